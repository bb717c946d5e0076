"""Ground truth of simulated recordings: of each event, and of all pixels at given instants."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError, Option
from amiwarp.events.poses import PoseStore
from amiwarp.events.stores import Instants, StoredInstants, StoredRows
from amiwarp.schema.calls import guarded
from amiwarp.schema.type_names import not_called
from amiwarp.validation import INT64, array, as_times, check_slice, finite, instance, shown, whole


class Cause(Option):
    """Cause of a simulated event. Arrays and files hold the code of a cause: its position in this list, from 0.

    Examples
    --------
    >>> amiwarp.Cause.HOT_PIXEL.code
    3
    >>> list(amiwarp.Cause)[1].value
    'shot_noise'
    """

    SIGNAL = "signal"
    """Change of the light that reaches the contrast threshold. Code 0."""
    SHOT_NOISE = "shot_noise"
    """Shot noise of the photons. Code 1."""
    LEAK = "leak"
    """Leak: drift of the pixel's stored reference level. Code 2."""
    HOT_PIXEL = "hot_pixel"
    """Random event of a hot pixel: one of its additional ones, or of its shot noise. Code 3."""

    @property
    def code(self) -> int:
        """Number that represents the cause in arrays and files."""
        return list(Cause).index(self)


@not_called("a NumPy array with one row per event serves")
class EventValues(StoredRows[NDArray[Any]], Protocol):
    """Protocol of arrays with one row per event, shape ``(n,)`` or ``(n, k)``."""


@not_called("a NumPy array of shape (n, 2) serves")
class PointStore(StoredRows[NDArray[np.float32]], Protocol):
    """Protocol of one point per event [px], shape ``(n, 2)``, float32."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class EventTruth:
    """Ground truth of a block of events. An array is None if its values are not known.

    The surface of an event is the surface that the event's pixel saw through the prism when the light crossed the
    threshold, before the latency of the sensor. Events caused by noise have a surface too.

    Examples
    --------
    >>> import numpy as np
    >>> truth = amiwarp.EventTruth(cause=np.array([0, 3], np.uint8))
    >>> int((truth.cause == amiwarp.Cause.HOT_PIXEL.code).sum())
    1
    """

    points: NDArray[np.float32] | None = None
    """Position in the image at which each event's scene point would appear without the prism [px], shape ``(n, 2)``."""
    cause: NDArray[np.uint8] | None = None
    """Code of each event's cause, see :class:`amiwarp.Cause`, shape ``(n,)``."""
    instance: NDArray[np.uint16] | None = None
    """Instance number of each event's surface, shape ``(n,)``: 0 is the sky, i + 1 is ``WorldLabels.instances[i]``."""
    depth: NDArray[np.float32] | None = None
    """Depth of each event's surface along the optical axis [m], shape ``(n,)``; infinite for the sky."""
    place: NDArray[np.float32] | None = None
    """Point that each event saw, in the world's frame [m], shape ``(n, 3)``; NaN for the sky."""


EVENT_COLUMNS: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
    "cause": (np.uint8, ()),
    "instance": (np.uint16, ()),
    "depth": (np.float32, ()),
    "place": (np.float32, (3,)),
}
"""Arrays of :class:`EventTruth` other than the points: data type, and shape of a row."""


@guarded
@dataclass(frozen=True, slots=True)
class WorldLabels:
    """Names and classes of the instances in a simulated world.

    Examples
    --------
    >>> labels = amiwarp.WorldLabels("room", ("wall", "chair"), ("building", "furniture"))
    >>> labels.instances[1 - 1]
    'wall'
    """

    name: str
    """Name of the simulated world."""
    instances: tuple[str, ...]
    """Labels of the instances. The label at index i has the instance number i + 1; number 0 is the sky."""
    categories: tuple[str, ...]
    """Class label of each instance, in the order of ``instances``; an empty string for an instance without a class."""

    def __post_init__(self) -> None:
        instance(self.name, str, "world labels' name")
        for names in (self.instances, self.categories):
            listed = isinstance(names, tuple | list)
            if not listed or not all(isinstance(name, str) for name in names):
                raise AmiwarpError(f"world labels have {shown(names)}; give a tuple of texts")
        if len(self.categories) != len(self.instances):
            given = f"{len(self.instances)} instances and {len(self.categories)} categories"
            raise AmiwarpError(f"world labels have {given}; give one category per instance")


