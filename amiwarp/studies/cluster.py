"""Workers that run the jobs of every study in parallel: a thread, local processes, or a Dask cluster by its address."""

import contextlib
import functools
import importlib.util
import logging
import os
import signal
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, TypeVar

from amiwarp.errors import AmiwarpError, ErrorCode, optional_module
from amiwarp.kernels import quiet_start
from amiwarp.studies.failures import failure_text
from amiwarp.tasks import cpu_threads, no_garbage_collection
from amiwarp.validation import whole

Job = TypeVar("Job")
Result = TypeVar("Result")

WAITING = 2
"""Number of jobs that each worker holds at a time: a running job and the next one."""
ANY_GPU = "cuda"
"""Name of the device for all CUDA GPUs: each local worker uses one of them."""
MOST_WORKERS = 4096
"""Largest number of local workers."""

WORKERS_PER_GPU = 4
"""Local workers that share a GPU by default: what they do on the CPU takes several times as long."""
LOCAL_CONFIGURATION = {
    "distributed.nanny.pre-spawn-environ": {
        "OMP_NUM_THREADS": 1,
        "MKL_NUM_THREADS": 1,
        "OPENBLAS_NUM_THREADS": 1,
    },
    "distributed.worker.profile.enabled": False,
}
"""Dask's configuration of local workers.

By default Dask also makes the allocator return memory early, which costs a quarter more processor time here, and
samples the stack of each worker and of the scheduler, which may hang with Python 3.11.
"""


@dataclass(frozen=True)
class Workers:
    """Running workers."""

    executor: Executor
    """Executor that runs its jobs on them."""
    count: Callable[[], int]
    """Function that returns the present number of workers."""


@contextlib.contextmanager
def single_worker() -> Iterator[Workers]:
    """Yield one worker, which is a thread of this process."""
    with ThreadPoolExecutor(1, thread_name_prefix="amiwarp-worker") as pool:
        yield Workers(pool, lambda: 1)


@contextlib.contextmanager
def start_workers(
    command: str, extra: str, scheduler: str | None, count: int, device: str
) -> Iterator[Workers]:
    """Yield the workers of a scheduler, or ``count`` local processes without one; a single one is a thread.

    With the device :data:`ANY_GPU`, local workers share the GPUs evenly, and each sees one, as ``cuda:0``. A local
    worker that uses more than its share of the memory is restarted. ``command`` and ``extra`` are the names of the
    command and of its optional dependency for messages. Raises :class:`AmiwarpError` if Dask is not installed or the
    scheduler does not answer.
    """
    if scheduler is None and count == 1:
        with single_worker() as alone:
            yield alone
        return
    distributed = optional_module("distributed", extra, f"'{command}' needs Dask")
    with contextlib.ExitStack() as stack:
        where: Any = scheduler
        if scheduler is None:
            stack.enter_context(importlib.import_module("dask").config.set(LOCAL_CONFIGURATION))
            where = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    dashboard_address="127.0.0.1:0",
                    memory_limit=distributed.system.MEMORY_LIMIT // count,
                    silence_logs=logging.CRITICAL,  # a worker that dies is reported by the executor
                )
            )
        try:
            client = stack.enter_context(distributed.Client(where, timeout=20))
        except (OSError, ValueError) as error:
            if scheduler is None:
                raise AmiwarpError(
                    f"the workers on this machine do not start ({error}); give fewer of them"
                ) from error
            raise AmiwarpError(
                f"--scheduler {scheduler}: no Dask scheduler answers at this address ({error}); "
                "start one with: dask scheduler",
                ErrorCode.UNREACHABLE,
            ) from error
        gpus = _visible_gpus() if scheduler is None and device == ANY_GPU else ()
        client.register_worker_callbacks(functools.partial(_prepare, gpus, scheduler is None))
        yield Workers(stack.enter_context(client.get_executor()), lambda: len(client.nthreads()))


