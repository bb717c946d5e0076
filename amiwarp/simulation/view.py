"""Directions in which the pixels of a simulated camera look, through the prism, a vibration or a mirror."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels import prism_view
from amiwarp.kernels.camera import camera_params
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.steerer import SteererModel
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.motion import Mirror, Moved, Steerer


def shake(simulation: SimulationValues, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what vibration or mirror do at times [us] to directions of the camera, shape (n, 3, 3).

    The matrices turn them into the directions in which the camera at rest would see the same points, mirrored by a
    mirror. Without both, also with a beam steerer, the result is the identity, shape (3, 3).
    """
    moved = simulation.prism
    if not isinstance(moved, Moved) or isinstance(moved, Steerer):
        return np.eye(3)
    model = moved.model(simulation.camera)
    return mirrored(simulation) @ model.rotations(simulation.prism_motion.angles(t_us))


def mirrored(simulation: SimulationValues) -> NDArray[np.float64]:
    """Return what a mirror at rest does to directions of the camera, shape (3, 3); without one the identity."""
    mirror = simulation.prism
    if not isinstance(mirror, Mirror):
        return np.eye(3)
    return mirror.model(simulation.camera).reflection


def prism_view_of(simulation: SimulationValues, device: Any) -> Any:
    """Return the kernels' :class:`amiwarp.kernels.prism_view.View` with camera and prisms, without maps."""
    view = prism_view.View()
    prism, *second = simulation.bending.singles()
    view.camera = camera_params(simulation.camera, str(device))
    view.prism = prism.params(device)
    if second:
        view.second = second[0].params(device)
    view.steered = int(isinstance(simulation.prism, Steerer))
    return view


def seen_bearings(simulation: SimulationValues) -> NDArray[np.float64]:
    """Return the directions that pixels on the image's border see over one turn of the prism, shape (n, 3).

    The directions are in the camera's frame. Pixels without a valid ray are left out.
    """
    border = _border(simulation.camera)
    theta = _angles_of_a_turn(simulation)
    moved = simulation.prism
    if isinstance(moved, Moved):
        return _moved_bearings(simulation, moved, border, theta)

    # Every pixel of the border at every pair of angles.
    device = simulation.device
    every_pixel = np.repeat(border, len(theta), axis=0).astype(np.float32)
    every_angle = np.tile(theta.astype(np.float32), (len(border), 1))
    xy = wp.array(every_pixel, dtype=wp.vec2, device=device)
    angles = wp.array(every_angle, dtype=wp.vec2, device=device)
    view = prism_view_of(simulation, wp.get_device(device))
    out = wp.empty(len(xy), dtype=wp.vec3, device=device)
    launch(prism_view.scene_bearings, len(xy), [view, xy, angles], [out], device=device)
    bearings = out.numpy().astype(np.float64)
    valid = np.isfinite(bearings).all(axis=1)
    return np.asarray(bearings[valid])


def _border(camera: Camera) -> NDArray[np.float64]:
    """Return pixels on the four edges of the image, shape (n, 2)."""
    right = camera.width - 1.0
    bottom = camera.height - 1.0
    along = np.linspace(0.0, 1.0, 33)
    zero = np.zeros(33)
    ones = np.ones(33)
    edges = []
    for x, y in ((along, zero), (along, ones), (zero, along), (ones, along)):
        edges.append(np.stack([x * right, y * bottom], 1))
    return np.asarray(np.round(np.concatenate(edges)), np.float64)


def _angles_of_a_turn(simulation: SimulationValues) -> NDArray[np.float64]:
    """Return pairs of angles of both prisms that cover all that they can show [rad], shape (n, 2).

    An angle that changes nothing is 0.
    """
    motion = simulation.prism_motion
    second_matters = motion.second is not None
    first_matters = (
        isinstance(simulation.prism, Moved)
        or simulation.glass.apex > 0.0
        or any(motion.cylinder)
        or second_matters
    )
    one_turn = np.arange(24) * (2.0 * np.pi / 24)
    at_rest = np.zeros(1)
    first_angles = one_turn if first_matters else at_rest
    second_angles = one_turn if second_matters else at_rest
    first, second = np.meshgrid(first_angles, second_angles)
    return np.stack([first.ravel(), second.ravel()], axis=1)


def _moved_bearings(
    simulation: SimulationValues,
    moved: Moved,
    border: NDArray[np.float64],
    theta: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the directions that pixels see at the angles of an optic that moves the view, shape (n, 3)."""
    rays = np.asarray(simulation.camera.pixels_to_rays(border), np.float64)
    rays = rays[np.isfinite(rays).all(axis=1)]
    model = moved.model(simulation.camera)
    angles = theta if model.ANGLES > 1 else theta[:, 0]
    if isinstance(model, SteererModel):
        return np.concatenate([_steered(rays, added) for added in model.added(angles)])
    turned = mirrored(simulation) @ model.rotations(angles)
    return np.concatenate([rays @ rotation.T for rotation in turned])


def _steered(rays: NDArray[np.float64], added: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the directions that unit rays (n, 3) see through a beam steerer that adds a vector (2,) to theirs."""
    transverse = rays[:, :2] - added
    squared = 1.0 - np.sum(transverse**2, axis=1)
    exists = squared > 0.0
    axial = np.sqrt(squared[exists])
    return np.column_stack([transverse[exists], axial])
