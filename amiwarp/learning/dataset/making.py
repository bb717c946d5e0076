"""Making of data sets on local processes or a cluster. What is there already is kept."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import only_writer
from amiwarp.io.unfinished import scratch_folder
from amiwarp.kernels import quiet_start
from amiwarp.learning.dataset import specification as spec
from amiwarp.learning.dataset.files import Journal, check_folder, require_pyarrow, write_manifest
from amiwarp.learning.dataset.items import Item, list_items, sources_of_splits
from amiwarp.learning.dataset.randomise import drawn_ranges
from amiwarp.learning.dataset.worker import Failed, Job, Made, make
from amiwarp.schema.calls import guarded
from amiwarp.studies import cluster
from amiwarp.tasks import Progress, cpu_threads, silent

MOST_READERS = 8
"""Largest number of threads that read finished recordings."""
CHECKED = 256
"""Number of recordings that are given to these threads at a time."""


@guarded
@dataclass(frozen=True)
class DatasetSummary:
    """What :func:`make_dataset` did.

    Examples
    --------
    >>> summary = amiwarp.DatasetSummary(
    ...     recordings=12, made=11, kept=0, failed={"train/a-1.h5": "no such file"}, not_in_specification=(),
    ...     splits={"train": 11}, events=10, size_bytes=100, seconds=2.0, worker_seconds=3.0,
    ...     processor_seconds=2.5, workers=2, sources_of_splits={"all sources": {"train": 2}})
    >>> summary.made + summary.kept + len(summary.failed) == summary.recordings
    True
    """

    recordings: int
    """Number of recordings that the specification describes."""
    made: int
    """Number of recordings that were made."""
    kept: int
    """Number of recordings that were there already."""
    failed: Mapping[str, str]
    """Error message of each recording that could not be made, by its file."""
    not_in_specification: tuple[str, ...]
    """Recordings in the folder that the specification does not describe. They are kept, but not in the manifest."""
    splits: Mapping[str, int]
    """Number of finished recordings of each split."""
    events: int
    """Number of events in the recordings that were made."""
    size_bytes: int
    """Size of the recordings that were made [bytes]."""
    seconds: float
    """Elapsed time [s]."""
    worker_seconds: float
    """Time that the workers spent on recordings, added up [s]."""
    processor_seconds: float
    """Processor time that they spent, added up [s]."""
    workers: int
    """Largest number of workers; 0 if there was nothing to make."""
    sources_of_splits: Mapping[str, Mapping[str, int]]
    """Number of different sources of each split, as in :attr:`DatasetPlan.sources_of_splits`."""
    drawn: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Least, median and largest value of each randomised setting, as in :attr:`DatasetPlan.drawn`."""
    damaged: tuple[str, ...] = ()
    """What was wrong with the journal, and with each damaged recording. These recordings were made again."""


