"""The prism's speed kept to what the stream needs: windows of compensated events in, commands to the motor out."""

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
"""Length of a window [us], and how many are measured of what comes at once: the last ones, the others are long past."""
MOST_BYTES = 1 << 26
"""Memory of the packets of a window that is not over; of more, the oldest are left out of its coverage."""


class SpeedKeeper:
    """Measures each window and asks for another speed where it should be; in a thread of its own waits for the answer.

    ``set_speed``: takes rpm and ramp [rpm/s], as :meth:`Link.set_speed`. ``say`` gets what goes wrong there.
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
        """Memory that the packets take whose window is not over [bytes]."""
        self._begins: int | None = None
        self._asking: threading.Thread | None = None
        self._asked = controller.rpm
        self.coverage: float | None = None
        """Share of the edges that the last window saw."""

    def put(self, packets: list[Compensated], encoder: EncoderStream) -> None:
        """Compensated packets, in order."""
        self._begins = int(packets[0].events.t[0]) if self._begins is None else self._begins
        for packet in packets:
            self._packets.append(packet.events)
            self.held_bytes += held_bytes(packet.events)
            while self.held_bytes > MOST_BYTES and len(self._packets) > 1:
                self.held_bytes -= held_bytes(self._packets.popleft())
        last = int(self._packets[-1].t[-1])
        windows = (last - self._begins) // WINDOW_US
        if windows < 1:
            return
        events = Events.concatenate(list(self._packets))
        self._begins += WINDOW_US * max(0, windows - MOST_WINDOWS)
        while last - self._begins >= WINDOW_US:
            end = self._begins + WINDOW_US
            first, after = np.searchsorted(events.t, [self._begins, end])
            self._window(events[first:after], self._begins, end, encoder)
            events, self._begins = events[after:], end
        self._packets, self.held_bytes = deque([events]), held_bytes(events)

    def _window(self, events: Events, start: int, end: int, encoder: EncoderStream) -> None:
        if encoder.first is None:
            return
        samples = encoder.over(start, end)
        if not samples.covers(start, end):  # before the first samples
            return
        path = prism_path(self._model, samples, start, end)
        coverage = self._meter(events, start, end, path)
        self.coverage = coverage.share
        self.controller.update(start, end, coverage, len(events) / (end - start))
        rpm = self.controller.rpm
        # what changed while the answer to the last command was waited for is asked for with the next window
        if rpm != self._asked and (self._asking is None or not self._asking.is_alive()):
            self._asked = rpm
            self._asking = threading.Thread(target=self._ask, args=(rpm,), name="amiwarp-speed", daemon=True)
            self._asking.start()

    def _ask(self, rpm: float) -> None:
        try:
            self._set_speed(rpm, self.controller.ramp_rpm_s)
        except AmiwarpError as error:
            self._say(str(error))

    def close(self) -> None:
        """Waits for an answer that is due."""
        if self._asking is not None:
            self._asking.join()
