"""Estimate of the prism's phase at first sight, so that the page opens with compensated events."""

import math
from dataclasses import replace
from functools import cache

import numpy as np

from amiwarp.imaging.regions import MOST_SEARCHED, busiest
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Source
from amiwarp.viewer.selected_part import select_part

COARSE = 24
"""Number of phases of the first search, over one turn."""
FINER = (3.0, 12.0)
"""Divisors of the step of the first search, for the steps of the second and the third one."""
LEAST_GAIN = 1.3
"""Smallest ratio of the sharpness at the best phase to the median sharpness over all phases. It is 2 to 3 for scenes,
and 1.1 for random events."""


def estimate_phase(inspector: Inspector) -> bool:
    """Set an unknown phase to the one with the highest sharpness of the time window; return whether there is one.

    A phase that is known, from a calibration or by hand, is kept. So is any phase if the prism does not rotate, or if
    no phase sharpens the image.
    """
    if inspector.sources["phase"] is not Source.ASSUMED or not math.isfinite(inspector.turn_us):
        return False
    searched = inspector
    window = inspector.loaded
    size = inspector.recording.events.size
    if math.prod(size) > MOST_SEARCHED:
        # Of a large sensor, the part with most events, so that the search stays short.
        region = busiest(inspector.counts(window, None))
        part, start_us, length_us, _ = select_part(inspector, window, region)
        searched = Inspector(part, device=inspector.device)
        searched.set(inspector.knobs)
        searched.window = start_us, length_us
    measure = searched.sharpness_meter()

    @cache
    def sharpness(phase: float) -> float:
        return measure(replace(inspector.knobs, phase=phase))

    step = math.tau / COARSE
    phases = (step * np.arange(COARSE) - math.pi).tolist()
    found = max(phases, key=sharpness)
    usual = float(np.median([*map(sharpness, phases)]))
    for share in FINER:
        around = [found + k * step / share for k in range(-2, 3)]
        found = max(around, key=sharpness)
    if sharpness(found) < max(measure(None), LEAST_GAIN * usual):
        return False
    inspector.set(replace(inspector.knobs, phase=found))
    inspector.sources["phase"] = Source.ESTIMATED
    return True
