"""The native recording: written completely or not at all, and read back in parts by time and index."""

import itertools
import math
import os
import re
import threading
import time
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from amiwarp import (
    AmiwarpError,
    Camera,
    Encoder,
    ErrorCode,
    Events,
    EventSource,
    Fisheye,
    FlatSide,
    MemoryEvents,
    Prism,
    RadialTangential,
    Recording,
    RecordingWriter,
    Truth,
    convert,
    open_recording,
    save_recording,
)
from amiwarp.io.hdf5.chunks import CHUNK, decode, encode
from amiwarp.io.hdf5.fletcher32 import checksum
from amiwarp.io.hdf5.stored_column import StoredColumn
from amiwarp.io.native.attributes import camera_attributes, read_camera
from amiwarp.kernels.checksum import Checksums
from amiwarp.kernels.workers import run_together
from amiwarp.tasks import cores, cpu_threads, in_order
from tests import ROOT
from tests.errors import refused

SIZE = (320, 240)


def make(count: int, seed: int = 0, start: int = 5_000_000, mean_us: int = 3) -> Events:
    rng = np.random.default_rng(seed)
    t = start + np.cumsum(rng.integers(0, 2 * mean_us + 1, count))
    return Events.from_arrays(
        rng.integers(0, SIZE[0], count),
        rng.integers(0, SIZE[1], count),
        t,
        rng.integers(0, 2, count),
    )


def write(path: Path, events: Events, **options) -> Path:
    with RecordingWriter(path, width=SIZE[0], height=SIZE[1], **options) as writer:
        writer.append(events)
    return path


def assert_equal(given_events: Events, expected: Events) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(
            getattr(given_events, name), getattr(expected, name), err_msg=name, strict=True
        )


def assert_nothing_left(folder: Path) -> None:
    assert sorted(os.listdir(folder)) == []


@pytest.mark.parametrize(
    "distortion",
    [
        None,
        RadialTangential(-0.3, 0.1, 1e-4, -2e-4, 0.01),
        RadialTangential(k6=0.1),
        Fisheye(0.1, 0.2, 0.3, 0.4),
    ],
)
def test_everything_comes_back(tmp_path, distortion):
    events = make(3 * CHUNK + 17)
    points = np.random.default_rng(1).normal(size=(len(events), 2)).astype(np.float32)
    recording = Recording(
        events=MemoryEvents(events, *SIZE),
        camera=Camera(*SIZE, 200.5, 201.5, 150.25, 110.75, distortion),
        encoder=Encoder.constant_speed(3000.0, 4_999_000, events.t[-1])
        .with_index([5_000_123])
        .with_clock_offset(-12.5),
        prism=Prism(math.radians(2.0), 1.52, flat_side=FlatSide.CAMERA),
        truth=Truth({"apex": 0.0351, "phase": -1.25}, points),
        metadata={"seed": 7, "rate": 0.5, "made": True, "scene": "checkerboard"},
        name="whole",
    )
    save_recording(tmp_path / "whole.h5", recording)
    back = open_recording(tmp_path / "whole.h5")
    assert isinstance(back.events, EventSource)
    assert_equal(back.events.slice(0, len(events)), events)
    assert (back.camera, back.prism, back.name) == (recording.camera, recording.prism, "whole")
    assert back.metadata == {**recording.metadata, "format": "native"}
    assert back.encoder is not None
    assert back.encoder.clock_offset_us == -12.5
    for name in ("t", "angle", "index_t"):
        np.testing.assert_array_equal(getattr(back.encoder, name), getattr(recording.encoder, name))
    assert back.truth is not None
    assert back.truth.parameters == recording.truth.parameters
    np.testing.assert_array_equal(
        back.truth.points(70_000, 70_010), points[70_000:70_010], strict=True
    )
    assert sorted(os.listdir(tmp_path)) == ["whole.h5"]


@pytest.mark.parametrize(
    ("lens", "count"),
    [(RadialTangential(-0.3), 5), (RadialTangential(k6=0.1), 8), (Fisheye(0.1), 4)],
)
def test_a_lens_has_the_coefficients_of_its_model(lens, count):
    attributes = camera_attributes(Camera(*SIZE, 200.5, 201.5, 150.25, 110.75, lens))
    assert len(attributes["distortion"]) == count
    assert read_camera(attributes, "here").distortion == lens
    lengths = "4" if count == 4 else "5 or 8"
    with pytest.raises(AmiwarpError, match=f"expected {lengths} numbers"):
        read_camera({**attributes, "distortion": [0.1] * 6}, "here")


