"""Records of other sensors in a recording: samples of an inertial measurement unit (IMU), frames and depth maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.stores import Instants, StoredInstants
from amiwarp.schema.calls import guarded
from amiwarp.schema.type_names import not_called

LARGEST_ROTATION_ERROR = 1e-3
"""Largest deviation of a rotation matrix times its transpose from the identity."""

DEPTH_DTYPE = np.dtype(np.float32)
"""Data type of depth maps."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """Samples of an inertial measurement unit (IMU), in order of time.

    The axes are the IMU's own, as the file stores them. The acceleration includes gravity. A quantity that a sample
    does not hold is NaN on all three axes.

    Raises
    ------
    AmiwarpError
        If the arrays have other shapes or data types, the times decrease, or a value is not finite, except as above.

    Examples
    --------
    >>> import numpy as np
    >>> still = np.zeros((2, 3))
    >>> imu = amiwarp.ImuSamples(np.array([0, 1000]), angular_velocity=still, acceleration=still + [0.0, 0.0, 9.81])
    >>> len(imu), imu.rate_hz
    (2, 1000.0)
    """

    t: NDArray[np.int64]
    """Times of the samples, on the clock of the events [us], shape ``(n,)``. They do not decrease."""
    angular_velocity: NDArray[np.float64]
    """Angular velocity around the axes x, y and z [rad/s], shape ``(n, 3)``."""
    acceleration: NDArray[np.float64]
    """Acceleration along the axes x, y and z [m/s^2], shape ``(n, 3)``."""
    to_camera: NDArray[np.float64] | None = None
    """Rotation matrix from the axes of the IMU to the axes of :class:`amiwarp.Camera`, shape ``(3, 3)``, or None if it
    is unknown. Its rows are the camera's x, y and z axes in the IMU's frame."""

    def __post_init__(self) -> None:
        self._check_rotation()
        if self.t.dtype != np.int64 or self.t.ndim != 1:
            raise AmiwarpError(
                f"IMU times are {self.t.dtype} of shape {self.t.shape}; give int64 of shape (n,)"
            )
        for name in ("angular_velocity", "acceleration"):
            values = getattr(self, name)
            shape = (len(self.t), 3)
            if values.dtype != np.float64 or values.shape != shape:
                raise AmiwarpError(
                    f"IMU {name} is {values.dtype} of shape {values.shape}; give float64 of shape {shape}"
                )
            bad = ~(np.isfinite(values).all(axis=1) | np.isnan(values).all(axis=1))
            if bad.any():
                first_bad = int(np.argmax(bad))
                raise AmiwarpError(
                    f"IMU {name} of sample {first_bad} is {values[first_bad].tolist()}; expected finite numbers, "
                    "or three NaN for a "
                    "quantity that the sample does not hold"
                )
        if (self.t[1:] < self.t[:-1]).any():
            raise AmiwarpError("IMU times decrease; give the samples in order of time")

    def _check_rotation(self) -> None:
        """Raise :class:`AmiwarpError` if ``to_camera`` is no rotation matrix."""
        matrix = self.to_camera
        if matrix is None:
            return
        if matrix.dtype != np.float64 or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise AmiwarpError(
                f"IMU to_camera is {matrix.dtype} of shape {matrix.shape}; give finite float64 of shape (3, 3)"
            )
        off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        if off > LARGEST_ROTATION_ERROR or np.linalg.det(matrix) < 0.0:
            raise AmiwarpError(
                f"IMU to_camera = {matrix.tolist()} is no rotation: its rows must be at right angles, of length 1 and "
                "right-handed; check the signs of the axes"
            )

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        if not len(self):
            return "ImuSamples(0 samples)"
        samples = "sample" if len(self) == 1 else "samples"
        rate = "" if self.rate_hz is None else f", {self.rate_hz:.4g} Hz"
        return f"ImuSamples({len(self):,} {samples}, t {self.t[0]} .. {self.t[-1]} us{rate})"

    @property
    def rate_hz(self) -> float | None:
        """Mean rate of the samples [Hz], or None if they span no time."""
        return mean_rate(self.t)


def mean_rate(t: NDArray[np.int64]) -> float | None:
    """Return the mean rate of records at ordered times ``t`` [us], in Hz, or None if they span no time."""
    if not len(t):
        return None
    span = int(t[-1]) - int(t[0])
    if span <= 0:
        return None
    return (len(t) - 1) * 1e6 / span


@not_called("wrap frames as amiwarp.MemoryImages(t, images)")
class ImageStore(StoredInstants[NDArray[Any]], Protocol):
    """Protocol of the frames or depth maps of a recording, in order of time.

    A frame has grey levels of shape ``(height, width)``, or RGB colours of shape ``(height, width, 3)``, as uint8 or
    uint16. A depth map is float32 of shape ``(height, width)``: metres along the camera's axis, infinite for the sky,
    and NaN if the depth is unknown. All have the same shape and data type.
    """

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px]."""

    @property
    def exposure(self) -> NDArray[np.int64] | None:
        """Begin and end of each exposure, of the middle row of a rolling shutter [us], shape ``(k, 2)``, or None."""


