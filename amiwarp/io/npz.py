"""Reader of NumPy arrays of events: archives (.npz) and the folders of EV-IMO2.

An archive holds the integer arrays x, y [px], t [us] and p (1 is ON, 0 or -1 is OFF), with floating x and y for
compensated events, or one structured array ``event_data`` with these fields (N-ImageNet), or one array ``events`` with
the columns t [s], x, y, p (EV-IMO). The optional numbers ``width`` and ``height`` give the sensor size. Otherwise it is
the smallest known sensor that holds all events. A folder of EV-IMO2 holds ``dataset_events_t.npy`` [s],
``dataset_events_xy.npy`` and ``dataset_events_p.npy``. Arrays are read in pieces, so that memory does not depend on the
size that a file declares.
"""

import contextlib
import math
import shutil
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import DEFAULT_BLOCK, Events
from amiwarp.events.recording import Recording
from amiwarp.io.atomic_output import scratch_folder
from amiwarp.io.file_scan import FileEvents, Packet, microseconds, whole_pixels
from amiwarp.io.formats import Outline
from amiwarp.io.input_files import errors_name, input_path, open_input

PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods that NumPy writes. Others are refused, because they may take any amount of memory."""


def open_npz(path: Path) -> Recording:
    """Open an archive of events.

    Arrays are read in pieces, and read again for each use if they are too large to keep in memory.
    """
    with errors_name(path, lambda: "reading width and height"), zipfile.ZipFile(input_path(path)) as archive:
        size = None
        if {"width.npy", "height.npy"} <= set(archive.namelist()):
            size = (_number(archive, "width"), _number(archive, "height"))
    events = FileEvents(path, partial(_packets, path), size=size)
    return Recording(events=events, metadata={"format": "npz", **events.metadata}, name=path.stem)


Array: TypeAlias = tuple[IO[bytes], tuple[int, ...], np.dtype[Any]]
"""Stream of an array's values, its shape and its type."""


@contextlib.contextmanager
def _array(archive: zipfile.ZipFile, name: str, kinds: str = "iub") -> Iterator[Array]:
    """Open an array of the archive: its bytes, shape and type. Its header must agree with the archive's directory."""
    about = archive.getinfo(f"{name}.npy")
    if about.compress_type not in PACKED:
        raise AmiwarpError(
            f"array {name} is compressed by method {about.compress_type}; save the array with numpy.savez"
        )
    with archive.open(about) as stream:
        yield _header(stream, name, about.file_size, kinds)


def _header(stream: IO[bytes], name: str, file_bytes: int, kinds: str) -> Array:
    """Read the header of an array of ``file_bytes`` bytes, and check it."""
    version = npy.read_magic(stream)
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if read is None:
        raise AmiwarpError(f"array {name} has a header of version {version}; expected 1.0 or 2.0")
    shape, by_columns, dtype = read(stream)
    # Floating times could be in seconds or in microseconds. Object arrays would be unpickled, which is unsafe.
    if dtype.hasobject or dtype.kind not in kinds:
        raise AmiwarpError(f"array {name} is {dtype}; expected integers (t in microseconds), no pickled objects")
    if math.prod(shape) * dtype.itemsize != file_bytes - stream.tell():
        raise AmiwarpError(f"array {name} declares shape {shape}, which the archive does not hold; copy the file again")
    if by_columns and len(shape) > 1:
        raise AmiwarpError(f"array {name} is stored by columns; save numpy.ascontiguousarray of it")
    return stream, shape, dtype


def _number(archive: zipfile.ZipFile, name: str) -> int:
    """Return the single number in an array of the archive."""
    with _array(archive, name) as (stream, shape, dtype):
        if math.prod(shape) != 1:
            raise AmiwarpError(f"{name} has shape {shape}; expected one number")
        return int(np.frombuffer(stream.read(dtype.itemsize), dtype)[0])


def _packets(path: Path, notes: dict[str, int]) -> Iterator[Packet]:
    with contextlib.ExitStack() as opened:
        archive = opened.enter_context(zipfile.ZipFile(input_path(path)))
        names = {name.removesuffix(".npy") for name in archive.namelist()}
        missing = [name for name in "xytp" if name not in names]
        if not missing:
            kinds = {"x": "iubf", "y": "iubf", "t": "iub", "p": "iub"}
            arrays = {name: opened.enter_context(_array(archive, name, kinds[name])) for name in "xytp"}
            yield from _columns(path, arrays, notes)
        elif "event_data" in names:
            array = opened.enter_context(_array(archive, "event_data", "V"))
            yield from _records(path, array, notes)
        elif "events" in names:
            array = opened.enter_context(_array(archive, "events", "iuf"))
            yield from _rows(path, array, notes)
        else:
            raise AmiwarpError(f"{path}: is a ZIP archive without x, y, t and p: no array {', '.join(missing)}; {USED}")


USED = "expected x, y, t, p; or event_data (N-ImageNet); or events (EV-IMO)"
"""Arrays that are read, for messages."""


