"""Evaluations of motion, pictures and pose: known motion of events, and a small world with a body that moves."""

import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from amiwarp import (
    Body,
    Camera,
    CameraRotation,
    Events,
    ExactModel,
    Material,
    Mesh,
    Prism,
    PrismMotion,
    Simulation,
    Trajectory,
    World,
    WorldScene,
)
from amiwarp.simulation.worlds.trajectory import looking_at
from amiwarp.studies.evaluate import (
    QUICK,
    CellResult,
    Condition,
    Frames,
    Setup,
    Stream,
    Streams,
    Table,
    Verdict,
    camera_motion,
    flow,
    flow_error,
    moving_bodies,
    optical_flow,
    overlaps,
    pictures,
    pose,
    segmentation,
)
from amiwarp.studies.evaluate.camera_motion import estimate_rotation, rotated_back
from amiwarp.studies.evaluate.joints import PROPORTIONS
from amiwarp.studies.evaluate.moving_bodies import SegmentationSettings, moving_events
from amiwarp.studies.evaluate.optical_flow import flow_by_contrast, flow_by_dis, rotation_flow

CAMERA = Camera.from_fov(160, 120, math.radians(40.0))
RPM, DURATION_S = 1800.0, 0.05


def texture(seed: int, cells: int) -> NDArray[np.float32]:
    image = gaussian_filter(
        np.random.default_rng(seed).normal(size=(cells, cells)), 1.0, mode="wrap"
    )
    return np.asarray(image > 0.0, np.float32) * np.float32(0.8) + np.float32(0.1)


def panel(
    name: str, centre: Any, side: float, seed: int, cells: int, path: Trajectory | None = None
) -> Body:
    x, y, z = centre
    half = side / 2.0
    corners = [
        [x - half, y, z - half],
        [x + half, y, z - half],
        [x + half, y, z + half],
        [x - half, y, z + half],
    ]
    mesh = Mesh(corners, [[0, 1, 2], [0, 2, 3]], [[0, 0], [1, 0], [1, 1], [0, 1]])
    return Body(name, mesh, Material(1.0, texture(seed, cells)), path)


class FewStreams(Streams):
    """Streams without calibration, for which the recording is too short, and without that of equal count."""

    setup = Setup(None, 0.0, 0.0)
    names = (Stream.PLAIN, Stream.TRUE, Stream.RAW)


def joints() -> dict[str, Trajectory]:
    """Joints in the proportions of a standing figure that moves with the board, 0.5 m wide and 0.7 m high."""
    ends = {name: (0.5 * u - 0.45, 3.0, 0.35 - 0.7 * v) for name, (u, v) in PROPORTIONS.items()}
    none = Rotation.identity().as_quat()
    return {
        name: Trajectory([0.0, 0.05], [at, np.add(at, (0.3, 0.0, 0.0))], [none, none])
        for name, at in ends.items()
    }


@pytest.fixture(scope="module")
def streams() -> FewStreams:
    """A board that moves at 6 m/s before a wall, seen by a camera that pans at 0.3 rad/s."""
    none = Rotation.identity().as_quat()
    path = Trajectory([0.0, 0.05], [[-0.2, 0.0, 0.0], [0.1, 0.0, 0.0]], [none, none])
    bodies = (
        panel("wall", (0.0, 5.0, 0.0), 12.0, 1, 220),
        panel("board", (0.0, 3.0, 0.0), 0.7, 2, 60, path),
    )
    pan = [
        Rotation.from_rotvec([0.0, 0.0, -0.3 * t]) * looking_at((0, 0, 0), (0, 1, 0))
        for t in (0.0, 0.05)
    ]
    camera = Trajectory([0.0, 0.05], np.zeros((2, 3)), [turn.as_quat() for turn in pan])
    simulation = Simulation(
        WorldScene(World("board", bodies, ambient=1.0, joints=joints()), camera, motion_px=2.0), CAMERA,
        Prism(math.radians(0.5)), DURATION_S, motion=PrismMotion(RPM), seed=1,
    )  # fmt: skip
    condition: Any = SimpleNamespace(
        simulation=lambda device: simulation, rpm=RPM, seed=1, trajectory="handheld"
    )
    return FewStreams(condition)


