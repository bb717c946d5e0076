"""The decoder of EVT words: against the NumPy decoders, in pieces and blocks, and words that users' cameras send."""

import array
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from amiwarp import AmiwarpError, Events, EvtDecoder, open_recording
from amiwarp.io import event_order, file_scan
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.prophesee import evt_decoder
from reference.evt_words import Evt2Decoder, Evt3Decoder, swap_halves, unknown_words

TIME_HIGH_2, TIME_HIGH_3, TIME_LOW_3 = 0x8 << 28, 0x8000, 0x6000


def random_words(version: str, n: int, rng: np.random.Generator) -> NDArray[Any]:
    """Return words of all types, whose times wrap, step back and stand still."""
    if version == "3.0":
        words = rng.integers(0, 1 << 16, n).astype("<u2")
        high = words >> 12 == 8
        words[high] = TIME_HIGH_3 | rng.integers(4090, 4100, np.count_nonzero(high)) % 4096
        return words
    heads = rng.integers(0, 1 << 32, n).astype(np.uint64)
    high = heads >> np.uint64(28) == 8
    heads[high] = TIME_HIGH_2 | rng.integers(2**28 - 6, 2**28 + 6, np.count_nonzero(high)) % 2**28
    if version == "2.0":
        return heads.astype("<u4")
    return (heads << np.uint64(32)) | rng.integers(0, 1 << 32, n).astype(np.uint64)


@pytest.mark.parametrize("version", ["2.0", "2.1", "3.0"])
@pytest.mark.parametrize("length", [1, 5, 1 << 14])
def test_blocks_and_pieces_are_decoded_as_numpy_does(
    version: str, length: int, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("CPU_WORDS", "CUDA_WORDS"):
        monkeypatch.setattr(evt_decoder, limit, length)
    monkeypatch.setattr(evt_decoder, "GROUP_BLOCKS", 7)
    rng = np.random.default_rng(7)
    for trial in range(12):
        words = random_words(version, int(rng.integers(0, 400)), rng)
        expected: Any = Evt3Decoder() if version == "3.0" else Evt2Decoder(vectors=version == "2.1")
        swapped = version == "2.1" and trial % 2 == 1
        decoder = EvtDecoder(version, swapped=swapped, device=device)
        cuts = np.sort(rng.integers(0, len(words) + 1, 2))
        unknown = 0
        for piece in np.split(words, cuts):
            (x, y, t, p), edges = expected.decode(piece)
            on_device, triggers = decoder.decode(swap_halves(piece) if swapped else piece)
            events = on_device.to_host()
            assert str(on_device.device) == device
            for found, known in (
                (events.x, np.minimum(x, 65535)),
                (events.y, y),
                (events.t, t),
                (events.p, p),
            ):
                np.testing.assert_array_equal(found, known)
            np.testing.assert_array_equal(triggers.channel, edges[0])
            np.testing.assert_array_equal(triggers.t, edges[2])
            np.testing.assert_array_equal(triggers.rising, edges[3])
            unknown += unknown_words(piece)
            assert decoder.unknown == unknown
        assert unknown > 0 or len(words) < 50


def decoded(version: str, words: list[int], **options: Any) -> tuple[list[list[int]], EvtDecoder]:
    """Return [x, y, p, t] of the events of some words, and the decoder."""
    decoder = EvtDecoder(version, **options)
    on_device, _ = decoder.decode(np.array(words, evt_decoder.WORD_TYPES[version]))
    events = on_device.to_host()
    rows = np.column_stack([events.x, events.y, events.p, events.t]).tolist()
    return rows, decoder


@pytest.mark.parametrize(
    ("version", "word"), [("2.0", np.uint32), ("2.1", np.uint64), ("3.0", np.uint16)]
)
def test_words_may_be_bytes_or_arrays_of_any_library(version: str, word: type, device: str) -> None:
    words = random_words(version, 300, np.random.default_rng(3))
    data = words.tobytes()
    known = EvtDecoder(version, device=device).decode(words)[0].to_host()
    assert len(known) > 20
    # Begins within a word
    within = wp.array(np.frombuffer(b"\0" + data, np.uint8), device=device)[1:]
    signed = wp.array(words.view(np.dtype(word).str.replace("u", "i")), device=device)
    plain = wp.array(words, dtype=wp.dtype_from_numpy(np.dtype(word)), device=device)
    strided = np.repeat(words, 2)[::2]
    big_endian = words.astype(np.dtype(word).newbyteorder(">"))
    plain_array = array.array("B", data)
    gaps = memoryview(np.repeat(words, 2))[::2]
    for given in (
        data,
        bytearray(data),
        memoryview(data),
        np.frombuffer(data, np.uint8),
        within,
        signed,
        plain,
        strided,
        big_endian,
        plain_array,
        gaps,
    ):
        found = EvtDecoder(version, device=device).decode(given)[0]
        assert str(found.device) == device
        for name in "xytp":
            np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(known, name))
    assert not len(EvtDecoder(version, device=device).decode(b"")[0])


