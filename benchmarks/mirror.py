"""Mirrors with two tilts: error of the calibrated model over seeds and difficulties.

``python -m benchmarks.mirror PICTURES --out FILE.json`` simulates each case, calibrates it without start values, and
writes a row for it. A case is silent if its error is over 0.02 px, was not refused, and no warning names it.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

import amiwarp
from benchmarks.risley import FOV, LARGEST_PX, PICTURES, SIZE


@dataclass(frozen=True)
class Case:
    """A mirror in front of a picture, and what is known of it."""

    name: str
    seed: int
    picture: str
    mirror: amiwarp.Mirror
    duration_s: float = 0.2
    sensor: dict[str, float] = field(default_factory=dict)
    refractory_known: bool = True


def seeds(count: int) -> list[Case]:
    """Return cases with random tilts and mounts; both tilts of every third case make a circle at one frequency."""
    focal, found = amiwarp.Camera.from_fov(*SIZE, FOV).fx, []
    for seed in range(count):
        rng = np.random.default_rng([seed, 0])
        hz = np.exp(rng.uniform(math.log(20.0), math.log(150.0), 2)) * rng.choice([-1.0, 1.0], 2)
        amplitude = rng.uniform(1.0, 8.0, 2) / (2.0 * focal)
        phase = rng.uniform(-math.pi, math.pi, 2)
        if seed % 3 == 0:
            hz[1], amplitude[1], phase[1] = hz[0], amplitude[0], phase[0] + 0.5 * math.pi
        direction = np.array([0.0, 0.5 * math.pi]) + rng.uniform(-0.2, 0.2, 2)
        fold, incidence = rng.uniform(-math.pi, math.pi), math.radians(rng.uniform(30.0, 60.0))
        first, second, third, fourth = ((float(a), float(b)) for a, b in (hz, amplitude, phase, direction))
        mirror = amiwarp.Mirror(first, second, third, fourth, float(fold), incidence)
        duration = min(0.4, max(0.1, 6.0 / float(np.abs(hz).min())))
        found.append(Case("seed", seed, PICTURES[seed % len(PICTURES)], mirror, duration))
    return found


def atlas() -> list[Case]:
    """Return cases with one difficulty each."""
    usual = Case("usual", 0, PICTURES[0], amiwarp.Mirror((60.0, 77.0), (0.0045, 0.0036), (0.3, -1.0)))
    return [
        usual,
        replace(usual, name="noise 10 Hz", sensor={"shot_noise_hz": 10.0}),
        replace(usual, name="few events: 40 ms", duration_s=0.04),
        replace(usual, name="few events: thresholds 0.6", sensor={"contrast_on": 0.6, "contrast_off": 0.6}),
        replace(usual, name="little texture", picture="Dune.jpg"),
        replace(usual, name="refractory period unknown", refractory_known=False),
        replace(usual, name="second tilt small: 0.3 px", mirror=replace(usual.mirror, amplitude=(0.0045, 0.00027))),
        replace(usual, name="frequencies that differ by 2 %", mirror=replace(usual.mirror, hz=(60.0, 61.2))),
    ]


def measure(case: Case, pictures: Path, device: str) -> dict[str, Any]:
    """Return the row of a case."""
    camera, motion, rng = amiwarp.Camera.from_fov(*SIZE, FOV), case.mirror.motion, np.random.default_rng(case.seed)
    sensor = amiwarp.SensorModel(**case.sensor)
    recording = amiwarp.simulate(
        pictures / case.picture, camera, case.mirror, duration_s=case.duration_s, sensor=sensor, seed=case.seed,
        device=device,
    )  # fmt: skip
    known = amiwarp.SensorTiming(refractory_us=sensor.refractory_us if case.refractory_known else 0.0)
    row: dict[str, Any] = {
        "case": case.name, "seed": case.seed, "picture": case.picture, **case.mirror.parameters(),
        "hz": case.mirror.hz, "duration_s": case.duration_s, "events": len(recording.events),
    }  # fmt: skip
    began = time.perf_counter()
    try:
        found = amiwarp.calibrate(
            recording, model="mirror", device=device, photometric=amiwarp.PhotometricSettings(sensor=known)
        )
    except amiwarp.AmiwarpError as refusal:
        return {**row, "seconds": time.perf_counter() - began, "refused": str(refusal)}
    took = time.perf_counter() - began
    true = case.mirror.model(camera)
    xy = rng.uniform((0, 0), (SIZE[0] - 1, SIZE[1] - 1), (20_000, 2))
    theta, rates = motion.angles(rng.uniform(0.0, 1e6 * case.duration_s, len(xy))), np.array(case.mirror.hz) * math.tau
    places = found.model.compensate_points(xy, theta)

    def distance(lag_us: float) -> float:
        """Return the error if events are stamped late by a constant time, which a calibration of phases cannot see."""
        away = places - true.compensate_points(xy, theta - 1e-6 * lag_us * rates)
        away -= away.mean(axis=0)  # a constant shift of the picture blurs nothing
        return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))

    lag = float(minimize_scalar(distance, bounds=(-500.0, 500.0), method="bounded", options={"xatol": 0.1}).x)
    error, warnings = distance(lag), list(found.warnings)
    assert found.photometric is not None
    return {
        **row, "seconds": took, "refused": None, "error_px": error, "lag_us": lag, "cost": found.photometric.cost,
        "warnings": warnings, "silent": error > LARGEST_PX and not warnings,
    }  # fmt: skip


def main() -> None:
    """Run the cases and write their rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--no-atlas", action="store_true")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for case in seeds(options.seeds) + ([] if options.no_atlas else atlas()):
        rows.append(measure(case, options.pictures, options.device))
        print(json.dumps(rows[-1]), flush=True)
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
