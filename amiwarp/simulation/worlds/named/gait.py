"""Gait of the walking figure in the world ``person``.

The figure is a hierarchy of joints whose angles depend on the phase of the stride.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.bodies import Mesh
from amiwarp.simulation.worlds.named import shapes
from amiwarp.simulation.worlds.trajectory import Trajectory

SPEED = 1.25
"""Walking speed [m/s]."""
STRIDES_HZ = 0.92
"""Number of strides, of two steps each, per second."""
CIRCLE_M = 1.6
"""Radius of the circular path [m]. Its centre is at x = 0, y = 0.8 m."""
RATE_HZ = 200.0
"""Number of poses per second in the trajectories of the limbs."""
THIGH = 0.44
SHIN = 0.42
UPPER_ARM = 0.29
FOREARM = 0.26
"""Lengths of the limbs [m]."""
HIP = 0.1
SHOULDER = 0.2
SPINE = 0.5
"""Half the distances between the hips and between the shoulders, and height of the shoulders above the hips [m]."""
ANKLE = 0.075
"""Height of the ankle above the sole [m]."""
FORWARD = np.array([1.0, 0.0, 0.0])
LEFT = np.array([0.0, 1.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])
"""Axes of a joint's frame."""
SIDES = ("left", "right")
"""Sides of the body, as in the names of limbs and joints."""
JOINTS = (
    "head",
    *(
        f"{side} {joint}"
        for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in SIDES
    ),
)
"""Names of the joints whose positions belong to the ground truth."""
Places = tuple[Any, NDArray[np.float64]]
"""Pose over time: orientations as a ``Rotation``, and positions [m], shape (n, 3)."""


def limbs() -> dict[str, Mesh]:
    """Return the meshes of the limbs by name, each in the frame of its joint: x forward, y to the left, z up."""
    pelvis = shapes.ellipsoid((0.12, 0.17, 0.13), tile_m=0.3)
    torso = shapes.ellipsoid((0.13, 0.2, 0.3), sides=28, rings=18, tile_m=0.35)
    neck = shapes.capsule(0.055, 0.14, tile_m=0.2)
    skull = shapes.ellipsoid((0.1, 0.085, 0.125), sides=28, rings=16, tile_m=0.3)
    nose = shapes.ellipsoid((0.03, 0.014, 0.02), sides=12, rings=6, tile_m=0.3)
    meshes = {
        "pelvis": shapes.moved(pelvis, (0, 0, 0.03)),
        "torso": shapes.moved(torso, (0, 0, 0.31)),
        "neck": shapes.moved(neck, (0, 0, 0.1)),
        "head": shapes.merged([skull, shapes.moved(nose, (0.1, 0, -0.01))]),
    }

    hand = shapes.ellipsoid((0.045, 0.025, 0.09), sides=16, tile_m=0.2)
    foot = shapes.ellipsoid((0.14, 0.05, 0.045), sides=20, rings=10, tile_m=0.2)
    for side in SIDES:
        meshes[f"{side} upper arm"] = shapes.capsule(0.05, UPPER_ARM, tile_m=0.25)
        meshes[f"{side} forearm"] = shapes.capsule(0.04, FOREARM, tile_m=0.25)
        meshes[f"{side} hand"] = shapes.moved(hand, (0, 0, -0.08))
        meshes[f"{side} thigh"] = shapes.capsule(0.075, THIGH, tile_m=0.3)
        meshes[f"{side} shin"] = shapes.capsule(0.055, SHIN, tile_m=0.3)
        meshes[f"{side} foot"] = shapes.moved(foot, (0.06, 0, -0.03))
    return meshes


