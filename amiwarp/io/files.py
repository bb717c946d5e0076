"""How inputs are opened, and how outputs appear under their names complete or not at all.

Every reader of the package opens its files with :func:`open_input` or :func:`read_text`, or gives :func:`input_path` to
a library that opens files. So each input is a regular file, and no writer replaces it. Every writer of the package uses
:class:`NewFile` or :func:`scratch_folder`. Other files are overwritten only on request.
"""

from __future__ import annotations

import atexit
import contextlib
import csv
import errno
import gc
import io
import os
import re
import secrets
import shutil
import stat
import threading
import weakref
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from amiwarp.errors import WORD_HEAD, AmiwarpError, printable
from amiwarp.tasks import interrupts_later
from amiwarp.validation import LONGEST_NAME, check_name_lengths

# Check that an input is a regular file. A pipe or a device could block its reader, or never end.

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
        raise AmiwarpError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        what = getattr(error, "strerror", None) or error
        raise AmiwarpError(f"{path}: cannot be opened: {what}; give another file") from error
    if kind != stat.S_IFREG:
        raise AmiwarpError(f"{path}: is {KINDS.get(kind, 'not a regular file')}; give a regular file")


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
    """Open input whose read errors, such as those of a damaged disk, are :class:`AmiwarpError`."""

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
            reason = f"{self.name}: cannot be read: {_reason(error)}"
            raise AmiwarpError(f"{reason}; check the disk, or copy the file again") from error


def open_input(path: str | os.PathLike[str], *, noted: bool = True) -> io.BufferedReader:
    """Open an input for reading. ``noted`` is False for results that the command continues, and so may replace.

    Raises :class:`AmiwarpError` if the file cannot be opened or is not a regular file, and later if it cannot be read.
    """
    path = Path(path)
    check_regular(path)
    try:
        file: io.BufferedReader = io.BufferedReader(_Input(path))
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
    """Register the files that ``source`` reads, or folders with such files, until it is garbage-collected."""
    _sources[source] = paths


def note_input(path: Path) -> None:
    """Register a file as an input of the running command, unless the command has written it."""
    if _command is not None and (place := path.resolve()) not in _command.written:
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
    before, _command = _command, _Command({path.absolute() for path in paths})
    try:
        yield _command
    finally:
        _command = before


def inputs_in_use() -> tuple[Path, ...]:
    """Return the files that open event sources read, and those that the running command has read."""
    given = [path for paths in list(_sources.values()) for path in paths]
    files = [file for path in given for file in (path.iterdir() if path.is_dir() else (path,))]
    return (*files, *(_command.read if _command else ()))


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
        if str(error).startswith(tuple(printable(f"{path}{end}")[:WORD_HEAD] for end in ":/\\")):
            raise
        raise AmiwarpError(f"{path}: {place()}: {error}") from error
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except FileNotFoundError as error:
        raise AmiwarpError(f"{path}: no such file") from error
    except ImportError as error:
        raise AmiwarpError(f"{path}: is not read, because a library cannot be loaded: {error}; repair it") from error
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


# Names of files that are no recordings, by their first bytes, and what to do with them.

TABLE = "save x, y, t [us] and p from it as .npz"
VIDEO = "make events of it with amiwarp translate"
PICTURE = "make events of it with amiwarp simulate --picture"
MATLAB = "save x, y, t [us] and p from it as .npz, or as text 't x y p'"
CAPTURE = "give the events as the camera's software saves them"
UNPACK = "unpack it first"

