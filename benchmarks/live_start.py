"""Start and memory of ``amiwarp live`` on a file: time to the first packet on its standard output, resident memory.

    python -m benchmarks.live_start [--repeats 7] [--out FILE.json]

A recording of 1280 x 720 px is filtered and undistorted, and one is compensated. ``first_packet_s`` counts from the
start of the process to the first whole packet of events. All events that come are counted. The exit status is 1 if one
lacks.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from amiwarp import (
    Calibration,
    Camera,
    Compensated,
    Encoder,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    save_camera,
    save_recording,
)
from amiwarp.live.stream import PacketDecoder
from amiwarp.studies.machine import machine
from benchmarks.stages import LENS, SIZE, stream

SECONDS = 0.5
MEV_S = 2.0
KINDS = {
    "plain": "--refractory-us 300 --background-ms 10 --undistort lens.json",
    "compensated": "--calibration calibration.json",
}
"""Options of the commands."""


def write_inputs(folder: Path) -> int:
    """Write recording, camera and calibration, and return the number of events."""
    events = stream(SECONDS, MEV_S)
    camera = Camera(*SIZE, 900.0, 900.0, 639.5, 359.5)
    prism = Prism(math.radians(1.0))
    encoder = Encoder.constant_speed(720.0, -5000, round(1e6 * SECONDS) + 5000)
    save_recording(
        folder / "recording.h5", Recording(MemoryEvents(events, *SIZE), camera, encoder, prism)
    )
    save_camera(folder / "lens.json", LENS)
    Calibration(
        model_name="exact",
        camera=camera,
        prism=prism,
        parameters={"apex": prism.apex, "phase": 0.3},
        uncertainty={},
        free=("apex", "phase"),
        sharpness_name="variance",
        sharpness_before=1.0,
        sharpness_after=2.0,
        stages=(),
        events=len(events),
        seconds=SECONDS,
    ).save(folder / "calibration.json")
    return len(events)


def largest_memory_mib(pid: int) -> float:
    """Return the largest resident memory that a running process has had [MiB], 0 if it has ended.

    The system's figures of a process that has ended include the memory of the one that started it.
    """
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        name, _, value = line.partition(":")
        if name == "VmHWM":
            return int(value.split()[0]) / 1024
    return 0.0


def started(folder: Path, kind: str) -> dict[str, float]:
    """Run the command once, and return the time to its first packet, its number of events, and its largest memory."""
    began = time.monotonic()
    command = [sys.executable, "-m", "amiwarp", "live", "recording.h5", *KINDS[kind].split()]
    with subprocess.Popen(
        [*command, "--to", "-"], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as child:
        assert child.stdout is not None
        decoder = PacketDecoder(kind)
        first_s = math.nan
        events = 0
        memory_mib = 0.0
        while data := os.read(child.stdout.fileno(), 1 << 20):
            memory_mib = max(memory_mib, largest_memory_mib(child.pid))
            for message in decoder.feed(data):
                if isinstance(message, (Events, Compensated)):
                    first_s = time.monotonic() - began if math.isnan(first_s) else first_s
                    found = message if isinstance(message, Events) else message.events
                    events += len(found)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    return {
        "first_packet_s": first_s,
        "events": events,
        "memory_mib": memory_mib,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "exit_status": child.returncode,
    }


def measured(folder: Path, kind: str, repeats: int, wanted: int) -> dict[str, Any]:
    """Return the figures of a command."""
    started(folder, kind)  # compiles and caches kernels
    runs = [started(folder, kind) for _ in range(repeats)]
    times = [run["first_packet_s"] for run in runs]
    is_right = all(run["events"] == wanted and run["exit_status"] == 0 for run in runs)
    return {
        "command": kind,
        "first_packet_s": round(statistics.median(times), 2),
        "least_s": round(min(times), 2),
        "most_s": round(max(times), 2),
        "memory_mib": round(max(run["memory_mib"] for run in runs), 1),
        "events": wanted,
        "right": is_right,
    }


def main() -> int:
    from amiwarp import EventFilter

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        count = write_inputs(folder)
        calm = EventFilter(refractory_us=300, background_us=10_000)
        kept = len(calm.apply(stream(SECONDS, MEV_S), SIZE))
        rows = [measured(folder, "plain", args.repeats, kept)]
        rows.append(measured(folder, "compensated", args.repeats, count))
    for row in rows:
        print(json.dumps(row), flush=True)
    if args.out:
        args.out.write_text(json.dumps({"machine": machine("cpu"), "rows": rows}, indent=1) + "\n")
    return 0 if all(row["right"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
