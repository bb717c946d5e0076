"""Check during a stream that the prism's phase has not changed since the calibration."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.encoder_stream import EncoderStream
from amiwarp.events.recording import Events, MemoryEvents, Recording, held_bytes
from amiwarp.results.calibration import Calibration

SEARCH_RAD = math.radians(20.0)
"""Half width of the search about the calibrated phase [rad]. A phase outside is found at the edge of this range, and
reported."""
CHANGE_RAD = math.radians(1.5)
"""Smallest reported change of the phase since the first estimate [rad]."""
OFFSET_RAD = math.radians(5.0)
"""Smallest reported offset from the calibrated phase [rad]. The estimate has a bias of up to 3 deg,
beyond the bias of the calibration."""
FEWEST_EVENTS = 20_000
"""Smallest number of events for an estimate of the phase. The events must also cover half a turn."""
MOST_CHECK_BYTES = 1 << 24
"""Memory limit of the latest events, from which the phase is estimated [bytes]: about a million events."""
EVALUATIONS = 40
"""Number of evaluations of the sharpness per estimate of the phases."""
PHASES = ("phase", "second_phase")
"""Names of the phases of models with one and with two angles."""


@dataclass(frozen=True, slots=True)
class PhaseEstimate:
    """Estimate of a prism's phase by sharpness."""

    name: str
    """Name of the phase, in :data:`PHASES`."""
    offset: float
    """Difference between the estimated and the calibrated phase [rad]."""
    std: float
    """Standard deviation of the estimated phase [rad]."""


