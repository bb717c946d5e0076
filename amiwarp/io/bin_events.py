"""Events of 5 bytes, as in the ``.bin`` files of N-MNIST, and how such files are recognized."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BIN_EVENT_BYTES = 5
"""Size of an event in the ``.bin`` files of N-MNIST [bytes]."""

BIN_MARK_ROW = 240
"""Row of the marks in these files."""


def looks_like_bin(head: bytes, size: int) -> bool:
    """Return whether a file of ``size`` bytes that begins with ``head`` holds events of 5 bytes.

    Without a header, the content decides: whole events, rows of the cameras, and times that rise, except at marks.
    """
    if size % BIN_EVENT_BYTES or len(head) < 8 * BIN_EVENT_BYTES:
        return False
    events = len(head) // BIN_EVENT_BYTES
    whole = np.frombuffer(head, np.uint8, events * BIN_EVENT_BYTES)
    _, y, t, _ = bin_columns(whole)
    if (y > BIN_MARK_ROW).any():
        return False
    is_mark = y == BIN_MARK_ROW
    marks = np.count_nonzero(is_mark)
    step = np.diff(t[~is_mark])
    late = np.count_nonzero(step < 0)
    rising = np.count_nonzero(step > 0)
    seldom_late = late <= marks + events // 100
    mostly_rising = 2 * rising > events
    return bool(seldom_late and mostly_rising)


def bin_columns(data: NDArray[np.uint8]) -> tuple[NDArray[np.int64], ...]:
    """Return x, y, time since the last mark [us] and polarity of events of 5 bytes."""
    rows = data.reshape(-1, BIN_EVENT_BYTES).astype(np.int64)
    x, y, first, second, third = rows.T
    t = (first & 0x7F) << 16 | second << 8 | third
    p = first >> 7
    return x, y, t, p
