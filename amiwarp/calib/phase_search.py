"""Search for size and phase by sums in phase, without an initial guess, and the cost that NLopt's algorithms can lower.

The cost is what the scene that fits the sums best leaves of them, relative to the sums: 0 if an orbit explains all, 1
if it explains nothing. Long waves give it a wide basin, so a coarse grid over size, phase and direction finds it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.calibration_events import CalibrationEvents
from amiwarp.calib.nlopt_solver import best_of, maximise
from amiwarp.calib.phase_tiles import PhaseTiles
from amiwarp.calib.settings import PHASE, SEARCH_IF_UNCLEAR
from amiwarp.calib.thinning import thin_events
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.registry import MODELS, build_model
from amiwarp.optics.orbit import orbits_of
from amiwarp.optics.prism import Prism
from amiwarp.results.parameters import ParameterSpace
from amiwarp.results.search_stage import SearchStage

MOST_EVENTS = 150_000
"""Largest number of events that are summed. With 70,000 the answers differ by 0.02 px."""
LEAST_TURNS = 0.98
"""Fewest turns that count as a whole turn."""
LEAST_FORWARD = 0.99
"""Least share of the way of the angle that must go in one direction."""
CHECKED_ANGLES = 1000
"""Number of times at which it is examined in which direction the angle goes."""
SIZES = 8
PHASES = 12
"""Numbers of sizes and phases of the grid."""
BANDS = (0.5, 1.0)
"""Finest waves of the grid and the first descent, and of the second descent [rad/shrunk px]. With all waves at once,
the cost of orbits of 5 px has up to 20 minima."""
TOLERANCE_PX = 0.02
"""Length of steps that ends the descents [shrunk px]: the search over events goes on from there."""
STEP_PX = 0.5
"""First step of the descents [shrunk px]."""
MOST_EVALUATIONS = 60
"""Largest number of evaluations of each descent."""
LARGEST_COST = 0.5
"""Largest cost of an answer. It is 0.1 to 0.4 for a scene at rest, and 0.5 to 0.7 if the camera turns by 30 deg/s."""
LARGEST_RIVAL = 0.9
"""Largest share of the sums that another direction or phase may explain, relative to the answer's share."""
RIVAL_PHASE = math.radians(75.0)
"""Difference of the phase from which on a candidate is a rival of another one [rad]."""


@dataclass(frozen=True)
class FoundInPhase:
    """Answer of the search over sums in phase."""

    start: NDArray[np.float64]
    """Search vector of the answer [px], shape ``(n,)``."""
    stage: SearchStage
    """Points on the grid in the direction of the encoder, and of the first descent. Costs of the second descent, which
    led to the answer, are of other waves."""
    cost: float
    """Lowest cost on the grid."""
    rival: float
    """Lowest cost on the grid with a very different phase."""
    reversed: float
    """Lowest cost on the grid if the encoder's direction were reversed."""

    @property
    def distinct(self) -> bool:
        """Whether the answer explains the sums clearly better than all other ones."""
        share = 1.0 - self.cost
        others = 1.0 - min(self.rival, self.reversed)
        return self.cost <= LARGEST_COST and others <= LARGEST_RIVAL * share


class PhaseObjective:
    """Minus the cost of sums in phase as a function of the free parameters. Counts its evaluations."""

    def __init__(self, space: ParameterSpace, tiles: PhaseTiles, finest: float) -> None:
        """Keep the tiles. ``finest`` is the spatial frequency of the finest waves that count [rad/shrunk px]."""
        self.space = space
        self.evaluations = 0
        self._tiles = tiles
        self._finest = finest

    def measure(self, values: Mapping[str, float]) -> list[float]:
        """Return minus the cost at parameter values, in their units; -1 where points move to no finite place."""
        self.evaluations += 1
        try:
            orbits = _orbits(_model(self.space, values), self._tiles)
        except AmiwarpError:
            return [-1.0]
        return [-float(self._tiles.costs(orbits[None], self._finest)[0])]


def tiles_of(events: CalibrationEvents, space: ParameterSpace) -> PhaseTiles:
    """Return the sums of the whole turns about the middle of the events.

    Raises :class:`AmiwarpError` if they have less than a turn, or the angle turns back.
    """
    part = _whole_turns(events)
    width = space.camera.width
    height = space.camera.height
    largest = _largest_orbit(space)
    return PhaseTiles.of(thin_events(part, MOST_EVENTS), events.encoder, width, height, largest)


