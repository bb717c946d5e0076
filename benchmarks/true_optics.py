"""Errors of calibrations on recordings of a second simulator, with troubles drawn by seed, and what was stated of them.

    python -m benchmarks.true_optics drawn|fresh --out FILE.json [--seeds 12] [--only OPTIC …] [--processes 1]
        [--first-seed 0] [--events FOLDER] [--device cuda:0]

``drawn``: for each of five optics, recordings whose optic, scene, sensor and trouble are drawn by seed. ``fresh``:
twenty troubles that no code was chosen with. ``--events`` keeps the simulated events for the next run.

The error is the distance between where the calibration puts the events and where they belong, over the image and the
recording, in px rms. One constant lag of all events and one constant rotation of the camera are removed first: neither
can be seen. ``shift_removed_px`` is the error if only a shift of the picture is removed in place of the rotation.

``named`` is what the stability study calls so: a warning or a refusal has a word of the trouble's cause, or the stated
bound of that cause is at least as large as the error.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

import amiwarp
from amiwarp import Camera, Encoder, Events, MemoryEvents, Plate, Prism, Recording
from amiwarp.studies.stability.causes import could_hide, has_word
from benchmarks.moving_optics import rows_of
from reference import optics as oracle
from reference.second_simulator import Pixels, Place, dead_leaves, events_of

Array = NDArray[np.float64]

SIZE = 320, 240
FOV = math.radians(60.0)
CAMERA = Camera.from_fov(*SIZE, FOV)
SAMPLE_US = 1000
"""Time between two samples of an encoder [us]."""
BEFORE_US = 5000
"""Time by which an encoder begins before the events and ends after them [us]."""
DEPTH_PER_M = 2.0
"""Inverse depth of the scene behind a plate, in the middle of the image [1/m]."""


@dataclass(frozen=True)
class Rig:
    """An optic in motion, and what the user knows of it."""

    place: Place
    """Where pixels look at a time, without the camera's own motion."""
    encoder: Encoder | None
    """What the encoder reads."""
    prism: Any = None
    """Nominal glass, as the recording states it."""
    model: str = "auto"
    duration_s: float = 0.25
    camera: Camera = CAMERA
    """Camera as it is given."""
    pixels: Pixels = field(default_factory=Pixels)
    lamp: Callable[[float], float] = lambda _: 1.0
    contrast: float = 1.0
    metadata: dict[str, Any] = field(default_factory=dict)
    inverse_depth: Callable[[Array], Array] | None = None
    """Inverse depth of what pixels without the optic see [1/m], for a plate."""
    needs: tuple[str, ...] = ()
    """Words in small letters, one of which a warning, a refusal or a stated bound must have to name the cause."""


ANGLE = "angle is wrong", "repeats with"
"""Words that name an error of an encoder that repeats with its angle."""
SHAPE = "cylinder", "evenness", "uneven", "wobble", "seat"
"""Words that name the shape of a prism or its seat, which move the image nearly alike."""
Angle = Callable[[Array], Array]
"""Function that returns an angle [rad] at times [s]."""


def turning(rpm: float, start: float = 0.0) -> Angle:
    """Return an angle that grows at a constant speed."""
    return lambda t: start + rpm * math.tau / 60.0 * np.asarray(t)


def read(angle: Angle, duration_s: float, sample_us: int = SAMPLE_US) -> Encoder:
    """Return an encoder that reads an angle without error."""
    t = np.arange(-BEFORE_US, 1e6 * duration_s + BEFORE_US + sample_us, sample_us).astype(np.int64)
    return Encoder.from_angles(t, angle(t * 1e-6))


def wrong(angle: Angle, error: Callable[[Array], Array]) -> Angle:
    """Return what an encoder reads whose error depends on the angle."""
    return lambda t: angle(t) + error(angle(t))


def off_centre(
    rng: np.random.Generator, low_deg: float, high_deg: float, harmonic: int = 1
) -> Callable[[Array], Array]:
    """Return the error of an encoder that is off centre, or another harmonic of the angle."""
    size = math.radians(rng.uniform(low_deg, high_deg))
    at = rng.uniform(-math.pi, math.pi)
    return lambda angle: size * np.sin(harmonic * angle + at)


def speed(rng: np.random.Generator) -> float:
    """Return a speed of a motor [turns/min]."""
    return float(rng.choice([-1.0, 1.0]) * math.exp(rng.uniform(math.log(400.0), math.log(1200.0))))


