"""Words of memory on the CPU, all zero, which later calls use again: new memory takes longer than many events."""

from __future__ import annotations

import contextlib

import numpy as np
import warp as wp

from amiwarp.tasks import cores

MOST_BYTES = 6 << 25
"""Largest array that is kept [bytes]."""
_zeros: list[wp.array] = []


def take_zeros(n: int) -> wp.array:
    """Return at least ``n`` words, all zero."""
    while _zeros:
        with contextlib.suppress(IndexError):  # another thread took it
            words = _zeros.pop()
            if len(words) >= n:
                return words
    # NumPy asks for large pages, in which places at random are found faster.
    return wp.array(np.zeros(n, np.int64), dtype=wp.int64, device="cpu", copy=False)


def give_zeros(words: wp.array) -> None:
    """Keep words for a later call. The caller has cleared them."""
    if words.size * 8 <= MOST_BYTES and len(_zeros) < cores():
        _zeros.append(words)
