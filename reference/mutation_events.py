"""Damaged event files whose events are compared with what the damaged bytes say: no event is lost or changed unsaid.

A mutant that opens has the events of the undamaged file, or says what differs (``noted``), or holds other events that
are as valid as the first ones (``silent``): nothing in the file tells that a bit of a column has changed. For the
formats without checksums, a second decoder of plain Python reads the same damaged bytes: its events, repaired as
documented and with the counts that :func:`amiwarp.open_recording` states, must be the events that were read.

``python -m benchmarks.fuzz --events COUNT`` checks COUNT mutants of each decoder.
"""

from __future__ import annotations

import random
import struct
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1

from amiwarp import Events, MemoryEvents, Recording, convert, save_recording
from amiwarp.io.aedat.aedat2_header import read_aedat2_header
from amiwarp.io.assumptions import smallest_sensor
from reference.aedat4_files import whole_file
from reference.ecf_files import ecf_chunk, write_ecf
from reference.es_files import ES_SIZE, es_bytes
from reference.evt_words import Evt2Decoder, Evt3Decoder, swap_halves, unknown_words
from reference.io_samples import SIZE, make_events, write_aedat4, write_dat, write_es, write_evt
from reference.io_samples_extra import (
    arrays,
    evt3_words,
    packets,
    small,
    typestore,
    write_aedat2,
    write_aedat3,
    write_evt21,
    write_ros1,
    write_ros2,
)
from reference.mutation_files import Checker, checked, content_of, mutated, read_recording, serve

EVENTS = make_events(300)

Rows = NDArray[np.int64]
"""Events as rows x, y, t, p, shape ``(n, 4)``."""


class Said(NamedTuple):
    """What a second decoder finds in a file."""

    events: Rows
    """All events with a time, before any repair."""
    counts: dict[str, int]
    """What the reader must have counted, without repairs of times and places."""


# Second decoders, of whole files.


def evt_header(data: bytes) -> tuple[dict[str, str], int]:
    """Return the fields of the header of Prophesee's files, and where it ends."""
    fields: dict[str, str] = {}
    at = 0
    while data[at : at + 1] == b"%":
        end = data.find(b"\n", at, at + 4096)
        if end < 0:
            break
        line = data[at + 1 : end].decode("latin-1").strip()
        at = end + 1
        if line == "end":
            break
        key, _, value = line.partition(" ")
        fields[key.lower()] = value.strip()
    return fields, at


