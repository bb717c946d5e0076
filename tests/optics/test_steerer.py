"""The beam steerer: its model against a float64 formula, simulation, calibration, compensation of steps, commands."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import amiwarp
from amiwarp.results import best_model
from reference import optics as reference
from tests.command_line import app

VALUES = {
    "amplitude": 0.022, "phase": 0.7, "second_amplitude": 0.017, "second_phase": -1.1, "direction": 0.2,
    "second_direction": 1.7,
}  # fmt: skip
NO_PRISM = amiwarp.Prism(0.0)
PROMPT = amiwarp.SensorModel(refractory_us=0.0, latency_us=0.0, latency_jitter_us=0.0)
"""A sensor that keeps up with a fast beam steerer."""
STEERER = amiwarp.Steerer(
    hz=(200.0, -247.0),
    amplitude=(0.026, 0.021),
    phase=(0.7, -1.2),
    direction=(-0.3, 1.3),
)
"""Up to 5 px in the view of ``recording``."""


@pytest.mark.parametrize("scale", [1.0, 8.0])
def test_device_functions_agree_with_float64(device: str, scale: float) -> None:
    import warp as wp

    values = {name: scale * x if "amplitude" in name else x for name, x in VALUES.items()}
    lens = amiwarp.RadialTangential(k1=-0.1, k2=0.02)
    camera = amiwarp.Camera(320, 240, 280.0, 275.0, 161.0, 118.0, lens)
    rng = np.random.default_rng(1)
    xy = rng.uniform((0, 0), (319, 239), (2000, 2))
    theta = rng.uniform(-9, 9, (2000, 2))
    model = amiwarp.SteererModel.from_values(camera, NO_PRISM, values)
    points = wp.array(xy.astype(np.float32), dtype=wp.vec2, device=device)
    angles = wp.array(theta.astype(np.float32), dtype=float, device=device)

    expected = reference.steered(camera, values, xy, theta, to_scene=True)
    assert np.nanmax(np.linalg.norm(expected - xy, axis=1)) > 8.0 * scale
    inside = np.isfinite(expected).all(axis=1) & (np.abs(expected) < 600.0).all(axis=1)
    assert inside.mean() > 0.9
    found = model.compensate_points(points, angles)
    np.testing.assert_allclose(found.numpy()[inside], expected[inside], rtol=0, atol=2e-3)  # px
    back = model.deflect_points(found, angles).numpy()
    np.testing.assert_allclose(back[inside], xy[inside], rtol=0, atol=2e-3)

    seen = reference.steered(camera, values, xy, theta, to_scene=False)
    near = np.isfinite(seen).all(axis=1) & (np.abs(seen) < 600.0).all(axis=1)
    deflected = model.deflect_points(points, angles).numpy()
    np.testing.assert_allclose(deflected[near], seen[near], rtol=0, atol=2e-3)


def test_a_ray_that_would_leave_the_half_space_is_invalid() -> None:
    """A unit direction has no component over 1, so that a phase gradient cannot bend a steep ray further."""
    camera = amiwarp.Camera(201, 3, 20.0, 20.0, 100.0, 1.0)  # up to 79 deg from the axis
    model = amiwarp.SteererModel(camera, amplitude=0.1)
    xy = np.array([[0.0, 1.0], [200.0, 1.0]])
    found = model.compensate_points(xy, np.zeros((2, 2)))
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()
    observed = model.deflect_points(xy, np.zeros((2, 2)))
    assert np.isfinite(observed[0]).all()
    assert np.isnan(observed[1]).all()


def test_the_amplitude_is_the_deflection_at_the_middle_of_the_image() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    middle = np.array([[camera.cx, camera.cy]])
    for direction in (0.0, 1.1):
        model = amiwarp.SteererModel(camera, amplitude=0.03, direction=direction)
        moved = model.deflect_points(middle, np.zeros((1, 2))) - middle
        along = camera.fx * math.tan(0.03) * np.array([[math.cos(direction), math.sin(direction)]])
        np.testing.assert_allclose(moved, along, rtol=0, atol=1e-3)  # px


def test_each_deflector_moves_points_by_its_own_angle() -> None:
    camera, theta = amiwarp.Camera.from_fov(320, 240, 1.0), np.linspace(0.0, 3.0, 50)
    xy = np.tile([[100.0, 50.0]], (50, 1))
    model = amiwarp.SteererModel.from_values(camera, NO_PRISM, VALUES | {"ratio": -1.25})
    both = np.stack([theta, -1.25 * theta], axis=1)
    np.testing.assert_allclose(
        model.compensate_points(xy, theta), model.compensate_points(xy, both), rtol=0, atol=1e-4
    )
    for single, resting, place in zip(
        model.singles(), ("second_amplitude", "amplitude"), (0, 1), strict=True
    ):
        other = VALUES | {resting: 0.0}
        angles = np.full((50, 2), 0.7)
        angles[:, place] = theta
        expected = reference.steered(camera, other, xy, angles, to_scene=True)
        found = single.compensate_points(xy, theta)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)  # px


def test_directions_are_free_unless_both_have_one_frequency() -> None:
    directions = {"direction", "second_direction"}
    for ratio in (None, 0.8, -1.25, 0.0):
        assert directions < {*amiwarp.SteererModel.freed(ratio)}
    for ratio in (1.0, -1.0, -1.0005):
        freed = {*amiwarp.SteererModel.freed(ratio)}
        assert {*amiwarp.SteererModel.FREED} - freed == directions


def test_a_deflector_is_searched_up_to_a_displacement_of_24_px() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    middle = np.array([[camera.cx, camera.cy]])
    for name in ("amplitude", "second_amplitude"):
        low, high = amiwarp.SteererModel.default_bounds(name, 0.01, camera, NO_PRISM)
        assert low == 0.0
        model = amiwarp.SteererModel(camera, **({"amplitude": 0.0} | {name: high}))
        away = model.compensate_points(middle, np.zeros((1, 2))) - middle
        assert np.linalg.norm(away) == pytest.approx(24.0, rel=0.01)  # px


def test_unusable_values_are_refused() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    with pytest.raises(amiwarp.AmiwarpError, match=r"amplitude .* is it given in degrees"):
        amiwarp.SteererModel(camera, 0.5)
    with pytest.raises(amiwarp.AmiwarpError, match="steerer hz"):
        amiwarp.Steerer((5000.0, math.nan), (0.01, 0.01))
    with pytest.raises(amiwarp.AmiwarpError, match=r"both commands, shape \(n, 2\)"):
        amiwarp.SteererModel(camera, 0.01).added(np.zeros(3))


# Simulation.


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> amiwarp.Recording:
    camera = amiwarp.Camera.from_fov(96, 72, math.radians(35.0))
    return amiwarp.simulate(texture, camera, STEERER, duration_s=0.1, sensor=PROMPT, seed=3)


def test_simulated_events_know_their_point_at_rest(recording: amiwarp.Recording) -> None:
    assert recording.prism is None
    assert recording.metadata["optic"] == "steerer"
    assert best_model(recording) == "steerer"
    camera, truth = recording.camera, recording.truth
    assert camera is not None
    assert truth is not None
    events = recording.events.slice(0, 20_000)
    points = truth.points(0, 20_000)
    assert points is not None
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    angles = STEERER.motion.angles(events.t)
    expected = reference.steered(camera, STEERER.parameters(), xy, angles, to_scene=True)
    away = expected - points
    assert np.abs(np.median(away, axis=0)).max() < 0.01  # px
    assert np.std(away) < 0.03  # px: times in microseconds
    assert np.std(xy - points) > 1.5
    assert {name: truth.parameters[name] for name in STEERER.parameters()} == STEERER.parameters()


def sharpness_of(places: np.ndarray, width: int, height: int) -> float:
    """Return the share of fine detail in the image of events at places [px]: the sharper, the larger."""
    image, *_ = np.histogram2d(
        places[:, 1], places[:, 0], bins=(2 * height, 2 * width), range=((0, height), (0, width))
    )
    return float(image.var() / image.mean())


def test_events_gather_on_edges_where_the_formula_puts_them(recording: amiwarp.Recording) -> None:
    """The events come from brightness, and not from the formula for their points."""
    camera = recording.camera
    assert camera is not None
    events = recording.events.slice(0, 300_000)  # four periods
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    angles = STEERER.motion.angles(events.t)

    def sharpness(**changes: float) -> float:
        values = STEERER.parameters() | changes
        places = reference.steered(camera, values, xy, angles, to_scene=True)
        return sharpness_of(places[np.isfinite(places).all(axis=1)], camera.width, camera.height)

    true = STEERER.parameters()
    best = sharpness()
    for name, step in (("amplitude", 0.003), ("second_amplitude", 0.003), ("phase", 0.1), ("second_phase", 0.1),
                       ("direction", 0.1), ("second_direction", 0.1)):  # fmt: skip
        for change in (-step, step):
            assert sharpness(**{name: true[name] + change}) < best


@pytest.mark.parametrize("seeing", ["maps", "rays"])
def test_a_world_is_seen_through_it(seeing: str) -> None:
    """Events have their place at rest on the edges of a square, and their surfaces are those at this place."""
    corners = [[-0.6, 2, -0.5], [0.4, 2, -0.5], [0.4, 2, 0.5], [-0.6, 2, 0.5]]
    square = amiwarp.Mesh(corners, [[0, 1, 2], [0, 2, 3]])
    material = amiwarp.Material(reflectance=0.8)
    world = amiwarp.World("example", (amiwarp.Body("wall", square, material),))
    way = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    camera = amiwarp.Camera.from_fov(64, 48, 1.4)
    steerer = amiwarp.Steerer((100.0, 130.0), (0.06, 0.06))
    scene = amiwarp.WorldScene(world, way, seeing=seeing)
    sensor = amiwarp.SensorModel.ideal()
    simulation = amiwarp.Simulation(scene, camera, steerer, 0.02, sensor=sensor)
    made = simulation.run(truth_times_us=[0, 10_000])
    truth = made.truth
    assert truth is not None
    points = truth.points(0, len(made.events))
    assert points is not None
    upright = 31.5 + camera.fx * np.array([-0.3, 0.2])  # edges at rest [px]
    level = np.abs(points[:, 1] - 23.5) < 6.0
    nearest = np.abs(points[level, :1] - upright).min(axis=1)
    assert level.sum() > 200
    assert np.mean(nearest < 1.0) > 0.9
    recorded = made.events.slice(0, len(points))
    assert np.std(recorded.x[level] - points[level, 0]) > 1.0

    # What the camera sees through it at rest of the scene is what it sees without it where the model says.
    at = next(iter(truth.frames or ()))
    angles = np.zeros((1, 2)) + np.array(steerer.motion.angles([0.0]))
    edge = np.array([[upright[0], 23.5]])
    seen = steerer.model(camera).deflect_points(edge, angles)[0]
    row = at.intensity_with_prism[round(float(seen[1]))]
    jump = int(np.argmax(np.abs(np.diff(row[:32])))) + 0.5
    assert jump == pytest.approx(seen[0], abs=1.0)  # px
    assert len(simulation.without_prism().run().events) == 0


# Calibration.

FEW = amiwarp.PhotometricSettings(pairs=25_000, sensor=amiwarp.SensorTiming(0.0, 0.0))
"""The sensor's timing is given, because the image moves too fast for the events to tell it."""


