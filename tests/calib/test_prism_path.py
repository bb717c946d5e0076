"""Recordings without an encoder in which the prism's speed varies: the path of its angle is found in the events."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    Events,
    ExactModel,
    MemoryEvents,
    Prism,
    PrismMotion,
    Recording,
    calibrate,
    compensate_events,
    simulate,
)
from amiwarp.calib import attempts
from amiwarp.calib.repetition_path import varying_paths
from amiwarp.calib.start_burst import reaching_back
from amiwarp.optics.models.several import compensate_by_each
from amiwarp.viewer import Inspector
from tests.conftest import COARSE

CAMERA = Camera.from_fov(120, 90, math.radians(60.0))
PRISM = Prism(math.radians(2.0))
LATENCY_US = 100.0
"""Latency of the simulated sensor [us]."""
SECONDS = 0.4


def simulated(
    texture: np.ndarray, rpm: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> tuple[Recording, PrismMotion]:
    """Return a recording without an encoder of a prism with a speed over time [1/min], and its motion."""
    motion = PrismMotion.from_function(rpm, SECONDS + 0.1, phase=1.0)
    recording = simulate(texture, CAMERA, PRISM, duration_s=SECONDS, motion=motion, seed=4)
    return replace(recording, encoder=None), motion


def error_px(recording: Recording, motion: PrismMotion, found: Calibration) -> float:
    """Return the error of the compensated events, constant lag removed [px rms]."""
    events = recording.events.slice(0, len(recording.events))[::50]
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    theta = found.encoder_for(None, recording.events.t_first, recording.events.t_last).angle_at(
        events.t
    )
    true = compensate_by_each(
        [ExactModel(CAMERA, PRISM, motion.phase)], xy, motion.angle(events.t - LATENCY_US)
    )[0]
    at, later, earlier = compensate_by_each(
        [found.model] * 3, xy, theta + np.array([[0.0], [0.01], [-0.01]])
    )
    error, per_angle = at - true, later - earlier
    error -= per_angle * np.nansum(error * per_angle) / np.nansum(per_angle**2)
    return float(np.sqrt(np.nanmean((error**2).sum(axis=1))))


def with_burst(recording: Recording, count: int, before: int, t: int) -> Recording:
    """Return the recording with ``count`` more events before the event ``before``, all at the time ``t`` [us]."""
    events, rng = recording.events[:], np.random.default_rng(0)
    at = rng.integers(0, (120, 90), (count, 2)).T
    burst = Events.from_arrays(at[0], at[1], np.full(count, t), np.ones(count))
    whole = Events.concatenate([events[:before], burst, events[before:]])
    return replace(recording, events=MemoryEvents(whole, 120, 90))


def ramp(t: NDArray[np.float64]) -> NDArray[np.float64]:
    return 900.0 * np.clip(t / SECONDS, 0.0, 1.0)


@pytest.fixture(scope="module")
def spun_up(texture: np.ndarray) -> tuple[Recording, PrismMotion]:
    """Three turns of a prism that starts to turn when the recording begins."""
    return simulated(texture, ramp)


@pytest.fixture(scope="module")
def calibrated(spun_up: tuple[Recording, PrismMotion]) -> Calibration:
    return calibrate(spun_up[0], photometric=COARSE)


def test_a_prism_that_starts_is_followed(
    spun_up: tuple[Recording, PrismMotion], calibrated: Calibration
) -> None:
    assert error_px(*spun_up, calibrated) < 0.05
    assert "rpm" not in calibrated.parameters
    assert any("speed is not constant: it rose from" in w for w in calibrated.warnings)


def test_a_burst_of_the_starting_camera_is_left_out(
    spun_up: tuple[Recording, PrismMotion], calibrated: Calibration
) -> None:
    start = spun_up[0].events.t_first - 50_000
    recording = with_burst(spun_up[0], 20_000, 0, start)
    found = calibrate(recording, photometric=COARSE)
    assert found.parameters == calibrated.parameters
    assert found.warnings[:-1] == calibrated.warnings
    assert f"20,000 events carry the first time stamp ({start} us)" in found.warnings[-1]
    encoder = found.encoder_for(None, start, recording.events.t_last)
    assert encoder.covers(start, recording.events.t_last)
    assert calibrated.path is not None
    np.testing.assert_allclose(
        encoder.angle_at(calibrated.path.t), calibrated.path.angle, rtol=0, atol=1e-12
    )


def test_a_path_reaches_back_at_the_speed_of_its_start() -> None:
    path = Encoder(np.array([1000, 2000, 3000]), np.array([0.5, 0.7, 1.5]))
    longer = reaching_back(path, -4000)
    assert float(longer.angle_at([-4000])[0]) == pytest.approx(-0.5)
    np.testing.assert_allclose(longer.angle_at(path.t), path.angle, rtol=0, atol=1e-12)
    assert reaching_back(path, 1000) is path


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_many_events_of_one_time_leave_paths_of_finite_angles(
    spun_up: tuple[Recording, PrismMotion], share: float
) -> None:
    events = spun_up[0].events[:]
    before = int(share * (len(events) - 1))
    paths = varying_paths(with_burst(spun_up[0], 30_000, before, int(events.t[before])))
    assert len(paths) == 2
    assert all(np.isfinite(path.angle).all() for path in paths)


def test_events_of_one_time_have_no_path(spun_up: tuple[Recording, PrismMotion]) -> None:
    events = spun_up[0].events[:]
    same = Events(events.x, events.y, np.zeros_like(events.t), events.p)
    assert varying_paths(replace(spun_up[0], events=MemoryEvents(same, 120, 90))) == []


def test_the_file_keeps_the_path(
    spun_up: tuple[Recording, PrismMotion], calibrated: Calibration, tmp_path: Path
) -> None:
    recording = spun_up[0]
    calibrated.save(tmp_path / "c.json")
    loaded = Calibration.load(tmp_path / "c.json")
    assert calibrated.path is not None
    assert loaded.path is not None
    np.testing.assert_array_equal(loaded.path.t, calibrated.path.t)
    np.testing.assert_array_equal(loaded.path.angle, calibrated.path.angle)
    events = recording.events.slice(0, 10_000)
    span = int(events.t[0]), int(events.t[-1])
    moved = [
        compensate_events(events, c.model, c.encoder_for(None, *span)) for c in (calibrated, loaded)
    ]
    np.testing.assert_array_equal(moved[0], moved[1])
    with pytest.raises(
        AmiwarpError, match=r"one recording only, from -.* calibrate this recording itself"
    ):
        loaded.encoder_for(None, span[0], 10_000_000)
    with pytest.raises(AmiwarpError, match="the calibration was made without one"):
        loaded.encoder_for(loaded.path, *span)


def test_the_inspector_shows_the_path(
    spun_up: tuple[Recording, PrismMotion], calibrated: Calibration
) -> None:
    inspector = Inspector(spun_up[0], calibrated)
    assert calibrated.path is not None
    np.testing.assert_array_equal(inspector.encoder.angle, calibrated.path.angle)
    assert inspector.as_calibration() is calibrated


@pytest.mark.slow
def test_ripple_is_found(texture: np.ndarray) -> None:
    recording, motion = simulated(
        texture, lambda t: 720.0 * (1.0 + 0.1 * np.cos(math.tau * 12.0 * t))
    )
    found = calibrate(recording, photometric=COARSE, model="exact")
    assert found.path is not None
    assert error_px(recording, motion, found) < 0.04  # px; a constant speed leaves 0.25
    assert any("speed is not constant: it varied between" in w for w in found.warnings)


def test_a_constant_speed_stays_one_number(texture: np.ndarray) -> None:
    recording, motion = simulated(texture, lambda t: np.full_like(t, 720.0))
    assert varying_paths(recording) == []
    found = calibrate(recording, photometric=COARSE, model="exact")
    assert found.path is None
    assert found.warnings == ()
    assert found.parameters["rpm"] == pytest.approx(720.0, rel=1e-3)
    assert error_px(recording, motion, found) < 0.02
    # What the first look leaves open
    assert found.photometric is not None
    assert 0.002 < found.photometric.hidden_px["a speed that varies"] < 0.06


@pytest.mark.slow
def test_a_speed_that_changes_by_one_percent_is_found(texture: np.ndarray) -> None:
    """A constant speed leaves 0.02 px. With the path, what could hide is what its scatter leaves open."""
    recording, motion = simulated(texture, lambda t: 720.0 * (1.0 + 0.008 * t / SECONDS))
    found = calibrate(recording, photometric=COARSE, model="exact")
    assert found.path is not None
    assert error_px(recording, motion, found) < 0.015
    assert any("speed is not constant" in w for w in found.warnings)
    assert found.photometric is not None
    assert 0.001 < found.photometric.hidden_px["a speed that varies"] < 0.02


@pytest.mark.parametrize(
    ("was_accepted", "is_accepted", "cost", "is_taken"),
    [
        (False, False, 0.09, True),
        (True, True, 0.09, True),
        (True, False, 0.09, False),
        (True, True, 0.11, False),
    ],
)
def test_a_path_without_the_error_of_each_turn_must_be_as_good(
    was_accepted: bool, is_accepted: bool, cost: float, is_taken: bool
) -> None:
    """An answer with a third harmonic is accepted; a correction that is refused does not replace it."""
    path = Encoder.constant_speed(720.0, 0, 400_000)
    of_stage = SimpleNamespace(harmonics=(0.0, 0.0, 0.0, 0.0, 0.01, 0.0))
    found = SimpleNamespace(path=path, photometric=of_stage)
    tried: Any = SimpleNamespace(calibration=found, accepted=was_accepted, cost=0.1)
    again: Any = SimpleNamespace(calibration=found, accepted=is_accepted, cost=cost)

    @dataclass(frozen=True)
    class Calibrator:
        recording: Any
        path: Encoder | None = None

        def attempt(self) -> Any:
            """Return the attempt with the third harmonic taken out, which leaves the middle at 0."""
            assert self.path is not None
            bent = self.path.angle - path.angle_at(self.path.t)
            assert float(np.ptp(bent)) == pytest.approx(0.02, rel=0.05)
            assert self.path.angle_at([200_000])[0] == pytest.approx(0.0, abs=1e-9)
            return again

    events = SimpleNamespace(t_first=0, t_last=400_000)
    calibrator: Any = Calibrator(SimpleNamespace(events=events))
    kept = attempts.with_straight_path(calibrator, tried)
    assert kept is (again if is_taken else tried)


def test_repetition_gives_the_path_of_a_ramp(spun_up: tuple[Recording, PrismMotion]) -> None:
    recording, motion = spun_up
    forward, backward = varying_paths(recording)
    t = np.arange(20_000, recording.events.t_last, 1000)
    off = forward.angle_at(t) - motion.angle(t - LATENCY_US)
    assert float(np.std(off)) < 0.05  # rad
    np.testing.assert_allclose(backward.angle, -forward.angle, rtol=0, atol=1e-9)


def test_events_that_do_not_repeat_have_no_path() -> None:
    rng = np.random.default_rng(0)
    events = simulate(
        rng.integers(0, 255, (60, 80), dtype=np.uint8), CAMERA, PRISM, duration_s=0.02
    ).events
    short = Recording(
        MemoryEvents(events.slice(0, len(events)), 120, 90), CAMERA, None, PRISM, None, {}, "short"
    )
    assert varying_paths(short) == []


def test_speeds_are_told_in_words() -> None:
    t = np.arange(0, 1_000_000, 1000)
    assert "rose from" in attempts.speed_in_words(Encoder(t, 20.0 * (t * 1e-6) ** 2))
    assert "fell from" in attempts.speed_in_words(Encoder(t, -20.0 * (1.0 - t * 1e-6) ** 2))
    swing = Encoder(t, 100.0 * t * 1e-6 + np.sin(50.0 * t * 1e-6))
    assert "varied between" in attempts.speed_in_words(swing)
