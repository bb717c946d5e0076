"""What is translated: data sets by name, and pictures between the pictures of a sequence, by flow or by events."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import CONTRAST, Option
from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.events.recording import Events, EventSource
from amiwarp.io.files import errors_name, input_path
from amiwarp.optics.camera import Camera
from amiwarp.simulation.description import CameraMotion
from amiwarp.simulation.pictures import DARK, Pictures, linear_luminance

# Data sets that are translated by name: N-Caltech101 and MVSEC.

SACCADES_PX = ((3.5, 7.0), (3.5, -7.0), (-7.0, 0.0))
"""Motion of the image in the three saccades of N-Caltech101 and N-MNIST, x and y [px]."""
SACCADE_US = 105_000
"""Length of a saccade [us]."""
TURN_US = 1_000
"""Time in which the camera changes from one saccade to the next [us]."""
MVSEC_PICTURES = "davis/left/image_raw"
"""Pictures of the left camera in the HDF5 files of MVSEC; their times have the suffix ``_ts`` [s]."""


class DataSet(Option):
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


# Optical flow between two pictures, and pictures warped by it. OpenCV does both.

CONSISTENT_PX = 1.0
"""Largest distance from a pixel to where the flow forward and back leads it; beyond, the flow is not known [px]."""
WHITE_PERCENTILE = 99.8
"""Percentile of the light that becomes white in the 8-bit pictures of which the flow is computed."""
SMALLEST_SIDE = 16
"""Smallest width and height of pictures whose flow can be computed [px]."""


def load_opencv() -> Any:
    """Return OpenCV. Raises :class:`AmiwarpError` if it is not installed."""
    return optional_module("cv2", "translate", "motion between pictures needs OpenCV, unlike interpolation 'blend'")


@contextlib.contextmanager
def limited_opencv(cv2: Any, threads: int = 1) -> Iterator[Any]:
    """Yield OpenCV, which uses a number of threads within the block. Its flow depends on that number."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        yield cv2
    finally:
        cv2.setNumThreads(before)


