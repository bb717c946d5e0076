"""The wedge prism itself: apex, glass, the side of its flat face, and what it deflects."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import TypeAlias

from amiwarp.errors import AmiwarpError
from amiwarp.validation import choice, real, vector

LARGEST_APEX = math.radians(30.0)
"""Apex angle from which on a value must be a mistake [rad]."""
LARGEST_INDEX = 4.0
"""Refractive index up to which prisms are made: germanium."""
LARGEST_PHASE = 1e6
"""Largest magnitude of a phase [rad]: float64 then still resolves 1e-10 rad of it."""


class FlatSide(enum.StrEnum):
    """Which way the flat face of the prism looks."""

    SCENE = "scene"
    CAMERA = "camera"


@dataclass(frozen=True, slots=True)
class Prism:
    """A wedge prism in air: apex in 0 .. 30 deg, index in 1 .. 4, the upper limits not included.

    ``flat_side`` may be given as its name. Raises :class:`AmiwarpError` for anything else.
    """

    apex: float
    """Angle between its two faces [rad]; not the deflection (see :func:`deflection_from_apex`)."""
    index: float = 1.5168
    """Refractive index; the default is N-BK7 at the d line, 587.6 nm."""
    flat_side: FlatSide = FlatSide.SCENE
    """Where the flat face looks."""

    def __post_init__(self) -> None:
        below = math.nextafter(LARGEST_APEX, 0.0)
        hint = " rad, 0 .. 30 deg; is it given in degrees?"
        object.__setattr__(self, "apex", real(self.apex, "prism apex", 0.0, below, hint))
        object.__setattr__(self, "index", check_index(self.index, "prism index"))
        object.__setattr__(self, "flat_side", choice(FlatSide, self.flat_side, "prism flat_side"))

    @property
    def deflection(self) -> float:
        """Deflection of the ray that the camera sees on its axis [rad]."""
        return deflection_from_apex(self.apex, self.index, self.flat_side)


@dataclass(frozen=True, slots=True)
class UnsizedPrism:
    """What is known of a prism whose apex is not: its glass and the side of its flat face."""

    index: float = 1.5168
    """Refractive index; the default is N-BK7 at the d line, 587.6 nm."""
    flat_side: FlatSide = FlatSide.SCENE
    """Where the flat face looks."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "index", check_index(self.index, "prism index"))
        object.__setattr__(self, "flat_side", choice(FlatSide, self.flat_side, "prism flat_side"))

    def with_apex(self, apex: float) -> Prism:
        """Return the prism of this glass with an ``apex`` [rad]."""
        return Prism(apex, self.index, self.flat_side)


NominalPrism: TypeAlias = Prism | UnsizedPrism
"""What is known of a prism before a calibration: all of it, or all but its apex."""


def deflection_from_apex(apex: float, index: float, flat_side: FlatSide = FlatSide.SCENE) -> float:
    """Deflection [rad] of the camera's axial ray by a wedge of ``apex`` [rad]; about ``(index - 1) * apex``.

    Snell's law at both faces in the plane of the wedge. Raises :class:`AmiwarpError` for total reflection.
    """
    scene = choice(FlatSide, flat_side, "flat_side") is FlatSide.SCENE
    # flat face to the scene: in through the tilted face, out through the flat one
    sine = index * math.sin(apex - math.asin(math.sin(apex) / index) if scene else apex)
    if not abs(sine) <= 1.0:
        raise AmiwarpError(
            f"an apex of {math.degrees(apex):.4g} deg with index {index:.4g} reflects the camera's axial ray; "
            "give a smaller apex or index"
        )
    return math.asin(sine) - (0.0 if scene else apex)


def apex_from_deflection(deflection: float, index: float, flat_side: FlatSide = FlatSide.SCENE) -> float:
    """Apex [rad] that deflects the camera's axial ray by ``deflection`` [rad].

    The inverse of :func:`deflection_from_apex`.
    """
    if choice(FlatSide, flat_side, "flat_side") is FlatSide.SCENE:
        return math.atan2(math.sin(deflection), math.sqrt(index**2 - math.sin(deflection) ** 2) - 1.0)
    return math.atan2(math.sin(deflection), index - math.cos(deflection))


def check_index(value: object, what: str) -> float:
    """A refractive index between 1 and :data:`LARGEST_INDEX`, neither included."""
    return real(value, what, math.nextafter(1.0, 2.0), math.nextafter(LARGEST_INDEX, 0.0), "; N-BK7 has 1.5168")


def check_phase(value: object, what: str = "phase") -> float:
    """Return a phase [rad]. Raises :class:`AmiwarpError`."""
    return real(value, what, -LARGEST_PHASE, LARGEST_PHASE, " rad")


def check_tilt(value: object) -> tuple[float, float]:
    """Return the two tilts of an axis of rotation [rad], each under a right angle. Raises :class:`AmiwarpError`."""
    below = math.nextafter(math.pi / 2.0, 0.0)
    x, y = vector(value, 2, "tilt", lambda entry, what: real(entry, what, -below, below, " rad"))
    return x, y
