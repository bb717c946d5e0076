"""Number of CPU threads to use. This module does not import Warp, so that file readers start fast."""

import contextlib
import os
from collections.abc import Iterator

_limit: int | None = None
"""Largest number of threads while :func:`limited_cpu_threads` is active."""


def cpu_threads() -> int:
    """Return the number of CPU cores that this process may use."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return available if _limit is None else min(available, _limit)


@contextlib.contextmanager
def limited_cpu_threads(most: int | None) -> Iterator[None]:
    """Use at most ``most`` threads within the block, because other processes use the other cores."""
    global _limit
    before, _limit = _limit, most
    try:
        yield
    finally:
        _limit = before
