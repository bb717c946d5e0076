"""Circle and radial circle models: rotations of the bearing vector, described by a few numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from amiwarp.kernels.radial_circle import RadialCircleParams
from amiwarp.kernels.refraction import CircleParams
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.parameter import PHASE, Parameter
from amiwarp.optics.models.structs import phase_values
from amiwarp.optics.prism import (
    FlatSide,
    NominalPrism,
    Plate,
    Prism,
    apex_from_deflection,
    as_wedge,
    check_index,
    check_phase,
    deflection_from_apex,
)
from amiwarp.schema.calls import guarded
from amiwarp.validation import choice, instance, real


class _DeflectionModel(Model):
    """Model that is sized by the deflection on the optical axis."""

    PARAMETERS = (Parameter("deflection", "rad"), PHASE)

    deflection: float
    flat_side: FlatSide

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        largest = math.nextafter(math.pi / 2.0, 0.0)
        hint = " rad; for a negative deflection, add pi to the phase"
        deflection = real(self.deflection, "deflection", 0.0, largest, hint)
        object.__setattr__(self, "deflection", deflection)
        object.__setattr__(self, "phase", check_phase(self.phase))
        object.__setattr__(self, "flat_side", choice(FlatSide, self.flat_side, "flat_side"))

    def _signed_deflection(self) -> float:
        """Return the deflection [rad], negative if the flat side points to the camera: kernels tell the side by it."""
        return self.deflection if self.flat_side is FlatSide.SCENE else -self.deflection

    @classmethod
    def size_from_apex(cls, apex: float, prism: NominalPrism) -> float:
        return deflection_from_apex(apex, prism.index, as_wedge(prism).flat_side)

    @classmethod
    def apex_from_size(cls, size: float, prism: NominalPrism) -> float:
        return apex_from_deflection(size, prism.index, as_wedge(prism).flat_side)


@guarded
@dataclass(frozen=True)
class CircleModel(_DeflectionModel):
    """Circle model: rotates every bearing vector by one constant angle.

    Raises
    ------
    AmiwarpError
        If the deflection is not at least 0 and below pi/2, or another field has an unusable value.

    Notes
    -----
    The rotation axis is z × w, with z the optical axis and w = (cos φ, sin φ) the direction of the prism's tilt at
    φ = θ + θ_b. See ``docs/explanation/optics.md``.

    Examples
    --------
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.CircleModel(camera, deflection=0.02)
    >>> model.compensate_points(np.array([[320.0, 240.0]]), np.array([0.0])).round(2)
    array([[330., 240.]])
    """

    NAME = "circle"
    TEXT = "circle"
    NUMBERS = "2"
    STRUCT = CircleParams
    SIMPLIFIES = "radial"

    camera: Camera
    """Camera intrinsics."""
    deflection: float
    """Angle of the rotation [rad], not negative."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    flat_side: FlatSide = FlatSide.SCENE
    """Side that the prism's flat face points to: scene or camera."""

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        return cls(camera, values["deflection"], values["phase"], as_wedge(prism).flat_side)

    def kernel_values(self) -> tuple[Any, ...]:
        sine = math.sin(self._signed_deflection())
        versine = 2.0 * math.sin(self.deflection / 2.0) ** 2
        return sine, versine, *phase_values(self.phase)


@guarded
@dataclass(frozen=True)
class RadialCircleModel(_DeflectionModel):
    """Radial circle model: rotates each bearing vector by an angle that grows away from the optical axis.

    Raises
    ------
    AmiwarpError
        If the deflection is not at least 0 and below pi/2, or another field has an unusable value.

    Notes
    -----
    The angle is δ(φ) = δ₀ (√(n² − sin²φ)/cos φ − 1)/(n − 1), derived in ``docs/explanation/optics.md``. φ is the angle
    between the optical axis and the bearing on the side of the tilted face. This is the observed bearing if the flat
    face points to the scene, and the scene's bearing if it points to the camera. With the other bearing the model would
    lose its accuracy, which is almost second order in the apex angle.

    Examples
    --------
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.RadialCircleModel.from_prism(camera, amiwarp.Prism(apex=0.03), phase=0.5)
    >>> round(model.deflection, 4)
    0.0155
    """

    NAME = "radial"
    TEXT = "radial"
    NUMBERS = "2, index given"
    STRUCT = RadialCircleParams
    SIMPLIFIES = "exact"

    camera: Camera
    """Camera intrinsics."""
    deflection: float
    """Angle of the rotation on the optical axis, δ₀ [rad], not negative."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    index: float = 1.5168
    """Refractive index n of the prism."""
    flat_side: FlatSide = FlatSide.SCENE
    """Side that the prism's flat face points to: scene or camera."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "index", check_index(self.index, "index"))

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        flat_side = as_wedge(prism).flat_side
        return cls(camera, values["deflection"], values["phase"], prism.index, flat_side)

    def kernel_values(self) -> tuple[Any, ...]:
        return self._signed_deflection(), *phase_values(self.phase), self.index
