"""AMI-Bench: exact scores on cases with a known answer, refusals of the scorer, and the chain on tiny recordings."""

import json
import math
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    Events,
    ExactModel,
    MemoryEvents,
    MemoryImages,
    Prism,
    Recording,
    open_recording,
    save_recording,
)
from amiwarp.studies.bench import (
    BASELINES,
    COLUMNS,
    ArrayField,
    Entry,
    Scored,
    array_field,
    calibration_error,
    calibration_grid,
    detection_score,
    differences,
    displacement_of,
    entries,
    events_checksum,
    flow_score,
    frames_checksum,
    make_recordings,
    make_truth,
    not_compared,
    picture_score,
    read_arrays,
    rotation_error,
    run_baselines,
    score_submission,
    score_submissions,
    specification,
    stated_checksums,
    stated_table,
    table_data,
)
from tests import ROOT
from tests.command_line import app

CAMERA = Camera.from_fov(160, 120, math.radians(50.0))
TRUE = ExactModel(CAMERA, Prism(math.radians(1.0), 1.55), 0.4)
BALL = next(
    entry for entry in entries("small") if "detection" in entry.tasks and entry.speed != "rest"
)
RADIUS = math.sqrt(np.mean(np.sum(displacement_of(TRUE) ** 2, axis=-1)))
"""Rms radius of the orbits over the image [px]."""
TURN_US = 80_000


# The specification


def test_the_sets_have_ten_and_a_hundred_recordings() -> None:
    small = entries("small")
    full = entries("full")
    assert (len(small), len(full)) == (10, 100)
    for found in (small, full):
        assert len({entry.name for entry in found}) == len(found)
        assert {entry.speed for entry in found} == {"rest", "slow", "fast"}
        assert {entry.light for entry in found} == {"bright", "dim"}
        assert any("detection" in entry.tasks for entry in found)


def test_a_recording_is_scored_by_the_tasks_that_it_suits() -> None:
    tasks = {
        ("room", "rest"): ("calibration", "picture", "rotation"),
        ("room", "slow"): ("calibration", "picture", "flow", "rotation"),
        ("ball", "rest"): ("calibration", "picture", "detection", "rotation"),
        ("ball", "fast"): ("calibration", "picture", "flow", "detection", "rotation"),
    }
    for (world, speed), expected in tasks.items():
        assert Entry("small", world, speed, "bright", 1).tasks == expected


def test_windows_of_the_rotation_leave_half_a_turn_at_both_ends() -> None:
    for entry in (BALL, entries("full")[0]):
        ends = entry.rotation_ends_us
        half = entry.turn_us // 2
        assert set(np.diff(ends)) == {entry.turn_us}
        assert ends[0] >= half
        assert ends[-1] + half <= entry.duration_us
        assert ends[-1] + half > entry.duration_us - entry.turn_us


def test_what_is_drawn_depends_on_the_recording_alone() -> None:
    phases = [entry.mounted_phase for entry in entries("full")]
    assert len(set(phases)) == 100
    assert phases == [entry.mounted_phase for entry in entries("full")]
    true = BALL.rig().simulation("prism").truth_parameters()
    error = math.remainder(BALL.mounted_phase - true["phase"], math.tau)
    assert 0.0 < abs(error) <= math.radians(20.0)
    assert math.radians(0.8) <= true["apex"] <= math.radians(1.2)


def test_dim_light_is_a_tenth() -> None:
    bright = Entry("small", "room", "rest", "bright", 2).rig().world
    dim = Entry("small", "room", "rest", "dim", 2).rig().world
    assert dim.ambient == pytest.approx(0.1 * bright.ambient)
    assert dim.lamps[0].intensity == pytest.approx(0.1 * bright.lamps[0].intensity)


# Scores


def test_the_displacement_is_the_place_without_the_prism_less_the_place_of_the_event() -> None:
    found = displacement_of(TRUE)
    pixels, angles = calibration_grid(CAMERA)
    assert found.shape == (16, 6, 8, 2)
    assert pixels[0, 7].tolist() == [159.0, 0.0]
    assert pixels[5, 0].tolist() == [0.0, 119.0]
    place = pixels[4, 1][None]
    moved = TRUE.compensate_points(place, angles[3:4]) - place
    np.testing.assert_allclose(found[3, 4, 1], moved[0], rtol=0, atol=1e-6)
    # A thin prism moves the middle by the focal length times its deflection.
    radius = np.hypot(*found[:, 2, 3].T).mean()
    assert radius == pytest.approx(CAMERA.fx * 0.55 * math.radians(1.0), abs=0.06)  # px


