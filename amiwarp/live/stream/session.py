"""Live session: takes events from a source, compensates them, and gives them to files, servers and callbacks.

It checks the prism's phase meanwhile; :class:`RecentEvents` keeps the last seconds of a stream.
"""

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.result import Calibration, check_made_with_encoder
from amiwarp.choices import Sharpness
from amiwarp.compensation.streams import EXTRAPOLATED, NO_ANGLE, OUTSIDE, Compensated, Compensator
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TWO_PI, Encoder, EncoderStream, rpm_between, starts_of_runs
from amiwarp.events.recording import OVERHEAD, Events, MemoryEvents, Recording, held_bytes
from amiwarp.imaging.iwe import CanvasShape
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.io.native_format import LiveWriter
from amiwarp.live.link.camera_clock import NO_SHIFT_US, CameraClock, ClockSource
from amiwarp.live.link.clocks import ClockMap, monotonic_us
from amiwarp.live.link.link import Link, LinkUpdate
from amiwarp.live.queues import BackgroundWorker, EventSorter, PacketQueue, Policy
from amiwarp.live.stream.adaptive import SpeedKeeper
from amiwarp.live.stream.packets import NO_TIMES, Packet, Source
from amiwarp.live.stream.recorder import StreamRecorder
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism

# Check during a stream that the prism's phase has not changed since the calibration.

SEARCH_RAD = math.radians(20.0)
"""Half width of the search about the calibrated phase [rad]. A phase outside is found at the edge of this range, and
reported."""
CHANGE_RAD, OFFSET_RAD = math.radians(1.5), math.radians(5.0)
"""Smallest reported change of the phase since the first estimate, and smallest reported offset from the calibrated
phase [rad].

The bias of the estimate, beyond that in the calibration, is up to 3 deg.
"""
FEWEST_EVENTS = 20_000
"""Smallest number of events for an estimate of the phase. The events must also cover half a turn."""
MOST_CHECK_BYTES = 1 << 24
"""Memory limit of the latest events, from which the phase is estimated [bytes]: about a million events."""
EVALUATIONS = 40
"""Number of evaluations of the sharpness per estimate of the phases."""
PHASES = ("phase", "second_phase")
"""Names of the phases of models with one and with two angles."""


@dataclass(frozen=True, slots=True)
class PhaseEstimate:
    """Estimate of a prism's phase by sharpness."""

    name: str
    """Name of the phase, in :data:`PHASES`."""
    offset: float
    """Difference between the estimated and the calibrated phase [rad]."""
    std: float
    """Standard deviation of the estimated phase [rad]."""


