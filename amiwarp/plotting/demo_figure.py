"""Figure of the demo: images, an enlarged region as picture and as point clouds, and the cost surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.thinning import thin
from amiwarp.choices import Tone
from amiwarp.compensation.in_memory import compensate_events
from amiwarp.events.recording import Recording
from amiwarp.imaging.metrics import PictureQuality
from amiwarp.imaging.regions import best_box
from amiwarp.plotting.calibration_figure import EVENTS, LOCAL, Images, draw_cost, images, show
from amiwarp.plotting.clouds import Cloud, draw_cloud
from amiwarp.plotting.figures import blank, save
from amiwarp.reconstruction.picture import Picture
from amiwarp.reconstruction.picture_files import limits, tones
from amiwarp.results.calibration import Calibration

POINTS = 60_000
"""Largest number of points in an event cloud."""
REGION = (64, 80)
"""Width and height of the part of the image that is enlarged and drawn as clouds [px]."""
BORDER = 8
"""Distance of the enlarged part from the border of the image, if the image is large enough [px]."""
WIDTH = 15.0
TITLE = 14.0
"""Width of the demo's figure [inch], and size of its titles [point]."""


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

        The original sets black and white. The fit of the quality sets gain and offset of the picture.
        """
        gain = np.float32(self.quality.gain)
        offset = np.float32(self.quality.offset)
        found = replace(self.picture, log=gain * self.picture.log + offset)
        everywhere = np.ones(self.original.shape, np.bool_)
        original = replace(self.picture, log=self.original, known=everywhere)
        black_and_white = limits(original, 1.0)
        return (
            tones(found, Tone.MAPPED, contrast=1.0, between=black_and_white),
            tones(original, Tone.MAPPED, contrast=1.0, between=black_and_white),
        )


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
    pair = views.images
    corner = views.corner
    found, original = reconstructed.tones()
    figure = grid.figure
    ax = grid.axes
    figure.text(0.5, 1.0 - 0.34 / grid.height, headline, ha="center", va="center", fontsize=18)
    show(ax["raw"], pair.before, pair.top, "events before compensation")
    correlation = f"correlation {reconstructed.quality.correlation:.3f}"
    show_grey(ax["picture"], found, f"reconstructed from one turn, {correlation}")
    show_grey(ax["original"], original, "ground truth: the view without the prism")
    show(ax["compensated"], pair.after, pair.top, "events after compensation")
    for name in ("raw", "picture", "original", "compensated"):
        mark(ax[name], corner)
    left, top = corner
    width, height = REGION
    part = (slice(top, top + height), slice(left, left + width))
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
        # All lengths are in inches.
        gap = 0.12
        headline = 0.6
        title = 0.42
        width = (WIDTH - 4 * gap) / 3.0
        tall = width * rows / columns
        part = min(tall * REGION[0] / REGION[1], (WIDTH - 5 * gap - width) / 3.0)
        third = 4.1
        foot = 0.65
        height = headline + 2 * (title + tall + gap) + title + third + foot
        figure = blank((WIDTH, height))

        def place(
            left: float, top: float, wide: float, high: float, projection: str | None = None
        ) -> Any:
            low = 1.0 - (top + high) / height
            shares = (left / WIDTH, low, wide / WIDTH, high / height)
            return figure.add_axes(shares, projection=projection)

        axes = {}
        # First row: three images
        top = headline + title
        for k, name in enumerate(("raw", "picture", "original")):
            axes[name] = place(gap + k * (width + gap), top, width, tall)

        # Second row: an image, and the enlarged region three times
        top += tall + gap + title
        axes["compensated"] = place(gap, top, width, tall)
        spare = (WIDTH - 2 * gap - width - 3 * part) / 3.0
        first_left = gap + width + spare
        for k, name in enumerate(("part raw", "part compensated", "part picture")):
            axes[name] = place(first_left + k * (part + spare), top, part, tall)

        # Third row: two clouds, and the cost
        top += tall + gap + title
        for k, name in enumerate(("cloud before", "cloud after")):
            axes[name] = place(gap + k * (width + gap), top, width, third, "3d")
        axes["cost"] = place(2 * (width + gap) + 0.75, top, width - 0.65, third)
        return cls(figure, axes, height)


def enlarge(figure: Any, cost: Any) -> None:
    """Enlarge the text so that it stays legible when the figure is shown at half its size."""
    for ax in figure.axes:
        ax.title.set_fontsize(TITLE)
        ax.tick_params(labelsize=TITLE - 2.0)
        ax.xaxis.label.set_fontsize(TITLE - 2.0)
        ax.yaxis.label.set_fontsize(TITLE - 2.0)
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
    raw = np.stack([events.x, events.y], axis=1).astype(np.float32)
    after = compensate_events(events, calibration.model, encoder, device=device)

    inside = np.all((after >= corner) & (after < np.add(corner, REGION)), axis=1)
    which = np.flatnonzero(inside)
    step = max(1, -(-len(which) // POINTS))  # rounded up
    which = which[::step]
    angle = encoder.angle_at(events.t[which])
    if len(angle):
        angle = angle - angle.mean()
    height = angle / (2.0 * math.pi)
    on = events.p[which] == 1
    before = Cloud(_box(raw[which], height, corner), on)
    moved = Cloud(_box(after[which], height, corner), on)
    return before, moved


def _box(
    xy: NDArray[np.float32], height: NDArray[np.float64], corner: tuple[int, int]
) -> NDArray[np.float32]:
    """Return pixel coordinates relative to the centre of the region, in units of the region's longer side."""
    centred = (xy - np.array(corner) - np.array(REGION) / 2.0) / max(REGION)
    return np.column_stack([centred[:, 0], -centred[:, 1], height]).astype(np.float32)
