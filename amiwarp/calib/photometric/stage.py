"""Photometric stage: the parameters for which one brightness map of the scene explains the events.

Sharpness is biased by the sensor's hysteresis. This stage models the hysteresis by its equations, see
:mod:`amiwarp.brightness.solver`. For given parameters the map is the solution of a linear least-squares problem. The
parameters minimise its robust residual. :func:`refine` collects the equations, searches for the answer, corrects the
sensor's timing and then the given camera and prism, where the events contradict them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.solver import BrightnessMap, SensorTiming, Tiles, darkness, off_excess, set_lags
from amiwarp.calib.nlopt_solver import SearchStage, maximise
from amiwarp.calib.parameters import LINEAR_UNKNOWNS, MOTION, ParameterSpace, like_size, units
from amiwarp.calib.photometric import causes, consistency
from amiwarp.calib.photometric.cost import (
    FAST_PATH_TERMS,
    GRID,
    PATH_TERMS,
    Cost,
    TilePaths,
    cauchy_costs,
    check_pairs,
    collect_pairs,
    determined,
    fine_map_is_determined,
    iterate,
    size_and_phase_directions,
)
from amiwarp.calib.result import PhotometricSummary, StageSummary
from amiwarp.calib.settings import GAUSS_NEWTON, PhotometricSettings
from amiwarp.calib.sharpness_search import LEAST_INSIDE_PX, Search
from amiwarp.events.recording import Recording
from amiwarp.optics.camera import LENS, Camera
from amiwarp.optics.models import MODELS
from amiwarp.optics.prism import as_wedge

Vector = NDArray[np.float64]


def refine(recording: Recording, search: Search) -> tuple[PhotometricSummary, StageSummary, ParameterSpace]:
    """Run the photometric stage, which starts at the result of the sharpness stage ``search``.

    Return the result, the summary of the search, and the space of the result, whose camera and prism are corrected.
    Raises :class:`AmiwarpError` for too few pairs.
    """
    given = search.settings.photometric.sensor
    found = Equations(recording, search, given)
    answer = found.answers.search(found.start)
    if search.fast:
        return found.finished(found.with_fast_paths(answer))
    if found.answers.cost.space.moving:
        answer = found.with_paths(answer)
    if answer.result.cost > min(LARGEST_STILL_COST, search.most_cost):
        if answer.result.cost > search.most_cost and not answer.result.accepted:
            return found.finished(answer)
        if parts := moving_parts(found.answers.cost):
            return found.finished(replace(answer, result=replace(answer.result, moving=parts)).judged(*MOVING))
    rpm, sensor, time_constant, slow_px = search.calibration_events.encoder.rpm, given, 0.0, 0.0
    rad_per_us, direction, delay = abs(rpm) * math.tau / 60e6, math.copysign(1.0, rpm), list[str]()
    examined = can_be_examined(answer, found.answers.cost) and bool(rpm)
    missing = missing_step(found.answers.cost) if examined else 0.0
    if examined and not search.angles_hold:
        judged, delay = without_angle_error(found.answers, answer, direction * rad_per_us)
        if judged is not answer:
            return found.finished(judged)
    if examined:
        v = answer.stage.x
        pause, lag = timing_steps(found.answers.cost, v, direction)
        if pause and not given.refractory_us:
            turn = find_refractory(found.coarse(), v, pause, direction)
            sensor = replace(given, refractory_us=turn / rad_per_us)
            found = Equations(recording, search, sensor)
            answer = found.answers.search(found.start)
            _, lag = timing_steps(found.answers.cost, answer.stage.x, direction)
        if lag:
            fast = answer.stage.x
            answer, turn = found.with_slow_pixels(answer, lag, direction)
            time_constant = turn / rad_per_us
            space = found.answers.cost.space
            slow_px = consistency.distance(*(space.build(space.to_values(at)) for at in (fast, answer.stage.x)))
        if len(v) == len(answer.stage.x):
            found.answers.timing = answer.stage.x - v
    kind, blind_px = MODELS[found.answers.cost.space.model], 0.0
    if not kind.PRISM and (examined or kind.ANGLES > 1):  # it moves so fast that pixels miss events
        found.answers.cost.converge(answer.stage.x)
        if recording.encoder is None:
            answer = answer.judged(*judge_speed(consistency.change_of_speed_px(found.answers.cost, answer.stage.x)))
        doubt = consistency.by_refractory(found.answers.cost, answer.stage.x)
        found.answers.doubt = direction * rad_per_us * refractory_doubt_us(sensor) * doubt
        blind_rad = rad_per_us * (sensor.refractory_us or REFRACTORY_DOUBT_US)
        blind_px = fastest_px_per_rad(found.answers.cost.space, answer.stage.x) * blind_rad
        answer = answer.judged(*judge_blindness(blind_px))
    answers = found.answers
    answer = checked(answers, answer).judged(*judge_lag(time_constant * rad_per_us, slow_px))
    doubt_px = answers.doubt_px(answer.stage.x)
    answer = answer.judged(doubt_px <= LARGEST_DOUBT_PX, doubt_in_words(doubt_px, sensor))
    answer = answer.judged(*judge_losses(missing)) if examined else answer
    if examined and search.angles_hold and answer.result.accepted:
        answer, delay = without_angle_error(answers, answer, direction * rad_per_us)
    notes = (
        *timing_notes(sensor.refractory_us - given.refractory_us, time_constant, slow_px),
        *loss_notes(found.silent_share, missing), *delay, *answer.result.warnings,
        *([doubt_in_words(doubt_px, sensor)] if doubt_px >= NOTABLE_DOUBT_PX else []),
        *([blindness_in_words(blind_px)] if blind_px >= NOTABLE_BLIND_PX else []),
    )  # fmt: skip
    timed = replace(answer.result, warnings=notes, refractory_us=sensor.refractory_us, time_constant_us=time_constant)
    return found.finished(replace(answer, result=timed))


# Equations of the stage.

LARGEST_FINE_COST = 0.3
"""Largest cost, relative to that without a map, for which a map has more than one node per pixel along each axis. Where
half of the events are noise, a finer map follows them, and orbits come out too small."""


LEAST_SILENCE = 0.05
"""Share of the time without events from which on it is reported: the turns are not whole."""


class Equations:
    """Equations of the stage: pairs of events, a map, and the search on it."""

    def __init__(self, recording: Recording, search: Search, sensor: SensorTiming) -> None:
        """Collect the pairs and solve a first map. Raises :class:`AmiwarpError` for too few pairs."""
        self.search, self._settings = search, replace(search.settings.photometric, sensor=sensor)
        self.pairs, tiles, self.silent_share = collect_pairs(recording, search, self._settings)
        best, full = search.best, search.full_space
        self._linear = tuple(n for n in search.settings.free or () if n in LINEAR_UNKNOWNS)
        # the count of OFF and ON events gives the ratio of thresholds only if brightness returns after a whole turn
        duration_us = recording.events.t_last - recording.events.t_first
        whole_turn = abs(search.calibration_events.encoder.rpm) * duration_us >= 60e6
        whole_turn &= self.silent_share < LEAST_SILENCE
        self._off_excess = off_excess(self.pairs, with_leak="leak" in self._linear) if whole_turn else 0.0
        space = full.holding({n: x for n, x in best.items() if n not in full.names})
        v = space.to_vector({**space.start, **best})
        cost = self.cost_on(tiles, space)
        cost.warm_up(v)
        mean, coverage = cost.start_mean(), cost.brightness.coverage(cost.scale)
        few = not fine_map_is_determined(coverage, len(self.pairs))
        noisy = mean() > LARGEST_FINE_COST
        # a fine map converges too slowly for parameters that make nearly the same motion
        if tiles.density > 1.0 and (few or noisy or like_size(space.names)):
            cost = self.cost_on(tiles.at_density(1.0), space)
            cost.warm_up(v)
            coverage = cost.brightness.coverage(cost.scale)
        self.cost = cost
        """Cost on the first map, at the result of the sharpness stage."""
        self._left = check_pairs(recording.name, coverage, len(self.pairs))
        self.rotation: dict[str, float] = {}
        """Standard deviations of the camera's rotation, if it was found before the paths of the tiles."""
        self.held: tuple[str, ...] = ()
        """Free parameters that the events do not determine, known from :attr:`answers` on."""

    @cached_property
    def answers(self) -> AnswerSearch:
        """Search for the free parameters that the events determine.

        The others stay at the answer of sharpness, because the first were found together with them.
        """
        cost, best = self.cost, self.search.best
        keep = determined(cost.slopes(self.start, with_parts=True), cost.space, self._left)
        self.held = tuple(n for n in cost.space.names if n not in keep)
        cost.space = cost.space.without(self.held).holding({n: x for n, x in best.items() if n in self.held})
        if self.held:
            cost.warm_up(self.start)
        return AnswerSearch(cost, dict(best), self._left, self._settings, self._report, self.search.most_cost)

    @property
    def start(self) -> Vector:
        """Search vector of the sharpness stage's result."""
        space = self.cost.space
        return space.to_vector({**space.start, **self.search.best})

    def _report(self, share: float) -> None:
        self.search.report("photometric", share)

    def cost_on(self, tiles: Tiles, space: ParameterSpace) -> Cost:
        """Return a cost with a new map on tiles, which must be solved yet."""
        brightness = BrightnessMap(
            self.pairs, tiles, off_excess=None if "off_ratio" in self._linear else self._off_excess,
            with_leak="leak" in self._linear, middle_us=space.middle_us,
        )  # fmt: skip
        return Cost(space, brightness, self._settings.steps, self.search.meanwhile)

    def _solved_on(self, tiles: Tiles) -> Cost:
        """Return a cost with a new map on tiles, solved at the sharpness stage's result."""
        space = self.answers.cost.space
        cost = self.cost_on(tiles, space)
        cost.warm_up(space.to_vector({**space.start, **self.search.best}))
        return cost

    def use_density(self, density: float) -> None:
        """Go on with a map of another density, which starts from the present one."""
        present = self.cost
        self.cost = self.cost_on(present.brightness.tiles.at_density(density), present.space)
        self.cost.scale = present.scale
        self.cost.brightness.start_from(present.brightness)

    def coarse(self) -> AnswerSearch:
        """Return the search on a new map with one node per pixel."""
        tiles = self.answers.cost.brightness.tiles
        return replace(self.answers, cost=self._solved_on(tiles.at_density(1.0)))

    def finished(self, answer: Answer) -> tuple[PhotometricSummary, StageSummary, ParameterSpace]:
        """Return the result of the stage with ``answer``, the summary of the search, and the space of the result."""
        space, answers = self.answers.cost.space, self.answers
        result = replace(answer.result, sharpness_parameters=answers.sharpest, pairs=len(self.pairs), held=self.held)
        summary = StageSummary.of("photometric", answer.stage, space.names, map(space.to_values, answer.stage.points))
        result = replace(result, uncertainty={**self.rotation, **result.uncertainty})
        return result, summary, replace(space, names=(*space.names, *self.rotation))

    def with_fast_paths(self, answer: Answer) -> Answer:
        """Return the answer for tiles whose scenes move on their own paths while a camera in fast motion moves too."""
        return self.answers.search(self._free_paths(answer, FAST_PATH_TERMS))

    def _free_paths(self, answer: Answer, terms: int) -> Vector:
        """Let the scenes of tiles move on paths with ``terms`` powers of time, and hold the camera's motion.

        Return the search vector of ``answer`` in the new space. The map is solved there.
        """
        cost = self.answers.cost
        names, values = tuple(n for n in cost.space.names if n in MOTION), cost.space.to_values(answer.stage.x)
        self.rotation = {n: answer.result.uncertainty[n] for n in names}
        cost.space = cost.space.without(names).holding({n: values[n] for n in names})
        cost.paths = TilePaths(cost.brightness, terms)
        v = cost.space.to_vector(values)
        cost.residuals(v, rounds=2)
        return v

    def with_paths(self, answer: Answer) -> Answer:
        """Return the answer for tiles whose scenes move on their own paths, if these explain much of the residual.

        The camera's rotation stays as it was found; the paths add what it lacks: a rotation that varies faster, and
        parallax. Tiles that are not explained then, such as those of a moving object, are left out.
        """
        answers, cost, turning = self.answers, self.answers.cost, self.answers.cost.space
        if not {*turning.names} - {*MOTION} or len(cost.brightness.tiles.origin) == 1:
            return answer
        v = self._free_paths(answer, PATH_TERMS)
        cost.slopes(v)
        assert cost.paths is not None
        if cost.paths.gain() <= LARGEST_ROTATION_GAIN:
            cost.space, cost.paths, self.rotation = turning, None, {}
            cost.converge(answer.stage.x)
            return answer
        v = answers.descend(v).x
        cost.residuals(v, rounds=2)
        costs = cost.paths.costs(cost.scale)
        keep = costs <= max(LARGEST_STILL_COST, LARGEST_OF_LEAST * float(costs[costs > 0.0].min()))
        if not keep[costs > 0.0].all():
            self.pairs = self.pairs.of_tiles(keep)
            answers.cost = self.cost_on(cost.brightness.tiles, cost.space)
            answers.cost.paths = paths = TilePaths(answers.cost.brightness, PATH_TERMS)
            paths.set(cost.paths.moved_px)
            answers.cost.warm_up(v)
        return answers.search(v)

    def with_slow_pixels(self, answer: Answer, first: float, direction: float) -> tuple[Answer, float]:
        """Return the answer for pixels with slow photoreceptors, and the angle per time constant [rad].

        ``first`` is a first estimate of that angle. The search has a new map then. The angle is 0 if no lag is found;
        the answer remains.
        """
        answers, v = self.answers, answer.stage.x
        self.pairs.clear_lags()
        turns, turn = find_time_constants(self.coarse(), v, first, direction)
        if not turn:
            self.pairs.drop_lags()
            return answer, 0.0
        answers.cost = cost = self._solved_on(answers.cost.brightness.tiles)
        stage = answers.descend(v)
        # this map tells better than the coarse one how the output of the filters differs from the brightness
        model = cost.space.build(cost.space.to_values(stage.x))
        set_lags(cost.brightness, model, direction * turns, math.atan(direction * turn), with_offsets=True)
        cost.residuals(stage.x)
        again = answers.search(stage.x)
        return replace(again, stage=join_runs(join_runs(answer.stage, stage), again.stage)), turn


