"""Colours of values: scales with their bars and ticks, and the colours of causes and depths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.imaging.export import GAMMA, PERCENTILE, in_two_colours
from amiwarp.imaging.palette import BLUE, OFF_COLOUR, ON_COLOUR, ORANGE, PINK, VERMILION
from amiwarp.results.depth_map import DepthMap

SKY = (0.85, 0.92, 1.0)
"""Colour of pixels that see the sky, whose depth is unknown, or that have hardly any events."""
CAUSE_COLOURS = (BLUE, ORANGE, PINK, VERMILION)
"""Colour of each cause of events, in the order of the codes of :class:`amiwarp.Cause`."""
GREY = "#808080"
"""Colour of unknown causes, and of points in the sky."""
LIGHT_GREY = "#bbbbbb"
"""Colour of points without a value. No colour of a scale is like it."""
DEPTH_MAP = "viridis_r"
"""Matplotlib colour map of depth. Near points are light."""
DEPTH_PERCENTILES = (2.0, 98.0)
"""Percentiles of the depths of drawn events at which the colour scale begins and ends."""


@dataclass(frozen=True)
class Scale:
    """How values become colours."""

    title: str
    """Name of the quantity."""
    unit: str
    """Unit of the values; "1" for numbers without unit."""
    low: float
    """Value at the start of the colour bar. Lower values have the same colour."""
    high: float
    """Value at the end of the colour bar. Higher values have the same colour."""
    colours: str
    """Colours, as :func:`table_of` knows them, or "polarity" for OFF and ON in two colours on black."""
    gamma: float = 1.0
    """Exponent of the tone curve: a colour's place on the bar is the share of the range to this power."""
    missing: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Red, green and blue of pixels without a value, 0 to 1."""
    missing_text: str = "no event"
    """What a pixel without a value means."""

    def __post_init__(self) -> None:
        assert self.low < self.high

    def places(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the places of values on the colour bar, 0 to 1; NaN stays NaN."""
        share = (np.asarray(values, np.float64) - self.low) / (self.high - self.low)
        return np.asarray(np.clip(share, 0.0, 1.0) ** self.gamma, np.float64)

    def rgb(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Return the colours of an image, shape ``(height, width, 3)``.

        ``values``: shape ``(height, width)`` or ``(n,)``, or ``(2, height, width)`` for OFF and ON.
        """
        places = self.places(values)
        if self.colours == "polarity":
            return as_bytes(np.clip(in_two_colours(*places), 0.0, 1.0))
        known = ~np.isnan(places)
        entries = (255.0 * np.where(known, places, 0.0)).astype(np.uint8)
        rgb = table_of(self.colours)[entries]
        return np.where(known[..., None], rgb, as_bytes(self.missing))

    @property
    def counts(self) -> bool:
        """Whether the values are numbers of events, or their differences."""
        return self.unit == "per pixel"

    @property
    def label(self) -> str:
        """Name and unit of the quantity, and what a colour means that is not on the bar."""
        label = f"{self.title} {self.unit}" if self.counts else f"{self.title} [{self.unit}]"
        if self.missing == SKY:
            label += f"; blue: {self.missing_text}"
        return label

    def ticks(self) -> tuple[tuple[float, str], ...]:
        """Return the marks of the colour bar: their places, 0 to 1, and their texts."""
        values = ticks(self.low, self.high, 4, whole=self.counts)
        places = self.places(values).tolist()
        return tuple((place, f"{value:g}") for place, value in zip(places, values, strict=True))


def as_bytes(rgb: ArrayLike) -> NDArray[np.uint8]:
    """Return red, green and blue from 0 to 1 as 0 to 255, of the same shape."""
    return np.rint(255.0 * np.asarray(rgb)).astype(np.uint8)


@cache
def table_of(colours: str) -> NDArray[np.uint8]:
    """Return the 256 colours of a bar, shape ``(256, 3)``: of a colour map of Matplotlib, or "difference".

    The suffix " on light" or " on dark" keeps white or black apart from the background.
    """
    from matplotlib import colormaps
    from matplotlib.colors import LinearSegmentedColormap

    name, _, paper = colours.partition(" on ")
    if name == "difference":
        colour_map: Any = LinearSegmentedColormap.from_list(name, (OFF_COLOUR, "white", ON_COLOUR))
    else:
        colour_map = colormaps[name]
    table = colour_map(np.linspace(0.0, 1.0, 256))[:, :3]
    if paper == "dark":
        table = 1.0 - 0.8 * (1.0 - table)
    elif paper == "light":
        table = 0.8 * table
    return as_bytes(table)


def ticks(low: float, high: float, most: int = 5, *, whole: bool = False) -> NDArray[np.float64]:
    """Return at most about ``most`` round numbers from ``low`` to ``high``; for angles, divisors of a full turn.

    ``whole``: only whole numbers.
    """
    from matplotlib.ticker import MaxNLocator

    steps = [1, 2, 3, 4.5, 6, 9, 10] if high == 360.0 else [1, 2, 2.5, 5, 10]
    locator = MaxNLocator(most, steps=steps, integer=whole)
    values = np.asarray(locator.tick_values(low, high), np.float64)
    return values[(values >= low) & (values <= high)]


def count_scale(images: Sequence[NDArray[np.float32]], colours: str = "gray") -> Scale:
    """Return one scale of counts for images."""
    top = 1.0
    for image in images:
        positive = image[image > 0.0]
        if positive.size:
            top = max(top, float(np.percentile(positive, PERCENTILE)))
    return Scale("events", "per pixel", 0.0, math.ceil(top), colours, GAMMA)


def depth_image(depth: DepthMap) -> tuple[NDArray[np.float32], Scale]:
    """Return the depths of a map [m], shape ``(height, width)``, NaN where they are unknown, and their scale."""
    with np.errstate(divide="ignore"):
        metres = 1.0 / depth.inverse_depth
    low, high = depth_ends(metres)
    scale = Scale("depth", "m", low, high, DEPTH_MAP, missing=SKY, missing_text="unknown")
    return metres, scale


def cause_colours(codes: NDArray[Any]) -> NDArray[np.float64]:
    """Return the colours (0 to 1) of the codes of causes, shape ``(n, 3)``; unknown causes are grey."""
    from matplotlib.colors import to_rgb

    table = np.array([to_rgb(colour) for colour in (*CAUSE_COLOURS, GREY)])
    return np.asarray(table[np.minimum(codes, len(CAUSE_COLOURS))])


def depth_colours(depth: NDArray[Any], ends: tuple[float, float]) -> NDArray[np.float64]:
    """Return the colours (0 to 1) of depths [m] on a logarithmic scale, shape ``(n, 3)``. The sky is grey.

    ``ends``: depths at both ends of the scale [m].
    """
    from matplotlib import colormaps, colors

    place = colors.LogNorm(*ends, clip=True)
    rgb = colormaps[DEPTH_MAP](place(depth))[:, :3]
    seen = np.isfinite(depth)[:, None]
    return np.asarray(np.where(seen, rgb, colors.to_rgb(GREY)))


def depth_ends(depth: NDArray[Any]) -> tuple[float, float]:
    """Return the lowest and the highest depth of the colour scale [m]."""
    seen = depth[np.isfinite(depth)]
    low = 1.0
    high = 10.0
    if len(seen):
        low, high = np.percentile(seen, DEPTH_PERCENTILES).tolist()
    low = max(low, 1e-3)
    return low, max(high, 1.1 * low)
