"""Pictures in phase of windows of a recording on a device, one or two at a time.

The work of a picture is queued before the one before it is read, so that neither device nor host waits for the other.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.device_events import DeviceMemoryEvents, all_events, ranges_between
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import EventSource
from amiwarp.imaging.phase import BINS, sum_turns
from amiwarp.imaging.phase_device import DeviceSums
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction.device_picture import DevicePictures


class Drawn(NamedTuple):
    """Picture of a window on the host."""

    log: NDArray[np.float32]
    """Log intensity [ON thresholds], shape (height, width)."""
    known: NDArray[np.bool_]
    """Which pixels have events, shape (height, width)."""
    off_ratio: float
    """OFF threshold divided by the ON threshold."""
    full: bool
    """Whether a pixel has too many events for its sums."""


class Drawing:
    """Picture that is copied to the host when the device has made it."""

    def __init__(self, pictures: DevicePictures, sums: DeviceSums) -> None:
        pinned = pictures.device.is_cuda
        shape = pictures.picture.shape
        self._log = wp.empty(shape, dtype=float, device="cpu", pinned=pinned)
        self._known = wp.empty(shape, dtype=wp.uint8, device="cpu", pinned=pinned)
        self._marks = wp.empty(len(sums.marks), dtype=int, device="cpu", pinned=pinned)
        self._made = wp.Event(pictures.device) if pinned else None
        self._count = 0

    def copy(self, pictures: DevicePictures, sums: DeviceSums) -> None:
        """Queue the copies of a picture and what its sums note behind its work."""
        self._count = sums.count
        wp.copy(self._log, pictures.picture)
        wp.copy(self._known, sums.known)
        wp.copy(self._marks, sums.marks)
        if self._made is not None:
            pictures.device.stream.record_event(self._made)

    def result(self) -> Drawn:
        """Wait for the picture, and return it."""
        if self._made is not None:
            wp.synchronize_event(self._made)
        off_ratio, full = DeviceSums.notes_of(self._marks.numpy(), self._count)
        known = self._known.numpy().astype(np.bool_)
        return Drawn(self._log.numpy().copy(), known, off_ratio, full)


class DeviceWindows:
    """Pictures of windows of one recording. Use one object from one thread only."""

    def __init__(
        self, source: EventSource, encoder: Encoder, model: Model, harmonics: int, device: Any
    ) -> None:
        self._source: EventSource = source
        self._encoder = encoder
        width, height = source.size
        self._sums = DeviceSums(width, height, harmonics, BINS, device, extremes=True)
        self._pictures = DevicePictures(model, self._sums.values)
        self._idle: list[Drawing] = []
        # Events are looked up beside the pictures, not after them
        cuda = self._pictures.device.is_cuda
        self._beside = wp.Stream(self._pictures.device, priority=-1) if cuda else None

    def start(self, start_us: int, stop_us: int, turns: int) -> Drawing | None:
        """Begin with the picture of whole turns. None if there are no events."""
        sums = self._sums
        if isinstance(self._source, DeviceMemoryEvents):
            with wp.ScopedStream(self._beside, sync_enter=False):
                (part,) = ranges_between(self._source, [(start_us, stop_us)])
            if not part.number:
                return None
            sums.sum_range(all_events(self._source), part, self._encoder, turns=float(turns))
        else:
            events = self._source.between(start_us, stop_us)
            if not len(events):
                return None
            sum_turns(sums, events, self._encoder, float(turns))
        self._pictures.draw()
        drawing = self._idle.pop() if self._idle else Drawing(self._pictures, sums)
        drawing.copy(self._pictures, sums)
        return drawing

    def finish(self, drawing: Drawing) -> Drawn:
        """Return a picture when it is made."""
        found = drawing.result()
        self._idle.append(drawing)
        return found