def line_events(velocity: tuple[float, float], seconds: float = 0.04, count: int = 6000) -> Events:
    """Events of random points in the image that move at a velocity [px/s]."""
    rng = np.random.default_rng(5)
    points = rng.uniform((10.0, 10.0), (150.0, 110.0), (150, 2))[rng.integers(0, 150, count)]
    t = np.sort(rng.integers(0, round(seconds * 1e6), count))
    xy = (points + np.outer((t - seconds * 5e5) * 1e-6, velocity)).astype(np.float32)
    return Events(xy[:, 0].copy(), xy[:, 1].copy(), t, rng.integers(0, 2, count).astype(np.uint8))


def test_events_rotate_back_onto_their_points() -> None:
    still = line_events((0.0, 0.0))
    middle = int(still.t[0] + still.t[-1]) // 2
    there = CameraRotation((0.4, -0.6, 0.9), middle_us=middle)
    back = CameraRotation((-0.4, 0.6, -0.9), middle_us=middle)
    again = rotated_back(rotated_back(still, CAMERA, there), CAMERA, back)
    np.testing.assert_allclose(again.x, still.x, rtol=0, atol=1e-3)  # px
    found = estimate_rotation(rotated_back(still, CAMERA, back), CAMERA)
    # Rad/s: 0.5 px in 40 ms
    np.testing.assert_allclose(found.angular_velocity, (0.4, -0.6, 0.9), rtol=0, atol=0.06)


def test_rotation_flow_is_the_motion_of_rotated_events() -> None:
    rotation = CameraRotation((0.4, -0.6, 0.9))
    field = rotation_flow(CAMERA, rotation)
    pixel = Events.from_arrays([30, 30], [70, 70], [-500, 500], [1, 1])
    back = rotated_back(pixel, CAMERA, rotation)  # against the flow
    np.testing.assert_allclose(
        field[70, 30] * 1e-3, [back.x[0] - back.x[1], back.y[0] - back.y[1]], rtol=0, atol=1e-3
    )


def test_no_events_give_no_motion() -> None:
    assert not estimate_rotation(Events.empty(), CAMERA).moves
    assert not flow_by_contrast(Events.empty(), CAMERA).any()
    assert [m.shape for m in moving_events(Events.empty(), CAMERA, [SegmentationSettings()])] == [
        (0,)
    ]


@pytest.mark.parametrize("velocity", [(60.0, 0.0), (-30.0, 45.0)])
def test_flow_of_a_known_shift(velocity: tuple[float, float]) -> None:
    """Endpoint errors in pixels over the window of 40 ms, in which points move by about 2 px."""
    truth = np.broadcast_to(np.array(velocity), (120, 160, 2))
    inside = np.zeros((120, 160), np.bool_)
    inside[20:100, 20:140] = True
    contrast = flow_by_contrast(line_events(velocity), CAMERA)
    assert flow_error(contrast * 0.04, truth * 0.04, inside).epe < 0.35
    points = np.random.default_rng(6).uniform(0.0, (160.0, 120.0), (400, 2)).repeat(5, axis=0)
    now = Events.from_arrays(*points.astype(np.float32).T, np.zeros(2000), np.ones(2000))
    shifted = (points + 0.04 * np.array(velocity)).astype(np.float32)
    later = Events.from_arrays(*shifted.T, np.zeros(2000), np.ones(2000))
    dis = flow_by_dis(now, later, (160, 120), 0.04)
    assert flow_error(dis * 0.04, truth * 0.04, inside).epe < 0.35


def test_true_rotation_is_found_behind_the_prism(streams: Streams) -> None:
    found = estimate_rotation(streams.window(Stream.TRUE, 5_000, 45_000), streams.camera)
    turns = streams.simulation.scene.trajectory.poses([0.0, 0.05])[0]  # type: ignore[union-attr]
    truth = Rotation.from_matrix(turns[0].T @ turns[1]).as_rotvec() / 0.05
    error_px = (
        np.abs(np.subtract(found.angular_velocity, truth))
        * 0.04
        * [CAMERA.fx, CAMERA.fx, CAMERA.width / 2.0]
    )
    np.testing.assert_array_less(error_px, 0.5)  # px at the border within 40 ms


