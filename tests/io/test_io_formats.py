"""Files of data sets, of ROS and of older cameras: read exactly, or named for what they are."""

import contextlib
import gzip
import io
import json
import lzma
import os
import pickle
import sqlite3
import struct
import tarfile
import zipfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import zstandard
from faery.extension import aedat, dat, es, evt
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    DeviceEvents,
    ErrorCode,
    Events,
    EvtDecoder,
    MemoryEvents,
    OutputFormat,
    RadialTangential,
    Recording,
    convert,
    open_recording,
    save_recording,
)
from amiwarp.io import file_scan as scan
from amiwarp.io import read_encoder_triggers
from amiwarp.io.conversion import left_out
from amiwarp.io.prophesee import ecf
from amiwarp.io.prophesee.evt_words import Halves, halves_of, words_of
from amiwarp.io.ros.reader import read_packets
from amiwarp.io.ros.ros2_writer import _types_of
from amiwarp.io.ros.words import Layout
from reference.ecf_files import ecf_chunk, ecf_events, write_ecf
from reference.es_files import ES_SIZE, es_bytes
from reference.evt_words import Evt2Decoder, Evt3Decoder
from reference.io_samples import make_events, refusal, to_faery, write_aedat4
from reference.io_samples_extra import (
    ENCODERS,
    LATE,
    MORE_WRITERS,
    SIZE,
    aedat3_packet,
    array_message,
    arrays,
    evt2_words,
    evt3_words,
    packets,
    small,
    typestore,
    write_aedat2,
    write_aedat3,
    write_bin,
    write_evimo2,
    write_evt21,
    write_m3ed,
    write_mvsec,
    write_prophesee_hdf5,
    write_ros1,
    write_ros2,
)
from tests.command_line import app
from tests.io.test_io_readers import assert_equal, assert_same_source

EVENTS = make_events()
NOTHING = np.zeros(0, np.uint8)


def written(folder: Path, name: str, events: Events = EVENTS) -> Path:
    path = folder / f"sample.{MORE_WRITERS[name][1]}"
    MORE_WRITERS[name][3](path, events)
    return path


@pytest.mark.parametrize("name", MORE_WRITERS)
@pytest.mark.parametrize("keep", [True, False])
def test_formats_read_back(tmp_path, monkeypatch, name, keep):
    if not keep:
        monkeypatch.setattr(scan, "KEEP_EVENTS", 0)
    found, _, size, _ = MORE_WRITERS[name]
    path = written(tmp_path, name)
    recording = open_recording(path)
    assert (recording.metadata["format"], recording.events.size, recording.name) == (
        found,
        size,
        "sample",
    )
    assert_same_source(recording.events, MemoryEvents(EVENTS, *size))
    assert getattr(recording.events, "repairs", {}) == {}
    path.rename(tmp_path / "sample.other")
    assert len(open_recording(tmp_path / "sample.other").events) == len(EVENTS)


