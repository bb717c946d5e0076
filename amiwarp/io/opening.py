"""How the sources of events in a block of the program are opened: with a given size, sorted, or only their heads."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class GivenSource:
    """What the user says of an event source."""

    size: tuple[int, int] | None = None
    """Sensor size (width, height) [px], which replaces the size in the file; or None."""
    sort: bool = False
    """Whether the events are sorted by time."""


_given: ContextVar[GivenSource | None] = ContextVar("given", default=None)
"""What the user says of the sources that are opened, or None."""


@contextlib.contextmanager
def given_source(given: GivenSource) -> Iterator[None]:
    """Apply what the user says to the sources that are opened in the block."""
    token = _given.set(given)
    try:
        yield
    finally:
        _given.reset(token)


def is_sorting() -> bool:
    """Return whether :func:`given_source` asks for events in the order of time."""
    given = _given.get()
    return given is not None and given.sort


def given_size() -> tuple[int, int] | None:
    """Return the size of :func:`given_source`, or None."""
    given = _given.get()
    return None if given is None else given.size


_head: ContextVar[int | None] = ContextVar("head", default=None)
"""Number of events after which the first pass ends, or None."""


@contextlib.contextmanager
def head_only(count: int) -> Iterator[None]:
    """Let the sources that are opened in the block read only about their first ``count`` events.

    Their length is then the length of this part, and ``share`` of a :class:`~amiwarp.io.file_scan.FileEvents` tells how
    much of the file it is.
    """
    token = _head.set(count)
    try:
        yield
    finally:
        _head.reset(token)


def head_limit() -> int | None:
    """Return the number of events of :func:`head_only`, or None outside it."""
    return _head.get()