def common(rng: np.random.Generator) -> dict[str, Any]:
    """Return a scene's contrast and a sensor, drawn."""
    on = rng.uniform(0.15, 0.35)
    pixels = Pixels(
        on=on,
        off=on * rng.uniform(0.8, 1.25),
        refractory_us=float(rng.choice([0.0, 100.0])),
        noise=rng.uniform(0.005, 0.02),
        background_hz=rng.uniform(0.2, 3.0),
    )
    return {"pixels": pixels, "contrast": rng.uniform(0.6, 1.0)}


# A wedge.


@dataclass
class Wedge:
    """A wedge prism that turns, before its trouble."""

    apex: float
    phase: float
    rpm: float
    index: float = 1.5168
    duration_s: float = 0.25
    shape: dict[str, Any] = field(default_factory=dict)

    def place(self, angle: Angle, camera: Camera = CAMERA) -> Place:
        prism = Prism(self.apex, self.index)

        def at(xy: Array, t: float) -> Array:
            theta = np.full(len(xy), float(angle(np.array(t))))
            return oracle.move(
                camera, prism, xy, theta, to_scene=True, phase=self.phase, **self.shape
            )

        return at


def wedge(rng: np.random.Generator, trouble: str) -> Rig:
    """Return a wedge with a trouble."""
    one = Wedge(math.radians(rng.uniform(0.6, 1.8)), rng.uniform(-math.pi, math.pi), speed(rng))
    nominal = Prism(one.apex * rng.uniform(0.9, 1.1))
    angle = turning(one.rpm)
    known = common(rng)
    turn_s = 60.0 / abs(one.rpm)
    rig = Rig(one.place(angle), read(angle, one.duration_s), nominal, **known)
    pixels = rig.pixels
    if trouble == "none":
        return rig
    if trouble == "encoder off centre":
        off = read(wrong(angle, off_centre(rng, 1.0, 5.0)), one.duration_s)
        return replace(rig, encoder=off, needs=ANGLE)
    if trouble == "wobble":
        one.shape = {"wobble": tuple(np.radians(rng.uniform(-1.0, 1.0, 2)))}
        return replace(rig, place=one.place(angle), needs=SHAPE)
    if trouble == "cylinder":
        one.shape = {"cylinder": tuple(np.radians(rng.uniform(-0.1, 0.1, 2)))}
        return replace(rig, place=one.place(angle), needs=SHAPE)
    if trouble == "noise events":
        noisy = replace(pixels, background_hz=rng.uniform(10.0, 25.0))
        return replace(rig, pixels=noisy, needs=("noise",))
    if trouble == "time stamps of 1 ms":
        return replace(rig, pixels=replace(pixels, stamp_us=1000), needs=("time stamp",))
    if trouble == "OFF events late":
        return replace(rig, pixels=replace(pixels, off_delay_us=500.0))
    if trouble == "slow pixels":
        return replace(
            rig, pixels=replace(pixels, bandwidth_hz=rng.uniform(2e3, 6e3)), needs=("slow",)
        )
    if trouble == "lost counts":
        lost, at_s = (
            math.tau * rng.uniform(50.0, 150.0) / 4096.0,
            one.duration_s * rng.uniform(0.3, 0.7),
        )
        steps = lambda t: angle(t) - math.copysign(lost, one.rpm) * (np.asarray(t) > at_s)  # noqa: E731
        return replace(
            rig, encoder=read(steps, one.duration_s), needs=("lost", "slip", "jump", "step")
        )
    if trouble in ("index pulses that jitter", "hunting between index pulses"):
        duration_s = 6.5 * turn_s
        if trouble.startswith("hunting"):
            share, hz = rng.uniform(0.01, 0.04), rng.uniform(3.0, 20.0)
            angle = hunting(one.rpm, share, hz)
        pulses = pulse_times(angle, one.rpm, duration_s)
        jitter_us = 200.0 * rng.standard_normal(len(pulses)) if trouble.endswith("jitter") else 0.0
        t = np.rint(1e6 * pulses + jitter_us).astype(np.int64)
        turns = math.copysign(math.tau, one.rpm) * np.arange(len(t))
        return replace(
            rig,
            place=one.place(angle),
            encoder=Encoder.from_angles(t, turns),
            duration_s=duration_s,
            needs=("pulse", "index", "speed"),
        )
    if trouble == "no encoder, unsteady speed":
        angle = hunting(one.rpm, rng.uniform(0.0, 0.05), rng.uniform(1.0, 4.0))
        return replace(rig, place=one.place(angle), encoder=None, needs=("speed",))
    if trouble == "third harmonic of the encoder":
        return replace(
            rig,
            encoder=read(wrong(angle, off_centre(rng, 1.0, 1.0, 3)), one.duration_s),
            needs=ANGLE,
        )
    if trouble == "encoder's clock drifts":
        drifting = lambda t: angle(1.002 * np.asarray(t))  # noqa: E731
        return replace(rig, encoder=read(drifting, one.duration_s), needs=("clock", "scale"))
    if trouble == "encoder of 64 counts":
        counted = lambda t: np.floor(angle(t) * 64.0 / math.tau) * math.tau / 64.0  # noqa: E731
        return replace(rig, encoder=read(counted, one.duration_s), needs=("coarse", *ANGLE))
    if trouble == "speed changes by 10 % halfway":
        half_s = 0.5 * one.duration_s
        stepped = lambda t: angle(t) + 0.1 * angle(np.maximum(0.0, np.asarray(t) - half_s))  # noqa: E731
        return replace(rig, place=one.place(stepped), encoder=read(stepped, one.duration_s))
    if trouble == "lamp dims by 30 %":
        return replace(
            rig,
            lamp=lambda t: 1.0 - 0.3 * t / one.duration_s,
            needs=("light", "leak", "brightness"),
        )
    if trouble == "lamp at 100 Hz":
        return replace(
            rig,
            lamp=lambda t: 1.0 + 0.1 * math.sin(math.tau * 100.0 * t),
            needs=("light", "flicker", "lamp"),
        )
    if trouble == "another glass":
        one.index = 1.62
        return replace(rig, place=one.place(angle), needs=("index", "nominal prism"))
    if trouble == "lens that was not given":
        lens = replace(CAMERA, distortion=amiwarp.RadialTangential(k1=-0.06))
        return replace(rig, place=one.place(angle, lens), needs=("k1", "lens"))
    if trouble == "encoder silent for 30 ms":
        whole = read(angle, one.duration_s)
        keep = (whole.t < 100_000) | (whole.t > 130_000)
        return replace(
            rig,
            encoder=Encoder.from_angles(whole.t[keep], whole.angle[keep]),
            needs=("gap", "silent", *ANGLE),
        )
    assert trouble == "faint scene in noise", trouble
    noisy = replace(pixels, background_hz=8.0, noise=0.03)
    return replace(rig, contrast=0.3, pixels=noisy, needs=("noise", "contrast", "few events"))