def check_tables(evaluation: Any, values: dict[str, Any]) -> None:
    """Check that an evaluation's values are JSON, and make consistent tables and no verdict without calibration."""
    values = json.loads(json.dumps(values, allow_nan=False))
    results = [CellResult(evaluation.__name__, Condition("person"), values)]
    for table in evaluation.tables(results):
        assert isinstance(table, Table)
        assert table.rows
        assert {len(row) for row in table.rows} == {len(table.columns)}
        chart = table.chart
        if chart is not None:
            assert {chart.x, chart.y, chart.series, chart.spread, *chart.panels} <= {
                None,
                *table.columns,
            }
    assert {claim.verdict for claim in evaluation.claims(results)} <= {
        Verdict.NOT_TESTABLE,
        Verdict.UNDECIDED,
    }
    assert (
        evaluation.tables([CellResult(evaluation.__name__, Condition(), {}, "failed")])[0].rows
        == []
    )
    assert all(isinstance(condition, Condition) for condition in evaluation.conditions(QUICK))


@pytest.mark.slow
def test_the_board_is_segmented_in_each_stream(
    streams: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(segmentation, "VARIED", {"gain": ()})
    values = segmentation.measure(streams, QUICK)
    check_tables(segmentation, values)
    assert {row["budget"] for row in values["rows"]} == {"own", "equal"}
    own = {row["stream"]: row for row in values["rows"] if row["budget"] == "own"}
    assert set(own) == {Stream.PLAIN, Stream.TRUE, Frames.FAST}
    assert min(own[stream]["iou"] for stream in (Stream.PLAIN, Stream.TRUE)) > 0.5
    assert own[Frames.FAST]["object_iou"] > 0.5


def test_a_body_is_found_in_the_flow_of_a_rotating_camera() -> None:
    rotation = CameraRotation((0.3, -0.2, 0.5))
    given = optical_flow.rotation_flow(CAMERA, rotation)
    assert not moving_bodies.moving_pixels(given, CAMERA, 0.02).any()
    body = np.zeros(given.shape[:2], np.bool_)
    body[30:60, 50:90] = True
    given[body] += (120.0, -60.0)  # px/s: 2.7 px in the window
    np.testing.assert_array_equal(moving_bodies.moving_pixels(given, CAMERA, 0.02), body)
    assert overlaps.best_ious([body], [body, ~body]) == [1.0, body.mean()]


@pytest.mark.slow
def test_flow_of_still_objects(streams: Streams, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall moves by 0.4 px per window; the board, which moves by more than 2 px, is left out."""
    monkeypatch.setattr(flow, "QUICK_TURNS", (0.25,))
    values = flow.measure(streams, QUICK)
    check_tables(flow, values)
    errors = {
        (row["stream"], row["method"]): row["epe"]
        for row in values["rows"]
        if row["pixels"] == "edges"
    }
    zero = {errors.pop((flow.ZERO, method)) for method in flow.METHODS}
    assert all(0.2 < error < 0.6 for error in zero)  # px
    assert set(errors) == {
        (s, m) for s in streams.names for m in ("DIS", "contrast maximisation")
    } | {(Frames.FAST, "DIS")}
    assert errors[Frames.FAST, "DIS"] < 0.3  # px
    assert errors[Stream.PLAIN, "DIS"] < 0.6  # px
    assert all(errors[Stream.RAW, method] > errors[Stream.PLAIN, method] for _, method in errors)


def test_pose_over_the_rate_of_pictures(streams: Streams, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose, "RATES_HZ", (100.0,))
    monkeypatch.setattr(camera_motion, "MOST_EVENTS", 5_000)
    shapes: list[tuple[int, ...]] = []

    def detect(image: NDArray[Any]) -> dict[str, NDArray[np.float64]]:
        shapes.append(image.shape)
        (window,) = pose.windows(streams, 100.0, 1)
        return pose.image_joints(streams, window.end_us)

    values = pose.measure(streams, QUICK, {"perfect": detect})
    check_tables(pose, values)
    perfect = [row for row in values["rows"] if row["detector"] == "perfect"]
    assert shapes == [(CAMERA.height, CAMERA.width)] * 3
    assert perfect[0]["pdj"] == 1.0  # as soon as the picture is complete
    assert perfect[0]["iou"] > perfect[2]["iou"]  # and later the figure has moved


def test_a_learned_reconstruction_is_judged_next_to_ours(
    streams: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "QUICK_PICTURES", 1)
    monkeypatch.setattr(pictures, "QUICK_TURNS", (pictures.STANDARD_TURNS,))
    monkeypatch.setattr(camera_motion, "MOST_EVENTS", 5_000)
    given: list[Events] = []

    def perfect(events: Events) -> NDArray[np.float64]:
        given.append(events)
        (window,) = pictures.windows(streams, pictures.STANDARD_TURNS, 1)
        return np.asarray(
            3.0
            * np.log(streams.frame(window.middle_us).intensity.astype(np.float64) + pictures.DARK)
        )

    values = pictures.measure(streams, QUICK, {"perfect": perfect})
    check_tables(pictures, values)
    scores = {(row["method"], row["stream"]): row["ssim"] for row in values["time"]}
    assert scores["perfect", Stream.TRUE] == pytest.approx(1.0, abs=1e-6)
    assert scores["own", Stream.TRUE] > scores["own", Stream.RAW]
    assert {events.x.dtype for events in given} == {np.dtype(np.float32), np.dtype(np.uint16)}


def test_a_camera_that_sees_nothing_has_a_uniform_picture_without_a_score() -> None:
    still = Streams(
        Condition(width=64, height=48, duration_s=0.1, trajectory="still"),
        setup=Setup(None, 200.0, 0.0),
    )
    (window,) = pictures.windows(still, pictures.STANDARD_TURNS, 1)
    for stream in (Stream.PLAIN, Stream.RAW):
        (picture,) = pictures.PictureMaker(still, stream).pictures([window])
        assert np.ptp(picture) == 0.0
        assert pictures.naturalness(picture) is None
    (picture,) = pictures.PictureMaker(still, Stream.TRUE).pictures([window])
    assert np.ptp(picture) > 1.0


def test_the_best_window_is_chosen_among_pictures_that_have_a_score() -> None:
    known = {"scene": "room", "stream": Stream.PLAIN}
    rows = [{**known, "camera": camera, "seed": seed, "turns": turns, "niqe": niqe}
            for camera, turns, niqe in (("still", 0.25, None), ("fast", 0.25, 6.0), ("fast", 0.5, 5.0))
            for seed in (1, 2)]  # fmt: skip
    assert [row["niqe"] for row in pictures._best_lengths(rows, "niqe")] == [5.0, 5.0]


def test_pose_of_a_perfect_detector(streams: Streams) -> None:
    """The true joints of the instant score 1, and joints of another instant less."""
    now, later = (pose.image_joints(streams, t) for t in (10_000, 20_000))
    assert pose.pose_scores(now, now) == (dict.fromkeys(pose.FRACTIONS, 1.0), pytest.approx(1.0))
    pdj, iou = pose.pose_scores(later, now)
    assert pdj[pose.FRACTIONS[0]] < pdj[pose.FRACTIONS[-1]]
    assert iou is not None
    assert iou < 1.0
    assert pose.pose_scores({}, now) == (dict.fromkeys(pose.FRACTIONS, 0.0), 0.0)
    hidden = {**now, "left shoulder": np.full(2, np.nan)}
    assert pose.pose_scores(now, hidden) == (dict.fromkeys(pose.FRACTIONS), None)


def test_true_joints_project_to_their_pixels(streams: Streams) -> None:
    """The head, by the pinhole formula in float64."""
    scene: Any = streams.simulation.scene
    (turn,), (place,) = scene.trajectory.poses([0.02])
    local = (scene.world.joints["head"].poses([0.02])[1][0] - place) @ turn
    expected = [
        CAMERA.fx * local[0] / local[2] + CAMERA.cx,
        CAMERA.fy * local[1] / local[2] + CAMERA.cy,
    ]
    found = pose.image_joints(streams, 20_000)["head"]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)  # px


def test_windows_of_pictures_follow_their_rate(streams: Streams) -> None:
    (one,) = pose.windows(streams, 100.0, 1)
    assert one.end_us - one.start_us == 10_000
    shortest = pose.windows(streams, 1000.0, 3)
    assert {w.end_us - w.start_us for w in shortest} == {round(0.25 * 60e6 / RPM)}
    assert pose.windows(streams, 10.0, 1) == []
    over_time = pictures.windows(streams, 0.25, 4)
    assert np.diff([w.middle_us for w in over_time]).tolist() == [1000] * 3
    assert isinstance(streams.true_model, ExactModel)
