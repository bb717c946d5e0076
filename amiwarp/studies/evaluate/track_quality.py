"""Lifetime, error and update rate of tracks against truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.studies.evaluate.corner_tracks import Tracks

LIMITS_PX = tuple(float(limit) for limit in range(2, 11))
"""Distances from the truth at which a track ends, for the curves [px]."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackQuality:
    """Quality of tracks, for one limit."""

    limit_px: float
    """Distance from the truth at which a track ends [px]."""
    tracks: int
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
    return np.asarray(far_so_far == far_before_track[tracks.track])


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
    count = np.bincount(tracks.track[alive], minlength=len(first))
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
        tracks=len(np.unique(tracks.track[is_update])),
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
