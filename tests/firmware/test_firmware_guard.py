"""The firmware's core with a faulty encoder, index, magnet, supply or load: it stops in time, and only then."""

import ctypes
import itertools
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from amiwarp.live.link import Index, SetSpeed, Stop, Sync
from tests.firmware.test_firmware import FAULT, FIRMWARE, GEARED, Host, built, load, of

pytestmark = [
    pytest.mark.skipif(
        not FIRMWARE.is_dir(), reason="the firmware is not in this copy of the project"
    ),
    pytest.mark.skipif(
        shutil.which("gcc") is None or shutil.which("make") is None, reason="needs gcc and make"
    ),
]
LONGEST_UNFED_US = 100_000
"""Longest time for which the motor may have voltage while the encoder does not answer to it [us]."""
MOST_RPM = 3000.0


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("firmware"), "libboard.so") / "libboard.so"


@pytest.fixture
def turning(library: Path) -> Callable[..., Host]:
    """Start a board with these settings, and let it turn."""

    def start(rpm: float = 720.0, ramp: float = 2000.0, **settings: Any) -> Host:
        host = Host(load("boards").NativeBoard(library=library, **settings))
        host.run(0.2)
        assert host.command(SetSpeed(rpm, ramp)) == 0
        host.run(abs(rpm) / ramp + 1.0)
        assert (host.status.state, host.status.faults) == (1, 0)
        return host

    return start


def stopped(host: Host, fault: str) -> None:
    """Check that the motor is off because of a fault, stays off, and turns again after a stop."""
    assert (host.status.state, host.status.faults, host.board.get("driven")) == (
        3,
        FAULT[fault],
        0.0,
    )
    assert host.board.get("unfed_us") <= LONGEST_UNFED_US
    assert host.command(SetSpeed(100.0, 100.0)) == 3


# The magnetic encoder.


def test_an_error_flag_of_the_encoder_is_cleared_and_counted(turning: Callable[..., Host]) -> None:
    host = turning(magnetic=True)
    for k in range(1, 6):
        host.board.set("error_flag", 1)
        host.run(0.1)
        # The next answer, or the one after it
        assert host.board.counters()["encoder_errors"] in (
            k,
            2 * k,
        )
    host.run(1.0)
    assert host.board.counters()["encoder_errors"] <= 10
    assert (host.status.state, host.status.faults) == (1, 0)


def test_three_bad_answers_in_a_row_are_a_fault(turning: Callable[..., Host]) -> None:
    host = turning(magnetic=True)
    # All frames of one reading; the flag is then in the next one, too
    host.board.set("error_flag", 4)
    host.run(0.1)
    assert host.status.faults == 0
    host.board.set("error_flag", 16)
    host.run(0.1)
    stopped(host, "encoder lost")
    host.board.set("error_flag", 0)
    assert host.command(Stop()) == 0
    host.run(1.0)
    assert (host.status.state, host.status.faults) == (0, 0)


@pytest.mark.parametrize("counts", [16384, GEARED])
def test_a_lost_magnet_stops_the_motor(turning: Callable[..., Host], counts: int) -> None:
    host = turning(magnetic=True, counts_per_turn=counts)
    host.board.set("no_magnet")
    host.run(0.05)
    stopped(host, "magnet lost")
    assert host.board.get("fastest_rpm") < 1500.0
    assert host.command(Stop()) == 0
    host.run(0.1)
    assert host.status.faults == FAULT["magnet lost"]  # it is still lost
    host.board.set("no_magnet", 0)
    host.run(1.0)
    assert host.command(Stop()) == 0
    host.run(0.1)
    assert host.status.faults == 0


def test_the_diagnosis_of_the_encoder(library: Path) -> None:
    check = ctypes.CDLL(str(library)).as5047_has_no_magnet
    good, weak, overflow, starting, strong = 0x0180, 0x09FF, 0x0380, 0x0080, 0x0500
    for word, lost in ((good, 0), (weak, 1), (overflow, 1), (starting, 1), (strong, 0)):
        frame = word | (word.bit_count() % 2) << 15
        assert check(frame) & 1 == lost
        assert check(frame ^ 0x8000) & 1 == 0  # damaged: it says nothing
        assert check((frame ^ 0x8000) | 0x4000) & 1 == 0  # an error, not a diagnosis


# The index.


