"""Figures of a calibration and of the demo, drawn with Matplotlib into PNG files."""

from __future__ import annotations

import colorsys
import io
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.calibration_events import thin
from amiwarp.calib.result import Calibration, cost_surface
from amiwarp.choices import Tone
from amiwarp.compensation.recordings import compensate_events
from amiwarp.events.recording import Events, Recording
from amiwarp.events.truth import FrameTruth
from amiwarp.imaging.export import PERCENTILE, save_png
from amiwarp.imaging.iwe import iwe
from amiwarp.imaging.metrics import PictureQuality
from amiwarp.imaging.palette import BLACK, BLUE, ORANGE, VERMILION
from amiwarp.imaging.regions import best_box
from amiwarp.io.depth_map import DepthMap
from amiwarp.io.files import write_text
from amiwarp.io.formats import check_ending
from amiwarp.optics.models import MODELS
from amiwarp.plotting.clouds import Cloud, draw_cloud
from amiwarp.plotting.colours import DEPTH_MAP, SKY, depth_ends
from amiwarp.reconstruction.picture import Picture, limits, tones

EVENTS = 2_000_000
"""Largest number of events in the image of a figure; more events are thinned evenly."""
POINTS = 60_000
"""Largest number of points in an event cloud."""
REGION = (64, 80)
"""Width and height of the part of the image that is enlarged and drawn as clouds [px]."""
BORDER = 8
"""Distance of the enlarged part from the border of the image, if the image is large enough [px]."""
WIDTH, TITLE = 15.0, 14.0
"""Width of the demo's figure [inch], and size of its titles [point]."""
GREYS, FAINT = 128, 8
"""Number of grey entries in a figure's palette of 256 colours, and largest difference of the channels of a grey
[levels]."""
MOST_NUMBERS = 9
"""Largest number of numbers on a logarithmic axis."""
FOUND, TRUTH, LOCAL, SHARPEST = VERMILION, BLACK, ORANGE, BLUE
"""Colours of the calibrated parameters, of the true parameters, of the local search, and of the sharpest parameters."""
LEGEND = "#dddddd"
"""Background of the legend, on which white and orange marks can be seen."""
HATCHES = "#999999"
"""Colour of the hatches where nothing was sampled."""


@dataclass(frozen=True)
class Images:
    """Images of the events before and after compensation [events per pixel], shape ``(height, width)`` each."""

    before: NDArray[np.float32]
    """Image of the events as recorded [events per pixel], shape ``(height, width)``."""
    after: NDArray[np.float32]
    """Image of the compensated events [events per pixel], shape ``(height, width)``."""

    @property
    def top(self) -> float:
        """Number of events per pixel that both images show as white."""
        return float(np.percentile(self.after[self.after > 0], PERCENTILE)) if (self.after > 0).any() else 1.0


def draw_calibration(path: Path, recording: Recording, calibration: Calibration, *, device: Any) -> None:
    """Draw the images before and after compensation, and the cost surface with the samples of all stages."""
    figure = blank((14.0, 4.8), layout="compressed")
    axes = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.8))
    draw_images(axes[:2], images(thin(recording, EVENTS), recording, calibration, device=device))
    draw_cost(figure, axes[2], calibration)
    save(figure, path)


def images(events: Events, recording: Recording, calibration: Calibration, *, device: Any) -> Images:
    """Return the images of ``events`` before and after compensation, made on the device."""
    size = recording.events.size
    encoder = calibration.encoder_for(recording.encoder, recording.events.t_first, recording.events.t_last)
    after = iwe(events, *size, model=calibration.model, encoder=encoder, device=device)
    return Images(iwe(events, *size, device=device), after)


def draw_images(axes: Any, pair: Images) -> None:
    """Draw the images before and after compensation on the same scale."""
    for ax, image, title in zip(axes, (pair.before, pair.after), ("before", "after"), strict=True):
        show(ax, image, pair.top, f"events {title} compensation")


def show(ax: Any, image: NDArray[np.float32], top: float, title: str) -> None:
    """Draw an image of events; brightness is the square root of the count."""
    from matplotlib.colors import PowerNorm

    ax.imshow(image, cmap="gray", norm=PowerNorm(0.5, 0.0, top, clip=True), interpolation="nearest")
    ax.set(xticks=(), yticks=())
    ax.set_title(title)


