"""One search for the sharpest image: a global stage on a coarse image, then a local one on a fine image."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib import checks
from amiwarp.calib.parameters import LATE, MOTION, UNITS, check_names
from amiwarp.calib.photometric.stage import PhotometricSettings
from amiwarp.calib.result import StageSummary
from amiwarp.calib.sharpness.curvature import differences
from amiwarp.calib.sharpness.objective import Objective
from amiwarp.calib.solve import GLOBAL_ALGORITHMS, LOCAL_ALGORITHMS, SearchStage, check_algorithm, maximise
from amiwarp.calib.stage_share import stage_share
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.device_events import upload_events
from amiwarp.optics.models import MODELS
from amiwarp.progress import Progress
from amiwarp.validation import choice, one_of, real, shown, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.imaging.device_events import DeviceEvents

    SlopeOf = Callable[[NDArray[np.int64]], NDArray[np.float64]]

CANDIDATES = 3
"""Optima of the coarse image that are looked at on the fine one."""
PARTS = 8
"""Disjoint parts of the events that tell chance from signal."""

LARGEST_BUDGET = 10**12
"""Of evaluations and events: more is a mistake."""
LARGEST_FOLD = 1 << 20
AUTO = "auto"
STAGES = ("sharpness", "photometric")

"""Called with the stage's name, evaluations done, and its budget."""


@dataclass(frozen=True)
class Settings:
    """How to calibrate; every default was chosen by measurement, see ``docs/calibration.md``."""

    model: str = AUTO
    """One of the ladder, or ``auto``: the smallest that keeps the budget."""
    budget_px: float | None = None
    """For ``auto``: see :func:`amiwarp.calib.selection.model_choice.calibrate_auto`."""
    sharpness: Sharpness = Sharpness.VARIANCE
    global_algorithm: str | None = "GN_DIRECT_L"
    """None starts the local search at ``start`` at once."""
    local_algorithm: str = "LN_BOBYQA"
    free: tuple[str, ...] | None = None
    """Names of what to find; None: size and phase (and rpm, without an encoder)."""
    start: Mapping[str, float] = field(default_factory=dict)
    """Known values [rad, us, 1/min], by parameter name."""
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    global_evaluations: int = 120
    local_evaluations: int = 200
    tolerance_px: float = 0.002
    """The local search ends when its steps move events by less [px]."""
    smoothing_px: float = 1.0
    """Of the fine image [px]; the coarse one has 4 px."""
    per_polarity: bool = False
    """ON and OFF events in images of their own."""
    events: int = 300_000
    """At most so many events, thinned evenly; the global search uses a third of them."""
    fold: int = 0
    """Angles a turn into which the events of a pixel are folded, each point then standing for several; 0: none."""
    seed: int = 0
    stages: tuple[str, ...] = STAGES
    """Without "photometric" the answer of sharpness stands."""
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sharpness", choice(Sharpness, self.sharpness, "sharpness"))

    def check(self) -> None:
        one_of(self.model, (AUTO, *MODELS), "model")
        if self.global_algorithm is not None:
            check_algorithm(self.global_algorithm, GLOBAL_ALGORITHMS)
        check_algorithm(self.local_algorithm, LOCAL_ALGORITHMS)
        if not isinstance(self.stages, tuple) or [*map(str, self.stages)] not in ([*STAGES], [*STAGES[:1]]):
            raise AmiwarpError(f"stages {shown(self.stages)} are not 'sharpness' or 'sharpness, photometric'")
        for name in ("global_evaluations", "local_evaluations", "events"):
            whole(getattr(self, name), name, 1, LARGEST_BUDGET)
        whole(self.fold, "fold", 0, LARGEST_FOLD)
        whole(self.seed, "seed", 0, 2**31 - 1)
        real(self.tolerance_px, "tolerance_px", 0.0, 1e3, " px")
        real(self.smoothing_px, "smoothing_px", 0.0, 1e3, " px")
        check_names(self.free, self.start, self.bounds)
        self.photometric.check()


