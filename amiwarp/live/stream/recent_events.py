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

from amiwarp.errors import AmiwarpError, ErrorCode
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
"""Duration of the latest events that are kept [s]."""
MOST_BYTES = 1 << 27
"""Memory limit of the kept events, about eight million, and of the kept encoder samples [bytes]."""
NO_TIME_US = -(2**62)
"""Time before all events [us]."""
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
            since_us = NO_TIME_US
            if self._events:
                since_us = int(self._events[-1].t[-1]) - SEEN_US
            known = []
            for second, samples in zip((False, True), self._samples, strict=True):
                for t_us, angle in samples:
                    is_later = t_us >= since_us
                    if is_later.any():
                        known.append((second, (t_us[is_later], angle[is_later])))
            self.recorder.start(path, known)

    def _writer(self, path: Path) -> LiveWriter:
        """Return the writer of a recording of this stream."""
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
            newest_us = int(events.t[-1])
            self._delay_us = 1e6 * self._arrived_s - newest_us
            if self._events:
                self._least_delay_us = min(self._least_delay_us, self._delay_us)
            else:
                self._least_delay_us = self._delay_us
            self._events.append(events)
            self.event_bytes += held_bytes(events)

            # Events whose encoder samples have not come yet are kept for longer.
            since_us = newest_us - round(1e6 * max(SECONDS, LONGEST_WAIT_S))
            sampled_us = self._latest_samples_us()
            if sampled_us:
                both_known_us = min([newest_us, *sampled_us])
                since_us = max(since_us, both_known_us - round(1e6 * SECONDS))
            while len(self._events) > 1 and (
                self.event_bytes > MOST_BYTES or self._events[0].t[-1] < since_us
            ):
                self.event_bytes -= held_bytes(self._events.popleft())

    def _latest_samples_us(self) -> list[int]:
        """Return the time of the latest sample of each encoder that has sent some [us]."""
        return [int(samples[-1][0][-1]) for samples in self._samples if samples]

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
                since_us = int(t_us[-1]) - round(2e6 * SECONDS)
                if self._events:  # samples are kept until their events come, however late these are
                    since_us = min(since_us, int(self._events[0].t[0]) - round(1e6 * SECONDS))
                while len(samples) > 1 and (
                    self.sample_bytes > MOST_BYTES or samples[0][0][-1] < since_us
                ):
                    old_t_us, old_angle = samples.popleft()
                    self.sample_bytes -= OVERHEAD + old_t_us.nbytes + old_angle.nbytes

    def restart(self) -> None:
        """Forget all events and encoder samples: those that follow may be on another clock, and end a recording."""
        self.recorder.stop("the source was opened again, and its times count anew; record again")
        with self._lock:
            self._events.clear()
            for samples in self._samples:
                samples.clear()
            self.event_bytes = self.sample_bytes = 0
            self.ended = ""
            self.segment += 1
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
            newest_us = int(self._events[-1].t[-1])
            behind_us = [sampled_us - newest_us for sampled_us in self._latest_samples_us()]
            return max(0.0, 1e-6 * max([self._delay_us - self._least_delay_us, *behind_us]))

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
            events = list(self._events)
            samples = [list(each) for each in self._samples]
        if not events:
            self.turn_share = 0.0
            return None
        first_us = int(events[0].t[0])
        first_runs, second_runs = (_runs(each, first_us) for each in samples)
        needs_second = self._encoders == 2 and self.link is None
        if needs_second and not second_runs:
            self.turn_share = 0.0
            return None

        newest_share: float | None = None
        recording = None
        for run in first_runs:
            encoder = replace(run, second=second_runs[0] if second_runs else None)
            covered = _covered(events, encoder)
            if not len(covered):  # its events have not come yet
                continue
            turned = float(np.ptp(encoder.angle_at(covered.t[[0, -1]])))
            share = min(turned / math.tau, 1.0)
            if newest_share is None:
                newest_share = share
            if share >= 1.0:
                source = MemoryEvents(covered, *self._size)
                recording = Recording(source, self._camera, encoder, self._prism, name=self._name)
                break
        self.turn_share = newest_share or 0.0
        return recording


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
    edges = [*starts_of_runs(t, angle), len(t)]
    encoders = []
    for start, stop in reversed([*pairwise(edges)]):
        # Two samples before the first time, but at least two samples in all.
        before_first = int(np.searchsorted(t[start:stop], t_first)) - 2
        skipped = max(min(before_first, stop - start - 2), 0)
        first = start + skipped
        if stop - first >= 2:
            encoders.append(Encoder(t[first:stop], angle[first:stop]))
    return encoders


def _silence(what: str, seconds: float) -> str:
    """Return that nothing arrives, if that is so for longer than :data:`SILENT_S`; else an empty text."""
    return f"no {what} for {seconds:.0f} s" if seconds > SILENT_S else ""


