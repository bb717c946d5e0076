"""The emulated controller in Python and the firmware's core in C answer every frame alike."""

import math
import random
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amiwarp.live.link import (
    Answer,
    Ask,
    Condition,
    Controller,
    ControllerStatus,
    FrameDecoder,
    Identity,
    Motor,
    Pong,
    RestoreSettings,
    SaveSettings,
    SetCounts,
    SetSetting,
    SetSpeed,
    Setting,
    Stop,
    protocol,
)
from tests.firmware.test_firmware import FIRMWARE, built, load

pytestmark = [
    pytest.mark.skipif(
        not FIRMWARE.is_dir(), reason="the firmware is not in this copy of the project"
    ),
    pytest.mark.skipif(
        shutil.which("gcc") is None or shutil.which("make") is None, reason="needs gcc and make"
    ),
]
PLAUSIBLE = (0.0, -0.0, 60.0, -240.5, 720.0, 1440.0)
STRANGE = (math.nan, math.inf, -math.inf, 1e9, -1e9, 3000.5, -3001.0, 1e-45, 1e38)
"""Speeds."""
KEYS = range(len(protocol.SETTINGS))

FRAMES = 800
"""Number of random frames of one test."""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("firmware"), "libboard.so") / "libboard.so"


class Pair:
    """Emulator and core, which get the same bytes at the same times."""

    def __init__(self, library: Path) -> None:
        self.board = load("boards").NativeBoard(library=library)
        emulated = Controller(Motor(0.0))
        emulated._built["most-rpm"] = emulated.settings["most-rpm"] = 3000  # that of the core
        self.controllers: tuple[Any, Any] = (emulated, self.board)
        self.decoders = FrameDecoder(), FrameDecoder()
        self.now = 0
        self.status: list[ControllerStatus | None] = [None, None]
        self.run(200_000)

    def run(self, us: int, data: bytes = b"") -> list[list[protocol.Message]]:
        """Send bytes, let time pass, and return what both answer, without times and the board's name."""
        found: list[list[protocol.Message]] = [[], []]
        for controller in self.controllers:
            controller.feed(data, self.now)
        self.now += us
        for k, (controller, decoder) in enumerate(
            zip(self.controllers, self.decoders, strict=True)
        ):
            for _, message in decoder.feed(controller.advance(self.now)):
                if isinstance(message, ControllerStatus):
                    self.status[k] = message
                elif isinstance(message, Pong):
                    found[k].append(Pong(message.number, 0))
                elif isinstance(message, Condition):
                    found[k].append(replace(message, t_us=0))
                elif isinstance(message, Identity):
                    found[k].append(replace(message, board=bytes(protocol.BOARD_BYTES)))
                elif isinstance(message, Answer | Setting):
                    found[k].append(message)
        return found

    @property
    def core(self) -> ControllerStatus:
        """The core's latest status."""
        assert self.status[1] is not None
        return self.status[1]

    def check(self) -> None:
        """Compare the statuses but for times and speeds."""
        a, b = (
            (s.state, s.faults, np.float32(s.target_rpm), s.counts_per_turn)
            for s in self.status
            if s is not None
        )
        assert a == b


def values_of(key: int) -> list[int]:
    """Return values at and around the ends of a setting's range."""
    if key >= len(protocol.SETTINGS):
        return [0, 1]
    found = protocol.SETTINGS[key]
    return [
        found.least,
        found.least - 1,
        found.most,
        found.most + 1,
        0,
        -1,
        -(1 << 31),
        (1 << 31) - 1,
        5000,
        2,
    ]


def harmless(key: int, value: int) -> bool:
    """Whether a motor with this setting turns and stops as before."""
    if key >= len(protocol.SETTINGS) or not protocol.SETTINGS[key].contains(value):
        return True
    return protocol.SETTINGS[key].name in ("host-timeout", "undervoltage", "overvoltage")


