"""The photometric stage is a list of steps, each from one frozen state to the next."""

import math
from collections.abc import Iterator
from dataclasses import FrozenInstanceError, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amiwarp import (
    Camera,
    FlatSide,
    PhotometricSettings,
    Prism,
    RadialTangential,
    Recording,
    SensorTiming,
    Settings,
    simulate,
)
from amiwarp.calib.photometric import (
    angles,
    corrections,
    losses,
    sectors,
    steps,
    timing,
    verdicts,
)
from amiwarp.calib.photometric.causes import FACES, FOCAL_LENGTH, SIDE
from amiwarp.calib.photometric.equations import Problem
from amiwarp.calib.photometric.findings import (
    BlindTime,
    FlatSideCorrected,
    LensBeyondCorrection,
    MissingEvents,
    MotionError,
    Optimum,
    RefractoryDoubt,
    RefractoryPeriod,
    SectorError,
    Silence,
    SlowPixels,
)
from amiwarp.calib.photometric.refinement import Refinement, first_answer
from amiwarp.calib.photometric.verdicts import (
    refusal,
    refused,
    warned,
    warnings,
)
from amiwarp.calib.preparation import prepare
from amiwarp.optics.prism import as_wedge

CAMERA = Camera.from_fov(120, 90, math.radians(70.0))
GOOD = Optimum(cost=0.1, rise=0.05, moved_px=0.2, next_step_px=0.0)


@pytest.fixture(scope="module")
def still(texture: np.ndarray) -> Recording:
    return simulate(texture, CAMERA, Prism(math.radians(2.0)), duration_s=0.17, seed=6)


@pytest.fixture(scope="module")
def problem(still: Recording) -> Problem:
    photometric = PhotometricSettings(pairs=30_000, density=1.0)
    settings = Settings(
        model="exact", events=30_000, global_evaluations=60, photometric=photometric
    )
    [search] = prepare(still, settings)
    return Problem(still, search.run())


@pytest.fixture(scope="module")
def first(problem: Problem) -> Refinement:
    return first_answer(problem, problem.settings.sensor)


def test_a_search_through_another_lens_measures_its_image(problem: Problem) -> None:
    sharp = problem.sharp
    bent = replace(CAMERA, distortion=RadialTangential(k1=-0.1))
    through = sharp.through(bent)
    assert through.answer == sharp.answer
    assert through.stages == sharp.stages
    assert {through.space.camera, through.full_space.camera} == {bent}
    here = sharp.sharpness_in(sharp.space, sharp.best)
    there = sharp.sharpness_in(through.space, sharp.best)
    assert abs(there - here) > 1e-3 * here
    assert through.fine.values(sharp.best) == there
    assert through.sharpness_in(sharp.space, sharp.best) == here


def test_steps_without_anything_to_do_return_the_same_state(first: Refinement) -> None:
    for applies, step in steps.STEPS:
        if applies(first.problem) and step not in (
            losses.see_what_can_be_examined,
            losses.count_lost_events,
            steps.correct_camera_and_prism,
        ):
            assert step(first) is first, step.__name__


def steps_for(problem: Problem) -> set[str]:
    """Return the names of the steps that apply, but of those that always do."""
    return {
        step.__name__
        for applies, step in steps.STEPS
        if applies is not steps.always and applies(problem)
    }


def test_steps_apply_to_the_model_and_the_recording(problem: Problem) -> None:
    assert steps_for(problem) == {"examine_the_angles"}
    assert steps_for(replace(problem, angles_hold=True)) == {"examine_accepted_angles"}
    fast = replace(problem, fast=True)
    assert steps_for(fast) == {"examine_the_angles", "follow_a_fast_camera"}
    space = problem.sharp.full_space
    turning = replace(space, start={**space.start, "rate_x": 0.1})
    moving = replace(problem, sharp=replace(problem.sharp, full_space=turning))
    assert steps_for(moving) == {"examine_the_angles", "follow_a_slow_camera"}

    of_vibration = replace(problem.sharp, space=replace(problem.sharp.space, model="vibration"))
    measured = replace(problem, sharp=of_vibration)
    blind = {
        "examine_the_angles",
        "bound_what_blind_pixels_hide",
        "weigh_the_refractory_doubt",
    }
    assert steps_for(measured) == blind
    unmeasured = replace(measured, recording=replace(problem.recording, encoder=None))
    assert steps_for(unmeasured) == {*blind, "refuse_unsteady_motion"}


