"""Pictures from sums in phase, compared with the truth of simulated recordings and with the solver.

    python -m benchmarks.phase FOLDER --out FILE.json [--axes [NAME …]] [--speed] [--device cuda:0] [--figure FILE.png]

A 320 × 240 camera sees every picture of FOLDER through a prism (720 rpm) with apex angles of 0.5°, 1° and 2°, and noise
of about 0, 20 and 50 % of all events; ``--axes`` changes one condition at a time instead, and ``--speed`` measures
640 × 480 at 1°. All methods use the true optic, sums in phase and the solver one turn, amiwarp's network the last
quarter of it, if PyTorch is installed. Each row states the correlation with the truth of the detail (high-passed at
8 px) and of the whole picture, what the picture's contrast is beside the truth, and the processor time of the same
pictures. Rows of other axes that FILE.json already holds are kept. ``--figure`` draws the medians of all axes.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from amiwarp import (
    Calibration,
    Camera,
    CameraMotion,
    CameraRotation,
    Network,
    Prism,
    PrismMotion,
    Reconstruction,
    Recording,
    Scene,
    SensorModel,
    Simulation,
    Windows,
)
from amiwarp.reconstruction import PhaseReconstruction, phase_image
from amiwarp.studies.machine import machine, versions
from amiwarp.studies.stability.changing_scenes import Lamp
from benchmarks.reconstruct import scene_fov
from reference.calibration_sample import exact_calibration

RPM = 720.0
PHASE = 1.0
START_US = 100_000
"""Start of the turn: before a whole turn a simulated pixel still has the reference level of its start."""
PROBE_S = 0.05
"""Length of the noise-free recording that measures the scene's event rate [s]."""
FINE_PX = 8.0
BORDER = np.s_[8:-8, 8:-8]
MARGIN = 64
"""Margin of the wider view from which the view of a turned camera is cut out [px]."""
REPEATS = 3


@dataclass(frozen=True)
class Condition:
    """What a recording is made with."""

    apex_deg: float = 1.0
    noise: float = 0.0
    """Share of shot noise among the events."""
    threshold: float = 0.25
    """Contrast threshold of both polarities (log intensity)."""
    refractory_us: float = 100.0
    camera_deg_s: float = 0.0
    """Speed at which the camera turns about its vertical axis."""
    fov_deg: float = 60.0
    lamp_depth: float = 0.0
    """Relative decrease of the luminance of everything when a lamp is dark, 100 times a second."""
    width: int = 320
    height: int = 240


AXES: dict[str, tuple[Any, ...]] = {
    "apex_deg": (0.1, 0.2, 0.5, 1.0, 2.0, 4.0),
    "noise": (0.0, 0.1, 0.25, 0.5),
    "threshold": (0.1, 0.15, 0.25, 0.4, 0.6),
    "refractory_us": (0.0, 100.0, 500.0, 2000.0, 5000.0),
    "camera_deg_s": (0.0, 1.0, 3.0, 10.0, 30.0),
    "fov_deg": (30.0, 60.0, 90.0),
    "lamp_depth": (0.0, 0.05, 0.1, 0.2, 0.4),
}
TABLE = [Condition(apex_deg=a, noise=n) for a in (0.5, 1.0, 2.0) for n in (0.0, 0.2, 0.5)]
LARGE = Condition(width=640, height=480)


def simulation(picture: Path, condition: Condition, seconds: float, noise_hz: float) -> Simulation:
    """Return the simulation of a picture under a condition."""
    camera = Camera.from_fov(condition.width, condition.height, math.radians(condition.fov_deg))
    sensor = SensorModel(
        contrast_on=condition.threshold,
        contrast_off=condition.threshold,
        refractory_us=condition.refractory_us,
        shot_noise_hz=noise_hz,
    )
    still = Simulation(
        Scene.from_picture(picture),
        camera,
        Prism(math.radians(condition.apex_deg)),
        seconds,
        PrismMotion(RPM, PHASE),
        sensor=sensor,
    )
    # The same size of the scene, whose place would otherwise follow from the motion.
    scene = replace(Scene.from_picture(picture), fov=scene_fov(still))
    if condition.lamp_depth:
        lamp = Lamp(scene.frames.light, 1.0, math.ceil(1e6 * seconds), condition.lamp_depth)
        return replace(still, scene=replace(scene, frames=lamp))
    if not condition.camera_deg_s:
        return still
    motion = CameraMotion((0.0, math.radians(condition.camera_deg_s), 0.0))
    return replace(still, scene=scene, camera_motion=motion)


def noise_rate(picture: Path, condition: Condition) -> float:
    """Return the rate of shot noise per pixel [1/s] that makes up about the wanted share of all events."""
    quiet = simulation(picture, condition, PROBE_S, 0.0).run()
    pixels = condition.width * condition.height
    return condition.noise / (1.0 - condition.noise) * len(quiet.events) / PROBE_S / pixels


