"""State of the inspector without any user interface: recording, prism parameters, time window and its images."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.bad_pixels import strange_pixels, stretch
from amiwarp.calib.parameters import build_model, nominal
from amiwarp.calib.result import Calibration, constant_speed
from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder, turn_between
from amiwarp.events.events import Events
from amiwarp.events.recording import Recording
from amiwarp.imaging.export import PERCENTILE
from amiwarp.imaging.sharpness import random_variance
from amiwarp.imaging.votes import UploadedEvents, upload_events
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import MODELS, Model, size_names
from amiwarp.reconstruction.picture import border_displacements
from amiwarp.viewer import window
from amiwarp.viewer.timeline import Span, read_span
from amiwarp.viewer.window import Knobs, Selection, Source, WindowImager

# Region of the image that the inspector shows first: where compensation gains most sharpness.

WIDEST, NARROWEST = 120, 60
"""Largest width of a suggested region, and its width on a small sensor or if there are very many events [px]."""
CLEAR_EVENTS = 50_000
"""Number of events above which a narrower region is suggested, because so many points hide each other in the cloud."""
LEAST_SIGMA = 5.0
"""Smallest gain of variance over mean, in standard deviations of that of random events, that shows an effect."""
NEARLY_BEST = 0.5
"""Share of the largest gain of variance from which a region is a candidate. The candidate whose sharpness gains the
largest factor is chosen.

The variance grows with the square of the number of events, so that nearly empty regions are no candidates.
"""
LEAST_SHARE = 0.8
"""Smallest ratio of the number of recorded events to that of compensated events in a candidate: its edges do not come
from outside."""


@dataclass(frozen=True)
class Suggestion:
    """Suggested region of the image."""

    region: window.Region
    """Left, top, right and bottom [px]; right and bottom are exclusive."""
    gains: bool
    """Whether compensation with the current parameters sharpens the region. Otherwise, the region has most structure.
    """


def suggest_region(before: NDArray[np.float32], after: NDArray[np.float32], *, margin: int = 0) -> Suggestion:
    """Return the region in which compensation gains most sharpness.

    If it gains nothing anywhere, return the region of the recorded image that has most structure. ``before`` and
    ``after`` are images of the same events as recorded and compensated [events per pixel], shape ``(height, width)``.
    ``margin``: distance that the region keeps from the border of the image if it can [px]. If it is the radius of the
    orbit, no events of the region were outside of the image during a part of the turn.
    """
    rows, columns = before.shape
    width = min(columns, WIDEST, max(columns // 3, NARROWEST))
    while True:
        height = min(rows, max(1, round(width * min(rows / columns, 1.0))))
        left, top, gains = _best_box(before, after, width, height, margin)
        events = float(before[top : top + height, left : left + width].sum())
        if events <= CLEAR_EVENTS or width <= NARROWEST:
            return Suggestion((left, top, left + width, top + height), gains)
        width = max(NARROWEST, min(width - 1, int(width * (CLEAR_EVENTS / events) ** 0.5)))


def _best_box(
    before: NDArray[np.float32], after: NDArray[np.float32], width: int, height: int, margin: int
) -> tuple[int, int, bool]:
    """Return left and top of the best box of a size, and whether compensation sharpens it."""
    mean, over_mean = _of_boxes(before, width, height)
    mean_after, over_mean_after = _of_boxes(after, width, height)
    noise = random_variance(window.SMOOTHING_PX)
    # the variance of random events stays in the divisor, so that a region without structure has no arbitrary factor
    factor = (over_mean_after - noise) / mean_after / (np.maximum(over_mean, noise) / mean)
    variance = mean_after * over_mean_after - mean * over_mean
    variance = np.where(mean >= LEAST_SHARE * mean_after, variance, 0.0)
    inner = _inner(variance.shape, margin)
    gains = bool((over_mean_after - over_mean)[inner].max() > LEAST_SIGMA * noise * (2.0 / (width * height)) ** 0.5)
    if not gains:
        variance = factor = mean * over_mean
    candidates = np.full(variance.shape, -np.inf)
    candidates[inner] = np.where(variance[inner] >= NEARLY_BEST * variance[inner].max(), factor[inner], -np.inf)
    top, left = np.unravel_index(int(np.argmax(candidates)), candidates.shape)
    return int(left), int(top), gains


def _inner(shape: tuple[int, ...], margin: int) -> tuple[slice, ...]:
    """Return the part of an array without a margin on each side, at least its middle."""
    margins = (min(margin, (n - 1) // 2) for n in shape)
    return tuple(slice(m, n - m) for m, n in zip(margins, shape, strict=True))


def _of_boxes(image: NDArray[np.float32], width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean, and variance over mean, of all boxes in a smoothed image, indexed by top and left.

    Counts are limited, so that hot pixels are not taken for structure.
    """
    from scipy.ndimage import gaussian_filter

    positive = image[image > 0.0]
    limit = float(np.percentile(positive, PERCENTILE)) if positive.size else 1.0
    smoothed = gaussian_filter(np.minimum(image, limit).astype(np.float64), window.SMOOTHING_PX, mode="constant")
    mean, square = (_box_means(values, width, height) for values in (smoothed, smoothed**2))
    mean = np.maximum(mean, 1e-6)
    return mean, np.maximum(square / mean - mean, 0.0)