def hunting(rpm: float, share: float, hz: float) -> Angle:
    """Return the angle of a motor whose speed swings by a share, at a frequency."""
    rate = rpm * math.tau / 60.0
    return lambda t: (
        rate * (np.asarray(t) + share / (math.tau * hz) * np.sin(math.tau * hz * np.asarray(t)))
    )


def pulse_times(angle: Angle, rpm: float, duration_s: float) -> Array:
    """Return the times of a pulse each turn [s], from before the events to after them."""
    t = np.linspace(-2.2 * 60.0 / abs(rpm), duration_s + 2.2 * 60.0 / abs(rpm), 200_000)
    turns = math.copysign(1.0, rpm) * angle(t) / math.tau
    whole = np.arange(math.ceil(turns[0]), math.floor(turns[-1]) + 1)
    return np.interp(whole, turns, t)


# Two prisms.


def pair(rng: np.random.Generator, trouble: str) -> Rig:
    """Return a pair of prisms with a trouble."""
    first, second = (math.radians(x) for x in rng.uniform(0.6, 1.2, 2))
    one, two = (
        Wedge(first, rng.uniform(-math.pi, math.pi), speed(rng)),
        Wedge(second, rng.uniform(-3.0, 3.0), speed(rng)),
    )
    if abs(abs(one.rpm) - abs(two.rpm)) < 0.15 * abs(one.rpm):
        two.rpm *= 0.7  # what speeds that are nearly equal determine is another matter
    duration_s = 0.3
    a, b = turning(one.rpm), turning(two.rpm)
    glass = Prism(one.apex, second=Prism(two.apex))
    axis = oracle.rotation((0.0, 0.0))

    def place_of(first_axis: Array) -> Place:
        def at(xy: Array, t: float) -> Array:
            if first_axis is axis:
                theta = np.full((len(xy), 2), [float(a(np.array(t))), float(b(np.array(t)))])
                return oracle.through_pair(
                    CAMERA, glass, (one.phase, two.phase), xy, theta, to_scene=True
                )
            rays = oracle.pixels_to_rays(CAMERA, xy) @ first_axis
            rays = oracle.through_prism(
                Prism(one.apex),
                rays,
                np.full(len(xy), float(a(np.array(t)))) + one.phase,
                to_scene=True,
            )
            rays = rays @ first_axis.T
            phi = np.full(len(xy), float(b(np.array(t)))) + two.phase
            return oracle.rays_to_pixels(
                CAMERA, oracle.through_prism(Prism(two.apex), rays, phi, to_scene=True)
            )

        return at

    nominal = Prism(
        one.apex * rng.uniform(0.9, 1.1), second=Prism(two.apex * rng.uniform(0.9, 1.1))
    )
    reads = [read(a, duration_s), read(b, duration_s)]
    place = place_of(axis)
    needs: tuple[str, ...] = ()
    if trouble == "one encoder off centre":
        k = int(rng.integers(0, 2))
        reads[k] = read(wrong((a, b)[k], off_centre(rng, 1.0, 3.0)), duration_s)
        needs = ANGLE
    elif trouble == "both encoders off centre":
        reads = [read(wrong(x, off_centre(rng, 1.0, 3.0)), duration_s) for x in (a, b)]
        needs = ANGLE
    elif trouble == "encoders swapped":
        reads = reads[::-1]
        needs = ("swap", "exchange")
    elif trouble == "second encoder 1 ms late":
        reads[1] = read(lambda t: b(np.asarray(t) - 1e-3), duration_s)
    elif trouble == "third harmonic of the second encoder":
        reads[1] = read(wrong(b, off_centre(rng, 1.5, 1.5, 3)), duration_s)
        needs = ANGLE
    elif trouble == "axes 1 deg apart":
        place = place_of(oracle.rotation((math.radians(1.0), 0.0)))
        needs = ("axis", "tilt")
    else:
        assert trouble == "none", trouble
    encoder = reads[0].with_second(reads[1])
    return Rig(place, encoder, nominal, "risley", duration_s, needs=needs, **common(rng))


