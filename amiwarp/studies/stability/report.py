"""Report of the stability study: rates along each axis, aims, a summary, tables and figures."""

import io
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.palette import BLACK, BLUE, PINK, SKY_BLUE
from amiwarp.io.files import NewFile, write_csv, write_text
from amiwarp.plotting.figures import blank, save
from amiwarp.studies.stability import cells as study
from amiwarp.studies.stability.cells import Axis, Cell, Condition, Method, Outcome, Result, Store, Stored, identity

# Points of the stability study: rates and errors of one method at one value of an axis, and their text.

JUDGED = (Outcome.SUCCESS, Outcome.REFUSAL, Outcome.SILENT)
"""Outcomes that say something of a method, of which the rates are."""
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
    """Results of the method for all seeds, except those where the study failed."""
    failed: int = 0
    """Number of recordings for which the study failed. They are part of no rate."""

    @property
    def errors(self) -> list[float]:
        """Model errors of all calibrations that were not refused [px rms]."""
        return [r.error_px for r in self.results if r.error_px is not None]

    @property
    def limit_px(self) -> float:
        """Median over the seeds of the largest model error that counts as a success [px rms]; NaN without results."""
        return _median([r.limit_px for r in self.results])

    @property
    def seconds(self) -> float:
        """Median time of a calibration [s]; NaN without results."""
        return _median([r.seconds for r in self.results])

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
            "method": self.method, **{o.name.lower(): self.rate(o).to_json() for o in JUDGED}, "failed": self.failed,
            "error_px": {f"{q} %": float(f"{e:.4g}") for q, e in self.quantiles.items()},
            "limit_px": _rounded(self.limit_px), "seconds": _rounded(self.seconds),
            "messages": {o.name.lower(): text for o in JUDGED if (text := self.common_message(o))},
        }  # fmt: skip


def _median(values: Sequence[float]) -> float:
    """Return the median of values; NaN if there are none."""
    return float(np.median(values)) if values else math.nan


def _rounded(value: float) -> float | None:
    """Return a value with four digits for JSON; None for NaN."""
    return None if math.isnan(value) else float(f"{value:.4g}")


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


STATED_HEADINGS = ("recordings", "quantity", "within 1", "within 2", "within 3 stated deviations")
"""Headings of :meth:`StatedDeviations.row`."""


@dataclass(frozen=True)
class StatedDeviations:
    """How often the truth lies within the standard deviations that the default method states."""

    where: str
    """Recordings that count: random combinations of mild troubles, or the sensible range of the axes."""
    quantity: str
    """Quantity, one of :data:`amiwarp.studies.stability.cells.STATED`."""
    within: tuple[Rate, ...]
    """Number of answers with the truth within one, two and three standard deviations."""

    def row(self) -> tuple[str, ...]:
        """Return the values as a row of a table."""
        return (self.where, self.quantity, *map(str, self.within))

    def to_json(self) -> dict[str, Any]:
        """Return the values as JSON data."""
        return {"where": self.where, "quantity": self.quantity, "within": [rate.to_json() for rate in self.within]}


def _stated(cells: Iterable[Stored], default: str | None) -> tuple[StatedDeviations, ...]:
    """Return how honest the stated deviations are: for random combinations of troubles, and for the sensible range."""
    found: dict[str, dict[str, list[float]]] = {}
    for stored in cells:
        result, cell = stored.results.get(default or ""), stored.cell
        drawn = cell.condition == study.mild(cell.seed)
        if result is None or not (drawn or study.sensible(cell.condition, stored.events)):
            continue
        of_where = found.setdefault("random combinations" if drawn else "sensible range", {})
        for name, value in result.deviations.items():
            of_where.setdefault(name, []).append(value)
    return tuple(
        StatedDeviations(where, name, tuple(Rate(sum(v <= k for v in values), len(values)) for k in (1.0, 2.0, 3.0)))
        for where, of_where in sorted(found.items())
        for name, values in of_where.items()
    )


