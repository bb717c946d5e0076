"""Reliability tests: kill every command that writes files at random moments, and run it on disks that are too small.

    python -m benchmarks.reliability kills --folder FOLDER [--kills 60] [--only NAME …] [--out FILE.json]
    python -m benchmarks.reliability disks --folder FOLDER [--only NAME …] [--out FILE.json]

``kills`` ends each command by SIGKILL, SIGTERM and SIGINT in turn, at moments spread over its whole run, and checks the
files that remain. ``disks`` runs each command on disks (tmpfs, which needs root) with sizes from almost nothing to more
than it needs. The exit status is 1 if a file was lost, incomplete or left over, or if a command hung; each such case is
printed.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from amiwarp import AmiwarpError, open_recording
from amiwarp.io.outputs import NewFile
from amiwarp.io.unfinished import remove_abandoned

LIMIT_S = 180.0
"""Time after a signal at which a command that still runs is considered hanging [s]."""

START_S = 0.3
"""Time in which Python starts and imports its own modules [s]; a signal before then is handled by Python itself."""

CELLS = "cells"
"""Folder of complete intermediate results, from which the next run continues."""

EXPORTS = """import signal, sys
signal.signal(signal.SIGTERM, signal.default_int_handler)
try:
    import amiwarp
    truth = amiwarp.open_recording(sys.argv[1]).truth
    amiwarp.save_poses_tum(sys.argv[2] + "/poses.txt", truth.poses)
    amiwarp.save_flow_mvsec(sys.argv[2] + "/flow.npz", truth.frames)
    amiwarp.save_flow_dsec(sys.argv[2] + "/dsec", truth.frames)
except KeyboardInterrupt:
    sys.exit(130)
