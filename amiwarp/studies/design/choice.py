"""Which prism, and how fast: events, blur, model and window for apex × speed, and the choice."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

from amiwarp.calib.selection.smaller_models import QUANTISATION_PX, SHARE
from amiwarp.errors import AmiwarpError
from amiwarp.optics.models import MODELS
from amiwarp.optics.prism import Prism
from amiwarp.progress import Progress, part, silent
from amiwarp.simulation.simulator import Scene, SensorModel, Simulation
from amiwarp.studies.design.orbit import Orbit, orbit_of
from amiwarp.studies.design.volume import Volume, filled, measure

if TYPE_CHECKING:
    from amiwarp.optics.camera import Camera

ACROSS = math.sqrt(2.0 / 3.0)
"""Share of an error along the orbit that lies across the edges that fire: √⟨cos²⟩, weighted by their rate, |cos|."""
LEAST_SWING = 1.0
"""An edge that moves by less than this across itself finds pixels on neither side that see it pass [px]."""


@dataclass(frozen=True, slots=True)
class Timing:
    """What is wrong with times and angles, as standard deviations."""

    clock_us: float = 60.0
    """Of an event's time against the encoder's [us]: 58 is a readout in scans of 200 us."""
    encoder: float = math.radians(0.1)
    """Of the encoder's angle [rad]."""

    def __post_init__(self) -> None:
        if not (0.0 <= self.clock_us <= 1e6 and 0.0 <= self.encoder <= math.pi):
            raise AmiwarpError(f"clock error {self.clock_us} us or encoder error {math.degrees(self.encoder):.6g} deg "
                               "is negative or too large to compensate anything; give standard deviations")  # fmt: skip

    def blur(self, radius: float, rpm: float) -> tuple[float, float]:
        """What clock and encoder each add across an edge [px], for an orbit of ``radius`` [px]."""
        speed = 2.0 * math.pi * rpm / 60.0
        return ACROSS * radius * speed * self.clock_us * 1e-6, ACROSS * radius * self.encoder


