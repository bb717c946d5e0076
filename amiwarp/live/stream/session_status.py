"""Status of a live session, and the figures in it that are measured between two reports."""

from dataclasses import dataclass, field

import numpy as np

from amiwarp.choices import Sharpness
from amiwarp.compensation.streams import EXTRAPOLATED, NO_ANGLE, OUTSIDE, Compensated, Compensator
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.live.link.camera_clock import ClockSource
from amiwarp.live.link.clocks import ClockMap

IMAGE_US = 33_333
"""Length of the time window whose image gives the reported sharpness [us]."""


@dataclass(slots=True)
class StageStatus:
    """Counts and latency of a stage of a session."""

    name: str
    """Name of the stage: read, filter, compensate or undistort."""
    received: int = 0
    """Number of events that reached the stage."""
    passed: int = 0
    """Number of events that left it."""
    removed: dict[str, int] = field(default_factory=dict)
    """Number of events that the stage removed, by reason."""
    marked: dict[str, int] = field(default_factory=dict)
    """Number of events that the stage passed on with a mark, by reason."""
    latency_ms: tuple[float, float] | None = None
    """Median and 99th percentile of the time from an event to its exit from the stage, since the last report [ms]."""


class Latencies:
    """Latencies of the packets that left a stage since the last report."""

    def __init__(self) -> None:
        self._delays_us: list[float] = []

    def add(self, delay_us: float) -> None:
        """Add the time from the last event of a packet until now [us]."""
        self._delays_us.append(delay_us)

    def take(self) -> tuple[float, float] | None:
        """Return median and 99th percentile [ms], None without packets, and begin again."""
        if not self._delays_us:
            return None
        median, slow = np.percentile(self._delays_us, [50, 99]) * 1e-3
        self._delays_us.clear()
        return float(median), float(slow)


@dataclass(slots=True)
class SessionStatus:
    """Progress of a session. Counts are totals; shares, rates and latencies refer to the time since the last report."""

    seconds: float = 0.0
    """Duration of the session [s]."""
    events: int = 0
    """Number of events received so far."""
    done: int = 0
    """Number of events compensated so far."""
    outside: int = 0
    """Number of events displaced out of the image."""
    guessed: int = 0
    """Number of events compensated with an extrapolated prism angle."""
    unknown: int = 0
    """Number of events without a prism angle."""
    dropped: int = 0
    """Number of events dropped by the queue, see :class:`Policy`."""
    late: int = 0
    """Number of events that were out of order and got a later time."""
    waiting: int = 0
    """Number of events that wait in the queue or for encoder samples."""
    rate_mev_s: float = 0.0
    """Rate of the received events since the last report [million events/s]."""
    covered: float = 1.0
    """Share of events since the last report whose prism angle was interpolated between encoder samples."""
    latency_ms: tuple[float, float] = (0.0, 0.0)
    """Median and 99th percentile of the time from an event to its output [ms], with all that it waited for.

    It counts from the event's own time if the clocks are known, else from the earliest time at which the event can have
    happened: as if the packet with the shortest delay so far had none.
    """
    sharpness: float | None = None
    """Sharpness of the latest image of compensated events, over :data:`IMAGE_US`; None before the first."""
    rpm: float | None = None
    """Speed of the prism [turns/min]; None if it is unknown."""
    clock: ClockMap | None = None
    """Map from the controller's clock to the camera's; None without a link."""
    clock_source: ClockSource | None = None
    """How this map is known; None without a link."""
    coverage: float | None = None
    """Share of the scene's edges that the last window showed, 0 to 1; None without adaptive speed."""
    stages: list[StageStatus] = field(default_factory=list)
    """The stages of the session in their order, from "read" on, each with its counts and its latency."""


class IntervalFigures:
    """Event rate, latency, and coverage by encoder samples, all since the last report."""

    def __init__(self, began_us: int) -> None:
        # At the last report: time [us], and numbers of events received, compensated, and without a measured angle.
        self._reported = (began_us, 0, 0, 0)
        self._latencies = Latencies()

    def add(self, packet: Compensated, delay_us: float, status: SessionStatus) -> None:
        """Count a compensated packet in the figures of the interval. ``delay_us``: time from its last event [us]."""
        flags = packet.flags
        status.done += len(flags)
        if flags.any():
            status.outside += int(np.count_nonzero(flags & OUTSIDE))
            status.guessed += int(np.count_nonzero(flags & EXTRAPOLATED))
            status.unknown += int(np.count_nonzero(flags & NO_ANGLE))
        self._latencies.add(delay_us)

    def report(self, now_us: int, status: SessionStatus) -> None:
        """Write the figures since the last report into the status, and start the next interval."""
        before_us, events_before, done_before, unsure_before = self._reported
        unsure = status.guessed + status.unknown
        done = status.done - done_before
        status.rate_mev_s = (status.events - events_before) / max(now_us - before_us, 1)
        status.covered = 1.0
        if done > 0:
            status.covered = 1.0 - (unsure - unsure_before) / done
        self._reported = (now_us, status.events, status.done, unsure)
        status.latency_ms = self._latencies.take() or status.latency_ms


class WindowSharpness:
    """Measures the sharpness of the compensated image of one time window per report."""

    def __init__(self, compensator: Compensator, size: tuple[int, int], device: str) -> None:
        self._compensator = compensator
        self._meter = SharpnessMeter(
            CanvasShape(*size), Sharpness.VARIANCE, smoothing=1.0, device=device
        )
        self._start_us: int | None = None
        self._wanted = True

    def update(self, t: int) -> float | None:
        """Return the sharpness once the window is complete; ``t``: time up to which events are compensated [us]."""
        if self._start_us is None:
            self._compensator.image()  # discards the events before the window
            self._start_us = t
        elif self._wanted and t - self._start_us >= IMAGE_US:
            self._meter.image.write(self._compensator.image()[None])
            sharpness = self._meter.measure()
            self._start_us = t
            self._wanted = False
            return sharpness
        return None

    def restart(self) -> None:
        """Begin a new time window."""
        self._start_us = None
        self._wanted = True