def flows(
    first: NDArray[np.float32], second: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Return the flow from the first picture to the second, the flow back, and where both agree.

    Pictures are linear luminance of shape (height, width), flows have shape (height, width, 2) [px]. The method is DIS
    (T. Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016). The mask belongs to the first
    picture.
    """
    if min(first.shape) < SMALLEST_SIDE:
        none = np.zeros((*first.shape, 2), np.float32)
        return none, none, np.ones(first.shape, np.bool_)
    white = max(float(np.percentile(first, WHITE_PERCENTILE)), float(np.percentile(second, WHITE_PERCENTILE)), 1e-6)
    with limited_opencv(load_opencv()) as cv2:
        bytes_ = [
            (255.0 * np.clip(light / white, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8) for light in (first, second)
        ]
        method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        method.setFinestScale(0)
        forward, back = method.calc(*bytes_, None), method.calc(*bytes_[::-1], None)
    y, x = np.indices(first.shape, np.float32)
    to_x, to_y = x + forward[..., 0], y + forward[..., 1]
    returned = forward + np.stack([warped(back[..., k], forward) for k in (0, 1)], axis=2)
    inside = (to_x >= 0.0) & (to_x <= first.shape[1] - 1.0) & (to_y >= 0.0) & (to_y <= first.shape[0] - 1.0)
    return forward, back, inside & (np.hypot(returned[..., 0], returned[..., 1]) <= CONSISTENT_PX)


def warped(picture: NDArray[np.float32], offset: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the picture seen at each pixel plus ``offset``, shape (height, width, 2) [px]; its border is repeated."""
    y, x = np.indices(picture.shape, np.float32)
    with limited_opencv(load_opencv()) as cv2:
        at = (x + offset[..., 0], y + offset[..., 1])
        out = cv2.remap(np.ascontiguousarray(picture), *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, np.float32)


# Pictures between the pictures of a sequence: brightness follows the motion instead of fading over.

SMALL_MOTION_PX = 1.0
"""Largest motion between two pictures that are blended [px]."""
STEP_PX = 0.5
"""Largest motion between two interpolated pictures [px]."""
MOST_BETWEEN = 64
"""Largest number of pictures into which the time between two pictures is divided."""
MORE_PARTS = 4
"""Largest number of parts, relative to that for the motion that was expected: it limits the memory."""
SAMPLES = 6
"""Number of pairs of pictures whose motion is found before the simulation, to choose its time step."""
PERCENTILE = 99.0
"""Percentile of the flow's length that counts as the motion between two pictures."""
LEAST_CONSISTENT = 0.5
"""Smallest share of pixels whose flow is consistent; with fewer, the flow is meaningless and pictures are blended."""


class Interpolation(Option):
    """How the light changes between two pictures.

    Examples
    --------
    >>> [way.value for way in amiwarp.Interpolation]
    ['auto', 'motion', 'blend']
    """

    AUTO = "auto"
    """By motion if pictures move by more than one pixel, else by blending."""
    MOTION = "motion"
    """Along the optical flow between the two pictures (DIS of OpenCV)."""
    BLEND = "blend"
    """Each pixel's log intensity changes linearly. An edge that moves by more than a pixel fades out and in again."""


class KnownPictures:
    """Pictures that note which of their pixels are known while they are read (base class)."""

    def __init__(self) -> None:
        self._known: list[tuple[int, NDArray[np.bool_]]] = []

    def take_known(self) -> list[tuple[int, NDArray[np.bool_]]]:
        """Return, and forget, the masks of known pixels of the pictures read so far, with their times."""
        taken, self._known = self._known, []
        return taken


class MotionPictures(KnownPictures):
    """Pictures of a sequence, and pictures in between that follow the optical flow (:class:`amiwarp.Frames`).

    Pixels are known where the flow of a pair of pictures is consistent.
    """

    def __init__(self, pictures: Pictures, way: Interpolation = Interpolation.AUTO) -> None:
        """Find out how much the pictures move."""
        self._pictures, self._way = pictures, way
        self._parts = _parts(sampled_motion(pictures, way))
        super().__init__()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""
        return self._pictures.size

    @property
    def interval_us(self) -> float:
        """Smallest time between two pictures [us]."""
        return self._pictures.interval_us / self._parts

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time [us] and linear luminance, shape (height, width)."""
        self._known.clear()
        last: tuple[int, NDArray[np.float32]] | None = None
        for t, light in self._pictures.read():
            if last is not None:
                pair = PicturePair(last[1], light, self._way)
                self._known.append((last[0], pair.known))
                count = min(_parts(pair.motion_px), MORE_PARTS * self._parts, t - last[0])
                for k in range(1, count):
                    yield last[0] + (t - last[0]) * k // count, light_of(pair.at(k / count))
            yield t, light
            last = (t, light)


class PicturePair:
    """Two successive pictures and the motion between them."""

    def __init__(
        self, first: NDArray[np.float32], second: NDArray[np.float32], way: Interpolation = Interpolation.AUTO
    ) -> None:
        """Find the motion between two pictures of linear luminance."""
        self.logs = [np.log(light + np.float32(DARK)) for light in (first, second)]
        """Log intensity of both pictures."""
        self.motion_px = 0.0
        """Motion between the pictures [px]; 0 if no consistent motion is found or wanted."""
        self.known = np.ones(first.shape, np.bool_)
        """Pixels of the first picture whose motion is known, or so small that it does not matter."""
        self._flows: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if way is not Interpolation.BLEND:
            self._find_motion(first, second, way)

    def _find_motion(self, first: NDArray[np.float32], second: NDArray[np.float32], way: Interpolation) -> None:
        forward, back, consistent = flows(first, second)
        if consistent.mean() >= LEAST_CONSISTENT:
            self.motion_px = float(np.percentile(np.hypot(forward[..., 0], forward[..., 1])[consistent], PERCENTILE))
        else:
            self.known = consistent
        if self.motion_px > SMALL_MOTION_PX or way is Interpolation.MOTION:
            self._flows, self.known = (forward, back), consistent

    def at(self, part: float) -> NDArray[np.float32]:
        """Return the log intensity at a time between the pictures, 0 .. 1.

        The flow at that time is combined from the flows between the pictures as by H. Jiang et al., "Super SloMo", CVPR
        2018, equation 4.
        """
        rest, seen = 1.0 - part, self.logs
        if self._flows is not None:
            forward, back = self._flows
            to_first, to_second = part * part * back - rest * part * forward, rest * rest * forward - part * rest * back
            seen = [warped(log, offset) for log, offset in zip(self.logs, (to_first, to_second), strict=True)]
        return np.asarray(rest * seen[0] + part * seen[1], np.float32)


def sampled_motion(pictures: Pictures, way: Interpolation) -> float:
    """Return the largest motion in some pairs of successive pictures [px]; 0 if they are to be blended."""
    if way is Interpolation.BLEND:
        return 0.0
    every = max(1, round(pictures.duration_us / pictures.interval_us / SAMPLES))
    largest, last = 0.0, None
    for k, (_, light) in enumerate(pictures.read()):
        if last is not None and (k - 1) % every == 0:
            largest = max(largest, PicturePair(last, light).motion_px)
        last = light
    return largest


def light_of(log: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the linear luminance of a log intensity."""
    return np.maximum(np.exp(log) - np.float32(DARK), np.float32(0.0))


def _parts(motion_px: float) -> int:
    """Return the number of parts of the time between two pictures."""
    return min(MOST_BETWEEN, math.ceil(motion_px / STEP_PX)) if motion_px > SMALL_MOTION_PX else 1


# Fast pictures from pictures and the events between them: the events tell when the light of each pixel changes.

FAST_US = 1000
"""Time between two fast pictures [us]."""
READ_US = 20_000
"""Length of the time spans in which events are read [us]."""
FIT_PICTURES = 8
"""Largest number of pictures, after the first, to which the contrasts are fitted."""
FIT_CHANGE = 0.3
"""Smallest change of log intensity from the first picture that is used for the fit."""
CONTRAST_LIMITS = (0.02, 2.0)
"""Smallest and largest contrast that is believed [log intensity]."""
LARGEST_REST = 2.0
"""Largest change of log intensity between two pictures that the events leave unexplained at a known pixel [thresholds].

A pixel's unseen change is below one threshold at each of the two pictures.
"""
BAND = 0.75
"""Largest departure of the log intensity from what the events say [thresholds]: between two events it is not known."""


class EventPictures(KnownPictures):
    """Pictures of a sequence, and fast pictures in between that follow the events (:class:`amiwarp.Frames`).

    Between the pictures k and k + 1, the log intensity of each pixel is integrated from the events forward from picture
    k and backward from picture k + 1, and the two are blended linearly in time. This is right up to a threshold. The
    pictures interpolated by motion are used within that band, since they have no steps. Pixels are known where the
    events explain the change between two pictures.
    """

    def __init__(
        self,
        pictures: Pictures | MvsecPictures,
        events: EventSource,
        start_us: int,
        way: Interpolation = Interpolation.AUTO,
    ) -> None:
        """Fit the contrasts. ``start_us``: time of the first picture on the events' clock [us]."""
        if pictures.size != events.size:
            sizes = f"{pictures.size[0]}x{pictures.size[1]} px, the events {events.size[0]}x{events.size[1]} px"
            raise AmiwarpError(f"the pictures have {sizes}; give pictures of the camera that recorded the events")
        if not len(events) or events.t_last < start_us or events.t_first > start_us + pictures.duration_us:
            raise AmiwarpError(
                f"no events between {start_us} and {start_us + pictures.duration_us:.0f} us, the times of the "
                "pictures; give times.csv with times on the clock of the events"
            )
        self._pictures, self._events, self._start_us, self._way = pictures, events, start_us, way
        super().__init__()
        self.contrasts = self._fit_contrasts()
        """Fitted contrasts of ON and OFF events [log intensity]."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""
        return self._pictures.size

    @property
    def interval_us(self) -> float:
        """Smallest time between two pictures [us]."""
        return min(FAST_US, self._pictures.interval_us)

    @property
    def duration_us(self) -> float:
        """Duration of the pictures [us]."""
        return self._pictures.duration_us

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time [us], 0 at the first picture, and linear luminance, shape (height, width)."""
        self._known.clear()
        last: tuple[int, NDArray[np.float32]] | None = None
        for t, light in self._pictures.read():
            if last is not None:
                yield from self._between(last[0], t, PicturePair(last[1], light, self._way))
            yield t, light
            last = (t, light)

    def _between(self, start: int, stop: int, pair: PicturePair) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time and linear luminance between two pictures."""
        on, off = self.contrasts
        first, second = pair.logs
        ons, offs = self._counts(start, stop)
        rest = second - first - (on * ons - off * offs)
        self._known.append((start, np.abs(rest) < LARGEST_REST * max(on, off)))
        band = np.float32(BAND * 0.5 * (on + off))
        change = np.zeros_like(first)
        for t, events in self._spans([*range(start, stop, FAST_US), stop]):
            change += self._change(events)
            part = (t - start) / (stop - start)
            integrated = first + change + np.float32(part) * rest
            if t < stop:  # the light at the end is the second picture itself
                log = integrated + np.clip(pair.at(part) - integrated, -band, band)
                yield t, light_of(log)

    def _spans(self, times: list[int]) -> Iterator[tuple[int, Events]]:
        """Yield end and events of each span between successive times [us]."""
        many = max(1, READ_US // FAST_US)
        for k in range(0, len(times) - 1, many):
            part = times[k : k + many + 1]
            events = self._events.between(part[0] + self._start_us, part[-1] + self._start_us)
            ends = np.searchsorted(events.t, np.array(part) + self._start_us)
            for end, (i, j) in zip(part[1:], pairwise(ends.tolist()), strict=True):
                yield end, events[i:j]

    def _change(self, events: Events) -> NDArray[np.float32]:
        """Return the change of log intensity of each pixel, shape (height, width)."""
        on, off = self.contrasts
        width, height = self.size
        pixel = events.y.astype(np.int64) * width + events.x
        change = np.bincount(pixel, np.where(events.p == 1, on, -off), minlength=width * height)
        return change.astype(np.float32).reshape(height, width)

    def _counts(self, start: int, stop: int) -> NDArray[np.float32]:
        """Return the numbers of ON and of OFF events of each pixel between two times, shape (2, height, width)."""
        width, height = self.size
        counts = np.zeros((2, height * width), np.int64)
        for at in range(start, stop, READ_US):
            events = self._events.between(at + self._start_us, min(at + READ_US, stop) + self._start_us)
            pixel = events.y.astype(np.int64) * width + events.x
            for row, polarity in zip(counts, (1, 0), strict=True):
                row += np.bincount(pixel[events.p == polarity], minlength=width * height)
        return counts.reshape(2, height, width).astype(np.float32)

    def _fit_contrasts(self) -> tuple[float, float]:
        """Return the contrasts c for which ΔL = c_on N_on - c_off N_off holds from the first picture to later ones.

        Events are whole numbers, so a least-squares fit to them would find contrasts that are too small. The rises and
        the falls of log intensity are the instruments instead (two equations, summed over pixels). Pixels that the
        first fit does not explain are left out of the second.
        """
        contrasts = self._fit(np.full(2, np.inf))
        if not contrasts.any():  # nothing changes between the pictures
            return CONTRAST, CONTRAST
        on, off = self._fit(contrasts).tolist()
        low, high = CONTRAST_LIMITS
        if not (low <= min(on, off) and max(on, off) <= high):
            raise AmiwarpError(
                f"the pictures do not change as the events say: the fitted contrasts are {on:.3g} (ON) and {off:.3g} "
                "(OFF); check that pictures and events have one clock and one camera, or translate the pictures "
                "without the events"
            )
        return on, off

    def _fit(self, guess: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the contrasts that fit the pixels explained by a guess; zeros if nothing changes."""
        first: NDArray[np.float32] | None = None
        counts, last = np.zeros((2, *self.size[::-1])), 0
        left, right = np.zeros((2, 2)), np.zeros(2)
        for t, light in islice(self._pictures.read(), FIT_PICTURES + 1):
            log = np.log(light + np.float32(DARK)).astype(np.float64)
            first = log if first is None else first
            counts, last = counts + self._counts(last, t), t
            change, signed = (log - first).ravel(), counts.reshape(2, -1).T * np.array([1.0, -1.0])
            change[np.abs(change) < FIT_CHANGE] = 0.0
            if np.isfinite(guess).all():
                change[np.abs(change - signed @ guess) > LARGEST_REST * np.abs(guess).max()] = 0.0
            instruments = np.stack([np.maximum(change, 0.0), np.minimum(change, 0.0)])
            left += instruments @ signed
            right += instruments @ change
        return np.asarray(np.linalg.lstsq(left, right, rcond=None)[0])
