"""Simulate the events of an event camera from a picture or a world, a camera and a prism, with ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.events.device_events import DeviceEvents
from amiwarp.events.encoder import Encoder
from amiwarp.events.other_sensors import ImuSamples
from amiwarp.events.recording import Events, MetadataValue, Recording
from amiwarp.io import RecordingWriter
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Plate, Prism
from amiwarp.results.pixel_map import PixelMap
from amiwarp.schema.calls import guarded
from amiwarp.simulation.description import Scene, SimulationValues
from amiwarp.simulation.device_block import CollectedEvents
from amiwarp.simulation.encoder_model import EncoderModel
from amiwarp.simulation.imu_model import ImuModel
from amiwarp.simulation.motion import (
    CameraMotion,
    Commanded,
    Mirror,
    PrismMotion,
    Steerer,
    Vibration,
)
from amiwarp.simulation.picture_maps import log_view
from amiwarp.simulation.recorded_simulation import blocks_of, stored_prism
from amiwarp.simulation.recorded_truth import RecordedTruth, chosen_instants
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.true_parameters import true_parameters
from amiwarp.simulation.truth_renderer import TruthRenderer
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.tasks import Progress


@guarded
@dataclass(frozen=True, eq=False)
class Simulation(SimulationValues):
    """Description of a simulated recording, :class:`SimulationValues`, and the methods that simulate it.

    Equal values give equal events, bit for bit, on one kind of device.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> simulation = amiwarp.Simulation(
    ...     scene=amiwarp.Scene.from_picture(picture), camera=amiwarp.Camera.from_fov(32, 24, 1.0),
    ...     prism=amiwarp.Prism(0.03), duration_s=0.01)
    >>> recording = simulation.run()
    >>> recording.events.size
    (32, 24)
    """

    def without_prism(self) -> Simulation:
        """Return this simulation without prism and vibration, which makes it the simulation of a plain event camera.

        Returns
        -------
        Simulation
            The same scene, sensor and seed with an apex angle of 0, or a mirror or beam steerer at rest. Its recording
            has neither encoder nor prism.
        """
        return replace(self.at_rest, nominal_prism=None, encoder_model=None)

    def encoder(self) -> Encoder | None:
        """Sample the prism's encoder.

        Returns
        -------
        Encoder or None
            Samples of the encoder, or None without a prism. Its clock offset is only in the ground truth.
        """
        if self.encoder_model is None:
            return None
        return self.encoder_model.sample(self.prism_motion, self.duration_us, self.seed)

    def imu_samples(self) -> ImuSamples | None:
        """Simulate the IMU.

        Returns
        -------
        ImuSamples or None
            Samples of gyroscope and accelerometer, or None without an IMU. A vibration of the camera is not among them.
        """
        if self.imu is None:
            return None
        if isinstance(self.scene, WorldScene):
            return self.imu.follow(self.scene.trajectory, self.duration_s, seed=self.seed)
        return self.imu.turn(self.camera_motion, self.duration_s, seed=self.seed)

    def truth_parameters(self) -> dict[str, float]:
        """Return the true values of the parameters of prism, encoder, camera motion and sensor.

        Returns
        -------
        dict
            Values by the names that calibration uses, and the sensor's parameters.
        """
        return true_parameters(self)

    def metadata(self) -> dict[str, MetadataValue]:
        """Return the metadata that the recording stores about its simulation.

        Returns
        -------
        dict
            Seed and duration, the optic if no glass tells it, and :attr:`source`.
        """
        known: dict[str, MetadataValue] = {
            "simulated": True,
            "seed": self.seed,
            "duration_us": self.duration_us,
        }
        if isinstance(self.prism, Vibration) or (
            isinstance(self.prism, Commanded) and self.encoder_model is not None
        ):
            known["optic"] = self.moving_model.NAME
        return {**known, **self.source}

    def blocks(
        self, *, chunk_us: int | None = None, progress: Progress | None = None
    ) -> Iterator[tuple[Events, NDArray[np.float32]]]:
        """Yield the events of successive time spans. Memory use is constant.

        Parameters
        ----------
        chunk_us : int, optional
            Length of a span [us], at least 1. The default depends on the device. The events do not depend on it. Spans
            of over 134 s are divided; with more than 16,384 pixels, shorter ones too, at 1280x720 recordings of over 2
            s.
        progress : Progress, optional
            Called with the finished share.

        Yields
        ------
        tuple
            Events, and the scene point of each event: its pixel without prism and vibration [px], shape ``(n, 2)``, NaN
            if its ray misses the image plane.
        """
        for block, _ in blocks_of(self, chunk_us, progress):
            yield block.events(), block.points()

    def device_blocks(
        self, *, chunk_us: int | None = None, progress: Progress | None = None
    ) -> Iterator[tuple[DeviceEvents, wp.array]]:
        """Yield the events of successive time spans on the device that simulates them, without a copy to the host.

        Parameters
        ----------
        chunk_us : int, optional
            Length of a span [us], at least 1. The default depends on the device. The events do not depend on it. Spans
            of over 134 s are divided; with more than 16,384 pixels, shorter ones too, at 1280x720 recordings of over 2
            s.
        progress : Progress, optional
            Called with the finished share.

        Yields
        ------
        tuple
            Events, and the scene point of each event, as in :meth:`blocks`: a Warp array of vec2, shape ``(n,)``, which
            other libraries read as ``(n, 2)``.
        """
        for block, _ in blocks_of(self, chunk_us, progress):
            yield block.on_device()

    def log_view(self) -> NDArray[np.float32]:
        """Return the first picture as the camera sees it at t = 0 without the prism.

        Returns
        -------
        ndarray
            Log intensity, float32, shape ``(height, width)``.
        """
        return log_view(self)

    def displacement(
        self, t0_us: int, t1_us: int, *, with_prism: bool = False
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return how the points of a world that the pixels see at one time move until another time, before or after it.

        For many pairs of times, make a :class:`amiwarp.TruthRenderer` once and call its method of the same name.

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
            If the scene is a picture, or a time lies outside the recording.

        Examples
        --------
        >>> square = amiwarp.Mesh([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], [[0, 1, 2], [0, 2, 3]])
        >>> scene = amiwarp.WorldScene(
        ...     amiwarp.World("example", (amiwarp.Body("wall", square),)),
        ...     amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0]))
        >>> simulation = amiwarp.Simulation(
        ...     scene, amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.01), duration_s=0.01)
        >>> moved, occlusion = simulation.displacement(10_000, 2_000, with_prism=True)
        >>> moved.shape, occlusion.shape
        ((24, 32, 2), (24, 32))
        """
        return TruthRenderer(self).displacement(t0_us, t1_us, with_prism=with_prism)

    def run(
        self,
        *,
        truth_hz: float | None = None,
        truth_times_us: ArrayLike | None = None,
        on_device: bool = False,
        progress: Progress | None = None,
    ) -> Recording:
        """Simulate the whole recording in memory.

        Parameters
        ----------
        truth_hz : float, optional
            Rate of the instants whose depth, normals, instances, flow and luminance are recorded [1/s]. Only worlds
            have them. By default there are none.
        truth_times_us : array_like, optional
            The instants themselves instead of a rate [us], shape (k,), rising.
        on_device : bool, optional
            Keep the events and their ground truth on :attr:`device`, as :func:`simulate` does.
        progress : Progress, optional
            Called with the finished share.

        Returns
        -------
        Recording
            The recording, with ground truth.
        """
        recorded = RecordedTruth(self, chosen_instants(self.duration_us, truth_hz, truth_times_us))
        collected = CollectedEvents(on_device=on_device)
        for block, now_us in blocks_of(self, progress=progress):
            collected.add(block)
            recorded.keep(now_us)
        events, of_events = collected.take(self.camera.width, self.camera.height)
        known = recorded.kept(self.truth_parameters(), of_events)
        camera = self.camera
        encoder = self.encoder()
        return Recording(
            events,
            camera,
            encoder,
            stored_prism(self),
            known,
            self.metadata(),
            "simulation",
            imu=self.imu_samples(),
        )

    def write(
        self,
        path: str | Path,
        *,
        truth_hz: float | None = None,
        truth_times_us: ArrayLike | None = None,
        progress: Progress | None = None,
        overwrite: bool = False,
    ) -> int:
        """Simulate the whole recording to a file, in constant memory.

        Parameters
        ----------
        path : str or Path
            Path of the recording.
        truth_hz : float, optional
            Rate of the instants whose depth, normals, instances, flow and luminance are recorded [1/s], as in
            :meth:`run`.
        truth_times_us : array_like, optional
            The instants themselves instead of a rate [us], shape (k,), rising.
        progress : Progress, optional
            Called with the finished share.
        overwrite : bool, optional
            Replace an existing file.

        Returns
        -------
        int
            Number of events.
        """
        recorded = RecordedTruth(self, chosen_instants(self.duration_us, truth_hz, truth_times_us))
        header = header_of(self, recorded)
        with RecordingWriter(path, overwrite=overwrite, **header) as writer:
            write_recording(self, recorded, writer, progress)
        return len(writer)


