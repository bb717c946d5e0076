"""The scene in front of a simulated camera, pictures or a world: what pixels see of it, maps of its log intensity."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.sharpness import gaussian
from amiwarp.kernels import prism_view, world_rays
from amiwarp.kernels import world as kernels
from amiwarp.kernels.camera import camera_params
from amiwarp.kernels.launch import launch
from amiwarp.kernels.plate import PlateParams
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import LARGEST_INVERSE_DEPTH, Model, PlateModel
from amiwarp.simulation.description import Mirror, Moved, Scene, SimulationValues
from amiwarp.simulation.pictures import DARK, Placement, log_map, place_picture
from amiwarp.simulation.worlds.world import Body, Material, Trajectory, World, WorldScene

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


# View of the simulated camera: placement of the picture, speed of the image, and maps of pictures on the device.

LARGEST_MOTION = 0.5
"""Largest motion of the image in a time step of the simulation [px]."""

LARGEST_BEND = 0.002
"""Largest distance of the orbit from its chord in a time step [px]. Brightness is interpolated along the chord, so that
orbits come out too small by up to two thirds of it."""

PAIR_MARGIN = 1.1
"""Margin of the image's motion by a pair of prisms over the sum of both, as each deflects what the other deflected."""

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

    prisms: NDArray[np.float64]
    """Largest motion of the image per rotation angle of each prism, or per angle of a vibration [px/rad]; shape (1,) or
    (2,)."""
    bends: NDArray[np.float64]
    """Largest change of this motion per angle [px/rad²], of the same shape."""
    camera: NDArray[np.float64]
    """Largest motion of the image per rotation angle of the camera about each of its axes [px/rad], shape (3,)."""


def step_us(
    simulation: SimulationValues, *, world_speed: float = 0.0, longest: float = math.inf, inverse_depth: float = 0.0
) -> int:
    """Return the length of a time step [us]: in it the image moves by at most half a pixel, and nearly straight.

    ``world_speed``: speed of the image of a world, prism excluded [px/s]; ``longest``: upper bound of the step [us];
    ``inverse_depth``: that of the nearest surface, for a plate [1/m].
    """
    motion = image_motion(simulation, inverse_depth)
    rates = simulation.camera_motion.largest_rates
    turning = np.array(
        [each.largest_speed for each in (simulation.prism_motion, simulation.prism_motion.second) if each]
    )
    speed = float(motion.prisms @ turning) + float(motion.camera @ rates) + world_speed
    bend = float(motion.bends @ turning**2) / 8.0  # [px/s²]: the distance from the chord, per squared step
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