"""
"""Program that exports the ground truth of a world."""

SPECIFICATION = """format = "amiwarp-dataset-specification"
version = 1
name = "killed"
duration_s = 0.02
prisms = [{ apex_deg = 0.5 }, { apex_deg = 1.0 }]
speeds_rpm = [720.0]
sensors = ["davis346"]
seeds = 15
splits = { train = 1.0 }
[camera]
size = [64, 48]
fov_deg = 60.0
[[sources]]
pictures = "pic.png"
"""
"""Specification of a data set of 30 recordings."""

COMMANDS = {
    "simulate": ("simulate OUT/o.h5 --picture IN/pic.png --size 160x120 --duration 0.4", ("o.h5",)),
    "translate": ("translate IN/v.npy OUT/o.h5 --fps 100", ("o.h5",)),
    "convert": ("convert IN/r.h5 OUT/o.h5 --encoder IN/enc.csv", ("o.h5",)),
    "calibrate": (
        "calibrate IN/s.h5 OUT/c.json --figure OUT/c.png --events 100000",
        ("c.json", "c.png"),
    ),
    "compensate": (
        "compensate IN/r.h5 OUT/o.h5 --calibration IN/cal.json --iwe OUT/i.png --iwe OUT/i.npy --iwe-window-ms 100",
        ("o.h5", "i.npy", *(f"i_{k:05d}.png" for k in range(20))),
    ),
    "reconstruct": (
        "reconstruct IN/s.h5 OUT/p.tif --mask OUT/m.png --calibration IN/cal.json --turns 1",
        ("p.tif", "m.png"),
    ),
    "reconstruct, video": (
        "reconstruct IN/s.h5 OUT/p.mp4 --calibration IN/cal.json --length 0.04 --fps 20",
        ("p.mp4",),
    ),
    "record": ("record IN/r.h5 OUT/o.h5", ("o.h5",)),
    "live": (
        "live IN/r.h5 --calibration IN/cal.json --out OUT/o.h5 --record OUT/raw.h5",
        ("o.h5", "raw.h5"),
    ),
    "view --screenshot": (
        "view IN/s.h5 --calibration IN/cal.json --screenshot OUT/v.png",
        ("v.png",),
    ),
    "design": (
        "design --out OUT --picture IN/pic.png --size 64x48 --apex-deg 1,2 --rpm 720",
        ("design.png", "design.svg", "design.json", "design.csv"),
    ),
    "chart": (
        "chart IN/truth.h5 --out OUT --quick",
        (
            "chart.json",
            "chart.csv",
            "compensation.png",
            "compensation.svg",
            "calibration.png",
            "calibration.svg",
        ),
    ),
    "demo": (
        "demo --out OUT --picture IN/pic.png --size 160x120 --duration 0.2",
        ("recording.h5", "calibration.json", "compensated.h5", "picture.png", "demo.png"),
    ),
    "stability": (
        "stability --quick --axes apex --minutes 0.01 --out OUT",
        (
            "atlas.csv",
            "atlas.json",
            "atlas.pdf",
            "axis_apex.png",
            "overview.png",
            "summary.md",
            CELLS,
        ),
    ),
    "simulate, world": (
        "simulate OUT/o.h5 --world room --size 64x48 --duration 0.1 --truth-hz 200 --preview OUT/p.png",
        ("o.h5", "p.png"),
    ),
    "truth exports": ("IN/exports.py IN/world.h5 OUT", ("poses.txt", "flow.npz", "dsec")),
    "dataset": (
        "dataset IN/set.toml OUT --workers 1",
        ("journal.jsonl", "manifest.json", "manifest.parquet", "train"),
    ),
    "evaluate": (
        "evaluate --recording IN/s.h5 --recording IN/truth.h5 --seeds 1 --workers 1 --out OUT",
        ("report.html", "report.json", "tables", "figures", CELLS),
    ),
}
"""Command lines by name, each with the files that it writes. IN is the folder of inputs; OUT is empty at the start.
A line that begins with IN is a Python program."""

SHORTER = ("record", "live", "dataset")
"""Commands whose file is valid, but may be shorter: they keep what was finished when they were killed."""

CONTINUED = ("dataset", "evaluate")
"""Commands that continue a stopped run if they are given again, and end with the same files. With a limit of time, as
here, ``stability`` adds to them."""


def prepare(folder: Path) -> Path:
    """Make the input files once: a recording of 3 million events, a small one, a calibration and a picture."""
    from PIL import Image

    inputs = folder / "in"
    if (inputs / "done").exists():
        return inputs
    shutil.rmtree(inputs, ignore_errors=True)
    inputs.mkdir(parents=True)
    rng = np.random.default_rng(1)
    rows, columns = np.mgrid[:240, :320]
    picture = np.full((240, 320), 90, np.uint8)
    for _ in range(120):
        x, y, radius = rng.uniform(0, 320), rng.uniform(0, 240), rng.uniform(6, 30)
        picture[(columns - x) ** 2 + (rows - y) ** 2 < radius**2] = rng.integers(20, 250)
    Image.fromarray(picture).save(inputs / "pic.png")
    np.save(
        inputs / "v.npy", np.stack([np.roll(picture, k, axis=1) for k in range(30)])[:, ::2, ::2]
    )
    for line in (
        "simulate IN/s.h5 --picture IN/pic.png --size 160x120 --duration 0.3 --nominal-apex-deg 1.1",
        "simulate IN/truth.h5 --picture IN/pic.png --size 160x120 --duration 0.5",
        "calibrate IN/s.h5 IN/cal.json",
        "simulate IN/world.h5 --world room --size 64x48 --duration 0.2 --truth-hz 500",
    ):
        subprocess.run(words(line, inputs, inputs), check=True, stdout=subprocess.DEVNULL)
    many_events(inputs)
    t = np.arange(0, 2_100_000, 1000)
    (inputs / "enc.csv").write_text(
        "t_us,angle_deg\n" + "".join(f"{a},{b:.6f}\n" for a, b in zip(t, t * 4.32e-3, strict=True))
    )
    (inputs / "exports.py").write_text(EXPORTS)
    (inputs / "set.toml").write_text(SPECIFICATION)
    (inputs / "done").touch()
    return inputs


def many_events(inputs: Path, count: int = 3_000_000) -> None:
    """Write a recording of two seconds with evenly spread events, long enough to kill a command while it runs."""
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.recording import Events, MemoryEvents, Recording
    from amiwarp.io import save_recording

    rng = np.random.default_rng(2)
    events = Events.from_arrays(
        rng.integers(0, 160, count), rng.integers(0, 120, count), np.sort(rng.integers(0, 2_000_000, count)),
        rng.integers(0, 2, count),
    )  # fmt: skip
    small = open_recording(inputs / "s.h5")
    encoder = Encoder.constant_speed(720.0, -1000, 2_001_000)
    save_recording(
        inputs / "r.h5",
        Recording(MemoryEvents(events, 160, 120), small.camera, encoder, small.prism),
    )


def words(line: str, inputs: Path, out: Path) -> list[str]:
    text = [word.replace("IN/", f"{inputs}/").replace("OUT", str(out)) for word in line.split()]
    return [sys.executable, *(() if line.startswith("IN/") else ("-m", "amiwarp")), *text]


def digest(folder: Path) -> dict[str, str]:
    return {
        str(f): hashlib.sha256(f.read_bytes()).hexdigest()
        for f in sorted(folder.rglob("*"))
        if f.is_file()
    }


def size_of(path: Path) -> Any:
    """Read a file completely, and return a property that identifies a complete file of its kind."""
    if path.is_dir():
        return all(size_of(f) for f in path.rglob("[!.]*"))
    if path.suffix == ".pdf":
        return path.read_bytes()[:5] + path.read_bytes()[-6:]
    if path.suffix == ".h5":
        events = open_recording(path).events
        return sum(len(block) for block in events.blocks())
    if path.suffix in (".png", ".tif"):
        from PIL import Image

        with Image.open(path) as image:
            image.load()  # raises an error for an incomplete image; a chart's size depends on its figures
            return image.mode
    if path.suffix == ".npy":
        return np.load(path).shape
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return sorted((name, arrays[name].shape) for name in arrays)
    if path.suffix == ".parquet":
        import pyarrow.parquet

        return pyarrow.parquet.read_table(path).num_rows
    if path.suffix == ".mp4":
        import av

        with av.open(str(path)) as container:
            return sum(1 for _ in container.decode(video=0))
    text = path.read_text()
    if path.suffix == ".json":
        return sorted(json.loads(text))
    return text[-6:] if path.suffix in (".svg", ".html") else text.count("\n")


@contextlib.contextmanager
def begun(line: str, inputs: Path, out: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a command in its own session; at the end, kill all processes of the session."""
    process = subprocess.Popen(
        words(line, inputs, out), text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def left_alive(group: int, wait_s: float = 30.0) -> list[str]:
    """Return the processes of the session that still run ``wait_s`` seconds after its leader ended."""
    until = time.monotonic() + wait_s
    while True:
        alive = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, ProcessLookupError):
                if os.getsid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                    alive.append(" ".join(process.cmdline())[:120])
        if not alive or time.monotonic() > until:
            return alive
        time.sleep(0.1)


