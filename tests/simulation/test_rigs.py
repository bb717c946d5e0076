"""Rigs of several cameras: poses, clocks and seeds, frames, depth, and their files, against ``reference/rigs.py``."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import amiwarp
from amiwarp import AmiwarpError
from reference import rigs as oracle
from tests.command_line import app

GRAVITY = 9.80665
WALL_M = 2.0
SINE_SIDE_M = 1.0
PERIOD_M = 0.25
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def wall(y: float = WALL_M, side: float = 4.0) -> amiwarp.Mesh:
    """A square across the y axis, seen from the origin."""
    half = side / 2.0
    corners = [[-half, y, -half], [half, y, -half], [half, y, half], [-half, y, half]]
    return amiwarp.Mesh(corners, [[0, 1, 2], [0, 2, 3]], uv=[[0, 0], [1, 0], [1, 1], [0, 1]])


def sine_texture(texels: int = 256) -> NDArray[np.float32]:
    """A sine of x whose phase is 0 in the middle of the wall."""
    x = SINE_SIDE_M * ((np.arange(texels) + 0.5) / texels - 0.5)
    row = 0.5 + 0.4 * np.sin(2.0 * np.pi * x / PERIOD_M)
    return np.repeat(row[None], 16, axis=0).astype(np.float32)


def world_of(*bodies: amiwarp.Body, **light: Any) -> amiwarp.World:
    """A world that is lit evenly."""
    return amiwarp.World("test", bodies, ambient=1.0, **light)


def noise_wall(seed: int = 0) -> amiwarp.Body:
    """A wall with a texture that has events in every direction."""
    texture = np.random.default_rng(seed).uniform(0.05, 0.9, (128, 128))
    return amiwarp.Body("wall", wall(), amiwarp.Material(1.0, texture))


AHEAD = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
"""A rig at rest that looks at the wall."""
SPEED = 2.0
"""Speed of a sliding rig along x [m/s]."""


def sliding(duration_s: float = 0.1) -> amiwarp.Trajectory:
    """A rig that slides along x in front of the wall."""
    quaternion = np.asarray(AHEAD.rotation)[0]
    places = [[0.0, 0.0, 0.0], [SPEED * duration_s, 0.0, 0.0]]
    return amiwarp.Trajectory([0.0, duration_s], places, [quaternion, quaternion])


def waving() -> amiwarp.Trajectory:
    """A rig that moves and turns."""
    base = Rotation.from_quat(np.asarray(AHEAD.rotation)[0])

    def pose(t: float) -> tuple[Any, Any]:
        turn = Rotation.from_rotvec(
            [0.2 * math.sin(9 * t), 0.3 * math.sin(7 * t), 0.1 * math.cos(5 * t)]
        )
        return base * turn, (0.1 * math.sin(6 * t), 0.05 * math.cos(8 * t), 0.08 * math.sin(5 * t))

    return amiwarp.Trajectory.from_function(pose, 1.0, rate_hz=50.0)


def place_of(x: float, y: float, z: float, *turn_deg: float) -> NDArray[np.float64]:
    """A place on the rig."""
    rotation = Rotation.from_euler("xyz", turn_deg or (0.0, 0.0, 0.0), degrees=True)
    return np.column_stack([rotation.as_matrix(), (x, y, z)])


CAMERA = amiwarp.Camera.from_fov(64, 48, math.radians(40))
TELE = amiwarp.Camera.from_fov(64, 48, math.radians(5))
"""A camera whose pixels are smaller than the texels of the wall."""


def pose_at(rig: amiwarp.Rig, name: str, t: float) -> NDArray[np.float64]:
    """The pose of a camera by the oracle, 4x4."""
    (rotation,), (position,) = rig.trajectory.poses([t])
    return oracle.mounted_pose(
        oracle.homogeneous(rotation, position), np.asarray(rig.sensors[name].to_rig)
    )


def test_cameras_keep_their_places_between_the_poses_of_the_rig() -> None:
    """Cameras of a rig never move relative to each other: the composed pose is evaluated, not resampled."""
    place = place_of(0.1, -0.2, 0.3, 10, -20, 30)
    sensors = {"a": amiwarp.RigDepthCamera(CAMERA, to_rig=place)}
    rig = amiwarp.Rig(world_of(noise_wall()), waving(), sensors, 1.0)
    way = rig.trajectory_of("a")
    times = np.linspace(-0.1, 1.1, 301)
    rotations, positions = way.poses(times)
    for t, rotation, position in zip(times, rotations, positions, strict=True):
        expected = pose_at(rig, "a", t)
        np.testing.assert_allclose(rotation, expected[:3, :3], rtol=0, atol=1e-12)
        np.testing.assert_allclose(position, expected[:3, 3], rtol=0, atol=1e-12)  # m
    assert way.moves
    assert not dataclasses.replace(rig, trajectory=AHEAD).trajectory_of("a").moves


def test_the_imu_feels_the_lever_arm() -> None:
    """An IMU away from the rig's origin feels the acceleration of its own place."""
    place = place_of(0.4, 0.3, -0.5, 20, 10, -30)
    sensors = {"a": amiwarp.RigEventCamera(CAMERA, imu=amiwarp.ImuModel(), to_rig=place)}
    rig = amiwarp.Rig(world_of(noise_wall()), waving(), sensors, 1.0)
    samples = rig.simulation("a").imu_samples()
    assert samples is not None
    for k in range(20, 180, 13):  # away from the ends, where the rig stops at once
        t = 1e-6 * float(samples.t[k])
        felt = oracle.felt_acceleration(lambda t: pose_at(rig, "a", t), t, GRAVITY)
        turning = oracle.turning(lambda t: pose_at(rig, "a", t), t)
        # The third derivative of a cubic spline jumps, which a difference of 4 ms feels.
        np.testing.assert_allclose(samples.acceleration[k], felt, rtol=0, atol=0.08)  # m/s^2
        np.testing.assert_allclose(samples.angular_velocity[k], turning, rtol=0, atol=1e-4)