@dataclass(frozen=True)
class Failure:
    """Recording of the study for which a method has no result, because the study failed."""

    name: str
    """Name of the cell."""
    where: str
    """Values of the axes that the recording belongs to, in words."""
    methods: tuple[str, ...]
    """Names of the methods without result."""
    message: str
    """Error, and where it was raised."""

    def row(self) -> tuple[str, ...]:
        """Return the values as a row of a table."""
        return (self.name, self.where, ", ".join(self.methods), self.message)


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
    stated: tuple[StatedDeviations, ...] = ()
    """How often the truth lies within the stated standard deviations."""
    failures: tuple[Failure, ...] = ()
    """What failed in the study, recording by recording."""

    @property
    def measured(self) -> bool:
        """Whether there is any result."""
        return any(s.results for s in self.spots)

    @property
    def failed_cells(self) -> int:
        """Number of cells (single recordings) that lack the result of a method because the study failed."""
        return len({failure.name for failure in self.failures})

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
        """Return the values at which a method works, as text; runs of neighbours are written as from ... to.

        "measured" is added to "everywhere" and "nowhere" if not all values of the axis are measured.
        """
        spots = self.of(axis)
        unknown = {value for (name, value), spot in spots.items() if name == method and not spot.results}
        values = [v for v in axis.values if v not in unknown and any(value == v for _, value in spots)]
        if not values:
            return "not measured"
        good = [(s := spots.get((method, v))) is not None and s.rate(Outcome.SUCCESS).share >= WORKS for v in values]
        if all(good) or not any(good):
            where = "everywhere" if all(good) else "nowhere"
            return where if len(values) == len(axis.values) else f"{where} measured"
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
        _write_csv(files["table"], self.spots)
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
                if results := [s.results[key] for s in stored_cells if key in s.results]:
                    judged = tuple(r for r in results if r.outcome in JUDGED)
                    spots.append(AxisPoint(axis, value, name, judged, len(results) - len(judged)))
            worse += _worse(axis, value, stored_cells, names)
    if not spots:
        raise AmiwarpError(
            "found no results of single runs (cells) for these axes and methods; run without --redraw first"
        )
    default = names.get(DEFAULT)
    drawn = {s.cell: s for s in cells if s.cell.condition == study.mild(s.cell.seed)}
    return Atlas(
        tuple(spots), _aims(met.values(), default, worse), len(met), about, _stated(cells, default),
        _failures((met | drawn).values(), axes, names),
    )  # fmt: skip


def _failures(cells: Iterable[Stored], axes: Sequence[Axis], names: dict[str, str]) -> tuple[Failure, ...]:
    """Return what failed, recording by recording; methods that failed for the same reason are listed together."""
    places: dict[Condition, list[str]] = {}
    for axis in axes:
        for value, condition in zip(axis.values, axis.conditions(), strict=True):
            places.setdefault(condition, []).append(f"{axis.name} {value_label(axis, value)}")
    found = []
    for stored in cells:
        where = ", ".join(places.get(stored.cell.condition, ["random combination"]))
        methods: dict[str, list[str]] = {}
        for name, key in names.items():
            result = stored.results.get(key)
            if result is not None and result.outcome is Outcome.FAILED:
                methods.setdefault(result.message, []).append(name)
        found += [Failure(stored.cell.name, where, tuple(each), message) for message, each in methods.items()]
    return tuple(found)


def _aims(cells: Iterable[Stored], default: str | None, worse: Sequence[WorseThanPaper]) -> Aims:
    """Return the aims for the default method with the measured rates."""
    inside: list[Outcome] = []
    outside: list[Outcome] = []
    for stored in cells:
        result = stored.results.get(default or "")
        if result is not None and result.outcome in JUDGED:
            here = inside if study.sensible(stored.cell.condition, stored.events) else outside
            here.append(result.outcome)
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
    outcomes = [[s.results[names[n]].outcome for n in (DEFAULT, PAPER)]
                for s in stored_cells if names[DEFAULT] in s.results and names[PAPER] in s.results]  # fmt: skip
    both = [[outcome is Outcome.SUCCESS for outcome in pair] for pair in outcomes if Outcome.FAILED not in pair]
    lost, won = sum(p and not d for d, p in both), sum(d and not p for d, p in both)
    if lost <= won:
        return []
    default, paper = (Rate(sum(column), len(both)) for column in zip(*both, strict=True))
    p_value = float(binomtest(lost, lost + won, 0.5, alternative="greater").pvalue)
    return [WorseThanPaper(axis, value, default, paper, p_value)]


