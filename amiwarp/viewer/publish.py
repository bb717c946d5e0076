"""Figures for print of what the inspector shows: clouds, images and charts with Matplotlib, and clouds as VTP files."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Axis, View
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.imaging.regions import inside
from amiwarp.io.files import NewFile, check_output, scratch_folder
from amiwarp.io.formats import check_ending
from amiwarp.plotting.colours import Scale, table_of
from amiwarp.plotting.figures import blank
from amiwarp.plotting.meshes import AXIS_HEIGHT, Box, event_clouds
from amiwarp.viewer import drawing, layout
from amiwarp.viewer.drawing import CAMERA_DIRECTIONS, Look
from amiwarp.viewer.inspector import DisplayedWindow, Inspector, Knobs

FIGURE_ENDINGS = (".png", ".svg", ".pdf")
"""Endings of figures."""
SIZE_MM, DPI = (180.0, 130.0), 300
"""Default width and height of a figure [mm], and default resolution of what is drawn as pixels in it [1/inch]."""
MM_PER_INCH = 25.4
MOST_POINTS = 150_000
"""Largest number of points in each cloud of a figure."""
TEXT_PT, TITLE_PT = 6.5, 7.5
"""Sizes of text and titles [pt]."""
POINT_AREA = 0.35
"""Area of a point of a cloud [pt²]."""
CLOUD_LETTERS, IMAGE_LETTERS = 44, 20
"""Largest length of a line of the title of a cloud and of an image [characters]."""
LETTERS_PER_MM = 0.8
"""Letters of the caption that fit on a line, per width of the figure."""
RATE_BINS = 100
"""Number of bins of the rates over a time window."""
NOW, TRUTH = "#c8501e", drawing.ORBIT_COLOUR
"""Colours of the lines that mark the current and the true value of a parameter."""


@dataclass(frozen=True)
class Page:
    """Size and resolution of a figure."""

    width_mm: float = SIZE_MM[0]
    height_mm: float = SIZE_MM[1]
    dpi: int = DPI

    @classmethod
    def of_pixels(cls, width: int, height: int, dpi: int) -> Page:
        """Return the page that has so many pixels."""
        return cls(width * MM_PER_INCH / dpi, height * MM_PER_INCH / dpi, dpi)


def save_figure(
    inspector: Inspector, path: Path, page: Page, *, view: View, look: Look, against: Knobs | None = None
) -> int:
    """Write a figure as PNG, SVG or PDF, and return the number of points in each cloud.

    It holds both clouds, the images, and the sharpness over two parameters, with axes, legends, units, region, time and
    parameters. Points are drawn as pixels, all else as lines and text. Raises :class:`AmiwarpError` for another
    ending, or if the file exists.
    """
    import matplotlib as mpl

    ending = check_ending(path, "figures are written", FIGURE_ENDINGS)
    check_output(path)
    shown = inspector.show(against=against)
    stride = max(1, -(-len(shown.events) // MOST_POINTS))
    compensates = math.isfinite(inspector.turn_us)
    titles = drawing.cloud_titles(inspector, "recorded" if against is None else "B", look.axis)
    with mpl.rc_context({"font.size": TEXT_PT, "axes.titlesize": TITLE_PT, "pdf.fonttype": 42, "svg.hashsalt": "a"}):
        figure = blank((page.width_mm / MM_PER_INCH, page.height_mm / MM_PER_INCH), dpi=page.dpi)
        figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.03)
        clouds, charts, foot = figure.subfigures(3, 1, height_ratios=(1.3, 1.0, 0.25))
        pair = [(shown.first.before, shown.first), (shown.after, shown)][-len(titles) :]
        axes = []
        for k, (title, (xy, window)) in enumerate(zip(titles, pair, strict=True)):
            place = 1, len(titles), k + 1
            after = window is shown and k == len(titles) - 1
            ax = _draw_cloud(clouds, place, xy, window, look, view, stride=stride, after=after)
            ax.set_title(textwrap.fill(title, CLOUD_LETTERS))
            axes.append(ax)
        _explain_colours(clouds, axes, shown, look)
        _draw_charts(charts, inspector, shown, titles, against, compensates=compensates)
        _draw_foot(foot, inspector, shown, stride, page, compensates=compensates)
        with NewFile(path) as new:
            dated = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(ending)
            figure.savefig(new.part, format=ending[1:], metadata=dated, dpi=page.dpi)
    return len(range(0, len(shown.events), stride))


def _draw_cloud(
    figure: Any,
    place: tuple[int, int, int],
    xy: NDArray[np.float32],
    window: DisplayedWindow,
    look: Look,
    view: View,
    *,
    stride: int,
    after: bool,
) -> Any:
    """Draw a cloud, in three dimensions or flat along an axis, and return its axes."""
    rgb = drawing.colours_of(window, look, after=after)[::stride] / 255.0
    third, ends = drawing.third_axis(window, look.axis)[::stride], drawing.axis_range(window, look.axis)
    xy = xy[::stride]
    left, top, right, bottom = window.region
    x, y = (left - 0.5, right - 0.5), (bottom - 0.5, top - 0.5)  # y points down
    third_name = "θ [°]" if look.axis is Axis.ANGLE else "t [ms]"
    low, high = (x[0], y[1]), (x[1], y[0])
    within = ((xy >= low) & (xy <= high)).all(axis=1)  # not NaN, either: where the model has no solution
    points = [values[within] for values in (xy[:, 0], xy[:, 1], third)]
    dots = {"s": POINT_AREA, "c": rgb[within], "linewidths": 0.0, "rasterized": True}
    if view is View.FREE:
        ax = figure.add_subplot(*place, projection="3d", computed_zorder=False)
        away = CAMERA_DIRECTIONS[view][0]
        ax.view_init(elev=math.degrees(math.atan2(away[2], math.hypot(*away[:2]))),
                     azim=math.degrees(math.atan2(away[1], away[0])))  # fmt: skip
        ax.scatter(*points, depthshade=False, **dots)
        ax.set(xlim=x, ylim=y, zlim=ends, xlabel="x [px]", ylabel="y [px]", zlabel=third_name)
        ax.set_box_aspect((np.ptp(x), np.ptp(y), AXIS_HEIGHT * np.ptp(x)), zoom=1.15)
        ax.locator_params(axis="x", nbins=5)
        ax.locator_params(axis="y", nbins=4)
        ax.tick_params(pad=-2)
        ax.xaxis.labelpad = ax.yaxis.labelpad = ax.zaxis.labelpad = -6
        if look.axis is Axis.ANGLE:
            ax.set_zticks((0, 90, 180, 270, 360))
    else:
        ax = figure.add_subplot(*place)
        across, up = {View.XY: (0, 1), View.X_AXIS: (0, 2), View.Y_AXIS: (1, 2)}[view]
        names = "x [px]", "y [px]", third_name
        ax.scatter(points[across], points[up], **dots)
        ax.set(xlim=(x, y, ends)[across], ylim=(x, y, ends)[up], xlabel=names[across], ylabel=names[up])
        if view is View.XY:
            ax.set_aspect("equal")
    return ax


def _draw_charts(
    figure: Any,
    inspector: Inspector,
    shown: DisplayedWindow,
    titles: tuple[str, ...],
    against: Knobs | None,
    *,
    compensates: bool,
) -> None:
    """Draw the images with one scale, or of two recordings each with its own, and the sharpness over two parameters."""
    pair = drawing.make_images(inspector, drawing.ImageKind.COUNT, against=against, shown=shown)
    images = [pair.before, pair.after][-len(titles) :]
    names = [*inspector.orbit_names] if compensates else []
    axes = figure.subplots(1, len(images) + max(1, len(names)))
    left, top, right, bottom = shown.region
    scales = [pair.scale, pair.after_scale or pair.scale][-len(titles) :]
    extent = left - 0.5, right - 0.5, bottom - 0.5, top - 0.5
    for k, (ax, image, title, scale) in enumerate(zip(axes, images, titles, scales, strict=False)):
        drawn = ax.imshow(image, interpolation="nearest", extent=extent, **_mapped(scale))
        ax.set(title=textwrap.fill(title, IMAGE_LETTERS), xlabel="x [px]", ylabel="y [px]")
        if pair.after_scale is not None or k == len(images) - 1:
            figure.colorbar(drawn, ax=ax, label=scale.label, shrink=0.75)
    for ax, name in zip(axes[len(images) :], names, strict=False):
        _draw_curve(ax, inspector, name)
    if not names:
        _draw_rates(axes[-1], inspector)
    figure.legend(*axes[-1].get_legend_handles_labels(), loc="outside lower right", ncols=2, frameon=False)


def _draw_curve(ax: Any, inspector: Inspector, name: str) -> None:
    """Draw the sharpness over a parameter, with its shown and its true value."""
    values, sharpness = inspector.curve(name)
    label, unit, *_ = layout.SLIDERS[name]
    ax.plot(values / layout.UNITS[name], sharpness, color="#333333", linewidth=0.9)
    for knobs, colour, style, text in ((inspector.knobs, NOW, "-", "shown"), (inspector.truth, TRUTH, "--", "truth")):
        value = None if knobs is None else knobs.value(name) or 0.0
        if value is not None and values[0] <= value <= values[-1]:
            ax.axvline(value / layout.UNITS[name], color=colour, linewidth=0.9, label=text, linestyle=style)
    ax.set(title="sharpness", xlabel=f"{label} [{unit}]" if unit else label, box_aspect=0.8)
    ax.locator_params(axis="x", nbins=4)


def _draw_rates(ax: Any, inspector: Inspector) -> None:
    """Draw the rates of the selected ON and OFF events of the region over the time window."""
    window, region = inspector.loaded, inspector.loaded.region
    events, span = window.counted[inside(window.counted, region)], window.span
    edges = np.linspace(span.start_us, span.start_us + span.length_us, RATE_BINS + 1)
    read = len(span.events) / span.count  # of a full window, a part is read
    per_s = RATE_BINS / (span.length_us * 1e-6 * read)
    for polarity, colour, text in ((1, ON_COLOUR, "ON"), (0, OFF_COLOUR, "OFF")):
        counts, _ = np.histogram(events.t[events.p == polarity], edges)
        ax.stairs(counts * per_s * 1e-6, (edges - span.first_us) * 1e-3, color=colour, linewidth=0.8, label=text)
    ax.set(title="events of the region", xlabel="t [ms]", ylabel="rate [Mev/s]", ylim=(0.0, None), box_aspect=0.6)


def _mapped(scale: Scale) -> dict[str, Any]:
    """Return how Matplotlib maps values to the colours of a scale."""
    from matplotlib.colors import ListedColormap, PowerNorm

    return {"cmap": ListedColormap(table_of(scale.colours) / 255.0),
            "norm": PowerNorm(scale.gamma, scale.low, scale.high, clip=True)}  # fmt: skip


def _explain_colours(figure: Any, axes: list[Any], shown: DisplayedWindow, look: Look) -> None:
    """Draw the colour bar or the legend of the points below the clouds."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.lines import Line2D

    bar = drawing.scale_of(shown, look.colour, dark=False)
    if bar is not None:
        figure.colorbar(ScalarMappable(**_mapped(bar)), ax=axes, location="bottom", label=bar.label, shrink=0.4,
                        aspect=40)  # fmt: skip
    rows = (
        *drawing.legend_of(shown.truth, look.colour, drawing.LEGEND_ROWS),
        *drawing.unknown_rows(shown, look.colour),
    )
    marks = [Line2D([], [], marker="s", linestyle="", markersize=4, color=colour or "none", label=text)
             for colour, text in rows]  # fmt: skip
    if marks:
        figure.legend(handles=marks, loc="outside lower center", ncols=5, frameon=False, handletextpad=0.2)


