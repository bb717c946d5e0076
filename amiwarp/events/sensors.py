"""Records of other sensors in a recording: samples of an inertial measurement unit (IMU), and frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import StoredInstants
from amiwarp.validation import guarded


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """Samples of an inertial measurement unit (IMU), in order of time.

    The axes are those of the IMU, as the file stores them. The acceleration includes gravity. A quantity that a sample
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

    def __post_init__(self) -> None:
        if self.t.dtype != np.int64 or self.t.ndim != 1:
            raise AmiwarpError(f"IMU times are {self.t.dtype} of shape {self.t.shape}; give int64 of shape (n,)")
        for name in ("angular_velocity", "acceleration"):
            values, shape = getattr(self, name), (len(self.t), 3)
            if values.dtype != np.float64 or values.shape != shape:
                raise AmiwarpError(
                    f"IMU {name} is {values.dtype} of shape {values.shape}; give float64 of shape {shape}"
                )
            bad = ~(np.isfinite(values).all(axis=1) | np.isnan(values).all(axis=1))
            if bad.any():
                at = int(np.argmax(bad))
                raise AmiwarpError(
                    f"IMU {name} of sample {at} is {values[at].tolist()}; expected finite numbers, or three NaN for a "
                    "quantity that the sample does not hold"
                )
        if (self.t[1:] < self.t[:-1]).any():
            raise AmiwarpError("IMU times decrease; give the samples in order of time")

    def __len__(self) -> int:
        return len(self.t)

    @property
    def rate_hz(self) -> float | None:
        """Mean rate of the samples [Hz], or None if they span no time."""
        return mean_rate(self.t)


def mean_rate(t: NDArray[np.int64]) -> float | None:
    """Return the mean rate of records at ordered times ``t`` [us], in Hz, or None if they span no time."""
    span = int(t[-1]) - int(t[0]) if len(t) else 0
    return (len(t) - 1) * 1e6 / span if span > 0 else None


class ImageStore(StoredInstants[NDArray[Any]], Protocol):
    """Protocol of the frames of a recording: grey levels, uint8 or uint16, shape ``(height, width)``.

    All frames have the same size and data type. Their times do not decrease.
    """

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px]."""


@guarded
class MemoryImages:
    """Frames of a recording that are held in memory.

    Parameters
    ----------
    t : numpy.ndarray
        Times of the frames [us], int64, not decreasing, shape ``(k,)``.
    images : sequence of numpy.ndarray
        At least one frame: grey levels, uint8 or uint16, shape ``(height, width)``.

    Raises
    ------
    AmiwarpError
        If the arrays have other shapes or data types, or the times decrease.

    Examples
    --------
    >>> import numpy as np
    >>> frames = amiwarp.MemoryImages(np.array([0, 40_000]), np.zeros((2, 3, 4), np.uint8))
    >>> frames.size, frames[1].shape
    ((4, 3), (3, 4))
    """

    def __init__(self, t: NDArray[np.int64], images: Sequence[NDArray[Any]] | NDArray[Any]) -> None:
        images = [] if isinstance(images, np.ndarray) and not images.ndim else images
        if t.dtype != np.int64 or t.shape != (len(images),) or not len(t) or (t[1:] < t[:-1]).any():
            raise AmiwarpError(
                f"frames have {t.dtype} times of shape {t.shape} for {len(images)} images; give ordered int64 times, "
                "one per image, and at least one"
            )
        first = images[0]
        for image in images:
            check_image(image, first.shape, first.dtype)
        self._t, self._images = t, images

    @property
    def t(self) -> NDArray[np.int64]:
        """Times of the frames [us], shape ``(k,)``."""
        return self._t

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px]."""
        height, width = self._images[0].shape
        return width, height

    def __getitem__(self, index: int, /) -> NDArray[Any]:
        return self._images[index]


def check_image(image: NDArray[Any], shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Raise :class:`AmiwarpError` for an image that is no grey image, or not of the given shape and data type."""
    if image.ndim != 2 or not image.size or image.dtype not in (np.uint8, np.uint16):
        raise AmiwarpError(
            f"frame is {image.dtype} of shape {image.shape}; give uint8 or uint16 of shape (height, width)"
        )
    if image.shape != shape or image.dtype != dtype:
        raise AmiwarpError(f"frame is {image.dtype} of shape {image.shape}, earlier ones are {dtype} of {shape}")