def _json(atlas: Atlas) -> str:
    """Return the study's results as JSON, one line per point."""
    data = {"format": "amiwarp-atlas", "version": 1, **atlas.about, "cells": atlas.cells, "aims": atlas.aims.to_json(),
            "stated_deviations": [d.to_json() for d in atlas.stated],
            "failures": [asdict(f) for f in atlas.failures]}  # fmt: skip
    head = json.dumps(data, indent=1, allow_nan=False).removesuffix("\n}")
    lines = (json.dumps(s.to_json(), allow_nan=False, ensure_ascii=False) for s in atlas.spots)
    return head + ',\n "spots": [\n  ' + ",\n  ".join(lines) + "\n ]\n}\n"


def _write_csv(path: Path, spots: Sequence[AxisPoint]) -> None:
    """Write the points of the study as CSV, one line per point."""

    def line(s: AxisPoint) -> dict[str, Any]:
        out: dict[str, Any] = {"axis": s.axis.name, "field": s.axis.field, "value": s.value, "unit": s.axis.unit,
                               "method": s.method, "n": len(s.results), "failed": s.failed}  # fmt: skip
        for outcome in JUDGED:
            rate, name = s.rate(outcome), outcome.name.lower()
            low, high = rate.interval
            out |= {name: rate.count, f"{name}_low": f"{low:.4f}", f"{name}_high": f"{high:.4f}"}
        out |= {f"error_px_{q}": f"{e:.4g}" for q, e in s.quantiles.items()}
        medians = {"limit_px": s.limit_px, "seconds": s.seconds}
        out |= {name: "" if math.isnan(value) else f"{value:.4g}" for name, value in medians.items()}
        return out | {"message": s.common_message(Outcome.REFUSAL, Outcome.SILENT)}

    lines = [line(s) for s in spots]
    names = dict.fromkeys(n for each in sorted(lines, key=len, reverse=True) for n in each)
    write_csv(path, names, ([each.get(name, "") for name in names] for each in lines))


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
        f"{atlas.cells:,} recordings, {atlas.failed_cells:,} failed in the study itself, "
        f"{len(atlas.axes)} axes, {len(atlas.methods)} methods; "
        + "; ".join(str(atlas.about[k]) for k in ("machine", "date") if k in atlas.about) + ".",
        "## Aims",
        "\n".join(f"- {line}" for line in atlas.aims.lines()),
        "## Truth within the stated standard deviations",
        _grid(STATED_HEADINGS, [d.row() for d in atlas.stated]),
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
        "## Recordings that failed in the study itself\n\nThey are part of no rate. The same command tries them again.",
        _grid(("cell", "values", "methods", "error"), [f.row() for f in atlas.failures]),
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


# Figures of the stability study: a page per axis, all pages as one PDF, and an overview of every axis on one sheet.

COLOURS = {Outcome.SUCCESS: SKY_BLUE, Outcome.REFUSAL: "#d0d0d0", Outcome.SILENT: "#e6702e"}
"""Colour of each outcome: distinguishable with colour vision deficiency, and light enough for black text."""
MARKS = {DEFAULT: ("o", BLACK, -0.17), PAPER: ("D", PINK, 0.17)}
"""Marker, colour and horizontal offset of the errors of each method."""
LEAST_PX = 1e-4
"""Smallest error that is drawn [px]; smaller errors are drawn at this value."""
OVERVIEW = (DEFAULT, PAPER, "sharpness")
"""Names of the methods that the overview shows."""
WIDTH, LEFT, RIGHT, TOP = 11.0, 1.45, 0.25, 1.05
"""Width of a page, and its margins left, right and top [inch]."""
ROW, ERRORS, BETWEEN, BOTTOM = 0.52, 2.7, 0.32, 0.85
"""Heights of a method's row, of the error panel, of the gap between them, and of the bottom margin [inch]."""
SHEET, COLUMNS, STRIP, HEAD, HEADLINE = 12.4, 2, 0.23, 0.58, 0.66
"""Sizes of the overview [inch]: width, number of columns, heights of a method's strip, of an axis heading and of the
sheet's heading."""
LARGE, NORMAL, SMALL = 14.0, 11.0, 9.0
"""Font sizes of the figures [point]; bold digits below 9 points are illegible."""


