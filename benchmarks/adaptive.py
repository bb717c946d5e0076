"""Adaptive prism speed compared with fixed speeds: visible edges against event rate. Writes JSON and a chart.

    python -m benchmarks.adaptive [--out FILE.json] [--figure FILE.png]

A 320 × 240 camera (60°) behind a prism (apex 1.8°) looks at PyVista's map of the earth. The camera stands still, or
rotates so that its optical axis follows a circle. Each window of 33 ms is simulated at the speed that resulted from the
previous window, including the lag of the motor. docs/explanation/adaptive-speed.md defines ``ok`` and how edges are
counted. The exit status is 1 if a row is not ok.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from amiwarp import (
    Camera,
    CameraMotion,
    Encoder,
    Events,
    ExactModel,
    Prism,
    PrismMotion,
    Scene,
    Simulation,
    compensate_events,
)
from amiwarp.io.outputs import write_text
from amiwarp.kernels import prism_view as sight
from amiwarp.kernels.camera import camera_params
from amiwarp.kernels.launch import launch
from amiwarp.live.stream.adaptive import SpeedController
from amiwarp.live.stream.coverage import CoverageMeter, prism_orbit, prism_path
from amiwarp.plotting.figures import save
from amiwarp.simulation.image_motion import step_us
from amiwarp.simulation.picture_maps import MapRing, place_scene
from amiwarp.studies.demo import earth
from amiwarp.studies.machine import machine, versions

CAMERA = Camera.from_fov(320, 240, math.radians(60.0))
PRISM, SMALL, PHASE = Prism(math.radians(1.8)), Prism(math.radians(0.9)), 1.0
"""Two prisms, with orbits of 5.8 and 2.9 px, and the phase of both [rad]."""
WINDOW_US = 33_000
FIXED, USUAL = (180.0, 360.0, 540.0, 720.0, 1440.0), 720.0
MOTIONS = {
    "still": (0.0, 1.0, 1),
    "slow": (15.0, 1.0, 1),
    "fast": (120.0, 1.0, 3),
    "very fast": (300.0, 0.4, 6),
}
"""Camera motions by name: angular speed [deg/s], duration of a circle of the optical axis [s], and number of measured
circles."""
SETTLED_S, ADAPTED_S = 0.2, 1.2
"""Time from the start of a run to the start of the measured circles [s], for fixed and for adaptive speed."""
CHANGING = (("still", 2.0), ("slow", 1.0), ("fast", 2.0), ("still", 2.0))
"""Sequence of motions and their durations [s]: whole circles, so that each starts where the last one ends."""
MOST_RPM, START_RPM = 900.0, 540.0
"""Highest speed that the controller may command, and its initial speed, from which it settles before the measurement
starts [turns/min]."""
BANDS: dict[str, dict[str, float]] = {
    "adaptive": {},
    "adaptive, 99 %": {"low": 0.99, "high": 0.996},
}
"""Limits of the coverage that the controller aims at: its default limits, and lower ones of about 99 %."""
SPARE_S = 0.05
"""Time simulated after the measurement, because the last window extends past its end [s]."""
MOTOR_S = 0.1
"""Time constant of the simulated motor's speed [s]."""
CONTRAST, NEAR, LEAST = 0.75, 1.0, 2
"""Smallest change of log intensity within 3 × 3 px at an edge, and distance [px] and number of events that make an edge
visible."""
MARGIN = 24
"""Border of the image that is not evaluated, because it is not in view during the whole window [px]."""


