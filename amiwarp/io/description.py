"""Description of the content of a recording, as ``amiwarp info --json`` prints it."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.encoder import GAP_INTERVALS, Encoder
from amiwarp.events.encoder_speed import rpm_between
from amiwarp.events.other_sensors import ImageStore, ImuSamples, mean_rate
from amiwarp.events.recording import DEFAULT_BLOCK, EventSource, Recording
from amiwarp.events.truth import Cause, Truth
from amiwarp.io.assumptions import assumptions_of
from amiwarp.io.file_scan import FileEvents
from amiwarp.optics.camera import camera_to_json
from amiwarp.optics.prism import NominalPrism, Plate, Prism
from amiwarp.tasks import Progress, silent

HEAD_EVENTS = 1 << 22
"""Number of events that are read of a large file."""

ANGLES = (
    "apex",
    "amplitude",
    "phase",
    "deflection",
    "plate_tilt",
    "direction",
    "fold",
    "incidence",
    "second_apex",
    "second_amplitude",
    "second_phase",
    "second_direction",
)
"""True parameters of the optic that are angles. The models know the units of theirs, but would load Warp here."""

ANGLE_PAIRS = (
    "tilt",
    "cylinder",
    "wobble",
    "wedge",
    "backward",
    "roll",
    "second",
    "second_backward",
    "third",
    "third_backward",
)
"""True parameters of the optic that are pairs of angles: their names end in ``_x`` and ``_y``."""


def describe(
    recording: Recording, file: str, *, head: bool = False, progress: Progress = silent
) -> dict[str, Any]:
    """Return the description of a recording, with angles in degrees. With ``head``, only its first events are read."""
    source = recording.events
    width, height = source.size
    encoder = recording.encoder
    camera = recording.camera
    prism = recording.prism
    imu = recording.imu
    frames = recording.frames
    truth = recording.truth
    return {
        "file": file,
        "format": recording.metadata.get("format", "amiwarp"),
        "width": width,
        "height": height,
        **_events(source, head=head, progress=progress),
        "encoder": None if encoder is None else _encoder(encoder, source),
        "camera": None
        if camera is None
        else {**camera_to_json(camera), "fov_deg": math.degrees(camera.fov)},
        "prism": None if prism is None else _glass(prism),
        "imu": None if imu is None else _imu(imu),
        "frames": None if frames is None else _frames(frames),
        "depth_maps": None if recording.depth is None else _frames(recording.depth),
        "truth": None if truth is None else _in_degrees(truth.parameters),
        "truth_points": truth is not None and truth.points(0, 1) is not None,
        "world": None if truth is None else _world(truth, None if head else len(source)),
        "records": source.records if isinstance(source, FileEvents) else {},
        "repairs": source.repairs if isinstance(source, FileEvents) else {},
        "assumptions": [asdict(assumption) for assumption in assumptions_of(recording.metadata)],
        "metadata": recording.metadata,
    }


def _events(source: EventSource, *, head: bool, progress: Progress) -> dict[str, Any]:
    """Return number, times, rate and share of ON events, estimated if only a part is read."""
    counted = _count(source, head=head, progress=progress)
    # A file without an index may have been examined only in part, when it was opened.
    scanned = source if isinstance(source, FileEvents) else None
    examined_share = 1.0 if scanned is None else scanned.share
    count = len(source)
    t_first = t_last = None
    share_read = counted.read / max(count, 1)
    if count:
        t_first = source.t_first
        t_last = source.t_last
    if scanned is not None and examined_share < 1.0:
        share_read = examined_share
        if count:
            count = round(count / examined_share)
            t_last = _estimated_end(scanned)
    seconds = 0.0 if t_first is None or t_last is None else (t_last - t_first) * 1e-6

    description = {
        "events": count,
        "t_first_us": t_first,
        "t_last_us": t_last,
        "duration_s": seconds,
        "rate_mev_per_s": count / seconds / 1e6 if seconds > 0 else None,
        "on_share": counted.on / counted.read if counted.read else None,
        "estimated": examined_share < 1.0,
        "count_s": None if scanned is None else scanned.seconds,
        "share_read": share_read,
        "compensated": counted.is_compensated,
    }
    if counted.is_compensated:
        description["outside"] = counted.outside
    return description


def _estimated_end(source: FileEvents) -> int:
    """Return the time of the last event [us] of a partly examined file; an estimate if the file's end does not tell."""
    known = source.last_time()
    if known is not None:
        return known
    return source.t_first + round((source.t_last - source.t_first) / source.share)


class _Counted(NamedTuple):
    """What the blocks of events held that were read."""

    read: int
    on: int
    outside: int
    """Number of events outside of the image, if they are compensated."""
    is_compensated: bool


