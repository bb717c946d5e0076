"""Lens calibration from a board: corners, fit, still spans, and the whole way from recordings to a camera."""

import json
import math
import os
import re
import signal
import threading
import time
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import amiwarp
from amiwarp import Corners, Reconstruction
from amiwarp.lens import calibration, corner_fit, joint_prism
from amiwarp.lens import commands as lens_command
from amiwarp.lens import live as lens_live
from amiwarp.lens.corner_fit import fit_lens
from amiwarp.lens.corner_match import match_corners
from amiwarp.lens.joint_prism import JointPrism
from amiwarp.lens.live import StillSpans
from amiwarp.lens.poses import Pose, still_poses
from amiwarp.lens.projection import first_pose
from amiwarp.live.commands.session import stopped_by_interrupt
from amiwarp.live.stream import recent_events
from amiwarp.results import make_space
from tests.command_line import app
from tests.live.test_stream_returning import LONG_S

BOARD = amiwarp.Board(6, 5, 0.03)
CAMERA = amiwarp.Camera(
    320, 240, 262.0, 261.0, 163.0, 117.0, amiwarp.RadialTangential(k1=-0.1, k2=0.02)
)
ROUGH = amiwarp.Camera.from_fov(320, 240, 2.0 * math.atan(160.0 / 240.0))
FISHEYE = amiwarp.Camera(320, 240, 150.0, 150.5, 161.0, 118.0, amiwarp.Fisheye(-0.02, 0.004))
PRISM, PHASE = amiwarp.Prism(math.radians(1.0)), 0.7


def placed(
    rng: np.random.Generator,
    camera: amiwarp.Camera,
    count: int,
    tilt: tuple[float, float],
    away: float = 1.0,
) -> list[tuple]:
    """Return orientations and middles [m] of boards that lie wholly in the image, ``away`` times as far as usual."""
    out: list[tuple] = []
    half = BOARD.points.max(axis=0) / 2.0
    while len(out) < count:
        ray = np.asarray(
            camera.pixels_to_rays(rng.uniform([60, 50], [260, 190])[None]), np.float64
        )[0]
        middle = ray / ray[2] * rng.uniform(0.25, 0.42) * away
        turn, about = math.radians(rng.uniform(*tilt)), rng.uniform(0.0, math.tau)
        rotation = Rotation.from_rotvec([turn * math.cos(about), turn * math.sin(about), 0.0])
        xy = corners_of(camera, rotation, middle - rotation.apply(half)).xy
        if (xy > 8).all() and (xy < [311, 231]).all():
            out.append((rotation, middle))
    return out


def corners_of(camera: amiwarp.Camera, rotation: Rotation, origin: NDArray[np.float64]) -> Corners:
    """Return the true corners of a board whose first corner is at ``origin`` [m]."""
    points = rotation.apply(BOARD.points) + origin
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return Corners(np.arange(len(points)), np.asarray(camera.rays_to_pixels(rays), np.float64))


def seen(
    seed: int,
    camera: amiwarp.Camera,
    *,
    noise: float,
    tilt: tuple[float, float] = (10, 40),
    away: float = 1.0,
) -> list[Corners]:
    rng = np.random.default_rng(seed)
    half = BOARD.points.max(axis=0) / 2.0
    true = [corners_of(camera, r, m - r.apply(half)) for r, m in placed(rng, camera, 8, tilt, away)]
    return [replace(c, xy=c.xy + rng.normal(0.0, noise, c.xy.shape)) for c in true]


@pytest.mark.parametrize(
    "camera", [CAMERA, FISHEYE, replace(CAMERA, distortion=None)], ids=["bent", "fisheye", "plain"]
)
def test_corners_give_the_lens_within_its_deviations(camera: amiwarp.Camera) -> None:
    start = replace(ROUGH, fx=0.9 * camera.fx, fy=0.9 * camera.fx)
    if isinstance(camera.distortion, amiwarp.Fisheye):
        start = replace(start, distortion=amiwarp.Fisheye())
    ratios = []
    for seed in range(5):
        fit = fit_lens(start, BOARD, seen(seed, camera, noise=0.05))
        ratios += [
            (getattr(fit.camera, n) - getattr(camera, n)) / fit.deviations[n]
            for n in ("fx", "fy", "cx", "cy")
        ]
        assert ("k1" in fit.left_out) == (camera.distortion is None)
        assert "k3" in fit.left_out
        assert math.sqrt(fit.cost / fit.freedom) == pytest.approx(0.05, rel=0.15)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_deviations_hold_errors_that_the_corners_of_a_pose_share() -> None:
    ratios = []
    for seed in range(5):
        rng, corners = np.random.default_rng(seed), []
        for each in seen(seed, CAMERA, noise=0.005):
            u, v = (BOARD.points[each.ids][:, :2] / BOARD.points.max() - 0.4).T
            bent = np.stack([u * u, u * v, v * v, u**3, v**3], axis=1) @ rng.normal(
                0.0, 0.06, (5, 2)
            )
            corners.append(replace(each, xy=each.xy + bent))
        fit = fit_lens(ROUGH, BOARD, corners)
        ratios += [
            (getattr(fit.camera, n) - getattr(CAMERA, n)) / fit.deviations[n]
            for n in ("fx", "fy", "cx", "cy")
        ]
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_only_events_for_which_the_lens_is_known_determine_the_prism() -> None:
    wide = calibration.first_camera((320, 240), None, math.radians(120.0), fisheye=True)
    work = calibration.LensWork(BOARD, wide, [], "cpu", lambda *_: None)
    y, x = np.indices((240, 320))
    angle = np.hypot(x - 159.5, y - 119.5) / wide.fx
    assert work.inside[angle < math.radians(44.9)].all()
    assert not work.inside[angle > math.radians(45.1)].any()
    assert calibration.LensWork(
        BOARD, ROUGH, [], "cpu", lambda *_: None
    ).inside.all()  # 67 deg across
    corners = Corners(
        np.arange(4), np.array([[50.0, 40.0], [200.0, 60.0], [190.0, 180.0], [60.0, 170.0]])
    )
    between = work._between({"pose": corners})
    assert between[100, 100]
    assert between[180, 190]
    assert not between[100, 210]
    assert not between[45, 150]  # above the line from the first corner to the second


