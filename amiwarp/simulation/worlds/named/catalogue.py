"""The built-in worlds by name, and the function that builds one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from amiwarp.schema.calls import guarded
from amiwarp.simulation.worlds.named import ball, corridor, desk, person, room, street
from amiwarp.simulation.worlds.named.camera_paths import (
    TRAJECTORIES,
    Viewpoint,
    camera_trajectory,
)
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World
from amiwarp.validation import one_of, real, whole

LONGEST_S = 3600.0
"""Longest duration of a built-in world [s]."""


@dataclass(frozen=True)
class NamedWorld:
    """Builder and mean camera pose of a built-in world."""

    build: Callable[[np.random.Generator, float], World]
    """Function that returns the world for a random generator and a duration [s]."""
    view: Viewpoint
    """Mean position and viewing direction of the camera."""


NAMED = {
    "room": NamedWorld(room.build, room.VIEW),
    "desk": NamedWorld(desk.build, desk.VIEW),
    "corridor": NamedWorld(corridor.build, corridor.VIEW),
    "street": NamedWorld(street.build, street.VIEW),
    "ball": NamedWorld(ball.build, ball.VIEW),
    "person": NamedWorld(person.build, person.VIEW),
}
"""Built-in worlds by name."""
WORLDS = tuple(NAMED)
"""Names of the built-in worlds."""
CAMERA_NUMBER = 6
"""Number of the generator that draws camera paths. It stays when worlds are added, or all paths would change."""


@guarded
def named_world(
    name: str, trajectory: str = "handheld", *, seed: int = 0, duration_s: float = 1.0
) -> tuple[World, Trajectory]:
    """Return a built-in world and a camera trajectory through it.

    The worlds are generated from a seed and need no files.

    Parameters
    ----------
    name : str
        ``room`` (furniture, pictures, gratings in all directions), ``desk``, ``corridor``, ``street`` (a small town),
        ``ball`` (a ball thrown across the room) or ``person`` (a walking figure, whose joints are ``World.joints``).
    trajectory : str
        Camera motion: ``still``, ``handheld`` (smooth random motion below 3 Hz, about 1.5 cm and 1.5 deg in amplitude;
        in the corridor and the street the camera also walks forward) or ``fast`` (about ten times the speed).
    seed : int
        Seed of textures, shapes and camera motion. The same seed gives the same world with every trajectory.
    duration_s : float
        Length of the trajectories [s]. Nothing moves after this time.

    Returns
    -------
    world : World
        The world: bodies, lights and sky, with 2,000 to 100,000 triangles.
    trajectory : Trajectory
        Camera poses. The camera never passes through a body.

    Raises
    ------
    AmiwarpError
        If the name of the world or of the trajectory is unknown, or the seed or the duration is out of range.

    Examples
    --------
    >>> world, trajectory = amiwarp.named_world("person", "still", seed=1, duration_s=0.1)
    >>> [body.name for body in world.moving][:3]
    ['pelvis', 'torso', 'neck']
    >>> rotation, position = trajectory.poses([0.0])
    >>> position.tolist()
    [[0.3, -3.4, 1.35]]
    """
    one_of(name, WORLDS, "world")
    one_of(trajectory, TRAJECTORIES, "trajectory")
    seed = whole(seed, "seed", 0, 2**63 - 1)
    duration_s = real(duration_s, "duration_s", 1e-3, LONGEST_S, " s")
    entry = NAMED[name]
    # The camera has a generator of its own, so that the world is the same with every trajectory. Worlds that are added
    # come last, and change no other one.
    place = WORLDS.index(name)
    of_world = np.random.default_rng([seed, place + (place >= CAMERA_NUMBER)])
    of_camera = np.random.default_rng([seed, CAMERA_NUMBER])
    world = entry.build(of_world, duration_s)
    camera = camera_trajectory(entry.view, trajectory, duration_s, of_camera)
    return world, camera
