"""Arrays in NumPy's files and archives. They are read in pieces, so that memory does not depend on their size."""

from __future__ import annotations

import contextlib
import math
import zipfile
from collections.abc import Iterable, Iterator
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import DEFAULT_BLOCK

PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods that NumPy writes. Others are refused, because they may take any amount of memory."""


Array: TypeAlias = tuple[IO[bytes], tuple[int, ...], np.dtype[Any]]
"""Stream of an array's values, its shape and its type."""


@contextlib.contextmanager
def open_array(archive: zipfile.ZipFile, name: str, kinds: str = "iub") -> Iterator[Array]:
    """Open an array of the archive: its bytes, shape and type. Its header must agree with the archive's directory."""
    with open_any_array(archive, name, kinds) as (array, by_columns):
        if by_columns:
            raise AmiwarpError(
                f"array {name} is stored by columns; save numpy.ascontiguousarray of it",
                ErrorCode.FORMAT_UNKNOWN,
            )
        yield array


@contextlib.contextmanager
def open_any_array(archive: zipfile.ZipFile, name: str, kinds: str) -> Iterator[tuple[Array, bool]]:
    """Open an array of the archive as :func:`open_array`, and yield whether it is stored by columns."""
    with _stored_array(archive, name) as (stream, file_bytes):
        yield array_header(stream, f"array {name}", file_bytes, kinds)


def is_of_kind(archive: zipfile.ZipFile, name: str, kinds: str) -> bool:
    """Return whether an array of the archive has a type of these kinds, without objects."""
    with _stored_array(archive, name) as (stream, _):
        _, _, dtype = _read_header(stream, f"array {name}")
        return _has_kind(dtype, kinds)


@contextlib.contextmanager
def _stored_array(archive: zipfile.ZipFile, name: str) -> Iterator[tuple[IO[bytes], int]]:
    """Open an array of the archive at its header. Yield the stream, and its length [bytes]."""
    about = archive.getinfo(f"{name}.npy")
    if about.compress_type not in PACKED:
        raise AmiwarpError(
            f"array {name} is compressed by method {about.compress_type}; save the array with numpy.savez",
            ErrorCode.FORMAT_UNKNOWN,
        )
    with archive.open(about) as stream:
        yield stream, about.file_size


def array_header(stream: IO[bytes], name: str, file_bytes: int, kinds: str) -> tuple[Array, bool]:
    """Read the header of an array of ``file_bytes`` bytes, and check it. Return whether it is stored by columns."""
    shape, by_columns, dtype = _read_header(stream, name)
    if not _has_kind(dtype, kinds):
        expected = "integers (t in microseconds)"
        if kinds == "f":
            expected = "floating-point numbers"
        elif "f" in kinds:
            expected = f"{expected} or floating-point numbers"
        raise AmiwarpError(
            f"{name} is {dtype}; expected {expected}, no pickled objects", ErrorCode.FORMAT_UNKNOWN
        )
    array_bytes = math.prod(shape) * dtype.itemsize
    if array_bytes != file_bytes - stream.tell():
        raise AmiwarpError(
            f"{name} declares shape {shape}, which the archive does not hold; copy the file again",
            ErrorCode.FILE_DAMAGED,
        )
    return (stream, shape, dtype), by_columns and len(shape) > 1


def _read_header(stream: IO[bytes], name: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of an array: its shape, whether it is stored by columns, and its type."""
    version = npy.read_magic(stream)
    if version == (1, 0):
        return npy.read_array_header_1_0(stream)
    if version == (2, 0):
        return npy.read_array_header_2_0(stream)
    raise AmiwarpError(
        f"{name} has a header of version {version}; expected 1.0 or 2.0", ErrorCode.FORMAT_UNKNOWN
    )


def _has_kind(dtype: np.dtype[Any], kinds: str) -> bool:
    """Return whether a type is of these kinds. Object arrays would be unpickled, which is unsafe."""
    return not dtype.hasobject and dtype.kind in kinds


def lengths(count: int, notes: dict[str, int]) -> Iterator[int]:
    """Yield the lengths of the pieces of ``count`` events, and note the progress."""
    notes["total"] = max(count, 1)
    for start in range(0, count, DEFAULT_BLOCK):
        stop = min(start + DEFAULT_BLOCK, count)
        notes["read"] = stop
        yield stop - start


def next_rows(array: Array, length: int) -> NDArray[Any]:
    """Return the next ``length`` rows of an array."""
    stream, shape, dtype = array
    row = shape[1:]
    values = length * math.prod(row)
    data = stream.read(values * dtype.itemsize)
    return np.frombuffer(data, dtype, values).reshape(length, *row)


def write_array(
    archive: zipfile.ZipFile,
    name: str,
    shape: tuple[int, ...],
    dtype: str,
    parts: Iterable[bytes],
) -> None:
    """Write an array to an archive part by part. Equal arrays give equal files."""
    member = zipfile.ZipInfo(f"{name}.npy")
    member.compress_type = archive.compression
    header = {"descr": dtype, "fortran_order": False, "shape": shape}
    with archive.open(member, "w", force_zip64=True) as file:
        npy.write_array_header_1_0(file, header)
        for part in parts:
            file.write(part)