@pytest.mark.parametrize("name", MORE_WRITERS)
def test_cut_files_are_read_in_part_or_refused(tmp_path, name):
    path = written(tmp_path, name)
    whole = path.read_bytes()
    for share in (0.01, 0.5, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        said = refusal(open_recording, path)
        if said is None:
            source = open_recording(path).events
            assert 0 < len(source) < len(EVENTS)
            assert_equal(source.slice(0, len(source) - 1), EVENTS[: len(source) - 1])
        else:
            assert str(path) in said
            assert "\n" not in said


def test_evt_words_as_faery_decodes_them(data_dir):
    for name, version in (("evt3_driving_1280x720.raw", "3.0"), ("evt2_balls_640x480.raw", "2.0")):
        path = data_dir / "evt" / name
        data = path.read_bytes()
        start = data.rindex(b"\n% ", 0, 1000)
        words = words_of(data[data.index(b"\n", start + 1) + 1 :], version)
        decoder = EvtDecoder(version)
        # Pieces of odd length.
        found = [decoder.decode(words[at : at + 10_007])[0] for at in range(0, len(words), 10_007)]
        events = DeviceEvents.concatenate(found).to_host()
        x, y, t, p = events.x, events.y, events.t, events.p
        with evt.Decoder(path, (2048, 2048), f"evt{version[0]}") as packets_:
            expected = np.concatenate(
                [packet["events"] for packet in packets_ if "events" in packet]
            )
        raised = t
        if version == "3.0":
            # faery raises a time to the largest in any word before it: of 1455 events, by up to 11 us.
            times, known = Evt3Decoder()._times(words >> 12, (words & 0xFFF).astype(np.int64))
            counts = np.where(known, Layout("evt3").counts(words), 0)
            raised = np.repeat(np.maximum.accumulate(np.where(known, times, 0)), counts)
            assert (np.count_nonzero(raised != t), (raised - t).max()) == (1455, 11)
        source = open_recording(path).events
        columns = source.slice(0, len(source))
        for given, in_file, other, field in (
            (x, columns.x, x, "x"), (y, columns.y, y, "y"), (t, columns.t, raised, "t"), (p, columns.p, p, "p"),
        ):  # fmt: skip
            np.testing.assert_array_equal(in_file, given)
            np.testing.assert_array_equal(other, expected[field])


def test_real_words_of_bags_as_faery_decodes_them(data_dir, tmp_path):
    """Of both bags with EVT 3.0. faery reads no bags, so it gets the words of all messages as a RAW file."""
    store = typestore(False)
    for name in ("evt3_trigger", "ros2_evt3_640x480_trig10Hz"):
        path = data_dir / f"rosbag/{name}.db3"
        source = open_recording(path).events
        with contextlib.closing(sqlite3.connect(path)) as bag:
            rows = bag.execute(
                "select messages.data from messages join topics on topics.id = topic_id "
                "where type like 'event_%_msgs/msg/Event%' order by messages.timestamp, messages.id"
            ).fetchall()
        found = [store.deserialize_cdr(row, "event_camera_msgs/msg/EventPacket") for (row,) in rows]
        (tmp_path / "a.raw").write_bytes(
            b"% evt 3.0\n% end\n" + b"".join(each.events.tobytes() for each in found)
        )
        with evt.Decoder(tmp_path / "a.raw", (2048, 2048), "evt3") as packets_:
            expected = np.concatenate(
                [packet["events"] for packet in packets_ if "events" in packet]
            )
        events = source.slice(0, len(source))
        for field in "xytp":
            np.testing.assert_array_equal(getattr(events, field), expected[field])


def test_real_dat_file_as_faery_reads_it(data_dir, tmp_path):
    """faery refuses the type of the file's events, 2D, which has the layout of CD events."""
    data = (data_dir / "small/ncars.dat").read_bytes()
    source = open_recording(data_dir / "small/ncars.dat").events
    at = data.index(b"\x00\x08")
    (tmp_path / "a.dat").write_bytes(data[:at] + b"\x0c" + data[at + 1 :])
    with dat.Decoder(tmp_path / "a.dat", (128, 128), None) as decoder:
        expected = np.concatenate(list(decoder))
    events = source.slice(0, len(source))
    for field, other in (("x", "x"), ("y", "y"), ("t", "t"), ("p", "payload")):
        np.testing.assert_array_equal(getattr(events, field), expected[other])


@pytest.mark.parametrize(
    ("words", "decoder"), [(evt2_words, Evt2Decoder(vectors=False)), (evt3_words, Evt3Decoder())]
)
def test_evt_words_in_pieces(words, decoder):
    data = words(EVENTS)
    found = [decoder.decode(data[at : at + 7])[0] for at in range(0, len(data), 7)]
    x, y, t, p = (np.concatenate(parts) for parts in zip(*found, strict=True))
    for given, field in ((x, "x"), (y, "y"), (p, "p"), (t - t[0], "t")):
        expected = EVENTS.t - EVENTS.t[0] if field == "t" else getattr(EVENTS, field)
        np.testing.assert_array_equal(given, expected)


def test_evt3_time_runs_on_past_24_bits(tmp_path):
    events = Events(EVENTS.x, EVENTS.y, EVENTS.t + np.arange(len(EVENTS)) * 200_000, EVENTS.p)
    t = Evt3Decoder().decode(evt3_words(events))[0][2]
    np.testing.assert_array_equal(t, events.t)
    assert t[-1] > 7 << 24


@pytest.mark.parametrize("legacy", [True, False])
@pytest.mark.parametrize("header", [None, "% evt 2.1\n% geometry 320x240\n"])
def test_evt21_in_both_byte_orders(tmp_path, legacy, header):
    write_evt21(tmp_path / "a.raw", EVENTS, legacy=legacy, header=header)
    if header is None and not legacy:
        (tmp_path / "a.raw").write_bytes(
            (tmp_path / "a.raw").read_bytes().replace(b"EVT21;", b"EVT21;endianness=little;")
        )
    recording = open_recording(tmp_path / "a.raw")
    assert recording.events.size == SIZE
    assert_equal(recording.events.slice(0, 999), EVENTS)


ONLY_COUNTED = "only counted: amiwarp does not read them from this format"


@pytest.mark.parametrize(
    ("version", "name", "dtype", "unknown"),
    [("2", "evt2.0", "<u4", 10), ("21", "evt2.1", "<u8", 10), ("3", "evt3.0", "<u2", 5)],
)
def test_words_of_unknown_types_are_counted(tmp_path, version, name, dtype, unknown):
    """Words of all 16 types, more than a block has, below a header that names the version in short; one comes first."""
    shift = 8 * np.dtype(dtype).itemsize - 4
    turns = 2100
    words = [0x9 << shift, 0x8 << shift, *[kind << shift | 1 for kind in range(16)] * turns]
    head = f"% format EVT{version};endianness=little;width=2048;height=2048\n% end\n".encode()
    (tmp_path / "a.raw").write_bytes(head + np.array(words, dtype).tobytes())
    recording = open_recording(tmp_path / "a.raw")
    assert (recording.metadata["format"], recording.metadata["unknown_words"]) == (
        name,
        1 + unknown * turns,
    )


def test_evt21_vectors(tmp_path):
    words = np.array(
        [0x8 << 60 | 5 << 32, 1 << 60 | 3 << 54 | 64 << 43 | 9 << 32 | 0x80000005], np.uint64
    )
    (tmp_path / "a.raw").write_bytes(
        b"% evt 2.1\n% format EVT21;endianness=little;height=720;width=1280\n% end\n"
        + words.tobytes()
    )
    events = open_recording(tmp_path / "a.raw").events.slice(0, 9)
    assert (events.x.tolist(), events.y.tolist()) == ([64, 66, 95], [9, 9, 9])
    assert (events.t.tolist(), events.p.tolist()) == ([5 * 64 + 3] * 3, [1, 1, 1])


def test_aedat2_tells_events_from_frames_imu_and_triggers(tmp_path):
    now = int(EVENTS.t[100])
    frame = [
        (1 << 31 | y << 22 | x << 12 | kind << 10 | 99, now)
        for kind in (0, 1)
        for y in (0, 1)
        for x in (0, 1)
    ]
    imu = [(1 << 31 | kind << 28 | 500 << 12 | 3 << 10, now) for kind in range(7)]
    edges = [(1 << 10, now), (1 << 10, now + 1000), (1 << 10, now + 2000)]
    extra = np.array(frame + imu + imu + edges[:1], ">u4").tobytes()
    write_aedat2(tmp_path / "a.aedat", EVENTS, between=extra)
    recording = open_recording(tmp_path / "a.aedat")
    assert_equal(recording.events.slice(0, 999), EVENTS)
    assumed = "assumed: 8 g and 1000 deg/s, the defaults of jAER"
    assert recording.metadata == {
        "format": "aedat2", "frames": 1, "imu_samples": 2, "triggers": 1, "imu_ranges": assumed,
        "frames_note": ONLY_COUNTED,
    }  # fmt: skip
    (tmp_path / "a.aedat").write_bytes(
        (tmp_path / "a.aedat").read_bytes() + np.array(edges[1:], ">u4").tobytes()
    )
    assert read_encoder_triggers(tmp_path / "a.aedat").rpm == pytest.approx(60_000)


def test_aedat2_of_a_dvs128_and_wrapping_times(tmp_path):
    events = small(EVENTS, 128, 128, t_first=2**32 - 3000)
    write_aedat2(tmp_path / "a.aedat", events, chip="DVS128")
    recording = open_recording(tmp_path / "a.aedat")
    assert recording.events.size == (128, 128)
    assert_equal(recording.events.slice(0, 999), events)
    assert events.t[-1] > 2**32
    (tmp_path / "a.aedat").write_bytes(
        (tmp_path / "a.aedat").read_bytes().replace(b"DVS128", b"Cochlea")
    )
    with pytest.raises(
        AmiwarpError,
        match=r"a\.aedat: .*names camera 'eu.seebetter.*Cochlea'; expected one of .*--chip",
    ):
        open_recording(tmp_path / "a.aedat")


def aedat2_file(path: Path, lines: list[str], newline: str, records: np.ndarray) -> Recording:
    path.write_bytes(
        "".join(line + newline for line in lines).encode() + records.astype(">u4").tobytes()
    )
    return open_recording(path)


@pytest.mark.parametrize("newline", ["\r\n", "\n", "\r"])
@pytest.mark.parametrize("last", [["#End Of ASCII Header"], []])
@pytest.mark.parametrize("first", [0x23500800, 0x230A0800, 0x0A0D0800])
def test_aedat2_records_may_begin_like_a_line_of_the_header(tmp_path, newline, last, first):
    """The first bytes are ``#P``, ``#`` with a newline, or newlines."""
    lines = [
        "#!AER-DAT2.0",
        "# This is a raw AE data file",
        "#\tAEChip: eu.seebetter.ini.chips.davis.Davis346red",
    ]
    records = np.array([[first, 1000], [0x23000800, 1000], [0, 2000]])
    events = aedat2_file(tmp_path / "a.aedat", lines + last, newline, records).events
    assert (len(events), events.size, events.t_first, events.t_last) == (3, (346, 260), 1000, 2000)
    found = events.slice(0, 3)
    assert found.x.tolist() == [345 - (int(word) >> 12 & 0x3FF) for word, _ in records]
    assert found.y.tolist() == [259 - (int(word) >> 22 & 0x1FF) for word, _ in records]
    # A file without records ends with its header.
    assert "holds no events" in str(
        refusal(aedat2_file, tmp_path / "a.aedat", lines + last, newline, records[:0])
    )


def davis_record(x: int, y: int, t: int) -> tuple[int, int]:
    """Record of an event at a column and a row from the lower right."""
    return y << 22 | x << 12 | 1 << 11, t


@pytest.mark.parametrize(
    ("records", "name", "size"),
    [
        ([(127 << 8 | 127 << 1, 10), (1 << 15, 20)], "dvs128", (128, 128)),
        ([davis_record(127, 5, 10)], "davis128", (128, 128)),
        ([davis_record(5, 191, 10)], "davis208", (208, 192)),
        ([davis_record(239, 5, 10), davis_record(5, 179, 20)], "davis240", (240, 180)),
        ([davis_record(5, 192, 10)], "davis346", (346, 260)),
        (
            [davis_record(345, 5, 10), (1 << 31 | 1000 << 12, 20), (1 << 10 | 1000 << 12, 30)],
            "davis346",
            (346, 260),
        ),
        ([davis_record(346, 5, 10)], "davis640", (640, 480)),
    ],
)
def test_aedat2_without_a_camera_takes_the_smallest_and_says_so(tmp_path, records, name, size):
    """Samples of frames and edges have other bits than events."""
    recording = aedat2_file(tmp_path / "a.aedat", ["#!AER-DAT2.0"], "\r\n", np.array(records))
    assert recording.events.size == size
    assert recording.metadata["assumed_chip"] == (
        f"{name}: the header names no camera, and this is the smallest that has the largest address; --chip"
    )
    recording = open_recording(tmp_path / "a.aedat", chip="Davis640")
    assert (recording.events.size, "assumed_chip" in recording.metadata) == ((640, 480), False)
    with pytest.raises(
        AmiwarpError, match=r"a\.aedat: .*chip is 'gen4'; expected one of dvs128, davis128, "
    ):
        open_recording(tmp_path / "a.aedat", chip="gen4")
    np.savez(tmp_path / "a.npz", x=[1], y=[1], t=[1], p=[1])
    with pytest.raises(
        AmiwarpError, match=r"a\.npz: is of the format npz, which needs no chip; leave"
    ):
        open_recording(tmp_path / "a.npz", chip="dvs128")


def test_triggers_of_a_dvs128(tmp_path):
    """The bit above the address marks an edge; its other bits are none of an event."""
    edges = np.array([[1 << 15 | 0x7FFF, 1000], [1 << 15, 3000]], ">u4").tobytes()
    events = small(EVENTS, 128, 128, t_first=0)
    write_aedat2(tmp_path / "a.aedat", events, chip="DVS128", between=edges)
    recording = open_recording(tmp_path / "a.aedat")
    assert_equal(recording.events.slice(0, 999), events)
    assert recording.metadata["triggers"] == 2
    assert left_out(recording, OutputFormat.NATIVE) == ("triggers",)
    assert "triggers" in left_out(recording, OutputFormat.EVT3)
    used = replace(recording, encoder=read_encoder_triggers(tmp_path / "a.aedat"))
    assert left_out(used, OutputFormat.NATIVE) == ()
    assert np.diff(read_encoder_triggers(tmp_path / "a.aedat").t).tolist() == [2000]


def test_triggers_of_an_unknown_camera_take_its_chip(tmp_path):
    edges = np.array([[1 << 15 | 0x7FFF, 1000], [1 << 15, 3000]], ">u4").tobytes()
    path = tmp_path / "a.aedat"
    write_aedat2(path, small(EVENTS, 128, 128, t_first=0), chip="DVS128", between=edges)
    path.write_bytes(path.read_bytes().replace(b"DVS128", b"MyChip", 1))
    with pytest.raises(AmiwarpError, match="choose one with --chip"):
        read_encoder_triggers(path)
    assert np.diff(read_encoder_triggers(path, chip="dvs128").t).tolist() == [2000]
    given = ("--chip", "dvs128", "--encoder-from", "triggers:0")
    out = tmp_path / "a.h5"
    done = CliRunner().invoke(app, ["convert", str(path), str(out), *given])
    assert done.exit_code == 0, done.stderr
    assert np.diff(open_recording(tmp_path / "a.h5").encoder.t).tolist() == [2000]


def test_fields_of_words_are_read_over_their_whole_range(tmp_path):
    """The corners of the largest frame of each format, both polarities, and each bit of the coordinates alone."""
    bits = [0, *(1 << k for k in range(16))]

    def corners(width: int, height: int) -> Events:
        pairs = [
            (x, y) for x in (*(b for b in bits if b < width), width - 1) for y in (0, height - 1)
        ]
        pairs += [(x, y) for x in (0, width - 1) for y in bits if y < height]
        x, y = np.array(pairs, np.uint16).T
        return Events(
            x, y, 64 * 4096 + 37 * np.arange(len(pairs)), np.arange(len(pairs), dtype=np.uint8) % 2
        )

    for version, width, height, shifts in (("1", 512, 256, (9, 17)), ("2", 16384, 16384, (14, 28))):
        events = corners(width, height)
        x, y, p = (column.astype(np.uint32) for column in (events.x, events.y, events.p))
        words = np.stack(
            [events.t.astype(np.uint32), x | y << shifts[0] | p << shifts[1]], axis=1
        ).astype("<u4")
        head = f"% Version {version}\n% Width {width}\n% Height {height}\n".encode() + b"\x0c\x08"
        (tmp_path / f"{version}.dat").write_bytes(head + words.tobytes())
        recording = open_recording(tmp_path / f"{version}.dat")
        assert (recording.metadata["format"], recording.events.size) == (
            f"dat{version}",
            (width, height),
        )
        assert_equal(recording.events.slice(0, 999), events)
    events = corners(2048, 2048)
    for vectors in (False, True):
        columns, _ = Evt2Decoder(vectors=vectors).decode(evt2_words(events, vectors=vectors))
        assert_equal(Events.from_arrays(*columns), events)
    (x, y, t, p), _ = Evt3Decoder().decode(evt3_words(events))
    assert_equal(Events.from_arrays(x, y, t, p), events)


def test_aedat3_triggers_sources_and_overflow(tmp_path):
    late = int(EVENTS.t[120])
    special = np.array(
        [[2 << 1 | 1, late], [3 << 1 | 1, late], [2 << 1, late], [2 << 1 | 1, late + 500]], "<u4"
    )
    other = np.array([[1 << 17 | 1, late]], "<u4")
    between = aedat3_packet(0, special) + aedat3_packet(1, other, source=2)
    write_aedat3(tmp_path / "a.aedat", EVENTS, between=between)
    recording = open_recording(tmp_path / "a.aedat")
    assert_equal(recording.events.slice(0, 999), EVENTS)
    assert recording.metadata == {
        "format": "aedat3", "imu_samples": 5, "triggers": 3, "events_of_other_sources": 1, "invalid_events": 1,
    }  # fmt: skip
    assert np.diff(read_encoder_triggers(tmp_path / "a.aedat").t).tolist() == [500]
    later = Events(EVENTS.x, EVENTS.y, EVENTS.t + 2**31, EVENTS.p)
    write_aedat3(tmp_path / "b.aedat", later)
    assert_equal(open_recording(tmp_path / "b.aedat").events.slice(0, 999), later)
    (tmp_path / "b.aedat").write_bytes(
        (tmp_path / "b.aedat").read_bytes().replace(b"Format: RAW", b"Format: PNG")
    )
    with pytest.raises(AmiwarpError, match=r"b\.aedat: .*the packets have the format 'PNG'"):
        open_recording(tmp_path / "b.aedat")


def test_aedat3_events_that_are_invalid_and_packets_of_other_types_are_counted(tmp_path):
    """One event without its valid bit, and a packet of 100 events whose type is that of a configuration."""
    path = tmp_path / "a.aedat"
    write_aedat3(path, EVENTS)
    data = bytearray(path.read_bytes())
    start = data.index(b"#!END-HEADER\r\n") + 14
    data[start + 28 + 8 * 5] ^= 1
    last = len(data) - 28 - 8 * 100
    data[last] = 7
    path.write_bytes(data)
    recording = open_recording(path)
    assert len(recording.events) == len(EVENTS) - 101
    assert (recording.metadata["invalid_events"], recording.metadata["packets_of_other_types"]) == (
        1,
        1,
    )


def test_bin_with_and_without_marks(tmp_path):
    events = small(EVENTS, 34, 34, t_first=0)
    write_bin(tmp_path / "a.bin", events)
    recording = open_recording(tmp_path / "a.bin")
    assert (recording.events.size, set(recording.metadata)) == (
        (34, 34),
        {"format", "assumed_size"},
    )
    assert_equal(recording.events.slice(0, 999), events)
    # A file without a header can begin like any other: here like text, a PDF, a bitmap and a gzip archive.
    for x, y in ((ord("1"), ord(" ")), (ord("%"), ord("P")), (ord("B"), ord("M")), (0x1F, 0x8B)):
        first = small(EVENTS, 200, 170, t_first=0)
        first.x[0], first.y[0] = x, y
        write_bin(tmp_path / "c.bin", first)
        assert_equal(open_recording(tmp_path / "c.bin").events.slice(0, 999), first)
    wide = small(EVENTS, 200, 170, t_first=0)
    marked = Events(wide.x, wide.y, wide.t % 2**13, wide.p)
    at = int(np.searchsorted(wide.t, 2**13))
    parts = [
        marked[:at],
        Events(*(np.array([v], d) for v, d in ((0, "u2"), (240, "u2"), (0, "i8"), (0, "u1")))),
        marked[at:],
    ]
    write_bin(tmp_path / "b.bin", Events.concatenate(parts))
    recording = open_recording(tmp_path / "b.bin")
    assert (recording.events.size, recording.metadata["overflow_marks"]) == ((240, 180), 1)
    assert_equal(recording.events.slice(0, 999), wide)


# Event Stream.


@pytest.mark.parametrize("piece", [1, 4, 7, 1 << 20])
@pytest.mark.parametrize("kind", ["dvs", "atis"])
def test_event_stream_files(tmp_path, monkeypatch, kind, piece):
    """Gaps of more than a byte of time, columns of more than a byte, and exposures of an ATIS, which are left out."""
    monkeypatch.setattr("amiwarp.io.event_stream.PIECE_BYTES", piece)
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.choice([0, 1, 62, 63, 64, 126, 127, 128, 400, 70_000], 200))
    events = Events.from_arrays(
        rng.integers(0, 300, 200), rng.integers(0, 260, 200), t, rng.integers(0, 2, 200)
    )
    exposure = rng.random(200) < 0.3 if kind == "atis" else np.zeros(200, np.bool_)
    path = tmp_path / "a.es"
    path.write_bytes(es_bytes(events, kind, exposure=exposure))
    recording = open_recording(path)
    kept = Events(*(getattr(events, name)[~exposure] for name in "xytp"))
    assert (recording.metadata, recording.events.size) == ({"format": "es"}, ES_SIZE)
    assert_equal(recording.events.slice(0, 999), kept)
    with es.Decoder(path, 0) as decoder:
        expected = np.concatenate(list(decoder))
    if kind == "atis":
        expected = expected[~expected["exposure"].astype(bool)]
    np.testing.assert_array_equal(expected["t"], kept.t)
    np.testing.assert_array_equal(expected["x"], kept.x)
    np.testing.assert_array_equal(ES_SIZE[1] - 1 - expected["y"], kept.y)


