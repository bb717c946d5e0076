"""Reader of IMU samples and frames of AEDAT 4.0 files, with faery. Runs in the reading process.

The file's units are g and degrees per second.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.sensor_streams import GRAVITY


def read_imu(notes: dict[str, int], path: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of the first stream of IMU samples."""
    for samples in _packets(path, "imus"):
        turning = (np.radians(samples[f"gyroscope_{axis}"].astype(np.float64)) for axis in "xyz")
        pulling = (samples[f"accelerometer_{axis}"].astype(np.float64) * GRAVITY for axis in "xyz")
        yield samples["t"].astype(np.int64), *turning, *pulling


def read_heads(notes: dict[str, int], path: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], width, height and bytes per pixel of each frame. The time is the middle of the exposure."""
    for frame in _packets(path, "frame"):
        if frame.format != "L" or frame.pixels.ndim != 2:
            raise AmiwarpError(f"the frames are in colour ('{frame.format}'), not grey")
        height, width = frame.pixels.shape
        yield tuple(np.array([value], np.int64) for value in (frame.t, width, height, frame.pixels.itemsize))


def read_images(notes: dict[str, int], path: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the bytes of each frame."""
    for frame in _packets(path, "frame"):
        yield (np.ascontiguousarray(frame.pixels).reshape(-1).view(np.uint8),)


def _packets(path: str, kind: str) -> Iterator[Any]:
    """Yield the packets of the first stream of a type."""
    from faery.extension import aedat

    with aedat.Decoder(path) as decoder:
        number = next((track.id for track in decoder.tracks() if track.data_type == kind), None)
        for track, packet in decoder:
            if track.id == number:
                yield packet
