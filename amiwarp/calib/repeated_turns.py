"""Lost counts in the events: a still scene gives the same events in each turn, which tell the angle of the turn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.first_guess import ANGLE_RANGES, CELL
from amiwarp.calib.lost_counts import (
    FEWEST_PULSES,
    Step,
    changes_of_mean,
    few,
    located,
    steps_in_samples,
)
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording

Vector = NDArray[np.float64]
Spectrum = NDArray[np.complex128]

SAME_STEP = math.radians(0.5)
"""Largest difference of a step in the samples from the same one in the events [rad]."""
ANGLE_BINS = 96
"""Number of bins of the angle in a turn in which events are counted."""
FINE_BINS = 8192
"""Number of bins of the angle in a turn in which the angle of a turn is found."""
LEAST_CORRELATION = 0.3
"""Smallest correlation of the events of a turn with the events of the turns before it for the events to repeat. It was
0.5 for a still scene, and more with more events in a cell."""
MOST_CELLS = 1500
"""Largest number of cells in which events are counted."""


def steps_in_events(recording: Recording, encoder: Encoder) -> tuple[Step, ...]:
    """Return the steps that the events of a still scene show; nothing if they do not repeat in each turn.

    The samples tell when a step came, if they show it too. Otherwise it came within a turn.
    """
    starts = whole_turns(recording, encoder)
    if len(starts) <= 2 * FEWEST_PULSES:
        return ()
    shifts, correlation = shifts_of_turns(recording, encoder, starts)
    if float(np.median(correlation)) < LEAST_CORRELATION:
        return ()
    seen = steps_in_samples(encoder)
    starts_of_encoder = starts + round(encoder.clock_offset_us)
    last = len(shifts) - 1
    steps: list[Step] = []
    for k, size in changes_of_mean(shifts):
        # a step within a turn shifts part of it: it is the last turn before the step, or the first one after it
        before = abs(shifts[k - 1] - shifts[k - 2])
        after = abs(shifts[k] - shifts[min(k + 1, last)])
        turn = k if before > after else k + 1
        step = located(starts_of_encoder, turn, size, seen)
        steps.append(replace(step, angle=seen_size(step, seen)))
    return few(steps, encoder)


def seen_size(step: Step, seen: Sequence[Step]) -> float:
    """Return the size of a step in the samples, which is finer, if one ``seen`` came then and has that size."""
    for other in seen:
        is_then = other.first_us == step.first_us
        if is_then and abs(other.angle - step.angle) <= SAME_STEP:
            return other.angle
    return step.angle


def whole_turns(recording: Recording, encoder: Encoder) -> NDArray[np.int64]:
    """Return the event times at which the encoder begins its turns, counted from the first event on [us]."""
    first_covered, last_covered = encoder.coverage
    first = max(recording.events.t_first, first_covered)
    last = min(recording.events.t_last, last_covered)
    turn_us = 60e6 / max(abs(encoder.rpm), 1e-3)
    step_us = max(1, round(turn_us / ANGLE_BINS))
    t = np.arange(first, last + 1, step_us, dtype=np.int64)

    angle = encoder.angle_at(t)
    forward = (angle - angle[0]) * math.copysign(1.0, encoder.rpm)
    turned = np.maximum.accumulate(forward) / math.tau
    turns = np.arange(math.floor(float(turned[-1])) + 1)
    rising = turned + 1e-9 * np.arange(
        len(t)
    )  # a slope for the interpolation where the encoder stands
    starts = np.interp(turns, rising, t)
    return np.rint(starts).astype(np.int64)


def shifts_of_turns(
    recording: Recording,
    encoder: Encoder,
    starts: NDArray[np.int64],
) -> tuple[Vector, Vector]:
    """Return for each turn by how much its encoder angle exceeds the angle that its events tell [rad].

    They tell it by their correlation with the turns before; it is returned too. The first turn has 0 and 1.
    """
    sign = math.copysign(1.0, encoder.rpm)
    wave = np.arange(ANGLE_BINS // 2 + 1)
    shifts = [0.0]
    correlations = [1.0]
    # Sum of the spectra of the turns so far, each shifted by its own angle.
    total: Spectrum | None = None
    for begin, end in pairwise(starts.tolist()):
        spectrum = _spectrum_of_turn(recording, encoder, begin, end)
        if total is None:
            total = spectrum
            continue
        shift, correlation = _best_shift(total, spectrum)
        total = total + spectrum * np.exp(1j * wave * shift)[:, None]
        shifts.append(sign * shift)
        correlations.append(correlation)
    return np.unwrap(np.array(shifts)), np.array(correlations)


def _spectrum_of_turn(recording: Recording, encoder: Encoder, begin: int, end: int) -> Spectrum:
    """Return the spectrum over the angle of ON minus OFF events in each cell of a turn between two times [us]."""
    width, height = recording.events.size
    side = max(CELL, math.ceil(math.sqrt(width * height / MOST_CELLS)))
    columns = math.ceil(width / side)
    cells = columns * math.ceil(height / side)

    events = recording.events.between(begin, end)
    turned = encoder.angle_at(events.t) - encoder.angle_at([begin])
    bins_per_rad = math.copysign(1.0, encoder.rpm) * ANGLE_BINS / math.tau
    angle_bin = np.floor(turned * bins_per_rad).astype(np.int64) % ANGLE_BINS
    cell = events.y // side * columns + events.x // side
    signs = 2.0 * events.p - 1.0
    sums = np.bincount(angle_bin * cells + cell, signs, ANGLE_BINS * cells)
    counts = sums.reshape(ANGLE_BINS, cells)
    return np.fft.rfft(counts - counts.mean(axis=0), axis=0)


def _best_shift(total: Spectrum, spectrum: Spectrum) -> tuple[float, float]:
    """Return the angle at which a turn is most like the turns before it [rad], and how much it is: the correlation."""
    products = (np.conj(total) * spectrum).sum(axis=1)
    likeness = np.fft.irfft(products, FINE_BINS)
    best = int(np.argmax(likeness))
    bins = best if best < FINE_BINS // 2 else best - FINE_BINS
    shift = bins * math.tau / FINE_BINS

    energy = float((np.abs(total) ** 2).sum())
    energy_of_turn = float((np.abs(spectrum) ** 2).sum())
    size = math.sqrt(energy * energy_of_turn)
    correlation = 0.5 * FINE_BINS * float(likeness[best]) / max(size, 1e-30)
    return shift, correlation


def counts_of(turn: Events, encoder: Encoder, size: tuple[int, int]) -> Vector:
    """Return the events of a turn, ON minus OFF, by cell of the image and range of prism angles, flattened."""
    width, height = size
    columns = math.ceil(width / CELL)
    rows = math.ceil(height / CELL)
    ranges = np.floor(encoder.angle_at(turn.t) * (ANGLE_RANGES / math.tau))
    angle = ranges.astype(np.int64) % ANGLE_RANGES
    row = (turn.y // CELL).astype(np.int64)
    cell = row * columns + turn.x // CELL
    signs = 2.0 * turn.p - 1.0
    bins = rows * columns * ANGLE_RANGES
    counts = np.bincount(cell * ANGLE_RANGES + angle, weights=signs, minlength=bins)
    return np.asarray(counts, np.float64)


def repetition(before: Vector, counts: Vector) -> float:
    """Return the correlation of the events of a turn with the turn before."""
    energy = math.sqrt(float(counts @ counts) * float(before @ before))
    return float(counts @ before) / max(energy, 1e-30)