@pytest.mark.parametrize("rpm", [720.0, -300.0])
@pytest.mark.parametrize("fault", ["bouncing_index", "odd_index"])
def test_edges_nearer_than_half_a_turn_are_no_index(
    turning: Callable[..., Host], rpm: float, fault: str
) -> None:
    host = turning(rpm, pulses=1)
    host.board.set(fault)
    host.run(0.2)
    messages = host.run(2.0)
    pulses, syncs = of(Index, messages), of(Sync, messages)
    assert len(pulses) == pytest.approx(abs(rpm) / 30.0, abs=1)
    assert {b.count - a.count for a, b in itertools.pairwise(pulses)} == {math.copysign(4096, rpm)}
    assert [m.t_us for m in syncs] == [m.t_us for m in pulses]
    assert host.board.counters()["index_bounces"] >= len(pulses)
    assert (host.status.state, host.status.faults) == (1, 0)


def test_the_index_is_at_the_same_count_after_a_change_of_direction(
    turning: Callable[..., Host],
) -> None:
    host = turning(120.0)
    forwards = of(Index, host.messages)[-1].count
    assert host.command(SetSpeed(-120.0, 1000.0)) == 0
    pulses = of(Index, host.run(2.0))
    assert len(pulses) >= 3
    assert max(abs(math.remainder(p.count - forwards, 4096)) for p in pulses) <= 1.0


# Voltage without movement.


@pytest.mark.parametrize("rpm", [720.0, 1440.0, -1440.0, 120.0])
@pytest.mark.parametrize(
    "settings", [{}, {"magnetic": True}, {"magnetic": True, "counts_per_turn": GEARED}]
)
def test_a_dead_encoder_does_not_let_the_motor_run_away(
    turning: Callable[..., Host], rpm: float, settings: dict[str, Any]
) -> None:
    host = turning(rpm, **settings)
    host.board.set("dead_encoder")
    host.board.set("no_index")
    host.run(0.3)
    stopped(host, "stall")
    assert host.board.get("fastest_rpm") < abs(rpm) + 600.0


def test_a_dead_encoder_is_told_from_a_jam_by_the_index(turning: Callable[..., Host]) -> None:
    host = turning()
    host.board.set("dead_encoder")
    host.run(0.3)
    stopped(host, "encoder lost")


@pytest.mark.parametrize("rpm", [2.0, 5.0, 20.0, -20.0, 720.0])
@pytest.mark.parametrize("magnetic", [False, True])
def test_a_jammed_shaft_is_a_stall_at_any_speed(library: Path, rpm: float, magnetic: bool) -> None:
    host = Host(load("boards").NativeBoard(library=library, magnetic=magnetic))
    host.board.set("jammed")
    host.run(0.1)
    host.command(SetSpeed(rpm, 200.0))
    host.run(0.5)
    assert (host.status.state, host.status.faults, host.board.get("driven")) == (
        3,
        FAULT["stall"],
        0.0,
    )
    # At 2 rpm, the reference takes longer to make the counts that are awaited.
    assert host.board.get("unfed_us") <= (LONGEST_UNFED_US if abs(rpm) >= 20.0 else 300_000)


@pytest.mark.parametrize("share", [0.55, 0.8])
def test_an_encoder_that_suddenly_loses_counts_stops_the_motor(
    turning: Callable[..., Host], share: float
) -> None:
    host = turning(1440.0)
    host.board.set("no_index")
    host.board.set("lost_counts", share)
    host.run(0.5)
    assert (host.status.state, host.board.get("driven")) == (3, 0.0)
    assert host.board.get("fastest_rpm") < MOST_RPM


@pytest.mark.parametrize("settings", [{}, {"magnetic": True}])
def test_counts_lost_from_the_start_are_found_by_the_voltage(
    library: Path, settings: dict[str, Any]
) -> None:
    """Without an index, 0.56 of them are seen only by the voltage that a speed takes."""
    host = Host(load("boards").NativeBoard(library=library, **settings))
    host.board.set("no_index")
    host.board.set("lost_counts", 0.56)
    host.run(0.1)
    host.command(SetSpeed(1440.0, 500.0))
    host.run(4.0)
    assert (host.status.state, host.board.get("driven")) == (3, 0.0)
    assert host.status.faults & ~FAULT["index missed"] == FAULT["stall"]
    assert host.board.get("fastest_rpm") < MOST_RPM


def test_exchanged_wires_of_the_motor_are_found_at_low_speed(library: Path) -> None:
    host = Host(load("boards").NativeBoard(library=library))
    host.board.set("reversed_motor")
    host.run(0.1)
    host.command(SetSpeed(1440.0, 5000.0))
    host.run(0.5)
    stopped(host, "over-speed")
    assert host.board.get("fastest_rpm") < 1000.0


