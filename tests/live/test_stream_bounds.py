"""Memory of live streams: every queue is bounded in bytes, whatever a sender sends, and every wait can be ended."""

from __future__ import annotations

import itertools
import os
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Compensated,
    Compensator,
    Encoder,
    EncoderStream,
    Events,
    EventSource,
    Packet,
    Policy,
)
from amiwarp.events.recording import held_bytes
from amiwarp.live import PacketQueue
from amiwarp.live.background_worker import BackgroundWorker
from amiwarp.live.link import (
    Controller,
    EmulatedFault,
    LinkUpdate,
    Motor,
    Played,
    PseudoTerminal,
    emulator,
)
from amiwarp.live.link.pseudo_terminal import RETRY_S
from amiwarp.live.link.rotors import MOST_SEGMENTS
from amiwarp.live.stream import (
    EmulatedCamera,
    PhaseCheck,
    PipeSink,
    RecentEvents,
    Session,
    SocketSink,
    SpeedController,
    SpeedKeeper,
    encode_events,
    encode_hello,
    make_packet,
    phase_check,
    recent_events,
)
from amiwarp.live.stream import adaptive as speed_module
from amiwarp.live.stream.coverage import prism_orbit
from amiwarp.live.stream.sinks import MOST_CLIENTS, PACKET_OVERHEAD, REST_S
from tests.live.test_session import KNOWN, MODEL, Made, points, world
from tests.rig_world import World

MOST = 1 << 20
"""Bound of the queues here [bytes]."""
HELLO = encode_hello(64, 48)
LONG_S = 120.0


def samples(k: int, n: int = 500) -> Packet:
    """The k-th packet of encoder samples alone."""
    t = np.arange(k * n, (k + 1) * n, dtype=np.int64)
    return make_packet(0, encoder_t=t, encoder_angle=t * 1e-5)


def pulses(k: int, n: int = 500) -> Packet:
    """The k-th packet of triggers alone."""
    return make_packet(0, triggers=np.arange(k * n, (k + 1) * n, dtype=np.int64))


def single(k: int) -> Packet:
    """The k-th packet of one event."""
    return make_packet(0, events(1, k))


def events(n: int, t: int) -> Events:
    return Events(
        np.ones(n, np.uint16), np.ones(n, np.uint16), np.full(n, t, np.int64), np.zeros(n, np.uint8)
    )


def reached(what: Callable[[], bool]) -> None:
    until = time.monotonic() + LONG_S
    while not what():
        assert time.monotonic() < until
        time.sleep(0.005)


@pytest.mark.parametrize("policy", list(Policy))
@pytest.mark.parametrize("make", [samples, pulses])
def test_a_queue_bounds_packets_without_events(
    policy: Policy, make: Callable[[int], Packet]
) -> None:
    """Nothing of them is dropped: the source waits."""
    queue, count, most = PacketQueue(10, policy, MOST), 1000, []

    def feed() -> None:
        for k in range(count):
            queue.put(make(k))
            most.append(queue.held_bytes)
        queue.close()

    thread = threading.Thread(target=feed, daemon=True)
    thread.start()
    reached(lambda: queue.held_bytes > 0.98 * MOST)
    assert len(most) < 500
    got: list[Packet] = []
    while not queue.ended:
        given = queue.get(LONG_S)
        if given is not None:
            got.append(given)
    thread.join(LONG_S)
    assert 0.98 * MOST < max(most) <= MOST
    assert (queue.held_bytes, queue.dropped) == (0, 0)
    every = np.concatenate([np.concatenate([given.encoder_t, given.triggers]) for given in got])
    np.testing.assert_array_equal(every, np.arange(500 * count))


@pytest.mark.parametrize("policy", [Policy.DROP_OLDEST, Policy.THIN])
def test_a_queue_bounds_packets_of_one_event(policy: Policy) -> None:
    """Which take far more memory than their event."""
    queue = PacketQueue(1 << 23, policy, MOST)
    for k in range(5000):
        queue.put(single(k))
        assert queue.held_bytes <= MOST
    held = queue.held
    assert 500 < held < 1100
    assert queue.dropped == 5000 - held
    if policy is Policy.DROP_OLDEST:
        first = queue.get(0.0)
        assert first is not None
        assert first.events.t[0] == 5000 - held