class PhaseCheck:
    """Estimates the prism's phase repeatedly by sharpness, on the CPU in a background thread.

    For a pair of prisms and for a mirror, both phases are estimated together. The check needs the events that the
    compensator gets. The sharpness has a bias that depends on sensor and scene. Therefore the estimate is compared with
    that by sharpness in the calibration, if it has one, and the change since the first estimate is judged.
    """

    def __init__(self, calibration: Calibration, every_s: float, say: Callable[[str], None]) -> None:
        """Set up the check.

        ``every_s``: interval between estimates [s]; ``say`` is called with a message if the phase changed.
        """
        from amiwarp.calib.calibration import calibrate  # takes long to load, and ``record`` does not need it

        self._calibration, self._every_s, self._say = calibration, every_s, say
        self._calibrate = calibrate
        self._due, self._closed = 0.0, False
        self._recent: deque[Events] = deque()
        self.held_bytes = 0
        """Memory of the latest events that are kept for an estimate [bytes]."""
        self._thread: threading.Thread | None = None  # a daemon: the process may end while an estimate runs
        self._names = PHASES[: calibration.model.ANGLES]
        photometric = calibration.photometric
        sharp = {} if photometric is None else photometric.sharpness_parameters
        self._usual = {name: sharp.get(name, calibration.parameters[name]) for name in self._names}
        self._estimated: list[PhaseEstimate] = []
        self._first_estimate: list[PhaseEstimate] = []
        self._offset: float | None = None
        self._reported: dict[str, float] = {}

    def update(self, encoder: EncoderStream) -> float | None:
        """Start an estimate if one is due; return the latest offset from the calibrated phase [rad], at first None.

        Of two phases, return the larger offset.
        """
        if estimates := self.result():
            self._first_estimate = self._first_estimate or estimates
            self._offset = max((estimate.offset for estimate in estimates), key=abs)
            for estimate, first in zip(estimates, self._first_estimate, strict=True):
                self._report(estimate, first, sure=encoder.sure)
        if time.monotonic() >= self._due and self.start_check(encoder):
            self._due = time.monotonic() + self._every_s
        return self._offset

    def _report(self, estimate: PhaseEstimate, first: PhaseEstimate, *, sure: bool) -> None:
        """Report a large offset from the calibrated phase, or a significant change since the first estimate.

        ``sure``: whether the clocks of controller and camera are known. A wrong one turns the phase, too.
        """
        changed, phase = estimate.offset - first.offset, estimate.name.replace("_", " ")
        wrong_clock = ""
        if not sure:
            wrong_clock = (
                "the clocks of controller and camera are probably wrong: connect the sync pulses, or calibrate again"
            )
        reported = self._reported.pop(estimate.name, None)
        if reported is not None and abs(estimate.offset - reported) < CHANGE_RAD:
            self._reported[estimate.name] = reported
        elif abs(estimate.offset) > OFFSET_RAD:
            self._reported[estimate.name] = estimate.offset
            least = "at least " if abs(estimate.offset) > 0.99 * SEARCH_RAD else ""
            offset = f"{least}{math.degrees(estimate.offset):+.1f} deg"
            self._say(f"the {phase} differs from the calibrated one by {offset}: {wrong_clock or 'calibrate again'}")
        elif abs(changed) > max(CHANGE_RAD, 4.0 * math.hypot(estimate.std, first.std)):
            self._reported[estimate.name] = estimate.offset
            since = f"since the first check, to {math.degrees(estimate.offset):+.1f} deg from the calibrated one"
            why = wrong_clock or "has the index pulse slipped?"
            self._say(f"the {phase} has moved by {math.degrees(changed):+.1f} deg {since}: {why}")

    def put(self, events: Events) -> None:
        """Add events of the sensor, from which the next estimate is made."""
        self._recent.append(events)
        self.held_bytes += held_bytes(events)
        while self.held_bytes - held_bytes(self._recent[0]) > MOST_CHECK_BYTES:
            self.held_bytes -= held_bytes(self._recent.popleft())

    def start_check(self, encoder: EncoderStream) -> bool:
        """Start an estimate from the events of the last turn.

        Returns False if an estimate is running or the data do not suffice.
        """
        last = encoder.last
        if self._closed or self._thread is not None or last is None or not self._recent:
            return False
        events = Events.concatenate(list(self._recent))
        events = events[: int(events.t.searchsorted(last, side="right"))]
        if len(events) < FEWEST_EVENTS:
            return False
        samples = encoder.over(int(events.t[0]), int(events.t[-1]))
        speed = abs(samples.rpm) * TWO_PI / 60e6
        begin = int(events.t[-1]) - round(1.2 * TWO_PI / speed) if speed else int(events.t[0])
        events = events[int(events.t.searchsorted(begin)) :]
        swept = speed * float(events.t[-1] - events.t[0]) if len(events) else 0.0
        if len(events) < FEWEST_EVENTS or swept < TWO_PI / 2.0 or encoder.guessed(events.t).any():
            return False
        self._thread = threading.Thread(
            target=self._estimate, args=(events, samples), name="amiwarp-phase-check", daemon=True
        )
        self._thread.start()
        return True

    def result(self) -> list[PhaseEstimate]:
        """Return the new estimate of each phase once; an empty list if there is none."""
        if self._thread is None or self._thread.is_alive():
            return []
        self._thread.join()
        self._thread = None
        estimated, self._estimated = self._estimated, []
        return estimated

    def close(self, most_s: float = math.inf) -> None:
        """Wait for a running estimate for at most ``most_s`` [s], and start no further one."""
        self._closed = True
        if self._thread is not None:
            self._thread.join(None if math.isinf(most_s) else most_s)

    def _estimate(self, events: Events, encoder: Encoder) -> None:
        """Estimate the phases by a calibration in which all other parameters are fixed."""
        known, names = self._calibration, self._names
        bounds = {n: (self._usual[n] - SEARCH_RAD, self._usual[n] + SEARCH_RAD) for n in names}
        recording = Recording(MemoryEvents(events, known.camera.width, known.camera.height), known.camera, encoder,
                              known.prism, name="the stream")  # fmt: skip
        start = {n: x for n, x in {**known.parameters, **self._usual}.items() if n not in ("clock_offset", "rpm")}
        try:
            found = self._calibrate(
                recording, model=known.model_name, free=names, start=start, stages=("sharpness",), events=100_000,
                bounds=bounds, global_evaluations=EVALUATIONS, local_algorithm="LN_SBPLX", device="cpu",
            )  # fmt: skip
        except AmiwarpError:
            return  # for example without texture: a later estimate may succeed
        self._estimated = [PhaseEstimate(n, found.parameters[n] - self._usual[n], found.uncertainty[n]) for n in names]


# Consumers of a session's data: files and servers, each served by a background thread.


class RawConsumer(Protocol):
    """Consumer (protocol) of the sensor's events in order of time, and of encoder samples on the events' clock."""

    def append(self, events: Events, /) -> None: ...

    def append_encoder(
        self, t_us: NDArray[np.int64], angle: NDArray[np.float64], index_t_us: NDArray[np.int64], /, *, second: bool
    ) -> None: ...

    def tick(self) -> None: ...


