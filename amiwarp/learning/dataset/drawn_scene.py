"""Scenes and cameras with the randomised values of a recording: light, contrast of pictures, and shake."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from amiwarp.learning.dataset.items import Item
from amiwarp.simulation.description import Scene, Still
from amiwarp.simulation.motion import CameraMotion
from amiwarp.simulation.picture_light import read_picture
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World, lit
from amiwarp.simulation.worlds.world_choice import POSE_FILES, open_world
from amiwarp.simulation.worlds.world_scene import BLUR_PX

SAMPLES_PER_PERIOD = 32
"""Number of samples of a shake per period. Between them its angle deviates by 0.5 % of the amplitude at most."""
LEAST_SAMPLES_HZ = 200.0
"""Smallest rate at which the trajectory of a shaken camera is sampled [1/s]."""


def picture_scene(path: str, drawn: Mapping[str, float]) -> Scene:
    """Return the scene of a picture whose luminance L is ``light`` times L to the power of ``gamma``."""
    luminance = read_picture(path) ** np.float32(drawn.get("gamma", 1.0))
    light = np.float32(drawn.get("light", 1.0))
    return Scene(Still(light * luminance), blur=drawn.get("blur_px", BLUR_PX))


def shake_axis(drawn: Mapping[str, float]) -> NDArray[np.float64]:
    """Return the axis about which the camera shakes, in its own frame: the image moves along the drawn direction."""
    direction = math.radians(drawn.get("shake_direction_deg", 0.0))
    return np.array([-math.sin(direction), math.cos(direction), 0.0])


def shaken_motion(
    rates: Sequence[float], drawn: Mapping[str, float], duration_s: float
) -> CameraMotion:
    """Return the rotation of a camera with constant rates [rad/s] that also shakes: amplitude · sin(2π f t)."""
    if "shake_deg" not in drawn:
        return CameraMotion(rates)
    angular = 2.0 * math.pi * drawn["shake_hz"]
    count = math.ceil(duration_s * drawn["shake_hz"] * SAMPLES_PER_PERIOD) + 2
    t = np.linspace(0.0, duration_s, count)
    speed = math.radians(drawn["shake_deg"]) * angular * np.cos(angular * t)
    table = np.column_stack([t, np.asarray(rates) + np.outer(speed, shake_axis(drawn))])
    return CameraMotion(table)


def shaken(trajectory: Trajectory, drawn: Mapping[str, float], duration_s: float) -> Trajectory:
    """Return a trajectory with the same rotation of the camera about its own axes as :func:`shaken_motion`."""
    from scipy.spatial.transform import Rotation

    if "shake_deg" not in drawn:
        return trajectory
    rate_hz = max(drawn["shake_hz"] * SAMPLES_PER_PERIOD, LEAST_SAMPLES_HZ)
    t = np.linspace(0.0, duration_s, math.ceil(duration_s * rate_hz) + 2)
    matrices, positions = trajectory.poses(t)
    angle = math.radians(drawn["shake_deg"]) * np.sin(2.0 * math.pi * drawn["shake_hz"] * t)
    shakes = Rotation.from_rotvec(np.outer(angle, shake_axis(drawn)))
    return Trajectory(t, positions, (Rotation.from_matrix(matrices) * shakes).as_quat())


def drawn_world(item: Item) -> tuple[World, Trajectory]:
    """Return the world of a recording in its light, and the trajectory through it with its shake.

    The seed of a named world is the specification's.
    """
    recipe = item.recipe
    trajectory = recipe["trajectory"]
    if trajectory is not None and trajectory.lower().endswith(POSE_FILES):
        trajectory = os.fspath(item.folder / trajectory)
    name = item.source if item.kind == "worlds" else os.fspath(item.folder / item.source)
    duration_s = recipe["duration_s"]
    world, path = open_world(name, trajectory, seed=recipe["seed"], duration_s=duration_s)
    if "light" in item.drawn:
        world = lit(world, item.drawn["light"])
    return world, shaken(path, item.drawn, duration_s)
