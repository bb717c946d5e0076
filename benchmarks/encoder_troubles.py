"""Troubles of encoders: recordings with one trouble each, and the error of the calibration that is found for them.

    python -m benchmarks.encoder_troubles [--only NAME …] [--size 320x240]

Each recording is simulated (720 rpm, apex 1 degree, field of view 60 degrees, textured picture), calibrated with the
default settings, and its compensation compared with the truth over the image and the whole recording. A constant lag,
the sensor's delay, does not count. A row has the error [px rms, largest], or the refusal, and the warnings.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    EncoderModel,
    Events,
    ExactModel,
    MemoryEvents,
    Prism,
    PrismMotion,
    Recording,
    RisleyModel,
    Scene,
    SensorModel,
    calibrate,
    simulate,
)
from amiwarp.optics.models.base import Model
from amiwarp.simulation.description import Still
from amiwarp.studies.stability.scenes import leaves

Array = NDArray[np.float64]

RPM = 720.0
PHASE = 1.0
TEXELS = 2.0
"""Points of the picture in each pixel."""
LATENCY_US = 100.0
"""Delay of the simulated sensor [us]."""
LONGEST_LAG_US = 3000.0
"""Longest constant lag that is removed from an error [us]."""
GRID = 8
"""Rows of the grid of pixels on which an error is measured."""
FRAME_US = 2000
"""Time between two pictures of one that grows [us]."""
TIMES = 400
"""Number of times at which an error is measured."""


@dataclass(frozen=True)
class Growing:
    """Picture that grows about its middle, as if the focal length drifted."""

    light: NDArray[np.float32]
    per_s: float
    """Growth [1/s]."""
    duration_us: int

    @property
    def size(self) -> tuple[int, int]:
        return self.light.shape[1], self.light.shape[0]

    @property
    def interval_us(self) -> float | None:
        return FRAME_US

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        from scipy.ndimage import affine_transform

        middle = (np.array(self.light.shape) - 1.0) / 2.0
        for t in range(0, self.duration_us + 2 * FRAME_US, FRAME_US):
            shrink = 1.0 / (1.0 + self.per_s * 1e-6 * t)
            grown = affine_transform(
                self.light, np.eye(2) * shrink, middle * (1.0 - shrink), order=3, mode="nearest"
            )
            yield t, np.clip(grown, 0.01, 1.0).astype(np.float32)


@dataclass(frozen=True)
class Trouble:
    """A recording with a trouble, and its truth."""

    recording: Recording
    model: Model
    """Model with the true parameters."""
    motion: PrismMotion
    """True motion of the prism."""


def compensation_error(trouble: Trouble, found: Calibration) -> tuple[float, float]:
    """Return the error of compensation over the image and the recording, constant lag removed [px rms, largest]."""
    from scipy.optimize import minimize_scalar

    source, camera = trouble.recording.events, trouble.model.camera
    spare = round(LONGEST_LAG_US) + 1
    encoder = found.encoder_for(trouble.recording.encoder, source.t_first, source.t_last)
    rng = np.random.default_rng(0)
    # a burst at the start has no place in the truth
    begin, end = (int(source.slice(k, k + 1).t[0]) for k in (len(source) // 40, len(source) - 1))
    t = np.sort(rng.integers(begin + spare, end - spare, TIMES))
    columns = round(GRID * camera.width / camera.height)
    x, y = np.meshgrid(
        np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, GRID)
    )
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    pixels = np.tile(xy, (len(t), 1))
    times = np.repeat(t, len(xy))
    true = trouble.model.compensate_points(pixels, trouble.motion.angles(times))

    def distance(lag_us: float) -> Array:
        each = encoder.angles_at(np.rint(t + lag_us).astype(np.int64))
        at = found.model.compensate_points(pixels, np.repeat(each, len(xy), axis=0))
        away = np.linalg.norm(at - true, axis=1)
        return np.asarray(away[np.isfinite(away)], np.float64)

    def rms(lag_us: float) -> float:
        return float(np.sqrt(np.mean(distance(lag_us) ** 2)))

    start = min(np.linspace(-0.9, 0.9, 19) * LONGEST_LAG_US, key=rms)
    best = minimize_scalar(
        rms, bounds=(start - 300.0, start + 300.0), method="bounded", options={"xatol": 0.5}
    )
    return rms(float(best.x)), float(distance(float(best.x)).max())


def picture(width: int, height: int, *, gravel: bool = False) -> NDArray[np.float32]:
    """Return a textured picture: discs of all sizes, or small stones only."""
    rng = np.random.default_rng([7, int(gravel)])
    if not gravel:
        return leaves(rng, width, height)
    from scipy.ndimage import gaussian_filter

    rough = gaussian_filter(rng.normal(size=(height, width)), 1.0)
    return np.asarray(np.clip(0.55 + 0.18 * rough / rough.std(), 0.2, 1.0), np.float32)


def recorded(
    size: tuple[int, int],
    motion: PrismMotion,
    *,
    apex_deg: float = 1.0,
    second_deg: float = 0.0,
    seconds: float = 1.0,
    gravel: bool = False,
    growth: float = 0.0,
    encoder: EncoderModel | None = None,
    sensor: SensorModel | None = None,
    seed: int = 1,
) -> Trouble:
    """Return a recording of a picture without a trouble of the encoder; the picture grows by ``growth`` [1/s]."""
    camera = Camera.from_fov(*size, math.radians(60.0))
    prism = Prism(math.radians(apex_deg))
    if second_deg:
        prism = replace(prism, second=Prism(math.radians(second_deg)))
    turned = 2.2 * (prism.deflection + (prism.second.deflection if prism.second else 0.0))
    half = math.radians(30.0) + turned
    focal = TEXELS * camera.fx
    width = 2 * math.ceil(focal * math.tan(half)) + 2
    height = math.ceil(width * camera.height / camera.width) + 2 * math.ceil(focal * turned)
    light = picture(width, height, gravel=gravel)
    frames = Growing(light, growth, math.ceil(1e6 * seconds)) if growth else Still(light)
    recording = simulate(
        Scene(frames, 2.0 * math.atan(width / 2.0 / focal)),
        camera,
        prism,
        duration_s=seconds,
        motion=motion,
        encoder=encoder or EncoderModel(counts_per_turn=4096),
        sensor=sensor,
        seed=seed,
    )
    if prism.second is None:
        model: Model = ExactModel(camera, prism, motion.phase)
    else:
        assert motion.second is not None
        model = RisleyModel(camera, prism, motion.phase, motion.second.phase)
    return Trouble(recording, model, motion)


def steady() -> PrismMotion:
    """Return the motion at a constant speed."""
    return PrismMotion(RPM, PHASE)


def hunting(share: float, hz: float, seconds: float = 1.0) -> PrismMotion:
    """Return a motion whose speed swings by a ``share`` of it at a frequency [Hz]."""
    return PrismMotion.from_function(
        lambda t: RPM * (1.0 + share * np.sin(math.tau * hz * t + 0.7)), seconds + 1.0, phase=PHASE
    )


def turns_of(motion: PrismMotion, first_us: int, last_us: int) -> NDArray[np.int64]:
    """Return the times between two times at which the angle is a whole number of turns [us]."""
    t = np.arange(first_us, last_us + 1, 50, dtype=np.float64)
    angle = motion.angle(t)
    turned = angle * math.copysign(1.0, float(angle[-1] - angle[0]))
    turns = np.arange(
        math.ceil(float(turned[0]) / math.tau), math.floor(float(turned[-1]) / math.tau) + 1
    )
    return np.rint(np.interp(turns * math.tau, turned, t)).astype(np.int64)


def pulses_only(trouble: Trouble, jitter_us: float = 0.0) -> Trouble:
    """Return the recording with one pulse per turn as its encoder, whose times have a standard deviation [us]."""
    last = trouble.recording.events.t_last
    spare = round(1.6 * 60e6 / RPM)
    t = turns_of(trouble.motion, -spare, last + spare)
    turns = np.rint(trouble.motion.angle(t) / math.tau)
    t = t + np.rint(np.random.default_rng(3).normal(0.0, jitter_us, len(t))).astype(np.int64)
    return replace(
        trouble, recording=replace(trouble.recording, encoder=Encoder(t, turns * math.tau))
    )


def losing(
    trouble: Trouble, counts: int, at_us: int, *, index: bool, within_us: int = 0
) -> Trouble:
    """Return the recording whose encoder loses counts of 4096 at a time, or evenly ``within_us`` from then on."""
    encoder = trouble.recording.encoder
    assert encoder is not None
    lost = np.clip((encoder.t - at_us) / max(within_us, 1), 0.0, 1.0)
    lost = np.rint(counts * lost) * (math.tau / 4096)
    given = Encoder(encoder.t, encoder.angle - lost)
    if index:
        pulses = turns_of(trouble.motion, int(encoder.t[0]), int(encoder.t[-1]))
        given = given.with_index(pulses)
    return replace(trouble, recording=replace(trouble.recording, encoder=given))


def with_burst(trouble: Trouble, count: int, stamps: int = 1, before_us: int = 0) -> Trouble:
    """Return the recording without its encoder, and with a burst of events at its first time stamps."""
    source = trouble.recording.events
    events = source.slice(0, len(source))
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, source.size, (count, 2)).T
    t = events.t[0] - before_us + np.sort(rng.integers(0, stamps, count))
    burst = Events.from_arrays(x, y, t, np.ones(count))
    merged = Events.concatenate([burst, events])
    order = np.argsort(merged.t, kind="stable")
    merged = MemoryEvents(merged[order], *source.size)
    return replace(
        trouble, recording=replace(trouble.recording, events=merged, encoder=None, truth=None)
    )


def noisy(share: float, size: tuple[int, int], **given: Any) -> Trouble:
    """Return a recording of which a share of the events is noise."""
    clean = recorded(size, steady(), **given).recording.events
    seconds = 1e-6 * (clean.t_last - clean.t_first)
    hz = len(clean) * share / (1.0 - share) / (size[0] * size[1] * seconds)
    return recorded(size, steady(), sensor=SensorModel(shot_noise_hz=hz), **given)


def pair(size: tuple[int, int], *, swapped: bool) -> Trouble:
    """Return a recording of a pair of prisms, perhaps with the encoder of each taken for that of the other."""
    motion = PrismMotion(RPM, 0.4, second=PrismMotion(-500.0, -1.3))
    made = recorded(size, motion, second_deg=0.8)
    encoder = made.recording.encoder
    assert encoder is not None
    assert encoder.second is not None
    if swapped:
        encoder = encoder.second.with_second(replace(encoder, second=None))
    return replace(made, recording=replace(made.recording, encoder=encoder))


ROWS: dict[str, Callable[[tuple[int, int]], Trouble]] = {
    "no trouble": lambda size: recorded(size, steady()),
    "loses 100 of 4096 counts, index": lambda size: losing(
        recorded(size, steady()), 100, 437_300, index=True
    ),
    "loses 100 of 4096 counts, no index": lambda size: losing(
        recorded(size, steady()), 100, 437_300, index=False
    ),
    "loses 100 counts within 40 ms, index": lambda size: losing(
        recorded(size, steady()), 100, 437_300, index=True, within_us=40_000
    ),
    "loses 100 counts within 40 ms, no index": lambda size: losing(
        recorded(size, steady()), 100, 437_300, index=False, within_us=40_000
    ),
    "varying speed, burst": lambda size: with_burst(recorded(size, hunting(0.3, 0.7)), 6139),
    "varying speed, burst over 20 us": lambda size: with_burst(
        recorded(size, hunting(0.3, 0.7)), 6139, stamps=20
    ),
    "varying speed, burst 50 ms before": lambda size: with_burst(
        recorded(size, hunting(0.3, 0.7)), 6139, before_us=50_000
    ),
    "index only": lambda size: pulses_only(recorded(size, steady())),
    "index only, jitter 0.2 ms": lambda size: pulses_only(recorded(size, steady()), 200.0),
    "index only, hunts 3 % at 17 Hz": lambda size: pulses_only(recorded(size, hunting(0.03, 17.0))),
    "index only, hunts 5 % at 3 Hz": lambda size: pulses_only(recorded(size, hunting(0.05, 3.0))),
    "pair": lambda size: pair(size, swapped=False),
    "pair, encoders swapped": lambda size: pair(size, swapped=True),
    "focal length drifts by 2 %": lambda size: recorded(size, steady(), growth=0.02),
    "gravel, 2 deg, 35 % noise": lambda size: noisy(0.35, size, apex_deg=2.0, gravel=True),
}
"""Maker of each recording by name."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", nargs="+", default=[*ROWS], choices=[*ROWS], help="names of the rows"
    )
    parser.add_argument(
        "--size", default="320x240", help="size of the image [px] (default: 320x240)"
    )
    args = parser.parse_args()
    width, height = (int(side) for side in args.size.split("x"))
    for name in args.only:
        trouble = ROWS[name]((width, height))
        began = time.perf_counter()
        try:
            found = calibrate(trouble.recording)
        except AmiwarpError as error:
            print(f"{name}: refused after {time.perf_counter() - began:.1f} s: {error}", flush=True)
            continue
        taken = time.perf_counter() - began
        rms, largest = compensation_error(trouble, found)
        events = len(trouble.recording.events)
        print(f"{name}: {rms:.4f} px ({largest:.3f}), {events:,} events, {taken:.1f} s", flush=True)
        for warning in found.warnings:
            print(f"    {warning}", flush=True)


if __name__ == "__main__":
    main()
