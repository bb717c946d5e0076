"""Translated recordings compared with the true ones of simulated worlds.

    python -m benchmarks.translators [--worlds room desk] [--trajectories still handheld fast] [--out FILE.json]

A camera without a prism (160 × 120, 60°) records each world: its events, and 30 pictures per second of 8 bits. If the
camera moves fast, there are also 10 pictures per second. Finer pictures have twice its resolution. From these, each
translator makes the recording through a prism (apex angle 1°, 720 turns per minute). The truth is the recording that
the same camera with the prism makes of the same world. Translated recordings have another seed, so that the noise of
the truth cannot help. No blur is added, because the pictures have that of their camera. The row ``truth, other seed``
is the best that any translator could reach.

``rate_ratio`` and ``rate_correlation`` compare the numbers of events in tiles of 10 × 10 px. ``found`` is the share of
true signal events for which the translated recording has an event of the same pixel and polarity within 2 ms,
``found_by_chance`` the same with the times of the translated events shuffled, and ``right`` the share of translated
signal events with such a true event. ``known`` is the share of translated events that the masks call known; ``right
_known`` is ``right`` among them. ``calibration_px`` is the rms error of the model that is calibrated from the
recording. ``picture`` is the correlation of log intensity, with that of the world, of the picture that is reconstructed
from the second turn.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import platform
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from amiwarp import (
    AmiwarpError,
    Camera,
    Cause,
    ExactModel,
    Prism,
    PrismMotion,
    Recording,
    Simulation,
    TruthRenderer,
    WorldScene,
    calibrate,
    model_error,
    named_world,
    reconstruct,
)
from amiwarp.simulation.picture_light import DARK
from amiwarp.simulation.translation.translator import translation

CAMERA = Camera.from_fov(160, 120, math.radians(60.0))
PRISM, MOTION, TURN_US = Prism(math.radians(1.0)), PrismMotion(720.0), 83_333
TRUE_MODEL = ExactModel.from_prism(CAMERA, PRISM, 0.0)
DURATION_S = 0.25
FPS = {"still": (30,), "handheld": (30,), "fast": (30, 10)}
"""Pictures per second, by trajectory."""
FINE = 2
"""Resolution of the fine pictures, relative to the camera."""
BLUR_PX = math.sqrt(0.5**2 - 1.0 / 12.0)
"""Blur of the pictures [px]: with that of the square pixels it is 0.5 px, that of the simulated event camera."""
TILE, NEAR_US = 10, 2000
OUT = Path(__file__).parent / "results" / "translators_cpu.json"
COLUMNS = ("rate_ratio", "rate_correlation", "found", "found_by_chance", "right", "known", "right_known",
           "calibration_px", "picture", "seconds")  # fmt: skip


@dataclass(frozen=True)
class Source:
    """What a camera without a prism records of a world."""

    plain: Recording
    """Its events."""
    folder: Path
    """Folder with its pictures: one folder per number of pictures per second, and ``fine`` for finer ones."""
    truth: Recording
    """The recording through the prism."""
    again: Recording
    """The same with another seed."""
    log: NDArray[np.float32]
    """True log intensity without the prism in the middle of the second turn, shape (height, width)."""


def record(world: str, trajectory: str, folder: Path) -> Source:
    """Simulate what the cameras with and without the prism see, and write the pictures."""
    times = {
        fps: np.rint(np.arange(math.ceil(DURATION_S * fps) + 1) * 1e6 / fps)
        for fps in FPS[trajectory]
    }
    seconds = max(float(t[-1]) for t in times.values()) * 1e-6
    scene = WorldScene(*named_world(world, trajectory, duration_s=seconds))
    prism = Simulation(scene, CAMERA, PRISM, DURATION_S, MOTION)
    middle = TURN_US * 3 // 2
    plain = replace(prism, duration_s=seconds).without_prism()
    recorded = plain.run(truth_times_us=np.unique([*np.concatenate(list(times.values())), middle]))
    assert recorded.truth is not None
    assert recorded.truth.frames is not None
    frames = {
        int(t): recorded.truth.frames[k].intensity for k, t in enumerate(recorded.truth.frames.t)
    }
    frames = {t: gaussian_filter(light, BLUR_PX) for t, light in frames.items()}
    for fps, instants in times.items():
        write_pictures(folder / f"{fps}", {round(t): frames[round(t)] for t in instants.tolist()})
    wide = Camera.from_fov(FINE * CAMERA.width, FINE * CAMERA.height, CAMERA.fov)
    finer = TruthRenderer(replace(plain, camera=wide))
    fine = {round(t): finer.at(round(t)).intensity for t in times[30].tolist()}
    write_pictures(
        folder / "fine", {t: gaussian_filter(light, FINE * BLUR_PX) for t, light in fine.items()}
    )
    log = np.log(frames[middle] + np.float32(DARK))
    return Source(recorded, folder, prism.run(), replace(prism, seed=1).run(), log)


def write_pictures(folder: Path, pictures: dict[int, NDArray[np.float32]]) -> None:
    """Write pictures by their times [us] to a new folder, with the table of times."""
    folder.mkdir()
    with (folder / "times.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["file", "t_us"])
        for t, light in pictures.items():
            Image.fromarray(encoded(light)).save(folder / f"{t}.png")
            table.writerow([f"{t}.png", t])


def encoded(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return linear luminance as sRGB values of 8 bits."""
    light = np.clip(light, 0.0, 1.0)
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * value).astype(np.uint8)


