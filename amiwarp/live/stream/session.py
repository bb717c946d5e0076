"""Live session: takes events from a source, compensates them, and gives them to files, servers and callbacks."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.result import Calibration
from amiwarp.choices import Sharpness
from amiwarp.compensation.streams import EXTRAPOLATED, NO_ANGLE, OUTSIDE, Compensated, Compensator
from amiwarp.events.encoder import EncoderStream
from amiwarp.events.recording import Events, held_bytes
from amiwarp.imaging.iwe import CanvasShape
from amiwarp.imaging.metrics import SharpnessMeter
from amiwarp.io.native_writer import LiveWriter
from amiwarp.live.link.clocks import ClockMap, monotonic_us
from amiwarp.live.link.follower import LinkUpdate
from amiwarp.live.link.link import Link
from amiwarp.live.stream.adaptive import SpeedKeeper
from amiwarp.live.stream.camera_clock import CameraClock, clock_offset
from amiwarp.live.stream.packets import NO_TIMES, Packet, Source
from amiwarp.live.stream.phase_check import PhaseCheck
from amiwarp.live.stream.queues import BackgroundWorker, EventSorter, PacketQueue, Policy

# Consumers of a session's data: files and servers, each served by a background thread.


class RawConsumer(Protocol):
    """Consumer (protocol) of the sensor's events in order of time, and of encoder samples on the events' clock."""

    def append(self, events: Events, /) -> None: ...

    def append_encoder(
        self, t_us: NDArray[np.int64], angle: NDArray[np.float64], index_t_us: NDArray[np.int64], /
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
            self._put(served, partial(served[0].append, events), held_bytes(events))

    def append_encoder(self, t: NDArray[np.int64], angle: NDArray[np.float64], index_t: NDArray[np.int64]) -> None:
        """Pass encoder samples and index pulses to all consumers."""
        for served in self._all():
            append = partial(served[0].append_encoder, t, angle, index_t)
            self._put(served, append, t.nbytes + angle.nbytes + index_t.nbytes)

    def append_compensated(self, packet: Compensated) -> None:
        """Pass compensated events to the consumer of compensated events."""
        if self.out is None:
            return
        flags = packet.flags
        inside, extrapolated = (flags & OUTSIDE) == 0, (flags & (EXTRAPOLATED | NO_ANGLE)) != 0
        append = partial(self.out[0].append, packet.events, inside=inside, extrapolated=extrapolated)
        self._put(self.out, append, held_bytes(packet.events) + flags.nbytes)

    def tick(self) -> None:
        """Let all consumers continue pending work, even without new data."""
        for served in self._all():
            self._put(served, served[0].tick)

    def finish(self) -> None:
        """Wait until the consumers have processed all data, and collect their errors."""
        for _, worker in self._all():
            try:
                worker.close()
            except Exception as error:
                self._fail(error)

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
        self, served: tuple[RawConsumer | LiveWriter, BackgroundWorker], job: Callable[[], object], held: int = 0
    ) -> None:
        """Pass a job to a consumer's thread; remove the consumer if it has failed."""
        try:
            served[1].put(job, held)
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
    """Median and 99th percentile of the time from a packet's arrival to its output [ms]."""
    sharpness: float | None = None
    """Sharpness of the latest image of compensated events, over :data:`IMAGE_US`; None before the first."""
    rpm: float | None = None
    """Speed of the prism [turns/min]; None if it is unknown."""
    clock: ClockMap | None = None
    """Map from the controller's clock to the camera's; None without a link."""
    coverage: float | None = None
    """Share of the scene's edges that the last window showed, 0 to 1; None without adaptive speed."""
    phase_away: float | None = None
    """Difference between the latest estimated and the calibrated phase [rad]; None without an estimate."""


class IntervalFigures:
    """Event rate, latency, and coverage by encoder samples, all since the last report."""

    def __init__(self, began_us: int) -> None:
        # at the last report: time [us]; numbers of events received, compensated, without a measured angle
        self._reported = (began_us, 0, 0, 0)
        self._latencies: list[int] = []

    def add(self, packet: Compensated, now_us: int, status: SessionStatus) -> None:
        """Count a compensated packet in the figures of the interval."""
        flags = packet.flags
        status.done += len(flags)
        if flags.any():
            status.outside += int(np.count_nonzero(flags & OUTSIDE))
            status.guessed += int(np.count_nonzero(flags & EXTRAPOLATED))
            status.unknown += int(np.count_nonzero(flags & NO_ANGLE))
        self._latencies.append(now_us - packet.arrived_us)

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


PATIENCE_S = 1.0
"""Longest wait at the end of a session for the source's thread and for encoder samples of the last events [s]."""
POLL_S = 0.001
"""Longest wait for a packet between two polls of the encoder [s]."""
QUEUE_EVENTS = 1 << 23
"""Capacity of the queue before the compensator [events]: most of a second of the fastest sensor."""
STEP_BYTES = 1 << 22
"""Memory of the packets that are processed before controller and stop event are checked again [bytes]."""


