"""Decoders of AEDAT 2.0 records and AEDAT 3.1 and 4 packets with NumPy: what the kernels are compared with."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.aedat.aedat2_header import Chip
from amiwarp.io.aedat.aedat4_packets import EVENT
from amiwarp.io.aedat.aedat4_tables import DAMAGE, root_of, vector_of
from amiwarp.io.event_packets import Columns
from amiwarp.io.file_pieces import unwrapped


class Aedat2Records:
    """Decoder of the records of AEDAT 2.0 files, in pieces of shape ``(n, 2)``."""

    def __init__(self, chip: Chip) -> None:
        """Start without a time."""
        self._chip = chip
        self._last: int | None = None

    def decode(self, records: NDArray[Any]) -> tuple[Columns, dict[str, Any]]:
        """Return the events of the next records, and their edges, frames and records of IMU samples."""
        words = records[:, 0].astype(np.int64)
        t = unwrapped(records[:, 1].astype(np.int64), 32, self._last)
        self._last = int(t[-1]) if t.size else self._last
        return _davis(words, t, self._chip) if self._chip.davis else _dvs128(words, t)


def _davis(
    words: NDArray[np.int64], t: NDArray[np.int64], chip: Chip
) -> tuple[Columns, dict[str, Any]]:
    other, external = words >> 31 == 1, words >> 10 & 1 == 1
    kind = words[other] >> 10 & 3
    # A frame has two samples of each pixel: the type is 0 for the reset level, 1 for the signal. One pixel is counted.
    frames = np.count_nonzero((kind == 1) & (words[other] >> 12 & 0x7FFFF == 0))
    imu = other & (words >> 10 & 3 == 3)
    others = {
        "edge_t": t[external & ~other],
        "imu_t": t[imu],
        "imu_words": words[imu],
        "frames": frames,
    }
    at = ~other & ~external
    kept = words[at]
    columns = (
        chip.width - 1 - (kept >> 12 & 0x3FF),
        chip.height - 1 - (kept >> 22 & 0x1FF),
        t[at],
        kept >> 11 & 1,
    )
    return columns, others


def _dvs128(words: NDArray[np.int64], t: NDArray[np.int64]) -> tuple[Columns, dict[str, Any]]:
    external = words >> 15 & 1 == 1
    nothing = np.zeros(0, np.int64)
    others = {"edge_t": t[external], "imu_t": nothing, "imu_words": nothing, "frames": 0}
    kept = words[~external]
    # In jAER, bit 0 is 0 for an ON event.
    return (
        127 - (kept >> 1 & 0x7F),
        127 - (kept >> 8 & 0x7F),
        t[~external],
        1 - (kept & 1),
    ), others


def polarity_events(parts: list[bytes], bases: list[int]) -> Columns:
    """Return the valid events of packets of AEDAT 3.1, to whose times the bases are added."""
    found = []
    for part, base in zip(parts, bases, strict=True):
        words = np.frombuffer(part, "<i4").reshape(-1, 2).astype(np.int64)
        words = words[words[:, 0] & 1 == 1]
        words[:, 1] += base
        found.append(words)
    data, t = np.concatenate([np.zeros((0, 2), np.int64), *found]).T
    return data >> 17 & 0x7FFF, data >> 2 & 0x7FFF, t, data >> 1 & 1


def aedat4_rows(content: bytes) -> NDArray[Any] | None:
    """Return the events in a packet of AEDAT 4 whose compression is undone, or None if it is damaged."""
    try:
        place, count = vector_of(content, root_of(content), 0, EVENT.itemsize)
    except DAMAGE:
        return None
    return np.frombuffer(content, EVENT, count, place)
