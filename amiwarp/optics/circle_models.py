"""Circle and radial circle models: rotations of the bearing vector, described by a few numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from amiwarp.kernels.refraction import CircleParams, RadialCircleParams
from amiwarp.optics.camera import Camera
from amiwarp.optics.displacement import PointDisplacement, phase_values, struct_of
from amiwarp.optics.prism import FlatSide, Prism, check_index, check_phase
from amiwarp.validation import choice, guarded, instance, real


@guarded
@dataclass(frozen=True)
class CircleModel(PointDisplacement):
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

    FREE: ClassVar[tuple[str, ...]] = ("deflection", "phase")
    """Names of the parameters that a calibration can find."""
    camera: Camera
    """Camera intrinsics."""
    deflection: float
    """Angle of the rotation [rad], not negative."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    flat_side: FlatSide = FlatSide.SCENE
    """Side that the prism's flat face points to: scene or camera."""

    def __post_init__(self) -> None:
        _check_circle(self)

    @classmethod
    def from_prism(cls, camera: Camera, prism: Prism, phase: float = 0.0) -> CircleModel:
        """Create the circle model that is exact on the optical axis.

        Parameters
        ----------
        camera : Camera
            The camera.
        prism : Prism
            The prism.
        phase : float, default 0.0
            Added to the encoder's angle [rad].

        Returns
        -------
        CircleModel
            The model with the prism's deflection.
        """
        return cls(camera, prism.deflection, phase, prism.flat_side)

    def params(self, device: Any) -> Any:
        """Return the parameters for kernels.

        Parameters
        ----------
        device : str or warp.Device
            The device that runs the kernels.

        Returns
        -------
        amiwarp.kernels.refraction.CircleParams
            Deflection and phase as a Warp struct.
        """
        return struct_of(CircleParams, self.kernel_values())

    def kernel_values(self) -> tuple[Any, ...]:
        """Return the values of the parameters for kernels, in the order of the fields of their struct.

        Returns
        -------
        tuple
            The fields of :class:`amiwarp.kernels.refraction.CircleParams`.
        """
        sine = math.sin(self.deflection if self.flat_side is FlatSide.SCENE else -self.deflection)
        return sine, 2.0 * math.sin(self.deflection / 2.0) ** 2, *phase_values(self.phase)


@guarded
@dataclass(frozen=True)
class RadialCircleModel(PointDisplacement):
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

    FREE: ClassVar[tuple[str, ...]] = ("deflection", "phase")
    """Names of the parameters that a calibration can find."""
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
        _check_circle(self)
        object.__setattr__(self, "index", check_index(self.index, "index"))

    @classmethod
    def from_prism(cls, camera: Camera, prism: Prism, phase: float = 0.0) -> RadialCircleModel:
        """Create the model of a prism.

        Parameters
        ----------
        camera : Camera
            The camera.
        prism : Prism
            The prism.
        phase : float, default 0.0
            Added to the encoder's angle [rad].

        Returns
        -------
        RadialCircleModel
            The model with the deflection and index of the prism.
        """
        return cls(camera, prism.deflection, phase, prism.index, prism.flat_side)

    def params(self, device: Any) -> Any:
        """Return the parameters for kernels.

        Parameters
        ----------
        device : str or warp.Device
            The device that runs the kernels.

        Returns
        -------
        amiwarp.kernels.refraction.RadialCircleParams
            Deflection, phase and index as a Warp struct.
        """
        return struct_of(RadialCircleParams, self.kernel_values())

    def kernel_values(self) -> tuple[Any, ...]:
        """Return the values of the parameters for kernels, in the order of the fields of their struct.

        Returns
        -------
        tuple
            The fields of :class:`amiwarp.kernels.refraction.RadialCircleParams`.
        """
        deflection = self.deflection if self.flat_side is FlatSide.SCENE else -self.deflection
        return deflection, *phase_values(self.phase), self.index


def _check_circle(model: CircleModel | RadialCircleModel) -> None:
    """Check and convert the fields that both circle models share."""
    instance(model.camera, Camera, "camera")
    below = math.nextafter(math.pi / 2.0, 0.0)
    hint = " rad; for a negative deflection, add pi to the phase"
    object.__setattr__(model, "deflection", real(model.deflection, "deflection", 0.0, below, hint))
    object.__setattr__(model, "phase", check_phase(model.phase))
    object.__setattr__(model, "flat_side", choice(FlatSide, model.flat_side, "flat_side"))
