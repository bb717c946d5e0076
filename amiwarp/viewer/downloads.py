"""Files of the shown events, and the names of downloads. No file is written on the server."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Axis
from amiwarp.compensation.in_memory import BlockCompensator
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.regions import inside
from amiwarp.io import RecordingWriter
from amiwarp.io.array_maps import save_map
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import check_output
from amiwarp.io.spans import span_blocks
from amiwarp.io.text.writers import save_rows
from amiwarp.plotting.meshes import Box
from amiwarp.viewer.cloud_colours import axis_range
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.layout import EXPORTS

COLUMNS = ("t", "x", "y", "p", "theta", "x_compensated", "y_compensated")
"""Columns of a table of events: time [us], pixel, polarity, prism angle [rad] and compensated place [px]."""


def write_events(inspector: Inspector, path: Path, *, compensated: bool) -> int:
    """Write all selected events of the window to a new native file, and return their number.

    Compensated events get sub-pixel coordinates, with the parameters set on the page. Camera, prism and encoder that
    the recording lacks are those set on the page. A window with more events than the page reads is written completely.
    Raises :class:`AmiwarpError` if the file exists.
    """
    recording = inspector.recording
    span = inspector.loaded.span
    encoder = inspector.encoder_of(inspector.knobs)
    width, height = recording.events.size
    first_us = max(span.start_us, encoder.coverage[0])
    last_us = min(span.start_us + span.length_us, encoder.coverage[1])
    metadata = dict(recording.metadata)
    if compensated:
        metadata["compensated_with"] = inspector.knobs.model
    written_encoder = None
    if inspector.has_encoder or inspector.knobs.rpm:
        written_encoder = _cut(encoder, first_us, last_us)
    with RecordingWriter(
        path,
        width=width,
        height=height,
        camera=inspector.camera,
        prism=inspector.nominal_prism,
        metadata=metadata,
        encoder=written_encoder,
    ) as writer:
        compensator = BlockCompensator(
            inspector.model, encoder, first_us, last_us, inspector.device
        )
        for block in _selected_blocks(inspector):
            if compensated:
                moved, inside = compensator(block, all_cores=True)
                writer.append(moved, inside=inside)
            else:
                writer.append(block)
        return len(writer)


def write_table(inspector: Inspector, path: Path) -> None:
    """Write all selected events of the window, with :data:`COLUMNS`, to a new .csv or .npz file.

    Raises :class:`AmiwarpError` for another suffix, or if the file exists.
    """
    encoder = inspector.encoder_of(inspector.knobs)
    model = inspector.model

    def table(events: Events) -> tuple[NDArray[Any], ...]:
        theta = np.mod(encoder.angle_at(events.t), math.tau)
        # compensate_events refuses places between pixels
        xy = np.stack([events.x, events.y], axis=1).astype(np.float32)
        angles = encoder.angles_at(events.t).astype(np.float32)
        moved = np.asarray(model.compensate_points(xy, angles))
        return events.t, events.x, events.y, events.p, theta, moved[:, 0], moved[:, 1]

    tables = map(table, _selected_blocks(inspector))
    if check_ending(path, "tables are written", (".csv", ".npz")) == ".csv":
        save_rows(path, COLUMNS, tables, "%d,%d,%d,%d,%.6f,%.3f,%.3f")
        return
    arrays = {}
    for name, *parts in zip(COLUMNS, *tables, strict=True):
        arrays[name] = np.concatenate(parts)
    width, height = inspector.recording.events.size
    arrays["width"] = np.array(width)
    arrays["height"] = np.array(height)
    save_map(path, "table", arrays, overwrite=False)


def write_cloud(inspector: Inspector, path: Path, axis: Axis, *, compensated: bool) -> None:
    """Write all selected events of the window as points to a new .vtp file, as :func:`amiwarp.event_clouds` does.

    Points lie at x [px], -y [px], and angle [deg] or time [ms] on the third axis, in the scale of the clouds. Events
    that the model cannot compensate are left out of compensated points. Raises :class:`AmiwarpError` if the file
    exists.
    """
    import pyvista

    shown = inspector.show()
    encoder = inspector.encoder_of(inspector.knobs)
    model = inspector.model
    events = Events.concatenate(list(_selected_blocks(inspector)))
    xy = np.stack([events.x, events.y], axis=1).astype(np.float32)
    if compensated:
        angles = encoder.angles_at(events.t).astype(np.float32)
        xy = np.asarray(model.compensate_points(xy, angles), np.float32)
    theta = np.mod(encoder.angle_at(events.t), math.tau)
    t_us = events.t - shown.span.first_us
    if axis is Axis.ANGLE:
        along = np.degrees(theta)
        unit = "theta [deg]"
    else:
        along = t_us * 1e-3
        unit = "t [ms]"

    box = Box(*shown.region, *axis_range(shown, axis))
    known = np.isfinite(xy).all(axis=1)
    cloud = pyvista.PolyData(box.positions(xy[known], along[known]))
    arrays: dict[str, NDArray[Any]] = {"t_us": t_us, "polarity": events.p}
    if math.isfinite(inspector.turn_us):
        arrays["theta_rad"] = theta
    for name, values in arrays.items():
        cloud.point_data[name] = values[known]
    cloud.field_data["axes"] = ["x [px]", "-y [px]", f"({unit} - z_start) * z_scale"]
    cloud.field_data["z_scale"] = [box.stretch]
    cloud.field_data["z_start"] = [box.low]
    cloud.field_data["t_first_us"] = np.array([shown.span.first_us], np.int64)
    check_output(path)
    cloud.save(path)


def _selected_blocks(inspector: Inspector) -> Iterator[Events]:
    """Yield all selected events of the window, in blocks. The selection goes on from block to block."""
    running = inspector.selected_events(inspector.selection)
    region = inspector.loaded.region
    for block in span_blocks(inspector.recording.events, inspector.loaded.span):
        if not len(block):
            continue
        kept = running.keep(block) & inside(block, region)
        yield block if kept.all() else block[kept]


def _cut(encoder: Encoder, first_us: int, last_us: int) -> Encoder:
    """Return the samples of an encoder, and of its second one, that cover a time span, with one more on each side."""
    # On the encoder's clock
    begin = first_us + encoder.clock_offset_us
    end = last_us + encoder.clock_offset_us
    first = max(int(np.searchsorted(encoder.t, begin)) - 2, 0)
    stop = int(np.searchsorted(encoder.t, end)) + 2
    t = encoder.t[first:stop]
    pulses = encoder.index_t
    if pulses is not None:
        pulses = pulses[(pulses >= t[0]) & (pulses <= t[-1])]
    second = None if encoder.second is None else _cut(encoder.second, first_us, last_us)
    return Encoder(t, encoder.angle[first:stop], encoder.clock_offset_us, pulses, second)


def file_stem(recording: str) -> str:
    """Return the name of a recording or of a stream, as file names may have it."""
    return re.sub(r"[^\w.+=@-]+", "_", recording)[:60].strip("._-~ ") or "recording"


def download_name(recording: str, what: str) -> str:
    """Return the file name of a download. ``recording``: name of the recording or stream."""
    stem = file_stem(recording)
    _, suffix = EXPORTS[what]
    if suffix == f".{what}":
        return f"{stem}{suffix}"
    return f"{stem}.{what}{suffix}"


def unused_path(name: str) -> Path:
    """Return a path in the current folder with this name, or with a number after it, that no file has."""
    path = Path(name)
    unused = path
    number = 0
    while unused.exists() or unused.with_name(f"{unused.stem}.part.h5").exists():
        number += 1
        unused = path.with_stem(f"{path.stem}-{number}")
    return unused
