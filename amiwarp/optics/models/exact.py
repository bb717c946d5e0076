"""Exact model: refraction at both faces of the prism."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels.exact import ExactParams
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.parameter import PHASE, Parameter
from amiwarp.optics.models.structs import phase_values, struct_of
from amiwarp.optics.prism import FlatSide, Plate, Prism, as_wedge, check_angles, check_phase
from amiwarp.schema.calls import guarded
from amiwarp.validation import instance

UPRIGHT_ROWS = np.eye(3)
"""Rotation of a prism axis without tilt: the identity matrix."""
UPRIGHT_ROWS.setflags(write=False)
UPRIGHT = wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
"""The same for kernels."""
PAIRS = ("tilt", "cylinder", "wobble")
"""Names of the model's pairs of angles."""


def _pair(
    name: str, half_range_rad: float, limit_deg: float, slider_deg: tuple[float, float]
) -> tuple[Parameter, ...]:
    """Return two parameters, x and y, of one pair of angles.

    A search looks within ``half_range_rad`` of the start value [rad]; ``limit_deg`` is the largest value in an address
    [deg], and ``slider_deg`` the largest value and the step of the slider [deg].
    """
    largest, step = slider_deg
    return tuple(
        Parameter(
            f"{name}_{axis}",
            "rad",
            half_range_rad,
            limits=(-limit_deg, limit_deg),
            label=f"{name} in {axis}",
            slider=(-largest, largest, step),
        )
        for axis in ("x", "y")
    )


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

    NAME = "exact"
    TEXT = "exact (closed form)"
    NUMBERS = "2, index given"
    STRUCT = ExactParams
    PARAMETERS = (
        Parameter("apex", "rad"),
        PHASE,
        *_pair("tilt", math.radians(5.0), 45.0, (5.0, 0.05)),
        *_pair("cylinder", 0.02, 5.0, (1.0, 0.01)),
        *_pair("wobble", 0.1, 45.0, (5.0, 0.05)),
        Parameter("index", "1", 0.2, like_size=True, limits=(1.0, 5.0)),
    )

    camera: Camera
    """Camera intrinsics."""
    prism: Prism
    """Prism whose faces refract the rays."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Rotation of the prism's rotation axis about the camera's x, then about its y [rad]."""
    cylinder: tuple[float, float] = (0.0, 0.0)
    """Cylinder power of the tilted face: change of its slope per unit of the camera ray's tangent [rad], along the
    wedge (across it with the opposite sign), and at 45° to it."""
    wobble: tuple[float, float] = (0.0, 0.0)
    """Angles by which the prism's own axis is tipped out of the rotation axis, along the wedge and across it [rad].
    They turn with the prism."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        instance(self.prism, Prism, "prism")
        object.__setattr__(self, "phase", check_phase(self.phase))
        for name in PAIRS:
            angles = getattr(self, name)
            default = getattr(ExactModel, name)
            # A default is good already; models are made in each step of a search.
            if angles is not default:
                object.__setattr__(self, name, check_angles(angles, name))

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        wedge = Prism(values["apex"], values.get("index", prism.index), as_wedge(prism).flat_side)
        pairs = {}
        for name in PAIRS:
            x = f"{name}_x"
            y = f"{name}_y"
            if x in values or y in values:
                pairs[name] = (values.get(x, 0.0), values.get(y, 0.0))
        return cls(camera, wedge, values["phase"], **pairs)

    @classmethod
    def still_values(cls, values: Mapping[str, float]) -> dict[str, float]:
        # Without an apex, both faces are parallel however the prism is tipped, but a cylinder would still bend rays.
        flat = dict(values)
        for name in ("cylinder_x", "cylinder_y"):
            if name in flat:
                flat[name] = 0.0
        return super().still_values(flat)

    def params(self, device: Any) -> Any:
        *numbers, axis = self.kernel_values()
        # The same object: :meth:`kernel_values` returns it without a tilt.
        matrix = UPRIGHT if axis is UPRIGHT_ROWS else wp.mat33(*axis.ravel().tolist())
        return struct_of(ExactParams, [*numbers, matrix])

    def kernel_values(self) -> tuple[Any, ...]:
        # The fields of ExactParams, in their order; the axis as an array.
        tilted = any(self.tilt)
        uneven = any((*self.cylinder, *self.wobble))
        wobble_along, wobble_across = self.wobble
        azimuth = math.atan2(wobble_across, wobble_along)
        angle = math.atan(math.hypot(wobble_along, wobble_across))
        return (
            math.sin(self.prism.apex),
            math.cos(self.prism.apex),
            self.prism.index**2,
            *phase_values(self.phase),
            int(self.prism.flat_side is FlatSide.SCENE),
            int(tilted or uneven),
            int(uneven),
            *self.cylinder,
            math.cos(azimuth),
            math.sin(azimuth),
            math.sin(angle),
            2.0 * math.sin(angle / 2.0) ** 2,
            axis_rotation(*self.tilt) if tilted else UPRIGHT_ROWS,
        )


def axis_rotation(tilt_x: float, tilt_y: float) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a tilted axis: about x by ``tilt_x``, then about y by ``tilt_y`` [rad]."""
    cx = math.cos(tilt_x)
    sx = math.sin(tilt_x)
    cy = math.cos(tilt_y)
    sy = math.sin(tilt_y)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    return about_y @ about_x
