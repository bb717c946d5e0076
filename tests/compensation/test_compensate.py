"""Compensation of recordings: no event is lost or reordered, and positions are those of the model."""

import contextlib
import json
import math
import struct
import sys
from dataclasses import replace
from math import tau as TWO_PI
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import warp as wp
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    CircleModel,
    CompensationSummary,
    Encoder,
    Events,
    ExactModel,
    Fisheye,
    FlatSide,
    ImuSamples,
    MemoryEvents,
    MemoryImages,
    Poses,
    Prism,
    RadialTangential,
    Recording,
    compensate,
    compensate_events,
    convert,
    edge_blur,
    iwe,
    open_recording,
    save_recording,
    sharpness,
    truth_model,
)
from amiwarp.events.recording import inside_image
from amiwarp.io import Evt3Encoder, read_encoder_csv
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.ros.bags import PACKET_DEFINITION, opened_bag
from amiwarp.kernels.encoder_pieces import encoder_params
from amiwarp.kernels.launch import launch
from amiwarp.kernels.prism_angle import EncoderParams, theta_u32_at
from amiwarp.optics import MODELS, rungs
from reference import optics as oracle
from reference.calibration_sample import exact_calibration
from reference.io_samples_extra import array_message, typestore
from tests.command_line import app
from tests.conftest import TRUE_PRISM


@wp.kernel
def angles(
    encoder: EncoderParams, t: wp.array(dtype=wp.int64), start: int, out: wp.array(dtype=wp.uint32)
):
    i = start + wp.tid()
    out[i] = theta_u32_at(encoder, t[i])


def angle_error(encoder: Encoder, t: np.ndarray, device: str) -> float:
    """Return the largest difference between the kernel's angle and the encoder's in float64 [turn]."""
    params = encoder_params(encoder, int(t.min()), int(t.max()), device)
    out = wp.empty(len(t), dtype=wp.uint32, device=device)
    launch(
        angles, len(t), [params, wp.array(t, dtype=wp.int64, device=device)], [out], device=device
    )
    away = encoder.angle_at(t) / TWO_PI - out.numpy() / 2.0**32
    return float(np.abs(away - np.round(away)).max())


@pytest.fixture(scope="module")
def exact(recording: Recording) -> Calibration:
    """The true model of the recording."""
    assert recording.camera is not None
    assert recording.truth is not None
    values = {
        name: recording.truth.parameters.get(name, 0.0)
        for name in ("apex", "index", "phase", "tilt_x", "tilt_y")
    }
    return exact_calibration(recording.camera, TRUE_PRISM, values)


EPOCH = 1_700_000_000_000_000