def test_dropped_events_leave_their_samples_in_order() -> None:
    queue = PacketQueue(10, Policy.DROP_OLDEST)
    for k in range(100):
        queue.put(samples(k, 3))
        queue.put(make_packet(0, events(10, k), triggers=np.array([k])))
    assert queue.dropped == 990
    queue.close()
    got: list[Packet] = []
    while (given := queue.get(0.0)) is not None:
        got.append(given)
    assert queue.held_bytes == 0
    np.testing.assert_array_equal(
        np.concatenate([given.encoder_t for given in got]), np.arange(300)
    )
    np.testing.assert_array_equal(np.concatenate([given.triggers for given in got]), np.arange(100))


class Slow:
    """A taker that lets nothing through until it is released."""

    def __init__(self) -> None:
        self.go, self.samples, self.jobs = threading.Event(), 0, 0

    def append(self, events: Events) -> None:
        self.jobs += 1

    def append_encoder(
        self, t_us: np.ndarray, angle: np.ndarray, index_t_us: np.ndarray, *, second: bool
    ) -> None:
        assert self.go.wait(LONG_S)
        self.samples += len(t_us)

    def tick(self) -> None:
        assert self.go.wait(LONG_S)


class Flood(Made):
    """A source of packets made as they are fetched; counts them."""

    def __init__(self, make: Callable[[int], Packet], count: int) -> None:
        super().__init__([])
        self._make, self._count, self.given = make, count, 0

    def packets(self) -> Iterator[Packet]:
        for k in range(self._count):
            self.given += 1
            yield self._make(k)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions whose queues are small."""
    monkeypatch.setattr(
        "amiwarp.live.stream.consumers.BackgroundWorker", partial(BackgroundWorker, MOST)
    )
    monkeypatch.setattr(
        "amiwarp.live.stream.session.PacketQueue", partial(PacketQueue, most_bytes=MOST)
    )


@pytest.mark.usefixtures("small")
def test_a_session_bounds_encoder_samples_without_events() -> None:
    """Of 24 MB one MiB waits in the queue and one before the file, which takes nothing for a while."""
    taker, source, stop = Slow(), Flood(samples, 3000), threading.Event()
    session = Session(source, raw=[taker])
    thread = threading.Thread(target=session.run, args=(stop, lambda _: None), daemon=True)
    thread.start()
    reached(lambda: session._queue.held_bytes > 0.98 * MOST)
    for _ in range(50):  # it stays there
        time.sleep(0.002)
        assert session._queue.held_bytes <= MOST
        assert session._consumers.raw[0][1].held_bytes <= MOST
    assert source.given * samples(0).held_bytes < 2.1 * MOST
    taker.go.set()
    thread.join(LONG_S)
    assert not thread.is_alive()
    assert taker.samples == 3000 * 500


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("make", [samples, pulses])
def test_a_flood_without_events_ends_when_it_is_told(make: Callable[[int], Packet]) -> None:
    """A queue that never gets empty does not keep a session from looking whether it is to stop."""
    source, stop = Flood(make, 1 << 40), threading.Event()

    def report(_: object) -> None:
        if source.given > 2000:
            stop.set()

    Session(source, raw=[RecentEvents(source)]).run(stop, report, every_s=0.0)
    assert source.given > 2000
    assert source.closed


@pytest.mark.usefixtures("small")
def test_a_second_interrupt_drops_what_waits() -> None:
    """The job at work is waited for, so that its file can be finished; the others are not."""
    jobs: list[int] = []

    class Counting(Slow):
        def append_encoder(
            self, t_us: np.ndarray, angle: np.ndarray, index_t_us: np.ndarray, *, second: bool
        ) -> None:
            jobs.append(len(t_us))
            time.sleep(0.005)

    def interrupt(_: object) -> None:
        if jobs:
            raise KeyboardInterrupt

    taker = Counting()
    taker.go.set()
    session = Session(Flood(samples, 1 << 40), raw=[taker])
    with pytest.raises(KeyboardInterrupt):
        session.run(threading.Event(), interrupt, every_s=0.0)
    done = len(jobs)
    time.sleep(0.2)
    assert len(jobs) == done  # nothing runs on while the file is finished


def test_jobs_without_events_count_for_their_memory() -> None:
    beside, go = BackgroundWorker(16_384), threading.Event()
    thread = threading.Thread(
        target=lambda: [beside.put(lambda: go.wait(LONG_S)) for _ in range(100)], daemon=True
    )
    thread.start()
    reached(lambda: beside.held_bytes == 16_384)
    time.sleep(0.05)
    assert beside.held_bytes == 16_384
    go.set()
    thread.join(LONG_S)
    beside.close()
    assert beside.held_bytes == 0


def test_a_compensator_bounds_packets_of_one_event() -> None:
    """Without an encoder they wait, but no more of them than the bound."""
    compensator = Compensator(
        MODEL, EncoderStream(), wait_us=10**9, start_us=10**9, most_bytes=MOST
    )
    out = 0
    for k in range(2000):
        compensator.put(events(1, k), 0)
        out += sum(len(given.flags) for given in compensator.take(0))
        assert compensator.waiting_bytes <= MOST
    assert out + compensator.waiting == 2000
    assert compensator.waiting_bytes == compensator.waiting * held_bytes(events(1, 0))


def test_the_last_seconds_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recent_events, "MOST_BYTES", MOST)
    ring = RecentEvents(Made([]))
    for k in range(2000):
        ring.append(events(1, 7))
        ring.append_encoder(np.array([k]), np.array([0.1 * k]))
        assert max(ring.event_bytes, ring.sample_bytes) <= MOST
    assert min(ring.event_bytes, ring.sample_bytes) > 0.98 * MOST


def test_what_the_watch_remembers_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(phase_check, "MOST_CHECK_BYTES", MOST)
    watch = PhaseCheck(KNOWN, 1.0, print)
    for k in range(3000):
        watch.put(events(1, k))
        assert watch.held_bytes <= MOST + 2 * held_bytes(events(1, 0))


def test_a_window_that_never_ends_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Events whose time does not go on."""
    monkeypatch.setattr(speed_module, "MOST_BYTES", MOST)
    keeper = SpeedKeeper(MODEL, SpeedController(prism_orbit(MODEL)), lambda *_: None, print)
    encoder = EncoderStream()
    turning = Encoder.constant_speed(720.0, 0, 100_000)
    encoder.append(turning.t, turning.angle)
    for _ in range(3000):
        keeper.put([Compensated(events(1, 50_000), np.zeros(1, np.uint8))], encoder)
        assert keeper.held_bytes <= MOST


