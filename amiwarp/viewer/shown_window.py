"""Time windows of the inspector: their selected events, and what page and window show of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.imaging.regions import Region
from amiwarp.imaging.uploaded_events import UploadedEvents
from amiwarp.io.spans import Span
from amiwarp.reconstruction.picture import Picture
from amiwarp.viewer.drawn_truth import DrawnTruth
from amiwarp.viewer.filters import FilterStep


@dataclass(frozen=True, eq=False)
class DrawnWindow:
    """Selected events of a time window that are drawn as points."""

    span: Span
    """Time window, with all events that were read from it."""
    region: Region
    """Part of the image that is shown."""
    selected: int
    """Number of selected events, which are all in the images."""
    events: Events
    """Events that are drawn as points."""
    truth: DrawnTruth
    """Ground truth of these events."""
    before: NDArray[np.float32]
    """Pixels of the drawn events as recorded [px], shape ``(n, 2)``."""
    steps: tuple[FilterStep, ...]
    """Numbers of events before and after each part of the selection."""

    @property
    def read_us(self) -> float:
        """Time of which events were read [us]; of a window with too many events, the time of its runs."""
        return max(1.0, self.span.length_us * len(self.span.events) / max(self.span.count, 1))


@dataclass(frozen=True, eq=False)
class LoadedWindow(DrawnWindow):
    """Selected events of a window, in memory and on the device, and their image without compensation."""

    counted: Events
    """Events of the images: the selected events, and those near the region that compensation may move into it."""
    angles: dict[float, tuple[UploadedEvents, NDArray[np.float64], NDArray[np.float64]]] = field(
        default_factory=dict
    )
    """Events on the device, prism angles [rad] and speeds [rad/us] of the drawn events, without the clock offset set on
    the page, by the speed of a prism without encoder [1/min]; with an encoder, the only key is 0."""
    wrapped: dict[tuple[float, float], NDArray[np.float64]] = field(default_factory=dict)
    """Last prism angles of the drawn events, from 0 to 2π [rad], by speed and drift of the clock offset."""
    as_recorded: list[tuple[NDArray[np.float32], float]] = field(default_factory=list)
    """Image of the events as recorded and its sharpness; empty until it is measured."""
    last_picture: list[Picture] = field(default_factory=list)
    """Reconstructed picture for which the weight of the smoothness prior was chosen last; empty before."""


@dataclass(frozen=True, eq=False)
class DisplayedWindow(DrawnWindow):
    """Time window shown with the current parameters: images of all events, and points of evenly spaced events."""

    after: NDArray[np.float32]
    """Compensated positions of the drawn events [px], shape ``(n, 2)``; NaN if the model has no solution."""
    theta: NDArray[np.float64]
    """Prism angles of the drawn events [rad], from 0 to 2π, shape ``(n,)``."""
    image_before: NDArray[np.float32]
    """Number of events at each pixel as recorded, shape ``(height, width)``."""
    image_after: NDArray[np.float32]
    """Number of compensated events at each pixel, shape ``(height, width)``."""
    sharpness_before: float
    """Sharpness of ``image_before`` in the region: 0 for events at random, whatever their number."""
    sharpness_after: float
    """Sharpness of ``image_after`` in the region."""
    beside: DisplayedWindow | None = None
    """The same time of another recording, whose events, as recorded, the first cloud and image show instead."""
    is_beside: bool = False
    """Whether this is another recording, of which less may be known."""
    offset_us: int = 0
    """Time of its first event after the first event of the recording whose time axis it shares [us]."""

    @property
    def first(self) -> DisplayedWindow:
        """What the first cloud shows."""
        return self.beside or self

    def every(self, step: int) -> DisplayedWindow:
        """Return the window with every ``step``-th point."""
        if step == 1:
            return self
        return replace(
            self,
            events=self.events[::step],
            truth=self.truth.every(step),
            before=self.before[::step],
            after=self.after[::step],
            theta=self.theta[::step],
        )
