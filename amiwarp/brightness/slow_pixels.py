"""Pixels with slow photoreceptors: their events come late and from a smaller orbit, the more so the darker they are.

A photoreceptor is modelled as a first-order low-pass filter whose rate is proportional to the light (Delbruck and Mead,
ISCAS 1994). At an angular speed ω, a filter with time constant τ sees a circular orbit rotated by atan(ω τ) and
contracted by cos(atan(ω τ)), exactly so where the brightness is linear over the orbit. What the filter's output
differs from that elsewhere is computed along the prism's path and moved to the right side of the equations.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.kernels import slow_pixels as kernels
from amiwarp.kernels.launch import launch

if TYPE_CHECKING:
    from amiwarp.brightness.solver import BrightnessMap
    from amiwarp.optics.models import Model

SAMPLED = 1 << 13
"""Smallest number of pairs whose brightness gives the median of all; all are used if there are fewer."""
THRESHOLD = 0.25
"""Assumed ON threshold [log intensity], which turns the map's brightness into light. Data sheets state 0.1 to 0.4."""


def darkness(brightness: BrightnessMap, model: Model, *, ahead: float = 0.0) -> tuple[Any, float]:
    """Return the time constant at each event, relative to that at the median brightness of all, and that brightness.

    Parameters
    ----------
    brightness : BrightnessMap
        Solved map.
    model : Model
        Model with the phase at which the map was solved.
    ahead : float, default 0.0
        Angle by which the prism is ahead of that phase, because the events come late [rad].

    Returns
    -------
    relative : warp.array
        Relative time constants at the first and the second event of each pair, shape (2, n) padded to (2, m).
    middle : float
        Median brightness [ON thresholds].
    """
    pairs, device = brightness.pairs, brightness.device
    pixels = kernels.Photoreceptor()
    pixels.ahead = ahead

    def compute(every: int, columns: int) -> Any:
        out = wp.empty((2, columns), dtype=float, device=device)
        inputs = [*brightness.path_arguments(model), pixels, every]
        launch(kernels.find_time_constants, -(-len(pairs) // every), inputs, [out], device=device)
        return out

    every = max(1, len(pairs) // SAMPLED)
    pixels.middle = float(np.nanmedian(compute(every, -(-len(pairs) // every)).numpy()))
    pixels.threshold = THRESHOLD
    return compute(1, pairs.arrays.stride), pixels.middle


def set_lags(brightness: BrightnessMap, model: Model, turn: float, *, with_offsets: bool) -> None:
    """Give the pairs the lags of slow pixels, relative to the mean lag, which remains part of the phase.

    Parameters
    ----------
    brightness : BrightnessMap
        Solved map, whose pairs have lags (:meth:`PairSet.clear_lags`).
    model : Model
        Model with the phase at which the map was solved.
    turn : float
        Angle by which the prism turns within the time constant at median brightness [rad].
    with_offsets : bool
        Whether to compute what the filter's output differs from the brightness on the contracted orbit. The map must
        have been solved with lags.
    """
    pairs, ahead = brightness.pairs, math.atan(turn)
    relative, middle = darkness(brightness, model, ahead=ahead if with_offsets else 0.0)
    lag = np.arctan(turn * relative.numpy()[:, : len(pairs)])
    factor = np.cos(lag) * np.exp(1j * (ahead - lag))
    values = np.zeros((4, pairs.arrays.stride), np.float32)
    values[0] = values[2] = 1.0
    values[0::2, : len(pairs)], values[1::2, : len(pairs)] = factor.real, factor.imag
    pairs.arrays.lag.assign(values.ravel())
    pairs.arrays.offset.zero_()
    if with_offsets:
        filtering = kernels.Photoreceptor()
        filtering.threshold, filtering.middle, filtering.turn, filtering.ahead = THRESHOLD, middle, turn, ahead
        inputs = [*brightness.path_arguments(model), filtering]
        launch(kernels.find_offsets, len(pairs), inputs, [pairs.arrays.offset], device=brightness.device)
