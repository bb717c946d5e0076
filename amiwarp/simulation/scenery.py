"""The scene in front of a simulated camera: pictures, their placement, and the maps in which pixels look them up."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import prism_view
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import camera_params
from amiwarp.simulation.description import Scene, SimulationValues
from amiwarp.simulation.pictures import Placement, log_map, place_picture

# Device memory for the maps of a simulation: pictures of the scene in which pixels look up their light.


class MapSlots:
    """Arrays that are divided into slots for maps, and grow if all slots are taken.

    Slot k of an array begins at index ``k * texels``.
    """

    def __init__(self, texels: int, *dtypes: Any, device: Any) -> None:
        """Make one empty array of each type in ``dtypes``. A slot has ``texels`` elements."""
        self._texels, self._free = texels, list[int]()
        self.arrays = [wp.empty(0, dtype=dtype, device=device) for dtype in dtypes]
        """Arrays of all slots. :meth:`take` replaces the arrays when they have to grow."""

    def take(self) -> int:
        """Return the number of a free slot. If no slot is free, double the number of slots."""
        if not self._free:
            held = len(self.arrays[0]) // self._texels
            slots = 2 * held or 1
            for k, array in enumerate(self.arrays):
                self.arrays[k] = wp.empty(slots * self._texels, dtype=array.dtype, device=array.device)
                wp.copy(self.arrays[k], array, count=len(array))
            self._free.extend(range(held, slots))
        return self._free.pop()

    def give_back(self, slot: int) -> None:
        """Make a slot available again."""
        self._free.append(slot)


# The scene in front of a simulated camera: pictures, which may change with time.


# View of the simulated camera: placement of the picture, speed of the image, and maps of pictures on the device.

LARGEST_MOTION = 0.5
"""Largest motion of the image in a time step of the simulation [px]."""

LARGEST_BEND = 0.002
"""Largest distance of the orbit from its chord in a time step [px]. Brightness is interpolated along the chord, so that
orbits come out too small by up to two thirds of it."""

LONGEST_STEP = 2000
"""Longest time step of the simulation, even if nothing moves [us]."""

STEPS_PER_FRAME = 4
"""Smallest number of time steps of the simulation between two pictures of a sequence."""

TEXELS_PER_PIXEL = 1.75
"""Texels of a picture map per sensor pixel, along each axis."""
SMALLEST_COSINE = 0.25
"""Cosine of the largest angle between a line of sight and the axis of the picture.

