"""Streams of events that are compared, from a simulated or a real recording, and frames of a standard camera."""

from __future__ import annotations

import contextlib
import enum
import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.calibration import calibrate
from amiwarp.calib.settings import PhotometricSettings
from amiwarp.calib.settings import Settings as CalibrationSettings
from amiwarp.compensation.in_memory import compensate_events
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.events.truth import EventTruth, FrameTruth
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.votes import Votes
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.results.calibration import Calibration
from amiwarp.simulation.truth_renderer import TruthRenderer
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.evaluate.conditions import Condition, Settings
from amiwarp.studies.evaluate.event_images import DENSITY_PX, smooth_image, thinned

FAST_CALIBRATION = CalibrationSettings(
    model="exact",
    global_evaluations=40,
    events=60_000,
    tolerance_px=0.01,
    photometric=PhotometricSettings(steps=6, tolerance_px=0.005),
)
"""Settings of the calibration of simulated recordings, whose optics are known to be exact.

They take two fifths of the default settings' time. On a recording of the room with a handheld camera, the result is
0.011 px (rms) from the default settings' result.
"""
LONGEST_DELAY_US = 4000.0
"""Longest mean delay of a sensor that is looked for [us]."""
DELAY_EVENTS = 300_000
"""Largest number of events from which that delay is determined; more are thinned evenly."""
EXPOSURE_US = 8000
"""Exposure of a frame of the standard camera [us]."""
EXPOSURE_STEPS = {"still": 1, "handheld": 4, "fast": 12}
"""Number of moments of an exposure that are rendered and averaged, by the camera's motion: about one per pixel."""
GAMMA = 1.0 / 2.2
"""Exponent from luminance to the grey values of a picture."""
FRAMES_KEPT = 64
"""Number of instants whose ground truth is kept; more than an evaluation uses for several streams."""
ENOUGH = 0.95
"""Smallest number of events of the stream with the same count, relative to the AMI-EV's."""


class Stream(enum.StrEnum):
    """Streams of events that are compared."""

    PLAIN = "S-EV"
    """Plain event camera: same world, sensor and seed without the prism."""
    TRUE = "AMI-EV, true"
    """Events behind the prism, compensated by the true model, with the sensor's mean delay."""
    CALIBRATED = "AMI-EV, calibrated"
    """Events behind the prism, compensated as calibrated once, from another recording with the same prism."""
    SELF = "AMI-EV, self-calibrated"
    """Events behind the prism, compensated as calibrated from the recording itself."""
    RAW = "AMI-EV, raw"
    """Events behind the prism, as recorded."""
    SAME_COUNT = "S-EV, same count"
    """Plain events, thinned, or from a longer window, to the number of events of the AMI-EV."""


class Frames(enum.StrEnum):
    """Standard cameras that are compared: their frames have an exposure of :data:`EXPOSURE_US` and 8 bits."""

    SLOW = "camera, 30/s"
    """30 frames per second."""
    FAST = "camera, 60/s"
    """60 frames per second."""

    @property
    def interval_us(self) -> int:
        """Time between two frames [us]."""
        return 33_333 if self is Frames.SLOW else 16_667


