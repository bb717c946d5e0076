"""Writing of files: each appears under its name complete or not at all.

No input is overwritten, and other files only on request. All writers of the package use this module.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import re
import secrets
import shutil
import socket
import stat
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import TracebackType

from amiwarp.errors import AmiwarpError
from amiwarp.io.input_files import inputs_in_use, inputs_noted, same_file
from amiwarp.io.regular_file import KINDS

HOST = re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())[:32]
"""Name of this machine, which is part of the names of unfinished files: process ids are valid on one machine only."""

UNFINISHED = re.compile(r"\..+\.(?P<host>\w+)-(?P<pid>\d+)-[0-9a-f]{8}\.part")
"""Pattern of the names of unfinished files, with the machine and the process that writes them."""


@dataclass
class _Permissions:
    """Files that the running command may replace."""

    overwrite: bool = False
    """Whether all existing files may be replaced."""
    folders: list[Path] = field(default_factory=list)
    """Folders in which existing files may be replaced."""


_permissions = _Permissions()
_unfinished: set[Path] = set()
"""Unfinished files and scratch folders of this process."""


@contextlib.contextmanager
def run(inputs: Collection[Path], outputs: Collection[Path], *, overwrite: bool) -> Iterator[None]:
    """Protect files during a command: ``inputs`` are not overwritten, existing files only with ``overwrite``.

    Raises :class:`AmiwarpError` immediately if one of the ``outputs`` is an input, is given twice, exists or cannot be
    written. At the end all unfinished files are removed.
    """
    global _permissions
    before, _permissions = _permissions, _Permissions(overwrite)
    try:
        with inputs_noted(inputs):
            targets: set[Path] = set()
            for path in outputs:
                target = check_output(path)
                if target in targets:
                    raise AmiwarpError(f"{path}: is given for two outputs; give each output its own name")
                targets.add(target)
            yield
    finally:
        _permissions = before
        _discard_unfinished()


@contextlib.contextmanager
def own_folder(path: Path) -> Iterator[None]:
    """Allow this command to replace existing files in a folder that only holds the command's own results."""
    folder = path.resolve()
    _permissions.folders.append(folder)
    try:
        yield
    finally:
        _permissions.folders.remove(folder)


def check_output(path: Path, *, overwrite: bool = False) -> Path:
    """Return the file that writing to ``path`` creates or replaces: ``path`` itself, or the target of a symbolic link.

    Raises :class:`AmiwarpError` if the file is read in this run, exists and must not be replaced, or is not a regular
    file; and if its folder does not exist or is not writable.
    """
    try:
        target = path.resolve()
        mode = target.stat().st_mode if os.path.lexists(target) else None
    except (OSError, RuntimeError) as error:  # a loop of links
        raise AmiwarpError(f"{path}: cannot be written: {_reason(error)}; give another name") from error
    if mode is not None and not stat.S_ISREG(mode):
        what = KINDS.get(stat.S_IFMT(mode), "not a regular file")
        raise AmiwarpError(f"{path}: is {what}; give the name of a file")
    if not target.parent.is_dir():
        raise AmiwarpError(f"{path}: its folder {target.parent} does not exist; create it first")
    if not os.access(target.parent, os.W_OK):
        raise AmiwarpError(f"{path}: its folder {target.parent} is not writable; choose another place")
    if mode is not None:
        if any(same_file(read, target) for read in inputs_in_use()):
            raise AmiwarpError(f"{path}: is read in this run and would be lost; write to another file")
        if not _may_replace(target, overwrite):
            raise AmiwarpError(f"{path}: exists; give another name, or --force (overwrite=True in Python)")
    return target


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
        self.part = _unfinished_name(target)
        """Path of the unfinished file, to which the caller writes."""
        _unfinished.add(self.part)

    def __enter__(self) -> NewFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.commit()
            elif isinstance(error, OSError):
                raise AmiwarpError(f"{self.path}: cannot be written: {_reason(error)}; choose another place") from error
        finally:
            self.discard()

    def commit(self) -> None:
        """Rename the unfinished file to its final name."""
        put_in_place(self.part, self.path, overwrite=self._overwrite)
        _unfinished.discard(self.part)

    def discard(self) -> None:
        """Remove the file if it is unfinished."""
        _remove(self.part)


