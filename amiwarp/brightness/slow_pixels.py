"""Pixels with slow photoreceptors: their events come late and from a smaller orbit, the more so the darker they are.

A photoreceptor is modelled as a first-order low-pass filter whose rate is proportional to the light (Delbruck and
Mead, ISCAS 1994). At an angular speed ω, a filter with time constant τ sees a circular orbit rotated by atan(ω τ) and
contracted by cos(atan(ω τ)), exactly so where the brightness is linear over the orbit. Elsewhere, the filter's output
differs from the brightness on that orbit. The difference is computed along the prism's path and moved to the right side
of the equations.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.solver import BrightnessMap
from amiwarp.kernels import slow_pixels as slow_kernels
from amiwarp.kernels.launch import launch
from amiwarp.optics.models.base import Model

SAMPLED = 1 << 13
"""Smallest number of pairs whose brightness gives the median of all; all are used if there are fewer."""
THRESHOLD = 0.25
"""Assumed ON threshold [log intensity], which turns the map's brightness into light. Data sheets state 0.1 to 0.4."""


def darkness(
    brightness: BrightnessMap,
    model: Model,
    *,
    ahead: float = 0.0,
) -> tuple[Any, float]:
    """Return each event's time constant, relative to the one at the median brightness of all, and that brightness.

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
    pairs = brightness.pairs
    device = brightness.device
    path = brightness.path_arguments(model)

    every = max(1, len(pairs) // SAMPLED)
    count = math.ceil(len(pairs) / every)
    sampled = wp.empty((2, count), dtype=float, device=device)
    launch(slow_kernels.write_brightness, count, [*path, ahead, every], [sampled], device=device)

    pixels = slow_kernels.Photoreceptor()
    pixels.ahead = ahead
    pixels.middle = float(np.nanmedian(sampled.numpy()))
    pixels.threshold = THRESHOLD
    relative = wp.empty((2, pairs.arrays.stride), dtype=float, device=device)
    kernel = slow_kernels.write_time_constants
    launch(kernel, len(pairs), [*path, pixels], [relative], device=device)
    return relative, pixels.middle


def set_lags(
    brightness: BrightnessMap,
    model: Model,
    turns: NDArray[np.float64],
    ahead: float,
    *,
    with_offsets: bool,
) -> None:
    """Give the pairs the lags of slow pixels, relative to a mean lag, which remains part of the phase.

    Parameters
    ----------
    brightness : BrightnessMap
        Solved map, whose pairs have lags (:meth:`PairSet.clear_lags`).
    model : Model
        Model with the phase at which the map was solved.
    turns : numpy.ndarray
        Angle by which the prism turns within the time constant at median brightness [rad], shape (tiles,).
    ahead : float
        The mean lag [rad].
    with_offsets : bool
        Whether to compute what the filter's output differs from the brightness on the contracted orbit. The map must
        have been solved with lags.
    """
    pairs = brightness.pairs
    count = len(pairs)
    relative, middle = darkness(brightness, model, ahead=ahead if with_offsets else 0.0)
    turns_of_pairs = turns[pairs.column("tile")]
    lag = np.arctan(turns_of_pairs * relative.numpy()[:, :count])
    factor = np.cos(lag) * np.exp(1j * (ahead - lag))

    # Rows: real and imaginary part for the first event of each pair, then for the second one. The padding has a 1.
    values = np.zeros((4, pairs.arrays.stride), np.float32)
    values[0::2] = 1.0
    values[0::2, :count] = factor.real
    values[1::2, :count] = factor.imag
    pairs.arrays.lag.assign(values.ravel())
    pairs.arrays.offset.zero_()
    if not with_offsets:
        return

    device = brightness.device
    pixels = slow_kernels.Photoreceptor()
    pixels.threshold = THRESHOLD
    pixels.middle = middle
    pixels.ahead = ahead
    pixels.turn = wp.array(turns, dtype=float, device=device)
    inputs = [*brightness.path_arguments(model), pixels]
    launch(slow_kernels.write_offsets, count, inputs, [pairs.arrays.offset], device=device)
