"""Random combinations of mild troubles: no constant of the calibration was chosen with them."""

from dataclasses import replace
from typing import Any

import numpy as np

from amiwarp.studies.stability import optics
from amiwarp.studies.stability.axes import OPTIC_TROUBLES, TURNING
from amiwarp.studies.stability.condition import (
    LARGEST_VALUES,
    OPTIC_ALWAYS,
    SMALLEST_VALUES,
    Condition,
)
from amiwarp.studies.stability.scenes import SceneKind

COMBINED_SHARE = 0.5
"""Largest size of a trouble in a random combination with an optic, relative to the largest sensible one."""
SHARE_OF_EACH = 0.25
"""Probability of each trouble in a combination."""
NOT_DRAWN = ("window_events", "hunt_hz", "swapped")
"""Fields of troubles that no combination with an optic draws in their order."""
TROUBLES_OF_COUNTS = ("eccentric_deg", "second_deg", "third_deg", "lost_once_deg")
"""Fields of troubles that need an encoder with more than index pulses."""


def mild_optic(seed: int) -> Condition:
    """Return a random combination of an optic's troubles; the optics take turns. All sizes are drawn uniformly."""
    rng = np.random.default_rng([seed, 0x0971C])
    optic = optics.OPTICS[seed % len(optics.OPTICS)]
    values: dict[str, Any] = {name: _drawn(rng, span) for name, span in OPTIC_ALWAYS.items()}
    pulses = optic in TURNING and rng.uniform() < SHARE_OF_EACH
    for trouble in OPTIC_TROUBLES:
        name = trouble.axis.field
        if optic not in trouble.optics or name in OPTIC_ALWAYS or name in NOT_DRAWN:
            continue
        largest = LARGEST_VALUES[name] if name in LARGEST_VALUES else SMALLEST_VALUES[name]
        size = COMBINED_SHARE * float(rng.uniform()) * largest
        chosen = rng.uniform() < SHARE_OF_EACH

        # An encoder gives index pulses or counts, and has the troubles of these.
        needs_pulses = ("index_only", True) in trouble.axis.also
        needs_counts = name in TROUBLES_OF_COUNTS
        possible = not needs_counts if pulses else not needs_pulses
        if chosen and possible:
            values[name] = round(size, 5)
    if pulses:
        values["index_only"] = True
        values["hunt_hz"] = round(float(rng.uniform(3.0, LARGEST_VALUES["hunt_hz"])), 3)
    return Condition(optic=optic, **values)


def _drawn(rng: np.random.Generator, span: tuple[float, float]) -> float:
    """Return a random value of a range, rounded."""
    return round(float(rng.uniform(*span)), 5)


ALWAYS: dict[str, tuple[float, float]] = {
    "apex_deg": (0.5, 2.0), "rpm": (400.0, 1200.0), "turns": (3.0, 6.0), "fov_deg": (45.0, 75.0),
    "contrast": (0.15, 0.35), "mismatch": (0.0, 0.08), "noise": (0.0, 0.3), "latency_us": (50.0, 300.0),
}  # fmt: skip
"""Ranges of the condition fields that every combination draws."""

TROUBLES: dict[str, tuple[float, float]] = {
    "eccentric_deg": (0.0, 2.0), "second_deg": (0.0, 0.5), "turn_ripple": (0.0, 0.05), "cylinder_deg": (0.0, 0.1),
    "wobble_deg": (0.0, 0.5), "focal_error": (-0.02, 0.02), "principal_px": (-5.0, 5.0), "distortion": (-0.05, 0.0),
    "aspect_error": (-0.02, 0.02), "index_error": (-0.03, 0.03), "lost": (0.0, 0.1), "lost_part": (0.0, 0.3),
}  # fmt: skip
"""Troubles, and their ranges. Each combination has a quarter of them; ripple only shows with an index pulse alone."""

DRAWS = 300
"""Number of random combinations of the whole study."""


def mild(seed: int) -> Condition:
    """Return a random combination of mild troubles. All values are drawn uniformly."""
    rng = np.random.default_rng([seed, 0x41D])
    scenes = (SceneKind.TEXTURE, SceneKind.EDGES, SceneKind.PRINT)
    scene = scenes[rng.integers(len(scenes))]
    values = {name: _drawn(rng, span) for name, span in ALWAYS.items()}
    for name, span in TROUBLES.items():
        # All are drawn, so that each has the same value whether others are there or not.
        size = _drawn(rng, span)
        if rng.uniform() < SHARE_OF_EACH:
            values[name] = size
    condition = Condition(scene=scene.value, timing_known=True, **values)  # type: ignore[arg-type]
    if condition.turn_ripple:
        return replace(condition, index_only=True, eccentric_deg=0.0, second_deg=0.0)
    return condition
