"""Comparison of moving optics for a camera: wedge, pair, mirror, vibrating camera and plate, with a chart.

All optics move the image as far as one wedge of a design study does, and as often where they can. All numbers
come from their exact models.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.depths import SMALLEST_PX
from amiwarp.calib.timing_blur import QUANTISATION_PX
from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.plate import LARGEST_INVERSE_DEPTH, PlateModel
from amiwarp.optics.prism import Plate, Prism
from amiwarp.simulation.description import Scene
from amiwarp.simulation.motion import Vibration
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.design import Choice, Design
from amiwarp.studies.edge_coverage import ACROSS_EDGES, DOWN_EDGES, PATH_ANGLES, Coverage, coverage
from amiwarp.studies.event_volume import filled, simulated_yield, slopes_of, texture_of, tiles
from amiwarp.studies.failures import noted
from amiwarp.studies.image_flow import across_edges, change_of, flow_of
from amiwarp.studies.optic_settings import Setting, settings
from amiwarp.studies.orbits import LEAST_SWING, TURN_ANGLES, image_grid, paths, radii_of
from amiwarp.studies.plate_depth import depth_deviation, wall
from amiwarp.studies.quantities import rate
from amiwarp.tasks import Progress, silent

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
        if self.coverage.left_out > 0.0:
            return math.inf
        return self.events_per_s / self.coverage.swing

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
            self._best(
                "blur", " across an edge", lambda r: r.blur_px, lambda r: f"{r.blur_px:.3f} px"
            ),
            self._best(
                "events",
                " for each px that all edges move",
                lambda r: r.events_per_s_px,
                lambda r: rate(r.events_per_s_px),
            ),
            self._best(
                "directions",
                f" across every edge in {self.design.limits.window_ms:g} ms",
                lambda r: 1.0 / r.coverage.swing,
                lambda r: f"{r.coverage.swing:.2f} px",
            ),
            self._depth(),
        )

    def _best(
        self,
        task: str,
        what: str,
        cost: Callable[[Compared], float],
        text: Callable[[Compared], str],
    ) -> Advice:
        """Return the recommendation of the first optic whose cost is within :data:`TIE` of the least.

        ``text`` gives the value of an optic in words, ``what`` says what is meant.
        """
        kept = [r for r in self.results if not r.misses and r.setting.kind != "plate"]
        if not kept:
            return Advice(task, None, "no optic keeps all limits")

        def words(result: Compared) -> str:
            hz = result.setting.hz
            if hz == self.reference.rpm / 60.0:
                return text(result)
            return f"{text(result)} at {hz:g} turns/s"

        ranked = sorted(kept, key=cost)
        chosen = next(result for result in kept if cost(result) <= (1.0 + TIE) * cost(ranked[0]))
        why = f"{words(chosen)}{what}, the best of {len(kept)} optics that keep all limits"
        if chosen is not ranked[0]:
            why = f"{words(chosen)}{what}, and no optic that keeps all limits is better by over {100 * TIE:g} %"
        others = []
        for result in ranked:
            if result is not chosen:
                others.append(f"{result.setting.name.replace(', ', ' ')} {words(result)}")
        if others:
            why += f"; {', '.join(others)}"
        return Advice(task, chosen, why)

    def _depth(self) -> Advice:
        """Return the recommendation for depth."""
        plates = [r for r in self.results if r.setting.kind == "plate"]
        able = [r for r in plates if r.depth_deviation is not None]
        turning = "all other optics turn rays, which moves near and far points alike, and leave depth undetermined"
        if not plates:
            return Advice("depth", None, f"no plate could be compared; {turning}")
        if not able:
            return Advice(
                "depth", None, f"at every depth the orbit is under {SMALLEST_PX:g} px; {turning}"
            )
        values = []
        for plate in plates:
            found = f"orbit of {plate.radius:.2f} px, too small"
            if plate.depth_deviation is not None:
                found = f"± {100 * plate.depth_deviation:.2g} %"
            _, _, depth = plate.setting.name.partition(", ")
            values.append(f"{depth} {found}")
        return Advice(
            "depth", able[0], f"{', '.join(values)} by one turn and one pixel of an edge; {turning}"
        )


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

    Size and speed come from :func:`reference_of`. ``depths`` are the scene's for the plate [m]. An optic that fails is
    noted, and the others are compared. Raises :class:`AmiwarpError` for impossible depths, and if every optic fails.
    """
    depths = sorted(set(depths))
    if not (depths and depths[0] >= 1.0 / LARGEST_INVERSE_DEPTH and depths[-1] < math.inf):
        raise AmiwarpError(
            f"depths {depths} m: give at least one, each {1.0 / LARGEST_INVERSE_DEPTH:g} m or more"
        )
    camera = design.camera
    report = progress or silent
    sensor = sensor or SensorModel()
    reference = reference_of(design)
    failed: dict[str, str] = {}
    setting_list = settings(
        camera, design.glass, reference.orbit.apex, reference.rpm / 60.0, depths, failed
    )

    largest = Prism(design.orbits[-1].apex, design.glass.index, design.glass.flat_side)
    template = Simulation(
        filled(scene, camera, largest),
        camera,
        design.glass,
        1.0,
        sensor=sensor,
        seed=seed,
        device=device,
    )
    wedge = setting_list[0]
    change = change_of(_velocity(wedge, camera), slopes_of(template.log_view()), camera)
    mean_change = float(change.mean())
    scale = 4.0 * reference.orbit.radius * design.volume.texture * wedge.hz / mean_change

    results: list[Compared] = []
    for done, setting in enumerate(setting_list):
        report(f"simulating {setting.name}", done / len(setting_list))
        with noted(failed, setting.name):
            results.append(_compared(design, reference, setting, template, scale))
    if not results:
        raise AmiwarpError("; ".join(f"{name}: {message}" for name, message in failed.items()))
    return Comparison(design, reference, tuple(results), failed)


