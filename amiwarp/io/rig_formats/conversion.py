"""Conversion of a recorded rig to the layouts of public data sets, of Kalibr and of ROS."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from amiwarp.errors import AmiwarpError, ErrorCode, Option
from amiwarp.events.rig_recording import RigRecording
from amiwarp.io.formats import io_function
from amiwarp.io.inputs import errors_name
from amiwarp.io.output_formats import FILE_ENDINGS, Codec, check_ending
from amiwarp.io.outputs import NewFile
from amiwarp.io.rig_files import open_rig
from amiwarp.io.rig_formats.task import RigTask
from amiwarp.io.unfinished import scratch_folder
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress, silent
from amiwarp.validation import choice, instance, real, vector


class RigFormat(Option):
    """Layouts to which a rig is converted.

    Examples
    --------
    >>> amiwarp.RigFormat("euroc")
    <RigFormat.EUROC: 'euroc'>
    """

    DSEC = "dsec"
    """Folder in the stereo layout of DSEC: events, images and cam_to_cam.yaml."""
    MVSEC = "mvsec"
    """Folder with the HDF5 files of MVSEC, and its calibration."""
    EUROC = "euroc"
    """Folder mav0 of the EuRoC MAV data set: frames, IMU and true states."""
    KALIBR = "kalibr"
    """Folder for kalibr_bagcreater, with camchain-imucam.yaml and imu.yaml."""
    ROS1 = "ros1"
    """ROS 1 bag (.bag) with all topics."""
    ROS2 = "ros2"
    """ROS 2 bag (.mcap or .db3) with all topics."""


WRITERS = {
    RigFormat.DSEC: "rig_formats.dsec:write_dsec_rig",
    RigFormat.MVSEC: "rig_formats.mvsec:write_mvsec_rig",
    RigFormat.EUROC: "rig_formats.euroc:write_euroc",
    RigFormat.KALIBR: "rig_formats.kalibr:write_kalibr",
    RigFormat.ROS1: "rig_formats.ros:write_ros1_rig",
    RigFormat.ROS2: "rig_formats.ros:write_ros2_rig",
}
"""Function that writes a rig in each layout, see :func:`io_function`."""

ENDINGS = {RigFormat.ROS1: (".bag",), RigFormat.ROS2: (".mcap", ".db3")}
"""File extensions of the layouts that are one file."""


@guarded
@dataclass(frozen=True, slots=True)
class RigConversionSummary:
    """Summary of the conversion of a rig.

    Examples
    --------
    >>> amiwarp.RigConversionSummary(amiwarp.RigFormat.ROS1, 1, {}, (), ("encoder",)).left_out
    ('encoder',)
    """

    format: RigFormat
    """Layout that was written."""
    files: int
    """Number of written files."""
    roles: dict[str, str]
    """Names of the sensors by what they are in the layout, such as ``cam0``."""
    notes: tuple[str, ...]
    """What was assumed or changed."""
    left_out: tuple[str, ...]
    """Parts of the rig that the layout does not hold."""


@guarded
def convert_rig(
    rig: RigRecording | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    format: RigFormat | str | None = None,
    left: str | None = None,
    right: str | None = None,
    imu_noise: tuple[float, float, float, float] | None = None,
    imu_position: tuple[float, float, float] | None = None,
    codec: Codec | str = Codec.BLOSC,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> RigConversionSummary:
    """Convert a rig to a layout of other programs.

    Parameters
    ----------
    rig : RigRecording, str or path-like
        The rig, or its folder.
    out : str or path-like
        What to write: a new folder, or for ROS a file that ends in ``.bag``, ``.mcap`` or ``.db3``.
    format : RigFormat or str, optional
        The layout. It may be left out for ROS.
    left, right : str, optional
        Names of the left and the right camera. By default, the sensors of these names, or the outermost ones along the
        rig's x axis.
    imu_noise : tuple of float, optional
        Noise of the IMU for Kalibr and EuRoC: density [rad/s/sqrt(Hz)] and random walk [rad/s^2/sqrt(Hz)] of the
        gyroscope, then density [m/s^2/sqrt(Hz)] and random walk [m/s^3/sqrt(Hz)] of the accelerometer.
    imu_position : tuple of float, optional
        Place of the IMU in the frame of the camera that carries it [m]. By default, the camera's centre.
    codec : Codec or str, default "blosc"
        Compression of HDF5. Programs without HDF5's Blosc filter read ``"gzip"``.
    overwrite : bool, default False
        Whether an existing file may be replaced. An existing folder is never replaced.
    progress : callable, optional
        Called with the name of the step and its finished fraction, 0 to 1.

    Returns
    -------
    RigConversionSummary
        What was written, assumed and left out.

    Raises
    ------
    AmiwarpError
        If the rig cannot be read, lacks what the layout needs, or the output exists or cannot be written. Then no
        output remains.

    Examples
    --------
    >>> import numpy as np
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(events, amiwarp.Camera.from_fov(4, 4, 1.0))
    >>> shifted = np.eye(3, 4)
    >>> shifted[0, 3] = 0.1
    >>> rig = amiwarp.RigRecording({
    ...     "left": amiwarp.RigSensor("events", recording, np.eye(3, 4)),
    ...     "right": amiwarp.RigSensor("events", recording, shifted)})
    >>> amiwarp.convert_rig(rig, "sequence", format="dsec").roles
    {'cam0': 'left', 'cam3': 'right'}
    """
    out = Path(out)
    chosen = rig_format(out, format)
    for side, name in (("left", left), ("right", right)):
        if name is not None:
            instance(name, str, side)
    task = RigTask(
        rig=rig if isinstance(rig, RigRecording) else open_rig(rig),
        out=out,
        codec=choice(Codec, codec, f"{out}: codec"),
        left=left,
        right=right,
        imu_noise=None if imu_noise is None else vector(imu_noise, 4, "imu_noise", _not_negative),
        imu_position=None
        if imu_position is None
        else vector(imu_position, 3, "imu_position", real),
        progress=progress or silent,
    )
    write: Callable[[RigTask, Path], None] = io_function(WRITERS[chosen])
    if chosen in ENDINGS:
        if (left, right) != (None, None):
            raise AmiwarpError(
                f"{out}: a bag holds all sensors; leave out left and right", ErrorCode.OPTIONS
            )
        with NewFile(out, overwrite=overwrite) as new, errors_name(out, lambda: "writing the bag"):
            write(task, new.part)
        files = 1
    else:
        files = _write_folder(task, write)
    return RigConversionSummary(
        chosen, files, task.roles, tuple(task.notes), tuple(sorted(task.left_out))
    )


def rig_format(out: Path, given: RigFormat | str | None) -> RigFormat:
    """Return the layout to write: the given one, or the one of the extension.

    Raises :class:`AmiwarpError` for an extension that means none, or that files of the given layout do not have.
    """
    if given is None:
        ending = out.suffix.lower()
        for format, endings in ENDINGS.items():
            if ending in endings:
                return format
        raise AmiwarpError(
            f"{out}: is no bag of ROS (.bag, .mcap, .db3); give the format of the folder: dsec, mvsec, euroc or kalibr",
            ErrorCode.OPTIONS,
        )
    chosen = choice(RigFormat, given, f"{out}: format of a rig")
    if chosen in ENDINGS:
        check_ending(out, f"rigs in the format {chosen.value} are written", ENDINGS[chosen])
    return chosen


def _not_negative(value: object, what: str) -> float:
    return real(value, what, 0.0)


def _write_folder(task: RigTask, write: Callable[[RigTask, Path], None]) -> int:
    """Write a new folder, complete or not at all, and return the number of its files."""
    out = task.out
    if out.suffix.lower() in FILE_ENDINGS:
        raise AmiwarpError(
            f"{out}: is for a folder, but ends in {out.suffix}; give the name of a folder",
            ErrorCode.OPTIONS,
        )
    if os.path.lexists(out):
        raise AmiwarpError(f"{out}: exists; give the name of a new folder", ErrorCode.OUTPUT_EXISTS)
    if not out.absolute().parent.is_dir():
        raise AmiwarpError(
            f"{out}: its folder {out.absolute().parent} does not exist; create it first",
            ErrorCode.OUTPUT_FAILED,
        )
    with (
        errors_name(out, lambda: "writing the rig"),
        scratch_folder(out.absolute().parent) as scratch,
    ):
        part = scratch / "rig"
        part.mkdir()
        write(task, part)
        files = sum(path.is_file() for path in part.rglob("*"))
        os.rename(part, out)
    return files
