"""Report of the stability study: its results as JSON, as a table and as a summary in Markdown."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from amiwarp.io.outputs import write_csv, write_text
from amiwarp.studies.stability.aims import STATED_HEADINGS, WORKS
from amiwarp.studies.stability.atlas import Atlas
from amiwarp.studies.stability.judging import Outcome
from amiwarp.studies.stability.points import JUDGED, AxisPoint, axis_label, percent, value_label


def write(atlas: Atlas, folder: Path) -> dict[str, Path]:
    """Write atlas.json, atlas.csv and summary.md, and return their paths; each write is atomic."""
    files = {
        "data": folder / "atlas.json",
        "table": folder / "atlas.csv",
        "summary": folder / "summary.md",
    }
    write_text(files["data"], atlas_json(atlas))
    write_table(files["table"], atlas.spots)
    write_text(files["summary"], markdown(atlas))
    return files


def atlas_json(atlas: Atlas) -> str:
    """Return the study's results as JSON, one line per point."""
    data = {
        "format": "amiwarp-atlas",
        "version": 1,
        **atlas.about,
        "cells": atlas.cells,
        "aims": atlas.aims.to_json(),
        "stated_deviations": [deviation.to_json() for deviation in atlas.stated],
        "failures": [asdict(failure) for failure in atlas.failures],
    }
    head = json.dumps(data, indent=1, allow_nan=False).removesuffix("\n}")
    lines = []
    for spot in atlas.spots:
        lines.append(json.dumps(spot.to_json(), allow_nan=False, ensure_ascii=False))
    spots = ",\n  ".join(lines)
    return f'{head},\n "spots": [\n  {spots}\n ]\n}}\n'


def write_table(path: Path, spots: Sequence[AxisPoint]) -> None:
    """Write the points of the study as CSV, one line per point."""
    lines = [_table_line(spot) for spot in spots]
    # Points without errors lack the quantiles: the longest line gives the order of the columns.
    names: dict[str, None] = {}
    for line in sorted(lines, key=len, reverse=True):
        names |= dict.fromkeys(line)
    rows = [[line.get(name, "") for name in names] for line in lines]
    write_csv(path, names, rows)


def _table_line(spot: AxisPoint) -> dict[str, Any]:
    """Return the values of a point by the name of their column."""
    line: dict[str, Any] = {
        "axis": spot.axis.name,
        "field": spot.axis.field,
        "value": spot.value,
        "unit": spot.axis.unit,
        "method": spot.method,
        "n": len(spot.results),
        "failed": spot.failed,
    }
    for outcome in JUDGED:
        rate = spot.rate(outcome)
        low, high = rate.interval
        name = outcome.name.lower()
        line[name] = rate.count
        line[f"{name}_low"] = f"{low:.4f}"
        line[f"{name}_high"] = f"{high:.4f}"
    for quantile, error in spot.quantiles.items():
        line[f"error_px_{quantile}"] = f"{error:.4g}"
    line["limit_px"] = _number(spot.limit_px)
    line["seconds"] = _number(spot.seconds)
    line["message"] = spot.common_message(Outcome.REFUSAL, Outcome.SILENT)
    return line


def _number(median: float) -> str:
    """Return a median as text; empty for NaN."""
    return "" if math.isnan(median) else f"{median:.4g}"


def markdown(atlas: Atlas) -> str:
    """Return the summary as Markdown."""
    stated = [deviations.row() for deviations in atlas.stated]
    silent = _failing(atlas, Outcome.SILENT)
    refused = _failing(atlas, Outcome.REFUSAL)
    failures = [failure.row() for failure in atlas.failures]
    worse = []
    for comparison in atlas.aims.worse:
        value = value_label(comparison.axis, comparison.value)
        rates = (str(comparison.default), str(comparison.paper))
        worse.append((comparison.axis.name, value, *rates, f"{comparison.p_value:.2g}"))
    made = [str(atlas.about[name]) for name in ("machine", "date") if name in atlas.about]
    parts = [
        "# Atlas of failures",
        f"{atlas.cells:,} recordings, {atlas.failed_cells:,} failed in the study itself, "
        f"{len(atlas.axes)} axes, {len(atlas.methods)} methods; {'; '.join(made)}.",
        "## Aims",
        "\n".join(f"- {line}" for line in atlas.aims.lines()),
        "## Truth within the stated standard deviations",
        _grid(STATED_HEADINGS, stated),
        f"## Where each method works\n\nValues with at least {percent(WORKS)} successes.",
        _grid(("axis", *atlas.methods), summary(atlas)),
        "## Where the default succeeds less often than the paper's method",
        _grid(("axis", "value", "default", "paper", "p"), worse),
        "## Silent failures of the default",
        _grid(("axis", "value", "silent failures", "most common message"), silent),
        "## Refusals of the default",
        _grid(("axis", "value", "refusals", "most common message"), refused),
        "## Recordings that failed in the study itself\n\nThey are part of no rate. The same command tries them again.",
        _grid(("cell", "values", "methods", "error"), failures),
    ]
    return "\n\n".join(parts) + "\n"


def _failing(atlas: Atlas, outcome: Outcome) -> list[tuple[str, ...]]:
    """Return rows for the points at which the default method has an outcome: how often, and why."""
    rows: list[tuple[str, ...]] = []
    for spot in atlas.failing(outcome):
        value = value_label(spot.axis, spot.value)
        message = spot.common_message(outcome) or "–"
        rows.append((spot.axis.name, value, str(spot.rate(outcome)), message))
    return rows


def summary(atlas: Atlas) -> list[tuple[str, ...]]:
    """Return for each axis its name, and the values at which each method works."""
    rows = []
    for axis in atlas.axes:
        where = [atlas.works(axis, method) for method in atlas.methods]
        rows.append((axis_label(axis), *where))
    return rows


def _grid(headings: Sequence[str], rows: Sequence[tuple[str, ...]]) -> str:
    """Return headings and rows as a Markdown table."""
    if not rows:
        return "None."
    lines = []
    for row in (headings, ["---"] * len(headings), *rows):
        cells = [cell.replace("|", "\\|") for cell in row]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
