"""Speed of the inspector without its page: response to a parameter, images, event rates, first cloud of a file.

    python -m benchmarks.inspector [--device cuda:0] [--events 100_000_000] [--out FILE.json]

It needs no browser; ``benchmarks.inspector_page`` measures the page. An update includes what the server makes of it for
the page: bytes of points and colours, and encoded images.

Wall times are medians. CPU times of all threads stand next to them, because other programs lengthen the wall times on
a shared machine. Each figure is checked in the same run: positions are those of ``compensate_events``, counts are those
of the recording.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp import (
    Camera,
    Encoder,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    RecordingWriter,
    compensate_events,
    simulate,
)
from amiwarp.choices import Axis, Colour
from amiwarp.studies.machine import machine
from amiwarp.viewer.filters import Selection
from amiwarp.viewer.images import ImageKind, make_images, prepare
from amiwarp.viewer.inspector import WINDOW_POINTS, Inspector
from amiwarp.viewer.page_state import cloud_state, picture_state, scale_state
from amiwarp.viewer.window import LEAST_POINTS, Window

WIDTH, HEIGHT = 640, 480
"""Width and height of the sensor [px]."""
REPEATS = 20
REGION = (260, 200, 380, 290)
"""Region of the image in which the parameter is changed [px]."""
TARGETS_MS = {
    "cpu": {"update": 150.0, "window": 100.0, "log_intensity": 1000.0},
    "cuda": {"update": 40.0, "window": 100.0, "log_intensity": 100.0},
}
"""Longest times of an update of the page and of the window, and of a log intensity [ms]."""
MOST_S, MOST_GIB, MOST_RATE_MS = 3.0, 1.0, 50.0
OPENED = """
import sys, time
began, cpu = time.perf_counter(), time.process_time()
from amiwarp.io import open_recording
from amiwarp.viewer.filters import Selection
from amiwarp.viewer.inspector import Inspector
opened = Inspector(open_recording(sys.argv[1]), device=sys.argv[2])
start, length = opened.first_window()
opened.open(start, int(sys.argv[3]) or length)
opened.open(*opened.window, Selection(region=opened.suggest_region()))
shown = opened.show()
took, cpu = time.perf_counter() - began, time.process_time() - cpu
most = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(took, cpu, int(most.split()[1]) / 2**20, shown.span.count, len(shown.span.events), len(opened.recording.events))
"""
"""Program that opens a file as the page does: first window, suggested region, clouds."""


def made(n: int, seconds: float, seed: int = 0) -> Events:
    """Return events at random pixels and times."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, round(seconds * 1e6), n))
    x, y = rng.integers(0, WIDTH, n).astype(np.uint16), rng.integers(0, HEIGHT, n).astype(np.uint16)
    return Events(x, y, t, rng.integers(0, 2, n).astype(np.uint8))


def recorded(events: Events) -> Recording:
    """Return a recording of events in front of a prism at 720 rpm."""
    encoder = Encoder.constant_speed(720.0, 0, int(events.t[-1]))
    camera = Camera.from_fov(WIDTH, HEIGHT, 1.0)
    return Recording(MemoryEvents(events, WIDTH, HEIGHT), camera, encoder, Prism(0.02), name="made")


