"""Recommendation of a design study in words: the chosen prism and speed, and why others are rejected."""

import math

from amiwarp.calib.timing_blur import QUANTISATION_PX
from amiwarp.studies.design import Design
from amiwarp.studies.orbits import LEAST_SWING
from amiwarp.studies.quantities import degrees, quarter_turn_ms, rate


def headline(design: Design) -> str:
    """Return one line of text: the recommended prism and speed, or that no combination keeps all limits."""
    chosen = design.chosen
    if chosen is None:
        return f"none of {len(design.choices)} choices keeps all limits"
    return f"apex {degrees(chosen.orbit.apex)} at {chosen.rpm:g} rpm, compensated by the {chosen.model} model"


def reasons(design: Design) -> list[str]:
    """Return the reasons for the recommendation, or for having none: one line of text per limit."""
    chosen = design.chosen
    if chosen is None:
        return _refusals(design)
    limits = design.limits
    kept = sum(not choice.misses for choice in design.choices)
    count = f"{kept} choices of {len(design.choices)}"
    events = f"events: {rate(chosen.events_per_s)}, the fewest of the {count} that keep all limits"
    same_speed = [choice for choice in design.choices if choice.rpm == chosen.rpm]
    larger = [choice for choice in same_speed if choice.orbit.apex > chosen.orbit.apex]
    if larger:
        more = larger[0].events_per_s / chosen.events_per_s
        events += f"; {degrees(larger[0].orbit.apex)} generates {more:.1f} times as many"

    edges = (
        f"edges: a quarter turn displaces edges of every direction by at least {chosen.orbit.swing:.2f} px "
        f"across themselves (required: {LEAST_SWING:g} px)"
    )
    short = [orbit for orbit in design.orbits if orbit.swing < LEAST_SWING]
    if short:
        edges += f"; {degrees(short[-1].apex)} displaces them by only {short[-1].swing:.2f} px"

    window = f"window: a quarter turn takes {chosen.window_ms:.1f} ms (allowed: {limits.window_ms:.1f} ms)"
    slower = [rpm for rpm in design.rpms if rpm < chosen.rpm]
    if slower:
        window += f"; at {slower[-1]:g} rpm it takes {quarter_turn_ms(slower[-1]):.1f} ms"

    blur = (
        f"blur: {chosen.error_px:.3f} px across an edge (tolerance: {limits.tolerance_px:g} px), from pixels "
        f"{QUANTISATION_PX:.2f}, clock {chosen.clock_px:.3f}, encoder {chosen.encoder_px:.3f}"
    )

    errors = chosen.orbit.errors
    model = (
        f"model: {chosen.model}, with an error of {errors[chosen.model]:.2g} px "
        f"(allowed: {chosen.budget_px:.2g} px)"
    )
    for name, error in errors.items():
        if error > chosen.budget_px:
            model += f"; {name} has {error:.2g} px"

    lines = [events, edges, window, blur, model]
    if limits.bandwidth is not None:
        lines.append(f"bandwidth: {rate(chosen.events_per_s)} (limit: {rate(limits.bandwidth)})")
    low, high = design.range_at(chosen.rpm)
    upper = f"to {degrees(high)}" if high <= design.orbits[-1].apex else "upwards"
    lines.append(
        f"range: at {chosen.rpm:g} rpm every apex from {degrees(low)} {upper} keeps the limits of edges and blur, "
        "also off the grid"
    )
    return [*lines, *_failures(design)]


def _failures(design: Design) -> list[str]:
    """Return a line of text for each part of the study that failed."""
    return [f"failed: {name}: {message}" for name, message in design.failed.items()]


def _refusals(design: Design) -> list[str]:
    """Return text for each limit: how many combinations it rules out, and what would help."""
    limits = design.limits
    count = len(design.choices)
    best = max(design.orbits, key=lambda orbit: orbit.swing)
    least = min(choice.error_px for choice in design.choices)
    fewest = min(choice.events_per_s for choice in design.choices)
    shortest_ms = quarter_turn_ms(design.rpms[-1])
    less_blur = "try a better clock or encoder, a slower prism, or a larger --tolerance-px"
    if limits.tolerance_px <= QUANTISATION_PX:
        less_blur = (
            f"pixels alone leave {QUANTISATION_PX:.2f} px, so only a larger --tolerance-px helps"
        )
    advice = {
        "edges": f"a quarter turn displaces edges by {best.swing:.2f} px at most, and {LEAST_SWING:g} px is required; "
        "try a larger apex, or a longer focal length",
        "window": f"the shortest quarter turn takes {shortest_ms:.1f} ms, and {limits.window_ms:.1f} ms "
        "is allowed; try a faster prism, or a longer --window-ms",
        "blur": f"the smallest blur is {least:.3f} px, and the tolerance is {limits.tolerance_px:g} px; "
        f"{less_blur}",
        "bandwidth": f"the lowest event rate is {rate(fewest)}, and the limit is {rate(limits.bandwidth or math.inf)}; "
        "try a higher threshold, or a slower prism",
    }
    lines = []
    for name, text in advice.items():
        ruled_out = sum(name in choice.misses for choice in design.choices)
        if ruled_out:
            # If other choices keep the limit, only what would help is said.
            why = text if ruled_out == count else text.rpartition("; ")[2]
            lines.append(f"{name}: rules out {ruled_out} of {count}: {why}")
    return [*lines, *_failures(design)]
