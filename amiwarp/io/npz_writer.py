"""Writer of NumPy archives, which :func:`numpy.load` reads: arrays x, y, t and p, and the numbers width and height.

An archive holds one array after the other. The arrays therefore grow in temporary files next to the archive.
"""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.events.recording import Events
from amiwarp.io.numpy_arrays import write_array
from amiwarp.io.output_formats import Outline
from amiwarp.io.unfinished import scratch_folder

COLUMNS = {"x": "<u2", "y": "<u2", "t": "<i8", "p": "|u1"}
"""Types of the arrays."""
COMPENSATED_COLUMNS = {"x": "<f4", "y": "<f4", "t": "<i8", "p": "|u1"}
"""Types of the arrays of compensated events."""


def write_npz(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events."""
    with scratch_folder(part.parent) as folder:
        columns, count = _write_columns(folder, blocks)
        with zipfile.ZipFile(part, "x") as archive:
            for name, dtype in columns.items():
                with (folder / name).open("rb") as column:
                    pieces = iter(partial(column.read, 1 << 20), b"")
                    write_array(archive, name, (count,), dtype, pieces)
            for name, value in (("width", about.width), ("height", about.height)):
                number = np.array([value], "<i8")
                write_array(archive, name, (), "<i8", [number.tobytes()])


def _write_columns(folder: Path, blocks: Iterable[Events]) -> tuple[dict[str, str], int]:
    """Write a file for each array. Return their types and the number of events."""
    columns = COLUMNS
    count = 0
    with contextlib.ExitStack() as opened:
        files = {}
        for name in COLUMNS:
            files[name] = opened.enter_context((folder / name).open("wb"))
        for events in blocks:
            columns = COLUMNS if events.whole_pixels else COMPENSATED_COLUMNS
            count += len(events)
            for name, dtype in columns.items():
                values = np.ascontiguousarray(getattr(events, name), dtype)
                files[name].write(values.data)
    return columns, count
