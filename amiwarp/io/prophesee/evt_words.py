"""Words of Prophesee's EVT in bytes, and the order of the halves of EVT 2.1 words."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp import evt_types
from amiwarp.io.file_pieces import unwrapped
from amiwarp.io.prophesee.evt_decoder import WORD_TYPES


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
    lower = words & np.uint64(0xFFFFFFFF)
    upper = words >> np.uint64(32)
    if_swapped = _fit_of(lower)
    if_not = _fit_of(upper)
    if if_swapped is None and if_not is None:
        return None
    if if_swapped is None or if_not is None:
        return Halves(swapped=if_not is None, certain=True)

    swapped = if_swapped >= if_not
    best, other = (if_swapped, if_not) if swapped else (if_not, if_swapped)
    return Halves(swapped, certain=best.moves and not other.moves)


class _Fit(NamedTuple):
    """How likely an order of the halves is. The larger one is the likelier."""

    moves: bool
    """Whether the times change."""
    times: int
    """Number of times."""


def _fit_of(heads: NDArray[np.uint64]) -> _Fit | None:
    """Return how likely halves of words are those with type and time; None if they are not."""
    kind = heads >> np.uint64(28)
    of_time = kind == evt_types.TIME_HIGH
    times = (heads[of_time] & np.uint64(0xFFFFFFF)).astype(np.int64)
    if not times.size:
        return None
    known = np.count_nonzero(np.isin(kind, evt_types.EVT2))
    if known * 100 < 99 * kind.size:
        return None
    steps = np.diff(unwrapped(times, 28))
    falls = np.count_nonzero(steps < 0)
    if falls * 10 > steps.size:
        return None
    return _Fit(bool(steps.any()), times.size)