@dataclass(eq=False)
class Driven:
    """Prism motion whose speed is set during the simulation; used instead of a :class:`PrismMotion`."""

    rpm: float
    largest_rpm: float
    phase: float = PHASE
    tilt: tuple[float, float] = (0.0, 0.0)
    rows: list[tuple[float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rows = [(-1.0, self.rpm), (0.0, self.rpm)]

    @property
    def largest_speed(self) -> float:
        return self.largest_rpm * math.tau / 60.0

    def drive(self, until_us: int, rpm: float) -> None:
        """Command the motor to ``rpm``; its speed approaches this value until the given time."""
        elapsed = until_us * 1e-6 - self.rows[-1][0]
        self.rpm = rpm + (self.rpm - rpm) * math.exp(-elapsed / MOTOR_S)
        self.rows.append((until_us * 1e-6, self.rpm))

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        return PrismMotion(np.array(self.rows)).angle(t_us)


class Edges:
    """True edges of the scene at any time, as the camera would see them without the prism."""

    def __init__(self, simulation: Simulation) -> None:
        placement = place_scene(simulation)
        self._maps = MapRing(simulation, placement)
        self._maps.cover(0, 0)
        view = sight.View()
        view.camera, view.maps = camera_params(CAMERA, "cpu"), self._maps.maps
        view.width, view.height = placement.width, placement.height
        self._view, self._to_texel = view, placement.to_texel()
        self.orientation = simulation.camera_motion.orientation(simulation.duration_s)

    def at(self, seconds: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return rows and columns of edge pixels: crests of the gradient with a change of at least CONTRAST."""
        out = wp.empty(CAMERA.width * CAMERA.height, dtype=float, device="cpu")
        matrix = self._to_texel @ self.orientation(np.array([seconds]))[0]
        launch(
            sight.see_without_prism,
            len(out),
            [self._view, wp.mat33(*matrix.ravel().tolist())],
            [out],
            device="cpu",
        )
        log = out.numpy().reshape(CAMERA.height, CAMERA.width)
        steep = ndimage.maximum_filter(log, 3) - ndimage.minimum_filter(log, 3) >= CONTRAST
        steep[:MARGIN] = steep[-MARGIN:] = steep[:, :MARGIN] = steep[:, -MARGIN:] = False
        gx, gy = (ndimage.gaussian_filter(log, 0.7, order=order) for order in ((0, 1), (1, 0)))
        size = np.hypot(gx, gy)
        rows, columns = np.nonzero(steep)
        along = np.stack([gy[rows, columns], gx[rows, columns]]) / size[rows, columns]
        ahead, behind = (
            ndimage.map_coordinates(size, np.stack([rows, columns]) + s * along, order=1)
            for s in (1.0, -1.0)
        )
        crest = (size[rows, columns] >= ahead) & (size[rows, columns] > behind)
        return rows[crest], columns[crest]

    def seen(
        self, t_us: NDArray[np.int64], points: NDArray[np.float32], start_us: int, end_us: int
    ) -> float:
        """Return the share of the edges at the window's middle that have at least LEAST events within NEAR px."""
        middle = 0.5e-6 * (start_us + end_us)
        grid = np.arange(start_us, end_us, 1000)
        turned = self.orientation(np.array([middle]))[0].T @ self.orientation((grid + 500) * 1e-6)
        c = CAMERA
        pinhole = np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]])
        moves = (pinhole @ turned @ np.linalg.inv(pinhole)).astype(np.float32)
        places = []
        for move, part in zip(
            moves, np.split(points, np.searchsorted(t_us, grid[1:])), strict=True
        ):
            x, y, z = move[:, :2] @ part.T + move[:, 2:]
            column, row = np.rint(2.0 * x / z), np.rint(2.0 * y / z)
            inside = (column >= 0) & (row >= 0) & (column < 2 * c.width) & (row < 2 * c.height)
            places.append(
                row[inside].astype(np.int64) * (2 * c.width) + column[inside].astype(np.int64)
            )
        votes = np.bincount(np.concatenate(places), minlength=4 * c.width * c.height).reshape(
            2 * c.height, -1
        )
        rows, columns = self.at(middle)
        reach = range(-round(2 * NEAR), round(2 * NEAR) + 1)
        disc = [(dy, dx) for dy in reach for dx in reach if math.hypot(dy, dx) <= 2 * NEAR]
        return float(
            np.mean(sum(votes[2 * rows + dy, 2 * columns + dx] for dy, dx in disc) >= LEAST)
        )


