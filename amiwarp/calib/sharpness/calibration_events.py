"""Events of a calibration with the encoder that gives their prism angles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.imaging.device_events import upload_events

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.imaging.device_events import UploadedEvents

    SlopeOf = Callable[[NDArray[np.int64]], NDArray[np.float64]]


@dataclass(frozen=True)
class CalibrationEvents:
    """Events with their encoder, uploaded to a device on first use."""

    events: Events
    """The events in the order of time."""
    encoder: Encoder
    """The encoder that gives their prism angles."""
    slope_of: SlopeOf | None
    """Function that returns the change of the prism angle at given times [us] per unit of a free clock offset or rpm;
    None if neither is free."""
    fold: int = 0
    """Number of angle bins per turn into which a pixel's events are merged; 0: events are not merged."""
    _uploaded: dict[tuple[str, int | None], UploadedEvents] = field(default_factory=dict, repr=False, init=False)

    def on(self, device: Any, middle_us: int | None) -> UploadedEvents:
        """Return the events on a device, uploaded once; with times relative to ``middle_us`` if it is given."""
        if (str(device), middle_us) not in self._uploaded:
            slope = None if self.slope_of is None else self.slope_of(self.events.t)
            events = upload_events(self.events, self.encoder, device, slope=slope, middle_us=middle_us, fold=self.fold)
            self._uploaded[str(device), middle_us] = events
        return self._uploaded[str(device), middle_us]

    def every(self, step: int) -> CalibrationEvents:
        """Return every ``step``-th event, with the same encoder."""
        return self if step == 1 else self._cut(slice(0, None, step))

    def central(self, share: float) -> CalibrationEvents:
        """Return the events in the central ``share`` of the duration."""
        t = self.events.t
        middle, half = (int(t[0]) + int(t[-1])) / 2.0, share * (int(t[-1]) - int(t[0])) / 2.0
        first, last = np.searchsorted(t, [middle - half, middle + half])
        return self._cut(slice(int(first), int(last) + 1))

    def _cut(self, cut: slice) -> CalibrationEvents:
        return CalibrationEvents(self.events[cut], self.encoder, self.slope_of, self.fold)
