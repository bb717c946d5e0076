"""Datasets of a file: as they are, and as rows and images that are read on demand.

A dataset refers to its file weakly, so rows and images keep the file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events import recording as checks
from amiwarp.events.stores import Instants
from amiwarp.io.hdf5.file import Column, Hdf5File
from amiwarp.io.inputs import errors_name


def dataset_of(
    file: Hdf5File, name: str, count: int | None = None, row: tuple[int, ...] | None = None
) -> Column:
    """Return a dataset; raise :class:`AmiwarpError` if the dataset is missing or does not have the expected shape.

    ``count``: expected number of rows; ``row``: expected shape of a row. None accepts any.
    """
    if name not in file.columns:
        raise AmiwarpError(f"no dataset '{name}'; the file is incomplete", ErrorCode.FILE_DAMAGED)
    column = file.columns[name]
    shape = (len(column), *column.row)
    expected = (len(column) if count is None else count, *(column.row if row is None else row))
    if shape != expected:
        raise AmiwarpError(
            f"dataset '{name}' has shape {shape}; expected {expected}; the file is damaged",
            ErrorCode.FILE_DAMAGED,
        )
    return column


class StoredRows:
    """Rows of one or several datasets that are read on demand."""

    def __init__(
        self, path: Path, name: str, count: int, read: Callable[[int, int], Any], file: Hdf5File
    ) -> None:
        self._path = path
        self._name = name
        self._count = count
        self._read = read
        self._file = file

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, which: slice, /) -> Any:
        with errors_name(self._path, lambda: self._name):
            start, stop = checks.slice_bounds(which, self._count, "rows")
        with errors_name(self._path, lambda: f"{self._name} {start} .. {stop}"):
            return self._read(start, stop)


class StoredImages(Instants[Any]):
    """Images, or ground truth of all pixels, at several times, read on demand."""

    def __init__(
        self,
        path: Path,
        name: str,
        t: NDArray[np.int64],
        size: tuple[int, int],
        read: Callable[[int], Any],
        file: Hdf5File,
        exposure: NDArray[np.int64] | None = None,
    ) -> None:
        super().__init__(t)
        self._path = path
        self._name = name
        self._image = read
        self._file = file
        self.size = size
        """Size (width, height) of the images [px]."""
        self.exposure = exposure
        """Begin and end of each exposure of frames [us], shape ``(k, 2)``, or None."""

    def _read(self, index: int) -> Any:
        with errors_name(self._path, lambda: f"{self._name} {index}"):
            return self._image(index)
