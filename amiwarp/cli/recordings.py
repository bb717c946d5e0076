"""Content and files of recordings: ``amiwarp info``, ``amiwarp convert`` and ``amiwarp truth``."""

import contextlib
import math
import re
import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from numpy.typing import NDArray

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder, rpm_between
from amiwarp.events.recording import DEFAULT_BLOCK, EventSource, ImageStore, ImuSamples, Recording, mean_rate
from amiwarp.events.truth import Cause, Truth
from amiwarp.io import convert, open_recording
from amiwarp.io.export import GAP_INTERVALS, save_flow_dsec, save_flow_mvsec, save_poses_tum
from amiwarp.io.file_scan import ASSUMED, assumptions_of, head_only
from amiwarp.io.formats import EXTENSION_HELP, Codec, make_folder
from amiwarp.optics.camera import camera_to_json
from amiwarp.optics.prism import NominalPrism, Plate, Prism

# ``amiwarp info``: description of the content of a recording.

MOST_NAMES = 16
"""Largest number of instances, bodies or joints whose names are printed. ``--json`` prints all names."""
LARGE_BYTES = 1 << 28
"""Size from which on files are read only in part, unless --count is given [bytes]."""
HEAD_EVENTS = 1 << 22
"""Number of events that are read of a large file."""


