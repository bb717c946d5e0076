"""Background threads: a loop until closed, and jobs in order; queues of packets between a source and its consumers."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import numpy as np

from amiwarp.choices import Option
from amiwarp.events.recording import OVERHEAD, Events
from amiwarp.validation import choice, whole

if TYPE_CHECKING:
    from amiwarp.live.stream.packets import Packet


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

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the loop and wait for it. Raises the error that ended it, once."""
        self._ended.set()
        self._thread.join()
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _guarded_run(self) -> None:
        try:
            self._run()
        except Exception as error:
            self._failure = error

    def _run(self) -> None:
        raise NotImplementedError


# Background thread that runs a session's jobs for a file, server or other consumer. Not the pool of
# ``kernels/launch.py``: it waits while its jobs hold too much memory, and can drop the waiting ones.

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
                lambda: self._error or not self.held_bytes or self.held_bytes + count <= self._most_bytes
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


# Policies of a full queue of events.


class Policy(Option):
    """What a full queue does with further events."""

    BLOCK = "block"
    """Make the source and its sender wait until the queue has room. No event is lost in the queue."""
    DROP_OLDEST = "drop-oldest"
    """Drop the oldest events. The size of the queue then bounds the delay."""
    THIN = "thin"
    """Drop events evenly, so that all pixels and times remain represented."""


# Queue of packets between a source and a consumer, with limits for its number of events and its memory.

THIN_FROM = 0.5
"""Share of the queue's capacity above which :attr:`Policy.THIN` drops events; it drops more as the queue fills."""


class PacketQueue:
    """Queue of packets that holds at most ``most_events`` events and ``most_bytes`` bytes.

    The policy applies to events only: triggers and encoder samples are never dropped. If these alone fill the memory,
    the source waits under every policy. A single packet larger than the limits passes alone. One thread may put packets
    and one may get them. Raises :class:`AmiwarpError` for a size below 1.
    """

    def __init__(self, most_events: int, policy: Policy, most_bytes: int = QUEUE_BYTES) -> None:
        self.most_events = whole(most_events, "queue's most_events", 1, 1 << 40)
        self.most_bytes = whole(most_bytes, "queue's most_bytes", 1, 1 << 40)
        self.policy = choice(Policy, policy, "policy")
        self.received = self.dropped = 0
        """Number of events put, and number of them dropped."""
        self._packets: deque[Packet] = deque()
        self._held = 0
        self._emptied = 0
        """Number of packets at the front of the queue whose events were dropped."""
        self.held_bytes = 0
        """Memory of the packets in the queue [bytes], see :attr:`Packet.held_bytes`."""
        self._phase = 0.0
        self._closed = False
        self._changed = threading.Condition()

    @property
    def held(self) -> int:
        """Number of events in the queue."""
        return self._held

    @property
    def ended(self) -> bool:
        """Whether the queue is closed and empty."""
        with self._changed:
            return self._closed and not self._packets

    def put(self, packet: Packet) -> None:
        """Add a packet once it fits or the queue is closed. The policy may drop events to make it fit."""
        with self._changed:
            self.received += len(packet.events)
            if self.policy is Policy.THIN:
                packet = self._thinned(packet)
            while self.policy is Policy.DROP_OLDEST and self._held and not self._fits(packet):
                self._drop_oldest()
            if packet.empty:  # an empty packet only shows that the source is alive
                return
            self._changed.wait_for(lambda: not self._packets or self._fits(packet) or self._closed)
            self._packets.append(packet)
            self._held += len(packet.events)
            self.held_bytes += packet.held_bytes
            self._changed.notify_all()

    def get(self, timeout_s: float) -> Packet | None:
        """Return the next packet; None on time-out or if the queue has ended."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._packets) or self._closed, timeout_s)
            if not self._packets:
                return None
            packet = self._packets.popleft()
            self._emptied = max(0, self._emptied - 1)
            self._held -= len(packet.events)
            self.held_bytes -= packet.held_bytes
            self._changed.notify_all()
            return packet

    def discard(self) -> int:
        """Close the queue and drop the packets in it. Return their number of events."""
        with self._changed:
            self._closed = True
            lost, self._held, self.held_bytes, self._emptied = self._held, 0, 0, 0
            self._packets.clear()
            self.dropped += lost
            self._changed.notify_all()
        return lost

    def close(self) -> None:
        """Close the queue to further packets. The packets in it can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _fits(self, packet: Packet) -> bool:
        return self._share(self._held + len(packet.events), self.held_bytes + packet.held_bytes) <= 1.0

    def _share(self, events: int, held_bytes: int) -> float:
        return max(events / self.most_events, held_bytes / self.most_bytes)

    def _drop_oldest(self) -> None:
        """Drop the events of the first packet that has any; keep its triggers and encoder samples."""
        while not len(self._packets[self._emptied].events):
            self._emptied += 1
        packet = self._packets[self._emptied]
        self._held -= len(packet.events)
        self.dropped += len(packet.events)
        rest = replace(packet, events=Events.empty())
        self.held_bytes -= packet.held_bytes - (0 if rest.empty else rest.held_bytes)
        if rest.empty:
            del self._packets[self._emptied]
        else:
            self._packets[self._emptied] = rest

    def _thinned(self, packet: Packet) -> Packet:
        n = len(packet.events)
        free = 1.0 - self._share(self._held + n, self.held_bytes + packet.held_bytes)
        share = min(max(free / (1.0 - THIN_FROM), 0.0), 1.0)
        if share == 1.0 or not n:
            return packet
        steps = np.floor(self._phase + share * np.arange(n + 1))
        self._phase = (self._phase + share * n) % 1.0
        kept = steps[1:] > steps[:-1]
        self.dropped += n - int(np.count_nonzero(kept))
        return replace(packet, events=packet.events[kept])


