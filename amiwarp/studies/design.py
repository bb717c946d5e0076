"""Design study: the choice of a prism and its speed for a camera, before either is bought, and its chart."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.model_choice import QUANTISATION_PX, SHARE
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.palette import MODEL_COLOURS, VERMILION
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import EllipseModel, ExactModel, Model, predicted_error, rungs
from amiwarp.optics.prism import Prism
from amiwarp.plotting import figures
from amiwarp.simulation.description import PrismMotion, Scene
from amiwarp.simulation.scenery import place_scene, seen_bearings
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.studies.failures import noted
from amiwarp.tasks import Progress, part, silent

# Effect of a prism on a camera's image: radii of the pixels' orbits, and error of each refraction model.

QUARTER_SWING = 1.0 - math.sqrt(0.5)
"""Smallest displacement across an edge in a quarter turn on an orbit of radius 1.

The minimum is over all edge directions and all start angles.
"""
GRID = 12
"""Number of rows of the grid of pixels on which the circle models are fitted."""
ACROSS_IMAGE, DOWN_IMAGE = 33, 25
"""Number of columns and rows of the grid of pixels whose paths are followed."""
TURN_ANGLES = 24
"""Number of angles per turn at which these pixels are followed."""


@dataclass(frozen=True, slots=True)
class Orbit:
    """Effect of a prism on a camera's image, independent of its speed."""

    apex: float
    """Apex angle of the prism [rad]."""
    deflection: float
    """Deflection of the ray on the optical axis [rad]."""
    radius: float
    """Radius of the orbits [px], rms over the image."""
    smallest: float
    """Radius of the smallest orbit in the image [px]."""
    errors: dict[str, float]
    """For each model, the distance of its best fit from the exact model [px rms over image and turn]."""

    @property
    def swing(self) -> float:
        """Smallest displacement across an edge in a quarter turn, anywhere in the image [px]."""
        return QUARTER_SWING * self.smallest


def orbit_of(camera: Camera, prism: Prism, device: str = "cpu") -> Orbit:
    """Return the orbit of a prism: radii, and the errors of all models.

    Raises :class:`AmiwarpError` if no pixel has a ray during a whole turn.
    """
    rms, smallest = orbit_radii(camera, prism)
    return Orbit(prism.apex, prism.deflection, rms, smallest, _model_errors(ExactModel(camera, prism), device))


def orbit_radii(camera: Camera, prism: Prism) -> tuple[float, float]:
    """Return the radius of the orbits [px], rms over the image, and the smallest radius [px].

    Raises :class:`AmiwarpError` if no pixel has a ray during a whole turn.
    """
    moved = paths(ExactModel(camera, prism), image_grid(camera), TURN_ANGLES)
    radii = radii_of(moved[np.isfinite(moved).all(axis=(1, 2))])
    if not len(radii):
        raise AmiwarpError(f"apex {math.degrees(prism.apex):.6g} deg: no pixel of this camera has a ray during a "
                           "whole turn; choose a smaller apex or a lens with a narrower view")  # fmt: skip
    return float(np.sqrt(np.mean(radii**2))), float(radii.min())


def image_grid(camera: Camera, across: int = ACROSS_IMAGE, down: int = DOWN_IMAGE) -> NDArray[np.float64]:
    """Return a grid of pixels over the whole image, row by row, shape ``(down * across, 2)``."""
    x, y = np.linspace(0, camera.width - 1, across), np.linspace(0, camera.height - 1, down)
    return np.stack([m.ravel() for m in np.meshgrid(x, y)], axis=1)


def paths(model: Model, pixels: NDArray[np.float64], per_turn: int, turns: int = 1) -> NDArray[np.float64]:
    """Return the path of what each pixel sees in the image at rest, over whole turns of the first angle.

    The shape is (pixels, ``per_turn * turns``, 2). Positions are NaN where a pixel has no ray.
    """
    theta = np.arange(per_turn * turns) * (2.0 * np.pi / per_turn)
    moved = model.compensate_points(np.repeat(pixels, len(theta), axis=0), np.tile(theta, len(pixels)))
    return moved.reshape(len(pixels), len(theta), 2)


