"""Evaluations of stereo and of the gyroscope: matches with a known answer, known rotations, and a small room."""

import json
import math
from dataclasses import asdict

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import amiwarp
from amiwarp.studies.evaluate import (
    BASELINE_M,
    QUICK,
    CellResult,
    Condition,
    Frames,
    Gyroscope,
    Rates,
    RightCondition,
    Setup,
    Stream,
    Streams,
    Verdict,
    disparity_error,
    fitted_rate,
    inertial,
    match,
    mean_rates,
    rate_errors,
    right_streams,
    shared_edges,
    stereo,
    to_the_right,
    true_rates,
)

CAMERA = amiwarp.Camera.from_fov(160, 120, 0.7)


def texture(shape: tuple[int, int], seed: int = 0) -> NDArray[np.uint8]:
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 1.0)
    return np.asarray(np.clip(128.0 + 400.0 * noise, 0.0, 255.0), np.uint8)


@pytest.mark.parametrize("shift", [0, 3, 17])
def test_the_disparity_of_a_shifted_picture_is_the_shift(shift: int) -> None:
    wide = texture((60, 160))
    left = wide[:, : 160 - shift]
    right = wide[:, shift:]
    found = match(np.ascontiguousarray(left), np.ascontiguousarray(right))
    inside = found[5:-5, shift + 8 : -8]
    assert np.isfinite(inside).mean() > 0.95
    np.testing.assert_allclose(np.nanmedian(inside), shift, rtol=0, atol=0.1)  # px
    assert np.nanmean(np.abs(inside - shift) < 0.5) > 0.98


def test_errors_of_known_disparities() -> None:
    truth = np.full((2, 4), 10.0)
    found = np.array([[10.2, 11.0, 11.5, math.nan], [9.5, 3.0, math.nan, 10.0]])
    edges = np.ones((2, 4), np.bool_)
    edges[1, 3] = False
    error = disparity_error(found, truth, edges)
    assert error.complete == pytest.approx(5 / 7)
    assert error.median == pytest.approx(1.0)  # of 0.2, 0.5, 1.0, 1.5, 7.0
    assert error.outliers == pytest.approx(2 / 5)
    assert error.right == pytest.approx(3 / 7)
    nothing = disparity_error(np.full((2, 4), math.nan), truth, edges)
    assert (nothing.complete, nothing.right) == (0.0, 0.0)
    assert math.isnan(nothing.median)
    assert math.isnan(disparity_error(found, truth, np.zeros((2, 4), np.bool_)).complete)


