"""Tracks of corner events, and their lifetime, error and update rate against truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import FrameTruth
from amiwarp.kernels import loading
from amiwarp.kernels.corner_tracks import CornerChains, link_events
from amiwarp.optics.camera import Camera
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.studies.evaluate.libraries import library

LIMITS_PX = tuple(float(limit) for limit in range(2, 11))
"""Distances from the truth at which a track ends, for the curves [px]."""
RADIUS_PX = 3.0
"""Largest step of a track of corner events [px]."""
GAP_US = 25_000
"""Largest time between two corner events of a track [us]: a little more than a quarter turn at 720 turns/min."""
OCCLUDED = 0.95
"""A point is occluded where the surface in its direction is nearer than this part of its depth."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Points of tracks, sorted by track, then by time."""

    number: NDArray[np.int64]
    """Number of the track of each point, from 0 without gaps, shape ``(n,)``."""
    t: NDArray[np.int64]
    """Times [us], shape ``(n,)``."""
    xy: NDArray[np.float64]
    """Places [px], shape ``(n, 2)``."""
    index: NDArray[np.int64]
    """Index of the corner event of each point, shape ``(n,)``."""

    @property
    def first(self) -> NDArray[np.int64]:
        """Position of the first point of each track, shape ``(tracks,)``."""
        return np.flatnonzero(np.diff(self.number, prepend=-1))


def sorted_tracks(number: ArrayLike, t: ArrayLike, xy: ArrayLike, index: ArrayLike) -> Tracks:
    """Return the points of tracks of at least two points, sorted and numbered anew. Points are given in time order."""
    old_number = np.asarray(number, np.int64)
    is_track = np.bincount(old_number, minlength=1) >= 2
    new_number = np.cumsum(is_track) - 1

    # The stable order by track keeps the order in time.
    order = np.argsort(old_number, kind="stable")
    order = order[is_track[old_number[order]]]
    places = np.asarray(xy, np.float64).reshape(-1, 2)
    return Tracks(
        number=new_number[old_number[order]],
        t=np.asarray(t, np.int64)[order],
        xy=places[order],
        index=np.asarray(index, np.int64)[order],
    )


def link_corners(
    t: NDArray[np.int64],
    xy: NDArray[np.floating],
    *,
    radius_px: float = RADIUS_PX,
    gap_us: int = GAP_US,
) -> Tracks:
    """Join corner events to tracks: each to the track whose last point is nearest, or to a new one.

    ``t``: rising times [us]. ``xy``: places [px], shape (n, 2); NaN for corners without a place, which are left out.
    A track takes corners up to ``radius_px`` from its last point and ``gap_us`` after it.
    """
    kept = np.flatnonzero(np.isfinite(xy).all(axis=1))
    times = np.asarray(t, np.int64)[kept]
    places = np.asarray(xy, np.float64)[kept]
    number = wp.empty(len(kept), dtype=int, device="cpu")
    chains = _chains(times, places, radius_px, gap_us)
    loading.load(link_events, number.device)
    wp.launch(link_events, 1, [chains], [number], device="cpu")
    return sorted_tracks(number.numpy(), times, places, kept)


def _chains(t: NDArray[np.int64], xy: NDArray[np.float64], radius_px: float, gap_us: int) -> Any:
    """Return corner events and empty lists of tracks as the struct that the kernel takes."""
    # Tracks are looked for in a grid of cells, whose side is the largest step, with a border of empty cells.
    column, row = np.floor(xy / radius_px).astype(np.int64).T
    if len(t):
        column = column - column.min() + 1
        row = row - row.min() + 1
    columns = int(column.max(initial=0)) + 2
    rows = int(row.max(initial=0)) + 2
    cell = (row * columns + column).astype(np.int32)

    chains = CornerChains()
    chains.x = wp.array(xy[:, 0], dtype=wp.float64, device="cpu")
    chains.y = wp.array(xy[:, 1], dtype=wp.float64, device="cpu")
    chains.t = wp.array(t, device="cpu")
    chains.cell = wp.array(cell, device="cpu")
    chains.columns = columns
    chains.radius = radius_px
    chains.gap = gap_us
    chains.head = wp.full(columns * rows, -1, dtype=int, device="cpu")
    chains.after = wp.zeros(len(t), dtype=int, device="cpu")
    chains.last = wp.zeros(len(t), dtype=int, device="cpu")
    return chains