class LiveSource:
    """Function that returns the last seconds of a stream as a recording, with figures about the stream."""

    def __init__(self, recent: RecentEvents, messages: Sequence[str]) -> None:
        """Start with events of at least one turn. ``messages`` grows while the stream is followed.

        Raises :class:`AmiwarpError` if there are fewer events.
        """
        first = recent.recording()
        if first is None:
            raise AmiwarpError(
                "the stream has delivered less than one full turn; wait for one",
                ErrorCode.CONTENT_MISSING,
            )
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
        interruption = recent.silence
        no_angles = "" if interruption else recent.encoder_silence
        lag_s = 0.0 if interruption else recent.lag_s
        message = self._messages[-1] if self._messages else ""
        rows = self._rows(interruption, no_angles, lag_s)
        if message and not interruption:
            rows.append(("last message", message, False))

        note = ""
        if interruption:
            further = "" if message == interruption else message
            note = f"The stream is interrupted: {interruption}. {further}".strip()
        elif no_angles:
            note = f"No prism angles arrive: {no_angles}. The last turn before it is shown, until they return."
        elif lag_s > LATE_S:
            note = (
                f"The events are {lag_s:.1f} s late: this computer, or the one that sends them, is slower than the "
                "stream. The newest whole turn that has come is shown."
            )
        return [[name, text, "bad" if is_bad else ""] for name, text, is_bad in rows], note

    def _rows(self, interruption: str, no_angles: str, lag_s: float) -> list[tuple[str, str, bool]]:
        """Return the figures as rows of name, value and whether it is bad.

        ``interruption``, ``no_angles``: why no events or no encoder samples arrive; empty if they do. ``lag_s``: lag of
        the events [s].
        """
        recent = self._recent
        status = recent.status
        receives = not interruption
        has_angles = receives and not no_angles
        is_fresh = has_angles and recent.turn_share >= 1.0

        rpm = self._rpm()
        speed = "unknown" if rpm is None else f"{rpm:.1f} rpm"
        if not is_fresh:
            speed += ", last measured"
        latency_ms = 1e3 * recent.age_s
        latency = f"{latency_ms:.0f} ms" if receives else "–"
        lag = f"{lag_s:.1f} s" if receives else "–"
        rate_mev_s = status.rate_mev_s if receives else 0.0
        events = "receiving" if receives else "interrupted, last ones shown"
        angles = "receiving" if has_angles else "interrupted, last turn shown"
        rows = [
            ("events", events, not receives),
            ("prism angles", angles, not has_angles),
            ("rate", f"{rate_mev_s:.2f} million events/s", False),
            ("latency", latency, receives and latency_ms > 1e3),
            ("lag", lag, lag_s > LATE_S),
            ("turn covered", f"{100.0 * recent.turn_share:.0f} %", recent.turn_share < 1.0),
            ("speed of the prism", speed, rpm is None or not is_fresh),
            ("lost events", f"{status.dropped:,}", status.dropped > 0),
            ("out of order", f"{status.late:,}", status.late > 0),
        ]
        saved = recent.recorder.text
        if saved:
            rows.append(("recording", saved, False))
        elif recent.recorder.problem:
            rows.append(("recording", f"ended: {recent.recorder.problem}", True))
        if recent.segment > 1:
            rows.append(("segment", f"{recent.segment}, since the source came back", False))
        return rows

    def _rpm(self) -> float | None:
        """Return the mean speed of the last turn of the shown events [turns/min]; None if it is unknown."""
        encoder = self._last.encoder
        if encoder is None:
            return None
        last_us = self._last.events.t_last
        turn_us = min(2e6, 60e6 / max(abs(encoder.rpm), 1.0))
        return rpm_between(encoder, round(last_us - turn_us), last_us)


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
    over = threading.Event()  # set when the block is left
    stop = threading.Event()  # of the session that runs, which sets it at its end, too
    failures: list[Exception] = []
    recent.link = link

    def report(status: SessionStatus) -> None:
        recent.status = replace(status)

    def end(text: str) -> None:
        recent.ended = text
        say(text)

    def follow(part: Source) -> None:
        nonlocal stop
        stop = threading.Event()
        if over.is_set():
            part.close()
            return
        session = Session(part, link=link, raw=[recent], policy=Policy.DROP_OLDEST, say=say)
        try:
            status = session.run(stop, report)
            problem = getattr(part, "problem", None)
            how = "has ended" if problem is None else f"broke off: {problem}"
            end(
                f"{part.name}: the stream {how}; the last of its {status.events:,} events are shown"
            )
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
                end(
                    f"{part.name}: is back with a camera of {_shape(part)}, before it had {_shape(source)}; "
                    "start the command again"
                )

    # No BackgroundLoop: the session has its own stop event, and its end is shown as text while the block runs.
    thread = threading.Thread(target=run, name="amiwarp-follow", daemon=True)
    thread.start()
    try:
        until_s = time.monotonic() + FIRST_S
        while recent.recording() is None:
            if not thread.is_alive() or time.monotonic() > until_s:
                if failures:
                    raise failures[0]
                how = f"in {FIRST_S:g} s" if thread.is_alive() else "before the stream ended"
                problem = getattr(source, "problem", None)
                why = "" if problem is None else f": it broke off, {problem}"
                raise AmiwarpError(
                    f"{source.name}: delivered less than one full turn {how}{why}",
                    ErrorCode.CONTENT_MISSING,
                )
            time.sleep(0.05)
        yield
    finally:
        over.set()
        stop.set()
        thread.join()
        recent.recorder.stop()


def _shape(source: Source) -> str:
    """Return numbers of pixels and of encoders of a source, for messages."""
    width, height = source.size
    return f"{width}x{height} pixels and {source.encoders} encoders"
