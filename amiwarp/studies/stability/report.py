"""What the cells of an atlas come to: rates along each axis, the aims, and a summary for people."""

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
from amiwarp.io.output import write_text
from amiwarp.studies.stability.cells import Cell, Method, Outcome, Result, Store, Stored, identity
from amiwarp.studies.stability.conditions import Axis, Condition, sensible

DEFAULT, PAPER = "default", "paper"
AIM_SUCCESS, AIM_SILENT = 0.99, 0.01
"""Of the default: least share of successes where it is expected to work, most of silent failures elsewhere."""
WORKS = 0.9
"""A method works at a value where it succeeds at least so often."""
SIGNIFICANT = 0.05
QUANTILES = (5, 25, 50, 75, 95)
"""[%] of the model error."""


@dataclass(frozen=True)
class Rate:
    """``count`` of ``total``."""

    count: int
    total: int

    @property
    def share(self) -> float:
        return self.count / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's, 95 %."""
        return _wilson(self.count, self.total)

    def __str__(self) -> str:
        if not self.total:
            return "0 of 0"
        low, high = self.interval
        return f"{_percent(self.share)} ({_percent(low)} to {_percent(high)}; {self.count:,} of {self.total:,})"

    def to_json(self) -> dict[str, Any]:
        low, high = self.interval
        share = round(self.share, 5) if self.total else None
        return {"count": self.count, "total": self.total, "share": share, "low": round(low, 5), "high": round(high, 5)}


@cache
def _wilson(count: int, total: int) -> tuple[float, float]:
    if not total:
        return 0.0, 1.0
    found = binomtest(count, total).proportion_ci(confidence_level=0.95, method="wilson")
    return float(found.low), float(found.high)


@dataclass(frozen=True)
class Spot:
    """What one method made of one value of an axis, over all seeds."""

    axis: Axis
    value: Any
    method: str
    results: tuple[Result, ...]

    @property
    def errors(self) -> list[float]:
        """Of its answers, refusals left out [px rms]."""
        return [r.error_px for r in self.results if r.error_px is not None]

    @property
    def limit_px(self) -> float:
        """Median of what counts as a success."""
        return float(np.median([r.limit_px for r in self.results]))

    @property
    def seconds(self) -> float:
        """Median time of a calibration."""
        return float(np.median([r.seconds for r in self.results]))

    @property
    def quantiles(self) -> dict[int, float]:
        """Of the model error [px rms], by per cent; empty where every recording was refused."""
        errors = self.errors
        return dict(zip(QUANTILES, map(float, np.percentile(errors, QUANTILES)), strict=True)) if errors else {}

    def said(self, *outcomes: Outcome) -> str:
        """The message that comes most often with these; empty where there is none."""
        return most_said(r.message for r in self.results if r.outcome in outcomes)

    def rate(self, outcome: Outcome) -> Rate:
        return Rate(sum(r.outcome is outcome for r in self.results), len(self.results))

    def to_json(self) -> dict[str, Any]:
        return {
            "axis": self.axis.name, "field": self.axis.field, "value": self.value, "unit": self.axis.unit,
            "method": self.method, **{o.name.lower(): self.rate(o).to_json() for o in Outcome},
            "error_px": {f"{q} %": float(f"{e:.4g}") for q, e in self.quantiles.items()},
            "limit_px": float(f"{self.limit_px:.4g}"), "seconds": float(f"{self.seconds:.4g}"),
            "messages": {o.name.lower(): said for o in Outcome if (said := self.said(o))},
        }  # fmt: skip


@dataclass(frozen=True)
class Worse:
    """A value at which the default succeeds less often than the paper's method."""

    axis: Axis
    value: Any
    default: Rate
    paper: Rate
    p_value: float
    """Of the exact McNemar test, one-sided: both met the same recordings."""

    @property
    def significant(self) -> bool:
        return self.p_value < SIGNIFICANT

    def to_json(self) -> dict[str, Any]:
        return {"axis": self.axis.name, "value": self.value, "default": self.default.to_json(),
                "paper": self.paper.to_json(), "p_value": self.p_value, "significant": self.significant}  # fmt: skip


@dataclass(frozen=True)
class Aims:
    """How near the default comes to what it should reach. A cell that several axes share counts once."""

    inside: Rate
    """Successes where a sensible user would expect to be served."""
    outside: Rate
    """Silent failures elsewhere."""
    worse: tuple[Worse, ...]

    @property
    def holds(self) -> dict[str, bool]:
        return {
            "success inside": self.inside.total > 0 and self.inside.share >= AIM_SUCCESS,
            "silent failures outside": not self.outside.total or self.outside.share <= AIM_SILENT,
            "nowhere worse than the paper": not any(w.significant for w in self.worse),
        }

    def to_json(self) -> dict[str, Any]:
        return {"success inside": self.inside.to_json(), "silent failures outside": self.outside.to_json(),
                "worse than the paper": [w.to_json() for w in self.worse], "holds": self.holds}  # fmt: skip

    def lines(self) -> list[str]:
        """For people."""
        words = {True: "holds", False: "MISSED"}
        held = list(self.holds.values())
        bad = [f"{w.axis.name} {words_of(w.axis, w.value)}" for w in self.worse if w.significant]
        return [
            f"default succeeds inside the sensible region, at least {_percent(AIM_SUCCESS)}: {self.inside}: "
            + words[held[0]],
            f"default fails silently outside of it, at most {_percent(AIM_SILENT)}: {self.outside}: {words[held[1]]}",
            f"default nowhere worse than the paper: {', '.join(bad) if bad else 'nowhere with significance'}, "
            f"fewer successes at {len(self.worse)} values: {words[held[2]]}",
        ]