class Consumers:
    """Consumers of a session's data. A consumer that fails is removed; the others continue.

    The consumers ``raw`` get the sensor's events, ``out`` gets the compensated events, and all get the encoder samples.
    The function ``fail`` is called with the errors of consumers.
    """

    def __init__(self, raw: Iterable[RawConsumer], out: LiveWriter | None, fail: Callable[[Exception], None]) -> None:
        self.raw = [(consumer, BackgroundWorker()) for consumer in raw]
        """Consumers of the sensor's events, each with the thread that calls it."""
        self.out = None if out is None else (out, BackgroundWorker())
        """The same for the consumer of compensated events."""
        self._fail = fail

    def append(self, events: Events) -> None:
        """Pass the sensor's events to the consumers of raw events."""
        for served in list(self.raw):
            self._put(served, partial(served[0].append, events), held_bytes(events), len(events))

    def append_encoder(
        self, t: NDArray[np.int64], angle: NDArray[np.float64], index_t: NDArray[np.int64], second: bool
    ) -> None:
        """Pass samples and index pulses of the first or second encoder to all consumers."""
        for served in self._all():
            append = partial(served[0].append_encoder, t, angle, index_t, second=second)
            self._put(served, append, t.nbytes + angle.nbytes + index_t.nbytes)

    def append_compensated(self, packet: Compensated) -> None:
        """Pass compensated events to the consumer of compensated events."""
        if self.out is None:
            return
        flags = packet.flags
        inside, extrapolated = (flags & OUTSIDE) == 0, (flags & (EXTRAPOLATED | NO_ANGLE)) != 0
        append = partial(self.out[0].append, packet.events, inside=inside, extrapolated=extrapolated)
        self._put(self.out, append, held_bytes(packet.events) + flags.nbytes, len(flags))

    def tick(self) -> None:
        """Let all consumers continue pending work, even without new data."""
        for served in self._all():
            self._put(served, served[0].tick)

    def finish(self, most_s: float) -> None:
        """Wait until the consumers have processed all data, and collect their errors.

        After ``most_s`` [s] the rest is dropped.
        """
        end = time.monotonic() + most_s
        for _, worker in self._all():
            try:
                worker.close(max(end - time.monotonic(), 0.0))
            except Exception as error:
                self._fail(error)

    @property
    def dropped(self) -> int:
        """Number of events that were dropped at the end, of all consumers."""
        return sum(worker.dropped for _, worker in self._all())

    def end(self) -> None:
        """Wait for the end of all background threads."""
        for _, worker in self._all():
            worker.end()

    def abandon(self) -> None:
        """Drop the waiting data, so that the caller can close the consumers at once."""
        for _, worker in self._all():
            worker.abandon()

    def _all(self) -> list[tuple[RawConsumer | LiveWriter, BackgroundWorker]]:
        return [*self.raw, *([] if self.out is None else [self.out])]

    def _put(
        self,
        served: tuple[RawConsumer | LiveWriter, BackgroundWorker],
        job: Callable[[], object],
        held: int = 0,
        events: int = 0,
    ) -> None:
        """Pass a job to a consumer's thread; remove the consumer if it has failed."""
        try:
            served[1].put(job, held, events)
        except Exception as error:
            self._fail(error)
            served[1].end()
            if served is self.out:
                self.out = None
            else:
                self.raw = [other for other in self.raw if other is not served]


# Status of a live session, and the figures in it that are measured between two reports.

IMAGE_US = 33_333
"""Length of the time window whose image gives the reported sharpness [us]."""


@dataclass(slots=True)
class SessionStatus:
    """Progress of a session. Counts are totals; shares, rates and latencies refer to the time since the last report."""

    seconds: float = 0.0
    """Duration of the session [s]."""
    events: int = 0
    """Number of events received so far."""
    done: int = 0
    """Number of events compensated so far."""
    outside: int = 0
    """Number of events displaced out of the image."""
    guessed: int = 0
    """Number of events compensated with an extrapolated prism angle."""
    unknown: int = 0
    """Number of events without a prism angle."""
    dropped: int = 0
    """Number of events dropped by the queue, see :class:`Policy`."""
    late: int = 0
    """Number of events that were out of order and got a later time."""
    waiting: int = 0
    """Number of events that wait in the queue or for encoder samples."""
    rate_mev_s: float = 0.0
    """Rate of the received events since the last report [million events/s]."""
    covered: float = 1.0
    """Share of events since the last report whose prism angle was interpolated between encoder samples."""
    latency_ms: tuple[float, float] = (0.0, 0.0)
    """Median and 99th percentile of the time from an event to its output [ms], with all that it waited for.

    It counts from the event's own time if the clocks are known, else from the earliest time at which the event can have
    happened: as if the packet with the shortest delay so far had none.
    """
    sharpness: float | None = None
    """Sharpness of the latest image of compensated events, over :data:`IMAGE_US`; None before the first."""
    rpm: float | None = None
    """Speed of the prism [turns/min]; None if it is unknown."""
    clock: ClockMap | None = None
    """Map from the controller's clock to the camera's; None without a link."""
    clock_source: ClockSource | None = None
    """How this map is known; None without a link."""
    coverage: float | None = None
    """Share of the scene's edges that the last window showed, 0 to 1; None without adaptive speed."""


