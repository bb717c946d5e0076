"""Check during a stream that the prism's phase has not changed since the calibration."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from amiwarp.calib import calibrate
from amiwarp.calib.result import Calibration
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TWO_PI, Encoder, EncoderStream
from amiwarp.events.recording import Events, MemoryEvents, Recording, held_bytes

SEARCH_RAD = math.radians(20.0)
"""Half width of the search about the calibrated phase [rad]. A phase outside is found at the edge of this range, and
reported."""
CHANGE_RAD, OFFSET_RAD = math.radians(1.5), math.radians(5.0)
"""Smallest reported change of the phase since the first estimate, and smallest reported offset from the calibrated
phase [rad].

The bias of the estimate is up to 3 deg.
"""
FEWEST_EVENTS = 20_000
"""Smallest number of events for an estimate of the phase. The events must also cover half a turn."""
MOST_BYTES = 1 << 24
"""Memory limit of the latest events, from which the phase is estimated [bytes]: about a million events."""
EVALUATIONS = 40
"""Number of evaluations of the sharpness per estimate of the phase."""


@dataclass(frozen=True, slots=True)
class PhaseEstimate:
    """Estimate of the prism's phase by sharpness."""

    offset: float
    """Difference between the estimated and the calibrated phase [rad]."""
    std: float
    """Standard deviation of the estimated phase [rad]."""


class PhaseCheck:
    """Estimates the prism's phase repeatedly by sharpness, on the CPU in a background thread.

    The check needs the events that the compensator gets. The sharpness has a bias that depends on the sensor. Therefore
    the change since the first estimate is judged.
    """

    def __init__(self, calibration: Calibration, every_s: float, say: Callable[[str], None]) -> None:
        """Set up the check.

        ``every_s``: interval between estimates [s]; ``say`` is called with a message if the phase changed.
        """
        self._calibration, self._every_s, self._say = calibration, every_s, say
        self._due, self._closed = 0.0, False
        self._recent: deque[Events] = deque()
        self.held_bytes = 0
        """Memory of the latest events that are kept for an estimate [bytes]."""
        self._thread: threading.Thread | None = None
        self._estimated: PhaseEstimate | None = None
        self._first_estimate: PhaseEstimate | None = None
        self._offset: float | None = None
        self._reported: float | None = None

    def update(self, encoder: EncoderStream) -> float | None:
        """Start an estimate if one is due; return the latest offset from the calibrated phase [rad], at first None."""
        estimate = self.result()
        if estimate is not None:
            self._first_estimate = self._first_estimate or estimate
            self._offset = estimate.offset
            self._report(estimate, self._first_estimate)
        if time.monotonic() >= self._due and self.start_check(encoder):
            self._due = time.monotonic() + self._every_s
        return self._offset

    def _report(self, estimate: PhaseEstimate, first: PhaseEstimate) -> None:
        """Report a large offset from the calibrated phase, or a significant change since the first estimate."""
        changed = estimate.offset - first.offset
        if self._reported is not None and abs(estimate.offset - self._reported) < CHANGE_RAD:
            return
        self._reported = None
        if abs(estimate.offset) > OFFSET_RAD:
            self._reported = estimate.offset
            offset = f"{math.degrees(estimate.offset):+.1f} deg"
            self._say(f"the phase differs from the calibrated one by {offset}: calibrate again")
        elif abs(changed) > max(CHANGE_RAD, 4.0 * math.hypot(estimate.std, first.std)):
            self._reported = estimate.offset
            since = f"since the first check, to {math.degrees(estimate.offset):+.1f} deg from the calibrated one"
            self._say(f"the phase has moved by {math.degrees(changed):+.1f} deg {since}: has the index pulse slipped?")

    def put(self, events: Events) -> None:
        """Add events of the sensor, from which the next estimate is made."""
        self._recent.append(events)
        self.held_bytes += held_bytes(events)
        while self.held_bytes - held_bytes(self._recent[0]) > MOST_BYTES:
            self.held_bytes -= held_bytes(self._recent.popleft())

    def start_check(self, encoder: EncoderStream) -> bool:
        """Start an estimate from the events of the last turn.

        Returns False if an estimate is running or the data do not suffice.
        """
        last = encoder.last
        if self._closed or self._thread is not None or last is None or not self._recent:
            return False
        events = Events.concatenate(list(self._recent))
        events = events[: int(events.t.searchsorted(last, side="right"))]
        if len(events) < FEWEST_EVENTS:
            return False
        samples = encoder.over(int(events.t[0]), int(events.t[-1]))
        speed = abs(samples.rpm) * TWO_PI / 60e6
        begin = int(events.t[-1]) - round(1.2 * TWO_PI / speed) if speed else int(events.t[0])
        events = events[int(events.t.searchsorted(begin)) :]
        swept = speed * float(events.t[-1] - events.t[0]) if len(events) else 0.0
        if len(events) < FEWEST_EVENTS or swept < TWO_PI / 2.0 or encoder.guessed(events.t).any():
            return False
        self._thread = threading.Thread(
            target=self._estimate, args=(events, samples), name="amiwarp-phase-check", daemon=True
        )
        self._thread.start()
        return True

    def result(self) -> PhaseEstimate | None:
        """Return each new estimate once; None if there is no new one."""
        if self._thread is None or self._thread.is_alive():
            return None
        self._thread.join()
        self._thread = None
        estimate, self._estimated = self._estimated, None
        return estimate

    def close(self) -> None:
        """Wait for a running estimate, and start no further one."""
        self._closed = True
        if self._thread is not None:
            self._thread.join()

    def _estimate(self, events: Events, encoder: Encoder) -> None:
        """Estimate the phase by a calibration in which all other parameters are fixed."""
        known = self._calibration
        phase = known.parameters["phase"]
        recording = Recording(MemoryEvents(events, known.camera.width, known.camera.height), known.camera, encoder,
                              known.prism, name="the stream")  # fmt: skip
        start = {n: x for n, x in known.parameters.items() if n not in ("clock_offset", "rpm")}
        try:
            found = calibrate(
                recording, model=known.model_name, free=("phase",), start=start, stages=("sharpness",), events=100_000,
                bounds={"phase": (phase - SEARCH_RAD, phase + SEARCH_RAD)}, global_evaluations=EVALUATIONS,
                local_algorithm="LN_SBPLX", device="cpu",
            )  # fmt: skip
        except AmiwarpError:
            return  # for example without texture: a later estimate may succeed
        self._estimated = PhaseEstimate(found.parameters["phase"] - phase, found.uncertainty["phase"])
