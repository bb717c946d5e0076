"""Run of the evaluations on local processes or a cluster. Finished cells are kept."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from amiwarp._version import __version__
from amiwarp.cpu_threads import cpu_threads, limited_cpu_threads
from amiwarp.errors import AmiwarpError
from amiwarp.io import open_recording
from amiwarp.io.files import check_output, own_folder
from amiwarp.io.formats import make_folder
from amiwarp.io.json_files import CellStore, fields_of, value_of
from amiwarp.kernels.launch import load_all, load_kernels
from amiwarp.progress import Progress, silent
from amiwarp.studies.cluster import Workers, result_of, run_jobs, start_workers, worker_count
from amiwarp.studies.demo import EXACT_KERNELS
from amiwarp.studies.evaluate.measures import library
from amiwarp.studies.evaluate.report import EVALUATIONS, REPORT_FILES, SHORT, load, section, write
from amiwarp.studies.evaluate.study import (
    FULL,
    QUICK,
    CellResult,
    Condition,
    RecordedCondition,
    RecordedStreams,
    Settings,
    Streams,
)
from amiwarp.translation.pictures_between import limited_opencv
from amiwarp.validation import guarded, real, whole

# Cells of the study: one evaluation under one condition. Each is a file, so that a stopped run can be continued.

FORMAT = 4
"""Version of the files of cells, and of the streams and measures that all evaluations share."""


@dataclass(frozen=True)
class Job:
    """Evaluations of one condition, which share its simulation."""

    condition: Condition | RecordedCondition
    """Condition."""
    evaluations: tuple[str, ...]
    """Names of the evaluations."""
    settings: Settings
    """Size of the run."""
    threads: int | None = None
    """Number of CPU threads; None for all."""


@dataclass(frozen=True)
class JobResult:
    """Results of a job."""

    cells: list[CellResult]
    """Result of each evaluation."""
    processor_s: float
    """Processor time of the whole job [s]."""


def run_job(job: Job) -> JobResult:
    """Simulate the condition of a job once, or open its recording, and run its evaluations."""
    began = time.process_time()
    with limited_cpu_threads(job.threads), limited_opencv(library("cv2"), cpu_threads()):
        try:
            if isinstance(job.condition, Condition):
                streams: RecordedStreams = Streams(job.condition, job.settings.device)
            else:
                streams = RecordedStreams(open_recording(job.condition.path), job.settings.device)
            cells = [_run_cell(name, streams, job) for name in job.evaluations]
        except AmiwarpError as error:
            cells = [CellResult(name, job.condition, error=str(error)) for name in job.evaluations]
    return JobResult(cells, time.process_time() - began)


def compile_kernels(names: Sequence[str], device: str) -> float:
    """Compile the kernels of evaluations, which else each worker would compile. Return the processor time [s]."""
    began = time.process_time()
    for name in names:
        load(name)
    load_all(device)
    if device == "cpu":
        load_kernels(EXACT_KERNELS, device)
    return time.process_time() - began


def _run_cell(name: str, streams: RecordedStreams, job: Job) -> CellResult:
    """Run one evaluation. An error becomes part of the result, as a refused calibration does."""
    began = time.process_time()
    try:
        values, error = _as_stored(name, load(name).measure(streams, job.settings)), ""
    except AmiwarpError as refusal:
        values, error = {}, str(refusal)
    return CellResult(name, job.condition, values, error, time.process_time() - began)


def _as_stored(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of an evaluation as their cell will give them; numbers that are not finite become None."""
    plain = json.loads(json.dumps(values), parse_constant=lambda word: None)
    return value_of(load(name).Values, plain, f"values of {name}")


