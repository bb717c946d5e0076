"""Pictures from sums in phase on a GPU: how they differ from the CPU's, and the time of each stage.

    python -m benchmarks.phase_cuda [--device cuda:0] [--repeats 50] [--size 640x480] [--out FILE.json]

A camera with 60° sees scikit-image's astronaut through a prism of 1° (720 rpm), for some turns. The picture of one turn
is made on the device and on the CPU, from the same events; both are compared with the scene. Then the stages run, with
the events on the device:

``sums``: angles of the events, their order by pixels, and the sums; ``order`` alone, too.
``transform``, ``lag``, ``scenes``: from the sums to the detail of the picture. ``detail`` is all three.
``long waves``: long waves from the gradient, and the median.
``whole``: from the sums to the picture.
``events to detail``, ``events to picture``: the same with the sums.
``window``: ``PhaseReconstruction.window``, with the search for the events, and the picture copied to the host;
``whole turns`` is the part of the host in it that finds where the turn ends.

``ms`` is the median duration of a run and the wait for it, ``device_ms`` the time between two events of the device's
stream. The stages from the sums on are measured as launches and as a CUDA graph. ``stream`` are pictures of successive
windows, each of a turn, as fast as possible. The exit status is 1 if the pictures differ. On ``--device cpu`` the
stages run too, slowly, to try the program.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp import (
    Camera,
    DeviceEvents,
    DeviceMemoryEvents,
    PhaseReconstruction,
    Prism,
    PrismMotion,
    Recording,
    Scene,
    Simulation,
    phase_picture,
)
from amiwarp.imaging.phase import BINS, copied_sums, sum_turns
from amiwarp.imaging.phase_device import DeviceSums
from amiwarp.reconstruction.device_picture import DevicePictures, captured
from amiwarp.reconstruction.phase_lag import lag_of
from amiwarp.reconstruction.phase_tiles import scene_of_tiles
from amiwarp.reconstruction.phase_window import whole_turns
from amiwarp.studies.machine import machine, versions
from benchmarks.phase import correlation, fine
from reference.calibration_sample import exact_calibration

APEX = math.radians(1.0)
PHASE = 1.0
RPM = 720.0
SECONDS = 0.4
START_US = 100_000
"""Start of the turn: before a whole turn a simulated pixel still has the reference level of its start."""
STEP_US = 1000
"""Distance of the windows of the stream [us]."""
MOST_DIFFERENCE = 1e-3
"""Largest accepted difference of a pixel from the CPU's picture [thresholds]."""
LEAST_WHOLE = 0.97
LEAST_DETAIL = 0.97
"""Least correlations with the scene."""


def simulation(width: int, height: int) -> Simulation:
    """Return the simulation of the recording."""
    from skimage import data

    grey = data.astronaut().mean(axis=2).astype(np.uint8)
    camera = Camera.from_fov(width, height, math.radians(60.0))
    motion = PrismMotion(RPM, PHASE)
    return Simulation(Scene.from_picture(grey), camera, Prism(APEX), SECONDS, motion, seed=1)


def work_for(recording: Recording) -> PhaseReconstruction:
    """Return the pictures of a recording, where its events are."""
    assert recording.camera is not None
    values = {"apex": APEX, "phase": PHASE}
    return PhaseReconstruction(recording, exact_calibration(recording.camera, Prism(APEX), values))


def on_device(recording: Recording, device: str) -> Recording:
    """Return the recording with its events on a device."""
    events = recording.events[:]
    width, height = recording.events.size
    there = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device)
    source = DeviceMemoryEvents(there, width, height)
    return replace(recording, events=source)


class Comparison:
    """Picture of one turn on a device and on the CPU."""

    def __init__(self, through: Simulation, device: str) -> None:
        self.device = wp.get_device(device)
        recording = through.run()
        self.truth = through.log_view()
        self.host = work_for(recording)
        self.work = work_for(on_device(recording, device))
        self.span = self.host.span(START_US, None, 1.0)
        stop_us, turns = whole_turns(self.host.encoder, *self.span)
        self.turns = float(turns)
        source = self.work.recording.events
        assert isinstance(source, DeviceMemoryEvents)
        self.events = source.between_on_device(START_US, stop_us)
        size = source.size
        self.there = DeviceSums(*size, self.work.harmonics, BINS, device, extremes=True)
        self.pictures = DevicePictures(self.work.model, self.there.values)

    def sum(self) -> None:
        """Sum the events on the device."""
        sum_turns(self.there, self.events, self.work.encoder, self.turns)

    def order(self) -> None:
        """Order the words of the events by pixels, again: the sort takes as long as the first time."""
        self.there._order()

    def result(self) -> dict[str, Any]:
        """Return how the pictures differ, and how they resemble the scene."""
        sums = self.host.sums(*self.span)
        lag = lag_of(sums, self.host.model)
        detail = scene_of_tiles(sums, self.host.model, lag, with_rest=False).detail
        log = phase_picture(sums, self.host.model)
        self.sum()
        self.pictures.run()
        found = self.pictures.log()
        there = copied_sums(self.there)
        window = self.work.window(*self.span).log
        largest = float(np.abs(found - log).max())
        row = {
            "size": f"{found.shape[1]}x{found.shape[0]}",
            "events": len(self.events),
            "harmonics": sums.harmonics,
            "tiles": len(self.pictures._orbits),
            "sums_equal": bool(np.array_equal(sums.values, there.values)),
            "lag_deg": math.degrees(float(self.pictures.lag.numpy()[0])),
            "lag_cpu_deg": math.degrees(lag),
            "detail_difference": float(np.abs(self.pictures.detail.numpy() - detail).max()),
            "largest_difference": largest,
            "window_difference": float(np.abs(window - found).max()),
            "range": float(np.ptp(log)),
            **self.likeness(found),
        }
        good = row["whole"] >= LEAST_WHOLE and row["detail"] >= LEAST_DETAIL
        row["ok"] = bool(
            good and row["sums_equal"] and max(largest, row["window_difference"]) <= MOST_DIFFERENCE
        )
        return row

    def likeness(self, log: NDArray[np.float32]) -> dict[str, float]:
        """Return the correlations of a picture with the scene."""
        return {
            "detail": correlation(fine(log), fine(self.truth)),
            "whole": correlation(log, self.truth),
        }


