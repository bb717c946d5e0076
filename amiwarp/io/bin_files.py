"""Reader of the ``.bin`` files of N-MNIST and N-Caltech101: events of 5 bytes, without a header.

The bytes are x, y, and 24 bits, big-endian: the polarity (1 is ON) and 23 bits of the time [us]. In some of these
files an event with y = 240 is no event but a mark: 2**13 us are added to the times after it. The data sets have 34 or
up to 180 rows. Such marks are counted and dropped, as by the data sets' own reader.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import DEFAULT_BLOCK, Recording
from amiwarp.io.bin_events import BIN_EVENT_BYTES, BIN_MARK_ROW, bin_columns, looks_like_bin
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_pieces import read_pieces
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.inputs import errors_name, open_input

MARK_US = 1 << 13
"""Time between two marks [us]."""

FRAMES = ((34, 34), (240, 180), (304, 240))
"""Frames [px]: N-MNIST, N-Caltech101, and the camera of both."""


def open_bin(path: Path) -> Recording:
    """Open a file of 5-byte events."""
    with errors_name(path, lambda: "opening"), open_input(path) as file:
        head = file.read(4096)
        if not looks_like_bin(head, path.stat().st_size):
            raise AmiwarpError(
                "does not hold events of 5 bytes in the order of time; give another file",
                ErrorCode.FORMAT_UNKNOWN,
            )
    read = partial(_bin_packets, path)
    events = FileEvents(path, read, size=None, sensors=FRAMES)
    metadata = {"format": "bin", **events.metadata}
    return Recording(events=events, metadata=metadata, name=path.stem)


def _bin_packets(path: Path, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of a file, and count its marks."""
    marks = 0
    for data in read_pieces(path, 0, BIN_EVENT_BYTES * DEFAULT_BLOCK, notes):
        x, y, t, p = bin_columns(np.frombuffer(data, np.uint8))
        is_mark = y == BIN_MARK_ROW
        marks_before = marks + np.cumsum(is_mark)
        t = t + marks_before * MARK_US
        marks += int(np.count_nonzero(is_mark))
        notes["overflow_marks"] = marks
        is_event = ~is_mark
        yield x[is_event], y[is_event], t[is_event], p[is_event]
