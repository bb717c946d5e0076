"""The vibrating camera: its model against a float64 oracle, its simulation, its calibration and its refusals."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import amiwarp
from amiwarp.calib.photometric import consistency
from amiwarp.calib.photometric.causes import THIRD, SuspectedError, without_doubtful_harmonic
from amiwarp.results import make_space
from reference import optics as reference
from tests.command_line import app
from tests.conftest import COARSE

VALUES = {
    "amplitude": 0.012, "phase": 0.7, "backward_x": 0.005, "backward_y": -0.003, "roll_x": 0.002, "roll_y": 0.004,
    "second_x": 0.001, "second_y": -0.002, "second_backward_x": 0.0007, "second_backward_y": 0.0004,
    "third_x": -0.0008, "third_y": 0.0011, "third_backward_x": -0.0005, "third_backward_y": 0.0009,
}  # fmt: skip
"""Every part of a vibration: 3 px of the first harmonic, 0.5 px of the second, 0.3 px of the third."""
NO_PRISM = amiwarp.Prism(0.0)


@pytest.mark.parametrize("scale", [1.0, 8.0])
def test_device_functions_agree_with_float64(device: str, scale: float) -> None:
    import warp as wp

    values = {name: x if name == "phase" else scale * x for name, x in VALUES.items()}
    distortion = amiwarp.RadialTangential(k1=-0.1, k2=0.02)
    camera = amiwarp.Camera(320, 240, 280.0, 275.0, 161.0, 118.0, distortion)
    rng = np.random.default_rng(1)
    xy, theta = rng.uniform((0, 0), (319, 239), (2000, 2)), rng.uniform(-9, 9, 2000)
    model = amiwarp.VibrationModel.from_values(camera, NO_PRISM, values)
    points = wp.array(xy.astype(np.float32), dtype=wp.vec2, device=device)
    angles = wp.array(theta.astype(np.float32), dtype=float, device=device)
    turned = reference.vibration(values, theta)
    # Px; float32 angles up to 9 rad
    tolerance = {
        "rtol": 0.0,
        "atol": 2e-3 if scale == 1.0 else 6e-3,
    }
    expected = reference.turned(camera, turned, xy)
    assert np.linalg.norm(expected - xy, axis=1).max() > 3.0 * scale
    np.testing.assert_allclose(
        model.compensate_points(points, angles).numpy(), expected, **tolerance
    )
    expected = reference.turned(camera, turned.inv(), xy)
    np.testing.assert_allclose(model.deflect_points(points, angles).numpy(), expected, **tolerance)


def test_deflection_is_the_inverse() -> None:
    camera = amiwarp.Camera.from_fov(640, 480, 1.2)
    rng = np.random.default_rng(2)
    xy, theta = rng.uniform((0, 0), (639, 479), (2000, 2)), rng.uniform(-math.pi, math.pi, 2000)
    model = amiwarp.VibrationModel.from_values(camera, NO_PRISM, VALUES)
    there = model.compensate_points(xy, theta)
    np.testing.assert_allclose(model.deflect_points(there, theta), xy, rtol=0, atol=1e-3)  # px


def test_the_same_motion_by_the_opposite_angle() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    rng = np.random.default_rng(3)
    xy, theta = rng.uniform((0, 0), (319, 239), (500, 2)), rng.uniform(-math.pi, math.pi, 500)
    model = amiwarp.VibrationModel.from_values(camera, NO_PRISM, VALUES)
    other = amiwarp.VibrationModel.from_values(
        camera, NO_PRISM, amiwarp.VibrationModel.reversed_values(VALUES)
    )
    assert other.amplitude == pytest.approx(math.hypot(VALUES["backward_x"], VALUES["backward_y"]))
    np.testing.assert_allclose(
        other.compensate_points(xy, -theta), model.compensate_points(xy, theta), rtol=0, atol=1e-3
    )
    assert amiwarp.ExactModel.reversed_values({"apex": 0.03, "phase": 0.1}) is None


def test_the_same_motion_at_angles_that_are_larger_by_a_constant() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    rng = np.random.default_rng(3)
    xy, theta = rng.uniform((0, 0), (319, 239), (500, 2)), rng.uniform(-math.pi, math.pi, 500)
    model = amiwarp.VibrationModel.from_values(camera, NO_PRISM, VALUES)
    other = amiwarp.VibrationModel.from_values(
        camera, NO_PRISM, amiwarp.VibrationModel.turned_values(VALUES, 0.9)
    )
    np.testing.assert_allclose(
        other.compensate_points(xy, theta),
        model.compensate_points(xy, theta + 0.9),
        rtol=0,
        atol=1e-3,
    )


def test_a_still_vibration_moves_nothing() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    values = amiwarp.VibrationModel.still_values(VALUES)
    model = amiwarp.VibrationModel.from_values(camera, NO_PRISM, values)
    xy = np.array([[0.0, 0.0], [200.0, 100.0]])
    np.testing.assert_allclose(
        model.compensate_points(xy, np.array([0.3, 2.0])), xy, rtol=0, atol=1e-4
    )
    assert values["phase"] == VALUES["phase"]


def test_amplitudes_in_degrees_are_refused() -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    with pytest.raises(amiwarp.AmiwarpError, match=r"amplitude .* is it given in degrees"):
        amiwarp.VibrationModel(camera, 0.4)
    with pytest.raises(amiwarp.AmiwarpError, match="backward"):
        amiwarp.VibrationModel(camera, 0.1, backward=(0.0, 0.5))


# Simulation.

SHAKE = amiwarp.Vibration(
    hz=90.0,
    amplitude=0.014,
    phase=0.7,
    backward=(0.006, -0.003),
    roll=(0.001, 0.002),
    second=(0.0015, -0.001),
)
"""An ellipse of up to 3.5 px in the view of ``shaken``, with roll and a second harmonic."""
BUZZ = amiwarp.Vibration(
    hz=100.0,
    amplitude=0.012,
    phase=0.7,
    backward=(0.005, -0.002),
    second=(0.0015, -0.001),
    third=(0.0008, 0.0003),
    third_backward=(0.0, -0.0006),
)
"""An ellipse of up to 3.5 px in a view of 160 px and 43 deg, with a third harmonic of 0.2 px."""
FAST = amiwarp.SensorModel(refractory_us=0.0)


@pytest.fixture(scope="module")
def shaken(texture: np.ndarray) -> amiwarp.Recording:
    camera = amiwarp.Camera.from_fov(128, 96, math.radians(35.0))
    return amiwarp.simulate(texture, camera, SHAKE, duration_s=0.15, sensor=FAST, seed=3)


def test_simulated_events_know_their_point_at_rest(shaken: amiwarp.Recording) -> None:
    assert (shaken.prism, shaken.encoder) == (None, None)
    assert shaken.camera is not None
    assert shaken.truth is not None
    events = shaken.events.slice(0, 20_000)
    points = shaken.truth.points(0, 20_000)
    assert points is not None
    theta = SHAKE.motion.angle(events.t - 100.0)  # mean latency
    values = SHAKE.parameters()
    assert values.pop("rpm") == shaken.truth.parameters["rpm"] == 5400.0
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    away = reference.turned(shaken.camera, reference.vibration(values, theta), xy) - points
    assert np.abs(np.median(away, axis=0)).max() < 0.01  # px
    assert np.std(away) < 0.1  # px; latency jitter of 30 us at up to 2000 px/s
    assert np.std(xy - points) > 1.5


def test_a_table_gives_the_frequency_over_time() -> None:
    t = np.arange(0.0, 1e6, 1e4)
    constant = amiwarp.Vibration(90.0, 0.01, 0.7).motion.angle(t)
    table = amiwarp.Vibration([[0.0, 90.0], [1.0, 90.0]], 0.01, 0.7).motion.angle(t)
    np.testing.assert_allclose(table, constant, rtol=0, atol=1e-6)
    rising = amiwarp.Vibration([[0.0, 80.0], [1.0, 100.0]], 0.01).motion.angle([0.0, 1e6])
    assert rising[1] - rising[0] == pytest.approx(math.tau * 90.0)


def test_simulated_steps_resolve_the_vibration() -> None:
    from amiwarp.simulation.image_motion import step_us

    camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    picture = np.ones((48, 64), np.float32)

    def step(hz: float, **parts: Any) -> int:
        vibration = amiwarp.Vibration(hz, 0.03, **parts)
        return step_us(
            amiwarp.Simulation(amiwarp.Scene.from_picture(picture), camera, vibration, 0.1)
        )

    assert step(20.0) > 3 * step(100.0) > 6 * step(300.0)
    assert step(100.0, second=(0.02, 0.0)) < 0.8 * step(100.0)


def test_a_world_is_seen_by_a_vibrating_camera() -> None:
    square = amiwarp.Mesh([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], [[0, 1, 2], [0, 2, 3]])
    world = amiwarp.World(
        "example", (amiwarp.Body("wall", square, amiwarp.Material(reflectance=0.8)),)
    )
    way = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    camera = amiwarp.Camera.from_fov(64, 48, 1.4)
    vibration = amiwarp.Vibration(100.0, 0.05, backward=(0.05, 0.0))  # a line: rotation about x

    def view(seeing: str) -> amiwarp.Recording:
        scene = amiwarp.WorldScene(world, way, seeing=seeing)
        quiet = amiwarp.SensorModel.ideal()
        return amiwarp.Simulation(scene, camera, vibration, 0.02, sensor=quiet).run(
            truth_times_us=[0]
        )

    for seeing in ("maps", "rays"):
        recording = view(seeing)
        assert recording.truth is not None
        points = recording.truth.points(0, len(recording.events))
        assert points is not None
        rows = np.abs(points[:, 1] - 23.5)  # horizontal edges of the square, at rest
        assert len(rows) > 500
        assert np.mean(np.abs(rows - np.median(rows)) < 1.0) > 0.9
        assert np.std(recording.events.slice(0, len(rows)).y - points[:, 1]) > 2.0
        frame = next(iter(recording.truth.frames or ()))
        assert np.abs(frame.depth[24, 32] - 2.0) < 0.01
        assert np.nanmax(np.abs(frame.flow)) == 0.0  # px/s, at rest
        assert np.nanmax(np.abs(frame.flow_with_prism[24, 32])) < 1.0  # at its turning point


# Calibration.


def distance(found: amiwarp.Calibration, shake: amiwarp.Vibration) -> float:
    """Return the distance of the calibrated and the true motion over the image [px rms]."""
    values = shake.parameters()
    if found.parameters["rpm"] < 0.0:
        values = amiwarp.VibrationModel.reversed_values(values)
    true = amiwarp.VibrationModel.from_values(found.camera, NO_PRISM, values)
    return amiwarp.predicted_error(found.model, true, remove_lag=True).rms


PROMPT = amiwarp.PhotometricSettings(pairs=25_000, sensor=amiwarp.SensorTiming(refractory_us=0.0))


@pytest.fixture(scope="module")
def calibrated(shaken: amiwarp.Recording) -> amiwarp.Calibration:
    return amiwarp.calibrate(shaken, model="vibration", events=50_000, photometric=PROMPT)


@pytest.mark.slow
def test_an_unknown_refractory_period_is_refused_with_the_remedy(shaken: amiwarp.Recording) -> None:
    with pytest.raises(
        amiwarp.AmiwarpError, match=r"within 0\.0\d+ px only.*give it by --refractory-us"
    ):
        amiwarp.calibrate(
            shaken, model="vibration", events=25_000, photometric=replace(COARSE, pairs=10_000)
        )


def test_it_is_calibrated_without_start_values(calibrated: amiwarp.Calibration) -> None:
    assert distance(calibrated, SHAKE) < 0.02  # px
    assert calibrated.parameters["rpm"] == pytest.approx(5400.0, rel=1e-4)
    assert (
        set(calibrated.free)
        == {*amiwarp.VibrationModel.FREED, "rpm"}
        == set(calibrated.uncertainty)
    )


def test_a_third_harmonic_is_looked_for_unless_it_is_given() -> None:
    camera = amiwarp.Camera.from_fov(128, 96, 1.0)

    def causes_with(free: tuple[str, ...] | None = None, **start: float) -> list[SuspectedError]:
        space = make_space("vibration", camera, NO_PRISM, free=free, start=start, bounds={}, rad_per_us=1e-3,
                           duration_us=1e5)  # fmt: skip
        return consistency.testable(space)

    assert THIRD in causes_with()
    assert THIRD not in causes_with(third_x=0.0)
    assert THIRD not in causes_with((*amiwarp.VibrationModel.FREED, *THIRD.names))


def test_a_harmonic_that_may_be_none_is_left_out() -> None:
    values = {"amplitude": 0.01, "third_x": 8e-5, "third_y": 2e-5}
    certain = {"amplitude": 1e-5, "third_x": 2e-5, "third_y": 2e-5}
    assert without_doubtful_harmonic(values, certain) == {}
    assert without_doubtful_harmonic(values, {**certain, "third_x": 3e-5}) == {
        "third_x": 0.0,
        "third_y": 0.0,
    }
    assert without_doubtful_harmonic(values, {"amplitude": 1e-5}) == {}


@pytest.mark.slow
def test_a_third_harmonic_is_found_where_there_is_one() -> None:
    from pyvista.examples import mapfile

    camera = amiwarp.Camera.from_fov(160, 120, math.radians(43.0))
    recording = amiwarp.simulate(mapfile, camera, BUZZ, duration_s=0.15, seed=3)
    settings = amiwarp.PhotometricSettings(
        pairs=100_000, sensor=amiwarp.SensorTiming(refractory_us=100.0)
    )
    found = amiwarp.calibrate(recording, model="vibration", photometric=settings)
    assert distance(found, BUZZ) < 0.02  # px
    assert abs(abs(found.parameters["rpm"]) - 6000.0) < 3.0 * found.uncertainty["rpm"]
    assert {*THIRD.names} <= {*found.free}


def test_the_file_has_no_prism(
    calibrated: amiwarp.Calibration, shaken: amiwarp.Recording, tmp_path: Path
) -> None:
    calibrated.save(tmp_path / "c.json")
    data = json.loads((tmp_path / "c.json").read_text())
    assert data["prism"] is None
    assert data["parameters"]["rpm"]["hz"] == pytest.approx(90.0, rel=1e-4)
    loaded = amiwarp.Calibration.load(tmp_path / "c.json")
    assert (loaded.model, loaded.zero_us) == (calibrated.model, calibrated.zero_us)
    amiwarp.compensate(shaken, loaded, tmp_path / "out.h5")
    out = amiwarp.open_recording(tmp_path / "out.h5").events.slice(0, 20_000)
    points = shaken.truth.points(0, 20_000) if shaken.truth is not None else None
    assert points is not None
    away = np.stack([out.x, out.y], axis=1) - points
    assert np.std(away) < 0.12  # px


def test_the_larger_circle_is_the_forward_one(texture: np.ndarray) -> None:
    camera = amiwarp.Camera.from_fov(160, 120, math.radians(40.0))
    shake = amiwarp.Vibration(hz=150.0, amplitude=0.004, backward=(0.0, 0.015))
    recording = amiwarp.simulate(texture, camera, shake, duration_s=0.1, sensor=FAST, seed=1)
    found = amiwarp.calibrate(recording, model="vibration", stages=("sharpness",), events=60_000)
    assert found.parameters["rpm"] == pytest.approx(-9000.0, rel=1e-4)
    assert found.parameters["amplitude"] == pytest.approx(0.015, rel=0.05)
    assert distance(found, shake) < 0.15  # px


@pytest.mark.parametrize(
    ("rates", "said"),
    [
        ((0.0, 0.0, 0.0), "the vibration's speed cannot be estimated"),
        ((0.3, 0.2, 0.5), "no motion of a vibration"),
    ],
)
def test_a_camera_without_vibration_is_refused(
    texture: np.ndarray, rates: tuple[float, float, float], said: str
) -> None:
    camera = amiwarp.Camera.from_fov(160, 120, math.radians(40.0))
    recording = amiwarp.Simulation(
        amiwarp.Scene.from_picture(texture), camera, NO_PRISM, 0.2, camera_motion=amiwarp.CameraMotion(rates)
    ).without_prism().run()  # fmt: skip
    with pytest.raises(amiwarp.AmiwarpError, match=said):
        amiwarp.calibrate(recording, model="vibration")


# The command line.


def test_programs(tmp_path: Path, texture: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(texture).save(tmp_path / "p.png")
    out, runner = tmp_path / "v.h5", CliRunner()
    options = [
        "--size",
        "96x72",
        "--duration",
        "0.1",
        "--optic",
        "vibration",
        "--hz",
        "80",
        "--amplitude-deg",
        "0.8",
    ]
    given = ["simulate", str(out), "--picture", str(tmp_path / "p.png"), *options]
    made = runner.invoke(
        app, [*given, "--backward-deg", "0.3,0.1", "--second-deg", "0.05,0,0,0.02"]
    )
    assert made.exit_code == 0, made.output
    truth = json.loads(runner.invoke(app, ["info", str(out), "--json"]).stdout)["truth"]
    assert (truth["rpm"], truth["backward_y_deg"]) == (4800.0, pytest.approx(0.1))
    assert "amplitude_deg 0.8" in runner.invoke(app, ["info", str(out)]).stdout
    file = tmp_path / "c.json"
    # Of the file's optic
    found = runner.invoke(app, ["calibrate", str(out), str(file), "--stages", "sharpness"])
    assert found.exit_code == 0, found.output
    said = re.search(r"^frequency: ([\d.]+) ± (\S+) Hz$", found.stdout, re.MULTILINE)
    assert said is not None
    rpm = json.loads(file.read_text())["parameters"]["rpm"]
    assert float(said[1]) == pytest.approx(rpm["hz"], rel=1e-6) == pytest.approx(80.0, rel=1e-3)
    assert float(said[2]) == pytest.approx(rpm["std"] / 60.0, rel=0.05)
    for command in (
        ["compensate", str(out), str(tmp_path / "o.h5")],
        ["reconstruct", str(out), str(tmp_path / "o.png")],
    ):
        done = runner.invoke(app, [*command, "--calibration", str(file)])
        assert done.exit_code == 0, done.output
    wrong = runner.invoke(
        app, ["simulate", str(out), "--picture", str(tmp_path / "p.png"), "--hz", "80", "--force"]
    )
    assert wrong.exit_code == 1
    assert "--hz applies to a vibration" in wrong.stderr
