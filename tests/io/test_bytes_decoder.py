"""The decoder of the bytes of event files: against the NumPy decoders and the files, in pieces, on each device."""

import struct
from typing import Any

import numpy as np
import pytest
import warp as wp

from amiwarp import AmiwarpError, BytesDecoder, Events
from amiwarp.io import bytes_decoder, decoding
from amiwarp.io.aedat.aedat2_header import CHIPS
from amiwarp.io.file_pieces import unwrapped
from reference.aedat4_files import events_packet
from reference.aedat_records import Aedat2Records, polarity_events
from reference.io_samples_extra import aedat3_packet

RNG = np.random.default_rng(4)


def assert_decoded(found: list[Any], columns: Any, device: str) -> None:
    """Compare the events of all calls with columns."""
    assert all(str(events.device) == device for events in found)
    for name, column in zip("xytp", columns, strict=True):
        values = np.concatenate([getattr(events, name).numpy() for events in found])
        np.testing.assert_array_equal(values, np.asarray(column).astype(values.dtype))


def on(device: str, data: bytes) -> Any:
    """Return bytes as an array on a device."""
    return wp.array(np.frombuffer(data, np.uint8), dtype=wp.uint8, device=device)


@pytest.mark.parametrize("version", ["1", "2"])
@pytest.mark.parametrize("length", [1, 5, 1 << 14])
def test_dat_records_are_decoded_as_numpy_does(
    version: str, length: int, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Times wrap, also backwards, within pieces and blocks and between them."""
    for limit in ("CPU_RECORDS", "CUDA_RECORDS"):
        monkeypatch.setattr(decoding, limit, length)
    bits, shift, polarity = ((9, 8), 9, 17) if version == "1" else ((14, 14), 14, 28)
    rng = np.random.default_rng(3)
    turns = 0
    for trial in range(12):
        words = rng.integers(0, 1 << 32, (int(rng.integers(1, 400)), 2))
        near = (2**32 - 900 + np.cumsum(rng.integers(-9, 15, len(words)))) % 2**32
        words[:, 0] = np.where(rng.random(len(words)) < 0.98, near, words[:, 0])
        if trial % 3 == 0:  # many turns, all of them forwards
            words[:, 0] = np.arange(len(words)) * 2**30 % 2**32
        t = unwrapped(words[:, 0], 32)
        turns += int(np.ptp(t >> 32))
        rest = words[:, 1]
        known = (
            rest & (1 << bits[0]) - 1,
            rest >> shift & (1 << bits[1]) - 1,
            t,
            rest >> polarity & 1,
        )
        decoder = BytesDecoder(f"dat{version}", device=device)
        cuts = np.sort(rng.integers(0, len(words) + 1, 2))
        pieces = [on(device, piece.astype("<u4").tobytes()) for piece in np.split(words, cuts)]
        assert_decoded([decoder.decode(piece) for piece in pieces], known, device)
    assert turns > 5


def test_a_time_that_wraps_in_the_first_block_only(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("CPU_RECORDS", "CUDA_RECORDS"):
        monkeypatch.setattr(decoding, limit, 2)
    records = np.array([[2**32 - 1, 0], [5, 0], [6, 0]], "<u4")
    assert BytesDecoder("dat2", device=device).decode(records.tobytes()).t.numpy()[1:].tolist() == [
        2**32 + 5,
        2**32 + 6,
    ]


@pytest.mark.parametrize("chip", ["DVS128", "davis346"])
def test_aedat2_records_are_decoded_in_pieces(chip: str, device: str) -> None:
    records = RNG.integers(0, 1 << 32, (500, 2)).astype(">u4")
    known, _ = Aedat2Records(CHIPS[chip.lower()]).decode(records)
    decoder = BytesDecoder("aedat2", chip=chip, device=device)
    pieces = [records[:100], records[100:100], records[100:]]
    found = [decoder.decode(on(device, piece.tobytes())) for piece in pieces]
    assert_decoded(found, known, device)


@pytest.mark.parametrize("room", [1, 2, 1 << 12])
def test_aedat3_packets_are_found_and_decoded(
    room: int, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Packets of other types, and of another source, lie between; their sizes are those of no events."""
    monkeypatch.setattr(bytes_decoder, "MOST_PACKETS", room)
    for limit in ("CPU_RECORDS", "CUDA_RECORDS"):
        monkeypatch.setattr(decoding, limit, 7)
    rows = [RNG.integers(0, 1 << 32, (n, 2)).astype("<u4") for n in (20, 0, 33, 1)]
    kept = [aedat3_packet(1, part, overflow=k, source=3) for k, part in enumerate(rows)]
    imu = aedat3_packet(3, np.zeros((2, 9), "<u4"))
    odd = struct.pack("<hhiiiiii", 2, 1, 7, 4, 0, 1, 1, 1) + bytes(7)
    special = aedat3_packet(0, RNG.integers(0, 1 << 32, (4, 2)).astype("<u4"))
    other = aedat3_packet(1, RNG.integers(0, 1 << 32, (4, 2)).astype("<u4"), source=4)
    pieces = [odd + kept[0] + imu + kept[1] + other, special + kept[2] + kept[3], b"", other + imu]
    decoder = BytesDecoder("aedat3", device=device)
    known = polarity_events([part.tobytes() for part in rows], [k << 31 for k in range(4)])
    assert_decoded([decoder.decode(on(device, piece)) for piece in pieces], known, device)


@pytest.mark.parametrize("room", [1, 3, 1 << 12])
def test_aedat4_packets_are_found_and_decoded(
    room: int, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bytes_decoder, "MOST_PACKETS", room)
    t = RNG.integers(0, 2**60, 300)
    pixels = RNG.integers(0, 1 << 15, (2, 300)).astype(np.uint16)
    events = Events(*pixels, t, RNG.integers(0, 2, 300).astype(np.uint8))
    packets = [events_packet(events[at : at + 7]) for at in range(0, 300, 7)]
    decoder = BytesDecoder("aedat4", device=device)
    found = [
        decoder.decode(on(device, b"".join(packets[first : first + 20]))) for first in (0, 20, 40)
    ]
    assert_decoded(found, (events.x, events.y, events.t, events.p), device)


def test_damaged_and_cut_packets_are_refused(device: str) -> None:
    events = Events(*np.zeros((2, 3), np.uint16), np.arange(3), np.zeros(3, np.uint8))
    whole = events_packet(events)
    lost = bytearray(whole)
    lost[4] = 0xFF  # the position of the table lies outside
    for data in (
        whole + whole[:-1],
        whole + whole[:9],
        whole + whole.replace(b"EVTS", b"IMUS"),
        whole + bytes(lost),
    ):
        with pytest.raises(
            AmiwarpError,
            match=rf"byte {len(whole)} of the data does not begin a whole packet of aedat4",
        ):
            BytesDecoder("aedat4", device=device).decode(on(device, data))
    many = bytearray(whole)
    many[len(whole) - 16 * 3 - 4] = 4  # the fourth event lies in the next packet
    with pytest.raises(
        AmiwarpError, match=r"byte 0 of the data does not begin a whole packet of aedat4"
    ):
        BytesDecoder("aedat4", device=device).decode(on(device, bytes(many) + whole))
    whole = aedat3_packet(1, np.ones((3, 2), "<u4"))
    wide = struct.pack("<hhiiiiii", 1, 1, 12, 4, 0, 1, 1, 1) + bytes(12)
    negative = struct.pack("<hhiiiiii", 1, 1, -8, 4, 0, 1, -1, 1) + bytes(8)
    strange = struct.pack("<hhiiiiii", 256, 1, 8, 4, 0, 1, 0, 1)
    for data in (
        whole + whole[:-1],
        whole + whole[:27],
        whole + wide,
        whole + negative,
        whole + strange,
    ):
        with pytest.raises(
            AmiwarpError,
            match=rf"byte {len(whole)} of the data does not begin a whole packet of aedat3",
        ):
            BytesDecoder("aedat3", device=device).decode(on(device, data))


@pytest.mark.parametrize("format", ["dat2", "aedat4"])
def test_bytes_may_be_arrays_of_any_library(format: str, device: str) -> None:
    events = Events(*np.zeros((2, 3), np.uint16), np.arange(3), np.zeros(3, np.uint8))
    data = (
        RNG.integers(0, 1 << 28, (30, 2)).astype("<u4").tobytes()
        if format == "dat2"
        else events_packet(events)
    )
    known = BytesDecoder(format, device=device).decode(data).to_host()
    assert len(known) > 2
    within = on(device, b"\0" + data)[1:]  # begins within a word
    for given in (
        data,
        bytearray(data),
        memoryview(data),
        np.frombuffer(data, np.int8),
        on("cpu", data),
        within,
    ):
        found = BytesDecoder(format, device=device).decode(given)
        assert str(found.device) == device
        for name in "xytp":
            np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(known, name))


def test_other_arguments_and_data_are_refused() -> None:
    with pytest.raises(AmiwarpError, match=r"format of the bytes is 'aedat'; choose among"):
        BytesDecoder("aedat")
    with pytest.raises(
        AmiwarpError, match=r"format aedat2 needs a chip; give one of dvs128, davis128"
    ):
        BytesDecoder("aedat2")
    with pytest.raises(AmiwarpError, match=r"format dat2 needs no chip; leave it out"):
        BytesDecoder("dat2", chip="dvs128")
    with pytest.raises(AmiwarpError, match=r"chip is 'gen4'; choose among"):
        BytesDecoder("aedat2", chip="gen4")
    with pytest.raises(
        AmiwarpError,
        match=r"records are 12 bytes, which end within a record of 8 bytes; keep the rest",
    ):
        BytesDecoder("dat1").decode(bytes(12))
    with pytest.raises(
        AmiwarpError,
        match=r"packets are uint32 of shape \(4,\); expected bytes of shape \(n,\) for aedat3",
    ):
        BytesDecoder("aedat3").decode(np.zeros(4, np.uint32))
    with pytest.raises(AmiwarpError, match=r"records are None; expected bytes or an array"):
        BytesDecoder("dat2").decode(None)
