"""Conditions of the stability study: everything that determines a simulated recording."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace

import numpy as np

from amiwarp.events.encoder import TWO_PI, Encoder
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import Recording
from amiwarp.optics.camera import Camera
from amiwarp.optics.lens import RadialTangential
from amiwarp.optics.prism import FlatSide, Prism
from amiwarp.simulation.motion import CameraMotion, EncoderModel, PrismMotion
from amiwarp.simulation.scene import Scene, Still
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.studies.stability.scenes import Lamp, PassingObject, SceneKind, draw

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
        return replace(camera, distortion=RadialTangential(k1=self.distortion)) if self.distortion else camera

    @property
    def stated_camera(self) -> Camera:
        """Camera with the intrinsics that the recording states."""
        true, scale = self.camera, 1.0 + self.focal_error
        return replace(true, fx=true.fx * scale, fy=true.fy * scale, cx=true.cx + self.principal_px, distortion=None)

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


_LATER_FIELDS = ("cutoff_hz", "bus_rate_mev_s", "principal_px", "encoder_scale")
"""Fields of :class:`Condition` with default 0 that did not exist when the first cells were stored."""


@dataclass(frozen=True)
class SimulatedSample:
    """Simulated recording of the study, and the parameters that its hardware states."""

    recording: Recording
    """Simulated recording with its ground truth."""
    hardware: dict[str, float]
    """Approximate phase that the hardware states [rad]."""


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
    apex = condition.prism.apex * (1.0 + HARDWARE_APEX * rng.standard_normal())
    nominal = Prism(apex, flat_side=condition.stated_side)
    assert recording.encoder is not None
    stated = replace(
        recording,
        events=MemoryEvents(events, condition.width, condition.height),
        camera=condition.stated_camera,
        encoder=distorted_encoder(recording.encoder, condition, rng),
        prism=nominal,
    )
    stated_phase = simulation.motion.phase + math.radians(HARDWARE_DEG) * rng.standard_normal()
    return SimulatedSample(stated, {"phase": stated_phase + (math.pi / 2 if condition.start == "wrong" else 0.0)})


def _simulation(c: Condition, seed: int, rng: np.random.Generator, device: str) -> Simulation:
    """Return the simulation of a condition without background noise."""
    phase = rng.uniform(-math.pi, math.pi)
    sensor = SensorModel(
        contrast_on=c.contrast, contrast_off=c.contrast, mismatch=c.mismatch, latency_us=c.latency_us,
        refractory_us=c.refractory_us, hot_fraction=c.hot, hot_hz=500.0, shot_noise_hz=0.1, leak_hz=0.1,
        cutoff_hz=c.cutoff_hz, bus_rate_mev_s=c.bus_rate_mev_s,
    )  # fmt: skip
    encoder = EncoderModel(
        counts_per_turn=c.counts_per_turn, clock_offset_us=c.clock_offset_us, dropouts_hz=c.dropouts_hz, jitter_us=1.0
    )
    motion = _prism_motion(c, phase)
    return Simulation(
        _scene(c, seed), c.camera, c.prism, c.duration_s, motion, _camera_motion(c, motion, rng), sensor, encoder,
        seed=seed, device=device,
    )  # fmt: skip


def _scene(c: Condition, seed: int) -> Scene:
    """Return the scene of a condition."""
    wedge = 2.2 * c.prism.deflection
    half = min(math.radians(c.fov_deg) / 2.0 + wedge, 1.35)
    focal = TEXELS * c.camera.fx
    width = 2 * math.ceil(focal * math.tan(half)) + 2
    height = math.ceil(width * c.height / c.width) + 2 * math.ceil(focal * wedge)
    diameter = 2.0 * c.prism.deflection * focal
    light = draw(SceneKind(c.scene), width, height, period=diameter, seed=seed)
    fov = 2.0 * math.atan(width / 2.0 / focal)
    duration = math.ceil(c.duration_s * 1e6)
    if c.lamp:
        return Scene(Lamp(light, c.lamp, duration), fov)
    if c.passing:
        return Scene(PassingObject(light, c.passing, 0.5, duration, seed), fov)
    return Scene(Still(light), fov)


def _prism_motion(c: Condition, phase: float) -> PrismMotion:
    """Return the prism's motion under a condition."""
    if not c.ripple:
        return PrismMotion(c.rpm, phase)
    hz = 3.0 * c.rpm / 60.0
    return PrismMotion.from_function(
        lambda t: c.rpm * (1.0 + c.ripple * np.sin(TWO_PI * hz * t)), c.duration_s, phase=phase
    )


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
