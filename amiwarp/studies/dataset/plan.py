"""Estimate of the size of a data set and of the time to make it, from short samples of its recordings."""

from __future__ import annotations

import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from amiwarp.cpu_threads import limited_cpu_threads
from amiwarp.errors import AmiwarpError
from amiwarp.io.atomic_output import scratch_folder
from amiwarp.progress import Progress, silent
from amiwarp.studies.cluster import ANY_GPU, threads_of_worker, worker_count
from amiwarp.studies.dataset.items import Item, list_items, simulation_of, write_recording
from amiwarp.studies.dataset.run import Journal, check_folder
from amiwarp.studies.dataset.specification import content_digest, load_specification
from amiwarp.validation import guarded

SAMPLES = 24
"""Largest number of recordings that are sampled for each kind of source."""
LONGEST_SAMPLE_S = 0.1
"""Longest simulated time of a sample [s]."""
SAMPLING_S = 10.0
"""Time after which no further sample of a kind of source begins [s]."""


@guarded
@dataclass(frozen=True)
class DatasetPlan:
    """What :func:`plan_dataset` expects of a data set.

    Examples
    --------
    >>> plan = amiwarp.DatasetPlan(
    ...     recordings=12, missing=10, splits={"train": 12}, sources={"pictures": 12}, samples=6, uncertainty=0.1,
    ...     events=1e6, size_bytes=1e7, worker_seconds=30.0, workers=2, device="cpu")
    >>> plan.seconds
    15.0
    """

    recordings: int
    """Number of recordings that the specification describes."""
    missing: int
    """Number of them that are not in the folder."""
    splits: Mapping[str, int]
    """Number of recordings of each split."""
    sources: Mapping[str, int]
    """Number of recordings of each kind of source."""
    samples: int
    """Number of missing recordings that were sampled."""
    uncertainty: float
    """Standard error of the expected time, relative to it, from the spread of the samples."""
    events: float
    """Expected number of events of the missing recordings."""
    size_bytes: float
    """Expected size of the missing recordings [bytes]."""
    worker_seconds: float
    """Expected time of the missing recordings, added over the workers [s]."""
    workers: int
    """Number of workers."""
    device: str
    """Device of the samples."""

    @property
    def seconds(self) -> float:
        """Expected time [s], if the workers do not slow each other down."""
        return self.worker_seconds / max(self.workers, 1)


@dataclass(frozen=True)
class _Cost:
    """Events, bytes and seconds of a recording."""

    events: float = 0.0
    bytes: float = 0.0
    seconds: float = 0.0

    def plus(self, other: _Cost, times: float = 1.0) -> _Cost:
        """Return the sum with ``other`` times a factor."""
        return _Cost(
            self.events + times * other.events, self.bytes + times * other.bytes, self.seconds + times * other.seconds
        )


