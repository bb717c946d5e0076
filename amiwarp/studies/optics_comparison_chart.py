"""Chart of a comparison of moving optics: path of each optic, and a table."""

import math
from collections.abc import Callable
from textwrap import fill
from typing import Any

import numpy as np

from amiwarp.imaging.palette import BLACK
from amiwarp.plotting import figures
from amiwarp.studies.design_chart import BAD, CHOSEN, EDGE, GOOD, LETTERS, TABLE, TINY, WIDTH
from amiwarp.studies.edge_coverage import PATH_ANGLES
from amiwarp.studies.optics_comparison import Compared, Comparison
from amiwarp.studies.orbits import LEAST_SWING
from amiwarp.studies.quantities import rate

# Lengths are in inches.
LABEL = 1.15
"""Width of the column of labels."""
PATHS = 1.15
"""Height of the drawn paths."""
ROW = 0.42
"""Height of a row of the table."""
TOP = 0.5
"""Height of the headline."""
LINE = 0.19
"""Height of a line of text."""
REACH = 1.75
"""Half height of the panel of a drawn path, in radii of the motion."""
LETTERS_OF_CELL = 13
"""Largest number of letters on a line of a cell of words."""


def chart(comparison: Comparison) -> Any:
    """Return the chart as a Matplotlib figure: path of each optic, a table, and the recommendations."""
    rows = _rows(comparison)
    results = comparison.results
    notes = _notes(comparison)
    below = LINE * len(notes) + 0.2
    height = TOP + PATHS + ROW * (len(rows) + 1) + below
    figure = figures.blank((WIDTH, height), dpi=150)
    camera = comparison.design.camera
    fov = 2.0 * math.degrees(math.atan(camera.width / 2.0 / camera.fx))
    figure.text(
        EDGE / WIDTH,
        1.0 - 0.3 / height,
        f"{camera.width}×{camera.height}, field of view {fov:.0f}°: optics "
        f"that move the image by {comparison.reference.orbit.radius:.2f} px rms",
        fontsize=LETTERS + 1.5,
        fontweight="bold",
        va="baseline",
    )

    width = (TABLE - LABEL) / len(results)
    bottom = 1.0 - (TOP + PATHS) / height
    for column, result in enumerate(results):
        left = EDGE + LABEL + column * width
        ax = figure.add_axes((left / WIDTH, bottom, width / WIDTH, PATHS / height))
        _draw_path(ax, result, comparison)
    table_height = ROW * (len(rows) + 1)
    table = figure.add_axes((EDGE / WIDTH, below / height, TABLE / WIDTH, table_height / height))
    _draw_table(table, comparison, rows)

    # The first note holds the recommendations.
    for number, text in enumerate(notes):
        figure.text(
            EDGE / WIDTH,
            (below - 0.25 - number * LINE) / height,
            text,
            fontsize=TINY,
            va="baseline",
            fontweight="bold" if number == 0 else "normal",
            color=BLACK if number == 0 else "#404040",
        )
    return figure


def _rows(comparison: Comparison) -> list[tuple[str, str, list[str]]]:
    """Return the rows of the chart's table: task that the row decides or "", label, and a text for each optic."""

    def complete(r: Compared) -> str:
        if math.isfinite(r.complete_ms):
            return f"{r.complete_ms:.1f} ms"
        return f"never: {100 * r.coverage.left_out:.0f} %\nof directions"

    def needs(which: int) -> Callable[[Compared], str]:
        return lambda r: fill(r.setting.NEEDS[r.setting.kind][which], LETTERS_OF_CELL)

    def events_for_all(r: Compared) -> str:
        return rate(r.events_per_s_px) if math.isfinite(r.events_per_s_px) else "impossible"

    def depth(r: Compared) -> str:
        if r.depth_deviation is None:
            return "not\ndetermined"
        return f"± {100 * r.depth_deviation:.2g} %"

    rows: list[tuple[str, str, Callable[[Compared], str]]] = [
        ("", "size", lambda r: r.setting.size),
        ("", "turns / s", lambda r: f"{r.setting.hz:.3g}"),
        ("", "motion, rms\nand smallest", lambda r: f"{r.radius:.2f} px\n{r.smallest:.2f} px"),
        (
            "directions",
            f"edges move in\n{comparison.design.limits.window_ms:g} ms by",
            lambda r: f"{r.coverage.swing:.2f} px",
        ),
        ("", f"all move by\n{LEAST_SWING:g} px in", complete),
        (
            "blur",
            "blur, and\nwithout pixels",
            lambda r: f"{r.blur_px:.3f} px\n{math.hypot(r.clock_px, r.encoder_px):.3f} px",
        ),
        ("", "events", lambda r: rate(r.events_per_s)),
        ("", "simulated", lambda r: f"{rate(r.simulated_per_s)}\n± {100 * r.uncertainty:.1g} %"),
        ("events", "events, if all\nmove by 1 px", events_for_all),
        ("depth", "depth", depth),
        ("", "glass", needs(0)),
        ("", "drive", needs(1)),
        ("", "state from", needs(2)),
        ("", "violates", lambda r: ",\n".join(r.misses) or "none"),
    ]
    return [(task, name, [text(r) for r in comparison.results]) for task, name, text in rows]


