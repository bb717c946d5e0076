"""Pictures and images from sums in phase, on simulated recordings whose scene is known, and the command ``phase``."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import jv
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    EncoderStream,
    Events,
    ExactModel,
    PhaseCamera,
    PhaseImage,
    PhaseReconstruction,
    Prism,
    PrismMotion,
    Recording,
    Scene,
    Simulation,
    VibrationModel,
    phase_image,
    phase_picture,
    phase_sums,
    save_recording,
)
from amiwarp.cli.app import app
from amiwarp.optics.orbit import Orbits, orbits_of
from amiwarp.reconstruction import phase_lag, phase_tiles, picture_in_phase
from amiwarp.reconstruction.phase_figure import edge_colours
from amiwarp.reconstruction.phase_window import harmonics_for, whole_turns
from reference.calibration_sample import exact_calibration

CAMERA = Camera.from_fov(200, 150, math.radians(50.0))
PRISM = Prism(math.radians(1.2))
PHASE = 2.0
MODEL = ExactModel(CAMERA, PRISM, PHASE)
TURN_US = 83_333
START_US = 100_000
INNER = np.s_[8:-8, 8:-8]


@pytest.fixture(scope="module")
def simulation(texture: NDArray[np.uint8]) -> Simulation:
    motion = PrismMotion(720.0, PHASE)
    return Simulation(Scene.from_picture(texture), CAMERA, PRISM, 0.3, motion, seed=4)


@pytest.fixture(scope="module")
def recording(simulation: Simulation) -> Recording:
    """With noise: shot noise, leak, hot pixels, mismatch, latency and a refractory period."""
    return simulation.run()


@pytest.fixture(scope="module")
def truth(simulation: Simulation) -> NDArray[np.float32]:
    return simulation.log_view()


def calibration() -> Calibration:
    return exact_calibration(CAMERA, PRISM, {"apex": PRISM.apex, "phase": PHASE})


@pytest.fixture(scope="module")
def image(recording: Recording) -> PhaseImage:
    work = PhaseReconstruction(recording, calibration())
    return phase_image(work.sums(START_US, TURN_US), work.model)


def correlation(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    return float(np.corrcoef(a[INNER].ravel(), b[INNER].ravel())[0, 1])


def detail(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    return picture - gaussian_filter(picture, 8.0)


def test_one_turn_looks_like_the_truth(image: PhaseImage, truth: NDArray[np.float32]) -> None:
    assert correlation(image.log, truth) >= 0.97
    assert correlation(detail(image.log), detail(truth)) >= 0.97
    assert abs(float(np.median(image.log))) < 1e-4


def test_the_contrast_is_that_of_the_scene(image: PhaseImage, truth: NDArray[np.float32]) -> None:
    """In thresholds of 0.25. Hard edges are weaker: the refractory period swallows a fifth of their events."""
    slope = np.polyfit(truth[INNER].ravel(), 0.25 * image.log[INNER].ravel(), 1)[0]
    assert 0.75 < slope < 1.02


def test_the_gradient_is_that_of_the_picture(image: PhaseImage, truth: NDArray[np.float32]) -> None:
    """Smoothed as the orbit smooths it, so compared over a few pixels."""
    rows, columns = np.gradient(gaussian_filter(truth, 3.0))
    for found, expected in zip(image.gradient, (columns, rows), strict=True):
        assert correlation(gaussian_filter(found, 2.0), expected) > 0.95


def test_prisms_that_turn_backwards_give_the_same_picture(
    texture: NDArray[np.uint8], truth: NDArray[np.float32]
) -> None:
    motion = PrismMotion(-720.0, PHASE)
    recording = Simulation(Scene.from_picture(texture), CAMERA, PRISM, 0.3, motion, seed=4).run()
    found = PhaseReconstruction(recording, calibration()).window(START_US, TURN_US)
    assert correlation(detail(found.log), detail(truth)) >= 0.97


def test_a_wrong_phase_spoils_the_picture(recording: Recording, truth: NDArray[np.float32]) -> None:
    turned = ExactModel(CAMERA, PRISM, PHASE + math.pi / 2)
    sums = PhaseReconstruction(recording, calibration()).sums(START_US, TURN_US)
    assert correlation(detail(phase_picture(sums, turned)), detail(truth)) < 0.8


def test_what_moves_has_a_misfit(recording: Recording, image: PhaseImage) -> None:
    """A part of the image whose events come a quarter turn late cannot be a still scene; random events are noise."""
    work = PhaseReconstruction(recording, calibration())
    stop_us, _ = whole_turns(work.encoder, START_US, TURN_US)
    events = recording.events.between(START_US, stop_us)
    angles = work.encoder.angle_at(events.t)
    part = (events.x > 60) & (events.x < 120) & (events.y > 40) & (events.y < 100)
    first = angles[0]
    late = angles.copy()
    late[part] = first + (late[part] - first + math.pi / 2) % math.tau
    noise = angles.copy()
    noise[part] = first + np.random.default_rng(0).uniform(0.0, math.tau, int(part.sum()))

    inside = np.s_[50:90, 70:110]
    found = {}
    for name, changed in (("late", late), ("noise", noise)):
        sums = phase_sums(
            events, changed, 200, 150, turns=1.0, direction=1, harmonics=work.harmonics
        )
        found[name] = phase_image(sums, MODEL).misfit
    assert np.nanmean(image.misfit[INNER] > 0.5) < 0.02
    assert np.nanmedian(found["late"][inside]) > 0.4
    assert np.nanmedian(found["noise"][inside]) < 0.2
    np.testing.assert_allclose(found["late"][:20, :20], image.misfit[:20, :20], atol=0.05)

    # The same events in two turns are less noise in each, so that more of the misfit is none.
    twice = Events.concatenate([events, events])
    both = np.concatenate([late, late + math.tau])
    ordered = Events(twice.x, twice.y, np.arange(len(twice)), twice.p)
    sums = phase_sums(ordered, both, 200, 150, turns=2.0, harmonics=work.harmonics)
    again = phase_image(sums, MODEL).misfit[inside]
    assert np.all((again >= found["late"][inside] - 1e-3) | np.isnan(found["late"][inside]))


def test_waves_come_back_by_the_formula_of_the_sums() -> None:
    """Sums that a plane wave makes on a constant ellipse give this wave back, with both senses of rotation."""
    side = phase_tiles.SIDE
    k = 2.0 * math.pi * np.array([6, 9]) / side
    for a, b in ((3.0 * np.exp(0.4j), 0.5j), (0.5 + 0.1j, 3.0 * np.exp(-1.0j))):
        y, x = np.mgrid[:side, :side]
        wave = np.exp(1j * (k[0] * x + k[1] * y))
        wave_number = complex(*k)
        c = np.conj(wave_number) * a + wave_number * np.conj(b)
        orders = np.arange(1, 9)
        response = 1j * orders * (1j * c / abs(c)) ** orders * jv(orders, abs(c))
        # A real scene holds the wave and its conjugate, whose response is that of -k.
        opposite = 1j * orders * (-1j * c / abs(c)) ** orders * jv(orders, abs(c))
        values = response[:, None, None] * wave + opposite[:, None, None] * np.conj(wave)
        spectra = np.fft.fft2(values).astype(np.complex64)
        orbits = np.array([[a, b]], np.complex64)
        window = np.ones((side, side), np.float32)
        responses = phase_tiles.plan_of_orbits([(0, 0)], window, orbits, 8).responses(0.0)
        scene = responses.scene(spectra, 0)
        found = np.fft.irfft2(scene, s=(side, side))
        np.testing.assert_allclose(found, 2.0 * wave.real, atol=0.05)
        # Its own scene leaves little of the sums, and another scene leaves more.
        left = np.abs(responses.rest(spectra, scene, 0)).max()
        assert left < 0.02 * np.abs(spectra).max()
        assert np.abs(responses.rest(spectra, 2.0 * scene, 0)).max() > 10.0 * left


def test_the_lag_of_an_ellipse_turns_both_of_its_circles() -> None:
    """Waves in many directions on an ellipse whose events come 6 degrees late."""
    side = phase_tiles.SIDE
    lag = math.radians(6.0)
    orbits = np.array([[3.0 * np.exp(0.4j), 1.5 * np.exp(2.0j)]], np.complex64)
    late = orbits * np.exp([-1j * lag, 1j * lag])
    rng = np.random.default_rng(5)
    scene = np.fft.rfft2(gaussian_filter(rng.normal(size=(side, side)), 1.5))
    at = 2.0 * math.pi * np.fft.fftfreq(side)
    k = at[None, : side // 2 + 1] + 1j * at[:, None]
    c = np.conj(k) * late[0, 0] + k * np.conj(late[0, 1])
    orders = np.arange(1, 9)[:, None, None]
    unit = np.exp(1j * np.angle(c))
    half = 1j * orders * (1j * unit) ** orders * jv(orders, np.abs(c)) * scene
    # The other half is the response to the opposite waves, of which the scene holds the conjugates.
    spectra = np.zeros((8, side, side), np.complex64)
    spectra[:, :, : side // 2 + 1] = half
    mirrored = (-np.arange(side)) % side
    columns = np.arange(1, side // 2)
    opposite = 1j * orders * (-1j * unit) ** orders * jv(orders, np.abs(c)) * np.conj(scene)
    spectra[:, mirrored[:, None], (side - columns)[None, :]] = opposite[:, :, columns]

    window = np.ones((side, side), np.float32)
    plan = phase_tiles.plan_of_orbits([(0, 0)], window, orbits, 8)
    costs = phase_lag._costs(spectra[None], plan, [0])
    assert math.degrees(phase_lag.LAGS[np.argmin(costs)]) == pytest.approx(6.0)
    assert costs.min() < 0.004
    found = plan.responses(lag).scene(spectra, 0)
    inner = np.s_[1 : side // 4, 1 : side // 4]
    assert np.abs(found - scene)[inner].mean() < 0.05 * np.abs(scene)[inner].mean()


def test_the_gradient_solves_for_both_rotations_of_an_ellipse() -> None:
    gradient = 0.3 - 0.2j
    a, b = 3.0 * np.exp(0.4j), 1.2 * np.exp(2.0j)
    first = np.complex64(0.5j * (np.conj(gradient) * a + gradient * np.conj(b)))
    orbits = Orbits(*(np.array([value]) for value in (0.0, a, b, 0.0)))
    found = picture_in_phase.FirstSum.of(orbits).gradient(np.array([first]), 0.0)
    np.testing.assert_allclose(found, [gradient], atol=1e-6)
    late = np.array([first * np.exp(-0.2j)], np.complex64)
    found = picture_in_phase.FirstSum.of(orbits).gradient(late, 0.2)
    np.testing.assert_allclose(found, [gradient], atol=1e-6)


def test_long_waves_come_from_the_gradient_at_their_full_height() -> None:
    """A cosine of 40 px, whose gradient the orbit of 5 px attenuates by 2 J_1 / (k r)."""
    width, radius = 160, 5.0
    k = 2.0 * math.pi * 4 / width
    x = np.arange(width) + 0.5
    wave = np.tile(np.cos(k * x), (80, 1))
    slopes = np.tile(-k * np.sin(k * x), (80, 1)) * (2.0 * jv(1, k * radius) / (k * radius))
    nothing = np.zeros_like(wave, dtype=np.float32)
    found = picture_in_phase.with_long_waves(nothing, slopes.astype(np.complex64), radius)
    share = math.exp(-0.5 * (k * radius / picture_in_phase.LONG_WAVES) ** 2)
    np.testing.assert_allclose(found, share * wave, atol=0.01)
    kept = picture_in_phase.with_long_waves(
        wave.astype(np.float32), np.zeros_like(slopes, dtype=np.complex64), radius
    )
    np.testing.assert_allclose(kept, (1.0 - share) * wave, atol=0.01)


@pytest.mark.parametrize("length", [24, 100, 128, 300, 480, 641])
def test_tiles_cover_an_image(length: int) -> None:
    starts, overlap = phase_tiles.tile_starts(length)
    weights = phase_tiles.weights_of_line(overlap)
    assert len(weights) == phase_tiles.SIDE
    assert overlap >= phase_tiles.LEAST_OVERLAP
    total = np.zeros(length + 4 * phase_tiles.SIDE)
    for start in starts:
        first = start + phase_tiles.SIDE
        total[first : first + phase_tiles.SIDE] += weights**2
    inside = total[phase_tiles.SIDE : phase_tiles.SIDE + length]
    np.testing.assert_allclose(inside, 1.0, atol=1e-6)


def test_each_tile_has_the_orbit_of_its_middle() -> None:
    plan = phase_tiles.plan_of(MODEL, 3)
    row, column = plan.places[2]
    assert column > row
    half = phase_tiles.SIDE / 2
    expected = orbits_of(MODEL, np.array([[min(column + half, CAMERA.width - 1.0), row + half]]))
    a, b = plan.orbits[2]
    assert a == pytest.approx(complex(expected.forward[0]), rel=1e-6)
    assert b == pytest.approx(complex(expected.backward[0]), rel=1e-6)


def test_tiles_take_their_part_of_the_image() -> None:
    rng = np.random.default_rng(3)
    values = (rng.normal(size=(2, 60, 90)) + 1j * rng.normal(size=(2, 60, 90))).astype(np.complex64)
    window = rng.random((phase_tiles.SIDE, phase_tiles.SIDE)).astype(np.float32)
    cut = phase_tiles.cut_out(values, (-20, 30), window)
    np.testing.assert_allclose(
        cut[:, 20:80, :60], values[:, :, 30:] * window[20:80, :60], rtol=1e-6
    )
    assert not cut[:, :20].any()
    assert not cut[:, 80:].any()
    assert not cut[:, :, 60:].any()


def test_orbits_of_a_prism_are_ellipses() -> None:
    points = np.array([[99.5, 74.5], [10.0, 5.0]])
    orbits = orbits_of(MODEL, points)
    angles = np.linspace(0.0, math.tau, 7)
    for k, point in enumerate(points):
        moved = MODEL.compensate_points(np.tile(point, (7, 1)), angles) - point
        expected = (
            orbits.mean[k]
            + orbits.forward[k] * np.exp(1j * angles)
            + orbits.backward[k] * np.exp(-1j * angles)
        )
        rest = np.abs(moved[:, 0] + 1j * moved[:, 1] - expected)
        assert rest.max() < 0.05
        assert orbits.rest[k] < 0.03
    assert abs(orbits.backward[1]) > 10.0 * abs(orbits.backward[0])


def test_larger_orbits_have_more_harmonics() -> None:
    small = ExactModel(CAMERA, Prism(math.radians(0.3)), 0.0)
    large = ExactModel(CAMERA, Prism(math.radians(4.0)), 0.0)
    assert harmonics_for(small) == 6
    assert harmonics_for(MODEL) < harmonics_for(large) <= 31


def test_whole_turns_end_where_the_angle_does() -> None:
    # The speed rises from 720 turns a minute.
    t = np.arange(0, 400_000, 500)
    s = t * 1e-6
    encoder = Encoder(t, math.tau * (12.0 * s + 10.0 * s**2))
    for start_us in (0, 50_000):
        stop_us, turns = whole_turns(encoder, start_us, 170_000)
        swept = np.diff(encoder.angle_at(np.array([start_us, stop_us])))[0]
        assert turns == 2
        assert swept == pytest.approx(2.0 * math.tau, abs=2e-4)


def test_windows_shorter_than_a_turn_are_refused(recording: Recording) -> None:
    work = PhaseReconstruction(recording, calibration())
    with pytest.raises(AmiwarpError, match=r"0\.60 turns.*whole turn.*solver"):
        work.window(START_US, round(0.6 * TURN_US))
    with pytest.raises(AmiwarpError, match="outside the encoder's"):
        work.window(295_000, TURN_US)


def test_an_encoder_that_ends_before_the_turn_is_refused() -> None:
    encoder = Encoder.constant_speed(720.0, 0, 100_000)
    last_us = encoder.coverage[1]
    with pytest.raises(AmiwarpError, match=f"encoder ends at {last_us} us"):
        whole_turns(encoder, last_us - 82_000, 82_000)


def test_what_sums_cannot_do_is_refused(recording: Recording) -> None:
    other = ExactModel(Camera.from_fov(100, 80, 1.0), PRISM, 0.0)
    sums = PhaseReconstruction(recording, calibration()).sums(START_US, TURN_US)
    with pytest.raises(AmiwarpError, match="100x80"):
        phase_picture(sums, other)


def test_what_the_gradient_cannot_tell_is_refused() -> None:
    """Live pictures take the gradient of each pixel, which a motion along a line does not tell."""
    on_a_line = VibrationModel(CAMERA, 0.01, backward=(0.01, 0.0))
    with pytest.raises(AmiwarpError, match=r"along a line.*solver"):
        PhaseCamera(on_a_line, EncoderStream())


def test_a_calibration_with_a_moving_camera_is_refused(recording: Recording) -> None:
    values = {"apex": PRISM.apex, "phase": PHASE, "rate_x": 0.2, "rate_y": 0.0, "rate_z": 0.0}
    turned = exact_calibration(CAMERA, PRISM, values)
    with pytest.raises(AmiwarpError, match=r"camera rotates.*solver"):
        PhaseReconstruction(recording, turned)


def test_a_video_slides_over_the_recording(recording: Recording) -> None:
    work = PhaseReconstruction(recording, calibration())
    pictures = list(work.windows(0, TURN_US, step_us=TURN_US))
    assert len(pictures) == work.count(0, TURN_US, step_us=TURN_US) == 3
    assert correlation(detail(pictures[1].log), detail(pictures[2].log)) > 0.95


def test_colours_of_edges_differ_by_direction() -> None:
    gradient = np.zeros((2, 1, 3), np.float32)
    gradient[:, 0, 0] = 1.0, 0.0
    gradient[:, 0, 1] = -1.0, 0.0
    colours = edge_colours(gradient)
    assert colours[0, 0].tolist() == [1.0, 0.0, 0.0]
    assert colours[0, 1].tolist() == [0.0, 1.0, 1.0]
    assert not colours[0, 2].any()


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(one) for one in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_commands(recording: Recording, truth: NDArray[np.float32], tmp_path: Path) -> None:
    source = tmp_path / "a.h5"
    save_recording(source, recording)
    calibration_file = tmp_path / "calibration.json"
    calibration().save(calibration_file)
    start = ["--start", "0.1"]

    picture = tmp_path / "picture.npy"
    facts = json.loads(
        run(
            "reconstruct",
            source,
            picture,
            "--calibration",
            calibration_file,
            "--method",
            "phase",
            *start,
            "--json",
        )
    )
    assert facts["method"] == "phase"
    assert "pairs" not in facts
    assert correlation(detail(np.load(picture)), detail(truth)) >= 0.97

    out = tmp_path / "phase.npz"
    figure = tmp_path / "phase.png"
    facts = json.loads(
        run(
            "phase",
            source,
            calibration_file,
            out,
            *start,
            "--turns",
            2,
            "--figure",
            figure,
            "--flicker-hz",
            100,
            "--json",
        )
    )
    assert facts["turns"] == 2.0
    assert facts["moved"] < 0.2
    assert facts["off_ratio"] == pytest.approx(1.0, abs=0.35)
    assert figure.stat().st_size > 10_000
    with np.load(out) as arrays:
        assert correlation(detail(arrays["log"]), detail(truth)) >= 0.97
        assert arrays["gradient"].shape == (2, 150, 200)
        assert arrays["flicker"].shape == arrays["misfit"].shape == (150, 200)
        assert int(arrays["events"].sum()) == facts["events"]


@pytest.mark.parametrize(
    ("options", "method", "why"),
    [
        ([], "phase", "whole turns"),
        (["--turns", "0.5"], "solver", "0.50 turns"),
        (["--omega", "0,0.1,0"], "solver", "--omega"),
    ],
)
def test_the_method_is_chosen(
    recording: Recording, tmp_path: Path, options: list[str], method: str, why: str
) -> None:
    source = tmp_path / "a.h5"
    save_recording(source, recording)
    calibration_file = tmp_path / "calibration.json"
    calibration().save(calibration_file)
    given = [
        source,
        tmp_path / "picture.npy",
        "--calibration",
        calibration_file,
        "--method",
        "auto",
    ]
    facts = json.loads(run("reconstruct", *given, "--start", "0.1", *options, "--json"))
    assert facts["method"] == method
    assert why in facts["chosen"]


def test_options_that_do_not_apply_are_refused(recording: Recording, tmp_path: Path) -> None:
    source = tmp_path / "a.h5"
    save_recording(source, recording)
    calibration_file = tmp_path / "calibration.json"
    calibration().save(calibration_file)
    common = ["reconstruct", str(source), str(tmp_path / "p.png"), "--method", "phase"]
    for options in (["--fill", "edge"], ["--omega", "0,0.1,0"], ["--network", "quarter-turn"]):
        given = [*common, "--calibration", str(calibration_file), *options]
        result = CliRunner().invoke(app, given)
        assert result.exit_code == 1
        assert "--method phase" in result.output
