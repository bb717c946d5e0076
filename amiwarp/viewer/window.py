"""Time windows of the inspector: their selected events, and what the page shows of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from amiwarp.events.events import Events
from amiwarp.imaging.device_events import UploadedEvents
from amiwarp.viewer.drawn_truth import DrawnTruth
from amiwarp.viewer.imager import MeasuredImage, Region
from amiwarp.viewer.timeline import Span

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from amiwarp.reconstruction.result import Picture


@dataclass(frozen=True, eq=False)
class WindowAngles:
    """Prism angles of a window's events, without the clock offset that is set on the page."""

    on_device: UploadedEvents
    """Events of the images, on the device."""
    theta: NDArray[np.float64]
    """Prism angles of the drawn events [rad], shape ``(n,)``."""
    speed: NDArray[np.float64]
    """Speed of the prism at the drawn events [rad/us], shape ``(n,)``."""


@dataclass(frozen=True, eq=False)
class LoadedWindow:
    """Selected events of a window, in memory and on the device, and their image without compensation."""

    span: Span
    """Time window, with all events that were read from it."""
    region: Region
    """Part of the image that is shown."""
    selected: int
    """Number of events of the selection."""
    drawn: Events
    """Selected events that are drawn as points."""
    truth: DrawnTruth
    """Ground truth of the drawn events."""
    xy: NDArray[np.float32]
    """Pixels of the drawn events [px], shape ``(n, 2)``."""
    events: Events
    """Events of the images: the selected events, and those near the region that compensation may move into it."""
    curve_events: Events
    """Part of these events from which the sharpness curve is computed."""
    angles: dict[float, WindowAngles] = field(default_factory=dict)
    """Prism angles by the speed of a prism without encoder [1/min]; with an encoder, the only key is 0."""
    unmoved: list[MeasuredImage] = field(default_factory=list)
    """Image of the events as recorded, once it is measured."""
    chosen: list[Picture] = field(default_factory=list)
    """Reconstructed picture for which the weight of the smoothness prior was chosen last."""


@dataclass(frozen=True, eq=False)
class DisplayedWindow:
    """Time window shown with the current parameters: images of all events, and points of evenly spaced events."""

    span: Span
    """Time window, with all events that were read from it."""
    region: Region
    """Part of the image that is shown: left, top, right and bottom [px]; right and bottom are exclusive."""
    selected: int
    """Number of selected events, which are all in the images."""
    events: Events
    """Events that are drawn as points."""
    truth: DrawnTruth
    """Ground truth of these events."""
    before: NDArray[np.float32]
    """Pixels of the drawn events as recorded [px], shape ``(n, 2)``."""
    after: NDArray[np.float32]
    """Compensated positions of the drawn events [px], shape ``(n, 2)``; NaN if the model has no solution."""
    theta: NDArray[np.float64]
    """Prism angles of the drawn events [rad], from 0 to 2π, shape ``(n,)``."""
    image_before: NDArray[np.float32]
    """Image of the events as recorded [events per pixel], shape ``(height, width)``."""
    image_after: NDArray[np.float32]
    """Image of the compensated events [events per pixel], shape ``(height, width)``."""
    sharpness_before: float
    """Sharpness of ``image_before`` in the region: 0 for events at random, whatever their number."""
    sharpness_after: float
    """Sharpness of ``image_after`` in the region."""
