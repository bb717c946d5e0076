"""Processor time of the stages of a plain camera's stream: filter and undistortion, for each event.

    python -m benchmarks.stages [--seconds 0.1] [--mev-s 50] [--out FILE.json]

``stages``: a synthetic stream of edges that move over a sensor of 1280 x 720 px, with noise and hot pixels, in packets
of 1 ms. Each part of the filter alone, all parts together, and undistortion: the processor time of the thread, for each
event that reaches the stage. The same with packets of 1,000 events, of which each costs a call.
``session``: the stream through a whole session as fast as it goes: filter, undistortion, one output.

In each run the events are compared with the filtered and undistorted whole, and the counts of the stages with them.
The exit status is 1 if they differ.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp import Camera, Compensated, EventFilter, Events, Packet, RadialTangential
from amiwarp.imaging.filters import RunningFilter
from amiwarp.live.link import monotonic_us
from amiwarp.live.stream import Session, make_packet
from amiwarp.studies.machine import machine

SIZE = WIDTH, HEIGHT = 1280, 720
LENS = Camera(WIDTH, HEIGHT, 900.0, 900.0, 639.5, 359.5, RadialTangential(-0.2, 0.05))
REPEATS = 5
HOT = np.zeros((HEIGHT, WIDTH), np.bool_)
HOT[::97, ::131] = True
SMALL_PACKET = 1000
"""Number of events of a small packet."""


def parts(mev_s: float) -> dict[str, EventFilter]:
    """Return each part of the filter alone, and all together."""
    region = 40, 20, WIDTH - 40, HEIGHT - 20
    rate = 0.8e6 * mev_s
    return {
        "region": EventFilter(region=region),
        "hot pixels": EventFilter(hot_pixels=HOT),
        "refractory period": EventFilter(refractory_us=300),
        "background activity": EventFilter(background_us=200),
        "rate": EventFilter(most_per_s=rate),
        "all five": EventFilter(
            region=region, hot_pixels=HOT, refractory_us=300, background_us=200, most_per_s=rate
        ),
    }


def stream(seconds: float, mev_s: float) -> Events:
    """Return events of edges that cross the sensor, a tenth of them noise, a fiftieth of hot pixels."""
    rng = np.random.default_rng(0)
    n = round(seconds * mev_s * 1e6)
    t = (np.arange(n) / mev_s).astype(np.int64)
    edge = rng.integers(0, 8, n)
    x = (t // 100 + edge * (WIDTH // 8) + rng.integers(0, 3, n)) % WIDTH
    y = rng.integers(0, HEIGHT, n)
    kind = rng.random(n)
    is_noise = kind < 0.1
    x[is_noise] = rng.integers(0, WIDTH, np.count_nonzero(is_noise))
    is_hot = kind > 0.98
    rows, columns = np.nonzero(HOT)
    which = rng.integers(0, len(rows), np.count_nonzero(is_hot))
    x[is_hot] = columns[which]
    y[is_hot] = rows[which]
    p = rng.integers(0, 2, n).astype(np.uint8)
    return Events(x.astype(np.uint16), y.astype(np.uint16), t, p)


def cut(events: Events, count: int) -> list[Events]:
    return [events[start : start + count] for start in range(0, len(events), count)]


def same(found: Events, wanted: Events) -> bool:
    """Return whether all columns are equal, bit for bit."""
    columns = ((found.x, wanted.x), (found.y, wanted.y), (found.t, wanted.t), (found.p, wanted.p))
    return all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in columns)


def timed(step: Callable[[Events], Events], packets: list[Events]) -> tuple[float, list[Events]]:
    """Return the processor time of a stage for each event [ns], and the events that leave it."""
    began = time.thread_time()
    found = [step(packet) for packet in packets]
    spent = time.thread_time() - began
    return 1e9 * spent / sum(map(len, packets)), found


def measured(name: str, events: Events, count: int, step: Callable[[], Any], whole: Events) -> Any:
    """Return a row: the processor time of a stage over packets of ``count`` events, compared with the whole."""
    packets = cut(events, count)
    times = []
    for _ in range(REPEATS + 1):
        ns, found = timed(step(), packets)
        times.append(ns)
    is_right = same(Events.concatenate(found), whole)
    del times[0]  # loads kernels and tables
    row = {
        "stage": name,
        "packet_events": count,
        "ns_per_event": statistics.median(times),
        "least_ns": min(times),
        "most_ns": max(times),
        "passed": len(whole),
        "of": len(events),
        "right": is_right,
    }
    print(json.dumps(row), flush=True)
    return row


@dataclass
class PacketSource:
    """Source of packets in memory, as fast as they are taken."""

    packets_given: list[Events]
    size = SIZE
    camera = LENS
    prism = None
    encoders = 0
    name = "benchmark"

    def packets(self) -> Iterator[Packet]:
        for events in self.packets_given:
            yield make_packet(monotonic_us(), events)

    def close(self) -> None:
        pass


def session_row(events: Events, count: int, chosen: EventFilter) -> dict[str, Any]:
    """Return the processor time of a whole session, with its counts compared."""
    packets = cut(events, count)
    filtered = chosen.apply(events, SIZE)
    wanted = LENS.undistort(filtered)
    spent = []
    is_right = True
    for _ in range(REPEATS):
        taken: list[Compensated] = []
        session = Session(
            PacketSource(packets), chosen=chosen, undistort=LENS, sinks=(taken.append,)
        )
        began, clock = time.process_time(), time.perf_counter()
        status = session.run(threading.Event(), lambda _: None)
        seconds = time.perf_counter() - clock
        spent.append(1e9 * (time.process_time() - began) / len(events))
        found = Events.concatenate([packet.events for packet in taken])
        read, filtering, undistorting = status.stages
        counts = (
            read.received == read.passed == filtering.received == len(events)
            and filtering.passed == undistorting.received == undistorting.passed == len(filtered)
            and sum(filtering.removed.values()) == len(events) - len(filtered)
        )
        is_right = is_right and counts and same(found, wanted)
    row = {
        "stage": "session",
        "packet_events": count,
        "ns_per_event": statistics.median(spent),
        "least_ns": min(spent),
        "most_ns": max(spent),
        "last_mev_per_s": 1e-6 * len(events) / seconds,
        "passed": len(wanted),
        "of": len(events),
        "right": is_right,
    }
    print(json.dumps(row), flush=True)
    return row


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=0.1, help="length of the stream (s)")
    parser.add_argument("--mev-s", type=float, default=50.0, help="rate (million events/s)")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    events = stream(args.seconds, args.mev_s)
    few = events[: len(events) // 10]
    packet = round(1e3 * args.mev_s)
    rows = []
    filters = parts(args.mev_s)
    for name, chosen in filters.items():
        for given, count in ((events, packet), (few, SMALL_PACKET)):
            whole = chosen.apply(given, SIZE)

            def step(chosen: EventFilter = chosen) -> Callable[[Events], Events]:
                return RunningFilter(chosen, SIZE).kept

            rows.append(measured(name, given, count, step, whole))
    for given, count in ((events, packet), (few, SMALL_PACKET)):
        whole = LENS.undistort(given)
        rows.append(measured("undistort", given, count, lambda: LENS.undistort, whole))
    rows.append(session_row(events, packet, filters["all five"]))
    if args.out:
        args.out.write_text(json.dumps({"machine": machine("cpu"), "rows": rows}, indent=1) + "\n")
    return 0 if all(row["right"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
