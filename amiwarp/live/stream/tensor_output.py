"""Tensors of a live stream for a file or an address, made in a background thread."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from types import TracebackType

from amiwarp.compensation.streams import Compensated
from amiwarp.events.recording import Events, held_bytes
from amiwarp.imaging.tensor_stream import StreamTensor, TensorStream
from amiwarp.live.background_worker import BackgroundWorker


class TensorOutput:
    """Takes the packets of a session, and gives tensors to ``give``, in a background thread.

    A session waits for it while much waits. Close it before what ``give`` writes to.
    """

    def __init__(self, stream: TensorStream, give: Callable[[StreamTensor], None]) -> None:
        self._stream = stream
        self._give = give
        self._worker = BackgroundWorker()
        self._closed = False
        self.made = 0
        """Number of tensors that were made."""
        self.events = 0
        """Number of events in them."""

    def __enter__(self) -> TensorOutput:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._worker.abandon()

    def __call__(self, packet: Compensated) -> None:
        """Add a packet. Raises the error of an earlier one."""
        events = packet.events
        self._worker.put(partial(self._put, events), held_bytes(events), len(events))

    @property
    def dropped(self) -> int:
        """Number of events that were dropped at the end of the stream."""
        return self._worker.dropped

    def later(self, job: Callable[[], object]) -> None:
        """Run a job in the thread, after the waiting packets. Raises the error of an earlier packet."""
        self._worker.put(job)

    def close(self, most_s: float = math.inf) -> None:
        """Make the last tensors for at most ``most_s`` [s], drop and count the rest, and end the thread.

        Raises the error of the thread.
        """
        if self._closed:
            return
        self._closed = True
        self._worker.put(self._finish)
        self._worker.close(most_s)

    def _put(self, events: Events) -> None:
        for found in self._stream.put(events):
            self._take(found)

    def _finish(self) -> None:
        found = self._stream.finish()
        if found is not None:
            self._take(found)

    def _take(self, found: StreamTensor) -> None:
        self.made += 1
        self.events += found.events
        self._give(found)
