"""Compare simulators of plain event cameras on the same moving picture: amiwarp and eventcv, without noise.

    python -m benchmarks.simulators [--seconds 0.1] [--fps 1000] [--size 640 480] [--out FILE.json]

The frames show the world `room` from a camera in a hand. eventcv gets the frames; amiwarp gets the frames, and the
world itself; rendering the frames is not timed. The error is the rms difference, over bright pixels, between the change
of log intensity from the first to the last frame and the contrast of the events in between; a perfect simulator with a
contrast of 0.2 has about 0.1. amiwarp interpolates the frames, which blurs them a little; eventcv takes each frame's
pixels as they are. eventcv, as v2e, uses a linear scale below a luminance of 20/255; darker pixels are left out. v2e
itself cannot be installed from a package index; its authors report 50 to 200 times the simulated time.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import eventcv
import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import Scene
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.sequences import PictureStack
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.named import named_world
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.simulation.worlds.world_truth import TruthRenderer

CONTRAST = 0.2
"""Contrast threshold of ON and OFF events [natural log intensity]."""
DARKEST = 25.0 / 255.0
"""Smallest linear luminance of the pixels that are compared."""
Counts = tuple[int, NDArray[np.float64]]
"""Number of events, and number of ON minus OFF events of each pixel, shape (height, width)."""


def linear_to_srgb(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the sRGB codes, 0 to 1, of linear luminance (IEC 61966-2-1)."""
    clipped = np.clip(light, 0.0, 1.0)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055).astype(np.float32)


def net(x: Any, y: Any, p: Any, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the number of ON minus OFF events of each pixel, shape ``shape``."""
    out = np.zeros(shape)
    np.add.at(out, (np.asarray(y, np.int64), np.asarray(x, np.int64)), np.where(np.asarray(p) > 0, 1.0, -1.0))
    return out


def by_eventcv(frames: NDArray[np.float32], fps: float) -> Counts:
    """Simulate with eventcv."""
    stream = eventcv.simulate(frames, fps=fps, pos_thres=CONTRAST, neg_thres=CONTRAST, sigma_thres=0.0,
                              refractory_us=0, cutoff_hz=0.0, leak_rate_hz=0.0, shot_noise_rate_hz=0.0)  # fmt: skip
    events = stream.numpy()
    x, y, _, p = events.T
    return len(events), net(x, y, p, (frames.shape[1], frames.shape[2]))


def by_amiwarp(simulation: Simulation) -> Counts:
    """Run a simulation of amiwarp and count its events."""
    total, out = 0, np.zeros((simulation.camera.height, simulation.camera.width))
    for events, _ in simulation.blocks():
        total += len(events)
        out += net(events.x, events.y, events.p, out.shape)
    return total, out


def row(
    name: str, run: Callable[[], Counts], change: NDArray[np.float64], bright: Any, seconds: float
) -> dict[str, Any]:
    """Return time and error of a simulator. The simulator runs twice; only the second run is timed.

    ``change``: change of the log intensity from the first to the last frame; ``bright``: mask of the pixels to compare;
    ``seconds``: simulated time [s].
    """
    run()
    began, began_processor = time.perf_counter(), time.process_time()
    events, counts = run()
    took, processor = time.perf_counter() - began, time.process_time() - began_processor
    apart = (change - CONTRAST * counts)[bright]
    return {"simulator": name, "events": events, "s_per_s": took / seconds, "cpu_s_per_s": processor / seconds,
            "mev_per_s": events / took * 1e-6, "error_log": float(np.sqrt(np.mean(apart**2)))}  # fmt: skip


def main() -> None:
    """Run the benchmark, print each row, and write the rows to a file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=0.1)
    parser.add_argument("--fps", type=float, default=1000.0)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    camera, none = Camera.from_fov(*args.size, math.radians(60.0)), Prism(0.0)
    world, path = named_world("room", "handheld", duration_s=args.seconds)
    ideal = SensorModel.ideal(CONTRAST)
    in_world = Simulation(WorldScene(world, path), camera, none, args.seconds, sensor=ideal)
    truth, times = TruthRenderer(in_world), np.arange(round(args.seconds * args.fps) + 1) * (1e6 / args.fps)
    light = np.stack([truth.at(int(t)).intensity for t in times])
    frames = linear_to_srgb(light)
    pictures = Scene(PictureStack(frames, args.fps, "room"), fov=math.radians(60.0), blur=0.0)
    change = np.diff(np.log(np.clip(light[[0, -1]], DARKEST, 1.0)), axis=0)[0]
    bright = ((light[[0, -1]] > DARKEST) & (light[[0, -1]] < 1.0)).all(axis=0)
    from_frames = Simulation(pictures, camera, none, args.seconds, sensor=ideal)
    cases = (
        ("eventcv, frames", lambda: by_eventcv(frames, args.fps)),
        ("amiwarp, frames", lambda: by_amiwarp(from_frames)),
        ("amiwarp, world", lambda: by_amiwarp(in_world)),
    )
    rows = [row(name, run, change, bright, args.seconds) for name, run in cases]
    for found in rows:
        print(json.dumps(found), flush=True)
    if args.out is not None:
        report = {"cores": os.cpu_count(), "fps": args.fps, "size": list(args.size), "seconds": args.seconds,
                  "rows": rows}  # fmt: skip
        args.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
