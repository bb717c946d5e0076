"""Segmentation of moving bodies: what stays blurred after the camera's motion is compensated is clustered.

The camera's rotation is that of the sharpest image of the events. A region is blurred if events agree much better under
a further velocity in the image. The events of blurred regions are clustered in space and time by DBSCAN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.events import Events
from amiwarp.studies.evaluate.contrast_motion import (
    MOST_LOCAL,
    dithered,
    estimate_rotation,
    local_agreement,
    pixel_index,
    rotated_back,
    thinned,
    velocity_grid,
)
from amiwarp.studies.evaluate.measures.libraries import library

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.camera import Camera


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
    """Least density of events around a core event, relative to that of all blurred events spread over the image."""
    least_share: float = 0.15
    """Least share of the blurred events in a cluster that counts as a body."""


MOST_CLUSTERED = 20_000
"""Largest number of events that are clustered; others belong to the cluster of the nearest of them."""
WINDOW_RADII = 5.0
"""Length of a window on the time axis of the clustering [radii]."""


def moving_events(events: Events, camera: Camera, settings: Sequence[SegmentationSettings]) -> list[NDArray[np.bool_]]:
    """Return which events of a short window belong to bodies that move, shape (n,), for each of several settings.

    ``events``: events of a plain camera, or compensated, in order of time. ``settings``: they may differ in the least
    gain and in the clustering only.
    """
    if len(events) < 2 or events.t[-1] == events.t[0]:
        return [np.zeros(len(events), np.bool_) for _ in settings]
    size, scale = (camera.width, camera.height), camera.width / 640.0
    back = rotated_back(dithered(events), camera, estimate_rotation(events, camera))
    gain = agreement_gain(back, size, settings[0], scale)
    out = []
    for s in settings:
        which = gain > s.gain
        mask = np.zeros(len(events), np.bool_)
        mask[np.flatnonzero(which)] = in_large_clusters(back[which], size, s, scale)
        out.append(mask)
    return out


def agreement_gain(events: Events, size: tuple[int, int], s: SegmentationSettings, scale: float) -> NDArray[np.float64]:
    """Return how much better events agree under a further velocity where each event lies, shape (n,): a ratio."""
    seconds = (int(events.t[-1]) - int(events.t[0])) * 1e-6
    grid = velocity_grid(s.reach_px * scale, max(s.step_px * scale, 1.0)).reshape(-1, 2)
    fast = np.hypot(*grid.T) >= s.least_px * scale
    slow_best, fast_best = (np.zeros(size[::-1]) for _ in range(2))
    found = local_agreement(thinned(events, MOST_LOCAL), size, grid / seconds, s.pool_px * scale)
    for is_fast, agreement in zip(fast, found, strict=True):
        best = fast_best if is_fast else slow_best
        np.maximum(best, agreement, out=best)
    ratio = np.divide(fast_best, slow_best, out=np.where(fast_best > 0.0, np.inf, 0.0), where=slow_best > 0.0)
    return np.asarray(ratio.ravel()[pixel_index(events, size)])


def in_large_clusters(
    events: Events, size: tuple[int, int], s: SegmentationSettings, scale: float
) -> NDArray[np.bool_]:
    """Return which events belong to a large cluster of DBSCAN over x, y and t, shape (n,)."""
    from scipy.spatial import KDTree

    if not len(events):
        return np.zeros(0, np.bool_)
    radius = s.radius_px * scale
    tau = (events.t - events.t[0]) / max(int(events.t[-1] - events.t[0]), 1)
    points = np.stack([events.x, events.y, WINDOW_RADII * radius * tau], axis=1)
    chosen = np.random.default_rng(0).permutation(len(points))[:MOST_CLUSTERED]
    even = len(chosen) * 4.0 / 3.0 * np.pi * radius**2 / (WINDOW_RADII * size[0] * size[1])
    least = max(3, round(s.density * even))
    label = library("sklearn.cluster").DBSCAN(eps=radius, min_samples=least).fit_predict(points[chosen])
    counts = np.bincount(label + 1, minlength=1)
    large = counts >= s.least_share * len(chosen)
    large[0] = False  # noise
    distance, nearest = KDTree(points[chosen]).query(points)
    return np.asarray(large[label + 1][nearest] & (distance <= radius))
