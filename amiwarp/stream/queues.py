"""A bounded queue of packets between a sensor and whoever works on them, and what it does when that one is slower."""

from __future__ import annotations

import enum
import threading
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events import Events
from amiwarp.values import choice, whole

if TYPE_CHECKING:
    from amiwarp.stream.packets import Packet

THIN_FROM = 0.5
"""Fill from which on events are thinned, the more the fuller the queue is."""


class Policy(enum.StrEnum):
    """What a queue does that is full."""

    BLOCK = "block"
    """The source waits, and with it whoever sends: nothing is lost here."""
    DROP_OLDEST = "drop-oldest"
    """The events that have waited longest go: what comes out is late by no more than the queue is long."""
    THIN = "thin"
    """Events are left out evenly, so that all places and times are still seen."""


class PacketQueue:
    """Holds at most ``most_events``; a packet's triggers and encoder samples are always kept.

    For one thread that puts and one that gets. Raises :class:`AmiwarpError` for a size under 1.
    """

    def __init__(self, most_events: int, policy: Policy) -> None:
        self.most_events = whole(most_events, "queue's most_events", 1, 1 << 40)
        self.policy = choice(Policy, policy, "policy")
        self.received = self.dropped = 0
        """Events put, and those of them that never come out."""
        self._packets: deque[Packet] = deque()
        self._held = 0
        self._phase = 0.0
        self._closed = False
        self._changed = threading.Condition()

    @property
    def held(self) -> int:
        """Events that wait in it."""
        return self._held

    @property
    def fill(self) -> float:
        """Share of the room that is taken; above 1 while a single packet is larger than all of it."""
        return self._held / self.most_events

    @property
    def ended(self) -> bool:
        """Whether it was closed and all has come out."""
        with self._changed:
            return self._closed and not self._packets

    def put(self, packet: Packet) -> None:
        """Takes a packet, at once or, under :attr:`Policy.BLOCK`, when there is room or the queue is closed."""
        with self._changed:
            self.received += len(packet.events)
            if self.policy is Policy.BLOCK:
                self._changed.wait_for(lambda: not self._held or self._fits(packet) or self._closed)
            elif self.policy is Policy.THIN:
                packet = self._thinned(packet)
            while self.policy is Policy.DROP_OLDEST and self._held and not self._fits(packet):
                self._drop_oldest()
            self._packets.append(packet)
            self._held += len(packet.events)
            self._changed.notify_all()

    def get(self, timeout_s: float) -> Packet | None:
        """The next packet, or None where none came in time or the queue has ended."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._packets) or self._closed, timeout_s)
            if not self._packets:
                return None
            packet = self._packets.popleft()
            self._held -= len(packet.events)
            self._changed.notify_all()
            return packet

    def close(self) -> None:
        """Nothing more comes; what is held can still be got."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _fits(self, packet: Packet) -> bool:
        return self._held + len(packet.events) <= self.most_events

    def _drop_oldest(self) -> None:
        """Empties the first packet that has events; what else it carries goes with the next."""
        first = next(k for k, packet in enumerate(self._packets) if len(packet.events))
        packet = self._packets[first]
        self._held -= len(packet.events)
        self.dropped += len(packet.events)
        if first + 1 < len(self._packets):
            after = self._packets[first + 1]
            self._packets[first + 1] = replace(
                after,
                triggers=np.concatenate([packet.triggers, after.triggers]),
                encoder_t=np.concatenate([packet.encoder_t, after.encoder_t]),
                encoder_angle=np.concatenate([packet.encoder_angle, after.encoder_angle]),
            )
            del self._packets[first]
        else:
            self._packets[first] = replace(packet, events=Events.empty())

    def _thinned(self, packet: Packet) -> Packet:
        n = len(packet.events)
        free = 1.0 - (self._held + n) / self.most_events
        share = min(max(free / (1.0 - THIN_FROM), 0.0), 1.0)
        if share == 1.0 or not n:
            return packet
        steps = np.floor(self._phase + share * np.arange(n + 1))
        self._phase = (self._phase + share * n) % 1.0
        kept = steps[1:] > steps[:-1]
        self.dropped += n - int(np.count_nonzero(kept))
        return replace(packet, events=packet.events[kept])
