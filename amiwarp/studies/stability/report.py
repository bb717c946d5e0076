"""Evaluation of the stability study: rates along each axis, aims, and a summary."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from amiwarp.errors import AmiwarpError
from amiwarp.io.atomic_output import write_text
from amiwarp.studies.stability.cells import Cell, Method, Outcome, Result, Store, Stored, identity
from amiwarp.studies.stability.conditions import Axis, Condition, sensible

# Points of the stability study: rates and errors of one method at one value of an axis, and their text.

QUANTILES = (5, 25, 50, 75, 95)
"""Quantiles of the model error that are reported [%]."""


@dataclass(frozen=True)
class Rate:
    """Number of calibrations with some outcome, out of a total."""

    count: int
    """Number of calibrations with the outcome."""
    total: int
    """Total number of calibrations."""

    @property
    def share(self) -> float:
        """Share of the calibrations with the outcome; NaN for a total of 0."""
        return self.count / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % confidence interval of the share."""
        return _wilson(self.count, self.total)

    def __str__(self) -> str:
        if not self.total:
            return "0 of 0"
        low, high = self.interval
        return f"{percent(self.share)} ({percent(low)} to {percent(high)}; {self.count:,} of {self.total:,})"

    def to_json(self) -> dict[str, Any]:
        """Return count, total, share and confidence interval as JSON data."""
        low, high = self.interval
        share = round(self.share, 5) if self.total else None
        return {"count": self.count, "total": self.total, "share": share, "low": round(low, 5), "high": round(high, 5)}


@cache
def _wilson(count: int, total: int) -> tuple[float, float]:
    """Return Wilson's 95 % confidence interval of ``count / total``."""
    if not total:
        return 0.0, 1.0
    found = binomtest(count, total).proportion_ci(confidence_level=0.95, method="wilson")
    return float(found.low), float(found.high)


@dataclass(frozen=True)
class AxisPoint:
    """Results of one method at one value of an axis of the study, over all seeds."""

    axis: Axis
    """Axis of the study to which the point belongs."""
    value: Any
    """Value of the condition field that the axis varies."""
    method: str
    """Name of the calibration method."""
    results: tuple[Result, ...]
    """Results of the method for all seeds."""

    @property
    def errors(self) -> list[float]:
        """Model errors of all calibrations that were not refused [px rms]."""
        return [r.error_px for r in self.results if r.error_px is not None]

    @property
    def limit_px(self) -> float:
        """Median over the seeds of the largest model error that counts as a success [px rms]."""
        return float(np.median([r.limit_px for r in self.results]))

    @property
    def seconds(self) -> float:
        """Median time of a calibration [s]."""
        return float(np.median([r.seconds for r in self.results]))

    @property
    def quantiles(self) -> dict[int, float]:
        """Quantiles of the model error [px rms], by per cent; empty if every recording was refused."""
        errors = self.errors
        return dict(zip(QUANTILES, map(float, np.percentile(errors, QUANTILES)), strict=True)) if errors else {}

    def common_message(self, *outcomes: Outcome) -> str:
        """Return the most frequent message of the results with an outcome; empty if there is none."""
        return most_common_message(r.message for r in self.results if r.outcome in outcomes)

    def rate(self, outcome: Outcome) -> Rate:
        """Return how many of the results have an outcome."""
        return Rate(sum(r.outcome is outcome for r in self.results), len(self.results))

    def to_json(self) -> dict[str, Any]:
        """Return the point as JSON data."""
        return {
            "axis": self.axis.name, "field": self.axis.field, "value": self.value, "unit": self.axis.unit,
            "method": self.method, **{o.name.lower(): self.rate(o).to_json() for o in Outcome},
            "error_px": {f"{q} %": float(f"{e:.4g}") for q, e in self.quantiles.items()},
            "limit_px": float(f"{self.limit_px:.4g}"), "seconds": float(f"{self.seconds:.4g}"),
            "messages": {o.name.lower(): text for o in Outcome if (text := self.common_message(o))},
        }  # fmt: skip


def most_common_message(messages: Iterable[str]) -> str:
    """Return the most frequent message, without the recording's name.

    Messages that differ only in numbers count as one.
    """
    texts = [m.replace("simulation: ", "") for m in messages if m]
    kinds = [re.sub(r"-?\d[\d.,]*", "#", m) for m in texts]
    return texts[kinds.index(Counter(kinds).most_common(1)[0][0])] if texts else ""


