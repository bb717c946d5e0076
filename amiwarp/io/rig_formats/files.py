"""Files that several layouts of rigs have: YAML, tables of the inertial sensor, and Kalibr's chain of cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from amiwarp.events.other_sensors import ImuSamples
from amiwarp.io.camera_files import kalibr_camera
from amiwarp.io.rig_formats.task import Matrix, RigTask


def write_yaml(path: Path, data: dict[str, Any]) -> None:
    """Write a YAML file with short lists in one line."""
    import yaml

    path.parent.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=1000)
    path.write_text(text, encoding="utf-8", newline="\n")


def padded_ns(t_us: int) -> str:
    """Return a time [us] in nanoseconds, with zeros before it to 19 digits.

    Programs that read Kalibr's folders take the last nine digits for the part of a second, and sort names as texts.
    """
    return f"{1000 * t_us:019d}"


def frame_file(t_us: int) -> str:
    """Return the name of the file of a frame at a time [us]."""
    return f"{padded_ns(t_us)}.png"


def write_imu_table(path: Path, header: str, imu: ImuSamples) -> None:
    """Write IMU samples as rows of time [ns], angular velocity [rad/s] and acceleration [m/s^2]."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(header + "\n")
        for t, turning, force in zip(
            imu.t.tolist(), imu.angular_velocity.tolist(), imu.acceleration.tolist(), strict=True
        ):
            numbers = ",".join(repr(value) for value in (*turning, *force))
            file.write(f"{padded_ns(t)},{numbers}\n")


def camera_chain(task: RigTask, names: Sequence[str], carrier: str | None) -> dict[str, Any]:
    """Return the cameras as Kalibr's chain: each with its place after the one before, and after the IMU."""
    chain: dict[str, Any] = {}
    for index, name in enumerate(names):
        fields = kalibr_camera(task.camera(name))
        if index:
            fields["T_cn_cnm1"] = task.between(names[index - 1], name).tolist()
        if carrier is not None:
            fields["T_cam_imu"] = camera_from_imu(task, name, carrier).tolist()
            fields["timeshift_cam_imu"] = 0.0
        fields["cam_overlaps"] = [other for other in range(len(names)) if other != index]
        fields["rostopic"] = f"/cam{index}/image_raw"
        chain[f"cam{index}"] = fields
    return chain


def camera_from_imu(task: RigTask, name: str, carrier: str) -> Matrix:
    """Return the matrix from the IMU's frame to the frame of a camera, shape ``(4, 4)``."""
    return task.between(carrier, name) @ task.imu_to_camera(carrier)
