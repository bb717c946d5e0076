"""Methods of the writer of native recordings that append anything other than events."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.sensors import ImuSamples
from amiwarp.events.truth import FrameTruth, Poses
from amiwarp.io.chunks import Codec
from amiwarp.io.input_files import errors_name
from amiwarp.io.sensor_writer import SensorWriter
from amiwarp.io.truth_writer import TruthWriter


class RecordAppender:
    """Base of :class:`amiwarp.RecordingWriter`: appends ground truth, IMU samples and frames."""

    path: Path
    _chunks: Any = None
    _truth: TruthWriter | None = None
    _sensors: SensorWriter | None = None

    def append_frame(self, frame: FrameTruth) -> None:
        """Append the ground truth of an instant.

        Parameters
        ----------
        frame : FrameTruth
            Ground truth of all pixels, at a later time than the frame before.
        """
        with self._appending(lambda: f"truth of the instant {frame.t_us} us"):
            self._open_truth().append_frame(frame)

    def append_known(self, t_us: int, mask: NDArray[np.bool_]) -> None:
        """Append a mask of the pixels whose scene is known.

        Parameters
        ----------
        t_us : int
            Time from which the mask holds [us], later than that of the mask before.
        mask : numpy.ndarray
            Whether the scene at each pixel without the prism is known, shape ``(height, width)``.
        """
        with self._appending(lambda: f"mask at {t_us} us"):
            self._open_truth().append_known(t_us, mask)

    def append_poses(self, poses: Poses) -> None:
        """Append true poses of camera, bodies and joints.

        Parameters
        ----------
        poses : Poses
            Poses at later times than those before.
        """
        with self._appending(lambda: "true poses"):
            self._open_truth().append_poses(poses)

    def append_imu(self, samples: ImuSamples) -> None:
        """Append samples of an inertial measurement unit.

        Parameters
        ----------
        samples : ImuSamples
            Samples, not earlier than those before.
        """
        with self._appending(lambda: "IMU samples"):
            self._open_sensors().append_imu(samples)

    def append_image(self, t_us: int, image: NDArray[Any]) -> None:
        """Append a frame.

        Parameters
        ----------
        t_us : int
            Time of the frame [us], not earlier than that of the frame before.
        image : numpy.ndarray
            Grey levels, uint8 or uint16, shape ``(height, width)``, as those of the frames before.
        """
        with self._appending(lambda: f"frame at {t_us} us"):
            self._open_sensors().append_image(t_us, image)

    @contextlib.contextmanager
    def _appending(self, place: Callable[[], str]) -> Iterator[None]:
        """Name the file and the place in errors, and raise the error of a full disk."""
        with errors_name(self.path, place):
            yield
            if self._chunks is not None:
                self._chunks.check()

    def _open_records(self, file: Any, size: tuple[int, int], codec: Codec) -> None:
        """Set up the writers of an open file. ``size``: width and height of the sensor [px]."""
        self._truth = TruthWriter(file, self.path, size, codec)
        self._sensors = SensorWriter(file, self.path, codec)

    def _open_truth(self) -> TruthWriter:
        if self._truth is None:
            raise AmiwarpError(f"{self.path}: append outside the writer's with block; call it inside")
        return self._truth

    def _open_sensors(self) -> SensorWriter:
        if self._sensors is None:
            raise AmiwarpError(f"{self.path}: append outside the writer's with block; call it inside")
        return self._sensors
