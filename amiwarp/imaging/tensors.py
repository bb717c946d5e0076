"""Events as tensors for networks: counts, voxel grids, histograms, time surfaces; windows, batches and transforms."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events import device_events
from amiwarp.events.device_events import (
    DeviceEvents,
    check_sensor,
    device_for,
    find_indices,
    host_numbers,
    idle_numbers,
    limits,
    times_at,
    wait,
)
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.events.recording import Events, Recording, check_coordinates
from amiwarp.kernels import tensors as kernels
from amiwarp.kernels.compensation import LaunchPlan
from amiwarp.kernels.events import NEVER
from amiwarp.kernels.launch import launch, load, run_together, slices
from amiwarp.kernels.prism_angle import encoder_params
from amiwarp.kernels.tensors import BLOCK, RUN
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.optics.models import Model
from amiwarp.tasks import cpu_threads
from amiwarp.validation import TIME_LIMIT, check_names, guarded, instance, packed, real, shown, whole
from amiwarp.validation import array as as_numbers

# Windows of events.


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
        held, span = int((self.stop - self.start).sum()), f"t {self.t_start.min()} .. {self.t_end.max()} us"
        windows = f"{len(self):,} window{'s'[: len(self) != 1]}"
        return f"Windows({windows}, {held:,} event{'s'[: held != 1]}, {span})"

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
        Number of events in a window. It starts at the time of its first event and ends at that of its last one.
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
        Keep the last window if it is shorter than the others. Its end is then that of a whole window for a duration,
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
        raise AmiwarpError("windows are cut in one way: give one of duration_us, count, ranges and encoder")
    for name, value, way in (("turns", turns, "encoder"), ("t_start", t_start, "duration_us"),
                             ("t_end", t_end, "duration_us")):  # fmt: skip
        if value is not None and given[way] is None:
            raise AmiwarpError(f"{name} is given without {way}; give {way} too, or leave {name} out")
    n = len(events)
    if ranges is not None:
        if incomplete:
            raise AmiwarpError("incomplete is given for windows at given ranges; leave it out")
        pairs = as_numbers(ranges, "ranges", "iu").astype(np.int64)
        if pairs.size and (pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.min() < 0 or pairs.max() > n):
            raise AmiwarpError(f"ranges have shape {pairs.shape}; expected (n, 2), with indices in 0 .. {n}")
        pairs = pairs.reshape(-1, 2)
        return _at_indices(events, pairs[:, 0].copy(), pairs[:, 1].copy())
    if count is not None:
        count = whole(count, "count", 1, 1 << 62, " events in a window")
        edges = np.arange(0, n + count if incomplete and n % count else n + 1, count, dtype=np.int64)
        return _at_indices(events, edges[:-1], np.minimum(edges[1:], n))
    if not n and (t_start is None or t_end is None):
        return _at_indices(events, np.zeros(0, np.int64), np.zeros(0, np.int64))
    _check_order(events)
    first, last = times_at(events, np.array([0, n - 1])) if n else (0, 0)
    if duration_us is not None:
        duration_us = whole(duration_us, "duration_us", 1, 1 << 62, " us in a window")
        first = first if t_start is None else whole(t_start, "t_start", -TIME_LIMIT, TIME_LIMIT, " us")
        end = last if t_end is None else whole(t_end, "t_end", -TIME_LIMIT, TIME_LIMIT, " us")
        number, rest = divmod(max(end - first, 0), duration_us)
        # an event at the very end, the last one, is in no whole window
        number += 1 if incomplete and (rest or (t_end is None and end >= first)) else 0
        if number > MOST_WINDOWS:
            raise AmiwarpError(f"{number} windows of {duration_us} us are too many; give longer ones")
        edges = first + np.arange(number + 1, dtype=np.int64) * duration_us
    else:
        turns = 1.0 if turns is None else real(turns, "turns", 1e-6)
        edges = _turn_edges(encoder, first, last, turns, incomplete)
    found = find_indices(events, edges if t_end is None else np.minimum(edges, end)) if n else 0 * edges
    if incomplete and t_end is None and len(found) > 1:
        found[-1] = n
    return Windows(found[:-1], found[1:], edges[:-1], edges[1:])


MOST_WINDOWS = 1 << 27
"""Largest number of windows of equal duration."""


def _check_order(events: Events | DeviceEvents, first_index: int = 0) -> None:
    """Raise :class:`AmiwarpError` with both remedies if an event is earlier than the one before."""
    try:
        device_events.check_order(events, first_index)
    except AmiwarpError as error:
        raise AmiwarpError(f"{error}, or give the windows of amiwarp.collate, if it joined the events") from None


def _turn_edges(encoder: Any, first: int, last: int, turns: float, incomplete: bool) -> NDArray[np.int64]:
    """Return the times at which windows of ``turns`` of the prism start and end, from the first event on [us]."""
    inside = encoder.t[(encoder.t > first + encoder.clock_offset_us) & (encoder.t < last + encoder.clock_offset_us)]
    times = np.unique(np.concatenate([[first], np.rint(inside - encoder.clock_offset_us).astype(np.int64), [last]]))
    turned = (encoder.angle_at(times) - encoder.angle_at([first])) / (2.0 * math.pi)
    moved = np.concatenate([[True], np.diff(turned) != 0.0])
    turned, elapsed = turned[moved], (times[moved] - first).astype(np.float64)
    edges = [np.array([first])]
    for start, stop, level, way, number in _one_way(turned / turns):
        ahead, t = way * (turned[start:stop] - level * turns), elapsed[start:stop]
        farthest = np.maximum.accumulate(ahead)
        wanted = np.minimum(np.arange(1, number + 1) * turns, farthest[-1])
        after = np.maximum(np.searchsorted(farthest, wanted), 1)
        slope = (t[after] - t[after - 1]) / (ahead[after] - ahead[after - 1])
        edges.append(first + np.rint(slope * (wanted - ahead[after - 1]) + t[after - 1]).astype(np.int64))
    found = np.concatenate(edges)
    return np.append(found, last) if incomplete and (found[-1] < last or len(found) == 1) else found


def _one_way(turned: NDArray[np.float64]) -> Iterator[tuple[int, int, int, int, int]]:
    """Yield the stretches of samples in which windows end in one direction, for the angle in windows since the start.

    Each has its first sample, the one after its last, the whole number of windows at its start, its direction, 1 or -1,
    and the number of windows that end in it.
    """
    start = way = level = before = 0
    for k in (np.flatnonzero(np.diff(np.floor(turned) + np.ceil(turned))) + 1).tolist():
        at = float(turned[k])
        if abs(at - level) < 1.0:
            continue
        ahead = 1 if at > level else -1
        if way == -ahead:
            yield start, k, before, way, abs(level - before)
            start, before = k - 1, level
        way, level = ahead, ahead * math.floor(ahead * at)
    if way:
        yield start, len(turned), before, way, abs(level - before)


def _at_indices(events: Events | DeviceEvents, start: NDArray[np.int64], stop: NDArray[np.int64]) -> Windows:
    """Return windows at indices, which start and end at the times of their first and last events.

    Those without events start and end at the time of the event before them, or of the first one.
    """
    if not len(events):
        return Windows(start, stop, np.zeros_like(start), np.zeros_like(start))
    last = np.maximum(np.maximum(start, stop) - 1, 0)
    times = times_at(events, np.concatenate([np.minimum(start, last), last]))
    return Windows(start, stop, *np.split(times, 2))


# Batches of recordings.


@guarded
def collate(blocks: Sequence[Events] | Sequence[DeviceEvents], *, device: Any = None) -> tuple[Any, Windows]:
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
        raise AmiwarpError("a batch needs at least one block, and all blocks Events or all DeviceEvents")
    ends = np.concatenate([[0], np.cumsum([len(block) for block in blocks])]).astype(np.int64)
    joined = kinds.pop().concatenate(blocks)
    if isinstance(joined, DeviceEvents):
        device_for(joined, device)
    found = _at_indices(joined, ends[:-1], ends[1:])
    if isinstance(joined, Events) and device is not None:
        joined = on_device(joined, wp.get_device(device))
        wait(joined.device)
    return joined, found


def on_device(events: Events | DeviceEvents, device: Any) -> DeviceEvents:
    """Return events in Warp arrays on the device. On a CPU they are not copied."""
    if isinstance(events, DeviceEvents):
        return events
    columns = (packed(getattr(events, name)) for name in device_events.NAMES)
    return DeviceEvents(
        *(wp.array(v, dtype=wp.dtype_from_numpy(v.dtype), device=device, copy=not device.is_cpu) for v in columns)
    )


# Images of windows: sums, counts or times, computed by kernels.

MOST_BYTES = {"cpu": 1 << 25, "cuda": 1 << 30}
"""Memory for the images of the windows that are processed in one launch [bytes]; at least one window is processed."""
MOST_BINS = 1 << 20
"""Largest number of time bins."""
MOST_EVENTS = (1 << 31) - 1
"""Largest number of events, and of pixels in all images of a window, that kernels can address."""
SMALLEST = 256
"""Fewest blocks of a slice on a CPU."""
LEAST_ADDED = 1 << 15
"""Fewest numbers of the spare groups that a CPU thread adds."""


@dataclass(frozen=True, slots=True)
class _Batch:
    """Events on a device and their windows, as the kernels take them."""

    events: DeviceEvents
    windows: Windows
    single: bool
    """Whether the result has no axis of windows."""
    on_host: bool
    """Whether the result is a NumPy array."""
    size: tuple[int, int]
    """Width and height of the images [px]."""
    faults: wp.array
    """Faults of the events by number, 1 if they occur. Memory of the host, which the device writes to."""

    @property
    def device(self) -> Any:
        return self.events.device

    def empty(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """Return an array for the result, shape (windows, *shape)."""
        if math.prod(shape) > MOST_EVENTS:
            raise AmiwarpError(f"a tensor has shape {shape}, more than {MOST_EVENTS} elements; give fewer bins")
        return wp.empty((len(self.windows), *shape), dtype=dtype, device=self.device)

    def finish(self, out: wp.array) -> Any:
        """Return the result of a public function.

        Raises :class:`AmiwarpError` if times decrease in a window, or an event of a sensor lies outside the image.
        """
        wait(self.device)
        found_faults = self.faults.numpy()
        if found_faults[kernels.DESCENDING] or found_faults[kernels.OUTSIDE]:
            _check_windows(self.events.to_host(), self.windows, self.size)
        idle_numbers[self.device.is_cpu, wp.int32].append(self.faults)
        found = out.numpy() if self.on_host else out
        return found[0] if self.single else found


def _check_windows(events: Events, cut: Windows, size: tuple[int, int]) -> None:
    """Raise :class:`AmiwarpError` for the first event that is earlier than the one before, or outside the sensor."""
    for start, stop in zip(cut.start.tolist(), cut.stop.tolist(), strict=True):
        if stop > start:
            _check_order(events[start:stop], start)
            check_coordinates(events[start:stop], *size, where="events", first_index=start, allow_nan=True)


def _batch(
    events: Any, size: tuple[int, int], cut: Windows | None, t_start: int | None, t_end: int | None,
    model: Model | None, encoder: Encoder | None, device: Any,
) -> _Batch:  # fmt: skip
    """Return the events and windows of a public function's arguments, compensated if there is a model."""
    if (model is None) != (encoder is None):
        raise AmiwarpError("only one of model and encoder is given; give both a model and an encoder, or neither")
    single = cut is None and not isinstance(events, list | tuple)
    on_host = isinstance(events[0] if isinstance(events, list | tuple) and events else events, Events)
    if isinstance(events, list | tuple):
        if cut is not None:
            raise AmiwarpError("events are a batch of recordings and windows are given; join them by amiwarp.collate")
        events, cut = collate(events, device=device)
    if cut is not None and not (t_start is None and t_end is None):
        raise AmiwarpError("t_start or t_end is given for several windows; the windows have times of their own")
    n, there = len(events), device_for(events, device)
    if n > MOST_EVENTS:
        raise AmiwarpError(f"there are {n} events; give at most {MOST_EVENTS} at a time")
    cut = _window(events, t_start, t_end) if cut is None else cut
    if len(cut) and int(cut.stop.max()) > n:
        raise AmiwarpError(f"windows reach to event {int(cut.stop.max())} of {n}; give the events that were cut")
    width = whole(size[0], "width", 1, LARGEST_SIZE, " pixels")
    height = whole(size[1], "height", 1, LARGEST_SIZE, " pixels")
    found = on_device(events, there)
    if model is not None and encoder is not None:
        found = _compensated(found, (width, height), cut, model, encoder)
    return _Batch(found, cut, single, on_host, (width, height), host_numbers(2, wp.int32, there))