def test_event_stream_files_that_are_cut_or_damaged(tmp_path):
    path = tmp_path / "a.es"
    whole = es_bytes(small(EVENTS, 300, 240, t_first=0), "dvs")
    path.write_bytes(whole[:-2])  # the last event lacks a byte, and its reset
    recording = open_recording(path)
    assert (len(recording.events), recording.metadata["truncated_bytes"]) == (len(EVENTS) - 1, 4)
    path.write_bytes(whole[:-1])  # no reset follows
    assert open_recording(path).metadata == {"format": "es"}
    outside = bytearray(whole)
    outside[-2] = 1  # row 256 + from the bottom
    path.write_bytes(outside)
    assert open_recording(path).metadata.get("dropped_outside_events", 0) == int(whole[-3] > 3)
    for at, value, message in (
        (12, 1, r"has the version 1\.0\.0; expected 2"), (15, 0, "holds generic events; expected dvs or atis"),
        (15, 9, r"holds unknown \(type 9\) events"),
    ):  # fmt: skip
        other = bytearray(whole)
        other[at] = value
        path.write_bytes(other)
        with pytest.raises(AmiwarpError, match=rf"a\.es: .*{message}"):
            open_recording(path)
    path.write_bytes(whole[:14])
    with pytest.raises(AmiwarpError, match=r"a\.es: .*the header ends beyond the file"):
        open_recording(path)


