"""Stages of a session, between the events of its source and its outputs: filter, compensation, undistortion.

Each has its counts and its latency. A session of a plain camera has no compensation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from amiwarp.compensation.streams import OUTSIDE, Compensated
from amiwarp.events.recording import Events
from amiwarp.imaging.filters import NAMES, EventFilter, RunningFilter
from amiwarp.live.stream.session_status import Latencies, SessionStatus, StageStatus
from amiwarp.optics.camera import Camera
from amiwarp.optics.running_undistortion import RunningUndistortion


class Stage:
    """Counts of a stage, and the latencies of what left it since the last report."""

    def __init__(self, name: str) -> None:
        self.status = StageStatus(name)
        self._latencies = Latencies()

    def count(self, received: int, passed: int, delay_us: float) -> None:
        """Add numbers of events that reached and left the stage, the last of them ``delay_us`` after it happened."""
        self.status.received += received
        self.status.passed += passed
        self._latencies.add(delay_us)

    def report(self) -> StageStatus:
        """Return the counts so far, with the latency since the last report, or before if nothing came."""
        self.status.latency_ms = self._latencies.take() or self.status.latency_ms
        return replace(
            self.status, removed=dict(self.status.removed), marked=dict(self.status.marked)
        )


class SessionStages:
    """Stages of a session. Packets of any length give the same events.

    ``chosen``: the events that pass the filter; None: all. ``undistort``: camera whose lens distortion is removed;
    None: it stays. ``compensates``: whether the session has a compensator between both. ``delay_us`` returns the time
    since an event [us].
    """

    def __init__(
        self,
        size: tuple[int, int],
        chosen: EventFilter | None,
        undistort: Camera | None,
        *,
        compensates: bool,
        delay_us: Callable[[int], float],
    ) -> None:
        self.filters = chosen is not None
        """Whether there is a filter."""
        self._delay_us = delay_us
        self._undistortion = None if undistort is None else RunningUndistortion(undistort)
        self._running = None if chosen is None else RunningFilter(chosen, size)
        self._outside = 0
        self._read = Stage("read")
        self._filter = Stage("filter")
        self._compensate = Stage("compensate")
        self._undistort = Stage("undistort")
        self._stages = [self._read]
        if chosen is not None:
            self._stages.append(self._filter)
        if compensates:
            self._stages.append(self._compensate)
        if undistort is not None:
            self._stages.append(self._undistort)

    def chosen_of(self, events: Events) -> Events:
        """Return the events of the source that pass the filter."""
        count = len(events)
        last_us = int(events.t[-1])
        self._read.count(count, count, self._delay_us(last_us))
        if self._running is None:
            return events
        kept = self._running.kept(events)
        self._filter.count(count, len(kept), self._delay_us(last_us))
        removed = self._running.removed
        self._filter.status.removed = {NAMES[name]: number for name, number in removed.items()}
        return kept

    def plain(self, events: Events, arrived_us: int) -> Compensated:
        """Return events that passed the filter as a packet that is not compensated."""
        no_flags = np.zeros(len(events), np.uint8)
        return self._undistorted(Compensated(events, no_flags, arrived_us))

    def compensated(self, packet: Compensated) -> Compensated:
        """Return a packet of the compensator after the last stage."""
        count = len(packet.events)
        self._compensate.count(count, count, self._delay_us(int(packet.events.t[-1])))
        # After an undistortion, the flag says something else.
        self._outside += int(np.count_nonzero(packet.flags & OUTSIDE))
        return self._undistorted(packet)

    def _undistorted(self, packet: Compensated) -> Compensated:
        """Return a packet without lens distortion. The flag :data:`OUTSIDE` then belongs to the new places."""
        if self._undistortion is None:
            return packet
        places = self._undistortion.places(packet.events)
        events = replace(packet.events, x=places.x, y=places.y)
        outside = places.outside * np.uint8(OUTSIDE)
        flags = (packet.flags & np.uint8(~OUTSIDE & 0xFF)) | outside
        count = len(events)
        self._undistort.count(count, count, self._delay_us(int(events.t[-1])))
        marked = self._undistort.status.marked
        marked["outside"] = marked.get("outside", 0) + int(np.count_nonzero(outside))
        return Compensated(events, flags, packet.arrived_us)

    def report(self, status: SessionStatus, received: int) -> list[StageStatus]:
        """Return the stages with the losses and marks that a session's status counts. ``received``: from the source."""
        read = self._read.status
        read.received = received
        read.removed = {"queue": status.dropped}
        read.marked = {"late": status.late}
        self._compensate.status.marked = {
            "outside": self._outside,
            "extrapolated": status.guessed,
            "without angle": status.unknown,
        }
        return [stage.report() for stage in self._stages]
