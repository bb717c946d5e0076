"""Packets as bytes and back, whole or in pieces, and events put in order."""

import itertools
import re
import socket
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amiwarp import (
    AmiwarpError,
    Camera,
    Compensated,
    Events,
    Fisheye,
    FlatSide,
    Prism,
    RadialTangential,
)
from amiwarp.live.event_sorter import EventSorter
from amiwarp.live.stream import (
    HEADER,
    HELLO,
    MAGIC,
    EncoderSamples,
    End,
    Hello,
    PacketDecoder,
    encode_compensated,
    encode_encoder,
    encode_end,
    encode_events,
    encode_hello,
    encode_triggers,
)
from amiwarp.live.stream.stream_format import ENCODER, MOST, Triggers
from tests import ROOT

CAMERAS = (
    None,
    Camera(640, 480, 520.0, 521.0, 319.5, 239.5),
    Camera(640, 480, 520.0, 521.0, 319.5, 239.5, RadialTangential(-0.1, 0.01, 1e-4, -2e-4, 0.003)),
    Camera(640, 480, 520.0, 521.0, 319.5, 239.5, Fisheye(0.1, 0.2, 0.3, 0.4)),
)


def make(count: int, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    t = 1_700_000_000_000_000 + np.cumsum(rng.integers(0, 30, count))
    return Events.from_arrays(
        rng.integers(0, 640, count), rng.integers(0, 480, count), t, rng.integers(0, 2, count)
    )


def stream() -> tuple[list[object], bytes]:
    """Messages of every kind, and their bytes."""
    events = make(500)
    moved = Events(
        events.x.astype(np.float32) - 0.25, events.y.astype(np.float32), events.t, events.p
    )
    moved.x[7] = np.nan
    flags = (np.arange(500) % 8).astype(np.uint8)
    t, angle = np.arange(100) * 1000, np.linspace(-1.0, 9.0, 100)
    hello = Hello(640, 480, CAMERAS[2], Prism(0.04, 1.5, FlatSide.CAMERA), 2)
    messages = [hello, events, Compensated(moved, flags), Triggers(t), EncoderSamples(t, angle),
                EncoderSamples(t[::2] + 7, -angle[::2], True), End()]  # fmt: skip
    parts = [
        encode_hello(640, 480, hello.camera, hello.prism, 2),
        encode_events(events),
        encode_compensated(moved, flags),
        encode_triggers(t),
        encode_encoder(t, angle),
        encode_encoder(t[::2] + 7, -angle[::2], second=True),
        encode_end(),
    ]
    return messages, b"".join(parts)


def assert_same(got: object, expected: object) -> None:
    assert type(got) is type(expected)
    if isinstance(expected, np.ndarray):
        np.testing.assert_array_equal(got, expected, strict=True)
    elif isinstance(expected, (Events, Compensated, Triggers, EncoderSamples)):
        for name in type(expected).__slots__:
            assert_same(getattr(got, name), getattr(expected, name))
    else:
        assert got == expected


@settings(max_examples=40)
@given(cuts=st.lists(st.integers(0, 25_000), max_size=40))
def test_all_kinds_come_back_from_pieces_of_any_size(cuts):
    messages, data = stream()
    decoder, got = PacketDecoder("here"), []
    edges = [0, *sorted(cuts), len(data)]
    for start, stop in itertools.pairwise(edges):
        got += decoder.feed(data[start:stop])
    assert decoder.unfinished_at is None
    for one, other in zip(got, messages, strict=True):
        assert_same(one, other)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_hello_tells_camera_and_prism(camera):
    for prism, encoders in (
        (None, 1),
        (Prism(0.03), 1),
        (Prism(0.03, second=Prism(0.02, 1.6, FlatSide.CAMERA)), 2),
    ):
        assert list(
            PacketDecoder("here").feed(encode_hello(640, 480, camera, prism, encoders))
        ) == [Hello(640, 480, camera, prism, encoders)]


def test_a_stream_of_one_prism_is_that_of_earlier_versions():
    """Its bytes are those that programs without the second encoder write and read."""
    hello = encode_hello(64, 48, None, Prism(0.03))
    assert b"encoders" not in hello
    assert (
        hello[HEADER.size :]
        == b'{"width": 64, "height": 48, "prism": {"apex": 0.03, "index": 1.5168, "flat_side": "scene"}}'
    )
    assert encode_encoder(np.array([5]), np.array([1.0])) == packet(
        5, 1, b"\5" + bytes(13) + b"\xf0\x3f"
    )


def test_many_events_become_packets_of_bounded_size():
    events = make(2 * MOST + 5)
    got = list(PacketDecoder("here").feed(encode_events(events)))
    assert [len(part) for part in got] == [MOST, MOST, 5]
    assert_same(Events.concatenate(got), events)
    assert encode_events(Events.empty()) == b""


def test_events_are_views_of_the_packet_and_it_is_not_used_again():
    events = make(1000)
    decoder = PacketDecoder("here")
    first, second = decoder.feed(encode_events(events) + encode_events(events[::-1]))
    assert first.t.base is not None
    assert_same(first, events)
    assert_same(second, events[::-1])


def packet(
    kind: int, count: int, payload: bytes, *, magic: bytes = MAGIC, version: int = 1, wrong: int = 0
) -> bytes:
    return (
        HEADER.pack(magic, version, kind, 0, count, len(payload), zlib.crc32(payload) ^ wrong)
        + payload
    )


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (packet(4, 1, bytes(8), magic=b"AMIX"), "begins with b'AMIX'"),
        (packet(4, 1, bytes(8), version=2), "of version 2, not 1"),
        (packet(4, 1, bytes(8), wrong=1), "checksum of its 8 bytes"),
        (packet(4, 2, bytes(8)), "2 rows in 8 bytes"),
        (packet(4, MOST + 1, bytes(8 * MOST + 8)), f"{MOST + 1} rows"),
        (HEADER.pack(MAGIC, 1, 99, 0, 0, 1 << 31, 0), "2147483648 bytes"),
        (packet(HELLO, 0, b"{"), "Expecting"),
        (packet(HELLO, 0, b"\xff\xfe\x00"), "decode"),
        (packet(HELLO, 0, b"[]"), "attribute"),
        (packet(HELLO, 0, b'{"width": 640}'), "no attribute 'height'"),
        (packet(HELLO, 0, b'{"width": 640, "height": 0}'), "size of 640x0"),
        (
            packet(HELLO, 0, b'{"width": 640, "height": 480, "prism": {"apex": 2, "index": 1.5}}'),
            "prism apex",
        ),
        (
            packet(HELLO, 0, b'{"width": 640, "height": 480, "camera": {"width": 640}}'),
            "camera has no attribute",
        ),
        (packet(HELLO, 0, encode_hello(64, 48, CAMERAS[1])[HEADER.size :]), "640x480 for 64x48"),
    ],
)
def test_a_wrong_stream_is_refused_after_all_before_it(bad, message):
    events, got = make(300), []
    with pytest.raises(AmiwarpError, match=message) as caught:  # noqa: PT012
        for one in PacketDecoder("tcp:here:5").feed(encode_events(events) + bad + encode_end()):
            got.append(one)
    assert f"tcp:here:5: packet at byte {HEADER.size + 300 * 13}: " in str(caught.value)
    assert "\n" not in str(caught.value)
    assert [len(part) for part in got] == [300]


