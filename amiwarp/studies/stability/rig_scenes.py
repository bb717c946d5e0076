"""Scenes of the rigs: a picture far away, or on a slanted wall for a plate, which displaces only what is near."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from amiwarp.optics.camera import Camera
from amiwarp.simulation.worlds.bodies import Body, Material, Mesh
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.stability.optics import Array
from amiwarp.studies.stability.scenes import SceneKind, draw

if TYPE_CHECKING:
    from amiwarp.studies.stability.condition import Condition

DEPTH_PER_M = 2.0
"""Inverse depth of the wall behind a plate, in the middle of the image [1/m]."""
SLANT = 0.25
"""Largest relative change of that inverse depth from the middle of the image to its edge."""
TEXELS = 2.0
"""Texels of the scene's picture per camera pixel, in the middle of the image."""


def scene_picture(condition: Condition, seed: int, reach: float) -> NDArray[np.float32]:
    """Return the picture of the scene, ``reach`` times as large as the image."""
    width = 2 * math.ceil(0.5 * TEXELS * reach * condition.width)
    height = 2 * math.ceil(0.5 * TEXELS * reach * condition.height)
    return draw(SceneKind(condition.scene), width, height, period=12.0, seed=seed)


def plane_at(camera: Camera, slant: Array, xy: Array) -> Array:
    """Return the inverse depth of the wall at pixels [1/m], shape ``(n,)``. ``slant``: [1/m per unit tangent]."""
    rays = camera.pixels_to_rays(xy).astype(np.float64)
    tangents = rays[:, :2] / rays[:, 2:]
    return np.asarray(DEPTH_PER_M + tangents @ slant)


def wall(
    condition: Condition, slant: Array, turning: Array, duration_s: float, seed: int
) -> WorldScene:
    """Return a camera in front of a slanted wall, which is a plane. ``turning``: rotation of the camera [rad/s]."""
    # The wall is larger than the image, by a margin for the plate and by the way that a turning camera looks aside.
    aside = 0.5 * math.radians(condition.camera_deg_s) * duration_s
    half_view = math.radians(condition.fov_deg) / 2.0
    reach = 1.15 + aside / math.tan(half_view)
    right = reach * 0.5 * condition.width / condition.camera.fx
    bottom = reach * 0.5 * condition.height / condition.camera.fy

    corners = []
    directions = ((-right, bottom), (right, bottom), (right, -bottom), (-right, -bottom))
    for x, y in directions:
        depth = 1.0 / (DEPTH_PER_M + float(slant @ (x, y)))
        corners.append((x * depth, depth, -y * depth))  # the camera looks along y, with z up
    faces = [[0, 1, 2], [0, 2, 3]]
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    mesh = Mesh(corners, faces, uv)
    material = Material(texture=scene_picture(condition, seed, reach))
    world = World("wall", (Body("wall", mesh, material),), ambient=1.0)

    still = Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    if not turning.any():
        return WorldScene(world, still)
    t = np.linspace(0.0, duration_s, 50)
    from_middle = t - 0.5 * duration_s  # so that the wall stays in view
    facing = Rotation.from_quat(np.asarray(still.rotation, np.float64)[0])
    rotations = facing * Rotation.from_rotvec(np.outer(from_middle, turning))
    positions = np.zeros((len(t), 3))
    return WorldScene(world, Trajectory(t, positions, rotations.as_quat()))
