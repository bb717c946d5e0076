"""Figure of what a camera sees in a simulated world: luminance, depth, instances and optical flow."""

from __future__ import annotations

import colorsys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.plotting.figures import blank, save

if TYPE_CHECKING:
    from amiwarp.events.truth import FrameTruth

COLUMN_WIDTH, TITLE_HEIGHT = 4.6, 0.32
"""Width of a picture of the figure, and height of its title [inch]."""
PERCENTILE = 99.0
"""Percentile of luminance, depth or speed that is drawn with full brightness or colour."""
GAMMA = 2.2
"""Exponent (gamma) by which linear luminance is converted to grey."""
GOLDEN = 0.618034
"""Golden ratio, the step of the hue between successive instances, so that neighbouring numbers differ in colour."""
SKY = (0.85, 0.92, 1.0)
"""Colour of pixels that see the sky, in the pictures of depth and instances."""
WHEEL = 0.2
"""Diameter of the colour wheel of flow directions, as a share of the picture's height."""
LEAST_SPEED = 1e-3
"""Speed that is drawn with the full colour if nothing moves faster [px/s]."""


def draw_preview(path: Path, frame: FrameTruth, *, overwrite: bool = False) -> None:
    """Write a figure of six pictures of a world at one instant as a PNG."""
    height, width = frame.depth.shape
    size = (3 * COLUMN_WIDTH, 2 * (COLUMN_WIDTH * height / width + TITLE_HEIGHT))
    figure = blank(size, layout="compressed")
    axes = figure.subplots(2, 3)
    white = max(float(np.percentile(frame.intensity, PERCENTILE)), 1e-6)
    for ax, light, title in (
        (axes[0, 0], frame.intensity, "without the prism"),
        (axes[0, 1], frame.intensity_with_prism, "through the prism"),
    ):
        ax.imshow(np.clip(light / white, 0.0, 1.0) ** (1.0 / GAMMA), cmap="gray", vmin=0.0, vmax=1.0)
        ax.set_title(f"luminance, {title}")
    for ax, flow, title in (
        (axes[1, 0], frame.flow, "without the prism"),
        (axes[1, 1], frame.flow_with_prism, "through the prism"),
    ):
        _draw_flow(ax, flow, title)
    _draw_depth(figure, axes[0, 2], frame.depth)
    axes[1, 2].imshow(instance_colours(frame.instance))
    axes[1, 2].set_title("instances")
    for ax in axes.ravel():
        ax.set_axis_off()
    figure.suptitle(f"at {frame.t_us * 1e-3:.1f} ms")
    save(figure, path, all_colours=True, overwrite=overwrite)


def _draw_depth(figure: Any, ax: Any, depth: NDArray[np.float32]) -> None:
    """Draw the depth on a logarithmic scale, with a colour bar."""
    from matplotlib.colors import LogNorm

    seen = depth[np.isfinite(depth)]
    ax.set_title("depth [m]")
    if not seen.size:
        ax.imshow(np.broadcast_to(np.array(SKY), (*depth.shape, 3)))
        return
    low, high = float(seen.min()), float(np.percentile(seen, PERCENTILE))
    low = max(low, 1e-4)
    high = max(high, 1.1 * low)
    drawn = ax.imshow(np.ma.masked_invalid(depth), cmap="viridis_r", norm=LogNorm(low, high))
    ax.imshow(np.where(np.isfinite(depth)[..., None], 0.0, (*SKY, 1.0)))
    bar = figure.colorbar(drawn, ax=ax, shrink=0.85)
    ticks = np.geomspace(low, high, 5)
    bar.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks])
    bar.minorticks_off()


def _draw_flow(ax: Any, flow: NDArray[np.float32], title: str) -> None:
    """Draw the optical flow as colours, with the wheel of directions in the lower left corner."""
    speed = np.linalg.norm(flow, axis=2)
    known = speed[np.isfinite(speed)]
    full = max(float(np.percentile(known, PERCENTILE)) if known.size else 0.0, LEAST_SPEED)
    picture = flow_colours(flow, full)
    side = max(8, round(WHEEL * picture.shape[0]))
    along = np.linspace(-1.0, 1.0, side)
    wheel = np.stack(np.meshgrid(along, along), axis=2).astype(np.float32)
    inside = np.linalg.norm(wheel, axis=2) <= 1.0
    corner = picture[-side:, :side]
    corner[inside] = flow_colours(wheel, 1.0)[inside]
    ax.imshow(picture)
    ax.set_title(f"flow {title}; full colour: {full:.3g} px/s")


def flow_colours(flow: NDArray[np.float32], full: float) -> NDArray[np.float64]:
    """Return optical flow as colours, shape (height, width, 3): hue for the direction, saturation for the speed.

    ``full`` is the speed of full saturation. Unknown flow is black.
    """
    from matplotlib.colors import hsv_to_rgb

    known = np.isfinite(flow).all(axis=2)
    x, y = (np.where(known, flow[..., axis], 0.0) for axis in (0, 1))
    hue = (np.arctan2(y, x) / (2.0 * np.pi)) % 1.0
    saturation = np.clip(np.hypot(x, y) / full, 0.0, 1.0)
    return np.asarray(hsv_to_rgb(np.stack([hue, saturation, known.astype(float)], axis=2)))


def instance_colours(instance: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return instance numbers as colours, shape (height, width, 3). The sky is pale blue."""
    numbers, where = np.unique(instance, return_inverse=True)
    values = (0.95, 0.6, 0.8)
    colours = [SKY if n == 0 else colorsys.hsv_to_rgb(n * GOLDEN % 1.0, 0.65, values[n % 3]) for n in numbers.tolist()]
    return np.asarray(colours)[where.reshape(instance.shape)]
