"""IMU samples and frames are read from other formats, kept in native recordings, and described."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from amiwarp import (
    AmiwarpError,
    ImuSamples,
    MemoryEvents,
    MemoryImages,
    Recording,
    RecordingWriter,
    Truth,
    convert,
    open_recording,
    save_recording,
)
from amiwarp.events import axes_in_words, orientations
from amiwarp.events.axes import read_axes
from amiwarp.io.aedat import aedat2_imu
from amiwarp.io.description import describe
from amiwarp.io.description_table import table_rows
from amiwarp.io.opening import head_only
from amiwarp.optics import MODELS
from reference.io_samples import SIZE, make_events, refusal
from reference.io_samples_extra import (
    aedat3_packet,
    arrays,
    packets,
    typestore,
    write_aedat2,
    write_aedat3,
    write_mvsec,
    write_ros1,
    write_ros2,
)

EVENTS = make_events()
G = 9.80665


def make_imu(count: int = 3000) -> ImuSamples:
    rng = np.random.default_rng(0)
    turning = rng.normal(size=(count, 3))
    turning[::7] = np.nan  # these samples hold no angular velocity
    return ImuSamples(
        1_000_000 + np.arange(count) // 2 * 1000, turning, rng.normal(size=(count, 3))
    )


def make_images(dtype: Any, count: int = 5) -> MemoryImages:
    pixels = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (count, 7, 9), endpoint=True)
    return MemoryImages(1_000_000 + np.arange(count) * 40_000, pixels.astype(dtype))


def assert_same_sensors(given: Recording, expected: Recording) -> None:
    assert given.imu is not None
    assert expected.imu is not None
    for name in ("t", "angular_velocity", "acceleration"):
        np.testing.assert_array_equal(
            getattr(given.imu, name), getattr(expected.imu, name), strict=True
        )
    np.testing.assert_array_equal(given.imu.to_camera, expected.imu.to_camera)
    assert given.frames is not None
    assert expected.frames is not None
    assert given.frames.size == expected.frames.size
    np.testing.assert_array_equal(given.frames.t, expected.frames.t, strict=True)
    for index in range(len(expected.frames.t)):
        np.testing.assert_array_equal(given.frames[index], expected.frames[index], strict=True)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_native_recordings_keep_both_bit_for_bit(tmp_path: Path, dtype: Any) -> None:
    plain = Recording(MemoryEvents(EVENTS, *SIZE))
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    whole = replace(plain, imu=replace(make_imu(), to_camera=axes), frames=make_images(dtype))
    save_recording(tmp_path / "a.h5", whole)
    stored = open_recording(tmp_path / "a.h5")
    assert_same_sensors(stored, whole)
    assert stored.frames is not None
    save_recording(tmp_path / "part.h5", replace(stored, frames=stored.frames[1:3]))
    part = open_recording(tmp_path / "part.h5").frames
    assert part is not None
    assert (len(part), part.t.tolist()) == (2, whole.frames.t[1:3].tolist())
    np.testing.assert_array_equal(list(part), list(whole.frames[1:3]))
    assert convert(tmp_path / "a.h5", tmp_path / "b.h5", codec="gzip").left_out == ()
    assert_same_sensors(open_recording(tmp_path / "b.h5"), whole)
    assert {"IMU samples", "frames"} <= set(convert(tmp_path / "a.h5", tmp_path / "c.npz").left_out)
    back = open_recording(tmp_path / "c.npz")
    assert (back.imu, back.frames) == (None, None)
    empty = replace(plain, imu=make_imu(0))
    save_recording(tmp_path / "d.h5", empty)
    again = open_recording(tmp_path / "d.h5").imu
    assert again is not None
    assert (len(again), again.rate_hz, again.to_camera) == (0, None, None)


def test_frames_in_order_take_one_pass_over_the_file(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last frame ends it, which frees the process that reads."""
    frames: Any = open_recording(data_dir / "aedat/aedat4_davis346_cars.aedat4").frames
    passes, start = [], frames._images
    monkeypatch.setattr(frames, "_images", lambda: passes.append(start()) or passes[-1])
    seen = list(frames)
    assert len(passes) == 1
    assert len(seen) == len(frames) == len(frames.t) == 4
    assert passes[0].gi_frame is None
    np.testing.assert_array_equal(frames[1], seen[1])
    assert len(passes) == 2
    np.testing.assert_array_equal(frames[-1], seen[3])
    np.testing.assert_array_equal(list(frames[1:3]), seen[1:3])


