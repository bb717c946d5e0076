"""Sharpness stage of the calibration: contrast maximisation."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib import checks
from amiwarp.calib.calibration_events import CalibrationEvents
from amiwarp.calib.held_out_turns import PARTS
from amiwarp.calib.nlopt_solver import maximise
from amiwarp.calib.phase_search import (
    BANDS,
    PhaseObjective,
    check_distinct,
    check_found_in_phase,
    check_suited,
    search_in_phase,
    tiles_of,
)
from amiwarp.calib.phase_tiles import FINEST, PhaseTiles
from amiwarp.calib.settings import AUTO, PHASE, SEARCH_IF_UNCLEAR, Settings, stage_share
from amiwarp.calib.sharpness_objective import Objective, finite_differences, padding
from amiwarp.choices import SearchCost, Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.registry import MODELS
from amiwarp.results.calibration import StageSummary
from amiwarp.results.parameters import (
    MOTION,
    ParameterSpace,
    globally_searched,
    kept_by_global_search,
    like_size,
    of_orbit,
    optical_parameters,
    phase_names,
    units,
)
from amiwarp.results.search_stage import SearchStage
from amiwarp.tasks import Progress

Vector = NDArray[np.float64]


LEAST_INSIDE_PX = 0.05
"""Distance of a parameter from its bounds below which it lies on them [px]."""
FIRST_STEP_PX = 0.7
"""First step of the local search, as displacement of events [px]."""
CANDIDATES = 3
"""Largest number of optima of the coarse image from which the local search starts."""


@dataclass(frozen=True)
class Sharpest:
    """Answer of a search."""

    values: dict[str, float]
    """Values of all parameters."""
    score: float
    """Sharpness there; not a number if the values were given."""


@dataclass(frozen=True, eq=False)
class Search:
    """Search for the parameters that make the image of warped events sharpest.

    A search never changes: :meth:`run` returns the same search with its answer.
    """

    full_space: ParameterSpace
    """Parameter space of the photometric stage: all free parameters."""
    space: ParameterSpace
    """Parameter space of the sharpness search: without the parameters that are left to the photometric stage."""
    calibration_events: CalibrationEvents
    settings: Settings
    device: Any
    progress: Progress | None
    pad: int
    """Border of the fine image outside the sensor [px]."""
    fine: Objective
    """Sharpness of the fine image."""
    answer: Sharpest | None = None
    """The answer; None before the search."""
    stages: tuple[StageSummary, ...] = ()
    """Stages that led to the answer."""

    @classmethod
    def over(
        cls,
        full_space: ParameterSpace,
        calibration_events: CalibrationEvents,
        settings: Settings,
        device: Any,
        progress: Progress | None,
    ) -> Search:
        """Return a search without an answer, with its buffers on the device."""
        space = full_space
        if "photometric" in settings.stages:
            space = full_space.without(like_size(full_space.names))
        pad = padding(space)
        fine = _objective(
            space,
            calibration_events,
            settings,
            device,
            pad=pad,
            scale=1.0,
            smoothing=settings.smoothing_px,
        )
        return cls(full_space, space, calibration_events, settings, device, progress, pad, fine)

    @property
    def best(self) -> dict[str, float]:
        """Values of all parameters of the answer."""
        assert self.answer is not None
        return self.answer.values

    @property
    def score(self) -> float:
        """Sharpness at the answer."""
        assert self.answer is not None
        return self.answer.score

    def at(self, values: Mapping[str, float], stages: tuple[StageSummary, ...] = ()) -> Search:
        """Return the search with an answer that is known from elsewhere, and the stages that led to it."""
        return replace(self, answer=Sharpest(dict(values), math.nan), stages=stages)

    def through(self, camera: Camera) -> Search:
        """Return the search for the same events through another lens, at the same answer."""
        full_space = replace(self.full_space, camera=camera)
        again = Search.over(
            full_space, self.calibration_events, self.settings, self.device, self.progress
        )
        return replace(again, answer=self.answer, stages=self.stages)

    def _objective_by_parts(self, kind: Sharpness) -> Objective:
        """Return an objective that measures disjoint parts of the events separately."""
        smoothing = max(1.0, self.settings.smoothing_px)
        return self._objective(
            self.calibration_events, scale=1.0, smoothing=smoothing, kind=kind, parts=PARTS
        )

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
        """Return the sharpness of some events, by default in the search's own space."""
        space = space or self.space
        return _objective(
            space,
            events,
            self.settings,
            self.device,
            pad=self.pad if space is self.space else padding(space),
            scale=scale,
            smoothing=smoothing,
            kind=kind,
            parts=parts,
        )

    def run(self, start: Mapping[str, float] | None = None) -> Search:
        """Return the search with its answer, by a global and a local search.

        With ``start``, values of all parameters, only the local search runs. Its stages follow the ones that the search
        has already.
        """
        settings = self.settings
        space = self.space
        summaries = [*self.stages]
        fine: Objective | PhaseObjective = self.fine
        if settings.cost is SearchCost.PHASE:
            fine = PhaseObjective(space, self._tiles(space), FINEST)
        starts = self._global_starts(summaries) if start is None else [space.to_vector(start)]
        if space.moving:
            starts = [self._track_rotation(start_vector, summaries) for start_vector in starts]

        runs: list[SearchStage] = []
        for start_vector in starts:
            # Near an optimum that is known a search ends early.
            known = [run.x for run in runs]
            run = self._maximise(
                fine,
                settings.local_algorithm,
                start_vector,
                settings.local_evaluations,
                step=FIRST_STEP_PX,
                known=known,
                summaries=summaries,
            )
            runs.append(run)
        best = max(runs, key=lambda run: run.score)
        values = space.to_values(best.x)
        by_sharpness = settings.cost is SearchCost.SHARPNESS
        score = best.score if by_sharpness else self.fine.values(values)
        answer = Sharpest(values, score)
        return replace(self, answer=answer, stages=tuple(summaries))

    def _global_starts(self, summaries: list[StageSummary]) -> list[NDArray[np.float64]]:
        """Return the search vectors of the best optima of the coarse image; the start if it is not searched."""
        settings = self.settings
        space = self.space
        still = globally_searched(space.without(kept_by_global_search(space)))
        if settings.global_algorithm is None or not still.names:
            return [space.to_vector(space.start)]

        algorithm = settings.global_algorithm
        if algorithm in (AUTO, PHASE):
            start = self._start_in_phase(still, summaries)
            if start is not None:
                return [space.to_vector({**space.start, **start})]
            algorithm = SEARCH_IF_UNCLEAR

        found = [dict(still.start)]
        for part in self._global_parts(still):
            part_space = part(found[0])
            stage = self._maximise(
                self._global_objective(part_space),
                algorithm,
                part_space.to_vector(part_space.start),
                settings.global_evaluations,
                step=1.0,
                summaries=summaries,
            )
            found = [part_space.to_values(v) for v in distinct_optima(stage, CANDIDATES)]

        # Some models make nearly the same image at a second point.
        candidates = [{name: values[name] for name in space.names} for values in found]
        twins = [MODELS[space.model].twin_values(values) for values in candidates]
        candidates += [twin for twin in twins if twin is not None]
        return [space.to_vector(values) for values in candidates]

    def _global_parts(
        self, space: ParameterSpace
    ) -> list[Callable[[Mapping[str, float]], ParameterSpace]]:
        """Return for each step of the global search how its space follows from the values of the step before.

        The prisms of a pair are searched one after the other: each removes its part of the blur.
        """
        together = MODELS[space.model].TOGETHER
        if len(together) == 1:
            return [lambda _: space]
        return [
            partial(of_orbit, space, k)
            for k, names in enumerate(together)
            if {*names} & {*space.names}
        ]

    def _global_objective(self, space: ParameterSpace) -> Objective | PhaseObjective:
        """Return what an NLopt algorithm of the global search optimises, by the cost of the settings."""
        if self.settings.cost is SearchCost.PHASE:
            return PhaseObjective(space, self._tiles(space), BANDS[0])
        return self._coarse_objective(self.calibration_events, space)

    def _tiles(self, space: ParameterSpace) -> PhaseTiles:
        """Return the sums in phase of the events. Raises :class:`AmiwarpError` if they cannot tell the motion."""
        check_suited(self.space)
        return tiles_of(self.calibration_events, space)

    def _start_in_phase(
        self, space: ParameterSpace, summaries: list[StageSummary]
    ) -> dict[str, float] | None:
        """Return the values that sums in phase tell without a guess; None if another search must find them.

        Raises :class:`AmiwarpError` if no other search may, and they do not tell the values.
        """
        settings = self.settings
        only_this = settings.global_algorithm == PHASE or settings.cost is SearchCost.PHASE
        if not only_this and not wp.get_device(self.device).is_cpu:
            return None
        # A number of evaluations is meant for an NLopt algorithm.
        if not only_this and settings.global_evaluations != Settings.global_evaluations:
            return None
        try:
            tiles = self._tiles(space)
            check_found_in_phase(space)
            found = search_in_phase(space, tiles)
            check_distinct(found)
        except AmiwarpError:
            if only_this:
                raise
            return None
        points = [space.to_values(v) for v in found.stage.points]
        summaries.append(StageSummary.of("global", found.stage, space.names, points))
        return space.to_values(found.start)

    def _coarse_objective(self, events: CalibrationEvents, space: ParameterSpace) -> Objective:
        """Return the sharpness of a coarse image of a third of the events."""
        step = max(1, len(events.events) // (self.settings.events // 3 + 1))
        return self._objective(events.every(step), scale=0.5, smoothing=4.0, space=space)

    def _track_rotation(
        self, start: NDArray[np.float64], summaries: list[StageSummary]
    ) -> NDArray[np.float64]:
        """Improve the start values of a rotating camera by a local search on the coarse image.

        Without a prism there is no estimate of the rotation. Then the events come from windows that grow about the
        middle: in a short window the blur is smaller than the smoothing, whatever the speed.
        """
        for share in (1.0,) if self.space.sized else (0.125, 0.25, 0.5, 1.0):
            objective = self._coarse_objective(self.calibration_events.central(share), self.space)
            stage = self._maximise(
                objective,
                self.settings.local_algorithm,
                start,
                self.settings.local_evaluations,
                step=2.0,
                summaries=summaries,
            )
            start = stage.x
        return start

    def _maximise(
        self,
        objective: Objective | PhaseObjective,
        algorithm: str,
        start: NDArray[np.float64],
        budget: int,
        *,
        step: float,
        summaries: list[StageSummary],
        known: Sequence[NDArray[np.float64]] = (),
    ) -> SearchStage:
        """Run a search algorithm and append its summary to ``summaries``."""
        space = objective.space
        values = []
        low, high = space.bounds()
        name = "global" if algorithm.startswith("G") else "local"

        def score(v: NDArray[np.float64]) -> float:
            self.report(name, objective.evaluations / budget)
            values.append(space.to_values(v))
            return objective.measure(values[-1])[0]

        settings = self.settings
        stage = maximise(
            score,
            algorithm,
            low=low,
            high=high,
            start=start,
            evaluations=budget,
            tolerance=settings.tolerance_px,
            step=step,
            inner=settings.local_algorithm,
            seed=settings.seed,
            known=known,
        )
        summaries.append(StageSummary.of(name, stage, space.names, values))
        return stage

    def report(self, stage: str, share: float) -> None:
        """Tell the progress function which share of a stage is finished."""
        if self.progress is not None:
            self.progress(*stage_share(self.settings, stage, share))

    def gain_over(self, other: Search) -> float:
        """Return by how much the image is sharper than at another search's answer [standard deviations].

        Both searches have the same events, or this one has a camera's rotation, without which the other answer is
        measured here.
        """
        parts = self._objective_by_parts(Sharpness.VARIANCE)
        here = parts.of_parts(self.best)
        space = self.space
        if space.moving:
            at_rest = dict.fromkeys((name for name in MOTION if name in self.best), 0.0)
            others_best = {name: other.best[name] for name in other.space.names}
            there = parts.of_parts({**self.best, **others_best, **at_rest})
        else:
            there = other._objective_by_parts(Sharpness.VARIANCE).of_parts(other.best)
        return checks.significance(here, there)

    def check_answer(self, name: str) -> tuple[tuple[str, ...], dict[str, float]]:
        """Return warnings and standard deviations; raise :class:`AmiwarpError` if chance explains the sharpness."""
        best = self.best
        space = self.space
        camera = self.space.camera
        parts = self._objective_by_parts(self.settings.sharpness)
        if space.sized:
            # variance, whatever the measure of the search: the paper's J may prefer an image without compensation
            plain = self.settings.sharpness is Sharpness.VARIANCE
            variance = parts if plain else self._objective_by_parts(Sharpness.VARIANCE)
            kind = MODELS[space.model]
            points = (best, kind.turned_values(best, math.pi), kind.still_values(best))
            sharp, opposite, still = (variance.of_parts(values) for values in points)
            if "photometric" in self.settings.stages:
                size = space.size_name
                nearly_inside = best[size] + LEAST_INSIDE_PX / space.pixels[size]
                checks.check_size(kind, nearly_inside, space.high[size], name)
            checks.check_texture(sharp, opposite, still, name, kind.MOVER)

            # not the border outside the sensor, and as much inside, where the view ends: at most a quarter of it
            inset = self.pad + min(self.pad, min(camera.width, camera.height) // 4)
            checks.check_directions(self.fine.image(best), inset, name)
        v = space.to_vector(best)
        covariance, warnings = estimate_covariance(parts, v)
        return warnings, space.deviations(v, covariance)

    def sharpness_in(self, space: ParameterSpace, values: Mapping[str, float]) -> float:
        """Return the sharpness at ``values`` with the camera and the prism of ``space``."""
        if _same_canvas(space, self.space):
            return self.fine.values(values)
        smoothing = self.settings.smoothing_px
        fine = self._objective(self.calibration_events, scale=1.0, smoothing=smoothing, space=space)
        return fine.values(values)


def _objective(
    space: ParameterSpace,
    events: CalibrationEvents,
    settings: Settings,
    device: Any,
    *,
    pad: int,
    scale: float,
    smoothing: float,
    kind: Sharpness | None = None,
    parts: int = 1,
) -> Objective:
    """Return the sharpness of some events in a space, by the settings' measure or another ``kind``."""
    kind = kind or settings.sharpness
    if kind is Sharpness.PAPER_J:
        smoothing = 0.0  # J counts pixels with h > 0, and a Gaussian's tails would make almost all of them positive
    return Objective(
        space,
        events.on(device, space.middle_us if space.moving else None),
        kind=kind,
        smoothing=smoothing,
        pad=pad,
        scale=scale,
        per_polarity=settings.per_polarity,
        parts=parts,
        device=device,
    )


def _same_canvas(space: ParameterSpace, other: ParameterSpace) -> bool:
    """Return whether the images of two spaces are the same, so that their sharpness can be measured in one."""
    fields = ("model", "names", "camera", "prism", "moving", "start", "high")
    return all(getattr(space, name) == getattr(other, name) for name in fields)


def bound_warnings(space: ParameterSpace, values: Mapping[str, float]) -> tuple[str, ...]:
    """Return a warning for each free parameter whose value lies on one of its bounds.

    A bound beyond which there are no values is none.
    """
    unit = units()
    known = optical_parameters()
    at_bound = []
    for name in space.names:
        if name in phase_names():
            continue
        least, most = known[name].limits if name in known else (-math.inf, math.inf)
        scale = math.radians(1.0) if unit.get(name) == "rad" else 1.0
        distances = []
        if space.low[name] > scale * least:
            distances.append(values[name] - space.low[name])
        if space.high[name] < scale * most:
            distances.append(space.high[name] - values[name])
        if min(distances, default=math.inf) * space.pixels[name] < LEAST_INSIDE_PX:
            at_bound.append(name)
    shown = {n: f"{n} = {values[n]:.6g} {unit.get(n, '')}".rstrip() for n in at_bound}
    return tuple(f"{text} lies on its bound; widen the bounds of {n}" for n, text in shown.items())


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


def estimate_covariance(
    parts: Objective, v: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Return the covariance of the optimum [px²], and warnings that name the parameters of flat directions.

    The sandwich estimate H⁻¹ cov(g) H⁻¹ / n from n disjoint parts of the events: g is a part's gradient at the optimum
    of all events, and H the mean Hessian of the parts.
    """
    slopes, hessian = finite_differences(parts.of_parts, parts.space, v, np.eye(len(v)))
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
