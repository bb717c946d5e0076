"""Parameters of the optical models that a calibration can find."""

from __future__ import annotations

import math
from dataclasses import dataclass

from amiwarp.errors import AmiwarpError
from amiwarp.schema.calls import guarded
from amiwarp.validation import instance, real, shown, vector


@guarded
@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameter of an optical model that a calibration can find.

    Examples
    --------
    >>> amiwarp.ExactModel.PARAMETERS[-1].name
    'index'
    """

    name: str
    """Name in settings, files and results."""
    unit: str
    """Unit of its values: ``rad``, ``1/m``, or ``1`` for a number."""
    half_range: float = math.pi
    """Half width of its default bounds about its start value, in its unit. The size has bounds from its nominal value.
    """
    like_size: bool = False
    """Whether it changes the sharpness nearly as the size does, so that sharpness alone hardly finds it."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and largest value in an address of ``amiwarp view``, angles in degrees; infinite for none."""
    label: str = ""
    """Text of its slider in ``amiwarp view``; empty without a slider."""
    slider: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Minimum, maximum and step of its slider, angles in degrees. The slider starts at 0, the slider of a size at a
    typical value."""
    fine: bool = False
    """Whether its effect is so small that the global search keeps its start value."""
    period: float = 0.0
    """Period of an angle after which the motion repeats [rad], as for a direction; 0 for none. Such a parameter has
    no bounds unless they are given: only the global search keeps to ``half_range``."""

    def __post_init__(self) -> None:
        for name in ("name", "unit", "label"):
            instance(getattr(self, name), str, f"parameter's {name}")
        real(self.half_range, f"parameter {shown(self.name)}: half_range", 0.0)
        real(self.period, f"parameter {shown(self.name)}: period", 0.0)
        vector(self.slider, 3, f"parameter {shown(self.name)}: slider", real)
        low, high = vector(self.limits, 2, f"parameter {shown(self.name)}: limits", _limit)
        if low > high:
            raise AmiwarpError(
                f"parameter {shown(self.name)}: limits are {self.limits}; give the smaller one first"
            )


def _limit(value: object, what: str) -> float:
    """Return a number that may be infinite."""
    if isinstance(value, float) and math.isinf(value):
        return value
    return real(value, what)


PHASE = Parameter("phase", "rad")
"""Phase θ_b, which is added to the encoder's angle."""
AMPLITUDE = Parameter(
    "amplitude",
    "rad",
    math.radians(0.4),
    limits=(0.0, 11.4),
    label="amplitude",
    slider=(0.0, 3.0, 0.005),
)
"""Size of a motion that no glass makes."""