def header_of(simulation: Simulation, recorded: RecordedTruth) -> dict[str, Any]:
    """Return the arguments of :class:`RecordingWriter` that describe the recording of a simulation."""
    return {
        "width": simulation.camera.width,
        "height": simulation.camera.height,
        "camera": simulation.camera,
        "prism": stored_prism(simulation),
        "encoder": simulation.encoder(),
        "truth_parameters": simulation.truth_parameters(),
        "truth_labels": recorded.labels,
        "metadata": simulation.metadata(),
    }


def write_recording(
    simulation: Simulation,
    recorded: RecordedTruth,
    writer: RecordingWriter,
    progress: Progress | None = None,
) -> None:
    """Simulate a whole recording into an open writer, in constant memory."""
    imu = simulation.imu_samples()
    if imu is not None:
        writer.append_imu(imu)
    for block, now_us in blocks_of(simulation, progress=progress):
        writer.append(block.events(), truth=block.truth())
        for frame in recorded.frames_before(now_us):
            writer.append_frame(frame)
        for t_us, mask in recorded.known.take():
            writer.append_known(t_us, mask)
        poses = recorded.poses_before(now_us)
        if poses is not None:
            writer.append_poses(poses)


@guarded
def simulate(
    scene: Scene | WorldScene | str | Path | NDArray[Any],
    camera: Camera,
    prism: Prism | Plate | Vibration | Mirror | Steerer,
    *,
    duration_s: float,
    motion: PrismMotion | float = 720.0,
    camera_motion: CameraMotion | None = None,
    sensor: SensorModel | None = None,
    pixels: PixelMap | None = None,
    encoder: EncoderModel | None = None,
    nominal_prism: Prism | Plate | None = None,
    imu: ImuModel | None = None,
    seed: int = 0,
    device: str = "cpu",
    on_device: bool = False,
    truth_hz: float | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Simulate a recording.

    For recordings larger than memory, use :meth:`Simulation.write`, :meth:`Simulation.blocks` or
    :meth:`Simulation.device_blocks`.

    Parameters
    ----------
    scene : Scene, WorldScene, str, Path or ndarray
        Scene, world, picture file, or pixel values (see :meth:`Scene.from_picture`).
    camera : Camera
        The camera.
    prism : Prism, Plate, Vibration, Mirror or Steerer
        The true prism; or a plate, in a world; or a mirror; or a beam steerer; or the vibration of a camera without
        glass, whose recording has neither encoder nor prism.
    duration_s : float
        Duration [s].
    motion : PrismMotion or float, optional
        Motion of the prism, or its constant speed [turns/min]. Vibrations, mirrors and beam steerers have their own.
    camera_motion : CameraMotion, optional
        Rotation of the camera; by default none.
    sensor : SensorModel, optional
        Pixels of the sensor.
    pixels : PixelMap, optional
        Thresholds of each pixel, and hot and dead pixels, instead of random ones.
    encoder : EncoderModel, optional
        Errors of the encoder.
    nominal_prism : Prism or Plate, optional
        The prism or plate stored with the recording; by default the true one.
    imu : ImuModel, optional
        Gyroscope and accelerometer that move with the camera; by default none.
    seed : int, optional
        Seed of all random numbers.
    device : str, optional
        Device to compute on.
    on_device : bool, optional
        Keep the events and their ground truth on ``device``: the recording has :class:`DeviceMemoryEvents`. By default,
        they are copied to the host's memory.
    truth_hz : float, optional
        Rate of the instants whose depth, normals, instances, flow and luminance are recorded [1/s], in a world.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    Recording
        The recording, with ground truth.

    Raises
    ------
    AmiwarpError
        If a value is out of range, or the camera turns away from the picture.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> camera = amiwarp.Camera.from_fov(32, 24, 1.0)
    >>> recording = amiwarp.simulate(picture, camera, amiwarp.Prism(0.03), duration_s=0.01)
    >>> len(recording.events) > 0
    True
    """
    return Simulation(
        scene=scene if isinstance(scene, Scene | WorldScene) else Scene.from_picture(scene),
        camera=camera,
        prism=prism,
        duration_s=duration_s,
        motion=motion,
        camera_motion=camera_motion or CameraMotion(),
        sensor=sensor or SensorModel(),
        pixels=pixels,
        encoder_model=encoder or EncoderModel(),
        nominal_prism=nominal_prism,
        imu=imu,
        seed=seed,
        device=device,
    ).run(truth_hz=truth_hz, on_device=on_device, progress=progress)
