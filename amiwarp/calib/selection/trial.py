"""Data for the choice of a model: training and held-out events, and the parameters that might be freed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib.parameters import DEGENERATE_WITH_APEX
from amiwarp.calib.preparation import rotation_window
from amiwarp.calib.selection.smaller_models import (
    QUANTISATION_PX,
    SHARE,
    TURN,
    LinearMotion,
    Places,
    candidate_space,
    independent_directions,
    linear_motions,
    scales,
    timing_blur,
)
from amiwarp.calib.sharpness.calibration_events import CalibrationEvents
from amiwarp.calib.sharpness.curvature import STEP_PX
from amiwarp.calib.sharpness.held_out import HalfSharpness, Quadratic, split_turns
from amiwarp.calib.sharpness.search import Settings
from amiwarp.calib.thinning import thin, thin_events
from amiwarp.events.events import MemoryEvents

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.result import Calibration
    from amiwarp.calib.summaries import PhotometricSummary
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.events.recording import Recording

    Vector = NDArray[np.float64]

SIGNIFICANT_STD = 2.0
"""Number of standard deviations by which a larger model, or a freed parameter, must be sharper on held-out turns."""
CONVERSION_FACTOR = 2.0
"""Factor by which a displacement inferred from a loss of sharpness may be wrong: sharpness sees displacements only at
edges and across them."""
BIAS_PX = 0.1
"""Typical distance of the sharpest parameters from the true ones [px]. Smaller displacements are not significant in
sharpness."""
LARGEST_MOTION_PX = 3.0
"""Largest displacement to which a loss of sharpness is converted [px]: the quadratic approximation of sharpness holds
only near the optimum."""
SEARCH_RANGE = {"clock_offset": 20_000.0, "tilt_x": math.radians(15.0), "tilt_y": math.radians(15.0), "index": 0.4}
"""Half width of the tested range of each parameter that might be freed, in its unit (us, rad, 1)."""


CIRCLES = ("circle", "radial")
"""Models that are fitted to the exact one."""
TILT = ("tilt_x", "tilt_y")
"""Parameters of the direction of the prism's axis."""
TILT_FACTOR = 2.0
"""Factor by which a tilt may move events further than the correction of the principal point that it asks for: a tenth,
for lenses of 20 to 90 deg. The rest is for the linearised fit, which may find too small changes."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Calibrated exact model, with the two halves of the events on which models are fitted and compared.

    The sharpness of the halves is measured when it is first used: most recordings do not need it.
    """

    exact: Calibration
    """Calibration of the exact model, with which smaller models are compared."""
    encoder: Encoder
    """Encoder that gives the prism angles of the events, with the calibrated clock offset."""
    events: Events
    """Events of the recording: all that are in memory, or a part of those in a file."""
    most_events: int
    """Largest number of events on which sharpness is measured."""
    sample: Places
    """Evenly thinned events at which the displacements of models are compared."""
    path: Vector
    """Coordinates of the sample compensated by the exact model at :data:`TURN` [px], shape ``(TURN_ANGLES, n, 2)``."""
    circles: tuple[LinearMotion, ...]
    """Motion of the sample by each of the models :data:`CIRCLES`, about the exact model's parameters."""
    rad_per_us: float
    """Mean speed of the prism [rad/us]."""
    duration_us: float
    """Duration of the events [us]."""
    budget_px: float
    """Largest tolerated error of a smaller model relative to the exact one [px rms]."""
    timing_px: float
    """Estimated blur from encoder noise, clock resolution and latency jitter [px rms]."""
    device: Any
    """Device that measures sharpness."""
    space: ParameterSpace
    """Parameter space of the exact model in which all parameters that might be freed are free."""
    start: Vector
    """Parameters found by the sharpness stage, as a vector of ``space`` [px], shape ``(n,)``."""
    directions: Vector
    """One search direction per parameter (see :func:`independent_directions`), shape ``(n, n)``."""
    tested: tuple[str, ...]
    """Parameters that move events measurably within their tested range: size, phase and possibly others."""

    @cached_property
    def calibration_events(self) -> CalibrationEvents:
        """Evenly thinned events on which sharpness is measured, with their encoder."""
        drifts = "clock_offset" in self.space.names
        slope_of = (lambda t: self.encoder.speed_at(t) * 1e-6) if drifts else None
        return CalibrationEvents(thin_events(self.events, self.most_events), self.encoder, slope_of)

    @cached_property
    def _halves(self) -> tuple[HalfSharpness, ...]:
        halves = split_turns(self.calibration_events)
        return tuple(HalfSharpness(half, self.calibration_events, self.space, self.device) for half in halves)

    @property
    def train(self) -> HalfSharpness:
        """Sharpness of the training turns, on which models are fitted."""
        return self._halves[0]

    @property
    def test(self) -> HalfSharpness:
        """Sharpness of the held-out turns, on which models are compared."""
        return self._halves[1]

    @cached_property
    def quadratic(self) -> Quadratic:
        """Quadratic approximation of the exact model's sharpness on the training turns, along all tested directions."""
        rows = [self.space.names.index(n) for n in self.tested]
        return Quadratic.about(self.train, self.space, self.start, self.directions[rows])

    @cached_property
    def reference(self) -> Vector:
        """Sharpness of the exact model on the held-out turns, with the parameters sharpest on the training turns."""
        return self.test.each(self.space, self.sharpest([0, 1]))

    @property
    def rejection_px(self) -> float:
        """Error shown by held-out turns above which a model is rejected even if its predicted error is small [px]."""
        return max(CONVERSION_FACTOR * self.budget_px, BIAS_PX)

    def space_of(self, model: str, exact: Calibration) -> ParameterSpace:
        """Return the parameter space of ``model`` about the calibration ``exact``, with only size and phase free."""
        return candidate_space(
            model, exact, (), rad_per_us=self.rad_per_us, duration_us=self.duration_us, pixels=self.space.pixels
        )

    def motion_range(self, name: str) -> float:
        """Return how far a parameter moves events in its tested range [px rms], beyond what size and phase can do."""
        return _motion_range(self.space, self.directions, name)

    def shift_along(self, which: list[int], steps: Vector) -> Vector:
        """Return the change of the search vector [px] for ``steps`` along the directions numbered in ``which``."""
        rows = [self.directions[self.space.names.index(self.tested[k])] for k in which]
        return np.asarray(steps @ np.array(rows))

    def sharpest(self, which: list[int]) -> dict[str, float]:
        """Return the exact model's sharpest parameters on the training turns along the directions in ``which``."""
        step = self.quadratic.restricted_to(which).step_to_maximum()
        return self.space.to_values(self.start + self.shift_along(which, step))

    def as_motion(self, loss: Vector) -> tuple[float, float, tuple[float, float]]:
        """Return the mean and standard deviation of losses of sharpness, and the equivalent displacements [px rms].

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
    """Return a displacement as text; above the largest measurable displacement only that limit is given."""
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
    """Prepare the choice of a model: the places of events, and what the parameters that might be freed do there.

    ``names`` are these parameters; the tilt is left out if it cannot exceed the budget. ``budget_px`` is the largest
    tolerated model error [px rms]; None: :data:`SHARE` of the blur by quantisation and timing.
    """
    window = rotation_window(recording, settings)
    source, most = window.events, settings.events
    if isinstance(source, MemoryEvents):
        events = source.slice(0, len(source))
    else:
        events = thin(window, most)
        most = len(events)
    first, last = int(events.t[0]), int(events.t[-1])
    encoder = exact.encoder_for(recording.encoder, first, last)
    if not encoder.covers(first, last):  # a calibrated clock offset may uncover the first or the last events
        events = events[slice(*np.searchsorted(events.t, encoder.coverage))]
        first, last = int(events.t[0]), int(events.t[-1])
    duration = float(max(last - first, 1))
    speed = float(np.ptp(encoder.angle_at(events.t[[0, -1]]))) / duration
    sample = Places.of(events, encoder)
    path = sample.by_each([exact.model] * len(TURN), TURN)
    timing = timing_blur(path, encoder, speed)
    budget = budget_px or SHARE * math.hypot(QUANTISATION_PX, timing)
    if largest_tilt(exact) <= budget:
        names = tuple(n for n in names if n not in TILT)
    space = candidate_space(
        "exact", sharpness_answer(exact), names, rad_per_us=speed, duration_us=duration,
        pixels=None if set(TILT) & set(names) else scales(path, sample, exact, speed),
    )  # fmt: skip
    space = _with_search_range(space)
    circles = [
        candidate_space(name, exact, (), rad_per_us=speed, duration_us=duration, pixels=space.pixels)
        for name in CIRCLES
    ]
    motion, *smaller = linear_motions([space, *circles], sample)
    rows = independent_directions(motion)
    return Trial(
        exact=exact, encoder=encoder, events=events, most_events=most, sample=sample, path=path,
        circles=tuple(smaller), rad_per_us=speed, duration_us=duration, budget_px=budget, timing_px=timing,
        device=device, space=space, start=motion.v, directions=rows,
        tested=tuple(n for n in space.names if _motion_range(space, rows, n) >= STEP_PX),
    )  # fmt: skip


def accepted_photometric(exact: Calibration) -> PhotometricSummary | None:
    """Return the result of the photometric stage if it is the calibration's result, else None."""
    p = exact.photometric
    return p if p is not None and p.accepted else None


def largest_tilt(exact: Calibration) -> float:
    """Return how far a tilt of the prism's axis may move events [px rms]; infinite if only sharpness can show it.

    A tilt would ask the photometric stage for another principal point.
    """
    p = accepted_photometric(exact)
    if p is None or p.center_px is None:
        return math.inf
    moved, std = p.center_px
    return TILT_FACTOR * (moved + SIGNIFICANT_STD * std)


def sharpness_answer(exact: Calibration) -> Calibration:
    """Return the calibration with the sharpness stage's parameters, which are sharper than the photometric stage's."""
    p = accepted_photometric(exact)
    if p is None:
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
    """Return the value of :meth:`Trial.motion_range`; infinite for parameters without a range."""
    k = space.names.index(name)
    return SEARCH_RANGE[name] * space.pixels[name] / abs(float(directions[k, k])) if name in SEARCH_RANGE else math.inf
