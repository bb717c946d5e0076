"""Event representations: equal to float64 and integer definitions, for windows, batches and compensated events.

The oracles follow the definitions of the programs that they are named after, but are written anew.
"""

import gc
import pickle
import re
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import amiwarp
from amiwarp import AmiwarpError, Camera, DeviceEvents, Encoder, Events, Recording
from amiwarp.imaging import tensors, whole_windows, window_batch, window_images
from amiwarp.tasks import limited_cpu_threads

WIDTH, HEIGHT, BINS = 24, 17, 5
NEVER = np.iinfo(np.int64).min
EXACT = 1e-5
"""Largest error of a floating element [events]."""


def some_events(
    n: int = 20_000, seed: int = 0, *, span: int = 40_000, start: int = 7_000_000
) -> Events:
    """Return random events, a tenth of them at one hot pixel, the first and last one at the ends of the span."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    hot = rng.random(n) < 0.1
    x[hot], y[hot] = 3, 4
    t = np.sort(rng.integers(0, span + 1, n))
    t[:1], t[-1:] = 0, span
    return Events.from_arrays(x, y, start + t, rng.integers(0, 2, n))


def positions(events: Events, seed: int = 1) -> Events:
    """Return the events at random positions between pixels, some of them outside the image, one without a position."""
    rng = np.random.default_rng(seed)
    x = (events.x + rng.uniform(-1.5, 1.5, len(events))).astype(np.float32)
    y = (events.y + rng.uniform(-1.5, 1.5, len(events))).astype(np.float32)
    x[5] = np.nan
    return Events(x, y, events.t, events.p)


def put(events: Events, device: str) -> Events | DeviceEvents:
    """Return events on a GPU as DeviceEvents, on the CPU as they are."""
    if device == "cpu":
        return events
    return DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device)


def host(found: Any) -> np.ndarray:
    return found.numpy() if isinstance(found, wp.array) else found


# Definitions.


def weights(events: Events) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return row, column and weight of each event in the four pixels around its position."""
    x, y = events.x.astype(np.float64), events.y.astype(np.float64)
    keep = np.isfinite(x) & np.isfinite(y)
    x, y = np.where(keep, x, -9.0), np.where(keep, y, -9.0)
    left, top = np.floor(x), np.floor(y)
    found = []
    for column, wx in ((left, left + 1 - x), (left + 1, x - left)):
        for row, wy in ((top, top + 1 - y), (top + 1, y - top)):
            inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
            weight = np.where(inside, wx * wy, 0.0)
            found.append(
                (
                    np.where(inside, row, 0).astype(int),
                    np.where(inside, column, 0).astype(int),
                    weight,
                )
            )
    return found


def linear_grid(events: Events, bins: int, intervals: int, t0: int, t1: int) -> np.ndarray:
    """Return polarities, bilinear in x and y and linear in time between ``intervals + 1`` bins, of which ``bins`` stay.

    With ``intervals = bins - 1`` these are Zhu's event volumes, E2VID's and DSEC's voxel grids, and with
    ``intervals = bins`` those of tonic and evlib.
    """
    grid = np.zeros((max(bins, intervals) + 1, HEIGHT, WIDTH))
    s = intervals * (events.t - t0) / max(t1 - t0, 1)
    k = s.astype(int)
    sign = np.where(events.p > 0, 1.0, -1.0)
    for row, column, weight in weights(events):
        np.add.at(grid, (k, row, column), sign * weight * (1 - (s - k)))
        np.add.at(grid, (np.minimum(k + 1, len(grid) - 1), row, column), sign * weight * (s - k))
    return grid[:bins]


def normalised(grid: np.ndarray) -> np.ndarray:
    """Return a grid whose elements that are not 0 have mean 0 and standard deviation 1, as DSEC's and E2VID's code."""
    filled = np.abs(grid) > 1e-9
    values = grid[filled]
    deviation = values.std(ddof=1) if len(values) > 1 else 0.0
    out = np.zeros_like(grid)
    out[filled] = (values - values.mean()) / (deviation if deviation > 0 else 1.0)
    return out


def rvt_histogram(events: Events, bins: int, limit: int, t0: int, t1: int) -> np.ndarray:
    """Return RVT's stacked histogram: counts by polarity and time bin, in integer arithmetic."""
    counts = np.zeros((2, bins, HEIGHT, WIDTH), np.int64)
    k = np.minimum(bins * (events.t - t0) // max(t1 - t0, 1), bins - 1)
    np.add.at(counts, (events.p.astype(int), k, events.y.astype(int), events.x.astype(int)), 1)
    return np.minimum(counts, limit).astype(np.uint8).reshape(2 * bins, HEIGHT, WIDTH)


def surface(events: Events) -> np.ndarray:
    """Return the latest time of each polarity and pixel."""
    latest = np.full((2, HEIGHT, WIDTH), NEVER)
    for x, y, t, p in zip(events.x, events.y, events.t, events.p, strict=True):
        latest[p, y, x] = t
    return latest


def decayed(latest: np.ndarray, t_end: int, tau: float) -> np.ndarray:
    return np.where(
        latest == NEVER, 0.0, np.exp(-(t_end - np.where(latest == NEVER, t_end, latest)) / tau)
    )


# One window.


def test_counts(device: str) -> None:
    events = some_events()
    counts = np.zeros((2, HEIGHT, WIDTH), np.int32)
    np.add.at(counts, (events.p.astype(int), events.y.astype(int), events.x.astype(int)), 1)
    found = host(amiwarp.polarity_histogram(put(events, device), WIDTH, HEIGHT))
    assert found.dtype == np.int32
    assert np.array_equal(found, counts)
    assert np.array_equal(
        host(amiwarp.event_count(put(events, device), WIDTH, HEIGHT)), counts.sum(axis=0)
    )


@pytest.mark.parametrize("bins", [1, 2, 5, 9])
def test_voxel_grid_of_e2vid(bins: int, device: str) -> None:
    events = some_events()
    found = host(amiwarp.voxel_grid(put(events, device), WIDTH, HEIGHT, bins))
    assert found.dtype == np.float32
    expected = linear_grid(events, bins, bins - 1, events.t[0], events.t[-1])
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)


@pytest.mark.parametrize("bins", [1, 5])
def test_voxel_grid_of_tonic(bins: int, device: str) -> None:
    events = some_events()
    found = host(amiwarp.voxel_grid(put(events, device), WIDTH, HEIGHT, bins, end_bin=False))
    expected = linear_grid(events, bins, bins, events.t[0], events.t[-1])
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)