def test_the_right_camera_stays_beside_the_left_one() -> None:
    _, path = amiwarp.named_world("room", "fast", seed=3, duration_s=0.2)
    right = to_the_right(path, BASELINE_M)
    t = np.linspace(0.0, 0.2, 301)
    (rotation, position), (of_right, at_right) = path.poses(t), right.poses(t)
    np.testing.assert_allclose(of_right, rotation, rtol=0, atol=1e-6)
    expected = position + rotation @ np.array([BASELINE_M, 0.0, 0.0])
    np.testing.assert_allclose(at_right, expected, rtol=0, atol=1e-9)  # m
    still = to_the_right(amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0]), 0.5)
    np.testing.assert_allclose(still.poses([0.0])[1], [[0.5, 0.0, 0.0]], rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def left() -> Streams:
    return Streams(
        Condition(width=64, height=48, duration_s=0.1, trajectory="handheld", seed=1),
        setup=Setup(None, 1400.0, 0.0),
    )


@pytest.fixture(scope="module")
def right(left: Streams) -> Streams:
    return right_streams(left)


def test_the_right_camera_has_its_own_sensor_and_prism(left: Streams, right: Streams) -> None:
    assert isinstance(right.condition, RightCondition)
    assert asdict(right.condition) == asdict(left.condition)
    assert right.setup is left.setup
    assert right.simulation.seed != left.simulation.seed
    assert right.condition.phase != left.condition.phase
    # What the true model of the right prism compensates lies where its camera sees it.
    seen = right.window(Stream.TRUE, 0, right.end_us)
    points = right.event_truth(Stream.TRUE, 0, right.end_us).points
    assert points is not None
    assert np.nanmedian(np.hypot(seen.x - points[:, 0], seen.y - points[:, 1])) < 0.4  # px


def test_edges_that_both_cameras_see(left: Streams, right: Streams) -> None:
    truth = left.frame(50_000)
    edges = shared_edges(left, right, truth)
    disparity = amiwarp.disparity(truth.depth, left.camera, right.camera, BASELINE_M)
    column = np.arange(64)[None] - disparity
    assert 50 < edges.sum() < edges.size
    assert (column[edges] >= -0.6).all()  # px: the border of the right image
    # The wall behind the border of a near surface is hidden from the right camera.
    unhidden = (column >= -0.4) & (column < 63.4) & np.isfinite(truth.depth)
    nearer_left = truth.depth < 0.8 * np.roll(truth.depth, -1, axis=1)
    assert nearer_left.any()
    assert (unhidden & ~edges).any()


def test_stereo_of_a_small_room(left: Streams) -> None:
    values = stereo.measure(left, QUICK)
    rows = values["rows"]
    assert {row["turns"] for row in rows} == set(stereo.TURNS)
    names = {Stream.PLAIN, Stream.TRUE, Stream.RAW, *Frames, stereo.ONE_DISPARITY}
    assert {row["stream"] for row in rows} == {*map(str, names)}
    half = {row["stream"]: row for row in rows if row["turns"] == stereo.STANDARD_TURNS}
    assert half[Stream.TRUE]["right"] > 0.6
    assert half[Stream.TRUE]["right"] > 2.0 * half[Stream.RAW]["right"]
    assert half[Frames.FAST]["right"] > 0.7
    assert half[stereo.ONE_DISPARITY]["complete"] == 1.0
    for row in rows:
        if row["outliers"] is not None:
            correct = row["complete"] * (1.0 - row["outliers"])
            assert row["right"] == pytest.approx(correct, abs=1e-9)
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    cell = CellResult("stereo", left.condition, values)
    table, curve = stereo.tables([cell])
    assert len(table.rows) == len(half)
    assert len(curve.rows) == len(rows)
    assert {claim.verdict for claim in stereo.claims([cell])} <= {
        Verdict.UNDECIDED,
        Verdict.NOT_TESTABLE,
    }


def row_of(stream: str, right: float, median: float) -> dict[str, object]:
    return {
        "stream": stream,
        "turns": stereo.STANDARD_TURNS,
        "complete": 1.0,
        "median": median,
        "outliers": 1.0 - right,
        "right": right,
    }


def test_stereo_is_judged_by_the_motion_of_the_rig() -> None:
    """At rest the prism helps, in fast motion it does harm: both are said, each by its own rule."""
    cells = []
    for motion, ours in (("still", 0.9), ("fast", 0.4)):
        for seed in (1, 2, 3):
            condition = Condition(trajectory=motion, seed=seed)
            rows = [
                row_of(Stream.CALIBRATED, ours + 0.01 * seed, 0.3),
                row_of(Stream.PLAIN, 0.7, 0.25),
                row_of(stereo.MIXED, 0.7 + 0.1 * seed - 0.2, 0.3),
            ]
            cells.append(CellResult("stereo", condition, {"rows": rows}))
    verdicts = {claim.text: claim.verdict for claim in stereo.claims(cells)}
    than = f"'{Stream.CALIBRATED}' finds the disparity of more edges than '{Stream.PLAIN}'."
    assert verdicts[f"At rest, {than}"] is Verdict.REPRODUCED
    assert verdicts[f"With a fast rig, {than}"] is Verdict.NOT_REPRODUCED
    assert verdicts[f"With a handheld rig, {than}"] is Verdict.NOT_TESTABLE
    mixed = f"At rest, '{stereo.MIXED}' finds the disparity of more edges than '{Stream.PLAIN}'."
    assert verdicts[mixed] is Verdict.UNDECIDED
    (error,) = [claim for claim in stereo.claims(cells) if "median error" in claim.text]
    assert error.verdict is Verdict.REPRODUCED
    assert {claim.number for claim in stereo.claims(cells)} == {None}


def test_mean_rates_between_samples() -> None:
    """A rate that grows linearly has the rate of the middle as its mean, whatever the ends are."""
    t = np.arange(0, 100_001, 5000)
    rates = np.outer(1e-6 * t, [1.0, -2.0, 0.5])
    ends = np.array([1234, 31_000, 98_765])
    middles = 0.5e-6 * (ends[1:] + ends[:-1])
    found = mean_rates(t, rates, ends)
    expected = np.outer(middles, [1.0, -2.0, 0.5])
    # Within an interval of the samples the angle is taken to grow evenly.
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-5)  # rad/s


