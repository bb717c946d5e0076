"""Properties of one time window: time, size of the map, smoothness, ratio of the thresholds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.brightness.tiles import Tiles
from amiwarp.events.device_source import read_between
from amiwarp.events.encoder import TWO_PI
from amiwarp.optics.camera_rotation import CameraRotation, border

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from amiwarp.events.events import EventSource
    from amiwarp.optics.models import Model

LARGEST_MARGIN = 0.5
"""Largest margin of the map on each side of the image, relative to the image's width."""
SMOOTHNESS = (0.004, 0.02, 0.1, 0.5)
"""Candidate weights of the smoothness prior, ascending; held-out equations choose among them."""
TIE = 1.05
"""Ratio of costs of held-out equations up to which the larger weight is chosen. Converged maps nearly tie."""
CHOICE_STEPS = 12
"""Number of conjugate-gradient steps in each round with which the weights are compared. In 28 windows of 12 recordings,
8, 12, 16 and 24 steps chose the same."""
CHOICE_SQUARES = (64, 96)
"""Sides of the square of pixels in which the smoothness is chosen [px]."""
CHOICE_EVENTS = 24_000
"""Number of events that suffices for the choice in the smaller square."""
STILL_WINDOW_US = 100_000
"""Default length of a time window if the prism does not turn [us]."""


def settled_span(source: EventSource, turn_us: float | None, length_us: int | None) -> tuple[int, int]:
    """Return start and length [us] of a time window without the beginning of the recording, if it is long enough.

    There, the reference of a pixel is unknown until its first event. ``turn_us``: duration of a turn [us], None if the
    prism does not turn. ``length_us``: length of the window, by default a turn.
    """
    beginning = round(turn_us or STILL_WINDOW_US)
    length = length_us or beginning
    first, last = source.t_first, source.t_last
    return max(first, min(first + beginning, last + 1 - length)), length


def map_tile(model: Model, camera_rotation: CameraRotation, length_us: int) -> tuple[int, int, Tiles]:
    """Return the map's margin left of and above the image (columns, rows), and the map of all that pixels see.

    ``camera_rotation`` is the rotation about the window's middle. ``length_us`` is the window's length [us].
    """
    camera = model.camera
    margin = np.max(np.abs(border_displacements(model)), axis=0) + camera_rotation.reach(camera, length_us * 0.5e-6)
    limit = LARGEST_MARGIN * camera.width
    left, top = (math.ceil(min(float(m), limit)) + 2 for m in margin)
    origin = np.array([[-left, -top]], np.float32)
    return left, top, Tiles(origin, camera.height + 2 * top, camera.width + 2 * left, 1.0)


def border_displacements(model: Model) -> NDArray[np.float64]:
    """Return the displacements of the image's border by the prism over one turn [px], shape (n, 2)."""
    xy = border(model.camera)
    theta = np.arange(24) * (TWO_PI / 24)
    at = np.repeat(xy, 24, axis=0)
    moved = model.compensate_points(at.astype(np.float32), np.tile(theta, len(xy)))
    away = np.asarray(moved, np.float64) - at
    return away[np.isfinite(away).all(axis=1)]


def choice_square(count: NDArray[np.int32]) -> tuple[int, int, int]:
    """Return first column, first row and side of the square of pixels in which the smoothness is chosen.

    It is the square with the most events, of the smallest side with enough events. ``count``: events per pixel, shape
    ``(height, width)``.
    """
    for side in CHOICE_SQUARES:
        rows = [count[k : k + side].sum(axis=0, dtype=count.dtype) for k in range(0, count.shape[0], side)]
        cells = np.add.reduceat(rows, np.arange(0, count.shape[1], side), axis=1)
        row, column = np.unravel_index(int(cells.argmax()), cells.shape)
        if cells.max() >= CHOICE_EVENTS:
            break
    return int(column) * side, int(row) * side, side


def start_lowest_weight(start_cost: Callable[[float], Callable[[], float]]) -> Callable[[], float]:
    """Start to find the largest weight of :data:`SMOOTHNESS` whose cost is nearly the lowest; see :data:`TIE`.

    ``start_cost`` starts to compute the cost of a weight and returns a function that waits for it. Return a function
    that waits for the weight. The cost falls and then rises with the weight. So the two middle weights show on which
    side the lowest cost is.
    """
    weakest, weak, strong, strongest = SMOOTHNESS
    waiting = start_cost(weak), start_cost(strong)

    def result() -> float:
        weak_cost, strong_cost = (cost() for cost in waiting)
        if strong_cost <= TIE * weak_cost:
            return strongest if start_cost(strongest)() <= TIE * min(weak_cost, strong_cost) else strong
        return weak if weak_cost <= TIE * start_cost(weakest)() else weakest

    return result


def off_excess_by_counts(source: EventSource, turn_us: float | None, start_us: int, length_us: int) -> float:
    """Return the ratio of the OFF to the ON threshold, minus 1, from event counts over whole turns near the window.

    After a whole turn, a pixel is back at its brightness. So the number of ON events times the ON threshold equals the
    number of OFF events times the OFF threshold. This does not hold in the first turn of a recording: before a pixel
    fires, its reference is not the brightness that an event left. So later turns are counted; in a recording of less
    than two turns, the first event of each pixel is not counted.
    """
    first, last = source.t_first, source.t_last
    if turn_us is None or last - first < turn_us:
        return 0.0
    turns = (last - first) / turn_us
    length = max(1, math.floor(min(length_us / turn_us, turns - 1.0))) * turn_us
    start = min(max(start_us, first + turn_us), last - length)
    settled = start >= first + turn_us
    events = read_between(source, round(start if settled else first), round(start + length))
    t, x, y, p = (v if isinstance(v, np.ndarray) else v.numpy() for v in (events.t, events.x, events.y, events.p))
    if not settled:
        counted = t >= start
        counted[first_of_each_pixel(x, y, source.size[0])] = False
        p = p[counted]
    on = int(p.sum())
    return float(np.clip(on / max(len(p) - on, 1) - 1.0, -0.7, 2.0)) if len(p) >= 1000 else 0.0


def first_of_each_pixel(x: NDArray[Any], y: NDArray[Any], width: int) -> NDArray[np.int64]:
    """Return the index of the first event of each pixel that fires, for events in time order, shape (pixels,)."""
    index: NDArray[np.int64] = np.unique(y.astype(np.int64) * width + x, return_index=True)[1]
    return index
