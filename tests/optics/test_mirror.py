"""The mirror with two tilts: its model against float64 reflections, simulation, calibration, and commands."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import amiwarp
from amiwarp import ParameterSpace
from amiwarp.calib.sharpness_search import bound_warnings
from amiwarp.results import best_model, make_space
from amiwarp.results.parameters import globally_searched
from reference import optics as reference
from tests.command_line import app

VALUES = {
    "amplitude": 0.012, "phase": 0.7, "second_amplitude": 0.009, "second_phase": -1.1, "direction": 0.2,
    "second_direction": 1.7, "fold": 0.4, "incidence": 0.7,
}  # fmt: skip
NO_PRISM = amiwarp.Prism(0.0)
MIRROR = amiwarp.Mirror(
    hz=(60.0, -77.0),
    amplitude=(0.011, 0.008),
    phase=(0.7, -1.2),
    direction=(-0.3, 1.3),
    fold=2.4,
    incidence=0.9,
)
"""Up to 9 px in the view of ``recording``. A search starts with a fold of 0 and an incidence of 45 deg."""
PROMPT = amiwarp.SensorModel(refractory_us=0.0, latency_us=0.0, latency_jitter_us=0.0)
AMPLITUDES = ("amplitude", "phase", "second_amplitude", "second_phase")
"""What is left to find where the mount is known."""
FEW = amiwarp.PhotometricSettings(pairs=25_000)


@pytest.mark.parametrize("scale", [1.0, 8.0])
def test_device_functions_agree_with_float64_reflections(device: str, scale: float) -> None:
    import warp as wp

    values = {name: scale * x if "amplitude" in name else x for name, x in VALUES.items()}
    camera = amiwarp.Camera(
        320, 240, 280.0, 275.0, 161.0, 118.0, amiwarp.RadialTangential(k1=-0.1, k2=0.02)
    )
    rng = np.random.default_rng(1)
    xy, theta = rng.uniform((0, 0), (319, 239), (2000, 2)), rng.uniform(-9, 9, (2000, 2))
    model = amiwarp.MirrorModel.from_values(camera, NO_PRISM, values)
    points = wp.array(xy.astype(np.float32), dtype=wp.vec2, device=device)
    angles = wp.array(theta.astype(np.float32), dtype=float, device=device)
    expected = reference.in_mirror(camera, values, xy, theta)
    assert np.nanmax(np.linalg.norm(expected - xy, axis=1)) > 6.0 * scale
    inside = np.isfinite(expected).all(axis=1) & (np.abs(expected) < 600.0).all(axis=1)
    assert inside.mean() > 0.9
    there = model.compensate_points(points, angles)
    np.testing.assert_allclose(
        there.numpy()[inside], expected[inside], rtol=0, atol=2e-3 if scale == 1.0 else 2e-2
    )
    back = model.deflect_points(there, angles).numpy()
    np.testing.assert_allclose(back[inside], xy[inside], rtol=0, atol=2e-3)


def test_one_angle_gives_the_other_by_their_ratio() -> None:
    camera, theta = amiwarp.Camera.from_fov(320, 240, 1.0), np.linspace(0.0, 3.0, 50)
    model = amiwarp.MirrorModel.from_values(camera, NO_PRISM, VALUES | {"ratio": -1.25})
    xy = np.tile([[100.0, 50.0]], (50, 1))
    both = np.stack([theta, -1.25 * theta], axis=1)
    np.testing.assert_allclose(
        model.compensate_points(xy, theta), model.compensate_points(xy, both), rtol=0, atol=1e-4
    )
    first, second = (
        each.compensate_points(xy, np.stack([theta, theta], axis=1)) - xy
        for each in model.singles()
    )
    assert np.ptp(first, axis=0).max() > 2.0
    assert np.ptp(second, axis=0).max() > 2.0
    still = amiwarp.MirrorModel.from_values(
        camera, NO_PRISM, amiwarp.MirrorModel.still_values(VALUES)
    )
    np.testing.assert_allclose(still.compensate_points(xy, both), xy, rtol=0, atol=1e-4)


def test_each_single_tilt_moves_points_by_its_own_angle() -> None:
    camera, theta = amiwarp.Camera.from_fov(320, 240, 1.0), np.linspace(0.0, 3.0, 50)
    xy = np.tile([[100.0, 50.0]], (50, 1))
    singles = amiwarp.MirrorModel.from_values(camera, NO_PRISM, VALUES | {"ratio": -1.25}).singles()
    for single, resting, places in zip(
        singles, ("second_amplitude", "amplitude"), (0, 1), strict=True
    ):
        other = amiwarp.MirrorModel.from_values(camera, NO_PRISM, VALUES | {resting: 0.0})
        both = np.full((50, 2), 0.7)
        both[:, places] = theta
        expected = other.compensate_points(xy, both)
        # Px
        np.testing.assert_allclose(single.compensate_points(xy, theta), expected, rtol=0, atol=1e-4)


def test_directions_are_free_unless_both_tilts_have_one_frequency() -> None:
    directions = {"direction", "second_direction"}
    for ratio in (None, 0.8, -1.25, 0.0):
        assert directions < {*amiwarp.MirrorModel.freed(ratio)}
    for ratio in (
        1.0,
        -1.0,
        -1.0005,
    ):  # two oscillations of one frequency, also to and fro, make one ellipse
        assert {*amiwarp.MirrorModel.FREED} - {*amiwarp.MirrorModel.freed(ratio)} == directions


def test_a_tilt_is_searched_up_to_a_displacement_of_24_px() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    for name in ("amplitude", "second_amplitude"):
        low, high = amiwarp.MirrorModel.default_bounds(name, 0.01, camera, NO_PRISM)
        assert low == 0.0
        model = amiwarp.MirrorModel(camera, **({"amplitude": 0.0} | {name: high}))
        middle = np.array([[camera.cx, camera.cy]])
        away = model.compensate_points(middle, np.zeros((1, 2))) - middle
        assert np.linalg.norm(away) == pytest.approx(24.0, rel=0.01)  # px


def test_a_direction_has_no_bounds_but_given_ones() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)

    def space_with(**bounds: tuple[float, float]) -> ParameterSpace:
        return make_space("mirror", camera, NO_PRISM, free=None, start={"ratio": 1.3}, bounds=bounds, rad_per_us=1e-3,
                          duration_us=1e5)  # fmt: skip

    space = space_with()
    turned = {
        **space.start,
        "direction": 2.5,
        "second_direction": -1.8,
        "fold": 6.0,
        "amplitude": 0.01,
    }
    assert space.to_values(space.to_vector(turned))["direction"] == pytest.approx(2.5)
    assert bound_warnings(space, {**turned, "second_amplitude": 0.01}) == ()
    tilted = {**turned, "second_amplitude": 0.01, "incidence": 0.0}
    assert bound_warnings(space, tilted) == ()  # there is no incidence below
    assert len(bound_warnings(space_with(incidence=(0.1, 1.0)), {**tilted, "incidence": 0.1})) == 1
    coarse = globally_searched(space)
    for name, middle in (("direction", 0.0), ("second_direction", 0.5 * math.pi)):
        assert middle - math.pi < coarse.low[name] < middle - 0.5 * math.pi
        assert middle + 0.5 * math.pi < coarse.high[name] < middle + math.pi
    given = space_with(direction=(-0.3, 0.2))
    assert (
        globally_searched(given).low["direction"],
        globally_searched(given).high["direction"],
    ) == (-0.3, 0.2)
    assert (
        "direction = 0.2 rad lies on its bound"
        in bound_warnings(given, {**tilted, "direction": 0.2})[0]
    )


def test_the_twin_moves_the_image_nearly_alike() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    rng = np.random.default_rng(3)
    xy, theta = rng.uniform((0, 0), (319, 239), (500, 2)), rng.uniform(-3, 3, (500, 2))
    twin = amiwarp.MirrorModel.twin_values(VALUES)
    assert math.cos(twin["fold"] - VALUES["fold"]) == pytest.approx(-1.0)
    one, other = (amiwarp.MirrorModel.from_values(camera, NO_PRISM, v) for v in (VALUES, twin))
    middle = np.tile([[camera.cx, camera.cy]], (500, 1))
    at_centre = one.compensate_points(middle, theta) - other.compensate_points(middle, theta)
    assert np.abs(at_centre).max() < 0.2  # px
    assert np.abs(one.compensate_points(xy, theta) - other.compensate_points(xy, theta)).max() > 1.0
    assert amiwarp.ExactModel.twin_values({"apex": 0.03, "phase": 0.1}) is None
    assert amiwarp.MirrorModel.twin_values({"amplitude": 0.01, "phase": 0.1}) is None


def test_what_is_not_given_is_usual() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    model = amiwarp.MirrorModel.from_values(camera, NO_PRISM, {"amplitude": 0.01, "phase": 0.2})
    assert model == amiwarp.MirrorModel(camera, 0.01, 0.2)
    assert (model.second_amplitude, model.second_direction) == (0.0, 0.5 * math.pi)


def test_amplitudes_in_degrees_are_refused() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    with pytest.raises(amiwarp.AmiwarpError, match=r"amplitude .* is it given in degrees"):
        amiwarp.MirrorModel(camera, 0.5)
    with pytest.raises(amiwarp.AmiwarpError, match="incidence"):
        amiwarp.MirrorModel(camera, 0.01, incidence=1.6)
    with pytest.raises(amiwarp.AmiwarpError, match=r"mirror hz|hz"):
        amiwarp.Mirror((60.0, math.nan), (0.01, 0.01))


# Simulation.


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> amiwarp.Recording:
    camera = amiwarp.Camera.from_fov(128, 96, math.radians(35.0))
    return amiwarp.simulate(texture, camera, MIRROR, duration_s=0.2, sensor=PROMPT, seed=3)


def test_simulated_events_know_their_point_at_rest(recording: amiwarp.Recording) -> None:
    assert recording.prism is None
    assert recording.camera is not None
    assert recording.truth is not None
    assert recording.encoder is not None
    assert recording.encoder.second is not None
    events = recording.events.slice(0, 20_000)
    points = recording.truth.points(0, 20_000)
    assert points is not None
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    away = (
        reference.in_mirror(
            recording.camera, MIRROR.parameters(), xy, MIRROR.motion.angles(events.t)
        )
        - points
    )
    assert np.abs(np.median(away, axis=0)).max() < 0.01  # px
    assert np.std(away) < 0.02  # px: times in microseconds
    assert np.std(xy - points) > 1.5
    assert {
        name: recording.truth.parameters[name] for name in MIRROR.parameters()
    } == MIRROR.parameters()


def test_a_mirror_shows_the_scene_mirrored(texture: np.ndarray) -> None:
    camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    scene = amiwarp.Scene.from_picture(texture, fov=1.4)
    plain = amiwarp.Simulation(scene, camera, NO_PRISM, 0.1).log_view()
    folds = (0.0, 0.5 * math.pi)
    seen = [
        amiwarp.Simulation(
            scene, camera, amiwarp.Mirror((60.0, 77.0), (0.0, 0.0), fold=fold), 0.1
        ).log_view()
        for fold in folds
    ]
    np.testing.assert_allclose(seen[0], plain[:, ::-1], atol=1e-4)
    np.testing.assert_allclose(seen[1], plain[::-1], atol=1e-4)


@pytest.mark.parametrize("seeing", ["maps", "rays"])
def test_a_world_is_seen_in_a_mirror(seeing: str) -> None:
    """A square to the right is seen on the left, and events have their place at rest on its edges."""
    corners = [[0.2, 2, -0.5], [1.2, 2, -0.5], [1.2, 2, 0.5], [0.2, 2, 0.5]]
    square = amiwarp.Mesh(corners, [[0, 1, 2], [0, 2, 3]])
    world = amiwarp.World(
        "example", (amiwarp.Body("wall", square, amiwarp.Material(reflectance=0.8)),)
    )
    way = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    camera = amiwarp.Camera.from_fov(64, 48, 1.4)
    mirror = amiwarp.Mirror((100.0, 130.0), (0.03, 0.03))
    scene = amiwarp.WorldScene(world, way, seeing=seeing)
    simulation = amiwarp.Simulation(scene, camera, mirror, 0.02, sensor=amiwarp.SensorModel.ideal())
    made = simulation.run(truth_times_us=[0])
    assert made.truth is not None
    frame = next(iter(made.truth.frames or ()))
    near = frame.depth < 3.0
    assert near[:, :32].sum() > 300
    assert not near[:, 33:].any()
    np.testing.assert_allclose(frame.depth[24, 16], 2.0, atol=0.01)
    assert np.linalg.det(frame.rotation) == pytest.approx(1.0)
    assert np.nanmax(np.abs(frame.flow)) == 0.0
    points = made.truth.points(0, len(made.events))
    assert points is not None
    left = 31.5 - camera.fx * np.array([0.6, 0.1])  # of the square's edges at rest [px]
    level = np.abs(points[:, 1] - 23.5) < 6.0  # beside its upright edges
    nearest = np.abs(points[level, :1] - left).min(axis=1)
    assert level.sum() > 300
    assert np.mean(nearest < 1.0) > 0.9
    recorded = made.events.slice(0, len(points))
    assert np.std(recorded.x[level] - points[level, 0]) > 1.0
    assert len(simulation.without_prism().run().events) == 0


# Calibration.


def distance(found: amiwarp.Calibration, mirror: amiwarp.Mirror) -> float:
    """Return the distance of the calibrated and the true motion over the image and both angles [px rms]."""
    camera = found.camera
    at = [
        np.linspace(0, camera.width - 1, 6),
        np.linspace(0, camera.height - 1, 5),
        *[np.arange(8) * math.pi / 4] * 2,
    ]
    grid = np.stack(np.meshgrid(*at), axis=-1).reshape(-1, 4)
    moved = found.model.compensate_points(grid[:, :2], grid[:, 2:])
    expected = reference.in_mirror(camera, mirror.parameters(), grid[:, :2], grid[:, 2:])
    return float(np.sqrt(np.mean(np.sum((moved - expected) ** 2, axis=1))))


@pytest.fixture(scope="module")
def calibrated(recording: amiwarp.Recording) -> amiwarp.Calibration:
    return amiwarp.calibrate(recording, model="mirror", events=30_000, photometric=FEW)


def test_it_is_calibrated_without_start_values(calibrated: amiwarp.Calibration) -> None:
    assert distance(calibrated, MIRROR) < 0.02  # px
    true = MIRROR.parameters()
    for name in ("amplitude", "second_amplitude", "fold", "incidence"):
        assert abs(calibrated.parameters[name] - true[name]) < 6.0 * calibrated.uncertainty[name]
    assert set(calibrated.free) == set(amiwarp.MirrorModel.FREED) == set(calibrated.uncertainty)


@pytest.mark.slow
def test_two_mirrors_of_one_tilt_each_are_found_as_one(texture: np.ndarray) -> None:
    """Neither turns the image about its middle."""
    from scipy.spatial.transform import Rotation

    from tests.calib.test_steadiness import Shaken

    camera, hz, tilts = (
        amiwarp.Camera.from_fov(128, 96, math.radians(35.0)),
        (60.0, 77.0),
        (0.016, 0.012),
    )

    def swing(k: int, t: np.ndarray) -> np.ndarray:
        return np.asarray(tilts[k] * np.cos(math.tau * hz[k] * t + k))

    def path(t: np.ndarray) -> np.ndarray:
        about_x, about_y = swing(1, t), swing(0, t)
        second = Rotation.from_rotvec(np.outer(about_x, (1.0, 0.0, 0.0)))
        turned = (second * Rotation.from_rotvec(np.outer(about_y, (0.0, -1.0, 0.0)))).as_rotvec()
        return np.asarray(turned[:, 0] + 1j * turned[:, 1])

    still = amiwarp.Simulation(amiwarp.Scene.from_picture(texture), camera, NO_PRISM, 0.1, sensor=PROMPT,
                               camera_motion=Shaken(path=path)).without_prism().run()  # fmt: skip
    t = np.arange(-3000, 103_001, 500)
    first, second = (amiwarp.Encoder(t, math.tau * each * t * 1e-6) for each in hz)
    recording = amiwarp.Recording(
        still.events, camera, first.with_second(second), metadata={"optic": "mirror"}
    )
    found = amiwarp.calibrate(recording, model="mirror", stages=("sharpness",)).parameters
    assert found["incidence"] < 0.1
    assert 2.0 * found["amplitude"] == pytest.approx(tilts[0], rel=0.05)
    assert 2.0 * found["second_amplitude"] == pytest.approx(tilts[1], rel=0.05)


def test_a_known_mount_need_not_be_found(recording: amiwarp.Recording) -> None:
    true = MIRROR.parameters()
    known = {name: true[name] for name in ("direction", "second_direction", "fold", "incidence")}
    given = {"model": "mirror", "events": 30_000, "stages": ("sharpness",)}
    found = amiwarp.calibrate(recording, start=known, free=AMPLITUDES, **given)
    assert set(found.free) == set(AMPLITUDES)
    assert distance(found, MIRROR) < 0.3  # px
    same = amiwarp.MirrorModel.from_values(found.camera, NO_PRISM, found.parameters)
    assert same == found.model
    known |= {name: true[name] for name in AMPLITUDES[2:]}
    one = amiwarp.calibrate(recording, start=known, free=AMPLITUDES[:2], **given)
    assert one.parameters["second_amplitude"] == true["second_amplitude"]
    assert distance(one, MIRROR) < 0.3  # px


def test_a_file_keeps_it(
    calibrated: amiwarp.Calibration, recording: amiwarp.Recording, tmp_path: Path
) -> None:
    calibrated.save(tmp_path / "c.json")
    assert json.loads((tmp_path / "c.json").read_text())["prism"] is None
    loaded = amiwarp.Calibration.load(tmp_path / "c.json")
    assert loaded.model == calibrated.model
    amiwarp.save_recording(tmp_path / "r.h5", recording)
    amiwarp.compensate(amiwarp.open_recording(tmp_path / "r.h5"), loaded, tmp_path / "out.h5")
    out = amiwarp.open_recording(tmp_path / "out.h5").events.slice(0, 20_000)
    points = recording.truth.points(0, 20_000) if recording.truth is not None else None
    assert points is not None
    away = np.stack([out.x, out.y], axis=1) - points
    assert np.std(away) < 0.03  # px


@pytest.mark.parametrize(
    "resting", [("second_amplitude",), ("amplitude",), ("amplitude", "second_amplitude")]
)
def test_only_a_mirror_without_any_tilt_is_at_rest(
    calibrated: amiwarp.Calibration, resting: tuple[str, ...]
) -> None:
    parameters = {**calibrated.parameters, **dict.fromkeys(resting, 0.0)}
    encoder = replace(calibrated, parameters=parameters).encoder_for(TWO, 0, 100_000)
    turned = np.ptp(encoder.angles_at([0, 50_000]), axis=0)
    assert turned.tolist() == (
        [0.0, 0.0] if len(resting) == 2 else np.ptp(TWO.angles_at([0, 50_000]), axis=0).tolist()
    )


ONE = amiwarp.Encoder.constant_speed(720.0, 0, 100_000)
TWO = ONE.with_second(0.7)


@pytest.mark.parametrize(
    ("glass", "encoder", "optic", "best"),
    [
        (None, TWO, "mirror", "mirror"),
        (None, None, "vibration", "vibration"),
        (None, TWO, None, None),  # two prisms or a mirror
        (None, TWO, "vibration", None),  # which has no angles
        (None, ONE, "mirror", "exact"),  # which has two
        (None, TWO, "kaleidoscope", None),
        (None, TWO, 7, None),
        (None, ONE, None, "exact"),
        (amiwarp.Prism(0.02), TWO, None, "risley"),
        (amiwarp.UnsizedPrism(), TWO, None, "risley"),
        (amiwarp.Prism(0.02), TWO, "mirror", "risley"),  # known glass tells more
        (amiwarp.Plate(0.01, 0.7), ONE, None, "plate"),
    ],
)
def test_a_recording_tells_its_optic(
    glass: amiwarp.Prism | amiwarp.UnsizedPrism | amiwarp.Plate | None, encoder: amiwarp.Encoder | None,
    optic: str | int | None, best: str | None,
) -> None:  # fmt: skip
    events = amiwarp.MemoryEvents(amiwarp.Events.from_arrays([1], [1], [10], [1]), 4, 3)
    metadata = {} if optic is None else {"optic": optic}
    assert best_model(amiwarp.Recording(events, None, encoder, glass, metadata=metadata)) == best


def test_two_angles_without_a_named_optic_are_refused_with_the_choices(
    recording: amiwarp.Recording,
) -> None:
    assert recording.metadata["optic"] == "mirror"
    camera, scene = (
        amiwarp.Camera.from_fov(8, 6, 1.0),
        amiwarp.Scene.from_picture(np.zeros((8, 8), np.float32)),
    )
    assert "optic" not in amiwarp.Simulation(scene, camera, MIRROR, 0.1).without_prism().metadata()
    with pytest.raises(
        amiwarp.AmiwarpError,
        match=r"names no optic; give .*--model risley.*--model steerer.*--model mirror",
    ):
        amiwarp.calibrate(replace(recording, metadata={}))


def test_commands_that_nothing_follows_are_refused(recording: amiwarp.Recording) -> None:
    encoder = recording.encoder
    assert encoder is not None
    other = amiwarp.Encoder.constant_speed(-2111.0, -1000, 300_000)
    wrong = replace(
        recording, encoder=other.with_second(amiwarp.Encoder.constant_speed(1377.0, -1000, 300_000))
    )
    with pytest.raises(amiwarp.AmiwarpError, match="no motion of a mirror"):
        amiwarp.calibrate(wrong, model="mirror", events=30_000, stages=("sharpness",))


def test_motion_too_fast_for_the_sensor_is_refused(texture: np.ndarray) -> None:
    """Where the mount is known: the search for it takes longer, and says the same."""
    camera = amiwarp.Camera.from_fov(64, 48, math.radians(50.0))
    fast = amiwarp.Mirror((140.0, 120.0), (0.04, 0.04))
    shown = amiwarp.simulate(texture, camera, fast, duration_s=0.1, seed=1)
    coarse = amiwarp.PhotometricSettings(pairs=10_000, density=1.0)
    known = {
        name: fast.parameters()[name]
        for name in ("direction", "second_direction", "fold", "incidence")
    }
    with pytest.raises(
        amiwarp.AmiwarpError,
        match=r"px within the sensor's refractory period.* let the image move less",
    ):
        amiwarp.calibrate(
            shown, model="mirror", events=20_000, start=known, free=AMPLITUDES, photometric=coarse
        )


@pytest.mark.slow
def test_a_turning_camera_leaves_all_parameters_of_two_angles_free(texture: np.ndarray) -> None:
    camera, pair = (
        amiwarp.Camera.from_fov(80, 60, math.radians(50.0)),
        amiwarp.Prism(0.03, second=amiwarp.Prism(0.025)),
    )
    motion = amiwarp.PrismMotion(1500.0, 0.3, second=amiwarp.PrismMotion(-2100.0, -0.7))
    turns = amiwarp.CameraMotion((0.3, 0.2, 0.1))
    made = amiwarp.simulate(
        texture,
        camera,
        pair,
        duration_s=0.2,
        motion=motion,
        sensor=PROMPT,
        camera_motion=turns,
        seed=2,
    )
    found = amiwarp.calibrate(made, events=15_000, photometric=FEW)
    assert any("the camera turned at" in said for said in found.warnings)
    assert found.parameters["apex"] == pytest.approx(0.03, rel=0.02)
    assert found.parameters["second_apex"] == pytest.approx(0.025, rel=0.02)


# Commands.


@pytest.mark.parametrize("shape", ["sine", "two sines", "triangle", "damped", "pausing"])
def test_a_command_is_a_cosine_of_the_angle(shape: str) -> None:
    t = np.arange(0, 100_000, 200)
    command = {
        "sine": 3.0 * np.sin(4e-4 * t),
        "two sines": np.sin(2.1e-4 * t) + 0.4 * np.sin(7e-4 * t),
        "triangle": 2.0 * np.abs((t / 9000.0) % 2.0 - 1.0) - 1.0,
        "damped": np.exp(-1e-5 * t) * np.cos(5e-4 * t),
        "pausing": np.clip(1.5 * np.sin(4e-4 * t), -1.0, 1.0),
    }[shape]
    encoder = amiwarp.Encoder.from_command(t, command)
    between = np.arange(0, 99_000, 37)
    largest = np.abs(command).max()
    found = largest * np.cos(encoder.angle_at(between))
    off = np.abs(found - np.interp(between, t, command)) / largest
    assert np.quantile(off, 0.98) < 0.01
    assert off.max() < 0.03
    assert (np.diff(encoder.angle) >= 0.0).all()
    assert encoder.rpm > 0.0


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (np.ones(50), "never changes"),
        (np.r_[np.arange(49.0), np.nan], "not finite"),
        (np.ones(3), "one value for each"),
    ],
)
def test_unusable_commands_are_refused(command: np.ndarray, said: str) -> None:
    with pytest.raises(amiwarp.AmiwarpError, match=said):
        amiwarp.Encoder.from_command(np.arange(50) * 1000, command)


def test_recorded_commands_compensate_as_the_angles_do(recording: amiwarp.Recording) -> None:
    """The commands of a sine are those of its angle, so that the true model compensates with them."""
    assert recording.camera is not None
    model, t = MIRROR.model(recording.camera), np.arange(-2000, 204_000, 250)
    angles = MIRROR.motion.angles(t) + np.array(MIRROR.phase)
    first, second = (amiwarp.Encoder.from_command(t, 5.0 * np.cos(angle)) for angle in angles.T)
    at_zero = amiwarp.MirrorModel.from_values(recording.camera, NO_PRISM, MIRROR.parameters() | {
        "phase": 0.0, "second_phase": 0.0})  # fmt: skip
    events = recording.events.slice(0, 5000)
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    found = at_zero.compensate_points(xy, first.with_second(second).angles_at(events.t))
    expected = model.compensate_points(xy, MIRROR.motion.angles(events.t))
    assert np.abs(found - expected).max() < 0.02  # px


# The command line.


@pytest.mark.slow
def test_programs(tmp_path: Path, texture: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(texture).save(tmp_path / "p.png")
    out, runner = tmp_path / "m.h5", CliRunner()
    options = ["--size", "96x72", "--duration", "0.1", "--optic", "mirror", "--mirror-hz", "70,90"]
    made = runner.invoke(app, ["simulate", str(out), "--picture", str(tmp_path / "p.png"), *options,
                               "--mirror-deg", "0.9,0.7", "--fold-deg", "90", "--incidence-deg", "40"])  # fmt: skip
    assert made.exit_code == 0, made.output
    truth = json.loads(runner.invoke(app, ["info", str(out), "--json"]).stdout)["truth"]
    assert (truth["second_amplitude_deg"], truth["fold_deg"]) == (
        pytest.approx(0.7),
        pytest.approx(90.0),
    )
    file = tmp_path / "c.json"
    given = ["calibrate", str(out), str(file), "--start", "fold=90deg", "--stages", "sharpness"]
    found = runner.invoke(app, given)  # the file names its optic
    assert found.exit_code == 0, found.output
    saved = json.loads(file.read_text())
    assert saved["model"] == "mirror"
    assert saved["parameters"]["amplitude"]["degrees"] == pytest.approx(0.9, rel=0.05)
    for command in (
        ["compensate", str(out), str(tmp_path / "o.h5")],
        ["reconstruct", str(out), str(tmp_path / "o.png")],
    ):
        done = runner.invoke(app, [*command, "--calibration", str(file)])
        assert done.exit_code == 0, done.output
    wrong = runner.invoke(
        app,
        ["simulate", str(out), "--picture", str(tmp_path / "p.png"), "--fold-deg", "9", "--force"],
    )
    assert wrong.exit_code == 1
    assert "--fold-deg applies to a mirror" in wrong.stderr
    again = runner.invoke(app, ["record", str(out), str(tmp_path / "again.h5"), "--fast"])
    assert again.exit_code == 0, again.output
    assert best_model(amiwarp.open_recording(tmp_path / "again.h5")) == "mirror"