def draw_cost(figure: Any, ax: Any, calibration: Calibration, truth: tuple[float, float] | None = None) -> None:
    """Draw the global search's cost over (size cos phase, size sin phase), all samples, and the result.

    If the photometric stage has moved the result, the sharpest parameters are marked too. Where nothing was sampled,
    the map is hatched. ``truth`` is the true size and phase [rad]. Without a global search only the samples are drawn.
    """
    calibration = calibration.exact
    size = MODELS[calibration.model_name].SIZE
    samples = cost_surface(calibration.stages, size)
    x, y = (np.degrees(samples[:, 0]) * f(samples[:, 1]) for f in (np.cos, np.sin))
    coarse = np.array([stage.name == "global" for stage in calibration.stages], bool)[samples[:, 3].astype(int)]
    if coarse.sum() >= 10 and np.ptp(x[coarse]) > 0 and np.ptp(y[coarse]) > 0:
        surface = ax.tricontourf(x[coarse], y[coarse], samples[coarse, 2], levels=24, cmap="cividis")
        figure.colorbar(surface, ax=ax, label=f"sharpness ({calibration.sharpness_name}, coarse image)", shrink=0.85)
        dots = {"color": "white", "markersize": 4.0, "markeredgecolor": "black", "markeredgewidth": 0.7}
        ax.plot(x[coarse], y[coarse], "o", label="global search", **dots)
        _hatch_the_unsampled(ax)
    ax.plot(x[~coarse], y[~coarse], "+", color=LOCAL, markersize=7, markeredgewidth=1.4, label="local search")
    found = _polar(calibration.parameters[size], calibration.parameters["phase"])
    moved = _draw_sharpest(ax, calibration, size)
    ax.plot(*found, "o", markersize=13, fillstyle="none", color=FOUND, markeredgewidth=2.2, label="found")
    if truth is not None:
        ax.plot(*_polar(*truth), "x", color=TRUTH, markersize=9, markeredgewidth=1.8, label="true")
    reach = 1.05 * max(np.abs([*x, *y, *found]))
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), box_aspect=1.0)
    ax.set(xlabel=f"{size} · cos phase [deg]", ylabel=f"{size} · sin phase [deg]")
    ax.set_title(f"cost surface and its samples{moved}")
    below = 0.5, -0.15  # below the axes, where it covers nothing of the map
    ax.legend(loc="upper center", bbox_to_anchor=below, ncols=3, fontsize=9, facecolor=LEGEND, framealpha=1.0)


def _hatch_the_unsampled(ax: Any) -> None:
    """Hatch the background of a map, which shows where nothing was sampled, and name it in the legend."""
    how = {"facecolor": "white", "edgecolor": HATCHES, "hatch": "////", "linewidth": 0.0}
    ax.patch.set(**how)
    ax.fill((), (), label="not sampled", **how)  # draws nothing but the legend's entry


def _draw_sharpest(ax: Any, calibration: Calibration, size: str) -> str:
    """Mark the sharpest parameters if the photometric stage has moved the result from them.

    Returns a line of the title that says so; empty if nothing moved it.
    """
    stage = calibration.photometric
    if stage is None or not stage.accepted or not {size, "phase"} <= stage.sharpness_parameters.keys():
        return ""
    sharpest = _polar(stage.sharpness_parameters[size], stage.sharpness_parameters["phase"])
    ax.plot(*sharpest, "s", markersize=8, fillstyle="none", color=SHARPEST, markeredgewidth=1.6, label="sharpest")
    return f"\nphotometric stage moved it by {stage.moved_px:.2g} px"


def _polar(size: float, phase: float) -> tuple[float, float]:
    """Return size · cos phase and size · sin phase [deg]."""
    return math.degrees(size) * math.cos(phase), math.degrees(size) * math.sin(phase)


