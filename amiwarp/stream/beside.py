"""What a session hands on is worked through in threads of its own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

QUEUE_EVENTS = 1 << 23
"""Room between the source and the compensator, and before a file: most of a second of the busiest sensor, 110 MB."""


class Beside:
    """Calls what is put, one after the other, in a thread of its own; while jobs of so many events wait, others do."""

    def __init__(self, most_events: int = QUEUE_EVENTS) -> None:
        self._most_events, self._held = most_events, 0
        self._jobs: deque[tuple[Callable[[], object], int]] = deque()
        self._error: BaseException | None = None
        self._ended = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="amiwarp-beside", daemon=True)
        self._thread.start()

    def put(self, job: Callable[[], object], events: int = 0) -> None:
        """Raises what a job before raised; after it none is called any more."""
        with self._changed:
            self._changed.wait_for(lambda: self._error or not self._held or self._held + events <= self._most_events)
            if self._error is not None:
                raise self._error
            self._jobs.append((job, events))
            self._held += events
            self._changed.notify_all()

    def end(self) -> None:
        """Waits until all were called."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join()

    def close(self) -> None:
        """The same; raises as :meth:`put`."""
        self.end()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._ended)
                if not self._jobs:
                    return
                job, events = self._jobs.popleft()
            try:
                job()
            except BaseException as error:
                with self._changed:
                    self._error = error
                    self._changed.notify_all()
                    return
            with self._changed:
                self._held -= events
                self._changed.notify_all()
