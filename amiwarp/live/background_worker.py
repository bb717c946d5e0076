"""Background thread that runs a session's jobs for a file, server or other consumer.

Not the pool of ``kernels/launch.py``: it waits while its jobs hold too much memory, and can drop the waiting ones.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable

from amiwarp.events.recording import OVERHEAD

QUEUE_BYTES = 1 << 27
"""Memory limit of the queue before the compensator, and of each consumer's queue [bytes]: about 8 million events."""
LAST_JOB_S = 5.0
"""Longest wait for the running job after the waiting jobs were dropped [s]."""


class BackgroundWorker:
    """Runs jobs in order in a background thread. :meth:`put` blocks while the jobs hold ``most_bytes`` of memory.

    A job's memory is the given number plus :data:`~amiwarp.events.recording.OVERHEAD`, so that the number of jobs
    without events is limited too. A single job larger than the limit runs alone.
    """

    def __init__(self, most_bytes: int = QUEUE_BYTES) -> None:
        self._most_bytes = most_bytes
        self.held_bytes = 0
        """Memory of the waiting and running jobs [bytes]."""
        self.dropped = 0
        """Number of events of jobs that were dropped by :meth:`abandon`."""
        self._jobs: deque[tuple[Callable[[], object], int, int]] = deque()
        self._error: BaseException | None = None
        self._ended = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="amiwarp-worker", daemon=True)
        self._thread.start()

    def put(self, job: Callable[[], object], held_bytes: int = 0, events: int = 0) -> None:
        """Add a job once memory allows. ``events``: number of events that are lost if the job is dropped.

        Raises the error of an earlier job; after an error no job runs.
        """
        count = OVERHEAD + held_bytes
        with self._changed:
            self._changed.wait_for(
                lambda: (
                    self._error
                    or not self.held_bytes
                    or self.held_bytes + count <= self._most_bytes
                )
            )
            if self._error is not None:
                raise self._error
            self._jobs.append((job, count, events))
            self.held_bytes += count
            self._changed.notify_all()

    def end(self) -> None:
        """Run all waiting jobs and stop the thread."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join()

    def abandon(self) -> None:
        """Drop the waiting jobs, and wait for the running job for at most :data:`LAST_JOB_S`."""
        with self._changed:
            self._ended = True
            self.dropped += sum(events for _, _, events in self._jobs)
            self._jobs.clear()
            self._changed.notify_all()
        self._thread.join(LAST_JOB_S)

    def close(self, most_s: float = math.inf) -> None:
        """Run the waiting jobs for at most ``most_s`` [s], drop the rest, and stop the thread.

        Raises the error of a job that failed.
        """
        if math.isinf(most_s):
            self.end()
        else:
            with self._changed:
                self._ended = True
                self._changed.notify_all()
            self._thread.join(most_s)
            self.abandon()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._ended)
                if not self._jobs:
                    return
                job, count, _ = self._jobs.popleft()
            try:
                job()
            except BaseException as error:
                with self._changed:
                    self._error = error
                    self._jobs.clear()
                    self._changed.notify_all()
                    return
            with self._changed:
                self.held_bytes -= count
                self._changed.notify_all()
