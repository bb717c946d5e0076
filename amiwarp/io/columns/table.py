"""Files of plain columns other than text: NumPy arrays (.npy, .npz), HDF5, MATLAB and Parquet.

Each reader finds the columns of its file, and :func:`open_table` decides what they mean, see
:mod:`amiwarp.io.columns.search`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.io.assumptions import SENSORS
from amiwarp.io.columns.layout import Column, Hints, Layout
from amiwarp.io.columns.options import GivenLayout
from amiwarp.io.columns.search import find_layout
from amiwarp.io.columns.units import check_duration
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.inputs import errors_name

LARGEST_FRAME = 4096
"""Largest side of a sensor that is assumed [px]."""

Pieces: TypeAlias = Callable[[tuple[int, ...], dict[str, int]], Iterator[tuple[NDArray[Any], ...]]]
"""Function that yields pieces of the columns with these indices, and notes how much of the file it has read."""


@dataclass(frozen=True)
class Table:
    """Columns of a file."""

    columns: Sequence[Column]
    """The columns, with their first values."""
    pieces: Pieces
    """Reader of all values."""
    hints: Hints = field(default_factory=Hints)
    """What the format promises."""
    size: tuple[int, int] | None = None
    """Sensor size (width, height) that the file states [px], or None."""
    metadata: Mapping[str, MetadataValue] = field(default_factory=dict)
    """Further findings for the metadata of the recording."""


def open_table(path: Path, format: str, table: Table, given: GivenLayout) -> Recording:
    """Open the events in the columns of a file."""
    with errors_name(path, lambda: "finding the columns"):
        layout = find_layout(table.columns, given, table.hints)
    # OpenMV's camera is the GenX320.
    sensors = ((320, 320),) if layout.openmv else SENSORS
    read = partial(_events, table, layout)
    events = FileEvents(path, read, size=table.size, sensors=sensors)
    check_table(path, events, layout)
    metadata = {"format": format, **layout.metadata, **table.metadata, **events.metadata}
    return Recording(events=events, metadata=metadata, name=path.stem)


def check_table(path: Path, events: FileEvents, layout: Layout) -> None:
    """Raise :class:`AmiwarpError` if the events make an assumption about their file implausible."""
    with errors_name(path, lambda: "checking the columns"):
        read_us = events.t_last - events.t_first
        check_duration(layout, round(read_us / events.share))
        width, height = events.size
        if not events.size_is_known and max(width, height) > LARGEST_FRAME:
            raise AmiwarpError(
                f"x and y reach {width - 1} and {height - 1}, more than any sensor has; divide them with --scale-xy, "
                f"or give the size, such as --size {width}x{height}",
                ErrorCode.AMBIGUOUS,
            )


def _events(table: Table, layout: Layout, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of a file."""
    for columns in table.pieces(layout.chosen, notes):
        yield layout.events(*columns, notes=notes)