# A mirror.


def mirror(rng: np.random.Generator, trouble: str) -> Rig:
    """Return a mirror with two tilts, with a trouble."""
    hz = np.exp(rng.uniform(math.log(25.0), math.log(90.0), 2))
    if abs(hz[0] / hz[1] - 1.0) < 0.1:
        hz[1] *= 1.3
    size = rng.uniform(2.0, 6.0, 2) / (2.0 * CAMERA.fx)
    phase = rng.uniform(-math.pi, math.pi, 2)
    direction = np.array([0.0, 0.5 * math.pi]) + rng.uniform(-0.2, 0.2, 2)
    values = {
        "amplitude": size[0],
        "phase": 0.0,
        "second_amplitude": size[1],
        "second_phase": 0.0,
        "direction": direction[0],
        "second_direction": direction[1],
        "fold": rng.uniform(-math.pi, math.pi),
        "incidence": math.radians(rng.uniform(35.0, 55.0)),
    }
    duration_s = 0.12
    bend, skew, across = np.zeros(2), np.zeros(2), np.zeros(2)
    needs: tuple[str, ...] = ()
    if trouble == "cubic error of the command":
        bend = rng.uniform(0.03, 0.1, 2) * rng.choice([-1.0, 1.0], 2)
        needs = ("command",)
    elif trouble == "quadratic error of the command":
        skew = rng.uniform(0.03, 0.06, 2) * rng.choice([-1.0, 1.0], 2)
        needs = ("command",)
    elif trouble == "axes that leak 3 %":
        across = np.array([0.03, -0.03])
    elif trouble != "none":
        assert trouble == "tilts late by 0.3 and 0.8 ms", trouble
    late_s = np.array([3e-4, 8e-4]) if trouble.startswith("tilts late") else np.zeros(2)

    def swing(t: float) -> Array:
        c = np.cos(math.tau * hz * (t - late_s) + phase)
        tilt = c + bend * c**3 + skew * c**2
        return np.asarray(tilt + across * tilt[::-1])

    def place(xy: Array, t: float) -> Array:
        # The oracle takes angles: two tilts at rest in phase, with amplitudes that are those of this moment.
        c = swing(t)
        now = {**values, "amplitude": size[0] * c[0], "second_amplitude": size[1] * c[1]}
        return oracle.in_mirror(CAMERA, now, xy, np.zeros((len(xy), 2)))

    commands = [
        read(lambda t, k=k: math.tau * hz[k] * np.asarray(t) + phase[k], duration_s)
        for k in range(2)
    ]
    encoder = commands[0].with_second(commands[1])
    return Rig(
        place,
        encoder,
        None,
        "mirror",
        duration_s,
        needs=needs,
        metadata={"optic": "mirror"},
        **common(rng),
    )


