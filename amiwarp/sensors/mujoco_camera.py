"""Event cameras in MuJoCo Warp: larger views without the optic, displaced as the optic does."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import scene_rays
from amiwarp.kernels.camera import camera_params
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.plate import PlateModel
from amiwarp.schema.calls import guarded
from amiwarp.sensors.event_camera import EventCamera
from amiwarp.sensors.rays import Rays
from amiwarp.sensors.renderer import Renderer, Surfaces
from amiwarp.sensors.versions import simulator
from amiwarp.sensors.wide_view import look_up, wide_camera

SAMPLES = 2
"""Samples of MuJoCo Warp in each direction of a pixel of the larger view. With one, it rounds light to 8 bits."""
LARGEST_BYTE = 255.0
FARTHEST = 1e4
"""Depth above which what is seen counts as infinitely far [m]."""


@dataclass(frozen=True, eq=False)
class MujocoScene:
    """What the pictures of a state of MuJoCo Warp need: places in the world, world by world."""

    geoms: Any
    """Places of the geometries, Warp array of transforms, shape (worlds * geometries,)."""
    cameras: Any
    """Places of the cameras, shape (worlds * cameras of the model,)."""


@guarded
class MujocoWarpRenderer(Renderer):
    """Renderer of :class:`MujocoWarpEventCamera`: pictures by MuJoCo Warp, in which rays are looked up.

    Parameters
    ----------
    mjm : mujoco.MjModel
        The model on the host.
    model : mujoco_warp.Model
        The model on the device.
    data : mujoco_warp.Data
        Data of the worlds, whose number they give.
    name : str
        Name of the camera.
    wide : Camera
        Intrinsics of the larger view.
    """

    AXES: ClassVar[tuple[int, int, int]] = (1, -1, -1)

    def __init__(self, mjm: Any, model: Any, data: Any, name: str, wide: Camera) -> None:
        mujoco_warp = simulator("mujoco_warp")
        super().__init__(int(data.nworld), data.geom_xpos.device)
        self._library = mujoco_warp
        self._model = model
        self._wide = wide
        self._camera = _camera_number(mjm, name)
        self._geoms = int(mjm.ngeom)
        with wp.ScopedDevice(self.device):
            self._drawn = mujoco_warp.make_data(mjm, nworld=self.cameras)
            self.context = _context(mujoco_warp, mjm, self._camera, wide, self.cameras)
            """MuJoCo Warp's context of the pictures."""

    def snapshot(self, state: Any) -> MujocoScene:
        """Return a copy of the places of geometries and cameras. Lights and flexible bodies are drawn as they are now.

        Parameters
        ----------
        state : mujoco_warp.Data
            Data whose kinematics are computed, as after ``mujoco_warp.step`` or ``mujoco_warp.kinematics`` and
            ``camlight``.

        Returns
        -------
        object
            The copy.
        """
        for field in ("light_xpos", "light_xdir", "flexvert_xpos"):
            wp.copy(getattr(self._drawn, field), getattr(state, field))
        return MujocoScene(
            self._places(state.geom_xpos, state.geom_xmat),
            self._places(state.cam_xpos, state.cam_xmat),
        )

    def _places(self, position: wp.array, matrix: wp.array) -> wp.array:
        """Return transforms of positions and rotation matrices, axes world and object."""
        out = wp.empty(position.size, dtype=wp.transform, device=self.device)
        given = [position.flatten(), matrix.flatten()]
        launch(scene_rays.join_places, out.size, given, [out], device=self.device)
        return out

    def between(self, before: MujocoScene, after: MujocoScene, fraction: float) -> MujocoScene:
        """Return the scene between two.

        Parameters
        ----------
        before, after : object
            Scenes of :meth:`snapshot`.
        fraction : float
            Place in time between both, 0 to 1.

        Returns
        -------
        object
            The scene.
        """
        blended = []
        for name in ("geoms", "cameras"):
            first, last = getattr(before, name), getattr(after, name)
            out = wp.empty_like(first)
            inputs = [first, last, fraction]
            launch(scene_rays.blend_frames, out.size, inputs, [out], device=self.device)
            blended.append(out)
        return MujocoScene(*blended)

    def cameras_at(self, scene: MujocoScene) -> Any:
        """Return the places of the cameras.

        Parameters
        ----------
        scene : object
            The scene.

        Returns
        -------
        warp.array
            Transforms from MuJoCo's camera frame, x right, y up and -z ahead, to the world, shape (cameras,).
        """
        by_world = scene.cameras.reshape((self.cameras, -1))
        return by_world[:, self._camera].contiguous()

    def bodies(self, scene: MujocoScene) -> Any:
        """Return the places of the geometries.

        Parameters
        ----------
        scene : object
            The scene.

        Returns
        -------
        warp.array
            Transforms from the frame of each geometry to the world, world by world.
        """
        return scene.geoms

    def luminance(self, scene: MujocoScene, rays: Rays) -> Any:
        """Return what the rays see in the larger view, as linear red, green and blue.

        Parameters
        ----------
        scene : object
            The scene.
        rays : Rays
            Rays of all cameras, of which the directions count.

        Returns
        -------
        warp.array
            Colours, vec3, shape (cameras, height, width).
        """
        self._render(scene)
        shape = (self.cameras, self._wide.height, self._wide.width)
        sums = getattr(self.context, "aa_accum", None)
        if sums is not None:
            # The sums of all samples, before they are rounded to 8 bits
            factor = 1.0 / (LARGEST_BYTE * SAMPLES**2)
            return look_up(sums.reshape(shape), self._wide, rays, self.AXES, factor)
        pictures = wp.empty(shape, dtype=wp.vec3, device=self.device)
        with wp.ScopedDevice(self.device):
            self._library.get_rgb(self.context, 0, pictures)
        return look_up(pictures, self._wide, rays, self.AXES)

    def surfaces(self, scene: MujocoScene, rays: Rays) -> Surfaces:
        """Return what the rays hit, by the nearest pixel of the larger view.

        Parameters
        ----------
        scene : object
            The scene.
        rays : Rays
            Rays of all cameras, one for each pixel.

        Returns
        -------
        Surfaces
            What they hit: the numbers of MuJoCo's geometries; body is the row among all worlds.
        """
        self._render(scene)
        size = (self.cameras, self._wide.height, self._wide.width)
        depth = wp.empty(size, dtype=float, device=self.device)
        hit = wp.empty(size, dtype=wp.vec2i, device=self.device)
        with wp.ScopedDevice(self.device):
            # Depth is cut off at the scale
            self._library.get_depth(self.context, 0, FARTHEST, depth)
            self._library.get_segmentation(self.context, 0, hit)
        shape = (self.cameras, rays.values.shape[0] // rays.bundles, rays.values.shape[1])
        distance = wp.empty(shape, dtype=float, device=self.device)
        number = wp.empty(shape, dtype=int, device=self.device)
        body = wp.empty(shape, dtype=int, device=self.device)
        view = scene_rays.WideView()
        view.camera = camera_params(self._wide, str(self.device))
        view.axes = wp.vec3(*self.AXES)
        view.farthest = FARTHEST
        view.geoms = self._geoms
        outputs = [each.flatten() for each in (distance, number, body)]
        launch(
            scene_rays.look_up_surfaces,
            distance.size,
            [rays.values.flatten(), view, depth, hit],
            outputs,
            device=self.device,
        )
        return Surfaces(distance, body, number)

    def _render(self, scene: MujocoScene) -> None:
        """Draw the larger views of a scene."""
        drawn = self._drawn
        kinds = (
            (scene.geoms, drawn.geom_xpos, drawn.geom_xmat),
            (scene.cameras, drawn.cam_xpos, drawn.cam_xmat),
        )
        for places, position, matrix in kinds:
            outputs = [position.flatten(), matrix.flatten()]
            launch(scene_rays.split_places, len(places), [places], outputs, device=self.device)
        with wp.ScopedDevice(self.device):
            self._library.refit_bvh(self._model, drawn, self.context)
            self._library.render(self._model, drawn, self.context)


@guarded
class MujocoWarpEventCamera(EventCamera):
    """Event cameras in worlds of MuJoCo Warp, each of which looks through an optic at its own angle, or through none.

    MuJoCo Warp takes no rays. So a larger view without the optic is drawn, at twice the resolution and with four
    samples in each of its pixels, and each pixel's rays through the optic are looked up in it. That is exact for optics
    that turn rays, except for the blur of half a pixel of the larger view by the interpolation.

    Parameters
    ----------
    mjm : mujoco.MjModel
        The model on the host.
    model : mujoco_warp.Model
        The model on the device, of ``mujoco_warp.put_model``.
    data : mujoco_warp.Data
        Data of all worlds, which give their number.
    name : str
        Name of the model's camera, whose place the event cameras have. Its field of view is not used.
    camera : Camera
        Intrinsics of all event cameras.
    optic : Model, optional
        What each camera looks through, by default nothing. It turns rays about the camera: a plate, which shifts them,
        is refused.
    **options
        Keywords of :class:`EventCamera`: ``motion``, ``start``, ``sensor``, ``seed``, ``rays_per_pixel`` and
        ``pictures``.

    Raises
    ------
    AmiwarpError
        If MuJoCo Warp is not installed, there is no such camera, the optic is a plate, the camera sees beyond 76 deg
        from its axis, or as for :class:`EventCamera`.

    Notes
    -----
    MuJoCo's colours are taken as linear luminance. The sums of its samples are read before they are rounded to 8 bits,
    but light above 1 is cut off by MuJoCo.

    Examples
    --------
    >>> eyes = amiwarp.sensors.MujocoWarpEventCamera(mjm, model, data, "eye", camera, optic)  # doctest: +SKIP
    """

    renderer: MujocoWarpRenderer

    def __init__(
        self,
        mjm: Any,
        model: Any,
        data: Any,
        name: str,
        camera: Camera,
        optic: Model | None = None,
        **options: Any,
    ) -> None:
        if isinstance(optic, PlateModel):
            raise AmiwarpError(
                "a plate shifts rays by depth, and MuJoCo Warp draws from one place; use Newton for plates, or an "
                "optic that turns rays"
            )
        wide = wide_camera(camera, optic)
        super().__init__(MujocoWarpRenderer(mjm, model, data, name, wide), camera, optic, **options)


def _camera_number(mjm: Any, name: str) -> int:
    """Return the number of a model's camera."""
    names = [mjm.camera(k).name for k in range(mjm.ncam)]
    if name not in names:
        raise AmiwarpError(
            f"the model has no camera {name!r}; its cameras are {', '.join(names) or 'none'}"
        )
    return names.index(name)


def _context(library: Any, mjm: Any, number: int, wide: Camera, worlds: int) -> Any:
    """Return MuJoCo Warp's context for the larger views: the model's camera has their field of view meanwhile."""
    fovy = float(mjm.cam_fovy[number])
    sensor = mjm.cam_sensorsize[number].copy()
    try:
        mjm.cam_fovy[number] = math.degrees(2.0 * math.atan(0.5 * wide.height / wide.fy))
        mjm.cam_sensorsize[number] = 0.0
        return library.create_render_context(
            mjm,
            nworld=worlds,
            cam_res=(wide.width, wide.height),
            cam_active=[k == number for k in range(mjm.ncam)],
            render_rgb=True,
            render_depth=True,
            render_seg=True,
            samples_per_pixel=SAMPLES,
        )
    finally:
        mjm.cam_fovy[number] = fovy
        mjm.cam_sensorsize[number] = sensor
