"""True places of tracked points: what a camera without a prism sees there."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.events.truth import FrameTruth
from amiwarp.optics.camera import Camera
from amiwarp.simulation.other_camera import places_in
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.studies.evaluate.corner_tracks import Tracks

OCCLUDED_SHARE = 0.95
"""A point is occluded where the surface in its direction is nearer than this part of its depth."""


def seen_places(
    frame: FrameTruth,
    camera: Camera,
    trajectory: Trajectory,
    xy: NDArray[np.floating],
    t_us: ArrayLike,
) -> NDArray[Any]:
    """Return what a camera without a prism sees at places [px], in the world [m], shape (n, 3); NaN for the sky.

    ``t_us``: time of each place [us], shape (n,), at which the depth is about as in ``frame``.
    """
    height, width = frame.depth.shape
    # The nearest pixel, for places up to the image's border and beyond.
    column = np.clip(np.rint(xy[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.rint(xy[:, 1]).astype(int), 0, height - 1)
    depth_or_nan = np.where(np.isfinite(frame.depth), frame.depth, np.nan)
    depth = depth_or_nan[row, column]

    rotation, position = trajectory.poses(np.asarray(t_us, np.float64) * 1e-6)
    rays = np.asarray(camera.pixels_to_rays(xy.astype(np.float64)))
    from_camera = rays * (depth / rays[:, 2])[:, None]
    return np.asarray(position + np.einsum("nj,nij->ni", from_camera, rotation))


def project(
    camera: Camera, trajectory: Trajectory, places: NDArray[np.floating], t_us: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where a camera without a prism sees a resting point at each time [px], shape (n, 2), and its depth [m].

    ``places``: points in the world [m], shape (n, 3), one for each time ``t_us`` [us], shape (n,). NaN if a point lies
    behind the camera.
    """
    seen = places_in(places, t_us, camera, trajectory)
    return seen.points, seen.depth


def true_paths(
    tracks: Tracks,
    places: NDArray[np.floating],
    camera: Camera,
    trajectory: Trajectory,
    frames: Sequence[FrameTruth] = (),
) -> NDArray[np.float64]:
    """Return the true place of each point of the tracks [px], shape (n, 2); NaN where it cannot be seen.

    ``places``: resting point in the world that each track begins on [m], shape (tracks, 3); NaN if unknown, such as on
    a moving body. ``frames``: ground truth at some instants; a point is occluded if a surface in the nearest of them is
    in front of it.
    """
    points = np.asarray(places, np.float64)[tracks.track]
    truth, depth = project(camera, trajectory, points, tracks.t)
    if not len(frames) or not len(truth):
        return truth
    instants = np.array([frame.t_us for frame in frames])
    nearest = np.abs(tracks.t[:, None] - instants).argmin(axis=1)
    for k, frame in enumerate(frames):
        rows = np.flatnonzero((nearest == k) & np.isfinite(truth).all(axis=1))
        seen_at, _ = project(camera, trajectory, points[rows], np.full(len(rows), frame.t_us))
        hidden = _largest_depth_around(frame.depth, seen_at) < OCCLUDED_SHARE * depth[rows]
        truth[rows[hidden]] = np.nan
    return truth


def _largest_depth_around(
    depth: NDArray[np.float32], xy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the largest depth in the 3 x 3 pixels around places: infinite outside the image."""
    height, width = depth.shape
    # A point behind the camera, whose place is NaN, gets a place outside: infinite, so that nothing hides it.
    nearest = np.rint(np.nan_to_num(xy, nan=-1.0))
    column = np.clip(nearest[:, 0], -1, width).astype(int)
    row = np.clip(nearest[:, 1], -1, height).astype(int)

    border = 2
    padded = np.pad(depth.astype(np.float64), border, constant_values=np.inf)
    farthest = np.full(len(xy), -np.inf)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            neighbour = padded[row + border + dy, column + border + dx]
            np.maximum(farthest, neighbour, out=farthest)
    return farthest
