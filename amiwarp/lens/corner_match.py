"""Corners of a board, located by matching the picture around each of them with the mean of all."""

import numpy as np
from numpy.typing import NDArray

from amiwarp.lens.board import MARKER_SHARE, Board, Corners
from amiwarp.lens.projection import Projection, Vector
from amiwarp.optics.camera import Camera

PATCH = 0.42
"""Half side of the patch around a corner [squares]."""
SAMPLES = 25
"""Number of samples of a patch along a side."""
SIDE = np.linspace(-PATCH, PATCH, SAMPLES)
"""Places of the samples along a side, from the corner [squares]."""
V = np.repeat(SIDE, SAMPLES)
"""Places of all samples along the columns of the board [squares], shape (samples,)."""
U = np.tile(SIDE, SAMPLES)
"""Places of all samples along the rows of the board [squares], shape (samples,)."""
MIDDLE = SAMPLES * SAMPLES // 2
"""Number of the sample on the corner itself."""
STRIP = (1.0 - MARKER_SHARE) / 2.0
"""Samples farther than this from both lines through the corner are left out [squares]: markers lie there."""
MATCHES = 3
"""Number of times that corners are matched with their mean patch."""
FARTHEST = 0.1
"""Largest shift that is believed [squares]."""


def match_corners(
    picture: NDArray[np.uint8],
    board: Board,
    corners: Corners,
    camera: Camera,
    pose: Vector,
) -> Corners:
    """Return corners that fit the mean patch of all corners of their picture best.

    ``camera`` and ``pose`` are known roughly; through them the patches are sampled in the board's frame, where all
    corners look alike, every second one in a mirror. The mean patch is made symmetric about its middle. Least squares
    give the shift, contrast and brightness of each patch. Compared with the gradients near a corner
    (``cornerSubPix``), the error is a third: all of the edges counts, and no blur need be known.
    """
    from scipy.ndimage import map_coordinates, spline_filter

    patches = _patch_pixels(board, corners, camera, pose)
    px_per_u, px_per_v = _corner_motion(patches)
    mirrored = _mirrored(board, corners)

    smooth = spline_filter(picture.astype(np.float64))
    xy = corners.xy
    for _ in range(MATCHES):
        samples = patches + xy[:, None]
        x = samples[:, :, 0]
        y = samples[:, :, 1]
        brightness = map_coordinates(smooth, [y, x], mode="nearest", prefilter=False)

        # All patches as if none were in a mirror.
        seen = brightness.reshape(-1, SAMPLES, SAMPLES)
        seen[mirrored] = seen[mirrored, :, ::-1]

        # The shifts along u are in the mirror again.
        shift = _shifts(seen, _mean_patch(seen))
        shift[0, mirrored] *= -1.0
        believed = np.abs(shift).max(axis=0) < FARTHEST
        shift[:, ~believed] = 0.0

        shift_u = shift[0, :, None]
        shift_v = shift[1, :, None]
        xy = xy + shift_u * px_per_u + shift_v * px_per_v
    return Corners(corners.ids, xy)


def _mirrored(board: Board, corners: Corners) -> NDArray[np.bool_]:
    """Return which corners look like the mirror image of the first one, shape (corners,)."""
    column = corners.ids % board.columns
    row = corners.ids // board.columns
    return np.asarray((column + row) % 2 == 1)


def _corner_motion(patches: Vector) -> tuple[Vector, Vector]:
    """Return how a corner moves in the picture with a shift along u, and along v [px/square], shape (corners, 2)."""
    two_samples = 2.0 * (SIDE[1] - SIDE[0])
    by_u = patches[:, MIDDLE + 1] - patches[:, MIDDLE - 1]
    by_v = patches[:, MIDDLE + SAMPLES] - patches[:, MIDDLE - SAMPLES]
    return by_u / two_samples, by_v / two_samples


def _patch_pixels(
    board: Board,
    corners: Corners,
    camera: Camera,
    pose: Vector,
) -> Vector:
    """Return the pixels of the samples of each patch, relative to its corner [px], shape (corners, samples, 2)."""
    in_plane = np.zeros_like(U)
    offsets = board.square_m * np.stack([U, V, in_plane], axis=1)
    of_corners = board.points[corners.ids]
    points = of_corners[:, None] + offsets

    lens = Projection(camera)
    pixels, _ = lens.of(pose, points.reshape(-1, 3))
    patches = pixels.reshape(len(corners.ids), -1, 2)
    return patches - patches[:, MIDDLE : MIDDLE + 1]


def _mean_patch(seen: Vector) -> Vector:
    """Return the mean of patches at equal brightness and contrast, made symmetric about its middle."""
    level = seen.mean(axis=(1, 2), keepdims=True)
    contrast = seen.std(axis=(1, 2), keepdims=True)
    normal = (seen - level) / np.maximum(contrast, 1.0)
    mean = normal.mean(axis=0)
    turned_by_half = mean[::-1, ::-1]
    return np.asarray((mean + turned_by_half) / 2.0)


def _shifts(seen: Vector, mean: Vector) -> Vector:
    """Return the shift of each patch against the mean patch along u and v [squares], shape (2, patches).

    Least squares give it together with contrast and brightness. A shift adds the gradient of the mean patch.
    """
    # Only near the edges: markers lie elsewhere.
    near = np.minimum(np.abs(U), np.abs(V)) < STRIP
    by_v, by_u = np.gradient(mean, SIDE, SIDE)
    explaining = [
        by_u.ravel(),
        by_v.ravel(),
        mean.ravel(),
        np.ones_like(U),
    ]
    columns = np.stack(explaining, axis=1)
    brightness = seen.reshape(len(seen), -1)
    factors, *_ = np.linalg.lstsq(
        columns[near],
        brightness[:, near].T,
        rcond=None,
    )
    gradients = factors[:2]
    contrast = factors[2]
    return np.asarray(-gradients / np.maximum(contrast, 1e-3))