def test_wrong_arrays_are_refused(tmp_path: Path) -> None:
    t, rows = np.arange(3), np.zeros((3, 3))
    with pytest.raises(
        AmiwarpError, match=r"IMU acceleration is float64 of shape \(2, 3\); give float64"
    ):
        ImuSamples(t, rows, rows[:2])
    with pytest.raises(AmiwarpError, match="IMU times decrease"):
        ImuSamples(t[::-1].copy(), rows, rows)
    with pytest.raises(AmiwarpError, match="IMU times are float64"):
        ImuSamples(t * 1.0, rows, rows)  # type: ignore[arg-type]
    for value in (np.nan, np.inf, -np.inf):
        wrong = rows.copy()
        wrong[1, 2] = value
        with pytest.raises(
            AmiwarpError, match=r"IMU acceleration of sample 1 is \[0\.0, 0\.0, .*expected finite"
        ):
            ImuSamples(t, rows, wrong)
    for axes in (-np.eye(3), 1.01 * np.eye(3), np.full((3, 3), np.nan), np.eye(2)):
        with pytest.raises(AmiwarpError, match="IMU to_camera"):
            ImuSamples(t, rows, rows, axes)
    unknown = rows.copy()
    unknown[1] = np.nan  # the sample does not hold the quantity
    assert np.isnan(ImuSamples(t, unknown, rows).angular_velocity[1]).all()
    with pytest.raises(AmiwarpError, match="frame is float64 of shape"):
        MemoryImages(t, np.zeros((3, 2, 2)))
    with pytest.raises(AmiwarpError, match="frames have int64 times of shape"):
        MemoryImages(t, np.zeros((2, 2, 2), np.uint8))
    with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
        writer.append(EVENTS)
        writer.append_image(5, np.zeros((2, 3), np.uint8))
        with pytest.raises(AmiwarpError, match=r"a\.h5: .*earlier ones are uint8"):
            writer.append_image(6, np.zeros((2, 3), np.uint16))
        with pytest.raises(AmiwarpError, match="does not follow 5 us"):
            writer.append_image(4, np.zeros((2, 3), np.uint8))
        writer.append_imu(make_imu(4))
        with pytest.raises(AmiwarpError, match="imu/t 1000000 us does not follow 1001000 us"):
            writer.append_imu(make_imu(4))
    with pytest.raises(AmiwarpError, match="outside its 'with' block"):
        RecordingWriter(tmp_path / "b.h5", width=4, height=4).append_imu(make_imu(4))


def test_damage_is_named(tmp_path: Path) -> None:
    whole = Recording(MemoryEvents(EVENTS, *SIZE), imu=make_imu(9), frames=make_images(np.uint8))
    faults = {
        "imu/acceleration": (
            np.zeros((8, 3)),
            r"'imu/acceleration' has shape \(8, 3\); expected \(9, 3\)",
        ),
        "imu/t": (np.arange(9)[::-1], "IMU times decrease"),
        "imu/angular_velocity": (
            np.full((9, 3), np.inf),
            "IMU angular_velocity of sample 0 is .*expected finite",
        ),
        "frames/image": (np.zeros((5, 7, 9)), "dataset 'frames/image' is float64"),
        "frames/t": (np.arange(4), r"'frames/image' has shape \(5, 7, 9\); expected \(4, 7, 9\)"),
    }
    for name, (values, message) in faults.items():
        path = tmp_path / f"{name.replace('/', '_')}.h5"
        save_recording(path, whole)
        with h5py.File(path, "r+") as file:
            del file[name]
            file[name] = values
        with pytest.raises(AmiwarpError, match=message):
            open_recording(path)


