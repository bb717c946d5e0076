"""Contrast maximisation without an initial guess, on simulated recordings, and its refusals."""

import functools
import math
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

import amiwarp
from amiwarp import (
    AmiwarpError,
    Calibration,
    CalibrationOptions,
    Camera,
    Encoder,
    EncoderModel,
    Events,
    FlatSide,
    MemoryEvents,
    Prism,
    PrismMotion,
    Recording,
    SensorModel,
    Settings,
    Sharpness,
    compensate_events,
    model_error,
    open_recording,
    predicted_error,
    simulate,
    truth_model,
)
from amiwarp.calib import calibrate_as_paper
from amiwarp.calib.first_guess import estimate_rpm
from amiwarp.calib.held_out_turns import PARTS
from amiwarp.calib.preparation import prepare
from amiwarp.calib.start_burst import LaterEvents, burst_size, without_start_burst
from amiwarp.calib.thinning import RUN, thin
from amiwarp.optics import MODELS, rungs, wrap_angle
from amiwarp.results import make_space
from tests.conftest import NOMINAL_PRISM, TRUE_PRISM

calibrate = functools.partial(amiwarp.calibrate, stages=("sharpness",))


def error_px(recording: Recording, model: object) -> float:
    assert recording.camera is not None
    assert recording.truth is not None
    return model_error(model, truth_model(recording.camera, recording.truth, FlatSide.SCENE)).rms


def keep(recording: Recording, which: object) -> Recording:
    events = recording.events.slice(0, len(recording.events))[which]
    return replace(
        recording, events=MemoryEvents(events, *recording.events.size), truth=recording.truth
    )


def test_found_without_a_guess(recording: Recording, device: str) -> None:
    c = calibrate(recording, device=device)
    # Px; contrast maximisation is biased by the sensor's hysteresis
    assert error_px(recording, c.model) < 0.15
    assert c.sharpness_after > 1.5 * c.sharpness_before
    assert abs(math.degrees(c.parameters["apex"] - TRUE_PRISM.apex)) < 0.08
    assert [s.name for s in c.stages][:2] == ["global", "local"]
    assert c.warnings == ()


@pytest.mark.parametrize("phase", [-3.0, -1.2, 0.3, 1.7, 3.1])
def test_every_phase_is_found(texture: np.ndarray, phase: float) -> None:
    camera = Camera.from_fov(160, 120, math.radians(50))
    recording = simulate(
        texture, camera, Prism(math.radians(1.7)), duration_s=0.1, motion=PrismMotion(-720.0, phase=phase),
        nominal_prism=Prism(math.radians(2.0)),
    )  # fmt: skip
    c = calibrate(recording, events=100_000)
    assert error_px(recording, c.model) < 0.2
    # Events lag their edge
    assert abs(math.remainder(c.parameters["phase"] - phase, math.tau)) < math.radians(8)


@pytest.mark.parametrize("name", list(rungs()))
def test_every_model_reaches_its_own_best_fit(recording: Recording, name: str) -> None:
    c = calibrate(recording, model=name, events=200_000)
    assert recording.camera is not None
    assert recording.truth is not None
    truth = truth_model(recording.camera, recording.truth, FlatSide.SCENE)
    best = predicted_error(
        MODELS[name].from_prism(recording.camera, TRUE_PRISM), truth, remove_lag=True
    ).rms
    assert error_px(recording, c.model) < best + 0.12


@pytest.mark.parametrize(
    "kind", [Sharpness.VARIANCE, Sharpness.GRADIENT, Sharpness.LAPLACIAN, Sharpness.ENTROPY]
)
def test_costs_that_work_on_dense_texture(recording: Recording, kind: Sharpness) -> None:
    assert error_px(recording, calibrate(recording, sharpness=kind, events=200_000).model) < 0.25


def test_the_paper_s_cost_works_on_few_events_of_sparse_edges() -> None:
    rows, columns = np.mgrid[:240, :320]
    discs = np.full((240, 320), 60, dtype=np.uint8)
    for x, y, radius in ((80, 70, 30), (230, 90, 40), (150, 180, 35)):
        discs[(columns - x) ** 2 + (rows - y) ** 2 < radius**2] = 200
    camera = Camera.from_fov(160, 120, math.radians(50))
    recording = simulate(
        discs, camera, TRUE_PRISM, duration_s=0.17, motion=PrismMotion(720.0, phase=1.0)
    )
    hardware = {"apex": (0.03, 0.05), "phase": (0.5, 1.5)}
    c = calibrate(recording, sharpness=Sharpness.PAPER_J, events=3000, bounds=hardware)
    assert c.sharpness_name == "paper_j"
    assert error_px(recording, c.model) < 0.4