@dataclass(frozen=True)
class Material:
    """The events of a calibration, and what gives them their angles."""

    events: Events
    encoder: Encoder
    slope_of: SlopeOf | None
    """Where a parameter drifts the angle: change of the angle at times [us] per unit of it."""
    fold: int = 0
    """See :class:`Settings`."""
    _uploaded: dict[tuple[str, int | None], DeviceEvents] = field(default_factory=dict, repr=False, init=False)

    def on(self, device: Any, middle_us: int | None) -> DeviceEvents:
        """The events on a device, put there once; with their times from ``middle_us`` if it is given."""
        if (str(device), middle_us) not in self._uploaded:
            slope = None if self.slope_of is None else self.slope_of(self.events.t)
            events = upload_events(self.events, self.encoder, device, slope=slope, middle_us=middle_us, fold=self.fold)
            self._uploaded[str(device), middle_us] = events
        return self._uploaded[str(device), middle_us]

    def every(self, step: int) -> Material:
        return self if step == 1 else self._cut(slice(0, None, step))

    def central(self, share: float) -> Material:
        """The events within ``share`` of the time about its middle."""
        t = self.events.t
        middle, half = (int(t[0]) + int(t[-1])) / 2.0, share * (int(t[-1]) - int(t[0])) / 2.0
        first, last = np.searchsorted(t, [middle - half, middle + half])
        return self._cut(slice(int(first), int(last) + 1))

    def _cut(self, cut: slice) -> Material:
        return Material(self.events[cut], self.encoder, self.slope_of, self.fold)


