"""A beam steerer of two deflectors in front of the camera, such as electro-optic ones, moved by two commands.

The formula is in ``docs/explanation/optics.md``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels.steerer import SteererParams
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import two_commands
from amiwarp.optics.models.angles import both_angles
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.structs import struct_of
from amiwarp.optics.models.two_commands import LARGEST_PX
from amiwarp.optics.prism import Plate, Prism
from amiwarp.schema.calls import guarded
from amiwarp.validation import instance, one_of

LARGEST_DEFLECTION = 0.2
"""Upper limit of the amplitude of a deflector [rad]. Larger values are mistakes, such as angles in degrees."""
START_DEFLECTION = math.radians(0.5)
"""Amplitude with which a search starts [rad]."""


@guarded
@dataclass(frozen=True)
class SteererModel(Model):
    """Beam steerer: two deflectors, each of which adds a vector to the transverse part of a ray's unit direction.

    Raises
    ------
    AmiwarpError
        If an amplitude is over 0.2 rad, or another field has an unusable value.

    Notes
    -----
    A linear phase gradient across the beam does this, as of an electro-optic or acousto-optic deflector, or of a
    liquid-crystal grating. Each moves the middle of the image along its ``direction``, by up to ``amplitude``, as the
    cosine of the angle of its command says. See ``docs/explanation/optics.md``.

    Examples
    --------
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.SteererModel(camera, amplitude=0.02)
    >>> model.compensate_points(np.array([[320.0, 240.0]]), np.array([[0.0, 0.0]])).round(2)
    array([[310., 240.]])
    """

    NAME = "steerer"
    TEXT = "beam steerer of two deflectors"
    NUMBERS = "6"
    STRUCT = SteererParams
    ANGLES = 2
    PARAMETERS = two_commands.PARAMETERS
    ORBITS = two_commands.ORBITS
    TOGETHER = two_commands.TOGETHER
    FREED = two_commands.FREED
    PRISM = False
    MOVER = "beam steerer"
    SIZE_HINT = f"{LARGEST_PX:g} px"
    SECTORS = 8  # few events come where a command turns back

    camera: Camera
    """Camera intrinsics."""
    amplitude: float
    """Largest deflection by the first deflector, at the middle of the image [rad]."""
    phase: float = 0.0
    """Phase of the first deflector, added to the angle of its command [rad]."""
    second_amplitude: float = 0.0
    """Largest deflection by the second deflector, at the middle of the image [rad]."""
    second_phase: float = 0.0
    """Phase of the second deflector [rad]."""
    ratio: float = 0.0
    """Speed of the second command's angle relative to the first, which tells the second angle where one is given."""
    direction: float = 0.0
    """Direction in the image along which the first deflector moves it, from x towards y [rad]."""
    second_direction: float = 0.5 * math.pi
    """Direction in the image along which the second deflector moves it [rad]."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        two_commands.check_motions(self, LARGEST_DEFLECTION)

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        return cls(camera, **{name: value for name, value in values.items() if name in cls.FREE})

    @classmethod
    def start_values(cls, prism: Prism | Plate) -> dict[str, float]:
        return {
            **dict.fromkeys(cls.FREE, 0.0),
            "amplitude": START_DEFLECTION,
            "second_amplitude": START_DEFLECTION,
            "second_direction": 0.5 * math.pi,
        }

    @classmethod
    def default_bounds(
        cls, name: str, value: float, camera: Camera, prism: Prism | Plate
    ) -> tuple[float, float]:
        if one_of(name, cls.FREE, "name") in dict(cls.ORBITS):
            return 0.0, min(LARGEST_PX / camera.fx, LARGEST_DEFLECTION)
        return super().default_bounds(name, value, camera, prism)

    @classmethod
    def freed(cls, ratio: float | None) -> tuple[str, ...]:
        return two_commands.freed_at(ratio, cls.FREED)

    def singles(self) -> tuple[SteererModel, SteererModel]:
        return replace(self, second_amplitude=0.0), replace(self, amplitude=0.0, ratio=1.0)

    def all_angles(self, theta: NDArray[Any]) -> NDArray[np.float64]:
        return both_angles(theta, self.ratio)

    @property
    def vectors(self) -> NDArray[np.float64]:
        """What both deflectors add to x and y of an observed unit direction at commands of 1, shape (2, 2)."""
        directions = np.array([self.direction, self.second_direction])
        sines = np.sin([self.amplitude, self.second_amplitude])
        return sines[:, None] * np.stack([np.cos(directions), np.sin(directions)], axis=1)

    def added(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what the deflectors add to observed unit directions, in float64 on the host.

        Parameters
        ----------
        theta : numpy.ndarray
            Angles of both commands [rad], shape (n, 2).

        Returns
        -------
        numpy.ndarray
            Vectors that are added to x and y of the directions, shape (n, 2); NaN for angles that are NaN or infinite.

        Raises
        ------
        AmiwarpError
            If ``theta`` has another shape.
        """
        cosines = two_commands.both_cosines(theta, self.phase, self.second_phase)
        return np.asarray(cosines @ self.vectors)

    def kernel_values(self) -> tuple[Any, ...]:
        return self.phase, self.second_phase, self.ratio, *self.vectors

    def params(self, device: Any) -> Any:
        *numbers, first, second = self.kernel_values()
        vectors = [wp.vec2(*first.tolist()), wp.vec2(*second.tolist())]
        return struct_of(SteererParams, [*numbers, *vectors])
