"""What is stated of an answer's error: a deviation and bounds for the motion of events, not for a parameter."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amiwarp import (
    Calibration,
    Camera,
    PhotometricSettings,
    Prism,
    Recording,
    calibrate,
    predicted_error,
    simulate,
)
from amiwarp.calib.calibrator import few_events_in_words
from amiwarp.calib.photometric.causes import CENTER, FOCAL_LENGTH, with_cause
from amiwarp.calib.photometric.consistency import CLOCK
from amiwarp.calib.photometric.corrections import NOISE, NOISE_PX, motion_error
from amiwarp.calib.photometric.limits import FEW_EVENTS, NOTABLE_DEVIATION_PX
from amiwarp.calib.photometric.linear_fit import LinearFit
from amiwarp.calib.photometric.sectors import ERROR_THAT_REPEATS
from amiwarp.calib.photometric.stated_errors import hidden_px, motion_slopes, shift_px, spread_px
from amiwarp.calib.photometric.systematic import least_errors
from amiwarp.results import make_space

CAMERA = Camera.from_fov(160, 120, math.radians(60.0))
PRISM = Prism(math.radians(1.5))
FEW = {"model": "exact", "events": 60_000, "global_evaluations": 60}


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> Recording:
    """Two turns of a prism whose apex is stated 5 % too large."""
    return simulate(
        texture, CAMERA, PRISM, duration_s=0.17, seed=3, nominal_prism=Prism(1.05 * PRISM.apex)
    )


@pytest.fixture(scope="module")
def found(recording: Recording) -> Calibration:
    return calibrate(recording, photometric=PhotometricSettings(pairs=60_000, density=1.0), **FEW)  # type: ignore[arg-type]


def test_slopes_are_those_of_the_model_without_its_lag() -> None:
    space = make_space(
        "exact",
        CAMERA,
        PRISM,
        free=None,
        start={"phase": 0.4},
        bounds={},
        rad_per_us=75e-6,
        duration_us=2e5,
    )
    v = space.to_vector(space.start)
    slopes = motion_slopes(space, v)
    here = space.build(space.to_values(v))
    for step in (np.array([0.03, 0.0]), np.array([0.0, 0.03]), np.array([0.02, -0.02])):
        moved = space.build(space.to_values(v + step))
        expected = predicted_error(moved, here, remove_lag=True, grid=8).rms
        assert shift_px(slopes, step) == pytest.approx(expected, rel=0.06, abs=2e-4)
    # A change of the phase alone is a lag: nothing of it is left.
    values = space.to_values(v)
    turned = space.to_vector({**values, "phase": values["phase"] + 0.01}) - v
    assert np.linalg.norm(turned) > 0.02
    assert shift_px(slopes, turned) < 0.02 * np.linalg.norm(turned)


def test_the_spread_adds_variances() -> None:
    slopes = np.zeros((2, 4, 2))
    slopes[0, :, 0] = 2.0
    slopes[1, :2, 1] = 3.0
    covariance = np.diag([0.25, 1.0])
    assert spread_px(slopes, covariance) == pytest.approx(math.sqrt(4.0 * 0.25 + 9.0 * 1.0 * 0.5))
    assert shift_px(slopes, np.array([0.5, 0.0])) == pytest.approx(1.0)
    assert shift_px(slopes, np.array([-0.5, 0.0])) == pytest.approx(1.0)


def test_the_deviation_covers_the_error_and_is_smaller_than_the_doubt_about_the_apex(
    recording: Recording, found: Calibration
) -> None:
    truth = found.model.from_prism(CAMERA, PRISM)
    error = predicted_error(found.model, truth, remove_lag=True).rms
    stage = found.photometric
    assert stage is not None
    assert stage.deviation_px is not None
    assert error < 3.0 * stage.deviation_px
    assert stage.deviation_px < 0.03
    # The lens may be wrong by 1 %, which is an error of the apex, but not of the motion.
    larger = replace(
        found,
        parameters={
            **found.parameters,
            "apex": found.parameters["apex"] + found.uncertainty["apex"],
        },
    )
    assert (
        stage.deviation_px < 0.8 * predicted_error(larger.model, found.model, remove_lag=True).rms
    )


def test_the_bound_of_a_focal_length_covers_what_a_wrong_one_does(
    recording: Recording, found: Calibration
) -> None:
    """A focal length that is wrong by too little to be noticed moves the answer by less than its bound."""
    stage = found.photometric
    assert stage is not None
    bound = stage.hidden_px[FOCAL_LENGTH.words]
    assert 0.0 < bound < 0.1
    wrong = replace(CAMERA, fx=1.002 * CAMERA.fx, fy=1.002 * CAMERA.fy)
    again = calibrate(
        replace(recording, camera=wrong),
        photometric=PhotometricSettings(pairs=60_000, density=1.0),
        **FEW,  # type: ignore[arg-type]
    )
    assert again.warnings == found.warnings
    away = predicted_error(again.model, found.model, remove_lag=True).rms
    assert 0.0 < away < bound
    assert again.photometric is not None
    assert away < again.photometric.hidden_px[FOCAL_LENGTH.words]


def test_the_least_error_of_a_motion_does_not_grow_with_its_parameters() -> None:
    for model, start in (
        ("exact", {"phase": 0.4}),
        ("mirror", {"phase": 0.4, "ratio": 1.3, "second_phase": 0.2}),
    ):
        space = make_space(
            model,
            CAMERA,
            PRISM,
            free=None,
            start=start,
            bounds={},
            rad_per_us=75e-6,
            duration_us=2e5,
        )
        v = space.to_vector(space.start)
        n = len(v)
        answer = SimpleNamespace(covariance=np.zeros((n, n)), cost=0.1)
        state: Any = SimpleNamespace(
            space=space, answer=answer, timing=np.zeros(0), doubt=np.zeros(0), apart=()
        )
        check: Any = SimpleNamespace(method=np.zeros((n, n)), step=np.zeros(n), hidden_px={})
        assert motion_error(state, check, v).deviation_px == pytest.approx(0.002)
        check.method = np.diag([0.01**2, *[0.0] * (n - 1)])
        assert motion_error(state, check, v).deviation_px > 0.004
        assert np.count_nonzero(least_errors(space)) == n


def test_what_no_map_explains_could_hide_an_error(found: Calibration) -> None:
    stage = found.photometric
    assert stage is not None
    assert stage.hidden_px[NOISE] == pytest.approx(NOISE_PX * stage.cost)
    assert {CLOCK, f"{ERROR_THAT_REPEATS} the encoder's angle"} <= {*stage.hidden_px}
    assert all(0.0 < stage.hidden_px[words] < 0.1 for words in stage.hidden_px)


def test_few_events_are_named_if_they_leave_the_motion_uncertain(found: Calibration) -> None:
    assert found.photometric is not None
    poor = replace(found.photometric, deviation_px=NOTABLE_DEVIATION_PX)
    [said] = few_events_in_words(poor, FEW_EVENTS - 1)
    assert f"few events: the {FEW_EVENTS - 1:,} events" in said
    assert f"{NOTABLE_DEVIATION_PX:g} px" in said
    assert few_events_in_words(poor, FEW_EVENTS) == []
    good = replace(poor, deviation_px=0.99 * NOTABLE_DEVIATION_PX)
    assert few_events_in_words(good, FEW_EVENTS - 1) == []
    assert few_events_in_words(replace(poor, deviation_px=None), FEW_EVENTS - 1) == []


def test_both_figures_are_kept_and_printed(
    found: Calibration, recording: Recording, tmp_path: Path
) -> None:
    found.save(tmp_path / "c.json")
    loaded = Calibration.load(tmp_path / "c.json")
    assert loaded.photometric == found.photometric
    from amiwarp.calib.commands import calibration_lines, calibration_summary

    data = {**calibration_summary(found), "file": "c.json", "device": "cpu"}
    said = "\n".join(str(line) for line in calibration_lines(found, data))
    assert found.photometric is not None
    assert (
        f"the events determine their motion within ± {found.photometric.deviation_px:.2g} px rms"
        in said
    )
    for words, px in found.photometric.hidden_px.items():
        assert f"{words} {px:.2g} px" in said


def test_a_bound_is_the_estimate_and_twice_its_scatter_beyond_the_parameters_own() -> None:
    space = make_space(
        "exact",
        CAMERA,
        PRISM,
        free=("apex", "phase"),
        start={},
        bounds={},
        rad_per_us=75e-6,
        duration_us=2e5,
    )
    v = space.to_vector({"apex": PRISM.apex, "phase": 0.4})
    rng = np.random.default_rng(1)
    squares = 400
    gradient = rng.normal(0.0, [3.0, 3.0, 0.5], (squares, 3))
    gradient -= gradient.mean(axis=0)
    gradient[:, 2] += 0.4
    hessian = np.tile(np.diag([100.0, 100.0, 20.0]), (squares, 1, 1))
    fit = LinearFit(
        ("apex", "phase", "focal_length"),
        hessian,
        gradient,
        np.zeros((squares, 2)),
        squares_sum=1.0,
    )
    estimate = abs(gradient[:, 2].sum()) / (20.0 * squares)
    scatter = 0.5 * math.sqrt(squares) / (20.0 * squares)
    wide, at = with_cause(space, FOCAL_LENGTH, space.to_values(v))
    per_px = shift_px(motion_slopes(wide, at), np.array([0.0, 0.0, 1.0]))
    found = hidden_px(space, v, fit, (FOCAL_LENGTH, CENTER))
    assert found == {
        FOCAL_LENGTH.words: pytest.approx((estimate + 2.0 * scatter) * per_px, rel=0.1)
    }
    assert scatter > 0.05 * estimate
    # What scatters anyway is no part of it.
    calm = replace(fit, gradient=gradient * [0.01, 0.01, 1.0])
    again = hidden_px(space, v, calm, (FOCAL_LENGTH,))
    assert again[FOCAL_LENGTH.words] == pytest.approx(found[FOCAL_LENGTH.words], rel=0.02)
