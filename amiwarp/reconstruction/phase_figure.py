"""Figure of an image in phase: picture, edges by direction, thresholds, and misfit."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.outputs import NewFile
from amiwarp.reconstruction.image_in_phase import PhaseImage

STRONG = 99.0
"""Percentile of the gradient that is drawn in full colour."""
LARGEST_RATIO = 2.0
"""Largest ratio of thresholds that is drawn; the smallest is one over it."""


def save_phase_figure(found: PhaseImage, path: Path, *, overwrite: bool = False) -> None:
    """Write the figure in the format of the path's suffix."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 8.6), layout="constrained")
    axes = figure.subplots(2, 2)
    low, high = np.percentile(found.log, [0.5, 99.5])
    axes[0, 0].imshow(found.log, cmap="gray", vmin=low, vmax=max(high, low + 1e-6))
    axes[0, 0].set_title("log intensity")
    axes[0, 1].imshow(edge_colours(found.gradient))
    axes[0, 1].set_title("gradient: colour by direction, brightness by strength")
    ratio = np.log2(np.where(found.threshold_ratio > 0.0, found.threshold_ratio, np.nan))
    limit = math.log2(LARGEST_RATIO)
    shown = axes[1, 0].imshow(ratio, cmap="PuOr", vmin=-limit, vmax=limit)
    axes[1, 0].set_title("OFF threshold / ON threshold [octaves]")
    figure.colorbar(shown, ax=axes[1, 0], shrink=0.8)
    shown = axes[1, 1].imshow(found.misfit, cmap="viridis", vmin=0.0, vmax=1.0)
    axes[1, 1].set_title("share that neither a still scene nor noise explains")
    figure.colorbar(shown, ax=axes[1, 1], shrink=0.8)
    for one in axes.ravel():
        one.set(xticks=[], yticks=[])
    with NewFile(path, overwrite=overwrite) as new:
        figure.savefig(new.part, format=path.suffix[1:].lower(), dpi=110)


def edge_colours(gradient: NDArray[np.float32]) -> NDArray[Any]:
    """Return colours of a gradient, shape (height, width, 3), from 0 to 1: opposite directions have opposite hues."""
    from matplotlib.colors import hsv_to_rgb

    strength = np.hypot(*gradient)
    full = max(float(np.percentile(strength, STRONG)), 1e-9)
    hue = (np.arctan2(gradient[1], gradient[0]) / math.tau) % 1.0
    value = np.minimum(strength / full, 1.0)
    return np.asarray(hsv_to_rgb(np.stack([hue, np.ones_like(hue), value], axis=2)))
