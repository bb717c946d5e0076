"""The glass in front of the camera: a wedge prism, a pair of them or a plane-parallel plate, and a wedge's deflection.

This is the glass only. Its motion is measured by the encoder, :mod:`amiwarp.events.encoder`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias, overload

from amiwarp.errors import AmiwarpError, Option
from amiwarp.schema.calls import guarded
from amiwarp.validation import choice, instance, real, vector

LARGEST_APEX = math.radians(30.0)
"""Upper limit of the apex angle [rad]. Larger values are mistakes, such as angles in degrees."""
LARGEST_INDEX = 4.0
"""Upper limit of the refractive index: the index of germanium."""
LARGEST_THICKNESS = 0.2
"""Upper limit of a plate's thickness [m]. Larger values are mistakes, such as millimetres."""
STEEPEST_TILT = math.radians(80.0)
"""Upper limit of a plate's tilt [rad]. Larger values are mistakes, such as angles in degrees."""
LARGEST_PHASE = 1e6
"""Largest accepted magnitude of a phase [rad]. Up to this phase float64 resolves 1e-10 rad."""
_BELOW_LARGEST_APEX = math.nextafter(LARGEST_APEX, 0.0)
_ABOVE_ONE = math.nextafter(1.0, 2.0)
_BELOW_LARGEST_INDEX = math.nextafter(LARGEST_INDEX, 0.0)
_BELOW_RIGHT_ANGLE = math.nextafter(math.pi / 2.0, 0.0)


class FlatSide(Option):
    """The side that the flat face of the prism points to."""

    SCENE = "scene"
    """The flat face points to the scene."""
    CAMERA = "camera"
    """The flat face points to the camera."""


@guarded
@dataclass(frozen=True, slots=True)
class Prism:
    """Wedge prism in air, given by its apex angle, refractive index and flat side.

    Raises
    ------
    AmiwarpError
        If the apex angle is not at least 0 and below 30 deg, the index is not between 1 and 4 (both excluded), or
        ``flat_side`` is neither a :class:`FlatSide` nor its name.

    Examples
    --------
    >>> import math
    >>> prism = amiwarp.Prism(apex=math.radians(2.0), index=1.5)
    >>> round(math.degrees(prism.deflection), 3)
    1.0
    """

    apex: float
    """Angle between the two faces [rad]. It differs from the deflection (see :attr:`deflection`)."""
    index: float = 1.5168
    """Refractive index. The default is the index of N-BK7 at the d line, 587.6 nm."""
    flat_side: FlatSide = FlatSide.SCENE
    """Side that the flat face points to."""
    second: Prism | None = None
    """Second prism of a pair (Risley pair), behind this one as seen from the camera; None for one prism."""

    def __post_init__(self) -> None:
        if self.second is not None:
            second = instance(self.second, Prism, "prism second")
            if second.second is not None:
                raise AmiwarpError(
                    "prism second: it has a second prism itself; a pair has two prisms"
                )
        hint = " rad, 0 .. 30 deg; is it given in degrees?"
        object.__setattr__(
            self, "apex", real(self.apex, "prism apex", 0.0, _BELOW_LARGEST_APEX, hint)
        )
        object.__setattr__(self, "index", check_index(self.index, "prism index"))
        object.__setattr__(self, "flat_side", choice(FlatSide, self.flat_side, "prism flat_side"))

    @property
    def deflection(self) -> float:
        """Deflection of the ray on the camera's optical axis by this prism [rad]."""
        return deflection_from_apex(self.apex, self.index, self.flat_side)


