"""The core's settings and their memory, its supply, and what it does without a host."""

import ctypes
import itertools
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from amiwarp.live.link import (
    Answer,
    Ask,
    Condition,
    Identity,
    Index,
    Message,
    RestoreSettings,
    Samples,
    SaveSettings,
    SetSetting,
    SetSpeed,
    Setting,
    Stop,
    encode,
    protocol,
)
from tests.firmware import test_firmware as base
from tests.firmware.test_firmware import FAULT, FIRMWARE, Host, S, built, load, of

pytestmark = [
    pytest.mark.skipif(
        not FIRMWARE.is_dir(), reason="the firmware is not in this copy of the project"
    ),
    pytest.mark.skipif(
        shutil.which("gcc") is None or shutil.which("make") is None, reason="needs gcc and make"
    ),
]
KEY = {setting.name: key for key, setting in enumerate(protocol.SETTINGS)}
BUILT = {
    "counts-per-turn": 4096,
    "most-rpm": 3000,
    "most-ramp": 5000,
    "stop-ramp": 2000,
    "kp": 5120,
    "ki": 25_600,
    "friction": 600,
    "no-load-rpm": 4000,
    "rise-ms": 150,
    "host-timeout": 0,
    "undervoltage": 9000,
    "overvoltage": 15_000,
}
SAVED = {"kp": 4000, "ki": 12_000, "most-rpm": 1500, "host-timeout": 30}
SAVE_S = 0.05
"""Longest time of a save in the simulated memory [s]."""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("firmware"), "libboard.so") / "libboard.so"


@pytest.fixture
def board(library: Path) -> Callable[..., Any]:
    make: Callable[..., Any] = load("boards").NativeBoard
    return lambda **settings: make(library=library, **settings)


@pytest.fixture
def host(board: Callable[..., Any]) -> Host:
    return rested(board())


def rested(board: Any) -> Host:
    host = Host(board)
    host.run(0.2)
    return host


def asked(host: Host, kind: type[protocol.Plain], key: int = 0) -> Any:
    """Return the one message that is asked for, and check that its answer comes after it."""
    number, before = host.send(Ask(kind.KIND, key)), len(host.messages)
    got = [m for m in [*host.messages[before:], *host.run(0.05)] if isinstance(m, kind | Answer)]
    assert got[1:] == [Answer(number, 0)]
    return got[0]


def settings(host: Host) -> dict[str, int]:
    return {name: asked(host, Setting, key).value for name, key in KEY.items()}


def change(host: Host, values: dict[str, int]) -> None:
    for name, value in values.items():
        assert host.command(SetSetting(KEY[name], value)) == 0, name


def memory(board: Any) -> Any:
    """The two slots of the memory that outlives a reset."""
    board.library.board_store.restype = ctypes.POINTER(ctypes.c_uint8)
    size = 2 * board.library.board_store_bytes()
    return ctypes.cast(
        board.library.board_store(board._board), ctypes.POINTER(ctypes.c_uint8 * size)
    ).contents


def reset(host: Host) -> None:
    host.board.reset()
    host.run(0.2)


# What it is.


def test_the_identity_is_the_version_and_the_board(host: Host) -> None:
    who = asked(host, Identity)
    header = (FIRMWARE / "core" / "controller.h").read_text(encoding="utf-8")
    numbers = [
        int(header.partition(f"FIRMWARE_{part} ")[2].split()[0])
        for part in ("MAJOR", "MINOR", "PATCH")
    ]
    assert who.version == ".".join(map(str, numbers))
    assert who.board_name == "simulated"
    assert who.board == b"simulated".ljust(16, b"\0")
    assert replace(who, board=b"a\xff\nb\0c".ljust(16, b"\0")).board_name == "a??b"


def test_a_host_that_does_not_ask_sees_no_message_that_it_does_not_know(host: Host) -> None:
    """Its suite would count such a message as unknown, and fail."""
    host.command(SetSpeed(300.0, 3000.0))
    host.run(2.0)
    host.command(Stop())
    host.run(1.0)
    assert not of(Identity | Condition | Setting, host.messages)  # type: ignore[arg-type]
    assert max(type(m).KIND for m in host.messages) == Answer.KIND


