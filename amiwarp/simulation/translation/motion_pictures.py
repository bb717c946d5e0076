"""Pictures between the pictures of a sequence: brightness follows the motion instead of fading over."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.pictures import Pictures
from amiwarp.simulation.translation.known_pictures import KnownPictures
from amiwarp.simulation.translation.picture_pair import (
    SMALL_MOTION_PX,
    Interpolation,
    PicturePair,
    light_of,
)

STEP_PX = 0.5
"""Largest motion between two interpolated pictures [px]."""
MOST_BETWEEN = 64
"""Largest number of pictures into which the time between two pictures is divided."""
MORE_PARTS = 4
"""Largest number of parts, relative to the number for the expected motion: it limits the memory."""
SAMPLES = 6
"""Number of pairs of pictures whose motion is found before the simulation, to choose its time step."""


class MotionPictures(KnownPictures):
    """Pictures of a sequence, and pictures in between that follow the optical flow (:class:`amiwarp.Frames`).

    Pixels are known where the flow of a pair of pictures is consistent.
    """

    def __init__(self, pictures: Pictures, way: Interpolation = Interpolation.AUTO) -> None:
        """Find out how much the pictures move."""
        self._pictures = pictures
        self._way = way
        self._parts = _parts(sampled_motion(pictures, way))
        super().__init__()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""
        return self._pictures.size

    @property
    def interval_us(self) -> float:
        """Smallest time between two pictures [us]."""
        return self._pictures.interval_us / self._parts

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time [us] and linear luminance, shape (height, width)."""
        self._known.clear()
        last: tuple[int, NDArray[np.float32]] | None = None
        for t, light in self._pictures.read():
            if last is not None:
                start, first = last
                pair = PicturePair(first, light, self._way)
                self._known.append((start, pair.known))
                count = min(_parts(pair.motion_px), MORE_PARTS * self._parts, t - start)
                for k in range(1, count):
                    yield start + (t - start) * k // count, light_of(pair.at(k / count))
            yield t, light
            last = (t, light)


def sampled_motion(pictures: Pictures, way: Interpolation) -> float:
    """Return the largest motion in some pairs of successive pictures [px]; 0 if they are to be blended."""
    if way is Interpolation.BLEND:
        return 0.0
    every = max(1, round(pictures.duration_us / pictures.interval_us / SAMPLES))
    largest = 0.0
    last = None
    for k, (_, light) in enumerate(pictures.read()):
        if last is not None and (k - 1) % every == 0:
            largest = max(largest, PicturePair(last, light).motion_px)
        last = light
    return largest


def _parts(motion_px: float) -> int:
    """Return the number of parts of the time between two pictures."""
    if motion_px <= SMALL_MOTION_PX:
        return 1
    return min(MOST_BETWEEN, math.ceil(motion_px / STEP_PX))
