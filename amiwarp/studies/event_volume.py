"""Event volume: a law for the event rate, measured by simulating small parts of the image.

The law holds for every apex angle, speed and image size of a design study.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import Scene
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.picture_maps import place_scene
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.view import seen_bearings
from amiwarp.studies.failures import noted
from amiwarp.studies.orbits import Orbit, orbit_radii
from amiwarp.studies.quantities import degrees
from amiwarp.tasks import Progress

TILE = 16
"""Side of the tiles of the image that are simulated [px]."""
ACROSS_TILES = 12
"""Number of tiles across the image."""
DOWN_TILES = 9
"""Number of tiles down the image."""
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
        relative_yield = self.yield_at(orbit.apex, rpm)
        per_turn = relative_yield * 4.0 * orbit.radius * self.texture / self.contrast
        return self.of_image(per_turn * rpm / 60.0)

    def of_image(self, per_pixel: float) -> float:
        """Return the event rate of the whole image [events/s] for one per pixel without noise [events/s]."""
        return self.pixels * (per_pixel + self.noise_hz)

    def yield_at(self, apex: float, rpm: float) -> float:
        """Return the ratio of simulated to expected events at an apex angle [rad] and a speed [turns/min].

        It is a power law between simulated apexes; between speeds its reciprocal is linear, as for a dead time.
        """
        log_apex = math.log(apex)
        log_apexes = np.log(self.apexes)
        # At this apex, for each simulated speed
        log_yields = []
        for yields in self.yields.T:
            log_yields.append(float(np.interp(log_apex, log_apexes, np.log(yields))))
        reciprocals = np.exp(-np.array(log_yields))
        return 1.0 / float(np.interp(rpm, self.rpms, reciprocals))


def filled(scene: Scene, camera: Camera, prism: Prism) -> Scene:
    """Return the scene, centred and scaled to fill everything that the camera sees through this prism.

    Every part of the image then sees the same part of the scene as in the whole image. A scene with a given size stays
    unchanged.
    """
    if scene.fov is not None:
        return scene
    whole = Simulation(scene, camera, prism, 1.0)
    # Raises an error if a plane cannot fill the view.
    place_scene(whole)
    bearings = seen_bearings(whole)
    tangents = bearings[:, :2] / bearings[:, 2:]
    four_pixels = 4.0 / min(camera.fx, camera.fy)
    reach = np.abs(tangents).max(axis=0) + four_pixels
    width, height = scene.frames.size
    scale = float(np.max(reach / np.array([width, height])))
    return replace(scene, fov=2.0 * math.atan(scale * width))


def measure(
    template: Simulation, apexes: Sequence[float], rpms: Sequence[float], report: Progress
) -> Volume:
    """Measure the event volume by simulating tiles of the camera.

    The apex angles span the range of ``apexes``; the speeds are the slowest and the fastest of ``rpms``. Each tile is a
    small camera that sees the same as its part of the image. It is simulated for two turns; the first lets the
    reference levels of the pixels settle, the second is counted. The events of the tiles are scaled to the image by the
    gradient along their orbits, which is known everywhere, so that the choice of tiles matters little.

    A simulation that fails is noted, and the law is measured by the others. Raises :class:`AmiwarpError` for a scene
    without texture, and if too few simulations succeed for a law.
    """
    sensor = template.sensor
    camera = template.camera
    gradient = np.hypot(*slopes_of(template.log_view()))
    if not gradient.mean() > 0.0:
        raise AmiwarpError(
            "the scene has no texture, so it generates no events with any prism; choose another picture"
        )
    nodes = np.array(apexes)
    if len(apexes) > 1:
        nodes = np.geomspace(apexes[0], apexes[-1], min(NODES, len(apexes)))
    speeds = np.array(sorted({rpms[0], rpms[-1]}))

    # Mean of the thresholds of both polarities, by the events that each causes
    contrast = 2.0 / (1.0 / sensor.contrast_on + 1.0 / sensor.contrast_off)
    noise = noise_hz(sensor)
    cameras = tiles(camera, template.seed)
    yields = np.full((len(nodes), len(speeds)), np.nan)
    errors = yields.copy()
    simulated = np.zeros(yields.shape, np.bool_)
    failed: dict[str, str] = {}
    for done, (i, j) in enumerate(np.ndindex(yields.shape)):
        report("simulating", done / yields.size)
        apex = float(nodes[i])
        rpm = float(speeds[j])
        with noted(failed, f"simulation of apex {degrees(apex)} at {rpm:g} rpm"):
            prism = replace(template.glass, apex=apex)
            radius, _ = orbit_radii(camera, prism)
            likely = texture_of(gradient, radius, camera, cameras) * 4.0 * radius / contrast
            by_noise = noise * 60.0 / rpm
            # The first of two turns lets the pixels settle.
            two_turns_s = 120.0 / rpm
            case = replace(template, prism=prism, motion=PrismMotion(rpm), duration_s=two_turns_s)
            half_us = case.duration_us // 2
            yields[i, j], errors[i, j] = simulated_yield(case, cameras, likely, half_us, by_noise)
            simulated[i, j] = True

    complete = _complete(simulated)
    if complete is None:
        name, message = next(iter(failed.items()))
        raise AmiwarpError(f"too few simulations succeeded for the event volume; {name}: {message}")
    rows, columns = complete
    return Volume(
        apexes=nodes[rows],
        rpms=speeds[columns],
        yields=yields[np.ix_(rows, columns)],
        uncertainty=float(errors[np.ix_(rows, columns)].mean()),
        texture=float(gradient.mean()),
        contrast=contrast,
        pixels=camera.width * camera.height,
        noise_hz=noise,
        simulated=sum(tile.width * tile.height for tile in cameras),
        failed=failed,
    )


def _complete(simulated: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Return the rows and columns of a table that leave out what is missing and keep most; None if nothing remains."""
    height, width = simulated.shape
    options = [
        (np.flatnonzero(simulated.all(axis=1)), np.arange(width)),
        (np.arange(height), np.flatnonzero(simulated.all(axis=0))),
    ]
    # One speed may have failed everywhere and the other for some apexes.
    for column in range(width):
        options.append((np.flatnonzero(simulated[:, column]), np.array([column])))

    rows, columns = max(options, key=lambda option: len(option[0]) * len(option[1]))
    if not len(rows) or not len(columns):
        return None
    return rows, columns


