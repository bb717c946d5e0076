"""The progress callback, the same for every long task."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[str, float], None]
"""Called with what is being done, for a person to read, and the finished share of the whole task, 0 to 1."""


def part(progress: Progress, start: float, end: float) -> Progress:
    """Return the callback for a part of a task, which covers the shares ``start`` to ``end`` of the whole."""
    return lambda what, share: progress(what, start + (end - start) * share)


def silent(what: str, share: float) -> None:
    """Report nothing."""
