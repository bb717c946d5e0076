"""Images of warped events and their sharpness for the inspector, on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.events.events import Events
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.device_events import UploadedEvents
from amiwarp.imaging.sharpness_costs import SharpnessMeter
from amiwarp.imaging.warped_image import CanvasShape, Votes
from amiwarp.viewer.drawn_truth import DrawnTruth
from amiwarp.viewer.timeline import Span

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.models import Model

SMOOTHING_PX = 1.0
"""Standard deviation of the Gaussian that smooths the image before its sharpness is measured, as in calibration [px].
"""


class WindowImager:
    """Makes images of warped events and measures their sharpness.

    An imager owns its buffers, so only one thread may use it.
    """

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        canvas = CanvasShape(*size, dither=True)
        self._votes = Votes(canvas, device)
        self._meter = SharpnessMeter(canvas, Sharpness.VARIANCE, smoothing=SMOOTHING_PX, device=device)

    def measure(self, model: Model, events: UploadedEvents, offset_us: float) -> tuple[NDArray[np.float32], float]:
        """Return the image [events per pixel], shape ``(height, width)``, and its sharpness.

        ``offset_us`` is added to the encoder's clock offset [us].
        """
        self._votes.clear()
        self._votes.add_events(model, events, drift=offset_us)
        self._votes.read(self._meter.image)
        return self._meter.image.numpy()[0], self._meter.measure()


@dataclass(frozen=True, eq=False)
class LoadedWindow:
    """Selected events of a window, in memory and on the device, and their image without compensation."""

    span: Span
    """Time window, with all events that were read from it."""
    drawn: Events
    """Selected events that are drawn as points."""
    truth: DrawnTruth
    """Ground truth of the drawn events."""
    xy: NDArray[np.float32]
    """Pixels of the drawn events [px], shape ``(n, 2)``."""
    theta: NDArray[np.float64]
    """Prism angles of the drawn events [rad], shape ``(n,)``, without the clock offset that is set on the page."""
    speed: NDArray[np.float64]
    """Speed of the prism at the drawn events [rad/us], shape ``(n,)``."""
    on_device: UploadedEvents
    """All selected events, on the device."""
    curve_events: Events
    """Selected events from which the sharpness curve is computed."""
    curve_events_on_device: UploadedEvents
    """Events of the sharpness curve, on the device."""
    image: NDArray[np.float32]
    """Image of the events as recorded [events per pixel], shape ``(height, width)``."""
    sharpness: float
    """Sharpness of the image of the events as recorded."""
