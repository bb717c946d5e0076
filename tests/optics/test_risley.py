"""Pairs of prisms (Risley pairs): device functions, files, compensation, simulation and calibration."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from typer.testing import CliRunner

import amiwarp
from amiwarp import (
    AmiwarpError,
    Camera,
    Encoder,
    Fisheye,
    Prism,
    PrismMotion,
    RadialTangential,
    RisleyModel,
    SensorTiming,
)
from amiwarp.brightness.event_table import EventTable
from amiwarp.imaging import CanvasShape, Votes, upload_events
from amiwarp.kernels.encoder_pieces import encoder_params
from amiwarp.kernels.prism_pair import PairParams
from amiwarp.kernels.refraction import advanced, state_of
from reference import optics as reference
from tests.command_line import app
from tests.conftest import COARSE
from tests.simulation.test_world_truth import square

CAMERA = Camera.from_fov(320, 240, math.radians(60.0))
FIRST, SECOND = Prism(math.radians(1.0)), Prism(math.radians(0.8), 1.6, "camera")
PAIR = replace(FIRST, second=SECOND)
PHASES = 0.3, -0.7


def samples(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return random pixels [px] and angles of both prisms [rad]."""
    rng = np.random.default_rng(1)
    return rng.uniform((0, 0), (319, 239), (n, 2)), rng.uniform(-9.0, 9.0, (n, 2))


def encoder_of_pair() -> Encoder:
    """Return encoders with other sample times for each prism; the second one starts later."""
    first, second = np.arange(0, 401_000, 1000), np.arange(300, 402_000, 1300)
    angles = first * 75e-6 + 0.02 * np.sin(first * 1e-4), second * -52e-6
    return Encoder.from_angles(first, angles[0]).with_second(Encoder.from_angles(second, angles[1]))


LENSES = (None, RadialTangential(-0.2, 0.05, 1e-4, -1e-4, 0.0), Fisheye(0.05, 0.01, 0.0, 0.0))


@pytest.mark.parametrize("lens", LENSES, ids=["pinhole", "radial-tangential", "fisheye"])
def test_events_and_points_agree_with_a_float64_trace(
    lens: RadialTangential | Fisheye | None, device: str
) -> None:
    camera = replace(CAMERA, distortion=lens)
    model = RisleyModel(camera, PAIR, *PHASES, ratio=-0.7)
    xy, theta = samples(2000)
    np.testing.assert_allclose(
        model.compensate_points(xy, theta),
        reference.through_pair(camera, PAIR, PHASES, xy, theta, to_scene=True),
        atol=1e-3,
    )
    np.testing.assert_allclose(
        model.deflect_points(xy, theta),
        reference.through_pair(camera, PAIR, PHASES, xy, theta, to_scene=False),
        atol=1e-3,
    )
    rng, n, encoder = np.random.default_rng(3), 20_003, encoder_of_pair()
    t = np.sort(rng.integers(0, 400_000, n))
    events = amiwarp.Events.from_arrays(
        rng.integers(0, 320, n), rng.integers(0, 240, n), t, rng.integers(0, 2, n)
    )
    moved = amiwarp.compensate_events(events, model, encoder, device=device)
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    traced = reference.through_pair(camera, PAIR, PHASES, xy, encoder.angles_at(t), to_scene=True)
    np.testing.assert_allclose(moved, traced, rtol=0, atol=1.5e-3)
    image = amiwarp.iwe(events, 320, 240, model=model, encoder=encoder, device=device)
    voted = amiwarp.iwe(replace(events, x=moved[:, 0], y=moved[:, 1]), 320, 240, device=device)
    assert np.abs(image - voted).sum() < 0.02 * len(events)  # angles are rounded to 1/65536 turn


def test_the_clock_offset_moves_both_prisms(device: str) -> None:
    model, encoder = RisleyModel(CAMERA, PAIR, *PHASES, ratio=-52 / 75), encoder_of_pair()
    rng, n = np.random.default_rng(3), 20_000
    t = np.sort(rng.integers(20_000, 380_000, n))
    events = amiwarp.Events.from_arrays(
        rng.integers(0, 320, n), rng.integers(0, 240, n), t, rng.integers(0, 2, n)
    )

    def voted(encoder: Encoder, drift: float) -> NDArray[np.float64]:
        uploaded = upload_events(events, encoder, device, slope=encoder.speed_at(t) * 1e-6)
        votes = Votes(CanvasShape(320, 240), device)
        votes.add_events(model, uploaded, drift=drift)
        return np.asarray(votes.take(), np.float64)

    late, none = voted(encoder.with_clock_offset(2000.0), 0.0), voted(encoder, 0.0)
    apart = np.abs(voted(encoder, 2000.0) - late).sum()
    assert apart < 0.1 * np.abs(none - late).sum()