class IntervalFigures:
    """Event rate, latency, and coverage by encoder samples, all since the last report."""

    def __init__(self, began_us: int) -> None:
        # at the last report: time [us]; numbers of events received, compensated, without a measured angle
        self._reported = (began_us, 0, 0, 0)
        self._latencies: list[float] = []

    def add(self, packet: Compensated, delay_us: float, status: SessionStatus) -> None:
        """Count a compensated packet in the figures of the interval. ``delay_us``: time from its last event [us]."""
        flags = packet.flags
        status.done += len(flags)
        if flags.any():
            status.outside += int(np.count_nonzero(flags & OUTSIDE))
            status.guessed += int(np.count_nonzero(flags & EXTRAPOLATED))
            status.unknown += int(np.count_nonzero(flags & NO_ANGLE))
        self._latencies.append(delay_us)

    def report(self, now_us: int, status: SessionStatus) -> None:
        """Write the figures since the last report into the status, and start the next interval."""
        then_us, events, done, unsure_then = self._reported
        unsure = status.guessed + status.unknown
        status.rate_mev_s = (status.events - events) / max(now_us - then_us, 1)
        status.covered = 1.0 - (unsure - unsure_then) / (status.done - done) if status.done > done else 1.0
        self._reported = (now_us, status.events, status.done, unsure)
        if self._latencies:
            median, slow = np.percentile(self._latencies, [50, 99]) * 1e-3
            status.latency_ms = float(median), float(slow)
            self._latencies.clear()


class WindowSharpness:
    """Measures the sharpness of the compensated image of one time window per report."""

    def __init__(self, compensator: Compensator, size: tuple[int, int], device: str) -> None:
        self._compensator = compensator
        self._meter = SharpnessMeter(CanvasShape(*size), Sharpness.VARIANCE, smoothing=1.0, device=device)
        self._start_us: int | None = None
        self._wanted = True

    def update(self, t: int) -> float | None:
        """Return the sharpness once the window is complete; ``t``: time up to which events are compensated [us]."""
        if self._start_us is None:
            self._compensator.image()  # discards the events before the window
            self._start_us = t
        elif self._wanted and t - self._start_us >= IMAGE_US:
            self._meter.image.write(self._compensator.image()[None])
            sharpness, self._start_us, self._wanted = self._meter.measure(), t, False
            return sharpness
        return None

    def restart(self) -> None:
        """Begin a new time window."""
        self._start_us, self._wanted = None, True


CLOCKS_US = NO_SHIFT_US + 2_000_000
"""Longest wait of the first events for the relation between the clocks of controller and camera [us]."""
PATIENCE_S = 1.0
"""Longest wait at the end of a session for the source's thread and for encoder samples of the last events [s]."""
DRAIN_S = 10.0
"""Longest time for the waiting data after a session was stopped from outside [s]. The rest is dropped and counted."""
POLL_S = 0.001
"""Longest wait for a packet between two polls of the encoder [s]."""
QUEUE_EVENTS = 1 << 23
"""Capacity of the queue before the compensator [events]: most of a second of the fastest sensor."""
STEP_BYTES = 1 << 22
"""Memory of the packets that are processed before controller and stop event are checked again [bytes]."""