def test_rates_of_a_camera_that_turns_steadily_are_found_in_its_own_frame() -> None:
    rate = np.array([0.3, -0.5, 0.8])
    start = Rotation.from_rotvec([0.4, 1.0, -0.2])

    def pose(t: float) -> tuple[Rotation, NDArray[np.float64]]:
        return start * Rotation.from_rotvec(rate * t), np.array([t, 0.0, 0.0])

    path = amiwarp.Trajectory.from_function(pose, 0.3)
    ends = np.array([0, 100_000, 300_000])
    found = true_rates(path, ends)
    np.testing.assert_allclose(found.rates, [rate, rate], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.end().as_rotvec(), 0.3 * rate, rtol=0, atol=1e-9)


def test_the_flow_of_a_rotation_gives_its_rate() -> None:
    """The flow by the textbook's matrix of a pinhole camera, at rates of 0.2 rad/s."""
    rate = np.array([0.1, -0.2, 0.15])
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    u, v = (x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy
    wx, wy, wz = rate
    flow = np.stack(
        [
            CAMERA.fx * (u * v * wx - (1.0 + u * u) * wy + v * wz),
            CAMERA.fy * ((1.0 + v * v) * wx - u * v * wy - u * wz),
        ],
        axis=-1,
    )
    where = np.zeros((CAMERA.height, CAMERA.width), np.bool_)
    where[::7, ::5] = True
    found = fitted_rate(CAMERA, flow, where)
    np.testing.assert_allclose(found, rate, rtol=0, atol=2e-4)  # rad/s


def test_errors_of_known_rates(left: Streams) -> None:
    """Rates that are off by 1 deg/s about x; a gyroscope whose bias is found but for 0.2 deg/s about z."""
    gyroscope = Gyroscope.of(left)
    assert 0.5 < np.degrees(np.linalg.norm(gyroscope.bias)) < 12.0
    ends = np.array([0, 40_000, 80_000])
    true = true_rates(gyroscope.trajectory, ends)
    off = np.radians([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    bias = gyroscope.bias + np.radians([0.0, 0.0, 0.2])
    errors = rate_errors(Rates(ends, true.rates + off), bias, gyroscope)
    assert errors["rate_error"] == pytest.approx(1.0, abs=1e-9)  # deg/s
    assert errors["drift"] == pytest.approx(1.0, abs=1e-3)
    assert errors["bias_error"] == pytest.approx(0.2, abs=1e-9)
    # 0.1 s of 0.2 deg/s, and noise of 0.007 deg/s/sqrt(Hz)
    assert errors["gyroscope_angle"] == pytest.approx(0.02, abs=0.01)  # deg
    alternating = Rates(ends, true.rates + off * [[1.0], [-1.0]])
    both = rate_errors(alternating, bias, gyroscope)
    assert both["rate_error"] == pytest.approx(1.0, abs=1e-9)
    assert both["drift"] < 0.01


def test_the_gyroscope_is_the_truth_and_its_bias(left: Streams) -> None:
    gyroscope = Gyroscope.of(left)
    ends = np.array([0, 50_000, 100_000])
    difference = gyroscope.mean_rates(ends) - true_rates(gyroscope.trajectory, ends).rates
    # Noise of 0.1 deg/s in each of ten samples
    np.testing.assert_allclose(
        np.degrees(difference), np.degrees([gyroscope.bias] * 2), rtol=0, atol=0.15
    )


def test_rates_from_events_of_a_small_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Events turn to turn find the rate of a handheld camera; the search is replaced by a known answer."""
    condition = Condition(
        width=128, height=96, duration_s=0.1, trajectory="handheld", seed=1, rpm=1440.0
    )
    streams = Streams(condition, setup=Setup(None, 1400.0, 0.0))
    known = amiwarp.CameraRotation((0.1, 0.2, 0.3))
    monkeypatch.setattr(inertial, "estimate_rotation", lambda events, camera: known)
    values = inertial.measure(streams, QUICK)
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    rows = {(row["stream"], row["turns"]): row for row in values["rows"]}
    sources = {Stream.PLAIN.value, Stream.TRUE.value, *OTHER_SOURCES}
    assert set(rows) == {
        *((name, turns) for name in sources for turns in inertial.TURNS),
        (inertial.TURN_TO_TURN, 1.0),
    }
    nothing = rows[inertial.NO_MOTION, 1.0]["rate_error"]
    assert nothing > 2.0  # deg/s: what the camera turns
    assert rows[inertial.TURN_TO_TURN, 1.0]["rate_error"] < 0.5 * nothing
    assert rows[inertial.TRUE_FLOW, 1.0]["rate_error"] < 0.3 * nothing
    assert rows[Stream.PLAIN.value, 0.5]["rate_error"] > math.degrees(0.2)
    gyroscope = rows[inertial.GYROSCOPE, 1.0]
    assert gyroscope["rate_error"] == pytest.approx(gyroscope["bias_error"], abs=0.15)
    assert gyroscope["gyroscope_angle"] == pytest.approx(0.1 * gyroscope["bias_error"], rel=0.1)


OTHER_SOURCES = (inertial.GYROSCOPE, inertial.TRUE_FLOW, inertial.NO_MOTION)


def inertial_cell(seed: int, errors: dict[str, float]) -> CellResult:
    rows = []
    for turns in inertial.TURNS:
        for stream, error in errors.items():
            row = {
                "rate_error": error,
                "drift": error,
                "bias_error": error,
                "gyroscope_angle": error,
            }
            rows.append({"stream": stream, "turns": turns, **row})
    return CellResult("inertial", Condition(trajectory="still", seed=seed), {"rows": rows})


def test_rates_are_judged_by_source() -> None:
    cells = []
    for seed in (1, 2, 3):
        shift = 0.01 * seed
        errors = {
            Stream.CALIBRATED.value: 0.2 + shift,
            inertial.TURN_TO_TURN: 0.8 + shift,
            Stream.PLAIN.value: 0.6 + shift,
            inertial.GYROSCOPE: 3.0,
        }
        cells.append(inertial_cell(seed, errors))
    verdicts = [claim.verdict for claim in inertial.claims(cells)]
    good, bad, none = Verdict.REPRODUCED, Verdict.NOT_REPRODUCED, Verdict.NOT_TESTABLE
    assert verdicts == [good, good, good, bad, bad, good, *[none] * 12]
    rate, bias, over_length = inertial.tables(cells)
    assert len(rate.rows) == len(bias.rows) == 4
    assert len(over_length.rows) == 8
    assert {claim.number for claim in inertial.claims(cells)} == {None}
