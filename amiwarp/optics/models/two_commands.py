"""What all optics share that two commands move, each along a direction in the image: a mirror, a beam steerer."""

from __future__ import annotations

import math

from amiwarp.optics.models.pair import RATIO, SECOND_PHASE
from amiwarp.optics.models.parameter import AMPLITUDE, PHASE, Parameter
from amiwarp.validation import real

LARGEST_PX = 24.0
"""Largest displacement of the image by one command that is searched [px]."""
ONE_FREQUENCY = 1e-3
"""Relative difference of the frequencies of both commands up to which they count as equal."""
PARAMETERS = (
    AMPLITUDE,
    PHASE,
    Parameter("second_amplitude", "rad"),
    SECOND_PHASE,
    RATIO,
    # a motion along the opposite direction is one of the opposite phase
    Parameter("direction", "rad", 0.6 * math.pi, period=math.pi),
    Parameter("second_direction", "rad", 0.6 * math.pi, period=math.pi),
)
"""Parameters of both motions."""
ORBITS = (("amplitude", "phase"), ("second_amplitude", "second_phase"))
"""Names of size and phase of each motion."""
TOGETHER = (
    ("amplitude", "phase", "direction"),
    ("second_amplitude", "second_phase", "second_direction"),
)
"""Names that each step of the global search finds."""
FREED = tuple(name for names in TOGETHER for name in names)
"""Names that a calibration finds by default."""


def freed_at(ratio: float | None, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return those among the names of parameters that a calibration can find at a ratio of the commands' speeds.

    ``ratio``: None if it is not known.
    """
    if ratio is None or abs(abs(real(ratio, "ratio")) - 1.0) >= ONE_FREQUENCY:
        return names
    # At one frequency both make one ellipse, which other directions describe by other amplitudes and phases.
    directions = ("direction", "second_direction")
    return tuple(name for name in names if name not in directions)
