"""Events of a simulation and their ground truth, collected in the memory of the host or of the device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.events.device_events import NAMES, DeviceEvents, join, wait
from amiwarp.events.device_source import DeviceMemoryEvents, DeviceValues
from amiwarp.events.events import Events, EventSource, MemoryEvents

if TYPE_CHECKING:
    from amiwarp.events.truth import EventValues
    from amiwarp.simulation.engine import DeviceBlock


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
        found = {name: unite(self._parts.pop(name)) for name in list(self._parts)}
        events = [found.pop(name) for name in NAMES]
        if not self._on_device:
            return MemoryEvents(Events(*events), width, height), found
        source = DeviceMemoryEvents(DeviceEvents(*events), width, height)
        wait(source.device)
        return source, {name: DeviceValues(values) for name, values in found.items()}
