"""What the encoders of the stability study read: the same errors for each angle of an optic."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.encoder import Encoder
from amiwarp.simulation.encoder_model import EncoderModel
from amiwarp.simulation.motion import Mirror, PrismMotion
from amiwarp.studies.stability.optics import Optic, at_random

if TYPE_CHECKING:
    from amiwarp.studies.stability.condition import Condition


def read(condition: Condition, optic: Optic, rng: np.random.Generator, seed: int) -> Encoder:
    """Return what the encoders of an optic read, or the commands of a mirror."""
    motions = [replace(optic.motion, second=None)]
    if optic.motion.second is not None:
        motions.append(optic.motion.second)
    end_us = math.ceil(1e6 * optic.duration_s)
    encoders = []
    for k, motion in enumerate(motions):
        encoders.append(_read_one(condition, motion, end_us, rng, seed + k))

    if condition.lost_once_deg:
        lost_at_us = end_us * rng.uniform(0.3, 0.7)
        encoders[0] = losing(encoders[0], math.radians(condition.lost_once_deg), lost_at_us)
    if isinstance(optic.glass, Mirror) and (condition.command_cubic or condition.command_square):
        signs = rng.choice([-1.0, 1.0], 2)
        for k, (motion, sign) in enumerate(zip(motions, signs, strict=True)):
            cubic = sign * condition.command_cubic
            square = sign * condition.command_square
            encoders[k] = commanding(encoders[k], motion.phase, cubic, square)
    if condition.swapped:
        encoders.reverse()
    if len(encoders) == 1:
        return encoders[0]
    first, second = encoders
    return first.with_second(second)


def _read_one(
    condition: Condition, motion: PrismMotion, end_us: int, rng: np.random.Generator, seed: int
) -> Encoder:
    """Return what the encoder of one angle reads."""
    if condition.index_only:
        return index_pulses(motion, end_us, condition.index_jitter_us, rng)
    once = at_random(math.radians(condition.eccentric_deg), rng)
    twice = at_random(math.radians(condition.second_deg), rng)
    model = EncoderModel(counts_per_turn=condition.counts_per_turn, harmonics=(*once, *twice))
    encoder = model.sample(motion, end_us, seed)
    # The model has no third harmonic.
    third_cos, third_sin = at_random(math.radians(condition.third_deg), rng)
    wrong = third_cos * np.cos(3.0 * encoder.angle) + third_sin * np.sin(3.0 * encoder.angle)
    return Encoder(encoder.t, encoder.angle + wrong)


def index_pulses(
    motion: PrismMotion, end_us: int, jitter_us: float, rng: np.random.Generator
) -> Encoder:
    """Return the encoder that has but a pulse at each whole turn, from before time 0 to after ``end_us`` [us]."""
    _, after_a_second = motion.angle([0.0, 1e6])
    rad_per_us = abs(float(after_a_second)) / 1e6
    two_turns_us = 2.0 * math.tau / rad_per_us
    t = np.arange(-two_turns_us, end_us + two_turns_us, 100.0)
    angle = motion.angle(t)
    sign = math.copysign(1.0, angle[-1] - angle[0])

    turns = sign * angle / math.tau
    whole_turns = np.arange(math.ceil(turns[0]), math.floor(turns[-1]) + 1)
    pulse_us = np.interp(whole_turns, turns, t)
    if jitter_us:
        pulse_us = pulse_us + jitter_us * rng.standard_normal(len(pulse_us))
    return Encoder(np.rint(pulse_us).astype(np.int64), sign * math.tau * whole_turns)


def losing(encoder: Encoder, lost: float, at_us: float) -> Encoder:
    """Return an encoder that loses counts once, at a time [us]. ``lost``: the angle [rad]."""
    forward = math.copysign(1.0, encoder.angle[-1] - encoder.angle[0])
    after = encoder.t > at_us
    return Encoder(encoder.t, encoder.angle - forward * lost * after)


def commanding(encoder: Encoder, phase: float, cubic: float, square: float) -> Encoder:
    """Return the commands that a mirror gets whose tilt is no linear function of its command.

    The tilt follows cos θ. Its command follows the cosine of another angle ψ, where cos θ is
    (cos ψ + ``cubic`` cos³ ψ) / (1 + ``cubic``), or cos ψ + ``square`` (cos² ψ - 1): as if the driver knew the mirror,
    and the calibration did not.
    """
    # Table of half a period: θ of many ψ
    half_period = np.linspace(0.0, math.pi, 4097)
    cosine = np.cos(half_period)
    tilt = (cosine + cubic * cosine**3) / (1.0 + cubic) + square * (cosine**2 - 1.0)
    theta_of_table = np.arccos(np.clip(tilt, -1.0, 1.0))

    # The second half of a period is the first half, backwards.
    theta = encoder.angle + phase
    begin = np.floor(theta / math.tau) * math.tau
    within = theta - begin
    folded = np.minimum(within, math.tau - within)
    psi = np.interp(folded, theta_of_table, half_period)
    psi = np.where(within <= math.pi, psi, math.tau - psi)
    return Encoder(encoder.t, begin + psi - phase)
