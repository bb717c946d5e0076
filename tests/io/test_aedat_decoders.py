"""The decoders of AEDAT 2.0 records and AEDAT 3.1 and 4 packets: against the NumPy decoders, in pieces and blocks."""

import random
import struct
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from amiwarp import Events
from amiwarp.io import decoding
from amiwarp.io.aedat import aedat3, aedat4_events
from amiwarp.io.aedat.aedat2_decoder import Aedat2Decoder
from amiwarp.io.aedat.aedat2_header import CHIPS
from amiwarp.io.decoding import sums_before
from reference.aedat4_files import events_packet
from reference.aedat_records import Aedat2Records, aedat4_rows, polarity_events
from reference.mutation_files import mutated


def assert_columns(events: Any, known: Any) -> None:
    """Compare decoded events with columns; a coordinate outside the frame becomes a large number."""
    x, y, t, p = known
    host = events.to_host()
    for found, column in ((host.x, x), (host.y, y), (host.t, t), (host.p, p)):
        np.testing.assert_array_equal(found, column.astype(found.dtype))


def random_records(n: int, rng: np.random.Generator) -> NDArray[Any]:
    """Return records of all kinds, whose times wrap, step back and jump."""
    words = rng.integers(0, 1 << 32, (n, 2))
    # Some of the first pixel
    words[:, 0] &= np.where(rng.random(n) < 0.2, 0xFFF, 0xFFFFFFFF) | (1 << 31)
    words[:, 0] &= np.where(rng.random(n) < 0.5, 0x7FFFFFFF, 0xFFFFFFFF)
    near = (2**32 - 40 + np.cumsum(rng.integers(-3, 9, n))) % 2**32
    words[:, 1] = np.where(rng.random(n) < 0.9, near, words[:, 1])
    return words.astype(">u4")


@pytest.mark.parametrize("name", ["dvs128", "davis346"])
@pytest.mark.parametrize("length", [1, 5, 1 << 14])
def test_aedat2_records_are_decoded_as_numpy_does(
    name: str, length: int, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("CPU_RECORDS", "CUDA_RECORDS"):
        monkeypatch.setattr(decoding, limit, length)
    rng = np.random.default_rng(5)
    seen = 0
    for _ in range(12):
        records = random_records(int(rng.integers(0, 400)), rng)
        decoder = Aedat2Decoder(CHIPS[name], device)
        expected = Aedat2Records(CHIPS[name])
        for piece in np.split(records, np.sort(rng.integers(0, len(records) + 1, 3))):
            words = wp.array(
                np.ascontiguousarray(piece).view("<u4").ravel(), dtype=wp.uint32, device=device
            )
            events, others = decoder.decode(words)
            columns, known = expected.decode(piece)
            assert str(events.device) == device
            assert_columns(events, columns)
            for field in ("edge_t", "imu_t", "imu_words"):
                np.testing.assert_array_equal(getattr(others, field), known[field])
            assert others.frames == known["frames"]
            seen += others.frames + others.edge_t.size
    assert seen > 20


@pytest.mark.parametrize("length", [1, 3, 1 << 15])
def test_aedat3_packets_are_decoded_as_numpy_does(
    length: int, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("CPU_RECORDS", "CUDA_RECORDS"):
        monkeypatch.setattr(decoding, limit, length)
    rng = np.random.default_rng(6)
    for trial in range(8):
        counts = rng.integers(0, 90, trial)
        parts = [rng.integers(0, 1 << 32, (n, 2)).astype("<u4").tobytes() for n in counts]
        bases = rng.integers(0, 2**31, trial) << 31
        # Something else may lie between the packets.
        gap = trial % 3
        data = b"".join(bytes(gap) + part for part in parts)
        on_device = wp.array(np.frombuffer(data, np.uint8), dtype=wp.uint8, device=device)
        starts = 8 * sums_before(counts) + gap * (1 + np.arange(trial))
        events = aedat3.decode_packets(
            (on_device.ptr + starts).astype(np.uint64), counts, bases, device
        )
        assert str(events.device) == device
        assert_columns(events, polarity_events(parts, bases.tolist()))


def aedat4_packets(count: int, rng: np.random.Generator) -> list[bytes]:
    """Return packets of events, some of them damaged, at odd places or empty."""
    packets = []
    for k in range(count):
        n = int(rng.integers(0, 60))
        t = rng.integers(-(2**62), 2**62, n)
        pixels = rng.integers(0, 1 << 15, (2, n)).astype(np.uint16)
        packet = events_packet(Events(*pixels, t, rng.integers(0, 2, n).astype(np.uint8)))
        # Damage in the positions at the start, or anywhere.
        head = mutated(packet[:40], random.Random(k)) + packet[40:]
        packets.append([packet, head, mutated(packet, random.Random(k))][k % 3])
    return packets


def test_a_packet_of_aedat4_may_have_its_layout_behind_its_table(device: str) -> None:
    event = struct.pack("<qhhB3x", 7, 3, 2, 1)
    # size, position of the table, type; table: way back to the layout, way to the events; layout; events
    packet = struct.pack("<II4siIHHHHI", 44, 8, b"EVTS", -8, 12, 6, 8, 4, 0, 1) + event
    data = wp.array(np.frombuffer(packet, np.uint8), dtype=wp.uint8, device=device)
    table = np.array([(data.ptr, len(packet))], [("address", "<u8"), ("size", "<i8")])
    found = aedat4_events.decode_packets(table, device)
    known = aedat4_rows(packet)
    assert known is not None
    assert found.counts.tolist() == [1]
    assert_columns(found.events, (known["x"], known["y"], known["t"], known["p"]))
    assert found.events.t.numpy().tolist() == [7]


@pytest.mark.parametrize("length", [1, 7, 1 << 15])
def test_aedat4_packets_are_decoded_as_numpy_does(
    length: int, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("CPU_RECORDS", "CUDA_RECORDS"):
        monkeypatch.setattr(decoding, limit, length)
    packets = aedat4_packets(600, np.random.default_rng(8))
    known = [aedat4_rows(packet) for packet in packets]
    counts = [-1 if rows is None else len(rows) for rows in known]
    assert 50 < counts.count(-1) < 500
    data = wp.array(np.frombuffer(b"".join(packets), np.uint8), dtype=wp.uint8, device=device)
    sizes = np.array([len(packet) for packet in packets])
    table = np.zeros(len(packets), [("address", "<u8"), ("size", "<i8")])
    table["address"] = data.ptr + sums_before(sizes)
    table["size"] = sizes
    found = aedat4_events.decode_packets(table, device)
    assert str(found.events.device) == device
    assert found.counts.tolist() == counts
    rows = np.concatenate([rows for rows in known if rows is not None])
    assert_columns(found.events, (rows["x"], rows["y"], rows["t"], rows["p"] != 0))

    # What the blocks hold, in which no block goes beyond a packet.
    blocks = [
        part[at : at + length]
        for part in known
        if part is not None
        for at in range(0, len(part), length)
    ]
    assert len(found.surveys) == len(found.earliest) == len(blocks)
    for survey, earliest, block in zip(found.surveys.tolist(), found.earliest, blocks, strict=True):
        t = block["t"]
        x = block["x"].astype(np.uint16)
        y = block["y"].astype(np.uint16)
        assert survey == (t[0], t.max(), np.count_nonzero(t[1:] < t[:-1]), x.max(), y.max())
        assert earliest == t.min()
