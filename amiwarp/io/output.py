"""The one place that puts files under their names: whole or not at all, over no input, over nothing else unasked."""

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
from amiwarp.io.files import inputs_in_use, inputs_noted, same_file
from amiwarp.regular_file import KINDS

HOST = re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())[:32]
"""Names the machine in the names of unfinished files: process ids mean nothing on another one."""

UNFINISHED = re.compile(r"\..+\.(?P<host>\w+)-(?P<pid>\d+)-[0-9a-f]{8}\.part")
"""What the name of an unfinished file looks like."""


@dataclass
class _Run:
    """What one run of a command may replace."""

    overwrite: bool = False
    folders: list[Path] = field(default_factory=list)


_run = _Run()
_unfinished: set[Path] = set()


@contextlib.contextmanager
def run(inputs: Collection[Path], outputs: Collection[Path], *, overwrite: bool) -> Iterator[None]:
    """Guard a whole command: none of its ``inputs`` is written, and what exists only if ``overwrite``.

    Raises :class:`AmiwarpError` at once if one of the ``outputs`` is an input, is named twice, exists or cannot be
    written. At the end nothing unfinished is left, whatever happened.
    """
    global _run
    before, _run = _run, _Run(overwrite)
    try:
        with inputs_noted(inputs):
            targets: set[Path] = set()
            for path in outputs:
                target = check_output(path)
                if target in targets:
                    raise AmiwarpError(f"{path}: is given for two outputs; give each its own name")
                targets.add(target)
            yield
    finally:
        _run = before
        _discard_unfinished()


@contextlib.contextmanager
def own_folder(path: Path) -> Iterator[None]:
    """Let files in a folder be replaced that holds nothing but what the same job wrote before."""
    folder = path.resolve()
    _run.folders.append(folder)
    try:
        yield
    finally:
        _run.folders.remove(folder)


def check_output(path: Path, *, overwrite: bool = False) -> Path:
    """Return the file that writing to ``path`` makes or replaces: ``path`` itself, or what a symbolic link leads to.

    Raises :class:`AmiwarpError` if it is a file that is read in this run, exists and may not be replaced, is no
    regular file, or if its folder does not exist.
    """
    try:
        target = path.resolve()
        mode = target.stat().st_mode if os.path.lexists(target) else None
    except (OSError, RuntimeError) as error:  # a loop of links
        raise AmiwarpError(f"{path}: cannot be written: {_reason(error)}; give another name") from error
    if mode is not None and not stat.S_ISREG(mode):
        what = KINDS.get(stat.S_IFMT(mode), "no regular file")
        raise AmiwarpError(f"{path}: is {what}; give the name of a file")
    if not target.parent.is_dir():
        raise AmiwarpError(f"{path}: its folder {target.parent} does not exist; make it first")
    if not os.access(target.parent, os.W_OK):
        raise AmiwarpError(f"{path}: nothing may be written in its folder {target.parent}; choose another place")
    if mode is not None:
        if any(same_file(read, target) for read in inputs_in_use()):
            raise AmiwarpError(f"{path}: is read in this run and would be lost; write to another file")
        if not _may_replace(target, overwrite):
            raise AmiwarpError(f"{path}: exists; give another name, or --force (overwrite=True in Python)")
    return target


def _may_replace(target: Path, overwrite: bool) -> bool:
    return overwrite or _run.overwrite or target.parent in _run.folders


class NewFile:
    """A file that is written next to ``path`` and takes that name when it is whole.

    In a ``with`` block it does so at the end, and is gone after an exception. Raises :class:`AmiwarpError` as
    :func:`check_output` does, when it begins and once more before it takes its name.
    """

    def __init__(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._overwrite = overwrite
        target = check_output(self.path, overwrite=overwrite)
        remove_abandoned(target.parent)
        self.part = _unfinished_name(target)
        """Where to write."""
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
        """Give the file its name."""
        put_in_place(self.part, self.path, overwrite=self._overwrite)
        _unfinished.discard(self.part)

    def discard(self) -> None:
        """Remove what was written, if it has not got its name."""
        _remove(self.part)


def put_in_place(part: Path, path: Path, *, overwrite: bool = False) -> None:
    """Rename ``part`` to what ``path`` leads to. Raises :class:`AmiwarpError`, and leaves it, if that may not be."""
    target = check_output(path, overwrite=overwrite)
    try:
        if not _may_replace(target, overwrite):
            _link(part, target)
            return
        if os.path.lexists(target):
            shutil.copymode(target, part)
        os.replace(part, target)
    except FileExistsError as error:
        raise AmiwarpError(f"{path}: was made by another program meanwhile; give another name") from error
    except OSError as error:
        raise AmiwarpError(f"{path}: cannot be written: {_reason(error)}; choose another place") from error


def _link(part: Path, target: Path) -> None:
    """Rename without replacing: renaming itself would replace what another program made a moment ago."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        os.replace(part, target)
    else:
        part.unlink()


def allocate(handle: int, start: int, count: int) -> None:
    """Take room on the disk for bytes of a file; OSError if there is none. Systems that cannot do so are left out."""
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(handle, start, count)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
                raise


@contextlib.contextmanager
def scratch_folder(folder: Path) -> Iterator[Path]:
    """Make a folder for temporary files; it is removed at the end, or by the next run if this one is killed."""
    remove_abandoned(folder.resolve())
    made = _unfinished_name(folder.resolve() / "scratch")
    _unfinished.add(made)
    try:
        made.mkdir()
        yield made
    finally:
        _remove(made)


def _unfinished_name(target: Path) -> Path:
    return target.with_name(f".{target.name[:40]}.{HOST}-{os.getpid()}-{secrets.token_hex(4)}.part")


def write_text(path: Path, text: str, *, overwrite: bool = False) -> None:
    """Write a text file, whole or not at all. Raises :class:`AmiwarpError` as :class:`NewFile` does."""
    with NewFile(path, overwrite=overwrite) as new:
        new.part.write_text(text)


def make_folder(path: Path) -> None:
    """Make a folder and those above it. Raises :class:`AmiwarpError` if that cannot be done."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AmiwarpError(f"{path}: cannot be made a folder: {_reason(error)}; choose another --out") from error


@cache
def remove_abandoned(folder: Path) -> None:
    """Remove, once a process, the unfinished files that killed processes of this machine left in ``folder``."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            found = UNFINISHED.fullmatch(entry.name)
            if found and found["host"] == HOST and not _is_alive(int(found["pid"])):
                _remove(folder / entry.name)


def _is_alive(pid: int) -> bool:
    if os.name != "posix":  # asking would end the process
        return True
    try:
        os.kill(pid, 0)
    except OSError as error:
        return error.errno != errno.ESRCH
    return True


@atexit.register
def _discard_unfinished() -> None:
    """Remove what this process, not one that it was forked from, has begun and not finished."""
    for part in list(_unfinished):
        if f"-{os.getpid()}-" in part.name:
            _remove(part)
    _unfinished.clear()


def _remove(unfinished: Path) -> None:
    """Remove an unfinished file, or a folder of them, if it is there."""
    with contextlib.suppress(OSError):
        if unfinished.is_dir() and not unfinished.is_symlink():
            shutil.rmtree(unfinished)
        else:
            unfinished.unlink(missing_ok=True)
    _unfinished.discard(unfinished)


def _reason(error: BaseException) -> str:
    return getattr(error, "strerror", None) or str(error)