def test_only_events_are_needed(tmp_path):
    back = open_recording(write(tmp_path / "bare.h5", make(10)))
    assert (back.camera, back.encoder, back.prism, back.truth) == (None, None, None, None)
    assert back.metadata == {"format": "native"}
    assert back.events.size == SIZE


@given(
    st.integers(0, 400),
    st.lists(st.integers(0, 400), max_size=4),
    st.sampled_from([0, 1, 300, 40_000]),
    st.integers(-(10**15), 10**15),
    st.integers(0, 2**32),
)
@settings(max_examples=40)
def test_slices_by_time_and_index_are_those_of_memory(tmp_path, count, edges, mean_us, start, seed):
    events = make(count, seed, start, mean_us)
    path = tmp_path / f"{count}-{seed}-{start}-{mean_us}-{len(edges)}.h5"
    places = [0, *sorted(min(edge, count) for edge in edges), count]
    with RecordingWriter(path, width=SIZE[0], height=SIZE[1]) as writer:
        for a, b in itertools.pairwise(places):
            writer.append(events[a:b])
    source, memory = open_recording(path).events, MemoryEvents(events, *SIZE)
    assert len(source) == count
    rng = np.random.default_rng(seed)
    for _ in range(6 if count else 0):
        low, high = sorted(rng.integers(start - 2000, int(events.t[-1]) + 2000, 2).tolist())
        assert_equal(source.between(low, high), memory.between(low, high))
        at = int(events.t[rng.integers(count)])
        assert_equal(source.between(at, at + 1), memory.between(at, at + 1))
    assert_equal(source.slice(3, 50), memory.slice(3, 50))
    for options in ({"count": 37}, {"duration_us": 1 + 60 * mean_us}, {}):
        for got, expected in zip(source.blocks(**options), memory.blocks(**options), strict=True):
            assert_equal(got, expected)
    with h5py.File(path) as file:
        index, t = file["ms_to_idx"][:], file["events/t"][:]
        np.testing.assert_array_equal(index, np.searchsorted(t, 1000 * np.arange(index.size)))
        assert index[-1] == count
    del source
    path.unlink()


def test_without_the_millisecond_index_bisection_finds_times(tmp_path):
    events = make(20_000)
    path = write(tmp_path / "a.h5", events)
    with h5py.File(path, "r+") as file:
        del file["ms_to_idx"]
    source, memory = open_recording(path).events, MemoryEvents(events, *SIZE)
    for low in (0, 5_000_001, 5_012_345, 5_050_000, 6_000_000):
        assert_equal(source.between(low, low + 7777), memory.between(low, low + 7777))