@guarded
@dataclass(frozen=True, eq=False)
class FrameTruth:
    """Ground truth of all pixels at one instant.

    Depth, normals and instances are given for the view without the prism. The arrays cover the camera's image of
    (height, width) pixels. Raises :class:`AmiwarpError` for arrays of other types, and for values that are not finite,
    except as below.
    """

    t_us: int
    """Time of the instant, on the clock of the events [us]."""
    depth: NDArray[np.float32]
    """Depth along the optical axis [m], shape ``(height, width)``; infinite for the sky."""
    normal: NDArray[np.float32]
    """Unit normals of the surfaces in the world's frame, shape ``(height, width, 3)``; zero for the sky.

    The normals point to the side of the camera.
    """
    instance: NDArray[np.uint16]
    """Instance numbers, shape ``(height, width)``: 0 is the sky, i + 1 is ``WorldLabels.instances[i]``."""
    flow: NDArray[np.float32]
    """Optical flow without the prism [px/s], shape ``(height, width, 2)``; NaN where a point cannot be projected."""
    flow_with_prism: NDArray[np.float32]
    """Optical flow that the pixels see through the turning prism [px/s], shape ``(height, width, 2)``."""
    displacement: NDArray[np.float32]
    """Displacement to the next instant, without the prism, of the points that the pixels see without the prism [px].

    Shape ``(height, width, 2)``; NaN where a point cannot be projected, and if there is no next instant.
    """
    displacement_with_prism: NDArray[np.float32]
    """The same of the points that the pixels see through the prism, whose angle changes meanwhile."""
    occlusion: NDArray[np.uint8]
    """What becomes of these points at the next instant, without the prism, shape ``(height, width)``.

    0: visible; 1: hidden by another surface; 2: outside the image, or there is no next instant.
    """
    occlusion_with_prism: NDArray[np.uint8]
    """The same of the points that the pixels see through the prism, through the prism."""
    backward: NDArray[np.float32]
    """Displacement to the instant before [px], as :attr:`displacement`; NaN at the first instant."""
    backward_with_prism: NDArray[np.float32]
    """The same of the points that the pixels see through the prism, whose angle was another one."""
    backward_occlusion: NDArray[np.uint8]
    """Where these points were at the instant before, without the prism, as :attr:`occlusion`."""
    backward_occlusion_with_prism: NDArray[np.uint8]
    """The same of the points that the pixels see through the prism, through the prism."""
    intensity: NDArray[np.float32]
    """Linear luminance without the prism, shape ``(height, width)``."""
    intensity_with_prism: NDArray[np.float32]
    """Linear luminance through the prism, shape ``(height, width)``."""
    rotation: NDArray[np.float64]
    """Rotation matrix from the camera's frame to the world's frame, shape ``(3, 3)``."""
    position: NDArray[np.float64]
    """Position of the camera in the world [m], shape ``(3,)``."""
    joints: dict[str, NDArray[np.float64]]
    """Positions of the named points of the world, such as the joints of a figure [m], shape ``(3,)`` each."""

    def __post_init__(self) -> None:
        whole(self.t_us, "truth's t_us", *INT64)
        for name, (dtype, _) in MAPS.items():
            values = getattr(self, name)
            if not np.can_cast(values.dtype, dtype, "same_kind"):
                raise AmiwarpError(f"truth's {name} is {values.dtype}; give {np.dtype(dtype)}")
            check_truth(f"truth/frames/{name}", values)
        finite(self.rotation, f"truth's {shown('rotation')}")
        finite(self.position, f"truth's {shown('position')}")
        for name, values in self.joints.items():
            finite(values, f"truth's {shown(name)}")


MAPS = {
    "depth": (np.float32, ()),
    "normal": (np.float32, (3,)),
    "instance": (np.uint16, ()),
    "flow": (np.float32, (2,)),
    "flow_with_prism": (np.float32, (2,)),
    "displacement": (np.float32, (2,)),
    "displacement_with_prism": (np.float32, (2,)),
    "occlusion": (np.uint8, ()),
    "occlusion_with_prism": (np.uint8, ()),
    "backward": (np.float32, (2,)),
    "backward_with_prism": (np.float32, (2,)),
    "backward_occlusion": (np.uint8, ()),
    "backward_occlusion_with_prism": (np.uint8, ()),
    "intensity": (np.float32, ()),
    "intensity_with_prism": (np.float32, ()),
}
"""Arrays of :class:`FrameTruth` with one value per pixel: data type, and shape after (height, width)."""


OUTSIDE = 2
"""Value of :attr:`FrameTruth.occlusion` for points outside the image, and if there is no other instant."""
UNKNOWN_MAPS: dict[str, float] = {
    "backward": np.nan,
    "backward_with_prism": np.nan,
    "backward_occlusion": OUTSIDE,
    "backward_occlusion_with_prism": OUTSIDE,
}
"""Values of the maps that a file may lack, because the first files of the format lack them."""


NOT_FINITE: dict[str, Callable[[Any], Any]] = {
    "depth": np.isposinf,
    "x": np.isnan,
    "y": np.isnan,
    "place": np.isnan,
    "flow": np.isnan,
    "flow_with_prism": np.isnan,
    "displacement": np.isnan,
    "displacement_with_prism": np.isnan,
    "backward": np.isnan,
    "backward_with_prism": np.isnan,
}
"""Tests for the values that are not finite and have a meaning, such as the depth of the sky, by the last part of a
dataset's name."""


