"""Event cameras in a simulator, each behind an optic at its own angle: states go in, events come out."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import NAMES, DeviceEvents, wait
from amiwarp.events.encoder import Encoder
from amiwarp.events.poses import Poses
from amiwarp.events.recording import Events, Recording
from amiwarp.events.truth import Truth
from amiwarp.imaging.windows import Windows
from amiwarp.kernels import scene_rays
from amiwarp.kernels.camera import camera_params
from amiwarp.kernels.event_arrays import EventArrays, new_event_arrays
from amiwarp.kernels.launch import launch
from amiwarp.kernels.scene_rays import SceneFrames
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.prism import NominalPrism
from amiwarp.schema.calls import guarded
from amiwarp.sensors.optic_speed import optic_speed
from amiwarp.sensors.rays import Rays, RayWriter
from amiwarp.sensors.renderer import Renderer, Surfaces
from amiwarp.simulation.event_sensor import EventSensor
from amiwarp.simulation.image_levels import ImageEncoding, ImageLevels
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.validation import TIME_LIMIT, array, finite, instance, shown, whole

LARGEST_MOVE = 0.25
"""Largest movement of the image from one picture to the next, if their number is chosen [px]."""
COARSE_MOVE = 1.0
"""Movement by the optic from one picture to the next above which a given number of pictures is called too small [px].
"""
MOST_PICTURES = 256
"""Largest number of pictures between two states."""
STRIDE = 4
"""Distance of the pixels of which it is found how far the scene moves [px]."""
ENCODER_US = 500
"""Longest time between two samples of the encoder of a recording [us]."""


@guarded
class EventCamera:
    """Event cameras that look at a simulator's scene, through an optic that moves or without one.

    :meth:`step` takes the simulator's state and returns the events since the state before. In between it draws as many
    pictures as the motion of image and optic needs. :class:`amiwarp.sensors.NewtonEventCamera` and
    :class:`amiwarp.sensors.MujocoWarpEventCamera` make these cameras for two simulators; ``docs/how-to/simulators.md``
    shows another one.

    Parameters
    ----------
    renderer : Renderer
        What draws the pictures, with the number of the cameras and their device.
    camera : Camera
        Intrinsics of all cameras.
    optic : Model, optional
        What each camera looks through: the model of a prism, a plate or another optic, for this camera. By default
        nothing.
    motion : PrismMotion or sequence of PrismMotion, optional
        Angle of the optic over time, of all cameras or of each one. The phases are the model's. Default: an optic at
        rest.
    start : array_like, optional
        Angles of the optic at time 0 [rad]: one number, one for each camera, shape (cameras,), or both angles of each
        one, shape (cameras, 2).
    sensor : SensorModel, optional
        Pixels and readout.
    seed : int or sequence of int, optional
        Seeds of the sensors, as for :class:`amiwarp.EventSensor`.
    rays_per_pixel : int, optional
        Number of rays whose luminance is averaged: 1, 4, 9, 16 or 25. With one, edges jump from pixel to pixel.
    pictures : int, optional
        Number of pictures from one state to the next. By default it is chosen in each step, so that the image moves by
        up to 0.25 px from one picture to the next, if the renderer knows what moves; else by the optic alone.

    Raises
    ------
    AmiwarpError
        If the optic has another camera or gives no rays, there is a motion without an optic, or a value is unusable.

    Examples
    --------
    >>> import numpy as np
    >>> class Rising(amiwarp.Renderer):
    ...     def luminance(self, light, rays):
    ...         return np.full((1, 2, 3), light, np.float32)
    >>> eyes = amiwarp.EventCamera(Rising(1, "cpu"), amiwarp.Camera.from_fov(3, 2, 1.0), pictures=1,
    ...                            sensor=amiwarp.SensorModel.ideal(0.25))
    >>> len(eyes.step(0.3, 0)[0]), len(eyes.step(0.4, 1000)[0])  # log rises by 0.27 in each of the 6 pixels
    (0, 6)
    """

    def __init__(
        self,
        renderer: Renderer,
        camera: Camera,
        optic: Model | None = None,
        *,
        motion: PrismMotion | Sequence[PrismMotion] | None = None,
        start: ArrayLike = 0.0,
        sensor: SensorModel | None = None,
        seed: int | Sequence[int] | NDArray[np.integer[Any]] = 0,
        rays_per_pixel: int = 4,
        pictures: int | None = None,
    ) -> None:
        self.renderer = instance(renderer, Renderer, "renderer")
        """What draws the pictures."""
        self.camera = instance(camera, Camera, "camera")
        """Intrinsics of all cameras."""
        self.optic = optic
        """Model of what each camera looks through, or None."""
        if optic is not None and optic.camera != camera:
            raise AmiwarpError(
                f"the optic is a model for {optic.camera}; make it for the event camera's {camera}"
            )
        if optic is None and motion is not None:
            raise AmiwarpError("there is a motion without an optic; give the optic, too")
        cameras = self.renderer.cameras
        self._motions = _motions(motion, cameras)
        self._start = _start_angles(start, cameras, 1 if optic is None else optic.ANGLES)
        if pictures is not None:
            pictures = whole(pictures, "pictures", 1, MOST_PICTURES)
        self._pictures = pictures
        self._speed = np.zeros(1) if optic is None else optic_speed(optic)
        device = self.renderer.device
        axes = self.renderer.AXES
        self._rays = RayWriter(camera, optic, axes, device, rays_per_pixel)
        self._few_rays = RayWriter(camera, None, axes, device, stride=STRIDE)
        self._plain_rays = RayWriter(camera, None, axes, device)
        shape = (cameras, camera.height, camera.width)
        self._sensor = EventSensor(*shape, sensor, seed=seed, device=device)
        self._levels = ImageLevels(shape, device)
        self._before: Any = None
        self._before_us = -1
        self._fresh = np.zeros(cameras, bool)
        self._warned = False
        self.images: Any = None
        """Last luminance that the renderer gave, None at first."""
        self.pictures = 0
        """Number of pictures drawn in the last step."""

    def angles(self, t_us: int) -> NDArray[np.float64]:
        """Return the angle of each camera's optic, without the model's phase.

        Parameters
        ----------
        t_us : int
            Time [us].

        Returns
        -------
        numpy.ndarray
            Unwrapped angles [rad], shape (cameras,), or (cameras, 2) for an optic with two angles.
        """
        if self._motions is None:
            return self._start
        turned = [np.asarray(motion.angles([t_us]))[0] for motion in self._motions]
        moved = np.array(turned)
        if self.optic is not None and moved.ndim < self._start.ndim:
            moved = self.optic.all_angles(moved)
        return np.asarray(self._start + moved)

    def rays(self, t_us: int) -> Rays:
        """Return the rays of all cameras at a time.

        Parameters
        ----------
        t_us : int
            Time [us].

        Returns
        -------
        Rays
            The rays, one bundle if all optics have the same angle; valid until the next rays are made.
        """
        theta = self.angles(t_us)
        if self.optic is None or (theta == theta[:1]).all():
            theta = theta[:1]
        return self._rays.write(theta)

    def step(self, state: Any, t_us: int) -> tuple[DeviceEvents, Windows]:
        """Advance all cameras to the simulator's next state, and return the events since the state before.

        The first state sets the reference of each pixel and gives no events; as for :meth:`amiwarp.EventSensor.step`,
        events whose latency ends later follow in the next step.

        Parameters
        ----------
        state : object
            State of the simulator, as its renderer takes it. What it needs is copied.
        t_us : int
            Time of the state [us], after the time of the state before.

        Returns
        -------
        DeviceEvents
            Events of all cameras, sorted by camera, then by time.
        Windows
            One window for each camera: the range of its events, and the times of the two states.

        Raises
        ------
        AmiwarpError
            If the time does not increase, or as :meth:`amiwarp.EventSensor.step`.

        Warns
        -----
        UserWarning
            Once, if the optic moves the image by over 1 px from one picture to the next, or the motion needs more
            pictures than 256.
        """
        t_us = whole(t_us, "t_us", 0, TIME_LIMIT - 1, " us")
        if t_us <= self._before_us:
            raise AmiwarpError(f"t_us is {t_us} after {self._before_us} us; give a later time")
        scene = self.renderer.snapshot(state)
        before = self._before
        begin_us = self._before_us
        count = 1 if begin_us < 0 else self._number(before, scene, t_us)
        shape = (self.renderer.cameras, self.camera.height, self.camera.width)
        parts = []
        for k in range(1, count + 1):
            at_us = t_us
            if k < count:
                at_us = begin_us + (t_us - begin_us) * k // count
            seen = scene if begin_us < 0 else self.renderer.between(before, scene, k / count)
            self.images = self.renderer.luminance(seen, self.rays(at_us))
            if self._fresh.any():
                # They start at the last picture, the state itself: those before show the way to it
                self._sensor.reset(self._fresh)
            levels = self._levels.convert(self.images, ImageEncoding.LINEAR)
            parts.append(self._sensor.step(levels.reshape(shape), at_us))
        self._before = scene
        self._before_us = t_us
        self.pictures = count
        if count > 1:
            parts = [_joined(parts, self._fresh, self.renderer.device)]
        self._fresh[:] = False
        return parts[0]

    def _number(self, before: Any, after: Any, t_us: int) -> int:
        """Return the number of pictures from the state before to the one at a time."""
        turned = np.abs(self.angles(t_us) - self.angles(self._before_us))
        by_optic = float((turned.reshape(len(turned), -1) * self._speed).sum(axis=1).max())
        longest = t_us - self._before_us
        if self._pictures is not None:
            count = min(self._pictures, longest)
            if by_optic > COARSE_MOVE * count:
                self._warn(
                    f"the optic moves the image by {by_optic / count:.1f} px from one picture to the next; events in "
                    "between come evenly in time; give more pictures, or none for a number by the motion"
                )
            return count
        moved = by_optic + self._scene_movement(before, after)
        count = max(1, math.ceil(moved / LARGEST_MOVE))
        if count > MOST_PICTURES:
            self._warn(
                f"the image moves by {moved:.0f} px from one state to the next, for which {count} pictures are needed; "
                f"{MOST_PICTURES} are drawn; step more often"
            )
        return min(count, MOST_PICTURES, longest)

    def _warn(self, text: str) -> None:
        """Warn the caller of :meth:`step`, once."""
        if not self._warned:
            self._warned = True
            warnings.warn(text, stacklevel=5)

    def _scene_movement(self, before: Any, after: Any) -> float:
        """Return by how much the image of the scene moves at most without the optic [px]; 0 if it is not known."""
        flow = self._flow(before, after, self._few_rays)
        if flow is None:
            return 0.0
        longest = wp.zeros(1, dtype=float, device=self.renderer.device)
        counts = wp.array(~self._fresh, dtype=wp.uint8, device=flow.device)
        inputs = [flow, counts, flow.size // len(self._fresh)]
        launch(scene_rays.find_longest, flow.size, inputs, [longest], device=flow.device)
        return float(longest.numpy()[0])

    def _flow(self, before: Any, after: Any, writer: RayWriter) -> wp.array | None:
        """Return the movement of what pixels see without the optic [px], vec2, shape (pixels of all cameras,)."""
        renderer = self.renderer
        if renderer.cameras_at(before) is None:
            return None
        rays = writer.write(np.zeros(1))
        # Copied, because a renderer may use its arrays for the next scene
        frames = SceneFrames()
        frames.cameras_after = wp.clone(renderer.cameras_at(after))
        frames.bodies_after = wp.clone(renderer.bodies(after))
        # The last scene that is drawn is the one before, whose surfaces are found
        frames.cameras_before = wp.clone(renderer.cameras_at(before))
        frames.bodies_before = wp.clone(renderer.bodies(before))
        surfaces = renderer.surfaces(renderer.between(before, before, 1.0), rays)
        if surfaces is None:
            return None
        flow = wp.empty(surfaces.distance.size, dtype=wp.vec2, device=renderer.device)
        inputs = [
            camera_params(self.camera, str(renderer.device)),
            writer.grid,
            rays.values.flatten(),
            surfaces.distance.flatten(),
            surfaces.body.flatten(),
            frames,
        ]
        launch(scene_rays.find_flow, flow.size, inputs, [flow], device=renderer.device)
        return flow

    def surfaces(self) -> Surfaces:
        """Return what the pixels would see without the optic at the last state.

        Returns
        -------
        Surfaces
            Distance, body and shape of each pixel.

        Raises
        ------
        AmiwarpError
            If there was no state yet, or the renderer does not know.
        """
        self._check_started()
        scene = self.renderer.between(self._before, self._before, 1.0)
        found = self.renderer.surfaces(scene, self._plain_rays.write(np.zeros(1)))
        if found is None:
            raise AmiwarpError(f"{type(self.renderer).__name__} does not know surfaces")
        return found

    def flow_to(self, state: Any) -> Any:
        """Return by how much what each pixel sees without the optic moves from the last state to another one.

        Parameters
        ----------
        state : object
            State of the simulator.

        Returns
        -------
        warp.array
            Displacement [px], vec2, shape (cameras, height, width); NaN where a point leaves the image plane.

        Raises
        ------
        AmiwarpError
            If there was no state yet, or the renderer does not know what moves.
        """
        self._check_started()
        flow = self._flow(self._before, self.renderer.snapshot(state), self._plain_rays)
        if flow is None:
            raise AmiwarpError(f"{type(self.renderer).__name__} does not know what moves")
        wait(self.renderer.device)
        return flow.reshape((self.renderer.cameras, self.camera.height, self.camera.width))

    def _check_started(self) -> None:
        if self._before_us < 0:
            raise AmiwarpError("there was no state yet; call step first")

    def camera_poses(self) -> NDArray[np.float64]:
        """Return the places of the cameras at the last state, in amiwarp's camera frame.

        Returns
        -------
        numpy.ndarray
            Position [m] and quaternion x, y, z, w from the camera's frame to the simulator's world, shape (cameras, 7).

        Raises
        ------
        AmiwarpError
            If there was no state yet, or the renderer does not know.
        """
        self._check_started()
        found = self.renderer.cameras_at(self._before)
        if found is None:
            raise AmiwarpError(f"{type(self.renderer).__name__} does not know its cameras' places")
        poses = np.asarray(found.numpy(), np.float64).reshape(-1, 7)
        if self.renderer.AXES == (1, 1, 1):
            return poses
        # Half a turn about x is what changes the signs of y and z: q * (1, 0, 0, 0)
        x, y, z, w = poses[:, 3:].T
        poses[:, 3:] = np.stack([w, z, -y, -x], axis=1)
        return poses

    def reset(self, which: Any = None) -> None:
        """Start cameras anew at the next state, after the simulator has reset their worlds.

        Parameters
        ----------
        which : int or array_like, optional
            Number of a camera, or numbers of several cameras, shape (k,), or truth values, shape (cameras,). These
            cameras have no events in the next step, and what jumps before them does not count as movement. By default,
            all cameras: then the time starts anew, too.
        """
        self._sensor.reset(which)
        if which is None:
            self._before = None
            self._before_us = -1
            self._fresh[:] = False
        else:
            chosen = np.asarray(which).reshape(-1)
            self._fresh[chosen if chosen.dtype == bool else chosen.astype(np.int64)] = True

    def recording(
        self,
        steps: Any,
        camera: int = 0,
        *,
        prism: NominalPrism | None = None,
        poses: ArrayLike | None = None,
    ) -> Recording:
        """Return a recording of one camera, which :func:`amiwarp.save_recording` writes to a file.

        Parameters
        ----------
        steps : sequence of tuple
            What successive calls of :meth:`step` returned.
        camera : int, optional
            Number of the camera.
        prism : Prism, UnsizedPrism or Plate, optional
            Nominal glass that the recording states.
        poses : array_like, optional
            Places of the camera at the ends of the steps, shape (steps, 7), each of :meth:`camera_poses`.

        Returns
        -------
        Recording
            Events, intrinsics, the encoder of the optic with its true angles, and as ground truth the true parameters
            of the optic and the poses.

        Raises
        ------
        AmiwarpError
            If there are no steps, or there is no such camera.
        """
        camera = whole(camera, "camera", 0, self.renderer.cameras - 1)
        if not isinstance(steps, list | tuple) or not all(map(_is_step, steps)):
            raise AmiwarpError(
                f"steps are {shown(steps)}; give a list of what step returned, events and windows"
            )
        if not steps:
            raise AmiwarpError("a recording is made of no steps; give what step returned")
        own = []
        for events, windows in steps:
            start, stop = int(windows.start[camera]), int(windows.stop[camera])
            own.append(events[start:stop].to_host())
        begin = int(steps[0][1].t_start[camera])
        end = int(steps[-1][1].t_end[camera])
        truth = Truth(self._true_parameters())
        if poses is not None:
            t = np.array([windows.t_end[camera] for _, windows in steps], np.int64)
            places = array(poses, "poses").astype(np.float64)
            truth = Truth(self._true_parameters(), poses=Poses(t=t, camera=places))
        metadata: dict[str, str | int | float | bool] = {"simulated": True}
        if self.optic is not None and not self.optic.PRISM:
            metadata["optic"] = self.optic.NAME
        return Recording(
            Events.concatenate(own),
            self.camera,
            self._encoder(camera, begin, end),
            prism,
            truth,
            metadata,
            name=f"camera {camera}",
        )

    def _encoder(self, camera: int, begin: int, end: int) -> Encoder | None:
        """Return samples of the angle of a camera's optic over a time span [us]; None for an optic at rest."""
        if self._motions is None or self.optic is None:
            return None
        t = np.arange(begin, end + 2 * ENCODER_US, ENCODER_US, dtype=np.int64)
        moved = np.asarray(self._motions[camera].angles(t))
        if moved.ndim < self._start.ndim:
            moved = self.optic.all_angles(moved)
        angle = moved + self._start[camera]
        if angle.ndim == 1:
            return Encoder(t, angle)
        second = Encoder(t, np.ascontiguousarray(angle[:, 1]))
        return Encoder(t, np.ascontiguousarray(angle[:, 0])).with_second(second)

    def _true_parameters(self) -> dict[str, float]:
        """Return the values of the optic's parameters by the names that calibration uses."""
        optic: Any = self.optic
        values: dict[str, float] = {}
        for name in () if optic is None else optic.FREE:
            vector, _, axis = name.rpartition("_")
            if hasattr(optic, name):
                values[name] = float(getattr(optic, name))
            elif axis in ("x", "y") and hasattr(optic, vector):
                values[name] = float(getattr(optic, vector)["xy".index(axis)])
            elif hasattr(optic, "prism") and hasattr(optic.prism, name):
                values[name] = float(getattr(optic.prism, name))
        return values


