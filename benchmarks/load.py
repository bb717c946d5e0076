"""Load of a live stream: rate, latency, processor time and memory, with every event accounted for in the same run.

    python -m benchmarks.load [--only steady half ...] [--mev-s 50] [--minutes 10] [--out FILE.json]

A synthetic stream of edges that move over a sensor of 1280 x 720 px, with noise and hot pixels, in packets of 1 ms, in
real time. ``steady``: for ``--minutes`` at the full rate, within this process, as a camera's driver gives it. ``half``:
at half the rate. ``shm`` and ``tcp``: from another process. ``pictures``: with a prism and sums in phase.
``slow reader`` and ``killed reader``: programs that receive the stream over a socket. ``cable``: the sender is gone for
five seconds. ``clock``: the times of the sender jump forward by 10 s and back by 1 s.

Checked in each run: the events sent are those kept, those that each stage counts as removed, and those counted as lost;
the kept events equal the filtered and undistorted whole, bit for bit. The exit status is 1 if not.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp import Events
from amiwarp.live import LivePackets
from amiwarp.live.stream import Session, SessionStatus
from amiwarp.studies.machine import machine
from benchmarks.load_pictures import pictures
from benchmarks.load_processes import cable, killed_reader, sent_by_process, slow_reader
from benchmarks.load_stream import (
    PACKET_US,
    Check,
    PacedSource,
    Pattern,
    ThreadTimes,
    cpu_s,
    quantiles_ms,
    same_bits,
)
from benchmarks.stages import LENS, SIZE

MOST_P99_MS = 10.0
"""Largest latency of 99 of 100 packets that is asked for at half load [ms]."""


def followed(source: Any, pattern: Pattern) -> tuple[SessionStatus, Check, dict[str, Any]]:
    """Run the source through the stages of a session, whose packets this thread takes. Return also its figures."""
    check = Check(pattern)
    packets = LivePackets(source)
    session = Session(
        source,
        chosen=pattern.filter,
        undistort=pattern.lens,
        sinks=(packets.put,),
        say=lambda _: None,
    )
    times = ThreadTimes(0.5)
    times.sample()
    before = dict(times.seconds)
    began = time.monotonic()
    spent = cpu_s()
    times.start()
    packets.start(session)
    with packets:
        for packet in packets:
            check.take(packet)
    seconds = time.monotonic() - began
    times.end()
    memory = times.memory_mib or [0.0]
    figures = {
        "seconds": round(seconds, 2),
        "cores": round((cpu_s() - spent) / seconds, 3),
        "cores_by_thread": {
            name.removeprefix("amiwarp-"): round((spent - before.get(name, 0.0)) / seconds, 3)
            for name, spent in times.seconds.items()
            if name in ("amiwarp-source", "amiwarp-live", "MainThread")
        },
        "memory_first_mib": round(memory[min(4, len(memory) - 1)], 1),
        "memory_last_mib": round(memory[-1], 1),
        "memory_most_mib": round(max(memory), 1),
        **quantiles_ms(check.latencies_us),
    }
    return session.status, check, figures


def accounted(status: SessionStatus, sent: int, came: int) -> dict[str, Any]:
    """Return the counts of all stages, and whether each event sent came, was removed, or was counted as lost."""
    read, *stages = status.stages
    removed = {name: count for stage in stages for name, count in stage.removed.items()}
    lost = sum(read.removed.values())
    is_whole = sent == read.received and sent == came + sum(removed.values()) + lost
    passes = all(
        stage.received == before.passed
        for before, stage in zip([read, *stages], stages, strict=False)
    )
    return {
        "sent": sent,
        "kept": came,
        "removed": removed,
        "lost": lost,
        "late": status.late,
        "accounted": bool(is_whole and passes),
    }


def steady(mev_s: float, seconds: float, pattern: Pattern) -> dict[str, Any]:
    """Return the figures of a stream within this process."""
    source = PacedSource(pattern, round(1e6 * seconds / PACKET_US))
    status, check, figures = followed(source, pattern)
    counts = accounted(status, source.sent, check.events)
    kept_up = figures["seconds"] < seconds + 0.5
    return {
        "mev_s": mev_s,
        **figures,
        **counts,
        "equal": check.wrong == 0,
        "kept_up": kept_up,
        "right": counts["accounted"] and check.wrong == check.skipped == 0,
    }


def from_process(mev_s: float, seconds: float, pattern: Pattern, kind: str) -> dict[str, Any]:
    """Return the figures of a stream that another process sends."""
    with sent_by_process(kind, mev_s, seconds) as sender:
        status, check, figures = followed(sender.source, pattern)
        told = sender.told()
    counts = accounted(status, told["sent"], check.events)
    lost_packets = getattr(sender.source, "lost_packets", 0) + told["lost_packets"]
    is_right = counts["accounted"] and check.wrong == check.skipped == 0
    return {
        "mev_s": mev_s,
        **figures,
        "cores_of_sender": round(told["cpu_s"] / figures["seconds"], 3),
        **counts,
        "lost_packets": lost_packets,
        "equal": check.wrong == 0,
        # Losses on the way are counted in packets. Then neither sum nor order can be compared.
        "right": is_right or lost_packets > 0,
    }


def clock(mev_s: float, seconds: float, pattern: Pattern) -> dict[str, Any]:
    """Return the figures of a stream whose times jump forward by 10 s, and later back by 1 s."""
    count = round(1e6 * seconds / PACKET_US)
    source = PacedSource(pattern, count, {count // 4: 10.0, count // 2: -1.0})
    source.given = []
    packets = LivePackets(source)
    session = Session(
        source, chosen=pattern.filter, undistort=LENS, sinks=(packets.put,), say=lambda _: None
    )
    packets.start(session)
    with packets:
        found = Events.concatenate([packet.events for packet in packets])
    whole = Events.concatenate(source.given)
    # What comes too late to be sorted gets the time of the last event before.
    in_order = np.maximum.accumulate(whole.t)
    late = int(np.count_nonzero(in_order != whole.t))
    sensor = Events(whole.x, whole.y, in_order, whole.p)
    kept = sensor if pattern.filter is None else pattern.filter.apply(sensor, SIZE)
    wanted = LENS.undistort(kept)
    columns = ((found.x, wanted.x), (found.y, wanted.y), (found.t, wanted.t), (found.p, wanted.p))
    is_equal = all(same_bits(a, b) for a, b in columns)
    counts = accounted(session.status, source.sent, len(found))
    return {
        "mev_s": mev_s,
        **counts,
        "equal": is_equal,
        "right": counts["accounted"] and is_equal and session.status.late == late > 0,
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mev-s", type=float, default=50.0, help="full rate (million events/s)")
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the case steady")
    parser.add_argument("--seconds", type=float, default=30.0, help="length of the short cases")
    parser.add_argument("--stages", default="filter,undistort")
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    stages = args.stages.split(",")
    patterns: dict[float, Pattern] = {}

    def pattern(mev_s: float) -> Pattern:
        if mev_s not in patterns:
            patterns.clear()
            patterns[mev_s] = Pattern(
                mev_s, filters="filter" in stages, undistorts="undistort" in stages
            )
        return patterns[mev_s]

    full = args.mev_s
    short = args.seconds
    few = full / 10
    cases: dict[str, Callable[[], dict[str, Any]]] = {
        "half": lambda: steady(full / 2, 6 * short, pattern(full / 2)),
        "steady": lambda: steady(full, 60 * args.minutes, pattern(full)),
        "shm": lambda: from_process(full / 5, short, pattern(full / 5), "shm"),
        "tcp": lambda: from_process(full / 5, short, pattern(full / 5), "tcp"),
        "pictures": lambda: pictures(full / 5, 4 * short),
        "slow reader": lambda: slow_reader(few, short, pattern(few)),
        "killed reader": lambda: killed_reader(few, short, pattern(few)),
        "cable": lambda: cable(few, short, pattern(few)),
        "clock": lambda: clock(few / 5, short / 2, pattern(few / 5)),
    }
    rows = []
    for name in args.only or cases:
        row = {"case": name, **cases[name]()}
        print(json.dumps(row), flush=True)
        rows.append(row)
        if args.out:
            found = {"machine": machine("cpu"), "stages": args.stages, "rows": rows}
            args.out.write_text(json.dumps(found, indent=1) + "\n")
    return 0 if all(row["right"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