def test_evimo2_folders(tmp_path):
    write_evimo2(tmp_path / "scene", EVENTS)
    recording = open_recording(tmp_path / "scene")
    assert (recording.events.size, recording.name) == (SIZE, "scene")
    assert_equal(recording.events.slice(0, 999), EVENTS)
    assert convert(tmp_path / "scene", tmp_path / "out.h5").events == len(EVENTS)
    np.save(tmp_path / "scene/dataset_events_p.npy", EVENTS.p[:5])
    with pytest.raises(
        AmiwarpError,
        match=r"scene: .*the arrays have the shapes t \(600,\), xy \(600, 2\), p \(5,\)",
    ):
        open_recording(tmp_path / "scene")
    (tmp_path / "scene/dataset_events_p.npy").unlink()
    with pytest.raises(AmiwarpError, match=r"dataset_events_p\.npy: no such file"):
        open_recording(tmp_path / "scene")


def test_m3ed_has_a_camera_and_several_need_a_choice(tmp_path):
    write_m3ed(tmp_path / "a.h5", EVENTS, sides=("left", "right"))
    with pytest.raises(
        AmiwarpError, match=r"cameras: prophesee/left, prophesee/right; choose one with .*--topic"
    ):
        open_recording(tmp_path / "a.h5")
    recording = open_recording(tmp_path / "a.h5", topic="prophesee/right")
    lens = RadialTangential(-0.3, 0.1, 1e-4, -2e-4, 0.0)
    assert recording.camera == Camera(*SIZE, 200.0, 201.0, 150.0, 110.0, lens)
    assert recording.metadata == {"format": "m3ed", "topic": "prophesee/right"}
    with pytest.raises(
        AmiwarpError, match="no events in 'middle'; the choices for --topic are prophesee/left"
    ):
        open_recording(tmp_path / "a.h5", topic="middle")


