"""Speed at which the image of a simulated world moves.

The simulator derives the length of its time steps and the times of its maps from this speed.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.camera import Camera
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.worlds.bodies import Body
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.surfaces import pixel_rays, surfaces_at
from amiwarp.simulation.worlds.trajectory import Trajectory, abrupt_changes, poses_near
from amiwarp.simulation.worlds.world_scene import WorldScene

PROBE = 48
"""Number of columns of the grid of rays that measures the distances of visible surfaces."""
NEAREST_M = 0.02
"""Smallest distance for which speeds in the image are computed [m]. Nearer surfaces are treated as this far away."""
MOMENT_S = 1e-3
"""Time over which speeds are computed as difference quotients [s]."""
FLICKER_SAMPLES = 16
"""Smallest number of time steps, and of maps, per period of a flickering lamp."""
SAFETY = 1.2
"""Factor by which a speed measured on a coarse grid is increased, because the grid can miss the fastest pixel."""


def body_speed(
    body: Body, trajectory: Trajectory, focal: float, t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a moving body's largest speed in the middle of the image [px/s] at times [s], shape ``(n,)``.

    At an angle from the optical axis, a body may be faster by 1/cos² of the angle.
    """
    assert body.trajectory is not None
    centre, radius = body.mesh.bounding_sphere
    rotation, position = body.trajectory.poses(t)
    # A jump is no speed.
    rotation_after, position_after = poses_near(body.trajectory, t, t + MOMENT_S)
    _, camera = trajectory.poses(t)
    _, camera_after = trajectory.poses(t + MOMENT_S)

    # Of the bounding sphere, relative to the camera.
    place = rotation @ centre + position - camera
    place_after = rotation_after @ centre + position_after - camera_after
    speed_of_centre = np.linalg.norm(place_after - place, axis=1) / MOMENT_S
    speed_around_centre = turn_rate(rotation, rotation_after) * radius
    distance = np.maximum(np.linalg.norm(place, axis=1) - radius, NEAREST_M)
    return np.asarray(focal * (speed_of_centre + speed_around_centre) / distance)


