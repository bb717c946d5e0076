"""Optical flow from events, and its error: dense inverse search between event images, and contrast maximisation."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.imaging.iwe import iwe
from amiwarp.optics.camera import Camera
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.studies.evaluate.camera_motion import estimate_rotation, rotated_back
from amiwarp.studies.evaluate.event_images import dithered, grey_images, thinned
from amiwarp.studies.evaluate.libraries import library
from amiwarp.studies.evaluate.local_motion import MOST_LOCAL, local_contrast, velocity_grid

TILE = 16
"""Distance between the centres of overlapping tiles [px]; half of it is the standard deviation of their Gaussian."""
REACH_PX = 4.0
"""Largest motion in a window that is tried in addition to the camera's rotation [px]."""


def flow_by_dis(
    first: Events, second: Events, size: tuple[int, int], interval_s: float
) -> NDArray[np.float32]:
    """Return the flow [px/s] between the event images of two windows, shape (height, width, 2), by OpenCV's DIS.

    ``size``: width and height [px]. ``interval_s``: time between the middles of the windows [s].
    Source: T. Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016.
    """
    # Both images are scaled alike, as the flow keeps the brightness of what moves.
    grey = grey_images([iwe(events, *size) for events in (first, second)])
    return frames_flow(grey, interval_s)


def frames_flow(grey: Sequence[NDArray[np.uint8]], interval_s: float) -> NDArray[np.float32]:
    """Return the flow [px/s] between two pictures that are ``interval_s`` apart, by OpenCV's DIS."""
    cv2 = library("cv2")
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return np.asarray(search.calc(*grey, None) / np.float32(interval_s))


def flow_by_contrast(events: Events, camera: Camera) -> NDArray[np.float32]:
    """Return the flow [px/s] in the middle of a window, shape (height, width, 2), by contrast maximisation.

    It is the flow of the camera's rotation plus, for each tile, the velocity that makes its events sharpest.
    """
    width = camera.width
    height = camera.height
    if len(events) < 2 or events.t[-1] == events.t[0]:
        return np.zeros((height, width, 2), np.float32)
    seconds = (int(events.t[-1]) - int(events.t[0])) * 1e-6
    events = dithered(events)
    rotation = estimate_rotation(events, camera)
    back = rotated_back(thinned(events, MOST_LOCAL), camera, rotation)

    # Sharpness at the middle of each tile, for each motion in the window
    grid = velocity_grid(REACH_PX, 1.0)
    velocities = grid.reshape(-1, 2) / seconds
    rows = _middles_of_tiles(height)
    columns = _middles_of_tiles(width)
    middles = np.ix_(rows, columns)
    maps = local_contrast(back, (width, height), velocities, TILE / 2.0)
    scores = np.array([sharpness[middles] for sharpness in maps])
    scores = scores.reshape(*grid.shape[:2], len(rows), len(columns))
    motion = sharpest(scores, grid)

    # Interpolated between the tiles
    tile_row = (np.arange(height) - rows[0]) / TILE
    tile_column = (np.arange(width) - columns[0]) / TILE
    places = np.meshgrid(tile_row, tile_column, indexing="ij")
    motion_x = ndimage.map_coordinates(motion[..., 0], places, order=1, mode="nearest")
    motion_y = ndimage.map_coordinates(motion[..., 1], places, order=1, mode="nearest")
    further = np.stack([motion_x, motion_y], axis=-1) / seconds
    return np.asarray(rotation_flow(camera, rotation) + further, np.float32)


def _middles_of_tiles(side: int) -> NDArray[np.intp]:
    """Return the middles of the tiles along a side of the image [px]."""
    return np.arange(min(TILE // 2, side // 2), side, TILE)


def sharpest(scores: NDArray[np.float64], grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the best motion of each tile, refined by a parabola through the neighbours along each axis.

    ``scores``: shape (n, n, ...), for the motions ``grid`` of shape (n, n, 2), whose x varies along the second axis.
    """
    n = len(grid)
    step = float(grid[0, 1, 0] - grid[0, 0, 0])
    flat = scores.reshape(n, n, -1)
    best = flat.reshape(n * n, -1).argmax(axis=0)
    row, column = np.divmod(best, n)
    tile = np.arange(flat.shape[2])
    motion = grid[row, column].copy()

    # A best motion at the border of the grid has no neighbours on both sides: it is not refined.
    inner_row = np.clip(row, 1, n - 2)
    inner_column = np.clip(column, 1, n - 2)
    is_inner = (inner_row == row) & (inner_column == column)
    middle = flat[inner_row, inner_column, tile]
    for axis, (down, right) in enumerate(((0, 1), (1, 0))):
        low = flat[inner_row - down, inner_column - right, tile]
        high = flat[inner_row + down, inner_column + right, tile]
        bend = low - 2.0 * middle + high
        peak = (bend < 0.0) & is_inner
        shift = step * 0.5 * (low - high) / np.where(peak, bend, 1.0)
        motion[:, axis] += np.where(peak, shift, 0.0)
    return np.asarray(motion.reshape(*scores.shape[2:], 2))


def rotation_flow(camera: Camera, rotation: CameraRotation) -> NDArray[np.float64]:
    """Return the flow [px/s] of static points while the camera rotates, shape (height, width, 2)."""
    from scipy.spatial.transform import Rotation

    moment_s = 1e-3
    y, x = np.mgrid[: camera.height, : camera.width]
    xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    rays = camera.pixels_to_rays(xy)

    # Static points turn against the camera.
    turns = Rotation.from_rotvec(rotation.rotation(np.array([-moment_s, moment_s])))
    before = camera.rays_to_pixels(turns[1].apply(rays))
    after = camera.rays_to_pixels(turns[0].apply(rays))
    flow = np.asarray((after - before) / (2.0 * moment_s))
    return flow.reshape(camera.height, camera.width, 2)


OUTLIER_PX = 3.0
"""Endpoint error above which a pixel is an outlier [px]."""


@dataclass(frozen=True, slots=True)
class FlowError:
    """Errors of a flow field. They are NaN if no pixel is compared."""

    epe: float
    """Mean endpoint error, in the unit of the flow."""
    outliers: float
    """Share of pixels with an endpoint error above the threshold."""
    pixels: int
    """Number of pixels compared."""


def flow_error(
    flow: NDArray[Any],
    truth: NDArray[Any],
    where: NDArray[np.bool_],
    *,
    outlier: float = OUTLIER_PX,
) -> FlowError:
    """Compare a flow field with the true one, both of shape (height, width, 2), in the pixels of a mask.

    Pixels at which either flow is not finite are left out. Raises :class:`AmiwarpError` for different shapes.
    """
    if flow.shape != truth.shape or flow.shape[:2] != where.shape:
        raise AmiwarpError(
            f"flow, truth and mask have shapes {flow.shape}, {truth.shape}, {where.shape}; give "
            "(height, width, 2) twice and (height, width)"
        )
    difference = flow.astype(np.float64) - truth
    error = np.hypot(difference[..., 0], difference[..., 1])[where]
    error = error[np.isfinite(error)]
    if not error.size:
        return FlowError(float("nan"), float("nan"), 0)
    is_outlier = error > outlier
    return FlowError(float(error.mean()), float(is_outlier.mean()), int(error.size))
