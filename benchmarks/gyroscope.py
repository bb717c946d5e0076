"""Calibrate simulated recordings of a camera in fast motion with the gyroscope of the recording, and without.

    python -m benchmarks.gyroscope [--device cuda:0] [--size 160 120] [--rpm 720] [--seconds 0.5] [--seeds 10 11]
        [--worlds NAME ...] [--ways given found without] [--out FILE.json]

The gyroscope is that of the trajectory: it has noise, a bias, axes that are not the camera's, and a rate of 200 Hz to
1 kHz, all drawn from the seed. ``given``: its axes are told as a user would, to the nearest axes of the camera. Those
that it has are up to 2 deg beside them. ``found``: they are not told. ``without``: the recording has no gyroscope.

The error is the rms difference [px] between the displacements of the calibrated model and of the true prism, over the
image and a turn. A silent failure is an answer with an error over 0.05 px that is more than twice what the answer
states.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp import (
    AmiwarpError,
    Camera,
    ImuSamples,
    Prism,
    PrismMotion,
    Recording,
    Simulation,
    Trajectory,
    WorldScene,
    calibrate,
    model_error,
    named_world,
    truth_model,
)
from amiwarp.events.axes import angle_between, orientations
from amiwarp.simulation.worlds.named import WORLDS

APEX = math.radians(1.0)
"""True apex angle [rad]."""
NOMINAL = 1.1
"""Ratio of the nominal to the true apex angle. It is not 1, so that the search does not start at the truth."""
LARGEST_ERROR_PX = 0.05
"""Largest error of a right answer [px]."""
WAYS = ("given", "found", "without")
"""What is known of the gyroscope: its axes, not its axes, nothing."""
RATES_HZ = (200.0, 500.0, 1000.0)
"""Rates of the gyroscopes [Hz]."""
NOISE, LARGEST_BIAS = math.radians(0.1), math.radians(3.0)
"""Standard deviation of a sample, and largest bias about each axis [rad/s]."""


def rates_of(trajectory: Trajectory, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angular velocity of a trajectory in the moving frame [rad/s], at times ``t`` [s], shape (n, 3)."""
    from scipy.spatial.transform import Rotation

    half = 1e-4
    before, after = (
        Rotation.from_matrix(trajectory.poses(t + shift)[0]) for shift in (-half, half)
    )
    return np.asarray((before.inv() * after).as_rotvec() / (2.0 * half))


def gyroscope_of(
    trajectory: Trajectory, seconds: float, rng: np.random.Generator, to_camera: NDArray[np.float64]
) -> ImuSamples:
    """Return the samples of a gyroscope whose axes ``to_camera`` rotates to the camera's."""
    t = np.arange(0.0, seconds, 1.0 / rng.choice(RATES_HZ))
    inside = np.clip(t, 2e-4, seconds - 2e-4)  # at its ends, a trajectory stops
    seen = rates_of(trajectory, inside) @ to_camera
    seen = seen + rng.uniform(-LARGEST_BIAS, LARGEST_BIAS, 3) + rng.normal(0.0, NOISE, seen.shape)
    return ImuSamples(np.round(t * 1e6).astype(np.int64), seen, np.full(seen.shape, np.nan))


def mounting(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a rotation from the gyroscope's axes to the camera's: along axes, and up to two degrees beside them."""
    from scipy.spatial.transform import Rotation

    along: NDArray[np.float64] = orientations()[int(rng.integers(24))]
    off = rng.normal(size=3)
    off *= math.radians(rng.uniform(0.0, 2.0)) / np.linalg.norm(off)
    return np.asarray(Rotation.from_rotvec(off).as_matrix() @ along)


def answer(recording: Recording, device: str) -> dict[str, Any]:
    """Return the result of the calibration of a recording, checked against its truth."""
    assert recording.camera is not None
    assert recording.truth is not None
    try:
        c = calibrate(recording, device=device)
    except AmiwarpError as error:
        return {"refused": str(error)}
    error = model_error(
        c.model, truth_model(recording.camera, recording.truth, Prism(APEX).flat_side)
    )
    stated = [float(x) for said in c.warnings for x in re.findall(r"± ([0-9.]+) px", said)]
    silent = error.rms > LARGEST_ERROR_PX and error.rms > 2.0 * max(stated, default=0.0)
    return {"model": c.model_name, "error_px": error.rms, "stated_px": max(stated, default=None), "silent": silent,
            "seconds": c.seconds, "warnings": list(c.warnings)}  # fmt: skip


def rows_of(
    name: str,
    size: tuple[int, int],
    rpm: float,
    seconds: float,
    seed: int,
    device: str,
    ways: list[str],
) -> list[dict[str, Any]]:
    """Return the results for one simulated recording, by what is known of its gyroscope."""
    rng = np.random.default_rng(seed)
    world, trajectory = named_world(name, "fast", duration_s=seconds, seed=seed)
    to_camera = mounting(rng)
    imu = gyroscope_of(trajectory, seconds, rng, to_camera)
    recording = Simulation(
        WorldScene(world, trajectory), Camera.from_fov(*size, math.radians(60.0)), Prism(APEX), seconds,
        PrismMotion(rpm), nominal_prism=Prism(NOMINAL * APEX), device=device,
    ).run()  # fmt: skip
    rates = rates_of(trajectory, np.arange(0.01, seconds - 0.005, 0.01))
    about = {
        "world": name,
        "seed": seed,
        "events": len(recording.events),
        "fastest_deg_s": math.degrees(float(np.linalg.norm(rates, axis=1).max())),
        "gyroscope_hz": imu.rate_hz,
    }
    nearest = min(orientations(), key=lambda each: angle_between(each, to_camera))
    recordings = {
        "given": replace(recording, imu=replace(imu, to_camera=nearest)),
        "found": replace(recording, imu=imu),
        "without": recording,
    }
    return [about | {"way": way} | answer(recordings[way], device) for way in ways]


def summary(rows: list[dict[str, Any]]) -> dict[str, int]:
    """Return the number of right, silently wrong and refused answers."""
    given = [each for each in rows if "error_px" in each]
    return {
        "recordings": len(rows),
        "within_0.05_px": sum(each["error_px"] <= LARGEST_ERROR_PX for each in given),
        "silent_failures": sum(each["silent"] for each in given),
        "refused": len(rows) - len(given),
    }


def main() -> None:
    """Run the benchmark, print each row, and write the rows to a file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120))
    parser.add_argument("--rpm", type=float, default=720.0, help="speed of the prism [turns/min]")
    parser.add_argument("--seconds", type=float, default=0.5, help="length of a recording [s]")
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[10, 11], help="seeds of worlds and trajectories"
    )
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument(
        "--ways", nargs="+", default=list(WAYS), choices=WAYS, help="what is known of the gyroscope"
    )
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for seed, name in itertools.product(args.seeds, args.worlds):
        number = 10 * seed + list(WORLDS).index(name)  # no two recordings with the same motion
        found = rows_of(
            name, tuple(args.size), args.rpm, args.seconds, number, args.device, args.ways
        )
        print("\n".join(map(json.dumps, found)), flush=True)
        rows += found
        totals = {way: summary([each for each in rows if each["way"] == way]) for way in args.ways}
        if args.out is not None:  # after each recording, so that a run that is cut off is not lost
            machine = str(wp.get_device(args.device).name)
            report = {
                "machine": machine,
                "size": list(args.size),
                "rpm": args.rpm,
                "seconds": args.seconds,
            }
            args.out.write_text(json.dumps({**report, **totals, "rows": rows}, indent=1) + "\n")
    print(json.dumps(totals))


if __name__ == "__main__":
    main()
