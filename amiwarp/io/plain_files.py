"""Plain formats of events: writers of text and NumPy arrays, arrays of EV-IMO2, and the .bin files of N-MNIST."""

from __future__ import annotations

import contextlib
import math
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any, ClassVar, Self, TypeAlias

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import DEFAULT_BLOCK, Events, Recording, regroup
from amiwarp.io.file_scan import FileEvents, Packet, microseconds, read_pieces
from amiwarp.io.files import NewFile, errors_name, input_path, open_input, scratch_folder
from amiwarp.io.formats import (
    BIN_EVENT_BYTES,
    BIN_MARK_ROW,
    Outline,
    bin_columns,
    check_ending,
    looks_like_bin,
)
from amiwarp.optics.camera import LARGEST_SIZE, Camera, RadialTangential
from amiwarp.tasks import in_order


def read_calib(path: Path, width: int, height: int) -> Camera:
    """Return the camera of a ``calib.txt``. Raises :class:`AmiwarpError` unless it holds nine finite numbers."""
    wanted = "expected a camera as text (fx fy cx cy k1 k2 p1 p2 k3), or as .json or .yaml"
    with errors_name(path, lambda: wanted):
        with open_input(path) as file:
            words = file.read(10_000).decode("utf-8").split()
        numbers = [float(word) for word in words]
        if len(numbers) != 9 or not np.isfinite(numbers).all():
            raise AmiwarpError(f"{path}: has {len(numbers)} numbers; expected finite fx fy cx cy k1 k2 p1 p2 k3")
        fx, fy, cx, cy = numbers[:4]
        return Camera(width, height, fx, fy, cx, cy, RadialTangential(*numbers[4:]))


# Writers of text, one event per line, p 1 or 0: the format of the Event Camera Dataset, ``t x y p`` with t in seconds,
# and tables ``t,x,y,p`` with t in whole microseconds below a line of names.
#
# x and y of compensated events have six decimals; ``nan`` marks those without coordinates.
#
# Other readers take a further line or column for events. So the sensor size and the unit of time are in a file beside
# the text, see :mod:`amiwarp.io.text_size`.

LINES = 1 << 17
"""Number of events that are formatted at a time."""

FARTHEST = 2.0**31
"""Coordinates that are read again are less than this [px]. A larger one, of a ray along the image plane, is ``nan``."""

Digits = tuple[NDArray[np.uint8], NDArray[np.bool_]]
"""Characters by digit and event, and which of them are written."""