def test_plain_dsec_file(tmp_path):
    events = make(5000)
    path = tmp_path / "events.h5"
    with h5py.File(path, "w") as file:
        for name, kind in (("x", "u2"), ("y", "u2"), ("t", "u4"), ("p", "u1")):
            values = getattr(events, name) - (5_000_000 if name == "t" else 0)
            file.create_dataset(
                f"events/{name}", data=values.astype(kind), chunks=(512,), compression="gzip"
            )
        file["t_offset"] = np.int64(5_000_000)
        relative = events.t - 5_000_000
        file["ms_to_idx"] = np.searchsorted(
            relative, 1000 * np.arange(relative[-1] // 1000 + 1)
        ).astype(np.uint64)
    back = open_recording(path)
    assert set(back.metadata) == {"format", "assumed_size"}
    assert back.events.size == (640, 480)
    assert_equal(back.events.slice(0, 5000), events)
    memory = MemoryEvents(events, *SIZE)
    for low in range(5_000_000, int(events.t[-1]) + 2000, 777):
        assert_equal(back.events.between(low, low + 1500), memory.between(low, low + 1500))


def test_compensated_events_keep_fractions_flags_and_nan(tmp_path):
    sensor = make(2000)
    x = sensor.x.astype(np.float32) - 20.25
    x[5] = np.nan
    inside = np.isfinite(x) & (x >= 0)
    events = Events(x, sensor.y.astype(np.float32), sensor.t, sensor.p)
    with RecordingWriter(tmp_path / "c.h5", width=SIZE[0], height=SIZE[1]) as writer:
        writer.append(events[:700], inside=inside[:700])
        writer.append(events[700:], inside=inside[700:])
    recording = open_recording(tmp_path / "c.h5")
    save_recording(tmp_path / "copy.h5", recording)
    for source in (recording.events, open_recording(tmp_path / "copy.h5").events):
        assert_equal(source.slice(0, 2000), events)
        np.testing.assert_array_equal(source.inside(0, 2000), inside)


def test_empty_recording(tmp_path):
    with RecordingWriter(tmp_path / "none.h5", width=4, height=3):
        pass
    source = open_recording(tmp_path / "none.h5").events
    assert (
        len(source),
        list(source.blocks()),
        len(source.between(0, 10)),
        len(source.slice(0, 5)),
    ) == (0, [], 0, 0)
    with refused(ErrorCode.CONTENT_MISSING):
        source.t_last  # noqa: B018


def test_encoder_may_come_last(tmp_path):
    with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
        writer.append(make(5))
        writer.set_encoder(Encoder.constant_speed(60.0, 5_000_000, 5_001_000))
    assert open_recording(tmp_path / "a.h5").encoder.rpm == pytest.approx(60.0, abs=1e-6)
    with pytest.raises(AmiwarpError, match="outside its 'with' block"):
        writer.set_encoder(Encoder.constant_speed(60.0, 5_000_000, 5_001_000))


@pytest.mark.parametrize(
    ("append", "message"),
    [
        (lambda w: w.append(make(5)[::-1]), "event 11 .* earlier"),
        (lambda w: w.append(make(5, start=1000)), "event 10 .* earlier than the one before"),
        (
            lambda w: w.append(Events.from_arrays([320], [0], [9_000_000], [0])),
            "event 10 .* outside the 320x240 frame",
        ),
        (lambda w: w.append(make(5, start=6_000_000), inside=np.ones(5)), "those before"),
        (
            lambda w: w.append(make(5, start=6_000_000), truth_points=np.zeros((4, 2))),
            "expected \\(5, 2\\)",
        ),
        (lambda w: w.append(make(1, start=2**61)), "timestamp is damaged"),
        (lambda w: 1 / 0, "division"),
    ],
)
def test_failure_leaves_nothing(tmp_path, append, message):
    with pytest.raises((AmiwarpError, ZeroDivisionError), match=message):  # noqa: PT012, SIM117
        with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
            writer.append(make(10))
            append(writer)
    assert_nothing_left(tmp_path)


def test_arrays_may_be_used_again_after_append(tmp_path):
    """Some appends end within a chunk, others fill one or several."""
    events, points = make(4 * CHUNK), np.random.default_rng(1).random((4 * CHUNK, 2), np.float32)
    with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
        for start, stop in itertools.pairwise(
            [0, 9, 20, CHUNK + 5, 3 * CHUNK, 3 * CHUNK + 7, 4 * CHUNK]
        ):
            given = Events(*(getattr(events, name)[start:stop].copy() for name in "xytp"))
            xy = points[start:stop].copy()
            writer.append(given, truth_points=xy)
            for array in (given.x, given.y, given.t, given.p, xy):
                array[:] = 0
    recording = open_recording(tmp_path / "a.h5")
    assert_equal(recording.events[:], events)
    np.testing.assert_array_equal(recording.truth.points(0, 4 * CHUNK), points, strict=True)


def test_recording_goes_on_after_refused_events(tmp_path):
    with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
        damaged = Events.from_arrays([1, 1], [1, 1], [7, 2**61], [0, 1])
        with pytest.raises(AmiwarpError, match="timestamp is damaged"):
            writer.append(damaged, inside=[1, 1])
        writer.append(make(10, start=0))
    assert_equal(open_recording(tmp_path / "a.h5").events[:], make(10, start=0))


def test_failure_keeps_the_file_that_was_there(tmp_path):
    path = write(tmp_path / "a.h5", make(10))
    before = path.read_bytes()
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012, SIM117
        with RecordingWriter(path, width=SIZE[0], height=SIZE[1], overwrite=True) as writer:
            writer.append(make(99))
            raise KeyboardInterrupt
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.h5"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "size 0x240"),
        ({"camera": Camera(10, 10, 5.0, 5.0, 4.5, 4.5)}, "give both the same size"),
        ({"metadata": {"big": 10**30}}, "a.h5: making the file"),
        ({"metadata": {"nul": "a\0b"}}, "a.h5: making the file"),
    ],
)
def test_writer_refuses_its_options(tmp_path, options, message):
    with (
        pytest.raises(AmiwarpError, match=message),
        RecordingWriter(tmp_path / "a.h5", **{"width": 320, "height": 240, **options}),
    ):
        pass
    assert_nothing_left(tmp_path)


