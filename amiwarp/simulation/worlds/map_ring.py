"""Maps of a world over time, for the simulator's look-up: rendered where and when the camera is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import world_view
from amiwarp.simulation.pictures import DARK, Placement
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.motion import body_speed, flicker_interval_s, parallax_speed
from amiwarp.simulation.worlds.renderer import MapRenderer, device_pose

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation
    from amiwarp.simulation.worlds.world_scene import WorldScene

TEXELS_PER_PIXEL = 1.75
MARGIN_PX = 24.0
"""Room around what is seen at first [px]: the camera turns by so much before the maps turn with it."""
SMALLEST_COSINE = 0.25
"""Of the angle between a bearing and the maps' axis."""
LONGEST_S = 0.5
"""Between two maps of a world in which anything moves [s]."""
SAMPLES = 4
TEXEL_VARIANCE = 1.0 / 12.0 + 1.0 / 6.0
"""Blur by a texel's own area, and by bilinear look-up [texels squared]."""


class WorldMapRing:
    """Maps around a span of time; each has a slot on the device.

    Successive maps share the orientation in which they are rendered until the camera has turned away from it: its
    rotation is then exact, and only what its change of place and moving bodies do is blended.
    """

    def __init__(
        self, simulation: Simulation, scene: WorldScene, world: DeviceWorld, bearings: NDArray[np.float64]
    ) -> None:
        """``bearings``: all that is seen over a turn of the prism, in the camera's frame, shape (n, 3)."""
        self._scene, self._camera, self._bearings = scene, simulation.camera, bearings
        self._end_s = simulation.duration_s
        self._world = world
        focal = max(self._camera.fx, self._camera.fy)
        self.placement = _placement(bearings, focal, MARGIN_PX / focal if self._turns else 2.0 / focal)
        p, frame = self.placement, world_view.MapFrame()
        frame.left, frame.top, (frame.pitch_x, frame.pitch_y) = p.left, p.top, p.pitch
        frame.width, frame.height, frame.cone = p.width, p.height, 1.0 / (TEXELS_PER_PIXEL * focal)
        self._renderer = MapRenderer(self._world, frame, blur=map_blur(scene.blur), dark=DARK,
                                     samples=scene.samples or SAMPLES)  # fmt: skip
        self._texels = p.width * p.height
        self._held: list[tuple[float, int, NDArray[np.float64]]] = []  # time [us], slot, orientation
        self._free: list[int] = []
        self.maps: wp.array = wp.empty(0, dtype=wp.vec4, device=simulation.device)
        self.rendered = 0
        """Maps rendered so far."""

    @property
    def _turns(self) -> bool:
        return self._scene.trajectory.moves

    def cover(self, start: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Times [us] and slots of the maps around ``start`` .. ``stop`` [us], at least one."""
        if not self._held:
            self._render(0.0, self._scene.trajectory.poses([0.0])[0][0])
        while self._held[-1][0] < stop and self._still_moves:
            self._drop(start)
            self._next()
        self._drop(start)
        times, slots, _ = zip(*self._held, strict=True)
        return np.array(times, np.float64), np.array(slots, np.int32)

    def orientations(self, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Matrices (n, 3, 3) from the camera's frame at times [us] to the frame of the maps that hold them."""
        times = np.array([time for time, _, _ in self._held])
        which = np.clip(np.searchsorted(times, t_us, side="right") - 1, 0, len(times) - 1)
        reference = np.stack([orientation for _, _, orientation in self._held])[which]
        rotation, _ = self._scene.trajectory.poses(np.maximum(t_us, 0.0) * 1e-6)
        return np.asarray(np.swapaxes(reference, 1, 2) @ rotation)

    @property
    def _still_moves(self) -> bool:
        moving = (
            self._scene.trajectory.moves or self._world.movers or math.isfinite(flicker_interval_s(self._scene.world))
        )
        return bool(moving)

    def _next(self) -> None:
        time, _, reference = self._held[-1]
        at = time * 1e-6 + self._interval_s(time * 1e-6)
        rotation, _ = self._scene.trajectory.poses([at])
        between = self._scene.trajectory.poses(np.linspace(time * 1e-6, at, 9)[1:])[0]
        if not all(self._fits(reference.T @ turned) for turned in between):
            at = self._last_fit(time * 1e-6, at, reference)
            rotation, _ = self._scene.trajectory.poses([at])
            self._render(at, reference)
            self._render(at, rotation[0])
            return
        self._render(at, reference)

    def _interval_s(self, t: float) -> float:
        """Time [s] in which nothing moves further than allowed, but by the camera's rotation."""
        scene, focal = self._scene, max(self._camera.fx, self._camera.fy)
        self._world.set_instants(np.array([t]))
        speed = parallax_speed(self._world, self._camera, scene.trajectory, t, 0)
        speed += max(
            (float(body_speed(b, scene.trajectory, focal, np.array([t]))[0]) for b in self._world.movers), default=0.0
        )
        interval = min(LONGEST_S, flicker_interval_s(scene.world), scene.motion_px / max(speed, 1e-9))
        return max(interval, 1e-6)

    def _fits(self, turned: NDArray[np.float64]) -> bool:
        """Whether all that a turned camera sees lies on the map."""
        x, y, z = turned @ self._bearings.T
        if z.min() < SMALLEST_COSINE:
            return False
        p = self.placement
        inside_x = (x / z >= p.left) & (x / z <= p.left + p.width / p.pitch[0])
        inside_y = (y / z >= p.top) & (y / z <= p.top + p.height / p.pitch[1])
        return bool((inside_x & inside_y).all())

    def _last_fit(self, low: float, high: float, reference: NDArray[np.float64]) -> float:
        """Latest time [s] until ``high`` at which the camera still sees only the map."""
        for _ in range(20):
            middle = (low + high) / 2.0
            rotation, _ = self._scene.trajectory.poses([middle])
            low, high = (middle, high) if self._fits(reference.T @ rotation[0]) else (low, middle)
        return low

    def _render(self, t: float, orientation: NDArray[np.float64]) -> None:
        _, position = self._scene.trajectory.poses([t])
        self._world.set_instants(np.array([t]))
        slot = self._slot()
        self._renderer.render(device_pose(orientation, position[0]), 0, self.maps, slot * self._texels)
        self._held.append((t * 1e6, slot, orientation))
        self.rendered += 1

    def _drop(self, start: int) -> None:
        while len(self._held) > 1 and self._held[1][0] <= start:
            self._free.append(self._held.pop(0)[1])

    def _slot(self) -> int:
        if not self._free:
            slots = len(self.maps) // self._texels
            grown = wp.empty((2 * slots or 1) * self._texels, dtype=wp.vec4, device=self.maps.device)
            wp.copy(grown, self.maps, count=len(self.maps))
            self._free.extend(range(slots, 2 * slots or 1))
            self.maps = grown
        return self._free.pop()


def map_blur(blur: float) -> float:
    """Return the blur [texels] that leaves a total of ``blur`` [px], with that of the texels and of the look-up."""
    return math.sqrt(max((blur * TEXELS_PER_PIXEL) ** 2 - TEXEL_VARIANCE, 0.0))


def _placement(bearings: NDArray[np.float64], focal: float, margin: float) -> Placement:
    """Where the maps lie on their plane. Raises :class:`AmiwarpError` for too wide a view."""
    x, y, z = bearings.T
    if not len(bearings) or z.min() < SMALLEST_COSINE:
        limit = 2.0 * math.degrees(math.acos(SMALLEST_COSINE))
        raise AmiwarpError(
            f"the camera sees more than maps hold, {limit:.0f} deg across; give seeing='rays' (--seeing rays)"
        )
    low_x, high_x = float((x / z).min()) - margin, float((x / z).max()) + margin
    low_y, high_y = float((y / z).min()) - margin, float((y / z).max()) + margin
    pitch = TEXELS_PER_PIXEL * focal
    width, height = math.ceil((high_x - low_x) * pitch), math.ceil((high_y - low_y) * pitch)
    return Placement(width, height, (0.0, 0.0, 1.0, 1.0), low_x, low_y, (pitch, pitch))
