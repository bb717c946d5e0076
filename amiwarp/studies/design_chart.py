"""Chart of a design study: error and event rate over the apex angle, and a table of all apex angles and speeds."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from amiwarp.imaging.palette import MODEL_COLOURS, VERMILION
from amiwarp.optics.models.registry import rungs
from amiwarp.plotting import figures
from amiwarp.studies.design import Choice, Design
from amiwarp.studies.design_words import headline
from amiwarp.studies.orbits import LEAST_SWING
from amiwarp.studies.quantities import degrees, quarter_turn_ms

# Lengths are in inches, and font sizes in points.
WIDTH = 12.0
"""Width of the figure."""
PANEL = 3.9
"""Height of a panel."""
LEFT = 0.85
"""Left margin of the panels."""
RIGHT = 1.15
"""Right margin of the panels."""
BETWEEN = 2.1
"""Gap between the panels, which contains the names of the lines."""
TITLE = 0.85
"""Height of the title above a panel."""
AXIS = 0.7
"""Height of the axis below a panel."""
HEAD = 0.4
"""Height of the table's title."""
CELL = 0.55
"""Height of a table row."""
NOTE = 0.8
"""Height of the note."""
EDGE = 0.3
"""Margin of text and table."""
TABLE = 11.4
"""Width of the table."""
FIRST = 1.05
"""Width of the table's first column."""
LETTERS = 12.0
SMALL = 10.5
TINY = 9.5
"""Font sizes of the chart."""


_APPROXIMATIONS = [name for name, model in rungs().items() if model.SIMPLIFIES]


COLOURS = dict(zip(_APPROXIMATIONS, MODEL_COLOURS, strict=False))
"""Colour of each refraction model. The exact model has no error, so it is not drawn."""
MARKS = dict(zip(_APPROXIMATIONS, "os^vPX", strict=False))
"""Marker of each refraction model."""
SHORT = "#e3e3e3"
"""Colour of apex angles that are too small."""
GOOD = "#d3e8f4"
"""Colour of table cells that keep the limits."""
BAD = "#f3f3f3"
"""Colour of table cells that violate a limit."""
CHOSEN = VERMILION
"""Colour of the recommended cell's frame, and of limits."""
HIGHEST = 0.77
"""Height of the largest value in a panel, as a share of the panel; text stands above it."""
LOWEST_ERROR = 1e-3
"""Smallest error that is drawn [px]; smaller errors are drawn at this value."""


def chart(design: Design) -> Any:
    """Return the chart as a Matplotlib figure."""
    rows = len(design.rpms) + 1
    height = TITLE + PANEL + AXIS + HEAD + CELL * rows + NOTE
    figure = figures.blank((WIDTH, height), dpi=150)
    width = (WIDTH - LEFT - RIGHT - BETWEEN) / 2.0
    bottom = height - TITLE - PANEL

    def axes(left: float, lower: float, wide: float, high: float) -> Any:
        return figure.add_axes((left / WIDTH, lower / height, wide / WIDTH, high / height))

    _errors(axes(LEFT, bottom, width, PANEL), design)
    _volume(axes(LEFT + width + BETWEEN, bottom, width, PANEL), design)
    _table(axes(EDGE, NOTE, TABLE, CELL * rows), design)
    _words(figure, design, height)
    return figure


def _words(figure: Any, design: Design, height: float) -> None:
    """Write headline and note of the chart."""
    camera = design.camera
    volume = design.volume
    fov = 2.0 * math.degrees(math.atan(camera.width / 2.0 / camera.fx))
    figure.text(
        EDGE / WIDTH,
        (height - 0.3) / height,
        f"{camera.width}×{camera.height}, field of view {fov:.0f}°: {headline(design)}",
        fontsize=LETTERS + 1.5,
        fontweight="bold",
        va="baseline",
    )
    limits = design.limits
    timing = design.timing
    note = (
        f"Limits: error {limits.tolerance_px:g} px, window {limits.window_ms:g} ms, edges displaced by "
        f"{LEAST_SWING:g} px in a quarter turn. Clock ± {timing.clock_us:g} µs, encoder "
        f"± {math.degrees(timing.encoder):.3g}°, index {design.glass.index:g}.\n"
        "Models: rms distance of the best fit from the exact model over image and turn; the exact model has no error.\n"
        f"Events: simulated (rings) on {100 * volume.simulated / volume.pixels:.0f} % of the pixels, "
        f"± {100 * volume.uncertainty:.1g} %, threshold {volume.contrast:g}; interpolated between the rings."
    )
    if design.failed:
        note += f" Failed, and left out: {', '.join(design.failed)}."
    figure.text(
        EDGE / WIDTH,
        0.1 / height,
        note,
        fontsize=TINY,
        color="#404040",
        va="bottom",
        linespacing=1.35,
    )