def test_mvsec_counts_frames_and_needs_a_choice(tmp_path):
    write_mvsec(tmp_path / "a.hdf5", EVENTS, sides=("left", "right"))
    assert "davis/left, davis/right; choose one" in str(
        refusal(open_recording, tmp_path / "a.hdf5")
    )
    recording = open_recording(tmp_path / "a.hdf5", topic="davis/left")
    assert recording.metadata == {
        "format": "mvsec",
        "topic": "davis/left",
        "frames": 3,
        "imu_samples": 7,
    }
    assert convert(tmp_path / "a.hdf5", tmp_path / "out.h5", topic="davis/right").events == len(
        EVENTS
    )


def test_triggers_in_prophesee_hdf5(tmp_path):
    write_prophesee_hdf5(tmp_path / "a.hdf5", EVENTS, compression="gzip")
    assert open_recording(tmp_path / "a.hdf5").metadata["triggers"] == 4
    assert read_encoder_triggers(tmp_path / "a.hdf5").rpm == pytest.approx(30_000)


@pytest.mark.parametrize("mode", ["packed", "rows", "masks"])
def test_prophesee_hdf5_without_its_codec(tmp_path, mode):
    """The last chunk is padded, and the first one may be stored without the codec."""
    events = ecf_events(2003)
    padded = Events.concatenate([events, *[events[-1:]] * 397])
    chunks = [ecf_chunk(padded[at : at + 800], mode) for at in (0, 800, 1600)]
    write_ecf(tmp_path / "a.hdf5", chunks, 2003, 800)
    recording = open_recording(tmp_path / "a.hdf5")
    assert (recording.metadata, recording.events.size) == ({"format": "ecf", "topic": "CD"}, SIZE)
    assert_equal(recording.events.slice(0, 9999), events)
    plain = np.zeros(800, [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("pad", "<i2"), ("t", "<i8")])
    for name in "xytp":
        plain[name] = getattr(events, name)[:800]
    write_ecf(tmp_path / "b.hdf5", [plain.tobytes(), *chunks[1:]], 2003, 800, mask=1)
    assert_equal(open_recording(tmp_path / "b.hdf5").events.slice(0, 9999), events)


@pytest.mark.parametrize("mode", ["packed", "rows", "masks"])
def test_chunks_of_ecf_hold_coordinates_of_eleven_bits(mode):
    x, y = [0, 1023, 1024, 1279, 2047, 1500], [2047, 719, 1024, 0, 1023, 5]
    events = Events.from_arrays(x, y, [10, 10, 12, 30, 400, 401], [0, 1, 1, 0, 1, 0])
    chunk = ecf_chunk(events, mode)
    assert_equal(ecf.decode_chunks(chunk, [len(chunk)])[0].to_host(), events)


def test_prophesee_hdf5_that_is_damaged(tmp_path):
    events = ecf_events(800)
    path = tmp_path / "a.hdf5"
    for mode in ("packed", "rows", "masks"):
        whole = ecf_chunk(events, mode)
        for chunk, message in (
            (whole[:-3], "of a chunk of the ECF codec, number 1 of 1, are damaged"),
            (whole[:5], "dataset 'CD/events': a chunk .* has 5 bytes; expected 12 of its head"),
            (struct.pack("<I", 1 << 31) + whole[4:], r"has 536870912 events in \d+ bytes; expected at most 65535"),
            (ecf_chunk(events[:700], mode), "a chunk has 700 events; expected 800"),
            (whole[:12] + b"\xf1" * 20 + whole[12:], "the times of a chunk"),
        ):  # fmt: skip
            write_ecf(path, [chunk], 800, 800)
            with pytest.raises(AmiwarpError, match=rf"a\.hdf5: .*{message}"):
                open_recording(path)
    write_ecf(path, [b"\0" * (32 * 65535 + 1)], 800, 800)
    with pytest.raises(
        AmiwarpError, match=r"a\.hdf5: .*a chunk has 2097121 bytes; expected at most 2097120"
    ):
        open_recording(path)
    write_ecf(path, [ecf_chunk(events, "packed")], 800, 800, 32004)
    with pytest.raises(
        AmiwarpError, match=r"a\.hdf5: .*ECF codec and another filter, .*HDF5_PLUGIN_PATH"
    ):
        open_recording(path)


