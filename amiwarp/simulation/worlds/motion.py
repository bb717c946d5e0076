"""How fast the image of a world moves: the length of steps, and the times of maps."""

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
"""Columns of the grid of rays that finds how near the world is."""
NEAREST_M = 0.02
"""Bodies nearer than this count as this near [m]: nothing can follow what goes through the camera."""
MOMENT_S = 1e-3
"""Over which speeds are taken [s]."""
FLICKER_SAMPLES = 16
"""Steps, or maps, in a period of a flickering lamp."""
SAFETY = 1.2
"""Factor of a speed that a coarse grid finds."""


def body_speed(body: Body, trajectory: Trajectory, focal: float, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a bound of a moving body's speed in the image at times [s], shape ``(n,)`` [px/s]."""
    assert body.trajectory is not None
    vertices = np.asarray(body.mesh.vertices)
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    places, turns = [], []
    for at in (t, t + MOMENT_S):
        rotation, position = body.trajectory.poses(at)
        places.append(np.einsum("nij,j->ni", rotation, centre) + position - trajectory.poses(at)[1])
        turns.append(rotation)
    speed = np.linalg.norm(places[1] - places[0], axis=1) / MOMENT_S
    cosine = (np.einsum("nij,nij->n", turns[0], turns[1]) - 1.0) / 2.0
    rate = np.arccos(np.clip(cosine, -1.0, 1.0)) / MOMENT_S
    distance = np.maximum(np.linalg.norm(places[0], axis=1) - radius, NEAREST_M)
    return np.asarray(focal * (speed + rate * radius) / distance)


def parallax_speed(world: DeviceWorld, camera: Camera, trajectory: Trajectory, t: float, instant: int) -> float:
    """Return the largest speed in the image [px/s] that the camera's change of place gives the resting world."""
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


def turn_speed(camera: Camera, trajectory: Trajectory, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a bound of the speed in the image that the camera's rotation gives, at times [s], ``(n,)`` [px/s]."""
    first, second = (trajectory.poses(at)[0] for at in (t, t + MOMENT_S))
    cosine = (np.einsum("nij,nij->n", first, second) - 1.0) / 2.0
    rate = np.arccos(np.clip(cosine, -1.0, 1.0)) / MOMENT_S
    corner = math.hypot(max(camera.cx, camera.width - 1 - camera.cx), max(camera.cy, camera.height - 1 - camera.cy))
    focal = max(camera.fx, camera.fy)
    return np.asarray(rate * focal * (1.0 + (corner / focal) ** 2))


def flicker_interval_s(world: Any) -> float:
    """Return the longest time between two looks at flickering lamps [s]; infinite without any."""
    rates = [lamp.flicker_hz for lamp in world.lamps if lamp.flicker_hz and lamp.flicker_depth]
    return 1.0 / (FLICKER_SAMPLES * max(rates)) if rates else math.inf
