"""Command ``stability``: limits and failures of the calibration, on simulated recordings with ground truth."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import only_writer, own_folder
from amiwarp.studies.long_runs import failed_lines
from amiwarp.tasks import cpu_threads

if TYPE_CHECKING:
    from amiwarp.studies.stability.atlas import Atlas
    from amiwarp.studies.stability.axes import Axis
    from amiwarp.studies.stability.cells import Store, Stored
    from amiwarp.studies.stability.condition import Cell
    from amiwarp.studies.stability.judging import Method


SEEDS = 20
"""Number of recordings per value of an axis."""
QUICK_SEEDS = 1
"""The same with ``--quick``."""
QUICK_MINUTES = 9.0
"""Time limit of a run with ``--quick`` [min]."""


def run_stability(
    *,
    out: Annotated[
        Path,
        typer.Option(help="Folder for the results of single runs (cells), figures and tables."),
        cli.OUTPUT_FOLDER,
    ] = Path("amiwarp-atlas"),
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Use three values per axis, three methods and one seed: within ten minutes.",
        ),
    ] = False,
    axes: Annotated[
        list[str] | None,
        typer.Option(help="Axis to vary. Can be repeated. Default: all axes.", metavar="NAME"),
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
        int | None,
        typer.Option(
            min=1, help=f"Recordings per value. Default: {SEEDS}, with --quick {QUICK_SEEDS}."
        ),
    ] = None,
    draws: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Recordings with random combinations of mild troubles, by which the stated deviations are judged. "
            "Default: 300, none with --quick or --axes.",
        ),
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
        str | None,
        typer.Option(help="Address of a Dask scheduler. Default: one local process per core."),
    ] = None,
    redraw: Annotated[
        bool,
        typer.Option(
            "--redraw", help="Only draw figures and tables from the existing cells; run nothing."
        ),
    ] = False,
    common: cli.Common,
) -> None:
    """Calibrate simulated recordings under growing disturbances, and draw where calibration works and fails.

    Each axis varies one disturbance, such as noise. A cell holds one recording and the results of all methods on it.
    Finished cells are saved in OUT/cells: the same command continues a stopped run and skips finished cells. A cell
    that fails is reported, does not stop the others, and is run again by the same command.
    """
    device = cli.choose_device(common.device)
    from amiwarp.studies.stability.atlas import aggregate, load
    from amiwarp.studies.stability.cells import Store, cells_of, identity
    from amiwarp.studies.stability.figures import draw
    from amiwarp.studies.stability.mild_troubles import DRAWS
    from amiwarp.studies.stability.report import write

    chosen_axes = _axes(axes or (), quick)
    chosen_methods = _methods(methods or (), quick)
    cells_in = out / "cells"
    make_folder(cells_in)
    with only_writer(out):
        # Figures beside cells were drawn from them and may be replaced.
        continued = any(cells_in.iterdir())
        began = time.perf_counter()
        new = 0
        left = 0
        store = Store(cells_in)
        if redraw:
            cells = load(store)
        else:
            of_each = seeds or (QUICK_SEEDS if quick else SEEDS)
            limit = QUICK_MINUTES if quick and minutes is None else minutes
            if draws is None:
                draws = 0 if quick or axes else DRAWS
            wanted = cells_of(chosen_axes, of_each, first=common.seed, draws=draws)
            cells, new = _run_cells(wanted, chosen_methods, store, device, scheduler, limit)
            needed = {identity(method) for method in chosen_methods}
            left = sum(not needed <= cell.results.keys() for cell in cells)
        took = time.perf_counter() - began
        atlas = aggregate(cells, chosen_axes, chosen_methods, _about(cells))
        with cli.progress("drawing"), own_folder(out) if continued else contextlib.nullcontext():
            files = write(atlas, out) | draw(atlas, out)

    data = {
        "aims": atlas.aims.to_json(),
        "files": {name: str(path) for name, path in files.items()},
        "cells": atlas.cells,
        "new_cells": new,
        "cells_left": left,
        "seconds": took,
        "cells_per_s": new / took,
        "cells_failed": atlas.failed_cells,
        "device": device,
        "damaged": store.damaged,
        "failed": [asdict(failure) for failure in atlas.failures],
    }
    damaged = cli.made_again(store.damaged)
    if redraw:
        damaged = [f"damaged, and left out: {what}" for what in store.damaged]
    cli.report(common, data, [*damaged, *stability_lines(atlas, files, new, left, took)])
    if not atlas.measured:
        raise typer.Exit(1)


def _axes(names: Sequence[str], quick: bool) -> tuple[Axis, ...]:
    from amiwarp.studies.stability.axes import AXES, quick_axes

    known = quick_axes() if quick else AXES
    _check_known("axis", names, [axis.name for axis in known])
    if not names:
        return tuple(known)
    return tuple(axis for axis in known if axis.name in names)


def _methods(names: Sequence[str], quick: bool) -> tuple[Method, ...]:
    from amiwarp.studies.stability.judging import METHODS, QUICK_METHODS, chosen

    _check_known("method", names, [method.name for method in METHODS])
    if quick and not names:
        names = QUICK_METHODS
    return chosen(names)


def _check_known(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise :class:`AmiwarpError` for a name that is not known."""
    for name in names:
        if name not in known:
            raise AmiwarpError(f"unknown {what} {name!r}; choose among {', '.join(known)}")


