"""Chart of a design study: error and event rate over the apex angle, and a table of all apex angles and speeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.imaging.palette import MODEL_COLOURS, VERMILION
from amiwarp.optics.models import rungs
from amiwarp.plotting import figures
from amiwarp.studies.design.choice import LEAST_SWING, degrees, headline

if TYPE_CHECKING:
    from amiwarp.studies.design.choice import Choice, Design

WIDTH, PANEL, LEFT, RIGHT, BETWEEN = 12.0, 3.9, 0.85, 1.15, 2.1
"""Figure width, panel height, left and right margins, and gap between panels, which contains the names of the lines
[inch]."""
TITLE, AXIS, HEAD, CELL, NOTE = 0.85, 0.7, 0.95, 0.55, 0.8
"""Heights of the title above a panel, of the axis below it, of the table head, of a table row, and of the note [inch].
"""
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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = len(design.rpms)
    height = TITLE + PANEL + AXIS + HEAD + CELL * rows + NOTE
    figure = Figure(figsize=(WIDTH, height), dpi=150)
    FigureCanvasAgg(figure)
    width = (WIDTH - LEFT - RIGHT - BETWEEN) / 2.0
    bottom = height - TITLE - PANEL
    left, right = (
        figure.add_axes((x / WIDTH, bottom / height, width / WIDTH, PANEL / height))
        for x in (LEFT, LEFT + width + BETWEEN)
    )
    _errors(left, design)
    _volume(right, design)
    top = (bottom - AXIS) / height
    deep = (HEAD + CELL * rows) / height
    _table(figure.add_axes((EDGE / WIDTH, top - deep, TABLE / WIDTH, deep)), design)
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
    shown = _numbers(limits)
    ax.set_yticks(shown, [f"{value:g}" for value in shown])
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_formatter(lambda value, _: "")
    ax.tick_params(axis="x", which="minor", length=0)
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


def _numbers(limits: tuple[float, float]) -> list[float]:
    """Return the tick values of a logarithmic axis: 1, 2 and 5 of each decade, or only 1 if there are many decades."""
    low, high = limits
    digits = (1.0, 2.0, 5.0) if high / low < 100.0 else (1.0,)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [value for k in decades for digit in digits if low <= (value := float(f"{digit}e{k}")) <= high]


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
    """Draw a cell for every choice; the axes are in inches, downwards from the top left corner."""
    orbits, rpms = design.orbits, design.rpms
    ax.set(xlim=(0.0, TABLE), ylim=(-HEAD - CELL * len(rpms), 0.0))
    ax.axis("off")
    wide = (TABLE - FIRST) / len(orbits)
    heads = [f"apex {degrees(o.apex)}, orbit {o.radius:.1f} px\ndisplaces edges {o.swing:.2f} px" for o in orbits]
    size = _fitting(TINY, wide, heads)
    title = "Every choice: events, remaining error, and smallest sufficient model or violated limits"
    ax.text(0.0, -0.2, title, fontsize=LETTERS, va="baseline")
    ax.text(0.0, -HEAD + 0.1, "speed,\nquarter turn", va="bottom", fontsize=size, linespacing=1.3)
    for k, text in enumerate(heads):
        ax.text(FIRST + (k + 0.5) * wide, -HEAD + 0.1, text, ha="center", va="bottom", fontsize=size, linespacing=1.3)
    for j, rpm in enumerate(rpms):
        y = -HEAD - CELL * j
        ax.text(0.0, y - CELL / 2.0, f"{rpm:g} rpm,\n{15e3 / rpm:.1f} ms", va="center", fontsize=size, linespacing=1.3)
        for k, orbit in enumerate(orbits):
            choice = design.at(orbit.apex, rpm)
            _cell(ax, choice, (FIRST + k * wide, y, wide), size, chosen=choice is design.chosen)


def _cell(ax: Any, choice: Choice, at: tuple[float, float, float], size: float, *, chosen: bool) -> None:
    """Draw the table cell of one combination of apex angle and speed."""
    from matplotlib.patches import Rectangle

    x, y, wide = at
    good = not choice.misses
    box = Rectangle((x + 0.03, y - CELL + 0.03), wide - 0.06, CELL - 0.06, facecolor=GOOD if good else BAD,
                    edgecolor=CHOSEN if chosen else "none", linewidth=2.4)  # fmt: skip
    ax.add_patch(box)
    words = choice.model if good else f"violates {', '.join(choice.misses)}"
    text = f"{choice.events_per_s / 1e6:.3g} Mev/s, {choice.error_px:.2f} px\n{words}"
    size = _fitting(size, wide, [text])
    ax.text(x + wide / 2.0, y - CELL / 2.0, text, ha="center", va="center", fontsize=size, linespacing=1.3,
            color="black" if good else "#6a6a6a", fontweight="bold" if chosen else "normal")  # fmt: skip


def _fitting(size: float, wide: float, texts: Sequence[str]) -> float:
    """Return the largest font size [point], at most ``size``, at which all lines fit into ``wide`` [inch]."""
    return min(size, 72.0 * (wide - 0.2) / 0.56 / max(len(line) for text in texts for line in text.split("\n")))


def _degrees(design: Design) -> list[float]:
    """Return the apex angles of a design [deg]."""
    return [math.degrees(orbit.apex) for orbit in design.orbits]
