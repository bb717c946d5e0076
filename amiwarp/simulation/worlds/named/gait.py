"""Gait of the walking figure in the world ``person``.

The figure is a hierarchy of joints whose angles depend on the phase of the stride.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.named import shapes
from amiwarp.simulation.worlds.scene import Mesh
from amiwarp.simulation.worlds.trajectory import Trajectory

SPEED = 1.25
"""Walking speed [m/s]."""
STRIDES_HZ = 0.92
"""Number of strides, of two steps each, per second."""
CIRCLE_M = 1.6
"""Radius of the circular path [m]. Its centre is at x = 0, y = 0.8 m."""
RATE_HZ = 200.0
"""Number of poses per second in the trajectories of the limbs."""
THIGH, SHIN, UPPER_ARM, FOREARM = 0.44, 0.42, 0.29, 0.26
"""Lengths of the limbs [m]."""
HIP, SHOULDER, SPINE = 0.1, 0.2, 0.5
"""Half the distances between the hips and between the shoulders, and height of the shoulders above the hips [m]."""
ANKLE = 0.075
"""Height of the ankle above the sole [m]."""
SIDES = ("left", "right")
"""Sides of the body, as in the names of limbs and joints."""
JOINTS = (
    "head",
    *(f"{side} {joint}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in SIDES),
)
"""Names of the joints whose positions belong to the ground truth."""

Places = tuple[Any, NDArray[np.float64]]
"""Pose over time: orientations as a ``Rotation``, and positions [m], shape (n, 3)."""


def limbs() -> dict[str, Mesh]:
    """Return the meshes of the limbs by name, each in the frame of its joint: x forward, y to the left, z up."""
    out = {
        "pelvis": shapes.moved(shapes.ellipsoid((0.12, 0.17, 0.13), tile_m=0.3), (0, 0, 0.03)),
        "torso": shapes.moved(shapes.ellipsoid((0.13, 0.2, 0.3), sides=28, rings=18, tile_m=0.35), (0, 0, 0.31)),
        "neck": shapes.moved(shapes.capsule(0.055, 0.14, tile_m=0.2), (0, 0, 0.1)),
        "head": shapes.merged([
            shapes.ellipsoid((0.1, 0.085, 0.125), sides=28, rings=16, tile_m=0.3),
            shapes.moved(shapes.ellipsoid((0.03, 0.014, 0.02), sides=12, rings=6, tile_m=0.3), (0.1, 0, -0.01)),
        ]),
    }  # fmt: skip
    for side in SIDES:
        out[f"{side} upper arm"] = shapes.capsule(0.05, UPPER_ARM, tile_m=0.25)
        out[f"{side} forearm"] = shapes.capsule(0.04, FOREARM, tile_m=0.25)
        out[f"{side} hand"] = shapes.moved(shapes.ellipsoid((0.045, 0.025, 0.09), sides=16, tile_m=0.2), (0, 0, -0.08))
        out[f"{side} thigh"] = shapes.capsule(0.075, THIGH, tile_m=0.3)
        out[f"{side} shin"] = shapes.capsule(0.055, SHIN, tile_m=0.3)
        foot = shapes.ellipsoid((0.14, 0.05, 0.045), sides=20, rings=10, tile_m=0.2)
        out[f"{side} foot"] = shapes.moved(foot, (0.06, 0, -0.03))
    return out


def walk(duration_s: float) -> dict[str, Trajectory]:
    """Return the trajectories of all joints and limbs by name, for a walk of ``duration_s`` [s]."""
    t = np.linspace(0.0, duration_s, max(4, round(duration_s * RATE_HZ) + 1))
    phase = 2.0 * np.pi * STRIDES_HZ * t
    path = SPEED * t / CIRCLE_M - np.pi / 2.0 - 0.45  # angle on the circle, from the left of the camera's view
    heading = _about((0, 0, 1), path + np.pi / 2.0)
    ground = np.column_stack([CIRCLE_M * np.cos(path), 0.8 + CIRCLE_M * np.sin(path), np.zeros(len(t))])
    root = (heading * _about((0, 0, 1), 0.08 * np.sin(phase)), ground)
    places = {**_legs(root, phase), **_upper(root, phase)}
    lift = -np.minimum(*(places[f"{side} ankle"][1][:, 2] for side in SIDES)) + ANKLE
    return {name: Trajectory(t, at + lift[:, None] * (0, 0, 1), turn.as_quat()) for name, (turn, at) in places.items()}


def _about(axis: tuple[int, int, int], angle: NDArray[np.float64]) -> Any:
    """Return rotations by angles [rad] about an axis."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.outer(angle, axis))