@dataclass(frozen=True)
class Atlas:
    """All spots of some axes and methods, axes and their values in order; those without results are left out."""

    spots: tuple[Spot, ...]
    aims: Aims
    cells: int
    about: dict[str, Any]
    """Machine, versions, date."""

    @property
    def axes(self) -> list[Axis]:
        return list(dict.fromkeys(s.axis for s in self.spots))

    @property
    def methods(self) -> list[str]:
        return list(dict.fromkeys(s.method for s in self.spots))

    def of(self, axis: Axis) -> dict[tuple[str, Any], Spot]:
        """Its spots by method and value."""
        return {(s.method, s.value): s for s in self.spots if s.axis == axis}

    def works(self, axis: Axis, method: str) -> str:
        """The values at which a method works: runs of neighbours as from ... to."""
        spots = self.of(axis)
        values = [v for v in axis.values if any(value == v for _, value in spots)]
        good = [(s := spots.get((method, v))) is not None and s.rate(Outcome.SUCCESS).share >= WORKS for v in values]
        if all(good) or not any(good):
            return "everywhere" if all(good) else "nowhere"
        runs: list[list[Any]] = []
        for k, value in enumerate(values):
            if good[k]:
                runs[-1].append(value) if k and good[k - 1] else runs.append([value])
        named = [[words_of(axis, v) for v in run] for run in runs]
        return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(run) for run in named)

    def failing(self, outcome: Outcome) -> list[Spot]:
        """Values at which the default fails so, the most often first."""
        found = [s for s in self.spots if s.method == DEFAULT and s.rate(outcome).count]
        return sorted(found, key=lambda s: -s.rate(outcome).share)

    def write(self, folder: Path) -> dict[str, Path]:
        """Writes atlas.json, atlas.csv and summary.md, each whole or not at all."""
        files = {"data": folder / "atlas.json", "table": folder / "atlas.csv", "summary": folder / "summary.md"}
        write_text(files["data"], _json(self))
        write_text(files["table"], _csv(self.spots))
        write_text(files["summary"], _markdown(self))
        return files


def aggregate(cells: Sequence[Stored], axes: Sequence[Axis], methods: Sequence[Method], about: dict[str, Any]) -> Atlas:
    """What ``cells`` say of the ``axes``. Raises :class:`AmiwarpError` where they say nothing."""
    names = {m.name: identity(m) for m in methods}
    by_condition: dict[Condition, list[Stored]] = {}
    for stored in sorted(cells, key=lambda s: s.cell.seed):
        by_condition.setdefault(stored.cell.condition, []).append(stored)
    met: dict[Cell, Stored] = {}
    spots, worse = [], []
    for axis in axes:
        for value, condition in zip(axis.values, axis.conditions(), strict=True):
            there = by_condition.get(condition, [])
            met.update({s.cell: s for s in there if any(key in s.results for key in names.values())})
            for name, key in names.items():
                if results := tuple(s.results[key] for s in there if key in s.results):
                    spots.append(Spot(axis, value, name, results))
            worse += _worse(axis, value, there, names)
    if not spots:
        raise AmiwarpError("no cell of these axes and methods is there; run without --redraw first")
    return Atlas(tuple(spots), _aims(met.values(), names.get(DEFAULT), worse), len(met), about)


def _aims(cells: Iterable[Stored], default: str | None, worse: Sequence[Worse]) -> Aims:
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


def _worse(axis: Axis, value: Any, there: Sequence[Stored], names: dict[str, str]) -> list[Worse]:
    """McNemar, "Note on the sampling error of the difference between correlated proportions", Psychometrika 1947."""
    if not {DEFAULT, PAPER} <= names.keys():
        return []
    both = [[s.results[names[n]].outcome is Outcome.SUCCESS for n in (DEFAULT, PAPER)]
            for s in there if names[DEFAULT] in s.results and names[PAPER] in s.results]  # fmt: skip
    lost, won = sum(p and not d for d, p in both), sum(d and not p for d, p in both)
    if lost <= won:
        return []
    default, paper = (Rate(sum(column), len(both)) for column in zip(*both, strict=True))
    p_value = float(binomtest(lost, lost + won, 0.5, alternative="greater").pvalue)
    return [Worse(axis, value, default, paper, p_value)]