class Session:
    """Takes events from a source, compensates them and distributes them until the source ends or a stop is requested.

    The caller opens and closes all objects that the session gets. ``calibration``: None to compensate nothing, for
    example to record. ``link``: its encoder samples replace those of the source. ``second_ratio``: speed of the second
    prism of a pair relative to the first, if only the first has an encoder. The consumers ``raw`` get the sensor's
    events, ``out`` gets the compensated events, and both get encoder samples; ``sinks`` get compensated packets.
    ``watch_s``: interval between checks of the phase [s]; None: no checks. ``keeper``: adaptive speed. ``wait_us``:
    longest wait of an event for its encoder samples [us]. ``policy`` and ``queue_events``: for the queue before the
    compensator. ``say`` is called with messages.
    """

    def __init__(
        self,
        source: Source,
        calibration: Calibration | None = None,
        *,
        link: Link | None = None,
        second_ratio: float | None = None,
        raw: Sequence[RawConsumer] = (),
        out: LiveWriter | None = None,
        sinks: tuple[Callable[[Compensated], None], ...] = (),
        watch_s: float | None = None,
        keeper: SpeedKeeper | None = None,
        wait_us: int = 10_000,
        policy: Policy = Policy.BLOCK,
        queue_events: int = QUEUE_EVENTS,
        device: Any = "cpu",
        say: Callable[[str], None] = print,
    ) -> None:
        self.status = SessionStatus()
        # A source's own samples are already shifted by its file's clock offset; the calibrated offset is more accurate.
        own = clock_offset(source, link)
        if calibration is not None:
            check_made_with_encoder(calibration)
        known = {} if calibration is None else calibration.parameters
        harmonics = None if calibration is None else calibration.harmonics
        offset = known.get("clock_offset", own) - own
        second: EncoderStream | float | None = second_ratio
        if second is None and encoder_count(source, link) == 2:
            second = EncoderStream(offset)
        self.encoder = EncoderStream(offset, second=second, harmonics=harmonics)
        self._source, self._link, self._sinks, self._keeper = source, link, list(sinks), keeper
        self._stop, self._hasty = threading.Event(), False
        self._say, self._drain_until, self._discarded = say, math.inf, 0
        self._failure: BaseException | None = None
        self._consumers = Consumers(raw, out, self._fail)
        self._feed = EncoderFeed(link, self.encoder, self._consumers.append_encoder, say)
        self._queue, self._sorter = PacketQueue(queue_events, policy), EventSorter()
        self._compensator: Compensator | None = None
        self._sharpness: WindowSharpness | None = None
        self._phase_check: PhaseCheck | None = None
        if calibration is not None:
            start = {} if link is None else {"start_us": CLOCKS_US}
            self._compensator = Compensator(calibration.model, self.encoder, wait_us=wait_us, device=device, **start)
            self._sharpness = WindowSharpness(self._compensator, source.size, device)
            self._phase_check = None if watch_s is None else PhaseCheck(calibration, watch_s, say)
        self._last_us = -(2**62)
        self._began_us = monotonic_us()
        self._figures = IntervalFigures(self._began_us)

    def run(
        self, stop: threading.Event, on_status: Callable[[SessionStatus], None], *, every_s: float = 0.2,
        seconds: float | None = None,
    ) -> SessionStatus:  # fmt: skip
        """Process the source until it ends or ``stop`` is set, and then everything received by then.

        If others set ``stop``, this takes :data:`DRAIN_S` at most. The rest is dropped, and counted in a message. The
        session sets ``stop`` itself after ``seconds`` [s], unless None. ``on_status`` gets the status every
        ``every_s`` [s] and at the end. Raises the error of the source or of a consumer, after everything received
        before it was processed. KeyboardInterrupt ends the session at once and drops all waiting data.
        """
        # No BackgroundLoop: the source may never return, then the session ends without it.
        reader = threading.Thread(target=self._read, args=(stop,), name="amiwarp-source", daemon=True)
        self._stop = stop
        reader.start()
        try:
            self._process(stop, on_status, every_s, math.inf if seconds is None else seconds)
            self._finish()
        except KeyboardInterrupt:
            self._abandon()
            raise
        finally:
            stop.set()
            self._queue.close()
            try:
                self._end(reader)
            except KeyboardInterrupt:
                self._abandon()
                raise
        self._report(on_status)
        if self._discarded or self._consumers.dropped:
            self._say(
                f"dropped {DRAIN_S:g} s after the stop: {self._discarded:,} events that waited to be processed, "
                f"{self._consumers.dropped:,} that waited to be written or sent"
            )
        if self._failure is not None:
            raise self._failure
        return self.status

    def _process(
        self, stop: threading.Event, on_status: Callable[[SessionStatus], None], every_s: float, most_s: float
    ) -> None:
        """Process packets until the queue is closed and empty."""
        due, stopped, on_time = 0.0, math.inf, False
        while not self._queue.ended:
            self._step()
            if self._seconds >= due:
                due = self._seconds + every_s
                self._report(on_status)
            if self._seconds >= most_s and not stop.is_set():
                on_time = True
                stop.set()
            if stop.is_set():
                stopped = min(stopped, self._seconds)
                if not on_time:
                    self._drain_until = stopped + DRAIN_S
                if self._seconds > self._drain_until:
                    self._discarded += self._queue.discard()
                if self._seconds - stopped > PATIENCE_S:  # the source's thread does not return
                    self._queue.close()

    def _end(self, reader: threading.Thread) -> None:
        """Wait for the threads at the end of the session."""
        reader.join(PATIENCE_S)
        if not reader.is_alive():
            self._source.close()
        if self._phase_check is not None and not self._hasty:
            self._phase_check.close(self._drain_left)
        if self._keeper is not None and not self._hasty:
            self._keeper.close()
        self._consumers.end()

    def _abandon(self) -> None:
        """Drop the data that wait for the consumers, so that the caller can close their files at once."""
        self._hasty = True
        self._consumers.abandon()

    def _fail(self, error: Exception) -> None:
        self._failure = self._failure or error
        self._stop.set()

    @property
    def _drain_left(self) -> float:
        """Remaining time for the waiting data [s]."""
        return max(self._drain_until - self._seconds, 0.0)

    @property
    def _seconds(self) -> float:
        return (monotonic_us() - self._began_us) * 1e-6

    def _read(self, stop: threading.Event) -> None:
        """Move packets from the source to the queue; runs in a background thread."""
        try:
            for packet in self._source.packets():
                self._queue.put(packet)
                if stop.is_set():
                    break
        except BaseException as error:
            self._failure = self._failure or error
        finally:
            self._queue.close()

    def _step(self) -> None:
        """Process the waiting packets, and distribute the compensated events that are ready."""
        self._poll_encoder()
        packet, events, held = self._queue.get(POLL_S), 0, 0
        most = 1 if self._compensator is None else self._compensator.batch
        while packet is not None:  # compensating waiting packets together is faster
            self._take(packet)
            events, held = events + len(packet.events), held + packet.held_bytes
            packet = self._queue.get(0.0) if events < most and held < STEP_BYTES else None
        if self._compensator is not None:
            self._give(self._compensator.take(monotonic_us()))

    def _poll_encoder(self) -> None:
        self._feed.poll()
        self.status.clock, self.status.clock_source = self._feed.clock, self._feed.clock_source

    def _take(self, packet: Packet) -> None:
        self._feed.take(packet)
        self._take_events(self._sorter.put(packet.events), packet.arrived_us)

    def _take_events(self, events: Events, arrived_us: int) -> None:
        """Pass the sorted events to all consumers of the sensor's events."""
        if not len(events):
            return
        self.status.events += len(events)
        self._last_us = int(events.t[-1])
        self._consumers.append(events)
        if self._phase_check is not None:
            self._phase_check.put(events)
        if self._compensator is not None:
            self._compensator.put(events, monotonic_us(), arrived_us=arrived_us)

    def _give(self, packets: list[Compensated]) -> None:
        """Pass compensated packets to all their consumers."""
        now = monotonic_us()
        for packet in packets:
            event_us = int(packet.events.t[-1])
            self._figures.add(packet, now - self._feed.host_time(event_us), self.status)
            self._consumers.append_compensated(packet)
            for sink in list(self._sinks):
                try:
                    sink(packet)
                except Exception as error:
                    self._fail(error)
                    self._sinks.remove(sink)
        if packets and self._keeper is not None:
            self._keeper.put(packets, self.encoder)
        if packets and self._sharpness is not None:
            sharpness = self._sharpness.update(int(packets[-1].events.t[-1]))
            self.status.sharpness = self.status.sharpness if sharpness is None else sharpness

    def _report(self, on_status: Callable[[SessionStatus], None]) -> None:
        status = self.status
        now = monotonic_us()
        status.seconds = self._seconds
        self._figures.report(now, status)
        status.dropped, status.late = self._queue.dropped, self._sorter.late
        status.waiting = self._queue.held + (0 if self._compensator is None else self._compensator.waiting)
        status.rpm = self.encoder.rpm
        status.coverage = None if self._keeper is None else self._keeper.coverage
        if self._phase_check is not None:
            self._phase_check.update(self.encoder)
        self._consumers.tick()
        if self._sharpness is not None:
            self._sharpness.restart()
        on_status(status)

    def _finish(self) -> None:
        """Process all data that are still held back, at the end of the session."""
        self._take_events(self._sorter.flush(), monotonic_us())
        end = monotonic_us() + 1e6 * PATIENCE_S
        while self._link is not None and monotonic_us() < end:
            self._poll_encoder()
            last = self.encoder.last
            if last is not None and last > self._last_us:  # the encoder samples cover the last events
                break
            time.sleep(POLL_S)
        if self._link is not None and self._feed.clock is None:
            self._feed.settle()
            self._poll_encoder()
        if self._compensator is not None:
            self._give(self._compensator.flush())
        self._consumers.finish(self._drain_left)


