"""Speed of simulated worlds, each row with the reprojection error of the events of its own run.

    python -m benchmarks.worlds [--device cuda:0] [--quick] [--out FILE.json]

The error is the distance [px] between the place of an event without the prism, and the projection of the world point
that the event saw, computed in float64 at the time of its crossing. The first run of each kind, which compiles, is not
counted.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.engine import DeviceBlock, Engine
from amiwarp.simulation.scene import Scene
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.named import named_world
from amiwarp.simulation.worlds.world_scene import WorldScene

CAMERA, PRISM = Camera.from_fov(640, 480, math.radians(60.0)), Prism(math.radians(1.0))
SOME = 101
"""One event in this many is checked."""
LATENCY_S = 1e-4
"""Mean latency of the simulated sensor [s]; single latencies scatter by 30 us."""


def reprojection(scene: WorldScene, block: DeviceBlock) -> np.ndarray:
    """Return distances [px] of some events."""
    assert block.seen is not None
    places = block.seen.place.numpy()[::SOME].astype(np.float64)
    bare = block.arrays.points.numpy()[::SOME]
    t = block.arrays.t.numpy()[::SOME] * 1e-6 - LATENCY_S
    known = np.isfinite(places[:, 0])
    rotation, position = scene.trajectory.poses(t[known])
    local = np.einsum("nij,ni->nj", rotation, places[known] - position)
    x = CAMERA.fx * local[:, 0] / local[:, 2] + CAMERA.cx
    y = CAMERA.fy * local[:, 1] / local[:, 2] + CAMERA.cy
    return np.asarray(np.hypot(x - bare[known, 0], y - bare[known, 1]))


def measure(name: str, scene: Any, seconds: float, device: str) -> dict[str, Any]:
    """Simulate twice; return the second run's row."""
    for duration in (0.01, seconds):
        engine = Engine(Simulation(scene, CAMERA, PRISM, duration, device=device))
        began, events, blocks = time.perf_counter(), 0, []
        for block in engine.run():
            events += block.count
            blocks.append(block)
        wp.synchronize_device(device)
        took = time.perf_counter() - began
    error = None
    if isinstance(scene, WorldScene):
        error = float(np.quantile(np.concatenate([reprojection(scene, block) for block in blocks]), 0.95))
    return {"scene": name, "device": device, "simulated_s": seconds, "events": events, "s_per_s": took / seconds,
            "mev_per_s": events / took * 1e-6, "maps": getattr(engine._maps, "rendered", None),
            "error_px_95": error}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--quick", action="store_true", help="a tenth of the simulated time")
    parser.add_argument("--picture", type=Path, help="for the picture at infinity; by default PyVista's map")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    on_cpu = wp.get_device(args.device).is_cpu
    seconds = (0.1 if on_cpu else 1.0) * (0.1 if args.quick else 1.0)
    picture = args.picture or Path(importlib.import_module("pyvista.examples").mapfile)
    rows = [measure("picture at infinity", Scene.from_picture(picture), seconds, args.device)]
    print(json.dumps(rows[0]), flush=True)
    cases = [("room", "still", "maps", None), ("desk", "handheld", "maps", None), ("room", "handheld", "maps", None)]
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
            json.dumps({"machine": str(wp.get_device(args.device).name), "rows": rows}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