@dataclass(frozen=True, eq=False)
class Reconstructed:
    """Picture reconstructed from events, together with its ground truth."""

    picture: Picture
    """Picture that was reconstructed from events."""
    original: NDArray[np.float32]
    """Log intensity that the camera would see without the prism, shape ``(height, width)``."""
    quality: PictureQuality
    """Similarity of the reconstructed picture and the original."""

    def tones(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the reconstructed picture and the original as displayed, 0 .. 1, with the same black and white.

        Black and white are those of the original. Gain and offset of the picture are those of the quality fit.
        """
        log = np.float32(self.quality.gain) * self.picture.log + np.float32(self.quality.offset)
        original = replace(self.picture, log=self.original, known=np.ones(self.original.shape, np.bool_))
        between = limits(original, 1.0)
        found = tones(replace(self.picture, log=log), Tone.MAPPED, contrast=1.0, between=between)
        return found, tones(original, Tone.MAPPED, contrast=1.0, between=between)


@dataclass(frozen=True, eq=False)
class EventViews:
    """Parts of the demo's figure that show events: images, the enlarged region, and its point clouds."""

    images: Images
    """Images of the events before and after compensation."""
    corner: tuple[int, int]
    """Top left pixel (x, y) of the enlarged region."""
    clouds: tuple[Cloud, Cloud]
    """Events of one turn in the region, before and after compensation."""

    @classmethod
    def of(cls, recording: Recording, calibration: Calibration, device: Any) -> EventViews:
        """Compute the images and the clouds."""
        pair = images(thin(recording, EVENTS), recording, calibration, device=device)
        corner = best_box(pair.after, pair.after, *REGION, BORDER)
        return cls(pair, corner, region_clouds(recording, calibration, corner, device))


def draw_demo(
    path: Path,
    grid: Grid,
    calibration: Calibration,
    views: EventViews,
    reconstructed: Reconstructed,
    *,
    headline: str,
    truth: tuple[float, float],
) -> None:
    """Draw images, the enlarged region, point clouds and cost surface of the demo on the axes of ``grid``."""
    pair, corner = views.images, views.corner
    found, original = reconstructed.tones()
    figure, ax = grid.figure, grid.axes
    figure.text(0.5, 1.0 - 0.34 / grid.height, headline, ha="center", va="center", fontsize=18)
    show(ax["raw"], pair.before, pair.top, "events before compensation")
    show_grey(ax["picture"], found, f"reconstructed from one turn, correlation {reconstructed.quality.correlation:.3f}")
    show_grey(ax["original"], original, "ground truth: the view without the prism")
    show(ax["compensated"], pair.after, pair.top, "events after compensation")
    for name in ("raw", "picture", "original", "compensated"):
        mark(ax[name], corner)
    part = (slice(corner[1], corner[1] + REGION[1]), slice(corner[0], corner[0] + REGION[0]))
    show(ax["part raw"], pair.before[part], pair.top, "marked region: before")
    show(ax["part compensated"], pair.after[part], pair.top, "after compensation")
    show_grey(ax["part picture"], found[part], "reconstructed")
    for when, cloud in zip(("before", "after"), views.clouds, strict=True):
        draw_cloud(ax[f"cloud {when}"], cloud)
        ax[f"cloud {when}"].set_title(f"{when}: one turn of the marked region")
    draw_cost(figure, ax["cost"], calibration, truth)
    enlarge(figure, ax["cost"])
    save(figure, path)


@dataclass(frozen=True)
class Grid:
    """Axes of the demo's figure by name, laid out by the image's aspect ratio so that nothing overlaps."""

    figure: Any
    """Matplotlib figure to which the axes belong."""
    axes: dict[str, Any]
    """Axes of the figure, by name."""
    height: float
    """Height of the whole figure [inch]."""

    @classmethod
    def make(cls, columns: int, rows: int) -> Grid:
        """Lay out the axes for images of ``columns`` x ``rows`` pixels."""
        gap, title = 0.12, 0.42
        width = (WIDTH - 4 * gap) / 3.0
        tall = width * rows / columns
        part = min(tall * REGION[0] / REGION[1], (WIDTH - 5 * gap - width) / 3.0)
        third = 4.1
        height = 0.6 + 2 * (title + tall + gap) + title + third + 0.65
        figure = blank((WIDTH, height))

        def place(left: float, top: float, wide: float, high: float, projection: str | None = None) -> Any:
            at = (left / WIDTH, 1.0 - (top + high) / height, wide / WIDTH, high / height)
            return figure.add_axes(at, projection=projection)

        axes = {}
        top = 0.6 + title
        for k, name in enumerate(("raw", "picture", "original")):
            axes[name] = place(gap + k * (width + gap), top, width, tall)
        top += tall + gap + title
        axes["compensated"] = place(gap, top, width, tall)
        spare = (WIDTH - 2 * gap - width - 3 * part) / 3.0
        for k, name in enumerate(("part raw", "part compensated", "part picture")):
            axes[name] = place(gap + width + spare + k * (part + spare), top, part, tall)
        top += tall + gap + title
        for k, name in enumerate(("cloud before", "cloud after")):
            axes[name] = place(gap + k * (width + gap), top, width, third, "3d")
        axes["cost"] = place(2 * (width + gap) + 0.75, top, width - 0.65, third)
        return cls(figure, axes, height)


def enlarge(figure: Any, cost: Any) -> None:
    """Enlarge the text so that it stays legible when the figure is shown at half its size."""
    for each in figure.axes:
        each.title.set_fontsize(TITLE)
        each.tick_params(labelsize=TITLE - 2.0)
        each.xaxis.label.set_fontsize(TITLE - 2.0)
        each.yaxis.label.set_fontsize(TITLE - 2.0)
    for text in cost.get_legend().get_texts():
        text.set_fontsize(TITLE - 3.0)


def mark(ax: Any, corner: tuple[int, int]) -> None:
    """Draw a frame around the region whose top left pixel is ``corner``."""
    from matplotlib.patches import Rectangle

    ax.add_patch(Rectangle(corner, *REGION, fill=False, edgecolor=LOCAL, linewidth=2.0))


def show_grey(ax: Any, image: NDArray[np.float32], title: str) -> None:
    """Draw a picture of values 0 .. 1 in grey."""
    ax.imshow(image, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
    ax.set(xticks=(), yticks=())
    ax.set_title(title)


def region_clouds(
    recording: Recording, calibration: Calibration, corner: tuple[int, int], device: Any
) -> tuple[Cloud, Cloud]:
    """Return the events of one turn that compensation moves into the region, before and after compensation."""
    source = recording.events
    encoder = calibration.encoder_for(recording.encoder, source.t_first, source.t_last)
    turn_us = round(60e6 / max(abs(encoder.rpm), 1e-3))
    middle = (source.t_first + source.t_last) // 2
    events = source.between(middle - turn_us // 2, middle + turn_us // 2)
    after = compensate_events(events, calibration.model, encoder, device=device)
    inside = np.all((after >= corner) & (after < np.add(corner, REGION)), axis=1)
    which = np.flatnonzero(inside)
    which = which[:: max(1, -(-len(which) // POINTS))]
    raw = np.stack([events.x, events.y], axis=1).astype(np.float32)
    angle = encoder.angle_at(events.t[which])
    height = (angle - angle.mean()) / (2.0 * math.pi) if len(angle) else angle
    on = events.p[which] == 1
    before, moved = (Cloud(_box(xy[which], height, corner), on) for xy in (raw, after))
    return before, moved


def _box(xy: NDArray[np.float32], height: NDArray[np.float64], corner: tuple[int, int]) -> NDArray[np.float32]:
    """Return pixel coordinates relative to the centre of the region, in units of the region's longer side."""
    centred = (xy - np.array(corner) - np.array(REGION) / 2.0) / max(REGION)
    return np.column_stack([centred[:, 0], -centred[:, 1], height]).astype(np.float32)


def blank(size: tuple[float, float], layout: Literal["compressed"] | None = None, dpi: int = 110) -> Any:
    """Return an empty Matplotlib figure of a width and height [inch]."""
    # Without pyplot, which would change global state and look for a display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=dpi, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def number_logarithmic(*axes: Any) -> None:
    """Number logarithmic axes in plain digits: at decades and as many values between as fit, or evenly within one."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    for axis in axes:
        low, high = axis.get_view_interval()
        decades = math.log10(high / low)
        digits = next((d for d in ((1.0, 2.0, 5.0), (1.0, 3.0)) if decades * len(d) <= MOST_NUMBERS), (1.0,))
        locator = MaxNLocator(7, steps=(1, 2, 5, 10)) if decades < 1.0 else LogLocator(subs=digits)
        axis.set_ticks([value for value in locator.tick_values(low, high) if low <= value <= high])
        axis.set_major_formatter(lambda value, _: f"{value:,.12f}".rstrip("0").rstrip("."))
        axis.set_minor_formatter(NullFormatter())


def save(figure: Any, path: Path, *, all_colours: bool = False, overwrite: bool = False) -> None:
    """Write a figure as a PNG; the write is atomic.

    The file has 256 colours, which takes a third of the space, or ``all_colours``.
    """
    from PIL import Image

    buffer = io.BytesIO()
    # uncompressed: the bytes are decoded again at once
    figure.savefig(buffer, format="png", bbox_inches="tight", pad_inches=0.12, pil_kwargs={"compress_level": 0})
    picture = Image.open(buffer).convert("RGB")
    save_png(path, picture if all_colours else indexed(np.asarray(picture)), overwrite=overwrite)


def save_svg(figure: Any, path: Path) -> None:
    """Write a figure as an SVG without a date; the write is atomic."""
    check_ending(path, "figures are written here", [".svg"])
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    write_text(path, text.getvalue())


def save_png_and_svg(figure: Any, path: Path) -> None:
    """Write a figure as ``path`` with the endings .png and .svg; each write is atomic."""
    save(figure, path.with_suffix(".png"))
    save_svg(figure, path.with_suffix(".svg"))


def indexed(rgb: NDArray[np.uint8]) -> Any:
    """Return the picture ``(height, width, 3)`` with a palette of :data:`GREYS` even greys and other colours.

    A palette optimised for all pixels at once has too few greys, which shows steps in smooth areas, or too few colours.
    """
    from PIL import Image

    red, green, blue = np.moveaxis(rgb, 2, 0)
    spread = np.maximum(np.maximum(red, green), blue) - np.minimum(np.minimum(red, green), blue)
    coloured = spread > FAINT
    index = np.rint(rgb.mean(axis=2) * ((GREYS - 1) / 255.0)).astype(np.uint8)
    palette = np.repeat(np.rint(np.linspace(0.0, 255.0, GREYS)), 3).astype(np.uint8).tolist()
    if coloured.any():
        colours = Image.fromarray(rgb[coloured][None]).quantize(256 - GREYS, Image.Quantize.MEDIANCUT)
        index[coloured] = GREYS + np.asarray(colours)[0]
        palette += colours.getpalette() or []
    picture = Image.fromarray(index)
    picture.putpalette(palette[: 3 * 256])
    return picture


__all__ = ["draw_calibration", "draw_cost", "draw_demo", "draw_images", "images"]


# Figure of what a camera sees in a simulated world: luminance, depth, instances and optical flow.

COLUMN_WIDTH, TITLE_HEIGHT = 4.6, 0.32
"""Width of a picture of the figure, and height of its title [inch]."""
PREVIEW_PERCENTILE = 99.0
"""Percentile of luminance, depth or speed that is drawn with full brightness or colour."""
GAMMA = 2.2
"""Exponent (gamma) by which linear luminance is converted to grey."""
GOLDEN = 0.618034
"""Golden ratio, the step of the hue between successive instances, so that neighbouring numbers differ in colour."""
WHEEL = 0.2
"""Diameter of the colour wheel of flow directions, as a share of the picture's height."""
LEAST_SPEED = 1e-3
"""Speed that is drawn with the full colour if nothing moves faster [px/s]."""


def draw_preview(path: Path, frame: FrameTruth, *, overwrite: bool = False) -> None:
    """Write a figure of six pictures of a world at one instant as a PNG."""
    height, width = frame.depth.shape
    size = (3 * COLUMN_WIDTH, 2 * (COLUMN_WIDTH * height / width + TITLE_HEIGHT))
    figure = blank(size, layout="compressed")
    axes = figure.subplots(2, 3)
    white = max(float(np.percentile(frame.intensity, PREVIEW_PERCENTILE)), 1e-6)
    for ax, light, title in (
        (axes[0, 0], frame.intensity, "without the prism"),
        (axes[0, 1], frame.intensity_with_prism, "through the prism"),
    ):
        ax.imshow(np.clip(light / white, 0.0, 1.0) ** (1.0 / GAMMA), cmap="gray", vmin=0.0, vmax=1.0)
        ax.set_title(f"luminance, {title}")
    for ax, flow, title in (
        (axes[1, 0], frame.flow, "without the prism"),
        (axes[1, 1], frame.flow_with_prism, "through the prism"),
    ):
        _draw_flow(ax, flow, title)
    _draw_depth(figure, axes[0, 2], frame.depth)
    axes[1, 2].imshow(instance_colours(frame.instance))
    axes[1, 2].set_title("instances")
    for ax in axes.ravel():
        ax.set_axis_off()
    figure.suptitle(f"at {frame.t_us * 1e-3:.1f} ms")
    save(figure, path, all_colours=True, overwrite=overwrite)


def draw_depths(path: Path, found: DepthMap, *, overwrite: bool = False) -> None:
    """Write a figure of a map of depths and of their relative standard deviations as a PNG."""
    height, width = found.inverse_depth.shape
    figure = blank((2 * COLUMN_WIDTH, COLUMN_WIDTH * height / width + TITLE_HEIGHT), layout="compressed")
    left, right = figure.subplots(1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        _draw_depth(figure, left, 1.0 / found.inverse_depth)
        share = np.ma.masked_invalid(100.0 * found.std / found.inverse_depth)
    drawn = right.imshow(share, cmap="cividis", vmin=0.0)
    right.set_title("standard deviation of the depth [%]")
    figure.colorbar(drawn, ax=right, shrink=0.85)
    for ax in (left, right):
        ax.set_axis_off()
    save(figure, path, all_colours=True, overwrite=overwrite)


def _draw_depth(figure: Any, ax: Any, depth: NDArray[np.float32]) -> None:
    """Draw the depth on a logarithmic scale, with a colour bar."""
    from matplotlib.colors import LogNorm

    ax.set_title("depth [m]")
    if not np.isfinite(depth).any():
        ax.imshow(np.broadcast_to(np.array(SKY), (*depth.shape, 3)))
        return
    low, high = depth_ends(depth)
    drawn = ax.imshow(np.ma.masked_invalid(depth), cmap=DEPTH_MAP, norm=LogNorm(low, high))
    ax.imshow(np.where(np.isfinite(depth)[..., None], 0.0, (*SKY, 1.0)))
    bar = figure.colorbar(drawn, ax=ax, shrink=0.85)
    ticks = np.geomspace(low, high, 5)
    bar.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks])
    bar.minorticks_off()


def _draw_flow(ax: Any, flow: NDArray[np.float32], title: str) -> None:
    """Draw the optical flow as colours, with the wheel of directions in the lower left corner."""
    speed = np.linalg.norm(flow, axis=2)
    known = speed[np.isfinite(speed)]
    full = max(float(np.percentile(known, PREVIEW_PERCENTILE)) if known.size else 0.0, LEAST_SPEED)
    picture = flow_colours(flow, full)
    side = max(8, round(WHEEL * picture.shape[0]))
    along = np.linspace(-1.0, 1.0, side)
    wheel = np.stack(np.meshgrid(along, along), axis=2).astype(np.float32)
    inside = np.linalg.norm(wheel, axis=2) <= 1.0
    corner = picture[-side:, :side]
    corner[inside] = flow_colours(wheel, 1.0)[inside]
    ax.imshow(picture)
    ax.set_title(f"flow {title}; full colour: {full:.3g} px/s")


def flow_colours(flow: NDArray[np.float32], full: float) -> NDArray[np.float64]:
    """Return optical flow as colours, shape (height, width, 3): hue for the direction, saturation for the speed.

    ``full`` is the speed of full saturation. Unknown flow is black.
    """
    from matplotlib.colors import hsv_to_rgb

    known = np.isfinite(flow).all(axis=2)
    x, y = (np.where(known, flow[..., axis], 0.0) for axis in (0, 1))
    hue = (np.arctan2(y, x) / (2.0 * np.pi)) % 1.0
    saturation = np.clip(np.hypot(x, y) / full, 0.0, 1.0)
    return np.asarray(hsv_to_rgb(np.stack([hue, saturation, known.astype(float)], axis=2)))


def instance_colours(instance: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return instance numbers as colours, shape (height, width, 3). The sky is pale blue."""
    numbers, where = np.unique(instance, return_inverse=True)
    values = (0.95, 0.6, 0.8)
    colours = [SKY if n == 0 else colorsys.hsv_to_rgb(n * GOLDEN % 1.0, 0.65, values[n % 3]) for n in numbers.tolist()]
    return np.asarray(colours)[where.reshape(instance.shape)]