@wp.kernel
def turn(
    model: PairParams, angles: wp.array(dtype=wp.vec2), by: float, states: wp.array(dtype=wp.vec2)
):
    """Turn the first prism by an angle [rad], and the second one with it."""
    i = wp.tid()
    w0, w1 = state_of(model, angles[i][0], angles[i][1])
    states[i] = advanced(model, w0, w1, by)


def test_the_second_prism_turns_with_the_first_by_their_ratio(device: str) -> None:
    model, angles = RisleyModel(CAMERA, PAIR, *PHASES, ratio=-0.7), samples(50)[1]
    states = wp.empty(50, dtype=wp.vec2, device=device)
    given = wp.array(angles.astype(np.float32), dtype=wp.vec2, device=device)
    wp.launch(turn, 50, [model.params(device), given, 0.3], [states], device=device)
    np.testing.assert_allclose(states.numpy(), angles + PHASES + np.array([0.3, -0.21]), atol=1e-5)


def test_each_single_prism_moves_points_as_the_pair_whose_other_prism_is_flat() -> None:
    xy, theta = samples(200)
    singles = RisleyModel(CAMERA, PAIR, *PHASES).singles()
    flat = replace(PAIR, apex=0.0), replace(PAIR, second=replace(SECOND, apex=0.0))
    for k, other in enumerate(reversed(flat)):
        expected = RisleyModel(CAMERA, other, *PHASES).compensate_points(xy, theta)
        np.testing.assert_allclose(
            singles[k].compensate_points(xy, theta[:, k]), expected, rtol=0, atol=1e-3
        )


def test_a_pair_of_parameter_values_keeps_the_glass_of_each_prism() -> None:
    values = {
        "apex": 0.02,
        "phase": PHASES[0],
        "second_apex": 0.01,
        "second_phase": PHASES[1],
        "ratio": -0.5,
    }
    expected = replace(FIRST, apex=0.02, second=replace(SECOND, apex=0.01))
    assert RisleyModel.from_values(CAMERA, PAIR, values) == RisleyModel(
        CAMERA, expected, *PHASES, ratio=-0.5
    )


def test_a_search_starts_with_the_apex_of_each_prism() -> None:
    start = RisleyModel.start_values(PAIR)
    assert (start["apex"], start["second_apex"]) == (FIRST.apex, SECOND.apex)
    assert RisleyModel.start_values(FIRST)["second_apex"] == FIRST.apex  # nothing else is known


def test_pairs_of_events_have_both_angles_of_the_time_before_the_latency(device: str) -> None:
    encoder, rng = encoder_of_pair(), np.random.default_rng(4)
    t = np.sort(rng.integers(5_000, 390_000, 4000))
    events = amiwarp.Events.from_arrays(
        rng.integers(0, 16, 4000), rng.integers(0, 12, 4000), t, rng.integers(0, 2, 4000)
    )
    table = EventTable([events], np.zeros((12, 16), np.int32), device)
    pairs = table.pairs(
        encoder, longest_gap_us=50_000, sensor=SensorTiming(latency_us=400.0, refractory_us=150.0)
    )
    assert len(pairs) > 1000
    # Both angles of the first and second event
    angles = pairs.arrays.azimuth.numpy().reshape(4, -1)[:, : len(pairs)]
    times = np.rint(pairs.time.astype(np.float64) * 1e6).astype(np.int64)
    assert np.isin(times, t).all()
    for k, late in ((0, 150 - 400), (1, -400)):
        away = angles[2 * k : 2 * k + 2].T - encoder.angles_at(times[k] + late)
        # Rad; extrapolated within a sample
        np.testing.assert_allclose(np.exp(1j * away), 1.0, rtol=0, atol=2e-4)


def test_encoders_must_suit_the_model() -> None:
    events = amiwarp.Events.from_arrays([10, 20], [12, 14], [0, 1000], [0, 1])
    one, pair = Encoder.constant_speed(720.0, 0, 400_000), RisleyModel(CAMERA, PAIR)
    with pytest.raises(
        AmiwarpError,
        match="the model has two prisms, the encoder measures one; add the other one's",
    ):
        amiwarp.compensate_events(events, pair, one)
    with pytest.raises(
        AmiwarpError, match="the encoder belongs to a pair of prisms, the model has one prism"
    ):
        amiwarp.compensate_events(events, amiwarp.ExactModel(CAMERA, FIRST), one.with_second(-0.5))
    with pytest.raises(AmiwarpError, match="a pair has two prisms"):
        Prism(0.02, second=PAIR)
    with pytest.raises(AmiwarpError, match="a pair has two prisms"):
        one.with_second(one.with_second(1.0))
    with pytest.raises(AmiwarpError, match="the prism has no second one"):
        RisleyModel(CAMERA, FIRST)
    with pytest.raises(AmiwarpError, match="the prism has a second prism, the motion has none"):
        amiwarp.simulate(np.zeros((4, 4), np.uint8), CAMERA, PAIR, duration_s=0.1)


