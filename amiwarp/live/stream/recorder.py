"""Recording of a stream that one looks at: from a moment on, everything that it delivers goes to a file."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.io.native.live_writer import LiveWriter

Samples = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Times [us] and angles [rad] of encoder samples, each of shape ``(n,)``."""


class StreamRecorder:
    """Saves a stream with the writer of ``amiwarp record``, while one thread delivers and others start and stop it."""

    def __init__(self, writer: Callable[[Path], LiveWriter]) -> None:
        """``writer``: function that returns the writer of a file."""
        self.problem = ""
        """Why the last recording has ended by itself; empty if it has not."""
        self._make = writer
        self._lock = threading.Lock()
        self._writer: LiveWriter | None = None
        self._open = ExitStack()

    @property
    def text(self) -> str:
        """Name of the file that is being written, and its number of events; empty if there is none."""
        with self._lock:
            return (
                ""
                if self._writer is None
                else f"{self._writer.path.name}: {len(self._writer):,} events"
            )

    def start(self, path: Path, samples: Iterable[tuple[bool, Samples]]) -> None:
        """Begin a new file.

        ``samples``: encoder samples that have come already, of events that have not; whether they belong to the
        second encoder, and times and angles. Raises :class:`AmiwarpError` if a recording runs, or the file cannot be
        made.
        """
        with self._lock:
            if self._writer is not None:
                raise AmiwarpError(f"{self._writer.path}: is being recorded; stop it first")
            self._writer = self._open.enter_context(self._make(path))
            self.problem = ""
            try:
                for second, (t_us, angle) in samples:
                    self._writer.append_encoder(t_us, angle, second=second)
            except (AmiwarpError, OSError) as error:
                self._finish(str(error))
                raise

    def stop(self, problem: str = "") -> str:
        """Finish the file, and return a text about it; empty if nothing is recorded. ``problem``: why it ends."""
        with self._lock:
            return self._finish(problem)

    def append(self, events: Events) -> None:
        """Write events of the sensor."""
        self._write(lambda writer: writer.append(events))

    def append_encoder(
        self,
        t_us: NDArray[np.int64],
        angle: NDArray[np.float64],
        index_t_us: NDArray[np.int64],
        *,
        second: bool,
    ) -> None:
        """Write encoder samples and index pulses, on the events' clock."""
        self._write(lambda writer: writer.append_encoder(t_us, angle, index_t_us, second=second))

    def tick(self) -> None:
        """Write what waits, also while nothing arrives."""
        self._write(lambda writer: writer.tick())

    def _write(self, write: Callable[[LiveWriter], None]) -> None:
        """Write to the file, if there is one. An error ends the recording, and the stream goes on."""
        with self._lock:
            if self._writer is None:
                return
            try:
                write(self._writer)
            except (AmiwarpError, OSError) as error:
                self._finish(str(error))

    def _finish(self, problem: str) -> str:
        if self._writer is None:
            return ""
        writer = self._writer
        self._writer = None
        self.problem = problem
        try:
            self._open.close()
        except (AmiwarpError, OSError) as error:
            self.problem = problem or str(error)
        return f"{writer.path}: {len(writer):,} events"
