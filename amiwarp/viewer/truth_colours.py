"""Colours for events by cause, instance and depth, and the legend of these colours."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from amiwarp.imaging.palette import BLUE, ORANGE, PINK, VERMILION
from amiwarp.plotting.world_preview import instance_colours
from amiwarp.viewer.choices import Colour
from amiwarp.viewer.drawn_truth import STORES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.drawn_truth import DrawnTruth

CAUSE_COLOURS = (BLUE, ORANGE, PINK, VERMILION)
"""Colour of each cause of events, in the order of the codes of :class:`amiwarp.Cause`."""
GREY = "#808080"
"""Colour of the sky, and of unknown causes."""
DEPTH_MAP = "viridis_r"
"""Matplotlib colour map of depth. Near points are light."""
DEPTH_PERCENTILES = (2.0, 98.0)
"""Percentiles of the depths of drawn events at which the colour scale begins and ends."""
Legend: TypeAlias = tuple[tuple[str, str], ...]
"""Rows of a legend: a colour in hexadecimal notation, and the meaning of the colour.

The colour of the title row is empty.
"""


def truth_colours(truth: DrawnTruth, colour: Colour) -> NDArray[np.uint8]:
    """Return red, green and blue (0 to 255) of each drawn event, shape ``(n, 3)``."""
    values = truth.values(colour)
    rgb = _depths(values, _scale(values)) if colour is Colour.DEPTH else _names(colour, values)
    return np.rint(255.0 * rgb).astype(np.uint8)


def legend_of(truth: DrawnTruth, colour: Colour, most: int) -> Legend:
    """Return the legend of a colour choice; the legend is empty if the choice does not show ground truth.

    A legend of depth has ``most`` rows. Other legends list at most ``most`` causes or instances, the most frequent
    first, with their fractions of the drawn events.
    """
    if colour not in STORES:
        return ()
    if colour is Colour.DEPTH:
        return (("", "depth [m]"), *_depth_rows(truth.values(colour), most))
    return (("", colour.value), *_name_rows(truth, colour, most))


def _depth_rows(depth: NDArray[Any], most: int) -> Legend:
    """Return ``most`` legend rows of depths [m] in equal ratios, and a row for the sky if an event saw the sky."""
    scale = _scale(depth)
    steps = np.geomspace(*scale, most)
    rows = _rows(_depths(steps, scale), [f"{step:#.3g}".rstrip(".") for step in steps])
    return (*rows, (GREY, "sky")) if np.isinf(depth).any() else rows


def _name_rows(truth: DrawnTruth, colour: Colour, most: int) -> Legend:
    """Return the legend rows of the most frequent causes or instances, and a row that sums up the rest."""
    counts = np.bincount(truth.values(colour))
    found = np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)]
    shares = 100.0 * counts / counts.sum()
    texts = [f"{truth.name(colour, k)} {shares[k]:.3g} %" for k in found[:most].tolist()]
    rows, others = _rows(_names(colour, found[:most]), texts), found[most:]
    return (*rows, ("", f"{len(others)} more {shares[others].sum():.3g} %")) if len(others) else rows


def _rows(rgb: NDArray[np.float64], texts: list[str]) -> Legend:
    """Return legend rows of colours (0 to 1), shape (k, 3), and texts."""
    from matplotlib.colors import to_hex

    return tuple((to_hex(each), text) for each, text in zip(rgb, texts, strict=True))


def _names(colour: Colour, values: NDArray[Any]) -> NDArray[np.float64]:
    """Return the colours (0 to 1) of cause codes or instance numbers, shape ``(n, 3)``."""
    from matplotlib.colors import to_rgb

    if colour is Colour.CAUSE:
        table = np.array([to_rgb(each) for each in (*CAUSE_COLOURS, GREY)])
        return np.asarray(table[np.minimum(values, len(CAUSE_COLOURS))])
    return np.asarray(np.where((values == 0)[:, None], to_rgb(GREY), instance_colours(values)))


def _depths(depth: NDArray[Any], scale: tuple[float, float]) -> NDArray[np.float64]:
    """Return the colours (0 to 1) of depths [m] on a logarithmic scale, shape ``(n, 3)``. The sky is grey.

    ``scale``: depths at both ends of the scale [m].
    """
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    low, high = scale
    share = np.log(np.clip(depth, low, high) / low) / math.log(high / low)
    return np.asarray(np.where(np.isfinite(depth)[:, None], colormaps[DEPTH_MAP](share)[:, :3], to_rgb(GREY)))


def _scale(depth: NDArray[Any]) -> tuple[float, float]:
    """Return the lowest and the highest depth of the colour scale [m]."""
    seen = depth[np.isfinite(depth)]
    low, high = np.percentile(seen, DEPTH_PERCENTILES).tolist() if len(seen) else (1.0, 10.0)
    low = max(low, 1e-3)
    return low, max(high, 1.1 * low)
