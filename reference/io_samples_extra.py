"""Small valid files of data sets and of ROS, written by h5py, NumPy and rosbags, or by their specification; and
programs that are not amiwarp, which read the files that it writes."""

import csv
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import eventcv
import h5py
import hdf5plugin  # noqa: F401 - its import registers the compression
import numpy as np
import pytest
from faery.extension import dat, evt
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amiwarp import Events

SIZE = (320, 240)
EVENT = "uint16 x\nuint16 y\ntime ts\nbool polarity\n"
ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"
PACKET = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""


# EVT words, by Prophesee's specification.


def evt2_words(events: Events, *, vectors: bool = False) -> np.ndarray:
    """EVT 2.0 words, or those of EVT 2.1 with one pixel each."""
    words = []
    high = None
    for x, y, t, p in zip(
        *(column.tolist() for column in (events.x, events.y, events.t, events.p)), strict=True
    ):
        if t >> 6 != high:
            high = t >> 6
            words.append((0x8 << 28 | high & 0xFFFFFFF) << (32 if vectors else 0))
        base = x // 32 * 32 if vectors else x
        word = p << 28 | (t & 63) << 22 | base << 11 | y
        words.append(word << 32 | 1 << (x - base) if vectors else word)
    return np.array(words, "<u8" if vectors else "<u4")


def write_evt21(
    path: Path, events: Events, *, legacy: bool = True, header: str | None = None
) -> None:
    words = evt2_words(events, vectors=True)
    words = words >> np.uint64(32) | words << np.uint64(32) if legacy else words
    text = (
        header
        or f"% evt 2.1\n% format EVT21;height={SIZE[1]};width={SIZE[0]}{';endianness=legacy' * legacy}\n"
    )
    path.write_bytes(f"{text}% end\n".encode() + words.astype("<u8").tobytes())


def write_raw_of_a_sensor(path: Path, line: str) -> None:
    """Write one event at (5, 7) in EVT 2.0, below a header without a geometry and with a line about the camera."""
    words = np.array([0x8 << 28 | 10, 1 << 28 | 5 << 11 | 7], "<u4")
    path.write_bytes(f"% evt 2.0\n% {line}\n% end\n".encode() + words.tobytes())


# AEDAT, by iniVation's specification and jAER's addresses.


def write_aedat2(
    path: Path, events: Events, *, chip: str = "Davis346blue", between: bytes = b""
) -> None:
    """Write events of a DAVIS of 346 x 260 pixels, or of a DVS128, which holds only columns and rows below 128."""
    x, y, t, p = (column.astype(np.int64) for column in (events.x, events.y, events.t, events.p))
    addresses = {"DVS128": (127 - y) << 8 | (127 - x) << 1 | (1 - p)}
    address = addresses.get(chip, (259 - y) << 22 | (345 - x) << 12 | p << 11)
    records = np.stack([address, t % 2**32], axis=1).astype(">u4").tobytes()
    header = f"#!AER-DAT2.0\r\n# This is a raw AE data file\r\n# AEChip: eu.seebetter.ini.chips.davis.{chip}\r\n"
    path.write_bytes(header.encode() + records[:800] + between + records[800:])


def aedat3_packet(kind: int, rows: np.ndarray, *, overflow: int = 0, source: int = 1) -> bytes:
    size = rows.shape[1] * 4
    return (
        struct.pack("<hhiiiiii", kind, source, size, 4, overflow, len(rows), len(rows), len(rows))
        + rows.tobytes()
    )


def write_aedat3(path: Path, events: Events, *, between: bytes = b"") -> None:
    """Write packets of 100 events, with a packet of an inertial unit and one of special events between them."""
    x, y, t, p = (column.astype(np.int64) for column in (events.x, events.y, events.t, events.p))
    rows = np.stack([x << 17 | y << 2 | p << 1 | 1, t & 0x7FFFFFFF], axis=1).astype("<u4")
    parts = [
        aedat3_packet(1, rows[at : at + 100], overflow=int(t[at] >> 31))
        for at in range(0, len(t), 100)
    ]
    imu = aedat3_packet(3, np.zeros((5, 9), "<u4"))
    header = "#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS346\r\n#Start-Time: 2020-01-01 00:00:00 (TZ+0000)\r\n"
    path.write_bytes(
        f"{header}#!END-HEADER\r\n".encode() + parts[0] + imu + between + b"".join(parts[1:])
    )


