"""Trial of models on held-out turns: the two halves of the events, and the parameters that might be freed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib.parameters import DEGENERATE_WITH_APEX
from amiwarp.calib.preparation import rotation_window
from amiwarp.calib.selection.smaller_models import (
    QUANTISATION_PX,
    SHARE,
    Places,
    candidate_space,
    independent_directions,
    timing_blur,
)
from amiwarp.calib.sharpness.calibration_events import CalibrationEvents
from amiwarp.calib.sharpness.curvature import STEP_PX
from amiwarp.calib.sharpness.held_out import HalfSharpness, Quadratic, split_turns
from amiwarp.calib.sharpness.search import Settings
from amiwarp.calib.thinning import thin

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.result import Calibration
    from amiwarp.events.recording import Recording

    Vector = NDArray[np.float64]

SIGNIFICANT_STD = 2.0
"""Number of standard deviations by which a larger model, or a freed parameter, must be better on held-out turns."""
CONVERSION_FACTOR = 2.0
"""Accuracy, as a factor, with which sharpness measures displacements: it sees them only at edges and across them."""
BIAS_PX = 0.1
"""Bias of the sharpest parameters [px]. Smaller displacements are not significant in sharpness."""
LARGEST_MOTION_PX = 3.0
"""Largest displacement to which a loss of sharpness is converted: the quadratic holds only near the optimum [px]."""
SEARCH_RANGE = {"clock_offset": 20_000.0, "tilt_x": math.radians(15.0), "tilt_y": math.radians(15.0), "index": 0.4}
"""Half width of the range that is tested of each parameter that might be freed, in its unit."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Exact answer with the two halves of the events on which models are fitted and compared."""

    exact: Calibration
    """Calibration of the exact model."""
    calibration_events: CalibrationEvents
    """All events."""
    sample: Places
    """Sample of the events for the comparison of models."""
    rad_per_us: float
    """Mean speed of the prism [rad/us]."""
    duration_us: float
    """Duration of the events [us]."""
    budget_px: float
    """Largest tolerated model error [px rms]."""
    timing_px: float
    """Estimated blur by timing [px rms]."""
    train: HalfSharpness
    """Sharpness of the turns to which models are fitted."""
    test: HalfSharpness
    """Sharpness of the held-out turns."""
    space: ParameterSpace
    """Space of the exact model with all parameters that might be freed."""
    start: Vector
    """Answer of the sharpness stage as a vector of the space [px], shape ``(n,)``."""
    directions: Vector
    """One direction per parameter, see :func:`independent_directions`, shape ``(n, n)``."""
    tested: tuple[str, ...]
    """Parameters with a measurable effect within their range: size, phase and possibly others."""
    quadratic: Quadratic
    """Sharpness of the exact model about the start along the directions of ``tested``, on the training turns."""

    @property
    def rejection_px(self) -> float:
        """Displacement on held-out turns from which a model is rejected though its predicted error is small [px]."""
        return max(CONVERSION_FACTOR * self.budget_px, BIAS_PX)

    def space_of(self, model: str, exact: Calibration) -> ParameterSpace:
        """Return the parameter space of a model about an exact answer, with size and phase free."""
        return candidate_space(model, exact, (), rad_per_us=self.rad_per_us, duration_us=self.duration_us)

    def motion_range(self, name: str) -> float:
        """Return the motion of events by a parameter over its range, beyond that of size and phase [px rms]."""
        return _motion_range(self.space, self.directions, name)

    def shift_along(self, which: list[int], steps: Vector) -> Vector:
        """Return the shift of the search vector for steps along some of the tested directions [px]."""
        rows = [self.directions[self.space.names.index(self.tested[k])] for k in which]
        return np.asarray(steps @ np.array(rows))

    def sharpest(self, which: list[int]) -> dict[str, float]:
        """Return the parameters of the sharpest exact model on the training turns, free along some directions."""
        step = self.quadratic.restricted_to(which).step_to_maximum()
        return self.space.to_values(self.start + self.shift_along(which, step))

    def as_motion(self, loss: Vector) -> tuple[float, float, tuple[float, float]]:
        """Return the mean and standard deviation of a loss of sharpness, and the equivalent displacements [px rms].

        ``loss`` holds the losses of disjoint parts. The curvature of sharpness converts the mean minus and plus
        :data:`SIGNIFICANT_STD` standard deviations to displacements, negative for a gain, limited to
        :data:`LARGEST_MOTION_PX`. Without curvature the displacements are the two limits.
        """
        mean, std = float(loss.mean()), float(loss.std(ddof=1)) / math.sqrt(len(loss))
        curvature = self.quadratic.restricted_to([0, 1]).curvature
        if not curvature > 0.0:
            return mean, std, (-LARGEST_MOTION_PX, LARGEST_MOTION_PX)
        low, high = (
            math.copysign(min(math.sqrt(2.0 * abs(x) / curvature), LARGEST_MOTION_PX), x)
            for x in (mean - SIGNIFICANT_STD * std, mean + SIGNIFICANT_STD * std)
        )
        return mean, std, (low, high)


