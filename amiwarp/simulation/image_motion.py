"""Largest motion of a simulated image, and the time step that it allows."""

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.plate import LARGEST_INVERSE_DEPTH
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.motion import Moved

LARGEST_MOTION = 0.5
"""Largest motion of the image in a time step of the simulation [px]."""
LARGEST_BEND = 0.002
"""Largest distance of the orbit from its chord in a time step [px]. Brightness is interpolated along the chord, so that
orbits come out too small by up to two thirds of it."""
PAIR_MARGIN = 1.1
"""Margin of the image's motion by a pair of prisms over the sum of both, as each deflects what the other deflected."""
LONGEST_STEP = 2000
"""Longest time step of the simulation, even if nothing moves [us]."""
STEPS_PER_FRAME = 4
"""Smallest number of time steps of the simulation between two pictures of a sequence."""


@dataclass(frozen=True, slots=True)
class ImageMotion:
    """Largest motion of the image that a turn of the prism or of the camera by a unit angle causes."""

    prisms: NDArray[np.float64]
    """Largest motion of the image per rotation angle of each prism, or per angle of a vibration [px/rad]; shape (1,) or
    (2,)."""
    bends: NDArray[np.float64]
    """Largest change of this motion per angle [px/rad²], of the same shape."""
    camera: NDArray[np.float64]
    """Largest motion of the image per rotation angle of the camera about each of its axes [px/rad], shape (3,)."""


def step_us(
    simulation: SimulationValues,
    *,
    world_speed: float = 0.0,
    longest: float = math.inf,
    inverse_depth: float = 0.0,
) -> int:
    """Return the length of a time step [us]: in it the image moves by at most half a pixel, and nearly straight.

    ``world_speed``: speed of the image of a world, prism excluded [px/s]; ``longest``: upper bound of the step [us];
    ``inverse_depth``: inverse depth of the nearest surface, for a plate [1/m].
    """
    motion = image_motion(simulation, inverse_depth)
    rates = simulation.camera_motion.largest_rates
    both_prisms = (simulation.prism_motion, simulation.prism_motion.second)
    turning = np.array(
        [motion_of_prism.largest_speed for motion_of_prism in both_prisms if motion_of_prism]
    )

    speed = float(motion.prisms @ turning) + float(motion.camera @ rates) + world_speed
    # [px/s²]: the distance from the chord, per squared step
    bend = float(motion.bends @ turning**2) / 8.0
    by_motion = LARGEST_MOTION / max(speed, 1e-9)
    by_bend = math.sqrt(LARGEST_BEND / max(bend, 1e-9))
    step = min(float(LONGEST_STEP), longest, 1e6 * min(by_motion, by_bend))

    frames = getattr(simulation.scene, "frames", None)
    if frames is not None and frames.interval_us is not None:
        step = min(step, frames.interval_us / STEPS_PER_FRAME)
    if step < 1.0:
        raise AmiwarpError(
            f"the image moves at {speed:.3g} px/s, over half a pixel per microsecond; slow down prism, camera or world"
        )
    return int(step)


def image_motion(simulation: SimulationValues, inverse_depth: float = 0.0) -> ImageMotion:
    """Return the largest motion of the image on a grid of pixels, corners included, over one turn of what moves it.

    ``inverse_depth``: inverse depth of the nearest surface, for a plate [1/m].
    """
    camera = simulation.camera
    device = simulation.device
    columns = np.linspace(0, camera.width - 1, 9)
    rows = np.linspace(0, camera.height - 1, 9)
    x, y = np.meshgrid(columns, rows)
    grid = np.stack([x.ravel(), y.ravel()], 1)

    # Every pixel of the grid at every angle of a turn.
    steps = 72
    theta = np.linspace(0.0, 2.0 * np.pi, steps + 1)
    step = theta[1]
    repeated = np.repeat(grid, steps + 1, axis=0).astype(np.float32)
    xy = wp.array(repeated, dtype=wp.vec2, device=device)
    angles = wp.array(np.tile(theta, len(grid)).astype(np.float32), dtype=float, device=device)

    # A step along a circle is longer than its chord.
    arc = (step / 2.0) / math.sin(step / 2.0)
    prisms = []
    bends = []
    shakes = isinstance(simulation.prism, Moved)
    for model in _single_models(simulation, inverse_depth):
        # The largest motion over a turn does not depend on where the prism starts.
        placed = model if shakes else replace(cast("Any", model), phase=0.0)
        path = placed.compensate_points(xy, angles).numpy().reshape(len(grid), steps + 1, 2)
        change = np.diff(path, axis=1)
        motion = _largest(np.linalg.norm(change, axis=2)) * arc / step
        bend = motion  # of a circle
        if shakes:
            change_of_change = np.diff(path, n=2, axis=1)
            bend = _largest(np.linalg.norm(change_of_change, axis=2)) / step**2
        prisms.append(motion)
        bends.append(bend)
    share = 1.0 if len(prisms) == 1 else PAIR_MARGIN
    of_camera = _camera_image_motion(simulation, grid)
    return ImageMotion(np.array(prisms) * share, np.array(bends) * share, of_camera)


def _single_models(simulation: SimulationValues, inverse_depth: float) -> list[Model]:
    """Return the models of each prism, or of the plate, vibration or mirror.

    ``inverse_depth``: inverse depth of the nearest surface, for a plate [1/m].
    """
    if simulation.plate is not None:
        nearest = min(inverse_depth, LARGEST_INVERSE_DEPTH)
        return [replace(simulation.plate, inverse_depth=nearest)]
    if isinstance(simulation.prism, Moved):
        return [*simulation.moving_model.singles()]
    return [*simulation.bending.singles()]


def _largest(values: NDArray[Any]) -> float:
    """Return the largest of the finite values; 0 without any."""
    return float(np.max(values, initial=0.0, where=np.isfinite(values)))


def _camera_image_motion(
    simulation: SimulationValues, grid: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the largest motion of the image per rotation angle of the camera about each axis [px/rad], shape (3,).

    ``grid``: pixels at which the motion is computed, shape (n, 2).
    """
    camera = simulation.camera
    device = simulation.device
    pixels = wp.array(grid.astype(np.float32), dtype=wp.vec2, device=device)
    rays = camera.pixels_to_rays(pixels).numpy()
    angle = 1e-2
    of_axes = []
    for axis in np.eye(3, dtype=np.float32):
        turned = wp.array(rays + angle * np.cross(axis, rays), dtype=wp.vec3, device=device)
        moved = camera.rays_to_pixels(turned).numpy() - grid
        of_axes.append(_largest(np.linalg.norm(moved, axis=1) / angle))
    # Margin, because the grid and the finite angle may miss the largest value
    return np.array(of_axes) * 1.02
