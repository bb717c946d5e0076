"""AEDAT 4: what cameras and recorders really write, damage that leaves the rest readable, and files for others."""

import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from faery.extension import aedat

from amiwarp import (
    AmiwarpError,
    Events,
    MemoryEvents,
    Recording,
    convert,
    open_recording,
    save_recording,
)
from amiwarp.io import read_encoder_triggers
from amiwarp.io.aedat import aedat4_compression, aedat4_packets
from amiwarp.io.aedat.aedat4_clock import Clock
from amiwarp.io.aedat.aedat4_compression import Compression, Decompressor
from amiwarp.io.aedat.aedat4_writer import TABLE_POSITION
from reference.aedat4_files import (
    COMPRESSIONS,
    DOUBLE,
    events_packet,
    file_of,
    flat,
    frame_packet,
    imu_row,
    lists,
    whole_file,
)
from reference.io_samples import SIZE, make_events
from tests.io.test_io_readers import assert_equal

EVENTS = make_events()
G = 9.80665


def opened(folder: Path, data: bytes) -> Recording:
    path = folder / "a.aedat4"
    path.write_bytes(data)
    return open_recording(path)


def parts_of(events: Events, size: int = 100) -> list[Events]:
    return [events[at : at + size] for at in range(0, len(events), size)]


def all_of(recording: Recording) -> Events:
    return recording.events.slice(0, len(recording.events))


def write_own(path: Path, events: Events) -> None:
    save_recording(path.with_suffix(".h5"), Recording(MemoryEvents(events, *SIZE)))
    convert(path.with_suffix(".h5"), path)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_every_compression_is_read(tmp_path, compression):
    packets = [(0, events_packet(part)) for part in parts_of(EVENTS)]
    recording = opened(tmp_path, file_of(packets, compression=compression)[0])
    assert (recording.metadata, recording.events.size) == ({"format": "aedat4"}, SIZE)
    assert_equal(all_of(recording), EVENTS)


def test_a_file_with_all_types_of_packets(tmp_path):
    recording = opened(tmp_path, whole_file(EVENTS, "zstd"))
    assert recording.metadata == {
        "format": "aedat4",
        "frames": 4,
        "imu_samples": 12,
        "triggers": 10,
    }
    assert_equal(all_of(recording), EVENTS)
    assert recording.frames is not None
    assert recording.frames[3].tolist() == np.arange(35).reshape(5, 7).tolist()
    assert recording.imu is not None
    assert recording.imu.t.tolist() == EVENTS.t[::50].tolist()


def test_frames_of_16_bits(tmp_path):
    """Of jAER 3."""
    pixels = np.random.default_rng(0).integers(0, 1024, (2, 5, 7)).astype("<u2")
    packets = [
        (1, frame_packet(1_000_000 + 40_000 * k, image, 2)) for k, image in enumerate(pixels)
    ]
    recording = opened(tmp_path, file_of([(0, events_packet(EVENTS)), *packets])[0])
    assert recording.metadata == {"format": "aedat4", "frames": 2}
    assert recording.frames is not None
    assert (recording.frames.t.tolist(), recording.frames.size) == ([1_000_000, 1_040_000], (7, 5))
    for index in (1, 0):
        np.testing.assert_array_equal(recording.frames[index], pixels[index], strict=True)
    assert_equal(all_of(recording), EVENTS)


def test_frames_in_colour_are_counted(tmp_path):
    colour = np.zeros((4, 5, 3), np.uint8)
    recording = opened(
        tmp_path, file_of([(0, events_packet(EVENTS)), (1, frame_packet(9, colour, 16))])[0]
    )
    assert (recording.metadata["frames"], recording.frames) == (1, None)
    assert (
        recording.metadata["frames_note"]
        == "only counted: the frames are in colour (format 16 of OpenCV), not grey"
    )
    assert_equal(all_of(recording), EVENTS)


def test_other_streams_are_counted(tmp_path):
    """Unknown ones in the header and without it, and a second one of events."""
    packets = [(0, events_packet(EVENTS[:300])), (1, flat("POSE", {}, {})), (9, flat("BBOX", {}, {})),
               (2, events_packet(EVENTS[:7])), (0, events_packet(EVENTS[300:]))]  # fmt: skip
    recording = opened(tmp_path, file_of(packets, kinds="EVTS POSE EVTS")[0])
    assert recording.metadata == {
        "format": "aedat4",
        "packets_of_unknown_streams": 2,
        "events_of_other_sources": 7,
    }
    assert_equal(all_of(recording), EVENTS)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_file_cut_in_its_last_packet(tmp_path, compression):
    data, places = file_of(
        [(0, events_packet(part)) for part in parts_of(EVENTS)], compression=compression
    )
    for end in (places[-1] + 3, places[-1] + 30, len(data) - 1):
        recording = opened(tmp_path, data[:end])
        lost = "truncated_bytes" if end > places[-1] + 8 else "dropped_damaged_bytes"
        assert recording.metadata == {"format": "aedat4", lost: end - places[-1]}
        assert_equal(all_of(recording), EVENTS[:500])


