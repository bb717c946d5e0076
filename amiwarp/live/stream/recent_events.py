"""The last seconds of a stream in memory, available as a recording at any time."""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TWO_PI, Encoder, start_of_last_run
from amiwarp.events.recording import OVERHEAD, Events, MemoryEvents, Recording, held_bytes
from amiwarp.live.link.link import Link
from amiwarp.live.stream.packets import Source
from amiwarp.live.stream.queues import Policy
from amiwarp.live.stream.session import Session, SessionStatus
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism

SECONDS, MOST_BYTES = 2.0, 1 << 27
"""Limits of the latest events that are kept: their duration [s] and their memory [bytes], about eight million events.

Encoder samples have a memory limit of the same size.
"""
SILENT_S = 1.0
"""Time without events or encoder samples after which they count as interrupted [s]."""
FIRST_S = 15.0
"""Longest wait for the first turn of the prism when a stream starts [s]."""


class RecentEvents:
    """Keeps the latest events and encoder samples. One thread may append while others call :meth:`recording`."""

    def __init__(self, source: Source, camera: Camera | None = None, prism: NominalPrism | None = None) -> None:
        self._size, self._name = source.size, source.name
        self._camera, self._prism = camera or source.camera, prism or source.prism
        self._events: deque[Events] = deque()
        self._samples: deque[tuple[NDArray[np.int64], NDArray[np.float64]]] = deque()
        self.event_bytes = self.sample_bytes = 0
        """Memory of the kept events and of the kept encoder samples [bytes]."""
        self.turn_share = 0.0
        """Share of a turn of the prism that the kept events cover, 0 to 1, at the last call of :meth:`recording`."""
        self.status = SessionStatus()
        """Rate, losses and speed of the stream, from its last report."""
        self.ended = ""
        """Why the stream has ended; empty while it runs."""
        self.link: Link | None = None
        """Link to the controller that sends the encoder samples; None if they come with the events."""
        self._arrived_s = self._sampled_s = time.monotonic()
        self._lock = threading.Lock()

    def append(self, events: Events) -> None:
        """Append events, in order of time."""
        with self._lock:
            self._arrived_s = time.monotonic()
            self._events.append(events)
            self.event_bytes += held_bytes(events)
            since = int(events.t[-1]) - round(SECONDS * 1e6)
            while len(self._events) > 1 and (self.event_bytes > MOST_BYTES or self._events[0].t[-1] < since):
                self.event_bytes -= held_bytes(self._events.popleft())

    def append_encoder(self, t_us: NDArray[np.int64], angle: NDArray[np.float64], index_t_us: object = None) -> None:
        """Append encoder samples in order of time, on the events' clock.

        The angles already include the index pulses.
        """
        if len(t_us):
            with self._lock:
                self._sampled_s = time.monotonic()
                self._samples.append((t_us, angle))
                self.sample_bytes += OVERHEAD + t_us.nbytes + angle.nbytes
                since = int(t_us[-1]) - round(2e6 * SECONDS)
                while len(self._samples) > 1 and (self.sample_bytes > MOST_BYTES or self._samples[0][0][-1] < since):
                    t_us, angle = self._samples.popleft()
                    self.sample_bytes -= OVERHEAD + t_us.nbytes + angle.nbytes

    @property
    def age_s(self) -> float:
        """Time since the latest events arrived [s]."""
        return time.monotonic() - self._arrived_s

    @property
    def silence(self) -> str:
        """Why no events arrive; empty if they do."""
        return self.ended or _silence("events", self.age_s)

    @property
    def encoder_silence(self) -> str:
        """Why no encoder samples arrive; empty if they do."""
        if self.link is not None and not self.link.connected:
            return f"the port {self.link.name} of the controller is gone"
        return _silence("encoder samples", time.monotonic() - self._sampled_s)

    def tick(self) -> None:
        """Do nothing, because no data wait to be written."""

    def recording(self) -> Recording | None:
        """Return the kept events that the encoder covers, as a recording; None if they are shorter than one turn.

        Events before a gap or a restart of the encoder samples are left out, because their angles do not continue.
        """
        with self._lock:
            events, samples = list(self._events), list(self._samples)
        if not samples or not events:
            return None
        t, angle = (np.concatenate(column) for column in zip(*samples, strict=True))
        run = start_of_last_run(t)
        t, angle = t[run:], angle[run:]
        if len(t) < 2:
            return None
        joined = Events.concatenate(events)
        since = max(min(int(np.searchsorted(t, joined.t[0])) - 2, len(t) - 2), 0)
        encoder = Encoder(t[since:], angle[since:])
        first, last = np.searchsorted(joined.t, encoder.coverage)
        covered = joined[first:last]
        self.turn_share = (
            min(float(np.ptp(encoder.angle_at(covered.t[[0, -1]]))) / TWO_PI, 1.0) if len(covered) else 0.0
        )
        if self.turn_share < 1.0:
            return None
        return Recording(MemoryEvents(covered, *self._size), self._camera, encoder, self._prism, name=self._name)


def _silence(what: str, seconds: float) -> str:
    return f"no {what} for {seconds:.0f} s" if seconds > SILENT_S else ""


@contextlib.contextmanager
def followed(source: Source, link: Link | None, recent: RecentEvents, say: Callable[[str], None]) -> Iterator[None]:
    """Fill ``recent`` from a source, in a background thread, while the ``with`` block runs.

    Waits for the first turn of the prism. Raises :class:`AmiwarpError` if it does not come in time, or the error of the
    source.
    """
    stop, failures, recent.link = threading.Event(), [], link

    def report(status: SessionStatus) -> None:
        recent.status = replace(status)

    def end(text: str) -> None:
        recent.ended = text
        say(text)

    def run() -> None:
        session = Session(source, link=link, raw=[recent], policy=Policy.DROP_OLDEST, say=say)
        try:
            ended = session.run(stop, report)
            problem = getattr(source, "problem", None)
            how = "has ended" if problem is None else f"broke off: {problem}"
            end(f"{source.name}: the stream {how}; the last of its {ended.events:,} events are shown")
        except Exception as error:
            failures.append(error)
            end(str(error))

    thread = threading.Thread(target=run, name="amiwarp-follow", daemon=True)
    thread.start()
    try:
        until = time.monotonic() + FIRST_S
        while recent.recording() is None:
            if not thread.is_alive() or time.monotonic() > until:
                how = f"in {FIRST_S:g} s" if thread.is_alive() else "before the stream ended"
                problem = getattr(source, "problem", None)
                why = "" if problem is None else f": it broke off, {problem}"
                what = f"{source.name}: delivered less than one full turn {how}{why}"
                raise failures[0] if failures else AmiwarpError(what)
            time.sleep(0.05)
        yield
    finally:
        stop.set()
        thread.join()