def test_samples_that_wait_for_the_cameras_clock_are_bounded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A controller that sends without end while the camera sends nothing."""
    monkeypatch.setattr("amiwarp.live.stream.encoder_feed.MOST_WAITING", 1000)
    said: list[str] = []

    class Sending:
        polls = 0

        def poll(self) -> LinkUpdate:
            self.polls += 1
            t = np.arange(100 * self.polls, 100 * (self.polls + 1), dtype=np.int64)
            return LinkUpdate(
                t_us=t, angle=t * 1e-5, index_t_us=t[:1], sync=(), restarted=False, messages=()
            )

        def clock(self) -> None:
            return None

    class Silent(Flood):
        def packets(self) -> Iterator[Packet]:
            while controller.polls < 50:
                yield make_packet(0)

    controller = Sending()
    session = Session(Silent(samples, 0), link=controller, say=said.append)  # type: ignore[arg-type]
    session.run(threading.Event(), lambda _: None)
    assert controller.polls >= 50
    feed = session._feed
    assert feed._waiting_samples == sum(
        len(update.t_us) + len(update.index_t_us) for update in feed._waiting
    )
    assert 900 <= feed._waiting_samples <= 1000
    # On a slow machine it also says that events wait.
    waits = "the clocks of controller and camera are not known yet"
    dropped = [message for message in said if not message.startswith(waits)]
    assert len(dropped) == 1
    assert "clock is not known yet: dropping the oldest encoder samples" in dropped[0]


def test_a_motor_remembers_a_bounded_past() -> None:
    """However often its speed is set."""
    motor = Motor(720.0)
    for k in range(5000):
        motor.set_speed(700.0 + k % 40, 500.0, 1000 * k)
    assert len(motor._segments) <= MOST_SEGMENTS + 2
    assert motor.target_rpm(5_000_000) == 700.0 + 4999 % 40


def test_an_emulator_that_was_suspended_sends_a_bounded_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(emulator, "MOST_OUT_BYTES", 100_000)
    assert 100_000 <= len(Controller(Motor(720.0)).advance(20_000_000)) < 101_000


def test_an_emulated_port_comes_back_after_a_lack_of_descriptors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its thread lives on, and waits in between."""
    openpty, failed = os.openpty, []

    def exhausted() -> tuple[int, int]:
        if len(failed) < 3:
            failed.append(time.monotonic())
            raise OSError(24, "Too many open files")
        return openpty()

    controller = Controller(Motor(720.0), faults=[EmulatedFault.parse("unplug@0.1+0.1")])
    with PseudoTerminal(controller, tmp_path / "prism", now_us=World().step):
        monkeypatch.setattr(os, "openpty", exhausted)
        reached(lambda: len(failed) == 3)
        reached(lambda: (tmp_path / "prism").exists())
    assert min(np.diff(failed)) >= RETRY_S