The picture lies on a plane in front of the camera, so no picture exists beside or behind the camera.
"""


@dataclass(frozen=True, slots=True)
class ImageMotion:
    """Largest motion of the image that a turn of the prism or of the camera by a unit angle causes."""

    prism: float
    """Largest motion of the image per rotation angle of the prism [px/rad]."""
    camera: NDArray[np.float64]
    """Largest motion of the image per rotation angle of the camera about each of its axes [px/rad], shape (3,)."""


def step_us(simulation: SimulationValues, *, world_speed: float = 0.0, longest: float = math.inf) -> int:
    """Return the length of a time step [us]: in it the image moves by at most half a pixel, and nearly straight.

    ``world_speed``: speed of the image of a world, prism excluded [px/s]; ``longest``: upper bound of the step [us].
    """
    motion = image_motion(simulation)
    rates = simulation.camera_motion.largest_rates
    turning = simulation.motion.largest_speed
    speed = motion.prism * turning + float(motion.camera @ rates) + world_speed
    bend = motion.prism * turning**2 / 8.0  # [px/s²]: the distance from the chord, per squared duration of a step
    step = 1e6 * min(LARGEST_MOTION / max(speed, 1e-9), math.sqrt(LARGEST_BEND / max(bend, 1e-9)))
    step = min(float(LONGEST_STEP), longest, step)
    frames = getattr(simulation.scene, "frames", None)
    if frames is not None and frames.interval_us is not None:
        step = min(step, frames.interval_us / STEPS_PER_FRAME)
    if step < 1.0:
        raise AmiwarpError(
            f"the image moves at {speed:.3g} px/s, over half a pixel per microsecond; slow down prism, camera or world"
        )
    return int(step)


def image_motion(simulation: SimulationValues) -> ImageMotion:
    """Return the largest motion of the image on a grid of pixels, corners included, over one turn of the prism."""
    camera, device = simulation.camera, simulation.device
    grid = np.stack(
        [m.ravel() for m in np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9))], 1
    )
    turns = 72
    theta = np.linspace(0.0, 2.0 * np.pi, turns + 1)
    model = replace(simulation.true_model, phase=0.0)
    xy = wp.array(np.repeat(grid, turns + 1, axis=0).astype(np.float32), dtype=wp.vec2, device=device)
    angles = wp.array(np.tile(theta, len(grid)).astype(np.float32), dtype=float, device=device)
    path = model.compensate_points(xy, angles).numpy().reshape(len(grid), turns + 1, 2)
    arc = (theta[1] / 2.0) / math.sin(theta[1] / 2.0)  # a step along a circle is longer than its chord
    along = np.linalg.norm(np.diff(path, axis=1), axis=2)
    prism = float(np.max(along, initial=0.0, where=np.isfinite(along))) * arc / theta[1]
    return ImageMotion(prism, _camera_image_motion(simulation, grid))


def _camera_image_motion(simulation: SimulationValues, grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest motion of the image per rotation angle of the camera about each axis [px/rad], shape (3,).

    ``grid``: pixels at which the motion is computed, shape (n, 2).
    """
    camera = simulation.camera
    rays = camera.pixels_to_rays(wp.array(grid.astype(np.float32), dtype=wp.vec2, device=simulation.device)).numpy()
    angle = 1e-2
    result = []
    for axis in np.eye(3, dtype=np.float32):
        turned = wp.array(rays + angle * np.cross(axis, rays), dtype=wp.vec3, device=simulation.device)
        distance = np.linalg.norm(camera.rays_to_pixels(turned).numpy() - grid, axis=1) / angle
        result.append(float(np.max(distance, initial=0.0, where=np.isfinite(distance))))
    return np.array(result) * 1.02  # margin, because the grid and the finite angle may miss the largest value


def seen_bearings(simulation: SimulationValues) -> NDArray[np.float64]:
    """Return the directions that pixels on the image's border see over one turn of the prism, shape (n, 3).

    The directions are in the camera's frame. Pixels without a valid ray are left out.
    """
    camera, device = simulation.camera, simulation.device
    right, bottom = camera.width - 1.0, camera.height - 1.0
    along = np.linspace(0.0, 1.0, 33)
    zero, one = np.zeros(33), np.ones(33)
    border = np.concatenate(
        [np.stack([x * right, y * bottom], 1) for x, y in ((along, zero), (along, one), (zero, along), (one, along))]
    )
    border = np.round(border)
    theta = np.arange(24) * (2.0 * np.pi / 24)
    xy = wp.array(np.repeat(border, 24, axis=0).astype(np.float32), dtype=wp.vec2, device=device)
    angles = wp.array(np.tile(theta, len(border)).astype(np.float32), dtype=float, device=device)
    out = wp.empty(len(xy), dtype=wp.vec3, device=device)
    prism = simulation.true_model.params(device)
    inputs = [camera_params(camera, str(wp.get_device(device))), prism, xy, angles]
    launch(prism_view.scene_bearings, len(xy), inputs, [out], device=device)
    bearings = out.numpy().astype(np.float64)
    return np.asarray(bearings[np.isfinite(bearings).all(axis=1)])


