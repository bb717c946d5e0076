"""Chart of a design study: error and event rate over the apex angle, and a table of all apex angles and speeds."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.imaging.palette import MODEL_COLOURS, VERMILION
from amiwarp.optics.models import rungs
from amiwarp.plotting import figures
from amiwarp.studies.design.choice import LEAST_SWING, Choice, Design, degrees, headline

WIDTH, PANEL, LEFT, RIGHT, BETWEEN = 12.0, 3.9, 0.85, 1.15, 2.1
"""Figure width, panel height, left and right margins, and gap between panels, which contains the names of the lines
[inch]."""
TITLE, AXIS, HEAD, CELL, NOTE = 0.85, 0.7, 0.4, 0.55, 0.8
"""Heights of the title above a panel, of the axis below it, of the table's title, of a table row, and of the note
[inch]."""
EDGE, TABLE, FIRST = 0.3, 11.4, 1.05
"""Margin of text and table, width of the table, and width of its first column [inch]."""
LETTERS, SMALL, TINY = 12.0, 10.5, 9.5
"""Font sizes of the chart [point]."""
_APPROXIMATIONS = [name for name, model in rungs().items() if model.SIMPLIFIES]
COLOURS = dict(zip(_APPROXIMATIONS, MODEL_COLOURS, strict=False))
"""Colour of each refraction model. The exact model has no error, so it is not drawn."""
MARKS = dict(zip(_APPROXIMATIONS, "os^vPX", strict=False))
"""Marker of each refraction model."""
SHORT, GOOD, BAD, CHOSEN = "#e3e3e3", "#d3e8f4", "#f3f3f3", VERMILION
"""Colours of apex angles that are too small, of table cells that keep the limits, of cells that violate them, and of
the recommended cell's frame."""
HIGHEST = 0.77
"""Height of the largest value in a panel, as a share of the panel; text stands above it."""
LOWEST_ERROR = 1e-3
"""Smallest error that is drawn [px]; smaller errors are drawn at this value."""


def draw(path: Path, design: Design) -> None:
    """Write the chart as ``path`` with the endings .png and .svg; each write is atomic."""
    figure = chart(design)
    figures.save(figure, path.with_suffix(".png"))
    figures.save_svg(figure, path.with_suffix(".svg"))


def chart(design: Design) -> Any:
    """Return the chart as a Matplotlib figure."""
    rows = len(design.rpms) + 1
    height = TITLE + PANEL + AXIS + HEAD + CELL * rows + NOTE
    figure = figures.blank((WIDTH, height), dpi=150)
    width = (WIDTH - LEFT - RIGHT - BETWEEN) / 2.0
    bottom = height - TITLE - PANEL
    left, right = (
        figure.add_axes((x / WIDTH, bottom / height, width / WIDTH, PANEL / height))
        for x in (LEFT, LEFT + width + BETWEEN)
    )
    _errors(left, design)
    _volume(right, design)
    _table(figure.add_axes((EDGE / WIDTH, NOTE / height, TABLE / WIDTH, CELL * rows / height)), design)
    _words(figure, design, height)
    return figure


def _words(figure: Any, design: Design, height: float) -> None:
    """Write headline and note of the chart."""
    camera, volume = design.camera, design.volume
    fov = 2.0 * math.degrees(math.atan(camera.width / 2.0 / camera.fx))
    figure.text(EDGE / WIDTH, (height - 0.3) / height, f"{camera.width}×{camera.height}, field of view {fov:.0f}°: "
                f"{headline(design)}", fontsize=LETTERS + 1.5, fontweight="bold", va="baseline")  # fmt: skip
    limits, timing = design.limits, design.timing
    note = (
        f"Limits: error {limits.tolerance_px:g} px, window {limits.window_ms:g} ms, edges displaced by "
        f"{LEAST_SWING:g} px in a quarter turn. Clock ± {timing.clock_us:g} µs, encoder "
        f"± {math.degrees(timing.encoder):.3g}°, index {design.glass.index:g}.\n"
        "Models: rms distance of the best fit from the exact model over image and turn; the exact model has no error.\n"
        f"Events: simulated (rings) on {100 * volume.simulated / volume.pixels:.0f} % of the pixels, "
        f"± {100 * volume.uncertainty:.1g} %, threshold {volume.contrast:g}; interpolated between the rings."
    )
    figure.text(EDGE / WIDTH, 0.1 / height, note, fontsize=TINY, color="#404040", va="bottom", linespacing=1.35)


