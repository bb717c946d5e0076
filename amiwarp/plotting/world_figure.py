"""Figures of what a camera sees in a simulated world: luminance, depth, instances and optical flow."""

from __future__ import annotations

import colorsys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.truth import FrameTruth
from amiwarp.plotting.colours import DEPTH_MAP, SKY, depth_ends
from amiwarp.plotting.figures import blank, save
from amiwarp.results.depth_map import DepthMap

COLUMN_WIDTH = 4.6
TITLE_HEIGHT = 0.32
"""Width of a picture of the figure, and height of its title [inch]."""
PREVIEW_PERCENTILE = 99.0
"""Percentile of luminance, depth or speed that is drawn with full brightness or colour."""
GAMMA = 2.2
"""Exponent (gamma) by which linear luminance is converted to grey."""
GOLDEN = 0.618034
"""Golden ratio, the step of the hue between successive instances, so that neighbouring numbers differ in colour."""
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
    (light, light_with_prism, depth), (flow, flow_with_prism, instances) = axes
    white = max(float(np.percentile(frame.intensity, PREVIEW_PERCENTILE)), 1e-6)
    _draw_light(light, frame.intensity / white, "without the prism")
    _draw_light(light_with_prism, frame.intensity_with_prism / white, "through the prism")
    _draw_flow(flow, frame.flow, "without the prism")
    _draw_flow(flow_with_prism, frame.flow_with_prism, "through the prism")
    _draw_depth(figure, depth, frame.depth)
    instances.imshow(instance_colours(frame.instance))
    instances.set_title("instances")
    for ax in axes.ravel():
        ax.set_axis_off()
    figure.suptitle(f"at {frame.t_us * 1e-3:.1f} ms")
    save(figure, path, all_colours=True, overwrite=overwrite)


def draw_depths(path: Path, found: DepthMap, *, overwrite: bool = False) -> None:
    """Write a figure of a map of depths and of their relative standard deviations as a PNG."""
    height, width = found.inverse_depth.shape
    size = (2 * COLUMN_WIDTH, COLUMN_WIDTH * height / width + TITLE_HEIGHT)
    figure = blank(size, layout="compressed")
    left, right = figure.subplots(1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        _draw_depth(figure, left, 1.0 / found.inverse_depth)
        share = np.ma.masked_invalid(100.0 * found.std / found.inverse_depth)
    drawn = right.imshow(share, cmap="cividis", vmin=0.0)
    right.set_title("standard deviation of the depth [%]")
    figure.colorbar(drawn, ax=right, shrink=0.85)
    for ax in (left, right):
        ax.set_axis_off()
    save(figure, path, all_colours=True, overwrite=overwrite)


def _draw_light(ax: Any, light: NDArray[np.float32], title: str) -> None:
    """Draw luminance, of which 1 is white, in grey."""
    grey = np.clip(light, 0.0, 1.0) ** (1.0 / GAMMA)
    ax.imshow(grey, cmap="gray", vmin=0.0, vmax=1.0)
    ax.set_title(f"luminance, {title}")


def _draw_depth(figure: Any, ax: Any, depth: NDArray[np.float32]) -> None:
    """Draw the depth on a logarithmic scale, with a colour bar."""
    from matplotlib.colors import LogNorm

    ax.set_title("depth [m]")
    if not np.isfinite(depth).any():
        ax.imshow(np.broadcast_to(np.array(SKY), (*depth.shape, 3)))
        return
    low, high = depth_ends(depth)
    drawn = ax.imshow(np.ma.masked_invalid(depth), cmap=DEPTH_MAP, norm=LogNorm(low, high))
    ax.imshow(np.where(np.isfinite(depth)[..., None], 0.0, (*SKY, 1.0)))
    bar = figure.colorbar(drawn, ax=ax, shrink=0.85)
    ticks = np.geomspace(low, high, 5)
    bar.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks])
    bar.minorticks_off()


def _draw_flow(ax: Any, flow: NDArray[np.float32], title: str) -> None:
    """Draw the optical flow as colours, with the wheel of directions in the lower left corner."""
    speed = np.linalg.norm(flow, axis=2)
    known = speed[np.isfinite(speed)]
    full = LEAST_SPEED
    if known.size:
        full = max(float(np.percentile(known, PREVIEW_PERCENTILE)), LEAST_SPEED)
    picture = flow_colours(flow, full)

    # The wheel shows the flow whose vector is the place in it.
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
    x = np.where(known, flow[..., 0], 0.0)
    y = np.where(known, flow[..., 1], 0.0)
    hue = (np.arctan2(y, x) / (2.0 * np.pi)) % 1.0
    saturation = np.clip(np.hypot(x, y) / full, 0.0, 1.0)
    brightness = known.astype(float)
    hsv = np.stack([hue, saturation, brightness], axis=2)
    return np.asarray(hsv_to_rgb(hsv))


def instance_colours(instance: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return instance numbers as colours, shape (height, width, 3). The sky is pale blue."""
    numbers, where = np.unique(instance, return_inverse=True)
    values = (0.95, 0.6, 0.8)
    colours = []
    for number in numbers.tolist():
        if number == 0:
            colours.append(SKY)
        else:
            hue = number * GOLDEN % 1.0
            colours.append(colorsys.hsv_to_rgb(hue, 0.65, values[number % 3]))
    return np.asarray(colours)[where.reshape(instance.shape)]
