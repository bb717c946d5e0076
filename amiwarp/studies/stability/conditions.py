"""A condition is all that determines a recording of the atlas; an axis is one field of it, harmless to hopeless."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from amiwarp.events.encoder import TURN, Encoder
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import Recording
from amiwarp.optics.camera import Camera
from amiwarp.optics.lens import RadialTangential
from amiwarp.optics.prism import FlatSide, Prism
from amiwarp.simulation.motion import CameraMotion, EncoderModel, PrismMotion
from amiwarp.simulation.simulator import Scene, SensorModel, Simulation, Still
from amiwarp.studies.stability.scenes import Lamp, Passing, SceneKind, draw

TEXELS = 2.0
"""Of the picture per pixel of the camera, in its middle."""
HARDWARE_DEG = 10.0
"""Standard deviation of what the hardware tells of the phase."""
HARDWARE_APEX = 0.05
"""Relative standard deviation of the nominal apex."""


@dataclass(frozen=True)
class Condition:
    """A simulated recording; the defaults are harmless. Two equal ones with equal seeds give the same recording."""

    scene: str = SceneKind.TEXTURE.value
    width: int = 320
    height: int = 240
    fov_deg: float = 60.0
    apex_deg: float = 1.0
    rpm: float = 720.0
    turns: float = 4.0
    contrast: float = 0.25
    window_events: int = 0
    """Events in the sensor's readout window: a rectangle about the middle, as large as gives so many; 0: all of it."""
    lost: float = 0.0
    """Share of the events that never leave the sensor, at random."""
    noise: float = 0.0
    """Share of background noise among all events."""
    hot: float = 0.0
    """Share of hot pixels, of 500 events a second each."""
    mismatch: float = 0.03
    latency_us: float = 100.0
    refractory_us: float = 100.0
    readout_us: float = 0.0
    """Interval of scans to whose ends all time stamps are moved."""
    counts_per_turn: int = 8192
    jitter_deg: float = 0.0
    """Standard deviation of an encoder sample's angle."""
    clock_offset_us: float = 0.0
    dropouts_hz: float = 0.0
    slip_deg: float = 0.0
    """By which the encoder loses its angle each second, in two steps a turn."""
    backwards: bool = False
    """Whether the encoder counts the wrong way."""
    ripple: float = 0.0
    """Relative amplitude of the speed's ripple, three times a turn; the encoder sees it."""
    flat_side_wrong: bool = False
    focal_error: float = 0.0
    """Relative error of the focal length that the recording names."""
    distortion: float = 0.0
    """k1 of the camera, of which the recording does not tell."""
    start: str = "none"
    """What is told of the phase beforehand: none, right or wrong (by 90 degrees)."""
    lamp: float = 0.0
    """Share of the picture that flickers at 100 Hz."""
    passing: float = 0.0
    """Share of the picture that a passing object hides, at half a picture's width a second."""
    camera_deg_s: float = 0.0
    """Speed at which the camera turns, about a tilted axis."""
    cancelled: float = 0.0
    """Share of the prism's motion in the image that the camera's own takes back."""

    @property
    def key(self) -> str:
        """Tells conditions apart by their settings."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:16]

    @property
    def camera(self) -> Camera:
        """The true one."""
        camera = Camera.from_fov(self.width, self.height, math.radians(self.fov_deg))
        return replace(camera, distortion=RadialTangential(k1=self.distortion)) if self.distortion else camera

    @property
    def told_camera(self) -> Camera:
        """The one that the recording names."""
        scale = 1.0 + self.focal_error
        return replace(self.camera, fx=self.camera.fx * scale, fy=self.camera.fy * scale, distortion=None)

    @property
    def told_side(self) -> FlatSide:
        """Where the flat face looks, as the recording has it."""
        return FlatSide.CAMERA if self.flat_side_wrong else FlatSide.SCENE

    @property
    def prism(self) -> Prism:
        return Prism(math.radians(self.apex_deg))

    @property
    def duration_s(self) -> float:
        return self.turns * 60.0 / self.rpm


@dataclass(frozen=True)
class Sample:
    """A recording of the atlas, and what its hardware is thought to be."""

    recording: Recording
    hardware: dict[str, float]
    """Phase [rad] as the hardware tells it: roughly."""


def make(condition: Condition, seed: int, device: str = "cpu") -> Sample:
    """The recording of a condition."""
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
    nominal = Prism(apex, flat_side=condition.told_side)
    assert recording.encoder is not None
    told = replace(
        recording,
        events=MemoryEvents(events, condition.width, condition.height),
        camera=condition.told_camera,
        encoder=faulty(recording.encoder, condition, rng),
        prism=nominal,
    )
    told_phase = simulation.motion.phase + math.radians(HARDWARE_DEG) * rng.standard_normal()
    return Sample(told, {"phase": told_phase + (math.pi / 2 if condition.start == "wrong" else 0.0)})


def _simulation(c: Condition, seed: int, rng: np.random.Generator, device: str) -> Simulation:
    phase = rng.uniform(-math.pi, math.pi)
    sensor = SensorModel(
        contrast_on=c.contrast, contrast_off=c.contrast, mismatch=c.mismatch, latency_us=c.latency_us,
        refractory_us=c.refractory_us, hot_fraction=c.hot, hot_hz=500.0, shot_noise_hz=0.1, leak_hz=0.1,
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
        return Scene(Passing(light, c.passing, 0.5, duration, seed), fov)
    return Scene(Still(light), fov)


def _prism_motion(c: Condition, phase: float) -> PrismMotion:
    if not c.ripple:
        return PrismMotion(c.rpm, phase)
    hz = 3.0 * c.rpm / 60.0
    return PrismMotion.from_function(
        lambda t: c.rpm * (1.0 + c.ripple * np.sin(TURN * hz * t)), c.duration_s, phase=phase
    )


def _camera_motion(c: Condition, motion: PrismMotion, rng: np.random.Generator) -> CameraMotion:
    if c.cancelled:
        return _cancelling(c, motion)
    axis = rng.standard_normal(3)
    return CameraMotion(np.radians(c.camera_deg_s) * axis / np.linalg.norm(axis))


def _cancelling(c: Condition, motion: PrismMotion) -> CameraMotion:
    """Turns the camera so that the image moves against what the prism does to it.

    The prism moves what a pixel sees by δ (cos φ, sin φ) on the image plane, and turning about y by a moves it by
    +a along x, about x by -a along y.
    """
    t = np.arange(0.0, c.duration_s + 2e-3, 1e-3)
    angle = motion.phase + motion.angle(t * 1e6)
    size = -c.cancelled * c.prism.deflection
    along = size * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rates = np.gradient(along, t, axis=0)
    return CameraMotion(np.column_stack([t, -rates[:, 1], rates[:, 0], np.zeros(len(t))]))


def _noisy(c: Condition, simulation: Simulation, clean: int) -> SensorModel:
    """As much noise as makes the share: its rate follows from a run without."""
    hz = clean * c.noise / (1.0 - c.noise) / (c.width * c.height * c.duration_s)
    return replace(simulation.sensor, shot_noise_hz=hz)


def windowed(events: Events, width: int, height: int, count: int) -> Events:
    """The ``count`` events, about, that lie in the smallest rectangle of the image's shape about its middle."""
    away = np.maximum(np.abs(events.x / (width - 1.0) - 0.5), np.abs(events.y / (height - 1.0) - 0.5))
    if len(away) <= count:
        return events
    return events[away <= np.partition(away, count)[count]]