def test_a_lag_is_taken_off_the_angle() -> None:
    late = ExactModel(CAMERA, Prism(math.radians(1.0), 1.55), 0.1)
    np.testing.assert_allclose(displacement_of(TRUE, 0.3), displacement_of(late), atol=1e-4)


def test_the_error_of_a_calibration_is_what_a_larger_apex_moves() -> None:
    larger = ExactModel(CAMERA, Prism(math.radians(1.2), 1.55), 0.4)
    between = displacement_of(larger) - displacement_of(TRUE)
    expected = math.sqrt(np.mean(np.sum(between**2, axis=-1)))
    assert calibration_error(displacement_of(larger), TRUE) == pytest.approx(
        expected, abs=1e-3
    )  # px
    assert 0.25 < expected < 0.5


@pytest.mark.parametrize("lag", [0.0, 0.3, -0.7])
def test_the_lag_of_a_sensor_is_no_error(lag: float) -> None:
    late = ExactModel(CAMERA, Prism(math.radians(1.0), 1.55), 0.4 - lag)
    assert calibration_error(displacement_of(late), TRUE) < 1e-3  # px


@pytest.mark.parametrize("phase", [1.6, -1.6, math.pi])
def test_a_wrong_phase_is_an_error(phase: float) -> None:
    """A lag beyond the longest delay of a sensor is wrong: events would be moved to a wrong side."""
    wrong = ExactModel(CAMERA, Prism(math.radians(1.0), 1.55), 0.4 + phase)
    expected = 2.0 * RADIUS * math.sin(0.5 * (abs(phase) - 0.75))
    assert calibration_error(displacement_of(wrong), TRUE) == pytest.approx(expected, rel=0.05)


def test_other_signs_and_axes_are_errors() -> None:
    found = displacement_of(TRUE)
    assert calibration_error(-found, TRUE) > 1.0  # px
    assert calibration_error(found[..., ::-1], TRUE) > 1.0
    assert calibration_error(found[::-1], TRUE) > 1.0


def test_a_picture_is_scored_up_to_gain_and_offset() -> None:
    rng = np.random.default_rng(0)
    truth = ndimage.gaussian_filter(rng.normal(size=(48, 64)), 1.0)
    ramp = np.broadcast_to(np.linspace(0.0, 1.0, 64), (48, 64))
    for gain, expected in ((3.0, 1.0), (-0.5, -1.0)):
        score = picture_score(gain * truth + 7.0, truth)
        assert score.whole == pytest.approx(expected)
        assert score.detail == pytest.approx(expected)
    tilted = picture_score(truth + 4.0 * ramp, truth)
    assert tilted.whole < 0.5
    assert tilted.detail > 0.97
    blurred = picture_score(ndimage.gaussian_filter(truth, 8.0) + ramp, truth + ramp)
    assert blurred.detail < 0.5
    assert blurred.whole > 0.5


def test_a_uniform_picture_scores_zero() -> None:
    truth = np.random.default_rng(0).normal(size=(24, 32))
    for value in (0.0, 3.7):
        score = picture_score(np.full((24, 32), value, np.float32), truth)
        assert (score.whole, score.detail) == (0.0, 0.0)


def test_a_flow_is_scored_at_edges_in_a_quarter_turn() -> None:
    truth = np.zeros((4, 6, 2), np.float32)
    truth[0, 0] = np.nan
    edges = np.zeros((4, 6), np.bool_)
    edges[0] = True
    flow = np.full((4, 6, 2), 1000.0)
    flow[0] = (3.0 / 0.02, 4.0 / 0.02)  # 5 px in 20 ms
    score = flow_score(flow, truth, edges, TURN_US)
    assert score.endpoint_px == pytest.approx(5.0)
    assert score.angle_deg == pytest.approx(math.degrees(math.atan(5.0)))
    perfect = flow_score(np.nan_to_num(truth), truth, edges, TURN_US)
    assert (perfect.endpoint_px, perfect.angle_deg) == (0.0, 0.0)


def test_a_detection_is_scored_by_the_overlap() -> None:
    truth = np.zeros((10, 10), np.bool_)
    truth[2:6, 2:6] = True
    mask = np.zeros_like(truth)
    assert detection_score(mask, truth) == 0.0
    mask[2:6, 4:8] = True
    assert detection_score(mask, truth) == pytest.approx(8 / 24)