@guarded
def plan_dataset(
    specification: str | Path,
    out: str | Path,
    *,
    workers: int | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> DatasetPlan:
    """Estimate the size of a data set and the time to make it. No recording is added to the folder.

    Up to 24 recordings of each kind of source are simulated for at most 0.1 s each, within about 10 s. Events, bytes
    and time are taken to grow linearly with the duration, and the mean of the samples stands for all recordings of that
    kind.

    Parameters
    ----------
    specification : str or Path
        TOML file that describes the data set.
    out : str or Path
        Folder of the data set, which need not exist.
    workers : int, optional
        Number of workers. By default one for each core, or for each GPU.
    device : str, optional
        Device as for :func:`make_dataset`.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    DatasetPlan
        Counts, and the expected events, size and time.

    Raises
    ------
    AmiwarpError
        If the specification is wrong, a source is not found, or a sample cannot be made.

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
    ... speeds_rpm = [720.0]
    ... seeds = 10
    ... sources = [{pictures = "*.pgm"}]
    ... ''')
    >>> amiwarp.plan_dataset("small.toml", "small", workers=2).missing
    10
    """
    out = Path(out)
    items = list_items(load_specification(specification))
    check_folder(out)
    journal = Journal(out)
    todo = sorted((item for item in items if not journal.is_there(item)), key=lambda item: item.key)
    by_kind: defaultdict[str, list[Item]] = defaultdict(list)
    for item in todo:
        by_kind[item.kind].append(item)
    count = worker_count(workers, device)
    threads = threads_of_worker(device, count)
    total, samples, variance = _sample_all(list(by_kind.values()), out, device, threads, progress or silent)
    return DatasetPlan(
        recordings=len(items),
        missing=len(todo),
        splits=dict(Counter(item.split for item in items)),
        sources=dict(Counter(item.kind for item in items)),
        samples=samples,
        uncertainty=variance**0.5 / total.seconds if total.seconds else 0.0,
        events=total.events,
        size_bytes=total.bytes,
        worker_seconds=total.seconds,
        workers=count,
        device=device,
    )


def _sample_all(
    groups: Sequence[Sequence[Item]], out: Path, device: str, threads: int | None, progress: Progress
) -> tuple[_Cost, int, float]:
    """Return the expected cost of all recordings, the number of samples, and the variance of the expected time [s²].

    Each group holds the recordings of one kind of source.
    """
    total, samples, variance = _Cost(), 0, 0.0
    # The samples are written to the disk of the data set, whose folder may not exist yet.
    near = next(folder for folder in (out.resolve(), *out.resolve().parents) if folder.is_dir())
    with scratch_folder(near) as scratch:
        for group in groups:
            found = _sample(group, scratch, "cuda:0" if device == ANY_GPU else device, threads, progress)
            for cost in found:
                total = total.plus(cost, len(group) / len(found))
            samples += len(found)
            variance += len(group) ** 2 * _variance_of_mean([cost.seconds for cost in found], len(group))
    return total, samples, variance


def _sample(items: Sequence[Item], scratch: Path, device: str, threads: int | None, progress: Progress) -> list[_Cost]:
    """Return the costs of sampled recordings. The order of the items is random.

    A recording that fails is left out. If all fail, the last error is raised.
    """
    chosen, began, costs = items[:SAMPLES], time.perf_counter(), list[_Cost]()
    with limited_cpu_threads(threads):
        for count, item in enumerate(chosen, 1):
            try:
                if not costs:  # compiles the kernels
                    _cost(item, scratch, device, 1e-3)
                costs.append(_whole_cost(item, scratch, device))
            except AmiwarpError:
                if not costs and count == len(chosen):
                    raise
            progress(f"sampling {item.kind}", count / len(chosen))
            if costs and time.perf_counter() - began > SAMPLING_S:
                break
    return costs


def _variance_of_mean(values: Sequence[float], of: int) -> float:
    """Return the variance of the mean of values that were drawn from ``of`` without replacement."""
    if len(values) < 2:
        return 0.0
    return statistics.variance(values) / len(values) * (1.0 - len(values) / of)


def _whole_cost(item: Item, scratch: Path, device: str) -> _Cost:
    """Return the cost of a recording, extrapolated from two short ones if it is long."""
    whole = item.recipe.get("duration_s")
    if whole is None and item.kind in ("videos", "translated"):
        whole = simulation_of(item, device).duration_s
    if whole is None or whole <= LONGEST_SAMPLE_S:
        return _cost(item, scratch, device, None)
    short, long = (_cost(item, scratch, device, s) for s in (0.5 * LONGEST_SAMPLE_S, LONGEST_SAMPLE_S))
    slope = long.plus(short, -1.0)
    rising = _Cost(*(max(0.0, value) for value in (slope.events, slope.bytes, slope.seconds)))
    return long.plus(rising, (whole - LONGEST_SAMPLE_S) / (0.5 * LONGEST_SAMPLE_S))


def _cost(item: Item, scratch: Path, device: str, duration_s: float | None) -> _Cost:
    """Make a recording, and return its computing time and its size."""
    path = scratch / f"{item.key}.h5"
    began = time.perf_counter()
    written = write_recording(item, path, device, duration_s)
    content_digest(path, noted=False)
    cost = _Cost(written.events, path.stat().st_size, time.perf_counter() - began)
    path.unlink()
    return cost
