"""Maps of a scene of pictures: placement before the camera, and log intensity on the device."""

import math

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import prism_view
from amiwarp.kernels.camera import camera_params
from amiwarp.kernels.launch import launch
from amiwarp.simulation.description import Scene, SimulationValues
from amiwarp.simulation.maps import SMALLEST_COSINE, TEXELS_PER_PIXEL, MapSlots
from amiwarp.simulation.picture_placement import Placement, log_map, place_picture
from amiwarp.simulation.view import mirrored, seen_bearings

ORIENTATIONS = 25
"""Number of orientations of the camera for which :func:`place_scene` turns all directions at a time."""


def place_scene(simulation: SimulationValues) -> Placement:
    """Place the picture so that it covers everything that the camera sees through the turning prism.

    Raises :class:`AmiwarpError` if the camera turns too far away from the picture.
    """
    bearings = seen_bearings(simulation)
    if not len(bearings):
        raise AmiwarpError(
            "no pixel at the image's border has a valid ray; check the distortion and the prism"
        )
    duration = simulation.duration_s
    moments = np.linspace(0.0, duration, 400)
    orientations = simulation.camera_motion.orientation(duration)(moments)
    if not simulation.camera_motion.largest_rates.any():
        orientations = orientations[:1]

    # What the camera sees on the plane at distance 1. All directions at once would take much memory.
    low = np.full(2, np.inf)
    high = np.full(2, -np.inf)
    parts = -(-len(orientations) // ORIENTATIONS)  # rounded up
    for some in np.array_split(orientations, parts):
        x, y, z = np.moveaxis(some @ bearings.T, 1, 0)
        if z.min() < SMALLEST_COSINE:
            angle = math.degrees(math.acos(max(-1.0, float(z.min()))))
            limit = math.degrees(math.acos(SMALLEST_COSINE))
            raise AmiwarpError(
                f"the camera looks up to {angle:.0f} deg away from the picture's centre; the limit is "
                f"{limit:.0f} deg; turn the camera less far, or narrow its field of view"
            )
        plane = np.stack([x / z, y / z])
        low = np.minimum(low, plane.min(axis=(1, 2)))
        high = np.maximum(high, plane.max(axis=(1, 2)))
    focal = max(simulation.camera.fx, simulation.camera.fy)
    margin = 2.0 / focal
    view = (*(low - margin).tolist(), *(high + margin).tolist())
    scene = pictures_of(simulation)
    return place_picture(scene.frames.size, view, TEXELS_PER_PIXEL * focal, fov=scene.fov)


def pictures_of(simulation: SimulationValues) -> Scene:
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
        scene = pictures_of(simulation)
        self._blur = scene.blur * math.sqrt(placement.pitch[0] * placement.pitch[1]) / focal
        self.placement = placement
        self._orientation = None
        if simulation.camera_motion.largest_rates.any():
            self._orientation = simulation.camera_motion.orientation(simulation.duration_s)
        self._frames = scene.frames.read()
        self._device = simulation.device
        self._texels = placement.width * placement.height
        # Time [us] and slot of each map.
        self._held: list[tuple[int, int]] = []
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
            time, picture = following
            # Each map that is dropped first saves a slot.
            if self._first_is_past(start):
                self._drop_first()
            self._held.append((time, self._upload(picture)))
        while self._first_is_past(start):
            self._drop_first()
        times, slots = zip(*self._held, strict=True)
        return np.array(times, np.float64), np.array(slots, np.int32)

    def orientations(self, t_us: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return rotation matrices from the camera's to the pictures' frame at times ``t_us`` [us], shape (n, 3, 3).

        None stands for a camera at rest.
        """
        if self._orientation is None:
            return None
        return self._orientation(np.maximum(t_us, 0.0) * 1e-6)

    def _upload(self, picture: NDArray[np.float32]) -> int:
        """Make the map of a picture; return its slot."""
        pieces = bilinear_pieces(log_map(picture, self.placement, self._blur))
        coefficients = wp.array(pieces.reshape(-1, 4), dtype=wp.vec4, device=self._device)
        slot = self._slots.take()
        wp.copy(self.maps, coefficients, dest_offset=slot * self._texels)
        return slot

    def _first_is_past(self, start: int) -> bool:
        """Return whether the first map is needed only before ``start`` [us]."""
        return len(self._held) > 1 and self._held[1][0] <= start

    def _drop_first(self) -> None:
        """Drop the first map."""
        _, slot = self._held.pop(0)
        self._slots.give_back(slot)


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
    camera = simulation.camera
    device = wp.get_device(simulation.device)
    placement = place_scene(simulation)
    ring = MapRing(simulation, placement)
    ring.cover(0, 0)
    view = prism_view.View()
    view.camera = camera_params(camera, str(device))
    view.maps = ring.maps
    view.width = placement.width
    view.height = placement.height
    out = wp.empty(camera.width * camera.height, dtype=float, device=device)
    to_texel = placement.to_texel() @ mirrored(simulation)
    inputs = [view, wp.mat33(*to_texel.ravel().tolist())]
    launch(prism_view.see_without_prism, len(out), inputs, [out], device=device)
    return np.asarray(out.numpy().reshape(camera.height, camera.width))