def correlation(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Return the correlation of two pictures without their borders."""
    return float(np.corrcoef(one[BORDER].ravel(), other[BORDER].ravel())[0, 1])


def fine(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a picture without its long waves."""
    return picture - gaussian_filter(picture, FINE_PX)


def judged(
    log: NDArray[np.float32], truth: NDArray[np.float32], threshold: float
) -> dict[str, float]:
    """Return how a picture [thresholds] resembles the truth (log intensity)."""
    found = fine(log)[BORDER]
    true = fine(truth)[BORDER]
    return {
        "detail": correlation(fine(log), fine(truth)),
        "whole": correlation(log, truth),
        "contrast": float(threshold * (found * true).sum() / (true * true).sum()),
    }


def timed(work: Callable[[], Any], repeats: int) -> tuple[Any, float, float]:
    """Return a result, and the shortest processor time and duration of some runs [s]."""
    processor = []
    duration = []
    for _ in range(repeats):
        began = time.perf_counter()
        before = time.process_time()
        result = work()
        processor.append(time.process_time() - before)
        duration.append(time.perf_counter() - began)
    return result, min(processor), min(duration)


def row(
    picture: Path, condition: Condition, device: str | None, repeats: int = 1
) -> dict[str, Any]:
    """Return the measurements of both methods for one turn of one recording."""
    noise_hz = noise_rate(picture, condition) if condition.noise else 0.0
    through = simulation(picture, condition, 0.2, noise_hz)
    recording = through.run()
    # A turning camera sees the middle of the turn.
    truth = view_at(through, condition, START_US + 0.5e6 * 60.0 / RPM)
    apex = math.radians(condition.apex_deg)
    calibration = exact_calibration(through.camera, Prism(apex), {"apex": apex, "phase": PHASE})
    found: dict[str, Any] = {"picture": picture.name, **asdict(condition), "noise_hz": noise_hz}
    phase = PhaseReconstruction(recording, calibration, device=device)
    rate = CameraRotation((0.0, math.radians(condition.camera_deg_s), 0.0))
    solver = Reconstruction(recording, calibration, camera_rotation=rate, device=device)
    found["phase"] = measured(phase, truth, condition, repeats)
    found["solver"] = measured(solver, truth, condition, repeats)
    network = network_picture(recording, calibration, phase.span(START_US, None, 1.0), device)
    if network is not None:
        picture_of, processor_s, duration_s = network
        found["network"] = {
            **judged(picture_of, truth, condition.threshold),
            "processor_s": processor_s,
            "duration_s": duration_s,
        }
    sums = phase.sums(*phase.span(START_US, None, 1.0))
    found["events_per_pixel"] = sums.events / (condition.width * condition.height)
    found["misfit"] = float(np.nanmedian(phase_image(sums, phase.model).misfit))
    return found


def network_picture(
    recording: Recording, calibration: Calibration, span: tuple[int, int], device: str | None
) -> tuple[NDArray[np.float32], float, float] | None:
    """Return the picture of amiwarp's network from the last quarter of a turn, and its times; None without PyTorch."""
    if find_spec("torch") is None:
        return None
    network = Network.quarter_turn(device or "cpu")
    encoder = recording.encoder
    stop_us = sum(span)
    start_us = stop_us - round(0.25 * span[1])
    events = recording.events
    cut = Windows(
        *(np.array([at]) for at in (*map(events.find, (start_us, stop_us)), start_us, stop_us))
    )
    optic = {"model": calibration.model, "encoder": encoder}

    def draw() -> NDArray[np.float32]:
        return np.asarray(next(network.over(recording, cut, **optic)))[0]

    draw()  # compiles
    return timed(draw, 1)


def view_at(through: Simulation, condition: Condition, time_us: float) -> NDArray[np.float32]:
    """Return the log intensity that the turning camera sees at a time without the prism."""
    camera = through.camera
    rate = math.radians(condition.camera_deg_s)
    if not rate:
        return through.log_view()
    wide = Camera(
        camera.width + 2 * MARGIN,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx + MARGIN,
        camera.cy,
    )
    view = replace(through, camera=wide, camera_motion=CameraMotion()).log_view()
    rows, columns = np.indices((camera.height, camera.width), np.float32)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    rays = np.asarray(camera.pixels_to_rays(pixels))
    turned = Rotation.from_rotvec([0.0, rate * time_us * 1e-6, 0.0]).apply(rays)
    places = np.asarray(wide.rays_to_pixels(turned.astype(np.float32)))
    seen = map_coordinates(view, places[:, ::-1].T, order=1, mode="nearest")
    return np.asarray(seen, np.float32).reshape(camera.height, camera.width)


def measured(
    work: Reconstruction | PhaseReconstruction,
    truth: NDArray[np.float32],
    condition: Condition,
    repeats: int,
) -> dict[str, float]:
    """Return quality and times of one method, which knows how the camera turns if it can."""
    start_us, length_us = work.span(START_US, None, 1.0)
    work.window(start_us, length_us)  # compiles, and chooses the solver's smoothness
    picture, processor_s, duration_s = timed(lambda: work.window(start_us, length_us), repeats)
    return {
        **judged(picture.log, truth, condition.threshold),
        "processor_s": processor_s,
        "duration_s": duration_s,
    }


def conditions(axes: list[str] | None, speed: bool) -> list[tuple[str, Condition]]:
    """Return the conditions of a run, each with the name of its axis."""
    if speed:
        return [("speed", LARGE)]
    if axes is not None:
        chosen = axes or list(AXES)
        changes = [(name, value) for name in chosen for value in AXES[name]]
        return [(name, Condition(**{name: value})) for name, value in changes]
    return [("table", condition) for condition in TABLE]


def summary(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield a line for each condition: medians and worst pictures."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    names = list(asdict(Condition()))
    for one in rows:
        groups.setdefault((one["axis"], *(one[name] for name in names)), []).append(one)
    default = asdict(Condition())
    for key, group in groups.items():
        changed = [f"{n} {v:g}" for n, v in zip(names, key[1:], strict=True) if v != default[n]]
        parts = [f"{key[0]}: {', '.join(changed) or 'default'}"]
        for method in METHODS:
            if method not in group[0]:
                continue
            detail = [one[method]["detail"] for one in group]
            whole = [one[method]["whole"] for one in group]
            spent = statistics.median(one[method]["processor_s"] for one in group)
            parts.append(
                f"{method} {statistics.median(detail):.4f} {min(detail):.4f} "
                f"{statistics.median(whole):.4f} {min(whole):.4f} {1000 * spent:.0f} ms"
            )
        yield "  |  ".join(parts)


def kept_rows(path: Path, measured_axes: set[str]) -> list[dict[str, Any]]:
    """Return the rows of a file that are not of these axes."""
    if not path.exists():
        return []
    rows: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["rows"]
    kept = [one for one in rows if one["axis"] not in measured_axes]
    # Rows from before there were lamps
    return [{"lamp_depth": 0.0, **one} for one in kept]


def rounded(values: dict[str, Any]) -> dict[str, Any]:
    """Return values with five digits, of rows and of what they hold."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            found[name] = rounded(value)
        else:
            found[name] = float(f"{value:.5g}") if isinstance(value, float) else value
    return found


METHODS = {"phase": "tab:blue", "solver": "tab:orange", "network": "tab:green"}
"""Methods with their colours. Rows from before the network have none."""
LABELS = {
    "apex_deg": "apex angle [deg]",
    "noise": "share of noise",
    "threshold": "contrast threshold",
    "refractory_us": "refractory period [us]",
    "camera_deg_s": "speed of the camera [deg/s]",
    "fov_deg": "field of view [deg]",
    "lamp_depth": "depth of a lamp's flicker",
}


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the median correlations of both methods over each axis."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(11.5, 5.2), dpi=110, layout="constrained")
    FigureCanvasAgg(drawing)
    for place, (name, label) in zip(drawing.subplots(2, 4).flat, LABELS.items(), strict=False):
        of_axis = [one for one in rows if one["axis"] == name]
        values = sorted({one[name] for one in of_axis})
        for method, colour in METHODS.items():
            if not of_axis or method not in of_axis[0]:
                continue
            for quantity, line in (("detail", "-"), ("whole", "--")):
                medians = [
                    statistics.median(
                        one[method][quantity] for one in of_axis if one[name] == value
                    )
                    for value in values
                ]
                ticks = range(len(values))
                place.plot(
                    ticks, medians, line, color=colour, marker=".", label=f"{method}, {quantity}"
                )
        place.set_xticks(range(len(values)), [f"{value:g}" for value in values])
        place.set(xlabel=label, ylim=(0.5, 1.0))
        place.grid(alpha=0.3)
    drawing.axes[0].set_ylabel("correlation with the truth")
    drawing.axes[4].set_ylabel("correlation with the truth")
    *_, of_lamp, free = drawing.axes
    free.set_axis_off()
    free.legend(*of_lamp.get_legend_handles_labels(), fontsize=8, loc="center")
    drawing.savefig(path)


def main() -> int:
    """Measure, print medians, and write all rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--axes", nargs="*", choices=list(AXES))
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--device")
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args()
    pictures = sorted(p for p in args.folder.iterdir() if p.suffix in (".png", ".jpg"))
    rows: list[dict[str, Any]] = []
    for picture in pictures:
        for axis, condition in conditions(args.axes, args.speed):
            found = {
                "axis": axis,
                **row(picture, condition, args.device, REPEATS if args.speed else 1),
            }
            rows.append(found)
            phase = found["phase"]
            solver = found["solver"]
            print(
                f"{picture.name} {axis} {condition} {found['events_per_pixel']:.2f} phase {phase['detail']:.4f} "
                f"{phase['whole']:.4f} solver {solver['detail']:.4f} {solver['whole']:.4f}",
                flush=True,
            )
    about = {
        "machine": machine(args.device or "cpu"),
        "versions": versions(["warp-lang", "numpy", "scipy"]),
    }
    rows = [*kept_rows(args.out, {found["axis"] for found in rows}), *map(rounded, rows)]
    args.out.write_text(json.dumps({**about, "rows": rows}, indent=1) + "\n", encoding="utf-8")
    if args.figure is not None:
        figure(rows, args.figure)
    for line in summary(rows):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
