"""Photometric stage: the parameters for which one brightness map of the scene explains the events.

Sharpness is biased by the sensor's hysteresis. This stage models the hysteresis by its equations, see
:mod:`amiwarp.brightness.solver`. For given parameters the map is the solution of a linear least-squares problem. The
parameters minimise its robust residual.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from amiwarp.brightness.event_pairs import SensorTiming, off_excess
from amiwarp.brightness.solver import BrightnessMap
from amiwarp.calib.nlopt_solver import LOCAL_ALGORITHMS, check_algorithm
from amiwarp.calib.parameters import DEGENERATE_WITH_APEX
from amiwarp.calib.photometric.acceptance import judge_lag
from amiwarp.calib.photometric.answer_search import AnswerSearch, join_runs
from amiwarp.calib.photometric.correction import checked
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.gauss_newton import GAUSS_NEWTON, determined
from amiwarp.calib.photometric.pair_collection import check_pairs, collect_pairs, fine_map_is_determined
from amiwarp.calib.photometric.sensor_timing import (
    find_refractory,
    find_time_constant,
    timing_can_be_found,
    timing_notes,
    timing_steps,
)
from amiwarp.calib.progress_share import stage_share
from amiwarp.calib.summaries import PhotometricSummary, StageSummary
from amiwarp.validation import guarded, real, whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from amiwarp.brightness.event_pairs import PairSet
    from amiwarp.brightness.tiles import Tiles
    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.photometric.answer_search import Answer
    from amiwarp.calib.photometric.events_ahead import EventsAhead
    from amiwarp.calib.sharpness.search import Search
    from amiwarp.events.recording import Recording
    from amiwarp.progress import Progress


LARGEST_FINE_COST = 0.3
"""Largest cost, relative to that without a map, for which a map has more than one node per pixel along each axis. Where
half of the events are noise, a finer map follows them, and orbits come out too small."""


@guarded
@dataclass(frozen=True)
class PhotometricSettings:
    """Settings of the photometric stage of a calibration.

    Examples
    --------
    >>> settings = amiwarp.PhotometricSettings(pairs=100_000)
    >>> settings.check()
    >>> settings.algorithm
    'gauss-newton'
    """

    pairs: int = 300_000
    """Approximate largest number of pairs of events, from whole turns spread over the recording."""
    algorithm: str = GAUSS_NEWTON
    """Algorithm: ``gauss-newton`` or one of NLopt's derivative-free local algorithms."""
    evaluations: int = 80
    """Largest number of evaluations in each of the two runs of an NLopt algorithm."""
    tolerance_px: float = 0.002
    """Length below which the search's steps end it, as displacement of events [px]."""
    steps: int = 20
    """Number of conjugate-gradient steps that solve the brightness map in each evaluation, starting from the previous
    map."""
    density: float = 2.0
    """Nodes of the brightness map per pixel along each axis. With too few pairs of events for it, there is one node per
    pixel."""
    sensor: SensorTiming = field(default_factory=SensorTiming)
    """Known latency and refractory period of the sensor. If they are unknown, the calibrated phase contains their
    effect."""

    def check(self) -> None:
        """Check the settings.

        Raises
        ------
        AmiwarpError
            If the algorithm is unknown or a number out of range.
        """
        check_algorithm(self.algorithm, (GAUSS_NEWTON, *LOCAL_ALGORITHMS))
        for name in ("pairs", "evaluations", "steps"):
            whole(getattr(self, name), f"photometric {name}", 1, 10**12)
        real(self.tolerance_px, "photometric tolerance_px", 0.0, 1e3, " px")
        real(self.density, "photometric density", 0.01, 100.0)


@dataclass(frozen=True)
class _Equations:
    """Equations of the stage: pairs of events, a map, and the search on it."""

    pairs: PairSet
    cost_on: Callable[[Tiles, ParameterSpace], Cost]
    """Function that returns a cost with a new map on tiles, solved at the sharpness stage's result."""
    answers: AnswerSearch
    start: NDArray[np.float64]
    """Search vector of the sharpness stage's result."""
    held: tuple[str, ...]
    """Free parameters that the events do not determine."""

    def coarse(self) -> AnswerSearch:
        """Return the search on a new map with one node per pixel."""
        cost = self.answers.cost
        return replace(self.answers, cost=self.cost_on(cost.brightness.tiles.at_density(1.0), cost.space))