@pytest.mark.parametrize("offset", [0.0, -1234.75, 0.5, 1e6 + 0.75])
@pytest.mark.parametrize(
    ("interval", "turns_per_s"),
    [((1000, 1001), 50.0), ((1, 2000), -12.0), ((1, 4), 300.0), ((10**7, 10**8), 100.0)],
)
def test_angle_of_the_kernel(
    interval: tuple[int, int], turns_per_s: float, offset: float, device: str
) -> None:
    """Even and uneven samples, close and far apart, fractional clock offset, present-day times, unsorted events."""
    rng = np.random.default_rng(5)
    times = EPOCH + np.cumsum(rng.integers(*interval, 3000))
    angle = (times - times[0]) * (TWO_PI * turns_per_s * 1e-6) + np.cumsum(
        rng.normal(0.0, 0.01, times.size)
    )
    encoder = Encoder(times, angle, offset)
    first, last = encoder.coverage
    at_samples = np.clip(times + np.round(-offset).astype(int), first, last)
    t = np.concatenate(
        [rng.integers(first, last + 1, 50_000), at_samples, at_samples[1:] - 1, [first, last]]
    )
    # There are at most 1e7 turns here; float64 itself resolves these to 2**-28.
    assert angle_error(encoder, t, device) < 2.0**-26
    some = t[(t > first + (last - first) // 3) & (t < last - (last - first) // 3)]
    assert angle_error(encoder, some, device) < 2.0**-26


def test_angle_where_samples_crowd_and_jump(device: str) -> None:
    """Thousands of samples in one bucket, a gap of an hour, steps of many turns; only two samples."""
    times = np.concatenate([np.arange(5000), [3_600_000_000, 3_600_000_001, 7_200_000_000]]).astype(
        np.int64
    )
    angle = np.random.default_rng(2).normal(0.0, 300.0, times.size)
    encoder = Encoder(times, angle)
    t = np.concatenate([times[:-1], np.linspace(0, 7_200_000_000, 5001).astype(np.int64)])
    # Float64 itself: 1e9 us times a slope of 1e-15
    assert angle_error(encoder, t, device) < 2.0**-26
    two = Encoder(np.array([7, 7_000_007]), np.array([1.0, -4000.0]), 0.3)
    assert angle_error(two, np.arange(-1000, 7_001_000, 997), device) < 2.0**-30


def test_events_without_an_angle_are_refused(device: str) -> None:
    encoder = Encoder.constant_speed(600.0, 1000, 100_000)
    first, last = encoder.coverage
    for t in ([first - 1, 2000], [2000, last + 1]):
        with pytest.raises(AmiwarpError, match="outside the encoder"):
            encoder_params(encoder, *t, device)
        events = Events.from_arrays([1, 2], [1, 2], t, [0, 1])
        with pytest.raises(AmiwarpError, match="outside the encoder"):
            compensate_events(
                events, CircleModel(Camera.from_fov(64, 48, 1.0), 0.02), encoder, device=device
            )


LENSES = (None, RadialTangential(-0.2, 0.05, 1e-4, -1e-4, 0.0), Fisheye(0.05, 0.01, 0.0, 0.0))


@pytest.mark.parametrize("lens", LENSES, ids=["pinhole", "radial-tangential", "fisheye"])
@pytest.mark.parametrize("name", list(rungs()))
def test_places_are_the_models(
    name: str, lens: RadialTangential | Fisheye | None, device: str
) -> None:
    """One pass over the columns gives the positions of compensate_points and of a float64 trace."""
    rng = np.random.default_rng(3)
    camera = replace(Camera.from_fov(320, 240, math.radians(60.0)), distortion=lens)
    model = MODELS[name].from_prism(camera, TRUE_PRISM, 0.4)
    n = 40_007
    t = np.sort(rng.integers(0, 400_000, n))
    events = Events.from_arrays(
        rng.integers(0, 320, n), rng.integers(0, 240, n), t, rng.integers(0, 2, n)
    )
    encoder = Encoder.constant_speed(-900.0, 0, 400_000)
    moved = compensate_events(events, model, encoder, device=device)
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    expected = model.compensate_points(xy, encoder.angle_at(t))
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-3)
    if name == "exact":
        some = slice(0, 3000)
        traced = oracle.move(
            camera, TRUE_PRISM, xy[some], encoder.angle_at(t[some]), to_scene=True, phase=0.4
        )
        np.testing.assert_allclose(moved[some], traced, rtol=0, atol=1e-3)


def test_events_outside_the_camera_do_not_leave_its_tables(device: str) -> None:
    model = MODELS["ellipse"].from_prism(Camera.from_fov(64, 48, 1.0), TRUE_PRISM)
    events = Events.from_arrays([65_535, 3], [65_535, 3], [10, 20], [0, 1])
    moved = compensate_events(events, model, Encoder.constant_speed(600.0, 0, 1000), device=device)
    assert np.abs(moved[0] - 65_535).max() < 20.0
    assert (
        len(
            compensate_events(
                Events.empty(), model, Encoder.constant_speed(600.0, 0, 1000), device=device
            )
        )
        == 0
    )


def test_places_agree_with_the_stored_truth(recording: Recording, device: str) -> None:
    """The ground truth is the scene point at the threshold crossing. Time stamps are 0.1 ms late."""
    assert recording.truth is not None
    assert recording.encoder is not None
    events = recording.events.slice(0, 100_000)
    truth = truth_model(recording.camera, recording.truth, FlatSide.SCENE)
    moved = compensate_events(events, truth, recording.encoder, device=device)
    d = np.linalg.norm(moved - recording.truth.points(0, 100_000), axis=1)
    assert np.sqrt(np.nanmean(d**2)) < 0.12  # px: 130 us at 75 rad/s on an orbit of 9 px


def test_file_keeps_time_polarity_and_order(
    recording: Recording, calibration: Calibration, tmp_path: Path, device: str
) -> None:
    done = []
    summary = compensate(
        recording,
        calibration,
        tmp_path / "out.h5",
        device=device,
        progress=lambda _, share: done.append(share),
    )
    raw = recording.events.slice(0, len(recording.events))
    out = open_recording(tmp_path / "out.h5")
    moved = out.events.slice(0, len(out.events))
    assert summary.events == len(raw)
    assert done[-1] == 1.0
    np.testing.assert_array_equal(moved.t, raw.t)
    np.testing.assert_array_equal(moved.p, raw.p)
    assert recording.encoder is not None
    expected = compensate_events(raw, calibration.model, recording.encoder, device=device)
    np.testing.assert_array_equal(np.stack([moved.x, moved.y], axis=1), expected)
    outside = ~inside_image(*expected.T, *recording.events.size)
    assert summary.outside == outside.sum() > 0
    np.testing.assert_array_equal(out.events.inside(0, len(raw)), ~outside)
    assert list(tmp_path.iterdir()) == [tmp_path / "out.h5"]


def test_times_that_do_not_begin_at_the_first_event_are_kept(
    recording: Recording, calibration: Calibration, tmp_path: Path
) -> None:
    """Other programs may count times from another instant. Encoded times are then not copied."""
    save_recording(tmp_path / "a.h5", recording)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        index = file["ms_to_idx"][()]
        index = np.concatenate([np.zeros(7, index.dtype), index])
        del file["ms_to_idx"]
        file["ms_to_idx"] = index
        file["events/t"][...] = file["events/t"][()] + 7000
        file["t_offset"][()] -= 7000
    given = open_recording(tmp_path / "a.h5")
    compensate(given, calibration, tmp_path / "out.h5", device="cpu")
    out = open_recording(tmp_path / "out.h5").events
    np.testing.assert_array_equal(out.slice(0, len(out)).t, recording.events.slice(0, len(out)).t)


def test_compensation_sharpens(recording: Recording, calibration: Calibration) -> None:
    width, height = recording.events.size
    raw = recording.events.slice(0, len(recording.events))
    before = iwe(raw, width, height)
    after = iwe(raw, width, height, model=calibration.model, encoder=recording.encoder)
    assert sharpness(after, smoothing=1.0) > 1.5 * sharpness(before, smoothing=1.0)
    assert recording.encoder is not None
    places = compensate_events(raw, calibration.model, recording.encoder)
    blur = edge_blur(places, width, height)
    was = edge_blur(places, width, height, of=np.stack([raw.x, raw.y], axis=1).astype(np.float32))
    assert blur < was / 3


def test_files_and_memory_give_the_same(
    recording: Recording,
    calibration: Calibration,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    device: str,
) -> None:
    """A file that threads decode without HDF5, a file that HDF5 reads, and events in memory; in several pieces."""
    monkeypatch.setattr(sys.modules["amiwarp.compensation.recordings"], "PIECE", CHUNK)
    count = len(recording.events)
    raw = recording.events.slice(0, count)
    repeats = 2 * CHUNK // count + 1
    step = int(raw.t[-1] - raw.t[0]) + 1
    encoder = Encoder.constant_speed(720.0, int(raw.t[0]), int(raw.t[0]) + (repeats + 1) * step)
    many = Events.concatenate(
        [Events(raw.x, raw.y, raw.t + k * step, raw.p) for k in range(repeats + 1)]
    )
    memory = replace(
        recording, events=MemoryEvents(many, *recording.events.size), truth=None, encoder=encoder
    )
    save_recording(tmp_path / "ours.h5", memory)
    expected = compensate_events(
        many, calibration.model, calibration.encoder_for(encoder, 0, 0), device=device
    )
    with h5py.File(tmp_path / "ours.h5") as ours, h5py.File(tmp_path / "plain.h5", "w") as plain:
        for name in (
            "events/x",
            "events/y",
            "events/t",
            "events/p",
            "encoder/t",
            "encoder/angle",
            "t_offset",
        ):
            plain[name] = ours[name][()]
        plain.attrs.update(ours.attrs)
    for name, source in (
        ("memory", memory),
        ("ours", open_recording(tmp_path / "ours.h5")),
        ("plain", open_recording(tmp_path / "plain.h5")),
    ):
        blocks: list[Events] = []
        summary = compensate(
            source, calibration, tmp_path / f"{name}-out.h5", device=device, on_block=blocks.append
        )
        moved = open_recording(tmp_path / f"{name}-out.h5").events.slice(0, len(many))
        assert summary.events == len(many) > 2 * CHUNK, name
        for events in (moved, Events.concatenate(blocks)):
            np.testing.assert_array_equal(np.stack([events.x, events.y], axis=1), expected, name)
            np.testing.assert_array_equal(events.t, many.t)
            np.testing.assert_array_equal(events.p, many.p)
    with h5py.File(tmp_path / "ours.h5") as ours, h5py.File(tmp_path / "ours-out.h5") as out:
        for name in ("events/t", "events/p"):  # copied as they are stored, the last chunk too
            for at in range(0, len(many), CHUNK):
                assert out[name].id.read_direct_chunk((at,)) == ours[name].id.read_direct_chunk(
                    (at,)
                ), name
            np.testing.assert_array_equal(out[name][()], ours[name][()], strict=True)


def test_a_fault_in_the_middle_of_a_file_leaves_nothing(
    recording: Recording, calibration: Calibration, tmp_path: Path
) -> None:
    save_recording(tmp_path / "in.h5", replace(recording, truth=None))
    at = len(recording.events) * 2 // 3
    with h5py.File(tmp_path / "in.h5", "r+") as file:
        file["events/x"][at] = 60_000
    with pytest.raises(AmiwarpError, match=f"event {at} .* outside the 200x150 frame"):
        compensate(open_recording(tmp_path / "in.h5"), calibration, tmp_path / "out.h5")
    assert list(tmp_path.iterdir()) == [tmp_path / "in.h5"]


def test_a_native_file_gets_the_calibrated_camera_and_what_is_still_true(
    recording: Recording, exact: Calibration, tmp_path: Path
) -> None:
    imu = ImuSamples(np.array([0, 1000]), np.zeros((2, 3)), np.ones((2, 3)))
    poses = Poses(np.array([0, 1000]), np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1)))
    width, height = recording.events.size
    frames = MemoryImages(np.array([500]), np.zeros((1, height, width), np.uint8))
    assert recording.truth is not None
    assert exact.camera != (better := replace(exact.camera, fx=500.0, fy=500.0))
    given = replace(recording, imu=imu, frames=frames, truth=replace(recording.truth, poses=poses))
    calibration = replace(exact, parameters={**exact.parameters, "focal_length": 500.0})
    out = tmp_path / "out.h5"
    assert compensate(given, calibration, out).left_out == ("ground truth of events", "frames")
    found = open_recording(out)
    assert found.camera == better
    assert found.imu is not None
    np.testing.assert_array_equal(found.imu.acceleration, imu.acceleration)
    assert found.truth is not None
    assert found.truth.poses is not None
    np.testing.assert_array_equal(found.truth.poses[:].camera, poses.camera)
    assert found.frames is None


