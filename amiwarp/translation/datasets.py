"""Data sets that are translated by name: N-Caltech101 and MVSEC."""

import enum
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.files import errors_name, input_path
from amiwarp.optics.camera import Camera
from amiwarp.simulation.motion import CameraMotion
from amiwarp.simulation.pictures import linear_luminance

SACCADES_PX = ((3.5, 7.0), (3.5, -7.0), (-7.0, 0.0))
"""Motion of the image in the three saccades of N-Caltech101 and N-MNIST, x and y [px]."""
SACCADE_US = 105_000
"""Length of a saccade [us]."""
TURN_US = 1_000
"""Time in which the camera changes from one saccade to the next [us]."""
MVSEC_PICTURES = "davis/left/image_raw"
"""Pictures of the left camera in the HDF5 files of MVSEC; their times have the suffix ``_ts`` [s]."""


class DataSet(enum.StrEnum):
    """Data sets whose motion, or whose file layout, is known.

    Examples
    --------
    >>> amiwarp.DataSet("mvsec").name
    'MVSEC'
    """

    N_CALTECH101 = "n-caltech101"
    """Pictures of Caltech101, or recordings of N-Caltech101 or N-MNIST: three saccades in front of a picture.

    G. Orchard et al., "Converting Static Image Datasets to Spiking Neuromorphic Datasets Using Saccades", Frontiers in
    Neuroscience 9 (2015).
    """
    MVSEC = "mvsec"
    """HDF5 files with pictures and events of the left camera.

    A. Zhu et al., "The Multivehicle Stereo Event Camera Dataset", IEEE Robotics and Automation Letters 3 (2018).
    """


def saccade_rates(camera: Camera) -> list[tuple[float, float, float]]:
    """Return the angular velocity of the camera in each saccade [rad/s], for which the image moves as it should."""
    # a rotation about x moves the image along y, one about y along -x
    seconds = SACCADE_US * 1e-6
    return [(dy / camera.fy / seconds, -dx / camera.fx / seconds, 0.0) for dx, dy in SACCADES_PX]


def saccades(camera: Camera) -> CameraMotion:
    """Return the rotation of the camera in the three saccades, at constant speeds."""
    rows = []
    for k, rates in enumerate(saccade_rates(camera)):
        start, stop = k * SACCADE_US + TURN_US / 2, (k + 1) * SACCADE_US - TURN_US / 2
        rows += [(start * 1e-6, *rates), (stop * 1e-6, *rates)]
    return CameraMotion(np.array(rows))


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

        with errors_name(self.path, lambda: MVSEC_PICTURES), h5py.File(input_path(self.path)) as file:
            for k, t in enumerate(self.times_us.tolist()):
                pixels = np.asarray(file[MVSEC_PICTURES][k])
                yield t, linear_luminance(pixels.astype(np.float32) / 255.0, name=f"{self.path}: picture {k}")


def open_mvsec(path: Path) -> MvsecPictures:
    """Open the pictures of a recording of MVSEC. Raises :class:`AmiwarpError` if it has none."""
    import h5py

    with errors_name(path, lambda: "is not a file of MVSEC with pictures"):
        with h5py.File(input_path(path)) as file:
            pictures: Any = file.get(MVSEC_PICTURES)
            times: Any = file.get(f"{MVSEC_PICTURES}_ts")
            if pictures is None or times is None:
                raise AmiwarpError(f"it has no {MVSEC_PICTURES}; without a data set's name, its events are translated")
            seconds, shape, dtype = np.asarray(times, np.float64), pictures.shape, pictures.dtype
        if len(shape) != 3 or dtype != np.uint8 or len(seconds) != shape[0] or shape[0] < 2:
            given = f"{MVSEC_PICTURES} has shape {shape}, type {dtype} and {len(seconds)} times"
            raise AmiwarpError(f"{given}; expected (n, height, width), uint8, and n times, n at least 2")
        if not (np.isfinite(seconds).all() and np.abs(seconds).max() < 1e12):
            raise AmiwarpError(f"{MVSEC_PICTURES}_ts holds times that are no seconds; the file is damaged")
        t = np.rint(seconds * 1e6).astype(np.int64)
        if (np.diff(t) <= 0).any():
            raise AmiwarpError(f"{MVSEC_PICTURES}_ts does not rise; the file is damaged")
    return MvsecPictures(path, t - t[0], int(t[0]), (shape[2], shape[1]))
