"""Events of a chunk of simulated time on the device, and their collection in memory."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.device_events import (
    NAMES,
    DeviceEvents,
    DeviceMemoryEvents,
    DeviceValues,
    join,
    wait,
)
from amiwarp.events.recording import Events, EventSource, MemoryEvents
from amiwarp.events.truth import EventTruth, EventValues


@dataclass(slots=True)
class DeviceBlock:
    """Sorted events of one chunk of simulated time, in device memory."""

    arrays: Any
    """Columns of the events: the kernels' struct :class:`amiwarp.kernels.event_keys.Block`."""
    look: Callable[[], Any] | None = None
    """Function that finds the surfaces that the events saw, valid until the next chunk; None for a picture scene."""
    at_rest: wp.array | None = None
    """Pixel of each event's scene point in a vibrating camera's view at rest [px]; None if the camera has no vibration.
    """

    def events(self) -> Events:
        """Return the events in host memory."""
        arrays = self.arrays
        return Events(arrays.x.numpy(), arrays.y.numpy(), arrays.t.numpy(), arrays.p.numpy())

    def points(self) -> NDArray[np.float32]:
        """Return the scene point of each event: its pixel without prism and vibration [px], shape (n, 2)."""
        return np.asarray(self._points.numpy())

    @property
    def _points(self) -> wp.array:
        return self.arrays.points if self.at_rest is None else self.at_rest

    def on_device(self) -> tuple[DeviceEvents, wp.array]:
        """Return the finished events, and their scene points without the prism, without a copy."""
        arrays = self.arrays
        wait(arrays.t.device)
        return DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p), self._points

    def truth(self) -> EventTruth:
        """Return the ground truth of the events.

        In a world, call this method before the engine simulates the next chunk.
        """
        of_events = {}
        for name, values in self.columns().items():
            if name not in NAMES:
                of_events[name] = values.numpy()
        return EventTruth(**of_events)

    def columns(self) -> dict[str, wp.array]:
        """Return events and ground truth on the device, by the names of :class:`Events` and :class:`EventTruth`.

        In a world, call this method before the engine simulates the next chunk.
        """
        by_name = {name: getattr(self.arrays, name) for name in NAMES}
        by_name["points"] = self._points
        by_name["cause"] = self.arrays.cause
        if self.look is not None:
            surfaces = self.look()
            by_name["instance"] = surfaces.instance
            by_name["depth"] = surfaces.depth
            by_name["place"] = surfaces.place
        return by_name


class CollectedEvents:
    """Columns of successive blocks of events and of their ground truth."""

    def __init__(self, *, on_device: bool) -> None:
        """Prepare to collect events on the device that simulates them, or on the host."""
        self._on_device = on_device
        self._parts: dict[str, list[Any]] = {}

    def add(self, block: DeviceBlock) -> None:
        """Add a block. In a world, call this method before the engine simulates the next chunk."""
        for name, values in block.columns().items():
            self._parts.setdefault(name, []).append(values if self._on_device else values.numpy())

    def take(self, width: int, height: int) -> tuple[EventSource, dict[str, EventValues]]:
        """Return a source of all events, and their ground truth by the names of :class:`EventTruth`.

        The blocks of a column are released once they are joined, so that only one column is held twice.
        """
        unite = join if self._on_device else np.concatenate
        by_name = {name: unite(self._parts.pop(name)) for name in list(self._parts)}
        events = [by_name.pop(name) for name in NAMES]
        if not self._on_device:
            return MemoryEvents(Events(*events), width, height), by_name
        source = DeviceMemoryEvents(DeviceEvents(*events), width, height)
        wait(source.device)
        return source, {name: DeviceValues(values) for name, values in by_name.items()}
