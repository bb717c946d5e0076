"""Light between two successive pictures: along the motion between them, or blended."""

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import Option
from amiwarp.simulation.picture_light import DARK
from amiwarp.simulation.translation.picture_flow import flows, warped

SMALL_MOTION_PX = 1.0
"""Largest motion between two pictures that are blended [px]."""

PERCENTILE = 99.0
"""Percentile of the flow's length that counts as the motion between two pictures."""
LEAST_CONSISTENT = 0.5
"""Smallest share of pixels whose flow is consistent; with fewer, the flow is meaningless and pictures are blended."""


class Interpolation(Option):
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


class PicturePair:
    """Two successive pictures and the motion between them."""

    def __init__(
        self,
        first: NDArray[np.float32],
        second: NDArray[np.float32],
        way: Interpolation = Interpolation.AUTO,
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

    def _find_motion(
        self, first: NDArray[np.float32], second: NDArray[np.float32], way: Interpolation
    ) -> None:
        forward, back, consistent = flows(first, second)
        if consistent.mean() >= LEAST_CONSISTENT:
            length = np.hypot(forward[..., 0], forward[..., 1])
            self.motion_px = float(np.percentile(length[consistent], PERCENTILE))
        else:
            self.known = consistent
        if self.motion_px > SMALL_MOTION_PX or way is Interpolation.MOTION:
            self._flows = (forward, back)
            self.known = consistent

    def at(self, part: float) -> NDArray[np.float32]:
        """Return the log intensity at a time between the pictures, 0 .. 1.

        The flow at that time is combined from the flows between the pictures as by H. Jiang et al., "Super SloMo", CVPR
        2018, equation 4.
        """
        rest = 1.0 - part
        first, second = self.logs
        if self._flows is not None:
            forward, back = self._flows
            to_first = part * part * back - rest * part * forward
            to_second = rest * rest * forward - part * rest * back
            first = warped(first, to_first)
            second = warped(second, to_second)
        return np.asarray(rest * first + part * second, np.float32)


def light_of(log: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the linear luminance of a log intensity."""
    return np.maximum(np.exp(log) - np.float32(DARK), np.float32(0.0))