def test_empty_recording(recording: Recording, calibration: Calibration, tmp_path: Path) -> None:
    empty = replace(
        recording, events=MemoryEvents(Events.empty(), *recording.events.size), truth=None
    )
    summary = compensate(empty, calibration, tmp_path / "empty.h5")
    assert summary.events == 0
    assert len(open_recording(tmp_path / "empty.h5").events) == 0


def test_another_camera_is_refused(
    recording: Recording, calibration: Calibration, tmp_path: Path
) -> None:
    events = recording.events.slice(0, 10)
    small = replace(recording, events=MemoryEvents(events, 400, 300), camera=None, truth=None)
    with pytest.raises(AmiwarpError, match="400x300"):
        compensate(small, calibration, tmp_path / "out.h5")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_leaves_nothing(
    recording: Recording, calibration: Calibration, tmp_path: Path
) -> None:
    def interrupt(_what: str, _share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compensate(recording, calibration, tmp_path / "out.h5", progress=interrupt)
    assert list(tmp_path.iterdir()) == []


FORMATS = {
    # file: (format, rounding)
    "out.npz": (None, None),
    "out.txt": (None, None),
    "round.npz": (None, "nearest"),
    "round.txt": (None, "dithered"),
    "out.csv": (None, None),
    "out.raw": (None, "dithered"),
    "evt21.raw": ("evt21", "nearest"),
    "out.dat": (None, "nearest"),
    "out.aedat4": (None, "nearest"),
    "dsec.h5": ("dsec", "dithered"),
    "out.bag": (None, "nearest"),
    "out.mcap": (None, "nearest"),
    "out.db3": (None, "dithered"),
}


def events_of(path: Path) -> list[np.ndarray]:
    source = open_recording(path).events
    events = source.slice(0, len(source))
    return [events.x, events.y, events.t, events.p]


@pytest.fixture(scope="module")
def turn(recording: Recording) -> Recording:
    """One turn of the shared recording."""
    events = recording.events.between(0, 84_000)
    return replace(recording, events=MemoryEvents(events, *recording.events.size))


@pytest.fixture(scope="module")
def native(
    turn: Recording, exact: Calibration, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, CompensationSummary]:
    """The turn compensated into the native format, and its summary."""
    path = tmp_path_factory.mktemp("native") / "native.h5"
    blocks: list[Events] = []
    summary = compensate(turn, exact, path, on_block=blocks.append)
    assert sum(map(len, blocks)) == summary.events
    return path, summary


@pytest.mark.parametrize("file", ["again.h5", "again.npz"])
def test_compensated_recordings_are_not_compensated_again(
    exact: Calibration, native: tuple[Path, CompensationSummary], tmp_path: Path, file: str
) -> None:
    with pytest.raises(
        AmiwarpError, match=r"^native: its events are already compensated; give the sensor's events"
    ):
        compensate(open_recording(native[0]), exact, tmp_path / file)


@pytest.mark.parametrize("file", FORMATS)
def test_other_formats_hold_what_the_native_one_holds(
    turn: Recording,
    exact: Calibration,
    native: tuple[Path, CompensationSummary],
    tmp_path: Path,
    file: str,
) -> None:
    """Compensated into a format, or into the native one and converted, with any size of the blocks."""
    chosen, rounding = FORMATS[file]
    options = {"format": chosen, "rounding": rounding, "seed": 4}
    blocks: list[Events] = []
    path, summary = native
    found = compensate(turn, exact, tmp_path / file, on_block=blocks.append, **options)
    (tmp_path / "converted").mkdir()
    converted = convert(path, tmp_path / "converted" / file, **options)
    assert (found.events, found.outside) == (summary.events, summary.outside)
    assert sum(map(len, blocks)) == summary.events
    assert (found.rounding, found.dropped) == (rounding, converted.dropped)
    assert found.events - found.dropped == converted.events
    assert (found.dropped > 0) == (rounding is not None)
    assert found.format == converted.format
    assert found.left_out == ("encoder", "camera", "prism", "ground truth", "metadata")
    ours, theirs = events_of(tmp_path / file), events_of(tmp_path / "converted" / file)
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(a, b)
    expected = events_of(path)
    if rounding == "nearest":
        x, y = (np.floor(values.astype(np.float64) + 0.5) for values in expected[:2])
        kept = (x >= 0) & (x < 200) & (y >= 0) & (y < 150)
        expected = [x[kept], y[kept], expected[2][kept], expected[3][kept]]
    if rounding != "dithered":
        for a, b in zip(ours, expected, strict=True):
            np.testing.assert_allclose(
                a, b, rtol=0, atol=1e-6 if file in ("out.txt", "out.csv") else 0
            )


def test_a_format_of_whole_pixels_needs_rounding(
    recording: Recording, exact: Calibration, tmp_path: Path
) -> None:
    with pytest.raises(
        AmiwarpError, match=r"out\.raw: .*give --round \(rounding= in Python\) nearest or dithered"
    ):
        compensate(recording, exact, tmp_path / "out.raw")
    with pytest.raises(
        AmiwarpError, match=r"out\.h5: rounding is dithered, but the native format holds sub-pixels"
    ):
        compensate(recording, exact, tmp_path / "out.h5", rounding="dithered")
    assert list(tmp_path.iterdir()) == []


def test_the_codec_of_compensated_recordings(
    recording: Recording, exact: Calibration, tmp_path: Path
) -> None:
    compensate(recording, exact, tmp_path / "a.h5")
    compensate(recording, exact, tmp_path / "b.h5", codec="gzip")
    with h5py.File(tmp_path / "b.h5") as file:
        assert file["events/x"].compression == "gzip"
    for a, b in zip(events_of(tmp_path / "a.h5"), events_of(tmp_path / "b.h5"), strict=True):
        np.testing.assert_array_equal(a, b)


HOST_NS = 1_700_000_000_123_456_789
"""Time of the computer at time 0 of the camera [ns]."""

DELAY_NS = 4_000_000
"""Time from the first event of a message to its recording [ns]."""


def write_bag(path: Path, events: Events) -> None:
    """Write a bag as a robot records it: events, and messages of other topics, among them an unknown type."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    latched = Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, QosTime(0, 0), QosTime(1, 2),
        QosLiveliness.AUTOMATIC, QosTime(3, 4), False,
    )  # fmt: skip
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(PACKET_DEFINITION, "event_camera_msgs/msg/EventPacket"))
    store.register(get_types_from_msg("float64[] values\nstring name", "rig_msgs/msg/State"))
    kinds = store.types
    storage = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    messages: list[tuple[int, str, Any]] = []
    coder = Evt3Encoder(0)
    for number, packet in enumerate(MemoryEvents(events, 200, 150).blocks(duration_us=3_000)):
        t = int(packet.t[0]) * 1000
        stamp = kinds["builtin_interfaces/msg/Time"](*divmod(HOST_NS + t, 10**9))
        header = kinds["std_msgs/msg/Header"](stamp, "camera")
        words = coder.encode(packet, self_contained=True).view(np.uint8)
        message = kinds["event_camera_msgs/msg/EventPacket"](
            header, 150, 200, number, 0, "evt3", False, words
        )
        messages.append((HOST_NS + DELAY_NS + t, "/cam/events", message))
    for number in range(40):
        state = kinds["rig_msgs/msg/State"](np.arange(number, dtype=np.float64), "é" * number)
        messages.append((HOST_NS + 7_000_000 * number, "/rig/state", state))
    messages.append((HOST_NS - 5, "/note", kinds["std_msgs/msg/String"]("a calibration")))
    with Writer(path.with_suffix(""), version=9, storage_plugin=storage) as writer:
        topics = {
            topic: writer.add_connection(
                topic, message.__msgtype__, typestore=store,
                offered_qos_profiles=[latched] if topic == "/note" else [],
            )
            for topic, message in {topic: message for _, topic, message in messages}.items()
        }  # fmt: skip
        for t, topic, message in sorted(messages, key=lambda one: one[0]):
            writer.write(topics[topic], t, store.serialize_cdr(message, message.__msgtype__))
    next(path.with_suffix("").glob(f"*{path.suffix}")).rename(path)


def bag_of_rosbags(path: Path) -> tuple[dict[str, Any], dict[str, list[tuple[int, bytes]]]]:
    """Return the topics of a bag, and the messages of each."""
    with opened_bag(str(path)) as (bag, _):
        topics = {one.topic: (one.msgtype, one.msgdef, one.ext) for one in bag.connections}
        found: dict[str, list[tuple[int, bytes]]] = {topic: [] for topic in topics}
        for one, t, raw in bag.messages(connections=bag.connections):
            found[one.topic].append((t, bytes(raw)))
    return topics, found


@pytest.mark.parametrize("target", ["out.mcap", "out.db3"])
@pytest.mark.parametrize("source", ["in.mcap", "in.db3"])
def test_a_bag_is_compensated_and_keeps_its_other_topics(
    recording: Recording, exact: Calibration, tmp_path: Path, source: str, target: str
) -> None:
    from rosbags.highlevel import AnyReader

    events, encoder = recording.events.slice(0, 60_000), recording.encoder
    assert encoder is not None
    write_bag(tmp_path / source, events)
    exact.save(tmp_path / "calibration.json")
    rows = [
        f"{t},{angle!r}"
        for t, angle in zip(encoder.t, np.degrees(encoder.angle).tolist(), strict=True)
    ]
    (tmp_path / "encoder.csv").write_text("\n".join(["t_us,angle_deg", *rows]))
    before = (tmp_path / source).read_bytes()
    line = [
        "compensate",
        source,
        target,
        "--calibration",
        "calibration.json",
        "--encoder",
        "encoder.csv",
        "--json",
    ]
    with contextlib.chdir(tmp_path):
        result = CliRunner().invoke(app, [*line, "--round", "nearest"])
        assert result.exit_code == 0, result.stderr
    data = json.loads(result.stdout)
    xy = np.floor(
        compensate_events(events, exact.model, read_encoder_csv(tmp_path / "encoder.csv"))
        + np.float64(0.5)
    )
    kept = (xy[:, 0] >= 0) & (xy[:, 0] < 200) & (xy[:, 1] >= 0) & (xy[:, 1] < 150)
    assert (data["events"], data["dropped"], data["rounding"]) == (
        len(events),
        (~kept).sum(),
        "nearest",
    )
    assert data["left_out"] == ["encoder"]
    assert (tmp_path / source).read_bytes() == before
    topics, messages = bag_of_rosbags(tmp_path / source)
    out_topics, out_messages = bag_of_rosbags(tmp_path / target)
    assert out_topics.keys() == topics.keys()
    for topic in ("/rig/state", "/note"):
        assert out_messages[topic] == messages[topic]
        assert out_topics[topic] == topics[topic]
    found = open_recording(tmp_path / target)
    assert found.metadata["topic"] == "/cam/events"
    x, y, t, p = events_of(tmp_path / target)
    np.testing.assert_array_equal(np.stack([x, y], axis=1), xy[kept])
    np.testing.assert_array_equal(t, events.t[kept])
    np.testing.assert_array_equal(p, events.p[kept])
    # Messages keep the clock of the computer.
    at = 0
    with AnyReader([tmp_path / target]) as reader:
        for connection, recorded, raw in reader.messages(
            [one for one in reader.connections if "cam" in one.topic]
        ):
            packet = reader.deserialize(raw, connection.msgtype)
            stamp = packet.header.stamp.sec * 10**9 + packet.header.stamp.nanosec
            assert (recorded, stamp) == (
                HOST_NS + DELAY_NS + 1000 * int(t[at]),
                HOST_NS + 1000 * int(t[at]),
            )
            at += int(np.count_nonzero(packet.events.view("<u2") >> 12 == 2))
    assert at == len(t)


def test_compensate_says_what_it_subtracts_from_times_since_1970(
    exact: Calibration, tmp_path: Path
) -> None:
    first = 1_700_000_000_000_000
    events = Events.from_arrays([20, 30], [40, 50], [first, first + 20], [1, 0])
    save_recording(tmp_path / "a.h5", Recording(MemoryEvents(events, 200, 150)))
    exact.save(tmp_path / "calibration.json")
    (tmp_path / "encoder.csv").write_text(f"t_us,angle_deg\n{first - 100},0.0\n{first + 100},1.0\n")
    line = [
        "compensate",
        "a.h5",
        "a.mcap",
        "--calibration",
        "calibration.json",
        "--encoder",
        "encoder.csv",
    ]
    with contextlib.chdir(tmp_path):
        result = CliRunner().invoke(app, [*line, "--round", "nearest"])
    assert result.exit_code == 0, result.stderr
    assert f"note: the times begin at 0: {first:,} us are subtracted" in " ".join(
        result.stdout.split()
    )
    assert open_recording(tmp_path / "a.mcap").events.t_first == 0


def test_a_real_bag_is_compensated(data_dir: Path, tmp_path: Path) -> None:
    """It has no prism: one without deflection leaves every event in place. Its triggers are the encoder."""
    source = data_dir / "rosbag/ros2_evt3_640x480_trig10Hz.db3"
    camera = Camera.from_fov(640, 480, 1.0)
    values = {"apex": 1e-9, "index": 1.5, "phase": 0.0, "tilt_x": 0.0, "tilt_y": 0.0}
    exact_calibration(camera, Prism(1e-9), values).save(tmp_path / "calibration.json")
    line = [
        "compensate",
        source,
        tmp_path / "out.mcap",
        "--calibration",
        tmp_path / "calibration.json",
    ]
    options = ["--encoder-from", "triggers:6", "--round", "nearest"]
    result = CliRunner().invoke(app, [str(word) for word in [*line, *options]])
    assert result.exit_code == 0, result.stderr
    text = " ".join(result.stdout.split())
    assert "rounded to whole pixels (nearest); 0 events outside are dropped" in text
    assert "leaves out: encoder, triggers" in text
    for a, b in zip(events_of(tmp_path / "out.mcap"), events_of(source), strict=True):
        np.testing.assert_array_equal(a, b)
    given, found = (
        bag_of_rosbags(path)[1]["/event_camera/events"] for path in (source, tmp_path / "out.mcap")
    )
    assert (found[0][0], found[-1][0]) == (given[0][0], given[-1][0])


def test_other_topics_are_named_if_they_are_left_out(
    recording: Recording, exact: Calibration, tmp_path: Path
) -> None:
    write_bag(tmp_path / "in.mcap", recording.events.slice(0, 5000))
    opened = replace(open_recording(tmp_path / "in.mcap"), encoder=recording.encoder)
    found = compensate(opened, exact, tmp_path / "out.npz")
    assert found.left_out == ("encoder", "other topics", "metadata")
    assert convert(tmp_path / "in.mcap", tmp_path / "out.raw").left_out == (
        "other topics",
        "metadata",
    )
    assert convert(tmp_path / "in.mcap", tmp_path / "copy.db3").left_out == ()
    assert (
        bag_of_rosbags(tmp_path / "copy.db3")[1]["/note"]
        == bag_of_rosbags(tmp_path / "in.mcap")[1]["/note"]
    )


def test_a_ros_1_bag_keeps_its_other_topics_and_clocks(
    recording: Recording, tmp_path: Path
) -> None:
    """Messages of two publishers of one topic, one of them latched, and of an unknown type."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import get_types_from_msg

    events = recording.events.slice(0, 20_000)
    late = 3_000_000_000_123_456_789  # ns: beyond 2038, which a time with a sign does not hold
    store = typestore(True)
    store.register(get_types_from_msg("float64[] values\nstring name", "rig_msgs/msg/State"))
    kinds = store.types
    given: list[tuple[int, int]] = []
    with Writer(tmp_path / "in.bag") as writer:
        event_topic = writer.add_connection(
            "/dvs/left/events", "dvs_msgs/msg/EventArray", typestore=store
        )
        notes = [
            writer.add_connection(
                "/note", "std_msgs/msg/String", typestore=store, callerid=name, latching=latching
            )
            for name, latching in (("/rig", 1), ("/user", 0), (None, None))
        ]
        state_topic = writer.add_connection("/rig/state", "rig_msgs/msg/State", typestore=store)
        for number, connection in enumerate(notes):
            text = store.serialize_ros1(
                kinds["std_msgs/msg/String"](f"note {number}"), "std_msgs/msg/String"
            )
            writer.write(connection, late - 5 + number, text)
        for number, packet in enumerate(MemoryEvents(events, 200, 150).blocks(duration_us=3_000)):
            message = array_message(store, packet, ros1=True)
            stamp = late + 1000 * int(packet.t[0])
            raw = bytearray(store.serialize_ros1(message, message.__msgtype__))
            struct.pack_into("<II", raw, 4, *divmod(stamp, 10**9))  # rosbags takes no such seconds
            writer.write(event_topic, stamp + DELAY_NS, bytes(raw))
            given.append((stamp + DELAY_NS, stamp))
            state = kinds["rig_msgs/msg/State"](np.arange(number, dtype=np.float64), "é" * number)
            writer.write(
                state_topic,
                late + 7_000_000 * number,
                store.serialize_ros1(state, state.__msgtype__),
            )
    summary = convert(tmp_path / "in.bag", tmp_path / "out.bag", size=(200, 150))
    assert (summary.events, summary.left_out) == (len(events), ())
    assert open_recording(tmp_path / "out.bag").metadata["topic"] == "/dvs/left/events"
    for a, b in zip(
        events_of(tmp_path / "out.bag"), (events.x, events.y, events.t, events.p), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    seen = []
    for name in ("in.bag", "out.bag"):
        with opened_bag(str(tmp_path / name)) as (bag, _):
            others = [one for one in bag.connections if "events" not in one.topic]
            seen.append(
                [
                    (one.topic, one.msgtype, one.digest, one.msgdef, one.ext, t, bytes(raw))
                    for one, t, raw in bag.messages(connections=others)
                ]
            )
            arrays = [one for one in bag.connections if "events" in one.topic]
            clocks = [
                (t, seconds * 10**9 + rest)
                for _, t, raw in bag.messages(connections=arrays)
                for seconds, rest in [struct.unpack_from("<II", raw, 4)]
            ]
            assert clocks == given
    assert len(seen[0]) == len(given) + 3
    assert sorted(seen[1], key=repr) == sorted(seen[0], key=repr)
    assert "other topics" in convert(tmp_path / "in.bag", tmp_path / "out.mcap").left_out


def test_inside_image_at_its_border() -> None:
    xy = np.array(
        [[-0.5, 0], [-0.51, 0], [9.49, 4.49], [9.5, 0], [0, 4.5], [np.nan, 0]], dtype=np.float32
    )
    np.testing.assert_array_equal(
        inside_image(*xy.T, 10, 5), [True, False, True, False, False, False]
    )


def test_total_reflection_is_marked_not_spread(recording: Recording, tmp_path: Path) -> None:
    """With this steep prism, part of the image has no ray: NaN positions are marked, and the image has no NaN."""
    assert recording.camera is not None
    assert recording.encoder is not None
    wide = replace(recording.camera, fx=30.0, fy=30.0)
    steep = ExactModel(wide, replace(TRUE_PRISM, apex=math.radians(25.0)))
    events = recording.events.slice(0, 50_000)
    places = compensate_events(events, steep, recording.encoder)
    assert np.isnan(places).any()
    image = iwe(events, *recording.events.size, model=steep, encoder=recording.encoder)
    assert np.isfinite(image).all()
    assert 0 < image.sum() < len(events)
