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
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import NewFile, check_output
from amiwarp.io.unfinished import scratch_folder
from amiwarp.plotting.colours import Scale, table_of
from amiwarp.plotting.figures import blank
from amiwarp.plotting.meshes import AXIS_HEIGHT, Box, event_clouds
from amiwarp.viewer import captions, cloud_colours, sliders
from amiwarp.viewer.images import ImageKind, make_images
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.look import CAMERA_DIRECTIONS, ORBIT_COLOUR, Look
from amiwarp.viewer.page_state import LEGEND_ROWS
from amiwarp.viewer.shown_window import DisplayedWindow
from amiwarp.viewer.sliders import SLIDERS, UNITS

FIGURE_ENDINGS = (".png", ".svg", ".pdf")
"""Endings of figures."""
SIZE_MM = (180.0, 130.0)
DPI = 300
"""Default width and height of a figure [mm], and default resolution of what is drawn as pixels in it [1/inch]."""
MM_PER_INCH = 25.4
MOST_POINTS = 150_000
"""Largest number of points in each cloud of a figure."""
TEXT_PT = 6.5
TITLE_PT = 7.5
"""Sizes of text and titles [pt]."""
POINT_AREA = 0.35
"""Area of a point of a cloud [pt²]."""
CLOUD_LETTERS = 44
IMAGE_LETTERS = 20
"""Largest length of a line of the title of a cloud and of an image [characters]."""
LETTERS_PER_MM = 0.8
"""Letters of the caption that fit on a line, per width of the figure."""
RATE_BINS = 100
"""Number of bins of the rates over a time window."""
FLAT_AXES = {View.XY: (0, 1), View.X_THIRD: (0, 2), View.Y_THIRD: (1, 2)}
"""Which of a cloud's axes each flat view shows, across and upwards."""
NOW = "#c8501e"
TRUTH = ORBIT_COLOUR
"""Colours of the lines that mark the current and the true value of a parameter."""


@dataclass(frozen=True)
class Page:
    """Size and resolution of a figure."""

    width_mm: float = SIZE_MM[0]
    height_mm: float = SIZE_MM[1]
    dpi: int = DPI

    @classmethod
    def of_pixels(cls, width: int, height: int, dpi: int) -> Page:
        """Return the page with this number of pixels."""
        return cls(width * MM_PER_INCH / dpi, height * MM_PER_INCH / dpi, dpi)


