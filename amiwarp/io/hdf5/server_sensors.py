"""IMU samples and frames in MVSEC's HDF5 files. Runs in the reading process.

A row of ``imu`` has the acceleration x, y, z [m/s^2] and the angular velocity x, y, z [rad/s], as the data set's
converter writes it. Times are in seconds.
"""

from collections.abc import Iterator
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.event_packets import microseconds
from amiwarp.io.hdf5.server_datasets import check_stored
from amiwarp.io.hdf5.server_objects import is_dataset, member
from amiwarp.io.hdf5.server_rows import PIECE


def read_imu(notes: dict[str, int], path: str, group: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of all samples."""
    with h5py.File(path, "r") as file:
        times, rows = _pair(file, path, f"{group}/imu")
        if rows.shape[1:] != (6,) or rows.dtype.kind not in "fiu":
            raise AmiwarpError(
                f"dataset '{group}/imu' is {rows.dtype} of shape {rows.shape}; expected six columns",
                ErrorCode.FORMAT_UNKNOWN,
            )
        for start in range(0, len(times), PIECE):
            piece = slice(start, start + PIECE)
            values = rows[piece].astype(np.float64)
            acceleration = values[:, :3]
            angular_velocity = values[:, 3:]
            t = microseconds(times[piece])
            yield t, *angular_velocity.T, *acceleration.T


def read_heads(notes: dict[str, int], path: str, group: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], width, height and bytes per pixel of each frame."""
    with h5py.File(path, "r") as file:
        times, images = _pair(file, path, f"{group}/image_raw")
        is_stack = images.ndim == 3 and all(images.shape)
        if not is_stack or images.dtype not in (np.uint8, np.uint16):
            raise AmiwarpError(
                f"dataset '{group}/image_raw' is {images.dtype} of shape {images.shape}; expected uint8 or uint16 of "
                "shape (frames, height, width)",
                ErrorCode.FORMAT_UNKNOWN,
            )
        count, height, width = images.shape
        yield (
            microseconds(times[()]),
            np.full(count, width),
            np.full(count, height),
            np.full(count, images.dtype.itemsize),
        )


def read_images(notes: dict[str, int], path: str, group: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the bytes of each frame."""
    with h5py.File(path, "r") as file:
        count = len(member(file, f"{group}/image_raw_ts"))
        images = member(file, f"{group}/image_raw")
        for index in range(count):
            stored = np.ascontiguousarray(images[index])
            native = stored.dtype.newbyteorder("=")
            image = stored.astype(native, copy=False)
            yield (image.reshape(-1).view(np.uint8),)


def _pair(file: Any, path: str, name: str) -> tuple[Any, Any]:
    """Return the datasets of the times and of the values, after checking that the file holds all of both."""
    times = member(file, f"{name}_ts")
    values = member(file, name)
    _check_dataset(times, f"{name}_ts", path)
    _check_dataset(values, name, path)
    if times.shape != values.shape[:1] or times.dtype.kind not in "fiu":
        raise AmiwarpError(
            f"dataset '{name}_ts' is {times.dtype} of shape {times.shape} for {values.shape[0]} rows",
            ErrorCode.FORMAT_UNKNOWN,
        )
    return times, values


def _check_dataset(dataset: Any, name: str, path: str) -> None:
    """Raise :class:`AmiwarpError` if a member of a file is no dataset, or not all of it is stored."""
    if not is_dataset(dataset):
        raise AmiwarpError(f"no dataset '{name}'", ErrorCode.CONTENT_MISSING)
    check_stored(dataset, name, path)
