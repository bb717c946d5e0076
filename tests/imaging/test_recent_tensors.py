"""Volumes of recent events, mixed-density stacks and event spike tensors equal their papers' formulas in NumPy.

The oracles go through the events one by one in float64.
"""

import math
from collections import deque
from functools import partial
from typing import Any

import numpy as np
import pytest
import warp as wp

import amiwarp
from amiwarp import AmiwarpError, DeviceEvents, Events
from amiwarp.tasks import limited_cpu_threads

WIDTH, HEIGHT = 11, 7
EXACT = 1e-5
"""Largest error of a floating element."""


def some_events(n: int = 2_000, seed: int = 0, span: int = 60_000) -> Events:
    """Return random events, a tenth of them at one pixel, some at the same time."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    hot = rng.random(n) < 0.1
    x[hot], y[hot] = 3, 4
    t = np.sort(rng.integers(0, span // 7, n) * 7)
    return Events.from_arrays(x, y, 5_000_000 + t, rng.integers(0, 2, n))


def put(events: Events, device: str) -> Events | DeviceEvents:
    """Return events on a GPU as DeviceEvents, on the CPU as they are."""
    if device == "cpu":
        return events
    return DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device)


def host(found: Any) -> np.ndarray:
    return found.numpy() if isinstance(found, wp.array) else found


def rows_of(events: Events) -> list[tuple[int, int, int, int]]:
    """Return x, y, t and p of each event at the nearest pixel, if there is one."""
    x, y = (np.floor(v.astype(np.float64) + 0.5) for v in (events.x, events.y))
    inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    columns = (x[inside], y[inside], events.t[inside], events.p[inside])
    return list(zip(*(values.astype(int).tolist() for values in columns), strict=True))


def tore(events: Events, depth: int, shortest: float, longest: float, t_end: int) -> np.ndarray:
    """Return the TORE volume of Baldwin et al.: a queue of the latest times of each pixel and polarity."""
    queues = {
        place: deque([-math.inf] * depth, maxlen=depth) for place in np.ndindex(2, HEIGHT, WIDTH)
    }
    for x, y, t, p in rows_of(events):
        queues[p, y, x].appendleft(t)
    volume = np.zeros((2, depth, HEIGHT, WIDTH))
    for (p, y, x), queue in queues.items():
        ages = np.clip(t_end - np.array(queue), shortest, longest)
        volume[p, :, y, x] = np.log(ages + 1.0) - math.log(shortest + 1.0)
    return volume.reshape(-1, HEIGHT, WIDTH)


def density_stack(events: Events, stacks: int) -> np.ndarray:
    """Return the mixed-density stack of Nam et al.: the events are halved again and again, the later ones stay."""
    found = np.zeros((stacks, HEIGHT, WIDTH), int)
    rows = [(x, y, 2 * p - 1) for x, y, _, p in rows_of(events)]
    half = len(rows)
    for k in range(stacks):
        for x, y, sign in rows:
            found[k, y, x] = sign
        half //= 2
        rows = rows[half:]
    return found


def spikes(events: Events, bins: int, t0: int, t1: int) -> np.ndarray:
    """Return the event spike tensor of Gehrig et al., equation 7, with the trilinear kernel and the time as measure."""
    found = np.zeros((2, bins, HEIGHT, WIDTH))
    for x, y, t, p in rows_of(events):
        s = min(max((t - t0) / max(t1 - t0, 1), 0.0), 1.0)
        for b in range(bins):
            found[p, b, y, x] += s * max(0.0, 1.0 - abs((bins - 1) * s - b))
    return found.reshape(-1, HEIGHT, WIDTH)


@pytest.mark.parametrize("depth", [1, 3, 40])
def test_tore_volume(depth: int, device: str) -> None:
    events = some_events()
    end = int(events.t[-1])
    found = host(amiwarp.tore_volume(put(events, device), WIDTH, HEIGHT, depth))
    assert found.dtype == np.float32
    expected = tore(events, depth, 150.0, 5e6, end)
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)
    lacking = np.isclose(expected, math.log(5_000_001 / 151)).any()
    assert lacking == (depth == 40)
    limits = {"shortest_us": 2_000.0, "longest_us": 20_000.0, "t_end": end + 300}
    found = host(amiwarp.tore_volume(put(events, device), WIDTH, HEIGHT, depth, **limits))
    expected = tore(events, depth, 2_000.0, 20_000.0, end + 300)
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 100, 2_000])
def test_mixed_density_stack(count: int, device: str) -> None:
    events = some_events(count) if count else Events.empty()
    found = host(amiwarp.mixed_density_stack(put(events, device), WIDTH, HEIGHT, 7))
    assert found.dtype == np.int8
    assert np.array_equal(found, density_stack(events, 7))


@pytest.mark.parametrize("bins", [1, 2, 6])
def test_event_spike_tensor(bins: int, device: str) -> None:
    events = some_events()
    t0, t1 = int(events.t[0]), int(events.t[-1])
    found = host(amiwarp.event_spike_tensor(put(events, device), WIDTH, HEIGHT, bins))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, spikes(events, bins, t0, t1), rtol=0, atol=EXACT)


EVERY: dict[str, Any] = {
    "tore": (partial(amiwarp.tore_volume, depth=3), lambda e, t0, t1: tore(e, 3, 150.0, 5e6, t1)),
    "density": (
        partial(amiwarp.mixed_density_stack, stacks=4),
        lambda e, t0, t1: density_stack(e, 4),
    ),
    "spikes": (
        partial(amiwarp.event_spike_tensor, bins=5),
        lambda e, t0, t1: spikes(e, 5, t0, t1),
    ),
}
"""Functions and oracles."""


@pytest.mark.parametrize("name", EVERY)
def test_windows(name: str, device: str, every_core: None) -> None:
    """Each window as by itself, with the same bits for any number of threads."""
    events = some_events()
    function, oracle = EVERY[name]
    cut = amiwarp.windows(events, ranges=[(0, 900), (500, 700), (700, 700), (3, 4), (900, 2_000)])
    # Events before and after the times of their windows count at the nearer end.
    third = (cut.t_end - cut.t_start) // 3
    inner = amiwarp.Windows(cut.start, cut.stop, cut.t_start + third, cut.t_end - third)
    found = host(function(put(events, device), WIDTH, HEIGHT, windows=inner))
    for k, tensor in enumerate(found):
        part = events[inner.start[k] : inner.stop[k]]
        expected = oracle(part, int(inner.t_start[k]), int(inner.t_end[k]))
        np.testing.assert_allclose(tensor, expected, rtol=0, atol=EXACT)
    for threads in (1, 2):
        with limited_cpu_threads(threads):
            again = host(function(put(events, device), WIDTH, HEIGHT, windows=inner))
        assert np.array_equal(found, again)


def test_windows_in_several_launches(device: str) -> None:
    """On a CPU, the memory of a launch is less than the numbers of 120 windows with the largest depth."""
    events = some_events(600)
    cut = amiwarp.windows(events, count=5)
    found = host(amiwarp.tore_volume(put(events, device), WIDTH, HEIGHT, 256, windows=cut))
    assert len(found) == 120
    for k in (0, 1, 60, 105, 106, 107, 119):
        part = events[cut.start[k] : cut.stop[k]]
        assert np.array_equal(
            found[k], host(amiwarp.tore_volume(put(part, device), WIDTH, HEIGHT, 256))
        )


@pytest.mark.parametrize("name", EVERY)
def test_compensated_events_count_at_the_nearest_pixel(name: str, device: str) -> None:
    """Events outside the image count in no pixel, but in the number of events that a stack halves."""
    rng = np.random.default_rng(1)
    raw = some_events(500)
    x, y = ((v + rng.uniform(-0.49, 0.49, len(raw))).astype(np.float32) for v in (raw.x, raw.y))
    events = Events(x, y, raw.t, raw.p)
    function, oracle = EVERY[name]
    found = host(function(put(events, device), WIDTH, HEIGHT))
    assert np.array_equal(found, host(function(put(raw, device), WIDTH, HEIGHT)))
    expected = oracle(events, int(raw.t[0]), int(raw.t[-1]))
    np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT)
    x[:200] = np.nan
    x[200:250] = 1e9
    outside = host(function(put(Events(x, y, raw.t, raw.p), device), WIDTH, HEIGHT))
    rest = np.zeros_like(expected)
    if name != "density":
        rest = oracle(Events(x, y, raw.t, raw.p), int(raw.t[0]), int(raw.t[-1]))
        np.testing.assert_allclose(outside, rest, rtol=0, atol=EXACT)
    else:
        assert np.array_equal(outside[1:], found[1:])


@pytest.mark.parametrize("name", EVERY)
def test_raw_events_outside_the_image_and_falling_times_are_refused(name: str, device: str) -> None:
    function, _ = EVERY[name]
    events = some_events(300)
    events.x[130] = WIDTH
    with pytest.raises(AmiwarpError, match=f"event 130 .* lies outside the {WIDTH}x{HEIGHT} frame"):
        function(put(events, device), WIDTH, HEIGHT)
    t = np.arange(300)
    t[192] = 5
    zero = np.zeros(300, np.uint16)
    columns = (zero, zero, t, np.ones(300, np.uint8))
    given = DeviceEvents(*(wp.array(values, device=device) for values in columns))
    with pytest.raises(AmiwarpError, match=r"event 192 .* is earlier than the one before"):
        function(given, WIDTH, HEIGHT)


def test_refusals() -> None:
    events = some_events(10)
    for match, call in (
        ("depth = 0 is not", lambda: amiwarp.tore_volume(events, 99, 99, 0)),
        ("depth = 257 is not", lambda: amiwarp.tore_volume(events, 99, 99, 257)),
        (
            "longest_us is 3.0 us and shortest_us 3.0 us; give a longer",
            lambda: amiwarp.tore_volume(events, 99, 99, 1, shortest_us=3.0, longest_us=3.0),
        ),
        ("stacks = 33 is not", lambda: amiwarp.mixed_density_stack(events, 99, 99, 33)),
        ("bins = 0 is not", lambda: amiwarp.event_spike_tensor(events, 99, 99, 0)),
        ("give fewer bins", lambda: amiwarp.event_spike_tensor(events, 9_999, 9_999, 99)),
    ):
        with pytest.raises(AmiwarpError, match=match):
            call()
