"""Pictures between the pictures of a sequence: brightness follows the motion instead of fading over."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.pictures import DARK
from amiwarp.simulation.sequences import Pictures
from amiwarp.translation.optical_flow import flows, warped

SMALL_MOTION_PX = 1.0
"""Largest motion between two pictures that are blended [px]."""
STEP_PX = 0.5
"""Largest motion between two interpolated pictures [px]."""
MOST_BETWEEN = 64
"""Largest number of pictures into which the time between two pictures is divided."""
MORE_PARTS = 4
"""Largest number of parts, relative to that for the motion that was expected: it limits the memory."""
SAMPLES = 6
"""Number of pairs of pictures whose motion is found before the simulation, to choose its time step."""
PERCENTILE = 99.0
"""Percentile of the flow's length that counts as the motion between two pictures."""
LEAST_CONSISTENT = 0.5
"""Smallest share of pixels whose flow is consistent; with fewer, the flow is meaningless and pictures are blended."""


class Interpolation(enum.StrEnum):
    """How the light changes between two pictures.

    Examples
    --------
    >>> [way.value for way in amiwarp.Interpolation]
    ['auto', 'motion', 'blend']
    """

    AUTO = "auto"
    """By motion if pictures move by more than one pixel, else by blending."""
    MOTION = "motion"
    """Along the optical flow between the two pictures (DIS of OpenCV)."""
    BLEND = "blend"
    """Each pixel's log intensity changes linearly. An edge that moves by more than a pixel fades out and in again."""


class MotionPictures:
    """Pictures of a sequence, and pictures in between that follow the optical flow (:class:`amiwarp.Frames`)."""

    def __init__(self, pictures: Pictures, way: Interpolation = Interpolation.AUTO) -> None:
        """Find out how much the pictures move."""
        self._pictures, self._way = pictures, way
        self._parts = _parts(sampled_motion(pictures, way))
        self._known: list[tuple[int, NDArray[np.bool_]]] = []

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
                pair = PicturePair(last[1], light, self._way)
                self._known.append((last[0], pair.known))
                count = min(_parts(pair.motion_px), MORE_PARTS * self._parts, t - last[0])
                for k in range(1, count):
                    yield last[0] + (t - last[0]) * k // count, light_of(pair.at(k / count))
            yield t, light
            last = (t, light)

    def take_known(self) -> list[tuple[int, NDArray[np.bool_]]]:
        """Return, and forget, where the flow of the pairs of pictures read so far is consistent, with their times."""
        taken, self._known = self._known, []
        return taken


class PicturePair:
    """Two successive pictures and the motion between them."""

    def __init__(
        self, first: NDArray[np.float32], second: NDArray[np.float32], way: Interpolation = Interpolation.AUTO
    ) -> None:
        """Find the motion between two pictures of linear luminance."""
        self.logs = [np.log(light + np.float32(DARK)) for light in (first, second)]
        """Log intensity of both pictures."""
        self.motion_px = 0.0
        """Motion between the pictures [px]; 0 if no consistent motion is found or wanted."""
        self.known = np.ones(first.shape, np.bool_)
        """Pixels of the first picture whose motion is known, or so small that it does not matter."""
        self._flows: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if way is not Interpolation.BLEND:
            self._find_motion(first, second, way)

    def _find_motion(self, first: NDArray[np.float32], second: NDArray[np.float32], way: Interpolation) -> None:
        forward, back, consistent = flows(first, second)
        if consistent.mean() >= LEAST_CONSISTENT:
            self.motion_px = float(np.percentile(np.hypot(forward[..., 0], forward[..., 1])[consistent], PERCENTILE))
        else:
            self.known = consistent
        if self.motion_px > SMALL_MOTION_PX or way is Interpolation.MOTION:
            self._flows, self.known = (forward, back), consistent

    def at(self, part: float) -> NDArray[np.float32]:
        """Return the log intensity at a time between the pictures, 0 .. 1.

        The flow at that time is combined from the flows between the pictures as by H. Jiang et al., "Super SloMo", CVPR
        2018, equation 4.
        """
        rest, seen = 1.0 - part, self.logs
        if self._flows is not None:
            forward, back = self._flows
            to_first, to_second = part * part * back - rest * part * forward, rest * rest * forward - part * rest * back
            seen = [warped(log, offset) for log, offset in zip(self.logs, (to_first, to_second), strict=True)]
        return np.asarray(rest * seen[0] + part * seen[1], np.float32)


def sampled_motion(pictures: Pictures, way: Interpolation) -> float:
    """Return the largest motion in some pairs of successive pictures [px]; 0 if they are to be blended."""
    if way is Interpolation.BLEND:
        return 0.0
    every = max(1, round(pictures.duration_us / pictures.interval_us / SAMPLES))
    largest, last = 0.0, None
    for k, (_, light) in enumerate(pictures.read()):
        if last is not None and (k - 1) % every == 0:
            largest = max(largest, PicturePair(last, light).motion_px)
        last = light
    return largest


def light_of(log: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the linear luminance of a log intensity."""
    return np.maximum(np.exp(log) - np.float32(DARK), np.float32(0.0))


def _parts(motion_px: float) -> int:
    """Return the number of parts of the time between two pictures."""
    return min(MOST_BETWEEN, math.ceil(motion_px / STEP_PX)) if motion_px > SMALL_MOTION_PX else 1
