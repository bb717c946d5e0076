"""What all readers share: errors with a place, and which files are inputs that no writer may touch."""

from __future__ import annotations

import contextlib
import os
import weakref
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from amiwarp.errors import AmiwarpError, printable

_sources: weakref.WeakKeyDictionary[object, tuple[Path, ...]] = weakref.WeakKeyDictionary()
_noted: set[Path] | None = None


def register_reader(source: object, *paths: Path) -> None:
    """Remember that ``source`` reads from ``paths`` for as long as it lives."""
    _sources[source] = paths


def note_input(path: Path) -> None:
    """Remember a file that is read at once as an input of the command that runs, if one does."""
    if _noted is not None:
        _noted.add(path.absolute())


@contextlib.contextmanager
def inputs_noted(paths: Iterable[Path]) -> Iterator[None]:
    """Count ``paths``, and all that :func:`note_input` names within the block, as inputs."""
    global _noted
    before, _noted = _noted, {path.absolute() for path in paths}
    try:
        yield
    finally:
        _noted = before


def inputs_in_use() -> tuple[Path, ...]:
    """Return the files that open sources read, and those that the running command has read."""
    return (*(path for paths in list(_sources.values()) for path in paths), *(_noted or ()))


def same_file(first: Path, second: Path) -> bool:
    """Whether two paths lead to one existing file."""
    with contextlib.suppress(OSError):
        return os.path.samefile(first, second)
    return False


@contextlib.contextmanager
def errors_name(path: Path, place: Callable[[], str]) -> Iterator[None]:
    """Turn whatever a library raises into one :class:`AmiwarpError` line with the file and the ``place``.

    Panics of compiled decoders derive from BaseException only, hence the broad net.
    """
    try:
        yield
    except AmiwarpError as error:
        if printable(str(path)) in str(error):
            raise
        raise AmiwarpError(f"{path}: {place()}: {error}") from error
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except FileNotFoundError as error:
        raise AmiwarpError(f"{path}: no such file") from error
    except BaseException as error:
        what = " ".join(str(error).split())[:300] or type(error).__name__
        raise AmiwarpError(f"{path}: {place()}: {what}") from error