def value_label(axis: Axis, value: Any) -> str:
    """Return a value of an axis as text; shares in per cent."""
    if isinstance(value, bool):
        return "wrong" if value else "right"
    if isinstance(value, str):
        return value
    if axis.field == "window_events" and value == 0:
        return "all"
    if axis.unit.startswith(("of all", "of the", "relative")):
        return f"{100 * value:.10g} %"
    return f"{value:,.10g}"


def axis_label(axis: Axis) -> str:
    """Return name and unit of an axis."""
    return f"{axis.name} [{axis.unit}]" if axis.unit else axis.name


def percent(share: float) -> str:
    """Return a share as text in per cent."""
    return f"{100 * share:.3g} %"


DEFAULT, PAPER = "default", "paper"
"""Names of the default method and of the paper's method."""
AIM_SUCCESS, AIM_SILENT = 0.99, 0.01
"""Aims for the default method: smallest share of successes where a calibration is expected to work, and largest share
of silent failures elsewhere."""
WORKS = 0.9
"""Share of successes from which a method is said to work at a value of an axis."""
SIGNIFICANT = 0.05
"""Significance level of the comparison of the default with the paper's method."""


@dataclass(frozen=True)
class WorseThanPaper:
    """Value of an axis at which the default method succeeds less often than the paper's method."""

    axis: Axis
    """Axis of the study that the value belongs to."""
    value: Any
    """Value of the condition field that the axis varies."""
    default: Rate
    """Number of successes of the default method."""
    paper: Rate
    """Number of successes of the paper's method."""
    p_value: float
    """One-sided p-value of the exact McNemar test; both methods ran on the same recordings."""

    @property
    def significant(self) -> bool:
        """Whether the difference is significant."""
        return self.p_value < SIGNIFICANT

    def to_json(self) -> dict[str, Any]:
        """Return the comparison as JSON data."""
        return {"axis": self.axis.name, "value": self.value, "default": self.default.to_json(),
                "paper": self.paper.to_json(), "p_value": self.p_value, "significant": self.significant}  # fmt: skip


@dataclass(frozen=True)
class Aims:
    """Aims for the default method, and the measured rates. A cell that several axes share counts once."""

    inside: Rate
    """Rate of successes where a calibration is expected to work."""
    outside: Rate
    """Rate of silent failures where a calibration is not expected to work."""
    worse: tuple[WorseThanPaper, ...]
    """Values at which the default method succeeds less often than the paper's method, by increasing p-value."""

    @property
    def holds(self) -> dict[str, bool]:
        """Whether each aim is reached, by name."""
        return {
            "success inside": self.inside.total > 0 and self.inside.share >= AIM_SUCCESS,
            "silent failures outside": not self.outside.total or self.outside.share <= AIM_SILENT,
            "nowhere worse than the paper": not any(w.significant for w in self.worse),
        }

    def to_json(self) -> dict[str, Any]:
        """Return the aims as JSON data."""
        return {"success inside": self.inside.to_json(), "silent failures outside": self.outside.to_json(),
                "worse than the paper": [w.to_json() for w in self.worse], "holds": self.holds}  # fmt: skip

    def lines(self) -> list[str]:
        """Return the aims and the measured rates as lines of text."""
        words = {True: "holds", False: "MISSED"}
        held = list(self.holds.values())
        bad = [f"{w.axis.name} {value_label(w.axis, w.value)}" for w in self.worse if w.significant]
        return [
            f"default: successes inside the sensible region, at least {percent(AIM_SUCCESS)}: {self.inside}: "
            + words[held[0]],
            f"default: silent failures outside of it, at most {percent(AIM_SILENT)}: {self.outside}: {words[held[1]]}",
            f"default: nowhere worse than the paper: significantly worse at {', '.join(bad) if bad else 'no value'}, "
            f"fewer successes at {len(self.worse)} values: {words[held[2]]}",
        ]


