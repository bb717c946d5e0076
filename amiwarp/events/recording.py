"""The recording: events with their encoder, camera, prism and, if simulated, their truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.events import EventSource

if TYPE_CHECKING:
    from amiwarp.events.encoder import Encoder
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.prism import NominalPrism

MetadataValue: TypeAlias = str | int | float | bool


class PointStore(Protocol):
    """Anything that gives an ``(n, 2)`` float32 array for a slice: an array, or a lazily read file."""

    def __getitem__(self, which: slice, /) -> NDArray[np.float32]: ...


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What made a synthetic recording."""

    parameters: dict[str, float] = field(default_factory=dict)
    """True values: apex, phase, tilt_x, tilt_y [rad], index, clock_offset_us [us], and others by name."""
    stored_points: PointStore | None = None
    """Per event, in the events' order, its scene point's pixel without the prism, as ``(n, 2)`` float32 [px]."""

    def points(self, start: int, stop: int) -> NDArray[np.float32] | None:
        """Points of the events ``start <= index < stop``, shape ``(n, 2)`` [px], or None if they are not stored."""
        return None if self.stored_points is None else self.stored_points[max(start, 0) : max(stop, 0)]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Events with all that is known about how they came to be."""

    events: EventSource
    """The events."""
    camera: Camera | None = None
    """The camera, where known."""
    encoder: Encoder | None = None
    """The prism's angle over time, where known."""
    prism: NominalPrism | None = None
    """The nominal prism: what the hardware's sheet says, not what calibration found; its apex may be unknown."""
    truth: Truth | None = None
    """What made the recording, where it is synthetic."""
    metadata: dict[str, MetadataValue] = field(default_factory=dict)
    """Whatever else is known: format, repairs made while reading, the simulator's seed."""
    name: str = "recording"
    """Short name for messages and titles: the file's name without its ending."""
