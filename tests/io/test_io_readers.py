"""Every format reads back exactly. Damage is repaired and counted, or refused with the file and the position."""

import os
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Camera,
    ConversionSummary,
    Encoder,
    ErrorCode,
    Events,
    EventSource,
    Format,
    MemoryEvents,
    OutputFormat,
    Prism,
    RadialTangential,
    convert,
    open_recording,
)
from amiwarp.io import detect_format
from amiwarp.io import file_scan as scan
from amiwarp.io.assumptions import smallest_sensor
from reference.io_samples import SIZE, WRITERS, make_events, refusal, write_evt, write_sample
from reference.io_samples_extra import write_evimo, write_mvsec
from tests.errors import refused

EVENTS = make_events()

REAL = {
    # file: (events, span [ms] to the published digits, size, other records)
    "evt/evt3_driving_1280x720.raw": (219_596, 8.8, (1280, 720), {}),
    "evt/evt2_balls_640x480.raw": (521_252, 95.9, (640, 480), {}),
    "aedat/aedat4_dvxplorerlite_320x240.aedat4": (111_954, 590, (320, 240), {"imu_samples": 475}),
    "aedat/aedat4_davis346_cars.aedat4": (
        6_676,
        170,
        (346, 260),
        {"frames": 4, "imu_samples": 160},
    ),
    "text/shapes_rotation/events.txt": (20_000, 98.6, (240, 180), {}),
    "text/dynamic_rotation/events.txt": (30_000, 21, (240, 180), {}),
    "text/slider_depth/events_chunk.txt": (50_000, 170, (240, 180), {}),
    "small/ncars.dat": (2_009, 100, (128, 128), {}),
    "aedat/aedat2_davis240_IMU_translBoxes.aedat": (
        162_771,
        2072.7,
        (240, 180),
        {"imu_samples": 4833},
    ),  # the file ends within one
    "rosbag/ros2_evt3_640x480_trig10Hz.db3": (378_266, 1799.1, (640, 480), {"triggers": 36}),
    "small/nmnist.bin": (4_325, 310.5, (34, 34), {}),
}


def assert_equal(given: Events, expected: Events) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(
            getattr(given, name), getattr(expected, name), err_msg=name, strict=True
        )


