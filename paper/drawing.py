"""How the figures of the report look, and how they are saved."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from amiwarp.imaging.palette import BLUE, GREEN, ORANGE, VERMILION

FULL_WIDTH_IN = 6.7
"""Width of the text of a page [in]."""

LOOK: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "lines.markersize": 3.5,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "svg.fonttype": "path",
    "svg.hashsalt": "amiwarp",
}
COLOURS = (BLUE, VERMILION, GREEN, ORANGE)


def look() -> AbstractContextManager[None]:
    """Return a context in which figures must be drawn and saved."""
    return matplotlib.rc_context(LOOK)


def new_figure(panels: int, height_in: float) -> tuple[Figure, list[Any]]:
    """Return a figure as wide as the text, with panels in one row."""
    figure = Figure(figsize=(FULL_WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)[0]
    return figure, list(axes)


def save(figure: Figure, path: Path) -> None:
    """Save a figure as SVG, with the same bytes each time."""
    figure.savefig(path, format="svg", metadata={"Date": None})
