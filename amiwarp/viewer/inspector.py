"""What the inspector knows, without a window or a widget: a recording, the prism as it is set, and what is shown."""

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
from amiwarp.imaging.device_events import DeviceEvents, upload_events
from amiwarp.imaging.sharpness_costs import SharpnessMeter
from amiwarp.imaging.warped_image import CanvasShape, Votes
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import apex_from_deflection
from amiwarp.viewer.timeline import Span, event_rate, read_span

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.optics.models import Model

MOST_EVENTS = 4_000_000
"""Of a window, that its image is made of; one that holds more is read in evenly spaced runs."""
DRAWN = 100_000
"""Points of each cloud at most."""
FOV_DEG = 60.0
"""Taken where nothing tells the camera."""
SMOOTHING_PX = 1.0
"""Of the image whose sharpness is told, as in calibration."""
CURVE_POINTS, CURVE_EVENTS = 25, 200_000
ORBIT_POINTS = 181
WINDOW_US = 100_000
"""Length of the first window where no prism turns."""


@dataclass(frozen=True)
class Knobs:
    """The prism as it is set."""

    model: str = "exact"
    apex: float = 0.0
    """[rad]"""
    phase: float = 0.0
    """[rad]"""
    clock_offset: float = 0.0
    """Between the clocks of encoder and camera, as in :class:`Encoder` [us]."""
    tilt_x: float = 0.0
    """[rad]"""
    tilt_y: float = 0.0
    """[rad]"""
    rpm: float = 0.0
    """Speed where there is no encoder [1/min]."""


REACH = {
    "apex": math.radians(0.4), "phase": math.radians(30.0), "clock_offset": 5000.0, "tilt_x": math.radians(5.0),
    "tilt_y": math.radians(5.0), "rpm": 6.0,
}  # fmt: skip
"""Half width of the curve of sharpness over each knob."""


@dataclass(frozen=True)
class Selection:
    """Which events of a window are shown."""

    polarity: int | None = None
    """1: ON alone, 0: OFF alone."""
    region: tuple[int, int, int, int] | None = None
    """Left, top, right, bottom [px], the latter two not included."""
    hide_hot: bool = False


@dataclass(frozen=True, eq=False)
class Shown:
    """A window under the knobs: every event in the images, evenly thinned ones as points."""

    span: Span
    region: tuple[int, int, int, int]
    """What of the image is shown: left, top, right, bottom [px], the latter two not included."""
    selected: int
    """Events in the images."""
    events: Events
    """Those that are points."""
    before: NDArray[np.float32]
    """Their pixels, shape (n, 2)."""
    after: NDArray[np.float32]
    """Their places without the prism [px]; NaN: nowhere."""
    theta: NDArray[np.float64]
    """The prism's angle [rad], from 0 to a turn."""
    image_before: NDArray[np.float32]
    """[events per pixel], shape (height, width)."""
    image_after: NDArray[np.float32]
    sharpness_before: float
    sharpness_after: float