def write_text(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events as the Event Camera Dataset does. Their sensor size is in a file of its own."""
    with part.open("xb") as file:
        _write_lines(file, blocks, format_events)


def write_csv(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events as a table between commas. Their sensor size is in a file of its own."""
    with part.open("xb") as file:
        file.write(b"t,x,y,p\n")
        _write_lines(file, blocks, format_rows)


def _write_lines(file: IO[bytes], blocks: Iterable[Events], form: Callable[[Events], bytes]) -> None:
    """Write all events as lines of text, formatted in parallel threads."""
    jobs = (partial(form, events) for events in regroup(blocks, count=LINES))
    with contextlib.closing(in_order(jobs)) as lines:
        for text in lines:
            file.write(text)


def format_events(events: Events) -> bytes:
    """Return lines ``t x y p`` of some events, at least one, with t in seconds."""
    return _lines(_decimals(events.t), events, " ")


def format_rows(events: Events) -> bytes:
    """Return lines ``t,x,y,p`` of some events, at least one, with t in microseconds."""
    return _lines([_minus(events.t), _digits(np.abs(events.t))], events, ",")


def _lines(times: list[Digits], events: Events, separator: str) -> bytes:
    """Return the lines of some events, at least one, with their times as given."""
    columns = times
    for values in (events.x, events.y, events.p):
        digits = [_digits(values)] if values.dtype.kind == "u" else _fractional(values)
        columns += [_mark(separator, len(events)), *digits]
    columns.append(_mark("\n", len(events)))
    characters = np.concatenate([column for column, _ in columns])
    return characters.T[np.concatenate([kept for _, kept in columns]).T].tobytes()


def _minus(values: NDArray[np.int64]) -> Digits:
    return np.full((1, len(values)), ord("-"), np.uint8), (values < 0)[None]


def _decimals(millionths: NDArray[np.int64]) -> list[Digits]:
    """Return integers divided by a million, with six decimals."""
    whole, rest = np.divmod(np.abs(millionths), 1_000_000)
    return [_minus(millionths), _digits(whole), _mark(".", len(whole)), _digits(rest.astype(np.uint32), places=6)]


def _fractional(values: NDArray[Any]) -> list[Digits]:
    """Return coordinates with six decimals, or ``nan``."""
    unknown = ~(np.abs(values) < FARTHEST)
    columns = _decimals(np.rint(np.where(unknown, 0.0, values.astype(np.float64)) * 1e6).astype(np.int64))
    if unknown.any():
        for _, kept in columns:
            kept[:, unknown] = False
        columns += [(np.full((1, len(values)), ord(letter), np.uint8), unknown[None]) for letter in "nan"]
    return columns


def _mark(character: str, count: int) -> Digits:
    return np.full((1, count), ord(character), np.uint8), np.ones((1, count), np.bool_)


def _digits(values: NDArray[np.integer], places: int = 0) -> Digits:
    """Return the decimal digits of values, with leading zeros up to a number of places, and without if that is 0."""
    width = places or len(str(int(values.max())))
    characters = np.empty((width, len(values)), np.uint8)
    kept = np.ones((width, len(values)), np.bool_)
    for at in range(width - 1, -1, -1):
        if not places and at < width - 1:
            np.greater(values, 0, out=kept[at])
        rest = values // 10
        characters[at] = values - rest * 10
        values = rest
    characters += ord("0")
    return characters, kept


# NumPy arrays, and the reader of the folders of EV-IMO2. :mod:`amiwarp.io.column_files` reads other arrays.
#
# A folder of EV-IMO2 holds ``dataset_events_t.npy`` [s], ``dataset_events_xy.npy`` and ``dataset_events_p.npy``. Arrays
# are read in pieces, so that memory does not depend on the size that a file declares.

PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods that NumPy writes. Others are refused, because they may take any amount of memory."""


Array: TypeAlias = tuple[IO[bytes], tuple[int, ...], np.dtype[Any]]
"""Stream of an array's values, its shape and its type."""


@contextlib.contextmanager
def open_array(archive: zipfile.ZipFile, name: str, kinds: str = "iub") -> Iterator[Array]:
    """Open an array of the archive: its bytes, shape and type. Its header must agree with the archive's directory."""
    with open_any_array(archive, name, kinds) as (array, by_columns):
        if by_columns:
            raise AmiwarpError(f"array {name} is stored by columns; save numpy.ascontiguousarray of it")
        yield array


@contextlib.contextmanager
def open_any_array(archive: zipfile.ZipFile, name: str, kinds: str) -> Iterator[tuple[Array, bool]]:
    """Open an array of the archive as :func:`open_array`, also one that is stored by columns. Yield whether it is."""
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
            f"array {name} is compressed by method {about.compress_type}; save the array with numpy.savez"
        )
    with archive.open(about) as stream:
        yield stream, about.file_size


def array_header(stream: IO[bytes], name: str, file_bytes: int, kinds: str) -> tuple[Array, bool]:
    """Read the header of an array of ``file_bytes`` bytes, and check it. Return whether it is stored by columns."""
    shape, by_columns, dtype = _read_header(stream, name)
    if not _has_kind(dtype, kinds):
        raise AmiwarpError(f"{name} is {dtype}; expected integers (t in microseconds), no pickled objects")
    if math.prod(shape) * dtype.itemsize != file_bytes - stream.tell():
        raise AmiwarpError(f"{name} declares shape {shape}, which the archive does not hold; copy the file again")
    return (stream, shape, dtype), by_columns and len(shape) > 1