MISTAKEN_FILES: tuple[tuple[int, bytes, str, str], ...] = (
    # position, bytes, what the file is, what to do
    (0, b"\x89PNG\r\n\x1a\n", "a PNG picture", PICTURE),
    (0, b"\xff\xd8\xff", "a JPEG picture", PICTURE),
    (0, b"GIF8", "a GIF picture", PICTURE),
    (0, b"BM", "a BMP picture", PICTURE),
    (0, b"II*\0", "a TIFF picture", PICTURE),
    (0, b"MM\0*", "a TIFF picture", PICTURE),
    (8, b"WEBP", "a WebP picture", PICTURE),
    (4, b"ftyp", "an MP4 video", VIDEO),
    (8, b"AVI ", "an AVI video", VIDEO),
    (0, b"\x1aE\xdf\xa3", "a Matroska or WebM video", VIDEO),
    (0, b"\x1f\x8b", "a gzip archive", UNPACK),
    (0, b"BZh", "a bzip2 archive", UNPACK),
    (0, b"\xfd7zXZ\0", "an xz archive", UNPACK),
    (0, b"\x28\xb5\x2f\xfd", "a Zstandard archive", UNPACK),
    (0, b"\x04\x22\x4d\x18", "an LZ4 archive", UNPACK),
    (0, b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive", UNPACK),
    (0, b"Rar!\x1a\x07", "a RAR archive", UNPACK),
    (257, b"ustar", "a tar archive", UNPACK),
    (0, b"\xd4\xc3\xb2\xa1", "a pcap capture of network packets", CAPTURE),
    (0, b"\xa1\xb2\xc3\xd4", "a pcap capture of network packets", CAPTURE),
    (0, b"\x4d\x3c\xb2\xa1", "a pcap capture of network packets", CAPTURE),
    (0, b"\n\r\r\n", "a pcapng capture of network packets", CAPTURE),
    (0, b"ARROW1", "an Arrow table", TABLE),
    (0, b"\x80\x04\x95", "a Python pickle", "save x, y, t [us] and p from it as .npz; pickles are never loaded"),
    (0, b"#ROSBAG V1", "a ROS 1 bag of version 1", "run rosbag migrate and rosbag reindex"),
    (0, b"%PDF", "a PDF document", "give a recording"),
    (0, b"\x7fELF", "a program", "give a recording"),
    (0, b"<?xml", "an XML document", "give a recording"),
    (0, b"{", "a JSON document", "give a recording; a calibration goes to --calibration, a camera to --camera"),
)
"""Files that are often mistaken for recordings."""


def name_kind(head: bytes) -> str | None:
    """Return what a file is and what to do with it, from its first bytes, or None if it is unknown."""
    for at, magic, what, remedy in MISTAKEN_FILES:
        if head[at : at + len(magic)] == magic:
            return f"is {what}; {remedy}"
    if head.startswith(b"RIFF"):
        return "is a RIFF file of sound or pictures; give a recording"
    return None


# Outputs.
#
# A process that writes into a folder holds a lock on an empty file there. The names of its unfinished files contain the
# name of that file. If the lock is free, the process has ended. Process ids would mean nothing in another container.

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
    written. At the end all unfinished files are removed, and the folders that the command has made and left empty.
    """
    global _permissions
    before, _permissions = _permissions, _Permissions(overwrite)
    made: list[Path] = []
    try:
        with inputs_noted(inputs) as command:
            made = command.folders
            targets: set[Path] = set()
            for path in outputs:
                target = check_output(path)
                if target in targets:
                    raise AmiwarpError(f"{path}: is given for two outputs; give each output its own name")
                targets.add(target)
            for path in outputs:  # a folder that takes no files is found before the work and before the first output
                NewFile(path).discard()
            yield
    finally:
        _permissions = before
        _discard_unfinished()
        for folder in made:
            with contextlib.suppress(OSError):  # it is not empty
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
    except (ImportError, OSError):  # Windows, which does not open folders
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        what = "another command writes its results to this folder; wait for its end, or give another folder"
        raise AmiwarpError(f"{folder}: {what}") from error
    except OSError:  # a file system without locks
        os.close(handle)
        return None
    return handle


def _unlock(handle: int) -> None:
    """Unlock a folder, also for a worker process that was forked meanwhile and holds the handle too."""
    import fcntl

    fcntl.flock(handle, fcntl.LOCK_UN)
    os.close(handle)


def check_output(path: Path, *, overwrite: bool = False) -> Path:
    """Return the file that writing to ``path`` creates or replaces: ``path`` itself, or the target of a symbolic link.

    Raises :class:`AmiwarpError` if the file is read in this run, exists and must not be replaced, or is not a regular
    file; if its folder does not exist or is not writable; and if its name is too long for the folder's file system.
    """
    check_name_lengths(path)
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
    check_name_lengths(path, _longest_name(target.parent))
    if not os.access(target.parent, os.W_OK):
        raise AmiwarpError(f"{path}: its folder {target.parent} is not writable; choose another place")
    if mode is not None:
        if _is_read(target):
            raise AmiwarpError(f"{path}: is read in this run and would be lost; write to another file")
        if not _may_replace(target, overwrite):
            raise AmiwarpError(f"{path}: exists; give another name, or --force (overwrite=True in Python)")
    return target


def _longest_name(folder: Path) -> int:
    """Return the limit of names in a folder [bytes]. Some file systems have a smaller one than others."""
    with contextlib.suppress(AttributeError, OSError, ValueError):  # Windows has no such function
        limit = os.pathconf(folder, "PC_NAME_MAX")
        return min(limit, LONGEST_NAME) if limit > 0 else LONGEST_NAME
    return LONGEST_NAME


def _is_read(target: Path) -> bool:
    """Return whether a file is read in this run. Sources that a garbage collection releases are in use no more."""

    def found() -> bool:
        return any(same_file(read, target) for read in inputs_in_use())

    if found():
        gc.collect()
    return found()


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
        with contextlib.suppress(PermissionError):  # Windows, if the file is open: the name is removed at the exit
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


_seeking = threading.Lock()  # on systems without os.pread, a place is reached by moving the file's position


def read_at(handle: int, buffer: Any, place: int) -> int:
    """Read bytes at a place of a file [bytes] into ``buffer``, and return their number. Any thread may call it."""
    if hasattr(os, "preadv"):
        return os.preadv(handle, [buffer], place)
    view = memoryview(buffer).cast("B")
    with _seeking:
        os.lseek(handle, place, os.SEEK_SET)
        data = os.read(handle, len(view))
    view[: len(data)] = data
    return len(data)


def write_at(handle: int, parts: Sequence[Any], place: int) -> int:
    """Write parts one after the other at a place of a file [bytes], and return how many bytes were written."""
    if hasattr(os, "pwritev"):
        return os.pwritev(handle, parts, place)
    with _seeking:
        os.lseek(handle, place, os.SEEK_SET)
        return os.write(handle, parts[0])


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
    with interrupts_later(), _locks_guard:
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
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").replace("-", "")[:12]
    import uuid

    return f"{uuid.getnode():012x}"


def _forget(part: Path) -> None:
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


def write_text(path: Path, text: str, *, overwrite: bool = False) -> None:
    """Write a text file, complete or not at all. Raises :class:`AmiwarpError` as :class:`NewFile` does."""
    with NewFile(path, overwrite=overwrite) as new:
        new.part.write_text(text, encoding="utf-8", newline="\n")


def write_csv(path: Path, names: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a table as CSV, with a first line of ``names``, as :func:`write_text` does."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    write_text(path, text.getvalue())


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
