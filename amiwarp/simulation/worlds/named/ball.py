"""A ball thrown across the room, that bounces off its floor and walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.named import parts, room, shapes, textures
from amiwarp.simulation.worlds.scene import World
from amiwarp.simulation.worlds.trajectory import Trajectory

VIEW = room.VIEW
"""The camera of the room."""
RADIUS = 0.12
"""Of the ball [m]."""
GRAVITY = 9.81
"""Acceleration of falling [m/s²]."""
START = (-1.25, 1.0)
"""Distance along its way and height when it is thrown [m]."""
THROWN = (2.6, 3.9)
"""Velocity along its way and upwards when it is thrown [m/s]."""
LENGTH = 1.55
"""The way reaches so far both ways from its middle [m]."""
MIDDLE, WAY = (-0.15, -0.15), (math.sqrt(0.5), -math.sqrt(0.5))
"""Middle of the way on the floor [m], and its direction."""
BOUNCE = 0.8
"""Share of the speed that a bounce leaves."""
STEP_S = 0.002
"""Time between two poses [s]."""
SPIN = 5.0
"""Angular velocity about an upright axis and about the way [rad/s]."""


def build(rng: np.random.Generator, duration_s: float) -> World:
    """Return the room with the ball."""
    ball = parts.solid(
        "ball",
        shapes.ellipsoid((RADIUS,) * 3, sides=40, rings=20),
        textures.weathered(rng, textures.checkerboard(12), 0.2),
        "ball",
        trajectory=thrown(duration_s),
    )
    return World("ball", (*room.furniture(rng), ball), ambient=0.3, lamps=room.LAMPS)


def thrown(duration_s: float) -> Trajectory:
    """Return the poses of the ball."""
    from scipy.spatial.transform import Rotation

    t, along, height = flight(duration_s)
    position = np.column_stack([MIDDLE[0] + along * WAY[0], MIDDLE[1] + along * WAY[1], height])
    turn = np.outer(t, (SPIN * WAY[0], SPIN * WAY[1], 0.6 * SPIN))
    return Trajectory(t, position, Rotation.from_rotvec(turn).as_quat())


def flight(duration_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return times [s], distances along the way and heights [m]: parabolas between bounces."""
    t = np.linspace(0.0, duration_s, max(4, math.ceil(duration_s / STEP_S) + 1))
    step = float(t[1])
    s, z = START
    v, w = THROWN
    path = []
    for _ in t:
        path.append((s, z))
        s, z, w = s + v * step, z + w * step - 0.5 * GRAVITY * step**2, w - GRAVITY * step
        if abs(s) > LENGTH and s * v > 0.0:
            v = -BOUNCE * v
        if z < RADIUS and w < 0.0:
            z, v, w = RADIUS, 0.98 * v, -BOUNCE * w
            if w < GRAVITY * STEP_S * 4.0:
                v, w = 0.99 * v, 0.0
    along, height = np.array(path).T
    return t, along, height
