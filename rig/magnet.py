"""What an AS5047P reads of a magnet that does not stand on its axis.

The chip has four Hall elements on a circle of 1.1 mm, which measure the field Bz along the axis, and takes the angle
of the two differences, X = Bz(+x) - Bz(-x) and Y = Bz(+y) - Bz(-y). A magnet that is magnetised across its diameter
has, in a plane above it, Bz = f(ρ) cos(φ - θ) with the angle θ of the magnet (the charges of its cylinder faces are
proportional to the cosine of the angle). On the axis f is proportional to ρ, and X and Y are cosine and sine of θ. At a
distance ρ from the axis, the differences along the radius and across it have the factors f'(ρ) and f(ρ) / ρ instead.
With k = ρ f' / f the angle is atan2(sin θ, k cos θ): off by up to asin((1 - |k|) / (1 + |k|)) twice a turn, and
backwards where k is negative, beyond the largest field.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

HALL = 1.1
"""Radius of the circle of the Hall elements [mm]."""


@dataclass(frozen=True)
class Magnet:
    """Magnet that is magnetised across its diameter: a ring, or a disc without a bore [mm]."""

    outer: float
    inner: float
    height: float


DISC = Magnet(3.0, 0.0, 2.0)
"""The magnet of the encoder shaft, radii and height [mm]."""


def field(
    magnet: Magnet, x: NDArray[np.float64], y: NDArray[np.float64], gap: float, theta: float
) -> NDArray[np.float64]:
    """Return Bz in a plane in front of a magnet, in units of μ₀ M / 4π.

    The charge of a cylinder face, M cos φ for the outer one and -M cos φ for the bore, is integrated along z exactly:
    the integral of (z - z') / |r - r'|³ over z' is the difference of 1 / |r - r'| between the two rims.

    Parameters
    ----------
    x, y : NDArray
        Places in the plane [mm], same shape.
    gap : float
        Distance of the plane from the magnet's face [mm].
    theta : float
        Angle of the magnet [rad].
    """
    turn = np.arange(720) * math.tau / 720
    out = np.zeros(np.shape(x))
    for radius, sign in ((magnet.outer, 1.0), (magnet.inner, -1.0)):
        charge = sign * radius * math.tau / 720 * np.cos(turn - theta)
        flat = (x[..., None] - radius * np.cos(turn)) ** 2 + (
            y[..., None] - radius * np.sin(turn)
        ) ** 2
        near, far = (1.0 / np.sqrt(flat + depth**2) for depth in (gap, gap + magnet.height))
        out += (near - far) @ charge
    return out


def reading(
    magnet: Magnet, off: float, gap: float, thetas: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the angles that a chip reads [rad] whose middle is ``off`` [mm] beside the magnet's axis, along x."""
    x = off + HALL * np.array([1.0, -1.0, 0.0, 0.0])
    y = HALL * np.array([0.0, 0.0, 1.0, -1.0])
    found = []
    for theta in thetas:
        east, west, north, south = field(magnet, x, y, gap, float(theta))
        found.append(math.atan2(north - south, east - west))
    return np.unwrap(np.array(found))


def largest_error(magnet: Magnet, off: float, gap: float) -> float:
    """Return the largest error of the angle over a turn [rad], besides a constant; infinite if it runs backwards."""
    thetas = np.arange(90) * math.tau / 90
    read = reading(magnet, off, gap, thetas)
    if np.any(np.diff(read) <= 0.0):
        return math.inf
    error = read - thetas
    return float(error.max() - error.min()) / 2.0


def around_shaft(bore: float) -> tuple[float, float]:
    """Return the place beside the axis [mm], outside a hollow shaft, where a chip errs least, and the error [rad].

    The magnet is a ring of 3 x 3 mm around the bore [mm], the chip lies 1 mm in front of it or beyond its rim.
    """
    magnet = Magnet(bore / 2 + 4.0, bore / 2 + 1.0, 3.0)
    places = np.arange(bore / 2 + 1.0, bore / 2 + 15.0, 0.5)
    errors = [largest_error(magnet, float(off), 1.0) for off in places]
    best = int(np.argmin(errors))
    return float(places[best]), errors[best]