class RecordedStreams:
    """Streams of a recording without ground truth: its events as recorded, and compensated as calibrated."""

    def __init__(self, recording: Recording, device: str = "cpu") -> None:
        self.recording = recording
        self.device = device

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image [px]."""
        return self.recording.events.size

    @property
    def start_us(self) -> int:
        """Time of the first event [us]."""
        return self.recording.events.t_first

    @property
    def end_us(self) -> int:
        """Time after the last event [us]."""
        return self.recording.events.t_last + 1

    @property
    def names(self) -> tuple[Stream, ...]:
        """Streams that exist: a recording without encoder is one of a plain event camera."""
        if self.recording.encoder is None:
            return (Stream.PLAIN,)
        if self.own_calibration is None:
            return (Stream.RAW,)
        return (Stream.SELF, Stream.RAW)

    def names_with_own(self, settings: Settings) -> tuple[Stream, ...]:
        """Return the streams, in a full run with the one of the recording's own calibration."""
        known = self.names
        if settings.quick or Stream.SELF in known or self.recording.encoder is None:
            return known
        # Asked last, because it calibrates.
        if self.own_calibration is None:
            return known
        return (*known, Stream.SELF)

    @cached_property
    def own_calibration(self) -> Calibration | None:
        """Calibration from the recording itself, or None if it is refused."""
        with contextlib.suppress(AmiwarpError):
            return calibrate(self.recording, self._calibration_settings(), device=self.device)
        return None

    def _calibration_settings(self) -> CalibrationSettings:
        """Return the settings of the calibration: the defaults."""
        return CalibrationSettings()

    def window(self, stream: Stream, start_us: int, end_us: int) -> Events:
        """Return the events of a stream with ``start_us <= t < end_us``. Compensated coordinates are float32.

        Events that have no position without the prism are left out.
        """
        events, _ = self.indexed_window(stream, start_us, end_us)
        return events

    def count(self, stream: Stream, start_us: int, end_us: int) -> int:
        """Return the number of events that the stream's camera recorded with ``start_us <= t < end_us``."""
        source = self._source(stream).events
        return source.find(end_us) - source.find(start_us)

    def _source(self, stream: Stream) -> Recording:
        """Return the recording that the events of a stream are from."""
        return self.recording

    def indexed_window(
        self, stream: Stream, start_us: int, end_us: int
    ) -> tuple[Events, NDArray[np.int64]]:
        """Return the events of a window, and their indices in their recording."""
        source = self._source(stream).events
        first = source.find(start_us)
        raw = source.slice(first, source.find(end_us))
        rows = np.arange(first, first + len(raw))
        xy = self._compensated(stream, raw, first)
        if xy is None:
            return raw, rows
        kept = np.isfinite(xy).all(axis=1)
        return Events(xy[kept, 0], xy[kept, 1], raw.t[kept], raw.p[kept]), rows[kept]

    def _compensated(self, stream: Stream, raw: Events, first: int) -> NDArray[np.float32] | None:
        """Return the places of the events from index ``first`` without the prism; None if they are not compensated."""
        model, encoder = self.optics(stream)
        if model is None:
            return None
        return compensate_events(raw, model, encoder, device=self.device)

    def optics(self, stream: Stream) -> tuple[Model | None, Any]:
        """Return the model and the encoder that compensate a stream; both are None without compensation."""
        if stream is not Stream.SELF:
            return None, None
        return self._calibrated(self.own_calibration)

    def _calibrated(self, calibration: Calibration | None) -> tuple[Model | None, Any]:
        """Return the model and the encoder of a calibration."""
        if calibration is None:
            return None, None
        events = self.recording.events
        encoder = calibration.encoder_for(self.recording.encoder, events.t_first, events.t_last)
        return calibration.model, encoder


@dataclass(frozen=True)
class Setup:
    """What one recording of a still scene says about a prism and its sensor; it holds for all of their recordings."""

    calibration: Calibration | None
    """Calibration, or None if it is refused."""
    delay_us: float
    """Mean delay of the sensor [us], see :func:`sensor_delay`."""
    phase: float
    """Azimuth of the prism at the start of the recording [rad]."""


@lru_cache(maxsize=8)
def known_setup(condition: Condition, device: str) -> Setup:
    """Simulate and calibrate the recording of a :attr:`Condition.setup`, once in a process."""
    streams = Streams(condition, device)
    return Setup(streams.own_calibration, sensor_delay(streams), condition.phase)


def sensor_delay(streams: Streams) -> float:
    """Return the delay of the events [us] at which their image, compensated by the true model, is sharpest.

    At a constant speed ω, a delay τ of all events is the same as a phase of the prism that is smaller by ωτ. The delay
    holds the latency of the sensor and the mean lag of its photoreceptors.
    """
    from scipy.optimize import minimize_scalar

    recorded = streams.recording.events
    events = thinned(recorded.slice(0, len(recorded)), DELAY_EVENTS)
    encoder = streams.recording.encoder
    assert encoder is not None
    votes = Votes(CanvasShape(*streams.size), "cpu")

    def blur(delay_us: float) -> float:
        late = encoder.with_clock_offset(encoder.clock_offset_us - delay_us)
        xy = compensate_events(events, streams.true_model, late, device=streams.device)
        kept = np.isfinite(xy).all(axis=1)
        moved = Events(xy[kept, 0], xy[kept, 1], events.t[kept], events.p[kept])
        return -float(smooth_image(moved, votes, DENSITY_PX).var())

    optimum = minimize_scalar(
        blur, bounds=(0.0, LONGEST_DELAY_US), method="bounded", options={"xatol": 10.0}
    )
    return float(optimum.x)