def small_rig(**more: Any) -> amiwarp.Rig:
    """A rig of two event cameras, one behind a wedge."""
    camera = amiwarp.Camera.from_fov(32, 24, math.radians(40))
    sensors = {
        "ami": amiwarp.RigEventCamera(camera, amiwarp.Prism(0.02)),
        "plain": amiwarp.RigEventCamera(camera, to_rig=place_of(0.06, 0, 0)),
        **more,
    }
    return amiwarp.Rig(world_of(noise_wall()), sliding(), sensors, 0.02, seed=5)


def assert_same_events(one: amiwarp.Recording, other: amiwarp.Recording) -> None:
    """Both recordings have the same events, at least one."""
    a = one.events[:]
    b = other.events[:]
    assert len(a) > 0
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_another_camera_changes_no_other_one() -> None:
    """Seeds depend on the name of a camera only."""
    before = small_rig().run()
    rig = small_rig(
        third=amiwarp.RigFrameCamera(CAMERA, electrons=1000.0),
        fourth=amiwarp.RigEventCamera(CAMERA),
    )
    after = rig.run()
    assert list(after.sensors) == ["ami", "plain", "third", "fourth"]
    for name in ("ami", "plain"):
        assert_same_events(before[name].recording, after[name].recording)
        assert_same_events(before[name].recording, rig.simulation(name).run())
    assert before["ami"].recording.encoder is not None
    assert before["plain"].recording.encoder is None
    assert before["plain"].recording.prism is None
    seeds = {rig.seed_of(name) for name in rig.sensors}
    assert len(seeds) == 4
    assert dataclasses.replace(rig, seed=6).seed_of("ami") not in seeds


