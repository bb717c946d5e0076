"""The last seconds of a stream in memory, available as a recording at any time."""

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.encoder_speed import rpm_between
from amiwarp.events.encoder_stream import starts_of_runs
from amiwarp.events.recording import OVERHEAD, Events, MemoryEvents, Recording, held_bytes
from amiwarp.io.native.live_writer import LiveWriter
from amiwarp.live.link.link import Link
from amiwarp.live.queues import Policy
from amiwarp.live.stream.packets import NO_TIMES, Source
from amiwarp.live.stream.recorder import StreamRecorder
from amiwarp.live.stream.session import Session
from amiwarp.live.stream.session_status import SessionStatus
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism

SECONDS = 2.0
MOST_BYTES = 1 << 27
"""Limits of the latest events that are kept: their duration [s] and their memory [bytes], about eight million events.

Encoder samples have a memory limit of the same size.
"""
LONGEST_WAIT_S = 10.0
"""Longest time for which events are kept that are newer than all encoder samples [s]."""
SEEN_US = 20_000
"""Time before the first recorded event from which encoder samples are recorded [us]."""
LATE_S = 2.0
"""Lag of the events from which it is said [s]."""
SILENT_S = 1.0
"""Time without events or encoder samples after which they count as interrupted [s]."""
REOPEN_S = 0.2
"""Time between the end of a source and the first attempt to open it again [s]."""
FIRST_S = 15.0
"""Longest wait for the first turn of the prism when a stream starts [s]."""


