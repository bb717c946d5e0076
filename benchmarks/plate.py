"""Depth at rest behind a rotating tilted plate: errors in simulated worlds, and what noise and wrong glass do to them.

    python -m benchmarks.plate --out FILE.json [--device cuda:0] [--size 640 480] [--seeds 20] [--desk] [--no-atlas]
        [--processes 1]

Plate: 10 mm, 45 deg, N-BK7; 720 turns/min; camera at rest, 60 deg. The panels are twelve textured rectangles at 0.3 to
1 m; the desk is the named world. The atlas is a grid of noise, duration, contrast and what the recording states of the
plate. Depths are compared with the depth map of the simulator at known pixels, which all are at edges. Times are those
of calibration and depths.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import amiwarp
from amiwarp.brightness.depths import orbit_px
from benchmarks.moving_optics import rows_of

PLATE = amiwarp.Plate(0.01, math.radians(45.0))
PHASE = math.radians(40.0)


def panels(seed: int, contrast: float = 0.8) -> amiwarp.WorldScene:
    """Return a camera at rest in front of twelve textured panels at depths of 0.3 to 1 m."""
    rng = np.random.default_rng(seed)
    bodies = []
    for k, depth in enumerate(rng.permutation(np.linspace(0.3, 1.0, 12))):
        x, z = (k % 4 - 1.5) * 0.29 * depth, (k // 4 - 1.0) * 0.29 * depth
        half = 0.15 * depth
        corners = [(x - half, depth, z - half), (x + half, depth, z - half), (x + half, depth, z + half),
                   (x - half, depth, z + half)]  # fmt: skip
        cells = rng.random((12, 12)).astype(np.float32)
        cells = np.kron(cells, np.ones((16, 16), np.float32)) * contrast + 0.5 * (1.0 - contrast)
        mesh = amiwarp.Mesh(corners, [[0, 1, 2], [0, 2, 3]], uv=[[0, 0], [1, 0], [1, 1], [0, 1]])
        bodies.append(amiwarp.Body(f"panel {k}", mesh, amiwarp.Material(texture=0.1 + 0.8 * cells)))
    world = amiwarp.World("panels", tuple(bodies), ambient=1.0)
    return amiwarp.WorldScene(world, amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0]))


def measure(
    name: str,
    scene: amiwarp.WorldScene,
    seed: int,
    size: list[int],
    device: str,
    changes: dict[str, Any],
) -> dict[str, Any]:
    """Return the errors of phase and depth of one simulation. ``nominal``: plate that the recording states."""
    values = {"duration_s": 0.42, "sensor": amiwarp.SensorModel(), "nominal": PLATE} | changes
    nominal = values.pop("nominal")
    camera = amiwarp.Camera.from_fov(*size, math.radians(60.0))
    simulation = amiwarp.Simulation(
        scene, camera, PLATE, motion=amiwarp.PrismMotion(720.0, PHASE), nominal_prism=nominal, seed=seed,
        device=device, **values,
    )  # fmt: skip
    recording = simulation.run(truth_times_us=[0])
    row: dict[str, Any] = {"case": name, "seed": seed, "events": len(recording.events)}
    began = time.perf_counter()
    try:
        calibration = amiwarp.calibrate(recording, device=device)
        found = amiwarp.depth(recording, calibration, device=device)
    except amiwarp.AmiwarpError as error:
        return {**row, "refused": str(error)}
    row["seconds"] = time.perf_counter() - began
    assert recording.truth is not None
    assert recording.truth.frames is not None
    truth = recording.truth.frames[0].depth
    row["in_phase"] = by_sums_in_phase(recording, calibration, truth, device)
    began = time.process_time()
    amiwarp.depth(recording, calibration, device=device)
    row["depth_cpu_s"] = time.process_time() - began
    known = found.known & np.isfinite(truth)
    error = found.inverse_depth[known] - 1.0 / truth[known]
    relative, away = np.abs(error * truth[known]), np.abs(error) / found.std[known]
    latency = simulation.sensor.latency_us * 1e-6 * 720.0 / 60.0 * math.tau
    turned = math.remainder(calibration.parameters["phase"] - (PHASE - latency), math.tau)
    radius = orbit_px(replace(calibration.model, plate=PLATE)) * float(
        np.median(1.0 / truth[known])
    )  # type: ignore[type-var,arg-type]
    return row | {
        "known": int(known.sum()), "median_relative_error": float(np.median(relative)),
        "bias": float(np.median(error * truth[known])), "p95_relative_error": float(np.percentile(relative, 95)),
        "within_1_std": float(np.mean(away < 1.0)), "within_2_std": float(np.mean(away < 2.0)),
        "phase_error_deg": math.degrees(turned), "phase_error_px": abs(turned) * radius,
        "stated_phase_std_deg": math.degrees(calibration.uncertainty["phase"]),
        "events_without_depth_share": float(1.0 - known.mean()),
    }  # fmt: skip


def by_sums_in_phase(
    recording: amiwarp.Recording, calibration: amiwarp.Calibration, truth: np.ndarray, device: str
) -> dict[str, Any]:
    """Return errors and CPU time of the depths by sums in phase, kernels loaded."""
    amiwarp.depth(recording, calibration, method="phase", device=device)
    began = time.process_time()
    found = amiwarp.depth(recording, calibration, method="phase", device=device)
    cpu_s = time.process_time() - began
    known = found.known & np.isfinite(truth)
    error = found.inverse_depth[known] - 1.0 / truth[known]
    relative = np.abs(error * truth[known])
    away = np.abs(error) / found.std[known]
    return {
        "known": int(known.sum()),
        "median_relative_error": float(np.median(relative)),
        "bias": float(np.median(error * truth[known])),
        "p95_relative_error": float(np.percentile(relative, 95)),
        "within_1_std": float(np.mean(away < 1.0)),
        "within_2_std": float(np.mean(away < 2.0)),
        "depth_cpu_s": cpu_s,
    }


Call = tuple[str, amiwarp.WorldScene, int, list[int], str, dict[str, Any]]
"""Name, scene, seed, size, device and changes of a simulation."""


def atlas() -> list[tuple[str, float, dict[str, Any]]]:
    """Return name, contrast and changes of each cell of the grid."""
    noisy = replace(amiwarp.SensorModel(), shot_noise_hz=20.0, leak_hz=1.0, mismatch=0.1)
    noises: dict[str, Any] = {"usual noise": {}, "20 Hz": {"sensor": noisy}}
    turns = {"5 turns": {}, "2 turns": {"duration_s": 0.17}}
    stated: dict[str, Any] = {
        "plate known": {}, "thickness 10 % off": {"nominal": replace(PLATE, thickness=0.011)},
        "tilt 10 % off": {"nominal": replace(PLATE, tilt=1.1 * PLATE.tilt)},
    }  # fmt: skip
    return [
        (", ".join((a, b, f"contrast {contrast}", d)), contrast, noise | duration | plate)
        for (a, noise), (b, duration), contrast, (d, plate) in product(
            noises.items(), turns.items(), (0.8, 0.2), stated.items()
        )
    ]


def main() -> None:
    """Measure all cases and write them to a file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--desk", action="store_true", help="also simulate the desk, which takes minutes on a CPU"
    )
    parser.add_argument("--no-atlas", action="store_true")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", type=int, nargs=2, default=[320, 240])
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    where = options.size, options.device
    calls: list[Call] = []
    if options.desk:  # the longest
        calls.append(
            ("desk", amiwarp.WorldScene(*amiwarp.named_world("desk", "still")), 0, *where, {})
        )
    calls += [("panels", panels(seed), seed, *where, {}) for seed in range(options.seeds)]
    if not options.no_atlas:
        calls += [
            (name, panels(0, contrast), 0, *where, changes) for name, contrast, changes in atlas()
        ]
    rows = rows_of(measure, calls, options.processes)
    options.out.write_text(
        json.dumps({"protocol": __doc__, "size": options.size, "rows": rows}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