def place_scene(simulation: SimulationValues) -> Placement:
    """Place the picture so that it covers everything that the camera sees through the turning prism.

    Raises :class:`AmiwarpError` if the camera turns too far away from the picture.
    """
    bearings = seen_bearings(simulation)
    if not len(bearings):
        raise AmiwarpError("no pixel at the image's border has a valid ray; check the distortion and the prism")
    duration = simulation.duration_s
    at = simulation.camera_motion.orientation(duration)(np.linspace(0.0, duration, 400))
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for orientation in at if simulation.camera_motion.largest_rates.any() else at[:1]:
        x, y, z = orientation @ bearings.T
        if z.min() < SMALLEST_COSINE:
            angle = math.degrees(math.acos(max(-1.0, float(z.min()))))
            limit = math.degrees(math.acos(SMALLEST_COSINE))
            raise AmiwarpError(f"the camera looks up to {angle:.0f} deg away from the picture's centre; the limit is "
                               f"{limit:.0f} deg; turn the camera less far, or narrow its field of view")  # fmt: skip
        plane = np.stack([x / z, y / z])
        low, high = np.minimum(low, plane.min(axis=1)), np.maximum(high, plane.max(axis=1))
    focal = max(simulation.camera.fx, simulation.camera.fy)
    margin = 2.0 / focal
    view = (*(low - margin).tolist(), *(high + margin).tolist())
    scene = _pictures(simulation)
    return place_picture(scene.frames.size, view, TEXELS_PER_PIXEL * focal, fov=scene.fov)


def _pictures(simulation: SimulationValues) -> Scene:
    """Return the picture scene of a simulation; raise :class:`AmiwarpError` for a world."""
    if not isinstance(simulation.scene, Scene):
        raise AmiwarpError("the scene is a world, which has no picture at infinity; give a Scene")
    return simulation.scene


