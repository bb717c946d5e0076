"""Automatic choice of the model and of the free parameters, on simulated recordings."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    CircleModel,
    Encoder,
    EncoderModel,
    ErrorCode,
    Events,
    ExactModel,
    FlatSide,
    Prism,
    PrismMotion,
    Recording,
    Settings,
    calibrate,
    simulate,
    truth_model,
)
from amiwarp.calib import groundwork
from amiwarp.calib.calibration_events import CalibrationEvents
from amiwarp.calib.event_sample import SAMPLED, EventSample
from amiwarp.calib.groundwork import TILT, Groundwork
from amiwarp.calib.held_out_turns import split_turns
from amiwarp.calib.model_choice import ModelChooser, compare_models
from amiwarp.calib.model_fit import candidate_space, fit_models, linear_motions
from amiwarp.calib.timing_blur import encoder_noise
from amiwarp.calib.trial import CONVERSION_FACTOR, trial_for
from amiwarp.optics import rungs as wedge_models
from amiwarp.optics.models.comparison import rms
from amiwarp.optics.models.several import compensate_by_each
from tests.conftest import COARSE

BOTH = Settings(events=120_000, photometric=COARSE)
SHARPNESS = Settings(events=120_000, stages=("sharpness",))
CONSTANT, DOUBLING = 720.0, np.array([[0.0, 500.0], [0.34, 1000.0]])


def recorded(
    texture: np.ndarray,
    *,
    fov_deg: float,
    apex_deg: float,
    width: int = 160,
    rpm: float | np.ndarray = CONSTANT,
    tilt_deg: float = 0.0,
    encoder: EncoderModel | None = None,
) -> Recording:
    camera = Camera.from_fov(width, 3 * width // 4, math.radians(fov_deg))
    motion = PrismMotion(rpm, phase=1.0, tilt=(math.radians(tilt_deg), 0.0))
    prism = Prism(math.radians(apex_deg))
    return simulate(texture, camera, prism, duration_s=0.34, motion=motion, encoder=encoder, seed=2)


@pytest.fixture(scope="module")
def wide(texture: np.ndarray) -> Recording:
    return recorded(texture, fov_deg=90.0, apex_deg=2.0)


@pytest.fixture(scope="module")
def found(wide: Recording) -> Calibration:
    return calibrate(wide, BOTH)


@pytest.fixture(scope="module")
def as_circle(wide: Recording) -> Calibration:
    """Calibrated with a budget that a circle keeps."""
    return calibrate(wide, BOTH, budget_px=5.0)


def places_of(recording: Recording, most: int = SAMPLED) -> EventSample:
    assert recording.encoder is not None
    return EventSample.of(recording.events.slice(0, len(recording.events)), recording.encoder, most)


def true_exact(recording: Recording) -> ExactModel:
    assert recording.camera is not None
    assert recording.truth is not None
    return truth_model(recording.camera, recording.truth, FlatSide.SCENE)


def test_a_narrow_lens_gets_a_circle(texture: np.ndarray) -> None:
    c = calibrate(recorded(texture, fov_deg=20.0, apex_deg=0.5), SHARPNESS)
    assert c.model_name == "circle"
    assert isinstance(c.model, CircleModel)
    assert c.ladder is not None
    assert c.ladder.rungs[0].predicted_px < c.ladder.budget_px


def test_a_wide_lens_does_not(found: Calibration, wide: Recording) -> None:
    assert found.model_name == "exact"
    assert found.ladder is not None
    truth, places = true_exact(wide), places_of(wide, 50_000)
    rungs = {r.model: r for r in found.ladder.rungs}
    assert list(rungs) == list(wedge_models())
    assert [r.model for r in rungs.values() if r.chosen] == ["exact"]
    exact = replace(found.exact, parameters={"apex": truth.prism.apex, "phase": truth.phase})
    for name in ("circle", "radial"):
        space = candidate_space(name, exact, (), rad_per_us=7.5e-5, duration_us=3e5)
        ((_, error),) = fit_models(
            linear_motions([space], places), places.compensated(truth), places
        )
        assert rungs[name].predicted_px == pytest.approx(error, rel=0.05)
    assert rungs["circle"].predicted_px > 10 * found.ladder.budget_px
    assert rungs["exact"].predicted_px == 0.0


def test_the_answer_is_the_best_fit_to_the_exact_one(
    as_circle: Calibration, wide: Recording
) -> None:
    found = as_circle
    assert found.model_name == "circle"
    assert found.ladder is not None
    assert found.photometric is not None
    assert found.photometric.accepted
    places = places_of(wide)
    away = places.distance(found.model, found.exact.model)
    assert away == pytest.approx(found.ladder.rungs[0].predicted_px, abs=1e-4)
    # The photometric answer is a little less sharp
    local = [s.sharpness for s in found.stages if s.name == "local"]
    assert 0.93 * max(local) < found.sharpness_after < 1.001 * max(local)
    assert set(found.uncertainty) == set(found.free) == {"deflection", "phase"}
    assert found.exact.uncertainty["phase"] == found.uncertainty["phase"]
    ratio = found.uncertainty["deflection"] / found.exact.uncertainty["apex"]
    apex = found.exact.parameters["apex"]
    larger = replace(found.exact, parameters={**found.exact.parameters, "apex": 1.01 * apex})
    space = candidate_space("circle", larger, (), rad_per_us=7.5e-5, duration_us=3e5)
    ((values, _),) = fit_models(
        linear_motions([space], places), places.compensated(larger.model), places
    )
    deflection = values["deflection"]
    assert ratio == pytest.approx(
        (deflection - found.parameters["deflection"]) / (0.01 * apex), rel=0.02
    )
    # an independent method finds no closer circle
    target = places.compensated(found.exact.model)

    def error(v: np.ndarray) -> float:
        model = CircleModel(found.camera, v[0] * 1e-2, v[1])
        return float(np.sqrt(np.mean(np.sum((places.compensated(model) - target) ** 2, axis=1))))

    start = [found.parameters["deflection"] * 1e2, found.parameters["phase"]]
    best = minimize(error, start, method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-6}).fun
    assert found.ladder.rungs[0].predicted_px == pytest.approx(best, abs=1e-4)


def test_the_motion_by_a_clock_offset_follows_the_orbits(
    found: Calibration, wide: Recording
) -> None:
    """A step ahead alone would add 4 % by the orbit's curvature, which looks like an offset."""
    places = places_of(wide)
    places = replace(places, speed=places.speed * np.linspace(0.5, 1.5, len(places.speed)))
    space = candidate_space(
        "exact", found.exact, ("clock_offset",), rad_per_us=7.5e-5, duration_us=3e5
    )
    (motion,) = linear_motions([space], places)
    model, h = space.build(space.start), 0.03
    later, earlier = compensate_by_each(
        [model, model], places.xy, places.theta + np.array([[h], [-h]])
    )
    expected = (later - earlier) / (2.0 * h) * places.speed[:, None] / space.pixels["clock_offset"]
    assert rms(motion.slopes[2] - expected) < 2e-3 * rms(expected)


