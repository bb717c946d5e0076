"""Every format that is written is read back exactly, by amiwarp and by programs that are not amiwarp."""

import itertools
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import hdf5plugin  # noqa: F401 - its import registers the compression
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from amiwarp import (
    AmiwarpError,
    Camera,
    Codec,
    Encoder,
    ErrorCode,
    Events,
    EventSource,
    MemoryEvents,
    OutputFormat,
    Prism,
    Recording,
    Rounding,
    Truth,
    convert,
    open_recording,
    save_recording,
)
from amiwarp.io import Evt3Encoder
from amiwarp.io.export import export
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.output_formats import LIMITS
from amiwarp.io.prophesee.evt21_encoder import Evt21Encoder
from reference.io_samples import SIZE, make_events
from reference.io_samples_extra import (
    CLIENTS,
    HOURS_28,
    Columns,
    by_dv_processing,
    by_eventcv,
    by_words,
)
from tests.errors import refused


def save(path: Path, events: Events, **options: object) -> Path:
    save_recording(path, Recording(MemoryEvents(events, *SIZE), **options), overwrite=True)
    return path


def assert_columns(found: Columns, events: Events) -> None:
    for name, values in zip("xytp", found, strict=True):
        np.testing.assert_array_equal(values, getattr(events, name), err_msg=name)


def written(folder: Path, name: str, events: Events) -> Path:
    source = save(folder / "source.h5", events)
    path = folder / f"out{CLIENTS[name][0]}"
    summary = convert(source, path, format=name.split()[0], overwrite=True)
    assert (summary.events, summary.format, summary.left_out) == (len(events), name.split()[0], ())
    return path


def exported(folder: Path, name: str, source: EventSource) -> Path:
    """Write the events of a source without a file for them."""
    path = folder / f"out{CLIENTS[name][0]}"
    chosen = OutputFormat(name.split()[0])
    export(source, path, chosen, SIZE, codec=Codec.BLOSC, progress=None, overwrite=True)
    return path


