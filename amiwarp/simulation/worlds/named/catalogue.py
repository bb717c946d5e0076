"""The named worlds: scenes that are made by a program and need no files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from amiwarp.simulation.worlds.named import ball, corridor, desk, person, room, street
from amiwarp.simulation.worlds.named.motion import TRAJECTORIES, Viewpoint, camera_trajectory
from amiwarp.simulation.worlds.scene import World
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.validation import one_of, real, whole


MODULES = {"room": room, "desk": desk, "corridor": corridor, "street": street, "ball": ball, "person": person}
WORLDS = tuple(MODULES)
"""Names of the worlds."""


def named_world(
    name: str, trajectory: str = "handheld", *, seed: int = 0, duration_s: float = 1.0
) -> tuple[World, Trajectory]:
    one_of(name, WORLDS, "world")
    one_of(trajectory, TRAJECTORIES, "trajectory")
    seed = whole(seed, "seed", 0, 2**63 - 1)
    duration_s = real(duration_s, "duration_s", 1e-3, 3600.0, " s")
    module = MODULES[name]
    world = module.build(np.random.default_rng([seed, WORLDS.index(name)]), duration_s)
    way = camera_trajectory(module.VIEW, trajectory, duration_s, np.random.default_rng([seed, 100]))
    return world, way
