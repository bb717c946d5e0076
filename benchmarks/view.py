"""Speed of the inspector: frames per second while the view rotates, response to a parameter change, start-up time.

    python -m benchmarks.view [--device cuda:0] [--knob-only] [--events 100_000_000] [--out FILE.json]

Each figure is checked in the same run: the frames must differ, the compensated positions must be those of
``compensate_events``, and the number of events must be that of the file.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp.compensation.recordings import compensate_events
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import Recording
from amiwarp.io import RecordingWriter
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.studies.machine_info import machine
from amiwarp.viewer.choices import View
from amiwarp.viewer.cloud_scene import Look, Scene
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.page_values import jpeg

SIZE, WIDTH, HEIGHT = (1048, 514), 640, 480
"""Width and height of the clouds' picture in a browser window of 1366 x 768 [px], and width and height of the sensor
[px]."""
REPEATS = 20
LEAST_FPS, MOST_CPU_MS, MOST_CUDA_MS, MOST_S, MOST_GIB = 10.0, 150.0, 50.0, 3.0, 1.0
OPENED = """
import sys, time
began = time.perf_counter()
from amiwarp.io import open_recording
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.cloud_scene import Look, Scene
import pyvista, warp
pyvista.Plotter
imported = time.perf_counter() - began
opened = Inspector(open_recording(sys.argv[1]), device=sys.argv[2])
scene = Scene(({}, {}))
scene.show(opened.show(), Look())
scene.picture()
opened.rate
most = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(time.perf_counter() - began, imported, int(most.split()[1]) / 2**20, opened.show().span.count,
      len(opened.recording.events))
""".format(*SIZE)


def made(n: int, seconds: float, seed: int = 0) -> Events:
    """Return events at random pixels and times."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, round(seconds * 1e6), n))
    x, y = rng.integers(0, WIDTH, n).astype(np.uint16), rng.integers(0, HEIGHT, n).astype(np.uint16)
    return Events(x, y, t, rng.integers(0, 2, n).astype(np.uint8))


def recorded(events: Events) -> Recording:
    encoder = Encoder.constant_speed(720.0, 0, int(events.t[-1]))
    camera = Camera.from_fov(WIDTH, HEIGHT, 1.0)
    return Recording(MemoryEvents(events, WIDTH, HEIGHT), camera, encoder, Prism(0.02), name="made")


def orbiting(device: str) -> dict[str, Any]:
    """Measure the frames per second for 200,000 points in two clouds while the view rotates.

    The camera moves, and each picture is read back.
    """
    inspector, scene = Inspector(recorded(made(1_000_000, 0.2)), device=device), Scene(SIZE)
    inspector.open(0, 200_000)
    shown = inspector.show()
    scene.show(shown, Look())
    scene.picture()
    began, frames = time.perf_counter(), []
    for _ in range(REPEATS):
        scene.plotter.renderers[0].camera.Azimuth(3.0)
        frames.append(scene.picture())
    fps = REPEATS / (time.perf_counter() - began)
    differ = all((a != b).any() for a, b in itertools.pairwise(frames))
    return {"points": 2 * len(shown.events), "fps": fps, "ok": differ and fps >= LEAST_FPS}


def knob(device: str, *, drawn: bool) -> dict[str, Any]:
    """Measure the time from a new parameter value to drawn clouds, encoded images and sharpness (1 M events)."""
    inspector, scene = Inspector(recorded(made(1_000_000, 0.2)), device=device), Scene(SIZE) if drawn else None
    inspector.open(0, 200_000)
    inspector.show()
    if scene is not None:
        scene.show(inspector.show(), Look())
        scene.look_from(View.FREE, Look())
        scene.picture()
    times = []
    for k in range(REPEATS):
        began = time.perf_counter()
        inspector.set(replace(inspector.knobs, apex=0.01 + 0.0005 * k))
        shown = inspector.show()
        if scene is not None:
            scene.show(shown, Look())
            scene.picture()
        for image in (shown.image_before, shown.image_after):
            jpeg(np.sqrt(np.clip(image / image.max(), 0.0, 1.0)))
        times.append(1e3 * (time.perf_counter() - began))
    expected = compensate_events(shown.events, inspector.model, inspector.encoder)
    error = float(np.nanmax(np.abs(expected - shown.after)))
    most = MOST_CUDA_MS if "cuda" in device else MOST_CPU_MS
    median = float(np.median(times))
    return {"events": shown.selected, "drawn": drawn, "ms": median, "ms_slowest": max(times), "error_px": error,
            "ok": error < 0.01 and median <= most}  # fmt: skip


def write_long(path: Path, n: int) -> int:
    """Write a recording of about ``n`` random events at 10 million events/s, and return their number."""
    block, seconds = min(n, 5_000_000), 0.5
    camera = Camera.from_fov(WIDTH, HEIGHT, 1.0)
    encoder = Encoder.constant_speed(720.0, 0, round(n / block * seconds * 1e6))
    with RecordingWriter(path, width=WIDTH, height=HEIGHT, camera=camera, encoder=encoder, prism=Prism(0.02)) as writer:
        for k in range(n // block):
            e = made(block, seconds, k)
            writer.append(Events(e.x, e.y, e.t + round(k * seconds * 1e6), e.p))
    return n // block * block


def opening(device: str, n: int) -> dict[str, Any]:
    """Measure the time from the start of a process to its first picture and event rate.

    The result is the median of three runs.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.h5"
        n = write_long(path, n)
        os.sync()  # finish writing before the timed reading
        command = [sys.executable, "-c", OPENED, str(path), device]
        runs = [
            subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-5:] for _ in range(3)
        ]
        size = path.stat().st_size
    took, imports, gib, shown, count = (float(np.median(v)) for v in np.array(runs, float).T)
    return {"events": int(count), "file_mb": size * 1e-6, "s": took, "imports_s": imports, "gib": gib,
            "window_events": int(shown),
            "ok": count == n and took <= MOST_S and gib <= MOST_GIB}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--events", type=int, default=100_000_000)
    parser.add_argument("--knob-only", action="store_true", help="only the parameter change, without drawing")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    found: dict[str, Any] = {"machine": machine(args.device), "device": args.device}
    found["knob"] = knob(args.device, drawn=not args.knob_only)
    if not args.knob_only:
        found |= {"orbiting": orbiting(args.device), "opening": opening(args.device, args.events)}
    print(json.dumps(found, indent=1))
    if args.out:
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    return int(not all(found[n]["ok"] for n in ("orbiting", "knob", "opening") if n in found))


if __name__ == "__main__":
    sys.exit(main())
