"""A directive that shows measurements: a table from a file of ``benchmarks/results``.

In Markdown::

    ```{results-table} speed_cuda.json
    :rows: rows
    :where: scene = random pixels; model = exact
    :sort: -rate_per_s

    Implementation   | name
    Billion events/s | rate_per_s | *1e-9 .3g
    ```

Each line of the body is a column: its heading, the field, and optionally a factor and a format of Python.
``:rows:`` is the path of the rows in the file, with dots. ``*`` stands for every key; the field ``key`` then holds it.
``:where:`` keeps rows whose fields have these values. ``:sort:`` names a field, with ``-`` for descending order.
With ``:by: FIELD, FIELD`` rows of equal fields become one; the other columns then say how:
``median FIELD``, ``mean``, ``min``, ``max`` or ``count``.
"""

from __future__ import annotations

import json
import re
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

SUMMARIES: dict[str, Callable[[list[Any]], Any]] = {
    "median": statistics.median,
    "mean": statistics.fmean,
    "min": min,
    "max": max,
    "count": len,
}
Row = dict[str, Any]


class ResultsError(ValueError):
    """A table that cannot be made from its file."""


@dataclass(frozen=True)
class Column:
    """One column of a table."""

    heading: str
    summary: str
    """One of :data:`SUMMARIES`, or empty to take the value of the first row."""
    field: str
    factor: float
    format: str

    @classmethod
    def parse(cls, line: str) -> Column:
        """Read ``heading | [summary] field | [*factor] [format]``."""
        parts = [part.strip() for part in line.split("|")]
        if len(parts) not in (2, 3):
            raise ResultsError(
                f"column {line!r}: expected 'heading | field' or 'heading | field | format'"
            )
        first, _, rest = parts[1].partition(" ")
        summary, field = (first, rest.strip()) if first in SUMMARIES else ("", parts[1])
        match = re.fullmatch(r"(?:\*(\S+))?\s*(\S*)", parts[2] if len(parts) == 3 else "")
        if match is None:
            raise ResultsError(
                f"column {line!r}: expected '*factor format', as '*1e-6 .3g', after the second |"
            )
        return cls(parts[0], summary, field, float(match[1] or 1.0), match[2])

    def text(self, rows: list[Row]) -> tuple[str, bool]:
        """Return what the cell for ``rows`` shows, and whether it is a number."""
        values = [value(row, self.field) for row in rows] if self.field else list(rows)
        known = [one for one in values if one is not None]
        if not known:
            return "–", False
        one = SUMMARIES[self.summary](known) if self.summary else known[0]
        number = isinstance(one, int | float) and not isinstance(one, bool)
        if not number:
            return ("yes" if one else "no") if isinstance(one, bool) else str(one), False
        return format(one * self.factor if self.factor != 1.0 else one, self.format or "g"), True


def value(row: Any, path: str) -> Any:
    """Return the value at ``path`` in nested dictionaries and lists, or None if a row has none."""
    for key in path.split("."):
        if isinstance(row, list) and key.lstrip("-").isdigit():
            row = row[int(key)]
        elif isinstance(row, dict):
            row = row.get(key)
        else:
            return None
    return row


def rows_at(data: Any, path: str) -> Iterator[Row]:
    """Yield the rows at ``path``: the rows of a list, or a single one."""
    key, _, rest = path.partition(".")
    if key == "*":
        for name, below in data.items():
            for row in rows_at(below, rest):
                yield {"key": name, **row}
    elif key:
        if not isinstance(data, dict) or key not in data:
            raise ResultsError(f"no {key!r} in the file")
        yield from rows_at(data[key], rest)
    else:
        yield from data if isinstance(data, list) else [data]


def select(rows: list[Row], where: str) -> list[Row]:
    """Keep the rows that have all values of ``where``, as in ``field = value; field = value``."""
    for condition in filter(None, (part.strip() for part in where.split(";"))):
        field, equals, wanted = (part.strip() for part in condition.partition("="))
        if not equals:
            raise ResultsError(f"condition {condition!r}: expected 'field = value'")
        rows = [row for row in rows if str(value(row, field)) == wanted]
    if not rows:
        raise ResultsError(f"no row is left where {where!r}")
    return rows


def group(rows: list[Row], fields: list[str]) -> list[list[Row]]:
    """Return the rows in groups of equal ``fields``, in the order of the first ones."""
    if not fields:
        return [[row] for row in rows]
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(str(value(row, field)) for field in fields), []).append(row)
    return list(groups.values())


class ResultsTable(SphinxDirective):
    """Table of measurements from a JSON file."""

    required_arguments = 1
    has_content = True
    option_spec: ClassVar[dict[str, Any]] = {
        "rows": directives.unchanged,
        "where": directives.unchanged,
        "sort": directives.unchanged,
        "by": directives.unchanged,
        "caption": directives.unchanged,
    }

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        path = Path(self.env.app.srcdir).parent / "benchmarks" / "results" / self.arguments[0]
        self.env.note_dependency(str(path))
        try:
            return [self.table(json.loads(path.read_text()))]
        except (OSError, ValueError, TypeError, IndexError) as error:
            raise self.error(f"results-table {self.arguments[0]}: {error}") from error

    def table(self, data: Any) -> nodes.table:
        """Return the table of ``data``."""
        columns = [Column.parse(line) for line in self.content if line.strip()]
        rows = select(
            list(rows_at(data, self.options.get("rows", ""))), self.options.get("where", "")
        )
        if "sort" in self.options:
            field = self.options["sort"].strip()
            rows.sort(key=lambda row: value(row, field.lstrip("-")), reverse=field.startswith("-"))
        fields = [field.strip() for field in self.options.get("by", "").split(",") if field.strip()]
        out = nodes.table(classes=["results"])
        if "caption" in self.options:
            out += nodes.title("", "", *self.parse_inline(self.options["caption"])[0])
        body = nodes.tgroup(cols=len(columns))
        body += [nodes.colspec(colwidth=1) for _ in columns]
        body += nodes.thead("", self.row([self.entry(column.heading, False) for column in columns]))
        cells = [
            [self.entry(*column.text(same)) for column in columns] for same in group(rows, fields)
        ]
        body += nodes.tbody("", *map(self.row, cells))
        out += body
        return out

    def entry(self, text: str, number: bool) -> nodes.entry:
        """Return a cell."""
        children = [nodes.Text(text)] if number else self.parse_inline(text)[0]
        return nodes.entry(
            "", nodes.paragraph("", "", *children), classes=["number"] if number else []
        )

    def row(self, cells: list[nodes.entry]) -> nodes.row:
        """Return a row of cells."""
        return nodes.row("", *cells)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("results-table", ResultsTable)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
