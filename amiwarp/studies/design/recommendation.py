"""The recommendation in words: what was chosen, and why nothing else."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from amiwarp.calib.selection.smaller_models import QUANTISATION_PX
from amiwarp.studies.design.choice import LEAST_SWING

if TYPE_CHECKING:
    from amiwarp.studies.design.choice import Choice, Design


def headline(design: Design) -> str:
    """One line: the choice, or that there is none."""
    chosen = design.chosen
    if chosen is None:
        return f"none of {len(design.choices)} choices keeps all limits"
    return f"apex {degrees(chosen.orbit.apex)} at {chosen.rpm:g} rpm, compensated by the {chosen.model} model"


def reasons(design: Design) -> list[str]:
    """Why this choice, or why none: one line for each limit."""
    chosen = design.chosen
    if chosen is None:
        return _refusals(design)
    kept = sum(not c.misses for c in design.choices)
    lines = [
        f"events: {rate(chosen.events_per_s)}, the fewest of the {kept} choices of {len(design.choices)} "
        "that keep all limits" + _dearer(design, chosen),
        f"edges: a quarter turn moves every edge across itself by at least {chosen.orbit.swing:.2f} px, "
        f"whichever way it runs (needed: {LEAST_SWING:g})" + _smaller(design, chosen),
        f"window: a quarter turn takes {chosen.window_ms:.1f} ms, of {design.limits.window_ms:.1f} allowed"
        + _slower(design, chosen),
        f"blur: {chosen.error_px:.3f} px across an edge, of {design.limits.tolerance_px:g} tolerated: pixels "
        f"{QUANTISATION_PX:.2f}, clock {chosen.clock_px:.3f}, encoder {chosen.encoder_px:.3f}",
        f"model: {chosen.model}, wrong by {_px(chosen.orbit.errors[chosen.model])}, "
        f"of {_px(chosen.budget_px)} allowed" + _simpler(chosen),
    ]
    if design.limits.bandwidth is not None:
        lines.append(f"bandwidth: {rate(chosen.events_per_s)} of {rate(design.limits.bandwidth)}")
    return [*lines, _range(design, chosen)]


def _dearer(design: Design, chosen: Choice) -> str:
    larger = [c for c in design.choices if c.rpm == chosen.rpm and c.orbit.apex > chosen.orbit.apex]
    if not larger:
        return ""
    more = larger[0].events_per_s / chosen.events_per_s
    return f"; {degrees(larger[0].orbit.apex)} makes {more:.1f} times as many"


def _smaller(design: Design, chosen: Choice) -> str:
    short = [o for o in design.orbits if o.swing < LEAST_SWING]
    return f"; {degrees(short[-1].apex)} by only {short[-1].swing:.2f} px" if short else ""


def _slower(design: Design, chosen: Choice) -> str:
    slow = [rpm for rpm in design.rpms if rpm < chosen.rpm]
    return f"; at {slow[-1]:g} rpm {15e3 / slow[-1]:.1f} ms" if slow else ""


def _simpler(chosen: Choice) -> str:
    worse = {n: e for n, e in chosen.orbit.errors.items() if e > chosen.budget_px}
    return "".join(f"; {name} by {_px(error)}" for name, error in worse.items())


def _range(design: Design, chosen: Choice) -> str:
    low, high = design.range_at(chosen.rpm)
    largest = design.orbits[-1].apex
    ends = f"from {degrees(low)}" + (f" to {degrees(high)}" if high <= largest else " on")
    return (
        f"range: at {chosen.rpm:g} rpm apexes {ends} move edges enough and keep the blur, those between the grid's too"
    )


def _refusals(design: Design) -> list[str]:
    """What each limit rules out, and what would help."""
    limits, count = design.limits, len(design.choices)
    best = max(design.orbits, key=lambda o: o.swing)
    least = min(c.error_px for c in design.choices)
    fewest = min(c.events_per_s for c in design.choices)
    said = {
        "edges": f"a quarter turn moves edges by {best.swing:.2f} px at most, {LEAST_SWING:g} is needed; a larger "
        "apex, or a longer lens",
        "window": f"the shortest quarter turn takes {15e3 / design.rpms[-1]:.1f} ms, {limits.window_ms:.1f} is "
        "allowed; a faster prism, or a longer --window-ms",
        "blur": f"the least blur is {least:.3f} px, {limits.tolerance_px:g} is tolerated; "
        + (
            f"pixels alone leave {QUANTISATION_PX:.2f}, so only a larger --tolerance-px"
            if limits.tolerance_px <= QUANTISATION_PX
            else "a better clock or encoder, a slower prism, or a larger --tolerance-px"
        ),
        "bandwidth": f"the fewest events are {rate(fewest)}, {rate(limits.bandwidth or math.inf)} fit; "
        "a higher threshold, or a slower prism",
    }
    lines = []
    for name, text in said.items():
        out = sum(name in c.misses for c in design.choices)
        if out:
            why = text if out == count else text.rpartition("; ")[2]
            lines.append(f"{name}: rules out {out} of {count}: {why}")
    return lines


def degrees(angle: float) -> str:
    """An angle [rad] for people, in degrees."""
    return f"{float(f'{math.degrees(angle):.3g}'):g}°"


def rate(events_per_s: float) -> str:
    """Events a second for people."""
    return f"{events_per_s / 1e6:.3g} Mev/s"


def _px(error: float) -> str:
    return f"{error:.2g} px"
