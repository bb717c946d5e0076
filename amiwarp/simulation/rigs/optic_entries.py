"""Optics in a rig's file: what moves the image of an event camera, by kind, with angles in degrees."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.optics.prism import FlatSide, Plate, Prism
from amiwarp.schema.records import at_field, build, check_given, fields_of
from amiwarp.simulation.choices import Optic
from amiwarp.simulation.motion import Mirror, PrismMotion, Steerer, Vibration
from amiwarp.validation import choice


def _radians(value: float, name: str) -> float:
    """Return degrees of a file as radians."""
    return math.radians(value)


Angle = Annotated[float, _radians]
"""Angle, in degrees in the file."""
Angles = tuple[Angle, Angle]
DEGREE = math.radians(1.0)
"""One degree [rad]."""


@dataclass(frozen=True)
class OpticOfCamera:
    """Optic in front of an event camera, with its motion."""

    prism: Prism | Plate | Vibration | Mirror | Steerer
    motion: PrismMotion
    nominal: Prism | None = None


@dataclass(frozen=True)
class WedgeEntry:
    """Fields of a rotating wedge, or of two with ``second_apex_deg``."""

    apex_deg: Angle = DEGREE
    nominal_apex_deg: Angle | None = None
    index: float = 1.5168
    flat_side: FlatSide = FlatSide.SCENE
    rpm: float = 720.0
    phase_deg: Angle = 0.0
    tilt_deg: Angles = (0.0, 0.0)
    cylinder_deg: Angles = (0.0, 0.0)
    wobble_deg: Angles = (0.0, 0.0)
    second_apex_deg: Angle | None = None
    second_rpm: float | None = None
    second_phase_deg: Angle | None = None

    def build(self) -> OpticOfCamera:
        """Return the prism, or the pair of prisms."""
        second = None
        second_motion = None
        if self.second_apex_deg is not None:
            second = self._glass(self.second_apex_deg)
            rpm = -self.rpm if self.second_rpm is None else self.second_rpm
            second_motion = PrismMotion(rpm, self.second_phase_deg or 0.0)
        elif (self.second_rpm, self.second_phase_deg) != (None, None):
            raise AmiwarpError(
                "second_rpm and second_phase_deg describe a second prism; give second_apex_deg",
                ErrorCode.FIELD,
            )
        motion = PrismMotion(
            self.rpm,
            self.phase_deg,
            self.tilt_deg,
            self.cylinder_deg,
            self.wobble_deg,
            second_motion,
        )
        nominal = None
        if self.nominal_apex_deg is not None:
            nominal = self._glass(self.nominal_apex_deg, second)
        return OpticOfCamera(self._glass(self.apex_deg, second), motion, nominal)

    def _glass(self, apex: float, second: Prism | None = None) -> Prism:
        """Return a prism with an apex angle [rad]."""
        return Prism(apex, self.index, self.flat_side, second)


@dataclass(frozen=True)
class PlateEntry:
    """Fields of a rotating tilted plate."""

    thickness_mm: float = 10.0
    plate_tilt_deg: Angle = 45.0 * DEGREE
    index: float = 1.5168
    rpm: float = 720.0
    phase_deg: Angle = 0.0

    def build(self) -> OpticOfCamera:
        """Return the plate."""
        plate = Plate(1e-3 * self.thickness_mm, self.plate_tilt_deg, self.index)
        return OpticOfCamera(plate, PrismMotion(self.rpm, self.phase_deg))


@dataclass(frozen=True)
class VibrationEntry:
    """Fields of a vibration of the camera itself."""

    hz: float = 100.0
    amplitude_deg: Angle = 0.4 * DEGREE
    phase_deg: Angle = 0.0
    backward_deg: Angles = (0.0, 0.0)
    roll_deg: Angles = (0.0, 0.0)

    def build(self) -> OpticOfCamera:
        """Return the vibration."""
        vibration = Vibration(
            self.hz, self.amplitude_deg, self.phase_deg, self.backward_deg, self.roll_deg
        )
        return OpticOfCamera(vibration, vibration.motion)


@dataclass(frozen=True)
class MirrorEntry:
    """Fields of a mirror with two tilts."""

    hz: tuple[float, float] = (60.0, 77.0)
    amplitude_deg: Angles = (0.5 * DEGREE, 0.5 * DEGREE)
    phase_deg: Angles = (0.0, 0.0)
    direction_deg: Angles = (0.0, 0.5 * math.pi)
    fold_deg: Angle = 0.0
    incidence_deg: Angle = 0.25 * math.pi

    def build(self) -> OpticOfCamera:
        """Return the mirror."""
        mirror = Mirror(
            self.hz,
            self.amplitude_deg,
            self.phase_deg,
            self.direction_deg,
            fold=self.fold_deg,
            incidence=self.incidence_deg,
        )
        return OpticOfCamera(mirror, mirror.motion)


@dataclass(frozen=True)
class SteererEntry:
    """Fields of a beam steerer of two deflectors."""

    hz: tuple[float, float] = (200.0, 247.0)
    amplitude_deg: Angles = (DEGREE, DEGREE)
    phase_deg: Angles = (0.0, 0.0)
    direction_deg: Angles = (0.0, 0.5 * math.pi)

    def build(self) -> OpticOfCamera:
        """Return the beam steerer."""
        steerer = Steerer(self.hz, self.amplitude_deg, self.phase_deg, self.direction_deg)
        return OpticOfCamera(steerer, steerer.motion)


_ENTRIES: dict[Optic, type[Any]] = {
    Optic.WEDGE: WedgeEntry,
    Optic.PLATE: PlateEntry,
    Optic.VIBRATION: VibrationEntry,
    Optic.MIRROR: MirrorEntry,
    Optic.STEERER: SteererEntry,
}


def read_optic(data: Any, where: str) -> OpticOfCamera:
    """Return the optic of a field: the name of its kind, or a table with the field ``kind`` and others by kind."""
    given = {"kind": data} if isinstance(data, str) else data
    if not isinstance(given, dict):
        fields_of(given, where)  # raises the error of a field that is no table
    check_given(given, where, "kind")
    kind = choice(Optic, given["kind"], f"field {where}.kind")
    rest = {name: value for name, value in given.items() if name != "kind"}
    entry = build(_ENTRIES[kind], rest, where)
    return at_field(where, entry.build)