def test_voxel_grid_of_dsec(device: str) -> None:
    """DSEC's events have rectified coordinates between pixels; here, some lie outside the image, and one is NaN."""
    events = positions(some_events())
    expected = linear_grid(events, BINS, BINS - 1, events.t[0], events.t[-1])
    found = host(amiwarp.voxel_grid(put(events, device), WIDTH, HEIGHT, BINS))
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)
    found = host(amiwarp.voxel_grid(put(events, device), WIDTH, HEIGHT, BINS, normalize=True))
    np.testing.assert_allclose(found, normalised(expected), rtol=0, atol=EXACT)


def test_whole_positions_give_the_grid_of_pixels(device: str) -> None:
    events = some_events()
    floating = Events(events.x.astype(np.float32), events.y.astype(np.float32), events.t, events.p)
    grids = [
        host(amiwarp.voxel_grid(put(e, device), WIDTH, HEIGHT, BINS)) for e in (events, floating)
    ]
    np.testing.assert_allclose(grids[0], grids[1], rtol=0, atol=EXACT)


def test_normalised_grid(device: str) -> None:
    events = some_events(800)
    found = host(amiwarp.voxel_grid(put(events, device), WIDTH, HEIGHT, BINS, normalize=True))
    expected = normalised(linear_grid(events, BINS, BINS - 1, events.t[0], events.t[-1]))
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)
    assert abs(found[found != 0].mean()) < EXACT
    assert found[found != 0].std(ddof=1) == pytest.approx(1.0, abs=EXACT)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_normalised_grid_without_deviation(count: int, device: str) -> None:
    events = Events.from_arrays(
        np.arange(count), np.zeros(count, int), np.zeros(count, int), np.ones(count)
    )
    found = host(amiwarp.voxel_grid(put(events, device), WIDTH, HEIGHT, BINS, normalize=True))
    assert np.array_equal(found, np.zeros_like(found))


@pytest.mark.parametrize("limit", [255, 10])
@pytest.mark.parametrize("bins", [1, 7, 10])
def test_stacked_histogram_of_rvt(bins: int, limit: int, device: str) -> None:
    events = some_events()
    found = host(amiwarp.stacked_histogram(put(events, device), WIDTH, HEIGHT, bins, limit=limit))
    assert found.dtype == np.uint8
    expected = rvt_histogram(events, bins, limit, events.t[0], events.t[-1])
    assert np.array_equal(found, expected)
    assert limit == 255 or expected.max() == limit


def test_border_of_two_bins(device: str) -> None:
    """A time at the exact border of two bins belongs to the later one, also where k / n * n rounds to less than k."""
    bins, start = 49, 1 << 40
    t = start + np.arange(bins + 1) * 9
    events = Events.from_arrays(
        np.zeros(bins + 1, int), np.zeros(bins + 1, int), t, np.ones(bins + 1)
    )
    found = host(amiwarp.stacked_histogram(put(events, device), WIDTH, HEIGHT, bins))[bins:, 0, 0]
    assert found.tolist() == [1] * (bins - 1) + [2]
    assert any(k / bins * bins < k for k in range(bins))


def test_surfaces(device: str) -> None:
    events = some_events(300)
    latest = surface(events)
    given = put(events, device)
    assert np.array_equal(host(amiwarp.latest_times(given, WIDTH, HEIGHT)), latest)
    assert np.array_equal(
        host(amiwarp.latest_times(given, WIDTH, HEIGHT, per_polarity=False)), latest.max(axis=0)
    )
    end = events.t[-1]
    found = host(amiwarp.time_surface(given, WIDTH, HEIGHT, 9e3))
    np.testing.assert_allclose(found, decayed(latest, end, 9e3), rtol=0, atol=EXACT)
    found = host(
        amiwarp.time_surface(given, WIDTH, HEIGHT, 9e3, per_polarity=False, t_end=end + 500)
    )
    np.testing.assert_allclose(
        found, decayed(latest.max(axis=0), end + 500, 9e3), rtol=0, atol=EXACT
    )
    found = host(amiwarp.time_surface(given, WIDTH, HEIGHT, 2e4, linear=True))
    expected = np.where(
        latest == NEVER, 0.0, np.maximum(0.0, 1.0 - (end - latest.astype(np.float64)) / 2e4)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)
    assert (expected == 0.0).any()
    # A window that begins and ends at its only event
    alone = host(amiwarp.time_surface(put(events[:1], device), WIDTH, HEIGHT, 1.0))
    assert alone.max() == 1.0


def test_surfaces_are_1_after_the_end_of_the_window(device: str) -> None:
    """The read-out of a sensor delays events beyond the window in which they are delivered."""
    events = put(Events.from_arrays([0, 1, 2], [0, 0, 0], [10, 20, 90], [1, 1, 1]), device)
    cut = amiwarp.Windows(*(np.array([value], np.int64) for value in (0, 3, 0, 20)))
    for linear, first in ((False, np.exp(-1.0)), (True, 0.0)):
        found = amiwarp.time_surface(
            events, 3, 1, 10.0, linear=linear, per_polarity=False, windows=cut
        )
        np.testing.assert_allclose(host(found), [[[first, 1.0, 1.0]]], rtol=0, atol=EXACT)


def test_latest_times_of_dv_processing() -> None:
    dv = pytest.importorskip("dv_processing")
    events = some_events(300)
    store, latest = dv.EventStore(), dv.TimeSurface((WIDTH, HEIGHT))
    for x, y, t, p in zip(
        *(v.tolist() for v in (events.x, events.y, events.t, events.p)), strict=True
    ):
        store.push_back(t, x, y, bool(p))
    latest.accept(store)
    expected = np.array([[latest.at(y, x) for x in range(WIDTH)] for y in range(HEIGHT)])
    found = amiwarp.latest_times(events, WIDTH, HEIGHT, per_polarity=False)
    assert np.array_equal(np.where(found == NEVER, 0, found), expected)


def test_start_and_end_of_the_window(device: str) -> None:
    events = some_events()
    low, high = int(events.t[0]) + 5_000, int(events.t[0]) + 12_345
    inside = events[(events.t >= low) & (events.t <= high)]
    found = host(
        amiwarp.voxel_grid(put(events, device), WIDTH, HEIGHT, BINS, t_start=low, t_end=high)
    )
    np.testing.assert_allclose(
        found, linear_grid(inside, BINS, BINS - 1, low, high), rtol=0, atol=EXACT
    )
    found = host(amiwarp.stacked_histogram(put(events, device), WIDTH, HEIGHT, BINS, t_start=low))
    after = events[events.t >= low]
    assert np.array_equal(found, rvt_histogram(after, BINS, 255, low, events.t[-1]))


EVERY: dict[str, Any] = {
    "event_count": amiwarp.event_count,
    "polarity_histogram": amiwarp.polarity_histogram,
    "voxel_grid": partial(amiwarp.voxel_grid, bins=3),
    "stacked_histogram": partial(amiwarp.stacked_histogram, bins=2),
    "time_surface": partial(amiwarp.time_surface, tau_us=1e4),
    "latest_times": amiwarp.latest_times,
}
"""Every function that makes tensors."""


