"""Adaptive prism speed: as fast as the scene's edges need, no faster.

:class:`SpeedController` derives the prism's speed from the coverage of windows of events
(:mod:`amiwarp.live.stream.coverage`); :class:`SpeedKeeper` measures the windows of a session and commands the motor.
``docs/explanation/adaptive-speed.md`` shows the results.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder_stream import EncoderStream
from amiwarp.events.recording import Events, held_bytes
from amiwarp.live.stream.coverage import Coverage, CoverageMeter, prism_path

if TYPE_CHECKING:
    from amiwarp.compensation.streams import Compensated
    from amiwarp.optics.models.base import Model


SPEEDS = 32
"""Number of prism speeds between the lowest and the highest for which the coverage is predicted."""
MEMORY_S = 0.25
"""Time constant of the average of coverage predictions and of the event rate [s]. Edge directions vary between windows.
"""
FOLLOW_S = 0.2
LIMITED_S = 1.5
"""Time constants of the speed's approach to the sufficient speed, and to the speed that the event rate allows [s]."""
SPEED_TOLERANCE = 0.01
"""Relative difference from the sufficient speed below which the speed is not changed further."""
NEAR_LIMIT = 0.9
BELOW_LIMIT = 0.8
"""Shares of the largest event rate at which its limitation of the prism speed ends, and below which the speed may rise.

Once the event rate exceeds the largest rate, the speed is lowered until the event rate falls to the first share. The
speed may rise only while the event rate is below the second share.
"""


@dataclass(slots=True, eq=False)
class SpeedController:
    """Derives the prism's speed from coverage and event rate.

    It predicts the coverage at the worst prism phase for all speeds. If the prediction for the present speed is below
    :attr:`low` or above :attr:`high`, the controller moves to the lowest speed whose unseen share is at most the
    geometric mean of the two limits' unseen shares, or else to the speed with the best coverage. Raises
    :class:`AmiwarpError` for empty ranges of speed or coverage.
    """

    orbit: NDArray[np.float64]
    """Path of the image centre over a turn of the prism, see :func:`prism_orbit`."""
    rpm: float = 720.0
    """Present prism speed: the initial speed, later the last commanded one [turns/min]."""
    least_rpm: float = 120.0
    """Lowest prism speed that is commanded [turns/min]."""
    most_rpm: float = 1440.0
    """Highest prism speed that is commanded [turns/min]."""
    ramp_rpm_s: float = 600.0
    """Rate at which the motor can change its speed [turns/min/s]."""
    most_mev_s: float = math.inf
    """Largest event rate that sensor, cable and computer can handle [million events/s]. It has priority over coverage.
    """
    low: float = 0.9988
    """Lower limit of the predicted coverage. Below it, the speed changes."""
    high: float = 0.9996
    """Upper limit of the predicted coverage. Above it, the speed changes."""
    _t_us: int | None = field(default=None, init=False)
    _speeds: NDArray[np.float64] = field(init=False)
    _unseen: NDArray[np.float64] = field(init=False)
    _rate: float = field(default=0.0, init=False)
    _moving: bool = field(default=False, init=False)
    _limited: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.least_rpm <= self.rpm <= self.most_rpm < math.inf:
            given = f"{self.rpm:g} rpm to start with is not in {self.least_rpm:g} .. {self.most_rpm:g} rpm"
            raise AmiwarpError(
                f"adaptive speed: {given}; give limits above 0 that include the initial speed"
            )
        if not 0.0 < self.low < self.high < 1.0:
            given = f"coverage limits low = {self.low:g} and high = {self.high:g}"
            raise AmiwarpError(f"adaptive speed: {given}; give 0 < low < high < 1")
        for name in ("ramp_rpm_s", "most_mev_s"):
            if not getattr(self, name) > 0.0:
                raise AmiwarpError(
                    f"adaptive speed: {name} = {getattr(self, name):g}; give a number above 0"
                )
        self._unseen = np.zeros(SPEEDS)
        self._speeds = np.geomspace(self.least_rpm, self.most_rpm, SPEEDS)

    def update(
        self, start_us: int, end_us: int, coverage: Coverage, rate_mev_s: float
    ) -> float | None:
        """Return the prism speed to command after a window of events [turns/min]; None to keep the speed.

        ``start_us``, ``end_us``: window [us]; ``rate_mev_s``: event rate [million events/s]. Raises
        :class:`AmiwarpError` for windows out of order, or for a rate that is negative or not finite.
        """
        if not 0.0 <= rate_mev_s < math.inf:
            raise AmiwarpError(
                f"adaptive speed: {rate_mev_s:g} Mev/s; give a finite rate of 0 or more"
            )
        first = self._t_us is None
        if not start_us < end_us or (self._t_us is not None and start_us < self._t_us):
            given = f"window {start_us} .. {end_us} us after one that ended at {self._t_us} us"
            raise AmiwarpError(
                f"adaptive speed: {given}; pass the windows of events in order of time"
            )
        before_us = start_us if self._t_us is None else self._t_us
        seconds = (end_us - before_us) * 1e-6
        self._t_us = end_us
        new = 1.0 if first else 1.0 - math.exp(-seconds / MEMORY_S)
        unseen = 1.0 - coverage.predict(self._speeds, self.orbit, (end_us - start_us) * 1e-6)
        self._unseen += new * (unseen - self._unseen)
        self._rate += new * (rate_mev_s - self._rate)
        return None if first else self._step(seconds)

    def _step(self, seconds: float) -> float | None:
        """Move the present speed one step of ``seconds`` towards the sufficient speed."""
        # The unseen share at the present speed, interpolated geometrically between speeds.
        logs = np.log(np.maximum(self._unseen, 1e-12))
        unseen = math.exp(np.interp(math.log(self.rpm), np.log(self._speeds), logs))
        if not 1.0 - self.high <= unseen <= 1.0 - self.low:
            self._moving = True
        sufficient = self._sufficient_speed(logs) if self._moving else self.rpm

        # The event rate may ask for a lower speed, or forbid a higher one.
        time_constant = FOLLOW_S
        rate = self._rate / self.most_mev_s
        self._limited = rate > (NEAR_LIMIT if self._limited else 1.0)
        if self._limited:
            sufficient = min(sufficient, self.rpm * NEAR_LIMIT / rate)
            time_constant = LIMITED_S
        elif sufficient > self.rpm and rate > BELOW_LIMIT:
            sufficient = self.rpm
        if abs(sufficient / self.rpm - 1.0) < SPEED_TOLERANCE:
            self._moving = False
            return None

        largest = self.ramp_rpm_s * seconds
        step = (sufficient - self.rpm) * -math.expm1(-seconds / time_constant)
        step = min(max(step, -largest), largest)
        previous = self.rpm
        self.rpm = min(max(self.rpm + step, self.least_rpm), self.most_rpm)
        return self.rpm if self.rpm != previous else None

    def _sufficient_speed(self, logs: NDArray[np.float64]) -> float:
        """Return the lowest speed with an acceptable unseen share, interpolated; if there is none, the best speed."""
        aim = 0.5 * math.log((1.0 - self.low) * (1.0 - self.high))
        good = np.flatnonzero(logs <= aim)
        k = int(good[0]) if len(good) else int(logs.argmin())
        if k == 0 or not len(good):
            return float(self._speeds[k])
        above, below = logs[k - 1 : k + 1]
        part = (above - aim) / (above - below)
        return float(self._speeds[k - 1] * (self._speeds[k] / self._speeds[k - 1]) ** part)


