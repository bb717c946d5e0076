"""Datasets of the native layout: which are read, and whether the file holds what they declare.

Runs in the reading process.
"""

import math
import os
from typing import Any, NamedTuple

import h5py  # noqa: TID253 - only the reading process imports this module
import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.truth import EVENT_COLUMNS, MAPS
from amiwarp.io.hdf5.chunks import BLOSC, CHUNK, FLETCHER32

COLUMNS = {
    "events/t": "iub",
    "events/p": "iub",
    "events/inside": "iub",
    "events/extrapolated": "iub",
    "events/x": "iuf",
    "events/y": "iuf",
    "ms_to_idx": "iu",
    "t_offset": "iuf",
    "encoder/t": "iu",
    "encoder/angle": "f",
    "encoder/index_t": "iu",
    "encoder/second_t": "iu",
    "encoder/second_angle": "f",
    "encoder/second_index_t": "iu",
    "truth/x": "f",
    "truth/y": "f",
    **{
        f"truth/{group}/{name}": "f" if np.dtype(dtype).kind == "f" else "iu"
        for group, table in (("events", EVENT_COLUMNS), ("frames", MAPS))
        for name, (dtype, _) in table.items()
    },
    "truth/frames/t": "iu",
    "truth/frames/pose": "f",
    "truth/frames/joints": "f",
    "truth/known/t": "iu",
    "truth/known/mask": "iu",
    "truth/poses/t": "iu",
    "truth/poses/camera": "f",
    "truth/poses/bodies": "f",
    "truth/joints/position": "f",
    "imu/t": "iu",
    "frames/t": "iu",
    "imu/angular_velocity": "f",
    "imu/acceleration": "f",
    "frames/image": "u",
    "frames/exposure": "i",
    "frames/depth": "f",
    "truth/world/instances": "S",
    "truth/world/categories": "S",
    "truth/poses/body_names": "S",
    "truth/joints/names": "S",
}
"""Datasets that are read, with the kinds of data types allowed for each, as in NumPy's ``dtype.kind``."""

KIND_WORDS = {
    "i": "signed integers",
    "u": "unsigned integers",
    "b": "truth values",
    "f": "floats",
    "S": "text",
}
"""Kinds of data types in words, for messages."""

DIMENSIONS = {
    "t_offset": 0,
    **{f"truth/events/{name}": 1 + len(row) for name, (_, row) in EVENT_COLUMNS.items()},
    **{f"truth/frames/{name}": 3 + len(tail) for name, (_, tail) in MAPS.items()},
    "truth/frames/pose": 2,
    "truth/poses/camera": 2,
    "truth/frames/joints": 3,
    "truth/poses/bodies": 3,
    "truth/joints/position": 3,
    "truth/known/mask": 3,
    "imu/angular_velocity": 2,
    "imu/acceleration": 2,
    "frames/exposure": 2,
    "frames/depth": 3,
}
"""Numbers of dimensions of the datasets. Datasets that are not listed have one."""

IMAGE = "frames/image"
"""Dataset of frames: three dimensions with grey levels, four with colours."""

READ_AT_ONCE = (
    "t_offset",
    "encoder/t",
    "encoder/angle",
    "encoder/index_t",
    "encoder/second_t",
    "encoder/second_angle",
    "encoder/second_index_t",
    "truth/frames/t",
    "truth/known/t",
    "truth/world/instances",
    "truth/world/categories",
    "truth/poses/body_names",
    "truth/joints/names",
    "imu/t",
    "imu/angular_velocity",
    "imu/acceleration",
    "frames/t",
    "frames/exposure",
)
"""Datasets that are read into memory at once, and therefore have stricter size limits."""

AT_ONCE_BYTES = 1 << 24
"""Size in memory that a dataset in :data:`READ_AT_ONCE` may have, however small it is in the file [bytes]."""

AT_ONCE_RATIO = 1000
"""Ratio of the size in memory to the size in the file that a larger dataset in :data:`READ_AT_ONCE` may have."""

