"""Frames of events and prism angles, as the viewers Rerun and Foxglove get them."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Layers
from amiwarp.compensation.in_memory import BlockCompensator
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.export import to_picture
from amiwarp.imaging.palette import OFF_ON_BLACK, ON_ON_BLACK
from amiwarp.imaging.votes import Votes

FRAME_US = 33_333
"""Default length of the time window of a frame [us]."""
MOST_POINTS = 10_000
"""Largest number of points in the cloud of a frame; more events are thinned evenly."""
ANGLE_US = 1000
"""Interval between two prism angles of a recording [us]."""
RECORDED = "recorded"
COMPENSATED = "compensated"
"""Names of the two streams of frames."""


@dataclass(frozen=True, slots=True)
class Frame:
    """Events of a time window, and their image."""

    events: Events
    png: bytes
    """Image with OFF in blue and ON in orange, as a PNG file."""


@dataclass(frozen=True, slots=True)
class Window:
    """Time window with a frame of each stream, and with prism angles."""

    t: int
    """Start [us]."""
    length_us: int
    """Length [us]."""
    frames: Mapping[str, Frame]
    """Frames by the name of their stream."""
    angles: Mapping[str, tuple[NDArray[np.int64], NDArray[np.float64]]] = field(
        default_factory=dict
    )
    """Times [us] and prism angles [rad] by name, each of shape ``(n,)``."""


ANGLES = ("angle", "second_angle")
"""Names of the angles of the first and of the second prism, or of a mirror's two."""


class Painter:
    """Image of the events of a frame, on a canvas that is allocated once."""

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        """Take the width and height of the sensor [px]."""
        self._votes = Votes(CanvasShape(*size, per_polarity=True), device)

    def __call__(self, events: Events) -> Frame:
        """Return the frame of events, raw or compensated."""
        from PIL import Image

        self._votes.add_unmoved(events)
        picture = to_picture(self._votes.take(), Layers.POLARITY)
        buffer = io.BytesIO()
        # Level 1 is ten times as fast as the best one.
        Image.fromarray(picture).save(buffer, "PNG", compress_level=1)
        return Frame(events, buffer.getvalue())


def windows(
    recording: Recording,
    compensate: BlockCompensator | None,
    encoder: Encoder | None,
    length_us: int,
    device: Any,
) -> Iterator[Window]:
    """Yield the time windows with events, and an empty one at the start of each gap."""
    source = recording.events
    paint = Painter(source.size, device)
    first = source.t_first
    last = -1
    names = [RECORDED] if compensate is None else [RECORDED, COMPENSATED]
    for events in source.blocks(duration_us=length_us):
        number = (int(events.t[0]) - first) // length_us
        if last + 1 < number:
            gap_us = first + (last + 1) * length_us
            empty = {name: paint(Events.empty()) for name in names}
            yield Window(gap_us, length_us, empty)
        last = number
        start = first + number * length_us
        frames = {RECORDED: paint(events)}
        if compensate is not None:
            moved, _ = compensate(events)
            frames[COMPENSATED] = paint(moved)
        yield Window(start, length_us, frames, _angles(encoder, start, start + length_us))


def _angles(
    encoder: Encoder | None, start: int, stop: int
) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return times [us] from ``start`` to ``stop`` and the prism angles [rad] there, by name."""
    if encoder is None:
        return {}
    begin, end = encoder.coverage
    t = np.arange(start, stop, ANGLE_US, dtype=np.int64)
    t = t[(begin <= t) & (t <= end)]
    columns = [encoder.angle_at(t)]
    if encoder.second is not None:
        columns = list(encoder.angles_at(t).T)
    return {name: (t, angle) for name, angle in zip(ANGLES, columns, strict=False)}


def points(window: Window, events: Events) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the points of a cloud, shape ``(n, 3)``, and their colours as RGB, shape ``(n, 3)``.

    The coordinates are x and y [px], and the share of the window that has passed times 100.
    """
    step = max(1, -(-len(events) // MOST_POINTS))  # rounded up
    events = events[::step]
    passed = (events.t - window.t) * (100.0 / window.length_us)
    places = np.stack([events.x, events.y, passed], axis=1).astype(np.float32)
    palette = np.rint(255.0 * np.array([OFF_ON_BLACK, ON_ON_BLACK])).astype(np.uint8)
    known = np.isfinite(places).all(axis=1)
    return places[known], palette[events.p[known].astype(np.intp)]


def degrees_in_turn(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles [rad] within a turn, in degrees."""
    return np.degrees(np.mod(angle, 2.0 * math.pi))
