"""Figure of a lens calibration: corners with residuals over the image, and pictures of the board."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from amiwarp.io.files import NewFile
from amiwarp.lens.calibration import LensCalibration

MOST_PICTURES = 12
"""Largest number of pictures of the board in the figure."""
COLUMNS = 4
"""Number of pictures in a row."""


def save_figure(found: LensCalibration, path: Path, *, overwrite: bool = False) -> None:
    """Write the figure; its format is that of the path's suffix."""
    from matplotlib.figure import Figure

    poses = found.poses
    shown = [poses[k] for k in np.linspace(0, len(poses) - 1, min(len(poses), MOST_PICTURES)).round().astype(int)]
    rows = -(-len(shown) // COLUMNS)
    width, height = found.camera.width, found.camera.height
    figure = Figure(figsize=(12.0, 6.0 + 2.3 * rows), layout="constrained")
    grid = figure.add_gridspec(rows + 2, COLUMNS, height_ratios=[3.0, 0.01, *[1.2] * rows])
    left, right = figure.add_subplot(grid[0, :2]), figure.add_subplot(grid[0, 2:])
    longest = max(float(np.hypot(*p.residuals.T).max()) for p in poses)
    most = 0.06 * width / max(longest, 1e-6)
    decade = 10.0 ** math.floor(math.log10(most))
    factor = max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= most)
    for k, pose in enumerate(poses):
        colour = f"C{k % 10}"
        left.plot(*pose.corners.xy.T, ".", color=colour, markersize=3)
        left.quiver(
            *pose.corners.xy.T, *(factor * pose.residuals).T, color=colour, angles="xy", scale_units="xy", scale=1.0,
            width=0.0018,
        )  # fmt: skip
    left.set(title=f"Corners, and their residuals × {factor:g}", xlabel="x [px]", ylabel="y [px]")
    counts = found.coverage
    right.imshow(counts, extent=(-0.5, width - 0.5, height - 0.5, -0.5), cmap="Greens", vmin=0)
    for (a, b), count in np.ndenumerate(counts):
        place = ((b + 0.5) * width / 3.0, (a + 0.5) * height / 3.0)
        right.text(
            *place, str(count), ha="center", va="center", color="black" if count < 0.6 * counts.max() else "white"
        )
    right.set(title="Number of corners per region", xlabel="x [px]", ylabel="y [px]")
    for axes in (left, right):
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    for k, pose in enumerate(shown):
        axes = figure.add_subplot(grid[2 + k // COLUMNS, k % COLUMNS])
        axes.imshow(pose.picture, cmap="gray")
        axes.plot(*pose.corners.xy.T, ".", color="C1", markersize=2)
        axes.set_title(f"{pose.name}: {pose.rms:.2g} px", fontsize=8)
        axes.set(xticks=[], yticks=[])
    with NewFile(path, overwrite=overwrite) as new:
        figure.savefig(new.part, format=path.suffix[1:].lower(), dpi=110)
