"""Streams through shared memory: every packet once, losses counted, writers that die, readers in other languages."""

import errno
import json
import mmap
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from amiwarp import AmiwarpError, ErrorCode, Events, open_recording
from amiwarp.live.stream import (
    End,
    Hello,
    PacketDecoder,
    RingReceiver,
    RingSink,
    encode_compensated,
    encode_encoder,
    encode_events,
    encode_hello,
    encode_triggers,
    open_sink,
    open_source,
    shared_ring,
)
from tests import ROOT

HELLO = encode_hello(64, 48)
READERS = ROOT / "examples" / "shared_memory"
LONG_S = 60.0
"""Limit of waits: only what hangs takes as long [s]."""
needs_dev_shm = pytest.mark.skipif(
    not Path("/dev/shm").is_dir(),
    reason="this system has no /dev/shm, through which the test looks in",
)


def refused(code: ErrorCode, words: str) -> pytest.RaisesExc[AmiwarpError]:
    return pytest.raises(AmiwarpError, match=words, check=lambda error: error.code is code)


def make(count: int, start: int = 0) -> Events:
    t = np.arange(start, start + count)
    return Events.from_arrays(t % 64, t % 48, t, t % 2)


def numbered(k: int) -> bytes:
    return encode_triggers(np.array([k]))


def number_in(packet: bytes) -> int:
    return int.from_bytes(packet[20:28], "little")


def taken(receiver: RingReceiver) -> list[bytes]:
    """Return the packets that wait."""
    return list(iter(lambda: receiver.receive(0.0), None))


@pytest.fixture
def address() -> Iterator[str]:
    name = f"amiwarp-{uuid.uuid4().hex[:12]}"
    yield f"shm:{name}"
    Path("/dev/shm", name).unlink(missing_ok=True)


def memory_of(address: str) -> mmap.mmap:
    with open(f"/dev/shm/{address.removeprefix('shm:')}", "r+b") as file:
        return mmap.mmap(file.fileno(), 0)


def test_every_kind_of_packet_arrives_once_and_long_ones_in_parts(address: str) -> None:
    events = make(10_000)
    flags = np.arange(10_000).astype(np.uint8) % 8
    moved = Events(
        events.x.astype(np.float32) + 0.25, events.y.astype(np.float32), events.t, events.p
    )
    decoder = PacketDecoder("ring")
    with RingSink(address, HELLO, slot_bytes=4096) as sink:
        receiver = RingReceiver(address)
        sink.send(encode_events(events) + encode_triggers(np.array([7, 9])))
        sink.send(encode_encoder(np.array([1, 2]), np.array([0.5, 0.75]), second=True))
        sink.send(encode_compensated(moved, flags))
    packets = taken(receiver)
    assert max(map(len, packets)) <= 4096 - 16
    assert receiver.lost == 0
    messages = [message for packet in packets for message in decoder.feed(packet)]
    assert messages[0] == Hello(64, 48)
    assert messages[-1] == End()
    got = Events.concatenate([m for m in messages if isinstance(m, Events)])
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(got, name), getattr(events, name))
    compensated = [m for m in messages if hasattr(m, "flags")]
    np.testing.assert_array_equal(np.concatenate([m.flags for m in compensated]), flags)
    got_x = np.concatenate([m.events.x for m in compensated])
    np.testing.assert_array_equal(got_x, moved.x, strict=True)
    (samples,) = (m for m in messages if hasattr(m, "second"))
    assert (samples.t.tolist(), samples.angle.tolist(), samples.second) == (
        [1, 2],
        [0.5, 0.75],
        True,
    )
    receiver.close()


def test_a_reader_that_is_overtaken_counts_what_it_lost(address: str) -> None:
    with RingSink(address, HELLO, slots=8, slot_bytes=64) as sink:
        slow = RingReceiver(address)
        assert slow.receive(0.0) == HELLO
        for k in range(7):
            sink.send(numbered(k))
        quick = RingReceiver(address)  # begins here
        assert [number_in(packet) for packet in taken(slow)] == list(range(7))
        assert slow.lost == 0
        for k in range(7, 27):
            sink.send(numbered(k))
        assert [number_in(packet) for packet in taken(slow)] == [23, 24, 25, 26]
        assert slow.lost == 16
        assert [number_in(packet) for packet in taken(quick)[1:]] == [23, 24, 25, 26]
        assert quick.lost == 16
        slow.close()
        quick.close()


