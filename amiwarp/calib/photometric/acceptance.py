"""Whether the photometric stage's optimum is one: each bar was set by what failed below it, ``docs/stability.md``."""

FAR_PX = 1.5
"""The stage looks no further from the sharpness optimum than this."""
BESIDE_PX, LEAST_RISE = 0.3, 0.01
"""An orbit that is larger, smaller or turned by this much must cost more by this share of the cost with no map. Else a
map of few events fits anything, or there is no optimum."""
LARGEST_STEP_LEFT_PX = 0.06
"""By which Gauss and Newton's method would still move at the end: 0.01 where the search arrived."""
LARGEST_COST = 0.75
"""Of the cost with no map at all: above it there is nothing that the equations explain."""


def verdict(cost: float, rise: float, moved: float, ahead: float) -> tuple[bool, str]:
    """Whether to believe an optimum, and why.

    ``cost``: what is left of the residual, as a share of that with no map; ``rise``: by how much that is more, at
    least, for an orbit that is :data:`BESIDE_PX` larger, smaller or turned either way; ``moved`` [px] from the answer
    of sharpness; ``ahead`` [px]: the step that the search would take next.
    """
    if cost > LARGEST_COST:
        return False, (
            f"no map of the scene explains the events ({min(100 * cost, 100):.0f} % of the residual remains): the "
            "scene or the camera moved, light flickered, or the encoder is wrong"
        )
    if moved > 0.95 * FAR_PX:
        return False, f"the optimum lies over {FAR_PX:g} px from that of sharpness"
    if ahead > LARGEST_STEP_LEFT_PX:
        far = f"{ahead:.2f} px" if ahead <= FAR_PX else f"over {FAR_PX:g} px"
        return False, f"no step of the search helps, though it should move {far}: too few events, or many lost"
    if rise < LEAST_RISE:
        well = f"as well ({100 * rise:.1f} % of the residual more)" if rise > 0.0 else "better"
        return False, (
            f"an orbit {BESIDE_PX:g} px larger, smaller or turned explains the events {well}: "
            "too few events, too little contrast, or the scene or the camera moved"
        )
    return True, f"one map explains the events ({100 * cost:.0f} % of the residual remains)"
