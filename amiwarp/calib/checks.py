"""Refusals: what a recording must have before, and after, its parameters can be believed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib.parameters import size_name
from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from amiwarp.calib.bad_pixels import StrangeSummary
    from amiwarp.events.encoder import Encoder
    from amiwarp.optics.prism import Prism

FEWEST_EVENTS = 2000
SMALLEST_TURN = math.pi / 2
LEAST_SIGNIFICANCE = 5.0
"""By how many standard deviations the optimum must be sharper than with the phase turned round, and than still."""
LARGEST_FROM_NOMINAL = 0.18
"""Relative distance of the prism's size from the nominal one."""
LARGEST_FLICKER = 0.7
"""Share of the pixels that may see a lamp."""
LARGEST_DRIFT = 0.02
"""Turns by which index pulses may drift over a recording."""
FEWEST_PULSES = 3
STEADY = 0.2
"""Of a drift: pulses that lie no further from a line drift steadily."""
LARGEST_COHERENCE = 0.97
"""Of the edge directions: 0 where all are as frequent, 1 where all edges are parallel."""


class NotSharp(AmiwarpError):
    """No motion of a prism explains the events: what a turning camera looks like too."""


def check_events(count: int, name: str) -> None:
    if count < FEWEST_EVENTS:
        raise AmiwarpError(f"{name}: {count} events are too few to calibrate; record at least {FEWEST_EVENTS}")


def check_left(count: int, left_out: NDArray[np.bool_], name: str) -> None:
    """Enough events must remain without the hot and flickering pixels, True in ``left_out``."""
    if count < FEWEST_EVENTS:
        pixels = int(np.count_nonzero(left_out))
        raise AmiwarpError(
            f"{name}: without the pixels that flicker or fire at random, {pixels:,} in all, {count} events are left; "
            f"calibration needs at least {FEWEST_EVENTS}, of edges all over the image that the prism moves"
        )


def check_coverage(encoder: Encoder, t_first: int, t_last: int, name: str) -> None:
    """The encoder must know the angle of every event."""
    if not encoder.covers(t_first, t_last):
        first, last = encoder.coverage
        raise AmiwarpError(
            f"{name}: encoder samples cover {first} .. {last} us, the events {t_first} .. {t_last} us; "
            "record the encoder for as long as the events, or cut the events with a window"
        )


def check_pulses(encoder: Encoder, name: str) -> None:
    """Index pulses must come a turn apart: a steady drift is a wrong scale, counts per turn that are not the encoder's.

    Pulses may be missing, or come too often; what drifts in jumps is lost counts, which is not judged here.
    """
    if encoder.index_t is None or len(encoder.index_t) < FEWEST_PULSES:
        return
    at = encoder.pulse_angles() / math.tau
    steps = np.diff(at)
    turns = float(np.median(np.abs(steps)))
    if not turns > 0.0:
        return
    number = np.concatenate([[0.0], np.cumsum(np.rint(steps / turns))])
    slope, start = np.polyfit(number, at, 1)
    drift = abs(abs(slope) - 1.0) * float(np.ptp(number))
    off = float(np.abs(at - (start + slope * number)).max())
    # pulses of which every other is missing come a whole number of turns apart
    whole = abs(turns - max(1.0, round(turns))) * float(np.ptp(number)) <= LARGEST_DRIFT
    if drift > LARGEST_DRIFT and off <= STEADY * drift and not whole:
        raise wrong_scale(name, float(abs(slope)), "the index pulses come")


def wrong_scale(
    name: str, turns: float, what: str, cost: float | None = None, scaled: float | None = None
) -> AmiwarpError:
    """The error of an encoder in whose ``turns`` the prism turns once; ``what`` says so, costs are shares."""
    so = (
        "the encoder slips, or"
        if cost is None or scaled is None
        else f"with its angles divided by {turns:.4f} a still camera explains the events ({100 * scaled:.0f} % of the "
        f"residual remains instead of {100 * min(cost, 1.0):.0f} %):"
    )
    return AmiwarpError(
        f"{name}: {what} every {turns:.4f} turns of the encoder, not every turn; {so} its scale is off by a factor of "
        f"{turns:.4f}: read its log again with counts_per_turn (--counts-per-turn) times {turns:.4f}"
    )


