"""An emulated rig with a simulated clock, which stands still until the programs under test have caught up.

Delays on a busy machine do not count on this clock, so results of tests do not depend on the machine's speed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from amiwarp import Packet
from amiwarp.live.link import Answer, Link, PseudoTerminal
from amiwarp.live.stream import EmulatedCamera, Session
from amiwarp.live.stream.packets import Source

LONG_S = 120.0
"""Limit of every wait [s]. Only a hang takes so long."""
LAG_US = 20_000
"""Delay of a session behind the camera at which the simulated clock waits for it [us]."""


class World:
    """Simulated clock [us] that begins at 0. :meth:`step` advances it if all ``conditions`` hold."""

    def __init__(self, *conditions: Callable[[], bool], step_us: int = 4000) -> None:
        self.conditions = list(conditions)
        self._now, self._step_us = 0, step_us

    def now(self) -> int:
        return self._now

    def step(self) -> int:
        """Advance the clock if possible and return the time. Only the emulated controller's thread calls this."""
        if all(condition() for condition in self.conditions):
            self._now += self._step_us
        return self._now


class Wire:
    """Count of the bytes between a terminal and a link, which a busy operating system delivers late.

    A call returns whether the link has read all bytes and has noticed whether the cable is plugged in.
    """

    def __init__(self, link: Link, terminal: PseudoTerminal) -> None:
        self._link, self._terminal = link, terminal
        self._under_way = 0
        advance, feed = terminal._controller.advance, link._follower.feed

        def sent(now_us: int) -> bytes:
            out = advance(now_us)
            self._under_way += len(out)
            return out

        def read(data: bytes, host_us: int) -> list[Answer]:
            answers = feed(data, host_us)
            self._under_way -= len(data)
            return answers

        terminal._controller.advance = sent  # type: ignore[method-assign]
        link._follower.feed = read  # type: ignore[method-assign]

    def __call__(self) -> bool:
        plugged = self._terminal._master is not None
        if not plugged:
            self._under_way = 0
        return self._link.connected == plugged and self._under_way <= 0


class Counted:
    """A source that counts its triggers."""

    def __init__(self, source: Source) -> None:
        self._source, self.triggers = source, 0
        self.size, self.camera, self.prism = source.size, source.camera, source.prism
        self.name, self.encoders = source.name, source.encoders

    def packets(self) -> Iterator[Packet]:
        for packet in self._source.packets():
            self.triggers += len(packet.triggers)
            yield packet

    def close(self) -> None:
        self._source.close()


def has_taken_in(
    session: Session, source: Counted, camera: EmulatedCamera, link: Link
) -> Callable[[], bool]:
    """Return a check that the session has the link's samples, the camera's pulses, and all but its last few events."""
    first, last = camera._events.t_first, camera._events.t_last

    def ready() -> bool:
        missing = source.triggers < len(camera._controller.pulses) and not camera.done.is_set()
        if link._follower.updates.samples or missing:
            return False
        due = camera._time(camera._now_us()) - LAG_US
        return due < first or session._last_us >= min(due, last)

    return ready