def _window(events: Events | DeviceEvents, t_start: int | None, t_end: int | None) -> Windows:
    """Return one window, from ``t_start`` to ``t_end``, both included [us]; None for the first or the last event."""
    limits: list[Any] = events._limits if isinstance(events, DeviceEvents) else []
    if limits and not limits[5]:  # known, and the times ascend
        first, last = limits[:2]
    else:
        first, last = times_at(events, np.array([0, len(events) - 1])).tolist() if len(events) else (0, 0)
    low, high = first if t_start is None else t_start, last if t_end is None else t_end
    if high < low:
        if t_start is not None and t_end is not None:
            raise AmiwarpError(f"t_end is {t_end} us, before t_start, {t_start} us; give t_start <= t_end")
        if t_start is None and t_end is None:  # not in order, which the kernels find
            low, high = high, low
        else:
            low = high = t_start if t_end is None else t_end
    start, stop = 0, len(events)
    if t_start is not None or t_end is not None:
        start, stop = find_indices(events, np.array([low, high + 1])).tolist() if len(events) else (0, 0)
    return Windows(*(np.array([value], np.int64) for value in (start, stop, low, high)))


def _compensated(
    events: DeviceEvents, size: tuple[int, int], cut: Windows, model: Model, encoder: Encoder
) -> DeviceEvents:
    """Return events at their positions without the optic. ``size``: of the images, which the recorded events fit."""
    check_sensor(events)
    check_prisms(encoder, model.ANGLES)
    if not len(events):
        return events
    if events.device.is_cpu:
        x, y, t = (getattr(events, name).numpy() for name in ("x", "y", "t"))
        span, largest = (int(t.min()), int(t.max())), (int(x.max()), int(y.max()))
    else:
        t_first, t_last, right, bottom, _, _ = limits(events)
        span, largest = (t_first, t_last), (right, bottom)
    if largest[0] >= size[0] or largest[1] >= size[1]:
        _check_windows(events.to_host(), cut, size)
    plan = LaunchPlan(model, events.device)
    params = encoder_params(encoder, *span, str(events.device))
    columns = plan.run(plan.device_columns(events), params, *largest)
    return DeviceEvents(columns.out_x[: len(events)], columns.out_y[: len(events)], events.t, events.p)