def test_the_state_is_frozen_and_a_finished_one_is_the_last(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[str] = []

    def one(state: Refinement) -> Refinement:
        taken.append("one")
        return state.noticing(Silence(0.5)).ending()

    def two(state: Refinement) -> Refinement:
        taken.append("two")
        return state

    def three(state: Refinement) -> Refinement:
        taken.append("three")
        return state

    def never(problem: Problem) -> bool:
        return False

    monkeypatch.setattr(steps, "STEPS", ((never, three), (steps.always, one), (steps.always, two)))
    state = steps.refine(problem)
    assert taken == ["one"]
    assert state.findings == (Silence(0.5),)
    with pytest.raises(FrozenInstanceError):
        state.finished = False  # type: ignore[misc]


def test_a_cost_in_another_space_leaves_the_first_one_as_it_is(
    first: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both use one map. What is known about it in one space must not be taken for the other one."""
    search, v = first.search, first.answer.x
    cost = search.cost
    cost.residuals(v, rounds=2)
    assert cost.known_column("name") is None
    assert cost.keep_column("name", "column") == cost.known_column("name") == "column"
    space = search.space
    other = search.with_cause(FOCAL_LENGTH, v)
    assert (search.space, cost.space) == (space, space)
    assert other.cost.shared is cost.shared
    assert other.space.names == (*space.names, "focal_length")
    wide = other.space.to_vector({**other.space.start, **space.to_values(v)})
    other.cost.slopes(wide)
    assert cost.known_column("name") is None
    solved: list[int] = []
    monkeypatch.setattr(cost.brightness, "solve", lambda *_, rounds, **__: solved.append(rounds))
    cost.converge(v)  # the map was solved in the other space
    cost.converge(v)
    assert solved == [2]
    other.cost.slopes(wide)
    moved = np.array([0.1, 0.0])
    added: list[float] = []
    monkeypatch.setattr(cost.brightness, "add", lambda _, by: added.append(by))
    other.cost.predict(wide + np.append(moved, 0.0))
    assert added == pytest.approx([0.1, 0.0, 0.0])
    cost.predict(v + moved)  # by derivatives of the map in this space, of which there are none
    assert len(added) == 3


def test_the_other_flat_side_has_its_own_result_of_the_sharpness_stage(first: Refinement) -> None:
    search = first.search
    turned = search.with_cause(SIDE, first.answer.x)
    assert as_wedge(turned.space.prism).flat_side is not as_wedge(search.space.prism).flat_side
    assert math.remainder(
        turned.sharpest["phase"] - search.sharpest["phase"] - math.pi, math.tau
    ) == pytest.approx(0.0)
    assert search.sharpest["apex"] == first.problem.sharp.best["apex"]


class Stopped(Exception):
    """The user stopped the work."""


@pytest.mark.parametrize("what", ["angle", "refractory"])
def test_angles_of_the_pairs_are_the_given_ones_after_a_stop(
    first: Refinement, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    azimuth = first.equations.pairs.arrays.azimuth
    given = azimuth.numpy().copy()
    changed: list[bool] = []

    def stop(self: Any, start: np.ndarray, most_cost: float | None = None) -> Any:
        changed.append(not np.array_equal(azimuth.numpy(), given))
        raise Stopped

    monkeypatch.setattr(type(first.search), "descend", stop)
    monkeypatch.setattr(angles, "fit_angles", lambda *_: {"cos 1 of angle 0": 0.05})
    search, v = first.search, first.answer.x
    changing = {
        "angle": lambda: angles.find_angle_errors(search, v),
        "refractory": lambda: timing.find_refractory(search, v, 0.05, 1.0),
    }
    with pytest.raises(Stopped):
        changing[what]()
    assert changed == [True]
    np.testing.assert_array_equal(azimuth.numpy(), given)


def test_the_first_reason_counts_whatever_the_order_of_the_findings() -> None:
    lens, lost = LensBeyondCorrection({"focal_length": 50.0}), MissingEvents(0.3)
    slow = SlowPixels(4000.0, 0.5, 0.1)
    bad = replace(GOOD, cost=0.9)
    assert refusal((GOOD,)) == refusal((GOOD, Silence(0.4))) == ""
    assert refusal((GOOD, lost, slow)) == refusal((GOOD, slow, lost)) == refused(slow)
    assert refusal((bad, slow, lost)) == refused(bad)
    assert refusal((bad, slow, lens)) == refused(lens)


def test_warnings_have_one_order() -> None:
    found = (
        FlatSideCorrected(FlatSide.CAMERA, FlatSide.SCENE),
        BlindTime(0.42, SensorTiming(refractory_us=300.0)),
        Silence(0.2),
        RefractoryPeriod(900.0),
    )
    said = warnings(found)
    assert said == warnings(found[::-1])
    assert [
        words
        for each in said
        for words in (
            "refractory period): 900",
            "20 % of the time",
            "points to the scene",
            "by up to 0.42 px",
        )
        if words in each
    ] == ["refractory period): 900", "20 % of the time", "points to the scene", "by up to 0.42 px"]


def test_a_period_that_is_not_given_is_named_as_assumed() -> None:
    assumed, known = (
        refused(BlindTime(0.6, SensorTiming(refractory_us=given))) for given in (None, 100.0)
    )
    assert "period if that is 100 us, so that events are lost: give the period by --refr" in assumed
    assert "refractory period, so that events are lost: let the image move less" in known


@pytest.mark.parametrize(
    ("refractory_us", "std_us", "said"),
    [
        (None, 100.0, "which is not given"),
        (0.0, 0.0, "given as 0 us"),
        (200.0, 60.0, "given as 200 us"),
    ],
)
def test_a_refractory_period_of_0_is_known(
    refractory_us: float | None, std_us: float, said: str
) -> None:
    sensor = SensorTiming(refractory_us=refractory_us)
    assert sensor.pause_us == (refractory_us or 0.0)
    assert verdicts.refractory_doubt_us(sensor) == pytest.approx(std_us)
    assert said in refused(RefractoryDoubt(sensor, 0.02))


def kinds(base: type) -> Iterator[type]:
    for kind in base.__subclasses__():
        yield kind
        yield from kinds(kind)


def test_every_finding_is_said_or_refused() -> None:
    from amiwarp.calib.photometric.findings import Finding

    for kind in {*kinds(Finding)} - {MotionError}:  # which the result itself states
        assert (refused.dispatch(kind) is not refused.dispatch(object)) == (
            kind in verdicts.REFUSED_IN_ORDER
        )
        assert (warned.dispatch(kind) is not warned.dispatch(object)) == (
            kind in verdicts.SAID_IN_ORDER
        )
        assert kind in (*verdicts.REFUSED_IN_ORDER, *verdicts.SAID_IN_ORDER)


@pytest.mark.parametrize(
    ("likely", "rotation_gain", "is_kept"),
    [((), 0.0, True), (("x",), 0.0, False), ((), 0.2, False)],
)
def test_a_correction_of_noisy_events_is_kept_if_nothing_else_is_left(
    first: Refinement,
    monkeypatch: pytest.MonkeyPatch,
    likely: tuple[str, ...],
    rotation_gain: float,
    is_kept: bool,
) -> None:
    """The cost stays high by noise. With another cause or a turning camera left, the given camera is taken again."""
    optimum = replace(first.answer.optimum, cost=0.27)
    given = replace(first, answer=replace(first.answer, optimum=optimum))
    search = first.search.with_cause(FACES, first.answer.x)
    shape = {"cylinder_x": 1e-3, "cylinder_y": 2e-3}
    moved = search.space.to_vector({**search.space.start, **first.answer.parameters, **shape})
    answer = replace(
        first.answer,
        optimum=replace(optimum, cost=0.24),
        stage=replace(first.answer.stage, x=moved),
        parameters=search.space.to_values(moved),
    )
    best = corrections.Corrected(FACES, search, answer, 0.24)
    corrected = iter([best])
    monkeypatch.setattr(corrections, "_best_correction", lambda _: next(corrected, None))
    check: Any = SimpleNamespace(
        likely=likely, rotation_gain=rotation_gain, shake_px=0.0, step=np.zeros(4)
    )
    monkeypatch.setattr(corrections, "_checked", lambda state: replace(state, check=check))
    found = corrections.correct_camera_and_prism(given)
    assert (found.answer.cost == 0.24) == ("cylinder_x" in found.space.names) == is_kept
    assert (found.answer.cost == 0.27) != is_kept


def test_harmonics_that_explain_what_sectors_leave_are_given(
    first: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are no reason to refuse an answer: the calibration is tried again with them."""
    third = (0.0, 0.0, 0.0, 0.0, 0.02, 0.0)
    offsets = np.tile([0.05, -0.05], sectors.SECTORS // 2)[None]
    monkeypatch.setattr(sectors, "find_high_harmonics", lambda *_: third)
    seen = losses.see_what_can_be_examined(first)
    for ratio, expected in ((2.0, ()), (9.0, third)):
        ratios = np.array([ratio])
        monkeypatch.setattr(sectors, "sector_offsets", lambda *_, by=ratios: (offsets, by))
        noted = sectors.note_what_sectors_leave(seen)
        assert noted.refusal == ""
        result, *_ = steps.summarised(noted)
        assert result.harmonics == expected


def test_sectors_are_not_examined_where_pixels_are_slow(
    first: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    offsets = np.tile([0.05, -0.05], sectors.SECTORS // 2)[None]
    monkeypatch.setattr(sectors, "sector_offsets", lambda *_: (offsets, np.array([9.0])))
    seen = losses.see_what_can_be_examined(first)
    monkeypatch.setattr(sectors, "find_high_harmonics", lambda *_: ())
    [found] = sectors.note_what_sectors_leave(seen).findings
    assert isinstance(found, SectorError)
    left_px = 0.05 * np.linalg.norm(first.answer.x[:2])
    assert found.moved_px == pytest.approx(left_px / sectors.FOUND_SHARE)
    # what the sectors leave is stated as what could hide too, significant or not
    stated = seen.noticing(MotionError(0.004, {"the focal length": 0.003}))
    monkeypatch.setattr(sectors, "sector_offsets", lambda *_: (offsets, np.array([1.0])))
    noted = sectors.note_what_sectors_leave(stated)
    assert noted.findings == stated.findings
    assert noted.hidden_px == {
        "an error that repeats with the encoder's angle": pytest.approx(
            left_px / sectors.LEAST_FOUND_SHARE
        ),
    }
    assert stated.hidden_px == {}
    monkeypatch.setattr(sectors, "sector_offsets", lambda *_: (offsets, np.array([9.0])))
    assert sectors.note_what_sectors_leave(replace(seen, time_constant_us=2000.0)).findings == ()
