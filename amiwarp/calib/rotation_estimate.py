"""How the camera turns, from events one turn of the prism apart: there the prism's own motion is the same.

Events of one range of prism angles make the same image in two successive turns, moved by the camera alone. The images
of many such ranges are correlated part by part; the camera's angular velocity is fitted to the parts' motion.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.camera import Camera

ANGLES = 24
"""Ranges of prism angles in a turn."""
PARTS = (6, 5)
"""Of the image, along x and y."""
SMOOTHING_PX = 2.0
PEAKS, BEST = 3, 12
"""Looked at in each part; followed to the top."""
ROLLS = tuple(range(-60, 61, 12))
"""Turning about the optical axis that is tried with each [1/f in a turn]."""


def estimate_rates(events: Events, encoder: Encoder, camera: Camera) -> tuple[float, float, float]:
    """The camera's mean angular velocity [rad/s] from two turns of ``events`` or a little more; zeros from fewer."""
    from scipy.ndimage import map_coordinates
    from scipy.optimize import minimize
    from scipy.spatial.transform import Rotation

    angle = encoder.angle_at(events.t)
    way = math.copysign(1.0, float(angle[-1] - angle[0]))
    turned = way * (angle - angle[0])
    if turned[-1] < 1.25 * math.tau:
        return 0.0, 0.0, 0.0
    seconds = math.tau / (float(turned[-1]) / ((int(events.t[-1]) - int(events.t[0])) * 1e-6))
    bins = (turned % math.tau * (ANGLES / math.tau)).astype(np.int64)
    turn = np.minimum((turned / math.tau).astype(np.int64), 2)
    at, surfaces = correlations(events, bins, turn, camera)
    rays = np.asarray(camera.pixels_to_rays(at.astype(np.float32)), np.float64)

    def moved(rate: NDArray[np.float64]) -> NDArray[np.float64]:
        # a still point moves against the camera
        there = camera.rays_to_pixels(Rotation.from_rotvec(-rate * seconds).apply(rays).astype(np.float32))
        return np.asarray(there, np.float64) - at

    def agreement(rate: NDArray[np.float64]) -> float:
        way = moved(rate) / 2.0
        if not np.isfinite(way).all() or np.abs(way).max() > max(surfaces.shape[1:]) / 2:
            return 0.0
        return sum(
            float(map_coordinates(s, way[k, ::-1, None], order=1, mode="grid-wrap")[0]) for k, s in enumerate(surfaces)
        )

    unit = 1.0 / (camera.fx * seconds)  # moves the image by about a pixel in a turn
    starts = sorted((np.array(r) for r in hypotheses(surfaces, unit)), key=agreement)[-BEST:]
    simplex = 4.0 * unit * np.vstack([np.zeros(3), np.eye(3)])

    def cost(rate: NDArray[np.float64]) -> float:
        return -agreement(rate)

    runs = [minimize(cost, s, method="Nelder-Mead", options={"initial_simplex": s + simplex}) for s in starts]
    x, y, z = min(runs, key=lambda run: float(run.fun)).x.tolist()
    return x, y, z


def hypotheses(surfaces: NDArray[np.float64], unit: float) -> list[tuple[float, float, float]]:
    """Rates at which some part of the image agrees best, and those at which that and a roll go together."""
    found = []
    for part in [surfaces.sum(axis=0), *surfaces]:
        for _ in range(PEAKS):
            row, column = np.unravel_index(int(part.argmax()), part.shape)
            x, y = (
                2.0 * (n - size if n > size / 2 else n) for n, size in zip((column, row), part.shape[::-1], strict=True)
            )
            # turning about x moves the image along y, about y along -x
            found += [(y * unit, -x * unit, roll * unit) for roll in ROLLS]
            part = part.copy()
            part[np.ix_(*[(np.arange(-4, 5) + k) % n for k, n in zip((row, column), part.shape, strict=True)])] = 0.0
    return found


def correlations(
    events: Events, bins: NDArray[np.int64], turn: NDArray[np.int64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middles of the image's parts [px], and of each the correlation of a turn with the next over its motion.

    The surfaces have cells of 2 px, are periodic, and 0 to 1 high: shape (parts, rows, columns).
    """
    half = (camera.height // 2, camera.width // 2)
    size = tuple(2 ** math.ceil(math.log2(1.5 * n)) for n in half)
    centres = [((i + 0.5) / PARTS[0] * half[1], (j + 0.5) / PARTS[1] * half[0]) for j in range(PARTS[1])
               for i in range(PARTS[0])]  # fmt: skip
    y, x = np.mgrid[: half[0], : half[1]]
    spread = (half[1] / PARTS[0] * 0.5, half[0] / PARTS[1] * 0.5)
    views = [np.exp(-0.5 * (((x - cx) / spread[0]) ** 2 + ((y - cy) / spread[1]) ** 2)) for cx, cy in centres]
    total = [np.zeros((size[0], size[1] // 2 + 1), np.complex128) for _ in centres]
    for b in range(ANGLES):
        before, after = (_signed(events[np.flatnonzero((bins == b) & (turn == k))], half) for k in (0, 1))
        spectrum = np.fft.rfft2(after, size)
        for k, view in enumerate(views):
            total[k] += np.conj(np.fft.rfft2(before * view, size)) * spectrum
    from scipy.ndimage import gaussian_filter

    surfaces = np.array([gaussian_filter(np.fft.irfft2(part, size), SMOOTHING_PX / 2.0, mode="wrap") for part in total])
    high = np.maximum(surfaces.max(axis=(1, 2), keepdims=True), 1e-12)
    return 2.0 * np.array(centres) + 0.5, np.maximum(surfaces, 0.0) / high


def _signed(events: Events, half: tuple[int, int]) -> NDArray[np.float64]:
    """ON minus OFF events in cells of 2 × 2 px."""
    cell = np.minimum(events.y // 2, half[0] - 1).astype(np.int64) * half[1] + np.minimum(events.x // 2, half[1] - 1)
    counts = np.bincount(cell, weights=2.0 * events.p - 1.0, minlength=half[0] * half[1])
    return np.asarray(counts, np.float64).reshape(half)
