"""Speed of data sets in bulk, of recordings and of tensors, with the answers compared in the same run.

    python -m benchmarks.dataset [--device cuda] [--items 400] [--limit-s 240] [--folder FOLDER] [--out FILE.json]

Each row makes the same recordings of random pictures in a new folder, with another number of workers: ``recordings``
writes them, ``voxel_grid`` writes a voxel grid of 5 bins for each, by the table ``output`` of the specification. The
two alternate. The checksums of all files are compared between numbers of workers, and tensors with those computed from
the events of the recordings, bit for bit. The speed of a row is that after each worker has made its second recording,
so that start and compilation do not count. ``--device cuda`` compares one GPU with all GPUs of the machine, with one
and with several workers each. ``stages`` says what one recording spends its time on. ``plan`` computes 100,000
recordings on 16 GPUs, or on 32 CPU cores. Without pyarrow the tables are left out. Writes
benchmarks/results/dataset_cpu.json or dataset_cuda.json. The exit status is 1 if a file differs.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from PIL import Image

from amiwarp import DatasetSummary, ToTensor, make_dataset, open_recording, voxel_grid
from amiwarp.io import recorded_dataset
from amiwarp.io.finished_work import read_journal
from amiwarp.kernels.quiet_start import start_quietly
from amiwarp.learning.dataset import files, making
from amiwarp.learning.dataset.digests import content_digest
from amiwarp.learning.dataset.items import Item, list_items
from amiwarp.learning.dataset.specification import load_specification
from amiwarp.learning.dataset.worker import simulation_of, write_recording
from amiwarp.simulation.engine import Engine
from amiwarp.studies.cluster import ANY_GPU, threads_of_worker
from amiwarp.studies.machine import machine, versions
from amiwarp.tasks import cpu_threads, limited_cpu_threads

RESULTS = Path(__file__).parent / "results"
SPECIFICATION = """
format = "amiwarp-dataset-specification"
version = 1
duration_s = {duration}
prisms = [{{apex_deg = 0.5}}, {{apex_deg = 1.0}}]
speeds_rpm = [720.0, 1440.0]
sensors = ["davis346"]
seeds = {seeds}
camera = {{size = [320, 240], fov_deg = 60.0}}
{output}
[[sources]]
{source}
"""
OUTPUTS = {"recordings": "", "voxel_grid": 'output = {representation = "voxel_grid", bins = 5}'}
"""What is written, and the line of the specification that says so."""
CHECKED = 20
"""Number of recordings whose tensors are computed from their events, for comparison."""
PICTURES = 5
"""Number of pictures; with two prisms and two speeds, each seed adds 20 recordings."""
DURATION_S = {"cpu": 0.05, "cuda": 0.3}
PLANNED = 100_000
"""Recordings of the plan."""
PLANNED_DEVICES = {"cpu": 32, "cuda": 16}
"""CPU cores and GPUs of the plan."""
SMI = ("nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits", "-lms", "200")


def write_inputs(folder: Path, seeds: int, duration: float) -> dict[str, Path]:
    """Write pictures of random blocks and specifications: of the pictures for each output, and of a world."""
    rng = np.random.default_rng(0)
    (folder / "pictures").mkdir(parents=True)
    for k in range(PICTURES):
        light = sum(
            np.kron(rng.integers(0, 64, (480 // n, 640 // n)), np.ones((n, n)))
            for n in (8, 20, 40, 80)
        )
        Image.fromarray(np.asarray(light, np.uint8)).save(folder / "pictures" / f"{k}.png")
    paths = {}
    for name, source, output in (
        *(
            ("pictures" if not line else name, 'pictures = "pictures/*.png"', line)
            for name, line in OUTPUTS.items()
        ),
        ("world", 'worlds = ["room"]', ""),
    ):
        some = 1 if name == "world" else seeds
        text = SPECIFICATION.format(duration=duration, seeds=some, source=source, output=output)
        paths[name] = folder / f"{name}.toml"
        paths[name].write_text(text)
    return paths


class BusyMeter:
    """Mean share of the time in which each GPU ran a kernel, from nvidia-smi."""

    def __init__(self, gpu: bool) -> None:
        self._samples: list[tuple[float, float]] = []
        self._process: Any = None
        if gpu and shutil.which(SMI[0]):
            self._process = subprocess.Popen(SMI, stdout=subprocess.PIPE, text=True)
            threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                self._samples.append((time.perf_counter(), float(line) / 100.0))

    def stop(self, began: float, gpus: int) -> float | None:
        """Return the share of the time since ``began`` in which the GPUs in use were busy; None if unknown."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
        found = [share for at, share in self._samples if at >= began]
        visible = max(1, wp.get_cuda_device_count() if wp.is_cuda_available() else 1)
        # Idle GPUs are in the mean
        return float(np.mean(found)) * visible / gpus if found else None


