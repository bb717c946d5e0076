"""State of the inspector without a user interface: recording, parameters, time window and its images, event rates."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from threading import Event, Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.bad_pixels import strange_pixels, stretch
from amiwarp.calib.parameters import best_model, nominal, optical_parameters
from amiwarp.calib.plate import LARGEST_INVERSE
from amiwarp.calib.result import Calibration, constant_speed, replaces
from amiwarp.choices import Colour, Sharpness, Vote
from amiwarp.compensation.recordings import at_depths, compensate_events
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder, check_prisms, turn_between
from amiwarp.events.recording import Events, Recording
from amiwarp.events.truth import Cause, Truth
from amiwarp.imaging.filters import find_hot_pixels
from amiwarp.imaging.iwe import CanvasShape, UploadedEvents, Votes, iwe, upload_events
from amiwarp.imaging.regions import Region, RegionSharpness, inside, suggest_region
from amiwarp.io.depth_map import DepthMap
from amiwarp.io.formats import EXTENSIONS
from amiwarp.io.pixel_map import PixelMap
from amiwarp.io.plain_files import holds_map
from amiwarp.io.spans import Span, read_span
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import MODELS, PHASE, Model, PlateModel, RisleyModel, alternatives, build_model
from amiwarp.optics.prism import NominalPrism, Plate, Prism, as_wedge
from amiwarp.reconstruction.picture import Picture, border_displacements
from amiwarp.viewer.filters import FilterStep, HotPixel, SelectedEvents, Selection, list_hot_pixels


def _in_pixels(span: Span, size: tuple[int, int]) -> Span:
    """Return the span with the pixels of its events, also if these were compensated and lie anywhere."""
    e = span.events
    if not np.issubdtype(e.x.dtype, np.floating):
        return span
    x, y = (np.clip(np.rint(v), 0, n - 1).astype(np.uint16) for v, n in zip((e.x, e.y), size, strict=True))
    places = np.stack([e.x, e.y], axis=1).astype(np.float32)
    return replace(span, events=Events(x, y, e.t, e.p), places=places)


# Ground truth of the events that the inspector draws, read from the recording on first use.

STORES = {Colour.CAUSE: "stored_causes", Colour.INSTANCE: "stored_instances", Colour.DEPTH: "stored_depths"}
"""Attribute of :class:`amiwarp.Truth` that each colour choice based on ground truth shows."""


def colours_on_offer(truth: Truth | None) -> list[Colour]:
    """Return the colour choices that are possible for a recording with this ground truth."""
    return [c for c in Colour if c not in STORES or getattr(truth, STORES[c], None) is not None]


def truth_text(truth: Truth | None) -> str:
    """Return a one-line summary of the content of a ground truth; empty without ground truth."""
    if truth is None:
        return ""
    stores = {"point": truth.stored_points, **{c.value: getattr(truth, name) for c, name in STORES.items()},
              "place": truth.stored_places}  # fmt: skip
    per_event = ", ".join(name for name, store in stores.items() if store is not None)
    parts = [f"per event: {per_event}"] if per_event else ["prism"] if truth.parameters else []
    parts += [f"{len(truth.labels.instances)} instances"] if truth.labels is not None else []
    parts += [f"{len(truth.frames.t):,} instants"] if truth.frames is not None else []
    parts += [f"{len(truth.poses):,} poses"] if truth.poses is not None else []
    return "; ".join(parts)


@dataclass(frozen=True, eq=False)
class DrawnTruth:
    """Ground truth of the events that the inspector draws."""

    truth: Truth | None
    """Ground truth of the whole recording; None if the recording has none."""
    span: Span
    """Time span from which the drawn events are a selection."""
    positions: NDArray[np.int64]
    """Indices of the drawn events in ``span.events``, shape ``(n,)``."""
    _read: dict[Colour, NDArray[Any]] = field(default_factory=dict)

    def values(self, colour: Colour) -> NDArray[Any]:
        """Return the values of the drawn events that a colour shows, shape ``(n,)``.

        The values are codes of causes, instance numbers, or depths [m]. Raises :class:`AmiwarpError` if the recording
        does not hold this ground truth.
        """
        if colour not in self._read:
            store = getattr(self.truth, STORES[colour], None)
            if store is None:
                given = ", ".join(c.value for c in colours_on_offer(self.truth))
                raise AmiwarpError(
                    f"colour {colour.value!r} needs ground truth that the recording does not hold; choose among {given}"
                )
            self._read[colour] = self.span.rows(store)[self.positions]
        return self._read[colour]

    def name(self, colour: Colour, number: int) -> str:
        """Return the name of the cause with the code ``number``, or of the instance with this number."""
        if colour is Colour.CAUSE:
            return list(Cause)[number].value.replace("_", " ") if number < len(Cause) else f"cause {number}"
        labels = () if self.truth is None or self.truth.labels is None else self.truth.labels.instances
        return "sky" if number == 0 else labels[number - 1] if number <= len(labels) else f"instance {number}"

    def text(self, k: int) -> str:
        """Return the known ground truth of the drawn event ``k`` as text: cause, instance and depth."""
        known = [c for c in colours_on_offer(self.truth) if c in STORES]
        return "; ".join(
            f"depth {self.values(c)[k]:.3f} m" if c is Colour.DEPTH else f"{c.value} {self.name(c, self.values(c)[k])}"
            for c in known
        )


# Parameters of the prism and selection of events under which the inspector shows a recording.


class Source(enum.StrEnum):
    """Where the value of a parameter comes from. The value of a member is the text that the page shows."""

    ASSUMED = "assumed"
    ESTIMATED = "estimated"
    FILE = "from the file"
    CALIBRATED = "calibrated"
    HAND = "set by hand"
    TRUTH = "known truth"


@dataclass(frozen=True)
class Knobs:
    """Parameters of the prism that the page's sliders set."""

    model: str = "exact"
    """Name of the optical model."""
    apex: float = 0.0
    """Apex angle of the prism [rad]. Other optics have their size among :attr:`others`."""
    phase: float = 0.0
    """Phase θ_b of the prism [rad]."""
    clock_offset: float = 0.0
    """Offset between the clocks of encoder and camera, as in :class:`Encoder` [us]."""
    rpm: float = 0.0
    """Speed of the prism if the recording has no encoder [1/min]."""
    focal_length: float | None = None
    """Calibrated focal length [px]; None: that of the camera."""
    others: tuple[tuple[str, float], ...] = ()
    """Names and values of other parameters of optical models that are not 0, sorted by name."""

    @classmethod
    def given(cls, values: Mapping[str, float], **known: Any) -> Knobs:
        """Return parameters with ``known`` fields, and the other parameters of optical models among the ``values``."""
        return cls(**known).with_values({name: values[name] for name in OTHERS if name in values})

    def value(self, name: str) -> float | None:
        """Return the value of a parameter; None if it is not known and has no slider."""
        if name not in OTHERS:
            return getattr(self, name)
        return dict(self.others).get(name, 0.0 if name in SLIDING else None)

    def with_values(self, values: Mapping[str, float]) -> Knobs:
        """Return the parameters with other values of some of them."""
        others = dict(self.others) | {name: value for name, value in values.items() if name in OTHERS}
        fields: dict[str, Any] = {name: value for name, value in values.items() if name not in OTHERS}
        return replace(self, **fields, others=tuple(sorted((n, v) for n, v in others.items() if v)))

    @property
    def calibrated_only(self) -> dict[str, float]:
        """Parameters by name that the page cannot change, and that a calibration or the known truth gave."""
        found = {name: self.value(name) for name in (*(n for n in OTHERS if n not in SLIDING), "focal_length")}
        return {name: value for name, value in found.items() if value is not None}