@pytest.mark.parametrize(
    "wanted", [Ask(0x06), Ask(0x0A), Ask(0), Ask(Setting.KIND, 12), Ask(Setting.KIND, 255)]
)
def test_other_questions_are_out_of_range(host: Host, wanted: Message) -> None:
    assert host.command(wanted) == 2


# Supply.


def test_a_supply_that_is_not_connected_is_unknown_and_no_fault(host: Host) -> None:
    condition = asked(host, Condition)
    assert (condition.supply_v, condition.supply_mv) == (None, protocol.UNKNOWN_MV)
    host.board.set("no_supply")
    host.run(0.5)
    assert asked(host, Condition).supply_v is None
    assert host.status.faults == 0


def test_the_supply_is_the_mean_of_some_milliseconds(host: Host) -> None:
    host.board.set("divider")
    host.run(0.05)
    assert asked(host, Condition).supply_v == 12.0  # at once, without a ramp from 0
    host.board.set("volts", 13.0)
    host.run(0.005)
    during = asked(host, Condition)
    assert 12.1 < during.supply_v <= 13.0
    host.run(0.2)
    assert asked(host, Condition).supply_v == pytest.approx(13.0, abs=0.02)
    assert -1000 <= host.board.now - asked(host, Condition).t_us < 60_000
    host.board.set("divider", 0)
    host.run(0.01)
    assert asked(host, Condition).supply_v is None


@pytest.mark.parametrize(
    ("volts", "name"),
    [
        (9.1, None),
        (8.9, "undervoltage"),
        (14.9, None),
        (15.1, "overvoltage"),
        (0.0, "undervoltage"),
    ],
)
def test_a_supply_beyond_its_limits_stops_the_motor(
    host: Host, volts: float, name: str | None
) -> None:
    host.board.set("divider")
    assert host.command(SetSpeed(300.0, 3000.0)) == 0
    host.run(1.0)
    assert (host.status.state, host.status.faults) == (1, 0)
    host.board.set("volts", volts)
    host.run(0.3)
    if name is None:
        assert (host.status.state, host.status.faults) == (1, 0)
        return
    assert (host.status.state, host.status.faults) == (3, FAULT[name])
    assert host.board.get("driven") == 0.0
    host.board.set("volts", 12.0)
    host.run(0.3)
    assert host.status.faults == FAULT[name]  # it does not start by itself
    assert host.command(SetSpeed(100.0, 1000.0)) == 3
    assert host.command(Stop()) == 0
    host.run(0.5)
    assert host.status.faults == 0
    assert host.command(SetSpeed(100.0, 1000.0)) == 0


def test_a_dip_of_some_milliseconds_is_no_undervoltage(host: Host) -> None:
    host.board.set("divider")
    host.command(SetSpeed(300.0, 3000.0))
    host.run(1.0)
    for _ in range(10):
        host.board.set("volts", 3.0)
        host.run(0.005, 1000)
        host.board.set("volts", 12.0)
        host.run(0.095)
    assert (host.status.state, host.status.faults) == (1, 0)


def test_the_limits_of_the_supply_can_be_changed_and_switched_off(host: Host) -> None:
    host.board.set("divider")
    host.board.set("volts", 24.0)
    host.run(0.3)
    assert host.status.faults == FAULT["overvoltage"]
    # Also in the state of this fault, which could not be ended else
    change(host, {"overvoltage": 30_000})
    assert host.command(Stop()) == 0
    host.run(0.3)
    assert (host.status.state, host.status.faults) == (0, 0)
    change(host, {"undervoltage": 25_000})
    host.run(0.3)
    assert host.status.faults == FAULT["undervoltage"]
    change(host, {"undervoltage": 0, "overvoltage": 0})
    assert host.command(Stop()) == 0
    for volts in (0.0, 60.0):
        host.board.set("volts", volts)
        host.run(0.3)
        assert host.status.faults == 0


# Without a host.


