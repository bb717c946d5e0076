"""Equations of the photometric stage: pairs of events, a first map, and the parameters that they determine."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.pairs import PairSet, off_excess
from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.brightness.solver import BrightnessMap
from amiwarp.brightness.tiles import Tiles
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.answers import AnswerSearch
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.descent import determined
from amiwarp.calib.photometric.pairs import check_pairs, collect_pairs, fine_map_is_determined
from amiwarp.calib.settings import PhotometricSettings
from amiwarp.events.recording import Recording
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.registry import MODELS
from amiwarp.results.parameters import LINEAR_UNKNOWNS, ParameterSpace, like_size

if TYPE_CHECKING:
    from amiwarp.calib.events_ahead import EventsAhead
    from amiwarp.calib.sharpness_search import Search

    Vector = NDArray[np.float64]

LARGEST_FINE_COST = 0.3
"""Largest cost, relative to the cost without a map, for which a map has more than one node per pixel along each axis.
Where half of the events are noise, a finer map follows them, and orbits come out too small."""


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
    host_work: Callable[[], None] | None = None
    """Work of the host that is done while a GPU solves the first map."""

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

    @property
    def start_values(self) -> dict[str, float]:
        """Values at which the stage starts, in their units: the result of the sharpness stage, before the latency.

        Prisms turn too slowly for a latency to matter.
        """
        best = dict(self.sharp.best)
        kind = MODELS[self.sharp.space.model]
        late_rad = self.direction * self.rad_per_us * self.settings.sensor.latency_us
        if kind.PRISM or not late_rad:
            return best
        return before_latency(kind, best, late_rad)

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
    free_share: float
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
        best = self.problem.start_values
        slopes = self.cost.slopes(self.start, with_parts=True)
        keep = determined(slopes, self.cost.space, self.free_share)
        held = tuple(n for n in self.cost.space.names if n not in keep)
        space = self.cost.space.without(held).holding({n: x for n, x in best.items() if n in held})
        cost = self.cost.in_space(space)
        if held:
            cost.warm_up(_start_in(space, self.problem))
        problem = self.problem
        return AnswerSearch(
            cost, dict(best), self.free_share, self.settings, problem.report, problem.most_cost
        ), held


def collect_equations(problem: Problem, sensor: SensorTiming) -> Equations:
    """Collect the pairs and solve a first map. Raises :class:`AmiwarpError` for too few pairs."""
    recording = problem.recording
    sharp = problem.sharp
    settings = replace(problem.settings, sensor=sensor)
    found = collect_pairs(
        recording, sharp, settings, always_tiles=problem.fast, ahead=problem.ahead
    )
    pairs = found.pairs
    tiles = found.tiles
    # the count of OFF and ON events gives the ratio of thresholds only if brightness returns after a whole turn
    duration_us = recording.events.t_last - recording.events.t_first
    whole_turn = (
        abs(problem.rpm) * duration_us >= 60e6 and found.silent_share < limits.LEAST_SILENCE
    )
    excess = off_excess(pairs, with_leak="leak" in _linear_unknowns(problem)) if whole_turn else 0.0
    full = sharp.full_space
    space = full.holding({n: x for n, x in sharp.best.items() if n not in full.names})
    start = _start_in(space, problem)
    cost = _cost_on(problem, settings, pairs, excess, tiles, space)
    cost.solve_first(start)
    if problem.host_work is not None:
        problem.host_work()
    cost.scale_weights(start)
    mean = cost.start_mean()
    coverage = cost.brightness.coverage(cost.scale)
    few = not fine_map_is_determined(coverage, len(pairs))
    noisy = mean() > LARGEST_FINE_COST
    # a fine map converges too slowly for parameters that make nearly the same motion
    if tiles.density > 1.0 and (few or noisy or like_size(space.names)):
        cost = _cost_on(problem, settings, pairs, excess, tiles.at_density(1.0), space)
        cost.warm_up(start)
        coverage = cost.brightness.coverage(cost.scale)
    free_share = check_pairs(recording.name, coverage, len(pairs))
    return Equations(problem, settings, pairs, found.silent_share, excess, cost, free_share)


def _start_in(space: ParameterSpace, problem: Problem) -> Vector:
    """Return the search vector of the sharpness stage's result in a space."""
    return space.to_vector({**space.start, **problem.start_values})


def before_latency(
    kind: type[Model], values: Mapping[str, float], late_rad: float
) -> dict[str, float]:
    """Return values of a motion for angles before the latency, from values for angles at the events' time stamps.

    Sharpness takes each event at its time stamp, so that its phases contain the latency. If the image of a mirror
    moves by 0.3 px within it, the first map at such phases explains so little that no fine map is tried.

    Parameters
    ----------
    kind : type of Model
        Model of the motion.
    values : mapping of str to float
        Values by name, in their units.
    late_rad : float
        Angle by which the first angle turns within the latency [rad].

    Returns
    -------
    dict
        The values, with other phases.
    """
    before = kind.turned_values(values, late_rad)
    if kind.ANGLES > 1:
        _, phase = kind.ORBITS[1]
        before[phase] = values[phase] + values["ratio"] * late_rad
    return before


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
    return Cost.on(brightness, space, settings.steps)
