"""Colours of the points in the event clouds, and the quantities that the colours show."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.viewer.choices import Axis, Colour
from amiwarp.viewer.drawn_truth import STORES
from amiwarp.viewer.truth_colours import truth_colours

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.cloud_scene import Look
    from amiwarp.viewer.window import DisplayedWindow

COLOUR_MAPS = {Colour.ANGLE: "twilight", Colour.TIME: "viridis", Colour.DENSITY: "cividis", Colour.RESIDUAL: "cividis"}
"""Matplotlib colour map of each quantity that a scale shows."""
NEAR_PX = 2.0
"""Standard deviation of the Gaussian weights of the events near an event [px]."""
WIDEST_PX = 3.0 * NEAR_PX
"""Largest residual [px]. Wider edges look the same as spread events."""
VOTE_VARIANCE = 1.0 / 6.0 + 1.0 / 12.0
"""Variance that bilinear votes and dither add to the place of an event in an image [px²]."""
WIDE_EVENTS = 2.0
"""Number of spread events that are assumed near each event, so that a lone event has a large residual."""


def third_axis(shown: DisplayedWindow, axis: Axis) -> NDArray[np.float64]:
    """Return each point's third coordinate, shape ``(n,)``: prism angle [deg], or time [ms]."""
    if axis is Axis.ANGLE:
        return np.asarray(np.degrees(shown.theta), np.float64)
    return np.asarray((shown.events.t - shown.span.first_us) * 1e-3, np.float64)


def axis_range(shown: DisplayedWindow, axis: Axis) -> tuple[float, float]:
    """Return the ends of the third axis: prism angle [deg], or time after the recording's first event [ms]."""
    if axis is Axis.ANGLE:
        return 0.0, 360.0
    return shown.span.start_ms, shown.span.start_ms + shown.span.length_us * 1e-3


def colours_of(shown: DisplayedWindow, look: Look, *, after: bool) -> NDArray[np.uint8]:
    """Return red, green and blue of each point (0 to 255), shape ``(n, 3)``."""
    from matplotlib.colors import to_rgb

    if look.overlaid and not after:
        return np.full((len(shown.events), 3), 128, np.uint8)
    if look.colour is Colour.POLARITY:
        two = np.array([to_rgb(OFF_COLOUR), to_rgb(ON_COLOUR)])
        return np.asarray((255.0 * two).astype(np.uint8)[shown.events.p])
    if look.colour in STORES:
        return truth_colours(shown.truth, look.colour)
    value, table = _measure(shown, look.colour, after=after), colour_table(look.colour, dark=look.dark)
    return np.asarray(table[np.clip(np.nan_to_num(value) * 255.0, 0, 255).astype(np.uint8)])


def colour_table(colour: Colour, *, dark: bool) -> NDArray[np.uint8]:
    """Return the 256 colours of a scale, shape ``(256, 3)``.

    The colour maps are perceptually uniform; the colour map of the angle is cyclic.
    """
    from matplotlib import colormaps

    name = COLOUR_MAPS[colour]
    table = colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3]
    if colour is Colour.ANGLE:  # its ends are white and its middle is black: keep both apart from the background
        table = 1.0 - 0.8 * (1.0 - table) if dark else 0.8 * table
    return np.asarray(255.0 * table, np.uint8)


def scale_of(shown: DisplayedWindow, colour: Colour) -> tuple[str, str, str]:
    """Return the texts at both ends of a colour scale, and its title."""
    if colour is Colour.ANGLE:
        return "0°", "360°", "prism angle θ"
    if colour is Colour.TIME:
        low, high = axis_range(shown, Axis.TIME)
        return f"{low:.6g}", f"{high:.6g} ms", "time"
    if colour is Colour.DENSITY:
        return "0", f"{density_top(shown):.3g}", "events per pixel (square root)"
    return "0", f"{WIDEST_PX:g} px", "residual: width of the edge near an event"


def density_top(shown: DisplayedWindow) -> float:
    """Return the number of events per pixel at which the colour scale of the density ends, for both clouds."""
    image = shown.image_after
    return max(float(np.percentile(image[image > 0], 99.0)) if (image > 0).any() else 1.0, 1.0)


def _measure(shown: DisplayedWindow, colour: Colour, *, after: bool) -> NDArray[np.float64]:
    """Return the displayed quantity of each point, scaled to 0 … 1."""
    if colour is Colour.ANGLE:
        return shown.theta / math.tau
    if colour is Colour.TIME:
        return (shown.events.t - shown.span.start_us) / shown.span.length_us
    image, xy = (shown.image_after, shown.after) if after else (shown.image_before, shown.before)
    if colour is Colour.DENSITY:
        return np.sqrt(at_pixels(image, xy) / density_top(shown))
    left, top, right, bottom = shown.region
    return residual(image, xy, (slice(top, bottom), slice(left, right))) / WIDEST_PX


def at_pixels(image: NDArray[Any], xy: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the image's value at each point, 0 outside the image, shape ``(n,)``."""
    x, y = (np.nan_to_num(xy[:, k], nan=-9.0) for k in (0, 1))
    column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    inside = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
    out = np.zeros(len(xy))
    out[inside] = image[row[inside], column[inside]]
    return out


def residual(
    image: NDArray[np.float32], xy: NDArray[np.float32], where: tuple[slice, slice] = (slice(None), slice(None))
) -> NDArray[np.float64]:
    """Return the width of the edge at each point, or what is left of the prism's motion [px], shape ``(n,)``.

    It is the standard deviation across the edge of the events near the point: near 0 on a sharp edge, and
    :data:`WIDEST_PX` among spread events and outside the rows and columns ``where``, in which it is computed. The event
    itself does not count.
    """
    wide = np.full(image.shape, WIDEST_PX)
    spread = _spread_across_edges(image, where)
    # Gaussian weights of variance n² and an edge of variance w² give a spread of 1 / (1 / n² + 1 / w²).
    width = spread * NEAR_PX**2 / np.maximum(NEAR_PX**2 - spread, 1e-6) - VOTE_VARIANCE
    wide[where] = np.sqrt(np.clip(width, 1e-6, WIDEST_PX**2))
    found = at_pixels(wide, xy)
    return np.where(found > 0.0, found, WIDEST_PX)


def _spread_across_edges(image: NDArray[np.float32], where: tuple[slice, slice]) -> NDArray[np.float64]:
    """Return the smallest eigenvalue of the second moments of the weighted events about each pixel [px²].

    The moments with weights G of variance s are s G + s² G'', so they follow from derivatives of the smoothed image.
    """
    from scipy.ndimage import gaussian_filter

    reach = 4 * math.ceil(NEAR_PX)
    rows, columns = (range(size)[axis] for size, axis in zip(image.shape, where, strict=True))
    top, left = max(rows.start - reach, 0), max(columns.start - reach, 0)
    part = image[top : rows.stop + reach, left : columns.stop + reach].astype(np.float64)
    orders = ((0, 0), (2, 0), (1, 1), (0, 2))
    smooth, yy, xy, xx = (gaussian_filter(part, NEAR_PX, order=order, mode="constant") for order in orders)
    own_variance = NEAR_PX**2 + VOTE_VARIANCE
    own = 1.0 / (math.tau * own_variance)
    second = 0.5 * (xx + yy) + own / own_variance - np.hypot(0.5 * (xx - yy), xy)
    density = np.maximum(smooth - own, 0.0) + WIDE_EVENTS * own
    spread = np.clip(NEAR_PX**2 + NEAR_PX**4 * second / density, 0.0, NEAR_PX**2)
    return np.asarray(spread[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left])
