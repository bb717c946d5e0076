"""Built-in world ``ball``: a ball thrown across a room that bounces off the floor and at both ends of its path."""

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.named import parts, room, shapes, textures
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World

VIEW = room.VIEW
"""Camera pose, the same as in the world ``room``."""
RADIUS = 0.12
"""Radius of the ball [m]."""
GRAVITY = 9.81
"""Acceleration of free fall [m/s²]."""
THROW_START = (-1.25, 1.0)
"""Position at the start of the throw: distance along the path from its middle, and height [m]."""
THROW_VELOCITY = (2.6, 3.9)
"""Initial velocity of the ball along the path and upwards [m/s]."""
PATH_HALF_LENGTH = 1.55
"""Half the length of the path on the floor [m]; the ball bounces at both ends."""
PATH_MIDDLE = (-0.15, -0.15)
PATH_DIRECTION = (math.sqrt(0.5), -math.sqrt(0.5))
"""Middle of the path on the floor (x, y) [m], and its direction (unit vector)."""
BOUNCE = 0.8
"""Fraction of the speed that remains after a bounce."""
FLIGHT_STEP_S = 0.002
"""Longest time between two poses of the ball's trajectory [s]."""
SPIN = 5.0
"""Angular velocity of the ball about the direction of the path [rad/s].

The angular velocity about the vertical axis is 0.6 times as large.
"""


def build(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world: the room and the ball. ``duration_s``: length of the ball's trajectory [s]."""
    mesh = shapes.ellipsoid((RADIUS, RADIUS, RADIUS), sides=40, rings=20)
    chequered = textures.weathered(rng, textures.checkerboard(12), 0.2)
    ball = parts.solid("ball", mesh, chequered, "ball", trajectory=thrown(duration_s))
    return World("ball", (*room.furniture(rng), ball), ambient=0.3, lamps=room.LAMPS)


def thrown(duration_s: float) -> Trajectory:
    """Return the trajectory of the ball over ``duration_s`` [s]."""
    from scipy.spatial.transform import Rotation

    t, along, height = flight(duration_s)
    x = PATH_MIDDLE[0] + along * PATH_DIRECTION[0]
    y = PATH_MIDDLE[1] + along * PATH_DIRECTION[1]
    position = np.column_stack([x, y, height])

    spin = (SPIN * PATH_DIRECTION[0], SPIN * PATH_DIRECTION[1], 0.6 * SPIN)
    turn = np.outer(t, spin)
    return Trajectory(t, position, Rotation.from_rotvec(turn).as_quat())


def flight(
    duration_s: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the ball's flight: times [s], distances along the path from its middle [m], and heights [m].

    Between two bounces the flight is a parabola.
    """
    t = np.linspace(0.0, duration_s, max(4, math.ceil(duration_s / FLIGHT_STEP_S) + 1))
    step = float(t[1])
    along, height = THROW_START
    speed_along, speed_up = THROW_VELOCITY
    path = []
    for _ in t:
        path.append((along, height))
        along = along + speed_along * step
        height = height + speed_up * step - 0.5 * GRAVITY * step**2
        speed_up = speed_up - GRAVITY * step

        past_the_end = abs(along) > PATH_HALF_LENGTH and along * speed_along > 0.0
        if past_the_end:
            speed_along = -BOUNCE * speed_along

        hits_the_floor = height < RADIUS and speed_up < 0.0
        if hits_the_floor:
            height = RADIUS
            speed_along = 0.98 * speed_along
            speed_up = -BOUNCE * speed_up
            # A bounce that would last a few steps only is rolling.
            if speed_up < GRAVITY * FLIGHT_STEP_S * 4.0:
                speed_along = 0.99 * speed_along
                speed_up = 0.0
    all_along, all_heights = np.array(path).T
    return t, all_along, all_heights
