"""Upload of a simulated world to a device: meshes, textures, lights, and poses of moving bodies at given instants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import Any, cast
from weakref import WeakValueDictionary

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.simulation.kernels import world as kernels
from amiwarp.simulation.worlds.bodies import Body
from amiwarp.simulation.worlds.colours import in_channel
from amiwarp.simulation.worlds.world import World

CUDA_TREE = "cubql"
"""Warp's constructor of the bounding volume hierarchy of a mesh on a GPU.

Compared with Warp's default constructor, rays take 0.5 to 0.65 of the time on a GPU, but longer on a CPU.
"""
LARGEST_PYRAMID = 14
"""Largest number of levels (the texture and its halved copies) of a texture pyramid."""


def device_world(world: World, device: Any) -> DeviceWorld:
    """Return a world on a device, with instants of its own.

    All that the device holds of a world is uploaded once, and shared as long as it is in use.
    """
    key = (id(world), str(wp.get_device(device)))
    uploaded = _uploaded.get(key)
    if uploaded is None:
        uploaded = DeviceWorld(world, device)
        _uploaded[key] = uploaded
    return uploaded.sharing()


class DeviceWorld:
    """Meshes, materials and light of a simulated world on a device.

    All bodies at rest form one mesh. Each moving body has its own mesh, and a pose at each instant.
    """

    def __init__(self, world: World, device: Any) -> None:
        self.world = world
        self.device = wp.get_device(device)
        self.movers = world.moving
        names = {body.name for body in self.movers}
        still = [body for body in world.bodies if body.name not in names]
        bodies = [*still, *self.movers]  # the kernels number the bodies in this order

        self._bodies = bodies
        self.params = kernels.World()
        self.params.first_mover = len(still)
        surfaces = self._upload_materials(None)
        self._upload_light()

        # Shapes. Bodies at rest are given in the world's frame, moving bodies in their own.
        resting = [_resting(body) for body in still]
        moving = [np.asarray(body.mesh.vertices) for body in self.movers]
        self._upload_faces(bodies, [*resting, *moving], surfaces)
        # Keeps the meshes alive, of which the kernels know only the id.
        self._meshes: list[Any] = []
        self.params.still = wp.uint64(0)
        if still:
            self.params.still = self._mesh(resting, still).id
        faces_at_rest = sum(len(np.asarray(body.mesh.faces)) for body in still)
        self._upload_movers(faces_at_rest)
        self._shared: DeviceWorld | None = None
        self.set_instants(np.zeros(1))

    def sharing(self) -> DeviceWorld:
        """Return the same world with instants of its own, which shares everything else."""
        other = copy(self)
        params: Any = kernels.World()
        params.assign(self.params)
        other.params = params
        other._shared = self  # keeps it in use
        return other

    def in_colour(self, channel: int) -> DeviceWorld:
        """Return the same world as its red, green or blue light (0, 1, 2), with instants of its own."""
        other = self.sharing()
        other._upload_materials(channel)
        return other

    def _upload_materials(self, channel: int | None) -> list[Any]:
        """Upload the materials of all bodies and the sky, and return the materials.

        ``channel``: colour channel (0, 1, 2: red, green, blue), or None for the luminance.
        """
        # The textures, and then the sky's panorama, lie in one array.
        texels = _Texels(channel)
        numbers = {label: k + 1 for k, label in enumerate(self.world.instances)}
        surfaces = []
        shade = []
        for body in self._bodies:
            surfaces.append(_surface(body, numbers[body.instance or body.name], texels))
            shade.append(_shade(body, channel))
        self._set_sky(texels)
        self.params.surfaces = wp.array(surfaces, dtype=kernels.Surface, device=self.device)
        self.params.texels = wp.array(texels.joined(), dtype=float, device=self.device)
        self.params.shade = self._floats(np.concatenate(shade))
        return surfaces

    def _set_sky(self, texels: _Texels) -> None:
        """Describe the sky, and add its panorama to ``texels``."""
        sky = self.world.sky
        self.params.sky = sky.luminance * texels.factor(sky.colour)
        self.params.panorama = -1
        if sky.panorama is not None:
            self.params.panorama = texels.add(sky.panorama, sky.colour, 1)
            self.params.panorama_height, self.params.panorama_width = sky.panorama.shape

    def _mesh(self, vertices: Sequence[NDArray[np.float64]], bodies: Sequence[Body]) -> Any:
        """Return one Warp mesh of several bodies, whose vertices are given [m]."""
        faces = []
        count = 0
        for body, of_body in zip(bodies, vertices, strict=True):
            faces.append(np.asarray(body.mesh.faces) + count)
            count += len(of_body)
        points = self._vectors(np.concatenate(vertices))
        corners = np.concatenate(faces).ravel().astype(np.int32)
        indices = wp.array(corners, dtype=int, device=self.device)
        tree = None if self.device.is_cpu else CUDA_TREE
        mesh = wp.Mesh(points, indices, bvh_constructor=tree)
        self._meshes.append(mesh)
        return mesh

    def _upload_faces(
        self,
        bodies: Sequence[Body],
        vertices: Sequence[NDArray[np.float64]],
        surfaces: Sequence[Any],
    ) -> None:
        """Upload the body number, corners and texture coordinates of each face.

        ``vertices``: vertices of each body in the frame of its mesh on the device [m].
        """
        number = []
        corners = []
        uv = []
        density = []
        for k, body in enumerate(bodies):
            mesh = body.mesh
            faces = np.asarray(mesh.faces)
            corner = faces.ravel()  # index of each corner's vertex
            count = len(np.asarray(mesh.vertices))
            place = np.zeros((count, 2)) if mesh.uv is None else np.asarray(mesh.uv)
            number.append(np.full(len(faces), k, np.int32))
            corners.append(vertices[k][corner])
            uv.append(place[corner])
            density.append(_density(mesh, place, surfaces[k]))
        places = np.concatenate(uv).astype(np.float32)
        self.params.body = wp.array(np.concatenate(number), dtype=int, device=self.device)
        self.params.corners = self._vectors(np.concatenate(corners))
        self.params.uv = wp.array(places, dtype=wp.vec2, device=self.device)
        self.params.density = self._floats(np.concatenate(density))

    def _floats(self, values: NDArray[Any]) -> wp.array:
        """Upload numbers as float32."""
        return wp.array(values.astype(np.float32), dtype=float, device=self.device)

    def _vectors(self, values: NDArray[Any]) -> wp.array:
        """Upload vectors, shape (n, 3), as float32."""
        return wp.array(values.astype(np.float32), dtype=wp.vec3, device=self.device)

    def _upload_light(self) -> None:
        """Upload ambient light, sun and the positions of lamps."""
        world = self.world
        self.params.ambient = world.ambient
        self.params.sun = wp.vec3(0.0, 0.0, 1.0)
        if world.sun is not None:
            self.params.sun = wp.vec3(*world.sun.direction)
            self.params.sun_light = world.sun.intensity
            self.params.sun_shadows = int(world.sun.shadows)
        lamps = []
        for given in world.lamps:
            lamp = kernels.Lamp()
            lamp.position = wp.vec3(*given.position)
            lamp.shadows = int(given.shadows)
            lamps.append(lamp)
        self.params.lamps = wp.array(lamps, dtype=kernels.Lamp, device=self.device)

    def _upload_movers(self, first: int) -> None:
        """Upload the meshes of the moving bodies. ``first``: number of the first face of the first moving body."""
        movers = []
        for body in self.movers:
            mover = kernels.Mover()
            vertices = np.asarray(body.mesh.vertices)
            mover.mesh = self._mesh([vertices], [body]).id
            mover.first_face = first
            mover.lower = wp.vec3(*vertices.min(axis=0).tolist())
            mover.upper = wp.vec3(*vertices.max(axis=0).tolist())
            mover.radius = body.mesh.bounding_sphere[1] * 1.001
            first += len(np.asarray(body.mesh.faces))
            movers.append(mover)
        self.params.movers = wp.array(movers, dtype=kernels.Mover, device=self.device)

    def set_instants(self, t: NDArray[np.float64]) -> None:
        """Set the instants at which kernels can see the world: ``t`` [s], shape (n,).

        Uploads the poses of moving bodies and the light of the lamps at these times.
        """
        pose_type = cast("Any", kernels.Pose).numpy_dtype()
        poses: NDArray[Any] = np.zeros((len(t), len(self.movers)), pose_type)
        centres = np.zeros((len(t), len(self.movers), 3), np.float32)
        for k, body in enumerate(self.movers):
            assert body.trajectory is not None
            rotation, position = body.trajectory.poses(t)
            centre, _ = body.mesh.bounding_sphere
            poses["rotation"][:, k] = rotation
            poses["position"][:, k] = position
            centres[:, k] = rotation @ centre + position
        self.params.poses = wp.array(poses, dtype=kernels.Pose, device=self.device)
        self.params.centres = wp.array(centres, dtype=wp.vec3, device=self.device)

        lights = np.zeros((len(t), len(self.world.lamps)))
        for k, lamp in enumerate(self.world.lamps):
            flicker = np.sin(2.0 * math.pi * lamp.flicker_hz * t)
            lights[:, k] = lamp.intensity * (1.0 + lamp.flicker_depth * flicker)
        self.params.lamp_light = self._floats(lights)


_uploaded: WeakValueDictionary[tuple[int, str], DeviceWorld] = WeakValueDictionary()
"""Worlds on devices that are in use, by the number of the world and the name of the device."""


class _Texels:
    """Texels of all texture pyramids in one array, as luminance or in one colour channel."""

    def __init__(self, channel: int | None) -> None:
        """Begin without textures. ``channel``: 0, 1, 2 for red, green, blue; None for the luminance."""
        self._channel = channel
        self._parts: list[NDArray[np.float32]] = [np.zeros(1, np.float32)]
        self._count = 1
        self._known: dict[tuple[int, int], int] = {}

    def factor(self, colour: Any) -> float:
        """Return the factor of the luminance of what has one colour; 1 for colours of texels."""
        if colour is None or colour.ndim > 1:
            return 1.0
        return float(in_channel(np.ones(()), colour, self._channel))

    def add(self, texture: NDArray[np.float32], colour: Any, levels: int) -> int:
        """Append a texture and its halved copies, ``levels`` in total; return the index of the first texel.

        ``colour``: relative colours of the texels, or one colour, which does not count here.
        """
        key = (id(texture), id(colour))
        if key in self._known:
            return self._known[key]
        first = self._count
        self._known[key] = first
        if colour is not None and colour.ndim > 1:
            texture = in_channel(texture, colour, self._channel)
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
    two = np.float32(2.0)
    height, width = texture.shape
    even_rows = height // 2 * 2
    even_columns = width // 2 * 2
    if even_rows:
        texture = (texture[0:even_rows:2] + texture[1:even_rows:2]) / two
    if even_columns:
        texture = (texture[:, 0:even_columns:2] + texture[:, 1:even_columns:2]) / two
    return texture


def _surface(body: Body, number: int, texels: _Texels) -> Any:
    """Return the kernels' description of a body's material, and add its texture to ``texels``.

    ``number``: instance number of the body.
    """
    material = body.material
    surface = kernels.Surface()
    surface.reflectance = material.reflectance * texels.factor(material.colour)
    surface.emission = material.emission
    surface.instance = number
    surface.texel = -1
    if material.texture is not None:
        surface.levels = min(LARGEST_PYRAMID, max(material.texture.shape).bit_length())
        surface.texel = texels.add(material.texture, material.colour, surface.levels)
        surface.height, surface.width = material.texture.shape
    return surface


def _shade(body: Body, channel: int | None) -> NDArray[np.float64]:
    """Return the factors of the reflectance at the corners of a body's faces, shape (3 * faces,)."""
    mesh = body.mesh
    light = np.ones(len(np.asarray(mesh.vertices)))
    if mesh.light is not None:
        light = np.asarray(mesh.light)
    return in_channel(light, mesh.colour, channel)[np.asarray(mesh.faces).ravel()]


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
    # Twice the area of each face, in the world and in its texture
    a, b, c = np.moveaxis(np.asarray(mesh.vertices)[faces], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)

    in_texels = place * (surface.width, surface.height)
    a, b, c = np.moveaxis(in_texels[faces], 1, 0)
    ux, uy = (b - a).T
    vx, vy = (c - a).T
    texels = np.abs(ux * vy - uy * vx)
    return np.asarray(np.sqrt(texels / np.maximum(area, 1e-12)))
