"""Images of warped events and their sharpness for the inspector, on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.device_events import UploadedEvents
from amiwarp.imaging.sharpness_costs import SharpnessMeter, relative_variance
from amiwarp.imaging.warped_image import CanvasShape, Votes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.models import Model

SMOOTHING_PX = 1.0
"""Standard deviation of the Gaussian that smooths the image before its sharpness is measured, as in calibration [px].
"""

Region = tuple[int, int, int, int]
"""Part of the image: left, top, right and bottom [px]; right and bottom are exclusive."""


@dataclass(frozen=True, eq=False)
class MeasuredImage:
    """Image of warped events with its sharpness in a region."""

    image: NDArray[np.float32]
    """The whole image [events per pixel], shape ``(height, width)``."""
    variance: float
    """Variance over mean of the smoothed region, as :attr:`amiwarp.Sharpness.VARIANCE`. It grows with the number of
    events."""
    sharpness: float
    """Relative variance of the smoothed region, see
    :func:`amiwarp.imaging.sharpness_costs.relative_variance`. It does not depend on the number of events."""


class WindowImager:
    """Makes images of warped events and measures their sharpness.

    An imager owns its buffers, so only one thread may use it.
    """

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        self._votes, self._device = Votes(CanvasShape(*size, dither=True), device), device
        self._meters: dict[tuple[int, int], SharpnessMeter] = {}

    def measure(self, model: Model, events: UploadedEvents, offset_us: float, region: Region) -> MeasuredImage:
        """Return the image, and its sharpness in the region.

        ``offset_us`` is added to the encoder's clock offset [us].
        """
        self._votes.clear()
        self._votes.add_events(model, events, drift=offset_us)
        left, top, right, bottom = region
        meter = self._meter(right - left, bottom - top)
        if meter.image.shape == self._votes.canvas.shape:
            self._votes.read(meter.image)
            image = part = meter.image.numpy()[0]
        else:
            image = self._votes.take()[0]
            part = image[top:bottom, left:right]
            meter.image.write(part[None])
        variance, mean = meter.measure(), float(part.mean())
        return MeasuredImage(image, variance, relative_variance(variance, mean, SMOOTHING_PX) if mean > 0.0 else 0.0)

    def _meter(self, width: int, height: int) -> SharpnessMeter:
        """Return the meter of images of this size. Only the last one is kept."""
        if (width, height) not in self._meters:
            canvas = CanvasShape(width, height, dither=True)
            meter = SharpnessMeter(canvas, Sharpness.VARIANCE, smoothing=SMOOTHING_PX, device=self._device)
            self._meters = {(width, height): meter}
        return self._meters[width, height]
