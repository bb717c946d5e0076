"""Shared code of the readers: how an input is opened, errors that name the file, and a register of the inputs.

Every reader of the package opens its files with :func:`open_input` or :func:`read_text`, or gives :func:`input_path` to
a library that opens files. So each input is a regular file, and no writer replaces it.
"""

from __future__ import annotations

import contextlib
import io
import os
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from amiwarp.errors import WORD_HEAD, AmiwarpError, printable
from amiwarp.io.regular_file import check_regular

LONGEST_LINE = 1000
"""Longest accepted line of a text file [characters]."""

_sources: weakref.WeakKeyDictionary[object, tuple[Path, ...]] = weakref.WeakKeyDictionary()
"""Files that each open event source reads."""


@dataclass
class _Command:
    """Files of the running command."""

    read: set[Path]
    """Files that it has read."""
    written: set[Path] = field(default_factory=set)
    """Files that it has written itself. They are no inputs, even if it reads them."""


_command: _Command | None = None
"""Files of the running command, or None if no command runs."""


def open_input(path: str | os.PathLike[str], *, noted: bool = True) -> io.BufferedReader:
    """Open an input for reading. ``noted`` is False for results that the command continues, and so may replace.

    Raises :class:`AmiwarpError` if the file cannot be opened or is not a regular file.
    """
    path = Path(path)
    check_regular(path)
    try:
        file = open(path, "rb")  # noqa: SIM115
    except OSError as error:
        raise AmiwarpError(f"{path}: cannot be opened: {error.strerror}; give another file") from error
    if noted:
        note_input(path)
    return file


def read_text(
    path: str | os.PathLike[str], *, encoding: str = "utf-8", errors: str = "strict", noted: bool = True
) -> str:
    """Return the text of an input. Raises as :func:`open_input`, and UnicodeDecodeError."""
    with io.TextIOWrapper(open_input(path, noted=noted), encoding, errors) as file:
        return file.read()


def input_path(path: str | os.PathLike[str]) -> Path:
    """Return the path of an input for a library that opens it. Raises :class:`AmiwarpError` for other than files."""
    path = Path(path)
    check_regular(path)
    note_input(path)
    return path


def input_folder(folder: Path) -> Path:
    """Return the path of a folder for a library that opens the files in it, which must be regular files."""
    for path in folder.iterdir():
        if not path.is_dir():
            input_path(path)
    return folder


def register_reader(source: object, *paths: Path) -> None:
    """Register the files that ``source`` reads, or the files in a folder, until it is garbage-collected."""
    _sources[source] = tuple(file for path in paths for file in (path.iterdir() if path.is_dir() else (path,)))


def note_input(path: Path) -> None:
    """Register a file as an input of the running command, unless the command has written it."""
    if _command is not None and (place := path.resolve()) not in _command.written:
        _command.read.add(place)


def note_output(path: Path) -> None:
    """Register a file that the running command has written."""
    if _command is not None:
        _command.written.add(path.resolve())


@contextlib.contextmanager
def inputs_noted(paths: Iterable[Path]) -> Iterator[None]:
    """Treat ``paths``, and the files given to :func:`note_input` within the block, as inputs."""
    global _command
    before, _command = _command, _Command({path.absolute() for path in paths})
    try:
        yield
    finally:
        _command = before


def inputs_in_use() -> tuple[Path, ...]:
    """Return the files that open event sources read, and those that the running command has read."""
    return (*(path for paths in list(_sources.values()) for path in paths), *(_command.read if _command else ()))


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


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line of a UTF-8 file, with one line in memory at a time.

    Raises :class:`AmiwarpError` if the file is not regular or a line is longer than :data:`LONGEST_LINE`.
    """
    with io.TextIOWrapper(open_input(path), "utf-8-sig", "replace") as file:
        number = 0
        while line := file.readline(LONGEST_LINE + 1):
            number += 1
            if len(line) > LONGEST_LINE:
                raise AmiwarpError(
                    f"{path}: line {number} is longer than {LONGEST_LINE} characters; give a text file with one row "
                    "per line"
                )
            yield number, line.rstrip("\n")