def said_by_evt(recording: Recording, data: bytes) -> list[Said]:
    """Decode the words of a RAW file with NumPy; EVT 2.1 in each order of halves that the header allows."""
    version = str(recording.metadata["format"]).removeprefix("evt")
    fields, offset = evt_header(data)
    dtype = np.dtype(
        {"2.0": "<u4", "2.1": "<u8", "3.0": "<u2"}[
            {"2": "2.0", "21": "2.1", "3": "3.0"}.get(version, version)
        ]
    )
    words = np.frombuffer(data[offset:], dtype, (len(data) - offset) // dtype.itemsize)
    rest = (len(data) - offset) % dtype.itemsize
    orders = [words]
    if dtype.itemsize == 8:
        layout = fields.get("format", "")
        legacy = swap_halves(words)
        orders = (
            [legacy]
            if "endianness=legacy" in layout
            else [words]
            if "endianness=" in layout
            else [words, legacy]
        )
    return [
        _evt_words(each, int(fields.get("t0", "0")), {"truncated_bytes": rest}) for each in orders
    ]


def _evt_words(words: NDArray[Any], origin: int, counts: dict[str, int]) -> Said:
    def decoder(high: int | None) -> Any:
        return (
            Evt3Decoder(high)
            if words.dtype.itemsize == 2
            else Evt2Decoder(words.dtype.itemsize == 8, high)
        )

    (x, y, t, p), edges = decoder(None).decode(words)
    all_events, all_edges = decoder(0).decode(words)
    untimed = all_events[0].size - x.size + all_edges[0].size - edges[0].size
    rows = np.stack([np.minimum(x, 65535), y, t + origin, p], axis=1).astype(np.int64)
    counts |= {
        "dropped_untimed_events": untimed,
        "triggers": edges[0].size,
        "unknown_words": unknown_words(words),
    }
    return Said(rows, counts)


def unwrapped_times(values: list[int]) -> list[int]:
    """Return 32-bit times without their wraps."""
    out: list[int] = []
    turns, before = 0, values[0] if values else 0
    for value in values:
        turns += (value - before < -(2**31)) - (value - before > 2**31)
        out.append(value + (turns << 32))
        before = value
    return out


def said_by_dat(recording: Recording, data: bytes) -> list[Said]:
    fields, offset = evt_header(data)
    body = data[offset + 2 :]
    words = [struct.unpack_from("<II", body, at) for at in range(0, len(body) - 7, 8)]
    times = unwrapped_times([t for t, _ in words])
    first = recording.metadata["format"] == "dat1"
    bits, shift, polarity = ((9, 8), 9, 17) if first else ((14, 14), 14, 28)
    origin = int(fields.get("t0", "0"))
    rows = [
        (word % 2 ** bits[0], word >> shift & 2 ** bits[1] - 1, t + origin, word >> polarity & 1)
        for t, (_, word) in zip(times, words, strict=True)
    ]
    return [Said(np.array(rows, np.int64).reshape(-1, 4), {"truncated_bytes": len(body) % 8})]


def said_by_aedat2(recording: Recording, data: bytes) -> list[Said]:
    chip, offset, _ = read_aedat2_header(recording.events.path)  # type: ignore[attr-defined]
    body = data[offset:]
    words = [struct.unpack_from(">II", body, at) for at in range(0, len(body) - 7, 8)]
    rows: list[tuple[int, int, int, int]] = []
    triggers = 0
    for (word, _), t in zip(words, unwrapped_times([t for _, t in words]), strict=True):
        if not chip.davis:
            triggers += word >> 15 & 1
            if not word >> 15 & 1:
                rows.append((127 - (word >> 1 & 127), 127 - (word >> 8 & 127), t, 1 - word % 2))
        elif word < 1 << 31 and word >> 10 & 1:
            triggers += 1
        elif word < 1 << 31:
            rows.append(
                (
                    chip.width - 1 - (word >> 12 & 1023),
                    chip.height - 1 - (word >> 22 & 511),
                    t,
                    word >> 11 & 1,
                )
            )
    counts = {"truncated_bytes": len(body) % 8, "triggers": triggers}
    return [Said(np.array(rows, np.int64).reshape(-1, 4), counts)]


AEDAT3_COUNTS = (
    "truncated_bytes",
    "triggers",
    "events_of_other_sources",
    "invalid_events",
    "packets_of_other_types",
)
"""Counts of an AEDAT 3.1 file."""


def said_by_aedat3(recording: Recording, data: bytes) -> list[Said]:
    at = data.index(b"#!END-HEADER\r\n") + 14
    rows: list[tuple[int, int, int, int]] = []
    counts: Counter[str] = Counter()
    first = None
    while at < len(data):
        if at + 28 > len(data):
            counts["truncated_bytes"] = len(data) - at
            break
        kind, source, width, _, overflow, _, number, _ = struct.unpack_from("<hhiiiiii", data, at)
        end = at + 28 + width * number
        if end > len(data):
            counts["truncated_bytes"] = len(data) - at
            break
        if kind in (0, 1):
            pairs = [struct.unpack_from("<ii", data, place) for place in range(at + 28, end, 8)]
            valid = [(word, t) for word, t in pairs if word & 1]
            counts["invalid_events"] += len(pairs) - len(valid)
            if kind == 0:
                counts["triggers"] += sum(word >> 1 & 127 in (2, 3, 4) for word, _ in valid)
            elif first in (None, source):
                first = source
                rows += [
                    (w >> 17 & 0x7FFF, w >> 2 & 0x7FFF, t + (overflow << 31), w >> 1 & 1)
                    for w, t in valid
                ]
            else:
                counts["events_of_other_sources"] += len(valid)
        elif kind not in (2, 3, 4):
            counts["packets_of_other_types"] += 1
        at = end
    return [
        Said(np.array(rows, np.int64).reshape(-1, 4), {**dict.fromkeys(AEDAT3_COUNTS, 0), **counts})
    ]


def said_by_es(recording: Recording, data: bytes) -> list[Said]:
    atis, height = data[15] == 2, int.from_bytes(data[18:20], "little")
    shift = 2 if atis else 1
    rows: list[tuple[int, int, int, int]] = []
    now, at = 0, 20
    while at < len(data):
        time, kind = data[at] >> shift, data[at] % 2**shift
        if time == 2 ** (8 - shift) - 1:
            now += time * kind
            at += 1
            continue
        if at + 5 > len(data):
            break
        now += time
        x, y = struct.unpack_from("<HH", data, at + 1)
        if not (atis and kind % 2):
            rows.append((x, (height - 1 - y) % 65536, now, kind >> (shift - 1)))
        at += 5
    return [Said(np.array(rows, np.int64).reshape(-1, 4), {"truncated_bytes": len(data) - at})]


def repaired(said: Said, size: tuple[int, int] | None) -> tuple[Rows, dict[str, int]]:
    """Return events as they are repaired, in place and time, and all counts, without those that are 0."""
    x, y = said.events[:, 0], said.events[:, 1]
    width, height = size or (65536, 65536)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    rows = said.events[inside]
    ordered = np.maximum.accumulate(rows[:, 2])
    raised = ordered - rows[:, 2]
    rows[:, 2] = ordered
    counts = said.counts | {
        "dropped_outside_events": int((~inside).sum()),
        "repaired_time_events": int((raised > 0).sum()),
        "largest_time_repair_us": int(raised.max(initial=0)),
    }
    return rows, {name: count for name, count in counts.items() if count}


def assert_said(recording: Recording, rows: Rows, found: list[Said]) -> None:
    """Check that the events of a recording, and the counts in its metadata, are those of a second decoder."""
    stated = None if "assumed_size" in recording.metadata else recording.events.size
    differences = []
    for said in found:
        expected, counts = repaired(said, stated)
        wrong = [
            f"{name}: {recording.metadata.get(name, 0)} stated, {counts.get(name, 0)} found"
            for name in {
                *said.counts,
                "dropped_outside_events",
                "repaired_time_events",
                "largest_time_repair_us",
            }
            if recording.metadata.get(name, 0) != counts.get(name, 0)
        ]
        right, bottom = expected[:, :2].max(axis=0, initial=0).tolist()
        if stated is None and recording.events.size != smallest_sensor(right, bottom):
            wrong.append(f"size {recording.events.size}")
        if not np.array_equal(rows, expected):
            wrong.append(f"{len(rows)} events read, {len(expected)} expected, or other values")
        if not wrong:
            return
        differences.append("; ".join(wrong))
    raise AssertionError(" / ".join(differences))


# Samples of each decoder, by the program that writes them or the part of the format.

Oracle = Callable[[Recording, bytes], list[Said]]
Variant = tuple[str, Callable[[Path], None], Oracle | None]
"""File ending, writer of a sample, and second decoder."""


def by_faery(write: Callable[[Path, Events], None], path: Path) -> None:
    write(path, EVENTS)


def by_amiwarp(format: str, path: Path) -> None:
    """Write the events with amiwarp."""
    native = path.with_name("native.h5")
    save_recording(native, Recording(MemoryEvents(EVENTS, *SIZE)))
    convert(native, path, format=format)


def write_evt3_vectors(path: Path) -> None:
    path.write_bytes(
        b"% evt 3.0\n% format EVT3;height=240;width=320\n% end\n" + evt3_words(EVENTS).tobytes()
    )


def write_dat1(path: Path) -> None:
    x, y, p = (column.astype(np.uint32) for column in (EVENTS.x, EVENTS.y, EVENTS.p))
    words = np.stack([EVENTS.t.astype(np.uint32), x | y << 9 | p << 17], axis=1).astype("<u4")
    path.write_bytes(b"% Version 1\n% Width 320\n% Height 240\n\x0c\x08" + words.tobytes())


def write_davis(path: Path) -> None:
    """Write events of a DAVIS with frames, IMU samples and an edge between them."""
    now = int(EVENTS.t[99])
    frame = [
        (1 << 31 | y << 22 | x << 12 | kind << 10 | 99, now)
        for kind in (0, 1)
        for y in (0, 1)
        for x in (0, 1)
    ]
    imu = [(1 << 31 | kind << 28 | 500 << 12 | 3 << 10, now) for kind in range(7)]
    write_aedat2(path, EVENTS, between=np.array([*frame, *imu, (1 << 10, now)], ">u4").tobytes())


def write_dvs128(path: Path) -> None:
    write_aedat2(path, small(EVENTS, 128, 128, t_first=5), chip="DVS128")


def write_es_events(kind: str, path: Path) -> None:
    exposure = np.arange(len(EVENTS)) % 7 == 0 if kind == "atis" else None
    path.write_bytes(es_bytes(small(EVENTS, *ES_SIZE, t_first=100), kind, exposure=exposure))


def write_ecf_events(mode: str, path: Path) -> None:
    write_ecf(path, [ecf_chunk(EVENTS[at : at + 100], mode) for at in (0, 100, 200)], 300, 100)


def numbered(encoding: str, *, ros1: bool) -> list[Any]:
    """Return packets of 50 events, numbered as drivers do."""
    if encoding == "arrays":
        messages = arrays(EVENTS, ros1=ros1)
    else:
        messages = [
            each
            for at in range(0, 300, 50)
            for each in packets(encoding, EVENTS[at : at + 50], ros1=ros1)
        ]
    for number, message in enumerate(messages):
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = 1, 1_000_000 * number
        if encoding != "arrays":
            message.seq = number
        elif ros1:
            message.header.seq = number
    return messages


def write_bag1(encoding: str, path: Path) -> None:
    write_ros1(path, {"/events": numbered(encoding, ros1=True)})


def write_bag1_compressed(kind: str, path: Path) -> None:
    """Write a bag whose chunks are compressed."""
    store = typestore(True)
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat[kind])
    with writer:
        messages = numbered("evt3", ros1=True)
        name = messages[0].__msgtype__
        connection = writer.add_connection("/events", name, typestore=store)
        for at, message in enumerate(messages):
            writer.write(connection, at, store.serialize_ros1(message, name))


