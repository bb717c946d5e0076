"""Pair of prisms: exact refraction at the four faces of two prisms that turn independently."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels.prism_pair import PairParams
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.angles import both_angles
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.parameter import PHASE, Parameter
from amiwarp.optics.models.structs import struct_of
from amiwarp.optics.prism import Plate, Prism, as_wedge, check_phase
from amiwarp.schema.calls import guarded
from amiwarp.validation import instance, real

SECOND_PHASE = Parameter(
    "second_phase",
    "rad",
    limits=(-180.0, 180.0),
    label="second phase",
    slider=(-180.0, 180.0, 0.5),
)
"""Phase of the second angle of a state."""
RATIO = Parameter("ratio", "1", 0.01)
"""Speed of the second angle relative to the first."""


@guarded
@dataclass(frozen=True)
class RisleyModel(Model):
    """Risley pair: refracts each ray at the four faces of two prisms, each with its own angle.

    Raises
    ------
    AmiwarpError
        If the prism has no second one, or a field has an unusable value.

    Notes
    -----
    A ray of the camera meets the first prism, then the second one. Each refracts it as in :class:`ExactModel`; both
    turn about the optical axis.

    Examples
    --------
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> pair = amiwarp.Prism(apex=0.03, second=amiwarp.Prism(apex=0.03))
    >>> model = amiwarp.RisleyModel(camera, pair)
    >>> model.compensate_points(np.array([[100.0, 200.0]]), np.array([[0.4, 0.4 + np.pi]])).round()  # they cancel
    array([[100., 200.]])
    """

    NAME = "risley"
    TEXT = "pair of prisms"
    NUMBERS = "4, indices given"
    STRUCT = PairParams
    ANGLES = 2
    PARAMETERS = (
        Parameter("apex", "rad"),
        PHASE,
        Parameter(
            "second_apex",
            "rad",
            0.02,
            limits=(0.0, 30.0),
            label="second apex",
            slider=(0.0, 10.0, 0.05),
        ),
        SECOND_PHASE,
        RATIO,
    )
    ORBITS = (("apex", "phase"), ("second_apex", "second_phase"))

    camera: Camera
    """Camera intrinsics."""
    prism: Prism
    """The prism next to the camera, with the second one."""
    phase: float = 0.0
    """Phase θ_b of the first prism, added to its encoder's angle [rad]."""
    second_phase: float = 0.0
    """Phase of the second prism, added to its encoder's angle [rad]."""
    ratio: float = 0.0
    """Mean speed of the second prism relative to the first, which tells the second angle where only one is given."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        if instance(self.prism, Prism, "prism").second is None:
            raise AmiwarpError("the prism has no second one; give Prism(apex, second=Prism(apex))")
        for name in ("phase", "second_phase"):
            object.__setattr__(self, name, check_phase(getattr(self, name), name))
        object.__setattr__(self, "ratio", real(self.ratio, "ratio", -1e6, 1e6))

    @classmethod
    def start_values(cls, prism: Prism | Plate) -> dict[str, float]:
        prism = as_wedge(prism)
        second = _second_of(prism)
        return {**super().start_values(prism), "second_apex": second.apex}

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        prism = as_wedge(prism)
        second = _second_of(prism)
        other = Prism(values.get("second_apex", second.apex), second.index, second.flat_side)
        pair = Prism(values["apex"], prism.index, prism.flat_side, other)
        second_phase = values.get("second_phase", 0.0)
        return cls(camera, pair, values["phase"], second_phase, values.get("ratio", 0.0))

    def kernel_values(self) -> tuple[Any, ...]:
        first, second = self.singles()
        return (
            first.kernel_values(),
            second.kernel_values(),
            self.phase,
            self.second_phase,
            self.ratio,
        )

    def params(self, device: Any) -> Any:
        first, second = self.singles()
        prisms = [first.params(device), second.params(device)]
        angles = [self.phase, self.second_phase, self.ratio]
        return struct_of(PairParams, [*prisms, *angles])

    def singles(self) -> tuple[ExactModel, ExactModel]:
        first = ExactModel(self.camera, replace(self.prism, second=None), self.phase)
        return first, ExactModel(self.camera, cast("Prism", self.prism.second), self.second_phase)

    def all_angles(self, theta: NDArray[Any]) -> NDArray[np.float64]:
        return both_angles(theta, self.ratio)


def _second_of(prism: Prism) -> Prism:
    """Return the second prism of a pair; one like the first if there is none."""
    return prism if prism.second is None else prism.second