def distance(found: amiwarp.Calibration, steerer: amiwarp.Steerer) -> float:
    """Return the distance of the calibrated and the true motion over the image and both angles [px rms]."""
    camera = found.camera
    at = [
        np.linspace(0, camera.width - 1, 6),
        np.linspace(0, camera.height - 1, 5),
        *[np.arange(8) * math.pi / 4] * 2,
    ]
    grid = np.stack(np.meshgrid(*at), axis=-1).reshape(-1, 4)
    moved = found.model.compensate_points(grid[:, :2], grid[:, 2:])
    values = steerer.parameters()
    expected = reference.steered(camera, values, grid[:, :2], grid[:, 2:], to_scene=True)
    return float(np.sqrt(np.mean(np.sum((moved - expected) ** 2, axis=1))))


@pytest.fixture(scope="module")
def calibrated(recording: amiwarp.Recording) -> amiwarp.Calibration:
    return amiwarp.calibrate(recording, events=30_000, photometric=FEW)


def test_it_is_calibrated_without_start_values(calibrated: amiwarp.Calibration) -> None:
    assert calibrated.model_name == "steerer"
    assert distance(calibrated, STEERER) < 0.02  # px
    true = STEERER.parameters()
    for name in ("amplitude", "second_amplitude", "direction", "second_direction"):
        assert abs(calibrated.parameters[name] - true[name]) < 6.0 * calibrated.uncertainty[name]
    assert set(calibrated.free) == set(amiwarp.SteererModel.FREED) == set(calibrated.uncertainty)