def write_bin(path: Path, events: Events) -> None:
    x, y, p = (column.astype(np.uint8) for column in (events.x, events.y, events.p))
    t = events.t.astype(np.int64)
    columns = [x, y, (p << 7) | (t >> 16).astype(np.uint8), t >> 8 & 0xFF, t & 0xFF]
    path.write_bytes(np.stack(columns, axis=1).astype(np.uint8).tobytes())


# NumPy and HDF5 layouts of data sets.


def write_n_imagenet(path: Path, events: Events) -> None:
    rows = np.zeros(len(events), [("x", "<u2"), ("y", "<u2"), ("t", "<i8"), ("p", "?")])
    for name in "xytp":
        rows[name] = getattr(events, name)
    np.savez_compressed(path, event_data=rows)


def write_evimo(path: Path, events: Events) -> None:
    np.savez(
        path, events=np.stack([events.t * 1e-6, events.x, events.y, events.p], axis=1), K=np.eye(3)
    )


def write_evimo2(path: Path, events: Events) -> None:
    path.mkdir()
    np.save(path / "dataset_events_t.npy", events.t * 1e-6)
    np.save(path / "dataset_events_xy.npy", np.stack([events.x, events.y], axis=1))
    np.save(path / "dataset_events_p.npy", events.p)


