"""Depth at rest behind a rotating tilted plate: errors in simulated worlds, and what noise and wrong glass do to them.

    python -m benchmarks.plate --out FILE.json [--device cuda:0] [--size 640 480] [--seeds 20] [--desk]

Plate: 10 mm, 45 deg, N-BK7; 720 turns/min; camera at rest, 60 deg. The panels are twelve textured rectangles at 0.3 to
1 m; the desk is the named world. Depths are compared with the depth map of the simulator at known pixels, which all are
at edges. Times are those of calibration and depths.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import amiwarp
from amiwarp.brightness.depths import orbit_px

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
    name: str, scene: amiwarp.WorldScene, seed: int, size: list[int], device: str, **changes: Any
) -> dict[str, Any]:
    """Return the errors of phase and depth of one simulation. ``nominal``: plate that the recording states."""
    nominal = changes.pop("nominal", PLATE)
    values = {"duration_s": 0.42, "sensor": amiwarp.SensorModel()} | changes
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
    known = found.known & np.isfinite(truth)
    error = found.inverse_depth[known] - 1.0 / truth[known]
    relative, away = np.abs(error * truth[known]), np.abs(error) / found.std[known]
    latency = simulation.sensor.latency_us * 1e-6 * 720.0 / 60.0 * math.tau
    turned = math.remainder(calibration.parameters["phase"] - (PHASE - latency), math.tau)
    radius = orbit_px(replace(calibration.model, plate=PLATE)) * float(np.median(1.0 / truth[known]))  # type: ignore[type-var,arg-type]
    return row | {
        "known": int(known.sum()), "median_relative_error": float(np.median(relative)),
        "bias": float(np.median(error * truth[known])), "p95_relative_error": float(np.percentile(relative, 95)),
        "within_1_std": float(np.mean(away < 1.0)), "within_2_std": float(np.mean(away < 2.0)),
        "phase_error_deg": math.degrees(turned), "phase_error_px": abs(turned) * radius,
        "stated_phase_std_deg": math.degrees(calibration.uncertainty["phase"]),
        "events_without_depth_share": float(1.0 - known.mean()),
    }  # fmt: skip


def cases(desk: bool, seeds: int) -> list[tuple[str, amiwarp.WorldScene, int, dict[str, Any]]]:
    """Return name, scene, seed and changes of each simulation."""
    noisy = replace(amiwarp.SensorModel(), shot_noise_hz=20.0, leak_hz=1.0, mismatch=0.1)
    listed: list[tuple[str, amiwarp.WorldScene, int, dict[str, Any]]] = [
        *(("panels", panels(seed), seed, {}) for seed in range(seeds)),
        ("panels, noise", panels(0), 0, {"sensor": noisy}),
        ("panels, 2 turns", panels(0), 0, {"duration_s": 0.17}),
        ("panels, low contrast", panels(0, 0.2), 0, {}),
        ("panels, thickness 10 % off", panels(0), 0, {"nominal": replace(PLATE, thickness=0.011)}),
        ("panels, tilt 10 % off", panels(0), 0, {"nominal": replace(PLATE, tilt=1.1 * PLATE.tilt)}),
    ]
    if desk:
        listed.append(("desk", amiwarp.WorldScene(*amiwarp.named_world("desk", "still")), 0, {}))
    return listed


def main() -> None:
    """Measure all cases and write them to a file after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--desk", action="store_true", help="also simulate the desk, which takes minutes on a CPU")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", type=int, nargs=2, default=[320, 240])
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    rows = []
    for name, scene, seed, changes in cases(options.desk, options.seeds):
        rows.append(measure(name, scene, seed, options.size, options.device, **changes))
        print(rows[-1], flush=True)
        options.out.write_text(json.dumps({"protocol": __doc__, "size": options.size, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