def most_said(messages: Iterable[str]) -> str:
    """The most frequent message, one of those that differ in numbers only; without the recording's name."""
    said = [m.replace("simulation: ", "") for m in messages if m]
    kinds = [re.sub(r"-?\d[\d.,]*", "#", m) for m in said]
    return said[kinds.index(Counter(kinds).most_common(1)[0][0])] if said else ""


def words_of(axis: Axis, value: Any) -> str:
    """A value as people write it; shares as per cent."""
    if isinstance(value, bool):
        return "wrong" if value else "right"
    if isinstance(value, str):
        return value
    if axis.field == "window_events" and value == 0:
        return "all"
    if axis.unit.startswith(("of all", "of the", "relative")):
        return f"{100 * value:.10g} %"
    return f"{value:,.10g}"


def title_of(axis: Axis) -> str:
    """Its name and unit."""
    return f"{axis.name} [{axis.unit}]" if axis.unit else axis.name


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _json(atlas: Atlas) -> str:
    """One line a spot."""
    data = {"format": "amiwarp-atlas", "version": 1, **atlas.about, "cells": atlas.cells, "aims": atlas.aims.to_json()}
    head = json.dumps(data, indent=1, allow_nan=False).removesuffix("\n}")
    lines = (json.dumps(s.to_json(), allow_nan=False, ensure_ascii=False) for s in atlas.spots)
    return head + ',\n "spots": [\n  ' + ",\n  ".join(lines) + "\n ]\n}\n"


def _csv(spots: Sequence[Spot]) -> str:
    """One line a spot."""

    def line(s: Spot) -> dict[str, Any]:
        out: dict[str, Any] = {"axis": s.axis.name, "field": s.axis.field, "value": s.value, "unit": s.axis.unit,
                               "method": s.method, "n": len(s.results)}  # fmt: skip
        for outcome in Outcome:
            rate, name = s.rate(outcome), outcome.name.lower()
            low, high = rate.interval
            out |= {name: rate.count, f"{name}_low": f"{low:.4f}", f"{name}_high": f"{high:.4f}"}
        out |= {f"error_px_{q}": f"{e:.4g}" for q, e in s.quantiles.items()}
        return out | {"limit_px": f"{s.limit_px:.4g}", "seconds": f"{s.seconds:.4g}",
                      "message": s.said(Outcome.REFUSAL, Outcome.SILENT)}  # fmt: skip

    lines = [line(s) for s in spots]
    names = dict.fromkeys(n for each in sorted(lines, key=len, reverse=True) for n in each)
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _markdown(atlas: Atlas) -> str:
    def told(spots: Sequence[Spot], outcome: Outcome) -> list[tuple[str, ...]]:
        return [(s.axis.name, words_of(s.axis, s.value), str(s.rate(outcome)), s.said(outcome) or "–") for s in spots]

    silent, refused = atlas.failing(Outcome.SILENT), atlas.failing(Outcome.REFUSAL)
    parts = [
        "# Atlas of failures",
        f"{atlas.cells:,} recordings, {len(atlas.axes)} axes, {len(atlas.methods)} methods; "
        + "; ".join(str(atlas.about[k]) for k in ("machine", "date") if k in atlas.about) + ".",
        "## Aims",
        "\n".join(f"- {line}" for line in atlas.aims.lines()),
        f"## Where each method works\n\nValues with at least {_percent(WORKS)} successes.",
        _grid(("axis", *atlas.methods), summary(atlas)),
        "## Where the default succeeds less often than the paper's method",
        _grid(("axis", "value", "default", "paper", "p"), [
            (w.axis.name, words_of(w.axis, w.value), str(w.default), str(w.paper), f"{w.p_value:.2g}")
            for w in atlas.aims.worse]),
        "## Silent failures of the default",
        _grid(("axis", "value", "silent failures", "said most often"), told(silent, Outcome.SILENT)),
        "## Refusals of the default",
        _grid(("axis", "value", "refusals", "said most often"), told(refused, Outcome.REFUSAL)),
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def summary(atlas: Atlas) -> list[tuple[str, ...]]:
    """Per axis: its name, and where each method works."""
    return [(title_of(axis), *(atlas.works(axis, m) for m in atlas.methods)) for axis in atlas.axes]


def _grid(headings: Sequence[str], rows: Sequence[tuple[str, ...]]) -> str:
    if not rows:
        return "None."
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def load(folder: Path) -> list[Stored]:
    """All cells in a folder; those of another version, which no run would take up, are left out.

    Raises :class:`AmiwarpError` for a folder without cells and for damaged ones.
    """
    store = Store(folder)
    out = [store.load(cell) for path in sorted(folder.glob("*.json")) if (cell := _cell(path)) is not None]
    if not out:
        raise AmiwarpError(f"{folder}: no cells of this version are here; run without --redraw first")
    return out


def _cell(path: Path) -> Cell | None:
    try:
        data = json.loads(path.read_text())
        cell = Cell(Condition(**data["condition"]), int(data["seed"]))
    except TypeError:
        return None  # fields that this version does not have
    except (OSError, ValueError, KeyError) as error:
        raise AmiwarpError(f"{path}: damaged cell: {error}; delete it to have it done again") from error
    return cell if cell.name == path.stem else None
