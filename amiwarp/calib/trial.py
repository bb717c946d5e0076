"""Data for the choice of a model: training and held-out events, and the parameters that might be freed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.calibration_events import CalibrationEvents
from amiwarp.calib.groundwork import CIRCLES, TILT, Groundwork, accepted_photometric, lay_groundwork
from amiwarp.calib.held_out_turns import HalfSharpness, QuadraticSharpness, split_turns
from amiwarp.calib.model_fit import BUDGET_SHARE, ellipse_error, fit_models
from amiwarp.calib.settings import Settings
from amiwarp.calib.thinning import thin_events
from amiwarp.calib.timing_blur import QUANTISATION_PX, timing_blur
from amiwarp.events.recording import Recording
from amiwarp.results.calibration import Calibration

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
TILT_FACTOR = 2.0
"""Factor by which a tilt may move events further than the correction of the principal point that it asks for: a tenth,
for lenses of 20 to 90 deg. The rest is for the linearised fit, which may find too small changes."""


@dataclass(frozen=True, kw_only=True)
class Trial(Groundwork):
    """Calibrated exact model, with the two halves of the events on which models are fitted and compared.

    The sharpness of the halves is measured when it is first used: most recordings do not need it.
    """

    exact: Calibration
    """Calibration of the exact model, with which smaller models are compared."""
    path: Vector
    """Coordinates of the sample compensated by the exact model at :data:`TURN` [px], shape ``(TURN_ANGLES, n, 2)``."""
    predicted: Mapping[str, float]
    """Predicted error of each model: the distance of its best fit from the exact model at the sample [px rms]."""
    budget_px: float
    """Largest tolerated error of a smaller model relative to the exact one [px rms]."""
    timing_px: float
    """Estimated blur from encoder noise, clock resolution and latency jitter [px rms]."""
    device: Any
    """Device that measures sharpness."""

    @cached_property
    def calibration_events(self) -> CalibrationEvents:
        """Evenly thinned events on which sharpness is measured, with their encoder."""
        drifts = "clock_offset" in self.space.names
        slope_of = (lambda t: self.encoder.speed_at(t) * 1e-6) if drifts else None
        return CalibrationEvents(thin_events(self.events, self.most_events), self.encoder, slope_of)

    @cached_property
    def _halves(self) -> tuple[HalfSharpness, ...]:
        halves = split_turns(self.calibration_events)
        return tuple(
            HalfSharpness(half, self.calibration_events, self.space, self.device) for half in halves
        )

    @property
    def train(self) -> HalfSharpness:
        """Sharpness of the training turns, on which models are fitted."""
        return self._halves[0]

    @property
    def test(self) -> HalfSharpness:
        """Sharpness of the held-out turns, on which models are compared."""
        return self._halves[1]

    @cached_property
    def quadratic(self) -> QuadraticSharpness:
        """Quadratic approximation of the exact model's sharpness on the training turns, along all tested directions."""
        rows = [self.space.names.index(n) for n in self.tested]
        return QuadraticSharpness.about(self.train, self.space, self.start, self.directions[rows])

    @cached_property
    def reference(self) -> Vector:
        """Sharpness of the exact model on the held-out turns, with the parameters sharpest on the training turns."""
        return self.test.of_parts(self.space, self.sharpest([0, 1]))

    @property
    def rejection_px(self) -> float:
        """Error shown by held-out turns above which a model is rejected even if its predicted error is small [px]."""
        return max(CONVERSION_FACTOR * self.budget_px, BIAS_PX)

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
        mean = float(loss.mean())
        std = float(loss.std(ddof=1)) / math.sqrt(len(loss))
        curvature = self.quadratic.restricted_to([0, 1]).curvature
        if not curvature > 0.0:
            return mean, std, (-LARGEST_MOTION_PX, LARGEST_MOTION_PX)

        def motion_px(lost: float) -> float:
            moved = math.sqrt(2.0 * abs(lost) / curvature)
            return math.copysign(min(moved, LARGEST_MOTION_PX), lost)

        low = motion_px(mean - SIGNIFICANT_STD * std)
        high = motion_px(mean + SIGNIFICANT_STD * std)
        return mean, std, (low, high)


def in_pixels(px: float) -> str:
    """Return a displacement as text; above the largest measurable displacement only that limit is given."""
    return f"{px:.3f} px" if px < LARGEST_MOTION_PX else f"more than {LARGEST_MOTION_PX:g} px"


def trial_for(
    recording: Recording,
    exact: Calibration,
    settings: Settings,
    names: tuple[str, ...],
    ready: Groundwork | None = None,
    *,
    device: Any,
) -> Trial:
    """Return the trial of ``exact``, which tests the parameters ``names``.

    It does not test the tilt if the photometric stage has shown that a tilt moves events by less than the budget.
    ``ready``: groundwork that was laid before, if any.
    """
    untilted = tuple(name for name in names if name not in TILT)
    tilt = largest_tilt(exact)
    if tilt < math.inf:
        if ready is not None and ready.serves(exact, untilted):
            ground = ready
        else:
            ground = lay_groundwork(recording, exact, settings, untilted)
        trial = make_trial(ground, exact, device=device, budget_px=settings.budget_px)
        if tilt <= trial.budget_px or names == untilted:
            return trial
    ground = lay_groundwork(recording, exact, settings, names)
    return make_trial(ground, exact, device=device, budget_px=settings.budget_px)


def make_trial(
    ground: Groundwork, exact: Calibration, *, device: Any, budget_px: float | None
) -> Trial:
    """Compare the models with the calibrated exact model, on the groundwork for it.

    ``budget_px`` is the largest tolerated model error [px rms]; None: :data:`BUDGET_SHARE` of the blur by quantisation
    and timing.
    """
    path = ground.sample.path(exact.model)
    timing = timing_blur(path, ground.encoder_noise, ground.rad_per_us)
    fits = fit_models(ground.circles, path[0], ground.sample)
    predicted = {name: px for name, (_, px) in zip(CIRCLES, fits, strict=True)}
    return Trial(
        **vars(ground),
        exact=exact,
        path=path,
        predicted={**predicted, "ellipse": ellipse_error(path), "exact": 0.0},
        budget_px=budget_px or BUDGET_SHARE * math.hypot(QUANTISATION_PX, timing),
        timing_px=timing,
        device=device,
    )


def largest_tilt(exact: Calibration) -> float:
    """Return how far a tilt of the prism's axis may move events [px rms]; infinite if only sharpness can show it.

    A tilt would ask the photometric stage for another principal point.
    """
    found = accepted_photometric(exact)
    if found is None or found.center_px is None:
        return math.inf
    moved, std = found.center_px
    return TILT_FACTOR * (moved + SIGNIFICANT_STD * std)
