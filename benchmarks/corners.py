"""Speed of corner detection, compared with dv-processing and eventcv in the same run, with the agreement of each.

    python -m benchmarks.corners [--events 2000000] [--device cuda:0] [--recording FILE ...] [--out FILE.json]

The events are those of a square of 5 x 5 textured tiles that moves on a circle before a 640 x 480 sensor, with noise;
``--recording`` adds files. Each program runs ``REPEATS`` times on the same events, in turns, and each of our rows with
one thread and with all. The time includes the checks of the events, but neither reading nor conversion. ``mev_per_s``
is from the least elapsed time. ``cpu_ns`` is the least processor time per event, which depends less on other load, and
``free_mev_per_s`` the rate that follows from it if every thread had a core to itself and an equal share.

The error of a row is the share of events whose result differs from an independent implementation in NumPy, over the
first ``JUDGED`` events: of eFAST, of Arc*, or of dv-processing's own rule. Its circles have radii of 5 and 6 px, an arc
ends where times differ by 50 ms or more, and no redundant event is left out; so it finds other corners than Arc*.
Writes benchmarks/results/corners_cpu.json or corners_cuda.json. The exit status is 1 if a result is wrong.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp import CornerDetector, CornerMethod, DeviceEvents, Events, open_recording
from amiwarp.studies.machine import machine, versions
from amiwarp.tasks import cpu_threads, limited_cpu_threads
from reference import corners as oracle

RESULTS = Path(__file__).parent / "results"
WIDTH, HEIGHT = 640, 480
RANGE_US = 50_000
"""Largest difference of times in an arc, for dv-processing [us]."""
REPEATS = 5
JUDGED = 20_000
"""Number of events for which the results are compared with the references."""
SMALLER = 10
"""eventcv gets this part of the events, because it takes so much longer."""


@dataclass(frozen=True)
class Program:
    """Program to measure."""

    name: str
    run: Callable[[], Any]
    """Detects corners among the events. :func:`rows_of` converts what it returns."""
    expected: NDArray[np.int64]
    """Those among the first :data:`JUDGED` events, from the reference."""
    events: int
    """Number of events that it gets."""
    threads: int = 1
    """Number of CPU threads that it uses; 0 for a GPU."""


def moving_tiles(n: int, seed: int = 0) -> Events:
    """Return events of the edges of 5 x 5 tiles that move on a circle, at about 10 million events per second."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, n // 10, n))
    phase = t * (2e-6 * np.pi * 12.0)
    line, along = rng.integers(0, 6, n) * 60.0 - 150.0, rng.uniform(-150.0, 150.0, n)
    upright = rng.random(n) < 0.5
    x = 320.0 + 40.0 * np.cos(phase) + np.where(upright, line, along)
    y = 240.0 + 40.0 * np.sin(phase) + np.where(upright, along, line)
    p = np.where(upright, -np.sin(phase), np.cos(phase)) > 0.0
    noise = rng.random(n) < 0.05
    x, y = (
        np.where(noise, rng.uniform(0, WIDTH - 1, n), x),
        np.where(noise, rng.uniform(0, HEIGHT - 1, n), y),
    )
    return Events.from_arrays(np.rint(x).astype(np.int64), np.rint(y).astype(np.int64), t + 1, p)


def ours(
    events: Events, size: tuple[int, int], method: CornerMethod, device: str, threads: int
) -> Program:
    given = events
    if device != "cpu":
        given = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device)

    def run() -> NDArray[np.int64]:
        with limited_cpu_threads(threads):
            found = CornerDetector(size, detector=method, device=device).detect(given)
        return np.flatnonzero(found if isinstance(found, np.ndarray) else found.numpy())

    where = f"{threads} threads" if device == "cpu" else device
    expected = np.flatnonzero(oracle.corners(events[:JUDGED], *size, method))
    return Program(
        f"amiwarp {method.value}, {where}",
        run,
        expected,
        len(events),
        threads if device == "cpu" else 0,
    )


def by_dv_processing(events: Events, size: tuple[int, int]) -> Program:
    import dv_processing as dv

    store, mask = dv.EventStore(), np.full(size[::-1], 255, np.uint8)
    for x, y, t, p in oracle.table(events).tolist():
        store.push_back(t, x, y, bool(p))

    def run() -> Any:
        return dv.features.ArcCornerDetector(size, RANGE_US, False).detect(
            store, (0, 0, *size), mask
        )

    few = events[:JUDGED]
    expected = oracle.table(few)[oracle.corners_of_dv_processing(few, *size, RANGE_US)]
    return Program("dv-processing ArcCornerDetector", run, expected[:, :3], len(events))


