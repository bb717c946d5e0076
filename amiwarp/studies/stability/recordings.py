"""Simulated recordings of conditions."""

import math
from dataclasses import dataclass, replace
from math import tau as TWO_PI
from typing import Any, cast

import numpy as np

from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import Scene, Still
from amiwarp.simulation.encoder_model import EncoderModel
from amiwarp.simulation.motion import CameraMotion, PrismMotion
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.studies.stability import optics
from amiwarp.studies.stability.changing_scenes import Lamp, PassingObject
from amiwarp.studies.stability.condition import HARDWARE_APEX, HARDWARE_DEG, TEXELS, Condition
from amiwarp.studies.stability.encoders import index_pulses
from amiwarp.studies.stability.rigs import Rig, rig_of
from amiwarp.studies.stability.scenes import SceneKind, draw


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


@dataclass(frozen=True)
class OpticSample:
    """Simulated recording of the study with any optic."""

    recording: Recording
    """Simulated recording, as a user would have it."""
    rig: Rig
    """The rig that it was simulated with."""


def make_optic(condition: Condition, seed: int, device: str = "cpu") -> OpticSample:
    """Simulate the recording of a condition that names an optic."""
    rng = np.random.default_rng([seed, int(condition.key, 16) & 0x7FFFFFFF])
    rig = rig_of(condition, seed, rng, device)
    recording = rig.simulation.run()
    if condition.noise:
        sensor = _noisy(condition, rig.simulation, len(recording.events))
        recording = replace(rig.simulation, sensor=sensor).run()
    events = recording.events.slice(0, len(recording.events))
    if condition.window_events:
        events = windowed(events, condition.width, condition.height, condition.window_events)
    given = MemoryEvents(events, condition.width, condition.height)
    stated = replace(recording, events=given, camera=condition.stated_camera, encoder=rig.encoder)
    return OpticSample(stated, rig)


def make(condition: Condition, seed: int, device: str = "cpu") -> SimulatedSample:
    """Simulate the recording of a condition that names no optic."""
    rng = np.random.default_rng([seed, int(condition.key, 16) & 0x7FFFFFFF])
    simulation = _simulation(condition, seed, rng, device)
    recording = simulation.run()
    if condition.noise:
        sensor = _noisy(condition, simulation, len(recording.events))
        recording = replace(simulation, sensor=sensor).run()
    motion = simulation.prism_motion
    events = _troubled(recording, condition, motion, rng)

    # What the hardware states is not exact.
    apex = condition.prism.apex * (1.0 + HARDWARE_APEX * rng.standard_normal())
    index = condition.prism.index - condition.index_error
    nominal = Prism(apex, index, condition.stated_side)

    last_event_us = int(events.t[-1]) if len(events) else 0
    turn_and_a_half_us = math.ceil(1.5 * 60e6 / condition.rpm)
    end_us = max(last_event_us, turn_and_a_half_us)
    plain = None
    encoder = None
    if condition.index_only:
        plain = index_pulses(motion, end_us, 0.0, rng)
        encoder = plain
    elif not condition.no_encoder:
        assert recording.encoder is not None
        assert simulation.encoder_model is not None
        harmonics = simulation.encoder_model.harmonics
        ideal = replace(EncoderModel.ideal(), rate_hz=1e4, harmonics=harmonics)
        plain = ideal.sample(motion, end_us, 0)
        encoder = distorted_encoder(recording.encoder, condition, rng)

    phase = motion.phase + math.radians(HARDWARE_DEG) * rng.standard_normal()
    if condition.start == "wrong":
        phase += math.pi / 2
    hardware = {"phase": phase}
    if condition.no_encoder:
        hardware = {}  # nothing tells the angle that the mounted phase refers to

    stated = replace(
        recording,
        events=MemoryEvents(events, condition.width, condition.height),
        camera=condition.stated_camera,
        encoder=encoder,
        prism=nominal,
    )
    truth = cast("ExactModel", simulation.true_model)
    return SimulatedSample(stated, hardware, truth, motion, plain)


