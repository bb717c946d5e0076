"""What is known of a connection to the controller: state that is reset when the port is opened."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from amiwarp.live.link import protocol

REPORT_US = 1_000_000
"""Shortest interval between messages about losses, and between those about noise [us]."""


@dataclass(slots=True)
class LossReporter:
    """Turns the frame decoder's statistics into messages for the user, at a limited rate."""

    out_of_order: int = 0
    """Number of samples that were dropped because they were out of order, and are not yet reported."""
    _damaged: int | None = None
    """Number of damaged frames so far; None at first, because opening the port cuts a frame."""
    _lost: int = 0
    """Number of lost frames that were already reported."""
    _noise_us: int = -REPORT_US
    _lost_us: int = -REPORT_US

    def forget_lost(self, received: protocol.FrameCounters) -> None:
        """Mark the frames lost so far as reported."""
        self._lost = received.lost

    def check(self, received: protocol.FrameCounters, host_us: int) -> Iterator[str]:
        """Yield the messages about losses and noise that are due."""
        noisy = self._damaged is not None and received.damaged > self._damaged
        if noisy and host_us - self._noise_us > REPORT_US:
            yield "dropped damaged frames or lines; is the cable noisy?"
            self._noise_us = host_us
        self._damaged = received.damaged
        if host_us - self._lost_us > REPORT_US and (
            received.lost > self._lost or self.out_of_order
        ):
            if received.lost > self._lost:
                yield f"frames lost: {received.lost - self._lost:,}"
            if self.out_of_order:
                yield f"samples dropped, out of order: {self.out_of_order:,}"
            self._lost = received.lost
            self.out_of_order = 0
            self._lost_us = host_us


@dataclass(slots=True)
class Connection:
    """State that is reset when the port is opened."""

    opened_us: int
    """Host time at which the port was opened [us]."""
    decoder: protocol.FrameDecoder = field(default_factory=protocol.FrameDecoder)
    losses: LossReporter = field(default_factory=LossReporter)
    received_bytes: int = 0
    unusable: bool = False
    """Whether the user was told that the data cannot be used."""
    ping_answered: bool = False
    unread: bool = True
    """Whether no time of the controller has arrived since the port was opened."""
    _sequence: int | None = None
    """Latest sequence number of a frame."""

    def runs_back(self, sequence: int) -> bool:
        """Store a frame's sequence number; return whether it went backwards."""
        before = self._sequence
        self._sequence = sequence
        return before is not None and (sequence - before) & 0xFFFF >= 1 << 15