def assert_same_source(given: EventSource, expected: EventSource) -> None:
    assert (len(given), given.t_first, given.t_last) == (
        len(expected),
        expected.t_first,
        expected.t_last,
    )
    for got, wanted in zip(given.blocks(count=1000), expected.blocks(count=1000), strict=True):
        assert_equal(got, wanted)
    for got, wanted in zip(
        given.blocks(duration_us=700), expected.blocks(duration_us=700), strict=True
    ):
        assert_equal(got, wanted)
    middle = (given.t_first + given.t_last) // 2
    assert_equal(given.between(middle, middle + 1234), expected.between(middle, middle + 1234))
    n, first, last = len(expected), expected.t_first, expected.t_last
    for bounds in (31, 57), (0, 3), (0, 1), (7, 3), (n - 1, n), (n - 2, n + 5), (n, n + 5):
        assert_equal(given.slice(*bounds), expected.slice(*bounds))
    for bounds in (-5, -3), (-5, 3), (3, -5):
        with pytest.raises(AmiwarpError, match="has a negative index"):
            given.slice(*bounds)
    one = int(expected.slice(n // 2, n // 2 + 1).t[0])
    spans = (
        (first - 9, first),
        (first, first),
        (first, first + 1),
        (one, one),
        (one - 1, one),
        (one, one + 1),
    )
    for span in (
        *spans,
        (last, last),
        (last, last + 1),
        (last + 1, last + 9),
        (first - 9, last + 9),
    ):
        assert_equal(given.between(*span), expected.between(*span))


@pytest.mark.parametrize("file", REAL)
def test_real_files_to_the_exact_count(data_dir, tmp_path, file):
    count, span_ms, size, records = REAL[file]
    recording = open_recording(data_dir / file)
    source = recording.events
    assert (len(source), source.size) == (count, size)
    assert (source.t_last - source.t_first) / 1000 == pytest.approx(
        span_ms, abs=0.6 if span_ms > 99 else 0.06
    )
    expected = {"format": recording.metadata["format"], **records}
    if file.endswith((".txt", ".dat", ".bin")):  # which do not state the size
        expected["assumed_size"] = recording.metadata["assumed_size"]
        assert str(expected["assumed_size"]).startswith(f"{size[0]}x{size[1]}: ")
    assert {
        name: value for name, value in recording.metadata.items() if name != "topic"
    } == expected
    summary = convert(data_dir / file, tmp_path / "out.h5")
    assert (summary.events, summary.t_first, summary.t_last, summary.repairs) == (
        count,
        source.t_first,
        source.t_last,
        {},
    )
    assert_same_source(open_recording(tmp_path / "out.h5").events, source)


def test_real_text_has_its_camera(data_dir):
    camera = open_recording(data_dir / "text/shapes_rotation/events.txt").camera
    distortion = RadialTangential(
        -0.368436311798, 0.150947243557, -0.000296130534385, -0.000759431726241, 0.0
    )
    assert camera == Camera(
        240, 180, 199.092366542, 198.82882047, 132.192071378, 110.712660011, distortion
    )


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("keep", [True, False])
def test_every_format_reads_back(tmp_path, monkeypatch, name, keep):
    if not keep:
        monkeypatch.setattr(scan, "KEEP_EVENTS", 0)
    recording = open_recording(write_sample(tmp_path, name, EVENTS))
    assert recording.events.size == SIZE
    assert recording.metadata["format"] == WRITERS[name][0]
    assert recording.name == "sample"
    assert_same_source(recording.events, MemoryEvents(EVENTS, *SIZE))
    if name == "text":
        assert recording.camera == Camera(
            *SIZE, 200, 201, 150, 110, RadialTangential(-0.3, 0.1, 1e-4, -2e-4, 0.01)
        )


@pytest.mark.parametrize("name", ["t", "array", "a" * 200])
def test_a_file_is_named_also_if_its_name_is_a_word_of_the_error(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with open(name, "wb") as file:
        np.savez(file, x=[1], y=[0], t=[np.nan], p=[1])
    assert str(refusal(open_recording, Path(name))).startswith(
        (f"{name}: before the first event: ", f"{name[:100]}...")
    )


@pytest.mark.parametrize("name", ["text", "native"])
def test_changed_arrays_leave_the_recording_as_it_is(tmp_path, name):
    source = open_recording(write_sample(tmp_path, name, EVENTS)).events
    for given in (
        source[:],
        source[5:9],
        source.between(source.t_first, source.t_last),
        *source.blocks(),
    ):
        for values in (given.x, given.y, given.t, given.p):
            values[:] = 0
    assert_same_source(source, MemoryEvents(EVENTS, *SIZE))


@pytest.mark.parametrize("name", WRITERS)
def test_content_decides_not_the_ending(tmp_path, name):
    path = write_sample(tmp_path, name, EVENTS, ending="bin")
    assert len(open_recording(path).events) == len(EVENTS)
    assert (
        open_recording(path, format=detect_format(path).value).metadata["format"]
        == WRITERS[name][0]
    )


@pytest.mark.parametrize("name", WRITERS)
def test_truncated_files(tmp_path, name):
    path = write_sample(tmp_path, name, EVENTS)
    whole = path.read_bytes()
    for share in (0.0, 0.01, 0.3, 0.6, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        said = refusal(open_recording, path)
        if said is not None:
            assert str(path) in said
            assert "\n" not in said
            continue
        # Whole words are read. How much of the last word is lost depends on its position in the file.
        source = open_recording(path).events
        assert 0 < len(source) < len(EVENTS)
        assert_equal(source.slice(0, len(source) - 1), EVENTS[: len(source) - 1])
    assert os.listdir(tmp_path).count(path.name) == 1


@pytest.mark.parametrize("ending", ["raw", "dat", "aedat4", "es", "txt", "npz", "h5"])
@pytest.mark.parametrize(
    "content",
    [b"", b"\0" * 5000, b"\xff\xd8\xff\xe0JFIF", bytes(range(128, 144)) + b"\xfe" * 99, b"hello\n"],
)
def test_garbage_is_refused(tmp_path, ending, content):
    path = tmp_path / f"garbage.{ending}"
    path.write_bytes(content)
    with pytest.raises(
        AmiwarpError,
        match=f"garbage.{ending}: (is empty|is a JPEG picture|content is of no known format|is text, but line 1)",
    ):
        open_recording(path)
    for chosen in Format:
        with pytest.raises(AmiwarpError, match=f"garbage.{ending}"):
            open_recording(path, format=chosen)


def test_paths_and_formats_that_are_none(tmp_path):
    with refused(ErrorCode.FILE_MISSING):
        open_recording(tmp_path / "none.raw")
    with refused(ErrorCode.FILE_UNREADABLE):
        open_recording(tmp_path)
    with pytest.raises(AmiwarpError, match="format is 'wav'; choose among hdf5, evt"):
        open_recording(tmp_path / "none.raw", format="wav")
    (tmp_path / "old.aedat").write_bytes(b"#!AER-DAT1.0\r\n")
    with pytest.raises(AmiwarpError, match=r"is AEDAT 1\.0; only 2\.0, 3\.1 and 4 are read"):
        open_recording(tmp_path / "old.aedat")


def test_compensated_events_far_outside_do_not_count_for_the_size(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events/x"] = np.array([1.5, 639.6, np.nan, 3e9, -1e9], np.float32)
        file["events/y"] = np.array([1.5, 2.0, np.nan, 3e9, 70_000], np.float32)
        file["events/t"], file["events/p"] = np.arange(5), np.ones(5, np.uint8)
        file["events/inside"] = np.array([1, 1, 0, 0, 0], np.uint8)
    # 639.6 px lies on pixel 640
    assert open_recording(tmp_path / "a.h5").events.size == (
        1280,
        720,
    )


def test_a_file_without_a_size_gets_that_of_the_smallest_sensor_that_holds_it():
    sensors = [
        (128, 128), (132, 104), (240, 180), (304, 240), (320, 240), (346, 260), (320, 320), (640, 480), (640, 512),
        (1280, 720), (1280, 800), (1280, 960),
    ]  # fmt: skip
    for width, height in sensors:
        assert smallest_sensor(width - 1, height - 1) == (width, height)
    for x_max, size in [(0, (128, 128)), (128, (132, 104)), (132, (240, 180)), (240, (304, 240)), (304, (320, 240)),
                        (320, (346, 260)), (346, (640, 480)), (640, (1280, 720))]:  # fmt: skip
        assert smallest_sensor(x_max, 0) == size
    for y_max, size in [(128, (240, 180)), (260, (320, 320)), (320, (640, 480)), (480, (640, 512)), (512, (1280, 720)),
                        (720, (1280, 800)), (800, (1280, 960))]:  # fmt: skip
        assert smallest_sensor(0, y_max) == size
    assert smallest_sensor(1279, 960) == (1280, 961)
    assert smallest_sensor(1280, 719) == (1281, 720)


def write_lines(path: Path, lines: list[str]) -> Path:
    path.write_text("".join(line + "\n" for line in lines))
    return path


LINES = [f"{i * 1e-4:.6f} {i % 240} {i % 180} {i % 2}" for i in range(1000)]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0.03 nan 5 1", "line 301 is '0.03 nan 5 1'"),
        ("nan 5 5 1", "line 301"),
        ("0.03 5 5", "line 301"),
        ("0.03 5 5 1 9", "line 301"),
        ("0.03 5.5 5 1", "line 301"),
        ("0.03 5 5 2", "line 301"),
        ("1e300 5 5 1", "line 301"),
        ("0.03 1e99 5 1", "line 301"),
        ("t x y p", "line 301"),
        ("0.03 5 5 1\xff", "line 301"),
        ("7" * 5000, "line 301|longer than"),
    ],
)
def test_text_names_the_bad_line(tmp_path, monkeypatch, line, message):
    monkeypatch.setattr("amiwarp.io.text.reader.READ_BYTES", 1000)
    path = write_lines(tmp_path / "events.txt", [*LINES[:300], line, *LINES[300:]])
    with pytest.raises(AmiwarpError, match=f"events.txt: .*{message}"):
        open_recording(path)


def test_text_with_a_size_comments_and_no_last_newline(tmp_path):
    path = tmp_path / "events.txt"
    for head, size in (
        ("500 400\n# from a bench\n\n", (500, 400)),
        ("# a bench\n\n500 400\n", (500, 400)),
        ("# events\n", (240, 180)),
    ):
        path.write_text(head + "\n".join(LINES))
        source = open_recording(path).events
        assert (len(source), source.size) == (1000, size)
    path.write_text("500 -4\n" + "\n".join(LINES))
    with pytest.raises(AmiwarpError, match="line 1 '500 -4' is not a size"):
        open_recording(path)


@pytest.mark.parametrize("calib", ["1 2 3", "a", "nan 1 1 1 0 0 0 0 0", "-1 1 1 1 0 0 0 0 0", ""])
def test_bad_calibration_is_named(tmp_path, calib):
    path = write_lines(tmp_path / "events.txt", LINES)
    (tmp_path / "calib.txt").write_text(calib)
    with pytest.raises(AmiwarpError, match=r"calib\.txt"):
        open_recording(path)


def write_unsound(path: Path, name: str, events: Events) -> Path:
    """Write events out of order or outside the frame: DAT, text and npz allow this, faery's encoders do not."""
    if name == "dat":
        words = np.stack(
            [events.t, events.x | (events.y.astype(int) << 14) | (events.p.astype(int) << 28)],
            axis=1,
        )
        path.write_bytes(
            b"% Version 2\n% Width 320\n% Height 240\n\x0c\x08" + words.astype("<u4").tobytes()
        )
    elif name == "text":
        write_lines(
            path,
            [
                "320 240",
                *(
                    f"{t / 1e6:.6f} {x} {y} {p}"
                    for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True)
                ),
            ],
        )
    else:
        np.savez(path, x=events.x, y=events.y, t=events.t, p=events.p, width=320, height=240)
        os.replace(f"{path}.npz", path) if not path.exists() else None
    return path


@pytest.mark.parametrize("name", ["dat", "text", "npz"])
def test_few_faults_are_repaired_and_counted(tmp_path, name):
    t, x = EVENTS.t.copy(), EVENTS.x.copy()
    t[100], t[400] = t[100] - 5000, t[400] - 40
    x[50] = 320
    path = write_unsound(tmp_path / "faults", name, Events(x, EVENTS.y, t, EVENTS.p))
    recording = open_recording(path)
    assert recording.metadata["repaired_time_events"] == 2
    assert recording.metadata["dropped_outside_events"] == 1
    assert len(recording.events) == len(EVENTS) - 1
    events = recording.events.slice(0, len(EVENTS))
    expected = np.delete(np.maximum.accumulate(t), 50)
    np.testing.assert_array_equal(events.t, expected)
    summary = convert(path, tmp_path / "out.h5")
    most = int((np.maximum.accumulate(t) - t).max())
    assert summary.repairs == {
        "repaired_time_events": 2,
        "largest_time_repair_us": most,
        "dropped_outside_events": 1,
    }
    assert open_recording(tmp_path / "out.h5").metadata["repaired_time_events"] == 2


@pytest.mark.parametrize("name", ["dat", "text", "npz"])
def test_many_faults_are_refused(tmp_path, name):
    path = write_unsound(
        tmp_path / "backwards", name, Events(EVENTS.x, EVENTS.y, EVENTS.t[::-1].copy(), EVENTS.p)
    )
    with pytest.raises(AmiwarpError, match=r"backwards: \d+ of 600 events are out of order"):
        open_recording(path)
    path = write_unsound(
        tmp_path / "wide", name, Events(EVENTS.x + np.uint16(100), EVENTS.y, EVENTS.t, EVENTS.p)
    )
    with pytest.raises(
        AmiwarpError, match=r"wide: \d+ of 600 events lie outside the 320x240 frame"
    ):
        open_recording(path)


def test_pixels_that_no_sensor_has_are_named_without_a_size(tmp_path):
    path = tmp_path / "left.txt"
    path.write_text("".join(f"{k * 1e-3} {-2 - k} {k} 1\n" for k in range(20)))
    with pytest.raises(
        AmiwarpError, match=r"left.txt: 20 of 20 events lie outside pixels 0 .. 65535; the file"
    ):
        open_recording(path)


@pytest.mark.parametrize("start", [3_000_000_000, 2**32 - 200 * 15_000_000])
@pytest.mark.parametrize("back", [False, True], ids=["rising", "one step back over the end"])
@pytest.mark.parametrize("piece", [1, 7])
def test_dat_times_run_on_past_32_bits(tmp_path, monkeypatch, start, back, piece):
    monkeypatch.setattr("amiwarp.io.prophesee.dat.PIECE_EVENTS", piece)
    monkeypatch.setattr("amiwarp.io.decoding.CPU_RECORDS", 3)
    t = start + np.arange(0, 600) * 15_000_000
    if back:
        after = int(np.searchsorted(t, 2**32))
        t[after + 1 :] = np.maximum(t[after + 1 :], 2**32 + 100)
        t[after : after + 2] = 2**32 + 50, 2**32 - 50
    events = Events(EVENTS.x, EVENTS.y, t, EVENTS.p)
    path = write_unsound(tmp_path / "long.dat", "dat", events[:0])
    words = np.stack([t % 2**32, EVENTS.x | (EVENTS.y.astype(np.int64) << 14)], axis=1).astype(
        "<u4"
    )
    path.write_bytes(path.read_bytes() + words.tobytes() + b"\1\2\3")
    recording = open_recording(path)
    np.testing.assert_array_equal(recording.events.slice(0, 600).t, np.maximum.accumulate(t))
    assert recording.metadata["truncated_bytes"] == 3
    assert recording.metadata.get("repaired_time_events", 0) == back


@pytest.mark.parametrize(("version", "y_at", "p_at"), [("1", 9, 17), ("2", 14, 28)])
def test_dat_of_both_versions(tmp_path, version, y_at, p_at):
    """Bits above the polarity are of no meaning."""
    rng = np.random.default_rng(4)
    t = np.cumsum(rng.integers(0, 9, 50))
    x, y, p = rng.integers(0, 304, 50), rng.integers(0, 240, 50), rng.integers(0, 2, 50)
    rest = x | y << y_at | p << p_at | rng.integers(0, 8, 50) << p_at + 1
    path = tmp_path / "a.dat"
    path.write_bytes(
        f"% Version {version}\n".encode()
        + b"\x00\x08"
        + np.stack([t, rest], axis=1).astype("<u4").tobytes()
    )
    found = open_recording(path).events.slice(0, 50)
    for name, known in (("x", x), ("y", y), ("t", t), ("p", p)):
        np.testing.assert_array_equal(getattr(found, name), known)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"t": np.array([0, 1, 2, 3, np.inf])}, "times span .* inf us: not finite"),
        ({"t": np.array(list("abcde"))}, "array t is <U1; expected integers"),
        ({"x": np.full(5, np.nan)}, "array x is float64"),
        (
            {"y": np.arange(5.0)},
            "x is int64, y is float64; expected integers, or floating numbers for comp",
        ),
        (
            {"x": np.full(5, 1e300), "y": np.arange(5.0)},
            "x holds a coordinate that is too large for float32",
        ),
        ({"x": np.arange(4)}, "array x has shape"),
        ({"p": np.zeros((5, 1), int)}, "array p has shape"),
        ({"t": np.full(5, 2**63, np.uint64)}, "beyond int64"),
        ({"t": np.array([None] * 5)}, "pickle"),
        (
            {
                "x": np.zeros(0, int),
                "y": np.zeros(0, int),
                "t": np.zeros(0, int),
                "p": np.zeros(0, int),
            },
            "no events",
        ),
        ({"width": 0}, "size 0x9"),
    ],
)
def test_npz_refuses(tmp_path, arrays, message):
    good = {
        "x": np.arange(5),
        "y": np.arange(5),
        "t": np.arange(5),
        "p": np.zeros(5, int),
        "width": 9,
        "height": 9,
    }
    np.savez(tmp_path / "a.npz", **{**good, **arrays})
    with pytest.raises(AmiwarpError, match=f"a.npz.*{message}"):
        open_recording(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", x=np.arange(5), t=np.arange(5))
    with pytest.raises(AmiwarpError, match="no array y, p"):
        open_recording(tmp_path / "b.npz")


@pytest.mark.parametrize("write", [write_evimo, write_mvsec])
def test_fractions_of_pixels_are_not_cut_off(tmp_path, write):
    """Rows of these data sets are floating, also for whole pixels."""
    x = EVENTS.x.astype(np.float32)
    moved = replace(EVENTS, x=x, y=EVENTS.y.astype(np.float32))
    write(tmp_path / "whole", moved)
    (path,) = tmp_path.glob("whole*")
    assert_equal(open_recording(path).events.slice(0, 999), EVENTS)
    x[100] += 0.75
    write(tmp_path / "moved", moved)
    (path,) = tmp_path.glob("moved*")
    with pytest.raises(
        AmiwarpError, match=rf"moved.*: a coordinate is {x[100]:g}; expected whole pixels"
    ):
        open_recording(path)


def test_one_fraction_in_text_is_damage(tmp_path):
    lines = [f"{k * 1e-4:.6f} {k % 64} {k % 48} {k % 2}" for k in range(100)]
    lines[60] = "0.006000 12.7 5 1"
    write_lines(tmp_path / "a.txt", lines)
    with pytest.raises(AmiwarpError, match=r"a\.txt: line 61 is '0\.006000 12\.7 5 1'"):
        open_recording(tmp_path / "a.txt")


def test_fractions_in_text_are_read_block_by_block(tmp_path, monkeypatch):
    """What the first block shows holds for the whole file, also for a block of whole numbers."""
    monkeypatch.setattr("amiwarp.io.text.reader.READ_BYTES", 200)
    lines = [f"{k * 1e-4:.6f} {k / (8 if k < 90 else 1)} -0.25 1" for k in range(100)]
    write_lines(tmp_path / "a.txt", lines)
    events = open_recording(tmp_path / "a.txt").events.slice(0, 100)
    np.testing.assert_array_equal(
        events.x, np.float32([k / (8 if k < 90 else 1) for k in range(100)]), strict=True
    )
    np.testing.assert_array_equal(events.y, np.full(100, -0.25, np.float32), strict=True)
    write_lines(
        tmp_path / "b.txt", [*(f"{k * 1e-4:.6f} {k % 64} 5 1" for k in range(50)), *lines[50:]]
    )
    with pytest.raises(AmiwarpError, match=r"b\.txt: line 51 is '0\.005000 6\.25 -0\.25 1'"):
        open_recording(tmp_path / "b.txt")


def test_evt_headers(tmp_path):
    path = tmp_path / "a.raw"
    write_evt("evt2", dimensions=(1280, 720))(path, EVENTS)
    body = path.read_bytes()[path.read_bytes().rindex(b"% ") :]
    body = body[body.index(b"\n") + 1 :]
    for header, size in (
        (b"% evt 2.0\n% geometry 400x300\n", (400, 300)),
        (b"% evt 2.0\n% plugin_name hal_plugin_gen41_evk3\n", (1280, 720)),
        (b"% evt 2.0\n% plugin_name hal_plugin_gen3_fx3\n", (640, 480)),
        (b"% evt 2.0\n% plugin_name hal_plugin_gen31_fx3\n", (640, 480)),
        (b"% evt 2.0\n% plugin_name hal_plugin_gen4_fx3\n", (1280, 720)),
        (b"% evt 2.0\n% plugin_name hal_plugin_imx636_evk4\n", (1280, 720)),
        (b"% evt 2.0\n", (320, 240)),
    ):
        path.write_bytes(header + body + b"\1")
        recording = open_recording(path)
        assert (recording.events.size, recording.metadata["truncated_bytes"]) == (size, 1)
        assert_equal(recording.events.slice(0, 999), EVENTS)
    for header, message in (
        (b"% evt 9.0\n", "version in the header is '9.0'"),
        (b"% evt 2.0\n% t0 5.5\n", "t0 in the header is '5.5'; expected a time"),
        (b"% evt 2.0\n% geometry 10x10\n", "599 of 600 events lie outside the 10x10 frame"),
    ):
        path.write_bytes(header + body)
        with pytest.raises(AmiwarpError, match=f"a.raw: .*{message}"):
            open_recording(path)


def test_convert_puts_in_encoder_camera_and_prism(tmp_path):
    path = write_unsound(tmp_path / "events.npz", "npz", EVENTS)
    np.savez(path, x=EVENTS.x % 200, y=EVENTS.y % 150, t=EVENTS.t, p=EVENTS.p)
    t = np.arange(990_000, 1_020_000, 100)
    t = t[(t < 1_002_000) | (t > 1_004_000)]
    encoder = Encoder.from_counts(
        t, np.round(t * 0.02) % 400, counts_per_turn=400, index_t_us=[1_000_000]
    )
    camera, prism = Camera(*SIZE, 200.0, 200.0, 150.0, 110.0), Prism(0.03)
    seen: list[tuple[str, float]] = []
    summary = convert(
        path,
        tmp_path / "out.h5",
        encoder=encoder,
        camera=camera,
        prism=prism,
        progress=lambda *a: seen.append(a),
    )
    back = open_recording(tmp_path / "out.h5")
    assert (back.camera, back.prism, back.events.size) == (camera, prism, SIZE)
    assert back.metadata == {"source_name": "events", "source_format": "npz", "format": "native"}
    assert seen == [("writing events", 1.0)]
    assert summary == ConversionSummary(
        events=600,
        t_first=int(EVENTS.t[0]),
        t_last=int(EVENTS.t[-1]),
        width=320,
        height=240,
        repairs={},
        encoder_covers=True,
        encoder_gaps=((1_001_900, 1_004_100),),
        index_slip=summary.index_slip,
        format=OutputFormat.NATIVE,
        left_out=(),
    )
    assert summary.index_slip == pytest.approx(0.0, abs=1e-9)
    again = convert(tmp_path / "out.h5", tmp_path / "again.h5")
    assert again == summary
    assert open_recording(tmp_path / "again.h5").encoder.index_t.tolist() == [1_000_000]


def test_convert_refuses(tmp_path):
    path = write_sample(tmp_path, "npz", EVENTS)
    (tmp_path / "link.h5").symlink_to(path)
    before = path.read_bytes()
    for target in (path, tmp_path / "link.h5"):
        with pytest.raises(AmiwarpError, match="is read in this run"):
            convert(path, target, overwrite=True)
    with pytest.raises(AmiwarpError, match="give both the same size"):
        convert(path, tmp_path / "out.h5", camera=Camera(10, 10, 5.0, 5.0, 4.5, 4.5))
    assert path.read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == ["link.h5", "sample.npz"]