def payload(rng: random.Random, kind: int) -> bytes:
    """Return a payload, mostly one that fits the type."""
    if rng.random() < 0.15:
        return rng.randbytes(rng.choice((0, 1, 3, 5, 7, 9, 12, 40, 300)))
    if kind == SetSpeed.KIND:
        rpm = rng.choice((*PLAUSIBLE, *STRANGE))
        ramp = rng.choice((500.0, 5000.0, 1e5, 0.0, -0.0, -1.0, math.nan, math.inf, -math.inf))
        return struct.pack("<ff", rpm, ramp)
    if kind == SetCounts.KIND:
        return struct.pack(
            "<I", rng.choice((0, 1, 100, 4096, 4096, (1 << 24) - 1, 1 << 24, (1 << 32) - 1))
        )
    if kind == Ask.KIND:
        return bytes(
            [rng.choice((7, 8, 9, 9, 9, 10, 6, 0, 255)), rng.choice((*KEYS, len(KEYS), 255))]
        )
    if kind == SetSetting.KIND:
        key = rng.choice((*KEYS, len(KEYS), 255))
        return struct.pack("<Bi", key, rng.choice([v for v in values_of(key) if harmless(key, v)]))
    found = protocol._PLAIN.get(kind)
    return rng.randbytes(found.LAYOUT.size if found is not None else rng.randrange(20))


def frame(rng: random.Random, sequence: int) -> bytes:
    """Return a frame of any type, or garbage: some with a wrong version, size, CRC or encoding."""
    commands = (
        SetSpeed.KIND,
        SetSpeed.KIND,
        SetCounts.KIND,
        Ask.KIND,
        Ask.KIND,
        SetSetting.KIND,
        SetSetting.KIND,
    )
    kind = rng.choice(
        (
            *commands,
            *protocol._PLAIN,
            protocol.Samples.KIND,
            0x00,
            0x0A,
            0x7F,
            0x80,
            0x8F,
            0xFF,
            rng.randrange(256),
        )
    )
    version = protocol.VERSION if rng.random() < 0.95 else rng.randrange(256)
    whole = protocol.framed(struct.pack("<BBH", version, kind, sequence) + payload(rng, kind))
    fate = rng.random()
    if fate < 0.7:
        return whole
    at = rng.randrange(len(whole))
    if fate < 0.78:
        return whole[:at] + bytes([whole[at] ^ 1 << rng.randrange(8)]) + whole[at + 1 :]
    if fate < 0.84:
        return whole[:at] + whole[at + 1 :]
    if fate < 0.9:
        return whole[:at] + rng.randbytes(1) + whole[at:]
    if fate < 0.94:
        return b"\0" * rng.randrange(4) + whole
    if fate < 0.97:
        return rng.randbytes(rng.randrange(1, 700))
    # Around the longest frame, which has 512 bytes
    size = rng.choice((500, 501, 502, 503, 504, 505, 506, 507, 600))
    return protocol.framed(
        struct.pack("<BBH", 1, 0xF0, sequence) + bytes(rng.randrange(1, 256) for _ in range(size))
    )


@pytest.mark.parametrize(
    "seed", [0, 1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)]
)
def test_every_frame_has_the_same_answer(library: Path, seed: int) -> None:
    rng, pair = random.Random(seed), Pair(library)
    sequence, answers, refusals, turns = rng.randrange(1 << 16), 0, set(), False
    for k in range(FRAMES):
        sequence = (sequence + (1 if rng.random() < 0.9 else rng.randrange(1 << 16))) % (1 << 16)
        data = frame(rng, sequence)
        emulated, core = pair.run(20_000, data)
        assert emulated == core, (k, data.hex())
        answers += len(core)
        refusals |= {m.refused for m in core if isinstance(m, Answer)}
        if (
            pair.core.counts_per_turn != 4096
        ):  # with other counts than its encoder's, the core would see faults
            restored = pair.run(20_000, b"\0" + protocol.encode(SetCounts(4096), sequence))
            assert restored == [[Answer(sequence, 0)]] * 2
        if (
            turns and pair.core.target_rpm == 0.0
        ):  # until the prism stands still: the two motors brake differently
            emulated, core = pair.run(4_000_000)
            assert emulated == core
            pair.check()
        turns = pair.core.target_rpm != 0.0
    assert pair.board.counters()["lost"] == pair.controllers[0]._decoder.received.lost
    assert answers > FRAMES // 2
    assert refusals >= {0, 1, 2}


