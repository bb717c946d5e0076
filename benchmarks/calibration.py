"""Calibration without an initial guess, with default settings, on simulated recordings of real pictures.

    python -m benchmarks.calibration WHAT FOLDER --out FILE.json [--device cuda:0] …

WHAT is one of:

``pictures``: every picture of FOLDER through three prisms, with three seeds each. Each row holds the model error, the
blur compared with that of the true model, and the best point of a dense grid of the cost that was maximised.
``photometric``: the same recordings with thresholds of 0.22 (ON) and 0.28 (OFF) and a mismatch of 5 %, calibrated by
both stages. Each row holds the model error of both stages, and the phase error. The sensor's latency and refractory
period are known.
``moving``: the camera rotates at 2 to 60 degrees per second about each axis, and its angular velocity is calibrated.
``refiners``: the photometric stage with Gauss-Newton and with NLopt's local algorithms, from the same start.
``shares``: the photometric stage with fewer and fewer pairs of events.
``videos``: the clips in FOLDER, converted to events, with the limits of ``pictures``.
``algorithms``: NLopt's global algorithms with several budgets, and its local ones from 1 px away, on some recordings.
``costs``: sharpness costs, smoothing and polarity, on the same recordings as ``algorithms``.

The results are one JSON object. The exit status is 1 if a row exceeds its limits.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    CameraMotion,
    Events,
    FlatSide,
    MemoryEvents,
    PhotometricSettings,
    Prism,
    PrismMotion,
    Recording,
    Scene,
    SensorModel,
    SensorTiming,
    Settings,
    Sharpness,
    Simulation,
    Truth,
    calibrate,
    compensate_events,
    edge_blur,
    model_error,
    truth_model,
)
from amiwarp.calib.nlopt_solver import GLOBAL_ALGORITHMS, LOCAL_ALGORITHMS, maximise
from amiwarp.calib.preparation import prepare
from amiwarp.calib.settings import GAUSS_NEWTON, STAGES
from amiwarp.results.parameters import RATES

APEXES_DEG = (0.5, 1.0, 2.0)
NOMINAL = 1.15
"""Ratio of the nominal to the true apex angle. It differs from 1 so that no search range is centred on the truth."""
EVERY = 16
"""Interval of the kept events of a picture's recording: every 16th event. Calibration thins them further, to a million.
"""
GRID_PX = 0.75
BLUR_EVENTS = 1_000_000


def simulated(
    scene: Scene,
    camera: Camera,
    apex_deg: float,
    seed: int,
    seconds: float,
    device: str,
    *,
    every: int = EVERY,
    sensor: SensorModel | None = None,
    camera_rotation: CameraMotion | None = None,
) -> Recording:
    """Simulate a recording of which every ``every``-th event is kept. The phase depends on the seed."""
    prism = Prism(math.radians(apex_deg))
    phase = float(np.random.default_rng(seed).uniform(-math.pi, math.pi))
    simulation = Simulation(
        scene, camera, prism, seconds, PrismMotion(720.0, phase=phase),
        camera_motion=camera_rotation or CameraMotion(), sensor=sensor or SensorModel(), seed=seed, device=device,
        nominal_prism=replace(prism, apex=NOMINAL * prism.apex),
    )  # fmt: skip
    kept, count = [], 0
    for events, _ in simulation.blocks():
        part = events[slice((-count) % every, None, every)]
        kept.append(Events(part.x.copy(), part.y.copy(), part.t.copy(), part.p.copy()))
        count += len(events)
    return Recording(
        MemoryEvents(Events.concatenate(kept), camera.width, camera.height), camera, simulation.encoder(),
        simulation.nominal_prism, Truth(simulation.truth_parameters()), {"all_events": count}, "simulated",
    )  # fmt: skip


def pictures(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix in (".jpg", ".png"))


def best_of_grid(search: Any, best: np.ndarray) -> dict[str, float]:
    """Compare the optimum with the best points of two dense grids: over the search range, and around the optimum."""
    low, high = search.space.bounds()
    wide = np.stack(
        np.meshgrid(*(np.arange(a, b, GRID_PX) for a, b in zip(low, high, strict=True))), -1
    ).reshape(-1, 2)
    wide = wide[np.hypot(*wide.T) <= high[0]]
    near = best + np.stack(np.meshgrid(*[np.arange(-1.0, 1.01, 0.1)] * 2), -1).reshape(-1, 2)
    points = np.concatenate([wide, near])
    scores = np.array([search.fine(v) for v in points])
    found, k = search.fine(best), int(np.argmax(scores))
    peak = found - float(np.median(scores))
    return {
        "grid_points": len(points),
        "grid_excess": float(scores[k] - found) / peak,
        "grid_best_away_px": float(np.linalg.norm(points[k] - best)),
    }


def judged(recording: Recording, c: Calibration, device: str) -> dict[str, Any]:
    """Return model error and blur of a calibration, compared with the truth."""
    assert recording.camera is not None
    assert recording.truth is not None
    assert recording.encoder is not None
    truth = truth_model(recording.camera, recording.truth, FlatSide.SCENE)
    error = model_error(c.model, truth)
    events = recording.events.slice(0, BLUR_EVENTS)
    after, best = (
        compensate_events(events, m, recording.encoder, device=device) for m in (c.model, truth)
    )
    raw = np.stack([events.x, events.y], axis=1).astype(np.float32)
    width, height = recording.events.size
    blur, blur_truth = edge_blur(after, width, height), edge_blur(best, width, height)
    return {
        "all_events": recording.metadata["all_events"],
        "apex_deg": math.degrees(c.parameters["apex"]),
        "apex_std_deg": math.degrees(c.uncertainty["apex"]),
        "model_error_px": error.rms,
        "model_error_worst_px": error.worst,
        "lag_deg": math.degrees(error.lag),
        "blur_before_px": edge_blur(after, width, height, of=raw),
        "blur_after_px": blur,
        "blur_with_truth_px": blur_truth,
        "blur_ratio": blur / blur_truth,
        "sharpness_before": c.sharpness_before,
        "sharpness_after": c.sharpness_after,
        "evaluations": sum(s.evaluations for s in c.stages),
        "calibrate_s": c.seconds,
        "warnings": list(c.warnings),
    }


def row_of(recording: Recording, device: str) -> dict[str, Any]:
    """Calibrate one recording with the defaults, and compare the result with the truth; a refusal counts as a miss."""
    try:
        c = calibrate(recording, model="exact", device=device, stages=STAGES[:1])
    except AmiwarpError as error:
        return {"refused": str(error), "ok": False}
    search = prepare(recording, Settings(), device=device)[0]
    grid = best_of_grid(search, search.space.to_vector(dict(c.parameters)))
    row = {**judged(recording, c, device), **grid}
    row["ok"] = row["grid_excess"] <= 1e-4 and row["blur_ratio"] <= 1.05
    return row


def run_pictures(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    camera = Camera.from_fov(640, 480, math.radians(60.0))
    for picture in pictures(args.folder):
        scene = Scene.from_picture(picture)
        for apex in args.apex:
            for seed in range(args.seeds):
                recording = simulated(scene, camera, apex, seed, args.seconds, args.device)
                yield {
                    "picture": picture.name,
                    "apex_true_deg": apex,
                    "seed": seed,
                    **row_of(recording, args.device),
                }


def run_photometric(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    camera = Camera.from_fov(640, 480, math.radians(60.0))
    for picture in pictures(args.folder):
        scene = Scene.from_picture(picture)
        for apex in args.apex:
            for seed in range(args.seeds):
                recording = simulated(
                    scene, camera, apex, seed, args.seconds, args.device, every=1, sensor=MISMATCHED
                )
                label = {"picture": picture.name, "apex_true_deg": apex, "seed": seed}
                yield {**label, **photometric_row(recording, KNOWN, args.device)}


def photometric_row(
    recording: Recording, settings: PhotometricSettings, device: str
) -> dict[str, Any]:
    """Calibrate with both stages; return model errors, phase error, times and verdict."""
    assert recording.camera is not None
    assert recording.truth is not None
    try:
        c = calibrate(recording, model="exact", device=device, photometric=settings)
    except AmiwarpError as error:
        return {"refused": str(error), "ok": False}
    if c.photometric is None:
        return {"warnings": list(c.warnings), "ok": False}
    truth = truth_model(recording.camera, recording.truth, FlatSide.SCENE)
    first = replace(c, parameters=c.photometric.sharpness_parameters)
    error, before = model_error(c.model, truth).rms, model_error(first.model, truth).rms
    phase = math.degrees(math.remainder(c.parameters["phase"] - truth.phase, 2.0 * math.pi))
    stage = c.stages[-1]
    return {
        "all_events": recording.metadata["all_events"],
        "sharpness_model_error_px": before,
        "model_error_px": error,
        "phase_error_deg": phase,
        "apex_error_deg": math.degrees(c.parameters["apex"] - truth.prism.apex),
        "apex_std_deg": math.degrees(c.uncertainty["apex"]),
        "pairs": c.photometric.pairs,
        "off_over_on": c.photometric.off_over_on,
        "cost": c.photometric.cost,
        "verdict": c.photometric.verdict,
        "evaluations": stage.evaluations,
        "photometric_s": stage.seconds,
        "calibrate_s": c.seconds,
        "ok": c.photometric.accepted and error <= 0.02 and abs(phase) <= 0.3,
    }


MISMATCHED = SensorModel(contrast_on=0.22, contrast_off=0.28, mismatch=0.05)
KNOWN = PhotometricSettings(sensor=SensorTiming(MISMATCHED.latency_us, MISMATCHED.refractory_us))


def run_moving(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    camera = Camera.from_fov(640, 480, math.radians(60.0))
    for name in args.pictures:
        scene = Scene.from_picture(args.folder / name)
        for axis in range(3):
            for speed in args.speeds:
                rate = np.eye(3)[axis] * math.radians(speed)
                recording = simulated(
                    scene, camera, 1.0, axis, 0.18, args.device, every=1, sensor=MISMATCHED,
                    camera_rotation=CameraMotion(tuple(rate)),
                )  # fmt: skip
                label = {"picture": name, "axis": "xyz"[axis], "deg_per_s": speed}
                yield {**label, **moving_row(recording, rate, args.device)}


def moving_row(recording: Recording, rate: np.ndarray, device: str) -> dict[str, Any]:
    """Calibrate with free angular velocity; return the errors of velocity and model of both stages."""
    assert recording.camera is not None
    assert recording.truth is not None
    try:
        c = calibrate(
            recording,
            model="exact",
            free=("apex", "phase", "motion"),
            device=device,
            photometric=KNOWN,
        )
    except AmiwarpError as error:
        return {"refused": str(error), "ok": False}
    if c.photometric is None:
        return {"warnings": list(c.warnings), "ok": False}
    truth = truth_model(recording.camera, recording.truth, FlatSide.SCENE)
    row: dict[str, Any] = {"all_events": recording.metadata["all_events"]}
    for name, values in (("sharpness_", c.photometric.sharpness_parameters), ("", c.parameters)):
        found = np.array([values[n] for n in RATES])
        row[f"{name}velocity_error"] = float(np.linalg.norm(found - rate) / np.linalg.norm(rate))
        row[f"{name}model_error_px"] = model_error(replace(c, parameters=values).model, truth).rms
    return {
        **row,
        "pairs": c.photometric.pairs,
        "cost": c.photometric.cost,
        "verdict": c.photometric.verdict,
        "calibrate_s": c.seconds,
        "photometric_s": c.stages[-1].seconds,
        "ok": c.photometric.accepted
        and row["velocity_error"] <= 0.02
        and row["model_error_px"] <= 0.05,
    }


def run_refiners(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for label, recording in some(args, every=1, sensor=MISMATCHED):
        for algorithm in (GAUSS_NEWTON, *LOCAL_ALGORITHMS):
            row = photometric_row(recording, replace(KNOWN, algorithm=algorithm), args.device)
            yield {**label, "algorithm": algorithm, **row}


def run_shares(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for label, recording in some(args, every=1, sensor=MISMATCHED):
        for pairs in (2_400_000, 1_200_000, 600_000, 300_000, 150_000, 75_000):
            row = photometric_row(recording, replace(KNOWN, pairs=pairs), args.device)
            yield {**label, "asked_pairs": pairs, **row, "ok": True}


def run_videos(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    from amiwarp.simulation.picture_opening import open_pictures

    for clip in sorted(p for p in args.folder.iterdir() if p.suffix in (".npy", ".mp4")):
        frames = open_pictures(
            clip, fps=240.0 if "240fps" in clip.name else 25.0 if clip.suffix == ".npy" else None
        )
        camera = Camera.from_fov(*frames.size, math.radians(60.0))
        seconds = min(args.seconds, frames.duration_us * 1e-6)
        for apex in args.apex:
            for seed in range(args.seeds):
                recording = simulated(
                    Scene(frames), camera, apex, seed, seconds, args.device, every=1
                )
                yield {
                    "clip": clip.name,
                    "apex_true_deg": apex,
                    "seed": seed,
                    **row_of(recording, args.device),
                }


def some(
    args: argparse.Namespace, *, every: int = EVERY, sensor: SensorModel | None = None
) -> Iterator[tuple[dict[str, Any], Recording]]:
    """Yield one recording per picture, with each of the three prisms in turn."""
    camera = Camera.from_fov(640, 480, math.radians(60.0))
    for k, picture in enumerate(pictures(args.folder)):
        apex = APEXES_DEG[k % len(APEXES_DEG)]
        scene = Scene.from_picture(picture)
        recording = simulated(
            scene, camera, apex, k, args.seconds, args.device, every=every, sensor=sensor
        )
        yield {"picture": picture.name, "apex_true_deg": apex}, recording


def run_algorithms(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Measure how far each global and each local search algorithm ends from the optimum of the default search."""
    for label, recording in some(args):
        search = prepare(recording, Settings(), device=args.device)[0]
        search = search.run()
        best = search.space.to_vector(search.best)
        low, high = search.space.bounds()
        for name in GLOBAL_ALGORITHMS:
            for budget in (40, 80, 150, 300):
                trial = prepare(
                    recording,
                    Settings(global_algorithm=name, global_evaluations=budget),
                    device=args.device,
                )[0]
                began = time.perf_counter()
                trial.run()
                away = float(np.linalg.norm(trial.space.to_vector(trial.best) - best))
                yield {**label, "stage": "global", "algorithm": name, "budget": budget, "away_px": away,
                       "seconds": time.perf_counter() - began, "ok": True}  # fmt: skip
        for name in LOCAL_ALGORITHMS:
            for angle in (0.3, 2.0, 4.5):
                start = best + np.array([math.cos(angle), math.sin(angle)])
                stage = maximise(
                    search.fine,
                    name,
                    low=low,
                    high=high,
                    start=start,
                    evaluations=300,
                    tolerance=0.002,
                    step=0.7,
                )
                yield {**label, "stage": "local", "algorithm": name, "away_px": float(np.linalg.norm(stage.x - best)),
                       "evaluations": stage.evaluations, "seconds": stage.seconds, "ok": True}  # fmt: skip