def gaze(rates: ArrayLike, t: NDArray[np.float64], circle_s: float = 1.0) -> CameraMotion:
    """Return a camera motion along a closed circle, with speeds [deg/s] at evenly spaced times [s]."""
    turn = math.tau * t / circle_s
    radius = np.radians(np.broadcast_to(rates, t.shape)) * (circle_s / math.tau)
    faced = Rotation.from_rotvec(
        np.column_stack([radius * np.sin(turn), radius * (1.0 - np.cos(turn)), 0.0 * t])
    )
    step = float(t[1] - t[0])
    ways = (faced[:-1].inv() * faced[1:]).as_rotvec() / step
    return CameraMotion(np.column_stack([t[:-1] + 0.5 * step, ways]))


@dataclass(frozen=True)
class Window:
    """Results of one time window of a run."""

    t_s: float
    """Middle of the window [s]."""
    end_s: float
    """End of the window [s]."""
    seconds: float
    """Length of the window [s]."""
    rpm: float
    """Speed of the prism [turns/min]."""
    events: int
    """Number of events in the window."""
    share: float
    """Share of the scene's edges that the window's events make visible."""
    coverage: float
    """Coverage that was estimated from the window's events."""


def run(
    motion: CameraMotion,
    seconds: float,
    rpm: float,
    controller: SpeedController | None = None,
    prism: Prism = PRISM,
) -> Iterator[Window]:
    """Yield the windows of a run that starts at ``rpm``; without a controller, the speed stays constant."""
    largest = rpm if controller is None else max(rpm, controller.most_rpm)
    driven = Driven(rpm, largest)
    scene = Scene.from_picture(earth(), fov=math.radians(100.0))
    made = Simulation(scene, CAMERA, prism, seconds, cast("PrismMotion", driven), motion)
    edges, model, meter = (
        Edges(made),
        ExactModel(CAMERA, prism, PHASE),
        CoverageMeter(CAMERA.width, CAMERA.height),
    )
    step = step_us(made)
    length = WINDOW_US // step * step
    start, target_rpm = 0, rpm
    driven.drive(length, target_rpm)
    for events, points in made.blocks(chunk_us=WINDOW_US):
        end = start + length
        if end > made.duration_us:
            return
        times = np.arange(start - 2000, end + 2001, 1000)
        encoder = Encoder.from_angles(times, driven.angle(times))
        xy = compensate_events(events, model, encoder)
        moved = Events(xy[:, 0], xy[:, 1], events.t, events.p)
        coverage = meter(moved, start, end, prism_path(model, encoder, start, end))
        share = edges.seen(events.t, points, start, end)
        yield Window(
            0.5e-6 * (start + end),
            end * 1e-6,
            length * 1e-6,
            driven.rpm,
            len(events),
            share,
            coverage.share,
        )
        if controller is not None:
            target_rpm = controller.update(start, end, coverage, len(events) / length) or target_rpm
        start = end
        driven.drive(end + length, target_rpm)


Row = dict[str, Any]


def summary(name: str, windows: list[Window], start_s: float, end_s: float) -> Row:
    """Return event rate and shares of a run between two times; windows across a limit count in proportion."""
    chosen = [w for w in windows if start_s < w.t_s <= end_s]
    share = np.array([w.share for w in chosen])
    events = np.interp(
        [start_s, end_s], [w.end_s for w in windows], np.cumsum([w.events for w in windows])
    )
    return {
        "name": name,
        "rpm": float(np.mean([w.rpm for w in chosen])),
        "mev_s": 1e-6 * float(np.diff(events)[0]) / (end_s - start_s),
        "share": float(share.mean()),
        "share_error": float(share.std(ddof=1) / math.sqrt(len(share))),
        "share_p5": float(np.percentile(share, 5.0)),
        "coverage": float(np.mean([w.coverage for w in chosen])),
        "windows": len(share),
    }