# Search for the answer of the photometric stage on one brightness map, from the result of the sharpness stage.

LARGEST_ROTATION_MOVE_PX = 4.0
"""Largest distance from the sharpness optimum that is searched in the parameters of the camera's rotation [px]."""
RESTARTS = 3
"""Largest number of further searches, each from a point near the previous result that has a lower cost."""
FIRST_STEP_PX = 0.2
"""First step of an NLopt algorithm's first run [px]."""
POLISH_STEP_PX = 0.05
"""First step of an NLopt algorithm's second run, which starts at the result of the first run [px]."""


@dataclass(frozen=True)
class Answer:
    """Result of a search, with the evidence for it."""

    stage: SearchStage
    """The search that found it."""
    result: PhotometricSummary
    """The result, and whether it is accepted."""
    covariance: Vector
    """Covariance of the search vector from the scatter between places [px²], shape (n, n)."""

    def judged(self, accepted: bool, reason: str) -> Answer:
        """Return the answer, rejected for ``reason`` unless it is ``accepted`` or was rejected before."""
        if accepted or not self.result.accepted:
            return self
        return replace(self, result=replace(self.result, accepted=False, verdict=reason))


@dataclass
class AnswerSearch:
    """Searches on one brightness map, from the result of the sharpness stage."""

    cost: Cost
    sharpest: dict[str, float]
    """Parameter values that the sharpness stage found, in their units."""
    left: float
    """Share of equations of :func:`check_pairs`."""
    settings: PhotometricSettings
    report: Callable[[float], None]
    most_cost: float = math.inf
    """Cost above which an answer is of no use."""
    timing: Vector = field(default_factory=lambda: np.zeros(0))
    """Change of the first answer by a correction of the sensor's timing [px]; empty for none."""
    doubt: Vector = field(default_factory=lambda: np.zeros(0))
    """Change of the answer by the doubt about the refractory period [px]; empty if it does not count."""

    def doubt_px(self, v: Vector) -> float:
        """Return how far the model at ``v`` moves by :attr:`doubt`, constant lag removed [px rms]."""
        space = self.cost.space
        if not len(self.doubt):
            return 0.0
        doubt = np.zeros(len(v))
        doubt[: len(self.doubt)] = self.doubt
        return consistency.distance(*(space.build(space.to_values(at)) for at in (v + doubt, v)))

    @property
    def origin(self) -> Vector:
        """Search vector of the sharpness stage's result [px]."""
        space = self.cost.space
        return space.to_vector({**space.start, **self.sharpest})

    def search(self, start: Vector) -> Answer:
        """Search from ``start``, and again from any point near the new result with a lower cost.

        If there are few events, the map can adapt to wrong parameters so well that no single step lowers the cost. An
        answer that would be refused anyway is not searched for again.
        """
        return self.judged(self.descend(start))

    def judged(self, stage: SearchStage) -> Answer:
        """Return the answer of a search, or of those that follow it."""
        cost = self.cost
        answer, around = _evaluate(cost, stage, self.origin, self.left)
        few = cost.brightness.count < FEW_PAIRS
        for _ in range(RESTARTS):
            lower = [point for point, rise in around if rise < 0.0]
            most = LARGEST_EXAMINED_COST if stage.ended != "budget" else 0.0
            if not lower or is_far(answer.result.moved_px) or (answer.result.cost > most and not few):
                break
            cost.renew(lower[0])
            stage = join_runs(stage, self.descend(lower[0]))
            answer, around = _evaluate(cost, stage, self.origin, self.left)
        return answer

    def descend(self, start: Vector) -> SearchStage:
        """Run one search from ``start``, in the box about the sharpness stage's result."""
        cost, settings = self.cost, self.settings
        low, high = search_box(cost.space, self.origin)

        def report_steps(done: int, budget: int) -> None:
            self.report(done / budget)

        def score(at: Vector) -> float:
            report_steps(cost.evaluations, 2 * settings.evaluations)
            return cost(at)

        if settings.algorithm == GAUSS_NEWTON:
            # A GPU computes slopes while the host waits for the score. A CPU would do so in vain if the score is low.
            # After a low score, the map on a GPU converges from the derivatives there, to the same solution.
            return iterate(
                cost.start_settled, cost.start_slopes, start, low=low, high=high, tolerance=settings.tolerance_px,
                report=report_steps, early=not cost.brightness.device.is_cpu, least=-self.most_cost,
                walls=search_walls(cost.space, low, high),
            )  # fmt: skip

        def run(at: Vector, step: float) -> SearchStage:
            return maximise(
                score, settings.algorithm, low=low, high=high, start=at, evaluations=settings.evaluations,
                tolerance=settings.tolerance_px, step=step,
            )  # fmt: skip

        stage = run(start, FIRST_STEP_PX)
        # during long steps the map is not fully converged, so a second run starts nearby with a better map
        cost.steps *= 2
        return join_runs(stage, run(stage.x, POLISH_STEP_PX))


