"""Estimate of the prism's phase at first sight, so that the page opens with compensated events."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.viewer.imager import WindowImager
from amiwarp.viewer.parameters import Source

if TYPE_CHECKING:
    from amiwarp.viewer.inspector import Inspector

COARSE = 24
"""Number of phases of the first search, over one turn."""
FINER = (3.0, 12.0)
"""Divisors of the step of the first search, for the steps of the second and the third one."""
LEAST_GAIN = 1.3
"""Smallest ratio of the sharpness at the best phase to that at the median phase. It is 2 to 3 for scenes, and 1.1 for
random events."""


def estimate_phase(inspector: Inspector) -> bool:
    """Set an unknown phase to that with the highest sharpness of the time window; return whether there is one.

    A phase that is known, from a calibration or by hand, is kept. So is any phase if the prism does not rotate, or if
    no phase sharpens the image.
    """
    if inspector.sources["phase"] is not Source.ASSUMED or not math.isfinite(inspector.turn_us):
        return False
    measure = inspector.sharpness_meter(WindowImager(inspector.recording.events.size, inspector.device))
    sharpness: dict[float, float] = {}

    def best(phases: list[float]) -> float:
        for phase in phases:
            if phase not in sharpness:
                sharpness[phase] = measure(replace(inspector.knobs, phase=phase))
        return max(sharpness, key=lambda phase: sharpness[phase])

    step = math.tau / COARSE
    found = best((step * np.arange(COARSE) - math.pi).tolist())
    usual = float(np.median([*sharpness.values()]))
    for share in FINER:
        found = best([found + k * step / share for k in (-2, -1, 1, 2)])
    if sharpness[found] < max(measure(None), LEAST_GAIN * usual):
        return False
    inspector.set(replace(inspector.knobs, phase=found))
    inspector.sources["phase"] = Source.ESTIMATED
    return True