def _errors(ax: Any, design: Design) -> None:
    """Draw the panel of errors over the apex angle."""
    rpm = design.chosen.rpm if design.chosen else design.rpms[len(design.rpms) // 2]
    apex = _degrees(design)
    names = []
    for model, colour in COLOURS.items():
        errors = np.array([orbit.errors[model] for orbit in design.orbits])
        ax.plot(
            apex,
            np.where(errors >= LOWEST_ERROR, errors, np.nan),
            "-",
            marker=MARKS[model],
            color=colour,
            linewidth=1.6,
            markersize=6.0,
            zorder=3,
        )
        if errors[-1] >= LOWEST_ERROR:
            names.append((float(errors[-1]), f"{model} model", colour))

    choices = [design.at(orbit.apex, rpm) for orbit in design.orbits]
    blur = np.array([choice.blur_px for choice in choices])
    budget = [choice.budget_px for choice in choices]
    ax.plot(apex, blur, "-", marker="D", color="black", linewidth=2.2, markersize=5.0, zorder=4)
    ax.plot(apex, budget, ":", color="black", linewidth=1.4)
    ax.axhline(design.limits.tolerance_px, color=CHOSEN, linestyle=(0, (6, 3)), linewidth=1.5)
    names.append((design.limits.tolerance_px, "tolerance", CHOSEN))
    names += [
        (float(blur[-1]), "blur without\nmodel error", "black"),
        (budget[-1], "model budget", "black"),
    ]

    ax.set_title(f"Error after compensation, at {rpm:g} rpm", fontsize=LETTERS, loc="left", pad=8.0)
    ax.set_ylabel("error [px]", fontsize=LETTERS)
    values = [value for value, _, _ in names]
    for orbit in design.orbits:
        values += [orbit.errors[model] for model in COLOURS]
    _axes(ax, design, (0.7 * max(min(values), LOWEST_ERROR), max(values)))
    _name(ax, names)


def _volume(ax: Any, design: Design) -> None:
    """Draw the panel of event rates over the apex angle."""
    from matplotlib import colormaps

    apex = _degrees(design)
    rpms = design.rpms
    low = math.inf
    names: list[tuple[float, str, Any]] = []
    for number, rpm in enumerate(rpms):
        # Cividis also reads from dark to light in grey; its light end is too faint on white.
        colour = colormaps["cividis"](0.72 * number / max(len(rpms) - 1, 1))
        rates = np.array([design.at(orbit.apex, rpm).events_per_s for orbit in design.orbits]) / 1e6
        ax.plot(apex, rates, "-", marker=".", color=colour, linewidth=1.8, markersize=8.0)
        names.append((float(rates[-1]), f"{rpm:g} rpm", colour))
        low = min(low, float(rates.min()))
        if rpm in design.volume.rpms:
            # Rings at the apex angles that were simulated
            simulated = np.degrees(design.volume.apexes)
            ax.plot(
                simulated,
                np.exp(np.interp(np.log(simulated), np.log(apex), np.log(rates))),
                "o",
                color=colour,
                markersize=9.5,
                markerfacecolor="none",
                markeredgewidth=1.3,
            )
    high = max(value for value, _, _ in names)
    if design.limits.bandwidth is not None:
        limit = design.limits.bandwidth / 1e6
        ax.axhline(limit, color=CHOSEN, linestyle=(0, (6, 3)), linewidth=1.5)
        names.append((limit, "bandwidth", CHOSEN))
        low = min(low, limit)
        high = max(high, limit)
    ax.set_title("Event volume", fontsize=LETTERS, loc="left", pad=8.0)
    ax.set_ylabel("million events/s", fontsize=LETTERS)
    _axes(ax, design, (0.6 * low, high))
    _name(ax, names)
    chosen = design.chosen
    if chosen is not None:
        ax.plot(
            [math.degrees(chosen.orbit.apex)],
            [chosen.events_per_s / 1e6],
            "o",
            markersize=17,
            markerfacecolor="none",
            markeredgecolor=CHOSEN,
            markeredgewidth=2.2,
            zorder=5,
        )


def _axes(ax: Any, design: Design, values: tuple[float, float]) -> None:
    """Set up scales, ticks and shaded ranges of a panel. ``values``: smallest and largest value that is drawn."""
    apex = _degrees(design)
    low, high = values
    limits = low, low * (high / low) ** (1.0 / HIGHEST)
    spare = 1.18 if len(apex) > 1 else 1.6
    ax.set(xscale="log", yscale="log", xlim=(apex[0] / spare, apex[-1] * spare), ylim=limits)
    ax.set_xticks(apex, [degrees(orbit.apex) for orbit in design.orbits])
    ax.set_xticks([], minor=True)
    figures.number_logarithmic(ax.yaxis)
    ax.tick_params(which="both", labelsize=SMALL)
    ax.grid(True, color="#e6e6e6", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.set_xlabel("apex", fontsize=LETTERS)
    smallest = math.degrees(design.range_at(design.rpms[0])[0])
    left, right = ax.get_xlim()
    if smallest > left:
        ax.axvspan(left, min(smallest, right), color=SHORT, linewidth=0, zorder=0)
        ax.text(
            0.02,
            0.975,
            "too small:\nsome edges\nmove < 1 px",
            transform=ax.transAxes,
            va="top",
            fontsize=TINY,
            color="#404040",
            zorder=6,
            linespacing=1.25,
        )
    if design.chosen is not None:
        ax.axvline(
            math.degrees(design.chosen.orbit.apex),
            color=CHOSEN,
            linewidth=5.0,
            alpha=0.25,
            zorder=1,
        )


def _name(ax: Any, names: Sequence[tuple[float, str, Any]]) -> None:
    """Write the name of each line at its right end; names close to each other are moved apart."""
    low, high = (math.log(value) for value in ax.get_ylim())
    inside = [name for name in names if low <= math.log(name[0]) <= high]
    inside.sort(key=lambda name: name[0])

    # Heights in the panel, and heights of the texts, as shares of the panel
    places = np.array([(math.log(value) - low) / (high - low) for value, _, _ in inside])
    lines = [text.count("\n") + 1 for _, text, _ in inside]
    tall = np.array([1.25 * TINY * count / 72.0 / PANEL for count in lines])
    need = (tall[1:] + tall[:-1]) / 2.0

    spots = places.copy()
    for _ in range(300):
        for k, gap in enumerate(need):
            lack = gap - (spots[k + 1] - spots[k])
            if lack > 0.0:
                spots[k] -= lack / 2.0
                spots[k + 1] += lack / 2.0
        spots = np.clip(spots, 0.02, 0.98)
    for (_, text, colour), y, spot in zip(inside, places, spots, strict=True):
        ax.annotate(
            text,
            (1.0, y),
            (1.055, spot),
            xycoords="axes fraction",
            textcoords="axes fraction",
            fontsize=TINY,
            color=colour,
            va="center",
            linespacing=1.1,
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "linewidth": 0.7,
                "color": colour,
                "shrinkA": 1.0,
                "shrinkB": 0.0,
                "relpos": (0.0, 0.5),
            },
        )


def _table(ax: Any, design: Design) -> None:
    """Draw a cell for every choice."""
    from matplotlib.patches import Rectangle

    ax.set(frame_on=False, xticks=(), yticks=())
    ax.set_title(
        "Every choice: events, remaining error, and smallest sufficient model or violated limits",
        fontsize=LETTERS,
        loc="left",
    )
    choices = [[design.at(orbit.apex, rpm) for orbit in design.orbits] for rpm in design.rpms]
    texts = []
    for rpm, row in zip(design.rpms, choices, strict=True):
        label = f"{rpm:g} rpm,\n{quarter_turn_ms(rpm):.1f} ms"
        texts.append([label, *map(_words_of, row)])
    heads = []
    for orbit in design.orbits:
        size = f"apex {degrees(orbit.apex)}, orbit {orbit.radius:.1f} px"
        heads.append(f"{size}\ndisplaces edges {orbit.swing:.2f} px")
    first = FIRST / TABLE
    wide = (1.0 - FIRST / TABLE) / len(heads)
    high = 1.0 / (len(texts) + 1)
    table = ax.table(
        texts,
        colLabels=["speed,\nquarter turn", *heads],
        cellLoc="center",
        bbox=(0.0, 0.0, 1.0, 1.0),
        colWidths=[first, *[wide] * len(heads)],
    )
    table.set_fontsize(TINY)
    table.auto_set_font_size(True)
    for (row_number, column), cell in table.get_celld().items():
        cell.PAD = 0.03
        cell.set(edgecolor="white", linewidth=4.0)
        # Row and column 0 are the headings.
        if row_number and column:
            choice = choices[row_number - 1][column - 1]
            cell.set_facecolor(BAD if choice.misses else GOOD)
            cell.get_text().set(color="#6a6a6a" if choice.misses else "black")
            if choice is design.chosen:
                cell.get_text().set(fontweight="bold")
                corner = (first + (column - 1) * wide, 1.0 - (row_number + 1) * high)
                ax.add_patch(
                    Rectangle(
                        corner,
                        wide,
                        high,
                        fill=False,
                        edgecolor=CHOSEN,
                        linewidth=2.4,
                        transform=ax.transAxes,
                        clip_on=False,
                    )
                )


def _words_of(choice: Choice) -> str:
    """Return the text of a cell of the table."""
    words = f"violates {', '.join(choice.misses)}" if choice.misses else choice.model
    return f"{choice.events_per_s / 1e6:.3g} Mev/s, {choice.error_px:.2f} px\n{words}"


def _degrees(design: Design) -> list[float]:
    """Return the apex angles of a design [deg]."""
    return [math.degrees(orbit.apex) for orbit in design.orbits]
