"""Calibrate recordings of simulated worlds with a camera at rest, handheld, and in fast motion.

    python -m benchmarks.worlds_calibration [--device cuda:0] [--size 320 240] [--rpm 720] [--seconds 0.4] [--seeds 0]
        [--worlds NAME ...] [--trajectories NAME ...] [--out FILE.json]

The error is the rms difference [px] between the displacements of the calibrated model and of the true prism, over the
image and a turn. A camera that translates causes parallax, which differs over the image. Each row therefore gives
the largest speed of parallax in the image, and its ratio to the mean speed that the prism gives the image.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp import (
    AmiwarpError,
    Camera,
    Prism,
    PrismMotion,
    Settings,
    Simulation,
    WorldScene,
    calibrate,
    model_error,
    named_world,
    truth_model,
)
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.image_speed import movers_speed, parallax_speed
from amiwarp.simulation.worlds.named import TRAJECTORIES, WORLDS

APEX = math.radians(1.0)
"""True apex angle [rad]."""
NOMINAL = 1.1
"""Ratio of the nominal to the true apex angle. It is not 1, so that the search does not start at the truth."""


def image_speeds(
    scene: WorldScene, camera: Camera, seconds: float, device: str
) -> tuple[float, float]:
    """Return the largest speeds in the image [px/s] due to the camera's translation and due to moving bodies."""
    world, t = DeviceWorld(scene.world, device), np.linspace(0.0, seconds, 9)
    world.set_instants(t)
    parallax = max(
        parallax_speed(world, camera, scene.trajectory, float(at), k) for k, at in enumerate(t)
    )
    return parallax, float(movers_speed(world, camera, scene.trajectory, t).max())


def row(
    name: str,
    trajectory: str,
    size: tuple[int, int],
    rpm: float,
    seconds: float,
    seed: int,
    device: str,
) -> dict[str, Any]:
    """Return the result of the calibration of one simulated recording."""
    camera, prism = Camera.from_fov(*size, math.radians(60.0)), Prism(APEX)
    world, path = named_world(name, trajectory, duration_s=seconds, seed=seed)
    scene = WorldScene(world, path)
    began = time.perf_counter()
    nominal = Prism(NOMINAL * APEX)
    simulation = Simulation(
        scene, camera, prism, seconds, PrismMotion(rpm), nominal_prism=nominal, device=device
    )
    recording = simulation.run()
    simulated = time.perf_counter() - began
    parallax, movers = image_speeds(scene, camera, seconds, device)
    prism_speed = camera.fx * (prism.index - 1.0) * APEX * rpm / 60.0 * 2.0 * math.pi
    found = {"world": name, "trajectory": trajectory, "seed": seed, "events": len(recording.events),
             "simulated_in_s": simulated, "parallax_px_s": parallax, "movers_px_s": movers,
             "parallax_share": parallax / prism_speed}  # fmt: skip
    assert recording.camera is not None
    assert recording.truth is not None
    try:
        c = calibrate(recording, Settings(), device=device)
    except AmiwarpError as error:
        return found | {"refused": str(error)}
    truth = truth_model(recording.camera, recording.truth, prism.flat_side)
    error = model_error(c.model, truth)
    return found | {"model": c.model_name, "error_px": error.rms, "largest_px": error.worst, "seconds": c.seconds,
                    "warnings": list(c.warnings)}  # fmt: skip


def main() -> None:
    """Run the benchmark, print each row, and write the rows to a file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    parser.add_argument("--rpm", type=float, default=720.0, help="speed of the prism [turns/min]")
    parser.add_argument("--seconds", type=float, default=0.4, help="length of a recording [s]")
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0], help="seeds of the worlds and the trajectories"
    )
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument(
        "--trajectories", nargs="+", default=list(TRAJECTORIES), choices=list(TRAJECTORIES)
    )
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rows = []
    for trajectory in args.trajectories:
        for name, seed in itertools.product(args.worlds, args.seeds):
            rows.append(
                row(name, trajectory, tuple(args.size), args.rpm, args.seconds, seed, args.device)
            )
            print(json.dumps(rows[-1]), flush=True)
    if args.out is not None:
        machine = str(wp.get_device(args.device).name)
        report = {
            "machine": machine,
            "size": list(args.size),
            "rpm": args.rpm,
            "seconds": args.seconds,
            "rows": rows,
        }
        args.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
