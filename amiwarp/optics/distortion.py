"""Models of lens distortion."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from amiwarp.errors import AmiwarpError
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, real, shown

LARGEST_COEFFICIENT = 1e6
"""Largest accepted magnitude of a distortion coefficient. The coefficients of long lenses reach thousands."""


@guarded
@dataclass(frozen=True, slots=True)
class RadialTangential:
    """OpenCV's radial-tangential distortion, also with its rational model. The coefficients are in OpenCV's order.

    The radial factor is (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶).

    Examples
    --------
    >>> amiwarp.RadialTangential(k1=-0.3, k2=0.1)
    RadialTangential(k1=-0.3, k2=0.1, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0)
    """

    k1: float = 0.0
    """Radial coefficient of r²."""
    k2: float = 0.0
    """Radial coefficient of r⁴."""
    p1: float = 0.0
    """First tangential coefficient."""
    p2: float = 0.0
    """Second tangential coefficient."""
    k3: float = 0.0
    """Radial coefficient of r⁶."""
    k4: float = 0.0
    """Coefficient of r² in the denominator."""
    k5: float = 0.0
    """Coefficient of r⁴ in the denominator."""
    k6: float = 0.0
    """Coefficient of r⁶ in the denominator."""

    def __post_init__(self) -> None:
        _check_coefficients(self)


@guarded
@dataclass(frozen=True, slots=True)
class Fisheye:
    """OpenCV's fisheye (equidistant) distortion.

    Examples
    --------
    >>> amiwarp.Fisheye(k1=0.02)
    Fisheye(k1=0.02, k2=0.0, k3=0.0, k4=0.0)
    """

    k1: float = 0.0
    """Coefficient of θ³, with θ the angle between the ray and the optical axis."""
    k2: float = 0.0
    """Coefficient of θ⁵."""
    k3: float = 0.0
    """Coefficient of θ⁷."""
    k4: float = 0.0
    """Coefficient of θ⁹."""

    def __post_init__(self) -> None:
        _check_coefficients(self)


Distortion = RadialTangential | Fisheye
DISTORTIONS: dict[str, type[RadialTangential] | type[Fisheye]] = {
    "radial_tangential": RadialTangential,
    "fisheye": Fisheye,
}
"""Distortion classes by their names in files and streams. The fields of a class are in the files' order."""
COEFFICIENTS = {"radial_tangential": (5, 8), "fisheye": (4,)}
"""Numbers of coefficients that files and streams hold for each distortion class."""
RATIONAL = ("k4", "k5", "k6")
"""Coefficients of :class:`RadialTangential` that files and arrays leave out if all are 0."""


def coefficients(lens: Distortion) -> dict[str, float]:
    """Return the coefficients of a lens by name, in the files' order."""
    given = asdict(lens)
    if isinstance(lens, RadialTangential) and not any(given[name] for name in RATIONAL):
        return {name: value for name, value in given.items() if name not in RATIONAL}
    return given


def _check_coefficients(lens: Distortion) -> None:
    for field in fields(lens):
        what = f"camera distortion {field.name}"
        value = real(getattr(lens, field.name), what, -LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
        object.__setattr__(lens, field.name, value)


OPENCV_COUNTS = (4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV's radial-tangential model can have."""


def opencv_distortion(dist: ArrayLike | None, *, fisheye: bool) -> Distortion | None:
    """Return the lens of OpenCV's coefficients, or None if it does not distort."""
    if dist is None:
        return Fisheye() if fisheye else None
    given = array(dist, "distortion coefficients").astype(np.float64)
    if given.size != max(given.shape, default=0):
        raise AmiwarpError(
            f"distortion coefficients have shape {given.shape}; expected (n,), (1, n) or (n, 1)"
        )
    values = given.ravel().tolist()
    count = len(values)
    if fisheye:
        if count != 4:
            raise AmiwarpError(
                f"a fisheye lens has {count} distortion coefficients; expected k1 k2 k3 k4"
            )
        return Fisheye(*values)
    if count not in OPENCV_COUNTS:
        raise AmiwarpError(
            f"the lens has {count} distortion coefficients; expected 4, 5 or 8 in OpenCV's order"
        )
    if any(values[8:]):
        raise AmiwarpError(
            f"distortion coefficients {shown(values)} go beyond k6; calibrate without the thin-prism and tilt models"
        )
    return RadialTangential(*values[:8]) if any(values) else None
