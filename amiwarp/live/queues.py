"""Queues of packets between a source and its consumers, with limits for their events and memory."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import Option
from amiwarp.events.recording import Events
from amiwarp.live.background_worker import QUEUE_BYTES
from amiwarp.validation import choice, whole

if TYPE_CHECKING:
    from amiwarp.live.stream.packets import Packet


class Policy(Option):
    """What a full queue does with further events."""

    BLOCK = "block"
    """Make the source and its sender wait until the queue has room. No event is lost in the queue."""
    DROP_OLDEST = "drop-oldest"
    """Drop the oldest events. The size of the queue then bounds the delay."""
    THIN = "thin"
    """Drop events evenly, so that all pixels and times remain represented."""


THIN_FROM = 0.5
"""Share of the queue's capacity above which :attr:`Policy.THIN` drops events; it drops more as the queue fills."""


class PacketQueue:
    """Queue of packets that holds at most ``most_events`` events and ``most_bytes`` bytes.

    The policy applies to events only: triggers and encoder samples are never dropped. If these alone fill the memory,
    the source waits under every policy. A single packet larger than the limits passes alone. One thread may put packets
    and one may get them. Raises :class:`AmiwarpError` for a size below 1.
    """

    def __init__(self, most_events: int, policy: Policy, most_bytes: int = QUEUE_BYTES) -> None:
        self.most_events = whole(most_events, "queue's most_events", 1, 1 << 40)
        self.most_bytes = whole(most_bytes, "queue's most_bytes", 1, 1 << 40)
        self.policy = choice(Policy, policy, "policy")
        self.received = self.dropped = 0
        """Number of events put, and number of them dropped."""
        self._packets: deque[Packet] = deque()
        self._held = 0
        self._emptied = 0
        """Number of packets at the front of the queue whose events were dropped."""
        self.held_bytes = 0
        """Memory of the packets in the queue [bytes], see :attr:`Packet.held_bytes`."""
        self._phase = 0.0
        self._closed = False
        self._changed = threading.Condition()

    @property
    def held(self) -> int:
        """Number of events in the queue."""
        return self._held

    @property
    def ended(self) -> bool:
        """Whether the queue is closed and empty."""
        with self._changed:
            return self._closed and not self._packets

    def put(self, packet: Packet) -> None:
        """Add a packet once it fits or the queue is closed. The policy may drop events to make it fit."""
        with self._changed:
            self.received += len(packet.events)
            if self.policy is Policy.THIN:
                packet = self._thinned(packet)
            while self.policy is Policy.DROP_OLDEST and self._held and not self._fits(packet):
                self._drop_oldest()
            if packet.empty:  # an empty packet only shows that the source is alive
                return
            self._changed.wait_for(lambda: not self._packets or self._fits(packet) or self._closed)
            self._packets.append(packet)
            self._held += len(packet.events)
            self.held_bytes += packet.held_bytes
            self._changed.notify_all()

    def get(self, timeout_s: float) -> Packet | None:
        """Return the next packet; None on time-out or if the queue has ended."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._packets) or self._closed, timeout_s)
            if not self._packets:
                return None
            packet = self._packets.popleft()
            self._emptied = max(0, self._emptied - 1)
            self._held -= len(packet.events)
            self.held_bytes -= packet.held_bytes
            self._changed.notify_all()
            return packet

    def discard(self) -> int:
        """Close the queue and drop the packets in it. Return their number of events."""
        with self._changed:
            self._closed = True
            lost = self._held
            self._held = 0
            self.held_bytes = 0
            self._emptied = 0
            self._packets.clear()
            self.dropped += lost
            self._changed.notify_all()
        return lost

    def close(self) -> None:
        """Close the queue to further packets. The packets in it can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _fits(self, packet: Packet) -> bool:
        return (
            self._share(self._held + len(packet.events), self.held_bytes + packet.held_bytes) <= 1.0
        )

    def _share(self, events: int, held_bytes: int) -> float:
        return max(events / self.most_events, held_bytes / self.most_bytes)

    def _drop_oldest(self) -> None:
        """Drop the events of the first packet that has any; keep its triggers and encoder samples."""
        while not len(self._packets[self._emptied].events):
            self._emptied += 1
        packet = self._packets[self._emptied]
        self._held -= len(packet.events)
        self.dropped += len(packet.events)
        rest = replace(packet, events=Events.empty())
        self.held_bytes -= packet.held_bytes - (0 if rest.empty else rest.held_bytes)
        if rest.empty:
            del self._packets[self._emptied]
        else:
            self._packets[self._emptied] = rest

    def _thinned(self, packet: Packet) -> Packet:
        n = len(packet.events)
        free = 1.0 - self._share(self._held + n, self.held_bytes + packet.held_bytes)
        share = min(max(free / (1.0 - THIN_FROM), 0.0), 1.0)
        if share == 1.0 or not n:
            return packet
        steps = np.floor(self._phase + share * np.arange(n + 1))
        self._phase = (self._phase + share * n) % 1.0
        kept = steps[1:] > steps[:-1]
        self.dropped += n - int(np.count_nonzero(kept))
        return replace(packet, events=packet.events[kept])
