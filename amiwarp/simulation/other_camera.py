"""Ground truth in another camera: where it sees the points that events saw, and their disparity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import inside_image
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.schema.calls import guarded
from amiwarp.simulation.kernels.visible_surfaces import find_hidden
from amiwarp.simulation.truth_renderer import NEARER
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.surfaces import SMALLEST_LAUNCH
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World
from amiwarp.validation import array, as_times, real

TOGETHER = 1 << 16
"""Number of points that are tested together, each at an instant of its own."""
SAME_PX = 1e-6
"""Largest difference of the focal lengths and of the rows of a rectified pair [px]."""


@guarded
@dataclass(frozen=True, eq=False)
class PlacesInCamera:
    """Where a camera without a prism sees points of the world, each at its own time.

    Examples
    --------
    >>> import numpy as np
    >>> seen = amiwarp.PlacesInCamera(np.array([[3.0, 4.0]]), depth=np.array([2.0]), visible=np.array([True]))
    >>> seen.points[seen.visible].tolist()
    [[3.0, 4.0]]
    """

    points: NDArray[np.float64]
    """Pixels, also outside the image [px], shape ``(n, 2)``; NaN behind the camera, and for places that are NaN."""
    depth: NDArray[np.float64]
    """Depths along the camera's optical axis [m], shape ``(n,)``; NaN for places that are NaN."""
    visible: NDArray[np.bool_]
    """Whether a point lies in the image and, if the world was given, no surface hides it, shape ``(n,)``."""


@guarded
def places_in(
    places: ArrayLike,
    t_us: ArrayLike,
    camera: Camera,
    trajectory: Trajectory,
    *,
    world: World | None = None,
    device: str = "cpu",
) -> PlacesInCamera:
    """Return where a camera sees points of the world, such as the points that the events of another camera saw.

    Parameters
    ----------
    places : array_like
        Points in the world [m], shape ``(n, 3)``, such as :attr:`EventTruth.place`; NaN for the sky.
    t_us : array_like
        Time at which each point is looked at [us], shape ``(n,)``, such as the times of the events.
    camera : Camera
        The camera that looks.
    trajectory : Trajectory
        Pose of this camera over time.
    world : World, optional
        The world, whose surfaces may hide points. Without it, all points in the image count as visible.
    device : str, optional
        Device that casts the rays into the world.

    Returns
    -------
    PlacesInCamera
        Pixel, depth and visibility of each point.

    Raises
    ------
    AmiwarpError
        If the arrays have other shapes, or a time is no whole number.

    Notes
    -----
    The place of an event holds at the moment at which its pixel crossed the threshold. The event is later by the
    latency of the sensor, in which a body that moves leaves the place.

    Examples
    --------
    >>> camera = amiwarp.Camera.from_fov(32, 24, 1.0)
    >>> right = amiwarp.Trajectory.still([0.1, 0, 0], look_at=[0.1, 1, 0])
    >>> seen = amiwarp.places_in([[0.1, 2.0, 0.0], [0.1, -2.0, 0.0]], [0, 0], camera, right)
    >>> seen.points.tolist(), seen.visible.tolist()
    ([[15.5, 11.5], [nan, nan]], [True, False])
    """
    in_world = array(places, "places").astype(np.float64)
    times = as_times(t_us, "t_us")
    if times.ndim != 1 or in_world.shape != (len(times), 3):
        raise AmiwarpError(
            f"places have shape {in_world.shape}, t_us {times.shape}; give (n, 3) and (n,)"
        )
    if not len(times):
        return PlacesInCamera(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.bool_))

    rotation, position = trajectory.poses(times * 1e-6)
    rays = np.einsum("ni,nij->nj", in_world - position, rotation)
    points = np.asarray(camera.rays_to_pixels(rays), np.float64)
    visible = inside_image(points[:, 0], points[:, 1], camera.width, camera.height)
    if world is not None:
        inside = np.flatnonzero(visible)
        hidden = _hidden(
            DeviceWorld(world, device), position[inside], in_world[inside], times[inside]
        )
        visible[inside] = ~hidden
    return PlacesInCamera(points, rays[:, 2].copy(), visible)


def _hidden(
    world: DeviceWorld,
    starts: NDArray[np.float64],
    places: NDArray[np.float64],
    t_us: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Return whether a surface of a world lies between two points [m], shape (n, 3) each, at a time [us], (n,)."""
    hidden = np.zeros(len(t_us), np.bool_)
    for first in range(0, len(t_us), TOGETHER):
        part = slice(first, first + TOGETHER)
        instants, instant = np.unique(t_us[part], return_inverse=True)
        world.set_instants(np.asarray(1e-6 * instants, np.float64))
        device = world.device
        inputs = [
            world.params,
            wp.array(starts[part].astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(places[part].astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(instant.astype(np.int32), dtype=int, device=device),
            1.0 - NEARER,
        ]
        found = wp.empty(len(instant), dtype=wp.uint8, device=device)
        launch(find_hidden, len(instant), inputs, [found], device=device, smallest=SMALLEST_LAUNCH)
        hidden[part] = found.numpy() != 0
    return hidden


@guarded
def disparity(
    depth: ArrayLike, left: Camera, right: Camera, baseline_m: float
) -> NDArray[np.float64]:
    """Return the disparity of surfaces in a rectified pair of cameras: their column in the left image less the right.

    Parameters
    ----------
    depth : array_like
        Depths in the left camera [m], of any shape, such as :attr:`FrameTruth.depth` or :attr:`EventTruth.depth`;
        infinite for the sky.
    left, right : Camera
        The cameras, without distortion, with equal focal lengths and the same row of the principal point.
    baseline_m : float
        Distance of the right camera from the left one along the x axis, which they share [m], 1e-6 to 1000.

    Returns
    -------
    ndarray
        Disparities [px], in the shape of ``depth``; NaN where the depth is not positive.

    Raises
    ------
    AmiwarpError
        If the cameras are no rectified pair, or the baseline is out of range.

    Notes
    -----
    The disparity is fx b / z + cx_left - cx_right, with the baseline b and the depth z: R. Hartley and A. Zisserman,
    "Multiple View Geometry in Computer Vision", 2004, section 9.

    Examples
    --------
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)
    >>> amiwarp.disparity([[1.0, 2.0, float("inf")]], camera, camera, baseline_m=0.1).tolist()
    [[50.0, 25.0, 0.0]]
    """
    baseline_m = real(baseline_m, "baseline_m", 1e-6, 1e3, " m")
    for name in ("fx", "fy", "cy"):
        of_left = getattr(left, name)
        of_right = getattr(right, name)
        if abs(of_left - of_right) > SAME_PX:
            raise AmiwarpError(
                f"the cameras have {name} = {of_left:g} and {of_right:g} px; give a rectified pair, "
                "whose focal lengths and cy are equal"
            )
    for name, camera in (("left", left), ("right", right)):
        if camera.distortion is not None:
            raise AmiwarpError(
                f"the {name} camera has lens distortion; give the cameras of the rectified images"
            )
    z = array(depth, "depth").astype(np.float64)
    # The disparity of a tiny depth is infinite.
    with np.errstate(divide="ignore", over="ignore"):
        shift = np.where(z > 0.0, left.fx * baseline_m / z, np.nan)
    return np.asarray(shift + (left.cx - right.cx))