@dataclass(frozen=True)
class Atlas:
    """Results of the study as points, one per axis, method and value, in the order of axes and values.

    Points without results are left out.
    """

    spots: tuple[AxisPoint, ...]
    """Points of all axes: results of one method at one value each."""
    aims: Aims
    """Aims for the default method, and the measured rates."""
    cells: int
    """Number of cells (single recordings) that were evaluated."""
    about: dict[str, Any]
    """Description of the machine, the versions and the date."""

    @property
    def axes(self) -> list[Axis]:
        """Axes of the study for which there are results."""
        return list(dict.fromkeys(s.axis for s in self.spots))

    @property
    def methods(self) -> list[str]:
        """Names of the methods for which there are results."""
        return list(dict.fromkeys(s.method for s in self.spots))

    def of(self, axis: Axis) -> dict[tuple[str, Any], AxisPoint]:
        """Return the points of an axis, by method and value."""
        return {(s.method, s.value): s for s in self.spots if s.axis == axis}

    def works(self, axis: Axis, method: str) -> str:
        """Return the values at which a method works, as text; runs of neighbours are written as from ... to."""
        spots = self.of(axis)
        values = [v for v in axis.values if any(value == v for _, value in spots)]
        good = [(s := spots.get((method, v))) is not None and s.rate(Outcome.SUCCESS).share >= WORKS for v in values]
        if all(good) or not any(good):
            return "everywhere" if all(good) else "nowhere"
        runs: list[list[Any]] = []
        for k, value in enumerate(values):
            if good[k]:
                runs[-1].append(value) if k and good[k - 1] else runs.append([value])
        named = [[value_label(axis, v) for v in run] for run in runs]
        return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(run) for run in named)

    def failing(self, outcome: Outcome) -> list[AxisPoint]:
        """Return the points at which the default method has this outcome, the highest rate first."""
        found = [s for s in self.spots if s.method == DEFAULT and s.rate(outcome).count]
        return sorted(found, key=lambda s: -s.rate(outcome).share)

    def write(self, folder: Path) -> dict[str, Path]:
        """Write atlas.json, atlas.csv and summary.md, and return their paths; each write is atomic."""
        files = {"data": folder / "atlas.json", "table": folder / "atlas.csv", "summary": folder / "summary.md"}
        write_text(files["data"], _json(self))
        write_text(files["table"], _csv(self.spots))
        write_text(files["summary"], _markdown(self))
        return files


def aggregate(cells: Sequence[Stored], axes: Sequence[Axis], methods: Sequence[Method], about: dict[str, Any]) -> Atlas:
    """Evaluate stored cells along the axes of the study.

    Raises :class:`AmiwarpError` if there are no results of these axes and methods.
    """
    names = {m.name: identity(m) for m in methods}
    by_condition: dict[Condition, list[Stored]] = {}
    for stored in sorted(cells, key=lambda s: s.cell.seed):
        by_condition.setdefault(stored.cell.condition, []).append(stored)
    met: dict[Cell, Stored] = {}
    spots, worse = [], []
    for axis in axes:
        for value, condition in zip(axis.values, axis.conditions(), strict=True):
            stored_cells = by_condition.get(condition, [])
            met.update({s.cell: s for s in stored_cells if any(key in s.results for key in names.values())})
            for name, key in names.items():
                if results := tuple(s.results[key] for s in stored_cells if key in s.results):
                    spots.append(AxisPoint(axis, value, name, results))
            worse += _worse(axis, value, stored_cells, names)
    if not spots:
        raise AmiwarpError(
            "found no results of single runs (cells) for these axes and methods; run without --redraw first"
        )
    return Atlas(tuple(spots), _aims(met.values(), names.get(DEFAULT), worse), len(met), about)


def _aims(cells: Iterable[Stored], default: str | None, worse: Sequence[WorseThanPaper]) -> Aims:
    """Return the aims for the default method with the measured rates."""
    inside: list[Outcome] = []
    outside: list[Outcome] = []
    for stored in cells:
        if default in stored.results:
            here = inside if sensible(stored.cell.condition, stored.events) else outside
            here.append(stored.results[default].outcome)
    return Aims(
        Rate(inside.count(Outcome.SUCCESS), len(inside)),
        Rate(outside.count(Outcome.SILENT), len(outside)),
        tuple(sorted(worse, key=lambda w: w.p_value)),
    )


def _worse(axis: Axis, value: Any, stored_cells: Sequence[Stored], names: dict[str, str]) -> list[WorseThanPaper]:
    """Compare the default with the paper's method at one value of an axis, by McNemar's test.

    Source: McNemar, "Note on the sampling error of the difference between correlated proportions", Psychometrika 1947.
    """
    if not {DEFAULT, PAPER} <= names.keys():
        return []
    both = [[s.results[names[n]].outcome is Outcome.SUCCESS for n in (DEFAULT, PAPER)]
            for s in stored_cells if names[DEFAULT] in s.results and names[PAPER] in s.results]  # fmt: skip
    lost, won = sum(p and not d for d, p in both), sum(d and not p for d, p in both)
    if lost <= won:
        return []
    default, paper = (Rate(sum(column), len(both)) for column in zip(*both, strict=True))
    p_value = float(binomtest(lost, lost + won, 0.5, alternative="greater").pvalue)
    return [WorseThanPaper(axis, value, default, paper, p_value)]


