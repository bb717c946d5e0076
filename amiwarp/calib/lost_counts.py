"""Counts that an encoder lost: steps of its angle that the prism did not make.

A prism has inertia, so its angle follows its speed; an encoder that loses counts falls behind at once. Where there are
index pulses, they tell the size of a step, and the turn in which it came; the samples tell when. :func:`lost_counts`
finds the steps in the encoder alone, :func:`steps_in_events` in the events of a still scene, which repeat every turn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.first_guess import CELL
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording

Vector = NDArray[np.float64]

LEAST_STEP = math.radians(0.5)
"""Smallest step that is looked for [rad]."""
SIGNIFICANT = 8.0
"""Number of standard deviations from which on a step is significant. The speed of a prism that hunts makes no such
steps, because it changes over many samples."""
BESIDE, SPEED_SAMPLES = 5, 20
"""Number of samples on either side of a step that tell its size, and about it that tell the speed."""
AT_ONCE = 0.5
"""Smallest share of a step that comes between two samples."""
SAMPLES_PER_TURN = 16
"""Smallest number of samples per turn in which steps can be seen."""
MOST_STEPS, MOST_PER_TURN = 8, 0.5
"""Largest number of steps, and of steps in a turn. An encoder that slips all the time has another trouble, such as a
loose wheel, which is refused as a wrong scale."""
FEWEST_PULSES = 3
"""Smallest number of index pulses on either side of a step that tell its size."""
STEP_SHARE = 0.7
"""Smallest share of a change of the mean that comes between the pulses next to it. A steady drift has less."""
ALIKE = 0.3
"""Largest difference of a step in the samples from that at the index pulses, as a share of it."""


@dataclass(frozen=True)
class Step:
    """Step of an encoder's angle that the prism did not make."""

    first_us: int
    """Time before the step, on the encoder's clock [us]."""
    last_us: int
    """Time after the step [us]. Between both the angle is taken to change evenly."""
    angle: float
    """Size of the step [rad]: negative if the encoder fell behind a positive rotation."""

    def in_words(self, begin_us: int) -> str:
        """Return the step in words, with its time after ``begin_us``."""
        first, last = (1e-6 * (t - begin_us) for t in (self.first_us, self.last_us))
        when = f"at {first:.3f} s" if last - first < 0.01 else f"between {first:.2f} and {last:.2f} s"
        return f"{math.degrees(self.angle):+.2f} deg {when}"


def steps_in_words(steps: Sequence[Step], begin_us: int) -> str:
    """Return in words by how much an encoder's angle is wrong from when on, with times after ``begin_us``."""
    return f"the encoder's angle steps by {', '.join(step.in_words(begin_us) for step in steps)}"


def without_steps(encoder: Encoder, steps: Sequence[Step]) -> Encoder:
    """Return the encoder without some steps. Its angle is again a multiple of 2 pi at the median index pulse."""
    angle = encoder.angle.copy()
    for step in steps:
        angle -= step.angle * np.clip((encoder.t - step.first_us) / (step.last_us - step.first_us), 0.0, 1.0)
    mended = replace(encoder, angle=angle)
    return mended if encoder.index_t is None or not len(encoder.index_t) else mended.with_index(encoder.index_t)


def lost_counts(encoder: Encoder) -> tuple[Step, ...]:
    """Return the steps that the index pulses of an encoder show if it has enough of them, else those of its samples."""
    seen = steps_in_samples(encoder)
    if encoder.index_t is None or len(encoder.index_t) < 2 * FEWEST_PULSES:
        return few(seen, encoder)
    slips, pulses = np.unwrap(encoder.slip()), encoder.index_t
    return few([_located(pulses, k, size, seen) for k, size in changes_of_mean(slips)], encoder)


def few(steps: Sequence[Step], encoder: Encoder) -> tuple[Step, ...]:
    """Return the steps of an encoder, or nothing if there are too many."""
    turns = abs(float(encoder.angle[-1] - encoder.angle[0])) / math.tau
    return tuple(steps) if len(steps) <= min(MOST_STEPS, max(1.0, MOST_PER_TURN * turns)) else ()


