"""Errors of the angles of an optic that repeat every turn, of both angles of a pair and of a mirror alike."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    EncoderStream,
    Mirror,
    MirrorModel,
    PhotometricSettings,
    Prism,
    PrismMotion,
    Recording,
    RisleyModel,
    SensorModel,
    SensorTiming,
    Settings,
    VibrationModel,
    calibrate,
    simulate,
)
from amiwarp.brightness.event_table import EventTable
from amiwarp.calib.photometric import angles, sectors
from amiwarp.calib.photometric.answers import AnswerSearch
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.derivatives import shifted
from amiwarp.calib.photometric.equations import Problem, collect_equations
from amiwarp.calib.photometric.findings import AngleError, SectorError
from amiwarp.calib.photometric.verdicts import refused, warned
from amiwarp.calib.preparation import prepare
from amiwarp.optics import MODELS

CAMERA = Camera.from_fov(160, 120, math.radians(60.0))
PAIR = Prism(math.radians(1.0), second=Prism(math.radians(0.8), 1.6, "camera"))
PHASES = 0.3, -0.7
SPEEDS = 720.0, -500.0
PROMPT = SensorModel(refractory_us=0.0, latency_us=0.0, latency_jitter_us=0.0)
MIRROR = Mirror(
    hz=(60.0, -77.0),
    amplitude=(0.011, 0.008),
    phase=(0.7, -1.2),
    direction=(-0.3, 1.3),
    fold=2.4,
    incidence=0.9,
)


@pytest.fixture(scope="module")
def pair(texture: np.ndarray) -> Recording:
    motion = PrismMotion(SPEEDS[0], PHASES[0], second=PrismMotion(SPEEDS[1], PHASES[1]))
    return simulate(texture, CAMERA, PAIR, motion=motion, duration_s=0.4, sensor=PROMPT, seed=3)


@pytest.fixture(scope="module")
def solved(pair: Recording) -> tuple[Cost, np.ndarray]:
    """Cost of a pair's first map, and the search vector at which it is solved."""
    photometric = PhotometricSettings(pairs=30_000, density=1.0)
    [search] = prepare(pair, Settings(model="risley", events=30_000, photometric=photometric))
    best = {
        **search.space.start,
        "apex": PAIR.apex,
        "phase": PHASES[0],
        "second_phase": PHASES[1],
    }
    equations = collect_equations(Problem(pair, search.at(best)), photometric.sensor)
    equations.cost.residuals(equations.start)
    return equations.cost, equations.start


@pytest.mark.parametrize("angle", [0, 1])
def test_derivatives_by_each_angle_are_those_of_its_change(
    solved: tuple[Cost, np.ndarray], angle: int
) -> None:
    """Against finite differences: the angle of the first, or of the second events of all pairs changes a little."""
    cost, v = solved
    pairs, n, step = cost.brightness.pairs, len(cost.brightness.pairs), 0.02
    azimuth = pairs.arrays.azimuth
    given = azimuth.numpy().copy()
    for end in (0, 1):
        values = []
        for sign in (1.0, -1.0):
            changed = given.reshape(2, 2, -1).copy()
            changed[end, angle] += sign * step
            azimuth.assign(changed.ravel())
            cost.brightness.place(**cost.at(v))
            cost.brightness.solve(cost.scale, steps=0, rounds=0)
            values.append(cost.brightness.residuals.values.numpy()[:n].copy())
        azimuth.assign(given)
        expected = (values[0] - values[1]) / (2.0 * step)
        found = cost.by_angle(v, angle)[end].numpy()[:n]
        known = np.isfinite(expected) & np.isfinite(found)
        assert known.mean() > 0.9
        assert np.std(expected[known]) > 0.5
        assert np.corrcoef(expected[known], found[known])[0, 1] > 0.98
        assert np.std(found[known]) == pytest.approx(np.std(expected[known]), rel=0.05)
    cost.residuals(v)


