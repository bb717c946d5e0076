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

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import rounded_times
from amiwarp.events.recording import MetadataValue
from amiwarp.events.sensors import ImuSamples
from amiwarp.io.file_scan import head_limit
from amiwarp.io.input_files import errors_name
from amiwarp.io.reading_process import packets

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
            return ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
        t, *values = (np.concatenate(parts) for parts in zip(*found, strict=True))
        times = rounded_times(t)
        order = np.argsort(times, kind="stable")
        rows = np.stack(values, axis=1).astype(np.float64)[order]
        return ImuSamples(times[order], rows[:, :3].copy(), rows[:, 3:].copy())


class StreamedImages:
    """Frames of a file without an index, read on demand.

    Frames that are read in order take one pass over the file. An earlier frame starts a new pass.
    """

    def __init__(self, path: Path, heads: Packets, pixels: Callable[[], Packets]) -> None:
        """Take the time [us], width, height and bytes per pixel of each frame, and a function that starts a pass.

        Raises :class:`AmiwarpError` if the frames differ in size or data type.
        """
        self._path, self._pixels = path, pixels
        with errors_name(path, lambda: "frames"):
            found = list(heads)
            t, width, height, depth = (np.concatenate(parts) for parts in zip(*found, strict=True))
            kinds = set(zip(width.tolist(), height.tolist(), depth.tolist(), strict=True))
            if len(kinds) != 1 or (np.diff(t) < 0).any():
                raise AmiwarpError("frames differ in size or bits, or their times decrease")
        self.t = rounded_times(t)
        """Times of the frames [us], shape ``(k,)``."""
        self._size, self._dtype = (int(width[0]), int(height[0])), np.dtype(f"u{int(depth[0])}")
        self._lock = threading.Lock()
        self._pass: Generator[NDArray[Any], None, None] | None = None
        self._next = 0

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px]."""
        return self._size

    def __getitem__(self, index: int, /) -> NDArray[Any]:
        at = range(len(self.t))[index]
        with self._lock, errors_name(self._path, lambda: f"frame {index}"):
            if self._pass is None or at < self._next:
                self.close()
                self._pass = self._images()
            for image in self._pass:
                self._next += 1
                if self._next == at + 1:
                    if self._next == len(self.t):
                        self.close()
                    return image
            raise AmiwarpError("the file holds fewer frames than when it was opened; open it again")

    def close(self) -> None:
        """End the pass over the file."""
        if self._pass is not None:
            self._pass.close()
        self._pass, self._next = None, 0

    def _images(self) -> Generator[NDArray[Any], None, None]:
        """Yield all frames. Packets hold whole frames as bytes."""
        width, height = self._size
        count = width * height * self._dtype.itemsize
        running = self._pixels()
        with contextlib.closing(running) if isinstance(running, Generator) else contextlib.nullcontext():
            for (packet,) in running:
                for start in range(0, packet.size, count):
                    yield packet[start : start + count].view(self._dtype).reshape(height, width)


def read_sensors(
    path: Path, counts: Mapping[str, MetadataValue], module: str, *arguments: Any
) -> tuple[ImuSamples | None, StreamedImages | None, dict[str, MetadataValue]]:
    """Return the IMU samples and frames that were counted, and for those that cannot be read a note that says why.

    ``module`` has the functions ``read_imu``, ``read_heads`` and ``read_images``, which run in the reading process and
    get the absolute path and ``arguments``.
    """
    notes: dict[str, MetadataValue] = {}
    if head_limit() is not None:
        return None, None, notes

    def start(function: str) -> Packets:
        return packets(f"amiwarp.io.{module}:{function}", path.absolute(), *arguments, {})

    imu = frames = None
    if counts.get("imu_samples"):
        imu = _if_readable(path, "imu", lambda: imu_of(path, start("read_imu")), notes)
    if counts.get("frames"):
        images = partial(start, "read_images")
        frames = _if_readable(path, "frames", lambda: StreamedImages(path, start("read_heads"), images), notes)
    return imu, frames, notes


def only_counted(counts: Mapping[str, MetadataValue], *names: str) -> dict[str, MetadataValue]:
    """Return notes that the records ``imu_samples`` or ``frames`` are not read, for those that were counted."""
    return {
        f"{name.partition('_')[0]}_note": "only counted: amiwarp does not read them from this format"
        for name in names
        if counts.get(name)
    }


def _if_readable(path: Path, name: str, read: Callable[[], Kept], notes: dict[str, MetadataValue]) -> Kept | None:
    """Return what a function reads; None if it raises :class:`AmiwarpError`, which is then noted."""
    try:
        return read()
    except AmiwarpError as error:
        why = str(error).removeprefix(f"{path}: ").partition(": ")[2]
        notes[f"{name}_note"] = f"only counted: {why or error}"
        return None
