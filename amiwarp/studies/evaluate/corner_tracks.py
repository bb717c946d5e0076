"""Tracks of corner events."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.kernels import loading
from amiwarp.kernels.corner_tracks import CornerChains, link_events

RADIUS_PX = 3.0
"""Largest step of a track of corner events [px]."""
GAP_US = 25_000
"""Largest time between two corner events of a track [us]: a little more than a quarter turn at 720 turns/min."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Points of tracks, sorted by track, then by time."""

    track: NDArray[np.int64]
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
        return np.flatnonzero(np.diff(self.track, prepend=-1))


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
        track=new_number[old_number[order]],
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
