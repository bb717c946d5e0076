"""State of the inspector without any user interface: recording, prism parameters, time window and its images."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib.bad_pixels import strange_pixels, stretch
from amiwarp.calib.parameters import build_model, nominal
from amiwarp.calib.result import Calibration, constant_speed
from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events
from amiwarp.events.recording import Recording
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.device_events import UploadedEvents, upload_events
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import apex_from_deflection
from amiwarp.viewer.drawn_truth import DrawnTruth
from amiwarp.viewer.imager import LoadedWindow, WindowImager
from amiwarp.viewer.timeline import Span, event_rate, read_span

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.optics.models import Model

MOST_EVENTS = 4_000_000
"""Largest number of events in the image of a window. Of a fuller window, evenly spaced runs are read."""
MOST_POINTS = 100_000
"""Largest number of points in each event cloud."""
FOV_DEG = 60.0
"""Horizontal field of view that is assumed if the camera is unknown [deg]."""
CURVE_POINTS, CURVE_EVENTS = 25, 200_000
"""Number of points of a sharpness curve, and largest number of events that it uses."""
ORBIT_POINTS = 181
"""Number of points of the drawn orbit of a scene point."""
WINDOW_US = 100_000
"""Length of the first time window if the prism does not rotate [us]."""


@dataclass(frozen=True)
class Knobs:
    """Parameters of the prism that the page's sliders set."""

    model: str = "exact"
    """Name of the optical model."""
    apex: float = 0.0
    """Apex angle of the prism [rad]."""
    phase: float = 0.0
    """Phase θ_b of the prism [rad]."""
    clock_offset: float = 0.0
    """Offset between the clocks of encoder and camera, as in :class:`Encoder` [us]."""
    tilt_x: float = 0.0
    """Tilt of the axis of rotation, x component [rad]."""
    tilt_y: float = 0.0
    """Tilt of the axis of rotation, y component [rad]."""
    rpm: float = 0.0
    """Speed of the prism if the recording has no encoder [1/min]."""


CURVE_HALF_WIDTH = {
    "apex": math.radians(0.4), "phase": math.radians(30.0), "clock_offset": 5000.0, "tilt_x": math.radians(5.0),
    "tilt_y": math.radians(5.0), "rpm": 6.0,
}  # fmt: skip
"""Half width of the range of each parameter over which its sharpness curve is drawn, in the parameter's unit."""


@dataclass(frozen=True)
class Selection:
    """Conditions for the events that are shown."""

    polarity: int | None = None
    """Polarity of the shown events: 1 for only ON, 0 for only OFF, None for both."""
    region: tuple[int, int, int, int] | None = None
    """Region of the image: left, top, right and bottom [px], right and bottom exclusive. None: the whole image."""
    hide_hot: bool = False
    """Whether the events of hot pixels are left out."""