# A vibration.


def vibration(rng: np.random.Generator, trouble: str) -> Rig:
    """Return a vibrating camera with a trouble."""
    hz = math.exp(rng.uniform(math.log(30.0), math.log(150.0)))
    forward = rng.uniform(1.5, 5.0) / CAMERA.fx
    back = forward * rng.uniform(0.0, 0.7) * np.exp(1j * rng.uniform(-math.pi, math.pi))
    values = {
        "amplitude": forward,
        "phase": rng.uniform(-math.pi, math.pi),
        "backward_x": back.real,
        "backward_y": back.imag,
    }
    duration_s = 8.0 / hz
    third = other = 0.0
    share, drift = 0.0, 0.0
    needs: tuple[str, ...] = ()
    if trouble == "second harmonic":
        part = 0.15 * forward * np.exp(1j * rng.uniform(-math.pi, math.pi))
        values |= {"second_x": part.real, "second_y": part.imag}
    elif trouble == "third harmonic":
        third = rng.uniform(0.05, 0.25) / CAMERA.fx
        needs = ("third harmonic", "harmonic")
    elif trouble == "unsteady amplitude":
        share = rng.uniform(0.05, 0.15)
        needs = ("amplitude",)
    elif trouble == "roll of 0.2 deg":
        values |= {"roll_x": math.radians(0.2)}
    elif trouble == "frequency drifts by 1 %":
        drift = 0.01
        needs = ("frequency",)
    elif trouble == "another vibration of 0.1 px":
        other = 0.1 / CAMERA.fx
        needs = ("vibration", "harmonic", "frequency")
    else:
        assert trouble == "none", trouble

    def place(xy: Array, t: float) -> Array:
        theta = math.tau * hz * (t + 0.5 * drift * t * t / duration_s)
        grown = 1.0 + share * math.sin(math.tau * 0.23 * hz * t)
        now = {n: x * grown if n != "phase" else x for n, x in values.items()}
        turn = oracle.vibration(now, np.full(1, theta)).as_rotvec()
        turn[:, 0] += third * math.cos(3.0 * theta + 0.7) + other * math.cos(1.37 * theta)
        turn[:, 1] += third * math.sin(3.0 * theta + 0.7) + other * math.sin(1.37 * theta)
        return oracle.turned(
            CAMERA, oracle.Rotation.from_rotvec(np.repeat(turn, len(xy), axis=0)), xy
        )

    return Rig(
        place,
        None,
        None,
        "vibration",
        duration_s,
        needs=needs,
        metadata={"optic": "vibration"},
        **common(rng),
    )


# A plate.


def plate(rng: np.random.Generator, trouble: str) -> Rig:
    """Return a tilted plate that turns before a slanted plane, with a trouble."""
    glass = Plate(0.01, math.radians(rng.uniform(38.0, 48.0)))
    nominal, phase, rpm, duration_s = glass, rng.uniform(-math.pi, math.pi), speed(rng), 0.35
    slant = rng.uniform(-1.0, 1.0, 2) * DEPTH_PER_M * 0.5 / SIZE[0]
    angle = turning(rpm)
    wedge_angle = 0.0
    needs: tuple[str, ...] = ()
    if trouble == "faces not parallel":
        wedge_angle = math.radians(rng.uniform(0.5, 2.0) / 60.0)
        needs = ("parallel", "wedge")
    elif trouble == "another thickness":
        nominal = replace(glass, thickness=0.0105)
        needs = ("thickness",)
    elif trouble == "another glass":
        nominal = replace(glass, index=1.6)
        needs = ("glass",)
    elif trouble == "encoder off centre":
        needs = ANGLE
    else:
        assert trouble == "none", trouble

    def inverse_depth(places: Array) -> Array:
        return np.asarray(DEPTH_PER_M + (places - [SIZE[0] / 2.0, SIZE[1] / 2.0]) @ slant)

    def place(xy: Array, t: float) -> Array:
        theta = np.full(len(xy), float(angle(np.array(t))))
        seen = xy
        for _ in range(6):  # the depth is that of the place, which depends on the depth
            seen = oracle.at_depth(CAMERA, glass, phase, xy, theta, inverse_depth(seen))
        if wedge_angle:
            seen = oracle.move(
                CAMERA, Prism(wedge_angle), seen, theta, to_scene=True, phase=phase + 0.9
            )
        return seen

    shown = wrong(angle, off_centre(rng, 2.0, 2.0)) if trouble == "encoder off centre" else angle
    return Rig(
        place,
        read(shown, duration_s),
        nominal,
        "auto",
        duration_s,
        needs=needs,
        inverse_depth=inverse_depth,
        **common(rng),
    )