WAITING_S = 1.5
"""Time without a relation between the clocks after which the user is told [s]."""
MOST_WAITING = 1 << 20
"""Largest number of samples and index pulses that wait until the camera's clock is known. Beyond it, the oldest are
dropped."""


class EncoderFeed:
    """Appends encoder samples to an encoder, and gives them to the session's consumers.

    With a link, the controller's samples are used, on the camera's clock; else the source's own samples.
    """

    def __init__(
        self,
        link: Link | None,
        encoder: EncoderStream,
        give: Callable[[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], bool], None],
        say: Callable[[str], None],
    ) -> None:
        """Set up the feed.

        ``give`` is called with samples and index pulses on the events' clock and with whether they are those of the
        second encoder, ``say`` with messages.
        """
        self.clock: ClockMap | None = None
        """Map from the controller's clock to the camera's; None while it is unknown."""
        self.clock_source: ClockSource | None = None if link is None else ClockSource.UNKNOWN
        """How this map is known; None without a link."""
        self._link, self._encoder, self._give, self._say = link, encoder, give, say
        self._camera_clock = CameraClock()
        self._unknown_since = time.monotonic()
        self._has_related = False
        self._relation = 0
        self._shortest_us: int | None = None
        self._waiting: deque[LinkUpdate] = deque()
        self._waiting_samples = 0
        self._warned = False

    def poll(self) -> None:
        """Process the data that the controller has sent since the last call."""
        if self._link is None:
            return
        update = self._link.poll()
        for message in update.messages:
            self._say(message)
        if update.restarted:
            self._camera_clock.restart()
            self._encoder.restart()
            self._has_related = False
            self._clear()
        for _number, t_us, host_us in update.sync:
            self._camera_clock.sync(t_us, host_us)
        if _size(update):
            self._waiting.append(update)
            self._waiting_samples += _size(update)
        clock = self._camera_clock.clock(self._link.clock())
        self._follow_clock(clock, self._camera_clock.source)
        if clock is None:
            self._drop_oldest()
            return
        for waiting in self._waiting:
            self._append(clock(waiting.t_us), waiting.angle, clock(waiting.index_t_us))
        self._clear()

    def settle(self) -> None:
        """Wait for no more pulses, because the stream has ended."""
        self._camera_clock.settle()

    def host_time(self, event_us: int) -> float:
        """Return the host's time of an event [us]: by the clocks, else the earliest that its arrival allows."""
        host = None if self._link is None else self._link.clock()
        if host is not None and self.clock is not None and self._encoder.sure:
            return host.inverse(self.clock.inverse(event_us))
        return float(event_us + (self._shortest_us or 0))

    def _follow_clock(self, clock: ClockMap | None, source: ClockSource) -> None:
        """Take the relation between the clocks, and say how it is known if that has changed."""
        before, self.clock, self.clock_source = self.clock_source, clock, source
        now = time.monotonic()
        if source is ClockSource.UNKNOWN:
            if before is not source:
                self._unknown_since = now
            elif now - self._unknown_since > WAITING_S:
                self._unknown_since = math.inf
                self._say(
                    "the clocks of controller and camera are not known yet: events wait for sync pulses at the "
                    "camera's trigger input, and those that wait too long have no angle (flag 4)"
                )
            return
        if clock is None:
            return
        self._encoder.sure = source.sure
        relation = self._camera_clock.relation
        if self._has_related and relation != self._relation:  # the samples so far may be at wrong times
            self._encoder.clear()
        self._has_related, self._relation = True, relation
        if source is before:
            return
        known = {
            ClockSource.PULSES: f"by {clock.pairs} pulses, within {max(clock.offset_std_us, 0.1):.1f} µs",
            ClockSource.OLD: "by pulses that were seen long ago, and may have drifted apart since: all angles count as "
            "guessed (flag 2) until the camera sees sync pulses again",
            ClockSource.REGULAR: "by pulses at regular intervals, as an older controller sends them: arrival times "
            f"chose among shifts of {clock.offset_std_us * 1e-3:.0f} ms, so all angles count as guessed (flag 2); "
            "install newer firmware",
            ClockSource.ARRIVAL: f"by arrival times, within {clock.offset_std_us * 1e-3:.2g} ms at best, without sync "
            "pulses at the camera's trigger input: all angles count as guessed (flag 2)",
        }
        self._say(f"the clocks of controller and camera are related {known[source]}")

    def take(self, packet: Packet) -> None:
        """Process a source's packet: its arrival time and triggers with a link, else its own encoder samples."""
        if packet.returned:
            self._camera_clock.returned()
            if self._link is None:
                self._encoder.restart()
            else:  # its samples are on the clock that the camera had before, and may be later than the new events
                self._encoder.clear()
            self._has_related = False
            self._shortest_us = None
        if len(packet.events):
            last_us = int(packet.events.t[-1])
            self._camera_clock.packet(last_us, packet.arrived_us)
            delay_us = packet.arrived_us - last_us
            self._shortest_us = delay_us if self._shortest_us is None else min(self._shortest_us, delay_us)
        if self._link is not None:
            self._camera_clock.triggers(packet.triggers, packet.arrived_us)
            return
        if len(packet.encoder_t):
            self._append(packet.encoder_t, packet.encoder_angle, NO_TIMES)
        second = self._encoder.second
        if len(packet.second_t) and isinstance(second, EncoderStream):
            self._give(*second.append(packet.second_t, packet.second_angle), NO_TIMES, True)

    def _append(self, t: NDArray[np.int64], angle: NDArray[np.float64], index_t: NDArray[np.int64]) -> None:
        t, angle = self._encoder.append(t, angle)
        self._give(t, angle, index_t, False)
        if isinstance(self._encoder.second, float):
            self._give(t, self._encoder.second * angle, NO_TIMES, True)

    def _drop_oldest(self) -> None:
        """Drop the oldest waiting samples if there are too many; warn the user once."""
        if self._waiting_samples > MOST_WAITING and not self._warned:
            self._warned = True
            self._say("the camera's clock is not known yet: dropping the oldest encoder samples that wait for it")
        while self._waiting_samples > MOST_WAITING:
            self._waiting_samples -= _size(self._waiting.popleft())

    def _clear(self) -> None:
        self._waiting.clear()
        self._waiting_samples = 0