@guarded
class MemoryImages(Instants[NDArray[Any]]):
    """Frames or depth maps of a recording that are held in memory.

    Parameters
    ----------
    t : numpy.ndarray
        Times of the frames [us], int64, not decreasing, shape ``(k,)``: the middles of the exposures.
    images : sequence of numpy.ndarray
        At least one frame. Grey levels of shape ``(height, width)`` or RGB colours of shape ``(height, width, 3)`` are
        uint8 or uint16. Depth maps [m] are float32 of shape ``(height, width)``.
    exposure : numpy.ndarray, optional
        Begin and end of each exposure [us], int64, shape ``(k, 2)``.

    Raises
    ------
    AmiwarpError
        If the arrays have other shapes or data types, the times decrease, or an exposure does not hold its time.

    Examples
    --------
    >>> import numpy as np
    >>> frames = amiwarp.MemoryImages(np.array([0, 40_000]), np.zeros((2, 3, 4), np.uint8))
    >>> frames.size, len(frames), frames[-1].shape, frames[1:].t.tolist()
    ((4, 3), 2, (3, 4), [40000])
    """

    def __init__(
        self,
        t: NDArray[np.int64],
        images: Sequence[NDArray[Any]] | NDArray[Any],
        exposure: NDArray[np.int64] | None = None,
    ) -> None:
        if isinstance(images, np.ndarray) and not images.ndim:
            images = []
        fit = t.dtype == np.int64 and t.shape == (len(images),) and len(t) > 0
        if not fit or (t[1:] < t[:-1]).any():
            raise AmiwarpError(
                f"frames have {t.dtype} times of shape {t.shape} for {len(images)} images; give ordered int64 times, "
                "one per image, and at least one"
            )
        first = images[0]
        for image in images:
            check_frame(image, first.shape, first.dtype)
        if exposure is not None:
            check_exposure(exposure, t)
        super().__init__(t)
        self._images = images
        self.exposure = exposure
        """Begin and end of each exposure [us], shape ``(k, 2)``, or None."""

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px]."""
        height, width = self._images[0].shape[:2]
        return width, height

    def _read(self, index: int) -> NDArray[Any]:
        return self._images[index]


def check_frame(image: NDArray[Any], shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Raise :class:`AmiwarpError` for neither an image nor a depth map, or for another shape or data type."""
    if image.dtype == DEPTH_DTYPE:
        check_depth(image, shape)
    else:
        check_image(image, shape, dtype)


def check_image(image: NDArray[Any], shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Raise :class:`AmiwarpError` for no grey or colour image, or not of the given shape and data type."""
    has_shape = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if not has_shape or not image.size or image.dtype not in (np.uint8, np.uint16):
        raise AmiwarpError(
            f"frame is {image.dtype} of shape {image.shape}; give uint8 or uint16 of shape (height, width), or "
            "(height, width, 3) for RGB"
        )
    if image.shape != shape or image.dtype != dtype:
        raise AmiwarpError(
            f"frame is {image.dtype} of shape {image.shape}, earlier ones are {dtype} of {shape}"
        )


def check_depth(depth: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Raise :class:`AmiwarpError` for an array that is no depth map, or not of the given shape."""
    if depth.ndim != 2 or not depth.size or depth.dtype != DEPTH_DTYPE:
        raise AmiwarpError(
            f"depth is {depth.dtype} of shape {depth.shape}; give float32 [m] of shape (height, width)"
        )
    if depth.shape != shape:
        raise AmiwarpError(f"depth has shape {depth.shape}; expected {shape}")
    if (depth <= 0.0).any():
        raise AmiwarpError(
            "depth holds a value that is not above 0 m; give infinity for the sky, and NaN for unknown"
        )


def check_exposure(exposure: NDArray[Any], t: NDArray[np.int64]) -> None:
    """Raise :class:`AmiwarpError` if exposures [us] are no pairs of times around the times ``t`` of their frames."""
    if exposure.dtype != np.int64 or exposure.shape != (len(t), 2):
        raise AmiwarpError(
            f"exposures are {exposure.dtype} of shape {exposure.shape}; give int64 [us] of shape {(len(t), 2)}"
        )
    outside = (exposure[:, 0] > t) | (exposure[:, 1] < t)
    if outside.any():
        first = int(np.argmax(outside))
        begin, end = exposure[first].tolist()
        raise AmiwarpError(
            f"exposure {first} from {begin} to {end} us does not hold the time of its frame, {t[first]} us; "
            "a frame's time is the middle of its exposure"
        )
