"""Synthetic stream of :mod:`benchmarks.load`, its source and its check, and the figures of processes and threads."""

from __future__ import annotations

import os
import resource
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from amiwarp import Camera, Compensated, EventFilter, Events, Packet
from amiwarp.live.link import monotonic_us
from amiwarp.live.stream import make_packet
from benchmarks.stages import HOT, LENS, SIZE, stream

PACKET_US = 1000
PERIOD_PACKETS = 100
"""Number of packets after which the stream repeats. The last one is empty, so that each period is filtered alike."""
PERIOD_US = PERIOD_PACKETS * PACKET_US
FILTER = EventFilter(hot_pixels=HOT, refractory_us=300, background_us=200)
assert max(FILTER.refractory_us, FILTER.background_us) < PACKET_US


class Pattern:
    """A period of the stream, and what leaves its stages."""

    def __init__(self, mev_s: float, *, filters: bool = True, undistorts: bool = True) -> None:
        count = round(1e-6 * PERIOD_US * mev_s * 1e6)
        span_s = 1e-6 * (PERIOD_US - PACKET_US)
        events = stream(span_s, count / span_s / 1e6)
        self.events = events
        edges = np.searchsorted(events.t, np.arange(PERIOD_PACKETS) * PACKET_US).tolist()
        self.cuts = [*edges, len(events)]
        self.filter = FILTER if filters else None
        self.lens: Camera | None = LENS if undistorts else None
        kept = FILTER.apply(events, SIZE) if filters else events
        self.expected = LENS.undistort(kept) if undistorts else kept

    def packet(self, number: int, start_us: int) -> Events:
        """Return the events of a packet of a stream that starts at a time [us]."""
        period, k = divmod(number, PERIOD_PACKETS)
        part = self.events[self.cuts[k] : self.cuts[k + 1]]
        return Events(part.x, part.y, part.t + (start_us + period * PERIOD_US), part.p)


class PacedSource:
    """Source that gives the packets of a pattern in real time, each once its last event is over.

    ``jumps``: seconds that are added to the times of all events from a packet on, by the number of the packet.
    """

    size = SIZE
    camera = None
    prism = None
    encoders = 0
    name = "synthetic stream"

    def __init__(
        self, pattern: Pattern, packets: int, jumps: dict[int, float] | None = None
    ) -> None:
        self.pattern = pattern
        self.count = packets
        self.jumps = jumps or {}
        self.sent = 0
        """Number of events given so far."""
        self.start_us = 0
        """Time of the begin of the stream [us], on the clock of the host."""
        self.given: list[Events] | None = None
        """With a list, the packets are kept in it."""

    def packets(self) -> Iterator[Packet]:
        """Yield the packets."""
        self.start_us = monotonic_us()
        jumped_us = 0
        for k in range(self.count):
            wait_until(self.start_us + (k + 1) * PACKET_US)
            jumped_us += round(1e6 * self.jumps.get(k, 0.0))
            events = self.pattern.packet(k, self.start_us + jumped_us)
            self.sent += len(events)
            if self.given is not None:
                self.given.append(events)
            yield make_packet(monotonic_us(), events)

    def close(self) -> None:
        """Do nothing."""


def wait_until(due_us: int) -> None:
    """Wait until a time of the host's clock [us]."""
    left_us = due_us - monotonic_us()
    if left_us > 0:
        time.sleep(1e-6 * left_us)


class Check:
    """Compares what leaves the last stage with the pattern, and notes latencies by the events' times."""

    def __init__(self, pattern: Pattern) -> None:
        self._expected = pattern.expected
        self.events = 0
        """Number of events that came."""
        self.wrong = 0
        """Number of slices of packets with other events than expected."""
        self.skipped = 0
        """Number of periods of the pattern that were left out between others."""
        self.latencies_us: list[int] = []
        self._shift_us: int | None = None

    def take(self, packet: Compensated) -> None:
        """Compare a packet."""
        events = packet.events
        if not len(events):
            return
        self.latencies_us.append(monotonic_us() - int(events.t[-1]))
        first = 0
        while first < len(events):
            place = self.events % len(self._expected)
            stop = min(len(events), first + len(self._expected) - place)
            wanted = self._expected[place : place + stop - first]
            if not self._equal(events[first:stop], wanted, is_start=place == 0):
                self.wrong += 1
            self.events += stop - first
            first = stop

    def _equal(self, found: Events, wanted: Events, *, is_start: bool) -> bool:
        """Return whether all columns are equal, bit for bit, and the times by a shift that grows by whole periods."""
        shift_us = int(found.t[0] - wanted.t[0])
        if is_start and self._shift_us is not None:
            periods, rest_us = divmod(shift_us - self._shift_us, PERIOD_US)
            if rest_us or periods < 1:
                return False
            self.skipped += periods - 1
        elif not is_start and shift_us != self._shift_us:
            return False
        self._shift_us = shift_us
        is_same_t = bool((found.t - wanted.t == shift_us).all())
        columns = ((found.x, wanted.x), (found.y, wanted.y), (found.p, wanted.p))
        return is_same_t and all(same_bits(a, b) for a, b in columns)


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two columns are of one type and equal, bit for bit."""
    kind = f"u{a.itemsize}"
    return a.dtype == b.dtype and np.array_equal(a.view(kind), b.view(kind))


def quantiles_ms(latencies_us: list[int]) -> dict[str, float]:
    """Return median, 99th percentile and largest latency [ms]."""
    if not latencies_us:
        return {}
    median, slow, most = (1e-3 * np.percentile(latencies_us, [50, 99, 100])).round(2).tolist()
    return {"latency_p50_ms": median, "latency_p99_ms": slow, "latency_max_ms": most}


def rss_mib(pid: int | str = "self") -> float:
    """Return the resident memory of a process [MiB]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def cpu_s(pid: int | str = "self") -> float:
    """Return the processor time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class ThreadTimes(threading.Thread):
    """Samples the processor time of each of this process's threads by name, and its resident memory."""

    def __init__(self, every_s: float) -> None:
        super().__init__(name="amiwarp-sampler", daemon=True)
        self._every_s = every_s
        self._ended = threading.Event()
        self.seconds: dict[str, float] = {}
        self.memory_mib: list[float] = []

    def run(self) -> None:
        """Sample until :meth:`end`."""
        while not self._ended.wait(self._every_s):
            self.sample()

    def sample(self) -> None:
        """Take one sample."""
        self.memory_mib.append(rss_mib())
        for thread in threading.enumerate():
            stat = Path(f"/proc/self/task/{thread.native_id}/stat")
            if thread.native_id is not None and stat.exists():
                self.seconds[thread.name] = cpu_s(f"self/task/{thread.native_id}")

    def end(self) -> None:
        """Stop sampling."""
        self._ended.set()
        self.join()
