"""The simulator against analytic results, an independent float64 simulation, and its documented properties."""

import itertools
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraMotion,
    EncoderModel,
    Events,
    ExactModel,
    FlatSide,
    Prism,
    PrismMotion,
    RadialTangential,
    Recording,
    Scene,
    SensorModel,
    Simulation,
    simulate,
    truth_model,
)
from amiwarp.kernels import launch as launching
from amiwarp.kernels import pixels as kernels
from amiwarp.simulation import DARK, linear_luminance, read_picture
from amiwarp.simulation.engine import LATEST_US, Engine
from amiwarp.simulation.image_motion import step_us
from amiwarp.simulation.picture_placement import Placement, log_map, place_picture

CAMERA = Camera.from_fov(64, 48, math.radians(50.0))
PRISM = Prism(math.radians(3.0), 1.55)
SLOPE = 4.0  # log intensity per unit of the picture plane
FOV = math.radians(100.0)  # field of view of the pictures below
WIDE = Prism(0.0, 1.55)  # no deflection at all


def ramp(width: int = 1200, height: int = 20) -> Scene:
    """A scene with log intensity SLOPE * x on the picture plane, x = tan(angle from the axis)."""
    half = math.tan(FOV / 2.0)
    x = (np.arange(width) + 0.5) / width * 2.0 * half - half
    light = np.exp(SLOPE * (x + half)) * 0.5 - DARK  # DARK is added before the logarithm
    return Scene.from_picture(np.tile(light, (height, 1)).astype(np.float32), fov=FOV, blur=0.0)


def texture(seed: int = 1) -> NDArray[np.float32]:
    """A picture of blocks of random brightness."""
    return np.kron(
        np.random.default_rng(seed).uniform(0.05, 1.0, (24, 32)), np.ones((4, 4))
    ).astype(np.float32)


def flat() -> NDArray[np.float32]:
    return np.full((8, 8), 0.5, np.float32)


def everything(recording: Recording) -> tuple[Events, NDArray[np.float32]]:
    n = len(recording.events)
    points = None if recording.truth is None else recording.truth.points(0, n)
    assert points is not None
    return recording.events.slice(0, n), points


def same(a: Recording, b: Recording) -> bool:
    (ea, pa), (eb, pb) = everything(a), everything(b)
    pairs = [(ea.x, eb.x), (ea.y, eb.y), (ea.t, eb.t), (ea.p, eb.p), (pa, pb)]
    return len(ea) == len(eb) and all(
        np.array_equal(u, v, equal_nan=u.dtype.kind == "f") for u, v in pairs
    )


def base(**changes: object) -> Simulation:
    return replace(
        Simulation(Scene.from_picture(texture()), CAMERA, PRISM, 0.06, seed=3), **changes
    )


# -- times and numbers of events


def test_turning_camera_crosses_a_ramp_at_analytic_times(device: str) -> None:
    """With a log ramp and constant yaw, a pixel sees SLOPE * tan(a + w t) and fires at each change by the threshold."""
    rate, contrast, duration = 1.0, 0.2, 0.1
    recording = simulate(ramp(), CAMERA, WIDE, duration_s=duration, motion=0.0, device=device,
                         camera_motion=CameraMotion((0.0, rate, 0.0)), sensor=SensorModel.ideal(contrast))  # fmt: skip
    events, points = everything(recording)
    assert events.p.min() == 1
    # Px; no shift without a prism
    assert np.allclose(points, np.stack([events.x, events.y], 1), rtol=0, atol=1e-3)
    for column in (0, 17, 40, 63):
        angle = math.atan((column - CAMERA.cx) / CAMERA.fx)
        row = 24  # row nearest to the axis
        total = SLOPE * (math.tan(angle + rate * duration) - math.tan(angle))
        levels = np.arange(1, int(total / contrast) + 1) * contrast
        expected = (np.arctan(math.tan(angle) + levels / SLOPE) - angle) / rate * 1e6
        found = events.t[(events.x == column) & (events.y == row)]
        assert abs(len(found) - len(expected)) <= (abs(total / contrast % 1.0 - 0.5) > 0.45)
        n = min(len(found), len(expected))
        # Us; 0.1 px at this speed is 1.7 ms
        np.testing.assert_allclose(found[:n], expected[:n], rtol=0, atol=10.0)


