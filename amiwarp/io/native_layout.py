"""Layout of native HDF5 recordings: header, datasets, chunks and the millisecond index.

The format is described in ``docs/reference/recording-format.md``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MetadataValue
from amiwarp.io.camera_files import camera_attributes, prism_attributes
from amiwarp.io.chunks import CHUNK, GZIP_LEVEL, Codec, blosc_shuffle
from amiwarp.optics.camera import Camera, check_size

if TYPE_CHECKING:
    from amiwarp.optics.prism import NominalPrism


FORMAT = "amiwarp-recording"
"""Value of the attribute ``format`` of native recordings."""

FORMAT_VERSION = 1
"""Newest version of the format that is read, and the version that is written."""

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Arrays of a block of events, by the names of their datasets in the file."""

MAX_MS = 100_000_000
"""Longest recording that can be written [ms], 28 h. In a longer one a timestamp must be damaged, and the millisecond
index would be huge."""


def check_frame(path: Path, width: int, height: int, camera: Camera | None) -> None:
    """Raise :class:`AmiwarpError` for an impossible sensor size, or a size that differs from the camera's."""
    check_size(width, height, path)
    if camera is not None and (camera.width, camera.height) != (width, height):
        given = f"camera is {camera.width}x{camera.height}, the recording {width}x{height}"
        raise AmiwarpError(f"{path}: {given}; give both the same size")


def check_lengths(columns: Columns, count: int) -> None:
    """Raise :class:`AmiwarpError` for a column whose number of elements or rows differs from the number of events."""
    for name, column in columns.items():
        if column.shape[:1] != (count,) or (column.ndim > 1 and not name.startswith("truth/")):
            raise AmiwarpError(f"{name} has shape {column.shape}; expected ({count},)")


def ms_entries(t: NDArray[np.int64], t_offset: int, first_ms: int, before: int) -> Iterator[NDArray[np.int64]]:
    """Yield entries of the millisecond index ms_to_idx from entry ``first_ms`` on.

    ``t`` are the times of new events [us], which follow ``before`` earlier events.
    """
    last_ms = (int(t[-1]) - t_offset) // 1000
    if last_ms > MAX_MS:
        span = f"{t_offset} .. {int(t[-1])} us"
        raise AmiwarpError(f"events span {span}, beyond {MAX_MS // 3_600_000} h; a timestamp is damaged")
    for first in range(first_ms, last_ms + 1, 1 << 20):
        ms = np.arange(first, min(first + (1 << 20), last_ms + 1), dtype=np.int64)
        yield np.searchsorted(t, ms * 1000 + t_offset) + before


def describe_columns(columns: Mapping[str, np.dtype[Any]]) -> str:
    """Return names and data types of columns as text for messages."""
    return ", ".join(f"{name} {dtype}" for name, dtype in columns.items())


def make_dataset(
    file: Any,
    name: str,
    dtype: Any,
    row: tuple[int, ...] = (),
    chunk_rows: int = CHUNK,
    codec: Codec = Codec.BLOSC,
) -> Any:
    """Create an empty dataset of the native layout, whose rows have the shape ``row``."""
    import hdf5plugin

    blosc = {"compression": hdf5plugin.Blosc(cname="lz4", clevel=1, shuffle=blosc_shuffle(np.dtype(dtype)))}
    gzip = {"compression": "gzip", "compression_opts": GZIP_LEVEL, "shuffle": True}
    # The checksum covers the compressed bytes. Its cost is too small to measure. LZ4 alone misses most damage.
    return file.create_dataset(
        name,
        shape=(0, *row),
        maxshape=(None, *row),
        chunks=(chunk_rows, *row),
        dtype=dtype,
        fletcher32=True,
        **(blosc if codec is Codec.BLOSC else gzip),
    )


def write_header(
    file: Any,
    size: tuple[int, int],
    camera: Camera | None,
    prism: NominalPrism | None,
    metadata: Mapping[str, MetadataValue],
) -> None:
    """Write the parts of a file that are known before the first event: format, size, camera, prism and metadata."""
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["width"], file.attrs["height"] = size
    if camera is not None:
        file.create_group("camera").attrs.update(camera_attributes(camera))
    if prism is not None:
        file.create_group("prism").attrs.update(prism_attributes(prism))
    group = file.create_group("metadata")
    for name, item in metadata.items():
        group.attrs[name] = item


# Writer of rows that are appended to datasets of a native recording, in small chunks.

ROWS = 1024
"""Number of rows per HDF5 chunk in datasets of small rows, such as poses."""


class RowWriter:
    """Writer of rows into an open HDF5 file, whose datasets are created at their first rows."""

    def __init__(self, file: Any, path: Path, codec: Codec) -> None:
        self._file, self._path, self._codec = file, path, codec
        self._datasets: dict[str, Any] = {}

    def _append(self, name: str, values: NDArray[Any], chunk_rows: int) -> None:
        """Append rows to a dataset, which is created at the first call with ``chunk_rows`` rows per chunk."""
        if name not in self._datasets:
            self._datasets[name] = make_dataset(
                self._file, name, values.dtype, values.shape[1:], chunk_rows, self._codec
            )
        dataset = self._datasets[name]
        if dataset.shape[1:] != values.shape[1:]:
            raise AmiwarpError(
                f"{self._path}: rows of {name} have shape {values.shape[1:]}; expected {dataset.shape[1:]}"
            )
        start = dataset.shape[0]
        dataset.resize(start + len(values), axis=0)
        dataset[start:] = values

    def _check_later(self, name: str, t: int, *, equal: bool = False) -> None:
        """Raise :class:`AmiwarpError` if the time ``t`` [us] does not follow the last time in a dataset.

        ``equal``: whether the same time is allowed too.
        """
        stored = self._datasets.get(name)
        if stored is not None and len(stored) and (t < int(stored[-1]) or (t == int(stored[-1]) and not equal)):
            raise AmiwarpError(
                f"{self._path}: {name} {t} us does not follow {int(stored[-1])} us; append in order of time"
            )