def test_a_rotation_is_scored_by_the_rms_distance() -> None:
    truth = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    rates = truth + np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 12.0]])
    assert rotation_error(rates, truth) == pytest.approx(math.sqrt((25.0 + 144.0) / 2.0))


# Files that others write


def written(path: Path, **arrays: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.savez(file, **arrays)
    return path


FIELD = {"flow": ArrayField("f", (3, 4), 100.0, "px/s")}
GOOD = np.zeros((3, 4), np.float32)


def with_value(value: float) -> NDArray[np.float32]:
    values = GOOD.copy()
    values[1, 2] = value
    return values


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({}, "array flow is missing; give it once"),
        ({"flow": GOOD, "more": GOOD}, "array 'more' is unknown; expected flow alone"),
        (
            {"flow": with_value(np.nan)},
            r"array flow holds nan at \(1, 2\); expected finite numbers up to 100 px/s",
        ),
        ({"flow": with_value(-np.inf)}, r"array flow holds -inf at \(1, 2\)"),
        ({"flow": with_value(-100.5)}, r"array flow holds -100.5 at \(1, 2\)"),
        ({"flow": np.zeros((4, 3))}, r"array flow has shape \(4, 3\); expected \(3, 4\)"),
        ({"flow": GOOD.astype(int)}, "array flow is int64; expected floating-point numbers"),
        ({"flow": GOOD.astype(bool)}, "array flow is bool; expected floating-point numbers"),
    ],
)
def test_wrong_arrays_are_refused(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    path = written(tmp_path / "a.npz", **arrays)
    with pytest.raises(AmiwarpError, match=f"a.npz: .*{message}"):
        read_arrays(path, FIELD, "make it")


def test_right_arrays_are_read(tmp_path: Path) -> None:
    path = written(tmp_path / "a.npz", flow=with_value(100.0))
    np.testing.assert_array_equal(read_arrays(path, FIELD, "make it")["flow"], with_value(100.0))


def test_damaged_and_missing_archives_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"PK nonsense")
    with pytest.raises(AmiwarpError, match=r"a.npz: cannot be read as arrays"):
        read_arrays(tmp_path / "a.npz", FIELD, "make it")
    with pytest.raises(AmiwarpError, match=r"b.npz: does not exist; make it"):
        read_arrays(tmp_path / "b.npz", FIELD, "make it")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_array_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.npz", flow=GOOD)
    with zipfile.ZipFile(path) as archive:
        data = archive.read("flow.npy")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("flow.npy", data)
    with pytest.raises(AmiwarpError, match="array flow is there 2 times; give it once"):
        read_arrays(path, FIELD, "make it")


# Submissions


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    """Ground truth of one recording: a model, and made-up maps."""
    height, width = BALL.camera.height, BALL.camera.width
    rng = np.random.default_rng(1)
    ball = np.zeros((height, width), np.bool_)
    ball[20:40, 30:50] = True
    flow = np.full((height, width, 2), 40.0, np.float32)
    windows = len(BALL.rotation_ends_us) - 1
    written(
        tmp_path / "truth" / f"{BALL.name}.npz",
        optics=np.array([math.radians(1.0), 1.55, 0.4]),
        log=rng.normal(size=(height, width)).astype(np.float32),
        flow=flow,
        edges=np.ones((height, width), np.bool_),
        ball=ball,
        rates=np.full((windows, 3), 2.0),
    )
    return tmp_path / "truth"


@pytest.fixture
def submission(tmp_path: Path, truth: Path) -> Path:
    """A submission whose answers are the truth."""
    with np.load(truth / f"{BALL.name}.npz") as known:
        answers = {
            "calibration": {
                "displacement": displacement_of(ExactModel(BALL.camera, TRUE.prism, 0.4))
            },
            "picture": {"log": known["log"]},
            "flow": {"flow": known["flow"]},
            "detection": {"mask": known["ball"]},
            "rotation": {"rates": known["rates"]},
        }
    for task, arrays in answers.items():
        written(tmp_path / "mine" / task / f"{BALL.name}.npz", **arrays)
    describe(tmp_path / "mine")
    return tmp_path / "mine"


def describe(folder: Path, **changes: Any) -> None:
    about = {
        "format": "ami-bench-submission",
        "version": "1.0",
        "set": "small",
        "name": "mine",
        "units": {
            "calibration": "px",
            "picture": "log",
            "flow": "px/s",
            "detection": "mask",
            "rotation": "deg/s",
        },
    }
    (folder / "submission.json").write_text(json.dumps(about | changes))