def test_the_paper_s_cost_is_refused_where_it_fails(recording: Recording) -> None:
    """On dense texture its minimum is far from the truth. The answer of a global search for it is refused."""
    with pytest.raises(AmiwarpError, match="no motion of a prism"):
        calibrate(
            recording,
            sharpness=Sharpness.PAPER_J,
            global_algorithm="GN_DIRECT_L",
            events=200_000,
        )


def test_no_point_of_a_dense_grid_is_better(recording: Recording) -> None:
    search = prepare(recording, Settings(events=60_000))[0]
    space = search.space
    search = search.run()
    low, high = space.bounds()
    grid = np.stack(
        np.meshgrid(*(np.arange(a, b, 0.75) for a, b in zip(low, high, strict=True))), axis=-1
    )
    dense = max(search.fine(v) for v in grid.reshape(-1, 2))
    assert dense <= search.score


def test_the_same_input_gives_the_same_bits(recording: Recording, device: str) -> None:
    a, b = (calibrate(recording, events=50_000, device=device) for _ in range(2))
    assert dict(a.parameters) == dict(b.parameters)
    assert dict(a.uncertainty) == dict(b.uncertainty)
    assert a.sharpness_after == b.sharpness_after


def test_uncertainty_matches_the_scatter_of_repeats(texture: np.ndarray) -> None:
    """Eight noise seeds: the scatter of the answers agrees with the covariance within a factor of three."""
    camera = Camera.from_fov(120, 90, math.radians(50))
    found, said = [], []
    for seed in range(8):
        sensor = SensorModel(shot_noise_hz=20.0, latency_jitter_us=200.0)
        r = simulate(texture, camera, TRUE_PRISM, duration_s=0.1, sensor=sensor, seed=seed)
        c = calibrate(r, global_algorithm=None, start={"apex": TRUE_PRISM.apex, "phase": 0.0})
        found.append(c.parameters["apex"])
        said.append(c.uncertainty["apex"])
    assert 1 / 3 < np.std(found, ddof=1) / np.mean(said) < 3


def test_clock_offset_is_found_at_a_changing_speed(texture: np.ndarray) -> None:
    camera = Camera.from_fov(160, 120, math.radians(50))
    ramp = np.array([[0.0, 300.0], [0.3, 1500.0]])
    recording = simulate(
        texture, camera, TRUE_PRISM, duration_s=0.3, motion=PrismMotion(ramp, phase=1.0), seed=1,
        encoder=EncoderModel(clock_offset_us=1500.0), sensor=SensorModel(latency_us=0.0, latency_jitter_us=0.0),
    )  # fmt: skip
    c = calibrate(recording, free=("apex", "phase", "clock_offset"), events=200_000)
    assert c.parameters["clock_offset"] == pytest.approx(1500.0, abs=150.0)
    fixed = calibrate(recording, free=("apex", "phase"), events=200_000)
    assert c.sharpness_after > fixed.sharpness_after


def test_tilt_is_found(texture: np.ndarray) -> None:
    camera = Camera.from_fov(200, 150, math.radians(70))
    recording = simulate(
        texture, camera, Prism(math.radians(4)), duration_s=0.17, motion=PrismMotion(720.0, tilt=(0.05, -0.03)),
    )  # fmt: skip
    c = calibrate(recording, free=("apex", "phase", "tilt_x", "tilt_y"), local_evaluations=400)
    assert c.parameters["tilt_x"] == pytest.approx(0.05, abs=0.02)
    assert c.parameters["tilt_y"] == pytest.approx(-0.03, abs=0.02)


@pytest.mark.parametrize(("name", "x", "y"), [("cylinder", 0.008, -0.005), ("wobble", 0.06, -0.04)])
def test_an_uneven_prism_is_found(texture: np.ndarray, name: str, x: float, y: float) -> None:
    camera = Camera.from_fov(200, 150, math.radians(80))
    motion = replace(PrismMotion(720.0, phase=0.3), **{name: (x, y)})
    recording = simulate(
        texture,
        camera,
        Prism(math.radians(4)),
        duration_s=0.17,
        motion=motion,
        sensor=SensorModel.ideal(0.25),
    )
    c = amiwarp.calibrate(
        recording, free=("apex", "phase", f"{name}_x", f"{name}_y"), model="exact"
    )
    assert c.parameters[f"{name}_x"] == pytest.approx(x, rel=0.02)
    assert c.parameters[f"{name}_y"] == pytest.approx(y, rel=0.02)
    assert c.warnings == ()
    assert recording.truth is not None
    assert model_error(c.model, truth_model(camera, recording.truth, FlatSide.SCENE)).rms < 0.01


