"""Compute cells of the stability atlas with a pool of processes, on a machine with Python and a GPU but without Dask.

    python -m benchmarks.atlas --out FOLDER [--device cuda:0] [--seeds 20] [--draws 300] [--limit-s 500] [--quick]
        [--workers N] [--axes NAME …] [--methods NAME …]
    python -m benchmarks.atlas --optics --out FOLDER [--device cuda:0] [--seeds 5] [--draws 300] [--limit-s 500]
        [--workers N] [--axes NAME …]
    python -m benchmarks.atlas --map --out FOLDER
    python -m benchmarks.atlas --again OUTCOME --out FOLDER [--device cpu] [--limit-s 500] [--axes NAME …]

``--draws`` adds random combinations of mild troubles. They are run first, then all conditions with one seed after the
other. Writes FOLDER/cells.tar. Unpack it into the folder of ``amiwarp stability --out``, which then draws the atlas and
computes missing cells. Cells of an earlier run in FOLDER/cells are reused.

``--optics`` runs the axes of every optic, by the default method, and random combinations of their troubles. An answer
counts if its error is at most 0.02 px rms over the image and the recording; beyond it, it is ``named`` if a warning
names the cause, or the calibration states that the cause could hide by as much, else ``silent``. ``--map`` makes
atlas_optics.json, atlas_optics.csv and optic_map.json of the cells.

``--again`` runs the rows of FOLDER/atlas_optics.json with an outcome again, such as ``"silent failure"``, all or those
on some axes, and rewrites the three files: these rows then state their own machine and date.
"""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
import os
import sys
import tarfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.studies.cluster import Workers
from amiwarp.studies.machine import machine, versions
from amiwarp.studies.stability.axes import AXES, OPTIC_AXES, quick_axes
from amiwarp.studies.stability.cells import Store, Stored, cells_of, identity, run, run_cell
from amiwarp.studies.stability.condition import Cell, Condition, sensible
from amiwarp.studies.stability.judging import (
    METHODS,
    OPTIC_LIMIT_PX,
    QUICK_METHODS,
    Method,
    Outcome,
    Result,
)
from amiwarp.studies.stability.mild_troubles import mild, mild_optic
from amiwarp.studies.stability.optic_map import default_result, make_map, summary_of
from amiwarp.studies.stability.optics import OPTICS

_started = multiprocessing.get_context("spawn").Value("i", 0)


def pin(counter: object) -> None:
    """Pin each process to its own core, because work is spread over processes, not threads."""
    with counter.get_lock():  # type: ignore[attr-defined]
        number = counter.value  # type: ignore[attr-defined]
        counter.value += 1  # type: ignore[attr-defined]
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number % len(cores)]})


def write_map(folder: Path) -> int:
    """Write the results of every optic as a summary, as rows, and as the map that comes with the package."""
    stored = [known for known in Store(folder / "cells").load_all() if known.cell.condition.optic]
    machines = sorted({r.machine for known in stored for r in known.results.values() if r.machine})
    about = {
        "machine": ", ".join(machines),
        "date": time.strftime("%Y-%m-%d"),
        "versions": versions(()),
    }
    rows = [row for known in stored if (row := row_of(known)) is not None]
    if not rows:
        raise SystemExit(f"{folder / 'cells'}: no cells with an optic; run --optics first")
    rows.sort(key=lambda row: (row["optic"], row["kind"], json.dumps(row["troubles"]), row["seed"]))
    write_rows(folder, about, rows, len(stored) - len(rows))
    return 0


