"""Consumers of a session's data: files and servers, each served by a background thread."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from amiwarp.compensation.streams import EXTRAPOLATED, NO_ANGLE, OUTSIDE, held_bytes
from amiwarp.live.stream.background_worker import BackgroundWorker

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from amiwarp.compensation.streams import Compensated
    from amiwarp.events.events import Events
    from amiwarp.io.live_writer import LiveWriter


class RawConsumer(Protocol):
    """Consumer (protocol) of the sensor's events in order of time, and of encoder samples on the events' clock."""

    def append(self, events: Events, /) -> None: ...

    def append_encoder(
        self, t_us: NDArray[np.int64], angle: NDArray[np.float64], index_t_us: NDArray[np.int64], /
    ) -> None: ...

    def tick(self) -> None: ...


Consumer = TypeVar("Consumer", bound="RawConsumer | LiveWriter", covariant=True)


@dataclass(frozen=True, slots=True, eq=False)
class Served(Generic[Consumer]):
    """Consumer together with the background thread that calls it."""

    consumer: Consumer
    worker: BackgroundWorker


class Consumers:
    """Consumers of a session's data. A consumer that fails is removed; the others continue.

    The consumers ``raw`` get the sensor's events, ``out`` gets the compensated events, and all get the encoder samples.
    The function ``fail`` is called with the errors of consumers.
    """

    def __init__(self, raw: Iterable[RawConsumer], out: LiveWriter | None, fail: Callable[[Exception], None]) -> None:
        self.raw = [Served(consumer, BackgroundWorker()) for consumer in raw]
        self.out = None if out is None else Served(out, BackgroundWorker())
        self._fail = fail

    def append(self, events: Events) -> None:
        """Pass the sensor's events to the consumers of raw events."""
        for served in list(self.raw):
            self._put(served, partial(served.consumer.append, events), held_bytes(events))

    def append_encoder(self, t: NDArray[np.int64], angle: NDArray[np.float64], index_t: NDArray[np.int64]) -> None:
        """Pass encoder samples and index pulses to all consumers."""
        for served in self._all():
            append = partial(served.consumer.append_encoder, t, angle, index_t)
            self._put(served, append, t.nbytes + angle.nbytes + index_t.nbytes)

    def append_compensated(self, packet: Compensated) -> None:
        """Pass compensated events to the consumer of compensated events."""
        if self.out is None:
            return
        flags = packet.flags
        inside, extrapolated = (flags & OUTSIDE) == 0, (flags & (EXTRAPOLATED | NO_ANGLE)) != 0
        append = partial(self.out.consumer.append, packet.events, inside=inside, extrapolated=extrapolated)
        self._put(self.out, append, held_bytes(packet.events) + flags.nbytes)

    def tick(self) -> None:
        """Let all consumers continue pending work, even without new data."""
        for served in self._all():
            self._put(served, served.consumer.tick)

    def finish(self) -> None:
        """Wait until the consumers have processed all data, and collect their errors."""
        for served in self._all():
            try:
                served.worker.close()
            except Exception as error:
                self._fail(error)

    def end(self) -> None:
        """Wait for the end of all background threads."""
        for served in self._all():
            served.worker.end()

    def abandon(self) -> None:
        """Drop the waiting data, so that the caller can close the consumers at once."""
        for served in self._all():
            served.worker.abandon()

    def _all(self) -> list[Served[RawConsumer | LiveWriter]]:
        return [*self.raw, *([] if self.out is None else [self.out])]

    def _put(self, served: Served[RawConsumer | LiveWriter], job: Callable[[], object], held: int = 0) -> None:
        """Pass a job to a consumer's thread; remove the consumer if it has failed."""
        try:
            served.worker.put(job, held)
        except Exception as error:
            self._fail(error)
            served.worker.end()
            if served is self.out:
                self.out = None
            else:
                self.raw = [other for other in self.raw if other is not served]