def judge(row: Row, usual: Row) -> None:
    """Set the field ``ok`` of a measured row.

    It is true if there are fewer events than at the usual speed, and the same share of visible edges within the error,
    or at least 99 %.
    """
    row["within"] = 2.0 * math.hypot(row["share_error"], usual["share_error"])
    row["fewer_events"] = 1.0 - row["mev_s"] / usual["mev_s"]
    needed = usual["share"] - row["within"] if row["name"] == "adaptive" else 0.99
    row["ok"] = row["share"] >= needed and row["fewer_events"] > 0.0


def print_row(row: Row) -> None:
    fewer = (
        f"  {100 * row['fewer_events']:5.1f} % fewer  {'ok' if row['ok'] else 'NOT ok'}"
        if "ok" in row
        else ""
    )
    print(f"  {row['name']:15} {row['rpm']:5.0f} rpm  {row['mev_s']:6.3f} Mev/s  {100 * row['share']:7.3f} % "
          f"± {100 * row['share_error']:.3f}, 5th {100 * row['share_p5']:7.3f} %{fewer}", flush=True)  # fmt: skip


def one_motion(name: str, prism: Prism, speeds: tuple[float, ...]) -> list[Row]:
    """Return the rows of all fixed speeds and of the controller, for the same circles of the optical axis."""
    rate, circle_s, circles = MOTIONS[name]
    seconds = circle_s * circles
    motion = gaze(rate, np.arange(0.0, ADAPTED_S + seconds + 1.0, 0.005), circle_s)
    rows = []
    for rpm in speeds:
        windows = list(run(motion, SETTLED_S + seconds + SPARE_S, rpm, prism=prism))
        rows.append(summary(f"{rpm:g} rpm", windows, SETTLED_S, SETTLED_S + seconds))
        print_row(rows[-1])
    usual = rows[speeds.index(USUAL)]
    for band_name, band in BANDS.items():
        controller = SpeedController(
            prism_orbit(ExactModel(CAMERA, prism, PHASE)), START_RPM, most_rpm=MOST_RPM, **band
        )
        windows = list(run(motion, ADAPTED_S + seconds + SPARE_S, START_RPM, controller, prism))
        rows.append(summary(band_name, windows, ADAPTED_S, ADAPTED_S + seconds))
        judge(rows[-1], usual)
        print_row(rows[-1])
    return rows


def changing() -> tuple[list[Row], dict[str, Any]]:
    """Run a sequence of camera motions; return the rows, and the values over time."""
    ends = np.cumsum([seconds for _, seconds in CHANGING])
    t = np.arange(0.0, ends[-1] + 1.0, 0.005)
    rates = np.array([MOTIONS[name][0] for name, _ in CHANGING])
    motion = gaze(rates[np.minimum(np.searchsorted(ends, t, side="right"), len(rates) - 1)], t)
    rows, course = [], {}
    for name in (f"{USUAL:g} rpm", *BANDS):
        orbit = prism_orbit(ExactModel(CAMERA, PRISM, PHASE))
        controller = (
            SpeedController(orbit, most_rpm=MOST_RPM, **BANDS[name]) if name in BANDS else None
        )
        windows = list(run(motion, float(ends[-1]) + SPARE_S, USUAL, controller))
        rows.append(summary(name, windows, SETTLED_S, float(ends[-1])))
        if controller is not None:
            judge(rows[-1], rows[0])
        print_row(rows[-1])
        course[name] = {
            "t_s": [round(w.t_s, 4) for w in windows],
            "rpm": [round(w.rpm, 1) for w in windows],
            "mev_s": [round(1e-6 * w.events / w.seconds, 4) for w in windows],
            "share": [round(w.share, 5) for w in windows],
        }
    return rows, course


