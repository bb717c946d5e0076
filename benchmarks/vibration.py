"""Vibrating cameras: error of the calibrated motion and of the frequency, over seeds and where calibration fails.

``python -m benchmarks.vibration PICTURES --out FILE.json`` simulates each case, calibrates it without start values, and
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

import amiwarp
from amiwarp.optics.vibration import VibrationModel

SIZE, FOV = (320, 240), math.radians(50.0)
LARGEST_PX, LARGEST_SHARE = 0.02, 1e-4
"""Largest error of the model [px rms], and of the frequency."""
SHAPES = {"circle": 0.0, "ellipse": 0.5, "line": 1.0}
"""Size of the backward circle relative to the forward one."""
PICTURES = ("astronaut.png", "building.jpg", "motorcycle_left.png", "china.jpg", "graf1.png")


@dataclass(frozen=True)
class Case:
    """A vibration of a camera in front of a picture, and what is known of it."""

    name: str
    seed: int
    picture: str
    hz: float
    amplitude_px: float
    shape: str
    second: float
    duration_s: float = 0.1
    sensor: dict[str, float] = field(default_factory=dict)
    refractory_known: bool = True
    start: dict[str, float] = field(default_factory=dict)
    rise: float = 0.0

    def vibration(self, focal: float) -> amiwarp.Vibration:
        """Return the vibration. ``amplitude_px`` is the largest displacement by the first harmonic at the centre."""
        rng = np.random.default_rng([self.seed, 1])
        share = SHAPES[self.shape]
        forward = self.amplitude_px / focal / (1.0 + share)
        parts = [size * np.exp(2j * math.pi * rng.random()) for size in (share * forward, self.second * forward)]
        (bx, by), (sx, sy) = ((z.real, z.imag) for z in parts)
        hz = [(0.0, self.hz), (self.duration_s, self.hz * (1.0 + self.rise))] if self.rise else self.hz
        return amiwarp.Vibration(hz, forward, math.tau * rng.random(), (bx, by), (0.0, 0.0), (sx, sy))


def seeds(count: int, *, refractory_known: bool) -> list[Case]:
    """Return cases with random frequency, amplitude and second harmonic, and each shape and picture in turn."""
    found = []
    for seed in range(count):
        rng = np.random.default_rng([seed, 0])
        hz, amplitude = math.exp(rng.uniform(math.log(20.0), math.log(300.0))), rng.uniform(1.0, 10.0)
        shape, second = [*SHAPES][seed % 3], rng.choice([0.0, 0.15])
        picture = PICTURES[seed % len(PICTURES)]
        duration = min(0.25, max(0.1, 8.0 / hz))
        found.append(
            Case("seed", seed, picture, hz, amplitude, shape, second, duration, refractory_known=refractory_known)
        )
    return found


def atlas() -> list[Case]:
    """Return cases with one difficulty each."""
    usual = Case("usual", 0, PICTURES[0], 100.0, 4.0, "ellipse", 0.1)
    return [
        usual,
        replace(usual, name="noise 10 Hz", sensor={"shot_noise_hz": 10.0}),
        replace(usual, name="few events: 40 ms", duration_s=0.04),
        replace(usual, name="few events: thresholds 0.6", sensor={"contrast_on": 0.6, "contrast_off": 0.6}),
        replace(usual, name="little texture", picture="Dune.jpg"),
        replace(usual, name="refractory period unknown", refractory_known=False),
        replace(usual, name="speed given, 0.2 % off", start={"rpm": 6012.0}),
        replace(usual, name="frequency rises by 2 %", rise=0.02),
    ]


def measure(case: Case, pictures: Path, device: str) -> dict[str, Any]:
    """Return the row of a case."""
    camera = amiwarp.Camera.from_fov(*SIZE, FOV)
    vibration, sensor = case.vibration(camera.fx), amiwarp.SensorModel(**case.sensor)
    recording = amiwarp.simulate(
        pictures / case.picture, camera, vibration, duration_s=case.duration_s, sensor=sensor, seed=case.seed,
        device=device,
    )  # fmt: skip
    known = amiwarp.SensorTiming(refractory_us=sensor.refractory_us if case.refractory_known else 0.0)
    row: dict[str, Any] = {
        "case": case.name, "seed": case.seed, "picture": case.picture, "hz": case.hz, "shape": case.shape,
        "amplitude_px": case.amplitude_px, "second": case.second, "events": len(recording.events),
        "refractory_known": case.refractory_known,
    }  # fmt: skip
    began = time.perf_counter()
    try:
        found = amiwarp.calibrate(
            recording, model="vibration", start=case.start, device=device,
            photometric=amiwarp.PhotometricSettings(sensor=known),
        )  # fmt: skip
    except amiwarp.AmiwarpError as error:
        return {**row, "seconds": time.perf_counter() - began, "refused": str(error)}
    values = vibration.parameters()
    if found.parameters["rpm"] < 0.0:
        values = VibrationModel.reversed_values(values)
    true = VibrationModel.from_values(camera, amiwarp.Prism(0.0), values)
    error = amiwarp.predicted_error(found.model, true, remove_lag=True)
    share = abs(abs(found.parameters["rpm"]) / (60.0 * case.hz) - 1.0)
    assert found.photometric is not None
    wrong = error.rms > LARGEST_PX or share > LARGEST_SHARE
    return {
        **row, "seconds": time.perf_counter() - began, "refused": None, "error_px": error.rms, "worst_px": error.worst,
        "frequency_error": share, "cost": found.photometric.cost, "warnings": list(found.warnings),
        "silent": wrong and not found.warnings,
    }  # fmt: skip


def line(row: dict[str, Any]) -> str:
    """Return a row as text."""
    head = (
        f"{row['case']} {row['seed']}: {row['picture']}, {row['hz']:.0f} Hz, {row['amplitude_px']:.1f} px, "
        f"{row['shape']}, second {row['second']:.2f}, {row['events'] / 1e6:.1f} Mev, {row['seconds']:.0f} s: "
    )
    if row["refused"]:
        return f"{head}refused: {row['refused']}"
    warned = f"; {'; '.join(row['warnings'])}" if row["warnings"] else ""
    said = "SILENT " if row["silent"] else ""
    return f"{head}{said}{row['error_px']:.4f} px, frequency {row['frequency_error']:.1e}{warned}"


def main() -> None:
    """Run the cases and write their rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--unknown", action="store_true", help="do not tell the calibration the refractory period")
    parser.add_argument("--no-atlas", action="store_true")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    cases = seeds(options.seeds, refractory_known=not options.unknown) + ([] if options.no_atlas else atlas())
    rows: list[dict[str, Any]] = []
    for case in cases:
        rows.append(measure(case, options.pictures, options.device))
        print(line(rows[-1]), flush=True)
        options.out.write_text(json.dumps({"size": SIZE, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
