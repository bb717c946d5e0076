"""Windows of events: ranges of their indices with times, and recordings joined to a batch with one window for each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events import device_events
from amiwarp.events.device_events import DeviceEvents, device_for, find_indices, times_at, wait
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.schema.calls import guarded
from amiwarp.validation import TIME_LIMIT, instance, packed, real, whole
from amiwarp.validation import array as as_numbers

FEWEST_SAMPLES = 8
LEAST_STEP = 1e-6
"""Fewest samples, and smallest step of the angle between two [rad], that tell the end of turns by themselves."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Windows of events: ranges of their indices, with the times at which each window starts and ends.

    :func:`windows` and :func:`collate` make them. Windows may overlap, and need not be in order.

    Raises
    ------
    AmiwarpError
        If the arrays are not int64 of one length, or a window ends before it starts.

    Examples
    --------
    >>> import numpy as np
    >>> ends = np.array([0, 3, 5])
    >>> len(amiwarp.Windows(start=ends[:-1], stop=ends[1:], t_start=10 * ends[:-1], t_end=10 * ends[1:]))
    2
    """

    start: NDArray[np.int64]
    """Index of each window's first event, shape ``(n,)``."""
    stop: NDArray[np.int64]
    """Index after each window's last event, shape ``(n,)``."""
    t_start: NDArray[np.int64]
    """Time at which each window starts [us], shape ``(n,)``. Bins and decays refer to it."""
    t_end: NDArray[np.int64]
    """Time at which each window ends [us], shape ``(n,)``."""

    def __post_init__(self) -> None:
        for name in ("start", "stop", "t_start", "t_end"):
            values = instance(getattr(self, name), np.ndarray, f"windows' {name}")
            if values.dtype != np.int64 or values.shape != (len(self.start),):
                raise AmiwarpError(
                    f"windows' {name} is {values.dtype} of shape {values.shape}; expected int64, one for each window"
                )
        bad = (self.stop < self.start) | (self.t_end < self.t_start) | (self.start < 0)
        if bad.any():
            k = int(np.argmax(bad))
            raise AmiwarpError(
                f"window {k} has events {self.start[k]} .. {self.stop[k]} and times {self.t_start[k]} .. "
                f"{self.t_end[k]} us; expected 0 <= start <= stop and t_start <= t_end"
            )

    def __len__(self) -> int:
        return len(self.start)

    def __repr__(self) -> str:
        if not len(self):
            return "Windows(0 windows)"
        held = int((self.stop - self.start).sum())
        span = f"t {self.t_start.min()} .. {self.t_end.max()} us"
        windows = "window" if len(self) == 1 else "windows"
        events = "event" if held == 1 else "events"
        return f"Windows({len(self):,} {windows}, {held:,} {events}, {span})"

    def __getitem__(self, which: slice | NDArray[Any]) -> Windows:
        """Return the windows of a slice, or at an index or boolean array."""
        if np.ndim(self.start[which]) == 0:
            raise AmiwarpError(
                f"windows are indexed by {which}; give a slice, such as [k : k + 1] for one window; for the events of "
                "each, events[start:stop] for start, stop in zip(windows.start, windows.stop)"
            )
        return Windows(self.start[which], self.stop[which], self.t_start[which], self.t_end[which])