def shake(simulation: SimulationValues, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what vibration or mirror do at times [us] to directions of the camera, shape (n, 3, 3).

    Those are the directions in which the camera at rest would see the same points, mirrored by a mirror. Without both
    it is the identity, shape (3, 3).
    """
    if not isinstance(simulation.prism, Moved):
        return np.eye(3)
    model = simulation.prism.model(simulation.camera)
    return mirrored(simulation) @ model.rotations(simulation.prism_motion.angles(t_us))


def mirrored(simulation: SimulationValues) -> NDArray[np.float64]:
    """Return what a mirror at rest does to directions of the camera, shape (3, 3); without one the identity."""
    mirror = simulation.prism
    return mirror.model(simulation.camera).reflection if isinstance(mirror, Mirror) else np.eye(3)


def image_motion(simulation: SimulationValues, inverse_depth: float = 0.0) -> ImageMotion:
    """Return the largest motion of the image on a grid of pixels, corners included, over one turn of what moves it.

    ``inverse_depth``: that of the nearest surface, for a plate [1/m].
    """
    camera, device = simulation.camera, simulation.device
    grid = np.stack(
        [m.ravel() for m in np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9))], 1
    )
    turns = 72
    theta = np.linspace(0.0, 2.0 * np.pi, turns + 1)
    xy = wp.array(np.repeat(grid, turns + 1, axis=0).astype(np.float32), dtype=wp.vec2, device=device)
    angles = wp.array(np.tile(theta, len(grid)).astype(np.float32), dtype=float, device=device)
    arc = (theta[1] / 2.0) / math.sin(theta[1] / 2.0)  # a step along a circle is longer than its chord
    prisms, bends = [], []
    shakes = isinstance(simulation.prism, Moved)
    models: list[Model] = [*(simulation.moving_model if shakes else simulation.bending).singles()]
    if simulation.plate is not None:
        models = [replace(simulation.plate, inverse_depth=min(inverse_depth, LARGEST_INVERSE_DEPTH))]
    for model in models:
        placed = model if shakes else replace(cast("Any", model), phase=0.0)
        path = placed.compensate_points(xy, angles).numpy().reshape(len(grid), turns + 1, 2)
        along = np.linalg.norm(np.diff(path, axis=1), axis=2)
        prisms.append(float(np.max(along, initial=0.0, where=np.isfinite(along))) * arc / theta[1])
        bends.append(prisms[-1])  # of a circle
        if shakes:
            curved = np.linalg.norm(np.diff(path, n=2, axis=1), axis=2)
            bends[-1] = float(np.max(curved, initial=0.0, where=np.isfinite(curved))) / theta[1] ** 2
    share = 1.0 if len(prisms) == 1 else PAIR_MARGIN
    return ImageMotion(np.array(prisms) * share, np.array(bends) * share, _camera_image_motion(simulation, grid))


def prism_view_of(simulation: SimulationValues, device: Any) -> Any:
    """Return the kernels' :class:`amiwarp.kernels.prism_view.View` with camera and prisms, without maps."""
    view, (prism, *second) = prism_view.View(), simulation.bending.singles()
    view.camera, view.prism = camera_params(simulation.camera, str(device)), prism.params(device)
    if second:
        view.second = second[0].params(device)
    return view


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
    motion, moved = simulation.prism_motion, simulation.prism if isinstance(simulation.prism, Moved) else None
    turns = moved is not None or simulation.glass.apex > 0.0 or any(motion.cylinder) or motion.second is not None
    turn = np.arange(24) * (2.0 * np.pi / 24) if turns else np.zeros(1)
    others = turn if motion.second is not None else np.zeros(1)
    theta = np.stack([m.ravel() for m in np.meshgrid(turn, others)], axis=1)
    if moved is not None:
        rays = np.asarray(camera.pixels_to_rays(border), np.float64)
        rays = rays[np.isfinite(rays).all(axis=1)]
        model = moved.model(camera)
        turned = mirrored(simulation) @ model.rotations(theta if model.ANGLES > 1 else theta[:, 0])
        return np.concatenate([rays @ each.T for each in turned])
    xy = wp.array(np.repeat(border, len(theta), axis=0).astype(np.float32), dtype=wp.vec2, device=device)
    angles = wp.array(np.tile(theta.astype(np.float32), (len(border), 1)), dtype=wp.vec2, device=device)
    out = wp.empty(len(xy), dtype=wp.vec3, device=device)
    inputs = [prism_view_of(simulation, wp.get_device(device)), xy, angles]
    launch(prism_view.scene_bearings, len(xy), inputs, [out], device=device)
    bearings = out.numpy().astype(np.float64)
    return np.asarray(bearings[np.isfinite(bearings).all(axis=1)])


ORIENTATIONS = 25
"""Number of orientations of the camera for which :func:`place_scene` turns all directions at a time."""


def place_scene(simulation: SimulationValues) -> Placement:
    """Place the picture so that it covers everything that the camera sees through the turning prism.

    Raises :class:`AmiwarpError` if the camera turns too far away from the picture.
    """
    bearings = seen_bearings(simulation)
    if not len(bearings):
        raise AmiwarpError("no pixel at the image's border has a valid ray; check the distortion and the prism")
    duration = simulation.duration_s
    orientations = simulation.camera_motion.orientation(duration)(np.linspace(0.0, duration, 400))
    if not simulation.camera_motion.largest_rates.any():
        orientations = orientations[:1]
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for some in np.array_split(orientations, -(-len(orientations) // ORIENTATIONS)):
        x, y, z = np.moveaxis(some @ bearings.T, 1, 0)
        if z.min() < SMALLEST_COSINE:
            angle = math.degrees(math.acos(max(-1.0, float(z.min()))))
            limit = math.degrees(math.acos(SMALLEST_COSINE))
            raise AmiwarpError(f"the camera looks up to {angle:.0f} deg away from the picture's centre; the limit is "
                               f"{limit:.0f} deg; turn the camera less far, or narrow its field of view")  # fmt: skip
        plane = np.stack([x / z, y / z])
        low, high = np.minimum(low, plane.min(axis=(1, 2))), np.maximum(high, plane.max(axis=(1, 2)))
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
    to_texel = placement.to_texel() @ mirrored(simulation)
    inputs = [view, wp.mat33(*to_texel.ravel().tolist())]
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


# Upload of a simulated world to a device: meshes, textures, lights, and poses of moving bodies at given instants.

CUDA_TREE = "cubql"
"""Warp's constructor of the bounding volume hierarchy of a mesh on a GPU.

Compared with Warp's default constructor, rays take 0.5 to 0.65 of the time on a GPU, but longer on a CPU.
"""
LARGEST_PYRAMID = 14
"""Largest number of levels (the texture and its halved copies) of a texture pyramid."""


class DeviceWorld:
    """Meshes, materials and light of a simulated world on a device.

    All bodies at rest form one mesh. Each moving body has its own mesh, and a pose at each instant.
    """

    def __init__(self, world: World, device: Any) -> None:
        self.world, self.device = world, wp.get_device(device)
        self.movers = world.moving
        names = {body.name for body in self.movers}
        still = [body for body in world.bodies if body.name not in names]
        bodies = [*still, *self.movers]  # the kernels number the bodies in this order
        texels = _Texels()
        numbers = {label: k + 1 for k, label in enumerate(world.instances)}
        surfaces = [_surface(body, numbers[body.instance or body.name], texels) for body in bodies]
        p = self.params = kernels.World()
        p.panorama, p.sky, p.first_mover = -1, world.sky.luminance, len(still)
        if world.sky.panorama is not None:
            p.panorama = texels.add(world.sky.panorama, 1)
            p.panorama_height, p.panorama_width = world.sky.panorama.shape
        resting = [_resting(body) for body in still]
        self._upload_faces(bodies, [*resting, *(np.asarray(body.mesh.vertices) for body in self.movers)], surfaces)
        p.surfaces = wp.array(surfaces, dtype=kernels.Surface, device=self.device)
        p.texels = wp.array(texels.joined(), dtype=float, device=self.device)
        self._upload_light()
        self._meshes: list[Any] = []
        p.still = self._mesh(resting, still).id if still else wp.uint64(0)
        self._upload_movers(sum(len(np.asarray(body.mesh.faces)) for body in still))
        self.set_instants(np.zeros(1))

    def _mesh(self, vertices: Sequence[NDArray[np.float64]], bodies: Sequence[Body]) -> Any:
        """Return one Warp mesh of several bodies, whose vertices are given [m]."""
        starts = np.cumsum([0, *(len(v) for v in vertices)])
        faces = [np.asarray(body.mesh.faces) + start for body, start in zip(bodies, starts, strict=False)]
        points = wp.array(np.concatenate(vertices).astype(np.float32), dtype=wp.vec3, device=self.device)
        indices = wp.array(np.concatenate(faces).ravel().astype(np.int32), dtype=int, device=self.device)
        mesh = wp.Mesh(points, indices, bvh_constructor=None if self.device.is_cpu else CUDA_TREE)
        self._meshes.append(mesh)
        return mesh

    def _upload_faces(
        self, bodies: Sequence[Body], vertices: Sequence[NDArray[np.float64]], surfaces: Sequence[Any]
    ) -> None:
        """Upload the body number, corners, texture coordinates and reflectance factors of each face.

        ``vertices``: those of each body in the frame of its mesh on the device [m].
        """
        number, corners, uv, shade, density = [], [], [], [], []
        for k, body in enumerate(bodies):
            mesh, faces = body.mesh, np.asarray(body.mesh.faces)
            corners.append(vertices[k][faces.ravel()])
            number.append(np.full(len(faces), k, np.int32))
            place = np.zeros((len(np.asarray(mesh.vertices)), 2)) if mesh.uv is None else np.asarray(mesh.uv)
            light = np.ones(len(place)) if mesh.light is None else np.asarray(mesh.light)
            uv.append(place[faces.ravel()])
            shade.append(light[faces.ravel()])
            density.append(_density(mesh, place, surfaces[k]))
        p = self.params
        p.body = wp.array(np.concatenate(number), dtype=int, device=self.device)
        p.corners = wp.array(np.concatenate(corners).astype(np.float32), dtype=wp.vec3, device=self.device)
        p.uv = wp.array(np.concatenate(uv).astype(np.float32), dtype=wp.vec2, device=self.device)
        p.shade = wp.array(np.concatenate(shade).astype(np.float32), dtype=float, device=self.device)
        p.density = wp.array(np.concatenate(density).astype(np.float32), dtype=float, device=self.device)

    def _upload_light(self) -> None:
        """Upload ambient light, sun and the positions of lamps."""
        p, world = self.params, self.world
        p.ambient, p.sun = world.ambient, wp.vec3(0.0, 0.0, 1.0)
        if world.sun is not None:
            p.sun, p.sun_light = wp.vec3(*world.sun.direction), world.sun.intensity
            p.sun_shadows = int(world.sun.shadows)
        lamps = []
        for given in world.lamps:
            lamp = kernels.Lamp()
            lamp.position, lamp.shadows = wp.vec3(*given.position), int(given.shadows)
            lamps.append(lamp)
        p.lamps = wp.array(lamps, dtype=kernels.Lamp, device=self.device)

    def _upload_movers(self, first: int) -> None:
        """Upload the meshes of the moving bodies. ``first``: number of the first face of the first moving body."""
        movers = []
        for body in self.movers:
            mover = kernels.Mover()
            vertices = np.asarray(body.mesh.vertices)
            mover.mesh, mover.first_face = self._mesh([vertices], [body]).id, first
            mover.lower, mover.upper = (wp.vec3(*v.tolist()) for v in (vertices.min(axis=0), vertices.max(axis=0)))
            mover.radius = body.mesh.bounding_sphere[1] * 1.001
            first += len(np.asarray(body.mesh.faces))
            movers.append(mover)
        self.params.movers = wp.array(movers, dtype=kernels.Mover, device=self.device)

    def set_instants(self, t: NDArray[np.float64]) -> None:
        """Set the instants at which kernels can see the world: ``t`` [s], shape (n,).

        Uploads the poses of moving bodies and the light of the lamps at these times.
        """
        poses: NDArray[Any] = np.zeros((len(t), len(self.movers)), cast("Any", kernels.Pose).numpy_dtype())
        centres = np.zeros((len(t), len(self.movers), 3), np.float32)
        for k, body in enumerate(self.movers):
            assert body.trajectory is not None
            rotation, position = body.trajectory.poses(t)
            poses["rotation"][:, k], poses["position"][:, k] = rotation, position
            centres[:, k] = rotation @ body.mesh.bounding_sphere[0] + position
        self.params.poses = wp.array(poses, dtype=kernels.Pose, device=self.device)
        self.params.centres = wp.array(centres, dtype=wp.vec3, device=self.device)
        lights = [lamp.intensity * (1.0 + lamp.flicker_depth * np.sin(2.0 * math.pi * lamp.flicker_hz * t))
                  for lamp in self.world.lamps]  # fmt: skip
        table = np.stack(lights, axis=1) if lights else np.zeros((len(t), 0))
        self.params.lamp_light = wp.array(table.astype(np.float32), dtype=float, device=self.device)


class _Texels:
    """Texels of all texture pyramids in one array."""

    def __init__(self) -> None:
        self._parts: list[NDArray[np.float32]] = [np.zeros(1, np.float32)]
        self._count = 1
        self._known: dict[int, int] = {}

    def add(self, texture: NDArray[np.float32], levels: int) -> int:
        """Append a texture and its halved copies, ``levels`` in total; return the index of the first texel."""
        if id(texture) in self._known:
            return self._known[id(texture)]
        first = self._known[id(texture)] = self._count
        for level in range(levels):
            self._parts.append(np.ascontiguousarray(texture, np.float32).ravel())
            self._count += texture.size
            if level + 1 < levels:
                texture = _halved(texture)
        return first

    def joined(self) -> NDArray[np.float32]:
        """Return the texels of all pyramids."""
        return np.concatenate(self._parts)


def _halved(texture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a texture at half its size, rounded down; each texel is the mean of up to four texels."""
    rows, columns = (size // 2 * 2 for size in texture.shape)
    if rows:
        texture = (texture[0:rows:2] + texture[1:rows:2]) / np.float32(2.0)
    if columns:
        texture = (texture[:, 0:columns:2] + texture[:, 1:columns:2]) / np.float32(2.0)
    return texture


def _levels(material: Material) -> int:
    """Return the number of levels of the pyramid of a material's texture; 0 without a texture."""
    if material.texture is None:
        return 0
    return min(LARGEST_PYRAMID, max(material.texture.shape).bit_length())


def _surface(body: Body, number: int, texels: _Texels) -> Any:
    """Return the kernels' description of a body's material, and add its texture to ``texels``.

    ``number``: instance number of the body.
    """
    material, s = body.material, kernels.Surface()
    s.reflectance, s.emission, s.instance, s.texel = material.reflectance, material.emission, number, -1
    if material.texture is not None:
        s.levels = _levels(material)
        s.texel = texels.add(material.texture, s.levels)
        s.height, s.width = material.texture.shape
    return s


def _resting(body: Body) -> NDArray[np.float64]:
    """Return the vertices of a body at rest, in the world's frame."""
    vertices = np.asarray(body.mesh.vertices)
    if body.trajectory is None:
        return vertices
    rotation, position = body.trajectory.poses(np.zeros(1))
    return np.asarray(vertices @ rotation[0].T + position[0])


def _density(mesh: Any, place: NDArray[np.float64], surface: Any) -> NDArray[np.float64]:
    """Return the texture resolution on each face [texels/m], shape (faces,); 0 without a texture.

    ``place``: texture coordinates of the vertices, shape (n, 2).
    """
    faces = np.asarray(mesh.faces)
    if surface.texel < 0:
        return np.zeros(len(faces))
    a, b, c = (np.asarray(mesh.vertices)[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    p, q, r = (place[faces[:, k]] * (surface.width, surface.height) for k in range(3))
    (ux, uy), (vx, vy) = (q - p).T, (r - p).T
    return np.asarray(np.sqrt(np.abs(ux * vy - uy * vx) / np.maximum(area, 1e-12)))


# Surfaces that rays hit, and the renderer of maps of log intensity.

SMALLEST_LAUNCH = 1 << 10
"""Smallest number of rays that one CPU thread handles."""
ROTATED_GRID = [(-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375)]
"""Positions of four samples relative to the pixel's centre [px].

The positions are fixed, because random positions would differ between maps and cause events.
"""
TILE = int(kernels.TILE)
"""Side of a tile of a map [texels]."""


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """Surface that each of n rays hits first."""

    depth: NDArray[np.float32]
    """Depth of the surface along the camera's optical axis [m], shape (n,); infinite for the sky."""
    normal: NDArray[np.float32]
    """Unit normals in the world's frame, pointing to the camera's side, shape (n, 3); zero for the sky."""
    instance: NDArray[np.int32]
    """Instance numbers, shape (n,): 0 is the sky, i + 1 is ``World.instances[i]``."""
    mover: NDArray[np.int32]
    """Index of the body in ``World.moving``, shape (n,); -1 for bodies at rest and for the sky."""
    place: NDArray[np.float32]
    """Points on the surfaces, in the world's frame [m], shape (n, 3)."""


def device_pose(rotation: NDArray[np.float64], position: NDArray[np.float64]) -> Any:
    """Return the kernels' pose of a rotation matrix (3, 3) and a position (3,) [m]."""
    pose = kernels.Pose()
    pose.rotation = wp.mat33(*np.asarray(rotation).ravel().tolist())
    pose.position = wp.vec3(*np.asarray(position).tolist())
    return pose


def surfaces_at(
    world: DeviceWorld,
    rays: NDArray[Any],
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    instant: int = 0,
    centres: NDArray[Any] | None = None,
) -> SurfaceView:
    """Return the surfaces that rays from a camera hit.

    ``rays``: directions in the camera's frame, shape (n, 3); ``rotation``, ``position`` [m]: pose of the camera;
    ``instant``: index of the time in the last call of :meth:`DeviceWorld.set_instants`; ``centres``: where the rays
    begin in the camera's frame [m], shape (n, 3), by default at its origin.
    """
    n, device = len(rays), world.device
    out = world_rays.Surfaces()
    for name, dtype in (("depth", float), ("normal", wp.vec3), ("instance", int), ("mover", int), ("place", wp.vec3)):
        setattr(out, name, wp.empty(n, dtype=dtype, device=device))
    unit = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    starts = np.empty((0, 3), np.float32) if centres is None else centres.astype(np.float32)
    places = [wp.array(values, dtype=wp.vec3, device=device) for values in (unit, starts)]
    inputs = [world.params, instant, *places, device_pose(rotation, position)]
    launch(world_rays.find_surfaces, n, inputs, [out], device=device, smallest=SMALLEST_LAUNCH)
    return SurfaceView(*(getattr(out, name).numpy() for name in ("depth", "normal", "instance", "mover", "place")))


def pixel_rays(camera: Camera) -> NDArray[np.float64]:
    """Return the unit rays of all pixels in the camera's frame, row by row, shape (height * width, 3)."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.pixels_to_rays(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64))


def sample_grid(samples: int, device: Any) -> wp.array:
    """Return the positions of ``samples`` rays relative to the centre of their pixel [px], on the device."""
    centres = (np.arange(math.isqrt(samples)) + 0.5) / math.isqrt(samples) - 0.5
    places = ROTATED_GRID if samples == 4 else [(x, y) for y in centres for x in centres]
    return wp.array(np.array(places, np.float32), dtype=wp.vec2, device=device)


def first_hits(n: int, device: Any) -> Any:
    """Return the :class:`amiwarp.kernels.world.FirstHits` of ``n`` rays, without an array for the luminance."""
    hits = kernels.FirstHits()
    hits.face = wp.empty(n, dtype=int, device=device)
    hits.white = wp.empty(n, dtype=float, device=device)
    hits.normal = wp.empty(n, dtype=wp.vec3, device=device)
    return hits


class MapRenderer:
    """Renderer of maps: pictures of a world on a plane at distance 1 from the camera, without the prism.

    One array holds the log intensity of all maps, as coefficients of bilinear interpolation. A second array holds the
    number of the face that each texel sees.
    """

    def __init__(self, world: DeviceWorld, frame: Any, *, blur: float, dark: float, samples: int) -> None:
        """Set up the renderer.

        ``frame``: a :class:`amiwarp.kernels.world.MapFrame` without a pose; ``blur``: standard deviation [texels];
        ``dark``: luminance added before the logarithm; ``samples``: rays per texel at edges.
        """
        self._world, self._frame, self._dark = world, frame, dark
        frame.offsets = sample_grid(samples, world.device)
        n = frame.width * frame.height
        self._smooth, self._half = (wp.empty(n, dtype=float, device=world.device) for _ in range(2))
        self._hits = first_hits(n, world.device)
        self._hits.light = wp.empty(n, dtype=float, device=world.device)
        half = gaussian(blur)
        self._weights = wp.array(np.concatenate([half[:0:-1], half]), dtype=float, device=world.device)
        self._grid = (-(-frame.height // TILE), -(-frame.width // TILE))
        self._reach = -(-len(half) // TILE)  # [tiles]: the blur, and the next texel for interpolation
        self._all = self._numbers(np.ones(self._grid, bool))

    def render(self, pose: Any, maps: wp.array, faces: wp.array, first: int) -> None:
        """Render the whole map of the world's first instant into the arrays, from index ``first`` on."""
        self._frame.pose, self._frame.instant, self._frame.first = pose, 0, first
        self._cast(self._all, faces)
        self._blur(self._all, self._all, maps)

    def render_between(
        self, pose: Any, maps: wp.array, faces: wp.array, first: int, ends: tuple[int, int], weight: float
    ) -> None:
        """Render a map between an earlier and a later map, which begin at the indices ``ends``.

        The map is interpolated, with weight ``weight`` of the later map, and rendered only where bodies move. The
        world's first three instants are the times of this map, of the earlier and of the later map.
        """
        from scipy.ndimage import binary_dilation

        frame, world = self._frame, self._world
        n = frame.width * frame.height
        launch(kernels.interpolate_maps, n, [maps, faces, *ends, weight, first], [], device=world.device)
        frame.pose, frame.instant, frame.first = pose, 0, ends[0]
        marks = wp.empty(self._grid[0] * self._grid[1], dtype=wp.uint8, device=world.device)
        inputs = [world.params, frame, faces, 3]
        launch(kernels.mark_tiles, len(marks), inputs, [marks], device=world.device, smallest=SMALLEST_LAUNCH)
        neighbours = np.ones((3, 3), bool)
        changed = binary_dilation(marks.numpy().reshape(self._grid), neighbours)
        if not changed.any():
            return
        frame.first = first
        written = binary_dilation(changed, neighbours, iterations=self._reach)
        cast = binary_dilation(written, neighbours, iterations=self._reach)
        self._cast(self._numbers(cast), faces)
        self._blur(self._numbers(cast), self._numbers(written), maps)

    def _numbers(self, tiles: NDArray[np.bool_]) -> wp.array:
        """Return the numbers of the marked tiles, counted row by row, on the device."""
        return wp.array(np.flatnonzero(tiles).astype(np.int32), dtype=int, device=self._world.device)

    def _cast(self, tiles: wp.array, faces: wp.array) -> None:
        """Cast the rays of tiles, and compute their luminance before the blur."""
        f, device = self._frame, self._world.device
        f.tiles = tiles
        inputs, n = [self._world.params, f], len(tiles) * TILE * TILE
        launch(kernels.render_map, n, inputs, [faces, self._hits], device=device, smallest=SMALLEST_LAUNCH)
        if len(f.offsets) == 1:
            wp.copy(self._smooth, self._hits.light)
            return
        inputs += [self._hits]
        launch(kernels.smooth_edges, n, inputs, [self._smooth], device=device, smallest=SMALLEST_LAUNCH)

    def _blur(self, tiles: wp.array, written: wp.array, maps: wp.array) -> None:
        """Blur the luminance of ``tiles``, and write the log intensities of the tiles ``written`` to ``maps``."""
        f, device = self._frame, self._world.device
        for across, source, target in ((0, self._smooth, self._half), (1, self._half, self._smooth)):
            inputs = [f, source, self._weights, across]
            launch(kernels.blur_lines, len(tiles) * TILE * TILE, inputs, [target], device=device)
        f.tiles = written
        inputs = [f, self._smooth, self._dark]
        launch(kernels.log_pieces, len(written) * TILE * TILE, inputs, [maps], device=device)


# Speed at which the image of a simulated world moves.
#
# The simulator derives the length of its time steps and the times of its maps from this speed.

PROBE = 48
"""Number of columns of the grid of rays that measures the distances of visible surfaces."""
NEAREST_M = 0.02
"""Smallest distance for which speeds in the image are computed [m]. Nearer surfaces are treated as this far away."""
MOMENT_S = 1e-3
"""Time over which speeds are computed as difference quotients [s]."""
FLICKER_SAMPLES = 16
"""Smallest number of time steps, and of maps, per period of a flickering lamp."""
SAFETY = 1.2
"""Factor by which a speed measured on a coarse grid is increased, because the grid can miss the fastest pixel."""


def body_speed(body: Body, trajectory: Trajectory, focal: float, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an upper bound of a moving body's speed in the image [px/s] at times [s], shape ``(n,)``."""
    assert body.trajectory is not None
    centre, radius = body.mesh.bounding_sphere
    rotation, position = body.trajectory.poses(t)
    rotation_after, position_after = body.trajectory.poses(t + MOMENT_S)
    place = rotation @ centre + position - trajectory.poses(t)[1]
    place_after = rotation_after @ centre + position_after - trajectory.poses(t + MOMENT_S)[1]
    speed = np.linalg.norm(place_after - place, axis=1) / MOMENT_S
    distance = np.maximum(np.linalg.norm(place, axis=1) - radius, NEAREST_M)
    return np.asarray(focal * (speed + turn_rate(rotation, rotation_after) * radius) / distance)


def turn_rate(rotation: NDArray[np.float64], rotation_after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angular speed [rad/s] between rotations (n, 3, 3) that are :data:`MOMENT_S` apart."""
    cosine = (np.einsum("nij,nij->n", rotation, rotation_after) - 1.0) / 2.0
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) / MOMENT_S)


def parallax_speed(world: DeviceWorld, camera: Camera, trajectory: Trajectory, t: float, instant: int) -> float:
    """Return the largest speed in the image [px/s] that the camera's translation causes.

    ``instant``: index of the time ``t`` [s] in the last call of :meth:`DeviceWorld.set_instants`.
    """
    before, after = (trajectory.poses([at]) for at in (t, t + MOMENT_S))
    velocity = (after[1][0] - before[1][0]) / MOMENT_S
    if not velocity.any():
        return 0.0
    seen = surfaces_at(world, pixel_rays(small_camera(camera)), before[0][0], before[1][0], instant)
    near = seen.place[np.isfinite(seen.depth)].astype(np.float64) - before[1][0]
    if not len(near):
        return 0.0
    distance = np.maximum(np.linalg.norm(near, axis=1), NEAREST_M)
    along = near / distance[:, None]
    across = np.linalg.norm(velocity - (along @ velocity)[:, None] * along, axis=1)
    return float(SAFETY * max(camera.fx, camera.fy) * (across / distance).max())


def largest_inverse_depth(world: DeviceWorld, camera: Camera, trajectory: Trajectory, duration_s: float) -> float:
    """Return the inverse depth of the nearest surface that a camera sees on its way [1/m], with a margin."""
    nearest = math.inf
    times = np.linspace(0.0, duration_s, MOMENTS if trajectory.moves or world.movers else 1)
    world.set_instants(times)
    for k, (rotation, position) in enumerate(zip(*trajectory.poses(times), strict=True)):
        seen = surfaces_at(world, pixel_rays(small_camera(camera)), rotation, position, k)
        nearest = min(nearest, float(seen.depth.min()))
    return SAFETY / max(nearest, NEAREST_M)


def small_camera(camera: Camera) -> Camera:
    """Return a camera of the same view whose pixels are the grid of rays that measures distances."""
    scale = PROBE / camera.width
    return Camera(
        PROBE, max(1, round(camera.height * scale)), camera.fx * scale, camera.fy * scale,
        (camera.cx + 0.5) * scale - 0.5, (camera.cy + 0.5) * scale - 0.5,
    )  # fmt: skip


def movers_speed(world: DeviceWorld, camera: Camera, trajectory: Trajectory, t: NDArray[np.float64]) -> NDArray[Any]:
    """Return an upper bound of the speed of all moving bodies in the image [px/s] at times [s], shape ``(n,)``."""
    speeds = [body_speed(body, trajectory, max(camera.fx, camera.fy), t) for body in world.movers]
    return np.max([np.zeros(len(t)), *speeds], axis=0)


def rotation_speed(camera: Camera, trajectory: Trajectory, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an upper bound of the speed in the image [px/s] due to the camera's rotation at times [s], shape (n,)."""
    rate = turn_rate(*(trajectory.poses(at)[0] for at in (t, t + MOMENT_S)))
    corner = math.hypot(max(camera.cx, camera.width - 1 - camera.cx), max(camera.cy, camera.height - 1 - camera.cy))
    focal = max(camera.fx, camera.fy)
    return np.asarray(rate * focal * (1.0 + (corner / focal) ** 2))


def flicker_interval_s(world: Any) -> float:
    """Return the longest time between two renderings of a world with flickering lamps [s].

    The time is infinite if no lamp flickers.
    """
    rates = [lamp.flicker_hz for lamp in world.lamps if lamp.flicker_hz and lamp.flicker_depth]
    return 1.0 / (FLICKER_SAMPLES * max(rates)) if rates else math.inf


# Pre-rendered pictures (maps) of a simulated world at successive times along the camera's trajectory.

MARGIN_PX = 24.0
"""Border of a map around the view of a moving camera [px]. If the camera rotates further, the
orientation of the maps changes."""
LONGEST_S = 0.5
"""Longest time between two successive maps if the camera or a body moves, or a lamp flickers [s]."""
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
    """Number of the slot that holds the map, see :class:`amiwarp.simulation.scenery.MapSlots`."""
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
        self, simulation: SimulationValues, scene: WorldScene, world: DeviceWorld, bearings: NDArray[np.float64]
    ) -> None:
        """Place the maps. ``bearings``: directions that the camera sees over a turn of the prism, shape (n, 3)."""
        self._scene, self._camera, self._bearings, self._world = scene, simulation.camera, bearings, world
        focal = max(self._camera.fx, self._camera.fy)
        self.placement = _placement(bearings, focal, MARGIN_PX / focal if scene.trajectory.moves else 2.0 / focal)
        p, frame = self.placement, kernels.MapFrame()
        frame.left, frame.top, (frame.pitch_x, frame.pitch_y) = p.left, p.top, p.pitch
        frame.width, frame.height, frame.cone = p.width, p.height, 1.0 / (TEXELS_PER_PIXEL * focal)
        self._renderer = MapRenderer(self._world, frame, blur=map_blur(scene.blur), dark=DARK,
                                     samples=scene.samples or SAMPLES)  # fmt: skip
        self._texels = p.width * p.height
        self._slots = MapSlots(self._texels, wp.vec4, wp.int32, device=simulation.device)
        self._held: list[HeldMap] = []
        self._whole: list[HeldMap] = []  # whole maps before and after the last held map; one at the start
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
        return np.array([m.time for m in self._held], np.float64), np.array([m.slot for m in self._held], np.int32)

    def orientations(self, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rotation matrices from the camera's frame to the frame of the map at each time [us], (n, 3, 3)."""
        times = np.array([m.time for m in self._held])
        which = np.clip(np.searchsorted(times, t_us, side="right") - 1, 0, len(times) - 1)
        reference = np.stack([m.orientation for m in self._held])[which]
        rotation, _ = self._scene.trajectory.poses(np.maximum(t_us, 0.0) * 1e-6)
        return np.asarray(np.swapaxes(reference, 1, 2) @ rotation)

    def _next(self) -> None:
        """Append the next whole map, or the next inserted map before it."""
        last = self._held[-1]
        whole, between = self._intervals_s(last.time * 1e-6)
        if last is self._whole[-1]:
            self._whole = [last, *self._following(last, whole)]
        if last.time + 1e6 * between < self._whole[1].time:
            self._held.append(self._render_between(last.time + 1e6 * between))
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
        start, reference = last.time * 1e-6, last.orientation
        turned = self._scene.trajectory.poses(np.linspace(start, start + interval, 9)[1:])[0]
        if all(self._fits(reference.T @ rotation) for rotation in turned):
            return [self._render(start + interval, reference)]
        at = self._last_fit(start, start + interval, reference)
        return [self._render(at, reference), self._render(at, self._scene.trajectory.poses([at])[0][0])]

    def _intervals_s(self, t: float) -> tuple[float, float]:
        """Return the times [s] from ``t`` [s] until the next whole map and until the next whole or inserted map."""
        scene, camera = self._scene, self._camera
        self._world.set_instants(np.array([t]))
        parallax = parallax_speed(self._world, camera, scene.trajectory, t, 0)
        movers = float(movers_speed(self._world, camera, scene.trajectory, np.array([t]))[0])
        longest = min(LONGEST_S, flicker_interval_s(scene.world))
        whole, between = (min(longest, scene.motion_px / max(v, 1e-9)) for v in (parallax, parallax + movers))
        if not self._world.device.is_cpu:
            whole = between  # a GPU renders a whole map faster than the host finds the tiles in which bodies move
        return max(whole, 1e-6), max(between, 1e-6)

    def _fits(self, turned: NDArray[np.float64]) -> bool:
        """Return whether the view of a camera, rotated by ``turned`` (3, 3) relative to the map, lies on the map."""
        x, y, z = turned @ self._bearings.T
        if z.min() < SMALLEST_COSINE:
            return False
        p = self.placement
        inside_x = (x / z >= p.left) & (x / z <= p.left + p.width / p.pitch[0])
        inside_y = (y / z >= p.top) & (y / z <= p.top + p.height / p.pitch[1])
        return bool((inside_x & inside_y).all())

    def _last_fit(self, low: float, high: float, reference: NDArray[np.float64]) -> float:
        """Return the latest time [s] between ``low`` and ``high`` at which the camera's view lies on the map.

        ``reference``: orientation of the map, shape (3, 3).
        """
        for _ in range(20):
            middle = (low + high) / 2.0
            rotation, _ = self._scene.trajectory.poses([middle])
            low, high = (middle, high) if self._fits(reference.T @ rotation[0]) else (low, middle)
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
        pose, ends = (
            device_pose(before.orientation, position[0]),
            (before.slot * self._texels, after.slot * self._texels),
        )
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

    The total blur includes that of the texels' area and of bilinear interpolation (:data:`TEXEL_VARIANCE`).
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
    low_x, high_x = float((x / z).min()) - margin, float((x / z).max()) + margin
    low_y, high_y = float((y / z).min()) - margin, float((y / z).max()) + margin
    pitch = TEXELS_PER_PIXEL * focal
    width, height = math.ceil((high_x - low_x) * pitch), math.ceil((high_y - low_y) * pitch)
    return Placement(width, height, (0.0, 0.0, 1.0, 1.0), low_x, low_y, (pitch, pitch))


# Connection of the event simulator to a world: rays of pixels, image speeds, and surfaces that events saw.

RAYS_PER_PIXEL = 4
"""Default number of rays per pixel if pixels see the world by rays."""
LEAST_CONE_PX = 0.25
"""Smallest width of the cone of a ray [px]. Textures are averaged over the cone."""
MOMENTS = 64
"""Number of times in a simulation at which the speed of the world's image is computed."""
INSTANTS_TOGETHER = 16
"""Number of instants at which all pixels cast their rays together."""


def aperture(samples: int, blur: float) -> NDArray[np.float32]:
    """Return the rays of a pixel, shape (n, 3): x and y relative to the centre [px], and weights that sum to 1.

    The rays are the nodes of a Gauss-Hermite quadrature with the standard deviation ``blur`` of the optical blur [px].
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(math.isqrt(samples))
    x, y = np.meshgrid(nodes * blur, nodes * blur)
    return np.stack([x.ravel(), y.ravel(), np.outer(weights, weights).ravel() / weights.sum() ** 2], 1).astype(
        np.float32
    )


@dataclass(frozen=True, slots=True)
class ImageSpeed:
    """Upper bounds of the speed at which a world's image without the prism moves [px/s]."""

    total: float
    """Speed due to all motion of the camera and the bodies [px/s]."""
    in_maps: float
    """Speed due to moving bodies and the camera's translation [px/s], which require new maps."""


def image_speed(world: DeviceWorld, simulation: SimulationValues, scene: WorldScene) -> ImageSpeed:
    """Return the largest speeds of a world's image over the duration of a simulation."""
    t = np.linspace(0.0, simulation.duration_s, MOMENTS)
    camera, trajectory = simulation.camera, scene.trajectory
    world.set_instants(t)
    speed = movers_speed(world, camera, trajectory, t)
    if trajectory.moves:
        speed = speed + [parallax_speed(world, camera, trajectory, float(at), k) for k, at in enumerate(t)]
    total = speed + rotation_speed(camera, trajectory, t)
    return ImageSpeed(float(total.max()), float(speed.max()))


class WorldSight:
    """Light that pixels receive from a world through the prism, at the instants of a chunk of simulated time."""

    def __init__(self, simulation: SimulationValues, scene: WorldScene, world: DeviceWorld) -> None:
        self._scene, self._world, device = scene, world, world.device
        self._simulation = simulation
        camera, samples = simulation.camera, scene.samples or RAYS_PER_PIXEL
        rays = aperture(samples, scene.blur)
        view = self._view = world_rays.RayView()
        view.camera = camera_params(camera, str(device))
        self.set_plate(simulation.plate)
        view.aperture = wp.array(rays, dtype=wp.vec3, device=device)
        view.reach = max(1, math.ceil(float(np.abs(rays[:, :2]).max())))
        side = math.isqrt(samples)
        width = 1.0 if side == 1 else max(2.0 * scene.blur * math.sqrt(2.0 / side), LEAST_CONE_PX)
        view.cone = width / max(camera.fx, camera.fy)
        self._pixels = camera.width * camera.height
        self._tiled = math.prod(-(-size // TILE) * TILE for size in (camera.width, camera.height))
        self._light: wp.array = wp.empty(0, dtype=float, device=device)
        self._cast: wp.array = wp.empty(0, dtype=float, device=device)
        self._batch = world_rays.Batch()
        self._marks: wp.array = wp.empty(0, dtype=int, device=device)
        self._listed: wp.array = wp.empty(0, dtype=int, device=device)

    def set_plate(self, plate: PlateModel | None) -> None:
        """Set the plate through which the camera looks; None takes it out."""
        self._view.plate = PlateParams() if plate is None else plate.params(self._world.device)

    def through_plate(self, rays: NDArray[Any], angle: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where rays of the camera, shape (n, 3), begin at an azimuth of the plate [rad], and their directions.

        Places [m] and directions have the shape (n, 3).
        """
        device = self._world.device
        given = wp.array(rays.astype(np.float32), dtype=wp.vec3, device=device)
        places, directions = wp.empty_like(given), wp.empty_like(given)
        inputs = [self._view, wp.vec2(math.cos(angle), math.sin(angle)), given]
        launch(world_rays.find_centres, len(rays), inputs, [places, directions], device=device)
        return places.numpy(), directions.numpy()

    def set_instants(self, t_us: NDArray[np.float64], view: Any) -> None:
        """Set the poses of the camera and the bodies at the instants of a chunk.

        ``t_us``: times [us]; ``view``: a :class:`amiwarp.kernels.prism_view.View` with the prism.
        """
        t = np.maximum(t_us, 0.0) * 1e-6
        self._world.set_instants(t)
        poses: NDArray[Any] = np.zeros(len(t), cast("Any", kernels.Pose).numpy_dtype())
        rotation, poses["position"] = self._scene.trajectory.poses(t)
        poses["rotation"] = rotation @ shake(self._simulation, t_us)
        self._view.poses = wp.array(poses, dtype=kernels.Pose, device=self._world.device)
        self._view.prism, self._view.second = view.prism, view.second

    def light(self, steps: Any, first: int, count: int) -> wp.array:
        """Return the luminance that each pixel sees at ``count`` instants, the first of which has the index ``first``.

        The shape of the array is (count, pixels). The array is valid until the next call.
        """
        n = self._pixels
        if len(self._light) < count * n:
            self._light = wp.empty(count * n, dtype=float, device=self._world.device)
        self._reserve(min(count, INSTANTS_TOGETHER))
        for k in range(0, count, INSTANTS_TOGETHER):
            self._batch.first, self._batch.count = first + k, min(INSTANTS_TOGETHER, count - k)
            self._batch.hits.light = self._light[k * n : (k + self._batch.count) * n]
            self._cast_batch(steps)
        return self._light[: count * n].reshape((count, n))

    def _reserve(self, count: int) -> None:
        """Allocate the arrays of a batch of ``count`` instants."""
        if len(self._listed) < count * self._tiled:
            device = self._world.device
            self._batch.hits = first_hits(count * self._pixels, device)
            self._marks, self._listed = (wp.empty(count * self._tiled, dtype=int, device=device) for _ in range(2))

    def _cast_batch(self, steps: Any) -> None:
        """Write the luminance of all pixels at the instants of the batch to ``light`` of its hits."""
        device, batch, view, rays = self._world.device, self._batch, self._view, len(self._view.aperture)
        seen = [self._world.params, view, steps]
        launch(world_rays.cast_centres, self._tiled, seen, [batch], device=device, smallest=SMALLEST_LAUNCH)
        if rays == 1:
            return
        n = self._tiled * batch.count
        marks = self._marks[:n]
        launch(world_rays.smooth_insides, n, [*seen, batch], [marks], device=device)
        wp.utils.array_scan(marks, marks, inclusive=True)
        launch(world_rays.list_marked, n, [marks], [self._listed], device=device)
        listed = int(marks[n - 1 :].numpy()[0])
        if len(self._cast) < listed * rays:
            self._cast = wp.empty(listed * rays * 5 // 4, dtype=float, device=device)
        launch(world_rays.cast_edges, listed * rays, [*seen, batch, self._listed], [self._cast], device=device,
               smallest=SMALLEST_LAUNCH)  # fmt: skip
        launch(world_rays.add_edges, listed, [view, batch, self._listed, self._cast], [], device=device)

    def look(self, view: Any, steps: Any, block: Any, n: int, faces: Any) -> Any:
        """Return the surfaces that ``n`` events saw, as a :class:`amiwarp.kernels.world_rays.SeenSurfaces`.

        With a plate, this also finds the events' pixels without the plate, so that it can be called only once.

        ``view``, ``steps``: camera and instants of the chunk; ``block``: events; ``faces``: face of each texel of the
        maps, or an empty array without maps.
        """
        out = world_rays.SeenSurfaces()
        device = self._world.device
        for name, dtype in (("instance", wp.uint16), ("depth", float), ("place", wp.vec3)):
            setattr(out, name, wp.empty(n, dtype=dtype, device=device))
        if self._view.plate.thickness:
            inputs = [self._world.params, self._view, steps, block.ticks]
            outputs = [block.points, out]
            launch(world_rays.find_surfaces_through_plate, n, inputs, outputs, device=device, smallest=SMALLEST_LAUNCH)
            return out
        inputs = [self._world.params, view, steps, self._view.poses, faces, block.points, block.ticks]
        launch(world_rays.find_seen_surfaces, n, inputs, [out], device=device, smallest=SMALLEST_LAUNCH)
        return out
