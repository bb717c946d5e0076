"""The serial protocol: no damaged frame is accepted, and no undamaged frame is lost."""

import random
import struct
import zlib

import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from amiwarp.live.link import (
    Answer,
    ControllerStatus,
    FrameDecoder,
    Index,
    Message,
    Ping,
    Pong,
    Samples,
    SetCounts,
    SetSpeed,
    Stop,
    Sync,
    encode,
)
from amiwarp.live.link.protocol import LONGEST, MOST_SAMPLES

U8, U16, U32, I32 = (
    st.integers(0, 255), st.integers(0, 0xFFFF), st.integers(0, 0xFFFFFFFF), st.integers(-(1 << 31), (1 << 31) - 1)
)  # fmt: skip
F32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
PAIRS = st.lists(st.tuples(U32, I32), min_size=1, max_size=MOST_SAMPLES)
MESSAGES = st.one_of(
    PAIRS.map(lambda pairs: Samples(tuple(t for t, _ in pairs), tuple(c for _, c in pairs))),
    st.builds(Index, U32, I32), st.builds(Sync, U32, U32), st.builds(Pong, U32, U32), st.builds(Answer, U16, U8),
    st.builds(ControllerStatus, U32, U8, U16, F32, F32, U32), st.builds(SetSpeed, F32, F32), st.just(Stop()),
    st.builds(SetCounts, U32), st.builds(Ping, U32),
)  # fmt: skip


def some(rng: random.Random, n: int) -> list[Message]:
    """Return random messages of a controller."""
    out: list[Message] = []
    for k in range(n):
        t = rng.getrandbits(32)
        out.append(
            Index(t, rng.randrange(-(1 << 31), 1 << 31))
            if k % 7 == 3
            else Samples((t, t ^ 1), (k, rng.randrange(4096)))
        )
    return out


@given(MESSAGES, U16)
def test_every_message_comes_back(message: Message, sequence: int) -> None:
    frame = encode(message, sequence)
    assert frame.count(0) == 1
    assert frame[-1] == 0
    assert len(frame) <= LONGEST
    assert FrameDecoder().feed(frame) == [(sequence, message)]


@given(st.lists(MESSAGES, max_size=8), st.lists(st.integers(1, 30), min_size=1))
def test_it_does_not_matter_how_the_bytes_are_cut(messages: list[Message], cuts: list[int]) -> None:
    data = b"".join(encode(m, k) for k, m in enumerate(messages))
    decoder, found, at = FrameDecoder(), [], 0
    for k in range(len(data)):
        step = cuts[k % len(cuts)]
        found += decoder.feed(data[at : at + step])
        at += step
    assert [m for _, m in found] == messages
    assert decoder.received.lost == decoder.received.damaged == 0


def test_the_largest_number_of_samples_comes_back() -> None:
    message = Samples(tuple(range(MOST_SAMPLES)), tuple(range(-MOST_SAMPLES, 0)))
    decoder = FrameDecoder()
    assert decoder.feed(encode(message, 3)) == [(3, message)]
    assert decoder.received.unknown == 0


def test_layout_is_as_documented() -> None:
    """Computed by hand from the documentation: version 1, type 2, sequence 0x0102, t 0x04030201, count -1, CRC-32."""
    packet = bytes([1, 2, 0x02, 0x01, 1, 2, 3, 4, 255, 255, 255, 255])
    packet += struct.pack("<I", zlib.crc32(packet))
    assert encode(Index(0x04030201, -1), 0x0102) == cobs.encode(packet) + b"\0"


def test_a_hundred_thousand_strings_of_garbage_are_refused() -> None:
    """Random bytes, and frames with bytes changed, removed, doubled and inserted."""
    rng = random.Random(1)
    decoder, whole = FrameDecoder(), 0
    for _ in range(50_000):
        assert decoder.feed(rng.randbytes(rng.randrange(1, 40)) + b"\0") == []
    for _ in range(60_000):
        message, sequence = some(rng, 1)[0], rng.getrandbits(16)
        frame = bytearray(encode(message, sequence))
        place, how = rng.randrange(len(frame) - 1), rng.randrange(4)
        if how == 0:
            frame[place] ^= rng.randrange(1, 256)
        elif how == 1:
            del frame[place]
        elif how == 2:
            frame[place:place] = rng.randbytes(1)
        else:
            frame[place:] = frame[place : rng.randrange(place + 1, len(frame))] * 2
        whole += len(found := decoder.feed(bytes(frame) + b"\0"))
        assert found in ([], [(sequence, message)])  # a zero inserted before a frame is harmless
    assert decoder.received.frames == whole < 100
    assert decoder.received.damaged > 109_000


