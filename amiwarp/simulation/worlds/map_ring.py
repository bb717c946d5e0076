"""Pre-rendered pictures (maps) of a simulated world at successive times along the camera's trajectory."""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.kernels.map_rendering import MapFrame
from amiwarp.simulation.maps import SMALLEST_COSINE, TEXELS_PER_PIXEL, MapSlots
from amiwarp.simulation.picture_light import DARK
from amiwarp.simulation.picture_placement import Placement
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.image_speed import (
    changes_of,
    flicker_interval_s,
    movers_speed,
    parallax_speed,
)
from amiwarp.simulation.worlds.map_renderer import MapRenderer
from amiwarp.simulation.worlds.surfaces import device_pose
from amiwarp.simulation.worlds.world_scene import WorldScene

MARGIN_PX = 24.0
"""Border of a map around the view of a moving camera [px]. If the camera rotates further, the
orientation of the maps changes."""
LONGEST_S = 0.5
"""Longest time between two successive maps if the camera or a body moves, or a lamp flickers [s]."""
SHORTEST_S = 1e-6
"""Shortest time between two successive maps [s]."""
SPEEDS_BETWEEN = 8
"""Number of moments until the next key of an animation at which the speed of bodies is computed."""
SAMPLES = 4
"""Default number of rays per texel at edges."""
TEXEL_VARIANCE = 1.0 / 12.0 + 1.0 / 6.0
"""Variance of the blur that a texel's area (1/12) and bilinear interpolation (1/6) cause [texels squared]."""


@dataclass(frozen=True, eq=False, slots=True)
class HeldMap:
    """Map of a world in device memory."""

    time: float
    """Time that the map shows [us]."""
    slot: int
    """Number of the slot that holds the map, see :class:`amiwarp.simulation.maps.MapSlots`."""
    orientation: NDArray[np.float64]
    """Rotation matrix from the frame of the map's plane to the world's frame, shape (3, 3)."""


