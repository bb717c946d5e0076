"""What the writers of a rig's layouts share: roles of the sensors, places, and notes for the user."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.other_sensors import ImuSamples
from amiwarp.events.recording import Recording
from amiwarp.events.rig_recording import RigRecording, SensorKind
from amiwarp.io.output_formats import Codec
from amiwarp.optics.camera import Camera
from amiwarp.tasks import Progress, silent

Matrix = NDArray[np.float64]

ROUNDED = (
    "compensated events of {} are rounded to whole pixels; events outside the image are left out"
)
"""Note of a layout that holds whole pixels, with the name of the sensor."""


@dataclass(slots=True)
class RigTask:
    """A rig that is written in another layout, with what the user gave, and what the writer has to say."""

    rig: RigRecording
    out: Path
    """Name of the finished folder or file, for messages."""
    codec: Codec = Codec.BLOSC
    """Compression of HDF5."""
    left: str | None = None
    """Name of the left camera that the user gave."""
    right: str | None = None
    """Name of the right camera that the user gave."""
    imu_noise: tuple[float, ...] | None = None
    """Noise density and random walk of the gyroscope, then of the accelerometer, in SI units."""
    imu_position: tuple[float, ...] | None = None
    """Place of the IMU in the frame of the camera that carries it [m]."""
    progress: Progress = silent
    roles: dict[str, str] = field(default_factory=dict)
    """Names of the sensors by what they are in the layout, such as ``cam0``."""
    notes: list[str] = field(default_factory=list)
    """What was assumed or changed, one sentence each."""
    left_out: set[str] = field(default_factory=set)
    """Parts of the rig that the layout does not hold."""

    def note(self, text: str) -> None:
        """Add a note, once."""
        if text not in self.notes:
            self.notes.append(text)

    def recording(self, name: str) -> Recording:
        """Return the recording of a sensor."""
        return self.rig[name].recording

    def camera(self, name: str) -> Camera:
        """Return the camera of a sensor. Raises :class:`AmiwarpError` if it is unknown."""
        camera = self.recording(name).camera
        if camera is None:
            raise AmiwarpError(
                f"{self.out}: the camera of {name} is unknown; add it to its recording: amiwarp convert --camera",
                ErrorCode.CONTENT_MISSING,
            )
        return camera

    def between(self, source: str, target: str) -> Matrix:
        """Return the matrix from the frame of one sensor to the frame of another, shape ``(4, 4)``."""
        return homogeneous(self.rig.between(source, target))

    def cameras(self, usable: Callable[[str], bool], what: str) -> tuple[str, str | None]:
        """Return the names of the left and the right camera among the usable ones; None for no right one.

        Without given names, these are the sensors called left and right, or the outermost ones along the x axis of the
        rig. ``what`` describes usable sensors. Raises :class:`AmiwarpError` if there are none, or a given one is not
        usable.
        """
        known = [name for name in self.rig.sensors if usable(name)]
        for name in (self.left, self.right):
            if name is not None:
                self.rig[name]  # an unknown name is refused with all known ones
                if name not in known:
                    raise AmiwarpError(
                        f"{self.out}: {name} is no sensor with {what}; choose another"
                    )
        if not known:
            raise AmiwarpError(
                f"{self.out}: no sensor of the rig has {what}; choose another format",
                ErrorCode.CONTENT_MISSING,
            )
        if self.left is not None and self.left == self.right:
            raise AmiwarpError(
                f"{self.out}: left and right are both {self.left}; give two sensors",
                ErrorCode.OPTIONS,
            )
        others = [name for name in known if name not in (self.left, self.right)]
        others.sort(key=lambda name: float(self.rig[name].to_rig[0, 3]))
        left = self.left
        if left is None:
            left = "left" if "left" in others else others[0] if others else None
        if left is None:
            raise AmiwarpError(
                f"{self.out}: the rig has no sensor with {what} but {self.right}; give it as the left one",
                ErrorCode.OPTIONS,
            )
        right = self.right
        others = [name for name in others if name != left]
        if right is None and others:
            right = "right" if "right" in others else others[-1]
        return left, right

    def imu_carrier(self) -> str | None:
        """Return the name of the first sensor whose recording has IMU samples, or None."""
        for name in self.rig.sensors:
            if self.recording(name).imu is not None:
                return name
        return None

    def imu_samples(self, carrier: str) -> ImuSamples:
        """Return the IMU samples of the sensor that carries the IMU, without those that lack a quantity."""
        imu = self.recording(carrier).imu
        assert imu is not None
        is_whole = np.isfinite(imu.angular_velocity).all(axis=1)
        is_whole &= np.isfinite(imu.acceleration).all(axis=1)
        if not is_whole.all():
            self.note(
                f"{np.count_nonzero(~is_whole)} IMU samples without acceleration or angular velocity are left out"
            )
        return ImuSamples(
            imu.t[is_whole],
            imu.angular_velocity[is_whole],
            imu.acceleration[is_whole],
            imu.to_camera,
        )

    def imu_rate_hz(self, carrier: str) -> float:
        """Return the mean rate of all samples of the IMU [Hz]; 0 for a single one."""
        imu = self.recording(carrier).imu
        assert imu is not None
        return imu.rate_hz or 0.0

    def imu_to_camera(self, carrier: str) -> Matrix:
        """Return the matrix from the IMU's frame to the frame of the camera that carries it, shape ``(4, 4)``."""
        imu = self.recording(carrier).imu
        assert imu is not None
        place = np.eye(4)
        if imu.to_camera is None:
            self.note("axes of the IMU assumed to be the camera's: they are not in the recording")
        else:
            place[:3, :3] = imu.to_camera
        if self.imu_position is None:
            self.note(
                f"place of the IMU assumed at the centre of {carrier}: it is not in the recording (--imu-position)"
            )
        else:
            place[:3, 3] = self.imu_position
        return place

    def imu_densities(self) -> dict[str, float]:
        """Return the noise of the IMU by Kalibr's and EuRoC's names; empty if it is unknown."""
        if self.imu_noise is None:
            self.note(
                "noise of the IMU is not in the recording, and left out of its file (--imu-noise)"
            )
            return {}
        names = (
            "gyroscope_noise_density",
            "gyroscope_random_walk",
            "accelerometer_noise_density",
            "accelerometer_random_walk",
        )
        return dict(zip(names, self.imu_noise, strict=True))


def has_events(task: RigTask, name: str) -> bool:
    """Return whether a sensor records events."""
    return task.rig[name].kind is SensorKind.EVENTS


def has_frames(task: RigTask, name: str) -> bool:
    """Return whether a sensor has frames."""
    return task.recording(name).frames is not None


def homogeneous(matrix: Matrix) -> Matrix:
    """Return a matrix of the shape ``(3, 4)`` with the row 0, 0, 0, 1."""
    return np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])


def pose_matrices(poses: Matrix) -> Matrix:
    """Return poses (x, y, z, quaternion x, y, z, w), shape ``(k, 7)``, as matrices of the shape ``(k, 4, 4)``."""
    from scipy.spatial.transform import Rotation

    matrices = np.zeros((len(poses), 4, 4))
    matrices[:, :3, :3] = Rotation.from_quat(poses[:, 3:]).as_matrix()
    matrices[:, :3, 3] = poses[:, :3]
    matrices[:, 3, 3] = 1.0
    return matrices
