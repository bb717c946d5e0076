"""Rigs in the layouts of DSEC, MVSEC, EuRoC, Kalibr and ROS, read back by the libraries of their users."""

import csv
import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import hdf5plugin  # noqa: F401 - its import registers the compression
import numpy as np
import pytest
import yaml
from PIL import Image
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import amiwarp
from amiwarp import (
    AmiwarpError,
    Camera,
    Events,
    Fisheye,
    ImuSamples,
    MemoryEvents,
    MemoryImages,
    Poses,
    RadialTangential,
    Recording,
    RigRecording,
    RigSensor,
    Truth,
    convert_rig,
)
from tests.command_line import app

START = 5_000_000
LEFT = Camera(48, 36, 40.0, 41.0, 23.0, 18.5, RadialTangential(-0.2, 0.05, 0.002, -0.001))
RIGHT = Camera(48, 36, 42.0, 41.5, 24.5, 17.0, RadialTangential(-0.15, 0.03, -0.001, 0.002))
COLOUR = Camera(40, 30, 35.0, 35.0, 19.5, 14.5)
AXES = Rotation.from_euler("xyz", [90, 10, -5], degrees=True).as_matrix()
LEVER = (0.01, -0.02, 0.03)
NOISE = (1e-3, 2e-5, 3e-2, 4e-4)
TIMES = START + np.arange(4) * 20_000
EXPOSURE = np.stack([TIMES - 3000, TIMES + 3000], axis=1)
LEFT_PLACE = np.column_stack([np.eye(3), [-0.05, 0, 0]])
RIGHT_PLACE = np.column_stack(
    [Rotation.from_euler("xyz", [1, -2, 3], degrees=True).as_matrix(), [0.05, 0.004, -0.006]]
)
COLOUR_PLACE = np.column_stack([Rotation.from_rotvec([0, 0, 0.02]).as_matrix(), [0.01, -0.03, 0.0]])


def four(matrix: Any) -> np.ndarray:
    return np.vstack([matrix, [0, 0, 0, 1]])