class WorldMapRing:
    """Maps of a world for the current span of time, in slots of device memory.

    Successive maps share one orientation until the camera's view leaves the map. The effect of the camera's rotation is
    therefore exact; only the effects of the camera's translation and of moving bodies are interpolated in time. The
    interval between two whole maps depends on the speed of the camera's translation. On a CPU, if bodies move faster in
    the image, further maps are inserted between two whole maps. An inserted map is rendered only where bodies move, and
    interpolated elsewhere.
    """

    def __init__(
        self,
        simulation: SimulationValues,
        scene: WorldScene,
        world: DeviceWorld,
        bearings: NDArray[np.float64],
    ) -> None:
        """Place the maps. ``bearings``: directions that the camera sees over a turn of the prism, shape (n, 3)."""
        self._scene = scene
        self._camera = simulation.camera
        self._bearings = bearings
        self._world = world
        focal = max(self._camera.fx, self._camera.fy)
        margin_px = MARGIN_PX if scene.trajectory.moves else 2.0
        self.placement = _placement(bearings, focal, margin_px / focal)
        frame = MapFrame()
        frame.left = self.placement.left
        frame.top = self.placement.top
        frame.pitch_x, frame.pitch_y = self.placement.pitch
        frame.width = self.placement.width
        frame.height = self.placement.height
        frame.cone = 1.0 / (TEXELS_PER_PIXEL * focal)
        self._renderer = MapRenderer(
            self._world,
            frame,
            blur=map_blur(scene.blur),
            dark=DARK,
            samples=scene.samples or SAMPLES,
        )
        self._texels = self.placement.width * self.placement.height
        self._slots = MapSlots(self._texels, wp.vec4, wp.int32, device=simulation.device)
        self._held: list[HeldMap] = []
        # Whole maps before and after the last held map; one at the start.
        self._whole: list[HeldMap] = []
        # No map is interpolated across an abrupt change of a body's motion.
        self._motion_changes = changes_of(world, simulation.duration_s + LONGEST_S)
        self.rendered = 0
        """Number of whole maps rendered so far."""

    @property
    def maps(self) -> wp.array:
        """Coefficients of bilinear interpolation of the log intensity at each texel of all maps, slot by slot."""
        return self._slots.arrays[0]

    @property
    def faces(self) -> wp.array:
        """Number of the face that each texel of all maps sees, slot by slot; -1 for the sky."""
        return self._slots.arrays[1]

    @property
    def _changes(self) -> bool:
        """Whether anything moves or flickers."""
        flickers = math.isfinite(flicker_interval_s(self._scene.world))
        return bool(self._scene.trajectory.moves or self._world.movers or flickers)

    def cover(self, start: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Render the maps for the span ``start`` .. ``stop`` [us]; return their times [us] and their slots.

        There is at least one map. If anything moves, the last map is at ``stop`` or later.
        """
        if not self._held:
            rotation, _ = self._scene.trajectory.poses([0.0])
            self._whole = [self._render(0.0, rotation[0])]
            self._held = self._whole[:]
        while self._held[-1].time < stop and self._changes:
            self._drop(start)
            self._next()
        self._drop(start)
        times = np.array([held.time for held in self._held], np.float64)
        slots = np.array([held.slot for held in self._held], np.int32)
        return times, slots

    def orientations(self, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rotation matrices from the camera's frame to the frame of the map at each time [us], (n, 3, 3)."""
        times = np.array([held.time for held in self._held])
        which = np.clip(np.searchsorted(times, t_us, side="right") - 1, 0, len(times) - 1)
        reference = np.stack([held.orientation for held in self._held])[which]
        rotation, _ = self._scene.trajectory.poses(np.maximum(t_us, 0.0) * 1e-6)
        return np.asarray(np.swapaxes(reference, 1, 2) @ rotation)

    def _next(self) -> None:
        """Append the next whole map, or the next inserted map before it."""
        last = self._held[-1]
        whole, between = self._intervals_s(last.time * 1e-6)
        if last is self._whole[-1]:
            self._whole = [last, *self._following(last, whole)]
        inserted = last.time + 1e6 * between
        if inserted < self._whole[1].time:
            self._held.append(self._render_between(inserted))
            return
        before, *following = self._whole
        self._held.extend(following)
        self._whole = following[-1:]
        self._release(before)

    def _following(self, last: HeldMap, interval: float) -> list[HeldMap]:
        """Return the next whole map, ``interval`` [s] after the map ``last``.

        If the camera turns so far within the interval that its view leaves the area of ``last``, return two maps of the
        latest time before: one in the old and one in the new orientation.
        """
        start = last.time * 1e-6
        reference = last.orientation
        end = start + interval
        moments = np.linspace(start, end, 9)[1:]
        rotations, _ = self._scene.trajectory.poses(moments)
        if all(self._fits(reference.T @ rotation) for rotation in rotations):
            return [self._render(end, reference)]
        latest = self._last_fit(start, end, reference)
        (new_orientation,), _ = self._scene.trajectory.poses([latest])
        return [self._render(latest, reference), self._render(latest, new_orientation)]

    def _intervals_s(self, t: float) -> tuple[float, float]:
        """Return the times [s] from ``t`` [s] until the next whole map and until the next whole or inserted map."""
        scene = self._scene
        camera = self._camera
        self._world.set_instants(np.array([t]))
        parallax = parallax_speed(self._world, camera, scene.trajectory, t, 0)
        (movers,) = movers_speed(self._world, camera, scene.trajectory, np.array([t])).tolist()
        longest = min(LONGEST_S, flicker_interval_s(scene.world))
        whole = min(longest, scene.motion_px / max(parallax, 1e-9))
        between = min(longest, scene.motion_px / max(parallax + movers, 1e-9))
        if len(self._motion_changes):
            between = self._until_change(t, between, parallax)
        if not self._world.device.is_cpu:
            # A GPU renders a whole map faster than the host finds the tiles in which bodies move.
            whole = between
        return max(whole, SHORTEST_S), max(between, SHORTEST_S)

    def _until_change(self, t: float, interval: float, parallax: float) -> float:
        """Return an interval from ``t`` [s], shortened so that it ends at the next abrupt change of a body's motion,
        and that bodies move in it by no more than they should.

        ``parallax``: speed due to the camera's translation [px/s].
        """
        following = np.searchsorted(self._motion_changes, t + SHORTEST_S / 2.0, side="right")
        for change in self._motion_changes[following : following + 1].tolist():
            interval = min(interval, change - t)
        # Bodies that start from rest are fast only later.
        moments = np.linspace(t, t + interval, SPEEDS_BETWEEN, endpoint=False)
        speeds = movers_speed(self._world, self._camera, self._scene.trajectory, moments)
        return min(interval, self._scene.motion_px / max(parallax + speeds.max(), 1e-9))

    def _fits(self, turned: NDArray[np.float64]) -> bool:
        """Return whether the view of a camera, rotated by ``turned`` (3, 3) relative to the map, lies on the map."""
        x, y, z = turned @ self._bearings.T
        if z.min() < SMALLEST_COSINE:
            return False
        place = self.placement
        right = place.left + place.width / place.pitch[0]
        bottom = place.top + place.height / place.pitch[1]
        inside_x = (x / z >= place.left) & (x / z <= right)
        inside_y = (y / z >= place.top) & (y / z <= bottom)
        return bool((inside_x & inside_y).all())

    def _last_fit(self, low: float, high: float, reference: NDArray[np.float64]) -> float:
        """Return the latest time [s] between ``low`` and ``high`` at which the camera's view lies on the map.

        ``reference``: orientation of the map, shape (3, 3).
        """
        for _ in range(20):
            middle = (low + high) / 2.0
            rotation, _ = self._scene.trajectory.poses([middle])
            if self._fits(reference.T @ rotation[0]):
                low = middle
            else:
                high = middle
        return low

    def _render(self, t: float, orientation: NDArray[np.float64]) -> HeldMap:
        """Render a whole map at time ``t`` [s] with a given orientation (3, 3)."""
        _, position = self._scene.trajectory.poses([t])
        self._world.set_instants(np.array([t]))
        slot = self._slots.take()
        pose = device_pose(orientation, position[0])
        self._renderer.render(pose, self.maps, self.faces, slot * self._texels)
        self.rendered += 1
        return HeldMap(t * 1e6, slot, orientation)

    def _render_between(self, time: float) -> HeldMap:
        """Render an inserted map at a time [us] between the current two whole maps."""
        before, after = self._whole[:2]
        _, position = self._scene.trajectory.poses([time * 1e-6])
        self._world.set_instants(np.array([time, before.time, after.time]) * 1e-6)
        slot = self._slots.take()
        pose = device_pose(before.orientation, position[0])
        ends = (before.slot * self._texels, after.slot * self._texels)
        share = (time - before.time) / (after.time - before.time)
        self._renderer.render_between(pose, self.maps, self.faces, slot * self._texels, ends, share)
        return HeldMap(time, slot, before.orientation)

    def _drop(self, start: int) -> None:
        """Drop the maps that are needed only before ``start`` [us]."""
        while len(self._held) > 1 and self._held[1].time <= start:
            self._release(self._held.pop(0))

    def _release(self, held: HeldMap) -> None:
        """Give back the slot of a map if the map is neither held nor a current whole map."""
        if held not in self._held and held not in self._whole:
            self._slots.give_back(held.slot)


def map_blur(blur: float) -> float:
    """Return the standard deviation by which a map must be blurred [texels] for a total blur [px].

    The total blur includes the blur by the texels' area and by bilinear interpolation (:data:`TEXEL_VARIANCE`).
    """
    return math.sqrt(max((blur * TEXELS_PER_PIXEL) ** 2 - TEXEL_VARIANCE, 0.0))


def _placement(bearings: NDArray[np.float64], focal: float, margin: float) -> Placement:
    """Return the placement on their plane of maps that show all ``bearings``, shape (n, 3).

    ``focal``: focal length [px]; ``margin``: border [focal lengths].
    Raises :class:`AmiwarpError` if the view is too wide.
    """
    x, y, z = bearings.T
    if not len(bearings) or z.min() < SMALLEST_COSINE:
        limit = 2.0 * math.degrees(math.acos(SMALLEST_COSINE))
        raise AmiwarpError(
            f"the camera sees more than the {limit:.0f} deg that a map can cover; give seeing='rays' (--seeing rays)"
        )
    plane_x = x / z
    plane_y = y / z
    left = float(plane_x.min()) - margin
    right = float(plane_x.max()) + margin
    top = float(plane_y.min()) - margin
    bottom = float(plane_y.max()) + margin
    pitch = TEXELS_PER_PIXEL * focal
    width = math.ceil((right - left) * pitch)
    height = math.ceil((bottom - top) * pitch)
    return Placement(width, height, (0.0, 0.0, 1.0, 1.0), left, top, (pitch, pitch))