def test_held_out_turns_see_the_circle_s_error_in_pixels(as_circle: Calibration) -> None:
    assert as_circle.ladder is not None
    circle, exact = as_circle.ladder.rungs[:2]
    assert circle.seen_px is not None
    assert exact.seen_px == (0.0, 0.0)
    assert circle.seen_px[0] > circle.predicted_px / CONVERSION_FACTOR
    assert circle.seen_px[1] < circle.predicted_px * CONVERSION_FACTOR
    assert as_circle.ladder.agreed


def test_held_out_turns_are_not_measured_if_they_cannot_change_the_choice(
    found: Calibration,
) -> None:
    assert found.ladder is not None
    assert [r.seen_px for r in found.ladder.rungs] == [None] * len(wedge_models())
    assert found.ladder.agreed
    assert found.warnings == ()


def test_a_judge_s_objection_is_heard(found: Calibration, wide: Recording) -> None:
    """Even if the predicted error of the circle is zero, the check on held-out turns rejects it."""
    trial = trial_for(wide, found.exact, SHARPNESS, (), device="cpu")
    circle, exact = compare_models(replace(trial, predicted={**trial.predicted, "circle": 0.0}))[:2]
    assert not circle.chosen
    assert circle.seen_px is not None
    assert circle.seen_px[0] > trial.rejection_px
    assert circle.verdict.startswith("predicted under the budget, but held-out turns show an error")
    assert exact.chosen


