"""Segmentation of moving bodies: what stays blurred after the camera's motion is compensated is clustered.

The camera's rotation makes the image of the events sharpest. A region is blurred if events agree much better under a
further velocity in the image. The events of blurred regions are clustered in space and time by DBSCAN.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp.events.recording import Events
from amiwarp.optics.camera import Camera
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.studies.evaluate.camera_motion import estimate_rotation, rotated_back
from amiwarp.studies.evaluate.event_images import dithered, pixel_index, thinned
from amiwarp.studies.evaluate.libraries import library
from amiwarp.studies.evaluate.local_motion import MOST_LOCAL, local_agreement, velocity_grid
from amiwarp.studies.evaluate.optical_flow import rotation_flow


@dataclass(frozen=True, slots=True)
class SegmentationSettings:
    """Settings of the segmentation, for an image of 640 px; lengths scale with the width."""

    reach_px: float = 28.0
    """Largest motion of a body in a window, relative to the background [px]."""
    step_px: float = 2.5
    """Step of the velocities that are tried, times the window [px]."""
    least_px: float = 5.0
    """Least motion in a window that counts as the motion of a body [px]."""
    pool_px: float = 8.0
    """Standard deviation of the surrounding in which events are compared [px]."""
    gain: float = 1.5
    """Least agreement under a further velocity, relative to that without."""
    radius_px: float = 8.0
    """Radius of DBSCAN's neighbourhood [px]; a window lasts as long as five radii in its time axis."""
    density: float = 2.0
    """Least density of events around a core event, relative to all blurred events spread over the image."""
    least_share: float = 0.15
    """Least share of the blurred events in a cluster that counts as a body."""


MOST_CLUSTERED = 20_000
"""Largest number of events that are clustered; others belong to the cluster of the nearest of them."""
WINDOW_RADII = 5.0
"""Length of a window on the time axis of the clustering [radii]."""


def moving_events(
    events: Events, camera: Camera, settings: Sequence[SegmentationSettings]
) -> list[NDArray[np.intp]]:
    """Return the number of the moving body that each event of a short window belongs to, shape (n,).

    The numbers begin at 1; 0 is the background. There is one array for each of several settings. ``events``: events of
    a plain camera, or compensated, in order of time. ``settings``: they may differ in the least gain and in the
    clustering only.
    """
    if len(events) < 2 or events.t[-1] == events.t[0]:
        return [np.zeros(len(events), np.intp) for _ in settings]
    size = (camera.width, camera.height)
    scale = camera.width / 640.0
    back = rotated_back(dithered(events), camera, estimate_rotation(events, camera))
    gain = agreement_gain(back, size, settings[0], scale)
    bodies = []
    for chosen in settings:
        blurred = gain > chosen.gain
        body = np.zeros(len(events), np.intp)
        body[blurred] = large_clusters(back[blurred], size, chosen, scale)
        bodies.append(body)
    return bodies


def agreement_gain(
    events: Events, size: tuple[int, int], settings: SegmentationSettings, scale: float
) -> NDArray[np.float64]:
    """Return how much better events agree under a further velocity where each event lies, shape (n,): a ratio."""
    seconds = (int(events.t[-1]) - int(events.t[0])) * 1e-6
    step = max(settings.step_px * scale, 1.0)
    motions = velocity_grid(settings.reach_px * scale, step).reshape(-1, 2)
    length = np.hypot(motions[:, 0], motions[:, 1])
    further = length >= settings.least_px * scale
    few = thinned(events, MOST_LOCAL)
    agreements = local_agreement(few, size, motions / seconds, settings.pool_px * scale)

    width, height = size
    best_at_rest = np.zeros((height, width))
    best_moving = np.zeros((height, width))
    for is_further, agreement in zip(further, agreements, strict=True):
        best = best_moving if is_further else best_at_rest
        np.maximum(best, agreement, out=best)
    if_none_at_rest = np.where(best_moving > 0.0, np.inf, 0.0)
    agrees_at_rest = best_at_rest > 0.0
    ratio = np.divide(best_moving, best_at_rest, out=if_none_at_rest, where=agrees_at_rest)
    return np.asarray(ratio.ravel()[pixel_index(events, size)])


def large_clusters(
    events: Events, size: tuple[int, int], settings: SegmentationSettings, scale: float
) -> NDArray[np.intp]:
    """Return the number of the large cluster of DBSCAN over x, y and t of each event, from 1 on; 0 for none."""
    from scipy.spatial import KDTree

    if not len(events):
        return np.zeros(0, np.intp)
    radius = settings.radius_px * scale
    share_of_window = (events.t - events.t[0]) / max(int(events.t[-1] - events.t[0]), 1)
    points = np.stack([events.x, events.y, WINDOW_RADII * radius * share_of_window], axis=1)
    order = np.random.default_rng(0).permutation(len(points))
    chosen = points[order[:MOST_CLUSTERED]]

    # Number of events in the neighbourhood of one if all were spread evenly
    width, height = size
    even = len(chosen) * 4.0 / 3.0 * np.pi * radius**2 / (WINDOW_RADII * width * height)
    least = max(3, round(settings.density * even))
    clustering = library("sklearn.cluster").DBSCAN(eps=radius, min_samples=least)
    cluster = clustering.fit_predict(chosen) + 1  # 0 is noise

    number = _number_of_large(cluster, settings.least_share * len(chosen))

    # Each event belongs to the cluster of the nearest clustered one.
    distance, nearest = KDTree(chosen).query(points)
    return np.asarray(np.where(distance <= radius, number[nearest], 0))


def _number_of_large(label: NDArray[np.integer], least: float) -> NDArray[np.intp]:
    """Return the number from 1 on of the group of each member, for groups of at least ``least``; 0 for others.

    ``label``: number of each member's group; group 0 is the rest, and has no number.
    """
    counts = np.bincount(label.ravel(), minlength=1)
    large = counts >= least
    large[0] = False
    number = np.where(large, np.cumsum(large), 0)
    return np.asarray(number[label], np.intp)


MOST_STEPS = 10
"""Number of steps of the fit of a rotation."""
OUTLIER = 2.5
"""Residual above which a pixel is left out of the fit [medians]."""


def moving_pixels(
    flow: NDArray[np.floating],
    camera: Camera,
    seconds: float,
    settings: SegmentationSettings = SegmentationSettings(),
) -> NDArray[np.intp]:
    """Return the number of the moving body that each pixel of a flow belongs to, from 1 on; 0 is the background.

    The camera's rotation is fitted to the flow, shape (height, width, 2) [px/s], without outliers. Bodies are connected
    regions that move further than that by ``least_px`` in a window of ``seconds``, and have ``least_share`` of all such
    pixels.
    """
    # Flow of 1 rad/s about each axis
    axes = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    parts = [rotation_flow(camera, CameraRotation(axis)) for axis in axes]
    basis = np.stack(parts, axis=-1).reshape(-1, 2, 3)
    given = flow.reshape(-1, 2).astype(np.float64)
    kept = np.ones(len(given), np.bool_)
    for _ in range(MOST_STEPS):
        equations = basis[kept].reshape(-1, 3)
        rate, *_ = np.linalg.lstsq(equations, given[kept].ravel(), rcond=None)
        left = given - basis @ rate
        residual = np.hypot(left[:, 0], left[:, 1])
        kept = residual <= OUTLIER * np.median(residual)

    distance = residual.reshape(flow.shape[:2]) * seconds
    moves = distance >= settings.least_px * camera.width / 640.0
    region, _ = ndimage.label(moves)
    least = max(1.0, settings.least_share * np.count_nonzero(moves))
    return _number_of_large(region, least)
