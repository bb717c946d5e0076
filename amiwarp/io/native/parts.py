"""Header, columns and millisecond index of a file that is written: what the writers share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.each_encoder import each_encoder
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MetadataValue
from amiwarp.events.truth import EVENT_COLUMNS, EventTruth, check_truth
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.native.attributes import camera_attributes, prism_attributes
from amiwarp.io.native.layout import ATTRIBUTE_BYTES, ENCODERS, FORMAT, FORMAT_VERSION, Columns
from amiwarp.io.output_formats import MAX_MS
from amiwarp.optics.camera import Camera, check_size
from amiwarp.optics.prism import NominalPrism


def check_frame(path: Path, width: int, height: int, camera: Camera | None) -> None:
    """Raise :class:`AmiwarpError` for an impossible sensor size, or a size that differs from the camera's."""
    check_size(width, height, path)
    if camera is not None and (camera.width, camera.height) != (width, height):
        given = f"camera is {camera.width}x{camera.height}, the recording {width}x{height}"
        raise AmiwarpError(f"{path}: {given}; give both the same size")


def ms_entries(
    t: NDArray[np.int64], t_offset: int, first_ms: int, before: int
) -> Iterator[NDArray[np.int64]]:
    """Yield entries of the millisecond index ms_to_idx from entry ``first_ms`` on.

    ``t`` are the times of new events [us], which follow ``before`` earlier events.
    """
    last_ms = (int(t[-1]) - t_offset) // 1000
    if last_ms > MAX_MS:
        span = f"{t_offset} .. {int(t[-1])} us"
        raise AmiwarpError(
            f"events span {span}, beyond {MAX_MS // 3_600_000} h; a timestamp is damaged",
            ErrorCode.FILE_DAMAGED,
        )
    for first in range(first_ms, last_ms + 1, 1 << 20):
        ms = np.arange(first, min(first + (1 << 20), last_ms + 1), dtype=np.int64)
        yield np.searchsorted(t, ms * 1000 + t_offset) + before


def filled(chunk: Columns, start: int, columns: Columns) -> Columns:
    """Return a chunk with a copy of columns from element ``start`` on; a new chunk if ``start`` is 0.

    Callers may change their arrays before the chunk is written.
    """
    if start == 0:
        chunk = {
            name: np.empty((CHUNK, *column.shape[1:]), column.dtype)
            for name, column in columns.items()
        }
    for name, column in columns.items():
        chunk[name][start : start + len(column)] = column
    return chunk


def write_header(
    file: Any,
    size: tuple[int, int],
    camera: Camera | None,
    prism: NominalPrism | None,
    metadata: Mapping[str, MetadataValue],
) -> None:
    """Write the parts of a file that are known before the first event: format, size, camera, prism and metadata."""
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["width"], file.attrs["height"] = size
    if camera is not None:
        file.create_group("camera").attrs.update(camera_attributes(camera))
    if prism is not None:
        file.create_group("prism").attrs.update(prism_attributes(prism))
    group = file.create_group("metadata")
    for name, item in metadata.items():
        if isinstance(item, str) and len(item.encode()) > ATTRIBUTE_BYTES:
            raise AmiwarpError(
                f"metadata '{name}' has {len(item.encode()):,} bytes; give at most {ATTRIBUTE_BYTES:,}"
            )
        group.attrs[name] = item


def encoder_columns(encoder: Encoder) -> Columns:
    """Return times [us], angles [rad] and index pulses [us] of an encoder and of its second one as datasets."""
    columns: Columns = {}
    for name, each in zip(ENCODERS, each_encoder(encoder), strict=False):
        columns[f"{name}t"] = each.t
        columns[f"{name}angle"] = each.angle
        if each.index_t is not None:
            columns[f"{name}index_t"] = each.index_t
    return columns


def event_columns(events: Events, truth: EventTruth, **flags: ArrayLike | None) -> Columns:
    """Return events, their flags and their ground truth as datasets, without the times.

    Raises :class:`AmiwarpError` for arrays of another length or shape, and for values without meaning.
    """
    count = len(events)
    columns: Columns = {"events/x": events.x, "events/y": events.y, "events/p": events.p}
    for name, flag in flags.items():
        if flag is not None:
            columns[f"events/{name}"] = np.asarray(flag).astype(np.uint8)
    for name, column in columns.items():
        if column.shape != (count,):
            raise AmiwarpError(f"{name} has shape {column.shape}; expected ({count},)")
    return columns | _truth_columns(truth, count)


def _truth_columns(truth: EventTruth, count: int) -> Columns:
    """Return the ground truth of ``count`` events as datasets."""
    columns: Columns = {}
    if truth.points is not None:
        points = np.asarray(truth.points, np.float32)
        if points.shape != (count, 2):
            raise AmiwarpError(f"truth points have shape {points.shape}; expected ({count}, 2)")
        columns["truth/x"] = points[:, 0]
        columns["truth/y"] = points[:, 1]
    for name, (dtype, row) in EVENT_COLUMNS.items():
        given = getattr(truth, name)
        if given is None:
            continue
        values = np.asarray(given, dtype)
        if values.shape != (count, *row):
            raise AmiwarpError(
                f"truth of {name} has shape {values.shape}; expected {(count, *row)}"
            )
        columns[f"truth/events/{name}"] = values
    for name, values in columns.items():
        check_truth(name, values)
    return columns