def rig_pose(seconds: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Pose of the rig in the world, by formulas."""
    position = np.stack([np.sin(2 * seconds), 0.5 * np.cos(3 * seconds), 0.1 * seconds], axis=-1)
    turning = np.stack([0.1 * np.sin(seconds), 0.2 * seconds, 0.3 * np.cos(seconds)], axis=-1)
    return Rotation.from_rotvec(turning), position


def poses_of(place: np.ndarray) -> Poses:
    t = START + np.arange(61) * 1000
    rotation, position = rig_pose((t - START) * 1e-6)
    camera = rotation * Rotation.from_matrix(place[:, :3])
    return Poses(
        t, np.concatenate([position + rotation.apply(place[:, 3]), camera.as_quat()], axis=1)
    )


def events_of(seed: int, camera: Camera, count: int = 500) -> Events:
    rng = np.random.default_rng(seed)
    return Events.from_arrays(
        x=rng.integers(0, camera.width, count),
        y=rng.integers(0, camera.height, count),
        t=np.sort(rng.integers(START, START + 60_000, count)),
        p=rng.integers(0, 2, count),
    )


def pictures(seed: int, camera: Camera, *tail: int, dtype: Any = np.uint8) -> MemoryImages:
    """Smooth pictures, so that interpolated levels can be compared."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(0, np.iinfo(dtype).max, (4, 4, 4, *tail))
    sharp = [
        cv2.resize(one, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        for one in coarse
    ]
    return MemoryImages(TIMES, np.array(sharp).astype(dtype), EXPOSURE)


def imu_samples() -> ImuSamples:
    rng = np.random.default_rng(9)
    turning = rng.normal(size=(13, 3))
    turning[5] = np.nan  # this sample lacks the angular velocity
    return ImuSamples(START + np.arange(13) * 5000, turning, rng.normal(size=(13, 3)), AXES)


@functools.cache
def make_rig() -> RigRecording:
    nothing = MemoryEvents(events_of(0, COLOUR)[:0], 40, 30)
    metres = np.random.default_rng(4).uniform(1, 5, (4, 30, 40)).astype(np.float32)
    metres[0, 0, :2] = np.inf, np.nan
    left = Recording(
        events_of(1, LEFT),
        LEFT,
        truth=Truth({}, poses=poses_of(LEFT_PLACE)),
        imu=imu_samples(),
        frames=pictures(1, LEFT),
    )
    right = Recording(events_of(2, RIGHT), RIGHT, frames=pictures(2, RIGHT))
    colour = Recording(nothing, COLOUR, frames=pictures(3, COLOUR, 3))
    depth = Recording(nothing, COLOUR, depth=MemoryImages(TIMES, metres))
    return RigRecording(
        {
            "depth": RigSensor("depth", depth, COLOUR_PLACE),
            "right": RigSensor("events", right, RIGHT_PLACE),
            "left": RigSensor("events", left, LEFT_PLACE),
            "colour": RigSensor("frames", colour, COLOUR_PLACE),
        }
    )


def only(*names: str) -> RigRecording:
    rig = make_rig()
    return RigRecording({name: rig[name] for name in names})


def visible_points() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points in the left camera's frame that both see, and their pixels."""
    rng = np.random.default_rng(5)
    pixels = rng.uniform([4, 4], [44, 32], (400, 2))
    rays = LEFT.pixels_to_rays(pixels)
    points = rays / rays[:, 2:] * rng.uniform(0.5, 6.0, (400, 1))
    in_right = points @ make_rig().between("left", "right")[:, :3].T
    in_right += make_rig().between("left", "right")[:, 3]
    seen = RIGHT.rays_to_pixels(in_right)
    inside = ((seen > 2) & (seen < [45, 33])).all(axis=1)
    assert inside.sum() > 100
    return points[inside], pixels[inside], seen[inside]


def rectified(data: Any, number: int, pixels: np.ndarray) -> np.ndarray:
    """Rectified pixels by OpenCV, from the calibration of DSEC alone."""
    lens, virtual = data["intrinsics"][f"cam{number}"], data["intrinsics"][f"camRect{number}"]
    fx, fy, cx, cy = lens["camera_matrix"]
    gx, gy, dx, dy = virtual["camera_matrix"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    new = np.array([[gx, 0, dx], [0, gy, dy], [0, 0, 1.0]])
    turned = np.array(data["extrinsics"][f"R_rect{number}"])
    coefficients = np.array(lens["distortion_coeffs"])
    ends = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    found = cv2.undistortPoints(
        pixels[:, None].astype(float), matrix, coefficients, R=turned, P=new, criteria=ends
    )
    return found[:, 0]


def test_dsec_calibration_rectifies_true_points(tmp_path: Path) -> None:
    summary = convert_rig(make_rig(), tmp_path / "seq", format="dsec")
    assert summary.roles == {"cam0": "left", "cam3": "right", "cam1": "colour"}
    assert "sensor depth" in summary.left_out
    text = (tmp_path / "seq/calibration/cam_to_cam.yaml").read_text()
    assert "&" not in text  # no references inside the file
    data = yaml.safe_load(text)
    points, left, right = visible_points()
    there, here = rectified(data, 0, left), rectified(data, 3, right)
    assert np.abs(there[:, 1] - here[:, 1]).max() < 0.01  # px
    disparity = there[:, 0] - here[:, 0]
    assert disparity.min() > 0
    ones = np.ones(len(points))
    to_depth = np.array(data["disparity_to_depth"]["cams_03"])
    found = np.stack([*there.T, disparity, ones]).T @ to_depth.T
    in_virtual = points @ np.array(data["extrinsics"]["R_rect0"]).T
    np.testing.assert_allclose(found[:, :3] / found[:, 3:], in_virtual, rtol=1e-3)
    chain = np.array(data["extrinsics"]["T_31"]) @ np.array(data["extrinsics"]["T_10"])
    np.testing.assert_allclose(chain[:3], make_rig().between("left", "right"), rtol=0, atol=1e-12)
    assert data["intrinsics"]["cam1"]["resolution"] == [40, 30]
    with h5py.File(tmp_path / "seq/events/right/rectify_map.h5") as file:
        places = file["rectify_map"][:]
    grid = np.stack(np.meshgrid(np.arange(48), np.arange(36)), axis=-1)
    np.testing.assert_allclose(
        places.reshape(-1, 2), rectified(data, 3, grid.reshape(-1, 2)), rtol=0, atol=1e-3
    )  # px


def test_dsec_holds_events_frames_and_times(tmp_path: Path) -> None:
    """Without sensors of frames, the frames are the event cameras' own, and rectified."""
    summary = convert_rig(only("right", "left"), tmp_path / "seq", format="dsec", codec="gzip")
    assert summary.roles == {"cam0": "left", "cam3": "right", "cam1": "left", "cam2": "right"}
    assert summary.files == sum(path.is_file() for path in (tmp_path / "seq").rglob("*")) == 24
    for side in ("left", "right"):
        events = make_rig()[side].recording.events[:]
        with h5py.File(tmp_path / f"seq/events/{side}/events.h5") as file:
            np.testing.assert_array_equal(file["events/x"][:], events.x)
            np.testing.assert_array_equal(file["events/p"][:], events.p)
            t = file["events/t"][:].astype(int) + file["t_offset"][()]
            np.testing.assert_array_equal(t, events.t)
            index = file["ms_to_idx"][:]
            assert file["events/t"][index[3]] >= 3000 > file["events/t"][index[3] - 1]
    images = tmp_path / "seq/images"
    assert np.loadtxt(images / "timestamps.txt", int).tolist() == TIMES.tolist()
    exposure = np.loadtxt(images / "right/exposure_timestamps.txt", int, delimiter=",")
    np.testing.assert_array_equal(exposure, EXPOSURE)
    data = yaml.safe_load((tmp_path / "seq/calibration/cam_to_cam.yaml").read_text())
    assert sorted(data["extrinsics"])[-3:] == ["T_10", "T_21", "T_32"]
    taken = make_rig()["right"].recording.frames
    assert taken is not None
    stored = np.asarray(Image.open(images / "right/distorted/000002.png"))
    np.testing.assert_array_equal(stored, taken[2])
    seen = np.asarray(Image.open(images / "right/rectified/000002.png")).astype(int)
    lens, virtual = data["intrinsics"]["cam2"], data["intrinsics"]["camRect2"]
    matrices = []
    for fx, fy, cx, cy in (lens["camera_matrix"], virtual["camera_matrix"]):
        matrices.append(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
    turned = np.array(data["extrinsics"]["R_rect2"])
    coefficients = np.array(lens["distortion_coeffs"])
    maps = cv2.initUndistortRectifyMap(
        matrices[0], coefficients, turned, matrices[1], (48, 36), cv2.CV_32FC1
    )
    inside = (maps[0] > 0) & (maps[0] < 47) & (maps[1] > 0) & (maps[1] < 35)
    expected = cv2.remap(taken[2], *maps, cv2.INTER_LINEAR).astype(int)
    assert inside.mean() > 0.7
    assert np.abs(seen - expected)[inside].max() <= 2  # levels; OpenCV rounds positions to 1/32 px
    assert seen[maps[0] < -1].max(initial=0) == 0


def test_mvsec_files(tmp_path: Path) -> None:
    convert_rig(make_rig(), tmp_path / "walk", format="mvsec")
    names = {path.name for path in (tmp_path / "walk").iterdir()}
    assert names == {"walk_data.hdf5", "walk_gt.hdf5", "camchain-imucam-walk.yaml"}
    left = make_rig()["left"].recording
    events = left.events[:]
    with h5py.File(tmp_path / "walk/walk_data.hdf5") as file:
        rows = file["davis/left/events"][:]
        np.testing.assert_array_equal(rows[:, 0], events.x)
        np.testing.assert_array_equal(np.rint(rows[:, 2] * 1e6), events.t)
        np.testing.assert_array_equal(rows[:, 3], np.where(events.p, 1, -1))
        np.testing.assert_array_equal(
            file["davis/right/image_raw"][3], list(make_rig()["right"].recording.frames)[3]
        )  # type: ignore[arg-type]
        np.testing.assert_allclose(file["davis/left/image_raw_ts"][:], TIMES * 1e-6, rtol=0)
        nearest = file["davis/left/image_raw_event_inds"][:]
        gaps = np.abs(events.t[nearest] - TIMES)
        assert gaps.tolist() == [np.abs(events.t - t).min() for t in TIMES]
        imu = left.imu
        assert imu is not None
        whole = np.isfinite(imu.angular_velocity[:, 0])
        expected = np.concatenate([imu.acceleration, imu.angular_velocity], axis=1)[whole]
        np.testing.assert_array_equal(file["davis/left/imu"][:], expected)
        assert len(file["davis/left/imu_ts"]) == 12
    with h5py.File(tmp_path / "walk/walk_gt.hdf5") as file:
        pose = file["davis/left/pose"][20]
        rotation, position = rig_pose(np.array(0.02))
        np.testing.assert_allclose(
            pose, four(np.c_[rotation.as_matrix(), position]) @ four(LEFT_PLACE), rtol=0, atol=1e-12
        )
        assert file["davis/left/pose_ts"][20] == pytest.approx(5.02)
    back = amiwarp.open_recording(tmp_path / "walk/walk_data.hdf5", topic="davis/left")
    np.testing.assert_array_equal(back.events[:].t, events.t)
    assert back.frames is not None
    assert len(back.frames) == 4


def test_mvsec_depth_is_nan_where_it_is_unknown(tmp_path: Path) -> None:
    rig = make_rig()
    seen = Recording(events_of(7, COLOUR), COLOUR, depth=rig["depth"].recording.depth)
    convert_rig(
        RigRecording({"one": RigSensor("events", seen, np.eye(3, 4))}),
        tmp_path / "d",
        format="mvsec",
    )
    with h5py.File(tmp_path / "d/d_gt.hdf5") as file:
        depth = file["davis/left/depth_image_raw"][:]
        assert np.isnan(depth[0, 0]).tolist() == [True, True, *[False] * 38]
        expected = np.stack(list(seen.depth or []))
        np.testing.assert_array_equal(depth[1:], expected[1:])
        assert "pose" not in file["davis/left"]


def table(path: Path) -> np.ndarray:
    """Rows of a table of EuRoC, without its header."""
    with open(path, newline="") as file:
        header, *rows = csv.reader(file)
    assert header[0].startswith("#timestamp")
    assert {len(row) for row in rows} == {len(header)}
    return np.array(rows)


def test_euroc_folder(tmp_path: Path) -> None:
    summary = convert_rig(
        make_rig(), tmp_path / "e", format="euroc", imu_noise=NOISE, imu_position=LEVER
    )
    assert summary.roles == {"cam0": "left", "cam1": "right", "cam2": "colour"}
    assert "events" in summary.left_out
    mav = tmp_path / "e/mav0"
    body_of_left = four(np.c_[AXES, LEVER])  # from the IMU to the left camera
    for index, name in enumerate(("left", "right", "colour")):
        sensor = make_rig()[name]
        frames = sensor.recording.frames
        assert frames is not None
        listed = table(mav / f"cam{index}/data.csv")
        assert listed[:, 0].astype(int).tolist() == (1000 * TIMES).tolist()
        for (_, file), image in zip(listed, frames, strict=True):
            stored = np.asarray(Image.open(mav / f"cam{index}/data" / file))
            np.testing.assert_array_equal(stored, image)
        about = yaml.safe_load((mav / f"cam{index}/sensor.yaml").read_text())
        to_body = np.reshape(about["T_BS"]["data"], (4, 4))
        expected = np.linalg.inv(body_of_left) @ four(make_rig().between(name, "left"))
        np.testing.assert_allclose(to_body, expected, rtol=0, atol=1e-12)
        camera = sensor.recording.camera
        assert camera is not None
        assert about["intrinsics"] == [camera.fx, camera.fy, camera.cx, camera.cy]
        assert (about["distortion_model"], about["rate_hz"]) == ("radial-tangential", 50.0)
        _, coefficients = camera.to_opencv()
        assert about["distortion_coefficients"] == coefficients[:4].tolist()
    samples = table(mav / "imu0/data.csv").astype(float)
    imu = imu_samples()
    whole = np.isfinite(imu.angular_velocity[:, 0])
    np.testing.assert_array_equal(samples[:, 0], 1000 * imu.t[whole])
    np.testing.assert_array_equal(samples[:, 1:4], imu.angular_velocity[whole])
    np.testing.assert_array_equal(samples[:, 4:], imu.acceleration[whole])
    about = yaml.safe_load((mav / "imu0/sensor.yaml").read_text())
    names = ("gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density")
    assert [about[name] for name in names] == list(NOISE[:3])
    assert (about["T_BS"]["data"], about["rate_hz"]) == (np.eye(4).ravel().tolist(), 200.0)


def test_euroc_states_are_the_trajectory_of_the_imu(tmp_path: Path) -> None:
    convert_rig(make_rig(), tmp_path / "e", format="euroc", imu_position=LEVER)
    states = table(tmp_path / "e/mav0/state_groundtruth_estimate0/data.csv").astype(float)
    assert states.shape == (61, 17)
    seconds = states[:, 0] * 1e-9 - START * 1e-6

    def imu_place(at: np.ndarray) -> tuple[Rotation, np.ndarray]:
        rotation, position = rig_pose(at)
        on_rig = np.array(LEVER) + LEFT_PLACE[:, 3]
        return rotation * Rotation.from_matrix(AXES), position + rotation.apply(on_rig)

    rotation, position = imu_place(seconds)
    np.testing.assert_allclose(states[:, 1:4], position, rtol=0, atol=1e-12)  # m
    stored = Rotation.from_quat(states[:, [5, 6, 7, 4]])
    assert (stored.inv() * rotation).magnitude().max() < 1e-12  # rad
    _, later = imu_place(seconds + 1e-5)
    _, before = imu_place(seconds - 1e-5)
    velocity = (later - before) / 2e-5
    np.testing.assert_allclose(states[1:-1, 8:11], velocity[1:-1], rtol=0, atol=1e-5)  # m/s
    assert not states[:, 11:].any()


def test_kalibr_folder(tmp_path: Path) -> None:
    rig = make_rig()
    summary = convert_rig(
        rig, tmp_path / "k", format="kalibr", right="colour", imu_noise=NOISE, imu_position=LEVER
    )
    names = ["left", "colour", "right"]
    assert list(summary.roles.values()) == names
    chain = yaml.safe_load((tmp_path / "k/camchain-imucam.yaml").read_text())
    assert list(chain) == ["cam0", "cam1", "cam2"]
    point = np.array([0.1, 0.2, 0.3, 1.0])  # in the IMU's frame
    in_left = np.array([*(AXES @ point[:3] + LEVER), 1.0])
    for index, name in enumerate(names):
        fields = chain[f"cam{index}"]
        expected = four(rig.between("left", name)) @ in_left
        np.testing.assert_allclose(np.array(fields["T_cam_imu"]) @ point, expected, atol=1e-12)
        if index:
            earlier = np.array(chain[f"cam{index - 1}"]["T_cam_imu"])
            moved = np.array(fields["T_cn_cnm1"]) @ earlier @ point
            np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-12)  # m
        assert fields["rostopic"] == f"/cam{index}/image_raw"
        assert len(list((tmp_path / f"k/cam{index}").iterdir())) == 4
    assert chain["cam0"]["distortion_model"] == "radtan"
    stored = np.asarray(Image.open(tmp_path / f"k/cam1/{1000 * TIMES[3]:019d}.png"))
    taken = rig["colour"].recording.frames
    assert taken is not None
    np.testing.assert_array_equal(stored, taken[3])
    about = yaml.safe_load((tmp_path / "k/imu.yaml").read_text())
    assert about["accelerometer_random_walk"] == NOISE[3]
    assert about["update_rate"] == 200.0
    lines = (tmp_path / "k/imu0.csv").read_text().splitlines()
    assert lines[0] == "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z"
    assert len(lines) == 13


def test_what_is_not_in_the_rig_is_said(tmp_path: Path) -> None:
    summary = convert_rig(make_rig(), tmp_path / "k", format="kalibr")
    notes = " ".join(summary.notes)
    assert "1 IMU samples without acceleration or angular velocity are left out" in notes
    assert "place of the IMU assumed at the centre of left" in notes
    assert "noise of the IMU is not in the recording" in notes
    assert "gyroscope_noise_density" not in (tmp_path / "k/imu.yaml").read_text()
    alone = convert_rig(only("right", "colour"), tmp_path / "e", format="euroc")
    assert alone.roles == {"cam0": "colour", "cam1": "right"}
    assert "frame of the body is the frame of colour" in " ".join(alone.notes)
    assert "no true states" in " ".join(alone.notes)
    assert sorted(path.name for path in (tmp_path / "e/mav0").iterdir()) == [
        "body.yaml",
        "cam0",
        "cam1",
    ]
    pictured = pictures(1, RIGHT, 3, dtype=np.uint16)
    lone = Recording(events_of(2, RIGHT), RIGHT, frames=pictured)
    deep = RigRecording({"lone": RigSensor("events", lone, np.eye(3, 4))})
    summary = convert_rig(deep, tmp_path / "m", format="mvsec")
    assert "frames of lone have 16 bits: the upper 8 are written" in summary.notes
    assert "frames of lone are in colour: their luma is written" in summary.notes
    with h5py.File(tmp_path / "m/m_data.hdf5") as file:
        red, green, blue = np.moveaxis(pictured[1] // 256, 2, 0).astype(float)
        luma = 0.299 * red + 0.587 * green + 0.114 * blue
        assert np.abs(file["davis/left/image_raw"][1] - luma).max() < 1  # level
    convert_rig(deep, tmp_path / "k16", format="kalibr")
    stored = (tmp_path / f"k16/cam0/{1000 * TIMES[0]:019d}.png").read_bytes()
    colours = cv2.imdecode(np.frombuffer(stored, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(colours, pictured[0])


def messages_of(path: Path) -> dict[str, list[tuple[int, Any]]]:
    store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE)
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path], default_typestore=store) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
    return found


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * 1_000_000 + message.header.stamp.nanosec // 1000


@pytest.mark.parametrize("ending", ["bag", "mcap", "db3"])
def test_bags_hold_all_sensors(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"rig.{ending}"
    summary = convert_rig(make_rig(), path, imu_position=LEVER)
    assert (summary.files, summary.left_out) == (1, ("exposures",))
    found = messages_of(path)
    assert sorted(found) == [
        "/colour/camera_info",
        "/colour/image_raw",
        "/depth/depth/camera_info",
        "/depth/depth/image_raw",
        "/left/camera_info",
        "/left/events",
        "/left/image_raw",
        "/left/imu",
        "/left/pose",
        "/right/camera_info",
        "/right/events",
        "/right/image_raw",
        "/tf_static",
    ]
    encodings = {"/colour": "rgb8", "/left": "mono8", "/depth/depth": "32FC1"}
    stores = {
        "/colour": make_rig()["colour"].recording.frames,
        "/left": make_rig()["left"].recording.frames,
        "/depth/depth": make_rig()["depth"].recording.depth,
    }
    for topic, encoding in encodings.items():
        images = stores[topic]
        assert images is not None
        for (recorded, message), image, t in zip(
            found[f"{topic}/image_raw"], images, TIMES.tolist(), strict=True
        ):
            assert (message.encoding, stamp_of(message), recorded) == (encoding, t, 1000 * t)
            pixels = message.data.reshape(message.height, message.step).view(image.dtype)
            np.testing.assert_array_equal(pixels.reshape(image.shape), image)
    _, info = found["/right/camera_info"][0]
    matrix = np.reshape(getattr(info, "k", getattr(info, "K", None)), (3, 3))
    np.testing.assert_array_equal(matrix, RIGHT.to_opencv()[0])
    coefficients = getattr(info, "d", getattr(info, "D", None))
    assert (info.distortion_model, len(coefficients), info.width) == (
        "rational_polynomial" if len(RIGHT.to_opencv()[1]) == 8 else "plumb_bob",
        len(RIGHT.to_opencv()[1]),
        48,
    )
    [(_, places)] = found["/tf_static"]
    frames = {transform.child_frame_id: transform for transform in places.transforms}
    for name, sensor in make_rig().sensors.items():
        np.testing.assert_allclose(matrix_of(frames[name]), sensor.to_rig, rtol=0, atol=1e-12)
        assert frames[name].header.frame_id == "rig"
    np.testing.assert_allclose(matrix_of(frames["left_imu"]), np.c_[AXES, LEVER], atol=1e-12)
    assert frames["left_imu"].header.frame_id == "left"
    imu = imu_samples()
    _, sample = found["/left/imu"][7]
    assert stamp_of(sample) == imu.t[7]
    assert sample.angular_velocity.y == imu.angular_velocity[7, 1]
    assert found["/left/imu"][5][1].angular_velocity_covariance[0] == -1
    assert found["/left/imu"][5][1].linear_acceleration_covariance[0] == 0
    pose = poses_of(LEFT_PLACE).camera[30]
    _, true = found["/left/pose"][30]
    assert true.header.frame_id == "world"
    assert (true.pose.position.z, true.pose.orientation.w) == (pose[2], pose[6])
    for _, message in found["/right/events"]:
        assert message.header.frame_id == "right"
    for name in ("left", "right"):
        back = amiwarp.open_recording(path, topic=f"/{name}/events").events[:]
        given = make_rig()[name].recording.events[:]
        for column in ("x", "y", "t", "p"):
            np.testing.assert_array_equal(getattr(back, column), getattr(given, column))


def compensated_rig() -> RigRecording:
    """A rig whose left events are between pixels, outside the image, or without a place."""
    left = make_rig()["left"]
    events = left.recording.events[:20]
    x = events.x.astype(np.float32) + 0.25
    y = events.y.astype(np.float32) - 0.25
    x[3] = -7.5
    y[5] = np.nan
    moved = MemoryEvents(Events(x, y, events.t, events.p), LEFT.width, LEFT.height)
    recording = replace(left.recording, events=moved, truth=None)
    return RigRecording({"left": replace(left, recording=recording)})


@pytest.mark.parametrize("ending", ["bag", "mcap"])
def test_bags_round_compensated_events(tmp_path: Path, ending: str) -> None:
    out = tmp_path / f"rig.{ending}"
    done = convert_rig(compensated_rig(), out)
    assert any("left are rounded to whole pixels" in note for note in done.notes)
    read = amiwarp.open_recording(out).events[:]
    kept = np.delete(make_rig()["left"].recording.events[:20].x, [3, 5])
    np.testing.assert_array_equal(read.x, kept)


def test_dsec_rounds_compensated_events(tmp_path: Path) -> None:
    done = convert_rig(compensated_rig(), tmp_path / "d", format="dsec", left="left")
    assert any("left are rounded to whole pixels" in note for note in done.notes)
    with h5py.File(tmp_path / "d/events/left/events.h5") as file:
        kept = np.delete(make_rig()["left"].recording.events[:20].y, [3, 5])
        np.testing.assert_array_equal(file["events/y"][:], kept)


def matrix_of(transform: Any) -> np.ndarray:
    place, turned = transform.transform.translation, transform.transform.rotation
    rotation = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w]).as_matrix()
    return np.c_[rotation, [place.x, place.y, place.z]]


def with_lens(lens: Any) -> RigRecording:
    camera = Camera(48, 36, 40.0, 41.0, 23.0, 18.5, lens)
    seen = Recording(events_of(1, camera), camera, frames=pictures(1, camera))
    return RigRecording({"one": RigSensor("events", seen, np.eye(3, 4))})


def test_lenses_keep_their_meaning_or_are_refused(tmp_path: Path) -> None:
    fisheye = with_lens(Fisheye(0.1, 0.02))
    convert_rig(fisheye, tmp_path / "e", format="euroc")
    about = yaml.safe_load((tmp_path / "e/mav0/cam0/sensor.yaml").read_text())
    assert about["distortion_model"] == "equidistant"
    convert_rig(fisheye, tmp_path / "a.mcap")
    [(_, info), *_] = messages_of(tmp_path / "a.mcap")["/one/camera_info"]
    assert (info.distortion_model, info.d.tolist()) == ("equidistant", [0.1, 0.02, 0, 0])
    third = with_lens(RadialTangential(-0.2, 0.05, 0.0, 0.0, 0.01))
    for format in ("dsec", "euroc", "kalibr", "mvsec"):
        with pytest.raises(AmiwarpError, match="no coefficients after p2"):
            convert_rig(third, tmp_path / format, format=format)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "e"]


@pytest.mark.parametrize(
    ("names", "arguments", "message"),
    [
        (("left", "right"), {"format": "dsec", "left": "right"}, "does not lie to the right of"),
        (("left", "right"), {"format": "dsec", "left": "left", "right": "left"}, "are both left"),
        (("left", "right"), {"format": "dsec", "left": "centre"}, "no sensor 'centre'; choose amo"),
        (("left", "colour"), {"format": "dsec", "right": "colour"}, "colour is no sensor with eve"),
        (("left",), {"format": "dsec", "right": "left"}, "no sensor with events but left"),
        (("depth",), {"format": "kalibr"}, "no sensor of the rig has frames; choose another"),
        (("depth",), {"format": "mvsec"}, "no sensor of the rig has events"),
        (("left",), {}, "is no bag of ROS .*dsec, mvsec, euroc or kalibr"),
        (("left",), {"format": "ros2"}, "ros2 are written as .mcap or .db3"),
        (("left",), {"format": "tum"}, "choose among dsec"),
        (("left",), {"format": "euroc", "imu_noise": (1.0, 2.0, 3.0)}, "expected 4 numbers"),
        (("left",), {"format": "euroc", "imu_noise": (1.0, 2.0, 3.0, -1.0)}, "imu_noise"),
        (("left",), {"format": "euroc", "codec": "zip"}, "codec is 'zip'"),
    ],
)
def test_what_cannot_be_written_is_named(
    tmp_path: Path, names: Any, arguments: Any, message: str
) -> None:
    with pytest.raises(AmiwarpError, match=message):
        convert_rig(only(*names), tmp_path / "out", **arguments)
    assert list(tmp_path.iterdir()) == []


def test_without_names_the_outermost_cameras_are_left_and_right(tmp_path: Path) -> None:
    sensors = {}
    for name, x in (("middle", 0.0), ("east", 0.3), ("near", 0.1), ("west", -0.2)):
        seen = Recording(events_of(1, COLOUR), COLOUR)
        sensors[name] = RigSensor("events", seen, np.column_stack([np.eye(3), [x, 0, 0]]))
    rig = RigRecording(sensors)

    def roles(name: str, **given: str) -> list[str]:
        return list(convert_rig(rig, tmp_path / name, format="dsec", **given).roles.values())  # type: ignore[arg-type]

    assert roles("a") == ["west", "east"]
    assert roles("b", left="middle") == ["middle", "east"]
    assert roles("c", right="near") == ["west", "near"]


def test_existing_folders_stay(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for name, message in (
        ("mine", "exists; give the name of a new folder"),
        ("none/seq", "does not exist; create it"),
        ("seq.h5", r"is for a folder, but ends in \.h5"),
    ):
        with pytest.raises(AmiwarpError, match=message):
            convert_rig(make_rig(), tmp_path / name, format="dsec", overwrite=True)
    (tmp_path / "a.bag").write_bytes(b"mine")
    with pytest.raises(AmiwarpError, match=r"a\.bag: exists"):
        convert_rig(make_rig(), tmp_path / "a.bag")
    with pytest.raises(AmiwarpError, match="a bag holds all sensors; leave out left and right"):
        convert_rig(make_rig(), tmp_path / "b.bag", left="left")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.bag", "mine"]


def test_the_command_says_which_sensor_is_which(tmp_path: Path) -> None:
    amiwarp.save_rig(tmp_path / "rig", only("left", "right", "colour"))

    def run(*words: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["convert", str(tmp_path / "rig"), *words])
        return result.exit_code, " ".join((result.output + result.stderr).split())

    code, text = run(str(tmp_path / "seq"), "--format", "dsec", "--left", "left")
    assert (code, "cam0 is left, cam3 is right, cam1 is colour (--left, --right)" in text) == (
        0,
        True,
    )
    assert "note: left out: IMU samples, ground truth" in text
    code, text = run(str(tmp_path / "e"), "--format", "euroc", "--imu-noise", "1,2,3")
    assert (code, "--imu-noise" in text) == (1, True)
    code, text = run(str(tmp_path / "e"), "--format", "euroc", "--topic", "/a")
    assert (code, "is a rig; give only --format" in text) == (1, True)
    words = ["convert", str(tmp_path / "rig/left.h5"), str(tmp_path / "a.npz"), "--left", "left"]
    result = CliRunner().invoke(app, words)
    assert (result.exit_code, "is no rig; leave out --left" in result.stderr) == (1, True)
