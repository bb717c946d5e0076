"""JSON from untrusted sources: whatever the file holds, the message names the file and the field."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amiwarp import AmiwarpError, Calibration, Camera, FlatSide, load_camera
from amiwarp.calib import Preset
from amiwarp.io.json_files import MOST_BYTES, read_json
from amiwarp.schema.records import value_of
from amiwarp.simulation import open_pictures

READERS: dict[str, Callable[[Path], Any]] = {
    "calibration": Calibration.load,
    "preset": lambda path: Preset.load(path, "calibration"),
    "camera": lambda path: load_camera(path, (4, 3)),
    "any": lambda path: read_json(path, "a file"),
}

NO_JSON: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "is not JSON"),
    "cut off": (b'{"format": ', "is not JSON"),
    "binary": (b"\x89HDF\r\n\x1a\n\x00", "not UTF-8"),
    "latin-1": ('{"a": "\xe9"}'.encode("latin-1"), "byte 7 is not UTF-8"),
    "UTF-16": ('{"a": 1}'.encode("utf-16"), "not UTF-8"),
    "NaN": (b'{"format": NaN}', "holds NaN"),
    "Infinity": (b'{"format": [1, -Infinity]}', "holds -Infinity"),
    "beyond float64": (b'{"format": 1e400}', "'1e400', beyond the largest float64"),
    "5000 digits": (b'{"format": ' + b"9" * 5000 + b"}", "is not JSON: .*digits"),
    "deep lists": (b'{"a":' + b"[" * 200_000, "nests too deeply"),
    "deep objects": (b'{"a":' * 200_000, "nests too deeply"),
    "a list": (b"[1, 2]", r"holds \[1, 2\]; expected an object"),
    "a number": (b"3", "holds 3; expected an object"),
    "null": (b"null", "holds None; expected an object"),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", NO_JSON)
def test_what_is_no_json_object(tmp_path: Path, reader: str, kind: str) -> None:
    content, message = NO_JSON[kind]
    path = tmp_path / "c.json"
    path.write_bytes(content)
    with pytest.raises(AmiwarpError, match=rf"(?s)c\.json: .*{message}") as caught:
        READERS[reader](path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("reader", READERS)
def test_files_that_cannot_be_read(tmp_path: Path, reader: str) -> None:
    with pytest.raises(AmiwarpError, match=r"none\.json: no such file"):
        READERS[reader](tmp_path / "none.json")
    folder = tmp_path / "folder.json"
    folder.mkdir()
    with pytest.raises(AmiwarpError, match=r"folder\.json: is a folder"):
        READERS[reader](folder)
    with open(tmp_path / "large.json", "wb") as file:
        file.truncate(1 << 30)  # a sparse file, which takes no room on the disk
    with pytest.raises(AmiwarpError, match=rf"large\.json: is larger than {MOST_BYTES >> 20} MiB"):
        READERS[reader](tmp_path / "large.json")


def put(value: Any, *keys: str | int) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        for key in keys[:-1]:
            data = data[key]
        data[keys[-1]] = value

    return change


def drop(*keys: str | int) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        for key in keys[:-1]:
            data = data[key]
        del data[keys[-1]]

    return change


DAMAGE = [
    (drop("model"), "field model is missing"),
    (drop("seconds"), "field seconds is missing"),
    (put(1, "comment"), "field comment is unknown"),
    (put(1, "ca\x1b[1mera"), "is unknown"),
    (put("sphere", "model"), "field model is 'sphere'; choose among circle, exact"),
    (put(["exact"], "model"), "field model is"),
    (put([], "parameters"), r"field parameters is \[\]; expected an object"),
    (drop("parameters", "phase"), "field parameters.phase is missing"),
    (put({"value": 1.0, "free": True}, "parameters", "focal"), "field parameters.focal is unknown"),
    (
        put("1", "parameters", "phase", "value"),
        "field parameters.phase.value = '1' is not a finite number",
    ),
    (put(True, "parameters", "phase", "value"), "field parameters.phase.value = True"),
    (
        put(1, "parameters", "phase", "free"),
        "field parameters.phase.free is 1; expected true or false",
    ),
    (
        put("deg", "parameters", "phase", "unit"),
        "field parameters.phase.unit is 'deg'; expected rad",
    ),
    (put(-1.0, "parameters", "phase", "std"), "field parameters.phase.std = -1.0"),
    (put(1e300, "parameters", "phase", "value"), "phase = 1e[+]300"),
    (put(0.5, "camera", "width"), "camera width = 0.5"),
    (drop("camera", "cy"), "field camera.cy is missing"),
    (put(1, "camera", "focal"), "field camera.focal is unknown"),
    (
        put({"kind": "barrel"}, "camera", "distortion"),
        "field camera.distortion.kind is 'barrel'; choose among",
    ),
    (
        put({"kind": "fisheye", "k9": 1}, "camera", "distortion"),
        "field camera.distortion.k9 is unknown",
    ),
    (put([1], "camera", "distortion"), r"field camera.distortion is \[1\]"),
    (
        put("sideways", "prism", "flat_side"),
        "prism flat_side is 'sideways'; choose among scene, camera",
    ),
    (put(3.0, "prism", "apex_rad"), "prism apex = 3.0"),
    (put("much", "sharpness", "after"), "field sharpness.after = 'much'"),
    (put("loud", "sharpness", "kind"), "field sharpness.kind is 'loud'; choose among variance"),
    (put(2**63, "zero_us"), "field zero_us = 9223372036854775808"),
    (put(0.5, "zero_us"), "field zero_us = 0.5"),
    (put("few", "events"), "field events = 'few'"),
    (put("one", "warnings"), "field warnings is 'one'; expected a list"),
    (put([1], "warnings"), r"field warnings\[0\] is 1; expected text"),
    (put([{"name": "x"}], "stages"), r"field stages\[0\].algorithm is missing"),
    (
        put([[]], "stages", 0, "points"),
        r"field stages\[0\].points\[0\] is \[\]; expected an object",
    ),
    (put([{"apex": "x"}], "stages", 0, "points"), r"field stages\[0\].points\[0\].apex = 'x'"),
    (put(3, "photometric"), "field photometric is 3; expected an object"),
    (
        put("yes", "photometric", "accepted"),
        "field photometric.accepted is 'yes'; expected true or false",
    ),
    (put([None], "photometric", "held"), r"field photometric.held\[0\] is None; expected text"),
    (put({}, "ladder"), "field ladder.budget_px is missing"),
    (
        put([0.1], "ladder", "rungs", 0, "seen_px"),
        r"field ladder.rungs\[0\].seen_px has 1 entries; expected 2",
    ),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGE, ids=[message for _, message in DAMAGE])
def test_damage_in_a_calibration_is_named(
    calibration: Calibration, tmp_path: Path, damage: Callable[[Any], None], message: str
) -> None:
    path = tmp_path / "c.json"
    data = json.loads(json.dumps(calibration.to_json()))
    damage(data)
    path.write_text(json.dumps(data))
    with pytest.raises(AmiwarpError, match=rf"c\.json: .*{message}"):
        Calibration.load(path)


def leaves(value: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """Return the paths of all values within a JSON value; of a list only those of its first entry."""
    inner: list[tuple[str | int, Any]] = []
    if isinstance(value, dict):
        inner = list(value.items())
    elif isinstance(value, list) and value:
        inner = [(0, value[0])]
    return [place for key, entry in inner for place in [(*path, key), *leaves(entry, (*path, key))]]


@settings(max_examples=200)
@given(data=st.data())
def test_any_value_in_any_place(
    calibration: Calibration, tmp_path: Path, data: st.DataObject
) -> None:
    path = tmp_path / "c.json"
    content = json.loads(json.dumps(calibration.to_json()))
    place = data.draw(st.sampled_from(leaves(content)))
    value = data.draw(
        st.sampled_from(
            [None, True, -1, 0, 1e308, -1e308, 2**70, "", "x", [], {}, [[]], {"a": None}, [1, 2, 3]]
        )
        | st.recursive(
            st.none() | st.integers() | st.text(max_size=3),
            lambda s: st.lists(s, max_size=3),
            max_leaves=4,
        )
    )
    put(value, *place)(content)
    path.write_text(json.dumps(content))
    said = "c.json"
    try:
        Calibration.load(path)
    except AmiwarpError as error:
        said = str(error)
    assert "c.json" in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"width": 4}, "field height is missing"),
        ({"width": 4, "height": 3, "fx": "3", "fy": 3, "cx": 1, "cy": 1}, "camera fx = '3'"),
        (
            {"width": 4, "height": 3, "fx": 3, "fy": 3, "cx": 1, "cy": 1, "lens": 1},
            "field lens is unknown",
        ),
        ({"camera": 3}, "field camera is 3; expected an object"),
        ({"camera": {"width": 4}}, "field camera.height is missing"),
    ],
)
def test_damage_in_a_camera_is_named(tmp_path: Path, data: dict[str, Any], message: str) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(data))
    with pytest.raises(AmiwarpError, match=rf"camera\.json: .*{message}"):
        load_camera(path, (4, 3))


def test_a_camera_s_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    plain = {"width": 4, "height": 3, "fx": 3, "fy": 3.5, "cx": 1, "cy": 1}
    for data in (plain, {"camera": plain, "format": "amiwarp-calibration"}):
        path.write_text(json.dumps(data))
        assert load_camera(path, (9, 9)) == Camera(4, 3, 3.0, 3.5, 1.0, 1.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "has 0 numbers"),
        (b"1 2 3", "has 3 numbers"),
        (b"1 2 3 4 5 6 7 8 nan", "finite"),
        (b"a b c d e f g h i", "could not convert"),
        (b"\xff\xfe", "decode"),
        (b"1e300 2 3 4 0 0 0 0 0", "camera fx = 1e[+]300"),
        (b"200 200 3 4 1e300 0 0 0 0", "distortion k1 = 1e[+]300"),
    ],
)
def test_damage_in_calib_txt_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "calib.txt"
    path.write_bytes(content)
    with pytest.raises(AmiwarpError, match=rf"calib\.txt: .*{message}"):
        load_camera(path, (240, 180))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"file,t_us\na.png,0\nb.png,x\n", "line 3: t_us is 'x'"),
        (b"file,t_us\na.png,0\nb.png,nan\n", "line 3: t_us is 'nan'"),
        (b"file,t_us\na.png,0\nb.png,1e300\n", "line 3: t_us is '1e300'"),
        (b"file,t_us\na.png,0\nb.png\n", "line 3 has no t_us"),
        (b"file,t_us\na.png,0\n,1\n", "line 3 has no file"),
        (b"name,time\na.png,0\n", "line 2 has no file"),
        (b"file,t_us\n\xff\xfe,0\n", "decode"),
        (b"file,t_us\n" + b"a" * 200_000 + b",0\n", "field limit"),
    ],
)
def test_damage_in_times_csv_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "times.csv").write_bytes(content)
    with pytest.raises(AmiwarpError, match=rf"times\.csv: .*{message}"):
        open_pictures(tmp_path)
    with open(tmp_path / "times.csv", "wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(AmiwarpError, match=r"times\.csv: .*larger than 64 MiB"):
        open_pictures(tmp_path)


def test_a_calibration_comes_back_whole(calibration: Calibration, tmp_path: Path) -> None:
    calibration.save(tmp_path / "c.json")
    again = Calibration.load(tmp_path / "c.json")
    assert again == calibration
    assert all(isinstance(x, float) and math.isfinite(x) for x in again.parameters.values())


def test_a_choice_is_read_as_a_member(tmp_path: Path) -> None:
    assert value_of(FlatSide, "camera", "side") is FlatSide.CAMERA
    with pytest.raises(AmiwarpError, match="field side is 'top'"):
        value_of(FlatSide, "top", "side")
