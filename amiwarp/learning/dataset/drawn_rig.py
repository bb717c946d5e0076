"""Simulation of one recorded rig of a data set."""

from __future__ import annotations

from amiwarp.learning.dataset.drawn_scene import drawn_world
from amiwarp.learning.dataset.items import Item
from amiwarp.learning.dataset.rig_cameras import cameras_of, drawn_cameras, shortest_s
from amiwarp.simulation.rigs.rig import Rig


def rig_of(item: Item, device: str, duration_s: float | None = None) -> Rig:
    """Return the rig of a recording, which stores the values that it drew. ``duration_s`` shortens it."""
    world, trajectory = drawn_world(item)
    cameras = cameras_of(item.recipe["rig"], item.folder)
    stored = {f"drawn_{name}": value for name, value in item.drawn.items()}
    return Rig(
        world,
        trajectory,
        drawn_cameras(cameras, item.drawn),
        item.recipe["duration_s"] if duration_s is None else duration_s,
        item.seed,
        device,
        stored,
    )


def shortest_sample_s(item: Item) -> float:
    """Return the shortest duration of a recording [s]: 0 without a rig, whose cameras take one frame each."""
    if not item.cameras:
        return 0.0
    return shortest_s(cameras_of(item.recipe["rig"], item.folder))