def draw(atlas: Atlas, folder: Path) -> dict[str, Path]:
    """Write overview.png, a PNG for each axis and atlas.pdf into ``folder``; each write is atomic."""
    pages = [_page(atlas, axis) for axis in atlas.axes]
    sheet = _overview(atlas)
    files = {"overview": folder / "overview.png", "pages": folder / "atlas.pdf"}
    save(sheet, files["overview"])
    for axis, page in zip(atlas.axes, pages, strict=True):
        files[axis.name] = folder / f"axis_{re.sub('[^a-z0-9]+', '_', axis.name.lower())}.png"
        save(page, files[axis.name])
    _save_pdf([sheet, *pages], files["pages"])
    return files


def _save_pdf(figures: Sequence[Any], path: Path) -> None:
    """Write figures as the pages of a PDF."""
    from matplotlib.backends.backend_pdf import PdfPages

    buffer = io.BytesIO()
    with PdfPages(buffer, metadata={"CreationDate": None}) as pages:
        for figure in figures:
            pages.savefig(figure)
    with NewFile(path) as new:
        new.part.write_bytes(buffer.getvalue())


def _page(atlas: Atlas, axis: Axis) -> Any:
    """Draw the page of an axis: outcomes of every method above, errors of the default and the paper's method below."""
    spots = atlas.of(axis)
    values = _values(axis, spots)
    rows = ROW * len(atlas.methods)
    height = TOP + rows + BETWEEN + ERRORS + BOTTOM
    figure = blank((WIDTH, height), dpi=130)
    wide = (WIDTH - LEFT - RIGHT) / WIDTH
    heat = figure.add_axes((LEFT / WIDTH, 1.0 - (TOP + rows) / height, wide, rows / height))
    errors = figure.add_axes((LEFT / WIDTH, BOTTOM / height, wide, ERRORS / height))
    _shares(heat, spots, values, atlas.methods)
    middle = {"ha": "center", "va": "center"}
    for (method, value), spot in spots.items():
        x, y = values.index(value), atlas.methods.index(method)
        heat.text(
            x,
            y - 0.13,
            f"{_share(spot)} %" if spot.results else _share(spot),
            fontsize=NORMAL,
            fontweight="bold",
            **middle,
        )
        heat.text(x, y + 0.27, _count(spot), fontsize=SMALL, **middle)
    _heat_grid(heat, len(values), atlas.methods, NORMAL)
    heat.tick_params(axis="x", labelbottom=False)
    _errors(errors, spots, values)
    errors.set_xticks(range(len(values)), [_broken(value_label(axis, v)) for v in values], fontsize=NORMAL)
    errors.set_xlabel(axis_label(axis), fontsize=NORMAL)
    figure.text(LEFT / WIDTH, 1.0 - 0.3 / height, axis_label(axis), fontsize=LARGE, va="center")
    _legend(figure, WIDTH, height, 0.72)
    return figure


