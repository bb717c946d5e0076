"""Cells of the stability study: simulated recordings under conditions, and their calibration by each method."""

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from typing import Any

from amiwarp._version import __version__
from amiwarp.io.finished_work import CellStore
from amiwarp.schema.records import build, fields_of, value_of
from amiwarp.studies.cluster import Workers, failure_of, run_jobs
from amiwarp.studies.failures import failure_text
from amiwarp.studies.machine import machine
from amiwarp.studies.stability.axes import Axis, conditions
from amiwarp.studies.stability.condition import Cell, Condition
from amiwarp.studies.stability.judging import Method, Outcome, Result, failed_result, judge
from amiwarp.studies.stability.mild_troubles import mild
from amiwarp.studies.stability.recordings import OpticSample, SimulatedSample, make, make_optic
from amiwarp.tasks import Progress
from amiwarp.validation import instance, whole

FORMAT = 4
"""Version of the file format of a stored cell, which is part of the cell's identity."""


@dataclass
class Stored:
    """Known results of the calibration methods for one cell."""

    cell: Cell
    """Cell (condition and seed) to which the results belong."""
    events: int = 0
    """Number of events of the cell's recording."""
    results: dict[str, Result] = field(default_factory=dict)
    """Results by :func:`identity` of the method."""

    def lacks(self, method: Method) -> bool:
        """Return whether a method is still to be run: it has no result, or failed in an earlier run."""
        result = self.results.get(identity(method))
        return result is None or result.outcome is Outcome.FAILED


def identity(method: Method) -> str:
    """Return a text that identifies a method's results by its settings and the package version."""
    text = json.dumps([FORMAT, __version__, method.identity], sort_keys=True, default=str)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return f"{method.name} {digest[:8]}"


def run_cell(cell: Cell, methods: tuple[Method, ...], device: str) -> Stored:
    """Simulate the recording of a cell, run the methods on it, and return their results.

    What raises an error outside of a method has the outcome ``failed``.
    """
    began = time.perf_counter()
    try:
        where = machine(device)
        sample: SimulatedSample | OpticSample
        if cell.condition.optic:
            sample = make_optic(cell.condition, cell.seed, device)
        else:
            sample = make(cell.condition, cell.seed, device)
    except Exception as error:
        return failed(cell, methods, failure_text(error), time.perf_counter() - began)
    done = Stored(cell, len(sample.recording.events))
    for method in methods:
        began = time.perf_counter()
        try:
            result = judge(cell, method, sample, device)
        except Exception as error:
            result = failed_result(failure_text(error), time.perf_counter() - began)
        done.results[identity(method)] = replace(result, machine=where)
    return done


def failed(cell: Cell, methods: Sequence[Method], message: str, seconds: float = 0.0) -> Stored:
    """Return the cell of which no result is known because it failed with a message, after some time [s]."""
    result = failed_result(message, seconds)
    return Stored(cell, results={identity(method): result for method in methods})


class Store(CellStore):
    """Folder of stored cells. A cell is written when it finishes, and is not run again."""

    def load(self, cell: Cell) -> Stored:
        """Return the known results of ``cell``; none if its file is missing or damaged."""
        known = self._load(f"{cell.name}.json")
        return Stored(cell) if known is None or known.cell != cell else known

    def load_all(self) -> list[Stored]:
        """Return all cells of the folder; damaged cells and cells of other versions are left out."""
        cells = (self._load(path.name) for path in sorted(self.folder.glob("*.json")))
        return [known for known in cells if known is not None]

    def _load(self, name: str) -> Stored | None:
        """Return the cell of a file; None if it is missing, damaged, of another version or renamed."""

        def make(data: dict[str, Any]) -> Stored | None:
            fields_of(data, "", "format", "condition", "seed", "events", "results")
            if data["format"] != FORMAT:
                return None
            values = instance(data["condition"], dict, "field condition")
            known_fields = {field.name for field in fields(Condition)}
            if not values.keys() <= known_fields:
                return None  # a version with other fields wrote it
            condition = build(Condition, values, "condition")
            cell = Cell(condition, whole(data["seed"], "field seed", 0, 2**31))
            events = whole(data["events"], "field events", 0, 10**12)
            results = value_of(dict[str, Result], data["results"], "results")
            if f"{cell.name}.json" != name:
                return None
            return Stored(cell, events, results)

        return self.read(name, make)

    def save(self, known: Stored) -> None:
        """Write all known results of a cell."""
        data = {
            "format": FORMAT,
            "condition": asdict(known.cell.condition),
            "seed": known.cell.seed,
            "events": known.events,
            "results": {name: asdict(result) for name, result in sorted(known.results.items())},
        }
        self.write(f"{known.cell.name}.json", data)


def cells_of(
    axes: Sequence[Axis],
    seeds: int,
    *,
    first: int = 0,
    draws: int = 0,
    combination: Callable[[int], Condition] = mild,
) -> list[Cell]:
    """Return the cells of axes with ``seeds`` seeds from ``first`` on, and of random combinations of mild troubles.

    ``combination`` draws a combination by seed. The seed is the outer loop: an interrupted run covers every condition,
    with fewer seeds.
    """
    cells = [Cell(combination(seed), seed) for seed in range(draws)]
    of_axes = conditions(axes)
    for seed in range(first, first + seeds):
        cells += [Cell(condition, seed) for condition in of_axes]
    return cells


def run(
    cells: Sequence[Cell],
    methods: Sequence[Method],
    store: Store,
    workers: Workers,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
    until: Callable[[], bool] | None = None,
) -> list[Stored]:
    """Run cells in their order, and return their results.

    Cells in ``store`` are reused; if a cell lacks a method, or the method failed there, only that method is run. A cell
    that fails, or whose worker dies, does not stop the others. No new cell starts after ``until`` returns True.
    """
    known = {cell: store.load(cell) for cell in cells}
    todo = []
    for cell, stored in known.items():
        lacking = tuple(method for method in methods if stored.lacks(method))
        if lacking:
            todo.append((cell, lacking))
    done = len(cells) - len(todo)
    with contextlib.closing(run_jobs(workers, partial(_run_missing, device), todo)) as running:
        for (cell, lacking), future in running:
            message = failure_of(future)
            found = failed(cell, lacking, message) if message else future.result()
            events = found.events or known[cell].events
            known[cell] = Stored(cell, events, {**known[cell].results, **found.results})
            store.save(known[cell])
            done += 1
            if progress is not None:
                progress(f"{done:,} of {len(cells):,} cells", done / len(cells))
            if until is not None and until():
                break
    return [known[cell] for cell in cells]


def _run_missing(device: str, job: tuple[Cell, tuple[Method, ...]]) -> Stored:
    """Run the methods that a cell lacks."""
    return run_cell(*job, device)
