"""Upload of a simulated world to a device: meshes, textures, lights, and poses of moving bodies at given instants."""

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels import world as kernels
from amiwarp.simulation.worlds.world import Body, Material, World

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