def by_eventcv(events: Events, size: tuple[int, int]) -> Program:
    import eventcv

    few = events[: max(len(events) // SMALLER, JUDGED)]
    stream = eventcv.from_numpy(oracle.table(few), sensor_size=size, time_unit="us")
    first = few[:JUDGED]
    expected = oracle.table(first)[oracle.corners(first, *size, CornerMethod.EFAST)]
    return Program("eventcv efast", stream.efast, expected, len(few))


def rows_of(found: Any) -> NDArray[np.int64]:
    """Return what a program found as indices, or as rows x, y, t and so on."""
    if isinstance(found, np.ndarray):
        return found
    if hasattr(found, "numpy"):
        return np.asarray(found.numpy(), np.int64)
    return np.array([(int(c.pt[0]), int(c.pt[1]), c.timestamp) for c in found], np.int64).reshape(
        -1, 3
    )


def judged(program: Program, found: NDArray[np.int64], events: Events) -> float:
    """Return the share of the first events whose result differs from the reference."""
    judged_events = min(JUDGED, len(events))
    # Later events may have the same time
    last = judged_events if found.ndim == 1 else int(events.t[judged_events - 1])
    sets = []
    for corners in (found, program.expected):
        early = corners[(corners if corners.ndim == 1 else corners[:, 2]) < last]
        sets.append({tuple(np.atleast_1d(row)) for row in early.tolist()})
    return len(sets[0] ^ sets[1]) / judged_events


def measure(programs: list[Program], events: Events) -> list[dict[str, Any]]:
    """Run all programs in turns, and return a row for each."""
    walls: dict[str, list[float]] = {program.name: [] for program in programs}
    busy: dict[str, list[float]] = {program.name: [] for program in programs}
    found: dict[str, Any] = {}
    for _ in range(REPEATS):
        for program in programs:
            wall, processor = time.perf_counter(), time.process_time()
            found[program.name] = program.run()
            walls[program.name].append(time.perf_counter() - wall)
            busy[program.name].append(time.process_time() - processor)
    rows = []
    for program in programs:
        result = rows_of(found[program.name])
        rows.append({
            "program": program.name, "events": program.events, "corners": len(result),
            "mev_per_s": program.events / min(walls[program.name]) * 1e-6,
            "cpu_ns": min(busy[program.name]) / program.events * 1e9,
            "error": judged(program, result, events),
        })  # fmt: skip
        free = program.threads / rows[-1]["cpu_ns"] * 1e3
        rows[-1]["free_mev_per_s"] = free if program.threads else rows[-1]["mev_per_s"]
    base = next((row for row in rows if row["program"].startswith("dv")), {})
    for row in rows:
        for name in ("mev_per_s", "free_mev_per_s") if base else ():
            row[f"{name}_over_dv_processing"] = row[name] / base[name]
        print(f"{row['program']:34} {row['mev_per_s']:8.2f} Mev/s {row['cpu_ns']:7.0f} ns/event on the CPU, "
              f"{row['corners']:8} corners, error {row['error']:g}", flush=True)  # fmt: skip
    return rows


def programs(events: Events, size: tuple[int, int], device: str) -> list[Program]:
    """Return the programs to compare; those that are not installed are left out."""
    peers = {"dv_processing": by_dv_processing, "eventcv": by_eventcv}
    out = [by(events, size) for name, by in peers.items() if importlib.util.find_spec(name)]
    counts = sorted({1, cpu_threads()})
    for method in CornerMethod:
        out += [ours(events, size, method, "cpu", threads) for threads in counts]
        out += [ours(events, size, method, device, cpu_threads())] if device != "cpu" else []
    return out


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--events", type=int, default=2_000_000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--recording", type=Path, nargs="*", default=[])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    scenes = {"tiles": (moving_tiles(args.events), (WIDTH, HEIGHT))}
    for path in args.recording:
        source = open_recording(path).events
        scenes[path.name] = source.slice(0, args.events), source.size
    before, results = os.getloadavg()[0], {}
    for name, (events, size) in scenes.items():
        print(f"{name}: {len(events)} events, {size[0]}x{size[1]}")
        results[name] = {"size": size, "rows": measure(programs(events, size, args.device), events)}
    report = {
        "machine": machine(args.device), "cpu": machine("cpu"), "load": [before, os.getloadavg()[0]],
        "versions": versions(["warp-lang", "numpy", "dv-processing", "eventcv"]), "scenes": results,
    }  # fmt: skip
    kind = "cpu" if args.device == "cpu" else "cuda"
    (args.out or RESULTS / f"corners_{kind}.json").write_text(json.dumps(report, indent=1) + "\n")
    return int(any(row["error"] > 0.0 for scene in results.values() for row in scene["rows"]))


if __name__ == "__main__":
    sys.exit(main())