def _run_cells(
    wanted: Sequence[Cell],
    methods: Sequence[Method],
    store: Store,
    device: str,
    scheduler: str | None,
    minutes: float | None,
) -> tuple[list[Stored], int]:
    """Run all missing cells (single recordings). Return all cells and the number of new cells."""
    from amiwarp.studies.cluster import start_workers
    from amiwarp.studies.stability.cells import run

    until = None
    if minutes is not None:
        end = time.monotonic() + 60.0 * minutes

        def until() -> bool:
            return time.monotonic() > end

    new = 0

    def count(what: str, share: float) -> None:
        nonlocal new
        new += 1
        advance(what, share)

    try:
        with (
            cli.progress("starting workers") as advance,
            start_workers(
                "amiwarp stability", "cluster", scheduler, cpu_threads(), device
            ) as workers,
        ):
            cells = run(
                wanted,
                methods,
                store,
                workers,
                device=device,
                progress=count,
                until=until,
            )
    except KeyboardInterrupt:
        say(
            f"amiwarp: finished cells are kept in {store.folder}; run the same command again to continue"
        )
        raise
    return cells, new


def _about(cells: Sequence[Stored]) -> dict[str, Any]:
    from amiwarp.studies.machine import versions

    machines = set()
    for cell in cells:
        machines |= {result.machine for result in cell.results.values() if result.machine}
    return {
        "date": time.strftime("%Y-%m-%d"),
        "machine": ", ".join(sorted(machines)),
        "versions": versions(()),
    }


def stability_lines(
    atlas: Atlas, files: dict[str, Path], new: int, left: int, took: float
) -> list[Any]:
    """Return the results as tables and lines of text: where each method works, the aims, the files and the speed."""
    from amiwarp.studies.stability.aims import STATED_HEADINGS
    from amiwarp.studies.stability.report import summary

    shown: list[Any] = [
        cli.table(summary(atlas), "works at", *atlas.methods),
        "",
        *atlas.aims.lines(),
        "",
    ]
    if atlas.stated:
        shown += [cli.table([deviation.row() for deviation in atlas.stated], *STATED_HEADINGS), ""]
    listed = ("overview", "pages", "summary", "data", "table")
    shown += [f"{name}: {files[name]}" for name in listed]
    failed = {}
    for failure in atlas.failures:
        seed = failure.name.rpartition("_")[2]
        failed[f"{failure.where}, seed {seed}, {', '.join(failure.methods)}"] = failure.message
    shown += failed_lines(failed, files["summary"])
    if left:
        shown.append(
            f"{left:,} cells remain after the time limit; run the same command again to continue"
        )

    last = f"{atlas.cells:,} cells in all, in {files['data'].parent / 'cells'}"
    if new:
        last = f"{new:,} cells in {took:,.0f} s, {new / took:.3g} per second; {last}"
    if failed:
        last += f"; {atlas.failed_cells:,} failed: run the same command again to try them again"
    return [*shown, last]
