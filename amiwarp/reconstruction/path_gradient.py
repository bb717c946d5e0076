"""The long waves of a scene from sums in phase with any closed motion.

For waves that are long beside the motion, a sum in phase is A_m = c_m · g, with the gradient g of the scene and c_m =
i m times the Fourier coefficient of the motion. Least squares over all sums and pixels give the brightness whose
gradient fits them best. A motion along a line tells the gradient along it only; a little smoothness fills in the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from amiwarp.optics.models.base import Model
from amiwarp.optics.orbit import LockedAngles, grid_of_image, image_grid, paths_of, spread_over
from amiwarp.tasks import cpu_threads

LEAST_FACTOR = 0.1
"""Harmonics of the motion count whose factor is at least this, relative to the largest one."""
SMOOTHNESS = 0.05
"""Weight of the squared gradient, relative to what the sums tell of it: for directions in which nothing moves. With
0.01, noise across lines grows; with 0.3, pictures of circles lose."""
MOST_STEPS = 60
"""Largest number of steps of conjugate gradients."""
TOLERANCE = 1e-3
"""Size of the residual at which they end, relative to the first one."""
ANGLES = 64
"""Number of angles at which the motion is computed."""

Image = NDArray[np.float32]


@dataclass(frozen=True)
class PathGradient:
    """How the sums of each pixel tell the gradient."""

    orders: NDArray[np.int64]
    """Harmonics that count, shape (n,)."""
    factors: NDArray[np.complex64]
    """Factors c_m [px] of the gradient along x and along y, shape (n, 2, height, width)."""
    metric: Image
    """Sum of their squares: along x, mixed, along y, with the smoothness [px²], shape (3, height, width)."""

    def told(self, values: NDArray[np.complex64], lag: float) -> Image:
        """Return the gradient that sums tell, times :attr:`metric` [thresholds px], shape (2, height, width).

        ``lag`` is the angle by which the optic has turned on before an event is seen [rad].
        """
        found = np.zeros(self.factors.shape[1:], np.float32)
        for order, factor in zip(self.orders, self.factors, strict=True):
            turn = np.complex64(np.exp(1j * order * lag))
            found += (factor.conj() * (turn * values[order - 1])).real
        return found

    def brightness(self, told: Image) -> Image:
        """Return the brightness whose gradient fits best, by conjugate gradients on all pixels [thresholds]."""
        xx, xy, yy = self.metric
        scale = float(0.5 * (xx + yy).mean())

        # Between pixels along rows and columns; at pixels, the mixed part alone would leave patterns of single pixels.
        between_x = 0.5 * (xx[:, 1:] + xx[:, :-1])
        between_y = 0.5 * (yy[1:] + yy[:-1])

        def product(picture: Image) -> Image:
            x, y = _slopes(picture)
            out = _divergence(xy * y, xy * x)
            _add_ends(
                out, between_x * np.diff(picture, axis=1), between_y * np.diff(picture, axis=0)
            )
            return out

        found = np.zeros(told.shape[1:], np.float32)
        left = _divergence(told[0], told[1])
        step = _by_poisson(left) / scale
        direction = step
        size = float((left * step).sum(dtype=np.float64))
        end = TOLERANCE**2 * size
        for _ in range(MOST_STEPS):
            if size <= end:
                break
            moved = product(direction)
            share = size / float((direction * moved).sum(dtype=np.float64))
            found += np.float32(share) * direction
            left -= np.float32(share) * moved
            step = _by_poisson(left) / scale
            before = size
            size = float((left * step).sum(dtype=np.float64))
            direction = step + np.float32(size / before) * direction
        return found


@lru_cache(maxsize=4)
def path_gradient_of(model: Model, locked: LockedAngles | None, harmonics: int) -> PathGradient:
    """Return how the sums of each pixel tell the gradient. Motions are interpolated between some pixels."""
    columns, rows = grid_of_image(model.camera)
    paths = paths_of(model, image_grid(model.camera, columns, rows), ANGLES, locked)
    along = [scipy.fft.fft(part, axis=1) / ANGLES for part in (paths.real, paths.imag)]
    most = min(harmonics, ANGLES // 2 - 1)
    every = 1j * np.arange(1, most + 1) * np.stack(along)[:, :, 1 : most + 1]
    size = np.abs(every).max(axis=(0, 1))
    orders = 1 + np.flatnonzero(size >= LEAST_FACTOR * size.max())
    factors = np.stack(
        [
            [spread_over(model.camera, axis[:, order - 1], columns, rows) for axis in every]
            for order in orders
        ]
    )
    x = factors[:, 0]
    y = factors[:, 1]
    metric = np.stack(
        [
            (np.abs(x) ** 2).sum(axis=0),
            (x.conj() * y).real.sum(axis=0),
            (np.abs(y) ** 2).sum(axis=0),
        ]
    )
    smooth = SMOOTHNESS * 0.5 * float((metric[0] + metric[2]).mean())
    metric[[0, 2]] += smooth
    return PathGradient(orders, factors.astype(np.complex64), metric.astype(np.float32))


def _slopes(picture: Image) -> tuple[Image, Image]:
    """Return the slopes of a picture at its pixels along x and y, without slope over the border."""
    x = np.diff(picture, axis=1, prepend=picture[:, :1], append=picture[:, -1:])
    y = np.diff(picture, axis=0, prepend=picture[:1], append=picture[-1:])
    return 0.5 * (x[:, 1:] + x[:, :-1]), 0.5 * (y[1:] + y[:-1])


def _divergence(x: Image, y: Image) -> Image:
    """Return the transpose of :func:`_slopes`: minus the divergence of a flow, which ends at the border."""
    found = np.zeros_like(x)
    _add_ends(found, 0.5 * (x[:, 1:] + x[:, :-1]), 0.5 * (y[1:] + y[:-1]))
    return found


def _add_ends(picture: Image, between_x: Image, between_y: Image) -> None:
    """Add flows between pixels to the pixels where they end, and subtract them where they begin."""
    picture[:, 1:] += between_x
    picture[:, :-1] -= between_x
    picture[1:] += between_y
    picture[:-1] -= between_y


def _by_poisson(flow: Image) -> Image:
    """Return the picture without mean whose even diffusion makes a flow."""
    waves = scipy.fft.dctn(flow, workers=cpu_threads())
    waves *= _inverse_laplace(*flow.shape)
    return np.asarray(scipy.fft.idctn(waves, workers=cpu_threads(), overwrite_x=True))


@lru_cache(maxsize=4)
def _inverse_laplace(height: int, width: int) -> Image:
    """Return one over the Laplacian of each cosine wave of an image; 0 for its mean."""
    kx = math.pi * np.arange(width) / width
    ky = math.pi * np.arange(height) / height
    laplace = 4.0 * (np.sin(0.5 * kx[None, :]) ** 2 + np.sin(0.5 * ky[:, None]) ** 2)
    laplace[0, 0] = np.inf
    return (1.0 / laplace).astype(np.float32)