def test_writer_refuses_its_path(tmp_path):
    path = write(tmp_path / "a.h5", make(10))
    recording = open_recording(path)
    (tmp_path / "link.h5").symlink_to(path)
    for target in (path, tmp_path / "link.h5"):
        with pytest.raises(AmiwarpError, match="write to another file"):
            save_recording(target, recording, overwrite=True)
        with pytest.raises(AmiwarpError, match="is read in this run"):
            write(target, make(10), overwrite=True)
    (tmp_path / "folder.h5").mkdir()
    with refused(ErrorCode.OUTPUT_FAILED):
        write(tmp_path / "folder.h5", make(10))
    with refused(ErrorCode.OUTPUT_FAILED):
        write(tmp_path / "no" / "a.h5", make(10))
    closed = RecordingWriter(tmp_path / "c.h5", width=SIZE[0], height=SIZE[1])
    with closed:
        closed.append(make(1))
    for writer in (RecordingWriter(tmp_path / "b.h5", width=SIZE[0], height=SIZE[1]), closed):
        for use in (
            lambda w: w.append(make(1)),
            lambda w: w.fill([], count=CHUNK, t_first=0),
            lambda w: w.append_image(0, np.zeros((2, 3), np.uint8)),
        ):
            with pytest.raises(AmiwarpError, match="outside its 'with' block, before or after it"):
                use(writer)
    assert len(closed) == len(open_recording(tmp_path / "c.h5").events) == 1
    del recording
    with pytest.raises(AmiwarpError, match=r"a\.h5: exists; .*overwrite=True"):
        write(path, make(20))
    write(path, make(20), overwrite=True)
    assert len(open_recording(path).events) == 20


def _replace(name: str, values):
    def edit(file):
        del file[name]
        file[name] = values

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda f: f["events"].pop("t"), "events/t"),
        (lambda f: f.pop("events"), "no arrays are named as t, x, y and p"),
        (_replace("events", np.zeros(3)), "no arrays are named as t, x, y and p"),
        (_replace("events/x", np.zeros(3, np.uint16)), "differ in length"),
        (_replace("events/x", np.zeros((50, 2), np.uint16)), "one-dimensional"),
        (_replace("events/p", np.zeros(50)), "dataset 'events/p' is float64"),
        (_replace("events/t", np.arange(50)[::-1]), "event 1 .* sort by time"),
        (_replace("events/t", np.full(50, 2**63 - 1, np.uint64)), "beyond int64"),
        (_replace("events/x", np.full(50, 320, np.uint16)), "event 0 .* outside the 320x240 frame"),
        (_replace("events/x", np.full(50, np.nan, np.float32)), "differ|both uint16"),
        (lambda f: f.attrs.modify("format_version", 2), "newer than 1"),
        (lambda f: f.attrs.create("format_version", "two"), "format_version"),
        (lambda f: f.attrs.modify("width", -1), "size -1x240"),
        (lambda f: f.create_group("camera"), "camera has no attribute 'width'"),
        (lambda f: f.create_group("prism").attrs.update(apex=9.0, index=1.5), "prism apex"),
        (
            lambda f: f.create_group("prism").attrs.update(apex=0.1, index=1.5, flat_side="up"),
            "flat_side is 'up'",
        ),
        (lambda f: f.create_group("encoder"), "encoder/t"),
        (lambda f: f.update({"encoder/t": [0, 0], "encoder/angle": [0.0, 1.0]}), "sample 1"),
        (
            lambda f: f.update({"truth/x": np.zeros(9), "truth/y": np.zeros(9)}),
            r"'truth/x' has shape \(9,\); expected \(50,\)",
        ),
    ],
)
def test_damaged_files_name_the_place(tmp_path, edit, message):
    path = write(tmp_path / "a.h5", make(50))
    with h5py.File(path, "r+") as file:
        edit(file)
    with pytest.raises(AmiwarpError, match=message) as caught:
        open_recording(path).events.slice(0, 50)
    assert "a.h5" in str(caught.value)


def test_blocks_are_in_order_across_chunks(tmp_path):
    write(tmp_path / "a.h5", make(2 * CHUNK, mean_us=0))
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["events/t"]
        file["events/t"] = np.repeat([1, 0], CHUNK)
    events = open_recording(tmp_path / "a.h5").events
    for options in ({}, {"count": 1000}, {"duration_us": 10}):
        with pytest.raises(
            AmiwarpError, match=rf"a\.h5: event {CHUNK} .* earlier than the one before"
        ):
            list(events.blocks(**options))


def test_index_that_disagrees_is_noticed(tmp_path):
    path = write(tmp_path / "a.h5", make(5000))
    with h5py.File(path, "r+") as file:
        file["ms_to_idx"][:] = 17
    source = open_recording(path).events
    with pytest.raises(AmiwarpError, match="ms_to_idx disagrees"):
        source.between(5_003_000, 5_004_000)


