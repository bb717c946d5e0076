"""Hot pixels: far more events than their neighbours, or events that do not repeat from turn to turn.

Behind a rotating prism an edge triggers events at the same prism angles in every turn. If the events of a pixel are
summed over turns with alternating signs, they cancel. The events of a hot pixel, which fires at random, do not.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events

Counts = NDArray[np.float64]

BINS = 8
"""Number of angle bins per turn of the prism in which events are counted."""
HARMONICS = 2
"""Number of harmonics of the prism angle used to count the events of a pixel that do not repeat from turn to turn. Low
harmonics tolerate small delays of an edge."""
BLOCKS = 4
"""Number of groups of successive turns in which unrepeated events are counted separately before the counts are added.
More groups reduce the noise of the count, but cost time."""
NEIGHBOURS = 2
"""Half width of the square of neighbouring pixels with whose event counts a pixel's event count is compared [px]."""
LEAST_LOW = 19
"""Smallest number of the 24 neighbours that must have far fewer events than a pixel before it counts as hot. Pixels of
corners and thin lines have fewer such neighbours."""


def outliers(count: Counts) -> NDArray[np.bool_]:
    """Return the pixels with far more events than at least :data:`LEAST_LOW` of their 24 neighbours.

    Far more than a neighbour's n means more than 3 n + 5 √n + 8: beyond Poisson statistics and a picture's contrast. A
    few neighbours may count as much, so adjacent hot pixels do not hide each other.
    """
    height, width = count.shape
    padded = np.pad(count, NEIGHBOURS, mode="symmetric")
    far_more = 3.0 * padded + 5.0 * np.sqrt(padded) + 8.0
    enough = far_more.astype(np.float32)
    counts = count.astype(np.float32)
    low_neighbours = np.zeros(count.shape, np.int8)
    for i in range(2 * NEIGHBOURS + 1):
        for j in range(2 * NEIGHBOURS + 1):
            if i == NEIGHBOURS and j == NEIGHBOURS:
                continue  # the pixel itself
            neighbour = enough[i : i + height, j : j + width]
            low_neighbours += counts > neighbour
    return low_neighbours >= LEAST_LOW


def unrepeated_counts(
    events: Events,
    pixel: NDArray[np.int32],
    encoder: Encoder,
    size: tuple[int, int],
) -> Counts | None:
    """Estimate how many events of each pixel do not repeat from turn to turn, shape (height, width).

    Turns get signs that sum to zero, so repeated events cancel. The expected square of the sum of random events is
    their number. The squares are averaged over low harmonics of the angle and summed over both polarities and up to
    :data:`BLOCKS` spans of turns. None for less than two turns.
    """
    edges = bin_times(events, encoder)
    turns = (len(edges) - 1) // BINS
    pairs = turns // 2
    if not pairs:
        return None
    first_events = np.searchsorted(events.t, edges)
    width, height = size
    channels = 2 * width * height  # one for each pixel and polarity
    channel = pixel * np.int32(2) + events.p

    total = np.zeros(channels)
    for block in np.array_split(np.arange(pairs), min(pairs, BLOCKS)):
        first_turn = 2 * block[0]
        end_turn = 2 * (block[-1] + 1)
        marks = first_events[first_turn * BINS : end_turn * BINS + 1]
        folded = _folded(marks, channel, channels)
        amplitudes = harmonics() @ folded
        total += (amplitudes**2).mean(axis=0)
    by_polarity = total.reshape(height, width, 2)
    return np.asarray(by_polarity.sum(axis=2))


def _folded(
    marks: NDArray[np.int64],
    channel: NDArray[np.int32],
    channels: int,
) -> Counts:
    """Fold turns onto each other: return the sums of signs in each bin of the angle and channel.

    ``marks`` are the numbers of the first event in each bin of these turns, and of the event after them.
    """
    in_bin = np.diff(marks)
    turns = len(in_bin) // BINS

    # Thue-Morse signs: a response that alternates between two states cancels too
    ones = np.bitwise_count(np.arange(turns))
    sign_of_turn = 1.0 - 2.0 * (ones & 1)
    sign_of_bin = np.repeat(sign_of_turn, BINS)
    signs = np.repeat(sign_of_bin, in_bin)

    first_slots = np.arange(BINS, dtype=np.int32) * np.int32(channels)
    slot_of_bin = np.tile(first_slots, turns)
    slots = np.repeat(slot_of_bin, in_bin)
    first = int(marks[0])
    end = int(marks[-1])
    slots += channel[first:end]
    sums = np.bincount(slots, signs, minlength=BINS * channels)
    return np.asarray(sums.reshape(BINS, channels), np.float64)


def harmonics() -> NDArray[np.float64]:
    """Return a constant, cosines and sines of the angle at the bin centres, shape (harmonics, BINS).

    Each has the mean square 1.
    """
    centres = (np.arange(BINS) + 0.5) * (math.tau / BINS)
    orders = np.arange(1, HARMONICS + 1)
    phase = np.outer(orders, centres)
    constant = np.ones((1, BINS))
    cosines = math.sqrt(2.0) * np.cos(phase)
    sines = math.sqrt(2.0) * np.sin(phase)
    return np.concatenate([constant, cosines, sines])


def bin_times(events: Events, encoder: Encoder) -> NDArray[np.int64]:
    """Return the times [us] at which the prism enters each angle bin, for whole turns from the first event on."""
    if not len(events):
        return np.zeros(1, np.int64)
    # encoder noise may step back, but interpolating time over angle needs rising angles
    sign = 1.0 if encoder.rpm >= 0.0 else -1.0
    turned = sign * (encoder.angle - encoder.angle[0])
    angle = np.maximum.accumulate(turned)
    origin = int(encoder.t[0])
    elapsed = (encoder.t - encoder.t[0]).astype(np.float64)
    elapsed -= encoder.clock_offset_us

    begin = int(events.t[0]) - origin
    end = int(events.t[-1]) + 1 - origin
    first, last = np.interp([begin, end], elapsed, angle)
    turns = int((last - first) / math.tau + 1e-3)
    bins = np.arange(turns * BINS + 1)
    edges = first + bins * (math.tau / BINS)
    marks = np.interp(edges, angle, elapsed)
    return np.rint(marks).astype(np.int64) + encoder.t[0]
