"""Speed of the simulation of worlds. Each row gives the time and the reprojection error of the same run.

    python -m benchmarks.worlds [--device cuda:0] [--quick] [--out FILE.json]

The reprojection error of an event is the distance [px] between the pixel at which its scene point would appear without
the prism, and the projection, computed in float64, of the world point that the event saw. The first run of each scene,
which compiles kernels, is not counted.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp import (
    Camera,
    Events,
    EventTruth,
    Prism,
    Scene,
    Simulation,
    TruthRenderer,
    WorldScene,
    named_world,
)
from amiwarp.simulation.engine import Engine

CAMERA, PRISM = Camera.from_fov(640, 480, math.radians(60.0)), Prism(math.radians(1.0))
WIDE = math.radians(72.0)
"""Horizontal field of view of the picture at infinity [rad].

The picture covers the field of view of the camera and a border for the prism's deflection.
"""
SOME = 101
"""Interval of the events whose reprojection error is computed: every 101st event."""
LATENCY_S = 1e-4
"""Mean latency of the simulated sensor [s]. The latencies of events scatter by 30 us."""


def reprojection(scene: WorldScene, events: Events, truth: EventTruth) -> np.ndarray:
    """Return the reprojection errors [px] of every :data:`SOME`-th event."""
    assert truth.place is not None
    assert truth.points is not None
    places = truth.place[::SOME].astype(np.float64)
    t = events.t[::SOME] * 1e-6 - LATENCY_S
    known = np.isfinite(places[:, 0])
    rotation, position = scene.trajectory.poses(t[known])
    local = np.einsum("nij,ni->nj", rotation, places[known] - position)
    x = CAMERA.fx * local[:, 0] / local[:, 2] + CAMERA.cx
    y = CAMERA.fy * local[:, 1] / local[:, 2] + CAMERA.cy
    return np.asarray(
        np.hypot(x - truth.points[::SOME][known, 0], y - truth.points[::SOME][known, 1])
    )


def timed(
    scene: Any, seconds: float, device: str, errors: list[np.ndarray] | None
) -> tuple[float, float, int, Engine]:
    """Simulate a scene; return wall time [s], processor time [s], number of events, and the engine.

    The times do not include the first map. If ``errors`` is a list, the times include the ground truth of all events.
    The reprojection errors are then appended to the list, which is not timed.
    """
    engine = Engine(Simulation(scene, CAMERA, PRISM, seconds, device=device))
    if engine._maps is not None:
        engine._maps.cover(0, 0)
    wp.synchronize_device(device)
    wall, processor, count = 0.0, 0.0, 0
    began, began_processor = time.perf_counter(), time.process_time()
    for block in engine.run():
        count += len(block.arrays.t)
        truth = None if errors is None else block.truth()
        wp.synchronize_device(device)
        wall, processor = (
            wall + time.perf_counter() - began,
            processor + time.process_time() - began_processor,
        )
        if truth is not None and errors is not None and isinstance(scene, WorldScene):
            errors.append(reprojection(scene, block.events(), truth))
        began, began_processor = time.perf_counter(), time.process_time()
    return wall, processor, count, engine


def measure(name: str, scene: Any, seconds: float, device: str) -> dict[str, Any]:
    """Return the result of a scene, simulated without and with the ground truth of events."""
    timed(scene, 0.01, device, [])  # compiles the kernels
    wall, processor, events, _ = timed(scene, seconds, device, None)
    errors: list[np.ndarray] = []
    wall_truth, processor_truth, _, engine = timed(scene, seconds, device, errors)
    return {"scene": name, "device": device, "simulated_s": seconds, "events": events, "s_per_s": wall / seconds,
            "cpu_s_per_s": processor / seconds, "mev_per_s": events / wall * 1e-6,
            "s_per_s_with_truth": wall_truth / seconds, "cpu_s_per_s_with_truth": processor_truth / seconds,
            "maps": getattr(engine._maps, "rendered", None),
            "error_px_95": float(np.quantile(np.concatenate(errors), 0.95)) if errors else None}  # fmt: skip


def as_picture(name: str) -> Scene:
    """Return the first view of a built-in world as a picture at infinity with about twice the camera's resolution."""
    world, path = named_world(name, "still")
    wide = Camera.from_fov(1600, 1200, WIDE)
    truth = TruthRenderer(
        Simulation(WorldScene(world, path, samples=4, blur=0.5), wide, Prism(0.0), 0.01)
    ).at(0)
    return Scene.from_picture(truth.intensity, fov=WIDE)


def main() -> None:
    """Run the benchmark, print each row, and write the rows to a file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--quick", action="store_true", help="simulate a tenth of the time")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    on_cpu = wp.get_device(args.device).is_cpu
    seconds = (0.1 if on_cpu else 1.0) * (0.1 if args.quick else 1.0)
    rows = [
        measure("room, still, as a picture at infinity", as_picture("room"), seconds, args.device)
    ]
    print(json.dumps(rows[0]), flush=True)
    cases = [
        ("room", "still", "maps", None),
        ("desk", "handheld", "maps", None),
        ("room", "handheld", "maps", None),
    ]
    if not on_cpu:
        cases += [("room", "handheld", "rays", 1), ("room", "handheld", "rays", 4), ("street", "handheld", "rays", 1),
                  ("street", "handheld", "rays", 4)]  # fmt: skip
    for world, way, seeing, samples in cases:
        made, path = named_world(world, way, duration_s=seconds)
        scene = WorldScene(made, path, seeing=seeing, samples=samples)
        label = f"{world}, {way}, {seeing}" + (f", {samples} rays a pixel" if samples else "")
        rows.append(measure(label, scene, seconds, args.device) | {"triangles": made.triangles})
        print(json.dumps(rows[-1]), flush=True)
    if args.out is not None:
        args.out.write_text(
            json.dumps({"machine": str(wp.get_device(args.device).name), "rows": rows}, indent=1)
            + "\n"
        )


if __name__ == "__main__":
    main()