def run_costs(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for label, recording in some(args):
        for kind in Sharpness:
            for smoothing in (0.0, 1.0, 2.0):
                for per_polarity in (False, True):
                    what = {
                        "cost": kind.value,
                        "smoothing_px": smoothing,
                        "per_polarity": per_polarity,
                    }
                    try:
                        c = calibrate(
                            recording,
                            model="exact",
                            sharpness=kind,
                            smoothing_px=smoothing,
                            per_polarity=per_polarity,
                            stages=STAGES[:1],
                            device=args.device,
                        )
                        row = judged(recording, c, args.device)
                    except AmiwarpError as error:
                        row = {"refused": str(error)}
                    yield {**label, **what, **row, "ok": True}


RUNS = {
    "pictures": run_pictures,
    "photometric": run_photometric,
    "moving": run_moving,
    "refiners": run_refiners,
    "shares": run_shares,
    "videos": run_videos,
    "algorithms": run_algorithms,
    "costs": run_costs,
}


def machine(device: str) -> dict[str, str]:
    from importlib.metadata import version

    name = (
        wp.get_device(device).name
        if device != "cpu"
        else platform.processor() or platform.machine()
    )
    packages = {p: version(p) for p in ("numpy", "scipy", "nlopt")}
    return {"device": name, "python": platform.python_version(), "warp": wp.__version__, **packages}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=RUNS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--apex", type=float, nargs="+", default=list(APEXES_DEG))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--pictures", nargs="+", default=["china.jpg", "brick.png", "astronaut.png"], help="moving"
    )
    parser.add_argument(
        "--speeds", type=float, nargs="+", default=[2.0, 10.0, 30.0, 60.0], help="moving [deg/s]"
    )
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument(
        "--limit-s", type=float, default=math.inf, help="start no new row after this time [s]"
    )
    args = parser.parse_args()
    began, rows, complete = time.perf_counter(), [], True
    for row in RUNS[args.what](args):
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        if time.perf_counter() - began > args.limit_s:
            complete = False
            break
    result = {
        "benchmark": args.what,
        "machine": machine(args.device),
        "complete": complete,
        "rows": rows,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    missed = [row for row in rows if not row["ok"]]
    print(
        f"{len(rows)} rows, {len(missed)} exceed their limits, {time.perf_counter() - began:.0f} s",
        file=sys.stderr,
    )
    return 1 if missed or not complete else 0


if __name__ == "__main__":
    sys.exit(main())
