"""Camera trajectories of the built-in worlds: still, handheld and fast."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.trajectory import Trajectory, looking_at

TRAJECTORIES = ("still", "handheld", "fast")
"""Names of the kinds of camera trajectories."""
RATE_HZ = 100.0
"""Number of poses per second."""
SHAKE_M = 0.015
"""Approximate amplitude of the handheld translation [m]."""
SHAKE_DEG = 1.5
"""Approximate amplitude of the handheld rotation [deg]."""
SWAY_HZ = (0.15, 0.55)
"""Range of frequencies of the slow part of handheld motion [Hz]."""
TREMOR_HZ = (1.5, 2.8)
"""Range of frequencies of the tremor in handheld motion [Hz]. Each tremor sine has a relative amplitude of 0.03."""
FAST_RATE = 4.0
FAST_REACH = 2.5
"""Ratios of frequency and amplitude of fast to handheld trajectories. Their product, 10, is the ratio of speeds."""


@dataclass(frozen=True)
class Viewpoint:
    """Mean pose of a camera, and the path that a moving camera walks."""

    position: tuple[float, float, float]
    """Mean position of the camera [m]."""
    target: tuple[float, float, float]
    """Point that the camera looks at [m]."""
    walk_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Vector from the mean position to one end of the path [m]. A moving camera walks the path back and forth."""
    walk_speed: float = 1.2
    """Largest walking speed [m/s]. Fast trajectories are ten times as fast."""


def camera_trajectory(
    view: Viewpoint, kind: str, duration_s: float, rng: np.random.Generator
) -> Trajectory:
    """Return a camera trajectory about a viewpoint. ``kind``: one of :data:`TRAJECTORIES`."""
    from scipy.spatial.transform import Rotation

    base = looking_at(view.position, view.target)
    if kind == "still":
        return Trajectory.still(view.position, rotation=base.as_quat())
    t = np.linspace(0.0, duration_s, max(4, round(duration_s * RATE_HZ) + 1))
    rate = 1.0
    reach = 1.0
    if kind == "fast":
        rate = FAST_RATE
        reach = FAST_REACH
    sway = reach * shake(rate * t, rng)
    turn = reach * shake(rate * t, rng)
    position = np.asarray(view.position) + SHAKE_M * sway + walk(view, rate * reach, t)
    rotation = base * Rotation.from_rotvec(np.radians(SHAKE_DEG) * turn)
    return Trajectory(t, position, rotation.as_quat())


def shake(t: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return smooth random motion of amplitude about 1 along three axes, shape ``(n, 3)``.

    ``t``: times [s]. The motion along each axis is a sum of six sines.
    """
    # Four slow sines along each axis, one in each quarter of the range, and two of the tremor.
    low, high = SWAY_HZ
    quarter = np.arange(4)[:, None]
    sway_hz = low + (high - low) * (quarter + rng.uniform(size=(4, 3))) / 4.0
    sway = 0.5 * np.sqrt(low / sway_hz) + 0.1
    tremor_hz = rng.uniform(*TREMOR_HZ, (2, 3))
    tremor = np.full((2, 3), 0.03)

    frequency = np.concatenate([sway_hz, tremor_hz])
    amplitude = np.concatenate([sway, tremor])
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 3))
    waves = amplitude * np.sin(2.0 * np.pi * frequency * t[:, None, None] + phase)
    return np.asarray(waves.sum(axis=1))


def walk(view: Viewpoint, factor: float, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the displacements of a walking camera along ``view.walk_m`` [m], shape ``(n, 3)``.

    ``factor``: factor of the speed; ``t``: times [s]. The motion is a sine, so the speed is largest at time 0.
    """
    end = np.asarray(view.walk_m)
    length = float(np.linalg.norm(end))
    if not length > 0.0:
        return np.zeros((len(t), 3))
    share = np.sin(factor * view.walk_speed * t / length)
    return np.asarray(share[:, None] * end)
