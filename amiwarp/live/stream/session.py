"""A live session: a source, the link to the prism and the compensator, and where it all goes."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from amiwarp.compensation.streams import EXTRAPOLATED, NO_ANGLE, OUTSIDE, Compensated, Compensator, held_bytes
from amiwarp.events.encoder_stream import EncoderStream
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.sharpness_costs import SharpnessMeter
from amiwarp.imaging.warped_image import CanvasShape
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.stream.background_worker import BackgroundWorker
from amiwarp.live.stream.clocking import CameraClock, clock_offset
from amiwarp.live.stream.packets import NO_TIMES, Sorter
from amiwarp.live.stream.phase_check import PhaseCheck
from amiwarp.live.stream.policy import Policy
from amiwarp.live.stream.queues import PacketQueue

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.result import Calibration
    from amiwarp.events.events import Events
    from amiwarp.io.live_writer import LiveWriter
    from amiwarp.live.link.clocks import Clock
    from amiwarp.live.link.link import Link
    from amiwarp.live.link.news import News
    from amiwarp.live.stream.packets import Packet, Source
    from amiwarp.live.stream.speed_control import SpeedKeeper

IMAGE_US = 33_333
"""Window of the image whose sharpness is told [us]."""
PATIENCE_S = 1.0
"""A source that was told to stop gives up its thread within this, and samples of the last events come."""
POLL_S = 0.001
"""Longest wait for a packet, between two looks at the encoder."""
QUEUE_EVENTS = 1 << 23
"""Events between the source and the compensator: most of a second of the busiest sensor."""
STEP_BYTES = 1 << 22
"""Packets taken in at once, before the controller and a wish to stop are looked at again [bytes]."""
MOST_HELD = 1 << 20
"""Encoder samples and index pulses that wait for the camera's clock to be known; the oldest are dropped."""


@dataclass(slots=True)
class Status:
    """How a session goes; counts since its beginning, shares and rates since the status before."""

    seconds: float = 0.0
    events: int = 0
    """Taken in."""
    done: int = 0
    """Compensated."""
    outside: int = 0
    guessed: int = 0
    unknown: int = 0
    dropped: int = 0
    """By the queue, see :class:`Policy`."""
    late: int = 0
    """That came after later ones."""
    waiting: int = 0
    """For the encoder, or in the queue."""
    rate_mev_s: float = 0.0
    covered: float = 1.0
    """Share whose angle the encoder gave."""
    latency_ms: tuple[float, float] = (0.0, 0.0)
    """From a packet's arrival to its coming out, median and 99th percentile."""
    sharpness: float | None = None
    """Of the last image, over :data:`IMAGE_US`."""
    rpm: float | None = None
    clock: Clock | None = None
    """The camera's beside the controller's, where there is a link."""
    coverage: float | None = None
    """Share of the edges that the last window saw, where the speed is adaptive."""
    phase_away: float | None = None
    """What the watch found last, from the calibrated phase [rad]."""


class Raw(Protocol):
    """Takes events as they came, in order, and the encoder's samples on their clock; each in a thread of its own."""

    def append(self, events: Events, /) -> None: ...

    def append_encoder(
        self, t_us: NDArray[np.int64], angle: NDArray[np.float64], index_t_us: NDArray[np.int64], /
    ) -> None: ...

    def tick(self) -> None: ...


