"""Tensors of a stream at a steady rate: those of the whole file's windows, wherever the packets end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amiwarp import (
    ErrorCode,
    Events,
    StreamTensor,
    TensorStream,
    ToTensor,
    event_count,
    stacked_histogram,
    voxel_grid,
)
from tests.errors import refused

WIDTH, HEIGHT = 20, 15
REPRESENTATIONS = {
    "voxel": ToTensor(voxel_grid, width=WIDTH, height=HEIGHT, bins=4),
    "count": ToTensor(event_count, width=WIDTH, height=HEIGHT),
    "stack": ToTensor(stacked_histogram, width=WIDTH, height=HEIGHT, bins=3),
}


def some_events(n: int = 5000, *, floating: bool = False) -> Events:
    """Events of a third of a second from a time that is not 0, with a pause."""
    rng = np.random.default_rng(11)
    t = np.sort(rng.integers(0, 333_000, n))
    t[t > 150_000] += 120_000
    x, y = rng.uniform(0, WIDTH - 1, n), rng.uniform(0, HEIGHT - 1, n)
    dtype = np.float32 if floating else np.uint16
    return Events(
        x.astype(dtype), y.astype(dtype), t - 77_001, rng.integers(0, 2, n).astype(np.uint8)
    )


def expected(
    events: Events, rate_hz: float, representation: Any
) -> list[tuple[int, int, int, Any]]:
    """Return start, end, number of events and tensor of each window that has events."""
    found = []
    k = 0
    first = int(events.t[0])
    while True:
        start, end = (first + round(1e6 * number / rate_hz) for number in (k, k + 1))
        if start > events.t[-1]:
            return found
        part = events[(events.t >= start) & (events.t < end)]
        if len(part):
            tensor = representation(part, t_start=start, t_end=end)
            found.append((start, end, len(part), tensor))
        k += 1


def put_in_pieces(events: Events, stream: TensorStream, edges: list[int]) -> list[StreamTensor]:
    found = []
    for start, stop in zip([0, *edges], [*edges, len(events)], strict=True):
        found += stream.put(events[start:stop])
    last = stream.finish()
    assert last is not None
    assert stream.finish() is None
    return [*found, last]


@pytest.mark.parametrize("name", REPRESENTATIONS)
@pytest.mark.parametrize(("rate_hz", "seed"), [(30.0, 0), (30.0, 1), (7.3, 2), (113.7, 3)])
@pytest.mark.parametrize("floating", [False, True])
def test_packets_of_any_length_give_the_windows_of_the_file(
    name: str, rate_hz: float, seed: int, floating: bool
) -> None:
    events = some_events(floating=floating)
    rng = np.random.default_rng(seed)
    cuts = np.sort(rng.integers(0, len(events) + 1, int(rng.integers(0, 150)))).tolist()
    stream = TensorStream(REPRESENTATIONS[name], rate_hz)
    found = put_in_pieces(events, stream, cuts)
    wanted = expected(events, rate_hz, REPRESENTATIONS[name])
    assert len(found) > 2
    times = [(each.t_start, each.t_end, each.events) for each in found]
    assert times == [(start, end, count) for start, end, count, _ in wanted]
    assert sum(each.events for each in found) == len(events)
    for each, (*_, tensor) in zip(found, wanted, strict=True):
        assert np.array_equal(each.tensor, tensor)


def test_a_tensor_comes_with_the_first_event_at_the_end_of_its_window() -> None:
    stream = TensorStream(REPRESENTATIONS["count"], 1000.0)

    def at(*t: int) -> Events:
        return Events.from_arrays([1] * len(t), [2] * len(t), list(t), [1] * len(t))

    assert stream.put(Events.empty()) == []
    assert stream.put(at(500, 1499)) == []
    [first] = stream.put(at(1500))
    assert (first.t_start, first.t_end, first.events) == (500, 1500, 2)
    [second] = stream.put(at(9500))  # seven windows without events
    assert (second.t_start, second.events) == (1500, 1)
    last = stream.finish()
    assert last is not None
    assert (last.t_start, last.t_end) == (9500, 10_500)


@pytest.mark.parametrize("rate_hz", [30.0, 7.3, 333.3])
def test_an_event_at_the_start_of_a_window_belongs_to_it(rate_hz: float) -> None:
    counted: list[int] = []

    def count(events: Events, *, t_start: int, t_end: int) -> int:
        counted.append(len(events))
        return t_end - t_start

    starts = [12_345 + round(1e6 * k / rate_hz) for k in range(2000)]
    n = len(starts)
    stream = TensorStream(count, rate_hz)
    found = stream.put(Events.from_arrays([1] * n, [2] * n, starts, [1] * n))
    assert [each.t_start for each in found] == starts[:-1]
    assert counted == [1] * (n - 1)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, np.nan, 1e7])
def test_impossible_rates_are_refused(rate_hz: float) -> None:
    with refused(ErrorCode.INVALID):
        TensorStream(REPRESENTATIONS["count"], rate_hz)