def _located(times: NDArray[np.int64], k: int, size: float, seen: Sequence[Step]) -> Step:
    """Return a step between two of some times, those before the index ``k`` and at it [us].

    If one of the steps ``seen`` in the samples is like it, it came when that one did. The scatter of pulses may have
    hidden which pulse was the first one after the step.
    """
    before, after = int(times[max(0, k - 2)]), int(times[min(k + 1, len(times) - 1)])
    alike = [s for s in seen if before <= s.first_us <= after and abs(s.angle - size) <= ALIKE * abs(size)]
    if not alike:
        return Step(int(times[k - 1]), int(times[k]), size)
    nearest = min(alike, key=lambda s: abs(s.angle - size))
    return replace(nearest, angle=size)


def steps_in_samples(encoder: Encoder) -> list[Step]:
    """Return the steps between two samples that the speed before and after them does not explain."""
    t, angle, spread = encoder.t, encoder.angle, max(BESIDE, SPEED_SAMPLES // 2)
    interval = np.diff(t).astype(np.float64)
    if len(t) < 4 * spread or abs(encoder.rpm) * float(np.median(interval)) * SAMPLES_PER_TURN > 60e6:
        return []
    # the angle about each interval between two samples, without the part that the speed before and after it explains
    at = np.arange(spread, len(t) - spread - 1)
    before, after = at - spread, at + 1 + spread
    turned = (angle[at] - angle[before]) + (angle[after] - angle[at + 1])
    speed = turned / ((t[at] - t[before]) + (t[after] - t[at + 1]))
    around = at[:, None] + np.arange(1 - BESIDE, BESIDE + 1)
    left = angle[around] - angle[at][:, None] - speed[:, None] * (t[around] - t[at][:, None])
    size = np.median(left[:, BESIDE:], axis=1) - np.median(left[:, :BESIDE], axis=1)
    at_once = np.diff(angle)[at] - speed * interval[at]
    scatter = 1.4826 * float(np.median(np.abs(size - np.median(size))))
    strong = (np.abs(size) > max(LEAST_STEP, SIGNIFICANT * scatter)) & (at_once * size > AT_ONCE * size**2)
    steps: list[Step] = []
    for k in np.flatnonzero(strong):
        near = slice(max(0, k - BESIDE), k + BESIDE + 1)
        if abs(at_once[k]) == np.abs(at_once[near][strong[near]]).max():
            steps.append(Step(int(t[at[k]]), int(t[at[k] + 1]), float(size[k])))
    return steps


def changes_of_mean(values: Vector, least: float = LEAST_STEP) -> list[tuple[int, float]]:
    """Return where the mean of some values changes, as the index of the first value after it, and by how much.

    A change is significant beyond the scatter from value to value. A steady drift has none.
    """
    scatter = 1.4826 * float(np.median(np.abs(np.diff(values)))) / math.sqrt(2.0)
    edges = [0, len(values)]
    while len(edges) <= MOST_STEPS + 2:
        found: list[tuple[float, int]] = []
        for first, last in pairwise(edges):
            for k in range(first + FEWEST_PULSES, last - FEWEST_PULSES + 1):
                change = float(np.mean(values[k:last]) - np.mean(values[first:k]))
                spread = math.sqrt(1.0 / (k - first) + 1.0 / (last - k))
                beside = np.median(values[k : k + FEWEST_PULSES]) - np.median(values[k - FEWEST_PULSES : k])
                drifts = beside * change < STEP_SHARE * change**2
                if abs(change) > max(least, SIGNIFICANT * scatter * spread) and not drifts:
                    found.append((abs(change) / spread, k))
        if not found:
            break
        edges = sorted([*edges, max(found)[1]])
    means = [float(np.median(values[first:last])) for first, last in pairwise(edges)]
    return [(k, after - before) for k, before, after in zip(edges[1:-1], means[:-1], means[1:], strict=True)]


# Steps in the events. A still scene gives the same events in each turn, so that those of a turn tell its angle.

SAME_STEP = math.radians(0.5)
"""Largest difference of a step in the samples from the same one in the events [rad]."""
ANGLE_BINS, FINE_BINS = 96, 8192
"""Number of bins of the angle in a turn in which events are counted, and in which the angle of a turn is found."""
LEAST_CORRELATION = 0.3
"""Smallest correlation of the events of a turn with those of the turns before it for the events to repeat. That of a
still scene was 0.5, and more with more events in a cell."""
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
    seen, steps = steps_in_samples(encoder), list[Step]()
    for k, size in changes_of_mean(shifts):
        # a step within a turn shifts part of it: it is the last turn before the step, or the first one after it
        partly = abs(shifts[k - 1] - shifts[k - 2]) > abs(shifts[k] - shifts[min(k + 1, len(shifts) - 1)])
        step = _located(starts + round(encoder.clock_offset_us), k if partly else k + 1, size, seen)
        steps.append(replace(step, angle=seen_size(step, seen)))
    return few(steps, encoder)


def seen_size(step: Step, seen: Sequence[Step]) -> float:
    """Return the size of a step in the samples, which is finer, if one ``seen`` came then and has that size."""
    sizes = (s.angle for s in seen if s.first_us == step.first_us and abs(s.angle - step.angle) <= SAME_STEP)
    return next(sizes, step.angle)


def whole_turns(recording: Recording, encoder: Encoder) -> NDArray[np.int64]:
    """Return the event times at which the encoder begins its turns, counted from the first event on [us]."""
    first = max(recording.events.t_first, encoder.coverage[0])
    last = min(recording.events.t_last, encoder.coverage[1])
    t = np.arange(first, last + 1, max(1, round(60e6 / max(abs(encoder.rpm), 1e-3) / ANGLE_BINS)), dtype=np.int64)
    angle = encoder.angle_at(t)
    turned = np.maximum.accumulate((angle - angle[0]) * math.copysign(1.0, encoder.rpm)) / math.tau
    turns = np.arange(math.floor(float(turned[-1])) + 1)
    return np.rint(np.interp(turns, turned + 1e-9 * np.arange(len(t)), t)).astype(np.int64)


def shifts_of_turns(recording: Recording, encoder: Encoder, starts: NDArray[np.int64]) -> tuple[Vector, Vector]:
    """Return for each turn by how much its encoder angle exceeds the angle that its events tell [rad].

    They tell it by their correlation with the turns before; it is returned too. The first turn has 0 and 1.
    """
    (width, height), sign = recording.events.size, math.copysign(1.0, encoder.rpm)
    side = max(CELL, math.ceil(math.sqrt(width * height / MOST_CELLS)))
    columns = -(-width // side)
    cells = columns * -(-height // side)
    wave = np.arange(ANGLE_BINS // 2 + 1)
    shifts, correlation = [0.0], [1.0]
    total: NDArray[np.complex128] | None = None
    for begin, end in pairwise(starts.tolist()):
        e = recording.events.between(begin, end)
        turned = (encoder.angle_at(e.t) - encoder.angle_at([begin])) * (sign * ANGLE_BINS / math.tau)
        at = (np.floor(turned).astype(np.int64) % ANGLE_BINS) * cells + e.y // side * columns + e.x // side
        counts = np.bincount(at, 2.0 * e.p - 1.0, ANGLE_BINS * cells).reshape(ANGLE_BINS, cells)
        spectrum = np.fft.rfft(counts - counts.mean(axis=0), axis=0)
        if total is None:
            total = spectrum
            continue
        product = np.fft.irfft((np.conj(total) * spectrum).sum(axis=1), FINE_BINS)
        size = math.sqrt(float((np.abs(total) ** 2).sum()) * float((np.abs(spectrum) ** 2).sum()))
        best = int(np.argmax(product))
        shift = (best if best < FINE_BINS // 2 else best - FINE_BINS) * math.tau / FINE_BINS
        total = total + spectrum * np.exp(1j * wave * shift)[:, None]
        shifts.append(sign * shift)
        correlation.append(0.5 * FINE_BINS * float(product[best]) / max(size, 1e-30))
    return np.unwrap(np.array(shifts)), np.array(correlation)
