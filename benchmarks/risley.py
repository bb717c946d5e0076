"""Pairs of prisms: error of the calibrated model over seeds and difficulties, and the speed beside one prism.

``python -m benchmarks.risley PICTURES --out FILE.json`` simulates each case, calibrates it without start values from
nominal apexes that are 10 % off, and writes a row for it. A case is silent if its error is over 0.02 px, was not
refused, and no warning names it.
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
from amiwarp import ExactModel, Prism, PrismMotion, RisleyModel

SIZE, FOV = (640, 480), math.radians(60.0)
LARGEST_PX = 0.02
"""Largest error of the model [px rms]."""
PICTURES = ("astronaut.png", "building.jpg", "motorcycle_left.png", "china.jpg", "graf1.png")


@dataclass(frozen=True)
class Case:
    """A pair of prisms in front of a picture."""

    name: str
    seed: int
    picture: str
    apexes_deg: tuple[float, float]
    rpm: tuple[float, float]
    duration_s: float = 0.5
    sensor: dict[str, float] = field(default_factory=dict)
    nominal: tuple[float, float] = (1.1, 0.9)
    """Nominal apexes, relative to the true ones."""


def seeds(count: int) -> list[Case]:
    """Return cases with random apexes and speeds; the prisms of every third case turn at equal and opposite speeds."""
    found = []
    for seed in range(count):
        rng = np.random.default_rng([seed, 0])
        apexes = tuple(rng.uniform(0.5, 1.5, 2).tolist())
        first, second = rng.uniform(360.0, 1080.0, 2).tolist()
        rpm = (first, -first) if seed % 3 == 0 else (first, second * rng.choice([-1.0, 1.0]))
        found.append(Case("seed", seed, PICTURES[seed % len(PICTURES)], (apexes[0], apexes[1]), rpm))
    return found


def atlas() -> list[Case]:
    """Return cases with one difficulty each."""
    usual = Case("usual", 0, PICTURES[0], (1.0, 0.8), (720.0, -500.0))
    return [
        usual,
        replace(usual, name="noise 10 Hz", sensor={"shot_noise_hz": 10.0}),
        replace(usual, name="few events: 0.12 s", duration_s=0.12),
        replace(usual, name="few events: thresholds 0.6", sensor={"contrast_on": 0.6, "contrast_off": 0.6}),
        replace(usual, name="little texture", picture="Dune.jpg"),
        replace(usual, name="nominal apexes 40 % off", nominal=(1.4, 0.7)),
        replace(usual, name="equal speeds", rpm=(720.0, 720.0)),
        replace(usual, name="speeds that differ by 2 %", rpm=(720.0, 734.0)),
        replace(usual, name="second prism at rest", rpm=(720.0, 1e-3)),
    ]


def measure(case: Case, pictures: Path, device: str) -> dict[str, Any]:
    """Return the row of a case."""
    camera = amiwarp.Camera.from_fov(*SIZE, FOV)
    first, second = (Prism(math.radians(apex)) for apex in case.apexes_deg)
    rng = np.random.default_rng([case.seed, 1])
    phases = rng.uniform(-math.pi, math.pi, 2).tolist()
    motion = PrismMotion(case.rpm[0], phases[0], second=PrismMotion(case.rpm[1], phases[1]))
    nominal = Prism(case.nominal[0] * first.apex, second=Prism(case.nominal[1] * second.apex))
    recording = amiwarp.simulate(
        pictures / case.picture, camera, replace(first, second=second), duration_s=case.duration_s, motion=motion,
        sensor=amiwarp.SensorModel(**case.sensor), nominal_prism=nominal, seed=case.seed, device=device,
    )  # fmt: skip
    row: dict[str, Any] = {
        "case": case.name, "seed": case.seed, "picture": case.picture, "apexes_deg": case.apexes_deg, "rpm": case.rpm,
        "events": len(recording.events),
    }  # fmt: skip
    began = time.perf_counter()
    try:
        found = amiwarp.calibrate(recording, device=device)
    except amiwarp.AmiwarpError as error:
        return {**row, "seconds": time.perf_counter() - began, "refused": str(error)}
    took = time.perf_counter() - began
    truth = RisleyModel(camera, replace(first, second=second), *phases)
    xy = rng.uniform((0, 0), (SIZE[0] - 1, SIZE[1] - 1), (20_000, 2))
    t = rng.uniform(0.0, 1e6 * case.duration_s, len(xy))
    theta = motion.angles(t)
    rates = np.array(case.rpm) * math.tau / 60e6
    places = found.model.compensate_points(xy, theta)

    def distance(lag_us: float) -> float:
        """Return the error if events are stamped late by a constant time, which a calibration of phases cannot see."""
        away = places - truth.compensate_points(xy, theta - lag_us * rates)
        away -= away.mean(axis=0)  # a constant shift of the picture blurs nothing
        return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))

    lag = float(minimize_scalar(distance, bounds=(-500.0, 500.0), method="bounded", options={"xatol": 0.1}).x)
    assert found.photometric is not None
    error = distance(lag)
    true = dict(zip(("apex", "second_apex"), (first.apex, second.apex), strict=True))
    z = {name: (found.parameters[name] - value) / found.uncertainty[name] for name, value in true.items()}
    return {
        **row, "seconds": took, "refused": None, "error_px": error, "with_lag_px": distance(0.0),
        "lag_us": lag, "z": z, "cost": found.photometric.cost,
        "warnings": list(found.warnings), "silent": error > LARGEST_PX and not found.warnings,
    }  # fmt: skip


def speed(pictures: Path, device: str) -> dict[str, Any]:
    """Return the time to compensate the same events by one prism and by a pair, in turns, and the errors."""
    camera, duration = amiwarp.Camera.from_fov(*SIZE, FOV), 0.4
    encoder = amiwarp.Encoder.constant_speed(720.0, 0, round(1e6 * duration))
    prism = Prism(math.radians(1.0))
    recording = amiwarp.simulate(pictures / PICTURES[0], camera, prism, duration_s=duration, device=device)
    events = recording.events.slice(0, len(recording.events))
    given = {
        "one prism": (ExactModel(camera, prism, 0.3), encoder),
        "pair": (RisleyModel(camera, replace(prism, second=prism), 0.3, -0.7, -0.7), encoder.with_second(-0.7)),
    }
    times: dict[str, list[float]] = {name: [] for name in given}
    row: dict[str, Any] = {"case": "speed", "events": len(events)}
    some = np.linspace(0, len(events) - 1, 10_000).astype(int)
    xy = np.stack([events.x[some], events.y[some]], axis=1).astype(np.float64)
    for _ in range(8):
        for name, (model, angles) in given.items():
            began = time.perf_counter()
            places = amiwarp.compensate_events(events, model, angles, device=device)
            times[name].append(time.perf_counter() - began)
            expected = model.compensate_points(xy, angles.angles_at(events.t[some]))
            row[f"{name}: error_px"] = float(np.nanmax(np.abs(places[some] - expected)))
    return row | {f"{name}: mev_per_s": len(events) / np.median(each[1:]) / 1e6 for name, each in times.items()}


def main() -> None:
    """Run the cases and write their rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", nargs="+", type=int, help="numbers of the cases to run; the last one is the speed")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    cases = [*seeds(options.seeds), *atlas()]
    rows: list[dict[str, Any]] = []
    for k in options.only if options.only is not None else range(len(cases) + 1):
        of_speed = k == len(cases)
        row = (
            speed(options.pictures, options.device) if of_speed else measure(cases[k], options.pictures, options.device)
        )
        rows.append(row)
        print(json.dumps(row), flush=True)
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
