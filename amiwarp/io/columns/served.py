"""Files of plain columns that the reading process reads: HDF5, MATLAB and Parquet."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

from numpy.typing import NDArray

from amiwarp.events.recording import Recording
from amiwarp.io.columns.layout import Column
from amiwarp.io.columns.options import GivenLayout
from amiwarp.io.columns.table import Table, open_table
from amiwarp.io.inputs import errors_name
from amiwarp.io.reading_process import packets, run_with_arrays

Rows: TypeAlias = Iterator[tuple[NDArray[Any], ...]]
"""Pieces of some columns, one after the other."""

SERVER = "amiwarp.io.columns.server"
"""Name of the module that runs in the reading process."""


SERVED = {"hdf5": "the HDF5 file", "mat": "the MATLAB file", "parquet": "the Parquet table"}
"""Kinds of files that the reading process reads, for messages."""


def open_hdf5_columns(path: Path, given: GivenLayout) -> Recording:
    """Open an HDF5 file with datasets, records or a table of events."""
    return _open_served(path, "hdf5", given)


def open_mat(path: Path, given: GivenLayout) -> Recording:
    """Open a MATLAB file with arrays, a structure or a table of events. Its arrays are read as a whole."""
    return _open_served(path, "mat", given)


def open_parquet(path: Path, given: GivenLayout) -> Recording:
    """Open a Parquet table of events."""
    return _open_served(path, "parquet", given)


def _open_served(path: Path, kind: str, given: GivenLayout) -> Recording:
    """Open a file of events that the reading process reads."""
    source = path.absolute()
    with errors_name(path, lambda: f"finding events in {SERVED[kind]}"):
        about, head = run_with_arrays(f"{SERVER}:head_of", source, kind, given.columns)
    columns = []
    for name, values, unit in zip(about["names"], head, about["units"], strict=True):
        columns.append(Column(name, values, unit))

    def pieces(chosen: tuple[int, ...], notes: dict[str, int]) -> Rows:
        return packets(f"{SERVER}:read_columns", source, kind, given.columns, list(chosen), notes)

    size = about["size"] and tuple(about["size"])
    table = Table(columns, pieces, size=size)
    return open_table(path, kind, table, given)
