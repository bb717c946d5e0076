"""Images of the shown window in different kinds, each with the scale of its values for a colour bar."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.imaging.export import GAMMA, PERCENTILE
from amiwarp.imaging.palette import OFF_ON_BLACK, ON_ON_BLACK
from amiwarp.imaging.warped_image import CanvasShape, Votes
from amiwarp.viewer.log_intensity import log_intensity

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.parameters import Knobs
    from amiwarp.viewer.window import DisplayedWindow, LoadedWindow


SURFACE_GAMMA = 4.0
"""Exponent of the tone curve of time surfaces, which shows the last quarter of the window in most of the colours."""


class ImageKind(enum.StrEnum):
    """What the images show."""

    COUNT = "count"
    """Number of events per pixel."""
    POLARITY = "polarity"
    """Numbers of OFF and ON events per pixel, in two colours."""
    TIME_SURFACE = "time surface"
    """Time of the latest event of each pixel."""
    LOG_INTENSITY = "log intensity"
    """Log intensity of the scene, reconstructed from the compensated events."""


@dataclass(frozen=True)
class Scale:
    """How values become colours."""

    title: str
    """Name of the quantity."""
    unit: str
    """Unit of the values; empty for numbers without unit."""
    low: float
    """Value at the start of the colour bar. Lower values have the same colour."""
    high: float
    """Value at the end of the colour bar. Higher values have the same colour."""
    colours: str
    """Name of Matplotlib's colour map, or "polarity" for OFF and ON in two colours on black."""
    gamma: float = 1.0
    """Exponent of the tone curve: a colour's place on the bar is the share of the range to this power."""

    def __post_init__(self) -> None:
        assert self.low < self.high

    def places(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the places of values on the colour bar, 0 to 1; NaN stays NaN."""
        share = (np.asarray(values, np.float64) - self.low) / (self.high - self.low)
        return np.asarray(np.clip(share, 0.0, 1.0) ** self.gamma, np.float64)

    def rgb(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Return the colours of an image, shape ``(height, width, 3)``; pixels without a value are black.

        ``values``: shape ``(height, width)``, or ``(2, height, width)`` for OFF and ON.
        """
        steps = _steps(values, self.low, self.high)
        if self.colours == "polarity":
            places = np.linspace(0.0, 1.0, STEPS)[steps] ** self.gamma
            both = places[0][..., None] * np.array(OFF_ON_BLACK) + places[1][..., None] * np.array(ON_ON_BLACK)
            return np.asarray(np.rint(255.0 * np.clip(both, 0.0, 1.0)), np.uint8)
        colours = np.take(_table(self.colours, self.gamma), steps, axis=0)
        if self.colours != "gray":
            colours[np.isnan(values)] = 0
        return colours

    def ticks(self) -> tuple[tuple[float, str], ...]:
        """Return the marks of the colour bar: their places, 0 to 1, and their texts."""
        from matplotlib.ticker import MaxNLocator

        values = np.asarray(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]).tick_values(self.low, self.high), np.float64)
        values = values[(values >= self.low) & (values <= self.high)]
        return tuple((float(place), f"{v:g}") for place, v in zip(self.places(values), values, strict=True))


STEPS = 1 << 16
"""Number of steps into which the range of a scale is divided for its colours."""


def _steps(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint16]:
    """Return the steps of values in a range; 0 for NaN."""
    share = (np.asarray(values, np.float32) - np.float32(low)) * np.float32((STEPS - 1) / (high - low))
    return np.asarray(np.fmin(np.fmax(share, 0.0), STEPS - 1.0), np.uint16)


@cache
def _table(colours: str, gamma: float) -> NDArray[np.uint8]:
    """Return the colours of all steps, of a colour map of Matplotlib after a tone curve, shape ``(STEPS, 3)``."""
    from matplotlib import colormaps

    shares = np.linspace(0.0, 1.0, STEPS) ** gamma
    return np.asarray(np.rint(255.0 * colormaps[colours](shares)[:, :3]), np.uint8)


@dataclass(frozen=True, eq=False)
class ShownImages:
    """Images of the shown region, before and after compensation, with one scale for both."""

    kind: ImageKind
    before: NDArray[np.float32] | None
    """Image of the events as recorded, or of the parameters compared with, shape ``(height, width)``, or
    ``(2, height, width)`` for OFF and ON. NaN marks pixels without a value. None for a log intensity, which needs
    compensated events."""
    after: NDArray[np.float32]
    """Image of the compensated events, of the same shape."""
    scale: Scale
    note: str = ""
    """What limits the images, for the page; empty if nothing does."""


