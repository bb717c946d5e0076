"""Content of a simulated world: bodies with meshes and materials, lights and a sky."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.choices import Seeing
from amiwarp.errors import AmiwarpError
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.validation import array, choice, guarded, instance, one_of, real, shown, vector

MOST_INSTANCES = 65535
"""Largest number of instances of a world. Instance numbers are stored as uint16, and number 0 is the sky."""


@guarded
@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh.

    Raises :class:`AmiwarpError` if the mesh has no faces, or if a face refers to a vertex that does not exist.
    """

    vertices: ArrayLike
    """Vertices in the body's frame [m], shape ``(n, 3)``."""
    faces: ArrayLike
    """Indices of the vertices of each triangle, shape ``(m, 3)``, counter-clockwise as seen from outside."""
    uv: ArrayLike | None = None
    """Texture coordinates of each vertex, shape ``(n, 2)``.

    u points to the right in units of the texture's width, v points up in units of its height.
    """
    light: ArrayLike | None = None
    """Factor by which the reflectance is multiplied at each vertex, 0 to 1, shape ``(n,)``. None stands for 1."""

    def __post_init__(self) -> None:
        vertices = array(self.vertices, "mesh's vertices").astype(np.float64)
        faces = array(self.faces, "mesh's faces")
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise AmiwarpError(f"mesh's vertices have shape {vertices.shape}; give finite numbers of shape (n, 3)")
        if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise AmiwarpError(f"mesh's faces have shape {faces.shape}; give at least one triangle, shape (m, 3)")
        if faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= len(vertices):
            raise AmiwarpError(f"mesh's faces refer to vertices outside of 0 .. {len(vertices) - 1}; check the indices")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces.astype(np.int32))
        for name, shape in (("uv", (len(vertices), 2)), ("light", (len(vertices),))):
            if getattr(self, name) is not None:
                values = array(getattr(self, name), f"mesh's {name}").astype(np.float64)
                if values.shape != shape or not np.isfinite(values).all():
                    raise AmiwarpError(f"mesh's {name} has shape {values.shape}; give finite numbers of shape {shape}")
                object.__setattr__(self, name, values)

    @cached_property
    def bounding_sphere(self) -> tuple[NDArray[np.float64], float]:
        """Centre [m], shape ``(3,)``, and radius [m] of a sphere that contains all vertices."""
        vertices = np.asarray(self.vertices)
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        return centre, float(np.linalg.norm(vertices - centre, axis=1).max())


@guarded
@dataclass(frozen=True, eq=False)
class Material:
    """Material of a surface that reflects light evenly in all directions (Lambert)."""

    reflectance: float = 0.5
    """Fraction of the incident light that the surface reflects, 0 to 1."""
    texture: NDArray[Any] | None = None
    """Factors by which the reflectance is multiplied, linear, shape (height, width).

    The texture repeats beyond the range 0 to 1 of ``Mesh.uv``. None stands for the factor 1.
    """
    emission: float = 0.0
    """Luminance that the surface emits, relative to a white surface in full light."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "reflectance", real(self.reflectance, "material reflectance", 0.0, 1.0))
        object.__setattr__(self, "emission", real(self.emission, "material emission", 0.0, 1e6))
        if self.texture is not None:
            with np.errstate(over="ignore"):  # infinity is refused
                texture = array(self.texture, "material texture").astype(np.float32)
            if texture.ndim != 2 or min(texture.shape) < 2 or not (np.isfinite(texture).all() and texture.min() >= 0):
                raise AmiwarpError(f"material texture has shape {texture.shape}; give values >= 0, (height, width)")
            object.__setattr__(self, "texture", texture)


@guarded
@dataclass(frozen=True, eq=False)
class Body:
    """Rigid body of a world."""

    name: str
    """Name of the body, unique in the world."""
    mesh: Mesh
    """Surface of the body, in the body's frame."""
    material: Material = field(default_factory=Material)
    """Material of the whole surface."""
    trajectory: Trajectory | None = None
    """Pose of the body's frame in the world over time. None for a body at rest whose frame is the world's."""
    category: str = ""
    """Class label, for example ``wall`` or ``person``."""
    instance: str | None = None
    """Instance label. Bodies with the same label count as one object. None stands for the body's name."""


@guarded
@dataclass(frozen=True, slots=True)
class Sun:
    """Distant light source, whose light comes from one direction everywhere."""

    direction: tuple[float, float, float]
    """Vector towards the sun in the world's frame. The length has no effect."""
    intensity: float = 0.6
    """Luminance that the sun gives to a white surface that faces the sun."""
    shadows: bool = True
    """Whether bodies cast shadows in this light."""

    def __post_init__(self) -> None:
        direction = vector(self.direction, 3, "sun direction", real)
        length = math.hypot(*direction)
        if not 0.0 < length < math.inf:
            raise AmiwarpError(f"sun direction has length {length:.3g}; give the direction towards the sun")
        object.__setattr__(self, "direction", tuple(float(x) / length for x in direction))
        object.__setattr__(self, "intensity", real(self.intensity, "sun intensity", 0.0, 1e6))


