"""Source of live events whose packets come from messages of ROS."""

from __future__ import annotations

import math
import queue
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from amiwarp import Events, Packet
from amiwarp.live.link import monotonic_us
from amiwarp.live.stream import make_packet
from amiwarp_ros.event_packets import PacketDecoder, stamp_us

IDLE_S = 0.05
"""Longest time without a packet [s]."""
WINDOW_US = 5_000_000
"""Time over which the smallest delay of a message is taken [us]."""


class StampClock:
    """Relation between the sensor's clock and the time of ROS, by the stamps of messages with events.

    A stamp is late by the delay of its message, which is never negative: the smallest difference counts.
    """

    def __init__(self) -> None:
        self._differences: deque[tuple[int, int]] = deque()
        """Stamp and difference [us]. The differences rise: a later one that is smaller replaces those before."""

    def note(self, stamp_us: int, sensor_us: int) -> None:
        """Note the stamp of a message, and the sensor's time of its first event [us]."""
        difference = stamp_us - sensor_us
        while self._differences and self._differences[-1][1] >= difference:
            self._differences.pop()
        self._differences.append((stamp_us, difference))
        while self._differences[0][0] < stamp_us - WINDOW_US:
            self._differences.popleft()

    @property
    def offset_us(self) -> int | None:
        """Time of ROS minus time of the sensor [us]; None before the first message."""
        return self._differences[0][1] if self._differences else None


class MessageSource:
    """Source of a session, see :class:`amiwarp.live.stream.packets.Source`. Callbacks of ROS put messages.

    ``joint`` names the joint in ``sensor_msgs/JointState`` that is the prism; empty: the first one.
    """

    camera = None
    prism = None
    problem = None

    def __init__(self, name: str, size: tuple[int, int], *, encoders: int, joint: str = "") -> None:
        self.name = name
        self.size = size
        self.encoders = encoders
        self.decoder = PacketDecoder()
        self.clock = StampClock()
        self._joint = joint
        self._angle: float | None = None
        self._last_sample_us = -math.inf
        self._packets: queue.SimpleQueue[Packet | None] = queue.SimpleQueue()

    def put_events(self, message: Any) -> None:
        """Take a message with events. Raises :class:`amiwarp.AmiwarpError` if it cannot be read."""
        events, edges = self.decoder.decode(message)
        if len(events):
            self.clock.note(stamp_us(message), int(events.t[0]))
        self._packets.put(make_packet(monotonic_us(), events, edges))

    def put_joints(self, message: Any) -> None:
        """Take a message with the angle of the prism [rad], wrapped or not. Messages of other joints are left out."""
        offset_us = self.clock.offset_us
        names = list(message.name)
        index = names.index(self._joint) if self._joint in names else 0
        is_other = bool(self._joint) and self._joint not in names
        if is_other or offset_us is None or len(message.position) <= index:
            return
        t_us = stamp_us(message) - offset_us
        angle = float(message.position[index])
        if not math.isfinite(angle) or t_us <= self._last_sample_us:
            return
        if self._angle is not None:
            angle += 2.0 * math.pi * round((self._angle - angle) / (2.0 * math.pi))
        self._angle = angle
        self._last_sample_us = t_us
        sample = np.array([t_us]), np.array([angle])
        self._packets.put(make_packet(monotonic_us(), encoder_t=sample[0], encoder_angle=sample[1]))

    def packets(self) -> Iterator[Packet]:
        """Yield packets until :meth:`close`."""
        while True:
            try:
                packet = self._packets.get(timeout=IDLE_S)
            except queue.Empty:
                packet = make_packet(monotonic_us(), Events.empty())
            if packet is None:
                return
            yield packet

    def close(self) -> None:
        """End the packets."""
        self._packets.put(None)