@pytest.mark.parametrize(
    ("load_rpm_s", "heavy"), [(0.0, 0.0), (1000.0, 0.0), (0.0, 2.0), (0.0, -0.5), (2500.0, 0.0)]
)
@pytest.mark.parametrize("rpm", [120.0, -1440.0])
def test_load_and_inertia_are_no_faults(
    library: Path, rpm: float, load_rpm_s: float, heavy: float
) -> None:
    host = Host(load("boards").NativeBoard(library=library))
    host.board.set("load", load_rpm_s)
    host.board.set("heavy", heavy)
    host.run(0.1)
    for target, ramp in ((rpm, 5000.0), (-rpm, 1000.0), (0.5 * rpm, abs(rpm))):
        assert host.command(SetSpeed(target, ramp)) == 0
        host.run(3.5)
        assert (host.status.state, host.status.faults) == (1, 0)
    host.command(Stop())
    host.run(2.0)
    assert (host.status.state, host.status.faults) == (0, 0)


@pytest.mark.parametrize("rpm", [120.0, 240.0, -720.0, 1440.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_steep_ramp_does_not_overshoot(library: Path, rpm: float, seed: int) -> None:
    host = Host(load("boards").NativeBoard(library=library, seed=seed))
    host.run(0.1)
    assert host.command(SetSpeed(rpm, 1e6)) == 0
    host.run(2.0)
    assert abs(rpm) < host.board.get("fastest_rpm") < 1.12 * abs(rpm)


# The supply.


def test_a_supply_that_comes_back_does_not_start_the_motor(turning: Callable[..., Host]) -> None:
    host = turning()
    host.board.set("no_supply")
    host.run(3.0)
    # The pin is not connected
    assert (host.status.state, host.status.faults) == (
        3,
        FAULT["stall"],
    )
    before = host.board.get("rpm")
    host.board.set("no_supply", 0)
    host.run(1.0)
    assert host.board.get("rpm") <= before
    assert (host.status.state, host.board.get("driven")) == (3, 0.0)


def test_a_short_failure_of_the_supply_does_not_let_the_speed_overshoot(
    turning: Callable[..., Host],
) -> None:
    host = turning()
    host.board.set("no_supply")
    host.run(0.5)
    host.board.set("no_supply", 0)
    host.run(2.0)
    assert (host.status.state, host.status.faults) == (1, 0)
    assert host.board.get("fastest_rpm") < 1.25 * 720.0


@pytest.mark.parametrize("rpm", [720.0, -120.0])
def test_the_pin_of_the_supply_latches_at_once(turning: Callable[..., Host], rpm: float) -> None:
    host = turning(rpm)
    host.board.set("sensed")
    host.board.set("no_supply")
    host.run(0.02)
    stopped(host, "supply lost")
    assert host.command(Stop()) == 0
    host.run(0.02)
    assert host.status.faults == FAULT["supply lost"]  # it is still off
    host.board.set("no_supply", 0)
    host.run(0.3)
    assert (host.status.state, host.board.get("driven")) == (3, 0.0)
    assert host.command(Stop()) == 0
    assert host.command(SetSpeed(rpm, 1000.0)) == 0
    host.run(2.0)
    assert (host.status.state, host.status.faults) == (1, 0)
    assert host.board.get("fastest_rpm") < 1.12 * abs(rpm)


# Pulses to the camera, and gains.


@pytest.mark.parametrize(("pulses", "shortest", "longest"), [(0, 2000, 2000), (1, 1000, 2000)])
def test_the_pulse_to_the_camera_is_long_enough(
    turning: Callable[..., Host], pulses: int, shortest: int, longest: int
) -> None:
    host = turning(731.0, pulses=pulses)
    host.run(3.0)
    width = host.board.get("pulse_shortest_us"), host.board.get("pulse_longest_us")
    # The simulated motor has steps of 50 us
    assert shortest - 50 <= width[0] <= width[1] <= longest + 50


def test_gains_of_any_size_keep_their_sign(library: Path) -> None:
    gains, out = (ctypes.c_int32 * 6), (ctypes.c_int32 * 4)()
    code = ctypes.CDLL(str(library))
    for no_load, kp, ki, rise in (
        (4000, 20 * 256, 100 * 256, 150),
        (1, 1 << 30, 1 << 30, 1 << 30),
        (0, 1, 128_001, 1),
    ):
        code.board_gains(gains(no_load, 600, kp, ki, rise, 1500), out)
        forward = min(32767 * 65536 // max(no_load, 1), (1 << 31) - 1)
        expected = (forward, forward * rise, kp * 256, ki * 16777216 // 1000)
        assert list(out) == [min(value, (1 << 31) - 1) for value in expected]