def write_bag2(encoding: str, storage: str, path: Path) -> None:
    made = write_ros2(
        path.with_name("bag"), {"/events": numbered(encoding, ros1=False)}, storage=storage
    )
    data = made.read_bytes()
    path.write_bytes(zstandard.compress(data) if path.suffix == ".zstd" else data)


def write_csv(path: Path) -> None:
    rows = zip(
        *(column.tolist() for column in (EVENTS.t, EVENTS.x, EVENTS.y, EVENTS.p)), strict=True
    )
    path.write_text("t_us,x,y,p\n" + "".join(f"{t},{x},{y},{p}\n" for t, x, y, p in rows))


DECODERS: dict[str, dict[str, Variant]] = {
    "evt2": {"faery": (".raw", partial(by_faery, write_evt("evt2")), said_by_evt)},
    "evt21": {
        "legacy": (".raw", lambda path: write_evt21(path, EVENTS), said_by_evt),
        "little": (
            ".raw",
            lambda path: write_evt21(path, EVENTS, legacy=False, header="% evt 2.1\n% geometry 320x240\n"),
            said_by_evt,
        ),
        "amiwarp": (".raw", partial(by_amiwarp, "evt21"), said_by_evt),
    },
    "evt3": {
        "faery": (".raw", partial(by_faery, write_evt("evt3")), said_by_evt),
        "vectors": (".raw", write_evt3_vectors, said_by_evt),
        "amiwarp": (".raw", partial(by_amiwarp, "evt3"), said_by_evt),
    },
    "dat": {
        "faery": (".dat", partial(by_faery, write_dat), said_by_dat),
        "version1": (".dat", write_dat1, said_by_dat),
        "amiwarp": (".dat", partial(by_amiwarp, "dat"), said_by_dat),
    },
    "aedat2": {"davis": (".aedat", write_davis, said_by_aedat2), "dvs128": (".aedat", write_dvs128, said_by_aedat2)},
    "aedat3": {"caer": (".aedat", lambda path: write_aedat3(path, EVENTS), said_by_aedat3)},
    "aedat4": {
        "faery": (".aedat4", partial(by_faery, write_aedat4), None),
        "amiwarp": (".aedat4", partial(by_amiwarp, "aedat4"), None),
        **{
            name: (".aedat4", lambda path, name=name: path.write_bytes(whole_file(EVENTS, name)), None)
            for name in ("none", "lz4", "zstd")
        },
    },
    "es": {
        "faery": (".es", partial(by_faery, write_es), said_by_es),
        "dvs": (".es", partial(write_es_events, "dvs"), said_by_es),
        "atis": (".es", partial(write_es_events, "atis"), said_by_es),
    },
    "ecf": {mode: (".hdf5", partial(write_ecf_events, mode), None) for mode in ("packed", "rows", "masks")},
    "ros1": {
        **{name: (".bag", partial(write_bag1, name), None) for name in ("evt3", "evt2", "arrays")},
        **{kind: (".bag", partial(write_bag1_compressed, kind), None) for kind in ("BZ2", "LZ4")},
    },
    "ros2": {
        "mcap": (".mcap", partial(write_bag2, "evt3", "MCAP"), None),
        "sqlite": (".db3", partial(write_bag2, "evt3", "SQLITE3"), None),
        "evt2": (".mcap", partial(write_bag2, "evt2", "MCAP"), None),
        "mono": (".mcap", partial(write_bag2, "mono", "MCAP"), None),
        "zstd": (".mcap.zstd", partial(write_bag2, "evt3", "MCAP"), None),
    },
    "csv": {"names": (".csv", write_csv, None), "amiwarp": (".csv", partial(by_amiwarp, "csv"), None)},
}  # fmt: skip
"""Samples by decoder."""

