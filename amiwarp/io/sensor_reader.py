"""Reader of the IMU samples and frames of native recordings. Frames are read on demand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import rounded_times
from amiwarp.events.sensors import ImuSamples
from amiwarp.io.hdf5 import Column, Hdf5File
from amiwarp.io.input_files import errors_name


def read_imu(path: Path, file: Hdf5File) -> ImuSamples | None:
    """Return the IMU samples of a file, or None if it has none."""
    if "imu/t" not in file.columns:
        return None
    with errors_name(path, lambda: "imu"):
        count = len(file.columns["imu/t"])
        values = [_rows(file, f"imu/{name}", count, (3,)) for name in ("angular_velocity", "acceleration")]
        t = rounded_times(file.columns["imu/t"].read(0, count))
        return ImuSamples(t, *(column.read(0, count).astype(np.float64, copy=False) for column in values))


def _rows(file: Hdf5File, name: str, count: int, row: tuple[int, ...] | None) -> Column:
    """Return a dataset of ``count`` rows of the shape ``row``, or of any shape if it is None."""
    if name not in file.columns:
        raise AmiwarpError(f"dataset '{name}' is missing; the file is incomplete")
    column = file.columns[name]
    if len(column) != count or column.row != (row or column.row):
        shape = (len(column), *column.row)
        raise AmiwarpError(f"dataset '{name}' has shape {shape}, its times are {count}; the file is damaged")
    return column


def read_frames(path: Path, file: Hdf5File) -> StoredImages | None:
    """Return the frames of a file, or None if it has none."""
    if "frames/t" not in file.columns:
        return None
    with errors_name(path, lambda: "frames"):
        return StoredImages(path, file)


class StoredImages:
    """Frames of a native recording, read on demand."""

    def __init__(self, path: Path, file: Hdf5File) -> None:
        self._path, self._file = path, file  # the columns hold only a weak reference to the file
        times = file.columns["frames/t"]
        self._image = _rows(file, "frames/image", len(times), None)
        if self._image.dtype not in (np.uint8, np.uint16) or not all(self._image.row):
            raise AmiwarpError(f"frames are {self._image.dtype} of shape {self._image.row}; expected uint8 or uint16")
        self.t = rounded_times(times.read(0, len(times)))
        """Times of the frames [us], shape ``(k,)``."""
        if (self.t[1:] < self.t[:-1]).any():
            raise AmiwarpError("frames/t decreases; the file is damaged")

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px]."""
        height, width = self._image.row
        return width, height

    def __getitem__(self, index: int, /) -> NDArray[Any]:
        at = range(len(self.t))[index]
        with errors_name(self._path, lambda: f"frames {index}"):
            return self._image.read(at, at + 1)[0]
