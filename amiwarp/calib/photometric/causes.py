"""What may be wrong in the given camera and prism, if an answer does not hold everywhere in the image.

The photometric stage tests an answer for these causes, and frees the parameters of one (``consistency.py``,
``stage.py``). A new cause needs its line in :data:`SUSPECTS`, and parameters with ranges in
:func:`amiwarp.results.space_setup.widened`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.prism import FlatSide, Prism, apex_from_deflection, as_wedge
from amiwarp.results.parameters import ParameterSpace
from amiwarp.results.space_setup import widened

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

FLAT_SIDE = "flat_side"
"""Name of the unknown that is 0 for the given flat side of the prism, and 1 for the other."""

CERTAIN_STD = 3.0
"""Number of whole standard deviations above which a harmonic is certainly there."""


@dataclass(frozen=True)
class SuspectedError:
    """One thing that may be wrong, and the parameters that correct it."""

    words: str
    """What is wrong, in words."""
    names: tuple[str, ...]
    """Names of the parameters that correct it."""

    @property
    def rank(self) -> int:
        """Position in :data:`SUSPECTS`: of causes with equal evidence, the first one counts."""
        return SUSPECTS.index(self)


FOCAL_LENGTH = SuspectedError("the focal length", ("focal_length",))
CENTER = SuspectedError("the principal point", ("center_x", "center_y"))
SIDE = SuspectedError("the flat side of the prism", (FLAT_SIDE,))
INDEX = SuspectedError("the refractive index of the prism", ("index",))
DISTORTION = SuspectedError("the lens distortion k1", ("k1",))
ASPECT = SuspectedError("the ratio of the focal lengths fy / fx", ("fy_over_fx",))
AXIS = SuspectedError("the direction of the prism's axis", ("tilt_x", "tilt_y"))
SEAT = SuspectedError("the prism's seat in its mount", ("wobble_x", "wobble_y"))
FACES = SuspectedError("the evenness of the prism's faces", ("cylinder_x", "cylinder_y"))
THIRD = SuspectedError(
    "the vibration's third harmonic", ("third_x", "third_y", "third_backward_x", "third_backward_y")
)
SUSPECTS = (FOCAL_LENGTH, CENTER, SIDE, INDEX, DISTORTION, ASPECT, AXIS, SEAT, FACES, THIRD)
"""All causes that the photometric stage can name and correct, the likeliest first."""
UNEVEN = (SEAT, FACES)
"""Causes that make the prism uneven."""
LOOKED_AT_FIRST = (INDEX, ASPECT, *UNEVEN)
"""Causes whose effect is examined only if a first look, without the map's change, finds one."""
SCREENED = (FOCAL_LENGTH, CENTER, SIDE, *LOOKED_AT_FIRST, THIRD)
"""Causes that every answer is tested for. The effects of the others resemble those of the first two."""


def without_doubtful_harmonic(
    parameters: Mapping[str, float], uncertainty: Mapping[str, float]
) -> dict[str, float]:
    """Return the values without a third harmonic of a vibration, if it was found but may as well be none; else none.

    The search frees it where it makes the scatter smaller. Errors of the map and of the sensor's timing, which are part
    of the standard deviations, can look like a harmonic of a hundredth of a pixel.
    """
    names = [name for name in THIRD.names if name in uncertainty]
    if any(abs(parameters[name]) > CERTAIN_STD * uncertainty[name] for name in names):
        return {}
    return dict.fromkeys(names, 0.0)


def values_with_other_side(space: ParameterSpace, values: Mapping[str, float]) -> dict[str, float]:
    """Return values that deflect the axial ray as before if the prism's other side is flat."""
    prism = as_wedge(space.prism)
    index = values.get("index", space.prism.index)
    deflection = Prism(values["apex"], index, prism.flat_side).deflection
    phase = math.remainder(values["phase"] + math.pi, math.tau)
    return {
        **values,
        "apex": apex_from_deflection(deflection, index, _opposite_side(prism)),
        "phase": phase,
    }


def other_side(space: ParameterSpace) -> ParameterSpace:
    """Return the parameter space with the prism's other side flat."""
    prism = as_wedge(space.prism)
    apex = apex_from_deflection(prism.deflection, prism.index, _opposite_side(prism))
    return replace(
        space,
        prism=Prism(apex, prism.index, _opposite_side(prism)),
        start=values_with_other_side(space, space.start),
    )


def _opposite_side(prism: Prism) -> FlatSide:
    return FlatSide.CAMERA if prism.flat_side is FlatSide.SCENE else FlatSide.SCENE


def with_cause(
    space: ParameterSpace, cause: SuspectedError, values: Mapping[str, float]
) -> tuple[ParameterSpace, Vector]:
    """Return the space in which a cause is corrected or free, and the vector of ``values`` there."""
    if cause == SIDE:
        space, values = other_side(space), values_with_other_side(space, values)
    else:
        space = widened(space, tuple(n for n in cause.names if n not in space.names))
    return space, space.to_vector({**space.start, **values})