@pytest.mark.parametrize(
    "uneven", [{}, {"cylinder": (0.03, -0.02), "wobble": (0.1, 0.05)}], ids=["even", "uneven"]
)
@pytest.mark.parametrize("flat_side", list(FlatSide))
def test_prism_events_match_an_independent_walk(
    device: str, flat_side: FlatSide, uneven: Any
) -> None:
    """Reference: pixel by pixel, in float64 and steps of 10 us, through the exact model of amiwarp.optics."""
    prism = replace(PRISM, flat_side=flat_side)
    motion = PrismMotion(-900.0, phase=0.7, tilt=(0.02, -0.01), **uneven)
    recording = simulate(
        ramp(),
        CAMERA,
        prism,
        duration_s=0.05,
        motion=motion,
        sensor=SensorModel.ideal(0.03),
        device=device,
    )
    events, _ = everything(recording)
    t = np.arange(0.0, 50000.0, 10.0)
    theta = -900.0 / 60.0 * 2.0 * math.pi * t * 1e-6
    model = ExactModel(CAMERA, prism, 0.7, (0.02, -0.01), **uneven)
    for pixel in ((3, 5), (32, 24), (60, 40)):
        x = model.compensate_points(np.tile(np.array(pixel, np.float64), (len(t), 1)), theta)[:, 0]
        expected = walk(t, SLOPE * (x - CAMERA.cx) / CAMERA.fx, 0.03)
        chosen = (events.x == pixel[0]) & (events.y == pixel[1])
        assert len(expected) > 5
        assert events.p[chosen].tolist() == [p for _, p in expected]
        # Us; the simulator's step is 1.3 ms
        np.testing.assert_allclose(events.t[chosen], [t for t, _ in expected], rtol=0, atol=60.0)


def walk(
    t: NDArray[np.float64], level: NDArray[np.float64], contrast: float
) -> list[tuple[float, int]]:
    reference, found = level[0], []
    for time, value in zip(t, level, strict=True):
        if value >= reference + contrast:
            reference += contrast
            found.append((time, 1))
        elif value <= reference - contrast:
            reference -= contrast
            found.append((time, 0))
    return found


def test_nothing_moves_far_or_along_a_bend_in_a_step(device: str) -> None:
    rates = np.array([0.3, -0.5, 1.0])
    lens = replace(CAMERA, distortion=RadialTangential(-0.2, 0.05))
    for camera in (CAMERA, lens):
        simulation = base(
            camera=camera,
            motion=PrismMotion(1500.0),
            camera_motion=CameraMotion(rates),
            device=device,
        )
        step = step_us(simulation) * 1e-6
        t = np.arange(200) * step
        xy = np.random.default_rng(0).integers(0, (64, 48), (200, 2)).astype(np.float64)
        xy[:4] = [[0, 0], [63, 0], [0, 47], [63, 47]]
        model = ExactModel(camera, PRISM)
        moved, bent = [], []
        for start, end in itertools.pairwise(t):
            before, between, after = (
                model.compensate_points(xy, np.full(200, 1500.0 / 60.0 * 2.0 * math.pi * at))
                for at in (start, 0.5 * (start + end), end)
            )
            bent.append(np.linalg.norm(between - 0.5 * (before + after), axis=1))
            turned = camera.pixels_to_rays(after) @ Rotation.from_rotvec(rates * step).as_matrix().T
            moved.append(np.linalg.norm(camera.rays_to_pixels(turned) - before, axis=1))
        assert np.nanmax(moved) <= 0.5  # px
        assert np.nanmax(bent) <= 0.0021  # px
        # Steps are not shorter than necessary
        assert np.nanmax(moved) > 0.3 or np.nanmax(bent) > 0.0015


# -- reproducibility


def test_same_seed_same_events_other_seed_others(device: str) -> None:
    first = base(device=device).run()
    assert len(first.events) > 1000
    assert same(first, base(device=device).run())
    assert not same(first, base(device=device, seed=4).run())


