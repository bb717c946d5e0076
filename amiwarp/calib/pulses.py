"""Encoders that give an index pulse a turn and nothing between: a smooth path through their pulses."""

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.prism_path import SAMPLE_US
from amiwarp.events.encoder import Encoder

LONGEST_STEP = math.pi / 2
"""Median angle between two samples from which on an encoder tells too little of the speed between them [rad]."""
FEWEST = 4
"""Smallest number of pulses for a smooth path through them."""


def pulses_only(encoder: Encoder) -> bool:
    """Return whether an encoder has but pulses, so that the angle between them is not measured."""
    return len(encoder.t) >= FEWEST and float(np.median(np.abs(np.diff(encoder.angle)))) > LONGEST_STEP


def smooth_path(encoder: Encoder) -> Encoder:
    """Return a smooth path through the samples of an encoder, with a sample per millisecond between them."""
    from scipy.interpolate import CubicSpline

    elapsed = encoder.t - encoder.t[0]
    t = np.unique(np.concatenate([np.arange(0, elapsed[-1], SAMPLE_US), elapsed]))
    angle = CubicSpline(elapsed.astype(np.float64), encoder.angle, bc_type="natural")(t.astype(np.float64))
    return Encoder(t + encoder.t[0], np.asarray(angle, np.float64), encoder.clock_offset_us)


def off_path(encoder: Encoder, path: Encoder, first: int, last: int) -> NDArray[np.float64]:
    """Return how far a path is ahead of the samples of an encoder between two event times [us], shape (m,) [rad]."""
    t = encoder.t - encoder.clock_offset_us
    inside = (t >= first) & (t <= last)
    on_path = np.interp(encoder.t - path.t[0], path.t - path.t[0], path.angle)
    return np.asarray((on_path - encoder.angle)[inside])
