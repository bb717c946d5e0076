"""Type of the callback by which long tasks report their progress."""

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[str, float], None]
"""Callback that gets the name of the current step, and the finished fraction of the whole task, 0 to 1."""


def part(progress: Progress, start: float, end: float) -> Progress:
    """Return the callback for a part of a task, which covers the fractions ``start`` to ``end`` of the whole."""
    return lambda what, share: progress(what, start + (end - start) * share)


def silent(what: str, share: float) -> None:
    """Ignore the progress: callback for callers that do not report progress."""
