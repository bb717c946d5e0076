"""Sums in phase and the picture from them by their definitions, in float64: no tiles, Bessel functions or orbits.

The sums of a known scene come from its brightness at the places where exact refraction shows it, over the angles of a
turn, by a Fourier transform over the angle. The picture is the least-squares solution over all pixels at once.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, lsqr

Places = NDArray[np.float64]
"""Places (x, y) [px], shape (..., 2)."""
Path = Callable[[Places, NDArray[np.float64]], Places]
"""Where pixels see the scene at angles [rad]."""


def places_over_turn(path: Path, width: int, height: int, angles: int) -> NDArray[np.float64]:
    """Return where each pixel sees the scene at evenly spaced angles of a turn, shape (angles, height, width, 2)."""
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([x, y], axis=2).reshape(-1, 2).astype(np.float64)
    turn = np.arange(angles) * (math.tau / angles)
    seen = [path(pixels, np.full(len(pixels), theta)) for theta in turn]
    return np.array(seen).reshape(angles, height, width, 2)


def sums_of_scene(brightness: NDArray[np.float64], harmonics: int) -> NDArray[np.complex128]:
    """Return the sums A_1, A_2, … of pixels whose log intensity over a turn is known, shape (harmonics, height, width).

    ``brightness`` has shape (angles, height, width) [thresholds]. A sum is i m times the Fourier coefficient.
    """
    coefficients = np.fft.fft(brightness, axis=0) / len(brightness)
    order = np.arange(1, harmonics + 1)[:, None, None]
    return 1j * order * coefficients[1 : harmonics + 1]


def picture_by_least_squares(
    sums: NDArray[np.complex128], places: NDArray[np.float64], damping: float, steps: int
) -> NDArray[np.float64]:
    """Return the log intensity whose sums are the given ones, by least squares over all harmonics and pixels.

    Between pixels the scene is interpolated linearly, beyond the image it is that of the border. ``places`` are from
    :func:`places_over_turn`.
    """
    harmonics, height, width = sums.shape
    angles = len(places)
    see = [_interpolation(place.reshape(-1, 2), width, height) for place in places]
    seen = sparse.vstack(see).tocsr()
    order = np.arange(1, harmonics + 1)[:, None]
    waves = 1j * order * np.exp(-1j * order * np.arange(angles) * (math.tau / angles)) / angles

    def forward(scene: NDArray[np.float64]) -> NDArray[np.float64]:
        values = waves @ (seen @ scene.ravel()).reshape(angles, -1)
        return np.concatenate([values.real.ravel(), values.imag.ravel()])

    def backward(values: NDArray[np.float64]) -> NDArray[np.float64]:
        real, imaginary = values.reshape(2, harmonics, -1)
        over_turn = (waves.conj().T @ (real + 1j * imaginary)).real
        return np.asarray(seen.T @ over_turn.ravel())

    pixels = width * height
    operator = LinearOperator((2 * harmonics * pixels, pixels), forward, rmatvec=backward)
    wanted = np.concatenate([sums.real.ravel(), sums.imag.ravel()])
    found = lsqr(operator, wanted, damp=damping, iter_lim=steps)[0]
    return np.asarray(found).reshape(height, width)


def _interpolation(places: Places, width: int, height: int) -> sparse.csr_matrix:
    """Return the matrix that interpolates an image linearly at places."""
    x = np.clip(places[:, 0], 0.0, width - 1.001)
    y = np.clip(places[:, 1], 0.0, height - 1.001)
    left = x.astype(int)
    top = y.astype(int)
    right = x - left
    low = y - top
    rows = np.arange(len(places))
    corner = top * width + left
    weights = [(1 - right) * (1 - low), right * (1 - low), (1 - right) * low, right * low]
    columns = [corner, corner + 1, corner + width, corner + width + 1]
    return sparse.csr_matrix(
        (np.concatenate(weights), (np.tile(rows, 4), np.concatenate(columns))),
        shape=(len(places), width * height),
    )
