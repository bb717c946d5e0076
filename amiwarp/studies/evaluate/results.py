"""What evaluations return: results of cells, and tables with their charts."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np

from amiwarp.studies.evaluate.conditions import Condition, RecordedCondition
from amiwarp.studies.evaluate.streams import Frames, Stream
from amiwarp.validation import real, whole

Compared = Literal[*Stream, *Frames]  # type: ignore[valid-type]
"""Type of what is compared: a stream of events or a standard camera."""
Share = Annotated[float, partial(real, low=0.0, high=1.0)]
"""Type of a share in a cell, 0 to 1."""
Amount = Annotated[float, partial(real, low=0.0, high=1e6)]
"""Type of a measured value in a cell that is not negative: pixels, degrees, milliseconds, relative rates and so on."""
Count = Annotated[int, partial(whole, low=0, high=10**12)]
"""Type of a number of things in a cell."""
Value = str | int | float | bool | None
"""Type of a value in a table."""


@dataclass(frozen=True)
class CellResult:
    """Result of one evaluation under one condition."""

    evaluation: str
    """Name of the evaluation."""
    condition: Condition | RecordedCondition
    """Condition under which it ran."""
    values: dict[str, Any] = field(default_factory=dict)
    """Values that the evaluation's function ``measure`` returned; empty if it failed."""
    error: str = ""
    """Message of an error that ended it, or empty."""
    processor_s: float = 0.0
    """Processor time of the measure [s], without the simulation."""


class ChartKind(enum.StrEnum):
    """Kinds of charts."""

    LINES = "lines"
    BARS = "bars"


@dataclass(frozen=True)
class Chart:
    """Chart of a table. All texts but the labels are names of columns."""

    x: str
    """Column of the horizontal axis."""
    y: str
    """Column of the vertical axis."""
    series: str
    """Column whose values are drawn as separate lines or bars."""
    spread: str | None = None
    """Column of the standard deviation over seeds, drawn as a band or as error bars."""
    panels: tuple[str, ...] = ()
    """Columns whose combinations are drawn in separate panels."""
    kind: ChartKind = ChartKind.LINES
    """Kind of the chart."""
    log_x: bool = False
    """Whether the horizontal axis is logarithmic."""
    log_y: bool = False
    """Whether the vertical axis is logarithmic."""
    marks: dict[str, float] = field(default_factory=dict)
    """Values of the vertical axis that are marked by a horizontal line, by their labels, such as the paper's."""


@dataclass(frozen=True)
class Table:
    """Table of results."""

    name: str
    """Name of its files."""
    title: str
    """Title: what is measured."""
    columns: tuple[str, ...]
    """Names of the columns, with their units."""
    rows: list[tuple[Value, ...]]
    """Rows."""
    caption: str = ""
    """What can be seen, and how to read it."""
    chart: Chart | None = None
    """Chart of the table, or None."""
    long: bool = False
    """Whether the table is too long for the page and for ``report.json``, and is only written as CSV."""


def rows_of(results: Sequence[CellResult], name: str) -> list[dict[str, Any]]:
    """Return the rows that the cells' values hold under ``name``, with the fields of their conditions.

    Each row also has ``scene`` (the world, or the name of a recording) and ``camera`` (the camera's motion).
    """
    rows = []
    for result in results:
        condition = result.condition
        if isinstance(condition, Condition):
            known = {**asdict(condition), "scene": condition.world, "camera": condition.trajectory}
        else:
            known = {"scene": condition.path.name, "camera": "recording", "seed": condition.seed}
        rows += [{**known, **row} for row in result.values.get(name, ())]
    return rows


def where(rows: Sequence[dict[str, Any]], **values: Any) -> list[dict[str, Any]]:
    """Return the rows that have the given value in each named column."""
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def grouped(
    rows: Sequence[dict[str, Any]], by: Sequence[str], values: Sequence[str]
) -> list[tuple[Value, ...]]:
    """Return one row for each combination of the columns ``by``, in order of appearance.

    A row holds the combination, the number of rows, and for each of ``values`` the mean and the standard deviation.
    Values that are None or NaN are left out.
    """
    groups: dict[tuple[Value, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    table: list[tuple[Value, ...]] = []
    for key, members in groups.items():
        cells: list[Value] = [*key, len(members)]
        for name in values:
            known = [row[name] for row in members if row.get(name) is not None]
            given = np.array(known, np.float64)
            given = given[np.isfinite(given)]
            if given.size:
                cells += [float(given.mean()), float(given.std())]
            else:
                cells += [None, None]
        table.append(tuple(cells))
    return table


def finite(value: float) -> float | None:
    """Return a number for a cell; None if it is not finite."""
    return value if np.isfinite(value) else None