def translated(source: Source, way: str, fps: int) -> Recording:
    """Return the recording that a translator makes."""
    folder = "fine" if way == FINER else f"{fps}"
    given: Any = source.plain if way == "events" else source.folder / folder
    settings: dict[str, Any] = {
        "pictures, blended": {"interpolation": "blend"},
        "pictures, by motion": {"interpolation": "auto"},
        "pictures and events": {"events": source.plain},
        FINER: {"interpolation": "auto"},
        "events": {},
    }[way]
    work = translation(
        given,
        PRISM,
        fov=CAMERA.fov,
        blur=0.0,
        camera=CAMERA,
        motion=MOTION,
        duration_s=DURATION_S,
        seed=1,
        **settings,
    )
    return work.run()


FINER = "finer pictures, by motion"
WAYS = ("pictures, blended", "pictures, by motion", "pictures and events")
"""Translators of pictures, for each number of pictures per second."""


def columns(recording: Recording) -> dict[str, NDArray[Any]]:
    """Return the events that the scene caused: time, pixel with polarity, and whether the source knows them."""
    n = len(recording.events)
    events, truth = recording.events.slice(0, n), recording.truth
    assert truth is not None
    seen = truth.of_events(0, n)
    assert seen.cause is not None
    signal = seen.cause == Cause.SIGNAL.code
    place = (events.y.astype(np.int64) * CAMERA.width + events.x) * 2 + events.p
    known = truth.known_at(events.t, truth.points(0, n))
    return {"t": events.t[signal], "place": place[signal], "known": known[signal]}