class PhaseCheck:
    """Estimates the prism's phase repeatedly by sharpness, on the CPU in a background thread.

    For a pair of prisms and for a mirror, both phases are estimated together. The check needs the events that the
    compensator gets. The sharpness has a bias that depends on sensor and scene. Therefore the estimate is compared with
    that by sharpness in the calibration, if it has one, and the change since the first estimate is judged.
    """

    def __init__(
        self, calibration: Calibration, every_s: float, say: Callable[[str], None]
    ) -> None:
        """Set up the check.

        ``every_s``: interval between estimates [s]; ``say`` is called with a message if the phase changed.
        """
        # Here, because it takes long to load, and ``record`` does not need it.
        from amiwarp.calib.preparation import prepare
        from amiwarp.calib.settings import Settings

        self._calibration = calibration
        self._every_s = every_s
        self._say = say
        self._prepare = prepare
        self._due = 0.0
        self._closed = False
        self._recent: deque[Events] = deque()
        self.held_bytes = 0
        """Memory of the latest events that are kept for an estimate [bytes]."""
        # A daemon: the process may end while an estimate runs.
        self._thread: threading.Thread | None = None
        self._names = PHASES[: calibration.model.ANGLES]
        photometric = calibration.photometric
        sharp = {} if photometric is None else photometric.sharpness_parameters
        self._usual = {name: sharp.get(name, calibration.parameters[name]) for name in self._names}
        start = {**calibration.parameters, **self._usual}
        for name in ("clock_offset", "rpm"):  # the encoder has them
            start.pop(name, None)
        bounds = {}
        for name, usual in self._usual.items():
            bounds[name] = (usual - SEARCH_RAD, usual + SEARCH_RAD)
        self._settings = Settings(
            model=calibration.model_name,
            free=self._names,
            start=start,
            stages=("sharpness",),
            events=100_000,
            bounds=bounds,
            global_evaluations=EVALUATIONS,
            local_algorithm="LN_SBPLX",
        )
        self._estimated: list[PhaseEstimate] = []
        self._first_estimate: list[PhaseEstimate] = []
        self._offset: float | None = None
        self._reported: dict[str, float] = {}

    def update(self, encoder: EncoderStream) -> float | None:
        """Start an estimate if one is due; return the latest offset from the calibrated phase [rad], at first None.

        Of two phases, return the larger offset.
        """
        estimates = self.result()
        if estimates:
            self._first_estimate = self._first_estimate or estimates
            self._offset = max((estimate.offset for estimate in estimates), key=abs)
            for estimate, first in zip(estimates, self._first_estimate, strict=True):
                self._report(estimate, first, sure=encoder.sure)
        if time.monotonic() >= self._due and self.start_check(encoder):
            self._due = time.monotonic() + self._every_s
        return self._offset

    def _report(self, estimate: PhaseEstimate, first: PhaseEstimate, *, sure: bool) -> None:
        """Report a large offset from the calibrated phase, or a significant change since the first estimate.

        ``sure``: whether the clocks of controller and camera are known. A wrong one turns the phase, too.
        """
        changed = estimate.offset - first.offset
        phase = estimate.name.replace("_", " ")
        wrong_clock = ""
        if not sure:
            wrong_clock = (
                "the clocks of controller and camera are probably wrong: connect the sync pulses, "
                "or calibrate again"
            )
        reported = self._reported.pop(estimate.name, None)
        if reported is not None and abs(estimate.offset - reported) < CHANGE_RAD:
            self._reported[estimate.name] = reported
        elif abs(estimate.offset) > OFFSET_RAD:
            self._reported[estimate.name] = estimate.offset
            least = "at least " if abs(estimate.offset) > 0.99 * SEARCH_RAD else ""
            offset = f"{least}{math.degrees(estimate.offset):+.1f} deg"
            self._say(
                f"the {phase} differs from the calibrated one by {offset}: {wrong_clock or 'calibrate again'}"
            )
        elif abs(changed) > max(CHANGE_RAD, 4.0 * math.hypot(estimate.std, first.std)):
            self._reported[estimate.name] = estimate.offset
            since = f"since the first check, to {math.degrees(estimate.offset):+.1f} deg from the calibrated one"
            why = wrong_clock or "has the index pulse slipped?"
            self._say(f"the {phase} has moved by {math.degrees(changed):+.1f} deg {since}: {why}")

    def put(self, events: Events) -> None:
        """Add events of the sensor, from which the next estimate is made."""
        self._recent.append(events)
        self.held_bytes += held_bytes(events)
        while self.held_bytes - held_bytes(self._recent[0]) > MOST_CHECK_BYTES:
            self.held_bytes -= held_bytes(self._recent.popleft())

    def start_check(self, encoder: EncoderStream) -> bool:
        """Start an estimate from the events of the last turn.

        Returns False if an estimate is running or the data do not suffice.
        """
        last_us = encoder.last
        if self._closed or self._thread is not None or last_us is None or not self._recent:
            return False
        events = Events.concatenate(list(self._recent))
        events = events[: int(events.t.searchsorted(last_us, side="right"))]
        if len(events) < FEWEST_EVENTS:
            return False

        # The events of the last turn, and of a little more.
        samples = encoder.over(int(events.t[0]), int(events.t[-1]))
        rad_per_us = abs(samples.rpm) * math.tau / 60e6
        begin_us = int(events.t[0])
        if rad_per_us:
            begin_us = int(events.t[-1]) - round(1.2 * math.tau / rad_per_us)
        events = events[int(events.t.searchsorted(begin_us)) :]
        if len(events) < FEWEST_EVENTS:
            return False
        swept = rad_per_us * float(events.t[-1] - events.t[0])
        if swept < math.tau / 2.0 or encoder.guessed(events.t).any():
            return False
        self._thread = threading.Thread(
            target=self._estimate, args=(events, samples), name="amiwarp-phase-check", daemon=True
        )
        self._thread.start()
        return True

    def result(self) -> list[PhaseEstimate]:
        """Return the new estimate of each phase once; an empty list if there is none."""
        if self._thread is None or self._thread.is_alive():
            return []
        self._thread.join()
        self._thread = None
        estimated = self._estimated
        self._estimated = []
        return estimated

    def close(self, most_s: float = math.inf) -> None:
        """Wait for a running estimate for at most ``most_s`` [s], and start no further one."""
        self._closed = True
        if self._thread is not None:
            self._thread.join(None if math.isinf(most_s) else most_s)

    def _estimate(self, events: Events, encoder: Encoder) -> None:
        """Estimate the phases by a search for the sharpest image, in which all other parameters are fixed."""
        known = self._calibration
        recording = Recording(
            MemoryEvents(events, known.camera.width, known.camera.height),
            known.camera,
            encoder,
            known.prism,
            name="the stream",
        )
        try:
            (prepared,) = self._prepare(recording, self._settings)
            search = prepared.run()
            _, std = search.check_answer(recording.name)
        except (AmiwarpError, np.linalg.LinAlgError):
            return  # for example without texture: a later estimate may succeed
        estimated = []
        for name in self._names:
            offset = search.best[name] - self._usual[name]
            estimated.append(PhaseEstimate(name, offset, std[name]))
        self._estimated = estimated
