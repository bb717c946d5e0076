"""A recording: events with their encoder, camera, prism and, if simulated, their ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import EventSource, as_times
from amiwarp.events.sensors import ImageStore, ImuSamples
from amiwarp.events.truth import EventTruth, EventValues, FrameStore, KnownStore, PointStore, PoseStore, WorldLabels
from amiwarp.validation import array, guarded

if TYPE_CHECKING:
    from amiwarp.events.encoder import Encoder
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.prism import NominalPrism

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
    """True parameters by name: apex, phase, tilt_x, tilt_y [rad], index, clock_offset_us [us], and others."""
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