def silent(host: Host, seconds: float) -> None:
    host.messages += [
        m for _, m in host.decoder.feed(host.board.advance(host.board.now + round(seconds * S)))
    ]


def test_the_motor_brakes_by_its_ramp_when_no_host_is_heard(host: Host) -> None:
    change(host, {"host-timeout": 2, "stop-ramp": 1000})
    host.command(SetSpeed(600.0, 3000.0))
    host.run(1.0)
    silent(host, 1.9)
    assert host.status.target_rpm == 600.0
    silent(host, 0.35)
    assert (host.status.target_rpm, host.status.faults) == (0.0, FAULT["stopped for lost host"])
    # It is braked, neither released nor stopped at once
    assert 300.0 < host.board.get("rpm") < 500.0
    silent(host, 2.0)
    assert (host.status.state, host.board.get("driven")) == (0, 0.0)
    assert host.status.faults == FAULT["stopped for lost host"] | FAULT["host lost"]
    assert asked(host, Condition).host_stops == 1
    host.run(0.3)
    # The host is back, and the motor stays off
    assert host.status.faults == FAULT["stopped for lost host"]
    assert host.board.get("rpm") == pytest.approx(0.0, abs=2.0)
    assert host.command(SetSpeed(1e9, 100.0)) == 2
    assert host.status.faults == FAULT["stopped for lost host"]
    assert host.command(SetSpeed(300.0, 3000.0)) == 0
    host.run(0.5)
    assert (host.status.state, host.status.faults) == (1, 0)
    silent(host, 5.0)
    condition = asked(host, Condition)
    assert (condition.host_stops, condition.host_timeout_s) == (2, 2)
    assert host.command(Stop()) == 0
    host.run(0.1)
    assert host.status.faults == 0


def test_a_motor_at_rest_is_not_stopped_for_a_host_and_0_means_never(host: Host) -> None:
    change(host, {"host-timeout": 1})
    silent(host, 5.0)
    assert host.status.faults == FAULT["host lost"]
    change(host, {"host-timeout": 0})
    host.command(SetSpeed(300.0, 3000.0))
    host.run(0.5)
    silent(host, 20.0)
    assert (host.status.target_rpm, host.status.faults) == (300.0, FAULT["host lost"])
    assert asked(host, Condition).host_stops == 0


def test_any_frame_but_no_damaged_one_keeps_the_motor_turning(host: Host) -> None:
    change(host, {"host-timeout": 1})
    host.command(SetSpeed(300.0, 3000.0))
    for k in range(30):
        host.board.feed(encode(Ask(0x7F), k), host.board.now)
        silent(host, 0.5)
    assert (host.status.target_rpm, host.status.faults) == (300.0, 0)
    for k in range(4):
        frame = bytearray(encode(Ask(0x7F), k))
        frame[3] ^= 8
        host.board.feed(bytes(frame), host.board.now)
        silent(host, 0.5)
    assert host.status.target_rpm == 0.0


# Settings and their memory.


def test_settings_are_those_of_the_build_at_first(host: Host) -> None:
    assert settings(host) == BUILT
    assert asked(host, Condition).stored == 0


def test_settings_act_at_once(host: Host) -> None:
    change(host, {"most-rpm": 500, "counts-per-turn": 1000})
    assert host.command(SetSpeed(500.5, 3000.0)) == 2
    host.run(0.1)
    assert host.status.counts_per_turn == 1000
    change(host, {"counts-per-turn": 4096, "most-ramp": 100})
    host.command(SetSpeed(400.0, 3000.0))
    host.run(1.0)
    assert host.board.get("rpm") == pytest.approx(100.0, abs=40.0)  # at 100 rpm/s
    assert host.command(SetSetting(KEY["kp"], 100)) == 3  # not while it turns
    assert settings(host)["kp"] == BUILT["kp"]
    assert host.command(SetSetting(KEY["kp"], BUILT["kp"])) == 0  # it changes nothing
    assert host.command(SaveSettings()) == 3
    assert host.command(RestoreSettings()) == 3


