"""Time and memory of each command on a recording of a billion events, and the error of the same run.

    python -m benchmarks.long_recording [--events 1000000000] [--device cuda:0] [--folder FOLDER] [--out FILE.json]

The recording is half a second (six turns) of the simulator at 640x480, 60 degrees and 720 turns/min, repeated up to the
number of events. Each command runs as a process of its own, as a user starts it, whose peak memory is measured. The
folder needs about 30 bytes per event. The exit status is 1 if a result is wrong or a command needs more memory than
:data:`MOST_MIB`; the row is printed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp import Calibration, Events, ExactModel, Prism, model_error, open_recording
from amiwarp.studies.machine import processor
from amiwarp.tasks import cpu_threads
from benchmarks.compensate import CAMERA, PRISM, SAMPLE, SAMPLES, error_of, make, pieces
from benchmarks.simulate import blocks_picture

MOST_MIB = 1536.0
"""Largest peak memory of a command [MiB]."""
MEASURE = """
import resource, subprocess, sys, time
began = time.perf_counter()
status = subprocess.run(sys.argv[1:]).returncode
seconds = time.perf_counter() - began
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(f"\\n{seconds} {used.ru_utime + used.ru_stime} {used.ru_maxrss / 1024}")
sys.exit(status)
"""
"""Small program that runs a command and prints its time [s], processor time [s] and peak memory [MiB].