@dataclass(frozen=True, eq=False)
class DisplayedWindow:
    """Time window shown with the current parameters: images of all events, and points of evenly spaced events."""

    span: Span
    """Time window, with all events that were read from it."""
    region: tuple[int, int, int, int]
    """Part of the image that is shown: left, top, right and bottom [px]; right and bottom are exclusive."""
    selected: int
    """Number of selected events, which are all in the images."""
    events: Events
    """Events that are drawn as points."""
    truth: DrawnTruth
    """Ground truth of these events."""
    before: NDArray[np.float32]
    """Pixels of the drawn events as recorded [px], shape ``(n, 2)``."""
    after: NDArray[np.float32]
    """Compensated positions of the drawn events [px], shape ``(n, 2)``; NaN if the model has no solution."""
    theta: NDArray[np.float64]
    """Prism angles of the drawn events [rad], from 0 to 2π, shape ``(n,)``."""
    image_before: NDArray[np.float32]
    """Image of the events as recorded [events per pixel], shape ``(height, width)``."""
    image_after: NDArray[np.float32]
    """Image of the compensated events [events per pixel], shape ``(height, width)``."""
    sharpness_before: float
    """Sharpness of ``image_before``, the image before compensation."""
    sharpness_after: float
    """Sharpness of ``image_after``, the image after compensation."""


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

        ``latest`` is a function that returns the current events of a live stream; see :meth:`renew`. Raises
        :class:`AmiwarpError` if there are no events, or if the calibration belongs to another camera.
        """
        source = recording.events
        if not len(source):
            raise AmiwarpError(f"{recording.name}: holds no events; give a recording with events")
        self.notes: tuple[str, ...] = ()
        if recording.encoder is None and calibration is None:
            self.notes = ("no encoder: set the prism's speed (rpm), or calibrate, to compensate its motion",)
        if recording.camera is None:
            recording = replace(recording, camera=Camera.from_fov(*source.size, math.radians(FOV_DEG)))
            self.notes = (
                *self.notes,
                f"camera unknown: {FOV_DEG:g}° field of view assumed; give it with --fov-deg or --camera",
            )
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
        self._window: LoadedWindow | None = None
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
        """Duration of one turn of the prism [us]; infinite if the prism does not rotate."""
        rpm = self.knobs.rpm if self.recording.encoder is None else self.recording.encoder.rpm
        return 60e6 / abs(rpm) if abs(rpm) > 1e-3 else math.inf

    @property
    def encoder(self) -> Encoder:
        """Encoder of the recording, or one of the constant speed set on the page.

        The clock offset set on the page is not included.
        """
        source = self.recording.events
        return self.recording.encoder or constant_speed(self.knobs.rpm, source.t_first, source.t_last, self.zero_us)

    @property
    def adjusted_encoder(self) -> Encoder:
        """Encoder with the clock offset set on the page."""
        encoder = self.encoder
        return encoder.with_clock_offset(self.knobs.clock_offset) if self.has_encoder else encoder

    @property
    def model(self) -> Model:
        """Optical model with the parameters that are set on the page."""
        return self._model(self.knobs)

    @cached_property
    def rate(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Event rate over the recording; see :func:`event_rate`."""
        return event_rate(self.recording.events)

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
            for name in ("rate", "hot"):
                self.__dict__.pop(name, None)

    def accept(self, calibration: Calibration) -> None:
        """Set the parameters to a calibration. Raises :class:`AmiwarpError` if its camera has another size."""
        size, given = self.recording.events.size, (calibration.camera.width, calibration.camera.height)
        if given != size:
            raise AmiwarpError(
                f"the calibration is of {given[0]}x{given[1]} pixels, the events are of {size[0]}x{size[1]}; "
                "calibrate this recording"
            )
        p, self.prism = calibration.parameters, calibration.prism
        apex = (
            p["apex"] if "apex" in p else apex_from_deflection(p["deflection"], self.prism.index, self.prism.flat_side)
        )
        self.recording = replace(self.recording, camera=calibration.camera)
        self.zero_us = self.zero_us if calibration.zero_us is None else calibration.zero_us
        offset, tilts = p.get("clock_offset", self._recorded_offset_us), (p.get("tilt_x", 0.0), p.get("tilt_y", 0.0))
        self.set(Knobs(calibration.model_name, apex, p["phase"], offset, *tilts, p.get("rpm", 0.0)))
        self._found = self.knobs, calibration

    def as_calibration(self) -> Calibration:
        """Return the accepted calibration if no parameter was changed since, else one of the current parameters."""
        if self._found is not None and self._found[0] == self.knobs:
            return self._found[1]
        k, values = self.knobs, self._values(self.knobs)
        size = ("deflection",) if k.model in ("circle", "radial") else ("apex", "tilt_x", "tilt_y")
        kept = {n: values[n] for n in (*size, "phase", *self._calibrated_only)}
        kept |= {"clock_offset": k.clock_offset} if self.has_encoder else {"rpm": k.rpm}
        shown = self.show()
        return Calibration(
            model_name=k.model, camera=self.camera, prism=self.prism, parameters=kept, uncertainty={}, free=(),
            sharpness_name=Sharpness.VARIANCE.value, sharpness_before=shown.sharpness_before,
            sharpness_after=shown.sharpness_after, stages=(), events=shown.selected, seconds=0.0,
            warnings=("set by hand in the inspector",), zero_us=None if self.has_encoder else self.zero_us,
        )  # fmt: skip

    def set(self, knobs: Knobs) -> None:
        """Set the parameters of the prism."""
        speed_changed = not self.has_encoder and knobs.rpm != self.knobs.rpm
        self.knobs = knobs
        if speed_changed and self._window is not None:
            self._window = self._prepare(self._window.span)

    def open(self, start_us: int, length_us: int, selection: Selection | None = None) -> None:
        """Read a time window of events.

        Raises :class:`AmiwarpError` if it has no events that meet the ``selection``.
        """
        before, self.selection = self.selection, selection or self.selection
        try:
            self._window = self._prepare(
                read_span(self.recording.events, start_us, max(1, length_us), most_events=MOST_EVENTS)
            )
        except BaseException:
            self.selection = before  # the page still shows the previous window
            raise
        self.window = start_us, length_us

    def show(self) -> DisplayedWindow:
        """Return the time window's images and points with the current parameters."""
        w = self._loaded
        offset_us = self.knobs.clock_offset - self._recorded_offset_us
        image, sharpness = self._imager.measure(self.model, w.on_device, offset_us)
        theta = w.theta + w.speed * offset_us
        after = np.asarray(self.model.compensate_points(w.xy, theta.astype(np.float32)), np.float32)
        region = self.selection.region or (0, 0, *self.recording.events.size)
        return DisplayedWindow(
            w.span, region, w.on_device.count, w.drawn, w.truth, w.xy, after, np.mod(theta, math.tau), w.image,
            image, w.sharpness, sharpness,
        )  # fmt: skip

    def curve(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return values of a parameter around its current one, in its unit, and the sharpness at each of them."""
        w, current = self._loaded, self.knobs
        values = getattr(current, name) + np.linspace(-CURVE_HALF_WIDTH[name], CURVE_HALF_WIDTH[name], CURVE_POINTS)
        if name == "apex":
            values = values[values >= 0.0]
        scores = []
        for value in values:
            knobs = replace(current, **{name: float(value)})  # type: ignore[arg-type]
            events = self._upload(w.curve_events, knobs) if name == "rpm" else w.curve_events_on_device
            offset_us = knobs.clock_offset - self._recorded_offset_us
            scores.append(self._curve_imager.measure(self._model(knobs), events, offset_us)[1])
        return values, np.array(scores)

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
    def _loaded(self) -> LoadedWindow:
        if self._window is None:
            self.open(*(self.window or self.first_window()))
        assert self._window is not None
        return self._window

    @property
    def _calibrated_only(self) -> dict[str, float]:
        """Return the calibrated parameters that the page cannot change."""
        found: Mapping[str, float] = {} if self._found is None else self._found[1].parameters
        return {n: x for n, x in found.items() if n in ("index", "focal_length")}

    def _values(self, knobs: Knobs) -> dict[str, float]:
        """Return the parameters of every optical model.

        A prism that does not rotate gets apex 0, so that nothing is compensated.
        """
        apex = knobs.apex if self.has_encoder or knobs.rpm else 0.0
        prism = replace(self.prism, apex=apex, index=self._calibrated_only.get("index", self.prism.index))
        return {**self._calibrated_only, "apex": apex, "deflection": prism.deflection, "phase": knobs.phase,
                "tilt_x": knobs.tilt_x, "tilt_y": knobs.tilt_y}  # fmt: skip

    def _model(self, knobs: Knobs) -> Model:
        return build_model(knobs.model, self.camera, self.prism, self._values(knobs))

    def _prepare(self, span: Span) -> LoadedWindow:
        kept = np.flatnonzero(self._selected(span.events))
        selected = span.events if len(kept) == len(span.events) else span.events[kept]
        if not len(selected):
            what = "no events" if not len(span.events) else f"{span.count:,} events, none of them selected,"
            raise AmiwarpError(f"{what} from {(span.start_us - self.recording.events.t_first) * 1e-3:.3f} ms on for "
                               f"{span.length_us * 1e-3:.3f} ms; take another window")  # fmt: skip
        encoder, n = self.encoder, len(selected)
        thin = np.arange(min(n, MOST_POINTS)) * n // min(n, MOST_POINTS)
        drawn, truth = selected[thin], DrawnTruth(self.recording.truth, span, kept[thin])
        curve_events = selected[:: max(1, -(-n // CURVE_EVENTS))]
        on_device = self._upload(selected, self.knobs)
        no_prism = self._model(replace(self.knobs, model="exact", apex=0.0))
        image, sharpness = self._imager.measure(no_prism, on_device, 0.0)
        return LoadedWindow(
            span, drawn, truth, np.stack([drawn.x, drawn.y], axis=1).astype(np.float32), encoder.angle_at(drawn.t),
            encoder.speed_at(drawn.t) * 1e-6, on_device, curve_events, self._upload(curve_events, self.knobs), image,
            sharpness,
        )  # fmt: skip

    def _upload(self, events: Events, knobs: Knobs) -> UploadedEvents:
        source = self.recording.events
        if self.recording.encoder is None:
            encoder = constant_speed(knobs.rpm, source.t_first, source.t_last, self.zero_us)
            return upload_events(events, encoder, self.device)
        encoder = self.recording.encoder
        return upload_events(events, encoder, self.device, slope=encoder.speed_at(events.t) * 1e-6)

    def _selected(self, events: Events) -> NDArray[np.bool_]:
        """Return whether each event meets the selection, shape ``(n,)``."""
        s, keep = self.selection, np.ones(len(events), np.bool_)
        if self.recording.encoder is not None:
            first, last = self.recording.encoder.coverage
            keep &= (events.t >= first) & (events.t <= last)
        if s.polarity is not None:
            keep &= events.p == s.polarity
        if s.region is not None:
            left, top, right, bottom = s.region
            keep &= (events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)
        if s.hide_hot:
            keep &= ~self.hot[events.y, events.x]
        return keep