def test_a_recording_that_cannot_be_read_ends_its_emulated_camera(tmp_path: Path) -> None:
    """With the error, not with a thread that is gone while others wait for it."""
    recording = points(2000, 0.2)
    assert recording.encoder is not None

    def broken(**_: object) -> Iterator[Events]:
        yield recording.events.slice(0, 10)
        raise AmiwarpError("recording.h5: damaged")

    rotor = Played(recording.encoder)
    events = type(
        "Damaged",
        (EventSource,),
        {"size": (64, 48), "blocks": staticmethod(broken), "__len__": lambda _: 2000},
    )()
    played = replace(recording, events=events)
    camera = EmulatedCamera(played, rotor, Controller(rotor), f"unix:{tmp_path}/c", world())
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(f"{tmp_path}/c")
        assert camera.done.wait(LONG_S)
    with pytest.raises(AmiwarpError, match=r"recording\.h5: damaged"):
        camera.close()


def test_a_client_that_reads_nothing_is_bounded(tmp_path: Path) -> None:
    """Small packets count for the memory that they take."""
    most = 1 << 16
    with (
        SocketSink(f"unix:{tmp_path}/s", HELLO, most_bytes=most) as sink,
        socket.socket(socket.AF_UNIX) as client,
    ):
        client.connect(f"{tmp_path}/s")
        for _ in range(20_000):
            sink.send(bytes(40))
            assert sink.waiting <= most + 40 + PACKET_OVERHEAD
        assert sink.clients == 1
        assert sink.lost > 1000
        sink._clients[0].waiting.clear()  # no parting


def test_each_lost_packet_of_a_large_block_is_counted(tmp_path: Path) -> None:
    events = Events.from_arrays(*np.zeros((4, 600_000), np.int64))
    block = encode_events(events)  # three packets
    with (
        SocketSink(f"unix:{tmp_path}/s", HELLO, most_bytes=1) as sink,
        socket.socket(socket.AF_UNIX) as client,
    ):
        client.connect(f"{tmp_path}/s")
        sink.tick()
        sink.send(block)
        assert sink.lost == 0
        sink.send(block)
        assert sink.lost == 3
        sink.send(encode_events(events[:5]))
        assert sink.lost == 4
        sink._clients[0].waiting.clear()  # no parting