def test_the_truth_has_perfect_scores(submission: Path, truth: Path) -> None:
    scored = score_submission(submission, truth, [BALL])
    expected = {
        "calibration_px": 0.0,
        "picture": 1.0,
        "picture_detail": 1.0,
        "flow_px": 0.0,
        "flow_deg": 0.0,
        "detection_iou": 1.0,
        "rotation_deg_s": 0.0,
    }
    assert scored.scores == pytest.approx(expected, abs=1e-3)
    assert scored.refused == dict.fromkeys(
        ("calibration", "picture", "flow", "detection", "rotation"), 0
    )


def test_a_refused_recording_counts_as_an_answer_of_nothing(submission: Path, truth: Path) -> None:
    tasks = ("calibration", "picture", "flow", "detection", "rotation")
    for task in tasks:
        (submission / task / f"{BALL.name}.npz").unlink()
    describe(submission, refused={task: {BALL.name: "too dark"} for task in tasks})
    scored = score_submission(submission, truth, [BALL])
    expected = {
        "calibration_px": RADIUS,
        "picture": 0.0,
        "picture_detail": 0.0,
        "flow_px": 40.0 * math.sqrt(2.0) * 0.25e-6 * BALL.turn_us,
        "flow_deg": math.degrees(math.atan(40.0 * math.sqrt(2.0) * 0.25e-6 * BALL.turn_us)),
        "detection_iou": 0.0,
        "rotation_deg_s": 2.0 * math.sqrt(3.0),
    }
    assert scored.scores == pytest.approx(expected, rel=0.03)
    assert scored.refused == dict.fromkeys(tasks, 1)


def test_a_task_that_is_not_answered_has_a_dash(submission: Path, truth: Path) -> None:
    describe(submission, units={"rotation": "deg/s"})
    for task in ("calibration", "picture", "flow", "detection"):
        shutil.rmtree(submission / task)
    scored = score_submission(submission, truth, [BALL])
    assert [name for name, value in scored.scores.items() if value is not None] == [
        "rotation_deg_s"
    ]
    assert set(scored.refused) == {"rotation"}


def missing(folder: Path) -> None:
    (folder / "flow" / f"{BALL.name}.npz").unlink()


def additional(folder: Path) -> None:
    written(folder / "flow" / "cellar.npz", flow=GOOD)


def both(folder: Path) -> None:
    describe(folder, refused={"flow": {BALL.name: "too fast"}})


def not_finite(folder: Path) -> None:
    rates = np.zeros((len(BALL.rotation_ends_us) - 1, 3))
    rates[1, 2] = np.nan
    written(folder / "rotation" / f"{BALL.name}.npz", rates=rates)


def radians_per_second(folder: Path) -> None:
    describe(folder, units={"rotation": "rad/s"})


def unnamed(folder: Path) -> None:
    units = {"calibration": "px", "picture": "log", "detection": "mask", "rotation": "deg/s"}
    describe(folder, units=units)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            missing,
            f"flow/{BALL.name}.npz: does not exist; answer the recording, or state in submission.json",
        ),
        (
            additional,
            "flow/cellar.npz: the task flow has no recording of this name in the set small; remove",
        ),
        (both, f"flow/{BALL.name}.npz: answers a recording that submission.json refuses"),
        (not_finite, rf"rotation/{BALL.name}.npz: .*array rates holds nan at \(1, 2\)"),
        (
            radians_per_second,
            "submission.json: .*field units.rotation is 'rad/s'; expected 'deg/s': convert",
        ),
        (
            lambda folder: describe(folder, version="2.0"),
            "fields format and version are .*'2.0'; expected",
        ),
        (
            lambda folder: describe(folder, version=1.0),
            "fields format and version are .*1.0; expected",
        ),
        (lambda folder: describe(folder, set="large"), "field set is 'large'"),
        (
            lambda folder: describe(folder, name="a\nb"),
            "field name is 'a.*expected up to 40 letters",
        ),
        (lambda folder: describe(folder, units={}), "field units is empty"),
        (
            lambda folder: describe(folder, units={"pose": "px"}),
            "field units.pose is of an unknown task",
        ),
        (lambda folder: describe(folder, more=1), "field more is unknown"),
        (
            lambda folder: describe(folder, refused={"flow": {"cellar": "dark"}}),
            "field refused.flow names 'cellar'; choose among",
        ),
        (
            lambda folder: describe(folder, units={"flow": "px/s"}, refused={"picture": {}}),
            "field refused.picture is of a task without a unit",
        ),
        (lambda folder: describe(folder, set="full"), "field set is 'full'; expected 'small'"),
        (lambda folder: (folder / "submission.json").unlink(), "submission.json"),
    ],
)
def test_nonsense_is_refused(
    submission: Path, truth: Path, damage: Callable[[Path], object], message: str
) -> None:
    damage(submission)
    with pytest.raises(AmiwarpError, match=message):
        score_submission(submission, truth, [BALL])


