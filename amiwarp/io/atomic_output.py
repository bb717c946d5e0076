"""Writing of files: each appears under its name complete or not at all.

No input is overwritten, and other files only on request. All writers of the package use this module.

A process that writes into a folder holds a lock on an empty file there. The names of its unfinished files contain the
name of that file. If the lock is free, the process has ended. Process ids would mean nothing in another container.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import re
import secrets
import shutil
import signal
import stat
import threading
from collections import defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import IO

from amiwarp.errors import AmiwarpError
from amiwarp.io.formats import check_folder
from amiwarp.io.input_files import KINDS, inputs_in_use, inputs_noted, note_output, same_file

UNFINISHED = re.compile(r"\.(?:.+\.)?(?P<owner>(?P<system>[0-9a-f]{12})-[0-9a-f]{8})(?:-[0-9a-f]{8})?\.part")
"""Pattern of the names of unfinished files and of lock files, with the running system and the lock of their owner."""


@dataclass
class _Permissions:
    """Files that the running command may replace."""

    overwrite: bool = False
    """Whether all existing files may be replaced."""
    folders: list[Path] = field(default_factory=list)
    """Folders in which existing files may be replaced."""


@dataclass
class _Lock:
    """Lock of this process in a folder, with the unfinished files and scratch folders that it protects there."""

    owner: str
    """Part of the names of these files."""
    file: IO[bytes]
    """The open lock file."""
    files: set[Path] = field(default_factory=set)
    """Paths of the unfinished files and scratch folders."""


_permissions = _Permissions()
_locks: dict[Path, _Lock] = {}
"""Locks of this process, by folder."""
_locks_guard = threading.RLock()


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
        try:
            self.part = _unfinished_name(target)
            """Path of the unfinished file, to which the caller writes."""
        except OSError as error:
            raise AmiwarpError(f"{path}: cannot be written: {_reason(error)}; choose another place") from error

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
        _forget(self.part)

    def discard(self) -> None:
        """Remove the file if it is unfinished."""
        _remove(self.part)


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
        raise AmiwarpError(f"{path}: was created by another program meanwhile; give another name") from error
    except OSError as error:
        raise AmiwarpError(f"{path}: cannot be written: {_reason(error)}; choose another place") from error
    note_output(target)


def link_new(part: Path, target: Path) -> None:
    """Rename a file, but do not replace an existing file, as os.replace would. Raises FileExistsError."""
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
    try:
        made.mkdir()
        yield made
    finally:
        _remove(made)


def _unfinished_name(target: Path) -> Path:
    """Return a new name for the unfinished version of a file. No other process removes it while this one lives."""
    with _locks_guard:
        lock = _locks.get(target.parent) or _locks.setdefault(target.parent, _take_lock(target.parent))
        part = target.with_name(f".{target.name[:40]}.{lock.owner}-{secrets.token_hex(4)}.part")
        lock.files.add(part)
    return part


def _take_lock(folder: Path) -> _Lock:
    """Create a lock file and lock it, if the file system has locks."""
    while True:
        owner = f"{_system()}-{secrets.token_hex(4)}"
        path = _lock_path(folder, owner)
        file = open(path, "x+b")  # noqa: SIM115
        if _lock(file) is not False and path.exists():
            return _Lock(owner, file)
        file.close()  # another process took it for abandoned before it was locked, and removes it


def _lock(file: IO[bytes]) -> bool | None:
    """Lock a file until it is closed; return False if another process holds the lock, and None without locks."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        return None
    return True


def _lock_path(folder: Path, owner: str) -> Path:
    return folder / f".{owner}.part"


@cache
def _system() -> str:
    """Return 12 digits for the running system. Locks on a network drive may be unknown to other systems."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().replace("-", "")[:12]
    import uuid

    return f"{uuid.getnode():012x}"


def _forget(part: Path) -> None:
    """Take a file that was removed or renamed from the unfinished files; release the lock after the last."""
    with _locks_guard:
        lock = _locks.get(part.parent)
        if lock is None:
            return
        lock.files.discard(part)
        if not lock.files:
            lock.file.close()
            with contextlib.suppress(OSError):
                _lock_path(part.parent, lock.owner).unlink()
            del _locks[part.parent]


def _start_fork() -> None:
    """Leave the unfinished files to the process that this one was forked from. Its locks last until both have ended."""
    global _locks_guard
    _inherited.extend(_locks.values())
    _locks.clear()
    _locks_guard = threading.RLock()


_inherited: list[_Lock] = []
"""Locks of the process that this one was forked from. They stay open."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_start_fork)


def write_text(path: Path, text: str, *, overwrite: bool = False) -> None:
    """Write a text file, complete or not at all. Raises :class:`AmiwarpError` as :class:`NewFile` does."""
    with NewFile(path, overwrite=overwrite) as new:
        new.part.write_text(text)


def make_folder(path: Path) -> None:
    """Create a folder and its parents. Raises :class:`AmiwarpError` if that fails, or for the name of a file."""
    for new in (path, *path.parents):
        if not os.path.lexists(new):
            check_folder(new)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AmiwarpError(f"{path}: cannot be made a folder: {_reason(error)}; choose another --out") from error


@cache
def remove_abandoned(folder: Path) -> None:
    """Remove unfinished files in ``folder`` of processes that were killed since this system started.

    Done once per process. Files are kept if it is not certain that their process has ended: those of other systems, and
    those without a lock file, or on file systems without locks.
    """
    found: dict[str, list[Path]] = defaultdict(list)
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = UNFINISHED.fullmatch(entry.name)
            if match and match["system"] == _system():
                found[match["owner"]].append(folder / entry.name)
    for owner, paths in found.items():
        path = _lock_path(folder, owner)
        with contextlib.suppress(OSError), open(path, "r+b") as file:
            if _lock(file):
                parts = [part for part in paths if part != path]
                for part in parts:
                    _remove(part)
                if not any(os.path.lexists(part) for part in parts):
                    path.unlink()


@atexit.register
def _discard_unfinished() -> None:
    """Remove the unfinished files of this process."""
    for lock in list(_locks.values()):
        for part in list(lock.files):
            _remove(part)


def _remove(unfinished: Path) -> None:
    """Remove an unfinished file or scratch folder, if it exists."""
    with contextlib.suppress(OSError):
        if unfinished.is_dir() and not unfinished.is_symlink():
            shutil.rmtree(unfinished)
        else:
            unfinished.unlink(missing_ok=True)
    if not os.path.lexists(unfinished):
        _forget(unfinished)


def _reason(error: BaseException) -> str:
    return getattr(error, "strerror", None) or str(error)


@contextlib.contextmanager
def interrupts_later() -> Iterator[None]:
    """Postpone Ctrl-C and signals that act like it to the end of the ``with`` block.

    Native code that calls Python, or is left half-done by an exception, cannot close its files and windows.
    """
    arrived: list[int] = []
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            if callable(handler := signal.getsignal(number)):
                before[number] = handler
                signal.signal(number, lambda number, _frame: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if arrived:
            signal.raise_signal(arrived[0])
