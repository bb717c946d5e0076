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

from amiwarp.events.encoder import Encoder

Vector = NDArray[np.float64]


LEAST_STEP = math.radians(0.5)
"""Smallest step that is looked for [rad]."""
SIGNIFICANT = 8.0
"""Number of standard deviations above which a step is significant. The speed of a prism that hunts makes no such
steps, because it changes over many samples."""
AROUND = 10
DEGREE = 3
"""Number of samples on either side of a step that tell its size, and degree of the polynomial that their path is beside
it. A straight path bends away: an encoder with an error that repeats every turn hid steps of 1.3 deg, now of 0.5 deg.
"""
BESIDE = 5
"""Number of intervals on either side of a step that show it too."""
RIDGE = 1e-9
"""Weight of the squares of the polynomial's coefficients, which samples on either side of a long pause do not tell."""
AT_A_TIME = 65536
"""Number of intervals that are examined at a time, which bounds the memory."""
AT_ONCE = 0.8
"""Smallest share of a step that comes between two samples. With 0.5, counts that were lost within 3 ms, and pauses of
the samples, made steps of a part of them."""
SAMPLES_PER_TURN = 16
"""Smallest number of samples per turn in which steps can be seen."""
MOST_STEPS = 8
MOST_PER_TURN = 0.5
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
        first = 1e-6 * (self.first_us - begin_us)
        last = 1e-6 * (self.last_us - begin_us)
        when = f"between {first:.2f} and {last:.2f} s"
        if last - first < 0.01:
            when = f"at {first:.3f} s"
        return f"{math.degrees(self.angle):+.2f} deg {when}"


def steps_in_words(name: str, steps: Sequence[Step], begin_us: int) -> str:
    """Return in words by how much the angle with a name is wrong from when on, with times after ``begin_us``."""
    listed = ", ".join(step.in_words(begin_us) for step in steps)
    return f"{name} steps by {listed}"


def without_steps(encoder: Encoder, steps: Sequence[Step]) -> Encoder:
    """Return the encoder without some steps. Its angle is again a multiple of 2 pi at the median index pulse."""
    angle = encoder.angle.copy()
    for step in steps:
        duration = step.last_us - step.first_us
        share = (encoder.t - step.first_us) / duration
        angle -= step.angle * np.clip(share, 0.0, 1.0)
    mended = replace(encoder, angle=angle)
    pulses = encoder.index_t
    if pulses is None or not len(pulses):
        return mended
    return mended.with_index(pulses)


def lost_counts(encoder: Encoder) -> tuple[Step, ...]:
    """Return the steps that an encoder's index pulses show if it has enough of them, else the steps of its samples."""
    seen = steps_in_samples(encoder)
    pulses = encoder.index_t
    if pulses is None or len(pulses) < 2 * FEWEST_PULSES:
        return few(seen, encoder)
    slips = np.unwrap(encoder.slip())
    steps = []
    for k, size in changes_of_mean(slips):
        steps.append(located(pulses, k, size, seen))
    return few(steps, encoder)


def few(steps: Sequence[Step], encoder: Encoder) -> tuple[Step, ...]:
    """Return the steps of an encoder, or nothing if there are too many."""
    turned = abs(float(encoder.angle[-1] - encoder.angle[0]))
    turns = turned / math.tau
    most = min(MOST_STEPS, max(1.0, MOST_PER_TURN * turns))
    if len(steps) > most:
        return ()
    return tuple(steps)


def located(
    times: NDArray[np.int64],
    k: int,
    size: float,
    seen: Sequence[Step],
) -> Step:
    """Return a step between two of some times, those before the index ``k`` and at it [us].

    If one of the steps ``seen`` in the samples is like it, it came when that one did. The scatter of pulses may have
    hidden which pulse was the first one after the step.
    """
    before = int(times[max(0, k - 2)])
    after = int(times[min(k + 1, len(times) - 1)])
    most_off = ALIKE * abs(size)
    alike = []
    for step in seen:
        is_then = before <= step.first_us <= after
        if is_then and abs(step.angle - size) <= most_off:
            alike.append(step)
    if not alike:
        return Step(int(times[k - 1]), int(times[k]), size)
    nearest = min(alike, key=lambda step: abs(step.angle - size))
    return replace(nearest, angle=size)


