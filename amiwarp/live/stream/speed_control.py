"""Adaptive speed in a session: measures windows of compensated events and commands the motor."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.compensation.streams import held_bytes
from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events
from amiwarp.live.stream.adaptive import CoverageMeter, SpeedController, prism_path

if TYPE_CHECKING:
    from amiwarp.compensation.streams import Compensated
    from amiwarp.events.encoder_stream import EncoderStream
    from amiwarp.optics.models import Model

WINDOW_US, MOST_WINDOWS = 33_333, 10
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
        self._model, self._set_speed, self._say = model, set_speed, say
        self._meter = CoverageMeter(model.camera.width, model.camera.height)
        self._packets: deque[Events] = deque()
        self.held_bytes = 0
        """Memory of the packets of the unfinished window [bytes]."""
        self._window_start_us: int | None = None
        self._command_thread: threading.Thread | None = None
        self._commanded_rpm = controller.rpm
        self.coverage: float | None = None
        """Share of the scene's edges that the last window showed, 0 to 1; None before the first window."""

    def put(self, packets: list[Compensated], encoder: EncoderStream) -> None:
        """Add compensated packets, in order of time, and measure the windows that are complete."""
        self._window_start_us = int(packets[0].events.t[0]) if self._window_start_us is None else self._window_start_us
        for packet in packets:
            self._packets.append(packet.events)
            self.held_bytes += held_bytes(packet.events)
            while self.held_bytes > MOST_BYTES and len(self._packets) > 1:
                self.held_bytes -= held_bytes(self._packets.popleft())
        last = int(self._packets[-1].t[-1])
        windows = (last - self._window_start_us) // WINDOW_US
        if windows < 1:
            return
        events = Events.concatenate(list(self._packets))
        self._window_start_us += WINDOW_US * max(0, windows - MOST_WINDOWS)
        while last - self._window_start_us >= WINDOW_US:
            end = self._window_start_us + WINDOW_US
            first, after = np.searchsorted(events.t, [self._window_start_us, end])
            self._measure(events[first:after], self._window_start_us, end, encoder)
            events, self._window_start_us = events[after:], end
        self._packets, self.held_bytes = deque([events]), held_bytes(events)

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
        rpm = self.controller.rpm
        # While a command waits for its answer, a further change of speed waits for the next window.
        if rpm != self._commanded_rpm and (self._command_thread is None or not self._command_thread.is_alive()):
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
