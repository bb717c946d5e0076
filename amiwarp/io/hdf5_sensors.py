"""Reader of the IMU samples and frames in MVSEC's HDF5 files. Runs in the reading process.

A row of ``imu`` has the acceleration x, y, z [m/s^2] and the angular velocity x, y, z [rad/s], as the data set's
converter writes it. Times are in seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.file_scan import microseconds
from amiwarp.io.hdf5_row_server import PIECE, check_stored, is_dataset
from amiwarp.io.hdf5_server import member


def read_imu(notes: dict[str, int], path: str, group: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of all samples."""
    with h5py.File(path, "r") as file:
        times, rows = _pair(file, path, f"{group}/imu")
        if rows.shape[1:] != (6,) or rows.dtype.kind not in "fiu":
            raise AmiwarpError(f"dataset '{group}/imu' is {rows.dtype} of shape {rows.shape}; expected six columns")
        for start in range(0, len(times), PIECE):
            values = rows[start : start + PIECE].astype(np.float64)
            yield microseconds(times[start : start + PIECE]), *values[:, 3:].T, *values[:, :3].T


def read_heads(notes: dict[str, int], path: str, group: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], width, height and bytes per pixel of each frame."""
    with h5py.File(path, "r") as file:
        times, images = _pair(file, path, f"{group}/image_raw")
        if images.ndim != 3 or not all(images.shape) or images.dtype not in (np.uint8, np.uint16):
            raise AmiwarpError(
                f"dataset '{group}/image_raw' is {images.dtype} of shape {images.shape}; expected uint8 or uint16 of "
                "shape (frames, height, width)"
            )
        count, height, width = images.shape
        yield microseconds(times[()]), *(np.full(count, value) for value in (width, height, images.dtype.itemsize))


def read_images(notes: dict[str, int], path: str, group: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the bytes of each frame."""
    with h5py.File(path, "r") as file:
        for index in range(len(member(file, f"{group}/image_raw_ts"))):
            image = np.ascontiguousarray(member(file, f"{group}/image_raw")[index])
            yield (image.astype(image.dtype.newbyteorder("="), copy=False).reshape(-1).view(np.uint8),)


def _pair(file: Any, path: str, name: str) -> tuple[Any, Any]:
    """Return the dataset of the times and that of the values, after checking that the file holds all of both."""
    times, values = member(file, f"{name}_ts"), member(file, name)
    for dataset, shown in ((times, f"{name}_ts"), (values, name)):
        if not is_dataset(dataset):
            raise AmiwarpError(f"no dataset '{shown}'")
        check_stored(dataset, shown, path)
    if times.shape != values.shape[:1] or times.dtype.kind not in "fiu":
        raise AmiwarpError(f"dataset '{name}_ts' is {times.dtype} of shape {times.shape} for {values.shape[0]} rows")
    return times, values
