"""Description of a recorded rig, as ``amiwarp info`` prints it."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.other_sensors import mean_rate
from amiwarp.events.recording import Recording
from amiwarp.events.rig_recording import RigRecording

LEAST_OVERLAP = 0.5
"""Share of the shorter of two recordings that another one covers at least, if their clocks fit."""

Rows = list[tuple[str, str]]
"""Names and texts."""


def describe_rig(rig: RigRecording, folder: str) -> dict[str, Any]:
    """Return the description of a rig, with lengths in mm and angles in degrees."""
    sensors = {name: _sensor(rig, name) for name in rig.sensors}
    spans = {name: span for name in rig.sensors if (span := span_of(rig[name].recording))}
    common = None
    if len(spans) == len(rig.sensors):
        first = max(start for start, _ in spans.values())
        last = min(stop for _, stop in spans.values())
        common = [first, last] if first <= last else None
    return {
        "file": folder,
        "format": "amiwarp rig",
        "sensors": sensors,
        "common_us": common,
        "warnings": _clock_warnings(spans),
        "metadata": dict(rig.metadata),
    }


def span_of(recording: Recording) -> tuple[int, int] | None:
    """Return the time of the first and the last event, frame or depth map [us]; None for an empty recording."""
    events = recording.events
    ends = [(events.t_first, events.t_last)] if len(events) else []
    for store in (recording.frames, recording.depth):
        if store is not None and len(store.t):
            ends.append((int(store.t[0]), int(store.t[-1])))
    if not ends:
        return None
    return min(first for first, _ in ends), max(last for _, last in ends)


def _sensor(rig: RigRecording, name: str) -> dict[str, Any]:
    """Return the description of a sensor, whose place is given in the frame of the first sensor."""
    recording = rig[name].recording
    first = next(iter(rig.sensors))
    place = rig.between(name, first)
    span = span_of(recording)
    width, height = recording.events.size
    rate = None
    if len(recording.events):
        events_us = recording.events.t_last - recording.events.t_first
        rate = len(recording.events) / events_us if events_us else None
    return {
        "kind": rig[name].kind.value,
        "width": width,
        "height": height,
        "fov_deg": None if recording.camera is None else math.degrees(recording.camera.fov),
        "events": len(recording.events),
        "rate_mev_per_s": rate,
        "frames": None if recording.frames is None else _counted(recording.frames.t),
        "depth_maps": None if recording.depth is None else _counted(recording.depth.t),
        "imu": None if recording.imu is None else _counted(recording.imu.t),
        "encoder": recording.encoder is not None,
        "truth_poses": recording.truth is not None and recording.truth.poses is not None,
        "first_us": None if span is None else span[0],
        "last_us": None if span is None else span[1],
        "position_mm": (1e3 * place[:, 3]).tolist(),
        "baseline_mm": 1e3 * float(np.linalg.norm(place[:, 3])),
        "angle_deg": math.degrees(rotation_angle(place[:, :3])),
    }


def _counted(t: NDArray[np.int64]) -> dict[str, Any]:
    """Return the number and the rate of records at the times ``t`` [us]."""
    return {"count": len(t), "rate_hz": mean_rate(t)}


def rotation_angle(rotation: NDArray[np.float64]) -> float:
    """Return the angle of a rotation matrix [rad]."""
    # The sine is exact for small angles, where the cosine is not.
    x = rotation[2, 1] - rotation[1, 2]
    y = rotation[0, 2] - rotation[2, 0]
    z = rotation[1, 0] - rotation[0, 1]
    return math.atan2(math.sqrt(x * x + y * y + z * z), float(np.trace(rotation)) - 1.0)


def _clock_warnings(spans: dict[str, tuple[int, int]]) -> list[str]:
    """Return warnings of pairs of sensors that hardly overlap in time, so that their clocks may differ."""
    warnings = []
    for (name, (first, last)), (other, (first_of_other, last_of_other)) in itertools.combinations(
        spans.items(), 2
    ):
        overlap = min(last, last_of_other) - max(first, first_of_other)
        shorter = min(last - first, last_of_other - first_of_other)
        if overlap < LEAST_OVERLAP * shorter:
            common = "do not overlap" if overlap < 0 else f"overlap only by {overlap * 1e-6:.6g} s"
            warnings.append(
                f"{name} ({first} .. {last} us) and {other} ({first_of_other} .. {last_of_other} us) {common}; a rig "
                "has one clock: check their times"
            )
    return warnings


def rig_rows(about: dict[str, Any]) -> Rows:
    """Return the rows of the table for what :func:`describe_rig` returns."""
    rows = [("file", about["file"]), ("format", about["format"])]
    rows.append(("sensors", ", ".join(about["sensors"])))
    common = about["common_us"]
    if common is not None:
        first, last = common
        rows.append(("common time", f"{first} .. {last} us: {(last - first) * 1e-6:.6g} s"))
    reference = next(iter(about["sensors"]))
    for name, sensor in about["sensors"].items():
        rows.append((name, _content_text(sensor)))
        rows.append(("", _time_text(sensor)))
        if name != reference:
            rows.append(("", _place_text(sensor, reference)))
    rows += [(name, str(value)) for name, value in about["metadata"].items()]
    rows += [("warning", text) for text in about["warnings"]]
    return rows


def _content_text(sensor: dict[str, Any]) -> str:
    """Return kind, size and records of a sensor as text."""
    parts = [f"{sensor['kind']}, {sensor['width']} x {sensor['height']} px"]
    if sensor["fov_deg"] is not None:
        parts.append(f"FOV {sensor['fov_deg']:.4g} deg")
    if sensor["events"]:
        rate = sensor["rate_mev_per_s"]
        shown_rate = "" if rate is None else f" ({rate:.3g} Mev/s)"
        parts.append(f"{sensor['events']:,} events{shown_rate}")
    for name, what in (("frames", "frames"), ("depth_maps", "depth maps"), ("imu", "IMU samples")):
        counted = sensor[name]
        if counted is not None:
            hz = counted["rate_hz"]
            shown_rate = "" if hz is None else f" ({hz:.4g} Hz)"
            parts.append(f"{counted['count']:,} {what}{shown_rate}")
    parts += [
        what
        for name, what in (("encoder", "encoder"), ("truth_poses", "true poses"))
        if sensor[name]
    ]
    return ", ".join(parts)


def _time_text(sensor: dict[str, Any]) -> str:
    """Return the time span of a sensor as text."""
    if sensor["first_us"] is None:
        return "empty"
    seconds = (sensor["last_us"] - sensor["first_us"]) * 1e-6
    return f"{sensor['first_us']} .. {sensor['last_us']} us: {seconds:.6g} s"


def _place_text(sensor: dict[str, Any], reference: str) -> str:
    """Return the place of a sensor in the frame of the reference as text."""
    x, y, z = sensor["position_mm"]
    return (
        f"{sensor['baseline_mm']:.6g} mm from {reference} (x {x:.6g}, y {y:.6g}, z {z:.6g}), turned by "
        f"{sensor['angle_deg']:.4g} deg"
    )