def put_in_place(part: Path, path: Path, *, overwrite: bool = False) -> None:
    """Rename the file ``part`` to the target of ``path``.

    If that is not allowed, raise :class:`AmiwarpError` and keep ``part``.
    """
    target = check_output(path, overwrite=overwrite)
    try:
        if not _may_replace(target, overwrite):
            _link(part, target)
            return
        if os.path.lexists(target):
            shutil.copymode(target, part)
        os.replace(part, target)
    except FileExistsError as error:
        raise AmiwarpError(f"{path}: was created by another program meanwhile; give another name") from error
    except OSError as error:
        raise AmiwarpError(f"{path}: cannot be written: {_reason(error)}; choose another place") from error


def _link(part: Path, target: Path) -> None:
    """Rename a file, but do not replace a file that another program has just created, as os.replace would."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        os.replace(part, target)
    else:
        part.unlink()


def allocate(handle: int, start: int, count: int) -> None:
    """Reserve disk space for a file.

    Raises OSError if the disk is full. Systems that cannot reserve space do nothing.
    """
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(handle, start, count)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
                raise


@contextlib.contextmanager
def scratch_folder(folder: Path) -> Iterator[Path]:
    """Create a folder for temporary files. It is removed at the end, or by the next run if the process is killed."""
    remove_abandoned(folder.resolve())
    made = _unfinished_name(folder.resolve() / "scratch")
    _unfinished.add(made)
    try:
        made.mkdir()
        yield made
    finally:
        _remove(made)


def _unfinished_name(target: Path) -> Path:
    """Return a new name for the unfinished version of a file."""
    return target.with_name(f".{target.name[:40]}.{HOST}-{os.getpid()}-{secrets.token_hex(4)}.part")


def write_text(path: Path, text: str, *, overwrite: bool = False) -> None:
    """Write a text file, complete or not at all. Raises :class:`AmiwarpError` as :class:`NewFile` does."""
    with NewFile(path, overwrite=overwrite) as new:
        new.part.write_text(text)


def make_folder(path: Path) -> None:
    """Create a folder and its parents. Raises :class:`AmiwarpError` if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AmiwarpError(f"{path}: cannot be made a folder: {_reason(error)}; choose another --out") from error


@cache
def remove_abandoned(folder: Path) -> None:
    """Remove unfinished files in ``folder`` of killed processes of this machine. Done once per process."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            found = UNFINISHED.fullmatch(entry.name)
            if found and found["host"] == HOST and not _is_alive(int(found["pid"])):
                _remove(folder / entry.name)


def _is_alive(pid: int) -> bool:
    if os.name != "posix":  # on Windows, os.kill would end the process
        return True
    try:
        os.kill(pid, 0)
    except OSError as error:
        return error.errno != errno.ESRCH
    return True


@atexit.register
def _discard_unfinished() -> None:
    """Remove the unfinished files of this process, but not files of the process that it was forked from."""
    for part in list(_unfinished):
        if f"-{os.getpid()}-" in part.name:
            _remove(part)
    _unfinished.clear()


def _remove(unfinished: Path) -> None:
    """Remove an unfinished file or scratch folder, if it exists."""
    with contextlib.suppress(OSError):
        if unfinished.is_dir() and not unfinished.is_symlink():
            shutil.rmtree(unfinished)
        else:
            unfinished.unlink(missing_ok=True)
    _unfinished.discard(unfinished)


def _reason(error: BaseException) -> str:
    return getattr(error, "strerror", None) or str(error)