def test_a_corner_far_off_hardly_counts() -> None:
    corners = seen(3, CAMERA, noise=0.05)
    corners[4].xy[7] += 5.0
    fit = fit_lens(ROUGH, BOARD, corners)
    assert abs(fit.camera.fx - CAMERA.fx) < 4.0 * fit.deviations["fx"]
    assert np.abs(fit.residuals[4][7]).min() > 4.0


def test_the_pose_of_a_board_is_found() -> None:
    corners = corners_of(
        CAMERA, Rotation.from_rotvec([0.3, -0.2, 0.1]), np.array([-0.05, -0.06, 0.35])
    )
    assert first_pose(CAMERA, BOARD, corners) == pytest.approx(
        [0.3, -0.2, 0.1, -0.05, -0.06, 0.35], abs=1e-4
    )


def photographed(board: amiwarp.Board) -> NDArray[np.uint8]:
    """Return a picture of a board in front of a grey wall, slightly turned."""
    flat = board.picture(24)
    height, width = flat.shape
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    to = np.float32([[40, 30], [270, 50], [260, 210], [50, 200]])
    place = cv2.getPerspectiveTransform(corners, to)
    return np.asarray(
        cv2.GaussianBlur(cv2.warpPerspective(flat, place, (320, 240), borderValue=128), (0, 0), 0.8)
    )


def test_a_board_is_found_and_its_absence_explained() -> None:
    picture = photographed(BOARD)
    found = BOARD.find(picture)
    assert found is not None
    assert len(found.ids) == 30
    assert not BOARD.has_another(picture, found)
    assert "8 x 6 inner corners" not in BOARD.missing(np.full((240, 320), 128, np.uint8))
    assert (
        BOARD.missing(np.full((240, 320), 128, np.uint8))
        == "a board of 6 x 5 inner corners is not seen"
    )
    squares = amiwarp.Board(7, 6, 0.03).missing(picture)
    assert (
        squares
        == "a board of 6 x 5 inner corners is seen, not of 7 x 6; count the inner corners, not the squares"
    )
    other = amiwarp.Board(12, 4, 0.03)
    assert other.missing(picture) == "a board of 6 x 5 inner corners is seen, not of 12 x 4"
    upright = amiwarp.Board(6, 7, 0.03).missing(picture)
    assert (
        upright
        == "a board of 5 x 6 inner corners is seen, not of 6 x 7; count the inner corners, not the squares"
    )
    noise = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8), (0, 0), 3.0
    )
    assert other.missing(np.asarray(noise)) == "a board of 12 x 4 inner corners is not seen"


def steep_picture(
    board: amiwarp.Board, turn: Rotation, middle: list[float]
) -> tuple[NDArray[np.uint8], NDArray]:
    """Return a noisy picture of a board behind a lens of 520 px, 640 x 480, and its true corners [px]."""
    side = board.square_m
    left, right, bottom = -2.0 * side, (board.columns + 1) * side, (board.rows + 1) * side
    edges = np.array(
        [[left, left, 0.0], [right, left, 0.0], [right, bottom, 0.0], [left, bottom, 0.0]]
    )

    def seen_at(points: NDArray[np.float64]) -> NDArray[np.float64]:
        there = turn.apply(points - board.points.max(axis=0) / 2.0) + middle
        return there[:, :2] / there[:, 2:] * 520.0 + [319.5, 239.5]

    flat, fine = board.picture(40), 4
    height, width = flat.shape
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    place = cv2.getPerspectiveTransform(
        corners, np.float32(seen_at(edges) * fine + 0.5 * (fine - 1))
    )
    large = cv2.warpPerspective(flat, place, (640 * fine, 480 * fine), borderValue=128)
    picture = cv2.GaussianBlur(
        cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA), (0, 0), 0.8
    )
    noisy = 30.0 + 0.7 * picture + np.random.default_rng(0).normal(0.0, 10.0, picture.shape)
    return np.clip(noisy, 0.0, 255.0).astype(np.uint8), seen_at(board.points)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_steep_board_with_small_squares_is_found(
    monkeypatch: pytest.MonkeyPatch, mirrored: bool
) -> None:
    """OpenCV's detector of corners does not find it. ``mirrored``: the other one numbers it as in a mirror."""
    board = amiwarp.Board(9, 6, 0.03)
    about = math.radians(245.9)
    tilt = Rotation.from_rotvec(
        math.radians(53.2) * np.array([math.cos(about), math.sin(about), 0.0])
    )
    turn = tilt * Rotation.from_rotvec([0.0, 0.0, math.radians(34.4)])
    picture, true = steep_picture(board, turn, [0.119, 0.023, 0.456])
    detect = cv2.findChessboardCorners

    def in_a_mirror(*given: object, **flags: object) -> tuple[bool, NDArray[np.float32]]:
        _, corners = detect(*given, **flags)
        return True, corners.reshape(6, 9, 2)[:, ::-1].reshape(54, 1, 2).copy()

    if mirrored:
        monkeypatch.setattr(cv2, "findChessboardCorners", in_a_mirror)
    found = board.find(picture)
    assert found is not None
    # Either end may be the first
    known = true if np.linalg.norm(found.xy[0] - true[0]) < 20.0 else true[::-1]
    assert np.abs(found.xy - known).max() < 0.4


def test_a_charuco_board_is_found_in_parts_and_not_in_a_mirror() -> None:
    board = amiwarp.Board(6, 5, 0.03, "DICT_4X4_50")
    picture = cv2.resize(photographed(board), (960, 720))
    whole = board.find(picture)
    assert whole is not None
    picture[:, :300] = 128
    part = board.find(picture)
    assert part is not None
    assert 6 <= len(part.ids) < len(whole.ids) <= 30
    np.testing.assert_allclose(part.xy, whole.xy[np.isin(whole.ids, part.ids)], atol=0.5)
    mirror = np.ascontiguousarray(cv2.resize(photographed(board), (960, 720))[:, ::-1])
    assert board.find(mirror) is None
    assert (
        board.missing(mirror)
        == "the board is seen in a mirror image; flip the picture of the sensor"
    )