@pytest.mark.parametrize("name", EVERY)
def test_compensated_events_outside_the_image_are_left_out(name: str, device: str) -> None:
    events = positions(some_events())
    inside = events[(events.x > -1) & (events.x < 10) & (events.y > -1) & (events.y < 8)]
    low, high = int(events.t[0]), int(events.t[-1])
    all_events, only_inside = (
        host(EVERY[name](put(e, device), 10, 8, t_start=low, t_end=high)) for e in (events, inside)
    )
    assert np.array_equal(all_events, only_inside)
    far = Events(
        np.full(3, 1e9, np.float32),
        np.full(3, -np.inf, np.float32),
        np.arange(3),
        np.ones(3, np.uint8),
    )
    assert host(EVERY[name](put(far[:0], device), 4, 4)).max(initial=0) <= 0
    if device == "cpu":
        assert EVERY[name](far, 4, 4).max() <= 0


@pytest.mark.parametrize("count", [3, 300, 20_000])
@pytest.mark.parametrize("name", EVERY)
def test_raw_events_outside_the_image_are_refused(
    name: str, count: int, device: str, every_core: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One event is enough, at any place among the others, for each way in which kernels add events."""
    events = some_events(count)
    for at in (0, count // 2, count - 1):
        for axis, (low, high) in {"x": (WIDTH - 1, WIDTH), "y": (HEIGHT - 1, HEIGHT)}.items():
            for value in (low, high):
                moved = {"x": events.x.copy(), "y": events.y.copy()}
                moved[axis][at] = value
                given = put(Events(moved["x"], moved["y"], events.t, events.p), device)
                if value == low:
                    EVERY[name](given, WIDTH, HEIGHT)
                    continue
                with pytest.raises(
                    AmiwarpError, match=rf"event {at} \(x.* lies outside the {WIDTH}x{HEIGHT} frame"
                ):
                    EVERY[name](given, WIDTH, HEIGHT)
                cut = amiwarp.windows(given, ranges=[(at + 1, count), (0, at)])
                EVERY[name](given, WIDTH, HEIGHT, windows=cut)  # the event is in none of them
    monkeypatch.setattr(window_images, "CAPACITY", 1)  # two sums instead of a word
    with pytest.raises(AmiwarpError, match=f"outside the {WIDTH}x{HEIGHT} frame; "):
        EVERY[name](given, WIDTH, HEIGHT)


@pytest.mark.parametrize("name", EVERY)
def test_a_swapped_size_is_named(name: str, device: str) -> None:
    """Raw events that a model compensates have to fit the sensor, too."""
    x, t = np.arange(WIDTH), np.arange(WIDTH)
    given = put(Events.from_arrays(x, x % HEIGHT, t, x % 2), device)
    message = rf"event {HEIGHT} \(x={HEIGHT}, .*; give width {WIDTH} and height {HEIGHT}, if they are swapped"
    with pytest.raises(AmiwarpError, match=message):
        EVERY[name](given, HEIGHT, WIDTH)
    camera = amiwarp.Camera.from_fov(WIDTH, HEIGHT, 1.0)
    moved = {
        "model": amiwarp.CircleModel(camera, 0.05),
        "encoder": Encoder.constant_speed(900.0, 0, 10**6),
    }
    EVERY[name](given, WIDTH, HEIGHT, **moved)
    with pytest.raises(AmiwarpError, match=message):
        EVERY[name](given, HEIGHT, WIDTH, **moved)


def test_no_events(device: str) -> None:
    none = put(Events.empty(), device)
    assert not host(amiwarp.voxel_grid(none, 4, 3, 2, normalize=True)).any()
    assert not host(amiwarp.stacked_histogram(none, 4, 3, 2)).any()
    assert not host(amiwarp.time_surface(none, 4, 3, 10.0, t_start=0, t_end=10)).any()
    assert host(amiwarp.latest_times(none, 4, 3)).shape == (2, 3, 4)
    assert len(amiwarp.windows(none, duration_us=10)) == len(amiwarp.windows(none, count=3)) == 0
    assert host(amiwarp.event_count(none, 4, 3, windows=amiwarp.windows(none, count=3))).shape == (
        0,
        3,
        4,
    )
    short = put(some_events(9), device)
    no_windows = amiwarp.windows(short, count=10)
    assert host(amiwarp.voxel_grid(short, 4, 3, 2, normalize=True, windows=no_windows)).shape == (
        0,
        2,
        3,
        4,
    )


@pytest.mark.parametrize("burst", [0, 300, 3000])
def test_intervals_in_parts(
    burst: int, device: str, every_core: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full interval is cut into parts; with more events at one time than a part may hold, it cannot be."""
    monkeypatch.setattr(window_images, "CAPACITY", 2000)
    monkeypatch.setattr(window_images, "LEAST_BITS", 20)
    events = some_events()
    t = events.t.copy()
    t[5000 : 5000 + burst] = t[5000]
    events = Events(events.x, events.y, t, events.p)
    there = put(events, device)
    one, (t0, t1) = (
        window_batch.batch_of(there, (WIDTH, HEIGHT), None, None, None, None, None, device),
        (int(t[0]), int(t[-1])),
    )
    parts, fullest = window_images._parts(
        one, window_images.Grid(WIDTH, HEIGHT, steps=BINS - 1, rate=BINS - 1)
    )
    assert (parts > 1) == (fullest < window_images.CAPACITY) == (burst < window_images.CAPACITY)
    found = host(amiwarp.voxel_grid(there, WIDTH, HEIGHT, BINS))
    assert np.abs(found - linear_grid(events, BINS, BINS - 1, t0, t1)).max() < EXACT
    ranges = [(0, 9000), (9000, len(t))]
    cut = amiwarp.windows(events, ranges=ranges)
    each = [linear_grid(events[a:b], BINS, BINS - 1, int(t[a]), int(t[b - 1])) for a, b in ranges]
    assert (
        np.abs(
            host(amiwarp.voxel_grid(there, WIDTH, HEIGHT, BINS, windows=cut)) - np.stack(each)
        ).max()
        < EXACT
    )


def test_a_cell_with_very_many_events(device: str) -> None:
    """More events in one pixel and interval than a packed word holds: nothing overflows."""
    n = window_images.CAPACITY + 1000
    events = Events(
        np.full(n, 2, np.uint16),
        np.full(n, 1, np.uint16),
        np.arange(n, dtype=np.int64),
        np.ones(n, np.uint8),
    )
    found = host(amiwarp.voxel_grid(put(events, device), 4, 3, 2))
    assert found[:, 1, 2].tolist() == [n / 2, n / 2]
    assert found.sum() == n
    packed = host(amiwarp.voxel_grid(put(events[: window_images.CAPACITY - 1], device), 4, 3, 2))
    assert packed[:, 1, 2].tolist() == [(window_images.CAPACITY - 1) / 2] * 2
    # Few enough in each of two intervals
    assert host(amiwarp.voxel_grid(put(events, device), 4, 3, 3)).sum() == n


# Windows and batches.


def all_of(events: Any, cut: amiwarp.Windows) -> list[np.ndarray]:
    """Return every representation of windows."""
    size = {"width": WIDTH, "height": HEIGHT, "windows": cut}
    return [
        host(amiwarp.event_count(events, **size)),
        host(amiwarp.polarity_histogram(events, **size)),
        host(amiwarp.voxel_grid(events, bins=BINS, normalize=True, **size)),
        host(amiwarp.stacked_histogram(events, bins=BINS, **size)),
        host(amiwarp.time_surface(events, tau_us=5e3, **size)),
        host(amiwarp.latest_times(events, **size)),
    ]


def one_by_one(events: Events, cut: amiwarp.Windows) -> list[np.ndarray]:
    """Return every representation of windows, computed for each by itself."""
    parts = [all_of(events, cut[k : k + 1]) for k in range(len(cut))]
    return [np.concatenate(found) for found in zip(*parts, strict=True)]


CUTS: dict[str, Callable[[Any], amiwarp.Windows]] = {
    "duration": lambda events: amiwarp.windows(events, duration_us=3_000),
    "count": lambda events: amiwarp.windows(events, count=1_234, incomplete=True),
    "ranges": lambda events: amiwarp.windows(
        events, ranges=[(0, 900), (500, 700), (700, 700), (19_000, 20_000)]
    ),
}


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("between", [False, True])
def test_many_windows_are_those_one_by_one(
    cut: str, between: bool, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = positions(some_events()) if between else some_events()
    given = put(events, device)
    found = CUTS[cut](given)
    for name in ("start", "stop", "t_start", "t_end"):
        assert np.array_equal(getattr(found, name), getattr(CUTS[cut](events), name)), name
    expected = one_by_one(events, found)
    for one, other in zip(all_of(given, found), expected, strict=True):
        assert np.array_equal(one, other)
    # a launch for each window
    monkeypatch.setattr(window_images, "MOST_BYTES", {"cpu": 1, "cuda": 1})
    for one, other in zip(all_of(given, found), expected, strict=True):
        assert np.array_equal(one, other)


def in_both_ways(make: Callable[[], list[np.ndarray]]) -> None:
    """Compute tensors by threads that take blocks of events, and by threads that take whole windows: the same bits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(whole_windows, "cpu_threads", lambda: 1 << 30)
        patch.setattr(whole_windows, "FEW_EVENTS", 0)
        of_blocks = make()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(whole_windows, "PIXELS_OF_EVENT", 0)
        patch.setattr(whole_windows, "LEAST_WORK", 1)
        of_windows = [make(), make()]  # the second time in the memory of the first
    for again in of_windows:
        assert all(np.array_equal(a, b) for a, b in zip(of_blocks, again, strict=True))


@pytest.mark.parametrize("between", [False, True])
@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 1000])
def test_few_events_have_the_bits_of_many(count: int, between: bool, every_core: None) -> None:
    """The direct way of small calls, for one window, and for the same arrays on a device."""
    events = positions(some_events())[9:] if between else some_events()
    few = events[:count]
    on_device = DeviceEvents.from_arrays(few.x, few.y, few.t, few.p)
    given = {"t_start": int(events.t[0]) + 20, "t_end": int(events.t[0]) + 2_000}
    for options in ({}, given) if count else ({},):
        for function in EVERY.values():
            in_both_ways(lambda f=function, o=options: [f(few, WIDTH, HEIGHT, **o)])
            found = function(few, WIDTH, HEIGHT, **options)
            there = function(on_device, WIDTH, HEIGHT, **options)
            assert isinstance(found, np.ndarray)
            assert isinstance(there, wp.array)
            assert np.array_equal(found, there.numpy())


def test_recorded_launches_take_other_arrays() -> None:
    """A recorded launch takes images and events of other sizes, from several threads, and keeps none alive."""
    events = some_events()
    sizes = [(WIDTH, HEIGHT, 900), (WIDTH + 7, HEIGHT, 30), (WIDTH, HEIGHT + 9, 2000)] * 20

    def counts(size: tuple[int, int, int]) -> bool:
        width, height, count = size
        found = amiwarp.event_count(events[:count], width, height)
        expected = np.zeros((height, width), np.int32)
        np.add.at(expected, (events.y[:count], events.x[:count]), 1)
        return np.array_equal(found, expected)

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(counts, sizes))
    columns = [values[:50].copy() for values in (events.x, events.y, events.t, events.p)]
    freed = [weakref.ref(values) for values in columns]
    grid = amiwarp.voxel_grid(Events(*columns), WIDTH, HEIGHT, 3)
    freed.append(weakref.ref(grid))
    del columns, grid
    gc.collect()
    assert all(reference() is None for reference in freed)


@pytest.mark.parametrize("between", [False, True])
@pytest.mark.parametrize("cut", CUTS)
def test_threads_that_take_whole_windows(cut: str, between: bool, every_core: None) -> None:
    events = positions(some_events()) if between else some_events()
    found = CUTS[cut](events)
    in_both_ways(lambda: all_of(events, found))
    third = (found.t_end - found.t_start) // 3
    late = amiwarp.Windows(found.start, found.stop, found.t_start + third, found.t_end - third)
    in_both_ways(lambda: all_of(events, late))
    for bins in (1, 2, 70):
        for end_bin in (False, True):
            grid = partial(amiwarp.voxel_grid, events, WIDTH, HEIGHT, bins, end_bin=end_bin)
            in_both_ways(lambda grid=grid: [grid(windows=found)])


def test_whole_windows_after_a_fault() -> None:
    """Memory that the next call uses again is as clean as before, also if a call raises an error."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(whole_windows, "PIXELS_OF_EVENT", 0)
        expected = all_of(some_events(), amiwarp.windows(some_events(), count=900))
        for at in (70, 19_000):
            events = some_events()
            events.x[at] = WIDTH
            cut = amiwarp.windows(events, count=900)
            for name in EVERY:
                with pytest.raises(AmiwarpError, match=f"event {at} .* outside"):
                    EVERY[name](events, WIDTH, HEIGHT, windows=cut)
        again = all_of(some_events(), amiwarp.windows(some_events(), count=900))
    assert all(np.array_equal(a, b) for a, b in zip(expected, again, strict=True))


def test_windows_of_equal_duration(device: str) -> None:
    events = put(Events.from_arrays([0] * 5, [0] * 5, [100, 109, 110, 145, 149], [1] * 5), device)
    found = amiwarp.windows(events, duration_us=10)
    assert found.t_start.tolist() == [100, 110, 120, 130]
    assert found.t_end.tolist() == [110, 120, 130, 140]
    assert (found.stop - found.start).tolist() == [2, 1, 0, 0]
    found = amiwarp.windows(events, duration_us=10, incomplete=True)
    assert (found.stop - found.start).tolist() == [2, 1, 0, 0, 2]
    assert found.t_end[-1] == 150
    events = put(Events.from_arrays([0] * 3, [0] * 3, [100, 110, 120], [1] * 3), device)
    assert (lambda w: w.stop - w.start)(
        amiwarp.windows(events, duration_us=10, incomplete=True)
    ).tolist() == [1, 1, 1]


def test_windows_between_given_times(device: str) -> None:
    """Their number does not depend on the events, also if there are none."""
    t = np.array([7, 12, 25, 30, 31])
    events = put(Events.from_arrays(t * 0, t * 0, t, t * 0), device)
    for some in (events, put(Events.empty(), device)):
        found = amiwarp.windows(some, duration_us=10, t_start=0, t_end=35)
        assert (found.t_start.tolist(), found.t_end.tolist()) == ([0, 10, 20], [10, 20, 30])
        assert found.stop.tolist() == ([1, 2, 3] if len(some) else [0, 0, 0])
    rest = amiwarp.windows(events, duration_us=10, t_start=0, t_end=31, incomplete=True)
    # The event at 31 us is not before the end
    assert (rest.start[-1], rest.stop[-1], rest.t_end[-1]) == (
        3,
        4,
        40,
    )
    assert len(amiwarp.windows(events, duration_us=10, t_start=0, t_end=30, incomplete=True)) == 3
    assert len(amiwarp.windows(events, duration_us=10, t_start=50)) == 0
    assert amiwarp.windows(events, duration_us=10, t_start=10).start.tolist() == [1, 2]
    with pytest.raises(AmiwarpError, match=r"\d+ windows of 1 us are too many; give longer ones"):
        amiwarp.windows(events, duration_us=1, t_end=1 << 40)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"count": 5, "turns": 0.5}, "turns is given without encoder"),
        ({"count": 5, "t_start": 0}, "t_start is given without duration_us"),
        (
            {"ranges": [(0, 5)], "incomplete": True},
            "incomplete is given for windows at given ranges",
        ),
        (
            {"duration_us": 10.0},
            "duration_us = 10.0 is not a whole number, but a float; give an int",
        ),
    ],
)
def test_arguments_of_another_kind_of_windows_are_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(AmiwarpError, match=re.escape(said)):
        amiwarp.windows(some_events(100), **given)