def _errors(ax: Any, design: Design) -> None:
    """Draw the panel of errors over the apex angle."""
    rpm = design.chosen.rpm if design.chosen else design.rpms[len(design.rpms) // 2]
    apex = _degrees(design)
    names = []
    for model, colour in COLOURS.items():
        y = np.array([orbit.errors[model] for orbit in design.orbits])
        ax.plot(apex, np.where(y >= LOWEST_ERROR, y, np.nan), "-", marker=MARKS[model], color=colour, linewidth=1.6,
                markersize=6.0, zorder=3)  # fmt: skip
        if y[-1] >= LOWEST_ERROR:
            names.append((float(y[-1]), f"{model} model", colour))
    choices = [design.at(orbit.apex, rpm) for orbit in design.orbits]
    blur = np.array([c.blur_px for c in choices])
    ax.plot(apex, blur, "-", marker="D", color="black", linewidth=2.2, markersize=5.0, zorder=4)
    ax.plot(apex, [c.budget_px for c in choices], ":", color="black", linewidth=1.4)
    ax.axhline(design.limits.tolerance_px, color=CHOSEN, linestyle=(0, (6, 3)), linewidth=1.5)
    names.append((design.limits.tolerance_px, "tolerance", CHOSEN))
    names += [
        (float(blur[-1]), "blur without\nmodel error", "black"),
        (choices[-1].budget_px, "model budget", "black"),
    ]
    ax.set_title(f"Error after compensation, at {rpm:g} rpm", fontsize=LETTERS, loc="left", pad=8.0)
    ax.set_ylabel("error [px]", fontsize=LETTERS)
    values = [v for v, _, _ in names] + [o.errors[m] for o in design.orbits for m in COLOURS]
    _axes(ax, design, (0.7 * max(min(values), LOWEST_ERROR), max(values)))
    _name(ax, names)


def _volume(ax: Any, design: Design) -> None:
    """Draw the panel of event rates over the apex angle."""
    from matplotlib import colormaps

    apex, rpms, low = _degrees(design), design.rpms, math.inf
    names: list[tuple[float, str, Any]] = []
    for k, rpm in enumerate(rpms):
        # cividis also reads from dark to light in grey; its light end is too faint on white
        colour = colormaps["cividis"](0.72 * k / max(len(rpms) - 1, 1))
        y = np.array([design.at(orbit.apex, rpm).events_per_s for orbit in design.orbits]) / 1e6
        ax.plot(apex, y, "-", marker=".", color=colour, linewidth=1.8, markersize=8.0)
        names.append((float(y[-1]), f"{rpm:g} rpm", colour))
        low = min(low, float(y.min()))
        if rpm in design.volume.rpms:
            at = np.degrees(design.volume.apexes)
            ax.plot(at, np.exp(np.interp(np.log(at), np.log(apex), np.log(y))), "o", color=colour, markersize=9.5,
                    markerfacecolor="none", markeredgewidth=1.3)  # fmt: skip
    high = max(v for v, _, _ in names)
    if design.limits.bandwidth is not None:
        ax.axhline(design.limits.bandwidth / 1e6, color=CHOSEN, linestyle=(0, (6, 3)), linewidth=1.5)
        names.append((design.limits.bandwidth / 1e6, "bandwidth", CHOSEN))
        low, high = min(low, names[-1][0]), max(high, names[-1][0])
    ax.set_title("Event volume", fontsize=LETTERS, loc="left", pad=8.0)
    ax.set_ylabel("million events/s", fontsize=LETTERS)
    _axes(ax, design, (0.6 * low, high))
    _name(ax, names)
    if design.chosen is not None:
        c = design.chosen
        ax.plot([math.degrees(c.orbit.apex)], [c.events_per_s / 1e6], "o", markersize=17, markerfacecolor="none",
                markeredgecolor=CHOSEN, markeredgewidth=2.2, zorder=5)  # fmt: skip


def _axes(ax: Any, design: Design, values: tuple[float, float]) -> None:
    """Set up scales, ticks and shaded ranges of a panel."""
    apex = _degrees(design)
    limits = values[0], values[0] * (values[1] / values[0]) ** (1.0 / HIGHEST)
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
    if smallest > ax.get_xlim()[0]:
        ax.axvspan(ax.get_xlim()[0], min(smallest, ax.get_xlim()[1]), color=SHORT, linewidth=0, zorder=0)
        ax.text(0.02, 0.975, "too small:\nsome edges\nmove < 1 px", transform=ax.transAxes, va="top", fontsize=TINY,
                color="#404040", zorder=6, linespacing=1.25)  # fmt: skip
    if design.chosen is not None:
        ax.axvline(math.degrees(design.chosen.orbit.apex), color=CHOSEN, linewidth=5.0, alpha=0.25, zorder=1)


def _name(ax: Any, names: Sequence[tuple[float, str, Any]]) -> None:
    """Write the name of each line at its right end; names close to each other are moved apart."""
    low, high = (math.log(v) for v in ax.get_ylim())
    inside = sorted((n for n in names if low <= math.log(n[0]) <= high), key=lambda n: n[0])
    at = np.array([(math.log(value) - low) / (high - low) for value, _, _ in inside])
    tall = np.array([1.25 * TINY * (text.count("\n") + 1) / 72.0 / PANEL for _, text, _ in inside])
    need = (tall[1:] + tall[:-1]) / 2.0
    spots = at.copy()
    for _ in range(300):
        for k, gap in enumerate(need):
            lack = gap - (spots[k + 1] - spots[k])
            if lack > 0.0:
                spots[k] -= lack / 2.0
                spots[k + 1] += lack / 2.0
        spots = np.clip(spots, 0.02, 0.98)
    for (_, text, colour), y, spot in zip(inside, at, spots, strict=True):
        ax.annotate(text, (1.0, y), (1.055, spot), xycoords="axes fraction", textcoords="axes fraction",
                    fontsize=TINY, color=colour, va="center", linespacing=1.1, annotation_clip=False,
                    arrowprops={"arrowstyle": "-", "linewidth": 0.7, "color": colour, "shrinkA": 1.0,
                                "shrinkB": 0.0, "relpos": (0.0, 0.5)})  # fmt: skip


def _table(ax: Any, design: Design) -> None:
    """Draw a cell for every choice."""
    from matplotlib.patches import Rectangle

    ax.set(frame_on=False, xticks=(), yticks=())
    ax.set_title("Every choice: events, remaining error, and smallest sufficient model or violated limits",
                 fontsize=LETTERS, loc="left")  # fmt: skip
    choices = [[design.at(orbit.apex, rpm) for orbit in design.orbits] for rpm in design.rpms]
    texts = [[f"{rpm:g} rpm,\n{15e3 / rpm:.1f} ms", *map(_words_of, row)]
             for rpm, row in zip(design.rpms, choices, strict=True)]  # fmt: skip
    heads = [
        f"apex {degrees(o.apex)}, orbit {o.radius:.1f} px\ndisplaces edges {o.swing:.2f} px" for o in design.orbits
    ]
    first, wide, high = FIRST / TABLE, (1.0 - FIRST / TABLE) / len(heads), 1.0 / (len(texts) + 1)
    table = ax.table(texts, colLabels=["speed,\nquarter turn", *heads], cellLoc="center", bbox=(0.0, 0.0, 1.0, 1.0),
                     colWidths=[first, *[wide] * len(heads)])  # fmt: skip
    table.set_fontsize(TINY)
    table.auto_set_font_size(True)
    for (j, k), cell in table.get_celld().items():
        cell.PAD = 0.03
        cell.set(edgecolor="white", linewidth=4.0)
        if j and k:
            choice = choices[j - 1][k - 1]
            cell.set_facecolor(BAD if choice.misses else GOOD)
            cell.get_text().set(color="#6a6a6a" if choice.misses else "black")
            if choice is design.chosen:
                cell.get_text().set(fontweight="bold")
                corner = (first + (k - 1) * wide, 1.0 - (j + 1) * high)
                ax.add_patch(Rectangle(corner, wide, high, fill=False, edgecolor=CHOSEN, linewidth=2.4,
                                       transform=ax.transAxes, clip_on=False))  # fmt: skip


def _words_of(choice: Choice) -> str:
    """Return the text of a cell of the table."""
    words = f"violates {', '.join(choice.misses)}" if choice.misses else choice.model
    return f"{choice.events_per_s / 1e6:.3g} Mev/s, {choice.error_px:.2f} px\n{words}"


def _degrees(design: Design) -> list[float]:
    """Return the apex angles of a design [deg]."""
    return [math.degrees(orbit.apex) for orbit in design.orbits]