def test_two_submissions_of_one_name_are_refused(submission: Path, truth: Path) -> None:
    with pytest.raises(AmiwarpError, match="field name is 'mine', the name of another submission"):
        score_submissions([submission, submission], truth, [BALL])


def test_a_submission_without_all_recordings_is_refused(submission: Path, truth: Path) -> None:
    """Without a choice, the whole set is scored."""
    with pytest.raises(
        AmiwarpError, match=r"truth/.*npz: does not exist; make it with 'amiwarp bench truth'"
    ):
        score_submission(submission, truth)


def test_answers_have_the_shapes_of_their_recording() -> None:
    full = entries("full")[0]
    assert array_field("flow", full).shape == (240, 320, 2)
    assert array_field("rotation", full).shape == (5, 3)
    assert array_field("rotation", BALL).shape == (2, 3)


# The table


def scored_with(**scores: float | None) -> Scored:
    known = {name: value for name, value in scores.items() if value is not None}
    every = dict.fromkeys(COLUMNS, None) | scores
    return Scored("mine", "small", 1, every, {}, {BALL.name: known})


def test_differences_from_a_table_are_named() -> None:
    table = table_data([scored_with(flow_px=0.5, picture=0.9)])
    assert differences([scored_with(flow_px=0.54, picture=0.9)], table) == []
    assert differences([scored_with(flow_px=0.44, picture=0.9)], table) == [
        "mine, flow [px]: 0.440, in the table 0.500, beyond 0.05"
    ]
    assert differences([scored_with(flow_px=0.5)], table) == [
        "mine, picture: –, in the table 0.900"
    ]
    assert differences([replace(scored_with(), name="other")], table) == [
        "other: is not in the table"
    ]


def test_a_table_is_compared_over_the_scored_recordings() -> None:
    table = table_data([scored_with(picture=0.9)])
    table["methods"]["mine"]["recordings"]["another"] = {"picture": 0.1}
    assert differences([scored_with(picture=0.9)], table) == []


def test_recordings_that_a_table_lacks_are_named_and_not_compared() -> None:
    table = table_data([scored_with(picture=0.9)])
    found = scored_with(picture=0.5)
    found.by_recording[BALL.name]["picture"] = 0.9
    found.by_recording["another"] = {"picture": 0.1}
    assert not_compared([found], table) == ["another"]
    assert differences([found], table) == []


# Recordings


def test_the_checksum_covers_every_column() -> None:
    def checksum(x: int = 1, y: int = 2, t: int = 3, p: int = 1) -> str:
        events = Events.from_arrays([x, 5], [y, 6], [t, 9], [p, 0])
        return events_checksum(MemoryEvents(events, 8, 8))

    sums = {checksum(), checksum(x=2), checksum(y=1), checksum(t=4), checksum(p=0)}
    assert len(sums) == 5
    assert checksum() == checksum()


def test_the_checksum_of_frames_covers_times_and_values() -> None:
    images = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
    first = frames_checksum(MemoryImages(np.array([0, 10]), images))
    assert first != frames_checksum(MemoryImages(np.array([0, 11]), images))
    assert first != frames_checksum(MemoryImages(np.array([0, 10]), images[::-1]))
    assert first == frames_checksum(MemoryImages(np.array([0, 10]), images.copy()))


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> Entry:
    """A recording of the small set, at 48x36 px."""
    known = specification._specification()
    sets = {name: replace(known.sets[name], size=(48, 36)) for name in known.sets}
    monkeypatch.setattr(specification, "_specification", lambda: replace(known, sets=sets))
    return BALL