def save_figure(
    inspector: Inspector,
    path: Path,
    page: Page,
    *,
    view: View,
    look: Look,
    against: Knobs | None = None,
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
    stride = max(1, -(-len(shown.events) // MOST_POINTS))  # rounded up
    compensates = math.isfinite(inspector.turn_us)
    titles = captions.cloud_titles(inspector, "recorded" if against is None else "B", look.axis)
    style = {
        "font.size": TEXT_PT,
        "axes.titlesize": TITLE_PT,
        "pdf.fonttype": 42,
        "svg.hashsalt": "a",
    }
    with mpl.rc_context(style):
        figure = blank((page.width_mm / MM_PER_INCH, page.height_mm / MM_PER_INCH), dpi=page.dpi)
        figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.03)
        clouds, charts, foot = figure.subfigures(3, 1, height_ratios=(1.3, 1.0, 0.25))
        pair = [(shown.first.before, shown.first), (shown.after, shown)][-len(titles) :]
        axes = []
        for k, (title, (xy, window)) in enumerate(zip(titles, pair, strict=True)):
            place = (1, len(titles), k + 1)
            is_last = k == len(titles) - 1
            after = window is shown and is_last
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
    rgb = cloud_colours.colours_of(window, look, after=after)[::stride] / 255.0
    third = cloud_colours.third_axis(window, look.axis)[::stride]
    xy = xy[::stride]
    left, top, right, bottom = window.region
    low = (left - 0.5, top - 0.5)
    high = (right - 0.5, bottom - 0.5)
    # Not NaN, either: where the model has no solution
    within = ((xy >= low) & (xy <= high)).all(axis=1)
    points = [xy[within, 0], xy[within, 1], third[within]]
    dots = {"s": POINT_AREA, "c": rgb[within], "linewidths": 0.0, "rasterized": True}

    names = ["x [px]", "y [px]", "θ [°]" if look.axis is Axis.ANGLE else "t [ms]"]
    limits = [
        (left - 0.5, right - 0.5),
        (bottom - 0.5, top - 0.5),  # y points down
        cloud_colours.axis_range(window, look.axis),
    ]
    if view is not View.FREE:
        ax = figure.add_subplot(*place)
        across, up = FLAT_AXES[view]
        ax.scatter(points[across], points[up], **dots)
        ax.set(xlim=limits[across], ylim=limits[up], xlabel=names[across], ylabel=names[up])
        if view is View.XY:
            ax.set_aspect("equal")
        return ax

    ax = figure.add_subplot(*place, projection="3d", computed_zorder=False)
    (away_x, away_y, away_z), _ = CAMERA_DIRECTIONS[view]
    elevation = math.degrees(math.atan2(away_z, math.hypot(away_x, away_y)))
    azimuth = math.degrees(math.atan2(away_y, away_x))
    ax.view_init(elev=elevation, azim=azimuth)
    ax.scatter(*points, depthshade=False, **dots)
    ax.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    ax.set(xlabel=names[0], ylabel=names[1], zlabel=names[2])
    width = right - left
    ax.set_box_aspect((width, bottom - top, AXIS_HEIGHT * width), zoom=1.15)
    ax.locator_params(axis="x", nbins=5)
    ax.locator_params(axis="y", nbins=4)
    ax.tick_params(pad=-2)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.labelpad = -6
    if look.axis is Axis.ANGLE:
        ax.set_zticks((0, 90, 180, 270, 360))
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
    pair = make_images(inspector, ImageKind.COUNT, against=against, shown=shown)
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
    handles, labels = axes[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower right", ncols=2, frameon=False)


def _draw_curve(ax: Any, inspector: Inspector, name: str) -> None:
    """Draw the sharpness over a parameter, with its shown and its true value."""
    values, sharpness = inspector.curve(name)
    label, unit, *_ = SLIDERS[name]
    ax.plot(values / UNITS[name], sharpness, color="#333333", linewidth=0.9)
    for knobs, colour, style, text in (
        (inspector.knobs, NOW, "-", "shown"),
        (inspector.truth, TRUTH, "--", "truth"),
    ):
        if knobs is None:
            continue
        value = knobs.value(name) or 0.0
        if values[0] <= value <= values[-1]:
            shown = value / UNITS[name]
            ax.axvline(shown, color=colour, linewidth=0.9, label=text, linestyle=style)
    ax.set(title="sharpness", xlabel=f"{label} [{unit}]" if unit else label, box_aspect=0.8)
    ax.locator_params(axis="x", nbins=4)


def _draw_rates(ax: Any, inspector: Inspector) -> None:
    """Draw the rates of the selected ON and OFF events of the region over the time window."""
    window = inspector.loaded
    region = inspector.loaded.region
    events = window.counted[inside(window.counted, region)]
    span = window.span
    edges = np.linspace(span.start_us, span.start_us + span.length_us, RATE_BINS + 1)
    read = len(span.events) / span.count  # of a full window, a part is read
    per_s = RATE_BINS / (span.length_us * 1e-6 * read)
    for polarity, colour, text in ((1, ON_COLOUR, "ON"), (0, OFF_COLOUR, "OFF")):
        counts, _ = np.histogram(events.t[events.p == polarity], edges)
        rates = counts * per_s * 1e-6
        ax.stairs(rates, (edges - span.first_us) * 1e-3, color=colour, linewidth=0.8, label=text)
    ax.set(
        title="events of the region",
        xlabel="t [ms]",
        ylabel="rate [Mev/s]",
        ylim=(0.0, None),
        box_aspect=0.6,
    )


def _mapped(scale: Scale) -> dict[str, Any]:
    """Return how Matplotlib maps values to the colours of a scale."""
    from matplotlib.colors import ListedColormap, PowerNorm

    return {
        "cmap": ListedColormap(table_of(scale.colours) / 255.0),
        "norm": PowerNorm(scale.gamma, scale.low, scale.high, clip=True),
    }


def _explain_colours(figure: Any, axes: list[Any], shown: DisplayedWindow, look: Look) -> None:
    """Draw the colour bar or the legend of the points below the clouds."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.lines import Line2D

    bar = cloud_colours.scale_of(shown, look.colour, dark=False)
    if bar is not None:
        figure.colorbar(
            ScalarMappable(**_mapped(bar)),
            ax=axes,
            location="bottom",
            label=bar.label,
            shrink=0.4,
            aspect=40,
        )
    rows = (
        *cloud_colours.legend_of(shown.truth, look.colour, LEGEND_ROWS),
        *cloud_colours.unknown_rows(shown, look.colour),
    )
    square: dict[str, Any] = {"marker": "s", "linestyle": "", "markersize": 4}
    marks = [Line2D([], [], color=colour or "none", label=text, **square) for colour, text in rows]
    if marks:
        figure.legend(
            handles=marks, loc="outside lower center", ncols=5, frameon=False, handletextpad=0.2
        )


def _draw_foot(
    figure: Any,
    inspector: Inspector,
    shown: DisplayedWindow,
    stride: int,
    page: Page,
    *,
    compensates: bool,
) -> None:
    """Draw the caption: recording, time, region, numbers, sharpness and parameters."""
    words = [captions.caption(inspector, shown, stride)]
    if compensates:
        knobs = inspector.knobs
        orbit = sliders.orbit_text(knobs.model, knobs.value, knobs.phase)
        words.append(f"model {knobs.model}: {orbit} ({inspector.sources['phase'].value})")
    wide = round(page.width_mm * LETTERS_PER_MM)
    lines = [line for text in words for line in textwrap.wrap(text, wide)]
    figure.text(0.01, 0.04, "\n".join(lines), va="bottom", ha="left", fontsize=TEXT_PT)


def save_clouds(inspector: Inspector, path: Path) -> int:
    """Write both clouds of the window to one VTP file, and return the number of points of each.

    It has the arrays of :func:`amiwarp.event_clouds`, and ``compensated``: 0 for the events as recorded, 1 for the
    compensated ones. Without a prism that turns, there is one cloud over the time. Raises :class:`AmiwarpError` if
    the file exists, or for a depth map, which the file could not name.
    """
    import pyvista

    check_ending(path, "clouds are written", [".vtp"])
    check_output(path)
    if inspector.depth is not None:
        raise AmiwarpError(
            "a .vtp holds clouds that a calibration explains, without a depth map; leave --depth out"
        )
    shown = inspector.show()
    start = shown.span.start_us
    stop = shown.span.start_us + shown.span.length_us
    if math.isfinite(inspector.turn_us):
        pair = event_clouds(
            inspector.recording,
            inspector.as_calibration(),
            window=(start, stop),
            region=shown.region,
            device=inspector.device,
        )
        whole = pyvista.PolyData(np.concatenate([cloud.points for cloud in pair]))
        for name in pair[0].point_data:
            whole.point_data[name] = np.concatenate([cloud.point_data[name] for cloud in pair])
        counts = [cloud.n_points for cloud in pair]
        whole.point_data["compensated"] = np.repeat(np.arange(2, dtype=np.uint8), counts)
        for name in pair[0].field_data:
            whole.field_data[name] = pair[0].field_data[name]
        count = pair[0].n_points
    else:
        box = Box(*shown.region, *cloud_colours.axis_range(shown, Axis.TIME))
        t_us = shown.events.t - inspector.recording.events.t_first
        whole = pyvista.PolyData(box.positions(shown.before, t_us * 1e-3))
        whole.point_data["t_us"] = t_us
        whole.point_data["polarity"] = shown.events.p
        whole.field_data["axes"] = ["x [px]", "-y [px]", "(t [ms] - z_start) * z_scale"]
        whole.field_data["z_scale"] = [box.stretch]
        whole.field_data["z_start"] = [box.low]
        count = whole.n_points
    with scratch_folder(path.resolve().parent) as folder, NewFile(path) as new:
        whole.save(folder / "clouds.vtp")  # VTK wants this ending
        (folder / "clouds.vtp").replace(new.part)
    return count
