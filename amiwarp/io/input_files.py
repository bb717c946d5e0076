"""Shared code of the readers: errors that name the file, and a register of the inputs that no writer may replace."""

from __future__ import annotations

import contextlib
import os
import weakref
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from amiwarp.errors import WORD_HEAD, AmiwarpError, printable

_sources: weakref.WeakKeyDictionary[object, tuple[Path, ...]] = weakref.WeakKeyDictionary()
"""Files that each open event source reads."""
_noted: set[Path] | None = None
"""Files that the running command has read, or None if no command runs."""


def register_reader(source: object, *paths: Path) -> None:
    """Register the files that ``source`` reads, until it is garbage-collected."""
    _sources[source] = paths


def note_input(path: Path) -> None:
    """Register a file that was read as an input of the running command, if any."""
    if _noted is not None:
        _noted.add(path.absolute())


@contextlib.contextmanager
def inputs_noted(paths: Iterable[Path]) -> Iterator[None]:
    """Treat ``paths``, and the files given to :func:`note_input` within the block, as inputs."""
    global _noted
    before, _noted = _noted, {path.absolute() for path in paths}
    try:
        yield
    finally:
        _noted = before


def inputs_in_use() -> tuple[Path, ...]:
    """Return the files that open event sources read, and those that the running command has read."""
    return (*(path for paths in list(_sources.values()) for path in paths), *(_noted or ()))


def same_file(first: Path, second: Path) -> bool:
    """Return whether two paths lead to the same existing file."""
    with contextlib.suppress(OSError):
        return os.path.samefile(first, second)
    return False


@contextlib.contextmanager
def errors_name(path: Path, place: Callable[[], str]) -> Iterator[None]:
    """Turn any exception of a library into an :class:`AmiwarpError` with the file and the place in it.

    ``place`` is a function that returns the place. Panics of compiled decoders derive from BaseException, so
    BaseException is caught.
    """
    try:
        yield
    except AmiwarpError as error:
        if printable(str(path))[:WORD_HEAD] in str(error):
            raise
        raise AmiwarpError(f"{path}: {place()}: {error}") from error
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except FileNotFoundError as error:
        raise AmiwarpError(f"{path}: no such file") from error
    except BaseException as error:
        what = " ".join(str(error).split())[:300] or type(error).__name__
        raise AmiwarpError(f"{path}: {place()}: {what}") from error
