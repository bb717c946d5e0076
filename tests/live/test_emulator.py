"""The emulated controller: its motor, its messages, its answers to commands, and its faults."""

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from amiwarp import AmiwarpError, Encoder
from amiwarp.live.link import (
    Answer,
    Controller,
    ControllerStatus,
    EmulatedFault,
    FrameDecoder,
    Index,
    Message,
    Motor,
    Ping,
    Played,
    Pong,
    PseudoTerminal,
    Samples,
    SetCounts,
    SetSpeed,
    Stop,
    Sync,
    encode,
)
from amiwarp.live.link.clocks import WRAP
from amiwarp.live.link.emulator import MOST_RPM

S = 1_000_000
LONG_S = 120.0
"""Limit of waits [s]. Only a hang takes so long."""


def speeds(motor: Motor, t_us: np.ndarray) -> np.ndarray:
    """Return the motor's speed at each time [rpm]."""
    return np.asarray((motor.angle(t_us + 50) - motor.angle(t_us - 50)) / math.tau * 60e4)


def sent(controller: Controller, until_us: int, step_us: int = 10_000) -> list[Message]:
    """Return all messages that it sends. Checks that no frame is damaged or lost."""
    decoder = FrameDecoder()
    data = b"".join(controller.advance(t) for t in range(0, until_us + 1, step_us))
    found = [message for _, message in decoder.feed(data)]
    assert decoder.received.damaged == decoder.received.lost == decoder.received.unknown == 0
    return found


def counted(messages: list[Message]) -> np.ndarray:
    """Return rows (time, count) of the samples."""
    pairs = [
        p for m in messages if isinstance(m, Samples) for p in zip(m.t_us, m.count, strict=True)
    ]
    return np.array(pairs, np.int64)


def test_a_motor_goes_to_its_speed_as_its_inertia_lets_it() -> None:
    motor = Motor(0.0, inertia_s=0.2, ripple=0.0, noise=0.0)
    before = motor.angle(np.arange(0, S, 100))
    assert motor.set_speed(600.0, 1000.0, S)
    np.testing.assert_array_equal(motor.angle(np.arange(0, S, 100)), before)
    t = np.array([S + 300_000, S + 600_000, S + 600_000 + 200_000, 5 * S])
    ramp = 1000.0 * (0.3 - 0.2 * (1 - math.exp(-1.5)))  # a linear ramp, followed with a lag
    end = 1000.0 * (0.6 - 0.2 * (1 - math.exp(-3.0)))
    expected = [ramp, end, 600.0 - (600.0 - end) * math.exp(-1.0), 600.0]
    np.testing.assert_allclose(speeds(motor, t), expected, atol=0.5)
    assert (motor.target_rpm(S), motor.angle(S)) == (600.0, 0.0)


def test_a_command_during_the_ramp_goes_on_from_there() -> None:
    motor = Motor(600.0, ripple=0.0, noise=0.0)
    motor.set_speed(-600.0, 1000.0, S)
    motor.set_speed(0.0, 1000.0, 2 * S)
    t = np.arange(0, 5 * S, 1000)
    assert np.abs(np.diff(speeds(motor, t))).max() < 1.1
    assert speeds(motor, np.array([2 * S, 5 * S - 1000])) == pytest.approx([-250.0, 0.0], abs=1.0)


def test_ripple_and_noise_are_small_seeded_and_gone_at_rest() -> None:
    t = np.arange(0, 10 * S, 1000)
    noisy, even = Motor(600.0, seed=1), Motor(600.0, ripple=0.0, noise=0.0)
    share = speeds(noisy, t) / 600.0 - 1.0
    assert 0.003 < share.std() < 0.02
    assert np.abs(noisy.angle(t) - even.angle(t)).max() < 0.5
    np.testing.assert_array_equal(noisy.angle(t), Motor(600.0, seed=1).angle(t))
    assert np.abs(noisy.angle(t) - Motor(600.0, seed=2).angle(t)).max() > 1e-3
    assert np.ptp(Motor(0.0, seed=1).angle(t)) == 0.0


def test_a_recorded_rotation_is_played() -> None:
    encoder = Encoder.constant_speed(300.0, 7 * S, 9 * S)
    played = Played(encoder, start_us=S)
    t = np.arange(0, 4 * S, 7777)
    inside = (t >= S) & (t <= 3 * S)
    np.testing.assert_allclose(
        played.angle(t)[inside], encoder.angle_at(t[inside] + 6 * S), atol=1e-12
    )
    assert np.ptp(played.angle(t[t < S])) == 0.0
    assert (played.target_rpm(0), played.target_rpm(2 * S), played.target_rpm(4 * S)) == (
        0.0,
        pytest.approx(300),
        0.0,
    )
    controller = Controller(played)
    controller.feed(encode(SetSpeed(100.0, 100.0), 0) + encode(Stop(), 1), 10)
    assert [m for m in sent(controller, S) if isinstance(m, Answer)] == [Answer(0, 3), Answer(1, 3)]