def _troubled(
    recording: Recording, condition: Condition, motion: PrismMotion, rng: np.random.Generator
) -> Events:
    """Return the events of a recording as its sensor gives them under a condition: lost, cut off or late."""
    events = recording.events.slice(0, len(recording.events))
    if condition.window_events:
        events = windowed(events, condition.width, condition.height, condition.window_events)
    if condition.lost:
        kept = rng.uniform(size=len(events)) >= condition.lost
        events = events[kept]
    if condition.readout_us:
        events = scanned(events, condition.readout_us)
    events = skewed(events, condition)
    if condition.lost_part:
        begin = rng.uniform(0.0, TWO_PI)
        in_turn = (motion.angle(events.t) - begin) % TWO_PI
        events = events[in_turn >= condition.lost_part * TWO_PI]
    return events


def skewed(events: Events, condition: Condition) -> Events:
    """Return events whose pixels are read out one column, or one row, after the other."""
    if not (condition.column_us or condition.line_us):
        return events
    late_us = np.rint(condition.column_us * events.x + condition.line_us * events.y)
    t = events.t + late_us.astype(np.int64)
    order = np.argsort(t, kind="stable")
    return Events(events.x[order], events.y[order], t[order], events.p[order])


def _simulation(
    condition: Condition, seed: int, rng: np.random.Generator, device: str
) -> Simulation:
    """Return the simulation of a condition without background noise."""
    phase = rng.uniform(-math.pi, math.pi)
    harmonics = (*_at_random(condition.eccentric_deg, rng), *_at_random(condition.second_deg, rng))
    encoder = EncoderModel(
        counts_per_turn=condition.counts_per_turn,
        clock_offset_us=condition.clock_offset_us,
        dropouts_hz=condition.dropouts_hz,
        jitter_us=1.0,
        harmonics=harmonics,
    )
    motion = _prism_motion(condition, phase, rng)
    return Simulation(
        _scene(condition, seed),
        condition.camera,
        condition.prism,
        condition.duration_s,
        motion,
        _camera_motion(condition, motion, rng),
        condition.sensor,
        encoder,
        seed=seed,
        device=device,
    )


def _at_random(size_deg: float, rng: np.random.Generator) -> tuple[float, float]:
    """Return the two components of a size [deg] in a random direction [rad]; nothing is drawn for a size of 0."""
    return optics.at_random(math.radians(size_deg), rng)


def _scene(condition: Condition, seed: int) -> Scene:
    """Return the scene of a condition."""
    # The prism moves the view beyond the image: the picture is larger on all sides.
    wedge = 2.2 * condition.prism.deflection
    half = min(math.radians(condition.fov_deg) / 2.0 + wedge, 1.35)
    focal = TEXELS * condition.camera.fx
    width = 2 * math.ceil(focal * math.tan(half)) + 2
    flatter = min(1.0, 1.0 + condition.aspect_error)
    height_without_prism = math.ceil(width * condition.height / condition.width / flatter)
    height = height_without_prism + 2 * math.ceil(focal * wedge)

    orbit_diameter = 2.0 * condition.prism.deflection * focal
    light = draw(SceneKind(condition.scene), width, height, period=orbit_diameter, seed=seed)
    fov = 2.0 * math.atan(width / 2.0 / focal)
    duration_us = math.ceil(condition.duration_s * 1e6)
    if condition.lamp:
        return Scene(Lamp(light, condition.lamp, duration_us), fov)
    if condition.passing:
        passing = PassingObject(light, condition.passing, 0.5, duration_us, seed)
        return Scene(passing, fov)
    return Scene(Still(light), fov)


