"""Scenes of the stability study, drawn from a seed: from a dense texture to a blank wall."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

DARK, BRIGHT = 0.2, 1.0
"""Smallest and largest luminance of the scenes, relative to white."""
LAMP_HZ = 100.0
"""Frequency of the flickering lamp [Hz]."""
FRAME_US = 1000
"""Interval between two pictures of a changing scene [us]."""


class SceneKind(enum.StrEnum):
    """Kind of scene of the stability study."""

    TEXTURE = "dense texture"
    EDGES = "sparse edges"
    ONE_DIRECTION = "one edge direction"
    REPEATING = "repeating texture"
    PRINT = "print"
    LINES = "few thin lines"
    BLANK = "blank wall"


def draw(kind: SceneKind, width: int, height: int, *, period: float, seed: int) -> NDArray[np.float32]:
    """Draw a scene of a kind, and return its linear luminance, shape ``(height, width)``.

    ``period`` is the period of the repeating texture [texels].
    """
    rng = np.random.default_rng([seed, 0x5CE7E])
    if kind is SceneKind.TEXTURE:
        return leaves(rng, width, height)
    if kind is SceneKind.EDGES:
        return polygons(rng, width, height)
    if kind is SceneKind.PRINT:
        return printed(rng, width, height)
    if kind is SceneKind.LINES:
        return thin_lines(rng, width, height)
    if kind is SceneKind.BLANK:
        return np.full((height, width), 0.5, np.float32)
    rows, cols = np.mgrid[:height, :width].astype(np.float64)
    if kind is SceneKind.REPEATING:
        waves = np.cos(2.0 * np.pi * cols / period) + np.cos(2.0 * np.pi * rows / period)
        return _levels(0.5 + 0.25 * waves)
    angle = rng.uniform(0.0, np.pi)
    across = cols * math.cos(angle) + rows * math.sin(angle)
    steps = np.sort(rng.uniform(across.min(), across.max(), max(6, (width + height) // 40)))
    values = rng.uniform(0.0, 1.0, len(steps) + 1)
    return _levels(values[np.searchsorted(steps, across)])


def leaves(rng: np.random.Generator, width: int, height: int, count: int = 4000) -> NDArray[np.float32]:
    """Return discs that occlude each other, with sizes by a power law: the statistics of natural images.

    Lee, Mumford, Huang, "Occlusion models for natural images", IJCV 2001.
    """
    largest, smallest = height / 4.0, 3.0
    out = np.full((height, width), 0.5)
    u = rng.uniform(size=count)
    radii = 1.0 / np.sqrt(u * (smallest**-2 - largest**-2) + largest**-2)  # density proportional to r^-3
    middles = rng.uniform(0.0, 1.0, (count, 2)) * (height, width)
    for radius, (y, x), value in zip(radii, middles, rng.uniform(size=count), strict=True):
        _disc(out, y, x, radius, value)
    return _levels(out)


def _disc(out: NDArray[np.float64], y: float, x: float, radius: float, value: float) -> None:
    """Draw a disc of one luminance into the picture ``out``."""
    top, left = max(0, int(y - radius)), max(0, int(x - radius))
    part = out[top : int(y + radius) + 2, left : int(x + radius) + 2]
    rows, cols = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
    part[(rows - y) ** 2 + (cols - x) ** 2 <= radius**2] = value


def polygons(rng: np.random.Generator, width: int, height: int, count: int = 8) -> NDArray[np.float32]:
    """Return a few triangles on a uniform background."""
    out = np.full((height, width), 0.5)
    rows, cols = np.mgrid[:height, :width]
    for value in rng.choice([0.1, 0.9], count):
        middle = rng.uniform(0.1, 0.9, 2) * (width, height)
        corners = middle + rng.uniform(0.1, 0.25) * height * _triangle(rng.uniform(0.0, 2.0 * np.pi))
        inside = np.ones(out.shape, np.bool_)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            inside &= (b[0] - a[0]) * (rows - a[1]) - (b[1] - a[1]) * (cols - a[0]) >= 0.0
        out[inside] = value
    return _levels(out)


def printed(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float32]:
    """Return a page of print: lines of signs on white, each of two to four straight strokes."""
    out = np.ones((height, width))
    size = max(8, round(height / 30))
    for top in range(size, height - size, 2 * size):
        left = size
        while left < width - 2 * size:
            if rng.uniform() < 0.15:  # space between two words
                left += size
                continue
            for x0, y0, x1, y1 in rng.uniform(0.0, size, (rng.integers(2, 5), 4)):
                _line(out, (left + 0.6 * x0, top + y0), (left + 0.6 * x1, top + y1), 0.1 * size, 0.0)
            left += round(0.8 * size)
    return _levels(out)


def thin_lines(rng: np.random.Generator, width: int, height: int, count: int = 10) -> NDArray[np.float32]:
    """Return short thin lines, brighter or darker than their uniform background."""
    out = np.full((height, width), 0.5)
    for value in rng.choice([0.15, 0.85], count):
        middle, angle = rng.uniform(0.1, 0.9, 2) * (width, height), rng.uniform(0.0, np.pi)
        half = 0.5 * rng.uniform(0.1, 0.3) * height * np.array([math.cos(angle), math.sin(angle)])
        _line(out, middle - half, middle + half, rng.uniform(1.0, 2.5), value)
    return _levels(out)


def _line(out: NDArray[np.float64], start: ArrayLike, end: ArrayLike, half_width: float, value: float) -> None:
    """Draw a straight line of one luminance into the picture ``out``; ends are ``(x, y)`` [texels]."""
    ends = np.array([start, end])
    left, top = np.maximum(np.floor(ends.min(axis=0) - half_width).astype(int), 0)
    right, bottom = np.ceil(ends.max(axis=0) + half_width).astype(int) + 1
    part = out[top:bottom, left:right]
    rows, cols = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
    along = ends[1] - ends[0]
    share = ((cols - ends[0, 0]) * along[0] + (rows - ends[0, 1]) * along[1]) / max(float(along @ along), 1e-9)
    share = np.clip(share, 0.0, 1.0)
    away = np.hypot(cols - ends[0, 0] - share * along[0], rows - ends[0, 1] - share * along[1])
    part[away <= half_width] = value


def _triangle(angle: float) -> NDArray[np.float64]:
    """Return the corners of a unit triangle."""
    at = angle + np.arange(3) * (2.0 * np.pi / 3)
    return np.stack([np.cos(at), np.sin(at)], axis=1)


def _levels(share: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the luminance at shares 0 .. 1 of the scenes' range, on a logarithmic scale."""
    return (DARK * (BRIGHT / DARK) ** np.clip(share, 0.0, 1.0)).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _ChangingStill:
    """Still picture that changes with time (base class)."""

    light: NDArray[np.float32]
    """Linear luminance of the still picture, shape ``(height, width)``."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture [texels]."""
        return self.light.shape[1], self.light.shape[0]

    @property
    def interval_us(self) -> float:
        """Interval between two pictures [us]."""
        return float(FRAME_US)


