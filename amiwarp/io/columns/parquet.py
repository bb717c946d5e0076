"""Columns of a Parquet table. Runs in the reading process."""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray


class _ParquetColumn:
    """Column of a Parquet table. The rows of one group are in memory at a time."""

    def __init__(
        self,
        table: Any,
        bounds: NDArray[np.int64],
        name: str,
        dtype: np.dtype[Any],
    ) -> None:
        """``bounds``: the first row of each group, and the number of rows."""
        self._table = table
        self._bounds = bounds
        self._name = name
        self.shape = (int(bounds[-1]),)
        self.dtype = dtype
        self._group: int | None = None
        self._values = np.zeros(0, dtype)
        """Rows of the group in memory."""

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        first_group = int(np.searchsorted(self._bounds[1:], rows.start, side="right"))
        last_group = int(np.searchsorted(self._bounds[:-1], rows.stop, side="left"))
        parts = []
        for group in range(first_group, last_group):
            first = int(self._bounds[group])
            start = max(rows.start - first, 0)
            stop = rows.stop - first
            parts.append(self._rows(group)[start:stop])
        if not parts:
            return np.zeros(0, self.dtype)
        return np.concatenate(parts)

    def _rows(self, group: int) -> NDArray[Any]:
        """Return the rows of a group, which are read unless they are in memory."""
        if self._group != group:
            rows = self._table.read_row_group(group, columns=[self._name], use_threads=False)
            column = rows.column(0)
            values = column.to_numpy()
            if values.dtype.kind in "mM":
                # A time or a duration of Arrow becomes whole nanoseconds.
                nanoseconds = values.dtype.str[:2] + "8[ns]"
                values = values.astype(nanoseconds).astype(np.int64)
            self._group = group
            self._values = values
        return self._values


def parquet_arrays(path: str) -> dict[str, Any]:
    """Return the columns of a Parquet table by name."""
    from amiwarp.errors import optional_module

    # Arrow's own allocator reserves a gigabyte at once, which the limit of this process forbids.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    parquet: Any = optional_module("pyarrow.parquet", "dataset", "Parquet files need PyArrow")
    table = parquet.ParquetFile(path)
    lengths = [0]
    for group in range(table.metadata.num_row_groups):
        lengths.append(table.metadata.row_group(group).num_rows)
    bounds = np.cumsum(lengths, dtype=np.int64)
    columns = {}
    for field in table.schema_arrow:
        name = field.name
        try:
            dtype = np.dtype(field.type.to_pandas_dtype())
        except NotImplementedError:
            # Columns of text and the like are left out.
            continue
        if dtype.kind in "mM":
            name = f"{field.name} [ns]"
            dtype = np.dtype(np.int64)
        if dtype.kind in "iufb":
            columns[name] = _ParquetColumn(table, bounds, field.name, dtype)
    return columns