def _draw_foot(
    figure: Any, inspector: Inspector, shown: DisplayedWindow, stride: int, page: Page, *, compensates: bool
) -> None:
    """Draw the caption: recording, time, region, numbers, sharpness and parameters."""
    words = [drawing.caption(inspector, shown, stride)]
    if compensates:
        knobs, source = inspector.knobs, inspector.sources["phase"].value
        words.append(f"model {knobs.model}: {layout.orbit_text(knobs.model, knobs.value, knobs.phase)} ({source})")
    wide = round(page.width_mm * LETTERS_PER_MM)
    lines = [line for text in words for line in textwrap.wrap(text, wide)]
    figure.text(0.01, 0.04, "\n".join(lines), va="bottom", ha="left", fontsize=TEXT_PT)


def save_clouds(inspector: Inspector, path: Path) -> int:
    """Write both clouds of the window to one VTP file, and return the number of points of each.

    The arrays are those of :func:`amiwarp.event_clouds`, and ``compensated``: 0 for the events as recorded, 1 for the
    compensated ones. Without a prism that turns, there is one cloud over the time. Raises :class:`AmiwarpError` if
    the file exists, or for a depth map, which the file could not name.
    """
    import pyvista

    check_ending(path, "clouds are written", [".vtp"])
    check_output(path)
    if inspector.depth is not None:
        raise AmiwarpError("a .vtp holds clouds that a calibration explains, without a depth map; leave --depth out")
    shown = inspector.show()
    start, stop = shown.span.start_us, shown.span.start_us + shown.span.length_us
    if math.isfinite(inspector.turn_us):
        pair = event_clouds(
            inspector.recording, inspector.as_calibration(), window=(start, stop), region=shown.region,
            device=inspector.device,
        )  # fmt: skip
        whole = pyvista.PolyData(np.concatenate([cloud.points for cloud in pair]))
        for name in pair[0].point_data:
            whole.point_data[name] = np.concatenate([cloud.point_data[name] for cloud in pair])
        whole.point_data["compensated"] = np.repeat(np.arange(2, dtype=np.uint8), [cloud.n_points for cloud in pair])
        for name in pair[0].field_data:
            whole.field_data[name] = pair[0].field_data[name]
        count = pair[0].n_points
    else:
        box = Box(*shown.region, *drawing.axis_range(shown, Axis.TIME))
        t_us = shown.events.t - inspector.recording.events.t_first
        whole = pyvista.PolyData(box.positions(shown.before, t_us * 1e-3))
        whole.point_data["t_us"], whole.point_data["polarity"] = t_us, shown.events.p
        whole.field_data["axes"] = ["x [px]", "-y [px]", "(t [ms] - z_start) * z_scale"]
        whole.field_data["z_scale"], whole.field_data["z_start"] = [box.stretch], [box.low]
        count = whole.n_points
    with scratch_folder(path.resolve().parent) as folder, NewFile(path) as new:
        whole.save(folder / "clouds.vtp")  # VTK wants this ending
        (folder / "clouds.vtp").replace(new.part)
    return count
