"""How the cameras of the named worlds move: at rest, in a hand, and fast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.trajectory import Trajectory, looking_at

TRAJECTORIES = ("still", "handheld", "fast")
"""Kinds of camera trajectories."""
RATE_HZ = 100.0
"""Poses per second of the trajectories."""
SHAKE_M = 0.015
"""Amplitude of the hand's sway [m]."""
SHAKE_DEG = 1.5
"""Amplitude of the hand's turns [deg]."""
SWAY_HZ = (0.15, 0.55)
"""Frequencies of the hand's slow sway [1/s]."""
TREMOR_HZ = (1.5, 2.8)
"""Frequencies of its tremor [1/s], each of an amplitude of 0.03."""
FAST_RATE, FAST_REACH = 4.0, 2.5
"""Factors of frequency and amplitude of a fast trajectory: ten times the speed."""


@dataclass(frozen=True)
class Viewpoint:
    """Where a camera stands, and how far it walks."""

    position: tuple[float, float, float]
    """Middle of its positions [m]."""
    target: tuple[float, float, float]
    """Point that it looks at [m]."""
    walk_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Half of the way that a moving camera goes to and fro along [m]."""
    walk_speed: float = 1.2
    """Largest speed on this way [m/s], ten times as much for fast trajectories."""


def camera_trajectory(view: Viewpoint, kind: str, duration_s: float, rng: np.random.Generator) -> Trajectory:
    """Return the poses of a camera for a kind of trajectory."""
    from scipy.spatial.transform import Rotation

    base = looking_at(view.position, view.target)
    if kind == "still":
        return Trajectory.still(view.position, rotation=base.as_quat())
    t = np.linspace(0.0, duration_s, max(4, round(duration_s * RATE_HZ) + 1))
    rate, reach = (FAST_RATE, FAST_REACH) if kind == "fast" else (1.0, 1.0)
    sway, turn = (reach * shake(rate * t, rng) for _ in range(2))
    position = np.asarray(view.position) + SHAKE_M * sway + walk(view, rate * reach, t)
    rotation = base * Rotation.from_rotvec(np.radians(SHAKE_DEG) * turn)
    return Trajectory(t, position, rotation.as_quat())


def shake(t: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a smooth random motion of three axes, about 1 in amplitude: four sines of sway and two of tremor each."""
    low, high = SWAY_HZ
    frequency = np.concatenate([low + (high - low) * (np.arange(4)[:, None] + rng.uniform(size=(4, 3))) / 4.0,
                                rng.uniform(*TREMOR_HZ, (2, 3))])  # fmt: skip
    amplitude = np.concatenate([0.5 * np.sqrt(low / frequency[:4]) + 0.1, np.full((2, 3), 0.03)])
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 3))
    waves = amplitude * np.sin(2.0 * np.pi * frequency * t[:, None, None] + phase)
    return np.asarray(waves.sum(axis=1))


def walk(view: Viewpoint, factor: float, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return displacements to and fro along ``view.walk_m``, fastest at time 0, which is in the middle [m]."""
    way = np.asarray(view.walk_m)
    length = float(np.linalg.norm(way))
    if not length > 0.0:
        return np.zeros((len(t), 3))
    return np.asarray(np.sin(factor * view.walk_speed * t / length)[:, None] * way)
