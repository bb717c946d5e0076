"""Scenes of the stability study that change: a still picture with a flickering lamp, or with an object that passes."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.studies.stability.scenes import leaves

LAMP_HZ = 100.0
"""Frequency of the flickering lamp [Hz]."""
FRAME_US = 1000
"""Interval between two pictures [us]."""
LEAVES = 600
"""Number of leaves in the texture of a passing disc."""
DISC_STREAM = 0x0B1
"""Second seed of the disc's texture, which shall not be the texture of the scene with the same seed."""


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
    :class:`amiwarp.Frames`.
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
        columns = slice(round((0.5 - half) * width), round((0.5 + half) * width))
        for t in range(0, self.duration_us + FRAME_US, FRAME_US):
            picture = self.light.copy()
            # The square of a sine has twice its frequency: one dip in each period of the lamp.
            wave = math.sin(math.pi * LAMP_HZ * t * 1e-6)
            picture[rows, columns] *= 1.0 - self.depth * wave**2
            yield t, picture


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
        middle = math.ceil(radius)
        side = 2 * middle + 1
        texture = leaves(np.random.default_rng([self.seed, DISC_STREAM]), side, side, LEAVES)
        rows, columns = np.mgrid[:side, :side]
        in_disc = (rows - middle) ** 2 + (columns - middle) ** 2 <= radius**2
        top = height // 2 - middle
        for t in range(0, self.duration_us + FRAME_US, FRAME_US):
            picture = self.light.copy()
            path = self.widths_per_s * width * (t - self.duration_us / 2) * 1e-6
            left = round(width / 2 + path) - middle

            # The part of the disc's square that lies in the picture
            x0 = max(left, 0)
            x1 = min(left + side, width)
            y0 = max(top, 0)
            y1 = min(top + side, height)
            if x0 < x1:
                of_square = (slice(y0 - top, y1 - top), slice(x0 - left, x1 - left))
                hidden = in_disc[of_square]
                behind = picture[y0:y1, x0:x1]
                behind[hidden] = texture[of_square][hidden]
            yield t, picture