def whole_run(name: str, inputs: Path, out: Path) -> tuple[float, dict[str, Any], int]:
    """Run a command undisturbed; return its duration [s], the properties of its files, and their size [bytes]."""
    line, files = COMMANDS[name]
    began = time.perf_counter()
    with begun(line, inputs, out) as process:
        _, error = process.communicate(timeout=600)
    seconds = time.perf_counter() - began
    if process.returncode:
        raise SystemExit(f"{name}: {error}")
    return (
        seconds,
        {f: size_of(out / f) for f in files},
        sum(f.stat().st_size for f in out.rglob("*") if f.is_file()),
    )


def judge(
    name: str, out: Path, expected: dict[str, Any], number: signal.Signals, code: int
) -> tuple[str, list[str]]:
    """Return how a run ended, and the problems of the files that it left."""
    wrong = []
    there = {f.name for f in out.iterdir()}
    left = set(out.rglob(".*.part"))
    unfinished = {f.name for f in left}
    kept = {f for f in there if f.endswith(".part.h5")}
    for file in sorted(there - unfinished):
        try:
            found = size_of(out / file)
        except (AmiwarpError, OSError, ValueError) as error:
            wrong.append(f"{file} is damaged: {error}")
            continue
        if file not in kept and file not in expected:
            wrong.append(f"{file} was left")
        elif (
            file not in kept
            and found != expected[file]
            and not (name in SHORTER and found <= expected[file])
        ):
            wrong.append(f"{file} holds {found}, whole {expected[file]}")
    if number is not signal.SIGKILL:
        wrong += [f"{file} was left" for file in unfinished | kept]
    remove_abandoned.cache_clear()
    for place in (out, *(found for found in out.rglob("[!.]*") if found.is_dir())):
        NewFile(place / "next").discard()
    wrong += [f"{f.name} outlived the next run" for f in left if f.exists()]
    # exit status -number: the signal arrived while Python was starting or exiting
    if code not in ({-9, 0} if number is signal.SIGKILL else {130, 0, -number, -signal.SIGINT}):
        wrong.append(f"exit status {code}")
    ended = (
        "finished" if set(expected) <= there else "cut short" if there - unfinished else "nothing"
    )
    return ended, wrong


