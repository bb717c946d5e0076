"""Depth at rest from sums in phase: the size of the orbit that explains the sums of each tile best.

A plate moves the image on orbits that are proportional to the inverse depth, so the cost of an orbit
(:mod:`amiwarp.imaging.phase_costs`), tile by tile over the inverse depth, is a plane sweep. Its time does not depend on
the number of events. A tile has one depth. See ``docs/how-to/depth.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from amiwarp.brightness.depths import SMALLEST_PX, orbit_px
from amiwarp.imaging.phase import PhaseSums
from amiwarp.imaging.phase_costs import tile_squares
from amiwarp.optics.models.plate import PlateModel
from amiwarp.optics.orbit import orbits_of
from amiwarp.reconstruction.phase_lag import LAGS, lag_of_costs
from amiwarp.tasks import cpu_threads

SIDE = 48
"""Side of a tile [px]. With 32 px, orbits come out 3 to 5 % too small: much of a wave leaves the tile on its orbit."""
STEP = 8
"""Distance of the tiles' middles [px]."""
HARMONICS = 11
"""Number of harmonics of the angle."""
FINEST = 3.0
"""Spatial frequency of the finest waves that count [rad/px]."""
DAMPING = 1e-3
"""Weight of a flat scene, relative to one squared sum. With 0.01, orbits of 0.6 px came out up to 17 % too large."""
APART_PX = 4.0
"""Distance of the points that show how much larger or smaller the plate shows the scene [px]."""
PLANE_PX = 0.3
"""Distance of the orbits' radii at successive inverse depths [px]."""
LARGEST_PX = 14.0
"""Largest radius of an orbit that is tried [px]: a tile must hold waves that are longer than it."""
TOGETHER = 256
"""Number of tiles that are transformed at a time."""
TILES_OF_LAG = 8
"""Number of tiles from which the lag of the events is found: the ones with the largest sums."""
LARGEST_REST = 0.9
"""Largest share of the squared sums that the best orbit may leave. Tiles of noise alone leave 0.94 and more."""
CORRELATED = 90.0
"""Number of waves that count as one, because their errors are alike. In simulations, 77 to 82 % and 95 to 99 % of the
depths then lie within one and two standard deviations."""
FINER = 40
"""Number of steps in which the squares between two inverse depths are interpolated."""


