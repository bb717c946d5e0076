"""A vibrating camera without a prism: it rotates by small angles, at one frequency, twice and three times it.

The model's angle theta is the angle of the vibration, 2π f t. The formulas are in ``docs/explanation/optics.md``.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels.vibration import VibrationParams
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model, check_given
from amiwarp.optics.models.parameter import AMPLITUDE, PHASE, Parameter
from amiwarp.optics.models.structs import phase_values, struct_of
from amiwarp.optics.prism import Plate, Prism, check_phase
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, instance, one_of, real, vector

LARGEST_AMPLITUDE = 0.2
"""Upper limit of each part of a vibration [rad]. Larger values are mistakes, such as angles in degrees."""
TYPICAL_PX = 4.0
"""Displacement of the image by which parameters are scaled [px]."""
LARGEST_PX = 12.0
"""Largest displacement of the image that is searched [px]."""


def _parameters(label: str, name: str, *, fine: bool) -> tuple[Parameter, Parameter]:
    """Return two parameters, x and y, of a part of the vibration; ``label`` names it for a reader."""
    degrees = math.degrees(LARGEST_AMPLITUDE)

    def along(axis: str) -> Parameter:
        return Parameter(
            f"{name}_{axis}",
            "rad",
            fine=fine,
            limits=(-degrees, degrees),
            label=f"{label}, {axis}",
            slider=(-1.0, 1.0, 0.005),
        )

    return along("x"), along("y")


@guarded
@dataclass(frozen=True)
class VibrationModel(Model):
    """Vibrating camera: rotates each bearing by the camera's rotation from its orientation at rest.

    Raises
    ------
    AmiwarpError
        If a part of the vibration is 0.2 rad or more, or another field has an unusable value.

    Notes
    -----
    The camera's rotation vector about its x and y axes, as a complex number x + iy, is
    ``amplitude`` e^i(θ+phase) + ``backward`` e^-iθ + ``second`` e^2iθ + ``second_backward`` e^-2iθ + ``third`` e^3iθ +
    ``third_backward`` e^-3iθ.
    About the optical axis it is ``roll`` · (cos θ, sin θ). See ``docs/explanation/optics.md``.

    Examples
    --------
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.VibrationModel(camera, amplitude=0.01)
    >>> model.compensate_points(np.array([[320.0, 240.0]]), np.array([0.0])).round(2)
    array([[320., 235.]])
    """

    NAME = "vibration"
    TEXT = "vibrating camera"
    NUMBERS = "14"
    STRUCT = VibrationParams
    PARAMETERS = (
        AMPLITUDE,
        PHASE,
        *_parameters("backward circle", "backward", fine=False),
        *_parameters("roll", "roll", fine=True),
        *_parameters("second harmonic", "second", fine=True),
        *_parameters("second harmonic, backward", "second_backward", fine=True),
        *_parameters("third harmonic", "third", fine=True),
        *_parameters("third harmonic, backward", "third_backward", fine=True),
    )
    FREED = tuple(
        parameter.name for parameter in PARAMETERS if not parameter.name.startswith("third")
    )
    PRISM = False
    MOVER = "vibration"
    SIZE_HINT = f"{LARGEST_PX:g} px"
    TIME_BIN_US = 200
    SECTORS = 8  # no events come where a vibration along a line turns back

    camera: Camera
    """Camera intrinsics."""
    amplitude: float
    """Radius of the forward circle: largest rotation of the camera by it [rad]."""
    phase: float = 0.0
    """Phase of the forward circle at θ = 0 [rad]."""
    backward: tuple[float, float] = (0.0, 0.0)
    """Rotation about the camera's x and y axes by the backward circle at θ = 0 [rad]."""
    roll: tuple[float, float] = (0.0, 0.0)
    """Rotation about the optical axis: factors of cos θ and sin θ [rad]."""
    second: tuple[float, float] = (0.0, 0.0)
    """Rotation about x and y by the forward circle of the second harmonic at θ = 0 [rad]."""
    second_backward: tuple[float, float] = (0.0, 0.0)
    """Rotation about x and y by the backward circle of the second harmonic at θ = 0 [rad]."""
    third: tuple[float, float] = (0.0, 0.0)
    """Rotation about x and y by the forward circle of the third harmonic at θ = 0 [rad]."""
    third_backward: tuple[float, float] = (0.0, 0.0)
    """Rotation about x and y by the backward circle of the third harmonic at θ = 0 [rad]."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        object.__setattr__(self, "amplitude", check_amplitude(self.amplitude))
        object.__setattr__(self, "phase", check_phase(self.phase))
        for name in PARTS:
            part = getattr(self, name)
            default = getattr(VibrationModel, name)
            if part is not default:
                object.__setattr__(self, name, check_part(part, name))

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        parts = {}
        for name in PARTS:
            x = values.get(f"{name}_x", 0.0)
            y = values.get(f"{name}_y", 0.0)
            parts[name] = (x, y)
        return cls(camera, values["amplitude"], values["phase"], **parts)

    @classmethod
    def typical_size(cls, camera: Camera, prism: Prism | Plate) -> float:
        return TYPICAL_PX / camera.fx

    @classmethod
    def default_bounds(
        cls,
        name: str,
        value: float,
        camera: Camera,
        prism: Prism | Plate,
    ) -> tuple[float, float]:
        if one_of(name, cls.FREE, "name") == PHASE.name:
            return super().default_bounds(name, value, camera, prism)
        largest = min(LARGEST_PX / camera.fx, LARGEST_AMPLITUDE)
        smallest = 0.0 if name == cls.SIZE else -largest
        return smallest, largest

    @classmethod
    def still_values(cls, values: Mapping[str, float]) -> dict[str, float]:
        moving = {cls.SIZE, *cls.FREE[2:]}
        return {name: 0.0 if name in moving else value for name, value in values.items()}

    @classmethod
    def turned_values(cls, values: Mapping[str, float], angle: float) -> dict[str, float]:
        turned = super().turned_values(values, angle)
        for name, turns in TURNS.items():
            part = complex(values.get(f"{name}_x", 0.0), values.get(f"{name}_y", 0.0))
            part *= cmath.rect(1.0, turns * angle)
            turned[f"{name}_x"] = part.real
            turned[f"{name}_y"] = part.imag
        return turned

    @classmethod
    def reversed_values(cls, values: Mapping[str, float]) -> dict[str, float]:
        check_given(values, cls.FREE[:2])
        forward = cmath.rect(values["amplitude"], values["phase"])
        given = {name: values.get(name, 0.0) for name in cls.FREE[2:]}
        backward = complex(given["backward_x"], given["backward_y"])
        changed = {
            "amplitude": abs(backward),
            "phase": cmath.phase(backward),
            "backward_x": forward.real,
            "backward_y": forward.imag,
            "roll_x": given["roll_x"],
            "roll_y": -given["roll_y"],
        }
        for name in ("second", "third"):
            for axis in "xy":
                changed[f"{name}_{axis}"] = given[f"{name}_backward_{axis}"]
                changed[f"{name}_backward_{axis}"] = given[f"{name}_{axis}"]
        return {**values, **changed}

    def rotations(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the camera's rotation from its orientation at rest, in float64 on the host.

        Parameters
        ----------
        theta : numpy.ndarray
            Angle of the vibration [rad], shape (n,).

        Returns
        -------
        numpy.ndarray
            Matrices from the camera's frame to the frame of the camera at rest, shape (n, 3, 3); NaN for an angle that
            is NaN or infinite.

        Raises
        ------
        AmiwarpError
            If ``theta`` has another shape.
        """
        from scipy.spatial.transform import Rotation

        theta = array(theta, "theta")
        if theta.ndim != 1:
            raise AmiwarpError(f"theta has shape {theta.shape}; give angles of shape (n,)")
        theta = np.where(np.isfinite(theta), theta, np.nan)
        vector = self.amplitude * np.exp(1j * (theta + self.phase))
        for name, times in CIRCLES.items():
            part = complex(*getattr(self, name))
            vector += part * np.exp(1j * times * theta)
        by_cosine, by_sine = self.roll
        roll = by_cosine * np.cos(theta) + by_sine * np.sin(theta)
        vectors = np.stack([vector.real, vector.imag, roll], axis=1)
        return np.asarray(Rotation.from_rotvec(vectors).as_matrix())

    def kernel_values(self) -> tuple[Any, ...]:
        vectors = []
        for name in PARTS:  # the kernels' angle is φ = θ + phase
            turned = cmath.rect(1.0, -TURNS[name] * self.phase)
            part = complex(*getattr(self, name)) * turned
            vectors.append(np.array([part.real, part.imag]))
        return self.amplitude, *phase_values(self.phase), *vectors

    def params(self, device: Any) -> Any:
        values = self.kernel_values()
        numbers = values[: -len(PARTS)]
        vectors = [wp.vec2(*part.tolist()) for part in values[-len(PARTS) :]]
        return struct_of(VibrationParams, [*numbers, *vectors])


CIRCLES = {"backward": -1, "second": 2, "second_backward": -2, "third": 3, "third_backward": -3}
"""Names of the circles besides the forward one, and how often each is run through, forwards, while θ turns once."""
PARTS = ("backward", "roll", "second", "second_backward", "third", "third_backward")
"""Names of the parts of a vibration, besides the forward circle, in the order of the kernels' struct."""
TURNS = {**CIRCLES, "roll": -1}
"""How often each part turns, forwards, while θ turns once. The factors of the roll turn backwards."""


def check_amplitude(value: object) -> float:
    """Return ``value`` as the radius of a circle [rad]; raise :class:`AmiwarpError` if it is negative or too large."""
    return real(value, "amplitude", 0.0, LARGEST_AMPLITUDE, " rad; is it given in degrees?")


def check_part(value: object, what: str) -> tuple[float, float]:
    """Return two angles of a part of a vibration [rad]; raise :class:`AmiwarpError` for others."""

    hint = " rad; is it given in degrees?"

    def angle(given: object, name: str) -> float:
        return real(given, name, -LARGEST_AMPLITUDE, LARGEST_AMPLITUDE, hint)

    x, y = vector(value, 2, what, angle)
    return x, y
