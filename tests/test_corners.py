"""Corner detection: known answers, an independent implementation, streams, other libraries, bad input."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import eventcv
import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

import amiwarp
from amiwarp.events.events import Events
from amiwarp.imaging import corners
from amiwarp.imaging.choices import CornerMethod

METHODS = list(CornerMethod)
QUARTERS = {3: [(0, 3), (1, 3), (2, 2), (3, 1)], 4: [(0, 4), (1, 4), (2, 3), (3, 2), (4, 1)]}
TURNS = [np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), k) for k in range(4)]
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
    settled = place > 6  # before, the square has not left a full trace
    x, y = events.x - 8.0 - place, events.y - 8.0 - place  # in the square, whose corners are at 0 and 15
    away = np.hypot(np.minimum(abs(x), abs(x - 15)), np.minimum(abs(y), abs(y - 15)))  # from the nearest corner
    assert away[found & settled].max() < 5.0
    front = settled & (x == 15) & (y == 15)
    assert found[front].all()
    assert front.sum() == 18
    for corner in ((0, 15), (15, 0), *([(0, 0)] if method is CornerMethod.ARC else [])):
        near = found & settled & (abs(x - corner[0]) < 3) & (abs(y - corner[1]) < 3)
        assert sorted(set(place[near])) == list(range(7, 25))


@pytest.mark.parametrize("method", METHODS)
def test_a_straight_edge_has_no_corner(device: str, method: CornerMethod) -> None:
    rng = np.random.default_rng(5)
    column, row = (c.ravel() for c in np.meshgrid(np.arange(50), np.arange(40), indexing="ij"))
    t = column * 1000 + rng.integers(0, 300, len(column))
    order = np.argsort(t, kind="stable")
    for p in (0, 1):
        events = Events.from_arrays(column[order], row[order], t[order], np.full(len(t), p))
        assert not amiwarp.detect_corners(events, (50, 40), detector=method, device=device).any()


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


@pytest.mark.parametrize("method", METHODS)
def test_packets_give_the_same_as_the_whole(device: str, method: CornerMethod) -> None:
    events = random_events(40_000, 70, 53, seed=4)
    whole = amiwarp.detect_corners(events, (70, 53), detector=method, device=device)
    detector = amiwarp.CornerDetector((70, 53), detector=method, device=device)
    edges = [0, 0, 1, 2, 500, 20_000, 20_000, 40_000]
    packets = [detector.detect(events[a:b]) for a, b in itertools.pairwise(edges)]
    assert whole.sum() > 100
    np.testing.assert_array_equal(np.concatenate(packets), whole)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [(70, 53), (40, 300), (9, 9), (8, 20), (1, 1)])
def test_any_number_of_threads_gives_the_same(
    monkeypatch: pytest.MonkeyPatch, method: CornerMethod, size: tuple[int, int]
) -> None:
    events = random_events(20_000, *size, seed=6)
    found = []
    for threads in (1, 2, 3, 7):
        monkeypatch.setattr(corners, "cpu_threads", lambda threads=threads: threads)
        found.append(amiwarp.detect_corners(events, size, detector=method))
    assert found[0].any() == (min(size) > 9)
    assert all((other == found[0]).all() for other in found[1:])


def test_events_on_a_device_give_a_warp_array(device: str) -> None:
    events = random_events(5_000, 40, 30, seed=8)
    moved = amiwarp.DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device)
    found = amiwarp.detect_corners(moved, (40, 30))
    assert isinstance(found, wp.array)
    assert str(found.device) == device
    np.testing.assert_array_equal(found.numpy(), amiwarp.detect_corners(events, (40, 30)))


def test_no_events(device: str) -> None:
    found = amiwarp.detect_corners(Events.empty(), (40, 30), device=device)
    assert found.shape == (0,)
    assert found.dtype == np.bool_
    empty = amiwarp.DeviceEvents.from_arrays([], [], [], [], device=device)
    assert amiwarp.detect_corners(empty, (40, 30)).shape == (0,)


def test_columns_with_gaps_are_read() -> None:
    events = random_events(6_000, 40, 30, seed=9)
    every_other = events[::2]
    plain = Events(*(column.copy() for column in (every_other.x, every_other.y, every_other.t, every_other.p)))
    found = amiwarp.detect_corners(every_other, (40, 30))
    np.testing.assert_array_equal(found, amiwarp.detect_corners(plain, (40, 30)))


@pytest.mark.parametrize("on_device", [False, True])
def test_bad_events_are_refused_and_change_nothing(on_device: bool) -> None:
    def given(x: list[float], t: list[int]) -> Events | amiwarp.DeviceEvents:
        x = np.array(x)
        events = Events.from_arrays(x, np.full_like(x, 5), t, np.ones_like(x))
        return amiwarp.DeviceEvents.from_arrays(events.x, events.y, events.t, events.p) if on_device else events

    detector = amiwarp.CornerDetector((40, 30))
    detector.detect(given([3], [1000]))
    for x, t, message in (
        ([40], [1000], "outside the 40x30 frame"),
        ([3, 3], [2000, 1999], "sort by time"),
        ([3], [999], "1000 us"),
        ([3.5], [2000], "already compensated"),
    ):
        with pytest.raises(amiwarp.AmiwarpError, match=message):
            detector.detect(given(x, t))
    assert len(detector.detect(given([3], [1000]))) == 1


def test_bad_settings_are_refused() -> None:
    for size, method, message in (
        ((40, 30), "harris", "choose among efast, arc"),
        ((40, 0), "arc", "size of the sensor = 0"),
        ((40,), "arc", "expected 2 numbers"),
        ((65536, 65536), "arc", "more than 536870912 pixels"),
    ):
        with pytest.raises(amiwarp.AmiwarpError, match=message):
            amiwarp.CornerDetector(size, detector=method)  # type: ignore[arg-type]
    with pytest.raises(amiwarp.AmiwarpError, match="expected a Events"):
        amiwarp.detect_corners(np.zeros((3, 4)), (40, 30))  # type: ignore[call-overload]


def table(events: Events) -> NDArray[np.int64]:
    return np.column_stack([events.x, events.y, events.t, events.p]).astype(np.int64)


RECORDINGS = ("text/shapes_rotation/events.txt", "evt/evt2_balls_640x480.raw")


@pytest.mark.parametrize("name", RECORDINGS)
def test_eventcv_finds_the_same_corners(data_dir: Path, name: str) -> None:
    recording = amiwarp.open_recording(data_dir / name)
    events, size = recording.events.slice(0, 200_000), recording.events.size
    theirs = eventcv.from_numpy(table(events), sensor_size=size, time_unit="us").efast().numpy()
    ours = amiwarp.detect_corners(events, size, detector="efast")
    assert ours.sum() > 1000
    np.testing.assert_array_equal(table(events[ours]), theirs)


DV_RADII = {
    5: [(0, 5), (1, 5), (2, 5), (3, 4), (4, 3), (5, 2), (5, 1)],
    6: [(0, 6), (1, 6), (2, 6), (3, 5), (4, 4), (5, 3), (6, 2), (6, 1)],
}
DV_CIRCLES = [np.concatenate([np.array(quarter) @ turn for turn in TURNS]) for quarter in DV_RADII.values()]


def dv_accepts(times: NDArray[np.int64], range_us: int) -> bool | None:
    """Whether dv-processing takes a circle for that of a corner; None if no pixel of it had an event."""
    n, first = len(times), int(np.argmax(times))
    if times[first] == 0:
        return None
    ends, oldest = [first, first], times[first]
    open_ends = [True, True]
    while any(open_ends) and (ends[1] - ends[0] + 1) < n and (ends[0] == ends[1] or (ends[1] - ends[0]) % n):
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


@pytest.mark.parametrize("name", RECORDINGS)
def test_dv_processing_differs_only_by_its_own_rule(data_dir: Path, name: str) -> None:
    """Its circles have radii of 5 and 6 px, an arc ends where times jump, and no redundant event is left out.

    Its rule, written here once more, gives exactly its corners. The surfaces and circles are those of amiwarp's tests.
    """
    features = pytest.importorskip("dv_processing").features
    store = pytest.importorskip("dv_processing").EventStore()
    recording = amiwarp.open_recording(data_dir / name)
    events, (width, height) = recording.events.slice(0, 10_000), recording.events.size
    surface = np.zeros((2, height, width), np.int64)
    expected = []
    for x, y, t, p in table(events).tolist():
        store.push_back(t, x, y, bool(p))
        if 6 <= x < width - 6 and 6 <= y < height - 6:
            circles = [surface[p, y + circle[:, 1], x + circle[:, 0]] for circle in DV_CIRCLES]
            accepted = [dv_accepts(times, 50_000) for times in circles]
            if False not in accepted and True in accepted:
                expected.append((x, y, t))
        surface[p, y, x] = t
    detector = features.ArcCornerDetector((width, height), 50_000, False)
    found = detector.detect(store, (0, 0, width, height), np.full((height, width), 255, np.uint8))
    assert len(expected) > 100
    assert [(int(corner.pt[0]), int(corner.pt[1]), corner.timestamp) for corner in found] == expected
