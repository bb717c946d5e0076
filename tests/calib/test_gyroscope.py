"""A gyroscope tells how a camera in fast motion turned: its path, its axes and clock, and the calibration with it."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraMotion,
    FlatSide,
    ImuSamples,
    PhotometricSettings,
    Recording,
    RotationPath,
    SensorTiming,
    calibrate,
    model_error,
    open_recording,
    save_recording,
    simulate,
    truth_model,
)
from amiwarp.calib.commands import with_axes
from amiwarp.calib.gyroscope import Gyroscope, find_gyroscope
from amiwarp.calib.turn_by_turn import mean_of_few_turns
from amiwarp.events import axes_in_words, orientations
from amiwarp.events.axes import angle_between
from tests.conftest import TRUE_PRISM

CAMERA = Camera.from_fov(140, 105, math.radians(50.0))
SECONDS = 0.5
T = np.linspace(0.0, SECONDS, 251)
BIAS = np.array([0.05, -0.08, 0.1])


def shake(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a hard shake about all axes, at 3 to 9 Hz [rad/s]."""
    waves = [(1.0, 3.0, 0.3), (0.8, 4.1, 2.0), (0.9, 2.3, 4.0)]
    slow = [size * np.sin(math.tau * hz * t + phase) for size, hz, phase in waves]
    fast = [
        0.3 * np.sin(math.tau * hz * t + phase)
        for hz, phase in ((8.0, 1.0), (9.0, 0.0), (7.0, 2.0))
    ]
    return np.stack(slow, axis=1) + np.stack(fast, axis=1)


def samples(axes: NDArray[np.float64], *, late_us: int = 0, sign: float = 1.0) -> ImuSamples:
    """Return the samples of a gyroscope whose axes the matrix rotates to the camera's, with a bias."""
    seen = sign * shake(T) @ axes + BIAS @ axes
    return ImuSamples(
        np.round(T * 1e6).astype(np.int64) + late_us, seen, np.full(seen.shape, np.nan)
    )


def off_path(path: RotationPath) -> float:
    """Return the angle between the turn of a path from 0.1 to 0.3 s and the true one with the bias [rad]."""
    expected = Rotation.identity()
    for rate in shake(1e-6 * (np.arange(100_000, 300_000, 500) + 250)) + BIAS:
        expected = expected * Rotation.from_rotvec(rate * 5e-4)
    return float((path.orientations([300_000])[0] * expected.inv()).magnitude())


@pytest.fixture(scope="module")
def shaken(texture: NDArray[np.uint8]) -> Recording:
    motion = CameraMotion(np.column_stack([T, shake(T)]))
    nominal = replace(TRUE_PRISM, apex=1.2 * TRUE_PRISM.apex)
    return simulate(
        texture,
        CAMERA,
        TRUE_PRISM,
        duration_s=SECONDS,
        camera_motion=motion,
        seed=4,
        nominal_prism=nominal,
    )


def test_a_path_is_turned_in_the_moving_frame() -> None:
    """A quarter turn about x, then one about the camera's own y. The other order is another orientation."""
    quarter = math.pi / 2.0 / 0.1
    t = np.array([0, 99_999, 100_001, 200_000])
    rates = quarter * np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 1.0, 0]])
    path = RotationPath.from_rates(t, rates, (0, 200_000))
    expected = Rotation.from_rotvec([math.pi / 2, 0, 0]) * Rotation.from_rotvec([0, math.pi / 2, 0])
    found = path.orientations(np.array([0.0, 200_000.0]))
    assert (found[0].inv() * found[1] * expected.inv()).magnitude() < 1e-3
    vectors = path.vectors(100_000)
    np.testing.assert_allclose(vectors[0], [-math.pi / 2, 0, 0], atol=1e-3)
    np.testing.assert_allclose(vectors[-1], [0, math.pi / 2, 0], atol=1e-3)
    np.testing.assert_allclose(path.at(np.array([0.05]), 100_000), [[0, math.pi / 4, 0]], atol=1e-3)
    with pytest.raises(AmiwarpError, match="the gyroscope does not cover the time from -1 to 5 us"):
        RotationPath.from_rates(t, rates, (-1, 5))


def test_the_path_has_the_axes_and_the_clock_of_the_camera() -> None:
    axes = next(each for each in orientations() if axes_in_words(each) == "y, z, x")
    imu = samples(axes, late_us=20_000)
    right = Gyroscope(
        imu, axes, offset_us=-20_000.0, found=True, agreement=0.5, still=0.1, other=0.2
    )
    span = (100_000, 300_000)
    assert off_path(right.path(span)) < 2e-3
    assert off_path(replace(right, offset_us=0.0).path(span)) > 1e-2
    assert off_path(replace(right, to_camera=axes.T.copy()).path(span)) > 1e-2
    assert right.span == (0, round(SECONDS * 1e6))


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 7, 18])
def test_axes_are_found_in_the_events(shaken: Recording, number: int) -> None:
    assert shaken.encoder is not None
    axes = orientations()[number]
    found = find_gyroscope(replace(shaken, imu=samples(axes)), shaken.encoder, CAMERA)
    assert angle_between(found.to_camera, axes) < 1e-6
    assert found.offset_us == 0.0
    assert axes_in_words(axes) in found.in_words()
    assert "as found in the events" in found.in_words()
    assert "clock was taken to be that of the events" in found.in_words()
    assert off_path(found.path((100_000, 300_000))) < 2e-3