def slopes_of(log: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the gradient of a picture's log intensity [1/px]: along y, and along x."""
    down, across = np.gradient(log)
    return down, across


def noise_hz(sensor: SensorModel) -> float:
    """Return the mean noise rate of a pixel [events/s]."""
    return sensor.shot_noise_hz + sensor.leak_hz + sensor.hot_fraction * sensor.hot_hz


def simulated_yield(
    case: Simulation,
    cameras: Sequence[Camera],
    likely: NDArray[np.float64],
    start_us: int,
    noise: float,
) -> tuple[float, float]:
    """Simulate tiles, and return the ratio of their events to the likely ones, with its relative standard error.

    ``likely``: events per pixel that the scene's gradients let expect after ``start_us`` [us], shape ``(tiles,)``;
    ``noise``: events per pixel by noise.
    """
    counts = [_events_after(case, tile, k, start_us) for k, tile in enumerate(cameras)]
    by_scene = np.array(counts) - noise
    ratio = max(float(by_scene.mean() / likely.mean()), 1e-6)
    scatter = float(np.std(by_scene - ratio * likely))
    error_of_mean = scatter / math.sqrt(len(cameras))
    return ratio, error_of_mean / abs(by_scene.mean())


def tiles(camera: Camera, seed: int = 0) -> list[Camera]:
    """Return small cameras that each see a tile of the image, at a random position in each cell of a grid.

    The positions are random so that a repeating texture cannot align with the grid.
    """
    across = min(ACROSS_TILES, camera.width // TILE)
    down = min(DOWN_TILES, camera.height // TILE)
    if across < 2 or down < 2:
        return [camera]
    wide = camera.width / across
    high = camera.height / down
    rng = np.random.default_rng([seed, 0x71E5])
    in_cell = rng.random((down, across, 2)) * (wide - TILE, high - TILE)
    left_of_cell = np.arange(across) * wide
    top_of_cell = np.arange(down)[:, None] * high
    left = np.floor(left_of_cell + in_cell[..., 0]).ravel()
    top = np.floor(top_of_cell + in_cell[..., 1]).ravel()
    cameras = []
    for x, y in zip(left, top, strict=True):
        cx = camera.cx - float(x)
        cy = camera.cy - float(y)
        cameras.append(replace(camera, width=TILE, height=TILE, cx=cx, cy=cy))
    return cameras


def _events_after(case: Simulation, tile: Camera, number: int, start_us: int) -> float:
    """Simulate a tile and return its number of events per pixel from ``start_us`` [us] on."""
    seeded = replace(case, camera=tile, seed=(case.seed + number) % (1 << 31))
    # One chunk, because there are few pixels
    blocks = seeded.blocks(chunk_us=case.duration_us)
    count = sum(int((events.t >= start_us).sum()) for events, _ in blocks)
    return count / (tile.width * tile.height)


def texture_of(
    gradient: NDArray[Any], radius: float, camera: Camera, parts: Sequence[Camera]
) -> NDArray[np.float64]:
    """Return the mean gradient of log intensity along the orbits of each tile's pixels [1/px], shape ``(tiles,)``."""
    from scipy.ndimage import gaussian_filter

    # A Gaussian as wide as a ring of that radius
    met = gaussian_filter(gradient, radius / math.sqrt(2.0))
    means = []
    for part in parts:
        left = round(camera.cx - part.cx)
        top = round(camera.cy - part.cy)
        means.append(met[top : top + part.height, left : left + part.width].mean())
    return np.array(means, np.float64)
