"""Emulated camera for the emulated controller: serves a recording's events, and a trigger for each sync pulse."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.live.link.emulator import Controller
from amiwarp.live.link.rotors import Played
from amiwarp.live.stream.sinks import SocketSink
from amiwarp.live.stream.stream_format import encode_events, encode_hello, encode_triggers
from amiwarp.tasks import BackgroundLoop

STEP_US = 2000
RETRY_S = 2e-4
"""Duration of an event packet [us], and interval between attempts to send while a client is slow [s]."""
LEAD_US = 1_000_000
"""Time from the first client's connection to the first event [us], in which sync pulses relate the clocks."""
NEVER_US = 1 << 60
"""Start time of an emulation that has not begun [us]."""


class EmulatedCamera(BackgroundLoop):
    """Serves a recording's events at their recorded pace, and one trigger for each of the controller's sync pulses.

    Camera and ``rotor`` begin once the first client connects. If reading, sending or a client is slower than the
    recording, events are sent late, but none is lost. ``now_us``: emulation time [us], shared with the controller.
    Raises :class:`AmiwarpError` for a recording without encoder or events, or an address in use.
    """

    def __init__(
        self,
        recording: Recording,
        rotor: Played,
        controller: Controller,
        address: str,
        now_us: Callable[[], int],
    ) -> None:
        encoder = recording.encoder
        events = recording.events
        if encoder is None or not len(events):
            raise AmiwarpError(
                f"{recording.name}: has no {'events' if encoder else 'encoder'}; give a recording with both",
                ErrorCode.CONTENT_MISSING,
            )
        self._events = events
        self._rotor = rotor
        self._controller = controller
        self._now_us = now_us
        self._origin = round(int(encoder.t[0]) - encoder.clock_offset_us)
        """Time on the events' clock at which the rotor begins [us]."""
        rotor.begin(NEVER_US)
        self._start = NEVER_US
        self._pulses_until_us = -1
        self.late_us = 0
        """Largest delay of sent events so far [us]."""
        self._sink = SocketSink(
            address, encode_hello(*events.size, recording.camera, recording.prism)
        )
        self.address = self._sink.address
        self.done = threading.Event()
        """Event that is set when all events were sent, or the recording cannot be read further."""
        self._start_thread("amiwarp-camera")

    def _run(self) -> None:
        try:
            self._play()
        except Exception:
            self.done.set()
            raise

    def _play(self) -> None:
        with self._sink:
            while not self._sink.clients:
                if self._ended.wait(STEP_US * 1e-6):
                    return
                self._sink.tick()
            self._start = self._now_us() + LEAD_US
            self._rotor.begin(self._start)
            for block in self._events.blocks(duration_us=STEP_US):
                while (
                    ahead_us := int(block.t[-1]) - self._time(self._now_us())
                ) >= 0 or self._sink.waiting:
                    if self._pause(min(ahead_us, STEP_US) * 1e-6 if ahead_us > 0 else RETRY_S):
                        return
                self.late_us = max(self.late_us, -ahead_us)
                self._sink.send(encode_events(block))
            while self._sink.waiting:
                if self._pause(RETRY_S):
                    return
        self.done.set()

    def _pause(self, seconds: float) -> bool:
        """Wait, then send the new triggers and the waiting packets; return True if the camera was closed meanwhile."""
        if self._ended.wait(seconds):
            return True
        # Select pulses by time, not by number: after a reset the controller numbers them from 0 again.
        pulses = [
            world for _, world in list(self._controller.pulses) if world > self._pulses_until_us
        ]
        if pulses:
            self._pulses_until_us = pulses[-1]
        self._sink.send(
            encode_triggers(np.array([self._time(world) for world in pulses], np.int64))
        )
        return False

    def _time(self, world_us: int) -> int:
        """Return the time on the camera's clock [us] for an emulation time [us]."""
        return world_us - self._start + self._origin
