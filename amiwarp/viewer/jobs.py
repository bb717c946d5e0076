"""Jobs of the inspector: estimate of the phase, calibration on what is shown, and a live stream as a recording."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib import Calibration, Settings, calibrate
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import rpm_between
from amiwarp.events.recording import Recording
from amiwarp.live.stream.session import RecentEvents
from amiwarp.progress import Progress, silent
from amiwarp.viewer.images import SelectedPart, select_part
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.window import CURVE_HALF_WIDTH, Source

# Estimate of the prism's phase at first sight, so that the page opens with compensated events.

COARSE = 24
"""Number of phases of the first search, over one turn."""
FINER = (3.0, 12.0)
"""Divisors of the step of the first search, for the steps of the second and the third one."""
LEAST_GAIN = 1.3
"""Smallest ratio of the sharpness at the best phase to that at the median phase. It is 2 to 3 for scenes, and 1.1 for
random events."""


def estimate_phase(inspector: Inspector) -> bool:
    """Set an unknown phase to that with the highest sharpness of the time window; return whether there is one.

    A phase that is known, from a calibration or by hand, is kept. So is any phase if the prism does not rotate, or if
    no phase sharpens the image.
    """
    if inspector.sources["phase"] is not Source.ASSUMED or not math.isfinite(inspector.turn_us):
        return False
    measure = inspector.sharpness_meter()
    sharpness: dict[float, float] = {}

    def best(phases: list[float]) -> float:
        for phase in phases:
            if phase not in sharpness:
                sharpness[phase] = measure(replace(inspector.knobs, phase=phase))
        return max(sharpness, key=lambda phase: sharpness[phase])

    step = math.tau / COARSE
    found = best((step * np.arange(COARSE) - math.pi).tolist())
    usual = float(np.median([*sharpness.values()]))
    for share in FINER:
        found = best([found + k * step / share for k in (-2, -1, 1, 2)])
    if sharpness[found] < max(measure(None), LEAST_GAIN * usual):
        return False
    inspector.set(replace(inspector.knobs, phase=found))
    inspector.sources["phase"] = Source.ESTIMATED
    return True


# Calibration on what the inspector shows, and the sharpness over two parameters.

SURFACE_POINTS = (21, 37)
"""Number of values of the first and the second parameter of a cost surface."""


@dataclass(frozen=True, eq=False)
class FoundCalibration:
    """Result of a calibration on the shown events, which nobody has accepted yet."""

    calibration: Calibration
    """The calibration, of the whole camera."""
    scope: str
    """The events that it used, for the page."""
    before: float
    """Sharpness of the shown region as recorded."""
    current: float
    """Sharpness of the shown region with the inspector's parameters at the end of the calibration."""
    after: float
    """Sharpness of the shown region with the calibrated parameters."""


def scope_text(inspector: Inspector) -> str:
    """Return which events of the selection :func:`find_calibration` uses, for the page."""
    return _text(inspector, select_part(inspector, inspector.loaded, inspector.loaded.region))


def find_calibration(
    inspector: Inspector, settings: Settings | None = None, *, whole: bool = False, progress: Progress | None = None
) -> FoundCalibration:
    """Calibrate on the events of the window and the selection, or on the whole recording as ``amiwarp calibrate`` does.

    Without an encoder, the search starts at the speed set on the page. Raises :class:`AmiwarpError` if these events
    cannot determine the parameters.
    """
    recording, rpm = inspector.recording, inspector.knobs.rpm
    scope = f"the whole recording, {len(recording.events):,} events"
    if not whole:
        part = select_part(inspector, inspector.loaded, inspector.loaded.region)
        recording, scope = part.recording, _text(inspector, part)
    settings = settings or Settings()
    if rpm and not inspector.has_encoder:
        settings = replace(settings, start={"rpm": rpm, **settings.start})
    found = calibrate(recording, settings, device=inspector.device, progress=progress)
    if not whole:
        found = replace(found, camera=inspector.camera)
    sharpness = inspector.sharpness_meter()
    values = (sharpness(each) for each in (None, inspector.knobs, inspector.knobs_of(found)))
    return FoundCalibration(found, scope, *values)


def _text(inspector: Inspector, part: SelectedPart) -> str:
    """Return a description of the events of a part."""
    s, first = inspector.selection, inspector.recording.events.t_first
    start_s = (part.start_us - first) * 1e-6
    kind = "" if s.polarity is None else ("OFF ", "ON ")[s.polarity]
    texts = [
        f"{len(part.recording.events):,} {kind}events from {start_s:.3f} s to {start_s + part.length_us * 1e-6:.3f} s"
    ]
    if s.region is not None:
        left, top, right, bottom = s.region
        texts.append(f"x {left} to {right - 1}, y {top} to {bottom - 1} px")
    texts += ["without hot pixels"] if s.hide_hot else []
    texts += [f"without background activity ({s.noise_us * 1e-3:g} ms)"] if s.noise_us is not None else []
    return ", ".join(texts)