@pytest.mark.parametrize("chunk_us", [3000, 17001])
def test_chunks_do_not_matter(device: str, chunk_us: int) -> None:
    simulation = base(device=device)
    whole = everything(simulation.run())
    parts = list(simulation.blocks(chunk_us=chunk_us))
    assert len(parts) > 3
    events = Events.concatenate([e for e, _ in parts])
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(events, name), getattr(whole[0], name))
    np.testing.assert_array_equal(np.concatenate([p for _, p in parts]), whole[1])


def test_a_chunk_of_minutes_keeps_the_scene_points() -> None:
    simulation = base(camera=Camera.from_fov(4, 3, 1.0), motion=PrismMotion(3.0), duration_s=140.0)
    whole = everything(simulation.run())
    parts = list(simulation.blocks(chunk_us=140_000_000))
    assert whole[0].t[-1] > 2**31 / 16  # us; ticks are 32-bit integers
    np.testing.assert_array_equal(np.concatenate([e.t for e, _ in parts]), whole[0].t)
    np.testing.assert_array_equal(np.concatenate([p for _, p in parts]), whole[1])


def test_the_times_of_a_long_chunk_of_many_pixels_fit_into_their_keys(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("amiwarp.simulation.key_buffer.EVENTS_PER_PIXEL", 1)  # saves memory
    engine = Engine(base(camera=Camera.from_fov(1280, 720, 1.0)), 3_000_000)
    # Us; 22 + 20 bits are below the time
    assert 2_000_000 <= engine._chunk_steps * engine._step <= 2**21 - LATEST_US


@pytest.mark.usefixtures("every_core")
def test_threads_and_room_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    many = base().run()
    monkeypatch.setattr("amiwarp.simulation.key_buffer.CPU_RUN", 100)
    # Too small, so the run is repeated
    monkeypatch.setattr("amiwarp.simulation.key_buffer.EVENTS_PER_PIXEL", 1)
    monkeypatch.setattr(launching, "cpu_threads", lambda: 1)
    monkeypatch.setattr("amiwarp.kernels.program.cpu_threads", lambda: 1)
    assert same(many, base().run())


@pytest.mark.parametrize("flat_side", list(FlatSide))
def test_looking_ahead_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, flat_side: FlatSide
) -> None:
    """The faster algorithm on CPUs gives the same events as the plain one, also outside the picture and in films."""
    simulation = base(
        scene=Scene(Film(texture(1), texture(2)), fov=math.radians(30.0)),
        prism=replace(PRISM, flat_side=flat_side),
        camera_motion=CameraMotion((0.3, 0.2, -0.4)),
        motion=PrismMotion(-720.0, tilt=(0.02, 0.01)),
        sensor=SensorModel(contrast_on=0.1, contrast_off=0.1, shot_noise_hz=30.0, leak_hz=5.0),
    )
    fast = simulation.run()
    assert len(fast.events) > 20000
    monkeypatch.setattr(kernels, "run_pixels_ahead", kernels.run_pixels)
    assert same(fast, simulation.run())


class Film:
    """Two pictures that alternate every 25 ms."""

    interval_us = 25_000.0

    def __init__(self, *pictures: NDArray[np.float32]) -> None:
        self._pictures = pictures
        self.size = (pictures[0].shape[1], pictures[0].shape[0])

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        for i in range(4):
            yield 25_000 * i, self._pictures[i % 2]


def test_progress_rises_to_one() -> None:
    seen: list[float] = []
    base(duration_s=0.25).run(progress=lambda _, share: seen.append(share))
    assert len(seen) > 1
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


# -- imperfections of pixels


def quiet_sensor(**changes: float) -> SensorModel:
    return replace(SensorModel.ideal(), **changes)


def still(sensor: SensorModel, duration: float, device: str) -> Events:
    """Return events of a uniform picture, which are noise only."""
    return everything(
        simulate(flat(), CAMERA, PRISM, duration_s=duration, sensor=sensor, device=device)
    )[0]