@pytest.mark.parametrize("seed", range(20))
def test_what_was_whole_is_found_among_losses(seed: int) -> None:
    """A run of bytes is lost or changed. Only the frames that it touched are missing, and they are counted."""
    rng = random.Random(seed)
    messages = some(rng, 60)
    frames = [encode(m, k) for k, m in enumerate(messages)]
    data, ends = bytearray().join(frames), [sum(map(len, frames[: k + 1])) for k in range(60)]
    first = rng.randrange(ends[5], ends[50])
    last = first + rng.randrange(1, 120)
    touched = {k for k in range(60) if ends[k] > first and ends[k] - len(frames[k]) < last}
    if seed % 2:
        del data[first:last]
        # Joined with the next frame
        touched |= {max(touched) + 1} if last == ends[max(touched)] else set()
    else:
        data[first:last] = bytes(rng.randrange(1, 256) for _ in range(last - first))
        # Its final zero is gone
        touched |= {max(touched) + 1} if data[ends[max(touched)] - 1] else set()
    decoder = FrameDecoder()
    found = dict(decoder.feed(bytes(data)))
    assert all(found[k] == messages[k] for k in found if k is not None)
    assert set(range(60)) - set(found) <= touched
    assert decoder.received.lost == 60 - len(found)


def test_a_frame_without_end_is_let_go() -> None:
    decoder = FrameDecoder()
    assert decoder.feed(b"\x05" * 100_000) == []
    assert decoder.received.damaged > 100
    assert decoder.feed(b"\0" + encode(Ping(7), 0)) == [(0, Ping(7))]


def test_another_version_or_type_is_counted_and_passed_over() -> None:
    for head in (bytes([2, 1, 0, 0]), bytes([1, 0x77, 0, 0]), bytes([1, 2, 0, 0, 9])):
        packet = head + struct.pack("<I", zlib.crc32(head))
        decoder = FrameDecoder()
        assert decoder.feed(cobs.encode(packet) + b"\0") == []
        assert (decoder.received.unknown, decoder.received.damaged) == (1, 0)


def test_lost_frames_and_a_reset_are_told_apart() -> None:
    decoder = FrameDecoder()
    for sequence in (65534, 65535, 0, 5, 1, 2):
        decoder.feed(encode(Stop(), sequence))
    assert (decoder.received.lost, decoder.received.restarts, decoder.received.frames) == (4, 1, 6)


def test_lines_of_text() -> None:
    decoder = FrameDecoder()
    lines = b"345,678\r\nt_us,count\r\n1000,12\n2000,-13\r\nnonsense\n4294967296,1\n3000,4\n"
    found = [m for _, m in decoder.feed(lines)]
    assert found == [Samples((1000,), (12,)), Samples((2000,), (-13,)), Samples((3000,), (4,))]
    assert (decoder.received.lines, decoder.received.damaged) == (3, 2)


def test_a_frame_with_a_line_feed_in_it_is_no_line() -> None:
    frame = encode(Ping(0x0A0A0A0A), 0x0A0A)
    assert b"\n" in frame
    assert FrameDecoder().feed(frame) == [(0x0A0A, Ping(0x0A0A0A0A))]


def test_a_frame_that_begins_with_a_line_feed_is_no_line() -> None:
    """The first byte of a COBS frame is the position of the first zero, here 10, which is also a line feed."""
    message = Sync(0x01010101, 0x01010001)
    frame = encode(message, 0x0101)
    assert frame[0] == 10
    assert FrameDecoder().feed(frame) == [(0x0101, message)]


def test_empty_lines_do_no_harm() -> None:
    assert [m for _, m in FrameDecoder().feed(b"\n\nt,c\n\n1,2\n\n3,4\n")] == [
        Samples((1,), (2,)),
        Samples((3,), (4,)),
    ]


def test_what_does_not_fit_is_not_sent() -> None:
    for message in (
        Ping(1 << 32),
        Samples((), ()),
        Samples((1,) * 33, (1,) * 33),
        Samples((1,), (1 << 31,)),
        Sync(-1, 0),
        SetSpeed(1.0, 1e39),
    ):
        with pytest.raises(ValueError, match=r"\d"):
            encode(message, 0)