def test_kinds_that_are_unknown_are_passed_over():
    data = packet(77, 3, b"whatever") + packet(78, 0, b"") + encode_end()
    assert list(PacketDecoder("here").feed(data)) == [End()]


def test_an_end_within_a_packet_is_told():
    decoder = PacketDecoder("here")
    assert list(decoder.feed(encode_end() + encode_triggers(np.arange(5))[:-1])) == [End()]
    assert decoder.unfinished_at == HEADER.size


def test_room_is_never_more_than_the_packet():
    decoder, data = PacketDecoder("here"), encode_encoder(np.arange(MOST), np.zeros(MOST))
    assert len(decoder.free_buffer()) == HEADER.size
    decoder.free_buffer()[:] = data[: HEADER.size]
    assert decoder.commit(HEADER.size) is None
    assert len(decoder.free_buffer()) == len(data) - HEADER.size
    assert HEADER.unpack_from(data)[2] == ENCODER


def test_the_sender_of_the_documentation_is_understood():
    text = (ROOT / "docs" / "reference" / "stream-format.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(code, "stream-format.md", "exec"), names)
    ours, theirs = socket.socketpair()
    events, t, angle = make(50), np.arange(3), np.arange(3.0)
    with ours, theirs:
        names["send"](theirs, [(events.t, events.x, events.y, events.p)], [(t, angle)])
        got = list(PacketDecoder("here").feed(ours.recv(100_000)))
    for one, other in zip(
        got, [Hello(640, 480), EncoderSamples(t, angle), events, End()], strict=True
    ):
        assert_same(one, other)
    (end,) = re.findall(r"`((?:[0-9A-F]{2} ){19}[0-9A-F]{2})`", text)
    assert bytes.fromhex(end) == encode_end()


def at(*times: int) -> Events:
    """Events at times, told apart by their place."""
    t = np.array(times, np.int64)
    return Events(t.astype(np.uint16), t.astype(np.uint16), t, np.zeros(len(t), np.uint8))


def test_what_is_in_order_passes_untouched():
    sorter = EventSorter()
    for packet in (at(1, 2, 2), at(2, 5), at(), at(9)):
        assert sorter.put(packet) is packet
    assert len(sorter.flush()) == sorter.late == 0


def test_a_packet_is_sorted_and_equal_times_keep_their_order():
    x, p = np.arange(4, dtype=np.uint16), np.array([1, 0, 1, 0], np.uint8)
    events = Events(x, np.zeros(4, np.uint16), np.array([5, 3, 5, 3]), p)
    got = EventSorter().put(events)
    assert got.t.tolist() == [3, 3, 5, 5]
    assert got.x.tolist() == [1, 3, 0, 2]


def test_many_events_of_equal_times_keep_their_order():
    rng, n = np.random.default_rng(2), 5000
    t = rng.integers(0, 4, n)
    x = np.arange(n, dtype=np.uint16)
    got = EventSorter().put(Events(x, np.zeros(n, np.uint16), t, np.zeros(n, np.uint8)))
    assert got.x.tolist() == sorted(x.tolist(), key=lambda k: t[k])


def test_late_events_of_many_packets_keep_their_order():
    """A clock that jumps back: what comes after is too late for long, and no later packet overtakes it."""
    sorter = EventSorter(most_us=10)
    got = [
        sorter.put(packet) for packet in (at(1000, 1001), at(500, 501), at(502, 503), at(504, 505))
    ]
    assert [events.x.tolist() for events in got[1:]] == [[500, 501], [502, 503], [504, 505]]
    assert all(events.t.tolist() == [1001, 1001] for events in got[1:])
    assert sorter.late == 6


def test_late_ones_are_raised_once_and_then_waited_for():
    sorter = EventSorter()
    assert sorter.put(at(1000, 2000)).t.tolist() == [1000, 2000]
    got = sorter.put(at(1500, 2000))  # 500 us late
    assert (got.t.tolist(), got.x.tolist(), sorter.late) == ([2000], [1500], 1)
    assert sorter.put(at(2600)).t.tolist() == [2000]
    assert sorter.put(at(2300, 2900)).t.tolist() == [2300]
    assert sorter.put(at(3300)).t.tolist() == [2600]
    assert sorter.flush().t.tolist() == [2900, 3300]
    assert sorter.late == 1


def test_after_a_second_without_disorder_all_passes_at_once_again():
    sorter = EventSorter()
    sorter.put(at(1000))
    assert sorter.put(at(900)).t.tolist() == [1000]
    assert sorter.put(at(1100, 10_000)).t.tolist() == [1100]
    assert sorter.put(at(1_010_000)).t.tolist() == [10_000, 1_010_000]
    assert sorter.put(at(1_010_050)).t.tolist() == [1_010_050]


@settings(max_examples=150)
@given(
    times=st.lists(st.lists(st.integers(0, 40_000), max_size=30), max_size=30),
    most=st.integers(1, 60),
)
def test_every_event_comes_out_once_in_order(times, most):
    sorter = EventSorter(most_events=most)
    got = []
    for part in times:
        got.append(sorter.put(at(*part)))
        assert sorter._held is None or len(sorter._held) <= most
    out = Events.concatenate([*got, sorter.flush()])
    assert (np.diff(out.t) >= 0).all()
    assert sorted(out.x.tolist()) == sorted(t for part in times for t in part)
    assert (out.t >= out.x).all()
    assert sorter.late == np.count_nonzero(out.t != out.x)


def test_packets_late_by_a_little_lose_nothing_but_the_first():
    """A camera that hands every third packet over 4 ms late."""
    rng, sorter, out = np.random.default_rng(0), EventSorter(), []
    packets = [
        at(*np.sort(rng.integers(1000 * k, 1000 * k + 1000, 50)).tolist()) for k in range(60)
    ]
    for k in range(0, 60, 6):
        out += [sorter.put(packets[k + j]) for j in (0, 1, 3, 4, 5, 2)]
    out.append(sorter.flush())
    joined = Events.concatenate(out)
    assert len(joined) == 3000
    assert sorter.late == 50
    assert (np.diff(joined.t) >= 0).all()


def test_order_costs_one_comparison(monkeypatch):
    """Packets in order are neither sorted nor copied nor joined, however much passes."""
    events, sorter = make(10_000), EventSorter()

    def never(*_args, **_options):
        raise AssertionError

    monkeypatch.setattr(np, "argsort", never)
    monkeypatch.setattr(Events, "concatenate", never)
    monkeypatch.setattr(Events, "__getitem__", never)
    for k in range(200):
        packet = Events(events.x, events.y, events.t + 400_000 * k, events.p)
        assert sorter.put(packet) is packet
        assert sorter._held is None
