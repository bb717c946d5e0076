"""Threads for background work, and for the jobs of one launch on the CPU, as Warp runs each launch on one thread.

Background work has two kinds of worker: a job with a result runs in a pool, and a loop that runs until it is closed has
a daemon thread of its own. The helpers are a pool that hands over faster, for the jobs of one launch.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from queue import SimpleQueue
from threading import Lock, Thread

from amiwarp.tasks import cores, works_on_one_core

_Job = tuple[Callable[[], object], "SimpleQueue[BaseException | None]"]
"""Function to run, and the queue that gets its error, or None."""


@cache
def pool() -> ThreadPoolExecutor:
    """Return the shared thread pool for CPU launches, with one thread per core."""
    return ThreadPoolExecutor(cores(), thread_name_prefix="amiwarp")


class _Helpers:
    """Threads that run jobs for other threads. A ``ThreadPoolExecutor`` would take three times as long to hand over."""

    def __init__(self) -> None:
        """Start without threads."""
        self._jobs: SimpleQueue[_Job] = SimpleQueue()
        self._threads = 0
        self._starting = Lock()

    def put(self, jobs: list[_Job]) -> None:
        """Queue jobs, for at least as many threads."""
        with self._starting:
            while self._threads < len(jobs):
                name = f"amiwarp-helper-{self._threads}"
                Thread(target=self._work, name=name, daemon=True).start()
                self._threads += 1
        for job in jobs:
            self._jobs.put(job)

    def _work(self) -> None:
        while True:
            job, done = self._jobs.get()
            error = None
            try:
                job()
            except BaseException as raised:
                error = raised
            done.put(error)
            del job, done, error  # so that their arrays are freed while the thread waits


_helpers = cache(_Helpers)


def run_together(jobs: Sequence[Callable[[], object]]) -> None:
    """Run jobs at the same time, the first one in this thread, and wait for all of them.

    A job must not call this function. In a thread that works on one core, they run one after the other.
    """
    if works_on_one_core():
        for job in jobs:
            job()
        return
    done: SimpleQueue[BaseException | None] = SimpleQueue()
    if len(jobs) > 1:
        _helpers().put([(job, done) for job in jobs[1:]])
    try:
        jobs[0]()
    finally:
        errors = [done.get() for _ in jobs[1:]]
    for error in errors:
        if error is not None:
            raise error


@cache
def background_worker() -> ThreadPoolExecutor:
    """Return the shared background worker: a pool of one thread, which keeps the order of its jobs."""
    return ThreadPoolExecutor(1, thread_name_prefix="amiwarp-background-worker")


if hasattr(os, "register_at_fork"):  # a fork has none of the threads
    for _started in (pool, _helpers, background_worker):
        os.register_at_fork(after_in_child=_started.cache_clear)
