"""What a session hands on is worked through in threads of its own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from amiwarp.compensation.streams import OVERHEAD

QUEUE_BYTES = 1 << 27
"""Room between the source and the compensator, and before each file or server [bytes]: about eight million events."""
LAST_JOB_S = 5.0
"""Longest wait for the job at work when the others are given up."""


class BackgroundWorker:
    """Runs jobs one after the other in a background thread. :meth:`put` waits while ``most_bytes`` of them are held.

    Each job counts for the bytes it is put with and :data:`~amiwarp.compensation.streams.OVERHEAD`, so that jobs
    without events are bounded too. A single job larger than the bound still passes, alone.
    """

    def __init__(self, most_bytes: int = QUEUE_BYTES) -> None:
        self._most_bytes = most_bytes
        self.held_bytes = 0
        """Memory that the jobs take that wait or are at work [bytes]."""
        self._jobs: deque[tuple[Callable[[], object], int]] = deque()
        self._error: BaseException | None = None
        self._ended = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="amiwarp-beside", daemon=True)
        self._thread.start()

    def put(self, job: Callable[[], object], held_bytes: int = 0) -> None:
        """Add a job, once there is room. Raises what an earlier job raised; after that no job runs any more."""
        count = OVERHEAD + held_bytes
        with self._changed:
            self._changed.wait_for(
                lambda: self._error or not self.held_bytes or self.held_bytes + count <= self._most_bytes
            )
            if self._error is not None:
                raise self._error
            self._jobs.append((job, count))
            self.held_bytes += count
            self._changed.notify_all()

    def end(self) -> None:
        """Wait until all jobs have run."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join()

    def abandon(self) -> None:
        """Drop the jobs that wait, and wait for the job at work, at most :data:`LAST_JOB_S`."""
        with self._changed:
            self._ended = True
            self._jobs.clear()
            self._changed.notify_all()
        self._thread.join(LAST_JOB_S)

    def close(self) -> None:
        """Wait as :meth:`end` does; raises as :meth:`put`."""
        self.end()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._ended)
                if not self._jobs:
                    return
                job, count = self._jobs.popleft()
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