class RecentEvents:
    """Keeps the latest events and encoder samples. One thread may append while others call :meth:`recording`."""

    def __init__(
        self, source: Source, camera: Camera | None = None, prism: NominalPrism | None = None
    ) -> None:
        self._size = source.size
        self._name = source.name
        self._camera = camera or source.camera
        self._prism = prism or source.prism
        self._events: deque[Events] = deque()
        self._samples = tuple(
            deque[tuple[NDArray[np.int64], NDArray[np.float64]]]() for _ in range(2)
        )
        """Times and angles of the samples of both encoders."""
        self._encoders = source.encoders
        self._metadata = {"recorded_from": source.name, **getattr(source, "metadata", {})}
        self.recorder = StreamRecorder(self._writer)
        """What saves the stream to a file, see :meth:`record`."""
        self.event_bytes = self.sample_bytes = 0
        """Memory of the kept events and of the kept encoder samples [bytes]."""
        self.turn_share = 0.0
        """Share of a turn of the prism that the kept events cover, 0 to 1, at the last call of :meth:`recording`."""
        self.status = SessionStatus()
        """Rate, losses and speed of the stream, from its last report."""
        self.ended = ""
        """Why the stream has ended; empty while it runs."""
        self.segment = 1
        """Number of the current segment; a new one begins when the source is opened again."""
        self.link: Link | None = None
        """Link to the controller that sends the encoder samples; None if they come with the events."""
        self._arrived_s = self._sampled_s = time.monotonic()
        self._delay_us = self._least_delay_us = 0.0
        self._lock = threading.Lock()

    def record(self, path: Path) -> None:
        """Save what the stream delivers from now on to a new file, which ``self.recorder.stop`` finishes.

        Encoder samples of events that are late have come already; they are saved too. Raises :class:`AmiwarpError` if
        a recording runs already, or the file cannot be made.
        """
        with self._lock:
            since = int(self._events[-1].t[-1]) - SEEN_US if self._events else -(2**62)
            known = [
                (bool(k), (t[t >= since], angle[t >= since]))
                for k in range(2)
                for t, angle in self._samples[k]
            ]
            self.recorder.start(path, [(second, pair) for second, pair in known if len(pair[0])])

    def _writer(self, path: Path) -> LiveWriter:
        width, height = self._size
        encoders = 1 if self.link is not None else max(self._encoders, 1)
        return LiveWriter(
            path,
            width=width,
            height=height,
            camera=self._camera,
            prism=self._prism,
            metadata=self._metadata,
            encoders=encoders,
        )

    def append(self, events: Events) -> None:
        """Append events, in order of time."""
        with self._lock:
            self.recorder.append(events)
            self._arrived_s = time.monotonic()
            newest = int(events.t[-1])
            self._delay_us = 1e6 * self._arrived_s - newest
            self._least_delay_us = (
                min(self._least_delay_us, self._delay_us) if self._events else self._delay_us
            )
            self._events.append(events)
            self.event_bytes += held_bytes(events)
            # events whose encoder samples have not come yet are kept for longer
            sampled = [int(samples[-1][0][-1]) for samples in self._samples if samples]
            awaited = min([newest, *sampled]) - round(1e6 * SECONDS) if sampled else -(2**62)
            since = max(awaited, newest - round(1e6 * max(SECONDS, LONGEST_WAIT_S)))
            while len(self._events) > 1 and (
                self.event_bytes > MOST_BYTES or self._events[0].t[-1] < since
            ):
                self.event_bytes -= held_bytes(self._events.popleft())

    def append_encoder(
        self,
        t_us: NDArray[np.int64],
        angle: NDArray[np.float64],
        index_t_us: NDArray[np.int64] | None = None,
        *,
        second: bool = False,
    ) -> None:
        """Append samples of the first or second encoder in order of time, on the events' clock.

        The angles already include the index pulses.
        """
        pulses = NO_TIMES if index_t_us is None else index_t_us
        if len(t_us) or len(pulses):
            self.recorder.append_encoder(t_us, angle, pulses, second=second)
        if len(t_us):
            with self._lock:
                self._sampled_s = time.monotonic()
                samples = self._samples[second]
                samples.append((t_us, angle))
                self.sample_bytes += OVERHEAD + t_us.nbytes + angle.nbytes
                since = int(t_us[-1]) - round(2e6 * SECONDS)
                if self._events:  # samples are kept until their events come, however late these are
                    since = min(since, int(self._events[0].t[0]) - round(1e6 * SECONDS))
                while len(samples) > 1 and (
                    self.sample_bytes > MOST_BYTES or samples[0][0][-1] < since
                ):
                    t_us, angle = samples.popleft()
                    self.sample_bytes -= OVERHEAD + t_us.nbytes + angle.nbytes

    def restart(self) -> None:
        """Forget all events and encoder samples: those that follow may be on another clock, and end a recording."""
        self.recorder.stop("the source was opened again, and its times count anew; record again")
        with self._lock:
            self._events.clear()
            for samples in self._samples:
                samples.clear()
            self.event_bytes = self.sample_bytes = 0
            self.ended = ""
            self.segment = self.segment + 1
            self._arrived_s = self._sampled_s = time.monotonic()

    @property
    def age_s(self) -> float:
        """Time since the latest events arrived [s]."""
        return time.monotonic() - self._arrived_s

    @property
    def lag_s(self) -> float:
        """How late the latest events arrived [s]: after the encoder samples of their time, or after the promptest ones.

        Events are late if this computer, or the one that sends them, is slower than the stream.
        """
        with self._lock:
            if not self._events:
                return 0.0
            newest = int(self._events[-1].t[-1])
            behind = [int(samples[-1][0][-1]) - newest for samples in self._samples if samples]
            return max(0.0, 1e-6 * max([self._delay_us - self._least_delay_us, *behind]))

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
        """Write what waits to be recorded."""
        self.recorder.tick()

    def recording(self) -> Recording | None:
        """Return the kept events that the encoder covers, as a recording; None if they are shorter than one turn.

        The angles of an encoder do not continue over a gap or a restart of its samples. So the events belong to the
        newest part without one in which they cover a turn. :attr:`turn_share` belongs to the newest part with events.
        """
        with self._lock:
            events, samples = list(self._events), [list(each) for each in self._samples]
        first, second = (_runs(each, int(events[0].t[0])) if events else [] for each in samples)
        pair = self._encoders == 2 and self.link is None
        newest_share: float | None = None
        found = None
        for encoder in first if second or not pair else []:
            encoder = replace(encoder, second=second[0] if second else None)
            covered = _covered(events, encoder)
            if not len(covered):  # its events have not come yet
                continue
            share = min(float(np.ptp(encoder.angle_at(covered.t[[0, -1]]))) / math.tau, 1.0)
            newest_share = share if newest_share is None else newest_share
            if share >= 1.0:
                source = MemoryEvents(covered, *self._size)
                found = Recording(source, self._camera, encoder, self._prism, name=self._name)
                break
        self.turn_share = newest_share or 0.0
        return found