@dataclass(frozen=True, slots=True)
class Limits:
    """What a choice must keep."""

    tolerance_px: float = 0.5
    """Compensation error: standard deviation across an edge [px]."""
    window_ms: float = 33.4
    """Time in which every edge direction must have been seen [ms]; the default is a frame of a 30 Hz camera."""
    bandwidth: float | None = None
    """What the sensor and its cable can carry [events/s]; None for any."""
    budget_px: float | None = None
    """What the model of the prism may be wrong by [px rms]; None for :data:`SHARE` of the blur."""

    def __post_init__(self) -> None:
        for name in ("tolerance_px", "window_ms", "bandwidth", "budget_px"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise AmiwarpError(f"{name} = {value}; give a number above 0")


@dataclass(frozen=True, slots=True)
class Choice:
    """One apex at one speed."""

    orbit: Orbit
    rpm: float
    events_per_s: float
    clock_px: float
    """Blur across an edge from the clock's error [px]."""
    encoder_px: float
    """Likewise from the encoder's."""
    model: str
    """The first rung of the ladder whose error is within the budget."""
    budget_px: float
    """What a model may be wrong by [px]."""
    misses: tuple[str, ...]
    """Which limits it does not keep: of :data:`LIMITS`."""

    LIMITS: ClassVar[tuple[str, ...]] = ("edges", "window", "blur", "bandwidth")

    @property
    def blur_px(self) -> float:
        """What compensation leaves across an edge without the model's own error [px]."""
        return math.sqrt(QUANTISATION_PX**2 + self.clock_px**2 + self.encoder_px**2)

    @property
    def error_px(self) -> float:
        """Likewise with the model's error, of whose square half lies across an edge [px]."""
        return math.hypot(self.blur_px, self.orbit.errors[self.model] / math.sqrt(2.0))

    @property
    def window_ms(self) -> float:
        """A quarter turn [ms]: the shortest window that sees every edge direction."""
        return 15e3 / self.rpm


@dataclass(frozen=True, eq=False)
class Design:
    """All choices of a grid, and which to take; ``dataclasses.replace`` puts other limits in at no cost."""

    camera: Camera
    glass: Prism
    """Index and flat side of all prisms."""
    orbits: tuple[Orbit, ...]
    """One an apex, which rises."""
    rpms: tuple[float, ...]
    """Rising [turns/min]."""
    volume: Volume
    timing: Timing
    limits: Limits

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        """Every apex × every speed; apexes rise first, speeds within each."""
        return tuple(self._choice(orbit, rpm) for orbit in self.orbits for rpm in self.rpms)

    def _choice(self, orbit: Orbit, rpm: float) -> Choice:
        limits, blurs = self.limits, self.timing.blur(orbit.radius, rpm)
        budget = limits.budget_px or SHARE * math.hypot(QUANTISATION_PX, *blurs)
        model = next(name for name in MODELS if orbit.errors[name] <= budget)
        made = Choice(orbit, rpm, self.volume.events_per_s(orbit, rpm), *blurs, model, budget, ())
        kept = {
            "edges": orbit.swing >= LEAST_SWING,
            "window": made.window_ms <= limits.window_ms,
            "blur": made.error_px <= limits.tolerance_px,
            "bandwidth": limits.bandwidth is None or made.events_per_s <= limits.bandwidth,
        }
        return replace(made, misses=tuple(name for name in Choice.LIMITS if not kept[name]))

    @cached_property
    def chosen(self) -> Choice | None:
        """The choice of fewest events that keeps all limits, of equal ones that of the smaller error, or None."""
        return min((c for c in self.choices if not c.misses), key=lambda c: (c.events_per_s, c.error_px), default=None)

    def at(self, apex: float, rpm: float) -> Choice:
        """The choice of this apex [rad] and speed."""
        return next(c for c in self.choices if c.orbit.apex == apex and c.rpm == rpm)

    def range_at(self, rpm: float) -> tuple[float, float]:
        """Smallest and largest apex [rad] whose swing and blur keep the limits at this speed, the model being exact.

        Radii are taken as proportional to the apex. The first may be above the second: then none does.
        """
        orbit = min(self.orbits, key=lambda o: abs(math.log(o.swing / LEAST_SWING)))
        room = self.limits.tolerance_px**2 - QUANTISATION_PX**2
        added = math.hypot(*self.timing.blur(orbit.radius, rpm))
        largest = math.inf if added == 0.0 else math.sqrt(max(room, 0.0)) / added
        return orbit.apex * LEAST_SWING / orbit.swing, orbit.apex * largest


def design(
    camera: Camera,
    scene: Scene,
    glass: Prism,
    *,
    apexes: Sequence[float],
    rpms: Sequence[float],
    timing: Timing | None = None,
    limits: Limits | None = None,
    sensor: SensorModel | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Design:
    """Compute every apex [rad] × speed [turns/min] for a camera before a scene; ``glass``: index and flat side.

    Raises :class:`AmiwarpError` for empty lists, and for what no prism or camera can be.
    """
    apexes, rpms = sorted(set(apexes)), sorted(set(rpms))
    if not (apexes and rpms and apexes[0] > 0.0 and 0.0 < rpms[0] <= rpms[-1] < math.inf):
        raise AmiwarpError(f"apexes {apexes} rad or speeds {rpms} rpm: give at least one of each, all above 0")
    timing, limits, sensor = timing or Timing(), limits or Limits(), sensor or SensorModel()
    tell = progress or silent
    orbits = []
    for k, apex in enumerate(apexes):
        tell("fitting models", 0.5 * k / len(apexes))
        orbits.append(orbit_of(camera, replace(glass, apex=apex), device))
    template = Simulation(filled(scene, camera, replace(glass, apex=apexes[-1])), camera, glass, 1.0, sensor=sensor,
                          seed=seed, device=device)  # fmt: skip
    volume = measure(template, apexes, rpms, part(tell, 0.5, 1.0))
    return Design(camera, glass, tuple(orbits), tuple(rpms), volume, timing, limits)