@pytest.mark.slow
def test_wrong_axes_and_a_wrong_sign_are_said(shaken: Recording) -> None:
    assert shaken.encoder is not None
    axes = next(each for each in orientations() if axes_in_words(each) == "y, z, x")
    right = replace(samples(axes), to_camera=axes)
    found = find_gyroscope(replace(shaken, imu=right), shaken.encoder, CAMERA)
    assert "as given" in found.in_words()
    transposed = replace(right, to_camera=axes.T.copy())
    with pytest.raises(
        AmiwarpError, match=r"does not explain|seem not to lie as given.* its y, z, x"
    ):
        find_gyroscope(replace(shaken, imu=transposed), shaken.encoder, CAMERA)
    negative = replace(samples(axes, sign=-1.0), to_camera=axes)
    with pytest.raises(AmiwarpError, match=r"does not explain|seem not to lie as given"):
        find_gyroscope(replace(shaken, imu=negative), shaken.encoder, CAMERA)
    with pytest.raises(AmiwarpError, match=r"does not cover|together cover less than a turn"):
        find_gyroscope(replace(shaken, imu=samples(axes, late_us=450_000)), shaken.encoder, CAMERA)


@pytest.mark.slow
@pytest.mark.parametrize("late_us", [20_000, -20_000])
def test_a_clock_that_is_late_is_set_right(shaken: Recording, late_us: int) -> None:
    assert shaken.encoder is not None
    imu = replace(samples(np.eye(3), late_us=late_us), to_camera=np.eye(3))
    found = find_gyroscope(replace(shaken, imu=imu), shaken.encoder, CAMERA)
    assert found.offset_us == pytest.approx(-late_us, abs=2500)
    assert "forward, as the events show" in found.in_words()
    assert off_path(found.path((100_000, 300_000))) < 6e-3
    assert found.span == (
        int(imu.t[0]) + round(found.offset_us),
        int(imu.t[-1]) + round(found.offset_us),
    )


@pytest.mark.slow
def test_a_shaken_camera_is_calibrated_with_its_gyroscope(
    shaken: Recording, tmp_path: Path
) -> None:
    """The stored axes are used, and the gyroscope's bias is found."""
    axes = next(each for each in orientations() if axes_in_words(each) == "-x, y, -z")
    save_recording(tmp_path / "a.h5", replace(shaken, imu=replace(samples(axes), to_camera=axes)))
    recording = open_recording(tmp_path / "a.h5")
    assert recording.truth is not None
    known = PhotometricSettings(
        pairs=40_000, density=1.0, sensor=SensorTiming(latency_us=100.0, refractory_us=100.0)
    )
    c = calibrate(recording, model="exact", photometric=known, events=40_000)
    assert model_error(c.model, truth_model(CAMERA, recording.truth, FlatSide.SCENE)).rms < 0.02
    said = next(text for text in c.warnings if "gyroscope's rotation was used" in text)
    assert "the camera's x, y, z are the gyroscope's -x, y, -z, as given" in said
    shown = [
        float(rate) for rate in said.partition("in the mean ")[2].partition(" deg/s")[0].split(", ")
    ]
    np.testing.assert_allclose(shown, np.degrees(BIAS), atol=0.5)


def test_few_turns_have_a_mean_and_its_scatter() -> None:
    each = np.array([[1.0, 2.0], [3.0, 2.0], [2.0, 5.0]])
    mean, covariance = mean_of_few_turns(each)
    np.testing.assert_allclose(mean, [2.0, 3.0])
    np.testing.assert_allclose(np.diag(covariance), np.array([1.0, 3.0]) / 2.0)


def test_axes_need_a_gyroscope(shaken: Recording) -> None:
    with pytest.raises(
        AmiwarpError, match="has no samples of a gyroscope; leave out --imu-rotation"
    ):
        with_axes(shaken, "x,y,z")
    with pytest.raises(AmiwarpError, match=r"--imu-rotation: .*names no axes"):
        with_axes(replace(shaken, imu=samples(np.eye(3))), "x,y")
    with pytest.raises(AmiwarpError, match=r"--imu-rotation: IMU to_camera .* is no rotation"):
        with_axes(replace(shaken, imu=samples(np.eye(3))), "x,y,-z")
    turned = with_axes(replace(shaken, imu=samples(np.eye(3))), "y,z,x").imu
    assert turned is not None
    np.testing.assert_array_equal(turned.to_camera, [[0, 1, 0], [0, 0, 1], [1, 0, 0]])