def _size(update: LinkUpdate) -> int:
    return len(update.t_us) + len(update.index_t_us)


def encoder_count(source: Source, link: Link | None) -> int:
    """Return the number of encoders that a session takes samples from: that of a link, or those of the source."""
    return source.encoders if link is None else 1


def clock_offset(source: Source, link: Link | None) -> float:
    """Return the clock offset of a file's own encoder [us], which a new recording of it shall keep; 0 with a link."""
    return 0.0 if link is not None else float(getattr(source, "clock_offset_us", 0.0))


# The last seconds of a stream in memory, available as a recording at any time.

SECONDS, MOST_BYTES = 2.0, 1 << 27
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

    def __init__(self, source: Source, camera: Camera | None = None, prism: NominalPrism | None = None) -> None:
        self._size, self._name = source.size, source.name
        self._camera, self._prism = camera or source.camera, prism or source.prism
        self._events: deque[Events] = deque()
        self._samples = tuple(deque[tuple[NDArray[np.int64], NDArray[np.float64]]]() for _ in range(2))
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
            known = [(bool(k), (t[t >= since], angle[t >= since])) for k in range(2) for t, angle in self._samples[k]]
            self.recorder.start(path, [(second, pair) for second, pair in known if len(pair[0])])

    def _writer(self, path: Path) -> LiveWriter:
        width, height = self._size
        encoders = 1 if self.link is not None else max(self._encoders, 1)
        return LiveWriter(
            path, width=width, height=height, camera=self._camera, prism=self._prism, metadata=self._metadata,
            encoders=encoders,
        )  # fmt: skip

    def append(self, events: Events) -> None:
        """Append events, in order of time."""
        with self._lock:
            self.recorder.append(events)
            self._arrived_s = time.monotonic()
            newest = int(events.t[-1])
            self._delay_us = 1e6 * self._arrived_s - newest
            self._least_delay_us = min(self._least_delay_us, self._delay_us) if self._events else self._delay_us
            self._events.append(events)
            self.event_bytes += held_bytes(events)
            # events whose encoder samples have not come yet are kept for longer
            sampled = [int(samples[-1][0][-1]) for samples in self._samples if samples]
            awaited = min([newest, *sampled]) - round(1e6 * SECONDS) if sampled else -(2**62)
            since = max(awaited, newest - round(1e6 * max(SECONDS, LONGEST_WAIT_S)))
            while len(self._events) > 1 and (self.event_bytes > MOST_BYTES or self._events[0].t[-1] < since):
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
                while len(samples) > 1 and (self.sample_bytes > MOST_BYTES or samples[0][0][-1] < since):
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
            self.ended, self.segment = "", self.segment + 1
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

        The angles of an encoder do not continue over a gap or a restart of its samples. So the events are those of the
        newest part without one in which they cover a turn. :attr:`turn_share` is that of the newest part with events.
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
            share = min(float(np.ptp(encoder.angle_at(covered.t[[0, -1]]))) / TWO_PI, 1.0)
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


