"""What all evaluations share: conditions, streams of events, measures, results, and tables with charts."""

from __future__ import annotations

import base64
import contextlib
import enum
import hashlib
import io
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special
from scipy.spatial import KDTree

from amiwarp.calib.calibration import calibrate
from amiwarp.calib.result import Calibration
from amiwarp.calib.settings import PhotometricSettings
from amiwarp.calib.settings import Settings as CalibrationSettings
from amiwarp.compensation.recordings import compensate_events
from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.events.recording import Events, Recording
from amiwarp.events.truth import EventTruth, FrameTruth
from amiwarp.imaging.iwe import CanvasShape, Votes
from amiwarp.imaging.metrics import TRUTH_PERCENTILES, picture_quality
from amiwarp.optics.camera import Camera, CameraRotation
from amiwarp.optics.models import Model
from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import PrismMotion, Scene
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation, TruthRenderer
from amiwarp.simulation.worlds.named.catalogue import named_world
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.validation import real, whole

# Test picture of discs, whose edges are known: their distance from compensated events is the blur that is left.

PITCH_PX, RADIUS_PX = 80.0, 20.0
"""Distance between the centres of the discs, and their radius [px]."""
REACH_PX = 18.0
"""Largest distance from an edge at which events belong to it [px]; the next edge is 40 px away or more."""
SHIFT_PX = 10.0
"""Largest shift of all discs, drawn at random [px]."""
BACKGROUND, LUMINANCES = 0.25, (1.0, 0.12, 0.5, 0.06)
"""Luminance of the background and of the discs, white is 1. Two are brighter than the background, two are darker."""
FINENESS = 4
"""Pixels of the picture per pixel of the sensor, along each axis."""