def test_hdf5_without_known_events_is_named(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"] = np.zeros((3, 4))
        file["labels"] = np.zeros(3)
    message = str(refusal(open_recording, tmp_path / "a.h5"))
    assert "no arrays are named as t, x, y and p; its arrays are data, labels" in message
    assert "--columns, such as t=NAME,x=NAME,y=NAME,p=NAME" in message
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("davis/left/events", shape=(10**15, 4), dtype="f8", chunks=(1000, 4))
    assert "declares 1000000000000000 rows, which it does not hold" in str(
        refusal(open_recording, tmp_path / "b.h5")
    )


@pytest.mark.parametrize("package", ["dvs_msgs", "prophesee_event_msgs"])
@pytest.mark.parametrize("ros1", [True, False])
def test_arrays_of_ros(tmp_path, package, ros1):
    messages = {"/events": arrays(EVENTS, ros1=ros1, package=package)}
    path = tmp_path / "a.bag"
    if ros1:
        write_ros1(path, messages)
    else:
        path = write_ros2(tmp_path / "a", messages)
    recording = open_recording(path)
    assert recording.events.size == SIZE
    assert_equal(recording.events.slice(0, 999), EVENTS)


@pytest.mark.parametrize("encoding", ENCODERS)
@pytest.mark.parametrize("ros1", [True, False])
def test_packets_of_ros(tmp_path, encoding, ros1):
    events = (
        Events(EVENTS.x, EVENTS.y, EVENTS.t + LATE, EVENTS.p) if encoding == "libcaer" else EVENTS
    )
    topics = {"/camera/events": packets(encoding, events, ros1=ros1)}
    path = tmp_path / "a.bag"
    if ros1:
        write_ros1(path, topics)
    else:
        path = write_ros2(tmp_path / "a", topics)
    assert_equal(open_recording(path).events.slice(0, 999), events)


def test_folder_of_a_ros2_bag(tmp_path):
    write_ros2(tmp_path / "a", {"/events": packets("evt3", EVENTS)})
    recording = open_recording(tmp_path / "a")
    assert (recording.metadata["topic"], recording.name) == ("/events", "a")
    assert_equal(recording.events.slice(0, 999), EVENTS)


def test_topics_of_a_bag(tmp_path):
    store = typestore(True)
    text = store.types["std_msgs/msg/String"]("hello")
    two = {
        "/left": arrays(EVENTS, ros1=True),
        "/right": arrays(EVENTS[:99], ros1=True),
        "/chatter": [text],
    }
    write_ros1(tmp_path / "a.bag", two)
    with pytest.raises(
        AmiwarpError, match=r"events in several topics: /left \(\d+ messages\), /right .*--topic"
    ):
        open_recording(tmp_path / "a.bag")
    assert len(open_recording(tmp_path / "a.bag", topic="/right").events) == 99
    assert convert(tmp_path / "a.bag", tmp_path / "out.h5", topic="/left").events == len(EVENTS)
    with pytest.raises(
        AmiwarpError, match=r"no events in the topic '/chatter'; the topics with events are /left"
    ):
        open_recording(tmp_path / "a.bag", topic="/chatter")
    write_ros1(tmp_path / "b.bag", {"/chatter": [text]})
    with pytest.raises(
        AmiwarpError, match=r"without event topics; its topics are /chatter \(std_msgs/String\)"
    ):
        open_recording(tmp_path / "b.bag")
    path = write_ros2(
        tmp_path / "d", {"/chatter": [typestore(False).types["std_msgs/msg/String"]("hello")]}
    )
    assert "is a ROS 2 bag without event topics; its topics are /chatter" in str(
        refusal(open_recording, path)
    )
    np.savez(tmp_path / "c.npz", x=[1], y=[1], t=[1], p=[1])
    with pytest.raises(AmiwarpError, match=r"c\.npz: holds one stream of events, no topics"):
        open_recording(tmp_path / "c.npz", topic="/left")


def test_messages_of_ros_that_are_refused(tmp_path):
    big = packets("evt3", EVENTS)
    big[0].is_bigendian = True
    path = write_ros2(tmp_path / "a", {"/events": big})
    assert "big-endian words" in str(refusal(open_recording, path))
    other = packets("evt3", EVENTS)
    other[0].encoding = "zip"
    path = write_ros2(tmp_path / "b", {"/events": other})
    assert "encoding 'zip'; expected one of evt3" in str(refusal(open_recording, path))
    changed = [*packets("mono", EVENTS), *packets("evt3", EVENTS)]
    path = write_ros2(tmp_path / "d", {"/events": changed})
    several = (
        "has packets of several encodings, now 'evt3'; record the topic again with one encoding"
    )
    with pytest.raises(AmiwarpError, match=several):
        open_recording(path)
    store = typestore(True)
    empty = array_message(store, EVENTS[:0], ros1=True)
    write_ros1(tmp_path / "c.bag", {"/events": [empty]})
    assert "holds no events" in str(refusal(open_recording, tmp_path / "c.bag"))


def test_triggers_become_an_encoder(data_dir, tmp_path):
    path = data_dir / "rosbag/ros2_evt3_640x480_trig10Hz.db3"
    encoder = read_encoder_triggers(path, 6)
    assert (len(encoder.t), encoder.rpm) == (18, pytest.approx(600.0))
    assert encoder.index_t is not None
    assert encoder.index_t.tolist() == encoder.t.tolist()
    source = open_recording(path).events
    assert encoder.covers(source.t_first, source.t_last)
    with pytest.raises(
        AmiwarpError, match=r"0 rising trigger edges of channel 0; .*edges are: 18 of channel 6"
    ):
        read_encoder_triggers(path, 0)
    counts = read_encoder_triggers(path, 6, counts_per_turn=4, direction=-1)
    assert (counts.rpm, counts.index_t) == (pytest.approx(-150.0), None)
    summary = convert(path, tmp_path / "out.h5", encoder=encoder)
    assert (summary.events, summary.index_slip, summary.encoder_covers) == (
        378_266,
        pytest.approx(0.0, abs=1e-9),
        True,
    )
    write_bin(tmp_path / "a.bin", small(EVENTS, 34, 34, t_first=0))
    with pytest.raises(AmiwarpError, match=r"files of the format bin store no triggers"):
        read_encoder_triggers(tmp_path / "a.bin")
    with pytest.raises(AmiwarpError, match=r"out.h5: .*only Prophesee's files hold triggers"):
        read_encoder_triggers(tmp_path / "out.h5")


@pytest.mark.parametrize("version", ["2", "3", "2.1"])
def test_triggers_of_raw_files(tmp_path, version):
    if version == "3":
        words = np.array(
            [0x8001, 0x6005, 0xA301, 0x0007, 0x6006, 0x280A, 0x6009, 0xA300, 0x6010, 0xA301], "<u2"
        )
    else:
        words = np.array([0x8 << 28 | 1, 0xA << 28 | 5 << 22 | 3 << 8, 1 << 28 | 6 << 22 | 10 << 11 | 7,
                          0xA << 28 | 9 << 22 | 3 << 8, 0xA << 28 | 16 << 22 | 3 << 8], "<u8")  # fmt: skip
        words |= np.array([0, 1, 0, 0, 1], "<u8")
        # The lower half of an EVT 2.1 word holds the pixels of an event; that of a trigger is 0.
        pixels = np.array([0, 0, 1, 0, 0], "<u8")
        words = words.astype("<u4") if version == "2" else words << np.uint64(32) | pixels
    layout = (
        "% format EVT21;endianness=little;height=240;width=320\n"
        if version == "2.1"
        else "% geometry 320x240\n"
    )
    layout += "% t0 1700000000000000\n"
    path = tmp_path / "a.raw"
    path.write_bytes(
        f"% evt {version if '.' in version else version + '.0'}\n{layout}% end\n".encode()
        + words.tobytes()
    )
    recording, start = (
        open_recording(path),
        1_700_000_000_000_000 + (4096 if version == "3" else 64),
    )
    assert recording.metadata["triggers"] == 3
    assert recording.events.t_first == start + 6
    assert read_encoder_triggers(path, 3).t.tolist() == [start + 5, start + 16]
    with pytest.raises(
        AmiwarpError, match=r"a.raw: holds one stream of events, no topics; leave the topic out"
    ):
        read_encoder_triggers(path, 3, topic="/events")


def test_triggers_of_aedat4(tmp_path):
    attribute, node = aedat.DescriptionAttribute, aedat.DescriptionNode
    outputs = []
    for number, (kind, size) in enumerate((("EVTS", SIZE), ("TRIG", ()))):
        place = f"/mainloop/Recorder/outInfo/{number}/"
        names = ("originalModuleName", "originalOutputName", "typeDescription")
        stream = {
            "compression": attribute("string", "LZ4"),
            "typeIdentifier": attribute("string", kind),
        }
        stream |= {name: attribute("string", "test") for name in names}
        about = {
            f"size{axis}": attribute("int", value) for axis, value in zip("XY", size, strict=False)
        }
        info = node("info", f"{place}info/", {"source": attribute("string", "test"), **about}, [])
        outputs.append(node(str(number), place, stream, [info]))
    edges = np.zeros(5, [("t", "<u8"), ("source", "u1")])
    # Rising edge, falling edge, pulse, and the beginning and end of an exposure.
    edges["t"], edges["source"] = 1_000_000 + np.arange(5) * 500, [1, 2, 3, 8, 9]
    root = node("outInfo", "/mainloop/Recorder/outInfo/", {}, outputs)
    with aedat.Encoder(tmp_path / "a.aedat4", [root], ("lz4", 1)) as encoder:
        encoder.write(0, to_faery(EVENTS))
        encoder.write(1, edges)
    recording = open_recording(tmp_path / "a.aedat4")
    assert recording.metadata == {"format": "aedat4", "triggers": 3}
    assert_equal(recording.events.slice(0, 999), EVENTS)
    assert read_encoder_triggers(tmp_path / "a.aedat4").t.tolist() == [1_000_000, 1_001_000]


def tar(data: bytes) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        about = tarfile.TarInfo("events.txt")
        about.size = len(data)
        archive.addfile(about, io.BytesIO(data))
    return buffer.getvalue()


def zipped(data: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("events.txt", data)
    return buffer.getvalue()


def npy() -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.arange(4))
    return buffer.getvalue()


FOREIGN = {
    "finding events in the MATLAB file: Unknown mat file type": b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(
        200
    ),
    "is a PNG picture; .*simulate --picture": b"\x89PNG\r\n\x1a\n" + bytes(99),
    "is an MP4 video; .*translate": struct.pack(">I", 24) + b"ftypisom" + bytes(99),
    "is an AVI video": b"RIFF" + bytes(4) + b"AVI LIST" + bytes(99),
    "is a gzip archive; unpack it first": gzip.compress(b"1 2 3"),
    "is a tar archive; unpack": tar(b"1 2 3 0\n"),
    "is a bzip2 archive": b"BZh91AY&SY" + bytes(99),
    "is a pcap capture": b"\xd4\xc3\xb2\xa1" + bytes(99),
    r"reading the array: the array is int64 of shape \(4,\); expected a table \(n, 4\)": npy(),
    "is a ZIP archive without x, y, t and p": zipped(b"1 2 3 0\n"),
    "is a ROS 1 bag of version 1": b"#ROSBAG V1.2\n" + bytes(99),
    r"is AEDAT 1\.0; only 2\.0, 3\.1 and 4": b"#!AER-DAT1.0\r\n" + bytes(99),
    "is a JSON document": json.dumps({"width": 3}).encode(),
    "is a PDF document": b"%PDF-1.7\n" + bytes(99),
    "opening HDF5: Unable to synchronously open file": b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(
        200
    ),
    "is a GIF picture; .*simulate": b"GIF89a" + bytes(99),
    "is a BMP picture": b"BM" + bytes(99),
    "is a TIFF picture": b"II*\0" + bytes(99),
    "is a TIFF picture; .*simulate": b"MM\0*" + bytes(99),
    "is a WebP picture": b"RIFF" + bytes(4) + b"WEBPVP8 " + bytes(99),
    "is a RIFF file of sound or pictures": b"RIFF" + bytes(4) + b"WAVEfmt " + bytes(99),
    "is a Matroska or WebM video; .*translate": b"\x1aE\xdf\xa3" + bytes(99),
    "is an xz archive; unpack": lzma.compress(b"1 2 3"),
    "is a Zstandard archive; unpack": zstandard.compress(b"1 2 3"),
    "is an LZ4 archive; unpack": b"\x04\x22\x4d\x18" + bytes(99),
    "is a 7-Zip archive; unpack": b"7z\xbc\xaf\x27\x1c" + bytes(99),
    "is a RAR archive; unpack": b"Rar!\x1a\x07\x01\0" + bytes(99),
    "is a pcap capture of network packets; give": b"\xa1\xb2\xc3\xd4" + bytes(99),
    "is a pcap capture of network packets; give the events": b"\x4d\x3c\xb2\xa1" + bytes(99),
    "is a pcapng capture": b"\n\r\r\n" + bytes(99),
    "finding events in the Parquet table: Parquet magic bytes not found": b"PAR1" + bytes(99),
    "is an Arrow table": b"ARROW1\0\0" + bytes(99),
    "is a Python pickle; .* never loaded": pickle.dumps({"x": list(range(999))}, protocol=4),
    "is a Python pickle; save": pickle.dumps({"x": list(range(999))}, protocol=5),
    "is a HEIC picture; .*simulate": struct.pack(">I", 24) + b"ftypheic" + bytes(99),
    "is a HEIF picture; .*simulate": struct.pack(">I", 24) + b"ftypmif1" + bytes(99),
    "is an AVIF picture; .*simulate": struct.pack(">I", 24) + b"ftypavif" + bytes(99),
    "is a pcap capture of network": b"\xa1\xb2\x3c\x4d" + bytes(99),
    "is a program": b"\x7fELF\x02\x01\x01" + bytes(99),
    "is an XML document": b'<?xml version="1.0"?><a/>',
}


@pytest.mark.parametrize(("old", "new"), [(b"<", b"\xff"), (b"</", b"<<"), (b"<dv", b"")])
def test_a_damaged_header_of_aedat4_is_named(tmp_path, old, new):
    write_aedat4(tmp_path / "a.aedat4", EVENTS)
    whole = (tmp_path / "a.aedat4").read_bytes()
    start = len(b"#!AER-DAT4.0\r\n")
    (size,) = struct.unpack_from("<I", whole, start)
    header = whole[start + 4 : start + 4 + size].replace(old, new, 1)
    path = tmp_path / "b.aedat4"
    path.write_bytes(
        whole[:start] + struct.pack("<I", len(header)) + header + whole[start + 4 + size :]
    )
    with pytest.raises(
        AmiwarpError, match=r"b\.aedat4: bytes .* the header is damaged: .*; copy the file again"
    ):
        open_recording(path)


AEDAT2_CHIPS = {"DVS128": (128, 128), "Davis128": (128, 128), "Davis208Mono": (208, 192), "Davis240C": (240, 180),
                "Davis346blue": (346, 260), "Davis640": (640, 480), "Tmpdiff128": (128, 128)}  # fmt: skip


@pytest.mark.parametrize("chip", AEDAT2_CHIPS)
def test_a_camera_of_aedat2_has_its_size(tmp_path, chip):
    write_aedat2(tmp_path / "a.aedat", EVENTS[:0], chip=chip)
    header = (tmp_path / "a.aedat").read_bytes()
    (tmp_path / "a.aedat").write_bytes(header + np.array([[0, 1000]], ">u4").tobytes())
    assert open_recording(tmp_path / "a.aedat").events.size == AEDAT2_CHIPS[chip]


def test_a_ros_message_may_hold_no_events(tmp_path):
    for ros1, write, name in (True, write_ros1, "a.bag"), (False, write_ros2, "b"):
        nothing = array_message(typestore(ros1), EVENTS[:0], ros1=ros1)
        messages = [nothing, *arrays(EVENTS, ros1=ros1), nothing]
        path = write(tmp_path / name, {"/dvs/events": messages}) or tmp_path / name
        assert_equal(open_recording(path).events.slice(0, 999), EVENTS)


def test_a_bag_tells_how_many_of_its_messages_are_read(tmp_path):
    messages = arrays(EVENTS, ros1=True)
    write_ros1(tmp_path / "a.bag", {"/dvs/events": messages})
    notes: dict[str, int] = {}
    read = [
        notes["read"] for _ in read_packets(notes, str(tmp_path / "a.bag"), "/dvs/events", False)
    ]
    assert read == list(range(1, len(messages) + 1))
    assert notes["total"] == len(messages)


@pytest.mark.parametrize("message", FOREIGN)
def test_other_files_are_named(tmp_path, message):
    (tmp_path / "file.raw").write_bytes(FOREIGN[message])
    with pytest.raises(AmiwarpError, match=rf"file\.raw: {message}") as caught:
        open_recording(tmp_path / "file.raw")
    assert caught.value.code is not ErrorCode.INVALID
    assert os.listdir(tmp_path) == ["file.raw"]


def test_real_files_of_other_kinds_are_named(data_dir):
    real = {
        "images/brick.png": "is a PNG picture",
        "images/china.jpg": "is a JPEG picture",
        "video/bikes_640x272_25fps.mp4": "is an MP4 video",
        "video/nfs240fps_basketball_20x200x200.npy": "reading the array: the array is float32 of shape (20, 200, 200)",
    }
    for name, message in real.items():
        assert f"{name}: {message}" in str(refusal(open_recording, data_dir / name))


@pytest.mark.parametrize("shift", [0, 32])
def test_the_order_of_halves_is_told_by_times_that_may_stand_still(shift):
    """The other halves hold vectors that look like words of the time, but fall."""
    time, vectors = np.repeat(np.arange(50), 2) | 0x8 << 28, 0x8 << 28 | 2000 - np.arange(100)
    words = time.astype(np.uint64) << np.uint64(shift) | vectors.astype(np.uint64) << np.uint64(
        32 - shift
    )
    assert halves_of(words) == Halves(shift == 0, certain=True)


def test_raw_sizes_that_no_sensor_generation_has(tmp_path):
    words = np.array([0x8 << 60 | 5 << 32, 1 << 60 | 3 << 54 | 64 << 43 | 9 << 32 | 1], np.uint64)
    head = b"% evt 2.1\n% format EVT21;endianness=little;height=100;width=200\n% sensor_name IMX636\n% end\n"
    (tmp_path / "a.raw").write_bytes(head + words.tobytes())
    assert open_recording(tmp_path / "a.raw").events.size == (200, 100)


def test_impossible_times_of_a_text_file_are_named(tmp_path):
    (tmp_path / "a.txt").write_text("0.1 1 2 1\n5e12 1 2 1\n")
    with pytest.raises(AmiwarpError, match=r"line 2"):
        open_recording(tmp_path / "a.txt").events.slice(0, 9)


def test_types_in_the_interface_definition_language():
    rule = "=" * 80
    text = f"{rule}\nIDL: far/msg/Turn\nmodule far {{ module msg {{ struct Turn {{ int32 count; }}; }}; }};\n"
    assert [name for name, _ in _types_of(text, "far/msg/Turn")["far/msg/Turn"][1]] == ["count"]


def test_each_message_of_a_bag_can_be_read_alone(tmp_path):
    n = 1000
    events = Events.from_arrays(
        np.arange(n) % 320, np.full(n, 7), 5000 + 100 * np.arange(n), np.arange(n) % 2
    )
    save_recording(tmp_path / "a.h5", Recording(MemoryEvents(events, *SIZE)))
    convert(tmp_path / "a.h5", tmp_path / "a.db3")
    with contextlib.closing(sqlite3.connect(tmp_path / "a.db3")) as database:
        rows = database.execute("SELECT data FROM messages ORDER BY id").fetchall()
    store = typestore(False)
    messages = [
        store.deserialize_cdr(data, "event_camera_msgs/msg/EventPacket") for (data,) in rows
    ]
    assert len(messages) > 1
    decoded = [Evt3Decoder().decode(message.events.view("<u2"))[0] for message in messages]
    np.testing.assert_array_equal(np.concatenate([y for _, y, _, _ in decoded]), events.y)