@pytest.fixture(scope="module")
def recording(texture: NDArray[np.uint8]) -> amiwarp.Recording:
    """Simulated recording of a pair whose prisms turn against each other; the nominal apexes are 10 % off."""
    motion = PrismMotion(720.0, PHASES[0], second=PrismMotion(-500.0, PHASES[1]))
    nominal = Prism(1.1 * FIRST.apex, second=replace(SECOND, apex=0.9 * SECOND.apex))
    return amiwarp.simulate(
        texture, CAMERA, PAIR, motion=motion, duration_s=0.5, nominal_prism=nominal, seed=3
    )


def test_truth_is_the_compensated_place(recording: amiwarp.Recording) -> None:
    assert recording.encoder is not None
    assert recording.truth is not None
    events = recording.events.slice(0, 20_000)
    model = RisleyModel(CAMERA, PAIR, *PHASES, ratio=-500 / 720)
    # the sensor stamps events 100 us late: compensated at the time of the crossing they lie on their scene points
    early = replace(events, t=np.maximum(events.t - 100, 0))
    places = amiwarp.compensate_events(early, model, recording.encoder)
    away = np.linalg.norm(places - recording.truth.points(0, 20_000), axis=1)
    assert np.median(away) < 0.02
    parameters = recording.truth.parameters
    assert parameters["second_apex"] == SECOND.apex
    assert parameters["second_phase"] == PHASES[1]
    assert parameters["ratio"] == pytest.approx(-500 / 720)


def test_files_hold_both_prisms(tmp_path: Path) -> None:
    events = amiwarp.MemoryEvents(
        amiwarp.Events.from_arrays([1, 2], [3, 4], [100, 9000], [0, 1]), 320, 240
    )
    recording = amiwarp.Recording(events, prism=PAIR, encoder=encoder_of_pair())
    amiwarp.save_recording(tmp_path / "pair.h5", recording)
    opened = amiwarp.open_recording(tmp_path / "pair.h5")
    assert opened.prism == PAIR
    assert opened.encoder is not None
    np.testing.assert_array_equal(
        opened.encoder.angles_at([500, 700]), encoder_of_pair().angles_at([500, 700])
    )


def test_it_is_calibrated_stored_and_compensated(
    recording: amiwarp.Recording, tmp_path: Path
) -> None:
    path = tmp_path / "pair.h5"
    amiwarp.save_recording(path, recording)
    opened = amiwarp.open_recording(path)
    assert opened.prism == recording.prism
    assert opened.encoder is not None
    assert recording.encoder is not None
    t = np.arange(0, 500_000, 777)
    np.testing.assert_array_equal(opened.encoder.angles_at(t), recording.encoder.angles_at(t))
    found = amiwarp.calibrate(opened, events=100_000, photometric=COARSE)
    assert found.model_name == "risley"
    xy, theta = samples(2000)
    truth = RisleyModel(CAMERA, PAIR, *PHASES)
    away = found.model.compensate_points(xy, theta) - truth.compensate_points(xy, theta)
    assert math.sqrt(np.mean(np.sum(away**2, axis=1))) < 0.02
    found.save(tmp_path / "c.json")
    loaded = amiwarp.Calibration.load(tmp_path / "c.json")
    assert loaded.model == found.model
    assert set(loaded.uncertainty) == {"apex", "phase", "second_apex", "second_phase"}
    amiwarp.compensate(opened, loaded, tmp_path / "out.h5")
    out, events = (
        amiwarp.open_recording(each).events.slice(0, 1000) for each in (tmp_path / "out.h5", path)
    )
    places = amiwarp.compensate_events(events, loaded.model, recording.encoder)
    np.testing.assert_allclose(np.stack([out.x, out.y], axis=1), places, atol=1e-4)


def test_a_prism_at_rest_is_named(recording: amiwarp.Recording) -> None:
    assert recording.encoder is not None
    with pytest.raises(
        AmiwarpError, match=r"the second prism turned 0\.0 degrees during the events"
    ):
        amiwarp.calibrate(replace(recording, encoder=recording.encoder.with_second(1e-6)))


def test_a_pair_with_one_angle_is_refused(recording: amiwarp.Recording) -> None:
    one = None if recording.encoder is None else replace(recording.encoder, second=None)
    with pytest.raises(
        AmiwarpError, match=r"has two prisms, but the angle of one; give .* --second-ratio"
    ):
        amiwarp.calibrate(replace(recording, encoder=one))


