"""``amiwarp stability``: limits and failures of the calibration, on simulated recordings with ground truth."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import say
from amiwarp.cli.console import choose_device, made_again, progress, report, table
from amiwarp.cli.options import OUTPUT_FOLDER, Common
from amiwarp.cpu_threads import cpu_threads
from amiwarp.errors import AmiwarpError
from amiwarp.io.files import own_folder
from amiwarp.io.formats import make_folder
from amiwarp.studies.cluster import start_workers, versions

if TYPE_CHECKING:
    from amiwarp.studies.stability import Atlas, Axis, Method, Store, Stored

EXAMPLE = "amiwarp stability --quick --out amiwarp-atlas"
SEEDS, QUICK_SEEDS = 20, 1
"""Number of recordings per value of an axis, by default and with ``--quick``."""
QUICK_MINUTES = 9.0
"""Time limit of a run with ``--quick`` [min]."""


def run(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for the results of single runs (cells), figures and tables."), OUTPUT_FOLDER
    ] = Path("amiwarp-atlas"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Use three values per axis, three methods and one seed: within ten minutes.")
    ] = False,
    axes: Annotated[
        list[str] | None, typer.Option(help="Axis to vary. Can be repeated. Default: all axes.", metavar="NAME")
    ] = None,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            help="Method to run in addition to 'default' and 'paper'. Can be repeated. "
            "Default: all methods; with --quick, only 'sharpness'.",
            metavar="NAME",
        ),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help=f"Recordings per value. Default: {SEEDS}, with --quick {QUICK_SEEDS}.")
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Time limit (min). The same command continues later. "
            f"Default: none, with --quick {QUICK_MINUTES:.0f}.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler. Default: one local process per core.")
    ] = None,
    redraw: Annotated[
        bool, typer.Option("--redraw", help="Only draw figures and tables from the existing cells; run nothing.")
    ] = False,
    common: Common,
) -> None:
    """Calibrate simulated recordings under growing disturbances, and draw where calibration works and fails.

    Each axis varies one disturbance, such as noise. A cell holds one recording and the results of all methods on it.
    Finished cells are saved in OUT/cells: the same command continues a stopped run and skips finished cells.
    """
    device = choose_device(common.device)
    from amiwarp.studies.stability import Store, aggregate, draw, identity, load

    chosen_axes, chosen_methods = _axes(axes or (), quick), _methods(methods or (), quick)
    cells_in = out / "cells"
    make_folder(cells_in)
    earlier = any(cells_in.iterdir())  # existing figures were drawn from the cells in this folder and may be replaced
    began = time.perf_counter()
    new = left = 0
    store = Store(cells_in)
    if redraw:
        cells = load(store)
    else:
        of_each = seeds or (QUICK_SEEDS if quick else SEEDS)
        limit = QUICK_MINUTES if quick and minutes is None else minutes
        cells, new = _run(chosen_axes, of_each, chosen_methods, store, device, scheduler, limit, common.seed)
        left = sum(not {identity(m) for m in chosen_methods} <= c.results.keys() for c in cells)
    took = time.perf_counter() - began
    atlas = aggregate(cells, chosen_axes, chosen_methods, _about(cells))
    with progress("drawing"), own_folder(out) if earlier else contextlib.nullcontext():
        files = atlas.write(out) | draw(atlas, out)
    speed = {"cells": atlas.cells, "new_cells": new, "cells_left": left, "seconds": took, "cells_per_s": new / took}
    data = {"aims": atlas.aims.to_json(), "files": {name: str(path) for name, path in files.items()}, **speed}
    damaged = [f"damaged, and left out: {what}" for what in store.damaged] if redraw else made_again(store.damaged)
    shown = [*damaged, *lines(atlas, files, new, left, took)]
    report(common, data | {"device": device, "damaged": store.damaged}, shown)


def _axes(names: Sequence[str], quick: bool) -> tuple[Axis, ...]:
    from amiwarp.studies.stability import AXES, quick_axes

    known = quick_axes() if quick else AXES
    _check_known("axis", names, [a.name for a in known])
    return tuple(a for a in known if not names or a.name in names)


def _methods(names: Sequence[str], quick: bool) -> tuple[Method, ...]:
    from amiwarp.studies.stability import METHODS, QUICK_METHODS, chosen

    _check_known("method", names, [m.name for m in METHODS])
    return chosen(QUICK_METHODS if quick and not names else names)


def _check_known(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise :class:`AmiwarpError` for a name that is not known."""
    for name in names:
        if name not in known:
            raise AmiwarpError(f"unknown {what} {name!r}; choose among {', '.join(known)}")


def _run(
    axes: Sequence[Axis], seeds: int, methods: Sequence[Method], store: Store, device: str, scheduler: str | None,
    minutes: float | None, first: int,
) -> tuple[list[Stored], int]:  # fmt: skip
    """Run all missing cells (single recordings). Return all cells and the number of new cells."""
    from amiwarp.studies.stability import run

    end = None if minutes is None else time.monotonic() + 60.0 * minutes
    new = 0

    def count(what: str, share: float) -> None:
        nonlocal new
        new += 1
        advance(what, share)

    try:
        with (
            progress("starting workers") as advance,
            start_workers("amiwarp stability", "cluster", scheduler, cpu_threads(), device) as workers,
        ):
            cells = run(axes, seeds, methods, store, workers, device=device, first=first, progress=count,
                        until=None if end is None else lambda: time.monotonic() > end)  # fmt: skip
    except KeyboardInterrupt:
        say(f"amiwarp: finished cells are kept in {store.folder}; run the same command again to continue")
        raise
    return cells, new


def _about(cells: Sequence[Stored]) -> dict[str, Any]:
    machines = sorted({r.machine for c in cells for r in c.results.values() if r.machine})
    return {"date": time.strftime("%Y-%m-%d"), "machine": ", ".join(machines), "versions": versions(())}


def lines(atlas: Atlas, files: dict[str, Path], new: int, left: int, took: float) -> list[Any]:
    """Return the results as tables and lines of text: where each method works, the aims, the files and the speed."""
    from amiwarp.studies.stability import summary

    shown: list[Any] = [table(summary(atlas), "works at", *atlas.methods), "", *atlas.aims.lines(), ""]
    listed = ("overview", "pages", "summary", "data", "table")
    shown += [f"{name}: {files[name]}" for name in listed]
    speed = f"{new:,} cells in {took:,.0f} s, {new / took:.3g} per second; " if new else ""
    if left:
        shown.append(f"{left:,} cells remain after the time limit; run the same command again to continue")
    return [*shown, f"{speed}{atlas.cells:,} cells in all, in {files['data'].parent / 'cells'}"]
