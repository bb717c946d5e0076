"""A simulated world: bodies, lights, a sky, and named points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.schema.calls import guarded
from amiwarp.simulation.worlds.bodies import Body
from amiwarp.simulation.worlds.lights import Lamp, Sky, Sun
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.validation import instance, real

MOST_INSTANCES = 65535
"""Largest number of instances of a world. Instance numbers are stored as uint16, and number 0 is the sky."""


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
        instance(self.name, str, "world's name")
        object.__setattr__(self, "bodies", tuple(self.bodies))
        object.__setattr__(self, "lamps", tuple(self.lamps))
        object.__setattr__(self, "ambient", real(self.ambient, "world ambient", 0.0, 1e6))
        if not self.bodies:
            raise AmiwarpError(f"world {self.name!r} has no bodies; give at least one")
        for body in self.bodies:
            instance(body, Body, "world's body")
        self._check_names()
        if len(self.instances) > MOST_INSTANCES:
            raise AmiwarpError(
                f"world {self.name!r} has {len(self.instances)} instances; give up to {MOST_INSTANCES}"
            )

    def _check_names(self) -> None:
        """Raise :class:`AmiwarpError` if two bodies have the same name, the first such name in alphabetical order."""
        counts = Counter(body.name for body in self.bodies)
        duplicates = sorted(name for name, count in counts.items() if count > 1)
        if duplicates:
            raise AmiwarpError(
                f"world {self.name!r} has several bodies named {duplicates[0]!r}; give unique names"
            )

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
        return tuple(
            body for body in self.bodies if body.trajectory is not None and body.trajectory.moves
        )

    @property
    def triangles(self) -> int:
        """Number of triangles of all bodies."""
        return sum(len(np.asarray(body.mesh.faces)) for body in self.bodies)


def lit(world: World, light: float) -> World:
    """Return a world whose ambient light, sun, lamps and sky are ``light`` times as bright."""
    sun = world.sun
    if sun is not None:
        sun = replace(sun, intensity=light * sun.intensity)
    lamps = tuple(replace(lamp, intensity=light * lamp.intensity) for lamp in world.lamps)
    sky = replace(world.sky, luminance=light * world.sky.luminance)
    return replace(world, ambient=light * world.ambient, sun=sun, lamps=lamps, sky=sky)
