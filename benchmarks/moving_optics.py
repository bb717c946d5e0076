"""Optics beside the wedge: error of the calibrated model over seeds and a grid of difficulties, and speed of each.

    python -m benchmarks.moving_optics pair|mirror|vibration PICTURES --out FILE.json [--device cuda:0] [--seeds 20]
        [--first 0] [--no-atlas] [--every 1] [--processes 1] [--pairs N]
    python -m benchmarks.moving_optics speed --out FILE.json [--device cuda:0] [--events 10000000]

The first form simulates each case, calibrates it without start values, and writes a row for it. A pair's nominal
apexes are off by 10 %. The error is that of the model over the image and the optic's angles, without a constant lag of
all events. A case is silent if its error is over 0.02 px or its frequency is off by over 0.01 %, it was not refused,
and no warning names it. The second form compensates and votes the same random events by each optic in turns, and
compares them with a float64 trace of rays. Plates have a benchmark of their own, :mod:`benchmarks.plate`.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from scipy.optimize import minimize_scalar

import amiwarp
from amiwarp import Encoder, Mirror, Plate, Prism, PrismMotion, Vibration
from amiwarp.tasks import cpu_threads, limited_cpu_threads
from reference import optics as oracle

SIZE, FOV = (640, 480), math.radians(60.0)
CAMERA = amiwarp.Camera.from_fov(*SIZE, FOV)
LARGEST_PX, LARGEST_SHARE = 0.02, 1e-4
"""Largest error of the model [px rms], and of the frequency of a vibration."""
PICTURES = ("astronaut.png", "building.jpg", "motorcycle_left.png", "china.jpg", "graf1.png")
SHAPES = {"circle": 0.0, "ellipse": 0.5, "line": 1.0}
"""Shapes of a vibration: size of the backward circle relative to the forward one."""


@dataclass(frozen=True)
class Case:
    """A moving optic in front of a picture, and what is known of it."""

    name: str
    seed: int
    picture: str
    optic: Prism | Mirror | Vibration
    motion: PrismMotion | None = None
    duration_s: float = 0.3
    sensor: dict[str, float] = field(default_factory=dict)
    refractory_known: bool = True
    nominal: tuple[float, float] = (1.1, 0.9)
    """Nominal apexes of a pair, relative to the true ones."""
    start: dict[str, float] = field(default_factory=dict)


def pair(rng: np.random.Generator, seed: int, picture: str) -> Case:
    """Return a pair with random apexes and speeds; the prisms of every third one turn at equal and opposite speeds."""
    apexes, (first, second) = rng.uniform(0.5, 1.5, 2), rng.uniform(360.0, 1080.0, 2)
    second = -first if seed % 3 == 0 else second * rng.choice([-1.0, 1.0])
    phases = np.random.default_rng([seed, 1]).uniform(-math.pi, math.pi, 2)
    return Case("seed", seed, picture, *pair_of(apexes, (first, second), phases), duration_s=0.5)


def pair_of(apexes_deg: Any, rpm: Any, phases: Any) -> tuple[Prism, PrismMotion]:
    """Return two prisms and their motion."""
    first, second = (Prism(math.radians(float(apex))) for apex in apexes_deg)
    motion, other = (
        PrismMotion(float(speed), float(phase)) for speed, phase in zip(rpm, phases, strict=True)
    )
    return replace(first, second=second), replace(motion, second=other)


def mirror(rng: np.random.Generator, seed: int, picture: str) -> Case:
    """Return a mirror with random tilts and mount; both tilts of every third one make a circle at one frequency."""
    hz = np.exp(rng.uniform(math.log(20.0), math.log(150.0), 2)) * rng.choice([-1.0, 1.0], 2)
    amplitude, phase = (
        rng.uniform(1.0, 8.0, 2) / (2.0 * CAMERA.fx),
        rng.uniform(-math.pi, math.pi, 2),
    )
    if seed % 3 == 0:
        hz[1], amplitude[1], phase[1] = hz[0], amplitude[0], phase[0] + 0.5 * math.pi
    direction = np.array([0.0, 0.5 * math.pi]) + rng.uniform(-0.2, 0.2, 2)
    fold, incidence = rng.uniform(-math.pi, math.pi), math.radians(rng.uniform(30.0, 60.0))
    first, second, third, fourth = (
        (float(a), float(b)) for a, b in (hz, amplitude, phase, direction)
    )
    duration = min(0.4, max(0.1, 6.0 / float(np.abs(hz).min())))
    return Case(
        "seed",
        seed,
        picture,
        Mirror(first, second, third, fourth, float(fold), incidence),
        None,
        duration,
    )


def vibration(rng: np.random.Generator, seed: int, picture: str) -> Case:
    """Return a vibration with random frequency, amplitude and second harmonic, and each shape in turn."""
    hz, amplitude = math.exp(rng.uniform(math.log(20.0), math.log(300.0))), rng.uniform(1.0, 10.0)
    optic = shaken(hz, amplitude, [*SHAPES][seed % 3], float(rng.choice([0.0, 0.15])), seed)
    return Case("seed", seed, picture, optic, None, min(0.25, max(0.1, 8.0 / hz)))


def shaken(hz: Any, amplitude_px: float, shape: str, second: float, seed: int) -> Vibration:
    """Return a vibration. ``amplitude_px`` is the largest displacement by the first harmonic at the centre."""
    rng = np.random.default_rng([seed, 1])
    forward = amplitude_px / CAMERA.fx / (1.0 + SHAPES[shape])
    parts = [
        size * np.exp(2j * math.pi * rng.random())
        for size in (SHAPES[shape] * forward, second * forward)
    ]
    (bx, by), (sx, sy) = ((z.real, z.imag) for z in parts)
    return Vibration(hz, forward, math.tau * rng.random(), (bx, by), (0.0, 0.0), (sx, sy))


USUAL = {
    "pair": Case("usual", 0, PICTURES[0], *pair_of((1.0, 0.8), (720.0, -500.0), (0.4, -1.3)), 0.4),
    "mirror": Case(
        "usual", 0, PICTURES[0], Mirror((60.0, 77.0), (0.0045, 0.0036), (0.3, -1.0)), duration_s=0.2
    ),
    "vibration": Case(
        "usual", 0, PICTURES[0], shaken(100.0, 4.0, "ellipse", 0.1, 0), duration_s=0.1
    ),
}
OPTICS: dict[str, Callable[[np.random.Generator, int, str], Case]] = {
    "pair": pair, "mirror": mirror, "vibration": vibration,
}  # fmt: skip


def seeds(optic: str, first: int, count: int) -> list[Case]:
    """Return cases with random values."""
    numbers = range(first, first + count)
    return [
        OPTICS[optic](np.random.default_rng([s, 0]), s, PICTURES[s % len(PICTURES)])
        for s in numbers
    ]


def atlas(optic: str) -> list[Case]:
    """Return a grid of noise, number of events, texture and what is known, then difficulties of this optic alone."""
    usual = USUAL[optic]
    noises: dict[str, dict[str, Any]] = {"usual noise": {}, "10 Hz": {"shot_noise_hz": 10.0},
                                         "30 Hz": {"shot_noise_hz": 30.0}}  # fmt: skip
    counts = {
        "all events": (1.0, 1.0),
        "a third of the time": (1.0 / 3.0, 1.0),
        "thresholds 0.6": (1.0, 0.6),
    }
    textures = {"texture": usual.picture, "little texture": "Dune.jpg"}
    off: Any = {"nominal": (1.25, 0.8)} if optic == "pair" else {"refractory_known": False}
    known: dict[str, dict[str, Any]] = {"known": {}, next(iter(off)) + " off": off}
    cells = []
    for (a, noise), (b, (share, contrast)), (c, picture), (d, changes) in product(
        noises.items(), counts.items(), textures.items(), known.items()
    ):
        sensor = noise | (
            {"contrast_on": contrast, "contrast_off": contrast} if contrast < 1.0 else {}
        )
        name = ", ".join((a, b, c, d))
        cells.append(
            replace(
                usual,
                name=name,
                picture=picture,
                sensor=sensor,
                duration_s=share * usual.duration_s,
                **changes,
            )
        )
    return cells + specials(optic, usual)


def specials(optic: str, usual: Case) -> list[Case]:
    """Return cases with a difficulty that only this optic has."""
    if optic == "pair":
        speeds = {
            "equal speeds": 720.0,
            "speeds that differ by 2 %": 734.0,
            "second prism at rest": 1e-3,
        }
        return [
            replace(usual, name=name, motion=pair_of((1.0, 0.8), (720.0, rpm), (0.4, -1.3))[1])
            for name, rpm in speeds.items()
        ]
    if optic == "mirror":
        assert isinstance(usual.optic, Mirror)
        return [
            replace(
                usual,
                name="second tilt small: 0.3 px",
                optic=replace(usual.optic, amplitude=(0.0045, 0.00027)),
            ),
            replace(
                usual,
                name="frequencies that differ by 2 %",
                optic=replace(usual.optic, hz=(60.0, 61.2)),
            ),
        ]
    rising = shaken([(0.0, 100.0), (usual.duration_s, 102.0)], 4.0, "ellipse", 0.1, 0)
    return [
        replace(usual, name="speed given, 0.2 % off", start={"rpm": 6012.0}),
        replace(usual, name="frequency rises by 2 %", optic=rising),
    ]


def measure(case: Case, pictures: Path, device: str, pairs: int | None = None) -> dict[str, Any]:
    """Return the row of a case."""
    optic, seed, sensor = case.optic, case.seed, amiwarp.SensorModel(**case.sensor)
    given: dict[str, Any] = {"motion": case.motion} if case.motion else {}
    row: dict[str, Any] = {"case": case.name, "seed": seed, "picture": case.picture}
    if isinstance(optic, Prism):
        assert optic.second is not None
        assert case.motion is not None
        assert case.motion.second is not None
        first, second = (
            k * one.apex for k, one in zip(case.nominal, (optic, optic.second), strict=True)
        )
        given["nominal_prism"] = Prism(first, second=Prism(second))
        true: Any = amiwarp.RisleyModel(CAMERA, optic, case.motion.phase, case.motion.second.phase)
        row |= {"apexes_deg": [math.degrees(one.apex) for one in (optic, optic.second)],
                "rpm": [case.motion.rpm, case.motion.second.rpm]}  # fmt: skip
    else:
        row |= {"hz": optic.hz, **optic.parameters()}
    recording = amiwarp.simulate(
        pictures / case.picture, CAMERA, optic, duration_s=case.duration_s, sensor=sensor, seed=seed, device=device,
        **given,
    )  # fmt: skip
    row["events"] = len(recording.events)
    known = amiwarp.SensorTiming(
        refractory_us=sensor.refractory_us if case.refractory_known else None
    )
    model = {Prism: "risley", Mirror: "mirror", Vibration: "vibration"}[type(optic)]
    began = time.perf_counter()
    try:
        found = amiwarp.calibrate(
            recording, model=model, start=case.start, device=device,
            photometric=amiwarp.PhotometricSettings(sensor=known, **({"pairs": pairs} if pairs else {})),
        )  # fmt: skip
    except amiwarp.AmiwarpError as refusal:
        return {**row, "seconds": time.perf_counter() - began, "refused": str(refusal)}
    row |= {"seconds": time.perf_counter() - began, "refused": None}
    assert found.photometric is not None
    rng, rates = np.random.default_rng([seed, 2]), np.ones(1)
    xy, t = (
        rng.uniform((0, 0), (SIZE[0] - 1, SIZE[1] - 1), (20_000, 2)),
        rng.uniform(0.0, 1e6 * case.duration_s, 20_000),
    )
    share = 0.0
    if isinstance(optic, Vibration):
        theta, values, rpm = (
            rng.uniform(-math.pi, math.pi, len(xy)),
            optic.parameters(),
            found.parameters["rpm"],
        )
        true = amiwarp.VibrationModel.from_values(
            CAMERA,
            Prism(0.0),
            amiwarp.VibrationModel.reversed_values(values) if rpm < 0.0 else values,
        )
        if isinstance(optic.hz, float):
            share = row["frequency_error"] = abs(abs(rpm) / (60.0 * optic.hz) - 1.0)
    elif isinstance(optic, Mirror):
        true, theta, rates = optic.model(CAMERA), optic.motion.angles(t), np.array(optic.hz)
    else:
        assert case.motion is not None
        theta, rates = case.motion.angles(t), np.array(row["rpm"]) / 60.0
    places, largest = found.model.compensate_points(xy, theta), float(np.abs(rates).max())

    def distance(lag: float) -> float:
        """Return the error if all events are late by one time, which a calibration of phases cannot see."""
        away = places - true.compensate_points(xy, theta - np.squeeze(lag * rates / largest))
        away -= away.mean(axis=0)  # a constant shift of the picture blurs nothing
        return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))

    # a vibration has no encoder that says where its angle begins
    about = (
        min(np.linspace(-math.pi, math.pi, 64), key=distance)
        if isinstance(optic, Vibration)
        else 0.0
    )
    bounds = about - 0.3, about + 0.3
    lag = float(
        minimize_scalar(distance, bounds=bounds, method="bounded", options={"xatol": 1e-5}).x
    )
    error, warnings = distance(lag), list(found.warnings)
    if isinstance(optic, Prism):
        apexes = dict(zip(("apex", "second_apex"), np.radians(row["apexes_deg"]), strict=True))
        row["z"] = {n: (found.parameters[n] - x) / found.uncertainty[n] for n, x in apexes.items()}
    wrong = error > LARGEST_PX or share > LARGEST_SHARE
    return {
        **row, "error_px": error, "with_lag_px": distance(0.0), "cost": found.photometric.cost, "warnings": warnings,
        "silent": wrong and not warnings,
    }  # fmt: skip


def rows_of(
    work: Callable[..., dict[str, Any]], calls: list[tuple[Any, ...]], processes: int
) -> list[dict[str, Any]]:
    """Return what ``work`` returns for each tuple of arguments, computed by processes that share the cores."""
    rows: dict[int, dict[str, Any]] = {}
    threads = max(1, cpu_threads() // processes)
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as workers:
        jobs = {
            workers.submit(_with_threads, threads, work, call): k for k, call in enumerate(calls)
        }
        for job in as_completed(jobs):
            rows[jobs[job]] = job.result()
            print(json.dumps(rows[jobs[job]]), flush=True)
    return [rows[k] for k in sorted(rows)]


def _with_threads(
    threads: int, work: Callable[..., dict[str, Any]], call: tuple[Any, ...]
) -> dict[str, Any]:
    """Call a function with a limited number of threads."""
    with limited_cpu_threads(threads):
        return work(*call)


# Speed of every optic, each against a float64 trace of rays.


def optics(t: np.ndarray) -> dict[str, tuple[amiwarp.Model, Encoder, Callable[[Any, Any], Any]]]:
    """Return model, encoder and float64 trace of each optic."""
    last = int(t[-1]) + 1
    one, two = (Encoder.constant_speed(rpm, 0, last) for rpm in (720.0, 500.0))
    prism, plate, both = (
        Prism(math.radians(1.0)),
        Plate(0.01, math.radians(45.0)),
        one.with_second(two),
    )
    twice = replace(prism, second=Prism(math.radians(0.8)))
    mirror_optic, shaking = USUAL["mirror"].optic, USUAL["vibration"].optic
    assert isinstance(mirror_optic, Mirror)
    assert isinstance(shaking, Vibration)
    tilts, turns = mirror_optic.parameters(), shaking.parameters()
    return {
        "wedge": (amiwarp.ExactModel(CAMERA, prism, 0.3), one,
                  lambda xy, a: oracle.move(CAMERA, prism, xy, a, to_scene=True, phase=0.3)),
        "pair": (amiwarp.RisleyModel(CAMERA, twice, 0.3, -0.7), both,
                 lambda xy, a: oracle.through_pair(CAMERA, twice, (0.3, -0.7), xy, a, to_scene=True)),
        "mirror": (mirror_optic.model(CAMERA), both, lambda xy, a: oracle.in_mirror(CAMERA, tilts, xy, a)),
        "vibration": (amiwarp.VibrationModel.from_values(CAMERA, Prism(0.0), turns), one,
                      lambda xy, a: oracle.turned(CAMERA, oracle.vibration(turns, a), xy)),
        "plate": (amiwarp.PlateModel(CAMERA, plate, 0.3, inverse_depth=2.0), one,
                  lambda xy, a: oracle.at_depth(CAMERA, plate, 0.3, xy, a, np.full(len(xy), 2.0))),
    }  # fmt: skip


def speed(device: str, count: int, repeats: int = 9) -> list[dict[str, Any]]:
    """Return a row for each optic: events per second, and the error of that very run."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 400_000, count))
    x, y = (rng.integers(0, size, count).astype(np.uint16) for size in SIZE)
    events = amiwarp.DeviceEvents.from_arrays(
        x, y, t, rng.integers(0, 2, count).astype(np.uint8), device=device
    )
    given, times, results = optics(t), {}, {}
    rows = {
        name: {"optic": name, "device": wp.get_device(device).name, "events": count}
        for name in given
    }
    for _ in range(repeats):
        for name, (model, encoder, _) in given.items():
            for work in ("compensate", "iwe"):
                wp.synchronize_device(device)
                began = time.perf_counter()
                if work == "compensate":
                    results[name, work] = amiwarp.compensate_events(events, model, encoder)
                else:
                    results[name, work] = amiwarp.iwe(events, *SIZE, model=model, encoder=encoder)
                wp.synchronize_device(device)
                times.setdefault((name, work), []).append(time.perf_counter() - began)
    for name, (_, encoder, trace) in given.items():
        expected = trace(np.stack([x, y], axis=1).astype(np.float64), encoder.angles_at(t))
        moved = amiwarp.Events.from_arrays(
            *expected.T.astype(np.float32), t, np.ones(count, np.uint8)
        )
        away = results[name, "iwe"].numpy() - amiwarp.iwe(moved, *SIZE)
        rows[name]["error_px"] = float(
            np.nanmax(np.abs(results[name, "compensate"].numpy() - expected))
        )
        rows[name]["wrong_votes_share"] = float(0.5 * np.abs(away).sum() / count)
    for (name, work), seconds in times.items():
        rows[name][f"{work}_mev_per_s"] = count / float(np.median(seconds[1:])) / 1e6
    for row in rows.values():
        for work in ("compensate", "iwe"):
            row[f"{work}_ratio"] = row[f"{work}_mev_per_s"] / rows["wedge"][f"{work}_mev_per_s"]
        print(json.dumps(row), flush=True)
        assert row["error_px"] < 2e-3, row
        assert row["wrong_votes_share"] < 1e-3, row
    return list(rows.values())


def main() -> None:
    """Run the cases and write their rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=[*OPTICS, "speed"])
    parser.add_argument("pictures", type=Path, nargs="?")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--no-atlas", action="store_true")
    parser.add_argument("--every", type=int, default=1, help="only each N-th case")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--pairs", type=int, help="pairs of events for the photometric stage")
    parser.add_argument("--events", type=int, default=10_000_000)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    if options.what == "speed":
        options.out.write_text(json.dumps(speed(options.device, options.events), indent=1) + "\n")
        return
    cases = seeds(options.what, options.first, options.seeds) + (
        [] if options.no_atlas else atlas(options.what)
    )
    calls = [
        (case, options.pictures, options.device, options.pairs) for case in cases[:: options.every]
    ]
    options.out.write_text(json.dumps(rows_of(measure, calls, options.processes), indent=1) + "\n")


if __name__ == "__main__":
    main()