def test_events_that_are_not_in_order_are_named(device: str) -> None:
    """Events joined in reversed order, and those of a batch, without its windows."""
    events = some_events(100)
    join = amiwarp.Events.concatenate if device == "cpu" else DeviceEvents.concatenate
    for parts, at in (([events[50:], events[:50]], 50), ([events, events], 100)):
        given = join([put(part, device) for part in parts])
        said = rf"event {at} .* sort by time, or give the windows of amiwarp\.collate"
        for function in (
            partial(amiwarp.windows, duration_us=10),
            partial(amiwarp.event_count, width=9, height=9),
        ):
            with pytest.raises(AmiwarpError, match=said):
                function(given)


def test_times_are_carried_only_to_later_windows_of_one_recording() -> None:
    events = some_events(100)
    for function in (amiwarp.latest_times, partial(amiwarp.time_surface, tau_us=5.0)):
        with pytest.raises(AmiwarpError, match="carry is given for 2 recordings"):
            function([events, events], WIDTH, HEIGHT, carry=True)
        cut = amiwarp.windows(events, count=10)[::-1]
        with pytest.raises(AmiwarpError, match="not in order of time; sort them"):
            function(events, WIDTH, HEIGHT, carry=True, windows=cut)
        # The first one ends later than the second
        longer = amiwarp.windows(events, ranges=[(0, 20), (5, 10)])
        with pytest.raises(AmiwarpError, match="not in order of time; sort them"):
            function(events, WIDTH, HEIGHT, carry=True, windows=longer)