class Inspector:
    """See the module. Times are on the events' clock [us]."""

    def __init__(
        self,
        recording: Recording,
        calibration: Calibration | None = None,
        *,
        device: Any = "cpu",
        latest: Callable[[], Recording] | None = None,
    ) -> None:
        """``latest``: of a live stream what is there by now, see :meth:`renew`.

        Raises :class:`AmiwarpError` where there are no events, or for another camera's calibration.
        """
        source = recording.events
        if not len(source):
            raise AmiwarpError(f"{recording.name}: holds no events; there is nothing to see")
        self.notes: tuple[str, ...] = ()
        if recording.encoder is None and calibration is None:
            self.notes = ("no encoder: set the speed (rpm) of the prism, or calibrate, to take its motion out",)
        if recording.camera is None:
            recording = replace(recording, camera=Camera.from_fov(*source.size, math.radians(FOV_DEG)))
            self.notes = (
                *self.notes,
                f"camera unknown: {FOV_DEG:g}° field of view assumed; tell it with --fov-deg or --camera",
            )
        self.recording, self.device, self.latest = recording, device, latest
        self.prism = nominal(recording.prism)
        """The nominal one."""
        self.zero_us = (source.t_first + source.t_last) // 2
        """Where there is no encoder: when the angle is 0."""
        self.knobs = Knobs(apex=self.prism.apex, clock_offset=self._own_offset)
        self.window: tuple[int, int] | None = None
        """Start and length of what is shown; None: :meth:`first_window`."""
        self.selection = Selection()
        self._found: tuple[Knobs, Calibration] | None = None
        self._window: _Window | None = None
        self._shutter, self._curve_shutter = (_Shutter(source.size, device) for _ in range(2))
        if calibration is not None:
            self.accept(calibration)

    @property
    def camera(self) -> Camera:
        """The recording's, or what a calibration or nothing at all tells."""
        assert self.recording.camera is not None
        return self.recording.camera

    @property
    def has_encoder(self) -> bool:
        return self.recording.encoder is not None

    @property
    def turn_us(self) -> float:
        """Of the prism; infinite where it stands."""
        rpm = self.knobs.rpm if self.recording.encoder is None else self.recording.encoder.rpm
        return 60e6 / abs(rpm) if abs(rpm) > 1e-3 else math.inf

    @property
    def encoder(self) -> Encoder:
        """The recording's; or the constant speed that is set. The knob's clock offset comes on top."""
        source = self.recording.events
        return self.recording.encoder or constant_speed(self.knobs.rpm, source.t_first, source.t_last, self.zero_us)

    @property
    def set_encoder(self) -> Encoder:
        """With the knob's clock offset."""
        encoder = self.encoder
        return encoder.with_clock_offset(self.knobs.clock_offset) if self.has_encoder else encoder

    @property
    def model(self) -> Model:
        """The prism as it is set."""
        return self._model(self.knobs)

    @cached_property
    def rate(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """See :func:`event_rate`."""
        return event_rate(self.recording.events)

    @cached_property
    def hot(self) -> NDArray[np.bool_]:
        """Hot and flickering pixels of the recording, shape (height, width)."""
        source, encoder = self.recording.events, self.encoder
        return strange_pixels(stretch(source, encoder), encoder, source.size)[0]

    def first_window(self) -> tuple[int, int]:
        """Start and length of one turn in the middle, or of :data:`WINDOW_US`."""
        source = self.recording.events
        whole = source.t_last - source.t_first + 1
        length = min(round(self.turn_us) if math.isfinite(self.turn_us) else WINDOW_US, whole)
        return source.t_first + (whole - length) // 2, length

    def renew(self) -> None:
        """Takes over what a live stream has become; the window is to be opened anew. Raises as ``latest`` does."""
        if self.latest is not None:
            recording = self.latest()
            self.recording = replace(self.recording, events=recording.events, encoder=recording.encoder)
            for name in ("rate", "hot"):
                self.__dict__.pop(name, None)

    def accept(self, calibration: Calibration) -> None:
        """Sets the knobs to what was found. Raises :class:`AmiwarpError` for another camera's calibration."""
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
        offset, tilts = p.get("clock_offset", self._own_offset), (p.get("tilt_x", 0.0), p.get("tilt_y", 0.0))
        self.set(Knobs(calibration.model_name, apex, p["phase"], offset, *tilts, p.get("rpm", 0.0)))
        self._found = self.knobs, calibration

    def as_calibration(self) -> Calibration:
        """What was found, as long as no knob was moved; or the knobs."""
        if self._found is not None and self._found[0] == self.knobs:
            return self._found[1]
        k, values = self.knobs, self._values(self.knobs)
        size = ("deflection",) if k.model in ("circle", "radial") else ("apex", "tilt_x", "tilt_y")
        kept = {n: values[n] for n in (*size, "phase", *self._other)}
        kept |= {"clock_offset": k.clock_offset} if self.has_encoder else {"rpm": k.rpm}
        shown = self.show()
        return Calibration(
            model_name=k.model, camera=self.camera, prism=self.prism, parameters=kept, uncertainty={}, free=(),
            sharpness_name=Sharpness.VARIANCE.value, sharpness_before=shown.sharpness_before,
            sharpness_after=shown.sharpness_after, stages=(), events=shown.selected, seconds=0.0,
            warnings=("set by hand in the inspector",), zero_us=None if self.has_encoder else self.zero_us,
        )  # fmt: skip

    def set(self, knobs: Knobs) -> None:
        """Turns the knobs."""
        again = not self.has_encoder and knobs.rpm != self.knobs.rpm
        self.knobs = knobs
        if again and self._window is not None:
            self._window = self._prepare(self._window.span)

    def open(self, start_us: int, length_us: int, selection: Selection | None = None) -> None:
        """Reads a window. Raises :class:`AmiwarpError` where it holds no events of the ``selection``."""
        before, self.selection = self.selection, selection or self.selection
        try:
            self._window = self._prepare(read_span(self.recording.events, start_us, max(1, length_us), MOST_EVENTS))
        except BaseException:
            self.selection = before  # that of what is still shown
            raise
        self.window = start_us, length_us

    def show(self) -> Shown:
        """The window under the knobs."""
        w = self._opened
        late = self.knobs.clock_offset - self._own_offset
        image, sharpness = self._shutter.take(self.model, w.on_device, late)
        theta = w.theta + w.speed * late
        after = np.asarray(self.model.compensate_points(w.xy, theta.astype(np.float32)), np.float32)
        region = self.selection.region or (0, 0, *self.recording.events.size)
        return Shown(w.span, region, w.on_device.count, w.drawn, w.xy, after, np.mod(theta, math.tau), w.image, image,
                     w.sharpness, sharpness)  # fmt: skip

    def curve(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Sharpness over a knob about where it is: its values, in the knob's unit, and those of the sharpness."""
        w, set_to = self._opened, self.knobs
        at = getattr(set_to, name)
        values = at + np.linspace(-REACH[name], REACH[name], CURVE_POINTS)
        if name == "apex":
            values = values[values >= 0.0]
        scores = []
        for value in values:
            knobs = replace(set_to, **{name: float(value)})  # type: ignore[arg-type]
            few = self._upload(w.few, knobs) if name == "rpm" else w.few_on_device
            scores.append(self._curve_shutter.take(self._model(knobs), few, knobs.clock_offset - self._own_offset)[1])
        return values, np.array(scores)

    def orbit(self, x: float, y: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Where the model sees the scene point that would be at (x, y) [px] without the prism: angles [rad] over one
        turn, shape (n,), and pixels, shape (n, 2)."""
        theta = np.linspace(0.0, math.tau, ORBIT_POINTS)
        point = np.broadcast_to(np.array([[x, y]], np.float32), (len(theta), 2))
        return theta, self.model.deflect_points(point, theta.astype(np.float32))

    @property
    def _own_offset(self) -> float:
        """The clock offset with which the recording came [us]."""
        return 0.0 if self.recording.encoder is None else self.recording.encoder.clock_offset_us

    @property
    def _opened(self) -> _Window:
        if self._window is None:
            self.open(*(self.window or self.first_window()))
        assert self._window is not None
        return self._window

    @property
    def _other(self) -> dict[str, float]:
        """Parameters that a calibration found and no knob sets."""
        found: Mapping[str, float] = {} if self._found is None else self._found[1].parameters
        return {n: x for n, x in found.items() if n in ("index", "focal_length")}

    def _values(self, knobs: Knobs) -> dict[str, float]:
        """Parameters of every rung of the ladder; a prism that does not turn takes nothing out."""
        apex = knobs.apex if self.has_encoder or knobs.rpm else 0.0
        prism = replace(self.prism, apex=apex, index=self._other.get("index", self.prism.index))
        return {**self._other, "apex": apex, "deflection": prism.deflection, "phase": knobs.phase,
                "tilt_x": knobs.tilt_x, "tilt_y": knobs.tilt_y}  # fmt: skip

    def _model(self, knobs: Knobs) -> Model:
        return build_model(knobs.model, self.camera, self.prism, self._values(knobs))

    def _prepare(self, span: Span) -> _Window:
        chosen = self._selected(span.events)
        if not len(chosen):
            what = "no events" if not len(span.events) else f"{span.count:,} events, none of them selected,"
            raise AmiwarpError(f"{what} from {(span.start_us - self.recording.events.t_first) * 1e-3:.3f} ms on for "
                               f"{span.length_us * 1e-3:.3f} ms; take another window")  # fmt: skip
        encoder, n = self.encoder, len(chosen)
        drawn = chosen[np.arange(min(n, DRAWN)) * n // min(n, DRAWN)]
        few = chosen[:: max(1, -(-n // CURVE_EVENTS))]
        on_device = self._upload(chosen, self.knobs)
        still = self._model(replace(self.knobs, model="exact", apex=0.0))
        image, sharpness = self._shutter.take(still, on_device, 0.0)
        return _Window(
            span, drawn, np.stack([drawn.x, drawn.y], axis=1).astype(np.float32), encoder.angle_at(drawn.t),
            encoder.speed_at(drawn.t) * 1e-6, on_device, few, self._upload(few, self.knobs), image, sharpness,
        )  # fmt: skip

    def _upload(self, events: Events, knobs: Knobs) -> DeviceEvents:
        source = self.recording.events
        if self.recording.encoder is None:
            encoder = constant_speed(knobs.rpm, source.t_first, source.t_last, self.zero_us)
            return upload_events(events, encoder, self.device)
        encoder = self.recording.encoder
        return upload_events(events, encoder, self.device, slope=encoder.speed_at(events.t) * 1e-6)

    def _selected(self, events: Events) -> Events:
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
        return events if keep.all() else events[keep]


class _Shutter:
    """Takes images of events and their sharpness; owns its buffers, so for one thread."""

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        canvas = CanvasShape(*size, dither=True)
        self._votes = Votes(canvas, device)
        self._meter = SharpnessMeter(canvas, Sharpness.VARIANCE, smoothing=SMOOTHING_PX, device=device)

    def take(self, model: Model, events: DeviceEvents, late: float) -> tuple[NDArray[np.float32], float]:
        """Image [events per pixel], shape (height, width), and its sharpness; ``late``: the encoder, by more [us]."""
        self._votes.clear()
        self._votes.add_events(model, events, drift=late)
        self._votes.read(self._meter.image)
        return self._meter.image.numpy()[0], self._meter.measure()


@dataclass(frozen=True, eq=False)
class _Window:
    """A window's selected events, in memory and on the device."""

    span: Span
    drawn: Events
    xy: NDArray[np.float32]
    theta: NDArray[np.float64]
    """Angles of those that are drawn, without the knob's clock offset [rad]."""
    speed: NDArray[np.float64]
    """[rad/us]"""
    on_device: DeviceEvents
    few: Events
    few_on_device: DeviceEvents
    """For curves."""
    image: NDArray[np.float32]
    """As recorded."""
    sharpness: float
