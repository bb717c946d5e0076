"""An emulated camera beside an emulated controller: a recording played to who connects, with the pulses of both."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.live.stream.packets import encode_events, encode_hello, encode_triggers
from amiwarp.live.stream.sockets import SocketSink

if TYPE_CHECKING:
    from types import TracebackType

    from amiwarp.events.recording import Recording
    from amiwarp.live.link.emulator import Controller
    from amiwarp.live.link.rotors import Played

STEP_US, LATE_STEP_S = 2000, 2e-4
"""Events that are sent together, by their time; and how often one looks again whether who is behind has room."""
LEAD_US = 1_000_000
"""From the first client to the first event: time for pulses that tie the clocks."""
NEVER = 1 << 60


class EmulatedCamera:
    """Serves a recording's events at their own pace, and triggers at the controller's sync pulses.

    It begins, and ``rotor`` with it, when the first client has come. Where reading, sending or a client is slower than
    the recording was, events are sent late, and none is lost. ``now_us``: the world's time, the controller's.
    Raises :class:`AmiwarpError` for a recording without encoder or events, or an address that is taken.
    """

    def __init__(
        self, recording: Recording, rotor: Played, controller: Controller, address: str, now_us: Callable[[], int]
    ) -> None:
        encoder, events = recording.encoder, recording.events
        if encoder is None or not len(events):
            raise AmiwarpError(f"{recording.name}: has no {'events' if encoder else 'encoder'}; give one that has")
        self._events, self._rotor, self._controller, self._now_us = events, rotor, controller, now_us
        self._origin = round(int(encoder.t[0]) - encoder.clock_offset_us)
        """On the events' clock when the rotor begins."""
        rotor.begin(NEVER)
        self._start, self._told_us = NEVER, -1
        self.late_us = 0
        """By how much events were sent late at most."""
        self._sink = SocketSink(address, encode_hello(*events.size, recording.camera, recording.prism))
        self.address = self._sink.address
        self._ended = threading.Event()
        self.done = threading.Event()
        """Set when all has been sent, or the recording cannot be read any further."""
        self._failed: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="amiwarp-camera", daemon=True)
        self._thread.start()

    def __enter__(self) -> EmulatedCamera:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End it, and the stream of whoever listens. Raises what reading the recording raised."""
        self._ended.set()
        self._thread.join()
        failed, self._failed = self._failed, None
        if failed is not None:
            raise failed

    def _run(self) -> None:
        try:
            self._play()
        except Exception as error:
            self._failed = error
            self.done.set()

    def _play(self) -> None:
        with self._sink:
            while not self._sink.clients:
                if self._ended.wait(STEP_US * 1e-6):
                    return
                self._sink.tick()
            self._start = self._now_us() + LEAD_US
            self._rotor.begin(self._start)
            for block in self._events.blocks(duration_us=STEP_US):
                while (early := int(block.t[-1]) - self._time(self._now_us())) >= 0 or self._sink.waiting:
                    if self._pause(min(early, STEP_US) * 1e-6 if early > 0 else LATE_STEP_S):
                        return
                self.late_us = max(self.late_us, -early)
                self._sink.send(encode_events(block))
            while self._sink.waiting:
                if self._pause(LATE_STEP_S):
                    return
        self.done.set()

    def _pause(self, seconds: float) -> bool:
        """Waits, then sends what pulses there were and what waits; whether it is to end."""
        if self._ended.wait(seconds):
            return True
        # by their time: a controller that was reset counts its pulses from 0 again
        pulses = [world for _, world in list(self._controller.pulses) if world > self._told_us]
        if pulses:
            self._told_us = pulses[-1]
        self._sink.send(encode_triggers(np.array([self._time(world) for world in pulses], np.int64)))
        return False

    def _time(self, world_us: int) -> int:
        """On the camera's clock."""
        return world_us - self._start + self._origin