@pytest.mark.parametrize("checksum", [False, True])
def test_a_compressed_size_that_blosc_would_read_beyond_is_noticed(tmp_path, checksum):
    """Blosc trusts the compressed size of its header, and would read a block far behind the chunk."""
    path = tmp_path / "a.h5"
    blosc = hdf5plugin.Blosc(cname="lz4")
    with h5py.File(path, "w") as file:
        for name, kind in (("x", "u2"), ("y", "u2"), ("t", "u4"), ("p", "u1")):
            values = np.zeros(4096, kind) if name != "t" else np.arange(4096, dtype=kind) * 100
            file.create_dataset(
                f"events/{name}", data=values, chunks=(4096,), fletcher32=checksum, **blosc
            )
    assert len(open_recording(path, time_unit="us").events.slice(0, 9)) == 9
    with h5py.File(path) as file:
        offset = file["events/x"].id.get_chunk_info(0).byte_offset
    raw = bytearray(path.read_bytes())
    raw[offset + 12 : offset + 16] = (0x7FFFFFFF).to_bytes(4, "little")
    raw[offset + 16 : offset + 20] = (0x40000000).to_bytes(4, "little")
    path.write_bytes(raw)
    with pytest.raises(AmiwarpError, match="'events/x' has a damaged chunk"):
        open_recording(path, time_unit="us").events.slice(0, 9)


def test_blosc_parameters_that_would_crash_are_noticed(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name, kind in (("x", "u2"), ("y", "u2"), ("t", "u4"), ("p", "u1")):
            # Filter option 3 is the number of bytes per chunk. The damaged chunk below declares more.
            file.create_dataset(
                f"events/{name}", data=np.zeros(64, kind), chunks=(64,), compression=32001
            )
            assert (
                file[f"events/{name}"].id.get_create_plist().get_filter(0)[2][3]
                == 64 * np.dtype(kind).itemsize
            )
    raw = bytearray(path.read_bytes())
    with h5py.File(path) as file:
        at = file["events/t"].id.get_chunk_info(0).byte_offset
    raw[at + 4 : at + 8] = (1 << 20).to_bytes(4, "little")
    path.write_bytes(raw)
    with pytest.raises(AmiwarpError, match="'events/t' has a damaged chunk"):
        open_recording(path)


def test_example_of_the_documentation(tmp_path, monkeypatch):
    text = (ROOT / "docs" / "reference" / "recording-format.md").read_text(encoding="utf-8")
    code = [
        program
        for program in re.findall(r"```python\n(.*?)```", text, re.DOTALL)
        if '"w"' in program
    ]
    assert len(code) == 1  # the program that reads is tested in test_world_truth.py
    monkeypatch.chdir(tmp_path)
    exec(compile(code[0], "recording-format.md", "exec"), {})
    recording = open_recording("recording.h5")
    assert recording.metadata == {"format": "native"}
    assert (len(recording.events), recording.events.size) == (100_000, (640, 480))
    assert recording.encoder is not None
    assert recording.encoder.covers(recording.events.t_first, recording.events.t_last)
    assert len(recording.events.between(5_010_000, 5_020_000)) == pytest.approx(10_000, abs=500)


def columns_of(file: h5py.File) -> list[h5py.Dataset]:
    return [file[f"events/{name}"] for name in ("x", "y", "t", "p")]


def test_hdf5_reads_every_chunk_with_its_own_filters(tmp_path):
    events = make(2 * CHUNK + 4321)
    with h5py.File(write(tmp_path / "a.h5", events)) as file:
        for name, values in (
            ("x", events.x),
            ("y", events.y),
            ("t", events.t - events.t[0]),
            ("p", events.p),
        ):
            dataset = file[f"events/{name}"]
            creation = dataset.id.get_create_plist()
            assert [creation.get_filter(at)[0] for at in range(creation.get_nfilters())] == [
                32001,
                3,
            ]
            assert dataset.id.get_num_chunks() == 3
            np.testing.assert_array_equal(dataset[:], values, strict=True)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int64, np.float32])
@pytest.mark.parametrize("bits", [0, 3, 13, 40])
def test_chunks_are_those_of_hdf5(tmp_path, kind, bits):
    """amiwarp's own decoder reads files written by h5py with the same filters; checksums agree, for odd lengths too."""
    rng = np.random.default_rng(bits)
    values = rng.integers(0, 1 << min(bits, 8 * np.dtype(kind).itemsize - 2), 3 * CHUNK - 5).astype(
        kind
    )
    with h5py.File(tmp_path / "a.h5", "w") as file:
        blosc = hdf5plugin.Blosc(cname="lz4", clevel=1, shuffle=hdf5plugin.Blosc.BITSHUFFLE)
        file.create_dataset("v", data=values, chunks=(CHUNK,), fletcher32=True, compression=blosc)
    with h5py.File(tmp_path / "a.h5") as file:
        places = [
            (found.byte_offset, found.size) for found in map(file["v"].id.get_chunk_info, range(3))
        ]
        column = StoredColumn(file.id.get_vfd_handle(), file["v"].dtype, values.size, places)
        np.testing.assert_array_equal(column.read(CHUNK, values.size), values[CHUNK:], strict=True)
        for start in range(0, values.size, CHUNK):
            _mask, stored = file["v"].id.read_direct_chunk((start,))
            assert checksum(stored[:-4]) == int.from_bytes(stored[-4:], "little")
            whole = np.zeros(CHUNK, kind)
            whole[: len(values[start : start + CHUNK])] = values[start : start + CHUNK]
            out = np.empty_like(whole)
            assert decode([encode(whole)], out)
            np.testing.assert_array_equal(out, whole)