def radii_of(moved: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rms distance of each path, shape (pixels, angles, 2), from its middle: of a circle, its radius."""
    return np.asarray(np.sqrt(np.mean(np.sum((moved - moved.mean(axis=1, keepdims=True)) ** 2, axis=2), axis=1)))


def _model_errors(exact: ExactModel, device: str) -> dict[str, float]:
    """Return the error of each refraction model's best fit [px rms]; those without tables get the best size."""

    def error(kind: type[Model]) -> float:
        if kind is ExactModel:
            return 0.0
        fitted = _fitted(kind, exact) if kind.closed_form() is kind else EllipseModel.from_model(exact, device)
        return predicted_error(fitted, exact, remove_lag=True).rms

    return {name: error(kind) for name, kind in rungs().items()}


def _fitted(kind: type[Model], exact: ExactModel) -> Model:
    """Return the model whose size fits the exact model best."""
    from scipy.optimize import minimize_scalar

    start = kind.start_values(exact.prism)

    def sized(size: float) -> Model:
        return kind.from_values(exact.camera, exact.prism, {**start, kind.SIZE: size})

    def error(size: float) -> float:
        return predicted_error(sized(size), exact, grid=GRID).rms

    size = start[kind.SIZE]
    found = minimize_scalar(error, bounds=(0.5 * size, 4.0 * size), method="bounded", options={"xatol": 1e-3 * size})
    return sized(float(found.x))


# Event volume: a law for the event rate, measured by simulating small parts of the image.
#
# The law holds for every apex angle, speed and image size of a design study.

TILE, ACROSS_TILES, DOWN_TILES = 16, 12, 9
"""Side [px] and number, across and down, of the tiles of the image that are simulated."""
NODES = 4
"""Largest number of apex angles that are simulated; between them the events per turn are interpolated."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Measured law of the event volume.

    Events per turn and pixel are yield · Δ / C, where Δ is the mean distance by which the log intensity of a pixel
    goes up and down in a turn; sensor noise is added. On orbits of radius r, Δ is 4 r ⟨|∇L|⟩.
    """

    apexes: NDArray[np.float64]
    """Apex angles that were simulated [rad], shape ``(n,)``."""
    rpms: NDArray[np.float64]
    """Simulated speeds, one or two [turns/min], shape ``(m,)``."""
    yields: NDArray[np.float64]
    """Ratio of simulated events to events expected from the scene's gradients, shape ``(n, m)``."""
    uncertainty: float
    """Relative standard error of the yields, from the scatter of the tiles."""
    texture: float
    """⟨|∇L|⟩: mean gradient of log intensity over the image [1/px]."""
    contrast: float
    """C: contrast threshold, the change of log intensity between two events."""
    pixels: int
    """Number of pixels of the image."""
    noise_hz: float
    """Noise rate of each pixel [events/s]."""
    simulated: int
    """Number of pixels that were simulated, summed over the tiles."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """Error of each simulation that failed, by apex angle and speed. The law leaves it out."""

    def events_per_s(self, orbit: Orbit, rpm: float) -> float:
        """Return the event rate of the whole image [events/s]."""
        per_turn = self.yield_at(orbit.apex, rpm) * 4.0 * orbit.radius * self.texture / self.contrast
        return self.of_image(per_turn * rpm / 60.0)

    def of_image(self, per_pixel: float) -> float:
        """Return the event rate of the whole image [events/s] for one per pixel without noise [events/s]."""
        return self.pixels * (per_pixel + self.noise_hz)

    def yield_at(self, apex: float, rpm: float) -> float:
        """Return the ratio of simulated to expected events at an apex angle [rad] and a speed [turns/min].

        It is a power law between simulated apexes; between speeds its reciprocal is linear, as for a dead time.
        """
        at = [float(np.interp(math.log(apex), np.log(self.apexes), np.log(y))) for y in self.yields.T]
        return 1.0 / float(np.interp(rpm, self.rpms, np.exp(-np.array(at))))


def filled(scene: Scene, camera: Camera, prism: Prism) -> Scene:
    """Return the scene, centred and scaled to fill everything that the camera sees through this prism.

    Every part of the image then sees the same part of the scene as in the whole image. A scene with a given size stays
    unchanged.
    """
    if scene.fov is not None:
        return scene
    whole = Simulation(scene, camera, prism, 1.0)
    place_scene(whole)  # raises an error if a plane cannot fill the view
    bearings = seen_bearings(whole)
    reach = np.abs(bearings[:, :2] / bearings[:, 2:]).max(axis=0) + 4.0 / min(camera.fx, camera.fy)
    scale = float(np.max(reach / np.array(scene.frames.size)))
    return replace(scene, fov=2.0 * math.atan(scale * scene.frames.size[0]))


def measure(template: Simulation, apexes: Sequence[float], rpms: Sequence[float], report: Progress) -> Volume:
    """Measure the event volume by simulating tiles of the camera.

    The apex angles span the range of ``apexes``; the speeds are the slowest and the fastest of ``rpms``. Each tile is a
    small camera that sees the same as its part of the image. It is simulated for two turns; the first lets the
    reference levels of the pixels settle, the second is counted. The events of the tiles are scaled to the image by the
    gradient along their orbits, which is known everywhere, so that the choice of tiles matters little.

    A simulation that fails is noted, and the law is measured by the others. Raises :class:`AmiwarpError` for a scene
    without texture, and if too few simulations succeed for a law.
    """
    sensor, camera = template.sensor, template.camera
    gradient = np.hypot(*slopes_of(template.log_view()))
    if not gradient.mean() > 0.0:
        raise AmiwarpError("the scene has no texture, so it generates no events with any prism; choose another picture")
    nodes = np.geomspace(apexes[0], apexes[-1], min(NODES, len(apexes))) if len(apexes) > 1 else np.array(apexes)
    speeds = np.array(sorted({rpms[0], rpms[-1]}))
    contrast = 2.0 / (1.0 / sensor.contrast_on + 1.0 / sensor.contrast_off)
    noise = noise_hz(sensor)
    cameras = tiles(camera, template.seed)
    yields, errors = np.full((2, len(nodes), len(speeds)), np.nan)
    simulated = np.zeros(yields.shape, np.bool_)
    failed: dict[str, str] = {}
    for k, (i, j) in enumerate(np.ndindex(yields.shape)):
        report("simulating", k / yields.size)
        rpm, apex = float(speeds[j]), float(nodes[i])
        with noted(failed, f"simulation of apex {degrees(apex)} at {rpm:g} rpm"):
            prism = replace(template.glass, apex=apex)
            case = replace(template, prism=prism, motion=PrismMotion(rpm), duration_s=120.0 / rpm)
            radius = orbit_radii(camera, prism)[0]
            likely = texture_of(gradient, radius, camera, cameras) * 4.0 * radius / contrast
            half, by_noise = case.duration_us // 2, noise * 60.0 / rpm
            yields[i, j], errors[i, j] = simulated_yield(case, cameras, likely, half, by_noise)
            simulated[i, j] = True
    kept = _complete(simulated)
    if kept is None:
        name, said = next(iter(failed.items()))
        raise AmiwarpError(f"too few simulations succeeded for the event volume; {name}: {said}")
    nodes, speeds, yields, errors = nodes[kept[0]], speeds[kept[1]], yields[np.ix_(*kept)], errors[np.ix_(*kept)]
    pixels = camera.width * camera.height
    small = sum(tile.width * tile.height for tile in cameras)
    return Volume(nodes, speeds, yields, float(errors.mean()), float(gradient.mean()), contrast, pixels, noise,
                  small, failed)  # fmt: skip


def _complete(there: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Return the rows and columns of a table that leave out what is missing and keep most; None if nothing remains."""
    rows, columns = there.all(axis=1), there.all(axis=0)
    options = [
        (np.flatnonzero(rows), np.arange(there.shape[1])),
        (np.arange(there.shape[0]), np.flatnonzero(columns)),
        # one speed may have failed everywhere and the other for some apexes
        *((np.flatnonzero(there[:, [k]].all(axis=1)), np.array([k])) for k in range(there.shape[1])),
    ]
    best = max(options, key=lambda option: len(option[0]) * len(option[1]))
    return best if len(best[0]) and len(best[1]) else None


def slopes_of(log: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the gradient of a picture's log intensity [1/px]: along y, and along x."""
    down, across = np.gradient(log)
    return down, across


def noise_hz(sensor: SensorModel) -> float:
    """Return the mean noise rate of a pixel [events/s]."""
    return sensor.shot_noise_hz + sensor.leak_hz + sensor.hot_fraction * sensor.hot_hz


def simulated_yield(
    case: Simulation, cameras: Sequence[Camera], likely: NDArray[np.float64], start_us: int, noise: float
) -> tuple[float, float]:
    """Simulate tiles, and return the ratio of their events to the likely ones, with its relative standard error.

    ``likely``: events per pixel that the scene's gradients let expect after ``start_us`` [us], shape ``(tiles,)``;
    ``noise``: events per pixel by noise.
    """
    found = np.array([_events_after(case, tile, k, start_us) for k, tile in enumerate(cameras)]) - noise
    ratio = max(float(found.mean() / likely.mean()), 1e-6)
    return ratio, float(np.std(found - ratio * likely)) / math.sqrt(len(cameras)) / abs(found.mean())


def tiles(camera: Camera, seed: int = 0) -> list[Camera]:
    """Return small cameras that each see a tile of the image, at a random position in each cell of a grid.

    The positions are random so that a repeating texture cannot align with the grid.
    """
    across, down = min(ACROSS_TILES, camera.width // TILE), min(DOWN_TILES, camera.height // TILE)
    if across < 2 or down < 2:
        return [camera]
    wide, high = camera.width / across, camera.height / down
    at = np.random.default_rng([seed, 0x71E5]).random((down, across, 2)) * (wide - TILE, high - TILE)
    left = np.floor(np.arange(across) * wide + at[..., 0]).ravel()
    top = np.floor(np.arange(down)[:, None] * high + at[..., 1]).ravel()
    return [
        replace(camera, width=TILE, height=TILE, cx=camera.cx - float(x), cy=camera.cy - float(y))
        for x, y in zip(left, top, strict=True)
    ]


def _events_after(case: Simulation, tile: Camera, number: int, start_us: int) -> float:
    """Simulate a tile and return its number of events per pixel from ``start_us`` [us] on."""
    seeded = replace(case, camera=tile, seed=(case.seed + number) % (1 << 31))
    blocks = seeded.blocks(chunk_us=case.duration_us)  # one chunk, because there are few pixels
    return sum(int((events.t >= start_us).sum()) for events, _ in blocks) / (tile.width * tile.height)


def texture_of(gradient: NDArray[Any], radius: float, camera: Camera, parts: Sequence[Camera]) -> NDArray[np.float64]:
    """Return the mean gradient of log intensity along the orbits of each tile's pixels [1/px], shape ``(tiles,)``."""
    from scipy.ndimage import gaussian_filter

    met = gaussian_filter(gradient, radius / math.sqrt(2.0))  # as wide as a ring of that radius
    corners = [(round(camera.cx - part.cx), round(camera.cy - part.cy)) for part in parts]
    boxes = [met[y : y + p.height, x : x + p.width] for p, (x, y) in zip(parts, corners, strict=True)]
    return np.array([box.mean() for box in boxes], np.float64)


ACROSS = math.sqrt(2.0 / 3.0)
"""Share of an error along the orbit that acts across edges.

It is √⟨cos²⟩, weighted by |cos|, the rate at which the edges of each direction fire.
"""
LEAST_SWING = 1.0
"""Smallest useful displacement across an edge in a quarter turn [px].

An edge that moves less may not cross any pixel.
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
            raise AmiwarpError(f"clock error {self.clock_us} us or encoder error {math.degrees(self.encoder):.6g} deg "
                               "is out of range; give standard deviations of 0 to 1e6 us and 0 to 180 deg")  # fmt: skip

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
    """Largest error of the refraction model [px rms]; None for :data:`SHARE` of the blur."""

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
    """Names of the violated limits, from :data:`LIMITS`."""

    LIMITS: ClassVar[tuple[str, ...]] = ("edges", "window", "blur", "bandwidth")
    """Names of all limits that a choice can violate."""

    @property
    def blur_px(self) -> float:
        """Blur across an edge that compensation leaves, without the model's error [px]."""
        return math.sqrt(QUANTISATION_PX**2 + self.clock_px**2 + self.encoder_px**2)

    @property
    def error_px(self) -> float:
        """Standard deviation across an edge, model error included; half of the square of that error counts [px]."""
        return math.hypot(self.blur_px, self.orbit.errors[self.model] / math.sqrt(2.0))

    @property
    def window_ms(self) -> float:
        """Time of a quarter turn [ms]: the shortest window in which every edge direction fires."""
        return 15e3 / self.rpm


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
        limits, blurs = self.limits, self.timing.blur(orbit.radius, rpm)
        budget = limits.budget_px or SHARE * math.hypot(QUANTISATION_PX, *blurs)
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
        return min((c for c in self.choices if not c.misses), key=lambda c: (c.events_per_s, c.error_px), default=None)

    def at(self, apex: float, rpm: float) -> Choice:
        """Return the properties at this apex angle [rad] and speed [turns/min]."""
        return next(c for c in self.choices if c.orbit.apex == apex and c.rpm == rpm)

    def range_at(self, rpm: float) -> tuple[float, float]:
        """Return the smallest and the largest suitable apex angle [rad] at this speed [turns/min].

        At the smallest, the swing is :data:`LEAST_SWING`; see :attr:`Orbit.swing`. At the largest, the blur across an
        edge is ``limits.tolerance_px``. The error of the refraction model is not counted, and radii are taken as
        proportional to the apex angle. If the smallest exceeds the largest, no apex angle is suitable.
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
    """Evaluate every apex angle [rad] and speed [turns/min] for a camera in front of a scene.

    ``glass`` gives refractive index and flat side. An apex angle or a simulation that fails is noted, and the others
    are evaluated. Raises :class:`AmiwarpError` for empty lists, for a prism or camera that is impossible, and if every
    apex angle fails.
    """
    apexes, rpms = sorted(set(apexes)), sorted(set(rpms))
    if not (apexes and rpms and apexes[0] > 0.0 and 0.0 < rpms[0] <= rpms[-1] < math.inf):
        raise AmiwarpError(f"apexes {apexes} rad or speeds {rpms} rpm: give at least one of each, all above 0")
    timing, limits, sensor = timing or Timing(), limits or Limits(), sensor or SensorModel()
    report = progress or silent
    prisms = [replace(glass, apex=apex) for apex in apexes]
    orbits: list[Orbit] = []
    lost: dict[str, str] = {}
    for k, prism in enumerate(prisms):
        report("fitting models", 0.5 * k / len(prisms))
        with noted(lost, f"apex {degrees(prism.apex)}"):
            orbits.append(orbit_of(camera, prism, device))
    if not orbits:
        raise AmiwarpError("; ".join(f"{name}: {said}" for name, said in lost.items()))
    largest = replace(glass, apex=orbits[-1].apex)
    template = Simulation(filled(scene, camera, largest), camera, glass, 1.0, sensor=sensor, seed=seed,
                          device=device)  # fmt: skip
    volume = measure(template, [orbit.apex for orbit in orbits], rpms, part(report, 0.5, 1.0))
    return Design(camera, glass, tuple(orbits), tuple(rpms), volume, timing, limits, lost)


# Recommendation of a design study in words: the chosen prism and speed, and why others are rejected.


def headline(design: Design) -> str:
    """Return one line of text: the recommended prism and speed, or that no combination keeps all limits."""
    chosen = design.chosen
    if chosen is None:
        return f"none of {len(design.choices)} choices keeps all limits"
    return f"apex {degrees(chosen.orbit.apex)} at {chosen.rpm:g} rpm, compensated by the {chosen.model} model"


def reasons(design: Design) -> list[str]:
    """Return the reasons for the recommendation, or for having none: one line of text per limit."""
    chosen = design.chosen
    if chosen is None:
        return _refusals(design)
    kept = sum(not c.misses for c in design.choices)
    count = f"{kept} choices of {len(design.choices)}"
    events = f"events: {rate(chosen.events_per_s)}, the fewest of the {count} that keep all limits"
    if larger := [c for c in design.choices if c.rpm == chosen.rpm and c.orbit.apex > chosen.orbit.apex]:
        more = larger[0].events_per_s / chosen.events_per_s
        events += f"; {degrees(larger[0].orbit.apex)} generates {more:.1f} times as many"
    edges = (
        f"edges: a quarter turn displaces edges of every direction by at least {chosen.orbit.swing:.2f} px "
        f"across themselves (required: {LEAST_SWING:g} px)"
    )
    if short := [o for o in design.orbits if o.swing < LEAST_SWING]:
        edges += f"; {degrees(short[-1].apex)} displaces them by only {short[-1].swing:.2f} px"
    window = f"window: a quarter turn takes {chosen.window_ms:.1f} ms (allowed: {design.limits.window_ms:.1f} ms)"
    if slow := [rpm for rpm in design.rpms if rpm < chosen.rpm]:
        window += f"; at {slow[-1]:g} rpm it takes {15e3 / slow[-1]:.1f} ms"
    blur = (
        f"blur: {chosen.error_px:.3f} px across an edge (tolerance: {design.limits.tolerance_px:g} px), from pixels "
        f"{QUANTISATION_PX:.2f}, clock {chosen.clock_px:.3f}, encoder {chosen.encoder_px:.3f}"
    )
    errors = chosen.orbit.errors
    model = (
        f"model: {chosen.model}, with an error of {errors[chosen.model]:.2g} px (allowed: {chosen.budget_px:.2g} px)"
    )
    model += "".join(f"; {name} has {error:.2g} px" for name, error in errors.items() if error > chosen.budget_px)
    lines = [events, edges, window, blur, model]
    if design.limits.bandwidth is not None:
        lines.append(f"bandwidth: {rate(chosen.events_per_s)} (limit: {rate(design.limits.bandwidth)})")
    low, high = design.range_at(chosen.rpm)
    ends = f"from {degrees(low)}" + (f" to {degrees(high)}" if high <= design.orbits[-1].apex else " upwards")
    ends += " keeps the limits of edges and blur, also off the grid"
    return [*lines, f"range: at {chosen.rpm:g} rpm every apex {ends}", *_failures(design)]


def _failures(design: Design) -> list[str]:
    """Return a line of text for each part of the study that failed."""
    return [f"failed: {name}: {said}" for name, said in design.failed.items()]


def _refusals(design: Design) -> list[str]:
    """Return text for each limit: how many combinations it rules out, and what would help."""
    limits, count = design.limits, len(design.choices)
    best = max(design.orbits, key=lambda o: o.swing)
    least = min(c.error_px for c in design.choices)
    fewest = min(c.events_per_s for c in design.choices)
    advice = {
        "edges": f"a quarter turn displaces edges by {best.swing:.2f} px at most, and {LEAST_SWING:g} px is required; "
        "try a larger apex, or a longer focal length",
        "window": f"the shortest quarter turn takes {15e3 / design.rpms[-1]:.1f} ms, and {limits.window_ms:.1f} ms "
        "is allowed; try a faster prism, or a longer --window-ms",
        "blur": f"the smallest blur is {least:.3f} px, and the tolerance is {limits.tolerance_px:g} px; "
        + (
            f"pixels alone leave {QUANTISATION_PX:.2f} px, so only a larger --tolerance-px helps"
            if limits.tolerance_px <= QUANTISATION_PX
            else "try a better clock or encoder, a slower prism, or a larger --tolerance-px"
        ),
        "bandwidth": f"the lowest event rate is {rate(fewest)}, and the limit is {rate(limits.bandwidth or math.inf)}; "
        "try a higher threshold, or a slower prism",
    }
    lines = []
    for name, text in advice.items():
        out = sum(name in c.misses for c in design.choices)
        if out:
            why = text if out == count else text.rpartition("; ")[2]
            lines.append(f"{name}: rules out {out} of {count}: {why}")
    return [*lines, *_failures(design)]


def degrees(angle: float) -> str:
    """Return an angle [rad] as text in degrees."""
    return f"{float(f'{math.degrees(angle):.3g}'):g}°"


def rate(events_per_s: float) -> str:
    """Return an event rate [events/s] as text."""
    return f"{events_per_s / 1e6:.3g} Mev/s"


# Chart of a design study: error and event rate over the apex angle, and a table of all apex angles and speeds.

WIDTH, PANEL, LEFT, RIGHT, BETWEEN = 12.0, 3.9, 0.85, 1.15, 2.1
"""Figure width, panel height, left and right margins, and gap between panels, which contains the names of the lines
[inch]."""
TITLE, AXIS, HEAD, CELL, NOTE = 0.85, 0.7, 0.4, 0.55, 0.8
"""Heights of the title above a panel, of the axis below it, of the table's title, of a table row, and of the note
[inch]."""
EDGE, TABLE, FIRST = 0.3, 11.4, 1.05
"""Margin of text and table, width of the table, and width of its first column [inch]."""
LETTERS, SMALL, TINY = 12.0, 10.5, 9.5
"""Font sizes of the chart [point]."""
_APPROXIMATIONS = [name for name, model in rungs().items() if model.SIMPLIFIES]
COLOURS = dict(zip(_APPROXIMATIONS, MODEL_COLOURS, strict=False))
"""Colour of each refraction model. The exact model has no error, so it is not drawn."""
MARKS = dict(zip(_APPROXIMATIONS, "os^vPX", strict=False))
"""Marker of each refraction model."""
SHORT, GOOD, BAD, CHOSEN = "#e3e3e3", "#d3e8f4", "#f3f3f3", VERMILION
"""Colours of apex angles that are too small, of table cells that keep the limits, of cells that violate them, and of
the recommended cell's frame."""
HIGHEST = 0.77
"""Height of the largest value in a panel, as a share of the panel; text stands above it."""
LOWEST_ERROR = 1e-3
"""Smallest error that is drawn [px]; smaller errors are drawn at this value."""


def chart(design: Design) -> Any:
    """Return the chart as a Matplotlib figure."""
    rows = len(design.rpms) + 1
    height = TITLE + PANEL + AXIS + HEAD + CELL * rows + NOTE
    figure = figures.blank((WIDTH, height), dpi=150)
    width = (WIDTH - LEFT - RIGHT - BETWEEN) / 2.0
    bottom = height - TITLE - PANEL
    left, right = (
        figure.add_axes((x / WIDTH, bottom / height, width / WIDTH, PANEL / height))
        for x in (LEFT, LEFT + width + BETWEEN)
    )
    _errors(left, design)
    _volume(right, design)
    _table(figure.add_axes((EDGE / WIDTH, NOTE / height, TABLE / WIDTH, CELL * rows / height)), design)
    _words(figure, design, height)
    return figure


def _words(figure: Any, design: Design, height: float) -> None:
    """Write headline and note of the chart."""
    camera, volume = design.camera, design.volume
    fov = 2.0 * math.degrees(math.atan(camera.width / 2.0 / camera.fx))
    figure.text(EDGE / WIDTH, (height - 0.3) / height, f"{camera.width}×{camera.height}, field of view {fov:.0f}°: "
                f"{headline(design)}", fontsize=LETTERS + 1.5, fontweight="bold", va="baseline")  # fmt: skip
    limits, timing = design.limits, design.timing
    note = (
        f"Limits: error {limits.tolerance_px:g} px, window {limits.window_ms:g} ms, edges displaced by "
        f"{LEAST_SWING:g} px in a quarter turn. Clock ± {timing.clock_us:g} µs, encoder "
        f"± {math.degrees(timing.encoder):.3g}°, index {design.glass.index:g}.\n"
        "Models: rms distance of the best fit from the exact model over image and turn; the exact model has no error.\n"
        f"Events: simulated (rings) on {100 * volume.simulated / volume.pixels:.0f} % of the pixels, "
        f"± {100 * volume.uncertainty:.1g} %, threshold {volume.contrast:g}; interpolated between the rings."
    )
    if design.failed:
        note += f" Failed, and left out: {', '.join(design.failed)}."
    figure.text(EDGE / WIDTH, 0.1 / height, note, fontsize=TINY, color="#404040", va="bottom", linespacing=1.35)


def _errors(ax: Any, design: Design) -> None:
    """Draw the panel of errors over the apex angle."""
    rpm = design.chosen.rpm if design.chosen else design.rpms[len(design.rpms) // 2]
    apex = _degrees(design)
    names = []
    for model, colour in COLOURS.items():
        y = np.array([orbit.errors[model] for orbit in design.orbits])
        ax.plot(apex, np.where(y >= LOWEST_ERROR, y, np.nan), "-", marker=MARKS[model], color=colour, linewidth=1.6,
                markersize=6.0, zorder=3)  # fmt: skip
        if y[-1] >= LOWEST_ERROR:
            names.append((float(y[-1]), f"{model} model", colour))
    choices = [design.at(orbit.apex, rpm) for orbit in design.orbits]
    blur = np.array([c.blur_px for c in choices])
    ax.plot(apex, blur, "-", marker="D", color="black", linewidth=2.2, markersize=5.0, zorder=4)
    ax.plot(apex, [c.budget_px for c in choices], ":", color="black", linewidth=1.4)
    ax.axhline(design.limits.tolerance_px, color=CHOSEN, linestyle=(0, (6, 3)), linewidth=1.5)
    names.append((design.limits.tolerance_px, "tolerance", CHOSEN))
    names += [
        (float(blur[-1]), "blur without\nmodel error", "black"),
        (choices[-1].budget_px, "model budget", "black"),
    ]
    ax.set_title(f"Error after compensation, at {rpm:g} rpm", fontsize=LETTERS, loc="left", pad=8.0)
    ax.set_ylabel("error [px]", fontsize=LETTERS)
    values = [v for v, _, _ in names] + [o.errors[m] for o in design.orbits for m in COLOURS]
    _axes(ax, design, (0.7 * max(min(values), LOWEST_ERROR), max(values)))
    _name(ax, names)


def _volume(ax: Any, design: Design) -> None:
    """Draw the panel of event rates over the apex angle."""
    from matplotlib import colormaps

    apex, rpms, low = _degrees(design), design.rpms, math.inf
    names: list[tuple[float, str, Any]] = []
    for k, rpm in enumerate(rpms):
        # cividis also reads from dark to light in grey; its light end is too faint on white
        colour = colormaps["cividis"](0.72 * k / max(len(rpms) - 1, 1))
        y = np.array([design.at(orbit.apex, rpm).events_per_s for orbit in design.orbits]) / 1e6
        ax.plot(apex, y, "-", marker=".", color=colour, linewidth=1.8, markersize=8.0)
        names.append((float(y[-1]), f"{rpm:g} rpm", colour))
        low = min(low, float(y.min()))
        if rpm in design.volume.rpms:
            at = np.degrees(design.volume.apexes)
            ax.plot(at, np.exp(np.interp(np.log(at), np.log(apex), np.log(y))), "o", color=colour, markersize=9.5,
                    markerfacecolor="none", markeredgewidth=1.3)  # fmt: skip
    high = max(v for v, _, _ in names)
    if design.limits.bandwidth is not None:
        ax.axhline(design.limits.bandwidth / 1e6, color=CHOSEN, linestyle=(0, (6, 3)), linewidth=1.5)
        names.append((design.limits.bandwidth / 1e6, "bandwidth", CHOSEN))
        low, high = min(low, names[-1][0]), max(high, names[-1][0])
    ax.set_title("Event volume", fontsize=LETTERS, loc="left", pad=8.0)
    ax.set_ylabel("million events/s", fontsize=LETTERS)
    _axes(ax, design, (0.6 * low, high))
    _name(ax, names)
    if design.chosen is not None:
        c = design.chosen
        ax.plot([math.degrees(c.orbit.apex)], [c.events_per_s / 1e6], "o", markersize=17, markerfacecolor="none",
                markeredgecolor=CHOSEN, markeredgewidth=2.2, zorder=5)  # fmt: skip


def _axes(ax: Any, design: Design, values: tuple[float, float]) -> None:
    """Set up scales, ticks and shaded ranges of a panel."""
    apex = _degrees(design)
    limits = values[0], values[0] * (values[1] / values[0]) ** (1.0 / HIGHEST)
    spare = 1.18 if len(apex) > 1 else 1.6
    ax.set(xscale="log", yscale="log", xlim=(apex[0] / spare, apex[-1] * spare), ylim=limits)
    ax.set_xticks(apex, [degrees(orbit.apex) for orbit in design.orbits])
    ax.set_xticks([], minor=True)
    figures.number_logarithmic(ax.yaxis)
    ax.tick_params(which="both", labelsize=SMALL)
    ax.grid(True, color="#e6e6e6", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.set_xlabel("apex", fontsize=LETTERS)
    smallest = math.degrees(design.range_at(design.rpms[0])[0])
    if smallest > ax.get_xlim()[0]:
        ax.axvspan(ax.get_xlim()[0], min(smallest, ax.get_xlim()[1]), color=SHORT, linewidth=0, zorder=0)
        ax.text(0.02, 0.975, "too small:\nsome edges\nmove < 1 px", transform=ax.transAxes, va="top", fontsize=TINY,
                color="#404040", zorder=6, linespacing=1.25)  # fmt: skip
    if design.chosen is not None:
        ax.axvline(math.degrees(design.chosen.orbit.apex), color=CHOSEN, linewidth=5.0, alpha=0.25, zorder=1)


def _name(ax: Any, names: Sequence[tuple[float, str, Any]]) -> None:
    """Write the name of each line at its right end; names close to each other are moved apart."""
    low, high = (math.log(v) for v in ax.get_ylim())
    inside = sorted((n for n in names if low <= math.log(n[0]) <= high), key=lambda n: n[0])
    at = np.array([(math.log(value) - low) / (high - low) for value, _, _ in inside])
    tall = np.array([1.25 * TINY * (text.count("\n") + 1) / 72.0 / PANEL for _, text, _ in inside])
    need = (tall[1:] + tall[:-1]) / 2.0
    spots = at.copy()
    for _ in range(300):
        for k, gap in enumerate(need):
            lack = gap - (spots[k + 1] - spots[k])
            if lack > 0.0:
                spots[k] -= lack / 2.0
                spots[k + 1] += lack / 2.0
        spots = np.clip(spots, 0.02, 0.98)
    for (_, text, colour), y, spot in zip(inside, at, spots, strict=True):
        ax.annotate(text, (1.0, y), (1.055, spot), xycoords="axes fraction", textcoords="axes fraction",
                    fontsize=TINY, color=colour, va="center", linespacing=1.1, annotation_clip=False,
                    arrowprops={"arrowstyle": "-", "linewidth": 0.7, "color": colour, "shrinkA": 1.0,
                                "shrinkB": 0.0, "relpos": (0.0, 0.5)})  # fmt: skip


def _table(ax: Any, design: Design) -> None:
    """Draw a cell for every choice."""
    from matplotlib.patches import Rectangle

    ax.set(frame_on=False, xticks=(), yticks=())
    ax.set_title("Every choice: events, remaining error, and smallest sufficient model or violated limits",
                 fontsize=LETTERS, loc="left")  # fmt: skip
    choices = [[design.at(orbit.apex, rpm) for orbit in design.orbits] for rpm in design.rpms]
    texts = [[f"{rpm:g} rpm,\n{15e3 / rpm:.1f} ms", *map(_words_of, row)]
             for rpm, row in zip(design.rpms, choices, strict=True)]  # fmt: skip
    heads = [
        f"apex {degrees(o.apex)}, orbit {o.radius:.1f} px\ndisplaces edges {o.swing:.2f} px" for o in design.orbits
    ]
    first, wide, high = FIRST / TABLE, (1.0 - FIRST / TABLE) / len(heads), 1.0 / (len(texts) + 1)
    table = ax.table(texts, colLabels=["speed,\nquarter turn", *heads], cellLoc="center", bbox=(0.0, 0.0, 1.0, 1.0),
                     colWidths=[first, *[wide] * len(heads)])  # fmt: skip
    table.set_fontsize(TINY)
    table.auto_set_font_size(True)
    for (j, k), cell in table.get_celld().items():
        cell.PAD = 0.03
        cell.set(edgecolor="white", linewidth=4.0)
        if j and k:
            choice = choices[j - 1][k - 1]
            cell.set_facecolor(BAD if choice.misses else GOOD)
            cell.get_text().set(color="#6a6a6a" if choice.misses else "black")
            if choice is design.chosen:
                cell.get_text().set(fontweight="bold")
                corner = (first + (k - 1) * wide, 1.0 - (j + 1) * high)
                ax.add_patch(Rectangle(corner, wide, high, fill=False, edgecolor=CHOSEN, linewidth=2.4,
                                       transform=ax.transAxes, clip_on=False))  # fmt: skip


def _words_of(choice: Choice) -> str:
    """Return the text of a cell of the table."""
    words = f"violates {', '.join(choice.misses)}" if choice.misses else choice.model
    return f"{choice.events_per_s / 1e6:.3g} Mev/s, {choice.error_px:.2f} px\n{words}"


def _degrees(design: Design) -> list[float]:
    """Return the apex angles of a design [deg]."""
    return [math.degrees(orbit.apex) for orbit in design.orbits]
