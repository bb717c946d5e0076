"""Records of a recording that is written, beside its events: poses, truth of instants, IMU samples and frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import check_truth
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.hdf5.datasets import make_dataset
from amiwarp.io.native.layout import Columns
from amiwarp.io.output_formats import Codec
from amiwarp.validation import shown

ROWS = 1024
"""Number of rows per HDF5 chunk in datasets of small rows, such as poses."""


class Datasets:
    """Datasets of a file that is written. Each is made when its first values come."""

    def __init__(self, file: Any, codec: Codec) -> None:
        self._file = file
        self._codec = codec
        self._made: dict[str, Any] = {}

    def find(self, name: str) -> Any | None:
        """Return a dataset, or None if it has not been made yet."""
        return self._made.get(name)

    def make(
        self,
        name: str,
        dtype: np.dtype[Any],
        row: tuple[int, ...] = (),
        chunk_rows: int = CHUNK,
    ) -> Any:
        """Return a dataset, which is made at the first call."""
        if name not in self._made:
            self._made[name] = make_dataset(self._file, name, dtype, row, chunk_rows, self._codec)
        return self._made[name]

    def extend(self, name: str, values: NDArray[Any], chunk_rows: int = CHUNK) -> None:
        """Append rows to a dataset through HDF5."""
        dataset = self.make(name, values.dtype, values.shape[1:], chunk_rows)
        start = dataset.shape[0]
        dataset.resize(start + len(values), axis=0)
        dataset[start:] = values

    def write_names(self, name: str, names: Sequence[str]) -> None:
        """Write names to a new dataset of UTF-8 strings."""
        import h5py

        encoded = [text.encode("utf-8", "replace") for text in names]
        longest = max(map(len, encoded), default=0)
        longest = max(longest, 1)
        kind = h5py.string_dtype("utf-8", longest)
        self._file.create_dataset(name, data=np.array(encoded, kind))


class Records:
    """Writer of records to a file. Records that are refused leave the file as it was."""

    def __init__(self, path: Path, datasets: Datasets) -> None:
        """Write to ``datasets`` of the file that gets the name ``path``."""
        self._path = path
        self._datasets = datasets
        self._given: dict[str, tuple[str, ...]] = {}
        """What all calls must give: datasets, by the dataset of their times; bodies or joints, by the dataset of their
        names."""

    def append(
        self,
        rows: Columns,
        images: Columns | None = None,
        named: Mapping[str, tuple[str, Mapping[str, NDArray[np.float64]]]] | None = None,
    ) -> None:
        """Append records to their datasets, of which the first holds the times [us].

        ``images`` are stored in chunks of one row. ``named`` gives for each dataset of names the dataset of the values
        and the values by name. They are stored side by side, if there are any.
        """
        times, *_ = rows
        rows = dict(rows)
        names: dict[str, tuple[str, ...]] = {}
        for dataset_of_names, (dataset_of_values, values_by_name) in (named or {}).items():
            if values_by_name:
                names[dataset_of_names] = tuple(values_by_name)
                side_by_side = np.stack(list(values_by_name.values()), axis=1)
                rows[dataset_of_values] = side_by_side.astype(np.float64)
        columns = rows | (images or {})
        given = {times: tuple(columns), **names}

        # All checks come first, so that nothing is written of refused records.
        self._check_later(times, rows[times])
        self._check_same(given)
        self._check_values(columns)

        for dataset_of_names, found in names.items():
            if dataset_of_names not in self._given:
                self._datasets.write_names(dataset_of_names, found)
        self._given |= given
        for name, values in columns.items():
            self._datasets.extend(name, values, ROWS if name in rows else 1)

    def _check_later(self, name: str, t: NDArray[np.int64]) -> None:
        """Raise :class:`AmiwarpError` if times [us] do not follow the last time in a dataset.

        Only times of the ground truth must be later.
        """
        stored = self._datasets.find(name)
        if stored is None or not len(stored) or not len(t):
            return
        last = int(stored[-1])
        earliest = last + 1 if name.startswith("truth/") else last
        if t[0] < earliest:
            raise AmiwarpError(
                f"{self._path}: {name} {t[0]} us does not follow {last} us; append in order of time"
            )

    def _check_same(self, given: Mapping[str, tuple[str, ...]]) -> None:
        """Raise :class:`AmiwarpError` if other datasets, bodies or joints are given than before."""
        for where, now in given.items():
            before = self._given.get(where, now)
            if now != before:
                change = f"{where} comes with {shown(now)}, before with {shown(before)}"
                raise AmiwarpError(f"{self._path}: {change}; append the same in each call")

    def _check_values(self, columns: Columns) -> None:
        """Raise :class:`AmiwarpError` for values without meaning, and for rows of another shape than before."""
        for name, values in columns.items():
            if name.startswith("truth/"):
                check_truth(name, values)
            stored = self._datasets.find(name)
            if stored is not None and values.shape[1:] != stored.shape[1:]:
                raise AmiwarpError(
                    f"{self._path}: rows of {name} have shape {values.shape[1:]}; expected {stored.shape[1:]}"
                )
