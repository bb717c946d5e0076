"""Folder in the layout of the EuRoC MAV data set (also called ASL): cameras, IMU and true states.

Source: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016, and the files of the data set. ``T_BS``
turns points of the sensor's frame into the body's frame, which is the frame of the IMU. Times are in nanoseconds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.other_sensors import mean_rate
from amiwarp.io.camera_files import kalibr_camera
from amiwarp.io.rig_formats.files import (
    camera_from_imu,
    frame_file,
    write_imu_table,
    write_yaml,
)
from amiwarp.io.rig_formats.kalibr import frame_cameras, write_frames
from amiwarp.io.rig_formats.task import RigTask, pose_matrices

MODELS = {"none": "radial-tangential", "radtan": "radial-tangential", "equidistant": "equidistant"}
"""EuRoC's names of the distortion models, by Kalibr's."""

IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
"""First line of the table of the IMU."""

STATE_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], "
    "b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], "
    "b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)
"""First line of the table of true states."""


def write_euroc(task: RigTask, folder: Path) -> None:
    """Write ``mav0`` with ``cam0`` ..., ``imu0`` and ``state_groundtruth_estimate0``."""
    mav = folder / "mav0"
    names = frame_cameras(task)
    carrier = task.imu_carrier()
    write_frames(task, names, [mav / f"cam{index}" / "data" for index in range(len(names))])
    for index, name in enumerate(names):
        _write_camera(task, mav / f"cam{index}", name, names[0], carrier)
    write_yaml(mav / "body.yaml", {"comment": f"rig {task.rig.name}, written by amiwarp"})
    if carrier is not None:
        imu = task.imu_samples(carrier)
        write_imu_table(mav / "imu0" / "data.csv", IMU_HEADER, imu)
        about = {
            "sensor_type": "imu",
            "comment": f"IMU of {carrier}",
            "T_BS": _matrix(np.eye(4)),
            "rate_hz": task.imu_rate_hz(carrier),
            **task.imu_densities(),
        }
        write_yaml(mav / "imu0" / "sensor.yaml", about)
    else:
        task.note(f"frame of the body is the frame of {names[0]}: the rig has no IMU")
    _write_states(task, mav / "state_groundtruth_estimate0", names[0], carrier)


def _write_camera(task: RigTask, folder: Path, name: str, first: str, carrier: str | None) -> None:
    """Write the list of the frames and the calibration of a camera."""
    frames = task.recording(name).frames
    assert frames is not None
    lines = ["#timestamp [ns],filename"]
    lines += [f"{1000 * t},{frame_file(t)}" for t in frames.t.tolist()]
    (folder / "data.csv").write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")
    lens = kalibr_camera(task.camera(name))
    to_camera = task.between(first, name)
    if carrier is not None:
        to_camera = camera_from_imu(task, name, carrier)
    about: dict[str, Any] = {
        "sensor_type": "camera",
        "comment": name,
        "T_BS": _matrix(np.linalg.inv(to_camera)),
        "rate_hz": mean_rate(frames.t) or 0.0,
        "resolution": lens["resolution"],
        "camera_model": "pinhole",
        "intrinsics": lens["intrinsics"],
        "distortion_model": MODELS[lens["distortion_model"]],
        "distortion_coefficients": lens["distortion_coeffs"] or [0.0] * 4,
    }
    write_yaml(folder / "sensor.yaml", about)


def _matrix(values: NDArray[np.floating[Any]]) -> dict[str, Any]:
    """Return a matrix as the files hold it."""
    rows, columns = values.shape
    return {"cols": columns, "rows": rows, "data": values.ravel().tolist()}


def _write_states(task: RigTask, folder: Path, first: str, carrier: str | None) -> None:
    """Write the true states of the body, from the true poses of the camera that carries the IMU, or of the first."""
    from scipy.spatial.transform import Rotation

    name = carrier or first
    truth = task.recording(name).truth
    if truth is None or truth.poses is None or len(truth.poses) < 2:
        task.note(f"no true states: the recording of {name} has no true poses")
        return
    poses = truth.poses[:]
    to_camera = np.eye(4) if carrier is None else task.imu_to_camera(carrier)
    body = pose_matrices(poses.camera) @ to_camera
    position = body[:, :3, 3]
    quaternions = Rotation.from_matrix(body[:, :3, :3]).as_quat()
    velocity = np.gradient(position, poses.t * 1e-6, axis=0)
    task.note("velocities of the true states are differences of positions, and the biases are 0")
    rows = np.concatenate([position, quaternions[:, [3, 0, 1, 2]], velocity], axis=1)
    folder.mkdir(parents=True)
    with open(folder / "data.csv", "w", encoding="ascii", newline="\n") as file:
        file.write(STATE_HEADER + "\n")
        for t, row in zip(poses.t.tolist(), rows.tolist(), strict=True):
            numbers = ",".join(repr(value) for value in (*row, *[0.0] * 6))
            file.write(f"{1000 * t},{numbers}\n")
    about = {"sensor_type": "groundtruth", "comment": "simulated", "T_BS": _matrix(np.eye(4))}
    write_yaml(folder / "sensor.yaml", about)