class Session:
    """Takes events from a source, compensates them and distributes them until the source ends or a stop is requested.

    The caller opens and closes all objects that the session gets. ``calibration``: None to compensate nothing, for
    example to record. ``link``: its encoder samples replace those of the source. The consumers ``raw`` get the sensor's
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
        known = {} if calibration is None else calibration.parameters
        self.encoder = EncoderStream(known.get("clock_offset", own) - own)
        self._source, self._link, self._sinks, self._keeper = source, link, list(sinks), keeper
        self._stop, self._hasty = threading.Event(), False
        self._failure: BaseException | None = None
        self._consumers = Consumers(raw, out, self._fail)
        self._feed = EncoderFeed(link, self.encoder, self._consumers.append_encoder, say)
        self._queue, self._sorter = PacketQueue(queue_events, policy), EventSorter()
        self._compensator: Compensator | None = None
        self._sharpness: WindowSharpness | None = None
        self._phase_check: PhaseCheck | None = None
        if calibration is not None:
            self._compensator = Compensator(calibration.model, self.encoder, wait_us=wait_us, device=device)
            self._sharpness = WindowSharpness(self._compensator, source.size, device)
            self._phase_check = None if watch_s is None else PhaseCheck(calibration, watch_s, say)
        self._last_us = -(2**62)
        self._began_us = monotonic_us()
        self._figures = IntervalFigures(self._began_us)

    def run(
        self, stop: threading.Event, on_status: Callable[[SessionStatus], None], *, every_s: float = 0.2
    ) -> SessionStatus:
        """Process the source until it ends or ``stop`` is set, and then everything received by then.

        ``on_status`` gets the status every ``every_s`` [s] and at the end. Raises the error of the source or of a
        consumer, after everything received before it was processed. KeyboardInterrupt ends the session at once and
        drops all waiting data.
        """
        reader = threading.Thread(target=self._read, args=(stop,), name="amiwarp-source", daemon=True)
        self._stop = stop
        reader.start()
        try:
            self._process(stop, on_status, every_s)
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
        if self._failure is not None:
            raise self._failure
        return self.status

    def _process(self, stop: threading.Event, on_status: Callable[[SessionStatus], None], every_s: float) -> None:
        """Process packets until the queue is closed and empty."""
        due, stopped = 0.0, math.inf
        while not self._queue.ended:
            self._step()
            if self._seconds >= due:
                due = self._seconds + every_s
                self._report(on_status)
            if stop.is_set():
                stopped = min(stopped, self._seconds)
                if self._seconds - stopped > PATIENCE_S:  # the source's thread does not return
                    self._queue.close()

    def _end(self, reader: threading.Thread) -> None:
        """Wait for the threads at the end of the session."""
        reader.join(PATIENCE_S)
        if not reader.is_alive():
            self._source.close()
        for background in (self._phase_check, self._keeper):
            if background is not None and not self._hasty:
                background.close()
        self._consumers.end()

    def _abandon(self) -> None:
        """Drop the data that wait for the consumers, so that the caller can close their files at once."""
        self._hasty = True
        self._consumers.abandon()

    def _fail(self, error: Exception) -> None:
        self._failure = self._failure or error
        self._stop.set()

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
        self.status.clock = self._feed.clock

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
            self._figures.add(packet, now, self.status)
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
            status.phase_away = self._phase_check.update(self.encoder)
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
        if self._compensator is not None:
            self._give(self._compensator.flush())
        self._consumers.finish()


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
        give: Callable[[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]], None],
        say: Callable[[str], None],
    ) -> None:
        """Set up the feed.

        ``give`` is called with samples and index pulses on the events' clock, ``say`` with messages.
        """
        self.clock: ClockMap | None = None
        """Map from the controller's clock to the camera's; None while it is unknown."""
        self._link, self._encoder, self._give, self._say = link, encoder, give, say
        self._camera_clock = CameraClock()
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
            self._clear()
        for _number, t_us, host_us in update.sync:
            self._camera_clock.sync(t_us, host_us)
        if _size(update):
            self._waiting.append(update)
            self._waiting_samples += _size(update)
        clock = self.clock = self._camera_clock.clock(self._link.clock())
        if clock is None:
            self._drop_oldest()
            return
        for waiting in self._waiting:
            self._append(clock(waiting.t_us), waiting.angle, clock(waiting.index_t_us))
        self._clear()

    def take(self, packet: Packet) -> None:
        """Process a source's packet: its arrival time and triggers with a link, else its own encoder samples."""
        if packet.returned:
            self._camera_clock.returned()
            self._encoder.restart()
        if len(packet.events):
            self._camera_clock.packet(int(packet.events.t[-1]), packet.arrived_us)
        if self._link is not None:
            self._camera_clock.triggers(packet.triggers, packet.arrived_us)
        elif len(packet.encoder_t):
            self._append(packet.encoder_t, packet.encoder_angle, NO_TIMES)

    def _append(self, t: NDArray[np.int64], angle: NDArray[np.float64], index_t: NDArray[np.int64]) -> None:
        t, angle = self._encoder.append(t, angle)
        self._give(t, angle, index_t)

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