def in_pixels(px: float) -> str:
    """Return a displacement as text: its size, or that it is above the largest measurable one."""
    return f"{px:.3f} px" if px < LARGEST_MOTION_PX else f"more than {LARGEST_MOTION_PX:g} px"


def make_trial(
    recording: Recording,
    exact: Calibration,
    settings: Settings,
    names: tuple[str, ...],
    *,
    device: Any,
    budget_px: float | None,
) -> Trial:
    """Return a trial of an exact answer: both halves of the events on the device, and the sharpness about the answer.

    ``names`` are the parameters that might be freed. ``budget_px`` is the largest tolerated model error [px rms]; None:
    :data:`SHARE` of the blur by quantisation and timing.
    """
    events = thin(rotation_window(recording, settings), settings.events)
    first, last = int(events.t[0]), int(events.t[-1])
    encoder = exact.encoder_for(recording.encoder, first, last)
    if not encoder.covers(first, last):  # a calibrated clock offset may uncover the first or the last events
        events = events[slice(*np.searchsorted(events.t, encoder.coverage))]
        first, last = int(events.t[0]), int(events.t[-1])
    drifts = "clock_offset" in names
    events_with_angles = CalibrationEvents(events, encoder, (lambda t: encoder.speed_at(t) * 1e-6) if drifts else None)
    duration = float(max(last - first, 1))
    speed = float(np.ptp(encoder.angle_at(events.t[[0, -1]]))) / duration
    sample = Places.of(events, encoder)
    space = candidate_space("exact", sharpness_answer(exact), names, rad_per_us=speed, duration_us=duration)
    space = _with_search_range(space)
    train, test = (HalfSharpness(half, events_with_angles, space, device) for half in split_turns(events_with_angles))
    start = space.to_vector(space.start)
    rows = independent_directions(space, start, sample)
    which = [k for k, n in enumerate(space.names) if _motion_range(space, rows, n) >= STEP_PX]
    timing = timing_blur(exact.model, sample, encoder, speed)
    budget = budget_px or SHARE * math.hypot(QUANTISATION_PX, timing)
    return Trial(
        exact=exact, calibration_events=events_with_angles, sample=sample, rad_per_us=speed, duration_us=duration,
        budget_px=budget, timing_px=timing, train=train, test=test, space=space, start=start, directions=rows,
        tested=tuple(space.names[k] for k in which),
        quadratic=Quadratic.about(train, space, start, rows[which]),
    )  # fmt: skip


def sharpness_answer(exact: Calibration) -> Calibration:
    """Return the calibration with the parameters of the sharpness stage: the photometric ones are less sharp."""
    p = exact.photometric
    if p is None or not p.accepted:
        return exact
    # parameters that only the photometric stage found stay; a camera rotation that was discarded stays discarded
    found = {n: x for n, x in p.sharpness_parameters.items() if n in exact.parameters and n not in DEGENERATE_WITH_APEX}
    return replace(exact, parameters={**exact.parameters, **found})


def _with_search_range(space: ParameterSpace) -> ParameterSpace:
    return replace(
        space,
        low={n: space.start[n] - SEARCH_RANGE[n] if n in SEARCH_RANGE else x for n, x in space.low.items()},
        high={n: space.start[n] + SEARCH_RANGE[n] if n in SEARCH_RANGE else x for n, x in space.high.items()},
    )


def _motion_range(space: ParameterSpace, directions: Vector, name: str) -> float:
    """Return :meth:`Trial.motion_range`; infinite for parameters without a range."""
    k = space.names.index(name)
    return SEARCH_RANGE[name] * space.pixels[name] / abs(float(directions[k, k])) if name in SEARCH_RANGE else math.inf
