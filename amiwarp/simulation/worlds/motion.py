"""Speed at which the image of a simulated world moves.

The simulator derives the length of its time steps and the times of its maps from this speed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.camera import Camera
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.renderer import pixel_rays, surfaces_at
from amiwarp.simulation.worlds.scene import Body
from amiwarp.simulation.worlds.trajectory import Trajectory

PROBE = 48
"""Number of columns of the grid of rays that measures the distances of visible surfaces."""
NEAREST_M = 0.02
"""Smallest distance for which speeds in the image are computed [m]. Nearer surfaces are treated as this far away."""
MOMENT_S = 1e-3
"""Time over which speeds are computed as difference quotients [s]."""
FLICKER_SAMPLES = 16
"""Smallest number of time steps, and of maps, per period of a flickering lamp."""
SAFETY = 1.2
"""Factor by which a speed measured on a coarse grid is increased, because the grid can miss the fastest pixel."""


def body_speed(body: Body, trajectory: Trajectory, focal: float, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an upper bound of a moving body's speed in the image [px/s] at times [s], shape ``(n,)``."""
    assert body.trajectory is not None
    centre, radius = body.mesh.bounding_sphere
    rotation, position = body.trajectory.poses(t)
    rotation_after, position_after = body.trajectory.poses(t + MOMENT_S)
    place = rotation @ centre + position - trajectory.poses(t)[1]
    place_after = rotation_after @ centre + position_after - trajectory.poses(t + MOMENT_S)[1]
    speed = np.linalg.norm(place_after - place, axis=1) / MOMENT_S
    distance = np.maximum(np.linalg.norm(place, axis=1) - radius, NEAREST_M)
    return np.asarray(focal * (speed + turn_rate(rotation, rotation_after) * radius) / distance)


def turn_rate(rotation: NDArray[np.float64], rotation_after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angular speed [rad/s] between rotations (n, 3, 3) that are :data:`MOMENT_S` apart."""
    cosine = (np.einsum("nij,nij->n", rotation, rotation_after) - 1.0) / 2.0
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) / MOMENT_S)


def parallax_speed(world: DeviceWorld, camera: Camera, trajectory: Trajectory, t: float, instant: int) -> float:
    """Return the largest speed in the image [px/s] that the camera's translation causes.

    ``instant``: index of the time ``t`` [s] in the last call of :meth:`DeviceWorld.set_instants`.
    """
    before, after = (trajectory.poses([at]) for at in (t, t + MOMENT_S))
    velocity = (after[1][0] - before[1][0]) / MOMENT_S
    if not velocity.any():
        return 0.0
    scale = PROBE / camera.width
    small = Camera(
        PROBE, max(1, round(camera.height * scale)), camera.fx * scale, camera.fy * scale,
        (camera.cx + 0.5) * scale - 0.5, (camera.cy + 0.5) * scale - 0.5,
    )  # fmt: skip
    seen = surfaces_at(world, pixel_rays(small), before[0][0], before[1][0], instant)
    near = seen.place[np.isfinite(seen.depth)].astype(np.float64) - before[1][0]
    if not len(near):
        return 0.0
    distance = np.maximum(np.linalg.norm(near, axis=1), NEAREST_M)
    along = near / distance[:, None]
    across = np.linalg.norm(velocity - (along @ velocity)[:, None] * along, axis=1)
    return float(SAFETY * max(camera.fx, camera.fy) * (across / distance).max())


def movers_speed(world: DeviceWorld, camera: Camera, trajectory: Trajectory, t: NDArray[np.float64]) -> NDArray[Any]:
    """Return an upper bound of the speed of all moving bodies in the image [px/s] at times [s], shape ``(n,)``."""
    speeds = [body_speed(body, trajectory, max(camera.fx, camera.fy), t) for body in world.movers]
    return np.max([np.zeros(len(t)), *speeds], axis=0)


def rotation_speed(camera: Camera, trajectory: Trajectory, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an upper bound of the speed in the image [px/s] due to the camera's rotation at times [s], shape (n,)."""
    rate = turn_rate(*(trajectory.poses(at)[0] for at in (t, t + MOMENT_S)))
    corner = math.hypot(max(camera.cx, camera.width - 1 - camera.cx), max(camera.cy, camera.height - 1 - camera.cy))
    focal = max(camera.fx, camera.fy)
    return np.asarray(rate * focal * (1.0 + (corner / focal) ** 2))


def flicker_interval_s(world: Any) -> float:
    """Return the longest time between two renderings of a world with flickering lamps [s].

    The time is infinite if no lamp flickers.
    """
    rates = [lamp.flicker_hz for lamp in world.lamps if lamp.flicker_hz and lamp.flicker_depth]
    return 1.0 / (FLICKER_SAMPLES * max(rates)) if rates else math.inf