def _overview(atlas: Atlas) -> Any:
    """Draw the overview: a block for each axis (varied quantity), with one strip per method.

    The blocks fill the columns of the sheet from top to bottom.
    """
    methods = [m for m in OVERVIEW if m in atlas.methods] or atlas.methods[:1]
    block = HEAD + STRIP * len(methods)
    deep = -(-len(atlas.axes) // COLUMNS)
    height = HEADLINE + deep * block + 0.15
    figure = blank((SHEET, height), dpi=130)
    left, between = 0.85, 0.25
    wide = (SHEET - between) / COLUMNS - left
    for k, axis in enumerate(atlas.axes):
        x = (k // deep) * (left + wide + between) + left
        top = HEADLINE + (k % deep) * block + HEAD
        strips = STRIP * len(methods)
        ax = figure.add_axes((x / SHEET, 1.0 - (top + strips) / height, wide / SHEET, strips / height))
        _strips(ax, axis, atlas.of(axis), methods)
        figure.text(x / SHEET, 1.0 - (top - 0.32) / height, axis_label(axis), fontsize=NORMAL, fontweight="bold",
                    va="center")  # fmt: skip
    figure.text(left / SHEET, 1.0 - 0.22 / height, _headline(atlas), fontsize=LARGE, va="center")
    lost = any(not spot.results for spot in atlas.spots)
    text = "numbers: successes [%]; –: failed in the study" if lost else "numbers: successes [%]"
    _legend(figure, SHEET, height, 0.52, left=left, text=text)
    return figure


def _headline(atlas: Atlas) -> str:
    """Return the title of the overview."""
    most = max(len(s.results) for s in atlas.spots)
    title = f"Where calibration works: {atlas.cells:,} simulated recordings, up to {most} for each value"
    return f"{title}; {atlas.failed_cells:,} failed" if atlas.failed_cells else title


def _strips(ax: Any, axis: Axis, spots: dict[tuple[str, Any], AxisPoint], methods: Sequence[str]) -> None:
    """Draw the overview's block of one axis: a strip per method."""
    values = _values(axis, spots)
    _shares(ax, spots, values, methods)
    for (method, value), spot in spots.items():
        if method in methods:
            ax.text(values.index(value), methods.index(method) + 0.03, _share(spot), fontsize=SMALL,
                    fontweight="bold", ha="center", va="center")  # fmt: skip
    _heat_grid(ax, len(values), methods, SMALL)
    ax.xaxis.tick_top()
    ax.tick_params(axis="x", length=0, pad=1.0)
    names = [value_label(axis, v) for v in values]
    room = 72.0 * ax.get_position().width * SHEET / len(names)
    size = min(SMALL, *(room / (0.6 * len(name)) for name in names))
    ax.set_xticks(range(len(values)), names, fontsize=size)


def _values(axis: Axis, spots: dict[tuple[str, Any], AxisPoint]) -> list[Any]:
    """Return the values of an axis for which there are results."""
    there = [value for _, value in spots]
    return [v for v in axis.values if v in there]


def _shares(ax: Any, spots: dict[tuple[str, Any], AxisPoint], values: Sequence[Any], methods: Sequence[str]) -> None:
    """Draw the cells of the heat map; each cell is divided by the shares of the outcomes."""
    from matplotlib.collections import PolyCollection

    parts: dict[str, list[list[tuple[float, float]]]] = {colour: [] for colour in COLOURS.values()}
    for k, method in enumerate(methods):
        for column, value in enumerate(values):
            spot = spots.get((method, value))
            if spot is not None and spot.results:
                edges = np.cumsum([0.0, *(spot.rate(o).share for o in COLOURS)]) + column - 0.5
                for part, (x0, x1) in zip(parts.values(), pairwise(edges), strict=True):
                    part.append([(x0, k - 0.5), (x1, k - 0.5), (x1, k + 0.5), (x0, k + 0.5)])
    for colour, part in parts.items():
        ax.add_collection(PolyCollection(part, facecolors=colour, linewidths=0))


def _share(spot: AxisPoint) -> str:
    """Return the share of successful calibrations in per cent, as text; a dash if the study failed for all."""
    return f"{100 * spot.rate(Outcome.SUCCESS).share:.0f}" if spot.results else "–"


def _count(spot: AxisPoint) -> str:
    """Return the number of successes, the total, and the median time, as text, or how many failed in the study."""
    if not spot.results:
        return f"{spot.failed} failed"
    success = spot.rate(Outcome.SUCCESS)
    if spot.failed:
        return f"{success.count}/{success.total}, {spot.failed} failed"
    return f"{success.count}/{success.total}, {spot.seconds:.2g} s"


def _heat_grid(ax: Any, columns: int, methods: Sequence[str], size: float) -> None:
    """Draw the grid lines and method names of a heat map."""
    ax.set(xlim=(-0.5, columns - 0.5), ylim=(len(methods) - 0.5, -0.5))
    ax.set_yticks(range(len(methods)), methods, fontsize=size)
    ax.tick_params(axis="both", length=0)
    ax.vlines(np.arange(columns + 1) - 0.5, -0.5, len(methods) - 0.5, color="white", linewidth=3.0)
    ax.hlines(np.arange(len(methods) + 1) - 0.5, -0.5, columns - 0.5, color="white", linewidth=1.5)
    for side in ax.spines.values():
        side.set_visible(False)


def _errors(ax: Any, spots: dict[tuple[str, Any], AxisPoint], values: Sequence[Any]) -> None:
    """Draw all errors as markers, their median as a line, and the limit of a success as a dashed line."""
    ax.set_yscale("log")
    shown = [e for (method, _), spot in spots.items() if method in MARKS for e in spot.errors]
    low, high = max(min(shown, default=study.LIMIT_PX), LEAST_PX), max(shown, default=study.LIMIT_PX)
    ax.set(
        xlim=(-0.5, len(values) - 0.5),
        ylim=(min(low / 1.5, study.LIMIT_PX / 3.0), max(high * 1.5, study.LIMIT_PX * 3.0)),
    )
    for method, (mark, colour, aside) in MARKS.items():
        for column, value in enumerate(values):
            spot = spots.get((method, value))
            if spot is None or not spot.errors:
                continue
            x, errors = column + aside, np.maximum(np.sort(spot.errors), LEAST_PX)
            spread = 0.11 * np.sin(2.4 * np.arange(len(errors))) if len(errors) > 1 else np.zeros(1)
            ax.plot(x + spread, errors, mark, color=colour, markersize=4.0, alpha=0.55, markeredgewidth=0)
            ax.hlines(np.median(errors), x - 0.15, x + 0.15, color=colour, linewidth=2.0)
            if spot.limit_px > study.LIMIT_PX:
                ax.hlines(spot.limit_px, x - 0.16, x + 0.16, color=colour, linewidth=1.2, linestyle=(0, (2, 1.5)))
    ax.axhline(study.LIMIT_PX, color=BLUE, linewidth=1.2, linestyle="--", zorder=1)
    ax.set_ylabel("model error [px rms]", fontsize=NORMAL)
    ax.grid(True, axis="y", color="#e4e4e4")
    ax.set_axisbelow(True)
    ax.yaxis.set_major_formatter(lambda y, _: f"{y:g}")
    ax.tick_params(axis="y", labelsize=NORMAL)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    _key(ax)


def _key(ax: Any) -> None:
    """Draw the legend of the errors."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], marker=mark, color=colour, markersize=5, linewidth=2.0, label=f"{name}, median")
        for name, (mark, colour, _) in MARKS.items()
    ]
    handles.append(Line2D([], [], color=BLUE, linestyle="--", linewidth=1.2, label=f"{study.LIMIT_PX} px"))
    handles.append(Line2D([], [], color=BLACK, linestyle=(0, (2, 1.5)), linewidth=1.2,
                          label="limit of a success if the model itself has a larger error"))  # fmt: skip
    ax.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, frameon=False, fontsize=SMALL,
              borderpad=0.0, borderaxespad=0.1, columnspacing=1.5)  # fmt: skip


def _legend(figure: Any, width: float, height: float, down: float, *, left: float = LEFT, text: str = "") -> None:
    """Draw the legend of the outcomes."""
    from matplotlib.patches import Patch

    handles = [Patch(color=colour, label=outcome.value) for outcome, colour in COLOURS.items()]
    label = text or "share of successes; number of successes and recordings, median time of a calibration"
    handles.append(Patch(color="none", label=label))
    figure.legend(handles=handles, loc="center left", ncols=4, frameon=False, fontsize=NORMAL, borderpad=0.0,
                  borderaxespad=0.0, bbox_to_anchor=(left / width, 1.0 - down / height), columnspacing=1.5,
                  handletextpad=0.5)  # fmt: skip


def _broken(text: str) -> str:
    """Return a long text broken into two lines."""
    words = text.split()
    half = (len(words) + 1) // 2
    return "\n".join([" ".join(words[:half]), " ".join(words[half:])]) if len(text) > 12 else text