def _whole_turns(events: CalibrationEvents) -> Events:
    """Return the events of the whole turns about the middle of the events."""
    used = events.events
    times = np.linspace(int(used.t[0]), int(used.t[-1]), CHECKED_ANGLES)
    angles = events.encoder.angle_at(times.astype(np.int64))
    path_length = np.abs(np.diff(angles)).sum()
    swept = angles[-1] - angles[0]
    turns = math.floor(abs(swept) / math.tau + 1.0 - LEAST_TURNS)
    if turns < 1 or abs(swept) < LEAST_FORWARD * path_length:
        raise AmiwarpError(
            f"the angle goes {abs(swept) / math.tau:.2f} turns on, and {path_length / math.tau:.2f} turns in all; "
            "sums in phase need a whole turn in one direction: record for longer, or search with the cost 'sharpness'"
        )

    # Cut at equal angles before and after the middle.
    middle = 0.5 * (angles[0] + angles[-1])
    forward = np.sign(swept)
    ends = forward * (middle + np.array([-1.0, 1.0]) * forward * turns * math.pi)
    first_us, last_us = np.interp(ends, forward * angles, times)
    first, last = np.searchsorted(used.t, [first_us, last_us])
    return used[int(first) : int(last)]


def check_suited(space: ParameterSpace) -> None:
    """Raise :class:`AmiwarpError` if sums in phase cannot tell the free parameters of a space."""
    kind = MODELS[space.model]
    reason = ""
    if kind.ANGLES != 1:
        reason = f"the {kind.NAME} model has {kind.ANGLES} angles, and sums in phase need an optic with one"
    elif not kind.PRISM or kind.GLASS is not Prism:
        reason = (
            f"sums in phase need the orbit of a turning prism, which the {kind.NAME} model is not"
        )
    elif "rpm" in space.names:
        reason = "the recording has no encoder, and sums in phase need the angle of each event"
    elif "clock_offset" in space.names or space.moving:
        reason = "sums in phase need a fixed clock offset and a camera at rest"
    elif not space.cartesian:
        reason = "sums in phase need a free size, and a free phase over the full turn"
    if reason:
        raise AmiwarpError(
            f"{reason}; search with the cost 'sharpness' and the global algorithm {SEARCH_IF_UNCLEAR!r}",
            ErrorCode.OPTIONS,
        )


def check_found_in_phase(space: ParameterSpace) -> None:
    """Raise :class:`AmiwarpError` if parameters other than size and phase would have to be found."""
    if len(space.names) != 2:
        raise AmiwarpError(
            f"the global search {PHASE!r} finds size and phase only, and {', '.join(space.names)} are free; give one "
            f"of NLopt's algorithms, such as {SEARCH_IF_UNCLEAR!r}",
            ErrorCode.OPTIONS,
        )


def check_distinct(found: FoundInPhase) -> None:
    """Raise :class:`AmiwarpError` if the answer does not explain the sums clearly better than all others."""
    if found.distinct:
        return
    costs = (
        f"the best motion leaves {100 * found.cost:.0f} % of the sums in phase unexplained, a very different phase "
        f"{100 * found.rival:.0f} %, the reversed direction {100 * found.reversed:.0f} %"
    )
    if found.reversed < min(found.cost, found.rival):
        raise AmiwarpError(
            f"the prism seems to turn against the direction of the encoder: {costs}; read the encoder log again with "
            "the other direction (--direction)",
            ErrorCode.CALIBRATION_REFUSED,
        )
    raise AmiwarpError(
        f"sums in phase do not tell the motion: {costs}; hold the camera still, show a scene with more texture, or "
        f"search with the cost 'sharpness' and the global algorithm {SEARCH_IF_UNCLEAR!r}",
        ErrorCode.CALIBRATION_REFUSED,
    )