OPTICS: dict[str, Callable[[np.random.Generator, str], Rig]] = {
    "wedge": wedge,
    "pair": pair,
    "mirror": mirror,
    "vibration": vibration,
    "plate": plate,
}

DRAWN = {
    "wedge": (
        "none",
        "encoder off centre",
        "wobble",
        "cylinder",
        "noise events",
        "time stamps of 1 ms",
        "OFF events late",
        "slow pixels",
        "lost counts",
        "index pulses that jitter",
        "hunting between index pulses",
        "no encoder, unsteady speed",
    ),
    "pair": ("none", "one encoder off centre", "both encoders off centre", "encoders swapped"),
    "mirror": ("none", "cubic error of the command", "quadratic error of the command"),
    "vibration": ("none", "second harmonic", "third harmonic", "unsteady amplitude"),
    "plate": ("none", "faces not parallel", "another thickness"),
}
"""Troubles from which those of an optic are drawn in turn."""

FRESH = (
    ("wedge", "third harmonic of the encoder"),
    ("wedge", "encoder's clock drifts"),
    ("wedge", "encoder of 64 counts"),
    ("wedge", "speed changes by 10 % halfway"),
    ("wedge", "lamp dims by 30 %"),
    ("wedge", "lamp at 100 Hz"),
    ("wedge", "another glass"),
    ("wedge", "lens that was not given"),
    ("wedge", "encoder silent for 30 ms"),
    ("wedge", "faint scene in noise"),
    ("pair", "second encoder 1 ms late"),
    ("pair", "third harmonic of the second encoder"),
    ("pair", "axes 1 deg apart"),
    ("mirror", "tilts late by 0.3 and 0.8 ms"),
    ("mirror", "axes that leak 3 %"),
    ("vibration", "roll of 0.2 deg"),
    ("vibration", "frequency drifts by 1 %"),
    ("vibration", "another vibration of 0.1 px"),
    ("plate", "another glass"),
    ("plate", "encoder off centre"),
)
"""Optic and trouble of the recordings that no code was chosen with."""


def record(rig: Rig, rng: np.random.Generator, kept: Path | None) -> Recording:
    """Return the recording of a rig, as a user would have it. Its events are kept in a file, if one is named."""
    if kept is not None and kept.exists():
        with np.load(kept) as columns:
            events = Events.from_arrays(*(columns[name] for name in "xytp"))
    else:
        scene = dead_leaves(*SIZE, rng, contrast=rig.contrast)
        events = events_of(scene, CAMERA, rig.place, rig.duration_s, rng, rig.pixels, rig.lamp)
        if kept is not None:
            np.savez_compressed(kept, x=events.x, y=events.y, t=events.t, p=events.p)
    return Recording(
        MemoryEvents(events, *SIZE),
        rig.camera,
        rig.encoder,
        rig.prism,
        metadata=rig.metadata,
        name="second simulator",
    )


def known_timing(rig: Rig) -> amiwarp.PhotometricSettings:
    """Return settings with the sensor's refractory period, which is on data sheets."""
    return amiwarp.PhotometricSettings(
        sensor=amiwarp.SensorTiming(refractory_us=rig.pixels.refractory_us)
    )