@guarded
def make_dataset(
    specification: str | Path,
    out: str | Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> DatasetSummary:
    """Make the recordings of a data set that are missing, and write its manifest.

    A recording that cannot be made is reported in the manifest and does not stop the others.

    Parameters
    ----------
    specification : str or Path
        TOML file that describes the data set.
    out : str or Path
        Folder of the data set: a new folder, or the folder of an earlier call.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``tcp://10.0.0.1:8786``. By default, processes of this machine do the
        work. All workers need access to ``out`` and to the sources under the same paths.
    workers : int, optional
        Number of local processes. By default one for each core, or up to four for each GPU. One worker runs in this
        process, and needs no Dask.
    device : str, optional
        ``cpu``; ``cuda`` for all GPUs, which the workers share evenly; or one GPU, such as ``cuda:0``.
    progress : Progress, optional
        Called with the state and the finished share.

    Returns
    -------
    DatasetSummary
        Numbers of recordings, failures and the speed.

    Raises
    ------
    AmiwarpError
        If the specification is wrong, a source is not found, the folder holds other files, or workers are missing.

    Notes
    -----
    Several local workers are processes that import the running script. Call this function under
    ``if __name__ == "__main__":`` in a script.

    Examples
    --------
    >>> import pathlib
    >>> _ = pathlib.Path("step.pgm").write_text("P2 4 2 255 0 255 0 255 255 0 255 0")
    >>> _ = pathlib.Path("small.toml").write_text('''
    ... format = "amiwarp-dataset-specification"
    ... version = 1
    ... duration_s = 0.002
    ... camera = {size = [16, 12]}
    ... prisms = [{apex_deg = 1.0}]
    ... speeds_rpm = [720.0, 1800.0]
    ... sources = [{pictures = "*.pgm"}]
    ... ''')
    >>> amiwarp.make_dataset("small.toml", "small", workers=1).made
    2
    """
    began = time.perf_counter()
    out = Path(out)
    report = progress or silent
    loaded = spec.load_specification(specification)
    require_pyarrow()
    check_folder(out)
    items = list_items(loaded)
    count = _local_workers(scheduler, workers, device)
    make_folder(out)
    with only_writer(out):
        return _make_missing(
            loaded,
            items,
            out,
            scheduler=scheduler,
            count=count,
            device=device,
            report=report,
            began=began,
        )


def _make_missing(
    loaded: spec.Specification,
    items: Sequence[Item],
    out: Path,
    *,
    scheduler: str | None,
    count: int | None,
    device: str,
    report: Progress,
    began: float,
) -> DatasetSummary:
    """Make the recordings that the folder lacks, and write the manifest."""
    journal = Journal(out)
    journal.create()
    todo = missing(journal, items, report)
    run = _Run(len(todo), journal, report)
    try:
        if todo:
            target = out.resolve()
            threads = cluster.threads_of_worker(device, count)
            name = "amiwarp dataset"
            with (
                scratch_folder(target) as scratch,
                cluster.start_workers(name, "dataset", scheduler, count or 0, device) as workers,
            ):
                jobs = (Job(item, target, scratch, device, threads) for item in todo)
                run.wait_for(jobs, workers)
    finally:
        write_manifest(out, loaded, items, journal, run.failed)
    files = {item.key: item.file for item in items}
    return DatasetSummary(
        recordings=len(items),
        made=len(run.made),
        kept=len(items) - len(todo),
        failed={files[failed.key]: failed.error for failed in run.failed},
        not_in_specification=tuple(journal.others(items)),
        splits=dict(Counter(item.split for item in items if item.key in journal.made)),
        events=run.events,
        size_bytes=sum(made.bytes for made in run.made),
        seconds=time.perf_counter() - began,
        worker_seconds=sum(made.seconds for made in run.made),
        processor_seconds=sum(made.processor_s for made in run.made),
        workers=run.most_workers,
        sources_of_splits=sources_of_splits(loaded, items),
        drawn=drawn_ranges([item.drawn for item in items]),
        damaged=tuple(journal.damaged),
    )


class _Run:
    """Recordings that are being made, and what became of them."""

    def __init__(self, total: int, journal: Journal, report: Progress) -> None:
        self._total = total
        self._journal = journal
        self._report = report
        self.made: list[Made] = []
        self.failed: list[Failed] = []
        self.events = 0
        """Number of events in the recordings that were made."""
        self.most_workers = 0
        """Largest number of workers so far."""

    def wait_for(self, jobs: Iterator[Job], workers: cluster.Workers) -> None:
        """Give jobs to workers, and enter their results into the journal as they come."""
        with contextlib.closing(cluster.run_jobs(workers, make, jobs)) as results:
            began = time.perf_counter()
            self._report(f"0 of {self._total:,} recordings", 0.0)
            for job, future in results:
                result = _result(job, future)
                if isinstance(result, Failed):
                    self.failed.append(result)
                else:
                    self.made.append(result)
                    self.events += result.events
                    self._journal.add(result)
                self.most_workers = max(self.most_workers, workers.count())
                self._report_state(time.perf_counter() - began)

    def _report_state(self, seconds: float) -> None:
        """Report how many recordings are finished, and the time that is left at the mean speed so far."""
        finished = len(self.made) + len(self.failed)
        left_s = (self._total - finished) * seconds / finished
        failures = f", {len(self.failed):,} failed" if self.failed else ""
        speed = self.events / seconds / 1e6
        self._report(
            f"{finished:,} of {self._total:,} recordings{failures}, {speed:.3g} Mev/s, {duration_text(left_s)} left",
            finished / self._total,
        )


def missing(journal: Journal, items: Sequence[Item], progress: Progress) -> list[Item]:
    """Return the items without an undamaged recording, in an order that depends on their keys alone.

    Undamaged recordings whose split has changed are moved to its folder.
    The order mixes long and short recordings, so that the speed so far predicts the rest. The files are read by several
    threads, to compare their checksums.
    """
    present = [item for item in items if journal.is_there(item)]
    intact: set[str] = set()
    with ThreadPoolExecutor(min(cpu_threads(), MOST_READERS)) as pool:
        for start in range(0, len(present), CHECKED):
            block = present[start : start + CHECKED]
            are_intact = pool.map(journal.is_intact, block)
            for item, is_intact in zip(block, are_intact, strict=True):
                if is_intact:
                    intact.add(item.key)
            progress("checking finished recordings", (start + len(block)) / len(present))
    for item in present:
        if item.key in intact:
            journal.move(item)
    todo = [item for item in items if item.key not in intact]
    for item in todo:
        journal.drop(item)
    return sorted(todo, key=lambda item: item.key)


def _local_workers(scheduler: str | None, workers: int | None, device: str) -> int | None:
    """Return the number of local workers; None with a scheduler.

    Raises :class:`AmiwarpError` if this machine lacks their device.
    """
    if scheduler is not None:
        if workers is not None:
            raise AmiwarpError(
                f"workers = {workers} applies to local processes; leave it out with a scheduler",
                ErrorCode.OPTIONS,
            )
        return None
    known = quiet_start.start_quietly()
    if device not in (*known, *([cluster.ANY_GPU] if cluster.gpu_count(known) else [])):
        raise AmiwarpError(
            f"device {device!r} is not available; choose one of {', '.join(known)}",
            ErrorCode.DEVICE_MISSING,
        )
    return cluster.worker_count(workers, device)


def _result(job: Job, future: Future[Made | Failed]) -> Made | Failed:
    """Return the result of a job. A worker that dies, for example for want of memory, is a failure of its recording.

    Raises :class:`AmiwarpError` if the worker does not see the folder of the data set.
    """
    message = cluster.failure_of(future)
    if not message or isinstance(future.exception(), AmiwarpError):
        return future.result()
    return Failed(job.item.key, message)


def duration_text(seconds: float) -> str:
    """Return a duration with the unit in which it reads best."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"
