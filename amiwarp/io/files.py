"""What all readers and writers share: errors with a place, no file half written, none overwritten while it is read."""

from __future__ import annotations

import contextlib
import os
import secrets
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from amiwarp.errors import AmiwarpError


class HasPath(Protocol):
    """A source that reads from a file."""

    path: Path


_being_read: weakref.WeakSet[HasPath] = weakref.WeakSet()


def register_reader(source: HasPath) -> None:
    """Remember that ``source`` reads from its ``path`` for as long as it lives."""
    _being_read.add(source)


def refuse_overwriting(path: Path) -> None:
    """Raise :class:`AmiwarpError` where ``path`` is a file that a living source reads."""
    for source in list(_being_read):
        if same_file(source.path, path):
            raise AmiwarpError(f"{path}: is being read; write to another file")


def same_file(first: Path, second: Path) -> bool:
    """Whether two paths lead to one existing file."""
    with contextlib.suppress(OSError):
        return os.path.samefile(first, second)
    return False


def part_path(path: Path) -> Path:
    """A name beside ``path`` to write to before ``os.replace``; :class:`AmiwarpError` without a folder to write in."""
    if path.is_dir():
        raise AmiwarpError(f"{path}: is a folder; give the name of a file")
    if not path.parent.is_dir():
        raise AmiwarpError(f"{path}: its folder {path.parent} does not exist; make it first")
    return path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.part")


def make_folder(path: Path) -> None:
    """Makes a folder and those above it; :class:`AmiwarpError` where it cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AmiwarpError(f"{path}: cannot be made a folder: {error.strerror}; choose another --out") from error


def write_text(path: Path, text: str) -> None:
    """Writes a file beside first and then by renaming."""
    part = part_path(path)
    try:
        part.write_text(text)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextlib.contextmanager
def errors_name(path: Path, place: Callable[[], str]) -> Iterator[None]:
    """Turn whatever a library raises into one :class:`AmiwarpError` line with the file and the ``place``.

    Panics of compiled decoders derive from BaseException only, hence the broad net.
    """
    try:
        yield
    except AmiwarpError as error:
        if str(path) in str(error):
            raise
        raise AmiwarpError(f"{path}: {place()}: {error}") from error
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except FileNotFoundError as error:
        raise AmiwarpError(f"{path}: no such file") from error
    except BaseException as error:
        what = " ".join(str(error).split())[:300] or type(error).__name__
        raise AmiwarpError(f"{path}: {place()}: {what}") from error
