"""Event volume: a law for the event rate, measured by simulating small parts of the image.

The law holds for every apex angle, speed and image size of a design study.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics.prism import Prism
from amiwarp.progress import Progress
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.scene import Scene
from amiwarp.simulation.scenery import place_scene, seen_bearings
from amiwarp.simulation.simulator import Simulation
from amiwarp.studies.design.orbit_size import Orbit, orbit_radii

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.camera import Camera

TILE, ACROSS_TILES, DOWN_TILES = 16, 12, 9
"""Side [px] and number, across and down, of the tiles of the image that are simulated."""
NODES = 4
"""Largest number of apex angles that are simulated; between them the events per turn are interpolated."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Measured law of the event volume.

    Events per turn and pixel are yield · 4 r ⟨|∇L|⟩ / C, where r is the radius of the orbits; sensor noise is added.
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

    def events_per_s(self, orbit: Orbit, rpm: float) -> float:
        """Return the event rate of the whole image [events/s]."""
        per_turn = self._yield(orbit.apex, rpm) * 4.0 * orbit.radius * self.texture / self.contrast
        return self.pixels * (per_turn * rpm / 60.0 + self.noise_hz)

    def _yield(self, apex: float, rpm: float) -> float:
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

    Raises :class:`AmiwarpError` for a scene without texture.
    """
    sensor, camera = template.sensor, template.camera
    slopes: Any = np.gradient(template.log_view())
    gradient = np.hypot(slopes[0], slopes[1])
    if not gradient.mean() > 0.0:
        raise AmiwarpError("the scene has no texture, so it generates no events with any prism; choose another picture")
    nodes = np.geomspace(apexes[0], apexes[-1], min(NODES, len(apexes))) if len(apexes) > 1 else np.array(apexes)
    speeds = np.array(sorted({rpms[0], rpms[-1]}))
    contrast = 2.0 / (1.0 / sensor.contrast_on + 1.0 / sensor.contrast_off)
    noise = sensor.shot_noise_hz + sensor.leak_hz + sensor.hot_fraction * sensor.hot_hz
    cameras = tiles(camera, template.seed)
    yields, spread = np.empty((len(nodes), len(speeds))), []
    for k, (i, j) in enumerate(np.ndindex(yields.shape)):
        report("simulating", k / yields.size)
        rpm = float(speeds[j])
        prism = replace(template.prism, apex=float(nodes[i]))
        case = replace(template, prism=prism, motion=PrismMotion(rpm), duration_s=120.0 / rpm)
        radius = orbit_radii(camera, prism)[0]
        found = np.array([_per_turn(case, tile, k) for k, tile in enumerate(cameras)]) - noise * 60.0 / rpm
        likely = _texture_of(gradient, radius, camera, cameras) * 4.0 * radius / contrast
        yields[i, j] = max(float(found.mean() / likely.mean()), 1e-6)
        spread.append(float(np.std(found - yields[i, j] * likely)) / math.sqrt(len(cameras)) / abs(found.mean()))
    pixels = camera.width * camera.height
    simulated = sum(tile.width * tile.height for tile in cameras)
    return Volume(nodes, speeds, yields, float(np.mean(spread)), float(gradient.mean()), contrast, pixels, noise,
                  simulated)  # fmt: skip


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


def _per_turn(case: Simulation, tile: Camera, number: int) -> float:
    """Simulate a tile and return its number of events per pixel in the second turn."""
    half = case.duration_us // 2
    seeded = replace(case, camera=tile, seed=(case.seed + number) % (1 << 31))
    blocks = seeded.blocks(chunk_us=case.duration_us)  # one chunk, because there are few pixels
    return sum(int((events.t >= half).sum()) for events, _ in blocks) / (tile.width * tile.height)


def _texture_of(gradient: NDArray[Any], radius: float, camera: Camera, parts: Sequence[Camera]) -> NDArray[np.float64]:
    """Return the mean gradient of log intensity along the orbits of each tile's pixels [1/px], shape ``(tiles,)``."""
    from scipy.ndimage import gaussian_filter

    met = gaussian_filter(gradient, radius / math.sqrt(2.0))  # as wide as a ring of that radius
    corners = [(round(camera.cx - part.cx), round(camera.cy - part.cy)) for part in parts]
    boxes = [met[y : y + p.height, x : x + p.width] for p, (x, y) in zip(parts, corners, strict=True)]
    return np.array([box.mean() for box in boxes], np.float64)