def search_in_phase(space: ParameterSpace, tiles: PhaseTiles) -> FoundInPhase:
    """Search for size and phase on a grid, then by descents. All other parameters keep their start values."""
    began = time.perf_counter()
    size = space.size_name
    grid = OrbitGrid.of(space, tiles)
    phases = np.arange(PHASES) * (math.tau / PHASES)
    orbits = np.concatenate([grid.turned(phase) for phase in phases])
    both = np.concatenate([orbits, orbits[..., ::-1]])
    costs = tiles.costs(both, BANDS[0])
    forward, backward = costs.reshape(2, PHASES, SIZES)

    best = np.unravel_index(int(np.argmin(forward)), forward.shape)
    apart = np.abs(np.angle(np.exp(1j * (phases - phases[best[0]]))))
    rival = float(forward[apart >= RIVAL_PHASE].min())
    points = [
        space.to_vector({**space.start, size: float(grid_size), "phase": float(phase)})
        for phase in phases
        for grid_size in grid.sizes
    ]
    scores = (-forward).ravel().tolist()

    x = points[int(np.argmin(forward))]
    low, high = space.bounds()
    for finest in BANDS:

        def score(v: NDArray[np.float64], finest: float = finest) -> float:
            values = space.to_values(v)
            candidate = grid.at(values[size], values["phase"])
            return -float(tiles.costs(candidate[None], finest)[0])

        run = maximise(
            score,
            "LN_BOBYQA",
            low=low,
            high=high,
            start=x,
            evaluations=MOST_EVALUATIONS,
            tolerance=TOLERANCE_PX * tiles.shrink,
            step=STEP_PX * tiles.shrink,
        )
        x = run.x
        if finest == BANDS[0]:
            # of the other band, costs are not comparable
            points += [*run.points]
            scores += run.scores.tolist()
    stage = best_of(PHASE, points, scores, seconds=time.perf_counter() - began, ended=run.ended)
    return FoundInPhase(x, stage, float(forward.min()), rival, float(backward.min()))


@dataclass(frozen=True, eq=False)
class OrbitGrid:
    """Orbits of the tiles at some sizes and the phase 0, between which they are interpolated.

    A phase turns the rotations with the angle on, and the rotations against it back.
    """

    sizes: NDArray[np.float64]
    """Sizes, evenly spaced, shape (sizes,)."""
    orbits: NDArray[np.complex128]
    """Rotations with and against the angle [px], shape (sizes, tiles, 2)."""

    @classmethod
    def of(cls, space: ParameterSpace, tiles: PhaseTiles) -> OrbitGrid:
        size = space.size_name
        low = space.low[size]
        high = space.high[size]
        sizes = low + (high - low) * (np.arange(SIZES) + 1.0) / SIZES
        still = {**space.start, "phase": 0.0}
        models = [_model(space, {**still, size: float(size_value)}) for size_value in sizes]
        return cls(sizes, np.stack([_orbits(model, tiles) for model in models]))

    def turned(self, phase: float) -> NDArray[np.complex128]:
        """Return the orbits of all sizes at a phase [rad]."""
        return self.orbits * np.exp(1j * phase * np.array([1.0, -1.0]))

    def at(self, size: float, phase: float) -> NDArray[np.complex128]:
        """Return the orbits at a size and a phase [rad], shape (tiles, 2)."""
        step = self.sizes[1] - self.sizes[0]
        place = (size - self.sizes[0]) / step
        left = int(np.clip(place, 0, SIZES - 2))
        between = self.orbits[left] + (place - left) * (self.orbits[left + 1] - self.orbits[left])
        return between * np.exp(1j * phase * np.array([1.0, -1.0]))


def _model(space: ParameterSpace, values: Mapping[str, float]) -> Model:
    """Return the model at parameter values, without tables."""
    kind = MODELS[space.model].closed_form()
    return build_model(kind.NAME, space.camera, space.prism, values)


def _orbits(model: Model, tiles: PhaseTiles) -> NDArray[np.complex128]:
    """Return the rotations of each tile's middle with and against the angle [px], shape (tiles, 2)."""
    found = orbits_of(model, tiles.middles)
    return np.stack([found.forward, found.backward], axis=1)


def _largest_orbit(space: ParameterSpace) -> float:
    """Return the radius of the orbit at the image's middle at the largest size [px]."""
    size = space.size_name
    model = _model(space, {**space.start, size: space.high[size]})
    middle = np.array([[0.5 * (space.camera.width - 1), 0.5 * (space.camera.height - 1)]])
    return orbits_of(model, middle).radius
