"""Comparison of moving optics for a camera: wedge, pair, mirror, vibrating camera and plate, with a chart.

All optics move the image as far as one wedge does, that of a design study, and as often where they can. All numbers
come from their exact models.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from textwrap import fill
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.depths import SMALLEST_PX
from amiwarp.calib.model_choice import QUANTISATION_PX
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.palette import BLACK
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import LARGEST_INVERSE_DEPTH, ExactModel, Model, PlateModel, RisleyModel
from amiwarp.optics.prism import LARGEST_THICKNESS, Plate, Prism
from amiwarp.plotting import figures
from amiwarp.simulation.description import Mirror, PrismMotion, Scene, Vibration
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.world import Body, Material, Mesh, Trajectory, World, WorldScene
from amiwarp.studies.design import (
    ACROSS_IMAGE,
    BAD,
    CHOSEN,
    DOWN_IMAGE,
    EDGE,
    GOOD,
    LEAST_SWING,
    LETTERS,
    TABLE,
    TINY,
    TURN_ANGLES,
    WIDTH,
    Choice,
    Design,
    degrees,
    filled,
    image_grid,
    paths,
    radii_of,
    rate,
    simulated_yield,
    slopes_of,
    texture_of,
    tiles,
)
from amiwarp.studies.failures import noted
from amiwarp.tasks import Progress, silent

# The optics and their motions.

UNEQUAL = Fraction(-1, 2)
"""Speed of the second wedge of a pair relative to the first, for unequal speeds."""
LISSAJOUS = Fraction(4, 3)
"""Frequency of a mirror's second tilt relative to the first, for unequal frequencies."""
ELLIPSE = 1.0 / 3.0
"""Radius of a vibration's backward circle relative to the forward one: an ellipse of two to one."""
SLOWEST_VIBRATION = 20.0
"""Lowest frequency at which the calibration of vibrations was measured [Hz]."""
PLATE_TILT = math.radians(45.0)
"""Tilt of the plate [rad]."""
SIZING_STEPS = 4
"""Number of steps that find the size of an optic for a radius, which is nearly proportional to it."""


@dataclass(frozen=True, slots=True)
class Setting:
    """An optic and its motion."""

    name: str
    """Name of optic and motion."""
    optic: Prism | Plate | Mirror | Vibration
    """What moves the image."""
    hz: float
    """Speed of its first angle [turns/s]."""
    size: str
    """Size of the optic, in words."""
    ratio: Fraction = Fraction(1)
    """Speed of its second angle relative to the first."""
    inverse_depth: float = 0.0
    """Inverse depth of the scene, for a plate [1/m]."""

    NEEDS: ClassVar[dict[str, tuple[str, str, str]]] = {
        "wedge": ("one wedge", "motor", "encoder"),
        "pair": ("two wedges", "two motors, or gears", "two encoders"),
        "mirror": ("mirror", "two-axis drive", "both commands"),
        "vibration": ("none", "unbalanced motor", "events alone"),
        "plate": ("thick plate", "motor", "encoder"),
    }
    """What each kind of optic needs: glass, drive, and what its state is known from."""

    @property
    def kind(self) -> str:
        """Kind of the optic, one of :attr:`NEEDS`."""
        return self.name.partition(",")[0]

    @property
    def turns(self) -> int:
        """Turns of the first angle after which the motion repeats."""
        return self.ratio.denominator

    @property
    def motion(self) -> PrismMotion:
        """Motion of the glass."""
        rpm = 60.0 * self.hz
        pair = isinstance(self.optic, Prism) and self.optic.second is not None
        return PrismMotion(rpm, second=PrismMotion(rpm * float(self.ratio)) if pair else None)

    def model(self, camera: Camera) -> Model:
        """Return the exact model of the optic."""
        if isinstance(self.optic, Plate):
            return PlateModel(camera, self.optic, inverse_depth=self.inverse_depth)
        if not isinstance(self.optic, Prism):
            return self.optic.model(camera)
        if self.optic.second is not None:
            return RisleyModel(camera, self.optic, ratio=float(self.ratio))
        return ExactModel(camera, self.optic)

    def speeds(self, model: Model) -> NDArray[np.float64]:
        """Return the speeds of the model's angles [rad/s]."""
        return np.array([1.0, float(self.ratio)][: model.ANGLES]) * math.tau * self.hz


