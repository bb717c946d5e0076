"""Writer of the IMU samples and frames of a native recording.

``docs/reference/recording-format.md`` describes the format.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.sensors import ImuSamples, check_image
from amiwarp.io.row_writer import ROWS, RowWriter


class SensorWriter(RowWriter):
    """Writer of IMU samples and frames into an open HDF5 file."""

    def append_imu(self, samples: ImuSamples) -> None:
        """Append samples, which must not be earlier than those before."""
        if len(samples):
            self._check_later("imu/t", int(samples.t[0]), equal=True)
        for name in ("t", "angular_velocity", "acceleration"):
            self._append(f"imu/{name}", getattr(samples, name), ROWS)

    def append_image(self, t_us: int, image: NDArray[Any]) -> None:
        """Append a frame, which must not be earlier than the frame before."""
        stored = self._datasets.get("frames/image")
        shape, dtype = (image.shape, image.dtype) if stored is None else (stored.shape[1:], stored.dtype)
        try:
            check_image(image, shape, dtype)
        except AmiwarpError as error:
            raise AmiwarpError(f"{self._path}: {error}") from error
        self._check_later("frames/t", t_us, equal=True)
        self._append("frames/t", np.array([t_us], np.int64), ROWS)
        self._append("frames/image", image[None], 1)
