"""Read the committed results, and write numbers as the report shows them."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"

Row = dict[str, Any]
Values = dict[str, str]


@dataclass(frozen=True)
class Table:
    """A table of the report."""

    columns: list[str]
    rows: list[list[str]]


@cache
def results(name: str) -> Any:
    """Return the content of a JSON file of ``benchmarks/results``."""
    return json.loads((RESULTS / name).read_text(encoding="utf-8"))


@cache
def page(name: str) -> str:
    """Return the text of a Markdown page of ``benchmarks/results``."""
    return (RESULTS / name).read_text(encoding="utf-8")


def table_after(name: str, start: str) -> list[dict[str, str]]:
    """Return the rows of the first table after a text of a Markdown page, by the names of the columns."""
    rest = page(name).split(start, 1)[1]
    lines = rest[rest.index("\n|") + 1 :].split("\n\n", 1)[0].splitlines()
    columns = cells(lines[0])
    return [dict(zip(columns, cells(line), strict=True)) for line in lines[2:]]


def cells(line: str) -> list[str]:
    """Return the cells of a line of a Markdown table."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def one(rows: Iterable[Row], **wanted: Any) -> Row:
    """Return the only row whose fields have the given values."""
    found = [row for row in rows if all(row[name] == value for name, value in wanted.items())]
    if len(found) != 1:
        raise ValueError(f"{len(found)} rows have {wanted}; expected one")
    return found[0]


def evaluation_rows(report: str, table: str) -> list[Row]:
    """Return the rows of a table of an evaluation report, ``"gpu"`` or ``"cpu"``."""
    for section in results(f"evaluate/{report}.json")["evaluations"]:
        for candidate in section["tables"]:
            if candidate["name"] == table:
                columns = candidate["columns"]
                return [dict(zip(columns, row, strict=True)) for row in candidate["rows"]]
    raise ValueError(f"no table {table!r} in the report {report!r}")


def claims(report: str) -> list[Row]:
    """Return all claims and checks of an evaluation report."""
    sections = results(f"evaluate/{report}.json")["evaluations"]
    return [claim for section in sections for claim in section["claims"]]


def median(rows: Iterable[Row], field: str) -> float:
    """Return the median of a field."""
    return float(statistics.median(row[field] for row in rows))


def fixed(value: float, digits: int) -> str:
    """Return a number with a number of decimals, a true minus sign and groups of thousands."""
    return f"{value:,.{digits}f}".replace("-", "−")


def significant(value: float, digits: int = 2) -> str:
    """Return a number with a number of significant digits, without an exponent."""
    rounded = float(f"{value:.{digits - 1}e}")
    exponent = int(f"{rounded:e}".split("e")[1])
    return fixed(rounded, max(0, digits - 1 - exponent))


def percent(share: float, digits: int = 0) -> str:
    """Return a share as a percentage."""
    return f"{fixed(100.0 * share, digits)} %"


def percents(shares: Iterable[float]) -> str:
    """Return shares as one list of whole percentages."""
    return f"{', '.join(fixed(100.0 * share, 0) for share in shares)} %"