@guarded
def windows(
    events: Events | DeviceEvents,
    *,
    duration_us: int | None = None,
    count: int | None = None,
    ranges: ArrayLike | None = None,
    encoder: Encoder | None = None,
    turns: float | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    incomplete: bool = False,
) -> Windows:
    """Cut events into windows: of equal duration, of equal count, at given indices, or of turns of the prism.

    Give one of ``duration_us``, ``count``, ``ranges`` and ``encoder``.

    Parameters
    ----------
    events : Events or DeviceEvents
        Events, sorted by time.
    duration_us : int, optional
        Length of a window [us]. Windows start at the first event, and the last one ends at the last event or before.
        They hold the events with ``t_start <= t < t_end``.
    count : int, optional
        Number of events in a window. It starts at the time of its first event and ends at the time of its last one.
    ranges : array_like, optional
        First index, and index after the last, of each window, shape ``(n, 2)``. Times are as for ``count``; a window
        without events is at the time of the event before it.
    encoder : Encoder, optional
        Encoder that covers the events. Windows start at the first event. Each lasts until the angle of the prism
        differs by ``turns``, in either direction, from that at its start.
    turns : float, optional
        Turns of the prism in a window, with ``encoder``; 1 by default.
    t_start, t_end : int, optional
        Start of the first window and latest end of the last one, with ``duration_us`` [us], instead of the times of the
        first and last event. The number of windows then does not depend on the events.
    incomplete : bool, default False
        Keep the last window if it is shorter than the others. Its end is then the end of a whole window for a duration,
        else the last event's time. Not for ``ranges``.

    Returns
    -------
    Windows
        The windows, in order of time.

    Raises
    ------
    AmiwarpError
        If not exactly one way to cut is given, an argument belongs to another way, a range lies outside the events, the
        events are not sorted by time, or the encoder does not cover them.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 25], [0, 1, 1])
    >>> found = amiwarp.windows(events, duration_us=10, incomplete=True)
    >>> found.start.tolist(), found.stop.tolist(), found.t_end.tolist()
    ([0, 1, 2], [1, 2, 3], [10, 20, 30])
    """
    given = {"duration_us": duration_us, "count": count, "ranges": ranges, "encoder": encoder}
    if sum(value is not None for value in given.values()) != 1:
        raise AmiwarpError(
            "windows are cut in one way: give one of duration_us, count, ranges and encoder"
        )
    for name, value, option in (
        ("turns", turns, "encoder"),
        ("t_start", t_start, "duration_us"),
        ("t_end", t_end, "duration_us"),
    ):
        if value is not None and given[option] is None:
            raise AmiwarpError(
                f"{name} is given without {option}; give {option} too, or leave {name} out"
            )
    if ranges is not None:
        if incomplete:
            raise AmiwarpError("incomplete is given for windows at given ranges; leave it out")
        return _in_ranges(events, ranges)
    if count is not None:
        count = whole(count, "count", 1, 1 << 62, " events in a window")
        return _of_count(events, count, incomplete=incomplete)
    if not len(events) and (t_start is None or t_end is None):
        nothing = np.zeros(0, np.int64)
        return _at_indices(events, nothing, nothing.copy())
    check_window_order(events)
    if duration_us is not None:
        duration_us = whole(duration_us, "duration_us", 1, 1 << 62, " us in a window")
        return _of_duration(events, duration_us, t_start, t_end, incomplete=incomplete)
    turns = 1.0 if turns is None else real(turns, "turns", 1e-6)
    return _of_turns(events, encoder, turns, incomplete=incomplete)


def _in_ranges(events: Events | DeviceEvents, ranges: ArrayLike) -> Windows:
    """Return windows at given pairs of indices."""
    count = len(events)
    pairs = as_numbers(ranges, "ranges", "iu").astype(np.int64)
    are_pairs = pairs.ndim == 2 and pairs.shape[1] == 2
    if pairs.size and (not are_pairs or pairs.min() < 0 or pairs.max() > count):
        raise AmiwarpError(
            f"ranges have shape {pairs.shape}; expected (n, 2), with indices in 0 .. {count}"
        )
    pairs = pairs.reshape(-1, 2)
    start = pairs[:, 0].copy()
    stop = pairs[:, 1].copy()
    return _at_indices(events, start, stop)


def _of_count(events: Events | DeviceEvents, count: int, *, incomplete: bool) -> Windows:
    """Return windows of ``count`` events."""
    total = len(events)
    end = total + 1
    if incomplete and total % count:
        end = total + count  # one edge behind the last event
    edges = np.arange(0, end, count, dtype=np.int64)
    stop = np.minimum(edges[1:], total)
    return _at_indices(events, edges[:-1], stop)


def _of_duration(
    events: Events | DeviceEvents,
    duration_us: int,
    t_start: int | None,
    t_end: int | None,
    *,
    incomplete: bool,
) -> Windows:
    """Return windows of equal duration. Without events, both ``t_start`` and ``t_end`` are given."""
    start_us, end_us = _first_and_last(events)
    if t_start is not None:
        start_us = whole(t_start, "t_start", -TIME_LIMIT, TIME_LIMIT, " us")
    if t_end is not None:
        end_us = whole(t_end, "t_end", -TIME_LIMIT, TIME_LIMIT, " us")
    number, rest = divmod(max(end_us - start_us, 0), duration_us)
    # an event at the very end, the last one, is in no whole window
    if incomplete and (rest or (t_end is None and end_us >= start_us)):
        number += 1
    if number > MOST_WINDOWS:
        raise AmiwarpError(f"{number} windows of {duration_us} us are too many; give longer ones")

    edges = start_us + np.arange(number + 1, dtype=np.int64) * duration_us
    if not len(events):
        indices = np.zeros_like(edges)
    else:
        # The last window may reach beyond t_end, but holds no events after it.
        limits_us = edges if t_end is None else np.minimum(edges, end_us)
        indices = find_indices(events, limits_us)
    if incomplete and t_end is None and len(indices) > 1:
        indices[-1] = len(events)
    return Windows(indices[:-1], indices[1:], edges[:-1], edges[1:])