@guarded
@dataclass(frozen=True, slots=True)
class UnsizedPrism:
    """A prism of unknown apex angle: its refractive index and the side of its flat face.

    Examples
    --------
    >>> amiwarp.UnsizedPrism(index=1.5).with_apex(0.03)
    Prism(apex=0.03, index=1.5, flat_side=<FlatSide.SCENE: 'scene'>, second=None)
    """

    index: float = 1.5168
    """Refractive index. The default is the index of N-BK7 at the d line, 587.6 nm."""
    flat_side: FlatSide = FlatSide.SCENE
    """Side that the flat face points to."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "index", check_index(self.index, "prism index"))
        object.__setattr__(self, "flat_side", choice(FlatSide, self.flat_side, "prism flat_side"))

    def with_apex(self, apex: float) -> Prism:
        """Return a prism with this index and flat side, and a given apex angle.

        Parameters
        ----------
        apex : float
            Apex angle [rad].

        Returns
        -------
        Prism
            The prism.
        """
        return Prism(apex, self.index, self.flat_side)


@guarded
@dataclass(frozen=True, slots=True)
class Plate:
    """Plane-parallel plate in air that rotates about the optical axis, given by thickness, tilt and refractive index.

    Raises
    ------
    AmiwarpError
        If the thickness is not between 0 and 0.2 m, the tilt not between 0 and 80 deg, or the index not between 1 and 4
        (both excluded).

    Examples
    --------
    >>> import math
    >>> plate = amiwarp.Plate(thickness=0.01, tilt=math.radians(45.0))
    >>> round(1e3 * plate.shift, 2)
    3.34
    """

    thickness: float
    """Distance between the two faces [m]."""
    tilt: float
    """Angle between the normal of the faces and the rotation axis [rad]."""
    index: float = 1.5168
    """Refractive index. The default is the index of N-BK7 at the d line, 587.6 nm."""

    def __post_init__(self) -> None:
        hint = " m; is it given in millimetres?"
        thickness = real(self.thickness, "plate thickness", 0.0, LARGEST_THICKNESS, hint)
        object.__setattr__(self, "thickness", thickness)
        hint = " rad, 0 .. 80 deg; is it given in degrees?"
        object.__setattr__(self, "tilt", real(self.tilt, "plate tilt", 0.0, STEEPEST_TILT, hint))
        object.__setattr__(self, "index", check_index(self.index, "plate index"))

    @property
    def shift(self) -> float:
        """Distance by which the plate shifts the ray on the camera's optical axis [m].

        That is t sin α (1 − cos α / √(n² − sin² α)) for thickness t, tilt α and index n.
        """
        sine = math.sin(self.tilt)
        cosine = math.cos(self.tilt)
        return self.thickness * sine * (1.0 - cosine / math.sqrt(self.index**2 - sine**2))


NominalPrism: TypeAlias = Prism | UnsizedPrism | Plate
"""Nominal glass before calibration: a prism, with or without a known apex angle, or a plate."""


@overload
def as_wedge(prism: Prism | Plate) -> Prism: ...


@overload
def as_wedge(prism: NominalPrism) -> Prism | UnsizedPrism: ...


def as_wedge(prism: NominalPrism) -> Prism | UnsizedPrism:
    """Return the prism if it is a wedge; raise :class:`AmiwarpError` for a plate."""
    if isinstance(prism, Plate):
        raise AmiwarpError(
            "the glass is a plane-parallel plate, but this works with a wedge prism; give a prism"
        )
    return prism


@guarded
def deflection_from_apex(apex: float, index: float, flat_side: FlatSide = FlatSide.SCENE) -> float:
    """Return the deflection of the camera's axial ray by a wedge, about ``(index - 1) * apex``.

    Parameters
    ----------
    apex : float
        Apex angle [rad].
    index : float
        Refractive index.
    flat_side : FlatSide or str, optional
        Side that the flat face looks to.

    Returns
    -------
    float
        Deflection [rad].

    Raises
    ------
    AmiwarpError
        If the ray is totally reflected.

    Notes
    -----
    Snell's law at both faces, in the plane of the wedge.

    Examples
    --------
    >>> round(amiwarp.deflection_from_apex(0.02, 1.5168), 6)
    0.010337
    """
    flat_to_scene = choice(FlatSide, flat_side, "flat_side") is FlatSide.SCENE
    index = check_index(index, "index")
    # The ray starts at the camera. With the flat face to the scene it enters the tilted face and leaves the flat one;
    # else it enters the flat face straight. ``incidence`` is its angle inside, to the normal of the face it leaves.
    incidence = apex
    if flat_to_scene:
        incidence = apex - math.asin(math.sin(apex) / index)
    sine = index * math.sin(incidence)
    if not abs(sine) <= 1.0:
        raise AmiwarpError(
            f"an apex of {math.degrees(apex):.4g} deg with index {index:.4g} totally reflects the camera's axial ray; "
            "give a smaller apex or index"
        )
    direction = math.asin(sine)  # to the normal of the face that the ray leaves
    return direction if flat_to_scene else direction - apex


@guarded
def apex_from_deflection(
    deflection: float, index: float, flat_side: FlatSide = FlatSide.SCENE
) -> float:
    """Return the apex angle for a deflection of the camera's axial ray.

    Inverse of :func:`deflection_from_apex`.

    Parameters
    ----------
    deflection : float
        Deflection [rad].
    index : float
        Refractive index.
    flat_side : FlatSide or str, optional
        Side that the flat face looks to.

    Returns
    -------
    float
        Apex angle [rad].

    Examples
    --------
    >>> round(amiwarp.apex_from_deflection(amiwarp.deflection_from_apex(0.02, 1.5168), 1.5168), 9)
    0.02
    """
    index = check_index(index, "index")
    if choice(FlatSide, flat_side, "flat_side") is FlatSide.SCENE:
        sine = math.sin(deflection)
        return math.atan2(sine, math.sqrt(index**2 - sine**2) - 1.0)
    return math.atan2(math.sin(deflection), index - math.cos(deflection))


def check_index(value: object, what: str) -> float:
    """Return ``value`` as a refractive index between 1 and :data:`LARGEST_INDEX`, both excluded.

    Raises :class:`AmiwarpError` for any other value.
    """
    return real(value, what, _ABOVE_ONE, _BELOW_LARGEST_INDEX, "; N-BK7 has 1.5168")


def check_phase(value: object, what: str = "phase") -> float:
    """Return ``value`` as a phase [rad]; raise :class:`AmiwarpError` if it is not finite or too large."""
    return real(value, what, -LARGEST_PHASE, LARGEST_PHASE, " rad")


def check_angles(value: object, what: str) -> tuple[float, float]:
    """Return two angles [rad], such as the tilts of a rotation axis, each below a right angle.

    Raises :class:`AmiwarpError` for others.
    """
    x, y = vector(value, 2, what, _acute)
    return x, y


def _acute(value: object, what: str) -> float:
    return real(value, what, -_BELOW_RIGHT_ANGLE, _BELOW_RIGHT_ANGLE, " rad")
