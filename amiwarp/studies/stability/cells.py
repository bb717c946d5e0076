"""Cells of the stability study: simulated recordings under conditions, and their calibration by each method."""

import contextlib
import enum
import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache, partial
from typing import Annotated, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from amiwarp._version import __version__
from amiwarp.brightness.solver import SensorTiming
from amiwarp.calib.calibration import calibrate
from amiwarp.calib.paper_method import calibrate_as_paper
from amiwarp.calib.presets import settings_to
from amiwarp.calib.result import Calibration
from amiwarp.calib.settings import AUTO, STAGES, Settings
from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TWO_PI, Encoder
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.io.json_files import CellStore, build, fields_of, value_of
from amiwarp.optics.camera import Camera, RadialTangential
from amiwarp.optics.models import ExactModel, build_model, predicted_error
from amiwarp.optics.prism import FlatSide, Prism
from amiwarp.simulation.description import CameraMotion, EncoderModel, PrismMotion, Scene, Still
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.studies.cluster import Workers, failure_of, machine, run_jobs
from amiwarp.studies.failures import failure_text
from amiwarp.tasks import Progress
from amiwarp.validation import instance, real, whole

# Scenes of the stability study, drawn from a seed: from a dense texture to a blank wall.

DARK, BRIGHT = 0.2, 1.0
"""Smallest and largest luminance of the scenes, relative to white."""
LAMP_HZ = 100.0
"""Frequency of the flickering lamp [Hz]."""
FRAME_US = 1000
"""Interval between two pictures of a changing scene [us]."""


class SceneKind(enum.StrEnum):
    """Kind of scene of the stability study."""

    TEXTURE = "dense texture"
    EDGES = "sparse edges"
    ONE_DIRECTION = "one edge direction"
    REPEATING = "repeating texture"
    PRINT = "print"
    LINES = "few thin lines"
    BLANK = "blank wall"


