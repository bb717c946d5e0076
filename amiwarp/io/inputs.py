"""How inputs are opened, and which files the running command reads.

Every reader of the package opens its files with :func:`open_input` or :func:`read_text`, or gives :func:`input_path` to
a library that opens files. So each input is a regular file, and no writer replaces it. A pipe or a device could block
its reader, or never end.
"""

from __future__ import annotations

import contextlib
import io
import os
import stat
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amiwarp.errors import WORD_HEAD, AmiwarpError, ErrorCode, printable
from amiwarp.validation import check_name_lengths

KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe (FIFO)",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
}
"""Names of the file types that are refused, used in messages."""


def check_regular(path: Path) -> None:
    """Check that ``path``, symbolic links followed, is a regular file, without opening it.

    Raises
    ------
    AmiwarpError
        If the file does not exist or cannot be reached, or is a folder, a named pipe, a socket or a device; or if a
        name is too long.
    """
    check_name_lengths(path)
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except FileNotFoundError as error:
        raise AmiwarpError(f"{path}: no such file", ErrorCode.FILE_MISSING) from error
    except (OSError, ValueError) as error:
        what = getattr(error, "strerror", None) or error
        raise AmiwarpError(
            f"{path}: cannot be opened: {what}; give another file", ErrorCode.FILE_UNREADABLE
        ) from error
    if kind != stat.S_IFREG:
        raise AmiwarpError(
            f"{path}: is {KINDS.get(kind, 'not a regular file')}; give a regular file",
            ErrorCode.FILE_UNREADABLE,
        )


LONGEST_LINE = 1000
"""Longest accepted line of a text file [characters]."""

_sources: weakref.WeakKeyDictionary[object, tuple[Path, ...]] = weakref.WeakKeyDictionary()
"""Files that each open event source reads, or folders of them."""


@dataclass
class _Command:
    """Files of the running command."""

    read: set[Path]
    """Files that it has read."""
    written: set[Path] = field(default_factory=set)
    """Files that it has written itself. They are no inputs, even if it reads them."""
    folders: list[Path] = field(default_factory=list)
    """Folders that it has made, inner ones before outer ones."""


_command: _Command | None = None
"""Files of the running command, or None if no command runs."""


class _Input(io.FileIO):
    """Open input whose read errors, for example of a damaged disk, are :class:`AmiwarpError`."""

    def readinto(self, buffer: Any) -> int | None:
        with self._errors_named():
            return super().readinto(buffer)

    def readall(self) -> bytes:
        with self._errors_named():
            return super().readall()

    @contextlib.contextmanager
    def _errors_named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            reason = f"{self.name}: cannot be read: {reason_of(error)}"
            raise AmiwarpError(
                f"{reason}; check the disk, or copy the file again", ErrorCode.FILE_UNREADABLE
            ) from error


def open_input(path: str | os.PathLike[str], *, noted: bool = True) -> io.BufferedReader:
    """Open an input for reading. ``noted`` is False for results that the command continues, and so may replace.

    Raises :class:`AmiwarpError` if the file cannot be opened or is not a regular file, and later if it cannot be read.
    """
    path = Path(path)
    check_regular(path)
    try:
        file: io.BufferedReader = io.BufferedReader(_Input(path))
    except OSError as error:
        raise AmiwarpError(
            f"{path}: cannot be opened: {error.strerror}; give another file",
            ErrorCode.FILE_UNREADABLE,
        ) from error
    if noted:
        note_input(path)
    return file


def read_text(
    path: str | os.PathLike[str],
    *,
    encoding: str = "utf-8",
    errors: str = "strict",
    noted: bool = True,
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
    """Register the files that ``source`` reads, or folders with such files, until it is garbage-collected."""
    _sources[source] = paths


def note_input(path: Path) -> None:
    """Register a file as an input of the running command, unless the command has written it."""
    if _command is None:
        return
    place = path.resolve()
    if place not in _command.written:
        _command.read.add(place)


def note_output(path: Path) -> None:
    """Register a file that the running command has written."""
    if _command is not None:
        _command.written.add(path.resolve())


def note_folders(paths: Iterable[Path]) -> None:
    """Register folders that the running command has made, inner ones before outer ones."""
    if _command is not None:
        _command.folders.extend(paths)


@contextlib.contextmanager
def inputs_noted(paths: Iterable[Path]) -> Iterator[_Command]:
    """Treat ``paths``, and the files given to :func:`note_input` within the block, as inputs."""
    global _command
    before = _command
    _command = _Command({path.absolute() for path in paths})
    try:
        yield _command
    finally:
        _command = before


def inputs_in_use() -> tuple[Path, ...]:
    """Return the files that open event sources read, and those that the running command has read."""
    files: list[Path] = []
    for paths in list(_sources.values()):
        for path in paths:
            files += path.iterdir() if path.is_dir() else [path]
    if _command is not None:
        files += _command.read
    return tuple(files)


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
        # The error may name the file, or a file in this folder, already.
        named = tuple(printable(f"{path}{end}")[:WORD_HEAD] for end in ":/\\")
        if str(error).startswith(named):
            raise
        raise AmiwarpError(f"{path}: {place()}: {error}") from error
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except FileNotFoundError as error:
        raise AmiwarpError(f"{path}: no such file", ErrorCode.FILE_MISSING) from error
    except ImportError as error:
        raise AmiwarpError(
            f"{path}: is not read, because a library cannot be loaded: {error}; repair it"
        ) from error
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


def reason_of(error: BaseException) -> str:
    return getattr(error, "strerror", None) or str(error)