MOST_CORNERS = 500
"""Largest number of corners that a frame adds to those that are tracked."""
QUALITY = 0.01
"""Least quality of a corner, relative to the best."""
APART_PX = 5.0
"""Least distance between corners [px]."""
BACK_PX = 1.0
"""Largest distance between a corner and the same corner tracked to the next frame and back [px]."""


def track_frames(grey: Sequence[NDArray[np.uint8]], t_us: Sequence[int]) -> Tracks:
    """Track corners through the frames of a standard camera (Shi and Tomasi; Lucas and Kanade, by OpenCV).

    ``t_us``: times of the frames [us]. In each frame, new corners are added away from those that are tracked. The
    ``index`` of a point is the index of its frame.
    """
    number = np.zeros(0, np.int64)
    xy = np.zeros((0, 2), np.float32)
    numbers = []
    places = []
    indices = []
    total = 0
    for k, frame in enumerate(grey):
        if k and len(xy):
            moved, is_tracked = _tracked(grey[k - 1], frame, xy)
            number = number[is_tracked]
            xy = moved[is_tracked]
        new = _new_corners(frame, xy)
        number = np.concatenate([number, total + np.arange(len(new))])
        xy = np.concatenate([xy, new])
        total = total + len(new)
        numbers.append(number)
        places.append(xy)
        indices.append(np.full(len(xy), k, np.int64))
    index = np.concatenate(indices)
    times = np.asarray(t_us, np.int64)[index]
    return sorted_tracks(np.concatenate(numbers), times, np.concatenate(places), index)