def write_rows(
    folder: Path, about: dict[str, object], rows: list[dict[str, Any]], failed: int
) -> None:
    """Write rows as JSON with a summary, as CSV and as a map. ``failed``: number of cells that the study lacks."""
    stored = [stored_of(row) for row in rows]
    optic_map = folder / "optic_map.json"
    optic_map.unlink(missing_ok=True)
    make_map(stored, about).save(optic_map)
    answered = [row for row in rows if row["error_px"] is not None and row["stated_px"]]
    error = np.array([row["error_px"] for row in answered])
    stated = np.array([row["stated_px"] for row in answered])
    summary = {
        "outcomes": summary_of(stored),
        "failed": failed,
        "within_1_2_3_stated_deviations": [
            float(np.mean(error <= k * stated)) for k in (1, 2, 3) if answered
        ],
    }
    print(json.dumps(summary, indent=1))
    head = json.dumps(
        {"protocol": __doc__, **about, "summary": summary}, indent=1, ensure_ascii=False
    )
    lines = ",\n  ".join(json.dumps(row, ensure_ascii=False) for row in rows)
    text = head.removesuffix("\n}") + f',\n "rows": [\n  {lines}\n ]\n}}\n'
    (folder / "atlas_optics.json").write_text(text, encoding="utf-8")
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with (folder / "atlas_optics.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, fieldnames=columns, restval="")
        table.writeheader()
        table.writerows({**row, "troubles": json.dumps(row["troubles"])} for row in rows)


def run_again(folder: Path, outcome: str, axes: Sequence[str], device: str, limit_s: float) -> int:
    """Run the rows with an outcome again, all or those on some axes, and write all files again."""
    path = folder / "atlas_optics.json"
    data = json.loads(path.read_text(encoding="utf-8"))
    rows: list[dict[str, Any]] = data["rows"]
    about = {name: data[name] for name in ("machine", "date", "versions")}
    on_axes = {c for axis in OPTIC_AXES if axis.name in axes for c in axis.conditions()}
    began = time.perf_counter()
    for place, row in enumerate(rows):
        cell = cell_of(row)
        if row["outcome"] != outcome or (axes and cell.condition not in on_axes):
            continue
        if time.perf_counter() - began > limit_s:
            break
        again = row_of(run_cell(cell, default_method(), device))
        if again is None:
            print(f"{cell.name}: the study failed; its row stays", flush=True)
            continue
        rows[place] = again | {"machine": machine(device), "date": time.strftime("%Y-%m-%d")}
        print(f"{cell.name}: {outcome} -> {again['outcome']}", flush=True)
    write_rows(folder, about, rows, data["summary"]["failed"])
    return 0


def default_method() -> tuple[Method, ...]:
    """Return the default method, the only one for conditions with an optic."""
    return tuple(method for method in METHODS if method.name == "default")


def cell_of(row: dict[str, Any]) -> Cell:
    """Return the cell of a row. Inverse of :func:`row_of`, with :func:`stored_of`."""
    return Cell(Condition(optic=row["optic"], **row["troubles"]), row["seed"])


def stored_of(row: dict[str, Any]) -> Stored:
    """Return the cell of a row with its result."""
    result = Result(
        Outcome(row["outcome"]),
        row["error_px"],
        OPTIC_LIMIT_PX,
        row["seconds"],
        row["said"],
        stated_px=row["stated_px"],
    )
    results = {identity(method): result for method in default_method()}
    return Stored(cell_of(row), row["events"], results)


def row_of(known: Stored) -> dict[str, Any] | None:
    """Return the row of a cell with an optic; None if the study failed there."""
    result, c = default_result(known), known.cell.condition
    if result is None:
        return None
    default = Condition()
    changed = {n: x for n, x in asdict(c).items() if x != getattr(default, n) and n != "optic"}
    return {
        "optic": c.optic,
        "kind": "combination" if c == mild_optic(known.cell.seed) else "axis",
        "troubles": changed,
        "seed": known.cell.seed,
        "events": known.events,
        "sensible": sensible(c, known.events),
        "outcome": result.outcome.value,
        "error_px": result.error_px,
        "stated_px": result.stated_px,
        "seconds": round(result.seconds, 2),
        "said": result.message,
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--limit-s", type=float, default=500.0)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--draws", type=int, default=0)
    parser.add_argument("--optics", action="store_true")
    parser.add_argument("--map", action="store_true")
    parser.add_argument("--again", choices=[outcome.value for outcome in Outcome])
    parser.add_argument("--axes", nargs="+", choices=[a.name for a in (*AXES, *OPTIC_AXES)])
    parser.add_argument("--methods", nargs="+", choices=[m.name for m in METHODS])
    args = parser.parse_args()
    if args.map:
        return write_map(args.out)
    if args.again:
        return run_again(args.out, args.again, args.axes or (), args.device, args.limit_s)
    known = quick_axes() if args.quick else AXES
    names = args.methods or (QUICK_METHODS if args.quick else [m.name for m in METHODS])
    first = [Cell(Condition(), 0)]
    if args.optics:
        known, names = OPTIC_AXES, ["default"]
    axes = [a for a in known if not args.axes or a.name in args.axes]
    if args.optics:
        there = {c.optic for a in axes for c in a.conditions()}
        first = [Cell(Condition(optic=optic), 0) for optic in OPTICS if optic in there]
    methods = tuple(m for m in METHODS if m.name in names)
    cells = args.out / "cells"
    cells.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    said = 0

    def show_progress(what: str, share: float) -> None:
        nonlocal said
        if int(20 * share) > said:
            said = int(20 * share)
            print(f"{time.perf_counter() - began:6.0f} s  {what}", flush=True)

    start = {
        "initializer": pin,
        "initargs": (_started,),
        "mp_context": multiprocessing.get_context("spawn"),
    }
    with ProcessPoolExecutor(
        len(first), **start
    ) as few:  # one process for each optic compiles the kernels for all
        for done in [few.submit(run_cell, cell, methods, args.device) for cell in first]:
            done.result()
    print(f"{time.perf_counter() - began:6.0f} s  compiled", flush=True)
    with ProcessPoolExecutor(args.workers, **start) as pool:
        workers = Workers(pool, lambda: args.workers)
        wanted = cells_of(
            axes, args.seeds, draws=args.draws, combination=mild_optic if args.optics else mild
        )
        run(wanted, methods, Store(cells), workers, device=args.device, progress=show_progress,
            until=lambda: time.perf_counter() - began > args.limit_s)  # fmt: skip
        with tarfile.open(
            args.out / "cells.tar", "w"
        ) as tar:  # before the pool waits for cells that have begun
            tar.add(cells, arcname="cells")
    print(
        f"{time.perf_counter() - began:6.0f} s  {len(list(cells.glob('*.json')))} cells in {args.out / 'cells.tar'}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