def test_gains_act(host: Host) -> None:
    """With little proportional gain and a wrong feed-forward, the speed lags behind."""
    change(host, {"kp": 0, "ki": 1000, "no-load-rpm": 8000})
    host.command(SetSpeed(600.0, 3000.0))
    host.run(1.0)
    assert host.board.get("rpm") < 400.0


def test_saved_settings_outlive_a_reset_and_others_do_not(host: Host) -> None:
    change(host, SAVED)
    assert host.command(SaveSettings()) == 0
    assert asked(host, Condition).stored == 1
    change(host, {"kp": 1})
    reset(host)
    assert settings(host) == BUILT | SAVED
    condition = asked(host, Condition)
    assert (condition.stored, condition.host_timeout_s) == (1, 30)
    assert host.command(SetSpeed(1500.5, 3000.0)) == 2
    assert host.command(RestoreSettings()) == 0
    assert settings(host) == BUILT
    reset(host)
    assert settings(host) == BUILT | SAVED
    assert host.command(RestoreSettings()) == 0
    assert host.command(SaveSettings()) == 0
    reset(host)
    assert settings(host) == BUILT


def test_each_save_takes_the_other_slot(host: Host) -> None:
    size = host.board.library.board_store_bytes()
    before = bytes(memory(host.board))
    assert before == b"\xff" * (2 * size)
    for k in range(1, 6):
        change(host, {"kp": 100 + k})
        assert host.command(SaveSettings()) == 0
        after = bytes(memory(host.board))
        changed = [
            after[s * size : (s + 1) * size] != before[s * size : (s + 1) * size] for s in (0, 1)
        ]
        assert changed == [k % 2 == 0, k % 2 == 1]
        before = after


def test_each_power_on_takes_the_newest_record(host: Host) -> None:
    for kp in (100, 200, 300, 400):
        change(host, {"kp": kp})
        assert host.command(SaveSettings()) == 0
        reset(host)
        assert settings(host)["kp"] == kp


def test_a_power_cut_at_any_moment_of_a_save_leaves_the_old_or_the_new(
    board: Callable[..., Any],
) -> None:
    seen = set()
    for us in range(0, 20_000, 500):
        host = rested(board())
        for value in (1000, 2000):
            change(host, {"kp": value})
            assert host.command(SaveSettings()) == 0
        change(host, {"kp": 3000})
        host.send(SaveSettings())
        host.board.advance(host.board.now + us)
        reset(host)
        kp = settings(host)["kp"]
        assert asked(host, Condition).stored == 1
        seen.add(kp)
        change(host, {"ki": 7})
        assert host.command(SaveSettings()) == 0  # and it can save again, twice
        reset(host)
        change(host, {"ki": 8})
        assert host.command(SaveSettings()) == 0
        reset(host)
        assert settings(host) == BUILT | {"kp": kp, "ki": 8}
    assert seen == {2000, 3000}


def test_a_damaged_record_is_not_used_and_the_other_one_is(host: Host) -> None:
    size = host.board.library.board_store_bytes()
    for value in (1000, 2000):
        change(host, {"kp": value})
        assert host.command(SaveSettings()) == 0
    newest = bytes(memory(host.board))[:size]  # the second save
    for byte in range(size):
        memory(host.board)[byte] ^= 1 << byte % 8
        reset(host)
        assert settings(host)["kp"] == 1000, byte
        assert asked(host, Condition).stored == 1
        memory(host.board)[byte] = newest[byte]
    reset(host)
    assert settings(host)["kp"] == 2000
    memory(host.board)[5] ^= 1
    memory(host.board)[size + 5] ^= 1
    reset(host)
    assert settings(host) == BUILT
    assert asked(host, Condition).stored == 3
    assert host.command(SaveSettings()) == 0
    reset(host)
    assert asked(host, Condition).stored == 1


def test_a_record_in_the_slot_of_the_other_is_not_used(host: Host) -> None:
    size = host.board.library.board_store_bytes()
    change(host, {"kp": 1000})
    assert host.command(SaveSettings()) == 0
    held = bytes(memory(host.board))
    memory(host.board)[:] = held[size:] + held[:size]
    reset(host)
    assert settings(host) == BUILT
    assert asked(host, Condition).stored == 3