Linux counts the memory of the starting program towards the peak of what it starts; this program needs little.
"""


@dataclass(frozen=True)
class Command:
    """Command of amiwarp whose run is measured."""

    name: str
    arguments: tuple[str, ...]
    error: Callable[[Path], float]
    """Function that returns the error of the result in the folder."""
    bar: float
    """Largest accepted error."""
    unit: str


def same_events(folder: Path, name: str, *, start_only: bool = False) -> float:
    """Return the share of sampled events that differ between a converted file and the recording.

    ``start_only``: compare the first events only. A file without an index is read from its start to any event.
    """
    source, made = (
        open_recording(folder / "recording.h5").events,
        open_recording(folder / name).events,
    )

    def differ(a: Events, b: Events) -> int:
        return int(np.count_nonzero((a.x != b.x) | (a.y != b.y) | (a.t != b.t) | (a.p != b.p)))

    spans = pieces(SAMPLES * SAMPLE if start_only else len(source))
    if not start_only and len(source) != len(made):
        return 1.0
    return sum(differ(source.slice(*span), made.slice(*span)) for span in spans) / sum(
        b - a for a, b in spans
    )


def apex_away(folder: Path) -> float:
    """Return the error of the calibrated model [px rms over the image and a turn, constant lag removed]."""
    found = Calibration.load(folder / "calibration.json")
    return model_error(
        found.model, ExactModel.from_prism(CAMERA, PRISM, found.parameters["phase"])
    ).rms


def moved_away(folder: Path) -> float:
    """Return the largest error of compensated positions [px]; infinite if times, polarities or flags differ."""
    source, made = (
        open_recording(folder / "recording.h5"),
        open_recording(folder / "moved.h5").events,
    )
    assert source.encoder is not None
    found = Calibration.load(folder / "calibration.json")
    prism, phase = Prism(found.parameters["apex"], PRISM.index), found.parameters["phase"]
    return max(
        error_of(
            "exact", found.model, source.encoder, source.events.slice(*span), made.slice(*span), made.inside(*span),
            prism, phase,
        )
        for span in pieces(len(made))
    )  # fmt: skip


def decorrelation(folder: Path) -> float:
    """Return 1 minus the correlation of the picture with the scene's log brightness, without the image's border."""
    from PIL import Image

    from amiwarp.simulation.description import Scene
    from amiwarp.simulation.simulator import Simulation

    truth = Simulation(Scene.from_picture(blocks_picture()), CAMERA, PRISM, 1.0).log_view()
    found = np.asarray(Image.open(folder / "picture.tif"), dtype=np.float64)
    inner = np.s_[20:-20, 20:-20]
    return 1.0 - float(np.corrcoef(found[inner].ravel(), truth[inner].ravel())[0, 1])


def empty_share(folder: Path) -> float:
    """Return 0 if the picture of the inspector shows events, that is many different colours, else 1."""
    from PIL import Image

    pixels = np.asarray(Image.open(folder / "view.png").convert("RGB")).reshape(-1, 3)
    return 0.0 if len(np.unique(pixels, axis=0)) > 50 else 1.0


def commands(device: str) -> list[Command]:
    on = ("--device", device)
    calibrated = ("--calibration", "calibration.json")
    return [
        Command("convert to EVT 3.0", ("convert", "recording.h5", "converted.raw"),
                lambda f: same_events(f, "converted.raw", start_only=True), 0.0, "share"),
        Command("convert from EVT 3.0", ("convert", "converted.raw", "again.h5"),
                lambda f: same_events(f, "again.h5"), 0.0, "share"),
        Command("calibrate", ("calibrate", "recording.h5", "calibration.json", "--model", "exact", *on),
                apex_away, 0.02, "px"),
        Command("compensate", ("compensate", "recording.h5", "moved.h5", *calibrated, *on), moved_away, 1e-3, "px"),
        Command("reconstruct", ("reconstruct", "recording.h5", "picture.tif", "--turns", "1", *calibrated, *on),
                decorrelation, 0.1, "1 - correlation"),
        Command("view", ("view", "recording.h5", "--screenshot", "view.png", *calibrated), empty_share, 0.0, "empty"),
    ]  # fmt: skip


def measured(command: Command, folder: Path, events: int) -> dict[str, Any]:
    """Run a command and return its time, memory and error."""
    call = [sys.executable, "-m", "amiwarp", *command.arguments]
    ran = subprocess.run(
        [sys.executable, "-S", "-c", MEASURE, *call], cwd=folder, capture_output=True, check=False
    )
    if ran.returncode:
        raise SystemExit(f"{command.name} failed: {ran.stderr.decode(errors='replace')[-2000:]}")
    seconds, cpu_s, mib = map(float, ran.stdout.splitlines()[-1].split())
    error = command.error(folder)
    return {
        "command": command.name, "seconds": seconds, "mev_per_s": events / seconds / 1e6, "peak_mib": mib,
        "cpu_s": cpu_s, "error": error, "unit": command.unit,
        "wrong": [text for bad, text in (
            (not error <= command.bar, f"error {error:.3g} > {command.bar:g}"),
            (not mib <= MOST_MIB, f"{mib:.0f} MiB > {MOST_MIB:.0f}"),
        ) if bad],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--events", type=int, default=1_000_000_000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--folder", type=Path, help="folder for the files (default: a temporary folder)"
    )
    parser.add_argument("--out", type=Path, help="JSON file to write")
    a = parser.parse_args()
    result: dict[str, Any] = {
        "benchmark": "long_recording", "machine": f"{processor()}, {cpu_threads()} cores", "device": a.device,
        "events": a.events, "rows": [],
    }  # fmt: skip
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=a.folder)))
        make(folder / "recording.h5", a.events, columns=False)
        print(
            f"recording: {(folder / 'recording.h5').stat().st_size / a.events:.2f} bytes per event",
            flush=True,
        )
        for command in commands(a.device):
            row = measured(command, folder, a.events)
            result["rows"].append(row)
            speed = (
                f"{row['seconds']:7.1f} s {row['mev_per_s']:8.1f} Mev/s {row['peak_mib']:6.0f} MiB"
            )
            print(
                f"{command.name:22} {speed}  error {row['error']:.4g} {row['unit']}",
                *row["wrong"],
                flush=True,
            )
        result["bytes"] = {p.name: p.stat().st_size for p in sorted(folder.iterdir())}
    if a.out:
        a.out.write_text(json.dumps(result, indent=1) + "\n")
    if any(row["wrong"] for row in result["rows"]):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
