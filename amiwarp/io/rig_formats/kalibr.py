"""Folder for Kalibr: pictures and IMU samples as kalibr_bagcreater reads them, and the chain of cameras and IMU.

Sources: Kalibr's wiki, pages `Bag format <https://github.com/ethz-asl/kalibr/wiki/bag-format>`_ and `YAML formats
<https://github.com/ethz-asl/kalibr/wiki/yaml-formats>`_.
"""

from __future__ import annotations

from pathlib import Path

from amiwarp.io.rig_formats.files import camera_chain, frame_file, write_imu_table, write_yaml
from amiwarp.io.rig_formats.pictures import png_bytes
from amiwarp.io.rig_formats.task import RigTask, has_frames


def write_kalibr(task: RigTask, folder: Path) -> None:
    """Write ``cam0`` ..., ``imu0.csv``, ``camchain-imucam.yaml`` and ``imu.yaml``."""
    names = frame_cameras(task)
    carrier = task.imu_carrier()
    write_frames(task, names, [folder / f"cam{index}" for index in range(len(names))])
    name = "camchain.yaml" if carrier is None else "camchain-imucam.yaml"
    write_yaml(folder / name, camera_chain(task, names, carrier))
    if carrier is None:
        return
    imu = task.imu_samples(carrier)
    header = "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z"
    write_imu_table(folder / "imu0.csv", header, imu)
    about = {"rostopic": "/imu0", "update_rate": task.imu_rate_hz(carrier)}
    write_yaml(folder / "imu.yaml", {**task.imu_densities(), **about})


def frame_cameras(task: RigTask) -> list[str]:
    """Return the sensors with frames: left, right, then the others. Notes their roles and what is left out."""
    left, right = task.cameras(lambda name: has_frames(task, name), "frames")
    first = [name for name in (left, right) if name is not None]
    others = [name for name in task.rig.sensors if has_frames(task, name) and name not in first]
    names = [*first, *others]
    task.roles |= {f"cam{index}": name for index, name in enumerate(names)}
    carrier = task.imu_carrier()
    for name in task.rig.sensors:
        if name != carrier and task.recording(name).imu is not None:
            task.left_out.add(f"IMU samples of {name}")
    if any(len(task.recording(name).events) for name in task.rig.sensors):
        task.left_out.add("events")
    if any(task.recording(name).depth is not None for name in task.rig.sensors):
        task.left_out.add("depth maps")
    return names


def write_frames(task: RigTask, names: list[str], folders: list[Path]) -> None:
    """Write the frames of each camera to its folder, see :func:`frame_file`."""
    for index, (name, folder) in enumerate(zip(names, folders, strict=True)):
        folder.mkdir(parents=True, exist_ok=True)
        frames = task.recording(name).frames
        assert frames is not None
        if frames.exposure is not None:
            task.left_out.add("exposures")
        for number, (t, image) in enumerate(zip(frames.t.tolist(), frames, strict=True)):
            (folder / frame_file(t)).write_bytes(png_bytes(image))
            task.progress("writing frames", (index + (number + 1) / len(frames)) / len(names))