# Sorting of events by time across packets.


class EventSorter:
    """Sorts events by time across packets. Each event is returned once.

    Packets in order pass at once and unchanged. After an event that is earlier than those of a previous packet, events
    are held back for as long as that event was late, by at most ``most_us`` [us] of event time and ``most_events``
    events. This ends after :data:`CALM_US` without disorder. An event that is later still gets the time of the last
    event returned, and is counted in :attr:`late`.
    """

    CALM_US = 1_000_000
    """Event time without disorder after which events are no longer held back [us]."""

    def __init__(self, *, most_us: int = 10_000, most_events: int = 1 << 18) -> None:
        self._most_us, self._most_events = most_us, most_events
        self._hold_us = 0
        self._last_out_us = self._newest_us = -(1 << 62)
        self._disorder_us = 0
        self._held: Events | None = None
        self.late = 0
        """Number of events that were too late to be sorted and got a later time stamp."""

    def put(self, events: Events) -> Events:
        """Add a packet's events; return the events that are ready, in order of time."""
        t = events.t
        if not len(events):
            return events
        if not self._hold_us and t[0] >= self._last_out_us and not (t[1:] < t[:-1]).any():
            self._last_out_us = self._newest_us = int(t[-1])
            return events
        lateness = self._newest_us - int(t.min())
        self._newest_us = max(self._newest_us, int(t.max()))
        if lateness > 0:
            self._hold_us, self._disorder_us = max(self._hold_us, min(lateness, self._most_us)), self._newest_us
        elif self._newest_us - self._disorder_us > self.CALM_US:
            self._hold_us = 0
        return self._release(events, self._newest_us - self._hold_us)

    def flush(self) -> Events:
        """Return all events that are still held back."""
        return self._release(Events.empty(), self._newest_us)

    def _release(self, events: Events, until: int) -> Events:
        """Return the events up to the time ``until`` [us], and hold back the later events."""
        joined = events if self._held is None else Events.concatenate([self._held, events])
        joined = joined[np.argsort(joined.t, kind="stable")]
        late = int(np.searchsorted(joined.t, self._last_out_us))
        if late:
            self.late += late
            t = joined.t.copy()
            t[:late] = self._last_out_us
            joined = Events(joined.x, joined.y, t, joined.p)
        count = max(int(np.searchsorted(joined.t, until, "right")), len(joined) - self._most_events)
        out, held = joined[:count], joined[count:]
        self._held = held if len(held) else None
        self._last_out_us = int(out.t[-1]) if len(out) else self._last_out_us
        return out
