"""Motion compensation of streams of events and encoder samples."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.compensation.batches import BatchInFlight, BatchPipeline, StagedBatch
from amiwarp.compensation.packet_copy import PIECE
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents, check_sensor, limits, wait
from amiwarp.events.encoder import check_prisms
from amiwarp.events.encoder_stream import EncoderStream
from amiwarp.events.recording import Events, held_bytes
from amiwarp.optics.models.base import Model
from amiwarp.schema.calls import guarded
from amiwarp.validation import TIME_LIMIT, whole

OUTSIDE = 1
"""Flag of a compensated event whose coordinates are outside the image. The flags of an event are added."""
EXTRAPOLATED = 2
"""Flag: no encoder sample arrived in time, so the prism angle is extrapolated at constant speed."""
NO_ANGLE = 4
"""Flag: no prism angle is known, so the coordinates are NaN."""
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
        If a number is out of range, or the encoder does not measure as many angles as the model has.

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
        if batch is None:
            batch = 1 << 16 if self._device.is_cpu else 1 << 20
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
        # Event times that the encoder's samples on the device cover.
        self._covered: tuple[int, int] | None = None
        self._cleared = encoder.cleared

    def put(
        self, events: Events | DeviceEvents, now_us: int, *, arrived_us: int | None = None
    ) -> None:
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
        parts = [events]
        most = min(self.batch, PIECE)
        if t.size > most:
            if (t[most::most] < t[most - 1 : -1 : most]).any():
                raise AmiwarpError(
                    f"events of {t[0]} to {t[-1]} us are not sorted; sort each packet"
                )
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
            # Three batches overlap: one is copied to the buffers, a GPU computes the second, the third is fetched.
            packets = self._pop_ready(now_us)
            if not packets and len(out) >= self._least_returned:
                return out
            staged = self._staged
            self._staged = self._stage(packets) if packets else None
            in_flight = self._in_flight
            self._in_flight = None
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
            for events, _, _, arrived in packets:
                out.append(self._compensate_on_device(events, arrived))
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
        count = 0
        covered = self.encoder.last
        patience = self.start_us if covered is None else self.wait_us
        while self._queue:
            events, last, put_us, _ = self._queue[0]
            size = events.t.size
            if count + size > self.batch:
                break
            known = covered is not None and last <= covered
            overdue = now_us - put_us >= patience
            full = self.waiting > self.most_waiting or self.waiting_bytes > self.most_bytes
            if not (known or overdue or full):
                break
            packets.append(self._queue.popleft())
            count += size
            self.waiting -= size
            self.waiting_bytes -= held_bytes(events)
        return packets

    def _stage(self, packets: list[QueuedPacket]) -> StagedBatch:
        parts = [part.to_host() if isinstance(part, DeviceEvents) else part for part, *_ in packets]
        _, _, _, arrived_us = packets[0]
        return self._pipeline.stage(parts, arrived_us)

    def _submit(self, staged: StagedBatch) -> tuple[BatchInFlight, NDArray[np.bool_] | None]:
        """Submit a batch; return also which of its events have an extrapolated angle, or None if none has."""
        parts = staged.parts
        first = int(parts[0].t[0])
        last = int(parts[-1].t[-1])
        unknown = self._prepare_encoder(first, last, [part.t for part in parts])
        in_flight = self._pipeline.submit(staged, unknown)
        if self.encoder.knows(first, last):
            return in_flight, None
        return in_flight, self.encoder.guessed(in_flight.t)

    def _compensate_on_device(
        self, events: Events | DeviceEvents, arrived_us: int
    ) -> DeviceCompensated:
        """Compensate a packet on the device."""
        if not isinstance(events, DeviceEvents) or events.device != self._device:
            columns = (events.x, events.y, events.t, events.p)
            events = DeviceEvents.from_arrays(*columns, device=self._device)
        first = events.t_first
        last = events.t_last
        first_known = self.encoder.first
        some_unknown = first_known is None or first < first_known
        known = self.encoder.knows(first, last)
        # The times are copied to the host only if an angle is missing.
        times = [events.t.numpy()] if some_unknown or not known else []
        unknown = self._prepare_encoder(first, last, times)
        extrapolated = None if known else self.encoder.guessed(times[0])
        x, y, flags = self._pipeline.run_on_device(events, unknown, extrapolated)
        return DeviceCompensated(DeviceEvents(x, y, events.t, events.p), flags, arrived_us)

    def _prepare_encoder(self, first: int, last: int, times: list[NDArray[np.int64]]) -> int:
        """Copy the encoder over a span of event times [us] to the device; return how many events have no angle.

        ``times`` are the times of the events; they are used only if the first has none.
        """
        first_known = self.encoder.first
        last_known = self.encoder.last
        count = sum(t.size for t in times)
        if first_known is None or last_known is None:
            return count
        unknown = 0
        if first < first_known:
            unknown = sum(int(np.searchsorted(t, first_known)) for t in times)
        if unknown < count or not count:
            self._set_encoder(max(first, first_known), last, last_known)
        return unknown

    def _finish(
        self, in_flight: BatchInFlight, extrapolated: NDArray[np.bool_] | None
    ) -> Compensated:
        x, y, flags = self._pipeline.finish(in_flight)
        if extrapolated is not None:
            flags[extrapolated] |= EXTRAPOLATED
        flags[: in_flight.unknown] = OUTSIDE | NO_ANGLE
        return Compensated(Events(x, y, in_flight.t, in_flight.p), flags, in_flight.arrived_us)

    def _set_encoder(self, first: int, last: int, last_known: int) -> None:
        """Copy the encoder's samples over a span of event times [us] to the device, unless it has them already."""
        if self._cleared != self.encoder.cleared:  # the samples on the device were on another clock
            self._cleared = self.encoder.cleared
            self._covered = None
        if self._covered is None or first < self._covered[0] or last > self._covered[1]:
            until = max(last, min(last_known, last + AHEAD_US))
            self._pipeline.set_encoder(self.encoder.over(first, until), first, until)
            # Angles past the last sample are extrapolated; newer samples may cover them next time.
            self._covered = (first, until) if until <= last_known else None
