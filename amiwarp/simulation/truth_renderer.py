"""Ground truth of a simulated world at an instant: depth, normals, instances, optical flow and luminance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import inside_image
from amiwarp.events.truth import OUTSIDE, FrameTruth
from amiwarp.optics.models.angles import wrap_angle
from amiwarp.optics.models.plate import PlateModel
from amiwarp.schema.calls import guarded
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.engine import steps_of
from amiwarp.simulation.motion import Moved
from amiwarp.simulation.view import mirrored, prism_view_of
from amiwarp.simulation.worlds.device_world import device_world
from amiwarp.simulation.worlds.sight import WorldSight
from amiwarp.simulation.worlds.surfaces import SurfaceView, pixel_rays, surfaces_at
from amiwarp.simulation.worlds.trajectory import poses_near
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.validation import whole

ANGLE = 1e-3
"""Half of the angle over which derivatives with respect to direction are difference quotients [rad]."""
DEFLECTING_STEPS = 4
"""Number of steps of the fixed-point iteration that finds the pixel that sees a point through a plate."""
NEARER = 1e-3
"""Relative difference of depth from which a surface hides a point."""
MOMENT_S = 1e-4
"""Time between the moments whose difference quotient is the optical flow [s]."""


def rate_of_change(
    value_at: Callable[[float], NDArray[np.float64]], t: float, duration_s: float
) -> NDArray[np.float64]:
    """Return the rate at which a value changes at the time ``t`` [s], from its values at two or three moments.

    ``value_at`` returns the value at a moment [s]. All moments lie within the recording, because cameras, bodies and
    optics may rest before and after it. At its ends the rate is the slope of the parabola through three moments on one
    side, elsewhere the central difference quotient.
    """
    step = min(MOMENT_S, duration_s / 2.0)
    centre = t
    if 0.0 <= t <= duration_s:
        centre = min(max(t, step), duration_s - step)
    after_t = (centre - t) + step * np.array([-1.0, 0.0, 1.0])

    # The weights of all three moments sum to 0. So only changes since the first moment count, and a value that does
    # not change has no rate, not even a rounding error.
    first = value_at(t + float(after_t[0]))
    rate = np.zeros_like(first)
    for k in (1, 2):
        others = np.delete(after_t, k)
        weight = float(-others.sum() / np.prod(after_t[k] - others))
        if weight:
            rate += weight * (value_at(t + float(after_t[k])) - first)
    return rate


@guarded
class TruthRenderer:
    """Renders the ground truth of a simulated world at any instant.

    Parameters
    ----------
    simulation : Simulation
        Simulation whose scene is a :class:`amiwarp.WorldScene`.

    Raises
    ------
    AmiwarpError
        If the scene of the simulation is a picture.

    Examples
    --------
    >>> square = amiwarp.Mesh([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> world = amiwarp.World("example", (amiwarp.Body("wall", square),))
    >>> way = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    >>> simulation = amiwarp.Simulation(
    ...     amiwarp.WorldScene(world, way), amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.01), duration_s=0.01)
    >>> round(float(amiwarp.TruthRenderer(simulation).at(0).depth[12, 16]), 3)
    2.0
    """

    def __init__(self, simulation: SimulationValues) -> None:
        if not isinstance(simulation.scene, WorldScene):
            raise AmiwarpError(
                "the scene is a picture at infinity, which has no depth; give a WorldScene as the scene"
            )
        self._simulation = simulation
        self._scene = simulation.scene
        self._world = device_world(self._scene.world, simulation.device)
        self._sight = WorldSight(simulation, self._scene, self._world)
        self._sight_at_rest = self._sight
        if isinstance(simulation.prism, Moved):
            self._sight_at_rest = WorldSight(simulation.at_rest, self._scene, self._world)
        self._rays = pixel_rays(simulation.camera)
        self._pixels = simulation.camera.rays_to_pixels(self._rays)

    def at(self, t_us: int, next_us: int | None = None, before_us: int | None = None) -> FrameTruth:
        """Return the ground truth of all pixels at a time.

        Parameters
        ----------
        t_us : int
            Time from the start of the recording [us].
        next_us : int, optional
            Time of the next instant [us], to which displacements and occlusion refer. Without it, they are unknown.
        before_us : int, optional
            Time of the instant before [us], to which backward displacements and occlusion refer. Without it, they are
            unknown.

        Returns
        -------
        FrameTruth
            Depth, normals, instances, optical flow, displacement and luminance of all pixels, the pose of the camera,
            and the positions of the joints.
        """
        t = t_us * 1e-6
        camera = self._simulation.camera
        (rotation,), (position,) = self._poses([t])

        # What each pixel sees without the prism, and through the prism or the plate.
        self._world.set_instants(np.array([t]))
        bare, pixels = self._seen(t_us, prism=False)
        flow = self._flow(bare, pixels, t)
        through, places = self._seen(t_us, prism=True)
        if self._simulation.plate is None:
            speed = self._flow(through, places, t)
            prism_flow = self._prism_flow(places, speed, t_us)
        else:
            prism_flow = self._plate_flow(self._simulation.plate, through, places, t)

        moved, occluded = self._moved(bare, pixels, t_us, next_us, prism=False)
        back, back_occluded = self._moved(bare, pixels, t_us, before_us, prism=False)
        prism_moved, prism_occluded = self._moved(through, places, t_us, next_us, prism=True)
        prism_back, prism_back_occluded = self._moved(through, places, t_us, before_us, prism=True)

        size = (camera.height, camera.width)
        joints = self._scene.world.joints
        return FrameTruth(
            t_us=t_us,
            depth=bare.depth.reshape(size),
            normal=bare.normal.reshape(*size, 3),
            instance=bare.instance.reshape(size).astype(np.uint16),
            flow=flow.astype(np.float32).reshape(*size, 2),
            flow_with_prism=prism_flow.astype(np.float32).reshape(*size, 2),
            displacement=moved,
            displacement_with_prism=prism_moved,
            occlusion=occluded,
            occlusion_with_prism=prism_occluded,
            backward=back,
            backward_with_prism=prism_back,
            backward_occlusion=back_occluded,
            backward_occlusion_with_prism=prism_back_occluded,
            intensity=self.luminance(t_us),
            intensity_with_prism=self._intensity(t_us, prism=True).reshape(size),
            rotation=rotation @ mirrored(self._simulation).T,
            position=position,
            joints={name: path.poses([t])[1][0] for name, path in joints.items()},
        )

    def displacement(
        self, t0_us: int, t1_us: int, *, with_prism: bool = False
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return how the points that the pixels see at one time move until another time, before or after it.

        Parameters
        ----------
        t0_us : int
            Time at which the pixels see the points [us], from 0 to the end of the recording.
        t1_us : int
            Time to which the points move [us], from 0 to the end of the recording.
        with_prism : bool, default False
            Whether the pixels see the points through the prism, at its angles of both times.

        Returns
        -------
        displacement : numpy.ndarray
            Displacement (x, y) in the image [px], shape ``(height, width, 2)``; NaN where a point cannot be projected.
        occlusion : numpy.ndarray
            0 for points that are visible at ``t1_us``, 1 for points that another surface hides, 2 for points outside
            the image, shape ``(height, width)``.

        Raises
        ------
        AmiwarpError
            If a time lies outside the recording.

        Examples
        --------
        >>> square = amiwarp.Mesh([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], [[0, 1, 2], [0, 2, 3]])
        >>> world = amiwarp.World("example", (amiwarp.Body("wall", square),))
        >>> ahead = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0]).rotation
        >>> way = amiwarp.Trajectory([0.0, 0.01], [[0, 0, 0], [0.02, 0, 0]], [ahead[0], ahead[0]])
        >>> camera = amiwarp.Camera.from_fov(32, 24, 1.0)
        >>> simulation = amiwarp.Simulation(
        ...     amiwarp.WorldScene(world, way), camera, amiwarp.Prism(0.01), duration_s=0.01)
        >>> moved, occlusion = amiwarp.TruthRenderer(simulation).displacement(0, 10_000)
        >>> bool(abs(moved[12, 16, 0] + camera.fx * 0.02 / 2.0) < 1e-3)
        True
        """
        duration_us = self._simulation.duration_us
        t0_us = whole(t0_us, "t0_us", 0, duration_us, " us")
        t1_us = whole(t1_us, "t1_us", 0, duration_us, " us")
        self._world.set_instants(np.array([t0_us * 1e-6]))
        surfaces, places = self._seen(t0_us, prism=with_prism)
        return self._moved(surfaces, places, t0_us, t1_us, prism=with_prism)

    def luminance(self, t_us: int) -> NDArray[np.float32]:
        """Return the linear luminance without the prism at a time, which takes a fraction of the time of :meth:`at`.

        Parameters
        ----------
        t_us : int
            Time from the start of the recording [us].

        Returns
        -------
        numpy.ndarray
            Luminance of all pixels, shape ``(height, width)``.
        """
        camera = self._simulation.camera
        return self._intensity(t_us, prism=False).reshape(camera.height, camera.width)

    def _poses(self, t: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return how directions of the camera at rest look in the world at times [s], (n, 3, 3), and its places."""
        rotation, position = self._scene.trajectory.poses(t)
        return rotation @ mirrored(self._simulation), position

    def _seen(self, t_us: int, *, prism: bool) -> tuple[SurfaceView, NDArray[np.float64]]:
        """Return the surfaces that the pixels see at a time, and where these appear without the prism [px], (n, 2).

        The world shows its first instant, which is this time.
        """
        t = t_us * 1e-6
        (rotation,), (position,) = self._poses([t])
        if not prism:
            return surfaces_at(self._world, self._rays, rotation, position), self._pixels
        if self._simulation.plate is not None:
            return self._through_plate(t, rotation, position)
        model = self._simulation.moving_model
        places = model.compensate_points(self._pixels, self._angles(t_us))
        rays = self._simulation.camera.pixels_to_rays(places)
        return surfaces_at(self._world, rays, rotation, position), places

    def _flow(
        self, surfaces: SurfaceView, pixels: NDArray[np.float64], t: float
    ) -> NDArray[np.float64]:
        """Return the optical flow [px/s] of the points that pixels see at time ``t`` [s], shape (n, 2).

        ``surfaces``: surfaces that appear at ``pixels`` [px] in the image without the prism.
        """

        def ray_at(later: float) -> NDArray[np.float64]:
            rays, _ = self._ray_at(surfaces, pixels, t, later, smooth=True)
            return rays

        change = rate_of_change(ray_at, t, self._simulation.duration_s)
        rate = np.linalg.norm(change, axis=1, keepdims=True)

        # The same small angle to both sides for all points, however slowly they move.
        aside = ANGLE * change / np.maximum(rate, 1e-12)
        camera = self._simulation.camera
        rays = camera.pixels_to_rays(pixels).astype(np.float64)
        before = camera.rays_to_pixels(rays - aside).astype(np.float64)
        after = camera.rays_to_pixels(rays + aside).astype(np.float64)
        return np.asarray((after - before) / (2.0 * ANGLE) * rate)

    def _ray_at(
        self,
        surfaces: SurfaceView,
        pixels: NDArray[np.float64],
        t: float,
        later: float,
        *,
        smooth: bool = False,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return unit rays from the camera at time ``later`` [s] to the points that pixels see at time ``t`` [s].

        The rays are in the camera's frame, shape (n, 3). The second array has the depths of the points [m], shape (n,).
        ``smooth``: whether bodies move on from ``t`` as if no abrupt change of their motion came between.
        """
        (rotation, later_rotation), (position, later_position) = self._poses([t, later])
        rays = self._simulation.camera.pixels_to_rays(pixels).astype(np.float64)
        distance = surfaces.depth.astype(np.float64) / rays[:, 2]
        sky = ~np.isfinite(distance)
        reach = np.where(sky, 1.0, distance)[:, None]
        points = position + reach * (rays @ rotation.T)

        # Points on moving bodies move with these.
        for k, body in enumerate(self._world.movers):
            on_body = (surfaces.mover == k) & ~sky
            if body.trajectory is not None and on_body.any():
                near = [t, t] if smooth else [t, later]
                turns, places = poses_near(body.trajectory, near, [t, later])
                turn, later_turn = turns
                place, later_place = places
                in_body = (points[on_body] - place) @ turn
                points[on_body] = in_body @ later_turn.T + later_place

        # The sky is at infinity: it does not see that the camera moves.
        from_camera = np.where(sky[:, None], points - position, points - later_position)
        directions = from_camera @ later_rotation
        depth = np.where(sky, np.inf, directions[:, 2])
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        return directions / length, depth

    def _angles(self, t_us: int) -> NDArray[np.float64]:
        """Return the prism angle of all pixels at a time [rad], shape (n,), or (n, 2) for two prisms."""
        angles = wrap_angle(self._simulation.prism_motion.angles([t_us]))
        return np.repeat(angles, len(self._rays), axis=0)

    def _moved(
        self,
        surfaces: SurfaceView,
        places: NDArray[np.float64],
        t_us: int,
        other_us: int | None,
        *,
        prism: bool,
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return the displacement of what the pixels see until ``other_us`` [px], shape (height, width, 2).

        The second array has its occlusion, shape (height, width). ``surfaces``: surfaces that appear at ``places`` [px]
        in the image without the prism; ``prism``: whether the pixels see them through the prism. The world then shows
        the other time.
        """
        camera = self._simulation.camera
        shape = (camera.height, camera.width)
        if other_us is None:
            return np.full((*shape, 2), np.nan, np.float32), np.full(shape, OUTSIDE, np.uint8)
        later = other_us * 1e-6
        plate = self._simulation.plate if prism else None

        # Pixels that will see the points, and the rays that will lead there.
        centres = None
        rays, depth = self._ray_at(surfaces, places, t_us * 1e-6, later)
        ends = camera.rays_to_pixels(rays)
        if plate is not None:
            ends = self._plate_pixels(plate, rays, depth, later)
            known = np.isfinite(ends).all(axis=1, keepdims=True)
            rays = np.where(known, camera.pixels_to_rays(ends), self._rays)
            centres, behind = self._behind_plate(rays, later)
            rays = behind.astype(np.float64)
        elif prism:
            ends = self._simulation.moving_model.deflect_points(ends, self._angles(other_us))

        # A point is hidden if something nearer will lie on its ray.
        (rotation,), (position,) = self._poses([later])
        self._world.set_instants(np.array([later]))
        hit = surfaces_at(self._world, rays, rotation, position, centres=centres)
        hidden = hit.depth < depth * (1.0 - NEARER)
        inside = inside_image(ends[:, 0], ends[:, 1], camera.width, camera.height)
        occlusion = np.where(inside, hidden, OUTSIDE).astype(np.uint8)
        moved = (ends - self._pixels).astype(np.float32)
        return moved.reshape(*shape, 2), occlusion.reshape(shape)

    def _prism_flow(
        self, places: NDArray[np.float64], speed: NDArray[np.float64], t_us: int
    ) -> NDArray[np.float64]:
        """Return the optical flow [px/s] that pixels see through the turning prism, shape (n, 2).

        ``places``: points [px] that the pixels would see without the prism; ``speed``: the flow at these points without
        the prism [px/s].
        """
        model = self._simulation.moving_model
        theta = self._angles(t_us)
        # What the scene moves, seen through the prism at rest: one pixel to both sides along the motion.
        size = np.linalg.norm(speed, axis=1, keepdims=True)
        aside = speed / np.maximum(size, 1e-9)
        before = model.deflect_points(places - aside, theta)
        after = model.deflect_points(places + aside, theta)
        flow = (after - before) / 2.0 * size

        # What each angle of the prism moves.
        motion = self._simulation.prism_motion

        def angles_at(t: float) -> NDArray[np.float64]:
            return motion.angles([1e6 * t])[0]

        rates = np.atleast_1d(rate_of_change(angles_at, t_us * 1e-6, self._simulation.duration_s))
        for rate, only_this in zip(rates, np.eye(len(rates)), strict=True):
            step = ANGLE * only_this if len(rates) > 1 else ANGLE
            before = model.deflect_points(places, theta - 10.0 * step)
            after = model.deflect_points(places, theta + 10.0 * step)
            flow = flow + (after - before) / (20.0 * ANGLE) * rate
        return np.asarray(flow)

    def _through_plate(
        self, t: float, rotation: NDArray[np.float64], position: NDArray[np.float64]
    ) -> tuple[SurfaceView, NDArray[np.float64]]:
        """Return the surfaces that the pixels see through the turning plate at time ``t`` [s], and where they appear
        without it [px], shape (n, 2)."""
        centres, rays = self._behind_plate(self._rays, t)
        surfaces = surfaces_at(self._world, rays, rotation, position, centres=centres)
        # The sky appears where the rays point to.
        is_surface = np.isfinite(surfaces.depth)[:, None]
        from_camera = (surfaces.place - position) @ rotation
        directions = np.where(is_surface, from_camera, rays)
        return surfaces, self._simulation.camera.rays_to_pixels(directions)

    def _behind_plate(
        self, rays: NDArray[np.float64], t: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where rays of the camera begin through the plate at time ``t`` [s], and their directions there.

        Places [m] and directions have the shape (n, 3).
        """
        motion = self._simulation.prism_motion
        azimuth = motion.phase + float(motion.angle([t * 1e6])[0])
        return self._sight.through_plate(rays, azimuth)

    def _plate_pixels(
        self, model: PlateModel, rays: NDArray[np.float64], depth: NDArray[np.float64], later: float
    ) -> NDArray[np.float64]:
        """Return the pixels that see points through the plate at time ``later`` [s], shape (n, 2).

        ``rays``, ``depth``: directions and depths [m] of the points from the camera at this time.
        """
        (angle,) = self._simulation.prism_motion.angle([later * 1e6])
        theta = np.full(len(rays), float(angle))
        without_plate = self._simulation.camera.rays_to_pixels(rays)
        inverse_depth = 1.0 / depth
        observed = self._pixels
        for _ in range(DEFLECTING_STEPS):
            compensated = model.compensate_at(observed, theta, inverse_depth)
            observed = observed - (compensated - without_plate)
        return observed

    def _plate_flow(
        self, model: PlateModel, surfaces: SurfaceView, places: NDArray[np.float64], t: float
    ) -> NDArray[np.float64]:
        """Return the optical flow [px/s] that the pixels see through the turning plate at time ``t`` [s], (n, 2).

        ``surfaces``, ``places``: from :meth:`_through_plate`.
        """

        def pixels_at(later: float) -> NDArray[np.float64]:
            rays, depth = self._ray_at(surfaces, places, t, later)
            return self._plate_pixels(model, rays, depth, later)

        return rate_of_change(pixels_at, t, self._simulation.duration_s)

    def _intensity(self, t_us: int, *, prism: bool) -> NDArray[np.float32]:
        """Return the luminance of all pixels at a time, through the prism or without the prism, shape (n,)."""
        device = self._world.device
        simulation = self._simulation if prism else self._simulation.at_rest
        sight = self._sight if prism else self._sight_at_rest
        # Both may be the same, so that the plate is put in or taken out each time.
        sight.set_plate(self._simulation.plate if prism else None)
        instant = np.array([float(t_us)])
        sight.set_instants(instant, prism_view_of(simulation, device))
        steps = steps_of(simulation, instant, device)
        return np.array(sight.light(steps, 0, 1).numpy()[0])
