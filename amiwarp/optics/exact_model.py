"""Exact model: refraction at both faces of the prism."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import warp as wp

from amiwarp.kernels.refraction import ExactParams
from amiwarp.optics.camera import Camera
from amiwarp.optics.displacement import PHASE, Model, Parameter, phase_values, struct_of
from amiwarp.optics.prism import FlatSide, Prism, check_phase, check_tilt
from amiwarp.validation import guarded, instance

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

UPRIGHT = wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
UPRIGHT_ROWS = np.eye(3)
"""Rotation of a prism axis without tilt: the identity matrix."""


@guarded
@dataclass(frozen=True)
class ExactModel(Model):
    """Exact model: refracts each ray at both faces of the prism, in closed form.

    Raises
    ------
    AmiwarpError
        If a field has an unusable value.

    Notes
    -----
    The formulas are in ``docs/explanation/optics.md``.

    Examples
    --------
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.ExactModel(camera, amiwarp.Prism(apex=0.03), phase=0.1)
    >>> observed = model.deflect_points(np.array([[100.0, 200.0]]), np.array([0.5]))
    >>> model.compensate_points(observed, np.array([0.5])).round(2)
    array([[100., 200.]])
    """

    NAME, TEXT, NUMBERS, STRUCT = "exact", "exact (closed form)", "2, index given", ExactParams
    PARAMETERS = (
        Parameter("apex", "rad"),
        PHASE,
        *(
            Parameter(
                f"tilt_{axis}", "rad", math.radians(5.0), limits=(-45.0, 45.0), label=f"tilt in {axis}",
                slider=(-5.0, 5.0, 0.05),
            )
            for axis in "xy"
        ),
        Parameter("index", "1", 0.2, like_size=True, limits=(1.0, 5.0)),
    )  # fmt: skip

    camera: Camera
    """Camera intrinsics."""
    prism: Prism
    """Prism whose faces refract the rays."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Rotation of the prism's rotation axis about the camera's x, then about its y [rad]."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        instance(self.prism, Prism, "prism")
        object.__setattr__(self, "phase", check_phase(self.phase))
        object.__setattr__(self, "tilt", check_tilt(self.tilt))

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism, values: Mapping[str, float]) -> Self:
        wedge = Prism(values["apex"], values.get("index", prism.index), prism.flat_side)
        return cls(camera, wedge, values["phase"], (values.get("tilt_x", 0.0), values.get("tilt_y", 0.0)))

    def params(self, device: Any) -> Any:
        *numbers, axis = self.kernel_values()
        matrix = UPRIGHT if axis is UPRIGHT_ROWS else wp.mat33(*axis.ravel().tolist())
        return struct_of(ExactParams, [*numbers, matrix])

    def kernel_values(self) -> tuple[Any, ...]:
        tilted = any(self.tilt)
        return (
            math.sin(self.prism.apex), math.cos(self.prism.apex), self.prism.index**2, *phase_values(self.phase),
            int(self.prism.flat_side is FlatSide.SCENE), int(tilted),
            axis_rotation(*self.tilt) if tilted else UPRIGHT_ROWS,
        )  # fmt: skip


def axis_rotation(tilt_x: float, tilt_y: float) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a tilted axis: about x by ``tilt_x``, then about y by ``tilt_y`` [rad]."""
    cx, sx, cy, sy = math.cos(tilt_x), math.sin(tilt_x), math.cos(tilt_y), math.sin(tilt_y)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    return about_y @ about_x