def test_windows_of_equal_count() -> None:
    events = some_events(10)
    found = amiwarp.windows(events, count=4)
    assert (found.start.tolist(), found.stop.tolist()) == ([0, 4], [4, 8])
    assert found.t_start.tolist() == events.t[[0, 4]].tolist()
    assert found.t_end.tolist() == events.t[[3, 7]].tolist()
    assert amiwarp.windows(events, count=4, incomplete=True).stop.tolist() == [4, 8, 10]
    assert amiwarp.windows(events, count=5, incomplete=True).stop.tolist() == [5, 10]


@pytest.mark.parametrize("rpm", [1200.0, -1200.0])
@pytest.mark.parametrize("offset", [0.0, 321.5])
def test_windows_of_turns(rpm: float, offset: float, device: str) -> None:
    """At 1200 turns a minute, a quarter turn lasts 12.5 ms."""
    events = some_events(5_000, span=40_000)
    encoder = Encoder.constant_speed(rpm, 6_900_000, 7_200_000).with_clock_offset(offset)
    found = amiwarp.windows(put(events, device), encoder=encoder, turns=0.25)
    np.testing.assert_allclose(found.t_start - events.t[0], [0, 12_500, 25_000], rtol=0, atol=1)
    assert np.array_equal(found.stop, np.searchsorted(events.t, found.t_end))
    assert len(amiwarp.windows(events, encoder=encoder, turns=0.25, incomplete=True)) == 4
    assert amiwarp.windows(events, encoder=encoder, turns=0.25, incomplete=True).stop[-1] == len(
        events
    )
    assert len(amiwarp.windows(events, encoder=encoder)) == 0


def test_windows_of_turns_at_varying_speed() -> None:
    events = some_events(5_000, span=40_000)
    t = np.arange(6_990_000, 7_060_000, 500)
    angle = 2e-8 * (t - 6_990_000.0) ** 2
    encoder = Encoder.from_angles(t, angle)
    found = amiwarp.windows(events, encoder=encoder, turns=0.5)
    turned = np.diff(encoder.angle_at(np.append(found.t_start, found.t_end[-1])))
    assert len(found) == int(
        abs(encoder.angle_at(events.t[-1]) - encoder.angle_at(events.t[0])) / np.pi
    )
    np.testing.assert_allclose(turned, np.pi, rtol=0, atol=4e-3)  # a whole microsecond