def turn_rate(
    rotation: NDArray[np.float64], rotation_after: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the angular speed [rad/s] between rotations (n, 3, 3) that are :data:`MOMENT_S` apart."""
    cosine = (np.einsum("nij,nij->n", rotation, rotation_after) - 1.0) / 2.0
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) / MOMENT_S)


def parallax_speed(
    world: DeviceWorld, camera: Camera, trajectory: Trajectory, t: float, instant: int
) -> float:
    """Return the largest speed in the image [px/s] that the camera's translation causes.

    Each surface counts as in the middle of the image, see :func:`body_speed`.
    ``instant``: index of the time ``t`` [s] in the last call of :meth:`DeviceWorld.set_instants`.
    """
    (rotation,), (position,) = trajectory.poses([t])
    _, (position_after,) = trajectory.poses([t + MOMENT_S])
    velocity = (position_after - position) / MOMENT_S
    if not velocity.any():
        return 0.0
    surfaces = surfaces_at(world, pixel_rays(small_camera(camera)), rotation, position, instant)
    near = surfaces.place[np.isfinite(surfaces.depth)].astype(np.float64) - position
    if not len(near):
        return 0.0
    distance = np.maximum(np.linalg.norm(near, axis=1), NEAREST_M)
    sight = near / distance[:, None]
    along_sight = (sight @ velocity)[:, None] * sight
    across_sight = np.linalg.norm(velocity - along_sight, axis=1)
    return float(SAFETY * max(camera.fx, camera.fy) * (across_sight / distance).max())


def largest_inverse_depth(
    world: DeviceWorld, camera: Camera, trajectory: Trajectory, duration_s: float
) -> float:
    """Return the inverse depth of the nearest surface that a camera sees on its way [1/m], with a margin."""
    moments = MOMENTS if trajectory.moves or world.movers else 1
    times = np.linspace(0.0, duration_s, moments)
    world.set_instants(times)
    rays = pixel_rays(small_camera(camera))
    rotations, positions = trajectory.poses(times)
    nearest = math.inf
    for k, (rotation, position) in enumerate(zip(rotations, positions, strict=True)):
        surfaces = surfaces_at(world, rays, rotation, position, k)
        nearest = min(nearest, float(surfaces.depth.min()))
    return SAFETY / max(nearest, NEAREST_M)


def small_camera(camera: Camera) -> Camera:
    """Return a camera of the same view whose pixels are the grid of rays that measures distances."""
    scale = PROBE / camera.width
    return Camera(
        width=PROBE,
        height=max(1, round(camera.height * scale)),
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx + 0.5) * scale - 0.5,
        cy=(camera.cy + 0.5) * scale - 0.5,
    )


def movers_speed(
    world: DeviceWorld, camera: Camera, trajectory: Trajectory, t: NDArray[np.float64]
) -> NDArray[Any]:
    """Return an upper bound of the speed of all moving bodies in the image [px/s] at times [s], shape ``(n,)``."""
    focal = max(camera.fx, camera.fy)
    speeds = [body_speed(body, trajectory, focal, t) for body in world.movers]
    return np.max([np.zeros(len(t)), *speeds], axis=0)


def changes_of(world: DeviceWorld, stop: float) -> NDArray[np.float64]:
    """Return the times from 0 to ``stop`` [s] at which the motion of a body may change abruptly, increasing."""
    changes: list[NDArray[np.float64]] = [np.empty(0)]
    for body in world.movers:
        assert body.trajectory is not None
        changes.append(abrupt_changes(body.trajectory, stop))
    return np.unique(np.concatenate(changes))


def fastest_between_changes(
    world: DeviceWorld, camera: Camera, trajectory: Trajectory, start: float, stop: float
) -> float:
    """Return an upper bound of the speed of moving bodies in the image [px/s] at the abrupt changes of their motion
    from ``start`` to ``stop`` [s] and in the middle between two; 0 if there are none."""
    changes = changes_of(world, stop)
    inside = changes[changes >= start]
    if not len(inside):
        return 0.0
    middles = (inside[1:] + inside[:-1]) / 2.0
    moments = np.concatenate([inside, middles])
    return float(movers_speed(world, camera, trajectory, moments).max())


def rotation_speed(
    camera: Camera, trajectory: Trajectory, t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return an upper bound of the speed in the image [px/s] due to the camera's rotation at times [s], shape (n,)."""
    rotation, _ = trajectory.poses(t)
    rotation_after, _ = trajectory.poses(t + MOMENT_S)
    rate = turn_rate(rotation, rotation_after)
    # Distance of the furthest corner from the principal point.
    corner_x = max(camera.cx, camera.width - 1 - camera.cx)
    corner_y = max(camera.cy, camera.height - 1 - camera.cy)
    corner = math.hypot(corner_x, corner_y)
    focal = max(camera.fx, camera.fy)
    return np.asarray(rate * focal * (1.0 + (corner / focal) ** 2))


def flicker_interval_s(world: Any) -> float:
    """Return the longest time between two renderings of a world with flickering lamps [s].

    The time is infinite if no lamp flickers.
    """
    rates = [lamp.flicker_hz for lamp in world.lamps if lamp.flicker_hz and lamp.flicker_depth]
    if not rates:
        return math.inf
    return 1.0 / (FLICKER_SAMPLES * max(rates))


MOMENTS = 64
"""Number of times in a simulation at which the speed of the world's image is computed."""


@dataclass(frozen=True, slots=True)
class ImageSpeed:
    """Upper bounds of the speed at which a world's image without the prism moves [px/s]."""

    total: float
    """Speed due to all motion of the camera and the bodies [px/s]."""
    in_maps: float
    """Speed due to moving bodies and the camera's translation [px/s], which require new maps."""


def image_speed(world: DeviceWorld, simulation: SimulationValues, scene: WorldScene) -> ImageSpeed:
    """Return the largest speeds of a world's image over the duration of a simulation."""
    t = np.linspace(0.0, simulation.duration_s, MOMENTS)
    return image_speed_at(world, simulation.camera, scene.trajectory, t)


def image_speed_at(
    world: DeviceWorld, camera: Camera, trajectory: Trajectory, t: NDArray[np.float64]
) -> ImageSpeed:
    """Return the largest speeds of a world's image at times [s], shape ``(n,)``."""
    world.set_instants(t)
    speed = movers_speed(world, camera, trajectory, t)
    others = np.zeros(len(t))
    if trajectory.moves:
        for k, moment in enumerate(t.tolist()):
            others[k] = parallax_speed(world, camera, trajectory, moment, k)
    speed += others
    turning = rotation_speed(camera, trajectory, t)
    total = speed + turning
    # Motion between keys may lie between the given times.
    fastest = fastest_between_changes(world, camera, trajectory, float(t.min()), float(t.max()))
    largest_total = max(total.max(), fastest + (others + turning).max() if fastest else 0.0)
    largest = max(speed.max(), fastest + others.max() if fastest else 0.0)
    return ImageSpeed(float(largest_total), float(largest))