@pytest.mark.parametrize("readout_us", [0, 20_000])
@pytest.mark.parametrize("mover", ["camera", "wall"])
def test_frames_are_the_mean_light_of_each_row(readout_us: int, mover: str) -> None:
    """The light of a sine on a wall, integrated over each row's exposure while the camera or the wall moves."""
    way = AHEAD
    path = None
    if mover == "camera":
        way = sliding()
    else:
        path = amiwarp.Trajectory([0.0, 0.1], [[0, 0, 0], [-SPEED * 0.1, 0, 0]], [[0, 0, 0, 1]] * 2)
    sine = amiwarp.Material(1.0, sine_texture())
    body = amiwarp.Body("wall", wall(side=SINE_SIDE_M), sine, path)
    camera = amiwarp.RigFrameCamera(
        TELE, exposure_us=10_000, readout_us=readout_us, bits=16, encoding="linear"
    )
    rig = amiwarp.Rig(world_of(body), way, {"grey": camera}, 0.1)
    frames = rig.run()["grey"].recording.frames
    assert frames is not None
    expected_times = [readout_us // 2 + 5_000 + k for k in (0, 33_333, 66_667)]
    assert frames.t.tolist() == expected_times[: 2 + (readout_us < 23_334)]
    begin_us, end_us = np.asarray(frames.exposure)[1].tolist()
    assert (begin_us + end_us) // 2 == frames.t[1]
    assert end_us - begin_us == 10_000
    rows = np.arange(48) / 47 - 0.5
    light = oracle.sine_frame(
        (np.arange(64) - TELE.cx) / TELE.fx,
        1e-6 * (begin_us + readout_us * rows),
        0.01,
        speed=SPEED,
        distance=WALL_M,
        period=PERIOD_M,
        blur_m=0.5 * WALL_M / TELE.fx,
    )
    np.testing.assert_allclose(frames[1] / 65535.0, light, rtol=0, atol=6e-4)  # white is 1


def test_the_top_row_is_exposed_first() -> None:
    """A lamp that fades in is dark in the top row of a rolling shutter."""
    lamp = amiwarp.Lamp((0.0, 0.0, 0.0), 3.0, flicker_hz=5.0)
    plain = amiwarp.Body("wall", wall(), amiwarp.Material(0.5))
    world = amiwarp.World("lamp", (plain,), ambient=0.0, lamps=(lamp,))
    camera = amiwarp.RigFrameCamera(
        TELE, exposure_us=1000, readout_us=30_000, bits=16, encoding="linear"
    )
    frames = amiwarp.Rig(world, AHEAD, {"grey": camera}, 0.04).run()["grey"].recording.frames
    assert frames is not None
    rows = frames[0].mean(axis=1) / 65535.0
    middles = 1e-6 * (500 + 30_000 * np.arange(48) / 47)
    x = (np.arange(64) - TELE.cx) / TELE.fx
    y = (np.arange(48) - TELE.cy) / TELE.fy
    slant = (1.0 + x**2 + y[:, None] ** 2) ** -1.5  # cosine, and the square of the distance
    lamps = 3.0 * (1.0 + np.sin(2.0 * np.pi * 5.0 * middles))
    expected = 0.5 / WALL_M**2 * lamps * slant.mean(axis=1)
    # Light is computed 0.2 mm in front of a surface.
    np.testing.assert_allclose(rows, expected, rtol=0, atol=2e-4)
    assert rows[0] < rows[20] < 1.0


def one_frame(camera: amiwarp.RigFrameCamera, material: amiwarp.Material, seed: int = 0) -> Any:
    """The frame of a wall at rest."""
    body = amiwarp.Body("wall", wall(), material)
    rig = amiwarp.Rig(world_of(body), AHEAD, {"camera": camera}, 0.02, seed)
    frames = rig.run()["camera"].recording.frames
    assert frames is not None
    return frames[0]


@pytest.mark.parametrize("light", [0.0, 0.002, 0.18, 0.77, 1.0])
def test_values_are_encoded(light: float) -> None:
    """8 and 16 bits, sRGB and linear, and the luminance of white."""
    grey = amiwarp.Material(light)
    expected = float(oracle.srgb(np.array([light]))[0])
    frame = one_frame(amiwarp.RigFrameCamera(TELE), grey)
    assert frame.dtype == np.uint8
    assert (frame == round(255 * expected)).all()
    frame = one_frame(amiwarp.RigFrameCamera(TELE, bits=16), grey)
    assert frame.dtype == np.uint16
    assert np.abs(frame - 65535 * expected).max() <= 1
    frame = one_frame(amiwarp.RigFrameCamera(TELE, bits=16, encoding="linear", white=0.8), grey)
    assert np.abs(frame - 65535 * min(light / 0.8, 1.0)).max() <= 1


def test_colour_is_beside_luminance() -> None:
    """Red, green and blue are luminance times relative colour, of texels and of the whole material."""
    rng = np.random.default_rng(1)
    texture = rng.uniform(0.2, 0.5, (4, 4)).astype(np.float32)
    colours = rng.uniform(0.5, 1.5, (4, 4, 3))
    colours /= (colours @ LUMINANCE)[..., None]
    linear = {"bits": 16, "encoding": "linear"}
    colour_camera = amiwarp.RigFrameCamera(CAMERA, colour=True, **linear)
    grey_camera = amiwarp.RigFrameCamera(CAMERA, **linear)
    tinted = amiwarp.Material(0.9, texture, colour=colours)
    frame = one_frame(colour_camera, tinted) / 65535.0
    assert frame.shape == (48, 64, 3)
    grey = one_frame(grey_camera, tinted) / 65535.0
    np.testing.assert_allclose(frame @ LUMINANCE, grey, rtol=0, atol=2e-5)
    without = one_frame(grey_camera, amiwarp.Material(0.9, texture)) / 65535.0
    np.testing.assert_array_equal(grey, without)
    whole = one_frame(colour_camera, amiwarp.Material(0.5, colour=colours[0, 0])) / 65535.0
    np.testing.assert_allclose(
        whole, np.broadcast_to(0.5 * colours[0, 0], whole.shape), rtol=0, atol=2e-5
    )
    assert np.ptp(frame, axis=2).max() > 0.05


@pytest.mark.parametrize("bits", [8, 16])
def test_noise_of_photons_and_of_the_readout(bits: int) -> None:
    """Mean and variance of the values, by the number of electrons."""
    camera = amiwarp.RigFrameCamera(
        amiwarp.Camera.from_fov(128, 96, 0.1),
        electrons=2000.0,
        read_noise=20.0,
        bits=bits,
        encoding="linear",
    )
    light = 0.4
    frame = one_frame(camera, amiwarp.Material(light)).astype(np.float64)
    top = 2.0**bits - 1.0
    share = frame / top
    expected = (light * 2000.0 + 20.0**2) / 2000.0**2 + 1.0 / 12.0 / top**2
    n = share.size
    assert abs(share.mean() - light) < 4.0 * math.sqrt(expected / n)
    assert abs(share.var() / expected - 1.0) < 4.0 * math.sqrt(2.0 / n)
    again = one_frame(camera, amiwarp.Material(light))
    np.testing.assert_array_equal(again, frame)
    assert (one_frame(camera, amiwarp.Material(light), seed=1) != frame).any()


def test_depth_of_a_plane() -> None:
    """The depth along the axis of a camera that is turned and moves, within 1 um."""
    place = place_of(0.05, -0.1, 0.02, 8, -12, 5)
    camera = amiwarp.RigDepthCamera(CAMERA, rate_hz=50.0, to_rig=place)
    rig = amiwarp.Rig(world_of(noise_wall()), waving(), {"depth": camera}, 0.1)
    recording = rig.run()["depth"].recording
    assert recording.depth is not None
    assert recording.depth.t.tolist() == [0, 20_000, 40_000, 60_000, 80_000, 100_000]
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    rays = np.stack(
        [
            (columns.ravel() - CAMERA.cx) / CAMERA.fx,
            (rows.ravel() - CAMERA.cy) / CAMERA.fy,
            np.ones(64 * 48),
        ],
        axis=1,
    )
    poses = recording.truth.poses
    for k, t_us in enumerate(recording.depth.t.tolist()):
        pose = pose_at(rig, "depth", 1e-6 * t_us)
        expected = oracle.plane_depth(rays, pose, np.array([0.0, 1.0, 0.0]), WALL_M)
        np.testing.assert_allclose(recording.depth[k].ravel(), expected, rtol=0, atol=1e-6)  # m
        np.testing.assert_allclose(poses.camera[k][:3], pose[:3, 3], rtol=0, atol=1e-12)


def test_depth_out_of_range_is_unknown_and_the_sky_infinite() -> None:
    """A near and a far square in front of the sky."""
    near = amiwarp.Body("near", wall(1.0, 0.1))
    middle = amiwarp.Body("middle", wall(2.0, 0.6))
    far = amiwarp.Body("far", wall(4.0, 2.0))
    camera = amiwarp.RigDepthCamera(CAMERA, nearest_m=1.5, farthest_m=3.0)
    world = world_of(near, middle, far)
    depth = amiwarp.Rig(world, AHEAD, {"depth": camera}, 0.01).run()["depth"].recording.depth
    assert depth is not None
    row = depth[0][24]
    assert np.isnan(row[32])
    assert row[36] == pytest.approx(2.0, abs=1e-6)
    assert np.isnan(row[45])
    assert np.isposinf(row[0])


def test_events_of_two_cameras_lie_on_epipolar_lines() -> None:
    """The places that events of one camera saw appear in the other one on the epipolar lines of these events."""
    place = place_of(0.1, 0.01, -0.02, 1, -4, 2)
    ideal = amiwarp.SensorModel.ideal()
    sensors = {
        "left": amiwarp.RigEventCamera(CAMERA, amiwarp.Prism(0.02), sensor=ideal),
        "right": amiwarp.RigEventCamera(CAMERA, sensor=ideal, to_rig=place),
    }
    rig = amiwarp.Rig(world_of(noise_wall()), sliding(), sensors, 0.02)
    recorded = rig.run()
    left_to_right = np.vstack([recorded.between("left", "right"), [0.0, 0.0, 0.0, 1.0]])
    recording = recorded["left"].recording
    events = recording.events[:]
    assert len(events) > 200
    assert recording.truth is not None
    truth = recording.truth.of_events(0, len(events))
    seen = np.asarray(truth.points, np.float64)
    places = np.asarray(truth.place, np.float64)
    in_right = np.empty((len(events), 2))
    for k, t_us in enumerate(events.t.tolist()):
        pose = pose_at(rig, "right", 1e-6 * t_us)
        in_camera = pose[:3, :3].T @ (places[k] - pose[:3, 3])
        in_right[k] = CAMERA.rays_to_pixels(in_camera[None])[0]
    lens = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1.0]])
    error = oracle.epipolar_distance(seen, in_right, left_to_right, lens, lens)
    assert error.max() < 0.01  # px
    disparity = np.abs(seen - in_right).max(axis=1)
    assert disparity.min() > 0.5  # px: the lines are not trivial


