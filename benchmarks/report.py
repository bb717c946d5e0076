"""Tables of benchmarks/results/speed.md, made from the JSON files of the runs.

    python -m benchmarks.report [--check]

Replaces the text between the two marker comments of the page. ``--check`` changes nothing; its exit status is 1 if the
page and the files differ.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from benchmarks.cases import AIMS, IMAGE, MOVED, PREPARED, Aim

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "benchmarks" / "results" / "speed.md"
FILES = {kind: ROOT / "benchmarks" / "results" / f"speed_{kind}.json" for kind in ("cpu", "cuda")}
BEGIN, END = (
    "<!-- speed: from here on by python -m benchmarks.report -->",
    "<!-- speed: to here -->",
)
IMAGES = (IMAGE, PREPARED)
RATES = {IMAGE: "Mev/s", PREPARED: "Mvotes/s", MOVED: "Mev/s"}
"""Unit of the rate that tables show instead of the time, by task."""
ERRORS = {
    "model_px": "model error [px]",
    "decorrelation": "1 − correlation",
    "places_px": "worst place [px]",
}
ALSO = {"psnr_db": "PSNR [dB]", "peak_mib": "peak memory [MiB]"}
"""Titles of the columns with further results of complete tasks."""
SCALES = {"Gev/s": 1e9, "Mev/s": 1e6, "Gvotes/s": 1e9}

Row = dict[str, Any]
Results = dict[str, Any]


def table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield f"|{'---|' * len(head)}"
    for row in rows:
        yield f"| {' | '.join(row)} |"


def speed(value: float) -> str:
    """Return a number with three significant digits as text."""
    if value < 100:
        return f"{value:.3g}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.1f}"
    return f"{value:,.0f}"


def head(row: Row) -> list[str]:
    """Return the heading of the table to which the result belongs."""
    start = ["method", RATES.get(row["what"], "ms"), "quartiles"]
    if row["what"] in IMAGES:
        return [*start, "rms / worst pixel [events]", "misplaced", "px from exact"]
    return [
        *start,
        *(text for name, text in (ERRORS | ALSO).items() if name in row["errors"] | row["also"]),
    ]


def row_cells(row: Row) -> list[str]:
    """Return the table cells of a result: name, speed and its quartiles, then the errors."""
    if "skipped" in row:
        return [row["name"], row["skipped"]]
    low, high = row["quartiles_s"]
    errors = row["errors"]
    name = f"{row['name']} ({row['note']})" if row["note"] else row["name"]
    if row["what"] in RATES:
        rates = [speed(row["work"] / s / 1e6) for s in (row["median_s"], high, low)]
    else:
        rates = [speed(1e3 * s) for s in (row["median_s"], low, high)]
    start = [name, rates[0], f"{rates[1]} to {rates[2]}"]
    if row["what"] in IMAGES:
        return [
            *start, f"{errors['rms_events']:.2g} / {errors['max_events']:.2g}", f"{100 * errors['misplaced']:.2g} %",
            f"{errors['exact_px']:.2g}",
        ]  # fmt: skip
    values = errors | row["also"]
    return [*start, *(f"{values[name]:.3g}" for name in ERRORS | ALSO if name in values)]


def measured(rows: list[Row]) -> Iterator[str]:
    """Yield one table: the rows of one task on one scene."""
    done = [row for row in rows if "skipped" not in row]
    count = f"{done[0]['events']:,} events" if done else "skipped"
    what = rows[0]["what"]
    yield ""
    yield f"**{what[0].upper()}{what[1:]}, {rows[0]['scene']}: {count}**"
    yield ""
    titles = head(done[0]) if done else ["method", ""]
    yield from table(
        titles, [[*cells, *[""] * (len(titles) - len(cells))] for cells in map(row_cells, rows)]
    )


def section(results: Results) -> Iterator[str]:
    """Yield all tables of one machine's results."""
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    yield f"### {results['machine']}"
    yield ""
    yield f"Commit {results['commit']}, {results['date']}; {versions}; load average "
    yield f"{results['load'][0]} before, {results['load'][-1]} after; picture of the recording: {results['picture']}."
    aims = [cells for aim in AIMS if (cells := aim_cells(aim, results))]
    if aims:
        yield ""
        yield from table(["task", "target", "measured", "met"], aims)
    for _, rows in groupby(results["rows"], lambda row: (row["what"], row["scene"])):
        yield from measured(list(rows))
    yield ""


def value_of(aim: Aim, row: Row, compared_with: Row | None = None) -> float:
    """Return the result of a case in the target's unit.

    A comparison with another case is the median over pairs of consecutive passes.
    """
    if aim.unit == "MiB":
        return float(row["also"]["peak_mib"])
    if compared_with is None:
        return float(row["median_s"] if aim.unit == "s" else row["rate_per_s"] / SCALES[aim.unit])
    pairs = zip(row["seconds"], compared_with["seconds"], strict=False)
    if aim.unit == "x time":
        return statistics.median(a / b for a, b in pairs)
    return statistics.median(b / a for a, b in pairs) * row["work"] / compared_with["work"]


def aim_cells(aim: Aim, results: Results) -> list[str]:
    """Return one line of the table of targets.

    It is empty if the target is for another device, or a case was not run.
    """
    if results["device"].partition(":")[0] != aim.device:
        return []
    rows = {(row["scene"], row["name"]): row for row in results["rows"]}
    names = [name for name in (aim.of, aim.compared_with) if name]
    if not all((scene, name) in rows for scene in aim.bars for name in names):
        return []
    sides = {scene: [rows[scene, name] for name in names] for scene in aim.bars}
    most = aim.unit in ("s", "x time", "MiB")
    bars = list(aim.bars.values())
    target = " / ".join(f"{bar:g}" for bar in (bars if len(set(bars)) > 1 else bars[:1]))
    unit = aim.unit.replace("x ", "× ") if aim.unit != "x time" else "×"
    start = [aim.what, f"{'≤' if most else '≥'} {target} {unit}"]
    skipped = [row["skipped"] for pair in sides.values() for row in pair if "skipped" in row]
    if skipped:
        return [*start, f"skipped: {skipped[0]}", "–"]
    values = {scene: value_of(aim, *pair) for scene, pair in sides.items()}
    met = [
        value <= aim.bars[scene] if most else value >= aim.bars[scene]
        for scene, value in values.items()
    ]
    verdict = (
        "yes"
        if all(met)
        else "no"
        if not any(met)
        else " / ".join("yes" if m else "no" for m in met)
    )
    notes = {f" ({row['note']})" for pair in sides.values() for row in pair if row["note"]}
    return [*start, " / ".join(map(speed, values.values())) + "".join(sorted(notes)), verdict]


def page(text: str, results: list[Results]) -> str:
    """Return the page's text with new tables."""
    start = text.index(BEGIN) + len(BEGIN)
    end = text.index(END)
    lines = "\n".join(line for each in results for line in section(each))
    return f"{text[:start]}\n\n{lines}\n{text[end:]}"


def refreshed() -> str:
    """Return the text of the page with new tables from all files."""
    results = [json.loads(path.read_text()) for path in FILES.values() if path.exists()]
    return page(PAGE.read_text(), results)


def write_page() -> None:
    """Put new tables into the page."""
    PAGE.write_text(refreshed())


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    if not args.check:
        write_page()
        return 0
    same = PAGE.read_text() == refreshed()
    print(
        "page and files agree" if same else "page and files differ: run python -m benchmarks.report"
    )
    return int(not same)


if __name__ == "__main__":
    sys.exit(main())