@pytest.mark.parametrize("rpm", [720.0, -720.0])
def test_counts_pulses_and_status_are_those_of_the_rotor(rpm: float) -> None:
    motor = Motor(rpm)
    controller = Controller(motor, counts_per_turn=1000, drift_ppm=100.0, clock_start=WRAP - S)
    messages = sent(controller, 3 * S)
    rows = counted(messages)
    t = (rows[:, 0] + S) % WRAP  # its clock wraps a second after the start
    assert len(t) == pytest.approx(3000, abs=6)
    assert (np.diff(t) == 1000).all()
    angle = motor.angle(controller.time_at(t + WRAP - S))
    np.testing.assert_array_equal(rows[:, 1], np.floor(angle * 1000 / math.tau))
    pulses = [m for m in messages if isinstance(m, Index)]
    assert len(pulses) == pytest.approx(36, abs=1)
    assert all(m.count % 1000 == 0 for m in pulses)
    at = motor.angle(controller.time_at(np.array([(m.t_us + S) % WRAP for m in pulses]) + WRAP - S))
    np.testing.assert_allclose(at, np.round(at / math.tau) * math.tau, atol=2e-4)
    syncs = [m for m in messages if isinstance(m, Sync)]
    assert len(syncs) == pytest.approx(30, abs=4)
    assert [m.number for m in syncs] == list(range(len(syncs)))
    assert [n for n, _ in controller.pulses] == list(range(len(syncs)))
    intervals = np.diff([(m.t_us + S) % WRAP for m in syncs])
    assert set(intervals.tolist()) <= set(range(70_000, 131_000, 1000))
    assert len(set(intervals.tolist())) > 15  # irregular
    away = [
        (controller.clock(w) - m.t_us + 1) % WRAP
        for m, (_, w) in zip(syncs, controller.pulses, strict=True)
    ]
    assert max(away) <= 2
    status = [m for m in messages if isinstance(m, ControllerStatus)]
    assert 3 <= len(status) <= 5
    assert {(m.state, m.faults, m.target_rpm, m.counts_per_turn) for m in status} == {
        (1, 0, rpm, 1000)
    }
    assert all(m.rpm == pytest.approx(rpm, rel=0.03) for m in status)


def test_steps_of_any_size_send_the_same() -> None:
    a, b = (
        sent(Controller(Motor(500.0), faults=[EmulatedFault("slip", 0.5)]), S, step)
        for step in (1000, 250_000)
    )
    np.testing.assert_array_equal(counted(a), counted(b))
    assert [m for m in a if isinstance(m, Index)] == [m for m in b if isinstance(m, Index)]


def test_commands_are_obeyed_answered_and_refused() -> None:
    controller = Controller(Motor())
    controller.advance(1)
    for k, message in enumerate(
        (SetSpeed(600.0, 5000.0), SetSpeed(MOST_RPM + 1, 1.0), SetSpeed(1.0, 0.0), SetSpeed(math.nan, 1.0),
         SetCounts(0), Ping(77), Index(0, 0))
    ):  # fmt: skip
        controller.feed(encode(message, k), S)
    found = [m for _, m in FrameDecoder().feed(controller.advance(S + 1))]
    answers = [(m.sequence, m.refused) for m in found if isinstance(m, Answer)]
    assert answers == [(0, 0), (1, 2), (2, 2), (3, 2), (4, 2), (6, 1)]
    assert [m for m in found if isinstance(m, Pong)] == [Pong(77, S)]
    assert found[-1] == Answer(6, 1)
    assert any(
        isinstance(m, ControllerStatus) and (m.state, m.target_rpm) == (2, 600.0) for m in found
    )
    controller.feed(encode(SetCounts(4096), 8) + encode(SetCounts(100), 9), 3 * S)
    controller.feed(encode(Stop(), 10), 3 * S + 100_000)
    controller.feed(encode(SetCounts(100), 11), 5 * S)
    found = [m for _, m in FrameDecoder().feed(controller.advance(6 * S))]
    assert [(m.sequence, m.refused) for m in found if isinstance(m, Answer)] == [
        (8, 0),
        (9, 3),
        (10, 0),
        (11, 0),
    ]
    status = [m for m in found if isinstance(m, ControllerStatus)]
    assert (status[-1].state, status[-1].rpm, status[-1].counts_per_turn) == (
        0,
        pytest.approx(0.0, abs=1.0),
        100,
    )
    assert np.ptp(counted(found)[-100:, 1]) <= 1