def size_name(model: str) -> str:
    """Return the name of the parameter that the slider of a model's size sets: for all models of wedges the apex."""
    kind = MODELS[model]
    return "apex" if kind.PRISM and kind.GLASS is Prism else kind.SIZE


WEDGE_SIZES = {kind.SIZE for name, kind in MODELS.items() if size_name(name) == "apex"}
"""Names of the sizes of models that the slider of the apex sets."""
OTHERS = {name: p for name, p in optical_parameters().items() if name not in (*WEDGE_SIZES, PHASE.name)}
"""Parameters of the optical models but for phase and sizes of wedges, by name."""
SLIDING = {name: p for name, p in OTHERS.items() if p.label}
"""Those among :data:`OTHERS` that have a slider."""


def foreign_names(model: str) -> set[str]:
    """Return the names among :data:`OTHERS` of parameters that no model of the same optic has."""
    return OTHERS.keys() - {name for each in alternatives(model).values() for name in each.FREE}


CURVE_HALF_WIDTH = {
    "apex": math.radians(0.4), "phase": math.radians(30.0), "clock_offset": 5000.0, "rpm": 6.0,
    **{name: p.half_range for name, p in SLIDING.items()},
}  # fmt: skip
"""Half width of the range of each parameter over which its sharpness curve is drawn, in the parameter's unit."""


# Time windows of the inspector: their selected events, and what the page shows of them.


@dataclass(frozen=True, eq=False)
class DrawnWindow:
    """Selected events of a time window that are drawn as points."""

    span: Span
    """Time window, with all events that were read from it."""
    region: Region
    """Part of the image that is shown."""
    selected: int
    """Number of selected events, which are all in the images."""
    events: Events
    """Events that are drawn as points."""
    truth: DrawnTruth
    """Ground truth of these events."""
    before: NDArray[np.float32]
    """Pixels of the drawn events as recorded [px], shape ``(n, 2)``."""
    steps: tuple[FilterStep, ...]
    """Numbers of events before and after each part of the selection."""

    @property
    def read_us(self) -> float:
        """Time of which events were read [us]; of a window with too many events, that of its runs."""
        return max(1.0, self.span.length_us * len(self.span.events) / max(self.span.count, 1))


@dataclass(frozen=True, eq=False)
class LoadedWindow(DrawnWindow):
    """Selected events of a window, in memory and on the device, and their image without compensation."""

    counted: Events
    """Events of the images: the selected events, and those near the region that compensation may move into it."""
    angles: dict[float, tuple[UploadedEvents, NDArray[np.float64], NDArray[np.float64]]] = field(default_factory=dict)
    """Events on the device, prism angles [rad] and speeds [rad/us] of the drawn events, without the clock offset set on
    the page, by the speed of a prism without encoder [1/min]; with an encoder, the only key is 0."""
    wrapped: dict[tuple[float, float], NDArray[np.float64]] = field(default_factory=dict)
    """Last prism angles of the drawn events, from 0 to 2π [rad], by speed and drift of the clock offset."""
    unmoved: list[tuple[NDArray[np.float32], float]] = field(default_factory=list)
    """Image of the events as recorded and its sharpness, once it is measured."""
    chosen: list[Picture] = field(default_factory=list)
    """Reconstructed picture for which the weight of the smoothness prior was chosen last."""


@dataclass(frozen=True, eq=False)
class DisplayedWindow(DrawnWindow):
    """Time window shown with the current parameters: images of all events, and points of evenly spaced events."""

    after: NDArray[np.float32]
    """Compensated positions of the drawn events [px], shape ``(n, 2)``; NaN if the model has no solution."""
    theta: NDArray[np.float64]
    """Prism angles of the drawn events [rad], from 0 to 2π, shape ``(n,)``."""
    image_before: NDArray[np.float32]
    """Number of events at each pixel as recorded, shape ``(height, width)``."""
    image_after: NDArray[np.float32]
    """Number of compensated events at each pixel, shape ``(height, width)``."""
    sharpness_before: float
    """Sharpness of ``image_before`` in the region: 0 for events at random, whatever their number."""
    sharpness_after: float
    """Sharpness of ``image_after`` in the region."""
    beside: DisplayedWindow | None = None
    """The same time of another recording, whose events, as recorded, the first cloud and image show instead."""
    is_beside: bool = False
    """Whether this is another recording, of which less may be known."""
    offset_us: int = 0
    """Time of its first event after the first event of the recording whose time axis it shares [us]."""

    @property
    def first(self) -> DisplayedWindow:
        """What the first cloud shows."""
        return self.beside or self

    def every(self, step: int) -> DisplayedWindow:
        """Return the window with every ``step``-th point."""
        if step == 1:
            return self
        read = {colour: values[::step] for colour, values in self.truth._read.items()}
        truth = replace(self.truth, positions=self.truth.positions[::step], _read=read)
        return replace(self, events=self.events[::step], truth=truth, before=self.before[::step],
                       after=self.after[::step], theta=self.theta[::step])  # fmt: skip


# Selected events of a time window, on the host and with their prism angles on the device.

