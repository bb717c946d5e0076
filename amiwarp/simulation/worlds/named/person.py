"""Built-in world ``person``: a figure of capsules and ellipsoids that walks in a circle in a hall."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.named import bodies as parts
from amiwarp.simulation.worlds.named.bodies import Viewpoint
from amiwarp.simulation.worlds.world import Body, Lamp, Mesh, Trajectory, World

# Gait of the walking figure in the world ``person``.
#
# The figure is a hierarchy of joints whose angles depend on the phase of the stride.

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
        "pelvis": parts.moved(parts.ellipsoid((0.12, 0.17, 0.13), tile_m=0.3), (0, 0, 0.03)),
        "torso": parts.moved(parts.ellipsoid((0.13, 0.2, 0.3), sides=28, rings=18, tile_m=0.35), (0, 0, 0.31)),
        "neck": parts.moved(parts.capsule(0.055, 0.14, tile_m=0.2), (0, 0, 0.1)),
        "head": parts.merged([
            parts.ellipsoid((0.1, 0.085, 0.125), sides=28, rings=16, tile_m=0.3),
            parts.moved(parts.ellipsoid((0.03, 0.014, 0.02), sides=12, rings=6, tile_m=0.3), (0.1, 0, -0.01)),
        ]),
    }  # fmt: skip
    for side in SIDES:
        out[f"{side} upper arm"] = parts.capsule(0.05, UPPER_ARM, tile_m=0.25)
        out[f"{side} forearm"] = parts.capsule(0.04, FOREARM, tile_m=0.25)
        out[f"{side} hand"] = parts.moved(parts.ellipsoid((0.045, 0.025, 0.09), sides=16, tile_m=0.2), (0, 0, -0.08))
        out[f"{side} thigh"] = parts.capsule(0.075, THIGH, tile_m=0.3)
        out[f"{side} shin"] = parts.capsule(0.055, SHIN, tile_m=0.3)
        foot = parts.ellipsoid((0.14, 0.05, 0.045), sides=20, rings=10, tile_m=0.2)
        out[f"{side} foot"] = parts.moved(foot, (0.06, 0, -0.03))
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


SIZE = (9.0, 8.0, 3.2)
"""Length, width and height of the hall [m]."""
VIEW = Viewpoint((0.3, -3.4, 1.35), (0.05, 0.0, 1.0))
"""Camera pose: near a wall. The figure first crosses the view from left to right."""
LAMPS = (Lamp((-1.5, -1.5, 3.0), 4.5, shadows=True), Lamp((2.5, 1.5, 2.9), 3.0))
"""Two lamps near the ceiling; the first casts shadows."""


def build(rng: np.random.Generator, duration_s: float) -> World:
    """Return the world: the hall and the figure. All bodies of the figure belong to the instance ``person``."""
    walls = [
        parts.bricks(rng, mean=0.4),
        parts.plaster(rng, 0.5, 0.45),
        parts.plaster(rng),
        parts.plaster(rng, 0.4),
    ]
    bodies = parts.hall(SIZE, walls, parts.wood(rng, mean=0.35), parts.tiles(rng, mean=0.6, joint=0.2, count=4))
    poses = walk(duration_s)
    return World(
        "person",
        (*bodies, *_hall(rng), *_figure(rng, poses)),
        ambient=0.3,
        lamps=LAMPS,
        joints={name: poses[name] for name in JOINTS},
    )


def _hall(rng: np.random.Generator) -> list[Body]:
    """Return the pictures and furniture of the hall, which leave the figure's path free."""
    north, y = (1.0, 0.0, 0.0), SIZE[1] / 2.0
    columns = [
        parts.moved(parts.cylinder(0.18, SIZE[2], sides=32, tile_m=0.6), (x, 3.3, 0)) for x in (-3.3, -1.1, 1.1, 3.3)
    ]
    return [
        *parts.grating_strip("grating", (-2.0, y, 2.2), north, count=8, side=0.45, cycles=6.0),
        *parts.picture("star", (-2.2, y, 1.3), north, parts.star(), 1.2, 1.2),
        *parts.picture("poster", (0.0, y, 1.3), north, parts.poster(rng), 1.3, 1.2),
        *parts.picture("page", (2.2, y, 1.3), north, parts.text_page(rng, letter=26), 0.95, 1.25),
        parts.solid("columns", parts.merged(columns), parts.plaid(rng, stripes=8), "column"),
        parts.table("bench", (1.6, 0.4, 0.45), (-3.6, 1.6, 0), parts.wood(rng, boards=4), turn_deg=90.0),
        parts.table("second bench", (1.6, 0.4, 0.45), (3.6, 1.2, 0), parts.wood(rng, boards=4), turn_deg=80.0),
        parts.solid(
            "crate",
            parts.moved(parts.standing_box((0.6, 0.6, 0.6)), (3.0, -1.6, 0), turn_deg=20),
            parts.poster(rng),
            "box",
        ),
        parts.solid(
            "carpet",
            parts.standing_box((4.6, 4.2, 0.01), (0, 0.8, -0.002)),
            parts.plaid(rng, size=512, stripes=30),
            "carpet",
        ),
    ]


def _figure(rng: np.random.Generator, poses: dict[str, Trajectory]) -> list[Body]:
    """Return the limbs of the figure. Each limb has the trajectory of its upper joint."""
    skin = parts.plaster(rng, 0.42, 0.25, size=256)
    trousers = parts.plaster(rng, 0.16, 0.45, size=256)
    shirt, shoe = parts.plaid(rng, stripes=12), parts.plaster(rng, 0.07, 0.4, size=128)
    cloth = dict.fromkeys(("head", "neck", "forearm", "hand"), skin)
    cloth |= dict.fromkeys(("torso", "upper arm"), shirt)
    cloth |= dict.fromkeys(("pelvis", "thigh", "shin"), trousers) | {"foot": shoe}
    bodies = []
    for name, mesh in limbs().items():
        kind = name.removeprefix("left ").removeprefix("right ")
        bodies.append(parts.solid(name, mesh, cloth[kind], "person", instance="person", trajectory=poses[name]))
    return bodies