def errors_px(
    rig: Rig, recording: Recording, found: amiwarp.Calibration
) -> tuple[float, float, float]:
    """Return the error of a calibration [px rms], the largest one, and the error without a shift only.

    A constant lag is removed, and from the first two a constant rotation of the camera.
    """
    columns, rows = np.linspace(8, SIZE[0] - 9, 12), np.linspace(8, SIZE[1] - 9, 9)
    xy = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    times = np.linspace(0.03, 0.97, 96) * rig.duration_s
    stamps = np.rint(1e6 * times).astype(np.int64)
    first, last = recording.events.t_first, recording.events.t_last
    angles = found.encoder_for(recording.encoder, first, last).angles_at(stamps)
    theta = np.repeat(angles, len(xy), axis=0)
    everywhere = np.tile(xy, (len(times), 1))

    def true_at(lag_s: float) -> Array:
        return np.concatenate([rig.place(xy, t - lag_s) for t in times])

    if rig.inverse_depth is None:
        places = found.model.compensate_points(everywhere, theta)
    else:
        assert isinstance(found.model, amiwarp.PlateModel)
        places = found.model.compensate_at(everywhere, theta, rig.inverse_depth(true_at(0.0)))

    by_rotation = rotation_slopes(everywhere)

    def apart(lag_s: float) -> Array:
        return np.asarray(places - true_at(lag_s))

    def away(lag_s: float) -> Array:
        found_apart = apart(lag_s).ravel()
        rotation = np.linalg.lstsq(by_rotation, found_apart, rcond=None)[0]
        return np.asarray(
            np.linalg.norm((found_apart - by_rotation @ rotation).reshape(-1, 2), axis=1)
        )

    def rms(lag_s: float) -> float:
        return float(np.sqrt(np.mean(away(lag_s) ** 2)))

    # No event tells when an unmeasured vibration began: its lag may be any.
    lags = np.linspace(-2e-3, 2e-3, 41)
    start = min(lags, key=rms)
    best = minimize_scalar(
        rms, bounds=(start - 2e-4, start + 2e-4), method="bounded", options={"xatol": 1e-8}
    )
    lag_s = float(best.x)
    shifted = apart(lag_s) - apart(lag_s).mean(axis=0)
    return rms(lag_s), float(away(lag_s).max()), float(np.sqrt(np.mean(np.sum(shifted**2, axis=1))))


def rotation_slopes(xy: Array) -> Array:
    """Return how pixels, shape (n, 2), move by a rotation of the camera about x, y and z [px/rad], shape (2 n, 3)."""
    a, b = ((xy - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]).T
    about_x = np.stack([a * b, 1.0 + b**2], axis=1)
    about_y = np.stack([1.0 + a**2, a * b], axis=1)
    about_z = np.stack([-b, a], axis=1)
    return np.stack([CAMERA.fx * each.ravel() for each in (about_x, about_y, about_z)], axis=1)


def stated_px(found: amiwarp.Calibration) -> float:
    """Return the standard deviation that is stated of the motion [px rms].

    Where the stage states none, it is what the parameters' standard deviations amount to, each for itself.
    """
    if found.photometric is not None and found.photometric.deviation_px is not None:
        return found.photometric.deviation_px
    total = 0.0
    for name, std in found.uncertainty.items():
        changed = {**found.parameters, name: found.parameters[name] + std}
        try:
            moved = replace(found, parameters=changed).model
            total += amiwarp.predicted_error(moved, found.model, remove_lag=True, grid=8).rms ** 2
        except amiwarp.AmiwarpError:
            continue
    return math.sqrt(total)


def hidden_px(found: amiwarp.Calibration) -> dict[str, float]:
    """Return the stated bounds of what could hide [px rms], by cause."""
    return {} if found.photometric is None else dict(found.photometric.hidden_px)


def total_px(stated: float, hidden: dict[str, float]) -> float:
    """Return one figure for a stated error [px rms]: the deviation, and the largest bound of what could hide."""
    return math.hypot(stated, max(hidden.values(), default=0.0))


