"""Triggers, IMU samples and frames in AEDAT 4 files. The file's units are g and degrees per second.

Their times are shifted as the times of the events, where the clock of the camera starts again.
"""

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.aedat.aedat4_clock import OtherClock
from amiwarp.io.aedat.aedat4_header import Aedat4File
from amiwarp.io.aedat.aedat4_packets import read_batches
from amiwarp.io.aedat.aedat4_tables import (
    DAMAGE,
    I1,
    I2,
    I8,
    field_of,
    root_of,
    tables_of,
    vector_of,
)
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_sensors import GRAVITY

RISING = 1
FALLING = 2
PULSE = 3
EDGES = (RISING, FALLING, PULSE)
"""Types of triggers at the external input. Others mark the exposure and the reading of frames."""
TRIGGER_FIELDS = {0: "<i8", 1: "i1"}
"""Fields of a trigger: time and type."""

GREY_BYTES = {0: 1, 2: 2}
"""Bytes per pixel of grey frames, by their format, as OpenCV numbers it."""


def edge_packets(about: Aedat4File, restarts: list[tuple[int, int]]) -> Iterator[Packet]:
    """Yield the edges at the external input, of channel 0."""
    clock = OtherClock(restarts)
    with contextlib.closing(read_batches(about, "TRIG")) as batches:
        for batch in batches:
            contents = [content for content in batch.contents if content.kind == "TRIG"]
            fields = tables_of([content.data for content in contents], TRIGGER_FIELDS)
            t = clock.shift_all(contents, fields)
            kind = fields.values[1]
            is_edge = np.isin(kind, EDGES)
            channel = np.zeros(np.count_nonzero(is_edge), np.uint8)
            yield channel, channel, t[is_edge], kind[is_edge] != FALLING


def imu_packets(
    about: Aedat4File, restarts: list[tuple[int, int]]
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of the first stream of IMU samples."""
    number = about.first("IMUS")
    clock = OtherClock(restarts)
    # Time, acceleration x, y, z and angular velocity x, y, z.
    fields = {0: "<i8", **dict.fromkeys(range(2, 8), "<f4")}
    with contextlib.closing(read_batches(about, "IMUS")) as batches:
        for batch in batches:
            contents = [content for content in batch.contents if content.stream == number]
            found = tables_of([content.data for content in contents], fields)
            t = clock.shift_all(contents, found)
            values = [value.astype(np.float64) for value in found.values[1:]]
            acceleration = [value * GRAVITY for value in values[:3]]
            velocity = [np.radians(value) for value in values[3:]]
            yield t, *velocity, *acceleration


class Frame(NamedTuple):
    """A grey frame."""

    t: int
    """Middle of the exposure [us]."""
    width: int
    height: int
    depth: int
    """Bytes per pixel."""
    pixels: NDArray[np.uint8]
    """Bytes of the pixels."""


def _frames(about: Aedat4File, restarts: list[tuple[int, int]]) -> Iterator[Frame]:
    """Yield the frames of the first stream of frames. Raises :class:`AmiwarpError` if they are in colour."""
    number = about.first("FRME")
    clock = OtherClock(restarts)
    with contextlib.closing(read_batches(about, "FRME")) as batches:
        for batch in batches:
            for content in batch.contents:
                if content.stream != number:
                    continue
                data = content.data
                try:
                    root = root_of(data)
                    t = field_of(data, root, 0, I8)
                    kind = field_of(data, root, 5, I1)
                    width = field_of(data, root, 6, I2)
                    height = field_of(data, root, 7, I2)
                    start, size = vector_of(data, root, 10, 1)
                except DAMAGE:
                    continue
                if kind not in GREY_BYTES:
                    raise AmiwarpError(
                        f"the frames are in colour (format {kind} of OpenCV), not grey",
                        ErrorCode.FORMAT_UNKNOWN,
                    )
                depth = GREY_BYTES[kind]
                if min(width, height) > 0 and size == width * height * depth:
                    pixels = np.frombuffer(data, np.uint8, size, start)
                    yield Frame(t + clock.shift(t, content.at), width, height, depth, pixels)


def frame_heads(
    about: Aedat4File, restarts: list[tuple[int, int]]
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], width, height and bytes per pixel of each frame."""
    for frame in _frames(about, restarts):
        yield tuple(np.array([value], np.int64) for value in frame[:4])


def frame_images(
    about: Aedat4File, restarts: list[tuple[int, int]]
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the bytes of each frame."""
    for frame in _frames(about, restarts):
        yield (frame.pixels,)
