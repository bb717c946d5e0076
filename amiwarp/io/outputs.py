"""How outputs appear under their names complete or not at all.

Every writer of the package uses :class:`NewFile` or :func:`~amiwarp.io.unfinished.scratch_folder`. Other files are
overwritten only on request.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import gc
import io
import os
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import KINDS, inputs_in_use, inputs_noted, note_output, reason_of, same_file
from amiwarp.io.unfinished import (
    discard_all_unfinished,
    forget_unfinished,
    remove_abandoned,
    remove_unfinished,
    unfinished_name,
)
from amiwarp.validation import LONGEST_NAME, check_name_lengths


@dataclass
class _Permissions:
    """Files that the running command may replace."""

    overwrite: bool = False
    """Whether all existing files may be replaced."""
    folders: list[Path] = field(default_factory=list)
    """Folders in which existing files may be replaced."""


_permissions = _Permissions()


@contextlib.contextmanager
def protecting_files(
    inputs: Collection[Path], outputs: Collection[Path], *, overwrite: bool
) -> Iterator[None]:
    """Protect files during a command: ``inputs`` are not overwritten, existing files only with ``overwrite``.

    Raises :class:`AmiwarpError` immediately if one of the ``outputs`` is an input, is given twice, exists or cannot be
    written. At the end all unfinished files are removed, and the folders that the command has made and left empty.
    """
    global _permissions
    before = _permissions
    _permissions = _Permissions(overwrite)
    made: list[Path] = []
    try:
        with inputs_noted(inputs) as command:
            made = command.folders
            targets: set[Path] = set()
            for path in outputs:
                target = check_output(path)
                if target in targets:
                    raise AmiwarpError(
                        f"{path}: is given for two outputs; give each output its own name",
                        ErrorCode.OPTIONS,
                    )
                targets.add(target)
            # A folder that takes no files is found before the work, and before the first output.
            for path in outputs:
                NewFile(path).discard()
            yield
    finally:
        _permissions = before
        discard_all_unfinished()
        for folder in made:
            # A folder that is not empty stays.
            with contextlib.suppress(OSError):
                folder.rmdir()


@contextlib.contextmanager
def own_folder(path: Path) -> Iterator[None]:
    """Allow this command to replace existing files in a folder that only holds the command's own results."""
    folder = path.resolve()
    _permissions.folders.append(folder)
    try:
        yield
    finally:
        _permissions.folders.remove(folder)


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Lock a folder in which a command continues earlier results, so that no other command does so meanwhile.

    The folder itself is locked, so that no lock file can be left. Raises :class:`AmiwarpError` if it is locked already.
    File systems without locks are not locked.
    """
    handle = _lock_folder(folder)
    try:
        yield
    finally:
        if handle is not None:
            _unlock(handle)


def _lock_folder(folder: Path) -> int | None:
    """Lock a folder, and return its open handle; None without locks."""
    try:
        import fcntl

        handle = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):
        # Windows does not open folders.
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        what = "another command writes its results to this folder; wait for its end, or give another folder"
        raise AmiwarpError(f"{folder}: {what}") from error
    except OSError:
        # The file system has no locks.
        os.close(handle)
        return None
    return handle


def _unlock(handle: int) -> None:
    """Unlock a folder, also for a worker process that was forked meanwhile and holds the handle too."""
    import fcntl

    fcntl.flock(handle, fcntl.LOCK_UN)
    os.close(handle)


def not_written(
    path: str | os.PathLike[str], error: BaseException, remedy: str = "choose another place"
) -> AmiwarpError:
    """Return the error for an output that the system refuses to write."""
    full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
    code = ErrorCode.DISK_FULL if full else ErrorCode.OUTPUT_FAILED
    return AmiwarpError(f"{path}: cannot be written: {reason_of(error)}; {remedy}", code)


def check_output(path: Path, *, overwrite: bool = False) -> Path:
    """Return the file that writing to ``path`` creates or replaces: ``path`` itself, or the target of a symbolic link.

    Raises :class:`AmiwarpError` if the file is read in this run, exists and must not be replaced, or is not a regular
    file; if its folder does not exist or is not writable; and if its name is too long for the folder's file system.
    """
    check_name_lengths(path)
    try:
        target = path.resolve()
        mode = target.stat().st_mode if os.path.lexists(target) else None
    except (OSError, RuntimeError) as error:
        # A loop of links raises RuntimeError.
        raise not_written(path, error, "give another name") from error
    if mode is not None and not stat.S_ISREG(mode):
        what = KINDS.get(stat.S_IFMT(mode), "not a regular file")
        raise AmiwarpError(f"{path}: is {what}; give the name of a file", ErrorCode.OUTPUT_FAILED)
    if not target.parent.is_dir():
        raise AmiwarpError(
            f"{path}: its folder {target.parent} does not exist; create it first",
            ErrorCode.OUTPUT_FAILED,
        )
    check_name_lengths(path, _longest_name(target.parent))
    if not os.access(target.parent, os.W_OK):
        raise AmiwarpError(
            f"{path}: its folder {target.parent} is not writable; choose another place",
            ErrorCode.OUTPUT_FAILED,
        )
    if mode is not None:
        if _is_read(target):
            raise AmiwarpError(
                f"{path}: is read in this run and would be lost; write to another file",
                ErrorCode.OUTPUT_EXISTS,
            )
        if not _may_replace(target, overwrite):
            raise AmiwarpError(
                f"{path}: exists; give another name, or --force (overwrite=True in Python)",
                ErrorCode.OUTPUT_EXISTS,
            )
    return target


def _longest_name(folder: Path) -> int:
    """Return the limit of names in a folder [bytes]. Some file systems have a smaller one than others."""
    # Windows has no such function.
    with contextlib.suppress(AttributeError, OSError, ValueError):
        limit = os.pathconf(folder, "PC_NAME_MAX")
        if limit > 0:
            return min(limit, LONGEST_NAME)
    return LONGEST_NAME


def _is_read(target: Path) -> bool:
    """Return whether a file is read in this run."""

    def is_in_use() -> bool:
        return any(same_file(read, target) for read in inputs_in_use())

    # A source that nothing refers to any more may only wait for the garbage collection.
    if is_in_use():
        gc.collect()
    return is_in_use()


def _may_replace(target: Path, overwrite: bool) -> bool:
    """Return whether an existing file may be replaced: any file, or a file in a folder of the command's own results."""
    return overwrite or _permissions.overwrite or target.parent in _permissions.folders