def test_a_written_rig_is_the_rig_in_memory(tmp_path: Path) -> None:
    """Events, frames, depth, poses and places are the same in the files."""
    rig = small_rig(
        colour=amiwarp.RigFrameCamera(CAMERA, colour=True, readout_us=1000, electrons=5000.0),
        depth=amiwarp.RigDepthCamera(CAMERA, rate_hz=100.0, to_rig=place_of(0, 0.1, 0, 3, 0, 0)),
    )
    shares: list[float] = []
    rig.write(tmp_path / "rig", progress=lambda _, share: shares.append(share))
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    stored = amiwarp.open_rig(tmp_path / "rig")
    made = rig.run()
    assert stored.metadata == made.metadata
    assert stored.metadata["world"] == "test"
    for name, sensor in made.sensors.items():
        kept = stored[name]
        assert kept.kind is sensor.kind
        np.testing.assert_array_equal(kept.to_rig, sensor.to_rig)
        assert kept.recording.camera == sensor.recording.camera
        for what in ("frames", "depth"):
            one, other = getattr(kept.recording, what), getattr(sensor.recording, what)
            assert (one is None) == (other is None)
            if one is not None:
                np.testing.assert_array_equal(one.t, other.t)
                for k in range(len(other)):
                    np.testing.assert_array_equal(one[k], other[k])
    for name in ("ami", "plain"):
        assert_same_events(stored[name].recording, made[name].recording)
    frames = stored["colour"].recording.frames
    assert frames is not None
    assert frames.exposure is not None
    assert frames.exposure.tolist() == [[500, 5500]]
    with pytest.raises(AmiwarpError, match=r"rig\.json: exists"):
        rig.write(tmp_path / "rig")


