"""What long tasks need: CPU threads, the results of jobs in order, progress, freed memory, and postponed interrupts.

This module does not import Warp, so that file readers start fast.
"""

import contextlib
import ctypes
import gc
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self, TypeAlias, TypeVar

Result = TypeVar("Result")

_limit: int | None = None
"""Largest number of threads while :func:`limited_cpu_threads` is active."""
_of_thread = threading.local()
"""What each thread knows of itself: ``one_core``, whether it works on one core."""


def cpu_threads() -> int:
    """Return the number of CPU cores that this process may use, or 1 in a thread that works on one core."""
    return 1 if works_on_one_core() else cores()


def works_on_one_core() -> bool:
    """Return whether other threads use the other cores, so that helpers would only wait for one."""
    return getattr(_of_thread, "one_core", False)


def cores() -> int:
    """Return the number of CPU cores that this process may use."""
    available = _available_cores()
    return available if _limit is None else min(available, _limit)


def _available_cores() -> int:
    """Return the number of CPU cores that the operating system lets this process use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))  # takes a tenth of the time of cpu_count
    return os.cpu_count() or 1


@contextlib.contextmanager
def limited_cpu_threads(most: int | None) -> Iterator[None]:
    """Use at most ``most`` threads within the block, because other processes use the other cores."""
    global _limit
    before = _limit
    _limit = most
    try:
        yield
    finally:
        _limit = before


MAX_THREADS = 12
"""Largest number of threads of :func:`in_order`. More hinder each other, because they take turns to hold Python's
lock."""

EXTRA_JOBS = 2
"""Number of jobs in flight in addition to one per thread. Their results wait in memory for their turn."""


def in_order(
    jobs: Iterable[Callable[[], Result]], most: int = MAX_THREADS, *, fill_cores: bool = False
) -> Generator[Result, None, None]:
    """Run jobs in at most ``most`` parallel threads, and yield their results in the order of the jobs.

    A bounded number of jobs is in flight. The exception of a job is raised when its result is due. When the generator
    is closed, waiting jobs are dropped and running jobs are completed. With ``fill_cores``, jobs are such that each
    keeps a core busy: with a thread for each core, kernels of a job are not spread over several cores.
    """
    threads = min(cpu_threads(), most)
    waiting: deque[Future[Result]] = deque()

    def begin() -> None:
        _of_thread.one_core = fill_cores and threads == cores()

    pool = ThreadPoolExecutor(threads, thread_name_prefix="amiwarp-io", initializer=begin)
    try:
        for job in jobs:
            waiting.append(pool.submit(job))
            if len(waiting) > threads + EXTRA_JOBS:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


Progress: TypeAlias = Callable[[str, float], None]
"""Callback that gets the name of the current step, and the finished fraction of the whole task, 0 to 1."""


def part(progress: Progress, start: float, end: float) -> Progress:
    """Return the callback for a part of a task, which covers the fractions ``start`` to ``end`` of the whole."""
    return lambda what, share: progress(what, start + (end - start) * share)


def silent(what: str, share: float) -> None:
    """Ignore the progress: callback for callers that do not report progress."""


def release_memory() -> None:
    """Collect garbage, and return freed memory to the operating system.

    Objects that refer to each other in cycles are freed by the garbage collector only. glibc keeps freed memory in the
    arena of each thread until ``malloc_trim`` is called.
    """
    gc.collect()
    if sys.platform.startswith("linux"):
        with contextlib.suppress(AttributeError):  # musl has no malloc_trim
            ctypes.CDLL(None).malloc_trim(0)


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Stop the garbage collector in all threads, inside a ``with`` block. What is due then is collected at its end."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.collect(0)  # in this thread, or the next thread that allocates anything would do it
            gc.enable()


@contextlib.contextmanager
def only_new_garbage() -> Iterator[None]:
    """Make the garbage collector ignore the objects that exist now, inside a ``with`` block.

    Modules create several 100,000 objects, and to visit them all may take as long as a calibration on a GPU.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextlib.contextmanager
def interrupts_later() -> Iterator[list[int]]:
    """Postpone Ctrl-C and signals that act like it to the end of the ``with`` block; yield those that have arrived.

    Native code that calls Python, or is left half-done by an exception, cannot close its files and windows.
    """
    arrived: list[int] = []
    numbers = [
        getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
    ]
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            handler = signal.getsignal(number)
            if callable(handler):
                before[number] = handler
                signal.signal(number, lambda number, _frame: arrived.append(number))
    try:
        yield arrived
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if arrived:
            signal.raise_signal(arrived[0])


class BackgroundLoop:
    """Base of what runs :meth:`_run` in a daemon thread, from :meth:`_start_thread` until closed; a context manager."""

    def _start_thread(self, name: str) -> None:
        """Start the thread. ``name``: the thread's name."""
        self._ended = threading.Event()
        """Event on which the loop waits instead of sleeping; it ends soon after the event is set."""
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._guarded_run, name=name, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # An error of the block is the cause; what the loop then lacks would hide it.
        with contextlib.nullcontext() if kind is None else contextlib.suppress(Exception):
            self.close()

    def close(self) -> None:
        """End the loop and wait for it. Raises the error that ended it, once."""
        self._ended.set()
        self._thread.join()
        failure = self._failure
        self._failure = None
        if failure is not None:
            raise failure

    def _guarded_run(self) -> None:
        """Run the loop, and keep the error that ends it for :meth:`close`."""
        try:
            self._run()
        except Exception as error:
            self._failure = error

    def _run(self) -> None:
        """Run until :attr:`_ended` is set: what a derived class does."""
        raise NotImplementedError
