"""Acceptance of the photometric stage's optimum.

Each limit was set by failures that it prevents; ``docs/explanation/stability.md`` describes them.
"""

import math

LARGEST_MOVE_PX = 1.5
"""Largest accepted distance between the optima of the photometric and the sharpness stage, in the prism's parameters
[px]."""
PERTURBATION_PX, LEAST_COST_RISE = 0.3, 0.01
"""Reject the photometric optimum if changing the prism's orbit by ``PERTURBATION_PX`` [px] raises the cost by less than
``LEAST_COST_RISE``.

Without such a rise there is no distinct optimum, or a brightness map of few events fits any orbit. The cost is relative
to that without a brightness map.
"""
RISE_SHARE, SMALLEST_RISE = 0.1, 0.003
"""A rise below ``LEAST_COST_RISE`` suffices if it is this share of the cost, and at least ``SMALLEST_RISE``.

Few edges leave a small cost, and small rises. In recordings that determined the orbit the share was 0.11 to 0.25, in
those that did not, 0.02 at most.
"""
LARGEST_NEXT_STEP_PX = 0.06
"""Largest Gauss-Newton step that may remain when the search ends [px]. The step is about 0.01 px if the search
converged."""
LARGEST_COST = 0.75
"""Largest accepted cost, relative to the cost without a brightness map. Above it the map explains too little of the
events."""

LARGEST_EXAMINED_COST = 0.5
"""Largest cost, relative to that without a map, of an answer that is examined for causes of an error."""
LARGEST_STILL_COST = 0.2
"""Largest cost of the photometric stage, relative to that without a brightness map, that a still camera and a correct
encoder scale leave."""
LARGEST_ROTATION_GAIN = 0.05
"""Largest share of the squared residuals that a camera rotation may explain before it is freed. Cameras that turned at
0.1 to 1 deg/s left 0.1 to 0.5; still ones 0.007 at most, whatever the noise."""
LARGEST_COST_RATIO = 0.75
"""Ratio of the new to the previous cost up to which another explanation is accepted if the previous cost was high: a
camera rotation, a corrected encoder scale, or a corrected lens."""
LARGEST_INCONSISTENCY_PX = 0.1
"""Largest accepted error that the check of the answer's consistency leaves [px]."""


LARGEST_LAG_RAD = 0.35
"""Largest angle by which the prism may turn within the time constant of slow photoreceptors [rad]. At 0.2 an error of
0.02 px remains, at 0.4 one of 0.14 px."""


def judge_lag(turn: float) -> tuple[bool, str]:
    """Return whether to accept an answer for pixels within whose time constant the prism turns by an angle [rad]."""
    if turn <= LARGEST_LAG_RAD:
        return True, ""
    return False, (
        f"the pixels are too slow: the prism turns by {math.degrees(turn):.0f} deg within their time constant; use "
        "more light, a larger bandwidth or a slower prism"
    )


def judge_consistency(error_px: float, cause: str) -> tuple[bool, str]:
    """Return whether to accept an answer that differs over the image and over time by ``error_px``, and the reason.

    ``cause`` is the likeliest cause, in words.
    """
    if error_px <= LARGEST_INCONSISTENCY_PX:
        return True, ""
    return False, f"the answer differs by {error_px:.2f} px between parts of the image or of the recording: {cause}"


def judge_optimum(cost: float, *, rise: float, moved: float, next_step: float) -> tuple[bool, str]:
    """Return whether to accept an optimum of the photometric stage, and the reason.

    Parameters
    ----------
    cost : float
        Remaining cost, relative to that without a map.
    rise : float
        Smallest rise of the cost for an orbit that is :data:`PERTURBATION_PX` larger, smaller or rotated either way.
    moved : float
        Distance from the answer of the sharpness stage [px].
    next_step : float
        Length of the next Gauss-Newton step [px].

    Returns
    -------
    accepted : bool
        Whether to accept the optimum.
    reason : str
        The reason.
    """
    if cost > LARGEST_COST:
        return False, (
            f"no brightness map of the scene explains the events ({min(100 * cost, 100):.0f} % of the residual "
            "remains): the scene or the camera moved, light flickered, or the encoder or the lens is wrong"
        )
    if moved > 0.95 * LARGEST_MOVE_PX:
        return False, (
            f"the optimum is over {LARGEST_MOVE_PX:g} px away from that of sharpness: the lens or the encoder is "
            "wrong, or the scene or the camera moved"
        )
    if next_step > LARGEST_NEXT_STEP_PX:
        size = f"{next_step:.2f} px" if next_step <= LARGEST_MOVE_PX else f"over {LARGEST_MOVE_PX:g} px"
        return False, (
            f"the search did not converge: its next step would be {size}, but no step lowers the cost: too few events, "
            "or many lost"
        )
    if rise < min(LEAST_COST_RISE, max(SMALLEST_RISE, RISE_SHARE * cost)):
        well = f"as well ({100 * rise:.1f} % of the residual more)" if rise > 0.0 else "better"
        return False, (
            f"an orbit that is {PERTURBATION_PX:g} px larger, smaller or rotated explains the events {well}: "
            "too few events, too little contrast, or the scene or the camera moved"
        )
    return True, f"one brightness map explains the events ({100 * cost:.0f} % of the residual remains)"