def join_runs(first: SearchStage, second: SearchStage) -> SearchStage:
    """Return two successive runs with the same free parameters as one.

    The result is that of the second run, whose brightness map was better converged.
    """
    return replace(
        second,
        evaluations=first.evaluations + second.evaluations,
        seconds=first.seconds + second.seconds,
        points=np.concatenate([first.points, second.points]),
        scores=np.concatenate([first.scores, second.scores]),
    )


def _evaluate(
    cost: Cost,
    stage: SearchStage,
    v: Vector,
    left: float,
) -> tuple[Answer, list[tuple[Vector, float]]]:
    """Evaluate the optimum of ``stage``: final map, covariance and acceptance.

    ``v`` is the answer of the sharpness stage, ``left`` the share of equations of :func:`check_pairs`. Return the
    answer, and points near the optimum with their rise in cost, the lowest first.
    """
    space, best = cost.space, stage.x
    cost.predict(best)
    cost.residuals(best, rounds=2)
    # everything is started before the first result is waited for
    waiting_final, residuals = cost.start_mean(), cost.brightness.residuals
    waiting_residual = residuals.start_median(residuals.count)
    waiting_slopes = cost.start_slopes(best, with_parts=True)
    solved, paths = cost.brightness.copy_unknowns(), cost.paths
    moved_px = np.zeros(0) if paths is None else paths.moved_px
    waiting_around = start_costs_around(cost, best, waiting_final)
    # the map is better converged now than at the start of the search, so the cost at the start is measured again
    cost.predict(v)
    cost.residuals(v)
    waiting_at_start = cost.start_mean()
    cost.replace_map(solved)
    if paths is not None:
        paths.set(moved_px)
    cost.residuals(best, rounds=0)
    slopes, final, around = waiting_slopes(), waiting_final(), waiting_around()
    covariance = slopes.covariance() / left**2
    unsharp = like_size(space.names)
    of_sharpness = np.array([n not in unsharp for n in space.names])
    of_prism = np.array([n not in (*unsharp, *MOTION) for n in space.names])
    leak, excess = (float(x) for x in cost.brightness.extra)
    rise = around[0][1] if around else math.inf
    next_step = float(np.linalg.norm(slopes.step()[of_prism]))
    moved = float(np.linalg.norm((best - v)[of_prism]))
    accepted, verdict = judge_optimum(final, rise=rise, moved=moved, next_step=next_step)
    found = PhotometricSummary(
        accepted=accepted,
        verdict=verdict,
        parameters=space.to_values(best),
        uncertainty=space.deviations(best, covariance),
        sharpness_parameters={},
        moved_px=float(np.linalg.norm((best - v)[of_sharpness])),
        cost=final,
        cost_at_sharpness=waiting_at_start(),
        residual=waiting_residual(),
        pairs=0,
        off_over_on=1.0 + excess,
        leak=leak,
    )
    return Answer(stage, found, covariance), around


def search_box(space: ParameterSpace, v: Vector) -> tuple[Vector, Vector]:
    """Return the corners of the box about the sharpness stage's result ``v`` in which this stage searches."""

    unsharp = like_size(space.names)

    def largest_move(name: str) -> float:
        if name in unsharp:
            return math.inf
        return LARGEST_ROTATION_MOVE_PX if name in MOTION else LARGEST_MOVE_PX

    most = np.array([largest_move(n) for n in space.names])
    low, high = space.bounds()
    return np.clip(low, v - most, v + most), np.clip(high, v - most, v + most)


def search_walls(space: ParameterSpace, low: Vector, high: Vector) -> tuple[Vector, Vector]:
    """Return those bounds of the search box ``low .. high`` on which an answer is refused [px]; infinite for others."""
    given_low, given_high = space.bounds()
    lens = np.array([name in LENS for name in space.names])
    return np.where(lens | (low > given_low), low, -np.inf), np.where(lens | (high < given_high), high, np.inf)


# Acceptance of the photometric stage's optimum.
#
# Each limit was set by failures that it prevents; ``docs/explanation/stability.md`` describes them.

LARGEST_MOVE_PX = 1.5
"""Largest accepted distance between the optima of the photometric and the sharpness stage, in the prism's parameters
[px]."""
PERTURBATION_PX, LEAST_COST_RISE = 0.3, 0.01
"""Reject the photometric optimum if changing the prism's orbit by ``PERTURBATION_PX`` [px] raises the cost by less than
``LEAST_COST_RISE``.

Without such a rise there is no distinct optimum, or a brightness map of few events fits any orbit. The cost is relative
to that without a brightness map.
"""
RISE_SHARE, SMALLEST_RISE = 0.1, 0.003
"""A rise below ``LEAST_COST_RISE`` suffices if it is this share of the cost, and at least ``SMALLEST_RISE``.

Few edges leave a small cost, and small rises. In recordings that determined the orbit the share was 0.11 to 0.25, in
those that did not, 0.02 at most.
"""
LARGEST_NEXT_STEP_PX = 0.06
"""Largest Gauss-Newton step that may remain when the search ends [px]. The step is about 0.01 px if the search
converged."""
LARGEST_COST = 0.75
"""Largest accepted cost, relative to the cost without a brightness map. Above it the map explains too little of the
events."""

LARGEST_EXAMINED_COST = 0.5
"""Largest cost, relative to that without a map, of an answer that is examined for causes of an error."""
LARGEST_STILL_COST = 0.2
"""Largest cost of the photometric stage, relative to that without a brightness map, that a still camera and a correct
encoder scale leave."""
LARGEST_ROTATION_GAIN = 0.05
"""Largest share of the squared residuals that a camera rotation may explain before it is freed. Cameras that turned at
0.1 to 1 deg/s left 0.1 to 0.5; still ones 0.007 at most, whatever the noise."""
LARGEST_OF_LEAST = 2.0
"""A tile whose scene moves on its own path is left out if its cost is over this multiple of the least cost of a tile,
and over :data:`LARGEST_STILL_COST`."""
LARGEST_COST_RATIO = 0.75
"""Ratio of the new to the previous cost up to which another explanation is accepted if the previous cost was high: a
camera rotation, a corrected encoder scale, or a corrected lens."""
LARGEST_INCONSISTENCY_PX = 0.1
"""Largest accepted error that the check of the answer's consistency leaves [px]."""