def imu_message(
    store: Any, ros1: bool, t: int, turning: tuple[float, ...], *, known: bool = True
) -> Any:
    types = store.types
    vector, none = types["geometry_msgs/msg/Vector3"], np.full(9, 0.0 if known else -1.0)
    return types["sensor_msgs/msg/Imu"](
        stamped(store, ros1, t), types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), np.zeros(9),
        vector(*turning), np.zeros(9), vector(1.0, 2.0, 3.0), none,
    )  # fmt: skip


def image_message(
    store: Any, ros1: bool, t: int, encoding: str, pixels: np.ndarray, *, big: bool = False
) -> Any:
    """Image whose rows are padded by 3 bytes."""
    height, width = pixels.shape
    stored = (
        pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
        .view(np.uint8)
        .reshape(height, -1)
    )
    padded = np.pad(stored, ((0, 0), (0, 3)), constant_values=77)
    image = store.types["sensor_msgs/msg/Image"]
    head = stamped(store, ros1, t)
    return image(head, height, width, encoding, int(big), padded.shape[1], padded.reshape(-1))


def stamped(store: Any, ros1: bool, t: int) -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](t // 1_000_000, t % 1_000_000 * 1000 + 999)
    return store.types["std_msgs/msg/Header"](
        **({"seq": 0} if ros1 else {}), stamp=stamp, frame_id="camera"
    )


def write_bag(path: Path, ros1: bool, topics: dict[str, list[Any]]) -> Path:
    if ros1:
        write_ros1(path, topics)
        return path
    return write_ros2(path.with_suffix(""), topics)


@pytest.mark.parametrize("ros1", [True, False])
def test_ros_bags(tmp_path: Path, ros1: bool) -> None:
    store = typestore(ros1)
    pixels = np.random.default_rng(0).integers(0, 2**16, (3, 5, 4)).astype(np.uint16)
    images = [
        image_message(store, ros1, 1_000_000 + index * 40_000, "mono16", image, big=index == 1)
        for index, image in enumerate(pixels)
    ]
    samples = [
        imu_message(store, ros1, 1_000_000 + t, (0.1, 0.2, t), known=t > 0) for t in (0, 1000, 2000)
    ]
    topics = {
        "/dvs/events": arrays(EVENTS, ros1=ros1), "/dvs/imu": samples, "/dvs/image_raw": images,
        "/rig/imu": samples[:1],
    }  # fmt: skip
    recording = open_recording(write_bag(tmp_path / "a.bag", ros1, topics))
    assert (recording.metadata["imu_samples"], recording.metadata["frames"]) == (4, 3)
    imu, frames = recording.imu, recording.frames
    assert imu is not None
    assert imu.t.tolist() == [1_000_000, 1_001_000, 1_002_000]
    assert imu.angular_velocity.tolist() == [
        [0.1, 0.2, 0.0],
        [0.1, 0.2, 1000.0],
        [0.1, 0.2, 2000.0],
    ]
    np.testing.assert_array_equal(
        imu.acceleration, [[np.nan] * 3, [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]]
    )
    assert frames is not None
    assert (frames.t.tolist(), frames.size) == ([1_000_000, 1_040_000, 1_080_000], (4, 5))
    for index in (0, 2, 1, 1, -1, 0):
        np.testing.assert_array_equal(frames[index], pixels[index], strict=True)
    save_recording(tmp_path / "out.h5", recording)
    assert_same_sensors(open_recording(tmp_path / "out.h5"), recording)


def test_what_a_bag_holds_but_cannot_be_read_is_counted(tmp_path: Path) -> None:
    store = typestore(True)
    sample, grey = imu_message(store, True, 0, (0.0, 0.0, 0.0)), np.zeros((2, 3), np.uint8)
    colour = image_message(store, True, 0, "bgr8", grey)
    topics = {
        "/e": arrays(EVENTS, ros1=True),
        "/a/imu": [sample],
        "/b/imu": [sample],
        "/image": [colour],
    }
    recording = open_recording(write_bag(tmp_path / "a.bag", True, topics))
    assert (recording.imu, recording.frames) == (None, None)
    notes = recording.metadata
    assert (
        notes["imu_note"]
        == "only counted: expected one topic of sensor_msgs/Imu; the topics are /a/imu, /b/imu"
    )
    assert str(notes["frames_note"]).startswith(
        "only counted: the images have the encoding 'bgr8', not one of mono8"
    )
    topics = {"/e": packets("evt3", EVENTS, ros1=True), "/imu": [sample], "/image": [colour]}
    recording = open_recording(write_bag(tmp_path / "b.bag", True, topics))
    assert "only counted: the events have the time of their sensor" in str(
        recording.metadata["imu_note"]
    )
    sizes = [image_message(store, True, t, "mono8", np.zeros((2, 3 + t), np.uint8)) for t in (0, 1)]
    topics = {"/e": arrays(EVENTS, ros1=True), "/image": sizes}
    recording = open_recording(write_bag(tmp_path / "c.bag", True, topics))
    assert "only counted: frames differ in size" in str(recording.metadata["frames_note"])


def test_mvsec(tmp_path: Path) -> None:
    write_mvsec(tmp_path / "a.hdf5", EVENTS)
    recording = open_recording(tmp_path / "a.hdf5")
    imu, frames = recording.imu, recording.frames
    assert imu is not None
    assert imu.t.tolist() == list(range(1_000_000, 1_007_000, 1000))
    assert imu.acceleration[1].tolist() == [6.0, 7.0, 8.0]
    assert imu.angular_velocity[1].tolist() == [9.0, 10.0, 11.0]
    assert frames is not None
    assert (frames.t.tolist(), frames.size) == ([1_000_000, 1_040_000, 1_080_000], (34, 26))
    expected = np.arange(3 * 26 * 34, dtype=np.uint16).reshape(3, 26, 34)
    for index in (2, 0, 1):
        np.testing.assert_array_equal(frames[index], expected[index], strict=True)
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        del file["davis/left/imu_ts"]
        file["davis/left/image_raw_ts"][2] = np.nan
    recording = open_recording(tmp_path / "a.hdf5")
    assert (recording.imu, recording.frames) == (None, None)
    assert recording.metadata["imu_note"] == "only counted: no dataset 'davis/left/imu_ts'"
    assert "only counted: a time is not finite" in str(recording.metadata["frames_note"])


def aedat2_sample(now: int, values: list[int]) -> bytes:
    words = [
        (1 << 31 | kind << 28 | (value & 0xFFFF) << 12 | 3 << 10, now)
        for kind, value in enumerate(values)
    ]
    return np.array(words, ">u4").tobytes()


def test_aedat2_samples_have_the_ranges_of_the_header(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = int(EVENTS.t[100])
    values = [4096, -8192, 100, 0, 328, -656, 131]
    # Blocks of few records, so that samples cross their ends; the last sample lacks a record.
    monkeypatch.setattr("amiwarp.io.aedat.aedat2.DEFAULT_BLOCK", 4)
    extra = aedat2_sample(now, values) * 3 + aedat2_sample(now, values[:6])
    write_aedat2(tmp_path / "a.aedat", EVENTS, between=extra)
    recording = open_recording(tmp_path / "a.aedat")
    assert (recording.metadata["imu_samples"], recording.metadata["imu_ranges"]) == (
        3, "assumed: 8 g and 1000 deg/s, the defaults of jAER",
    )  # fmt: skip
    imu = recording.imu
    assert imu is not None
    assert imu.t.tolist() == [now] * 3
    np.testing.assert_allclose(
        imu.acceleration[2], np.array([1.0, -2.0, 100 / 4096]) * G, rtol=1e-12
    )
    np.testing.assert_allclose(
        imu.angular_velocity[2], np.radians([10.0, -20.0, 131 / 32.8]), rtol=1e-12
    )
    settings = (
        b'# <entry key="DAVIS240C.IMU.AccelScale" value="ImuAccelScaleG16"/>\r\n'
        b'# <entry key="Davis346blue.IMU.AccelScale" value="ImuAccelScaleG2"/>\r\n'
        b'# <entry key="ImuGyroScale" value="GyroFullScaleDegPerSec250"/>\r\n'
    )
    head, _, rest = (tmp_path / "a.aedat").read_bytes().partition(b"blue\r\n")
    (tmp_path / "b.aedat").write_bytes(head + b"blue\r\n" + settings + rest)
    recording = open_recording(tmp_path / "b.aedat")
    assert recording.imu is not None
    assert "imu_ranges" not in recording.metadata
    np.testing.assert_allclose(recording.imu.acceleration[0, 0], G / 4, rtol=1e-12)
    np.testing.assert_allclose(recording.imu.angular_velocity[0, 2], np.radians(1.0), rtol=1e-12)


def test_real_samples_of_a_davis240(data_dir: Path) -> None:
    recording = open_recording(data_dir / "aedat/aedat2_davis240_IMU_translBoxes.aedat")
    imu = recording.imu
    # The file ends within a sample, which is the 4834th.
    assert imu is not None
    assert len(imu) == recording.metadata["imu_samples"] == 4833
    assert imu.t[:2].tolist() == [294_976_899, 294_977_304]
    np.testing.assert_allclose(
        imu.acceleration[0], np.array([42, -4129, -111]) / 4096 * G, rtol=1e-12
    )
    np.testing.assert_allclose(
        imu.angular_velocity[0], np.radians(np.array([-117, -67, -1]) / 32.8), rtol=1e-12
    )
    assert np.linalg.norm(imu.acceleration, axis=1).mean() == pytest.approx(G, abs=0.1)  # m/s^2
    with head_only(1000):
        assert open_recording(data_dir / "aedat/aedat2_davis240_IMU_translBoxes.aedat").imu is None


def test_real_frames_and_samples_of_a_davis346(data_dir: Path, tmp_path: Path) -> None:
    recording = open_recording(data_dir / "aedat/aedat4_davis346_cars.aedat4")
    imu, frames = recording.imu, recording.frames
    assert imu is not None
    assert (len(imu), int(imu.t[0])) == (160, 1_589_163_147_369_190)
    np.testing.assert_allclose(
        imu.acceleration[0], np.array([0.02758789, -0.9951172, 0.2590332]) * G, rtol=1e-6
    )
    np.testing.assert_allclose(
        imu.angular_velocity[0], np.radians([0.7781982, -0.5187988, -0.01525879]), rtol=1e-6
    )
    assert frames is not None
    assert frames.size == (346, 260)
    assert np.diff(frames.t).tolist() == [40_000] * 3
    assert frames[0][0, :3].tolist() == [78, 75, 79]
    assert [int(frames[index].sum()) for index in (3, 0, 2)] == [6_941_188, 6_949_660, 6_961_512]
    convert(data_dir / "aedat/aedat4_davis346_cars.aedat4", tmp_path / "out.h5")
    assert_same_sensors(open_recording(tmp_path / "out.h5"), recording)


def test_real_samples_of_a_dvxplorer(data_dir: Path) -> None:
    recording = open_recording(data_dir / "aedat/aedat4_dvxplorerlite_320x240.aedat4")
    imu = recording.imu
    assert imu is not None
    assert (len(imu), recording.frames) == (475, None)
    assert np.linalg.norm(imu.acceleration, axis=1).mean() == pytest.approx(G, rel=0.1)


@pytest.mark.parametrize("name", MODELS)
def test_true_angles_of_every_optic_are_described_in_degrees(name: str) -> None:
    angles = [each.name for each in MODELS[name].PARAMETERS if each.unit == "rad"]
    truth = Truth(dict.fromkeys(angles, 0.01))
    data = describe(Recording(MemoryEvents(EVENTS, *SIZE), truth=truth), "a.h5")
    assert data["truth"] == {f"{angle}_deg": pytest.approx(0.5729578) for angle in angles}


def test_info_shows_both(tmp_path: Path) -> None:
    whole = Recording(
        MemoryEvents(EVENTS, *SIZE), imu=make_imu(2001), frames=make_images(np.uint16)
    )
    save_recording(tmp_path / "a.h5", whole)
    data = describe(open_recording(tmp_path / "a.h5"), "a.h5")
    fastest = np.degrees(np.nanmax(np.linalg.norm(make_imu(2001).angular_velocity, axis=1)))
    assert data["imu"] == {
        "samples": 2001, "rate_hz": 2000.0, "first_us": 1_000_000, "last_us": 2_000_000,
        "fastest_deg_s": pytest.approx(fastest), "to_camera": None,
    }  # fmt: skip
    assert data["frames"] == {
        "count": 5, "rate_hz": 25.0, "width": 9, "height": 7, "first_us": 1_000_000, "last_us": 1_160_000,
    }  # fmt: skip
    rows = dict(table_rows(data))
    assert rows["IMU"] == "2,001 samples, 2000 Hz"
    assert (
        rows["gyroscope"]
        == f"1.000 s, up to {fastest:.0f} deg/s; axes in the camera's frame unknown"
    )
    flipped = replace(whole, imu=replace(make_imu(2001), to_camera=np.diag([-1.0, 1.0, -1.0])))
    assert dict(table_rows(describe(flipped, "a.h5")))["gyroscope"].endswith(
        "camera's x, y, z = its -x, y, -z"
    )
    assert rows["frames"] == "5 of 9 x 7 px, 25 Hz"
    assert refusal(open_recording, tmp_path / "missing.h5") is not None


def test_samples_of_jaer_start_where_seven_records_follow() -> None:
    for numbers, starts in (
        (range(7), [0]),
        (range(6), []),
        ([3, *range(7), 0, 1], [1]),
        ([0, *range(7)] * 2, [1, 9]),
    ):
        assert aedat2_imu._starts(np.array(numbers)).tolist() == starts


def test_samples_of_aedat3(tmp_path: Path) -> None:
    """With six and nine axes; invalid samples and those of another source are left out, the overflow is added."""
    rng = np.random.default_rng(3)
    values = rng.normal(size=(5, 6)).astype("<f4")
    packets_of = []
    for kind, width, source, rows in ((3, 9, 1, [0, 1]), (3, 9, 2, [2]), (4, 12, 1, [3, 4])):
        words = np.zeros((len(rows), width), "<u4")
        words[:, 0] = [row != 4 for row in rows]  # the last one is invalid
        words[:, 1] = 1_000_000 + 1000 * np.array(rows)
        words[:, 2:8] = values[rows].view("<u4")
        packets_of.append(aedat3_packet(kind, words, overflow=kind == 4, source=source))
    write_aedat3(tmp_path / "a.aedat", EVENTS, between=b"".join(packets_of))
    recording = open_recording(tmp_path / "a.aedat")
    imu = recording.imu
    assert imu is not None
    assert imu.t.tolist() == [1_000_000, 1_001_000, 1_003_000 + (1 << 31)]
    kept = values[[0, 1, 3]].astype(float)
    np.testing.assert_allclose(imu.angular_velocity, np.radians(kept[:, 3:]), rtol=1e-12)
    np.testing.assert_allclose(imu.acceleration, kept[:, :3] * G, rtol=1e-12)
    assert "imu_note" not in recording.metadata


def test_axes_are_read_and_named() -> None:
    davis = read_axes("-x, y, -z")
    np.testing.assert_array_equal(davis, np.diag([-1.0, 1.0, -1.0]))
    assert axes_in_words(davis) == "-x, y, -z"
    turned = read_axes("0,0,-1,1,0,0,0,-1,0")
    np.testing.assert_array_equal(turned, read_axes("-z,x,-y"))
    assert axes_in_words(turned) == "-z, x, -y"
    beside = Rotation.from_rotvec([0.0, 0.0, np.radians(4.0)]).as_matrix() @ turned
    assert axes_in_words(beside) == "-z, x, -y, 4 deg beside them"
    assert len({axes_in_words(each) for each in orientations()}) == 24
    for text in ("x,y", "x,y,w", "1,2,3", "1,0,0,0,1,0,0,0,a"):
        with pytest.raises(AmiwarpError, match="names no axes"):
            read_axes(text)
