"""Design study: the choice of a prism and its speed for a camera, before either is bought, and its chart."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

from amiwarp.calib.model_fit import BUDGET_SHARE
from amiwarp.calib.timing_blur import QUANTISATION_PX
from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.registry import rungs
from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import Scene
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.studies.event_volume import Volume, filled, measure
from amiwarp.studies.failures import noted
from amiwarp.studies.orbits import LEAST_SWING, Orbit, orbit_of
from amiwarp.studies.quantities import degrees, quarter_turn_ms
from amiwarp.tasks import Progress, part, silent

ACROSS = math.sqrt(2.0 / 3.0)
"""Share of an error along the orbit that acts across edges.

It is √⟨cos²⟩, weighted by |cos|, the rate at which the edges of each direction fire.
"""


@dataclass(frozen=True, slots=True)
class Timing:
    """Errors of event times and encoder angles, as standard deviations."""

    clock_us: float = 60.0
    """Error of an event's time relative to the encoder's clock [us]; 58 us results from a readout in scans of 200 us.
    """
    encoder: float = math.radians(0.1)
    """Standard deviation of the encoder's angle [rad]."""

    def __post_init__(self) -> None:
        if not (0.0 <= self.clock_us <= 1e6 and 0.0 <= self.encoder <= math.pi):
            raise AmiwarpError(
                f"clock error {self.clock_us} us or encoder error {math.degrees(self.encoder):.6g} deg "
                "is out of range; give standard deviations of 0 to 1e6 us and 0 to 180 deg"
            )

    def blur(self, radius: float, rpm: float) -> tuple[float, float]:
        """Return the blur across an edge [px] that clock and encoder each add, for an orbit of ``radius`` [px]."""
        speed = 2.0 * math.pi * rpm / 60.0
        return self.scaled(ACROSS * radius * speed, ACROSS * radius)

    def scaled(self, per_second: float, per_radian: float) -> tuple[float, float]:
        """Return the blur across an edge [px] by clock and encoder, for motions across it per second and per radian."""
        return per_second * self.clock_us * 1e-6, per_radian * self.encoder