def test_command_line(texture: NDArray[np.uint8], tmp_path: Path) -> None:
    from PIL import Image

    Image.fromarray(texture).save(tmp_path / "picture.png")
    run = CliRunner().invoke
    made = run(app, ["simulate", str(tmp_path / "r.h5"), "--picture", str(tmp_path / "picture.png"), "--size", "64x48",
                     "--duration", "0.2", "--second-apex-deg", "0.7", "--second-rpm", "-400",
                     "--second-phase-deg", "20"])  # fmt: skip
    assert made.exit_code == 0, made.stderr
    recording = amiwarp.open_recording(tmp_path / "r.h5")
    assert isinstance(recording.prism, Prism)
    assert recording.prism.second == Prism(math.radians(0.7))
    assert recording.encoder is not None
    assert recording.encoder.ratio == pytest.approx(-400 / 720, rel=1e-3)
    refused = run(
        app,
        [
            "simulate",
            str(tmp_path / "s.h5"),
            "--picture",
            str(tmp_path / "picture.png"),
            "--second-rpm",
            "9",
        ],
    )
    assert "give --second-apex-deg" in refused.stderr
    (tmp_path / "e.csv").write_text(
        "t_us,angle_deg\n" + "".join(f"{t},{t * 0.004}\n" for t in range(-9000, 220_000, 500))
    )
    joined = run(app, ["convert", str(tmp_path / "r.h5"), str(tmp_path / "j.h5"), "--encoder", str(tmp_path / "e.csv"),
                       "--second-ratio", "-0.5"])  # fmt: skip
    assert joined.exit_code == 0, joined.stderr
    encoder = amiwarp.open_recording(tmp_path / "j.h5").encoder
    assert encoder is not None
    assert encoder.ratio == -0.5


def test_worlds_are_seen_through_both_prisms() -> None:
    """What a pixel sees through both prisms is what the compensated place sees without them."""
    smooth = gaussian_filter(np.random.default_rng(0).random((128, 128)), 4.0, mode="wrap")
    wall = amiwarp.Body("wall", square(4.0, 3.0), amiwarp.Material(1.0, smooth))
    world = amiwarp.World("wall", (wall,)), amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    motion = PrismMotion(720.0, PHASES[0], second=PrismMotion(-500.0, PHASES[1]))
    camera, t = Camera.from_fov(64, 48, 1.0), 1234
    simulation = amiwarp.Simulation(amiwarp.WorldScene(*world), camera, PAIR, 0.04, motion, seed=3)
    frame = amiwarp.TruthRenderer(simulation).at(t)
    y, x = (values.ravel().astype(np.float64) for values in np.mgrid[:48, :64])
    model, theta = RisleyModel(camera, PAIR, *PHASES), np.repeat(motion.angles([t]), len(x), axis=0)
    first = replace(model, prism=replace(PAIR, second=replace(SECOND, apex=0.0)))
    inside = (x > 4) & (x < 60) & (y > 4) & (y < 44)
    seen, bare = frame.intensity_with_prism.astype(np.float64), frame.intensity.astype(np.float64)
    errors = []
    for each in (model, first):
        places = each.compensate_points(np.stack([x, y], axis=1), theta)
        errors.append(
            np.std((map_coordinates(bare, places.T[::-1], order=3) - seen.ravel())[inside])
        )
    assert errors[0] < 0.03 * bare.std()
    assert errors[0] < 0.2 * errors[1]
    recording = simulation.run()
    assert recording.truth is not None
    assert recording.encoder is not None
    events = recording.events.slice(0, len(recording.events))
    early = replace(events, t=np.maximum(events.t - 100, 0))
    moved = amiwarp.compensate_events(early, simulation.true_model, recording.encoder)
    assert np.median(np.linalg.norm(moved - recording.truth.points(0, len(events)), axis=1)) < 0.02


@pytest.mark.parametrize("ratio", [1e6 + 0.5, -1e6 - 0.5, math.nan])
def test_impossible_ratios_are_refused(ratio: float) -> None:
    assert RisleyModel(CAMERA, PAIR, ratio=1e6).ratio == 1e6
    with pytest.raises(AmiwarpError, match="ratio"):
        RisleyModel(CAMERA, PAIR, ratio=ratio)


def test_an_encoder_that_begins_later_reaches_back_to_the_first_event() -> None:
    params = encoder_params(encoder_of_pair(), 100, 9000, "cpu")  # the second encoder begins at 300
    assert (params.start.numpy()[0], params.second_start.numpy()[0]) == (0, 0)