FILE = """
format = "amiwarp-rig-specification"
version = 1
world = "world.toml"
duration_s = 0.02
seed = 3

[[sensors]]
name = "ami"
kind = "events"
camera = {size = [32, 24], fov_deg = 40}
optic = {kind = "wedge", apex_deg = 1.5, nominal_apex_deg = 1.6, rpm = 600, phase_deg = 90}
sensor = {preset = "dvxplorer", leak_hz = 0.5}
encoder = {counts_per_turn = 1000}
imu = {preset = "bmi160", rate_hz = 100, position = [0.0, 0.1, 0.0]}
truth_hz = 100

[[sensors]]
name = "colour"
kind = "frames"
position = [0.1, 0.0, 0.0]
look = [1.0, 0.0, 1.0]
camera = {width = 20, height = 10, fx = 30, fy = 31, cx = 9, cy = 5}
colour = true
exposure_us = 1000
readout_us = 2000
bits = 16
encoding = "linear"

[[sensors]]
name = "depth"
kind = "depth"
rotation = [0.0, 0.0, 0.7071068, 0.7071068]
nearest_m = 0.5
"""
WORLD = """
format = "amiwarp-world"
version = 1
bodies = [{name = "wall", mesh = "wall.obj", material = {colour = [0.9, 0.3, 0.1]}}]
camera = {trajectory = [
  {t = 0, position = [0, 0, 0], look_at = [0, 1, 0]}, {t = 1, position = [1, 0, 0], look_at = [1, 1, 0]},
]}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A rig file and its world."""
    (tmp_path / "rig.toml").write_text(FILE)
    (tmp_path / "world.toml").write_text(WORLD)
    (tmp_path / "wall.obj").write_text("v -2 2 -2\nv 2 2 -2\nv 0 2 3\nf 1 2 3\n")
    return tmp_path


