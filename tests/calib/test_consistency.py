"""The photometric answer must hold everywhere in the image and over time; a wrong camera or flat side is corrected."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    CameraMotion,
    Encoder,
    Events,
    FlatSide,
    MemoryEvents,
    ParameterSpace,
    PhotometricSettings,
    Prism,
    PrismMotion,
    RadialTangential,
    Recording,
    SensorModel,
    calibrate,
    model_error,
    simulate,
    truth_model,
)
from amiwarp.calib import straight_angles
from amiwarp.calib.photometric import angles, limits, systematic
from amiwarp.calib.photometric.causes import FACES, FOCAL_LENGTH, SEAT, SIDE
from amiwarp.calib.photometric.consistency import CLOCK, LEAST_GAIN, Consistency, LikelyCause
from amiwarp.calib.photometric.findings import RivalCauses
from amiwarp.calib.photometric.linear_fit import LinearFit
from amiwarp.calib.photometric.verdicts import likeliest, refused, rivals_in_words, warned
from amiwarp.results import make_space
from amiwarp.studies.stability.scenes import polygons

CAMERA = Camera.from_fov(160, 120, math.radians(90.0))
PRISM = Prism(math.radians(2.0))


@pytest.fixture(scope="module")
def wide(texture: np.ndarray) -> Recording:
    """Two turns through a wide lens."""
    return simulate(texture, CAMERA, PRISM, duration_s=0.17, seed=6)


def calibrated(recording: Recording, density: float = 2.0, **settings: Any) -> Calibration:
    """Return a calibration from few events. One node per pixel is a third faster, and the orbit 0.01 px too large."""
    given = {"model": "exact", "events": 60_000, "global_evaluations": 60, **settings}
    return calibrate(
        recording, photometric=PhotometricSettings(pairs=60_000, density=density), **given
    )


def error_px(recording: Recording, found: Calibration, camera: Camera = CAMERA) -> float:
    assert recording.truth is not None
    return model_error(found.model, truth_model(camera, recording.truth, FlatSide.SCENE)).rms


def test_a_right_camera_is_left_alone(wide: Recording) -> None:
    found = calibrated(wide)
    assert found.camera == CAMERA
    assert found.harmonics is None
    assert not {"cylinder_x", "wobble_x"} & found.parameters.keys()
    assert found.warnings == ()
    assert error_px(wide, found) < 0.02
    assert abs(found.parameters["apex"] - PRISM.apex) < 3.0 * found.uncertainty["apex"]


def test_a_distortion_that_was_not_given_is_found(texture: np.ndarray) -> None:
    camera = replace(CAMERA, distortion=RadialTangential(k1=-0.1))
    recording = simulate(texture, camera, PRISM, duration_s=0.17, seed=6)
    found = calibrated(replace(recording, camera=CAMERA), density=1.0)
    assert error_px(recording, found, camera) < 0.03
    assert isinstance(found.camera.distortion, RadialTangential)
    assert found.camera.distortion.k1 == pytest.approx(-0.1, abs=0.01)
    assert any("contradict k1 = 0" in w for w in found.warnings)
    assert set(found.parameters) == {*found.free} == {"apex", "phase"}
    assert found.photometric is not None
    assert "k1" in found.photometric.uncertainty


def test_the_flat_side_is_found(wide: Recording) -> None:
    found = calibrated(replace(wide, prism=replace(PRISM, flat_side=FlatSide.CAMERA)))
    assert found.prism.flat_side is FlatSide.SCENE
    assert error_px(wide, found) < 0.02
    assert any("flat face of the prism points to the scene" in w for w in found.warnings)


def test_the_index_is_found(texture: np.ndarray) -> None:
    """Without it, a wobble, a focal length and a distortion would share the error."""
    prism = Prism(math.radians(4.0))
    recording = simulate(texture, CAMERA, prism, duration_s=0.17, seed=6)
    found = calibrated(replace(recording, prism=replace(prism, index=prism.index - 0.06)))
    assert found.parameters["index"] == pytest.approx(prism.index, abs=0.01)
    assert found.parameters["apex"] == pytest.approx(prism.apex, rel=0.02)
    assert found.camera == CAMERA
    assert error_px(recording, found) < 0.01
    assert any(
        "contradict index = 1.4568" in w and "give that of the glass" in w for w in found.warnings
    )


def test_a_drifting_phase_is_reported(wide: Recording) -> None:
    assert wide.encoder is not None
    slipping = replace(wide, encoder=Encoder(wide.encoder.t, wide.encoder.angle * 1.008))
    assert any(
        "drifts over the recording" in w and "encoder" in w for w in calibrated(slipping).warnings
    )


HARMONICS = np.radians([1.2, 2.5, 0.0, -0.8])
"""Error of an encoder: factors of cos, sin, cos 2 and sin 2 of the true angle."""


def bent(encoder: Encoder) -> Encoder:
    """Return an encoder that reads its angle wrongly, in the same way each turn."""
    turns = np.stack(
        [
            np.cos(encoder.angle),
            np.sin(encoder.angle),
            np.cos(2 * encoder.angle),
            np.sin(2 * encoder.angle),
        ]
    )
    return replace(encoder, angle=encoder.angle + HARMONICS @ turns)


@pytest.mark.parametrize("model", ["exact", "auto"])
def test_an_encoder_that_is_off_centre_is_corrected(
    wide: Recording, model: str, tmp_path: Path
) -> None:
    assert wide.encoder is not None
    given = replace(wide, encoder=bent(wide.encoder))
    found = calibrated(given, model=model)
    assert found.harmonics is not None
    assert any(
        re.search(r"angle is wrong by 2\.[78] deg once a turn", said) for said in found.warnings
    )
    t = np.arange(wide.events.t_first, wide.events.t_last, 97)
    left = found.encoder_for(given.encoder, int(t[0]), int(t[-1])).angle_at(
        t
    ) - wide.encoder.angle_at(t)
    assert np.abs(left - left.mean()).max() < np.radians(0.25)  # 0.01 px
    assert error_px(wide, found) < 0.02
    found.save(tmp_path / "calibration.json")
    assert Calibration.load(tmp_path / "calibration.json").harmonics == found.harmonics


def test_an_accepted_answer_confirms_a_corrected_encoder(
    wide: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its cost may be that of other pairs: the last turn may no longer be whole at the corrected speed."""
    assert wide.encoder is not None
    monkeypatch.setattr(straight_angles, "LARGEST_STRAIGHT_COST_RATIO", 0.0)
    assert calibrated(replace(wide, encoder=bent(wide.encoder))).harmonics is not None