@pytest.mark.parametrize("offset", [30_000.0, -20_000.25])
def test_windows_of_turns_between_few_samples_with_a_clock_offset(offset: float) -> None:
    """The speed changes at each sample, whose time is on the encoder's clock."""
    encoder = Encoder.from_angles(
        [0, 90_000, 210_000, 400_000], [0.0, 11.0, 15.0, 40.0]
    ).with_clock_offset(offset)
    t = np.arange(25_000, 350_000, 1000)
    events = Events.from_arrays(t * 0, t * 0, t, t * 0)
    cut = amiwarp.windows(events, encoder=encoder, turns=0.5)
    turned = (
        encoder.angle_at(np.append(cut.t_start, cut.t_end[-1])) - encoder.angle_at([25_000])
    ) / np.pi
    assert len(cut) > 8
    # Half turns; times are whole
    np.testing.assert_allclose(turned, np.arange(len(cut) + 1), rtol=0, atol=1e-4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_windows_of_turns_to_and_fro(sign: float) -> None:
    """A window ends a quarter turn from its start on either side; less to and fro does not count."""
    events = Events.from_arrays([0] * 2, [0] * 2, [0, 100], [1] * 2)
    turned = np.array([-0.5, 0.0, 0.9, -0.1, 2.9, 1.9, -1.1, -1.2])
    encoder = Encoder(np.array([-10, 0, 20, 30, 60, 70, 100, 110]), sign * np.pi / 2 * turned)
    found = amiwarp.windows(events, encoder=encoder, turns=0.25)
    assert found.t_start.tolist() == [0, 41, 51, 79, 89]
    assert found.t_end.tolist() == [41, 51, 79, 89, 99]


def test_the_only_window_of_turns_is_incomplete() -> None:
    encoder = Encoder.constant_speed(1200.0, 0, 100)
    for t in ([5], [5, 5]):
        events = Events.from_arrays([1] * len(t), [0] * len(t), t, [1] * len(t))
        found = amiwarp.windows(events, encoder=encoder, incomplete=True)
        assert (found.start.tolist(), found.stop.tolist()) == ([0], [len(t)])
        assert (found.t_start.tolist(), found.t_end.tolist()) == ([5], [5])


def test_time_surface_of_tonic(device: str) -> None:
    """Tonic keeps the times of earlier windows, and lets them decay until the end of each window."""
    events = some_events(400)
    cut = amiwarp.windows(put(events, device), duration_us=5_000)
    expected = [
        decayed(surface(events[: cut.stop[k]]), int(cut.t_end[k]), 7e3) for k in range(len(cut))
    ]
    found = host(
        amiwarp.time_surface(put(events, device), WIDTH, HEIGHT, 7e3, windows=cut, carry=True)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)
    alone = host(amiwarp.time_surface(put(events, device), WIDTH, HEIGHT, 7e3, windows=cut))
    assert (alone <= found).all()
    assert (alone < found).any()


def test_times_are_carried_through_a_window_without_events(device: str) -> None:
    events = put(Events.from_arrays([0, 1, 0, 1], [0] * 4, [100, 110, 160, 170], [1] * 4), device)
    cut = amiwarp.windows(events, ranges=[(0, 0), (0, 2), (2, 2), (2, 4), (4, 4)])
    assert cut.t_start.tolist() == [100, 100, 110, 160, 170]
    assert cut.t_end.tolist() == [100, 110, 110, 170, 170]
    found = amiwarp.time_surface(
        events, 2, 1, 20.0, linear=True, per_polarity=False, windows=cut, carry=True
    )
    expected = [[0.0, 0.0], [0.5, 1.0], [0.5, 1.0], [0.5, 1.0], [0.5, 1.0]]
    np.testing.assert_allclose(host(found)[:, 0], expected, rtol=0, atol=EXACT)


def test_carried_times_in_several_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    events = some_events(400)
    cut = amiwarp.windows(events, count=50)
    whole = amiwarp.latest_times(events, WIDTH, HEIGHT, windows=cut, carry=True)
    monkeypatch.setattr(window_images, "MOST_BYTES", {"cpu": 3 * 2 * WIDTH * HEIGHT * 8, "cuda": 1})
    assert np.array_equal(
        amiwarp.latest_times(events, WIDTH, HEIGHT, windows=cut, carry=True), whole
    )
    assert np.array_equal(whole[-1], surface(events))


def test_batch_of_recordings(device: str) -> None:
    blocks = [some_events(n, seed=n, start=10**n % 977) for n in (0, 1, 700, 65, 64)]
    joined, cut = amiwarp.collate(blocks, device=None if device == "cpu" else device)
    assert isinstance(joined, Events if device == "cpu" else DeviceEvents)
    for one, other in zip(
        all_of(joined, cut), one_by_one(amiwarp.collate(blocks)[0], cut), strict=True
    ):
        assert np.array_equal(one, other)
    expected = np.stack([amiwarp.voxel_grid(block, WIDTH, HEIGHT, BINS) for block in blocks])
    found = amiwarp.voxel_grid([put(block, device) for block in blocks], WIDTH, HEIGHT, BINS)
    assert isinstance(found, np.ndarray if device == "cpu" else wp.array)
    assert np.array_equal(host(found), expected)
    assert np.array_equal(amiwarp.voxel_grid(blocks, WIDTH, HEIGHT, BINS, device=device), expected)


def test_batch_of_raw_and_compensated_events(device: str) -> None:
    raw, moved = some_events(300), positions(some_events(400))
    expected = [amiwarp.voxel_grid(block, WIDTH, HEIGHT, BINS) for block in (raw, moved)]
    blocks = [
        DeviceEvents.from_arrays(*(getattr(e, n) for n in "xytp"), device=device)
        for e in (raw, moved)
    ]
    for batch in ([raw, moved], blocks):
        np.testing.assert_allclose(
            host(amiwarp.voxel_grid(batch, WIDTH, HEIGHT, BINS)), expected, rtol=0, atol=EXACT
        )


# Compensated events.


def behind_a_prism() -> tuple[Events, amiwarp.ExactModel, Encoder]:
    events = some_events(3_000)
    camera = Camera.from_fov(WIDTH, HEIGHT, 1.0)
    model = amiwarp.ExactModel(camera, amiwarp.Prism(0.05), 0.3)
    return events, model, Encoder.constant_speed(900.0, 6_900_000, 7_200_000)


def test_compensated_events(device: str) -> None:
    """The same bits as for the positions that compensate_events returns, which other tests compare with an oracle."""
    events, model, encoder = behind_a_prism()
    x, y = amiwarp.compensate_events(events, model, encoder).T
    moved = Events(x.copy(), y.copy(), events.t, events.p)
    optic = {"model": model, "encoder": encoder}
    given = put(events, device)
    expected = linear_grid(moved, BINS, BINS - 1, events.t[0], events.t[-1])
    found = host(amiwarp.voxel_grid(given, WIDTH, HEIGHT, BINS, **optic))
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)
    counts = np.zeros((2, HEIGHT, WIDTH))
    for row, column, weight in weights(moved):
        np.add.at(counts, (events.p.astype(int), row, column), weight)
    found = host(amiwarp.polarity_histogram(given, WIDTH, HEIGHT, **optic))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, counts, rtol=0, atol=EXACT)
    found = host(amiwarp.event_count(given, WIDTH, HEIGHT, **optic))
    np.testing.assert_allclose(found, counts.sum(axis=0), rtol=0, atol=EXACT)
    assert np.abs(moved.x - events.x).max() > 0.3  # they do move
    nearest = [np.floor(v.astype(np.float64) + 0.5).astype(int) for v in (x, y)]
    inside = (nearest[0] >= 0) & (nearest[0] < WIDTH) & (nearest[1] >= 0) & (nearest[1] < HEIGHT)
    rounded = Events.from_arrays(
        nearest[0][inside], nearest[1][inside], events.t[inside], events.p[inside]
    )
    span = {"t_start": int(events.t[0]), "t_end": int(events.t[-1])}
    found = host(amiwarp.stacked_histogram(given, WIDTH, HEIGHT, BINS, **optic))
    assert np.array_equal(found, rvt_histogram(rounded, BINS, 255, *span.values()))
    assert np.array_equal(
        host(amiwarp.latest_times(given, WIDTH, HEIGHT, **optic)), surface(rounded)
    )