def test_a_rig_of_a_file(folder: Path) -> None:
    """Every field arrives, with angles in radians."""
    pytest.importorskip("trimesh")
    rig = amiwarp.load_rig(folder / "rig.toml")
    assert (rig.duration_s, rig.seed) == (0.02, 3)
    colour = np.asarray(rig.world.bodies[0].material.colour)
    np.testing.assert_allclose(colour / colour[0], np.array([9, 3, 1]) / 9.0, rtol=1e-6)
    ami, frames, depth = rig.sensors.values()
    assert isinstance(ami, amiwarp.RigEventCamera)
    assert ami.prism == amiwarp.Prism(math.radians(1.5))
    assert ami.nominal_prism == amiwarp.Prism(math.radians(1.6))
    assert isinstance(ami.motion, amiwarp.PrismMotion)
    assert (ami.motion.rpm, ami.motion.phase) == (600, math.radians(90))
    dvxplorer = amiwarp.SensorModel.preset("dvxplorer")
    assert ami.sensor == dataclasses.replace(dvxplorer, leak_hz=0.5)
    assert ami.encoder_model == amiwarp.EncoderModel(counts_per_turn=1000)
    assert ami.imu is not None
    assert (ami.imu.rate_hz, np.asarray(ami.imu.position).tolist()) == (100.0, [0.0, 0.1, 0.0])
    assert ami.truth_hz == 100
    assert isinstance(frames, amiwarp.RigFrameCamera)
    assert frames.camera == amiwarp.Camera(20, 10, 30.0, 31.0, 9.0, 5.0)
    given = (frames.colour, frames.exposure_us, frames.readout_us, frames.bits, frames.encoding)
    assert given == (True, 1000, 2000, 16, "linear")
    # Half a right angle to the right: the axis points to x and z, the image's right to x and -z, and down stays down.
    half = math.sqrt(0.5)
    expected = [[half, 0, half, 0.1], [0, 1, 0, 0], [-half, 0, half, 0]]
    np.testing.assert_allclose(frames.to_rig, expected, rtol=0, atol=1e-12)
    assert isinstance(depth, amiwarp.RigDepthCamera)
    turned = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0]]
    np.testing.assert_allclose(depth.to_rig, turned, rtol=0, atol=1e-6)
    assert (depth.nearest_m, depth.camera.width) == (0.5, 640)
    other = amiwarp.load_rig(folder / "rig.toml", duration_s=0.5, seed=9)
    assert (other.duration_s, other.seed) == (0.5, 9)


