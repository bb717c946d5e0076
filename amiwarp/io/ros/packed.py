"""Compressed ROS bags: a file that the Zstandard program or rosbag2 has compressed, or the folder of such files.

rosbag2 can also compress each message, which needs no copy.
"""

import contextlib
import errno
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import open_input
from amiwarp.io.reading_process import run
from amiwarp.io.reading_server import Reply
from amiwarp.io.unfinished import scratch_folder

ZSTANDARD = b"\x28\xb5\x2f\xfd"
"""First bytes of a Zstandard archive."""

LARGEST_RATIO = 100
"""Largest ratio of the sizes after and before unpacking. Words of sensors reach 10."""

SMALLEST_LIMIT = 1 << 30
"""Size to which every file may be unpacked [bytes]."""

LARGEST_MESSAGE = 1 << 28
"""Largest message after unpacking [bytes]."""

PIECE_BYTES = 1 << 20
"""Number of bytes that are unpacked at once."""


def unpacked_message(raw: bytes) -> bytes:
    """Return a message that was compressed alone."""
    import zstandard

    decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_MESSAGE)
    try:
        with decompressor.stream_reader(raw) as reader:
            data = reader.read(LARGEST_MESSAGE + 1)
    except zstandard.ZstdError as error:
        raise AmiwarpError(
            f"a compressed message cannot be unpacked: {error}; the bag is damaged",
            ErrorCode.FILE_DAMAGED,
        ) from error
    if len(data) > LARGEST_MESSAGE:
        raise AmiwarpError(
            f"a message unpacks to over {LARGEST_MESSAGE} bytes; the bag is damaged",
            ErrorCode.FILE_DAMAGED,
        )
    return data


def packed_head(path: Path) -> bytes:
    """Return the first bytes of what a Zstandard archive holds, or nothing if it is damaged.

    Raises :class:`AmiwarpError` if the archive ends before them.
    """
    import zstandard

    try:
        with open_input(path) as file, zstandard.ZstdDecompressor().stream_reader(file) as reader:
            head = reader.read(16)
            if head:
                return head
            file.seek(0)
            holds_something = zstandard.frame_content_size(file.read(32)) != 0
    except zstandard.ZstdError:
        return b""
    if holds_something:
        raise AmiwarpError(
            f"{path}: is a Zstandard archive that is cut off; copy the whole file again",
            ErrorCode.FILE_DAMAGED,
        )
    return b""


def is_packed(path: Path) -> bool:
    """Return whether a bag is a Zstandard archive, or a folder of such files."""
    if path.is_dir():
        return any(file.suffix == ".zstd" for file in path.iterdir())
    with open_input(path) as file:
        return file.read(4) == ZSTANDARD


@contextlib.contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """Give a bag that is not compressed: the bag itself, or a copy, which is removed at the end.

    The copy lies in the system's folder for temporary files: the folder of a recording may be read-only.
    """
    if not is_packed(path):
        yield path.absolute()
        return
    with scratch_folder(Path(tempfile.gettempdir())) as scratch:
        yield scratch / run(unpack, path.absolute(), str(scratch))


def unpack(path: str, scratch: str) -> Reply:
    """Unpack a bag into a folder, and return the name that it has there. Runs in the reading process."""
    source = Path(path)
    target = Path(scratch) / "bag"
    try:
        if source.is_dir():
            _unpack_folder(source, target)
        else:
            _unpack_file(source, target)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        raise AmiwarpError(
            f"is compressed, and {scratch} has no space for its copy; set TMPDIR to a folder with more space",
            ErrorCode.DISK_FULL,
        ) from error
    return target.name, []


def _unpack_folder(source: Path, target: Path) -> None:
    """Unpack the files of a folder, and write its metadata without their compression."""
    with open(source / "metadata.yaml", encoding="utf-8") as text:
        metadata = text.read()
    metadata = re.sub(r"(\bcompression_(?:mode|format):).*", r'\1 ""', metadata)
    metadata = re.sub(r"(\.(?:db3|mcap))\.zstd\b", r"\1", metadata)
    target.mkdir()
    (target / "metadata.yaml").write_text(metadata, encoding="utf-8")
    for file in sorted(source.glob("*.zstd")):
        _unpack_file(file, target / file.stem)


def _unpack_file(source: Path, target: Path) -> None:
    """Unpack an archive of one file."""
    import zstandard

    most = max(LARGEST_RATIO * source.stat().st_size, SMALLEST_LIMIT)
    written = 0
    try:
        with open(source, "rb") as packed, open(target, "xb") as plain:
            stated = zstandard.frame_content_size(packed.read(32))
            packed.seek(0)
            decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_MESSAGE)
            with decompressor.stream_reader(packed, read_across_frames=True) as reader:
                while piece := reader.read(PIECE_BYTES):
                    written += len(piece)
                    if written > most:
                        raise AmiwarpError(
                            f"{source.name} unpacks to over {most:,} bytes, too many for its size; the file is damaged",
                            ErrorCode.FILE_DAMAGED,
                        )
                    plain.write(piece)
    except zstandard.ZstdError as error:
        raise AmiwarpError(
            f"{source.name} cannot be unpacked after {written:,} bytes: {error}; the file is damaged",
            ErrorCode.FILE_DAMAGED,
        ) from error
    if written < stated:
        raise AmiwarpError(
            f"{source.name} ends after {written:,} of {stated:,} bytes of the bag; copy the whole file again",
            ErrorCode.FILE_DAMAGED,
        )