def test_data_that_are_no_words_are_refused() -> None:
    decoder = EvtDecoder("2.0")
    with pytest.raises(
        AmiwarpError, match="are 6 bytes, which end within a word of 4 bytes; keep the rest"
    ):
        decoder.decode(bytes(6))
    for wrong in (np.zeros(4, np.uint16), np.zeros(4, np.float32), np.zeros((2, 2), np.uint32)):
        with pytest.raises(
            AmiwarpError, match=r"expected bytes or uint32 of shape \(n,\) for EVT 2.0"
        ):
            decoder.decode(wrong)
    for wrong, kind in (([1, 2], r"\[1, 2\]"), (None, "None"), ("words", "'words'")):
        with pytest.raises(AmiwarpError, match=f"EVT words are {kind}; expected bytes or an array"):
            decoder.decode(wrong)
    with pytest.raises(AmiwarpError, match="are a masked array"):
        decoder.decode(np.ma.masked_array(np.zeros(2, np.uint32), [True, False]))
    for view in (memoryview(np.zeros(4, np.float32)), memoryview(np.zeros(4, np.int64))):
        with pytest.raises(AmiwarpError, match="expected bytes or uint32"):
            decoder.decode(view)
    with pytest.raises(AmiwarpError, match="version of EVT is '4'; choose among"):
        EvtDecoder("4")
    for version in ("2.0", "3.0"):
        with pytest.raises(AmiwarpError, match=f"swapped is True for EVT {version}, but only"):
            EvtDecoder(version, swapped=True)


@pytest.mark.parametrize("rare", [0.003, 0.03])
def test_words_that_are_rare_are_found_anywhere_in_a_block(rare: float, device: str) -> None:
    """Rows, bases and times are searched for in strides of 64 words."""
    rng = np.random.default_rng(int(1000 * rare))
    for _ in range(6):
        count = int(rng.integers(2000, 3000))
        words = random_words("3.0", count, rng)
        events = (rng.choice([2, 4, 5], count) << 12 | rng.integers(0, 1 << 12, count)).astype(
            "<u2"
        )
        words = np.where(rng.random(count) < rare, words, events)
        (x, y, t, p), known_edges = Evt3Decoder().decode(words)
        decoder = EvtDecoder("3.0", device=device)
        cut = int(rng.integers(0, count))
        parts = [decoder.decode(part) for part in (words[:cut], words[cut:])]
        found = [events.to_host() for events, _ in parts]
        for name, known in (("x", np.minimum(x, 65535)), ("y", y), ("t", t), ("p", p)):
            np.testing.assert_array_equal(
                np.concatenate([getattr(each, name) for each in found]), known
            )
        np.testing.assert_array_equal(
            np.concatenate([edges.t for _, edges in parts]), known_edges[2]
        )


def test_blocks_that_hold_nothing_but_full_vectors_are_counted(device: str) -> None:
    """More events and more words of a kind than 16 bits can count."""
    vectors = 40_000
    words = np.array([0x8000, 0x6001, 0x0000, 0x3000, *[0x4FFF] * vectors], np.uint16)
    events, _ = EvtDecoder("3.0", device=device).decode(words)
    assert len(events) == 12 * vectors
    assert events.x.numpy()[:65535].tolist() == list(range(65535))


def test_a_single_event_between_vectors_moves_no_vector() -> None:
    words = [0x8000, 0x6001, 0x0000, 0x300A, 0x2805, 0x4001]
    assert decoded("3.0", words)[0] == [[5, 0, 1, 1], [10, 0, 0, 1]]
    # each vector moves the base behind it, by its own width
    words = [0x8000, 0x6001, 0x0000, 0x300A, 0x4001, 0x4000, 0x5080, 0x4001, 0x80FF, 0x2001]
    known = [[10, 0, 0, 1], [41, 0, 0, 1], [42, 0, 0, 1], [1, 0, 0, 0xFF << 12]]
    assert decoded("3.0", words)[0] == known


