"""Rig of several cameras in a simulated world, on one body and one clock."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MetadataValue
from amiwarp.optics.prism import Prism
from amiwarp.schema.calls import guarded
from amiwarp.simulation.motion import LONGEST_S
from amiwarp.simulation.rigs.cameras import RigCamera, RigEventCamera
from amiwarp.simulation.rigs.paper_platform import APEX, VGA, paper_platform
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.mounted_trajectory import MountedTrajectory
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World
from amiwarp.simulation.worlds.world_choice import open_world
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.validation import instance, real, shown, whole

SENSOR_NAME = r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}"
"""Names of sensors, as they are also names of files."""


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
        whole(self.seed, "seed", 0, (1 << 31) - 1)
        if not self.sensors:
            raise AmiwarpError("the rig has no sensors; give at least one camera")
        known: dict[str, str] = {}
        for name, sensor in self.sensors.items():
            if not isinstance(name, str) or not re.fullmatch(SENSOR_NAME, name):
                raise AmiwarpError(
                    f"rig has a sensor named {shown(name)}; give up to 64 letters, digits, '-' and '_'"
                )
            other = known.setdefault(name.lower(), name)
            if other != name:
                raise AmiwarpError(
                    f"rig has sensors named {other!r} and {name!r}; give names that differ in more than case"
                )
            if not isinstance(sensor, RigCamera):
                raise AmiwarpError(
                    f"rig's sensor {name!r} is {shown(sensor)}; expected a RigEventCamera, RigFrameCamera or "
                    "RigDepthCamera"
                )
            if isinstance(sensor, RigEventCamera):
                self._check_simulation(name)

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
        of_world, way = open_world(world, trajectory, seed=seed, duration_s=duration_s)
        return cls(of_world, way, paper_platform(size, apex), duration_s, seed, device)

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

    def _sensor(self, name: str) -> RigCamera:
        """Return a sensor by name. Raises :class:`AmiwarpError` if the rig has no such sensor."""
        sensor = self.sensors.get(name)
        if sensor is None:
            raise AmiwarpError(
                f"rig has no sensor {shown(name)}; choose among {', '.join(self.sensors)}"
            )
        return sensor
