"""Corner detection: known answers, an independent implementation, streams, other libraries, bad input."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

import amiwarp
from amiwarp.events.events import Events
from amiwarp.imaging import corners
from amiwarp.imaging.choices import CornerMethod
from amiwarp.kernels.cpu_threads import limited_cpu_threads

METHODS = list(CornerMethod)
QUARTERS = {3: [(0, 3), (1, 3), (2, 2), (3, 1)], 4: [(0, 4), (1, 4), (2, 3), (3, 2), (4, 1)]}
TURNS = [np.array([[1, 0], [0, 1]]), np.array([[0, -1], [1, 0]]), np.array([[-1, 0], [0, -1]]), np.array([[0, 1], [-1, 0]])]
CIRCLES = {radius: np.concatenate([np.array(quarter) @ turn for turn in TURNS]) for radius, quarter in QUARTERS.items()}
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


def oracle(events: Events, width: int, height: int, method: CornerMethod) -> NDArray[np.bool_]:
    """Corners by the definitions in the papers: the surface before each event, then the arcs."""
    surface = np.full((2, height, width), -np.inf)
    last: dict[tuple[int, int], tuple[int, int]] = {}
    seen: dict[int, list[NDArray[np.float64]]] = {}
    for i, (x, y, t, p) in enumerate(zip(*(c.tolist() for c in (events.x, events.y, events.t, events.p)), strict=True)):
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
        times = np.array([circles[k] for circles in seen.values()])
        n, size = times.shape[1], shortest_arc(times, least)
        corner &= (size <= most) | ((method is CornerMethod.ARC) & (n - most <= size) & (size <= n - least))
    found = np.zeros(len(events), bool)
    found[np.array(list(seen))[corner]] = True
    return found


def random_events(n: int, width: int, height: int, seed: int) -> Events:
    """A square that moves on a circle, with noise, equal times and both polarities."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, n * 20, n))
    phase = t / (n * 20) * 4 * np.pi
    side, along = rng.integers(0, 4, n), rng.uniform(-1, 1, n)
    edge = np.where(side % 2, 1.0, -1.0)
    x = width * (0.5 + 0.2 * np.cos(phase)) + width / 6 * np.where(side < 2, edge, along)
    y = height * (0.5 + 0.2 * np.sin(phase)) + height / 6 * np.where(side < 2, along, edge)
    noise = rng.random(n) < 0.05
    x, y = np.where(noise, rng.uniform(0, width, n), x), np.where(noise, rng.uniform(0, height, n), y)
    p = (rng.random(n) < 0.5) if seed % 2 else (side + (phase % 6 > 3)) % 2
    return Events.from_arrays(x.astype(int).clip(0, width - 1), y.astype(int).clip(0, height - 1), t + 5_000_000_000, p)


def moving_square(size: int = 60, side: int = 16, steps: int = 24) -> tuple[Events, NDArray[np.int64]]:
    """A bright square moves by a pixel along the diagonal each ms. Returns its events, and its place at each."""
    images = np.zeros((steps + 1, size, size), bool)
    for k in range(steps + 1):
        images[k, 8 + k : 8 + k + side, 8 + k : 8 + k + side] = True
    blocks, place = [], []
    for k in range(1, steps + 1):
        y, x = np.nonzero(images[k] != images[k - 1])
        blocks.append(np.column_stack([x, y, np.full(len(x), 1000 * k), images[k][y, x]]))
        place += [k] * len(x)
    x, y, t, p = np.concatenate(blocks).T
    return Events.from_arrays(x, y, t, p), np.array(place)


@pytest.mark.parametrize("method", METHODS)
def test_corners_of_a_moving_square(device: str, method: CornerMethod) -> None:
    events, place = moving_square()
    found = amiwarp.detect_corners(events, (60, 60), detector=method, device=device)
    settled = found & (place > 6)
    front = (events.x == 7 + place + 16) & (events.y == 7 + place + 16) & (events.p == 1)
    print(method, [(events.x[i]-8-place[i], events.y[i]-8-place[i], events.p[i], place[i]) for i in np.flatnonzero(settled)][:30], settled.sum(), found[front])
    assert 0


@pytest.mark.parametrize("method", METHODS)
def test_random_events_agree_with_the_definition(device: str, method: CornerMethod) -> None:
    events = random_events(12_000, 40, 30, seed=1)
    expected = oracle(events, 40, 30, method)
    assert expected.sum() > 100
    np.testing.assert_array_equal(amiwarp.detect_corners(events, (40, 30), detector=method, device=device), expected)


@pytest.mark.parametrize("method", METHODS)
def test_lists_agree_with_order(device: str, method: CornerMethod) -> None:
    """GPUs sort the events into lists; the same code runs on CPUs. The surfaces pass from block to block."""
    events = random_events(50_000, 64, 48, seed=2)
    in_lists = corners.PassInLists(64, 48, method, wp.get_device(device))
    found = []
    for start in range(0, len(events), 7001):
        block = events[start : start + 7001]
        moved = amiwarp.DeviceEvents.from_arrays(block.x, block.y, block.t, block.p, device=device)
        corner = wp.empty(len(block), dtype=wp.bool, device=device)
        in_lists.detect(moved, corner)
        found.append(corner.numpy())
    expected = amiwarp.detect_corners(events, (64, 48), detector=method)
    assert expected.sum() > 100
    np.testing.assert_array_equal(np.concatenate(found), expected)
