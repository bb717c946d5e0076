"""Table of the description of a recording, as ``amiwarp info`` prints it: names and texts."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from amiwarp.events.axes import axes_in_words
from amiwarp.io.assumptions import ASSUMED

MOST_NAMES = 16
"""Largest number of instances, bodies or joints whose names are printed. ``--json`` prints all names."""

SHOWN_TRUTH = (
    "apex_deg",
    "amplitude_deg",
    "thickness",
    "plate_tilt_deg",
    "phase_deg",
    "index",
    "rpm",
)
"""True parameters of the optic that are printed. ``--json`` prints all parameters."""

Rows: TypeAlias = list[tuple[str, str]]
"""Names and texts."""


def table_rows(about: dict[str, Any]) -> Rows:
    """Return the rows of the table for what :func:`amiwarp.io.description.describe` returns."""
    format = str(about["format"])
    if about["compensated"]:
        format = f"{about['format']}, compensated ({about['outside']:,} outside)"
    rows = [
        ("file", about["file"]),
        ("format", format),
        ("size", f"{about['width']} x {about['height']} px"),
        *_event_rows(about),
    ]
    if about["records"]:
        counts = [f"{count:,} {_spaced(name)}" for name, count in about["records"].items()]
        rows.append(("other", ", ".join(counts)))
    rows.append(("encoder", _encoder_text(about["encoder"])))
    rows.append(("camera", _camera_text(about["camera"])))
    rows.append(("prism", _prism_text(about["prism"])))
    rows += _sensor_rows(about)
    if about["truth"] is not None:
        rows.append(("truth", _truth_text(about)))
    if about["world"] is not None:
        rows += _world_rows(about["world"])
    repairs = [f"{name} {count:,}" for name, count in about["repairs"].items()]
    rows.append(("repairs", ", ".join(repairs) or "none"))
    shown = {"format", *about["repairs"], *about["records"]}
    for name, value in about["metadata"].items():
        if name not in shown and not name.startswith(ASSUMED):
            rows.append((name, str(value)))
    for assumed in about["assumptions"]:
        text = f"{assumed['what']} {assumed['value']}: {assumed['why']} ({assumed['option']})"
        rows.append(("assumed", text))
    return rows


def _event_rows(about: dict[str, Any]) -> Rows:
    """Return the rows about number, times and polarity of the events."""
    count = about["events"]
    part = f"the first {100 * about['share_read']:.2g} % of the file"
    roughly = ""
    events = f"{count:,}"
    if about["estimated"]:
        roughly = "about "
        takes = "" if about["count_s"] is None else f", in about {about['count_s']:.0f} s"
        three_digits = float(f"{count:.3g}")
        events = f"about {three_digits:,.0f} (from {part}; --count counts them{takes})"
    rows = [("events", events)]
    if count:
        rate = ""
        if about["rate_mev_per_s"] is not None:
            rate = f", {roughly}{about['rate_mev_per_s']:.3g} Mev/s"
        span = f"{about['t_first_us']} .. {roughly}{about['t_last_us']} us"
        rows.append(("time", f"{span}: {about['duration_s']:.6g} s{rate}"))
        of_part = f" of {part}" if about["share_read"] < 1.0 else ""
        rows.append(("polarity", f"{100 * about['on_share']:.1f} % ON{of_part}"))
    return rows


def _encoder_text(encoder: dict[str, Any] | None) -> str:
    """Return the description of the encoder as text."""
    if encoder is None:
        return "none"
    samples = f"{encoder['samples']:,} samples"
    parts = [f"{samples}, {encoder['rpm']:.6g} rpm, {encoder['turns']:.4g} turns"]
    if encoder["second_rpm"] is not None:
        parts.append(f"second prism {encoder['second_rpm']:.6g} rpm")
    if encoder["covers_events"]:
        parts.append("covers the events")
    else:
        parts.append(f"covers only {encoder['first_us']} .. {encoder['last_us']} us")
    parts.append(f"{len(encoder['gaps'])} gaps" if encoder["gaps"] else "no gaps")
    if encoder["index_pulses"]:
        pulses = f"{encoder['index_pulses']} index pulses"
        parts.append(f"{pulses}, slip {encoder['slip_deg']:.3g} deg")
    return "; ".join(parts)


def _camera_text(camera: dict[str, Any] | None) -> str:
    """Return the description of the camera as text."""
    if camera is None:
        return "unknown"
    distortion = camera.get("distortion") or {}
    lens = distortion.get("kind", "no distortion").replace("_", "-")
    return (
        f"fx {camera['fx']:.6g}, fy {camera['fy']:.6g}, cx {camera['cx']:.6g}, cy {camera['cy']:.6g} px, "
        f"FOV {camera['fov_deg']:.4g} deg, {lens}"
    )


def _prism_text(prism: dict[str, Any] | None) -> str:
    """Return the description of the nominal prism as text."""
    if prism is None:
        return "unknown"
    index = f"n {prism['index']:.6g}"
    if "thickness_mm" in prism:
        thickness = f"plate of {prism['thickness_mm']:.5g} mm"
        return f"{thickness}, tilted by {prism['plate_tilt_deg']:.5g} deg, {index}"
    apex = "apex unknown"
    if prism["apex_deg"] is not None:
        apex = f"nominal apex {prism['apex_deg']:.5g} deg"
    text = f"{apex}, {index}, flat face to the {prism['flat_side']}"
    if "second" in prism:
        text += f"; behind it: {_prism_text(prism['second'])}"
    return text


def _sensor_rows(about: dict[str, Any]) -> Rows:
    """Return the rows about IMU samples and frames."""
    rows = []
    imu = about["imu"]
    if imu is not None:
        rows.append(("IMU", f"{imu['samples']:,} samples{_rate_text(imu)}"))
    for name in ("frames", "depth_maps"):
        images = about[name]
        if images is not None:
            size = f"{images['width']} x {images['height']} px"
            rows.append((_spaced(name), f"{images['count']:,} of {size}{_rate_text(images)}"))
    if imu is not None:
        rows.append(("gyroscope", _gyroscope_text(imu)))
    return rows


def _gyroscope_text(imu: dict[str, Any]) -> str:
    """Return the span, the largest rate and the axes of a gyroscope."""
    if imu["fastest_deg_s"] is None:
        return "no angular velocities"
    seconds = (imu["last_us"] - imu["first_us"]) * 1e-6
    axes = "axes in the camera's frame unknown"
    if imu["to_camera"] is not None:
        axes = f"camera's x, y, z = its {axes_in_words(np.array(imu['to_camera']))}"
    return f"{seconds:.3f} s, up to {imu['fastest_deg_s']:.0f} deg/s; {axes}"


def _rate_text(records: dict[str, Any]) -> str:
    return "" if records["rate_hz"] is None else f", {records['rate_hz']:.4g} Hz"


def _truth_text(about: dict[str, Any]) -> str:
    """Return the most important true parameters of the optic as text."""
    parameters = [
        f"{name} {value:.5g}" for name, value in about["truth"].items() if name in SHOWN_TRUTH
    ]
    points = "without positions"
    if about["truth_points"]:
        points = "with the true position of each event"
    return f"{', '.join(parameters)}; {points}"


def _world_rows(world: dict[str, Any]) -> Rows:
    """Return the rows about the ground truth of events and of a world."""
    rows = []
    if world["causes"] is not None:
        total = max(sum(world["causes"].values()), 1)
        shares = [
            f"{100 * count / total:.3g} % {_spaced(cause)}"
            for cause, count in world["causes"].items()
            if count
        ]
        rows.append(("causes", ", ".join(shares) or "no events"))
    if world["name"] is not None:
        categories = ""
        if world["categories"]:
            categories = f" of the classes {', '.join(world['categories'])}"
        rows.append(("world", f"{world['name']}: {len(world['instances'])} instances{categories}"))
        rows.append(("instances", _listed(world["instances"])))
    surfaces = [name for name in world["per_event"] if name != "cause"]
    if surfaces:
        rows.append(("per event", ", ".join(surfaces)))
    if world["instants"]:
        what = "depth, normals, instances, flow and intensity"
        rows.append(("instants", f"{world['instants']} with {what}"))
    if world["poses"]:
        moving = [name for name in ("moving_bodies", "joints") if world[name]]
        counts = [f"{world['poses']:,} of the camera"]
        counts += [f"{len(world[name])} {_spaced(name)}" for name in moving]
        rows.append(("poses", ", ".join(counts)))
        rows += [(_spaced(name), _listed(world[name])) for name in moving]
    return rows


def _listed(names: list[str]) -> str:
    """Return the first :data:`MOST_NAMES` names as text, and the number of further names."""
    listed = ", ".join(names[:MOST_NAMES])
    further = len(names) - MOST_NAMES
    return f"{listed} and {further} more" if further > 0 else listed


def _spaced(name: str) -> str:
    return name.replace("_", " ")