def write_long(path: Path, n: int) -> int:
    """Write a recording of about ``n`` random events at 10 million events/s, and return their number."""
    block, seconds = min(n, 5_000_000), 0.5
    camera = Camera.from_fov(WIDTH, HEIGHT, 1.0)
    encoder = Encoder.constant_speed(720.0, 0, round(n / block * seconds * 1e6))
    with RecordingWriter(
        path, width=WIDTH, height=HEIGHT, camera=camera, encoder=encoder, prism=Prism(0.02)
    ) as writer:
        for k in range(n // block):
            e = made(block, seconds, k)
            writer.append(Events(e.x, e.y, e.t + round(k * seconds * 1e6), e.p))
    return n // block * block


def timed(work: Callable[[int], object], repeats: int = REPEATS) -> dict[str, float]:
    """Return the median wall time and the mean CPU time of a function of the number of the repetition [ms]."""
    work(0)
    times, cpu = [], time.process_time()
    for k in range(repeats):
        began = time.perf_counter()
        work(k + 1)
        times.append(1e3 * (time.perf_counter() - began))
    return {
        "ms": float(np.median(times)),
        "ms_slowest": max(times),
        "cpu_ms": 1e3 * (time.process_time() - cpu) / repeats,
    }


def once(work: Callable[[], object]) -> dict[str, float]:
    """Return the wall time and the CPU time of the first call of a function [ms]."""
    began, cpu = time.perf_counter(), time.process_time()
    work()
    return {"ms": 1e3 * (time.perf_counter() - began), "cpu_ms": 1e3 * (time.process_time() - cpu)}


def update(device: str, region: tuple[int, int, int, int] | None) -> dict[str, Any]:
    """Measure the time from a new parameter to the values of the page: points, image, sharpness (1 million events)."""
    inspector = Inspector(recorded(made(1_000_000, 0.2)), device=device)
    inspector.open(0, 200_000, Selection(region=region))

    def change(k: int) -> None:
        inspector.set(replace(inspector.knobs, apex=0.01 + 0.0005 * k))
        shown = inspector.show()
        cloud_state(shown, Colour.POLARITY, Axis.ANGLE, dark=False)
        images = make_images(inspector, ImageKind.COUNT, shown=shown)
        assert images.before is not None
        for image in (images.before, images.after):
            picture_state(image, images.scale)
        scale_state(images.scale)

    found, shown = timed(change), inspector.show()
    expected = compensate_events(shown.events, inspector.model, inspector.encoder)
    error = float(np.nanmax(np.abs(expected - shown.after)))
    most = TARGETS_MS["cuda" if "cuda" in device else "cpu"]["update"]
    return {
        "events": shown.selected,
        **found,
        "error_px": error,
        "ok": error < 0.01 and found["ms"] <= most,
    }


def window(device: str) -> dict[str, Any]:
    """Measure the time from a moved slider to the points in VTK (1 million events), and the drawing off screen."""
    inspector = Inspector(recorded(made(1_000_000, 0.2)), device=device, most_points=WINDOW_POINTS)
    inspector.window = 0, 200_000
    shown = Window(inspector, off_screen=True)
    shown.whole()

    def slide(k: int) -> None:
        shown.slide("apex", 0.6 + 0.03 * k)
        shown.update()

    found, draw = timed(slide), shown.plotter.render_window.Render
    expected = compensate_events(shown.shown.events, inspector.model, inspector.encoder)
    places = np.asarray(shown.scene._clouds[1].mapper.dataset.points)
    error = float(np.nanmax(np.abs(expected - places[:, :2] * (1.0, -1.0))))
    out = {
        "events": len(shown.shown.events),
        **found,
        "error_px": error,
        "drawing": timed(lambda _: draw(), 3),
    }
    shown.scene.stride = len(shown.shown.events) // LEAST_POINTS
    slide(-1)
    out["drawing_moving"] = timed(lambda _: draw(), 3)
    shown.scene.close()
    most = TARGETS_MS["cuda" if "cuda" in device else "cpu"]["window"]
    return {**out, "ok": error < 0.01 and found["ms"] <= most}


def images(device: str) -> dict[str, Any]:
    """Measure each kind of image of a region, and a log intensity of the whole image (simulated texture)."""
    texture = np.kron(
        np.random.default_rng(0).integers(0, 255, (75, 100), dtype=np.uint8),
        np.ones((16, 16), np.uint8),
    )
    recording = simulate(
        texture, Camera.from_fov(WIDTH, HEIGHT, 1.0), Prism(0.02), duration_s=0.1, seed=1
    )
    inspector = Inspector(recording, device=device)
    inspector.take_truth()
    inspector.open(*inspector.first_window(), Selection(region=REGION))
    # As the page does after the first cloud
    out: dict[str, Any] = {"preparation": once(lambda: prepare(inspector))}
    for name, selection in (("region", Selection(region=REGION)), ("whole", Selection())):
        inspector.open(*inspector.first_window(), selection)
        # the first one also chooses the smoothness
        out[f"log_intensity_{name}_first"] = once(
            lambda: make_images(inspector, ImageKind.LOG_INTENSITY)
        )
        for kind in ImageKind:
            out[f"{kind.name.lower()}_{name}"] = timed(
                lambda _, kind=kind: make_images(inspector, kind), 3
            )
        counts = make_images(inspector, ImageKind.COUNT).before
        assert counts is not None
        out[f"events_{name}"] = {"n": inspector.loaded.selected, "counted": float(counts.sum())}
    most = TARGETS_MS["cuda" if "cuda" in device else "cpu"]["log_intensity"]
    counted = all(
        math.isclose(*out[f"events_{n}"].values(), rel_tol=0.02) for n in ("region", "whole")
    )
    slowest = max(out[f"log_intensity_{n}"]["ms"] for n in ("region", "whole"))
    return {**out, "ok": counted and slowest <= most}


def opening(path: Path, device: str, n: int, length_us: int) -> dict[str, Any]:
    """Measure the time from the start of a process to its first cloud of the suggested region; median of three runs."""
    command = [sys.executable, "-c", OPENED, str(path), device, str(length_us)]
    runs = [
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-6:]
        for _ in range(3)
    ]
    took, cpu, gib, window, read, count = (float(np.median(v)) for v in np.array(runs, float).T)
    return {"events": int(count), "window_events": int(window), "window_read": int(read), "s": took, "cpu_s": cpu,
            "gib": gib, "ok": count == n and took <= MOST_S and gib <= MOST_GIB}  # fmt: skip


