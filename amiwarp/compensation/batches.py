"""Batches of a stream's events on a device: packets are joined, compensated, fetched and voted into an image."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.compensation.packet_copy import PIECE, ColumnCheck, PacketCopier, join_packets
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents, limits, wait
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.votes import Votes
from amiwarp.kernels.compensation import BLOCK, Columns, LaunchPlan
from amiwarp.kernels.encoder_pieces import encoder_pieces, second_pieces
from amiwarp.kernels.events import flag_events
from amiwarp.kernels.launch import RecordedLaunch, launch
from amiwarp.kernels.page_locked_memory import PageLockedPool
from amiwarp.kernels.prism_angle import EncoderParams
from amiwarp.kernels.workers import background_worker
from amiwarp.optics.models.base import Model

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
COLUMN_TYPES: dict[str, Any] = {
    "x": wp.uint16,
    "y": wp.uint16,
    "t": wp.int64,
    "out_x": float,
    "out_y": float,
    "inside": wp.uint8,
}
"""Types of the columns of the buffers."""
RESULTS = ("out_x", "out_y", "inside")
"""Names of the columns that the kernel writes."""
ONE_BUCKET = 62
"""Number of bits of a time that do not tell its bucket: all, so that there is one bucket."""


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
        self._device = device
        self._batch = batch
        self._at = 0
        self._pool = PageLockedPool(most=MOST_HELD)
        self._encoder: Any = None
        # Ranges of the buffers whose events are not voted yet, and ranges that a thread votes.
        self._unvoted: list[tuple[int, int]] = []
        self._voting: deque[tuple[int, int, Future[None]]] = deque()
        self._plan = LaunchPlan(model, device)
        self._block = int(BLOCK) if device.is_cpu else 1  # number of events that are voted together
        self._room = ROUNDS * self._padded(batch)

        self._columns = Columns()
        for name, dtype in COLUMN_TYPES.items():
            column = wp.zeros(self._room, dtype=dtype, device=device)
            setattr(self._columns, name, column)
        if device.is_cpu:
            self._host_columns = self._columns
        else:
            self._host_columns = Columns()
            for name, dtype in COLUMN_TYPES.items():
                column = self._pool.array(self, (self._room,), dtype)
                setattr(self._host_columns, name, column)
        self._host = {}
        for name in COLUMN_TYPES:
            column = getattr(self._host_columns, name)
            self._host[name] = column.numpy()

        self._recorded: dict[bool, RecordedLaunch] = {}
        # Two, because the first may still copy the previous batch.
        self._copiers = [PacketCopier(), PacketCopier()] if batch > PIECE else []
        self._votes = Votes(CanvasShape(*self._plan.size), device)
        self._layer = wp.zeros(self._room, dtype=wp.uint8, device=device)
        self._vote_range = self._votes.range_voter(
            self._columns.out_x, self._columns.out_y, self._layer
        )
        if device.is_cuda and batch > LEAST_DIRECT:
            # For the batches in flight, and as many again that the caller holds.
            batches = 2 * ROUNDS
            times = [wp.int64] * batches
            results = [wp.float32, wp.uint8] * 2 * batches  # x and y; polarities and flags
            self._pool.fill(batch, times + results)

    def set_encoder(self, encoder: Encoder, first: int, last: int) -> None:
        """Copy the pieces of the encoder, and of a second one, over a span of event times [us] to the device.

        All pieces go into one bucket, which the kernel searches for an event's piece, because they are few.
        """
        origin, *pieces = encoder_pieces(encoder, first, last)
        if self._encoder is None:
            self._encoder = EncoderParams()
            self._encoder.shift = ONE_BUCKET
        self._encoder.origin = origin
        self._set_pieces("", pieces)
        if encoder.second is not None:
            self._set_pieces("second_", second_pieces(encoder.second, first, last, origin))
        for command in self._recorded.values():
            command.set(3, self._encoder)

    def _set_pieces(self, prefix: str, pieces: Iterable[NDArray[Any]]) -> None:
        """Copy starts, angles and slopes to the arrays of the encoder whose names have a prefix."""
        start, angle, slope = pieces
        count = len(start)
        params = self._encoder
        if count > len(getattr(params, f"{prefix}start") or ()):
            capacity = max(2 * count, 64)
            larger = {
                "first": wp.zeros(2, dtype=int, device=self._device),
                "start": wp.zeros(capacity, dtype=wp.int64, device=self._device),
                "angle": wp.zeros(capacity, dtype=wp.uint64, device=self._device),
                "slope": wp.zeros(capacity, dtype=wp.uint64, device=self._device),
            }
            for name, values in larger.items():
                setattr(params, prefix + name, values)
        first = np.array([0, count - 1], np.int32)
        columns = {"first": first, "start": start, "angle": angle, "slope": slope}
        for name, values in columns.items():
            target = getattr(params, prefix + name)
            if self._device.is_cpu:
                target.numpy()[: len(values)] = values
            else:
                on_host = wp.array(values, dtype=target.dtype, device="cpu", copy=False)
                wp.copy(target, on_host, count=len(values))

    def _padded(self, n: int) -> int:
        """Return the length of the range of the buffers that ``n`` events take."""
        return -(-n // self._block) * self._block

    def stage(self, parts: list[Events], arrived_us: int) -> StagedBatch:
        """Start to copy packets into the buffers; long packets are copied by several threads."""
        n = sum(part.t.size for part in parts)
        start, end = self._reserve(n)
        direct = self._device.is_cuda and n > LEAST_DIRECT
        if direct:
            locked_t, t = self._pool.result(self._batch, n, wp.int64)
        else:
            locked_t = None
            t = self._host["t"][start:end]
        targets = [self._host["x"][start:end], self._host["y"][start:end], t]
        if len(parts) == 1:
            p = parts[0].p
        else:
            if direct:
                _, p = self._pool.result(self._batch, n, wp.uint8)
            else:
                p = np.empty(n, np.uint8)
            targets.append(p)
        if n > PIECE:
            self._copiers.reverse()
            wait = self._copiers[0](parts, targets)
        else:
            wait = partial(ColumnCheck, *join_packets(parts, targets))
        return StagedBatch(
            parts=parts,
            at=start,
            end=end,
            t=t,
            p=p,
            arrived_us=arrived_us,
            locked_t=locked_t,
            wait=wait,
        )

    def _reserve(self, n: int) -> tuple[int, int]:
        """Return start and end of a free range of ``n`` events of the buffers; wait for votes that still use it."""
        padded = self._padded(n)
        if self._at + padded > self._room:
            self._at = 0
        position = self._at
        self._at += padded
        overlap = any(start < self._at and stop > position for start, stop in self._unvoted)
        self._vote(least=1 if overlap else LEAST_VOTED)
        self._wait_for_votes(position, self._at)
        return position, position + n

    def submit(self, staged: StagedBatch, unknown: int) -> BatchInFlight:
        """Send a batch to the device; its first ``unknown`` events have no prism angle and get no coordinates.

        Raises :class:`AmiwarpError` if a packet is not sorted.
        """
        check = staged.wait()
        parts = staged.parts
        locked_t = staged.locked_t
        start = staged.at
        end = staged.end
        count = end - start
        if check.unsorted:
            raise AmiwarpError(
                f"events of {parts[0].t[0]} to {parts[-1].t[-1]} us are not sorted; sort each packet by time"
            )
        if self._device.is_cuda:
            staged_names = ("x", "y", "t") if locked_t is None else ("x", "y")
            self._copy(self._columns, self._host_columns, staged_names, start, end)
            if locked_t is not None:
                wp.copy(self._columns.t, locked_t, dest_offset=start, count=count)

        padded_end = start + self._padded(count)
        if unknown < count:
            # The kernel also compensates the padding of the last block, so that must hold valid events.
            self._host["x"][end:padded_end] = 0
            self._host["y"][end:padded_end] = 0
            self._host["t"][end:padded_end] = staged.t[-1]
            outside = self._plan.any_outside(check.max_x, check.max_y)
            blocks = (padded_end - start) // self._plan.block
            self._launch(start // self._plan.block, blocks, outside)
        self._invalidate(start, start + unknown)
        self._invalidate(end, padded_end)
        self._unvoted.append((start, padded_end))
        out = None
        done = None
        if self._device.is_cuda:
            out = self._copy_back(start, end, locked_t is not None)
            done = self._device.stream.record_event()
        self._vote(least=LEAST_VOTED)

        # The times in the staging buffers are overwritten by later batches.
        if locked_t is not None:
            t = staged.t
        elif len(parts) > 1:
            t = staged.t.copy()
        else:
            t = parts[0].t
        return BatchInFlight(
            at=start,
            end=end,
            t=t,
            p=staged.p,
            unknown=unknown,
            arrived_us=staged.arrived_us,
            out=out,
            done=done,
        )

    def finish(self, in_flight: BatchInFlight) -> list[NDArray[Any]]:
        """Wait for a batch; return its x and y [px], and 1 for each event outside the image."""
        if in_flight.done is not None:
            wp.synchronize_event(in_flight.done)
        if in_flight.out is None:
            batch = slice(in_flight.at, in_flight.end)
            x, y, inside = (self._host[name][batch].copy() for name in RESULTS)
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
        count = len(events)
        device = self._device
        _, _, max_x, max_y, _, _ = limits(events)
        if unknown < count:
            columns = self._plan.device_columns(events)
            results = self._plan.run(columns, self._encoder, max_x, max_y)
            x = results.out_x[:count]
            y = results.out_y[:count]
            inside = results.inside[:count]
        else:
            x = wp.empty(count, dtype=float, device=device)
            y = wp.empty(count, dtype=float, device=device)
            inside = wp.zeros(count, dtype=wp.uint8, device=device)
        if unknown:
            x[:unknown].fill_(math.nan)
            y[:unknown].fill_(math.nan)
        marks = np.zeros(0, np.uint8) if extrapolated is None else extrapolated.view(np.uint8)
        flags = wp.empty(count, dtype=wp.uint8, device=device)
        inputs = [inside, wp.array(marks, dtype=wp.uint8, device=device), unknown]
        wp.launch(flag_events, count, inputs=inputs, outputs=[flags], device=device)
        self._votes.add_points(x, y, wp.zeros(count, dtype=wp.uint8, device=device))
        return x, y, flags

    def _copy_back(self, start: int, end: int, direct: bool) -> list[NDArray[Any]] | None:
        """Start to copy results from a GPU: to the buffers, or, if ``direct`` is given, to arrays for the caller."""
        if not direct:
            self._copy(self._host_columns, self._columns, RESULTS, start, end)
            return None
        views = []
        for name in RESULTS:
            column = getattr(self._columns, name)
            array, view = self._pool.result(self._batch, end - start, column.dtype)
            wp.copy(array, column, src_offset=start, count=end - start)
            views.append(view)
        return views

    def _copy(self, target: Any, source: Any, names: Iterable[str], start: int, end: int) -> None:
        """Copy the events ``start`` to ``end`` of columns between the device and the host."""
        for name in names:
            target_column = getattr(target, name)
            source_column = getattr(source, name)
            wp.copy(
                target_column, source_column, dest_offset=start, src_offset=start, count=end - start
            )

    def _launch(self, first: int, blocks: int, outside: bool) -> None:
        """Launch the compensation of ``blocks`` blocks. ``outside``: whether events may lie outside the sensor."""
        kernel = self._plan.kernel
        inputs = self._plan.inputs(self._encoder, self._columns, outside=outside)
        device = self._device
        if device.is_cpu and blocks >= LEAST_PARALLEL:
            smallest = LEAST_PARALLEL // 2
            launch(kernel, blocks, inputs, [], device=device, first=first, smallest=smallest)
            return
        command = self._recorded.get(outside)
        if command is None:
            command = RecordedLaunch(kernel, [*inputs, 0], [], device=device)
            self._recorded[outside] = command
        command(first, blocks)

    def _invalidate(self, start: int, stop: int) -> None:
        """Set the coordinates of a range of events to NaN."""
        if start >= stop:
            return
        for name in ("out_x", "out_y"):
            if self._device.is_cpu:
                self._host[name][start:stop] = np.nan
            else:
                getattr(self._columns, name)[start:stop].fill_(math.nan)

    def _vote(self, *, least: int) -> None:
        """Vote pending events if at least ``least`` are waiting. On CPUs one background thread votes, in order."""
        if sum(stop - start for start, stop in self._unvoted) < least:
            return
        for start, stop in _joined(self._unvoted):
            first = start // self._block
            blocks = (stop - start) // self._block
            if self._device.is_cpu:
                job = background_worker().submit(self._vote_range, first, blocks)
                self._voting.append((start, stop, job))
            else:
                self._vote_range(first, blocks)
        self._unvoted.clear()

    def _wait_for_votes(self, start: int, stop: int) -> None:
        """Wait until no vote uses a range of the buffers."""
        while any(begin < stop and end > start for begin, end, _ in self._voting):
            _, _, job = self._voting.popleft()
            job.result()

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
    joined: list[tuple[int, int]] = []
    for start, stop in ranges:
        if joined and joined[-1][1] == start:
            first, _ = joined.pop()
            joined.append((first, stop))
        else:
            joined.append((start, stop))
    return joined
