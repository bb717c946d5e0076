"""Estimate of the size of a data set and of the time to make it, from short samples of its recordings."""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from amiwarp.errors import AmiwarpError
from amiwarp.io.unfinished import scratch_folder
from amiwarp.learning.dataset import specification as spec
from amiwarp.learning.dataset import worker
from amiwarp.learning.dataset.drawn_rig import shortest_sample_s
from amiwarp.learning.dataset.files import Journal, check_folder
from amiwarp.learning.dataset.items import Item, list_items, sources_of_splits
from amiwarp.learning.dataset.randomise import drawn_ranges
from amiwarp.learning.dataset.stored import remove_stored, stored_bytes, stored_digest
from amiwarp.learning.dataset.worker import simulation_of
from amiwarp.schema.calls import guarded
from amiwarp.studies import cluster
from amiwarp.studies.failures import noted
from amiwarp.tasks import Progress, limited_cpu_threads, silent

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
    ...     events=1e6, size_bytes=1e7, worker_seconds=30.0, workers=2, device="cpu",
    ...     sources_of_splits={"all sources": {"train": 2}})
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
    uncertainty: float | None
    """Standard error of the expected time, relative to it, from the spread of the samples.

    None if a kind of source has only one sample, so that its spread is unknown.
    """
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
    sources_of_splits: Mapping[str, Mapping[str, int]]
    """Number of different sources of each split, by the class whose sources the splits share, such as
    ``class = 'disc'``; an empty text for sources whose splits are drawn."""
    drawn: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Least, median and largest value of each randomised setting in the recordings, by its name."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """Error message of each sample that could not be made, by its file. The estimate leaves these samples out."""

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
            self.events + times * other.events,
            self.bytes + times * other.bytes,
            self.seconds + times * other.seconds,
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
        Number of workers. By default one for each core, or up to four for each GPU.
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
        If the specification is wrong, a source is not found, or no sample of a kind of source can be made.

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
    loaded = spec.load_specification(specification)
    items = list_items(loaded)
    check_folder(out)
    journal = Journal(out)
    todo = sorted((item for item in items if not journal.is_there(item)), key=lambda item: item.key)
    by_kind: defaultdict[str, list[Item]] = defaultdict(list)
    for item in todo:
        by_kind[item.kind].append(item)
    count = cluster.worker_count(workers, device)
    threads = cluster.threads_of_worker(device, count)
    failed: dict[str, str] = {}
    groups = list(by_kind.values())
    total, samples, variance = _sample_all(groups, out, device, threads, progress or silent, failed)
    return DatasetPlan(
        recordings=len(items),
        missing=len(todo),
        splits=dict(Counter(item.split for item in items)),
        sources=dict(Counter(item.kind for item in items)),
        samples=samples,
        uncertainty=_relative_error(variance, total.seconds),
        events=total.events,
        size_bytes=total.bytes,
        worker_seconds=total.seconds,
        workers=count,
        device=device,
        sources_of_splits=sources_of_splits(loaded, items),
        drawn=drawn_ranges([item.drawn for item in items]),
        failed=failed,
    )


def _sample_all(
    groups: Sequence[Sequence[Item]],
    out: Path,
    device: str,
    threads: int | None,
    progress: Progress,
    failed: dict[str, str],
) -> tuple[_Cost, int, float]:
    """Return the expected cost of all recordings, the number of samples, and the variance of the expected time [s²].

    The variance is infinite if a group has only one sample.

    Each group holds the recordings of one kind of source. Samples that cannot be made are noted in ``failed``.
    """
    total = _Cost()
    samples = 0
    variance = 0.0
    # The samples are written to the disk of the data set, whose folder may not exist yet.
    near = next(folder for folder in (out.resolve(), *out.resolve().parents) if folder.is_dir())
    with scratch_folder(near) as scratch:
        for group in groups:
            one_device = "cuda:0" if device == cluster.ANY_GPU else device
            sample = _sample(group, scratch, one_device, threads, progress, failed)
            for cost in sample:
                total = total.plus(cost, len(group) / len(sample))
            samples += len(sample)
            variance += len(group) ** 2 * _variance_of_mean([cost.seconds for cost in sample])
    return total, samples, variance


def _sample(
    items: Sequence[Item],
    scratch: Path,
    device: str,
    threads: int | None,
    progress: Progress,
    failed: dict[str, str],
) -> list[_Cost]:
    """Return the costs of sampled recordings. The order of the items is random.

    A recording that fails is noted in ``failed`` and left out. Raises :class:`AmiwarpError` if all fail.
    """
    chosen = items[:SAMPLES]
    began = time.perf_counter()
    costs = list[_Cost]()
    with limited_cpu_threads(threads):
        for count, item in enumerate(chosen, 1):
            with noted(failed, item.file):
                if not costs:  # compiles the kernels
                    _cost(item, scratch, device, max(1e-3, shortest_sample_s(item)))
                costs.append(_whole_cost(item, scratch, device))
            if not costs and count == len(chosen):
                raise AmiwarpError(
                    f"no sample of {item.kind} can be made; {item.file}: {failed[item.file]}"
                )
            progress(f"sampling {item.kind}", count / len(chosen))
            if costs and time.perf_counter() - began > SAMPLING_S:
                break
    return costs


def _variance_of_mean(values: Sequence[float]) -> float:
    """Return the variance of the mean of measured values; infinite for one value, whose spread is unknown.

    There is no correction for recordings that are all sampled: making one again takes another time.
    """
    if len(values) < 2:
        return math.inf
    return statistics.variance(values) / len(values)


def _relative_error(variance: float, seconds: float) -> float | None:
    """Return the standard error relative to the expected time; None if the variance is unknown."""
    if math.isinf(variance):
        return None
    return math.sqrt(variance) / seconds if seconds else 0.0


def _whole_cost(item: Item, scratch: Path, device: str) -> _Cost:
    """Return the cost of a recording, extrapolated from two short ones if it is long."""
    whole = item.recipe.get("duration_s")
    if whole is None and item.kind in ("videos", "translated"):
        whole = simulation_of(item, device).duration_s
    half = max(0.5 * LONGEST_SAMPLE_S, shortest_sample_s(item))
    if whole is None or whole <= 2.0 * half:
        return _cost(item, scratch, device, None)
    short = _cost(item, scratch, device, half)
    long = _cost(item, scratch, device, 2.0 * half)
    slope = long.plus(short, -1.0)
    rising = _Cost(max(0.0, slope.events), max(0.0, slope.bytes), max(0.0, slope.seconds))
    return long.plus(rising, (whole - 2.0 * half) / half)


def _cost(item: Item, scratch: Path, device: str, duration_s: float | None) -> _Cost:
    """Make a recording, and return its computing time and its size."""
    path = scratch / Path(item.file).name
    began = time.perf_counter()
    events, *_ = worker.write_recording(item, path, device, duration_s)
    stored_digest(path, item.cameras)
    seconds = time.perf_counter() - began
    cost = _Cost(events, stored_bytes(path, item.cameras) or 0, seconds)
    remove_stored(path, item.cameras)
    return cost
