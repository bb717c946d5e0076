"""Contrast maximisation: a global search on a coarse image of events, then a local search on a fine one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib import checks
from amiwarp.calib.nlopt_solver import GLOBAL_ALGORITHMS, LOCAL_ALGORITHMS, SearchStage, check_algorithm, maximise
from amiwarp.calib.parameters import DEGENERATE_WITH_APEX, MOTION, UNITS, check_names
from amiwarp.calib.photometric.stage import PhotometricSettings
from amiwarp.calib.progress_share import stage_share
from amiwarp.calib.sharpness.curvature import finite_differences
from amiwarp.calib.sharpness.objective import Objective, padding
from amiwarp.calib.summaries import StageSummary
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.choices import Sharpness
from amiwarp.optics.models import MODELS
from amiwarp.progress import Progress
from amiwarp.validation import choice, guarded, one_of, real, shown, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.sharpness.calibration_events import CalibrationEvents

CANDIDATES = 3
"""Largest number of optima of the coarse image from which the local search starts."""
PARTS = 8
"""Number of disjoint parts of the events, whose scatter measures the uncertainty of the parameters."""
LARGEST_BUDGET = 10**12
"""Upper limit of the settings that give numbers of evaluations and of events."""
LARGEST_FOLD = 1 << 20
"""Upper limit of the setting ``fold``, a number of angle bins per turn."""
AUTO = "auto"
"""Name in the settings for the automatic choice of the model."""
STAGES = ("sharpness", "photometric")
"""Names of the stages of a calibration, in order."""


@guarded
@dataclass(frozen=True)
class Settings:
    """Settings of a calibration.

    The defaults were chosen by measurement, see ``docs/explanation/calibration.md``.

    Examples
    --------
    >>> amiwarp.Settings(model="circle", events=100_000).sharpness.value
    'variance'
    """

    model: str = AUTO
    """Model: ``circle``, ``radial``, ``ellipse``, ``exact``, or ``auto`` for the smallest with a tolerable error."""
    budget_px: float | None = None
    """Largest tolerated error of a smaller model for ``auto``, relative to the exact model [px rms]; None: a tenth of
    the blur by quantisation and timing."""
    sharpness: Sharpness = Sharpness.VARIANCE
    """Measure of sharpness that the search maximises."""
    global_algorithm: str | None = "GN_DIRECT_L"
    """NLopt algorithm of the global search; None: no global search, the local search starts at ``start``."""
    local_algorithm: str = "LN_BOBYQA"
    """NLopt algorithm of the local search that follows the global search."""
    free: tuple[str, ...] | None = None
    """Names of the free parameters; None: size and phase, and without an encoder ``rpm``."""
    start: Mapping[str, float] = field(default_factory=dict)
    """Known or start values by parameter name, in rad, us, 1/min or px. A value of a parameter that is not free stays
    fixed."""
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Lower and upper bounds of free parameters by name, in the units of ``start``."""
    global_evaluations: int = 120
    """Number of evaluations of the global search."""
    local_evaluations: int = 200
    """Largest number of evaluations of each local search."""
    tolerance_px: float = 0.002
    """Length below which the steps of the local search end it, as displacement of events [px]."""
    smoothing_px: float = 1.0
    """Standard deviation of the Gaussian that smooths the fine image [px]; 4 px are used for the coarse image."""
    per_polarity: bool = False
    """Whether ON and OFF events form separate images."""
    events: int = 300_000
    """Largest number of events that are used, thinned evenly; the global search uses a third of them."""
    fold: int = 0
    """Number of angle bins per turn into which each pixel's events are folded as weighted points; 0: no folding."""
    seed: int = 0
    """Seed of the algorithms that use random numbers."""
    stages: tuple[str, ...] = STAGES
    """Stages to run: ``("sharpness",)`` or ``("sharpness", "photometric")``."""
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)
    """Settings of the photometric stage."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sharpness", choice(Sharpness, self.sharpness, "sharpness"))

    def check(self) -> None:
        """Check the settings.

        Raises
        ------
        AmiwarpError
            If a name is unknown or a number out of range.
        """
        one_of(self.model, (AUTO, *MODELS), "model")
        if self.global_algorithm is not None:
            check_algorithm(self.global_algorithm, GLOBAL_ALGORITHMS)
        check_algorithm(self.local_algorithm, LOCAL_ALGORITHMS)
        if not isinstance(self.stages, tuple) or [*map(str, self.stages)] not in ([*STAGES], [*STAGES[:1]]):
            raise AmiwarpError(f"stages is {shown(self.stages)}; expected 'sharpness' or 'sharpness, photometric'")
        for name in ("global_evaluations", "local_evaluations", "events"):
            whole(getattr(self, name), name, 1, LARGEST_BUDGET)
        whole(self.fold, "fold", 0, LARGEST_FOLD)
        whole(self.seed, "seed", 0, 2**31 - 1)
        real(self.tolerance_px, "tolerance_px", 0.0, 1e3, " px")
        real(self.smoothing_px, "smoothing_px", 0.0, 1e3, " px")
        check_names(self.free, self.start, self.bounds)
        self.photometric.check()


class Search:
    """Search for the parameters that make the image of warped events sharpest.

    :meth:`run` sets ``best``, the values of all parameters, and ``score``, the sharpness there.
    """

    def __init__(
        self,
        space: ParameterSpace,
        calibration_events: CalibrationEvents,
        settings: Settings,
        device: Any,
        progress: Progress | None,
    ) -> None:
        self.full_space = space
        """Parameter space of the photometric stage: all free parameters."""
        self.space = space.without(DEGENERATE_WITH_APEX) if "photometric" in settings.stages else space
        """Parameter space of the sharpness search: without the parameters that are left to the photometric stage."""
        self.calibration_events, self.settings, self.device = calibration_events, settings, device
        self.progress = progress
        self.stages: list[StageSummary] = []
        self.pad = padding(self.space)
        """Border of the fine image outside the sensor [px]."""
        self.fine = self._objective(calibration_events, scale=1.0, smoothing=settings.smoothing_px)

    def _objective_by_parts(self, kind: Sharpness) -> Objective:
        """Return an objective that measures disjoint parts of the events separately."""
        smoothing = max(1.0, self.settings.smoothing_px)
        return self._objective(self.calibration_events, scale=1.0, smoothing=smoothing, kind=kind, parts=PARTS)

    def _objective(
        self,
        events: CalibrationEvents,
        *,
        scale: float,
        smoothing: float,
        kind: Sharpness | None = None,
        space: ParameterSpace | None = None,
        parts: int = 1,
    ) -> Objective:
        s = self.settings
        kind, space = kind or s.sharpness, space or self.space
        pad = self.pad if space is self.space else padding(space)
        if kind is Sharpness.PAPER_J:
            smoothing = 0.0  # J counts pixels with h > 0, and a Gaussian's tails would make almost all of them positive
        return Objective(
            space, events.on(self.device, space.middle_us if space.moving else None),
            kind=kind, smoothing=smoothing, pad=pad, scale=scale,
            per_polarity=s.per_polarity, parts=parts, device=self.device,
        )  # fmt: skip

    def run(self) -> None:
        """Run the global and the local search; set ``best``, ``score`` and ``stages``."""
        starts = [self.space.to_vector(self.space.start)]
        if self.settings.global_algorithm is not None:
            starts = self._run_global(self.settings.global_algorithm)
        if self.space.moving:
            starts = [self._track_rotation(start) for start in starts]
        runs: list[SearchStage] = []
        for start in starts:
            runs.append(self._run_local(start, [run.x for run in runs]))
        best = max(runs, key=lambda run: run.score)
        self.best, self.score = self.space.to_values(best.x), best.score

    def _coarse_objective(self, events: CalibrationEvents, space: ParameterSpace) -> Objective:
        step = max(1, len(events.events) // (self.settings.events // 3 + 1))
        return self._objective(events.every(step), scale=0.5, smoothing=4.0, space=space)

    def _run_global(self, algorithm: str) -> list[NDArray[np.float64]]:
        """Run the global search and return the starts of the local search.

        The camera's rotation stays at its start values.
        """
        space = self.space.without(MOTION) if self.space.moving else self.space
        if not space.names:
            return [self.space.to_vector(self.space.start)]
        start = space.to_vector(space.start)
        objective = self._coarse_objective(self.calibration_events, space)
        stage = self._maximise(objective, algorithm, start, self.settings.global_evaluations, step=1.0)
        return [self.space.to_vector(space.to_values(v)) for v in distinct_optima(stage, CANDIDATES)]

    def _track_rotation(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Improve the start values of a rotating camera by a local search on the coarse image.

        Without a prism there is no estimate of the rotation. Then the events come from windows that grow about the
        middle: in a short window the blur is smaller than the smoothing, whatever the speed.
        """
        for share in (1.0,) if self.space.sized else (0.125, 0.25, 0.5, 1.0):
            objective = self._coarse_objective(self.calibration_events.central(share), self.space)
            stage = self._maximise(
                objective, self.settings.local_algorithm, start, self.settings.local_evaluations, step=2.0
            )
            start = stage.x
        return start

    def _run_local(self, start: NDArray[np.float64], known: Sequence[NDArray[np.float64]]) -> SearchStage:
        """Run a local search on the fine image from ``start``. It ends early near an optimum in ``known``."""
        return self._maximise(
            self.fine, self.settings.local_algorithm, start, self.settings.local_evaluations, step=0.7, known=known
        )

    def _maximise(
        self,
        objective: Objective,
        algorithm: str,
        start: NDArray[np.float64],
        budget: int,
        step: float,
        known: Sequence[NDArray[np.float64]] = (),
    ) -> SearchStage:
        """Run a search algorithm and append its summary to ``stages``."""
        space, values = objective.space, []
        low, high = space.bounds()
        name = "global" if algorithm.startswith("G") else "local"

        def score(v: NDArray[np.float64]) -> float:
            if self.progress is not None:
                self.progress(*stage_share(self.settings, name, objective.evaluations / budget))
            values.append(space.to_values(v))
            return objective.values(values[-1])

        s = self.settings
        stage = maximise(
            score, algorithm, low=low, high=high, start=start, evaluations=budget, tolerance=s.tolerance_px, step=step,
            inner=s.local_algorithm, seed=s.seed, known=known,
        )  # fmt: skip
        self.stages.append(StageSummary.of(name, stage, space.names, values))
        return stage

    def check_answer(self, name: str) -> tuple[tuple[str, ...], dict[str, float]]:
        """Return warnings and standard deviations; raise :class:`AmiwarpError` if chance explains the sharpness."""
        best = self.best
        parts = self._objective_by_parts(self.settings.sharpness)
        if self.space.sized:
            self._check_sharper_than_chance(best, parts, name)
            checks.check_directions(self.fine.image(best), self._edge_inset, name)
        v = self.space.to_vector(best)
        covariance, warnings = estimate_covariance(parts, v)
        return self._bound_warnings(best) + warnings, self.space.deviations(v, covariance)

    def _check_sharper_than_chance(self, best: dict[str, float], parts: Objective, name: str) -> None:
        # variance, whatever the measure of the search: the paper's J may prefer an image without compensation
        variance = (
            parts if self.settings.sharpness is Sharpness.VARIANCE else self._objective_by_parts(Sharpness.VARIANCE)
        )
        points = (best, {**best, "phase": best["phase"] + math.pi}, {**best, self.space.size_name: 0.0})
        sharp, opposite, still = (variance.each(values) for values in points)
        checks.check_texture(sharp, opposite, still, name)

    @property
    def _edge_inset(self) -> int:
        """Border of the fine image that the check of edge directions leaves out [px].

        It is the part outside the sensor and as much inside, where the view ends, but at most a quarter of the sensor.
        """
        camera = self.space.camera
        return self.pad + min(self.pad, min(camera.width, camera.height) // 4)

    def sharpness_in(self, space: ParameterSpace, values: Mapping[str, float]) -> float:
        """Return the sharpness at ``values`` with the camera and the prism of ``space``."""
        known, fine = self.space, self.fine
        same = (space.model, space.names, space.camera, space.prism, space.moving, space.start, space.high) == (
            known.model, known.names, known.camera, known.prism, known.moving, known.start, known.high
        )  # fmt: skip
        if not same:
            smoothing = self.settings.smoothing_px
            fine = self._objective(self.calibration_events, scale=1.0, smoothing=smoothing, space=space)
        return fine.values(values)

    def _bound_warnings(self, best: dict[str, float]) -> tuple[str, ...]:
        """Return a warning for each parameter that ended on a bound."""
        s = self.space
        at_bound = [
            n for n in s.names if n != "phase" and min(best[n] - s.low[n], s.high[n] - best[n]) * s.pixels[n] < 0.05
        ]
        return tuple(f"{n} = {best[n]:.6g} {UNITS[n]} lies on its bound; widen the bounds of {n}" for n in at_bound)


def distinct_optima(stage: SearchStage, most: int, apart: float = 6.0) -> list[NDArray[np.float64]]:
    """Return at most ``most`` best points of a stage, each at least ``apart`` px away from all better points."""
    points = stage.points.tolist()
    chosen: list[int] = []
    for k in np.argsort(-stage.scores, kind="stable").tolist():
        if all(math.dist(points[k], points[other]) >= apart for other in chosen):
            chosen.append(k)
            if len(chosen) == most:
                break
    return [stage.points[k] for k in chosen]


def estimate_covariance(parts: Objective, v: NDArray[np.float64]) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Return the covariance of the optimum [px²], and warnings that name the parameters of flat directions.

    The sandwich estimate H⁻¹ cov(g) H⁻¹ / n from n disjoint parts of the events: g is a part's gradient at the optimum
    of all events, and H the mean Hessian of the parts.
    """
    slopes, hessian = finite_differences(lambda shift: parts.each(parts.space.to_values(v + shift)), np.eye(len(v)))
    gradients = slopes.T
    values, vectors = np.linalg.eigh(-hessian)
    largest = max(float(values.max()), 1e-12)
    weak = values < 1e-3 * largest
    inverse = vectors @ np.diag(1.0 / np.maximum(values, 1e-3 * largest)) @ vectors.T
    names = parts.space.names
    warnings = tuple(
        f"the events hardly determine {names[int(np.argmax(np.abs(vectors[:, k])))]} (curvature "
        f"{values[k] / largest:.1e} of the largest one)"
        for k in np.flatnonzero(weak)
    )
    return inverse @ np.atleast_2d(np.cov(gradients.T)) @ inverse / len(gradients), warnings