def _covered(events: list[Events], encoder: Encoder) -> Events:
    """Return the events of packets, in order of time, that an encoder covers."""
    low, high = encoder.coverage
    near = [each for each in events if each.t[-1] >= low and each.t[0] <= high]
    if not near:
        return Events.empty()
    joined = Events.concatenate(near)
    return joined[slice(*np.searchsorted(joined.t, (low, high)))]


def _runs(
    samples: list[tuple[NDArray[np.int64], NDArray[np.float64]]], t_first: int
) -> list[Encoder]:
    """Return the encoders of samples without a gap or a restart, the newest first, from shortly before ``t_first`` on.

    Parts of fewer than two samples are left out. ``t_first``: time [us].
    """
    if not samples:
        return []
    t, angle = (np.concatenate(column) for column in zip(*samples, strict=True))
    starts = [*starts_of_runs(t, angle), len(t)]
    found = []
    for start, stop in reversed([*pairwise(starts)]):
        since = start + max(
            min(int(np.searchsorted(t[start:stop], t_first)) - 2, stop - start - 2), 0
        )
        if stop - since >= 2:
            found.append(Encoder(t[since:stop], angle[since:stop]))
    return found


def _silence(what: str, seconds: float) -> str:
    return f"no {what} for {seconds:.0f} s" if seconds > SILENT_S else ""


class LiveSource:
    """Function that returns the last seconds of a stream as a recording, with figures about the stream."""

    def __init__(self, recent: RecentEvents, messages: Sequence[str]) -> None:
        """Start with events of at least one turn. ``messages`` grows while the stream is followed.

        Raises :class:`AmiwarpError` if there are fewer events.
        """
        first = recent.recording()
        if first is None:
            raise AmiwarpError("the stream has delivered less than one full turn; wait for one")
        self._recent = recent
        self._messages = messages
        self._last = first

    def __call__(self) -> Recording:
        """Return the latest events of at least one turn."""
        self._last = self._recent.recording() or self._last
        return self._last

    def record(self, path: Path) -> None:
        """Save what the stream delivers from now on to a new file.

        Raises :class:`AmiwarpError` if a recording runs already, or the file cannot be made.
        """
        self._recent.record(path)

    @property
    def is_recording(self) -> bool:
        """Whether the stream is being saved."""
        return bool(self._recent.recorder.text)

    def stop_recording(self) -> str:
        """Finish the recording, and return a text about it; empty if there is none."""
        return self._recent.recorder.stop()

    def figures(self) -> tuple[list[list[str]], str]:
        """Return figures of this moment, as rows of name, value and "bad", and what is wrong; empty if nothing is.

        The speed is the mean of the last turn of the shown events; the latency is their age if they are shown now.
        """
        recent = self._recent
        problem = self._recent.silence
        status = self._recent.status
        last = self._last.events.t_last
        encoder = self._last.encoder
        no_angles = "" if problem else recent.encoder_silence
        turn_us = 2e6 if encoder is None else min(2e6, 60e6 / max(abs(encoder.rpm), 1.0))
        rpm = None if encoder is None else rpm_between(encoder, round(last - turn_us), last)
        said = self._messages[-1] if self._messages else ""
        speed = "unknown" if rpm is None else f"{rpm:.1f} rpm"
        angles = not (problem or no_angles)
        rate = 0.0 if problem else status.rate_mev_s
        lag_s = 0.0 if problem else recent.lag_s
        fresh = angles and recent.turn_share >= 1.0
        latency_ms = 1e3 * recent.age_s
        rows = [
            ("events", "interrupted, last ones shown" if problem else "receiving", problem),
            ("prism angles", "receiving" if angles else "interrupted, last turn shown", not angles),
            ("rate", f"{rate:.2f} million events/s", False),
            (
                "latency",
                "–" if problem else f"{latency_ms:.0f} ms",
                not problem and latency_ms > 1e3,
            ),
            ("lag", "–" if problem else f"{lag_s:.1f} s", lag_s > LATE_S),
            ("turn covered", f"{100.0 * recent.turn_share:.0f} %", recent.turn_share < 1.0),
            (
                "speed of the prism",
                speed if fresh else f"{speed}, last measured",
                rpm is None or not fresh,
            ),
            ("lost events", f"{status.dropped:,}", status.dropped),
            ("out of order", f"{status.late:,}", status.late),
        ]
        if recent.recorder.text or recent.recorder.problem:
            words = recent.recorder.text or f"ended: {recent.recorder.problem}"
            rows.append(("recording", words, not recent.recorder.text))
        if recent.segment > 1:
            rows.append(("segment", f"{recent.segment}, since the source came back", False))
        if said and not problem:
            rows.append(("last message", said, False))
        message = "" if said == problem else said
        note = f"The stream is interrupted: {problem}. {message}".strip() if problem else ""
        if no_angles:
            note = f"No prism angles arrive: {no_angles}. The last turn before it is shown, until they return."
        if lag_s > LATE_S and not note:
            note = (
                f"The events are {lag_s:.1f} s late: this computer, or the one that sends them, is slower than the "
                "stream. The newest whole turn that has come is shown."
            )
        return [[name, text, "bad" if bad else ""] for name, text, bad in rows], note