CHUNK_BYTES = 1 << 28
"""Largest chunk that is read [bytes]. HDF5 holds a decoded chunk in memory."""

FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32", 4: "szip", 5: "nbit", 6: "scaleoffset", 307: "bzip2",
           32000: "lzf", 32001: "blosc", 32004: "lz4", 32008: "bitshuffle", 32013: "zfp", 32015: "zstd",
           32026: "blosc2"}  # fmt: skip
"""Names of HDF5 filters by number, for messages."""


class FileFacts(NamedTuple):
    """What is known of an open file when its datasets are described."""

    path: str
    unfinished: bool
    """Whether it may still grow."""
    plain: bool
    """Whether HDF5's places of chunks are places in the file, which another process can read."""
    size: int
    """Size when it was opened [bytes]."""

    def size_now(self) -> int:
        """Return the size of the file [bytes]."""
        return os.path.getsize(self.path) if self.unfinished else self.size


class _Dataset(NamedTuple):
    """Dataset with properties that are used several times; h5py would ask HDF5 each time. Its names are h5py's."""

    id: Any
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunks: tuple[int, ...] | None
    filters: list[Any]


def describe(stored: Any, name: str, kinds: str, about: FileFacts) -> dict[str, Any]:
    """Return type, length and filters of a dataset.

    If the chunks are read without HDF5, their positions in the file are returned too.
    """
    dataset = _opened(stored, name)
    if dataset.dtype.kind not in kinds or dataset.dtype.fields is not None:
        raise AmiwarpError(
            f"dataset '{name}' is {dataset.dtype}; expected {_in_words(kinds)}, see "
            "docs/reference/recording-format.md",
            ErrorCode.FORMAT_UNKNOWN,
        )
    row = dataset.shape[1:]
    has_whole_rows = dataset.chunks is None or dataset.chunks[1:] == row
    if row_bytes(dataset) > CHUNK_BYTES or not has_whole_rows:
        raise AmiwarpError(
            f"dataset '{name}' has rows of over {CHUNK_BYTES >> 20} MiB, or chunks of partial rows; "
            "rewrite the file with chunks of whole rows",
            ErrorCode.FORMAT_UNKNOWN,
        )

    places: list[tuple[int, int]] | None = None
    if dataset.chunks is None:
        count = plain_length(dataset, name, about.size_now())
    else:
        chunks = _chunks(dataset, name, about)
        count = _chunked_length(dataset, name, chunks, about.unfinished)
        if about.plain:
            # Only datasets with chunks of the native layout have places.
            used = -(-count // CHUNK)
            places = _stored_places(dataset, chunks[:used])
        if places is None:
            _check_heads(dataset, name, chunks, about.path)

    if name in READ_AT_ONCE:
        most_bytes = max(AT_ONCE_BYTES, AT_ONCE_RATIO * dataset.id.get_storage_size())
        if count * row_bytes(dataset) > most_bytes:
            raise AmiwarpError(
                f"dataset '{name}' declares {count} elements, too many for its size; the file is damaged",
                ErrorCode.FILE_DAMAGED,
            )
    return {
        "dtype": dataset.dtype.str,
        "count": count,
        "filters": [FILTERS.get(code, f"filter {code}") for code, *_ in dataset.filters],
        "places": places,
        "row": row,
    }


def _in_words(kinds: str) -> str:
    """Return the kinds of data types of a dataset in words."""
    *others, last = [KIND_WORDS[kind] for kind in kinds]
    return f"{', '.join(others)} or {last}" if others else last


def _opened(stored: Any, name: str) -> _Dataset:
    """Return a dataset with its properties, after checking its number of dimensions."""
    dimensions = (3, 4) if name == IMAGE else (DIMENSIONS.get(name, 1),)
    wanted = "one-dimensional"
    if dimensions != (1,):
        wanted = f"{' or '.join(map(str, dimensions))}-dimensional"
    if not isinstance(stored, h5py.h5d.DatasetID) or stored.shape is None:
        raise AmiwarpError(
            f"no {wanted} dataset '{name}'; the file is incomplete", ErrorCode.FILE_DAMAGED
        )
    if len(stored.shape) not in dimensions:
        raise AmiwarpError(
            f"dataset '{name}' has the shape {stored.shape}; expected a {wanted} one, see "
            "docs/reference/recording-format.md",
            ErrorCode.FORMAT_UNKNOWN,
        )
    return _properties(stored)


def _properties(stored: Any) -> _Dataset:
    """Return a dataset of h5py's low-level interface with its properties."""
    creation = stored.get_create_plist()
    is_chunked = creation.get_layout() == h5py.h5d.CHUNKED
    return _Dataset(
        id=stored,
        shape=stored.shape,
        dtype=stored.dtype,
        chunks=creation.get_chunk() if is_chunked else None,
        filters=[creation.get_filter(number) for number in range(creation.get_nfilters())],
    )


def row_bytes(dataset: _Dataset) -> int:
    """Return the size of a dataset's row in memory [bytes]."""
    return int(dataset.dtype.itemsize) * math.prod(dataset.shape[1:])


def plain_length(dataset: _Dataset, name: str, file_bytes: int) -> int:
    """Return the length of a dataset without chunks, after checking that the file holds all of it."""
    count = int(dataset.shape[0]) if dataset.shape else 1
    offset = dataset.id.get_offset()
    declared = count * row_bytes(dataset)
    stored = dataset.id.get_storage_size()
    is_compact = dataset.id.get_create_plist().get_layout() == h5py.h5d.COMPACT
    is_inside = is_compact or (offset is not None and offset + declared <= file_bytes)
    if count and (stored < declared or not is_inside):
        raise AmiwarpError(
            f"dataset '{name}' declares {count} elements, which the file does not hold; copy the file again",
            ErrorCode.FILE_DAMAGED,
        )
    return count


def _chunked_length(dataset: _Dataset, name: str, chunks: list[Any], unfinished: bool) -> int:
    """Return the length of a dataset with chunks, after checking that no chunk is missing.

    An unfinished file ends at the first missing chunk.
    """
    count = int(dataset.shape[0])
    assert dataset.chunks is not None
    size = dataset.chunks[0]
    held = 0
    while held < len(chunks) and chunks[held].chunk_offset[0] == held * size:
        held += 1
    if unfinished:
        return min(count, held * size)
    if held != -(-count // size) or len(chunks) != held:
        raise AmiwarpError(
            f"dataset '{name}' declares {count} elements, the file holds {len(chunks)} chunks of {size}; copy the "
            "file again",
            ErrorCode.FILE_DAMAGED,
        )
    return count


def _chunks(dataset: _Dataset, name: str, about: FileFacts) -> list[Any]:
    """Return all chunks of a dataset in order, after checking that each lies in the file."""
    chunk_bytes = bytes_of_chunk(dataset, name)
    chunks: list[Any] = []
    dataset.id.chunk_iter(chunks.append)
    chunks.sort(key=lambda chunk: chunk.chunk_offset[0])
    file_bytes = about.size_now()
    if about.unfinished and not dataset.filters:
        # An unfiltered chunk of an interrupted recording may end beyond the file. HDF5 reads zeros there.
        file_bytes += chunk_bytes
    if sum(chunk.size for chunk in chunks) > file_bytes:
        raise _damaged_chunk(name)
    for chunk in chunks:
        if chunk.byte_offset is None or chunk.byte_offset + chunk.size > file_bytes:
            raise _damaged_chunk(name)
    for code, _, values, _ in dataset.filters:
        # The Blosc filter's parameters are two versions, bytes per element and bytes per chunk.
        if code == BLOSC and tuple(values[2:4]) != (dataset.dtype.itemsize, chunk_bytes):
            raise _damaged_chunk(name)
    return chunks


def bytes_of_chunk(dataset: _Dataset, name: str) -> int:
    """Return the size of a dataset's chunk in memory [bytes], after checking that it is not too large."""
    assert dataset.chunks is not None
    size = math.prod(dataset.chunks) * int(dataset.dtype.itemsize)
    if size > CHUNK_BYTES:
        raise AmiwarpError(
            f"dataset '{name}' has chunks of over {CHUNK_BYTES >> 20} MiB; store it in smaller chunks",
            ErrorCode.FORMAT_UNKNOWN,
        )
    return size


def _damaged_chunk(name: str) -> AmiwarpError:
    return AmiwarpError(
        f"dataset '{name}' has a damaged chunk; copy the file again", ErrorCode.FILE_DAMAGED
    )


def _check_heads(dataset: _Dataset, name: str, chunks: list[Any], path: str) -> None:
    """Check that the size of each chunk agrees with the dataset. HDF5 and its Blosc filter would read beyond a chunk.

    Chunks in the native layout are not checked here, because they are read without HDF5.
    """
    with open(path, "rb") as raw:
        if any(_chunk_is_damaged(dataset, chunk, raw) for chunk in chunks):
            raise _damaged_chunk(name)


def _chunk_is_damaged(dataset: _Dataset, chunk: Any, raw: Any) -> bool:
    """Return whether a chunk's stored size contradicts the dataset."""
    codes = [code for code, *_ in dataset.filters]
    chunk_bytes = (dataset.chunks or (0,))[0] * row_bytes(dataset)
    if not codes:
        return bool(chunk.size != chunk_bytes)
    if codes[0] != BLOSC:
        return False
    if chunk.filter_mask == 1:
        # Blosc, the first filter, skipped this incompressible chunk.
        checksum_bytes = 4 if FLETCHER32 in codes else 0
        return bool(chunk.size != chunk_bytes + checksum_bytes)
    raw.seek(chunk.byte_offset)
    header = raw.read(16)
    if len(header) < 16 or chunk.filter_mask != 0:
        return True
    # Blosc's header: versions and flags in 4 bytes, then uncompressed, block and compressed size, little-endian.
    decoded_size = int.from_bytes(header[4:8], "little")
    encoded_size = int.from_bytes(header[12:16], "little")
    if codes[1:] not in ([], [FLETCHER32]):
        # Filters behind Blosc changed the stored size, and only HDF5 can undo them.
        return decoded_size != chunk_bytes
    checksum_bytes = 4 if FLETCHER32 in codes else 0
    return decoded_size != chunk_bytes or encoded_size != chunk.size - checksum_bytes


def _stored_places(dataset: _Dataset, chunks: list[Any]) -> list[tuple[int, int]] | None:
    """Return offset and size of every chunk in the native layout [bytes]; None for other layouts, which HDF5 reads."""
    codes = [code for code, *_ in dataset.filters]
    if not dataset.dtype.isnative or codes != [BLOSC, FLETCHER32]:
        return None
    if dataset.chunks is None or dataset.chunks[0] != CHUNK:
        return None
    if any(chunk.filter_mask for chunk in chunks):
        return None
    return [(chunk.byte_offset, chunk.size) for chunk in chunks]


def check_stored(opened: h5py.Dataset, name: str, path: str) -> None:
    """Check that the file holds all of a dataset, in chunks that fit into memory."""
    dataset = _properties(opened.id)
    if dataset.chunks is None:
        plain_length(dataset, name, os.path.getsize(path))
        return
    declared = math.prod(
        -(-size // chunk) for size, chunk in zip(dataset.shape, dataset.chunks, strict=True)
    )
    if declared != dataset.id.get_num_chunks():
        raise AmiwarpError(
            f"dataset '{name}' declares {dataset.shape[0]} rows, which it does not hold; copy the file again",
            ErrorCode.FILE_DAMAGED,
        )
    bytes_of_chunk(dataset, name)