class Store(CellStore):
    """Folder of the cells of evaluations."""

    @staticmethod
    def _name(name: str, condition: Condition | RecordedCondition, settings: Settings) -> str:
        return f"{name}_{'quick' if settings.quick else 'full'}_{condition.key}.json"

    @staticmethod
    def _version(name: str, condition: Condition | RecordedCondition, settings: Settings) -> list[Any]:
        """Return all that a cell depends on: its condition, versions, settings and the kind of device.

        Seeds are left out, so that a run with more of them keeps its cells; the first one is shown in pictures.
        """
        size = asdict(settings) | {"device": settings.device.partition(":")[0]}
        del size["seeds"]
        return [FORMAT, __version__, load(name).VERSION, size, condition.key]

    def load(self, name: str, condition: Condition | RecordedCondition, settings: Settings) -> CellResult | None:
        """Return a stored cell; None if it is missing, damaged, or of another version, other settings or a device."""

        def make(data: dict[str, Any]) -> CellResult | None:
            fields_of(data, "", "version", "condition", "values", "error", "processor_s")
            if data["version"] != self._version(name, condition, settings):
                return None
            error, seconds = value_of(str, data["error"], "error"), real(data["processor_s"], "processor_s", 0.0, 1e9)
            values = {} if error else value_of(load(name).Values, data["values"], "values")
            return CellResult(name, condition, values, error, seconds)

        return self.read(self._name(name, condition, settings), make)

    def save(self, cell: CellResult, settings: Settings) -> None:
        """Write a cell."""
        condition = {name: str(v) if isinstance(v, Path) else v for name, v in asdict(cell.condition).items()}
        self.write(self._name(cell.evaluation, cell.condition, settings), {
            "version": self._version(cell.evaluation, cell.condition, settings),
            "condition": condition,
            "values": cell.values,
            "error": cell.error,
            "processor_s": cell.processor_s,
        })  # fmt: skip


def plan(names: Sequence[str], settings: Settings, recordings: Iterable[Path], *, worlds: bool = True) -> list[Job]:
    """Return one job for each condition and each recording, with all evaluations that need it.

    Without ``worlds`` there are only the recordings.
    """
    by: dict[Condition | RecordedCondition, list[str]] = {}
    for name in names:
        evaluation = load(name)
        for condition in evaluation.conditions(settings) if worlds else ():
            by.setdefault(condition, []).append(name)
        for path in () if evaluation.NEEDS_TRUTH else recordings:
            by.setdefault(RecordedCondition(path), []).append(name)
    return [Job(condition, tuple(evaluations), settings) for condition, evaluations in by.items()]


@guarded
@dataclass(frozen=True)
class EvaluationSummary:
    """What :func:`evaluate` did.

    Examples
    --------
    >>> summary = amiwarp.EvaluationSummary(
    ...     cells=4, new_cells=1, failed=0, verdicts={"reproduced": 3}, files={}, seconds=2.0, processor_seconds=3.0)
    >>> summary.verdicts["reproduced"]
    3
    """

    cells: int
    """Number of cells: evaluations under a condition, with a seed."""
    new_cells: int
    """Number of cells that were run; the others were there already."""
    failed: int
    """Number of cells that ended with an error, which the report states."""
    verdicts: dict[str, int]
    """Number of claims of the paper by the verdict on them."""
    files: dict[str, Path]
    """Files of the report, ``report`` and ``data``."""
    seconds: float
    """Elapsed time [s]."""
    processor_seconds: float
    """Processor time of all workers [s]."""
    damaged: tuple[str, ...] = ()
    """What was wrong with each damaged cell, which was run again."""