def test_both_angles_drift_by_the_ratio_of_their_speeds(solved: tuple[Cost, np.ndarray]) -> None:
    cost, v = solved
    n = len(cost.brightness.pairs)
    for end in (0, 1):
        drifting, first, second = (
            each[end].numpy()[:n]
            for each in (cost.by_angle(v), cost.by_angle(v, 0), cost.by_angle(v, 1))
        )
        known = np.isfinite(drifting) & np.isfinite(first) & np.isfinite(second)
        expected = (first + SPEEDS[1] / SPEEDS[0] * second)[known]
        assert np.corrcoef(drifting[known], expected)[0, 1] > 0.99
        assert np.std(drifting[known] - expected) < 0.2 * np.std(drifting[known])
        assert np.std(drifting[known] - first[known]) > 0.3 * np.std(drifting[known])


def test_patterns_belong_to_their_angle(solved: tuple[Cost, np.ndarray]) -> None:
    cost, v = solved
    n = len(cost.brightness.pairs)
    stored = cost.brightness.pairs.arrays.azimuth.numpy()
    patterns = {
        name: each.numpy().reshape(2, -1) for name, each in angles.patterns_of(cost).items()
    }
    assert [*patterns] == [*angles.harmonics_of(0), *angles.harmonics_of(1)]
    theta = stored.reshape(2, 2, -1)[:, :, :n].astype(np.float64)  # events, angles, pairs
    np.testing.assert_allclose(
        patterns["sin 2 of angle 1"][:, :n], np.sin(2.0 * theta[:, 1]), atol=1e-6
    )
    np.testing.assert_allclose(patterns["cos 1 of angle 0"][:, :n], np.cos(theta[:, 0]), atol=1e-6)
    errors = {"cos 1 of angle 0": 0.02, "sin 2 of angle 1": -0.03}
    bent = angles.bent(stored, errors, patterns, 2).reshape(2, 2, -1)[:, :, :n]
    np.testing.assert_allclose(bent[:, 0], theta[:, 0] + 0.02 * np.cos(theta[:, 0]), atol=1e-5)
    np.testing.assert_allclose(
        bent[:, 1], theta[:, 1] - 0.03 * np.sin(2.0 * theta[:, 1]), atol=1e-5
    )
    px = angles.moved_px(cost.space, v, errors)
    sizes = np.linalg.norm(v[:2]) * 0.02, np.linalg.norm(v[2:4]) * 0.03
    assert px == pytest.approx(math.hypot(*sizes) / math.sqrt(2.0))
    shift = wp.array(patterns["cos 1 of angle 0"].ravel(), dtype=float, device="cpu")
    by_first, by_second = (shifted(cost, v, shift, k).numpy()[:n] for k in (0, 1))
    assert np.nanstd(by_first - by_second) > 0.5 * np.nanstd(by_first)


def test_one_angle_is_bent_as_two_are(pair: Recording, device: str) -> None:
    assert pair.encoder is not None
    encoder = replace(pair.encoder, second=None)
    everywhere = np.zeros((120, 160), np.int32)
    pairs = EventTable([pair.events.slice(0, 20_000)], everywhere, device).pairs(
        encoder, longest_gap_us=20_000
    )
    rows = pairs.angle_patterns((80.0, 60.0)).numpy()
    patterns = {"sin 1 of angle 0": rows[1].reshape(2, -1), "skew x": rows[4].reshape(2, -1)}
    errors = {"sin 1 of angle 0": 0.05, "skew x": 1e-3}
    stored, n = pairs.arrays.azimuth.numpy(), len(pairs)
    c, s = angles.bent(stored, errors, patterns, 1).reshape(2, 2, -1)[:, :, :n].swapaxes(0, 1)
    was_c, was_s = stored.reshape(2, 2, -1)[:, :, :n].swapaxes(0, 1)
    turned = np.angle((c + 1j * s) / (was_c + 1j * was_s))
    expected = 0.05 * was_s + 1e-3 * (pairs.column("x") - 80.0)
    np.testing.assert_allclose(turned, expected, atol=1e-5)


def test_which_errors_are_examined() -> None:
    first, second = angles.harmonics_of(0), angles.harmonics_of(1)
    assert (
        angles.examined_errors(RisleyModel)
        == angles.examined_errors(MirrorModel)
        == (first, second)
    )
    assert angles.examined_errors(MODELS["exact"]) == (first, angles.SKEW)
    assert angles.examined_errors(VibrationModel) == (angles.SKEW,)