def refine(
    recording: Recording,
    search: Search,
    linear: tuple[str, ...],
    *,
    ahead: EventsAhead | None = None,
    progress: Progress | None = None,
    meanwhile: Iterator[None] | None = None,
) -> tuple[PhotometricSummary, StageSummary, ParameterSpace]:
    """Run the photometric stage, which starts at the result of the sharpness stage.

    ``linear`` names the free ones of ``off_ratio`` and ``leak``. ``ahead``: events already on the device, of
    :func:`upload_ahead`. Some steps of ``meanwhile`` are taken while a GPU works. Return the result, the summary of the
    search, and the space of the result, whose camera and prism are corrected. Raises :class:`AmiwarpError` for too few
    pairs.
    """

    def report(share: float) -> None:
        if progress is not None:
            progress(*stage_share(search.settings, "photometric", share))

    def equations(sensor: SensorTiming) -> _Equations:
        settings = replace(search.settings.photometric, sensor=sensor)
        collected = collect_pairs(recording, search, settings, ahead)
        return _equations(recording, search, linear, settings, collected, report, meanwhile)

    given = search.settings.photometric.sensor
    found = equations(given)
    answer = found.answers.search(found.start)
    rpm, sensor, time_constant = search.calibration_events.encoder.rpm, given, 0.0
    rad_per_us, direction = abs(rpm) * math.tau / 60e6, math.copysign(1.0, rpm)
    if timing_can_be_found(answer, found.answers.cost) and rpm:
        v = answer.stage.x
        pause, lag = timing_steps(found.answers.cost, v, direction)
        if pause and not given.refractory_us:
            turn = find_refractory(found.coarse(), v, pause, direction)
            sensor = replace(given, refractory_us=turn / rad_per_us)
            found = equations(sensor)
            answer = found.answers.search(found.start)
            _, lag = timing_steps(found.answers.cost, answer.stage.x, direction)
        if lag:
            answer, turn = _with_slow_pixels(found, answer, lag, direction)
            time_constant = turn / rad_per_us
        if len(v) == len(answer.stage.x):
            found.answers.timing = answer.stage.x - v
    answers = found.answers
    answer = checked(answers, answer)
    accepted, reason = judge_lag(time_constant * rad_per_us)
    if answer.result.accepted and not accepted:
        answer = replace(answer, result=replace(answer.result, accepted=False, verdict=reason))
    notes = (*timing_notes(sensor.refractory_us - given.refractory_us, time_constant), *answer.result.warnings)
    result = replace(
        answer.result, sharpness_parameters=answers.sharpest, pairs=len(found.pairs), held=found.held, warnings=notes,
        refractory_us=sensor.refractory_us, time_constant_us=time_constant,
    )  # fmt: skip
    space = answers.cost.space
    values = map(space.to_values, answer.stage.points)
    return result, StageSummary.of("photometric", answer.stage, space.names, values), space


def _with_slow_pixels(found: _Equations, answer: Answer, first: float, direction: float) -> tuple[Answer, float]:
    """Return the answer for pixels with slow photoreceptors, and the angle per time constant [rad]; 0 if it fails.

    ``first`` is a first estimate of that angle. The search of ``found`` has a new map then.
    """
    answers, v = found.answers, answer.stage.x
    found.pairs.clear_lags()
    turn = find_time_constant(found.coarse(), v, first, direction)
    answers.cost = found.cost_on(answers.cost.brightness.tiles, answers.cost.space)
    again = answers.search(v)
    return replace(again, stage=join_runs(answer.stage, again.stage)), turn


def _equations(
    recording: Recording,
    search: Search,
    linear: tuple[str, ...],
    settings: PhotometricSettings,
    collected: tuple[PairSet, Tiles],
    report: Callable[[float], None],
    meanwhile: Iterator[None] | None,
) -> _Equations:
    """Return the equations of ``collected`` pairs. Raises :class:`AmiwarpError` for too few pairs."""
    pairs, tiles = collected
    full = search.full_space
    space = full.holding({n: x for n, x in search.best.items() if n not in full.names})
    # the count of OFF and ON events gives the ratio of thresholds only if brightness returns after a whole turn
    duration_us = recording.events.t_last - recording.events.t_first
    whole_turn = abs(search.calibration_events.encoder.rpm) * duration_us >= 60e6
    excess = off_excess(pairs, with_leak="leak" in linear) if whole_turn else 0.0

    def cost_on(tiles: Tiles, space: ParameterSpace = space) -> Cost:
        brightness = BrightnessMap(
            pairs, tiles, off_excess=None if "off_ratio" in linear else excess, with_leak="leak" in linear,
            middle_us=space.middle_us,
        )  # fmt: skip
        cost = Cost(space, brightness, settings.steps, meanwhile)
        cost.warm_up(space.to_vector({**space.start, **search.best}))
        return cost

    v = space.to_vector({**space.start, **search.best})
    cost = cost_on(tiles)
    mean, coverage = cost.start_mean(), cost.brightness.coverage(cost.scale)
    few = not fine_map_is_determined(coverage, len(pairs))
    noisy = mean() > LARGEST_FINE_COST
    # a fine map converges too slowly for parameters that make nearly the same motion
    if tiles.density > 1.0 and (few or noisy or any(n in DEGENERATE_WITH_APEX for n in space.names)):
        cost = cost_on(tiles.at_density(1.0))
        coverage = cost.brightness.coverage(cost.scale)
    left = check_pairs(recording.name, coverage, len(pairs))
    keep = determined(cost.slopes(v, with_parts=True), space, left)
    held = tuple(n for n in space.names if n not in keep)
    # undetermined parameters stay at the answer of sharpness, because the others were found together with them
    cost.space = space = space.without(held).holding({n: x for n, x in search.best.items() if n in held})
    v = space.to_vector({**space.start, **search.best})
    if held:
        cost.warm_up(v)
    return _Equations(pairs, cost_on, AnswerSearch(cost, dict(search.best), left, settings, report), v, held)