@dataclass(frozen=True, slots=True)
class Limits:
    """Requirements that a prism and its speed must meet."""

    tolerance_px: float = 0.5
    """Largest compensation error: standard deviation across an edge [px]."""
    window_ms: float = 33.4
    """Time in which every edge direction must fire [ms]; the default is one frame of a 30 Hz camera."""
    bandwidth: float | None = None
    """Event rate that sensor and cable can transfer [events/s]; None for no limit."""
    budget_px: float | None = None
    """Largest error of the refraction model [px rms]; None for :data:`BUDGET_SHARE` of the blur."""

    def __post_init__(self) -> None:
        for name in ("tolerance_px", "window_ms", "bandwidth", "budget_px"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise AmiwarpError(f"{name} = {value}; give a number above 0")


@dataclass(frozen=True, slots=True)
class Choice:
    """Properties of one prism at one speed, and the limits that it violates."""

    orbit: Orbit
    """Effect of the prism on the image: sizes of orbits, and errors of models."""
    rpm: float
    """Speed of the prism [turns/min]."""
    events_per_s: float
    """Predicted event rate [events/s]."""
    clock_px: float
    """Blur across an edge caused by the clock error [px]."""
    encoder_px: float
    """Blur across an edge caused by the encoder error [px]."""
    model: str
    """Name of the smallest refraction model whose error is within the budget."""
    budget_px: float
    """Largest tolerated error of the refraction model [px rms]."""
    misses: tuple[str, ...]
    """Names of the violated limits, from :attr:`LIMITS`."""

    LIMITS: ClassVar[tuple[str, ...]] = ("edges", "window", "blur", "bandwidth")
    """Names of all limits that a choice can violate."""

    @property
    def blur_px(self) -> float:
        """Blur across an edge that compensation leaves, without the model's error [px]."""
        return math.sqrt(QUANTISATION_PX**2 + self.clock_px**2 + self.encoder_px**2)

    @property
    def error_px(self) -> float:
        """Standard deviation across an edge, model error included; half of the model error's square counts [px]."""
        return math.hypot(self.blur_px, self.orbit.errors[self.model] / math.sqrt(2.0))

    @property
    def window_ms(self) -> float:
        """Time of a quarter turn [ms]: the shortest window in which every edge direction fires."""
        return quarter_turn_ms(self.rpm)


@dataclass(frozen=True, eq=False)
class Design:
    """Predicted properties of all combinations of apex angle and speed, and the recommended combination.

    ``dataclasses.replace`` changes the limits without new simulations.
    """

    camera: Camera
    """Camera intrinsics."""
    glass: Prism
    """Refractive index and flat side of all prisms."""
    orbits: tuple[Orbit, ...]
    """Effects of the prisms on the image, one per apex angle, in increasing order of apex."""
    rpms: tuple[float, ...]
    """Speeds of the prism, in increasing order [turns/min]."""
    volume: Volume
    """Measured law that gives the event rate."""
    timing: Timing
    """Errors of event times and encoder angles."""
    limits: Limits
    """Requirements on prism and speed."""
    lost: Mapping[str, str] = field(default_factory=dict)
    """Error of each apex angle that could not be evaluated, by its name. It is no choice."""

    @property
    def failed(self) -> dict[str, str]:
        """Errors of all that failed, by name: apex angles, and simulations of the event volume."""
        return {**self.lost, **self.volume.failed}

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        """All combinations of apex angle and speed; the speed varies fastest."""
        return tuple(self._choice(orbit, rpm) for orbit in self.orbits for rpm in self.rpms)

    def _choice(self, orbit: Orbit, rpm: float) -> Choice:
        """Return the properties of a prism, given by its orbit, at a speed [turns/min]."""
        limits = self.limits
        blurs = self.timing.blur(orbit.radius, rpm)
        budget = limits.budget_px or BUDGET_SHARE * math.hypot(QUANTISATION_PX, *blurs)
        model = next(name for name in rungs() if orbit.errors[name] <= budget)
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
        """Choice with the fewest events that keeps all limits; None if there is none.

        Of choices with equal numbers of events, it is the choice with the smallest error.
        """
        kept = [choice for choice in self.choices if not choice.misses]
        return min(kept, key=lambda choice: (choice.events_per_s, choice.error_px), default=None)

    def at(self, apex: float, rpm: float) -> Choice:
        """Return the properties at this apex angle [rad] and speed [turns/min]."""
        return next(c for c in self.choices if c.orbit.apex == apex and c.rpm == rpm)

    def range_at(self, rpm: float) -> tuple[float, float]:
        """Return the smallest and the largest suitable apex angle [rad] at this speed [turns/min].

        At the smallest, the swing is :data:`LEAST_SWING`; see :attr:`Orbit.swing`. At the largest, the blur across an
        edge is ``limits.tolerance_px``. The error of the refraction model is not counted, and radii are taken as
        proportional to the apex angle. If the smallest exceeds the largest, no apex angle is suitable.
        """
        # The orbit nearest to the smallest suitable one is scaled.
        orbit = min(self.orbits, key=lambda orbit: abs(math.log(orbit.swing / LEAST_SWING)))
        smallest_apex = orbit.apex * LEAST_SWING / orbit.swing

        # Square of the blur that clock and encoder may add to the rounding to pixels
        blur_left = self.limits.tolerance_px**2 - QUANTISATION_PX**2
        added = math.hypot(*self.timing.blur(orbit.radius, rpm))
        if added == 0.0:
            return smallest_apex, math.inf if blur_left >= 0.0 else 0.0
        return smallest_apex, orbit.apex * (math.sqrt(max(blur_left, 0.0)) / added)


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
    """Evaluate every apex angle [rad] and speed [turns/min] for a camera in front of a scene.

    ``glass`` gives refractive index and flat side. An apex angle or a simulation that fails is noted, and the others
    are evaluated. Raises :class:`AmiwarpError` for empty lists, for a prism or camera that is impossible, and if every
    apex angle fails.
    """
    apexes = sorted(set(apexes))
    rpms = sorted(set(rpms))
    if not (apexes and rpms and apexes[0] > 0.0 and 0.0 < rpms[0] <= rpms[-1] < math.inf):
        raise AmiwarpError(
            f"apexes {apexes} rad or speeds {rpms} rpm: give at least one of each, all above 0"
        )
    timing = timing or Timing()
    limits = limits or Limits()
    sensor = sensor or SensorModel()
    report = progress or silent

    prisms = [replace(glass, apex=apex) for apex in apexes]
    orbits: list[Orbit] = []
    lost: dict[str, str] = {}
    for k, prism in enumerate(prisms):
        report("fitting models", 0.5 * k / len(prisms))
        with noted(lost, f"apex {degrees(prism.apex)}"):
            orbits.append(orbit_of(camera, prism, device))
    if not orbits:
        raise AmiwarpError("; ".join(f"{name}: {message}" for name, message in lost.items()))

    largest = replace(glass, apex=orbits[-1].apex)
    whole_scene = filled(scene, camera, largest)
    template = Simulation(whole_scene, camera, glass, 1.0, sensor=sensor, seed=seed, device=device)
    volume = measure(template, [orbit.apex for orbit in orbits], rpms, part(report, 0.5, 1.0))
    return Design(camera, glass, tuple(orbits), tuple(rpms), volume, timing, limits, lost)