def test_what_another_build_saved_is_not_used(board: Callable[..., Any]) -> None:
    first, second = rested(board()), rested(board(counts_per_turn=2000))
    change(first, SAVED)
    assert first.command(SaveSettings()) == 0
    memory(second.board)[:] = bytes(memory(first.board))
    reset(second)
    assert settings(second) == BUILT | {"counts-per-turn": 2000}
    assert asked(second, Condition).stored == 2
    change(second, {"kp": 9})
    assert second.command(SaveSettings()) == 0
    reset(second)
    assert settings(second) == BUILT | {"counts-per-turn": 2000, "kp": 9}


def test_a_memory_that_does_not_keep_what_is_written_is_said(host: Host) -> None:
    change(host, {"kp": 1000})
    assert host.command(SaveSettings()) == 0
    host.board.set("bad_store")
    for _ in range(2):  # the slot of the good record is never written meanwhile
        change(host, {"kp": 2000})
        for _ in range(3):
            assert host.command(SaveSettings()) == 3
        reset(host)
        assert settings(host)["kp"] == 1000
    host.board.set("bad_store", 0)
    change(host, {"kp": 3000})
    assert host.command(SaveSettings()) == 0
    reset(host)
    assert settings(host)["kp"] == 3000


def test_a_second_save_waits_for_the_first(host: Host) -> None:
    first, second = host.send(SaveSettings()), host.send(SaveSettings())
    answers = {m.sequence: m.refused for m in of(Answer, host.run(SAVE_S))}
    assert answers == {first: 0, second: 3}


def test_a_magnetic_encoder_can_get_another_ratio(board: Callable[..., Any]) -> None:
    host = rested(board(magnetic=True))
    change(host, {"counts-per-turn": 32_768})
    assert host.command(SaveSettings()) == 0
    reset(host)
    assert host.status.counts_per_turn == 32_768


# The images for the RP2040 and the ATmega2560.


images, chip, avr, image = base.images, base.chip, base.avr, base.image


@pytest.fixture
def chip_host(image: Callable[..., Any]) -> Host:
    return rested(image())


def saved(host: Host, seconds: float = 1.0) -> int:
    """Save, and return the answer: an EEPROM of 64 bytes takes a fifth of a second."""
    number = host.send(SaveSettings())
    return next(
        m.refused for m in host.run(seconds) if isinstance(m, Answer) and m.sequence == number
    )


def test_an_image_senses_its_supply_if_it_is_connected(chip_host: Host) -> None:
    host = chip_host
    who = asked(host, Identity)
    assert who.board_name == (
        "RP2040" if type(host.board).__name__ == "SimulatedBoard" else "ATmega2560"
    )
    assert asked(host, Condition).supply_v is None
    assert host.status.faults == 0
    host.board.set("divider")
    for volts in (12.0, 9.5, 14.5):
        host.board.set("volts", volts)
        reset(host)
        assert asked(host, Condition).supply_v == pytest.approx(volts, rel=0.01)
        assert host.status.faults == 0
    host.board.set("volts", 12.0)
    host.run(0.2)
    assert host.command(SetSpeed(300.0, 4000.0)) == 0
    host.run(0.4)
    assert (host.status.state, host.status.faults) == (1, 0)
    host.board.set("volts", 7.0)
    host.run(0.1)
    assert (host.status.faults, host.board.get("enable")) == (FAULT["undervoltage"], False)
    assert asked(host, Condition).supply_v == pytest.approx(7.0, rel=0.02)
    host.board.set("volts", 16.0)
    assert host.command(Stop()) == 0
    host.run(0.1)
    assert host.status.faults == FAULT["overvoltage"]


def test_an_image_that_starts_without_voltage_knows_it_when_it_comes(
    image: Callable[..., Any],
) -> None:
    host = Host(image())
    host.board.set("divider")
    host.board.set("volts", 0.0)
    reset(host)
    assert asked(host, Condition).supply_v == pytest.approx(0.0, abs=0.05)
    host.board.set("volts", 12.0)
    host.run(0.2)
    assert asked(host, Condition).supply_v == pytest.approx(12.0, rel=0.01)


