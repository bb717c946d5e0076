"""Content and files of recordings: ``amiwarp info``, ``amiwarp convert`` and ``amiwarp truth``."""

import contextlib
import math
import re
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import (
    Recording,
)
from amiwarp.events.truth import Truth
from amiwarp.io import convert, description, open_recording
from amiwarp.io.description_table import table_rows
from amiwarp.io.opening import head_only
from amiwarp.io.output_formats import EXTENSION_HELP, Codec, make_folder
from amiwarp.io.rig_description import describe_rig, rig_rows
from amiwarp.io.rig_files import is_rig, open_rig
from amiwarp.io.rig_formats.conversion import convert_rig
from amiwarp.io.truth_files import save_flow_dsec, save_flow_mvsec, save_poses_tum

LARGE_BYTES = 1 << 28
"""Size at which files are read only in part, unless --count is given [bytes]."""


def run_info(
    file: Annotated[
        Path,
        typer.Argument(
            help="Recording in any supported format, folder of a rig, or camera: to list the connected cameras."
        ),
    ],
    *,
    count: Annotated[
        bool,
        typer.Option(
            "--count",
            help="Read all of a large file, to count its events instead of estimating them.",
        ),
    ] = False,
    topic: cli.Topic = None,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Show a recording's format, events, encoder, camera, prism, IMU, frames, truth, repairs and assumptions.

    Of a rig it shows the sensors, their places, and whether their times overlap.

    Files of up to 256 MiB are read once, in blocks. Of larger files only the first 4 million events and the end are
    read, unless --count is given. Figures that are then estimates are marked as such.
    """
    if str(file) == "camera:":
        _report_cameras(common)
        return
    if is_rig(file):
        of_rig = describe_rig(open_rig(file), str(file))
        cli.report(common, of_rig, [cli.table(rig_rows(of_rig))])
        return
    is_large = not count and _file_bytes(file) > LARGE_BYTES
    with contextlib.ExitStack() as reading:
        if is_large:
            reading.enter_context(head_only(description.HEAD_EVENTS))
        recording = open_recording(file, topic=topic, **layout.given())
    with cli.progress("reading") as advance:
        data = description.describe(recording, str(file), head=is_large, progress=advance)
    cli.report(common, data, [cli.table(table_rows(data))])


def _report_cameras(common: cli.Common) -> None:
    """Print the connected cameras, and the names under which ``amiwarp record`` and ``live`` open them."""
    from amiwarp.live.stream.camera_neuromorphic import list_cameras

    data = []
    rows = []
    for camera in list_cameras():
        source = camera.serial and f"camera:{camera.serial}"
        model = camera.name.value
        connection = camera.connection.value
        data.append(
            {"source": source, "model": model, "connection": connection, "error": camera.error}
        )
        rows.append((model, source or f"cannot be opened: {camera.error}", connection))
    lines = [cli.table(rows)] if rows else ["no camera is connected"]
    cli.report(common, {"cameras": data}, lines)


def _file_bytes(path: Path) -> int:
    """Return the size of a file, or of the files in a folder [bytes]."""
    # Opening the file names the fault.
    with contextlib.suppress(OSError):
        files = path.iterdir() if path.is_dir() else (path,)
        return sum(file.stat().st_size for file in files if file.is_file())
    return 0


_in_viewers = partial(typer.Option, rich_help_panel="Viewers")


@dataclass(frozen=True)
class ViewerOptions:
    """Options for the files of the viewers Rerun and Foxglove."""

    foxglove: Annotated[
        bool,
        _in_viewers(
            "--foxglove", help="Write .mcap for Foxglove, with images, not as a ROS 2 bag."
        ),
    ] = False
    calibration: Annotated[
        Path | None,
        _in_viewers(
            help="Calibration file (.json), to show compensated events too. Default: only recorded ones."
        ),
    ] = None
    frame_ms: Annotated[
        float | None,
        _in_viewers(min=0.001, help="Time window of the events in an image (ms). Default: 33.333."),
    ] = None

    def chosen(self, out: Path) -> bool:
        """Return whether ``out`` is a file for a viewer. Raises :class:`AmiwarpError` for options without one."""
        ending = out.suffix.lower()
        if ending == ".rrd" or (self.foxglove and ending == ".mcap"):
            return True
        if self.foxglove:
            raise AmiwarpError(
                f"{out}: files for Foxglove end in .mcap, not '{out.suffix}'; leave --foxglove out",
                ErrorCode.OPTIONS,
            )
        if self != ViewerOptions():
            raise AmiwarpError(
                f"{out}: --calibration and --frame-ms are for viewers: .rrd, or .mcap with --foxglove; to compensate a "
                "recording, run 'amiwarp compensate'",
                ErrorCode.OPTIONS,
            )
        return False


_in_rigs = partial(typer.Option, rich_help_panel="Rigs")


@dataclass(frozen=True)
class RigConversionOptions:
    """Options for the conversion of a rig."""

    left: Annotated[
        str | None,
        _in_rigs(
            help="Sensor that is the left camera. Default: the one called left, or the outermost one."
        ),
    ] = None
    right: Annotated[
        str | None,
        _in_rigs(
            help="Sensor that is the right camera. Default: the one called right, or the outermost one."
        ),
    ] = None
    imu_noise: Annotated[
        str | None,
        _in_rigs(
            help="Noise of the IMU for EuRoC and Kalibr: density and random walk of the gyroscope, then of the "
            "accelerometer (SI units).",
            metavar="G,GW,A,AW",
        ),
    ] = None
    imu_position: Annotated[
        str | None,
        _in_rigs(
            help="Place of the IMU in the frame of the camera that carries it (m). Default: 0,0,0.",
            metavar="X,Y,Z",
        ),
    ] = None

    def given(self) -> dict[str, Any]:
        """Return the arguments of :func:`amiwarp.convert_rig`."""
        noise = self.imu_noise
        place = self.imu_position
        return {
            "left": self.left,
            "right": self.right,
            "imu_noise": None if noise is None else cli.numbers(noise, 4, "--imu-noise"),
            "imu_position": None if place is None else cli.numbers(place, 3, "--imu-position"),
        }


def run_convert(
    source: Annotated[
        Path, typer.Argument(help="Recording in any supported format, or the folder of a rig.")
    ],
    out: Annotated[
        Path,
        typer.Argument(
            help=f"File to write. Its extension gives the format: {EXTENSION_HELP}; .rrd (Rerun), or .mcap with "
            "--foxglove, for viewers. Of a rig, a bag (.bag, .mcap, .db3), or with --format a new folder."
        ),
        cli.OUTPUT,
    ],
    *,
    format: Annotated[
        str | None,
        typer.Option(
            help="Format to write, if the extension means another one: dsec (.h5), evt21 (.raw). Of a rig, the layout "
            "of the folder: dsec, mvsec, euroc or kalibr.",
            show_default=False,
        ),
    ] = None,
    codec: cli.HdfCodec = Codec.BLOSC,
    round: cli.Round = None,
    encoder: cli.EncoderOptions,
    camera: cli.CameraOptions,
    prism: cli.NominalPrismOptions,
    viewers: ViewerOptions,
    rigs: RigConversionOptions,
    topic: cli.Topic = None,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Convert a recording to amiwarp's HDF5 format, and add the encoder, camera and prism given by options.

    Other formats hold the events only; the command lists what it leaves out. From a ROS bag to one of the same version
    of ROS, all other topics are copied. Memory use does not depend on the length of the recording.

    Files for the viewers Rerun and Foxglove show images of the events, recorded and, with --calibration, compensated,
    and the prism's angle.

    A rig is converted to the folders of DSEC, MVSEC, EuRoC and Kalibr, and to bags with the topics of all sensors.
    """
    began = time.perf_counter()
    has_optics = camera != cli.CameraOptions() or prism != cli.NominalPrismOptions()
    if is_rig(source):
        others = (encoder, viewers, layout) == (
            cli.EncoderOptions(),
            ViewerOptions(),
            cli.FileOptions(),
        )
        if has_optics or not others or (round, topic) != (None, None):
            raise AmiwarpError(
                f"{source}: is a rig; give only --format, --codec and the options of rigs, or convert one of its "
                "recordings",
                ErrorCode.OPTIONS,
            )
        _convert_rig(source, out, format, codec, rigs, common)
        return
    if rigs != RigConversionOptions():
        raise AmiwarpError(
            f"{source}: is no rig; leave out --left, --right, --imu-noise and --imu-position",
            ErrorCode.OPTIONS,
        )
    if viewers.chosen(out):
        if (format, codec, round) != (None, Codec.BLOSC, None) or has_optics:
            raise AmiwarpError(
                f"{out}: is a file for a viewer; leave out --format, --codec, --round, and the camera's and prism's "
                "options",
                ErrorCode.OPTIONS,
            )
        log = encoder.build(source, topic, layout.chip)
        recording = open_recording(source, topic=topic, **layout.given())
        if log is not None:
            recording = replace(recording, encoder=log)
        _write_for_viewer(recording, out, viewers, common, began)
        return

    log = encoder.build(source, topic, layout.chip)
    lens = wedge = None
    # Opening may read the whole file, so it is done only for these options.
    if has_optics:
        recording = open_recording(source, topic=topic, **layout.given())
        # If the file does not hold the sensor's size, the camera's size is used.
        size_is_known = getattr(recording.events, "size_is_known", True)
        lens = camera.build(*recording.events.size, fixed=size_is_known)
        wedge = prism.build(recording.prism)
    with cli.progress("converting") as advance:
        summary = convert(
            source,
            out,
            encoder=log,
            camera=lens,
            prism=wedge,
            topic=topic,
            format=format,
            codec=codec,
            progress=advance,
            rounding=round,
            seed=common.seed,
            **layout.given(),
        )
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {"file": str(out), **asdict(summary), "seconds": seconds}
    data["t_first_us"] = data.pop("t_first")
    data["t_last_us"] = data.pop("t_last")
    slip = data.pop("index_slip")
    data["slip_deg"] = None if slip is None else math.degrees(slip)
    cli.report(common, data, _convert_lines(data))


def _convert_rig(
    source: Path,
    out: Path,
    format: str | None,
    codec: Codec,
    options: RigConversionOptions,
    common: cli.Common,
) -> None:
    """Convert a rig, and report which sensor is which, what was assumed, and what was left out."""
    began = time.perf_counter()
    with cli.progress("converting") as advance:
        summary = convert_rig(
            source, out, format=format, codec=codec, progress=advance, **options.given()
        )
    seconds = time.perf_counter() - began
    data = {"file": str(out), **asdict(summary), "seconds": seconds}
    lines = [f"{out}: {summary.format.value}, {summary.files:,} files, {seconds:.2f} s"]
    if summary.roles:
        roles = ", ".join(f"{role} is {name}" for role, name in summary.roles.items())
        lines.append(f"{roles} (--left, --right)")
    lines += [f"note: {note}" for note in summary.notes]
    if summary.left_out:
        lines.append(f"note: left out: {', '.join(summary.left_out)}")
    cli.report(common, data, lines)


def _write_for_viewer(
    recording: Recording, out: Path, options: ViewerOptions, common: cli.Common, began: float
) -> None:
    """Write a file for a viewer, and report it."""
    from amiwarp.plotting.frames import FRAME_US
    from amiwarp.plotting.viewer_files import save_for_viewer
    from amiwarp.results.calibration import Calibration

    device = cli.choose_device(common.device)
    calibration = None if options.calibration is None else Calibration.load(options.calibration)
    frame_us = FRAME_US
    if options.frame_ms is not None:
        frame_us = cli.microseconds(options.frame_ms, "ms", "--frame-ms")
    with cli.progress("writing frames") as advance:
        summary = save_for_viewer(
            recording,
            out,
            calibration=calibration,
            frame_us=frame_us,
            device=device,
            progress=advance,
        )
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {
        "file": str(out),
        **asdict(summary),
        "device": device,
        "seconds": seconds,
    }
    rate = summary.events / max(seconds, 1e-9) / 1e6
    frames = f"{summary.frames:,} frames ({' and '.join(summary.streams)})"
    line = (
        f"{out}: {summary.events:,} events in {frames}, {summary.angles:,} prism angles, {seconds:.2f} s, "
        f"{rate:.3g} Mev/s"
    )
    cli.report(common, data, [line])


def _convert_lines(data: dict[str, Any]) -> list[str]:
    """Return the lines that report a conversion."""
    seconds = data["seconds"]
    rate = data["events"] / max(seconds, 1e-9) / 1e6
    size = f"{data['width']} x {data['height']}"
    lines = [
        f"{data['file']}: {data['events']:,} events, {size}, {seconds:.2f} s, {rate:.3g} Mev/s"
    ]
    lines += [f"note: {name}: {count:,}" for name, count in data["repairs"].items()]
    lines += cli.assumption_lines(data["assumptions"])
    if data["encoder_covers"] is False:
        lines.append("warning: the encoder samples do not cover all events")
    gaps = data["encoder_gaps"]
    if gaps:
        begin, end = gaps[0]
        lines.append(f"warning: the encoder has {len(gaps)} gaps, the first at {begin} .. {end} us")
    lines += cli.format_notes(data)
    if data["slip_deg"] is not None:
        lines.append(f"encoder slips up to {data['slip_deg']:.3g} deg at its index pulses")
    return lines


def run_truth(
    recording: Annotated[
        Path, typer.Argument(help="Recording of a simulated world, in amiwarp's format (.h5).")
    ],
    out: Annotated[Path, typer.Argument(help="Folder for the exported files."), cli.OUTPUT_FOLDER],
    *,
    flow: Annotated[
        Literal["dsec", "mvsec"] | None,
        typer.Option(
            help="Export optical flow between the recorded instants. dsec: writes 16-bit flow/forward/*.png, "
            "flow/backward/*.png and their times; mvsec: writes NAME_gt_flow_dist.npz."
        ),
    ] = None,
    with_prism: Annotated[
        bool,
        typer.Option(
            "--with-prism", help="Export the optical flow as seen through the turning prism."
        ),
    ] = False,
    poses: Annotated[
        Literal["tum"] | None,
        typer.Option(
            help="Export the poses of the camera and the moving bodies. tum: writes poses/camera.txt and "
            "poses/body_NAME.txt."
        ),
    ] = None,
    common: cli.Common,
) -> None:
    """Export the ground truth of a simulated world: optical flow in the DSEC or MVSEC format, poses as TUM files.

    Flow requires a recording that was simulated with --truth-hz or --truth-us.
    """
    began = time.perf_counter()
    if flow is None and poses is None:
        raise AmiwarpError(
            "nothing is chosen to export; give --flow dsec, --flow mvsec or --poses tum",
            ErrorCode.OPTIONS,
        )
    if with_prism and flow is None:
        raise AmiwarpError(
            "--with-prism applies to the optical flow; give --flow too", ErrorCode.OPTIONS
        )
    source = open_recording(recording)
    truth = source.truth
    if truth is None or (truth.frames is None and truth.poses is None):
        raise AmiwarpError(
            f"{recording}: holds no ground truth of a world; simulate a recording with --world",
            ErrorCode.CONTENT_MISSING,
        )
    if flow is not None and truth.frames is None:
        raise AmiwarpError(
            f"{recording}: holds no optical flow; simulate the recording with --truth-hz",
            ErrorCode.CONTENT_MISSING,
        )
    make_folder(out)
    data: dict[str, Any] = {"folder": str(out), "flow_maps": 0, "pose_files": 0}
    with cli.progress("writing flow") as advance:
        if truth.frames is not None and flow == "dsec":
            data["flow_maps"] = save_flow_dsec(
                out / "flow", truth.frames, with_prism=with_prism, progress=advance
            )
        elif truth.frames is not None and flow == "mvsec":
            path = out / f"{source.name}_gt_flow_dist.npz"
            data["flow_maps"] = save_flow_mvsec(
                path, truth.frames, with_prism=with_prism, progress=advance
            )
    if poses is not None:
        data["pose_files"] = _save_poses(out / "poses", truth)
    data["seconds"] = time.perf_counter() - began
    direction = " in each direction" if flow == "dsec" else ""
    line = (
        f"{out}: {data['flow_maps']} maps of flow{direction}, {data['pose_files']} files of poses, "
        f"{data['seconds']:.2f} s"
    )
    cli.report(common, data, [line])


def _save_poses(folder: Path, truth: Truth) -> int:
    """Write the poses of the camera and of each moving body; return the number of files."""
    if truth.poses is None:
        raise AmiwarpError(
            "the recording holds no poses; simulate a recording with --world",
            ErrorCode.CONTENT_MISSING,
        )
    make_folder(folder)
    save_poses_tum(folder / "camera.txt", truth.poses)
    names = pose_files_of(truth.poses[:0].bodies)
    for name, body in names.items():
        save_poses_tum(folder / name, truth.poses, body=body)
    return 1 + len(names)


def pose_files_of(bodies: Iterable[str]) -> dict[str, str]:
    """Return a name of a file for the poses of each body, without what file systems refuse, and the body's name."""
    names: dict[str, str] = {}
    for body in bodies:
        plain = re.sub(r"[^A-Za-z0-9_.-]", "_", body)[:80]
        name = f"body_{plain}.txt"
        number = len(names)
        while name in names:
            name = f"body_{plain}_{number}.txt"
            number += 1
        names[name] = body
    return names
