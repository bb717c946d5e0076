"""Run of the stability study by any executor, such as a Dask cluster or a process pool.

Each cell (one recording with its results) is stored when it finishes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import replace
from typing import TYPE_CHECKING

from amiwarp.progress import Progress
from amiwarp.studies.stability.axes import AXES, Axis
from amiwarp.studies.stability.cells import METHODS, Cell, Method, Store, Stored, identity, run_cell
from amiwarp.studies.stability.conditions import Condition

if TYPE_CHECKING:
    from concurrent.futures import Future

QUICK_METHODS = ("default", "paper", "sharpness")
"""Names of the methods of a quick run."""


def quick_axes() -> tuple[Axis, ...]:
    """Return each axis with at most three values: both ends and the middle."""
    return tuple(
        replace(a, values=tuple(dict.fromkeys(a.values[i] for i in (0, len(a.values) // 2, -1))))
        for a in AXES
        if a.name != "many events"
    )


def conditions(axes: Sequence[Axis]) -> list[Condition]:
    """Return every condition of the axes once; all axes share the condition with default values."""
    return list(dict.fromkeys(c for axis in axes for c in axis.conditions()))


def run(
    axes: Sequence[Axis],
    seeds: int,
    methods: Sequence[Method],
    store: Store,
    executor: Executor,
    *,
    device: str = "cpu",
    first: int = 0,
    progress: Progress | None = None,
    until: Callable[[], bool] | None = None,
) -> list[Stored]:
    """Run all cells (conditions and seeds) of the axes, and return their results.

    Cells in ``store`` are reused; if a cell lacks a method, only that method is run. Seeds begin at ``first``. The
    seed is the outer loop: an interrupted run covers every condition, with fewer seeds. No new cell starts after
    ``until`` returns True.
    """
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
    """Return the methods for which a cell has no result."""
    return tuple(m for m in methods if identity(m) not in stored.results)


def chosen(names: Sequence[str] = ()) -> tuple[Method, ...]:
    """Return methods by their names; the default and the paper's method are always included."""
    return tuple(m for m in METHODS if not names or m.name in (*names, "default", "paper"))
