"""Reader of NumPy archives with the integer arrays x, y [px], t [us] and p (1 is ON, 0 or -1 is OFF).

The optional numbers ``width`` and ``height`` give the sensor size. Otherwise it is the smallest known sensor that holds
all events. Arrays are read in pieces, so that memory does not depend on the size that an archive declares.
"""

from __future__ import annotations

import contextlib
import math
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import DEFAULT_BLOCK
from amiwarp.events.recording import Recording
from amiwarp.io.file_scan import FileEvents, Packet
from amiwarp.io.input_files import errors_name
from amiwarp.io.regular_file import check_regular

PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods that NumPy writes. Others are refused, because they may take any amount of memory."""


def open_npz(path: Path) -> Recording:
    """Open an archive of events.

    Arrays are read in pieces, and read again for each use if they are too large to keep in memory.
    """
    check_regular(path)
    with errors_name(path, lambda: "reading width and height"), zipfile.ZipFile(path) as archive:
        size = None
        if {"width.npy", "height.npy"} <= set(archive.namelist()):
            size = (_number(archive, "width"), _number(archive, "height"))
    events = FileEvents(path, partial(_packets, path), size=size)
    return Recording(events=events, metadata={"format": "npz", **events.repairs}, name=path.stem)


@contextlib.contextmanager
def _array(archive: zipfile.ZipFile, name: str) -> Iterator[tuple[IO[bytes], tuple[int, ...], np.dtype[np.generic]]]:
    """Open an array of the archive: its bytes, shape and type. Its header must agree with the archive's directory."""
    about = archive.getinfo(f"{name}.npy")
    if about.compress_type not in PACKED:
        raise AmiwarpError(
            f"array {name} is compressed by method {about.compress_type}; save the array with numpy.savez"
        )
    with archive.open(about) as stream:
        version = npy.read_magic(stream)
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
        if read is None:
            raise AmiwarpError(f"array {name} has a header of version {version}; expected 1.0 or 2.0")
        shape, _, dtype = read(stream)
        # Floating times could be in seconds or in microseconds. Object arrays would be unpickled, which is unsafe.
        if dtype.kind not in "iub":
            raise AmiwarpError(f"array {name} is {dtype}; expected integers (t in microseconds), no pickled objects")
        if math.prod(shape) * dtype.itemsize != about.file_size - stream.tell():
            raise AmiwarpError(
                f"array {name} declares shape {shape}, which the archive does not hold; copy the file again"
            )
        yield stream, shape, dtype


def _number(archive: zipfile.ZipFile, name: str) -> int:
    """Return the single number in an array of the archive."""
    with _array(archive, name) as (stream, shape, dtype):
        if math.prod(shape) != 1:
            raise AmiwarpError(f"{name} has shape {shape}; expected one number")
        return int(np.frombuffer(stream.read(dtype.itemsize), dtype)[0])


def _packets(path: Path, notes: dict[str, int]) -> Iterator[Packet]:
    with contextlib.ExitStack() as opened:
        archive = opened.enter_context(zipfile.ZipFile(path))
        missing = [name for name in "xytp" if f"{name}.npy" not in archive.namelist()]
        if missing:
            raise AmiwarpError(f"{path}: no array {', '.join(missing)}; expected x, y, t, p")
        arrays = {name: opened.enter_context(_array(archive, name)) for name in "xytp"}
        count = arrays["t"][1]
        for name, (_, shape, _) in arrays.items():
            if len(shape) != 1 or shape != count:
                raise AmiwarpError(f"{path}: array {name} has shape {shape}, t {count}; expected one length (n,)")
        for start in range(0, count[0], DEFAULT_BLOCK):
            length = min(DEFAULT_BLOCK, count[0] - start)
            x, y, t, p = (
                np.frombuffer(stream.read(length * dtype.itemsize), dtype, length)
                for stream, _, dtype in arrays.values()
            )
            yield x, y, t, p