def test_an_ideal_sensor_is_silent_before_a_flat_picture(device: str) -> None:
    assert len(still(SensorModel.ideal(), 0.1, device)) == 0


def test_shot_noise_is_poisson_at_its_rate_and_of_both_signs(device: str) -> None:
    events = still(quiet_sensor(shot_noise_hz=20.0), 0.5, device)
    mean = 20.0 * 0.5 * 64 * 48
    assert abs(len(events) - mean) < 5.0 * math.sqrt(mean)
    assert abs(events.p.mean() - 0.5) < 5.0 * 0.5 / math.sqrt(mean)
    counts = np.bincount(events.y.astype(int) * 64 + events.x, minlength=64 * 48)
    # standard deviation of the variance of n Poisson counts of mean m: about m sqrt(2 / n)
    assert abs(counts.var() - 10.0) < 5.0 * 10.0 * math.sqrt(2.0 / (64 * 48)) * 1.1


def test_leak_gives_on_events_at_its_rate_from_the_start(device: str) -> None:
    events = still(quiet_sensor(leak_hz=5.0), 0.5, device)
    assert events.p.min() == 1
    pixels = 64 * 48
    # evenly spaced with a random start: half of the pixels have 2 events, half have 3
    assert abs(len(events) - 2.5 * pixels) < 5.0 * 0.5 * math.sqrt(pixels)
    early = np.count_nonzero(events.t < 100_000)
    assert abs(early - 0.5 * pixels) < 5.0 * 0.5 * math.sqrt(pixels)


def test_hot_pixels_are_few_and_loud(device: str) -> None:
    events = still(quiet_sensor(hot_fraction=0.02, hot_hz=200.0), 0.2, device)
    counts = np.bincount(events.y.astype(int) * 64 + events.x, minlength=64 * 48)
    hot = counts[counts > 0]
    assert abs(len(hot) - 0.02 * 64 * 48) < 5.0 * math.sqrt(0.02 * 64 * 48)
    assert abs(hot.mean() - 40.0) < 5.0 * math.sqrt(40.0 / len(hot))


def test_mismatch_spreads_the_thresholds(device: str) -> None:
    """On a log ramp, intervals between events are proportional to the pixel's threshold."""
    sensor = quiet_sensor(contrast_on=0.05, mismatch=0.1)
    recording = simulate(ramp(), CAMERA, WIDE, duration_s=0.2, motion=0.0, sensor=sensor, device=device,
                         camera_motion=CameraMotion((0.0, 1.0, 0.0)))  # fmt: skip
    events, _ = everything(recording)
    row = (events.y >= 20) & (events.y < 28)
    pixel = events.y[row].astype(int) * 64 + events.x[row]
    count = np.bincount(pixel)
    first, last = np.full(len(count), 1 << 60), np.zeros(len(count))
    np.minimum.at(first, pixel, events.t[row])
    np.maximum.at(last, pixel, events.t[row])
    used = np.flatnonzero(count > 3)
    angle = np.arctan((used % 64 - CAMERA.cx) / CAMERA.fx)
    swept = np.tan(angle + last[used] * 1e-6) - np.tan(angle + first[used] * 1e-6)
    threshold = SLOPE * swept / (count[used] - 1)
    assert len(used) > 400
    assert abs(threshold.mean() - 0.05) < 5.0 * 0.005 / math.sqrt(len(used)) + 5e-4
    assert abs(threshold.std() / threshold.mean() - 0.1) < 5.0 * 0.1 / math.sqrt(2.0 * len(used))


def test_refractory_time_keeps_events_apart(device: str) -> None:
    events, _ = everything(
        base(sensor=quiet_sensor(refractory_us=700.0, shot_noise_hz=200.0), device=device).run()
    )
    pixel = events.y.astype(int) * 64 + events.x
    order = np.lexsort((events.t, pixel))
    gaps = np.diff(events.t[order])[np.diff(pixel[order]) == 0]
    assert len(gaps) > 1000
    assert gaps.min() >= 699  # us; time stamps are rounded
    free, _ = everything(base(sensor=quiet_sensor(shot_noise_hz=200.0), device=device).run())
    assert len(free) > len(events)


