"""Models of lens distortion."""

from __future__ import annotations

from dataclasses import dataclass, fields

from amiwarp.validation import real

LARGEST_COEFFICIENT = 1e6
"""Largest magnitude of a coefficient of distortion: those of long lenses run to thousands."""


@dataclass(frozen=True, slots=True)
class RadialTangential:
    """OpenCV's radial-tangential distortion, coefficients in its order k1, k2, p1, p2, k3."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        _check_coefficients(self)


@dataclass(frozen=True, slots=True)
class Fisheye:
    """OpenCV's fisheye (equidistant) distortion, coefficients k1 .. k4."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def __post_init__(self) -> None:
        _check_coefficients(self)


Distortion = RadialTangential | Fisheye


def _check_coefficients(lens: Distortion) -> None:
    for field in fields(lens):
        what = f"camera distortion {field.name}"
        value = real(getattr(lens, field.name), what, -LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
        object.__setattr__(lens, field.name, value)
