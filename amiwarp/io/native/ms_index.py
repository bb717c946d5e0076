"""Index of a file of the native layout or DSEC's: the first event at or after each millisecond."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.output_formats import MAX_MS


def ms_entries(
    t: NDArray[np.int64], t_offset_us: int, first_ms: int, events_before: int
) -> Iterator[NDArray[np.int64]]:
    """Yield entries of the millisecond index ms_to_idx from entry ``first_ms`` on.

    ``t`` are the times of new events [us], which follow ``events_before`` earlier events.
    """
    last_ms = (int(t[-1]) - t_offset_us) // 1000
    if last_ms > MAX_MS:
        span = f"{t_offset_us} .. {int(t[-1])} us"
        raise AmiwarpError(
            f"events span {span}, beyond {MAX_MS // 3_600_000} h; a timestamp is damaged",
            ErrorCode.FILE_DAMAGED,
        )
    for first in range(first_ms, last_ms + 1, 1 << 20):
        ms = np.arange(first, min(first + (1 << 20), last_ms + 1), dtype=np.int64)
        yield np.searchsorted(t, ms * 1000 + t_offset_us) + events_before
