"""Edges, and what moved, in the whole turns of the shown window: from sums of its events in phase with the optic."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder_speed import turn_between
from amiwarp.reconstruction.image_in_phase import PhaseImage, phase_image
from amiwarp.reconstruction.locked_angles import MotionPeriod
from amiwarp.reconstruction.phase_window import harmonics_for, sums_of_turns
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.shown_window import LoadedWindow

MOST_TURNS = 4
"""Largest number of turns that are summed, so that it takes less than a second."""


def phase_of_window(
    inspector: Inspector, window: LoadedWindow, knobs: Knobs
) -> tuple[PhaseImage, str]:
    """Return what the whole turns of a window tell of all pixels, and which turns these are.

    A window of less than a turn is lengthened to one, towards the start where the recording ends.

    Raises :class:`AmiwarpError` if the optic does not rotate, or the recording has no whole turn.
    """
    events = inspector.recording.events
    model = inspector.model_of(knobs)
    both = inspector.encoder_of(knobs)
    period = MotionPeriod.of(model, both, events.t_first, events.t_last)
    turn_us = turn_between(period.encoder, events.t_first, events.t_last)
    if turn_us is None:
        raise AmiwarpError(
            "edges and misfit need an optic that rotates; set its speed (rpm), or calibrate"
        )
    span = window.span
    least_us = math.ceil(turn_us)
    length_us = int(min(max(span.length_us, least_us), MOST_TURNS * least_us))
    start_us = max(events.t_first, min(span.start_us, events.t_last - length_us))
    harmonics = harmonics_for(model, period.locked(start_us, start_us + least_us))
    sums, stop_us = sums_of_turns(
        events, period.encoder, start_us, length_us, harmonics=harmonics, device=inspector.device
    )
    sums = replace(sums, locked=period.locked(start_us, stop_us))
    turns = round(sums.turns)
    begins_ms = (start_us - events.t_first) * 1e-3
    note = f"{turns} turn{'s' if turns > 1 else ''} from {begins_ms:.1f} ms"
    return phase_image(sums, model), note


def edge_strength(image: PhaseImage) -> NDArray[np.float32]:
    """Return the size of the gradient of the log intensity [ON thresholds/px], shape ``(height, width)``."""
    return np.hypot(image.gradient[0], image.gradient[1])
