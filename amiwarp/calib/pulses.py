"""Encoders that give an index pulse a turn and nothing between: a smooth path through their pulses."""

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.path_splines import SAMPLE_US
from amiwarp.events.encoder import Encoder

LONGEST_STEP = math.pi / 2
"""Median angle between two samples above which an encoder tells too little of the speed between them [rad]."""
FEWEST = 4
"""Smallest number of pulses for a smooth path through them."""
CONFIRMED_SHARE = 0.3
"""Largest distance of the pulses from a path that they confirm, relative to how far the path bends between them. A path
that follows a moving camera in place of the motor misses the pulses by as much as it bends."""


def pulses_only(encoder: Encoder) -> bool:
    """Return whether an encoder has but pulses, so that the angle between them is not measured."""
    if len(encoder.t) < FEWEST:
        return False
    step = float(np.median(np.abs(np.diff(encoder.angle))))
    return step > LONGEST_STEP


def smooth_path(encoder: Encoder) -> Encoder:
    """Return a smooth path through the samples of an encoder, with a sample per millisecond between them."""
    from scipy.interpolate import CubicSpline

    origin = encoder.t[0]
    elapsed = encoder.t - origin
    spline = CubicSpline(elapsed.astype(np.float64), encoder.angle, bc_type="natural")

    every_millisecond = np.arange(0, elapsed[-1], SAMPLE_US)
    t = np.unique(np.concatenate([every_millisecond, elapsed]))
    angle = spline(t.astype(np.float64))
    return Encoder(
        t + origin,
        np.asarray(angle, np.float64),
        encoder.clock_offset_us,
    )


def off_path(
    encoder: Encoder,
    path: Encoder,
    first: int,
    last: int,
) -> NDArray[np.float64]:
    """Return how far a path is ahead of the samples of an encoder between two event times [us], shape (m,) [rad]."""
    t = encoder.t - encoder.clock_offset_us
    inside = (t >= first) & (t <= last)
    origin = path.t[0]
    on_path = np.interp(encoder.t - origin, path.t - origin, path.angle)
    ahead = on_path - encoder.angle
    return np.asarray(ahead[inside])


def confirm(
    encoder: Encoder,
    path: Encoder,
    first: int,
    last: int,
) -> bool:
    """Return whether a path that bends between the samples of an encoder passes through them.

    ``first`` and ``last`` are the times of the first and the last event [us].
    """
    off = off_path(encoder, path, first, last)
    if len(off) < FEWEST:
        return False
    t = np.linspace(first, last, 64 * len(off)).astype(np.int64)
    straight = smooth_path(encoder)
    bent = path.angle_at(t) - straight.angle_at(t)
    largest = CONFIRMED_SHARE * float(np.std(bent))
    return float(np.std(off)) <= largest