class NewFile:
    """File that is written next to ``path`` and renamed to ``path`` when it is complete.

    A ``with`` block renames the file at its end, and removes the file after an exception. Raises :class:`AmiwarpError`
    as :func:`check_output` does, at the start and again before renaming.
    """

    def __init__(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._overwrite = overwrite
        target = check_output(self.path, overwrite=overwrite)
        remove_abandoned(target.parent)
        try:
            self.part = unfinished_name(target)
            """Path of the unfinished file, to which the caller writes."""
        except OSError as error:
            raise not_written(path, error) from error

    def __enter__(self) -> NewFile:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self.commit()
            elif isinstance(error, OSError):
                raise not_written(self.path, error) from error
        finally:
            self.discard()

    def commit(self) -> None:
        """Rename the unfinished file to its final name."""
        put_in_place(self.part, self.path, overwrite=self._overwrite)
        forget_unfinished(self.part)

    def discard(self) -> None:
        """Remove the file if it is unfinished."""
        remove_unfinished(self.part)


def put_in_place(part: Path, path: Path, *, overwrite: bool = False) -> None:
    """Rename the file ``part`` to the target of ``path``.

    If that is not allowed, raise :class:`AmiwarpError` and keep ``part``.
    """
    target = check_output(path, overwrite=overwrite)
    try:
        if _may_replace(target, overwrite):
            if os.path.lexists(target):
                shutil.copymode(target, part)
            os.replace(part, target)
        else:
            link_new(part, target)
    except FileExistsError as error:
        raise AmiwarpError(
            f"{path}: was created by another program meanwhile; give another name",
            ErrorCode.OUTPUT_EXISTS,
        ) from error
    except OSError as error:
        raise not_written(path, error) from error
    note_output(target)


def link_new(part: Path, target: Path) -> None:
    """Rename a file, but do not replace an existing file, as os.replace would. Raises FileExistsError."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise
    except OSError:
        # The file system has no hard links.
        os.replace(part, target)
    else:
        # Windows refuses if the file is open. Then the name is removed at the exit.
        with contextlib.suppress(PermissionError):
            part.unlink()


def write_text(path: Path, text: str, *, overwrite: bool = False) -> None:
    """Write a text file, complete or not at all. Raises :class:`AmiwarpError` as :class:`NewFile` does."""
    with NewFile(path, overwrite=overwrite) as new:
        new.part.write_text(text, encoding="utf-8", newline="\n")


def write_csv(path: Path, names: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a table as CSV, with a first line of ``names``, as :func:`write_text` does."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    write_text(path, text.getvalue())
