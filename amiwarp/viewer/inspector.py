"""State of the inspector without a user interface: recording, parameters, time window and its images, event rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from threading import Event, Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.bad_pixels import find_bad_pixels, searched_part
from amiwarp.calib.plate import LARGEST_INVERSE
from amiwarp.choices import Sharpness, Vote
from amiwarp.compensation.in_memory import compensate_events
from amiwarp.compensation.recordings import at_depths
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.encoder_speed import turn_between
from amiwarp.events.encoder_stream import check_prisms
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.filters import find_hot_pixels
from amiwarp.imaging.iwe import iwe
from amiwarp.imaging.regions import Region, RegionSharpness, inside, suggest_region
from amiwarp.imaging.uploaded_events import UploadedEvents, upload_events
from amiwarp.imaging.votes import Votes
from amiwarp.io.spans import Span, read_span
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.pair import RisleyModel
from amiwarp.optics.models.parameter import PHASE
from amiwarp.optics.models.plate import PlateModel
from amiwarp.optics.models.registry import MODELS, build_model
from amiwarp.optics.prism import NominalPrism, Plate, Prism, as_wedge
from amiwarp.reconstruction.windows import border_displacements
from amiwarp.results.calibration import Calibration, constant_speed, replaces
from amiwarp.results.depth_map import DepthMap
from amiwarp.results.parameters import best_model, nominal
from amiwarp.viewer.drawn_truth import DrawnTruth
from amiwarp.viewer.filters import HotPixel, SelectedEvents, Selection, list_hot_pixels
from amiwarp.viewer.knobs import (
    CURVE_HALF_WIDTH,
    SLIDING,
    WEDGE_SIZES,
    Knobs,
    Source,
    foreign_names,
    size_name,
)
from amiwarp.viewer.rig_pictures import ShownRig
from amiwarp.viewer.shown_window import DisplayedWindow, LoadedWindow
from amiwarp.viewer.window_statistics import window_statistics

MOST_POINTS = 100_000
WINDOW_POINTS = 1_000_000
"""Largest number of points in each event cloud: of the page, and of the window or a browser with a graphics card."""
CURVE_EVENTS = 200_000
"""Largest number of events that a sharpness curve uses."""
MOST_EVENTS = 2_000_000
"""Largest number of events in the image of a window. Of a fuller window, evenly spaced runs are read."""
FOV_DEG = 60.0
"""Horizontal field of view that is assumed if the camera is unknown [deg]."""
NO_ENCODER = "no encoder: set the prism's speed (rpm), or calibrate, to compensate its motion"
NO_CAMERA = f"camera unknown: {FOV_DEG:g}° field of view assumed; set it, or give it with --fov-deg or --camera"
CURVE_POINTS = 25
ORBIT_POINTS = 181
"""Number of points of a sharpness curve, and of the drawn orbit of a scene point."""
LARGEST_APEX = math.radians(3.0)
"""Apex angle up to which events that move into the region are in its images, if the nominal apex is smaller [rad]."""
WINDOW_US = 100_000
"""Length of the first time window if the prism does not rotate [us]."""


def _at_whole_pixels(span: Span, size: tuple[int, int]) -> Span:
    """Return the span with its events at whole pixels; places between pixels, of compensated events, are kept apart."""
    events = span.events
    if not np.issubdtype(events.x.dtype, np.floating):
        return span
    width, height = size
    x = np.clip(np.rint(events.x), 0, width - 1).astype(np.uint16)
    y = np.clip(np.rint(events.y), 0, height - 1).astype(np.uint16)
    places = np.stack([events.x, events.y], axis=1).astype(np.float32)
    return replace(span, events=Events(x, y, events.t, events.p), places=places)


def _first_sources(recording: Recording) -> dict[str, Source]:
    """Return where the values come from with which the inspector of a recording starts."""

    def source_of(given: object) -> Source:
        return Source.ASSUMED if given is None else Source.FILE

    sources = {
        "camera": source_of(recording.camera),
        "prism": source_of(recording.prism),
        "apex": source_of(getattr(recording.prism, "apex", None)),
        **dict.fromkeys(("model", "phase", *SLIDING), Source.ASSUMED),
    }
    if recording.encoder is None:
        sources["rpm"] = Source.ASSUMED
    else:
        sources["clock_offset"] = Source.FILE
    return sources


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
            raise AmiwarpError(
                f"{recording.name}: holds no events; give a recording with events",
                ErrorCode.CONTENT_MISSING,
            )
        if calibration is not None and recording.encoder is None:
            # A calibration without encoder may have found the angles of this very recording.
            path = calibration.path
            if path is not None and path.covers(source.t_first, source.t_last):
                recording = replace(recording, encoder=path)
        self._no_speed = recording.encoder is None and calibration is None
        self.sources = _first_sources(recording)
        """Where the value of each parameter that the page shows, the camera, and the prism's index come from."""
        if recording.camera is None:
            recording = replace(
                recording, camera=Camera.from_fov(*source.size, math.radians(FOV_DEG))
            )
        self.recording = recording
        self.device = device
        self.latest = latest
        self.prism = nominal(recording.prism)
        """Nominal glass of the recording; a prism with an assumed apex if it is unknown."""
        self.zero_us = (source.t_first + source.t_last) // 2
        """Time at which the prism angle is 0 if there is no encoder [us]."""
        self.knobs = self._first_knobs()
        self.window: tuple[int, int] | None = None
        """Start and length of the time window [us]; None: the window of :meth:`first_window`."""
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
        """The recording of :attr:`besides` that is shown beside this one."""
        self.shown_rig: ShownRig | None = None
        """The rig that this recording is a part of, whose other sensors are shown too."""
        self.offset_us = 0
        """If this recording is beside another one: its first event's time after the other one's first event [us]."""
        self._angles_are_lent = False
        """Whether this recording is beside another one and uses the encoder of the other one."""
        self.depth: DepthMap | None = None
        """Depths of what the pixels see through a plate, see :meth:`use_depths`."""
        self._shown_beside = False
        """Whether this recording is beside another one."""
        self._accepted: tuple[Knobs, Calibration] | None = None
        """The calibration that was accepted last, with its parameters: they are equal while no slider has moved."""
        self._harmonics: tuple[float, ...] | None = None
        self._calibrated_encoder: Encoder | None = None
        """Angles that a calibration found, which replace the encoder's."""
        self._window: LoadedWindow | None = None
        self._span: Span | None = None
        self._closing = Event()
        self.lock = Lock()
        """Lock for the events on the device and the buffers of their images."""
        self._imager = RegionSharpness(source.size, device)
        self._votes: dict[bool, Votes] = {}
        if calibration is not None:
            self.accept(calibration)

    def _first_knobs(self) -> Knobs:
        """Return the nominal parameters of the recording's optic, with which the inspector starts."""
        model = self._best_model
        encoder = self.recording.encoder
        values = self._typical_size(model)
        if encoder is not None and encoder.ratio is not None:  # a pair of prisms
            wedge = as_wedge(self.prism)
            second = wedge.second or wedge
            values |= {"second_apex": second.apex, "ratio": encoder.ratio}
        return Knobs.given(
            values,
            model=model,
            apex=self.nominal_apex,
            clock_offset=self._recorded_offset_us,
        )

    def copy(self) -> Inspector:
        """Return an inspector that shows the same, with buffers of its own, for another thread."""
        copied = copy(self)
        size = self.recording.events.size
        copied.lock = Lock()
        copied._votes = {}
        copied.sources = dict(self.sources)
        copied._imager = RegionSharpness(size, self.device)
        copied._window = None
        copied._span = None
        copied.besides = tuple(inspector.copy() for inspector in self.besides)
        copied.beside = None
        if self.beside is not None:
            copied.beside = copied.besides[self.besides.index(self.beside)]
        return copied

    def snapshot(self) -> Inspector:
        """Return an inspector of what is shown now, for work in another thread that takes long.

        It shares window and buffers, but what is set or renewed in this inspector meanwhile does not change it: a live
        stream goes on to events and angles that do not belong together with the window.
        """
        snapshot = copy(self)
        snapshot.sources = dict(self.sources)
        return snapshot

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
        missing = []
        if self._no_speed and not self.knobs.rpm:
            missing.append(NO_ENCODER)
        if self.sources["camera"] is Source.ASSUMED:
            missing.append(NO_CAMERA)
        return tuple(missing)

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view of the camera [deg]."""
        return round(2.0 * math.degrees(math.atan(0.5 * self.camera.width / self.camera.fx)), 4)

    def set_camera(self, fov_deg: float) -> None:
        """Set a camera with a horizontal field of view [deg], without distortion. The window is read again."""
        camera = Camera.from_fov(*self.recording.events.size, math.radians(fov_deg))
        self.recording = replace(self.recording, camera=camera)
        self.sources["camera"] = Source.HAND
        self._window = None

    def set_index(self, index: float) -> None:
        """Set the refractive index of the prism."""
        self.prism = replace(self.prism, index=index)
        self.sources["prism"] = Source.HAND

    @property
    def nominal_prism(self) -> NominalPrism | None:
        """Prism of the recording, or the one that was set by hand; None if neither is known."""
        given = self.recording.prism
        by_hand = self.sources["prism"] is Source.HAND
        if given is None:
            by_hand = by_hand or self.sources["apex"] is Source.HAND
        if by_hand:
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
        of_optic = [source for name, source in self.sources.items() if name != "camera"]
        known = any(source is not Source.ASSUMED for source in of_optic)
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
        return self._corrected_encoder or constant_speed(
            rpm, source.t_first, source.t_last, self.zero_us
        )

    @cached_property
    def _corrected_encoder(self) -> Encoder | None:
        """The recording's encoder without the errors that a calibration found in it; None if there is no encoder."""
        encoder = self.recording.encoder
        if encoder is None:
            return None
        if self._calibrated_encoder is not None:
            encoder = replace(self._calibrated_encoder, clock_offset_us=encoder.clock_offset_us)
        if self._harmonics is not None:
            encoder = encoder.with_harmonics(self._harmonics)
        return encoder

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
        self.depth = depth
        self._depths = table
        self._window = None

    @property
    def orbit_names(self) -> tuple[str, ...]:
        """Names of size and phase, as far as they have a slider: with a depth map, there is no size to set."""
        if self.depth is not None:
            return (PHASE.name,)
        return (size_name(self.knobs.model), PHASE.name)

    @property
    def margin_px(self) -> int:
        """How far outside a region the events of its images may be: how far the optic may move them [px]."""
        if not self.has_optic:
            return 0
        if isinstance(self.prism, Plate):
            nearest = LARGEST_INVERSE if self.depth is None else float(self._depths.max())
            reach = self.prism.shift * nearest
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
        return self._hot_pixels[0]

    @property
    def hot_pixels(self) -> tuple[HotPixel, ...]:
        """The pixels of :attr:`hot`, the busiest first. Rates and shares are of the part that was searched for them."""
        return self._hot_pixels[1]

    @cached_property
    def _hot_pixels(self) -> tuple[NDArray[np.bool_], tuple[HotPixel, ...]]:
        """Hot pixels as a mask and as a list, found in the middle of the recording."""
        source = self.recording.events
        encoder = self.encoder
        events = searched_part(source, encoder)
        if math.isfinite(self.turn_us):
            hot, _ = find_bad_pixels(events, encoder, source.size)
        else:
            hot = find_hot_pixels(events, source.size)
        return hot, list_hot_pixels(events, hot)

    def first_window(self) -> tuple[int, int]:
        """Return start and length of one turn in the middle of the recording [us].

        If the prism does not rotate, the length is :data:`WINDOW_US`, and at most a fifth of the recording, so that it
        can be played.
        """
        source = self.recording.events
        whole = source.t_last - source.t_first + 1
        length = min(WINDOW_US, max(1, whole // 5))
        if math.isfinite(self.turn_us):
            length = min(round(self.turn_us), whole)
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
        count = self.fixed_count or 1
        if windows >= 0:
            index = source.find(start_us + length_us) + (windows - 1) * count
        else:
            index = source.find(start_us) + windows * count
        index = min(max(index, 0), len(source) - 1)
        return int(source.slice(index, index + 1).t[0])

    def renew(self) -> None:
        """Take the current events of a live stream; call :meth:`open` afterwards.

        Raises the errors of the function ``latest``.
        """
        if self.latest is not None:
            recording = self.latest()
            self.recording = replace(
                self.recording, events=recording.events, encoder=recording.encoder
            )
            self._span = None
            self._forget_angles()

    def _forget_angles(self) -> None:
        """Forget what depends on the encoder's angles."""
        for name in ("_hot_pixels", "_corrected_encoder"):
            self.__dict__.pop(name, None)
        if self._window is not None:
            self._window.angles.clear()
            self._window.wrapped.clear()

    def accept(self, calibration: Calibration) -> None:
        """Set the parameters to a calibration. Raises :class:`AmiwarpError` if its camera has another size."""
        size = self.recording.events.size
        given = (calibration.camera.width, calibration.camera.height)
        if given != size:
            raise AmiwarpError(
                f"the calibration is of {given[0]}x{given[1]} pixels, the events are of {size[0]}x{size[1]}; "
                "calibrate this recording"
            )
        self.prism = calibration.prism
        self.recording = replace(self.recording, camera=calibration.camera)
        self._harmonics = calibration.harmonics
        recorded = self.recording.encoder
        path = calibration.path
        self._calibrated_encoder = None
        if recorded is not None and path is not None and replaces(path, recorded):
            self._calibrated_encoder = path
        self._forget_angles()
        self.set(self.knobs_of(calibration))

        self.sources |= dict.fromkeys(self._shown_names(calibration.parameters), Source.FILE)
        free = self._shown_names(calibration.free)
        self.sources |= dict.fromkeys(("model", *free), Source.CALIBRATED)
        self._accepted = self.knobs, calibration

    def _shown_names(self, names: Iterable[str]) -> set[str]:
        """Return which of a model's parameters the page shows, by its names: any size of a wedge is the apex."""
        return {"apex" if name in WEDGE_SIZES else name for name in names} & set(self.sources)

    def knobs_of(self, calibration: Calibration) -> Knobs:
        """Return the parameters of a calibration of this camera, with the phase at the inspector's angle zero."""
        values = calibration.parameters
        model = MODELS[calibration.model_name]
        rpm = values.get("rpm", 0.0)
        if calibration.zero_us is not None:
            turned = rpm * math.tau / 60e6 * (self.zero_us - calibration.zero_us)
            values = model.turned_values(values, turned)
        apex = self.knobs.apex
        if model.SIZE in WEDGE_SIZES:
            apex = model.apex_from_size(values[model.SIZE], as_wedge(calibration.prism))
        return Knobs.given(
            values,
            model=model.NAME,
            apex=apex,
            phase=values["phase"],
            clock_offset=values.get("clock_offset", self._recorded_offset_us),
            rpm=rpm,
            focal_length=values.get("focal_length"),
        )

    @property
    def truth(self) -> Knobs | None:
        """Known parameters of a simulated recording; None if the recording has no ground truth of its prism.

        Ground truth holds no speed, because the encoder measures it: the current one stands in for it.
        """
        values = {} if self.recording.truth is None else self.recording.truth.parameters
        if "apex" not in values or "phase" not in values:
            return None
        return Knobs.given(
            values,
            model=self._best_model,
            apex=values["apex"],
            phase=values["phase"],
            clock_offset=values.get("clock_offset_us", self._recorded_offset_us),
            rpm=self.knobs.rpm,
        )

    def take_truth(self) -> None:
        """Set the parameters to the known truth. Raises :class:`AmiwarpError` if the recording has none."""
        if self.truth is None:
            raise AmiwarpError(
                f"{self.recording.name}: holds no true parameters of its prism; simulate a recording"
            )
        self.set(self.truth)
        known = set(self.sources) - {"camera", "prism", "rpm"} - foreign_names(self.truth.model)
        self.sources |= dict.fromkeys(known, Source.TRUTH)

    def as_calibration(self) -> Calibration:
        """Return the accepted calibration if no parameter was changed since, else one of the current parameters."""
        if self._accepted is not None and self._accepted[0] == self.knobs:
            return self._accepted[1]
        knobs = self.knobs
        window = self.loaded
        model = MODELS[knobs.model]

        values = self._values(knobs)
        sliding = [name for name in model.FREE if name in SLIDING]
        names = (model.SIZE, *sliding, "phase", *knobs.calibrated_only)
        parameters = {name: values[name] for name in names}
        if self.has_encoder:
            parameters["clock_offset"] = knobs.clock_offset
        else:
            parameters["rpm"] = knobs.rpm

        with self.lock:
            before, _ = self._imager.measure(*self.warped(window, None), window.region)
            after, _ = self._imager.measure(*self.warped(window, knobs), window.region)
        return Calibration(
            model_name=knobs.model,
            camera=self.camera,
            prism=nominal(self.prism, model),
            parameters=parameters,
            uncertainty={},
            free=(),
            sharpness_name=Sharpness.VARIANCE.value,
            sharpness_before=before,
            sharpness_after=after,
            stages=(),
            events=len(window.counted),
            seconds=0.0,
            warnings=("set by hand in the inspector",),
            zero_us=None if self.has_encoder else self.zero_us,
            harmonics=self._harmonics,
            path=self._calibrated_encoder,
        )

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
        selection = selection or self.selection
        if self.fixed_count is not None:
            start_us, length_us = self.window_of(start_us, self.fixed_count)
        self._window = self._load(start_us, max(1, length_us), selection)
        self.selection = selection
        self.window = (start_us, length_us)

    @property
    def window_and_selection(self) -> tuple[tuple[int, int] | None, Selection]:
        """Time window and selection. A result that was computed for another pair is out of date."""
        return self.window, self.selection

    def suggest_region(self) -> Region:
        """Return the region in which compensation gains most sharpness in the current time window."""
        loaded = self.loaded
        if self.selection.region is not None:
            loaded = self._load(
                loaded.span.start_us, loaded.span.length_us, replace(self.selection, region=None)
            )
        before, _ = self._measured(loaded, None)
        after, _ = self._measured(loaded, self.knobs)
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
        source = recording.events
        size = self.recording.events.size
        if source.size != size:
            raise AmiwarpError(
                f"{recording.name}: has {source.size[0]}x{source.size[1]} pixels, {self.recording.name} has "
                f"{size[0]}x{size[1]}; give two recordings of one size"
            )
        recorded = self.recording.encoder
        lent = recording.encoder is None
        if recording.encoder is None and recorded is not None and len(source):
            shift = source.t_first - self.recording.events.t_first - offset_us
            recording = replace(
                recording,
                encoder=Encoder(recorded.t + shift, recorded.angle, recorded.clock_offset_us),
            )
        other = Inspector(recording, device=self.device, most_points=self.most_points)
        other._shown_beside = True
        other.offset_us = offset_us
        other._angles_are_lent = lent
        other.zero_us = source.t_first + self.zero_us - self.recording.events.t_first - offset_us
        self.besides = (*self.besides, other)
        self.beside = self.beside or other

    def show_rig(self, shown_rig: ShownRig) -> None:
        """Show the other sensors of a rig at the times of this recording, which is its main one."""
        self.shown_rig = shown_rig
        first_us = self.recording.events.t_first
        for other in shown_rig.others():
            self.put_beside(other, other.events.t_first - first_us)

    @property
    def angles_lent(self) -> bool:
        """Whether the recording beside has no encoder of its own, and is shown at this recording's prism angles."""
        return self.beside is not None and self.beside._angles_are_lent

    def time_of(self, shared_us: int) -> int:
        """Return a time on this recording's clock [us].

        ``shared_us``: the time on the shared axis, after the first event of the other recording [us].
        """
        return self.recording.events.t_first + shared_us - self.offset_us

    def counts_beside(self, span: Span) -> list[int]:
        """Return how many events each recording on this time axis has in the time of a span, whatever is selected."""
        start_us = span.start_us - span.first_us
        stop_us = start_us + span.length_us
        counts = []
        for other in self.besides:
            source = other.recording.events
            first = source.find(other.time_of(start_us))
            stop = source.find(other.time_of(stop_us))
            counts.append(stop - first)
        return counts

    def _shown_as_recorded(
        self, span: Span, selection: Selection, image_after: NDArray[np.float32], lent: Knobs | None
    ) -> DisplayedWindow:
        """Return what this recording, as recorded, shows beside another one.

        ``span``: time that the other one shows. ``image_after``: compensated image of the other one, which sets the
        scale of colours. ``lent``: parameters of the other one whose speed and clock offset this one takes over; None
        to keep its own.
        """
        if lent is not None:
            self.knobs = replace(self.knobs, rpm=lent.rpm, clock_offset=lent.clock_offset)
        time = self.time_of(span.start_us - span.first_us), span.length_us
        if (time, selection) != (self.window, self.selection):
            self.open(*time, selection)
        window = self.loaded
        image, sharpness = self._measured(window, None)
        return DisplayedWindow(
            span=window.span,
            region=window.region,
            selected=window.selected,
            events=window.events,
            truth=window.truth,
            before=window.before,
            steps=window.steps,
            after=window.before,
            theta=self._wrapped(window, self.knobs),
            image_before=image,
            image_after=image_after,
            sharpness_before=sharpness,
            sharpness_after=sharpness,
            is_beside=True,
            offset_us=self.offset_us,
        )

    def show(self, knobs: Knobs | None = None, *, against: Knobs | None = None) -> DisplayedWindow:
        """Return the time window's images and points.

        ``knobs``: parameters to show, by default the current ones. ``against``: parameters to compare with; they
        replace the recorded events as the first of the two clouds and images. Without them, the first ones show the
        recording beside, if there is one.
        """
        window = self.loaded
        knobs = knobs or self.knobs
        before = window.before if against is None else self._moved(window, against)
        image_after, sharpness_after = self._measured(window, knobs)
        shown_beside = None
        if self.beside is not None and against is None:
            lent = knobs if self.angles_lent else None
            shown_beside = self.beside._shown_as_recorded(
                window.span, self.selection, image_after, lent
            )
            image_before = shown_beside.image_before
            sharpness_before = shown_beside.sharpness_before
        else:
            image_before, sharpness_before = self._measured(window, against)
        return DisplayedWindow(
            span=window.span,
            region=window.region,
            selected=window.selected,
            events=window.events,
            truth=window.truth,
            before=before,
            steps=window.steps,
            after=self._moved(window, knobs),
            theta=self._wrapped(window, knobs),
            image_before=image_before,
            image_after=image_after,
            sharpness_before=sharpness_before,
            sharpness_after=sharpness_after,
            beside=shown_beside,
        )

    def curve(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return values of a parameter around its current one, in its unit, and the sharpness at each of them."""
        values, sharpness = np.array([*self.curve_points(name)], np.float64).reshape(-1, 2).T
        return values, sharpness

    def curve_points(self, name: str) -> Iterator[tuple[float, float]]:
        """Yield the points of :meth:`curve` one after the other."""
        knobs = self.knobs
        half = CURVE_HALF_WIDTH[name]
        sharpness = self.sharpness_meter()
        values = (knobs.value(name) or 0.0) + np.linspace(-half, half, CURVE_POINTS)
        if name == size_name(knobs.model):
            values = values[values >= 0.0]
        for value in values.tolist():
            yield value, sharpness(knobs.with_values({name: value}))

    def sharpness_meter(self) -> Callable[[Knobs | None], float]:
        """Return a function that measures the sharpness of part of the window's events with given parameters.

        Without parameters, it measures the events as recorded. It uses at most :data:`CURVE_EVENTS`, and has buffers of
        its own, for one thread.
        """
        window = self.loaded
        imager = RegionSharpness(self.recording.events.size, self.device)
        step = max(1, -(-len(window.counted) // CURVE_EVENTS))  # rounded up
        undrawn = replace(
            window, counted=window.counted[::step], events=window.events[:0], angles={}
        )

        def sharpness(knobs: Knobs | None) -> float:
            if self.closed:
                raise AmiwarpError(f"{self.recording.name}: is closed")
            return imager.measure(*self.warped(undrawn, knobs), window.region)[1]

        return sharpness

    def statistics(self) -> dict[str, Any]:
        """Return the statistics of the selected events of the time window, see :func:`window_statistics`."""
        return window_statistics(self.loaded)

    def orbit(self, x: float, y: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return the orbit of the scene point that would appear at (x, y) [px] without the prism.

        Returns prism angles over one turn [rad], shape ``(n,)``, and pixels, shape ``(n, 2)``.
        """
        theta = np.linspace(0.0, math.tau, ORBIT_POINTS)
        model = self.model
        point = np.broadcast_to(np.array([[x, y]], np.float32), (len(theta), 2))
        if isinstance(model, PlateModel) and model.depths is not None:  # the point has one depth
            last = np.array(model.depths.shape) - 1
            row, column = np.clip(np.rint(np.nan_to_num([y, x])).astype(int), 0, last)
            model = replace(model, depths=None, inverse_depth=float(model.depths[row, column]))
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
        turns = bool(self.has_encoder or knobs.rpm)
        calibrated = knobs.calibrated_only
        sliding = dict.fromkeys(SLIDING, 0.0)
        if turns:
            sliding = {name: knobs.value(name) or 0.0 for name in SLIDING}
        values = {**calibrated, **sliding, "phase": knobs.phase}

        model = MODELS[knobs.model]
        if model.SIZE in WEDGE_SIZES:
            wedge = replace(as_wedge(self.prism), index=calibrated.get("index", self.prism.index))
            values[model.SIZE] = model.size_from_apex(knobs.apex if turns else 0.0, wedge)
        return values

    def model_of(
        self,
        knobs: Knobs,
        camera: Camera | None = None,
        part: tuple[slice, slice] = (slice(None), slice(None)),
    ) -> Model:
        """Return the optical model with given parameters.

        ``camera``: another camera than the recording's, which sees these rows and columns of its pixels.
        """
        model = build_model(knobs.model, camera or self.camera, self.prism, self._values(knobs))
        if self.depth is None or not isinstance(model, PlateModel):
            return model
        if not model.inverse_depth:  # nothing moves
            return model
        return model.with_depths(self._depths[part])

    def encoder_of(self, knobs: Knobs) -> Encoder:
        """Return the encoder with the clock offset or the speed of given parameters."""
        encoder = self._encoder(knobs.rpm)
        return encoder.with_clock_offset(knobs.clock_offset) if self.has_encoder else encoder

    def warped(
        self, window: LoadedWindow, knobs: Knobs | None
    ) -> tuple[Model, UploadedEvents, float]:
        """Return the model, the events on the device and their drift [us], to vote the events of a window.

        ``knobs``: the parameters; None for the events as recorded.
        """
        if knobs is None:  # parameters that move no event
            knobs = replace(self.knobs, model=self._best_model, apex=0.0, others=())
        uploaded, _, _ = self._angles(window, knobs)
        return self.model_of(knobs), uploaded, self._drift_us(knobs)

    def _load(self, start_us: int, length_us: int, selection: Selection) -> LoadedWindow:
        """Read and select the events of a time window. The events of the last one are not read again."""
        span = self._span
        if span is None or (span.start_us, span.length_us) != (start_us, length_us):
            span = read_span(self.recording.events, start_us, length_us, most_events=MOST_EVENTS)
            if self._shown_beside:
                span = _at_whole_pixels(span, self.recording.events.size)
            self._span = span
        return self.select(span, selection)

    def select(self, span: Span, selection: Selection) -> LoadedWindow:
        """Select the events of a time window. Raises :class:`AmiwarpError` if no event meets the selection."""
        recording = self.recording
        region = selection.region or (0, 0, *recording.events.size)

        # Events in the region and near it: compensation may move these into it.
        running = self.selected_events(selection)
        keep = running.keep(span.events)
        if span.places is not None:  # compensated events outside of the image have no pixel
            half = np.array(recording.events.size) / 2.0  # from the image's middle to its sides
            keep &= (np.abs(span.places + 0.5 - half) <= half).all(axis=1)
        near = None if keep.all() else np.flatnonzero(keep)  # None stands for all
        counted = span.events if near is None else span.events[near]

        within = np.flatnonzero(inside(counted, region)) if selection.region else None
        selected = len(counted) if within is None else len(within)
        if not selected:
            what = "no events"
            if len(span.events):
                what = f"{span.count:,} events, none of them selected,"
            raise AmiwarpError(
                f"{recording.name}: {what} from {span.start_ms:.3f} ms on for {span.length_us * 1e-3:.3f} ms; "
                "take another window, or a wider selection"
            )

        # The drawn events are evenly spaced among the selected ones.
        points = min(selected, self.most_points)
        drawn_at = np.arange(points) * selected // points
        if within is not None:
            drawn_at = within[drawn_at]
        drawn = counted[drawn_at]
        truth = DrawnTruth(recording.truth, span, drawn_at if near is None else near[drawn_at])
        if span.places is None:
            before = np.stack([drawn.x, drawn.y], axis=1).astype(np.float32)
        else:
            before = span.places[truth.positions]
        return LoadedWindow(
            span, region, selected, drawn, truth, before, running.steps, counted=counted
        )

    def selected_events(self, selection: Selection) -> SelectedEvents:
        """Return a selection that can run over the events of a window.

        It also keeps the events near the region, which compensation may move into it.
        """
        size = self.recording.events.size
        margin = self.margin_px
        left, top, right, bottom = selection.region or (0, 0, *size)
        with_margin = (left - margin, top - margin, right + margin, bottom + margin)
        hidden = self.hot if selection.hide_hot else None
        encoder = self.recording.encoder
        coverage = None if encoder is None else encoder.coverage
        return SelectedEvents(selection, size, with_margin, hidden, coverage)

    def _drift_us(self, knobs: Knobs) -> float:
        """Return how far the clock offset is from the offset of the recording's own encoder [us]."""
        return knobs.clock_offset - self._recorded_offset_us

    def _angles(
        self, window: LoadedWindow, knobs: Knobs
    ) -> tuple[UploadedEvents, NDArray[np.float64], NDArray[np.float64]]:
        """Return a window's events on the device, and the drawn events' prism angles [rad] and speeds [rad/us].

        These are without the drift of the clock offset. The angles of the two last speeds are kept.
        """
        rpm = 0.0 if self.has_encoder else knobs.rpm
        if rpm not in window.angles:
            encoder = self._encoder(rpm)
            t = window.events.t
            for old in list(window.angles)[:-1]:
                del window.angles[old]
            # With the slope of the angle, the kernels can move the clock offset without a new upload.
            slope = encoder.speed_at(window.counted.t) * 1e-6 if self.has_encoder else None
            uploaded = upload_events(window.counted, encoder, self.device, slope=slope)
            window.angles[rpm] = uploaded, encoder.angle_at(t), encoder.speed_at(t) * 1e-6
        return window.angles[rpm]

    def _theta(self, window: LoadedWindow, knobs: Knobs) -> NDArray[np.float64]:
        """Return the prism angles of the drawn events [rad], shape ``(n,)``."""
        _, theta, speed = self._angles(window, knobs)
        return theta + speed * self._drift_us(knobs)

    def _wrapped(self, window: LoadedWindow, knobs: Knobs) -> NDArray[np.float64]:
        """Return the prism angles of the drawn events, from 0 to 2π [rad], shape ``(n,)``."""
        rpm = 0.0 if self.has_encoder else knobs.rpm
        key = rpm, self._drift_us(knobs)
        if key not in window.wrapped:
            window.wrapped.clear()
            window.wrapped[key] = np.mod(self._theta(window, knobs), math.tau)
        return window.wrapped[key]

    def _moved(self, window: LoadedWindow, knobs: Knobs) -> NDArray[np.float32]:
        """Return the compensated positions of the drawn events [px], shape ``(n, 2)``."""
        events = window.events
        model = self.model_of(knobs)
        encoder = self.encoder_of(knobs)
        first_us, last_us = events.t[[0, -1]].tolist()
        if encoder.covers(first_us, last_us) and events.x.dtype == np.uint16:
            # This way is several times as fast, but takes only whole pixels and known angles.
            return np.asarray(compensate_events(events, model, encoder, device=self.device))
        theta = self._theta(window, knobs).astype(np.float32)
        return np.asarray(model.compensate_points(window.before, theta), np.float32)

    def at_pixels(self, window: LoadedWindow, knobs: Knobs | None) -> Events:
        """Return a window's events at the pixels in which they lie with given parameters; None: as recorded."""
        events = window.counted
        if knobs is None:
            return events
        recorded = np.stack([events.x, events.y], axis=1).astype(np.float32)
        moved = self._moved(replace(window, events=events, before=recorded, angles={}), knobs)
        half = np.array(self.recording.events.size) / 2.0  # from the image's middle to its sides
        seen = (np.abs(moved + 0.5 - half) < half).all(axis=1)  # False for NaN
        x, y = np.rint(moved[seen]).astype(np.uint16).T
        return Events(x, y, events.t[seen], events.p[seen])

    def counts(
        self, window: LoadedWindow, knobs: Knobs | None, *, per_polarity: bool = False
    ) -> NDArray[np.float32]:
        """Return the number of a window's events at each pixel, shape ``(height, width)``, or two such images.

        Compensated events count at the pixel in which they lie; ``knobs`` None counts the events as recorded.
        """
        size = self.recording.events.size
        if knobs is None:
            return iwe(window.counted, *size, per_polarity=per_polarity, vote=Vote.NEAREST)
        with self.lock:
            if per_polarity not in self._votes:
                canvas = CanvasShape(*size, per_polarity=per_polarity, vote=Vote.NEAREST)
                self._votes[per_polarity] = Votes(canvas, self.device)
            votes = self._votes[per_polarity]
            model, events, drift_us = self.warped(window, knobs)
            votes.add_events(model, events, drift=drift_us)
            image = votes.take()
        return image if per_polarity else image[0]

    def _measured(
        self, window: LoadedWindow, knobs: Knobs | None
    ) -> tuple[NDArray[np.float32], float]:
        """Return the image of a window with these parameters, and its sharpness.

        If ``knobs`` is None, it shows the events as recorded, and is measured only once.
        """
        if knobs is None and window.as_recorded:
            return window.as_recorded[0]
        with self.lock:
            _, sharpness = self._imager.measure(*self.warped(window, knobs), window.region)
        measured = self.counts(window, knobs), sharpness
        if knobs is None:
            window.as_recorded.append(measured)
        return measured