def _runs(samples: list[tuple[NDArray[np.int64], NDArray[np.float64]]], t_first: int) -> list[Encoder]:
    """Return the encoders of samples without a gap or a restart, the newest first, from shortly before ``t_first`` on.

    Parts of fewer than two samples are left out. ``t_first``: time [us].
    """
    if not samples:
        return []
    t, angle = (np.concatenate(column) for column in zip(*samples, strict=True))
    starts, found = [*starts_of_runs(t, angle), len(t)], []
    for start, stop in reversed([*pairwise(starts)]):
        since = start + max(min(int(np.searchsorted(t[start:stop], t_first)) - 2, stop - start - 2), 0)
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
        self._recent, self._messages, self._last = recent, messages, first

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

        The speed is that of the last turn of the shown events; the latency is their age if they are shown now.
        """
        recent, problem, status = self._recent, self._recent.silence, self._recent.status
        last, encoder = self._last.events.t_last, self._last.encoder
        no_angles = "" if problem else recent.encoder_silence
        turn_us = 2e6 if encoder is None else min(2e6, 60e6 / max(abs(encoder.rpm), 1.0))
        rpm = None if encoder is None else rpm_between(encoder, round(last - turn_us), last)
        said, speed = self._messages[-1] if self._messages else "", "unknown" if rpm is None else f"{rpm:.1f} rpm"
        angles, rate = not (problem or no_angles), 0.0 if problem else status.rate_mev_s
        lag_s = 0.0 if problem else recent.lag_s
        fresh, latency_ms = angles and recent.turn_share >= 1.0, 1e3 * recent.age_s
        rows = [
            ("events", "interrupted, last ones shown" if problem else "receiving", problem),
            ("prism angles", "receiving" if angles else "interrupted, last turn shown", not angles),
            ("rate", f"{rate:.2f} million events/s", False),
            ("latency", "–" if problem else f"{latency_ms:.0f} ms", not problem and latency_ms > 1e3),
            ("lag", "–" if problem else f"{lag_s:.1f} s", lag_s > LATE_S),
            ("turn covered", f"{100.0 * recent.turn_share:.0f} %", recent.turn_share < 1.0),
            ("speed of the prism", speed if fresh else f"{speed}, last measured", rpm is None or not fresh),
            ("lost events", f"{status.dropped:,}", status.dropped), ("out of order", f"{status.late:,}", status.late),
        ]  # fmt: skip
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
                say(f"{part.name}: the stream is back: segment {recent.segment}, its times count anew")
                follow(part)
            else:
                part.close()
                now, before = (f"{s.size[0]}x{s.size[1]} pixels and {s.encoders} encoders" for s in (part, source))
                end(f"{part.name}: is back with a camera of {now}, before it had {before}; start the command again")

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