def draw(path: Path, results: dict[str, Any]) -> None:
    """Draw missed edges against event rate, and speed and event rate over time for changing camera motion."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 5.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 1.15))
    _against(figure.add_subplot(grid[:, 0]), results["motions"])
    upper = figure.add_subplot(grid[0, 1])
    _course(upper, results["course"], "rpm", "speed [turns/min]")
    lower = figure.add_subplot(grid[1, 1], sharex=upper)
    _course(lower, results["course"], "mev_s", "million events/s")
    upper.set_title("the camera's motion changes", fontsize=11)
    upper.tick_params(labelbottom=False)
    upper.legend(loc="lower right", fontsize=9, framealpha=1.0)
    lower.set_xlabel("time [s]")
    save(figure, path, overwrite=True)


COLOURS = {"still": "#0072b2", "slow": "#009e73", "fast": "#d55e00", "very fast": "#cc79a7"}
COURSES = {
    f"{USUAL:g} rpm": ("#777777", "--"),
    "adaptive": ("#000000", "-"),
    "adaptive, 99 %": ("#e69f00", "-"),
}
ALL = 2e-5
"""Share of missed edges at which zero is drawn, because the axis of the figure is logarithmic."""
LABELS = {"still": (-26, 8), "slow": (5, -11), "fast": (10, -9), "very fast": (-9, 10)}
"""Offsets of the speed labels from their points in the figure [pt]."""


def _against(ax: Any, motions: dict[str, list[Row]]) -> None:
    for motion, rows in motions.items():
        fixed = [row for row in rows if row["name"] not in BANDS]
        x = [row["mev_s"] for row in fixed]
        y = [max(1.0 - row["share"], ALL) for row in fixed]
        ax.plot(
            x,
            y,
            "o-",
            color=COLOURS[motion],
            markersize=4,
            linewidth=1.3,
            label=f"{motion}, {MOTIONS[motion][0]:g}°/s",
        )
        for k, (row, a, b) in enumerate(zip(fixed, x, y, strict=True)):
            if any(abs(a - x[j]) < 0.3 and abs(math.log(b / y[j])) < 0.1 for j in range(k)):
                continue  # another label is already there
            ax.annotate(
                f"{row['rpm']:g}",
                (a, b),
                LABELS[motion],
                textcoords="offset points",
                fontsize=8,
                color=COLOURS[motion],
            )
        for name, marker, size in (("adaptive", "*", 17), ("adaptive, 99 %", "D", 8)):
            row = next(row for row in rows if row["name"] == name)
            ax.plot(row["mev_s"], max(1.0 - row["share"], ALL), marker, color=COLOURS[motion], markersize=size,
                    markeredgecolor="black", markeredgewidth=1.0)  # fmt: skip
    for name, marker, size in (
        ("fixed speeds [turns/min]", "o-", 4),
        ("adaptive", "*", 14),
        ("adaptive, 99 %", "D", 7),
    ):
        ax.plot(
            [],
            [],
            marker,
            color="#999999",
            markersize=size,
            markeredgecolor="black" if size > 4 else None,
            label=name,
        )
    ax.set_yscale("log")
    ax.margins(x=0.09)
    ax.set_ylim(0.1, ALL / 1.6)
    ticks = {0.1: "90 %", 0.01: "99 %", 0.001: "99.9 %", 0.0001: "99.99 %", ALL: "all"}
    ax.set_yticks(list(ticks), list(ticks.values()))
    ax.minorticks_off()
    ax.grid(True, color="#dddddd", linewidth=0.6)
    ax.set(xlabel="million events/s", ylabel="edges seen per 33 ms window")
    ax.set_title("edges seen against events", fontsize=11)
    ax.legend(loc="lower right", fontsize=9, framealpha=1.0)


def _course(ax: Any, course: dict[str, Any], what: str, label: str) -> None:
    start, top = 0.0, 1.18 * max(max(run[what]) for run in course.values())
    for motion, seconds in CHANGING:
        ax.axvspan(start, start + seconds, color=COLOURS[motion], alpha=0.1, linewidth=0)
        ax.text(
            start + seconds / 2,
            0.97 * top,
            motion,
            color=COLOURS[motion],
            ha="center",
            va="top",
            fontsize=10,
        )
        start += seconds
    for name, (colour, style) in COURSES.items():
        ax.plot(
            course[name]["t_s"], course[name][what], style, color=colour, linewidth=1.6, label=name
        )
    ax.set(xlim=(0.0, start), ylim=(0.0, top), ylabel=label)


def measure_ms(events: int = 300_000, repeats: int = 50) -> tuple[float, float]:
    """Return the median times to measure a window's coverage and to update the controller [ms].

    The events lie near 20,000 points of a 640 × 480 image, each of which is seen many times.
    """
    rng = np.random.default_rng(0)
    meter, orbit = CoverageMeter(640, 480), prism_orbit(ExactModel(CAMERA, PRISM, PHASE))
    controller = SpeedController(orbit)
    places = rng.uniform(0.0, (640.0, 480.0), (20_000, 2))[rng.integers(0, 20_000, events)]
    xy = (places + rng.normal(0.0, 0.3, places.shape)).astype(np.float32)
    t, none = np.sort(rng.integers(0, WINDOW_US, events)), np.zeros(events, np.uint8)
    x, y = (np.ascontiguousarray(column) for column in xy.T)
    taken = []
    for start in range(0, repeats * WINDOW_US, WINDOW_US):
        window, end = Events(x, y, t + start, none), start + WINDOW_US
        began = time.perf_counter()
        coverage = meter(window, start, end, orbit[:425:25])
        measured = time.perf_counter()
        controller.update(start, end, coverage, 1.0)
        taken.append((1e3 * (measured - began), 1e3 * (time.perf_counter() - measured)))
    coverage_ms, foretold_ms = np.median(taken, axis=0).tolist()
    return coverage_ms, foretold_ms


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="results to write (JSON)")
    parser.add_argument("--figure", type=Path, help="chart to write (PNG)")
    parser.add_argument(
        "--again", type=Path, metavar="FILE.json", help="only draw the results of an earlier run"
    )
    args = parser.parse_args()
    if args.again:
        draw(args.figure, json.loads(args.again.read_text()))
        return 0
    began = time.perf_counter()
    results: dict[str, Any] = {
        "machine": machine("cpu"),
        "versions": versions(["warp-lang", "numpy", "scipy"]),
    }
    results |= {"window_ms": WINDOW_US / 1e3, "measure_ms": measure_ms(), "motions": {}}
    for name, (rate, *_) in MOTIONS.items():
        print(f"{name}, {rate:g} deg/s", flush=True)
        results["motions"][name] = one_motion(name, PRISM, FIXED)
    print("still, half the orbit", flush=True)
    results["small_orbit"] = one_motion("still", SMALL, (360.0, 720.0))
    print("changing", flush=True)
    results["changing"], results["course"] = changing()
    groups = (*results["motions"].values(), results["small_orbit"], results["changing"])
    results["ok"] = all(row.get("ok", True) for rows in groups for row in rows)
    print(f"{'ok' if results['ok'] else 'NOT ok'}, {time.perf_counter() - began:.0f} s; coverage of 300,000 events in "
          f"{results['measure_ms'][0]:.2f} ms, speeds in {results['measure_ms'][1]:.2f} ms", flush=True)  # fmt: skip
    if args.out:
        write_text(args.out, json.dumps(results, indent=1) + "\n", overwrite=True)
    if args.figure:
        draw(args.figure, results)
    return int(not results["ok"])


if __name__ == "__main__":
    sys.exit(main())
