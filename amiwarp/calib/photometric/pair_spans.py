"""How many pairs of events the photometric stage takes, and the time spans that they come from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording
from amiwarp.optics.models.registry import MODELS

if TYPE_CHECKING:
    from amiwarp.calib.sharpness_search import Search

WITHOUT_GLASS = 3
"""Factor of the number of pairs for a mirror or a vibrating camera. Their parameters need a map with several nodes per
pixel: with a coarser one, the worst of 30 simulated mirrors was wrong by 0.024 px, with it by 0.008 px."""


def turn_length(recording: Recording, encoder: Encoder) -> float:
    """Return the duration of a turn of the prism [us]; the duration of the recording if it is shorter."""
    events = recording.events
    duration_us = float(events.t_last - events.t_first + 1)
    turn_us = 60e6 / max(abs(encoder.rpm), 1e-6)
    return min(turn_us, duration_us)


def time_spans(recording: Recording, search: Search) -> list[tuple[int, int]]:
    """Return the time spans whose events give pairs, in the order of their use [us]: turns of the prism.

    A rotating camera needs successive turns, so it gets one span.
    """
    first = recording.events.t_first
    end = recording.events.t_last + 1
    if search.full_space.moving:
        return [(first, end)]
    turn_us = turn_length(recording, search.calibration_events.encoder)
    turns = max(1, int((end - first) / turn_us))
    spans = []
    for k in van_der_corput(turns):
        start = first + int(k * turn_us)
        spans.append((start, start + int(turn_us)))
    return spans


def most_pairs(search: Search) -> int:
    """Return the approximate largest number of pairs."""
    pairs = search.settings.photometric.pairs
    if MODELS[search.space.model].PRISM:
        return pairs
    return pairs * WITHOUT_GLASS


def van_der_corput(n: int) -> list[int]:
    """Return 0 … n-1 in van der Corput's order: the first k numbers are evenly spread for every k."""
    bits = max(1, (n - 1).bit_length())
    order = []
    for k in range(1 << bits):
        binary = f"{k:0{bits}b}"
        mirrored = int(binary[::-1], 2)
        if mirrored < n:
            order.append(mirrored)
    return order
