"""Consumers of a session's data: files and servers, each served by a background thread."""

import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.streams import EXTRAPOLATED, NO_ANGLE, OUTSIDE, Compensated
from amiwarp.events.recording import Events, held_bytes
from amiwarp.io.native.live_writer import LiveWriter
from amiwarp.live.background_worker import BackgroundWorker


class RawConsumer(Protocol):
    """Consumer (protocol) of the sensor's events in order of time, and of encoder samples on the events' clock."""

    def append(self, events: Events, /) -> None:
        """Take events."""

    def append_encoder(
        self,
        t_us: NDArray[np.int64],
        angle: NDArray[np.float64],
        index_t_us: NDArray[np.int64],
        /,
        *,
        second: bool,
    ) -> None:
        """Take samples of the first or second encoder: times [us], unwrapped angles [rad], and index pulses [us]."""

    def tick(self) -> None:
        """Continue pending work without new data."""


Kind = TypeVar("Kind")
"""Type of a consumer."""


class Served(NamedTuple, Generic[Kind]):
    """Consumer with the thread that calls it."""

    consumer: Kind
    worker: BackgroundWorker


class Consumers:
    """Consumers of a session's data. A consumer that fails is removed.

    The others continue until the session, which ``fail`` may stop, has passed on what it received.

    The consumers ``raw`` get the sensor's events, ``out`` gets the compensated events, and all get the encoder samples.
    The function ``fail`` is called with the errors of consumers.
    """

    def __init__(
        self, raw: Iterable[RawConsumer], out: LiveWriter | None, fail: Callable[[Exception], None]
    ) -> None:
        self.raw = [Served(consumer, BackgroundWorker()) for consumer in raw]
        """Consumers of the sensor's events, each with the thread that calls it."""
        self.out = None if out is None else Served(out, BackgroundWorker())
        """The same for the consumer of compensated events."""
        self._fail = fail

    def append(self, events: Events) -> None:
        """Pass the sensor's events to the consumers of raw events."""
        for served in list(self.raw):
            append = partial(served.consumer.append, events)
            self._put(served, append, held_bytes(events), len(events))

    def append_encoder(
        self,
        t: NDArray[np.int64],
        angle: NDArray[np.float64],
        index_t: NDArray[np.int64],
        second: bool,
    ) -> None:
        """Pass samples and index pulses of the first or second encoder to all consumers."""
        for served in self._all():
            append = partial(served.consumer.append_encoder, t, angle, index_t, second=second)
            self._put(served, append, t.nbytes + angle.nbytes + index_t.nbytes)

    def append_compensated(self, packet: Compensated) -> None:
        """Pass events to the consumer of compensated events. Events of whole pixels are not compensated: no flags."""
        if self.out is None:
            return
        if packet.events.whole_pixels:
            append = partial(self.out.consumer.append, packet.events)
            self._put(self.out, append, held_bytes(packet.events), len(packet.events))
            return
        flags = packet.flags
        inside = (flags & OUTSIDE) == 0
        extrapolated = (flags & (EXTRAPOLATED | NO_ANGLE)) != 0
        append = partial(
            self.out.consumer.append, packet.events, inside=inside, extrapolated=extrapolated
        )
        self._put(self.out, append, held_bytes(packet.events) + flags.nbytes, len(flags))

    def tick(self) -> None:
        """Let all consumers continue pending work, even without new data."""
        for served in self._all():
            self._put(served, served.consumer.tick)

    def drain(self, limit_s: float) -> None:
        """Wait until the consumers have processed all data, and collect their errors.

        After ``limit_s`` [s] the rest is dropped.
        """
        end = time.monotonic() + limit_s
        for _, worker in self._all():
            try:
                worker.close(max(end - time.monotonic(), 0.0))
            except Exception as error:
                self._fail(error)

    @property
    def dropped(self) -> int:
        """Number of events that were dropped at the end, of all consumers."""
        return sum(worker.dropped for _, worker in self._all())

    def join(self) -> None:
        """Wait for the end of all background threads."""
        for _, worker in self._all():
            worker.end()

    def abandon(self) -> None:
        """Drop the waiting data, so that the caller can close the consumers at once."""
        for _, worker in self._all():
            worker.abandon()

    def _all(self) -> list[Served[Any]]:
        return [*self.raw, *([] if self.out is None else [self.out])]

    def _put(
        self,
        served: Served[Any],
        job: Callable[[], object],
        held: int = 0,
        events: int = 0,
    ) -> None:
        """Pass a job to a consumer's thread; remove the consumer if it has failed."""
        try:
            served.worker.put(job, held, events)
        except Exception as error:
            self._fail(error)
            served.worker.end()
            if served is self.out:
                self.out = None
            else:
                self.raw = [other for other in self.raw if other is not served]