def _tracked(
    before: NDArray[np.uint8], frame: NDArray[np.uint8], xy: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return where corners of the frame before are [px], and whether tracking back leads to where they were."""
    cv2 = library("cv2")
    moved, was_found, _ = cv2.calcOpticalFlowPyrLK(before, frame, xy, None)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(frame, before, moved, None)
    away = back - xy
    returns = np.hypot(away[:, 0], away[:, 1]) < BACK_PX
    return moved, (was_found.ravel() == 1) & (found_back.ravel() == 1) & returns


def _new_corners(frame: NDArray[np.uint8], xy: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return corners away from the places of known ones [px], shape (n, 2)."""
    cv2 = library("cv2")
    free = np.full(frame.shape, 255, np.uint8)
    for x, y in np.rint(xy).astype(int).tolist():
        cv2.circle(free, (x, y), round(APART_PX), color=0, thickness=-1)
    corners = cv2.goodFeaturesToTrack(frame, MOST_CORNERS, QUALITY, APART_PX, mask=free)
    if corners is None:
        return np.zeros((0, 2), np.float32)
    return np.asarray(corners.reshape(-1, 2))


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
    if not len(places):
        return np.zeros((0, 2)), np.zeros(0)
    rotation, position = trajectory.poses(np.asarray(t_us, np.float64) * 1e-6)
    from_camera = np.asarray(places, np.float64) - position
    rays = np.einsum("ni,nij->nj", from_camera, rotation)
    return np.asarray(camera.rays_to_pixels(rays), np.float64), rays[:, 2]


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
    points = np.asarray(places, np.float64)[tracks.number]
    truth, depth = project(camera, trajectory, points, tracks.t)
    if not len(frames) or not len(truth):
        return truth
    instants = np.array([frame.t_us for frame in frames])
    nearest = np.abs(tracks.t[:, None] - instants).argmin(axis=1)
    for k, frame in enumerate(frames):
        rows = np.flatnonzero((nearest == k) & np.isfinite(truth).all(axis=1))
        at, _ = project(camera, trajectory, points[rows], np.full(len(rows), frame.t_us))
        hidden = _farthest(frame.depth, at) < OCCLUDED * depth[rows]
        truth[rows[hidden]] = np.nan
    return truth


def _farthest(depth: NDArray[np.float32], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest depth in the 3 x 3 pixels around places: infinite outside the image."""
    height, width = depth.shape
    nearest = np.rint(np.nan_to_num(xy))
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


@dataclass(frozen=True, slots=True, eq=False)
class TrackQuality:
    """Quality of tracks, for one limit."""

    limit_px: float
    """Distance from the truth at which a track ends [px]."""
    number: int
    """Number of tracks that live at least up to their second point."""
    lifetime_s: float
    """Mean time from the first point of a track to the last before it ends [s], over all tracks; NaN without tracks."""
    error_px: float
    """Mean distance from the truth until the end, over all points after the first of each track [px]."""
    update_hz: float
    """Number of points after the first of each track, by the time that tracks live [1/s]."""
    total_s: float
    """Sum of the lifetimes [s]."""


def lives(tracks: Tracks, truth: NDArray[np.float64], limit_px: float) -> NDArray[np.bool_]:
    """Return which points belong to the life of their track, shape (n,).

    A track ends before its first point that is more than ``limit_px`` from the truth, or whose truth is NaN.
    """
    if truth.shape != tracks.xy.shape:
        raise AmiwarpError(
            f"truth has shape {truth.shape}; expected the shape of the tracks, {tracks.xy.shape}"
        )
    near = _distances(tracks, truth) <= limit_px  # False for NaN
    # A point is alive if no point of its track, up to itself, is far.
    far_so_far = np.cumsum(~near)
    far_before_track: NDArray[np.int64] = far_so_far[tracks.first] - ~near[tracks.first]
    return np.asarray(far_so_far == far_before_track[tracks.number])


def _distances(tracks: Tracks, truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of each point from the truth [px], shape (n,)."""
    away = tracks.xy - truth
    return np.asarray(np.hypot(away[:, 0], away[:, 1]))


def lifetimes(tracks: Tracks, truth: NDArray[np.float64], limit_px: float) -> NDArray[np.float64]:
    """Return the lifetime of each track [s], shape (tracks,); 0 if it ends before its second point.

    :func:`lives` says when a track ends.
    """
    alive = lives(tracks, truth, limit_px)
    first = tracks.first
    count = np.bincount(tracks.number[alive], minlength=len(first))
    last = first + np.maximum(count, 1) - 1
    return np.asarray((tracks.t[last] - tracks.t[first]) * 1e-6)


def track_quality(tracks: Tracks, truth: NDArray[np.float64], limit_px: float) -> TrackQuality:
    """Return the quality of tracks that end more than ``limit_px`` from the truth, or where it is NaN."""
    is_update = lives(tracks, truth, limit_px)
    is_update[tracks.first] = False
    errors = _distances(tracks, truth)[is_update]
    lifetime = lifetimes(tracks, truth, limit_px)
    total = float(lifetime.sum())
    return TrackQuality(
        limit_px,
        number=len(np.unique(tracks.number[is_update])),
        lifetime_s=float(lifetime.mean()) if len(lifetime) else float("nan"),
        error_px=float(errors.mean()) if len(errors) else float("nan"),
        update_hz=len(errors) / total if total > 0.0 else float("nan"),
        total_s=total,
    )


def quality_curve(
    tracks: Tracks, truth: NDArray[np.float64], limits_px: Sequence[float] = LIMITS_PX
) -> list[TrackQuality]:
    """Return the quality of tracks for each of several limits, see :func:`track_quality`."""
    return [track_quality(tracks, truth, limit) for limit in limits_px]
