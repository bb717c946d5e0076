"""Rows of a chart: what was run, how long it took, how far off it was; the Pareto front, and answers to a budget."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

"""Called with what is being done and the share of it that is."""

ALIKE = 0.05
"""Times that differ by a smaller share are taken for equal: so much they differ from run to run."""
HOPELESS = 0.7
"""What another beats in so small a share of its time, and in error too, no repeat brings to a front."""
ALIKE_PX = 0.003
"""Errors that differ by less are taken for equal: another seed of the noise would turn them round."""


@dataclass(frozen=True)
class Row:
    """One setting, with the speed and the error of the same run."""

    chart: str
    """"compensation" or "calibration"."""
    job: str
    """Rows of one job do the same work, so that one front holds them all."""
    label: str
    family: str
    """What the colour tells."""
    mark: str
    """What the marker's shape tells."""
    settings: Mapping[str, Any]
    events: int
    """Of the recording that was worked through, whatever share of them was used."""
    seconds: float
    """Median of the repeats."""
    spread: float
    """Longest less shortest repeat, over the median."""
    repeats: int
    error_px: float
    """[px rms]."""
    image_error: float | None = None
    """Rms difference of the run's image from the float64 one, over that one's standard deviation."""
    default: bool = False
    """What the commands do unless told otherwise."""
    comparable: bool = True
    """Rows that pay in noise, or need a guess, stand beside the front."""

    @property
    def mev_per_s(self) -> float:
        """Million events of the recording a second."""
        return self.events / self.seconds / 1e6

    @property
    def cost(self) -> float:
        """Time per event [s]: the less the better."""
        return self.seconds / self.events


@dataclass(frozen=True)
class Task:
    """A row to be: what to run, and the row's fixed fields."""

    run: Callable[[], Any]
    """Returns once the device is done."""
    events: int
    """Worked through by one run."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    keep: Callable[[Any], Any] = lambda result: result
    """What is kept of a run, off the clock."""


@dataclass(frozen=True)
class Timed:
    """A task's times and what was kept of its first timed run; the others do the same work."""

    task: Task
    times: tuple[float, ...]
    result: Any

    def row(self, error_px: float, **more: Any) -> Row:
        median = statistics.median(self.times)
        spread = (max(self.times) - min(self.times)) / median
        return Row(**self.task.fields, events=self.task.events, seconds=median, spread=spread,
                   repeats=len(self.times), error_px=error_px, **more)  # fmt: skip


def measure(
    tasks: Sequence[Task],
    repeats: int,
    tell: Callable[[float], None],
    *,
    warm_up: bool = True,
    limit_s: float = 180.0,
    rest_s: float = 0.0,
    again: Callable[[Sequence[Timed]], Sequence[bool]] | None = None,
) -> list[Timed]:
    """Times of all tasks, taken round-robin: what slows the machine for a while slows all of them.

    ``warm_up``: a first round, in which kernels are compiled, is left out. No new round begins after ``limit_s``.
    ``rest_s``: before each run, where threads of the one before may still spin. ``again``: of tasks timed once, which
    to repeat.
    """
    times: list[list[float]] = [[] for _ in tasks]
    results: list[Any] = [None] * len(tasks)
    worth: Sequence[bool] = [True] * len(tasks)
    rounds, began = repeats + int(warm_up), time.perf_counter()
    for turn in range(rounds):
        if turn > int(warm_up) and time.perf_counter() - began > limit_s:
            break
        if turn == int(warm_up) + 1 and again is not None:
            worth = again(_timed(tasks, times, results))
        for k, task in enumerate(tasks):
            if not worth[k]:
                continue
            time.sleep(rest_s)
            start = time.perf_counter()
            result = task.run()
            took = time.perf_counter() - start
            results[k] = task.keep(result) if turn == int(warm_up) else results[k]
            if turn >= int(warm_up):
                times[k].append(took)
            tell((turn * len(tasks) + k + 1) / (rounds * len(tasks)))
    return _timed(tasks, times, results)


def _timed(tasks: Sequence[Task], times: list[list[float]], results: list[Any]) -> list[Timed]:
    return [Timed(task, tuple(each), result) for task, each, result in zip(tasks, times, results, strict=True)]


def front(rows: Sequence[Row]) -> list[Row]:
    """The Pareto front, fastest first: nothing is faster and at least as accurate."""
    best, chosen = float("inf"), []
    for row in sorted((r for r in rows if r.comparable), key=lambda r: (r.cost, r.error_px)):
        if row.error_px < best:
            best = row.error_px
            chosen.append(row)
    return chosen


def fronts(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Each job's front."""
    for job in dict.fromkeys(row.job for row in rows):
        yield job, front([row for row in rows if row.job == job])


def told_apart(chosen: Sequence[Row]) -> list[Row]:
    """Of a front, fastest first, what is clearly faster than the next more accurate; and the default."""
    kept: list[Row] = []
    for row in reversed(chosen):
        if not kept or row.default or row.cost < kept[-1].cost * (1.0 - ALIKE):
            kept.append(row)
    return kept[::-1]


def beaten_by(row: Row, rows: Sequence[Row]) -> list[Row]:
    """Rows of the same job that are clearly better in one and no worse in the other."""
    out = []
    for other in rows:
        if other.job != row.job or not other.comparable:
            continue
        faster, slower = other.cost < row.cost * (1.0 - ALIKE), other.cost > row.cost
        nearer, further = other.error_px < row.error_px - ALIKE_PX, other.error_px > row.error_px
        if (faster and not further) or (nearer and not slower):
            out.append(other)
    return out


def near_front(rows: Sequence[Row | None]) -> list[bool]:
    """Whether a row may be on the front after all, once its time is known better; the default always counts."""
    there = [row for row in rows if row is not None]

    def hopeful(row: Row) -> bool:
        return row.default or all(
            other.cost > row.cost * HOPELESS or other.error_px > row.error_px for other in there if other.comparable
        )

    return [row is not None and hopeful(row) for row in rows]


def fastest_within(rows: Sequence[Row], error_px: float) -> Row | None:
    """The fastest row within an error; of those as fast, the most accurate."""
    within = [r for r in rows if r.comparable and r.error_px <= error_px]
    if not within:
        return None
    limit = min(r.cost for r in within) * (1.0 + ALIKE)
    return min((r for r in within if r.cost <= limit), key=lambda r: r.error_px)


def most_accurate_within(rows: Sequence[Row], seconds: float) -> Row | None:
    """The most accurate row within a time; of those as accurate, the fastest."""
    within = [r for r in rows if r.comparable and r.seconds <= seconds]
    if not within:
        return None
    limit = min(r.error_px for r in within) + ALIKE_PX
    return min((r for r in within if r.error_px <= limit), key=lambda r: r.cost)
