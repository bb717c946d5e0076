"""Colours of the points in the event clouds, the legend or scale that explains them, and the points' third axis."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Axis, Colour
from amiwarp.imaging.export import GAMMA
from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.imaging.residuals import WIDEST_PX, at_pixels, outside, residual
from amiwarp.plotting.colours import (
    GREY,
    LIGHT_GREY,
    Scale,
    as_bytes,
    cause_colours,
    depth_colours,
    depth_ends,
)
from amiwarp.plotting.world_figure import instance_colours
from amiwarp.viewer.drawn_truth import DrawnTruth, colours_on_offer
from amiwarp.viewer.look import Look
from amiwarp.viewer.shown_window import DisplayedWindow


def _truth_colours(colour: Colour, values: NDArray[Any]) -> NDArray[np.float64]:
    """Return the colours (0 to 1) of causes, instances or depths, shape ``(n, 3)``. The sky is grey."""
    from matplotlib.colors import to_rgb

    if colour is Colour.DEPTH:
        return depth_colours(values, depth_ends(values))
    if colour is Colour.CAUSE:
        return cause_colours(values)
    is_sky = (values == 0)[:, None]
    return np.asarray(np.where(is_sky, to_rgb(GREY), instance_colours(values)))


def legend_of(truth: DrawnTruth, colour: Colour, most: int) -> tuple[tuple[str, str], ...]:
    """Return the legend of a colour choice; the legend is empty if a scale explains the colours.

    Its rows are a colour in hexadecimal notation, which is empty for the title, and the meaning of the colour. A legend
    of depth has ``most`` rows. Other legends list at most ``most`` causes or instances, the most frequent first, with
    their fractions of the drawn events, and sum up the rest.
    """
    if colour is Colour.POLARITY:
        return ("", "polarity"), (ON_COLOUR, "ON: brighter"), (OFF_COLOUR, "OFF: darker")
    if colour in colours_on_offer(None):  # which needs no ground truth
        return ()

    if colour is Colour.DEPTH:
        return ("", "depth [m]"), *_depth_rows(truth.values(colour), most)
    return ("", colour.value), *_frequent_rows(truth, colour, most)


def _depth_rows(depth: NDArray[Any], rows: int) -> list[tuple[str, str]]:
    """Return rows of a legend for depths in equal ratios, and for the sky if it is there."""
    from matplotlib.colors import to_hex

    ends = depth_ends(depth)
    low, high = ends
    steps = np.geomspace(low, high, rows)
    legend = []
    for step, rgb in zip(steps, depth_colours(steps, ends), strict=True):
        legend.append((to_hex(rgb), f"{step:#.3g}".rstrip(".")))
    if np.isinf(depth).any():
        legend.append((GREY, "sky"))
    return legend


def _frequent_rows(truth: DrawnTruth, colour: Colour, most: int) -> list[tuple[str, str]]:
    """Return rows of a legend for the most frequent causes or instances, and one for the rest."""
    from matplotlib.colors import to_hex

    counts = np.bincount(truth.values(colour))
    share = 100.0 * counts / counts.sum()
    by_count = np.argsort(-counts, kind="stable")
    found = by_count[: np.count_nonzero(counts)]
    listed = found[:most]
    others = found[most:]
    legend = []
    for k, rgb in zip(listed.tolist(), _truth_colours(colour, listed), strict=True):
        legend.append((to_hex(rgb), f"{truth.name(colour, k)} {share[k]:.3g} %"))
    if len(others):
        legend.append(("", f"{len(others)} more {share[others].sum():.3g} %"))
    return legend


def third_axis(shown: DisplayedWindow, axis: Axis) -> NDArray[np.float64]:
    """Return each point's third coordinate, shape ``(n,)``: prism angle [deg], or time [ms]."""
    if axis is Axis.ANGLE:
        return np.asarray(np.degrees(shown.theta), np.float64)
    time_us = shown.events.t - shown.span.first_us + shown.offset_us
    return np.asarray(time_us * 1e-3, np.float64)


