"""Writer of rows that are appended to datasets of a native recording, in small chunks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.chunks import Codec
from amiwarp.io.native_layout import make_dataset

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
