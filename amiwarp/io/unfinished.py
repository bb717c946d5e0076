"""Unfinished files and scratch folders, which are removed also if their process is killed.

A process that writes into a folder holds a lock on an empty file there. The names of its unfinished files contain the
name of that file. If the lock is free, the process has ended. Process ids would mean nothing in another container.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import re
import secrets
import shutil
import threading
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import IO

from amiwarp.tasks import interrupts_later

UNFINISHED = re.compile(
    r"\.(?:.+\.)?(?P<owner>(?P<system>[0-9a-f]{12})-[0-9a-f]{8})(?:-[0-9a-f]{8})?\.part"
)
"""Pattern of the names of unfinished files and of lock files, with the running system and the lock of their owner."""


@dataclass
class _Lock:
    """Lock of this process in a folder, with the unfinished files and scratch folders that it protects there."""

    owner: str
    """Part of the names of these files."""
    file: IO[bytes]
    """The open lock file."""
    files: set[Path] = field(default_factory=set)
    """Paths of the unfinished files and scratch folders."""


_locks: dict[Path, _Lock] = {}
"""Locks of this process, by folder."""

_locks_guard = threading.RLock()


@contextlib.contextmanager
def scratch_folder(folder: Path) -> Iterator[Path]:
    """Create a folder for temporary files. It is removed at the end, or by the next run if the process is killed."""
    remove_abandoned(folder.resolve())
    made = unfinished_name(folder.resolve() / "scratch")
    try:
        made.mkdir()
        yield made
    finally:
        remove_unfinished(made)


def unfinished_name(target: Path) -> Path:
    """Return a new name for the unfinished version of a file. No other process removes it while this one lives."""
    with interrupts_later(), _locks_guard:
        lock = _locks.get(target.parent)
        if lock is None:
            lock = _locks.setdefault(target.parent, _take_lock(target.parent))
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
        # Another process took it for abandoned before it was locked, and removes it.
        file.close()


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
        boot_id = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        return boot_id.replace("-", "")[:12]
    import uuid

    return f"{uuid.getnode():012x}"


def forget_unfinished(part: Path) -> None:
    """Take a file that was removed or renamed from the unfinished files; release the lock after the last."""
    with interrupts_later(), _locks_guard:
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


@cache
def remove_abandoned(folder: Path) -> None:
    """Remove unfinished files in ``folder`` of processes that were killed since this system started.

    Done once per process. Files are kept if it is not certain that their process has ended: files of other systems,
    without a lock file, or on file systems without locks.
    """
    abandoned: dict[str, list[Path]] = defaultdict(list)
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = UNFINISHED.fullmatch(entry.name)
            if match and match["system"] == _system():
                abandoned[match["owner"]].append(folder / entry.name)
    for owner, paths in abandoned.items():
        path = _lock_path(folder, owner)
        with contextlib.suppress(OSError), open(path, "r+b") as file:
            if _lock(file):
                parts = [part for part in paths if part != path]
                for part in parts:
                    remove_unfinished(part)
                if not any(os.path.lexists(part) for part in parts):
                    path.unlink()


@atexit.register
def discard_all_unfinished() -> None:
    """Remove the unfinished files of this process."""
    for lock in list(_locks.values()):
        for part in list(lock.files):
            remove_unfinished(part)


def remove_unfinished(unfinished: Path) -> None:
    """Remove an unfinished file or scratch folder, if it exists."""
    with contextlib.suppress(OSError):
        if unfinished.is_dir() and not unfinished.is_symlink():
            shutil.rmtree(unfinished)
        else:
            unfinished.unlink(missing_ok=True)
    if not os.path.lexists(unfinished):
        forget_unfinished(unfinished)