@dataclass(frozen=True, eq=False)
class CostSurface:
    """Sharpness of the shown region over two parameters, with all others fixed."""

    names: tuple[str, str]
    """Names of the parameters along the columns and along the rows."""
    values: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Values of these parameters, in their units, shapes ``(columns,)`` and ``(rows,)``."""
    sharpness: NDArray[np.float64]
    """Sharpness, shape ``(rows, columns)``."""

    @property
    def best(self) -> tuple[float, float]:
        """Values of both parameters with the largest sharpness."""
        row, column = np.unravel_index(int(np.argmax(self.sharpness)), self.sharpness.shape)
        return float(self.values[0][column]), float(self.values[1][row])


def cost_surface(
    inspector: Inspector, *, points: tuple[int, int] = SURFACE_POINTS, progress: Progress | None = None
) -> CostSurface:
    """Return the sharpness over the two parameters that matter most.

    These are apex, from 0 to twice its value, and phase, over one turn about its value. Without an encoder, they are
    speed and apex. ``points``: numbers of their values. The call may run in a thread; ``progress`` may raise an error
    to stop it.
    """
    progress, current = progress or silent, inspector.knobs
    sharpness = inspector.sharpness_meter()
    apex = np.linspace(0.0, 2.0 * (current.apex or inspector.prism.apex), points[0])
    if inspector.has_encoder:
        names, values = ("apex", "phase"), (apex, current.phase + np.linspace(-math.pi, math.pi, points[1]))
    else:
        width = CURVE_HALF_WIDTH["rpm"]
        names, values = ("apex", "rpm"), (apex, current.rpm + np.linspace(-width, width, points[1]))
    out = np.empty((len(values[1]), len(values[0])))
    for row, second in enumerate(values[1]):
        progress(f"sharpness over {names[0]} and {names[1]}", row / len(out))
        for column, first in enumerate(values[0]):
            changes: dict[str, Any] = {names[0]: float(first), names[1]: float(second)}
            out[row, column] = sharpness(replace(current, **changes))
    return CostSurface(names, values, out)


# Live stream as the inspector sees it: its last seconds as a recording, and figures about it.


@dataclass(frozen=True)
class LiveFigures:
    """Figures about a live stream, for the page."""

    connected: bool
    """Whether events arrive."""
    problem: str
    """Why no events arrive; empty if they do."""
    no_angles: str
    """Why no angles of the prism arrive; empty if they do, or if no events arrive either."""
    rate_mev_s: float
    """Rate of the received events [million events/s]."""
    latency_ms: float
    """Time since the latest events arrived [ms]: the age of what is shown, if it is shown now."""
    turn_share: float
    """Share of a turn of the prism that the kept events cover, 0 to 1."""
    dropped: int
    """Number of events that were dropped because this computer was too slow."""
    late: int
    """Number of events that arrived out of order and got a later time."""
    rpm: float | None
    """Measured speed of the prism in the last turn of the shown events [turns/min]; None if it is unknown."""
    message: str
    """Latest message of the source or of the controller; empty if there was none."""


class LiveSource:
    """Function that returns the last seconds of a stream as a recording, with figures about the stream."""

    def __init__(self, recent: RecentEvents, messages: Sequence[str]) -> None:
        """Start with events of at least one turn. ``messages`` grows while the stream is followed.

        Raises :class:`AmiwarpError` if there are fewer events.
        """
        first = recent.recording()
        if first is None:
            raise AmiwarpError("the stream has delivered less than one full turn; wait for one")
        self._recent, self._messages, self._last = recent, messages, first

    def __call__(self) -> Recording:
        """Return the latest events of at least one turn."""
        self._last = self._recent.recording() or self._last
        return self._last

    def figures(self) -> LiveFigures:
        """Return the figures of this moment."""
        recent, status, problem = self._recent, self._recent.status, self._recent.silence
        last, encoder = self._last.events.t_last, self._last.encoder
        turn_us = 2e6 if encoder is None else min(2e6, 60e6 / max(abs(encoder.rpm), 1.0))
        rpm = None if encoder is None else rpm_between(encoder, round(last - turn_us), last)
        return LiveFigures(
            not problem, problem, "" if problem else recent.encoder_silence, 0.0 if problem else status.rate_mev_s,
            1e3 * recent.age_s, recent.turn_share, status.dropped, status.late, rpm,
            self._messages[-1] if self._messages else "",
        )  # fmt: skip