NOTABLE_BLIND_PX, LARGEST_BLIND_PX = 0.4, 0.47
"""Motion of the image by a vibration or a mirror within the refractory period from which on it is reported, and refused
[px]. With 0.48 px errors were at most 0.025 px, with 0.51 px 0.028 px, and with 0.6 px 0.047 px."""
NOTABLE_STATED_PX, LARGEST_STATED_PX = 0.025, 0.03
"""Error of a vibration or a mirror that the answer's covariance states from which on it is reported, and refused [px
rms]. In 60 simulations of 640×480 px, every answer with an error over 0.02 px stated at least 0.03 px, except two that
are refused for their speed and one for the doubt about the refractory period."""
MOST_TURNS = 12
"""Turns of the first of two angles in which the largest speed is looked for."""
LARGEST_CHANGE_OF_SPEED_PX = 0.01
"""Largest accepted change of a vibration's frequency over a recording, as motion of events by a linearised fit, which
finds a share of it [px rms]."""


def is_far(moved: float) -> bool:
    """Return whether an answer lies so far from that of the sharpness stage that it is refused [px]."""
    return moved > 0.95 * LARGEST_MOVE_PX


LARGEST_LAG_RAD = 0.35
"""Largest angle by which the prism may turn within the time constant of slow photoreceptors [rad]. At 0.2 an error of
0.02 px remains, at 0.4 one of 0.14 px."""
LARGEST_SLOW_PX = 0.2
"""Largest correction for slow photoreceptors [px rms]. About a tenth of it remains: up to 0.06 px in weak and fine
texture, where the correction is 0.3 to 0.4 px."""


def judge_lag(turn: float, moved_px: float) -> tuple[bool, str]:
    """Return whether to accept an answer for slow pixels, and the reason.

    The prism turns by the angle ``turn`` [rad] within their time constant, and their correction moved the model by
    ``moved_px``.
    """
    remedy = "use more light, a larger bandwidth or a slower prism"
    if turn > LARGEST_LAG_RAD:
        angle = math.degrees(turn)
        return (
            False,
            f"the pixels are too slow: the prism turns by {angle:.0f} deg within their time constant; {remedy}",
        )
    if moved_px > LARGEST_SLOW_PX:
        return False, (
            f"the pixels are too slow for this texture: they change the size of the orbit by {moved_px:.2f} px rms, "
            f"and the correction leaves about a tenth of that; {remedy}, or show a scene with stronger edges"
        )
    return True, ""


def judge_consistency(error_px: float, cause: str) -> tuple[bool, str]:
    """Return whether to accept an answer that differs over the image and over time by ``error_px``, and the reason.

    ``cause`` is the likeliest cause, in words.
    """
    if error_px <= LARGEST_INCONSISTENCY_PX:
        return True, ""
    return False, f"the answer differs by {error_px:.2f} px between parts of the image or of the recording: {cause}"


def judge_lens(given: ParameterSpace, space: ParameterSpace, answer: Answer) -> tuple[bool, str]:
    """Return whether to accept an answer whose lens was corrected, and the reason: not if the correction is too large.

    ``given`` is the space before the correction.
    """
    low, high = space.bounds()
    inside = np.minimum(answer.stage.x - low, high - answer.stage.x).tolist()
    lens = {n: x for n, x in zip(space.names, inside, strict=True) if n in LENS and n not in given.names}
    unfinished = answer.stage.ended == "budget" and not answer.result.accepted
    if not lens or not (unfinished or min(lens.values()) < LEAST_INSIDE_PX or is_far(answer.result.moved_px)):
        return True, ""
    values = ", ".join(f"{name} = {answer.result.parameters[name]:.4g}" for name in lens)
    return False, (
        f"the given lens is wrong by more than can be corrected (the search ended at {values}): give its true field of "
        "view or focal length, and its distortion; a fisheye lens is no pinhole"
    )


def judge_speed(moved_px: float) -> tuple[bool, str]:
    """Return whether to accept an answer at a constant speed, whose change moves events by ``moved_px``; the reason."""
    if moved_px <= LARGEST_CHANGE_OF_SPEED_PX:
        return True, ""
    return False, (
        f"the frequency of the vibration changes, which moves events by {moved_px:.2f} px or more; record while it is "
        "steady, or a shorter time"
    )


def judge_blindness(moved_px: float) -> tuple[bool, str]:
    """Return whether to accept an answer if the image moves by ``moved_px`` while a pixel is blind, and the reason."""
    if moved_px <= LARGEST_BLIND_PX:
        return True, ""
    return False, f"{blindness_in_words(moved_px)}; over {LARGEST_BLIND_PX:g} px are refused"


def blindness_in_words(moved_px: float) -> str:
    """Return how far the image moves while a pixel is blind [px]."""
    return (
        f"the image moves by up to {moved_px:.2f} px within the sensor's refractory period, so that events are lost: "
        "let the image move less, or more slowly"
    )


def stated_in_words(px: float) -> str:
    """Return how well the events determine a motion [px rms]."""
    return (
        f"the events determine the motion of the image within {px:.2g} px only: give the sensor's refractory period "
        "by --refractory-us if it is not given, show a scene with more texture, or record for longer"
    )


def fastest_px_per_rad(space: ParameterSpace, v: Vector) -> float:
    """Return the largest motion of the image's middle per angle, the first of two, at a search vector [px/rad]."""
    camera, steps = space.camera, 96
    middle = np.array([[0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]])
    turns = MOST_TURNS if MODELS[space.model].ANGLES > 1 else 1
    theta = np.linspace(0.0, math.tau * turns, steps * turns + 1)
    path = space.build(space.to_values(v)).compensate_points(np.repeat(middle, len(theta), axis=0), theta)
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).max()) * steps / math.tau


def judge_shake(amplitude_px: float) -> tuple[bool, str]:
    """Return that an answer is rejected whose camera shakes with the prism, and the reason."""
    return False, (
        f"the camera shakes with the prism, by {amplitude_px:.2f} px or more, which looks like a weaker or stronger "
        "prism; mount the camera apart from the motor, or balance the prism; a given refractive index that is wrong by "
        "0.1 or more looks alike"
    )


def judge_optimum(cost: float, *, rise: float, moved: float, next_step: float) -> tuple[bool, str]:
    """Return whether to accept an optimum of the photometric stage, and the reason.

    Parameters
    ----------
    cost : float
        Remaining cost, relative to that without a map.
    rise : float
        Smallest rise of the cost for an orbit that is :data:`PERTURBATION_PX` larger, smaller or rotated either way.
    moved : float
        Distance from the answer of the sharpness stage [px].
    next_step : float
        Length of the next Gauss-Newton step [px].

    Returns
    -------
    accepted : bool
        Whether to accept the optimum.
    reason : str
        The reason.
    """
    if cost > LARGEST_COST:
        return False, (
            f"no brightness map of the scene explains the events ({min(100 * cost, 100):.0f} % of the residual "
            "remains): the scene or the camera moved, light flickered, or the encoder or the lens is wrong"
        )
    if is_far(moved):
        return False, (
            f"the optimum is over {LARGEST_MOVE_PX:g} px away from that of sharpness: the lens or the encoder is "
            "wrong, or the scene or the camera moved"
        )
    if next_step > LARGEST_NEXT_STEP_PX:
        size = f"{next_step:.2f} px" if next_step <= LARGEST_MOVE_PX else f"over {LARGEST_MOVE_PX:g} px"
        return False, (
            f"the search did not converge: its next step would be {size}, but no step lowers the cost: too few events, "
            "or many lost"
        )
    if rise < min(LEAST_COST_RISE, max(SMALLEST_RISE, RISE_SHARE * cost)):
        well = f"as well ({100 * rise:.1f} % of the residual more)" if rise > 0.0 else "better"
        return False, (
            f"an orbit that is {PERTURBATION_PX:g} px larger, smaller or rotated explains the events {well}: "
            "too few events, too little contrast, or the scene or the camera moved"
        )
    return True, f"one brightness map explains the events ({100 * cost:.0f} % of the residual remains)"


