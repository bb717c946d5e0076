"""Speed of event representations for networks, compared with other libraries in the same run, with the error of each.

    python -m benchmarks.tensors [--events 4000000] [--device cuda:0] [--repeats 9] [--out FILE.json]

The main task is one voxel grid of 5 bins at 640 x 480 pixels, of events at random pixels and at 20,000 edge points.
Other tasks are grids of few events, and of many windows in one call. On
a GPU, the events lie there as each library takes them, and ours are checked for their order in every call. Programs run
in turns, after one pass that compiles them. ``gev_per_s`` is from the median elapsed time. ``cpu_ns`` is the median
processor time per event, which depends less on other load. A library that is missing, or has no such representation,
gets a row that says so.

The error of a row is the largest difference of an element from a float64 or integer calculation with NumPy of the same
events, relative to the element where it is larger than 1. Libraries whose bins differ are compared with their own
definition. Writes benchmarks/results/tensors_cpu.json or tensors_cuda.json. The exit status is 1 if a result of ours is
wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

import amiwarp
from amiwarp import DeviceEvents, Events
from amiwarp.studies.machine import machine, versions
from amiwarp.tasks import cpu_threads, limited_cpu_threads
from benchmarks.libraries import Missing, library

RESULTS = Path(__file__).parent / "results"
WIDTH, HEIGHT, BINS = 640, 480, 5
SPAN_US = 100_000
WINDOWS = 32
FEW = (1_000, 10_000)
"""Numbers of events in a small call."""
EVENTS = {"cpu": 4_000_000, "cuda": 100_000_000}
PEER_EVENTS = 4_000_000
"""Most events for programs on the CPU."""
DV_EVENTS = 500_000
"""Most events for dv-processing, which takes them one by one from Python."""
BAR = 1e-5
"""Largest accepted error of our results."""
GRID = "voxel grid"


@dataclass(frozen=True)
class Program:
    """Program to measure."""

    task: str
    name: str
    events: Events
    run: Callable[[], Any]
    """Computes the tensor of the events, and waits until it is finished."""
    expected: Callable[[Events], NDArray[Any]]
    """Float64 or integer calculation with NumPy."""
    threads: int | None = None
    """Number of CPU threads of ours; None for all."""

    @property
    def ours(self) -> bool:
        """Whether it is one of amiwarp."""
        return self.name.startswith("amiwarp")


def scene(points: int, n: int, seed: int = 0) -> Events:
    """Return events at ``points`` pixels; 0 for all pixels with equal probability."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, WIDTH * HEIGHT, points or n, np.int64)
    pixels = pixels[rng.integers(0, points, n)] if points else pixels
    t = np.sort(rng.integers(0, SPAN_US, n))
    t[0], t[-1] = 0, SPAN_US
    x, y = (pixels % WIDTH).astype(np.uint16), (pixels // WIDTH).astype(np.uint16)
    return Events(x, y, t, rng.integers(0, 2, n, np.uint8))


# Calculations with NumPy in float64 and integers, in blocks.

PIECE = 1 << 22


def pieces(events: Events) -> list[Events]:
    return [events[start : start + PIECE] for start in range(0, len(events), PIECE)]


def cells(events: Events) -> NDArray[np.int64]:
    return events.y.astype(np.int64) * WIDTH + events.x


def expected_grid(events: Events, intervals: int = BINS - 1) -> NDArray[np.float64]:
    size, t0, t1 = WIDTH * HEIGHT, int(events.t[0]), int(events.t[-1])
    total = np.zeros((BINS + 2) * size)
    for part in pieces(events):
        s = intervals * (part.t - t0) / (t1 - t0)
        k = s.astype(np.int64)
        sign, at = 2.0 * part.p - 1.0, k * size + cells(part)
        total += np.bincount(at, sign * (1.0 - (s - k)), len(total))
        total += np.bincount(at + size, sign * (s - k), len(total))
    return total.reshape(-1, HEIGHT, WIDTH)[:BINS]


def expected_count(events: Events) -> NDArray[np.int64]:
    parts = [np.bincount(cells(part), minlength=WIDTH * HEIGHT) for part in pieces(events)]
    return np.sum(parts, axis=0).reshape(HEIGHT, WIDTH)


def expected_histogram(events: Events) -> NDArray[np.int64]:
    size, t0, t1 = WIDTH * HEIGHT, int(events.t[0]), int(events.t[-1])
    total = np.zeros(2 * BINS * size, np.int64)
    for part in pieces(events):
        k = np.minimum(BINS * (part.t - t0) // (t1 - t0), BINS - 1)
        total += np.bincount(
            (part.p.astype(np.int64) * BINS + k) * size + cells(part), minlength=len(total)
        )
    return np.minimum(total, 255).reshape(2 * BINS, HEIGHT, WIDTH)


def expected_latest(events: Events) -> NDArray[np.int64]:
    latest = np.full(WIDTH * HEIGHT, np.iinfo(np.int64).min)
    for part in pieces(events):
        np.maximum.at(latest, cells(part), part.t)
    return latest.reshape(HEIGHT, WIDTH)


def expected_windows(events: Events) -> NDArray[np.float64]:
    cut = amiwarp.windows(events, count=len(events) // WINDOWS)
    return np.stack([expected_grid(events[a:b]) for a, b in zip(cut.start, cut.stop, strict=True)])


def expected_quarter(events: Events) -> NDArray[np.float64]:
    """Return the voxel grid of events that lie a quarter pixel right of their pixels."""
    here, right = expected_grid(events), np.zeros((BINS, HEIGHT, WIDTH))
    right[:, :, 1:] = here[:, :, :-1]
    return 0.75 * here + 0.25 * right


# amiwarp.


def ours(events: Events, device: str, threads: int | None = None) -> list[Program]:
    """Return our programs on a device."""
    place = "" if threads is None else f", {threads} thread{'s' * (threads > 1)}"
    kind = "cpu" if device == "cpu" else "CUDA"

    def put(these: Events) -> Events | DeviceEvents:
        columns = (these.x, these.y, these.t, these.p)
        return (
            these
            if device == "cpu"
            else DeviceEvents(*(wp.array(values, device=device) for values in columns))
        )

    here = put(events)
    x = events.x.astype(np.float32) + np.float32(0.25)
    between = put(Events(x, events.y.astype(np.float32), events.t, events.p))
    cut = amiwarp.windows(here, count=len(events) // WINDOWS)
    tasks: dict[str, tuple[Callable[[], Any], Any]] = {
        GRID: (lambda: amiwarp.voxel_grid(here, WIDTH, HEIGHT, BINS), expected_grid),
        f"{GRID}s of {WINDOWS} windows": (
            lambda: amiwarp.voxel_grid(here, WIDTH, HEIGHT, BINS, windows=cut), expected_windows),
        f"{GRID}, bilinear positions": (
            lambda: amiwarp.voxel_grid(between, WIDTH, HEIGHT, BINS), expected_quarter),
        "event count": (lambda: amiwarp.event_count(here, WIDTH, HEIGHT), expected_count),
        "stacked histogram": (lambda: amiwarp.stacked_histogram(here, WIDTH, HEIGHT, BINS), expected_histogram),
        "latest times": (lambda: amiwarp.latest_times(here, WIDTH, HEIGHT, per_polarity=False), expected_latest),
    }  # fmt: skip
    name = f"amiwarp, {kind}{place}"
    programs = [
        Program(task, name, events, run, expected, threads)
        for task, (run, expected) in tasks.items()
    ]
    for number in FEW:
        few = events[:number]
        run = partial(amiwarp.voxel_grid, put(few), WIDTH, HEIGHT, BINS)
        programs.append(Program(small(number), name, few, run, expected_grid, threads))
    return programs


def small(number: int) -> str:
    """Return the name of the task of a grid of few events."""
    return f"{GRID} of {number:,} events"


# Other libraries, as their users write it. Each function returns the program's call and the expected result.

Peer = tuple[Callable[[], Any], Any]


def numpy_add_at(events: Events, device: str) -> Peer:
    """E2VID's calculation: two calls of add.at in float32."""
    size = WIDTH * HEIGHT

    def run() -> Any:
        grid = np.zeros((BINS + 1) * size, np.float32)
        s = (BINS - 1) * (events.t - events.t[0]) / (events.t[-1] - events.t[0])
        k = s.astype(np.int64)
        sign, at = np.where(events.p > 0, 1.0, -1.0), k * size + cells(events)
        np.add.at(grid, at, (sign * (1.0 - (s - k))).astype(np.float32))
        np.add.at(grid, at + size, (sign * (s - k)).astype(np.float32))
        return grid[: BINS * size].reshape(BINS, HEIGHT, WIDTH)

    return run, expected_grid


def numpy_bincount(events: Events, device: str) -> Peer:
    size = WIDTH * HEIGHT

    def run() -> Any:
        s = (BINS - 1) * (events.t - events.t[0]) / (events.t[-1] - events.t[0])
        k = s.astype(np.int64)
        sign, at = np.where(events.p > 0, 1.0, -1.0), k * size + cells(events)
        grid = np.bincount(at, sign * (1.0 - (s - k)), (BINS + 1) * size)
        grid += np.bincount(at + size, sign * (s - k), (BINS + 1) * size)
        return grid[: BINS * size].astype(np.float32).reshape(BINS, HEIGHT, WIDTH)

    return run, expected_grid


def with_torch(events: Events, device: str, put: bool = False) -> Peer:
    torch = library("torch")
    if device != "cpu" and not torch.cuda.is_available():
        raise Missing("this PyTorch has no CUDA")
    size = WIDTH * HEIGHT
    t = torch.from_numpy(events.t).to(device)
    x, y, p = (
        torch.from_numpy(v.astype(np.int64)).to(device) for v in (events.x, events.y, events.p)
    )

    def run() -> Any:
        grid = torch.zeros((BINS + 1) * size, device=device)
        s = (BINS - 1) * (t - t[0]).double() / (t[-1] - t[0])
        k = s.long()
        end = (s - k).float()
        sign, at = (2 * p - 1).float(), k * size + y * WIDTH + x
        if put:
            grid.put_(at, sign * (1 - end), accumulate=True)
            grid.put_(at + size, sign * end, accumulate=True)
        else:
            grid.index_add_(0, at, sign * (1 - end))
            grid.index_add_(0, at + size, sign * end)
        if device != "cpu":
            torch.cuda.synchronize()
        return grid[: BINS * size].view(BINS, HEIGHT, WIDTH)

    return run, expected_grid


def with_torch_put(events: Events, device: str) -> Peer:
    return with_torch(events, device, put=True)


@cache
def numba_loop() -> Callable[..., None]:
    """Return a loop over events, compiled by Numba."""
    nb = library("numba")

    @nb.njit(fastmath=True)  # type: ignore[untyped-decorator]
    def add(x: Any, y: Any, t: Any, p: Any, grid: Any) -> None:
        scale = (BINS - 1) / (t[-1] - t[0])
        for i in range(len(t)):
            s = (t[i] - t[0]) * scale
            k = min(int(s), BINS - 2)
            sign, end = np.float32(1 if p[i] else -1), np.float32(s - k)
            grid[k, y[i], x[i]] += sign * (np.float32(1.0) - end)
            grid[k + 1, y[i], x[i]] += sign * end

    return add


def with_numba(events: Events, device: str) -> Peer:
    add = numba_loop()

    def run() -> Any:
        grid = np.zeros((BINS, HEIGHT, WIDTH), np.float32)
        add(events.x, events.y, events.t, events.p, grid)
        return grid

    return run, expected_grid


def windows_with_numba(events: Events, device: str) -> Peer:
    add = numba_loop()
    cut = amiwarp.windows(events, count=len(events) // WINDOWS)

    def run() -> Any:
        grids = np.zeros((len(cut), BINS, HEIGHT, WIDTH), np.float32)
        for start, stop, grid in zip(cut.start, cut.stop, grids, strict=True):
            part = events[start:stop]
            add(part.x, part.y, part.t, part.p, grid)
        return grids

    return run, expected_windows


CUDA_SOURCE = r"""
extern "C" __global__ void add(const unsigned short* x, const unsigned short* y, const long long* t,
                               const unsigned char* p, long long n, float scale, int bins, int width, int height,
                               float* grid) {
    const long long i = (long long)blockDim.x * blockIdx.x + threadIdx.x;
    if (i >= n) return;
    const float s = (float)(t[i] - t[0]) * scale;
    const int k = min((int)s, bins - 2);
    const float sign = p[i] ? 1.0f : -1.0f, end = s - k;
    float* at = grid + ((long long)k * height + y[i]) * width + x[i];
    atomicAdd(at, sign * (1.0f - end));
    atomicAdd(at + width * height, sign * end);
}
"""


def with_cupy(events: Events, device: str) -> Peer:
    """A kernel in CUDA C++ with two float atomics per event."""
    cupy = library("cupy")
    kernel = cupy.RawKernel(CUDA_SOURCE, "add")
    x, y, t, p = (cupy.asarray(values) for values in (events.x, events.y, events.t, events.p))
    n, scale = len(events), np.float32((BINS - 1) / (events.t[-1] - events.t[0]))

    def run() -> Any:
        grid = cupy.zeros((BINS, HEIGHT, WIDTH), cupy.float32)
        sizes = np.int32(BINS), np.int32(WIDTH), np.int32(HEIGHT)
        kernel((-(-n // 256),), (256,), (x, y, t, p, np.int64(n), scale, *sizes, grid))
        cupy.cuda.get_current_stream().synchronize()
        return grid

    return run, expected_grid


def with_tonic(events: Events, device: str) -> Peer:
    transforms = library("tonic.transforms")
    transform = transforms.ToVoxelGrid(sensor_size=(WIDTH, HEIGHT, 2), n_time_bins=BINS)
    array = np.zeros(len(events), [("x", "i2"), ("y", "i2"), ("t", "i8"), ("p", "i1")])
    for name in ("x", "y", "t", "p"):
        # Its transform changes p to -1 and 1; a second pass leaves it so
        array[name] = getattr(events, name)
    return lambda: transform(array)[:, 0], lambda these: expected_grid(these, BINS)


def with_evlib(events: Events, device: str) -> Peer:
    module, pl = library("evlib.representations"), library("polars")
    t = events.t.astype("timedelta64[us]")
    columns = {
        "t": t,
        "x": events.x.astype("i2"),
        "y": events.y.astype("i2"),
        "polarity": events.p.astype("i1"),
    }
    table = pl.DataFrame(columns)

    def run() -> Any:
        return module.densify_voxel_grid(
            module.create_voxel_grid(table, HEIGHT, WIDTH, BINS), BINS, HEIGHT, WIDTH
        )[:, 0]

    return run, lambda these: expected_grid(these, BINS)


def with_dv(events: Events, device: str) -> Peer:
    raise Missing("dv-processing has no voxel grid; see its time surface among the latest times")


def dv_surface(events: Events, device: str) -> Peer:
    dv = library("dv_processing")
    store = dv.EventStore()
    for x, y, t, p in zip(
        events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist(), strict=True
    ):
        store.push_back(t + 1, x, y, bool(p))
    surfaces: list[Any] = []

    def run() -> Any:
        surfaces[:] = [dv.TimeSurface((WIDTH, HEIGHT))]
        surfaces[0].accept(store)
        return surfaces[0]

    return run, expected_latest


PEERS: dict[str, tuple[Callable[[Events, str], Peer], tuple[str, ...]]] = {
    "NumPy add.at": (numpy_add_at, ("cpu",)),
    "NumPy bincount": (numpy_bincount, ("cpu",)),
    "Numba, 1 thread": (with_numba, ("cpu",)),
    "PyTorch index_add_": (with_torch, ("cpu", "cuda")),
    "PyTorch put_": (with_torch_put, ("cpu", "cuda")),
    "CuPy, CUDA C++": (with_cupy, ("cuda",)),
    "tonic ToVoxelGrid": (with_tonic, ("cpu",)),
    "evlib create_voxel_grid": (with_evlib, ("cpu",)),
    "dv-processing": (with_dv, ("cpu",)),
}


def array_of(found: Any) -> NDArray[Any]:
    """Return what a program found as a NumPy array."""
    if isinstance(found, np.ndarray):
        return found
    if hasattr(found, "accept"):  # a time surface of dv-processing; times start at 1
        times = np.array([[found.at(y, x) for x in range(WIDTH)] for y in range(HEIGHT)], np.int64)
        return np.where(times == 0, np.iinfo(np.int64).min, times - 1)
    for name in ("cpu", "get"):
        found = getattr(found, name)() if hasattr(found, name) else found
    return np.asarray(found.numpy() if hasattr(found, "numpy") else found)


def error_of(found: NDArray[Any], expected: NDArray[Any]) -> float:
    """Return the largest difference of an element, relative to it where it is larger than 1."""
    if np.issubdtype(expected.dtype, np.integer):
        return float((found != expected).max())
    return float((np.abs(found - expected) / np.maximum(np.abs(expected), 1.0)).max())


def programs(events: Events, device: str) -> tuple[list[Program], list[dict[str, Any]]]:
    """Return the programs to run, and rows of those that are missing."""
    few = events[:PEER_EVENTS]
    out, missing = [], []
    for threads in sorted({1, cpu_threads()}):
        out += ours(few, "cpu", threads)
    out += ours(events, device) if device != "cpu" else []
    for name, (make, kinds) in PEERS.items():
        for kind in kinds:
            there = "cpu" if kind == "cpu" else device
            if there == "cpu" and kind != "cpu":
                continue
            these = few if kind == "cpu" else events
            try:
                run, expected = make(these, there)
                out.append(
                    Program(
                        GRID, f"{name}, {'CUDA' if kind == 'cuda' else kind}", these, run, expected
                    )
                )
            except Missing as error:
                missing.append({"task": GRID, "program": name, "missing": str(error)})
    try:
        name = "Numba, 1 thread, cpu"
        out.append(
            Program(f"{GRID}s of {WINDOWS} windows", name, few, *windows_with_numba(few, "cpu"))
        )
        for number in FEW:
            part = few[:number]
            out.append(Program(small(number), name, part, *with_numba(part, "cpu")))
    except Missing as error:
        missing.append({"task": small(FEW[0]), "program": "Numba", "missing": str(error)})
    try:
        fewer = few[:DV_EVENTS]
        out.append(
            Program(
                "latest times", "dv-processing TimeSurface, cpu", fewer, *dv_surface(fewer, "cpu")
            )
        )
    except Missing as error:
        missing.append(
            {"task": "latest times", "program": "dv-processing TimeSurface", "missing": str(error)}
        )
    return out, missing


def measure(events: Events, device: str, repeats: int) -> list[dict[str, Any]]:
    """Run all programs in turns, and return a row for each."""
    every, missing = programs(events, device)
    walls: list[list[float]] = [[] for _ in every]
    busy: list[list[float]] = [[] for _ in every]
    found: list[Any] = [None for _ in every]
    for _ in range(repeats + 1):
        for k, program in enumerate(every):
            found[k] = None  # frees the memory of the pass before
            with limited_cpu_threads(program.threads):
                wall, processor = time.perf_counter(), time.process_time()
                found[k] = program.run()
                walls[k].append(time.perf_counter() - wall)
                busy[k].append(time.process_time() - processor)
    rows, wanted = [], dict[Any, NDArray[Any]]()
    for program, seconds, processor, result in zip(every, walls, busy, found, strict=True):
        key = program.task, len(program.events), program.name.split()[0] in ("tonic", "evlib")
        if key not in wanted:
            wanted[key] = program.expected(program.events)
        middle = float(np.median(seconds[1:]))
        rows.append({
            "task": program.task, "program": program.name, "events": len(program.events), "ms": middle * 1e3,
            "gev_per_s": len(program.events) / middle * 1e-9,
            "quartiles_ms": [float(v) * 1e3 for v in np.percentile(seconds[1:], [25, 75])],
            "cpu_ns": float(np.median(processor[1:])) / len(program.events) * 1e9,
            "error": error_of(array_of(result), wanted[key]), "ours": program.ours,
        })  # fmt: skip
    tasks = list(dict.fromkeys(program.task for program in every))
    rows.sort(key=lambda row: tasks.index(row["task"]))
    for row in rows:
        print(f"{row['task']:32} {row['program']:28} {row['gev_per_s']:9.4f} Gev/s {row['ms']:9.2f} ms "
              f"{row['cpu_ns']:7.1f} ns/event on the CPU, error {row['error']:.1e}", flush=True)  # fmt: skip
    for row in missing:
        print(f"{row['task']:32} {row['program']:28} missing: {row['missing']}", flush=True)
    return rows + missing


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--events", type=int)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    kind = "cpu" if args.device == "cpu" else "cuda"
    n = args.events or EVENTS[kind]
    before, results = os.getloadavg()[0], {}
    for name, points in (("random pixels", 0), ("20,000 edge points", 20_000)):
        print(f"{name}: {n} events, {WIDTH}x{HEIGHT}")
        results[name] = measure(scene(points, n), args.device, args.repeats)
    packages = ["warp-lang", "numpy", "numba", "torch", "cupy", "tonic", "evlib", "dv-processing"]
    report = {
        "machine": machine(args.device), "cpu": machine("cpu"), "load": [before, os.getloadavg()[0]],
        "versions": versions(packages), "size": [WIDTH, HEIGHT], "bins": BINS, "scenes": results,
    }  # fmt: skip
    (args.out or RESULTS / f"tensors_{kind}.json").write_text(json.dumps(report, indent=1) + "\n")
    wrong = [
        row for rows in results.values() for row in rows if row.get("ours") and row["error"] > BAR
    ]
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