@dataclass(frozen=True, eq=False)
class TileDepths:
    """Inverse depth of tiles of the image."""

    middles: NDArray[np.float64]
    """Middle of each tile [px], shape (n, 2)."""
    inverse_depth: NDArray[np.float64]
    """Inverse depth [1/m], shape (n,)."""
    std: NDArray[np.float64]
    """Its standard deviation [1/m], shape (n,); infinity where a tile determines none."""
    rest: NDArray[np.float64]
    """Share of the squared sums that the best orbit leaves, shape (n,)."""

    def of_pixels(self, width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the inverse depth of each pixel, and its standard deviation [1/m], each (height, width).

        Beside the edge of a body, tiles that hold one depth explain their sums better than tiles with two. So a pixel
        takes the best explained tile of the nine whose middles are nearest. How far these differ is part of the
        standard deviation.
        """
        columns = len(np.unique(self.middles[:, 0]))
        rows = len(self.middles) // columns
        row_of_pixel = _nearest(self.middles[::columns, 1], height)
        column_of_pixel = _nearest(self.middles[:columns, 0], width)

        tiles = np.arange(rows * columns).reshape(rows, columns)
        around = _nine_about(tiles)
        best = np.take_along_axis(around, self.rest[around].argmin(axis=0)[None], axis=0)[0]
        # Where tiles about each other differ, the pixel may see another depth than the best explained one.
        differences = self.inverse_depth[around] - self.inverse_depth[best]
        spread = np.sqrt((differences**2).mean(axis=0))
        std = np.hypot(self.std[best], spread)
        at = (row_of_pixel[:, None], column_of_pixel[None, :])
        return self.inverse_depth[best][at], std[at]


def depths_in_phase(
    sums: PhaseSums,
    model: PlateModel,
    largest: float,
    report: Callable[[float], None] = lambda share: None,
) -> TileDepths:
    """Return the inverse depths of tiles. ``largest``: largest to try [1/m]; ``report`` gets the finished share."""
    tried = inverse_depths_to_try(model, largest)
    tiles = _Tiles(sums)
    count = len(tiles.corners)
    orbits = np.stack([_orbits(model, tiles.middles, inverse) for inverse in tried.tolist()])
    report(0.2)

    strength = tiles.strength()
    strongest = np.argsort(-strength, kind="stable")[:TILES_OF_LAG]
    lag = _lag_of(tiles.spectra(strongest), orbits[:, strongest])
    report(0.4)

    late = _late(orbits, lag)
    parts = []
    for first in range(0, count, TOGETHER):
        some = np.arange(first, min(first + TOGETHER, count))
        parts.append(_depths_of(tiles.spectra(some), tried, late[:, some]))
        report(0.4 + 0.6 * (some[-1] + 1) / count)
    inverse_depth, std, rest = (np.concatenate(values) for values in zip(*parts, strict=True))
    return TileDepths(tiles.middles, inverse_depth, std, rest)


def _lag_of(spectra: NDArray[np.complex64], orbits: NDArray[np.complex128]) -> float:
    """Return the lag of the events of some tiles [rad], each at its best inverse depth."""
    costs = []
    for lag in LAGS:
        left, total = tile_squares(spectra, _late(orbits, lag), FINEST, damping=DAMPING)
        costs.append(left.min(axis=0).sum() / max(total[0].sum(), 1e-30))
    return lag_of_costs(LAGS, np.array(costs))


def _depths_of(
    spectra: NDArray[np.complex64], tried: NDArray[np.float64], late: NDArray[np.complex64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return inverse depth, its standard deviation, and the share of the squares that is left, of some tiles."""
    left, total = tile_squares(spectra, np.ascontiguousarray(late), FINEST, damping=DAMPING)
    inverse_depth, std, lowest = _minima(tried, left, waves=spectra[0].size)
    rest = lowest / np.maximum(total[0], 1e-30)
    std[(total[0] <= 0.0) | (rest > LARGEST_REST)] = np.inf
    return inverse_depth, std, rest


def inverse_depths_to_try(model: PlateModel, largest: float) -> NDArray[np.float64]:
    """Return inverse depths up to ``largest`` [1/m], as far as their orbits are neither too small nor too large."""
    radius = orbit_px(model)
    most = min(largest, LARGEST_PX / radius)
    least = min(SMALLEST_PX / radius, most / 2.0)
    count = 1 + math.ceil((most - least) * radius / PLANE_PX)
    return np.linspace(least, most, max(5, count))


class _Tiles:
    """Windowed tiles of sums in phase, whose spectra are made for some at a time: all would take gigabytes."""

    def __init__(self, sums: PhaseSums) -> None:
        """Place the tiles over the image, row by row."""
        _, height, width = sums.values.shape
        self._padded = np.pad(sums.values, ((0, 0), (SIDE, SIDE), (SIDE, SIDE)))
        line = np.hanning(SIDE + 2)[1:-1]
        self._window = np.outer(line, line).astype(np.float32)
        tops = np.arange((STEP - SIDE) // 2, height - SIDE // 2, STEP)
        lefts = np.arange((STEP - SIDE) // 2, width - SIDE // 2, STEP)
        self.corners = [(int(top), int(left)) for top in tops for left in lefts]
        """First row and column of each tile, which may lie outside of the image [px]."""
        middle = (SIDE - 1) / 2
        self.middles = np.array([(left + middle, top + middle) for top, left in self.corners])
        """Middle of each tile [px], shape (n, 2)."""

    def strength(self) -> NDArray[np.float64]:
        """Return the sum of the sizes of the waves of each tile's first sum, shape (n,)."""
        found = np.empty(len(self.corners))
        for first in range(0, len(found), TOGETHER):
            some = np.arange(first, min(first + TOGETHER, len(found)))
            found[some] = np.abs(self.spectra(some, harmonics=1)[:, 0]).sum(axis=(1, 2))
        return found

    def spectra(
        self, some: NDArray[np.intp], *, harmonics: int | None = None
    ) -> NDArray[np.complex64]:
        """Return the Fourier transforms of the windowed sums of some tiles, shape (tiles, harmonics, side, side)."""
        values = self._padded[:harmonics]
        parts = np.empty((len(some), len(values), SIDE, SIDE), np.complex64)
        for k, tile in enumerate(some.tolist()):
            top, left = self.corners[tile]
            rows = slice(top + SIDE, top + 2 * SIDE)
            columns = slice(left + SIDE, left + 2 * SIDE)
            np.multiply(values[:, rows, columns], self._window, out=parts[k])
        spectra = scipy.fft.fft2(parts, workers=cpu_threads(), overwrite_x=True)
        return np.asarray(spectra, np.complex64)


def _orbits(
    model: PlateModel, middles: NDArray[np.float64], inverse_depth: float
) -> NDArray[np.complex128]:
    """Return the rotations of points with and against the angle at an inverse depth [px], shape (n, 2).

    The mean of a turn shows the scene smaller or larger than without the plate. The orbits are in pixels of this mean.
    """
    camera = model.camera
    plane = replace(model, inverse_depth=inverse_depth, depths=None)
    inside = np.clip(middles, APART_PX, (camera.width - 1 - APART_PX, camera.height - 1 - APART_PX))
    aside = inside + np.array([APART_PX, 0.0])
    below = inside + np.array([0.0, APART_PX])
    found = orbits_of(plane, np.concatenate([inside, aside, below]))
    mean, mean_aside, mean_below = found.mean.reshape(3, -1)
    growth = ((mean_aside - mean).real + (mean_below - mean).imag) / (2.0 * APART_PX)
    count = len(middles)
    orbits = np.stack([found.forward[:count], found.backward[:count]], axis=1)
    return np.asarray(orbits / (1.0 + growth)[:, None])


def _late(orbits: NDArray[np.complex128], lag: float) -> NDArray[np.complex64]:
    """Return the orbits from which events come that lag by an angle [rad]."""
    late = orbits * np.exp(np.array([-1j, 1j]) * lag)
    return np.ascontiguousarray(late, dtype=np.complex64)


def _minima(
    tried: NDArray[np.float64], left: NDArray[np.float64], waves: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return where each tile leaves least, the standard deviation of it, and what is left there.

    ``left``: squares that are left at the inverse depths that were tried, shape (candidates, n); ``waves``: number of
    the waves that they are the sum of. Noise of the variance s² in each wave leaves ``waves`` s², so that the negative
    logarithm of the likelihood is the squares divided by s², apart from what the errors of waves have in common.
    """
    finer = np.linspace(tried[0], tried[-1], FINER * (len(tried) - 1) + 1)
    spline = CubicSpline(tried, left)
    fine = spline(finer)
    place = fine.argmin(axis=0)
    tile = np.arange(left.shape[1])
    lowest = fine[place, tile]
    bend = spline(finer, 2)[place, tile]
    variance = lowest * CORRELATED / waves / np.where(bend > 0.0, bend, np.nan)
    std = np.sqrt(variance)
    at_an_end = (place == 0) | (place == len(finer) - 1)
    std[at_an_end | np.isnan(std)] = np.inf
    return finer[place], std, lowest


def _nine_about(numbers: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the nine numbers about each place of a grid, shape (9, rows, columns); at its borders some twice."""
    padded = np.pad(numbers, 1, mode="edge")
    return sliding_window_view(padded, (3, 3)).transpose(2, 3, 0, 1).reshape(9, *numbers.shape)


def _nearest(middles: NDArray[np.float64], length: int) -> NDArray[np.intp]:
    """Return the number of the nearest of some middles for each pixel of a line."""
    return np.asarray(np.abs(np.arange(length)[:, None] - middles[None, :]).argmin(axis=1))
