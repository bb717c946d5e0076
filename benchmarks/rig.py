"""Processor time of a rig of four sensors, against the sum of each sensor alone. Prints JSON.

    python -m benchmarks.rig [--device cpu] [--size 320 240] [--duration 0.1] [--repeats 3] [--out FILE]

The sensors are the platform of the AMI-EV paper with one camera fewer: event cameras behind a wedge and without, a
colour camera with a rolling shutter, and a depth camera, in the world ``room``. Each run writes a recorded rig to a new
folder. Making the world is not included, and its upload to the device is. Repeats measure both sides in turn, and begin
with another one each time, so that other load acts on both. Processor time is of all threads of the process.

In the same run, everything that the rig recorded is compared with what each sensor recorded alone: ``differing`` counts
the values of events, frames, depth maps and poses that differ. The program fails if one does, if a sensor recorded
nothing, or if the ratio is above the limit.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp import Recording, Rig, open_rig
from amiwarp.studies.machine import machine, versions

NAMES = ("ami", "plain", "colour", "depth")
"""Sensors of the rig."""
LIMIT = 1.3
"""Largest ratio of the processor times."""


def written(rig: Rig, folder: Path, device: str) -> float:
    """Write a recorded rig, and return the processor time [s]."""
    began = time.process_time()
    rig.write(folder)
    wp.synchronize_device(device)
    return time.process_time() - began


def alone(rig: Rig, name: str) -> Rig:
    """Return a rig with one of the sensors."""
    return replace(rig, sensors={name: rig.sensors[name]})


def columns(recording: Recording) -> dict[str, np.ndarray]:
    """Return all that a sensor recorded: events, images with their times, and poses."""
    found = {}
    events = recording.events[:]
    for name in ("x", "y", "t", "p"):
        found[f"events.{name}"] = np.asarray(getattr(events, name))
    for name in ("frames", "depth"):
        store = getattr(recording, name)
        if store is not None:
            found[f"{name}.t"] = np.asarray(store.t)
            found[name] = np.stack([store[k] for k in range(len(store))])
    truth = recording.truth
    if truth is not None and truth.poses is not None:
        poses = truth.poses[:]
        found["poses.t"] = np.asarray(poses.t)
        found["poses"] = np.asarray(poses.camera)
    return found


def differing(one: Recording, other: Recording) -> int:
    """Return the number of values that differ between two recordings of a sensor."""
    first = columns(one)
    second = columns(other)
    wrong = len(first.keys() ^ second.keys())
    for name in first.keys() & second.keys():
        a = first[name]
        b = second[name]
        if a.shape != b.shape:
            wrong += max(a.size, b.size)
            continue
        # Unknown depths are NaN in both
        same = (a == b) | ((a != a) & (b != b))
        wrong += int(np.count_nonzero(~same))
    return wrong


def measured(rig: Rig, folder: Path, device: str, *, rig_first: bool) -> dict[str, Any]:
    """Write the rig, and each sensor alone, once. Return their processor times [s], and what differs."""
    seconds: dict[str, float] = {}
    if rig_first:
        seconds["rig"] = written(rig, folder / "rig", device)
    for name in NAMES:
        seconds[name] = written(alone(rig, name), folder / name, device)
    if not rig_first:
        seconds["rig"] = written(rig, folder / "rig", device)
    together = open_rig(folder / "rig")
    found: dict[str, Any] = {"seconds": seconds, "differing": {}, "recorded": {}}
    for name in NAMES:
        recording = together[name].recording
        of_one = open_rig(folder / name)[name].recording
        found["differing"][name] = differing(recording, of_one)
        images = recording.frames or recording.depth
        found["recorded"][name] = len(recording.events) or (0 if images is None else len(images.t))
    found["ratio"] = seconds["rig"] / sum(seconds[name] for name in NAMES)
    return found


def result_of(repeats: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians of the repeats, one row for each sensor, and the largest differences."""
    rows = []
    for name in NAMES:
        rows.append(
            {
                "sensor": name,
                "processor_s": statistics.median(repeat["seconds"][name] for repeat in repeats),
                "recorded": repeats[0]["recorded"][name],
                "differing": max(repeat["differing"][name] for repeat in repeats),
            }
        )
    rig_s = statistics.median(repeat["seconds"]["rig"] for repeat in repeats)
    sum_s = statistics.median(sum(repeat["seconds"][name] for name in NAMES) for repeat in repeats)
    totals = {
        "rig_processor_s": rig_s,
        "sum_processor_s": sum_s,
        "ratio": statistics.median(repeat["ratio"] for repeat in repeats),
        "least_ratio": min(repeat["ratio"] for repeat in repeats),
        "largest_ratio": max(repeat["ratio"] for repeat in repeats),
        "limit": LIMIT,
    }
    return {"rows": rows, "totals": [totals]}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--world", default="room")
    parser.add_argument("--size", type=int, nargs=2, default=[320, 240])
    parser.add_argument("--duration", type=float, default=0.1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    wp.init()
    width, height = arguments.size
    platform = Rig.paper_platform(
        arguments.world,
        duration_s=arguments.duration,
        size=(width, height),
        device=arguments.device,
    )
    rig = replace(platform, sensors={name: platform.sensors[name] for name in NAMES})
    repeats = []
    with tempfile.TemporaryDirectory() as folder:
        # Compiles the kernels
        replace(rig, duration_s=0.03).write(Path(folder) / "warm")
        for k in range(arguments.repeats):
            repeats.append(
                measured(rig, Path(folder) / str(k), arguments.device, rig_first=k % 2 == 0)
            )
    result = {
        "machine": machine(arguments.device),
        "versions": versions(["warp-lang", "numpy"]),
        "world": arguments.world,
        "width": width,
        "height": height,
        "duration_s": arguments.duration,
        "repeats": arguments.repeats,
        **result_of(repeats),
    }
    text = json.dumps(result, indent=1)
    print(text)
    wrong = [row["sensor"] for row in result["rows"] if row["differing"] or not row["recorded"]]
    if wrong:
        raise SystemExit(
            f"wrong answer: {', '.join(wrong)} recorded something else in the rig, or nothing"
        )
    if arguments.out:
        arguments.out.write_text(text + "\n")
    if result["totals"][0]["ratio"] > LIMIT:
        raise SystemExit(f"the rig takes more than {LIMIT} of the time of its sensors")


if __name__ == "__main__":
    main()
