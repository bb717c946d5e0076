"""Batches of a stream's events on a device: packets are joined, compensated, fetched and voted into an image."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.compensation.launch_plan import LaunchPlan
from amiwarp.compensation.packet_copy import PIECE, ColumnCheck, PacketCopier
from amiwarp.compensation.pinned_pool import PinnedPool, PooledArray
from amiwarp.compensation.pointers import address
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_encoder import encoder_pieces
from amiwarp.events.device_events import DeviceEvents, limits, wait
from amiwarp.imaging.warped_image import CanvasShape, Votes
from amiwarp.kernels.compensation import Columns
from amiwarp.kernels.encoder_angle import EncoderParams
from amiwarp.kernels.event_arrays import flag_events
from amiwarp.kernels.launch import RecordedLaunch, background_worker, launch

if TYPE_CHECKING:
    from concurrent.futures import Future

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.models import Model

ROUNDS = 4
"""Number of batches for which the buffers have room, because the votes of earlier batches may still be pending."""
LEAST_VOTED = 1 << 16
"""Number of pending events at which they are voted into the image."""
LEAST_PARALLEL = 4096
"""Number of blocks of events from which several CPU threads compensate them."""
LEAST_DIRECT = 1 << 16
"""Number of events from which a GPU writes its results directly to the arrays that the caller gets, not to the buffers.
"""
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
    pooled_t: PooledArray | None
    """Array of the pool that receives the event times for the caller; None if the times stay in the staging buffers."""
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
        self._device, self._at = device, 0
        self._encoder: Any = None
        self._unvoted: list[tuple[int, int]] = []  # ranges of the buffers
        self._voting: deque[tuple[int, int, Future[None]]] = deque()
        self._plan = LaunchPlan(model, device)
        self._block = self._plan.block
        self._room = ROUNDS * self._plan.padded(batch)
        dtypes = {"x": wp.uint16, "y": wp.uint16, "t": wp.int64, "out_x": float, "out_y": float, "inside": wp.uint8}
        columns = self._columns = Columns()
        for name, dtype in dtypes.items():
            setattr(columns, name, wp.zeros(self._room, dtype=dtype, device=device))
        self._host_columns = columns if device.is_cpu else Columns()
        if not device.is_cpu:
            for name, dtype in dtypes.items():
                setattr(self._host_columns, name, wp.zeros(self._room, dtype=dtype, device="cpu", pinned=True))
        self._host = {name: getattr(self._host_columns, name).numpy() for name in dtypes}
        self._layer = wp.zeros(self._room, dtype=wp.uint8, device=device)
        self._recorded: dict[bool, RecordedLaunch] = {}
        self._pool = PinnedPool(batch)
        self._copiers = [PacketCopier(), PacketCopier()]  # two, because the first may still copy the previous batch
        self._votes = Votes(CanvasShape(*self._plan.size), device)
        self._vote_range = self._votes.range_voter(columns.out_x, columns.out_y, self._layer)
        if device.is_cuda and batch > LEAST_DIRECT:
            # for the batches in flight, and as many again that the caller holds
            self._pool.fill({np.int64: 2 * ROUNDS, np.float32: 4 * ROUNDS, np.uint8: 4 * ROUNDS})

    def set_encoder(self, encoder: Encoder, first: int, last: int) -> None:
        """Copy the encoder's pieces over a span of event times [us] to the device.

        All pieces go into one bucket, which the kernel searches for an event's piece, because they are few.
        """
        origin, *pieces = encoder_pieces(encoder, first, last)
        n, p = len(pieces[0]), self._encoder
        if p is None or n > len(p.start):
            p = self._encoder = EncoderParams()
            p.shift, p.first = 62, wp.zeros(2, dtype=int, device=self._device)
            p.start, p.angle, p.slope = (
                wp.zeros(max(2 * n, 64), dtype=dtype, device=self._device) for dtype in (wp.int64, wp.uint64, wp.uint64)
            )
        p.origin = origin
        for to, values in zip(
            (p.first, p.start, p.angle, p.slope), (np.array([0, n - 1], np.int32), *pieces), strict=True
        ):
            if self._device.is_cpu:
                to.numpy()[: len(values)] = values
            else:
                wp.copy(to, wp.array(values, dtype=to.dtype, device="cpu", copy=False), count=len(values))
        for command in self._recorded.values():
            command.set(3, p)

    def stage(self, parts: list[Events], arrived_us: int) -> StagedBatch:
        """Start to copy packets into the buffers; long packets are copied by several threads."""
        n, several = sum(part.t.size for part in parts), len(parts) > 1
        at, end = self._reserve(n)
        direct, p = self._device.is_cuda and n > LEAST_DIRECT, parts[0].p
        pooled_t = self._pool(n, np.int64) if direct else None
        t = self._host["t"][at:end] if pooled_t is None else pooled_t[1]
        if several:
            p = self._pool(n, np.uint8)[1] if direct else np.empty(n, np.uint8)
        to = [self._host["x"][at:end], self._host["y"][at:end], t, p]
        if several or n > PIECE:
            self._copiers.reverse()
            wait = self._copiers[0](parts, n, [address(column) for column in to], with_p=several).wait
        else:  # a single short packet is copied fastest without threads
            to[0][:], to[1][:], to[2][:] = parts[0].x, parts[0].y, parts[0].t
            wait = partial(ColumnCheck, bool((t[1:] < t[:-1]).any()), int(to[0].max()), int(to[1].max()))
        return StagedBatch(parts=parts, at=at, end=end, t=t, p=p, arrived_us=arrived_us, pooled_t=pooled_t, wait=wait)

    def _reserve(self, n: int) -> tuple[int, int]:
        """Return start and end of a free range of ``n`` events of the buffers; wait for votes that still use it."""
        padded = self._plan.padded(n)
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
            self._copy(self._columns, self._host_columns, ("x", "y") if s.pooled_t else ("x", "y", "t"), at, end)
            if s.pooled_t is not None:
                wp.copy(self._columns.t, s.pooled_t[0], dest_offset=at, count=n)
        padded = self._plan.padded(n)
        if unknown < n:
            # the kernel also compensates the padding of the last block, so that must hold valid events
            for name, value in (("x", 0), ("y", 0), ("t", s.t[-1])):
                self._host[name][end : at + padded] = value
            outside = self._plan.any_outside(check.max_x, check.max_y)
            self._launch(at // self._block, padded // self._block, outside)
        self._invalidate(at, at + unknown)
        self._invalidate(end, at + padded)
        self._unvoted.append((at, at + padded))
        out, done = None, None
        if self._device.is_cuda:
            out = self._copy_back(at, end, s.pooled_t is not None)
            done = self._device.stream.record_event()
        self._vote(least=LEAST_VOTED)
        t = s.t if s.pooled_t else s.t.copy() if len(s.parts) > 1 else s.parts[0].t
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
        pooled = [self._pool(end - at, dtype) for dtype in (np.float32, np.float32, np.uint8)]
        for name, (array, _) in zip(RESULTS, pooled, strict=True):
            wp.copy(array, getattr(self._columns, name), src_offset=at, count=end - at)
        return [view for _, view in pooled]

    def _copy(self, to: Any, source: Any, names: tuple[str, ...], at: int, end: int) -> None:
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
            command = self._recorded[outside] = RecordedLaunch(kernel, inputs, [], device=self._device)
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
