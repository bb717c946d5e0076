"""An emulated camera beside an emulated controller: a recording played to who connects, with the pulses of both."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.stream.packets import encode_events, encode_hello, encode_triggers
from amiwarp.stream.sockets import SocketSink

if TYPE_CHECKING:
    from types import TracebackType

    from amiwarp.events import Recording
    from amiwarp.link.emulator import Controller
    from amiwarp.link.rotors import Played

STEP_S = 2e-3
LEAD_US = 1_000_000
"""From the first client to the first event: time for pulses that tie the clocks."""
NEVER = 1 << 60


class EmulatedCamera:
    """Serves a recording's events at their own pace, and triggers at the controller's sync pulses.

    It begins, and ``rotor`` with it, when the first client has come. ``now_us``: the world's time, the controller's.
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
        self._start: int | None = None
        self._sink = SocketSink(address, encode_hello(*events.size, recording.camera, recording.prism))
        self.address = self._sink.address
        self._ended = threading.Event()
        self.done = threading.Event()
        """Set when all has been sent."""
        self._thread = threading.Thread(target=self._run, name="amiwarp-camera", daemon=True)
        self._thread.start()

    def __enter__(self) -> EmulatedCamera:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends it, and the stream of whoever listens."""
        self._ended.set()
        self._thread.join()

    @property
    def lost(self) -> int:
        """Packets that were not sent because a client was too slow."""
        return self._sink.lost

    def _run(self) -> None:
        sent, told = self._origin, -1
        with self._sink:
            while not self._ended.wait(STEP_S):
                self._sink.tick()
                if self._start is None:
                    if not self._sink.clients:
                        continue
                    self._start = self._now_us() + LEAD_US
                    self._rotor.begin(self._start)
                    sent = self._events.t_first
                now = self._time(self._now_us())
                pulses = [(n, self._time(world)) for n, world in list(self._controller.pulses) if n > told]
                if pulses:
                    told = pulses[-1][0]
                    self._sink.send(encode_triggers(np.array([t for _, t in pulses], np.int64)))
                if now > sent:
                    self._sink.send(encode_events(self._events.between(sent, now)))
                    sent = now
                if sent > self._events.t_last:
                    break
        self.done.set()

    def _time(self, world_us: int) -> int:
        """On the camera's clock."""
        assert self._start is not None
        return world_us - self._start + self._origin
