"""The firmware's core, compiled for this computer: protocol, encoders, speed control, faults. Skipped without gcc."""

import contextlib
import ctypes
import importlib.util
import itertools
import json
import math
import os
import random
import re
import shutil
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import pytest
from cobs import cobs

from amiwarp import AmiwarpError
from amiwarp.live import commands as rig
from amiwarp.live.link import (
    Answer,
    ControllerStatus,
    Follower,
    FrameDecoder,
    Index,
    Link,
    LinkUpdate,
    Message,
    Ping,
    Pong,
    PseudoTerminal,
    Samples,
    SetCounts,
    SetSpeed,
    Stop,
    Sync,
    check_controller,
    encode,
    protocol,
)
from amiwarp.live.link import link as link_module
from amiwarp.live.link.clocks import WRAP
from tests import ROOT
from tests.live.test_conformance import VirtualWire, motor
from tests.rig_world import LONG_S, Wire, World

FIRMWARE = Path(os.environ.get("AMIWARP_FIRMWARE", ROOT / "firmware"))
"""The firmware; ``firmware/planted.py`` gives a copy with a fault."""
pytestmark = [
    pytest.mark.skipif(
        not FIRMWARE.is_dir(), reason="the firmware is not in this copy of the project"
    ),
    pytest.mark.skipif(
        shutil.which("gcc") is None or shutil.which("make") is None, reason="needs gcc and make"
    ),
]
S = 1_000_000
COUNT = math.tau / 4096
T = TypeVar("T")
FAULT = {name: 1 << bit for bit, name in enumerate(protocol.FAULTS)}


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"firmware_{name}", FIRMWARE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def built(folder: Path, *targets: str) -> Path:
    """Build targets for this computer in a folder of their own, and return it."""
    make = (
        "make",
        "-s",
        "-C",
        str(FIRMWARE),
        f"BUILD={folder}",
        "CC=gcc",
        *(f"{folder}/{name}" for name in targets),
    )
    done = subprocess.run(make, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the library and the fuzzer."""
    return built(tmp_path_factory.mktemp("firmware"), "libboard.so", "fuzz")


@pytest.fixture
def board(build: Path) -> Callable[..., Any]:
    make: Callable[..., Any] = load("boards").NativeBoard
    return lambda **settings: make(library=build / "libboard.so", **settings)


class Host:
    """A host that talks to a board in simulated time and keeps the messages."""

    def __init__(self, board: Any, damage: Callable[[bytes], bytes] = bytes) -> None:
        self.board, self.decoder, self.damage = board, FrameDecoder(), damage
        self.messages: list[Message] = []
        self._sequence = itertools.count()

    def send(self, message: Message) -> int:
        number = next(self._sequence) % (1 << 16)
        self.board.feed(self.damage(encode(message, number)), self.board.now)
        return number

    def run(self, seconds: float, step_us: int = 5000) -> list[Message]:
        """Advance, with ten pings per second, and return the new messages."""
        end, before = self.board.now + round(seconds * S), len(self.messages)
        while self.board.now < end:
            now = min(self.board.now + step_us, end)
            self.messages += [m for _, m in self.decoder.feed(self.damage(self.board.advance(now)))]
            if now % 100_000 < step_us:
                self.send(Ping(now))
        return self.messages[before:]

    def command(self, message: Message) -> int | None:
        """Send a command; return the reason of its refusal, or None without an answer."""
        number = self.send(message)
        return next(
            (m.refused for m in self.run(0.05) if isinstance(m, Answer) and m.sequence == number),
            None,
        )

    def run_until(self, true: Callable[[], bool], seconds: float) -> None:
        """Advance until the condition is true, for at most ``seconds``."""
        end = self.board.now + seconds * S
        while not true():
            assert self.board.now < end
            self.run(0.02)

    @property
    def status(self) -> ControllerStatus:
        return next(m for m in reversed(self.messages) if isinstance(m, ControllerStatus))


def of(kind: type[T], messages: list[Message]) -> list[T]:
    return [m for m in messages if isinstance(m, kind)]


# One description of the protocol, and the same bytes.


def test_the_header_is_that_of_the_python_protocol() -> None:
    generate = load("generate")
    assert generate.HEADER.read_text() == generate.described()


def test_the_figure_of_the_wires_shows_each_pin() -> None:
    table = re.findall(
        r"#define PIN_(\w+) +(\d+)", (FIRMWARE / "pins.h").read_text(encoding="utf-8")
    )
    figure = (ROOT / "docs/images/rig_wiring.svg").read_text(encoding="utf-8")
    page = (ROOT / "docs/how-to/build-a-rig.md").read_text(encoding="utf-8")
    assert len(table) > 15
    for name, number in table:
        assert re.search(rf"GPIO{number}\b", figure), name
        assert re.search(rf"^\| [^|]*\b(GPIO)?{number}\b", page, re.MULTILINE), name


def test_frames_have_the_bytes_of_the_documentation(board: Callable[..., Any]) -> None:
    library, rng = board().library, random.Random(0)
    packets = [bytes.fromhex("010202010102 0304FFFFFFFF".replace(" ", ""))]
    packets += [
        bytes(rng.choice((0, rng.randrange(256), 7)) for _ in range(n))
        for n in (0, 1, 30, 250, 264)
    ]
    packets += [
        bytes(range(1, 256)) * 2,
        *(bytes(n) for n in (1, 253, 254)),
        *(b"\1" * n for n in range(245, 260)),
    ]
    for packet in packets:
        held = ctypes.create_string_buffer(packet, len(packet) + 4)
        frame, size = ctypes.create_string_buffer(700), ctypes.c_uint32()
        library.board_frame(held, len(packet), frame, ctypes.byref(size))
        assert (
            frame.raw[: size.value]
            == cobs.encode(packet + zlib.crc32(packet).to_bytes(4, "little")) + b"\0"
        )


def test_numbers_on_the_line_are_rounded_to_fixed_point(board: Callable[..., Any]) -> None:
    library, rng = board().library, np.random.default_rng(1)
    q16 = ctypes.c_int32()
    values = np.concatenate(
        [rng.uniform(-32000, 32000, 300), 10.0 ** rng.uniform(-9, 4, 300), [0.0, -0.0, 720, 1 / 3]]
    )
    for value in values.astype(np.float32):
        assert library.board_q16(int(value.view(np.uint32)), ctypes.byref(q16))
        assert abs(q16.value - float(value) * 65536) <= 0.5
        back = np.uint32(library.board_f32(q16.value) & 0xFFFFFFFF).view(np.float32)
        assert back == pytest.approx(q16.value / 65536, rel=2**-22, abs=0)
    for value in np.array([np.nan, np.inf, -np.inf, 32768, -1e30], np.float32):
        assert not library.board_q16(int(value.view(np.uint32)), ctypes.byref(q16))


def test_every_step_of_the_encoders(board: Callable[..., Any]) -> None:
    library = board().library
    cycle = [0b00, 0b10, 0b11, 0b01]  # 2 A + B, A leads
    for old, new in itertools.product(range(4), repeat=2):
        step = (cycle.index(new) - cycle.index(old)) % 4
        assert library.board_step(old << 2 | new) == {0: 0, 1: 1, 2: 2, 3: -1}[step]
    for frame in range(0, 1 << 16, 7):
        valid = frame.bit_count() % 2 == 0 and not frame & 0x4000
        assert library.board_angle(frame) == (frame & 0x3FFF if valid else -1)


# Speed, angles and pulses.


@pytest.mark.parametrize(
    ("rpm", "magnetic"), [(720.0, False), (-240.0, False), (1440.0, True), (-60.0, True)]
)
def test_the_motor_follows_its_ramp_and_stops(
    board: Callable[..., Any], rpm: float, magnetic: bool
) -> None:
    host = Host(board(magnetic=magnetic))
    host.run(0.2)
    assert (host.status.state, host.status.rpm) == (0, pytest.approx(0.0, abs=2.0))
    assert host.command(SetSpeed(rpm, abs(rpm))) == 0
    measured = []
    for k in range(1, 9):
        host.run(0.1)
        measured.append(host.board.get("rpm") - rpm * (0.05 + 0.1 * k))
    assert np.abs(measured).max() < 0.05 * abs(rpm) + 10.0
    host.run(1.0)
    turned = -host.board.get("angle")
    host.run(4.0)
    turned += host.board.get("angle")
    assert turned / math.tau * 15.0 == pytest.approx(rpm, rel=0.005)
    assert (host.status.state, host.status.target_rpm, host.status.faults) == (1, rpm, 0)
    assert host.command(Stop()) == 0
    host.run(1.5)
    assert (host.status.state, host.status.target_rpm) == (0, 0.0)
    assert host.board.get("rpm") == pytest.approx(0.0, abs=2.0)
    assert host.decoder.received == protocol.FrameCounters(frames=host.decoder.received.frames)


GEARED = 32768
"""Counts per turn of a prism whose magnetic encoder turns twice as fast."""


@pytest.mark.parametrize(
    ("rpm", "magnetic", "counts"),
    [
        (720.0, False, 4096), (-720.0, False, 4096), (300.0, True, 16384),
        (720.0, True, GEARED), (-300.0, True, GEARED), (300.0, True, 24576),
    ],
)  # fmt: skip
def test_angles_on_the_host_are_those_of_the_shaft(
    board: Callable[..., Any], rpm: float, magnetic: bool, counts: int
) -> None:
    """The clock and the counts wrap on the way."""
    turning = board(
        magnetic=magnetic, counts_per_turn=counts, clock_start=WRAP - 2.2 * S, drift_ppm=80.0
    )
    host, follower = Host(turning), Follower("port")
    if not magnetic:
        turning.library.board_tamper(
            turning._board, (1 << 31) - 50_000 if rpm > 0 else 50_000 - (1 << 31)
        )
    host.command(SetSpeed(rpm, 2000.0))
    host.run(0.5)
    follower.opened(0)
    times, angles, truth = [], [], {}
    for _ in range(300):
        data = turning.advance(turning.now + 5000)
        truth[turning.now] = turning.get("angle")
        follower.feed(data, turning.now + 400)
        host.send(Ping(0))
        update = follower.take()
        assert not update.messages
        times.extend(update.t_us)
        angles.extend(update.angle)
    start = WRAP - 2.2 * S
    on_clock = [start + t * (1 + 80e-6) for t in truth]
    error = np.interp(times, on_clock, list(truth.values())) - angles
    error = (error + math.pi) % math.tau - math.pi
    inside = slice(10, -10)
    assert len(times) > 1300
    # eccentricity of the disc, noise of the magnetic encoder, and a linear interpolation over 5 ms
    assert np.abs(error[inside] - error[inside].mean()).max() < 0.015
    assert abs(error[inside].mean()) < 2 * COUNT


def test_index_pulses_are_latched_within_two_microseconds(board: Callable[..., Any]) -> None:
    host = Host(board())
    host.command(SetSpeed(1440.0, 5000.0))
    host.run(1.0)
    pulses = of(Index, host.run(2.0))
    assert {b.count - a.count for a, b in itertools.pairwise(pulses)} == {4096}
    assert 0 < host.board.get("late_us") <= 2.0
    assert math.gcd(*(b.t_us - a.t_us for a, b in itertools.pairwise(pulses))) == 1


@pytest.mark.parametrize("pulses", [0, 1, 2])
def test_pulses_of_the_camera_are_numbered_and_timed(
    board: Callable[..., Any], pulses: int
) -> None:
    host = Host(board(pulses=pulses))
    host.command(SetSpeed(600.0, 5000.0))
    host.run(1.0)
    sent = []
    got: list[Message] = []
    for _ in range(20):
        if pulses == 2:
            host.board.pulse()
            sent.append(host.board.now)
        got += host.run(0.1)
    syncs = of(Sync, got)
    assert [m.number - syncs[0].number for m in syncs] == list(range(len(syncs)))
    if pulses == 0:
        intervals = [b.t_us - a.t_us for a, b in itertools.pairwise(syncs)]
        assert set(intervals) <= set(range(70_000, 131_000, 1000))
        assert len(set(intervals)) > 8
    elif pulses == 1:
        assert [m.t_us for m in syncs] == [m.t_us for m in of(Index, got)]
    else:
        assert [m.t_us for m in syncs] == sent
    assert len(syncs) == pytest.approx(20, abs=1 if pulses else 3)


def test_intervals_between_pulses_differ_after_each_reset(board: Callable[..., Any]) -> None:
    """By the time of the host's last message, so that pulses before and after a reset are not taken for one another."""
    found = []
    for wait_s in (0.0503, 0.0507):
        host = Host(board())
        host.run(wait_s)
        host.command(SetSpeed(600.0, 5000.0))
        times = [m.t_us for m in of(Sync, host.run(2.0))]
        found.append([b - a for a, b in itertools.pairwise(times)])
    assert found[0][2:12] != found[1][2:12]
    # all lengths are drawn, the shortest and the longest, too
    drawn = {b.t_us - a.t_us for a, b in itertools.pairwise(of(Sync, host.run(60.0)))}
    assert min(drawn) == 70_000
    assert max(drawn) == 130_000


def test_messages_are_in_the_order_of_their_times(board: Callable[..., Any]) -> None:
    host = Host(board())
    host.command(SetSpeed(1440.0, 5000.0))
    host.run(2.0)
    last = 0
    for message in host.messages:
        for t in (
            message.t_us
            if isinstance(message, Samples)
            else [message.t_us]
            if isinstance(message, Index | Sync)
            else []
        ):
            assert t >= last
            last = t
    assert len(of(Pong, host.messages)) == 20


# Commands.


@pytest.mark.parametrize(
    ("message", "refused"),
    [
        (SetSpeed(3000.5, 100.0), 2), (SetSpeed(-1e9, 100.0), 2), (SetSpeed(math.nan, 100.0), 2),
        (SetSpeed(100.0, 0.0), 2), (SetSpeed(100.0, -1.0), 2), (SetSpeed(100.0, math.nan), 2),
        (SetSpeed(100.0, math.inf), 2), (SetSpeed(100.0, 1e6), 0), (SetSpeed(0.0, 1e-6), 0), (SetCounts(0), 2),
        (SetCounts(1 << 24), 2), (SetCounts(4096), 0), (SetCounts(1000), 0), (Stop(), 0), (Index(0, 0), 1),
    ],
)  # fmt: skip
def test_answers_to_commands(board: Callable[..., Any], message: Message, refused: int) -> None:
    host = Host(board())
    host.run(0.1)
    assert host.command(message) == refused


def test_counts_are_not_changed_while_the_prism_turns(board: Callable[..., Any]) -> None:
    host = Host(board())
    host.command(SetSpeed(300.0, 3000.0))
    host.run(1.0)
    assert host.command(SetCounts(1000)) == 3
    assert host.status.counts_per_turn == 4096
    host.command(Stop())
    host.run(1.0)
    assert host.command(SetCounts(1000)) == 0
    assert host.status.counts_per_turn == 1000


@pytest.mark.parametrize(
    "settings",
    [
        {}, {"magnetic": True, "drift_ppm": -80.0}, {"pulses": 1, "counts_per_turn": 1000},
        {"magnetic": True, "counts_per_turn": GEARED, "pulses": 1},
    ],
)  # fmt: skip
def test_the_firmware_passes_the_conformance_suite(
    board: Callable[..., Any], settings: dict[str, Any]
) -> None:
    checks = check_controller(VirtualWire(board(**settings)), 240.0)
    assert [check.name for check in checks if not check.passed] == []


# Faults.


@pytest.mark.parametrize(
    ("switch", "fault", "magnetic"),
    [
        ("jammed", "stall", False), ("driver_fault", "over-current", False), ("dead_a", "encoder lost", False),
        ("bad_spi", "encoder lost", True), ("reversed_motor", "over-speed", False), ("runaway", "over-speed", True),
    ],
)  # fmt: skip
def test_a_fault_stops_the_motor_until_a_stop_command(
    board: Callable[..., Any], switch: str, fault: str, magnetic: bool
) -> None:
    host = Host(board(magnetic=magnetic))
    early = switch in ("reversed_motor", "jammed")
    if early:
        host.board.set(switch)
    assert host.command(SetSpeed(720.0, 1000.0)) == 0
    host.run(0.0 if early else 2.0)
    assert (host.status.state, host.status.faults) == (2 if early else 1, 0)
    host.board.set(switch)
    host.run(3.0)
    assert host.status.faults == FAULT[fault]
    assert (host.status.state, host.status.target_rpm) == (3, 0.0)
    assert host.command(SetSpeed(100.0, 100.0)) == 3
    host.board.set(switch, 0)
    host.run(16.0)
    assert host.board.get("rpm") == pytest.approx(0.0, abs=10.0)  # released
    assert host.command(Stop()) == 0
    host.run(0.5)
    assert (host.status.state, host.status.faults) == (0, 0)
    assert host.command(SetSpeed(100.0, 1000.0)) == 0


def test_a_lost_wire_of_the_encoder_does_not_let_the_motor_run_away(
    board: Callable[..., Any],
) -> None:
    host = Host(board())
    host.command(SetSpeed(720.0, 1000.0))
    host.run(2.0)
    host.board.set("dead_a")
    fastest = 0.0
    for _ in range(150):
        host.run(0.01)
        fastest = max(fastest, host.board.get("rpm"))
    assert host.status.faults == FAULT["encoder lost"]
    assert fastest < 3000.0


def test_a_missing_index_and_a_silent_host_do_not_stop_the_motor(board: Callable[..., Any]) -> None:
    host = Host(board())
    host.command(SetSpeed(300.0, 3000.0))
    host.run(1.0)
    host.board.set("no_index")
    host.run(0.5)
    assert (host.status.state, host.status.faults) == (1, FAULT["index missed"])
    host.board.set("no_index", 0)
    host.run(0.5)
    assert host.status.faults == 0
    received = host.decoder.feed(host.board.advance(host.board.now + 4 * S))
    host.messages += [m for _, m in received]
    assert (host.status.state, host.status.target_rpm, host.status.faults) == (
        1,
        300.0,
        FAULT["host lost"],
    )
    host.run(0.2)
    assert host.status.faults == 0


def test_a_reset_stops_the_motor_and_the_host_reports_it(board: Callable[..., Any]) -> None:
    host, follower = Host(board()), Follower("port")
    follower.opened(0)

    def follow(seconds: float) -> list[str]:
        """Advance with the follower, and return its new messages."""
        for _ in range(round(seconds / 0.005)):
            follower.feed(host.board.advance(host.board.now + 5000), host.board.now + 400)
        messages: list[str] = []
        update: LinkUpdate | None = None
        while update is None or len(update.t_us) or update.messages:
            update = follower.take()
            messages += update.messages
        return messages

    host.command(SetSpeed(600.0, 3000.0))
    follow(1.0)
    host.board.reset()
    messages = follow(0.5)
    assert 400.0 < host.board.get("rpm") < 550.0  # it is not driven, not even to brake
    messages += follow(3.5)
    assert any("the controller was reset" in m for m in messages)
    assert messages.count("the motor no longer has its speed of 600 rpm; set it again") == 1
    assert follower.status is not None
    assert (follower.status.state, follower.status.target_rpm) == (0, 0.0)
    assert host.board.get("rpm") == 0.0
    host.send(SetSpeed(300.0, 3000.0))
    messages = follow(1.0)
    host.send(Stop())
    assert [m for m in messages + follow(1.0) if "no longer has its speed" in m] == []
    host.board.reset()
    assert [m for m in follow(1.0) if "no longer has its speed" in m] == []  # it rested before


@pytest.mark.parametrize("coasts_s", [0.0, 0.01, 0.014, 0.018, 0.2])
@pytest.mark.parametrize(
    ("rpm", "message"), [(700.0, Stop()), (-700.0, Stop()), (700.0, SetSpeed(-200.0, 2000.0))]
)
def test_a_prism_that_runs_down_follows_the_ramp_of_the_next_command(
    board: Callable[..., Any], rpm: float, message: Message, coasts_s: float
) -> None:
    """However soon it comes after a reset, the reference begins at the prism's speed: no full voltage brakes it."""
    host = Host(board())
    host.command(SetSpeed(rpm, 3000.0))
    host.run(1.0)
    host.board.reset()
    host.run(coasts_s, step_us=1000)
    begun, start = host.board.now, host.board.get("rpm")
    assert 500.0 < abs(start) < 710.0
    host.send(message)
    target = message.rpm if isinstance(message, SetSpeed) else 0.0
    for _ in range(100):
        host.run(0.005)
        ramped = 2000.0 * (host.board.now - begun) / S
        expected = start + math.copysign(min(ramped, abs(target - start)), target - start)
        assert host.board.get("rpm") == pytest.approx(expected, abs=100.0)
    assert host.status.faults == 0


def test_of_two_commands_just_after_a_reset_the_later_counts(board: Callable[..., Any]) -> None:
    host = Host(board())
    host.command(SetSpeed(600.0, 3000.0))
    host.run(0.5)
    host.board.reset()
    speed, stop = host.send(SetSpeed(-200.0, 3000.0)), host.send(Stop())
    host.run(1.0)
    answers = {m.sequence: m.refused for m in of(Answer, host.messages)}
    assert (answers[speed], answers[stop]) == (3, 0)
    assert (host.board.get("rpm"), host.status.state, host.status.faults) == (0.0, 0, 0)


# Damaged lines.


def test_lost_and_changed_bytes_are_counted_and_do_no_harm(board: Callable[..., Any]) -> None:
    rng = random.Random(3)

    def damage(data: bytes) -> bytes:
        changed = [
            b ^ (1 << rng.randrange(8)) if rng.random() < 0.002 else b
            for b in data
            if rng.random() > 0.003
        ]
        return bytes(changed)

    host = Host(board(), damage)
    accepted = 0
    for k in range(80):
        accepted += host.command(SetSpeed(300.0 + k, 3000.0)) is not None
        host.run(0.1)
    assert accepted > 40  # frames of 18 bytes, and their answers
    counters = host.board.counters()
    assert counters["damaged"] > 5
    assert counters["frames"] > 50
    assert host.status.faults == 0
    assert host.decoder.received.damaged > 20
    host.damage = bytes
    host.run(0.1)
    assert host.command(Stop()) == 0


def test_garbage_is_not_a_command(board: Callable[..., Any]) -> None:
    rng, host = random.Random(5), Host(board())
    host.run(0.1)
    for _ in range(100):
        host.board.feed(rng.randbytes(300), host.board.now)
        host.run(0.005)
    assert (host.status.state, host.status.target_rpm) == (0, 0.0)
    host.board.feed(b"\0", host.board.now)
    assert host.command(SetSpeed(200.0, 500.0)) == 0


def test_other_versions_and_types_are_skipped(board: Callable[..., Any]) -> None:
    host = Host(board())
    host.run(0.1)
    for packet in (b"\2\x82\0\0", b"\1\xf0\1\0" + bytes(300), b"\1\x81\2\0abc"):
        host.board.feed(
            cobs.encode(packet + zlib.crc32(packet).to_bytes(4, "little")) + b"\0", host.board.now
        )
    host.run(0.1)
    assert host.board.counters()["unknown"] == 3
    assert host.board.counters()["damaged"] == 0
    assert of(Pong, host.run(0.2))


def test_a_host_that_does_not_read_loses_whole_frames(board: Callable[..., Any]) -> None:
    host = Host(board())
    host.board._out = ctypes.create_string_buffer(40)  # a line too slow for the samples
    received = b"".join(host.board.advance(t) for t in range(0, 2 * S, 5000))
    decoder = FrameDecoder()
    decoder.feed(received)
    assert decoder.received.damaged == 0
    assert decoder.received.lost > 50


def test_fuzzed_frames_and_commands(build: Path) -> None:
    done = subprocess.run([build / "fuzz", "100000"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("100000 frames")


# Over a pseudo-terminal, with the host's own programs.


class Desk:
    """A board behind a pseudo-terminal, on a simulated clock that waits for the open link and stands still without one.

    Only the terminal's thread uses the board, see :meth:`do`. ``damage`` changes the bytes of both directions.
    """

    plugged = True

    def __init__(self, board: Any, path: Path) -> None:
        self.board = board
        self.damage: Callable[[bytes], bytes] = bytes
        self.shaft: list[tuple[int, float]] = []
        self._actions: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._running = threading.Event()
        self.world = World(self._running.is_set)
        self.terminal = PseudoTerminal(self, path, now_us=self.world.step)  # type: ignore[arg-type]

    def advance(self, now_us: int) -> bytes:
        while not self._actions.empty():
            self._actions.get()()
        if now_us <= self.board.now:
            return b""
        data = self.damage(self.board.advance(now_us))
        self.shaft.append((self.board.now, self.board.get("angle")))
        return data

    def feed(self, data: bytes, now_us: int) -> None:
        if data:
            self.board.feed(self.damage(data), now_us)

    def do(self, action: Callable[[], None]) -> None:
        """Run ``action`` in the terminal's thread."""
        self._actions.put(action)

    @contextlib.contextmanager
    def link(self, port: object = None) -> Iterator[Link]:
        with Link(self.terminal.name, host_us=self.world.now) as link:
            self.world.conditions[1:] = [Wire(link, self.terminal)]
            self._running.set()
            try:
                yield link
            finally:
                self._running.clear()


def noise(seed: int) -> Callable[[bytes], bytes]:
    rng = random.Random(seed)
    return lambda data: bytes(b ^ (rng.random() < 0.004) for b in data if rng.random() > 0.004)


def wait(true: Callable[[], object]) -> None:
    end = time.monotonic() + LONG_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.fixture(params=["board", "chip", "avr"])
def desk(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Desk]:  # the core, and the images if there are simulators
    monkeypatch.setattr(link_module, "ANSWER_S", LONG_S)
    monkeypatch.setattr(rig.motor, "WAIT_S", LONG_S)
    desk = Desk(request.getfixturevalue(request.param)(), tmp_path / "prism")
    monkeypatch.setattr(rig.motor, "Link", desk.link)
    with desk.terminal:
        yield desk


def is_at(link: Link, state: int, target_rpm: float) -> bool:
    status = link.status
    return status is not None and (status.state, status.target_rpm, status.faults) == (
        state,
        target_rpm,
        0,
    )


def test_the_link_through_damage_and_a_reset(desk: Desk) -> None:
    news: list[LinkUpdate] = []

    def said() -> str:
        news.append(link.poll())
        return "\n".join(m for n in news for m in n.messages)

    with desk.link() as link:
        link.set_speed(600.0, 2000.0)
        wait(lambda: is_at(link, 1, 600.0))
        with pytest.raises(AmiwarpError, match="out of range"):
            link.set_speed(3500.0, 100.0)
        desk.damage = noise(4)
        wait(lambda: link._follower._connection.decoder.received.damaged > 20)
        desk.damage = bytes
        sent = link._number
        # The faults of the damage are cleared
        wait(lambda: link._number > sent + 2 and is_at(link, 1, 600.0))
        said()
        assert not any(n.restarted for n in news)
        t, angle = (np.concatenate([getattr(n, name) for n in news]) for name in ("t_us", "angle"))
        assert len(t) > 300
        error = np.interp(t, *np.array(desk.shaft).T) - angle
        error = (error + math.pi) % math.tau - math.pi
        assert np.abs(error).max() < 0.02  # eccentricity of the disc, and interpolation over 4 ms
        desk.do(desk.board.reset)
        wait(lambda: "the controller was reset" in said())
        wait(lambda: link.status is not None and link.status.target_rpm == 0.0)
        link.set_speed(-300.0, 4000.0)
        wait(lambda: is_at(link, 1, -300.0))
        link.stop()
        wait(lambda: is_at(link, 0, 0.0))


def test_the_command_sets_shows_and_stops(desk: Desk) -> None:
    done = motor("set", "--rpm", -300, "--ramp-rpm-s", 5000, "--port", "prism", "--json")
    assert json.loads(done.stdout)["target_rpm"] == -300.0
    wait(lambda: "at speed" in motor("status", "--port", "prism").stdout)
    data = json.loads(motor("stop", "--port", "prism", "--json").stdout)
    assert (data["target_rpm"], data["answers"]) == (0.0, True)
    wait(lambda: "stopped" in motor("status", "--port", "prism").stdout)


# The images for the RP2040 and the ATmega2560 in simulators of the chips.


def run_make(folder: Path, *arguments: str) -> None:
    make = (
        "make",
        "-s",
        "-C",
        str(FIRMWARE),
        f"BUILD={folder}",
        f"PYTHON={sys.executable}",
        "CC=gcc",
        *arguments,
    )
    done = subprocess.run(make, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Build the image for an encoder, a source of pulses and other settings of make."""
    if shutil.which("arm-none-eabi-gcc") is None:
        pytest.skip("needs arm-none-eabi-gcc (Debian: gcc-arm-none-eabi)")
    if (
        shutil.which("node") is None
        or not (FIRMWARE / "simulator" / "node_modules" / "rp2040js").is_dir()
    ):
        pytest.skip("needs Node.js, and rp2040js: npm install --prefix firmware/simulator")
    folder = tmp_path_factory.mktemp("rp2040")

    def build(encoder: str, pulses: str, *settings: str) -> Path:
        run_make(folder, f"ENCODER={encoder}", f"PULSES={pulses}", *settings, "rp2040")
        return folder / f"prism-{encoder}-{pulses}.bin"

    return build


@pytest.fixture
def chip(images: Callable[..., Path]) -> Iterator[Callable[..., Any]]:
    """Start the simulator on an image; ``counts`` of the prism are those of the ``settings`` of make."""
    started = []

    def start(
        encoder: str = "QUADRATURE",
        pulses: str = "PULSES_TIMED",
        *settings: str,
        counts: int | None = None,
    ) -> Any:
        image, magnetic = images(encoder, pulses, *settings), encoder == "MAGNETIC"
        started.append(
            load("boards").SimulatedBoard(image, magnetic=magnetic, counts_per_turn=counts)
        )
        return started[-1]

    yield start
    for board in started:
        board.close()


def header_is_missing(compiler: tuple[str, ...], header: str) -> bool:
    make = (*compiler, "-E", "-include", header, "-x", "c", "/dev/null")
    return (
        shutil.which(compiler[0]) is None
        or subprocess.run(make, capture_output=True, check=False).returncode != 0
    )


@pytest.fixture(scope="module")
def avr(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """Start the simulator on an image for the ATmega2560."""
    if header_is_missing(("avr-gcc", "-mmcu=atmega2560"), "avr/io.h"):
        pytest.skip("needs avr-gcc (Debian: gcc-avr) and avr-libc")
    if header_is_missing(("gcc",), "simavr/sim_avr.h"):
        pytest.skip("needs simavr (Debian: libsimavr-dev)")
    folder = tmp_path_factory.mktemp("avr")

    def start(
        encoder: str = "QUADRATURE", pulses: str = "PULSES_TIMED", counts: int | None = None
    ) -> Any:
        run_make(
            folder, f"PULSES={pulses}", f"COUNTS={counts or 4096}", "avr", f"{folder}/libavr.so"
        )
        image = folder / f"prism-atmega2560-{pulses}.elf"
        return load("boards").AvrBoard(image, counts_per_turn=counts, library=folder / "libavr.so")

    return start


@pytest.fixture(params=["chip", "avr"])
def image(request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Start the simulator of each chip."""
    start: Callable[..., Any] = request.getfixturevalue(request.param)
    return start


def test_the_image_turns_stops_and_survives_damage_and_resets(image: Callable[..., Any]) -> None:
    rng, host = random.Random(1), Host(image())
    host.run(0.15)
    assert host.command(SetSpeed(400.0, 4000.0)) == 0
    host.run(0.6)
    assert (host.status.state, host.status.target_rpm, host.status.faults) == (1, 400.0, 0)
    host.damage = lambda data: bytes(b ^ (rng.random() < 0.01) for b in data if rng.random() > 0.01)
    host.run(0.2)
    host.damage = bytes
    host.run(0.05)
    damaged = host.decoder.received.damaged
    assert damaged > 0
    host.run(0.3)
    assert (host.decoder.received.damaged, host.status.target_rpm) == (damaged, 400.0)
    true = np.array(host.board.get("index_us"))
    pulses = of(Index, host.messages)
    assert len(pulses) > 4
    late = np.array([m.t_us - true[np.abs(true - m.t_us).argmin()] for m in pulses])
    assert -1.5 <= late.min() <= late.max() <= 2.0  # times are rounded down to 1 us
    sent, syncs = np.array(host.board.get("trigger_us")), of(Sync, host.messages)
    assert max(abs(m.t_us - sent[m.number]) for m in syncs) <= 2.0
    assert max(m["worst"] for m in host.board.interrupts().values()) < 600  # cycles of an interrupt
    host.board.set("driver_fault")
    host.run(0.1)
    assert (host.status.state, host.status.faults, host.status.target_rpm) == (
        3,
        FAULT["over-current"],
        0.0,
    )
    host.board.set("driver_fault", 0)
    assert host.command(Stop()) == 0
    host.board.reset()
    host.run(0.1)
    assert host.decoder.received.restarts == 1
    assert (host.status.target_rpm, host.status.faults) == (0.0, 0)


def camera_pulses(host: Host, pulses: str, number: int) -> list[float]:
    """Let time pass, with pulses of the camera if the build reads them, and return their times [us]."""
    times = []
    for _ in range(number):
        if pulses == "PULSES_CAMERA":
            times.append(host.board.now)
            host.board.set("sync")
            host.run(0.05)
            host.board.set("sync", 0)
        host.run(0.1)
    return times


@pytest.mark.parametrize("pulses", ["PULSES_TIMED", "PULSES_INDEX", "PULSES_CAMERA"])
def test_the_image_with_each_source_of_pulses_and_each_encoder(
    chip: Callable[..., Any], pulses: str
) -> None:
    magnetic = pulses == "PULSES_TIMED"
    host = Host(chip("MAGNETIC" if magnetic else "QUADRATURE", pulses))
    host.command(SetSpeed(600.0, 5000.0))
    host.run(0.4)
    edges = camera_pulses(host, pulses, 2)
    syncs = of(Sync, host.messages)
    if pulses == "PULSES_INDEX":
        assert [m.t_us for m in syncs] == [m.t_us for m in of(Index, host.messages)]
        edges = host.board.get("trigger_us")
    elif pulses == "PULSES_TIMED":
        edges = host.board.get("trigger_us")
    assert len(syncs) >= 2
    assert max(abs(m.t_us - edge) for m, edge in zip(syncs, edges, strict=True)) <= 2.0
    assert host.status.counts_per_turn == (16384 if magnetic else 4096)
    assert host.status.rpm == pytest.approx(600.0, abs=60.0)
    assert host.decoder.received.damaged == host.decoder.received.lost == 0
    if magnetic:
        host.board.set("bad_spi")
        host.run(0.05)
        assert host.status.faults == FAULT["encoder lost"]


def test_the_image_with_a_magnet_that_turns_twice_per_turn_of_the_prism(
    chip: Callable[..., Any],
) -> None:
    host = Host(chip("MAGNETIC", "PULSES_INDEX", "RATIO=2", counts=GEARED))
    assert host.command(SetSpeed(-600.0, 5000.0)) == 0
    host.run(0.8)
    pulses, edges, turned = (
        of(Index, host.messages),
        np.array(host.board.get("index_us")),
        host.board.get("angle"),
    )
    assert len(pulses) == len(edges) > 4
    assert np.abs([m.t_us - edge for m, edge in zip(pulses, edges, strict=True)]).max() <= 2.0
    # Noise
    assert np.abs([b.count - a.count + GEARED for a, b in itertools.pairwise(pulses)]).max() < 10
    last = of(Samples, host.messages)[-1]
    angle = (last.count[-1] - pulses[-1].count) / GEARED - 10e-6 * (host.board.now - last.t_us[-1])
    assert math.remainder(turned - angle * math.tau, math.tau) == pytest.approx(0.0, abs=0.02)
    assert [m.t_us for m in of(Sync, host.messages)] == [m.t_us for m in pulses]
    assert (host.status.counts_per_turn, host.status.faults) == (GEARED, 0)
    assert host.status.rpm == pytest.approx(-600.0, abs=60.0)
    host.board.set("no_index")
    host.run(0.3)
    assert host.status.faults == FAULT["index missed"]


def test_the_image_with_a_magnet_that_counts_backwards(chip: Callable[..., Any]) -> None:
    host = Host(chip("MAGNETIC", "PULSES_TIMED", "REVERSED=1"))
    host.board.set("reversed_motor")
    assert host.command(SetSpeed(400.0, 4000.0)) == 0
    host.run_until(lambda: host.status.state == 1, 1.0)
    assert (host.status.target_rpm, host.status.faults) == (400.0, 0)
    assert host.board.get("rpm") == pytest.approx(-400.0, abs=80.0)  # it overshoots


def test_settings_of_make_are_those_of_the_image(chip: Callable[..., Any]) -> None:
    host = Host(
        chip("QUADRATURE", "PULSES_TIMED", "COUNTS=2000", "RATIO=3/2", "MOST_RPM=500", counts=3000)
    )
    host.run(0.1)
    assert host.status.counts_per_turn == 3000
    assert host.command(SetSpeed(500.5, 5000.0)) == 2
    assert host.command(SetSpeed(500.0, 5000.0)) == 0
    host.run(0.5)
    pulses = of(Index, host.run(0.4))
    assert {b.count - a.count for a, b in itertools.pairwise(pulses)} == {3000}
    assert (host.status.state, host.status.faults) == (1, 0)


@pytest.mark.parametrize("coasts_s", [0.01, 0.15])
def test_the_image_catches_a_prism_that_runs_down(
    image: Callable[..., Any], coasts_s: float
) -> None:
    host = Host(image())
    host.command(SetSpeed(600.0, 5000.0))
    host.run(0.4)
    host.board.reset()
    host.run(coasts_s)
    start = host.board.get("rpm")
    assert (host.board.get("enable"), start > 450.0) == (False, True)
    host.send(Stop())
    host.run(0.1)
    # The ramp of a stop is 2000 rpm/s
    assert host.board.get("rpm") == pytest.approx(start - 200.0, abs=100.0)
    host.run_until(lambda: host.status.state == 0, 1.0)


@pytest.mark.parametrize("port", ["chip", "avr"])
@pytest.mark.parametrize(
    ("switch", "fault", "encoder"),
    [
        ("jammed", "stall", "QUADRATURE"), ("driver_fault", "over-current", "QUADRATURE"),
        ("dead_a", "encoder lost", "QUADRATURE"), ("bad_spi", "encoder lost", "MAGNETIC"),
        ("reversed_motor", "over-speed", "QUADRATURE"), ("runaway", "over-speed", "MAGNETIC"),
    ],
)  # fmt: skip
def test_the_image_stops_the_motor_for_a_fault(
    request: pytest.FixtureRequest, port: str, switch: str, fault: str, encoder: str
) -> None:
    if (port, encoder) == ("avr", "MAGNETIC"):
        encoder, switch = "QUADRATURE", {"bad_spi": "dead_a"}.get(switch, switch)
    host = Host(request.getfixturevalue(port)(encoder))
    host.run(0.05)
    if switch == "reversed_motor":
        host.board.set(switch)
    assert host.command(SetSpeed(400.0, 4000.0)) == 0
    if switch != "reversed_motor":
        host.run(0.3)
        assert (host.status.faults, host.board.get("enable")) == (0, True)
    host.board.set(switch)
    host.run_until(lambda: host.status.state == 3, 1.5)
    assert (host.status.target_rpm, host.board.get("enable")) == (0.0, False)
    # A dead wire is a stall until the next index
    host.run_until(lambda: host.status.faults == FAULT[fault], 0.5)
    assert host.command(SetSpeed(100.0, 100.0)) == 3
    host.board.set(switch, 0)
    # It runs down
    host.run_until(
        lambda: abs(host.board.get("rpm")) < (2500.0 if port == "chip" else 1100.0), 12.0
    )
    assert host.command(Stop()) == 0
    host.run_until(lambda: host.status.state == 0, 2.0)
    assert (host.status.faults, host.command(SetSpeed(100.0, 1000.0))) == (0, 0)


def test_the_image_latches_a_lost_supply_and_ignores_bounces(image: Callable[..., Any]) -> None:
    host = Host(image())
    host.board.set("bouncing_index")
    host.run(0.05)
    assert host.command(SetSpeed(600.0, 4000.0)) == 0
    host.run(0.4)
    steps = [b.count - a.count for a, b in itertools.pairwise(of(Index, host.run(0.4)))]
    assert len(steps) >= 2
    # An AVR reads the count some microseconds after the edge
    assert max(abs(step - 4096) for step in steps) <= 2
    assert (host.status.state, host.status.faults) == (1, 0)
    host.board.set("sensed")
    host.board.set("no_supply")
    host.run(0.03)
    assert (host.status.faults, host.board.get("enable")) == (FAULT["supply lost"], False)
    host.board.set("no_supply", 0)
    host.run(0.1)
    assert (host.status.state, host.board.get("enable"), host.command(SetSpeed(100.0, 100.0))) == (
        3,
        False,
        3,
    )
    assert host.command(Stop()) == 0
    host.run_until(lambda: host.status.state == 0, 2.0)


def test_the_image_gives_the_magnetic_encoder_time_and_clears_its_errors(
    chip: Callable[..., Any],
) -> None:
    host = Host(chip("MAGNETIC", "PULSES_TIMED"))
    host.run(0.05)
    assert host.command(SetSpeed(300.0, 4000.0)) == 0
    host.run(0.3)
    for _ in range(4):
        host.board.set("error_flag", 1)
        host.run(0.05)
    assert (host.status.state, host.status.faults) == (1, 0)
    assert min(host.board.get("spi_ns").values()) >= 350.0
    begins, ends = host.board.get("trigger_us"), host.board.get("trigger_end_us")
    assert all(1000 <= end - begin <= 2050 for begin, end in zip(begins, ends, strict=False))
    host.board.set("no_magnet")
    host.run(0.05)
    assert (host.status.faults, host.board.get("enable")) == (FAULT["magnet lost"], False)


def test_the_image_reports_a_missing_index_and_a_silent_host(image: Callable[..., Any]) -> None:
    host = Host(image())
    host.run(0.05)
    host.command(SetSpeed(400.0, 4000.0))
    host.run_until(lambda: host.status.state == 1, 2.0)
    host.board.set("no_index")
    host.run_until(lambda: host.status.faults != 0, 0.5)
    assert (host.status.faults, host.status.target_rpm, host.board.get("enable")) == (
        FAULT["index missed"],
        400.0,
        True,
    )
    host.board.set("no_index", 0)
    host.run_until(lambda: host.status.faults == 0, 0.5)
    host.messages += [
        m for _, m in host.decoder.feed(host.board.advance(host.board.now + 3_200_000))
    ]
    assert (host.status.faults, host.status.target_rpm, host.board.get("enable")) == (
        FAULT["host lost"],
        400.0,
        True,
    )
    host.run_until(lambda: host.status.faults == 0, 0.5)


@pytest.mark.parametrize("where", ["loop", "tick", "no-tick"])
def test_the_watchdog_ends_a_hang_of_the_image(chip: Callable[..., Any], where: str) -> None:
    host = Host(chip())
    host.command(SetSpeed(400.0, 4000.0))
    host.run(0.2)
    before = host.board.get("fed")["times"]
    host.run(0.2)
    assert abs(host.board.get("fed")["times"] - before - 200) <= 1  # once per tick
    assert host.board.get("watchdog_resets") == 0x1FFFC  # all but the oscillators
    host.board.hang(where)
    host.run(0.09)
    assert (host.board.get("watchdogs"), host.board.get("enable")) == (0, True)
    last = host.board.get("fed")["last_us"]
    assert host.board.now - last > 88_000
    host.run(0.05)
    assert host.board.get("watchdogs") == 1
    assert host.board.get("boot_us") - last == pytest.approx(100_000, abs=10)
    host.run(0.3)
    # No pulse in the start
    assert (host.board.get("enable"), len(host.board.get("enabled_us"))) == (
        False,
        1,
    )
    assert (host.decoder.received.restarts, host.status.target_rpm, host.status.faults) == (
        1,
        0.0,
        0,
    )
    assert host.command(SetSpeed(100.0, 1000.0)) == 0


# The image for the ATmega2560.


def test_the_image_for_the_avr_passes_the_conformance_suite(avr: Callable[..., Any]) -> None:
    checks = check_controller(VirtualWire(avr()), 240.0)
    assert [check.name for check in checks if not check.passed] == []


def test_the_avr_follows_the_edges_at_1000_rpm(avr: Callable[..., Any]) -> None:
    host = Host(avr())
    host.run(0.05)
    assert host.command(SetSpeed(1000.0, 5000.0)) == 0
    host.run(0.6)
    steps = {b.count - a.count for a, b in itertools.pairwise(of(Index, host.run(0.5)))}
    # The count is read some microseconds after the edge
    assert 4094 <= min(steps) <= max(steps) <= 4098
    last = of(Samples, host.messages)[-1]
    since = (host.board.now - last.t_us[-1]) / S
    turned = host.board.get("angle") / math.tau - 0.3 - since * host.board.get("rpm") / 60.0
    assert last.count[-1] / 4096 == pytest.approx(turned, abs=0.001)
    used = host.board.get("cycles") / (16 * host.board.now)
    assert 0.3 < used < 0.9
    interrupts = host.board.interrupts()
    assert interrupts["edge A"]["worst"] < 70
    # One edge
    assert max(interrupts[name]["late"] for name in ("edge A", "edge B")) < 16e6 / (
        1000 / 60 * 4096
    )
    assert host.decoder.received == protocol.FrameCounters(frames=host.decoder.received.frames)


@pytest.mark.parametrize("pulses", ["PULSES_TIMED", "PULSES_INDEX", "PULSES_CAMERA"])
def test_the_avr_with_each_source_of_pulses(avr: Callable[..., Any], pulses: str) -> None:
    host = Host(avr(pulses=pulses))
    host.run(0.05)
    host.command(SetSpeed(600.0, 5000.0))
    host.run(0.4)
    received = camera_pulses(host, pulses, 3)
    syncs, edges = of(Sync, host.messages), received or host.board.get("trigger_us")
    assert len(syncs) >= 3
    assert max(abs(m.t_us - edge) for m, edge in zip(syncs, edges, strict=True)) <= 2.0
    if pulses == "PULSES_INDEX":  # sent after the edge
        assert all(
            0 <= s.t_us - m.t_us < 60 for s, m in zip(syncs, of(Index, host.messages), strict=True)
        )


@pytest.mark.parametrize("where", ["loop", "tick", "no-tick"])
def test_the_watchdog_of_the_avr_ends_a_hang(avr: Callable[..., Any], where: str) -> None:
    host = Host(avr())
    host.run(0.05)
    host.command(SetSpeed(400.0, 4000.0))
    host.run(0.3)
    hung = host.board.now
    host.board.hang(where)
    host.run(0.11)
    assert (host.board.get("watchdogs"), host.board.get("enable")) == (0, True)
    host.run(0.05)
    assert host.board.get("watchdogs") == 1
    assert host.board.get("boot_us") - hung == pytest.approx(128_000, abs=2000)
    host.run(0.3)
    assert (host.board.get("enable"), len(host.board.get("enabled_us"))) == (False, 1)
    assert (host.decoder.received.restarts, host.status.target_rpm, host.status.faults) == (
        1,
        0.0,
        0,
    )
    assert host.command(SetSpeed(100.0, 1000.0)) == 0