def test_compensated_windows(device: str) -> None:
    events, model, encoder = behind_a_prism()
    cut = amiwarp.windows(events, count=700)
    found = host(
        amiwarp.voxel_grid(
            put(events, device), WIDTH, HEIGHT, BINS, windows=cut, model=model, encoder=encoder
        )
    )
    for k in range(len(cut)):
        one = amiwarp.voxel_grid(
            events[cut.start[k] : cut.stop[k]], WIDTH, HEIGHT, BINS, model=model, encoder=encoder
        )
        np.testing.assert_allclose(found[k], one, rtol=0, atol=EXACT)


# Determinism.


@pytest.mark.parametrize("between", [False, True])
def test_any_number_of_threads_gives_the_same_bits(between: bool, every_core: None) -> None:
    events = some_events(200_000)
    events = positions(events) if between else events
    cut = amiwarp.windows(events, duration_us=9_000, incomplete=True)
    found = []
    for threads in (1, 2, 3, 7):
        with limited_cpu_threads(threads), pytest.MonkeyPatch.context() as patch:
            patch.setattr(window_images, "cpu_threads", lambda n=threads: n)
            patch.setattr(window_images, "SMALLEST", 16)
            patch.setattr(tensors, "SMALLEST", 16)
            one = amiwarp.Windows(
                *(np.array([v], np.int64) for v in (0, len(events), events.t[0], events.t[-1]))
            )
            found.append([*all_of(events, cut), *all_of(events, one)])
    for other in found[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_devices_agree_to_the_last_bit(device: str) -> None:
    events = positions(some_events())
    cut = amiwarp.windows(events, count=3_000)
    here, there = all_of(events, cut), all_of(put(events, device), cut)
    exponential = 4  # its exponential function differs by device
    for k, (one, other) in enumerate(zip(here, there, strict=True)):
        if k == exponential:
            np.testing.assert_allclose(one, other, rtol=0, atol=EXACT)
        else:
            assert np.array_equal(one, other)


def test_events_are_not_changed() -> None:
    events = some_events()
    before = [column.copy() for column in (events.x, events.y, events.t, events.p)]
    all_of(events, amiwarp.windows(events, count=500))
    for column, old in zip((events.x, events.y, events.t, events.p), before, strict=True):
        assert np.array_equal(column, old)


# Transforms.


def structured(events: Events, names: str) -> np.ndarray:
    kinds = {"t": "i8", "x": "u2", "y": "u2", "p": "i2"}
    found = np.zeros(len(events), [(name, kinds[name]) for name in names])
    for name in names:
        found[name] = getattr(events, name)
    return found


@pytest.mark.parametrize("names", ["txyp", "xytp", "tpyx"])
def test_transform_of_structured_arrays(names: str) -> None:
    events = some_events()
    array = structured(events, names)
    array["p"] = np.where(array["p"] > 0, 1, -1)
    transform = pickle.loads(
        pickle.dumps(amiwarp.ToTensor(amiwarp.voxel_grid, width=WIDTH, height=HEIGHT, bins=BINS))
    )
    assert np.array_equal(transform(array), amiwarp.voxel_grid(events, WIDTH, HEIGHT, BINS))
    assert np.array_equal(transform(events), transform(array))
    with pytest.raises(AmiwarpError, match="field p is missing"):
        transform(array[["t", "x", "y"]])


def test_an_option_of_a_call_replaces_that_of_the_transform() -> None:
    events = some_events(200)
    transform = amiwarp.ToTensor(amiwarp.voxel_grid, width=WIDTH, height=HEIGHT, bins=BINS)
    assert np.array_equal(transform(events, bins=3), amiwarp.voxel_grid(events, WIDTH, HEIGHT, 3))
    assert transform(events).shape == (BINS, HEIGHT, WIDTH)


def test_transform_of_a_function_without_a_size(tmp_path: Path) -> None:
    events = some_events(200)
    recording = amiwarp.Recording(amiwarp.MemoryEvents(events, WIDTH, HEIGHT))
    columns = amiwarp.ToTensor(lambda events: events.x)
    assert np.array_equal(columns(recording), events.x)
    with pytest.raises(amiwarp.AmiwarpError, match="takes no events"):
        amiwarp.ToTensor(lambda: 0)


def test_transform_on_a_device(device: str) -> None:
    events = some_events()
    cut = partial(amiwarp.windows, count=4_000)
    transform = amiwarp.ToTensor(amiwarp.event_count, width=WIDTH, height=HEIGHT, windows=cut)
    found = transform(put(events, device))
    assert isinstance(found, np.ndarray if device == "cpu" else wp.array)
    assert host(found).sum(axis=(1, 2)).tolist() == [4_000] * 5
    assert repr(amiwarp.ToTensor(amiwarp.voxel_grid, bins=5)) == "ToTensor(voxel_grid, bins=5)"


def test_transform_in_a_data_set(tmp_path: Path) -> None:
    import json

    items = []
    for number in range(3):
        recording = Recording(amiwarp.MemoryEvents(some_events(50, seed=number), WIDTH, HEIGHT))
        amiwarp.save_recording(tmp_path / f"{number}.h5", recording)
        items.append(
            {"file": f"{number}.h5", "split": "train", "labels": {"class": number}, "events": 50}
        )
    manifest = {"format": "amiwarp-dataset", "version": 1, "items": items}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    dataset = amiwarp.RecordedDataset(
        tmp_path, transform=amiwarp.ToTensor(amiwarp.voxel_grid, bins=BINS)
    )
    for number in range(3):
        grid, labels = dataset[number]
        assert labels == {"class": number}
        expected = amiwarp.voxel_grid(some_events(50, seed=number), WIDTH, HEIGHT, BINS)
        assert np.array_equal(grid, expected)


def test_transform_takes_the_encoder_of_each_recording() -> None:
    events, model, _ = behind_a_prism()
    transform = amiwarp.ToTensor(amiwarp.voxel_grid, bins=3, model=model)
    for rpm in (720.0, 1440.0):
        encoder = Encoder.constant_speed(rpm, 6_900_000, 7_200_000)
        recording = Recording(amiwarp.MemoryEvents(events, WIDTH, HEIGHT), None, encoder)
        expected = amiwarp.voxel_grid(events, WIDTH, HEIGHT, 3, model=model, encoder=encoder)
        assert np.array_equal(transform(recording), expected)


def test_transform_names_what_is_missing_or_unknown() -> None:
    events = some_events(50)
    for options, said in (
        ({"bins": 3}, "no width and no height"),
        ({"width": 9, "height": 9}, "no bins"),
    ):
        with pytest.raises(
            AmiwarpError, match=f"ToTensor has {said}; give the options by name, or a recording"
        ):
            amiwarp.ToTensor(amiwarp.voxel_grid, **options)(events)
    with pytest.raises(AmiwarpError, match=r"option nbins is unknown; did you mean bins\?"):
        amiwarp.ToTensor(amiwarp.voxel_grid, width=9, height=9, bins=3)(events, nbins=4)
    assert amiwarp.ToTensor(lambda events, **options: options, own=1)(events) == {"own": 1}


def test_other_kinds_of_events_are_refused_with_the_remedy() -> None:
    events = some_events(50)
    recording = Recording(amiwarp.MemoryEvents(events, WIDTH, HEIGHT))
    for given, remedy in (
        (structured(events, "txyp"), "Events.from_structured"),
        (recording, "recording.events[:]"),
    ):
        with pytest.raises(AmiwarpError, match=re.escape(remedy)):
            amiwarp.event_count(given, WIDTH, HEIGHT)
    wrong: Any = events
    with pytest.raises(AmiwarpError, match=r"wrap them as amiwarp\.MemoryEvents"):
        Recording(wrong)


# Refusals.


@pytest.mark.parametrize("at", [200, 192])
def test_falling_times_are_refused(at: int, device: str) -> None:
    """Also at the beginning of a block of 64 events, which kernels take together."""
    t = np.arange(300)
    t[at] = 5
    events = Events(np.zeros(300, np.uint16), np.zeros(300, np.uint16), t, np.ones(300, np.uint8))
    given = DeviceEvents(
        *(wp.array(v, device=device) for v in (events.x, events.y, events.t, events.p))
    )
    for function in (
        amiwarp.event_count,
        amiwarp.latest_times,
        partial(amiwarp.voxel_grid, bins=3),
    ):
        for one in (events, given):
            with pytest.raises(
                AmiwarpError, match=rf"event {at} .* is earlier than the one before"
            ):
                function(one, 4, 3)
    cut = amiwarp.Windows(
        *(np.array(v, np.int64) for v in ([0, at], [at, 300], [0, 5], [at - 1, 299]))
    )
    assert host(amiwarp.event_count(given, 4, 3, windows=cut))[:, 0, 0].tolist() == [at, 300 - at]


def test_refusals() -> None:
    events = some_events(100)
    cut = amiwarp.windows(events, count=10)
    _, model, encoder = behind_a_prism()
    for match, call in (
        ("give one of duration_us", lambda: amiwarp.windows(events)),
        ("give one of duration_us", lambda: amiwarp.windows(events, count=3, duration_us=3)),
        ("with indices in 0 .. 100", lambda: amiwarp.windows(events, ranges=[(0, 101)])),
        ("expected .n, 2.", lambda: amiwarp.windows(events, ranges=[1, 2])),
        ("expected 0 <= start <= stop", lambda: amiwarp.windows(events, ranges=[(5, 2)])),
        (
            "lie outside the encoder",
            lambda: amiwarp.windows(events, encoder=Encoder.constant_speed(9.0, 0, 9)),
        ),
        (
            "windows reach to event 100 of 50",
            lambda: amiwarp.event_count(events[:50], 9, 9, windows=cut),
        ),
        ("windows have times", lambda: amiwarp.event_count(events, 9, 9, windows=cut, t_start=0)),
        ("join them by amiwarp.collate", lambda: amiwarp.event_count([events], 9, 9, windows=cut)),
        ("at least one block", lambda: amiwarp.collate([])),
        ("before t_start", lambda: amiwarp.event_count(events, 9, 9, t_start=5, t_end=4)),
        ("both a model and an encoder", lambda: amiwarp.event_count(events, 9, 9, model=model)),
        (
            "already compensated",
            lambda: amiwarp.event_count(positions(events), 9, 9, model=model, encoder=encoder),
        ),
        ("bins = 0", lambda: amiwarp.voxel_grid(events, 9, 9, 0)),
        ("limit = 256", lambda: amiwarp.stacked_histogram(events, 9, 9, 2, limit=256)),
        ("tau_us = 0", lambda: amiwarp.time_surface(events, 9, 9, 0.0)),
        ("width = 0", lambda: amiwarp.event_count(events, 0, 9)),
        ("windows are indexed by 2; give a slice", lambda: cut[2]),
        ("windows are indexed by 0; give a slice", lambda: list(cut)),
        ("expected int64", lambda: amiwarp.Windows(*np.zeros((4, 2)))),
        ("a window lasts", lambda: amiwarp.voxel_grid(events, 9, 9, 5, t_start=0, t_end=1 << 60)),
        ("give fewer bins", lambda: amiwarp.voxel_grid(events, 9_999, 9_999, 999)),
    ):
        with pytest.raises(AmiwarpError, match=match):
            call()


def test_windows_that_are_longer_than_an_integer_have_the_longest_length() -> None:
    low, high = -(2**63), 2**63 - 1
    one = amiwarp.Windows(*(np.array([value], np.int64) for value in (0, 1, low, 500)))
    two = amiwarp.Windows(
        *(np.array(values, np.int64) for values in ([0, 1], [1, 2], [low, 7], [500, 7]))
    )
    for cut in (one, two):
        rows, _ = window_batch.table_of_windows(cut)
        assert rows[0].tolist() == [0, 1, 0, low, high, 500]
    assert rows[1].tolist() == [1, 2, 1, 7, 1, 7]
