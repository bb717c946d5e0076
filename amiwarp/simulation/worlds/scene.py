"""What a world holds: bodies with meshes and materials, light and sky."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.validation import array, instance, real, vector

MOST_INSTANCES = 65535
"""Instances of a world: their numbers are stored as uint16, 0 is the sky."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles. Raises :class:`AmiwarpError` for a mesh without faces, or faces of vertices that do not exist."""

    vertices: ArrayLike
    """Corners in the body's frame [m], shape ``(n, 3)``."""
    faces: ArrayLike
    """Indices of each triangle's corners, shape ``(m, 3)``; the outside sees them counter-clockwise."""
    uv: ArrayLike | None = None
    """Place of each vertex on the texture, u to the right and v up, in widths and heights of it, shape ``(n, 2)``."""
    light: ArrayLike | None = None
    """Factor of the reflectance at each vertex, 0 to 1, shape ``(n,)``."""

    def __post_init__(self) -> None:
        vertices = array(self.vertices, "mesh's vertices").astype(np.float64)
        faces = np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise AmiwarpError(f"mesh's vertices have shape {vertices.shape}; give finite numbers, (n, 3)")
        if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise AmiwarpError(f"mesh's faces have shape {faces.shape}; give at least one triangle, (m, 3)")
        if faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= len(vertices):
            raise AmiwarpError(f"mesh's faces name vertices outside of 0 .. {len(vertices) - 1}; check the indices")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces.astype(np.int32))
        for name, shape in (("uv", (len(vertices), 2)), ("light", (len(vertices),))):
            if getattr(self, name) is not None:
                values = array(getattr(self, name), f"mesh's {name}").astype(np.float64)
                if values.shape != shape or not np.isfinite(values).all():
                    raise AmiwarpError(f"mesh's {name} has shape {values.shape}; give finite numbers, {shape}")
                object.__setattr__(self, name, values)

    @cached_property
    def bounding_sphere(self) -> tuple[NDArray[np.float64], float]:
        """Centre [m], shape ``(3,)``, and radius [m] of a sphere that contains all vertices."""
        vertices = np.asarray(self.vertices)
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        return centre, float(np.linalg.norm(vertices - centre, axis=1).max())


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface reflects: evenly in all directions (Lambert)."""

    reflectance: float = 0.5
    """Share of the light that is reflected, 0 to 1."""
    texture: NDArray[Any] | None = None
    """Factors of the reflectance, linear, shape (height, width), repeated over the plane of ``Mesh.uv``."""
    emission: float = 0.0
    """Luminance that the surface emits by itself; white in full light is 1."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "reflectance", real(self.reflectance, "material reflectance", 0.0, 1.0))
        object.__setattr__(self, "emission", real(self.emission, "material emission", 0.0, 1e6))
        if self.texture is not None:
            texture = array(self.texture, "material texture").astype(np.float32)
            if texture.ndim != 2 or min(texture.shape) < 2 or not (np.isfinite(texture).all() and texture.min() >= 0):
                raise AmiwarpError(f"material texture has shape {texture.shape}; give numbers from 0, (height, width)")
            object.__setattr__(self, "texture", texture)


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body."""

    name: str
    """Name, unique in the world."""
    mesh: Mesh
    """Its surface, in its own frame."""
    material: Material = field(default_factory=Material)
    """What the surface is made of."""
    trajectory: Trajectory | None = None
    """Its pose over time; None for a body that rests in the world's frame."""
    category: str = ""
    """Class label, as ``wall`` or ``person``."""
    instance: str | None = None
    """Instance label, shared by the parts of one thing; None for the name."""


@dataclass(frozen=True, slots=True)
class Sun:
    """Light from one direction."""

    direction: tuple[float, float, float]
    """Towards the sun, in the world's frame; of any length."""
    intensity: float = 0.6
    """Luminance of a white surface that faces it."""
    shadows: bool = True
    """Whether bodies cast shadows."""

    def __post_init__(self) -> None:
        direction = vector(self.direction, 3, "sun direction", real)
        length = float(np.linalg.norm(direction))
        if not length > 0.0:
            raise AmiwarpError("sun direction has length 0; give the direction towards the sun")
        object.__setattr__(self, "direction", tuple(float(x) / length for x in direction))
        object.__setattr__(self, "intensity", real(self.intensity, "sun intensity", 0.0, 1e6))


