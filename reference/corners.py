"""Independent corner detectors in NumPy: eFAST, Arc*, and the rule of dv-processing's ``ArcCornerDetector``."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp import CornerMethod, Events

QUARTERS = {3: [(0, 3), (1, 3), (2, 2), (3, 1)], 4: [(0, 4), (1, 4), (2, 3), (3, 2), (4, 1)]}
TURNS = [np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), k) for k in range(4)]
CIRCLES = {
    radius: np.concatenate([np.array(quarter) @ turn for turn in TURNS])
    for radius, quarter in QUARTERS.items()
}
"""Pixels of the digital circles by radius, in the order of their angles, shape (n, 2)."""


def shortest_arc(times: NDArray[np.float64], least: int) -> NDArray[np.int64]:
    """Return the length of the shortest arc from ``least`` on that is newer than the rest of the circle, for each row.

    It is the number of pixels if there is no such arc.
    """
    n = times.shape[1]
    shortest = np.full(len(times), n)
    for length in range(n - 1, least - 1, -1):
        for start in range(n):
            turned = np.roll(times, -start, axis=1)
            shortest[turned[:, :length].min(axis=1) > turned[:, length:].max(axis=1)] = length
    return shortest


def corners(events: Events, width: int, height: int, method: CornerMethod) -> NDArray[np.bool_]:
    """Return which events are corners by the papers' definitions: the surface before each event, then the arcs."""
    surface = np.full((2, height, width), -np.inf)
    last: dict[tuple[int, int], tuple[int, int]] = {}
    seen: dict[int, list[NDArray[np.float64]]] = {}
    for i, (x, y, t, p) in enumerate(
        zip(*(c.tolist() for c in (events.x, events.y, events.t, events.p)), strict=True)
    ):
        if method is CornerMethod.ARC:
            t_before, p_before = last.get((x, y), (0, None))
            last[x, y] = (t, p)
            if p_before == p and t - t_before <= 50_000:
                continue
        if 4 <= x < width - 4 and 4 <= y < height - 4:
            seen[i] = [surface[p, y + CIRCLES[r][:, 1], x + CIRCLES[r][:, 0]] for r in (3, 4)]
        surface[p, y, x] = t
    corner = np.ones(len(seen), bool)
    for k, (least, most) in enumerate(((3, 6), (4, 8))):
        times = np.array([circles[k] for circles in seen.values()]).reshape(len(seen), -1)
        n, size = times.shape[1], shortest_arc(times, least)
        corner &= (size <= most) | (
            (method is CornerMethod.ARC) & (n - most <= size) & (size <= n - least)
        )
    found = np.zeros(len(events), bool)
    found[np.array(list(seen), int)[corner]] = True
    return found


def table(events: Events) -> NDArray[np.int64]:
    """Return events as rows x, y, t, p."""
    return np.column_stack([events.x, events.y, events.t, events.p]).astype(np.int64)


DV_RADII = {
    5: [(0, 5), (1, 5), (2, 5), (3, 4), (4, 3), (5, 2), (5, 1)],
    6: [(0, 6), (1, 6), (2, 6), (3, 5), (4, 4), (5, 3), (6, 2), (6, 1)],
}
DV_CIRCLES = [
    np.concatenate([np.array(quarter) @ turn for turn in TURNS]) for quarter in DV_RADII.values()
]


def dv_accepts(times: NDArray[np.int64], range_us: int) -> bool | None:
    """Return whether dv-processing takes a circle for that of a corner; None if no pixel of it had an event."""
    n, first = len(times), int(np.argmax(times))
    if times[first] == 0:
        return None
    ends, oldest = [first, first], times[first]
    open_ends = [True, True]
    while (
        any(open_ends)
        and (ends[1] - ends[0] + 1) < n
        and (ends[0] == ends[1] or (ends[1] - ends[0]) % n)
    ):
        for side, step in enumerate((-1, 1)):
            following = times[(ends[side] + step) % n]
            open_ends[side] = open_ends[side] and abs(following - oldest) < range_us
            if open_ends[side]:
                ends[side] += step
                oldest = min(oldest, following)
    size = ends[1] - ends[0] + 1
    least, most = (math.floor(n * share + 0.5) for share in (0.125, 0.4))
    rest = [times[k % n] for k in range(ends[1] + 1, ends[0] + n)]
    return (least <= size <= most or least <= n - size <= most) and all(t < oldest for t in rest)


def corners_of_dv_processing(
    events: Events, width: int, height: int, range_us: int
) -> NDArray[np.bool_]:
    """Return which events are corners by the rule of dv-processing 2.0."""
    surface, found = np.zeros((2, height, width), np.int64), np.zeros(len(events), bool)
    for i, (x, y, t, p) in enumerate(table(events).tolist()):
        if 6 <= x < width - 6 and 6 <= y < height - 6:
            circles = [surface[p, y + circle[:, 1], x + circle[:, 0]] for circle in DV_CIRCLES]
            accepted = [dv_accepts(times, range_us) for times in circles]
            found[i] = False not in accepted and True in accepted
        surface[p, y, x] = t
    return found
