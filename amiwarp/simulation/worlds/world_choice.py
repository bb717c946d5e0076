"""Worlds and camera trajectories by name: built-in worlds, or files."""

from __future__ import annotations

from pathlib import Path

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.simulation.worlds.animated_trajectory import AnimatedTrajectory
from amiwarp.simulation.worlds.named.camera_paths import TRAJECTORIES
from amiwarp.simulation.worlds.named.catalogue import WORLDS, named_world
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World
from amiwarp.simulation.worlds.world_files import load_world

WORLD_FILES = (".toml", ".json")
"""File suffixes of world files."""
POSE_FILES = (".txt", ".csv", ".tum")
"""File suffixes of files with poses."""


def open_world(
    name: str, trajectory: str | None, *, seed: int, duration_s: float
) -> tuple[World, Trajectory]:
    """Return a world and the camera's trajectory through it.

    ``name`` is the name of a built-in world or of a world file. ``trajectory`` is a kind of motion of the built-in
    worlds, or a file of poses; None is handheld motion, or the trajectory of the world file. Raises
    :class:`AmiwarpError` if one of them does not exist or they do not belong together.
    """
    is_file = trajectory is not None and trajectory.lower().endswith(POSE_FILES)
    poses = Trajectory.from_file(str(trajectory)) if is_file else None
    if not name.lower().endswith(WORLD_FILES):
        _check_is_name("world", name, WORLDS, WORLD_FILES)
        if trajectory is not None and poses is None:
            _check_is_name("trajectory", trajectory, TRAJECTORIES, POSE_FILES)
        kind = "still" if poses is not None else trajectory or "handheld"
        world, named_trajectory = named_world(name, kind, seed=seed, duration_s=duration_s)
        return world, poses or named_trajectory
    world, stored = load_world(Path(name))
    if trajectory is not None and poses is None:
        raise AmiwarpError(
            f"trajectory {trajectory} applies only to named worlds; give a file of poses for {name}",
            ErrorCode.OPTIONS,
        )
    chosen = poses or stored
    if chosen is None:
        raise AmiwarpError(
            f"{name}: has no camera trajectory; give a file of poses ({', '.join(POSE_FILES)}) as trajectory",
            ErrorCode.CONTENT_MISSING,
        )
    return world, chosen


def animation_notes(world: World) -> list[str]:
    """Return which animation of a glTF file moves each object of a world, and the other animations of the file."""
    notes: list[str] = []
    for body in world.bodies:
        if isinstance(body.trajectory, AnimatedTrajectory):
            motion = body.trajectory.motion
            others = "".join(f", not {name!r}" for name in motion.others)
            notes.append(
                f"note: {body.instance or body.name} follows animation {motion.animation!r}{others}"
            )
    return list(dict.fromkeys(notes))


def _check_is_name(what: str, name: str, names: tuple[str, ...], suffixes: tuple[str, ...]) -> None:
    """Raise :class:`AmiwarpError` if a name means a file, of a kind that is not read."""
    if Path(name).suffix:
        raise AmiwarpError(
            f"{what} is '{name}'; give a file of the kind {' or '.join(suffixes)}, or one of {', '.join(names)}",
            ErrorCode.FORMAT_UNKNOWN,
        )
