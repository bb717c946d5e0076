"""Optical flow from events: dense inverse search between event images, and contrast maximisation per tile."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from amiwarp.imaging.warped_image import iwe
from amiwarp.studies.evaluate.contrast_motion import (
    MOST_LOCAL,
    dithered,
    estimate_rotation,
    local_contrast,
    rotated_back,
    thinned,
    velocity_grid,
)
from amiwarp.studies.evaluate.measures.libraries import library

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.events import Events
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.camera_rotation import CameraRotation

BRIGHT_PERCENTILE = 99.0
"""Percentile of the non-empty pixels of both event images that becomes the brightest grey value."""
TILE = 16
"""Distance between the centres of overlapping tiles [px]; half of it is the standard deviation of their Gaussian."""
REACH_PX = 4.0
"""Largest motion in a window that is tried in addition to the camera's rotation [px]."""


def flow_by_dis(first: Events, second: Events, size: tuple[int, int], interval_s: float) -> NDArray[np.float32]:
    """Return the flow [px/s] between the event images of two windows, shape (height, width, 2), by OpenCV's DIS.

    ``size``: width and height [px]. ``interval_s``: time between the middles of the windows [s].
    Source: T. Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016.
    """
    cv2 = library("cv2")
    images = [iwe(events, *size) for events in (first, second)]
    full = np.concatenate([image[image > 0.0] for image in images])
    top = float(np.percentile(full, BRIGHT_PERCENTILE)) if full.size else 1.0
    grey = [np.clip(255.0 / top * image, 0.0, 255.0).astype(np.uint8) for image in images]
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return np.asarray(search.calc(*grey, None) / np.float32(interval_s))


def flow_by_contrast(events: Events, camera: Camera) -> NDArray[np.float32]:
    """Return the flow [px/s] in the middle of a window, shape (height, width, 2), by contrast maximisation.

    It is the flow of the camera's rotation plus, for each tile, the velocity that makes its events sharpest.
    """
    size = (camera.width, camera.height)
    if len(events) < 2 or events.t[-1] == events.t[0]:
        return np.zeros((*size[::-1], 2), np.float32)
    events, seconds = dithered(events), (int(events.t[-1]) - int(events.t[0])) * 1e-6
    rotation = estimate_rotation(events, camera)
    grid = velocity_grid(REACH_PX, 1.0)
    rows, columns = (np.arange(min(TILE // 2, n // 2), n, TILE) for n in size[::-1])
    back = rotated_back(thinned(events, MOST_LOCAL), camera, rotation)
    maps = local_contrast(back, size, grid.reshape(-1, 2) / seconds, TILE / 2.0)
    scores = np.array([sharpness[np.ix_(rows, columns)] for sharpness in maps])
    motion = sharpest(scores.reshape(*grid.shape[:2], len(rows), len(columns)), grid)
    at = np.meshgrid(*((np.arange(n) - c[0]) / TILE for n, c in zip(size[::-1], (rows, columns), strict=True)),
                     indexing="ij")  # fmt: skip
    dense = [ndimage.map_coordinates(motion[..., k], at, order=1, mode="nearest") for k in range(2)]
    return np.asarray(rotation_flow(camera, rotation) + np.stack(dense, axis=-1) / seconds, np.float32)


def sharpest(scores: NDArray[np.float64], grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the best motion of each tile, refined by a parabola through the neighbours along each axis.

    ``scores``: shape (n, n, ...), for the motions ``grid`` of shape (n, n, 2), whose x varies along the second axis.
    """
    n, step = len(grid), float(grid[0, 1, 0] - grid[0, 0, 0])
    flat = scores.reshape(n, n, -1)
    best = flat.reshape(n * n, -1).argmax(axis=0)
    row, column, tile = best // n, best % n, np.arange(flat.shape[2])
    motion = grid[row, column].copy()
    inner = np.clip(row, 1, n - 2), np.clip(column, 1, n - 2)
    middle = flat[inner[0], inner[1], tile]
    for k, (i, j) in enumerate(((0, 1), (1, 0))):
        low, high = flat[inner[0] - i, inner[1] - j, tile], flat[inner[0] + i, inner[1] + j, tile]
        bend = low - 2.0 * middle + high
        peak = (bend < 0.0) & (inner[0] == row) & (inner[1] == column)
        motion[:, k] += np.where(peak, step * 0.5 * (low - high) / np.where(peak, bend, 1.0), 0.0)
    return np.asarray(motion.reshape(*scores.shape[2:], 2))


def rotation_flow(camera: Camera, rotation: CameraRotation) -> NDArray[np.float64]:
    """Return the flow [px/s] of static points while the camera rotates, shape (height, width, 2)."""
    from scipy.spatial.transform import Rotation

    moment_s = 1e-3
    y, x = np.mgrid[: camera.height, : camera.width]
    xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    rays = camera.pixels_to_rays(xy)
    turn = Rotation.from_rotvec(rotation.rotation(np.array([-moment_s, moment_s])))
    before, after = (camera.rays_to_pixels(turn[k].apply(rays)) for k in (1, 0))
    return np.asarray((after - before) / (2.0 * moment_s)).reshape(camera.height, camera.width, 2)
