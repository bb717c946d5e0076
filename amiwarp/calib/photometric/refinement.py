"""State of the photometric stage between two of its steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.calib.photometric.answers import Answer, AnswerSearch
from amiwarp.calib.photometric.consistency import Consistency
from amiwarp.calib.photometric.equations import Equations, Problem, collect_equations
from amiwarp.calib.photometric.findings import Finding
from amiwarp.calib.photometric.verdicts import refusal
from amiwarp.results.parameters import ParameterSpace

if TYPE_CHECKING:
    Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Refinement:
    """What the photometric stage knows so far."""

    problem: Problem
    """Recording, settings and device. Never changes."""
    equations: Equations
    """Pairs of events, for the sensor's timing as it is known now."""
    search: AnswerSearch
    """Search on the present map, in the space of the answer."""
    answer: Answer
    """Best parameters so far, with their cost."""
    held: tuple[str, ...] = ()
    """Free parameters that the events do not determine."""
    rotation: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the camera's motion by name, if it was found before the paths of the tiles."""
    are_angles_examined: bool = False
    """Whether the events tell errors of their angles: for a still camera, if a map explains most of them."""
    is_timing_examined: bool = False
    """Whether they also tell the timing of the sensor: for one angle of a prism."""
    missing_step: float = 0.0
    """Median change of brightness beyond one threshold between the events of a pair [thresholds]."""
    pause_rad: float = 0.0
    """First estimate of the angle by which the prism turns in an unknown refractory period; 0 for none [rad]."""
    lag_rad: float = 0.0
    """The same for the time constant of slow pixels [rad]."""
    time_constant_us: float = 0.0
    """Time constant of slow pixels that was found [us]."""
    before_timing: Vector = field(default_factory=lambda: np.zeros(0))
    """Search vector of the answer before a correction of the sensor's timing [px]; empty if it was not examined."""
    timing: Vector = field(default_factory=lambda: np.zeros(0))
    """Change of the answer by a correction of the sensor's timing [px]; empty for none."""
    doubt: Vector = field(default_factory=lambda: np.zeros(0))
    """Change of the answer by the doubt about the refractory period [px]; empty if it does not count."""
    check: Consistency | None = None
    """Whether the answer holds everywhere; None if this was not examined."""
    given_space: ParameterSpace | None = None
    """Space before camera and prism were corrected; None if they were not examined."""
    apart: tuple[Vector, ...] = ()
    """Differences between the answers of rival explanations [px], each of shape (n,)."""
    findings: tuple[Finding, ...] = ()
    """What was noticed, in order: causes, corrections, doubts. Warnings and refusals are made from these alone."""
    hidden_px: Mapping[str, float] = field(default_factory=dict)
    """By how much causes that a step looked for may still move events [px rms], by their words."""
    finished: bool = False
    """Whether later steps are pointless."""

    @property
    def space(self) -> ParameterSpace:
        """Space of the answer's search vector."""
        return self.search.space

    @property
    def sensor(self) -> SensorTiming:
        """Refractory period and latency of the sensor, as given or as found."""
        return self.equations.settings.sensor

    @property
    def refusal(self) -> str:
        """Why the answer is refused; empty if it is accepted so far."""
        return refusal((self.answer.optimum, *self.findings))

    def noticing(self, *findings: Finding) -> Refinement:
        """Return the state with more findings."""
        return replace(self, findings=(*self.findings, *findings))

    def hiding(self, words: str, bound_px: float) -> Refinement:
        """Return the state with a further cause, given in words, that could hide, and how far it may move events."""
        return replace(self, hidden_px={**self.hidden_px, words: bound_px})

    def ending(self) -> Refinement:
        """Return the state as the last one: no further step is taken."""
        return replace(self, finished=True)

    def on_coarse_map(self) -> AnswerSearch:
        """Return the search on a new map with one node per pixel."""
        tiles = self.search.cost.brightness.tiles.at_density(1.0)
        return replace(self.search, cost=self.equations.solved_on(tiles, self.space))


Step = Callable[[Refinement], Refinement]
"""Part of the stage: it returns the state after it, and the same state if there is nothing to do."""


def first_answer(problem: Problem, sensor: SensorTiming) -> Refinement:
    """Return the state after a first search from the result of the sharpness stage, for the timing of a sensor.

    Raises :class:`AmiwarpError` for too few pairs of events.
    """
    equations = collect_equations(problem, sensor)
    search, held = equations.search()
    return Refinement(problem, equations, search, answer=search.search(search.origin), held=held)