def _count(source: EventSource, *, head: bool, progress: Progress) -> _Counted:
    """Count the events, or with ``head`` about the first :data:`HEAD_EVENTS`."""
    width, height = source.size
    count = len(source)
    read = 0
    on = 0
    outside = 0
    is_compensated = False
    for block in source.blocks(count=min(DEFAULT_BLOCK, HEAD_EVENTS)):
        on += int(np.count_nonzero(block.p))
        read += len(block)
        if block.x.dtype != np.uint16:
            is_compensated = True
            x = np.rint(block.x)
            y = np.rint(block.y)
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            outside += int(np.count_nonzero(~inside))
        progress("reading", read / max(count, 1))
        if head and read >= HEAD_EVENTS:
            break
    return _Counted(read, on, outside, is_compensated)


def _encoder(encoder: Encoder, source: EventSource) -> dict[str, Any]:
    """Return a description of the encoder's samples, gaps and slip."""
    if len(source):
        rpm = rpm_between(encoder, source.t_first, source.t_last)
        covers_events = encoder.covers(source.t_first, source.t_last)
    else:
        rpm = encoder.rpm
        covers_events = True
    slip = encoder.slip()
    first, last = encoder.coverage
    return {
        "samples": len(encoder.t),
        "rpm": rpm,
        "turns": float(np.ptp(encoder.angle)) / (2.0 * math.pi),
        "second_rpm": None if encoder.second is None else encoder.second.rpm,
        "interval_us": encoder.interval_us,
        "clock_offset_us": encoder.clock_offset_us,
        "first_us": first,
        "last_us": last,
        "covers_events": covers_events,
        "gaps": encoder.gaps(GAP_INTERVALS * encoder.interval_us),
        "index_pulses": len(slip),
        "slip_deg": math.degrees(float(np.abs(slip).max())) if len(slip) else None,
    }


def _glass(glass: NominalPrism) -> dict[str, Any]:
    """Return the nominal glass, with lengths in mm and angles in degrees."""
    if isinstance(glass, Plate):
        return {
            "thickness_mm": 1e3 * glass.thickness,
            "plate_tilt_deg": math.degrees(glass.tilt),
            "index": glass.index,
        }
    apex = math.degrees(glass.apex) if isinstance(glass, Prism) else None
    fields: dict[str, Any] = {
        "apex_deg": apex,
        "index": glass.index,
        "flat_side": glass.flat_side.value,
    }
    if isinstance(glass, Prism) and glass.second is not None:
        fields["second"] = _glass(glass.second)
    return fields


def _imu(imu: ImuSamples) -> dict[str, Any]:
    """Return the number, the rate, the times, the axes and the largest rate of rotation of the IMU samples."""
    speed = np.linalg.norm(imu.angular_velocity, axis=1)
    known = speed[np.isfinite(speed)]
    return {
        "samples": len(imu),
        "rate_hz": imu.rate_hz,
        **_ends(imu.t),
        "fastest_deg_s": math.degrees(float(known.max())) if len(known) else None,
        "to_camera": None if imu.to_camera is None else imu.to_camera.tolist(),
    }


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
    if not len(t):
        return {"first_us": None, "last_us": None}
    return {"first_us": int(t[0]), "last_us": int(t[-1])}


def _world(truth: Truth, count: int | None) -> dict[str, Any] | None:
    """Return the ground truth that is stored in addition to the parameters, or None."""
    stores = {
        "cause": truth.stored_causes,
        "instance": truth.stored_instances,
        "depth": truth.stored_depths,
        "place": truth.stored_places,
    }
    stored = [name for name, store in stores.items() if store is not None]
    labels = truth.labels
    if not stored and labels is None and truth.frames is None and truth.poses is None:
        return None
    categories = None
    if labels is not None:
        categories = sorted({name for name in labels.categories if name})
    # No rows: only the names are asked, and the poses of a file stay unread.
    poses = None if truth.poses is None else truth.poses[:0]
    return {
        "name": None if labels is None else labels.name,
        "instances": None if labels is None else list(labels.instances),
        "categories": categories,
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


def _in_degrees(parameters: dict[str, float]) -> dict[str, float]:
    """Return the true parameters of the optic with angles in degrees, under names that end in ``_deg``."""
    angles = {*ANGLES}
    for pair in ANGLE_PAIRS:
        angles |= {f"{pair}_x", f"{pair}_y"}
    in_degrees = {}
    for name, value in parameters.items():
        if name in angles:
            in_degrees[f"{name}_deg"] = math.degrees(value)
        else:
            in_degrees[name] = value
    return in_degrees