def kills(name: str, inputs: Path, folder: Path, count: int, rng: random.Random) -> dict[str, Any]:
    """Run a command ``count`` times, and kill it each time at another moment."""
    whole_run(name, inputs, emptied(folder))  # compiles
    seconds, expected, _ = whole_run(name, inputs, emptied(folder))
    before = digest(inputs)
    ended: Counter[str] = Counter()
    problems, longest, unfinished = [], 0.0, 0
    signals = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
    # Each round of the three signals has its own part of the run; the last round may be cut short
    rounds = -(-count // len(signals))
    for k in range(count):
        number = signals[k % len(signals)]
        after = seconds * (k // len(signals) + rng.random()) / rounds
        out = emptied(folder)
        with begun(COMMANDS[name][0], inputs, out) as process:
            time.sleep(after)
            process.send_signal(number)
            signalled_s = time.perf_counter()
            try:
                _, error = process.communicate(timeout=LIMIT_S)
            except subprocess.TimeoutExpired:
                problems.append(f"{number.name} after {after:.2f} s: still running")
                continue
            longest = max(longest, time.perf_counter() - signalled_s)
            alive = left_alive(process.pid)
        unfinished += any(out.rglob(".*.part"))
        # During Python's start
        starting = after < START_S and process.returncode in (
            1,
            -signal.SIGINT,
        )
        how, wrong = judge(name, out, expected, number, 0 if starting else process.returncode)
        wrong += [f"{line} is still running" for line in alive]
        if "Traceback" in error and not starting:
            wrong.append(f"traceback: {error[-300:]}")
        if name in CONTINUED:
            wrong += continued(name, inputs, out, expected)
        ended[f"{number.name}: {how}"] += 1
        problems += [f"{number.name} after {after:.2f} s: {text}" for text in wrong]
    if digest(inputs) != before:
        problems.append("an input was changed")
    return {"command": name, "kills": count, "run_s": seconds, "ended": dict(sorted(ended.items())),
            "runs_that_left_unfinished_files_to_the_next": unfinished, "longest_end_s": longest,
            "problems": problems}  # fmt: skip


def continued(name: str, inputs: Path, out: Path, expected: dict[str, Any]) -> list[str]:
    """Run a command again on what a killed run left; return the problems of the files."""
    with begun(COMMANDS[name][0], inputs, out) as process:
        _, error = process.communicate(timeout=600)
    wrong = (
        [f"the next run ended with {process.returncode}: {error[-300:]}"]
        if process.returncode
        else []
    )
    for file, whole in expected.items():
        if not (out / file).exists() or size_of(out / file) != whole:
            wrong.append(f"{file} is not whole after the next run")
    return wrong


def emptied(folder: Path) -> Path:
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    return out


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    place = folder / "disk"
    place.mkdir(exist_ok=True)
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={max(size, 4096)}", "tmpfs", place], check=True
    )
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)


def disks(name: str, inputs: Path, folder: Path) -> dict[str, Any]:
    """Run a command on disks from almost no space to one and a half times the size of its files."""
    _, expected, size = whole_run(name, inputs, emptied(folder))
    before = digest(inputs)
    ended: Counter[str] = Counter()
    problems = []
    for share in (0.0, 0.05, 0.25, 0.5, 0.75, 0.9, 1.0, 1.5):
        with small_disk(folder, int(share * size)) as out:
            with begun(COMMANDS[name][0], inputs, out) as process:
                _, error = process.communicate(timeout=600)
            code = process.returncode
            there = {f.name for f in out.iterdir()}
            wrong = [f"{f} was left" for f in there - set(expected)]
            for file in there & set(expected):
                try:
                    found = size_of(out / file)
                except (AmiwarpError, OSError, ValueError) as damage:
                    wrong.append(f"{file} is damaged: {damage}")
                    continue
                if found != expected[file] and not (name in SHORTER and found <= expected[file]):
                    wrong.append(f"{file} holds {found}, whole {expected[file]}")
            if code == 0 and there != set(expected):
                wrong.append("exit status 0 without all files")
            if code not in (0, 1) or (
                code == 1 and "amiwarp: " not in error.strip().splitlines()[-1]
            ):
                wrong.append(f"exit status {code}: {error[-300:]}")
            ended["whole" if code == 0 else "one clear error"] += 1
            problems += [f"{100 * share:.0f} % of {size} bytes: {text}" for text in wrong]
    if digest(inputs) != before:
        problems.append("an input was changed")
    return {"command": name, "bytes": size, "ended": dict(ended), "problems": problems}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["kills", "disks"])
    parser.add_argument(
        "--folder", type=Path, required=True, help="working folder; the inputs are kept in it"
    )
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--only", nargs="+", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    inputs = prepare(args.folder)
    rows = []
    for name in args.only:
        rng = random.Random(f"{args.seed} {name}")
        if args.what == "kills":
            rows.append(kills(name, inputs, args.folder, args.kills, rng))
        else:
            rows.append(disks(name, inputs, args.folder))
        print(json.dumps(rows[-1]), flush=True)
        if args.out is not None:
            args.out.write_text(json.dumps(rows, indent=1) + "\n")
    return 1 if any(row["problems"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
