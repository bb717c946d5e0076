"""Pictures of all sensors of a rig at the time of the shown window: counts of events, frames and depth maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Vote
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.other_sensors import ImageStore
from amiwarp.events.recording import Recording
from amiwarp.events.rig_recording import RigRecording
from amiwarp.imaging.iwe import iwe
from amiwarp.io.spans import Span, read_span
from amiwarp.plotting.colours import DEPTH_MAP, SKY, Scale, count_scale, depth_ends

MOST_EVENTS = 1_000_000
"""Largest number of events of a sensor that are counted. Of a fuller window, evenly spaced runs are read."""


@dataclass(frozen=True, eq=False)
class SensorPicture:
    """What a sensor saw at the time of a window."""

    name: str
    """Name of the sensor, with what the picture shows if the sensor has several."""
    text: str
    """Number of events, or time of the frame after the main sensor's first event, and after the window's middle."""
    values: NDArray[Any]
    """Counts, grey levels or depths, shape ``(height, width)``; or colours of 8 bits, shape ``(height, width, 3)``."""
    scale: Scale | None
    """Colours of the values; None for colours."""


@dataclass(frozen=True, eq=False)
class ShownRig:
    """A rig of which the inspector shows one sensor in full, and pictures of the others."""

    rig: RigRecording
    main: str
    """Name of the sensor that is shown in full."""

    def others(self) -> list[Recording]:
        """Return the recordings of the other sensors with events and as many pixels."""
        size = self.rig[self.main].recording.events.size
        found = []
        for name, sensor in self.rig.sensors.items():
            events = sensor.recording.events
            if name != self.main and len(events) and events.size == size:
                found.append(sensor.recording)
        return found

    def pictures(self, span: Span) -> list[SensorPicture]:
        """Return the pictures of all sensors at the time of a window; the events of the main one are shown already."""
        found = []
        for name, sensor in self.rig.sensors.items():
            recording = sensor.recording
            if name != self.main and len(recording.events):
                found.append(_events_picture(name, recording, span))
            for what, store in (("frames", recording.frames), ("depth", recording.depth)):
                if store is not None and len(store.t):
                    title = name if sensor.kind.value == what else f"{name}, {what}"
                    found.append(_nearest_picture(title, store, span))
        return found


def main_sensor(rig: RigRecording, given: str | None) -> str:
    """Return the name of the sensor that is shown in full: the given one, or left, or the first one with events.

    Raises :class:`AmiwarpError` if it has no events.
    """
    with_events = [name for name in rig.sensors if len(rig[name].recording.events)]
    if given is not None:
        rig[given]  # an unknown name is refused with all known ones
        if given not in with_events:
            raise AmiwarpError(
                f"{rig.name}: {given} has no events; choose among {', '.join(with_events)}",
                ErrorCode.CONTENT_MISSING,
            )
        return given
    if not with_events:
        raise AmiwarpError(
            f"{rig.name}: no sensor has events; the inspector needs one", ErrorCode.CONTENT_MISSING
        )
    return "left" if "left" in with_events else with_events[0]


def _events_picture(name: str, recording: Recording, span: Span) -> SensorPicture:
    """Return the number of events per pixel in the time of a window."""
    source = recording.events
    seen = read_span(source, span.start_us, span.length_us, most_events=MOST_EVENTS)
    counts = iwe(seen.events, *source.size, vote=Vote.NEAREST)
    return SensorPicture(name, f"{seen.count:,} events", counts, count_scale([counts]))


def _nearest_picture(name: str, store: ImageStore, span: Span) -> SensorPicture:
    """Return the frame or depth map that is nearest to the middle of a window."""
    middle = span.start_us + span.length_us // 2
    index = int(np.argmin(np.abs(store.t - middle)))
    t = int(store.t[index])
    text = f"{(t - span.first_us) * 1e-3:.1f} ms (middle {(t - middle) * 1e-3:+.1f} ms)"
    image = store[index]
    if image.dtype == np.float32:
        metres = np.where(np.isfinite(image), image, np.nan)
        low, high = depth_ends(metres)
        scale = Scale("depth", "m", low, high, DEPTH_MAP, missing=SKY, missing_text="unknown")
        return SensorPicture(name, text, metres, scale)
    if image.ndim == 3:
        colours = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
        return SensorPicture(name, text, colours, None)
    most = float(np.iinfo(image.dtype).max)
    return SensorPicture(name, text, image, Scale("grey level", "1", 0.0, most, "gray"))