MISTAKES = {
    'name = "colour"': ('name = "ami"', r"sensors\[1\] has the name 'ami' of another sensor"),
    'kind = "depth"': ('kind = "radar"', r"sensors\[2\]\.kind is 'radar'; choose among"),
    "apex_deg = 1.5, ": ("apex = 1.5, ", r"sensors\[0\]\.optic\.apex is unknown.*apex_deg"),
    "apex_deg = 1.5": ("apex_deg = 99", r"sensors\[0\]\.optic: prism apex"),
    "exposure_us = 1000": ("exposure_us = 50000", r"sensors\[1\]: exposure_us = 50000"),
    "bits = 16": ("bits = 10", r"sensors\[1\]: bits is 10; give 8 or 16"),
    "look = [1.0, 0.0, 1.0]": ("look = [0, 0, 0]", r"sensors\[1\]: look is a vector of length 0"),
    "nearest_m = 0.5": ("electrons = 5", r"sensors\[2\]\.electrons is unknown"),
    "leak_hz = 0.5": ("leak = 0.5", r"sensors\[0\]\.sensor\.leak is unknown.*leak_hz"),
    "seed = 3": ('rig = "platform"', r"field rig is 'platform'; choose among paper-platform"),
    "truth_hz = 100": ("truth_hz = -1", r"sensors\[0\]: truth_hz = -1"),
    "0.7071068]": ("1.7071068]", r"sensors\[2\]: rotation has length 1\.85"),
}


@pytest.mark.parametrize("field", MISTAKES)
def test_mistakes_name_file_and_field(folder: Path, field: str) -> None:
    """One line says which field is wrong, and what to do."""
    wrong, message = MISTAKES[field]
    assert FILE.count(field) == 1
    (folder / "rig.toml").write_text(FILE.replace(field, wrong))
    with pytest.raises(AmiwarpError, match=rf"rig\.toml: .*{message}"):
        amiwarp.load_rig(folder / "rig.toml")


def test_the_command_simulates_a_rig(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options replace what the file says; others are refused."""
    pytest.importorskip("trimesh")
    monkeypatch.chdir(folder)
    runner = CliRunner()
    result = runner.invoke(
        app, ["simulate", "out", "--rig", "rig.toml", "--duration", "0.01", "--json"]
    )
    assert result.exit_code == 0, result.output
    data = json.loads(result.output)
    assert data["sensors"]["colour"] == {"kind": "frames", "count": 1}
    assert data["sensors"]["depth"] == {"kind": "depth", "count": 1}
    assert (data["duration_s"], data["seed"], data["world"]) == (0.01, 3, "world")
    rig = amiwarp.open_rig("out")
    assert list(rig.sensors) == ["ami", "colour", "depth"]
    assert len(rig["ami"].recording.events) == data["sensors"]["ami"]["count"] > 0
    result = runner.invoke(app, ["simulate", "out", "--rig", "rig.toml", "--rpm", "300"])
    assert result.exit_code == 1
    assert "--rpm does not apply to --rig" in result.output


def test_the_paper_platform() -> None:
    """Five cameras, of which one is behind a wedge, and a colour camera with a rolling shutter."""
    rig = amiwarp.Rig.paper_platform("desk", duration_s=0.1, size=(64, 48))
    assert list(rig.sensors) == ["ami", "plain", "colour", "grey", "depth"]
    ami = rig.sensors["ami"]
    assert isinstance(ami, amiwarp.RigEventCamera)
    assert ami.prism == amiwarp.Prism(math.radians(1.0))
    np.testing.assert_array_equal(ami.to_rig, np.eye(3, 4))
    assert rig.simulation("plain").camera == ami.camera


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: small_rig(**{"a b": amiwarp.RigDepthCamera(CAMERA)}), "give a name of at most 64"),
        (lambda: small_rig(PLAIN=amiwarp.RigDepthCamera(CAMERA)), "differ in more than case"),
        (lambda: small_rig(slow=amiwarp.RigFrameCamera(CAMERA, exposure_us=21_000)), "no frame"),
        (lambda: small_rig().trajectory_of("left"), "choose among ami, plain"),
        (lambda: amiwarp.RigFrameCamera(CAMERA, read_noise=3.0), "electrons is not given"),
        (lambda: amiwarp.RigDepthCamera(CAMERA, to_rig=-np.eye(3, 4)), "no rotation matrix"),
        (
            lambda: small_rig(grey=amiwarp.RigFrameCamera(CAMERA)).simulation("grey"),
            "has no events",
        ),
        (lambda: amiwarp.Material(0.5, colour=(1.0, 0.5, 0.5)), "luminance that differs from 1"),
        (lambda: amiwarp.Material(0.5, colour=(1.0, 1.0)), r"shape \(2,\)"),
    ],
)
def test_what_is_no_rig(make: Any, message: str) -> None:
    """Errors say what to do."""
    with pytest.raises(AmiwarpError, match=message):
        make()
