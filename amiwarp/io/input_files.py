"""Shared code of the readers: how an input is opened, errors that name the file, and a register of the inputs.

Every reader of the package opens its files with :func:`open_input` or :func:`read_text`, or gives :func:`input_path` to
a library that opens files. So each input is a regular file, and no writer replaces it.
"""

import contextlib
import io
import os
import stat
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from amiwarp.errors import WORD_HEAD, AmiwarpError, printable

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
        If the file does not exist or cannot be reached, or is a folder, a named pipe, a socket or a device.
    """
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


# Names of files that are no recordings, by their first bytes, and what to do with them.

TABLE = "save x, y, t [us] and p from it as .npz"
VIDEO = "make events of it with amiwarp translate"
PICTURE = "make events of it with amiwarp simulate --picture"
MATLAB = "save x, y, t [us] and p from it as .npz, or as text 't x y p'"
CAPTURE = "give the events as the camera's software saves them"
UNPACK = "unpack it first"

MISTAKEN_FILES: tuple[tuple[int, bytes, str, str], ...] = (
    # position, bytes, what the file is, what to do
    (0, b"MATLAB 5.0 MAT-file", "a MATLAB 5 file", MATLAB),
    (0, b"MATLAB 7.3 MAT-file", "a MATLAB 7.3 file", MATLAB),
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
    (0, b"\x93NUMPY", "a NumPy array (.npy)", "save x, y, t [us] and p together with numpy.savez"),
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
    (0, b"PAR1", "a Parquet table", TABLE),
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