def test_index_can_be_free_and_is_hardly_determined(recording: Recording) -> None:
    """At equal deflection, another index moves events by hundredths of a pixel only."""
    c = calibrate(recording, free=("apex", "phase", "index"), events=200_000, local_evaluations=300)
    hardly = c.uncertainty["index"] > 5 * calibrate(recording, events=200_000).uncertainty["apex"]
    assert hardly or any("lies on its bound; widen the bounds of index" in w for w in c.warnings)
    assert error_px(recording, c.model) < 0.25


@pytest.mark.parametrize("rpm", [720.0, -431.0])
def test_speed_is_found_without_an_encoder(texture: np.ndarray, rpm: float) -> None:
    camera = Camera.from_fov(160, 120, math.radians(50))
    recording = simulate(
        texture, camera, TRUE_PRISM, duration_s=0.5, motion=PrismMotion(rpm, phase=1.0)
    )
    recording = replace(recording, encoder=None)
    assert estimate_rpm(recording) == pytest.approx(abs(rpm), rel=2e-3)
    c = calibrate(recording, events=200_000)
    assert c.parameters["rpm"] == pytest.approx(rpm, rel=1e-3)
    assert error_px(recording, c.model) < 0.2
    encoder = c.encoder_for(None, recording.events.t_first, recording.events.t_last)
    assert encoder.rpm == pytest.approx(c.parameters["rpm"])
    with pytest.raises(
        AmiwarpError, match="the calibration was made without one, so its phase holds for its own"
    ):
        c.encoder_for(encoder, recording.events.t_first, recording.events.t_last)
    x, y = compensate_events(recording.events[:], c.model, encoder).T
    moved = Events(x.copy(), y.copy(), recording.events[:].t, recording.events[:].p)
    with pytest.raises(AmiwarpError, match="already compensated; give events from a sensor"):
        calibrate(replace(recording, events=MemoryEvents(moved, 160, 120)))