def _is_step(step: object) -> bool:
    """Return whether a value is what :meth:`EventCamera.step` returns."""
    if not isinstance(step, tuple) or len(step) != 2:
        return False
    events, windows = step
    return isinstance(events, DeviceEvents) and isinstance(windows, Windows)


def _motions(motion: Any, cameras: int) -> list[PrismMotion] | None:
    """Return the motion of each camera's optic, checked; None for optics at rest."""
    if motion is None:
        return None
    if isinstance(motion, PrismMotion):
        return [motion] * cameras
    given = [instance(each, PrismMotion, "motion") for each in motion]
    if len(given) != cameras:
        raise AmiwarpError(f"motion has {len(given)} entries; expected one for each of {cameras}")
    return given


def _start_angles(start: ArrayLike, cameras: int, angles: int) -> NDArray[np.float64]:
    """Return the angles at time 0 of each camera, shape (cameras,) or (cameras, 2), checked."""
    given = finite(array(start, "start"), "start").astype(np.float64)
    shape = (cameras,) if angles == 1 else (cameras, angles)
    if given.ndim == 1 and angles > 1 and len(given) == cameras:
        given = given[:, None]
    if given.shape not in ((), shape, (cameras, 1)):
        raise AmiwarpError(f"start has shape {given.shape}; expected one number, or shape {shape}")
    return np.array(np.broadcast_to(given, shape))


