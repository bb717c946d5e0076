"""Ground truth in another camera, against projection matrices and analytic squares in float64."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import amiwarp
from amiwarp import AmiwarpError, RadialTangential
from reference import other_camera as oracle

LEFT = amiwarp.Camera.from_fov(96, 72, 1.0)
RIGHT = replace(LEFT, width=80, cx=36.0)
DURATION_S = 0.03
BASELINE_M = 0.15
WALL_M = 3.0
BOARD = np.array([0.1, 1.6, 0.05])
"""Centre of the board at the start [m]; it moves along x at :data:`SPEED`."""
BOARD_SIDE = 0.25
SPEED = np.array([1.5, 0.0, 0.0])


def square(side: float, centre: NDArray[np.float64]) -> amiwarp.Mesh:
    corners = np.array([[-side, 0, -side], [side, 0, -side], [side, 0, side], [-side, 0, side]])
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    return amiwarp.Mesh(corners + centre, [[0, 1, 2], [0, 2, 3]], uv=uv)


def path(shift: NDArray[np.float64], turn: NDArray[np.float64]) -> amiwarp.Trajectory:
    """Path of a camera on a rig that moves and pans, at ``shift`` [m] and turned by ``turn`` in the rig's frame."""
    base = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])

    def pose(t: float) -> tuple[Rotation, NDArray[np.float64]]:
        rig = Rotation.from_rotvec([0.2 * t, 0.5 * t, -0.8 * t]) * base
        position = np.array([0.3 * t, 0.2 * t, -0.1 * t])
        return rig * Rotation.from_rotvec(turn), position + rig.apply(shift)

    return amiwarp.Trajectory.from_function(pose, DURATION_S, rate_hz=1000.0)


@pytest.fixture(scope="module")
def world() -> amiwarp.World:
    rng = np.random.default_rng(4)
    ends = [BOARD, BOARD + SPEED * DURATION_S]
    moves = amiwarp.Trajectory([0.0, DURATION_S], ends, [[0, 0, 0, 1]] * 2)
    on_wall = amiwarp.Material(1.0, 0.1 + 0.9 * rng.integers(0, 2, (48, 48)))
    on_board = amiwarp.Material(1.0, 0.1 + 0.9 * rng.integers(0, 2, (12, 12)))
    bodies = (
        amiwarp.Body("wall", square(1.5, np.array([0, WALL_M, 0])), on_wall),
        amiwarp.Body("board", square(BOARD_SIDE, np.zeros(3)), on_board, moves),
    )
    return amiwarp.World("two", bodies, ambient=1.0)


@pytest.fixture(scope="module")
def left_path() -> amiwarp.Trajectory:
    return path(np.zeros(3), np.zeros(3))


@pytest.fixture(scope="module")
def recording(world: amiwarp.World, left_path: amiwarp.Trajectory) -> amiwarp.Recording:
    """Events of the left camera, behind a prism, without the sensor's latency."""
    return amiwarp.Simulation(
        amiwarp.WorldScene(world, left_path), LEFT, amiwarp.Prism(0.02), DURATION_S,
        sensor=amiwarp.SensorModel.ideal(0.25), seed=2,
    ).run(truth_times_us=[0, 10_000])  # fmt: skip


def matrix_of(camera: amiwarp.Camera, way: amiwarp.Trajectory, t_us: float) -> NDArray[np.float64]:
    (rotation,), (position,) = way.poses([t_us * 1e-6])
    return oracle.projection(camera, rotation, position)


def truth_of(recording: amiwarp.Recording) -> amiwarp.EventTruth:
    assert recording.truth is not None
    return recording.truth.of_events(0, len(recording.events))


