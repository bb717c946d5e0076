"""IMU samples and frames of files that are read only from their start.

They are read after the events, and only if the file is read completely: of the first part of a large file, which
``amiwarp info`` reads, they are only counted.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.other_sensors import ImuSamples
from amiwarp.events.recording import MetadataValue
from amiwarp.events.stores import Instants
from amiwarp.io.inputs import errors_name
from amiwarp.io.opening import head_limit
from amiwarp.io.reading_process import packets
from amiwarp.validation import rounded_times

GRAVITY = 9.80665
"""Standard gravity [m/s^2], the unit g of acceleration."""

Packets = Iterator[tuple[NDArray[Any], ...]]
"""Packets of arrays from the reading process."""

Kept = TypeVar("Kept")


def imu_of(path: Path, columns: Packets) -> ImuSamples:
    """Return the samples in packets of seven columns, ordered by time.

    The columns hold the time [us], the angular velocity around x, y, z [rad/s] and the acceleration along x, y, z
    [m/s^2].
    """
    with errors_name(path, lambda: "IMU samples"):
        found = list(columns)
        if not found:
            nothing = np.zeros((0, 3))
            return ImuSamples(np.zeros(0, np.int64), nothing, nothing.copy())
        t, *values = (np.concatenate(parts) for parts in zip(*found, strict=True))
        times = rounded_times(t)
        order = np.argsort(times, kind="stable")
        rows = np.stack(values, axis=1).astype(np.float64)[order]
        angular_velocity = rows[:, :3].copy()
        acceleration = rows[:, 3:].copy()
        return ImuSamples(times[order], angular_velocity, acceleration)


class StreamedImages(Instants[NDArray[Any]]):
    """Frames of a file without an index, read on demand.

    Frames that are read in order take one pass over the file. An earlier frame starts a new pass.
    """

    exposure: NDArray[np.int64] | None = None
    """Exposures, which are not read from these files."""

    def __init__(
        self,
        path: Path,
        heads: Packets,
        pixels: Callable[[], Packets],
    ) -> None:
        """Take the time [us], width, height and bytes per pixel of each frame, and a function that starts a pass.

        Raises :class:`AmiwarpError` if the frames differ in size or data type.
        """
        self._path = path
        self._pixels = pixels
        with errors_name(path, lambda: "frames"):
            found = list(heads)
            columns = [np.concatenate(parts) for parts in zip(*found, strict=True)]
            t, width, height, depth = columns
            kinds = np.unique(np.stack([width, height, depth]), axis=1)
            decrease = (np.diff(t) < 0).any()
            if kinds.shape[1] != 1 or decrease:
                raise AmiwarpError(
                    "frames differ in size or bits, or their times decrease", ErrorCode.FILE_DAMAGED
                )
        super().__init__(rounded_times(t))
        self._size = (int(width[0]), int(height[0]))
        self._dtype = np.dtype(f"u{int(depth[0])}")
        self._lock = threading.Lock()
        self._pass: Generator[NDArray[Any], None, None] | None = None
        self._next = 0

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px]."""
        return self._size

    def _read(self, index: int) -> NDArray[Any]:
        with self._lock, errors_name(self._path, lambda: f"frame {index}"):
            if self._pass is None or index < self._next:
                self.close()
                self._pass = self._images()
            for image in self._pass:
                self._next += 1
                if self._next == index + 1:
                    if self._next == len(self.t):
                        self.close()
                    return image
            raise AmiwarpError(
                "the file holds fewer frames than when it was opened; open it again",
                ErrorCode.FILE_UNREADABLE,
            )

    def close(self) -> None:
        """End the pass over the file."""
        if self._pass is not None:
            self._pass.close()
        self._pass = None
        self._next = 0

    def _images(self) -> Generator[NDArray[Any], None, None]:
        """Yield all frames. Packets hold whole frames as bytes."""
        width, height = self._size
        image_bytes = width * height * self._dtype.itemsize
        packets = self._pixels()
        with contextlib.ExitStack() as ending:
            if isinstance(packets, Generator):
                ending.enter_context(contextlib.closing(packets))
            for (packet,) in packets:
                for start in range(0, packet.size, image_bytes):
                    image = packet[start : start + image_bytes]
                    yield image.view(self._dtype).reshape(height, width)


Sensors = tuple[ImuSamples | None, StreamedImages | None, dict[str, MetadataValue]]
"""IMU samples, frames, and notes about those that cannot be read."""


def sensors_of(
    path: Path,
    counts: Mapping[str, MetadataValue],
    start: Callable[[str], Packets],
) -> Sensors:
    """Return the IMU samples and frames that were counted, and notes that say why some cannot be read.

    ``start`` starts a pass over the file, with the name of what it yields: ``read_imu``, ``read_heads`` or
    ``read_images``.
    """
    notes: dict[str, MetadataValue] = {}
    imu = None
    frames = None
    if head_limit() is not None:
        return imu, frames, notes

    def read_imu() -> ImuSamples:
        return imu_of(path, start("read_imu"))

    def read_frames() -> StreamedImages:
        return StreamedImages(path, start("read_heads"), partial(start, "read_images"))

    if counts.get("imu_samples"):
        imu = _if_readable(path, "imu", read_imu, notes)
    if counts.get("frames"):
        frames = _if_readable(path, "frames", read_frames, notes)
    return imu, frames, notes


def read_sensors(
    path: Path,
    counts: Mapping[str, MetadataValue],
    module: str,
    *arguments: Any,
) -> Sensors:
    """Return what :func:`sensors_of` returns, read in the reading process.

    ``module`` is the name of the module with the functions that are started. They get the absolute path and
    ``arguments``.
    """

    def start(name: str) -> Packets:
        return packets(f"{module}:{name}", path.absolute(), *arguments, {})

    return sensors_of(path, counts, start)


def only_counted(counts: Mapping[str, MetadataValue], *names: str) -> dict[str, MetadataValue]:
    """Return notes that the records ``imu_samples`` or ``frames`` are not read, for those that were counted."""
    notes: dict[str, MetadataValue] = {}
    for name in names:
        if counts.get(name):
            kind, _, _ = name.partition("_")
            notes[f"{kind}_note"] = "only counted: amiwarp does not read them from this format"
    return notes


def _if_readable(
    path: Path,
    name: str,
    read: Callable[[], Kept],
    notes: dict[str, MetadataValue],
) -> Kept | None:
    """Return what a function reads; None if it raises :class:`AmiwarpError`, which is then noted."""
    try:
        return read()
    except AmiwarpError as error:
        _, _, why = str(error).removeprefix(f"{path}: ").partition(": ")
        notes[f"{name}_note"] = f"only counted: {why or error}"
        return None
