"""Speed of the simulator, and the error of the timed events. Prints JSON, one row per line.

    python -m benchmarks.simulate [--device cuda:0] [--picture FILE] [--apex 0.5 1 2] [--duration 1]

The camera has 640x480 pixels and 60 degrees, the prism 720 turns/min, and the sensor its default settings. ``ratio`` is
elapsed time over simulated time; below 1 is faster than real time. ``device`` leaves the events on the device; ``host``
copies them to NumPy arrays. Reading the picture and compilation are not included; ``setup_s`` is the time to prepare
the brightness map.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp import Camera, EncoderModel, ExactModel, Prism, Scene, Simulation
from amiwarp.simulation.engine import Engine
from amiwarp.simulation.image_motion import step_us

WIDTH, HEIGHT, FOV, INDEX = 640, 480, math.radians(60.0), 1.55


def blocks_picture() -> np.ndarray:
    """Return a picture of random blocks of several sizes, so that the benchmark needs no file."""
    rng = np.random.default_rng(0)
    light = np.zeros((960, 1280), np.float32)
    for size in (8, 20, 40, 80, 160):
        coarse = rng.uniform(0.0, 1.0, (-(-960 // size), -(-1280 // size))).astype(np.float32)
        light += np.kron(coarse, np.ones((size, size), np.float32))[:960, :1280]
    return np.asarray(light / light.max())


def time_run(simulation: Simulation, to_host: bool) -> tuple[float, int, float]:
    """Run a simulation; return its duration [s], its number of events, and the duration of its preparation [s]."""
    start = time.perf_counter()
    engine = Engine(simulation)
    engine.prepare()
    wp.synchronize_device(simulation.device)
    ready = time.perf_counter()
    events = 0
    for block in engine.run():
        events += len(block.events()) if to_host else len(block.arrays.t)
    wp.synchronize_device(simulation.device)
    return time.perf_counter() - ready, events, ready - start


def error_px(simulation: Simulation) -> float:
    """Return the rms distance between the true positions and those of the exact model [px].

    The model uses the encoder's angle at the event time minus the mean latency. The sensor's jitter remains: 30 us are
    0.02 px at an apex angle of 1 degree.
    """
    encoder = simulation.encoder()
    model = ExactModel(simulation.camera, simulation.prism)
    events, points = next(iter(simulation.blocks()))
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    found = model.compensate_points(
        xy, encoder.angle_at(events.t - round(simulation.sensor.latency_us))
    )
    return float(np.sqrt(np.nanmean(np.sum((found - points) ** 2, axis=1))))


def row(scene: Scene, apex: float, duration: float, device: str, repeats: int) -> dict[str, Any]:
    prism = Prism(math.radians(apex), INDEX)
    camera = Camera.from_fov(WIDTH, HEIGHT, FOV)
    simulation = Simulation(
        scene, camera, prism, duration, encoder_model=EncoderModel.ideal(), device=device
    )
    result: dict[str, Any] = {
        "apex_deg": apex,
        "step_us": step_us(simulation),
        "duration_s": duration,
    }
    for name, to_host in (("device", False), ("host", True)):
        runs = [time_run(simulation, to_host) for _ in range(repeats + 1)][1:]
        best = min(seconds for seconds, _, _ in runs)
        median = float(np.median([seconds for seconds, _, _ in runs]))
        result[name] = {
            "ratio": median / duration,
            "best": best / duration,
            "events_per_s": runs[0][1] / median,
        }
        result["setup_s"] = min(setup for _, _, setup in runs)
        result["events"] = runs[0][1]
    result["error_px_rms"] = error_px(simulation)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--apex", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--duration", type=float, default=1.0)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    wp.init()
    device = wp.get_device(arguments.device)
    scene = Scene.from_picture(arguments.picture or blocks_picture())
    print(json.dumps({"machine": platform.processor() or platform.machine(), "device": device.name, "picture":
                      arguments.picture.name if arguments.picture else "blocks"}))  # fmt: skip
    for apex in arguments.apex:
        result = row(scene, apex, arguments.duration, arguments.device, arguments.repeats)
        print(json.dumps(result), flush=True)
        if not result["error_px_rms"] < 0.1:
            raise SystemExit(f"wrong answer: the error is {result['error_px_rms']} px rms")


if __name__ == "__main__":
    main()
