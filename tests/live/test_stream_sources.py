"""Sources of live events and sinks: files, sockets and pipes."""

import itertools
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from amiwarp import AmiwarpError, Camera, Encoder, ErrorCode, Events, Packet, Prism, RecordingWriter
from amiwarp.live.link import monotonic_us
from amiwarp.live.stream import (
    HEADER,
    End,
    FileSource,
    Hello,
    PacketDecoder,
    PipeSink,
    SocketSink,
    StreamSource,
    encode_compensated,
    encode_encoder,
    encode_end,
    encode_events,
    encode_hello,
    encode_triggers,
    open_sink,
    open_source,
    sinks,
    stream_source,
)
from amiwarp.live.stream import sockets as connections
from tests.errors import refused

SIZE = (320, 240)
CAMERA = Camera(*SIZE, 200.0, 201.0, 159.5, 119.5)
HELLO = encode_hello(*SIZE, CAMERA, Prism(0.04))
LONG_S = 120.0
"""Limit of waits: only what hangs takes as long [s]."""


def make(count: int, *, start: int = 5_000_000, seed: int = 0, mean_us: float = 3.0) -> Events:
    rng = np.random.default_rng(seed)
    t = start + np.cumsum(rng.poisson(mean_us, count))
    return Events.from_arrays(
        rng.integers(0, 320, count), rng.integers(0, 240, count), t, rng.integers(0, 2, count)
    )


def assert_equal(got: Events, expected: Events) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), strict=True)


def joined(packets: list[Packet]) -> Events:
    return Events.concatenate([packet.events for packet in packets if len(packet.events)])


def record(path: Path, events: Events, encoder: Encoder | None = None) -> Path:
    with RecordingWriter(
        path, width=320, height=240, camera=CAMERA, prism=Prism(0.04), encoder=encoder
    ) as writer:
        writer.append(events)
    return path


class Host:
    """A clock that only sleeping moves on."""

    def __init__(self) -> None:
        self.now = 70_000_000
        self.slept: list[float] = []

    def monotonic(self) -> float:
        return self.now / 1e6

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += round(seconds * 1e6)


def test_a_file_is_replayed_at_its_pace(tmp_path):
    gap = 130_000
    events = Events.concatenate([make(3000), make(2000, start=5_009_000 + gap)])
    host = Host()
    path = record(tmp_path / "a.h5", events)
    source = FileSource(path, pace=0.5, packet_us=2000, clock=lambda: host.now, sleep=host.sleep)
    assert (source.size, source.camera, source.prism) == (SIZE, CAMERA, Prism(0.04))
    assert (source.encoders, source.name) == (0, str(path))
    got = []
    for packet in source.packets():
        got.append(packet)
        if len(packet.events):
            over = (int(packet.events.t[0]) - int(events.t[0])) // 2000 * 2000 + 2000
            assert host.now == packet.arrived_us == 70_000_000 + 2 * over
            assert np.ptp(packet.events.t) < 2000
    assert_equal(joined(got), events)
    assert max(host.slept) <= 0.05
    assert sum(not len(packet.events) for packet in got) == 2 * gap // 50_000
    source.close()


def test_a_slow_reader_gets_all_and_is_told_when_it_came(tmp_path):
    events, host = make(3000), Host()
    source = FileSource(record(tmp_path / "a.h5", events), clock=lambda: host.now, sleep=host.sleep)
    got = []
    for packet in source.packets():
        got.append(packet)
        host.now += 5000  # takes five times as long as there is
    assert host.slept == [0.001]
    assert [packet.arrived_us for packet in got] == [70_001_000 + 1000 * k for k in range(len(got))]
    assert_equal(joined(got), events)


