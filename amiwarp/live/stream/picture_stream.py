"""Pictures of a live stream, made in a background thread."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, held_bytes
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.reconstruction.phase_camera import LivePicture, PhaseCamera
from amiwarp.tasks import BackgroundLoop

MOST_BYTES = 1 << 26
"""Memory of the data that wait for the thread [bytes]. With more, the stream waits."""
POLL_S = 0.05
"""Longest wait for data between two looks at those that wait for encoder samples [s]."""
MOST_LATENCIES = 100_000
"""Number of latest pictures whose latency is kept."""
MOST_ARRIVALS = 100_000
"""Number of latest packets whose arrival is kept: 100 s of packets of 1 ms. A prism that stands makes no picture."""


class PictureStream(BackgroundLoop):
    """Makes pictures of a stream: a consumer of the sensor's events and of encoder samples.

    The thread calls ``give`` with each picture. With ``newest`` it leaves out pictures for which this computer is too
    slow; without, the stream waits.
    """

    def __init__(
        self, camera: PhaseCamera, give: Callable[[LivePicture], None], *, newest: bool
    ) -> None:
        self.made = 0
        """Number of pictures."""
        self.latencies_us: deque[int] = deque(maxlen=MOST_LATENCIES)
        """Time from the arrival of a picture's last event to the picture [us], of the latest pictures."""
        self._camera = camera
        self._give = give
        self._newest = newest
        self._jobs: deque[Callable[[], object]] = deque()
        self._held_bytes = 0
        self._arrived: deque[tuple[int, int]] = deque(maxlen=MOST_ARRIVALS)
        self._changed = threading.Condition()
        self._start_thread("amiwarp-pictures")

    @property
    def skipped(self) -> int:
        """Number of pictures that were left out."""
        return self._camera.skipped

    def append(self, events: Events) -> None:
        """Add events of the sensor. Waits while too much waits.

        Raises the error of the thread, once, and :class:`AmiwarpError` after its end.
        """
        now = monotonic_us()
        with self._changed:
            self._changed.wait_for(lambda: self._held_bytes < MOST_BYTES or self._ended.is_set())
            self._add(partial(self._camera.put, events, now))
            self._held_bytes += held_bytes(events)
            if len(events):
                self._arrived.append((int(events.t[-1]), now))

    def append_encoder(
        self,
        t_us: NDArray[np.int64],
        angle: NDArray[np.float64],
        index_t_us: object = None,
        *,
        second: bool = False,
    ) -> None:
        """Add encoder samples on the events' clock. The angles already include the index pulses.

        Raises as :meth:`append`.
        """
        if not second:
            with self._changed:
                self._add(partial(self._camera.encoder.append, t_us, angle))

    def tick(self) -> None:
        """Raise the error of the thread; it needs no other call."""
        with self._changed:
            self._raise_failure()

    def close(self) -> None:
        """Make the last pictures, and end the thread. Raises its error, once."""
        with self._changed:
            self._ended.set()
            self._changed.notify_all()
        super().close()

    def _add(self, job: Callable[[], object]) -> None:
        """Add a job for the thread, unless it has ended."""
        self._raise_failure()
        if self._ended.is_set():
            raise AmiwarpError("the pictures have ended; add no more data")
        self._jobs.append(job)
        self._changed.notify_all()

    def _raise_failure(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _run(self) -> None:
        try:
            while self._step():
                pass
        except Exception as error:
            self._failure = error  # before those that wait for the thread go on
        finally:
            with self._changed:
                self._ended.set()
                self._jobs.clear()
                self._held_bytes = 0
                self._changed.notify_all()

    def _step(self) -> bool:
        """Process all waiting data; return whether the thread goes on."""
        with self._changed:
            self._changed.wait_for(lambda: self._jobs or self._ended.is_set(), POLL_S)
            ended = self._ended.is_set()
            jobs = list(self._jobs)
            self._jobs.clear()
            self._held_bytes = 0
            self._changed.notify_all()
        for job in jobs:
            job()
            if not self._newest:
                self._take(monotonic_us())
        self._take(2**62 if ended else monotonic_us())
        return not ended

    def _take(self, now_us: int) -> None:
        """Make and give the pictures that are ready."""
        for picture in self._camera.take(now_us, newest=self._newest):
            self.made += 1
            self._note_latency(picture.end_us)
            self._give(picture)

    def _note_latency(self, end_us: int) -> None:
        with self._changed:
            while self._arrived and self._arrived[0][0] < end_us:
                self._arrived.popleft()
            if self._arrived:
                _, arrived_us = self._arrived[0]
                self.latencies_us.append(monotonic_us() - arrived_us)