@guarded
@dataclass(frozen=True, slots=True)
class Lamp:
    """Point light source."""

    position: tuple[float, float, float]
    """Position in the world's frame [m]."""
    intensity: float = 1.0
    """Luminance that the lamp gives to a white surface that faces the lamp at a distance of 1 m."""
    flicker_hz: float = 0.0
    """Frequency of the flicker [1/s]; 0 for steady light.

    A lamp on alternating current flickers at twice the frequency of the current.
    """
    flicker_depth: float = 1.0
    """Amplitude of the flicker as a fraction of the intensity, 0 to 1."""
    shadows: bool = False
    """Whether bodies cast shadows in this light."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", tuple(float(x) for x in vector(self.position, 3, "lamp position", real)))
        for name, high in (("intensity", 1e6), ("flicker_hz", 1e4), ("flicker_depth", 1.0)):
            object.__setattr__(self, name, real(getattr(self, name), f"lamp {name}", 0.0, high))


@guarded
@dataclass(frozen=True, eq=False)
class Sky:
    """Background at infinity, which is seen where no body is."""

    luminance: float = 0.6
    """Luminance of an even sky, or factor by which the panorama is multiplied."""
    panorama: NDArray[Any] | None = None
    """Linear luminance in all directions, shape (height, 2 height); None for an even sky.

    The picture is equirectangular with the elevation up. Its middle column shows the direction +x, its right half -y.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "luminance", real(self.luminance, "sky luminance", 0.0, 1e6))
        if self.panorama is not None:
            with np.errstate(over="ignore"):  # infinity is refused
                panorama = array(self.panorama, "sky panorama").astype(np.float32)
            if (
                panorama.ndim != 2
                or min(panorama.shape) < 2
                or not (np.isfinite(panorama).all() and panorama.min() >= 0)
            ):
                raise AmiwarpError(f"sky panorama has shape {panorama.shape}; give values >= 0, (height, 2 height)")
            object.__setattr__(self, "panorama", panorama)


@guarded
@dataclass(frozen=True, eq=False)
class World:
    """Three-dimensional scene: bodies, lights and a sky.

    The world's frame is right-handed, with z up and metres as unit.
    """

    name: str
    """Name of the world, used in messages and stored in recordings."""
    bodies: tuple[Body, ...]
    """All bodies of the world, at least one."""
    ambient: float = 0.4
    """Luminance of a white surface in the shade, where only ambient light falls."""
    sun: Sun | None = None
    """Distant light source; None for none."""
    lamps: tuple[Lamp, ...] = ()
    """Point light sources."""
    sky: Sky = field(default_factory=Sky)
    """Background at infinity."""
    joints: Mapping[str, Trajectory] = field(default_factory=dict)
    """Trajectories of named points, such as the joints of a figure."""

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
            raise AmiwarpError(f"world {self.name!r} has several bodies named {doubles[0]!r}; give unique names")
        if len(self.instances) > MOST_INSTANCES:
            raise AmiwarpError(f"world {self.name!r} has {len(self.instances)} instances; give up to {MOST_INSTANCES}")

    @property
    def instances(self) -> tuple[str, ...]:
        """Instance labels in the order of the bodies.

        The label at index i has the instance number i + 1; number 0 is the sky.
        """
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
        """Bodies whose pose changes over time."""
        return tuple(body for body in self.bodies if body.trajectory is not None and body.trajectory.moves)

    @property
    def triangles(self) -> int:
        """Number of triangles of all bodies."""
        return sum(len(np.asarray(body.mesh.faces)) for body in self.bodies)


# World and camera trajectory, as the scene of a simulation.

SAMPLES = (1, 4, 9, 16)
"""Allowed numbers of rays per pixel or per texel."""


@guarded
@dataclass(frozen=True, eq=False)
class WorldScene:
    """Scene of a simulation in which a camera moves through a world, as an alternative to :class:`amiwarp.Scene`."""

    world: World
    """World that the camera sees."""
    trajectory: Trajectory
    """Pose of the camera over time."""
    blur: float = 0.5
    """Standard deviation of the optical blur, including the area of the pixel [px].

    The blur has no effect with ``seeing="rays"`` and ``samples=1``.
    """
    seeing: Seeing = Seeing.MAPS
    """Method by which the light that each pixel receives is computed."""
    samples: int | None = None
    """Number of rays: 1, 4, 9 or 16; None stands for 4.

    With maps, the rays of each texel at an edge; with rays, the rays of each pixel, which search the whole world only
    at edges.
    """
    motion_px: float = 0.5
    """Largest motion of the image between two successive maps [px], 0.01 to 2. Has no effect with rays."""

    def __post_init__(self) -> None:
        instance(self.world, World, "world scene's world")
        instance(self.trajectory, Trajectory, "world scene's trajectory")
        object.__setattr__(self, "blur", real(self.blur, "scene blur", 0.0, 20.0, " px"))
        object.__setattr__(self, "seeing", choice(Seeing, self.seeing, "seeing"))
        object.__setattr__(self, "motion_px", real(self.motion_px, "motion_px", 0.01, 2.0, " px"))
        if self.samples is not None:
            one_of(shown(self.samples), [str(n) for n in SAMPLES], "samples")