def test_noise_that_does_not_compress(tmp_path):
    """For such chunks HDF5 skips Blosc and amiwarp stores an uncompressed Blosc frame. Both are read."""
    rng = np.random.default_rng(1)
    t = np.arange(CHUNK + 9)
    x, y = rng.integers(0x3F800000, 0x43800000, (2, t.size), dtype=np.uint32).view(np.float32)
    events = Events(x, y, t, np.ones(t.size, np.uint8))
    ours, theirs = write(tmp_path / "ours.h5", events), tmp_path / "theirs.h5"
    with h5py.File(ours) as file, h5py.File(theirs, "w") as copy:
        copy.attrs.update(file.attrs)
        for dataset in columns_of(file):
            values = dataset[:]
            noise = (
                rng.integers(0, 256, values.size).astype(np.uint8)
                if dataset.name.endswith("p")
                else values
            )
            noise[[0, -1]] = values[[0, -1]]  # which are read on opening
            blosc = hdf5plugin.Blosc(cname="lz4", clevel=1, shuffle=hdf5plugin.Blosc.BITSHUFFLE)
            copy.create_dataset(
                dataset.name, data=noise, chunks=(CHUNK,), fletcher32=True, compression=blosc
            )
        assert copy["events/p"].id.get_chunk_info(0).filter_mask == 1
        np.testing.assert_array_equal(file["events/x"][:], x)
    got = open_recording(ours).events.slice(0, t.size)
    np.testing.assert_array_equal(got.x, x)
    np.testing.assert_array_equal(got.t, t)
    with h5py.File(theirs) as copy:
        noise = copy["events/p"][:]
    source = open_recording(theirs).events
    for name, values in (("x", x), ("t", t), ("p", noise)):
        np.testing.assert_array_equal(source._columns[name].read(0, t.size), values)
    at = int(np.argmax(noise > 1))
    with pytest.raises(
        AmiwarpError, match=rf"theirs\.h5: events 0 .* p holds {noise[at]} \(number {at}\)"
    ):
        source.slice(0, t.size)


@given(st.binary(max_size=3000), st.integers(0, 3))
@settings(max_examples=200)
def test_checksum_is_fletchers(data, fill):
    """Compare with a computation word by word, as HDF5 does it."""
    data = data + bytes([0, 255, 0, 1][fill : fill + 1]) * (700 * fill)
    first = second = 0
    for at in range(0, len(data) - 1, 2):
        first += (data[at] << 8) + data[at + 1]
        first = (first & 0xFFFF) + (first >> 16)
        second += first
        second = (second & 0xFFFF) + (second >> 16)
    if len(data) % 2:
        first += data[-1] << 8
        first = (first & 0xFFFF) + (first >> 16)
        second += first
        second = (second & 0xFFFF) + (second >> 16)
    assert checksum(data) == second << 16 | first


@given(
    st.lists(st.binary(max_size=200), max_size=40),
    st.integers(0, 25_000),
    st.sampled_from([0, 1, 255]),
)
@example([bytes([k]) for k in range(40)], 0, 0)  # several launches
@settings(max_examples=100)
def test_the_kernel_computes_the_same_checksums(parts, size, fill):
    """Also if the sums are multiples of 65535 before a row of zeros."""
    parts = [*parts, bytes([fill]) * size, bytes([fill]) * 11520 + bytes(size), b"".join(parts)]
    assert Checksums()(parts) == [checksum(part) for part in parts]


@pytest.mark.parametrize("name", ["x", "y", "t", "p"])
@pytest.mark.parametrize("place", [0.1, 0.5, 1.0])
def test_a_flipped_bit_in_a_chunk_is_noticed(tmp_path, name, place):
    path = write(tmp_path / "a.h5", make(CHUNK + 999))
    with h5py.File(path) as file:
        chunk = file[f"events/{name}"].id.get_chunk_info(0)
    raw = bytearray(path.read_bytes())
    raw[chunk.byte_offset + 16 + int((chunk.size - 17) * place)] ^= 4
    path.write_bytes(raw)
    with pytest.raises(AmiwarpError, match=r"a\.h5: events 0 \.\. "):
        next(iter(open_recording(path).events.blocks()))


