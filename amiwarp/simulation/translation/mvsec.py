"""Pictures in the HDF5 files of MVSEC."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, input_path
from amiwarp.simulation.picture_light import linear_luminance

MVSEC_PICTURES = "davis/left/image_raw"
"""Pictures of the left camera in the HDF5 files of MVSEC; their times have the suffix ``_ts`` [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class MvsecPictures:
    """Pictures of a recording of MVSEC. Their values are proportional to the light."""

    path: Path
    """Path of the HDF5 file."""
    times_us: NDArray[np.int64]
    """Time of each picture since the first [us], shape (n,)."""
    start_us: int
    """Time of the first picture on the clock of the events [us]."""
    size: tuple[int, int]
    """Width and height of each picture [px]."""

    @property
    def interval_us(self) -> float:
        """Smallest time between pictures [us]."""
        return float(np.diff(self.times_us).min())

    @property
    def duration_us(self) -> float:
        """Time from the first picture to the last [us]."""
        return float(self.times_us[-1])

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time [us] and linear luminance, shape (height, width)."""
        import h5py

        with (
            errors_name(self.path, lambda: MVSEC_PICTURES),
            h5py.File(input_path(self.path)) as file,
        ):
            for k, t in enumerate(self.times_us.tolist()):
                pixels = np.asarray(file[MVSEC_PICTURES][k])
                yield (
                    t,
                    linear_luminance(
                        pixels.astype(np.float32) / 255.0, name=f"{self.path}: picture {k}"
                    ),
                )


def open_mvsec(path: Path) -> MvsecPictures:
    """Open the pictures of a recording of MVSEC. Raises :class:`AmiwarpError` if it has none."""
    import h5py

    with errors_name(path, lambda: "is not a file of MVSEC with pictures"):
        with h5py.File(input_path(path)) as file:
            pictures: Any = file.get(MVSEC_PICTURES)
            times: Any = file.get(f"{MVSEC_PICTURES}_ts")
            if pictures is None or times is None:
                raise AmiwarpError(
                    f"it has no {MVSEC_PICTURES}; without a data set's name, its events are translated",
                    ErrorCode.CONTENT_MISSING,
                )
            seconds = np.asarray(times, np.float64)
            shape = pictures.shape
            dtype = pictures.dtype
        if len(shape) != 3 or dtype != np.uint8 or len(seconds) != shape[0] or shape[0] < 2:
            given = f"{MVSEC_PICTURES} has shape {shape}, type {dtype} and {len(seconds)} times"
            raise AmiwarpError(
                f"{given}; expected (n, height, width), uint8, and n times, n at least 2",
                ErrorCode.FORMAT_UNKNOWN,
            )
        if not (np.isfinite(seconds).all() and np.abs(seconds).max() < 1e12):
            raise AmiwarpError(
                f"{MVSEC_PICTURES}_ts holds times that are no seconds; the file is damaged",
                ErrorCode.FILE_DAMAGED,
            )
        t = np.rint(seconds * 1e6).astype(np.int64)
        if (np.diff(t) <= 0).any():
            raise AmiwarpError(
                f"{MVSEC_PICTURES}_ts does not rise; the file is damaged", ErrorCode.FILE_DAMAGED
            )
    return MvsecPictures(path, t - t[0], int(t[0]), (shape[2], shape[1]))
