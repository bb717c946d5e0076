"""Equations of the photometric stage: pairs of events, a first map, and the parameters that they determine."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.solver import BrightnessMap, PairSet, SensorTiming, Tiles, off_excess
from amiwarp.calib.calibration_events import EventsAhead
from amiwarp.calib.parameters import LINEAR_UNKNOWNS, ParameterSpace, like_size
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.answers import AnswerSearch
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.descent import determined
from amiwarp.calib.photometric.pairs import check_pairs, collect_pairs, fine_map_is_determined
from amiwarp.calib.settings import PhotometricSettings
from amiwarp.events.recording import Recording

if TYPE_CHECKING:
    from amiwarp.calib.sharpness_search import Search

    Vector = NDArray[np.float64]

LARGEST_FINE_COST = 0.3
"""Largest cost, relative to that without a map, for which a map has more than one node per pixel along each axis. Where
half of the events are noise, a finer map follows them, and orbits come out too small."""


@dataclass(frozen=True)
class Problem:
    """What the photometric stage is to explain, and how. It never changes."""

    recording: Recording
    sharp: Search
    """The search of the sharpness stage, at whose answer the stage starts."""
    angles_hold: bool = False
    """Whether camera and prism are corrected before an error of the prism's angles is looked for. With such an error,
    the answer is refused then."""
    fast: bool = False
    """Whether the camera is in fast motion: the stage ends with its first answer."""
    most_cost: float = math.inf
    """Cost above which an answer is of no use."""
    ahead: EventsAhead | None = None
    """Events that are on the device already."""
    meanwhile: Iterator[None] = field(default_factory=lambda: iter(()))
    """Other work, whose steps are taken where the host would wait for a GPU."""

    @property
    def settings(self) -> PhotometricSettings:
        """Settings of the stage."""
        return self.sharp.settings.photometric

    @property
    def rpm(self) -> float:
        """Mean speed of the prism [1/min]."""
        return self.sharp.calibration_events.encoder.rpm

    @property
    def rad_per_us(self) -> float:
        """Magnitude of the prism's mean speed [rad/us]."""
        return abs(self.rpm) * math.tau / 60e6

    @property
    def direction(self) -> float:
        """Direction of rotation of the prism: 1 or -1."""
        return math.copysign(1.0, self.rpm)

    def report(self, share: float) -> None:
        """Tell the progress function which share of the stage is finished."""
        self.sharp.report("photometric", share)


@dataclass(frozen=True)
class Equations:
    """Pairs of events, and the cost on the first map that explains them."""

    problem: Problem
    settings: PhotometricSettings
    """Settings of the stage, with the timing of the sensor as it is known now."""
    pairs: PairSet
    silent_share: float
    """Share of the time in which no events came."""
    off_excess: float
    """Excess of the OFF over the ON threshold, from the numbers of events."""
    cost: Cost
    """Cost on the first map, at the result of the sharpness stage."""
    left: float
    """Share of equations beyond the unknowns of the map."""

    @property
    def start(self) -> Vector:
        """Search vector of the sharpness stage's result."""
        return _start_in(self.cost.space, self.problem)

    def cost_on(self, tiles: Tiles, space: ParameterSpace) -> Cost:
        """Return a cost with a new map on tiles, which must be solved yet."""
        return _cost_on(self.problem, self.settings, self.pairs, self.off_excess, tiles, space)

    def solved_on(self, tiles: Tiles, space: ParameterSpace) -> Cost:
        """Return a cost with a new map on tiles, solved at the sharpness stage's result."""
        cost = self.cost_on(tiles, space)
        cost.warm_up(_start_in(space, self.problem))
        return cost

    def at_density(self, density: float) -> Equations:
        """Return the equations with a map of another density, which starts from the present one."""
        present = self.cost
        cost = self.cost_on(present.brightness.tiles.at_density(density), present.space)
        cost.set_scale(present.scale)
        cost.brightness.start_from(present.brightness)
        return replace(self, cost=cost)

    def search(self) -> tuple[AnswerSearch, tuple[str, ...]]:
        """Return the search for the free parameters that the events determine, and the names of the others.

        These stay at the answer of sharpness, because the first were found together with them.
        """
        best = self.problem.sharp.best
        slopes = self.cost.slopes(self.start, with_parts=True)
        keep = determined(slopes, self.cost.space, self.left)
        held = tuple(n for n in self.cost.space.names if n not in keep)
        space = self.cost.space.without(held).holding({n: x for n, x in best.items() if n in held})
        cost = self.cost.in_space(space)
        if held:
            cost.warm_up(_start_in(space, self.problem))
        problem = self.problem
        return AnswerSearch(cost, dict(best), self.left, self.settings, problem.report, problem.most_cost), held


def collect_equations(problem: Problem, sensor: SensorTiming) -> Equations:
    """Collect the pairs and solve a first map. Raises :class:`AmiwarpError` for too few pairs."""
    recording = problem.recording
    sharp = problem.sharp
    settings = replace(problem.settings, sensor=sensor)
    found = collect_pairs(recording, sharp, settings, always_tiles=problem.fast, ahead=problem.ahead)
    pairs = found.pairs
    tiles = found.tiles
    # the count of OFF and ON events gives the ratio of thresholds only if brightness returns after a whole turn
    duration_us = recording.events.t_last - recording.events.t_first
    whole_turn = abs(problem.rpm) * duration_us >= 60e6 and found.silent_share < limits.LEAST_SILENCE
    excess = off_excess(pairs, with_leak="leak" in _linear_unknowns(problem)) if whole_turn else 0.0
    full = sharp.full_space
    space = full.holding({n: x for n, x in sharp.best.items() if n not in full.names})
    start = _start_in(space, problem)
    cost = _cost_on(problem, settings, pairs, excess, tiles, space)
    cost.warm_up(start)
    mean = cost.start_mean()
    coverage = cost.brightness.coverage(cost.scale)
    few = not fine_map_is_determined(coverage, len(pairs))
    noisy = mean() > LARGEST_FINE_COST
    # a fine map converges too slowly for parameters that make nearly the same motion
    if tiles.density > 1.0 and (few or noisy or like_size(space.names)):
        cost = _cost_on(problem, settings, pairs, excess, tiles.at_density(1.0), space)
        cost.warm_up(start)
        coverage = cost.brightness.coverage(cost.scale)
    left = check_pairs(recording.name, coverage, len(pairs))
    return Equations(problem, settings, pairs, found.silent_share, excess, cost, left)


def _start_in(space: ParameterSpace, problem: Problem) -> Vector:
    """Return the search vector of the sharpness stage's result in a space."""
    return space.to_vector({**space.start, **problem.sharp.best})


def _linear_unknowns(problem: Problem) -> tuple[str, ...]:
    """Return the names of the free unknowns of the linear equations, beyond the map."""
    return tuple(n for n in problem.sharp.settings.free or () if n in LINEAR_UNKNOWNS)


def _cost_on(
    problem: Problem,
    settings: PhotometricSettings,
    pairs: PairSet,
    excess: float,
    tiles: Tiles,
    space: ParameterSpace,
) -> Cost:
    """Return a cost with a new map on tiles, which must be solved yet."""
    linear = _linear_unknowns(problem)
    brightness = BrightnessMap(
        pairs,
        tiles,
        off_excess=None if "off_ratio" in linear else excess,
        with_leak="leak" in linear,
        middle_us=space.middle_us,
    )
    return Cost.on(brightness, space, settings.steps, problem.meanwhile)
