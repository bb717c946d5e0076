"""Recommendation of a design study in words: the chosen prism and speed, and why others are rejected."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from amiwarp.calib.selection.smaller_models import QUANTISATION_PX
from amiwarp.studies.design.choice import LEAST_SWING

if TYPE_CHECKING:
    from amiwarp.studies.design.choice import Choice, Design


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
    kept = sum(not c.misses for c in design.choices)
    lines = [
        f"events: {rate(chosen.events_per_s)}, the fewest of the {kept} choices of {len(design.choices)} "
        "that keep all limits" + _dearer(design, chosen),
        f"edges: a quarter turn displaces edges of every direction by at least {chosen.orbit.swing:.2f} px "
        f"across themselves (required: {LEAST_SWING:g} px)" + _smaller(design, chosen),
        f"window: a quarter turn takes {chosen.window_ms:.1f} ms (allowed: {design.limits.window_ms:.1f} ms)"
        + _slower(design, chosen),
        f"blur: {chosen.error_px:.3f} px across an edge (tolerance: {design.limits.tolerance_px:g} px), from pixels "
        f"{QUANTISATION_PX:.2f}, clock {chosen.clock_px:.3f}, encoder {chosen.encoder_px:.3f}",
        f"model: {chosen.model}, with an error of {_px(chosen.orbit.errors[chosen.model])} "
        f"(allowed: {_px(chosen.budget_px)})" + _simpler(chosen),
    ]
    if design.limits.bandwidth is not None:
        lines.append(f"bandwidth: {rate(chosen.events_per_s)} (limit: {rate(design.limits.bandwidth)})")
    return [*lines, _range(design, chosen)]


def _dearer(design: Design, chosen: Choice) -> str:
    """Return text about the event rate with the next larger apex."""
    larger = [c for c in design.choices if c.rpm == chosen.rpm and c.orbit.apex > chosen.orbit.apex]
    if not larger:
        return ""
    more = larger[0].events_per_s / chosen.events_per_s
    return f"; {degrees(larger[0].orbit.apex)} generates {more:.1f} times as many"


def _smaller(design: Design, chosen: Choice) -> str:
    """Return text about the displacement across edges by the largest apex that is too small."""
    short = [o for o in design.orbits if o.swing < LEAST_SWING]
    return f"; {degrees(short[-1].apex)} displaces them by only {short[-1].swing:.2f} px" if short else ""


def _slower(design: Design, chosen: Choice) -> str:
    """Return text about the duration of a quarter turn at the next lower speed."""
    slow = [rpm for rpm in design.rpms if rpm < chosen.rpm]
    return f"; at {slow[-1]:g} rpm it takes {15e3 / slow[-1]:.1f} ms" if slow else ""


def _simpler(chosen: Choice) -> str:
    """Return text about the errors of the models that exceed the error budget."""
    worse = {n: e for n, e in chosen.orbit.errors.items() if e > chosen.budget_px}
    return "".join(f"; {name} has {_px(error)}" for name, error in worse.items())


def _range(design: Design, chosen: Choice) -> str:
    """Return text about the range of apex angles that keep the limits of edges and blur."""
    low, high = design.range_at(chosen.rpm)
    largest = design.orbits[-1].apex
    ends = f"from {degrees(low)}" + (f" to {degrees(high)}" if high <= largest else " upwards")
    return f"range: at {chosen.rpm:g} rpm every apex {ends} keeps the limits of edges and blur, also off the grid"


def _refusals(design: Design) -> list[str]:
    """Return text for each limit: how many combinations it rules out, and what would help."""
    limits, count = design.limits, len(design.choices)
    best = max(design.orbits, key=lambda o: o.swing)
    least = min(c.error_px for c in design.choices)
    fewest = min(c.events_per_s for c in design.choices)
    advice = {
        "edges": f"a quarter turn displaces edges by {best.swing:.2f} px at most, and {LEAST_SWING:g} px is required; "
        "try a larger apex, or a longer focal length",
        "window": f"the shortest quarter turn takes {15e3 / design.rpms[-1]:.1f} ms, and {limits.window_ms:.1f} ms "
        "is allowed; try a faster prism, or a longer --window-ms",
        "blur": f"the smallest blur is {least:.3f} px, and the tolerance is {limits.tolerance_px:g} px; "
        + (
            f"pixels alone leave {QUANTISATION_PX:.2f} px, so only a larger --tolerance-px helps"
            if limits.tolerance_px <= QUANTISATION_PX
            else "try a better clock or encoder, a slower prism, or a larger --tolerance-px"
        ),
        "bandwidth": f"the lowest event rate is {rate(fewest)}, and the limit is {rate(limits.bandwidth or math.inf)}; "
        "try a higher threshold, or a slower prism",
    }
    lines = []
    for name, text in advice.items():
        out = sum(name in c.misses for c in design.choices)
        if out:
            why = text if out == count else text.rpartition("; ")[2]
            lines.append(f"{name}: rules out {out} of {count}: {why}")
    return lines


def degrees(angle: float) -> str:
    """Return an angle [rad] as text in degrees."""
    return f"{float(f'{math.degrees(angle):.3g}'):g}°"


def rate(events_per_s: float) -> str:
    """Return an event rate [events/s] as text."""
    return f"{events_per_s / 1e6:.3g} Mev/s"


def _px(error: float) -> str:
    """Return an error [px] as text."""
    return f"{error:.2g} px"