def run_info(
    file: Annotated[
        Path, typer.Argument(help="Recording in any supported format, or camera: to list the connected cameras.")
    ],
    *,
    count: Annotated[
        bool, typer.Option("--count", help="Read all of a large file, to count its events instead of estimating them.")
    ] = False,
    topic: cli.Topic = None,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Show a recording's format, events, encoder, camera, prism, IMU, frames, truth, repairs and assumptions.

    Files of up to 256 MiB are read once, in blocks. Of larger files only the first 4 million events and the end are
    read, unless --count is given. Figures that are then estimates are marked as such.
    """
    if str(file) == "camera:":
        _report_cameras(common)
        return
    large = not count and _file_bytes(file) > LARGE_BYTES
    with head_only(HEAD_EVENTS) if large else contextlib.nullcontext():
        recording = open_recording(file, topic=topic, **layout.given())
    data = describe(recording, str(file), head=large)
    cli.report(common, data, [cli.table(_rows(data))])


def _report_cameras(common: cli.Common) -> None:
    """Print the connected cameras, and the names under which ``amiwarp record`` and ``live`` open them."""
    from amiwarp.live.stream.camera_neuromorphic import list_cameras

    data = [
        {"source": each.serial and f"camera:{each.serial}", "model": each.name.value,
         "connection": each.connection.value, "error": each.error}
        for each in list_cameras()
    ]  # fmt: skip
    rows = [(d["model"], d["source"] or f"cannot be opened: {d['error']}", d["connection"]) for d in data]
    cli.report(common, {"cameras": data}, [cli.table(rows)] if rows else ["no camera is connected"])


def _file_bytes(path: Path) -> int:
    """Return the size of a file, or of the files in a folder [bytes]."""
    with contextlib.suppress(OSError):  # opening the file names the fault
        files = path.iterdir() if path.is_dir() else (path,)
        return sum(file.stat().st_size for file in files if file.is_file())
    return 0


def describe(recording: Recording, file: str, *, head: bool = False) -> dict[str, Any]:
    """Return the description of a recording, with angles in degrees. With ``head``, only its first events are read."""
    source = recording.events
    width, height = source.size
    data: dict[str, Any] = {
        "file": file,
        "format": recording.metadata.get("format", "amiwarp"),
        "width": width,
        "height": height,
        **_events(source, head=head),
        "encoder": None if recording.encoder is None else _encoder(recording.encoder, source),
        "camera": None if recording.camera is None else _camera(recording),
        "prism": None,
        "imu": None if recording.imu is None else _imu(recording.imu),
        "frames": None if recording.frames is None else _frames(recording.frames),
        "truth": None if recording.truth is None else _degrees(recording.truth.parameters),
        "truth_points": recording.truth is not None and recording.truth.points(0, 1) is not None,
        "world": None if recording.truth is None else _world(recording.truth, None if head else len(source)),
        "records": getattr(source, "records", {}),
        "repairs": getattr(source, "repairs", {}),
        "assumptions": [asdict(each) for each in assumptions_of(recording.metadata)],
        "metadata": recording.metadata,
    }
    if recording.prism is not None:
        p = recording.prism
        data["prism"] = _glass(p)
    return data


def _glass(p: NominalPrism) -> dict[str, Any]:
    """Return the nominal glass, with lengths in mm and angles in degrees."""
    if isinstance(p, Plate):
        return {"thickness_mm": 1e3 * p.thickness, "plate_tilt_deg": math.degrees(p.tilt), "index": p.index}
    apex = math.degrees(p.apex) if isinstance(p, Prism) else None
    found = {"apex_deg": apex, "index": p.index, "flat_side": p.flat_side.value}
    second = p.second if isinstance(p, Prism) else None
    return found if second is None else {**found, "second": _glass(second)}


def _events(source: EventSource, *, head: bool) -> dict[str, Any]:
    n, on, outside, done = len(source), 0, 0, 0
    compensated = False
    with cli.progress("reading") as advance:
        for block in source.blocks(count=min(DEFAULT_BLOCK, HEAD_EVENTS)):
            on += int(np.count_nonzero(block.p))
            done += len(block)
            if block.x.dtype != np.uint16:
                compensated = True
                inside = (np.rint(block.x) >= 0) & (np.rint(block.x) < source.size[0])
                inside &= (np.rint(block.y) >= 0) & (np.rint(block.y) < source.size[1])
                outside += int(np.count_nonzero(~inside))
            advance("reading", done / max(n, 1))
            if head and done >= HEAD_EVENTS:
                break
    first, last = (source.t_first, source.t_last) if n else (None, None)
    share = getattr(source, "share", 1.0)
    if share < 1.0 and first is not None and last is not None:
        # In a part of the file, the end is known only if the last bytes of the file hold its time.
        n, known = round(n / share), source.last_time()  # type: ignore[attr-defined]
        last = first + round((last - first) / share) if known is None else known
    seconds = 0.0 if first is None or last is None else (last - first) * 1e-6
    out = {
        "events": n,
        "t_first_us": first,
        "t_last_us": last,
        "duration_s": seconds,
        "rate_mev_per_s": n / seconds / 1e6 if seconds > 0 else None,
        "on_share": on / done if done else None,
        "estimated": share < 1.0,
        "count_s": getattr(source, "seconds", None),
        "share_read": share if share < 1.0 else done / max(n, 1),
        "compensated": compensated,
    }
    return {**out, "outside": outside} if compensated else out


def _encoder(encoder: Encoder, source: EventSource) -> dict[str, Any]:
    """Return a description of the encoder's samples, gaps and slip."""
    slip = encoder.slip()
    first, last = encoder.coverage
    return {
        "samples": len(encoder.t),
        "rpm": rpm_between(encoder, source.t_first, source.t_last) if len(source) else encoder.rpm,
        "turns": float(np.ptp(encoder.angle)) / (2.0 * math.pi),
        "second_rpm": None if encoder.second is None else encoder.second.rpm,
        "interval_us": encoder.interval_us,
        "clock_offset_us": encoder.clock_offset_us,
        "first_us": first,
        "last_us": last,
        "covers_events": encoder.covers(source.t_first, source.t_last) if len(source) else True,
        "gaps": encoder.gaps(GAP_INTERVALS * encoder.interval_us),
        "index_pulses": len(slip),
        "slip_deg": math.degrees(float(np.abs(slip).max())) if len(slip) else None,
    }


def _imu(imu: ImuSamples) -> dict[str, Any]:
    """Return the number, the rate and the times of the IMU samples."""
    return {"samples": len(imu), "rate_hz": imu.rate_hz, **_ends(imu.t)}


def _frames(frames: ImageStore) -> dict[str, Any]:
    """Return the number, the rate, the size and the times of the frames."""
    width, height = frames.size
    return {
        "count": len(frames.t),
        "rate_hz": mean_rate(frames.t),
        "width": width,
        "height": height,
        **_ends(frames.t),
    }


def _ends(t: NDArray[np.int64]) -> dict[str, int | None]:
    """Return the first and the last time [us], or None for both without times."""
    return {"first_us": int(t[0]) if len(t) else None, "last_us": int(t[-1]) if len(t) else None}


def _sensor_rows(d: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the table about IMU samples and frames."""
    rows = []
    for label, name, text in (
        ("IMU", "imu", "{samples:,} samples"),
        ("frames", "frames", "{count:,} of {width} x {height} px"),
    ):
        if d[name] is not None:
            rate = "" if d[name]["rate_hz"] is None else f", {d[name]['rate_hz']:.4g} Hz"
            rows.append((label, text.format(**d[name]) + rate))
    return rows


def _camera(recording: Recording) -> dict[str, Any]:
    """Return the camera's intrinsics and its field of view [deg]."""
    camera = recording.camera
    assert camera is not None
    return {**camera_to_json(camera), "fov_deg": math.degrees(camera.fov)}


def _world(truth: Truth, count: int | None) -> dict[str, Any] | None:
    """Return the ground truth that is stored in addition to the parameters, or None."""
    stores = {"cause": truth.stored_causes, "instance": truth.stored_instances, "depth": truth.stored_depths,
              "place": truth.stored_places}  # fmt: skip
    stored = [name for name, store in stores.items() if store is not None]
    if not stored and truth.labels is None and truth.frames is None and truth.poses is None:
        return None
    poses = None if truth.poses is None else truth.poses[:0]
    labels = truth.labels
    return {
        "name": None if labels is None else labels.name,
        "instances": None if labels is None else list(labels.instances),
        "categories": None if labels is None else sorted({name for name in labels.categories if name}),
        "per_event": stored,
        "causes": _causes(truth, count),
        "instants": 0 if truth.frames is None else len(truth.frames.t),
        "poses": 0 if truth.poses is None else len(truth.poses),
        "moving_bodies": [] if poses is None else list(poses.bodies),
        "joints": [] if poses is None else list(poses.joints),
    }


def _causes(truth: Truth, count: int | None) -> dict[str, int] | None:
    """Return the number of the first ``count`` events by cause, or None if it is not stored or not counted."""
    if truth.stored_causes is None or count is None:
        return None
    totals = np.zeros(256, np.int64)
    for start in range(0, count, DEFAULT_BLOCK):
        totals += np.bincount(truth.stored_causes[start : start + DEFAULT_BLOCK], minlength=256)
    return {cause.value: int(totals[cause.code]) for cause in Cause}


def _world_rows(d: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the table about the ground truth of events and of a world."""
    rows = []
    if d["causes"] is not None:
        total = max(sum(d["causes"].values()), 1)
        shares = (f"{100 * n / total:.3g} % {name.replace('_', ' ')}" for name, n in d["causes"].items() if n)
        rows.append(("causes", ", ".join(shares) or "no events"))
    if d["name"] is not None:
        categories = f" of the classes {', '.join(d['categories'])}" if d["categories"] else ""
        rows.append(("world", f"{d['name']}: {len(d['instances'])} instances{categories}"))
        rows.append(("instances", _listed(d["instances"])))
    surfaces = [name for name in d["per_event"] if name != "cause"]
    if surfaces:
        rows.append(("per event", ", ".join(surfaces)))
    if d["instants"]:
        rows.append(("instants", f"{d['instants']} with depth, normals, instances, flow and intensity"))
    if d["poses"]:
        moving = [f"{len(d[name])} {name.replace('_', ' ')}" for name in ("moving_bodies", "joints") if d[name]]
        rows.append(("poses", f"{d['poses']:,} of the camera" + (f", {', '.join(moving)}" if moving else "")))
        rows += [(name.replace("_", " "), _listed(d[name])) for name in ("moving_bodies", "joints") if d[name]]
    return rows


def _listed(names: list[str]) -> str:
    """Return the first :data:`MOST_NAMES` names as text, and the number of further names."""
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join(names[:MOST_NAMES]) + more


def _degrees(parameters: dict[str, float]) -> dict[str, float]:
    """Return the true parameters of the optic with angles in degrees, under names that end in ``_deg``."""
    pairs = ("tilt", "cylinder", "wobble", "backward", "roll", "second", "second_backward", "third", "third_backward")
    single = ("apex", "amplitude", "phase", "plate_tilt", "direction", "fold", "incidence")
    second = (f"second_{name}" for name in ("apex", "amplitude", "phase", "direction"))
    angles = (*single, *second, *(f"{name}_{axis}" for name in pairs for axis in "xy"))
    return {f"{n}_deg" if n in angles else n: math.degrees(v) if n in angles else v for n, v in parameters.items()}


def _rows(d: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the printed table: names and texts."""
    n = d["events"]
    kind = f"{d['format']}, compensated ({d['outside']:,} outside)" if d["compensated"] else str(d["format"])
    takes = "" if d["count_s"] is None else f", in about {d['count_s']:.0f} s"
    part = f"the first {100 * d['share_read']:.2g} % of the file"
    about, counted = ("about ", f" (from {part}; --count counts them{takes})") if d["estimated"] else ("", "")
    events = f"{about}{float(f'{n:.3g}'):,.0f}{counted}" if d["estimated"] else f"{n:,}"
    rows = [("file", d["file"]), ("format", kind), ("size", f"{d['width']} x {d['height']} px"), ("events", events)]
    if n:
        rate = "" if d["rate_mev_per_s"] is None else f", {about}{d['rate_mev_per_s']:.3g} Mev/s"
        rows.append(("time", f"{d['t_first_us']} .. {about}{d['t_last_us']} us: {d['duration_s']:.6g} s{rate}"))
        of = f" of {part}" if d["share_read"] < 1.0 else ""
        rows.append(("polarity", f"{100 * d['on_share']:.1f} % ON{of}"))
    if d["records"]:
        rows.append(("other", ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in d["records"].items())))
    rows.append(("encoder", _encoder_text(d["encoder"])))
    c, p = d["camera"], d["prism"]
    lens = "" if c is None else (c.get("distortion") or {}).get("kind", "no distortion").replace("_", "-")
    rows.append(("camera", "unknown" if c is None else f"fx {c['fx']:.6g}, fy {c['fy']:.6g}, cx {c['cx']:.6g}, "
                 f"cy {c['cy']:.6g} px, FOV {c['fov_deg']:.4g} deg, {lens}"))  # fmt: skip
    rows.append(("prism", _prism_text(p)))
    rows += _sensor_rows(d)
    if d["truth"] is not None:
        points = "with the true position of each event" if d["truth_points"] else "without positions"
        short = ("apex_deg", "amplitude_deg", "thickness", "plate_tilt_deg", "phase_deg", "index", "rpm")
        shown = [f"{n} {v:.5g}" for n, v in d["truth"].items() if n in short]
        rows.append(("truth", f"{', '.join(shown)}; {points}"))
    if d["world"] is not None:
        rows += _world_rows(d["world"])
    rows.append(("repairs", ", ".join(f"{name} {count:,}" for name, count in d["repairs"].items()) or "none"))
    known = {"format", *d["repairs"], *d["records"]}
    rest = {k: v for k, v in d["metadata"].items() if k not in known and not k.startswith(ASSUMED)}
    rows += [(name, str(value)) for name, value in rest.items()]
    for each in d["assumptions"]:
        rows.append(("assumed", f"{each['what']} {each['value']}: {each['why']} ({each['option']})"))
    return rows


def _prism_text(p: dict[str, Any] | None) -> str:
    """Return the description of the nominal prism as text."""
    if p is None:
        return "unknown"
    if "thickness_mm" in p:
        return f"plate of {p['thickness_mm']:.5g} mm, tilted by {p['plate_tilt_deg']:.5g} deg, n {p['index']:.6g}"
    apex = "apex unknown" if p["apex_deg"] is None else f"nominal apex {p['apex_deg']:.5g} deg"
    text = f"{apex}, n {p['index']:.6g}, flat face to the {p['flat_side']}"
    return text if "second" not in p else f"{text}; behind it: {_prism_text(p['second'])}"


def _encoder_text(e: dict[str, Any] | None) -> str:
    """Return the description of the encoder as text."""
    if e is None:
        return "none"
    parts = [f"{e['samples']:,} samples, {e['rpm']:.6g} rpm, {e['turns']:.4g} turns"]
    parts += [] if e["second_rpm"] is None else [f"second prism {e['second_rpm']:.6g} rpm"]
    parts.append("covers the events" if e["covers_events"] else f"covers only {e['first_us']} .. {e['last_us']} us")
    parts.append(f"{len(e['gaps'])} gaps" if e["gaps"] else "no gaps")
    if e["index_pulses"]:
        parts.append(f"{e['index_pulses']} index pulses, slip {e['slip_deg']:.3g} deg")
    return "; ".join(parts)


# ``amiwarp convert``: conversion of recordings to the native format and to others, and files for viewers.

_in_viewers = partial(typer.Option, rich_help_panel="Viewers")


@dataclass(frozen=True)
class ViewerOptions:
    """Options for the files of the viewers Rerun and Foxglove."""

    foxglove: Annotated[
        bool, _in_viewers("--foxglove", help="Write .mcap for Foxglove, with images, not as a ROS 2 bag.")
    ] = False
    calibration: Annotated[
        Path | None,
        _in_viewers(help="Calibration file (.json), to show compensated events too. Default: only recorded ones."),
    ] = None
    frame_ms: Annotated[
        float | None, _in_viewers(min=0.001, help="Time window of the events in an image (ms). Default: 33.333.")
    ] = None

    def chosen(self, out: Path) -> bool:
        """Return whether ``out`` is a file for a viewer. Raises :class:`AmiwarpError` for options without one."""
        if out.suffix.lower() == ".rrd" or (self.foxglove and out.suffix.lower() == ".mcap"):
            return True
        if self.foxglove:
            raise AmiwarpError(f"{out}: files for Foxglove end in .mcap, not '{out.suffix}'; leave --foxglove out")
        if self != ViewerOptions():
            raise AmiwarpError(
                f"{out}: --calibration and --frame-ms are for viewers: .rrd, or .mcap with --foxglove; to compensate a "
                "recording, run 'amiwarp compensate'"
            )
        return False


def run_convert(
    source: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path,
        typer.Argument(
            help=f"File to write. Its extension gives the format: {EXTENSION_HELP}; .rrd (Rerun), or .mcap with "
            "--foxglove, for viewers."
        ),
        cli.OUTPUT,
    ],
    *,
    format: cli.Format = None,
    codec: cli.HdfCodec = Codec.BLOSC,
    round: cli.Round = None,
    encoder: cli.EncoderOptions,
    camera: cli.CameraOptions,
    prism: cli.NominalPrismOptions,
    viewers: ViewerOptions,
    topic: cli.Topic = None,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Convert a recording to amiwarp's HDF5 format, and add the encoder, camera and prism given by options.

    Other formats hold the events only; the command lists what it leaves out. From a ROS bag to one of the same version
    of ROS, all other topics are copied. Memory use does not depend on the length of the recording.

    Files for the viewers Rerun and Foxglove show images of the events, recorded and, with --calibration, compensated,
    and the prism's angle.
    """
    began = time.perf_counter()
    for_viewer = viewers.chosen(out)
    if for_viewer and (format, codec, round, camera, prism) != (
        None, Codec.BLOSC, None, cli.CameraOptions(), cli.NominalPrismOptions()
    ):  # fmt: skip
        raise AmiwarpError(
            f"{out}: is a file for a viewer; leave out --format, --codec, --round, and the camera's and prism's options"
        )
    log = encoder.build(source, topic)
    if for_viewer:
        opened = open_recording(source, topic=topic, **layout.given())
        _write_for_viewer(opened if log is None else replace(opened, encoder=log), out, viewers, common, began)
        return
    lens = wedge = None
    if camera != cli.CameraOptions() or prism != cli.NominalPrismOptions():  # opening may read the whole file
        recording = open_recording(source, topic=topic, **layout.given())
        # If the file does not hold the sensor's size, the camera's size is used.
        lens = camera.build(*recording.events.size, fixed=getattr(recording.events, "size_is_known", True))
        wedge = prism.build(recording.prism)
    with cli.progress("converting") as advance:
        summary = convert(
            source, out, encoder=log, camera=lens, prism=wedge, topic=topic, format=format, codec=codec,
            progress=advance, rounding=round, seed=common.seed, **layout.given(),
        )  # fmt: skip
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {"file": str(out), **asdict(summary), "seconds": seconds}
    data |= {f"{name}_us": data.pop(name) for name in ("t_first", "t_last")}
    slip = data.pop("index_slip")
    data["slip_deg"] = None if slip is None else math.degrees(slip)
    cli.report(common, data, _convert_lines(data))


def _write_for_viewer(
    recording: Recording, out: Path, options: ViewerOptions, common: cli.Common, began: float
) -> None:
    """Write a file for a viewer, and report it."""
    from amiwarp.calib.result import Calibration
    from amiwarp.plotting.viewers import FRAME_US, save_for_viewer

    device = cli.choose_device(common.device)
    found = None if options.calibration is None else Calibration.load(options.calibration)
    frame_us = FRAME_US if options.frame_ms is None else cli.microseconds(options.frame_ms, "ms", "--frame-ms")
    with cli.progress("writing frames") as advance:
        summary = save_for_viewer(
            recording, out, calibration=found, frame_us=frame_us, device=device, progress=advance
        )  # fmt: skip
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {"file": str(out), **asdict(summary), "device": device, "seconds": seconds}
    rate = summary.events / max(seconds, 1e-9) / 1e6
    frames = f"{summary.frames:,} frames ({' and '.join(summary.streams)})"
    cli.report(
        common,
        data,
        [
            f"{out}: {summary.events:,} events in {frames}, {summary.angles:,} prism angles, {seconds:.2f} s, "
            f"{rate:.3g} Mev/s"
        ],
    )


def _convert_lines(d: dict[str, Any]) -> list[str]:
    rate = d["events"] / max(d["seconds"], 1e-9) / 1e6
    lines = [
        f"{d['file']}: {d['events']:,} events, {d['width']} x {d['height']}, {d['seconds']:.2f} s, {rate:.3g} Mev/s"
    ]
    lines += [f"note: {name}: {count:,}" for name, count in d["repairs"].items()]
    lines += cli.assumption_lines(d["assumptions"])
    if d["encoder_covers"] is False:
        lines.append("warning: the encoder samples do not cover all events")
    if d["encoder_gaps"]:
        first = d["encoder_gaps"][0]
        lines.append(
            f"warning: the encoder has {len(d['encoder_gaps'])} gaps, the first at {first[0]} .. {first[1]} us"
        )
    lines += cli.format_notes(d)
    if d["slip_deg"] is not None:
        lines.append(f"encoder slips up to {d['slip_deg']:.3g} deg at its index pulses")
    return lines


# ``amiwarp truth``: export of a simulated world's ground truth to the formats of public data sets.


def run_truth(
    recording: Annotated[Path, typer.Argument(help="Recording of a simulated world, in amiwarp's format (.h5).")],
    out: Annotated[Path, typer.Argument(help="Folder for the exported files."), cli.OUTPUT_FOLDER],
    *,
    flow: Annotated[
        Literal["dsec", "mvsec"] | None,
        typer.Option(
            help="Export optical flow between the recorded instants. dsec: writes 16-bit flow/forward/*.png and "
            "flow/forward_timestamps.txt; mvsec: writes NAME_gt_flow_dist.npz."
        ),
    ] = None,
    with_prism: Annotated[
        bool, typer.Option("--with-prism", help="Export the optical flow as seen through the turning prism.")
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

    Flow requires a recording that was simulated with --truth-hz.
    """
    began = time.perf_counter()
    if flow is None and poses is None:
        raise AmiwarpError("nothing is chosen to export; give --flow dsec, --flow mvsec or --poses tum")
    if with_prism and flow is None:
        raise AmiwarpError("--with-prism applies to the optical flow; give --flow too")
    source = open_recording(recording)
    truth = source.truth
    if truth is None or (truth.frames is None and truth.poses is None):
        raise AmiwarpError(f"{recording}: holds no ground truth of a world; simulate a recording with --world")
    if flow is not None and truth.frames is None:
        raise AmiwarpError(f"{recording}: holds no optical flow; simulate the recording with --truth-hz")
    make_folder(out)
    data: dict[str, Any] = {"folder": str(out), "flow_maps": 0, "pose_files": 0}
    with cli.progress("writing flow") as advance:
        if truth.frames is not None and flow == "dsec":
            data["flow_maps"] = save_flow_dsec(out / "flow", truth.frames, with_prism=with_prism, progress=advance)
        elif truth.frames is not None and flow == "mvsec":
            path = out / f"{source.name}_gt_flow_dist.npz"
            data["flow_maps"] = save_flow_mvsec(path, truth.frames, with_prism=with_prism, progress=advance)
    if poses is not None:
        data["pose_files"] = _save_poses(out / "poses", truth)
    data["seconds"] = time.perf_counter() - began
    line = f"{out}: {data['flow_maps']} maps of flow, {data['pose_files']} files of poses, {data['seconds']:.2f} s"
    cli.report(common, data, [line])


def _save_poses(folder: Path, truth: Truth) -> int:
    """Write the poses of the camera and of each moving body; return the number of files."""
    if truth.poses is None:
        raise AmiwarpError("the recording holds no poses; simulate a recording with --world")
    make_folder(folder)
    save_poses_tum(folder / "camera.txt", truth.poses)
    names: dict[str, str] = {}
    for body in truth.poses[:0].bodies:
        plain = re.sub(r"[^A-Za-z0-9_.-]", "_", body)[:80]
        name = f"body_{plain}.txt" if f"body_{plain}.txt" not in names else f"body_{plain}_{len(names)}.txt"
        names[name] = body
    for name, body in names.items():
        save_poses_tum(folder / name, truth.poses, body=body)
    return 1 + len(names)
