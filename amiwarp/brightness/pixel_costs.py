"""Photometric cost of each pixel as a function of the optical model, from which a plate's phase and depths are found.

For each model the brightness map is solved anew: the cost is the one of variable projection. The equations of a pixel
depend only on the map near it. So one solution gives the costs of all pixels, and an inverse depth is tried for all of
them at once.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.event_table import EventTable
from amiwarp.brightness.pairs import off_excess
from amiwarp.brightness.solver import BrightnessMap, Smoothness
from amiwarp.brightness.tiles import Tiles
from amiwarp.events.device_events import DeviceEvents
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.kernels import pixel_costs as kernels
from amiwarp.kernels.launch import launch
from amiwarp.optics.models.base import Model

SCALE = 0.5
"""Residual at which an equation gets half weight [thresholds]."""
STEPS = 30
"""Number of conjugate-gradient steps of a solution, which starts from the last map; the first one takes two rounds."""
DENSITY = 2.0
"""Map nodes per pixel. With one, interpolation makes orbits of a pixel 5 to 10 % too large."""
SMOOTHNESS = 0.02
"""Weight of the smoothness prior, which makes the solver converge faster."""
DAMPING = 1e-6
"""Weight of the squared map values, which determines the mean of the map."""


class PixelCosts:
    """Costs of the pixels over one time window of events. Owns the pairs of events and the brightness map."""

    def __init__(
        self,
        events: Events | DeviceEvents,
        size: tuple[int, int],
        encoder: Encoder,
        *,
        longest_gap_us: int,
        margin_px: float,
        device: Any,
    ) -> None:
        """Make the pairs of events. ``margin_px``: largest displacement by the models that follow [px].

        Raises :class:`amiwarp.AmiwarpError` if no pixel fires twice.
        """
        width, height = size
        one_tile = np.zeros((height, width), np.int32)
        table = EventTable([events], one_tile, device)
        table.exclude_hot_pixels()
        first, last = table.covers
        middle_us = (first + last) // 2
        self.pairs = table.pairs(encoder, longest_gap_us=longest_gap_us, middle_us=middle_us)
        border = math.ceil(margin_px) + 2
        origin = np.full((1, 2), -border, np.float32)
        tiles = Tiles(origin, height + 2 * border, width + 2 * border, 1.0)
        self._map = BrightnessMap(
            self.pairs,
            tiles.at_density(DENSITY),
            off_excess=off_excess(self.pairs) if len(self.pairs) else 0.0,
            damping=DAMPING,
            smoothness=Smoothness(SMOOTHNESS),
            middle_us=middle_us,
        )
        self._size = size
        self._device = self._map.device
        self._sums = wp.zeros(width * height, dtype=wp.int64, device=self._device)
        self._rounds = 2
        row = self.pairs.column("y").astype(np.int64)
        pixel = row * width + self.pairs.column("x")
        count = np.bincount(pixel, minlength=width * height)
        self.count: NDArray[np.int64] = count.reshape(height, width)
        """Number of pairs of each pixel, shape (height, width)."""

    def of(self, model: Model) -> NDArray[np.float64]:
        """Return the cost of each pixel, summed over its pairs, for the map that fits the model; shape (height, width).

        The cost of a pair with the residual r is s² log(1 + (r / s)²), nearly r² [thresholds²].
        """
        self._solve(model)
        inputs = [self._map.residuals.values, SCALE]
        return SCALE**2 * self._summed(kernels.add_costs, inputs)

    def gradient(
        self,
        model: Model,
        plus: Model,
        minus: Model,
        width: float,
    ) -> NDArray[np.float64]:
        """Return the derivative of half the cost of each pixel along a line of models, shape (height, width).

        The line goes from the model ``minus`` to ``plus``, whose distance is ``width``. The derivative loses the part
        that a change of the map explains. So the sum over pixels is the derivative of the cost of variable projection.
        """
        self._solve(model)
        still = {"drift": 0.0, "camera_rotation": None}
        slope = self._map.find_slope(
            {"model": plus, **still},
            {"model": minus, **still},
            width,
        )
        self._map.prepare_projection()
        rest = self._map.unexplained(slope, steps=STEPS)
        residuals = self._map.residuals
        return self._summed(kernels.add_products, [rest, residuals.values, residuals.weight])

    def _solve(self, model: Model) -> None:
        self._map.place(model)
        self._map.solve(SCALE, steps=STEPS, rounds=self._rounds)
        self._rounds = 1

    def _summed(self, kernel: Any, inputs: list[Any]) -> NDArray[np.float64]:
        """Return the sums over each pixel's pairs that a kernel computes, shape (height, width)."""
        width, height = self._size
        self._sums.zero_()
        count = len(self.pairs)
        # One CPU thread only: several would add to the same sums.
        one_thread = count + 1
        inputs = [self.pairs.arrays, *inputs, width]
        launch(kernel, count, inputs, [self._sums], device=self._device, smallest=one_thread)
        sums = self._sums.numpy().reshape(height, width)
        return np.asarray(sums / float(kernels.UNIT))
