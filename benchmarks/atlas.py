"""Compute cells of the stability atlas with a pool of processes, on a machine with Python and a GPU but without Dask.

    python -m benchmarks.atlas --out FOLDER [--device cuda:0] [--seeds 20] [--draws 300] [--limit-s 500] [--quick]
        [--axes NAME …] [--methods NAME …]

``--draws`` adds random combinations of mild troubles. They are run first, then all conditions with one seed after the
other. Writes FOLDER/cells.tar. Unpack it into the folder of ``amiwarp stability --out``, which then draws the atlas and
computes missing cells. Cells of an earlier run in FOLDER/cells are reused.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tarfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from amiwarp.studies.cluster import Workers
from amiwarp.studies.stability.cells import (
    AXES,
    METHODS,
    QUICK_METHODS,
    Cell,
    Condition,
    Store,
    cells_of,
    quick_axes,
    run,
    run_cell,
)

_started = multiprocessing.get_context("spawn").Value("i", 0)


def pin(counter: object) -> None:
    """Pin each process to its own core, because work is spread over processes, not threads."""
    with counter.get_lock():  # type: ignore[attr-defined]
        number = counter.value  # type: ignore[attr-defined]
        counter.value += 1  # type: ignore[attr-defined]
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number % len(cores)]})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--limit-s", type=float, default=500.0)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--draws", type=int, default=0)
    parser.add_argument("--axes", nargs="+", choices=[a.name for a in AXES])
    parser.add_argument("--methods", nargs="+", choices=[m.name for m in METHODS])
    args = parser.parse_args()
    axes = [a for a in (quick_axes() if args.quick else AXES) if not args.axes or a.name in args.axes]
    names = args.methods or (QUICK_METHODS if args.quick else [m.name for m in METHODS])
    methods = [m for m in METHODS if m.name in names]
    cells = args.out / "cells"
    cells.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    said = 0

    def show_progress(what: str, share: float) -> None:
        nonlocal said
        if int(20 * share) > said:
            said = int(20 * share)
            print(f"{time.perf_counter() - began:6.0f} s  {what}", flush=True)

    start = {"initializer": pin, "initargs": (_started,), "mp_context": multiprocessing.get_context("spawn")}
    with ProcessPoolExecutor(1, **start) as one:  # one process compiles the kernels for all
        one.submit(run_cell, Cell(Condition(), 0), methods, args.device).result()
    print(f"{time.perf_counter() - began:6.0f} s  compiled", flush=True)
    with ProcessPoolExecutor(args.workers, **start) as pool:
        workers = Workers(pool, lambda: args.workers)
        wanted = cells_of(axes, args.seeds, draws=args.draws)
        run(wanted, methods, Store(cells), workers, device=args.device, progress=show_progress,
            until=lambda: time.perf_counter() - began > args.limit_s)  # fmt: skip
        with tarfile.open(args.out / "cells.tar", "w") as tar:  # before the pool waits for cells that have begun
            tar.add(cells, arcname="cells")
    print(f"{time.perf_counter() - began:6.0f} s  {len(list(cells.glob('*.json')))} cells in {args.out / 'cells.tar'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