def _read_header(stream: IO[bytes], name: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of an array: its shape, whether it is stored by columns, and its type."""
    version = npy.read_magic(stream)
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if read is None:
        raise AmiwarpError(f"{name} has a header of version {version}; expected 1.0 or 2.0")
    return read(stream)


def _has_kind(dtype: np.dtype[Any], kinds: str) -> bool:
    """Return whether a type is of these kinds. Object arrays would be unpickled, which is unsafe."""
    return not dtype.hasobject and dtype.kind in kinds


def _header(stream: IO[bytes], name: str, file_bytes: int, kinds: str) -> Array:
    """Read the header of an array of ``file_bytes`` bytes, and check it. Refuse an array that is stored by columns."""
    array, by_columns = array_header(stream, f"array {name}", file_bytes, kinds)
    if by_columns:
        raise AmiwarpError(f"array {name} is stored by columns; save numpy.ascontiguousarray of it")
    return array


# Maps of a sensor's pixels: arrays with one value or vector per pixel.


def save_map(path: Path, what: str, arrays: Mapping[str, NDArray[Any]], *, overwrite: bool) -> None:
    """Write the arrays of a map, by name, to a ``.npz`` file; ``what`` names such a map."""
    check_ending(path, f"{what}s are written", [".npz"])
    with NewFile(path, overwrite=overwrite) as new, open(new.part, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def save_rows(path: Path, names: Sequence[str], blocks: Iterable[tuple[NDArray[Any], ...]], form: str) -> None:
    """Write blocks of columns to a new text file, under a line with their names; ``form``: format of a row."""
    with NewFile(path) as new, open(new.part, "wb") as file:
        file.write((",".join(names) + "\n").encode())
        for block in blocks:
            np.savetxt(file, np.column_stack(block), fmt=form)


class ArrayMap:
    """Map with values for each pixel, which a file of NumPy arrays holds: a dataclass of the arrays."""

    _WHAT: ClassVar[str]
    """Name of such a map in messages."""
    _COMMAND: ClassVar[str]
    """Command that makes one."""
    _KINDS: ClassVar[Mapping[str, str]]
    """Kinds of data types that each array may have, as in ``numpy.dtype.kind``."""
    _AXES: ClassVar[Mapping[str, int]] = {}
    """Numbers of axes of the arrays that do not have two."""

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the map to a file of NumPy arrays with the names of the attributes.

        Parameters
        ----------
        path : str or Path
            The file, which ends in ``.npz``.
        overwrite : bool, default False
            Whether to replace an existing file.

        Raises
        ------
        AmiwarpError
            If the file has another extension, exists and ``overwrite`` is False, or cannot be written.
        """
        save_map(Path(path), self._WHAT, {name: getattr(self, name) for name in self._KINDS}, overwrite=overwrite)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a map that :meth:`save` wrote.

        Parameters
        ----------
        path : str or Path
            The file.

        Returns
        -------
        Self
            The map.

        Raises
        ------
        AmiwarpError
            If the file cannot be read, or does not hold the arrays of a map. The message names the array.
        """
        values, path = {}, Path(path)
        with errors_name(path, lambda: f"is no {cls._WHAT}"), zipfile.ZipFile(input_path(path)) as archive:
            names = archive.namelist()
            for name, allowed in cls._KINDS.items():
                if f"{name}.npy" not in names:
                    raise AmiwarpError(f"has no array {name}; make the map with '{cls._COMMAND}'")
                with open_array(archive, name, allowed) as (stream, shape, dtype):
                    if len(shape) != cls._AXES.get(name, 2) or max(shape) > LARGEST_SIZE:
                        raise AmiwarpError(f"array {name} has shape {shape}; expected (height, width)")
                    values[name] = np.frombuffer(stream.read(math.prod(shape) * dtype.itemsize), dtype).reshape(shape)
            return cls(**values)


def holds_map(path: Path, kinds: Iterable[type[ArrayMap]]) -> bool:
    """Return whether a file holds a map of one of these kinds, by the names of its arrays."""
    if path.suffix.lower() != ".npz":
        return False
    try:
        with zipfile.ZipFile(input_path(path)) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
    except (zipfile.BadZipFile, OSError):
        return False
    return any(names >= kind._KINDS.keys() for kind in kinds)


def save_tensors(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the tensors of a recording of a data set by name, without compression, replacing an existing file.

    Equal tensors give equal files.
    """
    with NewFile(path, overwrite=True) as new, open(new.part, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_tensors(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays that :func:`save_tensors` wrote. Raises :class:`AmiwarpError` if there is no ``tensor``."""
    found = {}
    with errors_name(path, lambda: "reading tensors"), zipfile.ZipFile(input_path(path)) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        if "tensor" not in names:
            raise AmiwarpError(f"has no array tensor, but {', '.join(names[:8])}; make this recording again")
        for name in names:
            with open_array(archive, name, "iuf") as (stream, shape, dtype):
                found[name] = np.frombuffer(bytearray(stream.read()), dtype).reshape(shape)
    return found


def lengths(count: int, notes: dict[str, int]) -> Iterator[int]:
    """Yield the lengths of the pieces of ``count`` events, and note the progress."""
    notes["total"] = max(count, 1)
    for start in range(0, count, DEFAULT_BLOCK):
        notes["read"] = min(start + DEFAULT_BLOCK, count)
        yield min(DEFAULT_BLOCK, count - start)


def next_rows(array: Array, length: int) -> NDArray[Any]:
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
        for length in lengths(counts["t"], notes):
            t, xy, p = (next_rows(array, length) for array in arrays.values())
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
                with (folder / name).open("rb") as column:
                    write_array(archive, name, (count,), dtype, iter(partial(column.read, 1 << 20), b""))
            for name in ("width", "height"):
                write_array(archive, name, (), "<i8", [np.array([getattr(about, name)], "<i8").tobytes()])


def write_array(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], dtype: str, parts: Iterable[bytes]
) -> None:
    """Write an array to an archive part by part. Equal arrays give equal files."""
    member = zipfile.ZipInfo(f"{name}.npy")
    member.compress_type = archive.compression
    with archive.open(member, "w", force_zip64=True) as file:
        npy.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
        for part in parts:
            file.write(part)


# Reader of the ``.bin`` files of N-MNIST and N-Caltech101: events of 5 bytes, without a header.
#
# The bytes are x, y, and 24 bits, big-endian: the polarity (1 is ON) and 23 bits of the time [us]. In some of these
# files an event with y = 240 is no event but a mark: 2**13 us are added to the times after it. The data sets have 34 or
# up to 180 rows. Such marks are counted and dropped, as by the data sets' own reader.

MARK_US = 1 << 13
"""Time between two marks [us]."""
FRAMES = ((34, 34), (240, 180), (304, 240))
"""Frames [px]: N-MNIST, N-Caltech101, and the camera of both."""


def open_bin(path: Path) -> Recording:
    """Open a file of 5-byte events."""
    with errors_name(path, lambda: "opening"), open_input(path) as file:
        if not looks_like_bin(file.read(4096), path.stat().st_size):
            raise AmiwarpError("does not hold events of 5 bytes in the order of time; give another file")
    events = FileEvents(path, partial(_bin_packets, path), size=None, sensors=FRAMES)
    return Recording(events=events, metadata={"format": "bin", **events.metadata}, name=path.stem)


def _bin_packets(path: Path, notes: dict[str, int]) -> Iterator[Packet]:
    marks = 0
    for data in read_pieces(path, 0, BIN_EVENT_BYTES * DEFAULT_BLOCK, notes):
        x, y, t, p = bin_columns(np.frombuffer(data, np.uint8))
        is_mark = y == BIN_MARK_ROW
        t = t + (marks + np.cumsum(is_mark)) * MARK_US
        marks += int(np.count_nonzero(is_mark))
        notes["overflow_marks"] = marks
        yield x[~is_mark], y[~is_mark], t[~is_mark], p[~is_mark]
