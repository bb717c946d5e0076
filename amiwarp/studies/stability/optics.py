"""Optics of the stability study, whose sizes, speeds and phases are drawn by seed in the ranges of ordinary rigs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.prism import Plate, Prism
from amiwarp.simulation.motion import CameraMotion, Mirror, PrismMotion, Vibration

if TYPE_CHECKING:
    from amiwarp.studies.stability.condition import Condition


Array = NDArray[np.float64]

OPTICS = ("wedge", "pair", "mirror", "vibration", "plate")
"""Names of the optics of the study."""
APEX_SPREAD = 0.05
"""Relative standard deviation of the apex angle that the recording states of each prism."""
UNSTEADY_SHARE = 0.23
"""Frequency at which the amplitude of a vibration varies, relative to the vibration's."""


@dataclass(frozen=True)
class Optic:
    """An optic in motion, drawn by seed."""

    glass: Prism | Plate | Vibration | Mirror
    """The optic with its true parameters."""
    motion: PrismMotion
    """Motion of all its angles."""
    nominal: Prism | Plate | None
    """What the recording states of it."""
    model: str
    """Name of the model that the calibration is given."""
    duration_s: float
    """Duration of the recording [s]."""


def _speed(rng: np.random.Generator) -> float:
    """Return a speed of a motor [turns/min]."""
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(500.0, 1000.0))


def _motion(
    condition: Condition, rpm: float, phase: float, duration_s: float, rng: np.random.Generator
) -> PrismMotion:
    """Return a motion whose speed hunts about its mean, as the condition says."""
    if not condition.hunt:
        return PrismMotion(rpm, phase)
    begin = rng.uniform(0.0, math.tau)
    three_turns_s = 3.0 * 60.0 / abs(rpm)
    t = np.arange(-three_turns_s, duration_s + three_turns_s, 2e-4)
    swing = np.sin(math.tau * condition.hunt_hz * t + begin)
    speed = rpm * (1.0 + condition.hunt * swing)
    return PrismMotion(np.column_stack([t, speed]), phase)


def _any_angle(rng: np.random.Generator) -> float:
    """Return a random angle [rad]."""
    return rng.uniform(-math.pi, math.pi)


def _turning_s(condition: Condition, duration_s: float) -> float:
    """Return the duration of a recording [s]: twice as long if there are index pulses only, which need more turns."""
    return 2.0 * duration_s if condition.index_only else duration_s


def _wedge(condition: Condition, rng: np.random.Generator) -> Optic:
    """Return a wedge prism."""
    duration_s = _turning_s(condition, 0.25)
    prism = Prism(math.radians(rng.uniform(0.7, 1.6)))
    nominal = Prism(prism.apex * (1.0 + APEX_SPREAD * rng.standard_normal()))
    rpm = _speed(rng)
    motion = _motion(condition, rpm, _any_angle(rng), duration_s, rng)
    return Optic(prism, motion, nominal, "exact", duration_s)


def _pair(condition: Condition, rng: np.random.Generator) -> Optic:
    """Return two prisms, whose speeds differ by at least 15 %."""
    duration_s = _turning_s(condition, 0.3)
    apexes = np.radians(rng.uniform(0.6, 1.2, 2))
    pair = Prism(apexes[0], second=Prism(apexes[1]))
    stated = apexes * (1.0 + APEX_SPREAD * rng.standard_normal(2))
    nominal = Prism(stated[0], second=Prism(stated[1]))

    rpm = _speed(rng)
    other_rpm = _speed(rng)
    if abs(abs(rpm) - abs(other_rpm)) < 0.15 * abs(rpm):
        other_rpm *= 0.7
    first_motion = _motion(condition, rpm, _any_angle(rng), duration_s, rng)
    second_motion = _motion(condition, other_rpm, _any_angle(rng), duration_s, rng)
    motion = replace(first_motion, second=second_motion)
    return Optic(pair, motion, nominal, "risley", duration_s)


def _mirror(condition: Condition, rng: np.random.Generator) -> Optic:
    """Return a mirror with two tilts, whose frequencies differ by at least 10 %."""
    first_hz, second_hz = np.exp(rng.uniform(math.log(25.0), math.log(90.0), 2)).tolist()
    if abs(first_hz / second_hz - 1.0) < 0.1:
        second_hz *= 1.3
    first_size, second_size = (rng.uniform(2.0, 6.0, 2) / (2.0 * condition.camera.fx)).tolist()
    first_phase, second_phase = rng.uniform(-math.pi, math.pi, 2).tolist()
    # The axes of the two tilts are about perpendicular.
    first_turn, second_turn = rng.uniform(-0.2, 0.2, 2).tolist()
    fold = float(_any_angle(rng))
    incidence = math.radians(rng.uniform(35.0, 55.0))
    mirror = Mirror(
        (first_hz, second_hz),
        (first_size, second_size),
        (first_phase, second_phase),
        (first_turn, 0.5 * math.pi + second_turn),
        fold,
        incidence,
    )
    return Optic(mirror, mirror.motion, None, "mirror", 0.15)


def _vibration(condition: Condition, rng: np.random.Generator) -> Optic:
    """Return a vibrating camera."""
    hz = math.exp(rng.uniform(math.log(30.0), math.log(80.0)))
    amplitude = rng.uniform(1.5, 5.0) / condition.camera.fx
    back_amplitude = amplitude * rng.uniform(0.0, 0.7)
    back = back_amplitude * np.exp(1j * _any_angle(rng))
    third = condition.third_px / condition.camera.fx * np.exp(1j * _any_angle(rng))
    phase = _any_angle(rng)
    vibration = Vibration(
        hz,
        amplitude,
        phase,
        (back.real, back.imag),
        third=(third.real, third.imag),
    )
    eight_periods_s = 8.0 / hz
    return Optic(vibration, vibration.motion, None, "vibration", eight_periods_s)


def _plate(condition: Condition, rng: np.random.Generator) -> Optic:
    """Return a tilted plate."""
    duration_s = _turning_s(condition, 0.35)
    plate = Plate(0.01, math.radians(rng.uniform(38.0, 48.0)))
    rpm = _speed(rng)
    steady = _motion(condition, rpm, _any_angle(rng), duration_s, rng)
    wedge = at_random(math.radians(condition.plate_wedge_arcmin / 60.0), rng)
    motion = replace(steady, wedge=wedge)
    return Optic(plate, motion, plate, "plate", duration_s)


MAKERS: dict[str, Callable[[Condition, np.random.Generator], Optic]] = {
    "wedge": _wedge,
    "pair": _pair,
    "mirror": _mirror,
    "vibration": _vibration,
    "plate": _plate,
}
"""Function that draws each of :data:`OPTICS`."""


def varying(vibration: Vibration, share: float, duration_s: float) -> CameraMotion:
    """Return the rotation by which the forward circle of a vibration is larger and smaller in turn, by a share."""
    t = np.arange(0.0, duration_s + 2e-3, 2.5e-4)
    turned = vibration.motion.angle(1e6 * t)
    size = share * vibration.amplitude * np.sin(UNSTEADY_SHARE * turned)
    away = size * np.exp(1j * (turned + vibration.phase))
    rates = np.gradient(away, t)
    about_z = np.zeros(len(t))
    return CameraMotion(np.column_stack([t, rates.real, rates.imag, about_z]))


def at_random(size: float, rng: np.random.Generator) -> tuple[float, float]:
    """Return the two components of a size in a random direction; nothing is drawn for a size of 0."""
    direction = rng.uniform(0.0, math.tau) if size else 0.0
    return size * math.cos(direction), size * math.sin(direction)
