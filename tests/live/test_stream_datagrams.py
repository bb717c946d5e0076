"""Streams over UDP: datagrams of a safe size, losses counted, strangers ignored."""

import socket
import threading
import time
import zlib
from collections.abc import Iterator

import numpy as np
import pytest

from amiwarp import AmiwarpError, ErrorCode, Events
from amiwarp.live.stream import (
    DatagramReceiver,
    DatagramSink,
    End,
    PacketDecoder,
    encode_encoder,
    encode_events,
    encode_hello,
    encode_triggers,
    open_sink,
    open_source,
)

HELLO = encode_hello(64, 48)
HEAD_BYTES = 16
"""Size of what a datagram has before its packet [bytes]."""


def refused(code: ErrorCode, words: str) -> pytest.RaisesExc[AmiwarpError]:
    return pytest.raises(AmiwarpError, match=words, check=lambda error: error.code is code)


def make(count: int) -> Events:
    t = np.arange(count)
    return Events.from_arrays(t % 64, t % 48, t, t % 2)


def free_address() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"udp:127.0.0.1:{probe.getsockname()[1]}"


def place(address: str) -> tuple[str, int]:
    return "127.0.0.1", int(address.rpartition(":")[2])


def number_of(datagram: bytes) -> int:
    return int.from_bytes(datagram[8:16], "little")