@pytest.mark.parametrize("charuco", [None, "DICT_4X4_50"])
def test_matched_corners_are_better_by_far_than_detected_ones(charuco: str | None) -> None:
    """A rendered frame: bent lens, blur, pixel noise, and one corner that is covered."""
    board = replace(BOARD, charuco=charuco)
    pose = np.array([0.3, -0.25, 0.1, -0.07, -0.06, 0.27])
    true = corners_of(CAMERA, Rotation.from_rotvec(pose[:3]), pose[3:])
    flat, fine = board.picture(40), 4
    x, y = ((np.arange(fine * n) + 0.5) / fine - 0.5 for n in (320, 240))
    rays = np.asarray(
        CAMERA.pixels_to_rays(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)), np.float64
    )
    turn = Rotation.from_rotvec(pose[:3])
    normal = turn.apply([0.0, 0.0, 1.0])
    at = (
        turn.inv().apply(rays * ((pose[3:] @ normal) / (rays @ normal))[:, None] - pose[3:])
        / board.square_m
    )
    u, v = (
        ((at[:, k] + 2.0) * 40 - 0.5).reshape(240 * fine, -1).astype(np.float32) for k in (0, 1)
    )
    sampled = cv2.remap(flat, u, v, cv2.INTER_LINEAR, borderValue=255).astype(float)
    picture = cv2.GaussianBlur(sampled.reshape(240, fine, 320, fine).mean(axis=(1, 3)), (0, 0), 0.7)
    rng = np.random.default_rng(1)
    picture = np.clip(
        40.0 + 0.6 * picture + rng.normal(0.0, 6.0, picture.shape), 0.0, 255.0
    ).astype(np.uint8)
    hidden = np.rint(true.xy[8]).astype(int)
    found = board.find(picture)
    assert found is not None
    picture[hidden[1] - 12 : hidden[1] + 13, hidden[0] - 12 : hidden[0] + 13] = 90
    flipped = np.linalg.norm(found.xy[0] - true.xy[found.ids[0]]) > 20.0
    found = replace(found, xy=found.xy[::-1]) if flipped else found
    rough = replace(
        CAMERA,
        fx=CAMERA.fx * 1.01,
        fy=CAMERA.fx * 1.01,
        distortion=amiwarp.RadialTangential(k1=-0.08),
    )
    matched = match_corners(picture, board, found, rough, first_pose(rough, board, found))
    seen = found.ids != 8
    before, after = (np.sqrt(np.mean((c.xy - true.xy[c.ids])[seen] ** 2)) for c in (found, matched))
    assert after < 0.02
    assert after < 0.4 * before
    assert np.abs(matched.xy - found.xy).max() < 1.5  # a covered corner stays near its place


@pytest.mark.parametrize(("scatter", "bend"), [(0.0, 1.0), (0.01, 1.0), (0.0, 0.0)])
def test_the_index_is_where_the_cost_of_the_poses_is_least(
    monkeypatch: pytest.MonkeyPatch, scatter: float, bend: float
) -> None:
    """Costs with a minimum at an index of 1.57, which differs between poses by ``scatter``; or flat ones."""
    least = 1.57 + scatter * np.random.default_rng(2).standard_normal(12)
    maps = SimpleNamespace(copy_unknowns=lambda: "map")
    replaced: list[object] = []
    cost = SimpleNamespace(brightness=maps, replace_map=replaced.append)
    equations = {str(k): SimpleNamespace(cost=cost) for k in range(12)}
    values = {"apex": 0.0175, "index": 1.5168}
    joint = JointPrism.start(equations, SimpleNamespace(start={}), values)
    sizes = []
    began = []

    def refine(fit: JointPrism, *_: object) -> JointPrism:
        index = fit.values["index"]
        costs = {k: 0.15 + bend * (index - least[int(k)]) ** 2 for k in fit.equations}
        sizes.append(fit.values["apex"] * (index - 1.0))
        began.append(fit.longer)
        replaced.append("fitted")
        return replace(fit, costs=costs, longer=fit.longer + 1.0).with_values(apex=1.0)

    monkeypatch.setattr(JointPrism, "refine", refine)
    index, off = joint.index(CAMERA, [*equations])
    assert joint.values == values
    assert began == [1.0, 2.0, 3.0]  # the next fit knows how much longer steps should be
    assert replaced[-13:] == ["fitted", *["map"] * 12]
    assert sizes == pytest.approx([0.0175 * 0.5168] * 3)  # the orbit stays as large
    if not bend:
        assert off == math.inf
        return
    assert index == pytest.approx(1.57, abs=1e-9 + 3.0 * off)
    assert off == pytest.approx(scatter / math.sqrt(12), rel=0.5, abs=1e-9)


def test_a_small_orbit_tells_less_of_the_index_than_its_noise_says() -> None:
    """The systematic error falls with the cube of the orbit, and the index's effect grows with the orbit."""
    fit, off = fit_lens(ROUGH, BOARD, seen(0, CAMERA, noise=0.001)), []
    for apex in (PRISM.apex, 2.0 * PRISM.apex):
        full = make_space(
            "exact", CAMERA, replace(PRISM, apex=apex), free=("apex", "phase", "index"), start={}, bounds={},
            rad_per_us=75e-6, duration_us=250e3,
        )  # fmt: skip
        off.append(JointPrism.start({}, full, {}).systematic_of_index(fit))
    assert off[0] > 0.05
    assert off[1] == pytest.approx(off[0] / 16.0, rel=0.1)
    worse = fit_lens(ROUGH, BOARD, seen(0, CAMERA, noise=0.1))
    # So does an uncertain lens
    assert JointPrism.start({}, full, {}).systematic_of_index(worse) > 2.0 * off[1]


def test_a_small_orbit_tells_less_of_its_size_than_its_noise_says() -> None:
    fit, off = fit_lens(ROUGH, BOARD, seen(0, CAMERA, noise=1e-5)), []
    for apex in (PRISM.apex, 2.0 * PRISM.apex):
        space = make_space(
            "exact", fit.camera, replace(PRISM, apex=apex), free=("apex", "phase"), start={}, bounds={},
            rad_per_us=75e-6, duration_us=250e3,
        )  # fmt: skip
        v = space.to_vector(space.start)
        found = space.deviations(v, JointPrism.start({}, space, {})._systematic(space, v, fit))
        off.append(found["apex"] / apex)
        assert found["phase"] < 0.01 * off[-1]
    in_the_middle = joint_prism.SIZE_ERROR / (CAMERA.fx * PRISM.deflection) ** 2
    assert 0.7 * in_the_middle < off[0] < in_the_middle  # farther out, orbits are larger
    assert off[1] == pytest.approx(off[0] / 4.0, rel=0.05)


