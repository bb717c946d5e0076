"""HDF5 files in the layout of MVSEC: events, frames and IMU of two DAVIS cameras, and depth and poses of the left one.

Sources: `MVSEC's page of downloads <https://daniilidis-group.github.io/mvsec/download/>`_ and its `converter
<https://github.com/daniilidis-group/mvsec/tree/master/tools>`_. Events are rows of x, y, time [s] and polarity (1 or
-1). A row of ``imu`` has the acceleration, then the angular velocity. The times of what NAME holds are ``NAME_ts`` [s].
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.events.other_sensors import ImageStore
from amiwarp.events.recording import Events, Recording
from amiwarp.io.hdf5.datasets import make_dataset
from amiwarp.io.rig_formats.files import camera_chain, write_yaml
from amiwarp.io.rig_formats.pictures import eight_bits, grey
from amiwarp.io.rig_formats.task import RigTask, has_events, pose_matrices

ROWS = 1 << 16
"""Number of rows per HDF5 chunk of events."""


def write_mvsec_rig(task: RigTask, folder: Path) -> None:
    """Write ``NAME_data.hdf5``, ``NAME_gt.hdf5`` and ``camchain-imucam-NAME.yaml``, with the name of the folder."""
    import h5py

    left, right = task.cameras(lambda name: has_events(task, name), "events")
    task.roles["davis/left"] = left
    if right is not None:
        task.roles["davis/right"] = right
    folder.mkdir(parents=True, exist_ok=True)
    name = task.out.name
    with h5py.File(folder / f"{name}_data.hdf5", "w") as file:
        for group, sensor in task.roles.items():
            _write_davis(task, file, group, sensor)
    _write_truth(task, folder / f"{name}_gt.hdf5", left)
    chain = camera_chain(task, list(task.roles.values()), task.imu_carrier())
    write_yaml(folder / f"camchain-imucam-{name}.yaml", chain)
    for sensor in task.rig.sensors:
        if sensor not in task.roles.values():
            task.left_out.add(f"sensor {sensor}")
        if task.recording(sensor).encoder is not None:
            task.left_out.add("encoder")


def _write_davis(task: RigTask, file: Any, group: str, name: str) -> None:
    """Write events, frames and IMU samples of a camera."""
    recording = task.recording(name)
    events = make_dataset(file, f"{group}/events", np.float64, (4,), ROWS, task.codec)
    written = 0
    for block in recording.events.blocks():
        events.resize(written + len(block), axis=0)
        events[written:] = event_rows(block)
        written += len(block)
        task.progress("writing events", written / len(recording.events))
    if recording.frames is not None:
        _write_frames(task, file, group, name, recording, recording.frames)
    if recording.imu is not None:
        imu = task.imu_samples(name)
        file[f"{group}/imu"] = np.concatenate([imu.acceleration, imu.angular_velocity], axis=1)
        file[f"{group}/imu_ts"] = imu.t * 1e-6


def event_rows(events: Events) -> Any:
    """Return events as rows of x, y, time [s] and polarity, shape ``(n, 4)``."""
    polarity = np.where(events.p == 1, 1.0, -1.0)
    return np.stack([events.x, events.y, events.t * 1e-6, polarity], axis=1)


def _write_frames(
    task: RigTask, file: Any, group: str, name: str, recording: Recording, frames: ImageStore
) -> None:
    """Write the frames of a camera, with the number of the event that is nearest in time to each."""
    width, height = frames.size
    images = make_dataset(file, f"{group}/image_raw", np.uint8, (height, width), 1, task.codec)
    images.resize(len(frames), axis=0)
    for index, image in enumerate(frames):
        if image.dtype != np.uint8:
            task.note(f"frames of {name} have 16 bits: the upper 8 are written")
        if image.ndim == 3:
            task.note(f"frames of {name} are in colour: their luma is written")
        images[index] = grey(eight_bits(image))
    file[f"{group}/image_raw_ts"] = frames.t * 1e-6
    nearest = [_nearest_event(recording, t) for t in frames.t.tolist()]
    file[f"{group}/image_raw_event_inds"] = np.array(nearest, np.int64)
    if frames.exposure is not None:
        task.left_out.add("exposures")


def _nearest_event(recording: Recording, t_us: int) -> int:
    """Return the index of the event that is nearest to a time; -1 without events."""
    events = recording.events
    following = events.find(t_us)
    near = events[max(following - 1, 0) : following + 1]
    if not len(near):
        return -1
    return max(following - 1, 0) + int(np.argmin(np.abs(near.t - t_us)))


def _write_truth(task: RigTask, path: Path, left: str) -> None:
    """Write true depth and poses of the left camera, if its recording has some."""
    import h5py

    recording = task.recording(left)
    truth = recording.truth
    stores: Any = None
    if recording.depth is not None:
        stores = recording.depth.t, recording.depth
    elif truth is not None and truth.frames is not None:
        stores = truth.frames.t, (frame.depth for frame in truth.frames)
    has_poses = truth is not None and truth.poses is not None
    if stores is None and not has_poses:
        task.note(f"no ground truth: the recording of {left} has neither depth nor poses")
        return
    with h5py.File(path, "w") as file:
        if stores is not None:
            times, maps = stores
            for index, depth in enumerate(maps):
                height, width = depth.shape
                name = "davis/left/depth_image_raw"
                if not index:
                    stored = make_dataset(file, name, np.float32, (height, width), 1, task.codec)
                    stored.resize(len(times), axis=0)
                # MVSEC's maps are NaN where the depth is not known.
                stored[index] = np.where(np.isfinite(depth), depth, np.nan)
            file["davis/left/depth_image_raw_ts"] = np.asarray(times, np.int64) * 1e-6
        if truth is not None and truth.poses is not None:
            poses = truth.poses[:]
            file["davis/left/pose"] = pose_matrices(poses.camera)
            file["davis/left/pose_ts"] = poses.t * 1e-6