def _velocity(setting: Setting, camera: Camera) -> NDArray[np.float64]:
    """Return the velocity of the image on the grid of :func:`image_grid` [px/s], shape (pixels, times, 2)."""
    model = setting.model(camera)
    flow = flow_of(model, image_grid(camera), setting.turns)
    return np.tensordot(setting.speeds(model), flow, axes=1)


def reference_of(design: Design) -> Choice:
    """Return the wedge and speed with which optics are compared: the ones that the study recommends.

    If no choice keeps all limits, it is the one that violates fewest, and of these the one with the fewest events.
    """
    if design.chosen is not None:
        return design.chosen
    return min(design.choices, key=lambda choice: (len(choice.misses), choice.events_per_s))


def _compared(
    design: Design, reference: Choice, setting: Setting, template: Simulation, scale: float
) -> Compared:
    """Return the predicted properties of one optic. ``scale``: see :func:`_event_rates`."""
    camera = design.camera
    limits = design.limits
    model = setting.model(camera)

    # Extent of the motion
    pixels = image_grid(camera)
    radii = radii_of(paths(model, pixels, TURN_ANGLES, setting.turns))
    radii = radii[np.isfinite(radii)]
    radius = float(np.sqrt(np.mean(radii**2)))
    at_edges = image_grid(camera, ACROSS_EDGES, DOWN_EDGES)
    followed = paths(model, at_edges, PATH_ANGLES, setting.turns)
    followed = followed[np.isfinite(followed).all(axis=(1, 2))]
    covered = coverage(followed, 1e-3 * limits.window_ms * setting.hz)

    # Blur by the errors of clock and angles
    flow = flow_of(model, pixels, setting.turns)
    velocity = _velocity(setting, camera)
    valid = np.isfinite(velocity).all(axis=(1, 2))
    by_clock = np.mean(across_edges(velocity[valid], velocity[valid]))
    by_angles = np.mean(
        sum(across_edges(flow_of_angle[valid], velocity[valid]) for flow_of_angle in flow)
    )
    # Nothing measures the angles of a vibration.
    per_radian = 0.0 if isinstance(setting.optic, Vibration) else math.sqrt(by_angles)
    clock, encoder = design.timing.scaled(math.sqrt(by_clock), per_radian)

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
        setting,
        radius=radius,
        smallest=float(radii.min()),
        coverage=covered,
        clock_px=clock,
        encoder_px=encoder,
        events_per_s=law,
        simulated_per_s=simulated,
        uncertainty=uncertainty,
        depth_deviation=deviation,
        path=path - path.mean(axis=0),
        misses=tuple(name for name, good in kept.items() if not good),
    )


def _event_rates(
    design: Design,
    reference: Choice,
    setting: Setting,
    template: Simulation,
    radius: float,
    scale: float,
) -> tuple[float, float, float]:
    """Return the event rate by law and by simulation [events/s], and the simulated rate's relative standard error.

    The law has the yield of the wedge of the same ``radius`` [px rms] at the speed at which its image moves as fast.
    ``scale``: ratio of 4 r ⟨|∇L|⟩, to which the yields refer, to the change of log intensity by the reference.
    """
    volume = design.volume
    camera = design.camera
    scene = template.scene
    velocity = _velocity(setting, camera)
    assert isinstance(scene, Scene)
    speed = float(np.nanmean(np.linalg.norm(velocity, axis=2)))
    apex = reference.orbit.apex * radius / reference.orbit.radius
    relative_yield = volume.yield_at(apex, 60.0 * speed / (math.tau * radius))

    # One turn lets the pixels settle; then the motion is counted until it repeats.
    settling_s = 1.0 / setting.hz
    counted_s = setting.turns / setting.hz
    scene_at_depth: Scene | WorldScene = scene
    if isinstance(setting.optic, Plate):
        scene_at_depth = wall(scene, 1.0 / setting.inverse_depth)
    case = replace(
        template,
        scene=scene_at_depth,
        prism=setting.optic,
        motion=setting.motion,
        duration_s=settling_s + counted_s,
    )

    # A mirror shows the scene mirrored; a plate's wall shows what the template does.
    viewed = template if isinstance(setting.optic, Plate) else case
    change = change_of(velocity, slopes_of(viewed.log_view()), camera)
    parts = tiles(camera, template.seed)
    likely = texture_of(change, radius, camera, parts) * counted_s / volume.contrast
    start_us = round(1e6 * settling_s)
    ratio, error = simulated_yield(case, parts, likely, start_us, volume.noise_hz * counted_s)

    mean_change = float(change.mean())
    law = volume.of_image(scale * relative_yield * mean_change / volume.contrast)
    checked = volume.of_image(ratio * mean_change / volume.contrast)
    return law, checked, error