def test_an_image_keeps_its_settings_without_power(chip_host: Host) -> None:
    host, most = chip_host, 900
    before = settings(host)
    change(host, SAVED | {"most-rpm": most})
    assert saved(host) == 0
    reset(host)
    assert settings(host) == before | SAVED | {"most-rpm": most}
    assert asked(host, Condition).stored == 1
    samples = of(Samples, host.run(0.3))  # and while it writes, it goes on with its samples
    times = [t for m in samples for t in m.t_us]
    assert max(b - a for a, b in itertools.pairwise(times)) < 1100
    change(host, {"kp": 77})
    number = host.send(SaveSettings())
    during = host.run(0.6)
    times = [t for m in of(Samples, during) for t in m.t_us]
    assert max(b - a for a, b in itertools.pairwise(times)) < 1100
    assert Answer(number, 0) in during
    assert host.board.get("watchdogs") == 0


def test_an_image_without_power_in_the_middle_of_a_save_has_the_old_settings(
    chip_host: Host,
) -> None:
    host = chip_host
    for kp in (1000, 2000):
        change(host, {"kp": kp})
        assert saved(host) == 0
    found = []
    for us in (2_000, 20_000, 150_000, 299_000, 301_500, 310_000, 400_000):
        change(host, {"kp": 2000 + us})
        host.send(SaveSettings())
        host.board.advance(host.board.now + us)
        reset(host)
        old = found[-1] if found else 2000
        kp = settings(host)["kp"]
        assert asked(host, Condition).stored == 1
        assert kp in (old, 2000 + us), us
        found.append(kp)
    assert found[0] == 2000
    assert found[-1] == 402_000


def test_an_image_says_that_its_memory_is_bad(chip: Callable[..., Any]) -> None:
    host = rested(chip())
    change(host, {"kp": 1000})
    assert saved(host) == 0
    host.board.set("bad_store")
    change(host, {"kp": 2000})
    assert saved(host) == 3
    host.board.set("bad_store", 0)
    reset(host)
    assert settings(host)["kp"] == 1000


def test_an_image_stops_its_motor_without_a_host(chip_host: Host) -> None:
    host = chip_host
    change(host, {"host-timeout": 1})
    assert host.command(SetSpeed(300.0, 4000.0)) == 0
    host.run(0.3)
    assert host.status.state == 1
    silent(host, 1.5)
    assert (host.status.target_rpm, host.board.get("enable")) == (0.0, False)
    assert host.status.faults == FAULT["stopped for lost host"]
    assert asked(host, Condition).host_stops == 1


def test_the_avr_takes_no_limit_of_speed_that_it_cannot_count(avr: Callable[..., Any]) -> None:
    host = rested(avr())
    assert host.command(SetSetting(KEY["most-rpm"], 1098)) == 0  # 74,957 edges per second
    assert host.command(SetSetting(KEY["most-rpm"], 1099)) == 2
    assert host.command(SetSetting(KEY["counts-per-turn"], 4100)) == 2
    assert settings(host)["most-rpm"] == 1098


def test_a_magnetic_image_gets_the_ratio_of_its_pulleys(chip: Callable[..., Any]) -> None:
    """One that was built for a magnet on the prism, with a magnet that turns twice as fast: it then reads the index."""
    host = rested(chip("MAGNETIC", "PULSES_TIMED", counts=32_768))
    assert host.status.counts_per_turn == 16_384
    change(host, {"counts-per-turn": 32_768})
    assert host.command(SetSpeed(600.0, 5000.0)) == 0
    host.run(0.8)
    pulses = of(Index, host.messages)[1:]
    assert len(pulses) > 3
    assert all(abs(b.count - a.count - 32_768) < 10 for a, b in itertools.pairwise(pulses))
    assert (host.status.state, host.status.faults) == (1, 0)
    assert host.status.rpm == pytest.approx(600.0, abs=60.0)
