"""CPU threads: how many to use, and the results of jobs in order.

This module does not import Warp, so that file readers start fast.
"""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

_limit: int | None = None
"""Largest number of threads while :func:`limited_cpu_threads` is active."""


def cpu_threads() -> int:
    """Return the number of CPU cores that this process may use."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return available if _limit is None else min(available, _limit)


@contextlib.contextmanager
def limited_cpu_threads(most: int | None) -> Iterator[None]:
    """Use at most ``most`` threads within the block, because other processes use the other cores."""
    global _limit
    before, _limit = _limit, most
    try:
        yield
    finally:
        _limit = before


MAX_THREADS = 12
"""Largest number of threads of :func:`in_order`. More hinder each other, because they take turns to hold Python's
lock."""

EXTRA_JOBS = 2
"""Number of jobs in flight in addition to one per thread. Their results wait in memory for their
turn."""


def in_order(jobs: Iterable[Callable[[], Result]]) -> Generator[Result, None, None]:
    """Run jobs in parallel threads, and yield their results in the order of the jobs.

    A bounded number of jobs is in flight. The exception of a job is raised when its result is due. When the generator
    is closed, waiting jobs are dropped and running jobs are completed.
    """
    threads = min(cpu_threads(), MAX_THREADS)
    waiting: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(threads, thread_name_prefix="amiwarp-io")
    try:
        for job in jobs:
            waiting.append(pool.submit(job))
            if len(waiting) > threads + EXTRA_JOBS:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