def walk(duration_s: float) -> dict[str, Trajectory]:
    """Return the trajectories of all joints and limbs by name, for a walk of ``duration_s`` [s]."""
    t = np.linspace(0.0, duration_s, max(4, round(duration_s * RATE_HZ) + 1))
    phase = 2.0 * np.pi * STRIDES_HZ * t
    # Angle on the circle, from the left of the camera's view
    azimuth = SPEED * t / CIRCLE_M - np.pi / 2.0 - 0.45
    heading = _about(UP, azimuth + np.pi / 2.0)
    x = CIRCLE_M * np.cos(azimuth)
    y = 0.8 + CIRCLE_M * np.sin(azimuth)
    ground = np.column_stack([x, y, np.zeros(len(t))])
    hips_turn = _about(UP, 0.08 * np.sin(phase))
    root = (heading * hips_turn, ground)
    places = {**_legs(root, phase), **_upper(root, phase)}

    # The lower foot stands on the floor.
    left_ankle_z, right_ankle_z = (places[f"{side} ankle"][1][:, 2] for side in SIDES)
    lift = -np.minimum(left_ankle_z, right_ankle_z) + ANKLE
    trajectories = {}
    for name, (rotation, position) in places.items():
        lifted = position + lift[:, None] * UP
        trajectories[name] = Trajectory(t, lifted, rotation.as_quat())
    return trajectories


def _about(axis: NDArray[np.float64], angle: NDArray[np.float64]) -> Any:
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
    places = {"pelvis": root}
    for side, y, shift in (("left", HIP, 0.0), ("right", -HIP, np.pi)):
        of_leg = phase + shift
        hip_angle = -0.297 * (np.sin(of_leg) - 0.065 * np.sin(3.0 * of_leg)) - 0.192
        knee_angle = 0.05 + 1.15 * ((1.0 + np.cos(of_leg + 0.22)) / 2.0) ** 4
        ankle_angle = -0.75 * (hip_angle + knee_angle)
        hip = _child(root, (0, y, 0), _about(LEFT, hip_angle))
        knee = _child(hip, (0, 0, -THIGH), _about(LEFT, knee_angle))
        ankle = _child(knee, (0, 0, -SHIN), _about(LEFT, ankle_angle))
        # A limb has the pose of its upper joint.
        places[f"{side} hip"] = hip
        places[f"{side} thigh"] = hip
        places[f"{side} knee"] = knee
        places[f"{side} shin"] = knee
        places[f"{side} ankle"] = ankle
        places[f"{side} foot"] = ankle
    return places


def _upper(root: Places, phase: NDArray[np.float64]) -> dict[str, Places]:
    """Return the poses of trunk, neck, head and arms. Each arm swings with the opposite leg."""
    always = np.ones_like(phase)
    twist = _about(UP, -0.2 * np.sin(phase))
    lean = _about(LEFT, 0.05 * always)
    trunk = _child(root, (0, 0, 0.06), twist * lean)
    turn_of_head = _about(UP, 0.12 * np.sin(phase))
    neck = _child(trunk, (0, 0, SPINE + 0.08), turn_of_head)
    nod = _about(LEFT, -0.05 + 0.02 * np.sin(2.0 * phase))
    head = _child(neck, (0.015, 0, 0.2), nod)
    places = {"torso": trunk, "neck": neck, "head": head}

    for side, y, shift in (("left", SHOULDER, np.pi), ("right", -SHOULDER, 0.0)):
        of_arm = phase + shift
        outward = 1.0 if side == "left" else -1.0
        tilt = _about(FORWARD, 0.1 * outward * always)
        swing = _about(LEFT, -0.45 * np.sin(of_arm) + 0.08)
        bend_of_elbow = _about(LEFT, -0.35 - 0.25 * (1.0 + np.sin(of_arm)))
        bend_of_wrist = _about(LEFT, -0.1 * always)
        shoulder = _child(trunk, (0, y, SPINE), tilt * swing)
        elbow = _child(shoulder, (0, 0, -UPPER_ARM), bend_of_elbow)
        wrist = _child(elbow, (0, 0, -FOREARM), bend_of_wrist)
        # A limb has the pose of its upper joint.
        places[f"{side} shoulder"] = shoulder
        places[f"{side} upper arm"] = shoulder
        places[f"{side} elbow"] = elbow
        places[f"{side} forearm"] = elbow
        places[f"{side} wrist"] = wrist
        places[f"{side} hand"] = wrist
    return places