@pytest.fixture
def raw() -> Iterator[socket.socket]:
    """Socket that receives datagrams as they are."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiving:
        receiving.bind(("127.0.0.1", 0))
        receiving.settimeout(10.0)
        yield receiving


def stream_of(raw: socket.socket, *packets: bytes) -> list[bytes]:
    """Return the datagrams of a stream with these packets."""
    sink = DatagramSink(f"udp:127.0.0.1:{raw.getsockname()[1]}", HELLO)
    for packet in packets:
        sink.send(packet)
    sink.close()
    found = [raw.recv(65536)]
    while found[-1][HEAD_BYTES + 5] != 6 or len([d for d in found if d[HEAD_BYTES + 5] == 6]) < 3:
        found.append(raw.recv(65536))
    return found


def test_a_stream_arrives_whole() -> None:
    address = free_address()
    events = make(5000)
    receiver = DatagramReceiver(address)
    with open_sink(address, HELLO) as sink:
        sink.send(encode_events(events) + encode_triggers(np.array([3, 4])))
        sink.send(encode_encoder(np.array([1, 2]), np.array([0.5, 0.75])))
    assert sink.lost == 0
    decoder = PacketDecoder("datagrams")
    got = []
    while not got or not isinstance(got[-1], End):
        got += decoder.feed(receiver.receive(10.0) or b"")
    receiver.close()
    assert receiver.lost == 0
    parts = [message for message in got if isinstance(message, Events)]
    assert len(parts) <= 3  # what waits is joined
    joined = Events.concatenate(parts)
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(events, name), strict=True)
    assert [m.t.tolist() for m in got if not isinstance(m, Events) and hasattr(m, "t")] == [
        [3, 4],
        [1, 2],
    ]


def test_datagrams_are_small_numbered_and_begin_with_the_hello(raw: socket.socket) -> None:
    found = stream_of(raw, encode_events(make(1000)))
    assert max(map(len, found)) <= 1400
    assert found[0][HEAD_BYTES:] == HELLO
    assert [number_of(datagram) for datagram in found] == list(range(len(found)))
    assert {datagram[:4] for datagram in found} == {b"AMIU"}
    assert len({datagram[4:8] for datagram in found}) == 1
    assert len(found) == 1 + -(-1000 // ((1400 - 16 - 20) // 13)) + 3
    other = stream_of(raw)
    assert other[0][4:8] != found[0][4:8]


def test_lost_late_and_strange_datagrams_are_counted_or_ignored(raw: socket.socket) -> None:
    found = stream_of(raw, *(encode_triggers(np.array([k])) for k in range(8)))
    stranger = stream_of(raw, encode_triggers(np.array([99])))
    damaged = bytearray(found[8])
    damaged[-1] ^= 1
    address = free_address()
    source_of = DatagramReceiver(address)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sent = [
            found[1],  # before the hello: the stream begins later
            b"", b"AMIU", b"x" * 60, found[0][:-1],
            found[0], found[1],
            stranger[0], stranger[1],
            found[4],  # 2 and 3 are lost
            found[3],  # late
            found[4],  # twice
            found[5],
            bytes(damaged),  # 7
            found[10],  # the end; 6, 7, 8 and 9 were lost or damaged
        ]  # fmt: skip
        for datagram in sent:
            sender.sendto(datagram, place(address))
    decoder = PacketDecoder("datagrams")
    got = []
    while not got or not isinstance(got[-1], End):
        got += decoder.feed(source_of.receive(10.0) or b"")
    source_of.close()
    edges = [t for message in got if hasattr(message, "t") for t in message.t.tolist()]
    assert edges == [0, 3, 4]
    assert source_of.lost == 2 + 4


def test_a_receiver_that_begins_later_gets_the_hello_and_what_follows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    address = free_address()
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    sink = DatagramSink(address, HELLO)
    sink.send(encode_triggers(np.array([1])))
    receiver = DatagramReceiver(address)
    sink.send(encode_triggers(np.array([2])))
    assert receiver.receive(0.0) is None
    now = 100.6
    sink.send(encode_triggers(np.array([3])))
    assert receiver.receive(0.0) == HELLO
    assert receiver.receive(0.0) == encode_triggers(np.array([3]))
    now = 102.0
    sink.tick()
    assert receiver.receive(0.0) == HELLO
    assert receiver.lost == 0
    receiver.close()
    sink.close()


def test_a_sender_that_dies_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    address = free_address()
    sink = DatagramSink(address, HELLO)
    receiver = DatagramReceiver(address)
    now = time.monotonic() + 1.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    now += 60.0
    assert receiver.receive(0.0) is None
    assert receiver.problem is None  # no sender began yet
    sink.tick()
    assert receiver.receive(0.0) == HELLO
    now += 2.9
    assert receiver.receive(0.0) is None
    assert receiver.problem is None
    now += 0.2
    assert receiver.receive(0.0) is None
    assert receiver.problem == "its sender has sent nothing for 3 s"
    receiver.close()
    sink.close()


def test_datagrams_that_the_system_refuses_are_counted_and_said_once() -> None:
    said: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM):
        sink = DatagramSink("udp:255.255.255.255:9", HELLO, say=said.append)
        sink.send(encode_triggers(np.array([1])))
        assert sink.lost == 2
        sink.close()
    assert len(said) == 1
    assert "a datagram was not sent: " in said[0]


def test_a_stream_over_udp_is_a_source() -> None:
    address = free_address()
    receiver_first = DatagramReceiver(address)
    with refused(ErrorCode.UNREACHABLE, "cannot receive at this address"):
        open_source(address)
    receiver_first.close()
    stop = threading.Event()

    def send() -> None:
        with DatagramSink(address, HELLO) as sink:
            while not stop.wait(0.01):  # the source waits for the next hello
                sink.tick()
            sink.send(encode_events(make(300)))

    sender = threading.Thread(target=send)
    sender.start()
    source = open_source(address)
    stop.set()
    assert source.size == (64, 48)
    assert sum(len(packet.events) for packet in source.packets()) == 300
    assert getattr(source, "lost_packets", None) == 0
    assert getattr(source, "problem", "") is None
    sender.join()
    source.close()


def test_a_hello_that_does_not_fit_into_a_datagram_is_refused() -> None:
    payload = b'{"width": 64, "height": 48, "note": "' + b"x" * 1400 + b'"}'
    sizes = len(payload).to_bytes(4, "little") + zlib.crc32(payload).to_bytes(4, "little")
    with refused(ErrorCode.INVALID, "at most 1,384 fit"):
        open_sink(free_address(), HELLO[:12] + sizes + payload)


@pytest.mark.parametrize(
    "spec", ["udp:", "udp:1:2:x", "udp:127.0.0.1", "udp:127.0.0.1:0", "udp:127.0.0.1:70000"]
)
def test_invalid_addresses_are_refused(spec: str) -> None:
    with refused(ErrorCode.INVALID, "give"):
        open_source(spec)
    with refused(ErrorCode.INVALID, "give"):
        open_sink(spec, HELLO)