class Session:
    """Takes in what a source gives until it ends or is told to stop; compensates, writes and hands on all of it.

    ``calibration``: None where nothing is to be compensated, as for a recording. ``link``: its samples are used in
    place of the source's. ``out`` gets the compensated events and the encoder, ``sinks`` the compensated packets. All
    are the caller's to open and to close.
    """

    def __init__(
        self,
        source: Source,
        calibration: Calibration | None = None,
        *,
        link: Link | None = None,
        raw: Sequence[Raw] = (),
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
        self.status = Status()
        self._source, self._link, self._sinks, self._keeper, self._say = source, link, list(sinks), keeper, say
        self._raw: list[tuple[Raw | LiveWriter, BackgroundWorker]] = [(taker, BackgroundWorker()) for taker in raw]
        self._out = None if out is None else (out, BackgroundWorker())
        self._stop = threading.Event()
        self._queue = PacketQueue(queue_events, policy)
        self._sorter, self._camera_clock = Sorter(), CameraClock()
        # a source's own samples are on the events' clock already, as its file says; what was calibrated says it better
        own = clock_offset(source, link)
        known = {} if calibration is None else calibration.parameters
        self.encoder = EncoderStream(known.get("clock_offset", own) - own)
        self._held: deque[News] = deque()
        self._held_samples, self._told_held = 0, False
        self._hasty = False
        self._compensator: Compensator | None = None
        self._meter: SharpnessMeter | None = None
        self._watch: PhaseCheck | None = None
        if calibration is not None:
            model = calibration.model
            self._compensator = Compensator(model, self.encoder, wait_us=wait_us, device=device)
            self._meter = SharpnessMeter(CanvasShape(*source.size), Sharpness.VARIANCE, smoothing=1.0, device=device)
            if watch_s is not None:
                self._watch = PhaseCheck(calibration, watch_s, say)
        self._failed: BaseException | None = None
        self._image_us: int | None = None
        self._wants_image = True
        self._last_us = -(2**62)
        self._latencies: list[int] = []
        self._began_us = monotonic_us()
        self._since = (self._began_us, 0, 0, 0)

    def run(self, stop: threading.Event, on_status: Callable[[Status], None], *, every_s: float = 0.2) -> Status:
        """Until the source has ended or ``stop`` is set, and then to the end of what had come by then.

        Raises :class:`AmiwarpError` where source or a writer failed, after all that came before was worked through.
        KeyboardInterrupt ends it at once: what still waits is dropped.
        """
        reader = threading.Thread(target=self._read, args=(stop,), name="amiwarp-source", daemon=True)
        self._stop = stop
        reader.start()
        due, told = 0.0, math.inf
        try:
            while not self._queue.ended:
                self._step()
                if self._seconds >= due:
                    due = self._seconds + every_s
                    self._report(on_status)
                if stop.is_set():
                    told = min(told, self._seconds)
                    if self._seconds - told > PATIENCE_S:  # the source does not let go of its thread
                        self._queue.close()
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
        if self._failed is not None:
            raise self._failed
        return self.status

    def _end(self, reader: threading.Thread) -> None:
        """Wait for the threads."""
        reader.join(PATIENCE_S)
        if not reader.is_alive():
            self._source.close()
        for aside in (self._watch, self._keeper):
            if aside is not None and not self._hasty:
                aside.close()
        for _, beside in self._takers:
            beside.end()

    def _abandon(self) -> None:
        """Drop what waits for the takers, so that the caller can finish their files at once."""
        self._hasty = True
        for _, beside in self._takers:
            beside.abandon()

    @property
    def _takers(self) -> list[tuple[Raw | LiveWriter, BackgroundWorker]]:
        return [*self._raw, *([] if self._out is None else [self._out])]

    def _hand(self, taker: tuple[Raw | LiveWriter, BackgroundWorker], job: Callable[[], object], held: int = 0) -> None:
        """To a taker; of one that failed no more is asked, the others get all that came until the session ends."""
        try:
            taker[1].put(job, held)
        except Exception as error:
            self._fail(error)
            taker[1].end()
            if taker is self._out:
                self._out = None
            else:
                self._raw = [other for other in self._raw if other is not taker]

    def _fail(self, error: Exception) -> None:
        self._failed = self._failed or error
        self._stop.set()

    @property
    def _seconds(self) -> float:
        return (monotonic_us() - self._began_us) * 1e-6

    def _read(self, stop: threading.Event) -> None:
        try:
            for packet in self._source.packets():
                self._queue.put(packet)
                if stop.is_set():
                    break
        except BaseException as error:
            self._failed = self._failed or error
        finally:
            self._queue.close()

    def _step(self) -> None:
        self._follow()
        packet, events, held = self._queue.get(POLL_S), 0, 0
        most = 1 if self._compensator is None else self._compensator.batch
        while packet is not None:  # what waits is compensated together, which is faster
            self._take_in(packet)
            events, held = events + len(packet.events), held + packet.held_bytes
            packet = self._queue.get(0.0) if events < most and held < STEP_BYTES else None
        if self._compensator is not None:
            self._give_out(self._compensator.take(monotonic_us()))

    def _follow(self) -> None:
        """What the controller sent: its clock to the camera's, its samples to the encoder."""
        if self._link is None:
            return
        news = self._link.poll()
        for message in news.messages:
            self._say(message)
        if news.restarted:
            self._camera_clock.restart()
            self.encoder.restart()
            self._let_go()
        for _number, t_us, host_us in news.sync:
            self._camera_clock.sync(t_us, host_us)
        if len(news.t_us) or len(news.index_t_us):
            self._held.append(news)
            self._held_samples += len(news.t_us) + len(news.index_t_us)
        clock = self.status.clock = self._camera_clock.clock(self._link.clock())
        if clock is None:
            if self._held_samples > MOST_HELD and not self._told_held:
                self._told_held = True
                self._say("the camera's clock is not known yet: the oldest of the samples that wait for it are dropped")
            while self._held_samples > MOST_HELD:
                oldest = self._held.popleft()
                self._held_samples -= len(oldest.t_us) + len(oldest.index_t_us)
            return
        for held in self._held:
            self._sample(clock(held.t_us), held.angle, clock(held.index_t_us))
        self._let_go()

    def _let_go(self) -> None:
        self._held.clear()
        self._held_samples = 0

    def _sample(self, t: NDArray[np.int64], angle: NDArray[np.float64], index_t: NDArray[np.int64]) -> None:
        t, angle = self.encoder.append(t, angle)
        for taker in self._takers:
            append = partial(taker[0].append_encoder, t, angle, index_t)
            self._hand(taker, append, t.nbytes + angle.nbytes + index_t.nbytes)

    def _take_in(self, packet: Packet) -> None:
        if packet.returned:
            self._camera_clock.returned()
            self.encoder.restart()
        if len(packet.events):
            self._camera_clock.packet(int(packet.events.t[-1]), packet.arrived_us)
        if self._link is not None:
            self._camera_clock.triggers(packet.triggers, packet.arrived_us)
        elif len(packet.encoder_t):
            self._sample(packet.encoder_t, packet.encoder_angle, NO_TIMES)
        self._pass_on(self._sorter.put(packet.events), packet.arrived_us)

    def _pass_on(self, events: Events, arrived_us: int) -> None:
        """Events in order, to where they go."""
        if not len(events):
            return
        self.status.events += len(events)
        self._last_us = int(events.t[-1])
        for taker in list(self._raw):
            self._hand(taker, partial(taker[0].append, events), held_bytes(events))
        if self._watch is not None:
            self._watch.put(events)
        if self._compensator is not None:
            self._compensator.put(events, monotonic_us(), arrived_us=arrived_us)

    def _give_out(self, packets: list[Compensated]) -> None:
        now, status = monotonic_us(), self.status
        for packet in packets:
            flags = packet.flags
            status.done += len(flags)
            if flags.any():
                status.outside += int(np.count_nonzero(flags & OUTSIDE))
                status.guessed += int(np.count_nonzero(flags & EXTRAPOLATED))
                status.unknown += int(np.count_nonzero(flags & NO_ANGLE))
            self._latencies.append(now - packet.arrived_us)
            if self._out is not None:
                inside, guessed = (flags & OUTSIDE) == 0, (flags & (EXTRAPOLATED | NO_ANGLE)) != 0
                append = partial(self._out[0].append, packet.events, inside=inside, extrapolated=guessed)
                self._hand(self._out, append, held_bytes(packet.events) + flags.nbytes)
            for sink in list(self._sinks):
                try:
                    sink(packet)
                except Exception as error:
                    self._fail(error)
                    self._sinks.remove(sink)
        if packets and self._keeper is not None:
            self._keeper.put(packets, self.encoder)
        if packets:
            self._look(int(packets[-1].events.t[-1]))

    def _look(self, t: int) -> None:
        """Sharpness of the image of a window, once for each status."""
        assert self._compensator is not None
        assert self._meter is not None
        if self._image_us is None:
            self._compensator.image()  # begins the window
            self._image_us = t
        elif self._wants_image and t - self._image_us >= IMAGE_US:
            self._meter.image.write(self._compensator.image()[None])
            self.status.sharpness, self._image_us, self._wants_image = self._meter.measure(), t, False

    def _report(self, on_status: Callable[[Status], None]) -> None:
        now, status = monotonic_us(), self.status
        status.seconds = self._seconds
        then, events, done, unsure_then = self._since
        unsure = status.guessed + status.unknown
        status.rate_mev_s = (status.events - events) / max(now - then, 1)
        status.covered = 1.0 - (unsure - unsure_then) / (status.done - done) if status.done > done else 1.0
        self._since = (now, status.events, status.done, unsure)
        if self._latencies:
            median, slow = np.percentile(self._latencies, [50, 99]) * 1e-3
            status.latency_ms = float(median), float(slow)
            self._latencies.clear()
        status.dropped, status.late = self._queue.dropped, self._sorter.late
        status.waiting = self._queue.held + (0 if self._compensator is None else self._compensator.waiting)
        status.rpm = self.encoder.rpm
        status.coverage = None if self._keeper is None else self._keeper.coverage
        if self._watch is not None:
            status.phase_away = self._watch.look(self.encoder)
        for taker in self._takers:
            self._hand(taker, taker[0].tick)
        self._image_us, self._wants_image = None, True
        on_status(status)

    def _finish(self) -> None:
        """All that is held anywhere."""
        self._pass_on(self._sorter.flush(), monotonic_us())
        end = monotonic_us() + 1e6 * PATIENCE_S
        while self._link is not None and monotonic_us() < end:
            self._follow()
            last = self.encoder.last
            if last is not None and last > self._last_us:  # samples cover the last events
                break
            time.sleep(POLL_S)
        if self._compensator is not None:
            self._give_out(self._compensator.flush())
        for _, beside in self._takers:
            try:
                beside.close()
            except Exception as error:
                self._fail(error)