def test_latency_delays_every_stamp_and_jitter_spreads_them(device: str) -> None:
    prompt, points = everything(base(sensor=SensorModel.ideal(), device=device).run())
    late, late_points = everything(base(sensor=quiet_sensor(latency_us=500.0), device=device).run())
    assert len(prompt) > len(late) > 0.9 * len(prompt)
    np.testing.assert_array_equal(late.t, prompt.t[: len(late)] + 500)
    # Px; the truth refers to the crossing, not to the time stamp
    np.testing.assert_allclose(late_points, points[: len(late)], rtol=0, atol=2e-3)
    sensor = quiet_sensor(latency_us=500.0, latency_jitter_us=100.0)
    jittered, _ = everything(base(sensor=sensor, device=device).run())
    assert (np.diff(jittered.t) >= 0).all()
    delay = [
        b - a
        for key in range(0, 64 * 48, 7)
        for a, b in zip(stamps(prompt, key), stamps(jittered, key), strict=False)
    ]
    assert abs(np.mean(delay) - 500.0) < 10.0  # us
    assert 70.0 < np.std(delay) < 110.0  # us; keeping the order within a pixel lowers it slightly


def stamps(events: Events, key: int) -> list[int]:
    return events.t[(events.y.astype(int) * 64 + events.x) == key].tolist()


# -- truth


@pytest.mark.parametrize("flat_side", list(FlatSide))
def test_truth_agrees_with_the_model_and_the_encoder(device: str, flat_side: FlatSide) -> None:
    prism = replace(PRISM, flat_side=flat_side)
    uneven = {"cylinder": (0.01, -0.02), "wobble": (0.03, 0.05)}
    motion = PrismMotion([[0.0, 300.0], [0.06, 1500.0]], phase=1.1, tilt=(0.01, 0.02), **uneven)
    recording = base(prism=prism, motion=motion, sensor=SensorModel.ideal(), encoder_model=EncoderModel.ideal(),
                     device=device).run()  # fmt: skip
    events, points = everything(recording)
    assert recording.encoder is not None
    xy = np.stack([events.x, events.y], 1).astype(np.float64)
    model = ExactModel(CAMERA, prism, 1.1, (0.01, 0.02), **uneven)
    found = model.compensate_points(xy, recording.encoder.angle_at(events.t))
    assert recording.truth is not None
    assert truth_model(CAMERA, recording.truth, flat_side) == model
    assert np.sqrt(np.mean(np.sum((found - points) ** 2, axis=1))) < 0.01  # px
    assert np.linalg.norm(xy - points, axis=1).mean() > 0.5  # px: the prism moves events


def test_compensated_events_are_sharp(device: str) -> None:
    events, points = everything(
        base(device=device, motion=PrismMotion(720.0), duration_s=0.17).run()
    )

    def sharpness(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
        inside = (x > -0.5) & (x < 63.5) & (y > -0.5) & (y < 47.5)
        return float(
            np.histogram2d(y[inside], x[inside], bins=[48, 64], range=[[-0.5, 47.5], [-0.5, 63.5]])[
                0
            ].var()
        )

    raw = sharpness(events.x.astype(np.float64), events.y.astype(np.float64))
    assert sharpness(points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)) > 1.5 * raw


def test_truth_and_nominal_prism_are_told_apart() -> None:
    nominal = Prism(math.radians(2.9), 1.5168)
    encoder = EncoderModel(clock_offset_us=1234.0)
    recording = base(
        nominal_prism=nominal, encoder_model=encoder, camera_motion=CameraMotion((0.1, 0.2, 0.3))
    ).run()
    assert recording.prism == nominal
    assert recording.truth is not None
    expected = {
        "apex": PRISM.apex,
        "index": 1.55,
        "phase": 0.0,
        "clock_offset_us": 1234.0,
        "omega_y": 0.2,
    }
    assert {k: recording.truth.parameters[k] for k in expected} == pytest.approx(expected)
    assert recording.encoder is not None
    assert recording.encoder.clock_offset_us == 0.0