@dataclass(frozen=True, slots=True, eq=False)
class Lamp(_ChangingStill):
    """Still picture with a flickering square.

    The square's luminance falls by ``depth`` and rises again :data:`LAMP_HZ` times per second. Satisfies
    :class:`amiwarp.simulation.simulator.Frames`.
    """

    share: float
    """Share of the picture's area that the lamp lights."""
    duration_us: int
    """Duration for which pictures are given [us]."""
    depth: float = 0.7
    """Relative decrease of the square's luminance when the lamp is dark."""

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield the time [us] and the picture with the square."""
        height, width = self.light.shape
        half = 0.5 * math.sqrt(self.share)
        rows = slice(round((0.5 - half) * height), round((0.5 + half) * height))
        cols = slice(round((0.5 - half) * width), round((0.5 + half) * width))
        for t in range(0, self.duration_us + FRAME_US, FRAME_US):
            out = self.light.copy()
            out[rows, cols] *= 1.0 - self.depth * math.sin(math.pi * LAMP_HZ * t * 1e-6) ** 2
            yield t, out


@dataclass(frozen=True, slots=True, eq=False)
class PassingObject(_ChangingStill):
    """Still picture in front of which a textured disc passes."""

    share: float
    """Share of the picture's area that the disc hides."""
    widths_per_s: float
    """Speed of the disc [picture widths/s]."""
    duration_us: int
    """Duration for which pictures are given [us]."""
    seed: int
    """Seed of the disc's texture."""

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield the time [us] and the picture with the disc."""
        height, width = self.light.shape
        radius = math.sqrt(self.share * width * height / math.pi)
        side = 2 * math.ceil(radius) + 1
        leaf = leaves(np.random.default_rng([self.seed, 0x0B1]), side, side, 600)
        rows, cols = np.mgrid[:side, :side]
        round_ = (rows - side // 2) ** 2 + (cols - side // 2) ** 2 <= radius**2
        for t in range(0, self.duration_us + FRAME_US, FRAME_US):
            out = self.light.copy()
            path = self.widths_per_s * width * (t - self.duration_us / 2) * 1e-6
            left, top = round(width / 2 + path) - side // 2, height // 2 - side // 2
            x0, x1, y0, y1 = max(left, 0), min(left + side, width), max(top, 0), min(top + side, height)
            if x0 < x1:
                part = (slice(y0 - top, y1 - top), slice(x0 - left, x1 - left))
                out[y0:y1, x0:x1][round_[part]] = leaf[part][round_[part]]
            yield t, out