@dataclass(frozen=True, eq=False)
class DiscTarget:
    """Discs on a plane at infinity."""

    centres: NDArray[np.float64]
    """Centres in the image without the prism [px], shape ``(n, 2)``."""
    luminance: NDArray[np.float64]
    """Luminance of each disc, shape ``(n,)``."""
    size: tuple[int, int]
    """Width and height of the image [px]."""

    @classmethod
    def of_seed(cls, size: tuple[int, int], seed: int) -> DiscTarget:
        """Return the discs that an image of ``size`` (width, height) holds, shifted and mixed by a seed."""
        rng = np.random.default_rng([seed, 1])
        columns, rows = (max(1, int((n - 2 * SHIFT_PX) // PITCH_PX)) for n in size)
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
        middle = (np.array(size) - 1.0) / 2.0 + rng.uniform(-SHIFT_PX, SHIFT_PX, 2)
        centres = middle + PITCH_PX * (grid - (np.array([columns, rows]) - 1.0) / 2.0)
        return cls(centres, rng.permutation(np.resize(LUMINANCES, len(grid))), size)

    def scene(self, focal_px: float) -> Scene:
        """Return the scene for a camera of a focal length [px] whose principal point is the image's middle."""
        margin = int(PITCH_PX)
        shape = [FINENESS * (n + 2 * margin) for n in self.size]
        x, y = ((np.arange(n) + 0.5) / FINENESS - margin - 0.5 for n in shape)
        light = np.full(shape[::-1], BACKGROUND, np.float32)
        for (cx, cy), luminance in zip(self.centres, self.luminance, strict=True):
            light[(x - cx) ** 2 + (y[:, None] - cy) ** 2 < RADIUS_PX**2] = luminance
        return Scene.from_picture(light, fov=2.0 * math.atan(0.5 * shape[0] / FINENESS / focal_px))

    def distances(self, xy: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the distance of each place from the edge of its disc [px], positive outside, and the disc's luminance.

        Places further than :data:`REACH_PX` from all edges are left out.
        """
        nearest = np.asarray(KDTree(self.centres).query(xy)[1], np.intp)
        distance = np.hypot(*(xy - self.centres[nearest]).T) - RADIUS_PX
        near = np.abs(distance) <= REACH_PX
        return distance[near], self.luminance[nearest[near]]


def robust_spread(distance: NDArray[np.floating], group: NDArray[np.floating]) -> float:
    """Return half the range that holds the middle 68.3 % of the distances [px]; inf without any.

    The median of each group is subtracted first: a blurred edge of light lies towards the darker side in its logarithm.
    For normal distances it is their standard deviation.
    """
    if not len(distance):
        return float("inf")
    away = np.array(distance, np.float64)
    for value in np.unique(group):
        away[group == value] -= np.median(away[group == value])
    low, high = np.quantile(away, (0.158655, 0.841345))
    return float(high - low) / 2.0


INDEX = 1.55
"""Refractive index of the paper's prism."""
FOCAL_PX = 554.0
"""Focal length [px]: that of 640 px over a field of view of 60 deg. A smaller image is the middle of the sensor: its
displacements in pixels are the same."""
FEATURES_APEX = math.radians(1.0)
"""Apex angle of the paper's corners and segmentation [rad]; elsewhere it is 0.5 deg."""
NOMINAL = 1.15
"""Nominal apex angle that calibration starts from, relative to the true one."""

DISCS = "discs"
"""Name of the picture of :class:`DiscTarget` among the worlds."""
IDEAL, BANDWIDTH = "none", "bandwidth"
"""Names of the sensor without any of :data:`LIMITS`, and of the limit of its photoreceptors."""
LIMITS = {
    BANDWIDTH: ("cutoff_hz",),
    "refractory period": ("refractory_us",),
    "readout": ("row_us", "bus_rate_mev_s", "bus_queue"),
    "latency jitter": ("latency_us", "latency_jitter_us"),
    "mismatch and noise": ("mismatch", "leak_hz", "shot_noise_hz", "shot_noise_dark"),
}
"""Limits of a sensor, by the fields of :class:`amiwarp.SensorModel` that describe them."""
FAST_CALIBRATION = CalibrationSettings(
    model="exact", global_evaluations=40, events=60_000, tolerance_px=0.01,
    photometric=PhotometricSettings(steps=6, tolerance_px=0.005),
)  # fmt: skip
"""Settings of the calibration of simulated recordings, whose optics are known to be exact.

They take two fifths of the time of the default ones. On a recording of the room with a handheld camera, the result is
0.011 px (rms) from theirs.
"""
SETUP_SEED, SETUP_S = 1_000_003, 2.0
"""Seed of the recording that a prism is calibrated from once, which no evaluation scores, and its duration [s]."""
LONGEST_DELAY_US = 4000.0
"""Longest mean delay of a sensor that is looked for [us]."""
DELAY_EVENTS = 300_000
"""Largest number of events from which it is determined; more are thinned evenly."""
EXPOSURE_US = 8000
"""Exposure of a frame of the standard camera [us]."""
EXPOSURE_STEPS = {"still": 1, "handheld": 4, "fast": 12}
"""Number of moments of an exposure that are rendered and averaged, by the camera's motion: about one per pixel."""
GAMMA = 1.0 / 2.2
"""Exponent from luminance to the grey values of a picture."""
FRAMES_KEPT = 64
"""Number of instants whose ground truth is kept; more than an evaluation uses for several streams."""
ENOUGH = 0.95
"""Smallest number of events of the stream with the same count, relative to those of the AMI-EV."""


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


@dataclass(frozen=True)
class Condition:
    """Description of a simulated recording."""

    world: str = "room"
    """Name of the world, see :func:`amiwarp.named_world`; or :data:`DISCS` for a picture of discs at infinity."""
    trajectory: str = "handheld"
    """Motion of the camera: still, handheld or fast."""
    apex: float = math.radians(0.5)
    """Apex angle of the prism [rad]."""
    rpm: float = 720.0
    """Speed of the prism [turns/min]."""
    seed: int = 0
    """Seed of the world, of the camera's motion and of the sensor."""
    duration_s: float = 0.25
    """Duration [s]."""
    width: int = 240
    """Width of the image [px]."""
    height: int = 180
    """Height of the image [px]."""
    focal_px: float = FOCAL_PX
    """Focal length [px]."""
    sensor: str = "dvxplorer"
    """Name of the sensor, see :meth:`amiwarp.SensorModel.preset`."""
    cutoff_hz: float | None = None
    """Bandwidth of the photoreceptors at white [Hz], 0 for unlimited; None for that of the sensor."""
    only: str | None = None
    """The only one of :data:`LIMITS` that the sensor has, or :data:`IDEAL` for none of them; None for all."""

    @property
    def key(self) -> str:
        """Short text that identifies the condition."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:12]

    @property
    def phase(self) -> float:
        """Azimuth of the prism at the start of the recording [rad], which depends on the seed."""
        return float(np.random.default_rng(self.seed).uniform(0.0, 2.0 * math.pi))

    @property
    def text(self) -> str:
        """Description in words: world, motion, prism and seed, and what else differs from the defaults."""
        said = {"world", "trajectory", "apex", "rpm", "seed"}
        others = [f"{f.name} {getattr(self, f.name)}" for f in fields(self)
                  if f.name not in said and getattr(self, f.name) != f.default]  # fmt: skip
        prism = f"apex {math.degrees(self.apex):.4g}°, {self.rpm:g} rpm"
        return ", ".join([f"{self.world} {self.trajectory}", prism, f"seed {self.seed}", *others])

    @property
    def setup(self) -> Condition:
        """Recording of a still scene by the usual lens that the same prism and sensor are calibrated from."""
        return replace(self, world="room", trajectory="still", seed=SETUP_SEED, duration_s=SETUP_S, focal_px=FOCAL_PX)

    def simulation(self, device: str) -> Simulation:
        """Return the simulation of the AMI-EV under this condition."""
        return Simulation(
            self._scene(),
            Camera.from_fov(self.width, self.height, 2.0 * math.atan(self.width / (2.0 * self.focal_px))),
            Prism(self.apex, INDEX),
            self.duration_s,
            motion=PrismMotion(self.rpm, self.phase),
            sensor=self._sensor(),
            nominal_prism=Prism(NOMINAL * self.apex, INDEX),
            seed=self.seed,
            device=device,
        )

    def _scene(self) -> Scene | WorldScene:
        if self.world == DISCS:
            return DiscTarget.of_seed((self.width, self.height), self.seed).scene(self.focal_px)
        return WorldScene(*named_world(self.world, self.trajectory, seed=self.seed, duration_s=self.duration_s))

    def _sensor(self) -> SensorModel:
        """Return the sensor with this condition's bandwidth, and without the limits that it leaves out."""
        sensor = SensorModel.preset(self.sensor)
        if self.only is not None:
            ideal = SensorModel.ideal(sensor.contrast_on)
            sensor = replace(ideal, **{name: getattr(sensor, name) for name in LIMITS.get(self.only, ())})
        return sensor if self.cutoff_hz is None else replace(sensor, cutoff_hz=self.cutoff_hz)


@dataclass(frozen=True)
class RecordedCondition:
    """Recording of a real camera, given as a file."""

    path: Path
    """File of the recording."""
    seed: int = 0
    """Seed of the calibration."""

    @property
    def text(self) -> str:
        """Name of the file."""
        return str(self.path)

    @property
    def key(self) -> str:
        """Short text that identifies the recording."""
        stat = self.path.stat()
        text = json.dumps([str(self.path.resolve()), stat.st_size, stat.st_mtime_ns, self.seed])
        return hashlib.sha256(text.encode()).hexdigest()[:12]


class RecordedStreams:
    """Streams of a recording without ground truth: its events as recorded, and compensated as calibrated."""

    def __init__(self, recording: Recording, device: str = "cpu") -> None:
        self.recording, self.device = recording, device

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
        return (Stream.RAW,) if self.own_calibration is None else (Stream.SELF, Stream.RAW)

    def names_with_own(self, settings: Settings) -> tuple[Stream, ...]:
        """Return the streams, in a full run with that of the recording's own calibration."""
        known = self.names
        more = not settings.quick and Stream.SELF not in known and self.recording.encoder is not None
        return (*known, Stream.SELF) if more and self.own_calibration is not None else known

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

    def indexed_window(self, stream: Stream, start_us: int, end_us: int) -> tuple[Events, NDArray[np.int64]]:
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
        return None if model is None else compensate_events(raw, model, encoder, device=self.device)

    def optics(self, stream: Stream) -> tuple[Model | None, Any]:
        """Return the model and the encoder that compensate a stream; both are None without compensation."""
        return self._calibrated(self.own_calibration) if stream is Stream.SELF else (None, None)

    def _calibrated(self, found: Calibration | None) -> tuple[Model | None, Any]:
        """Return the model and the encoder of a calibration."""
        if found is None:
            return None, None
        recording, events = self.recording, self.recording.events
        return found.model, found.encoder_for(recording.encoder, events.t_first, events.t_last)


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

    events = thinned(streams.recording.events.slice(0, len(streams.recording.events)), DELAY_EVENTS)
    encoder, votes = streams.recording.encoder, Votes(CanvasShape(*streams.size), "cpu")
    assert encoder is not None

    def blur(delay_us: float) -> float:
        late = encoder.with_clock_offset(encoder.clock_offset_us - delay_us)
        xy = compensate_events(events, streams.true_model, late, device=streams.device)
        kept = np.isfinite(xy).all(axis=1)
        moved = Events(xy[kept, 0], xy[kept, 1], events.t[kept], events.p[kept])
        return -float(smooth_image(moved, votes, DENSITY_PX).var())

    found = minimize_scalar(blur, bounds=(0.0, LONGEST_DELAY_US), method="bounded", options={"xatol": 10.0})
    return float(found.x)


class Streams(RecordedStreams):
    """Streams of a simulated recording with ground truth, and frames of a standard camera.

    Without ``setup``, its prism is calibrated when a stream first needs that.
    """

    def __init__(self, condition: Condition, device: str = "cpu", setup: Setup | None = None) -> None:
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
        missing = {Stream.SELF} | (set() if self.calibration is not None else {Stream.CALIBRATED})
        return tuple(s for s in Stream if s not in missing)

    @cached_property
    def setup(self) -> Setup:
        """What is known of the prism and the sensor from another recording."""
        return known_setup(self.condition.setup, self.device)

    @cached_property
    def calibration(self) -> Calibration | None:
        """Calibration of the prism behind this recording's lens, or None if it was refused.

        Its phase is that at the start of this recording: the encoder is absolute, but a simulated one starts at 0.
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
        truth = source.truth.of_events(int(rows[0]), int(rows[-1]) + 1)
        at = rows - rows[0]
        values = {name: getattr(truth, name) for name in ("points", "cause", "instance", "depth", "place")}
        return EventTruth(**{name: None if value is None else value[at] for name, value in values.items()})

    def _source(self, stream: Stream) -> Recording:
        return self.plain if stream in (Stream.PLAIN, Stream.SAME_COUNT) else self.recording

    def _compensated(self, stream: Stream, raw: Events, first: int) -> NDArray[np.float32] | None:
        """Return the places as usual; all events of a stream are compensated once, and kept."""
        if stream not in self._places:
            source = self.recording.events
            self._places[stream] = super()._compensated(stream, source.slice(0, len(source)), 0)
        places = self._places[stream]
        return None if places is None else places[first : first + len(raw)]

    @cached_property
    def _truth(self) -> TruthRenderer:
        return TruthRenderer(self.simulation)

    def _frame(self, t_us: int) -> FrameTruth:
        """Return the ground truth of all pixels at a time; :attr:`frame` keeps the last ones."""
        return self._truth.at(t_us)

    def indexed_window(self, stream: Stream, start_us: int, end_us: int) -> tuple[Events, NDArray[np.int64]]:
        """Return the events of a window, and their indices in their recording."""
        if stream is not Stream.SAME_COUNT:
            return super().indexed_window(stream, start_us, end_us)
        source = self.plain.events
        rows = np.arange(source.find(start_us), source.find(end_us))
        rows = self._with_count(rows, self.count(Stream.RAW, start_us, end_us))
        if not len(rows):
            return Events.empty(), rows
        return source.slice(int(rows[0]), int(rows[-1]) + 1)[rows - rows[0]], rows

    def _with_count(self, rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
        """Return ``count`` indices of plain events: drawn from ``rows``, or of a longer window around them.

        There are fewer if the whole recording has fewer events.
        """
        if len(rows) >= count:
            chosen = np.random.default_rng(self.condition.seed).choice(len(rows), count, replace=False)
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
            return self.true_model, encoder.with_clock_offset(encoder.clock_offset_us - self.setup.delay_us)
        return self._calibrated(self.calibration) if stream is Stream.CALIBRATED else super().optics(stream)

    def exposures(self, camera: Frames) -> NDArray[np.int64]:
        """Return the middles of the exposures of a standard camera's frames [us]; the first depends on the seed."""
        interval = camera.interval_us
        first = int(np.random.default_rng([self.condition.seed, 2]).integers(0, interval))
        starts = np.arange(self.start_us + first, self.end_us - EXPOSURE_US, interval)
        return np.asarray(starts + EXPOSURE_US // 2)

    def last_exposure(self, camera: Frames, t_us: int) -> int | None:
        """Return the middle of the exposure of the last frame that is complete at a time [us], or None."""
        complete = [int(m) for m in self.exposures(camera) if m + EXPOSURE_US // 2 <= t_us]
        return complete[-1] if complete else None

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


# What evaluations return: results of cells, tables with their charts, and pictures.

Compared = Literal[*Stream, *Frames]  # type: ignore[valid-type]
"""Type of what is compared: a stream of events or a standard camera."""
Share = Annotated[float, partial(real, low=0.0, high=1.0)]
"""Type of a share in a cell, 0 to 1."""
Amount = Annotated[float, partial(real, low=0.0, high=1e6)]
"""Type of a measured value in a cell that is not negative: pixels, degrees, milliseconds, relative rates and so on."""
Count = Annotated[int, partial(whole, low=0, high=10**12)]
"""Type of a number of things in a cell."""
Value = str | int | float | bool | None
"""Type of a value in a table."""


@dataclass(frozen=True)
class Settings:
    """Size of a run."""

    quick: bool = True
    """Whether the run is short: a small image and few values."""
    seeds: int = 2
    """Number of seeds of each condition."""
    first_seed: int = 1
    """First seed. The settings of the algorithms were chosen with seed 0, which is therefore not scored."""
    width: int = 240
    """Width of the images [px]."""
    height: int = 180
    """Height of the images [px]."""
    duration_s: float = 0.25
    """Duration of a recording [s]."""
    device: str = "cpu"
    """Device that computes."""

    def conditions(self, **values: Any) -> list[Condition]:
        """Return a condition of this size for each seed, with the given ``values`` of its other fields."""
        size = {"width": self.width, "height": self.height, "duration_s": self.duration_s}
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return [Condition(**{**size, **values}, seed=seed) for seed in seeds]

    def scenes(self) -> list[Condition]:
        """Return the room at rest and moving; in full also in fast motion, and the desk and the street."""
        scenes = [("room", "still"), ("room", "handheld")]
        scenes += [] if self.quick else [("room", "fast"), ("desk", "handheld"), ("street", "handheld")]
        return [c for world, motion in scenes for c in self.conditions(world=world, trajectory=motion)]


QUICK = Settings()
FULL = Settings(quick=False, seeds=10, width=320, height=240)


def wide_focal(settings: Settings) -> float:
    """Return the focal length with which an image of any size sees what the whole sensor does [px]."""
    return FOCAL_PX * settings.width / 640.0


@dataclass(frozen=True)
class CellResult:
    """Result of one evaluation under one condition."""

    evaluation: str
    """Name of the evaluation."""
    condition: Condition | RecordedCondition
    """Condition under which it ran."""
    values: dict[str, Any] = field(default_factory=dict)
    """Values that the evaluation's function ``measure`` returned; empty if it failed."""
    error: str = ""
    """Message of an error that ended it, or empty."""
    processor_s: float = 0.0
    """Processor time of the measure [s], without the simulation."""


class ChartKind(enum.StrEnum):
    """Kinds of charts."""

    LINES = "lines"
    BARS = "bars"


@dataclass(frozen=True)
class Chart:
    """Chart of a table. All texts but the labels are names of columns."""

    x: str
    """Column of the horizontal axis."""
    y: str
    """Column of the vertical axis."""
    series: str
    """Column whose values are drawn as separate lines or bars."""
    spread: str | None = None
    """Column of the standard deviation over seeds, drawn as a band or as error bars."""
    panels: tuple[str, ...] = ()
    """Columns whose combinations are drawn in separate panels."""
    kind: ChartKind = ChartKind.LINES
    """Kind of the chart."""
    log_x: bool = False
    """Whether the horizontal axis is logarithmic."""
    log_y: bool = False
    """Whether the vertical axis is logarithmic."""
    marks: dict[str, float] = field(default_factory=dict)
    """Values of the vertical axis that are marked by a horizontal line, by their labels, such as the paper's."""


@dataclass(frozen=True)
class Table:
    """Table of results."""

    name: str
    """Name of its files."""
    title: str
    """Title: what is measured."""
    columns: tuple[str, ...]
    """Names of the columns, with their units."""
    rows: list[tuple[Value, ...]]
    """Rows."""
    caption: str = ""
    """What can be seen, and how to read it."""
    chart: Chart | None = None
    """Chart of the table, or None."""
    long: bool = False
    """Whether the table is too long for the page and for ``report.json``, and is only written as CSV."""


@dataclass(frozen=True)
class Picture:
    """Picture or film in the report."""

    name: str
    """Name of its file."""
    caption: str
    """What can be seen."""
    frames: list[NDArray[np.uint8]]
    """Picture, or frames of the film, shape ``(height, width)`` or ``(height, width, 3)``."""
    frame_s: float = 0.1
    """Time that a frame of a film is shown [s]."""


MOST_PIXELS = 1 << 22
"""Largest number of pixels of a picture in a cell."""


def rows_of(results: Sequence[CellResult], name: str) -> list[dict[str, Any]]:
    """Return the rows that the cells' values hold under ``name``, with the fields of their conditions.

    Each row also has ``scene`` (the world, or the name of a recording) and ``camera`` (the camera's motion).
    """
    rows = []
    for result in results:
        condition = result.condition
        if isinstance(condition, Condition):
            known = {**asdict(condition), "scene": condition.world, "camera": condition.trajectory}
        else:
            known = {"scene": condition.path.name, "camera": "recording", "seed": condition.seed}
        rows += [{**known, **row} for row in result.values.get(name, ())]
    return rows


def grouped(rows: Sequence[dict[str, Any]], by: Sequence[str], values: Sequence[str]) -> list[tuple[Value, ...]]:
    """Return one row for each combination of the columns ``by``, in order of appearance.

    A row holds the combination, the number of rows, and for each of ``values`` the mean and the standard deviation.
    Values that are None or NaN are left out.
    """
    groups: dict[tuple[Value, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    out: list[tuple[Value, ...]] = []
    for key, members in groups.items():
        cells: list[Value] = [*key, len(members)]
        for name in values:
            given = np.array([m[name] for m in members if m.get(name) is not None], np.float64)
            given = given[np.isfinite(given)]
            cells += [float(given.mean()), float(given.std())] if given.size else [None, None]
        out.append(tuple(cells))
    return out


def finite(value: float) -> float | None:
    """Return a number for a cell; None if it is not finite."""
    return value if np.isfinite(value) else None


def encode_picture(picture: NDArray[np.uint8]) -> str:
    """Return a picture as text, for the values of a cell."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode()


def decode_picture(text: str, what: str = "the picture") -> NDArray[np.uint8]:
    """Return a picture of :func:`encode_picture`. Raises :class:`AmiwarpError` for other texts."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(base64.b64decode(text, validate=True)), formats=["PNG"]) as picture:
            if picture.width * picture.height <= MOST_PIXELS:
                return np.asarray(picture)
    except Exception as error:  # PIL raises many kinds
        raise AmiwarpError(f"{what} cannot be decoded: {error}") from error
    raise AmiwarpError(f"{what} has {picture.width}x{picture.height} px; expected at most {MOST_PIXELS:,} pixels")


def check_pictures(texts: Sequence[str], axes: int, what: str) -> None:
    """Check that texts are pictures of 8-bit values, all of one shape of ``axes`` axes."""
    found = {(picture.shape, picture.dtype.str) for picture in map(partial(decode_picture, what=what), texts)}
    if len(found) > 1 or any(len(shape) != axes or kind != "|u1" for shape, kind in found):
        raise AmiwarpError(f"{what} has pictures of shapes and types {found}; expected one shape of {axes} axes, 8 bit")


# Optional libraries of the evaluations.


def library(name: str) -> Any:
    """Return a module of an optional library. Raises :class:`AmiwarpError` if it is not installed."""
    return optional_module(name, "evaluate", f"'amiwarp evaluate' needs {name.partition('.')[0]}")


# Gaussian smoothing of images.


def smoothed(image: NDArray[Any], sigma: float, *, truncate: float = 4.0, mirrored: bool = True) -> NDArray[np.float32]:
    """Return an image smoothed by a Gaussian of standard deviation ``sigma`` [px]; OpenCV is the fastest on one core.

    ``truncate``: radius at which the Gaussian ends [standard deviations]. Outside, the image is ``mirrored``, or zero.
    """
    plain, cv2 = np.ascontiguousarray(image, np.float32), library("cv2")
    if sigma <= 0.0:
        return plain
    side = 2 * int(truncate * sigma + 0.5) + 1
    border = cv2.BORDER_REFLECT if mirrored else cv2.BORDER_CONSTANT
    return np.asarray(cv2.GaussianBlur(plain, (side, side), sigma, borderType=border), np.float32)


# Natural image quality evaluator (NIQE): distance of a picture's statistics from those of natural pictures.
#
# Source: A. Mittal, R. Soundararajan and A. C. Bovik, "Making a 'Completely Blind' Image Quality Analyzer", IEEE Signal
# Processing Letters 2013. This is an independent implementation. Its natural pictures are :data:`PICTURES`, not those
# of the authors, so values are comparable with each other, but not with published ones.

BLOCK = 96
"""Side of a block of pixels [px]."""
SCALES = 2
"""Number of scales; the second has half the resolution."""
FEATURES = 36
"""Number of features of a block: 18 per scale."""
WINDOW_SIGMA = 7.0 / 6.0
"""Standard deviation of the local mean's window of 7 x 7 px [px]."""
SHARP_SHARE = 0.75
"""Share of the sharpest block's mean local deviation below which a block of a natural picture is not used."""
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Steps (rows, columns) from a pixel to the neighbours with which it is multiplied."""
PICTURES = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel", "rocket")
"""Natural pictures of ``skimage.data``, all in the public domain or under CC0, and installed with scikit-image."""
SHAPES = np.arange(0.2, 10.001, 0.001)
"""Shapes of generalised Gaussians among which the fit chooses."""


@dataclass(frozen=True, eq=False)
class NaturalPictures:
    """Statistics of the features of natural pictures."""

    mean: NDArray[np.float64]
    """Mean of the features, shape ``(36,)``."""
    covariance: NDArray[np.float64]
    """Covariance of the features, shape ``(36, 36)``."""


def niqe(picture: NDArray[Any], natural: NaturalPictures | None = None) -> float:
    """Return the NIQE of a grey picture with values from 0 to 255. Lower is more natural.

    ``natural``: statistics of natural pictures, by default :func:`shipped_pictures`. The picture needs at least two
    blocks of 96 x 96 px, else :class:`AmiwarpError` is raised.
    """
    natural = natural or shipped_pictures()
    features, _ = block_features(picture)
    if len(features) < 2:
        raise AmiwarpError(f"picture has shape {picture.shape}; NIQE needs two blocks of {BLOCK} x {BLOCK} px")
    distance = features.mean(axis=0) - natural.mean
    pooled = (np.cov(features, rowvar=False) + natural.covariance) / 2.0
    return float(np.sqrt(distance @ np.linalg.pinv(pooled) @ distance))


def fit(pictures: list[NDArray[Any]]) -> NaturalPictures:
    """Return the statistics of the sharp blocks of grey pictures with values from 0 to 255."""
    rows = []
    for picture in pictures:
        features, sharpness = block_features(picture)
        rows.append(features[sharpness > SHARP_SHARE * sharpness.max()])
    table = np.concatenate(rows)
    if len(table) <= FEATURES:
        raise AmiwarpError(f"NIQE's statistics have {len(table)} sharp blocks; give pictures with over {FEATURES}")
    return NaturalPictures(table.mean(axis=0), np.cov(table, rowvar=False))


@cache
def shipped_pictures() -> NaturalPictures:
    """Return the statistics of :data:`PICTURES`, each in its size and scaled to three quarters and to half."""
    data, colour = library("skimage.data"), library("skimage.color")
    resize = library("skimage.transform").rescale
    grey = []
    for name in PICTURES:
        picture = getattr(data, name)()
        picture = 255.0 * colour.rgb2gray(picture) if picture.ndim == 3 else picture.astype(np.float64)
        grey += [picture, *(resize(picture, scale, anti_aliasing=True, preserve_range=True) for scale in (0.75, 0.5))]
    return fit(grey)


def block_features(picture: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the features of each block, shape (n, 36), and the blocks' mean local deviation, shape (n,)."""
    rows, columns = (side // BLOCK for side in picture.shape)
    if not rows or not columns:
        raise AmiwarpError(f"picture has shape {picture.shape}; NIQE needs blocks of {BLOCK} x {BLOCK} px")
    image = picture[: rows * BLOCK, : columns * BLOCK].astype(np.float64)
    columns_of: list[NDArray[np.float64]] = []
    sharpness = np.zeros(0)
    for scale in range(SCALES):
        if scale:
            image = library("skimage.transform").rescale(image, 0.5, order=3, anti_aliasing=True, preserve_range=True)
        coefficients, deviation = locally_normalised(image)
        side = BLOCK >> scale
        columns_of.append(np.array([_block(part) for part in _blocks(coefficients, side)]))
        if not scale:
            sharpness = np.array([part.mean() for part in _blocks(deviation, side)])
    return np.concatenate(columns_of, axis=1), sharpness


def locally_normalised(image: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the picture less its local mean, over its local deviation plus 1, and that deviation."""
    mean = ndimage.gaussian_filter(image, WINDOW_SIGMA, radius=3, mode="nearest")
    square = ndimage.gaussian_filter(image * image, WINDOW_SIGMA, radius=3, mode="nearest")
    deviation = np.sqrt(np.abs(square - mean * mean))
    return (image - mean) / (deviation + 1.0), deviation


def _blocks(image: NDArray[np.float64], side: int) -> list[NDArray[np.float64]]:
    """Return the square blocks of an image whose sides are multiples of ``side`` [px]."""
    rows, columns = (n // side for n in image.shape)
    return [image[i * side : (i + 1) * side, j * side : (j + 1) * side] for i in range(rows) for j in range(columns)]


def _block(part: NDArray[np.float64]) -> list[float]:
    """Return the 18 features of a block of normalised pixels."""
    shape, left, right = asymmetric_gaussian(part)
    features = [shape, (left + right) / 2.0]
    for step in NEIGHBOURS:
        shape, left, right = asymmetric_gaussian(part * np.roll(part, step, axis=(0, 1)))
        mean = (right - left) * float(special.gamma(2.0 / shape) / special.gamma(1.0 / shape))
        features += [shape, mean, left, right]
    return features


def asymmetric_gaussian(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return shape, left scale and right scale of an asymmetric generalised Gaussian, by its moments.

    Source: N.-E. Lasmar, Y. Stitou and Y. Berthoumieu, "Multiscale skewed heavy tailed model for texture analysis",
    ICIP 2009.
    """
    flat = values.ravel()
    left, right = (np.sqrt(np.mean(side**2)) if side.size else 1e-6 for side in (flat[flat < 0], flat[flat > 0]))
    left, right = max(float(left), 1e-6), max(float(right), 1e-6)
    ratio = left / right
    flatness = np.mean(np.abs(flat)) ** 2 / max(float(np.mean(flat**2)), 1e-12)
    wanted = flatness * (ratio**3 + 1.0) * (ratio + 1.0) / (ratio**2 + 1.0) ** 2
    shape = float(SHAPES[np.argmin((_flatness() - wanted) ** 2)])
    scale = float(np.sqrt(special.gamma(1.0 / shape) / special.gamma(3.0 / shape)))
    return shape, left * scale, right * scale


@cache
def _flatness() -> NDArray[np.float64]:
    """Return the squared mean absolute value over the mean square, of a generalised Gaussian of each shape."""
    one, two, three = (special.gamma(k / SHAPES) for k in (1.0, 2.0, 3.0))
    return np.asarray(two**2 / (one * three))


# Similarity of a picture to the true luminance.


@dataclass(frozen=True, slots=True)
class Similarity:
    """Similarity of a picture to the true one."""

    psnr_db: float
    """Peak signal-to-noise ratio [dB]; infinite for equal pictures."""
    ssim: float
    """Structural similarity, up to 1."""


def similarity(picture: NDArray[Any], truth: NDArray[Any]) -> Similarity:
    """Return PSNR and SSIM of two pictures with values from 0 to 1 and one shape, by scikit-image.

    SSIM has the settings of its authors: a Gaussian window of 1.5 px. Z. Wang et al., "Image Quality Assessment: From
    Error Visibility to Structural Similarity", IEEE Transactions on Image Processing 2004.
    Raises :class:`AmiwarpError` for different shapes.
    """
    if picture.shape != truth.shape:
        raise AmiwarpError(f"picture and truth have shapes {picture.shape} and {truth.shape}; give equal shapes")
    metrics = library("skimage.metrics")
    a, b = truth.astype(np.float64), picture.astype(np.float64)
    psnr = float("inf") if np.array_equal(a, b) else float(metrics.peak_signal_noise_ratio(a, b, data_range=1.0))
    ssim = metrics.structural_similarity(
        a, b, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    return Similarity(psnr, float(ssim))


def fitted(picture: NDArray[Any], log_truth: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a picture and the true log luminance, shape (height, width), in one range from 0 to 1.

    Events determine log luminance only up to gain and offset, which are fitted by least squares. A constant picture
    becomes the mean of the truth. 0 and 1 are the percentiles :data:`TRUTH_PERCENTILES` of the truth, and values
    outside are clipped. Raises :class:`AmiwarpError` for values that are not finite and a constant truth.
    """
    a, b = picture.astype(np.float64), log_truth.astype(np.float64)
    if np.ptp(a) > 0.0:
        quality = picture_quality(a, b)
        a = quality.gain * a + quality.offset
    else:
        a = np.full(b.shape, b.mean())
    low, high = np.percentile(b, TRUTH_PERCENTILES)
    if not high > low:
        raise AmiwarpError("the true luminance is constant, so a picture cannot be compared with it")
    return np.clip((a - low) / (high - low), 0.0, 1.0), np.clip((b - low) / (high - low), 0.0, 1.0)


def displayed(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Return a picture in the grey values 0 to 255: its percentiles :data:`TRUTH_PERCENTILES` become 0 and 255."""
    low, high = np.percentile(picture, TRUTH_PERCENTILES)
    if not high > low:
        return np.full(picture.shape, 128.0)
    return np.clip((picture.astype(np.float64) - low) / (high - low), 0.0, 1.0) * 255.0


# Motion by contrast maximisation: the motion whose compensation makes the image of warped events sharpest.
#
# Source: G. Gallego, H. Rebecq and D. Scaramuzza, "A Unifying Contrast Maximization Framework for Event Cameras", CVPR
# 2018. Coordinates may be those of a sensor, or compensated.

SMOOTHING_PX = (5.0, 1.0)
"""Standard deviations of the Gaussian that smooths the image, from coarse to fine [px]."""
DENSITY_PX = 1.0
"""Standard deviation of the Gaussian that smooths the density of events in local sharpness [px]."""
TILE_PX = 24
"""Side of the tiles whose sharpness is compared [px]."""
LEAST_SHARE = 0.25
"""Number of events, relative to the median tile, below which a tile is left out."""
MOST_EVENTS = 40_000
"""Largest number of events from which the camera's rotation is estimated; more are thinned evenly."""
MOST_LOCAL = 100_000
"""Largest number of events from which local motion is estimated; more are thinned evenly."""


def thinned(events: Events, most: int) -> Events:
    """Return at most ``most`` of the events, spread evenly."""
    return events[:: max(1, -(-len(events) // most))]


def rotated_back(events: Events, camera: Camera, rotation: CameraRotation) -> Events:
    """Return the events where the camera saw their scene points at ``rotation.middle_us``."""
    rays = camera.pixels_to_rays(np.stack([events.x, events.y], axis=1).astype(np.float32))
    tau = ((events.t - rotation.middle_us) * 1e-6).astype(np.float64)
    xy = camera.rays_to_pixels(turned(rays, rotation.rotation(tau)).astype(np.float32))
    return Events(xy[:, 0].copy(), xy[:, 1].copy(), events.t, events.p)


def turned(rays: NDArray[np.floating], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays turned by rotation vectors [rad], both of shape (n, 3), by the formula of Rodrigues."""
    angle = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    axis = vectors / np.maximum(angle, 1e-300)
    cos, (ax, ay, az), (x, y, z) = np.cos(angle), axis.T, rays.T
    across = np.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x], axis=1)
    along = np.einsum("ij,ij->i", axis, rays)[:, None]
    return np.asarray(rays * cos + across * np.sin(angle) + axis * (along * (1.0 - cos)))


def estimate_rotation(events: Events, camera: Camera) -> CameraRotation:
    """Return the camera's angular velocity about the middle of the events' time span.

    The search starts at rest, once for each of :data:`SMOOTHING_PX`: on a coarse image it finds fast rotations, and on
    a fine one it is not drawn away by a moving body. The sharpest result counts. Without events, the rotation is
    zero.
    """
    if not len(events):
        return CameraRotation()
    few = dithered(thinned(events, MOST_EVENTS))
    search = _RotationSearch(few, camera)
    found = []
    for k in range(len(SMOOTHING_PX)):
        rate = np.zeros(3)
        for sigma in SMOOTHING_PX[k:]:
            rate, cost = search.refine(rate, sigma)
        found.append((cost, rate))
    return search.rotation(min(found, key=lambda pair: pair[0])[1])


def dithered(events: Events) -> Events:
    """Return the events at random places in their pixels, if they are at pixel centres, where a grid adds sharpness."""
    if not events.whole_pixels:
        return events
    offset = np.random.default_rng(0).uniform(-0.5, 0.5, (2, len(events))).astype(np.float32)
    return Events(events.x + offset[0], events.y + offset[1], events.t, events.p)


class _RotationSearch:
    """Search for the angular velocity with the sharpest image.

    The cost is the median over the tiles of the change of sharpness from that at rest, so that a fast body with many
    events does not decide.
    """

    def __init__(self, events: Events, camera: Camera) -> None:
        first, last = int(events.t[0]), int(events.t[-1])
        self._events, self._camera, self._middle_us = events, camera, (first + last) // 2
        self._unit = 1.0 / (camera.fx * max(last - first, 1) * 1e-6)  # moves the image by about one pixel [rad/s]
        self._votes = Votes(CanvasShape(camera.width, camera.height), "cpu")
        counts = image_tiles(smooth_image(events, self._votes, 0.0)).sum(axis=1)
        self._busy = counts >= LEAST_SHARE * np.median(counts)
        self._at_rest = {sigma: self._log_variance(events, sigma) for sigma in SMOOTHING_PX}

    def rotation(self, rate: NDArray[np.float64]) -> CameraRotation:
        """Return the rotation with an angular velocity [rad/s]."""
        return CameraRotation((float(rate[0]), float(rate[1]), float(rate[2])), middle_us=self._middle_us)

    def refine(self, rate: NDArray[np.float64], sigma: float) -> tuple[NDArray[np.float64], float]:
        """Return the best angular velocity near ``rate`` and its cost, on an image smoothed by ``sigma`` [px]."""
        from scipy.optimize import minimize

        def cost(v: NDArray[np.float64]) -> float:
            moved = rotated_back(self._events, self._camera, self.rotation(v))
            return -float(np.median(self._log_variance(moved, sigma) - self._at_rest[sigma]))

        roll = 2.0 * self._camera.fx / self._camera.width  # the roll that moves the border by one pixel
        simplex = rate + 1.5 * sigma * self._unit * np.vstack([np.zeros(3), np.diag([1.0, 1.0, roll])])
        options: Any = {"initial_simplex": simplex, "xatol": 0.02 * self._unit * sigma, "fatol": np.inf, "maxiter": 60}
        run = minimize(cost, rate, method="Nelder-Mead", options=options)
        return np.asarray(run.x), float(run.fun)

    def _log_variance(self, events: Events, sigma: float) -> NDArray[np.float32]:
        """Return the logarithm of the image's variance in each tile that has events."""
        variance = image_tiles(smooth_image(events, self._votes, sigma)).var(axis=1)
        return np.asarray(np.log(variance[self._busy] + 1e-9))


def image_tiles(image: NDArray[np.float32], side: int = TILE_PX) -> NDArray[np.float32]:
    """Return the square tiles of an image, shape (n, side * side), without a rest at the right and at the bottom."""
    rows, columns = (n // side for n in image.shape)
    whole = image[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return whole.swapaxes(1, 2).reshape(rows * columns, side * side)


def smooth_image(events: Events, votes: Votes, sigma: float) -> NDArray[np.float32]:
    """Return the image of the events [events per pixel], smoothed; ``votes`` are its buffers."""
    votes.add_unmoved(events)
    return smoothed(votes.take()[0], sigma)


def velocity_grid(reach: float, step: float) -> NDArray[np.float64]:
    """Return velocities from ``-reach`` to ``reach`` along both axes, shape (n, n, 2): (x, y); the middle is 0."""
    half = max(1, round(reach / step))
    line = step * np.arange(-half, half + 1)
    return np.stack(np.meshgrid(line, line), axis=-1)


def local_agreement(
    events: Events, size: tuple[int, int], velocities: NDArray[np.float64], pool: float
) -> Iterator[NDArray[np.floating[Any]]]:
    """Yield how well events agree under each velocity [px/s] of shape (k, 2), as images of shape (height, width).

    It is the mean, over the events of a surrounding, of the density of events of their polarity less that of the other
    polarity, at their places when moved back to the middle of the time span; relative to the density of the
    surrounding. ``size``: width and height [px]. ``pool``: standard deviation of the surrounding's Gaussian [px].
    """
    width, height = size
    votes = Votes(CanvasShape(width, height, per_polarity=True), "cpu")
    place, sign = pixel_index(events, size), 2.0 * events.p - 1.0
    count = np.bincount(place, minlength=width * height).reshape(height, width).astype(np.float64)
    around = np.maximum(smoothed(count, pool), 1e-9)
    for moved in _moved(events, velocities):
        votes.add_unmoved(moved)
        off, on = votes.take()
        density = sign * smoothed(on - off, DENSITY_PX).ravel()[pixel_index(moved, size)]
        total = np.bincount(place, weights=density, minlength=width * height).reshape(height, width)
        yield np.asarray(smoothed(total, pool) / around, np.float32)


def local_contrast(
    events: Events, size: tuple[int, int], velocities: NDArray[np.float64], pool: float
) -> Iterator[NDArray[np.floating[Any]]]:
    """Yield variance over mean of the image of moved events around each pixel, arguments as in :func:`local_agreement`.

    Both polarities count, because an edge behind the prism has both within a turn.
    """
    votes = Votes(CanvasShape(*size), "cpu")
    for moved in _moved(events, velocities):
        image = smooth_image(moved, votes, DENSITY_PX)
        mean, square = (smoothed(values, pool) for values in (image, image * image))
        yield np.asarray((square - mean * mean) / np.maximum(mean, 1e-9), np.float32)


def _moved(events: Events, velocities: NDArray[np.float64]) -> Iterator[Events]:
    """Yield the events moved back to the middle of their time span, for each velocity [px/s]."""
    middle_us = (int(events.t[0]) + int(events.t[-1])) / 2.0
    tau = ((events.t - middle_us) * 1e-6).astype(np.float32)
    x, y = events.x.astype(np.float32), events.y.astype(np.float32)
    for vx, vy in velocities.astype(np.float32):
        yield Events(x - vx * tau, y - vy * tau, events.t, events.p)


def pixel_index(events: Events, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return the index of each event's pixel, row by row; events outside have that of the nearest pixel."""
    width, height = size
    x, y = (np.rint(np.clip(np.nan_to_num(v), 0, n - 1)).astype(np.int64)
            for v, n in ((events.x, width), (events.y, height)))  # fmt: skip
    return np.asarray(y * width + x)