def rates(path: Path, n: int) -> dict[str, Any]:
    """Measure the count of all events over time, and a curve of 1,000 bins at four zooms."""
    from amiwarp.io import open_recording
    from amiwarp.io.event_rates import EventRates

    source = open_recording(path).events
    counted, began, cpu = EventRates(source), time.perf_counter(), time.process_time()
    while not counted.fill(0.2):
        pass
    out: dict[str, Any] = {
        "fill_s": time.perf_counter() - began,
        "fill_cpu_s": time.process_time() - cpu,
    }
    edges, whole = counted.curve(source.t_first, source.t_last + 1, 1000)
    for length_us in (source.t_last - source.t_first, 1_000_000, 100_000, 10_000):
        start = source.t_first + (source.t_last - source.t_first - length_us) // 2
        out[f"curve_{length_us}_us"] = timed(
            lambda _, a=start, b=start + length_us: counted.curve(a, b, 1000)
        )
    total = float((whole * np.diff(edges)).sum() * 1e-6)
    slowest = max(each["ms"] for name, each in out.items() if name.startswith("curve"))
    return {**out, "ok": math.isclose(total, n, rel_tol=1e-6) and slowest <= MOST_RATE_MS}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--events", type=int, default=100_000_000)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    found: dict[str, Any] = {"machine": machine(args.device), "device": args.device}
    found["update_whole"], found["update_region"] = (
        update(args.device, None),
        update(args.device, REGION),
    )
    found["window"] = window(args.device)
    found["images"] = images(args.device)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.h5"
        n = write_long(path, args.events)
        os.sync()  # finish writing before the timed reading
        found["opening_turn"] = opening(path, args.device, n, 0)
        found["opening_second"] = opening(path, args.device, n, 1_000_000)
        found["rates"] = rates(path, n)
    print(json.dumps(found, indent=1))
    if args.out:
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    return int(
        not all(each["ok"] for each in found.values() if isinstance(each, dict) and "ok" in each)
    )


if __name__ == "__main__":
    sys.exit(main())