def axis_range(shown: DisplayedWindow, axis: Axis) -> tuple[float, float]:
    """Return the ends of the third axis: prism angle [deg], or time after the recording's first event [ms]."""
    if axis is Axis.ANGLE:
        return 0.0, 360.0
    start_ms = shown.span.start_ms + shown.offset_us * 1e-3
    return start_ms, start_ms + shown.span.length_us * 1e-3


def colours_of(shown: DisplayedWindow, look: Look, *, after: bool) -> NDArray[np.uint8]:
    """Return red, green and blue of each point (0 to 255), shape ``(n, 3)``."""
    from matplotlib.colors import to_rgb

    unknown = shown.is_beside and look.colour not in colours_on_offer(shown.truth.truth)
    if (look.overlaid and not after) or unknown:
        return np.full((len(shown.events), 3), 128, np.uint8)
    if look.colour is Colour.POLARITY:
        two = np.array([to_rgb(OFF_COLOUR), to_rgb(ON_COLOUR)])
        return np.asarray((255.0 * two).astype(np.uint8)[shown.events.p])
    scale = scale_of(shown, look.colour, dark=look.dark)
    if scale is None:
        return as_bytes(_truth_colours(look.colour, shown.truth.values(look.colour)))
    if look.colour in (Colour.ANGLE, Colour.TIME):
        return scale.rgb(third_axis(shown, Axis(look.colour.value)))
    image = shown.image_after if after else shown.image_before
    xy = shown.after if after else shown.before
    if look.colour is Colour.DENSITY:
        return scale.rgb(at_pixels(image, xy))
    return scale.rgb(residual(image, xy, _known_part(shown, look.colour)))


def _known_part(shown: DisplayedWindow, colour: Colour) -> tuple[slice, slice]:
    """Return the rows and columns in which density or residual are known: all of the image, or the region's."""
    if colour is Colour.DENSITY:
        height, width = shown.image_after.shape
        return slice(0, height), slice(0, width)
    left, top, right, bottom = shown.region
    return slice(top, bottom), slice(left, right)


def unknown_rows(shown: DisplayedWindow, colour: Colour) -> tuple[tuple[str, str], ...]:
    """Return the row of the legend that counts the drawn events whose density or residual is unknown.

    A model moves them out of the image or the region. Returns no row if there are none.
    """
    if colour not in (Colour.DENSITY, Colour.RESIDUAL):
        return ()
    first = _count_outside(shown.first.before, _known_part(shown.first, colour))
    second = _count_outside(shown.after, _known_part(shown, colour))
    if first:
        return ((LIGHT_GREY, f"unknown: {first:,} of the first cloud, {second:,} of the second"),)
    if second:
        return ((LIGHT_GREY, f"unknown: {second:,} events"),)
    return ()


def _count_outside(xy: NDArray[np.float32], part: tuple[slice, slice]) -> int:
    """Return the number of points that are drawn, and lie outside rows and columns of an image."""
    drawn = np.isfinite(xy).all(axis=1)
    return int(np.count_nonzero(drawn & outside(xy, *part)))


def scale_of(shown: DisplayedWindow, colour: Colour, *, dark: bool) -> Scale | None:
    """Return the scale of a colour choice; None for polarity and ground truth, whose legends have rows.

    The colour maps are perceptually uniform; the map of the angle is cyclic, with white ends and a black middle. Both
    clouds have one scale of the density.
    """
    from matplotlib.colors import to_rgb

    unknown = to_rgb(LIGHT_GREY)
    # Without the darkest colours, which are like a dark background
    paper = " on dark" if dark else ""
    if colour is Colour.ANGLE:
        twilight = "twilight on dark" if dark else "twilight on light"
        return Scale("prism angle θ", "°", 0.0, 360.0, twilight)
    if colour is Colour.TIME:
        low, high = axis_range(shown, Axis.TIME)
        return Scale("time", "ms", low, high, f"viridis{paper}")
    if colour is Colour.DENSITY:
        counts = shown.image_after[shown.image_after > 0]
        high = float(math.ceil(np.percentile(counts, 99.0))) if counts.size else 1.0
        return Scale("events", "per pixel", 0.0, high, f"cividis{paper}", GAMMA, missing=unknown)
    if colour is Colour.RESIDUAL:
        return Scale("residual σ", "px", 0.0, WIDEST_PX, f"cividis{paper}", missing=unknown)
    return None
