"""Simulated inertial sensors: against the trajectories that they follow, and their stated noise."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import amiwarp
from amiwarp import AmiwarpError, CameraMotion, ImuModel, ImuSamples, Trajectory

G = 9.80665
DURATION_S = 0.5


def waving(seconds: float = DURATION_S) -> Trajectory:
    """Return a smooth motion about all axes."""

    def pose(t: float) -> tuple[Rotation, list[float]]:
        turn = Rotation.from_rotvec([0.3 * math.sin(5 * t), 0.2 * math.cos(4 * t), 0.5 * t])
        return turn, [0.1 * math.sin(6 * t), 0.2 * t * t, 0.05 * math.cos(7 * t)]

    return Trajectory.from_function(pose, seconds, rate_hz=200.0)


def integrated(
    imu: ImuSamples, start: Trajectory, lever: NDArray[np.float64]
) -> tuple[Rotation, NDArray[np.float64]]:
    """Return the last orientation and position [m] of the IMU, by the samples alone and the state at 0."""
    assert imu.to_camera is not None
    t = 1e-6 * imu.t
    rate = imu.angular_velocity @ imu.to_camera.T
    felt = imu.acceleration @ imu.to_camera.T
    h = 1e-6
    first, place = start.poses([0.0])
    _, soon = start.poses([h])
    turn = Rotation.from_matrix(first[0])
    at = place[0] + turn.apply(lever)
    speed = (soon[0] - place[0]) / h + turn.apply(np.cross(rate[0], lever))
    for k in range(len(t) - 1):
        step = t[k + 1] - t[k]
        after = turn * Rotation.from_rotvec(0.5 * (rate[k] + rate[k + 1]) * step)
        here = turn.apply(felt[k]) - [0.0, 0.0, G]
        there = after.apply(felt[k + 1]) - [0.0, 0.0, G]
        at = at + speed * step + (2.0 * here + there) / 6.0 * step**2
        speed = speed + 0.5 * (here + there) * step
        turn = after
    return turn, at


def test_samples_integrate_back_to_the_trajectory() -> None:
    path = waving()
    lever = np.array([0.03, -0.02, 0.05])
    axes = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix()
    imu = ImuModel(rate_hz=1000.0, position=lever, to_camera=axes).follow(path, DURATION_S)
    assert len(imu) == 501
    turn, at = integrated(imu, path, lever)
    true_turn, true_place = path.poses([DURATION_S])
    truth = Rotation.from_matrix(true_turn[0])
    assert math.degrees((turn.inv() * truth).magnitude()) < 1e-3
    assert np.linalg.norm(at - (true_place[0] + truth.apply(lever))) < 1e-5


def test_noise_integrates_within_what_its_density_states() -> None:
    path = waving()
    density = math.radians(0.5)
    model = ImuModel(rate_hz=500.0, gyroscope_noise=density)
    angles = []
    for seed in range(40):
        imu = model.follow(path, DURATION_S, seed=seed)
        turn, _ = integrated(imu, path, np.zeros(3))
        truth = Rotation.from_matrix(path.poses([DURATION_S])[0][0])
        angles.append((turn.inv() * truth).as_rotvec())
    # White noise integrates to a random walk: density times the root of the time.
    expected = density * math.sqrt(DURATION_S)
    assert np.std(angles) == pytest.approx(expected, rel=0.2)


def test_at_rest_the_accelerometer_points_up() -> None:
    still = Trajectory.still([1.0, 2.0, 3.0], look_at=[2.0, 2.0, 3.0])
    imu = ImuModel().follow(still, 0.1)
    assert imu.acceleration == pytest.approx(np.tile([0.0, -G, 0.0], (21, 1)), abs=1e-12)
    assert not imu.angular_velocity.any()
    assert imu.rate_hz == pytest.approx(200.0)


def test_after_the_last_pose_nothing_moves() -> None:
    imu = ImuModel(rate_hz=100.0).follow(waving(0.1), 0.3)
    after = 1e-6 * imu.t > 0.1
    assert after.any()
    assert not imu.angular_velocity[after].any()
    assert np.linalg.norm(imu.acceleration[after], axis=1) == pytest.approx(G)
    assert np.abs(imu.angular_velocity[~after]).max() > 0.1


def test_a_lever_arm_feels_the_turn() -> None:
    turning = Trajectory(
        [0.0, 1.0], np.zeros((2, 3)), Rotation.from_rotvec([[0, 0, 0], [0, 0, 2.0]]).as_quat()
    )
    imu = ImuModel(position=(0.5, 0.0, 0.0)).follow(turning, 0.5, gravity=0.0)
    assert imu.acceleration == pytest.approx(np.tile([-2.0, 0.0, 0.0], (101, 1)), abs=1e-9)


def test_errors_have_the_stated_sizes() -> None:
    still = Trajectory.still([0, 0, 0], look_at=[1, 0, 0])
    rate = 400.0
    white = ImuModel(rate_hz=rate, accelerometer_noise=0.01).follow(still, 50.0)
    noise = white.acceleration - [0.0, -G, 0.0]
    assert noise.std() == pytest.approx(0.01 * math.sqrt(rate), rel=0.02)
    walking = ImuModel(rate_hz=rate, gyroscope_walk=0.02)
    ends = [walking.follow(still, 1.0, seed=k).angular_velocity[-1] for k in range(200)]
    assert np.std(ends) == pytest.approx(0.02, rel=0.1)
    offset = ImuModel(gyroscope_bias=0.05)
    first = [offset.follow(still, 0.01, seed=k).angular_velocity for k in range(200)]
    assert np.std([each[0] for each in first]) == pytest.approx(0.05, rel=0.1)
    assert np.ptp(first[0], axis=0).max() == 0.0


def test_samples_are_clipped_and_rounded() -> None:
    turning = CameraMotion((1.0, -20.0, 0.1234))
    model = ImuModel(gyroscope_range=4.0, accelerometer_range=16.0, bits=8)
    rates = model.turn(turning, 0.01).angular_velocity
    step = 4.0 / 128
    assert rates[0].tolist() == [1.0, -4.0, 4 * step]
    fast = model.turn(CameraMotion((20.0, 0.0, 0.0)), 0.01).angular_velocity
    assert fast[0, 0] == 4.0 - step


def test_a_picture_turns_with_the_camera_and_has_gravity() -> None:
    quarter = CameraMotion((0.0, 0.0, math.pi / 2))
    imu = ImuModel(rate_hz=10.0).turn(quarter, 1.0)
    assert imu.angular_velocity == pytest.approx(np.tile([0.0, 0.0, math.pi / 2], (11, 1)))
    # The camera rolls about its view by a quarter: what was up is along x then.
    assert imu.acceleration[0] == pytest.approx([0.0, -G, 0.0])
    assert imu.acceleration[-1] == pytest.approx([-G, 0.0, 0.0])


def test_a_recording_has_the_samples(tmp_path: Path) -> None:
    scene = amiwarp.Scene.from_picture(np.random.default_rng(1).random((64, 64)).astype(np.float32))
    simulation = amiwarp.Simulation(
        scene,
        amiwarp.Camera.from_fov(32, 24, 1.0),
        amiwarp.Prism(0.02),
        0.05,
        camera_motion=CameraMotion((0.1, 0.0, 0.0)),
        imu=ImuModel.preset("mpu6500"),
        seed=3,
    )
    in_memory = simulation.run().imu
    simulation.write(tmp_path / "r.h5")
    stored = amiwarp.open_recording(tmp_path / "r.h5").imu
    assert in_memory is not None
    assert stored is not None
    for name in ("t", "angular_velocity", "acceleration", "to_camera"):
        assert np.array_equal(getattr(in_memory, name), getattr(stored, name))
    assert simulation.run().imu.angular_velocity.tobytes() == in_memory.angular_velocity.tobytes()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"rate_hz": 0.0}, "rate_hz"),
        ({"gyroscope_noise": -1.0}, "gyroscope_noise"),
        ({"bits": 4}, "8 to 32"),
        ({"bits": 16}, "gyroscope_range"),
        ({"position": (1.0, 2.0)}, "position"),
        ({"position": (100.0, 0.0, 0.0)}, "10 m"),
        ({"to_camera": np.diag([1.0, 1.0, -1.0])}, "no rotation"),
        ({"accelerometer_range": 0.0}, "accelerometer_range"),
    ],
)
def test_impossible_values_are_refused(values: dict[str, object], words: str) -> None:
    with pytest.raises(AmiwarpError, match=words):
        ImuModel(**values)  # type: ignore[arg-type]


def test_unknown_presets_and_too_many_samples_are_refused() -> None:
    with pytest.raises(AmiwarpError, match="bmi160"):
        ImuModel.preset("bmi161")
    with pytest.raises(AmiwarpError, match="IMU samples"):
        ImuModel(rate_hz=1e5).turn(CameraMotion(), 1e5)
