"""Reader of the ``.bin`` files of N-MNIST and N-Caltech101: events of 5 bytes, without a header.

The bytes are x, y, and 24 bits, big-endian: the polarity (1 is ON) and 23 bits of the time [us]. In some of these files
an event with y = 240 is no event but a mark: 2**13 us are added to the times after it. The data sets have 34 or up to
180 rows. Such marks are counted and dropped, as by the data sets' own reader.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import DEFAULT_BLOCK
from amiwarp.events.recording import Recording
from amiwarp.io.file_scan import FileEvents, Packet, read_pieces
from amiwarp.io.input_files import errors_name, open_input

EVENT_BYTES = 5
MARK_ROW = 240
"""Row of the marks."""
MARK_US = 1 << 13
"""Time between two marks [us]."""
FRAMES = ((34, 34), (240, 180), (304, 240))
"""Frames [px]: N-MNIST, N-Caltech101, and the camera of both."""


def open_bin(path: Path) -> Recording:
    """Open a file of 5-byte events."""
    with errors_name(path, lambda: "opening"), open_input(path) as file:
        if not looks_like_bin(file.read(4096), path.stat().st_size):
            raise AmiwarpError("does not hold events of 5 bytes in the order of time; give another file")
    events = FileEvents(path, partial(_packets, path), size=None, sensors=FRAMES)
    return Recording(events=events, metadata={"format": "bin", **events.metadata}, name=path.stem)


def looks_like_bin(head: bytes, size: int) -> bool:
    """Return whether a file of ``size`` bytes that begins with ``head`` holds such events.

    Without a header, the content decides: whole events, rows of the cameras, and times that rise, except at marks.
    """
    if size % EVENT_BYTES or len(head) < 8 * EVENT_BYTES:
        return False
    _, y, t, _ = _columns(np.frombuffer(head, np.uint8, len(head) // EVENT_BYTES * EVENT_BYTES))
    mark = y == MARK_ROW
    step = np.diff(t[~mark])
    late, rising = np.count_nonzero(step < 0), np.count_nonzero(step > 0)
    return bool((y <= MARK_ROW).all() and late <= np.count_nonzero(mark) + t.size // 100 and 2 * rising > t.size)


def _columns(data: NDArray[np.uint8]) -> Packet:
    rows = data.reshape(-1, EVENT_BYTES).astype(np.int64)
    return rows[:, 0], rows[:, 1], (rows[:, 2] & 0x7F) << 16 | rows[:, 3] << 8 | rows[:, 4], rows[:, 2] >> 7


def _packets(path: Path, notes: dict[str, int]) -> Iterator[Packet]:
    marks = 0
    for data in read_pieces(path, 0, EVENT_BYTES * DEFAULT_BLOCK, notes):
        x, y, t, p = _columns(np.frombuffer(data, np.uint8))
        is_mark = y == MARK_ROW
        t = t + (marks + np.cumsum(is_mark)) * MARK_US
        marks += int(np.count_nonzero(is_mark))
        notes["overflow_marks"] = marks
        yield x[~is_mark], y[~is_mark], t[~is_mark], p[~is_mark]