def _joined(
    parts: Sequence[tuple[DeviceEvents, Windows]], fresh: NDArray[np.bool_], device: Any
) -> tuple[DeviceEvents, Windows]:
    """Join the events of successive steps, each sorted by camera, into one that is.

    ``fresh``: whether each camera starts in the last one.
    """
    counts = np.array([windows.stop - windows.start for _, windows in parts])
    of_camera = counts.sum(axis=0)
    edges = np.concatenate([[0], np.cumsum(of_camera)])
    # Where the events of a camera in each part begin
    begins = edges[:-1] + np.cumsum(counts, axis=0) - counts
    total = int(edges[-1])
    columns = new_event_arrays(total, device)
    for (events, windows), begin in zip(parts, begins, strict=True):
        if not len(events):
            continue
        given = EventArrays()
        for name in NAMES:
            setattr(given, name, getattr(events, name))
        firsts = np.append(windows.start, len(events))
        on_device = [
            wp.array(values, dtype=int, device=device) for values in (firsts, begin - windows.start)
        ]
        launch(scene_rays.gather_events, len(events), [given, *on_device], [columns], device=device)
    wait(device)
    windows = Windows(
        start=edges[:-1].astype(np.int64),
        stop=edges[1:].astype(np.int64),
        t_start=np.where(fresh, parts[-1][1].t_start, parts[0][1].t_start),
        t_end=parts[-1][1].t_end,
    )
    return DeviceEvents(*(getattr(columns, name) for name in NAMES)), windows