@pytest.mark.parametrize("given", [None, 717.0])
def test_phase_without_an_encoder_belongs_to_the_speed_found(
    texture: np.ndarray, tmp_path: Path, given: float | None
) -> None:
    camera = Camera.from_fov(160, 120, math.radians(50))
    recording = simulate(
        texture, camera, TRUE_PRISM, duration_s=0.5, motion=PrismMotion(720.0, phase=1.0)
    )
    assert recording.encoder is not None
    blind = replace(recording, encoder=None)
    first, last = recording.events.t_first, recording.events.t_last
    c = calibrate(blind, events=200_000, start={} if given is None else {"rpm": given})
    c.save(tmp_path / "c.json")
    c = Calibration.load(tmp_path / "c.json")
    # the azimuth of the tilt, compared with a calibration that uses the encoder
    known = calibrate(recording, events=200_000)
    t = np.array([first, (first + last) // 2, last])
    azimuth = c.encoder_for(None, first, last).angle_at(t) + c.parameters["phase"]
    expected = recording.encoder.angle_at(t) + known.parameters["phase"]
    np.testing.assert_allclose(wrap_angle(azimuth - expected), 0.0, rtol=0, atol=math.radians(1.0))
    # the same holds for a part of the recording
    part = c.encoder_for(None, first + 100_000, last).angle_at(t[1:]) + c.parameters["phase"]
    np.testing.assert_allclose(part, azimuth[1:], rtol=0, atol=1e-9)


def test_what_is_known_is_used(recording: Recording) -> None:
    known = {"apex": TRUE_PRISM.apex, "phase": 0.0, "index": 1.6}
    c = calibrate(recording, global_algorithm=None, start=known, events=50_000)
    assert c.parameters["index"] == 1.6
    assert "index" not in c.free
    # the events determine (n - 1) apex only
    assert c.parameters["apex"] * 0.6 == pytest.approx(
        TRUE_PRISM.apex * (TRUE_PRISM.index - 1.0), rel=0.03
    )


def test_thinning_is_even_and_complete(recording: Recording) -> None:
    n = len(recording.events)
    assert len(thin(recording, n)) == n
    few = thin(recording, n // 7)
    whole = recording.events.slice(0, n)
    kept = np.arange(n) // RUN % -(-n // (n // 7)) == 0
    np.testing.assert_array_equal(few.t, whole.t[kept])
    assert PARTS > 1


def test_a_burst_at_the_first_time_stamp_is_left_out_and_said(recording: Recording) -> None:
    (width, height), events = recording.events.size, recording.events[:]
    y, x = np.divmod(np.arange(5000), width)
    start = int(events.t[0]) - 3
    burst = Events.from_arrays(x, y, np.full(5000, start), np.ones(5000))
    started = MemoryEvents(Events.concatenate([burst, events]), width, height)
    plain = calibrate(recording)
    found = calibrate(replace(recording, events=started))
    assert found.parameters == plain.parameters
    assert found.events == plain.events
    assert found.warnings[:-1] == plain.warnings
    assert found.warnings[-1].startswith(f"5,000 events carry the first time stamp ({start} us)")
    by_paper = calibrate_as_paper(replace(recording, events=started))
    assert by_paper.parameters == calibrate_as_paper(recording).parameters
    assert by_paper.warnings == found.warnings[-1:]


def test_a_coarse_clock_is_no_burst(recording: Recording) -> None:
    events = recording.events[:]
    ticks = Events(events.x, events.y, events.t // 5000 * 5000, events.p)
    source = MemoryEvents(ticks, *recording.events.size)
    assert source.find(source.t_first + 1) > 1000
    assert without_start_burst(replace(recording, events=source))[0].events is source
    assert burst_size(MemoryEvents(ticks[:1000], *source.size)) == 0  # all have the same time


def test_events_after_a_burst_are_a_whole_source() -> None:
    t = np.concatenate([np.zeros(300, np.int64), np.arange(1, 3994)])
    zeros = np.zeros(len(t), np.uint16)
    events = Events(zeros, zeros, t, (t % 2).astype(np.uint8))
    source = MemoryEvents(events, 4, 3)
    later, expected = LaterEvents(source, 300), MemoryEvents(events[300:], 4, 3)
    assert burst_size(source) == 300
    assert (len(later), later.t_first, later.t_last, later.size) == (3993, 1, 3993, (4, 3))
    assert [later.find(at) for at in (-5, 0, 1, 8, 9000)] == [
        expected.find(at) for at in (-5, 0, 1, 8, 9000)
    ]
    for one, other in (
        (later.slice(2, 5), expected.slice(2, 5)),
        (later[-3:], expected[-3:]),
        (later.between(-5, 9), expected.between(-5, 9)),
        (later.between(10, 20), expected.between(10, 20)),
        (Events.concatenate([*later.blocks()]), expected[:]),
    ):
        np.testing.assert_array_equal(one.t, other.t)
    for size in ({"count": 1000}, {"duration_us": 900}):
        blocks = [block.t.tolist() for block in later.blocks(**size)]
        assert blocks == [block.t.tolist() for block in expected.blocks(**size)]


# -- refusals, each with its reason


def test_too_few_events(recording: Recording) -> None:
    with pytest.raises(AmiwarpError, match="too few"):
        calibrate(keep(recording, slice(0, 1000)))


def test_under_a_quarter_turn(recording: Recording) -> None:
    with pytest.raises(AmiwarpError, match="quarter turn"):
        calibrate(keep(recording, recording.events.slice(0, len(recording.events)).t < 18_000))


def test_encoder_not_covering(recording: Recording) -> None:
    assert recording.encoder is not None
    short = Encoder(recording.encoder.t[:100], recording.encoder.angle[:100])
    with pytest.raises(AmiwarpError, match="cover"):
        calibrate(replace(recording, encoder=short))


def test_no_texture() -> None:
    rng = np.random.default_rng(0)
    n = 50_000
    events = Events.from_arrays(
        rng.integers(0, 160, n),
        rng.integers(0, 120, n),
        np.sort(rng.integers(0, 250_000, n)),
        rng.integers(0, 2, n),
    )
    camera = Camera.from_fov(160, 120, math.radians(50))
    noise = Recording(
        MemoryEvents(events, 160, 120),
        camera,
        Encoder.constant_speed(720, 0, 250_000),
        TRUE_PRISM,
        None,
        {},
        "noise",
    )
    with pytest.raises(AmiwarpError, match="no texture"):
        calibrate(noise)


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0])
def test_one_edge_direction(angle: float) -> None:
    rows, columns = np.mgrid[:240, :320]
    across = columns * math.cos(math.radians(angle)) + rows * math.sin(math.radians(angle))
    rng = np.random.default_rng(2)
    steps = np.cumsum(rng.uniform(10, 40, 60))
    stripes = rng.integers(20, 250, 61)[np.searchsorted(steps, across + 300)].astype(np.uint8)
    camera = Camera.from_fov(160, 120, math.radians(50))
    recording = simulate(stripes, camera, TRUE_PRISM, duration_s=0.1)
    with pytest.raises(AmiwarpError, match="one direction"):
        calibrate(recording, events=100_000)


def test_a_real_recording_without_a_prism(data_dir: Path) -> None:
    recording = open_recording(data_dir / "aedat" / "aedat4_davis346_cars.aedat4")
    camera = Camera.from_fov(346, 260, math.radians(60))
    first, last = recording.events.t_first, recording.events.t_last
    encoder = Encoder.constant_speed(600.0, first, last)
    with pytest.raises(AmiwarpError, match="no motion"):
        calibrate(replace(recording, camera=camera, encoder=encoder))


def test_unknown_camera(recording: Recording) -> None:
    with pytest.raises(AmiwarpError, match="camera is unknown"):
        calibrate(replace(recording, camera=None))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"free": ("apex", "focal")},
            "'focal' is unknown; choose among .*, motion, off_ratio, leak",
        ),
        ({"free": ("rpm", "apex")}, "encoder gives the rpm"),
        ({"start": {"rpm": 720.0}}, "encoder gives the rpm"),
        ({"start": {"deflection": 0.01}}, "deflection, which is no parameter of the exact model"),
        (
            {"start": {"apex": 0.2}},
            r"start of apex = 0\.2 is not in 0 \.\. 0\.\d+ rad; give its bounds too \(--bound\)",
        ),
        ({"bounds": {"index": (1.4, 1.6)}}, "given for index, which is not free"),
        ({"free": ()}, "no parameter is free"),
        ({"model": "circle", "free": ("deflection", "tilt_x")}, "tilt_x"),
        ({"model": "sphere"}, "sphere"),
        ({"global_algorithm": "GN_X"}, "GN_X"),
        ({"local_algorithm": "GN_DIRECT"}, "GN_DIRECT"),
        ({"bounds": {"apex": (0.05, 0.01)}}, "lower bound first"),
        ({"events": 0}, "events"),
    ],
)
def test_bad_settings(recording: Recording, changes: dict[str, object], text: str) -> None:
    with pytest.raises(AmiwarpError, match=text):
        calibrate(recording, **changes)


