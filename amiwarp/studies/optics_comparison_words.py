"""Comparison of moving optics in words: what all have in common, and the recommendations with their reasons."""

from amiwarp.studies.optics_comparison import Compared, Comparison
from amiwarp.studies.orbits import LEAST_SWING
from amiwarp.studies.quantities import degrees, rate


def reasons(comparison: Comparison) -> list[str]:
    """Return the recommendations with their reasons, after what all optics have in common: one line of text each."""
    reference = comparison.reference
    limits = comparison.design.limits
    because = "recommended" if comparison.design.chosen is not None else "nearest to the limits"
    same = (
        f"setting: the image moves by {reference.orbit.radius:.2f} px rms, as by the {because} wedge of "
        f"{degrees(reference.orbit.apex)} at {reference.rpm:g} rpm"
    )
    rules = [
        f"edges of every direction move by {LEAST_SWING:g} px in {limits.window_ms:g} ms",
        f"blur up to {limits.tolerance_px:g} px",
    ]
    if limits.bandwidth is not None:
        rules.append(f"up to {rate(limits.bandwidth)}")
    kept = f"limits: {', '.join(rules)}"
    violated = [_violation(result) for result in comparison.results if result.misses]
    if violated:
        kept += f"; violated by {'; '.join(violated)}"

    lines = [same, kept]
    for advice in comparison.advice:
        name = "none"
        if advice.chosen is not None:
            name = advice.chosen.setting.name.replace(", ", " ")
        lines.append(f"{advice.task}: {name}: {advice.why}")
    for name, error in comparison.failed.items():
        lines.append(f"failed: {name}: {error}")
    return lines


def _violation(result: Compared) -> str:
    """Return which limits an optic violates, in words."""
    text = f"{result.setting.name.replace(', ', ' ')} ({', '.join(result.misses)}"
    covered = result.coverage
    if "edges" in result.misses:
        text += f": {covered.swing:.2f} px"
        if covered.left_out > 0.0:
            text += f", {100 * covered.left_out:.0f} % of the directions never, about {degrees(covered.blind)}"
    return text + ")"
