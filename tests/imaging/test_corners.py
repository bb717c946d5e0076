"""Corner detection: known answers, an independent implementation, streams, other libraries, bad input."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

import amiwarp
from amiwarp import CornerMethod, Events
from amiwarp.imaging import corners
from reference.corners import corners as reference_corners
from reference.corners import corners_of_dv_processing, table

METHODS = list(CornerMethod)


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
    x, y = (
        np.where(noise, rng.uniform(0, width, n), x),
        np.where(noise, rng.uniform(0, height, n), y),
    )
    p = (rng.random(n) < 0.5) if seed % 2 else (side + (phase % 6 > 3)) % 2
    return Events.from_arrays(
        x.astype(int).clip(0, width - 1), y.astype(int).clip(0, height - 1), t + 5_000_000_000, p
    )


def moving_square(
    size: int = 60, side: int = 16, steps: int = 24
) -> tuple[Events, NDArray[np.int64]]:
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
    # In the square, whose corners are at 0 and 15
    x, y = (
        events.x - 8.0 - place,
        events.y - 8.0 - place,
    )
    # From the nearest corner
    away = np.hypot(np.minimum(abs(x), abs(x - 15)), np.minimum(abs(y), abs(y - 15)))
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
    expected = reference_corners(events, 40, 30, method)
    assert expected.sum() > 100
    np.testing.assert_array_equal(
        amiwarp.detect_corners(events, (40, 30), detector=method, device=device), expected
    )


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
    plain = Events(
        *(column.copy() for column in (every_other.x, every_other.y, every_other.t, every_other.p))
    )
    found = amiwarp.detect_corners(every_other, (40, 30))
    np.testing.assert_array_equal(found, amiwarp.detect_corners(plain, (40, 30)))


@pytest.mark.parametrize("on_device", [False, True])
def test_bad_events_are_refused_and_change_nothing(on_device: bool) -> None:
    def given(x: list[float], t: list[int]) -> Events | amiwarp.DeviceEvents:
        x = np.array(x)
        events = Events.from_arrays(x, np.full_like(x, 5), t, np.ones_like(x))
        return (
            amiwarp.DeviceEvents.from_arrays(events.x, events.y, events.t, events.p)
            if on_device
            else events
        )

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
    with pytest.raises(amiwarp.AmiwarpError, match="expected Events or DeviceEvents"):
        amiwarp.detect_corners(np.zeros((3, 4)), (40, 30))  # type: ignore[call-overload]


RECORDINGS = ("text/shapes_rotation/events.txt", "evt/evt2_balls_640x480.raw")


@pytest.mark.parametrize("name", RECORDINGS)
def test_eventcv_finds_the_same_corners(data_dir: Path, name: str) -> None:
    import eventcv

    recording = amiwarp.open_recording(data_dir / name)
    events, size = recording.events.slice(0, 200_000), recording.events.size
    theirs = eventcv.from_numpy(table(events), sensor_size=size, time_unit="us").efast().numpy()
    ours = amiwarp.detect_corners(events, size, detector="efast")
    assert ours.sum() > 1000
    np.testing.assert_array_equal(table(events[ours]), theirs)


@pytest.mark.parametrize("name", RECORDINGS)
def test_dv_processing_differs_only_by_its_own_rule(data_dir: Path, name: str) -> None:
    """Its circles have radii of 5 and 6 px, an arc ends where times jump, and no redundant event is left out.

    Its rule, written once more in ``reference.corners``, gives exactly its corners.
    """
    dv_processing = pytest.importorskip("dv_processing")
    recording = amiwarp.open_recording(data_dir / name)
    events, (width, height) = recording.events.slice(0, 10_000), recording.events.size
    store = dv_processing.EventStore()
    for x, y, t, p in table(events).tolist():
        store.push_back(t, x, y, bool(p))
    detector = dv_processing.features.ArcCornerDetector((width, height), 50_000, False)
    found = detector.detect(store, (0, 0, width, height), np.full((height, width), 255, np.uint8))
    expected = table(events[corners_of_dv_processing(events, width, height, 50_000)])[:, :3]
    assert len(expected) > 100
    assert [
        [int(corner.pt[0]), int(corner.pt[1]), corner.timestamp] for corner in found
    ] == expected.tolist()
