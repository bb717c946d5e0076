"""Throughput of one and of several GPUs: one Dask worker for each GPU, the same tasks, and their results compared.

    python -m benchmarks.two_gpus [--device cuda] [--workers 2] [--seconds 5] [--jobs files atlas dataset] [--out FILE]

Each job runs first on one worker, then on all of them. A worker sees one GPU and an equal share of the processor's
cores, as if the other workers were on other machines; the last rows give one worker all cores. Every worker runs a task
of each job before the clock starts, so compilation does not count; the number of tasks is chosen so that one worker
takes about ``--seconds``. ``--device cpu`` compares worker processes without GPUs. Files are compared bit for bit,
calibrations by their outcome and error, with those of one worker and with a few made by this process. Files and data
sets share the disk, and the cores encode and write them, so these jobs can scale worse than their GPUs. Writes
benchmarks/results/two_gpus_cuda.json or two_gpus_cpu.json. The exit status is 1 if a result differs.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp import compensate, make_dataset, open_recording
from amiwarp.io import recorded_dataset
from amiwarp.kernels.quiet_start import start_quietly
from amiwarp.learning.dataset import making
from amiwarp.learning.dataset.digests import content_digest
from amiwarp.learning.dataset.items import Item, list_items
from amiwarp.learning.dataset.specification import load_specification
from amiwarp.learning.dataset.worker import simulation_of, write_recording
from amiwarp.studies.cluster import ANY_GPU, LOCAL_CONFIGURATION, run_jobs, start_workers
from amiwarp.studies.machine import machine, processor, versions
from amiwarp.studies.stability.axes import AXES, Axis
from amiwarp.studies.stability.cells import Store, Stored, cells_of, run_cell
from amiwarp.studies.stability.cells import run as run_cells
from amiwarp.studies.stability.condition import Cell
from amiwarp.studies.stability.judging import METHODS
from amiwarp.tasks import cpu_threads
from benchmarks import compensate as file_benchmark
from benchmarks import simulate
from benchmarks.dataset import RESULTS, leave_out_tables, write_inputs

FILE_EVENTS = {"cpu": 4_000_000, "cuda": 10_000_000}
"""Number of events of each file."""
DURATION_S = {"cpu": 0.05, "cuda": 0.3}
"""Duration of each recording of the data set [s]."""
OF_PICTURES = 20
"""Recordings of the data set for each seed of its specification."""
VALUES = 4
"""Number of values of the atlas's axis; each seed adds as many cells."""
AXIS = "background noise"
MOST_PX = {"files": 1e-3, "atlas": 0.1, "dataset": 0.1}
"""Largest accepted error of each job [px]."""
CLOSE_PX = 1e-3
"""Largest accepted difference between the errors of the same calibration on two workers [px]."""
SAMPLE = 2
"""Number of tasks of each job that this process also runs."""


@dataclass(frozen=True)
class FileTask:
    """File to compensate, with a prism phase of its own, so that every result differs."""

    source: Path
    out: Path
    number: int
    device: str

    @property
    def phase(self) -> float:
        """Phase of the prism [rad]."""
        return file_benchmark.PHASE + 0.01 * self.number


def compensate_file(task: FileTask) -> int:
    """Compensate a file by the exact model; return its number of events."""
    calibration = file_benchmark.calibrated("exact", task.phase)
    return compensate(
        open_recording(task.source), calibration, task.out, device=task.device, overwrite=True
    ).events


