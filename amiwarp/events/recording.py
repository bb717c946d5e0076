"""A recording: events with their encoder, camera, prism, the records of other sensors and, if simulated, the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import EventSource, as_times
from amiwarp.events.truth import (
    EventTruth,
    EventValues,
    FrameStore,
    KnownStore,
    PointStore,
    PoseStore,
    StoredInstants,
    WorldLabels,
)
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism
from amiwarp.validation import array, guarded

# Records of other sensors in a recording: samples of an inertial measurement unit (IMU), and frames.


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


# A recording: events with their encoder, camera, prism and, if simulated, their ground truth.

MetadataValue: TypeAlias = str | int | float | bool
"""Type of a value in a recording's metadata."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Ground truth of a simulated recording.

    Examples
    --------
    >>> import numpy as np
    >>> truth = amiwarp.Truth({"apex": 0.03, "phase": 0.5}, stored_causes=np.array([0, 1, 0], np.uint8))
    >>> truth.points(0, 10) is None
    True
    >>> truth.of_events(1, 3).cause.tolist()
    [1, 0]
    """

    parameters: dict[str, float] = field(default_factory=dict)
    """True parameters by name: apex, phase, tilt, cylinder and wobble in x and y (such as tilt_x) [rad], index,
    clock_offset_us [us], and others."""
    stored_points: PointStore | None = None
    """Pixel without the prism of each event's scene point [px], shape ``(n, 2)``, float32, or None."""
    stored_causes: EventValues | None = None
    """Code of the cause of each event, see :class:`amiwarp.Cause`, shape ``(n,)``, uint8, or None."""
    stored_instances: EventValues | None = None
    """Instance number of the surface that each event saw, shape ``(n,)``, uint16, or None."""
    stored_depths: EventValues | None = None
    """Depth of the surface that each event saw [m], shape ``(n,)``, float32, or None."""
    stored_places: EventValues | None = None
    """Point in the world that each event saw [m], shape ``(n, 3)``, float32, or None."""
    labels: WorldLabels | None = None
    """Names of the world's instances and their classes, or None."""
    frames: FrameStore | None = None
    """Ground truth of all pixels at chosen instants, or None."""
    poses: PoseStore | None = None
    """Poses of the camera, the moving bodies and the joints over time, or None."""
    known: KnownStore | None = None
    """Pixels without the prism whose scene the source of a translated recording determines, over time; None for all."""

    def points(self, start: int, stop: int) -> NDArray[np.float32] | None:
        """Return the true points of the events with ``start <= index < stop``.

        Parameters
        ----------
        start, stop : int
            First index, and index after the last.

        Returns
        -------
        numpy.ndarray or None
            Pixels without the prism [px], shape (n, 2), or None if they are not stored.
        """
        return None if self.stored_points is None else self.stored_points[max(start, 0) : max(stop, 0)]

    def known_at(self, t_us: ArrayLike, xy: ArrayLike) -> NDArray[np.bool_]:
        """Return whether the scene is known at pixels without the prism.

        The times and :meth:`points` of events tell which events the source of a translated recording determines.

        Parameters
        ----------
        t_us : array_like
            Times [us], shape ``(n,)``.
        xy : array_like
            Pixels without the prism [px], shape ``(n, 2)``.

        Returns
        -------
        numpy.ndarray
            Whether each pixel is known at its time, shape ``(n,)``. Pixels outside the image, NaN and times before the
            first mask are unknown. Everything is known if no masks are stored.
        """
        times, pixels = as_times(t_us), array(xy, "xy").astype(np.float64)
        if times.ndim != 1 or pixels.shape != (len(times), 2):
            raise AmiwarpError(f"t_us has shape {times.shape}, xy {pixels.shape}; expected (n,) and (n, 2)")
        if self.known is None:
            return np.ones(len(times), np.bool_)
        row = np.searchsorted(self.known.t, times, side="right") - 1
        found = np.zeros(len(times), np.bool_)
        for index in np.unique(row[row >= 0]).tolist():
            mask, which = self.known[index], np.flatnonzero(row == index)
            inside = np.isfinite(pixels[which].sum(axis=1))
            x, y = np.rint(np.where(inside[:, None], pixels[which], -1.0)).astype(np.int64).T
            inside &= (x >= 0) & (x < mask.shape[1]) & (y >= 0) & (y < mask.shape[0])
            found[which[inside]] = mask[y[inside], x[inside]]
        return found

    def of_events(self, start: int, stop: int) -> EventTruth:
        """Return all ground truth of the events with ``start <= index < stop``.

        Parameters
        ----------
        start, stop : int
            First index, and index after the last, as in the ``slice`` method of event sources.

        Returns
        -------
        EventTruth
            The arrays that are stored, with one row per event.
        """
        which = slice(max(start, 0), max(stop, 0))
        stores = self.stored_causes, self.stored_instances, self.stored_depths, self.stored_places
        return EventTruth(self.points(start, stop), *(None if store is None else store[which] for store in stores))


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Events with the encoder, camera and prism that recorded them.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4), name="example")
    >>> len(recording.events), recording.camera
    (2, None)
    """

    events: EventSource
    """Events of the recording, in order of time."""
    camera: Camera | None = None
    """Camera intrinsics, or None if unknown."""
    encoder: Encoder | None = None
    """Encoder, which gives the prism angle over time, or None if there is none."""
    prism: NominalPrism | None = None
    """The nominal prism of the data sheet, not the calibrated one, or None if unknown. Its apex may be unknown."""
    truth: Truth | None = None
    """Ground truth of a synthetic recording, else None."""
    metadata: dict[str, MetadataValue] = field(default_factory=dict)
    """Other information by name, such as the file format, repairs made while reading, and the simulator's seed."""
    name: str = "recording"
    """Short name of the recording in messages and titles: the file name without its extension."""
    imu: ImuSamples | None = None
    """Samples of the camera's inertial measurement unit, or None."""
    frames: ImageStore | None = None
    """Frames that the camera recorded with the events, read on demand, or None."""