class Search:
    """One calibration under way: coarse and fine objective over the same space."""

    def __init__(
        self, space: ParameterSpace, material: Material, settings: Settings, device: Any, progress: Progress | None
    ) -> None:
        # the whole space is the photometric stage's
        self.whole = space
        self.space = space.without(LATE) if "photometric" in settings.stages else space
        self.material, self.settings, self.device = material, settings, device
        self.progress = progress
        self.stages: list[StageSummary] = []
        self.fine = self._objective(material, 1.0, settings.smoothing_px)

    def _parts(self, kind: Sharpness) -> Objective:
        return self._objective(self.material, 1.0, max(1.0, self.settings.smoothing_px), kind, parts=PARTS)

    def _objective(
        self,
        m: Material,
        scale: float,
        smoothing: float,
        kind: Sharpness | None = None,
        space: ParameterSpace | None = None,
        parts: int = 1,
    ) -> Objective:
        s = self.settings
        kind, space = kind or s.sharpness, space or self.space
        if kind is Sharpness.PAPER_J:
            smoothing = 0.0  # the tails of a Gaussian are pixels with h > 0, each of which J would count
        return Objective(
            space, m.on(self.device, space.middle_us if space.moving else None),
            kind=kind, smoothing=smoothing, scale=scale,
            per_polarity=s.per_polarity, parts=parts, device=self.device,
        )  # fmt: skip

    def run(self) -> None:
        """Finds ``best``, its ``score``, and keeps the ``stages`` that led there."""
        starts = [self.space.to_vector(self.space.start)]
        if self.settings.global_algorithm is not None:
            starts = self._run_global(self.settings.global_algorithm)
        if self.space.moving:
            starts = [self._follow(start) for start in starts]
        runs = [self._run_local(start) for start in starts]
        best = max(runs, key=lambda run: run.score)
        self.stages.extend(StageSummary.of("local", run, self.space) for run in runs)
        self.best, self.score = self.space.to_values(best.x), best.score

    def _coarse(self, material: Material, space: ParameterSpace) -> Objective:
        step = max(1, len(material.events) // (self.settings.events // 3 + 1))
        return self._objective(material.every(step), 0.5, 4.0, space=space)

    def _run_global(self, algorithm: str) -> list[NDArray[np.float64]]:
        """Starts for the local search. The camera's motion stays at its start, unless it is all that is sought."""
        space = self.space.without(MOTION)
        if not space.names:
            return [self.space.to_vector(self.space.start)]
        start = space.to_vector(space.start)
        objective = self._coarse(self.material, space)
        stage = self._maximise(objective, algorithm, start, self.settings.global_evaluations, step=1.0)
        self.stages.append(StageSummary.of("global", stage, space))
        return [self.space.to_vector(space.to_values(v)) for v in distinct_optima(stage, CANDIDATES)]

    def _follow(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """A turning camera followed on the coarse image, through windows that grow about the middle where no prism
        tells how it turns: a short window blurs less than the smoothing, whatever the speed."""
        for share in (1.0,) if self.space.sized else (0.125, 0.25, 0.5, 1.0):
            objective = self._coarse(self.material.central(share), self.space)
            stage = self._maximise(
                objective, self.settings.local_algorithm, start, self.settings.local_evaluations, step=2.0
            )
            start = stage.x
            self.stages.append(StageSummary.of("local", stage, self.space))
        return start

    def _run_local(self, start: NDArray[np.float64]) -> SearchStage:
        return self._maximise(
            self.fine, self.settings.local_algorithm, start, self.settings.local_evaluations, step=0.7
        )

    def _maximise(
        self, objective: Objective, algorithm: str, start: NDArray[np.float64], budget: int, step: float
    ) -> SearchStage:
        low, high = objective.space.bounds()
        name = "global" if algorithm.startswith("G") else "local"

        def score(v: NDArray[np.float64]) -> float:
            if self.progress is not None:
                self.progress(*stage_share(self.settings, name, objective.evaluations / budget))
            return objective(v)

        s = self.settings
        return maximise(
            score, algorithm, low=low, high=high, start=start, evaluations=budget, tolerance=s.tolerance_px, step=step,
            inner=s.local_algorithm, seed=s.seed,
        )  # fmt: skip

    def judge(self, name: str) -> tuple[tuple[str, ...], dict[str, float]]:
        """Refuses what chance could have made; returns warnings and standard deviations."""
        best = self.best
        parts = self._parts(self.settings.sharpness)
        if self.space.sized:
            self._check(best, parts, name)
        v = self.space.to_vector(best)
        covariance, warnings = scatter(parts, v)
        return self._at_bounds(best) + warnings, self.space.deviations(v, covariance)

    def _check(self, best: dict[str, float], parts: Objective, name: str) -> None:
        # by variance, whatever the cost: the paper's J may like an image without motion best
        plain = parts if self.settings.sharpness is Sharpness.VARIANCE else self._parts(Sharpness.VARIANCE)
        points = (best, {**best, "phase": best["phase"] + math.pi}, {**best, self.space.size_name: 0.0})
        sharp, turned, still = (plain.each(values) for values in points)
        checks.check_texture(sharp, turned, still, name)
        checks.check_directions(self.image(), name)

    def image(self) -> NDArray[np.float32]:
        """The IWE at the answer, of the sensor's size, all polarities."""
        image = self.fine.image(self.best).sum(axis=0)
        pad = (image.shape[1] - self.space.camera.width) // 2
        return np.asarray(image[pad:-pad, pad:-pad])

    def _at_bounds(self, best: dict[str, float]) -> tuple[str, ...]:
        s = self.space
        stuck = [
            n for n in s.names if n != "phase" and min(best[n] - s.low[n], s.high[n] - best[n]) * s.pixels[n] < 0.05
        ]
        return tuple(f"{n} = {best[n]:.6g} {UNITS[n]} lies on its bound; widen it" for n in stuck)


def distinct_optima(stage: SearchStage, most: int, apart: float = 6.0) -> list[NDArray[np.float64]]:
    """The best points of a stage that lie at least ``apart`` px from each better one."""
    chosen: list[NDArray[np.float64]] = []
    for k in np.argsort(-stage.scores, kind="stable"):
        if all(np.linalg.norm(stage.points[k] - other) >= apart for other in chosen):
            chosen.append(stage.points[k])
            if len(chosen) == most:
                break
    return chosen


def scatter(parts: Objective, v: NDArray[np.float64]) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Covariance of the optimum [px²]: the cost's curvature, and the scatter of its slope over parts of the events.

    H⁻¹ cov(g) H⁻¹, the sandwich estimate, g being a part's slope at the whole's optimum and H the mean curvature of
    the parts; the whole has as many times the events. A direction without curvature is named in a warning.
    """
    slopes, hessian = differences(lambda shift: parts.each(parts.space.to_values(v + shift)), np.eye(len(v)))
    gradients = slopes.T
    values, vectors = np.linalg.eigh(-hessian)
    largest = max(float(values.max()), 1e-12)
    weak = values < 1e-3 * largest
    inverse = vectors @ np.diag(1.0 / np.maximum(values, 1e-3 * largest)) @ vectors.T
    names = parts.space.names
    warnings = tuple(
        f"the events hardly determine {names[int(np.argmax(np.abs(vectors[:, k])))]} (curvature "
        f"{values[k] / largest:.1e} of the best determined)"
        for k in np.flatnonzero(weak)
    )
    return inverse @ np.atleast_2d(np.cov(gradients.T)) @ inverse / len(gradients), warnings
