"""Words of Prophesee's EVT in bytes, and the order of the halves of those of EVT 2.1."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp import evt_types
from amiwarp.io.evt_decoder import WORD_TYPES
from amiwarp.io.file_scan import unwrapped


def words_of(data: bytes | NDArray[np.uint8], version: str) -> NDArray[Any]:
    """Return the whole words of some bytes, in a version of EVT."""
    dtype = np.dtype(WORD_TYPES[version])
    return np.frombuffer(data, dtype, len(data) // dtype.itemsize)


@dataclass(frozen=True, slots=True)
class Halves:
    """Order of the 32-bit halves of EVT 2.1 words."""

    swapped: bool
    """Whether the half with type and time comes first, as the IMX636 writes them (``endianness=legacy``)."""
    certain: bool
    """Whether only this order fits."""


def halves_of(words: NDArray[np.uint64]) -> Halves | None:
    """Return the order in which the halves of some words have known types and times that rise, or None.

    If both fit, times that stand still are less likely, then fewer times.
    """
    found = {}
    for swapped, heads in ((True, words & np.uint64(0xFFFFFFFF)), (False, words >> np.uint64(32))):
        kind = heads >> np.uint64(28)
        times = (heads[kind == evt_types.TIME_HIGH] & np.uint64(0xFFFFFFF)).astype(np.int64)
        steps = np.diff(unwrapped(times, 28))
        typed = np.count_nonzero(np.isin(kind, evt_types.EVT2)) * 100 >= 99 * kind.size
        if times.size and typed and np.count_nonzero(steps < 0) * 10 <= steps.size:
            found[swapped] = (bool(steps.any()), times.size)
    if not found:
        return None
    best = max(found, key=lambda swapped: found[swapped])
    others = [fit for swapped, fit in found.items() if swapped != best]
    return Halves(best, certain=not others or (found[best][0] and not others[0][0]))