def test_events_before_the_first_time_are_dropped_and_counted() -> None:
    early = [1 << 28 | 3 << 11 | 4, 0xA << 28]
    words = [*early, TIME_HIGH_2 | 46_875_000, 1 << 28 | 5 << 22 | 3 << 11 | 4]
    rows, decoder = decoded("2.0", words)
    assert rows == [[3, 4, 1, 46_875_000 * 64 + 5]]
    assert decoder.untimed == 2
    decoder.decode(np.array(early, "<u4"))
    assert decoder.untimed == 2  # now their time is known
    words = [
        0x0004,
        0x2803,
        0x3803,
        0x4FFF,
        0x5003,
        0xA001,
        TIME_HIGH_3 | 9,
        TIME_LOW_3 | 1,
        0x2803,
    ]
    rows, decoder = decoded("3.0", words)
    assert rows == [[3, 4, 1, (9 << 12) + 1]]
    assert decoder.untimed == 1 + 12 + 2 + 1


def test_times_go_on_where_words_were_lost_at_a_wrap() -> None:
    words = [0x0001]
    for high in (4092, 4093, 2, 3):
        words += [TIME_HIGH_3 | high, TIME_LOW_3 | 7, 0x2001]
    times = [row[3] for row in decoded("3.0", words)[0]]
    assert times == [(high << 12) + 7 for high in (4092, 4093, 4098, 4099)]


def test_a_small_step_back_is_repaired_however_frequent(tmp_path) -> None:
    """As in EVT 2.0 files with TIME_HIGH 100, 101, 102, 101, 102, 103. A large one is refused."""
    head = b"% evt 2.0\n% format EVT2;height=480;width=640\n% end\n"
    for name, highs in (
        ("small", (100, 101, 102, 101, 102, 103)),
        ("large", (100, 9000, 101, 9001)),
    ):
        words = []
        for high in highs:
            words += [TIME_HIGH_2 | high, *(k << 22 | 5 << 11 | 6 for k in range(10))]
        (tmp_path / f"{name}.raw").write_bytes(head + np.array(words, "<u4").tobytes())
    recording = open_recording(tmp_path / "small.raw")
    events = recording.events.slice(0, 99)
    assert len(events) == 60
    assert [events.t[0], events.t[-1]] == [6400, 103 * 64 + 9]
    assert recording.metadata["repaired_time_events"] == 19
    assert recording.metadata["largest_time_repair_us"] == 73
    with pytest.raises(AmiwarpError, match=r"large\.raw: 10 of 40 events are out of order"):
        open_recording(tmp_path / "large.raw")


def test_a_step_back_of_a_microsecond_between_blocks_or_packets_is_noticed(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(event_order, "CHECKED_EVENTS", 2)
    path = tmp_path / "a"
    path.touch()

    def packets(notes: dict[str, int]) -> Any:
        for t in ([10, 20, 19, 30], [29, 40]):
            pixels = np.zeros(len(t), np.uint16)
            yield Events(pixels, pixels.copy(), np.array(t), pixels.astype(np.uint8))

    source = FileEvents(path, packets, size=(4, 4))
    assert source.slice(0, 9).t.tolist() == [10, 20, 20, 30, 30, 40]
    assert source.repairs == {"repaired_time_events": 2, "largest_time_repair_us": 1}


@pytest.mark.parametrize("span", [1, 3, 1 << 15])
@pytest.mark.parametrize("width", [200, 250])
def test_checks_of_events_are_those_of_other_packets(
    tmp_path, span: int, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Packets of events, in blocks of any length, give the same events and counts as packets of arrays."""
    monkeypatch.setattr(event_order, "CHECKED_EVENTS", span)
    monkeypatch.setattr(file_scan, "SMALL_STEP_US", 10**9)
    rng = np.random.default_rng(3)
    path = tmp_path / "a"
    path.touch()
    packets = []
    for n in (0, 7, 400, 1):
        t = (
            5000
            + np.sort(rng.integers(0, 3000, n))
            + rng.integers(-40, 40, n) * (rng.random(n) < 0.2)
        )
        x = rng.integers(0, 201 if width == 200 else 250, n).astype(np.uint16)
        y = rng.integers(0, 120, n).astype(np.uint16)
        packets.append(Events(x, y, t, rng.integers(0, 2, n).astype(np.uint8)))

    def as_events(notes: dict[str, int]) -> Any:
        return (Events(e.x.copy(), e.y.copy(), e.t.copy(), e.p.copy()) for e in packets)

    def as_arrays(notes: dict[str, int]) -> Any:
        return ((e.x, e.y, e.t, e.p) for e in packets)

    found = FileEvents(path, as_events, size=(width, 130))
    known = FileEvents(path, as_arrays, size=(width, 130))
    assert found.repairs == known.repairs
    assert found.repairs["repaired_time_events"] > 30
    assert ("dropped_outside_events" in found.repairs) == (width == 200)
    assert (found.t_first, found.t_last, len(found)) == (known.t_first, known.t_last, len(known))
    for name in "xytp":
        one, other = (getattr(source.slice(0, 999), name) for source in (found, known))
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