def make_images(
    inspector: Inspector, kind: ImageKind, knobs: Knobs | None = None, *, against: Knobs | None = None
) -> ShownImages:
    """Return the images of the inspector's window.

    ``knobs``: parameters of the second image, by default the current ones. ``against``: parameters of the first image
    instead of none. Raises :class:`AmiwarpError` if a log intensity cannot be reconstructed.
    """
    window, knobs = inspector.loaded, knobs or inspector.knobs
    left, top, right, bottom = window.region
    cut = np.s_[..., top:bottom, left:right]
    if kind is ImageKind.LOG_INTENSITY:
        return _log_images(inspector, window, knobs, against)
    if kind is ImageKind.TIME_SURFACE:
        images = [_time_surface(inspector, window, k)[cut] for k in (against, knobs)]
        scale = Scale("time of the latest event", "ms", 0.0, window.span.length_us * 1e-3, "viridis", SURFACE_GAMMA)
        return ShownImages(kind, images[0], images[1], scale)
    per_polarity = kind is ImageKind.POLARITY
    images = [_counts(inspector, window, k, per_polarity=per_polarity)[cut] for k in (against, knobs)]
    colours = "polarity" if per_polarity else "gray"
    scale = Scale("events", "per pixel", 0.0, _top(*images), colours, GAMMA)
    return ShownImages(kind, images[0], images[1], scale)


def count_images(shown: DisplayedWindow) -> ShownImages:
    """Return the images of kind :attr:`ImageKind.COUNT` of a window that is already shown."""
    left, top, right, bottom = shown.region
    images = [each[top:bottom, left:right] for each in (shown.image_before, shown.image_after)]
    scale = Scale("events", "per pixel", 0.0, _top(*images), "gray", GAMMA)
    return ShownImages(ImageKind.COUNT, images[0], images[1], scale)


def _top(*images: NDArray[np.float32]) -> float:
    """Return the count at the end of the scale of both images."""
    positive = [image[image > 0.0] for image in images]
    return max([1.0, *(float(np.percentile(each, PERCENTILE)) for each in positive if each.size)])


def _counts(
    inspector: Inspector, window: LoadedWindow, knobs: Knobs | None, *, per_polarity: bool
) -> NDArray[np.float32]:
    """Return the events per pixel, with the place of each event dithered in its pixel."""
    size = inspector.recording.events.size
    votes = Votes(CanvasShape(*size, per_polarity=per_polarity, dither=True), inspector.device)
    with inspector.lock:
        model, events, drift_us = inspector.warped(window, knobs)
        votes.add_events(model, events, drift=drift_us)
        image = votes.take()
    return image if per_polarity else image[0]


def _time_surface(inspector: Inspector, window: LoadedWindow, knobs: Knobs | None) -> NDArray[np.float32]:
    """Return the time of the latest event of each pixel from the start of the window on [ms]; NaN without events."""
    events, (width, height) = window.events, inspector.recording.events.size
    if knobs is None:
        pixel = events.y.astype(np.int64) * width + events.x
    else:
        x, y = np.rint(inspector.positions(events, knobs)).T
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        with np.errstate(invalid="ignore"):
            pixel = np.where(inside, y.astype(np.int64) * width + x.astype(np.int64), width * height)
    surface = np.full(width * height + 1, np.nan, np.float32)  # the last element takes the events outside of the image
    # events are in order of time; of several values for one pixel, NumPy keeps the last
    surface[pixel] = (events.t - window.span.start_us) * 1e-3
    return surface[:-1].reshape(height, width)


def _log_images(inspector: Inspector, window: LoadedWindow, knobs: Knobs, against: Knobs | None) -> ShownImages:
    """Return log intensities of the region with one scale."""
    found = [None if each is None else log_intensity(inspector, window, each) for each in (against, knobs)]
    first, second = found
    assert second is not None
    known = np.concatenate([each.log[each.known] for each in found if each is not None])
    low, high = (float(np.percentile(known, share)) for share in (0.5, 99.5)) if known.size else (0.0, 1.0)
    scale = Scale("log intensity", "ON thresholds", low, max(high, low + 1e-3), "gray")
    return ShownImages(ImageKind.LOG_INTENSITY, None if first is None else first.log, second.log, scale, second.note)