def test_log_view_is_the_picture_without_the_prism(device: str) -> None:
    view = Simulation(ramp(), CAMERA, PRISM, 0.05, device=device).log_view()
    x = (np.arange(64) - CAMERA.cx) / CAMERA.fx
    expected = SLOPE * (x + math.tan(FOV / 2.0)) + math.log(0.5)
    np.testing.assert_allclose(view, np.tile(expected, (48, 1)), rtol=0, atol=2e-3)  # log intensity


def test_written_recording_is_the_one_in_memory(tmp_path: Path) -> None:
    from amiwarp.io import open_recording

    simulation = base(duration_s=0.25)
    simulation.write(tmp_path / "a.h5")
    assert same(open_recording(tmp_path / "a.h5"), simulation.run())


# -- motion and encoder


@pytest.mark.parametrize("speed", [-500.0, 600, np.float32(90.0)])
def test_a_constant_speed_stands_for_a_motion(speed: Any) -> None:
    scene = Scene.from_picture(np.random.default_rng(0).random((64, 64)))
    by_speed = Simulation(scene, CAMERA, Prism(0.03), 0.01, motion=speed)
    by_motion = Simulation(scene, CAMERA, Prism(0.03), 0.01, motion=PrismMotion(speed))
    assert isinstance(by_speed.motion, PrismMotion)
    assert by_speed.prism_motion is by_speed.motion
    assert same(by_speed.run(), by_motion.run())
    assert same(by_speed.run(), simulate(scene, CAMERA, Prism(0.03), duration_s=0.01, motion=speed))
    with pytest.raises(AmiwarpError, match=r"prism speed is 'fast'.*expected numbers"):
        replace(by_speed, motion="fast")


def test_prism_angle_is_the_integral_of_the_speed() -> None:
    table = np.array([[-0.1, 100.0], [0.2, 700.0], [0.5, 700.0], [0.6, -300.0]])
    motion = PrismMotion(table)

    def speed(t: float) -> float:
        return float(np.interp(t, table[:, 0], table[:, 1])) * 2.0 * math.pi / 60.0

    for end in (-0.3, 0.1, 0.2, 0.55, 0.9):
        expected = quad(speed, 0.0, end, points=[-0.1, 0.2, 0.5, 0.6], limit=200)[0]
        assert motion.angle(end * 1e6) == pytest.approx(expected, rel=0, abs=1e-7)  # rad
    assert motion.largest_speed == pytest.approx(700.0 * 2.0 * math.pi / 60.0)
    same_speed = PrismMotion.from_function(lambda t: np.interp(t, table[:, 0], table[:, 1]), 0.6)
    assert same_speed.angle(0.6e6) == pytest.approx(motion.angle(0.6e6), rel=0, abs=1e-4)


def test_changing_camera_rates_are_integrated() -> None:
    rates = [[0.0, 0.0, 0.0, 0.0], [1.0, 2.0, -1.0, 3.0]]
    found = CameraMotion(rates).orientation(1.0)(np.array([0.0, 0.7]))
    expected = Rotation.identity()
    for k in range(70000):  # steps of 10 us, with the angular velocity at their middle
        expected = (
            expected
            if k % 10
            else expected * Rotation.from_rotvec(np.array([2, -1, 3]) * (k + 5) * 1e-5 * 1e-4)
        )
    np.testing.assert_allclose(found, [np.eye(3), expected.as_matrix()], rtol=0, atol=1e-6)
    assert not CameraMotion(rates).constant
    assert CameraMotion((0.1, 0.0, 0.0)).constant