def settings(
    camera: Camera, glass: Prism, apex: float, hz: float, depths: Sequence[float], failed: dict[str, str]
) -> list[Setting]:
    """Return a wedge, and all other optics in sizes that move the image as far as the wedge, rms over the image.

    ``glass``: index and flat side; ``apex``: apex angle of the wedge [rad]; ``hz``: its speed [turns/s]; ``depths``:
    depths of the scene for the plate [m]. The plate moves the scene at the nearest of them as far as the wedge.
    Optics of which no size does so are noted in ``failed``. Raises :class:`AmiwarpError` if no plate does so.
    """

    def wedges(*apexes: float) -> Prism:
        first, *others = (Prism(apex, glass.index, glass.flat_side) for apex in apexes)
        return Prism(first.apex, glass.index, glass.flat_side, *others)

    def pair(name: str, ratio: Fraction) -> Callable[[float], Setting]:
        return lambda size: Setting(f"pair, {name}", wedges(size, size), hz, f"2 × {degrees(size)}", ratio)

    def mirror(name: str, ratio: Fraction, phase: float) -> Callable[[float], Setting]:
        def made(size: float) -> Setting:
            optic = Mirror((hz, hz * float(ratio)), (size, size), (0.0, phase))
            return Setting(f"mirror, {name}", optic, hz, f"± {degrees(size)}", ratio)

        return made

    def vibration(size: float) -> Setting:
        often = max(hz, SLOWEST_VIBRATION)
        axes = [degrees(size * (1.0 + sign * ELLIPSE)) for sign in (1.0, -1.0)]
        return Setting("vibration", Vibration(often, size, 0.0, (ELLIPSE * size, 0.0)), often,
                       f"{axes[0]} × {axes[1]}")  # fmt: skip

    def plate(depth: float) -> Callable[[float], Setting]:
        def made(thickness: float) -> Setting:
            if thickness > LARGEST_THICKNESS:
                raise AmiwarpError(
                    f"to move a scene at {depth:g} m as far as the wedge, the plate would have to be "
                    f"{1e3 * thickness:.0f} mm thick; the limit is {1e3 * LARGEST_THICKNESS:.0f} mm; give a nearer "
                    "depth (--depth-m), or a smaller apex"
                )
            optic = Plate(thickness, PLATE_TILT, glass.index)
            return Setting(f"plate, {depth:g} m", optic, hz, f"{1e3 * thickness:.1f} mm, 45°", Fraction(1), 1.0 / depth)

        return made

    wedge = Setting("wedge", wedges(apex), hz, degrees(apex))
    radius = _rms(wedge, camera)
    angle = radius / camera.fx
    unit = Plate(1e-3, PLATE_TILT, glass.index).shift * 1e3
    nearest = min(depths)
    quarter = 0.5 * math.pi
    found = [wedge]
    lissajous = f"{LISSAJOUS.denominator}:{LISSAJOUS.numerator}"
    for name, make, start in (
        ("pair, opposite", pair("opposite", Fraction(-1)), apex / math.sqrt(2.0)),
        ("pair, unequal", pair("unequal", UNEQUAL), apex / math.sqrt(2.0)),
        ("mirror, circle", mirror("circle", Fraction(1), quarter), 0.5 * angle),
        (f"mirror, {lissajous}", mirror(lissajous, LISSAJOUS, quarter), 0.5 * angle),
        ("vibration", vibration, angle),
    ):
        with noted(failed, name):
            found.append(_sized(make, start, camera, radius))
    glass_plate = _sized(plate(nearest), angle * nearest / unit, camera, radius).optic
    assert isinstance(glass_plate, Plate)
    return [*found, *(plate(depth)(glass_plate.thickness) for depth in sorted(depths))]


def _sized(make: Callable[[float], Setting], size: float, camera: Camera, radius: float) -> Setting:
    """Return the optic whose size moves the image by a radius [px rms], starting from a size near it."""
    for _ in range(SIZING_STEPS):
        size *= radius / _rms(make(size), camera)
    return make(size)


def _rms(setting: Setting, camera: Camera) -> float:
    """Return the distance of the paths from their middles [px], rms over the image and time."""
    moved = paths(setting.model(camera), image_grid(camera), TURN_ANGLES, setting.turns)
    return float(np.sqrt(np.nanmean(radii_of(moved) ** 2)))


# Extent of the motion, and displacement of edges across themselves.