WINDOW_US = 33_333
MOST_WINDOWS = 10
"""Length of a window of events [us], and largest number of windows measured at once. Older windows are skipped as
outdated."""
MOST_BYTES = 1 << 26
"""Memory limit of the unfinished window's packets [bytes]. Beyond it, the window's oldest packets are left out."""


class SpeedKeeper:
    """Measures the coverage of each window of events and commands a new prism speed if needed.

    A background thread waits for the controller's answer. ``set_speed`` is called with speed [rpm] and ramp [rpm/s],
    like :meth:`Link.set_speed`. ``say`` is called with the messages of its errors.
    """

    def __init__(
        self,
        model: Model,
        controller: SpeedController,
        set_speed: Callable[[float, float], None],
        say: Callable[[str], None],
    ) -> None:
        self.controller = controller
        self._model = model
        self._set_speed = set_speed
        self._say = say
        self._meter = CoverageMeter(model.camera.width, model.camera.height)
        self._packets: deque[Events] = deque()
        self.held_bytes = 0
        """Memory of the packets of the unfinished window [bytes]."""
        self._window_start_us: int | None = None
        # A daemon: no exit waits for an answer that never comes.
        self._command_thread: threading.Thread | None = None
        self._commanded_rpm = controller.rpm
        self.coverage: float | None = None
        """Share of the scene's edges that the last window showed, 0 to 1; None before the first window."""

    def put(self, packets: list[Compensated], encoder: EncoderStream) -> None:
        """Add compensated packets, in order of time, and measure the windows that are complete."""
        if self._window_start_us is None:
            self._window_start_us = int(packets[0].events.t[0])
        for packet in packets:
            self._packets.append(packet.events)
            self.held_bytes += held_bytes(packet.events)
            while self.held_bytes > MOST_BYTES and len(self._packets) > 1:
                self.held_bytes -= held_bytes(self._packets.popleft())
        last = int(self._packets[-1].t[-1])
        windows = (last - self._window_start_us) // WINDOW_US
        if windows < 1:
            return

        # The oldest windows are skipped if there are too many.
        events = Events.concatenate(list(self._packets))
        self._window_start_us += WINDOW_US * max(0, windows - MOST_WINDOWS)
        while last - self._window_start_us >= WINDOW_US:
            end = self._window_start_us + WINDOW_US
            first, after = np.searchsorted(events.t, [self._window_start_us, end])
            self._measure(events[first:after], self._window_start_us, end, encoder)
            events = events[after:]
            self._window_start_us = end
        self._packets = deque([events])
        self.held_bytes = held_bytes(events)

    def _measure(self, events: Events, start: int, end: int, encoder: EncoderStream) -> None:
        if encoder.first is None:
            return
        samples = encoder.over(start, end)
        if not samples.covers(start, end):  # the window begins before the first encoder sample
            return
        path = prism_path(self._model, samples, start, end)
        coverage = self._meter(events, start, end, path)
        self.coverage = coverage.share
        self.controller.update(start, end, coverage, len(events) / (end - start))
        # While a command waits for its answer, a further change of speed waits for the next window.
        busy = self._command_thread is not None and self._command_thread.is_alive()
        rpm = self.controller.rpm
        if rpm != self._commanded_rpm and not busy:
            self._commanded_rpm = rpm
            self._command_thread = threading.Thread(
                target=self._command, args=(rpm,), name="amiwarp-speed", daemon=True
            )
            self._command_thread.start()

    def _command(self, rpm: float) -> None:
        try:
            self._set_speed(rpm, self.controller.ramp_rpm_s)
        except AmiwarpError as error:
            self._say(str(error))

    def close(self) -> None:
        """Wait for the controller's answer to the last command."""
        if self._command_thread is not None:
            self._command_thread.join()
