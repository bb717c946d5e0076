"""Columns of a file that is written: events with their flags and ground truth, and encoders, as datasets."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder, each_encoder
from amiwarp.events.recording import Events
from amiwarp.events.truth import EVENT_COLUMNS, EventTruth, check_truth
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.native.layout import ENCODERS, Columns
from amiwarp.validation import shown


def copied_into_chunk(chunk: Columns, start: int, columns: Columns) -> Columns:
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
            columns[f"events/{name}"] = _as_flags(flag, name)
    for name, column in columns.items():
        if column.shape != (count,):
            raise AmiwarpError(
                f"{name} has shape {column.shape}; expected ({count},), one value for each event"
            )
    return columns | _truth_columns(truth, count)


def _as_flags(given: ArrayLike, name: str) -> NDArray[np.uint8]:
    """Return flags of events as they are stored. Raises :class:`AmiwarpError` for values other than 0 and 1."""
    flags = np.asarray(given)
    if flags.dtype.kind not in "biuf" or not ((flags == 0) | (flags == 1)).all():
        raise AmiwarpError(f"flag {name} is {shown(given)}; give booleans, or numbers 0 and 1")
    return flags.astype(np.uint8)


def _truth_columns(truth: EventTruth, count: int) -> Columns:
    """Return the ground truth of ``count`` events as datasets."""
    columns: Columns = {}
    if truth.points is not None:
        points = np.asarray(truth.points, np.float32)
        if points.shape != (count, 2):
            raise AmiwarpError(
                f"truth points have shape {points.shape}; expected ({count}, 2), one point for each event"
            )
        columns["truth/x"] = points[:, 0]
        columns["truth/y"] = points[:, 1]
    for name, (dtype, row) in EVENT_COLUMNS.items():
        given = getattr(truth, name)
        if given is None:
            continue
        found = np.asarray(given)
        if found.shape != (count, *row):
            raise AmiwarpError(
                f"truth of {name} has shape {found.shape}; expected {(count, *row)}, one row for each event"
            )
        with np.errstate(invalid="ignore"):  # of NaN as a whole number, which the comparison finds
            values = found.astype(dtype)
        if values.dtype.kind == "u" and not (values == found).all():
            wrong = found[values != found][0]
            raise AmiwarpError(
                f"truth of {name} holds {wrong}; give whole numbers from 0 to {np.iinfo(values.dtype).max}"
            )
        columns[f"truth/events/{name}"] = values
    for name, values in columns.items():
        check_truth(name, values)
    return columns