def check_truth(name: str, values: NDArray[Any]) -> None:
    """Raise :class:`AmiwarpError` if values of the dataset ``name`` are not finite, except :data:`NOT_FINITE`."""
    if values.dtype.kind != "f" or np.isfinite(values).all():
        return
    _, _, last_part = name.rpartition("/")
    has_meaning = NOT_FINITE.get(last_part)
    good = np.isfinite(values)
    if has_meaning is not None:
        good |= has_meaning(values)
    bad = ~good
    if bad.any():
        raise AmiwarpError(
            f"'{name}' holds {values[bad][0]}, which has no meaning there; give finite numbers"
        )


@not_called("simulate(..., truth_hz=...) makes one, recording.truth.frames")
class FrameStore(StoredInstants[FrameTruth], Protocol):
    """Protocol of the ground truth of all pixels at several instants, at increasing times."""


class MemoryFrames(Instants[FrameTruth]):
    """Ground truth of several instants, held in memory."""

    def __init__(self, frames: list[FrameTruth]) -> None:
        super().__init__(np.array([frame.t_us for frame in frames], np.int64))
        self._frames = frames

    def _read(self, index: int) -> FrameTruth:
        return self._frames[index]


@not_called("translate makes one, recording.truth.known")
class KnownStore(StoredInstants[NDArray[np.bool_]], Protocol):
    """Protocol of masks of the pixels whose scene is known, shape ``(height, width)``.

    Each holds from its time until the next. The times increase.
    """


class MemoryMasks(Instants[NDArray[np.bool_]]):
    """Masks of known pixels that are held in memory, as bits. Each holds from its time."""

    def __init__(self, t: Sequence[int], masks: Sequence[NDArray[np.bool_]]) -> None:
        super().__init__(np.array(t, np.int64))
        self._shape = masks[0].shape if masks else (0, 0)
        self._bits = [np.packbits(mask) for mask in masks]

    def _read(self, index: int) -> NDArray[np.bool_]:
        rows, columns = self._shape
        bits = np.unpackbits(self._bits[index], count=rows * columns)
        return bits.reshape(self._shape).astype(np.bool_)


GLASS = {"apex": "rad", "thickness": "m", "plate_tilt": "rad", "index": "", "phase": "rad"}
"""True parameters of a prism or plate that a printed :class:`Truth` shows, with their units."""


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

    def __repr__(self) -> str:
        glass = [name for name in GLASS if name in self.parameters]
        shown_names = glass or list(self.parameters)[:3]
        values = [f"{name} {self._in_words(name)}" for name in shown_names]
        more = len(self.parameters) - len(shown_names)
        if more > 0:
            values.append(f"{more} more parameters")
        per_event = ("points", "causes", "instances", "depths", "places")
        held = [name for name in per_event if getattr(self, f"stored_{name}") is not None]
        parts = [f"{', '.join(held)} of events"] if held else []
        stores = {"frames": self.frames, "poses": self.poses, "masks": self.known}
        for name, store in stores.items():
            if store is not None:
                parts.append(f"{len(store)} {name}")
        if self.labels is not None:
            parts.append(f"labels of {len(self.labels.instances)} instances")
        return f"Truth({', '.join(values) or 'no parameters'};\n      {', '.join(parts) or 'nothing else'})"

    def _in_words(self, name: str) -> str:
        """Return a parameter's value, with its unit if it belongs to the glass; angles in degrees."""
        value = self.parameters[name]
        unit = GLASS.get(name, "")
        if unit == "rad":
            return f"{math.degrees(value):.5g} deg"
        return f"{value:.5g} {unit}".rstrip()

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

        Raises
        ------
        AmiwarpError
            If an index is negative.
        """
        check_slice(start, stop)
        if self.stored_points is None:
            return None
        return self.stored_points[start:stop]

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
        times = as_times(t_us)
        pixels = array(xy, "xy").astype(np.float64)
        if times.ndim != 1 or pixels.shape != (len(times), 2):
            raise AmiwarpError(
                f"t_us has shape {times.shape}, xy {pixels.shape}; expected (n,) and (n, 2)"
            )
        if self.known is None:
            return np.ones(len(times), np.bool_)
        mask_of = np.searchsorted(self.known.t, times, side="right") - 1
        found = np.zeros(len(times), np.bool_)
        # Mask by mask, because each is read on demand.
        for index in np.unique(mask_of[mask_of >= 0]).tolist():
            mask = self.known[index]
            height, width = mask.shape
            which = np.flatnonzero(mask_of == index)
            of_mask = pixels[which]
            finite_pixels = np.isfinite(of_mask.sum(axis=1))
            numbers = np.where(finite_pixels[:, None], of_mask, -1.0)
            x, y = np.rint(numbers).astype(np.int64).T
            in_columns = (x >= 0) & (x < width)
            in_rows = (y >= 0) & (y < height)
            inside = finite_pixels & in_columns & in_rows
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

        Raises
        ------
        AmiwarpError
            If an index is negative.
        """
        points = self.points(start, stop)
        which = slice(start, stop)

        def rows(store: EventValues | None) -> NDArray[Any] | None:
            return None if store is None else store[which]

        return EventTruth(
            points,
            cause=rows(self.stored_causes),
            instance=rows(self.stored_instances),
            depth=rows(self.stored_depths),
            place=rows(self.stored_places),
        )
