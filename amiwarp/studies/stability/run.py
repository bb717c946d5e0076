"""Runs cells through any executor, a Dask cluster's or a pool of processes, and keeps each as it finishes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from amiwarp.progress import Progress
from amiwarp.studies.stability.cells import METHODS, Cell, Method, Store, Stored, identity, run_cell
from amiwarp.studies.stability.conditions import AXES, Axis, Condition

if TYPE_CHECKING:
    from concurrent.futures import Future

QUICK_METHODS = ("default", "paper", "sharpness")


def quick_axes() -> tuple[Axis, ...]:
    """Of each axis the ends and what lies between them, three values at most."""
    return tuple(
        replace(a, values=tuple(dict.fromkeys(a.values[i] for i in (0, len(a.values) // 2, -1))))
        for a in AXES
        if a.name != "many events"
    )


def conditions(axes: Sequence[Axis]) -> list[Condition]:
    """Every condition of the axes once: their harmless ends are one and the same."""
    return list(dict.fromkeys(c for axis in axes for c in axis.conditions()))


def run(
    axes: Sequence[Axis],
    seeds: int,
    methods: Sequence[Method],
    folder: Path,
    executor: Executor,
    *,
    device: str = "cpu",
    first: int = 0,
    progress: Progress | None = None,
    until: Callable[[], bool] | None = None,
) -> list[Stored]:
    """All cells of the axes; those in the folder are taken from there, those that miss a method run that method.

    Seeds are ``first`` and those after it. They go round: a run that is cut short has every condition with fewer
    seeds. After ``until`` says so no further cell is begun. Raises :class:`AmiwarpError` for damaged files.
    """
    store = Store(folder)
    cells = [Cell(c, seed) for seed in range(first, first + seeds) for c in conditions(axes)]
    known = {cell: store.load(cell) for cell in cells}
    todo = [(cell, missing) for cell in cells if (missing := _missing(known[cell], methods))]
    waiting: dict[Future[Stored], Cell] = {}
    done = len(cells) - len(todo)
    try:
        for cell, missing in todo:
            waiting[executor.submit(run_cell, cell, missing, device)] = cell
        for future in as_completed(waiting):
            found, cell = future.result(), waiting[future]
            known[cell] = replace(found, results={**known[cell].results, **found.results})
            store.save(known[cell])
            done += 1
            if progress is not None:
                progress(f"{done:,} of {len(cells):,} cells", done / len(cells))
            if until is not None and until():
                break
    finally:
        for future in waiting:
            future.cancel()
    return [known[cell] for cell in cells]


def _missing(stored: Stored, methods: Sequence[Method]) -> tuple[Method, ...]:
    return tuple(m for m in methods if identity(m) not in stored.results)


def chosen(names: Sequence[str] = ()) -> tuple[Method, ...]:
    """Methods by name, the default and the paper's always among them."""
    return tuple(m for m in METHODS if not names or m.name in (*names, "default", "paper"))