@contextlib.contextmanager
def followed(
    source: Source,
    link: Link | None,
    recent: RecentEvents,
    say: Callable[[str], None],
    reopen: Callable[[threading.Event], Source | None] = lambda _: None,
) -> Iterator[None]:
    """Fill ``recent`` from a source, in a background thread, while the ``with`` block runs.

    Waits for the first turn of the prism. ``reopen`` gives the next source after the end of one, which begins a new
    segment; it returns None if there is none, or once its event is set. Raises :class:`AmiwarpError` if the first turn
    does not come in time, or the error of the source.
    """
    over, stop, failures, recent.link = threading.Event(), threading.Event(), [], link

    def report(status: SessionStatus) -> None:
        recent.status = replace(status)

    def end(text: str) -> None:
        recent.ended = text
        say(text)

    def follow(part: Source) -> None:
        nonlocal stop
        stop = threading.Event()  # a session sets it at its end
        if over.is_set():
            return part.close()
        session = Session(part, link=link, raw=[recent], policy=Policy.DROP_OLDEST, say=say)
        try:
            ended = session.run(stop, report)
            problem = getattr(part, "problem", None)
            how = "has ended" if problem is None else f"broke off: {problem}"
            end(f"{part.name}: the stream {how}; the last of its {ended.events:,} events are shown")
        except Exception as error:
            failures.append(error)
            end(str(error))

    def run() -> None:
        follow(source)
        if recent.recording() is None:
            return
        while not over.wait(REOPEN_S) and (part := reopen(over)) is not None:
            if (part.size, part.encoders) == (source.size, source.encoders):
                recent.restart()
                say(
                    f"{part.name}: the stream is back: segment {recent.segment}, its times count anew"
                )
                follow(part)
            else:
                part.close()
                now, before = (
                    f"{s.size[0]}x{s.size[1]} pixels and {s.encoders} encoders"
                    for s in (part, source)
                )
                end(
                    f"{part.name}: is back with a camera of {now}, before it had {before}; start the command again"
                )

    # No BackgroundLoop: the session has its own stop event, and its end is shown as text while the block runs.
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
        over.set()
        stop.set()
        thread.join()
        recent.recorder.stop()
