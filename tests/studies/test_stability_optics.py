"""Study of every optic: its recordings, what encoders read, where events belong, outcomes, and the map made of them."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Calibration,
    Encoder,
    Mirror,
    Plate,
    Prism,
    PrismMotion,
    TruthRenderer,
    Vibration,
)
from amiwarp.studies.stability import (
    Cell,
    Condition,
    Outcome,
    Result,
    Store,
    Stored,
    axes,
    causes,
    condition,
    encoders,
    judging,
    mild_troubles,
    optic_map,
    optics,
    placing_error,
    recordings,
    rigs,
)
from amiwarp.studies.stability import cells as study
from amiwarp.studies.stability.recordings import OpticSample
from benchmarks import atlas
from reference import optics as oracle
from reference.calibration_sample import exact_calibration
from tests.command_line import app

SMALL = Condition(width=96, height=72)
XY = np.stack(np.meshgrid(np.linspace(5.0, 90.0, 4), np.linspace(4.0, 66.0, 3)), axis=-1).reshape(
    -1, 2
)


def rig(optic: str, seed: int = 0, **troubles: Any) -> rigs.Rig:
    return rigs.rig_of(
        replace(SMALL, optic=optic, **troubles), seed, np.random.default_rng(seed), "cpu"
    )


def read_of(made: rigs.Rig) -> Encoder:
    assert made.encoder is not None
    return made.encoder


def error_of(encoder: Encoder, motion: PrismMotion) -> np.ndarray:
    """Return the angle of each encoder sample minus the true one [rad]."""
    return np.asarray(encoder.angle - replace(motion, second=None).angle(encoder.t))


@pytest.mark.parametrize("axis", axes.OPTIC_AXES, ids=lambda a: a.name)
def test_axes_are_one_optic_and_begin_in_the_sensible_range(axis: axes.Axis) -> None:
    made = axis.conditions()
    assert len({c.key for c in made}) == len(axis.values)
    assert {c.optic for c in made} == {axis.name.split(":")[0]}
    assert condition.sensible(made[1 if axis.field == "fov_deg" else 0], 100_000)


def test_every_optic_has_each_trouble_of_its_angles() -> None:
    names = {axis.name for axis in axes.OPTIC_AXES}
    assert len(names) == len(axes.OPTIC_AXES)
    for optic in ("wedge", "pair", "plate"):
        for trouble in ("encoder off centre", "counts lost once", "jitter of index pulses"):
            assert f"{optic}: {trouble}" in names
    assert "mirror: encoder off centre" not in names
    assert "vibration: encoder off centre" not in names
    for each in axes.OPTIC_TROUBLES:
        assert each.axis.field in (*causes.CAUSES, "fov_deg", "hunt_hz")


def test_combinations_are_sensible_and_take_turns() -> None:
    drawn = [mild_troubles.mild_optic(seed) for seed in range(200)]
    assert [c.optic for c in drawn[:5]] == list(optics.OPTICS)
    assert all(condition.sensible(c, 100_000) for c in drawn)
    met = {name for c in drawn for name in condition.troubles_of(c)}
    assert {"lost_once_deg", "hunt", "index_jitter_us", "command_cubic", "third_px", "unsteady", "plate_wedge_arcmin",
            "camera_deg_s", "distortion"} < met  # fmt: skip
    assert not any(c.index_only and (c.eccentric_deg or c.lost_once_deg) for c in drawn)
    assert not any(c.hunt and not c.index_only for c in drawn)
    assert mild_troubles.mild_optic(7) == mild_troubles.mild_optic(7)


@pytest.mark.parametrize("optic", optics.OPTICS)
def test_recordings_are_made_and_equal_seeds_make_equal_ones(optic: str) -> None:
    condition = replace(
        SMALL, optic=optic, noise=0.3 if optic == "wedge" else 0.0, distortion=-0.05
    )
    one, two = (recordings.make_optic(condition, 3).recording for _ in range(2))
    a, b = (recording.events.slice(0, 10**9) for recording in (one, two))
    assert len(a) > 2000
    np.testing.assert_array_equal(a.t, b.t)
    assert one.camera is not None
    assert one.camera.distortion is None
    assert (one.encoder is None) == (optic == "vibration")
    assert optic not in ("mirror", "vibration") or one.metadata["optic"] == optic


def test_encoder_errors_are_those_of_the_condition() -> None:
    off, motion = (
        rig("wedge", eccentric_deg=3.0),
        rig("wedge", eccentric_deg=3.0).simulation.prism_motion,
    )
    assert np.degrees(np.abs(error_of(read_of(off), motion)).max()) == pytest.approx(3.0, abs=0.1)
    made = rig("plate", third_deg=2.0)
    wrong = error_of(read_of(made), made.simulation.prism_motion)
    angle = made.simulation.prism_motion.angle(read_of(made).t)
    part = 2.0 * np.mean(wrong * np.exp(-3j * angle))
    assert math.degrees(abs(part)) == pytest.approx(2.0, rel=0.15)
    assert np.degrees(np.abs(wrong).max()) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_counts_are_lost_once_behind_the_motion(seed: int) -> None:
    made = rig("pair", seed, lost_once_deg=10.0)
    motion = made.simulation.prism_motion
    encoder = read_of(made)
    forward = math.copysign(1.0, float(np.asarray(motion.rpm)))
    behind = -forward * np.degrees(error_of(encoder, motion))
    late = encoder.t > 0.75e6 * made.simulation.duration_s
    early = encoder.t < 0.25e6 * made.simulation.duration_s
    assert behind[late] == pytest.approx(10.0, abs=0.1)
    assert behind[early] == pytest.approx(0.0, abs=0.1)
    assert encoder.second is not None
    assert motion.second is not None
    assert np.abs(error_of(encoder.second, motion.second)).max() < 1e-3


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_index_pulses_are_at_whole_turns_with_jitter_and_hunting(seed: int) -> None:
    made = rig("wedge", seed, index_only=True, index_jitter_us=200.0, hunt=0.05, hunt_hz=10.0)
    motion, encoder = made.simulation.prism_motion, read_of(made)
    assert np.allclose(np.abs(np.diff(encoder.angle)), math.tau)
    rate = math.tau * np.mean(np.asarray(motion.rpm)[:, 1]) / 60.0
    late_us = 1e6 * error_of(encoder, motion) / rate
    assert 80.0 < late_us.std() < 400.0
    assert encoder.t[0] < 0
    assert encoder.t[-1] > 1e6 * made.simulation.duration_s
    speed = np.asarray(motion.rpm)[:, 1]
    assert np.ptp(speed) == pytest.approx(0.1 * abs(speed.mean()), rel=0.01)


def test_swapped_encoders_read_each_others_angles() -> None:
    made = rig("pair", swapped=True)
    motion, encoder = made.simulation.prism_motion, read_of(made)
    assert encoder.second is not None
    assert motion.second is not None
    assert np.abs(error_of(encoder.second, motion)).max() < 1e-3
    assert np.abs(error_of(encoder, motion.second)).max() < 1e-3


@pytest.mark.parametrize(("cubic", "square"), [(0.1, 0.0), (-0.2, 0.0), (0.0, 0.1), (0.05, -0.05)])
def test_a_mirrors_command_is_bent_as_the_formula_says(cubic: float, square: float) -> None:
    t = np.arange(0, 100_000, 100)
    true = np.asarray(0.7 + math.tau * 40.0 * 1e-6 * t, np.float64)
    given = encoders.commanding(Encoder(t, true - 0.7), 0.7, cubic, square)
    c = np.cos(given.angle + 0.7)
    tilt = (c + cubic * c**3) / (1.0 + cubic) + square * (c**2 - 1.0)
    np.testing.assert_allclose(tilt, np.cos(true), atol=2e-6)
    assert (np.diff(given.angle) > 0.0).all()
    assert np.abs(given.angle + 0.7 - true).max() > 0.01


def angles_at(made: rigs.Rig, t_us: np.ndarray) -> np.ndarray:
    return made.simulation.prism_motion.angles(t_us)


def test_events_belong_where_a_trace_of_rays_puts_them() -> None:
    t = np.linspace(0.0, 1e5, len(XY))
    one = rig("wedge", distortion=-0.05)
    camera, glass, phase = (
        one.simulation.camera,
        one.simulation.glass,
        one.simulation.prism_motion.phase,
    )
    assert camera.distortion is not None
    expected = oracle.move(camera, glass, XY, angles_at(one, t), to_scene=True, phase=phase)
    np.testing.assert_allclose(one.places(XY, t), expected, atol=1e-3)
    two = rig("pair")
    camera, glass, motion = two.simulation.camera, two.simulation.glass, two.simulation.prism_motion
    assert motion.second is not None
    phases = motion.phase, motion.second.phase
    expected = oracle.through_pair(camera, glass, phases, XY, angles_at(two, t), to_scene=True)
    np.testing.assert_allclose(two.places(XY, t), expected, atol=1e-3)
    mirror = rig("mirror")
    assert isinstance(mirror.simulation.prism, Mirror)
    expected = oracle.in_mirror(
        camera, mirror.simulation.prism.parameters(), XY, angles_at(mirror, t)
    )
    np.testing.assert_allclose(mirror.places(XY, t), expected, atol=1e-3)


def test_a_vibration_whose_amplitude_varies_moves_events_by_it() -> None:
    t = np.linspace(0.0, 1e5, len(XY))
    made = rig("vibration", unsteady=0.3, third_px=0.2)
    assert isinstance(made.simulation.prism, Vibration)
    values, camera = made.simulation.prism.parameters(), made.simulation.camera
    assert math.hypot(values["third_x"], values["third_y"]) * camera.fx == pytest.approx(0.2)
    theta = angles_at(made, t)
    turn = oracle.vibration(values, theta).as_rotvec()
    at = oracle.turned(camera, Rotation.from_rotvec(turn), XY)
    varies = 0.3 * values["amplitude"] * np.sin(optics.UNSTEADY_SHARE * theta)
    turn[:, 0] += varies * np.cos(theta + values["phase"])
    turn[:, 1] += varies * np.sin(theta + values["phase"])
    expected = oracle.turned(camera, Rotation.from_rotvec(turn), XY)
    assert np.abs(expected - at).max() > 0.2
    # The rotation is made in steps of 1 ms
    np.testing.assert_allclose(made.places(XY, t), expected, atol=0.03)
    steady = replace(made, swing=None)
    np.testing.assert_allclose(steady.places(XY, t), at, atol=1e-3)


def test_the_wall_behind_a_plate_has_the_depth_that_is_assumed() -> None:
    made = rig("plate")
    camera = made.simulation.camera
    depth = TruthRenderer(made.simulation).at(0).depth
    rows, columns = np.mgrid[: camera.height, : camera.width]
    xy = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    assert made.inverse_depth is not None
    expected = made.inverse_depth(xy)
    np.testing.assert_allclose(1.0 / depth.ravel(), expected, rtol=1e-3)
    assert np.ptp(expected) > 0.1


def test_a_plate_moves_events_as_its_depths_say() -> None:
    t = np.linspace(0.0, 1e5, len(XY))
    made = rig("plate")
    glass, phase = made.simulation.prism, made.simulation.prism_motion.phase
    assert isinstance(glass, Plate)
    assert made.inverse_depth is not None
    places = made.places(XY, t)
    depth = made.inverse_depth(places)
    camera = made.simulation.camera
    expected = oracle.at_depth(camera, glass, phase, XY, angles_at(made, t), depth)
    np.testing.assert_allclose(places, expected, atol=2e-3)
    bent = rig("plate", plate_wedge_arcmin=60.0)
    assert math.hypot(*bent.simulation.prism_motion.wedge) == pytest.approx(math.radians(1.0))


def sample_of(made: rigs.Rig) -> OpticSample:
    recording = recordings.make_optic(replace(SMALL, optic="wedge"), 0).recording
    return OpticSample(recording, made)


def test_the_error_leaves_out_lag_and_shift_and_nothing_else() -> None:
    condition = replace(SMALL, optic="wedge")
    sample = recordings.make_optic(condition, 0)
    made = sample.rig
    truth, phase = made.simulation.glass, made.simulation.prism_motion.phase

    def error(apex: float, turned: float) -> float:
        found = exact_calibration(
            made.simulation.camera, Prism(truth.apex), {"apex": apex, "phase": phase + turned}
        )
        return placing_error.error_px(made, sample.recording, found)

    assert error(truth.apex, 0.0) < 1e-3
    assert error(truth.apex, 0.05) < 2e-3  # a lag of half a millisecond
    camera = made.simulation.camera
    xy = np.stack(np.meshgrid(np.linspace(8, 87, 12), np.linspace(8, 63, 9)), axis=-1).reshape(
        -1, 2
    )
    turned = [oracle.move(camera, truth, xy, np.full(108, a), to_scene=True) for a in range(6)]
    radius = math.sqrt(float(np.mean(np.sum((np.array(turned) - xy) ** 2, axis=-1))))
    assert error(1.05 * truth.apex, 0.0) == pytest.approx(0.05 * radius, rel=0.03)


def judged(
    condition: Condition, monkeypatch: pytest.MonkeyPatch, error: float, **found: Any
) -> Result:
    monkeypatch.setattr(placing_error, "error_px", lambda *_: error)
    stage = SimpleNamespace(accepted=True, verdict="no", deviation_px=0.004, hidden_px={})
    made = SimpleNamespace(warnings=(), photometric=stage)
    for name, value in found.items():
        setattr(made if hasattr(made, name) else stage, name, value)
    return judging.judge_optic(condition, cast(OpticSample, SimpleNamespace(rig=None, recording=None)),
                              cast(Calibration, made), 1.0)  # fmt: skip


def test_outcomes_are_answered_named_refused_and_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    lost = replace(SMALL, optic="wedge", lost_once_deg=9.0)
    assert judged(lost, monkeypatch, 0.019).outcome is Outcome.SUCCESS
    assert judged(lost, monkeypatch, 0.021).outcome is Outcome.SILENT
    says = ("The encoder LOST counts",)
    assert judged(lost, monkeypatch, 0.021, warnings=says).outcome is Outcome.NAMED
    other = replace(SMALL, optic="wedge", third_deg=1.0)
    assert (
        judged(other, monkeypatch, 0.5, warnings=("the lens was not given",)).outcome
        is Outcome.SILENT
    )
    assert (
        judged(replace(SMALL, optic="wedge"), monkeypatch, 0.5, warnings=says).outcome
        is Outcome.SILENT
    )
    refused = judged(lost, monkeypatch, 0.001, accepted=False)
    assert (refused.outcome, refused.error_px, refused.message) == (Outcome.REFUSAL, None, "no")
    assert judged(lost, monkeypatch, math.inf).error_px == judging.LARGEST_PX
    assert judged(lost, monkeypatch, 0.01).stated_px == 0.004


def test_a_cause_that_could_hide_by_as_much_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    uneven = replace(SMALL, optic="plate", plate_wedge_arcmin=0.5)
    hidden = {"faces that are not parallel": 0.05, "noise": 0.9}
    found = judged(uneven, monkeypatch, 0.049, hidden_px=hidden)
    assert found.outcome is Outcome.NAMED
    assert "could hide: faces that are not parallel 0.05 px" in found.message
    assert judged(uneven, monkeypatch, 0.051, hidden_px=hidden).outcome is Outcome.SILENT
    assert judged(uneven, monkeypatch, 0.01, hidden_px=hidden).message == ""
    lost = replace(SMALL, optic="plate", lost_once_deg=9.0)
    assert judged(lost, monkeypatch, 0.049, hidden_px=hidden).outcome is Outcome.SILENT


@pytest.mark.parametrize(
    ("said", "named"),
    [
        ("the encoder's angle steps by +1.00 deg: it lost counts, or slipped", ["lost_once_deg"]),
        ("the sensor or its link lost them; lower the event rate", []),
        (
            "the second encoder's angle is wrong by 1 deg once a turn: it was corrected",
            ["eccentric_deg", "second_deg", "third_deg"],
        ),
        ("the scale or the clock of the encoder is wrong, or the camera moved", []),
        (
            "an error of about 0.03 px rms is left that repeats with the encoder's angle",
            ["eccentric_deg", "second_deg", "third_deg"],
        ),
        ("the first encoder gives pulses only", ["index_jitter_us", "hunt"]),
        ("the faces of the plate are not parallel: 1.6 arcmin", ["plate_wedge_arcmin"]),
    ],
)
def test_words_name_a_trouble_of_the_angles_and_no_other(said: str, named: list[str]) -> None:
    of_angles = [
        "eccentric_deg", "second_deg", "third_deg", "index_jitter_us", "hunt", "lost_once_deg",
        "plate_wedge_arcmin",
    ]  # fmt: skip
    found = [trouble for trouble in of_angles if causes.names_cause([said], [trouble])]
    assert found == named


def test_rows_are_cells_again_and_only_chosen_ones_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost, jitter = (
        Condition(optic="pair", lost_once_deg=9.0),
        Condition(optic="plate", index_only=True, index_jitter_us=200.0),
    )
    known = [
        of_cell(lost, 0, Outcome.SILENT, 0.1),
        of_cell(lost, 1, Outcome.SUCCESS, 0.01),
        of_cell(jitter, 0, Outcome.SILENT, 0.2),
    ]
    rows = [row for each in known if (row := atlas.row_of(each)) is not None]
    assert [atlas.cell_of(row) for row in rows] == [each.cell for each in known]
    assert [atlas.row_of(atlas.stored_of(row)) for row in rows] == rows
    about = {"machine": "H200", "date": "2026-01-01", "versions": {}}
    atlas.write_rows(tmp_path, about, rows, 3)

    def run_cell(cell: Cell, *_: object) -> Stored:
        return of_cell(cell.condition, cell.seed, Outcome.SUCCESS, 0.005)

    monkeypatch.setattr(atlas, "run_cell", run_cell)
    atlas.run_again(tmp_path, "silent failure", ["pair: counts lost once"], "cpu", 100.0)
    data = json.loads((tmp_path / "atlas_optics.json").read_text())
    assert [row["outcome"] for row in data["rows"]] == ["success", "success", "silent failure"]
    assert ["machine" in row for row in data["rows"]] == [True, False, False]
    assert (data["machine"], data["summary"]["failed"]) == ("H200", 3)
    assert data["summary"]["outcomes"]["pair"]["all"]["answered"] == 2
    atlas.run_again(tmp_path, "silent failure", [], "cpu", 100.0)
    with (tmp_path / "atlas_optics.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["outcome"] for row in table] == ["success", "success", "success"]
    assert table[1]["machine"] == ""
    assert optic_map.load_map(tmp_path / "optic_map.json").limit_px == 0.02


def test_what_every_combination_has_is_no_trouble() -> None:
    assert condition.troubles_of(Condition(optic="pair", noise=0.2, contrast=0.3)) == []
    assert condition.troubles_of(Condition(optic="pair", noise=0.3, eccentric_deg=1.0)) == [
        "noise",
        "eccentric_deg",
    ]


# The map.


def stored(
    optic: str, outcomes: dict[float, list[tuple[Outcome, float | None]]], field: str = "noise"
) -> list[Stored]:
    out = []
    for value, results in outcomes.items():
        for seed, (outcome, error) in enumerate(results):
            condition = Condition(optic=optic, **{field: value})  # type: ignore[arg-type]
            out.append(of_cell(condition, seed, outcome, error))
    return out


def of_cell(condition: Condition, seed: int, outcome: Outcome, error: float | None) -> Stored:
    default = judging.METHODS[0]
    result = Result(outcome, error, 0.02, 1.0)
    return Stored(Cell(condition, seed), 100_000, {study.identity(default): result})


@pytest.fixture
def found() -> optic_map.OpticMap:
    cells = stored("pair", {
        0.0: [(Outcome.SUCCESS, 0.001), (Outcome.SUCCESS, 0.003)],
        0.25: [(Outcome.SUCCESS, 0.01), (Outcome.NAMED, 0.05)],
        0.5: [(Outcome.REFUSAL, None), (Outcome.SILENT, 0.2)],
    })  # fmt: skip
    return optic_map.make_map(cells, {"machine": "one"})


def test_the_map_counts_outcomes_and_is_read_again(
    found: optic_map.OpticMap, tmp_path: Path
) -> None:
    noise = found.axis("pair", "noise")
    assert [str(p) for p in noise.points] == [
        "2 answered of 2; 0.002 px",
        "1 answered, 1 named of 2; 0.03 px",
        "1 refused, 1 silent of 2; 0.2 px",
    ]
    assert found.limit_px == 0.02
    found.save(tmp_path / "map.json")
    assert optic_map.load_map(tmp_path / "map.json") == found
    (tmp_path / "map.json").write_text('{"format": "other", "axes": []}')
    with pytest.raises(AmiwarpError, match=r"map\.json: no map of optics"):
        optic_map.load_map(tmp_path / "map.json")


@pytest.mark.parametrize(
    ("value", "near"),
    [(0.25, [0.25]), (0.3, [0.25, 0.5]), (0.1, [0.0, 0.25]), (0.9, [0.5]), (-1.0, [0.0])],
)
def test_the_nearest_measured_values_are_those_about_a_value(
    found: optic_map.OpticMap, value: float, near: list[float]
) -> None:
    noise = found.axis("pair", "noise")
    assert [point.value for point in noise.about(value)] == near
    assert noise.measured_at(value) == (0.0 <= value <= 0.5)
    falling = replace(noise, points=noise.points[::-1])
    assert [point.value for point in falling.about(value)] == near


def test_what_was_not_measured_is_said(found: optic_map.OpticMap) -> None:
    row = {name: said for name, _, said in optic_map.rows_for(found, "pair", {"noise": 0.9})}
    assert row["background noise [of all events]"].startswith(
        "not measured there; nearest: 50 %: 1 refused, 1 silent"
    )
    rows = optic_map.rows_for(found, "pair", {})
    assert (
        "background noise [of all events]",
        "not given",
        "all answered at 0 %; silent failures at 50 %",
    ) in rows
    with pytest.raises(
        AmiwarpError, match="trouble 'third_px' of a pair was not measured; choose among noise"
    ):
        optic_map.RigOnMap(found, "pair", {"third_px": 1.0})
    with pytest.raises(AmiwarpError, match="nothing was measured of a plate"):
        optic_map.RigOnMap(found, "plate", {})
    with pytest.raises(AmiwarpError, match="optic 'lens' is not known; choose among wedge"):
        found.of("lens")


def test_the_map_is_drawn_with_the_given_value_marked(found: optic_map.OpticMap) -> None:
    figure = optic_map.chart(found, "pair", {"noise": 0.375})
    ax = next(ax for ax in figure.axes if ax.get_ylabel().startswith("background noise"))
    assert [text.get_text() for text in ax.texts] == ["2/2", "1/2", "0/2"]
    assert ax.lines[-1].get_xdata() == pytest.approx([1.5, 1.5])
    widths = [round(bar.get_width(), 6) for bar in ax.patches]
    assert widths == [1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5, 0.5]


def test_summary_counts_combinations_apart_from_axes() -> None:
    drawn = mild_troubles.mild_optic(1)
    result = Result(Outcome.SILENT, 0.3, 0.02, 1.0)
    cells = [
        *stored("pair", {0.0: [(Outcome.SUCCESS, 0.001)]}),
        Stored(Cell(drawn, 1), 100_000, {study.identity(judging.METHODS[0]): result}),
        Stored(Cell(drawn, 2), 100, {study.identity(judging.METHODS[0]): result}),
    ]
    counts = optic_map.summary_of(cells)
    assert counts["pair"]["combinations"]["silent"] == 1
    assert counts["pair"]["axes"] == {"answered": 1, "named": 0, "refused": 0, "silent": 1}
    assert counts["all"]["sensible"] == {"answered": 1, "named": 0, "refused": 0, "silent": 1}


def test_cells_with_an_optic_are_stored_and_read_again(tmp_path: Path) -> None:
    (cell,) = stored("plate", {0.25: [(Outcome.NAMED, 0.05)]})
    store = Store(tmp_path)
    store.save(cell)
    assert store.load(cell.cell) == cell
    assert store.load_all() == [cell]


# The command.


def test_design_says_where_an_optic_can_be_calibrated(
    found: optic_map.OpticMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*args: str) -> Any:
        words = [
            "design",
            "--size",
            "64x48",
            "--apex-deg",
            "1",
            "--rpm",
            "720",
            "--device",
            "cpu",
            *args,
        ]
        return CliRunner().invoke(app, words)

    monkeypatch.setattr(optic_map, "load_map", lambda: found)
    out = str(tmp_path / "out")
    done = run("--optic", "pair", "--trouble", "noise=0.4", "--out", out, "--json")
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)["calibration"]
    assert [point["value"] for point in said["rig"]["noise"]["points"]] == [0.25, 0.5]
    assert said["rig"]["noise"]["measured_there"]
    assert said["rig"]["fov_deg"]["measured_there"]  # 60 deg, up to rounding
    assert json.loads((tmp_path / "out" / "calibration.json").read_text()) == said
    assert (tmp_path / "out" / "calibration.png").stat().st_size > 1000
    shown = run("--optic", "pair", "--trouble", "noise=0.4", "--out", str(tmp_path / "other"))
    words = " ".join(shown.output.split())
    assert (
        "25 %: 1 answered, 1 named of 2; 0.03 px; 50 %: 1 refused, 1 silent of 2; 0.2 px" in words
    )
    for args, message in (
        (["--trouble", "noise=0.4"], "--trouble applies to the optic of your rig"),
        (["--optic", "pair", "--trouble", "noise"], "--trouble noise: give a name and a number"),
        (
            ["--optic", "pair", "--trouble", "noise=loud"],
            "--trouble noise=loud: give a name and a number",
        ),
        (["--optic", "pair", "--trouble", "wind=1"], "trouble 'wind' of a pair was not measured"),
        (["--optic", "eye"], "optic 'eye' is not known"),
    ):
        refused = run(*args, "--out", str(tmp_path / "none"))
        assert refused.exit_code == 1
        assert message in " ".join(refused.stderr.split())
        assert not (tmp_path / "none").exists()