def test_a_frame_of_512_bytes_is_the_longest(library: Path) -> None:
    pair = Pair(library)
    for size in range(495, 515):
        packet = struct.pack("<BBH", 1, 0xF0, size) + b"\1" * size
        data = protocol.framed(packet)
        emulated, core = pair.run(20_000, data)
        assert emulated == core == ([Answer(size, 1)] if len(data) <= protocol.LONGEST else [])
    assert len(data) > protocol.LONGEST


def test_the_answers_to_commands_at_rest_and_in_motion(library: Path) -> None:
    pair = Pair(library)
    steps: list[tuple[protocol.Message, int, int]] = [
        (SetCounts(4096), 0, 20_000), (SetCounts(1000), 0, 20_000), (SetCounts(4096), 0, 20_000),
        (SetSpeed(300.0, 1000.0), 0, 1_500_000), (SetCounts(4096), 0, 20_000), (SetCounts(1000), 3, 20_000),
        (SetCounts(0), 2, 20_000), (SetSpeed(-300.0, 2000.0), 0, 2_000_000), (SetCounts(1000), 3, 20_000),
        (Answer(1, 1), 1, 20_000), (Stop(), 0, 3_000_000), (SetCounts(1000), 0, 200_000),
    ]  # fmt: skip
    for sequence, (message, refused, us) in enumerate(steps):
        emulated, core = pair.run(us, protocol.encode(message, sequence))
        assert emulated == core == [Answer(sequence, refused)]
        pair.check()


def test_settings_are_changed_saved_and_restored_alike(library: Path) -> None:
    """Including resets, after which both have what was saved last, and counts per turn that no encoder has."""
    rng, pair = random.Random(7), Pair(library)
    saved, changed = 0, 0
    for k in range(500):
        key = rng.choice((*KEYS, len(KEYS), 255))
        message = rng.choice(
            (
                SetSetting(key, rng.choice(values_of(key))), SetSetting(key, rng.randrange(1, 20_000)),
                SetSetting(key, rng.randrange(1, 20_000)), Ask(Setting.KIND, key), Ask(Condition.KIND, key),
                SaveSettings(), RestoreSettings(), SetCounts(rng.randrange(1 << 24)),
            )
        )  # fmt: skip
        emulated, core = pair.run(200_000, protocol.encode(message, k))
        assert emulated == core, message
        accepted = core[-1] == Answer(k, 0)
        saved += accepted and isinstance(message, SaveSettings)
        changed += accepted and isinstance(message, SetSetting)
        if rng.random() < 0.1:
            pair.board.reset()
            pair.controllers[0]._boot(0)
            pair.run(200_000)
        asked = [protocol.encode(Ask(Setting.KIND, other), other) for other in KEYS]
        emulated, core = pair.run(50_000, b"".join(asked))
        assert emulated == core
        assert [m.key for m in core if isinstance(m, Setting)] == list(KEYS)
        pair.check()
    assert saved > 20
    assert changed > 50


def test_the_motor_stops_for_a_silent_host_alike(library: Path) -> None:
    pair, timeout = Pair(library), [s.name for s in protocol.SETTINGS].index("host-timeout")
    stops = 0
    for k, (message, us) in enumerate(
        [
            (SetSetting(timeout, 2), 20_000), (SetSpeed(300.0, 1000.0), 1_900_000), (Ask(Condition.KIND), 1_900_000),
            (Ask(Condition.KIND), 6_000_000), (Ask(Condition.KIND), 20_000), (SetSpeed(300.0, 1000.0), 20_000),
            (Stop(), 6_000_000), (Ask(Condition.KIND), 20_000), (SetSpeed(-300.0, 1000.0), 6_000_000),
            (Ask(Condition.KIND), 20_000), (Stop(), 1_000_000), (SetSetting(timeout, 0), 20_000),
            (SetSpeed(-300.0, 1000.0), 6_000_000), (Ask(Condition.KIND), 20_000), (Stop(), 1_000_000),
        ]
    ):  # fmt: skip
        emulated, core = pair.run(us, protocol.encode(message, k))
        assert emulated == core
        pair.check()
        found = [m for m in core if isinstance(m, Condition)]
        stops = found[0].host_stops if found else stops
        still = pair.core.target_rpm == 0.0
        assert still == (k in (0, 3, 4, 6, 7, 8, 9, 10, 11, 14)), k
    assert stops == 2
