"""Evaluations: their names, their run on local processes or a cluster, and their report in HTML, JSON and figures."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import check_output, only_writer, own_folder
from amiwarp.schema.calls import guarded
from amiwarp.studies.cluster import Workers, failure_of, run_jobs, start_workers, worker_count
from amiwarp.studies.evaluate.catalogue import EVALUATIONS, UNCALIBRATED
from amiwarp.studies.evaluate.conditions import FULL, QUICK, Condition
from amiwarp.studies.evaluate.jobs import (
    Job,
    JobResult,
    Store,
    compile_kernels,
    failed,
    plan,
    run_job,
    run_setup,
)
from amiwarp.studies.evaluate.report import REPORT_FILES, Section, section, write
from amiwarp.studies.evaluate.results import CellResult
from amiwarp.studies.evaluate.streams import Setup
from amiwarp.tasks import Progress, cpu_threads, silent
from amiwarp.validation import whole

BYTES_PER_PIXEL = 52_000
"""Memory of a worker [bytes per pixel]: 50 million events of two seconds, with their ground truth, at 320x240 px."""


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
    """Number of cells that ended with an error, which the report states. The next call runs them again."""
    verdicts: dict[str, int]
    """Number of tested parts of the paper's claims, by the verdict on them."""
    files: dict[str, Path]
    """Files of the report, ``report`` and ``data``."""
    seconds: float
    """Elapsed time [s]."""
    processor_seconds: float
    """Processor time of all workers [s]."""
    damaged: tuple[str, ...] = ()
    """What was wrong with each damaged cell, which was run again."""
    failures: Mapping[str, str] = field(default_factory=dict)
    """Error message of each cell that failed, by its evaluation and condition."""


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

    Finished cells in ``out`` are kept: the same call continues a stopped run. A cell that fails is reported, and does
    not stop the others; the same call runs it again.

    Parameters
    ----------
    out : str or Path
        Folder for the report, its tables and figures, and the cells.
    only : sequence of str, optional
        Names of the evaluations, by default all.
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
        Number of local processes, by default up to four for each GPU, or one for each core without a GPU, as far
        as the memory goes. With 1 everything runs in this process.
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
    jobs = plan(
        only or EVALUATIONS,
        settings,
        [Path(recording) for recording in recordings],
        worlds=bool(only) or not recordings,
    )
    folder = Path(out)
    make_folder(folder / "cells")
    with only_writer(folder):
        # A report beside cells was made from them and may be replaced.
        continued = any((folder / "cells").iterdir())
        if not continued:
            for name in REPORT_FILES:
                check_output(folder / name)

        count = worker_count(workers, device, settings.width * settings.height * BYTES_PER_PIXEL)
        if scheduler is None:
            jobs = [replace(job, threads=max(1, cpu_threads() // count)) for job in jobs]
        store = Store(folder / "cells")
        with start_workers(
            "amiwarp evaluate", "evaluate", scheduler, count, device
        ) as started_workers:
            results, new, processor_s = _run(jobs, store, started_workers, progress or silent)

        sections = []
        for name in EVALUATIONS:
            cells = [cell for cell in results if cell.evaluation == name]
            if cells:
                sections.append(section(name, cells))
        with contextlib.ExitStack() as stack:
            if continued:
                for output_folder in (folder, folder / "tables", folder / "figures"):
                    stack.enter_context(own_folder(output_folder))
            files = write(folder, sections, settings, processor_s)

    failures = {
        f"{cell.evaluation}, {cell.condition.text}": cell.error for cell in results if cell.error
    }
    return EvaluationSummary(
        cells=len(results),
        new_cells=new,
        failed=sum(bool(cell.error) for cell in results),
        verdicts=_count_verdicts(sections),
        files=files,
        seconds=time.perf_counter() - began,
        processor_seconds=processor_s,
        damaged=tuple(store.damaged),
        failures=failures,
    )


def _count_verdicts(sections: Sequence[Section]) -> dict[str, int]:
    """Return how many tested parts of the paper's claims have each verdict, in order of appearance."""
    counts: dict[str, int] = {}
    for evaluated in sections:
        for claim in evaluated.claims:
            # Claims without a number are our checks, not the paper's.
            if claim.number is not None:
                counts[claim.verdict.value] = counts.get(claim.verdict.value, 0) + 1
    return counts


def _run(
    jobs: Sequence[Job], store: Store, workers: Workers, progress: Progress
) -> tuple[list[CellResult], int, float]:
    """Run the missing cells of the jobs, and those that failed before.

    Return all cells, the number of new ones, and the processor time [s]. A cell that fails, or whose worker dies, does
    not stop the others.
    """
    results, todo = _finished_and_missing(jobs, store)
    processor_s = _compile(todo, workers, progress)

    prisms = _calibrate_prisms(todo, workers, progress)
    processor_s += prisms.processor_s
    todo, lost = _without_setups(todo, prisms.refused)
    new: list[CellResult] = []
    for job, message in lost:
        new += _kept(failed(job, message), job, store)

    todo = [_with_setup(job, prisms.setups) for job in todo]
    with contextlib.closing(run_jobs(workers, run_job, todo)) as running:
        for done, (job, future) in enumerate(running, start=1):
            message = failure_of(future)
            result = JobResult(failed(job, message), 0.0) if message else future.result()
            new += _kept(result.cells, job, store)
            processor_s += result.processor_s
            progress(f"{done:,} of {len(todo):,} recordings", done / len(todo))

    order = {}
    for number, job in enumerate(jobs):
        for name in job.evaluations:
            order[job.condition, name] = number
    cells = sorted([*results, *new], key=lambda cell: order[cell.condition, cell.evaluation])
    return cells, len(new), processor_s


def _finished_and_missing(jobs: Sequence[Job], store: Store) -> tuple[list[CellResult], list[Job]]:
    """Return the stored cells without an error, and jobs with the evaluations that remain."""
    results: list[CellResult] = []
    todo: list[Job] = []
    for job in jobs:
        missing = []
        # A name that was given twice counts once.
        for name in dict.fromkeys(job.evaluations):
            cell = store.load(name, job.condition, job.settings)
            if cell is None or cell.error:
                missing.append(name)
            else:
                results.append(cell)
        if missing:
            todo.append(replace(job, evaluations=tuple(missing)))
    return results, todo


def _compile(jobs: Sequence[Job], workers: Workers, progress: Progress) -> float:
    """Compile the kernels of the jobs once if several workers would. Return the processor time [s]."""
    if len(jobs) < 2 or workers.count() < 2:
        return 0.0
    progress("compiling kernels", 0.0)
    names = dict.fromkeys(name for job in jobs for name in job.evaluations)
    device = jobs[0].settings.device
    compiling = workers.executor.submit(compile_kernels, tuple(names), device)
    if failure_of(compiling):
        # Each worker compiles its kernels then, and the cells say what fails.
        return 0.0
    return compiling.result()


@dataclass(frozen=True)
class _Prisms:
    """Prisms that jobs need calibrated from another recording."""

    setups: Mapping[Condition, Setup]
    """What is known of each prism, by the condition of that recording."""
    refused: Mapping[Condition | None, str]
    """Why the others could not be calibrated."""
    processor_s: float
    """Processor time [s]."""


def _calibrate_prisms(jobs: Sequence[Job], workers: Workers, progress: Progress) -> _Prisms:
    """Calibrate each prism once, from its own recording."""
    needed = {job.setup_condition: job for job in jobs if job.setup_condition is not None}
    # They are few, and take the threads of idle workers, too.
    share = max(1, workers.count() // max(1, len(needed)))
    first = []
    for job in needed.values():
        threads = None if job.threads is None else job.threads * share
        first.append(replace(job, threads=threads))

    setups: dict[Condition, Setup] = {}
    refused: dict[Condition | None, str] = {}
    processor_s = 0.0
    for job, calibrated in run_jobs(workers, run_setup, first):
        condition = job.setup_condition
        assert condition is not None
        if message := failure_of(calibrated):
            refused[condition] = f"calibration of the prism: {message}"
            continue
        setups[condition], seconds = calibrated.result()
        processor_s += seconds
        progress(f"calibrated {len(setups)} of {len(needed)} prisms", 0.0)
    return _Prisms(setups, refused, processor_s)


def _with_setup(job: Job, setups: Mapping[Condition, Setup]) -> Job:
    """Return the job with what is known of its prism, if it needs that."""
    if job.setup_condition is None:
        return job
    return replace(job, setup=setups[job.setup_condition])


def _without_setups(
    jobs: Sequence[Job], refused: Mapping[Condition | None, str]
) -> tuple[list[Job], list[tuple[Job, str]]]:
    """Return the jobs that can be run although the calibration of some prisms failed, and the others with the reason.

    A job is divided if some of its evaluations need no calibration.
    """
    able = list[Job]()
    lost = list[tuple[Job, str]]()
    for job in jobs:
        if job.setup_condition not in refused:
            able.append(job)
            continue
        without = tuple(name for name in job.evaluations if name in UNCALIBRATED)
        needing = tuple(name for name in job.evaluations if name not in UNCALIBRATED)
        lost.append((replace(job, evaluations=needing), refused[job.setup_condition]))
        if without:
            able.append(replace(job, evaluations=without))
    return able, lost


def _kept(cells: list[CellResult], job: Job, store: Store) -> list[CellResult]:
    """Return new results of a job after writing them to the store."""
    for cell in cells:
        store.save(cell, job.settings)
    return cells
