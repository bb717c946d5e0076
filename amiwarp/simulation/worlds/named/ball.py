"""Built-in world ``ball``: a ball thrown across a room that bounces off the floor and at both ends of its path."""

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.named import bodies, room
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World

VIEW = room.VIEW
"""Camera pose, the same as in the world ``room``."""
RADIUS = 0.12
"""Radius of the ball [m]."""
GRAVITY = 9.81
"""Acceleration of free fall [m/s²]."""
START = (-1.25, 1.0)
"""Position at the start of the throw: distance along the path from its middle, and height [m]."""
THROWN = (2.6, 3.9)
"""Initial velocity of the ball along the path and upwards [m/s]."""
LENGTH = 1.55
"""Half the length of the path on the floor [m]; the ball bounces at both ends."""
MIDDLE, DIRECTION = (-0.15, -0.15), (math.sqrt(0.5), -math.sqrt(0.5))
"""Middle of the path on the floor (x, y) [m], and its direction (unit vector)."""
BOUNCE = 0.8
"""Fraction of the speed that remains after a bounce."""
STEP_S = 0.002
"""Longest time between two poses of the ball's trajectory [s]."""
SPIN = 5.0
"""Angular velocity of the ball about the direction of the path [rad/s].

The angular velocity about the vertical axis is 0.6 times as large.
"""


def build(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world: the room and the ball. ``duration_s``: length of the ball's trajectory [s]."""
    ball = bodies.solid(
        "ball",
        bodies.ellipsoid((RADIUS,) * 3, sides=40, rings=20),
        bodies.weathered(rng, bodies.checkerboard(12), 0.2),
        "ball",
        trajectory=thrown(duration_s),
    )
    return World("ball", (*room.furniture(rng), ball), ambient=0.3, lamps=room.LAMPS)


def thrown(duration_s: float) -> Trajectory:
    """Return the trajectory of the ball over ``duration_s`` [s]."""
    from scipy.spatial.transform import Rotation

    t, along, height = flight(duration_s)
    position = np.column_stack([MIDDLE[0] + along * DIRECTION[0], MIDDLE[1] + along * DIRECTION[1], height])
    turn = np.outer(t, (SPIN * DIRECTION[0], SPIN * DIRECTION[1], 0.6 * SPIN))
    return Trajectory(t, position, Rotation.from_rotvec(turn).as_quat())


def flight(duration_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the ball's flight: times [s], distances along the path from its middle [m], and heights [m].

    Between two bounces the flight is a parabola.
    """
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
