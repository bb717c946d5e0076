"""Events of a calibration: thinned, with the encoder that gives their angles, and uploaded to a device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.uploaded_events import UploadedEvents, upload_events

SlopeOf = Callable[[NDArray[np.int64]], NDArray[np.float64]]
_Place = tuple[str, int | None]
"""Device to which events are uploaded, and the time to which theirs are relative [us]."""


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
    _uploaded: dict[_Place, UploadedEvents] = field(
        default_factory=dict,
        repr=False,
        init=False,
    )

    def on(self, device: Any, middle_us: int | None) -> UploadedEvents:
        """Return the events on a device, uploaded once; with times relative to ``middle_us`` if it is given."""
        key = str(device), middle_us
        if key not in self._uploaded:
            uploaded = self._every_uploaded(key) or self._upload(device, middle_us)
            self._uploaded[key] = uploaded
        return self._uploaded[key]

    def _every_uploaded(self, key: _Place) -> UploadedEvents | None:
        """Return these events from the ones on the device of which they are a part; None if they are not there."""
        if self.every_of is None or self.fold:
            return None
        all_events, step = self.every_of
        uploaded = all_events._uploaded.get(key)
        if uploaded is None:
            return None
        return uploaded.every(step)

    def _upload(self, device: Any, middle_us: int | None) -> UploadedEvents:
        """Upload the events to a device."""
        slope = None
        if self.slope_of is not None:
            slope = self.slope_of(self.events.t)
        return upload_events(
            self.events,
            self.encoder,
            device,
            slope=slope,
            middle_us=middle_us,
            fold=self.fold,
        )

    def every(self, step: int) -> CalibrationEvents:
        """Return every ``step``-th event, with the same encoder."""
        if step == 1:
            return self
        some = self._cut(slice(0, None, step))
        return replace(some, every_of=(self, step))

    def central(self, share: float) -> CalibrationEvents:
        """Return the events in the central ``share`` of the duration."""
        t = self.events.t
        first_us = int(t[0])
        last_us = int(t[-1])
        middle = (first_us + last_us) / 2.0
        half = share * (last_us - first_us) / 2.0
        first, last = np.searchsorted(t, [middle - half, middle + half])
        return self._cut(slice(int(first), int(last) + 1))

    def _cut(self, cut: slice) -> CalibrationEvents:
        return CalibrationEvents(self.events[cut], self.encoder, self.slope_of, self.fold)
