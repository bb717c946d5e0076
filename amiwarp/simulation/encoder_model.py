"""Encoder of a simulated prism, and the errors that it makes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from amiwarp.events.encoder import Encoder, periodic
from amiwarp.schema.calls import guarded
from amiwarp.simulation.motion import LONGEST_S, PrismMotion
from amiwarp.validation import INT64, real, vector, whole

LARGEST_OFFSET_US = 1e7
"""Largest clock offset of a simulated encoder [us]. The encoder is sampled for this much longer before and after the
events."""


@guarded
@dataclass(frozen=True, slots=True)
class EncoderModel:
    """Errors that a simulated encoder makes.

    Raises :class:`AmiwarpError` for values out of range.

    Examples
    --------
    >>> encoder = amiwarp.EncoderModel.ideal().sample(amiwarp.PrismMotion(600.0), duration_us=1000, seed=0)
    >>> encoder.angle_at([500]).round(6)
    array([0.031416])
    """

    counts_per_turn: int | None = 8192
    """Resolution of the encoder [counts/turn]: the angle is rounded to the nearest count; None disables rounding."""
    rate_hz: float = 1000.0
    """Rate of the encoder samples [Hz]."""
    jitter_us: float = 1.0
    """Standard deviation of the time stamp of an encoder sample [us]."""
    clock_offset_us: float = 0.0
    """Offset of the encoder's clock: encoder time minus event time [us]; stored in the ground truth only."""
    dropouts_hz: float = 0.0
    """Mean number of drop-outs per second [Hz]."""
    dropout_us: float = 5000.0
    """Duration of a drop-out, in which all encoder samples are lost [us]."""
    harmonics: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Error of the angle that repeats every turn: factors of cos θ, sin θ, cos 2θ and sin 2θ [rad].

    Eccentric discs and magnets cause the first two. The prism itself turns without this error.
    """

    def __post_init__(self) -> None:
        if self.counts_per_turn is not None:
            counts = whole(self.counts_per_turn, "encoder counts_per_turn", 1, 2**31, ", or None")
            object.__setattr__(self, "counts_per_turn", counts)
        limits = {
            "rate_hz": (0.1, 1e6),
            "jitter_us": (0.0, 1e6),
            "dropouts_hz": (0.0, 1e5),
            "dropout_us": (0.0, 1e9),
            "clock_offset_us": (-LARGEST_OFFSET_US, LARGEST_OFFSET_US),
        }
        for name, (low, high) in limits.items():
            value = real(getattr(self, name), f"encoder {name}", low, high)
            object.__setattr__(self, name, value)
        small_angle = partial(real, low=-1.0, high=1.0, hint=" rad")
        harmonics = vector(self.harmonics, 4, "encoder harmonics", small_angle)
        object.__setattr__(self, "harmonics", harmonics)

    @classmethod
    def ideal(cls) -> EncoderModel:
        """Return an encoder without rounding and jitter.

        Returns
        -------
        EncoderModel
            The encoder.
        """
        return cls(counts_per_turn=None, jitter_us=0.0)

    def sample(self, motion: PrismMotion, duration_us: int, seed: int) -> Encoder:
        """Sample the encoder from 0 to ``duration_us`` on the camera's clock, with a margin at both ends.

        Parameters
        ----------
        motion : PrismMotion
            Motion of the prism.
        duration_us : int
            Duration [us].
        seed : int
            Seed of the random errors.

        Returns
        -------
        Encoder
            Samples with times on the encoder's clock. Its clock offset is 0: calibration has to find it.
        """
        duration_us = whole(duration_us, "duration_us", 0, round(1e6 * LONGEST_S), " us")
        seed = whole(seed, "seed", 0, INT64[1])
        rng = np.random.default_rng([seed, 0xE2C])  # independent of the pixels' random numbers
        interval_us = 1e6 / self.rate_hz
        longest_shift_us = abs(self.clock_offset_us) + 8.0 * self.jitter_us
        spare = math.ceil(longest_shift_us / interval_us) + 2
        last = math.ceil(duration_us / interval_us) + spare
        number = np.arange(-spare, last + 1)
        true_t = np.rint(number * interval_us).astype(np.int64)

        angle = motion.angle(true_t - self.clock_offset_us)
        if any(self.harmonics):
            angle = angle + periodic(angle, self.harmonics)
        if self.counts_per_turn is not None:
            count = np.rint(angle * (self.counts_per_turn / math.tau))
            angle = count * (math.tau / self.counts_per_turn)

        jitter = rng.normal(0.0, self.jitter_us, len(true_t))
        stamp = true_t + np.rint(jitter).astype(np.int64)

        # Samples in drop-outs are lost, but never the first and the last one: the encoder covers the events.
        kept = np.ones(len(stamp), np.bool_)
        dropouts = rng.poisson(self.dropouts_hz * duration_us * 1e-6)
        for start in self.clock_offset_us + rng.uniform(0.0, duration_us, dropouts):
            kept &= (true_t < start) | (true_t >= start + self.dropout_us)
        kept[[0, -1]] = True
        stamp = stamp[kept]
        angle = angle[kept]

        # So are samples that jitter moves before earlier ones.
        latest = np.maximum.accumulate(stamp)
        rising = np.concatenate([[True], stamp[1:] > latest[:-1]])
        second = None
        if motion.second is not None:
            second = self.sample(motion.second, duration_us, seed + 1)
        return Encoder(stamp[rising], angle[rising], second=second)