@pytest.mark.parametrize("seed", [3, 7])
def test_coefficients_that_trade_against_each_other_hide_no_index(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """One coefficient of a rational lens, moved alone by its deviation, gives a lens that cannot be."""
    full = make_space(
        "exact", CAMERA, replace(PRISM, apex=2.0 * PRISM.apex), free=("apex", "phase", "index"), start={}, bounds={},
        rad_per_us=75e-6, duration_us=250e3,
    )  # fmt: skip
    off = []
    for most in (2, 3):
        monkeypatch.setattr(
            corner_fit, "_gain_is_real", lambda less, more, count, most=most: count <= most
        )
        fit = fit_lens(ROUGH, BOARD, seen(seed, CAMERA, noise=0.01))
        off.append(JointPrism.start({}, full, {}).systematic_of_index(fit))
    assert fit.deviations["k4"] > 3.0
    assert off[1] < 1.2 * off[0]


def test_a_lens_that_folds_between_the_corners_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    given, folding = seen(1, CAMERA, noise=0.01), amiwarp.RadialTangential(k1=-0.1, k2=0.02, k4=3.0)
    assert corner_fit._is_seen_through(CAMERA, given)
    assert not corner_fit._is_seen_through(replace(CAMERA, distortion=folding), given)
    monkeypatch.setattr(corner_fit, "_gain_is_real", lambda *_: True)
    monkeypatch.setattr(corner_fit, "_is_seen_through", lambda camera, _: not camera.distortion.k4)
    assert fit_lens(ROUGH, BOARD, given).left_out == ("k4", "k5", "k6")


def test_the_axes_of_a_lens_hold_its_covariance() -> None:
    fit = fit_lens(ROUGH, BOARD, seen(0, CAMERA, noise=0.05))
    steps, lengths = fit.axes(np.array([[40, 40], [280, 60], [160, 200]]))
    assert lengths == pytest.approx(1.0)  # no coefficient moves pixels far
    assert steps.T @ steps == pytest.approx(fit.covariance, rel=1e-9, abs=1e-18)


def test_two_boards_are_noticed() -> None:
    one = cv2.resize(photographed(BOARD), (240, 180))
    both = np.hstack([one, one])
    found = BOARD.find(both)
    assert found is not None
    assert BOARD.has_another(both, found)


def test_boards_that_cannot_be_are_refused() -> None:
    with pytest.raises(amiwarp.AmiwarpError, match="board columns"):
        amiwarp.Board(1, 6, 0.03)
    with pytest.raises(amiwarp.AmiwarpError, match="DICT_4X4_50"):
        amiwarp.Board(9, 6, 0.03, "DICT_5")
    with pytest.raises(amiwarp.AmiwarpError, match="has 50 markers; this board needs 60"):
        amiwarp.Board(11, 9, 0.03, "DICT_4X4_50")
    with pytest.raises(
        amiwarp.AmiwarpError, match="corners are empty; give those that find returned"
    ):
        BOARD.has_another(
            np.zeros((9, 9), np.uint8), Corners(np.zeros(0, np.int64), np.zeros((0, 2)))
        )


@pytest.mark.parametrize(
    ("charuco", "least"), [("DICT_4X4_50", 8), ("DICT_6X6_250", 10), ("DICT_7X7_250", 12)]
)
def test_the_squares_of_a_picture_show_every_cell_of_a_marker(charuco: str, least: int) -> None:
    board = amiwarp.Board(9, 6, 0.03, charuco)
    assert board.picture(least).shape == (9 * least, 12 * least)
    with pytest.raises(
        amiwarp.AmiwarpError, match=f"square_px is {least - 1}, too few for .*; give {least}"
    ):
        board.picture(least - 1)


@pytest.mark.parametrize("suffix", [".pdf", ".svg"])
def test_a_printed_board_has_its_true_size(tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"board{suffix}"
    result = CliRunner().invoke(
        app, ["board", str(out), "--board", "9x6", "--square-mm", "25", "--json"]
    )
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["width_mm"] == pytest.approx(12 * 25.0)
    if suffix == ".svg":
        width = re.search(r'<svg [^>]*width="([\d.]+)pt"', out.read_text())
        assert width is not None
        assert float(width[1]) == pytest.approx(12 * 25.0 / 25.4 * 72.0)


LIVE = ("--live", "--board", "6x5", "--fov-deg", "67", "--json")


def run_live(*args: object) -> str:
    """Run ``amiwarp lens`` that must end with an error; return what it says."""
    result = CliRunner().invoke(app, ["lens", *map(str, args)])
    assert result.exit_code == 1, result.output
    return result.stderr


def simulated(pose: tuple, seed: int, motion: float = 720.0) -> amiwarp.Recording:
    world = BOARD.world(pose[0].as_quat(), pose[1])
    scene = amiwarp.WorldScene(world, amiwarp.Trajectory.still([0, 0, 0]))
    recording = amiwarp.simulate(
        scene, CAMERA, PRISM, duration_s=0.17, motion=amiwarp.PrismMotion(motion, PHASE), seed=seed
    )
    return replace(
        recording, camera=None, name=f"pose{seed}", prism=amiwarp.Prism(1.1 * PRISM.apex)
    )


@pytest.fixture(scope="module")
def recordings() -> list[amiwarp.Recording]:
    poses = placed(np.random.default_rng(1), CAMERA, 5, (20, 35))
    return [simulated(pose, seed) for seed, pose in enumerate(poses)]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop after two passes, with a sixth of the pairs: the images are small."""
    monkeypatch.setattr(calibration, "MOST_PASSES", 2)
    monkeypatch.setattr(calibration, "PAIRS", calibration.PAIRS // 6)
    monkeypatch.setattr(calibration, "FINE_PAIRS", calibration.FINE_PAIRS // 6)


@pytest.mark.usefixtures("quick")
def test_recordings_of_a_still_board_give_lens_and_prism(
    recordings: list[amiwarp.Recording], tmp_path: Path
) -> None:
    encoder = recordings[0].encoder
    assert encoder is not None
    # Its zero is off by 10 deg
    shifted = replace(recordings[0], encoder=encoder.with_clock_offset(83333 / 36))
    names = [str(tmp_path / f"{k}.h5") for k in range(len(recordings) + 1)]
    for name, recording in zip(names, [*recordings, shifted], strict=True):
        amiwarp.save_recording(name, recording)
    camera, prism, figure = (tmp_path / name for name in ("camera.yaml", "prism.json", "lens.png"))
    outputs = [str(camera), "--calibration", str(prism), "--figure", str(figure)]
    result = CliRunner().invoke(
        app, ["lens", *names, *outputs, "--board", "6x5", "--fov-deg", "67", "--json"]
    )
    assert result.exit_code == 0, result.output
    found, data = amiwarp.load_camera(camera), json.loads(result.stdout)
    assert found.fx == pytest.approx(CAMERA.fx, rel=0.005)
    assert (found.cx, found.cy) == pytest.approx((CAMERA.cx, CAMERA.cy), abs=0.6)
    calibration = amiwarp.Calibration.load(prism)
    assert math.degrees(calibration.parameters["apex"]) == pytest.approx(1.0, rel=0.008)
    assert calibration.camera.fx == data["camera"]["fx"] == found.fx
    assert data["reprojection_px"] < 0.08
    assert list(data["left_out"]) == ["5"]
    assert "the encoder's zero changed" in data["left_out"]["5"]
    assert sum(map(sum, data["coverage"])) == 30 * len(recordings)
    assert any("record more poses" in text for text in data["advice"])
    assert cv2.imread(str(figure)).std() > 10.0


@pytest.mark.parametrize(
    ("seen_index", "systematic", "said"),
    [
        (1.6, (0.021, 0.01), None),  # pictures of the wrong index bent the lens
        (
            1.6,
            (0.021, 0.021),
            "the events prefer an index of 1.600 ± 0.022, but not with certainty: the given one",
        ),
        (1.52, (0.01, 0.01), ""),
        (1.6, (0.04, 0.01), "the index of the prism is not determined, and stays as given, 1.5168"),
    ],
)
def test_an_index_far_off_is_asked_for_with_the_lens_that_is_seen_through_it(
    monkeypatch: pytest.MonkeyPatch,
    seen_index: float,
    systematic: tuple[float, float],
    said: str | None,
) -> None:
    """``systematic``: deviation of the index that the lens causes, with the given index and with the one seen."""
    sights = [
        calibration.Sight(
            {},
            {"0": Corners(np.arange(0), np.zeros((0, 2)))},
            SimpleNamespace(off=off, camera=camera),
        )
        for off, camera in zip(systematic, (ROUGH, replace(ROUGH, fx=1.01 * ROUGH.fx)), strict=True)
    ]
    work = calibration.LensWork(BOARD, ROUGH, [], "cpu", lambda *_: None)
    joint = JointPrism.start(
        {str(k): None for k in range(12)},
        SimpleNamespace(start={}),
        {"apex": 0.0175, "index": 1.5168},
    )
    monkeypatch.setattr(work, "pictures", lambda *_, **__: {})
    monkeypatch.setattr(work, "_lens", lambda *_, **__: sights[1])
    monkeypatch.setattr(JointPrism, "model", lambda *_: None)
    monkeypatch.setattr(JointPrism, "refine", lambda fit, *_: fit)
    monkeypatch.setattr(JointPrism, "index", lambda *_: (seen_index, 0.007))
    monkeypatch.setattr(JointPrism, "systematic_of_index", lambda _, fit: fit.off)
    notes = list[str]()
    given = joint
    off, joint, sight = work._free_index(given, sights[0], notes)
    assert given.values == {"apex": 0.0175, "index": 1.5168}
    if said is None:
        assert (off, sight, work.camera, notes) == (
            math.hypot(0.007, 0.01),
            sights[1],
            sights[1].fit.camera,
            [],
        )
        assert joint.values["index"] == 1.6
        # In pixels, the orbit is as large
        assert joint.values["apex"] == pytest.approx(0.0175 * 0.5168 / 0.6 / 1.01)
        return
    assert (off, sight, work.camera) == (0.0, sights[0], ROUGH)
    assert joint.values == {"apex": 0.0175, "index": 1.5168}
    assert "".join(notes).startswith(said)
    assert len(notes) == bool(said)


def test_a_pose_that_better_pictures_show_is_not_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    corners = seen(1, CAMERA, noise=0.01)
    work = calibration.LensWork(BOARD, CAMERA, [], "cpu", lambda *_: None)
    pictures = {str(k): np.full((240, 320), k, np.uint8) for k in range(len(corners))}
    for blurred, left_out in ((2, {"2": BOARD.missing(pictures["2"])}), (None, {})):
        shown = {k: None if k == blurred else each for k, each in enumerate(corners)}
        monkeypatch.setattr(
            amiwarp.Board, "find", lambda _, picture, shown=shown: shown[int(picture[0, 0])]
        )
        work.left_out["unlit"] = "has no events"
        assert len(work._lens(pictures, matched=False).corners) == len(corners) - len(left_out)
        assert work.left_out == {"unlit": "has no events", **left_out}


@pytest.mark.parametrize("rpm", [720.0, -720.0])
def test_pictures_start_at_evenly_spread_angles(rpm: float) -> None:
    turn_us = 60e6 / 720.0
    at = amiwarp.Events.from_arrays([1, 1], [1, 1], [0, round(3 * turn_us) - 1], [0, 1])
    encoder = amiwarp.Encoder.constant_speed(
        abs(rpm), -1000, 300_000, direction=1 if rpm > 0.0 else -1
    )
    recording = amiwarp.Recording(amiwarp.MemoryEvents(at, 8, 8), None, encoder)
    for angle in (0.1, 2.0, 4.0, 6.0):
        start = calibration.window_start(recording, 1.25, turn_us, angle)
        assert math.cos(float(encoder.angle_at(np.array([start]))[0]) - angle) == pytest.approx(
            1.0, abs=1e-6
        )
        assert 0.75 * turn_us - 1.0 <= start <= 1.75 * turn_us + 1.0
    # Too short to start at that angle
    assert calibration.window_start(recording, 2.9, turn_us, 2.0) == 0


def test_corners_hardly_depend_on_the_start_of_a_picture(
    recordings: list[amiwarp.Recording],
) -> None:
    """The positions of a picture's corners at starts half a turn apart, by the length of the picture's events."""
    (rotation, middle), turn_us = (
        placed(np.random.default_rng(1), CAMERA, 5, (20, 35))[0],
        60e6 / 720.0,
    )
    true = corners_of(CAMERA, rotation, middle - rotation.apply(BOARD.points.max(axis=0) / 2.0))
    pose = first_pose(CAMERA, BOARD, true)
    work = Reconstruction(
        recordings[0],
        model=amiwarp.ExactModel(CAMERA, PRISM, PHASE),
        smoothness=calibration.SMOOTHNESS,
        with_silence=False,
        device="cpu",
    )
    moved = []
    for turns in (1.0, calibration.PICTURE_TURNS):
        xy = []
        for start in (0.2, 0.7):
            log = work.window(round(start * turn_us), round(turns * turn_us)).log
            low, high = np.percentile(log, (1.0, 99.0))
            picture = np.clip((log - low) / (high - low) * 255.0, 0.0, 255.0).astype(np.uint8)
            xy.append(match_corners(picture, BOARD, true, CAMERA, pose).xy)
        moved.append(float(np.linalg.norm(np.median(xy[1] - xy[0], axis=0))))
    assert moved[1] < 0.6 * moved[0]
    assert moved[1] < 0.03


def test_too_few_poses_and_still_prisms_are_refused(recordings: list[amiwarp.Recording]) -> None:
    with pytest.raises(amiwarp.AmiwarpError, match=r"a lens needs 4 poses .* directions; given: 3"):
        amiwarp.calibrate_lens(recordings[:3], BOARD)
    with pytest.raises(amiwarp.AmiwarpError, match="pose0: has no encoder"):
        amiwarp.calibrate_lens([replace(recordings[0], encoder=None)], BOARD)
    still = replace(recordings[0], encoder=amiwarp.Encoder.constant_speed(0.0, -1000, 200_000))
    with pytest.raises(
        amiwarp.AmiwarpError,
        match=r"prism makes 0 turns.* without it a still board gives no events",
    ):
        amiwarp.calibrate_lens([still], BOARD)
    some = [*recordings[:3], replace(recordings[3], encoder=None)]
    with pytest.raises(amiwarp.AmiwarpError, match=r"given: 3; pose3: has no encoder; record"):
        amiwarp.calibrate_lens(some, BOARD)


def test_a_moving_board_is_refused(tmp_path: Path) -> None:
    world = BOARD.world([0, 0, 0, 1], [0.0, 0.0, 0.4])
    path = amiwarp.Trajectory(
        [0.0, 0.25], [[0, 0, 0], [0.06, 0.0, 0.0]], np.tile([0, 0, 0, 1.0], (2, 1))
    )
    camera = amiwarp.Camera.from_fov(96, 72, 1.0)
    recording = amiwarp.simulate(
        amiwarp.WorldScene(world, path), camera, PRISM, duration_s=0.25, seed=1
    )
    with pytest.raises(
        amiwarp.AmiwarpError, match="no turn of the prism repeats the one before: hold the board"
    ):
        amiwarp.calibrate_lens([recording], BOARD)
    amiwarp.save_recording(tmp_path / "moving.h5", recording)
    said = run_live(tmp_path / "moving.h5", tmp_path / "camera.json", "--fast", *LIVE)
    assert "no turn of the prism repeats the one before: hold the board" in said


def test_parallel_boards_are_refused() -> None:
    with pytest.raises(
        amiwarp.AmiwarpError, match=r"do not determine the focal length.*; tilt it by 20 to 40 deg"
    ):
        fit_lens(ROUGH, BOARD, seen(5, CAMERA, noise=0.05, tilt=(0, 0.5)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_tilted_boards_far_away_are_asked_to_come_nearer(seed: int) -> None:
    """With every board as much nearer as the message says, the poses determine the focal length."""
    poses = {"noise": 0.06, "tilt": (15, 35)}
    with pytest.raises(amiwarp.AmiwarpError, match="do not determine the focal length") as caught:
        fit_lens(ROUGH, BOARD, seen(seed, CAMERA, **poses, away=2.6))
    message = (
        r"tilted by \d+ to \d+ deg and spans (\d+) % of the image; "
        r"hold it (.*) times nearer, where it spans (\d+) %"
    )
    said = re.search(message, str(caught.value))
    assert said is not None
    span, nearer, then = (float(value) for value in said.groups())
    assert then == pytest.approx(span * nearer, rel=0.1)
    fit = fit_lens(ROUGH, BOARD, seen(seed, CAMERA, **poses, away=2.6 / nearer))
    assert fit.deviations["fx"] < corner_fit.LARGEST_FOCAL_DEVIATION * fit.camera.fx


@pytest.mark.parametrize(
    ("excess", "tilt_deg", "span", "said"),
    [
        (3.0, 5, 0.5, "tilt it by 20 to 40 deg in different directions"),
        (3.0, 5, 0.2, "tilt it by 20 to 40 deg in different directions, and hold it nearer"),
        (2.0**0.8, 20, 0.2, "hold it 2.0 times nearer, where it spans 40 %, or record more poses"),
        (9.0, 20, 0.2, "hold it 4.0 times nearer, where it spans 80 %, or record more poses"),
        (2.0, 20, 0.79, "record more poses"),
    ],
)
def test_advice_follows_tilt_and_size_of_the_boards(
    excess: float, tilt_deg: float, span: float, said: str
) -> None:
    assert corner_fit._what_determines_it(excess, math.radians(tilt_deg), span) == said


@pytest.fixture(scope="module")
def moved() -> amiwarp.Recording:
    """The camera rests, moves to another place, and rests."""
    world = BOARD.world([0, 0, 0, 1], [0.0, 0.0, 0.4])
    at = [[0, 0, 0], [0, 0, 0], [0.05, 0.02, -0.05], [0.05, 0.02, -0.05]]
    path = amiwarp.Trajectory([0.0, 0.35, 0.65, 1.0], at, np.tile([0, 0, 0, 1.0], (4, 1)))
    camera = amiwarp.Camera.from_fov(128, 96, 1.0)
    return amiwarp.simulate(amiwarp.WorldScene(world, path), camera, PRISM, duration_s=1.0, seed=1)


def test_still_spans_of_one_recording_are_found(moved: amiwarp.Recording) -> None:
    poses, reasons = still_poses([moved])
    assert (len(poses), reasons) == (2, {})
    spans = [(p.recording.events.t_first * 1e-6, p.recording.events.t_last * 1e-6) for p in poses]
    assert spans[0][1] < 0.36
    assert spans[1][0] > 0.64
    assert all(0.12 < stop - start < 0.26 for start, stop in spans)
    named = [f"{moved.name}, {start:.2f} to {stop:.2f} s" for start, stop in spans]
    assert [pose.name for pose in poses] == named


def test_a_still_span_has_all_turns_that_repeat_each_other() -> None:
    """Two turns of the same events, and two of others."""
    turn_us = round(60e6 / 720.0)
    parts = list[amiwarp.Events]()
    for k, seed in enumerate((1, 1, 2, 3)):
        rng = np.random.default_rng(seed)
        t = np.sort(rng.integers(0, turn_us, 3000))
        t[0] = 0
        xy = rng.integers(0, 64, (2, 3000))
        parts.append(amiwarp.Events.from_arrays(*xy, k * turn_us + t, rng.integers(0, 2, 3000)))
    source = amiwarp.MemoryEvents(amiwarp.Events.concatenate(parts), 64, 64)
    encoder = amiwarp.Encoder.constant_speed(720.0, -1000, 5 * turn_us)
    (pose,), _ = still_poses([amiwarp.Recording(source, None, encoder)])
    found = pose.recording.events
    assert found.t_first == 0
    assert found.t_last == pytest.approx(2 * turn_us, abs=200)
    assert len(found) == pytest.approx(6000, abs=10)


def test_recordings_of_one_name_are_all_used(recordings: list[amiwarp.Recording]) -> None:
    """The files ``day0/pose.h5`` and ``day1/pose.h5`` have the same name."""
    same = [replace(one, name="pose") for one in recordings[:3]]
    poses, reasons = still_poses(
        [*same, replace(same[0], encoder=None), replace(same[0], encoder=None)]
    )
    assert [pose.name for pose in poses] == ["pose", "pose (2)", "pose (3)"]
    assert list(reasons) == ["pose (4)", "pose (5)"]


def streamed(recording: amiwarp.Recording, late_us: int = 0) -> list[amiwarp.Recording]:
    """Return the still spans found in a stream of 5 ms packets whose events come later than its encoder samples."""
    assert recording.encoder is not None
    found: list[amiwarp.Recording] = []
    spans, e = StillSpans("stream", recording.events.size, None, found.append), recording.encoder
    for start in range(recording.events.t_first, recording.events.t_last + late_us, 5000):
        new = (e.t >= start) & (e.t < start + 5000)
        spans.append_encoder(e.t[new], e.angle[new])
        events = recording.events.between(start - late_us, start - late_us + 5000)
        if len(events):
            spans.append(events)
    spans.finish()
    return found


@pytest.mark.parametrize(("late_us", "way"), [(0, 1.0), (300_000, 1.0), (0, -1.0)])
def test_a_stream_has_the_same_still_spans(
    moved: amiwarp.Recording, late_us: int, way: float
) -> None:
    """``way``: 1 for angles that grow, -1 for those of a prism that turns backwards."""
    assert moved.encoder is not None
    moved = replace(moved, encoder=replace(moved.encoder, angle=way * moved.encoder.angle))
    found = streamed(moved, late_us)
    times = [(r.events.t_first * 1e-6, r.events.t_last * 1e-6) for r in found]
    assert len(found) == 2
    assert times[0][1] < 0.36
    assert times[1][0] > 0.64
    for recording in found:
        e = recording.events
        assert 0.12 < (e.t_last - e.t_first) * 1e-6 < 0.26
        np.testing.assert_array_equal(
            e.slice(0, len(e)).x, moved.events.between(e.t_first, e.t_last + 1).x
        )
        assert recording.encoder is not None
        np.testing.assert_allclose(
            recording.encoder.angle_at(e.t_first), moved.encoder.angle_at(e.t_first)
        )


def test_turns_with_lost_events_are_no_pose(recordings: list[amiwarp.Recording]) -> None:
    """In the second of six still turns, events are missing for 15 ms."""
    e = recordings[0].events.between(0, 166_667)
    six = [amiwarp.Events(e.x, e.y, e.t + k * 166_667, e.p) for k in range(3)]
    joined = amiwarp.Events.concatenate(six)
    encoder = amiwarp.Encoder.constant_speed(720.0, -1000, 510_000)
    for until in (110_000, 125_000):
        kept = joined[(joined.t < 110_000) | (joined.t >= until)]
        found = streamed(amiwarp.Recording(amiwarp.MemoryEvents(kept, 320, 240), None, encoder))
        assert [r.events.t_first > 125_000 for r in found] == [until > 110_000]


def test_a_stream_is_not_kept_in_memory(
    moved: amiwarp.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lens_live, "MOST_BYTES", 100_000)
    monkeypatch.setattr(lens_live, "MOST_SAMPLES", 100)
    spans = StillSpans("stream", moved.events.size, None, lambda _: None)
    for k in range(300):
        spans.append_encoder(np.arange(10 * k, 10 * k + 10) * 1000, np.zeros(10))
        spans.append(moved.events.slice(1000 * k, 1000 * k + 1000))
    assert len(spans._t) <= 210
    assert sum(len(events) for events in spans._waiting) < 10_000
    with pytest.raises(amiwarp.AmiwarpError, match="stream: the prism makes 0 turns"):
        spans.finish()
    with pytest.raises(amiwarp.AmiwarpError, match=r"stream: .*no encoder samples.*--port"):
        StillSpans("stream", moved.events.size, None, lambda _: None).finish()


@pytest.fixture(scope="module")
def stream(recordings: list[amiwarp.Recording], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two turns of each pose three times, and a mirrored turn as a move; the second again."""
    turn, scrambled = 60e6 / 720.0, np.random.default_rng(0).permutation(320 * 240).astype(np.int64)
    parts = []
    for k, pose in enumerate((0, 1, 1, None, 2, 3, 4)):
        e = recordings[pose or 0].events.between(0, round(2 * turn))
        place = np.asarray(e.y, np.int64) * 320 + e.x
        if pose is None:
            place = scrambled[place]
        parts += [
            (place % 320, place // 320, e.t + round((7 * k + 2 * n) * turn), e.p) for n in range(3)
        ]
        one = e.t < turn
        parts.append(
            (
                319 - place[one] % 320,
                place[one] // 320,
                e.t[one] + round((7 * k + 6) * turn),
                e.p[one],
            )
        )
    x, y, t, p = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t, kind="stable")
    events = amiwarp.Events.from_arrays(x[order], y[order], t[order], p[order])
    assert recordings[0].encoder is not None
    first = float(recordings[0].encoder.angle_at(np.array([0]))[0])
    at = np.arange(-1000, round(49 * turn) + 1000, 1000)
    encoder = amiwarp.Encoder(at, first + at * (math.tau / turn))
    path = tmp_path_factory.mktemp("stream") / "stream.h5"
    recording = amiwarp.Recording(
        amiwarp.MemoryEvents(events, 320, 240), None, encoder, recordings[0].prism
    )
    amiwarp.save_recording(path, recording)
    return path


@pytest.mark.usefixtures("quick")
def test_a_stream_gives_a_lens_once_its_poses_are_enough(
    stream: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lens_live, "GOOD_POSES", 4)
    monkeypatch.setattr(corner_fit, "LARGEST_FOCAL_DEVIATION", 0.02)
    monkeypatch.setattr(calibration, "MOST_PASSES", 1)
    result = CliRunner().invoke(
        app, ["lens", str(stream), str(tmp_path / "camera.json"), "--fast", *LIVE]
    )
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert [pose["name"] for pose in data["poses"]] == ["pose 1", "pose 2", "pose 5", "pose 6"]
    assert amiwarp.load_camera(tmp_path / "camera.json").fx == pytest.approx(CAMERA.fx, rel=0.02)
    said = [text for text in data["messages"] if not text.startswith(" ")]
    grids = [text for text in data["messages"] if text.startswith(" ")]
    assert len(grids) == 4 * 3
    assert sum(int(count) for row in grids[-3:] for count in row.split()) == 4 * 30
    assert re.match(r"pose 1: board seen, tilt \d+ deg; 1 of 4 poses", said[1])
    assert "no corner lies in the upper left, upper centre" in said[2]
    assert "pose 3: as pose 2, so it does not count; move the board" in said
    assert "pose 4: a board of 6 x 5 inner corners is not seen" in said
    assert said[-1] == "enough: 4 poses; calibrating"
    assert data["left_out"] == {"pose 4": "a board of 6 x 5 inner corners is not seen"}


@pytest.mark.parametrize("tilt", [(0, 0.5), (15, 40)])
def test_poses_are_enough_only_if_they_determine_the_focal_length(
    tilt: tuple[float, float], recordings: list[amiwarp.Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    corners, said = seen(5, CAMERA, noise=0.05, tilt=tilt), list[str]()
    monkeypatch.setattr(lens_live, "GOOD_POSES", len(corners))
    monkeypatch.setattr(lens_live, "lacking", lambda *_: [])
    monkeypatch.setattr(lens_live.LiveLens, "_find", lambda *_: corners[len(poses.poses)])
    poses = lens_live.LiveLens(BOARD, ROUGH, "cpu", said.append)
    for _ in corners:
        poses.add(recordings[0])
    assert poses.enough == (tilt[0] > 0)
    assert any(text.startswith("still missing: the poses do not determine") for text in said) == (
        tilt[0] == 0
    )


def test_a_pose_that_shows_more_corners_than_an_earlier_one_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole, said = seen(5, CAMERA, noise=0.0)[0], list[str]()
    part = Corners(whole.ids[:12], whole.xy[:12])
    shown = [part, whole, whole]
    monkeypatch.setattr(lens_live.LiveLens, "_find", lambda *_: shown.pop(0))
    live = lens_live.LiveLens(BOARD, ROUGH, "cpu", said.append)
    events = amiwarp.MemoryEvents(amiwarp.Events.from_arrays([1], [1], [0], [1]), 320, 240)
    for _ in range(3):
        live.add(amiwarp.Recording(events))
    assert [pose.name for pose in live.poses] == ["pose 1", "pose 2"]
    assert any(text.startswith("pose 3: as pose 2, so it does not count") for text in said)


def test_ctrl_c_ends_a_stream_with_the_poses_so_far(
    stream: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: lens_live.LiveLens, recording: amiwarp.Recording) -> None:
        self._spans += 1
        self.poses.append(Pose(f"pose {self._spans}", recording))
        if self._spans == 1:
            os.kill(os.getpid(), signal.SIGINT)
            assert stops[0].wait(LONG_S)

    stops = list[threading.Event]()

    def noted(stop: threading.Event) -> AbstractContextManager[None]:
        stops.append(stop)
        return stopped_by_interrupt(stop)

    monkeypatch.setattr(lens_command, "stopped_by_interrupt", noted)
    monkeypatch.setattr(lens_live.LiveLens, "add", interrupted)
    said = run_live(stream, tmp_path / "camera.json", *LIVE)
    assert re.search(r"amiwarp: a lens needs 4 poses .* directions; given: [12]", said)


def test_streams_that_cannot_show_a_board_are_refused(
    recordings: list[amiwarp.Recording], tmp_path: Path
) -> None:
    path, out = tmp_path / "stream.h5", tmp_path / "camera.json"
    amiwarp.save_recording(path, replace(recordings[0], encoder=None))
    assert "contains no encoder samples; give the controller's --port" in run_live(path, out, *LIVE)
    assert "--live takes one source, and 2 are given" in run_live(path, path, out, *LIVE)
    assert "--seconds and --wait-for-source belong to --live" in run_live(
        path, out, "--seconds", "1"
    )


def test_a_prism_at_rest_ends_a_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recent_events, "FIRST_S", 0.2)
    ends = amiwarp.Events.from_arrays([1, 1], [1, 1], [0, 100_000_000], [0, 1])
    still = amiwarp.Encoder.constant_speed(0.0, 0, 100_000_000, interval_us=20_000)
    path, began = tmp_path / "stream.h5", time.monotonic()
    amiwarp.save_recording(path, amiwarp.Recording(amiwarp.MemoryEvents(ends, 8, 8), None, still))
    assert "the prism makes 0 turns; a pose needs 1.5 turns" in run_live(
        path, tmp_path / "camera.json", *LIVE
    )
    assert time.monotonic() - began < 90.0
