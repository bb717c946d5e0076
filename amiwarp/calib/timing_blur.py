"""Blur that remains even with the exact model: by whole pixels, encoder noise, clock resolution and latency jitter."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.event_sample import ANGLES_OVER_TURN, SAMPLED
from amiwarp.events.encoder import Encoder
from amiwarp.optics.models.comparison import rms

Floats = NDArray[np.float64]

QUANTISATION_PX = 1.0 / math.sqrt(12.0)
"""Standard deviation of the error from rounding coordinates to whole pixels [px]."""
CLOCK_US = 1.0 / math.sqrt(12.0)
"""Standard deviation of the error from rounding times to whole microseconds [us]."""
LATENCY_JITTER_US = 30.0
"""Assumed standard deviation of the latency of a good sensor in good light [us]. It cannot be measured from a
recording."""
MEDIAN_MAGNITUDE = 0.6745
"""Median magnitude of a normal distribution whose standard deviation is 1."""


def motion_per_angle(path: Floats) -> float:
    """Return how far compensated events move per change of the prism angle [px rms per rad].

    ``path`` holds their coordinates at :data:`ANGLES_OVER_TURN` [px], shape (TURN_ANGLES, n, 2). The result is exact
    for the first harmonic of the motion, next to which the others are small.
    """
    across = 2.0 * math.sin(ANGLES_OVER_TURN[1, 0])
    return rms(path[1] - path[-1]) / across


def timing_blur(path: Floats, noise: float, speed: float) -> float:
    """Return the blur [px rms] by encoder noise [rad], clock resolution and latency jitter at a prism speed [rad/us].

    ``path`` holds the compensated coordinates of n events at :data:`ANGLES_OVER_TURN` [px], shape (TURN_ANGLES, n, 2).
    """
    timing_us = math.hypot(CLOCK_US, LATENCY_JITTER_US)
    blur_rad = math.hypot(noise, speed * timing_us)
    return motion_per_angle(path) * blur_rad


def encoder_noise(encoder: Encoder) -> float:
    """Return the standard deviation of an encoder's angle noise [rad], rounding included; 0 for less than 4 samples.

    Samples are compared with the interpolation between their two neighbours: at most about :data:`SAMPLED`, however
    long the recording is. The median magnitude of the differences gives the standard deviation of white noise.
    """
    t = encoder.t
    angle = encoder.angle
    if len(t) < 4:
        return 0.0
    step = max(1, len(t) // SAMPLED)
    first = slice(0, len(t) - 2, step)
    second = slice(1, len(t) - 1, step)
    third = slice(2, len(t), step)
    middle = (t[second] - t[first]) / (t[third] - t[first])
    interpolated = middle * (angle[third] - angle[first])
    excess = angle[second] - angle[first] - interpolated

    # The three samples have the same noise.
    variance = 1.0 + middle**2 + (1.0 - middle) ** 2
    magnitude = np.abs(excess) / np.sqrt(variance)
    return float(np.median(magnitude)) / MEDIAN_MAGNITUDE