def scanned(events: Events, interval_us: float) -> Events:
    """Events read out in scans: each bears the time of the next scan's end, rows in order."""
    t = (np.ceil(events.t / interval_us) * interval_us).astype(np.int64)
    order = np.lexsort((events.x, events.y, t))
    return Events(events.x[order], events.y[order], t[order], events.p[order])


def faulty(encoder: Encoder, c: Condition, rng: np.random.Generator) -> Encoder:
    """What the calibration is told of the encoder."""
    angle = encoder.angle + math.radians(c.jitter_deg) * rng.standard_normal(len(encoder.angle))
    if c.slip_deg:
        half_turns = np.floor(angle / math.pi)
        angle = angle - math.radians(c.slip_deg) * (half_turns - half_turns[0]) * 30.0 / c.rpm
    if c.backwards:
        angle = -angle
    return Encoder(encoder.t, angle)


@dataclass(frozen=True)
class Axis:
    """What breaks calibration, from harmless to hopeless."""

    name: str
    field: str
    """Of :class:`Condition`."""
    values: tuple[Any, ...]
    unit: str = ""
    also: tuple[tuple[str, Any], ...] = ()
    """Fields that differ from the default all along the axis."""

    def conditions(self) -> list[Condition]:
        return [replace(Condition(), **dict(self.also), **{self.field: value}) for value in self.values]


def _scene_values(*kinds: SceneKind) -> tuple[str, ...]:
    return tuple(kind.value for kind in kinds)


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
    Axis("scene", "scene", _scene_values(*SceneKind)),
    Axis("flickering lamp", "lamp", (0.0, 0.01, 0.05, 0.2, 0.6), "of the picture"),
    Axis("camera turning", "camera_deg_s", (0.0, 1.0, 3.0, 10.0, 30.0, 60.0), "°/s"),
    Axis("passing object", "passing", (0.0, 0.02, 0.1, 0.3, 0.6), "of the picture"),
    Axis("motion cancelled", "cancelled", (0.0, 0.3, 0.6, 0.9, 1.0), "of the prism's"),
)


_MOST: dict[str, float] = {
    "noise": 0.5, "camera_deg_s": 30.0, "jitter_deg": 0.5,
    "contrast": 0.6, "lost": 0.1, "hot": 0.001, "mismatch": 0.1, "latency_us": 1000.0, "refractory_us": 1000.0,
    "readout_us": 500.0, "clock_offset_us": 1000.0, "dropouts_hz": 10.0, "slip_deg": 0.0, "backwards": 0.0,
    "ripple": 0.2, "focal_error": 0.01, "lamp": 0.05, "passing": 0.02, "cancelled": 0.0, "flat_side_wrong": 0.0,
}  # fmt: skip
_LEAST: dict[str, float] = {"turns": 0.5, "counts_per_turn": 64, "distortion": -0.03, "apex_deg": 0.5}
"""An apex of 0.5 degrees makes an orbit of 1.2 px here; that of 0.25 degrees lies within a pixel."""
FEWEST_EVENTS = 20_000


def sensible(c: Condition, events: int) -> bool:
    """Whether a sensible user would expect to be served: what the aims speak of, and a working rig."""
    return (
        events >= FEWEST_EVENTS
        and c.scene in _scene_values(SceneKind.TEXTURE, SceneKind.EDGES)
        and all(getattr(c, name) <= most for name, most in _MOST.items())
        and all(getattr(c, name) >= least for name, least in _LEAST.items())
    )