def events_at(t: list[int], seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    x, y = (rng.integers(0, side, len(t)) for side in SIZE)
    return Events.from_arrays(x, y, np.array(t, np.int64), rng.integers(0, 2, len(t)))


GAPS = st.one_of(
    st.integers(0, 3),
    st.integers(4090, 4100),
    st.integers(0, 10**6),
    st.integers(2**24 - 5000, 2**24 + 5000),
    st.integers(2**24, 2**27),
)
"""Times between events [us]: equal times, steps of the upper bits of EVT 3.0, and gaps of several of its ranges."""


@pytest.mark.parametrize("name", [name for name in CLIENTS if name != "ros2 db3"])
@given(
    start=st.sampled_from([0, 7, 2**24 - 1, 2**31, 1_700_000_000_000_000]),
    gaps=st.lists(GAPS, max_size=24),
    seed=st.integers(0, 99),
)
@example(start=0, gaps=[0] * 20, seed=1)
@example(start=2**25, gaps=[], seed=1)
@example(start=4095 << 12, gaps=[1 << 12, 4094 << 12, 4095 << 12, 1 << 12], seed=1)
@settings(max_examples=20)
def test_any_events_come_back_from_other_programs(tmp_path, name, start, gaps, seed):
    events = events_at(np.cumsum([start, *gaps]).tolist(), seed)
    source = MemoryEvents(events, *SIZE)
    if events.t[-1] - events.t[0] > LIMITS[OutputFormat(name.split()[0])].span:
        with pytest.raises(
            AmiwarpError, match=r"events span \d+ us, .* holds .*; write a native recording"
        ):
            exported(tmp_path, name, source)
        return
    assert_columns(CLIENTS[name][1](exported(tmp_path, name, source)), events)


@pytest.mark.parametrize("name", CLIENTS)
def test_no_events_come_back_from_other_programs(tmp_path, name):
    events = Events.empty()
    assert_columns(CLIENTS[name][1](written(tmp_path, name, events)), events)


@pytest.mark.parametrize("name", CLIENTS)
def test_amiwarp_reads_what_it_writes(tmp_path, name):
    events = make_events(3 * CHUNK // 2)
    recording = open_recording(written(tmp_path, name, events))
    found = recording.events.slice(0, len(events) + 1)
    assert_columns((found.x, found.y, found.t, found.p), events)
    assert set(recording.metadata) == {"format"} | ({"topic"} if name.startswith("ros") else set())
    assert recording.events.size == SIZE
    beside = {"text": ["out.txt.json"], "csv": ["out.csv.json"]}.get(name, [])
    assert sorted(os.listdir(tmp_path)) == [f"out{CLIENTS[name][0]}", *beside, "source.h5"]


def test_late_times_in_text_are_exact(tmp_path):
    t = np.sort(np.random.default_rng(0).integers(2**51 - 2**30, 2**51, 2000))
    events = events_at([-(2**51), *t.tolist()])
    path = exported(tmp_path, "text", MemoryEvents(events, *SIZE))
    np.testing.assert_array_equal(open_recording(path).events.slice(0, 3000).t, events.t)


@pytest.mark.parametrize("name", ["evt3", "text"])
def test_eventcv_reads_what_is_written(tmp_path, name):
    events = make_events(5000)
    assert_columns(by_eventcv(written(tmp_path, name, events)), events)


@pytest.mark.parametrize("count", [0, 1, 50_000])
def test_dv_processing_reads_aedat4(tmp_path, count):
    events = make_events(50_000)[:count]
    assert_columns(by_dv_processing(written(tmp_path, "aedat4", events)), events)


def test_text_is_what_a_person_would_write(tmp_path):
    events = Events.from_arrays(
        [0, 7, 10, 319], [239, 100, 5, 0], [0, 9, 1_000_000, 123_456_789], [1, 0, 0, 1]
    )
    save_recording(tmp_path / "a.h5", Recording(MemoryEvents(events, *SIZE)))
    convert(tmp_path / "a.h5", tmp_path / "a.txt")
    expected = "0.000000 0 239 1\n0.000009 7 100 0\n1.000000 10 5 0\n123.456789 319 0 1\n"
    assert (tmp_path / "a.txt").read_text() == expected


REAL = {
    "evt/evt3_driving_1280x720.raw": 219_596,
    "evt/evt2_balls_640x480.raw": 521_252,
    "aedat/aedat4_dvxplorerlite_320x240.aedat4": 111_954,
    "text/slider_depth/events_chunk.txt": 50_000,
}


@pytest.mark.parametrize("file", REAL)
def test_real_recordings_come_back(data_dir, tmp_path, file):
    source = open_recording(data_dir / file).events
    events = source.slice(0, len(source))
    for ending in (".raw", ".dat", ".aedat4", ".npz", ".txt", ".csv", ".bag", "21.raw"):
        chosen = "evt21" if ending == "21.raw" else None
        assert (
            convert(data_dir / file, tmp_path / f"out{ending}", format=chosen).events == REAL[file]
        )
        found = open_recording(tmp_path / f"out{ending}").events
        assert found.size == source.size
        assert_columns(
            tuple(getattr(found.slice(0, len(events) + 1), name) for name in "xytp"), events
        )


HDF5_WITHOUT_PLUGINS = """
import sys, h5py, numpy as np
with h5py.File(sys.argv[1]) as file:
    np.savez(sys.argv[2], **{name: file["events/" + name][:] for name in "xytp"}, t_offset=file["t_offset"][()],
             truth=file["truth/x"][:], angle=file["encoder/angle"][:])
assert "hdf5plugin" not in sys.modules
"""


def by_plain_hdf5(path: Path, out: Path) -> subprocess.CompletedProcess[str]:
    """Read a native recording in a process whose HDF5 has no plugins."""
    command = [sys.executable, "-I", "-c", HDF5_WITHOUT_PLUGINS, str(path), str(out)]
    environment = {**os.environ, "HDF5_PLUGIN_PATH": ""}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_plain_hdf5_libraries_read_gzip(tmp_path):
    events = make_events(CHUNK + 4321)
    points = np.random.default_rng(0).random((len(events), 2)).astype(np.float32)
    encoder = Encoder.constant_speed(3000.0, 999_000, int(events.t[-1]))
    blosc = save(
        tmp_path / "blosc.h5", events, encoder=encoder, truth=Truth({"apex": 0.03}, points)
    )
    assert convert(blosc, tmp_path / "gzip.h5", codec="gzip").left_out == ()
    assert "HDF5_PLUGIN_PATH" in by_plain_hdf5(blosc, tmp_path / "none.npz").stderr
    result = by_plain_hdf5(tmp_path / "gzip.h5", tmp_path / "plain.npz")
    assert result.returncode == 0, result.stderr
    with np.load(tmp_path / "plain.npz") as plain:
        assert_columns((plain["x"], plain["y"], plain["t"] + plain["t_offset"], plain["p"]), events)
        np.testing.assert_array_equal(plain["truth"], points[:, 0])
        np.testing.assert_array_equal(plain["angle"], encoder.angle)
    x, y, t, p = by_eventcv(tmp_path / "gzip.h5")
    assert_columns((x, y, t + events.t[0], p), events)  # eventcv does not add t_offset
    back = open_recording(tmp_path / "gzip.h5")
    found = back.events.slice(0, len(events))
    assert_columns((found.x, found.y, found.t, found.p), events)
    np.testing.assert_array_equal(back.truth.points(0, len(events)), points)


def test_eventcv_reads_dsec_with_gzip(tmp_path):
    events = make_events(5000)
    convert(save(tmp_path / "source.h5", events), tmp_path / "out.h5", format="dsec", codec="gzip")
    x, y, t, p = by_eventcv(tmp_path / "out.h5")
    assert_columns((x, y, t + events.t[0], p), events)


@pytest.mark.parametrize("name", [OutputFormat.EVT3, OutputFormat.TEXT])
def test_what_is_left_out_is_named(tmp_path, name):
    events = make_events(50)
    camera = Camera(*SIZE, 200.0, 200.0, 150.0, 110.0)
    source = save(
        tmp_path / "source.h5",
        events,
        encoder=Encoder.constant_speed(3000.0, 999_000, int(events.t[-1])),
        camera=camera,
        prism=Prism(0.03),
        truth=Truth({"apex": 0.03}),
        metadata={"seed": 7},
    )
    left_out = convert(source, tmp_path / f"out{CLIENTS[name][0]}").left_out
    assert left_out == ("encoder", "camera", "prism", "ground truth", "metadata")
    assert convert(source, tmp_path / "out.h5").left_out == ()


def test_the_size_of_the_camera_is_written(tmp_path):
    events = make_events(50)
    np.savez(tmp_path / "a.npz", x=events.x % 50, y=events.y % 40, t=events.t, p=events.p)
    convert(tmp_path / "a.npz", tmp_path / "b.npz", camera=Camera(77, 66, 50.0, 50.0, 38.0, 32.5))
    assert open_recording(tmp_path / "b.npz").events.size == (77, 66)


def test_times_before_zero(tmp_path):
    events = events_at([-5_000_001, -1, 0, 3])
    source = save(tmp_path / "source.h5", events)
    for name in ("npz", "text", "csv", "dsec"):
        assert_columns(CLIENTS[name][1](written(tmp_path, name, events)), events)
    for ending, label in (
        (".raw", "RAW EVT 3.0"), (".dat", "DAT"), (".aedat4", "AEDAT 4"), (".bag", "a ROS 1 bag"),
        (".mcap", "a ROS 2 bag"),
    ):  # fmt: skip
        with pytest.raises(
            AmiwarpError, match=rf"an event is at -5000001 us, {label} holds 0 \.\. .*\(\.h5\)"
        ):
            convert(source, tmp_path / f"none{ending}")


REFUSED = [
    (
        "a.raw",
        {},
        {"size": (2049, 100)},
        r"the sensor is 2049x100, RAW EVT 3\.0 holds up to 2048x2048",
    ),
    ("a.mcap", {}, {"size": (4000, 300)}, r"a ROS 2 bag holds up to 2048x2048"),
    ("a.aedat4", {}, {"size": (40_000, 100)}, r"AEDAT 4 holds up to 32768x32768"),
    (
        "a.h5",
        {"format": "dsec"},
        {"t": [0, 2**32]},
        r"span 4294967296 us, the DSEC layout holds up to 4294967295 us",
    ),
    (
        "a.db3",
        {},
        {"t": [2**31 * 10**6]},
        r"at 2147483648000000 us, a ROS 2 bag holds 0 \.\. 2147483647999999 us",
    ),
    ("a.txt", {}, {"t": [2**53]}, "text holds"),
    (
        "a.raw",
        {},
        {"t": [5, HOURS_28 + 6]},
        "span 100000000001 us, RAW EVT 3.0 holds up to 100000000000 us",
    ),
    (
        "a.raw",
        {"format": "evt21"},
        {"size": (500, 2049)},
        r"is 500x2049, RAW EVT 2\.1 holds up to 2048x2048",
    ),
    (
        "a.raw",
        {"format": "evt21"},
        {"t": [5, 2**34 + 5]},
        r"17179869184 us, RAW EVT 2\.1 holds up to 17179869183 us",
    ),
    ("a.dat", {}, {"size": (16385, 100)}, r"the sensor is 16385x100, DAT holds up to 16384x16384"),
    (
        "a.dat",
        {},
        {"t": [9, 2**32 + 9]},
        "the events span 4294967296 us, DAT holds up to 4294967295 us",
    ),
    (
        "a.bag",
        {},
        {"t": [2**32 * 10**6]},
        r"at 4294967296000000 us, a ROS 1 bag holds 0 \.\. 4294967295999999 us",
    ),
    ("a.csv", {}, {"t": [2**53 + 1]}, "csv holds"),
    (
        "a.xyz",
        {},
        {},
        r"the extension '\.xyz' is of no format .* among \.h5, .*the formats native, dsec, evt3",
    ),
    (
        "a.txt",
        {"format": "evt3"},
        {},
        r"the format evt3 are written as \.raw, not '\.txt'; .* ends in \.raw",
    ),
    ("a.h5", {"format": "bag"}, {}, "format is 'bag'; choose among native, dsec"),
    ("a.h5", {"codec": "zip"}, {}, "codec is 'zip'; choose among blosc, gzip"),
    ("a.npz", {"codec": "gzip"}, {}, r"codec is gzip, which is for HDF5 \(\.h5\)"),
    (
        "a.raw",
        {"format": "ros2"},
        {},
        r"the format ros2 are written as \.mcap or \.db3, not '\.raw'",
    ),
]


@pytest.mark.parametrize(("out", "options", "made", "message"), REFUSED)
def test_what_a_format_cannot_hold_is_refused(tmp_path, out, options, made, message):
    events = events_at(made.get("t", [0, 1, 2]))
    if events.t[-1] - events.t[0] <= HOURS_28:
        source = tmp_path / "source.h5"
        save_recording(source, Recording(MemoryEvents(events, *made.get("size", SIZE))))
    else:
        source = tmp_path / "source.npz"
        np.savez(source, x=events.x, y=events.y, t=events.t, p=events.p)
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(AmiwarpError, match=rf"{out}: .*{message}"):
        convert(source, tmp_path / out, **options)
    assert sorted(os.listdir(tmp_path)) == before


def moved(count: int = 3000) -> Events:
    """Return compensated events: inside and outside the image, at the edges of pixels, and without coordinates."""
    events, rng = make_events(count), np.random.default_rng(8)
    x, y = (rng.uniform(-3.0, side + 2.0, count).astype(np.float32) for side in SIZE)
    x[:8] = [
        -0.5,
        np.nextafter(np.float32(-0.5), np.float32(-1)),
        SIZE[0] - 0.5,
        SIZE[0] - 1,
        0.5,
        1.5,
        2.5,
        3e20,
    ]
    y[:8] = [0, 0, 0, SIZE[1] - 0.5, 0.5, -0.5, np.nextafter(np.float32(0.5), np.float32(0)), 7]
    x[8::50], y[8::50] = np.nan, np.nan
    return Events(x, y, events.t, events.p)


def pixels(found: Columns) -> np.ndarray:
    return np.stack([np.asarray(found[0], np.int64), np.asarray(found[1], np.int64)], axis=1)


@pytest.mark.parametrize("name", CLIENTS)
def test_other_programs_read_compensated_events_at_their_nearest_pixel(tmp_path, name):
    events = moved()
    at = [
        [math.floor(float(v) + 0.5) if v == v else -1 for v in values]
        for values in (events.x, events.y)
    ]
    kept = np.array([0 <= x < SIZE[0] and 0 <= y < SIZE[1] for x, y in zip(*at, strict=True)])
    assert kept[:8].tolist() == [True, False, False, False, True, True, True, False]
    source, path = save(tmp_path / "source.h5", events), tmp_path / f"out{CLIENTS[name][0]}"
    summary = convert(source, path, format=name.split()[0], rounding="nearest")
    assert (summary.events, summary.dropped, summary.rounding) == (
        kept.sum(),
        (~kept).sum(),
        Rounding.NEAREST,
    )
    found = CLIENTS[name][1](path)
    np.testing.assert_array_equal(pixels(found), np.array(at).T[kept])
    np.testing.assert_array_equal(found[2], events.t[kept])
    np.testing.assert_array_equal(found[3], events.p[kept])
    again = open_recording(path).events
    assert_columns(found, again.slice(0, len(events)))


@pytest.mark.parametrize("name", CLIENTS)
def test_dithered_pixels_have_the_mean_of_the_coordinates(tmp_path, name):
    count = 40_000
    events = make_events(count)
    x = np.where(np.arange(count) % 2, np.float32(20.25), np.float32(100.9))
    # 30 % and 80 % drop out
    y = np.where(np.arange(count) % 2, np.float32(-0.3), np.float32(SIZE[1] - 0.2))
    source = save(tmp_path / "source.h5", Events(x, y, events.t, events.p))

    def written_with(seed: int) -> Columns:
        path = tmp_path / f"out{CLIENTS[name][0]}"
        summary = convert(
            source,
            path,
            format=name.split()[0],
            rounding=Rounding.DITHERED,
            seed=seed,
            overwrite=True,
        )
        found = CLIENTS[name][1](path)
        assert summary.dropped == count - len(found[0]) == count - summary.events
        return found

    found = written_with(5)
    for row, (least, share, kept) in {0: (20, 0.25, 0.7), SIZE[1] - 1: (100, 0.9, 0.2)}.items():
        columns = np.asarray(found[0], np.int64)[np.asarray(found[1], np.int64) == row]
        assert set(columns.tolist()) == {least, least + 1}
        # five standard deviations
        assert columns.mean() == pytest.approx(
            least + share, abs=5.0 * (share * (1 - share) / columns.size) ** 0.5
        )
        assert columns.size / (count / 2) == pytest.approx(
            kept, abs=5.0 * (kept * (1 - kept) / (count / 2)) ** 0.5
        )
    same, other = written_with(5), written_with(6)
    assert all(np.array_equal(a, b) for a, b in zip(found, same, strict=True))
    assert len(other[0]) != len(found[0]) or not np.array_equal(pixels(other), pixels(found))


@pytest.mark.parametrize("name", [name for name in CLIENTS if name not in ("npz", "text", "csv")])
def test_fractional_pixels_need_rounding(tmp_path, name):
    source = save(tmp_path / "source.h5", moved(100))
    remedy = r"give --round \(rounding= in Python\) nearest or dithered, or write \.h5, \.npz, \.txt or \.csv"
    with pytest.raises(
        AmiwarpError, match=rf"out.*fractional pixels, .* holds whole pixels; {remedy}"
    ):
        convert(source, tmp_path / f"out{CLIENTS[name][0]}", format=name.split()[0])
    assert os.listdir(tmp_path) == ["source.h5"]


def test_rounding_where_it_does_not_apply_is_refused(tmp_path):
    source = save(tmp_path / "source.h5", moved(100))
    with pytest.raises(
        AmiwarpError, match=r"out\.h5: rounding is nearest, but the native format holds sub-pixels"
    ):
        convert(source, tmp_path / "out.h5", rounding="nearest")
    with pytest.raises(
        AmiwarpError, match=r"out\.raw: rounding is 'up'; choose among nearest, dithered"
    ):
        convert(source, tmp_path / "out.raw", rounding="up")
    with pytest.raises(AmiwarpError, match="seed = -1 is not a whole number"):
        convert(source, tmp_path / "out.raw", rounding="dithered", seed=-1)
    whole = save(tmp_path / "whole.h5", make_events(100))
    with pytest.raises(
        AmiwarpError,
        match=r"out\.raw: .*events have whole pixels and are not rounded; leave --round",
    ):
        convert(whole, tmp_path / "out.raw", rounding="nearest")
    assert sorted(os.listdir(tmp_path)) == ["source.h5", "whole.h5"]


def test_npz_holds_sub_pixels(tmp_path):
    events = moved()
    summary = convert(save(tmp_path / "source.h5", events), tmp_path / "out.npz")
    assert (summary.events, summary.dropped, summary.rounding, summary.left_out) == (
        len(events),
        0,
        None,
        (),
    )
    with np.load(tmp_path / "out.npz") as archive:
        assert [archive[name].dtype.str for name in "xytp"] == ["<f4", "<f4", "<i8", "|u1"]
        assert_columns(tuple(archive[name] for name in "xytp"), events)


def test_text_holds_sub_pixels_to_a_millionth(tmp_path):
    events = moved()
    events = events[~(np.abs(events.x) > 1e6)]
    convert(save(tmp_path / "source.h5", events), tmp_path / "out.txt")
    table = np.loadtxt(tmp_path / "out.txt")
    np.testing.assert_array_equal(np.rint(table[:, 0] * 1e6), events.t)
    np.testing.assert_array_equal(table[:, 3], events.p)
    for column, values in zip(table.T[1:3], (events.x, events.y), strict=True):
        np.testing.assert_allclose(column, values.astype(np.float64), rtol=0, atol=0.51e-6)  # px
        far = np.abs(values) >= 16  # there, neighbouring float32 numbers differ by more
        np.testing.assert_array_equal(column.astype(np.float32)[far], values[far])


def test_text_has_no_coordinates_beyond_the_image_plane(tmp_path):
    """A ray along the image plane would need a number that no reader takes for a pixel."""
    events = moved()
    convert(save(tmp_path / "source.h5", events), tmp_path / "out.txt")
    assert (tmp_path / "out.txt").read_text().splitlines()[7].split()[1:3] == ["nan", "7.000000"]
    assert np.isnan(open_recording(tmp_path / "out.txt").events.slice(7, 8).x).all()


@pytest.mark.parametrize("ending", [".npz", ".txt", ".csv"])
def test_amiwarp_reads_sub_pixels_back_as_compensated_events(tmp_path, ending):
    events = moved()
    source = save(tmp_path / "source.h5", events)
    convert(source, tmp_path / f"out{ending}")
    camera = Camera(*SIZE, 200.0, 200.0, 150.0, 110.0)
    summary = convert(tmp_path / f"out{ending}", tmp_path / "back.h5", camera=camera)
    assert (summary.events, summary.repairs) == (len(events), {})
    first, back = open_recording(source).events, open_recording(tmp_path / "back.h5").events
    assert not back.slice(0, 1).whole_pixels
    assert back.size == SIZE
    found, expected = back.slice(0, len(events)), first.slice(0, len(events))
    for name in "tp":
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    for name in "xy":
        given = getattr(expected, name).copy()
        given[np.abs(given) > 2**31] = given[np.abs(given) > 2**31] if ending == ".npz" else np.nan
        np.testing.assert_allclose(
            getattr(found, name), given, rtol=0, atol=0 if ending == ".npz" else 1e-6
        )
    inside = [
        -0.5 <= x < SIZE[0] - 0.5 and -0.5 <= y < SIZE[1] - 0.5
        for x, y in zip(events.x, events.y, strict=True)
    ]
    np.testing.assert_array_equal(first.inside(0, len(events)), inside)
    inside[1] = ending != ".npz"  # within a millionth of the edge
    np.testing.assert_array_equal(back.inside(0, len(events)), inside)


@pytest.mark.parametrize("name", CLIENTS)
def test_an_interrupted_conversion_leaves_what_was_there(tmp_path, name):
    source, path = (
        save(tmp_path / "source.h5", make_events(200)),
        tmp_path / f"out{CLIENTS[name][0]}",
    )
    path.write_bytes(b"mine")

    def interrupt(what: str, share: float) -> None:
        raise KeyboardInterrupt

    with refused(ErrorCode.OUTPUT_EXISTS):
        convert(source, path, format=name.split()[0])
    with pytest.raises(KeyboardInterrupt):
        convert(source, path, format=name.split()[0], progress=interrupt, overwrite=True)
    with pytest.raises(AmiwarpError, match=r"is read in this run|are written as .*, not '\.h5'"):
        convert(source, source, format=name.split()[0], overwrite=True)
    assert sorted(os.listdir(tmp_path)) == sorted([path.name, "source.h5"])
    assert path.read_bytes() == b"mine"


def test_a_missing_rosbags_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    source = save(tmp_path / "source.h5", make_events(10))
    with pytest.raises(
        AmiwarpError, match=r"out\.mcap: ROS bags need rosbags; .* pip install 'amiwarp\[ros\]'"
    ):
        convert(source, tmp_path / "out.mcap")
    assert os.listdir(tmp_path) == ["source.h5"]


@given(
    cuts=st.lists(st.integers(0, 60), max_size=5),
    gaps=st.lists(GAPS, min_size=60, max_size=60),
    whole=st.booleans(),
)
@settings(max_examples=60)
def test_evt3_words_follow_the_format(cuts, gaps, whole):
    """Decode word by word, as Prophesee's documentation defines them, with the wraps of the time counted."""
    events = events_at(np.cumsum(gaps).tolist(), len(cuts))
    encoder, found = Evt3Encoder(0), []
    high = low = y = turns = 0
    places = [0, *sorted(cuts), 60]
    for start, stop in itertools.pairwise(places):
        if start == stop:
            continue
        words = encoder.encode(events[start:stop], self_contained=whole)
        for word in words.tolist():
            kind, value = word >> 12, word & 0xFFF
            if kind == 8:
                assert value >= high or (high, value) == (0xFFF, 0)
                turns += value < high
                high = value
            elif kind == 6:
                low = value
            elif kind == 0:
                y = value
            else:
                assert kind == 2
                found.append((value & 0x7FF, y, (turns << 24) + (high << 12) + low, value >> 11))
        if whole:
            kinds = (words >> 12).tolist()
            assert kinds[kinds.index(6) :][:3] == [6, 0, 2]
            assert set(kinds[: kinds.index(6)]) == {8}
    assert_columns(tuple(np.array(found, np.int64).reshape(-1, 4).T), events)


@given(
    cuts=st.lists(st.integers(0, 60), max_size=5),
    gaps=st.lists(st.sampled_from([0, 0, 0, 1, 63, 64, 2**27]), min_size=60, max_size=60),
    steps=st.lists(st.sampled_from([0, 1, 1, 1, 30, -1]), min_size=60, max_size=60),
)
@settings(max_examples=60)
def test_events_share_the_words_of_evt21(tmp_path, cuts, gaps, steps):
    """Neighbours share a word as long as their columns rise, so that their order stays."""
    t, x = np.cumsum(gaps) + 5, np.abs(np.cumsum(steps)) % 320
    y, p = np.arange(60) // 20, np.arange(60) // 30 % 2
    events, encoder, parts = Events.from_arrays(x, y, t, p), Evt21Encoder(5), []
    for start, stop in itertools.pairwise([0, *sorted(cuts), 60]):
        if start < stop:
            parts.append(encoder.encode(events[start:stop]))
    words = np.concatenate(parts)
    header = "% evt 2.1\n% geometry 320x240\n% format EVT21;height=240;width=320;endianness=little\n% t0 5\n% end\n"
    (tmp_path / "a.raw").write_bytes(header.encode() + words.tobytes())
    assert_columns(by_words(tmp_path / "a.raw"), events)
    same = (
        (np.diff(t) == 0)
        & (np.diff(y) == 0)
        & (np.diff(p) == 0)
        & (x[1:] // 32 == x[:-1] // 32)
        & (np.diff(x) > 0)
    )
    same[[cut - 1 for cut in cuts if 0 < cut < 60]] = False
    assert np.count_nonzero(words >> np.uint64(60) != 8) == 60 - np.count_nonzero(same)


@pytest.mark.parametrize("name", ["dat", "evt21"])
def test_the_clock_of_late_events_begins_at_the_first(tmp_path, name):
    """Its time is in the header, also for the last time, which is read from the end of a large file."""
    late = 1_700_000_000_000_000
    events = events_at([late, late + 5, late + 70_000])
    path = exported(tmp_path, name, MemoryEvents(events, *SIZE))
    line = {"dat": b"% T0 1700000000000000\n", "evt21": b"% t0 1700000000000000\n"}[name]
    assert line in path.read_bytes()
    found = open_recording(path).events
    assert (found.t_first, found.t_last, found.last_time()) == (late, late + 70_000, late + 70_000)
    if name == "dat":
        path.write_bytes(path.read_bytes().replace(b"T0 1700000000000000", b"T0 -5"))
        with pytest.raises(AmiwarpError, match="t0 in the header is '-5'"):
            open_recording(path)


def test_a_csv_file_is_what_a_person_would_write(tmp_path):
    events = Events.from_arrays([0, 7, 319], [239, 100, 0], [-15, 0, 123_456_789_012], [1, 0, 1])
    path = exported(tmp_path, "csv", MemoryEvents(events, *SIZE))
    assert path.read_text() == "t,x,y,p\n-15,0,239,1\n0,7,100,0\n123456789012,319,0,1\n"


def test_pandas_reads_csv_without_options(tmp_path):
    pandas = pytest.importorskip("pandas")
    events = make_events(5000)
    table = pandas.read_csv(written(tmp_path, "csv", events))
    assert [str(table[name].dtype) for name in "txyp"] == ["int64"] * 4
    assert_columns(tuple(table[name].to_numpy() for name in "xytp"), events)


@pytest.mark.parametrize("name", ["csv", "text"])
def test_a_size_that_no_event_shows_comes_back(tmp_path, name):
    """Also of a recording of over an hour, whose unit of time could not be assumed."""
    events = Events.from_arrays([0, 1], [0, 1], [0, 5_000_000_000], [1, 0])
    path = exported(tmp_path, name, MemoryEvents(events, *SIZE))
    found = open_recording(path)
    assert (found.events.size, found.metadata) == (SIZE, {"format": "text"})
    assert_columns(tuple(getattr(found.events.slice(0, 2), name) for name in "xytp"), events)
    assert open_recording(path, size=(500, 400)).events.size == (500, 400)


def test_the_size_beside_a_text_belongs_to_this_text(tmp_path):
    path = exported(tmp_path, "text", MemoryEvents(make_events(50), *SIZE))
    beside = tmp_path / "out.txt.json"
    stated = {
        "width": 320,
        "height": 240,
        "time_unit": "s",
        "compensated": False,
        "bytes": path.stat().st_size,
    }
    assert json.loads(beside.read_text()) == stated
    path.write_text("0.000001 5 7 1\n")
    assert open_recording(path).events.size == (128, 128)
    stated["bytes"] = path.stat().st_size
    for wrong in ({"width": 0}, {"compensated": 1}, {"time_unit": "ms"}):
        beside.write_text(json.dumps({**stated, **wrong}))
        with pytest.raises(AmiwarpError, match=rf"out\.txt\.json: {next(iter(wrong))}\b"):
            open_recording(path)
    source = save(tmp_path / "source.h5", make_events(50))
    with pytest.raises(AmiwarpError, match=r"out\.txt: exists; give another name"):
        convert(source, path)
    path.unlink()
    convert(source, path)  # replaces what is left over of the text that is gone
    assert json.loads(beside.read_text())["bytes"] == path.stat().st_size
    path.rename(tmp_path / "moved.txt")
    beside.rename(tmp_path / "moved.txt.json")
    del stated["compensated"]  # as earlier versions wrote it
    (tmp_path / "moved.txt.json").write_text(
        json.dumps({**stated, "bytes": (tmp_path / "moved.txt").stat().st_size})
    )
    assert open_recording(tmp_path / "moved.txt").events.size == SIZE


@pytest.mark.parametrize("name", CLIENTS)
def test_events_are_taken_block_by_block(tmp_path, name):
    taken = []

    class Counted(MemoryEvents):
        def blocks(self, **options):
            assert options == {}
            for block in super().blocks(count=1000):
                taken.append(len(block))
                yield block

    events = make_events(5500)
    assert_columns(CLIENTS[name][1](exported(tmp_path, name, Counted(events, *SIZE))), events)
    assert taken == [1000] * 5 + [500]


def test_a_camera_of_another_size_is_refused(tmp_path: Path) -> None:
    """A sensor size that the source knows is not replaced by the camera's."""
    source = save(tmp_path / "a.h5", make_events())
    with pytest.raises(AmiwarpError, match="camera is 640x480, the recording 320x240"):
        convert(source, tmp_path / "b.h5", camera=Camera.from_fov(640, 480, 1.0))
    assert not (tmp_path / "b.h5").exists()


@pytest.mark.parametrize("name", ["a.h5", "a.npz", "a.raw"])
def test_events_outside_the_given_camera_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.txt").write_text("0.0 1 2 1\n0.1 300 2 0\n")
    with pytest.raises(
        AmiwarpError, match=rf"{name}: event 1 \(x=300, .* outside the 240x180 frame"
    ):
        convert(tmp_path / "a.txt", tmp_path / name, camera=Camera.from_fov(240, 180, 1.0))
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("name", ["a.h5", "a.npz", "a.txt"])
def test_the_error_of_a_callers_function_stays_as_it_is(tmp_path: Path, name: str) -> None:
    source = save(tmp_path / "source.h5", make_events())

    def cancel(step: str, share: float) -> None:
        raise RuntimeError("cancelled")

    with pytest.raises(RuntimeError, match=r"^cancelled$"):
        convert(source, tmp_path / name, progress=cancel)
    assert os.listdir(tmp_path) == ["source.h5"]


def test_seeds_beyond_63_bits_are_refused(tmp_path: Path) -> None:
    events = make_events()
    moved = Events(events.x + np.float32(0.25), events.y.astype(np.float32), events.t, events.p)
    source = save(tmp_path / "a.h5", moved)
    convert(source, tmp_path / "b.raw", rounding="dithered", seed=2**63 - 1)
    with pytest.raises(AmiwarpError, match="seed"):
        convert(source, tmp_path / "c.raw", rounding="dithered", seed=2**63)


def test_the_earliest_times_are_written(tmp_path: Path) -> None:
    t = -(2**62) + np.array([5, 7])
    source = save(tmp_path / "a.h5", Events.from_arrays([1, 2], [3, 4], t, [0, 1]))
    convert(source, tmp_path / "a.npz")
    np.testing.assert_array_equal(open_recording(tmp_path / "a.npz").events.slice(0, 2).t, t)


def partly_whole(count: int, whole: int) -> Events:
    """Return compensated events, of which the first have whole coordinates; some lie outside the image."""
    rng = np.random.default_rng(5)
    x, y = (np.floor(rng.uniform(-9, side + 9, count)) for side in SIZE)
    x[whole:] += 0.25
    p = (np.arange(count) % 2).astype(np.uint8)
    return Events(x.astype(np.float32), y.astype(np.float32), np.arange(count) * 10, p)


@pytest.mark.parametrize("ending", [".txt", ".csv"])
@pytest.mark.parametrize(("count", "whole"), [(2000, 1100), (8000, 7000), (2000, 2000), (1, 1)])
def test_compensated_events_in_text_are_known_without_fractions(tmp_path, ending, count, whole):
    events = partly_whole(count, whole)
    path = tmp_path / f"out{ending}"
    convert(save(tmp_path / "source.h5", events), path)
    assert json.loads((tmp_path / f"out{ending}.json").read_text())["compensated"] is True
    found = open_recording(path).events.slice(0, count + 1)
    assert not found.whole_pixels
    assert_columns(tuple(getattr(found, name) for name in "xytp"), events)
    assert open_recording(path).metadata["format"] == "text"


def test_whole_pixels_in_text_stay_whole(tmp_path):
    """Also such as fixed-point numbers, and of more events than a camera sends: amiwarp says what they are."""
    events = Events.from_arrays(
        np.full(5000, 2048), np.full(5000, 1024), np.arange(5000) // 2500, np.arange(5000) % 2
    )
    save_recording(tmp_path / "source.h5", Recording(MemoryEvents(events, 4096, 2048)))
    convert(tmp_path / "source.h5", tmp_path / "out.csv")
    found = open_recording(tmp_path / "out.csv").events.slice(0, 5001)
    assert found.whole_pixels
    assert_columns(tuple(getattr(found, name) for name in "xytp"), events)


def test_rounded_events_in_text_are_whole(tmp_path):
    convert(save(tmp_path / "source.h5", moved()), tmp_path / "out.csv", rounding="nearest")
    assert json.loads((tmp_path / "out.csv.json").read_text())["compensated"] is False


FOREIGN = {
    "list": b"[1, 2]",
    "prose": b"my notes",
    "empty": b"",
    "object": b'{"width": 3, "height": 4, "bytes": 0}',
    "long": b'{"a": "' + b"a" * 9000 + b'"}',
    "not UTF-8": b"\xff\xfe\x00",
}
"""Files beside a text that amiwarp did not write."""


@pytest.mark.parametrize("name", FOREIGN)
def test_a_file_of_another_program_beside_a_text(tmp_path, name):
    """It is ignored when the text is read, and never replaced."""
    source = save(tmp_path / "source.h5", make_events(50))
    path = tmp_path / "out.csv"
    beside = tmp_path / "out.csv.json"
    beside.write_bytes(FOREIGN[name])
    path.write_text("t_us,x,y,p\n5,6,7,1\n")
    assert open_recording(path).events.size == (128, 128)
    for _ in range(2):  # with and without a text
        with pytest.raises(
            AmiwarpError, match=r"out\.csv\.json: was not written by amiwarp, .* another name"
        ):
            convert(source, path, overwrite=True)
        assert beside.read_bytes() == FOREIGN[name]
        path.unlink(missing_ok=True)
    assert sorted(os.listdir(tmp_path)) == ["out.csv.json", "source.h5"]


@pytest.mark.parametrize(
    ("ending", "message"),
    [(".csv", "only names of columns in line 1"), (".txt", "another recording")],
)
def test_texts_without_events_say_so(tmp_path, ending, message):
    path = tmp_path / f"out{ending}"
    convert(save(tmp_path / "source.h5", Events.empty()), path)
    with pytest.raises(AmiwarpError, match=rf"out{ending}: holds no events.*{message}"):
        open_recording(path)
    (tmp_path / "out.txt").write_bytes(b"")
    (tmp_path / "out.txt.json").unlink(missing_ok=True)
    with pytest.raises(AmiwarpError, match=r"out\.txt: is empty; give a recording"):
        open_recording(tmp_path / "out.txt")


def test_what_amiwarp_says_of_a_text_is_believed(tmp_path):
    """Coordinates that could be polarities, and fractions in a text that is said to have none."""
    x, y = np.full((2, 40), -5, np.float32)
    events = Events(x, y, np.arange(40) * 10, (np.arange(40) % 2).astype(np.uint8))
    path = exported(tmp_path, "text", MemoryEvents(events, *SIZE))
    recording = open_recording(path)
    assert recording.metadata == {"format": "text"}
    assert_columns(tuple(getattr(recording.events.slice(0, 41), name) for name in "xytp"), events)
    beside = tmp_path / "out.txt.json"
    path.write_text(path.read_text().replace("-5.000000", "5.2500000"))
    assert not open_recording(path).events.slice(0, 1).whole_pixels
    beside.write_text(beside.read_text().replace("true", "false"))
    with pytest.raises(AmiwarpError, match=r"line 1 is '0\.000000 5\.2500000 5\.2500000 0'"):
        open_recording(path)
