"""Motion compensation of streams of events and encoder samples."""

from __future__ import annotations

import ctypes
import math
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents, check_sensor, limits, wait
from amiwarp.events.encoder import Encoder, EncoderStream, check_prisms
from amiwarp.events.recording import Events, held_bytes
from amiwarp.imaging.iwe import CanvasShape, Votes
from amiwarp.kernels.compensation import BLOCK, Columns, LaunchPlan
from amiwarp.kernels.events import flag_events
from amiwarp.kernels.launch import PageLockedPool, RecordedLaunch, background_worker, launch, pool
from amiwarp.kernels.packet_copy import FOUND, ROW, gather_parts
from amiwarp.kernels.prism_angle import EncoderParams, encoder_pieces, second_pieces
from amiwarp.optics.models import Model
from amiwarp.validation import TIME_LIMIT, guarded, whole

# Copying of packets into the columns of a batch: by NumPy, or by several threads of native code if the batch is long.

PIECE = 1 << 17
"""Number of events from which several threads copy a batch, and into which longer packets are cut."""
THREADS = 2
"""Number of threads that copy a long batch together with the calling thread."""
CALLER_SHARE = 8
"""Share of the packets that the calling thread copies: one packet in eight.

While its native code runs, the other threads can take Python's lock and start. Without packets to copy, the caller
would keep the lock, and the threads would start only once the caller waits for them.
"""
WIDTHS = (2, 2, 8, 1)
"""Bytes per event of x, y, t and p."""


class ColumnCheck(NamedTuple):
    """Properties of packets that are found while they are copied."""

    unsorted: bool
    """Whether the times decrease within any packet."""
    max_x: int
    """Largest x of all events [px]."""
    max_y: int
    """Largest y of all events [px]."""


def join_packets(parts: list[Events], to: list[NDArray[Any]]) -> ColumnCheck:
    """Copy packets into the columns x, y, t and, if it is given, p. Times must not decrease between packets."""
    for name, column in zip("xytp", to, strict=False):
        if len(parts) == 1:  # faster by 1 us for each column
            column[:] = getattr(parts[0], name)
        else:
            np.concatenate([getattr(part, name) for part in parts], out=column)
    x, y, t, *_ = to
    return ColumnCheck(bool((t[1:] < t[:-1]).any()), int(x.max()), int(y.max()))