def test_a_written_file_cut_before_its_table(tmp_path):
    write_own(tmp_path / "whole.aedat4", make_events(20_000))
    data = (tmp_path / "whole.aedat4").read_bytes()
    assert_equal(all_of(opened(tmp_path, data[: len(data) * 9 // 10])), make_events(20_000)[:16384])


def test_samples_and_triggers_follow_the_schema(tmp_path):
    rows = [
        imu_row(1_000_000, 1.0, 0.0, -2.0, 90.0, 0.0, 45.0),
        imu_row(1_000_500),
        imu_row(1_001_000, 0.0, 3.0),
    ]
    # A type of 0, which a FlatBuffer leaves out, is a reset of the time; 4 and 8 are no edges at the input either.
    edges = [{0: DOUBLE.pack(1_000_000 + 500 * k), **({1: bytes([kind])} if kind else {})} for k, kind in
             enumerate([1, 2, 3, 0, 4, 8, 1])]  # fmt: skip
    packets = [(0, events_packet(EVENTS)), (2, lists("IMUS", rows[:2])), (3, lists("TRIG", edges)),
               (2, lists("IMUS", rows[2:])), (2, lists("IMUS", []))]  # fmt: skip
    recording = opened(tmp_path, file_of(packets)[0])
    assert recording.metadata == {"format": "aedat4", "imu_samples": 3, "triggers": 4}
    assert recording.imu is not None
    assert recording.imu.t.tolist() == [1_000_000, 1_000_500, 1_001_000]
    np.testing.assert_allclose(
        recording.imu.acceleration, np.array([[1, 0, -2], [0, 0, 0], [0, 3, 0]]) * G
    )
    np.testing.assert_allclose(
        recording.imu.angular_velocity, np.radians([[90, 0, 45], [0, 0, 0], [0, 0, 0]])
    )
    encoder = read_encoder_triggers(tmp_path / "a.aedat4")
    assert encoder.t.tolist() == [1_000_000, 1_001_000, 1_003_000]


# The clock of the camera starts again.


def again(t: np.ndarray, parts: list[tuple[int, int]]) -> np.ndarray:
    """Times whose clock shows ``start`` at index ``at``, for each pair."""
    stored = t.copy()
    for at, start in parts:
        stored[at:] += start - stored[at]
    return stored


@pytest.mark.parametrize("size", [100, 90, 600])
def test_a_clock_that_starts_again(tmp_path, size):
    """At the start of a packet, within one, and in a file of one packet (libcaer's issue 69)."""
    t = EVENTS.t + 500_000 * (np.arange(len(EVENTS)) >= 150)
    events = Events(EVENTS.x, EVENTS.y, again(t, [(300, 0)]), EVENTS.p)
    recording = opened(
        tmp_path, file_of([(0, events_packet(part)) for part in parts_of(events, size)])[0]
    )
    right = t.copy()
    right[300:] -= right[300] - right[299]
    assert all_of(recording).t.tolist() == right.tolist()
    added = "1 time: the times behind it follow the earlier ones, for which"
    assert recording.metadata == {
        "format": "aedat4", "clock_restarts": 1, "clock_note": f"started again {added} {t[299]} us were added",
    }  # fmt: skip


def test_every_restart_is_found(tmp_path):
    t = EVENTS.t * 1000
    stored = again(t, [(200, 0), (470, 1000)])
    events = Events(EVENTS.x, EVENTS.y, stored, EVENTS.p)
    recording = opened(
        tmp_path, file_of([(0, events_packet(part)) for part in parts_of(events)])[0]
    )
    right = t.copy()
    for at in (200, 470):
        right[at:] -= right[at] - right[at - 1]
    assert all_of(recording).t.tolist() == right.tolist()
    assert (recording.metadata["clock_restarts"], "repaired_time_events" in recording.metadata) == (
        2,
        False,
    )


@pytest.mark.parametrize("impossible", [0, 40])
def test_other_records_follow_the_clock(tmp_path, impossible):
    """Packets of samples and edges stand on either side of the restart, also behind events with impossible times."""
    events = Events(EVENTS.x, EVENTS.y, again(EVENTS.t * 1000, [(300, 0)]), EVENTS.p)
    last = int(events.t[299])
    samples = [
        (2, lists("IMUS", [imu_row(t)])) for t in (last - 2000, last - 1000, last - 10, 990, 1990)
    ]
    edges = [(3, lists("TRIG", [{0: DOUBLE.pack(t), 1: b"\1"}])) for t in (last - 5000, 0, 5000)]
    early_t = events.t[:300].copy()
    early_t[:impossible] = -(2**63)
    early = (0, events_packet(events[:300], t=early_t))
    late = (0, events_packet(events[300:]))
    for behind, first_edge in ((2, 1), (3, 2), (4, 1)):
        packets = [
            *samples[:behind],
            early,
            *edges[:first_edge],
            late,
            *samples[behind:],
            *edges[first_edge:],
        ]
        recording = opened(tmp_path, file_of(packets)[0])
        assert recording.imu is not None
        assert (recording.imu.t - last).tolist() == [-2000, -1000, -10, 990, 1990]
        assert (read_encoder_triggers(tmp_path / "a.aedat4").t - last).tolist() == [-5000, 0, 5000]
        assert recording.metadata.get("dropped_damaged_events", 0) == impossible


@pytest.mark.parametrize("count", [1, 2])
def test_a_step_back_at_the_end_of_a_batch_is_decided_by_the_next_one(count):
    """Of wrong times the next events know nothing; behind a restart they go on."""
    earlier = 5_000_000 + np.arange(100)
    wrong = np.concatenate([earlier, 1000 + np.arange(count)])
    clock = Clock()
    clock.shift_all(wrong.copy(), [0], [10], in_order=False)
    later = 5_000_100 + np.arange(100)
    clock.shift_all(later, [0], [20], in_order=False)
    assert clock.restarts == []
    assert later.tolist() == (5_000_100 + np.arange(100)).tolist()

    clock = Clock()
    clock.shift_all(wrong.copy(), [0], [10], in_order=False)
    behind = 1000 + count + np.arange(100)
    clock.shift_all(behind, [0], [20], in_order=False)
    assert [place for place, _ in clock.restarts] == [20]
    assert behind.tolist() == (5_000_099 + count + np.arange(100)).tolist()


def test_a_black_frame_that_zstandard_has_compressed_is_whole():
    black = bytes(640 * 480)
    packed = zstandard.ZstdCompressor().compress(black)
    assert len(packed) < 100
    assert Decompressor(Compression.ZSTD)(packed) == black


@pytest.mark.parametrize("at", [1, 250, 299])
def test_a_single_wrong_time_is_no_restart(tmp_path, at):
    t = EVENTS.t.copy()
    t[at] += 3_000_000
    events = Events(EVENTS.x, EVENTS.y, t, EVENTS.p)
    with pytest.raises(AmiwarpError, match=r"a\.aedat4: .* of 600 events are out of order"):
        opened(tmp_path, file_of([(0, events_packet(part)) for part in parts_of(events)])[0])


def test_times_that_jump_all_the_time_are_refused(tmp_path):
    t = EVENTS.t + 10_000_000 * (np.arange(len(EVENTS)) % 2)
    with pytest.raises(AmiwarpError, match="are out of order"):
        opened(tmp_path, file_of([(0, events_packet(Events(EVENTS.x, EVENTS.y, t, EVENTS.p)))])[0])


# Damage.


@pytest.mark.parametrize("window", [64, 1 << 22])
@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("part", ["stream", "size", "small", "huge", "negative", "mark", "rest"])
def test_damage_leaves_the_packets_around_it(tmp_path, monkeypatch, compression, part, window):
    monkeypatch.setattr(aedat4_packets, "WINDOW_BYTES", window)
    data, places = file_of(
        [(0, events_packet(part_)) for part_ in parts_of(EVENTS)], compression=compression
    )
    damaged = bytearray(data)
    at = places[2]
    size = places[3] - at - 8
    sizes = {"size": size + 150, "small": size - 150, "huge": 2**31 - 1, "negative": -5}
    if part == "stream":
        struct.pack_into("<i", damaged, at, 77)
    elif part in sizes:
        struct.pack_into("<i", damaged, at + 4, sizes[part])
    elif part == "mark":
        damaged[at + 8 : at + 28] = b"\xff" * 20
    else:
        damaged[at : places[4]] = b"\xff" * (places[4] - at)
    recording = opened(tmp_path, bytes(damaged))
    found = all_of(recording)
    assert_equal(found[:200], EVENTS[:200])
    if part in sizes and part != "negative":
        assert recording.metadata == {"format": "aedat4", "repaired_packet_sizes": 1}
        assert_equal(found, EVENTS)
    elif part == "rest":
        assert recording.metadata == {"format": "aedat4", "dropped_damaged_bytes": places[4] - at}
        assert_equal(found[200:], EVENTS[400:])
    else:
        lost = recording.metadata.get("dropped_damaged_bytes", 0)
        unknown = recording.metadata.get("packets_of_unknown_streams", 0)
        assert (lost, unknown) in ((places[3] - at, 0), (0, 1)) or part == "negative"
        assert_equal(found[-300:], EVENTS[300:])


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_a_packet_is_found_wherever_a_window_ends(tmp_path, monkeypatch, compression):
    data, places = file_of(
        [(0, events_packet(part)) for part in parts_of(EVENTS)], compression=compression
    )
    damaged = bytearray(data)
    damaged[places[2] : places[3]] = b"\xff" * (places[3] - places[2])
    for window in range(30, 62):
        monkeypatch.setattr(aedat4_packets, "WINDOW_BYTES", window)
        recording = opened(tmp_path, bytes(damaged))
        assert recording.metadata == {
            "format": "aedat4",
            "dropped_damaged_bytes": places[3] - places[2],
        }


def test_a_damaged_list_leaves_the_other_tables(tmp_path):
    rows = [imu_row(1_000_000 + k, k) for k in range(9)]
    packet = bytearray(lists("IMUS", rows))
    slots = packet.index(struct.pack("<I", 9)) + 4
    struct.pack_into("<I", packet, slots + 4 * 3, 2**31)  # beyond the packet
    beyond = bytearray(lists("IMUS", rows))
    struct.pack_into("<I", beyond, slots - 4, 10**6)  # more tables than the packet can hold
    packets = [(0, events_packet(EVENTS)), (2, bytes(packet)), (2, bytes(beyond))]
    recording = opened(tmp_path, file_of(packets)[0])
    assert (recording.metadata["imu_samples"], recording.metadata["dropped_damaged_records"]) == (
        8,
        2,
    )
    assert recording.imu is not None
    assert (recording.imu.t - 1_000_000).tolist() == [0, 1, 2, 4, 5, 6, 7, 8]


def test_events_outside_a_packet_and_impossible_ones(tmp_path):
    beyond = bytearray(events_packet(EVENTS[200:300]))
    struct.pack_into("<I", beyond, beyond.index(struct.pack("<I", 100)), 10**8)
    t = EVENTS.t[100:200].copy()
    t[5], t[6] = -(2**63), 2**63 - 1
    x = EVENTS.x[300:400].astype(np.int16)
    x[9] = -3
    y = EVENTS.y[300:400].astype(np.int16)
    y[11] = -(2**15)
    packets = [events_packet(EVENTS[:100]), events_packet(EVENTS[100:200], t=t), bytes(beyond),
               events_packet(EVENTS[300:400], x=x, y=y), events_packet(EVENTS[400:])]  # fmt: skip
    data, places = file_of([(0, packet) for packet in packets])
    recording = opened(tmp_path, data)
    assert recording.metadata == {
        "format": "aedat4", "dropped_outside_events": 2, "dropped_damaged_events": 2,
        "dropped_damaged_bytes": places[3] - places[2],
    }  # fmt: skip
    keep = np.ones(len(EVENTS), np.bool_)
    keep[[105, 106, 309, 311]] = False
    keep[200:300] = False
    assert_equal(all_of(recording), Events(*(getattr(EVENTS, name)[keep] for name in "xytp")))


@pytest.mark.parametrize("compression", ["lz4", "lz4_high", "zstd", "zstd_high"])
def test_packets_that_grow_without_measure_are_dropped(tmp_path, monkeypatch, compression):
    monkeypatch.setattr(aedat4_compression, "LARGEST_PACKET", 1 << 16)
    packets = [events_packet(EVENTS[:300]), bytes(1 << 20), events_packet(EVENTS[300:])]
    data, places = file_of([(0, packet) for packet in packets], compression=compression)
    recording = opened(tmp_path, data)
    assert recording.metadata == {
        "format": "aedat4",
        "dropped_damaged_bytes": places[2] - places[1],
    }
    assert_equal(all_of(recording), EVENTS)


def test_a_size_that_a_packet_only_states_takes_no_memory(tmp_path):
    """The heads of LZ4 and Zstandard may state any size."""
    stated = {
        "lz4": lz4.frame.compress(b"x", store_size=True)[:6] + DOUBLE.pack(2**62),
        "zstd": b"\x28\xb5\x2f\xfd\xe0",
    }
    for compression, head in stated.items():
        data, _ = file_of([(0, events_packet(EVENTS))], compression=compression)
        bad = head + b"\x7f" * 40
        recording = opened(tmp_path, data + struct.pack("<ii", 0, len(bad)) + bad)
        assert recording.metadata == {"format": "aedat4", "dropped_damaged_bytes": 8 + len(bad)}
        assert_equal(all_of(recording), EVENTS)


def test_a_table_at_a_wrong_place_is_none(tmp_path):
    write_own(tmp_path / "whole.aedat4", make_events(20_000))
    data = bytearray((tmp_path / "whole.aedat4").read_bytes())
    (place,) = DOUBLE.unpack_from(data, TABLE_POSITION)
    for wrong in (place - 1000, len(data) + 1, 0, -7):
        DOUBLE.pack_into(data, TABLE_POSITION, wrong)
        recording = opened(tmp_path, bytes(data))
        assert_equal(all_of(recording), make_events(20_000))
        assert recording.metadata == {
            "format": "aedat4",
            "dropped_damaged_bytes": len(data) - place,
        }


def test_a_file_without_a_stream_of_events_is_named(tmp_path):
    with pytest.raises(
        AmiwarpError, match=r"a\.aedat4: has no stream of events; give a file with events"
    ):
        opened(tmp_path, file_of([], kinds="IMUS")[0])


# Files for other programs.


def test_faery_reads_what_is_written(tmp_path):
    events = make_events(20_000)
    write_own(tmp_path / "a.aedat4", events)
    with aedat.Decoder(tmp_path / "a.aedat4") as decoder:
        assert [(track.id, track.data_type, track.dimensions) for track in decoder.tracks()] == [
            (0, "events", SIZE)
        ]
        found = np.concatenate([packet for _, packet in decoder])
    for name in "xytp":
        np.testing.assert_array_equal(found[name], getattr(events, name))


def test_the_table_of_a_written_file_lists_its_packets(tmp_path):
    """dv-processing finds the packets of a part by it."""
    dv = pytest.importorskip("dv_processing")
    events = make_events(20_000)
    write_own(tmp_path / "a.aedat4", events)
    reader = dv.io.MonoCameraRecording(str(tmp_path / "a.aedat4"))
    assert reader.getTimeRange() == (events.t[0], events.t[-1])
    for start, stop in ((0, 5), (9_000, 12_000), (16_384, 19_999)):
        t = events.t[start], events.t[stop]
        found = reader.getEventsTimeRange(int(t[0]), int(t[1]))
        assert (
            found.timestamps().tolist() == events.t[(events.t >= t[0]) & (events.t < t[1])].tolist()
        )


def test_real_files_as_faery_reads_them(data_dir):
    for name in ("aedat4_dvxplorerlite_320x240", "aedat4_davis346_cars"):
        path = data_dir / f"aedat/{name}.aedat4"
        recording = open_recording(path)
        with aedat.Decoder(path) as decoder:
            packets = [(track.data_type, packet) for track, packet in decoder]
        expected = np.concatenate([packet for kind, packet in packets if kind == "events"])
        found = all_of(recording)
        for field in "xytp":
            np.testing.assert_array_equal(getattr(found, field), expected[field])
        samples = np.concatenate([packet for kind, packet in packets if kind == "imus"])
        assert recording.imu is not None
        np.testing.assert_array_equal(recording.imu.t, samples["t"])
        for k, axis in enumerate("xyz"):
            turning = np.radians(samples[f"gyroscope_{axis}"].astype(np.float64))
            np.testing.assert_array_equal(recording.imu.angular_velocity[:, k], turning)
            pulling = samples[f"accelerometer_{axis}"].astype(np.float64) * G
            np.testing.assert_array_equal(recording.imu.acceleration[:, k], pulling)


def test_real_files_as_dv_processing_reads_them(data_dir):
    dv = pytest.importorskip("dv_processing")
    for name in ("aedat4_dvxplorerlite_320x240", "aedat4_davis346_cars"):
        path = data_dir / f"aedat/{name}.aedat4"
        recording = open_recording(path)
        reader = dv.io.MonoCameraRecording(str(path))
        batches = []
        while (batch := reader.getNextEventBatch()) is not None:
            batches.append(batch.numpy())
        expected = np.concatenate(batches)
        found = all_of(recording)
        for given, field in (("x", "x"), ("y", "y"), ("t", "timestamp"), ("p", "polarity")):
            np.testing.assert_array_equal(getattr(found, given), expected[field])
        assert reader.getEventResolution() == recording.events.size
