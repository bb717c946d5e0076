"""Folder in the stereo layout of DSEC: events left and right, frames left and right, and the calibration of all four.

Source: `data format of DSEC <https://dsec.ifi.uzh.ch/data-format/>`_. The cameras are cam0 (events, left), cam1
(frames, left), cam2 (frames, right) and cam3 (events, right). ``T_XY`` turns points of camY into the frame of camX.
``R_rectX`` turns points of camX into the frame of the rectified camera camRectX.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.rig_recording import SensorKind
from amiwarp.io.camera_files import kalibr_camera
from amiwarp.io.export import export
from amiwarp.io.output_formats import OutputFormat, Rounding
from amiwarp.io.rig_formats.files import write_yaml
from amiwarp.io.rig_formats.pictures import eight_bits, png_bytes
from amiwarp.io.rig_formats.rectification import Rectified, rectify
from amiwarp.io.rig_formats.task import ROUNDED, Matrix, RigTask, has_events, has_frames

NUMBERS = {"cam0": 0, "cam1": 1, "cam2": 2, "cam3": 3}
"""Numbers of the cameras."""

PAIRS = (("cam0", "cam3"), ("cam1", "cam2"))
"""Left and right camera of the pairs that are rectified together."""


def write_dsec_rig(task: RigTask, folder: Path) -> None:
    """Write ``events``, ``images`` and ``calibration``."""
    left, right = task.cameras(lambda name: has_events(task, name), "events")
    task.roles["cam0"] = left
    if right is not None:
        task.roles["cam3"] = right
    task.roles |= _frame_roles(task, left, right)
    _note_left_out(task)
    rectified: dict[str, tuple[Rectified, Matrix]] = {}
    for first, second in PAIRS:
        if first in task.roles and second in task.roles:
            pair = rectify(task, task.roles[first], task.roles[second])
            rectified[first] = pair, pair.left
            rectified[second] = pair, pair.right
    for camera, side in (("cam0", "left"), ("cam3", "right")):
        if camera in task.roles:
            _write_events(task, folder / "events" / side, camera, rectified.get(camera))
    for camera, side in (("cam1", "left"), ("cam2", "right")):
        if camera in task.roles:
            _write_images(task, folder / "images" / side, camera, rectified.get(camera))
    _write_image_times(task, folder / "images" / "timestamps.txt")
    write_yaml(folder / "calibration" / "cam_to_cam.yaml", calibration(task, rectified))


def _frame_roles(task: RigTask, left: str, right: str | None) -> dict[str, str]:
    """Return the cameras of frames: the sensors of frames, or the event cameras themselves if these have frames."""
    names = [name for name in task.rig.sensors if task.rig[name].kind is SensorKind.FRAMES]
    names.sort(key=lambda name: float(task.rig[name].to_rig[0, 3]))
    if not names:
        names = [name for name in (left, right) if name is not None and has_frames(task, name)]
    if len(names) > 1 and task.between(names[1], names[0])[0, 3] <= 0.0:
        task.note(
            f"{names[1]} does not lie to the right of {names[0]}: only the frames of {names[0]} are written"
        )
        names = names[:1]
    return dict(zip(("cam1", "cam2"), names, strict=False))


def _note_left_out(task: RigTask) -> None:
    """Note what the layout does not hold."""
    used = set(task.roles.values())
    for name in task.rig.sensors:
        recording = task.recording(name)
        if name not in used:
            task.left_out.add(f"sensor {name}")
        parts = {
            "IMU samples": recording.imu,
            "encoder": recording.encoder,
            "depth maps": recording.depth,
            "ground truth": recording.truth,
        }
        task.left_out |= {what for what, value in parts.items() if value is not None}


def _write_events(
    task: RigTask, folder: Path, camera: str, rectified: tuple[Rectified, Matrix] | None
) -> None:
    """Write the events of a camera, and the map of their rectified positions if it is one of a pair."""
    import h5py

    folder.mkdir(parents=True)
    name = task.roles[camera]
    events = task.recording(name).events
    is_compensated = len(events) > 0 and not events.slice(0, 1).whole_pixels
    if is_compensated:
        task.note(ROUNDED.format(name))
    export(
        events,
        folder / "events.h5",
        OutputFormat.DSEC,
        events.size,
        codec=task.codec,
        progress=task.progress,
        overwrite=False,
        rounding=Rounding.NEAREST if is_compensated else None,
    )
    if rectified is None:
        return
    pair, rotation = rectified
    with h5py.File(folder / "rectify_map.h5", "w") as file:
        places = pair.map_of(task.camera(name), rotation)
        file.create_dataset("rectify_map", data=places, compression="gzip", shuffle=True)


def _write_images(
    task: RigTask, folder: Path, camera: str, rectified: tuple[Rectified, Matrix] | None
) -> None:
    """Write the frames of a camera as it recorded them, and rectified if it is one of a pair; and the exposures."""
    name = task.roles[camera]
    frames = task.recording(name).frames
    assert frames is not None
    (folder / "distorted").mkdir(parents=True)
    if rectified is not None:
        (folder / "rectified").mkdir()
    for index, image in enumerate(frames):
        if image.dtype != np.uint8:
            task.note(f"frames of {name} have 16 bits: the upper 8 are written")
        file = f"{index:06d}.png"
        short = eight_bits(image)
        (folder / "distorted" / file).write_bytes(png_bytes(short))
        if rectified is not None:
            pair, rotation = rectified
            seen = pair.image_of(short, task.camera(name), rotation)
            (folder / "rectified" / file).write_bytes(png_bytes(seen))
        task.progress("writing frames", (index + 1) / len(frames))
    if frames.exposure is None:
        task.note(f"exposures of {name} are unknown: no exposure_timestamps.txt")
        return
    lines = ["# exposure_start_timestamp_us, exposure_end_timestamp_us"]
    lines += [f"{begin}, {end}" for begin, end in frames.exposure.tolist()]
    _write_lines(folder / "exposure_timestamps.txt", lines)


def _write_image_times(task: RigTask, path: Path) -> None:
    """Write the times of the frames, which are the same for left and right in DSEC."""
    times: list[NDArray[np.int64]] = []
    for camera in ("cam1", "cam2"):
        frames = task.recording(task.roles[camera]).frames if camera in task.roles else None
        if frames is not None:
            times.append(frames.t)
    if not times:
        return
    if not all(np.array_equal(times[0], t) for t in times):
        task.note(
            "frames of left and right have other times: images/timestamps.txt has the times of the left ones"
        )
    _write_lines(path, [str(t) for t in times[0].tolist()])


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")


def calibration(task: RigTask, rectified: dict[str, tuple[Rectified, Matrix]]) -> dict[str, Any]:
    """Return the content of ``cam_to_cam.yaml``."""
    cameras = sorted(task.roles, key=lambda camera: NUMBERS[camera])
    intrinsics: dict[str, Any] = {}
    extrinsics: dict[str, Any] = {}
    for camera in cameras:
        fields = kalibr_camera(task.camera(task.roles[camera]))
        intrinsics[camera] = {
            "camera_model": fields["camera_model"],
            "camera_matrix": fields["intrinsics"],
            "distortion_model": fields["distortion_model"].replace("none", "radtan"),
            "distortion_coeffs": fields["distortion_coeffs"] or [0.0] * 4,
            "resolution": fields["resolution"],
        }
    for camera, (pair, _) in rectified.items():
        intrinsics[camera.replace("cam", "camRect")] = {
            "camera_model": "pinhole",
            "camera_matrix": pair.intrinsics,
            "resolution": list(intrinsics[camera]["resolution"]),
        }
    for before, camera in itertools.pairwise(cameras):
        moved = task.between(task.roles[before], task.roles[camera])
        extrinsics[f"T_{NUMBERS[camera]}{NUMBERS[before]}"] = moved.tolist()
    for camera, (_, rotation) in rectified.items():
        extrinsics[f"R_rect{NUMBERS[camera]}"] = rotation.tolist()
    depths = {}
    for first, second in PAIRS:
        if first in rectified:
            pair, _ = rectified[first]
            name = f"cams_{NUMBERS[first]}{NUMBERS[second]}"
            depths[name] = pair.disparity_to_depth().tolist()
    return {"intrinsics": intrinsics, "extrinsics": extrinsics, "disparity_to_depth": depths}