def test_a_refusal_names_the_angle() -> None:
    harmonics = (0.0, 0.0, 0.0, 0.0, 0.03, 0.0, 0.0, 0.0)
    said = refused(AngleError("risley", harmonics, (0.0, 0.0), 0.0))
    assert said.startswith(
        "the second encoder's angle is wrong by 1.7 deg once a turn, and its correction was not"
    )
    said = refused(AngleError("mirror", harmonics[4:] + harmonics[:4], (0.0, 0.0), 0.0))
    assert said.startswith("the angle of the first command is wrong by 1.7 deg once a period")


def test_three_and_four_times_a_turn_are_said() -> None:
    third = (0.0, 0.0, 0.0, 0.0, 0.03, 0.0, 0.0, 0.03)
    assert refused(AngleError("exact", third, (0.0, 0.0), 0.0)).startswith(
        "the encoder's angle is wrong by 1.7 deg three times a turn and 1.7 deg four times a turn,"
    )
    of_second = (*[0.0] * 10, 0.03, 0.0)
    assert refused(AngleError("risley", of_second, (0.0, 0.0), 0.0)).startswith(
        "the second encoder's angle is wrong by 1.7 deg three times a turn,"
    )


def test_factors_are_those_of_the_angles_in_turn(solved: tuple[Cost, np.ndarray]) -> None:
    space = solved[0].space
    errors = {"sin 1 of angle 0": 0.01, "cos 2 of angle 1": 0.02, "skew x": 1e-3}
    assert angles.harmonics_in(space, errors) == (0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.02, 0.0)
    third = {**errors, "cos 3 of angle 1": 0.03, "sin 4 of angle 0": 0.0}
    expected = (*(0.0, 0.01, 0.0, 0.0, 0.0, 0.0), *(0.0, 0.0, 0.02, 0.0, 0.03, 0.0))
    assert angles.harmonics_in(space, third) == expected
    further = angles.harmonics_in(space, {**third, "sin 4 of angle 0": 0.04})
    assert further[:8] == (0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04)
    total = angles.sum_of_harmonics(expected, (0.1, *[0.0] * 6, 0.2), 2)
    assert total == pytest.approx((0.1, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.02, 0.2, 0.03, 0.0))


