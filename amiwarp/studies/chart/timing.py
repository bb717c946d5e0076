"""Timing of settings in rounds, so that a machine that is slow for a while can be allowed for."""

from __future__ import annotations

import random
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amiwarp.studies.chart.rows import Row
from amiwarp.studies.failures import failure_text
from amiwarp.tasks import Progress, only_new_garbage, release_memory


@dataclass(frozen=True)
class Task:
    """Setting to measure: the function that runs it, and the fields of its row."""

    run: Callable[[], Any]
    """Function to measure; it returns when the device has finished."""
    events: int
    """Number of events that one run processes."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the row that do not depend on the measurement."""
    keep: Callable[[Any], Any] = lambda result: result
    """Function that returns the part of a result to keep; its time does not count."""


@dataclass(frozen=True)
class Timed:
    """Times of a task, and the kept result of its first timed run."""

    task: Task
    """The compensation or calibration that was timed."""
    times: tuple[float, ...]
    """Times of the repeated runs [s]."""
    slowness: tuple[float, ...]
    """How slow the machine was in the round of each run; 1 is usual."""
    result: Any
    """Part of the first timed run's result that was kept."""
    failure: str = ""
    """Error that a run raised, with its place; empty if none did."""

    def row(self, error_px: float, **more: Any) -> Row:
        """Return the row of the measured setting, with its error and further fields."""
        usual = [seconds / slow for seconds, slow in zip(self.times, self.slowness, strict=True)]
        median = statistics.median(usual)
        spread = (max(self.times) - min(self.times)) / median
        return Row(
            **self.task.fields,
            events=self.task.events,
            seconds=median,
            spread=spread,
            repeats=len(self.times),
            error_px=error_px,
            **more,
        )


@only_new_garbage()
def measure(
    tasks: Sequence[Task],
    repeats: int,
    progress: Progress,
    what: str,
    *,
    warm_up: bool = True,
    limit_s: float = 180.0,
    rest_s: float = 0.0,
    release: bool = False,
    again: Callable[[Sequence[Timed]], Sequence[bool]] | None = None,
) -> list[Timed]:
    """Measure all tasks in rounds, so that a temporary slowdown of the machine affects all of them and can be removed.

    Each timed round after the first has another order, because a run may depend on the one before it.
    A task that raises an error is not run again; the others go on. ``warm_up`` adds an untimed first round, in which
    kernels are compiled. No new round begins after ``limit_s`` [s]. ``rest_s`` [s] is a pause before each run, in which
    threads of the previous run may still be busy. ``again`` decides from tasks that were timed once which of them to
    repeat. Memory that earlier work freed is released first; with ``release`` before each run, for runs that need much
    memory. All runs then start with an equally empty heap.
    """
    release_memory()
    # By the number of the task
    times: list[list[float]] = [[] for _ in tasks]
    results: list[Any] = [None] * len(tasks)
    repeated: Sequence[bool] = [True] * len(tasks)
    failed: dict[int, str] = {}

    first_timed = 1 if warm_up else 0
    rounds = repeats + first_timed
    began = time.perf_counter()
    order = list(enumerate(tasks))
    rng = random.Random(0)
    for turn in range(rounds):
        if turn > first_timed:
            if time.perf_counter() - began > limit_s:
                break
            if turn == first_timed + 1 and again is not None:
                repeated = again(_timed(tasks, times, results, failed))
            rng.shuffle(order)
        for done, (number, task) in enumerate(order):
            if not repeated[number] or number in failed:
                continue
            if release:
                release_memory()
            time.sleep(rest_s)
            try:
                start = time.perf_counter()
                result = task.run()
                seconds = time.perf_counter() - start
                if turn == first_timed:
                    results[number] = task.keep(result)
                if turn >= first_timed:
                    times[number].append(seconds)
            except Exception as error:
                failed[number] = failure_text(error)
            progress(what, (turn * len(tasks) + done + 1) / (rounds * len(tasks)))
    return _timed(tasks, times, results, failed)


def _timed(
    tasks: Sequence[Task], times: list[list[float]], results: list[Any], failed: Mapping[int, str]
) -> list[Timed]:
    """Return the tasks together with their times and results, or with their failures, by the number of the task."""
    slow = slowness([seconds for number, seconds in enumerate(times) if number not in failed])
    timed = []
    for number, task in enumerate(tasks):
        if number in failed:
            timed.append(Timed(task, (), (), None, failed[number]))
        else:
            seconds = times[number]
            timed.append(Timed(task, tuple(seconds), slow[: len(seconds)], results[number]))
    return timed


def slowness(times: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """Return how slow the machine was in each round; 1 is usual.

    ``times``: run times of each task [s]. Tasks that were not repeated in every round do not count. The slowness of a
    round is the median over tasks of the run time relative to the task's median.
    """
    rounds = max(map(len, times), default=0)
    if rounds == 0:
        return ()
    whole = np.array([seconds for seconds in times if len(seconds) == rounds])
    relative = whole / np.median(whole, axis=1, keepdims=True)
    return tuple(np.median(relative, axis=0).tolist())


def measured_row(
    timed: Timed, failed: dict[str, str], error: Callable[[], tuple[float, float | None]]
) -> Row | None:
    """Return the row of a measured setting; None if it failed, which is noted in ``failed`` by its label.

    ``error`` returns the row's error [px] and the error of its image.
    """
    label = str(timed.task.fields["label"])
    if timed.failure:
        failed[label] = timed.failure
        return None
    try:
        error_px, image_error = error()
        return timed.row(error_px, image_error=image_error)
    except Exception as raised:
        failed[label] = failure_text(raised)
        return None