MOST_WINDOWS = 1 << 27
"""Largest number of windows of equal duration."""


def _of_turns(
    events: Events | DeviceEvents,
    encoder: Any,
    turns: float,
    *,
    incomplete: bool,
) -> Windows:
    """Return windows of ``turns`` of the prism. There must be an event."""
    first_us, last_us = _first_and_last(events)
    edges = turn_edges(encoder, first_us, last_us, turns, incomplete)
    indices = find_indices(events, edges)
    if incomplete and len(indices) > 1:
        indices[-1] = len(events)
    return Windows(indices[:-1], indices[1:], edges[:-1], edges[1:])


def _first_and_last(events: Events | DeviceEvents) -> tuple[Any, Any]:
    """Return the times of the first and of the last event [us]; zeros without events."""
    if not len(events):
        return 0, 0
    first_us, last_us = times_at(events, np.array([0, len(events) - 1]))
    return first_us, last_us


def check_window_order(events: Events | DeviceEvents, first_index: int = 0) -> None:
    """Raise :class:`AmiwarpError` with both remedies if an event is earlier than the one before."""
    try:
        device_events.check_order(events, first_index)
    except AmiwarpError as error:
        raise AmiwarpError(
            f"{error}, or give the windows of amiwarp.collate, if it joined the events"
        ) from None


def turn_edges(
    encoder: Any,
    first: int,
    last: int,
    turns: float,
    incomplete: bool,
) -> NDArray[np.int64]:
    """Return the times at which windows of ``turns`` of the prism start and end, from the first event on [us]."""
    # Turns since the first event, at it, at the encoder's samples and at the last event. Between them, the prism
    # turns evenly.
    offset = encoder.clock_offset_us
    begin = np.searchsorted(encoder.t, math.floor(first + offset), side="right")
    end = np.searchsorted(encoder.t, math.ceil(last + offset), side="left")
    inside = encoder.t[begin:end]
    samples = np.rint(inside - encoder.clock_offset_us).astype(np.int64)
    times = np.unique(np.concatenate([[first], samples, [last]]))
    angle = encoder.angle_at(times)
    turned = (angle - angle[0]) / math.tau
    moved = np.concatenate([[True], np.diff(turned) != 0.0])
    turned = turned[moved]
    elapsed = (times[moved] - first).astype(np.float64)

    edges = [np.array([first])]
    for start, stop, level, direction, number in _one_way(turned / turns):
        ahead = direction * (turned[start:stop] - level * turns)
        t = elapsed[start:stop]
        farthest = np.maximum.accumulate(ahead)
        ends = np.arange(1, number + 1) * turns
        wanted = np.minimum(ends, farthest[-1])
        after = np.maximum(np.searchsorted(farthest, wanted), 1)
        before = after - 1
        slope = (t[after] - t[before]) / (ahead[after] - ahead[before])
        reached = slope * (wanted - ahead[before]) + t[before]
        edges.append(first + np.rint(reached).astype(np.int64))

    all_edges = np.concatenate(edges)
    if incomplete and (all_edges[-1] < last or len(all_edges) == 1):
        all_edges = np.append(all_edges, last)
    return all_edges


def turn_end(encoder: Encoder, first: int, start: float, last: int, turns: int) -> int | None:
    """Return edge number ``turns`` of :func:`turn_edges` for single turns [us], in less time, from few samples.

    ``start`` is the angle at ``first`` [rad]. None if the prism turns back between ``first`` and ``last``, or the edge
    is not between two samples there.
    """
    offset = encoder.clock_offset_us
    begin = int(np.searchsorted(encoder.t, math.floor(first + offset), side="right"))
    end = int(np.searchsorted(encoder.t, math.ceil(last + offset), side="left"))
    angle = encoder.angle[max(begin - 1, 0) : end + 1]
    if end - begin < FEWEST_SAMPLES:
        return None
    direction = math.copysign(1.0, angle[1] - angle[0])
    if not (direction * np.diff(angle) > LEAST_STEP).all():
        return None

    # Some samples before and after the edge, which may lie a sample beside the place that the first angle tells
    inside = direction * encoder.angle[begin:end]
    behind = begin + int(inside.searchsorted(direction * start + math.tau * turns))
    near = encoder.t[max(behind - 3, begin) : min(behind + 3, end)]
    samples = np.rint(near - offset).astype(np.int64)
    # With the first time, the angles are rounded as there
    angles = encoder.angle_at(np.concatenate([[first], samples]))[1:]
    ahead = direction * ((angles - start) / math.tau)
    after = int(ahead.searchsorted(float(turns)))
    if not 0 < after < len(ahead):
        return None
    elapsed = (samples - first).astype(np.float64)
    before = after - 1
    slope = (elapsed[after] - elapsed[before]) / (ahead[after] - ahead[before])
    reached = slope * (turns - ahead[before]) + elapsed[before]
    return first + round(float(reached))