def test_a_tiny_recording_is_made_answered_and_scored(tmp_path: Path, tiny: Entry) -> None:
    folder = tmp_path / "recordings"
    made = make_recordings(folder, [tiny], "cpu")
    assert (made.made, made.equal) == ([tiny.name], [])
    assert len(made.different) + len(made.unknown) == 3
    for camera in ("prism", "plain"):
        public = open_recording(folder / camera / f"{tiny.name}.h5")
        assert public.truth is None
        assert set(public.metadata) & {"seed", "source", "world"} == set()
    assert make_recordings(folder, [tiny], "cpu").kept == [tiny.name]

    make_truth(tmp_path / "truth", [tiny], "cpu")
    chosen = {name: BASELINES[name] for name in ("frames",)}
    run_baselines(chosen, folder, {"frames": tmp_path / "frames"}, [tiny], "cpu")
    scored = score_submission(tmp_path / "frames", tmp_path / "truth", [tiny])
    assert scored.scores["calibration_px"] is None
    assert scored.scores["picture"] is not None
    assert scored.scores["picture"] > 0.9
    assert set(scored.refused.values()) == {0}


def test_recordings_of_another_set_are_refused(tmp_path: Path) -> None:
    (tmp_path / "prism").mkdir()
    (tmp_path / "plain").mkdir()
    other = Recording(MemoryEvents(Events.from_arrays([1], [1], [0], [1]), 48, 36))
    for camera in ("prism", "plain"):
        save_recording(tmp_path / camera / f"{BALL.name}.h5", other)
    with pytest.raises(
        AmiwarpError, match=r"has \(48, 36\) px, the recording of this name in the set small"
    ):
        make_recordings(tmp_path, [BALL], "cpu")


def test_the_package_has_checksums_and_a_table_of_the_small_set() -> None:
    sums = stated_checksums()["small"]
    names = {entry.name for entry in entries("small")}
    assert set(sums) == {
        f"{camera}/{name}" for camera in ("prism", "plain", "frames") for name in names
    }
    table = stated_table()
    assert set(table["methods"]) == {*BASELINES, "network"}
    scored = [set(method["recordings"]) for method in table["methods"].values()]
    assert scored[0]
    assert scored[0] <= names
    assert all(recordings == scored[0] for recordings in scored)


def test_the_page_shows_the_table_of_the_package() -> None:
    page = (ROOT / "docs/how-to/bench.md").read_text(encoding="utf-8")
    for name, method in stated_table()["methods"].items():
        cells = ["–" if value is None else f"{value:.3f}" for value in method["scores"].values()]
        refused = [f"{count} {task}" for task, count in method["refused"].items() if count]
        row = " | ".join([f"`{name}`", *cells, ", ".join(refused) or "none"])
        assert f"| {row} |" in page


# The command


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("bench make", "'amiwarp bench make' has 0 names after it; give a folder"),
        ("bench make one two", "'amiwarp bench make' has 2 names after it; give a folder"),
        ("bench run frames", "'amiwarp bench run' needs --data; give it"),
        ("bench score mine", "'amiwarp bench score' needs --truth; give it"),
        ("bench score --truth there", "has 0 names after it; give folders of submissions"),
        ("bench truth new --truth there", "--truth does not apply to 'amiwarp bench truth'"),
        ("bench --data there", "--data does not apply to 'amiwarp bench'"),
        ("bench make new --methods plain", "--methods does not apply to 'amiwarp bench make'"),
        ("bench --methods magic", "baseline 'magic' is unknown; choose among paper, ours"),
        ("bench run magic --data there", "baseline 'magic' is unknown"),
        ("bench --only cellar", "recording 'cellar' is not in the set small; choose among room"),
        ("bench run frames --data there --out new", "there/prism/room-rest-bright-2.h5: does not"),
    ],
)
def test_wrong_command_lines_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, line.split())
    assert result.exit_code == 1, result.output
    assert message in result.stderr
    assert not list(tmp_path.rglob("*.*"))


def test_the_command_prints_the_table(submission: Path, truth: Path) -> None:
    line = ["bench", "score", str(submission), "--truth", str(truth), "--only", BALL.name]
    shown = CliRunner().invoke(app, line)
    assert shown.exit_code == 0, shown.output
    assert "calibration [px]" in shown.stdout
    assert "mine" in shown.stdout
    data = json.loads(CliRunner().invoke(app, [*line, "--json"]).stdout)
    assert data["methods"]["mine"]["scores"]["detection_iou"] == 1.0
    assert data["methods"]["mine"]["recordings"][BALL.name]["flow_px"] == 0.0