def _prism_motion(condition: Condition, phase: float, rng: np.random.Generator) -> PrismMotion:
    """Return the prism's motion under a condition."""
    # the apex varies over the image by twice the cylinder power: along the wedge and across it, with opposite signs
    shape: dict[str, Any] = {
        "cylinder": _at_random(condition.cylinder_deg / 2.0, rng),
        "wobble": _at_random(condition.wobble_deg, rng),
    }
    if not (condition.ripple or condition.turn_ripple or condition.ramp):
        return PrismMotion(condition.rpm, phase, **shape)
    begin = rng.uniform(0.0, TWO_PI) if condition.turn_ripple else 0.0
    hz = condition.rpm / 60.0
    three_turns_s = 3.0 / hz
    end_s = max(condition.duration_s, 1.5 / hz)
    t = np.arange(-three_turns_s, end_s + three_turns_s, 1e-3)
    speed = condition.rpm * (1.0 + condition.ripple * np.sin(TWO_PI * 3.0 * hz * t))
    speed *= 1.0 + condition.turn_ripple * np.sin(TWO_PI * hz * t + begin)
    speed *= np.interp(t, [0.0, condition.duration_s], [1.0 - condition.ramp, 1.0])
    return PrismMotion(np.column_stack([t, speed]), phase, **shape)


def _camera_motion(
    condition: Condition, motion: PrismMotion, rng: np.random.Generator
) -> CameraMotion:
    """Return the camera's motion under a condition."""
    if condition.cancelled:
        return _cancelling(condition, motion)
    axis = rng.standard_normal(3)
    return CameraMotion(np.radians(condition.camera_deg_s) * axis / np.linalg.norm(axis))


def _cancelling(condition: Condition, motion: PrismMotion) -> CameraMotion:
    """Return the rotation of the camera that moves the image against the prism's motion.

    The prism displaces the view of a pixel by δ (cos φ, sin φ) on the image plane. A rotation about y by a displaces it
    by +a along x, and a rotation about x by -a along y.
    """
    t = np.arange(0.0, condition.duration_s + 2e-3, 1e-3)
    angle = motion.phase + motion.angle(t * 1e6)
    size = -condition.cancelled * condition.prism.deflection
    along = size * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rates = np.gradient(along, t, axis=0)
    about_x = -rates[:, 1]
    about_y = rates[:, 0]
    about_z = np.zeros(len(t))
    return CameraMotion(np.column_stack([t, about_x, about_y, about_z]))


def _noisy(condition: Condition, simulation: Simulation, clean: int) -> SensorModel:
    """Return the sensor with the noise rate that gives the condition's share of noise.

    ``clean`` is the number of events without noise.
    """
    pixel_seconds = condition.width * condition.height * simulation.duration_s
    noise_events = clean * condition.noise / (1.0 - condition.noise)
    hz = noise_events / pixel_seconds
    return replace(simulation.sensor, shot_noise_hz=hz)


def windowed(events: Events, width: int, height: int, count: int) -> Events:
    """Return about ``count`` events in a readout window.

    It is the smallest rectangle about the middle that holds them, with the aspect ratio of the image.
    """
    if len(events) <= count:
        return events
    aside = np.abs(events.x / (width - 1.0) - 0.5)
    above = np.abs(events.y / (height - 1.0) - 0.5)
    from_middle = np.maximum(aside, above)
    farthest = np.partition(from_middle, count)[count]
    return events[from_middle <= farthest]


def scanned(events: Events, interval_us: float) -> Events:
    """Return events as read out in scans: each gets the time stamp of the end of its scan; rows are in order."""
    t = (np.ceil(events.t / interval_us) * interval_us).astype(np.int64)
    order = np.lexsort((events.x, events.y, t))
    return Events(events.x[order], events.y[order], t[order], events.p[order])


def distorted_encoder(encoder: Encoder, condition: Condition, rng: np.random.Generator) -> Encoder:
    """Return the encoder with the errors that the condition demands."""
    jitter = math.radians(condition.jitter_deg) * rng.standard_normal(len(encoder.angle))
    angle = encoder.angle + jitter
    if condition.slip_deg:
        half_turns = np.floor(angle / math.pi)
        # Half a turn takes 30 s / rpm.
        lost = math.radians(condition.slip_deg) * (half_turns - half_turns[0]) * 30.0
        angle = angle - lost / condition.rpm
    angle = angle * (1.0 + condition.encoder_scale)
    if condition.backwards:
        angle = -angle
    return Encoder(encoder.t, angle)