PATH_ANGLES = 97
"""Number of angles per turn at which edges are followed: a prime, so that the starts differ from the directions."""
DIRECTIONS = 180
"""Number of edge directions."""
ACROSS_EDGES, DOWN_EDGES = 9, 7
"""Number of columns and rows of the grid of pixels at which edges are followed."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """How far a motion displaces edges across themselves."""

    swing: float
    """Smallest displacement across an edge within the window [px]: over directions, starts and the image."""
    complete: float
    """Shortest time in which edges of every direction are displaced by :data:`LEAST_SWING` [turns]; infinite if some
    never are."""
    left_out: float
    """Share of the edge directions that are never displaced by :data:`LEAST_SWING`, mean over the image."""
    blind: float
    """Direction in the image of the edges that are displaced least during the whole motion [rad], 0 to π from x."""


def coverage(moved: NDArray[np.float64], window: float) -> Coverage:
    """Return how far paths displace edges across themselves.

    ``moved``: closed paths of pixels, :data:`PATH_ANGLES` points a turn, shape (pixels, angles, 2); ``window``: time in
    which edges have to be displaced [turns].
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    normals = np.arange(DIRECTIONS) * (np.pi / DIRECTIONS)
    across = moved @ np.stack([np.cos(normals), np.sin(normals)])
    whole = np.ptp(across, axis=1)
    count = moved.shape[1]

    def least(steps: int) -> float:
        if steps >= count:
            return float(whole.min())
        high, low = (each(across, steps + 1, axis=1, mode="wrap") for each in (maximum_filter1d, minimum_filter1d))
        return float((high - low).min())

    steps = window * PATH_ANGLES
    low = math.floor(steps)
    swing = least(low) + (steps - low) * (least(low + 1) - least(low))
    left_out, blind = float((whole < LEAST_SWING).mean()), float(normals[whole.mean(axis=0).argmin()])
    complete = math.inf
    if whole.min() >= LEAST_SWING:
        few, enough = 0, count  # the displacement grows with the number of steps
        while enough - few > 1:
            middle = (few + enough) // 2
            few, enough = (few, middle) if least(middle) >= LEAST_SWING else (middle, enough)
        short, long = least(few), least(enough)
        complete = (few + (LEAST_SWING - short) / (long - short)) / PATH_ANGLES
    return Coverage(swing, complete, left_out, (blind + 0.5 * math.pi) % math.pi)


# Speed of the motion: blur by errors of clock and angle, and events.

ANGLE_STEP = 0.2
"""Half of the angle over which derivatives with respect to an angle are difference quotients [rad]. They are exact for
harmonics."""


def flow_of(model: Model, pixels: NDArray[np.float64], turns: int) -> NDArray[np.float64]:
    """Return how fast the image moves with each angle of a model [px/rad], shape (angles, pixels, times, 2).

    The times are :data:`TURN_ANGLES` a turn of the first angle. Pixels without a ray are NaN.
    """
    theta = np.arange(TURN_ANGLES * turns) * (math.tau / TURN_ANGLES)
    angles = model.all_angles(np.tile(theta, len(pixels)))
    xy = np.repeat(pixels, len(theta), axis=0)

    def at(moved: NDArray[np.float64]) -> NDArray[np.float64]:
        return model.compensate_points(xy, moved if model.ANGLES > 1 else moved[:, 0])

    steps = ANGLE_STEP * np.eye(model.ANGLES)
    found = [(at(angles + step) - at(angles - step)) / (2.0 * math.sin(ANGLE_STEP)) for step in steps]
    return np.reshape(found, (model.ANGLES, len(pixels), len(theta), 2))