def test_one_word_is_enough_where_a_setting_takes_several() -> None:
    assert Settings(stages="sharpness", free="apex") == Settings(
        stages=("sharpness",), free=("apex",)
    )
    assert Settings(stages=["sharpness", "photometric"], free=["apex"]) == Settings(free=("apex",))
    Settings(stages="sharpness").check()
    with pytest.raises(
        AmiwarpError,
        match=r"stages is \('photometric',\); expected 'sharpness' or \('sharpness', 'ph",
    ):
        Settings(stages="photometric").check()
    with pytest.raises(
        AmiwarpError, match="free is 3; expected a tuple of parameter names, or None"
    ):
        Settings(free=3).check()


def test_the_typed_options_are_the_settings() -> None:
    """A type checker knows every keyword argument of ``calibrate``, with the type of the field, or one word of it."""
    fields = get_type_hints(Settings)
    assert get_type_hints(CalibrationOptions) == fields | {
        name: str | fields[name] for name in ("free", "stages")
    }
    assert not CalibrationOptions.__required_keys__


def test_a_phase_to_start_with_is_wrapped(recording: Recording) -> None:
    """Unless bounds are given, which hold for it as given."""
    assert recording.camera is not None

    def started(start: float, **bounds: tuple[float, float]) -> float:
        return make_space(
            "circle", recording.camera, NOMINAL_PRISM, free=("deflection", "phase"), start={"phase": start},
            bounds=bounds, rad_per_us=75e-6, duration_us=250e3,
        ).start["phase"]  # fmt: skip

    assert started(1.5 * np.pi) == pytest.approx(-0.5 * np.pi, abs=1e-12)
    assert started(-1.25) == -1.25
    assert started(5.0, phase=(4.0, 6.0)) == 5.0


def test_a_drift_that_is_held_still_turns_the_angles(recording: Recording) -> None:
    """Angles of events are computed for the start value. If the parameter is fixed elsewhere, they change."""
    assert recording.camera is not None
    space = make_space(
        "exact", recording.camera, NOMINAL_PRISM, free=("apex", "phase", "clock_offset"), start={"clock_offset": 100.0},
        bounds={}, rad_per_us=75e-6, duration_us=250e3,
    )  # fmt: skip
    values = {"apex": 0.03, "phase": 1.0, "clock_offset": 140.0}
    held = space.without(("clock_offset",)).holding(values)
    assert space.drift(values) == held.drift(values) == held.drift({}) == 40.0