def test_the_groundwork_of_the_sharpness_answer_serves_the_final_one(
    found: Calibration, wide: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is laid once, during the photometric stage; laid again for the final answer, it gives the same choice."""
    laid: list[Groundwork] = []
    lay = groundwork.lay_groundwork

    def recorded(*given: Any) -> Groundwork:
        laid.append(lay(*given))
        return laid[-1]

    for module in ("trial", "model_choice"):
        monkeypatch.setattr(f"amiwarp.calib.{module}.lay_groundwork", recorded)
    again = calibrate(wide, BOTH)
    assert len(laid) == 1
    assert laid[0].answer.photometric is None
    monkeypatch.setattr(Groundwork, "serves", lambda *_: False)
    late = calibrate(wide, BOTH)
    assert len(laid) == 3
    assert laid[2].answer.photometric is not None
    for c in (found, again):
        assert c.ladder is not None
        assert late.ladder is not None
        for a, b in zip(c.ladder.rungs, late.ladder.rungs, strict=True):
            assert replace(a, predicted_px=0.0) == replace(b, predicted_px=0.0)
            assert a.predicted_px == pytest.approx(b.predicted_px, abs=1e-4)
        assert c.ladder.parameters == late.ladder.parameters

    # Later attempts lay no other one.
    chooser = ModelChooser(wide, BOTH, "cpu")
    for _ in range(2):
        chooser.prepare(found.exact)
    assert len(laid) == 4


def test_the_budget_decides(wide: Recording) -> None:
    assert calibrate(wide, SHARPNESS, budget_px=5.0).model_name == "circle"
    c = calibrate(wide, SHARPNESS, budget_px=1e-5)
    assert c.model_name == "exact"
    assert c.ladder is not None
    assert c.ladder.budget_px == 1e-5
    with pytest.raises(AmiwarpError, match="budget_px"):
        calibrate(wide, SHARPNESS, budget_px=0.0)


def test_the_file_keeps_the_ladder(as_circle: Calibration, tmp_path: Path) -> None:
    found = as_circle
    found.save(tmp_path / "c.json")
    assert Calibration.load(tmp_path / "c.json") == found
    data = json.loads((tmp_path / "c.json").read_text())
    del data["ladder"]  # as in an older file
    (tmp_path / "old.json").write_text(json.dumps(data))
    old = Calibration.load(tmp_path / "old.json")
    assert old == replace(found, ladder=None)
    assert old.exact is old
    for damage in ({"rungs": []}, {"exact": {"apex": "1"}}):
        (tmp_path / "bad.json").write_text(json.dumps(data | {"ladder": damage}))
        with pytest.raises(AmiwarpError, match=r"bad\.json"):
            Calibration.load(tmp_path / "bad.json")


def test_the_command_shows_the_table(
    found: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    from rich.console import Console

    from amiwarp.calib.commands import calibration_lines, calibration_summary

    console = Console(width=1000)
    for line in calibration_lines(
        found, calibration_summary(found) | {"file": "c.json", "device": "cpu"}
    ):
        console.print(line, markup=False)
    out = capsys.readouterr().out
    assert all(f"\n{name} " in out for name in wedge_models())
    assert "chosen: the smallest that keeps the budget" in out
    assert "record at two speeds" in out


def test_at_one_speed_the_clock_offset_is_not_determined(found: Calibration) -> None:
    assert found.ladder is not None
    told = {p.name: p for p in found.ladder.parameters}
    assert not told["clock_offset"].determined
    assert "two speeds" in told["clock_offset"].verdict
    assert not any(p.freed for p in told.values())


def test_a_tilt_that_the_photometric_stage_rules_out_is_not_measured(
    found: Calibration, wide: Recording
) -> None:
    assert found.ladder is not None
    assert found.photometric is not None
    tilt = next(p for p in found.ladder.parameters if p.name == "tilt")
    assert tilt.gain_px is None
    assert tilt.verdict.startswith(
        "held: the photometric stage finds that it moves events by at most 0.0"
    )
    for center_px, names in (
        ((0.0, 0.001), ()),
        ((0.1, 0.001), TILT),
        ((0.0, 0.1), TILT),
        (None, TILT),
    ):
        exact = replace(found.exact, photometric=replace(found.photometric, center_px=center_px))
        trial = trial_for(wide, exact, BOTH, TILT, device="cpu")
        assert trial.space.names == ("apex", "phase", *names)


def test_a_clock_offset_is_freed_where_the_speed_changes(texture: np.ndarray) -> None:
    late = EncoderModel(clock_offset_us=3000.0)
    recording = recorded(texture, fov_deg=60.0, apex_deg=2.0, rpm=DOUBLING, encoder=late)
    # Along a ridge of clock offset and phase, the sharpness hardly changes: another start ends elsewhere on it.
    c = calibrate(recording, replace(SHARPNESS, global_algorithm="GN_DIRECT_L"))
    assert c.ladder is not None
    assert [p.name for p in c.ladder.parameters if p.freed] == ["clock_offset"]
    # Us; the sensor's latency adds to it
    assert c.parameters["clock_offset"] == pytest.approx(3000.0, abs=400.0)
    assert "clock_offset" in c.uncertainty
    assert c.model_name == "exact"


def test_a_tilt_is_freed_through_a_wide_lens(texture: np.ndarray) -> None:
    c = calibrate(recorded(texture, fov_deg=90.0, apex_deg=3.0, tilt_deg=4.0, width=240), SHARPNESS)
    assert c.ladder is not None
    assert [p.name for p in c.ladder.parameters if p.freed] == ["tilt"]
    assert math.degrees(c.exact.parameters["tilt_x"]) == pytest.approx(4.0, abs=0.5)
    assert math.degrees(c.exact.parameters["tilt_y"]) == pytest.approx(0.0, abs=0.5)


def test_what_is_given_is_left_alone(wide: Recording) -> None:
    c = calibrate(wide, replace(SHARPNESS, free=("apex", "phase")))
    assert c.ladder is not None
    assert c.ladder.parameters == ()


def test_a_lag_is_no_error_of_the_model(found: Calibration, wide: Recording) -> None:
    places, exact = places_of(wide), found.exact
    late = replace(
        exact, parameters={**exact.parameters, "phase": exact.parameters["phase"] + 0.05}
    ).model
    apart = places.distance(late, exact.model)
    assert apart > 0.1
    assert places.distance(late, exact.model, remove_lag=True) < 0.05 * apart


def test_halves_are_alternate_turns() -> None:
    t = np.arange(0, 1_000_000, 100, dtype=np.int64)
    zero = np.zeros(len(t), np.uint16)
    encoder = Encoder.constant_speed(300.0, 0, 1_000_000)  # five turns
    first, second = split_turns(
        CalibrationEvents(Events(zero, zero, t, zero.astype(np.uint8)), encoder, None)
    )
    assert np.array_equal(np.sort(np.concatenate([first.t, second.t])), t)
    # an event at the border of two turns may belong to either
    whole = [half.t[half.t % 200_000 > 1000] // 200_000 for half in (first, second)]
    assert [set(turns.tolist()) for turns in whole] == [{0, 2, 4}, {1, 3}]


def test_turns_of_an_encoder_that_stands_still_cannot_be_held_out() -> None:
    still = Encoder(np.array([0, 10_000]), np.zeros(2))
    events = Events.from_arrays([1, 2], [1, 2], [0, 5000], [0, 1])
    with pytest.raises(AmiwarpError, match="the encoder stands still") as caught:
        split_turns(CalibrationEvents(events, still, None))
    assert caught.value.code is ErrorCode.CALIBRATION_REFUSED


def test_an_encoder_s_noise_is_told_from_its_speeding_up() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.integers(800, 1200, 4000)).astype(np.int64)
    ramp = 1e-5 * t + 1e-12 * t.astype(np.float64) ** 2
    assert encoder_noise(Encoder(t, ramp + rng.normal(0.0, 1e-3, len(t)))) == pytest.approx(
        1e-3, rel=0.1
    )
    assert encoder_noise(Encoder(t, ramp)) < 1e-5


def test_every_device_judges_alike(found: Calibration, wide: Recording, device: str) -> None:
    trial = trial_for(wide, found.exact, SHARPNESS, (), device=device)
    values = trial.sharpest([0, 1])
    assert (
        trial.test.of_parts(trial.space, values).mean()
        > trial.test.of_parts(trial.space, {**values, "apex": 0.0}).mean()
    )
    assert np.abs(trial.start - trial.space.to_vector(values)).max() < 0.3  # px