OUTCOMES = (
    "refused",
    "same",  # all events of the undamaged file
    "noted",  # the metadata say what was repaired, left out or assumed
    "silent: version",  # the header names another version
    "silent: cut",  # the file ends between two events
    "silent: fewer",
    "silent: more",
    "silent: size",  # the same events, and another size in the header
    "silent: all times",  # all are shifted
    "silent: values",  # as many events, some with other values
)
"""What can become of the events of a mutant."""

VARIANTS = {
    f"{decoder}/{name}": variant
    for decoder, found in DECODERS.items()
    for name, variant in found.items()
}


@cache
def sample(name: str) -> bytes:
    """Return the content of an undamaged file of one of :data:`VARIANTS`."""
    ending, write, _ = VARIANTS[name]
    return content_of(ending, write)


def rows_of(recording: Recording) -> Rows:
    events = recording.events.slice(0, len(recording.events))
    return np.stack([events.x, events.y, events.t, events.p], axis=1).astype(np.int64)


@cache
def sound(name: str) -> tuple[Rows, dict[str, Any], tuple[int, int]]:
    """Return the events, the metadata and the size of an undamaged file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"sample{VARIANTS[name][0]}"
        path.write_bytes(sample(name))
        recording = read_recording(path)
        return rows_of(recording), dict(recording.metadata), recording.events.size


def check(path: Path, name: str) -> str:
    """Read a mutant of one of :data:`VARIANTS`, and return one of :data:`OUTCOMES`.

    Raises :class:`AssertionError` for events or counts that a second decoder does not find.
    """
    found: list[Recording] = []
    if checked(path, lambda path: found.append(read_recording(path))) is not None:
        return "refused"
    (recording,) = found
    rows = rows_of(recording)
    second = VARIANTS[name][2]
    if second is not None:
        assert_said(recording, rows, second(recording, path.read_bytes()))
    known, about, size = sound(name)
    if any(
        recording.metadata.get(key) != about.get(key)
        for key in {*recording.metadata, *about} - {"format"}
    ):
        return "noted"
    if recording.metadata["format"] != about["format"]:
        return "silent: version"
    if len(rows) != len(known) and sample(name).startswith(path.read_bytes()):
        return "silent: cut"
    if len(rows) != len(known):
        return "silent: fewer" if len(rows) < len(known) else "silent: more"
    if np.array_equal(rows, known):
        return "same" if recording.events.size == size else "silent: size"
    step = rows[:, 2] - known[:, 2]
    shifted = (
        step[0] != 0
        and (step == step[0]).all()
        and np.array_equal(rows[:, [0, 1, 3]], known[:, [0, 1, 3]])
    )
    return "silent: all times" if shifted else "silent: values"


def count_outcomes(
    checker: Checker, decoder: str, numbers: range, folder: Path, keep: Path
) -> Counter[str]:
    """Check mutants of a decoder's samples with a checker of this module; return what became of their events.

    Files with findings are saved in ``keep``.
    """
    names = [f"{decoder}/{name}" for name in DECODERS[decoder]]
    outcomes: Counter[str] = Counter()
    for number in numbers:
        name = names[number % len(names)]
        path = folder / f"{name.replace('/', '-')}-{number}{VARIANTS[name][0]}"
        path.write_bytes(mutated(sample(name), random.Random(f"{name} {number}")))
        try:
            outcomes[str(checker.check(path, name))] += 1
        except AssertionError as finding:
            outcomes["defects"] += 1
            print(finding, file=sys.stderr, flush=True)
            keep.mkdir(parents=True, exist_ok=True)
            (keep / path.name).write_bytes(path.read_bytes())
        path.unlink()
    return outcomes


def event_checker() -> Checker:
    """Start a process that compares the events of mutants."""
    return Checker(module="reference.mutation_events")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(float(sys.argv[2]), check)
