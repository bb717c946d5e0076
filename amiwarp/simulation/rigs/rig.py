"""Rig of several cameras in a simulated world, on one body and one clock."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.other_sensors import MemoryImages
from amiwarp.events.poses import Poses
from amiwarp.events.recording import Events, MemoryEvents, MetadataValue, Recording
from amiwarp.events.rig_recording import RigRecording, RigSensor, SensorKind
from amiwarp.events.truth import Truth
from amiwarp.io import RigWriter
from amiwarp.optics.prism import Prism
from amiwarp.schema.calls import guarded
from amiwarp.simulation.motion import LONGEST_S
from amiwarp.simulation.recorded_truth import RecordedTruth, chosen_instants, labels_of, poses_at
from amiwarp.simulation.rigs.cameras import (
    RigCamera,
    RigDepthCamera,
    RigEventCamera,
    RigFrameCamera,
    check_camera_names,
)
from amiwarp.simulation.rigs.paper_platform import APEX, VGA, paper_platform
from amiwarp.simulation.rigs.taken_frames import TakenFrame, taken_frames
from amiwarp.simulation.simulator import Simulation, header_of, write_recording
from amiwarp.simulation.worlds.device_world import device_world
from amiwarp.simulation.worlds.mounted_trajectory import MountedTrajectory
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World
from amiwarp.simulation.worlds.world_choice import open_world
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.tasks import Progress, part, silent
from amiwarp.validation import instance, real, shown, whole

KINDS: dict[type, SensorKind] = {
    RigEventCamera: SensorKind.EVENTS,
    RigFrameCamera: SensorKind.FRAMES,
    RigDepthCamera: SensorKind.DEPTH,
}
"""What each kind of camera records."""


@guarded
@dataclass(frozen=True, eq=False)
class Rig:
    """Rig of several cameras that moves through a world: their places on it, and one clock for all.

    Each camera has its own random numbers, which depend on its name and :attr:`seed` only. So another camera changes
    none of the others.

    Examples
    --------
    >>> import numpy as np
    >>> world, way = amiwarp.named_world("desk", duration_s=0.02)
    >>> camera = amiwarp.Camera.from_fov(32, 24, 1.0)
    >>> beside = np.column_stack([np.eye(3), (0.06, 0.0, 0.0)])
    >>> rig = amiwarp.Rig(world, way, {
    ...     "ami": amiwarp.RigEventCamera(camera, amiwarp.Prism(0.02)),
    ...     "plain": amiwarp.RigEventCamera(camera, to_rig=beside)}, duration_s=0.02)
    >>> rig.simulation("plain").camera.width
    32
    """

    world: World
    """World that all cameras see."""
    trajectory: Trajectory
    """Pose of the rig over time."""
    sensors: Mapping[str, RigCamera]
    """Cameras by name: letters, digits, ``-`` and ``_``."""
    duration_s: float
    """Duration of the recording [s]."""
    seed: int = 0
    """Seed of all random numbers."""
    device: str = "cpu"
    """Device that computes, such as ``cpu`` or ``cuda:0``."""
    source: Mapping[str, MetadataValue] = field(default_factory=dict)
    """Description of what the rig was made from; it becomes part of the recordings' metadata."""

    def __post_init__(self) -> None:
        instance(self.world, World, "rig's world")
        instance(self.trajectory, Trajectory, "rig's trajectory")
        real(self.duration_s, "duration_s", 1e-3, LONGEST_S, " s")
        object.__setattr__(self, "seed", whole(self.seed, "seed", 0, (1 << 31) - 1))
        check_camera_names(self.sensors)
        for name, sensor in self.sensors.items():
            if not isinstance(sensor, RigCamera):
                raise AmiwarpError(
                    f"rig's sensor {name!r} is {shown(sensor)}; expected a RigEventCamera, RigFrameCamera or "
                    "RigDepthCamera"
                )
            if isinstance(sensor, RigEventCamera):
                self._check_simulation(name)
            elif not len(sensor.times(self.duration_s)):
                raise AmiwarpError(
                    f"rig's sensor {name!r} takes no frame within {self.duration_s:g} s; give a longer duration"
                )

    def _check_simulation(self, name: str) -> None:
        """Raise :class:`AmiwarpError`, which names the sensor, if it cannot be simulated."""
        try:
            self.simulation(name)
        except AmiwarpError as error:
            raise AmiwarpError(f"rig's sensor {name!r}: {error}", error.code) from error

    @classmethod
    def paper_platform(
        cls,
        world: str = "room",
        *,
        trajectory: str = "handheld",
        duration_s: float = 2.0,
        size: tuple[int, int] = VGA,
        apex: float = APEX,
        seed: int = 0,
        device: str = "cpu",
    ) -> Rig:
        """Return the platform of the AMI-EV paper in a world.

        Parameters
        ----------
        world : str, optional
            Name of a built-in world, or a world file.
        trajectory : str, optional
            Motion of the platform in a built-in world, or a file of poses.
        duration_s : float, optional
            Duration [s].
        size : tuple of int, optional
            Width and height of all images [px].
        apex : float, optional
            Apex angle of the wedge [rad]. The paper uses 0.5 and 1 degree.
        seed : int, optional
            Seed of the world and of all random numbers.
        device : str, optional
            Device to compute on.

        Returns
        -------
        Rig
            Rig with the event cameras ``ami``, behind the wedge, and ``plain``, and the RealSense D435's cameras
            ``colour``, ``grey`` and ``depth``.

        Raises
        ------
        AmiwarpError
            If the world does not exist, or a value is out of range.

        Notes
        -----
        B. He et al., "Microsaccade-inspired event camera for robotics", Science Robotics 9, 2024, names two DVXplorer
        (640x480), a wedge at 720 turns/min, and an Intel RealSense D435. The places of the cameras, the lenses'
        fields of view, and the D435's times of exposure and readout are not in its main text; they are assumed here.
        Fields of view of the D435 at 640x480, its range, and the distance of 15 mm between its left imager and its
        colour camera follow Intel's data sheet (337029).

        Examples
        --------
        >>> rig = amiwarp.Rig.paper_platform("desk", duration_s=0.1, size=(64, 48))
        >>> list(rig.sensors)
        ['ami', 'plain', 'colour', 'grey', 'depth']
        """
        for what, name in (("world", world), ("trajectory", trajectory)):
            instance(name, str, what)
        sensors = paper_platform(size, apex)  # first, because its checks are fast
        of_world, way = open_world(world, trajectory, seed=seed, duration_s=duration_s)
        return cls(of_world, way, sensors, duration_s, seed, device)

    def trajectory_of(self, name: str) -> Trajectory:
        """Return the trajectory of a camera: the rig's, composed with the place of the camera at every instant.

        Parameters
        ----------
        name : str
            Name of the camera.

        Returns
        -------
        Trajectory
            Poses of the camera in the world.

        Raises
        ------
        AmiwarpError
            If the rig has no such camera.
        """
        return MountedTrajectory(self.trajectory, np.asarray(self._sensor(name).to_rig))

    def seed_of(self, name: str) -> int:
        """Return the seed of a camera's random numbers.

        Parameters
        ----------
        name : str
            Name of the camera.

        Returns
        -------
        int
            Seed, which depends on the name and :attr:`seed` only.
        """
        self._sensor(name)  # its check
        digest = hashlib.sha256(f"{self.seed} {name}".encode()).digest()
        return int.from_bytes(digest[:4], "big") >> 1

    def simulation(self, name: str) -> Simulation:
        """Return the simulation of an event camera of the rig.

        Parameters
        ----------
        name : str
            Name of the event camera.

        Returns
        -------
        Simulation
            Simulation of this camera alone. Its events are the camera's in the rig, bit for bit.

        Raises
        ------
        AmiwarpError
            If the rig has no such event camera.
        """
        sensor = self._sensor(name)
        if not isinstance(sensor, RigEventCamera):
            raise AmiwarpError(
                f"sensor {name!r} is a {type(sensor).__name__}, which has no events; name an event camera"
            )
        scene = WorldScene(
            self.world,
            self.trajectory_of(name),
            sensor.blur,
            sensor.seeing,
            sensor.samples,
            sensor.motion_px,
        )
        is_plain = sensor.prism is None
        return Simulation(
            scene,
            sensor.camera,
            Prism(0.0) if sensor.prism is None else sensor.prism,
            self.duration_s,
            motion=sensor.motion,
            sensor=sensor.sensor,
            encoder_model=None if is_plain else sensor.encoder_model,
            nominal_prism=None if is_plain else sensor.nominal_prism,
            seed=self.seed_of(name),
            device=self.device,
            source=self.source,
            pixels=sensor.pixels,
            imu=sensor.imu,
        )

    def run(self, *, progress: Progress | None = None) -> RigRecording:
        """Simulate all cameras in memory.

        Parameters
        ----------
        progress : Progress, optional
            Called with the finished share.

        Returns
        -------
        RigRecording
            Recordings of the cameras by name, with ground truth.
        """
        _shared = device_world(self.world, self.device)  # all cameras use it
        sensors: dict[str, RigSensor] = {}
        for name, sensor in self.sensors.items():
            advance = self._part_of(name, progress)
            if isinstance(sensor, RigEventCamera):
                recording = self.simulation(name).run(truth_hz=sensor.truth_hz, progress=advance)
            else:
                recording = self._frames_in_memory(name, sensor, advance)
            sensors[name] = RigSensor(KINDS[type(sensor)], recording, np.asarray(sensor.to_rig))
        return RigRecording(sensors, self.metadata(), self.world.name)

    def write(
        self,
        folder: str | Path,
        *,
        progress: Progress | None = None,
        overwrite: bool = False,
    ) -> None:
        """Simulate all cameras to a folder, in constant memory.

        Parameters
        ----------
        folder : str or Path
            Folder of the recorded rig, which is made if it does not exist.
        progress : Progress, optional
            Called with the finished share.
        overwrite : bool, optional
            Replace existing files of a rig.
        """
        _shared = device_world(self.world, self.device)  # all cameras use it
        with RigWriter(folder, metadata=self.metadata(), overwrite=overwrite) as rig_writer:
            for name, sensor in self.sensors.items():
                advance = self._part_of(name, progress)
                place = np.asarray(sensor.to_rig)
                if isinstance(sensor, RigEventCamera):
                    simulation = self.simulation(name)
                    instants = chosen_instants(simulation.duration_us, sensor.truth_hz)
                    recorded = RecordedTruth(simulation, instants)
                    header = header_of(simulation, recorded)
                    writer = rig_writer.add(name, KINDS[type(sensor)], place, **header)
                    write_recording(simulation, recorded, writer, advance)
                else:
                    writer = rig_writer.add(
                        name,
                        KINDS[type(sensor)],
                        place,
                        width=sensor.camera.width,
                        height=sensor.camera.height,
                        camera=sensor.camera,
                        truth_labels=labels_of(self.world),
                        metadata=self._metadata_of(name),
                    )
                    for frame in self._frames(name, sensor, advance):
                        frame.append_to(writer)
                    writer.append_poses(self._poses_of_frames(name, sensor))

    def metadata(self) -> dict[str, MetadataValue]:
        """Return the metadata that the recorded rig stores.

        Returns
        -------
        dict
            World, seed and duration, and :attr:`source`.
        """
        return {
            "simulated": True,
            "world": self.world.name,
            "seed": self.seed,
            "duration_us": self._duration_us,
            **self.source,
        }

    @property
    def _duration_us(self) -> int:
        """Duration of the recording, rounded [us]."""
        return round(1e6 * self.duration_s)

    def _part_of(self, name: str, progress: Progress | None) -> Progress:
        """Return the callback of a camera's part of the work, which is as large as any other's."""
        place = list(self.sensors).index(name)
        count = len(self.sensors)
        return part(progress or silent, place / count, (place + 1) / count)

    def _metadata_of(self, name: str) -> dict[str, MetadataValue]:
        """Return the metadata of the recording of a camera without events."""
        return {**self.metadata(), "seed": self.seed_of(name)}

    def _scene_of(self, name: str) -> WorldScene:
        """Return the scene of a camera without events."""
        sensor = self._sensor(name)
        scene = WorldScene(self.world, self.trajectory_of(name))
        if isinstance(sensor, RigFrameCamera):
            return replace(scene, blur=sensor.blur, samples=sensor.samples)
        return scene

    def _frames(
        self, name: str, sensor: RigFrameCamera | RigDepthCamera, progress: Progress
    ) -> Iterator[TakenFrame]:
        """Yield the frames or depth images of a camera."""
        return taken_frames(
            sensor,
            self._scene_of(name),
            self.duration_s,
            seed=self.seed_of(name),
            device=self.device,
            progress=progress,
        )

    def _poses_of_frames(self, name: str, sensor: RigFrameCamera | RigDepthCamera) -> Poses:
        """Return the poses of a camera, the bodies and the joints at the times of its frames."""
        return poses_at(self._scene_of(name), sensor.times(self.duration_s))

    def _frames_in_memory(
        self, name: str, sensor: RigFrameCamera | RigDepthCamera, progress: Progress
    ) -> Recording:
        """Return the recording of a camera without events."""
        taken = list(self._frames(name, sensor, progress))
        times = sensor.times(self.duration_s)
        frames = None
        depth = None
        if isinstance(sensor, RigFrameCamera):
            images = [frame.image for frame in taken if frame.image is not None]
            frames = MemoryImages(times, images, sensor.exposures(self.duration_s))
        else:
            depth = MemoryImages(times, [frame.depth for frame in taken if frame.depth is not None])
        camera = sensor.camera
        truth = Truth({}, labels=labels_of(self.world), poses=self._poses_of_frames(name, sensor))
        return Recording(
            MemoryEvents(Events.from_arrays([], [], [], []), camera.width, camera.height),
            camera,
            truth=truth,
            metadata=self._metadata_of(name),
            name=name,
            frames=frames,
            depth=depth,
        )

    def _sensor(self, name: str) -> RigCamera:
        """Return a sensor by name. Raises :class:`AmiwarpError` if the rig has no such sensor."""
        sensor = self.sensors.get(instance(name, str, "name of a sensor"))
        if sensor is None:
            raise AmiwarpError(
                f"rig has no sensor {shown(name)}; choose among {', '.join(self.sensors)}"
            )
        return sensor
