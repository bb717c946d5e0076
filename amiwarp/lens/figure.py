"""Figure of a lens calibration: corners with residuals over the image, and pictures of the board."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.io.outputs import NewFile
from amiwarp.lens.result import BoardPose, LensCalibration

MOST_PICTURES = 12
"""Largest number of pictures of the board in the figure."""
COLUMNS = 4
"""Number of pictures in a row."""


def save_figure(found: LensCalibration, path: Path, *, overwrite: bool = False) -> None:
    """Write the figure in the format of the path's suffix."""
    from matplotlib.figure import Figure

    shown = _shown(found.poses)
    rows = math.ceil(len(shown) / COLUMNS)
    figure = Figure(figsize=(12.0, 6.0 + 2.3 * rows), layout="constrained")
    heights = [3.0, 0.01] + [1.2] * rows
    grid = figure.add_gridspec(rows + 2, COLUMNS, height_ratios=heights)
    left = figure.add_subplot(grid[0, :2])
    right = figure.add_subplot(grid[0, 2:])
    _draw_residuals(left, found)
    _draw_coverage(right, found)

    camera = found.camera
    for axes in (left, right):
        axes.set(
            xlim=(-0.5, camera.width - 0.5),
            ylim=(camera.height - 0.5, -0.5),
            aspect="equal",
        )
    for k, pose in enumerate(shown):
        axes = figure.add_subplot(grid[2 + k // COLUMNS, k % COLUMNS])
        _draw_picture(axes, pose)
    with NewFile(path, overwrite=overwrite) as new:
        kind = path.suffix[1:].lower()
        figure.savefig(new.part, format=kind, dpi=110)


def _shown(poses: Sequence[BoardPose]) -> list[BoardPose]:
    """Return the poses whose pictures are shown, evenly chosen."""
    count = min(len(poses), MOST_PICTURES)
    numbers = np.linspace(0, len(poses) - 1, count).round().astype(int)
    return [poses[k] for k in numbers]


def _draw_picture(axes: Any, pose: BoardPose) -> None:
    """Draw the picture of a pose with its corners."""
    x, y = pose.corners.xy.T
    axes.imshow(pose.picture, cmap="gray")
    axes.plot(x, y, ".", color="C1", markersize=2)
    axes.set_title(f"{pose.name}: {pose.rms:.2g} px", fontsize=8)
    axes.set(xticks=[], yticks=[])


def _draw_residuals(axes: Any, found: LensCalibration) -> None:
    """Draw the corners of all poses, with their residuals enlarged by a round factor."""
    factor = _enlargement(found)
    for k, pose in enumerate(found.poses):
        colour = f"C{k % 10}"
        x, y = pose.corners.xy.T
        along_x, along_y = (factor * pose.residuals).T
        axes.plot(x, y, ".", color=colour, markersize=3)
        axes.quiver(
            x,
            y,
            along_x,
            along_y,
            color=colour,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.0018,
        )
    axes.set(
        title=f"Corners, and their residuals × {factor:g}",
        xlabel="x [px]",
        ylabel="y [px]",
    )


def _enlargement(found: LensCalibration) -> float:
    """Return the factor of the arrows: 1, 2 or 5 times a power of ten, with arrows of at most 6 % of the width."""
    longest = 0.0
    for pose in found.poses:
        lengths = np.hypot(pose.residuals[:, 0], pose.residuals[:, 1])
        longest = max(longest, float(lengths.max()))
    most = 0.06 * found.camera.width / max(longest, 1e-6)
    decade = 10.0 ** math.floor(math.log10(most))
    if 5.0 * decade <= most:
        return 5.0 * decade
    if 2.0 * decade <= most:
        return 2.0 * decade
    return decade


def _draw_coverage(axes: Any, found: LensCalibration) -> None:
    """Draw the number of corners in each ninth of the image."""
    width = found.camera.width
    height = found.camera.height
    counts = found.coverage
    image = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(counts, extent=image, cmap="Greens", vmin=0)
    for (row, column), count in np.ndenumerate(counts):
        x = (column + 0.5) * width / 3.0
        y = (row + 0.5) * height / 3.0
        is_pale = count < 0.6 * counts.max()
        colour = "black" if is_pale else "white"
        axes.text(x, y, str(count), ha="center", va="center", color=colour)
    axes.set(
        title="Number of corners per region",
        xlabel="x [px]",
        ylabel="y [px]",
    )