def write_tumvie(path: Path, events: Events) -> None:
    with h5py.File(path, "w") as file:
        for name in "xytp":
            file.create_dataset(
                f"events/{name}", data=getattr(events, name), chunks=(200,), compression="gzip"
            )
        file["ms_to_idx"] = np.searchsorted(events.t, 1000 * np.arange(events.t[-1] // 1000 + 1))


def write_m3ed(path: Path, events: Events, *, sides: tuple[str, ...] = ("left",)) -> None:
    with h5py.File(path, "w") as file:
        for side in sides:
            group = file.create_group(f"prophesee/{side}")
            for name in "xytp":
                group.create_dataset(
                    name, data=getattr(events, name), chunks=(200,), compression="lzf"
                )
            group["ms_map_idx"] = np.searchsorted(
                events.t, 1000 * np.arange(events.t[-1] // 1000 + 1)
            )
            group["calib/resolution"] = np.array(SIZE)
            group["calib/intrinsics"] = np.array([200.0, 201.0, 150.0, 110.0])
            group["calib/distortion_coeffs"] = np.array([-0.3, 0.1, 1e-4, -2e-4])


def write_mvsec(path: Path, events: Events, *, sides: tuple[str, ...] = ("left",)) -> None:
    with h5py.File(path, "w") as file:
        for side in sides:
            rows = np.stack([events.x, events.y, events.t * 1e-6, events.p * 2.0 - 1.0], axis=1)
            file.create_dataset(
                f"davis/{side}/events", data=rows, chunks=(100, 2), compression="gzip"
            )
            file[f"davis/{side}/image_raw"] = np.arange(3 * 26 * 34, dtype=np.uint16).reshape(
                3, 26, 34
            )
            file[f"davis/{side}/image_raw_ts"] = 1.0 + np.arange(3) * 0.04
            file[f"davis/{side}/imu"] = np.arange(42.0).reshape(7, 6)
            file[f"davis/{side}/imu_ts"] = 1.0 + np.arange(7) * 0.001


def write_prophesee_hdf5(path: Path, events: Events, **filters: Any) -> None:
    rows = np.zeros(len(events), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name in "xytp":
        rows[name] = getattr(events, name)
    edges = np.zeros(4, [("p", "<i2"), ("t", "<i8"), ("id", "<i2")])
    edges["t"], edges["p"] = events.t[0] + np.arange(4) * 1000, [1, 0, 1, 0]
    with h5py.File(path, "w") as file:
        file.create_dataset("CD/events", data=rows, chunks=(256,), **filters)
        file["EXT_TRIGGER/events"] = edges
        file.attrs["geometry"] = f"{SIZE[0]}x{SIZE[1]}"


# Bags of ROS 1 and ROS 2, written by rosbags.


def typestore(ros1: bool) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    time = "time" if ros1 else "builtin_interfaces/Time"
    for package in ("dvs_msgs", "prophesee_event_msgs", "dv_ros_msgs" if ros1 else "dv_ros2_msgs"):
        store.register(get_types_from_msg(EVENT.replace("time", time), f"{package}/msg/Event"))
        store.register(
            get_types_from_msg(ARRAY.replace("dvs_msgs", package), f"{package}/msg/EventArray")
        )
    store.register(get_types_from_msg(PACKET, "event_camera_msgs/msg/EventPacket"))
    return store


def header(store: Any, ros1: bool) -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](0, 0)
    first = {"seq": 0} if ros1 else {}
    return store.types["std_msgs/msg/Header"](**first, stamp=stamp, frame_id="camera")


def array_message(store: Any, events: Events, *, ros1: bool, package: str = "dvs_msgs") -> Any:
    time, event = store.types["builtin_interfaces/msg/Time"], store.types[f"{package}/msg/Event"]
    columns = (column.tolist() for column in (events.x, events.y, events.t, events.p))
    found = [
        event(x, y, time(t // 1_000_000, t % 1_000_000 * 1000), bool(p))
        for x, y, t, p in zip(*columns, strict=True)
    ]
    message = store.types[f"{package}/msg/EventArray"]
    return message(header(store, ros1), SIZE[1], SIZE[0], found)


def packet_message(store: Any, encoding: str, data: np.ndarray, base: int, *, ros1: bool) -> Any:
    message = store.types["event_camera_msgs/msg/EventPacket"]
    return message(
        header(store, ros1), SIZE[1], SIZE[0], 0, base, encoding, False, data.view(np.uint8)
    )


def write_ros1(path: Path, topics: dict[str, list[Any]]) -> None:
    """Write messages by topic into a ROS 1 bag."""
    store = typestore(True)
    with Writer1(path) as writer:
        for topic, messages in topics.items():
            name = messages[0].__msgtype__
            connection = writer.add_connection(topic, name, typestore=store)
            for at, message in enumerate(messages):
                writer.write(connection, at, store.serialize_ros1(message, name))


def write_ros2(path: Path, topics: dict[str, list[Any]], *, storage: str = "SQLITE3") -> Path:
    """Write messages by topic into a ROS 2 bag, and return its one file."""
    store = typestore(False)
    with Writer2(path, version=9, storage_plugin=StoragePlugin[storage]) as writer:
        for topic, messages in topics.items():
            name = messages[0].__msgtype__
            connection = writer.add_connection(topic, name, typestore=store)
            for at, message in enumerate(messages):
                writer.write(connection, at, store.serialize_cdr(message, name))
    return next(file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))


def arrays(events: Events, *, ros1: bool, package: str = "dvs_msgs") -> list[Any]:
    """Messages of 1, 2, 3 and 150 events in turn."""
    store, messages, at = typestore(ros1), [], 0
    while at < len(events):
        count = (1, 2, 3, 150)[len(messages) % 4]
        messages.append(array_message(store, events[at : at + count], ros1=ros1, package=package))
        at += count
    return messages


def packets(encoding: str, events: Events, *, ros1: bool = False) -> list[Any]:
    """Messages of 200 events with the words of a sensor."""
    store, messages = typestore(ros1), []
    for at in range(0, len(events), 200):
        base, data = ENCODERS[encoding](events[at : at + 200])
        messages.append(packet_message(store, encoding, data, base, ros1=ros1))
    return messages


def _mono(events: Events) -> tuple[int, np.ndarray]:
    base = int(events.t[0]) * 1000
    rest = events.p.astype(np.uint64) << np.uint64(31) | events.y.astype(np.uint64) << np.uint64(16)
    dt = (events.t * 1000 - base).astype(np.uint64)
    return base, ((rest | events.x.astype(np.uint64)) << np.uint64(32) | dt).astype("<u8")


LATE = 1 << 32
"""Time that is added to the events for libcaer, so that none of its numbers is negative [us]."""


def _libcaer(events: Events) -> tuple[int, np.ndarray]:
    x, y, p = (column.astype(np.int64) for column in (events.x, events.y, events.p))
    low = events.t - LATE - 1_000_000 + 2**31 - 5000  # overflows within a message
    words = np.stack([x << 17 | y << 2 | p << 1 | 1, low % 2**31], axis=1).astype("<i4")
    start = int(low[0]) >> 31 << 31
    return (LATE + 1_000_000 - 2**31 + 5000 + start) * 1000, words.reshape(-1)


def _libcaer_cmp(events: Events) -> tuple[int, np.ndarray]:
    base, words = int(events.t[0]), []
    for x, y, t, p in zip(
        *(column.tolist() for column in (events.x, events.y, events.t, events.p)), strict=True
    ):
        words += [(t - base) >> 12, 1 << 12 | (t - base) & 0xFFF, 2 << 12 | x]
        # Odd rows as the second of two vectors, even rows alone.
        words += (
            [4 << 12 | p << 11 | y - 9, 5 << 12, 5 << 12 | 2]
            if y % 2 and y > 8
            else [3 << 12 | p << 11 | y]
        )
    return base * 1000, np.array(words, "<u2")


def evt3_words(events: Events) -> np.ndarray:
    words = []
    for x, y, t, p in zip(
        *(column.tolist() for column in (events.x, events.y, events.t, events.p)), strict=True
    ):
        words += [0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF, y]
        # Odd columns as the second of two vectors, even columns alone.
        words += (
            [0x3000 | p << 11 | x - 13, 0x4000, 0x5002]
            if x % 2 and x > 12
            else [0x2000 | p << 11 | x]
        )
    return np.array(words, "<u2")


ENCODERS: dict[str, Callable[[Events], tuple[int, np.ndarray]]] = {
    "evt3": lambda events: (0, evt3_words(events)),
    "evt2": lambda events: (0, evt2_words(events)),
    "mono": _mono,
    "libcaer": _libcaer,
    "libcaer_cmp": _libcaer_cmp,
}


def write_bag1(path: Path, events: Events) -> None:
    write_ros1(path, {"/dvs/events": arrays(events, ros1=True)})


def write_bag2(storage: str, path: Path, events: Events) -> None:
    made = write_ros2(
        path.with_name("bag_of_sample"), {"/events": packets("evt3", events)}, storage=storage
    )
    path.write_bytes(made.read_bytes())


def small(events: Events, width: int, height: int, *, t_first: int) -> Events:
    """Events within a small frame, from ``t_first`` on."""
    return Events(events.x % width, events.y % height, events.t - events.t[0] + t_first, events.p)


MORE_WRITERS: dict[str, tuple[str, str, tuple[int, int], Callable[[Path, Events], None]]] = {
    # name: (format in the metadata, file ending, sensor size, writer)
    "evt21": ("evt2.1", "raw", SIZE, write_evt21),
    "aedat3": ("aedat3", "aedat", (346, 260), write_aedat3),
    "aedat2": ("aedat2", "aedat", (346, 260), write_aedat2),
    "n_imagenet": ("npz", "npz", SIZE, write_n_imagenet),
    "evimo": ("npz", "npz", SIZE, write_evimo),
    "tumvie": ("dsec", "h5", (640, 480), write_tumvie),
    "m3ed": ("m3ed", "h5", SIZE, write_m3ed),
    "mvsec": ("mvsec", "hdf5", (346, 260), write_mvsec),
    "prophesee_hdf5": ("ecf", "hdf5", SIZE, write_prophesee_hdf5),
    "ros1": ("rosbag1", "bag", SIZE, write_bag1),
    "ros2_sqlite": ("rosbag2", "db3", SIZE, partial(write_bag2, "SQLITE3")),
    "ros2_mcap": ("rosbag2", "mcap", SIZE, partial(write_bag2, "MCAP")),
}
"""Formats that store columns up to 319, rows up to 239 and times from 1 s on."""


# Programs that are not amiwarp, which read what it writes.

Columns = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""x, y, t and p, as a client gives them."""

HOURS_28 = 100_000_000_000
"""Longest recording of the formats with EVT 3.0 [us]."""


def by_dsec(path: Path) -> Columns:
    """Read as DSEC's own programs do, and check its index."""
    with h5py.File(path) as file:
        assert sorted(file) == ["events", "ms_to_idx", "t_offset"]
        assert [file[f"events/{name}"].dtype.str for name in "xytp"] == ["<u2", "<u2", "<u4", "|u1"]
        assert (file["ms_to_idx"].dtype.str, file["t_offset"].shape) == ("<u8", ())
        t, index = file["events/t"][:], file["ms_to_idx"][:]
        ms = np.arange(t[-1] // 1000 + 1 if t.size else 0)
        np.testing.assert_array_equal(index, np.searchsorted(t, 1000 * ms))
        return (
            file["events/x"][:],
            file["events/y"][:],
            t + file["t_offset"][()],
            file["events/p"][:],
        )


def by_faery(path: Path) -> Columns:
    with evt.Decoder(path, None, None) as decoder:
        assert (decoder.version, decoder.dimensions) == ("evt3", SIZE)
        packets = [packet["events"] for packet in decoder if "events" in packet]
    return _columns_of_faery(packets, "p")


def by_words(path: Path) -> Columns:
    """Decode EVT 2.1 word by word, by Prophesee's specification, with the lines of the header that OpenEB needs."""
    header, end, data = path.read_bytes().partition(b"% end\n")
    lines = dict(line[2:].split(" ", 1) for line in header.decode().splitlines())
    width, height = SIZE
    assert (lines["evt"], lines["geometry"], end) == ("2.1", f"{width}x{height}", b"% end\n")
    assert lines["format"] == f"EVT21;height={height};width={width};endianness=little"
    origin, high, rows = int(lines.get("t0", 0)), -1, []
    for word in np.frombuffer(data, "<u8").tolist():
        kind = word >> 60
        if kind == 8:
            assert (word & 0xFFFFFFFF, (word >> 32 & 0xFFFFFFF) > high) == (0, True)
            high = word >> 32 & 0xFFFFFFF
            continue
        base, y = word >> 43 & 0x7FF, word >> 32 & 0x7FF
        assert (kind in (0, 1), base % 32, high >= 0, word & 0xFFFFFFFF > 0) == (
            True,
            0,
            True,
            True,
        )
        t = origin + (high << 6 | word >> 54 & 63)
        rows += [(base + bit, y, t, kind) for bit in range(32) if word >> bit & 1]
    return tuple(np.array(rows, np.int64).reshape(-1, 4).T)


def by_faery_dat(path: Path) -> Columns:
    with dat.Decoder(path, None, None) as decoder:
        assert (decoder.version, decoder.event_type, decoder.dimensions) == ("dat2", "cd", SIZE)
        packets = list(decoder)
    return _columns_of_faery(packets, "payload")


def _columns_of_faery(packets: list[np.ndarray], polarity: str) -> Columns:
    events = (
        np.concatenate(packets)
        if packets
        else np.zeros(0, [(name, "<u8") for name in ("t", "x", "y", polarity)])
    )
    return events["x"], events["y"], events["t"], events[polarity]


def by_eventcv(path: Path) -> Columns:
    options = {"time_unit": "microseconds"} if path.suffix == ".h5" else {}
    return tuple(eventcv.load(str(path), **options).numpy().T)


def by_dv_processing(path: Path) -> Columns:
    recording = pytest.importorskip("dv_processing").io.MonoCameraRecording(str(path))
    assert recording.getEventResolution() == SIZE
    x, y, t, p = [[np.zeros(0, np.int64)] for _ in range(4)]
    while (batch := recording.getNextEventBatch()) is not None:
        x.append(batch.coordinates()[:, 0])
        y.append(batch.coordinates()[:, 1])
        t.append(batch.timestamps())
        p.append(batch.polarities())
    return np.concatenate(x), np.concatenate(y), np.concatenate(t), np.concatenate(p)


def by_numpy(path: Path) -> Columns:
    with np.load(path) as archive:
        assert (int(archive["width"]), int(archive["height"])) == SIZE
        assert [archive[name].dtype.str for name in "xytp"] == ["<u2", "<u2", "<i8", "|u1"]
        return archive["x"], archive["y"], archive["t"], archive["p"]


def by_decimals(path: Path) -> Columns:
    """Read text without rounding: the point is taken out of the seconds."""
    rows = [line.split() for line in path.read_text().splitlines()]
    assert all(len(row) == 4 and len(row[0].partition(".")[2]) == 6 for row in rows)
    table = np.array(
        [[int(word.replace(".", "")) for word in row] for row in rows], np.int64
    ).reshape(-1, 4)
    return table[:, 1], table[:, 2], table[:, 0], table[:, 3]


def by_csv(path: Path) -> Columns:
    """Read a table as Python's own library does, which gives columns their names."""
    with path.open(newline="") as file:
        table = csv.DictReader(file)
        rows = [[int(row[name]) for name in "xytp"] for row in table]
        assert table.fieldnames == ["t", "x", "y", "p"]
    return tuple(np.array(rows, np.int64).reshape(-1, 4).T)


def by_rosbags_ros1(path: Path) -> Columns:
    """Read the arrays of a ROS 1 bag with the definitions that it holds."""
    rows, at = [], 0
    with AnyReader([path]) as reader:
        for connection in reader.connections:
            assert (connection.topic, connection.msgtype) == (
                "/dvs/events",
                "dvs_msgs/msg/EventArray",
            )
            # As rosbag prints it of rpg_dvs_ros
            assert connection.digest == "5e8beee5a6c107e504c2e78903c224b8"
        for connection, recorded, data in reader.messages():
            array = reader.deserialize(data, connection.msgtype)
            assert (array.width, array.height, array.header.seq) == (*SIZE, at)
            rows += [(e.x, e.y, e.ts.sec * 10**9 + e.ts.nanosec, e.polarity) for e in array.events]
            first = rows[-len(array.events)][2]
            assert array.header.stamp.sec * 10**9 + array.header.stamp.nanosec == first
            assert recorded == max(first, 1)  # ROS does not play messages at 0
            at += 1
    x, y, t, p = np.array(rows, np.int64).reshape(-1, 4).T
    assert not (t % 1000).any()
    return x, y, t // 1000, p


def by_rosbags(path: Path) -> Columns:
    """Read a bag with the definitions that it holds. Its packets, one after the other, are the words of a RAW file."""
    words, stamps, counts = [], [], []
    with AnyReader([path]) as reader:
        for connection, recorded, data in reader.messages():
            assert (connection.topic, connection.msgtype) == (
                "/event_camera/events",
                "event_camera_msgs/msg/EventPacket",
            )
            packet = reader.deserialize(data, connection.msgtype)
            assert (packet.width, packet.height, packet.encoding, packet.is_bigendian) == (
                *SIZE,
                "evt3",
                False,
            )
            assert packet.seq == len(words)
            stamps.append(packet.header.stamp.sec * 1_000_000 + packet.header.stamp.nanosec // 1000)
            assert recorded == stamps[-1] * 1000
            words.append(packet.events.tobytes())
            counts.append(int(np.count_nonzero(packet.events.view("<u2") >> 12 == 2)))
    origin = 0 if not stamps or stamps[0] < HOURS_28 else stamps[0]
    raw = path.with_suffix(".packets")
    raw.write_bytes(
        f"% evt 3.0\n% geometry {SIZE[0]}x{SIZE[1]}\n% t0 {origin}\n% end\n".encode()
        + b"".join(words)
    )
    columns = by_faery(raw)
    np.testing.assert_array_equal(columns[2][np.cumsum([0, *counts])[:-1]], stamps)
    return columns


CLIENTS: dict[str, tuple[str, Callable[[Path], Columns]]] = {
    # format: (extension, client)
    "dsec": (".h5", by_dsec),
    "evt3": (".raw", by_faery),
    "evt21": (".raw", by_words),
    "dat": (".dat", by_faery_dat),
    "aedat4": (".aedat4", by_eventcv),
    "npz": (".npz", by_numpy),
    "text": (".txt", by_decimals),
    "csv": (".csv", by_csv),
    "ros1": (".bag", by_rosbags_ros1),
    "ros2 mcap": (".mcap", by_rosbags),
    "ros2 db3": (".db3", by_rosbags),
}