def test_it_is_calibrated_at_5_khz(texture: np.ndarray) -> None:
    camera = amiwarp.Camera.from_fov(64, 48, math.radians(35.0))
    fast = amiwarp.Steerer(
        hz=(5000.0, -6100.0),
        amplitude=(0.026, 0.021),
        phase=(0.7, -1.2),
        direction=(-0.3, 1.3),
    )
    known = amiwarp.EncoderModel.ideal()  # the program that sends the commands knows them
    shown = amiwarp.simulate(
        texture, camera, fast, duration_s=0.01, sensor=PROMPT, encoder=known, seed=3
    )
    found = amiwarp.calibrate(shown, events=30_000, photometric=FEW)
    assert distance(found, fast) < 0.02  # px


def test_a_file_keeps_it(
    calibrated: amiwarp.Calibration, recording: amiwarp.Recording, tmp_path: Path
) -> None:
    calibrated.save(tmp_path / "c.json")
    assert json.loads((tmp_path / "c.json").read_text())["prism"] is None
    loaded = amiwarp.Calibration.load(tmp_path / "c.json")
    assert loaded.model == calibrated.model
    first_part = amiwarp.MemoryEvents(recording.events.slice(0, 20_000), *recording.events.size)
    amiwarp.save_recording(tmp_path / "r.h5", replace(recording, events=first_part, truth=None))
    stored = amiwarp.open_recording(tmp_path / "r.h5")
    assert best_model(stored) == "steerer"
    amiwarp.compensate(stored, loaded, tmp_path / "out.h5")
    out = amiwarp.open_recording(tmp_path / "out.h5").events.slice(0, 20_000)
    points = recording.truth.points(0, 20_000) if recording.truth is not None else None
    assert points is not None
    away = np.stack([out.x, out.y], axis=1) - points
    assert np.std(away) < 0.03  # px