def test_encoder_rounds_jitters_shifts_and_drops_out() -> None:
    motion = PrismMotion(720.0)
    model = EncoderModel(
        counts_per_turn=100,
        jitter_us=20.0,
        clock_offset_us=3000.0,
        dropouts_hz=10.0,
        dropout_us=9000.0,
    )
    encoder = model.sample(motion, 1_000_000, seed=5)
    counts = encoder.angle / (2.0 * math.pi / 100)
    np.testing.assert_allclose(counts, np.round(counts), rtol=0, atol=1e-6)
    assert 3 <= len(encoder.gaps(5000)) <= 20
    assert encoder.covers(0, 1_000_000)
    assert encoder.with_clock_offset(3000.0).covers(0, 1_000_000)
    t = encoder.t[1:-1]
    error = encoder.angle[1:-1] - motion.angle(t - 3000.0)
    rounding = 2.0 * math.pi / 100 / math.sqrt(12.0)
    jitter = 20e-6 * 720.0 / 60.0 * 2.0 * math.pi
    assert abs(error.mean()) < 0.1 * rounding
    assert error.std() == pytest.approx(math.hypot(rounding, jitter), rel=0.1)


def test_drop_outs_of_an_encoder_with_another_clock_are_within_the_recording() -> None:
    ideal = EncoderModel.ideal()
    model = replace(ideal, clock_offset_us=5e6, dropouts_hz=20.0, dropout_us=9000.0)
    encoder = model.sample(PrismMotion(720.0), 1_000_000, seed=5)
    gaps = np.diff(encoder.t) > 5000
    assert 5 <= gaps.sum() <= 40
    assert encoder.t[:-1][gaps].min() >= 5_000_000
    assert encoder.t[:-1][gaps].max() <= 6_000_000


def test_ideal_encoder_is_exact_and_clock_offset_is_undone() -> None:
    motion = PrismMotion(-720.0)
    t = np.arange(0, 500_000, 777)
    encoder = replace(EncoderModel.ideal(), clock_offset_us=-2500.0).sample(motion, 500_000, seed=0)
    found = encoder.with_clock_offset(-2500.0).angle_at(t)
    np.testing.assert_allclose(found, motion.angle(t), rtol=0, atol=1e-9)  # rad
    # Rad: the offset has an effect
    assert np.abs(encoder.angle_at(t) - motion.angle(t)).min() > 0.1


def test_an_eccentric_encoder_is_wrong_by_its_harmonics_only() -> None:
    motion, factors = PrismMotion(720.0), (0.02, -0.05, 0.01, 0.005)
    right = EncoderModel().sample(motion, 300_000, seed=1)
    wrong = EncoderModel(harmonics=factors).sample(motion, 300_000, seed=1)
    np.testing.assert_array_equal(wrong.t, right.t)
    theta = motion.angle(right.t)
    error = (
        0.02 * np.cos(theta)
        - 0.05 * np.sin(theta)
        + 0.01 * np.cos(2 * theta)
        + 0.005 * np.sin(2 * theta)
    )
    # Jitter, counts
    np.testing.assert_allclose(
        wrong.angle - right.angle, error, rtol=0, atol=2.0 * np.pi / 8192 + 1e-3
    )


# -- pictures


def test_luminance_is_linear_light() -> None:
    codes = np.array([[[0, 0, 0], [255, 255, 255]], [[188, 188, 188], [255, 0, 0]]], np.uint8)
    np.testing.assert_allclose(
        linear_luminance(codes), [[0.0, 1.0], [0.5029, 0.2126]], rtol=0, atol=1e-4
    )