def test_a_closed_file_is_named(tmp_path: Path) -> None:
    file = (tmp_path / "out").open("wb")
    sink = PipeSink(HELLO, file, name="out")
    file.close()
    with pytest.raises(AmiwarpError, match="out: the file is closed; open it again"):
        sink.send(b"more")


def test_no_more_clients_than_there_is_memory_for(tmp_path: Path) -> None:
    """One that has left makes room for another."""
    said: list[str] = []
    with SocketSink(f"unix:{tmp_path}/s", HELLO, say=said.append) as sink:
        clients = [socket.socket(socket.AF_UNIX) for _ in range(MOST_CLIENTS + 2)]
        try:
            for client in clients:
                client.connect(f"{tmp_path}/s")
                sink.tick()
            assert sink.clients == MOST_CLIENTS
            assert clients[-1].recv(10) == b""
            assert len(said) == 1
            assert f"{MOST_CLIENTS} receivers are connected" in said[0]
            clients[3].close()
            with socket.socket(socket.AF_UNIX) as late:
                late.connect(f"{tmp_path}/s")
                sink.tick()
                assert late.recv(4) == HELLO[:4]
        finally:
            for client in clients:
                client.close()


def test_a_sink_lives_through_a_lack_of_descriptors(tmp_path: Path) -> None:
    """It says so once, and accepts whoever waited as soon as it can."""
    said: list[str] = []
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with (
        SocketSink(f"unix:{tmp_path}/s", HELLO, say=said.append) as sink,
        socket.socket(socket.AF_UNIX) as client,
    ):
        client.connect(f"{tmp_path}/s")
        taken: list[int] = []
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (256, limits[1]))
            with pytest.raises(OSError, match="Too many open files"):
                taken.extend(os.open(os.devnull, os.O_RDONLY) for _ in itertools.count())
            for _ in range(1000):
                sink.send(bytes(10))
            assert sink.clients == 0
        finally:
            for descriptor in taken:
                os.close(descriptor)
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        assert len(said) == 1
        assert "cannot accept a connection: Too many open files; trying again" in said[0]
        reached(lambda: sink.tick() or sink.clients == 1)
        assert client.recv(4) == HELLO[:4]


def test_a_sink_pauses_after_a_lack_of_descriptors(tmp_path: Path) -> None:
    """Rather than trying with every packet."""

    class Exhausted:
        tried = 0

        def accept(self) -> None:
            self.tried += 1
            raise OSError(24, "Too many open files")

    with SocketSink(f"unix:{tmp_path}/s", HELLO) as sink:
        server, exhausted = sink._server, Exhausted()
        began = time.monotonic()
        sink._server = exhausted  # type: ignore[assignment]
        for _ in range(5000):
            sink.tick()
        assert 1 <= exhausted.tried <= 1 + (time.monotonic() - began) / REST_S
        sink._server = server


def test_a_pipe_whose_reader_takes_nothing_can_be_ended() -> None:
    reading, writing = os.pipe()
    stop = threading.Event()
    with open(reading, "rb"), open(writing, "wb", buffering=0) as file:
        sink = PipeSink(HELLO, file, stop=stop)
        raised: list[BaseException] = []

        def send() -> None:
            try:
                sink.send(bytes(1 << 20))
            except AmiwarpError as error:
                raised.append(error)

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        thread.join(0.2)
        assert thread.is_alive()  # until then it waits
        stop.set()
        thread.join(LONG_S)
        assert not thread.is_alive()
        assert "its reader accepts no more data" in str(raised[0])


def test_descriptors_above_a_thousand_can_be_waited_for() -> None:
    from amiwarp.live.stream.sockets import ready

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    ours, theirs = socket.socketpair()
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(2048, hard)), hard))
        os.dup2(ours.fileno(), 1500)
        assert not ready(1500, 0.0)
        theirs.send(b"x")
        assert ready(1500, LONG_S)
        assert ready(1500, LONG_S, to_write=True)
        os.close(1500)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        ours.close()
        theirs.close()
