"""Recorded rigs: a folder of recordings with rig.json, frames with colour and exposure, and depth maps."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import amiwarp
from amiwarp import AmiwarpError, Camera, Events, MemoryEvents, MemoryImages, Recording, RigSensor

CAMERA = Camera.from_fov(6, 4, 1.0)
EVENTS = Events.from_arrays(x=[1, 5, 2], y=[0, 3, 1], t=[10, 20, 400], p=[1, 0, 1])
NO_EVENTS = MemoryEvents(EVENTS[:0], 6, 4)
TIMES = np.array([100, 300])
EXPOSURE = np.array([[50, 150], [250, 350]])


def pose(degrees: tuple[float, float, float], position: tuple[float, float, float]) -> Any:
    return np.column_stack(
        [Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), position]
    )


def colours(dtype: Any = np.uint8) -> MemoryImages:
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (2, 4, 6, 3), endpoint=True)
    return MemoryImages(TIMES, pixels.astype(dtype), EXPOSURE)


def depths() -> MemoryImages:
    maps = np.random.default_rng(1).uniform(0.5, 9.0, (2, 4, 6)).astype(np.float32)
    maps[0, 0, 0] = np.inf
    maps[1, 2, 3] = np.nan
    return MemoryImages(TIMES, maps)


def make_rig() -> amiwarp.RigRecording:
    rgb_d = Recording(NO_EVENTS, CAMERA, frames=colours(), depth=depths())
    return amiwarp.RigRecording(
        {
            "left": RigSensor(
                "events", Recording(EVENTS, CAMERA), pose((1, 2, 3), (-0.05, 0, 0.01))
            ),
            "rgb-d": RigSensor("depth", rgb_d, pose((5, -3, 90), (0.1, 0.02, -0.01))),
        },
        {"world": "room", "seed": 3},
    )


def same_images(given: Any, expected: Any) -> None:
    np.testing.assert_array_equal(given.t, expected.t, strict=True)
    np.testing.assert_array_equal(np.stack(list(given)), np.stack(list(expected)), strict=True)
    assert given.size == expected.size


def test_a_saved_rig_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    rig = make_rig()
    amiwarp.save_rig(tmp_path / "rig", rig)
    assert sorted(path.name for path in (tmp_path / "rig").iterdir()) == [
        "left.h5",
        "rgb-d.h5",
        "rig.json",
    ]
    for place in (tmp_path / "rig", tmp_path / "rig/rig.json"):
        back = amiwarp.open_rig(place)
        assert (back.name, dict(back.metadata)) == ("rig", {"world": "room", "seed": 3})
        assert list(back.sensors) == ["left", "rgb-d"]
        for name, sensor in rig.sensors.items():
            np.testing.assert_array_equal(back[name].to_rig, sensor.to_rig, strict=True)
            assert back[name].kind is sensor.kind
            assert back[name].recording.camera == CAMERA
        assert back["left"].recording.events[:].t.tolist() == [10, 20, 400]
        rgb_d = back["rgb-d"].recording
        assert len(rgb_d.events) == 0
        same_images(rgb_d.frames, colours())
        same_images(rgb_d.depth, depths())
        assert rgb_d.frames is not None
        np.testing.assert_array_equal(rgb_d.frames.exposure, EXPOSURE, strict=True)
        np.testing.assert_array_equal(rgb_d.frames[1:].exposure, EXPOSURE[1:], strict=True)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_frames_follow_a_recording_through_conversions_and_filters(
    tmp_path: Path, dtype: Any
) -> None:
    recording = Recording(EVENTS, CAMERA, frames=colours(dtype), depth=depths())
    amiwarp.save_recording(tmp_path / "a.h5", recording)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["frames/image"].shape == (2, 4, 6, 3)
        assert (file["frames/depth"].dtype, file["frames/exposure"].dtype) == ("f4", "i8")
    amiwarp.convert(tmp_path / "a.h5", tmp_path / "b.h5", codec="gzip")
    back = amiwarp.open_recording(tmp_path / "b.h5")
    same_images(back.frames, colours(dtype))
    same_images(back.depth, depths())
    late = amiwarp.EventFilter(window=(200, 500))
    summary = amiwarp.filter_recording(back, tmp_path / "c.h5", late)
    assert summary.removed_records == {"frames": 1, "depth_maps": 1}
    kept = amiwarp.open_recording(tmp_path / "c.h5")
    same_images(kept.frames, colours(dtype)[1:])
    same_images(kept.depth, depths()[1:])
    left_out = amiwarp.convert(tmp_path / "a.h5", tmp_path / "d.npz").left_out
    assert {"frames", "depth maps"} <= set(left_out)


def test_between_turns_points_of_one_sensor_into_the_frame_of_another() -> None:
    rig = make_rig()
    point = np.array([0.3, -0.2, 2.0, 1.0])
    in_rig = rig["rgb-d"].to_rig @ point
    there = rig.between("rgb-d", "left") @ point
    np.testing.assert_allclose(rig["left"].to_rig @ [*there, 1.0], in_rig, rtol=0, atol=1e-12)  # m
    back = rig.between("left", "rgb-d") @ [*there, 1.0]
    np.testing.assert_allclose(back, point[:3], rtol=0, atol=1e-12)  # m


def test_a_rig_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def write_unsorted() -> None:
        with amiwarp.RigWriter(tmp_path) as rig:
            left = rig.add("left", "events", np.eye(3, 4), width=6, height=4)
            right = rig.add("right", "events", np.eye(3, 4), width=6, height=4)
            left.append(EVENTS)
            right.append(EVENTS)
            right.append(EVENTS)

    with pytest.raises(AmiwarpError, match="earlier than the one before"):
        write_unsorted()
    assert list(tmp_path.iterdir()) == []


def test_existing_files_are_kept_without_overwrite(tmp_path: Path) -> None:
    rig = make_rig()
    (tmp_path / "rgb-d.h5").write_bytes(b"mine")
    with pytest.raises(AmiwarpError, match=r"rgb-d\.h5: exists"):
        amiwarp.save_rig(tmp_path, rig)
    assert [path.name for path in tmp_path.iterdir()] == ["rgb-d.h5"]
    amiwarp.save_rig(tmp_path, rig, overwrite=True)
    with pytest.raises(AmiwarpError, match=r"rig\.json: exists"):
        amiwarp.save_rig(tmp_path, rig)
    del rig
    assert list(amiwarp.open_rig(tmp_path).sensors) == ["left", "rgb-d"]


def _set(*keys: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        inner = data
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("format", value="other"), r"rig\.json: .*field format is 'other'"),
        (_set("format_version", value=2), "format_version 2 is newer than 1; update"),
        (_set("sensors", value={}), "a rig has no sensors"),
        (_set("sensors", "left", "kind", value="sound"), r"sensors\.left\.kind.*events, frames"),
        (_set("sensors", "left", "kind", value="depth"), r"field sensors\.left.*has no depth"),
        (_set("sensors", "left", "file", value="../left.h5"), r"sensors\.left\.file is '\.\./left"),
        (_set("sensors", "left", "file", value="a\\left.h5"), "expected the name of a file in the"),
        (_set("sensors", "left", "file", value="none.h5"), r"none\.h5: no such file"),
        (_set("sensors", "left", "to_rig", value=[[1.0]]), r"sensors\.left.*shape \(1, 1\)"),
        (_set("sensors", "left", "to_rig", value=[[1.0], []]), r"rows of \[1, 0\] numbers"),
        (
            _set("sensors", "left", "to_rig", value=(-np.eye(3, 4)).tolist()),
            "no rotation matrix",
        ),
        (_set("sensors", "a b", value={}), "field sensors.a b.kind is missing"),
        (_set("metadata", "list", value=[1]), r"metadata\.list"),
    ],
)
def test_damage_is_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], message: str
) -> None:
    amiwarp.save_rig(tmp_path, make_rig())
    path = tmp_path / "rig.json"
    data = json.loads(path.read_text())
    data["sensors"]["left"]["note"] = data["of a later version"] = 1
    path.write_text(json.dumps(data))
    assert list(amiwarp.open_rig(tmp_path).sensors) == ["left", "rgb-d"]
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(AmiwarpError, match=message):
        amiwarp.open_rig(tmp_path)


def test_wrong_frames_are_refused(tmp_path: Path) -> None:
    grey = np.zeros((4, 6), np.uint8)
    metres = np.ones((4, 6), np.float32)
    wrong: dict[str, dict[str, Any]] = {
        "give an image, a depth map or both": {},
        r"frame is uint8 of shape \(4, 6, 4\)": {"image": np.zeros((4, 6, 4), np.uint8)},
        "frame is float32": {"image": metres},
        r"depth is float64 of shape \(4, 6\)": {"depth": metres.astype(float)},
        r"depth has shape \(4, 5\); expected \(4, 6\)": {"image": grey, "depth": metres[:, :5]},
        "not above 0 m": {"depth": 0 * metres},
        "from 10 to 19 us does not hold the time of its frame, 20": {
            "image": grey,
            "exposure_us": (10, 19),
        },
        "from 21 to 30 us does not hold": {"image": grey, "exposure_us": (21, 30)},
    }
    with amiwarp.RecordingWriter(tmp_path / "a.h5", width=6, height=4) as writer:
        for message, arguments in wrong.items():
            with pytest.raises(AmiwarpError, match=message):
                writer.append_image(20, **arguments)
        writer.append_image(20, grey, exposure_us=(20, 20), depth=metres)
        with pytest.raises(AmiwarpError, match="append the same in each call"):
            writer.append_image(30, grey)
        with pytest.raises(AmiwarpError, match=r"earlier ones are uint8 of \(4, 6\)"):
            writer.append_image(30, np.zeros((4, 6, 3), np.uint8))
    with pytest.raises(AmiwarpError, match="exposure 1 from 50 to 60 us"):
        MemoryImages(TIMES, np.zeros((2, 4, 6), np.uint8), np.array([[50, 150], [50, 60]]))
    later = MemoryImages(TIMES + 1, np.ones((2, 4, 6), np.float32))
    unequal = Recording(NO_EVENTS, CAMERA, frames=colours(), depth=later)
    with pytest.raises(AmiwarpError, match="frames and depth maps have other times"):
        amiwarp.save_recording(tmp_path / "b.h5", unequal)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("frames/image", np.zeros((2, 4, 6, 4), np.uint8), "grey or RGB"),
        ("frames/image", np.zeros((2, 4), np.uint8), "expected a 3 or 4-dimensional one"),
        ("frames/depth", np.ones((2, 4, 6)), "frames/depth is float64"),
        ("frames/depth", np.ones((1, 4, 6), np.float32), r"'frames/depth' has shape \(1, 4, 6\)"),
        ("frames/exposure", EXPOSURE[:1], r"'frames/exposure' has shape \(1, 2\)"),
        ("frames/exposure", EXPOSURE + 60, "does not hold the time"),
    ],
)
def test_damaged_frames_are_named(
    tmp_path: Path, name: str, values: np.ndarray, message: str
) -> None:
    path = tmp_path / "a.h5"
    amiwarp.save_recording(path, Recording(EVENTS, CAMERA, frames=colours(), depth=depths()))
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = values
    with pytest.raises(AmiwarpError, match=message):
        amiwarp.open_recording(path)


def test_names_of_sensors_are_names_of_files() -> None:
    sensor = make_rig()["left"]
    for name in ("", "../a", "a.b", "ä", "a" * 65, "-a"):
        with pytest.raises(AmiwarpError, match="give a name of at most 64 letters"):
            amiwarp.RigRecording({name: sensor})
    with pytest.raises(AmiwarpError, match="has no sensor 'right'; choose among left, rgb-d"):
        make_rig().between("left", "right")