@dataclass(frozen=True, slots=True)
class Lamp:
    """Light from one point."""

    position: tuple[float, float, float]
    """In the world's frame [m]."""
    intensity: float = 1.0
    """Luminance of a white surface that faces it at a distance of 1 m."""
    flicker_hz: float = 0.0
    """Frequency of its flicker [1/s]; 0 for none. A lamp on alternating current flickers at twice its frequency."""
    flicker_depth: float = 1.0
    """Amplitude of the flicker, a share of the intensity, 0 to 1."""
    shadows: bool = False
    """Whether bodies cast shadows."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", tuple(float(x) for x in vector(self.position, 3, "lamp position", real)))
        for name, high in (("intensity", 1e6), ("flicker_hz", 1e4), ("flicker_depth", 1.0)):
            object.__setattr__(self, name, real(getattr(self, name), f"lamp {name}", 0.0, high))


@dataclass(frozen=True, eq=False)
class Sky:
    """What rays that meet no body see."""

    luminance: float = 0.6
    """Its luminance, or a factor of the panorama."""
    panorama: NDArray[Any] | None = None
    """Linear luminance in all directions, shape (height, 2 height): azimuth to the right, elevation up."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "luminance", real(self.luminance, "sky luminance", 0.0, 1e6))
        if self.panorama is not None:
            panorama = array(self.panorama, "sky panorama").astype(np.float32)
            if (
                panorama.ndim != 2
                or min(panorama.shape) < 2
                or not (np.isfinite(panorama).all() and panorama.min() >= 0)
            ):
                raise AmiwarpError(f"sky panorama has shape {panorama.shape}; give numbers from 0, (height, 2 height)")
            object.__setattr__(self, "panorama", panorama)


@dataclass(frozen=True, eq=False)
class World:
    """Bodies, light and sky. The world's frame is right-handed with z up, in metres."""

    name: str
    """Name for messages and files."""
    bodies: tuple[Body, ...]
    """Everything that can be seen but the sky."""
    ambient: float = 0.4
    """Luminance of a white surface in the shade."""
    sun: Sun | None = None
    """Light from one direction."""
    lamps: tuple[Lamp, ...] = ()
    """Lights at points."""
    sky: Sky = field(default_factory=Sky)
    """What lies behind everything."""
    joints: Mapping[str, Trajectory] = field(default_factory=dict)
    """Named points that move, as the joints of a figure: their trajectories."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "bodies", tuple(self.bodies))
        object.__setattr__(self, "lamps", tuple(self.lamps))
        object.__setattr__(self, "ambient", real(self.ambient, "world ambient", 0.0, 1e6))
        if not self.bodies:
            raise AmiwarpError(f"world {self.name!r} has no bodies; give at least one")
        for body in self.bodies:
            instance(body, Body, "world's body")
        names = [body.name for body in self.bodies]
        doubles = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
        if doubles:
            raise AmiwarpError(f"world {self.name!r} has several bodies named {doubles[0]!r}; give each its own name")
        if len(self.instances) > MOST_INSTANCES:
            raise AmiwarpError(f"world {self.name!r} has {len(self.instances)} instances; at most {MOST_INSTANCES}")

    @property
    def instances(self) -> tuple[str, ...]:
        """Instance labels in the order of their bodies; the label at index i has the number i + 1, the sky has 0."""
        return tuple(dict.fromkeys(body.instance or body.name for body in self.bodies))

    @property
    def categories(self) -> tuple[str, ...]:
        """Class label of each instance, in the order of :attr:`instances`."""
        labels: dict[str, str] = {}
        for body in self.bodies:
            labels.setdefault(body.instance or body.name, body.category)
        return tuple(labels[name] for name in self.instances)

    @property
    def moving(self) -> tuple[Body, ...]:
        """Bodies whose pose changes."""
        return tuple(body for body in self.bodies if body.trajectory is not None and body.trajectory.moves)

    @property
    def triangles(self) -> int:
        """Number of triangles of all bodies."""
        return sum(len(np.asarray(body.mesh.faces)) for body in self.bodies)