def matched(of: dict[str, NDArray[Any]], among: dict[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return for each event whether the other recording has one of the same place within :data:`NEAR_US`."""
    span = 1 << 32
    keys = np.sort(among["place"] * span + among["t"])
    wanted = of["place"] * span + of["t"]
    low, high = (
        np.searchsorted(keys, wanted - NEAR_US),
        np.searchsorted(keys, wanted + NEAR_US, side="right"),
    )
    return np.asarray(high > low)


def shuffled(events: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return events whose times are permuted at random."""
    return {**events, "t": np.random.default_rng(0).permutation(events["t"])}


def tiles(recording: Recording) -> NDArray[np.float64]:
    """Return the number of events in each tile."""
    events = recording.events.slice(0, len(recording.events))
    cell = (events.y // TILE).astype(np.int64) * (CAMERA.width // TILE) + events.x // TILE
    return np.bincount(cell, minlength=CAMERA.width * CAMERA.height // TILE**2).astype(np.float64)


def share(values: NDArray[np.bool_]) -> float | None:
    return float(values.mean()) if values.size else None


def compare(found: Recording, source: Source) -> dict[str, float | None]:
    """Return how a recording compares with the truth."""
    here, there = tiles(found), tiles(source.truth)
    mine, true = columns(found), columns(source.truth)
    right = matched(mine, true)
    return {
        "rate_ratio": float(here.sum() / there.sum()),
        "rate_correlation": float(np.corrcoef(here, there)[0, 1]),
        "found": share(matched(true, mine)),
        "found_by_chance": share(matched(true, shuffled(mine))),
        "right": share(right),
        "known": share(mine["known"]),
        "right_known": share(right[mine["known"]]),
        "calibration_px": None,
        "picture": picture_correlation(found, source.log),
    }


def calibration_px(recording: Recording) -> float | None:
    """Return the rms error of the calibrated model [px], or None if the calibration refuses."""
    try:
        return float(model_error(calibrate(recording, model="exact").model, TRUE_MODEL).rms)
    except AmiwarpError:
        return None


def picture_correlation(recording: Recording, log: NDArray[np.float32]) -> float | None:
    """Return the correlation of the reconstructed picture with the true one, where the events determine it."""
    try:
        picture = reconstruct(recording, model=TRUE_MODEL, start_us=TURN_US, length_us=TURN_US)
    except AmiwarpError:
        return None
    known = picture.known
    return float(np.corrcoef(picture.log[known], log[known])[0, 1]) if known.sum() > 50 else None


def rows_of(world: str, trajectory: str) -> list[dict[str, Any]]:
    """Return one row per translator, and those of the truth."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        source = record(world, trajectory, Path(folder))
        given = {"truth": source.truth, "truth, other seed": source.again}
        cases = [
            *((way, None) for way in given),
            *((way, fps) for fps in FPS[trajectory] for way in WAYS),
        ]
        for way, fps in [*cases, (FINER, 30), ("events", None)]:
            began = time.process_time()
            found = given.get(way) or translated(source, way, fps or 0)
            seconds = None if way in given else time.process_time() - began
            row = {
                "world": world,
                "trajectory": trajectory,
                "fps": fps,
                "way": way,
                **compare(found, source),
            }
            if (
                trajectory != "fast"
            ):  # calibration refuses the truth, too: the camera moves too much
                row["calibration_px"] = calibration_px(found)
            rows.append({**row, "seconds": seconds, "events": len(found.events)})
            print(line(rows[-1]), flush=True)
    return rows


def line(row: dict[str, Any]) -> str:
    """Return a row as text."""
    values = ("     –" if row[name] is None else f"{row[name]:6.2f}" for name in COLUMNS)
    return (
        f"{row['world']:5} {row['trajectory']:9} {row['fps'] or '':3} {row['way']:25} "
        + " ".join(values)
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", nargs="+", default=["room", "desk"])
    parser.add_argument("--trajectories", nargs="+", default=list(FPS), choices=list(FPS))
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    print(" " * 46 + " ".join(name[:6].rjust(6) for name in COLUMNS))
    began = time.process_time()
    rows = [row for w in arguments.worlds for t in arguments.trajectories for row in rows_of(w, t)]
    about = {
        "machine": platform.processor() or platform.machine(), "cores": os.cpu_count(), "warp": wp.__version__,
        "cpu_seconds": time.process_time() - began, "camera": "160x120, 60 deg", "apex_deg": 1.0, "rpm": 720.0,
        "duration_s": DURATION_S, "near_us": NEAR_US, "tile_px": TILE,
    }  # fmt: skip
    arguments.out.write_text(json.dumps({**about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