def draw(kind: SceneKind, width: int, height: int, *, period: float, seed: int) -> NDArray[np.float32]:
    """Draw a scene of a kind, and return its linear luminance, shape ``(height, width)``.

    ``period`` is the period of the repeating texture [texels].
    """
    rng = np.random.default_rng([seed, 0x5CE7E])
    if kind is SceneKind.TEXTURE:
        return leaves(rng, width, height)
    if kind is SceneKind.EDGES:
        return polygons(rng, width, height)
    if kind is SceneKind.PRINT:
        return printed(rng, width, height)
    if kind is SceneKind.LINES:
        return thin_lines(rng, width, height)
    if kind is SceneKind.BLANK:
        return np.full((height, width), 0.5, np.float32)
    rows, cols = np.mgrid[:height, :width].astype(np.float64)
    if kind is SceneKind.REPEATING:
        waves = np.cos(2.0 * np.pi * cols / period) + np.cos(2.0 * np.pi * rows / period)
        return _levels(0.5 + 0.25 * waves)
    angle = rng.uniform(0.0, np.pi)
    across = cols * math.cos(angle) + rows * math.sin(angle)
    steps = np.sort(rng.uniform(across.min(), across.max(), max(6, (width + height) // 40)))
    values = rng.uniform(0.0, 1.0, len(steps) + 1)
    return _levels(values[np.searchsorted(steps, across)])


def leaves(rng: np.random.Generator, width: int, height: int, count: int = 4000) -> NDArray[np.float32]:
    """Return discs that occlude each other, with sizes by a power law: the statistics of natural images.

    Lee, Mumford, Huang, "Occlusion models for natural images", IJCV 2001.
    """
    largest, smallest = height / 4.0, 3.0
    out = np.full((height, width), 0.5)
    u = rng.uniform(size=count)
    radii = 1.0 / np.sqrt(u * (smallest**-2 - largest**-2) + largest**-2)  # density proportional to r^-3
    middles = rng.uniform(0.0, 1.0, (count, 2)) * (height, width)
    for radius, (y, x), value in zip(radii, middles, rng.uniform(size=count), strict=True):
        _disc(out, y, x, radius, value)
    return _levels(out)


def _disc(out: NDArray[np.float64], y: float, x: float, radius: float, value: float) -> None:
    """Draw a disc of one luminance into the picture ``out``."""
    top, left = max(0, int(y - radius)), max(0, int(x - radius))
    part = out[top : int(y + radius) + 2, left : int(x + radius) + 2]
    rows, cols = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
    part[(rows - y) ** 2 + (cols - x) ** 2 <= radius**2] = value


def polygons(rng: np.random.Generator, width: int, height: int, count: int = 8) -> NDArray[np.float32]:
    """Return a few triangles on a uniform background."""
    out = np.full((height, width), 0.5)
    rows, cols = np.mgrid[:height, :width]
    for value in rng.choice([0.1, 0.9], count):
        middle = rng.uniform(0.1, 0.9, 2) * (width, height)
        corners = middle + rng.uniform(0.1, 0.25) * height * _triangle(rng.uniform(0.0, 2.0 * np.pi))
        inside = np.ones(out.shape, np.bool_)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            inside &= (b[0] - a[0]) * (rows - a[1]) - (b[1] - a[1]) * (cols - a[0]) >= 0.0
        out[inside] = value
    return _levels(out)


def printed(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float32]:
    """Return a page of print: lines of signs on white, each of two to four straight strokes."""
    out = np.ones((height, width))
    size = max(8, round(height / 30))
    for top in range(size, height - size, 2 * size):
        left = size
        while left < width - 2 * size:
            if rng.uniform() < 0.15:  # space between two words
                left += size
                continue
            for x0, y0, x1, y1 in rng.uniform(0.0, size, (rng.integers(2, 5), 4)):
                _line(out, (left + 0.6 * x0, top + y0), (left + 0.6 * x1, top + y1), 0.1 * size, 0.0)
            left += round(0.8 * size)
    return _levels(out)


def thin_lines(rng: np.random.Generator, width: int, height: int, count: int = 10) -> NDArray[np.float32]:
    """Return short thin lines, brighter or darker than their uniform background."""
    out = np.full((height, width), 0.5)
    for value in rng.choice([0.15, 0.85], count):
        middle, angle = rng.uniform(0.1, 0.9, 2) * (width, height), rng.uniform(0.0, np.pi)
        half = 0.5 * rng.uniform(0.1, 0.3) * height * np.array([math.cos(angle), math.sin(angle)])
        _line(out, middle - half, middle + half, rng.uniform(1.0, 2.5), value)
    return _levels(out)


def _line(out: NDArray[np.float64], start: ArrayLike, end: ArrayLike, half_width: float, value: float) -> None:
    """Draw a straight line of one luminance into the picture ``out``; ends are ``(x, y)`` [texels]."""
    ends = np.array([start, end])
    left, top = np.maximum(np.floor(ends.min(axis=0) - half_width).astype(int), 0)
    right, bottom = np.ceil(ends.max(axis=0) + half_width).astype(int) + 1
    part = out[top:bottom, left:right]
    rows, cols = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
    along = ends[1] - ends[0]
    share = ((cols - ends[0, 0]) * along[0] + (rows - ends[0, 1]) * along[1]) / max(float(along @ along), 1e-9)
    share = np.clip(share, 0.0, 1.0)
    away = np.hypot(cols - ends[0, 0] - share * along[0], rows - ends[0, 1] - share * along[1])
    part[away <= half_width] = value


def _triangle(angle: float) -> NDArray[np.float64]:
    """Return the corners of a unit triangle."""
    at = angle + np.arange(3) * (2.0 * np.pi / 3)
    return np.stack([np.cos(at), np.sin(at)], axis=1)


def _levels(share: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the luminance at shares 0 .. 1 of the scenes' range, on a logarithmic scale."""
    return (DARK * (BRIGHT / DARK) ** np.clip(share, 0.0, 1.0)).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _ChangingStill:
    """Still picture that changes with time (base class)."""

    light: NDArray[np.float32]
    """Linear luminance of the still picture, shape ``(height, width)``."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture [texels]."""
        return self.light.shape[1], self.light.shape[0]

    @property
    def interval_us(self) -> float:
        """Interval between two pictures [us]."""
        return float(FRAME_US)


@dataclass(frozen=True, slots=True, eq=False)
class Lamp(_ChangingStill):
    """Still picture with a flickering square.

    The square's luminance falls by ``depth`` and rises again :data:`LAMP_HZ` times per second. Satisfies
    :class:`amiwarp.Frames`.
    """

    share: float
    """Share of the picture's area that the lamp lights."""
    duration_us: int
    """Duration for which pictures are given [us]."""
    depth: float = 0.7
    """Relative decrease of the square's luminance when the lamp is dark."""

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield the time [us] and the picture with the square."""
        height, width = self.light.shape
        half = 0.5 * math.sqrt(self.share)
        rows = slice(round((0.5 - half) * height), round((0.5 + half) * height))
        cols = slice(round((0.5 - half) * width), round((0.5 + half) * width))
        for t in range(0, self.duration_us + FRAME_US, FRAME_US):
            out = self.light.copy()
            out[rows, cols] *= 1.0 - self.depth * math.sin(math.pi * LAMP_HZ * t * 1e-6) ** 2
            yield t, out


@dataclass(frozen=True, slots=True, eq=False)
class PassingObject(_ChangingStill):
    """Still picture in front of which a textured disc passes."""

    share: float
    """Share of the picture's area that the disc hides."""
    widths_per_s: float
    """Speed of the disc [picture widths/s]."""
    duration_us: int
    """Duration for which pictures are given [us]."""
    seed: int
    """Seed of the disc's texture."""

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield the time [us] and the picture with the disc."""
        height, width = self.light.shape
        radius = math.sqrt(self.share * width * height / math.pi)
        side = 2 * math.ceil(radius) + 1
        leaf = leaves(np.random.default_rng([self.seed, 0x0B1]), side, side, 600)
        rows, cols = np.mgrid[:side, :side]
        round_ = (rows - side // 2) ** 2 + (cols - side // 2) ** 2 <= radius**2
        for t in range(0, self.duration_us + FRAME_US, FRAME_US):
            out = self.light.copy()
            path = self.widths_per_s * width * (t - self.duration_us / 2) * 1e-6
            left, top = round(width / 2 + path) - side // 2, height // 2 - side // 2
            x0, x1, y0, y1 = max(left, 0), min(left + side, width), max(top, 0), min(top + side, height)
            if x0 < x1:
                part = (slice(y0 - top, y1 - top), slice(x0 - left, x1 - left))
                out[y0:y1, x0:x1][round_[part]] = leaf[part][round_[part]]
            yield t, out


TEXELS = 2.0
"""Texels of the scene's picture per camera pixel, in the middle of the image."""
HARDWARE_DEG = 10.0
"""Standard deviation of the phase that the simulated hardware states [deg]."""
HARDWARE_APEX = 0.05
"""Relative standard deviation of the nominal apex angle that the simulated hardware states."""


@dataclass(frozen=True)
class Condition:
    """Condition under which a recording is simulated. The defaults are harmless.

    Equal conditions and equal seeds give equal recordings.
    """

    scene: str = SceneKind.TEXTURE.value
    """Kind of scene: a value of :class:`SceneKind`."""
    width: int = 320
    """Width of the camera's image [px]."""
    height: int = 240
    """Height of the camera's image [px]."""
    fov_deg: float = 60.0
    """Horizontal field of view of the camera [deg]."""
    apex_deg: float = 1.0
    """Apex angle of the prism [deg]."""
    rpm: float = 720.0
    """Speed of the prism [turns/min]."""
    turns: float = 4.0
    """Duration of the recording [turns of the prism]."""
    contrast: float = 0.25
    """Contrast threshold of the sensor [log intensity]."""
    window_events: int = 0
    """Number of events in the sensor's readout window; 0 for the whole sensor.

    The window is a rectangle about the middle, just large enough for that number.
    """
    lost: float = 0.0
    """Share of the events that are lost in the sensor, at random."""
    noise: float = 0.0
    """Share of background noise among all events, 0 to 1."""
    hot: float = 0.0
    """Share of hot pixels, each with 500 events/s."""
    mismatch: float = 0.03
    """Relative standard deviation of the contrast thresholds between pixels."""
    latency_us: float = 100.0
    """Latency of the sensor's pixels [us]."""
    refractory_us: float = 100.0
    """Refractory period of the pixels [us]."""
    readout_us: float = 0.0
    """Interval of readout scans [us]; time stamps are moved to the end of their scan. 0 for none."""
    cutoff_hz: float = 0.0
    """Bandwidth of the photoreceptor at white [Hz]; 0 for unlimited."""
    bus_rate_mev_s: float = 0.0
    """Largest rate of events on the sensor's bus [million events/s]; 0 for unlimited."""
    counts_per_turn: int = 8192
    """Resolution of the encoder [counts/turn]."""
    jitter_deg: float = 0.0
    """Standard deviation of the angle of an encoder sample [deg]."""
    clock_offset_us: float = 0.0
    """Offset between the clocks of encoder and camera [us]."""
    dropouts_hz: float = 0.0
    """Rate of drop-outs, in which encoder samples are lost [1/s]."""
    encoder_scale: float = 0.0
    """Relative error of the scale of the encoder's angles."""
    slip_deg: float = 0.0
    """Angle that the encoder loses per second [deg], in two steps per turn."""
    backwards: bool = False
    """Whether the encoder counts in the wrong direction."""
    ripple: float = 0.0
    """Relative amplitude of the speed ripple, three periods per turn; the encoder measures it."""
    flat_side_wrong: bool = False
    """Whether the recording states the wrong flat side."""
    focal_error: float = 0.0
    """Relative error of the focal length that the recording states."""
    principal_px: float = 0.0
    """Error of the principal point that the recording states, along x [px]."""
    distortion: float = 0.0
    """Distortion coefficient k1 of the true camera, which the recording does not state."""
    start: str = "none"
    """Phase that is given to the calibration: ``none``, ``right``, or ``wrong`` (by 90 degrees)."""
    lamp: float = 0.0
    """Share of the picture that flickers at 100 Hz."""
    passing: float = 0.0
    """Share of the picture that a passing object hides; its speed is half the picture's width per second."""
    camera_deg_s: float = 0.0
    """Speed of the camera's rotation [deg/s], about a tilted axis."""
    cancelled: float = 0.0
    """Share of the prism's motion in the image that a rotation of the camera cancels."""
    eccentric_deg: float = 0.0
    """Amplitude of the encoder's error that repeats once a turn [deg], at a random angle."""
    second_deg: float = 0.0
    """Amplitude of the encoder's error that repeats twice a turn [deg], at a random angle."""
    index_only: bool = False
    """Whether the encoder gives but one index pulse per turn."""
    turn_ripple: float = 0.0
    """Relative amplitude of the speed ripple, one period per turn, at a random angle."""
    no_encoder: bool = False
    """Whether the recording has no encoder."""
    ramp: float = 0.0
    """Share of the speed that is missing at the start of the recording; the speed then rises linearly."""
    cylinder_deg: float = 0.0
    """Change of the apex over the image, by cylinder power at a random azimuth [deg per unit of the ray's tangent]."""
    wobble_deg: float = 0.0
    """Angle between the prism's axis and the axis of rotation, at a random azimuth [deg]."""
    column_us: float = 0.0
    """Delay of the events from each column of pixels to the next [us]."""
    line_us: float = 0.0
    """Delay of the events from each row of pixels to the next [us]."""
    row_us: float = 0.0
    """Time to read out a row of pixels, one row after the other without a pause [us]; 0 for all at once."""
    aspect_error: float = 0.0
    """True fy / fx - 1; the recording states 0."""
    index_error: float = 0.0
    """True refractive index of the prism minus the one that the recording states."""
    lost_part: float = 0.0
    """Share of each turn whose events are lost, always the same part."""
    timing_known: bool = False
    """Whether latency and refractory period are given to the calibration. Else their effect is part of the phase."""

    @property
    def key(self) -> str:
        """Hash of the settings, which identifies the condition.

        Later fields count only if they differ from the default, so that earlier results stay valid.
        """
        settings = {name: value for name, value in asdict(self).items() if value or name not in _LATER_FIELDS}
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def camera(self) -> Camera:
        """Camera with the true intrinsics."""
        camera = Camera.from_fov(self.width, self.height, math.radians(self.fov_deg))
        camera = replace(camera, fy=camera.fy * (1.0 + self.aspect_error))
        return replace(camera, distortion=RadialTangential(k1=self.distortion)) if self.distortion else camera

    @property
    def stated_camera(self) -> Camera:
        """Camera with the intrinsics that the recording states."""
        true, scale = self.camera, 1.0 + self.focal_error
        return replace(true, fx=true.fx * scale, fy=true.fx * scale, cx=true.cx + self.principal_px, distortion=None)

    @property
    def stated_side(self) -> FlatSide:
        """Flat side of the prism that the recording states."""
        return FlatSide.CAMERA if self.flat_side_wrong else FlatSide.SCENE

    @property
    def prism(self) -> Prism:
        """Prism with the true parameters."""
        return Prism(math.radians(self.apex_deg))

    @property
    def duration_s(self) -> float:
        """Duration of the recording [s]."""
        return self.turns * 60.0 / self.rpm


_LATER_FIELDS = (
    "cutoff_hz", "bus_rate_mev_s", "principal_px", "encoder_scale", "eccentric_deg", "second_deg", "index_only",
    "turn_ripple", "no_encoder", "ramp", "cylinder_deg", "wobble_deg", "column_us", "line_us", "row_us", "aspect_error",
    "index_error", "lost_part", "timing_known",
)  # fmt: skip
"""Fields of :class:`Condition` with default 0 that did not exist when the first cells were stored."""


@dataclass(frozen=True)
class SimulatedSample:
    """Simulated recording of the study, and the parameters that its hardware states."""

    recording: Recording
    """Simulated recording with its ground truth."""
    hardware: dict[str, float]
    """Approximate phase that the hardware states [rad]; empty without an encoder."""
    truth: ExactModel
    """Optical model with the true parameters."""
    motion: PrismMotion
    """True motion of the prism."""
    plain: Encoder | None
    """Encoder with none but the errors that repeat every turn, for at least a turn; None if the recording has none."""


def make(condition: Condition, seed: int, device: str = "cpu") -> SimulatedSample:
    """Simulate the recording of a condition."""
    rng = np.random.default_rng([seed, int(condition.key, 16) & 0x7FFFFFFF])
    simulation = _simulation(condition, seed, rng, device)
    recording = simulation.run()
    if condition.noise:
        recording = replace(simulation, sensor=_noisy(condition, simulation, len(recording.events))).run()
    events = recording.events.slice(0, len(recording.events))
    if condition.window_events:
        events = windowed(events, condition.width, condition.height, condition.window_events)
    if condition.lost:
        events = events[rng.uniform(size=len(events)) >= condition.lost]
    if condition.readout_us:
        events = scanned(events, condition.readout_us)
    events = skewed(events, condition)
    motion = simulation.prism_motion
    if condition.lost_part:
        begin = rng.uniform(0.0, TWO_PI)
        events = events[(motion.angle(events.t) - begin) % TWO_PI >= condition.lost_part * TWO_PI]
    apex = condition.prism.apex * (1.0 + HARDWARE_APEX * rng.standard_normal())
    nominal = Prism(apex, condition.prism.index - condition.index_error, condition.stated_side)
    end = max(int(events.t[-1]) if len(events) else 0, math.ceil(1.5 * 60e6 / condition.rpm))
    plain = encoder = None
    if condition.index_only:
        plain = encoder = _index_pulses(motion, end, condition.rpm)
    elif not condition.no_encoder:
        assert recording.encoder is not None
        assert simulation.encoder_model is not None
        ideal = replace(EncoderModel.ideal(), rate_hz=1e4, harmonics=simulation.encoder_model.harmonics)
        plain, encoder = ideal.sample(motion, end, 0), distorted_encoder(recording.encoder, condition, rng)
    stated = replace(
        recording,
        events=MemoryEvents(events, condition.width, condition.height),
        camera=condition.stated_camera,
        encoder=encoder,
        prism=nominal,
    )
    stated_phase = motion.phase + math.radians(HARDWARE_DEG) * rng.standard_normal()
    known = {"phase": stated_phase + (math.pi / 2 if condition.start == "wrong" else 0.0)}
    if condition.no_encoder:
        known = {}  # nothing tells the angle that the mounted phase refers to
    truth = cast("ExactModel", simulation.true_model)
    return SimulatedSample(stated, known, truth, motion, plain)


def skewed(events: Events, c: Condition) -> Events:
    """Return events whose pixels are read out one column, or one row, after the other."""
    if not (c.column_us or c.line_us):
        return events
    t = events.t + np.rint(c.column_us * events.x + c.line_us * events.y).astype(np.int64)
    order = np.argsort(t, kind="stable")
    return Events(events.x[order], events.y[order], t[order], events.p[order])


def _index_pulses(motion: PrismMotion, end: int, rpm: float) -> Encoder:
    """Return the encoder that has but a pulse at each whole turn, from before time 0 to after ``end`` [us]."""
    spare = 2.0 * 60e6 / rpm
    t = np.arange(-spare, end + spare, 100.0)
    angle = motion.angle(t)
    turns = np.arange(math.ceil(angle[0] / TWO_PI), math.floor(angle[-1] / TWO_PI) + 1) * TWO_PI
    return Encoder(np.rint(np.interp(turns, angle, t)).astype(np.int64), turns)


def _simulation(c: Condition, seed: int, rng: np.random.Generator, device: str) -> Simulation:
    """Return the simulation of a condition without background noise."""
    phase = rng.uniform(-math.pi, math.pi)
    sensor = SensorModel(
        contrast_on=c.contrast, contrast_off=c.contrast, mismatch=c.mismatch, latency_us=c.latency_us,
        refractory_us=c.refractory_us, hot_fraction=c.hot, hot_hz=500.0, shot_noise_hz=0.1, leak_hz=0.1,
        cutoff_hz=c.cutoff_hz, bus_rate_mev_s=c.bus_rate_mev_s, row_us=c.row_us,
    )  # fmt: skip
    harmonics = (*_at_random(c.eccentric_deg, rng), *_at_random(c.second_deg, rng))
    encoder = EncoderModel(
        counts_per_turn=c.counts_per_turn, clock_offset_us=c.clock_offset_us, dropouts_hz=c.dropouts_hz, jitter_us=1.0,
        harmonics=harmonics,
    )  # fmt: skip
    motion = _prism_motion(c, phase, rng)
    return Simulation(
        _scene(c, seed), c.camera, c.prism, c.duration_s, motion, _camera_motion(c, motion, rng), sensor, encoder,
        seed=seed, device=device,
    )  # fmt: skip


def _at_random(size_deg: float, rng: np.random.Generator) -> tuple[float, float]:
    """Return the two components of a size [deg] in a random direction [rad]; nothing is drawn for a size of 0."""
    direction = rng.uniform(0.0, TWO_PI) if size_deg else 0.0
    return math.radians(size_deg) * math.cos(direction), math.radians(size_deg) * math.sin(direction)


def _scene(c: Condition, seed: int) -> Scene:
    """Return the scene of a condition."""
    wedge = 2.2 * c.prism.deflection
    half = min(math.radians(c.fov_deg) / 2.0 + wedge, 1.35)
    focal = TEXELS * c.camera.fx
    width = 2 * math.ceil(focal * math.tan(half)) + 2
    height = math.ceil(width * c.height / c.width / min(1.0, 1.0 + c.aspect_error)) + 2 * math.ceil(focal * wedge)
    diameter = 2.0 * c.prism.deflection * focal
    light = draw(SceneKind(c.scene), width, height, period=diameter, seed=seed)
    fov = 2.0 * math.atan(width / 2.0 / focal)
    duration = math.ceil(c.duration_s * 1e6)
    if c.lamp:
        return Scene(Lamp(light, c.lamp, duration), fov)
    if c.passing:
        return Scene(PassingObject(light, c.passing, 0.5, duration, seed), fov)
    return Scene(Still(light), fov)


def _prism_motion(c: Condition, phase: float, rng: np.random.Generator) -> PrismMotion:
    """Return the prism's motion under a condition."""
    # the apex varies over the image by twice the cylinder power: along the wedge and across it, with opposite signs
    shape: dict[str, Any] = {"cylinder": _at_random(c.cylinder_deg / 2.0, rng), "wobble": _at_random(c.wobble_deg, rng)}
    if not (c.ripple or c.turn_ripple or c.ramp):
        return PrismMotion(c.rpm, phase, **shape)
    begin = rng.uniform(0.0, TWO_PI) if c.turn_ripple else 0.0
    hz = c.rpm / 60.0
    t = np.arange(-3.0 / hz, max(c.duration_s, 1.5 / hz) + 3.0 / hz, 1e-3)
    speed = c.rpm * (1.0 + c.ripple * np.sin(TWO_PI * 3.0 * hz * t))
    speed *= 1.0 + c.turn_ripple * np.sin(TWO_PI * hz * t + begin)
    speed *= np.interp(t, [0.0, c.duration_s], [1.0 - c.ramp, 1.0])
    return PrismMotion(np.column_stack([t, speed]), phase, **shape)


def _camera_motion(c: Condition, motion: PrismMotion, rng: np.random.Generator) -> CameraMotion:
    """Return the camera's motion under a condition."""
    if c.cancelled:
        return _cancelling(c, motion)
    axis = rng.standard_normal(3)
    return CameraMotion(np.radians(c.camera_deg_s) * axis / np.linalg.norm(axis))


def _cancelling(c: Condition, motion: PrismMotion) -> CameraMotion:
    """Return the rotation of the camera that moves the image against the prism's motion.

    The prism displaces the view of a pixel by δ (cos φ, sin φ) on the image plane. A rotation about y by a displaces it
    by +a along x, and a rotation about x by -a along y.
    """
    t = np.arange(0.0, c.duration_s + 2e-3, 1e-3)
    angle = motion.phase + motion.angle(t * 1e6)
    size = -c.cancelled * c.prism.deflection
    along = size * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rates = np.gradient(along, t, axis=0)
    return CameraMotion(np.column_stack([t, -rates[:, 1], rates[:, 0], np.zeros(len(t))]))


def _noisy(c: Condition, simulation: Simulation, clean: int) -> SensorModel:
    """Return the sensor with the noise rate that gives the condition's share of noise.

    ``clean`` is the number of events without noise.
    """
    hz = clean * c.noise / (1.0 - c.noise) / (c.width * c.height * c.duration_s)
    return replace(simulation.sensor, shot_noise_hz=hz)


def windowed(events: Events, width: int, height: int, count: int) -> Events:
    """Return about ``count`` events in a readout window.

    It is the smallest rectangle about the middle that holds them, with the aspect ratio of the image.
    """
    away = np.maximum(np.abs(events.x / (width - 1.0) - 0.5), np.abs(events.y / (height - 1.0) - 0.5))
    if len(away) <= count:
        return events
    return events[away <= np.partition(away, count)[count]]


def scanned(events: Events, interval_us: float) -> Events:
    """Return events as read out in scans: each gets the time stamp of the end of its scan; rows are in order."""
    t = (np.ceil(events.t / interval_us) * interval_us).astype(np.int64)
    order = np.lexsort((events.x, events.y, t))
    return Events(events.x[order], events.y[order], t[order], events.p[order])


def distorted_encoder(encoder: Encoder, c: Condition, rng: np.random.Generator) -> Encoder:
    """Return the encoder with the errors that the condition demands."""
    angle = encoder.angle + math.radians(c.jitter_deg) * rng.standard_normal(len(encoder.angle))
    if c.slip_deg:
        half_turns = np.floor(angle / math.pi)
        angle = angle - math.radians(c.slip_deg) * (half_turns - half_turns[0]) * 30.0 / c.rpm
    angle = angle * (1.0 + c.encoder_scale)
    if c.backwards:
        angle = -angle
    return Encoder(encoder.t, angle)


_LARGEST: dict[str, float] = {
    "noise": 0.5, "camera_deg_s": 30.0, "jitter_deg": 0.5,
    "contrast": 0.6, "lost": 0.1, "hot": 0.001, "mismatch": 0.1, "latency_us": 1000.0, "refractory_us": 1000.0,
    "readout_us": 500.0, "clock_offset_us": 1000.0, "dropouts_hz": 10.0, "slip_deg": 0.0, "backwards": 0.0,
    "encoder_scale": 1e-4, "ripple": 0.2, "focal_error": 0.03, "principal_px": 10.0, "lamp": 0.05,
    "passing": 0.02, "cancelled": 0.0,
    "eccentric_deg": 3.0,  # a disc of 10 mm radius, half a millimetre off centre
    "second_deg": 1.0,  # sine and cosine signals of an encoder whose amplitudes differ by 3.5 %
    "turn_ripple": 0.1,  # a small motor that turns an unbalanced prism
    "ramp": 1.0,  # the recording begins when the motor is switched on
    "cylinder_deg": 0.1,  # a cast wedge, bent by 7 um over 25 mm, 20 mm in front of the pupil
    "wobble_deg": 0.5,  # 0.2 mm of play in a mount 20 mm wide
    "column_us": 1.0, "line_us": 1.0,  # the whole sensor within 0.3 ms, as at 3,000 scans per second
    "row_us": 4.0,  # 240 rows within 1 ms
    "aspect_error": 0.03,  # pictures of the lens calibration that were resized, 640x480 to 640x466
    "index_error": 0.06,  # fused silica taken for N-BK7
    "lost_part": 0.4,  # a guard, or a bus that is full whenever the longest edges move
}  # fmt: skip
"""Largest values of the condition fields for which a calibration is expected to work."""
_SMALLEST: dict[str, float] = {"turns": 0.5, "counts_per_turn": 64, "distortion": -0.08, "apex_deg": 0.5}
"""Smallest values of the condition fields for which a calibration is expected to work.

An apex of 0.5 degrees gives an orbit of 1.2 px; at 0.25 degrees the orbit lies within a pixel.
"""
_SMALLEST_OR_NONE: dict[str, float] = {"cutoff_hz": 300.0, "bus_rate_mev_s": 3.0}
"""Smallest values of condition fields for which a calibration is expected to work, where 0 also does, because it means
no limit."""
FEWEST_EVENTS = 20_000
"""Smallest number of events for which a calibration is expected to work."""


def sensible(c: Condition, events: int) -> bool:
    """Return whether a calibration is expected to work under a condition (the sensible region).

    That is a working rig, and a scene that the aims cover.
    """
    return (
        events >= FEWEST_EVENTS
        and c.scene in (SceneKind.TEXTURE, SceneKind.EDGES, SceneKind.PRINT)
        and all(getattr(c, name) <= most for name, most in _LARGEST.items())
        and all(getattr(c, name) >= least for name, least in _SMALLEST.items())
        and all(not getattr(c, name) or getattr(c, name) >= least for name, least in _SMALLEST_OR_NONE.items())
    )


# Axes of the stability study: each varies one field of a condition, from harmless to hopeless.


@dataclass(frozen=True)
class Axis:
    """Axis of the study: values of one condition field, from harmless to hopeless."""

    name: str
    """Name of the axis in reports."""
    field: str
    """Name of the field of :class:`Condition` that the axis varies."""
    values: tuple[Any, ...]
    """Values of the field along the axis."""
    unit: str = ""
    """Unit of the values, as shown in reports."""
    also: tuple[tuple[str, Any], ...] = ()
    """Other fields of the condition, with values that differ from their defaults along the whole axis."""

    def conditions(self) -> list[Condition]:
        """Return the condition at each value of the axis."""
        return [replace(Condition(), **dict(self.also), **{self.field: value}) for value in self.values]


SCENES = tuple(kind.value for kind in SceneKind)
"""Names of all kinds of scenes."""
WIDE = (("fov_deg", 90.0), ("apex_deg", 2.0))
"""Condition in which a wrong camera shows: a wide view and a large orbit."""

AXES = (
    Axis("events", "window_events", (0, 300_000, 100_000, 50_000, 20_000, 10_000, 5_000, 1_000)),
    Axis("events lost", "lost", (0.0, 0.1, 0.3, 0.5, 0.7, 0.9), "of all events"),
    Axis("many events", "contrast", (0.25, 0.12, 0.06, 0.03), "log intensity, 24 turns", (("turns", 24.0),)),
    Axis("time window", "turns", (24.0, 8.0, 2.0, 1.0, 0.75, 0.5, 0.25, 0.125), "turns"),
    Axis("background noise", "noise", (0.0, 0.1, 0.25, 0.5, 0.65, 0.8), "of all events"),
    Axis("hot pixels", "hot", (0.0, 0.0002, 0.001, 0.005, 0.02, 0.05), "of all pixels"),
    Axis("threshold", "contrast", (0.1, 0.15, 0.25, 0.4, 0.6, 1.0), "log intensity"),
    Axis("threshold mismatch", "mismatch", (0.0, 0.03, 0.1, 0.2, 0.3), "relative"),
    Axis("latency", "latency_us", (0.0, 100.0, 300.0, 1000.0, 3000.0), "µs"),
    Axis("refractory time", "refractory_us", (0.0, 100.0, 1000.0, 3000.0, 10_000.0), "µs"),
    Axis("readout in scans", "readout_us", (0.0, 200.0, 500.0, 1000.0, 2000.0), "µs"),
    Axis("bandwidth", "cutoff_hz", (3000.0, 1000.0, 300.0, 100.0, 30.0), "Hz at white"),
    Axis("bus rate", "bus_rate_mev_s", (10.0, 3.0, 1.0, 0.3, 0.1), "million events/s"),
    Axis("encoder resolution", "counts_per_turn", (8192, 1024, 256, 64, 16, 4), "counts a turn"),
    Axis("encoder jitter", "jitter_deg", (0.0, 0.1, 0.5, 2.0, 5.0, 20.0), "°"),
    Axis("clock offset", "clock_offset_us", (0.0, 100.0, 1000.0, 5000.0, 20_000.0), "µs", (("ripple", 0.05),)),
    Axis("encoder drop-outs", "dropouts_hz", (0.0, 3.0, 10.0, 30.0, 100.0), "of 5 ms, a second"),
    Axis("slipping index", "slip_deg", (0.0, 1.0, 5.0, 20.0, 90.0), "° a second"),
    Axis("direction", "backwards", (False, True)),
    Axis("speed", "rpm", (60.0, 180.0, 720.0, 1800.0, 3600.0, 6000.0), "rpm"),
    Axis("speed ripple", "ripple", (0.0, 0.01, 0.05, 0.2, 0.5), "relative"),
    Axis("apex", "apex_deg", (4.0, 2.0, 1.0, 0.5, 0.25), "°"),
    Axis("field of view", "fov_deg", (30.0, 45.0, 60.0, 80.0, 100.0), "°"),
    Axis("flat side", "flat_side_wrong", (False, True)),
    Axis("focal length", "focal_error", (0.0, 0.01, 0.03, 0.1, 0.3), "relative error"),
    Axis("distortion ignored", "distortion", (0.0, -0.03, -0.1, -0.2), "k1"),
    Axis("start", "start", ("none", "right", "wrong")),
    Axis("scene", "scene", SCENES),
    Axis("flickering lamp", "lamp", (0.0, 0.01, 0.05, 0.2, 0.6), "of the picture"),
    Axis("camera turning", "camera_deg_s", (0.0, 1.0, 3.0, 10.0, 30.0, 60.0), "°/s"),
    Axis("passing object", "passing", (0.0, 0.02, 0.1, 0.3, 0.6), "of the picture"),
    Axis("motion cancelled", "cancelled", (0.0, 0.3, 0.6, 0.9, 1.0), "of the prism's"),
    Axis("encoder scale", "encoder_scale", (0.0, 1e-4, 1e-3, 0.01, 0.1), "relative error"),
    Axis("principal point", "principal_px", (0.0, 2.0, 5.0, 10.0, 20.0), "px"),
    Axis("small orbit", "scene", SCENES, "apex 0.5°", (("apex_deg", 0.5),)),
    Axis("events, sparse edges", "window_events", (0, 50_000, 20_000, 10_000), "", (("scene", SceneKind.EDGES.value),)),
    Axis("thin lines and noise", "noise", (0.0, 0.1, 0.2, 0.35), "of all events",
         (("scene", SceneKind.LINES.value),)),
    Axis("focal length, wide", "focal_error", (0.0, 0.01, 0.03, 0.1, 0.3, 0.73), "relative error, 90°, apex 2°", WIDE),
    Axis("principal point, wide", "principal_px", (0.0, 2.0, 5.0, 10.0, 20.0), "px, 90°, apex 2°", WIDE),
    Axis("distortion ignored, wide", "distortion", (0.0, -0.03, -0.08, -0.15), "k1, 90°, apex 2°", WIDE),
    Axis("flat side, wide", "flat_side_wrong", (False, True), "90°, apex 2°", WIDE),
    Axis("encoder off centre", "eccentric_deg", (0.0, 0.3, 1.0, 3.0, 10.0), "°, once a turn"),
    Axis("encoder, second harmonic", "second_deg", (0.0, 0.1, 0.3, 1.0, 3.0), "°, twice a turn"),
    Axis("speed ripple, index pulse only", "turn_ripple", (0.0, 0.01, 0.03, 0.1, 0.3), "relative, once a turn",
         (("index_only", True),)),
    Axis("ramp without encoder", "ramp", (0.0, 0.1, 0.3, 0.6, 1.0), "of the speed, up to 8 turns",
         (("no_encoder", True), ("turns", 8.0))),
    Axis("cylinder power", "cylinder_deg", (0.0, 0.01, 0.03, 0.1, 0.3), "° of apex over the image"),
    Axis("wobble", "wobble_deg", (0.0, 0.1, 0.5, 2.0, 5.0), "°"),
    Axis("column skew", "column_us", (0.0, 0.3, 1.0, 5.0, 20.0), "µs from column to column"),
    Axis("row skew", "line_us", (0.0, 0.3, 1.0, 5.0, 20.0), "µs from row to row"),
    Axis("readout of row after row", "row_us", (0.0, 1.0, 4.0, 20.0), "µs a row"),
    Axis("fy / fx", "aspect_error", (0.0, 0.003, 0.01, 0.03, 0.1), "relative error"),
    Axis("refractive index, wide", "index_error", (0.0, 0.01, 0.03, 0.06, 0.2), "error, 90°, apex 2°", WIDE),
    Axis("events lost in a part of the turn", "lost_part", (0.0, 0.1, 0.2, 0.4, 0.6, 0.8), "of the turn"),
    Axis("focal length and distortion", "focal_error", (0.01, 0.03, 0.1), "relative error, k1 −0.05",
         (("distortion", -0.05),)),
    Axis("principal point and distortion", "principal_px", (2.0, 5.0, 10.0), "px, k1 −0.05", (("distortion", -0.05),)),
    Axis("focal length and flat side", "focal_error", (0.01, 0.03, 0.1), "relative error, wrong side",
         (("flat_side_wrong", True),)),
    Axis("focal length, camera turning", "camera_deg_s", (1.0, 10.0, 30.0), "°/s, focal length 3 % off",
         (("focal_error", 0.03),)),
    Axis("bandwidth and noise", "cutoff_hz", (1000.0, 300.0, 100.0), "Hz at white, 25 % noise", (("noise", 0.25),)),
    Axis("bandwidth and refractory time", "cutoff_hz", (1000.0, 300.0, 100.0), "Hz at white, 1 ms",
         (("refractory_us", 1000.0),)),
    Axis("events lost and noise", "lost", (0.1, 0.3, 0.5), "of all events, 25 % noise", (("noise", 0.25),)),
    Axis("small orbit, few events", "window_events", (100_000, 50_000, 20_000), "apex 0.5°", (("apex_deg", 0.5),)),
)  # fmt: skip
"""All axes of the stability study. The last :data:`COMBINED` combine two troubles that are likely to occur together."""
COMBINED = 8
"""Number of axes that combine two troubles."""


# Random combinations of mild troubles: no constant of the calibration was chosen with them.

ALWAYS: dict[str, tuple[float, float]] = {
    "apex_deg": (0.5, 2.0), "rpm": (400.0, 1200.0), "turns": (3.0, 6.0), "fov_deg": (45.0, 75.0),
    "contrast": (0.15, 0.35), "mismatch": (0.0, 0.08), "noise": (0.0, 0.3), "latency_us": (50.0, 300.0),
}  # fmt: skip
"""Ranges of the condition fields that every combination draws."""
TROUBLES: dict[str, tuple[float, float]] = {
    "eccentric_deg": (0.0, 2.0), "second_deg": (0.0, 0.5), "turn_ripple": (0.0, 0.05), "cylinder_deg": (0.0, 0.1),
    "wobble_deg": (0.0, 0.5), "focal_error": (-0.02, 0.02), "principal_px": (-5.0, 5.0), "distortion": (-0.05, 0.0),
    "aspect_error": (-0.02, 0.02), "index_error": (-0.03, 0.03), "lost": (0.0, 0.1), "lost_part": (0.0, 0.3),
}  # fmt: skip
"""Troubles, and their ranges. Each combination has a quarter of them; ripple only shows with an index pulse alone."""
DRAWS = 300
"""Number of random combinations of the whole study."""


def mild(seed: int) -> Condition:
    """Return a random combination of mild troubles. All values are drawn uniformly."""
    rng = np.random.default_rng([seed, 0x41D])
    scene = (SceneKind.TEXTURE, SceneKind.EDGES, SceneKind.PRINT)[rng.integers(3)]
    values = {name: round(float(rng.uniform(*span)), 5) for name, span in ALWAYS.items()}
    for name, span in TROUBLES.items():
        size, there = round(float(rng.uniform(*span)), 5), rng.uniform() < 0.25
        values |= {name: size} if there else {}
    condition = Condition(scene=scene.value, timing_known=True, **values)  # type: ignore[arg-type]
    return (
        replace(condition, index_only=True, eccentric_deg=0.0, second_deg=0.0) if condition.turn_ripple else condition
    )


# Methods, and cells: a condition, a seed, and the result of each calibration method on that recording.

LIMIT_PX = 0.1
"""Largest model error of a successful calibration [px rms], unless the model's best fit to the truth has a large error
itself."""
BEST_FIT = 1.5
"""Multiple of the error of the model's best fit to the truth that a successful calibration may have."""
LAG_STEPS = 4
"""Number of Gauss-Newton steps that find the lag of a calibration."""
STATED = ("apex", "phase", "size")
"""Quantities whose distance from the truth is measured in standard deviations that the calibration states.

The size is that of the displacements in the image, which is proportional to the apex."""
JUDGED = 5_000
"""Number of events at which the error of a smaller model is measured: enough for an rms error accurate to 1 %."""
LARGEST_PX = 1e3
"""Largest model error that is stored [px rms]; that of a model without a valid position anywhere is this too."""
MOST_DEVIATION = 1e9
"""Largest stored distance of a parameter from the truth [standard deviations]."""
FORMAT = 4
"""Version of the file format of a stored cell, which is part of the cell's identity."""


class Outcome(enum.StrEnum):
    """Outcome of one calibration."""

    SUCCESS = "success"
    REFUSAL = "refusal"
    """Refusal: the method raised an error that names the cause."""
    SILENT = "silent failure"
    """Silent failure: the result is wrong and there was no error. A crash counts as a silent failure too."""
    FAILED = "failed"
    """The study failed: recording or comparison could not be made, or a worker died. It says nothing of the method."""


@dataclass(frozen=True)
class Method:
    """Calibration method. Without settings it is the paper's method."""

    name: str
    """Name of the method in reports."""
    settings: Settings | None
    """Settings of the calibration; None for the paper's method."""

    @property
    def model(self) -> str:
        """Name of the largest refraction model that the result can have."""
        if self.settings is None:
            return "circle"
        return "exact" if self.settings.model == AUTO else self.settings.model

    @property
    def identity(self) -> dict[str, Any]:
        """Settings that identify the method, as JSON data."""
        return (
            {"method": "paper"}
            if self.settings is None
            else settings_to(self.settings) | {"sharpness": self.settings.sharpness.value}
        )

    def run(self, sample: SimulatedSample, condition: Condition, seed: int, device: str) -> Calibration:
        """Calibrate a sample. Raises :class:`AmiwarpError` if the method refuses it."""
        if self.settings is None:
            return calibrate_as_paper(sample.recording, start=sample.hardware, device=device)
        settings = replace(self.settings, seed=seed, start=sample.hardware if condition.start != "none" else {})
        if condition.timing_known:
            sensor = SensorTiming(condition.latency_us, condition.refractory_us)
            settings = replace(settings, photometric=replace(settings.photometric, sensor=sensor))
        return calibrate(sample.recording, settings, device=device)


_SHARP = Settings(model="exact", stages=STAGES[:1])
METHODS = (
    Method("default", Settings()),
    Method("paper", None),
    Method("sharpness", _SHARP),
    Method("circle", Settings(model="circle")),
    Method("gradient", replace(_SHARP, sharpness=Sharpness.GRADIENT)),
    Method("entropy", replace(_SHARP, sharpness=Sharpness.ENTROPY)),
    Method("J by DIRECT", replace(_SHARP, sharpness=Sharpness.PAPER_J)),
    Method("CRS + Sbplx", replace(_SHARP, global_algorithm="GN_CRS2_LM", local_algorithm="LN_SBPLX")),
)
"""All methods of the study: sharpness measures, models and algorithms, with and without the photometric stage.

The paper's method and the default are always run.
"""


@dataclass(frozen=True)
class Result:
    """Result of one calibration method on one recording."""

    outcome: Outcome
    """Outcome: success, refusal or silent failure."""
    error_px: Annotated[float, partial(real, low=0.0, high=LARGEST_PX)] | None
    """Model error relative to the ground truth [px rms]; None if the method refused the recording, or the study failed.
    """
    limit_px: Annotated[float, partial(real, low=0.0, high=LARGEST_PX)]
    """Largest model error with which this calibration counts as a success [px rms]."""
    seconds: Annotated[float, partial(real, low=0.0, high=1e9)]
    """Run time of the calibration [s]."""
    message: str = ""
    """Error message of a refusal or of what failed, or warnings of the calibration."""
    machine: str = ""
    """Description of the machine that ran the calibration."""
    deviations: dict[str, Annotated[float, partial(real, low=0.0, high=MOST_DEVIATION)]] = field(default_factory=dict)
    """Distances of the quantities :data:`STATED` from the truth, in standard deviations that the calibration states;
    empty for a circle and for a refused recording."""

    def __post_init__(self) -> None:
        """Raise :class:`AmiwarpError` for an outcome that does not follow from the error."""
        within = self.error_px is not None and self.error_px <= self.limit_px
        without_error = self.outcome in (Outcome.REFUSAL, Outcome.FAILED)
        if within != (self.outcome is Outcome.SUCCESS) or (without_error and self.error_px is not None):
            raise AmiwarpError(f"outcome {self.outcome} does not fit error_px = {self.error_px} and {self.limit_px}")


@dataclass(frozen=True)
class Cell:
    """Condition and seed of one recording of the study."""

    condition: Condition
    """Condition under which the recording is simulated."""
    seed: int
    """Seed of the simulated recording and of the search."""

    @property
    def name(self) -> str:
        """Name of the file of the cell, without its ending."""
        return f"{self.condition.key}_{self.seed}"


@dataclass
class Stored:
    """Known results of the calibration methods for one cell."""

    cell: Cell
    """Cell (condition and seed) to which the results belong."""
    events: int = 0
    """Number of events of the cell's recording."""
    results: dict[str, Result] = field(default_factory=dict)
    """Results by :func:`identity` of the method."""

    def lacks(self, method: Method) -> bool:
        """Return whether a method is still to be run: it has no result, or failed in an earlier run."""
        result = self.results.get(identity(method))
        return result is None or result.outcome is Outcome.FAILED


def identity(method: Method) -> str:
    """Return a text that identifies a method's results by its settings and the package version."""
    text = json.dumps([FORMAT, __version__, method.identity], sort_keys=True, default=str)
    return f"{method.name} {hashlib.sha256(text.encode()).hexdigest()[:8]}"


def run_cell(cell: Cell, methods: tuple[Method, ...], device: str) -> Stored:
    """Simulate the recording of a cell, run the methods on it, and return their results.

    What raises an error outside of a method has the outcome ``failed``.
    """
    began = time.perf_counter()
    try:
        where = machine(device)
        sample = make(cell.condition, cell.seed, device)
    except Exception as error:
        return failed(cell, methods, failure_text(error), time.perf_counter() - began)
    done = Stored(cell, len(sample.recording.events))
    for method in methods:
        began = time.perf_counter()
        try:
            result = _judge(cell, method, sample, device)
        except Exception as error:
            result = _failed_result(failure_text(error), time.perf_counter() - began)
        done.results[identity(method)] = replace(result, machine=where)
    return done


def failed(cell: Cell, methods: Sequence[Method], message: str, seconds: float = 0.0) -> Stored:
    """Return the cell of which no result is known because it failed with a message, after some time [s]."""
    return Stored(cell, results={identity(method): _failed_result(message, seconds) for method in methods})


def _failed_result(message: str, seconds: float) -> Result:
    return Result(Outcome.FAILED, None, LIMIT_PX, seconds, message)


def _judge(cell: Cell, method: Method, sample: SimulatedSample, device: str) -> Result:
    """Run one method on a recording, and compare its result with the ground truth."""
    limit = max(LIMIT_PX, BEST_FIT * best_fit(cell.condition, method.model))
    began = time.perf_counter()
    try:
        found = method.run(sample, cell.condition, cell.seed, device)
    except AmiwarpError as error:
        return Result(Outcome.REFUSAL, None, limit, time.perf_counter() - began, str(error))
    except MemoryError:  # says something of the machine, not of the method
        raise
    except Exception as error:  # a crash is no clear error, so it is no refusal
        return Result(Outcome.SILENT, None, limit, time.perf_counter() - began, f"crashed: {error!r}")
    took = time.perf_counter() - began
    error_px = compare(found, sample).rms
    outcome = Outcome.SUCCESS if error_px <= limit else Outcome.SILENT
    return Result(
        outcome, min(error_px, LARGEST_PX), limit, took, "; ".join(found.warnings),
        deviations=deviations(found, cell.condition, sample) if method.model == "exact" else {},
    )  # fmt: skip


def deviations(found: Calibration, condition: Condition, sample: SimulatedSample) -> dict[str, float]:
    """Return the distance of each parameter of :data:`STATED` from the truth [stated standard deviations].

    Quantities without a stated standard deviation are left out; so is the phase if the sensor's timing is part of it.
    """
    exact = found.exact
    at = compare(exact, sample)
    apex, std = exact.parameters["apex"], exact.uncertainty.get("apex", 0.0)
    away = {
        "apex": (apex - sample.truth.prism.apex, std),
        "phase": (at.lag, exact.uncertainty.get("phase", 0.0) if condition.timing_known else 0.0),
        "size": (at.gain, std / apex if apex else 0.0),
    }
    return {name: min(abs(value) / std, MOST_DEVIATION) for name, (value, std) in away.items() if std > 0.0}


@dataclass(frozen=True)
class Difference:
    """Difference of a calibration from the truth, over the image and a turn."""

    rms: float
    """Difference of the compensated positions without the lag [px rms]; infinite if none is valid."""
    lag: float
    """Constant angle by which the calibration is behind the truth [rad]."""
    gain: float
    """Relative error of the size of the displacements."""


def compare(found: Calibration, sample: SimulatedSample) -> Difference:
    """Compare a calibration, the path that it gives the prism included, with the truth."""
    events = sample.recording.events
    xy, t = _places(found, sample)
    target = sample.truth.compensate_points(xy, sample.motion.angle(t))
    encoder = found.encoder_for(sample.plain, events.t_first, events.t_last).with_clock_offset(0.0)
    theta, model = encoder.angle_at(np.clip(t, *encoder.coverage)), found.model

    def away(lag: float) -> NDArray[np.float64]:
        return model.compensate_points(xy, theta + lag) - target

    def rms(lag: float) -> float:
        return float(np.sqrt(np.nanmean((away(lag) ** 2).sum(axis=1))))

    if not np.isfinite(away(0.0)).all(axis=1).any():
        return Difference(math.inf, 0.0, 0.0)
    lags = [0.0]
    for _ in range(LAG_STEPS):
        slope = (away(lags[-1] + 0.01) - away(lags[-1] - 0.01)) / 0.02
        square = float(np.nansum(slope**2))
        lags.append(lags[-1] - (float(np.nansum(away(lags[-1]) * slope)) / square if square else 0.0))
    lag = min(lags, key=rms)
    moved = target - xy
    return Difference(rms(lag), lag, float(np.nansum(away(lag) * moved) / np.nansum(moved**2)))


def _places(found: Calibration, sample: SimulatedSample) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return pixels [px] and times [us] at which a calibration is compared: over the image, and over a turn.

    They are those of events if a smaller model was selected because it suffices there. Without an encoder, the times
    are those of the whole recording.
    """
    events = sample.recording.events
    if found.ladder is not None and found.model_name != "exact":
        some = events.slice(0, len(events))[:: max(1, len(events) // JUDGED)]
        return np.stack([some.x, some.y], axis=1).astype(np.float64), some.t
    if sample.plain is None:
        times = np.linspace(events.t_first, events.t_last, 20_000)
    else:
        times = np.linspace(0.0, sample.plain.t[-1] - 1000.0, 20_000)
    angle = sample.motion.angle(times)
    wanted = np.linspace(angle[0], angle[-1], 97) if sample.plain is None else np.arange(36) * (TWO_PI / 36)
    t = np.rint(np.interp(wanted, angle, times))
    camera = sample.truth.camera
    x, y = np.linspace(0.0, camera.width - 1.0, 32), np.linspace(0.0, camera.height - 1.0, 24)
    every = np.stack([m.ravel() for m in np.meshgrid(x, y, t, indexing="ij")], axis=1)
    return every[:, :2], every[:, 2].astype(np.int64)


@cache
def best_fit(condition: Condition, model: str) -> float:
    """Return the error of the best fit of ``model`` to the true model [px rms].

    It is 0 for the exact model: a wrong camera or prism that the recording states is no excuse.
    """
    if model != "circle":
        return 0.0
    truth = ExactModel(condition.camera, condition.prism)

    def error(v: np.ndarray[Any, np.dtype[np.float64]]) -> float:
        values = {"deflection": condition.prism.deflection * abs(float(v[0])), "phase": float(v[1])}
        fitted = build_model(model, condition.camera, condition.prism, values)
        return predicted_error(fitted, truth, grid=8).rms

    return float(minimize(error, [1.0, 0.0], method="Nelder-Mead", options={"maxfev": 80}).fun)


class Store(CellStore):
    """Folder of stored cells. A cell is written when it finishes, and is not run again."""

    def load(self, cell: Cell) -> Stored:
        """Return the known results of ``cell``; none if its file is missing or damaged."""
        known = self._load(f"{cell.name}.json")
        return Stored(cell) if known is None or known.cell != cell else known

    def load_all(self) -> list[Stored]:
        """Return all cells of the folder; damaged ones and those of other versions are left out."""
        found = (self._load(path.name) for path in sorted(self.folder.glob("*.json")))
        return [known for known in found if known is not None]

    def _load(self, name: str) -> Stored | None:
        """Return the cell of a file; None if it is missing, damaged, of another version or renamed."""

        def make(data: dict[str, Any]) -> Stored | None:
            fields_of(data, "", "format", "condition", "seed", "events", "results")
            if data["format"] != FORMAT:
                return None
            condition = instance(data["condition"], dict, "field condition")
            if not condition.keys() <= {f.name for f in fields(Condition)}:
                return None  # a version with other fields wrote it
            cell = Cell(build(Condition, condition, "condition"), whole(data["seed"], "field seed", 0, 2**31))
            events = whole(data["events"], "field events", 0, 10**12)
            results = value_of(dict[str, Result], data["results"], "results")
            return Stored(cell, events, results) if f"{cell.name}.json" == name else None

        return self.read(name, make)

    def save(self, known: Stored) -> None:
        """Write all known results of a cell."""
        self.write(f"{known.cell.name}.json", {
            "format": FORMAT, "condition": asdict(known.cell.condition), "seed": known.cell.seed,
            "events": known.events, "results": {name: asdict(r) for name, r in sorted(known.results.items())},
        })  # fmt: skip


QUICK_METHODS = ("default", "paper", "sharpness")
"""Names of the methods of a quick run."""


def quick_axes() -> tuple[Axis, ...]:
    """Return axes of one trouble with at most three values, both ends and the middle: what runs within ten minutes."""
    return tuple(
        replace(a, values=tuple(dict.fromkeys(a.values[i] for i in (0, len(a.values) // 2, -1))))
        for a in AXES[:-COMBINED]
        if a.name not in ("many events", "encoder, second harmonic", "row skew", "readout of row after row")
    )


def conditions(axes: Sequence[Axis]) -> list[Condition]:
    """Return every condition of the axes once; all axes share the condition with default values."""
    return list(dict.fromkeys(c for axis in axes for c in axis.conditions()))


def cells_of(axes: Sequence[Axis], seeds: int, *, first: int = 0, draws: int = 0) -> list[Cell]:
    """Return the cells of axes with ``seeds`` seeds from ``first`` on, and of random combinations of mild troubles.

    The seed is the outer loop: an interrupted run covers every condition, with fewer seeds.
    """
    of_axes = [Cell(c, seed) for seed in range(first, first + seeds) for c in conditions(axes)]
    return [*(Cell(mild(seed), seed) for seed in range(draws)), *of_axes]


def run(
    cells: Sequence[Cell],
    methods: Sequence[Method],
    store: Store,
    workers: Workers,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
    until: Callable[[], bool] | None = None,
) -> list[Stored]:
    """Run cells in their order, and return their results.

    Cells in ``store`` are reused; if a cell lacks a method, or the method failed there, only that method is run. A cell
    that fails, or whose worker dies, does not stop the others. No new cell starts after ``until`` returns True.
    """
    known = {cell: store.load(cell) for cell in cells}
    missing = {cell: tuple(m for m in methods if known[cell].lacks(m)) for cell in cells}
    todo = [(cell, lacking) for cell, lacking in missing.items() if lacking]
    done = len(cells) - len(todo)
    with contextlib.closing(run_jobs(workers, partial(_run_missing, device), todo)) as running:
        for (cell, lacking), future in running:
            message = failure_of(future)
            found = failed(cell, lacking, message) if message else future.result()
            events = found.events or known[cell].events
            known[cell] = Stored(cell, events, {**known[cell].results, **found.results})
            store.save(known[cell])
            done += 1
            if progress is not None:
                progress(f"{done:,} of {len(cells):,} cells", done / len(cells))
            if until is not None and until():
                break
    return [known[cell] for cell in cells]


def _run_missing(device: str, job: tuple[Cell, tuple[Method, ...]]) -> Stored:
    """Run the methods that a cell lacks."""
    return run_cell(*job, device)


def chosen(names: Sequence[str] = ()) -> tuple[Method, ...]:
    """Return methods by their names; the default and the paper's method are always included."""
    return tuple(m for m in METHODS if not names or m.name in (*names, "default", "paper"))
