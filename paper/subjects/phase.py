"""Pictures from sums in phase, compared with the solver."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from paper.drawing import COLOURS, new_figure
from paper.sources import Row, Table, Values, fixed, one, results, significant

METHODS = ("phase", "solver")
NAMES = {"phase": "sums in phase", "solver": "solver"}
APEXES = (0.5, 1.0, 2.0)


def rows(axis: str) -> list[Row]:
    """Return the recordings of one axis of the comparison."""
    return [row for row in results("phase_cpu.json")["rows"] if row["axis"] == axis]


def median_of(found: list[Row], method: str, field: str) -> float:
    """Return the median of a result of a method."""
    values = sorted(row[method][field] for row in found)
    middle = len(values) // 2
    return float(values[middle] if len(values) % 2 else 0.5 * (values[middle - 1] + values[middle]))


def stage_ms(stage: str, how: str = "graph") -> str:
    """Return the time of a stage on the GPU [ms]."""
    stages = results("phase_cuda.json")["stages"]
    return fixed(one(stages, stage=stage, how=how)["ms"], 2)


def turning(camera_deg_s: float) -> list[Row]:
    """Return the recordings of a camera that turns at a speed."""
    return [row for row in rows("camera_deg_s") if row["camera_deg_s"] == camera_deg_s]


def flickering() -> list[Row]:
    """Return the recordings with the deepest flicker."""
    found = rows("lamp_depth")
    deepest = max(row["lamp_depth"] for row in found)
    return [row for row in found if row["lamp_depth"] == deepest]


def speed_range(method: str) -> tuple[str, str]:
    """Return the least and the largest time of a method at full size on two cores [ms]."""
    times = [1e3 * row[method]["duration_s"] for row in rows("speed")]
    return significant(min(times)), significant(max(times))


def values() -> Values:
    """Return the values of the subject."""
    table = rows("table")
    found = results("phase_cuda.json")
    brick = one(rows("speed"), picture="brick.png")
    ratios = [row["solver"]["processor_s"] / row["phase"]["processor_s"] for row in table]
    return {
        "phase.pictures": str(len({row["picture"] for row in table})),
        "phase.recordings": str(len(table)),
        "phase.detail": fixed(median_of(table, "phase", "detail"), 3),
        "phase.detail_solver": fixed(median_of(table, "solver", "detail"), 3),
        "phase.whole": fixed(median_of(table, "phase", "whole"), 3),
        "phase.whole_solver": fixed(median_of(table, "solver", "whole"), 3),
        "phase.faster_least": significant(min(ratios)),
        "phase.faster_most": significant(max(ratios)),
        "phase.cpu_ms_least": speed_range("phase")[0],
        "phase.cpu_ms_most": speed_range("phase")[1],
        "phase.solver_ms_least": speed_range("solver")[0],
        "phase.solver_ms_most": speed_range("solver")[1],
        "phase.brick_whole": fixed(brick["phase"]["whole"], 2),
        "phase.brick_solver": fixed(brick["solver"]["whole"], 2),
        "phase.brick_detail": fixed(brick["phase"]["detail"], 3),
        "phase.turning_detail": fixed(median_of(turning(30.0), "phase", "detail"), 2),
        "phase.turning_solver": fixed(median_of(turning(30.0), "solver", "detail"), 2),
        "phase.turning_speed": f"{max(row['camera_deg_s'] for row in rows('camera_deg_s')):g}",
        "phase.lamp_whole": fixed(median_of(flickering(), "phase", "whole"), 2),
        "phase.lamp_solver": fixed(median_of(flickering(), "solver", "whole"), 2),
        "phase.cuda_events": significant(1e-6 * found["result"]["events"]),
        "phase.cuda_sums_ms": stage_ms("sums", "launches"),
        "phase.cuda_detail_ms": stage_ms("events to detail"),
        "phase.cuda_picture_ms": stage_ms("events to picture"),
        "phase.cuda_window_ms": stage_ms("window", "call"),
        "phase.cuda_per_s": fixed(found["stream"]["pictures_per_s"], 0),
        "phase.cuda_detail": fixed(found["result"]["detail"], 3),
        "phase.cuda_whole": fixed(found["result"]["whole"], 3),
        "phase.cuda_difference": significant(found["result"]["largest_difference"], 1),
    }


def tables() -> dict[str, Table]:
    """Return the tables of the subject."""
    columns = [
        "apex",
        "noise",
        "detail, phase",
        "solver",
        "whole, phase",
        "solver",
        "time, phase [ms]",
        "solver",
    ]
    lines = []
    for apex in APEXES:
        for noise in sorted({row["noise"] for row in rows("table")}):
            found = [
                row for row in rows("table") if (row["apex_deg"], row["noise"]) == (apex, noise)
            ]
            line = [f"{apex:g}°", f"{100 * noise:g} %"]
            for field in ("detail", "whole"):
                line += [fixed(median_of(found, method, field), 3) for method in METHODS]
            line += [fixed(1e3 * median_of(found, method, "processor_s"), 0) for method in METHODS]
            lines.append(line)
    return {"phase": Table(columns, lines)}  # fmt: skip


def draw_axis(panel: Any, axis: str, label: str) -> None:
    """Draw the median detail of both methods over one condition."""
    places = sorted({row[axis] for row in rows(axis)})
    for method, colour in zip(METHODS, COLOURS, strict=False):
        found = [[row for row in rows(axis) if row[axis] == place] for place in places]
        details = [median_of(some, method, "detail") for some in found]
        panel.plot(places, details, marker="o", color=colour, label=NAMES[method])
    panel.set_xlabel(label)


def draw_phase() -> Figure:
    """Draw the detail over conditions of the recording."""
    figure, axes = new_figure(4, 1.9)
    draw_axis(axes[0], "threshold", "threshold")
    draw_axis(axes[1], "refractory_us", "refractory period [µs]")
    draw_axis(axes[2], "camera_deg_s", "camera turns [°/s]")
    draw_axis(axes[3], "lamp_depth", "depth of flicker")
    for panel in axes:
        panel.set_ylim(0.6, 1.01)
    axes[0].set_ylabel("detail, correlation")
    axes[0].legend(loc="lower left")
    return figure


def figures() -> dict[str, Figure]:
    """Return the figures of the subject."""
    return {"phase": draw_phase()}