def _json(atlas: Atlas) -> str:
    """Return the study's results as JSON, one line per point."""
    data = {"format": "amiwarp-atlas", "version": 1, **atlas.about, "cells": atlas.cells, "aims": atlas.aims.to_json()}
    head = json.dumps(data, indent=1, allow_nan=False).removesuffix("\n}")
    lines = (json.dumps(s.to_json(), allow_nan=False, ensure_ascii=False) for s in atlas.spots)
    return head + ',\n "spots": [\n  ' + ",\n  ".join(lines) + "\n ]\n}\n"


def _csv(spots: Sequence[AxisPoint]) -> str:
    """Return the points of the study as CSV, one line per point."""

    def line(s: AxisPoint) -> dict[str, Any]:
        out: dict[str, Any] = {"axis": s.axis.name, "field": s.axis.field, "value": s.value, "unit": s.axis.unit,
                               "method": s.method, "n": len(s.results)}  # fmt: skip
        for outcome in Outcome:
            rate, name = s.rate(outcome), outcome.name.lower()
            low, high = rate.interval
            out |= {name: rate.count, f"{name}_low": f"{low:.4f}", f"{name}_high": f"{high:.4f}"}
        out |= {f"error_px_{q}": f"{e:.4g}" for q, e in s.quantiles.items()}
        return out | {"limit_px": f"{s.limit_px:.4g}", "seconds": f"{s.seconds:.4g}",
                      "message": s.common_message(Outcome.REFUSAL, Outcome.SILENT)}  # fmt: skip

    lines = [line(s) for s in spots]
    names = dict.fromkeys(n for each in sorted(lines, key=len, reverse=True) for n in each)
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _markdown(atlas: Atlas) -> str:
    """Return the summary as Markdown."""

    def rows_of(spots: Sequence[AxisPoint], outcome: Outcome) -> list[tuple[str, ...]]:
        return [
            (s.axis.name, value_label(s.axis, s.value), str(s.rate(outcome)), s.common_message(outcome) or "–")
            for s in spots
        ]

    silent, refused = atlas.failing(Outcome.SILENT), atlas.failing(Outcome.REFUSAL)
    parts = [
        "# Atlas of failures",
        f"{atlas.cells:,} recordings, {len(atlas.axes)} axes, {len(atlas.methods)} methods; "
        + "; ".join(str(atlas.about[k]) for k in ("machine", "date") if k in atlas.about) + ".",
        "## Aims",
        "\n".join(f"- {line}" for line in atlas.aims.lines()),
        f"## Where each method works\n\nValues with at least {percent(WORKS)} successes.",
        _grid(("axis", *atlas.methods), summary(atlas)),
        "## Where the default succeeds less often than the paper's method",
        _grid(("axis", "value", "default", "paper", "p"), [
            (w.axis.name, value_label(w.axis, w.value), str(w.default), str(w.paper), f"{w.p_value:.2g}")
            for w in atlas.aims.worse]),
        "## Silent failures of the default",
        _grid(("axis", "value", "silent failures", "most common message"), rows_of(silent, Outcome.SILENT)),
        "## Refusals of the default",
        _grid(("axis", "value", "refusals", "most common message"), rows_of(refused, Outcome.REFUSAL)),
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def summary(atlas: Atlas) -> list[tuple[str, ...]]:
    """Return for each axis its name, and the values at which each method works."""
    return [(axis_label(axis), *(atlas.works(axis, m) for m in atlas.methods)) for axis in atlas.axes]


def _grid(headings: Sequence[str], rows: Sequence[tuple[str, ...]]) -> str:
    """Return headings and rows as a Markdown table."""
    if not rows:
        return "None."
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def load(store: Store) -> list[Stored]:
    """Return all cells (results of single runs) of a folder; damaged cells and those of other versions are left out.

    Raises :class:`AmiwarpError` for a folder without cells.
    """
    out = store.load_all()
    if not out:
        what = "holds no results of single runs (cells) of this version"
        raise AmiwarpError(f"{store.folder}: {what}; run without --redraw first")
    return out