class Streams(RecordedStreams):
    """Streams of a simulated recording with ground truth, and frames of a standard camera.

    Without ``setup``, its prism is calibrated when a stream first needs that.
    """

    def __init__(
        self, condition: Condition, device: str = "cpu", setup: Setup | None = None
    ) -> None:
        self.condition = condition
        if setup is not None:
            self.setup = setup
        self.simulation = condition.simulation(device)
        super().__init__(self.simulation.run(), device)
        self._places: dict[Stream, NDArray[np.float32] | None] = {}
        self.frame = lru_cache(maxsize=FRAMES_KEPT)(self._frame)
        self._exposed = lru_cache(maxsize=FRAMES_KEPT)(self._exposure)

    @property
    def start_us(self) -> int:
        """Start of the simulation [us]."""
        return 0

    @property
    def end_us(self) -> int:
        """End of the simulation [us]."""
        return self.simulation.duration_us

    @property
    def camera(self) -> Camera:
        """Camera of all streams."""
        return self.simulation.camera

    def _calibration_settings(self) -> CalibrationSettings:
        """Return the fast settings. For a camera that is known to rest, they leave out a rotation of the camera."""
        scene = self.simulation.scene
        moves = isinstance(scene, WorldScene) and scene.trajectory.moves
        return replace(FAST_CALIBRATION, free=None if moves else ("apex", "phase"))

    @cached_property
    def plain(self) -> Recording:
        """Recording of the plain event camera."""
        return self.simulation.without_prism().run()

    @property
    def names(self) -> tuple[Stream, ...]:
        """Streams that exist without a calibration from the recording itself."""
        missing = {Stream.SELF}
        if self.calibration is None:
            missing.add(Stream.CALIBRATED)
        return tuple(stream for stream in Stream if stream not in missing)

    @cached_property
    def setup(self) -> Setup:
        """What is known of the prism and the sensor from another recording."""
        return known_setup(self.condition.setup, self.device)

    @cached_property
    def calibration(self) -> Calibration | None:
        """Calibration of the prism behind this recording's lens, or None if it was refused.

        Its phase holds at the start of this recording: the encoder is absolute, but a simulated one starts at 0.
        """
        found = self.setup.calibration
        if found is None:
            return None
        phase = found.parameters["phase"] + self.condition.phase - self.setup.phase
        parameters = {**found.parameters, "phase": math.remainder(phase, 2.0 * math.pi)}
        return replace(found, camera=self.camera, parameters=parameters)

    @cached_property
    def true_model(self) -> Model:
        """True model of the prism."""
        return self.simulation.bending

    def event_truth(self, stream: Stream, start_us: int, end_us: int) -> EventTruth:
        """Return the ground truth of the events that :meth:`window` returns, in the same order."""
        _, rows = self.indexed_window(stream, start_us, end_us)
        source = self._source(stream)
        assert source.truth is not None
        if not len(rows):
            return source.truth.of_events(0, 0)
        # The truth is read in one piece; then the rows are picked that the window has.
        truth = source.truth.of_events(int(rows[0]), int(rows[-1]) + 1)
        offsets = rows - rows[0]
        picked = {}
        for name in ("points", "cause", "instance", "depth", "place"):
            value = getattr(truth, name)
            picked[name] = None if value is None else value[offsets]
        return EventTruth(**picked)

    def _source(self, stream: Stream) -> Recording:
        if stream in (Stream.PLAIN, Stream.SAME_COUNT):
            return self.plain
        return self.recording

    def _compensated(self, stream: Stream, raw: Events, first: int) -> NDArray[np.float32] | None:
        """Return the places as usual; all events of a stream are compensated once, and kept."""
        if stream not in self._places:
            source = self.recording.events
            self._places[stream] = super()._compensated(stream, source.slice(0, len(source)), 0)
        places = self._places[stream]
        if places is None:
            return None
        return places[first : first + len(raw)]

    @cached_property
    def _truth(self) -> TruthRenderer:
        return TruthRenderer(self.simulation)

    def _frame(self, t_us: int) -> FrameTruth:
        """Return the ground truth of all pixels at a time; :attr:`frame` keeps the last ones."""
        return self._truth.at(t_us)

    def indexed_window(
        self, stream: Stream, start_us: int, end_us: int
    ) -> tuple[Events, NDArray[np.int64]]:
        """Return the events of a window, and their indices in their recording."""
        if stream is not Stream.SAME_COUNT:
            return super().indexed_window(stream, start_us, end_us)
        source = self.plain.events
        rows = np.arange(source.find(start_us), source.find(end_us))
        rows = self._with_count(rows, self.count(Stream.RAW, start_us, end_us))
        if not len(rows):
            return Events.empty(), rows
        events = source.slice(int(rows[0]), int(rows[-1]) + 1)
        return events[rows - rows[0]], rows

    def _with_count(self, rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
        """Return ``count`` indices of plain events: drawn from ``rows``, or of a longer window around them.

        There are fewer if the whole recording has fewer events.
        """
        if len(rows) >= count:
            rng = np.random.default_rng(self.condition.seed)
            chosen = rng.choice(len(rows), count, replace=False)
            return rows[np.sort(chosen)]
        total = len(self.plain.events)
        middle = int(rows[0] + len(rows) // 2) if len(rows) else total // 2
        first = max(0, min(middle - count // 2, total - count))
        return np.arange(first, min(first + count, total))

    def optics(self, stream: Stream) -> tuple[Model | None, Any]:
        """Return the model and the encoder that compensate a stream; both are None without compensation."""
        if stream is Stream.TRUE:
            encoder = self.recording.encoder
            assert encoder is not None
            offset_us = encoder.clock_offset_us - self.setup.delay_us
            return self.true_model, encoder.with_clock_offset(offset_us)
        if stream is Stream.CALIBRATED:
            return self._calibrated(self.calibration)
        return super().optics(stream)

    def exposures(self, camera: Frames) -> NDArray[np.int64]:
        """Return the middles of the exposures of a standard camera's frames [us]; the first depends on the seed."""
        interval = camera.interval_us
        first = int(np.random.default_rng([self.condition.seed, 2]).integers(0, interval))
        starts = np.arange(self.start_us + first, self.end_us - EXPOSURE_US, interval)
        return np.asarray(starts + EXPOSURE_US // 2)

    def last_exposure(self, camera: Frames, t_us: int) -> int | None:
        """Return the middle of the exposure of the last frame that is complete at a time [us], or None."""
        middles = self.exposures(camera)
        complete = middles[middles + EXPOSURE_US // 2 <= t_us]
        return int(complete[-1]) if len(complete) else None

    def grey_frame(self, middle_us: int) -> NDArray[np.uint8]:
        """Return the frame of a standard camera, without the prism, whose exposure has the given middle [us]."""
        scaled = np.clip(self._exposed(middle_us) / self._white, 0.0, 1.0) ** GAMMA
        return np.asarray(np.rint(255.0 * scaled), np.uint8)

    def frame_luminance(self, middle_us: int) -> NDArray[np.float64]:
        """Return the luminance that a frame of the standard camera states."""
        return np.asarray(self._white * (self.grey_frame(middle_us) / 255.0) ** (1.0 / GAMMA))

    @cached_property
    def _white(self) -> float:
        """Luminance that a standard camera renders white: half a percent of the first frame is brighter."""
        return float(np.percentile(self._exposed(EXPOSURE_US // 2), 99.5)) or 1.0

    def _exposure(self, middle_us: int) -> NDArray[np.float64]:
        """Return the mean luminance over an exposure, by moments that divide it evenly."""
        # All frames of a picture that stays are the first one.
        if not self._changes and middle_us != EXPOSURE_US // 2:
            return self._exposed(EXPOSURE_US // 2)
        steps = EXPOSURE_STEPS[self.condition.trajectory] if self._changes else 1
        moments = middle_us + EXPOSURE_US * ((np.arange(steps) + 0.5) / steps - 0.5)
        return np.mean([self._truth.luminance(round(t)) for t in moments], axis=0, dtype=np.float64)

    @cached_property
    def _changes(self) -> bool:
        """Whether the picture changes: the camera or a body moves."""
        scene = self.simulation.scene
        assert isinstance(scene, WorldScene)
        return scene.trajectory.moves or bool(scene.world.moving)