class _Grid(NamedTuple):
    """Values of :class:`amiwarp.kernels.tensors.Grid`."""

    width: int
    height: int
    border: int = 0
    steps: int = 1
    rate: int = 0
    layers: int = 1
    low: int = 0
    off: int = 1
    parts: int = 1


@lru_cache(maxsize=256)
def _struct(kind: Any, *values: int) -> Any:
    """Return a struct of numbers, which must not be changed. To make one takes as long as a launch."""
    found = kind()
    for name, value in zip(kind.vars, values, strict=False):
        setattr(found, name, value)
    return found


_zeros: list[wp.array] = []
"""Memory of words on the CPU, all zero, which the next call uses again: new memory takes longer than many events."""


def _take_zeros(n: int) -> wp.array:
    """Return at least ``n`` words on the CPU, all zero."""
    while _zeros:
        found = _zeros.pop()
        if len(found) >= n:
            return found
    return wp.zeros(n, dtype=wp.int64, device="cpu")


def _images(
    batch: _Batch, grid: _Grid, kernel: Any, on_cpu: Any, dtype: Any, *, sums: int = 1, empty: int = 0
) -> Iterator[tuple[int, int, wp.array]]:
    """Compute the images of all windows by a kernel. Yield the first window, the number of windows, and their images.

    ``on_cpu``: kernel for blocks of events. ``sums``: numbers of type ``dtype`` in each pixel, ``empty`` at first. The
    images are overwritten by the next ones; on a CPU, the caller clears images of words.
    """
    cut, events, device = batch.windows, batch.events, batch.device
    group = grid.layers * (grid.height + 2 * grid.border) * (grid.width + 2 * grid.border)
    span = cut.t_end - cut.t_start
    if grid.rate and len(cut) and int(span.max()) >= (1 << 53) // grid.rate:
        raise AmiwarpError(f"a window lasts {int(span.max())} us; give one below {(1 << 53) // grid.rate} us")
    groups = grid.steps * grid.parts
    bytes_each = groups * group * sums * wp.types.type_size_in_bytes(dtype)
    most = min(max(MOST_BYTES["cpu" if device.is_cpu else "cuda"] // bytes_each, 1), len(cut))
    # behind the images there are the spare groups of the slices, and places for the events outside the image
    threads = cpu_threads() if device.is_cpu else 1
    spare = most * groups
    trash = (spare + threads - 1) * group
    size = (trash + threads * 2 * (grid.width + 16)) * sums
    if size > MOST_EVENTS:
        raise AmiwarpError(f"a window has {groups * group} pixels in all its images; give fewer bins")
    in_words = device.is_cpu and on_cpu is kernels.add_event_word_blocks
    images = _take_zeros(size) if in_words else wp.empty(size, dtype=dtype, device=device)
    for first in range(0, len(cut), most or 1):
        number = min(most, len(cut) - first)
        if not in_words:
            images.fill_(empty)
        rows, blocks = _rows(cut if number == len(cut) else cut[first : first + number], device)
        inputs = [events.x, events.y, events.t, events.p, rows, _struct(kernels.Grid, *grid)]
        outputs = [batch.faults, images]
        if device.is_cpu:
            _add_on_cpu(on_cpu, inputs, outputs, blocks, spare, group * sums, trash)
        elif blocks:
            wp.launch(kernel, blocks * int(BLOCK), [*inputs, _struct(kernels.Part)], outputs, device=device)
        yield first, number, images
    if in_words:
        images.numpy()[trash:size] = 0
        if images.size * 8 <= 6 * MOST_BYTES["cpu"]:
            _zeros[:] = [images]


def _rows(cut: Windows, device: Any) -> tuple[wp.array, int]:
    """Return windows as the array that kernels take, and the number of their blocks."""
    ends = np.cumsum(-(-(cut.stop - cut.start) // int(BLOCK)))
    rows = np.empty((len(cut), 5), np.int64)
    rows[:, 0], rows[:, 1], rows[0, 2], rows[1:, 2] = cut.start, cut.stop, 0, ends[:-1]
    rows[:, 3], rows[:, 4] = cut.t_start, np.maximum(cut.t_end - cut.t_start, 1)
    return wp.array(rows, dtype=wp.int64, device=device, copy=not device.is_cpu), int(ends[-1])


def _add_on_cpu(
    kernel: Any, inputs: list[Any], outputs: list[wp.array], blocks: int, spare: int, group: int, trash: int
) -> None:
    """Run a kernel on slices of the blocks. Add the spare groups of all slices but the first, and clear them.

    ``spare``: number of the first spare group. ``group``: numbers in a group. ``trash``: first pixel after all groups.
    """
    images, grid = outputs[-1], inputs[-1]
    load(kernel, images.device)
    if not blocks:
        return
    parts = []
    for k, (first, stop) in enumerate(slices(blocks, cpu_threads(), SMALLEST)):
        part = first, spare + k - 1 if k else -1, trash + k * 2 * (grid.width + 16), stop
        run_of = int(RUN) if kernel is kernels.add_event_word_blocks else 1
        parts.append((_struct(kernels.Part, *part), -(-(stop - first) // run_of)))

    def run(part: Any, n: int) -> None:
        wp.launch(kernel, n, [*inputs, part], outputs, device=images.device)

    run_together([partial(run, *part) for part in parts])
    if len(parts) == 1:
        return
    own, values, pairs = wp.zeros(1, dtype=int, device=images.device), images.numpy(), []
    for part, _ in parts[1:]:
        wp.launch(kernels.find_own, 1, [inputs[2], *inputs[4:], part], [own], device=images.device)
        pairs.append([values[k * group : (k + 1) * group] for k in (int(own.numpy()[0]), part.spare)])

    def add(first: int, stop: int) -> None:
        for to, added in pairs:
            to, added = to[first:stop], added[first:stop]
            (np.maximum if kernel is kernels.keep_latest_blocks else np.add)(to, added, out=to)
            added[:] = 0

    run_together([partial(add, *ends) for ends in slices(group, cpu_threads(), LEAST_ADDED)])


def _part(out: wp.array, first: int, number: int) -> wp.array:
    """Return the results of some windows as one row."""
    return (out if number == len(out) else out[first : first + number]).flatten()


def _counts(batch: _Batch, grid: _Grid) -> Iterator[tuple[int, int, wp.array]]:
    """Count the events at the nearest pixels, see :func:`_images`."""
    return _images(batch, grid, kernels.count_events, kernels.count_event_blocks, wp.int32)


def _latest(batch: _Batch, grid: _Grid, *, carry: bool) -> Iterator[tuple[int, int, wp.array]]:
    """Find the latest times at the nearest pixels, see :func:`_images`. With ``carry``, also of earlier windows."""
    size = grid.layers * grid.height * grid.width
    before = None
    for first, number, images in _images(
        batch, grid, kernels.keep_latest, kernels.keep_latest_blocks, wp.int64, empty=int(NEVER)
    ):
        if carry:
            launch(kernels.carry_latest, size, [images, number, size, before or images], [], device=batch.device)
            before = wp.clone(images[(number - 1) * size : number * size])
        yield first, number, images


def _check_carry(events: Any, cut: Windows) -> None:
    """Raise :class:`AmiwarpError` if times cannot be carried from each window to the next."""
    if isinstance(events, list | tuple) and len(events) > 1:
        raise AmiwarpError(f"carry is given for {len(events)} recordings; call the function for each of them")
    if (np.diff(cut.start) < 0).any() or (np.diff(cut.t_end) < 0).any():
        raise AmiwarpError("carry is given for windows that are not in order of time; sort them, or leave carry out")


def _shares(batch: _Batch, grid: _Grid, bins: int) -> wp.array:
    """Return the bins of all windows, shape (windows, layers * bins, height, width)."""
    out = batch.empty((grid.layers * bins, grid.height, grid.width), wp.float32)
    parts, fullest = _parts(batch, grid) if batch.events.whole_pixels else (1, CAPACITY)
    in_words = fullest < CAPACITY
    border, low = int(not in_words), 63 - max(fullest.bit_length(), LEAST_BITS)
    grid = grid._replace(border=border, low=low, parts=parts)
    kernel, on_cpu, read, sums = kernels.share_events, kernels.share_event_blocks, kernels.read_shares, 2
    if in_words:
        kernel, on_cpu, read, sums = kernels.add_event_words, kernels.add_event_word_blocks, kernels.read_bins, 1
    length = grid.width if batch.device.is_cpu else 1
    for first, number, images in _images(batch, grid, kernel, on_cpu, wp.int64, sums=sums):
        part = _part(out, first, number)
        threads = part.size // (length * (bins if in_words else 1))
        inputs = [images, _struct(kernels.Grid, *grid), bins, length]
        launch(read, threads, inputs, [part], device=batch.device, smallest=SMALLEST // 4)
    return out


CAPACITY, LEAST_BITS = 1 << 19, 16
"""Number of events in a part of a time interval from which words are not used. Fewer events leave more bits for their
shares: 24 bits just below the capacity, and 30 bits below ``2**LEAST_BITS`` events. With 24 bits, the sum of ten
thousand shares is exact to 1e-5."""
MOST_IMAGES = 52
"""Largest memory of a window's images for each of its events, if its time intervals are cut into parts [bytes]."""


def _parts(batch: _Batch, grid: _Grid) -> tuple[int, int]:
    """Return into how many parts each time interval is cut so that words can be used, and the most events in a part.

    The second number is an upper bound, exact if there are many events. From CAPACITY on, words cannot be used.
    """
    cut = batch.windows
    most = int((cut.stop - cut.start).max(initial=0))
    if most < CAPACITY or not grid.rate:
        return 1, most
    span = cut.t_end - cut.t_start
    parts = 1 << (most // (grid.rate * CAPACITY)).bit_length()
    image = 8 * grid.layers * grid.width * grid.height
    while grid.steps * parts * image <= MOST_IMAGES * most and int(span.max()) * grid.rate * parts < 1 << 53:
        number = grid.rate * parts
        edges = cut.t_start - -np.arange(1, number)[:, None] * span // number
        inside = find_indices(batch.events, edges.ravel()).reshape(edges.shape)
        found = np.stack([cut.start, *np.clip(inside, cut.start, cut.stop), cut.stop])
        fullest = int(np.diff(found, axis=0).max())
        if fullest < CAPACITY:
            return parts, fullest
        parts *= 2
    return 1, most


def _normalise(values: wp.array) -> None:
    """Bring the values of each row that are not zero to a mean of 0 and a standard deviation of 1."""
    device = values.device
    parts = -(-values.shape[1] // ROW)
    moments = wp.empty((values.shape[0], parts), dtype=wp.vec3d, device=device)
    wp.launch(kernels.sum_moments, moments.shape, [values, ROW], [moments], device=device)
    while parts > 1:
        parts = -(-parts // ROW)
        fewer = wp.empty((values.shape[0], parts), dtype=wp.vec3d, device=device)
        wp.launch(kernels.add_moments, fewer.shape, [moments, ROW], [fewer], device=device)
        moments = fewer
    wp.launch(kernels.normalise, values.shape, [moments, values], device=device)


ROW = 64
"""Number of values that a thread adds up."""


# Public representations.

EventsLike: TypeAlias = Events | DeviceEvents | Sequence[Events] | Sequence[DeviceEvents]
"""Events of one recording, or of several."""


@guarded
def event_count(
    events: EventsLike,
    width: int,
    height: int,
    *,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[Any] | wp.array:
    """Count the events at each pixel.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or those of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, those of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Events per pixel, shape ``(height, width)``, int32. Compensated events are shared among the four nearest
        pixels by bilinear weights, as float32. A Warp array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.event_count(events, 3, 2)
    array([[0, 2, 0],
           [0, 0, 1]], dtype=int32)
    """
    batch = _batch(events, (width, height), windows, t_start, t_end, model, encoder, device)
    return batch.finish(_counted(batch, _Grid(*batch.size)).reshape((-1, height, width)))


@guarded
def polarity_histogram(
    events: EventsLike,
    width: int,
    height: int,
    *,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[Any] | wp.array:
    """Count the OFF and the ON events at each pixel.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or those of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, those of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        OFF, then ON events per pixel, shape ``(2, height, width)``, int32. Compensated events are shared among the
        four nearest pixels by bilinear weights, as float32. A Warp array on the same device for
        :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.polarity_histogram(events, 3, 2)[1]
    array([[0, 1, 0],
           [0, 0, 1]], dtype=int32)
    """
    batch = _batch(events, (width, height), windows, t_start, t_end, model, encoder, device)
    return batch.finish(_counted(batch, _Grid(*batch.size, layers=2)))


def _counted(batch: _Batch, grid: _Grid) -> wp.array:
    """Return the counts of all windows, shape (windows, layers, height, width)."""
    if not batch.events.whole_pixels:
        return _shares(batch, grid, 1)
    shape = grid.layers, grid.height, grid.width
    out = batch.empty(shape, wp.int32)
    for first, number, images in _counts(batch, grid):
        wp.copy(_part(out, first, number), images, count=number * math.prod(shape))
    return out


@guarded
def voxel_grid(
    events: EventsLike,
    width: int,
    height: int,
    bins: int,
    *,
    end_bin: bool = True,
    normalize: bool = False,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.float32] | wp.array:
    """Compute the voxel grid: the polarities of the events, shared linearly between time bins.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or those of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    bins : int
        Number of time bins.
    end_bin : bool, default True
        Put the first bin at the start and the last bin at the end of the window, so that there are ``bins - 1``
        intervals. Without it, there are ``bins`` intervals, and what belongs to the window's end is left out.
    normalize : bool, default False
        Shift and scale the elements of each window that are not 0 to a mean of 0 and a standard deviation of 1.
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, those of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Voxel grid, float32, shape ``(bins, height, width)``. A Warp array on the same device for
        :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Notes
    -----
    An event of polarity p (1 for ON, -1 for OFF) at time t adds ``p * max(0, 1 - abs(b - s))`` to bin b, with
    ``s = (bins - 1) * (t - t_start) / (t_end - t_start)`` [1]_. Compensated events are shared among the four nearest
    pixels, too. Each event is exact to 2**-23, and the sums do not depend on the device or the number of threads.

    References
    ----------
    .. [1] Zhu et al., "Unsupervised event-based learning of optical flow, depth, and egomotion", CVPR 2019.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.voxel_grid(events, 3, 2, bins=2)[:, 0, 1]
    array([-0.5,  0.5], dtype=float32)
    """
    bins = whole(bins, "bins", 1, MOST_BINS)
    batch = _batch(events, (width, height), windows, t_start, t_end, model, encoder, device)
    intervals = bins - 1 if end_bin else bins
    grid = _Grid(*batch.size, steps=max(intervals, 1), rate=intervals, off=-1)
    out = _shares(batch, grid, bins)
    if normalize and len(batch.windows):
        _normalise(out.reshape((len(batch.windows), -1)))
    return batch.finish(out)


@guarded
def stacked_histogram(
    events: EventsLike,
    width: int,
    height: int,
    bins: int,
    *,
    limit: int = 255,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.uint8] | wp.array:
    """Count the OFF and the ON events at each pixel in time bins, as bytes.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or those of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    bins : int
        Number of time bins of equal length.
    limit : int, default 255
        Largest count. Larger ones are clipped.
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, those of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Counts of the OFF events in each bin, then of the ON events, uint8, shape ``(2 * bins, height, width)``. A
        compensated event counts at its nearest pixel. A Warp array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Notes
    -----
    An event at time t is in bin ``floor(bins * (t - t_start) / (t_end - t_start))``; those at ``t_end`` are in the last
    bin. This is the input of RVT [1]_.

    References
    ----------
    .. [1] Gehrig and Scaramuzza, "Recurrent vision transformers for object detection with event cameras", CVPR 2023.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.stacked_histogram(events, 3, 2, bins=2)[:, 0, 1]
    array([1, 0, 0, 1], dtype=uint8)
    """
    bins = whole(bins, "bins", 1, MOST_BINS)
    limit = whole(limit, "limit", 1, 255)
    batch = _batch(events, (width, height), windows, t_start, t_end, model, encoder, device)
    grid = _Grid(*batch.size, steps=bins, rate=bins, layers=2)
    out = batch.empty((2 * bins, height, width), wp.uint8)
    length = width if batch.device.is_cpu else 1
    for first, number, images in _counts(batch, grid):
        part = _part(out, first, number)
        inputs = [images, _struct(kernels.Grid, *grid), limit, length]
        launch(kernels.clip_counts, part.size // length, inputs, [part], device=batch.device, smallest=SMALLEST)
    return batch.finish(out)


@guarded
def time_surface(
    events: EventsLike,
    width: int,
    height: int,
    tau_us: float,
    *,
    linear: bool = False,
    per_polarity: bool = True,
    carry: bool = False,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.float32] | wp.array:
    """Compute the time surface: how long ago the latest event was at each pixel, as a decay from 1 to 0.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or those of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    tau_us : float
        Time constant of the decay [us].
    linear : bool, default False
        Decay linearly to 0 within ``tau_us``, not exponentially.
    per_polarity : bool, default True
        Return separate images for OFF and ON.
    carry : bool, default False
        Use the latest times of earlier windows, too. The windows must then be of one recording and in order.
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, those of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Time surface, float32, shape ``(2, height, width)``: OFF, then ON. Without ``per_polarity``, shape
        ``(height, width)``. A compensated event is at its nearest pixel. A Warp array on the same device for
        :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Notes
    -----
    With the latest event at time t, a pixel is ``exp(-(t_end - t) / tau_us)`` [1]_, or
    ``max(0, 1 - (t_end - t) / tau_us)``; without events, it is 0. If t is after ``t_end``, it is 1.

    References
    ----------
    .. [1] Lagorce et al., "HOTS: a hierarchy of event-based time-surfaces for pattern recognition", TPAMI 2017.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.time_surface(events, 3, 2, tau_us=20, linear=True, per_polarity=False)[:, 1:]
    array([[0.5, 0. ],
           [0. , 1. ]], dtype=float32)
    """
    tau = real(tau_us, "tau_us", 1e-6, hint=" us")
    batch = _batch(events, (width, height), windows, t_start, t_end, model, encoder, device)
    grid = _Grid(*batch.size, layers=2 if per_polarity else 1)
    size = grid.layers * height * width
    out = batch.empty((grid.layers, height, width), wp.float32)
    if carry:
        _check_carry(events, batch.windows)
    for first, number, images in _latest(batch, grid, carry=carry):
        part = _part(out, first, number)
        ends = wp.array(batch.windows.t_end[first : first + number], dtype=wp.int64, device=batch.device)
        launch(kernels.decay_times, part.size, [images, ends, size, tau, int(linear)], [part], device=batch.device)
    return batch.finish(out if per_polarity else out.reshape((-1, height, width)))


@guarded
def latest_times(
    events: EventsLike,
    width: int,
    height: int,
    *,
    per_polarity: bool = True,
    carry: bool = False,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.int64] | wp.array:
    """Return the time of the latest event at each pixel: the surface of active events (SAE).

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or those of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    per_polarity : bool, default True
        Return separate images for OFF and ON.
    carry : bool, default False
        Use the latest times of earlier windows, too. The windows must then be of one recording and in order.
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, those of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Times [us], int64, shape ``(2, height, width)``: OFF, then ON. Without ``per_polarity``, shape
        ``(height, width)``. Pixels without events have the lowest value of int64. A compensated event is at its
        nearest pixel. A Warp array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.latest_times(events, 3, 2, per_polarity=False)[0, 1]
    np.int64(10)
    """
    batch = _batch(events, (width, height), windows, t_start, t_end, model, encoder, device)
    grid = _Grid(*batch.size, layers=2 if per_polarity else 1)
    out = batch.empty((grid.layers, height, width), wp.int64)
    if carry:
        _check_carry(events, batch.windows)
    for first, number, images in _latest(batch, grid, carry=carry):
        size = number * grid.layers * height * width
        wp.copy(_part(out, first, number), images, count=size)
    return batch.finish(out if per_polarity else out.reshape((-1, height, width)))


# Transforms with the call of other libraries.


class ToTensor:
    """Transform of events to a tensor, which calls one of the representations with fixed options.

    It is called with events, as the transforms of tonic are, or with a recording and its labels, as
    :class:`RecordedDataset` does. It can be pickled, for the worker processes of a ``DataLoader``.

    Parameters
    ----------
    representation : callable
        Function such as :func:`voxel_grid`.
    **options : object
        Arguments of the function by name. ``width`` and ``height`` may be left out for recordings, which also have the
        ``encoder`` that a ``model`` needs. ``windows`` may also be a function that is called with the events, such as
        ``functools.partial(amiwarp.windows, count=10_000)``.

    Raises
    ------
    AmiwarpError
        If the function has no parameter of a given name, or if a call lacks an option that the function needs.

    Examples
    --------
    >>> import numpy as np
    >>> to_grid = amiwarp.ToTensor(amiwarp.voxel_grid, width=4, height=3, bins=5)
    >>> rows = [(0, 1, 2, 1), (10, 3, 0, 0)]
    >>> events = np.array(rows, dtype=[("t", "i8"), ("x", "i2"), ("y", "i2"), ("p", "i1")])
    >>> to_grid(events).shape
    (5, 3, 4)
    """

    def __init__(self, representation: Callable[..., Any], **options: Any) -> None:
        if not callable(representation):
            raise AmiwarpError(f"representation is {shown(representation)}; give a function, such as voxel_grid")
        self.representation = representation
        self.options = options
        self._needed = self._check(options)

    def _check(self, options: dict[str, Any]) -> tuple[str, ...]:
        """Return the names that the function needs besides the events. Raises :class:`AmiwarpError` for others."""
        _, *known = inspect.signature(self.representation).parameters.values()
        if not any(p.kind is p.VAR_KEYWORD for p in known):
            check_names(options, [p.name for p in known], "option ")
        variable = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        return tuple(p.name for p in known if p.default is p.empty and p.kind not in variable)

    def __call__(self, events: Any, labels: Any = None, **more: Any) -> Any:
        """Return the tensor of events, or the tensor of a recording's events and the labels. ``more``: options."""
        options = self.options | more
        if more:
            self._check(more)
        if isinstance(events, Recording):
            source = events.events
            options = dict(zip(("width", "height"), source.size, strict=True)) | options
            if options.get("model") is not None:
                options.setdefault("encoder", events.encoder)
            events = source.slice(0, len(source))
        elif isinstance(events, np.ndarray) and events.dtype.names is not None:
            events = Events.from_structured(events)
        missing = [name for name in self._needed if name not in options]
        if missing:
            raise AmiwarpError(f"ToTensor has no {' and no '.join(missing)}; give the options by name, or a recording")
        if callable(options.get("windows")):
            options["windows"] = options["windows"](events)
        found = self.representation(events, **options)
        return found if labels is None else (found, labels)

    def __repr__(self) -> str:
        options = "".join(f", {name}={value!r}" for name, value in self.options.items())
        return f"ToTensor({getattr(self.representation, '__name__', self.representation)}{options})"