def _visible_gpus() -> tuple[str, ...]:
    """Return the GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    count = gpu_count(quiet_start.start_quietly())
    return tuple(given.split(",")[:count]) if given else tuple(map(str, range(count)))


def worker_count(workers: int | None, device: str, bytes_each: int = 0) -> int:
    """Return the number of local workers; by default one for each core, or :data:`WORKERS_PER_GPU` for each GPU.

    A GPU does not get more of them than it has cores, nor the machine more than its memory has ``bytes_each`` for.
    """
    if workers is not None:
        return whole(workers, "workers", 1, MOST_WORKERS)
    if device == ANY_GPU:
        gpus = max(1, gpu_count(quiet_start.start_quietly()))
        count = gpus * min(WORKERS_PER_GPU, max(1, cpu_threads() // gpus))
    else:
        count = cpu_threads() if device == "cpu" else 1
    if bytes_each and count > 1 and importlib.util.find_spec("distributed"):
        count = max(
            1, min(count, importlib.import_module("distributed.system").MEMORY_LIMIT // bytes_each)
        )
    return count


def threads_of_worker(device: str, workers: int | None) -> int | None:
    """Return the number of CPU threads of each of ``workers`` local workers; None for all, in a cluster.

    On the CPU each worker runs on one thread. Workers with a GPU share the cores, which encode and write the events.
    """
    if device == "cpu":
        return 1
    return None if workers is None else max(1, cpu_threads() // workers)


def gpu_count(devices: Iterable[str]) -> int:
    """Return the number of CUDA GPUs among the names of Warp's devices."""
    return sum(name.startswith("cuda") for name in devices)


def _prepare(gpus: tuple[str, ...], local: bool, dask_worker: Any) -> None:
    """Prepare a worker: choose its GPU and start Warp. A local worker also leaves Ctrl-C to its parent process."""
    if gpus:  # before CUDA starts in this process
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[int(dask_worker.name) % len(gpus)]
    if local:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    # An earlier command may have prepared this worker already.
    if sys.version_info < (3, 12) and not hasattr(sys._current_frames, "__wrapped__"):
        sys._current_frames = _without_collection(sys._current_frames)
    quiet_start.start_quietly()


def _without_collection(function: Callable[[], Result]) -> Callable[[], Result]:
    """Return a function during which no garbage is collected.

    Dask samples the stacks of a worker by ``sys._current_frames``. If Python 3.11 collects garbage meanwhile, and
    another thread ends, both wait for each other for ever (issue 106883 of CPython).
    """

    @functools.wraps(function)
    def call() -> Result:
        with no_garbage_collection():
            return function()

    return call


def run_jobs(
    workers: Workers, function: Callable[[Job], Result], jobs: Iterable[Job]
) -> Generator[tuple[Job, Future[Result]], None, None]:
    """Yield each job and its finished future, in the order in which they finish.

    Only a few jobs for each worker are given out at a time, so that memory use does not depend on their number. When
    the generator is closed, jobs that did not begin are cancelled.
    """
    waiting: dict[Future[Result], Job] = {}
    left = iter(jobs)
    try:
        while True:
            for job in left:
                waiting[workers.executor.submit(function, job)] = job
                if len(waiting) >= WAITING * max(1, workers.count()):
                    break
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future
    finally:
        for future in waiting:
            future.cancel()


def failure_of(future: Future[Any]) -> str:
    """Return why a finished job has no result, as one line of text; empty if it has one.

    Raises :class:`AmiwarpError` if the scheduler stopped or dropped the job, because no other job can run then.
    """
    if future.cancelled():
        raise AmiwarpError(
            "the scheduler stopped or dropped the work; run the same command again to continue",
            ErrorCode.UNREACHABLE,
        )
    error = future.exception()
    if error is None:
        return ""
    if isinstance(error, KeyboardInterrupt):
        raise error
    if type(error).__name__ == "KilledWorker":  # of Dask, which need not be installed
        return f"its worker died, out of memory or killed: {failure_text(error)}"
    return failure_text(error)
