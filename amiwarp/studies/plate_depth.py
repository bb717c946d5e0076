"""Depth by a turning plate: how precisely one turn determines it, and a wall that shows a picture at a depth."""

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.models.plate import PlateModel
from amiwarp.simulation.description import Scene
from amiwarp.simulation.worlds.bodies import Body, Material, Mesh
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.edge_coverage import DIRECTIONS
from amiwarp.studies.image_flow import flow_of
from amiwarp.studies.orbits import TURN_ANGLES, image_grid, paths

WALL_BLUR = 0.8
"""Blur of a wall seen by rays relative to the same picture's at infinity: the levels of its texture blur it, too. With
it, the mean gradients of four pictures are within 5 % of the gradients at infinity."""
DEPTH_STEP = 0.05
"""Relative step of the inverse depth for the derivative of the image with respect to it."""


def depth_deviation(model: PlateModel, noise: float) -> float:
    """Return the relative standard deviation of the depth of an edge, by one turn and one pixel of its length.

    ``noise``: standard deviation of the place of an event across the edge [px]. The edge causes one event at each pixel
    that it crosses. A fit of inverse depth and of the place of the edge at rest, by least squares, has this deviation.
    It is the rms over the image and over the directions of edges.
    """
    pixels = image_grid(model.camera)
    (flow,) = flow_of(model, pixels, 1)

    def paths_at(scale: float) -> NDArray[np.float64]:
        inverse_depth = model.inverse_depth * scale
        plate = PlateModel(model.camera, model.plate, model.phase, inverse_depth)
        return paths(plate, pixels, TURN_ANGLES)

    azimuth = np.arange(DIRECTIONS) * (np.pi / DIRECTIONS)
    normals = np.stack([np.cos(azimuth), np.sin(azimuth)])

    # Motion across the edge by the logarithm of the inverse depth, at each event
    nearer = paths_at(1.0 + DEPTH_STEP)
    farther = paths_at(1.0 - DEPTH_STEP)
    moved = (nearer - farther) @ normals / (2.0 * DEPTH_STEP)

    # The variance of the depth is 1 / spread: the place of the edge at rest is fitted, too.
    events = np.abs(flow @ normals) * (math.tau / TURN_ANGLES)
    count = events.sum(axis=1)
    total = (events * moved).sum(axis=1)
    total_of_squares = (events * moved**2).sum(axis=1)
    spread = total_of_squares - total**2 / count
    return noise * math.sqrt(float(np.nanmean(1.0 / spread)))


def wall(scene: Scene, depth: float) -> WorldScene:
    """Return a world that shows the first picture of a scene with a field of view on a wall at a depth [m]."""
    assert scene.fov is not None
    _, picture = next(scene.frames.read())
    right = depth * math.tan(scene.fov / 2.0)
    top = right * picture.shape[0] / picture.shape[1]
    corners = [
        (-right, depth, -top),
        (right, depth, -top),
        (right, depth, top),
        (-right, depth, top),
    ]
    faces = [[0, 1, 2], [0, 2, 3]]
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    body = Body("wall", Mesh(corners, faces, uv), Material(1.0, picture))
    world = World("wall", (body,), ambient=1.0)
    still = Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    return WorldScene(world, still, WALL_BLUR * scene.blur)