@guarded
def evaluate(
    out: str | Path,
    *,
    only: Sequence[str] = (),
    full: bool = False,
    seeds: int | None = None,
    recordings: Sequence[str | Path] = (),
    scheduler: str | None = None,
    workers: int | None = None,
    device: str = "cpu",
    seed: int = 0,
    progress: Progress | None = None,
) -> EvaluationSummary:
    """Evaluate the AMI-EV against a plain event camera as its paper does, and write a report.

    Finished cells in ``out`` are kept: the same call continues a stopped run.

    Parameters
    ----------
    out : str or Path
        Folder for the report, its tables and figures, and the cells.
    only : sequence of str, optional
        Names of the evaluations. By default a full run has all of them, and a quick run the short ones: texture,
        edges, apex_speed and fading.
    full : bool, optional
        Run the full study: 320×240, ten seeds, all values. By default the run is quick: 240×180, two seeds.
    seeds : int, optional
        Number of seeds instead.
    recordings : sequence of str or Path, optional
        Recordings on which to run the evaluations that need no ground truth. Without names in ``only``, nothing else is
        run then.
    scheduler : str, optional
        Address of a Dask scheduler. By default the work is done on this machine.
    workers : int, optional
        Number of local processes, by default one for each GPU, or for each core without a GPU. With 1 everything runs
        in this process.
    device : str, optional
        Device of the workers; ``cuda`` for all GPUs.
    seed : int, optional
        Offset of the seeds. With 0 they begin at 1, because settings were chosen with seed 0.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    EvaluationSummary
        Numbers of cells and verdicts, the files, and the time.

    Raises
    ------
    AmiwarpError
        If there is no evaluation of a name, a folder has the name of a cell, or a package is missing.

    Examples
    --------
    >>> amiwarp.evaluate("report", only=["texture"])  # doctest: +SKIP
    """
    began = time.perf_counter()
    settings = FULL if full else QUICK
    settings = replace(settings, first_seed=settings.first_seed + seed, device=device)
    if seeds is not None:
        settings = replace(settings, seeds=whole(seeds, "seeds", 1, 10_000))
    folder = Path(out)
    make_folder(folder / "cells")
    earlier = any((folder / "cells").iterdir())  # an existing report was made from these cells and may be replaced
    for name in () if earlier else REPORT_FILES:
        check_output(folder / name)
    chosen = only or (EVALUATIONS if full else SHORT)
    jobs = plan(chosen, settings, [Path(r) for r in recordings], worlds=bool(only) or not recordings)
    count = worker_count(workers, device)
    if scheduler is None:
        jobs = [replace(job, threads=max(1, cpu_threads() // count)) for job in jobs]
    store = Store(folder / "cells")
    with start_workers("amiwarp evaluate", "cluster", scheduler, count, device) as there:
        results, new, processor_s = _run(jobs, store, there, progress or silent)
    names = [name for name in EVALUATIONS if any(r.evaluation == name for r in results)]
    sections = [section(name, [r for r in results if r.evaluation == name]) for name in names]
    with contextlib.ExitStack() as stack:
        for own in (folder, folder / "tables", folder / "figures") if earlier else ():
            stack.enter_context(own_folder(own))
        files = write(folder, sections, settings, processor_s)
    verdicts = [claim.verdict.value for s in sections for claim in s.claims]
    return EvaluationSummary(
        len(results), new, sum(bool(r.error) for r in results), {v: verdicts.count(v) for v in dict.fromkeys(verdicts)},
        files, time.perf_counter() - began, processor_s, tuple(store.damaged),
    )  # fmt: skip


def _run(
    jobs: Sequence[Job], store: Store, workers: Workers, progress: Progress
) -> tuple[list[CellResult], int, float]:
    """Run the missing cells of the jobs. Return all cells, the number of new ones, and the processor time [s]."""
    results: list[CellResult] = []
    todo: list[Job] = []
    for job in jobs:
        known = {name: store.load(name, job.condition, job.settings) for name in job.evaluations}
        results += [cell for cell in known.values() if cell is not None]
        if missing := tuple(name for name, cell in known.items() if cell is None):
            todo.append(replace(job, evaluations=missing))
    processor_s, done, new = 0.0, 0, 0
    if len(todo) > 1 and workers.count() > 1:
        progress("compiling kernels", 0.0)
        names = dict.fromkeys(name for job in todo for name in job.evaluations)
        compiling = workers.executor.submit(compile_kernels, tuple(names), todo[0].settings.device)
        processor_s = compiling.result()
    with contextlib.closing(run_jobs(workers, run_job, todo)) as running:
        for job, future in running:
            result = result_of(future)
            for cell in result.cells:
                store.save(cell, job.settings)
            results += result.cells
            processor_s, done, new = processor_s + result.processor_s, done + 1, new + len(result.cells)
            progress(f"{done:,} of {len(todo):,} recordings", done / len(todo))
    order = {(job.condition, name): k for k, job in enumerate(jobs) for name in job.evaluations}
    return sorted(results, key=lambda r: order[r.condition, r.evaluation]), new, processor_s