def test_a_change_is_told_at_once() -> None:
    controller = Controller(Motor())
    controller.advance(1)
    controller.feed(encode(SetSpeed(600.0, 5000.0), 0), S)
    status = [
        m
        for _, m in FrameDecoder().feed(controller.advance(S + 800_000))
        if isinstance(m, ControllerStatus)
    ]
    assert [(m.state, m.target_rpm) for m in status[-2:]] == [(2, 600.0), (1, 600.0)]


def test_a_host_that_is_silent_is_told_of_and_stops_nothing() -> None:
    controller = Controller(Motor(300.0))
    messages = sent(controller, 5 * S)
    faults = {m.t_us // S: m.faults for m in messages if isinstance(m, ControllerStatus)}
    assert [faults[k] for k in (0, 1, 2, 4)] == [0, 0, 0, 16]
    assert [m.state for m in messages if isinstance(m, ControllerStatus)][-1] == 1
    controller.feed(encode(Ping(1), 0), 5 * S)
    found = [m for _, m in FrameDecoder().feed(controller.advance(5 * S))]
    assert [m.faults for m in found if isinstance(m, ControllerStatus)] == [0]


def test_faults_are_written_as_name_and_time() -> None:
    assert EmulatedFault.parse("slip@5") == EmulatedFault("slip", 5.0)
    assert EmulatedFault.parse("unplug@1.5+0.25") == EmulatedFault("unplug", 1.5, 0.25)
    assert EmulatedFault.parse("stall@3").duration_s == 2.0
    for text, says in (
        ("melt@3", "garbage, truncate"),
        ("slip", "NAME@SECONDS"),
        ("reset@1+2", "happens at once"),
    ):
        with pytest.raises(AmiwarpError, match=says):
            EmulatedFault.parse(text)
    with pytest.raises(AmiwarpError, match="reverse"):
        Controller(
            Played(Encoder.constant_speed(300.0, 0, S)), faults=[EmulatedFault("reverse", 1.0, 1.0)]
        )


def test_nothing_is_left_of_a_pseudo_terminal(tmp_path: Path) -> None:
    path = tmp_path / "prism"
    path.symlink_to(tmp_path / "gone")  # left by an emulator that was killed
    with PseudoTerminal(Controller(Motor()), path) as terminal:
        assert terminal.name == str(path)
        assert path.resolve().is_char_device()
        with pytest.raises(AmiwarpError, match="already exists"):
            PseudoTerminal(Controller(Motor()), path)
        port = path.resolve()
    with pytest.raises(AmiwarpError, match=r"there is no folder .*gone"):
        PseudoTerminal(Controller(Motor()), tmp_path / "gone" / "prism")
    assert list(tmp_path.iterdir()) == []
    assert not port.exists()
    with PseudoTerminal(Controller(Motor())) as terminal:
        assert os.path.exists(terminal.name)


def amiwarp(*args: object) -> list[str]:
    return [sys.executable, "-m", "amiwarp", *map(str, args)]


def test_emulate_and_motor_as_commands(tmp_path: Path) -> None:
    path = tmp_path / "prism"
    args = amiwarp("emulate", "--link", path, "--rpm", 300, "--fault", "slip@0.5", "--json")
    with subprocess.Popen(args, stdout=subprocess.PIPE, text=True) as emulator:
        try:
            assert emulator.stdout is not None
            started = json.loads(emulator.stdout.readline())
            assert started == {"port": str(path), "try": f"amiwarp motor status --port {path}"}
            until = time.monotonic() + LONG_S
            while True:  # without flow control, a busy machine may lose the answer
                done = subprocess.run(
                    amiwarp("motor", "set", "--rpm", "720", "--port", path), capture_output=True, text=True,
                    timeout=LONG_S,
                )  # fmt: skip
                if not re.search("no (answer|status) in", done.stderr) or time.monotonic() > until:
                    break
            assert (done.returncode, done.stderr) == (0, "")
            assert "set to 720 rpm" in done.stdout
            assert (
                f"the motor keeps turning; to stop it: amiwarp motor stop --port {path}"
                in done.stdout
            )
            emulator.send_signal(signal.SIGINT)
            assert emulator.wait(LONG_S) == 0
        finally:
            emulator.kill()
    assert list(tmp_path.iterdir()) == []