class PacketCopier:
    """Does what :func:`join_packets` does by several threads, see :mod:`amiwarp.kernels.packet_copy`.

    Threads that call NumPy would wait for Python's lock at each column of each packet. One copy at a time.
    """

    def __init__(self) -> None:
        self._allocate(64)

    def _allocate(self, rows: int) -> None:
        """Allocate a table of copies with ``rows`` rows."""
        table = wp.zeros(rows * ROW, dtype=wp.uint64, device="cpu")
        found = wp.zeros(rows * FOUND, dtype=int, device="cpu")
        self._table, self._found = table.numpy().reshape(-1, ROW), found.numpy().reshape(-1, FOUND)
        self._commands = [RecordedLaunch(gather_parts, [table, found, 0], [], device="cpu") for _ in range(1 + THREADS)]

    def __call__(self, parts: list[Events], to: list[NDArray[Any]]) -> Callable[[], ColumnCheck]:
        """Start to copy packets; return a function that waits. Call it before the next copy."""
        rows = len(parts)
        if rows > len(self._table):
            self._allocate(2 * rows)
        sources = [_pointers([getattr(part, name) for part in parts]) for name in "xytp"[: len(to)]]
        counts = np.array([part.t.size for part in parts])
        offsets = np.concatenate([[0], np.cumsum(counts)[:-1]])
        table = self._table[:rows]
        table[:] = 0
        for k, (source, column, width) in enumerate(zip(sources, to, WIDTHS, strict=False)):
            table[:, k] = source[0]
            table[:, 4 + k] = _address(column) + width * offsets
        table[:, 8] = counts
        ours = rows // CALLER_SHARE
        edges = [0, *(ours + (rows - ours) * k // THREADS for k in range(THREADS + 1))]
        jobs = [pool().submit(self._commands[k], edges[k], edges[k + 1] - edges[k]) for k in range(1, THREADS + 1)]
        self._commands[0](0, ours)
        return partial(self._wait, jobs, rows, sources)

    def _wait(self, jobs: list[Future[None]], rows: int, _sources: object) -> ColumnCheck:
        """Wait for the copy of ``rows`` packets, whose columns live until then, because threads only have addresses."""
        for job in jobs:
            job.result()
        unsorted, max_x, max_y = self._found[:rows].max(axis=0).tolist()
        return ColumnCheck(bool(unsorted), max_x, max_y)


def _address(array: NDArray[Any]) -> int:
    """Return the address of an array's first value."""
    return int(array.__array_interface__["data"][0])


HEAD = object.__basicsize__
"""Place of the pointer to the values in NumPy's array object (``PyArrayObject_fields`` in its C interface) [bytes]."""


@cache
def layout_is_known() -> bool:
    """Return whether this NumPy keeps the pointer to an array's values at :data:`HEAD`."""
    probe = np.zeros(1)
    return bool(ctypes.c_uint64.from_address(id(probe) + HEAD).value == _address(probe))


def _pointers(arrays: list[NDArray[Any]]) -> tuple[NDArray[np.uint64], object]:
    """Return the addresses at which the pointers to the arrays' values are stored, and what must live until the copy.

    A batch of 104 packets has 416 arrays. NumPy's public interface needs 1 to 1.5 us for each, where native code reads
    the pointer out of the array object in 0.04 us: without that, a GPU compensates a quarter fewer events per second.
    """
    arrays = [array if array.flags.c_contiguous else np.ascontiguousarray(array) for array in arrays]
    if layout_is_known():
        return np.array(list(map(id, arrays)), np.uint64) + np.uint64(HEAD), arrays
    values = np.array([_address(array) for array in arrays], np.uint64)
    return np.uint64(_address(values)) + np.uint64(8) * np.arange(len(arrays), dtype=np.uint64), (values, arrays)


# Batches of a stream's events on a device: packets are joined, compensated, fetched and voted into an image.

ROUNDS = 4
"""Number of batches for which the buffers have room, because the votes of earlier batches may still be pending."""
LEAST_VOTED = 1 << 16
"""Number of pending events at which they are voted into the image."""
LEAST_PARALLEL = 4096
"""Number of blocks of events from which several CPU threads compensate them."""
LEAST_DIRECT = 1 << 16
"""Number of events from which a GPU writes its results directly to the arrays that the caller gets, not to the buffers.
"""
MOST_HELD = 16
"""Largest number of page-locked arrays of a type that a caller may keep. Locking the memory of one takes a millisecond,
and a batch needs five, while it is compensated in less than two."""
RESULTS = ("out_x", "out_y", "inside")
"""Names of the columns that the kernel writes."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StagedBatch:
    """Batch whose packets are being copied to the positions ``at`` to ``end`` of the buffers."""

    parts: list[Events]
    at: int
    end: int
    t: NDArray[np.int64]
    p: NDArray[np.uint8]
    arrived_us: int
    locked_t: wp.array | None
    """Page-locked array of ``t``; None if the times stay in the staging buffers."""
    wait: Callable[[], ColumnCheck]
    """Function that waits until the packets are copied, and returns the properties found while copying."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BatchInFlight:
    """Batch that a device works on, at the positions ``at`` to ``end`` of the buffers."""

    at: int
    end: int
    t: NDArray[np.int64]
    p: NDArray[np.uint8]
    unknown: int
    """Number of events at the start of the batch that have no prism angle."""
    arrived_us: int
    out: list[NDArray[Any]] | None
    """Arrays to which a GPU writes x, y and the inside flag; None if it writes to the buffers."""
    done: Any
    """Event that marks the end of the device's work (``wp.Event``) on CUDA, else None."""


class BatchPipeline:
    """Buffers for the compensation of a stream, allocated once, and the steps of a batch.

    A batch is staged (:meth:`stage`), submitted to the device (:meth:`submit`) and fetched (:meth:`finish`). Use one
    pipeline from one thread only.
    """

    def __init__(self, model: Model, batch: int, device: Any) -> None:
        """Allocate the buffers for batches of at most ``batch`` events."""
        self._device, self._batch, self._at = device, batch, 0
        self._pool = PageLockedPool(most=MOST_HELD)
        self._encoder: Any = None
        self._unvoted: list[tuple[int, int]] = []  # ranges of the buffers
        self._voting: deque[tuple[int, int, Future[None]]] = deque()
        self._plan = LaunchPlan(model, device)
        self._block = int(BLOCK) if device.is_cpu else 1  # number of events that are voted together
        self._room = ROUNDS * self._padded(batch)
        dtypes = {"x": wp.uint16, "y": wp.uint16, "t": wp.int64, "out_x": float, "out_y": float, "inside": wp.uint8}
        columns = self._columns = Columns()
        for name, dtype in dtypes.items():
            setattr(columns, name, wp.zeros(self._room, dtype=dtype, device=device))
        self._host_columns = columns if device.is_cpu else Columns()
        if not device.is_cpu:
            for name, dtype in dtypes.items():
                setattr(self._host_columns, name, self._pool.array(self, (self._room,), dtype))
        self._host = {name: getattr(self._host_columns, name).numpy() for name in dtypes}
        self._layer = wp.zeros(self._room, dtype=wp.uint8, device=device)
        self._recorded: dict[bool, RecordedLaunch] = {}
        # two, because the first may still copy the previous batch
        self._copiers = [PacketCopier(), PacketCopier()] if batch > PIECE else []
        self._votes = Votes(CanvasShape(*self._plan.size), device)
        self._vote_range = self._votes.range_voter(columns.out_x, columns.out_y, self._layer)
        if device.is_cuda and batch > LEAST_DIRECT:
            # for the batches in flight, and as many again that the caller holds
            self._pool.fill(batch, [wp.int64] * 2 * ROUNDS + [wp.float32, wp.uint8] * 4 * ROUNDS)

    def set_encoder(self, encoder: Encoder, first: int, last: int) -> None:
        """Copy the encoder's pieces over a span of event times [us] to the device, and those of a second encoder.

        All pieces go into one bucket, which the kernel searches for an event's piece, because they are few.
        """
        origin, *pieces = encoder_pieces(encoder, first, last)
        p = self._encoder
        if p is None:
            p = self._encoder = EncoderParams()
            p.shift = 62
        p.origin = origin
        self._set_pieces("", pieces)
        if encoder.second is not None:
            self._set_pieces("second_", second_pieces(encoder.second, first, last, origin))
        for command in self._recorded.values():
            command.set(3, p)

    def _set_pieces(self, prefix: str, pieces: Iterable[NDArray[Any]]) -> None:
        """Copy starts, angles and slopes to the arrays of the encoder whose names have a prefix."""
        start, angle, slope = pieces
        n, p = len(start), self._encoder
        if n > len(getattr(p, f"{prefix}start") or ()):
            setattr(p, f"{prefix}first", wp.zeros(2, dtype=int, device=self._device))
            for name, dtype in (("start", wp.int64), ("angle", wp.uint64), ("slope", wp.uint64)):
                setattr(p, prefix + name, wp.zeros(max(2 * n, 64), dtype=dtype, device=self._device))
        given = {"first": np.array([0, n - 1], np.int32), "start": start, "angle": angle, "slope": slope}
        for name, values in given.items():
            to = getattr(p, prefix + name)
            if self._device.is_cpu:
                to.numpy()[: len(values)] = values
            else:
                wp.copy(to, wp.array(values, dtype=to.dtype, device="cpu", copy=False), count=len(values))

    def _padded(self, n: int) -> int:
        """Return the length of the range of the buffers that ``n`` events take."""
        return -(-n // self._block) * self._block

    def stage(self, parts: list[Events], arrived_us: int) -> StagedBatch:
        """Start to copy packets into the buffers; long packets are copied by several threads."""
        n, several = sum(part.t.size for part in parts), len(parts) > 1
        at, end = self._reserve(n)
        direct, p = self._device.is_cuda and n > LEAST_DIRECT, parts[0].p
        locked_t, t = self._pool.result(self._batch, n, wp.int64) if direct else (None, self._host["t"][at:end])
        to = [self._host["x"][at:end], self._host["y"][at:end], t]
        if several:
            p = self._pool.result(self._batch, n, wp.uint8)[1] if direct else np.empty(n, np.uint8)
            to.append(p)
        if n > PIECE:
            self._copiers.reverse()
            wait = self._copiers[0](parts, to)
        else:
            wait = partial(ColumnCheck, *join_packets(parts, to))
        return StagedBatch(parts=parts, at=at, end=end, t=t, p=p, arrived_us=arrived_us, locked_t=locked_t, wait=wait)

    def _reserve(self, n: int) -> tuple[int, int]:
        """Return start and end of a free range of ``n`` events of the buffers; wait for votes that still use it."""
        padded = self._padded(n)
        if self._at + padded > self._room:
            self._at = 0
        at = self._at
        self._at += padded
        overlap = any(start < self._at and stop > at for start, stop in self._unvoted)
        self._vote(least=1 if overlap else LEAST_VOTED)
        self._wait_for_votes(at, self._at)
        return at, at + n

    def submit(self, staged: StagedBatch, unknown: int) -> BatchInFlight:
        """Send a batch to the device; its first ``unknown`` events have no prism angle and get no coordinates.

        Raises :class:`AmiwarpError` if a packet is not sorted.
        """
        s, check = staged, staged.wait()
        at, end, n = s.at, s.end, s.end - s.at
        if check.unsorted:
            raise AmiwarpError(
                f"events of {s.parts[0].t[0]} to {s.parts[-1].t[-1]} us are not sorted; sort each packet by time"
            )
        if self._device.is_cuda:
            self._copy(self._columns, self._host_columns, "xyt" if s.locked_t is None else "xy", at, end)
            if s.locked_t is not None:
                wp.copy(self._columns.t, s.locked_t, dest_offset=at, count=n)
        padded = self._padded(n)
        if unknown < n:
            # the kernel also compensates the padding of the last block, so that must hold valid events
            for name, value in (("x", 0), ("y", 0), ("t", s.t[-1])):
                self._host[name][end : at + padded] = value
            outside = self._plan.any_outside(check.max_x, check.max_y)
            self._launch(at // self._plan.block, padded // self._plan.block, outside)
        self._invalidate(at, at + unknown)
        self._invalidate(end, at + padded)
        self._unvoted.append((at, at + padded))
        out, done = None, None
        if self._device.is_cuda:
            out = self._copy_back(at, end, s.locked_t is not None)
            done = self._device.stream.record_event()
        self._vote(least=LEAST_VOTED)
        t = s.t if s.locked_t is not None else s.t.copy() if len(s.parts) > 1 else s.parts[0].t
        return BatchInFlight(at=at, end=end, t=t, p=s.p, unknown=unknown, arrived_us=s.arrived_us, out=out, done=done)

    def finish(self, in_flight: BatchInFlight) -> list[NDArray[Any]]:
        """Wait for a batch; return its x and y [px], and 1 for each event outside the image."""
        if in_flight.done is not None:
            wp.synchronize_event(in_flight.done)
        if in_flight.out is None:
            x, y, inside = (self._host[name][in_flight.at : in_flight.end].copy() for name in RESULTS)
        else:
            x, y, inside = in_flight.out
        return [x, y, np.bitwise_xor(inside, np.uint8(1), out=inside)]

    def run_on_device(
        self, events: DeviceEvents, unknown: int, extrapolated: NDArray[np.bool_] | None
    ) -> tuple[wp.array, wp.array, wp.array]:
        """Compensate and vote a packet on the device; return new arrays x, y [px] and flags.

        Its first ``unknown`` events get no coordinates. ``extrapolated`` marks events with an extrapolated angle.
        """
        self._wait_for_votes(0, self._room)
        n, device = len(events), self._device
        _, _, max_x, max_y, _, _ = limits(events)
        if unknown < n:
            c = self._plan.run(self._plan.device_columns(events), self._encoder, max_x, max_y)
            x, y, inside = c.out_x[:n], c.out_y[:n], c.inside[:n]
        else:
            x, y = (wp.empty(n, dtype=float, device=device) for _ in range(2))
            inside = wp.zeros(n, dtype=wp.uint8, device=device)
        for values in (x, y) if unknown else ():
            values[:unknown].fill_(float("nan"))
        marks = np.zeros(0, np.uint8) if extrapolated is None else extrapolated.view(np.uint8)
        flags = wp.empty(n, dtype=wp.uint8, device=device)
        inputs = [inside, wp.array(marks, dtype=wp.uint8, device=device), unknown]
        wp.launch(flag_events, n, inputs=inputs, outputs=[flags], device=device)
        self._votes.add_points(x, y, wp.zeros(n, dtype=wp.uint8, device=device))
        return x, y, flags

    def _copy_back(self, at: int, end: int, direct: bool) -> list[NDArray[Any]] | None:
        """Start to copy results from a GPU: to the buffers, or, if ``direct`` is given, to arrays for the caller."""
        if not direct:
            self._copy(self._host_columns, self._columns, RESULTS, at, end)
            return None
        views = []
        for name in RESULTS:
            column = getattr(self._columns, name)
            array, view = self._pool.result(self._batch, end - at, column.dtype)
            wp.copy(array, column, src_offset=at, count=end - at)
            views.append(view)
        return views

    def _copy(self, to: Any, source: Any, names: Iterable[str], at: int, end: int) -> None:
        for name in names:
            columns = getattr(to, name), getattr(source, name)
            wp.copy(*columns, dest_offset=at, src_offset=at, count=end - at)

    def _launch(self, first: int, blocks: int, outside: bool) -> None:
        kernel, inputs = self._plan.kernel, self._plan.inputs(self._encoder, self._columns, outside=outside)
        if self._device.is_cpu and blocks >= LEAST_PARALLEL:
            launch(kernel, blocks, inputs, [], device=self._device, first=first, smallest=LEAST_PARALLEL // 2)
            return
        command = self._recorded.get(outside)
        if command is None:
            command = self._recorded[outside] = RecordedLaunch(kernel, [*inputs, 0], [], device=self._device)
        command(first, blocks)

    def _invalidate(self, start: int, stop: int) -> None:
        """Set the coordinates of a range of events to NaN."""
        if start >= stop:
            return
        for name in ("out_x", "out_y"):
            if self._device.is_cpu:
                self._host[name][start:stop] = np.nan
            else:
                getattr(self._columns, name)[start:stop].fill_(float("nan"))

    def _vote(self, *, least: int) -> None:
        """Vote pending events if at least ``least`` are waiting. On CPUs one background thread votes, in order."""
        if sum(stop - start for start, stop in self._unvoted) < least:
            return
        for start, stop in _joined(self._unvoted):
            blocks = start // self._block, (stop - start) // self._block
            if self._device.is_cpu:
                self._voting.append((start, stop, background_worker().submit(self._vote_range, *blocks)))
            else:
                self._vote_range(*blocks)
        self._unvoted.clear()

    def _wait_for_votes(self, start: int, stop: int) -> None:
        """Wait until no vote uses a range of the buffers."""
        while any(begin < stop and end > start for begin, end, _ in self._voting):
            self._voting.popleft()[2].result()

    def image(self) -> NDArray[np.float32]:
        """Return the image of the events since the last call, shape (height, width)."""
        self._vote(least=1)
        self._wait_for_votes(0, self._room)
        return self._votes.take()[0]

    def image_on_device(self) -> wp.array:
        """Return the image as a finished Warp array, see :meth:`image`."""
        self._vote(least=1)
        self._wait_for_votes(0, self._room)
        image = self._votes.take_on_device()[0]
        wait(self._device)
        return image


def _joined(ranges: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Join index ranges that follow one another."""
    out: list[tuple[int, int]] = []
    for start, stop in ranges:
        if out and out[-1][1] == start:
            out[-1] = (out[-1][0], stop)
        else:
            out.append((start, stop))
    return out


OUTSIDE, EXTRAPOLATED, NO_ANGLE = 1, 2, 4
"""Flags of a compensated event. The flags of an event are added.

OUTSIDE: the coordinates are outside the image. EXTRAPOLATED: no encoder sample arrived in time, so the prism angle is
extrapolated at constant speed. NO_ANGLE: no prism angle is known, so the coordinates are NaN.
"""
LEAST_RETURNED = 2
"""Number of finished batches after which :meth:`Compensator.take` no longer waits for batches that a GPU still
computes. The next call returns those."""
AHEAD_US = 100_000
"""Span of encoder samples that is copied to the device at once, if the samples are available [us]."""
QueuedPacket: TypeAlias = tuple[Events | DeviceEvents, int, int, int]
"""Queued packet, its last event time, the time when it was queued, and its time of arrival [us]."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Compensated:
    """Compensated events of one packet, or of several that were ready together.

    Examples
    --------
    >>> camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    >>> model = amiwarp.CircleModel.from_prism(camera, amiwarp.Prism(0.02), 0.3)
    >>> compensator = amiwarp.Compensator(model, amiwarp.EncoderStream(), start_us=0)
    >>> compensator.put(amiwarp.Events.from_arrays([10], [20], [0], [1]), now_us=0)
    >>> [packet] = compensator.take(now_us=0)
    >>> packet.flags  # outside the image, because no prism angle is known
    array([5], dtype=uint8)
    """

    events: Events
    """Compensated events: coordinates without the prism, float32 [px], NaN if there are none. Times and polarities are
    unchanged."""
    flags: NDArray[np.uint8]
    """Sum of :data:`OUTSIDE`, :data:`EXTRAPOLATED` and :data:`NO_ANGLE` for each event, shape ``(n,)``."""
    arrived_us: int = 0
    """Arrival time of the first packet of these events, by the caller's clock [us]."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class DeviceCompensated:
    """Compensated events of one packet on a device.

    Examples
    --------
    >>> camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    >>> model = amiwarp.CircleModel.from_prism(camera, amiwarp.Prism(0.02), 0.3)
    >>> compensator = amiwarp.Compensator(model, amiwarp.EncoderStream(), start_us=0)
    >>> compensator.put(amiwarp.Events.from_arrays([10], [20], [0], [1]), now_us=0)
    >>> [packet] = compensator.take_on_device(now_us=0)
    >>> packet.flags.numpy()  # outside the image, because no prism angle is known
    array([5], dtype=uint8)
    """

    events: DeviceEvents
    """Coordinates without the prism, float32 [px], NaN if there are none; times and polarities are unchanged."""
    flags: wp.array
    """Sum of :data:`OUTSIDE`, :data:`EXTRAPOLATED` and :data:`NO_ANGLE` for each event, uint8, shape ``(n,)``."""
    arrived_us: int = 0
    """Arrival time of the packet, by the caller's clock [us]."""


@guarded
class Compensator:
    """Motion compensation of a stream: put packets as they arrive, take those that are ready.

    A packet waits until the encoder samples cover it. If it has waited for too long, or if too much waits, its prism
    angles are extrapolated and flagged. Every event comes out exactly once, in the order of input. Buffers are
    allocated once. Use one compensator from one thread only.

    Parameters
    ----------
    model : Model
        Optical model of the prism.
    encoder : EncoderStream
        Encoder samples; the caller appends to it. A pair of prisms and a mirror need a second encoder, or the ratio of
        the speeds.
    wait_us : int, optional
        Longest wait of a packet, by the caller's clock [us].
    start_us : int, optional
        The same while fewer than two encoder samples have arrived [us].
    most_waiting : int, optional
        Largest number of events that wait.
    most_bytes : int, optional
        Largest memory of waiting packets [bytes].
    batch : int, optional
        Largest number of events compensated at a time. By default 65,536 on a CPU and 1,048,576 on CUDA.
    device : str or warp.Device, optional
        Device to compute on.

    Raises
    ------
    AmiwarpError
        If a number is out of range, or the encoder is not that of a model with as many angles.

    Examples
    --------
    >>> camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    >>> model = amiwarp.CircleModel.from_prism(camera, amiwarp.Prism(0.02), 0.3)
    >>> encoder = amiwarp.EncoderStream()
    >>> compensator = amiwarp.Compensator(model, encoder)
    >>> compensator.put(amiwarp.Events.from_arrays([10, 20], [20, 20], [100, 900], [1, 0]), now_us=0)
    >>> len(compensator.take(now_us=0))  # the packet waits for encoder samples
    0
    >>> _ = encoder.append([0, 1000], [0.0, 0.0754])
    >>> [packet] = compensator.take(now_us=500)
    >>> packet.events.t, packet.flags
    (array([100, 900]), array([0, 0], dtype=uint8))
    """

    def __init__(
        self,
        model: Model,
        encoder: EncoderStream,
        *,
        wait_us: int = 10_000,
        start_us: int = 5_000_000,
        most_waiting: int = 1 << 24,
        most_bytes: int = 1 << 28,
        batch: int | None = None,
        device: Any = "cpu",
    ) -> None:
        check_prisms(encoder, model.ANGLES)
        self.encoder = encoder
        self.wait_us = whole(wait_us, "wait_us", 0, TIME_LIMIT >> 1, " us")  # less than in flush
        self.start_us = whole(start_us, "start_us", 0, TIME_LIMIT >> 1, " us")
        self.most_waiting = whole(most_waiting, "most_waiting", 0, TIME_LIMIT, " events")
        self.most_bytes = whole(most_bytes, "most_bytes", 0, TIME_LIMIT, " bytes")
        self._device = wp.get_device(device)
        batch = (1 << 16 if self._device.is_cpu else 1 << 20) if batch is None else batch
        self.batch = whole(batch, "batch", 1, 1 << 28, " events")
        self._pipeline = BatchPipeline(model, self.batch, self._device)
        self._least_returned = LEAST_RETURNED if self._device.is_cuda else math.inf
        self._queue: deque[QueuedPacket] = deque()
        self.waiting = 0
        """Number of events in the queue, which wait for encoder samples."""
        self.waiting_bytes = 0
        """Memory of the packets in the queue [bytes], as computed by :func:`held_bytes`."""
        self._staged: StagedBatch | None = None
        self._in_flight: tuple[BatchInFlight, NDArray[np.bool_] | None] | None = None
        self._t_last = -(2**62)
        self._covered: tuple[int, int] | None = None
        self._cleared = encoder.cleared

    def put(self, events: Events | DeviceEvents, now_us: int, *, arrived_us: int | None = None) -> None:
        """Queue a packet. The packet is kept, not copied.

        Parameters
        ----------
        events : Events or DeviceEvents
            Events with whole pixel coordinates (uint16), sorted by time, not earlier than those before.
        now_us : int
            Current time of the caller's clock [us], from which the packet waits.
        arrived_us : int, optional
            Arrival time of the packet for :attr:`Compensated.arrived_us`, if it is earlier than ``now_us`` [us].

        Raises
        ------
        AmiwarpError
            If the coordinates are not whole pixels, or the packet starts before the end of the last. Nothing is queued
            then.
        """
        check_sensor(events)
        arrived = now_us if arrived_us is None else arrived_us
        if isinstance(events, DeviceEvents):
            self._put_on_device(events, now_us, arrived)
            return
        t = events.t
        if not t.size:
            return
        if t.item(0) < self._t_last:
            raise AmiwarpError(
                f"a packet starts at {t[0]} us, the previous one ended at {self._t_last} us; sort the packets by time"
            )
        parts, most = [events], min(self.batch, PIECE)
        if t.size > most:
            if (t[most::most] < t[most - 1 : -1 : most]).any():
                raise AmiwarpError(f"events of {t[0]} to {t[-1]} us are not sorted; sort each packet")
            parts = [events[start : start + most] for start in range(0, t.size, most)]
        self._t_last = t.item(-1)
        self.waiting += t.size
        self.waiting_bytes += sum(map(held_bytes, parts))
        self._queue.extend((part, part.t.item(-1), now_us, arrived) for part in parts)

    def _put_on_device(self, events: DeviceEvents, now_us: int, arrived_us: int) -> None:
        """Queue a packet on a device."""
        if not len(events):
            return
        first, last, _, _, _, decreases = limits(events)
        if first < self._t_last or decreases:
            raise AmiwarpError(
                f"events of {first} to {last} us are not sorted, or start before {self._t_last} us; sort them"
            )
        self._t_last = last
        self.waiting += len(events)
        for start in range(0, len(events), self.batch):
            part = events[start : start + self.batch]
            self.waiting_bytes += held_bytes(part)
            self._queue.append((part, part.t_last, now_us, arrived_us))

    def take(self, now_us: int) -> list[Compensated]:
        """Return the compensated events that are ready.

        Packets that are ready together are joined to a batch. After several batches, a GPU may still work on the last
        ones; they are returned by the next call, or by :meth:`flush`.

        Parameters
        ----------
        now_us : int
            Current time of the caller's clock [us].

        Returns
        -------
        list of Compensated
            Compensated events, in the order of input.

        Raises
        ------
        AmiwarpError
            If a packet is not sorted. The batches that were ready or in flight are lost.
        """
        out: list[Compensated] = []
        while True:
            # three batches overlap: one is copied to the buffers, a GPU computes the second, the third is fetched
            packets = self._pop_ready(now_us)
            if not packets and len(out) >= self._least_returned:
                return out
            staged, self._staged = self._staged, self._stage(packets) if packets else None
            in_flight, self._in_flight = self._in_flight, None
            if staged is not None:
                self._in_flight = self._submit(staged)
            if in_flight is not None:
                out.append(self._finish(*in_flight))
            if self._staged is None and self._in_flight is None:
                return out

    def take_on_device(self, now_us: int) -> list[DeviceCompensated]:
        """Return the compensated events that are ready, on the device.

        Use either this method or :meth:`take` for a stream. Packets are not joined. Those on the device are not copied;
        others are copied to it.

        Parameters
        ----------
        now_us : int
            Current time of the caller's clock [us]. At the end of a stream, ``2**62`` returns everything that waits.

        Returns
        -------
        list of DeviceCompensated
            Compensated events, in the order of input.

        Raises
        ------
        AmiwarpError
            If :meth:`take` has left a batch in flight.
        """
        if self._staged is not None or self._in_flight is not None:
            raise AmiwarpError("take has left a batch in flight; use either take or take_on_device")
        out: list[DeviceCompensated] = []
        while packets := self._pop_ready(now_us):
            out += [self._compensate_on_device(events, arrived) for events, _, _, arrived in packets]
        wait(self._device)
        return out

    def flush(self) -> list[Compensated]:
        """Return all events that still wait, with extrapolated prism angles if necessary.

        Call it at the end of a stream.

        Returns
        -------
        list of Compensated
            Compensated events, in the order of input.
        """
        out: list[Compensated] = []
        while more := self.take(2**62):
            out += more
        return out

    def image(self) -> NDArray[np.float32]:
        """Return the image of all events that were compensated since the last call.

        Returns
        -------
        ndarray
            Events per pixel, float32, shape ``(height, width)``.
        """
        return self._pipeline.image()

    def image_on_device(self) -> wp.array:
        """Return the image of all events that were compensated since the last call, on the device.

        Returns
        -------
        warp.array
            Events per pixel, float32, shape ``(height, width)``.
        """
        return self._pipeline.image_on_device()

    def _pop_ready(self, now_us: int) -> list[QueuedPacket]:
        """Remove the next batch from the queue: packets that encoder samples cover or that waited too long."""
        packets: list[QueuedPacket] = []
        count, covered = 0, self.encoder.last
        patience = self.start_us if covered is None else self.wait_us
        while self._queue:
            events, last, put_us, _ = self._queue[0]
            full = self.waiting > self.most_waiting or self.waiting_bytes > self.most_bytes
            n, overdue = events.t.size, full or now_us - put_us >= patience
            if count + n > self.batch or not (overdue or (covered is not None and last <= covered)):
                break
            packets.append(self._queue.popleft())
            count += n
            self.waiting -= n
            self.waiting_bytes -= held_bytes(events)
        return packets

    def _stage(self, packets: list[QueuedPacket]) -> StagedBatch:
        parts = [part.to_host() if isinstance(part, DeviceEvents) else part for part, *_ in packets]
        return self._pipeline.stage(parts, packets[0][3])

    def _submit(self, staged: StagedBatch) -> tuple[BatchInFlight, NDArray[np.bool_] | None]:
        """Submit a batch; return also which of its events have an extrapolated angle, or None if none has."""
        parts = staged.parts
        first, last = int(parts[0].t[0]), int(parts[-1].t[-1])
        unknown = self._prepare_encoder(first, last, [part.t for part in parts])
        in_flight = self._pipeline.submit(staged, unknown)
        return in_flight, None if self.encoder.knows(first, last) else self.encoder.guessed(in_flight.t)

    def _compensate_on_device(self, events: Events | DeviceEvents, arrived_us: int) -> DeviceCompensated:
        """Compensate a packet on the device."""
        if not isinstance(events, DeviceEvents) or events.device != self._device:
            events = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=self._device)
        first, last = events.t_first, events.t_last
        first_known = self.encoder.first
        some_unknown = first_known is None or first < first_known
        known = self.encoder.knows(first, last)
        t = [events.t.numpy()] if some_unknown or not known else []  # copied to the host only if an angle is missing
        unknown = self._prepare_encoder(first, last, t)
        x, y, flags = self._pipeline.run_on_device(events, unknown, None if known else self.encoder.guessed(t[0]))
        return DeviceCompensated(DeviceEvents(x, y, events.t, events.p), flags, arrived_us)

    def _prepare_encoder(self, first: int, last: int, times: list[NDArray[np.int64]]) -> int:
        """Copy the encoder over a span of event times [us] to the device; return how many events have no angle.

        ``times`` are the times of the events; they are used only if the first has none.
        """
        first_known, last_known = self.encoder.first, self.encoder.last
        n = sum(t.size for t in times)
        if first_known is None or last_known is None:
            return n
        unknown = 0 if first >= first_known else sum(int(np.searchsorted(t, first_known)) for t in times)
        if unknown < n or not n:
            self._set_encoder(max(first, first_known), last, last_known)
        return unknown

    def _finish(self, in_flight: BatchInFlight, extrapolated: NDArray[np.bool_] | None) -> Compensated:
        x, y, flags = self._pipeline.finish(in_flight)
        if extrapolated is not None:
            flags[extrapolated] |= EXTRAPOLATED
        flags[: in_flight.unknown] = OUTSIDE | NO_ANGLE
        return Compensated(Events(x, y, in_flight.t, in_flight.p), flags, in_flight.arrived_us)

    def _set_encoder(self, first: int, last: int, last_known: int) -> None:
        """Copy the encoder's samples over a span of event times [us] to the device, unless it has them already."""
        if self._cleared != self.encoder.cleared:  # the samples on the device were on another clock
            self._cleared, self._covered = self.encoder.cleared, None
        if self._covered is None or first < self._covered[0] or last > self._covered[1]:
            until = max(last, min(last_known, last + AHEAD_US))
            self._pipeline.set_encoder(self.encoder.over(first, until), first, until)
            # angles past the last sample are extrapolated; newer samples may cover them next time
            self._covered = (first, until) if until <= last_known else None