def test_a_packet_that_is_overwritten_while_it_is_read_is_lost_and_not_mixed(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RingSink(address, HELLO, slots=4, slot_bytes=64) as sink:
        receiver = RingReceiver(address)
        receiver.receive(0.0)
        sink.send(numbered(0))

        def overwritten(packet: bytes) -> bool:
            """Check the copy of packet 0 after the writer has written the slot again."""
            monkeypatch.undo()
            for k in range(1, 5):
                sink.send(numbered(k))
            return True

        monkeypatch.setattr(shared_ring, "is_packet", overwritten)
        assert [number_in(packet) for packet in taken(receiver)] == []
        assert [number_in(packet) for packet in taken(receiver)] == [3, 4]
        assert receiver.lost == 3
        receiver.close()


@needs_dev_shm
@pytest.mark.parametrize(
    ("place", "value"),
    [(16 + 20, 99), (12, 1), (8, 5), (8, 200)],
    ids=["a byte of the payload", "the check of an older packet", "short", "longer than the slot"],
)
def test_a_packet_that_is_not_whole_is_read_again(
    address: str, place: int, value: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RingSink(address, HELLO, slots=4, slot_bytes=64) as sink:
        receiver = RingReceiver(address)
        receiver.receive(0.0)
        sink.send(numbered(5))
        memory = memory_of(address)
        at = struct.unpack_from("<I", memory, 20)[0] + place
        before = memory[at]
        assert before != value
        memory[at] = value
        assert receiver.receive(0.0) is None
        memory[at] = before
        assert number_in(receiver.receive(0.0) or b"") == 5

        monkeypatch.setattr(shared_ring, "DAMAGED_S", 0.0)
        sink.send(numbered(6))
        memory[at + 64] ^= 1
        assert receiver.receive(0.05) is None
        assert receiver.problem == "packet 1 is damaged"
        receiver.close()


def test_a_second_writer_is_refused_and_the_first_goes_on(address: str) -> None:
    with RingSink(address, HELLO) as sink:
        receiver = RingReceiver(address)
        with refused(ErrorCode.UNREACHABLE, "another program writes to it"):
            RingSink(address, HELLO)
        sink.send(numbered(1))
        assert [number_in(packet) for packet in taken(receiver)[1:]] == [1]
        receiver.close()
    with refused(ErrorCode.UNREACHABLE, "no such shared memory"):
        open_source(address)
    with RingSink(address, HELLO):  # the name is free again
        pass


@needs_dev_shm
def test_memory_of_others_is_left_alone(address: str) -> None:
    path = Path("/dev/shm", address.removeprefix("shm:"))
    path.write_bytes(b"mine" * 25)
    with refused(ErrorCode.UNREACHABLE, "something else"):
        RingSink(address, HELLO)
    with refused(ErrorCode.UNREACHABLE, "holds no ring"):
        RingReceiver(address)
    assert path.read_bytes() == b"mine" * 25


def test_memory_of_another_user_is_an_error(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(shared_ring, "untracked_shared_memory", denied)
    with refused(ErrorCode.UNREACHABLE, "Permission denied; run both programs as the same user"):
        RingReceiver(address)


@needs_dev_shm
def test_a_ring_of_another_version_or_with_other_sizes_is_refused(address: str) -> None:
    with RingSink(address, HELLO, slots=4, slot_bytes=64):
        memory = memory_of(address)
        for place, value in ((4, 2), (8, 5), (8, 1), (12, 63), (16, 65_000), (20, 4)):
            before = memory[place : place + 4]
            memory[place : place + 4] = value.to_bytes(4, "little")
            with refused(ErrorCode.FILE_DAMAGED, "expected version 1"):
                RingReceiver(address)
            memory[place : place + 4] = before
        RingReceiver(address).close()


@pytest.mark.parametrize("name", ["", "a/b", "a b", "é", "x" * 31])
def test_names_that_some_systems_refuse_are_refused(name: str) -> None:
    for open_ in (lambda spec: open_sink(spec, HELLO), open_source):
        with refused(ErrorCode.INVALID, "1 to 30 letters"):
            open_(f"shm:{name}")


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="this system reserves no memory")
@needs_dev_shm
def test_too_little_memory_is_an_error_and_leaves_nothing(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with refused(ErrorCode.OUTPUT_FAILED, "No space left.*--shm-size"):
        RingSink(address, HELLO)
    assert not Path("/dev/shm", address.removeprefix("shm:")).exists()


WRITER = """
import sys, time
import numpy as np
from amiwarp.live.stream import RingSink, encode_hello, encode_triggers
sink = RingSink(sys.argv[1], encode_hello(64, 48))
print("ready", flush=True)
sys.stdin.readline()
sink.send(encode_triggers(np.array([5])))
print("sent", flush=True)
time.sleep(600)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_a_writer_that_dies_is_noticed_and_its_ring_is_replaced(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_ring, "DEAD_S", 0.6)
    said: list[str] = []
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, address], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert writer.stdin is not None
    assert writer.stdout is not None
    writer.stdout.readline()
    once = open_source(address)
    source = open_source(address, wait_s=LONG_S, say=said.append)
    writer.stdin.write(b"\n")
    writer.stdin.flush()
    writer.stdout.readline()
    writer.kill()
    writer.communicate()
    edges = []
    sink = None
    for packet in source.packets():
        edges += packet.triggers.tolist()
        if said and sink is None:
            with refused(ErrorCode.UNREACHABLE, "has ended, or died"):
                open_source(address)
            sink = RingSink(address, HELLO)
        if getattr(source, "returns", 0) and sink is not None and len(edges) == 1:
            sink.send(numbered(6))
            edges.append(0)
            sink.close()
    source.close()
    assert edges == [5, 0, 6]
    assert "its writer has not answered for 0.6 s" in said[0]
    assert "is back" in said[1]
    assert [t for packet in once.packets() for t in packet.triggers.tolist()] == [5]
    assert getattr(once, "problem", None) == "its writer has not answered for 0.6 s"
    once.close()


def test_a_command_records_a_ring_and_leaves_it(address: str, tmp_path: Path) -> None:
    """Python's tracker of resources would remove the ring at the end of the command."""
    out = tmp_path / "copy.h5"
    command = [
        sys.executable,
        "-m",
        "amiwarp",
        "record",
        address,
        str(out),
        "--json",
        "--seconds",
        "1",
    ]
    with RingSink(address, HELLO, slots=16_384, slot_bytes=2048) as sink:  # also on a busy machine
        record = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        sent = 0
        while record.poll() is None:
            sink.send(encode_encoder(np.array([sent]), np.array([0.1 * sent])))
            sink.send(encode_events(make(100, sent)))
            sent += 100
            time.sleep(0.001)
        text, errors = record.communicate()
        assert record.returncode == 0, errors
        assert errors == ""
        RingReceiver(address).close()
    said = json.loads(text)
    events = open_recording(out).events
    got = events[: len(events)]
    assert len(got) == said["events"] > 0
    assert said["lost_packets"] == 0
    np.testing.assert_array_equal(got.t, np.arange(got.t[0], got.t[0] + len(got)))


def program(language: str, folder: Path) -> list[str]:
    """Return the command of a reader, after compiling it."""
    if language == "py":
        return [sys.executable, str(READERS / "reader.py")]
    compilers = {
        "c": ["gcc", "-O2", "-Wall", "-Wextra", "-Werror"],
        "rs": ["rustc", "-O", "--edition", "2021"],
    }
    command = compilers[language]
    if shutil.which(command[0]) is None:
        pytest.skip(f"{command[0]} is not installed")
    binary = folder / "reader"
    source = READERS / f"reader.{language}"
    last = ["-lrt"] if language == "c" and sys.platform == "linux" else []
    done = subprocess.run(
        [*command, str(source), "-o", str(binary), *last],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return [str(binary)]


@needs_dev_shm
@pytest.mark.parametrize("language", ["c", "rs", "py"])
def test_readers_in_other_languages(language: str, address: str, tmp_path: Path) -> None:
    """They count all events, count what is overwritten while they are stopped, and end with the stream."""
    command = [*program(language, tmp_path), address.removeprefix("shm:")]
    with RingSink(address, HELLO, slots=64, slot_bytes=1024) as sink:
        reader = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert reader.stdout is not None
        assert reader.stdout.readline() == "reading\n"
        for k in range(20):
            sink.send(encode_events(make(50, 50 * k)))
            time.sleep(0.001)
        time.sleep(0.1)  # it has read all
        reader.send_signal(signal.SIGSTOP)
        for k in range(100):
            sink.send(encode_events(make(50, 50 * k)))
        # A packet of which a byte is wrong is read again until it fits
        memory = memory_of(address)
        at = struct.unpack_from("<I", memory, 20)[0] + 119 % 64 * 1024 + 16 + 20
        memory[at] ^= 1
        reader.send_signal(signal.SIGCONT)
        time.sleep(0.2)
        memory[at] ^= 1
        time.sleep(0.05)
    text, errors = reader.communicate(timeout=LONG_S)
    assert (text, errors) == (f"{20 * 50 + 32 * 50} events, 68 packets lost\n", "")
    assert reader.returncode == 0


@needs_dev_shm
def test_a_reader_without_amiwarp_refuses_other_memory(address: str) -> None:
    path = Path("/dev/shm", address.removeprefix("shm:"))
    path.write_bytes(bytes(4096))
    done = subprocess.run(
        [sys.executable, str(READERS / "reader.py"), path.name],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("this is no ring of version 1\n", "")
    assert path.exists()