@pytest.mark.usefixtures("every_core")
def test_threads_may_slice_at_once(tmp_path):
    events = make(5 * CHUNK + 7)
    source = open_recording(write(tmp_path / "a.h5", events)).events
    for got, start in zip(
        in_order(source.pieces(CHUNK)), range(0, len(events), CHUNK), strict=True
    ):
        assert_equal(got, events[start : start + CHUNK])
    odd = [(start, start + CHUNK // 2) for start in range(3, len(events), CHUNK // 3)]
    for got, (start, stop) in zip(
        in_order(lambda a=a, b=b: source.slice(a, b) for a, b in odd), odd, strict=True
    ):
        assert_equal(got, events[start:stop])


def test_jobs_run_a_bounded_number_ahead_and_stop_with_the_first_error():
    begun, results = [], []
    before = set(
        threading.enumerate()
    )  # a reader of an earlier test may not have been collected yet

    def job(k: int) -> int:
        begun.append(k)
        time.sleep(0.001 * (k % 3))
        if k == 40:
            raise ZeroDivisionError
        return k

    def take() -> None:
        for result in in_order(lambda k=k: job(k) for k in range(1000)):
            results.append(result)
            assert len(begun) - len(results) <= 2 * 16 + 1

    with pytest.raises(ZeroDivisionError):
        take()
    assert results == list(range(40))
    assert len(begun) < 100
    left = set(threading.enumerate()) - before
    assert not [thread for thread in left if thread.name.startswith("amiwarp-io")]


@pytest.mark.parametrize("fill_cores", [False, True])
def test_jobs_that_fill_the_cores_keep_to_one_each(*, fill_cores: bool) -> None:
    """Only where there is a thread for each core: elsewhere, cores would be idle."""
    most = cores()

    def job() -> tuple[int, bool]:
        threads: list[int] = []
        run_together([lambda: threads.append(threading.get_ident())] * 3)
        return cpu_threads(), set(threads) == {threading.get_ident()}

    for threads in {most, most + 1}:
        found = set(in_order([job] * 4, threads, fill_cores=fill_cores))
        assert found == {(1, True)} if fill_cores else {count for count, _ in found} == {most}
    if most > 1:
        found = set(in_order([job] * 4, most - 1, fill_cores=fill_cores))
        assert {count for count, _ in found} == {most}
    assert cpu_threads() == most


def test_filled_files_are_those_of_append(tmp_path):
    sensor = make(3 * CHUNK + 77)
    events = Events(
        sensor.x.astype(np.float32) - 10.5, sensor.y.astype(np.float32), sensor.t, sensor.p
    )
    inside = (events.x >= -0.5).astype(np.uint8)
    cuts = [slice(start, start + CHUNK) for start in range(0, len(events), CHUNK)]
    seen = []
    with RecordingWriter(tmp_path / "fill.h5", width=SIZE[0], height=SIZE[1]) as writer:
        pieces = [lambda cut=cut: (events[cut], inside[cut], {}) for cut in cuts]
        for block, _, _ in writer.fill(pieces, count=CHUNK, t_first=int(events.t[0])):
            seen.append(len(block))
    with RecordingWriter(tmp_path / "append.h5", width=SIZE[0], height=SIZE[1]) as writer:
        writer.append(events, inside=inside)
    assert seen == [CHUNK, CHUNK, CHUNK, 77]
    with h5py.File(tmp_path / "fill.h5") as filled, h5py.File(tmp_path / "append.h5") as appended:
        for name in (
            "events/x",
            "events/y",
            "events/t",
            "events/p",
            "events/inside",
            "ms_to_idx",
            "t_offset",
        ):
            np.testing.assert_array_equal(filled[name][()], appended[name][()], strict=True)


@pytest.mark.parametrize("full", [0, 2])
def test_the_last_piece_may_be_empty(tmp_path, full):
    events = make(full * CHUNK)
    flags = np.ones(len(events), np.uint8)
    cuts = [slice(index * CHUNK, (index + 1) * CHUNK) for index in range(full + 1)]
    with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
        pieces = [lambda cut=cut: (events[cut], flags[cut], {}) for cut in cuts]
        t_first = int(events.t[0]) if full else 0
        lengths = [len(piece) for piece, _, _ in writer.fill(pieces, count=CHUNK, t_first=t_first)]
    assert lengths == [CHUNK] * full + [0]
    stored = open_recording(tmp_path / "a.h5").events
    np.testing.assert_array_equal(stored.slice(0, len(stored)).t, events.t, strict=True)


@pytest.mark.parametrize("count", [0, -CHUNK, CHUNK + 1])
def test_pieces_of_whole_chunks(tmp_path, count):
    with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
        with pytest.raises(AmiwarpError, match=f"for pieces of {count}; .* multiple of {CHUNK}"):
            writer.fill([], count=count, t_first=0)
        writer.append(make(3))


def test_events_out_of_order_within_a_piece_are_refused(tmp_path):
    sensor = make(50)
    t = sensor.t - sensor.t[0]
    t[7] = t[6] - 1
    events = Events(sensor.x.astype(np.float32), sensor.y.astype(np.float32), t, sensor.p)
    flags = np.ones(50, np.uint8)
    with pytest.raises(AmiwarpError, match=r"event 7 .* earlier than the one before"):  # noqa: SIM117
        with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
            list(writer.fill([lambda: (events, flags, {})], count=CHUNK, t_first=0))
    assert_nothing_left(tmp_path)


@pytest.mark.parametrize("taken", [0, 1])
def test_a_filled_writer_fails_unless_all_pieces_were_taken(tmp_path, taken):
    events = make(2 * CHUNK)
    flags = np.ones(CHUNK, np.uint8)
    pieces = [
        lambda: (events[:CHUNK], flags, {}),
        lambda: (events[CHUNK:], flags, {}),
    ]
    with pytest.raises(AmiwarpError, match="not all pieces of fill"):  # noqa: PT012, SIM117
        with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
            written = writer.fill(pieces, count=CHUNK, t_first=int(events.t[0]))
            for _ in range(taken):
                next(written)
            with pytest.raises(AmiwarpError, match="not all pieces of fill"):
                writer.append(make(1), inside=[1])
    written.close()
    assert_nothing_left(tmp_path)


@pytest.mark.parametrize("flag", ["inside", "extrapolated"])
def test_a_flag_for_each_event(tmp_path, flag):
    with pytest.raises(AmiwarpError, match=rf"events/{flag} has shape \(9,\); expected \(10,\)"):  # noqa: SIM117
        with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
            writer.append(make(10), **{flag: np.ones(9)})
    assert_nothing_left(tmp_path)


def test_an_infinite_position_outside_the_image_is_refused(tmp_path):
    sensor = make(50)
    events = Events(
        sensor.x.astype(np.float32), sensor.y.astype(np.float32), sensor.t - sensor.t[0], sensor.p
    )
    events.y[7], inside = -np.inf, np.ones(50, np.uint8)
    inside[7] = 0
    known = {"events/t": [encode(events.t)], "events/p": [encode(events.p)]}
    with pytest.raises(AmiwarpError, match=r"event 7 .*y=-inf.* infinite"):  # noqa: SIM117
        with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
            list(writer.fill([lambda: (events, inside, known)], count=CHUNK, t_first=0))
    assert_nothing_left(tmp_path)


@pytest.mark.parametrize(
    ("order", "message"),
    [
        ([slice(0, CHUNK), slice(0, CHUNK)], f"event {CHUNK} .* earlier than the one before"),
        ([slice(0, 10), slice(10, 20)], "ends within a chunk"),
        ([slice(0, 0), slice(0, 20)], "is empty; give"),
        ([slice(0, CHUNK), slice(0, 0), slice(CHUNK, 2 * CHUNK)], "is empty; give"),
    ],
)
def test_pieces_that_do_not_follow_leave_nothing(tmp_path, order, message):
    events = make(2 * CHUNK)
    with pytest.raises(AmiwarpError, match=message):  # noqa: PT012, SIM117
        with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
            pieces = [
                lambda cut=cut: (events[cut], np.ones(len(events.t[cut]), np.uint8), {})
                for cut in order
            ]
            list(writer.fill(pieces, count=CHUNK, t_first=int(events.t[0])))
    assert_nothing_left(tmp_path)


def test_only_native_chunks_are_copied_as_they_are(tmp_path):
    events = make(3000)
    save_recording(tmp_path / "a.h5", Recording(MemoryEvents(events, *SIZE)))
    convert(tmp_path / "a.h5", tmp_path / "dsec.h5", format="dsec")
    native, dsec = (open_recording(tmp_path / name).events for name in ("a.h5", "dsec.h5"))
    stored = native.encoded_times_and_polarities(0, 3000)
    assert {name: len(chunks) for name, chunks in stored.items()} == {"events/t": 1, "events/p": 1}
    assert dsec.encoded_times_and_polarities(0, 3000) == {}


def test_full_chunks_do_not_wait_in_memory(tmp_path):
    with RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
        writer.append(make(2 * CHUNK + 9))
        assert writer._events._pending_count == 9