def test_encoder_samples_come_in_step_and_one_ahead(tmp_path):
    t = np.arange(4_990_000, 5_050_000, 700)
    encoder = Encoder(t + 300, np.linspace(0.0, 9.0, t.size), 300.25)
    source = open_source(
        str(record(tmp_path / "a.h5", make(10_000), encoder)), pace=None, packet_us=1000
    )
    assert source.encoders == 1
    got, seen = list(source.packets()), 0
    for packet in got[:-1]:
        end = (
            int(packet.events.t[0] - got[0].events.t[0]) // 1000 * 1000
            + 1000
            + int(got[0].events.t[0])
        )
        seen += len(packet.encoder_t)
        assert t[seen - 2] < end <= t[seen - 1]
        assert packet.encoder_t.dtype == np.int64
    assert not len(got[-1].events)
    np.testing.assert_array_equal(np.concatenate([packet.encoder_t for packet in got]), t)
    np.testing.assert_array_equal(
        np.concatenate([packet.encoder_angle for packet in got]), encoder.angle
    )


def test_samples_of_two_encoders_come_in_step(tmp_path):
    t, second_t = np.arange(4_990_000, 5_050_000, 700), np.arange(4_995_000, 5_060_000, 1900)
    encoder = Encoder(t, t * 1e-5, second=Encoder(second_t, second_t * -3e-6))
    source = open_source(
        str(record(tmp_path / "a.h5", make(10_000), encoder)), pace=None, packet_us=1000
    )
    assert source.encoders == 2
    for _ in range(2):  # the source can be played again
        got, sent = list(source.packets()), [0, 0]
        first = int(got[0].events.t[0])
        for packet in got[:-1]:
            end = first + ((int(packet.events.t[0]) - first) // 1000 + 1) * 1000
            sent = [sent[0] + len(packet.encoder_t), sent[1] + len(packet.second_t)]
            for times, count in ((t, sent[0]), (second_t, sent[1])):
                assert times[count - 2] < end <= times[count - 1]
        for name, values in (("encoder_t", t), ("encoder_angle", encoder.angle), ("second_t", second_t),
                             ("second_angle", encoder.second.angle)):  # fmt: skip
            np.testing.assert_array_equal(
                np.concatenate([getattr(packet, name) for packet in got]), values
            )


def test_what_a_replayed_file_does_not_state_is_said(tmp_path):
    path = tmp_path / "table.csv"
    rows = [f"{1000 * k},{k % 240},{k % 180},{k % 2}" for k in range(500)]
    path.write_text("\n".join(["t,x,y,p", *rows]))
    said: list[str] = []
    source = open_source(str(path), say=said.append)
    assert source.size == (240, 180)
    assert len(said) == 2
    assert "assumed time unit us (--time-unit): amiwarp convert has the option" in said[0]
    assert "assumed size 240x180 (--size): amiwarp convert" in said[1]
    rows[-1] = "4000000000,1,1,1"  # over an hour
    path.write_text("\n".join(["t,x,y,p", *rows]))
    message = r"--time-unit s, ms, us or ns: amiwarp convert has the option; play the file that"
    with pytest.raises(AmiwarpError, match=message):
        open_source(str(path))


def test_files_that_cannot_be_replayed(tmp_path):
    moved = make(10)
    moved = Events(moved.x.astype(np.float32), moved.y.astype(np.float32), moved.t, moved.p)
    with pytest.raises(AmiwarpError, match=r"a\.h5: is compensated already"):
        open_source(str(record(tmp_path / "a.h5", moved)))
    path = str(record(tmp_path / "b.h5", make(10)))
    for pace in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(AmiwarpError, match=r"pace = .*positive"):
            open_source(path, pace=pace)
    with pytest.raises(AmiwarpError, match="packet_us = 0"):
        open_source(path, packet_us=0)
    with refused(ErrorCode.FILE_MISSING):
        open_source(str(tmp_path / "c.h5"))


def pipe(data: bytes) -> StreamSource:
    """A source of all of a stream."""
    reading, writing = os.pipe()
    thread = threading.Thread(target=lambda: (os.write(writing, data), os.close(writing)))
    thread.start()
    try:
        return StreamSource("the pipe", open(reading, "rb", buffering=0))
    finally:
        thread.join()


def test_a_stream_brings_events_triggers_and_encoder():
    events, edges, t, angle = make(3000), np.array([4, 5]), np.arange(7), np.arange(7.0)
    parts = [
        HELLO,
        encode_events(events),
        encode_triggers(edges),
        encode_encoder(t, angle),
        HELLO,
        encode_end(),
    ]
    source = pipe(b"".join(parts))
    before = monotonic_us()
    first, second, third = source.packets()
    assert (source.size, source.camera, source.prism) == (SIZE, CAMERA, Prism(0.04))
    assert_equal(first.events, events)
    np.testing.assert_array_equal(second.triggers, edges)
    np.testing.assert_array_equal(third.encoder_t, t)
    np.testing.assert_array_equal(third.encoder_angle, angle)
    assert before <= first.arrived_us <= third.arrived_us
    assert source.problem is None
    source.close()


def test_a_stream_brings_the_samples_of_two_encoders():
    t, angle = np.arange(7), np.arange(7.0)
    parts = [
        encode_hello(*SIZE, encoders=2),
        encode_encoder(t, angle),
        encode_encoder(t + 3, -angle, second=True),
    ]
    source = pipe(b"".join([*parts, encode_end()]))
    assert source.encoders == 2
    first, second = source.packets()
    for packet, given in ((first, (t, angle, (), ())), (second, ((), (), t + 3, -angle))):
        for name, values in zip(
            ("encoder_t", "encoder_angle", "second_t", "second_angle"), given, strict=True
        ):
            np.testing.assert_array_equal(getattr(packet, name), values)
        assert not packet.empty
        assert packet.held_bytes > 2 * t.nbytes
    source.close()


@pytest.mark.parametrize(
    ("tail", "problem"),
    [
        (b"", "ended without an end packet"),
        (
            encode_events(make(9))[:-1],
            f"ended within the packet at byte {len(HELLO) + HEADER.size + 5 * 13}",
        ),
        (b"AM", f"ended within the packet at byte {len(HELLO) + HEADER.size + 5 * 13}"),
    ],
)
def test_a_stream_that_breaks_off_is_used_up_to_there(tail, problem):
    source = pipe(HELLO + encode_events(make(5)) + tail)
    assert [len(packet.events) for packet in source.packets()] == [5]
    assert source.problem == problem
    source.close()


@pytest.mark.parametrize(
    ("tail", "message"),
    [
        (
            b"garbage, a good deal of it",
            f"packet at byte {len(HELLO) + HEADER.size + 5 * 13}: it begins with",
        ),
        (
            encode_compensated(Events.from_arrays([0.5], [0.5], [1], [1]), np.zeros(1, np.uint8)),
            "sends compensated or undistorted events; .* --raw-to passes on, or .* with its --out",
        ),
        (encode_events(Events.from_arrays([320], [0], [1], [1])), "outside the 320x240 frame"),
        (encode_encoder(np.arange(1), np.array([np.nan])), "not finite"),
        (
            encode_encoder(np.arange(1), np.array([0.0]), second=True),
            "a second encoder come without 'encoders': 2",
        ),
    ],
)
def test_a_wrong_stream_is_an_error_after_all_before_it(tail, message):
    source, got = pipe(HELLO + encode_events(make(5)) + tail), []
    with pytest.raises(AmiwarpError, match=f"the pipe: .*{message}"):  # noqa: PT012
        for packet in source.packets():
            got.append(len(packet.events))
    assert got == [5]
    source.close()


def test_a_stream_begins_with_a_hello(monkeypatch):
    for data, message in (
        (encode_end(), "begins without a hello"),
        (b"", "ended without"),
        (b"AMI", "ended within"),
    ):
        with pytest.raises(AmiwarpError, match=f"the pipe: {message}"):
            pipe(data)
    monkeypatch.setattr(stream_source, "HELLO_S", 0.06)
    ours, theirs = socket.socketpair()
    with ours, theirs, pytest.raises(AmiwarpError, match="the silent: sent no hello"):
        StreamSource("the silent", ours.makefile("rb", buffering=0))


def test_standard_input_and_output(tmp_path):
    events = make(700)
    with open(tmp_path / "stream", "wb") as file, PipeSink(HELLO, file) as sink:
        sink.send(encode_events(events))
    script = (
        "from amiwarp.live.stream.stream_format import encode_events, encode_hello\n"
        "from amiwarp.live.stream import open_sink\n"
        "from amiwarp.live.stream.sources import open_source\n"
        "source = open_source('-')\n"
        "with open_sink('-', encode_hello(*source.size, source.camera, source.prism)) as sink:\n"
        "    for packet in source.packets():\n"
        "        sink.send(encode_events(packet.events))\n"
        "source.close()\n"
    )
    with open(tmp_path / "stream", "rb") as file:
        done = subprocess.run(
            [sys.executable, "-X", "dev", "-c", script], stdin=file, capture_output=True, check=True
        )
    assert (done.stdout, done.stderr) == ((tmp_path / "stream").read_bytes(), b"")


def test_a_pipe_that_nobody_reads(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    with (
        open(writing, "wb", buffering=0) as file,
        pytest.raises(AmiwarpError, match="standard output: Broken pipe"),
    ):
        PipeSink(HELLO, file)


@pytest.fixture(params=["tcp", "tcp6", "unix"])
def address(request, tmp_path):
    return {"tcp": "tcp::0", "tcp6": "tcp:[::1]:0", "unix": f"unix:{tmp_path}/socket"}[
        request.param
    ]


def test_any_number_of_clients_get_hello_packets_and_end(address, tmp_path, monkeypatch):
    monkeypatch.setattr(sinks, "DRAIN_S", LONG_S)
    events = make(60_000)
    with SocketSink(address, HELLO) as sink:
        assert sink.address.startswith(
            "tcp:127.0.0.1:" if address == "tcp::0" else address[: address.rfind(":") + 1]
        )
        sink.send(encode_events(events[:10]))  # nobody is there yet
        early = [connections.connect(sink.address) for _ in range(2)]
        sink.tick()
        assert sink.clients == 2
        late = connections.connect(sink.address)
        sink.send(encode_events(events[10:20]))
        parts = [StreamSource("it", one.makefile("rb", buffering=0)) for one in (*early, late)]
        got: list[list[Packet]] = [[] for _ in parts]

        def collect(source, into):
            into += source.packets()

        threads = [
            threading.Thread(target=collect, args=pair) for pair in zip(parts, got, strict=True)
        ]
        for thread in threads:
            thread.start()
        for start in range(20, len(events), 5000):
            sink.send(encode_events(events[start : start + 5000]))
    for thread in threads:
        thread.join(LONG_S)
    for source, packets, connection in zip(parts, got, (*early, late), strict=True):
        assert_equal(joined(packets), events[10:])
        assert (source.problem, source.size, sink.lost) == (None, SIZE, 0)
        source.close()
        connection.close()
    assert not (tmp_path / "socket").exists()


def test_packets_that_wait_for_a_client_at_the_end_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(sinks, "DRAIN_S", 0.05)
    sink = SocketSink(f"unix:{tmp_path}/s", HELLO)
    with connections.connect(sink.address) as slow:
        sink.tick()
        for k in range(60):
            two = encode_events(make(2000, start=4000 * k)) + encode_events(
                make(2000, start=4000 * k + 2000)
            )
            sink.send(two)
        assert sink.lost == 0
        sink.close()
        slow.settimeout(LONG_S)
        data = b"".join(iter(lambda: slow.recv(1 << 20), b""))
    got = sum(isinstance(message, Events) for message in PacketDecoder("slow").feed(data))
    assert 0 < got < 120
    # A packet of which a part was sent is lost, too; the two of one call are counted together.
    assert 120 <= got + sink.lost <= 121


def test_a_slow_client_loses_whole_packets_and_no_other_does(tmp_path, monkeypatch):
    monkeypatch.setattr(sinks, "DRAIN_S", LONG_S)
    with SocketSink(f"unix:{tmp_path}/s", HELLO, most_bytes=1 << 18) as sink:
        slow, quick, gone = (connections.connect(sink.address) for _ in range(3))
        sink.tick()
        gone.close()
        decoder, seen = PacketDecoder("quick"), []
        quick.setblocking(False)
        for k in range(300):
            sink.send(encode_events(make(1000, start=10_000 * k)))
            try:
                while True:
                    seen += decoder.feed(quick.recv(1 << 20))
            except BlockingIOError:
                pass
        assert sink.clients == 2
        lost = sink.lost
        held = sink._clients[0].waiting_bytes
        assert 0 < held <= (1 << 18) + 20_000
        thread = threading.Thread(target=sink.close)
        thread.start()
        slow.settimeout(LONG_S)
        data = b"".join(iter(lambda: slow.recv(1 << 20), b""))
        quick.setblocking(True)
        seen += decoder.feed(b"".join(iter(lambda: quick.recv(1 << 20), b"")))
        thread.join()
    slow.close()
    quick.close()
    assert [type(message) for message in seen] == [Hello, *[Events] * 300, End]
    got = list(PacketDecoder("slow").feed(data))
    assert isinstance(got[0], Hello)
    assert isinstance(got[-1], End)
    starts = [int(message.t[0]) // 10_000 for message in got[1:-1]]
    assert len(starts) == 300 - lost < 300
    assert all(a < b for a, b in itertools.pairwise(starts))


def test_a_source_may_listen_for_its_sender(tmp_path):
    path, events = tmp_path / "s", make(100)

    def send() -> None:
        while not path.exists():
            time.sleep(0.002)
        with connections.connect(f"unix:{path}") as connection:
            connection.sendall(HELLO)
            connection.sendall(encode_events(events) + encode_end())

    thread = threading.Thread(target=send)
    thread.start()
    source = open_source(f"unix-listen:{path}")
    assert_equal(joined(list(source.packets())), events)
    thread.join()
    source.close()
    assert not path.exists()


def test_a_silent_sender_brings_empty_packets():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.sendall(HELLO)
        source = StreamSource("the silent", ours.makefile("rb", buffering=0))
        packets = source.packets()
        for _ in range(2):
            assert not len(next(packets).events)
        half = encode_events(make(10))
        theirs.sendall(half[:50])
        assert not len(next(packets).events)
        theirs.sendall(half[50:])
        assert next(len(packet.events) for packet in packets if len(packet.events)) == 10
        source.close()


def test_empty_packets_come_each_50_ms_of_silence(monkeypatch):
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.sendall(HELLO)
        source, host = StreamSource("the silent", ours.makefile("rb", buffering=0)), Host()

        def silent(_file, seconds):
            host.sleep(seconds + 1e-4)
            return False

        monkeypatch.setattr(stream_source, "ready", silent)
        monkeypatch.setattr(stream_source, "time", SimpleNamespace(monotonic=host.monotonic))
        monkeypatch.setattr(stream_source, "monotonic_us", lambda: host.now)
        packets = list(itertools.islice(source.packets(), 5))
        source.close()
    assert [packet.arrived_us for packet in packets] == [
        70_050_100,
        70_100_200,
        70_150_300,
        70_200_400,
        70_250_500,
    ]
    assert all(packet.empty for packet in packets)


def test_addresses_that_are_none(tmp_path):
    for address in ("tcp:host", "tcp:host:99999", "tcp:", "unix:", "tcp:1:x"):
        with pytest.raises(
            AmiwarpError, match=f"{address}: is not an address; give tcp:HOST:PORT or unix:PATH"
        ):
            open_source(address)
    with pytest.raises(AmiwarpError, match="with a port up to 65535"):
        open_source("tcp:host:65536")
    with socket.create_server(("127.0.0.1", 0)) as server:
        taken = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(AmiwarpError, match=f"{taken}: cannot listen at this address: .*in use"):
            SocketSink(taken, HELLO)
    for address in (taken, f"unix:{tmp_path}/nobody"):
        with pytest.raises(AmiwarpError, match=f"{address}: .*start its sender first"):
            open_source(address)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(AmiwarpError, match="cannot listen at this address"):
        open_sink(f"unix:{tmp_path}/file", HELLO)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_socket_left_behind_is_replaced_one_in_use_is_not(tmp_path):
    address = f"unix:{tmp_path}/s"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(f"{tmp_path}/s")
    with (
        SocketSink(address, HELLO),
        pytest.raises(AmiwarpError, match="cannot listen at this address"),
    ):
        SocketSink(address, HELLO)
    assert not (tmp_path / "s").exists()
