"""A mirror with two tilts in front of the camera, moved by commands that are cosines of two angles.

The formulas are in ``docs/explanation/optics.md``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels.mirror import MirrorParams
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import two_commands
from amiwarp.optics.models.angles import both_angles
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.parameter import Parameter
from amiwarp.optics.models.structs import struct_of
from amiwarp.optics.models.two_commands import LARGEST_PX
from amiwarp.optics.prism import Plate, Prism, check_phase
from amiwarp.schema.calls import guarded
from amiwarp.validation import instance, one_of, real

LARGEST_TILT = 0.2
"""Upper limit of the amplitude of a tilt [rad]. Larger values are mistakes, such as angles in degrees."""
START_TILT = math.radians(0.25)
"""Amplitude with which a search starts [rad]."""
INCIDENCE = math.radians(45.0)
"""Usual angle of incidence of the optical axis on the mirror [rad]."""
LARGEST_INCIDENCE = math.radians(80.0)
"""Upper limit of the angle of incidence [rad]."""


@guarded
@dataclass(frozen=True)
class MirrorModel(Model):
    """Mirror with two tilts: reflects each ray at the tilted mirror, seen from the image of the mirror at rest.

    Raises
    ------
    AmiwarpError
        If an amplitude is over 0.2 rad, or another field has an unusable value.

    Notes
    -----
    Each tilt moves the middle of the image along its ``direction``, by twice ``amplitude`` · cos(θ+phase). Its axis
    lies in the plane of the mirror, so that it turns the image about its middle too, unless it moves it along ``fold``.
    A mirror shows the scene mirrored along ``fold``, whatever its tilts; the compensated image stays so. See
    ``docs/explanation/optics.md``.

    Examples
    --------
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.MirrorModel(camera, amplitude=0.01)
    >>> model.compensate_points(np.array([[320.0, 240.0]]), np.array([[0.0, 0.0]])).round(2)
    array([[310., 240.]])
    """

    NAME = "mirror"
    TEXT = "mirror with two tilts"
    NUMBERS = "8"
    STRUCT = MirrorParams
    ANGLES = 2
    PARAMETERS = (
        *two_commands.PARAMETERS,
        Parameter("fold", "rad", math.pi, fine=True, period=math.tau),
        Parameter("incidence", "rad", limits=(0.0, math.degrees(LARGEST_INCIDENCE)), fine=True),
    )
    ORBITS = two_commands.ORBITS
    TOGETHER = two_commands.TOGETHER
    FREED = (*two_commands.FREED, "fold", "incidence")
    PRISM = False
    MOVER = "mirror"
    SIZE_HINT = f"{LARGEST_PX:g} px"
    SECTORS = 8  # few events come where a tilt turns back

    camera: Camera
    """Camera intrinsics."""
    amplitude: float
    """Amplitude of the first tilt, seen along the optical axis [rad]: half the largest angle by which it moves the
    middle of the image. A tilt of the mirror about an axis that is not perpendicular to the optical axis is larger."""
    phase: float = 0.0
    """Phase of the first tilt, added to the angle of its command [rad]."""
    second_amplitude: float = 0.0
    """Amplitude of the second tilt [rad]."""
    second_phase: float = 0.0
    """Phase of the second tilt [rad]."""
    ratio: float = 0.0
    """Speed of the second command's angle relative to the first, which tells the second angle where one is given."""
    direction: float = 0.0
    """Direction in the image along which the first tilt moves it, from x towards y [rad]."""
    second_direction: float = 0.5 * math.pi
    """Direction in the image along which the second tilt moves it [rad]."""
    fold: float = 0.0
    """Direction in the image in which the mirror folds the optical axis, from x towards y [rad]."""
    incidence: float = INCIDENCE
    """Angle of incidence of the optical axis on the mirror at rest [rad]."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        two_commands.check_motions(self, LARGEST_TILT)
        object.__setattr__(self, "fold", check_phase(self.fold, "fold"))
        incidence = real(self.incidence, "incidence", 0.0, LARGEST_INCIDENCE, " rad, 0 .. 80 deg")
        object.__setattr__(self, "incidence", incidence)

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        own_values = {name: value for name, value in values.items() if name in cls.FREE}
        return cls(camera, **own_values)

    @classmethod
    def start_values(cls, prism: Prism | Plate) -> dict[str, float]:
        return {
            **dict.fromkeys(cls.FREE, 0.0),
            "amplitude": START_TILT,
            "second_amplitude": START_TILT,
            "second_direction": 0.5 * math.pi,
            "incidence": INCIDENCE,
        }

    @classmethod
    def default_bounds(
        cls,
        name: str,
        value: float,
        camera: Camera,
        prism: Prism | Plate,
    ) -> tuple[float, float]:
        if one_of(name, cls.FREE, "name") in dict(cls.ORBITS):
            return 0.0, min(0.5 * LARGEST_PX / camera.fx, LARGEST_TILT)
        # Two mirrors of one tilt each do not turn the image about its middle, as one mirror at an incidence of 0.
        if name == "incidence":
            return 0.0, LARGEST_INCIDENCE
        return super().default_bounds(name, value, camera, prism)

    @classmethod
    def freed(cls, ratio: float | None) -> tuple[str, ...]:
        return two_commands.freed_at(ratio, cls.FREED)

    @classmethod
    def twin_values(cls, values: Mapping[str, float]) -> dict[str, float] | None:
        if "fold" not in values:
            return None
        # the opposite fold turns the image about its middle in the other sense
        opposite = math.remainder(values["fold"] + math.pi, math.tau)
        return {**values, "fold": opposite}

    def singles(self) -> tuple[MirrorModel, MirrorModel]:
        first = replace(self, second_amplitude=0.0)
        second = replace(self, amplitude=0.0, ratio=1.0)
        return first, second

    def all_angles(self, theta: NDArray[Any]) -> NDArray[np.float64]:
        return both_angles(theta, self.ratio)

    @property
    def axes(self) -> NDArray[np.float64]:
        """Axes of both tilts in the camera's frame, of length 1 across the optical axis, shape (2, 3)."""
        directions = np.array([self.direction, self.second_direction])
        x = -np.sin(directions)
        y = np.cos(directions)
        # So that the axis lies in the plane of the mirror
        along = math.tan(self.incidence) * np.sin(self.fold - directions)
        return np.stack([x, y, along], axis=1)

    @property
    def reflection(self) -> NDArray[np.float64]:
        """Matrix (3, 3) that mirrors directions along ``fold``, as every odd number of mirrors does."""
        along = np.array([math.cos(self.fold), math.sin(self.fold), 0.0])
        return np.eye(3) - 2.0 * np.outer(along, along)

    def rotations(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what the tilts do to directions of the camera, in float64 on the host.

        Parameters
        ----------
        theta : numpy.ndarray
            Angles of both commands [rad], shape (n, 2).

        Returns
        -------
        numpy.ndarray
            Rotations from the directions in which the camera sees points to those in which it would see them in the
            mirror at rest, shape (n, 3, 3); NaN for angles that are NaN or infinite.

        Raises
        ------
        AmiwarpError
            If ``theta`` has another shape.
        """
        from scipy.spatial.transform import Rotation

        amplitudes = np.array([self.amplitude, self.second_amplitude])
        tilts = two_commands.both_cosines(theta, self.phase, self.second_phase) * amplitudes
        return np.asarray(Rotation.from_rotvec(-2.0 * tilts @ self.axes).as_matrix())

    def kernel_values(self) -> tuple[Any, ...]:
        amplitudes = np.array([[self.amplitude], [self.second_amplitude]])
        first, second = -2.0 * amplitudes * self.axes
        return self.phase, self.second_phase, self.ratio, first, second

    def params(self, device: Any) -> Any:
        *numbers, first, second = self.kernel_values()
        first_axis = wp.vec3(*first.tolist())
        second_axis = wp.vec3(*second.tolist())
        return struct_of(MirrorParams, [*numbers, first_axis, second_axis])
