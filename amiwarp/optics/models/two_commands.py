"""What all optics share that two commands move, each along a direction in the image: a mirror, a beam steerer."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.pair import RATIO, SECOND_PHASE
from amiwarp.optics.models.parameter import AMPLITUDE, PHASE, Parameter
from amiwarp.optics.prism import check_phase
from amiwarp.validation import array, real

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


def check_motions(model: Model, largest_amplitude: float) -> None:
    """Check amplitudes, phases, directions and ratio of a new model, and set them in their plain types.

    Raises :class:`AmiwarpError` for an amplitude out of 0 .. ``largest_amplitude`` [rad], or an unusable value.
    """
    hint = " rad; is it given in degrees?"
    for name in ("amplitude", "second_amplitude"):
        _set_real(model, name, 0.0, largest_amplitude, hint)
    for name in ("phase", "second_phase", "direction", "second_direction"):
        object.__setattr__(model, name, check_phase(getattr(model, name), name))
    _set_real(model, "ratio", -1e6, 1e6)


def _set_real(model: Model, name: str, low: float, high: float, hint: str = "") -> None:
    """Check a number of a new model, and set it as a float. Raises :class:`AmiwarpError` outside low .. high."""
    value = real(getattr(model, name), name, low, high, hint)
    object.__setattr__(model, name, value)


def both_cosines(
    theta: NDArray[np.float64], phase: float, second_phase: float
) -> NDArray[np.float64]:
    """Return the cosines of both commands' angles, phases included, shape (n, 2); NaN for NaN and infinite angles.

    ``theta``: angles of both commands [rad], shape (n, 2). Raises :class:`AmiwarpError` for another shape.
    """
    theta = array(theta, "theta")
    if theta.ndim != 2 or theta.shape[1] != 2:
        raise AmiwarpError(
            f"theta has shape {theta.shape}; give the angles of both commands, shape (n, 2)"
        )
    angles = np.where(np.isfinite(theta), theta, np.nan) + np.array([phase, second_phase])
    return np.asarray(np.cos(angles))


def freed_at(ratio: float | None, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return those among the names of parameters that a calibration can find at a ratio of the commands' speeds.

    ``ratio``: None if it is not known.
    """
    if ratio is None or abs(abs(real(ratio, "ratio")) - 1.0) >= ONE_FREQUENCY:
        return names
    # At one frequency both make one ellipse, which other directions describe by other amplitudes and phases.
    directions = ("direction", "second_direction")
    return tuple(name for name in names if name not in directions)
