"""Events of a calibration with the encoder that gives their prism angles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
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
    every_of: tuple[CalibrationEvents, int] | None = None
    """Events of which these are every n-th, and n; None if these are all events."""
    _uploaded: dict[tuple[str, int | None], UploadedEvents] = field(default_factory=dict, repr=False, init=False)

    def on(self, device: Any, middle_us: int | None) -> UploadedEvents:
        """Return the events on a device, uploaded once; with times relative to ``middle_us`` if it is given."""
        key = str(device), middle_us
        if key not in self._uploaded:
            self._uploaded[key] = self._every_uploaded(key) or self._upload(device, middle_us)
        return self._uploaded[key]

    def _every_uploaded(self, key: tuple[str, int | None]) -> UploadedEvents | None:
        """Return these events from the ones on the device of which they are a part; None if they are not there."""
        if self.every_of is None or self.fold:
            return None
        all_events, step = self.every_of
        return all_events._uploaded[key].every(step) if key in all_events._uploaded else None

    def _upload(self, device: Any, middle_us: int | None) -> UploadedEvents:
        slope = None if self.slope_of is None else self.slope_of(self.events.t)
        return upload_events(self.events, self.encoder, device, slope=slope, middle_us=middle_us, fold=self.fold)

    def every(self, step: int) -> CalibrationEvents:
        """Return every ``step``-th event, with the same encoder."""
        return self if step == 1 else replace(self._cut(slice(0, None, step)), every_of=(self, step))

    def central(self, share: float) -> CalibrationEvents:
        """Return the events in the central ``share`` of the duration."""
        t = self.events.t
        middle, half = (int(t[0]) + int(t[-1])) / 2.0, share * (int(t[-1]) - int(t[0])) / 2.0
        first, last = np.searchsorted(t, [middle - half, middle + half])
        return self._cut(slice(int(first), int(last) + 1))

    def _cut(self, cut: slice) -> CalibrationEvents:
        return CalibrationEvents(self.events[cut], self.encoder, self.slope_of, self.fold)
