"""Causes of an answer that does not hold everywhere in the image: what may be wrong in the given camera and prism."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from amiwarp.calib.space_setup import widened
from amiwarp.optics.prism import FlatSide, Prism, apex_from_deflection

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace

    Vector = NDArray[np.float64]

FLAT_SIDE = "flat_side"
"""Name of the unknown that is 0 for the given flat side of the prism, and 1 for the other."""


@dataclass(frozen=True)
class Cause:
    """One thing that may be wrong, and the parameters that correct it."""

    words: str
    """What is wrong, in words."""
    names: tuple[str, ...]
    """Names of the parameters that correct it."""

    @property
    def rank(self) -> int:
        """Position in :data:`CAUSES`: of causes with equal evidence, the first one counts."""
        return CAUSES.index(self)


CENTER = Cause("the principal point", ("center_x", "center_y"))
CAUSES = (
    Cause("the focal length", ("focal_length",)),
    CENTER,
    Cause("the flat side of the prism", (FLAT_SIDE,)),
    Cause("the lens distortion k1", ("k1",)),
    Cause("the direction of the prism's axis", ("tilt_x", "tilt_y")),
)
"""All causes that the photometric stage can name and correct, the likeliest first."""
SCREENED = CAUSES[:3]
"""Causes that every answer is tested for. The effects of the others resemble those of the first two."""


def turned(space: ParameterSpace, values: Mapping[str, float]) -> dict[str, float]:
    """Return values that deflect the axial ray as before if the prism's other side is flat."""
    prism, index = space.prism, values.get("index", space.prism.index)
    deflection = Prism(values["apex"], index, prism.flat_side).deflection
    phase = math.remainder(values["phase"] + math.pi, math.tau)
    return {**values, "apex": apex_from_deflection(deflection, index, _other(prism)), "phase": phase}


def other_side(space: ParameterSpace) -> ParameterSpace:
    """Return the parameter space with the prism's other side flat."""
    prism = space.prism
    apex = apex_from_deflection(prism.deflection, prism.index, _other(prism))
    return replace(space, prism=Prism(apex, prism.index, _other(prism)), start=turned(space, space.start))


def _other(prism: Prism) -> FlatSide:
    return FlatSide.CAMERA if prism.flat_side is FlatSide.SCENE else FlatSide.SCENE


def with_cause(space: ParameterSpace, cause: Cause, values: Mapping[str, float]) -> tuple[ParameterSpace, Vector]:
    """Return the space in which a cause is corrected or free, and the vector of ``values`` there."""
    if cause.names == (FLAT_SIDE,):
        space, values = other_side(space), turned(space, values)
    else:
        space = widened(space, tuple(n for n in cause.names if n not in space.names))
    return space, space.to_vector({**space.start, **values})


def place_arguments(space: ParameterSpace, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the keyword arguments of :meth:`BrightnessMap.place` for parameter values."""
    return {
        "model": space.build(values),
        "drift": space.drift(values),
        "camera_rotation": space.camera_rotation(values),
    }