def test_integers_of_a_picture_keep_their_values(tmp_path: Path) -> None:
    """Of 32 bits, only what 16 bits hold; of either byte order."""
    codes = np.array([[0, 65535], [30000, 12]])
    light = linear_luminance(codes.astype(np.uint16))
    np.testing.assert_array_equal(linear_luminance(codes.astype(">u2")), light)
    Image.fromarray(codes.astype(np.int32)).save(tmp_path / "wide.tif")
    np.testing.assert_array_equal(read_picture(tmp_path / "wide.tif"), light)
    Image.frombytes("I;16B", (2, 2), codes.astype(">u2").tobytes()).save(tmp_path / "big.tif")
    np.testing.assert_array_equal(read_picture(tmp_path / "big.tif"), light)
    for value in (-1, 65536):
        Image.fromarray((codes // 65535 * value).astype(np.int32)).save(tmp_path / "over.tif")
        with pytest.raises(
            AmiwarpError,
            match=rf"over\.tif has values from .*{value}.*; save it with 16 bits, 0 to",
        ):
            read_picture(tmp_path / "over.tif")


def test_a_picture_is_cut_to_the_view() -> None:
    placed = place_picture((200, 100), (-0.5, -0.5, 0.5, 0.5), 64.0)
    assert placed == Placement(64, 64, (50.0, 0.0, 150.0, 100.0), -0.5, -0.5, (64.0, 64.0))
    light = np.tile(np.linspace(0.0, 1.0, 200, dtype=np.float32), (100, 1))
    np.testing.assert_allclose(
        np.exp(log_map(light, placed, 0.0)[32, [1, 62]]) - DARK, [0.26, 0.74], rtol=0, atol=0.01
    )


# -- errors


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SensorModel(contrast_on=0.0), "contrast_on = 0"),
        (lambda: SensorModel(latency_us=-1.0), "latency_us = -1"),
        (lambda: SensorModel(mismatch=math.nan), "mismatch = nan"),
        (lambda: PrismMotion(math.inf), "prism speed"),
        (lambda: PrismMotion([[1.0, 2.0], [0.0, 2.0]]), "do not increase"),
        (lambda: CameraMotion((1.0, 2.0)), "camera rotation has shape"),
        (lambda: EncoderModel(rate_hz=0.0), "rate_hz = 0"),
        (lambda: EncoderModel(counts_per_turn=0), "counts_per_turn = 0"),
        (lambda: EncoderModel(harmonics=(0.0, 0.1)), "encoder harmonics is"),  # type: ignore[arg-type]
        (lambda: EncoderModel(harmonics=(0.0, 3.0, 0.0, 0.0)), "harmonics = 3"),
        (lambda: base(duration_s=0.0), "duration_s = 0"),
        (lambda: base(seed=-1), "seed = -1"),
        (lambda: base(camera=Camera.from_fov(4000, 4000, 1.0)), "4000x4000"),
        (lambda: Scene.from_picture(np.zeros((4, 4), np.int64)), "int64"),
        (lambda: Scene.from_picture(np.zeros(4, np.float32)), "shape"),
        (lambda: Scene.from_picture(np.full((4, 4), -1.0)), "negative"),
        (lambda: read_picture("nowhere.png"), "nowhere.png: no such file"),
        (
            lambda: base(camera_motion=CameraMotion((0.0, 30.0, 0.0))).run(),
            "turn the camera less far",
        ),
        (lambda: base(motion=PrismMotion(1e9)).run(), "slow down prism"),
        (lambda: list(base().blocks(chunk_us=0)), "chunk_us = 0 is not a whole number in 1 "),
        (lambda: list(base().blocks(chunk_us=-5)), "chunk_us = -5"),
    ],
)
def test_bad_input_is_told(make: object, message: str) -> None:
    with pytest.raises(AmiwarpError, match=message):
        make()  # type: ignore[operator]


FORKED = """
import os, signal, sys
import numpy as np
import amiwarp
camera, prism = amiwarp.Camera.from_fov(64, 48, 1.0), amiwarp.Prism(0.02)
scene = amiwarp.Scene.from_picture(np.random.default_rng(0).random((40, 60)).astype(np.float32))
def use():
    recording = amiwarp.simulate(scene, camera, prism, duration_s=0.02, device="cpu")
    events = amiwarp.Events.concatenate(list(recording.events.blocks()))
    stream = amiwarp.EncoderStream()
    stream.append(recording.encoder.t, recording.encoder.angle)
    compensator = amiwarp.Compensator(amiwarp.ExactModel(camera, prism), stream, device="cpu")
    compensator.put(events, 0)
    compensator.flush()
    return len(events), float(compensator.image().sum())
known = use()
child = os.fork()
if child == 0:
    signal.alarm(60)
    os._exit(int(use() != known))
sys.exit(os.waitpid(child, 0)[1])
"""
"""Program that works in a fork of a process that has worked: Python's processes on Linux, and loaders of data sets."""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_fork_works_on() -> None:
    done = subprocess.run(
        [sys.executable, "-c", FORKED], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