def test_an_error_that_cannot_be_corrected_is_refused(
    wide: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert wide.encoder is not None
    given = replace(wide, encoder=bent(wide.encoder))
    monkeypatch.setattr(
        Encoder, "with_harmonics", lambda self, _: replace(self, angle=1.2 * self.angle)
    )
    with pytest.raises(
        AmiwarpError, match=r"wrong by 2\.[78] deg once .* 0\.\d+ deg twice a turn.*not confirmed"
    ):
        calibrated(given)


def read_by_column(recording: Recording, delay_us: int) -> Recording:
    """Return the recording of a sensor that reads each column later than the last one."""
    events = recording.events.slice(0, len(recording.events))  # type: ignore[attr-defined]
    t = events.t + delay_us * events.x.astype(np.int64)
    order = np.argsort(t, kind="stable")
    skewed = Events(events.x[order], events.y[order], t[order], events.p[order])
    return replace(recording, events=MemoryEvents(skewed, 160, 120))


def test_pixels_that_are_read_one_after_another_are_named(wide: Recording) -> None:
    with pytest.raises(
        AmiwarpError, match=r"events come late by .* us more from column to column"
    ) as refused:
        calibrated(read_by_column(wide, 6), density=1.0)
    found = re.search(r"late by (\S+) us more", str(refused.value))
    assert found is not None
    assert float(found[1]) == pytest.approx(6.0, abs=1.0)


def test_an_accepted_delay_of_the_read_out_is_reported_and_no_error_of_the_encoder(
    wide: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "LARGEST_SKEW_PX", 0.1)
    found = calibrated(read_by_column(wide, 6), density=1.0)
    assert any(
        re.search(r"late by [56]\.?\d* us more from column to column", said)
        for said in found.warnings
    )
    assert found.harmonics is None
    assert found.parameters["apex"] == pytest.approx(PRISM.apex, rel=0.01)


def test_a_very_wrong_camera_is_no_error_of_the_encoder(
    wide: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A false error of the angle is found first; the camera is corrected with it and without it."""
    errors = iter([dict(zip(angles.harmonics_of(0), (0.004, 0.002, 0.0, 0.006), strict=True))])
    monkeypatch.setattr(angles, "find_angle_errors", lambda *_: next(errors, None))
    found = calibrated(
        replace(wide, camera=replace(wide.camera, cx=wide.camera.cx + 3.0)), density=1.0
    )
    assert next(errors, None) is None
    assert found.harmonics is None
    assert found.camera.cx == pytest.approx(wide.camera.cx, abs=0.3)


def test_a_wrong_ratio_of_the_focal_lengths_is_found(texture: np.ndarray) -> None:
    camera = replace(CAMERA, fy=1.05 * CAMERA.fx)
    recording = simulate(texture, camera, PRISM, duration_s=0.17, seed=6)
    found = calibrated(replace(recording, camera=CAMERA), density=1.0)
    assert found.camera.fy / found.camera.fx == pytest.approx(1.05, abs=0.01)
    assert found.harmonics is None
    assert error_px(recording, found, camera) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shape"),
    [("cylinder", (0.0, math.radians(0.1))), ("wobble", (math.radians(0.5), math.radians(3.0)))],
)
def test_an_uneven_or_wobbling_prism_is_found(
    texture: np.ndarray, name: str, shape: tuple[float, float]
) -> None:
    motion = PrismMotion(720.0, **{name: shape})
    recording = simulate(texture, CAMERA, PRISM, duration_s=0.17, motion=motion, seed=6)
    found = calibrated(recording, density=1.0)
    assert {"cylinder_x", "wobble_x"} & found.parameters.keys()
    assert error_px(recording, found) < 0.04  # the other one explains the events nearly as well


def linear(truth: np.ndarray, noise: float, squares: int = 200) -> LinearFit:
    """Random columns whose residuals are those of the change ``truth``, with noise, in squares of 30 pairs."""
    rng = np.random.default_rng(1)
    columns = rng.normal(size=(squares, 30, len(truth)))
    residual = -columns @ truth + noise * rng.normal(size=(squares, 30))
    hessian = np.einsum("spi,spj->sij", columns, columns)
    gradient = np.einsum("spi,sp->si", columns, residual)
    xy = rng.uniform(0, 100, (squares, 2))
    return LinearFit(("size", "phase", "other"), hessian, gradient, xy, float(np.sum(residual**2)))


def test_a_slow_rotation_of_the_camera_is_noticed(texture: np.ndarray, wide: Recording) -> None:
    """The cost alone does not tell: it is below that from which on a rotation is tried anyway."""
    motion = CameraMotion(np.radians([1.5, 1.5, 0.0]))
    turning = simulate(texture, CAMERA, PRISM, duration_s=0.17, camera_motion=motion, seed=6)
    still, moved = (
        calibrated(recording, free=("apex", "phase")).photometric for recording in (wide, turning)
    )
    assert still is not None
    assert moved is not None
    assert still.rotation_gain < 0.2 * limits.LARGEST_ROTATION_GAIN
    assert moved.rotation_gain > limits.LARGEST_ROTATION_GAIN
    assert moved.cost < limits.LARGEST_STILL_COST


def test_a_camera_that_shakes_with_the_prism_is_refused(texture: np.ndarray) -> None:
    t = np.arange(0.0, 0.18, 1e-3)
    angle = 2.0 * math.pi * 12.0 * t
    away = -0.3 * PRISM.deflection * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rates = np.gradient(away, t, axis=0)
    motion = CameraMotion(np.column_stack([t, -rates[:, 1], rates[:, 0], np.zeros(len(t))]))
    recording = simulate(texture, CAMERA, PRISM, duration_s=0.17, camera_motion=motion, seed=6)
    with pytest.raises(AmiwarpError, match="the camera shakes with the prism, by 0"):
        calibrated(recording)


def test_two_explanations_are_named_with_what_to_free() -> None:
    said = rivals_in_words(RivalCauses(SEAT, FACES, 0.09))
    assert "seat in its mount" in said
    assert "evenness of the prism's faces" in said
    assert "0.09 px" in said
    assert "--free apex,phase,wobble_x,wobble_y or --free apex,phase,cylinder_x,cylinder_y" in said
    assert "flat_side" not in rivals_in_words(RivalCauses(SIDE, SEAT, 0.09))


def test_linear_fit() -> None:
    truth = np.array([0.3, -0.2, 0.5])
    fit = linear(truth, noise=0.1)
    whole = fit.fit(("size", "phase", "other"))
    std = np.sqrt(np.diag(whole.covariance))
    np.testing.assert_allclose(std, 0.1 / math.sqrt(200 * 30), rtol=0.2)
    np.testing.assert_array_less(np.abs(whole.change - truth), 4.0 * std)
    assert whole.significance(2) == pytest.approx(0.5 / std[2], rel=0.05)
    assert whole.gain == pytest.approx(1.0 - 0.01 / (0.01 + np.sum(truth**2)), abs=0.01)
    assert fit.fit(("size",)).gain < whole.gain
    half = fit.fit(("size", "phase", "other"), fit.xy[:, 0] < 50.0)
    assert half.covariance[0, 0] == pytest.approx(2.0 * whole.covariance[0, 0], rel=0.4)


def seen(curvatures: dict[str, float]) -> tuple[ParameterSpace, np.ndarray, LinearFit]:
    """Return a space, an answer, and a fit of independent columns with these curvatures at the answer."""
    space = make_space(
        "exact",
        CAMERA,
        PRISM,
        free=("apex", "phase"),
        start={},
        bounds={},
        rad_per_us=1e-4,
        duration_us=2e5,
    )
    hessian = np.diag([*curvatures.values()])[None]
    fit = LinearFit(
        (*curvatures,), hessian, np.zeros((1, len(hessian[0]))), np.zeros((1, 2)), squares_sum=1.0
    )
    return space, space.to_vector({"apex": PRISM.apex, "phase": 0.4}), fit


def test_a_lens_that_the_events_do_not_tell_is_a_part_of_the_apex() -> None:
    space, v, fit = seen({"apex": 1.0, "phase": 1.0, "focal_length": 1e-6})
    std = space.deviations(v, systematic.lens_errors(space, v, fit, LEAST_GAIN))
    assert 0.01 < std["apex"] / PRISM.apex < 0.03
    assert std["phase"] < 0.002
    space, v, fit = seen({"apex": 1.0, "phase": 1.0, "focal_length": 1e6})
    told = space.deviations(v, systematic.lens_errors(space, v, fit, LEAST_GAIN))
    assert told["apex"] < 0.01 * std["apex"]


def test_errors_of_the_map_are_shared_by_all_pairs() -> None:
    space, v, fit = seen({"apex": 400.0, "phase": 400.0})
    coarse, fine = (
        space.deviations(v, systematic.map_errors(space, v, fit, 40_000, d)) for d in (1.0, 2.0)
    )
    px_per_rad = float(np.linalg.norm(v))
    assert coarse["phase"] * px_per_rad == pytest.approx(
        systematic.MAP_ERROR["phase"] * 10.0, rel=1e-3
    )
    assert coarse["phase"] == pytest.approx(4.0 * fine["phase"])
    assert coarse["apex"] / PRISM.apex == pytest.approx(coarse["phase"] * 0.008 / 0.03, rel=1e-3)


def test_the_phase_from_few_sharp_edges_is_as_good_as_stated() -> None:
    """A map with one node per pixel makes it about one degree too large."""
    picture = polygons(np.random.default_rng(0), 480, 360)
    sensor = SensorModel(contrast_on=0.33, contrast_off=0.33, latency_us=0.0, refractory_us=0.0)
    camera = Camera.from_fov(160, 120, math.radians(60.0))
    recording = simulate(picture, camera, PRISM, duration_s=0.34, seed=0, sensor=sensor)
    found = calibrated(recording)
    assert abs(found.parameters["phase"]) < 2.0 * found.uncertainty["phase"]
    assert found.uncertainty["phase"] < math.radians(1.5)


def outcome(**values: Any) -> Consistency:
    none: dict[str, Any] = {
        "likely": (),
        "drift": (0.0, 0.0),
        "spread": (0.0, 0.0),
        "untold_px": 0.0,
        "rotation_gain": 0.0,
        "hidden_px": {},
    }
    covariance = np.zeros((2, 2))
    return Consistency(
        step=np.zeros(2),
        systematic=covariance,
        method=covariance,
        of_map=covariance,
        **{**none, **values},
    )


def test_what_is_said_and_refused() -> None:
    lens = LikelyCause(FOCAL_LENGTH, moved_px=0.2, gain=0.1, significance=20.0, start=np.zeros(3))
    for found, words, error in (
        (outcome(likely=(lens,)), "focal length seems to be wrong", 0.2),
        (outcome(spread=(0.3, 0.0)), "size of the orbit differs by 0.30 px", 0.3),
        (outcome(spread=(0.0, 0.3)), "slow where it is dark", 0.0),
        (outcome(drift=(0.15, 0.0)), "size of the orbit drifts", 0.15),
        (outcome(drift=(0.0, -0.15)), "scale or the clock of the encoder", 0.0),
        (outcome(untold_px=0.04), "do not tell which side", 0.0),
    ):
        [warning] = warned(found)
        assert words in warning
        assert found.inconsistent_px() == pytest.approx(error)
        reason = refused(found)
        assert (reason == "") == (error == 0.0)
        assert (likeliest(found) in reason) == (error != 0.0)
    # against an encoder's clock a smaller drift of the phase counts, but not of the size
    clock = {CLOCK: 0.04}
    [warning] = warned(outcome(drift=(0.0, -0.01), hidden_px=clock))
    assert "phase of the orbit drifts over the recording by 0.01 px" in warning
    assert (
        warned(outcome(drift=(0.0, -0.01)))
        == warned(outcome(drift=(0.01, 0.0), hidden_px=clock))
        == []
    )
    assert warned(outcome(drift=(0.0, 0.006), hidden_px=clock)) == []
    small = replace(lens, moved_px=0.02, gain=0.003)
    assert warned(outcome()) == warned(outcome(likely=(small,))) == []
    [warning] = warned(outcome(likely=(replace(small, gain=0.006),)))  # it explains much
    assert "focal length seems to be wrong, which amounts to 0.02 px" in warning
