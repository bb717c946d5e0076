"""Speed of the prism during the events. It differs from the mean of all samples if the motor starts or stops."""

from __future__ import annotations

import math

from amiwarp.events.encoder import Encoder

LEAST_RPM = 1e-3
"""Speed up to which a prism counts as at rest [turns/min]."""


def rpm_between(encoder: Encoder, t_first: int, t_last: int) -> float:
    """Return the mean speed between two event times [turns/min], negative if the angle decreases.

    Only the part of the time [us] within :attr:`Encoder.coverage` counts; if there is none, all samples count.
    """
    first = max(t_first, encoder.coverage[0])
    last = min(t_last, encoder.coverage[1])
    if first >= last:
        return encoder.rpm
    start, end = encoder.angle_at([first, last]).tolist()
    return float((end - start) / math.tau * 60e6 / (last - first))


def turn_between(encoder: Encoder, t_first: int, t_last: int) -> float | None:
    """Return the mean duration of a turn between two event times [us]; None if the prism is at rest."""
    rpm = abs(rpm_between(encoder, t_first, t_last))
    return 60e6 / rpm if rpm > LEAST_RPM else None