def check_turn(theta: NDArray[np.float64], name: str) -> None:
    """Under a quarter turn, size and phase trade against each other."""
    turned = float(np.ptp(theta))
    if turned < SMALLEST_TURN:
        raise AmiwarpError(
            f"{name}: the prism turned {math.degrees(turned):.1f} degrees during the events; "
            "at least a quarter turn (90 degrees) is needed, a whole one is better"
        )


def check_light(mask: NDArray[np.bool_], summary: StrangeSummary, name: str) -> None:
    """A scene whose light flickers all over shows no edges of its own."""
    if mask.mean() > LARGEST_FLICKER:
        at = " and ".join(f"{hz:.0f}" for hz in summary.lamps_hz)
        raise AmiwarpError(
            f"{name}: {100 * mask.mean():.0f} % of the pixels flicker at {at} Hz; use light that does not, as the day's"
        )


def check_nominal(model: str, parameters: Mapping[str, float], nominal: Prism, name: str) -> None:
    """A prism is made to a few percent; one far from its data sheet is another, or its motion is not all there is."""
    size = size_name(model)
    if size not in parameters:
        return
    share = parameters[size] / (nominal.apex if size == "apex" else nominal.deflection)
    if not abs(share - 1.0) <= LARGEST_FROM_NOMINAL:
        raise AmiwarpError(
            f"{name}: the prism seems to have {100 * share:.0f} % of its nominal {size}, "
            f"{math.degrees(nominal.apex):.4g} deg of apex: the camera shakes with the prism, or the nominal prism or "
            f"the focal length is wrong; mend these, or give bounds of {size} if it is so"
        )


def significance(best: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """By how many standard deviations the sharpness of disjoint parts of the events is higher at one point."""
    gain = best - other
    spread = float(gain.std(ddof=1)) / math.sqrt(len(gain))
    return float(gain.mean()) / max(spread, 1e-12)


def _by(sure: float) -> str:
    """A significance in words; far below 0 its number says nothing."""
    return f"{sure:.1f} standard deviations" if sure > 0.0 else "it is less sharp, or the same"


def check_texture(
    best: NDArray[np.float64], turned: NDArray[np.float64], still: NDArray[np.float64], name: str
) -> None:
    """The optimum must be sharper than chance: each array holds the sharpness of disjoint parts of the events.

    ``turned`` is the same with half a turn added to the phase, ``still`` without any motion taken out.
    """
    sure = significance(best, turned)
    if not sure >= LEAST_SIGNIFICANCE:
        raise NotSharp(
            f"{name}: no motion of a prism makes the image sharper than chance does ({_by(sure)}): "
            "no texture, too few events, or a wrong encoder; show the camera a scene with edges"
        )
    sure = significance(best, still)
    if not sure >= LEAST_SIGNIFICANCE:
        raise NotSharp(
            f"{name}: the image is as sharp with no motion taken out ({_by(sure)}): "
            "no prism turned, its apex is too small for these events, or the encoder is wrong; record more events"
        )


def edge_coherence(image: NDArray[np.float32], smoothing: float = 1.5) -> float:
    """Coherence of the edge directions of an image: |Σ g² e^{2iφ}| / Σ g² over gradients (g, φ), 0 to 1.

    Noise has no direction of its own and lowers it, so gradients weaker than the median are left out.
    """
    from scipy.ndimage import gaussian_filter

    slopes: Any = np.gradient(gaussian_filter(image.astype(np.float32), smoothing))
    energy = slopes[0] ** 2 + slopes[1] ** 2
    strong = energy > 0.1 * energy.max()
    gy, gx = (slope[strong].astype(np.float64) for slope in slopes)
    total = float(np.sum(gx**2 + gy**2))
    return math.hypot(float(np.sum(gx**2 - gy**2)), float(np.sum(2.0 * gx * gy))) / total if total > 0.0 else 0.0


def check_directions(image: NDArray[np.float32], name: str) -> None:
    coherence = edge_coherence(image)
    if coherence > LARGEST_COHERENCE:
        raise AmiwarpError(
            f"{name}: all edges run in one direction (coherence {coherence:.2f} of 1), so motion along them "
            "is not seen; show the camera edges in at least two directions"
        )