def steps_in_samples(encoder: Encoder) -> list[Step]:
    """Return the steps between two samples that the speed before and after them does not explain."""
    t = encoder.t
    if len(t) < 4 * AROUND:
        return []
    usual_interval = float(np.median(np.diff(t)))
    if abs(encoder.rpm) * usual_interval * SAMPLES_PER_TURN > 60e6:
        return []
    sample = np.arange(AROUND - 1, len(t) - AROUND)
    parts = np.array_split(sample, math.ceil(len(sample) / AT_A_TIME))
    fits = [_fit_steps(encoder, part) for part in parts]
    size, at_once, share = np.concatenate(fits, axis=1)

    # A step in a long pause counts less: a smooth path through the samples on either side takes up most of it.
    told = size * share / np.median(share)
    scatter = _scatter(told - np.median(told))
    strong = np.abs(told) > max(LEAST_STEP, SIGNIFICANT * scatter)

    # A step comes at once. A prism that changes its speed takes many samples.
    strong &= at_once * size > AT_ONCE * size**2
    steps: list[Step] = []
    for k in np.flatnonzero(strong):
        # Intervals beside a step show it too: it is in the one with the largest change.
        near = slice(max(0, k - BESIDE), k + BESIDE + 1)
        rivals = np.abs(at_once[near][strong[near]])
        if abs(at_once[k]) == rivals.max():
            first = sample[k]
            steps.append(Step(int(t[first]), int(t[first + 1]), float(size[k])))
    return steps


def _fit_steps(encoder: Encoder, sample: NDArray[np.int64]) -> Vector:
    """Return what the samples around some intervals tell of a step in each, shape (3, n).

    ``sample``: indices of the samples before the intervals, shape (n,). The rows are the size of the step [rad], the
    part of it that comes in the interval [rad], and the sum of the squares that a smooth path leaves of a step of 1.
    """
    around = sample[:, None] + np.arange(1 - AROUND, AROUND + 1)
    angle = encoder.angle[around] - encoder.angle[sample][:, None]
    elapsed = encoder.t[around] - 0.5 * (encoder.t[sample] + encoder.t[sample + 1])[:, None]
    reach = np.abs(elapsed).max(axis=1, keepdims=True)
    smooth = (elapsed / reach)[:, :, None] ** np.arange(DEGREE + 1)
    by_smooth = np.swapaxes(smooth, 1, 2)
    inverse = np.linalg.inv(by_smooth @ smooth + RIDGE * np.eye(DEGREE + 1))

    def fitted(values: Vector) -> Vector:
        return np.asarray((smooth @ (inverse @ (by_smooth @ values[:, :, None])))[:, :, 0])

    step = np.broadcast_to(np.repeat([-0.5, 0.5], AROUND), angle.shape)
    left = step - fitted(step)
    share = np.sum(left**2, axis=1)
    size = np.sum(left * angle, axis=1) / share
    path = fitted(angle - size[:, None] * step)
    before = AROUND - 1
    after = AROUND
    at_once = (angle[:, after] - path[:, after]) - (angle[:, before] - path[:, before])
    return np.stack([size, at_once, share])


def _scatter(differences: Vector) -> float:
    """Return the standard deviation of some differences about 0, without regard of outliers."""
    return 1.4826 * float(np.median(np.abs(differences)))


def changes_of_mean(values: Vector, least: float = LEAST_STEP) -> list[tuple[int, float]]:
    """Return where the mean of some values changes, as the index of the first value after it, and by how much.

    A change is significant beyond the scatter from value to value. A steady drift has none.
    """
    scatter = _scatter(np.diff(values)) / math.sqrt(2.0)
    edges = [0, len(values)]
    while len(edges) <= MOST_STEPS + 2:
        edge = _clearest_change(values, edges, least, scatter)
        if edge is None:
            break
        edges = sorted([*edges, edge])

    means = []
    for first, last in pairwise(edges):
        means.append(float(np.median(values[first:last])))
    changes = [after - before for before, after in pairwise(means)]
    return list(zip(edges[1:-1], changes, strict=True))


def _clearest_change(
    values: Vector,
    edges: list[int],
    least: float,
    scatter: float,
) -> int | None:
    """Return the index of the most significant change of the mean between known edges; None if there is none."""
    found: list[tuple[float, int]] = []
    for first, last in pairwise(edges):
        for k in range(first + FEWEST_PULSES, last - FEWEST_PULSES + 1):
            mean_before = np.mean(values[first:k])
            mean_after = np.mean(values[k:last])
            change = float(mean_after - mean_before)
            spread = math.sqrt(1.0 / (k - first) + 1.0 / (last - k))
            if not abs(change) > max(least, SIGNIFICANT * scatter * spread):
                continue
            just_before = np.median(values[k - FEWEST_PULSES : k])
            just_after = np.median(values[k : k + FEWEST_PULSES])
            drifts = (just_after - just_before) * change < STEP_SHARE * change**2
            if not drifts:
                found.append((abs(change) / spread, k))
    if not found:
        return None
    _, clearest = max(found)
    return clearest