def measure(
    optic: str, trouble: str, seed: int, folder: Path | None = None, device: str = "cpu"
) -> dict[str, Any]:
    """Return the row of a recording. ``folder`` keeps its events."""
    rng = np.random.default_rng([seed, [*OPTICS].index(optic)])
    rig = OPTICS[optic](rng, trouble)
    row: dict[str, Any] = {"optic": optic, "trouble": trouble, "seed": seed}
    began = time.perf_counter()
    kept = None if folder is None else folder / f"{optic}_{trouble.replace(' ', '_')}_{seed}.npz"
    recording = record(rig, rng, kept)
    row["events"] = len(recording.events)
    row["simulated_in_s"] = time.perf_counter() - began
    photometric = known_timing(rig)
    began = time.perf_counter()
    try:
        found = amiwarp.calibrate(
            recording, model=rig.model, photometric=photometric, device=device
        )
    except amiwarp.AmiwarpError as refusal:
        said = [str(refusal)]
        row |= {"refused": True, "error_px": None}
    else:
        said = [*found.warnings]
        if found.photometric is not None and not found.photometric.accepted:
            said.append(found.photometric.verdict)
        error, largest, shift_removed = errors_px(rig, recording, found)
        accepted = found.photometric is None or found.photometric.accepted
        row |= {
            "refused": not accepted,
            "error_px": error,
            "largest_px": largest,
            "shift_removed_px": shift_removed,
            "model": found.model_name,
            "cost": None if found.photometric is None else found.photometric.cost,
            "stated_px": stated_px(found),
            "hidden_px": hidden_px(found),
        }
        row["total_px"] = total_px(row["stated_px"], row["hidden_px"])
    row["seconds"] = time.perf_counter() - began
    row["named"] = is_named(row["error_px"], said, row.get("hidden_px", {}), rig.needs)
    row["said"] = said
    return row


def is_named(
    error_px: float | None,
    said: list[str],
    hidden_px: dict[str, float],
    needs: tuple[str, ...],
) -> bool:
    """Return whether the cause of a trouble is said, or stated to hide at least the error [px rms], if there is one."""
    hiding = [] if error_px is None else could_hide(hidden_px, error_px)
    return has_word([*said, *hiding], needs)


def drawn(seeds: range, optics: list[str]) -> list[tuple[str, str, int]]:
    """Return the calls of the drawn recordings."""
    return [
        (optic, DRAWN[optic][seed % len(DRAWN[optic])], seed) for optic in optics for seed in seeds
    ]


def fresh(seeds: range, optics: list[str]) -> list[tuple[str, str, int]]:
    """Return the calls of the troubles that no code was chosen with."""
    return [(optic, trouble, seed) for optic, trouble in FRESH if optic in optics for seed in seeds]


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how well the stated errors of the answered recordings tell good from bad.

    ``silent`` counts errors over 0.02 px whose cause is not named; ``unstated`` those of them that are also larger than
    three stated deviations and than the total of deviation and bound.
    """
    from scipy.stats import spearmanr

    answered = [row for row in rows if not row["refused"]]
    error = np.array([row["error_px"] for row in answered])
    stated = np.array([row["stated_px"] for row in answered])
    total = np.array([row["total_px"] for row in answered])
    silent = (error > 0.02) & ~np.array([row["named"] for row in answered], bool)
    return {
        "recordings": len(rows),
        "answered": len(answered),
        "within_0.02_px": int(np.count_nonzero(error <= 0.02)),
        "median_error_px": float(np.median(error)),
        "median_stated_px": float(np.median(stated)),
        "within_1_2_3_deviations": [float(np.mean(error <= k * stated)) for k in (1, 2, 3)],
        "rank_correlation": float(spearmanr(error, stated).statistic),
        "rank_correlation_total": float(spearmanr(error, total).statistic),
        "within_total": float(np.mean(error <= total)),
        "silent": int(np.count_nonzero(silent)),
        "unstated": int(np.count_nonzero(silent & (error > 3.0 * stated) & (error > total))),
    }


def main() -> None:
    """Measure all recordings and write their rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["drawn", "fresh"])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--seeds", type=int, help="recordings of each optic (12), or of each fresh trouble (1)"
    )
    parser.add_argument(
        "--first-seed", type=int, help="seed of the first one (0, or 1000 for fresh troubles)"
    )
    parser.add_argument("--only", nargs="+", choices=[*OPTICS], default=[*OPTICS])
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--events", type=Path, help="folder that keeps the simulated events")
    options = parser.parse_args()
    if options.events is not None:
        options.events.mkdir(parents=True, exist_ok=True)
    calls_of, count, first = (drawn, 12, 0) if options.what == "drawn" else (fresh, 1, 1000)
    if options.first_seed is not None:
        first = options.first_seed
    calls = calls_of(range(first, first + (options.seeds or count)), options.only)
    rows = rows_of(
        measure, [(*call, options.events, options.device) for call in calls], options.processes
    )
    report = {"protocol": __doc__, "summary": summary(rows), "rows": rows}
    print(json.dumps(report["summary"], indent=1))
    options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
