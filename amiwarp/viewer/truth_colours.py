"""Colours of causes, instances and depths, and the legend that explains them."""

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
"""Colour of each cause, by its code."""
GREY = "#808080"
"""Colour of the sky, and of unknown causes."""
DEPTH_MAP = "viridis_r"
"""Colour map of depth; its light end is near."""
DEPTH_PERCENTILES = (2.0, 98.0)
"""Percentiles of the drawn depths at which the scale begins and ends."""
Legend: TypeAlias = tuple[tuple[str, str], ...]
"""Rows of a legend: a colour in hexadecimal notation, and its meaning. The title has no colour."""


def truth_colours(truth: DrawnTruth, colour: Colour) -> NDArray[np.uint8]:
    """Return red, green and blue of each drawn event (0 to 255), shape ``(n, 3)``."""
    values = truth.values(colour)
    rgb = _depths(values, _scale(values)) if colour is Colour.DEPTH else _names(colour, values)
    return np.rint(255.0 * rgb).astype(np.uint8)


def legend_of(truth: DrawnTruth, colour: Colour, most: int) -> Legend:
    """Return the legend of a colour that shows ground truth, else an empty one.

    It has ``most`` depths; or the ``most`` frequent causes or instances, with their shares of the drawn events.
    """
    if colour not in STORES:
        return ()
    if colour is Colour.DEPTH:
        return (("", "depth [m]"), *_depth_rows(truth.values(colour), most))
    return (("", colour.value), *_name_rows(truth, colour, most))


def _depth_rows(depth: NDArray[Any], most: int) -> Legend:
    scale = _scale(depth)
    steps = np.geomspace(*scale, most)
    rows = _rows(_depths(steps, scale), [f"{step:#.3g}".rstrip(".") for step in steps])
    return (*rows, (GREY, "sky")) if np.isinf(depth).any() else rows


def _name_rows(truth: DrawnTruth, colour: Colour, most: int) -> Legend:
    counts = np.bincount(truth.values(colour))
    found = np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)]
    shares = 100.0 * counts / counts.sum()
    texts = [f"{truth.name(colour, k)} {shares[k]:.3g} %" for k in found[:most].tolist()]
    rows, others = _rows(_names(colour, found[:most]), texts), found[most:]
    return (*rows, ("", f"{len(others)} more {shares[others].sum():.3g} %")) if len(others) else rows


def _rows(rgb: NDArray[np.float64], texts: list[str]) -> Legend:
    from matplotlib.colors import to_hex

    return tuple((to_hex(each), text) for each, text in zip(rgb, texts, strict=True))


def _names(colour: Colour, values: NDArray[Any]) -> NDArray[np.float64]:
    """Return the colours of causes or instances, shape ``(n, 3)``."""
    from matplotlib.colors import to_rgb

    if colour is Colour.CAUSE:
        table = np.array([to_rgb(each) for each in (*CAUSE_COLOURS, GREY)])
        return np.asarray(table[np.minimum(values, len(CAUSE_COLOURS))])
    return np.asarray(np.where((values == 0)[:, None], to_rgb(GREY), instance_colours(values)))


def _depths(depth: NDArray[Any], scale: tuple[float, float]) -> NDArray[np.float64]:
    """Return the colours of depths [m] on a logarithmic scale, shape ``(n, 3)``; the sky is grey."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    low, high = scale
    share = np.log(np.clip(depth, low, high) / low) / math.log(high / low)
    return np.asarray(np.where(np.isfinite(depth)[:, None], colormaps[DEPTH_MAP](share)[:, :3], to_rgb(GREY)))


def _scale(depth: NDArray[Any]) -> tuple[float, float]:
    """Return the lowest and the highest depth of the scale [m]."""
    seen = depth[np.isfinite(depth)]
    low, high = np.percentile(seen, DEPTH_PERCENTILES).tolist() if len(seen) else (1.0, 10.0)
    low = max(low, 1e-3)
    return low, max(high, 1.1 * low)
