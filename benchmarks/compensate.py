"""Speed of the compensation of a file, including reading and writing, and the error of the same run.

    python -m benchmarks.compensate [--events 100000000] [--device cuda:0] [--models circle exact] [--out FILE]

The recording is half a second (six turns) of the simulator at 640x480, 60 degrees and 720 turns/min, repeated up to the
number of events. Each row runs in a separate process, so that its peak memory can be measured.

``copy_s`` is the time to read as many bytes as the recording has and to write as many as the result has, without any
processing. ``alone_mev_per_s`` is the rate of each stage without the others. ``cpu_ns`` is the processor time per
event, which depends less on other load than the elapsed time. Neither the result nor the copy is flushed to the disk.
If the file is not in the page cache, run the benchmark twice.

With ``--columns`` both files are plain binary columns, for machines without HDF5's filters. This measures everything
except the coding of chunks. The exit status is 1 if a sample of the result is more than 1e-3 px from an independent
float64 trace, or if times, polarities or flags differ.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import json
import math
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp import (
    Calibration,
    Camera,
    Encoder,
    Events,
    Model,
    Prism,
    RecordingWriter,
    compensate,
    open_recording,
)
from amiwarp.compensation.gpu_pieces import PIECE
from amiwarp.compensation.in_memory import BlockCompensator
from amiwarp.events.recording import inside_image
from amiwarp.optics.models.registry import MODELS
from amiwarp.tasks import cpu_threads, in_order
from benchmarks.simulate import FOV, HEIGHT, INDEX, WIDTH, blocks_picture
from reference import optics as oracle

APEX, PHASE, RPM, REPEATED_US = math.radians(2.0), 0.7, 720.0, 500_000
CAMERA, PRISM = Camera.from_fov(WIDTH, HEIGHT, FOV), Prism(APEX, INDEX)
BAR_PX = 1e-3
ALONE = 20_000_000
"""Number of events with which each stage is measured without the other stages."""
SAMPLES, SAMPLE = 40, 5000
"""Number of pieces of a written file that are compared with the truth, and events per piece."""
COLUMNS = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.uint8}
MOVED = {"x": np.float32, "y": np.float32, "t": np.int64, "p": np.uint8, "inside": np.uint8}


def half_a_second() -> Events:
    from amiwarp.simulation.description import Scene
    from amiwarp.simulation.encoder_model import EncoderModel
    from amiwarp.simulation.simulator import Simulation

    scene = Scene.from_picture(blocks_picture())
    simulation = Simulation(
        scene, CAMERA, PRISM, REPEATED_US * 1e-6, encoder_model=EncoderModel.ideal()
    )
    events = Events.concatenate([block for block, _points in simulation.blocks()])
    return events[(events.t >= 0) & (events.t < REPEATED_US)]


def repeated(once: Events, events: int) -> Iterator[Events]:
    done = 0
    while done < events:
        turn = once[: events - done]
        yield Events(turn.x, turn.y, turn.t + done // len(once) * REPEATED_US, turn.p)
        done += len(turn)


def make(path: Path, events: int, columns: bool) -> None:
    """Write the recording: a file in the native format, or a folder of plain binary columns."""
    once = half_a_second()
    encoder = Encoder.constant_speed(RPM, 0, (events // len(once) + 2) * REPEATED_US)
    if columns:
        path.mkdir()
        with contextlib.ExitStack() as stack:
            files = {name: stack.enter_context((path / name).open("wb")) for name in COLUMNS}
            for block in repeated(once, events):
                for name, file in files.items():
                    getattr(block, name).tofile(file)
        return
    with RecordingWriter(
        path, width=WIDTH, height=HEIGHT, camera=CAMERA, prism=PRISM, encoder=encoder
    ) as writer:
        for block in repeated(once, events):
            writer.append(block)


class Bare:
    """Stand-in for HDF5: a folder of plain binary columns, read and written by threads."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.count = (path / "p").stat().st_size

    def read(self, start: int, dtypes: dict[str, Any], count: int = PIECE) -> dict[str, Any]:
        count = min(count, self.count - start)
        return {
            name: np.fromfile(
                self.path / name, dtype, count, offset=start * np.dtype(dtype).itemsize
            )
            for name, dtype in dtypes.items()
        }

    def piece(self, start: int) -> Events:
        return Events(**self.read(start, COLUMNS))

    def compensate(self, out: Path, mover: BlockCompensator) -> None:
        out.mkdir()

        def job(start: int) -> dict[str, Any]:
            events, inside = mover(self.piece(start))
            return {name: getattr(events, name) for name in COLUMNS} | {"inside": inside}

        with contextlib.ExitStack() as stack:
            files = {
                name: stack.enter_context((out / name).open("wb", buffering=0)) for name in MOVED
            }
            for columns in in_order(partial(job, start) for start in range(0, self.count, PIECE)):
                for name, file in files.items():
                    file.write(columns[name])


