"""Compensation of streams: packets of events and encoder samples in, compensated events and a running image out."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import warp as wp

from amiwarp.compensation.batches import Batches, BatchInFlight, Started
from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events, check_sensor

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder_stream import EncoderStream
    from amiwarp.optics.models import Model

OUTSIDE, EXTRAPOLATED, NO_ANGLE = 1, 2, 4
"""Flags of an event: its place lies outside the image; no encoder sample came in time, so its angle goes on at constant
speed; there is no angle at all, and so no place (NaN)."""
MANY = 2
"""Batches that a call gives at least before it leaves those that a GPU works on to the next."""
AHEAD_US = 100_000
"""Of encoder samples that are put on the device at once, where there are so many [us]."""
OVERHEAD = 1024
"""Bytes that a packet counts for beyond its arrays: the Python objects that hold them."""
Waiting: TypeAlias = tuple[Events, int, int, int]
"""A packet, its last time, when it was put, and when it had come [us]."""


@dataclass(frozen=True, slots=True, eq=False)
class Compensated:
    """Events as they come out: a packet, or several that were ready together."""

    events: Events
    """Places without the prism, float32 [px], NaN where there is none; times and polarities as they were put."""
    flags: NDArray[np.uint8]
    """Shape ``(n,)``: sum of :data:`OUTSIDE`, :data:`EXTRAPOLATED`, :data:`NO_ANGLE`."""
    arrived_us: int = 0
    """When the first of them came, by the caller's clock [us]."""


def held_bytes(events: Events) -> int:
    """Return the memory that a waiting packet of events takes [bytes], its Python objects included."""
    return OVERHEAD + events.x.nbytes + events.y.nbytes + events.t.nbytes + events.p.nbytes


class Compensator:
    """Compensates a stream: put packets and encoder samples as they come, take what is ready.

    A packet waits until the encoder covers it, at most ``wait_us`` by the caller's clock, or ``start_us`` while the
    encoder has given no two samples yet; past that, or while more than ``most_waiting`` events or ``most_bytes`` wait,
    its angles are guessed and marked. Everything comes out once, in the order it was put. ``encoder``: the caller
    appends its samples.

    Buffers are allocated once, for ``batch`` events: what is ready is worked through so many at a time. For one thread.
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
        self.encoder = encoder
        self.wait_us, self.start_us = wait_us, start_us
        self.most_waiting, self.most_bytes = most_waiting, most_bytes
        self._device = wp.get_device(device)
        self.batch = batch or (1 << 16 if self._device.is_cpu else 1 << 20)
        self._work = Batches(model, self.batch, self._device)
        self._many = MANY if self._device.is_cuda else math.inf
        self._queue: deque[Waiting] = deque()
        self.waiting = 0
        """Events put that are not worked on yet."""
        self.waiting_bytes = 0
        """Memory that these take [bytes], see :func:`held_bytes`."""
        self._started: Started | None = None
        self._begun: tuple[BatchInFlight, NDArray[np.bool_] | None] | None = None
        self._t_last = -(2**62)
        self._covered: tuple[int, int] | None = None

    def put(self, events: Events, now_us: int, *, arrived_us: int | None = None) -> None:
        """A packet, now: uint16 pixels, sorted, not before the last one; kept, not copied. It waits from now on.

        ``arrived_us``: when it came, if that was earlier, for :attr:`Compensated.arrived_us`.
        Raises :class:`AmiwarpError` for other pixels or a packet that begins before the last; nothing was put then.
        """
        check_sensor(events)
        t = events.t
        if not t.size:
            return
        if t.item(0) < self._t_last:
            raise AmiwarpError(f"a packet from {t[0]} us comes after one to {self._t_last} us; sort it first")
        parts = [events]
        if t.size > self.batch:
            if (t[self.batch :: self.batch] < t[self.batch - 1 : -1 : self.batch]).any():
                raise AmiwarpError(f"events of {t[0]} to {t[-1]} us are not sorted; sort each packet")
            parts = [events[start : start + self.batch] for start in range(0, t.size, self.batch)]
        self._t_last = t.item(-1)
        self.waiting += t.size
        arrived = now_us if arrived_us is None else arrived_us
        self.waiting_bytes += sum(map(held_bytes, parts))
        self._queue.extend((part, part.t.item(-1), now_us, arrived) for part in parts)

    def take(self, now_us: int) -> list[Compensated]:
        """What is ready at ``now_us``, in the order it was put, packets that are ready together joined to a batch.

        Of many batches a GPU may work on the last still: they come with the next call, or with :meth:`flush`.
        Raises :class:`AmiwarpError` for a packet that is not sorted; what was ready with it, and what was under way, is
        lost.
        """
        out: list[Compensated] = []
        while True:
            # while one batch is put together, a GPU works on that before it, and the one before that is fetched
            packets = self._ready(now_us)
            if not packets and len(out) >= self._many:
                return out
            started, self._started = self._started, self._start(packets) if packets else None
            begun, self._begun = self._begun, None
            if started is not None:
                self._begun = self._begin(started)
            if begun is not None:
                out.append(self._end(*begun))
            if self._started is None and self._begun is None:
                return out

    def flush(self) -> list[Compensated]:
        """All that still waits, its angles guessed where they must be: at the end of a stream."""
        out: list[Compensated] = []
        while more := self.take(2**62):
            out += more
        return out

    def image(self) -> NDArray[np.float32]:
        """Image of the events worked on since the last call, shape (height, width)."""
        return self._work.image()

    def _ready(self, now_us: int) -> list[Waiting]:
        packets: list[Waiting] = []
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

    def _start(self, packets: list[Waiting]) -> Started:
        return self._work.start([events for events, *_ in packets], packets[0][3])

    def _begin(self, started: Started) -> tuple[BatchInFlight, NDArray[np.bool_] | None]:
        """With which of its events have a guessed angle, None for none: by the samples there are now."""
        parts, n = started.parts, started.end - started.at
        first, last = int(parts[0].t[0]), int(parts[-1].t[-1])
        begins, ends = self.encoder.first, self.encoder.last
        if begins is None or ends is None:
            unknown = n
        else:
            unknown = 0 if first >= begins else sum(int(np.searchsorted(part.t, begins)) for part in parts)
            if unknown < n:
                self._cover(max(first, begins), last, ends)
        begun = self._work.begin(started, unknown)
        return begun, None if self.encoder.knows(first, last) else self.encoder.guessed(begun.t)

    def _end(self, begun: BatchInFlight, guessed: NDArray[np.bool_] | None) -> Compensated:
        x, y, flags = self._work.end(begun)
        if guessed is not None:
            flags[guessed] |= EXTRAPOLATED
        flags[: begun.unknown] = OUTSIDE | NO_ANGLE
        return Compensated(Events(x, y, begun.t, begun.p), flags, begun.arrived_us)

    def _cover(self, first: int, last: int, ends: int) -> None:
        """Puts the encoder over a span of event times [us] on the device, where it is not there yet."""
        if self._covered is None or first < self._covered[0] or last > self._covered[1]:
            until = max(last, min(ends, last + AHEAD_US))
            self._work.set_encoder(self.encoder.over(first, until), first, until)
            # what was guessed for the end of it may be known the next time
            self._covered = (first, until) if until <= ends else None
