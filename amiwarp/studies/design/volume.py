"""The law of the events: measured on small parts of the image, good for every apex, speed and size of a grid."""

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
from amiwarp.simulation.scenery import place_scene, seen_bearings
from amiwarp.simulation.simulator import Scene, Simulation
from amiwarp.studies.design.orbit import Orbit, orbit_radii

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.camera import Camera

TILE, ACROSS_TILES, DOWN_TILES = 16, 12, 9
"""Size [px] and number of the parts of the image that are simulated."""
NODES = 4
"""At most so many apexes are simulated; between them the yield is interpolated."""

"""Called with what is being done and the share of it that is."""


@dataclass(frozen=True, eq=False)
class Volume:
    """The measured law of the events: per turn and pixel yield · 4 r ⟨|∇L|⟩ / C, and the sensor's noise."""

    apexes: NDArray[np.float64]
    """Simulated, shape (n,) [rad]."""
    rpms: NDArray[np.float64]
    """Simulated, shape (m,), one or two [turns/min]."""
    yields: NDArray[np.float64]
    """Events found over events expected, shape (n, m)."""
    uncertainty: float
    """Relative standard error of the yields, from the scatter of the tiles."""
    texture: float
    """⟨|∇L|⟩: mean gradient of log intensity over the image [1/px]."""
    contrast: float
    """C: what log intensity changes by between two events."""
    pixels: int
    noise_hz: float
    """Noise of a pixel [events/s]."""
    simulated: int
    """Pixels that were simulated."""

    def events_per_s(self, orbit: Orbit, rpm: float) -> float:
        """Events of the whole image in a second."""
        per_turn = self._yield(orbit.apex, rpm) * 4.0 * orbit.radius * self.texture / self.contrast
        return self.pixels * (per_turn * rpm / 60.0 + self.noise_hz)

    def _yield(self, apex: float, rpm: float) -> float:
        """Between simulated apexes a power law; between speeds dead time: the reciprocal is linear in the speed."""
        at = [float(np.interp(math.log(apex), np.log(self.apexes), np.log(y))) for y in self.yields.T]
        return 1.0 / float(np.interp(rpm, self.rpms, np.exp(-np.array(at))))


def filled(scene: Scene, camera: Camera, prism: Prism) -> Scene:
    """The scene as large as fills all that the camera sees through this prism, centred; one with a size stays.

    So every part of the image sees the same of it as the whole does.
    """
    if scene.fov is not None:
        return scene
    whole = Simulation(scene, camera, prism, 1.0)
    place_scene(whole)  # refuses what a plane cannot show
    bearings = seen_bearings(whole)
    reach = np.abs(bearings[:, :2] / bearings[:, 2:]).max(axis=0) + 4.0 / min(camera.fx, camera.fy)
    scale = float(np.max(reach / np.array(scene.frames.size)))
    return replace(scene, fov=2.0 * math.atan(scale * scene.frames.size[0]))


def measure(template: Simulation, apexes: Sequence[float], rpms: Sequence[float], tell: Progress) -> Volume:
    """Simulate tiles of the camera over the range of apexes, at the slowest and the fastest speed.

    Each tile is a small camera that sees what its part of the image sees: one turn, after one for the pixels'
    references to settle. The tiles' events are scaled to the image by the gradient along their orbits, which is known
    everywhere, so it hardly matters which tiles they are. Raises :class:`AmiwarpError` for a scene without texture.
    """
    sensor, camera = template.sensor, template.camera
    slopes: Any = np.gradient(template.log_view())
    gradient = np.hypot(slopes[0], slopes[1])
    if not gradient.mean() > 0.0:
        raise AmiwarpError("the scene has no texture, so no prism makes events of it; give another picture")
    nodes = np.geomspace(apexes[0], apexes[-1], min(NODES, len(apexes))) if len(apexes) > 1 else np.array(apexes)
    speeds = np.array(sorted({rpms[0], rpms[-1]}))
    contrast = 2.0 / (1.0 / sensor.contrast_on + 1.0 / sensor.contrast_off)
    noise = sensor.shot_noise_hz + sensor.leak_hz + sensor.hot_fraction * sensor.hot_hz
    cameras = tiles(camera, template.seed)
    yields, spread = np.empty((len(nodes), len(speeds))), []
    for k, (i, j) in enumerate(np.ndindex(yields.shape)):
        tell("simulating", k / yields.size)
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
    """Small cameras that see parts of the image, pixel by pixel as it does: one somewhere in each cell of a grid.

    Drawn at random within its cell, so that a texture that repeats does not fall into step with the grid.
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
    """Events of a pixel in the second turn."""
    half = case.duration_us // 2
    seeded = replace(case, camera=tile, seed=(case.seed + number) % (1 << 31))
    blocks = seeded.blocks(chunk_us=case.duration_us)  # in one go: so few pixels need no more
    return sum(int((events.t >= half).sum()) for events, _ in blocks) / (tile.width * tile.height)


def _texture_of(gradient: NDArray[Any], radius: float, camera: Camera, parts: Sequence[Camera]) -> NDArray[np.float64]:
    """Mean gradient that each tile's pixels meet on their orbits [1/px], shape (tiles,)."""
    from scipy.ndimage import gaussian_filter

    met = gaussian_filter(gradient, radius / math.sqrt(2.0))  # as wide as a ring of that radius
    corners = [(round(camera.cx - part.cx), round(camera.cy - part.cy)) for part in parts]
    boxes = [met[y : y + p.height, x : x + p.width] for p, (x, y) in zip(parts, corners, strict=True)]
    return np.array([box.mean() for box in boxes], np.float64)