class MapRing:
    """Maps of a picture sequence for the current span of time, in slots of device memory.

    A map is the log intensity of a picture, resampled and blurred. Pictures are read when they are needed.
    """

    def __init__(self, simulation: SimulationValues, placement: Placement) -> None:
        """Open the pictures without reading them."""
        focal = max(simulation.camera.fx, simulation.camera.fy)
        scene = _pictures(simulation)
        self._blur = scene.blur * math.sqrt(placement.pitch[0] * placement.pitch[1]) / focal
        self.placement = placement
        turns = bool(simulation.camera_motion.largest_rates.any())
        self._orientation = simulation.camera_motion.orientation(simulation.duration_s) if turns else None
        self._frames = scene.frames.read()
        self._device = simulation.device
        self._texels = placement.width * placement.height
        self._held: list[tuple[int, int]] = []  # time [us] and slot of each map
        self._slots = MapSlots(self._texels, wp.vec4, device=self._device)

    @property
    def maps(self) -> wp.array:
        """Coefficients of bilinear interpolation of the log intensity at each texel of all maps, slot by slot."""
        return self._slots.arrays[0]

    def cover(self, start: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Load the maps for the span ``start`` .. ``stop`` [us]; return their times [us] and their slots.

        There is at least one map.
        """
        while not self._held or self._held[-1][0] < stop:
            following = next(self._frames, None)
            if following is None:
                break
            if len(self._held) > 1 and self._held[1][0] <= start:
                self._slots.give_back(self._held.pop(0)[1])
            slot = self._slots.take()
            pieces = bilinear_pieces(log_map(following[1], self.placement, self._blur)).reshape(-1, 4)
            wp.copy(self.maps, wp.array(pieces, dtype=wp.vec4, device=self._device), dest_offset=slot * self._texels)
            self._held.append((following[0], slot))
        while len(self._held) > 1 and self._held[1][0] <= start:
            self._slots.give_back(self._held.pop(0)[1])
        times, slots = zip(*self._held, strict=True)
        return np.array(times, np.float64), np.array(slots, np.int32)

    def orientations(self, t_us: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return rotation matrices from the camera's to the pictures' frame at times ``t_us`` [us], shape (n, 3, 3).

        None stands for a camera at rest.
        """
        return None if self._orientation is None else self._orientation(np.maximum(t_us, 0.0) * 1e-6)


def bilinear_pieces(texels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the coefficients of bilinear interpolation between texels, shape (height, width, 4).

    The coefficients are the factors of 1, x, y and xy between each texel and its right and lower neighbours.
    """
    pieces = np.zeros((*texels.shape, 4), np.float32)
    pieces[..., 0] = texels
    pieces[:, :-1, 1] = np.diff(texels, axis=1)
    pieces[:-1, :, 2] = np.diff(texels, axis=0)
    pieces[:-1, :, 3] = np.diff(pieces[..., 1], axis=0)
    return pieces


def log_view(simulation: SimulationValues) -> NDArray[np.float32]:
    """Return the first picture as the camera would see it without the prism at time 0.

    The result is the log intensity, shape (height, width).
    """
    camera, device = simulation.camera, wp.get_device(simulation.device)
    placement = place_scene(simulation)
    ring = MapRing(simulation, placement)
    ring.cover(0, 0)
    view = prism_view.View()
    view.camera, view.maps = camera_params(camera, str(device)), ring.maps
    view.width, view.height = placement.width, placement.height
    out = wp.empty(camera.width * camera.height, dtype=float, device=device)
    inputs = [view, wp.mat33(*placement.to_texel().ravel().tolist())]
    launch(prism_view.see_without_prism, len(out), inputs, [out], device=device)
    return np.asarray(out.numpy().reshape(camera.height, camera.width))


# Pixels of a simulation whose scene is known: pictures of other people's recordings do not show everything.


@runtime_checkable
class PartlyKnown(Protocol):
    """Pictures (:class:`amiwarp.Frames`) parts of which are guessed."""

    def take_known(self) -> list[tuple[int, NDArray[np.bool_]]]:
        """Return, and forget, the masks of the pictures read so far.

        Each is the time from which it holds [us], rising, and whether each pixel of the pictures is known, shape
        (height, width).
        """


class KnownPixels:
    """Masks of the pixels whose scene is known, without the prism. They are taken from the pictures while these run."""

    def __init__(self, simulation: SimulationValues) -> None:
        """Find the pixel of the pictures that each pixel of the camera sees."""
        scene = simulation.scene
        self._frames = scene.frames if isinstance(scene, Scene) and isinstance(scene.frames, PartlyKnown) else None
        self._duration_us = simulation.duration_us
        self._last: NDArray[np.bool_] | None = None
        if self._frames is not None:
            self._rows, self._columns, self._inside = picture_pixels(simulation)

    def take(self) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        """Yield time [us] and mask of each change since the last call, shape (height, width)."""
        for t, known in [] if self._frames is None else self._frames.take_known():
            mask = self._inside & known[self._rows, self._columns]
            if t <= self._duration_us and (self._last is None or (mask != self._last).any()):
                self._last = mask
                yield t, mask


def picture_pixels(simulation: SimulationValues) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return row and column of the picture that each pixel of the camera sees without the prism, and if it is inside.

    Each has the shape (height, width) of the camera. Rows and columns outside the picture are those nearest to it.
    """
    camera, place, scene = simulation.camera, place_scene(simulation), simulation.scene
    assert isinstance(scene, Scene)
    width, height = scene.frames.size
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = np.asarray(camera.pixels_to_rays(np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)))
    ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.0)
    rays = np.where(ahead[:, None], rays, (0.0, 0.0, 1.0))
    left, top, right, bottom = place.box
    column = left + (rays[:, 0] / rays[:, 2] - place.left) * place.pitch[0] * (right - left) / place.width
    row = top + (rays[:, 1] / rays[:, 2] - place.top) * place.pitch[1] * (bottom - top) / place.height
    inside = ahead & (column >= 0.0) & (column < width) & (row >= 0.0) & (row < height)
    rows, columns = (np.clip(v, 0, n - 1).astype(np.int64) for v, n in ((row, height), (column, width)))
    shape = (camera.height, camera.width)
    return rows.reshape(shape), columns.reshape(shape), inside.reshape(shape)