def _one_way(turned: NDArray[np.float64]) -> Iterator[tuple[int, int, int, int, int]]:
    """Yield the stretches of samples in which windows end in one direction, for the angle in windows since the start.

    Each has its first sample, the one after its last, the whole number of windows at its start, its direction, 1 or -1,
    and the number of windows that end in it.
    """
    start = 0
    direction = 0
    level = 0
    before = 0
    # Floor plus ceiling changes where the angle passes a whole number, or reaches or leaves one.
    steps = np.diff(np.floor(turned) + np.ceil(turned))
    passes = np.flatnonzero(steps) + 1
    for k in passes.tolist():
        start_turns = float(turned[k])
        if abs(start_turns - level) < 1.0:
            continue
        ahead = 1 if start_turns > level else -1
        if direction == -ahead:
            yield start, k, before, direction, abs(level - before)
            start = k - 1
            before = level
        direction = ahead
        level = ahead * math.floor(ahead * start_turns)
    if direction:
        yield start, len(turned), before, direction, abs(level - before)


def _at_indices(
    events: Events | DeviceEvents,
    start: NDArray[np.int64],
    stop: NDArray[np.int64],
) -> Windows:
    """Return windows at indices, which start and end at the times of their first and last events.

    Those without events start and end at the time of the event before them, or of the first one.
    """
    if not len(events):
        return Windows(start, stop, np.zeros_like(start), np.zeros_like(start))
    last = np.maximum(np.maximum(start, stop) - 1, 0)
    first = np.minimum(start, last)
    times = times_at(events, np.concatenate([first, last]))
    t_start, t_end = np.split(times, 2)
    return Windows(start, stop, t_start, t_end)


@guarded
def collate(
    blocks: Sequence[Events] | Sequence[DeviceEvents], *, device: Any = None
) -> tuple[Any, Windows]:
    """Join the events of several recordings, with one window for each.

    Parameters
    ----------
    blocks : sequence of Events, or of DeviceEvents
        Events of each recording, sorted by time; at least one recording. A recording may be empty.
    device : str or warp.Device, optional
        Device to copy :class:`Events` to. Without it, they stay in NumPy arrays.

    Returns
    -------
    Events or DeviceEvents
        All events, in the order of the recordings. Their times start anew with each recording. If some are compensated,
        all coordinates are float32.
    Windows
        One window for each recording, from its first to its last event.

    Raises
    ------
    AmiwarpError
        If there are no blocks, or they differ in type or device.

    Examples
    --------
    >>> first = amiwarp.Events.from_arrays([1, 1], [0, 0], [0, 10], [0, 1])
    >>> second = amiwarp.Events.from_arrays([2], [1], [5], [1])
    >>> events, found = amiwarp.collate([first, second])
    >>> amiwarp.event_count(events, 4, 2, windows=found).sum(axis=(1, 2)).tolist()
    [2, 1]
    """
    kinds: set[Any] = {type(block) for block in blocks}
    if len(kinds) != 1 or not kinds <= {Events, DeviceEvents}:
        raise AmiwarpError(
            "a batch needs at least one block, and all blocks Events or all DeviceEvents"
        )
    lengths = [len(block) for block in blocks]
    ends = np.cumsum([0, *lengths], dtype=np.int64)
    joined = kinds.pop().concatenate(blocks)
    if isinstance(joined, DeviceEvents):
        device_for(joined, device)
    joined_windows = _at_indices(joined, ends[:-1], ends[1:])
    if isinstance(joined, Events) and device is not None:
        joined = on_device(joined, wp.get_device(device))
        wait(joined.device)
    return joined, joined_windows


def on_device(events: Events | DeviceEvents, device: Any) -> DeviceEvents:
    """Return events in Warp arrays on the device. On a CPU they are not copied."""
    if isinstance(events, DeviceEvents):
        return events
    columns = []
    for name in device_events.NAMES:
        values = packed(getattr(events, name))
        dtype = wp.dtype_from_numpy(values.dtype)
        columns.append(wp.array(values, dtype=dtype, device=device, copy=not device.is_cpu))
    return DeviceEvents(*columns)