def timed(run: Callable[[], Any], device: Any, repeats: int) -> dict[str, float]:
    """Return the median duration of a run with the wait for it, and of the device alone [ms]."""
    run()
    wp.synchronize_device(device)
    stream = wp.get_stream(device) if device.is_cuda else None
    durations = []
    spans = []
    for _ in range(repeats):
        began = time.perf_counter()
        if stream is not None:
            first = wp.Event(device, enable_timing=True)
            last = wp.Event(device, enable_timing=True)
            began = time.perf_counter()
            stream.record_event(first)
        run()
        if stream is not None:
            stream.record_event(last)
            wp.synchronize_event(last)
            spans.append(wp.get_event_elapsed_time(first, last))
        durations.append(1e3 * (time.perf_counter() - began))
    row = {"ms": statistics.median(durations), "ms_best": min(durations)}
    if spans:
        row["device_ms"] = statistics.median(spans)
    return row


def stages(comparison: Comparison, repeats: int) -> list[dict[str, Any]]:
    """Return the times of the stages."""
    pictures = comparison.pictures
    device = comparison.device
    comparison.sum()
    pictures.run()
    from_sums: dict[str, Callable[[], None]] = {
        "transform": pictures.transform,
        "lag": pictures.find_lag,
        "scenes": pictures.make_scenes,
        "detail": pictures.draw_detail,
        "long waves": pictures.add_long_waves,
        "whole": pictures.run,
    }
    rows: list[dict[str, Any]] = []

    def measure(name: str, run: Callable[[], Any], how: str) -> None:
        row: dict[str, Any] = {"stage": name, "how": how}
        try:
            row.update(timed(run, device, repeats))
        except Exception as problem:  # the other stages are still worth their time
            row["error"] = "".join(traceback.format_exception(problem))[-1500:]
        print(json.dumps(row), flush=True)
        rows.append(row)

    measure("sums", comparison.sum, "launches")
    measure("order", comparison.order, "launches")
    measure("whole turns", lambda: whole_turns(comparison.work.encoder, *comparison.span), "call")
    graphs: dict[str, Callable[[], None]] = {}
    for name, run in from_sums.items():
        measure(name, run, "launches")
        if device.is_cuda:
            graphs[name] = replayed(run, device)
            measure(name, graphs[name], "graph")

    def then(run: Callable[[], None]) -> Callable[[], None]:
        def both() -> None:
            comparison.sum()
            run()

        return both

    detail = graphs.get("detail", pictures.draw_detail)
    measure("events to detail", then(detail), "graph" if graphs else "launches")
    measure("events to picture", then(pictures.draw), "graph" if graphs else "launches")
    measure("window", lambda: comparison.work.window(*comparison.span), "call")
    return rows


def replayed(run: Callable[[], None], device: Any) -> Callable[[], None]:
    """Return a function that replays the graph of a stage, captured at its first call."""
    graphs: list[Any] = []

    def replay() -> None:
        if not graphs:
            graphs.append(captured(run, device))
        wp.capture_launch(graphs[0])

    return replay


def stream(comparison: Comparison) -> dict[str, Any]:
    """Return how many pictures of successive windows are made in a second, and the worst of them."""
    start_us, length_us = comparison.span
    comparison.work.window(start_us, length_us)
    began = time.perf_counter()
    count = 0
    worst = 1.0
    for picture in comparison.work.windows(start_us, length_us, step_us=STEP_US):
        count += 1
        last = picture.log
        if count % 50 == 1:
            paused = time.perf_counter()
            worst = min(worst, comparison.likeness(last)["whole"])
            began += time.perf_counter() - paused
    seconds = time.perf_counter() - began
    return {"pictures": count, "pictures_per_s": count / seconds, "worst_whole": worst}


def main() -> int:
    """Compare, measure, and write all rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    width, height = (int(length) for length in args.size.split("x"))
    began = time.perf_counter()
    comparison = Comparison(simulation(width, height), args.device)
    result = comparison.result()
    result["seconds_to_first"] = time.perf_counter() - began
    print(json.dumps(result), flush=True)
    found: dict[str, Any] = {
        "machine": machine(args.device),
        "versions": versions(["warp-lang", "numpy", "scipy"]),
        "result": result,
        "stages": stages(comparison, args.repeats),
    }
    if args.out is not None:
        args.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    found["stream"] = stream(comparison)
    print(json.dumps(found["stream"]))
    if args.out is not None:
        args.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0 if result["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