def across_edges(error: NDArray[np.float64], flow: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean square of errors across the edges that fire, for edges of all directions, shape (pixels,).

    An edge fires at the rate at which ``flow`` (pixels, times, 2) crosses it, which is c for an edge whose normal has
    the cosine c with it. ⟨c³⟩ / ⟨c⟩ is 2/3 of the part of an ``error`` along the flow, and ⟨c s²⟩ / ⟨c⟩ is 1/3 of that
    across it.
    """
    speed = np.linalg.norm(flow, axis=2)
    along = np.sum(error * flow, axis=2) / np.maximum(speed, 1e-12)
    square = (np.sum(error**2, axis=2) + along**2) / 3.0
    return np.asarray(np.sum(speed * square, axis=1) / np.maximum(np.sum(speed, axis=1), 1e-12))


def change_of(
    flow: NDArray[np.float64], slopes: tuple[NDArray[Any], NDArray[Any]], camera: Camera
) -> NDArray[np.float64]:
    """Return the distance by which the log intensity of each pixel goes up and down [1/s], shape (height, width).

    ``flow``: velocity of the image on the grid of :func:`image_grid` [px/s], shape (pixels, times, 2); ``slopes``:
    gradient of log intensity along y and x [1/px]. The change is the mean of |∇L · v|. On circles it is 4 r |∇L| a
    turn.
    """
    field = np.nan_to_num(flow).reshape(DOWN_IMAGE, ACROSS_IMAGE, -1, 2)
    rows, columns = _interpolation(camera.height, DOWN_IMAGE), _interpolation(camera.width, ACROSS_IMAGE)
    total = np.zeros((camera.height, camera.width))
    for velocity in np.moveaxis(field, 2, 0):
        across, down = (rows @ velocity[..., k] @ columns.T for k in (0, 1))
        total += np.abs(across * slopes[1] + down * slopes[0])
    return total / field.shape[2]


def _interpolation(count: int, nodes: int) -> NDArray[np.float64]:
    """Return the matrix (count, nodes) that interpolates linearly between evenly spaced nodes, first to last pixel."""
    at = np.linspace(0.0, nodes - 1.0, count)
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(nodes)))


# Depth by a plate.

WALL_BLUR = 0.8
"""Blur of a wall seen by rays relative to that of the same picture at infinity: the levels of its texture blur it, too.
With it, the mean gradients of four pictures are within 5 % of those of the pictures at infinity."""
DEPTH_STEP = 0.05
"""Relative step of the inverse depth for the derivative of the image with respect to it."""


def depth_deviation(model: PlateModel, noise: float) -> float:
    """Return the relative standard deviation of the depth of an edge, by one turn and one pixel of its length.

    ``noise``: standard deviation of the place of an event across the edge [px]. The edge causes one event at each pixel
    that it crosses. A fit of inverse depth and of the place of the edge at rest, by least squares, has this deviation.
    It is the rms over the image and over the directions of edges.
    """
    pixels, rho = image_grid(model.camera), model.inverse_depth
    (flow,) = flow_of(model, pixels, 1)
    nearer, farther = (
        paths(PlateModel(model.camera, model.plate, model.phase, rho * scale), pixels, TURN_ANGLES)
        for scale in (1.0 + DEPTH_STEP, 1.0 - DEPTH_STEP)
    )
    normals = np.arange(DIRECTIONS) * (np.pi / DIRECTIONS)
    normal = np.stack([np.cos(normals), np.sin(normals)])
    moved = (nearer - farther) @ normal / (2.0 * DEPTH_STEP)  # for the logarithm of the inverse depth
    events = np.abs(flow @ normal) * (math.tau / TURN_ANGLES)
    count = events.sum(axis=1)
    spread = (events * moved**2).sum(axis=1) - (events * moved).sum(axis=1) ** 2 / count
    return noise * math.sqrt(float(np.nanmean(1.0 / spread)))


def wall(scene: Scene, depth: float) -> WorldScene:
    """Return a world that shows the first picture of a scene with a field of view on a wall at a depth [m]."""
    assert scene.fov is not None
    _, picture = next(scene.frames.read())
    right = depth * math.tan(scene.fov / 2.0)
    top = right * picture.shape[0] / picture.shape[1]
    corners = [(-right, depth, -top), (right, depth, -top), (right, depth, top), (-right, depth, top)]
    mesh = Mesh(corners, [[0, 1, 2], [0, 2, 3]], uv=[[0, 0], [1, 0], [1, 1], [0, 1]])
    world = World("wall", (Body("wall", mesh, Material(1.0, picture)),), ambient=1.0)
    return WorldScene(world, Trajectory.still([0, 0, 0], look_at=[0, 1, 0]), WALL_BLUR * scene.blur)


# The comparison.

TIE = 0.05
"""Relative difference up to which the first of two optics in the list, which is the simpler one, is recommended."""


@dataclass(frozen=True, eq=False)
class Compared:
    """Predicted properties of one optic, and the limits that it violates."""

    setting: Setting
    """The optic and its motion."""
    radius: float
    """Distance of the paths from their middles [px], rms over image and time: of circles, their radius."""
    smallest: float
    """The smallest such distance of a pixel [px]."""
    coverage: Coverage
    """Displacement of edges across themselves; times are in turns of the first angle."""
    clock_px: float
    """Blur across an edge caused by the clock error [px]."""
    encoder_px: float
    """Blur across an edge caused by the error of each measured angle [px]; 0 without an encoder."""
    events_per_s: float
    """Event rate by the law of the event volume [events/s]."""
    simulated_per_s: float
    """Event rate by a simulation of the tiles [events/s]."""
    uncertainty: float
    """Relative standard error of the simulated event rate."""
    depth_deviation: float | None
    """Relative standard deviation of the depth of an edge, by one turn and one pixel of its length; None if the optic
    does not determine depth."""
    path: NDArray[np.float64]
    """Path of what the middle of the image sees [px], from its middle, shape (angles, 2)."""
    misses: tuple[str, ...]
    """Names of the violated limits: ``edges``, ``blur`` and ``bandwidth``."""

    @property
    def blur_px(self) -> float:
        """Blur across an edge that compensation by the exact model leaves [px]."""
        return math.sqrt(QUANTISATION_PX**2 + self.clock_px**2 + self.encoder_px**2)

    @property
    def complete_ms(self) -> float:
        """Shortest time in which edges of every direction are displaced by :data:`LEAST_SWING` [ms], or infinity."""
        return 1e3 * self.coverage.complete / self.setting.hz

    @property
    def events_per_s_px(self) -> float:
        """Event rate for each pixel of the smallest displacement across an edge [events/s/px].

        It is infinite if some edges are never displaced.
        """
        return math.inf if self.coverage.left_out > 0.0 else self.events_per_s / self.coverage.swing

    @property
    def deviation(self) -> float:
        """Relative deviation of the law's event rate from the simulated one."""
        return self.events_per_s / self.simulated_per_s - 1.0


@dataclass(frozen=True, eq=False)
class Advice:
    """Recommendation for a task."""

    task: str
    """The task: ``blur``, ``events``, ``directions`` or ``depth``."""
    chosen: Compared | None
    """Recommended optic; None if no optic does the task."""
    why: str
    """Reason, in words."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Predicted properties of moving optics, all in sizes that move the image as far as one wedge."""

    design: Design
    """Design study that gives camera, sensor, limits and the law of the event volume."""
    reference: Choice
    """Wedge and speed whose radius and speed the optics have."""
    results: tuple[Compared, ...]
    """The optics, simplest first."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """Error of each optic that could not be compared, by its name."""

    @cached_property
    def advice(self) -> tuple[Advice, ...]:
        """Recommendation for each task: the simplest optic whose value is within :data:`TIE` of the best.

        Optics that violate a limit are left out. A plate, which moves near points only, is recommended for depth alone.
        Events are compared for equal displacements of edges, as each optic could be made smaller down to the limit.
        """
        return (
            self._best("blur", " across an edge", lambda r: r.blur_px, lambda r: f"{r.blur_px:.3f} px"),
            self._best(
                "events", " for each px that all edges move", lambda r: r.events_per_s_px,
                lambda r: rate(r.events_per_s_px),
            ),
            self._best(
                "directions", f" across every edge in {self.design.limits.window_ms:g} ms",
                lambda r: 1.0 / r.coverage.swing, lambda r: f"{r.coverage.swing:.2f} px",
            ),
            self._depth(),
        )  # fmt: skip

    def _best(
        self, task: str, what: str, cost: Callable[[Compared], float], text: Callable[[Compared], str]
    ) -> Advice:  # fmt: skip
        """Return the recommendation of the first optic whose cost is within :data:`TIE` of the least.

        ``text`` gives the value of an optic in words, ``what`` tells what is meant.
        """
        kept = [r for r in self.results if not r.misses and r.setting.kind != "plate"]
        if not kept:
            return Advice(task, None, "no optic keeps all limits")

        def words(r: Compared) -> str:
            other = "" if r.setting.hz == self.reference.rpm / 60.0 else f" at {r.setting.hz:g} turns/s"
            return text(r) + other

        ranked = sorted(kept, key=cost)
        chosen = next(r for r in kept if cost(r) <= (1.0 + TIE) * cost(ranked[0]))
        why = f"{words(chosen)}{what}, the best of {len(kept)} optics that keep all limits"
        if chosen is not ranked[0]:
            why = f"{words(chosen)}{what}, and no optic that keeps all limits is better by over {100 * TIE:g} %"
        others = ", ".join(f"{r.setting.name.replace(', ', ' ')} {words(r)}" for r in ranked if r is not chosen)
        return Advice(task, chosen, f"{why}; {others}" if others else why)

    def _depth(self) -> Advice:
        """Return the recommendation for depth."""
        plates = [r for r in self.results if r.setting.kind == "plate"]
        able = [r for r in plates if r.depth_deviation is not None]
        turning = "all other optics turn rays, which moves near and far points alike, and leave depth undetermined"
        if not plates:
            return Advice("depth", None, f"no plate could be compared; {turning}")
        if not able:
            return Advice("depth", None, f"at every depth the orbit is under {SMALLEST_PX:g} px; {turning}")
        values = []
        for r in plates:
            found = f"orbit of {r.radius:.2f} px, too small"
            if r.depth_deviation is not None:
                found = f"± {100 * r.depth_deviation:.2g} %"
            values.append(f"{r.setting.name.partition(', ')[2]} {found}")
        return Advice("depth", able[0], f"{', '.join(values)} by one turn and one pixel of an edge; {turning}")


def compare(
    design: Design,
    scene: Scene,
    *,
    depths: Sequence[float] = (0.5, 1.0, 2.0),
    sensor: SensorModel | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Comparison:
    """Compare moving optics for the camera of a design study, in front of the same scene and with the same sensor.

    Size and speed are those of :func:`reference_of`. ``depths`` are those of the scene for the plate [m]. An optic that
    fails is noted, and the others are compared. Raises :class:`AmiwarpError` for impossible depths, and if every optic
    fails.
    """
    depths = sorted(set(depths))
    if not (depths and depths[0] >= 1.0 / LARGEST_INVERSE_DEPTH and depths[-1] < math.inf):
        raise AmiwarpError(f"depths {depths} m: give at least one, each {1.0 / LARGEST_INVERSE_DEPTH:g} m or more")
    camera, report, sensor = design.camera, progress or silent, sensor or SensorModel()
    reference = reference_of(design)
    failed: dict[str, str] = {}
    found = settings(camera, design.glass, reference.orbit.apex, reference.rpm / 60.0, depths, failed)
    largest = Prism(design.orbits[-1].apex, design.glass.index, design.glass.flat_side)
    template = Simulation(filled(scene, camera, largest), camera, design.glass, 1.0, sensor=sensor, seed=seed,
                          device=device)  # fmt: skip
    change = float(change_of(_velocity(found[0], camera), slopes_of(template.log_view()), camera).mean())
    scale = 4.0 * reference.orbit.radius * design.volume.texture * found[0].hz / change
    results: list[Compared] = []
    for k, setting in enumerate(found):
        report(f"simulating {setting.name}", k / len(found))
        with noted(failed, setting.name):
            results.append(_compared(design, reference, setting, template, scale))
    if not results:
        raise AmiwarpError("; ".join(f"{name}: {said}" for name, said in failed.items()))
    return Comparison(design, reference, tuple(results), failed)


def _velocity(setting: Setting, camera: Camera) -> NDArray[np.float64]:
    """Return the velocity of the image on the grid of :func:`image_grid` [px/s], shape (pixels, times, 2)."""
    model = setting.model(camera)
    return np.tensordot(setting.speeds(model), flow_of(model, image_grid(camera), setting.turns), axes=1)


def reference_of(design: Design) -> Choice:
    """Return the wedge and speed with which optics are compared: those that the study recommends.

    If no choice keeps all limits, it is the one that violates fewest, and of these the one with the fewest events.
    """
    return design.chosen or min(design.choices, key=lambda c: (len(c.misses), c.events_per_s))


def _compared(
    design: Design, reference: Choice, setting: Setting, template: Simulation, scale: float
) -> Compared:  # fmt: skip
    """Return the predicted properties of one optic. ``scale``: see :func:`_event_rates`."""
    camera, limits = design.camera, design.limits
    model, pixels = setting.model(camera), image_grid(camera)
    radii = radii_of(paths(model, pixels, TURN_ANGLES, setting.turns))
    radii = radii[np.isfinite(radii)]
    radius = float(np.sqrt(np.mean(radii**2)))
    followed = paths(model, image_grid(camera, ACROSS_EDGES, DOWN_EDGES), PATH_ANGLES, setting.turns)
    followed = followed[np.isfinite(followed).all(axis=(1, 2))]
    covered = coverage(followed, 1e-3 * limits.window_ms * setting.hz)

    flow, velocity = flow_of(model, pixels, setting.turns), _velocity(setting, camera)
    valid = np.isfinite(velocity).all(axis=(1, 2))
    by_clock = np.mean(across_edges(velocity[valid], velocity[valid]))
    by_angles = np.mean(sum(across_edges(one[valid], velocity[valid]) for one in flow))
    measured = not isinstance(setting.optic, Vibration)
    clock, encoder = design.timing.scaled(math.sqrt(by_clock), math.sqrt(by_angles) if measured else 0.0)

    noise = math.hypot(QUANTISATION_PX, clock, encoder)
    deviation = None
    if isinstance(model, PlateModel) and radius >= SMALLEST_PX:
        deviation = depth_deviation(model, noise)

    law, simulated, uncertainty = _event_rates(design, reference, setting, template, radius, scale)
    kept = {
        "edges": covered.swing >= LEAST_SWING,
        "blur": noise <= limits.tolerance_px,
        "bandwidth": limits.bandwidth is None or law <= limits.bandwidth,
    }
    middle = np.array([[(camera.width - 1) / 2.0, (camera.height - 1) / 2.0]])
    (path,) = paths(model, middle, PATH_ANGLES, setting.turns)
    return Compared(
        setting, radius, float(radii.min()), covered, clock, encoder, law, simulated, uncertainty, deviation,
        path - path.mean(axis=0), tuple(name for name, good in kept.items() if not good),
    )  # fmt: skip


def _event_rates(
    design: Design, reference: Choice, setting: Setting, template: Simulation, radius: float, scale: float
) -> tuple[float, float, float]:
    """Return the event rate by law and by simulation [events/s], and the relative standard error of the latter.

    The law has the yield of the wedge of the same ``radius`` [px rms] at the speed at which its image moves as fast.
    ``scale``: ratio of 4 r ⟨|∇L|⟩, to which the yields refer, to the change of log intensity by the reference.
    """
    volume, camera, scene = design.volume, design.camera, template.scene
    velocity = _velocity(setting, camera)
    assert isinstance(scene, Scene)
    speed = float(np.nanmean(np.linalg.norm(velocity, axis=2)))
    apex = reference.orbit.apex * radius / reference.orbit.radius
    found = volume.yield_at(apex, 60.0 * speed / (math.tau * radius))

    settling, counted = 1.0 / setting.hz, setting.turns / setting.hz  # [s]
    shown = wall(scene, 1.0 / setting.inverse_depth) if isinstance(setting.optic, Plate) else scene
    case = replace(template, scene=shown, prism=setting.optic, motion=setting.motion, duration_s=settling + counted)
    # a mirror shows the scene mirrored
    change = change_of(velocity, slopes_of((template if shown is not scene else case).log_view()), camera)
    parts = tiles(camera, template.seed)
    likely = texture_of(change, radius, camera, parts) * counted / volume.contrast
    ratio, error = simulated_yield(case, parts, likely, round(1e6 * settling), volume.noise_hz * counted)
    law, checked = (volume.of_image(each * float(change.mean()) / volume.contrast) for each in (scale * found, ratio))
    return law, checked, error


# The comparison in words.


def reasons(comparison: Comparison) -> list[str]:
    """Return the recommendations with their reasons, after what all optics have in common: one line of text each."""
    reference, limits = comparison.reference, comparison.design.limits
    because = "recommended" if comparison.design.chosen is not None else "nearest to the limits"
    same = (
        f"setting: the image moves by {reference.orbit.radius:.2f} px rms, as by the {because} wedge of "
        f"{degrees(reference.orbit.apex)} at {reference.rpm:g} rpm"
    )
    rules = [
        f"edges of every direction move by {LEAST_SWING:g} px in {limits.window_ms:g} ms",
        f"blur up to {limits.tolerance_px:g} px",
    ]
    if limits.bandwidth is not None:
        rules.append(f"up to {rate(limits.bandwidth)}")
    kept = f"limits: {', '.join(rules)}"
    if violated := [_violation(r) for r in comparison.results if r.misses]:
        kept += f"; violated by {'; '.join(violated)}"
    advice = [
        f"{a.task}: {'none' if a.chosen is None else a.chosen.setting.name.replace(', ', ' ')}: {a.why}"
        for a in comparison.advice
    ]
    return [same, kept, *advice, *(f"failed: {name}: {said}" for name, said in comparison.failed.items())]


def _violation(result: Compared) -> str:
    """Return which limits an optic violates, in words."""
    text = f"{result.setting.name.replace(', ', ' ')} ({', '.join(result.misses)}"
    covered = result.coverage
    if "edges" in result.misses:
        text += f": {covered.swing:.2f} px"
        if covered.left_out > 0.0:
            text += f", {100 * covered.left_out:.0f} % of the directions never, about {degrees(covered.blind)}"
    return text + ")"


# Chart of the comparison: path of each optic, and a table.

LABEL, PATHS, ROW, TOP, LINE = 1.15, 1.15, 0.42, 0.5, 0.19
"""Width of the column of labels, height of the drawn paths, heights of a row of the table, of the headline, and of a
line of text [inch]."""
REACH = 1.75
"""Half height of the panel of a drawn path, in radii of the motion."""
LETTERS_OF_CELL = 13
"""Largest number of letters on a line of a cell of words."""


def chart(comparison: Comparison) -> Any:
    """Return the chart as a Matplotlib figure: path of each optic, a table, and the recommendations."""
    rows, results, notes = _rows(comparison), comparison.results, _notes(comparison)
    below = LINE * len(notes) + 0.2
    height = TOP + PATHS + ROW * (len(rows) + 1) + below
    figure = figures.blank((WIDTH, height), dpi=150)
    camera = comparison.design.camera
    fov = 2.0 * math.degrees(math.atan(camera.width / 2.0 / camera.fx))
    figure.text(EDGE / WIDTH, 1.0 - 0.3 / height, f"{camera.width}×{camera.height}, field of view {fov:.0f}°: optics "
                f"that move the image by {comparison.reference.orbit.radius:.2f} px rms", fontsize=LETTERS + 1.5,
                fontweight="bold", va="baseline")  # fmt: skip
    width = (TABLE - LABEL) / len(results)
    for k, result in enumerate(results):
        left = EDGE + LABEL + k * width
        ax = figure.add_axes((left / WIDTH, 1.0 - (TOP + PATHS) / height, width / WIDTH, PATHS / height))
        _draw_path(ax, result, comparison)
    table = figure.add_axes((EDGE / WIDTH, below / height, TABLE / WIDTH, ROW * (len(rows) + 1) / height))
    _draw_table(table, comparison, rows)
    for k, text in enumerate(notes):
        figure.text(EDGE / WIDTH, (below - 0.25 - k * LINE) / height, text, fontsize=TINY, va="baseline",
                    fontweight="normal" if k else "bold", color="#404040" if k else BLACK)  # fmt: skip
    return figure


def _rows(comparison: Comparison) -> list[tuple[str, str, list[str]]]:
    """Return the rows of the chart's table: task that the row decides or "", label, and a text for each optic."""

    def complete(r: Compared) -> str:
        if math.isfinite(r.complete_ms):
            return f"{r.complete_ms:.1f} ms"
        return f"never: {100 * r.coverage.left_out:.0f} %\nof directions"

    def needs(which: int) -> Callable[[Compared], str]:
        return lambda r: fill(r.setting.NEEDS[r.setting.kind][which], LETTERS_OF_CELL)

    rows: list[tuple[str, str, Callable[[Compared], str]]] = [
        ("", "size", lambda r: r.setting.size),
        ("", "turns / s", lambda r: f"{r.setting.hz:.3g}"),
        ("", "motion, rms\nand smallest", lambda r: f"{r.radius:.2f} px\n{r.smallest:.2f} px"),
        ("directions", f"edges move in\n{comparison.design.limits.window_ms:g} ms by",
         lambda r: f"{r.coverage.swing:.2f} px"),
        ("", f"all move by\n{LEAST_SWING:g} px in", complete),
        ("blur", "blur, and\nwithout pixels",
         lambda r: f"{r.blur_px:.3f} px\n{math.hypot(r.clock_px, r.encoder_px):.3f} px"),
        ("", "events", lambda r: rate(r.events_per_s)),
        ("", "simulated", lambda r: f"{rate(r.simulated_per_s)}\n± {100 * r.uncertainty:.1g} %"),
        ("events", "events, if all\nmove by 1 px",
         lambda r: rate(r.events_per_s_px) if math.isfinite(r.events_per_s_px) else "impossible"),
        ("depth", "depth",
         lambda r: "not\ndetermined" if r.depth_deviation is None else f"± {100 * r.depth_deviation:.2g} %"),
        ("", "glass", needs(0)),
        ("", "drive", needs(1)),
        ("", "state from", needs(2)),
        ("", "violates", lambda r: ",\n".join(r.misses) or "none"),
    ]  # fmt: skip
    return [(task, name, [text(r) for r in comparison.results]) for task, name, text in rows]


def _notes(comparison: Comparison) -> list[str]:
    """Return the lines below the table: recommendations, then how to read it."""
    design = comparison.design
    advice = [f"{a.task}: {'none' if a.chosen is None else a.chosen.setting.name}" for a in comparison.advice]
    return [
        f"Recommended for {';  '.join(advice)}",
        *([f"Failed, and left out: {'; '.join(comparison.failed)}."] if comparison.failed else []),
        f"Paths: middle of the image; thick: {design.limits.window_ms:g} ms. Blur: across an edge; clock "
        f"± {design.timing.clock_us:g} µs, angles ± {math.degrees(design.timing.encoder):.3g}°. Events: law of the "
        f"event volume, threshold {design.volume.contrast:g}.",
        "Depth: standard deviation by one turn and one pixel of an edge. Blue: keeps the limits. Framed: recommended.",
    ]


def _draw_path(ax: Any, result: Compared, comparison: Comparison) -> None:
    """Draw the path of the middle of the image, and thicker the part that it takes within the window."""
    reach = REACH * comparison.reference.orbit.radius
    closed = np.concatenate([result.path, result.path[:1]])
    count = 2 + int(1e-3 * comparison.design.limits.window_ms * result.setting.hz * PATH_ANGLES)
    ax.plot(*closed.T, color="#9a9a9a", linewidth=1.2)
    ax.plot(*closed[:count].T, color=CHOSEN, linewidth=3.0, solid_capstyle="butt")
    ax.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", frame_on=False, xticks=(), yticks=())


def _draw_table(ax: Any, comparison: Comparison, rows: list[tuple[str, str, list[str]]]) -> None:
    """Draw a column for every optic."""
    from matplotlib.patches import Rectangle

    results = comparison.results
    ax.set(frame_on=False, xticks=(), yticks=(), xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    heads = [result.setting.name.replace(", ", ",\n") for result in results]
    first, high = LABEL / TABLE, 1.0 / (len(rows) + 1)
    wide = (1.0 - first) / len(results)
    table = ax.table([[name, *texts] for _, name, texts in rows], colLabels=["", *heads], cellLoc="center",
                     bbox=(0.0, 0.0, 1.0, 1.0), colWidths=[first, *[wide] * len(results)])  # fmt: skip
    table.auto_set_font_size(False)
    table.set_fontsize(TINY - 0.5)
    for (row, column), cell in table.get_celld().items():
        cell.PAD = 0.02
        cell.set(edgecolor="white", linewidth=3.0, facecolor="white")
        if row and column >= 1:
            cell.set_facecolor(BAD if results[column - 1].misses else GOOD)
    decided = [task for task, _, _ in rows]
    for advice in comparison.advice:
        if advice.chosen is not None:
            column, row = results.index(advice.chosen), decided.index(advice.task) + 1
            corner = (first + column * wide, 1.0 - (row + 1) * high)
            ax.add_patch(Rectangle(corner, wide, high, fill=False, edgecolor=CHOSEN, linewidth=2.4, zorder=5,
                                   transform=ax.transAxes, clip_on=False))  # fmt: skip