MOST_POINTS, WINDOW_POINTS = 100_000, 1_000_000
"""Largest number of points in each event cloud: of the page, and of the window or a browser with a graphics card."""
CURVE_EVENTS = 200_000
"""Largest number of events that a sharpness curve uses."""
INTERVALS_US = np.logspace(0, 6, 49)
"""Edges of the bins of the histogram of intervals [us]: eight bins per decade, from 1 us to 1 s."""
MOST_EVENTS = 2_000_000
"""Largest number of events in the image of a window. Of a fuller window, evenly spaced runs are read."""
FOV_DEG = 60.0
"""Horizontal field of view that is assumed if the camera is unknown [deg]."""
NO_ENCODER = "no encoder: set the prism's speed (rpm), or calibrate, to compensate its motion"
NO_CAMERA = f"camera unknown: {FOV_DEG:g}° field of view assumed; set it, or give it with --fov-deg or --camera"
CURVE_POINTS, ORBIT_POINTS = 25, 181
"""Number of points of a sharpness curve, and of the drawn orbit of a scene point."""
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
        most_points: int | None = None,
    ) -> None:
        """Start with a recording; a calibration sets the prism's parameters.

        ``latest`` returns the current events of a live stream, see :meth:`renew`. ``most_points``: largest number of
        points in each cloud, by default :data:`MOST_POINTS`. Raises :class:`AmiwarpError` if there are no events, or
        if the calibration belongs to another camera.
        """
        source = recording.events
        if not len(source):
            raise AmiwarpError(f"{recording.name}: holds no events; give a recording with events")
        path = None if calibration is None or recording.encoder is not None else calibration.path
        if path is not None and path.covers(source.t_first, source.t_last):
            recording = replace(recording, encoder=path)
        self._no_speed = recording.encoder is None and calibration is None
        self.sources = {
            "camera": Source.ASSUMED if recording.camera is None else Source.FILE,
            "prism": Source.ASSUMED if recording.prism is None else Source.FILE,
            "apex": Source.ASSUMED if getattr(recording.prism, "apex", None) is None else Source.FILE,
            **dict.fromkeys(("model", "phase", *SLIDING), Source.ASSUMED),
            **({"rpm": Source.ASSUMED} if recording.encoder is None else {"clock_offset": Source.FILE}),
        }
        """Where the value of each parameter that the page shows, the camera, and the prism's index come from."""
        if recording.camera is None:
            recording = replace(recording, camera=Camera.from_fov(*source.size, math.radians(FOV_DEG)))
        self.recording, self.device, self.latest = recording, device, latest
        self.prism = nominal(recording.prism)
        """Nominal glass of the recording; a prism with an assumed apex if it is unknown."""
        self.zero_us = (source.t_first + source.t_last) // 2
        """Time at which the prism angle is 0 if there is no encoder [us]."""
        best, ratio, second = self._best_model, None if recording.encoder is None else recording.encoder.ratio, {}
        if ratio is not None:  # of a pair of prisms
            second = {"second_apex": (as_wedge(self.prism).second or as_wedge(self.prism)).apex, "ratio": ratio}
        self.knobs = Knobs.given(
            second | self._typical_size(best), model=best, apex=self.nominal_apex,
            clock_offset=self._recorded_offset_us,
        )  # fmt: skip
        self.window: tuple[int, int] | None = None
        """Start and length of the time window [us]; None: that of :meth:`first_window`."""
        self.fixed_count: int | None = None
        """Number of events of each time window that is opened, from its start on; None: windows have their length."""
        self.path: Path | None = None
        """File of the recording, beside which its bookmarks are; None if it is not a file."""
        self.bookmark = ""
        """Name of the bookmark that page and window show first; empty for none."""
        self.selection = Selection()
        self.most_points = most_points or MOST_POINTS
        """Largest number of points in each event cloud."""
        self.besides: tuple[Inspector, ...] = ()
        """Other recordings on the time axis of this one, see :meth:`put_beside`."""
        self.beside: Inspector | None = None
        """The one of them that is shown beside this one."""
        self.offset_us = 0
        """Of a recording beside another one: time of its first event after that one's first event [us]."""
        self._angles_are_lent = False  # of a recording beside another one, whose encoder it uses
        self.depth: DepthMap | None = None
        """Depths of what the pixels see through a plate, see :meth:`use_depths`."""
        self._is_beside = False
        self._found: tuple[Knobs, Calibration] | None = None
        self._harmonics: tuple[float, ...] | None = None
        self._mended: Encoder | None = None  # angles that a calibration found in place of those of the encoder
        self._window: LoadedWindow | None = None
        self._span: Span | None = None
        self._closing = Event()
        self.lock = Lock()
        """Lock for the events on the device and the buffers of their images."""
        self._imager = RegionSharpness(source.size, device)
        self._votes: dict[bool, Votes] = {}
        if calibration is not None:
            self.accept(calibration)

    def copy(self) -> Inspector:
        """Return an inspector that shows the same, with buffers of its own, for another thread."""
        made, size = copy(self), self.recording.events.size
        made.lock, made._votes, made.sources = Lock(), {}, dict(self.sources)
        made._imager = RegionSharpness(size, self.device)
        made._window = made._span = None
        made.besides, made.beside = tuple(each.copy() for each in self.besides), None
        if self.beside is not None:
            made.beside = made.besides[self.besides.index(self.beside)]
        return made

    def snapshot(self) -> Inspector:
        """Return an inspector of what is shown now, for work in another thread that takes long.

        It shares window and buffers, but what is set or renewed in this inspector meanwhile does not change it: a live
        stream goes on to events and angles that do not belong together with the window.
        """
        made = copy(self)
        made.sources = dict(self.sources)
        return made

    @property
    def closed(self) -> bool:
        """Whether nobody looks any more: measuring the sharpness then raises :class:`AmiwarpError`."""
        return self._closing.is_set()

    def close(self) -> None:
        """End the measurements of this inspector, and of its copies."""
        self._closing.set()

    @property
    def camera(self) -> Camera:
        """Camera of the calibration or of the recording; an assumed camera if both lack it."""
        assert self.recording.camera is not None
        return self.recording.camera

    @property
    def notes(self) -> tuple[str, ...]:
        """What is missing to compensate the prism's motion, one sentence each."""
        no_speed = self._no_speed and not self.knobs.rpm
        return (NO_ENCODER,) * no_speed + (NO_CAMERA,) * (self.sources["camera"] is Source.ASSUMED)

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view of the camera [deg]."""
        return round(2.0 * math.degrees(math.atan(0.5 * self.camera.width / self.camera.fx)), 4)

    def set_camera(self, fov_deg: float) -> None:
        """Set a camera with a horizontal field of view [deg], without distortion. The window is read again."""
        camera = Camera.from_fov(*self.recording.events.size, math.radians(fov_deg))
        self.recording, self.sources["camera"] = replace(self.recording, camera=camera), Source.HAND
        self._window = None

    def set_index(self, index: float) -> None:
        """Set the refractive index of the prism."""
        self.prism, self.sources["prism"] = replace(self.prism, index=index), Source.HAND

    @property
    def nominal_prism(self) -> NominalPrism | None:
        """Prism of the recording, or the one that was set by hand; None if neither is known."""
        given = self.recording.prism
        if Source.HAND in (self.sources["prism"], None if given is not None else self.sources["apex"]):
            return replace(as_wedge(self.prism), apex=self.knobs.apex)
        return given

    @property
    def nominal_apex(self) -> float:
        """Apex angle of the nominal prism [rad]; 0 for a plate."""
        return self.prism.apex if isinstance(self.prism, Prism) else 0.0

    @property
    def has_encoder(self) -> bool:
        """Whether the recording has an encoder."""
        return self.recording.encoder is not None

    @property
    def has_optic(self) -> bool:
        """Whether anything says that the camera looks through an optic that moves: else it is a plain recording."""
        known = any(source is not Source.ASSUMED for name, source in self.sources.items() if name != "camera")
        return known or self.has_encoder or self.recording.prism is not None

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
        return self._corrected or constant_speed(rpm, source.t_first, source.t_last, self.zero_us)

    @cached_property
    def _corrected(self) -> Encoder | None:
        """The recording's encoder without the errors that a calibration found in it; None if there is no encoder."""
        encoder, harmonics = self.recording.encoder, self._harmonics
        if encoder is not None and self._mended is not None:
            encoder = replace(self._mended, clock_offset_us=encoder.clock_offset_us)
        return encoder if encoder is None or harmonics is None else encoder.with_harmonics(harmonics)

    @property
    def _best_model(self) -> str:
        """Name of the best model of the recording's optic; a pair of prisms if two angles may be theirs."""
        return best_model(self.recording) or RisleyModel.NAME

    def _typical_size(self, model: str) -> dict[str, float]:
        """Return the size with which a model of another optic than a wedge starts; none for a wedge."""
        size = size_name(model)
        return {} if size == "apex" else {size: MODELS[model].typical_size(self.camera, self.prism)}

    def use_model(self, model: str) -> None:
        """Set the optical model. A size of which nothing is known starts at a typical value."""
        size = self._typical_size(model)
        self.set(replace(self.knobs, model=model))
        if not all(map(self.knobs.value, size)):
            self.knobs = self.knobs.with_values(size)

    def use_depths(self, depth: DepthMap) -> None:
        """Compensate each event at the depth of what its pixel sees, as :func:`amiwarp.compensate` does.

        Raises :class:`AmiwarpError` for another optic than a plate, or a map of another size.
        """
        table = at_depths(self.model, depth).depths
        assert table is not None
        self.depth, self._depths, self._window = depth, table, None

    @property
    def orbit_names(self) -> tuple[str, ...]:
        """Names of size and phase, as far as they have a slider: with a depth map, there is no size to set."""
        return (*((size_name(self.knobs.model),) if self.depth is None else ()), PHASE.name)

    @property
    def margin_px(self) -> int:
        """How far outside a region the events of its images may be: how far the optic may move them [px]."""
        if not self.has_optic:
            return 0
        if isinstance(self.prism, Plate):
            reach = self.prism.shift * (LARGEST_INVERSE if self.depth is None else float(self._depths.max()))
        else:
            largest = replace(self.prism, apex=max(LARGEST_APEX, 2.0 * self.prism.apex))
            reach = math.tan(abs(largest.deflection))
        return math.ceil(1.2 * reach * max(self.camera.fx, self.camera.fy))

    @property
    def model(self) -> Model:
        """Optical model with the parameters that are set on the page."""
        return self.model_of(self.knobs)

    @property
    def hot(self) -> NDArray[np.bool_]:
        """Hot pixels of the recording, and behind a prism that rotates the flickering ones; shape (height, width)."""
        return self._searched[0]

    @property
    def hot_pixels(self) -> tuple[HotPixel, ...]:
        """The pixels of :attr:`hot`, the busiest first. Rates and shares are of the part that was searched for them."""
        return self._searched[1]

    @cached_property
    def _searched(self) -> tuple[NDArray[np.bool_], tuple[HotPixel, ...]]:
        """Hot pixels as a mask and as a list, found in the middle of the recording."""
        source, encoder = self.recording.events, self.encoder
        events = stretch(source, encoder)
        turns = math.isfinite(self.turn_us)
        hot = strange_pixels(events, encoder, source.size)[0] if turns else find_hot_pixels(events, source.size)
        return hot, list_hot_pixels(events, hot)

    def first_window(self) -> tuple[int, int]:
        """Return start and length of one turn in the middle of the recording [us].

        If the prism does not rotate, the length is :data:`WINDOW_US`, and at most a fifth of the recording, so that it
        can be played.
        """
        source = self.recording.events
        whole = source.t_last - source.t_first + 1
        still = min(WINDOW_US, max(1, whole // 5))
        length = min(round(self.turn_us) if math.isfinite(self.turn_us) else still, whole)
        return source.t_first + (whole - length) // 2, length

    def window_of(self, start_us: int, count: int) -> tuple[int, int]:
        """Return start and length of the time window [us] from a start on that holds a number of events.

        It starts earlier if too few events follow. Events of equal time stay together, so it may hold a few more.
        """
        source = self.recording.events
        count = min(max(1, count), len(source))
        first = source.find(start_us)
        if first > len(source) - count:
            first = len(source) - count
            start_us = int(source.slice(first, first + 1).t[0])
        last = int(source.slice(first + count - 1, first + count).t[0])
        return start_us, last - start_us + 1

    def start_after(self, windows: int) -> int:
        """Return the start of the window [us] that lies by a number of windows of equal count after the current one."""
        source = self.recording.events
        start_us, length_us = self.window or self.first_window()
        if windows >= 0:
            index = source.find(start_us + length_us) + (windows - 1) * (self.fixed_count or 1)
        else:
            index = source.find(start_us) + windows * (self.fixed_count or 1)
        index = min(max(index, 0), len(source) - 1)
        return int(source.slice(index, index + 1).t[0])

    def renew(self) -> None:
        """Take the current events of a live stream; call :meth:`open` afterwards.

        Raises the errors of the function ``latest``.
        """
        if self.latest is not None:
            recording = self.latest()
            self.recording = replace(self.recording, events=recording.events, encoder=recording.encoder)
            self._span = None
            self._forget_angles()

    def _forget_angles(self) -> None:
        """Forget what depends on the encoder's angles."""
        for name in ("_searched", "_corrected"):
            self.__dict__.pop(name, None)
        if self._window is not None:
            self._window.angles.clear()
            self._window.wrapped.clear()

    def accept(self, calibration: Calibration) -> None:
        """Set the parameters to a calibration. Raises :class:`AmiwarpError` if its camera has another size."""
        size, given = self.recording.events.size, (calibration.camera.width, calibration.camera.height)
        if given != size:
            raise AmiwarpError(
                f"the calibration is of {given[0]}x{given[1]} pixels, the events are of {size[0]}x{size[1]}; "
                "calibrate this recording"
            )
        self.prism, self.recording = calibration.prism, replace(self.recording, camera=calibration.camera)
        self._harmonics = calibration.harmonics
        own, path = self.recording.encoder, calibration.path
        self._mended = path if own is not None and path is not None and replaces(path, own) else None
        self._forget_angles()
        self.set(self.knobs_of(calibration))
        found, free = (
            {"apex" if name in WEDGE_SIZES else name for name in names} & set(self.sources)
            for names in (calibration.parameters, calibration.free)
        )
        self.sources |= dict.fromkeys(found, Source.FILE) | dict.fromkeys(("model", *free), Source.CALIBRATED)
        self._found = self.knobs, calibration

    def knobs_of(self, calibration: Calibration) -> Knobs:
        """Return the parameters of a calibration of this camera, with the phase at the inspector's angle zero."""
        p, prism = calibration.parameters, calibration.prism
        kind, rpm = MODELS[calibration.model_name], p.get("rpm", 0.0)
        if calibration.zero_us is not None:
            p = kind.turned_values(p, rpm * math.tau / 60e6 * (self.zero_us - calibration.zero_us))
        offset = p.get("clock_offset", self._recorded_offset_us)
        apex = kind.apex_from_size(p[kind.SIZE], as_wedge(prism)) if kind.SIZE in WEDGE_SIZES else self.knobs.apex
        return Knobs.given(
            p, model=kind.NAME, apex=apex, phase=p["phase"], clock_offset=offset, rpm=rpm,
            focal_length=p.get("focal_length"),
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
        return Knobs.given(
            p, model=self._best_model, apex=p["apex"], phase=p["phase"], clock_offset=offset, rpm=self.knobs.rpm
        )

    def take_truth(self) -> None:
        """Set the parameters to the known truth. Raises :class:`AmiwarpError` if the recording has none."""
        if self.truth is None:
            raise AmiwarpError(f"{self.recording.name}: holds no true parameters of its prism; simulate a recording")
        self.set(self.truth)
        known = set(self.sources) - {"camera", "prism", "rpm"} - foreign_names(self.truth.model)
        self.sources |= dict.fromkeys(known, Source.TRUTH)

    def as_calibration(self) -> Calibration:
        """Return the accepted calibration if no parameter was changed since, else one of the current parameters."""
        if self._found is not None and self._found[0] == self.knobs:
            return self._found[1]
        k, w, values = self.knobs, self.loaded, self._values(self.knobs)
        kind = MODELS[k.model]
        others = [name for name in kind.FREE if name in SLIDING]
        time = {"clock_offset": k.clock_offset} if self.has_encoder else {"rpm": k.rpm}
        kept = {name: values[name] for name in (kind.SIZE, *others, "phase", *k.calibrated_only)} | time
        with self.lock:
            before, after = (self._imager.measure(*self.warped(w, each), w.region)[0] for each in (None, k))
        return Calibration(
            model_name=k.model, camera=self.camera, prism=nominal(self.prism, kind), parameters=kept, uncertainty={},
            free=(), sharpness_name=Sharpness.VARIANCE.value, sharpness_before=before, sharpness_after=after,
            stages=(), events=len(w.counted), seconds=0.0, warnings=("set by hand in the inspector",),
            zero_us=None if self.has_encoder else self.zero_us, harmonics=self._harmonics,
            path=self._mended,
        )  # fmt: skip

    def set(self, knobs: Knobs) -> None:
        """Set the parameters of the prism. Parameters that change count as set by hand.

        Raises :class:`AmiwarpError` for a model of another number of prisms than the recording has.
        """
        check_prisms(self._encoder(0.0), MODELS[knobs.model].ANGLES)
        shown = self.sources.keys() - {"camera", "prism"}
        changed = {name for name in shown if knobs.value(name) != self.knobs.value(name)}
        had_optic = self.has_optic
        self.sources |= dict.fromkeys(changed, Source.HAND)
        self.knobs = knobs
        if self.has_optic != had_optic:  # events around the region may now be moved into it
            self._window = None

    def open(self, start_us: int, length_us: int, selection: Selection | None = None) -> None:
        """Read a time window of events. With a :attr:`fixed_count`, the length follows from it.

        Raises :class:`AmiwarpError` if it has no events that meet the ``selection``.
        """
        chosen = selection or self.selection
        if self.fixed_count is not None:
            start_us, length_us = self.window_of(start_us, self.fixed_count)
        self._window = self._load(start_us, max(1, length_us), chosen)
        self.selection, self.window = chosen, (start_us, length_us)

    @property
    def chosen(self) -> tuple[tuple[int, int] | None, Selection]:
        """Time window and selection, by which is known whether something was computed for other ones."""
        return self.window, self.selection

    def suggest_region(self) -> Region:
        """Return the region in which compensation gains most sharpness in the current time window."""
        loaded = self.loaded
        if self.selection.region is not None:
            loaded = self._load(loaded.span.start_us, loaded.span.length_us, replace(self.selection, region=None))
        (before, _), (after, _) = self._measured(loaded, None), self._measured(loaded, self.knobs)
        return suggest_region(before, after, margin=math.ceil(self.orbit_px))

    @property
    def orbit_px(self) -> float:
        """Largest displacement of a scene point by the optic, in x or in y, at the image's border [px]."""
        return float(np.abs(border_displacements(self.model)).max(initial=0.0))

    def put_beside(self, recording: Recording, offset_us: int = 0) -> None:
        """Put another recording on the time axis of this one. The first one is shown beside it: its events as recorded.

        ``offset_us``: time of its first event after this recording's first event [us]. Without an encoder it gets the
        prism's angles of this recording at these times, with the speed and the clock offset that are set for this one:
        :attr:`angles_lent` says so. Raises :class:`AmiwarpError` if it has no events, or another number of pixels.
        """
        source, size = recording.events, self.recording.events.size
        if source.size != size:
            raise AmiwarpError(
                f"{recording.name}: has {source.size[0]}x{source.size[1]} pixels, {self.recording.name} has "
                f"{size[0]}x{size[1]}; give two recordings of one size"
            )
        own = self.recording.encoder
        lent = recording.encoder is None
        if recording.encoder is None and own is not None and len(source):
            shift = source.t_first - self.recording.events.t_first - offset_us
            recording = replace(recording, encoder=Encoder(own.t + shift, own.angle, own.clock_offset_us))
        made = Inspector(recording, device=self.device, most_points=self.most_points)
        made._is_beside, made.offset_us, made._angles_are_lent = True, offset_us, lent
        made.zero_us = source.t_first + self.zero_us - self.recording.events.t_first - offset_us
        self.besides = (*self.besides, made)
        self.beside = self.beside or made

    @property
    def angles_lent(self) -> bool:
        """Whether the recording beside has no encoder of its own, and is shown at this recording's prism angles."""
        return self.beside is not None and self.beside._angles_are_lent

    def time_of(self, t_us: int) -> int:
        """Return the time on the clock of this recording beside another one, by the time after that one's first event.

        Both are in us.
        """
        return self.recording.events.t_first + t_us - self.offset_us

    def counts_beside(self, span: Span) -> list[int]:
        """Return how many events each recording on this time axis has in the time of a span, whatever is selected."""
        start_us = span.start_us - span.first_us
        ends = [[each.time_of(t_us) for t_us in (start_us, start_us + span.length_us)] for each in self.besides]
        sources = [each.recording.events for each in self.besides]
        return [source.find(stop) - source.find(start) for source, (start, stop) in zip(sources, ends, strict=True)]

    def _beside(
        self, span: Span, selection: Selection, image_after: NDArray[np.float32], lent: Knobs | None
    ) -> DisplayedWindow:
        """Return what this recording, as recorded, shows beside another one in the time of that one's ``span``.

        ``image_after``: compensated image of the other recording, which sets the scale of colours. ``lent``: parameters
        of the other one whose speed and clock offset this one gets; None for its own.
        """
        if lent is not None:
            self.knobs = replace(self.knobs, rpm=lent.rpm, clock_offset=lent.clock_offset)
        window = self.time_of(span.start_us - span.first_us), span.length_us
        if (window, selection) != (self.window, self.selection):
            self.open(*window, selection)
        w = self.loaded
        image, sharpness = self._measured(w, None)
        return DisplayedWindow(
            w.span, w.region, w.selected, w.events, w.truth, w.before, w.steps, w.before,
            self._wrapped(w, self.knobs), image, image_after, sharpness, sharpness, is_beside=True,
            offset_us=self.offset_us,
        )  # fmt: skip

    def show(self, knobs: Knobs | None = None, *, against: Knobs | None = None) -> DisplayedWindow:
        """Return the time window's images and points.

        ``knobs``: parameters to show, by default the current ones. ``against``: parameters to compare with; they
        replace the recorded events as the first of the two clouds and images. Without them, the first ones show the
        recording beside, if there is one.
        """
        w, knobs = self.loaded, knobs or self.knobs
        xy = w.before if against is None else self._moved(w, against)
        (image_after, sharpness_after), other = self._measured(w, knobs), None
        if self.beside is not None and against is None:
            lent = knobs if self.angles_lent else None
            other = self.beside._beside(w.span, self.selection, image_after, lent)
            image, sharpness = other.image_before, other.sharpness_before
        else:
            image, sharpness = self._measured(w, against)
        return DisplayedWindow(
            w.span, w.region, w.selected, w.events, w.truth, xy, w.steps, self._moved(w, knobs),
            self._wrapped(w, knobs), image, image_after, sharpness, sharpness_after, other,
        )  # fmt: skip

    def curve(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return values of a parameter around its current one, in its unit, and the sharpness at each of them."""
        values, sharpness = np.array([*self.curve_points(name)], np.float64).reshape(-1, 2).T
        return values, sharpness

    def curve_points(self, name: str) -> Iterator[tuple[float, float]]:
        """Yield the points of :meth:`curve` one after the other."""
        knobs, half, sharpness = self.knobs, CURVE_HALF_WIDTH[name], self.sharpness_meter()
        values = (knobs.value(name) or 0.0) + np.linspace(-half, half, CURVE_POINTS)
        for value in values[values >= 0.0].tolist() if name == size_name(knobs.model) else values.tolist():
            yield value, sharpness(knobs.with_values({name: value}))

    def sharpness_meter(self) -> Callable[[Knobs | None], float]:
        """Return a function that measures the sharpness of part of the window's events with given parameters.

        Without parameters, it measures the events as recorded. It uses at most :data:`CURVE_EVENTS`, and has buffers of
        its own, for one thread.
        """
        w, imager = self.loaded, RegionSharpness(self.recording.events.size, self.device)
        part = w.counted[:: max(1, -(-len(w.counted) // CURVE_EVENTS))]
        undrawn = replace(w, counted=part, events=w.events[:0], angles={})

        def sharpness(knobs: Knobs | None) -> float:
            if self.closed:
                raise AmiwarpError(f"{self.recording.name}: is closed")
            return imager.measure(*self.warped(undrawn, knobs), w.region)[1]

        return sharpness

    def statistics(self) -> dict[str, Any]:
        """Return the statistics of the selected events of the time window for page and window.

        They are rows of name and value, and the shares [%] and the median of the intervals between successive events of
        a pixel, over the logarithm of the interval [us]. Intervals between runs are not counted. Those under 1 us are
        in the first bin, those over 1 s in the last one.
        """
        events, span, (left, top, right, bottom) = self.loaded.counted, self.loaded.span, self.loaded.region
        events = events[inside(events, self.loaded.region)]
        run = np.searchsorted(span.run_starts, events.t, side="right")
        pixel = (run * (bottom - top) + events.y.astype(np.int64) - top) * (right - left) + events.x - left
        order = np.argsort(pixel, kind="stable")
        steps = np.diff(events.t[order])[np.diff(pixel[order]) == 0]
        counts, _ = np.histogram(np.clip(steps, 1, 999_999), INTERVALS_US)
        n, area, known, decades = len(events), (right - left) * (bottom - top), bool(len(steps)), np.log10(INTERVALS_US)
        pixels, read_us = len(np.unique(pixel % area)), self.loaded.read_us
        median_us = float(np.median(steps)) if known else math.nan
        rows = [
            ("rate", f"{n / read_us * 1e6:,.0f} events/s"), ("events per pixel", f"{n / area:.3g}"),
            ("ON", f"{100.0 * events.p.mean():.1f} %"), ("pixels with events", f"{100.0 * pixels / area:.1f} %"),
            ("median interval of a pixel", f"{median_us:,.0f} µs" if known else "–"),
        ]  # fmt: skip
        return {
            "rows": [list(row) for row in rows], "x": (0.5 * (decades[1:] + decades[:-1])).tolist() if known else [],
            "y": (100.0 * counts / max(1, counts.sum())).tolist(),
            "median": math.log10(max(median_us, 1.0)) if known else None,
        }  # fmt: skip

    def orbit(self, x: float, y: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return the orbit of the scene point that would appear at (x, y) [px] without the prism.

        Returns prism angles over one turn [rad], shape ``(n,)``, and pixels, shape ``(n, 2)``.
        """
        theta, model = np.linspace(0.0, math.tau, ORBIT_POINTS), self.model
        point = np.broadcast_to(np.array([[x, y]], np.float32), (len(theta), 2))
        if isinstance(model, PlateModel) and model.depths is not None:  # the point has one depth
            at = np.clip(np.rint(np.nan_to_num([y, x])).astype(int), 0, np.array(model.depths.shape) - 1)
            model = replace(model, depths=None, inverse_depth=float(model.depths[*at]))
        return theta, model.deflect_points(point, theta.astype(np.float32))

    @property
    def _recorded_offset_us(self) -> float:
        """Clock offset of the recording's own encoder [us]."""
        return 0.0 if self.recording.encoder is None else self.recording.encoder.clock_offset_us

    @property
    def loaded(self) -> LoadedWindow:
        """Selected events of the time window. They are read first if necessary."""
        if self._window is None:
            self.open(*(self.window or self.first_window()))
        assert self._window is not None
        return self._window

    def _values(self, knobs: Knobs) -> dict[str, float]:
        """Return the values of the optical model's parameters.

        A prism that does not rotate gets apex 0 and no cylinder power, so that nothing is compensated.
        """
        turns, more = bool(self.has_encoder or knobs.rpm), knobs.calibrated_only
        others = {name: (knobs.value(name) if turns else None) or 0.0 for name in SLIDING}
        kind, values = MODELS[knobs.model], {**more, **others, "phase": knobs.phase}
        if kind.SIZE in WEDGE_SIZES:
            wedge = replace(as_wedge(self.prism), index=more.get("index", self.prism.index))
            values[kind.SIZE] = kind.size_from_apex(knobs.apex if turns else 0.0, wedge)
        return values

    def model_of(
        self, knobs: Knobs, camera: Camera | None = None, part: tuple[slice, slice] = (slice(None), slice(None))
    ) -> Model:
        """Return the optical model with given parameters.

        ``camera``: another camera than the recording's, which sees these rows and columns of its pixels.
        """
        model = build_model(knobs.model, camera or self.camera, self.prism, self._values(knobs))
        if self.depth is None or not isinstance(model, PlateModel) or not model.inverse_depth:  # of 0, nothing moves
            return model
        return model.with_depths(self._depths[part])

    def encoder_of(self, knobs: Knobs) -> Encoder:
        """Return the encoder with the clock offset or the speed of given parameters."""
        encoder = self._encoder(knobs.rpm)
        return encoder.with_clock_offset(knobs.clock_offset) if self.has_encoder else encoder

    def warped(self, w: LoadedWindow, knobs: Knobs | None) -> tuple[Model, UploadedEvents, float]:
        """Return the model, the events on the device and their drift [us], to vote the events of a window.

        ``knobs``: the parameters; None for the events as recorded.
        """
        given = knobs or replace(self.knobs, model=self._best_model, apex=0.0, others=())  # which move no event
        return self.model_of(given), self._angles(w, given)[0], self._drift_us(given)

    def _load(self, start_us: int, length_us: int, selection: Selection) -> LoadedWindow:
        """Read and select the events of a time window. The events of the last one are not read again."""
        if self._span is None or (self._span.start_us, self._span.length_us) != (start_us, length_us):
            span = read_span(self.recording.events, start_us, length_us, most_events=MOST_EVENTS)
            self._span = _in_pixels(span, self.recording.events.size) if self._is_beside else span
        return self.select(self._span, selection)

    def select(self, span: Span, selection: Selection) -> LoadedWindow:
        """Select the events of a time window. Raises :class:`AmiwarpError` if no event meets the selection."""
        recording = self.recording
        region = selection.region or (0, 0, *recording.events.size)
        running = self.selected_events(selection)
        keep = running.keep(span.events)
        if span.places is not None:  # compensated events outside of the image have no pixel
            half = np.array(recording.events.size) / 2.0
            keep &= (np.abs(span.places + 0.5 - half) <= half).all(axis=1)
        near = None if keep.all() else np.flatnonzero(keep)  # None stands for all
        events = span.events if near is None else span.events[near]
        within = np.flatnonzero(inside(events, region)) if selection.region else None
        n = len(events) if within is None else len(within)
        if not n:
            what = "no events" if not len(span.events) else f"{span.count:,} events, none of them selected,"
            raise AmiwarpError(f"{what} from {span.start_ms:.3f} ms on for {span.length_us * 1e-3:.3f} ms; "
                               "take another window")  # fmt: skip
        thin = np.arange(min(n, self.most_points)) * n // min(n, self.most_points)
        thin = thin if within is None else within[thin]
        drawn, truth = events[thin], DrawnTruth(recording.truth, span, thin if near is None else near[thin])
        xy = np.stack([drawn.x, drawn.y], axis=1).astype(np.float32)
        xy = xy if span.places is None else span.places[truth.positions]
        return LoadedWindow(span, region, n, drawn, truth, xy, running.steps, events)

    def selected_events(self, selection: Selection) -> SelectedEvents:
        """Return a selection that can run over the events of a window.

        It also keeps the events near the region, which compensation may move into it.
        """
        m = self.margin_px
        left, top, right, bottom = selection.region or (0, 0, *self.recording.events.size)
        return SelectedEvents(
            selection,
            self.recording.events.size,
            (left - m, top - m, right + m, bottom + m),
            self.hot if selection.hide_hot else None,
            None if self.recording.encoder is None else self.recording.encoder.coverage,
        )

    def _drift_us(self, knobs: Knobs) -> float:
        """Return how far the clock offset is from that of the recording's own encoder [us]."""
        return knobs.clock_offset - self._recorded_offset_us

    def _angles(self, w: LoadedWindow, knobs: Knobs) -> tuple[UploadedEvents, NDArray[np.float64], NDArray[np.float64]]:
        """Return the prism angles of a window; those of the two last speeds are kept."""
        rpm = 0.0 if self.has_encoder else knobs.rpm
        if rpm not in w.angles:
            encoder, t = self._encoder(rpm), w.events.t
            for old in list(w.angles)[:-1]:
                del w.angles[old]
            # with the slope, the clock offset of the encoder can be changed afterwards
            slope = encoder.speed_at(w.counted.t) * 1e-6 if self.has_encoder else None
            uploaded = upload_events(w.counted, encoder, self.device, slope=slope)
            w.angles[rpm] = uploaded, encoder.angle_at(t), encoder.speed_at(t) * 1e-6
        return w.angles[rpm]

    def _theta(self, w: LoadedWindow, knobs: Knobs) -> NDArray[np.float64]:
        """Return the prism angles of the drawn events [rad], shape ``(n,)``."""
        _, theta, speed = self._angles(w, knobs)
        return theta + speed * self._drift_us(knobs)

    def _wrapped(self, w: LoadedWindow, knobs: Knobs) -> NDArray[np.float64]:
        """Return the prism angles of the drawn events, from 0 to 2π [rad], shape ``(n,)``."""
        key = 0.0 if self.has_encoder else knobs.rpm, self._drift_us(knobs)
        if key not in w.wrapped:
            w.wrapped.clear()
            w.wrapped[key] = np.mod(self._theta(w, knobs), math.tau)
        return w.wrapped[key]

    def _moved(self, w: LoadedWindow, knobs: Knobs) -> NDArray[np.float32]:
        """Return the compensated positions of the drawn events [px], shape ``(n, 2)``."""
        encoder, (first, last) = self.encoder_of(knobs), w.events.t[[0, -1]].tolist()
        if encoder.covers(first, last) and w.events.x.dtype == np.uint16:  # several times as fast
            return np.asarray(compensate_events(w.events, self.model_of(knobs), encoder, device=self.device))
        theta = self._theta(w, knobs).astype(np.float32)
        return np.asarray(self.model_of(knobs).compensate_points(w.before, theta), np.float32)

    def at_pixels(self, w: LoadedWindow, knobs: Knobs | None) -> Events:
        """Return a window's events at the pixels in which they lie with given parameters; None: as recorded."""
        if knobs is None:
            return w.counted
        e = w.counted
        recorded = np.stack([e.x, e.y], axis=1).astype(np.float32)
        moved = self._moved(replace(w, events=e, before=recorded, angles={}), knobs)
        half = np.array(self.recording.events.size) / 2.0
        seen = (np.abs(moved + 0.5 - half) < half).all(axis=1)  # False for NaN
        x, y = np.rint(moved[seen]).astype(np.uint16).T
        return Events(x, y, e.t[seen], e.p[seen])

    def counts(self, w: LoadedWindow, knobs: Knobs | None, *, per_polarity: bool = False) -> NDArray[np.float32]:
        """Return the number of a window's events at each pixel, shape ``(height, width)``, or two such images.

        Compensated events count at the pixel in which they lie; ``knobs`` None counts the events as recorded.
        """
        size = self.recording.events.size
        if knobs is None:
            return iwe(w.counted, *size, per_polarity=per_polarity, vote=Vote.NEAREST)
        with self.lock:
            if per_polarity not in self._votes:
                canvas = CanvasShape(*size, per_polarity=per_polarity, vote=Vote.NEAREST)
                self._votes[per_polarity] = Votes(canvas, self.device)
            votes = self._votes[per_polarity]
            model, events, drift_us = self.warped(w, knobs)
            votes.add_events(model, events, drift=drift_us)
            image = votes.take()
        return image if per_polarity else image[0]

    def _measured(self, w: LoadedWindow, knobs: Knobs | None) -> tuple[NDArray[np.float32], float]:
        """Return the image of a window with these parameters, and its sharpness.

        If ``knobs`` is None, it shows the events as recorded, and is measured only once.
        """
        if knobs is None and w.unmoved:
            return w.unmoved[0]
        with self.lock:
            _, sharpness = self._imager.measure(*self.warped(w, knobs), w.region)
        found = self.counts(w, knobs), sharpness
        if knobs is None:
            w.unmoved.append(found)
        return found


# Recordings that a page can open: the files in one folder.

SUFFIXES = {*EXTENSIONS, ".aedat", ".aedat2", ".bag", ".bin", ".csv", ".dat", ".es"}
"""Suffixes of files that may be recordings."""
MOST_FILES = 200
"""Largest number of files that are listed."""


class Library:
    """Files in a folder that a page may open. The page names a file, never a folder."""

    def __init__(self, folder: Path, open_file: Callable[[Path], Inspector]) -> None:
        self.folder, self._open_file = folder.resolve(), open_file

    def files(self) -> list[list[str]]:
        """Return names and sizes of the files, in the order of their names."""
        found = sorted(
            path for path in self.folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
            and path.is_file() and path.resolve().parent == self.folder  # also if it is a link
            and not holds_map(path, (DepthMap, PixelMap))
        )  # fmt: skip
        return [[path.name, f"{path.stat().st_size / 1e6:,.1f} MB"] for path in found[:MOST_FILES]]

    def open(self, name: str) -> Inspector:
        """Open a file of the folder. Raises :class:`AmiwarpError` for any other name, or if it is no recording."""
        if name not in [file for file, _ in self.files()]:
            raise AmiwarpError(f"{name!r}: is no recording in {self.folder}; choose one from the list")
        made = self._open_file(self.folder / name)
        made.path = self.folder / name
        return made