def measure(
    specification: Path, out: Path, device: str, workers: int
) -> tuple[dict[str, Any], dict[str, str]]:
    """Make the data set in a new folder. Return the row, and the checksums by file."""
    finished: list[float] = []
    gpus = 0 if device == "cpu" else wp.get_cuda_device_count() if device == ANY_GPU else 1
    meter = BusyMeter(gpu=gpus > 0)
    began = time.perf_counter()
    done: DatasetSummary = make_dataset(
        specification,
        out,
        workers=workers,
        device=device,
        progress=lambda *_: finished.append(time.perf_counter()),
    )
    warm = min(2 * workers, len(finished) - 2)
    steady_s = finished[-1] - finished[warm]
    found = json.loads((out / recorded_dataset.MANIFEST).read_text())
    # the median leaves out each worker's first recording, which imports and compiles
    times = [line["processor_s"] for line in read_journal(out / files.JOURNAL, dict, [])]
    per_s = (len(finished) - 1 - warm) / steady_s
    row = {
        "device": device, "gpus": gpus, "workers": workers, "items": done.made, "failed": len(done.failed),
        "items_per_s": per_s, "events_per_s": per_s * done.events / done.made, "bytes_per_s": per_s * done.size_bytes /
        done.made, "events_per_item": done.events / done.made, "bytes_per_item": done.size_bytes / done.made,
        "start_s": finished[1] - began, "elapsed_s": done.seconds,
        "worker_busy": done.worker_seconds / (workers * (finished[-1] - finished[0])),
        "processor_busy": done.processor_seconds / (workers * (finished[-1] - finished[0])),
        "processor_s_per_item": float(np.median(times)),
        "gpu_busy": meter.stop(finished[warm], max(1, gpus)),
    }  # fmt: skip
    return row, {item["file"]: item["sha256"] for item in found["items"]}


def equal_tensors(recordings: Path, tensors: Path) -> bool:
    """Return whether tensors are those of the events of the recordings in the other folder, bit for bit."""
    to_grid = ToTensor(voxel_grid, bins=5)
    items = [
        json.loads((folder / recorded_dataset.MANIFEST).read_text())["items"]
        for folder in (recordings, tensors)
    ]
    events = {item["seed"]: item for item in items[0]}
    for item in items[1][:CHECKED]:
        expected = to_grid(open_recording(recordings / events[item["seed"]]["file"]))
        with np.load(tensors / item["file"]) as arrays:
            if not (
                arrays["tensor"].dtype == expected.dtype
                and np.array_equal(arrays["tensor"], expected)
            ):
                return False
    return True


def runs(device: str) -> Iterator[tuple[str, int]]:
    """Yield devices and numbers of workers. The first is the reference of the checksums."""
    if device == "cpu":
        yield from (("cpu", count) for count in sorted({1, 2, cpu_threads()}))
        return
    gpus = wp.get_cuda_device_count()
    for per_gpu in (1, 4, 8):
        yield "cuda:0", per_gpu
        if gpus > 1:
            yield ANY_GPU, per_gpu * gpus


def add_scaling(rows: list[dict[str, Any]]) -> None:
    """Add the speed relative to other rows.

    ``scaling`` is relative to one GPU with as many workers each, or to one worker on the CPU; ``speed_up`` to writing
    recordings with the same workers.
    """
    for row in rows:
        each = row["workers"] // max(1, row["gpus"])
        alike = [r for r in rows if r["output"] == row["output"]]
        base = [r for r in alike if r["gpus"] <= 1 and r["workers"] == (each if row["gpus"] else 1)]
        row["scaling"] = row["items_per_s"] / base[0]["items_per_s"]
        if not row["gpus"]:  # what free cores would give
            row["scaling_of_processor_time"] = (
                row["workers"] * base[0]["processor_s_per_item"] / row["processor_s_per_item"]
            )
        same = [
            r
            for r in rows
            if all(r[k] == row[k] for k in ("gpus", "workers")) and r["output"] == "recordings"
        ]
        row["speed_up"] = row["items_per_s"] / same[0]["items_per_s"]
        row["speed_up_by_processor_time"] = (
            same[0]["processor_s_per_item"] / row["processor_s_per_item"]
        )


def stages(item: Item, folder: Path, device: str) -> dict[str, float]:
    """Return the time of each stage of one recording [s]: the second of two passes, each stage on its own.

    On the CPU, it is the processor time, so that other programs do not count.
    """
    path = folder / f"stages{Path(item.file).suffix}"
    clock = time.process_time if device == "cpu" else time.perf_counter
    times: dict[str, float] = {}
    with limited_cpu_threads(threads_of_worker(device, 1)):
        for _ in range(2):
            began = clock()
            simulation = simulation_of(item, device)
            times["prepare"] = clock() - began
            times["simulate"] = passed(simulation, device, clock, to_host=False)
            to_host = (
                0.0
                if item.output
                else passed(simulation, device, clock, to_host=True) - times["simulate"]
            )
            times["copy to the host"] = to_host
            began = clock()
            write_recording(item, path, device)
            rest = (
                clock() - began - times["prepare"] - times["simulate"] - times["copy to the host"]
            )
            times["encode and write"] = rest
            began = clock()
            content_digest(path)
            times["checksum"] = clock() - began
    return {name: max(0.0, seconds) for name, seconds in times.items()}