@dataclass(frozen=True)
class Place:
    """Inputs that all jobs share. Workers get it with their tasks."""

    folder: Path
    device: str
    """Device of each process: cpu or cuda:0, which is the GPU that a worker sees."""

    @property
    def kind(self) -> str:
        return "cpu" if self.device == "cpu" else "cuda"

    @property
    def source(self) -> Path:
        return self.folder / "recording.h5"

    def files(self, out: Path, count: int) -> list[FileTask]:
        return [FileTask(self.source, out / f"{k}.h5", k, self.device) for k in range(count)]

    def items(self, tasks: int) -> list[Item]:
        return list_items(load_specification(self.specification(tasks)))

    def specification(self, tasks: int) -> Path:
        """Return the specification of a data set of ``tasks`` recordings, a multiple of :data:`OF_PICTURES`."""
        folder = self.folder / f"inputs-{tasks}"
        if not folder.exists():
            write_inputs(folder, tasks // OF_PICTURES, DURATION_S[self.kind])
        return folder / "pictures.toml"


def axis() -> Axis:
    (found,) = (a for a in AXES if a.name == AXIS)
    return replace(found, values=found.values[:VALUES])


def known(cell: Stored) -> dict[str, Any]:
    """Return the result of a cell without what may differ: its time and its machine."""
    (result,) = cell.results.values()
    return {"events": cell.events, "outcome": result.outcome.value, "error_px": result.error_px,
            "message": result.message, "deviations": result.deviations}  # fmt: skip


@dataclass(frozen=True)
class Done:
    """Results of all tasks of a job."""

    seconds: float
    events: int
    found: dict[str, Any]
    """Checksum of each file, or result of each cell, by its name."""


def run_files(place: Place, scheduler: str, tasks: int) -> Done:
    out = place.folder / "files"
    out.mkdir()
    with start_workers("benchmarks.two_gpus", "cluster", scheduler, 0, place.device) as workers:
        began = time.perf_counter()
        done = [
            future.result()
            for _, future in run_jobs(workers, compensate_file, place.files(out, tasks))
        ]
        seconds = time.perf_counter() - began
    found = {path.name: content_digest(path) for path in sorted(out.iterdir())}
    shutil.rmtree(out)
    return Done(seconds, sum(done), found)


def run_atlas(place: Place, scheduler: str, tasks: int) -> Done:
    cells = place.folder / "cells"
    cells.mkdir()
    with start_workers("benchmarks.two_gpus", "cluster", scheduler, 0, place.device) as workers:
        began = time.perf_counter()
        done = run_cells(
            cells_of([axis()], tasks // VALUES),
            METHODS[:1],
            Store(cells),
            workers,
            device=place.device,
        )
        seconds = time.perf_counter() - began
    shutil.rmtree(cells)
    return Done(seconds, sum(c.events for c in done), {c.cell.name: known(c) for c in done})


def run_dataset(place: Place, scheduler: str, tasks: int) -> Done:
    out, specification = place.folder / "dataset", place.specification(tasks)
    began = time.perf_counter()
    done = make_dataset(
        specification, out, scheduler=scheduler, device="cpu" if place.device == "cpu" else ANY_GPU
    )
    seconds = time.perf_counter() - began
    if done.failed:
        raise SystemExit(f"recordings failed: {done.failed}")
    items = json.loads((out / recorded_dataset.MANIFEST).read_text())["items"]
    shutil.rmtree(out)
    return Done(seconds, done.events, {item["file"]: item["sha256"] for item in items})


def one_file(place: Place, number: int) -> tuple[str, Any]:
    with tempfile.TemporaryDirectory(dir=place.folder) as name:
        task = FileTask(place.source, Path(name) / f"{number}.h5", number, place.device)
        compensate_file(task)
        return task.out.name, content_digest(task.out)


def one_cell(place: Place, number: int) -> tuple[str, Any]:
    cell = Cell(axis().conditions()[number % VALUES], number // VALUES)
    return cell.name, known(run_cell(cell, METHODS[:1], place.device))


def one_recording(place: Place, number: int) -> tuple[str, Any]:
    items = place.items(OF_PICTURES * (1 + number // OF_PICTURES))
    item = items[number]
    with tempfile.TemporaryDirectory(dir=place.folder) as name:
        path = Path(name) / "recording.h5"
        write_recording(item, path, place.device)
        return item.file, content_digest(path)


@dataclass(frozen=True)
class Job:
    """Job that workers share."""

    all: Callable[[Place, str, int], Done]
    """Function that runs a number of tasks on the workers of a scheduler."""
    one: Callable[[Place, int], tuple[str, Any]]
    """Function that runs the task with a number in this process; returns its name and its result."""
    each: int
    """The number of tasks is a multiple of this number."""


JOBS = {
    "files": Job(run_files, one_file, 1),
    "atlas": Job(run_atlas, one_cell, VALUES),
    "dataset": Job(run_dataset, one_recording, OF_PICTURES),
}


def warm_up(place: Place, names: list[str]) -> tuple[str, dict[str, float]]:
    """Run two tasks of each job; return the GPU, or the number of cores, and the time of each second task [s]."""
    start_quietly()
    times = {}
    for name in names:
        JOBS[name].one(place, 0)
        began = time.perf_counter()
        JOBS[name].one(place, 1)
        times[name] = time.perf_counter() - began
    where = (
        wp.get_device(place.device).pci_bus_id
        if place.device != "cpu"
        else f"{cpu_threads()} cores"
    )
    return where, times


def prepare(gpus: tuple[str, ...], cores: tuple[frozenset[int], ...], dask_worker: Any) -> None:
    """Give a worker its GPU, before CUDA starts in its process, and its cores."""
    number = int(dask_worker.name)
    if gpus:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[number % len(gpus)]
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), cores[number])


@contextlib.contextmanager
def cluster(count: int, share: int, gpus: tuple[str, ...]) -> Iterator[Any]:
    """Yield a client of ``count`` workers with ``share`` cores each."""
    import dask
    from distributed import Client, LocalCluster

    mine = sorted(os.sched_getaffinity(0))
    cores = tuple(frozenset(mine[k * share : (k + 1) * share] or mine) for k in range(count))
    with (
        dask.config.set(LOCAL_CONFIGURATION),
        LocalCluster(
            n_workers=count, threads_per_worker=1, dashboard_address="127.0.0.1:0", memory_limit=0
        ) as local,
        Client(local) as client,
    ):
        client.register_worker_callbacks(partial(prepare, gpus, cores))
        yield client


def error_px(name: str, place: Place, done: Done) -> float:
    """Return the error of a job [px].

    ``files``: worst position of the first file; ``atlas``: median over the cells that did not refuse; ``dataset``: rms
    error of the positions of the first recording's events.
    """
    if name == "atlas":
        return float(
            np.median([r["error_px"] for r in done.found.values() if r["error_px"] is not None])
        )
    if name == "dataset":
        return simulate.error_px(simulation_of(place.items(OF_PICTURES)[0], place.device))
    with tempfile.TemporaryDirectory(dir=place.folder) as folder:
        task = FileTask(place.source, Path(folder) / "0.h5", 0, place.device)
        compensate_file(task)
        recording = open_recording(task.source)
        n = len(recording.events)
        model = file_benchmark.calibrated("exact", task.phase).model
        found = file_benchmark.errors(
            "exact", model, recording.encoder, recording, task.source, task.out, n, task.phase
        )
        return max(found)


def difference(name: str, a: dict[str, Any], b: dict[str, Any]) -> float:
    """Return the largest difference of the results that both have [px]; infinite if they differ otherwise."""
    common = a.keys() & b.keys()
    if name != "atlas":
        return 0.0 if common and all(a[k] == b[k] for k in common) else math.inf
    if not common or any(
        a[k]["outcome"] != b[k]["outcome"] or a[k]["events"] != b[k]["events"] for k in common
    ):
        return math.inf
    return max(abs((a[k]["error_px"] or 0.0) - (b[k]["error_px"] or 0.0)) for k in common)


def measure(
    args: argparse.Namespace, place: Place, gpus: tuple[str, ...], began: float
) -> Iterator[dict[str, Any]]:
    """Run every job on one and on all workers; yield the rows."""
    first: dict[str, Done] = {}
    tasks: dict[str, int] = {}
    share = max(1, cpu_threads() // args.workers)
    alone = {name: dict(JOBS[name].one(place, k) for k in range(SAMPLE)) for name in args.jobs}
    runs = [
        (1, share),
        (args.workers, share),
        *([(1, cpu_threads())] if cpu_threads() > share else []),
    ]
    for count, cores in runs:
        if first and time.perf_counter() - began > args.limit_s:
            print(
                f"left out after {args.limit_s:g} s: {count} workers with {cores} cores", flush=True
            )
            continue
        with cluster(count, cores, gpus) as client:
            addresses = sorted(client.nthreads())
            warm = [
                client.submit(warm_up, place, args.jobs, workers=[a], pure=False) for a in addresses
            ]
            places, times = zip(*client.gather(warm), strict=True)
            print(
                f"{time.perf_counter() - began:5.1f} s  {count} workers, {cores} cores each, {places}",
                flush=True,
            )
            for name in args.jobs:
                each = JOBS[name].each
                tasks.setdefault(
                    name, each * max(-(-4 // each), round(args.seconds / times[0][name] / each))
                )
                done = JOBS[name].all(place, client.scheduler.address, tasks[name])
                base = first.setdefault(name, done)
                of_one, of_alone = (
                    difference(name, base.found, done.found),
                    difference(name, alone[name], done.found),
                )
                same = (
                    all(done.found[k] == v for k, v in alone[name].items())
                    and done.found == base.found
                )
                yield {
                    "job": name, "workers": count, "cores_per_worker": cores, "places": sorted(places),
                    "tasks": tasks[name], "seconds": done.seconds, "per_s": tasks[name] / done.seconds,
                    "events_per_s": done.events / done.seconds, "ratio": base.seconds / done.seconds,
                    "identical": same, "difference_px": max(of_one, of_alone), "error_px": error_px(name, place, done),
                }  # fmt: skip


def wrong(row: dict[str, Any], gpus: tuple[str, ...]) -> bool:
    """Return whether results differ, the error is too large, or workers shared a GPU."""
    apart = not gpus or len(set(row["places"])) == min(row["workers"], len(gpus))
    return not (
        apart and row["difference_px"] <= CLOSE_PX and row["error_px"] <= MOST_PX[row["job"]]
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda", choices=("cpu", ANY_GPU))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--jobs", nargs="+", choices=JOBS, default=list(JOBS))
    parser.add_argument("--seconds", type=float, default=5.0, help="time of each job on one worker")
    parser.add_argument(
        "--limit-s", type=float, default=45.0, help="start no further workers after this time"
    )
    parser.add_argument("--events", type=int, help="events of each file")
    parser.add_argument(
        "--folder",
        type=Path,
        help="folder on the disk to measure; default: that of temporary files",
    )
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    began = time.perf_counter()
    try:
        making.require_pyarrow()
    except ValueError:
        leave_out_tables()
    start_quietly()
    gpus = () if args.device == "cpu" else tuple(map(str, range(wp.get_cuda_device_count())))
    device = "cpu" if args.device == "cpu" else "cuda:0"
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        place = Place(Path(name), device)
        file_benchmark.make(place.source, args.events or FILE_EVENTS[place.kind], columns=False)
        about = {
            "benchmark": "two_gpus", "date": time.strftime("%Y-%m-%d"), "machine": machine(device),
            "host": processor(), "cores": cpu_threads(), "gpus": len(gpus), "load": os.getloadavg()[0],
            "versions": versions(("warp-lang", "distributed")), "file_events": args.events or FILE_EVENTS[place.kind],
            "duration_s": DURATION_S[place.kind], "axis": AXIS,
        }  # fmt: skip
        out = args.out or RESULTS / f"two_gpus_{place.kind}.json"
        for row in measure(args, place, gpus, began):
            rows.append(row)
            print(json.dumps(row), flush=True)
            result = about | {"elapsed_s": time.perf_counter() - began, "rows": rows}
            # So that an interrupted run keeps its rows
            out.write_text(json.dumps(result, indent=1) + "\n")
    bad = [row["job"] for row in rows if wrong(row, gpus)]
    print(f"wrong: {', '.join(bad)}" if bad else "all results agree")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