@pytest.mark.parametrize("turned", [0.0, 0.1])
def test_events_lie_on_the_epipolar_lines_of_the_other_camera(
    recording: amiwarp.Recording, left_path: amiwarp.Trajectory, turned: float
) -> None:
    right_path = path(np.array([BASELINE_M, 0.02, 0.01]), turned * np.array([0.3, -1.0, 0.5]))
    truth, times = truth_of(recording), recording.events[:].t
    assert truth.points is not None
    assert truth.place is not None
    seen = amiwarp.places_in(truth.place, times, RIGHT, right_path)
    known = np.flatnonzero(np.isfinite(seen.points).all(axis=1))
    assert len(known) > 5000
    for k in known[:: len(known) // 200]:
        of_left = matrix_of(LEFT, left_path, times[k])
        of_right = matrix_of(RIGHT, right_path, times[k])
        first = truth.points[k].astype(np.float64)
        assert oracle.epipolar_distance(of_left, of_right, first, seen.points[k]) < 0.01  # px
        # The point by the plane that the left pixel sees, without the place of the ground truth
        y = WALL_M if truth.instance is not None and truth.instance[k] == 1 else BOARD[1]
        place = oracle.seen_through(of_left, first, y)
        expected = oracle.pixel(of_right, place)
        np.testing.assert_allclose(seen.points[k], expected, rtol=0, atol=0.01)  # px
        depth = (of_right @ np.append(place, 1.0))[2]
        assert seen.depth[k] == pytest.approx(depth, abs=2e-5)  # m


def test_the_disparity_is_the_difference_of_the_columns(
    recording: amiwarp.Recording,
) -> None:
    right_path = path(np.array([BASELINE_M, 0.0, 0.0]), np.zeros(3))
    truth = truth_of(recording)
    assert truth.points is not None
    assert truth.place is not None
    assert truth.depth is not None
    seen = amiwarp.places_in(truth.place, recording.events[:].t, RIGHT, right_path)
    known = np.isfinite(truth.depth)
    difference = truth.points[known] - seen.points[known]
    expected = amiwarp.disparity(truth.depth[known], LEFT, RIGHT, BASELINE_M)
    np.testing.assert_allclose(difference[:, 0], expected, rtol=0, atol=0.01)  # px
    np.testing.assert_allclose(difference[:, 1], 0.0, rtol=0, atol=0.01)  # px
    assert np.ptp(expected) > 3.0


def test_a_depth_map_becomes_a_disparity_map(recording: amiwarp.Recording) -> None:
    assert recording.truth is not None
    assert recording.truth.frames is not None
    depth = recording.truth.frames[0].depth
    found = amiwarp.disparity(depth, LEFT, LEFT, BASELINE_M)
    assert found.shape == depth.shape
    wall = LEFT.fx * BASELINE_M / WALL_M
    near = LEFT.fx * BASELINE_M / BOARD[1]
    np.testing.assert_allclose(
        np.unique(np.round(found, 3)), [0.0, wall, near], rtol=0, atol=2e-3
    )  # px
    sky_and_wrong = amiwarp.disparity([math.inf, 0.0, -1.0, math.nan], LEFT, RIGHT, 0.1)
    np.testing.assert_array_equal(sky_and_wrong, [LEFT.cx - RIGHT.cx, *[math.nan] * 3])


def test_the_board_hides_the_wall_where_it_is_at_the_time(
    world: amiwarp.World, recording: amiwarp.Recording
) -> None:
    right_path = path(np.array([BASELINE_M, 0.0, 0.0]), np.zeros(3))
    truth, times = truth_of(recording), recording.events[:].t
    assert truth.place is not None
    seen = amiwarp.places_in(truth.place, times, RIGHT, right_path, world=world)
    unhidden = amiwarp.places_in(truth.place, times, RIGHT, right_path)
    np.testing.assert_array_equal(seen.points, unhidden.points)
    assert (unhidden.visible >= seen.visible).all()
    _, eyes = right_path.poses(times * 1e-6)
    expected = unhidden.visible.copy()
    for k in np.flatnonzero(expected):
        board = BOARD + SPEED * times[k] * 1e-6
        expected[k] = not oracle.hides(board, BOARD_SIDE, eyes[k], truth.place[k].astype(float))
    assert 100 < (unhidden.visible & ~expected).sum() < 0.5 * len(expected)
    assert (seen.visible == expected).mean() > 0.9995

    # Only points inside the image are visible, to the outer border of its pixels
    x, y = unhidden.points.T
    inside = (x >= -0.5) & (x < 79.5) & (y >= -0.5) & (y < 71.5)
    np.testing.assert_array_equal(unhidden.visible, inside)
    assert 0.5 < inside.mean() < 0.99


def test_the_sky_and_what_lies_behind_have_no_pixel() -> None:
    still = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    places = [[0.0, 2.0, 0.0], [0.0, -2.0, 0.0], [math.nan] * 3]
    seen = amiwarp.places_in(places, [0, 0, 0], LEFT, still)
    np.testing.assert_allclose(seen.points[0], [LEFT.cx, LEFT.cy], rtol=0, atol=1e-4)  # px
    assert np.isnan(seen.points[1:]).all()
    assert seen.visible.tolist() == [True, False, False]
    np.testing.assert_allclose(seen.depth, [2.0, -2.0, math.nan], rtol=1e-12)
    assert len(amiwarp.places_in(np.zeros((0, 3)), [], LEFT, still).visible) == 0


@pytest.mark.parametrize(
    ("right", "says"),
    [
        (replace(LEFT, fx=80.0), r"the cameras have fx = 87\.\d+ and 80 px; give a rectified pair"),
        (replace(LEFT, fy=80.0), "the cameras have fy"),
        (replace(LEFT, cy=30.0), "the cameras have cy"),
        (
            replace(LEFT, distortion=RadialTangential(0.1, 0.0, 0.0, 0.0, 0.0)),
            "the right camera has lens distortion",
        ),
    ],
)
def test_cameras_that_are_no_rectified_pair_are_refused(right: amiwarp.Camera, says: str) -> None:
    with pytest.raises(AmiwarpError, match=says):
        amiwarp.disparity([1.0], LEFT, right, 0.1)


def test_wrong_shapes_are_refused() -> None:
    still = amiwarp.Trajectory.still([0, 0, 0])
    with pytest.raises(AmiwarpError, match=r"places have shape \(2, 3\), t_us \(1,\)"):
        amiwarp.places_in(np.ones((2, 3)), [0], LEFT, still)
    with pytest.raises(AmiwarpError, match="t_us"):
        amiwarp.places_in(np.ones((1, 3)), [math.nan], LEFT, still)
    with pytest.raises(AmiwarpError, match="baseline_m"):
        amiwarp.disparity([1.0], LEFT, LEFT, -0.1)