def _notes(comparison: Comparison) -> list[str]:
    """Return the lines below the table: recommendations, then how to read it."""
    design = comparison.design
    recommended = []
    for advice in comparison.advice:
        name = "none" if advice.chosen is None else advice.chosen.setting.name
        recommended.append(f"{advice.task}: {name}")
    failures = []
    if comparison.failed:
        failures = [f"Failed, and left out: {'; '.join(comparison.failed)}."]
    return [
        f"Recommended for {';  '.join(recommended)}",
        *failures,
        f"Paths: middle of the image; thick: {design.limits.window_ms:g} ms. Blur: across an edge; clock "
        f"± {design.timing.clock_us:g} µs, angles ± {math.degrees(design.timing.encoder):.3g}°. Events: law of the "
        f"event volume, threshold {design.volume.contrast:g}.",
        "Depth: standard deviation by one turn and one pixel of an edge. Blue: keeps the limits. Framed: recommended.",
    ]


def _draw_path(ax: Any, result: Compared, comparison: Comparison) -> None:
    """Draw the path of the middle of the image, and thicker the part that it takes within the window."""
    reach = REACH * comparison.reference.orbit.radius
    closed = np.concatenate([result.path, result.path[:1]])
    count = 2 + int(1e-3 * comparison.design.limits.window_ms * result.setting.hz * PATH_ANGLES)
    ax.plot(*closed.T, color="#9a9a9a", linewidth=1.2)
    ax.plot(*closed[:count].T, color=CHOSEN, linewidth=3.0, solid_capstyle="butt")
    ax.set(
        xlim=(-reach, reach),
        ylim=(reach, -reach),
        aspect="equal",
        frame_on=False,
        xticks=(),
        yticks=(),
    )


def _draw_table(ax: Any, comparison: Comparison, rows: list[tuple[str, str, list[str]]]) -> None:
    """Draw a column for every optic."""
    from matplotlib.patches import Rectangle

    results = comparison.results
    ax.set(frame_on=False, xticks=(), yticks=(), xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    heads = [result.setting.name.replace(", ", ",\n") for result in results]
    first = LABEL / TABLE
    high = 1.0 / (len(rows) + 1)
    wide = (1.0 - first) / len(results)
    table = ax.table(
        [[name, *texts] for _, name, texts in rows],
        colLabels=["", *heads],
        cellLoc="center",
        bbox=(0.0, 0.0, 1.0, 1.0),
        colWidths=[first, *[wide] * len(results)],
    )
    table.auto_set_font_size(False)
    table.set_fontsize(TINY - 0.5)
    for (row, column), cell in table.get_celld().items():
        cell.PAD = 0.02
        cell.set(edgecolor="white", linewidth=3.0, facecolor="white")
        if row and column >= 1:
            cell.set_facecolor(BAD if results[column - 1].misses else GOOD)
    decided = [task for task, _, _ in rows]
    for advice in comparison.advice:
        if advice.chosen is not None:
            column = results.index(advice.chosen)
            row = decided.index(advice.task) + 1
            corner = (first + column * wide, 1.0 - (row + 1) * high)
            ax.add_patch(
                Rectangle(
                    corner,
                    wide,
                    high,
                    fill=False,
                    edgecolor=CHOSEN,
                    linewidth=2.4,
                    zorder=5,
                    transform=ax.transAxes,
                    clip_on=False,
                )
            )
