"""Bodies of a simulated world: meshes, materials and where they are."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.schema.calls import guarded
from amiwarp.simulation.worlds.colours import checked_colour
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.validation import array, real


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
    colour: ArrayLike | None = None
    """Linear red, green and blue of ``light`` at each vertex, relative to it, shape ``(n, 3)``, as
    :attr:`Material.colour`."""

    def __post_init__(self) -> None:
        vertices = array(self.vertices, "mesh's vertices").astype(np.float64)
        faces = array(self.faces, "mesh's faces")
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise AmiwarpError(
                f"mesh's vertices have shape {vertices.shape}; give finite numbers of shape (n, 3)"
            )
        if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise AmiwarpError(
                f"mesh's faces have shape {faces.shape}; give at least one triangle, shape (m, 3)"
            )
        if faces.dtype.kind not in "iu":
            raise AmiwarpError(
                f"mesh's faces are {faces.dtype}; give whole numbers, the indices of vertices"
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise AmiwarpError(
                f"mesh's faces refer to vertices outside of 0 .. {len(vertices) - 1}; check the indices"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces.astype(np.int32))
        for name, shape in (("uv", (len(vertices), 2)), ("light", (len(vertices),))):
            if getattr(self, name) is not None:
                values = array(getattr(self, name), f"mesh's {name}").astype(np.float64)
                if values.shape != shape or not np.isfinite(values).all():
                    raise AmiwarpError(
                        f"mesh's {name} has shape {values.shape}; give finite numbers of shape {shape}"
                    )
                if name == "light" and not 0.0 <= values.min() <= values.max() <= 1.0:
                    raise AmiwarpError(
                        f"mesh's light is {values.min():g} .. {values.max():g}; give factors in 0 .. 1"
                    )
                object.__setattr__(self, name, values)
        if self.colour is not None:
            colour = checked_colour(self.colour, ((len(vertices), 3),), "mesh's colour")
            object.__setattr__(self, "colour", colour)

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
    """Luminance that the surface emits, relative to a white surface in full light. It is white."""
    colour: ArrayLike | None = None
    """Linear red, green and blue that the surface reflects, relative to its luminance, shape ``(3,)``, or ``(height,
    width, 3)`` for each texel of the texture. None stands for grey.

    Their luminance, ``0.2126 R + 0.7152 G + 0.0722 B``, is 1, so that event cameras see no colours.
    """

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "reflectance", real(self.reflectance, "material reflectance", 0.0, 1.0)
        )
        object.__setattr__(self, "emission", real(self.emission, "material emission", 0.0, 1e6))
        if self.texture is not None:
            with np.errstate(over="ignore"):  # infinity is refused
                texture = array(self.texture, "material texture").astype(np.float32)
            if (
                texture.ndim != 2
                or min(texture.shape) < 2
                or not (np.isfinite(texture).all() and texture.min() >= 0)
            ):
                raise AmiwarpError(
                    f"material texture has shape {texture.shape}; give values >= 0, (height, width)"
                )
            object.__setattr__(self, "texture", texture)
        if self.colour is not None:
            shapes: tuple[tuple[int, ...], ...] = ((3,),)
            if self.texture is not None:
                shapes = (*shapes, (*self.texture.shape, 3))
            colour = checked_colour(self.colour, shapes, "material colour")
            object.__setattr__(self, "colour", colour)


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