# Check that the photometric stage's result is a minimum: slightly larger, smaller or rotated orbits must cost more.

FEW_PAIRS = 50_000
"""Number of pairs of events below which a new brightness map is solved for each tested point."""


def start_costs_around(
    cost: Cost, best: Vector, final: Callable[[], float]
) -> Callable[[], list[tuple[Vector, float]]]:
    """Start to compute the costs at points :data:`PERTURBATION_PX` from ``best`` in size and phase.

    Return a function that waits, and returns the points with their rise in cost, lowest first. ``final`` waits for the
    cost at ``best`` with the present map. A map of few pairs is biased to the point where it was fitted, and all other
    points would cost more. Then a new map is solved for each point, ``best`` included.
    """
    few = cost.brightness.count < FEW_PAIRS
    points = [
        best + side * along
        for along in size_and_phase_directions(cost.space, best)
        for side in (PERTURBATION_PX, -PERTURBATION_PX)
    ]
    costs = []
    for point in [best, *points] if few else points:
        if few:
            cost.renew(point)
            cost.residuals(point, rounds=2)
        else:
            cost.predict(point)
            cost.residuals(point, rounds=2, steps=cost.steps // 2)
        costs.append(cost.start_mean())
    reference = costs.pop(0) if few else final

    def result() -> list[tuple[Vector, float]]:
        here = reference()
        rises = [there() - here for there in costs]
        return sorted(zip(points, rises, strict=True), key=lambda found: found[1])

    return result


# Events that the sensor or its link lost.

SAMPLED_PAIRS = 1 << 15
"""Number of pairs whose residuals tell whether events are missing."""
NOTABLE_STEP, LARGEST_STEP = 0.12, 0.2
"""Median change of brightness beyond one threshold between the two events of a pair from which on lost events are
reported, and from which on the answer is rejected [thresholds].

It is 0.03 for a sensor that loses nothing, 0.07 for one that loses a fifth of its events, 0.2 for a third, 0.3 for half
of them; then the answer is off by 0.06 px. Slow pixels leave 0.1.
"""


def missing_step(cost: Cost) -> float:
    """Return the median change of brightness beyond one threshold between the events of a pair [thresholds].

    Between two events of a pixel the brightness changes by one threshold, or by more if events between them were lost.
    """
    pairs, residuals = cost.brightness.pairs, cost.brightness.residuals.values
    every = max(1, len(pairs) // SAMPLED_PAIRS)
    change = residuals[: len(pairs) : every].numpy()
    on = pairs.arrays.on[: len(pairs) : every].numpy() & 1
    beyond = np.where(on, change, -change)[np.isfinite(change)]
    return float(np.median(beyond)) if len(beyond) else 0.0


def judge_losses(step: float) -> tuple[bool, str]:
    """Return whether to accept an answer from events with this :func:`missing_step`, and the reason."""
    if step < LARGEST_STEP:
        return True, ""
    return False, (
        "a third or more of the events are missing, so that brightness changes by more than one threshold between two "
        "events of a pixel: lower the event rate (thresholds, region of interest, slower prism), or record without a "
        "filter that drops events"
    )


def loss_notes(silent_share: float, step: float) -> list[str]:
    """Return a sentence for each kind of loss of events that was found."""
    notes = []
    if silent_share >= LEAST_SILENCE:
        notes.append(
            f"no events came in {100.0 * silent_share:.0f} % of the time: the sensor or its link lost them; lower the "
            "event rate"
        )
    if NOTABLE_STEP <= step < LARGEST_STEP:
        notes.append("a fifth or more of the events are missing: lower the event rate, or record without a filter")
    return notes


# Parts of the image in which something moves.

LEAST_PARTS = 0.2
"""Smallest share of the pairs that the still parts of the image must hold, and that the moving parts must hold, before
something is said to move. One part of the 4 x 3 grid holds less."""
MOVING = False, "something moves in a part of the view"
"""Judgement of an answer if one part of the view is still and another one moves."""


def moving_parts(cost: Cost) -> tuple[tuple[bool, ...], ...]:
    """Return for each part of the image, row by row, whether the scene is not still there; empty if there are no such.

    A map explains the events of a still part as well as those of a still scene, and hardly any of a moving one. If the
    camera turns, all parts move.
    """
    pairs, (columns, rows), camera = cost.brightness.pairs, GRID, cost.space.camera
    if cost.space.moving:
        return ()
    some = slice(None, len(pairs), max(1, len(pairs) // SAMPLED_PAIRS))
    costs = cauchy_costs(cost.brightness.residuals.values[some].numpy(), cost.scale)
    x, y = pairs.arrays.x[some].numpy().astype(int), pairs.arrays.y[some].numpy().astype(int)
    part = y * rows // camera.height * columns + x * columns // camera.width
    number = np.bincount(part, minlength=rows * columns)
    mean = np.bincount(part, costs, rows * columns) / np.maximum(number, 1)
    still, moving = ((mean < LARGEST_STILL_COST) & (number > 0), mean > LARGEST_EXAMINED_COST)
    if min(number[still].sum(), number[moving].sum()) < LEAST_PARTS * number.sum():
        return ()
    return tuple(tuple(row) for row in (~still).reshape(rows, columns).tolist())


# Errors of the prism's angle: harmonics of the encoder's angle, which repeat every turn, and delays of the read-out.

MOST_ANGLE_FITS = 6
"""Largest number of linearised fits of the errors of the angle."""
FIRST_SHARE, LEAST_SHARE = 0.5, 0.25
"""Share of the error that the first linearised fit is taken to find, and the least share of a later one."""
LEAST_ANGLE_PX = 0.003
"""Length of a correction of the angle below which the search ends [px rms]."""
NOTABLE_SKEW_PX, LARGEST_SKEW_PX = 0.02, 0.04
"""Errors by pixels that are read one after another, from which on they are reported and refused [px rms]. Compensation
does not correct them."""


def without_angle_error(search: AnswerSearch, answer: Answer, rad_per_us: float) -> tuple[Answer, list[str]]:
    """Return the answer, rejected if its angles have an error, and a sentence about a small delay of the read-out.

    ``rad_per_us`` is the speed of the prism. The result holds an error that repeats every turn, so that it can be
    corrected.
    """
    space, v = search.cost.space, answer.stage.x
    error = find_angle_error(search, v)
    if error is None:
        return answer, []
    px, late_us = skew_px(space.camera, error, consistency.px_per_rad(space, v)), -error[4:] / rad_per_us
    if not error[:4].any() and px < LARGEST_SKEW_PX:
        return answer, [skew_in_words(late_us, px)] if px >= NOTABLE_SKEW_PX else []
    harmonics = tuple(error[:4].tolist()) if error[:4].any() else ()
    answer = replace(answer, result=replace(answer.result, harmonics=harmonics))
    return answer.judged(False, angle_error_in_words(error, px, late_us)), []


def find_angle_error(search: AnswerSearch, v: Vector) -> Vector | None:
    """Return the correction of the prism's angle that the events ask for; None for none.

    It is the factors of :data:`consistency.PATTERNS`, shape (6,). A linearised fit finds a share of the error only,
    because the map absorbs the other part; the next fit tells how large the share was. The pairs keep the corrected
    angles, because an answer with an error ends the stage, unless the error is but a small delay of the read-out.
    """
    cost, camera = search.cost, search.cost.space.camera
    cost.converge(v)
    found = consistency.fit_angles(cost, v)
    if found is None or found.moved_px < consistency.LEAST_MOVE_PX:
        return None
    pairs = cost.brightness.pairs
    waves = pairs.angle_patterns((0.5 * camera.width, 0.5 * camera.height)).numpy().reshape(6, 2, -1)
    angle, azimuth = np.arctan2(waves[1], waves[0]), pairs.arrays.azimuth
    given, total, share, at = wp.clone(azimuth), np.zeros(6), FIRST_SHARE, v
    for _ in range(MOST_ANGLE_FITS):
        step = found.change / share
        total += step
        bent = angle + np.tensordot(total, waves, 1)
        azimuth.assign(np.stack([np.cos(bent), np.sin(bent)], axis=1).astype(np.float32).ravel())
        cost.renew(at)
        at = search.descend(at).x
        if found.moved_px / share < LEAST_ANGLE_PX:
            break
        cost.converge(at)
        before, found = found, consistency.fit_angles(cost, at, found.names)
        assert found is not None
        share = float(np.clip((before.change - found.change) @ step / (step @ step), LEAST_SHARE, 1.0))
    if not total[:4].any() and skew_px(camera, total, consistency.px_per_rad(cost.space, v)) < LARGEST_SKEW_PX:
        azimuth.assign(given)
        cost.renew(v)
    return total


def skew_px(camera: Camera, error: Vector, px_per_rad: float) -> float:
    """Return how far the delay of the read-out in an ``error`` of the angle moves events [px rms]."""
    return px_per_rad * consistency.rms_angle(camera, np.append(np.zeros(4), error[4:]))


def skew_in_words(late_us: Vector, px: float) -> str:
    """Return that events come late from column to column and from row to row [us], an error of ``px``."""
    x, y = late_us.tolist()
    return (
        f"the sensor reads its pixels one after another: events come late by {x:.2g} us more from column to column "
        f"and {y:.2g} us from row to row, an error of {px:.2f} px; subtract {x:.3g} * x + {y:.3g} * y from "
        "the events' times [us]"
    )


def angle_error_in_words(error: Vector, skew_px: float, late_us: Vector) -> str:
    """Return why an answer with an ``error`` of the angles is refused; see :func:`skew_in_words`."""
    if skew_px >= LARGEST_SKEW_PX:
        return skew_in_words(late_us, skew_px)
    return f"{harmonics_in_words(error[:4])}, and its correction was not confirmed: check how it is mounted"


def harmonics_in_words(harmonics: Sequence[float] | Vector) -> str:
    """Return the error of an encoder in words: its amplitude, and whether it repeats once or twice a turn."""
    sizes = [math.degrees(math.hypot(*harmonics[:2])), math.degrees(math.hypot(*harmonics[2:]))]
    often = ("once a turn", "twice a turn")
    named = [f"{x:.2g} deg {how}" for x, how in zip(sizes, often, strict=True) if x >= 0.2 * max(sizes)]
    return f"the encoder's angle is wrong by {' and '.join(named)}"


# Timing of the sensor that was not given: its refractory period, and the time constant of slow photoreceptors.
#
# Both shift the angles of the prism at which events tell the brightness. A linearised fit tells whether one of them
# explains much of the residual; then it is searched for. All angles are those by which the prism turns within a time.

LEAST_REFRACTORY_GAIN = 0.015
"""Smallest share of the squared residuals that a refractory period must explain. Eight photographs without one explain
0.014 at most, or more with the wrong sign; 1.7 ms explain 0.017, and 3 ms 0.023 and more."""
LEAST_SLOW_GAIN = 0.03
"""Smallest share that slow photoreceptors must explain. Seven of eight photographs without them explain 0.005 at most,
but a smaller lag does less harm than its correction, whose light is estimated."""
REFRACTORY_DOUBT_US = 100.0
"""Standard deviation of the refractory period of a sensor whose period is not given [us], for a vibrating camera: its
image moves too fast for the events to tell the period."""
KNOWN_SHARE = 0.3
"""Standard deviation of a period that is given, as a share of it: it stands for the jitter of the time stamps too."""
NOTABLE_DOUBT_PX, LARGEST_DOUBT_PX = 0.008, 0.015
"""Change of an answer by the doubt about this period from which on it is reported, and refused [px rms]."""
LARGEST_RAD = 0.5
"""Largest angle that is searched [rad]."""
FACTOR, MOST_TRIALS = 1.7, 7
"""Ratio between angles that are tried, and their largest number."""
PARABOLAS = 2
"""Number of parabolas that are laid through the lowest costs."""
LIGHT_STEP = 0.5
"""Step of the logarithm of a tile's light. In photographs it has a standard deviation of about 0.6 between tiles."""
LIGHT_ROUNDS = 2
"""How many times the light of the tiles is found, and after it the mean time constant."""


def can_be_examined(answer: Answer, cost: Cost) -> bool:
    """Return whether the angles of the events can be examined: for a still camera, if a map explains most events."""
    space = cost.space
    drifts = cost.brightness.pairs.arrays.slope.shape[0]
    one = MODELS[space.model].ANGLES == 1
    return one and space.sized and not space.moving and not drifts and answer.result.cost <= LARGEST_EXAMINED_COST


def timing_steps(cost: Cost, v: Vector, direction: float) -> tuple[float, float]:
    """Return the angles per refractory period and per time constant at median brightness [rad].

    A linearised fit at the answer ``v`` estimates each of them. An angle that is not significant is 0.
    """
    cost.converge(v)
    relative, _ = darkness(cost.brightness, cost.space.build(cost.space.to_values(v)))
    columns = consistency.slopes(cost, cost.space, v, cost.space.names)
    # the refractory period sets the reference of a pair, its first event, later
    columns["refractory"], columns["slow"] = cost.by_angle(v)[0], consistency.shifted(cost, v, relative)
    fit = consistency.linear_fit(cost, columns)

    def angle(name: str, sign: float) -> tuple[float, float, float]:
        estimate, significance, gain = fit.adding(cost.space.names, (name,))
        change = sign * float(estimate.change[-1])
        return change, math.copysign(significance, change), gain

    pause, pause_significance, pause_gain = angle("refractory", direction)
    lag, lag_significance, lag_gain = angle("slow", -direction)
    is_pause = pause_significance >= consistency.SIGNIFICANT and pause_gain >= LEAST_REFRACTORY_GAIN
    # where the lags are long and the light of the tiles differs, they look rather like a refractory period below 0
    is_certain = max(lag_significance, -pause_significance) >= consistency.SIGNIFICANT
    is_lag = lag > 0.0 and is_certain and lag_gain >= LEAST_SLOW_GAIN
    return pause if is_pause else 0.0, lag if is_lag else 0.0


def find_refractory(search: AnswerSearch, v: Vector, first: float, direction: float) -> float:
    """Return the angle by which the prism turns in the refractory period, for which the cost is lowest [rad].

    The parameters are those of :func:`find_time_constants`; the pairs remain unchanged.
    """
    cost = search.cost
    azimuth = cost.brightness.pairs.arrays.azimuth
    given = azimuth.numpy().copy()

    def cost_at(angle: float) -> float:
        """Return the cost if the references are ``angle`` later."""
        turned = given.reshape(4, -1).copy()
        z = (turned[0] + 1j * turned[1]) * np.exp(1j * direction * angle)
        turned[0], turned[1] = z.real, z.imag
        azimuth.assign(turned.ravel())
        cost.renew(v)
        at = search.descend(v).x
        cost.residuals(at, rounds=2, steps=2 * cost.steps)
        return cost.mean()

    best = _lowest(cost_at, *_bracketed(cost_at, [FACTOR * first, FACTOR**2 * first]))
    azimuth.assign(given)
    return best


def find_time_constants(search: AnswerSearch, v: Vector, first: float, direction: float) -> tuple[Vector, float]:
    """Return the angle per time constant at median brightness in each tile, and their mean, for the lowest cost [rad].

    Events come late in the dark, but their steps of brightness do not tell how dark a tile is compared with another. So
    each tile has a time constant of its own: the costs of the tiles at three values tell those of all tiles at once.

    Parameters
    ----------
    search : AnswerSearch
        Search on a map with one node per pixel, on which costs depend smoothly on the angle. The lags of its pairs are
        set to those of the result.
    v : numpy.ndarray
        Search vector of the answer without lags, shape (n,).
    first : float
        Estimate of a linearised fit [rad], a fifth to an eighth of the angle, because the map absorbs the rest.
    direction : float
        Direction of rotation of the prism: 1 or -1.

    Returns
    -------
    turns : numpy.ndarray
        The angles, shape (tiles,); 0 if no lag lowers the cost, or if the lag contracts the orbit by less than the
        smallest deviation of an answer.
    mean : float
        Their geometric mean over all pairs.
    """
    cost, space = search.cost, search.cost.space
    tile, tiles = cost.brightness.pairs.column("tile"), len(cost.brightness.tiles.origin)
    count = np.bincount(tile, minlength=tiles)
    px_per_rad = consistency.px_per_rad(space, v) or math.inf
    relative, at = np.ones(tiles), v
    answers: dict[float, Vector] = {}

    def is_negligible(turn: float) -> bool:
        return (1.0 - math.cos(math.atan(turn))) * px_per_rad < consistency.LEAST_STD_PX

    def renew() -> None:
        cost.brightness.pairs.clear_lags()
        cost.renew(at)
        cost.residuals(at, rounds=2)

    def lag(turn: float, longer: float, *, with_offsets: bool) -> None:
        turns, ahead = direction * turn * math.exp(longer) * relative, math.atan(direction * turn)
        set_lags(cost.brightness, space.build(space.to_values(at)), turns, ahead, with_offsets=with_offsets)

    def cost_at(turn: float) -> float:
        """Return the cost with the lags of an angle."""
        nonlocal at
        at = v
        renew()
        for with_offsets in (False, True) if turn else ():
            lag(turn, 0.0, with_offsets=with_offsets)
            at = search.descend(at).x
        cost.residuals(at, rounds=2, steps=2 * cost.steps)
        answers[turn] = at
        return cost.mean()

    def costs_of_tiles(turn: float, longer: float) -> Vector:
        """Return the mean cost of each tile with longer time constants, at the answer for an angle."""
        renew()
        for with_offsets in (False, True):
            lag(turn, longer, with_offsets=with_offsets)
            cost.residuals(at, rounds=2, steps=2 * cost.steps)
        each = cauchy_costs(cost.brightness.residuals.values.numpy()[: len(tile)], cost.scale)
        return np.bincount(tile, each, tiles) / np.maximum(count, 1)

    angles, costs = _bracketed(cost_at, [FACTOR**3 * first, FACTOR**4 * first])
    if is_negligible(angles[int(np.argmin(costs))]):
        return np.zeros(tiles), 0.0
    for _ in range(LIGHT_ROUNDS if tiles > 1 else 0):
        turn = angles[int(np.argmin(costs))]
        at = answers[turn]
        below, here, above = (costs_of_tiles(turn, k * LIGHT_STEP) for k in (-1.0, 0.0, 1.0))
        curved = below + above > 2.0 * here
        change = 0.5 * (below - above) / np.where(curved, below + above - 2.0 * here, 1.0)
        change = np.where(curved, change, np.sign(below - above)).clip(-1.0, 1.0) * LIGHT_STEP
        relative = relative * np.exp(change - np.average(change, weights=count))
        angles, costs = _bracketed(cost_at, [turn, FACTOR * turn])
    turn = _lowest(cost_at, angles, costs)
    turn = 0.0 if is_negligible(turn) else turn
    return turn * relative, turn


def _bracketed(cost_at: Callable[[float], float], angles: list[float]) -> tuple[list[float], list[float]]:
    """Return angles in geometric progression about the one of the lowest cost, and their costs, from two of them on."""
    costs = [cost_at(angle) for angle in angles]
    while len(angles) < MOST_TRIALS and costs[-1] < costs[-2] and FACTOR * angles[-1] <= LARGEST_RAD:
        angles = [*angles, FACTOR * angles[-1]]
        costs.append(cost_at(angles[-1]))
    while len(angles) < MOST_TRIALS and costs[0] <= costs[1]:
        angles = [angles[0] / FACTOR, *angles]
        costs.insert(0, cost_at(angles[0]))
    return angles, costs


def _lowest(cost_at: Callable[[float], float], angles: list[float], costs: list[float]) -> float:
    """Return the angle of the lowest cost, evaluated last; 0 if no angle costs less than 0.

    Parabolas find it, between angles of :func:`_bracketed`.
    """
    for _ in range(PARABOLAS):
        k = int(np.argmin(costs))
        if not 0 < k < len(angles) - 1:
            break
        curve = np.polyfit(np.log(angles[k - 1 : k + 2]), costs[k - 1 : k + 2], 2)
        angle = float(np.exp(-0.5 * curve[1] / curve[0]))
        at = k if angle < angles[k] else k + 1
        angles.insert(at, angle)
        costs.insert(at, cost_at(angle))
    best = angles[int(np.argmin(costs))]
    none = cost_at(0.0)
    return best if cost_at(best) < none else 0.0


def refractory_doubt_us(sensor: SensorTiming) -> float:
    """Return the standard deviation of a sensor's refractory period [us]."""
    return KNOWN_SHARE * sensor.refractory_us if sensor.refractory_us else REFRACTORY_DOUBT_US


def doubt_in_words(px: float, sensor: SensorTiming) -> str:
    """Return by how much the doubt about the refractory period changes an answer [px]."""
    known = sensor.refractory_us
    given = f"given as {known:.0f} us" if known else "which is not given"
    remedy = "let the image move less" if known else "give it by --refractory-us"
    return (
        f"the image moves fast for the sensor: an error of {refractory_doubt_us(sensor):.0f} us in its refractory "
        f"period, {given}, changes the answer by {px:.2f} px; {remedy}"
    )


def timing_notes(refractory_us: float, time_constant_us: float, slow_px: float) -> list[str]:
    """Return a sentence for each time that was found [us]; 0 for none.

    The correction for slow pixels moved the model by ``slow_px``.
    """
    notes = []
    if refractory_us:
        notes.append(
            f"the events show that pixels pause after an event (refractory period): {refractory_us:.0f} us of it fit "
            "best and were corrected; give the true one by --refractory-us"
        )
    if time_constant_us:
        notes.append(
            f"the pixels are slow: about {time_constant_us:.0f} us at the median brightness, more in the dark. The "
            f"size of the orbit was corrected, by {slow_px:.2f} px rms, of which about a tenth may remain. The lag is "
            "part of the phase, which holds at this speed of the prism only"
        )
    return notes


# Correction of the given camera and prism where the events contradict them, and the last judgement of the answer.

MOST_CORRECTIONS = 4
"""Largest number of corrections, and of searches that continue an unfinished one."""
RIVAL_SHARE = 0.75
"""A cause is tried if it removes at least this share of the residual that the likeliest one removes."""
TIE_SHARE = 0.04
"""Of the tried causes, the first one counts whose cost is at most this share of the gain above the lowest cost."""
GIVEN_SHARE = 0.15
"""The same share for what was given, the camera and the flat side: it is likelier wrong than the prism's shape, whose
two free numbers follow the noise too."""
TIMING_SHARE = 0.3
"""Systematic standard deviation of the answer if the sensor's timing was corrected: a share of the correction. The
thresholds, which turn the map's brightness into light, are not known."""
RIVAL_STD = 0.5
"""Systematic standard deviation of an answer with a rival explanation: a share of the difference of their answers."""
LEAST_RIVAL_PX = 0.02
"""Distance of the models of two explanations from which on both are reported [px rms]."""
LARGEST_RIVAL_PX = 0.06
"""The same from which on the answer is refused. A wobble of 2 degrees and cylinder power are 0.05 px apart."""
CONTRADICTING = 3.0
"""Number of standard deviations from which on a correction is said to contradict what was given."""
SAME_COST = 1.05
"""Largest ratio of the costs of two answers that count as equal. Two maps of the same scene differ by less."""
LARGEST_LAST_STEP_PX = 0.01
"""Longest step that is added to the answer without a new search [px]."""


@dataclass(frozen=True)
class _Corrected:
    """Answer after the correction of a cause."""

    cause: causes.Cause
    answer: Answer
    cost: float
    """Cost with a new map, which compares with that of other answers."""
    space: ParameterSpace
    sharpest: dict[str, float]
    """Result of the sharpness stage, expressed in ``space``."""
    rivals: tuple[_Corrected, ...] = ()
    """Other corrections that explain the events as well."""

    def distance_px(self, other: _Corrected) -> float:
        """Return how far the models of two corrections are apart [px rms]."""
        a, b = (each.space.build(each.space.to_values(each.answer.stage.x)) for each in (self, other))
        return consistency.distance(a, b)


def checked(search: AnswerSearch, answer: Answer) -> Answer:
    """Return the answer after corrections of the given camera and prism, judged by its consistency.

    A correction is kept if it lowers the cost. The search's space is the corrected one then. The answer's uncertainty
    includes its systematic part.
    """
    if answer.result.cost > LARGEST_EXAMINED_COST or not search.cost.space.sized:
        return answer
    given, cost = search.cost.space, search.cost
    first = answer, search.sharpest
    tied: list[tuple[_Corrected, _Corrected]] = []
    for left in range(MOST_CORRECTIONS, -1, -1):
        cost.converge(answer.stage.x)
        check = consistency.check_consistency(cost, answer.stage.x)
        if check.shake_px:
            return answer.judged(*judge_shake(check.shake_px))
        best = _best_correction(search, answer, check) if left else None
        if best is not None:
            cost.space, search.sharpest, answer = best.space, best.sharpest, best.answer
            tied += [(best, rival) for rival in best.rivals]
            accepted, reason = judge_lens(given, cost.space, answer)
            if not accepted:
                return replace(answer, result=replace(answer.result, accepted=False, verdict=reason))
        elif left and cost.space is not given and np.linalg.norm(check.step) > LARGEST_LAST_STEP_PX:
            again = search.search(answer.stage.x + check.step)
            if again.result.cost > SAME_COST * answer.result.cost:
                cost.converge(answer.stage.x)
                break
            answer = replace(again, stage=join_runs(answer.stage, again.stage))
        else:
            break
    unexplained = answer.result.cost > max(LARGEST_STILL_COST, LARGEST_COST_RATIO * first[0].result.cost)
    if unexplained and cost.space is not given:  # another trouble, such as a rotating camera, which is tried later
        cost.space, (answer, search.sharpest), tied = given, first, []
        cost.converge(answer.stage.x)
        check = consistency.check_consistency(cost, answer.stage.x)
    freed = set(search.cost.space.names)
    # an explanation that was corrected later too is no rival: the answer is their joint one
    rivals = [(best, rival, best.distance_px(rival)) for best, rival in tied if not freed >= {*rival.cause.names}]
    n = len(given.names)
    apart = [
        rival.answer.stage.x[:n] - best.answer.stage.x[:n]
        for best, rival, _ in rivals
        if as_wedge(best.space.prism).flat_side is as_wedge(rival.space.prism).flat_side
    ]
    answer = _final(search, answer, check, apart)
    notes = [rival_in_words(best, rival, px) for best, rival, px in rivals if px >= LEAST_RIVAL_PX]
    for best, rival, px in rivals:
        answer = answer.judged(px <= LARGEST_RIVAL_PX, rival_in_words(best, rival, px))
    notes = [*_corrections(given, search.cost.space, answer), *notes, *check.warnings()]
    return replace(answer, result=replace(answer.result, warnings=(*notes, *answer.result.warnings)))


def rival_in_words(best: _Corrected, rival: _Corrected, px: float) -> str:
    """Return that two explanations, ``px`` apart, explain the events equally well, and what to do."""
    frees = [",".join(n for n in each.cause.names if n != causes.FLAT_SIDE) for each in (best, rival)]
    remedy = " or ".join(f"--free apex,phase,{names}" for names in frees if names)
    return (
        f"the events do not tell whether {best.cause.words} or {rival.cause.words} is wrong: both explain them as "
        f"well, and differ by {px:.2f} px rms; choose the right one ({remedy})"
    )


def _best_correction(search: AnswerSearch, answer: Answer, check: consistency.Consistency) -> _Corrected | None:
    """Return the best answer with a likely cause corrected, and its rivals; None if none lowers the cost."""
    likely = [f for f in check.findings if f.gain >= RIVAL_SHARE * check.findings[0].gain]
    if not likely:
        return None
    v = answer.stage.x
    here = _comparable_cost(search, v)
    found: list[_Corrected] = []
    for finding in likely:
        # a cause that cannot come near the cost of another one on the same map is given up
        least = min((t.answer.result.cost for t in found), default=math.inf)
        each = _corrected(search, finding, v, least + GIVEN_SHARE * max(0.0, answer.result.cost - least))
        found += [each] if each is not None else []
    tried = [t for t in found if _significant(t) and t.cost < here]
    if not tried:
        return None

    def near_best(among: list[_Corrected], share: float) -> float:
        least = min(t.cost for t in among)
        return least + share * (here - least)

    given = [t for t in tried if t.cause not in causes.SHAPES]
    if given and min(t.cost for t in given) <= near_best(tried, GIVEN_SHARE):
        tried = given
    best, *rivals = sorted((t for t in tried if t.cost <= near_best(tried, TIE_SHARE)), key=lambda t: t.cause.rank)
    return replace(best, rivals=tuple(rivals))


def _corrected(search: AnswerSearch, finding: consistency.Finding, v: Vector, most_cost: float) -> _Corrected | None:
    """Return the answer with a cause corrected, or None if it costs far more than ``most_cost``. The space stays."""
    cost, space, sharpest, cause = search.cost, search.cost.space, search.sharpest, finding.cause
    cost.space, _ = causes.with_cause(space, cause, space.to_values(v))
    if cause == causes.SIDE:
        search.sharpest = causes.turned(space, sharpest)
    stage, found = replace(search, most_cost=most_cost).descend(finding.start), None
    if -stage.score <= SAME_COST * most_cost:
        answer = search.judged(stage)
        found = _Corrected(cause, answer, _comparable_cost(search, answer.stage.x), cost.space, search.sharpest)
    cost.space, search.sharpest = space, sharpest
    return found


def _significant(found: _Corrected) -> bool:
    """Return whether a corrected parameter differs significantly from the given one. A turned prism always does."""
    result, start = found.answer.result, found.space.start
    names = [n for n in found.cause.names if n != causes.FLAT_SIDE]
    return not names or any(
        abs(result.parameters[n] - start[n]) >= consistency.SIGNIFICANT * result.uncertainty[n] for n in names
    )


def _comparable_cost(search: AnswerSearch, v: Vector) -> float:
    """Return the cost at ``v`` with a new map: a map that was improved for longer has another cost."""
    cost = search.cost
    present = cost.brightness.copy_unknowns()
    cost.renew(v)
    cost.residuals(v, rounds=2, steps=2 * cost.steps)
    mean = cost.mean()
    cost.replace_map(present)
    return mean


def _final(search: AnswerSearch, answer: Answer, check: consistency.Consistency, apart: Sequence[Vector]) -> Answer:
    """Return the answer with the last step added, its whole uncertainty and the judgement of its consistency.

    ``apart`` holds the difference to the answer of each rival explanation [px].
    """
    result, v, space = answer.result, answer.stage.x, search.cost.space
    timing = np.zeros(len(v))
    timing[: len(search.timing)] = TIMING_SHARE * search.timing
    doubt = np.zeros(len(v))
    doubt[: len(search.doubt)] = search.doubt
    systematic = check.systematic + np.outer(check.step, check.step) + np.outer(timing, timing) + np.outer(doubt, doubt)
    for change in apart:
        systematic[: len(change), : len(change)] += RIVAL_STD**2 * np.outer(change, change)
    if np.linalg.norm(check.step) <= LARGEST_LAST_STEP_PX:
        v = v + check.step
    covariance, kind = answer.covariance + systematic, MODELS[space.model]
    # an answer with a free speed is found again at that speed
    stated_px = 0.0 if kind.PRISM or "rpm" in space.names else consistency.stated_px(space, v, covariance)
    result = replace(
        result, parameters=space.to_values(v), uncertainty=space.deviations(v, covariance),
        rotation_gain=check.rotation_gain, center_px=check.center_px,
        warnings=(*result.warnings, *([stated_in_words(stated_px)] if stated_px >= NOTABLE_STATED_PX else [])),
    )  # fmt: skip
    answer = replace(answer, result=result).judged(*judge_consistency(check.inconsistent_px(), check.likeliest()))
    return answer.judged(stated_px <= LARGEST_STATED_PX, stated_in_words(stated_px))


def _corrections(given: ParameterSpace, space: ParameterSpace, answer: Answer) -> list[str]:
    """Return a sentence for each correction of the given camera and prism."""
    found, std = answer.result.parameters, answer.result.uncertainty
    out = []
    side, given_side = as_wedge(space.prism).flat_side, as_wedge(given.prism).flat_side
    if side is not given_side:
        out.append(
            f"the events show that the flat face of the prism points to the {side.value}, not to the "
            f"{given_side.value}: the calibration uses this side"
        )
    for name in space.names:
        if name not in given.names:
            scale, unit = 1.0, "" if name in ("k1", "fy_over_fx", "index") else " px"
            if units().get(name) == "rad":
                scale, unit = math.degrees(1.0), " deg"
            was, now, by = (scale * x for x in (space.start[name], found[name], std[name]))
            remedy = "; calibrate the lens" if name in LENS else "; give that of the glass" if name == "index" else ""
            if abs(now - was) >= CONTRADICTING * by:
                said = f"the events contradict {name} = {was:.5g}{unit}: it was corrected to"
            else:  # the other one of two, or what a later correction explains
                said = f"{name} = {was:.5g}{unit} was fitted too, and is"
            out.append(f"{said} {now:.5g} ± {by:.2g}{unit}{remedy}")
    return out