def calibrated(name: str, phase: float = PHASE) -> Calibration:
    """Return a calibration with the true parameters."""
    size = (
        {"apex": PRISM.apex} if name in ("exact", "ellipse") else {"deflection": PRISM.deflection}
    )
    return Calibration(
        model_name=name, camera=CAMERA, prism=PRISM, parameters={**size, "phase": phase}, uncertainty={}, free=(),
        sharpness_name="variance", sharpness_before=0.0, sharpness_after=0.0, stages=(), events=0, seconds=0.0,
    )  # fmt: skip


def seconds(work: Callable[[], Any]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def truth(
    name: str, model: Any, xy: Any, theta: Any, prism: Prism = PRISM, phase: float = PHASE
) -> Any:
    """Return the true positions by the float64 oracle of the tests; for the ellipse, by its own tables in float64."""
    if name == "ellipse":
        phi = (theta + PHASE)[:, None]
        at = xy[:, 1].astype(int), xy[:, 0].astype(int)
        return xy + model.offset[at] + model.cosine[at] * np.cos(phi) + model.sine[at] * np.sin(phi)
    return oracle.place(name, CAMERA, prism, xy, theta, phase=phase)


def error_of(
    name: str, model: Any, encoder: Encoder, raw: Events, moved: Events, inside: Any, prism: Prism = PRISM,
    phase: float = PHASE,
) -> float:  # fmt: skip
    """Return the largest distance to the truth [px]; infinite if times, polarities or flags differ."""
    xy = np.stack([raw.x, raw.y], axis=1).astype(np.float64)
    found = np.stack([moved.x, moved.y], axis=1)
    away = np.linalg.norm(
        found - truth(name, model, xy, encoder.angle_at(raw.t), prism, phase), axis=1
    )
    same = np.array_equal(raw.t, moved.t) and np.array_equal(raw.p, moved.p)
    same &= np.array_equal(inside.astype(bool), inside_image(*found.T, WIDTH, HEIGHT))
    return float(away.max()) if same and np.isfinite(away).all() else math.inf


def plain_copy(source: Path, result: Path, folder: Path) -> float:
    """Return the time to read ``source`` and to write as many bytes as ``result`` has [s]."""

    def files(path: Path) -> list[Path]:
        return sorted(path.iterdir()) if path.is_dir() else [path]

    def copy() -> None:
        piece = bytearray(1 << 20)
        for path in files(source):
            with path.open("rb", buffering=0) as file:
                while file.readinto(piece):
                    pass
        with (folder / "copy").open("wb", buffering=0) as out:
            for _ in range(sum(path.stat().st_size for path in files(result)) >> 20):
                out.write(piece)

    try:
        return seconds(copy)
    finally:
        (folder / "copy").unlink()


def moved_again(
    events: Events, inside: Any, piece: int
) -> tuple[Events, Any, dict[str, list[bytes]]]:
    return (
        Events(events.x, events.y, events.t + piece * int(events.t[-1] - events.t[0]), events.p),
        inside,
        {},
    )


def stages_alone(recording: Any, mover: BlockCompensator, folder: Path) -> dict[str, float]:
    """Return the speed of each stage without the other stages, over all cores [million events/s]."""
    reads = list(recording.events.pieces(PIECE))[: ALONE // PIECE]
    count = min(len(reads) * PIECE, len(recording.events))
    held = [read() for read in reads[:8]]
    moved, inside = mover(held[0])

    def write() -> None:
        with RecordingWriter(
            folder / "alone.h5", width=WIDTH, height=HEIGHT, overwrite=True
        ) as writer:
            pieces = (partial(moved_again, moved, inside, k) for k in range(len(reads)))
            for _ in writer.fill(pieces, count=PIECE, t_first=int(moved.t[0])):
                pass

    def drain(jobs: Iterator[Callable[[], Any]]) -> None:
        for _ in in_order(jobs):
            pass

    stages = {
        "read": lambda: drain(iter(reads)),
        "move": lambda: drain(partial(mover, held[k % len(held)]) for k in range(len(reads))),
        "write": write,
    }
    rates = {
        name: count / 1e6 / min(seconds(work) for _ in range(2)) for name, work in stages.items()
    }
    (folder / "alone.h5").unlink()
    return rates


def peak_mib() -> float:
    """Return the peak memory of this process [MiB], without that of its parent."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024.0
    return math.nan


def row(source: Path, name: str, device: str, repeats: int, columns: bool) -> dict[str, Any]:
    folder, calibration = source.parent, calibrated(name)
    result: dict[str, Any] = {
        "model": name,
        "device": device,
        "layout": "columns" if columns else "native",
    }
    out = folder / ("moved" if columns else "moved.h5")
    times, copies, cpu = [], [], []
    bare = Bare(source) if columns else None
    recording = None if columns else open_recording(source)
    encoder = (
        Encoder.constant_speed(RPM, 0, int(bare.piece(bare.count - 1).t[0]))
        if bare
        else recording.encoder
    )
    first, last = (
        (0, int(encoder.t[-1])) if bare else (recording.events.t_first, recording.events.t_last)
    )
    began = time.perf_counter()
    mover = BlockCompensator(calibration.model, encoder, first, last, device)
    mover(bare.piece(0) if bare else recording.events.slice(0, PIECE))
    result["compile_s"] = time.perf_counter() - began
    for _ in range(repeats):
        began_cpu = time.process_time()
        for path in sorted(out.iterdir()) if out.is_dir() else [out]:
            path.unlink(missing_ok=True)
        if out.is_dir():
            out.rmdir()
        if bare:
            times.append(seconds(lambda: bare.compensate(out, mover)))
        else:
            times.append(seconds(lambda: compensate(recording, calibration, out, device=device)))
        cpu.append(time.process_time() - began_cpu)
        result["peak_mib"] = peak_mib()
        copies.append(plain_copy(source, out, folder))
    n = bare.count if bare else len(recording.events)
    middle, copy = float(np.median(times)), float(np.median(copies))
    result |= {
        "events": n,
        "seconds": times,
        "mev_per_s": n / middle / 1e6,
        "copy_s": copies,
        "of_copy": middle / copy,
    }
    result["cpu_ns"] = [spent / n * 1e9 for spent in cpu]
    for key, path in (("bytes_in", source), ("bytes_out", out)):
        result[key] = sum(p.stat().st_size for p in (path.iterdir() if columns else [path]))
    result["error_px"] = max(errors(name, calibration.model, encoder, recording, source, out, n))
    if not bare:
        result["alone_mev_per_s"] = stages_alone(recording, mover, folder)
    return result


def pieces(n: int) -> list[tuple[int, int]]:
    """Return ranges of events that are spread over a recording of ``n``."""
    starts = np.linspace(0, max(n - SAMPLE, 0), SAMPLES).astype(int).tolist()
    return [(start, min(start + SAMPLE, n)) for start in starts]


def errors(
    name: str,
    model: Model,
    encoder: Encoder,
    recording: Any,
    source: Path,
    out: Path,
    n: int,
    phase: float = PHASE,
) -> Iterator[float]:
    """Yield the error of short pieces spread over the written file."""
    written = None if recording is None else open_recording(out).events
    for start, stop in pieces(n):
        if written is None:
            raw = Events(**Bare(source).read(start, COLUMNS, SAMPLE))
            columns = Bare(out).read(start, MOVED, SAMPLE)
            inside = columns.pop("inside")
            moved = Events(**columns)
        else:
            raw, moved, inside = (
                recording.events.slice(start, stop),
                written.slice(start, stop),
                written.inside(start, stop),
            )
        yield error_of(name, model, encoder, raw, moved, inside, phase=phase)


def about(device: str) -> dict[str, Any]:
    from amiwarp.studies.machine import processor

    wp.init()
    found = {"python": platform.python_version()}
    for name in ("warp-lang", "numpy", "h5py", "hdf5plugin", "blosc"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    machine = f"{processor()}, {cpu_threads()} cores"
    return {"machine": machine, "device": wp.get_device(device).name, "versions": found}


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--events", type=int, default=100_000_000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--models", nargs="+", choices=list(MODELS), default=["circle", "exact"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--columns", action="store_true", help="plain binary columns instead of HDF5"
    )
    parser.add_argument(
        "--folder", type=Path, help="folder for the files (default: a temporary folder)"
    )
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--row", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    a = arguments()
    if a.row:
        print(json.dumps(row(a.row, a.models[0], a.device, a.repeats, a.columns)))
        return
    result = about(a.device) | {"rows": []}
    with tempfile.TemporaryDirectory(dir=a.folder) as folder:
        source = Path(folder) / ("recording" if a.columns else "recording.h5")
        child = [
            sys.executable,
            "-m",
            "benchmarks.compensate",
            "--device",
            a.device,
            "--repeats",
            str(a.repeats),
        ]
        child += ["--columns"] * a.columns
        make(source, a.events, a.columns)
        for name in a.models:
            ran = subprocess.run(
                [*child, "--row", str(source), "--models", name], stdout=subprocess.PIPE, check=True
            )
            result["rows"].append(json.loads(ran.stdout.splitlines()[-1]))
            print(json.dumps(result["rows"][-1]), flush=True)
    if a.out:
        a.out.write_text(json.dumps(result, indent=1) + "\n")
    wrong = [r["model"] for r in result["rows"] if not r["error_px"] <= BAR_PX]
    if wrong:
        raise SystemExit(f"errors above {BAR_PX} px: {', '.join(wrong)}")


if __name__ == "__main__":
    main()