# Steps.

STEP_US = 25
"""Length of a step: eight of them are a period at 5 kHz."""


def staircase(t: np.ndarray, command: int) -> np.ndarray:
    """Return one of two commands at times [us]: up and down in 8 steps, then 8 levels in any order."""
    up_and_down = np.array([-1.0, -0.5, 0.0, 0.5, 1.0, 0.5, 0.0, -0.5])
    any_order = np.linspace(-1.0, 1.0, 8)[np.random.default_rng(command).integers(0, 8, 600)]
    levels = np.concatenate([np.roll(np.tile(up_and_down, 25), 3 * command), any_order])
    return np.asarray(levels[t // STEP_US])


@pytest.mark.parametrize(("sampling_us", "edge_us"), [(5, 5), (1, 1)])
def test_steps_are_compensated_but_for_events_within_an_edge(
    sampling_us: int, edge_us: int
) -> None:
    """Between two samples the angle of a command changes evenly, so that only events there are between two steps."""
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    values = VALUES | {"phase": 0.0, "second_phase": 0.0}
    model = amiwarp.SteererModel.from_values(camera, NO_PRISM, values)
    samples = np.arange(0, 20_000, sampling_us)
    first, second = (
        amiwarp.Encoder.from_command(samples, staircase(samples, k), largest=1.0) for k in (0, 1)
    )

    rng = np.random.default_rng(5)
    t = np.sort(rng.integers(200, 19_800, 5000))
    xy = rng.integers((20, 20), (300, 220), (5000, 2))
    events = amiwarp.Events.from_arrays(*xy.T, t, np.ones(5000))
    found = amiwarp.compensate_events(events, model, first.with_second(second))
    both = np.arccos(np.stack([staircase(t, k) for k in (0, 1)], axis=1))
    expected = reference.steered(camera, values, xy.astype(np.float64), both, to_scene=True)
    away = np.linalg.norm(found - expected, axis=1)

    until_edge = STEP_US - t % STEP_US
    steady = until_edge >= edge_us  # up to the last sample before an edge
    assert away[steady].max() < 0.01  # px
    assert steady.mean() > 0.75
    if edge_us > 1:
        assert np.median(away[~steady]) > 1.0  # px: this is what edges cost


def test_an_edge_of_two_samples_lasts_a_microsecond() -> None:
    """As a driver knows its steps: one sample at the end of each step, and one at the start of the next."""
    starts = np.arange(0, 20_000, STEP_US)
    edges = np.sort(np.concatenate([starts, starts[1:] - 1]))
    encoder = amiwarp.Encoder.from_command(edges, staircase(edges, 1), largest=1.0)
    t = np.arange(200, 19_800)
    np.testing.assert_allclose(np.cos(encoder.angle_at(t)), staircase(t, 1), rtol=0, atol=1e-9)


def test_a_stream_of_steps_is_what_the_recording_of_them_is() -> None:
    starts = np.arange(0, 20_000, STEP_US)
    edges = np.sort(np.concatenate([starts, starts[1:] - 1]))
    command = staircase(edges, 1)
    stream = amiwarp.EncoderStream()
    for part in np.array_split(np.arange(len(edges)), 37):
        stream.append_command(edges[part], command[part], largest=1.0)
    t = np.arange(200, 19_000)
    angles = stream.over(200, 19_000).angle_at(t)
    np.testing.assert_allclose(np.cos(angles), staircase(t, 1), rtol=0, atol=1e-9)


# The command line.


@pytest.mark.slow
def test_programs(tmp_path: Path, texture: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(texture).save(tmp_path / "p.png")
    out, runner = tmp_path / "s.h5", CliRunner()
    options = ["--size", "96x72", "--duration", "0.05", "--optic", "steerer", "--ideal"]
    given = ["--steerer-hz", "210,290", "--steerer-deg", "1.5,1.2"]
    turned = ["--steerer-phase-deg", "10,20", "--steerer-direction-deg", "-20,80"]
    picture = ["--picture", str(tmp_path / "p.png")]
    made = runner.invoke(app, ["simulate", str(out), *picture, *options, *given, *turned])
    assert made.exit_code == 0, made.output
    truth = json.loads(runner.invoke(app, ["info", str(out), "--json"]).stdout)["truth"]
    expected = {
        "amplitude": 1.5, "second_amplitude": 1.2, "phase": 10.0, "second_phase": 20.0,
        "direction": -20.0, "second_direction": 80.0,
    }  # fmt: skip
    for name, degrees in expected.items():
        assert truth[f"{name}_deg"] == pytest.approx(degrees)

    file = tmp_path / "c.json"
    found = runner.invoke(app, ["calibrate", str(out), str(file), "--stages", "sharpness"])
    assert found.exit_code == 0, found.output  # the file names its optic
    saved = json.loads(file.read_text())
    assert saved["model"] == "steerer"
    assert saved["parameters"]["amplitude"]["degrees"] == pytest.approx(1.5, rel=0.05)
    done = runner.invoke(
        app, ["compensate", str(out), str(tmp_path / "o.h5"), "--calibration", str(file)]
    )
    assert done.exit_code == 0, done.output
    shown = ["--calibration", str(file), "--screenshot", str(tmp_path / "view.png")]
    viewed = runner.invoke(app, ["view", str(out), *shown])
    assert viewed.exit_code == 0, viewed.output
    wrong = runner.invoke(app, ["simulate", str(out), *picture, "--steerer-deg", "9,9", "--force"])
    assert wrong.exit_code == 1
    assert "--steerer-deg applies to a steerer" in wrong.stderr
