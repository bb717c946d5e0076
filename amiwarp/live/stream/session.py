"""Live session: takes events from a source, filters and compensates them, and gives them to files, servers, callbacks.

It checks the prism's phase meanwhile.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from amiwarp.compensation.streams import Compensated, Compensator
from amiwarp.events.recording import Events
from amiwarp.imaging.filters import EventFilter
from amiwarp.io.native.live_writer import LiveWriter
from amiwarp.live.event_sorter import EventSorter
from amiwarp.live.link.camera_clock import NO_SHIFT_US
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.link import Link
from amiwarp.live.queues import PacketQueue, Policy
from amiwarp.live.stream.adaptive import SpeedKeeper
from amiwarp.live.stream.consumers import Consumers, RawConsumer
from amiwarp.live.stream.encoder_feed import EncoderFeed, event_encoder
from amiwarp.live.stream.packets import Packet, Source
from amiwarp.live.stream.phase_check import PhaseCheck
from amiwarp.live.stream.session_status import IntervalFigures, SessionStatus, WindowSharpness
from amiwarp.live.stream.stages import SessionStages
from amiwarp.optics.camera import Camera
from amiwarp.results.calibration import Calibration

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
STEP_EVENTS = 1 << 16
"""Number of events that are processed together without a compensator, which has its own batches."""
STEP_BYTES = 1 << 22
"""Memory of the packets that are processed before controller and stop event are checked again [bytes]."""


class Session:
    """Takes events from a source, compensates them and distributes them until the source ends or a stop is requested.

    The caller opens and closes all objects that the session gets. ``calibration``: None to compensate nothing, for
    example to record. ``link``: its encoder samples replace the source's. ``second_ratio``: speed of the second
    prism of a pair relative to the first, if only the first has an encoder. The consumers ``raw`` get the sensor's
    events, ``out`` gets the compensated events, and both get encoder samples; ``sinks`` get compensated packets.
    Without a calibration, ``out`` and ``sinks`` get events that are not compensated. ``chosen``: the events for ``out``
    and ``sinks``; None: all. ``undistort``: camera whose lens distortion they lose; None: they keep it.
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
        chosen: EventFilter | None = None,
        undistort: Camera | None = None,
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
        self.encoder = event_encoder(source, calibration, link, second_ratio)
        self._source = source
        self._link = link
        self._sinks = list(sinks)
        self._keeper = keeper
        self._stop = threading.Event()
        self._hasty = False
        self._say = say
        self._drain_until = math.inf
        self._discarded = 0
        self._failure: BaseException | None = None
        self._consumers = Consumers(raw, out, self._fail)
        self._feed = EncoderFeed(link, self.encoder, self._consumers.append_encoder, say)
        self._queue = PacketQueue(queue_events, policy)
        self._sorter = EventSorter()
        self._stages = SessionStages(
            source.size,
            chosen,
            undistort,
            compensates=calibration is not None,
            delay_us=self._delay_us,
        )
        self._collected: list[Events] = []
        self._collected_us = 0
        """Events of the current step that the filter has not seen yet, and the time when the first arrived [us]."""
        self._gives_plain = calibration is None and (out is not None or bool(sinks))
        self._compensator: Compensator | None = None
        self._sharpness: WindowSharpness | None = None
        self._phase_check: PhaseCheck | None = None
        if calibration is not None:
            start = {} if link is None else {"start_us": CLOCKS_US}
            self._compensator = Compensator(
                calibration.model, self.encoder, wait_us=wait_us, device=device, **start
            )
            self._sharpness = WindowSharpness(self._compensator, source.size, device)
            self._phase_check = None if watch_s is None else PhaseCheck(calibration, watch_s, say)
        self._last_us = -(2**62)
        self._began_us = monotonic_us()
        self._figures = IntervalFigures(self._began_us)

    def run(
        self,
        stop: threading.Event,
        on_status: Callable[[SessionStatus], None],
        *,
        every_s: float = 0.2,
        seconds: float | None = None,
    ) -> SessionStatus:
        """Process the source until it ends or ``stop`` is set, and then everything received by then.

        If others set ``stop``, this takes :data:`DRAIN_S` at most. The rest is dropped, and counted in a message. The
        session sets ``stop`` itself after ``seconds`` [s], unless None. ``on_status`` gets the status every
        ``every_s`` [s] and at the end. Raises the error of the source or of a consumer, after everything received
        before it was processed. KeyboardInterrupt ends the session at once and drops all waiting data.
        """
        # No BackgroundLoop: the source may never return, then the session ends without it.
        reader = threading.Thread(
            target=self._read, args=(stop,), name="amiwarp-source", daemon=True
        )
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
        self,
        stop: threading.Event,
        on_status: Callable[[SessionStatus], None],
        every_s: float,
        most_s: float,
    ) -> None:
        """Process packets until the queue is closed and empty."""
        due = 0.0
        stopped = math.inf
        on_time = False
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
            self._phase_check.close(self.drain_left)
        if self._keeper is not None and not self._hasty:
            self._keeper.close()
        self._consumers.join()

    def _abandon(self) -> None:
        """Drop the data that wait for the consumers, so that the caller can close their files at once."""
        self._hasty = True
        self._consumers.abandon()

    def _fail(self, error: Exception) -> None:
        self._failure = self._failure or error
        self._stop.set()

    @property
    def drain_left(self) -> float:
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
        packet = self._queue.get(POLL_S)
        events = 0
        held = 0
        most = STEP_EVENTS if self._compensator is None else self._compensator.batch
        while packet is not None:  # processing waiting packets together is faster
            self._take(packet)
            events = events + len(packet.events)
            held = held + packet.held_bytes
            packet = self._queue.get(0.0) if events < most and held < STEP_BYTES else None
        self._pass_collected()
        if self._compensator is not None:
            self._give_compensated(self._compensator.take(monotonic_us()))

    def _poll_encoder(self) -> None:
        self._feed.poll()
        self.status.clock = self._feed.clock
        self.status.clock_source = self._feed.clock_source

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
        if not self._collected:
            self._collected_us = arrived_us
        self._collected.append(events)
        if self._compensator is not None and not self._stages.filters:
            self._pass_collected()  # the compensator joins packets itself, without a further copy

    def _pass_collected(self) -> None:
        """Filter the collected events, and pass them on to the compensator or the outputs."""
        if not self._collected:
            return
        events = Events.concatenate(self._collected)
        self._collected = []
        kept = self._stages.chosen_of(events)
        if not len(kept):
            return
        if self._compensator is not None:
            self._compensator.put(kept, monotonic_us(), arrived_us=self._collected_us)
        elif self._gives_plain:
            self._give([self._stages.plain(kept, self._collected_us)])

    def _delay_us(self, event_us: int) -> float:
        """Return the time since an event [us]: by the clocks, else at least as long."""
        return monotonic_us() - self._feed.host_time(event_us)

    def _give_compensated(self, packets: list[Compensated]) -> None:
        """Pass the packets of the compensator to the last stage, and to all consumers."""
        self._give([self._stages.compensated(packet) for packet in packets])
        if packets and self._keeper is not None:
            self._keeper.put(packets, self.encoder)
        if packets and self._sharpness is not None:
            sharpness = self._sharpness.update(int(packets[-1].events.t[-1]))
            self.status.sharpness = self.status.sharpness if sharpness is None else sharpness

    def _give(self, packets: list[Compensated]) -> None:
        """Pass packets that have left the last stage to all their consumers."""
        for packet in packets:
            self._figures.add(packet, self._delay_us(int(packet.events.t[-1])), self.status)
            self._consumers.append_compensated(packet)
            for sink in list(self._sinks):
                try:
                    sink(packet)
                except Exception as error:
                    self._fail(error)
                    self._sinks.remove(sink)

    def _report(self, on_status: Callable[[SessionStatus], None]) -> None:
        status = self.status
        now = monotonic_us()
        status.seconds = self._seconds
        self._figures.report(now, status)
        status.dropped = self._queue.dropped
        status.late = self._sorter.late
        status.stages = self._stages.report(status, self._queue.received)
        status.waiting = self._queue.held + (
            0 if self._compensator is None else self._compensator.waiting
        )
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
        self._pass_collected()
        end = monotonic_us() + 1e6 * PATIENCE_S
        while self._link is not None and monotonic_us() < end:
            self._poll_encoder()
            last = self.encoder.last
            if (
                last is not None and last > self._last_us
            ):  # the encoder samples cover the last events
                break
            time.sleep(POLL_S)
        if self._link is not None and self._feed.clock is None:
            self._feed.settle()
            self._poll_encoder()
        if self._compensator is not None:
            self._give_compensated(self._compensator.flush())
        self._consumers.drain(self.drain_left)