@pytest.mark.parametrize(
    ("significance", "gain", "found_px", "is_told"),
    [
        (5.5, 0.02, 0.001, True),
        (4.5, 0.02, 0.02, False),
        (5.5, 0.008, 0.02, False),
        (8.0, 0.002, 0.016, True),
        (8.0, 0.002, 0.014, False),
        (6.5, 0.002, 0.016, False),
    ],
)
def test_a_small_share_of_the_residuals_counts_if_it_is_certain_and_moves_events(
    solved: tuple[Cost, np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
    significance: float,
    gain: float,
    found_px: float,
    is_told: bool,
) -> None:
    """As much noise leaves large residuals. Of the two angles, only the second one is wrong."""
    cost, v = solved
    second = angles.harmonics_of(1)
    unit_px = angles.moved_px(cost.space, v, dict.fromkeys(second, 1.0))

    def adding(_: Any, names: Any, group: Any) -> tuple[Any, float, float]:
        change = np.full(len(names) + 4, found_px / unit_px)
        is_wrong = group == second
        return SimpleNamespace(change=change), significance * is_wrong, gain * is_wrong

    def fit(_: Any, names: Any) -> Any:
        return SimpleNamespace(change=np.arange(float(len(names))))

    fitted = SimpleNamespace(adding=partial(adding, None), fit=partial(fit, None))
    monkeypatch.setattr(angles, "telling", lambda *_: [1])
    monkeypatch.setattr(angles, "linear_fit", lambda *_: fitted)
    found = angles.fit_angles(cost, v)
    assert (found is not None) == is_told
    assert found is None or tuple(found) == second


@pytest.mark.parametrize(("wrong", "harmonic"), [(0, 3), (1, 4)])
def test_a_high_harmonic_is_found_with_its_sign_and_whole_size(
    solved: tuple[Cost, np.ndarray], wrong: int, harmonic: int
) -> None:
    """The correction has the sign opposite to the error; right angles have none."""
    cost, v = solved
    search = AnswerSearch(cost, cost.space.to_values(v), 0.9, PhotometricSettings(), lambda _: None)
    cost.converge(v)
    assert angles.find_high_harmonics(search, v) == ()
    azimuth = cost.brightness.pairs.arrays.azimuth
    given = azimuth.numpy().copy()
    changed = given.reshape(2, 2, -1).copy()
    changed[:, wrong] += 0.05 * np.cos(harmonic * changed[:, wrong])
    azimuth.assign(changed.ravel())
    cost.renew(v)
    cost.converge(v)
    read = azimuth.numpy().copy()
    found = angles.find_high_harmonics(search, v)
    np.testing.assert_array_equal(azimuth.numpy(), read)
    azimuth.assign(given)
    cost.renew(v)
    cost.residuals(v)
    assert len(found) == 4 * harmonic
    of_wrong, of_right = np.reshape(found, (2, -1))[[wrong, 1 - wrong]]
    assert of_wrong[2 * harmonic - 2] == pytest.approx(-0.05, rel=0.2)
    assert np.abs(of_right).max() == 0.0
    assert np.abs(np.delete(of_wrong, 2 * harmonic - 2)).max() < 0.012


BOTH = (0.02, 0.0, 0.0, -0.01, 0.0, 0.03, 0.01, 0.0)


def test_an_encoder_takes_harmonics_of_both_angles() -> None:
    t = np.arange(0, 100_000, 500)
    first, second = Encoder.from_angles(t, 7.5e-5 * t), Encoder.from_angles(t, -5.2e-5 * t)
    both = first.with_second(second).with_harmonics(BOTH)
    at = np.arange(100, 99_000, 333)
    expected = [
        first.with_harmonics(BOTH[:4]).angle_at(at),
        second.with_harmonics(BOTH[4:]).angle_at(at),
    ]
    np.testing.assert_array_equal(both.angles_at(at), np.stack(expected, axis=1))
    one = first.with_second(second).with_harmonics(BOTH[:4])
    np.testing.assert_array_equal(
        one.angles_at(at), np.stack([expected[0], second.angle_at(at)], axis=1)
    )
    with pytest.raises(AmiwarpError, match="harmonics"):
        first.with_harmonics((*BOTH, *BOTH))
    seconds = EncoderStream()
    stream = EncoderStream(second=seconds, harmonics=BOTH)
    stream.append(t, 7.5e-5 * t)
    seconds.append(t, -5.2e-5 * t)
    np.testing.assert_allclose(
        stream.over(100, 99_000).angles_at(at), both.angles_at(at), atol=1e-9
    )
    with pytest.raises(AmiwarpError, match="harmonics"):
        EncoderStream(harmonics=(*BOTH, *BOTH))


def error_px(found: Calibration, recording: Recording, true: Any, angle: Any) -> float:
    """Return the error of the compensation over image and time, constant lag and place removed [px rms].

    ``true`` is the true model, and ``angle`` returns its angles at times [us], shape (n, 2).
    """
    rng, events = np.random.default_rng(0), recording.events
    xy = rng.uniform((0, 0), (found.camera.width - 1, found.camera.height - 1), (5000, 2))
    t = rng.integers(events.t_first + 1000, events.t_last - 1000, 5000)
    theta = found.encoder_for(recording.encoder, events.t_first, events.t_last).angles_at(t)
    away = found.model.compensate_points(xy, theta) - true.compensate_points(xy, angle(t))
    later, earlier = (true.compensate_points(xy, angle(t + by)) for by in (20, -20))
    place = np.tile(np.eye(2), (len(xy), 1))
    design = np.column_stack([(later - earlier).ravel(), place])
    known = np.isfinite(away).all(axis=1).repeat(2)
    left = (
        away.ravel()[known]
        - design[known] @ np.linalg.lstsq(design[known], away.ravel()[known], rcond=None)[0]
    )
    return float(np.sqrt(2.0 * np.mean(left**2)))


def off_centre(encoder: Encoder, degrees: float) -> Encoder:
    """Return an encoder without a second one that reads its angle wrongly, in the same way each turn."""
    read = encoder.angle + math.radians(degrees) * np.cos(encoder.angle - 0.6)
    return Encoder(encoder.t, read)


FINE = PhotometricSettings(pairs=100_000, density=1.0)


@pytest.mark.slow
def test_both_encoders_of_a_pair_are_corrected(pair: Recording) -> None:
    assert pair.encoder is not None
    assert pair.encoder.second is not None
    wrong = off_centre(pair.encoder, 3.0).with_second(off_centre(pair.encoder.second, -4.0))
    found = calibrate(replace(pair, encoder=wrong), photometric=FINE, events=60_000)
    assert found.harmonics is not None
    assert len(found.harmonics) == 8
    true = RisleyModel(CAMERA, PAIR, *PHASES)

    def angle(t: np.ndarray) -> np.ndarray:
        return np.outer(t, np.array(SPEEDS) * math.tau / 60e6)

    assert error_px(found, replace(pair, encoder=wrong), true, angle) < 0.02
    [said] = [w for w in found.warnings if "was corrected" in w]
    assert "the first encoder's angle is wrong by" in said
    assert "the second encoder's angle is wrong by" in said


@pytest.mark.slow
def test_right_encoders_of_a_pair_are_left_alone(pair: Recording) -> None:
    found = calibrate(pair, photometric=FINE, events=60_000)
    assert found.harmonics is None
    assert found.warnings == ()


@pytest.mark.slow
def test_a_mirror_that_does_not_follow_its_commands_in_proportion(texture: np.ndarray) -> None:
    """The command is the tilt less a tenth of its cube."""
    camera = Camera.from_fov(128, 96, math.radians(35.0))
    recording = simulate(texture, camera, MIRROR, duration_s=0.2, sensor=PROMPT, seed=3)
    t = np.arange(0, 203_000, 200)
    commands = []
    for hz, phase in zip(MIRROR.hz, MIRROR.phase, strict=True):
        tilt = np.cos(math.tau * hz * 1e-6 * t + phase)
        commands.append(Encoder.from_command(t, tilt - 0.1 * tilt**3))
    commanded = replace(recording, encoder=commands[0].with_second(commands[1]))
    photometric = PhotometricSettings(pairs=25_000, sensor=SensorTiming(refractory_us=0.0))
    found = calibrate(commanded, model="mirror", photometric=photometric, events=30_000)
    assert found.harmonics is not None
    # Sin 2, by a cube
    assert np.abs(np.reshape(found.harmonics, (2, 4))).argmax(axis=1).tolist() == [
        3,
        3,
    ]
    true = MirrorModel.from_values(camera, Prism(0.0), MIRROR.parameters())

    def angle(t: np.ndarray) -> np.ndarray:
        return np.outer(t, np.array(MIRROR.hz) * math.tau * 1e-6)

    assert error_px(found, commanded, true, angle) < 0.03


@pytest.mark.parametrize("wrong", [0, 1])
def test_what_the_sectors_of_an_angle_leave(solved: tuple[Cost, np.ndarray], wrong: int) -> None:
    """A third harmonic of one angle, which no correction follows, is found at that angle, with its sign."""
    cost, v = solved
    azimuth = cost.brightness.pairs.arrays.azimuth
    given = azimuth.numpy().copy()
    changed = given.reshape(2, 2, -1).copy()
    changed[:, wrong] += 0.1 * np.cos(3.0 * changed[:, wrong])
    azimuth.assign(changed.ravel())
    cost.residuals(v, rounds=2)
    found, ratios = sectors.sector_offsets(cost, v)
    azimuth.assign(given)
    cost.residuals(v)
    offsets = found[wrong]
    assert ratios[wrong] > sectors.LEAST_RATIO
    assert offsets.mean() == pytest.approx(0.0, abs=1e-9)
    expected = -0.1 * np.cos(3.0 * (np.arange(sectors.SECTORS) + 0.5) * math.tau / sectors.SECTORS)
    assert np.corrcoef(offsets, expected)[0, 1] > 0.8
    assert np.std(offsets) / np.std(expected) == pytest.approx(sectors.FOUND_SHARE, rel=0.7)
    assert np.std(found[wrong]) > 1.5 * np.std(found[1 - wrong])


def test_an_error_that_is_left_names_its_angle() -> None:
    [said] = warned(SectorError("risley", 1, math.radians(75.0), 0.031))
    assert (
        "0.03 px rms is left that repeats with the second encoder's angle, most at 75 deg" in said
    )
    assert warned(SectorError("risley", 1, 0.0, 0.01)) == []