def _box_means(values: NDArray[np.float64], width: int, height: int) -> NDArray[np.float64]:
    """Return the mean over each box that lies in the image, indexed by top and left."""
    sums = np.pad(values, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    both = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    return np.asarray(both / (width * height), np.float64)


MOST_EVENTS = 2_000_000
"""Largest number of events in the image of a window. Of a fuller window, evenly spaced runs are read."""
FOV_DEG = 60.0
"""Horizontal field of view that is assumed if the camera is unknown [deg]."""
NO_ENCODER = "no encoder: set the prism's speed (rpm), or calibrate, to compensate its motion"
NO_CAMERA = f"camera unknown: {FOV_DEG:g}° field of view assumed; give it with --fov-deg or --camera"
CURVE_POINTS = 25
"""Number of points of a sharpness curve."""
ORBIT_POINTS = 181
"""Number of points of the drawn orbit of a scene point."""
LARGEST_APEX = math.radians(3.0)
"""Apex angle up to which events that move into the region are in its images, if the nominal apex is smaller [rad]."""
WINDOW_US = 100_000
"""Length of the first time window if the prism does not rotate [us]."""


class Inspector:
    """A recording with the prism parameters, the window and the selection under which it is shown.

    All times are on the events' clock [us].
    """

    def __init__(
        self,
        recording: Recording,
        calibration: Calibration | None = None,
        *,
        device: Any = "cpu",
        latest: Callable[[], Recording] | None = None,
    ) -> None:
        """Start with a recording; a calibration sets the prism's parameters.

        ``latest`` returns the current events of a live stream, see :meth:`renew`. Raises :class:`AmiwarpError` if there
        are no events, or if the calibration belongs to another camera.
        """
        source = recording.events
        if not len(source):
            raise AmiwarpError(f"{recording.name}: holds no events; give a recording with events")
        path = None if calibration is None or recording.encoder is not None else calibration.path
        if path is not None and path.covers(source.t_first, source.t_last):
            recording = replace(recording, encoder=path)
        no_speed = recording.encoder is None and calibration is None
        self.notes = (NO_ENCODER,) * no_speed + (NO_CAMERA,) * (recording.camera is None)
        """What is missing to compensate the prism's motion, one sentence each."""
        self.sources = {
            "camera": Source.ASSUMED if recording.camera is None else Source.FILE,
            "apex": Source.ASSUMED if getattr(recording.prism, "apex", None) is None else Source.FILE,
            **dict.fromkeys(("model", "phase", *window.SLIDING), Source.ASSUMED),
            **({"rpm": Source.ASSUMED} if recording.encoder is None else {"clock_offset": Source.FILE}),
        }
        """Where the value of each parameter that the page shows, and the camera, come from."""
        if recording.camera is None:
            recording = replace(recording, camera=Camera.from_fov(*source.size, math.radians(FOV_DEG)))
        self.recording, self.device, self.latest = recording, device, latest
        self.prism = nominal(recording.prism)
        """Nominal prism of the recording, with an assumed apex if it is unknown."""
        self.zero_us = (source.t_first + source.t_last) // 2
        """Time at which the prism angle is 0 if there is no encoder [us]."""
        self.knobs = Knobs(apex=self.prism.apex, clock_offset=self._recorded_offset_us)
        self.window: tuple[int, int] | None = None
        """Start and length of the time window [us]; None: that of :meth:`first_window`."""
        self.selection = Selection()
        self._found: tuple[Knobs, Calibration] | None = None
        self._window: window.LoadedWindow | None = None
        self._span: Span | None = None
        self.lock = Lock()
        """Lock for the events on the device and the buffers of their images."""
        self._imager, self._curve_imager = (WindowImager(source.size, device) for _ in range(2))
        if calibration is not None:
            self.accept(calibration)

    @property
    def camera(self) -> Camera:
        """Camera of the calibration or of the recording; an assumed camera if both lack it."""
        assert self.recording.camera is not None
        return self.recording.camera

    @property
    def has_encoder(self) -> bool:
        """Whether the recording has an encoder."""
        return self.recording.encoder is not None

    @property
    def turn_us(self) -> float:
        """Duration of one turn of the prism in the time window [us]; infinite if the prism does not rotate."""
        if not self.has_encoder:
            return 60e6 / abs(self.knobs.rpm) if self.knobs.rpm else math.inf
        source = self.recording.events
        start, length = self.window or (source.t_first, source.t_last - source.t_first)
        return turn_between(self.encoder, start, start + length) or math.inf

    @property
    def encoder(self) -> Encoder:
        """Encoder of the recording, or one of the constant speed set on the page.

        The clock offset set on the page is not included.
        """
        return self._encoder(self.knobs.rpm)

    def _encoder(self, rpm: float) -> Encoder:
        source = self.recording.events
        return self.recording.encoder or constant_speed(rpm, source.t_first, source.t_last, self.zero_us)

    @property
    def adjusted_encoder(self) -> Encoder:
        """Encoder with the clock offset set on the page."""
        return self.encoder_of(self.knobs)

    @property
    def margin_px(self) -> int:
        """How far outside a region the events of its images may be: how far the prism may move them [px]."""
        largest = replace(self.prism, apex=max(LARGEST_APEX, 2.0 * abs(self.prism.apex)))
        return math.ceil(1.2 * math.tan(abs(largest.deflection)) * max(self.camera.fx, self.camera.fy))

    @property
    def model(self) -> Model:
        """Optical model with the parameters that are set on the page."""
        return self.model_of(self.knobs)

    @cached_property
    def hot(self) -> NDArray[np.bool_]:
        """Hot and flickering pixels of the recording, shape (height, width)."""
        source, encoder = self.recording.events, self.encoder
        return strange_pixels(stretch(source, encoder), encoder, source.size)[0]

    def first_window(self) -> tuple[int, int]:
        """Return start and length of one turn in the middle of the recording [us].

        If the prism does not rotate, the length is :data:`WINDOW_US`.
        """
        source = self.recording.events
        whole = source.t_last - source.t_first + 1
        length = min(round(self.turn_us) if math.isfinite(self.turn_us) else WINDOW_US, whole)
        return source.t_first + (whole - length) // 2, length

    def renew(self) -> None:
        """Take the current events of a live stream; call :meth:`open` afterwards.

        Raises the errors of the function ``latest``.
        """
        if self.latest is not None:
            recording = self.latest()
            self.recording = replace(self.recording, events=recording.events, encoder=recording.encoder)
            self._span = None
            self.__dict__.pop("hot", None)

    def accept(self, calibration: Calibration) -> None:
        """Set the parameters to a calibration. Raises :class:`AmiwarpError` if its camera has another size."""
        size, given = self.recording.events.size, (calibration.camera.width, calibration.camera.height)
        if given != size:
            raise AmiwarpError(
                f"the calibration is of {given[0]}x{given[1]} pixels, the events are of {size[0]}x{size[1]}; "
                "calibrate this recording"
            )
        self.prism, self.recording = calibration.prism, replace(self.recording, camera=calibration.camera)
        self.set(self.knobs_of(calibration))
        found, free = (
            {"apex" if name in size_names() else name for name in names} & set(self.sources)
            for names in (calibration.parameters, calibration.free)
        )
        self.sources |= dict.fromkeys(found, Source.FILE) | dict.fromkeys(("model", *free), Source.CALIBRATED)
        self._found = self.knobs, calibration

    def knobs_of(self, calibration: Calibration) -> Knobs:
        """Return the parameters of a calibration of this camera, with the phase at the inspector's angle zero."""
        p, prism = calibration.parameters, calibration.prism
        kind, rpm, phase = MODELS[calibration.model_name], p.get("rpm", 0.0), p["phase"]
        if calibration.zero_us is not None:
            phase += rpm * math.tau / 60e6 * (self.zero_us - calibration.zero_us)
        offset = p.get("clock_offset", self._recorded_offset_us)
        return Knobs.given(
            p, model=kind.NAME, apex=kind.apex_from_size(p[kind.SIZE], prism), phase=phase, clock_offset=offset,
            rpm=rpm, focal_length=p.get("focal_length"),
        )  # fmt: skip

    @property
    def truth(self) -> Knobs | None:
        """Known parameters of a simulated recording, at the current speed, which ground truth does not hold.

        None if the recording has no ground truth of its prism.
        """
        p = {} if self.recording.truth is None else self.recording.truth.parameters
        if not {"apex", "phase"} <= set(p):
            return None
        offset = p.get("clock_offset_us", self._recorded_offset_us)
        return Knobs.given(p, apex=p["apex"], phase=p["phase"], clock_offset=offset, rpm=self.knobs.rpm)

    def take_truth(self) -> None:
        """Set the parameters to the known truth. Raises :class:`AmiwarpError` if the recording has none."""
        if self.truth is None:
            raise AmiwarpError(f"{self.recording.name}: holds no true parameters of its prism; simulate a recording")
        self.set(self.truth)
        known = set(self.sources) - {"camera", "rpm"}
        self.sources |= dict.fromkeys(known, Source.TRUTH)

    def as_calibration(self) -> Calibration:
        """Return the accepted calibration if no parameter was changed since, else one of the current parameters."""
        if self._found is not None and self._found[0] == self.knobs:
            return self._found[1]
        k, w, values = self.knobs, self.loaded, self._values(self.knobs)
        kind = MODELS[k.model]
        others = [name for name in kind.FREE if name in window.SLIDING]
        time = {"clock_offset": k.clock_offset} if self.has_encoder else {"rpm": k.rpm}
        kept = {name: values[name] for name in (kind.SIZE, *others, "phase", *k.calibrated_only)} | time
        before, after = self._unmoved(w), self._measured(w, k)
        return Calibration(
            model_name=k.model, camera=self.camera, prism=self.prism, parameters=kept, uncertainty={}, free=(),
            sharpness_name=Sharpness.VARIANCE.value, sharpness_before=before.variance, sharpness_after=after.variance,
            stages=(), events=len(w.events), seconds=0.0, warnings=("set by hand in the inspector",),
            zero_us=None if self.has_encoder else self.zero_us,
        )  # fmt: skip

    def set(self, knobs: Knobs) -> None:
        """Set the parameters of the prism. Parameters that change count as set by hand."""
        shown = self.sources.keys() - {"camera"}
        changed = {name for name in shown if knobs.value(name) != self.knobs.value(name)}
        self.sources |= dict.fromkeys(changed, Source.HAND)
        self.knobs = knobs

    def open(self, start_us: int, length_us: int, selection: Selection | None = None) -> None:
        """Read a time window of events.

        Raises :class:`AmiwarpError` if it has no events that meet the ``selection``.
        """
        chosen = selection or self.selection
        self._window = self._load(start_us, max(1, length_us), chosen)
        self.selection, self.window = chosen, (start_us, length_us)

    def suggest_region(self) -> Suggestion:
        """Return the region in which compensation gains most sharpness in the current time window."""
        loaded = self.loaded
        if self.selection.region is not None:
            loaded = self._load(loaded.span.start_us, loaded.span.length_us, replace(self.selection, region=None))
        before, after = self._unmoved(loaded).image, self._measured(loaded, self.knobs).image
        orbit_px = np.abs(border_displacements(self.model)).max(initial=0.0)
        return suggest_region(before, after, margin=math.ceil(orbit_px))

    def show(self, knobs: Knobs | None = None, *, against: Knobs | None = None) -> window.DisplayedWindow:
        """Return the time window's images and points.

        ``knobs``: parameters to show, by default the current ones. ``against``: parameters to compare with; they
        replace the recorded events as the first of the two clouds and images.
        """
        w, knobs = self.loaded, knobs or self.knobs
        first = self._unmoved(w) if against is None else self._measured(w, against)
        xy = w.xy if against is None else self._moved(w, against)
        second, theta = self._measured(w, knobs), np.mod(self._theta(w, knobs), math.tau)
        return window.DisplayedWindow(
            w.span, w.region, w.selected, w.drawn, w.truth, xy, self._moved(w, knobs), theta, first.image, second.image,
            first.sharpness, second.sharpness,
        )  # fmt: skip

    def curve(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return values of a parameter around its current one, in its unit, and the sharpness at each of them."""
        current = self.knobs
        half = window.CURVE_HALF_WIDTH[name]
        values = (current.value(name) or 0.0) + np.linspace(-half, half, CURVE_POINTS)
        if name == "apex":
            values = values[values >= 0.0]
        sharpness = self.sharpness_meter(self._curve_imager)
        changed = [current.with_values({name: float(value)}) for value in values]
        return values, np.array([sharpness(knobs) for knobs in changed])

    def sharpness_meter(self, imager: WindowImager | None = None) -> Callable[[Knobs | None], float]:
        """Return a function that measures the sharpness of part of the window's events with given parameters.

        Without parameters, it measures the events as recorded. It uses at most :data:`CURVE_EVENTS`, and belongs to the
        thread that uses the imager; by default, it has an imager of its own.
        """
        w, imager = self.loaded, imager or WindowImager(self.recording.events.size, self.device)
        on_device: dict[float, UploadedEvents] = {}

        def sharpness(knobs: Knobs | None) -> float:
            given = self._unprismed if knobs is None else knobs
            rpm = 0.0 if self.has_encoder else given.rpm
            if rpm not in on_device:
                on_device.clear()
                on_device[rpm] = self._upload(w.curve_events, rpm)
            model, drift_us = self.model_of(given), self._drift_us(given)
            return imager.measure(model, on_device[rpm], drift_us, w.region).sharpness

        return sharpness

    def orbit(self, x: float, y: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return the orbit of the scene point that would appear at (x, y) [px] without the prism.

        Returns prism angles over one turn [rad], shape ``(n,)``, and pixels, shape ``(n, 2)``.
        """
        theta = np.linspace(0.0, math.tau, ORBIT_POINTS)
        point = np.broadcast_to(np.array([[x, y]], np.float32), (len(theta), 2))
        return theta, self.model.deflect_points(point, theta.astype(np.float32))

    @property
    def _recorded_offset_us(self) -> float:
        """Clock offset of the recording's own encoder [us]."""
        return 0.0 if self.recording.encoder is None else self.recording.encoder.clock_offset_us

    @property
    def loaded(self) -> window.LoadedWindow:
        """Selected events of the time window. They are read first if necessary."""
        if self._window is None:
            self.open(*(self.window or self.first_window()))
        assert self._window is not None
        return self._window

    def _values(self, knobs: Knobs) -> dict[str, float]:
        """Return the values of the optical model's parameters.

        A prism that does not rotate gets apex 0, so that nothing is compensated.
        """
        apex, more = knobs.apex if self.has_encoder or knobs.rpm else 0.0, knobs.calibrated_only
        prism = replace(self.prism, apex=apex, index=more.get("index", self.prism.index))
        kind = MODELS[knobs.model]
        others = {name: knobs.value(name) or 0.0 for name in window.SLIDING}
        return {**more, **others, kind.SIZE: kind.size_from_apex(apex, prism), "phase": knobs.phase}

    def model_of(self, knobs: Knobs, camera: Camera | None = None) -> Model:
        """Return the optical model with given parameters, of the recording's camera or another one."""
        return build_model(knobs.model, camera or self.camera, self.prism, self._values(knobs))

    def encoder_of(self, knobs: Knobs) -> Encoder:
        """Return the encoder with the clock offset or the speed of given parameters."""
        encoder = self._encoder(knobs.rpm)
        return encoder.with_clock_offset(knobs.clock_offset) if self.has_encoder else encoder

    @property
    def _unprismed(self) -> Knobs:
        """Parameters that leave all events where they were recorded."""
        return replace(self.knobs, model="exact", apex=0.0)

    def warped(self, w: window.LoadedWindow, knobs: Knobs | None) -> tuple[Model, UploadedEvents, float]:
        """Return the model, the events on the device and their drift [us], to vote the events of a window.

        ``knobs``: the parameters; None for the events as recorded.
        """
        given = self._unprismed if knobs is None else knobs
        return self.model_of(given), self._angles(w, given).on_device, self._drift_us(given)

    def positions(self, events: Events, knobs: Knobs) -> NDArray[np.float32]:
        """Return the compensated positions of events [px], shape ``(n, 2)``."""
        xy = np.stack([events.x, events.y], axis=1).astype(np.float32)
        theta = self.encoder_of(knobs).angle_at(events.t).astype(np.float32)
        return np.asarray(self.model_of(knobs).compensate_points(xy, theta), np.float32)

    def _load(self, start_us: int, length_us: int, selection: Selection) -> window.LoadedWindow:
        """Read and select the events of a time window. The events of the last one are not read again."""
        if self._span is None or (self._span.start_us, self._span.length_us) != (start_us, length_us):
            self._span = read_span(self.recording.events, start_us, length_us, most_events=MOST_EVENTS)
        return self._select(self._span, selection)

    def select(self, span: Span) -> Events:
        """Return the events of a time window that meet the selection."""
        return self._select(span, self.selection).events

    def _select(self, span: Span, selection: Selection) -> window.LoadedWindow:
        hot = self.hot if selection.hide_hot else None
        return window.load_window(self.recording, span, selection, margin_px=self.margin_px, hot=hot)

    def _drift_us(self, knobs: Knobs) -> float:
        """Return how far the clock offset is from that of the recording's own encoder [us]."""
        return knobs.clock_offset - self._recorded_offset_us

    def _angles(self, w: window.LoadedWindow, knobs: Knobs) -> window.WindowAngles:
        """Return the prism angles of a window; those of the two last speeds are kept."""
        rpm = 0.0 if self.has_encoder else knobs.rpm
        if rpm not in w.angles:
            encoder, t = self._encoder(rpm), w.drawn.t
            for old in list(w.angles)[:-1]:
                del w.angles[old]
            angle, speed = encoder.angle_at(t), encoder.speed_at(t) * 1e-6
            w.angles[rpm] = window.WindowAngles(self._upload(w.events, rpm), angle, speed)
        return w.angles[rpm]

    def _upload(self, events: Events, rpm: float) -> UploadedEvents:
        """Upload events with their prism angles, so that the clock offset of the encoder can be changed afterwards."""
        encoder = self._encoder(rpm)
        slope = encoder.speed_at(events.t) * 1e-6 if self.has_encoder else None
        return upload_events(events, encoder, self.device, slope=slope)

    def _theta(self, w: window.LoadedWindow, knobs: Knobs) -> NDArray[np.float64]:
        """Return the prism angles of the drawn events [rad], shape ``(n,)``."""
        angles = self._angles(w, knobs)
        return angles.theta + angles.speed * self._drift_us(knobs)

    def _moved(self, w: window.LoadedWindow, knobs: Knobs) -> NDArray[np.float32]:
        """Return the compensated positions of the drawn events [px], shape ``(n, 2)``."""
        theta = self._theta(w, knobs).astype(np.float32)
        return np.asarray(self.model_of(knobs).compensate_points(w.xy, theta), np.float32)

    def _measured(self, w: window.LoadedWindow, knobs: Knobs | None) -> window.MeasuredImage:
        """Return the image of a window with these parameters; as recorded if ``knobs`` is None."""
        with self.lock:
            return self._imager.measure(*self.warped(w, knobs), w.region)

    def _unmoved(self, w: window.LoadedWindow) -> window.MeasuredImage:
        """Return the image of a window as recorded."""
        if not w.unmoved:
            w.unmoved.append(self._measured(w, None))
        return w.unmoved[0]


# Recordings that a page can open: the files in one folder.

SUFFIXES = {
    ".aedat", ".aedat2", ".aedat4", ".bag", ".bin", ".csv", ".dat", ".db3", ".es", ".h5", ".hdf5", ".mcap", ".npz",
    ".raw", ".txt",
}  # fmt: skip
"""Suffixes of files that may be recordings."""
MOST_FILES = 200
"""Largest number of files that are listed."""


class Library:
    """Files in a folder that a page may open. The page names a file, never a folder."""

    def __init__(self, folder: Path, open_file: Callable[[Path], Inspector]) -> None:
        self.folder, self._open_file = folder.resolve(), open_file

    def files(self) -> list[list[str]]:
        """Return names and sizes of the files, in the order of their names."""
        found = sorted(path for path in self.folder.iterdir() if self._is_recording(path))
        return [[path.name, f"{path.stat().st_size / 1e6:,.1f} MB"] for path in found[:MOST_FILES]]

    def open(self, name: str) -> Inspector:
        """Open a file of the folder. Raises :class:`AmiwarpError` for any other name, or if it is no recording."""
        if name not in [file for file, _ in self.files()]:
            raise AmiwarpError(f"{name!r}: is no recording in {self.folder}; choose one from the list")
        return self._open_file(self.folder / name)

    def _is_recording(self, path: Path) -> bool:
        """Return whether a file looks like a recording, and lies in the folder even if it is a link."""
        visible = path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
        return visible and path.is_file() and path.resolve().parent == self.folder
