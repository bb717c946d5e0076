"""Models of lens distortion."""

from __future__ import annotations

from dataclasses import dataclass, fields

from amiwarp.validation import guarded, real

LARGEST_COEFFICIENT = 1e6
"""Largest accepted magnitude of a distortion coefficient. The coefficients of long lenses reach thousands."""


@guarded
@dataclass(frozen=True, slots=True)
class RadialTangential:
    """OpenCV's radial-tangential distortion. The coefficients are in OpenCV's order.

    Examples
    --------
    >>> amiwarp.RadialTangential(k1=-0.3, k2=0.1)
    RadialTangential(k1=-0.3, k2=0.1, p1=0.0, p2=0.0, k3=0.0)
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


def _check_coefficients(lens: Distortion) -> None:
    for field in fields(lens):
        what = f"camera distortion {field.name}"
        value = real(getattr(lens, field.name), what, -LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
        object.__setattr__(lens, field.name, value)