def passed(simulation: Any, device: str, clock: Callable[[], float], to_host: bool) -> float:
    """Return the duration of a simulation [s], with its events left on the device or copied to the host."""
    began = clock()
    engine = Engine(simulation)
    for block in engine.run():
        if to_host:
            block.events()
            block.truth()
    wp.synchronize_device(device)
    return clock() - began


def plan(rows: list[dict[str, Any]], of: list[dict[str, Any]], kind: str) -> dict[str, Any]:
    """Return the time and size of many recordings on many devices, and the stage that limits them.

    GPUs take the speed of the fastest row with all GPUs; CPU cores the processor time of the row with most workers.
    """
    units = PLANNED_DEVICES[kind]
    rows = [row for row in rows if row["output"] == "recordings"]
    most = max(row["gpus"] or row["workers"] for row in rows)
    best = max(
        (row for row in rows if (row["gpus"] or row["workers"]) == most),
        key=lambda row: row["items_per_s"],
    )
    rate = units * (
        best["items_per_s"] / best["gpus"] if best["gpus"] else 1.0 / best["processor_s_per_item"]
    )
    (one,) = (row for row in of if row["source"] == "pictures")
    slowest = max(
        (name for name in one if isinstance(one[name], float)), key=lambda name: one[name]
    )
    return {
        "recordings": PLANNED, "devices": units, "unit": "GPUs" if kind == "cuda" else "CPU cores",
        "workers_per_device": best["workers"] // max(1, best["gpus"]) if kind == "cuda" else 1,
        "hours": PLANNED / rate / 3600.0, "terabytes": PLANNED * best["bytes_per_item"] / 1e12,
        "disk_mb_per_s": rate * best["bytes_per_item"] / 1e6, "events": PLANNED * best["events_per_item"],
        "bottleneck": slowest, "bottleneck_share": one[slowest] / sum(v for v in one.values() if isinstance(v, float)),
    }  # fmt: skip


def leave_out_tables() -> None:
    """Leave out the Parquet tables on a machine without pyarrow."""
    making.require_pyarrow = lambda: None
    files._write_table = lambda path, rows: None


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu", choices=("cpu", ANY_GPU))
    parser.add_argument(
        "--items", type=int, help="recordings of a row, rounded up to a multiple of 20"
    )
    parser.add_argument(
        "--limit-s", type=float, default=240.0, help="start no new row after this time [s]"
    )
    parser.add_argument(
        "--folder",
        type=Path,
        help="folder on the disk to measure; default: that of temporary files",
    )
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    try:
        making.require_pyarrow()
    except ValueError:
        leave_out_tables()
    seeds = -(-(args.items or {"cpu": 40, "cuda": 400}[args.device]) // 20)
    start_quietly()
    began = time.perf_counter()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        folder = Path(name)
        inputs = write_inputs(folder, seeds, DURATION_S[args.device])
        device = "cpu" if args.device == "cpu" else "cuda:0"
        of = [
            {"source": kind, **stages(list_items(load_specification(path))[0], folder, device)}
            for kind, path in inputs.items()
        ]
        print(json.dumps(of), flush=True)
        reference: dict[str, dict[str, str]] = {}
        for where, workers in runs(args.device):
            if rows and time.perf_counter() - began > args.limit_s:
                print(
                    f"left out after {args.limit_s:g} s: {workers} workers on {where}", flush=True
                )
                continue
            for output in OUTPUTS:
                path = inputs["pictures" if output == "recordings" else output]
                row, found = measure(path, folder / output, where, workers)
                row["equal_to_one_worker"] = found == reference.setdefault(output, found)
                row["output"], row["tensors_equal"] = output, None
                if output != "recordings":
                    row["tensors_equal"] = equal_tensors(folder / "recordings", folder / output)
                rows.append(row)
                print(json.dumps(row), flush=True)
            for output in OUTPUTS:
                shutil.rmtree(folder / output)
    add_scaling(rows)
    result = {
        "benchmark": "dataset", "date": time.strftime("%Y-%m-%d"), "machine": machine(device),
        "cores": cpu_threads(), "load": os.getloadavg()[0], "versions": versions(("warp-lang", "distributed")),
        "measured": True, "recording": "320x240, 60 deg, davis346, apex 0.5 and 1 deg, 720 and 1440 rpm",
        "duration_s": DURATION_S[args.device], "stages": of, "rows": rows, "plan": plan(rows, of, args.device),
    }  # fmt: skip
    out = args.out or RESULTS / f"dataset_{args.device}.json"
    out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result["plan"], indent=1))
    right = all(
        row["equal_to_one_worker"] and row["tensors_equal"] is not False and not row["failed"] and
        row["items"] == 20 * seeds for row in rows
    )  # fmt: skip
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