def _child(parent: Places, offset: tuple[float, float, float], turn: Any) -> Places:
    """Return the pose of a joint at ``offset`` in its parent's frame, rotated by ``turn`` relative to the parent."""
    rotation, position = parent
    return rotation * turn, position + rotation.apply(offset)


def _legs(root: Places, phase: NDArray[np.float64]) -> dict[str, Places]:
    """Return the poses of pelvis, hips, knees and ankles, and of the limbs below them.

    ``phase``: phase of the stride [rad], shape (n,). The knee bends while its leg swings forward, and the foot stays
    nearly level. The coefficients minimise the sliding of the standing foot. The angles stay within the range of human
    walking.
    """
    out = {"pelvis": root}
    for side, y, shift in (("left", HIP, 0.0), ("right", -HIP, np.pi)):
        p = phase + shift
        hip = -0.297 * (np.sin(p) - 0.065 * np.sin(3.0 * p)) - 0.192
        knee = 0.05 + 1.15 * ((1.0 + np.cos(p + 0.22)) / 2.0) ** 4
        thigh = _child(root, (0, y, 0), _about((0, 1, 0), hip))
        shin = _child(thigh, (0, 0, -THIGH), _about((0, 1, 0), knee))
        ankle = _child(shin, (0, 0, -SHIN), _about((0, 1, 0), -0.75 * (hip + knee)))
        for names, place in ((("hip", "thigh"), thigh), (("knee", "shin"), shin), (("ankle", "foot"), ankle)):
            out |= {f"{side} {name}": place for name in names}
    return out


def _upper(root: Places, phase: NDArray[np.float64]) -> dict[str, Places]:
    """Return the poses of trunk, neck, head and arms. Each arm swings with the opposite leg."""
    trunk = _child(root, (0, 0, 0.06), _about((0, 0, 1), -0.2 * np.sin(phase)) * _about((0, 1, 0), 0.05 + 0 * phase))
    neck = _child(trunk, (0, 0, SPINE + 0.08), _about((0, 0, 1), 0.12 * np.sin(phase)))
    head = _child(neck, (0.015, 0, 0.2), _about((0, 1, 0), -0.05 + 0.02 * np.sin(2.0 * phase)))
    out = {"torso": trunk, "neck": neck, "head": head}
    for side, y, shift in (("left", SHOULDER, np.pi), ("right", -SHOULDER, 0.0)):
        p, outward = phase + shift, 1.0 if y > 0 else -1.0
        tilt = _about((1, 0, 0), 0.1 * outward + 0 * p)
        upper = _child(trunk, (0, y, SPINE), tilt * _about((0, 1, 0), -0.45 * np.sin(p) + 0.08))
        fore = _child(upper, (0, 0, -UPPER_ARM), _about((0, 1, 0), -0.35 - 0.25 * (1.0 + np.sin(p))))
        hand = _child(fore, (0, 0, -FOREARM), _about((0, 1, 0), -0.1 + 0 * p))
        for names, place in (
            (("shoulder", "upper arm"), upper),
            (("elbow", "forearm"), fore),
            (("wrist", "hand"), hand),
        ):
            out |= {f"{side} {name}": place for name in names}
    return out
