"""Event cameras in Newton: its camera sensor casts the rays that an optic makes of each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import scene_rays
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.schema.calls import guarded
from amiwarp.sensors.event_camera import EventCamera
from amiwarp.sensors.rays import Rays
from amiwarp.sensors.renderer import Renderer, Surfaces
from amiwarp.sensors.versions import simulator
from amiwarp.validation import array, finite, whole


@dataclass(frozen=True, eq=False)
class NewtonScene:
    """What the pictures of a state of Newton need."""

    body_q: Any
    """Places of the bodies, Warp array of transforms."""
    particle_q: Any
    """Places of the particles, Warp array of vec3; None if there are none."""


@guarded
class NewtonRenderer(Renderer):
    """Renderer of :class:`NewtonEventCamera`: pictures by Newton's camera sensor.

    Parameters
    ----------
    model : newton.Model
        The model.
    body : array_like
        Row of the body that carries each camera, -1 for none, shape (cameras,).
    pose : array_like
        Pose of each camera in the frame of its body, or in the world without one, shape (cameras, 7).
    world : array_like
        Number of the world that each camera sees, shape (cameras,).
    """

    AXES: ClassVar[tuple[int, int, int]] = (1, -1, -1)

    def __init__(self, model: Any, body: ArrayLike, pose: ArrayLike, world: ArrayLike) -> None:
        newton = simulator("newton")
        places = np.asarray(pose, np.float32).reshape(-1, 7)
        super().__init__(len(places), model.device)
        self._model = model
        self._body = wp.array(np.asarray(body, np.int32), dtype=int, device=self.device)
        self._pose = wp.array(places, dtype=wp.transform, device=self.device)
        self._world = wp.array(np.asarray(world, np.int32), dtype=int, device=self.device)
        camera = newton.sensors.SensorCamera
        self.sensor = camera(model)
        """Newton's camera sensor, whose lights may be set."""
        self.sensor.create_default_light(enable_shadows=False)
        self.config = camera.RenderConfig(enable_textures=True)
        """Newton's settings of the pictures. The number of rays of a pixel sets ``anti_aliasing``."""
        self._modes = camera.AntiAliasing
        self._drawn = model.state()
        self._mounted = wp.empty_like(self._pose)
        self._graphs: dict[tuple[int, ...], Any] = {}
        self._colours: wp.array | None = None
        self._no_shape = int(camera.ClearData().clear_shape_index)

    def snapshot(self, state: Any) -> NewtonScene:
        """Return a copy of the places of bodies and particles.

        Parameters
        ----------
        state : newton.State
            The state.

        Returns
        -------
        object
            The copy.
        """
        bodies = wp.empty(0, dtype=wp.transform, device=self.device)
        if state.body_q is not None:
            bodies = wp.clone(state.body_q)
        particles = None if state.particle_q is None else wp.clone(state.particle_q)
        return NewtonScene(bodies, particles)

    def between(self, before: NewtonScene, after: NewtonScene, fraction: float) -> NewtonScene:
        """Return the scene between two, and prepare the sensor for it.

        Parameters
        ----------
        before, after : object
            Scenes of :meth:`snapshot`.
        fraction : float
            Place in time between both, 0 to 1.

        Returns
        -------
        object
            The scene, which the next one replaces.
        """
        drawn = self._drawn
        count = len(after.body_q)
        inputs = [before.body_q, after.body_q, fraction]
        if count:
            launch(scene_rays.blend_frames, count, inputs, [drawn.body_q], device=self.device)
        if after.particle_q is not None:
            points = [before.particle_q, after.particle_q, fraction]
            launch(
                scene_rays.blend_points,
                len(after.particle_q),
                points,
                [drawn.particle_q],
                device=self.device,
            )
            self._model.bvh_refit_particles(drawn)
        self._model.bvh_refit_shapes(drawn)
        bodies = drawn.body_q if count else after.body_q
        return NewtonScene(bodies, drawn.particle_q)

    def cameras_at(self, scene: NewtonScene) -> Any:
        """Return the places of the cameras.

        Parameters
        ----------
        scene : object
            The scene.

        Returns
        -------
        warp.array
            Transforms from Newton's camera frame, x right, y up and -z ahead, to the world, shape (cameras,).
        """
        found = wp.empty_like(self._pose)
        inputs = [scene.body_q, self._body, self._pose]
        launch(scene_rays.mount_cameras, self.cameras, inputs, [found], device=self.device)
        return found

    def bodies(self, scene: NewtonScene) -> Any:
        """Return the places of the bodies.

        Parameters
        ----------
        scene : object
            The scene.

        Returns
        -------
        warp.array
            Transforms from the frame of each body to the world, shape (bodies,).
        """
        return scene.body_q

    def luminance(self, scene: NewtonScene, rays: Rays) -> Any:
        """Return what the rays see, as linear red, green and blue.

        Parameters
        ----------
        scene : object
            The scene of the last call of :meth:`between`, or one without it.
        rays : Rays
            Rays of all cameras.

        Returns
        -------
        warp.array
            Newton's linear (HDR) colours, vec3, shape (cameras, height, width), which the next call replaces.
        """
        height, width = rays.values.shape[0] // rays.bundles, rays.values.shape[1]
        if self._colours is None:
            self._colours = wp.empty(
                (self.cameras, height, width), dtype=wp.vec3, device=self.device
            )
        self._render(scene, rays, hdr_color_image=self._colours)
        return self._colours

    def surfaces(self, scene: NewtonScene, rays: Rays) -> Surfaces:
        """Return what the rays hit.

        Parameters
        ----------
        scene : object
            The scene of the last call of :meth:`between`.
        rays : Rays
            Rays of all cameras, one for each pixel.

        Returns
        -------
        Surfaces
            What they hit: the numbers of Newton's shapes and the rows of their bodies.
        """
        shape = (self.cameras, rays.values.shape[0] // rays.bundles, rays.values.shape[1])
        distance = wp.empty(shape, dtype=float, device=self.device)
        hit = wp.empty(shape, dtype=wp.uint32, device=self.device)
        self._render(scene, rays, depth_image=distance, shape_index_image=hit)
        body = wp.empty(shape, dtype=int, device=self.device)
        number = wp.empty(shape, dtype=int, device=self.device)
        bodies = self._model.shape_body
        if bodies is None:
            bodies = wp.empty(0, dtype=int, device=self.device)
        launch(
            scene_rays.name_surfaces,
            hit.size,
            [hit.flatten(), bodies],
            [number.flatten(), body.flatten()],
            device=self.device,
        )
        return Surfaces(distance, body, number)

    def _render(self, scene: NewtonScene, rays: Rays, **images: Any) -> None:
        """Draw images of all cameras: in one call if they share their rays, else one after the other."""
        self._prepare(scene)
        several = rays.samples > 1
        self.config.anti_aliasing = self._modes.SSAA if several else self._modes.NONE
        wp.copy(self._mounted, self.cameras_at(scene))
        if rays.bundles == 1:
            self._draw(slice(0, self.cameras), rays, images)
            return
        # A launch for each camera, which CUDA records the first time and later repeats at once
        key = (rays.values.ptr, *(image.ptr for image in images.values()))
        if key in self._graphs and self.device.is_cuda:
            wp.capture_launch(self._graphs[key])
            return
        for k in range(self.cameras):
            self._draw(slice(k, k + 1), rays, images)
        if self.device.is_cuda:
            with wp.ScopedCapture(self.device, force_module_load=False) as capture:
                for k in range(self.cameras):
                    self._draw(slice(k, k + 1), rays, images)
            self._graphs = {key: capture.graph}

    def _draw(self, views: slice, rays: Rays, images: dict[str, Any]) -> None:
        """Draw images of successive cameras by the rays of the first one."""
        self.sensor.update(
            self._drawn,
            self._mounted[views],
            rays.bundle(views.start),
            world_indices=self._world[views],
            render_config=self.config,
            **{name: image[views] for name, image in images.items()},
        )

    def _prepare(self, scene: NewtonScene) -> None:
        """Take the scene of a snapshot into the state that is drawn."""
        if scene.body_q is not self._drawn.body_q and len(scene.body_q):
            self.between(scene, scene, 1.0)


@guarded
class NewtonEventCamera(EventCamera):
    """Event cameras in a model of Newton, each of which looks through an optic at its own angle, or through none.

    Rays of each pixel through the optic are made on the model's device, and Newton's camera sensor casts them: what is
    seen is exact for every optic that bends rays or shifts them, at any depth.

    Parameters
    ----------
    model : newton.Model
        The finalized model.
    camera : Camera
        Intrinsics of all cameras.
    optic : Model, optional
        What each camera looks through; by default nothing.
    body : str or int or sequence of int, optional
        Body that carries each camera: its row, or the end of its label, which is looked for in each world. By default
        the cameras stand still in the world.
    pose : array_like, optional
        Pose of the camera in the frame of its body, or in the world without one: position [m] and quaternion x, y, z,
        w, shape (7,) or (cameras, 7). A camera looks along -z, y is up, as in Newton.
    worlds : int or sequence of int, optional
        Number of cameras, one in each of the first worlds, or the world of each camera. By default one camera in each
        world.
    **options
        Keywords of :class:`EventCamera`: ``motion``, ``start``, ``sensor``, ``seed``, ``rays_per_pixel`` and
        ``pictures``.

    Raises
    ------
    AmiwarpError
        If Newton is not installed, a body or world does not exist, or as for :class:`EventCamera`.

    Notes
    -----
    Light is Newton's linear (HDR) image. The default light has no shadows; ``eyes.renderer.sensor`` and
    ``eyes.renderer.config`` set light, shadows and textures. What no ray hits is black.

    Examples
    --------
    >>> eyes = amiwarp.sensors.NewtonEventCamera(model, camera, optic, body="camera_mount")  # doctest: +SKIP
    """

    renderer: NewtonRenderer

    def __init__(
        self,
        model: Any,
        camera: Camera,
        optic: Model | None = None,
        *,
        body: str | int | Sequence[int] | NDArray[np.integer[Any]] | None = None,
        pose: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        worlds: int | Sequence[int] | NDArray[np.integer[Any]] | None = None,
        **options: Any,
    ) -> None:
        rows, numbers = _places(model, body, worlds)
        poses = finite(array(pose, "pose"), "pose").astype(np.float64)
        if poses.shape not in ((7,), (len(numbers), 7)):
            raise AmiwarpError(
                f"pose has shape {poses.shape}; expected (7,) or ({len(numbers)}, 7): position and quaternion x, y, z, "
                "w of each camera"
            )
        length = np.linalg.norm(poses[..., 3:], axis=-1)
        if not (np.abs(length - 1.0) < 1e-3).all():
            raise AmiwarpError(
                f"the quaternion of pose has length {float(np.min(length)):.4g}; expected 1, as x, y, z, w"
            )
        poses = np.broadcast_to(poses, (len(numbers), 7))
        super().__init__(NewtonRenderer(model, rows, poses, numbers), camera, optic, **options)


def _places(model: Any, body: Any, worlds: Any) -> tuple[list[int], list[int]]:
    """Return the row of the body of each camera, -1 without one, and the world that it sees."""
    count = int(model.world_count)
    if worlds is None or isinstance(worlds, int):
        most = count if worlds is None else whole(worlds, "worlds", 1, count)
        chosen = list(range(most))
    else:
        chosen = [whole(k, "worlds", 0, count - 1) for k in np.asarray(worlds).tolist()]
    if body is None:
        return [-1] * len(chosen), chosen
    if isinstance(body, str):
        return [_body_of(model, body, world) for world in chosen], chosen
    rows = np.atleast_1d(np.asarray(body)).tolist()
    rows = [whole(row, "body", -1, int(model.body_count) - 1) for row in rows]
    if worlds is None:
        of_body = model.body_world.numpy() if model.body_count else np.zeros(0, int)
        chosen = [max(int(of_body[row]), 0) if row >= 0 else 0 for row in rows]
    elif len(rows) != len(chosen):
        raise AmiwarpError(f"body has {len(rows)} entries for {len(chosen)} cameras; give one each")
    return rows, chosen


def _body_of(model: Any, label: str, world: int) -> int:
    """Return the row of the one body of a world whose label ends so."""
    of_body = model.body_world.numpy()
    found = [
        row
        for row, name in enumerate(model.body_label)
        if (name == label or name.endswith(f"/{label}")) and int(of_body[row]) in (world, -1)
    ]
    if len(found) != 1:
        known = sorted({name.rpartition("/")[2] for name in model.body_label})[:8]
        raise AmiwarpError(
            f"{len(found)} bodies of world {world} have the label {label!r}; expected one; some labels are "
            f"{', '.join(known) or 'none'}"
        )
    return found[0]