def _columns(path: Path, arrays: Mapping[str, Array], notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of the arrays x, y, t, p."""
    count = arrays["t"][1]
    for name, (_, shape, _) in arrays.items():
        if len(shape) != 1 or shape != count:
            raise AmiwarpError(f"{path}: array {name} has shape {shape}, t {count}; expected one length (n,)")
    x_type, y_type = (arrays[name][2] for name in "xy")
    if (x_type.kind == "f") != (y_type.kind == "f"):
        given = f"array x is {x_type}, y is {y_type}"
        raise AmiwarpError(f"{path}: {given}; expected integers, or floating numbers for compensated events")
    for length in _lengths(count[0], notes):
        x, y, t, p = (_next(array, length) for array in arrays.values())
        yield x, y, t, p


def _records(path: Path, array: Array, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of a structured array with the fields x, y, t [us], p."""
    _, shape, dtype = array
    fields: Mapping[str, Any] = dtype.fields or {}
    if len(shape) != 1 or any(name not in fields or fields[name][0].kind not in "iub" for name in "xytp"):
        raise AmiwarpError(f"{path}: array event_data is {dtype} of shape {shape}; expected integer fields x, y, t, p")
    for length in _lengths(shape[0], notes):
        rows = _next(array, length)
        yield rows["x"], rows["y"], rows["t"], rows["p"]


def _rows(path: Path, array: Array, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of an array with the columns t [s], x, y, p."""
    _, shape, dtype = array
    if len(shape) != 2 or shape[1] != 4 or dtype.kind != "f":
        raise AmiwarpError(f"{path}: array events is {dtype} of shape {shape}; expected float (n, 4): t [s], x, y, p")
    for length in _lengths(shape[0], notes):
        t, x, y, p = _next(array, length).T
        yield whole_pixels(x), whole_pixels(y), microseconds(t), p > 0


def _lengths(count: int, notes: dict[str, int]) -> Iterator[int]:
    """Yield the lengths of the pieces of ``count`` events, and note the progress."""
    notes["total"] = max(count, 1)
    for start in range(0, count, DEFAULT_BLOCK):
        notes["read"] = min(start + DEFAULT_BLOCK, count)
        yield min(DEFAULT_BLOCK, count - start)


def _next(array: Array, length: int) -> NDArray[Any]:
    """Return the next ``length`` rows of an array."""
    stream, shape, dtype = array
    row = math.prod(shape[1:])
    data = stream.read(length * row * dtype.itemsize)
    return np.frombuffer(data, dtype, length * row).reshape(length, *shape[1:])


EVIMO = ("t", "xy", "p")
"""Parts of the names of the files in a folder of EV-IMO2."""


def open_evimo(path: Path) -> Recording:
    """Open the events of a folder of EV-IMO2. Its sensor size is taken from the events."""
    events = FileEvents(path, partial(_evimo_packets, path), size=None)
    return Recording(events=events, metadata={"format": "evimo2", **events.metadata}, name=path.name)


def _evimo_packets(path: Path, notes: dict[str, int]) -> Iterator[Packet]:
    with contextlib.ExitStack() as opened:
        arrays = {}
        for name, kinds in zip(EVIMO, ("f", "iu", "iub"), strict=True):
            part = path / f"dataset_events_{name}.npy"
            stream = opened.enter_context(open_input(part))
            arrays[name] = _header(stream, part.name, part.stat().st_size, kinds)
        counts = {name: shape[0] if shape else 0 for name, (_, shape, _) in arrays.items()}
        sizes = {name: math.prod(shape[1:]) for name, (_, shape, _) in arrays.items()}
        if len(set(counts.values())) != 1 or sizes != {"t": 1, "xy": 2, "p": 1}:
            shapes = ", ".join(f"{name} {shape}" for name, (_, shape, _) in arrays.items())
            raise AmiwarpError(f"{path}: the arrays have the shapes {shapes}; expected (n,), (n, 2), (n,)")
        for length in _lengths(counts["t"], notes):
            t, xy, p = (_next(array, length) for array in arrays.values())
            yield xy[:, 0], xy[:, 1], microseconds(t.reshape(-1)), p.reshape(-1)


# Writer of NumPy archives, which :func:`numpy.load` reads: the arrays x, y, t and p, and the numbers width and height.
#
# An archive holds one array after the other. The arrays therefore grow in temporary files next to the archive.

COLUMNS = {"x": "<u2", "y": "<u2", "t": "<i8", "p": "|u1"}
"""Types of the arrays. x and y of compensated events are float32."""


def write_npz(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events."""
    columns, count = COLUMNS, 0
    with scratch_folder(part.parent) as folder:
        with contextlib.ExitStack() as opened:
            files = {name: opened.enter_context((folder / name).open("wb")) for name in COLUMNS}
            for events in blocks:
                columns = COLUMNS if events.whole_pixels else {**COLUMNS, "x": "<f4", "y": "<f4"}
                count += len(events)
                for name, dtype in columns.items():
                    files[name].write(np.ascontiguousarray(getattr(events, name), dtype).data)
        with zipfile.ZipFile(part, "x") as archive:
            for name, dtype in columns.items():
                with (
                    archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member,
                    (folder / name).open("rb") as column,
                ):
                    header = {"descr": dtype, "fortran_order": False, "shape": (count,)}
                    npy.write_array_header_1_0(member, header)
                    shutil.copyfileobj(column, member, 1 << 20)
            for name in ("width", "height"):
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w") as member:
                    npy.write_array(member, np.array(getattr(about, name)))
