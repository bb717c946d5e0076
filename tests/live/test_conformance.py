"""The conformance suite: the emulator passes it, and each check fails for the fault that it is for."""

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from amiwarp import ErrorCode
from amiwarp.cli.common import command as register
from amiwarp.live import commands as rig
from amiwarp.live.link import (
    Controller,
    EmulatedFault,
    Motor,
    PseudoTerminal,
    check_controller,
    conformance_talk,
    protocol,
)
from amiwarp.live.link.conformance_talk import SerialWire
from tests.errors import refused
from tests.rig_world import LONG_S

Edit = Callable[[int, protocol.Message], Iterable[tuple[int, protocol.Message]]]


class VirtualWire:
    """A controller in simulated time. ``edit`` changes the messages that it sends."""

    name = "virtual"

    def __init__(self, controller: Any, edit: Edit | None = None) -> None:
        self.controller, self._edit, self._now = controller, edit, 0
        self._decoder = protocol.FrameDecoder()

    def now_us(self) -> int:
        return self._now

    def read(self) -> bytes:
        self._now += 5000
        data: bytes = self.controller.advance(self._now)
        if self._edit is None:
            return data
        sent = [
            pair for number, m in self._decoder.feed(data) for pair in self._edit(number or 0, m)
        ]
        return b"".join(protocol.encode(message, number) for number, message in sent)

    def write(self, data: bytes) -> None:
        self.controller.feed(data, self._now)

    def reopen(self) -> bool:
        return True

    def close(self) -> None:
        pass


def emulated(*faults: str, rpm: float = 0.0, **settings: float) -> Controller:
    return Controller(Motor(rpm), faults=[EmulatedFault.parse(f) for f in faults], **settings)  # type: ignore[arg-type]


def failures(wire: VirtualWire, rpm: float = 240.0) -> list[str]:
    return [check.name for check in check_controller(wire, rpm) if check.passed is False]


@pytest.mark.parametrize(("rpm", "at_first"), [(-600.0, 0.0), (240.0, 500.0)])
def test_the_emulator_passes(rpm: float, at_first: float) -> None:
    controller = emulated(rpm=at_first, drift_ppm=80.0, clock_start=(1 << 32) - 9_000_000)
    checks = check_controller(VirtualWire(controller), rpm)
    assert [check.name for check in checks if not check.passed] == []
    assert len(checks) == 28
    assert controller.rotor.target_rpm(10**9) == 0.0


def test_settings_of_before_are_those_after_the_suite() -> None:
    """Also a time-out that is shorter than the silence of the suite, and limits that are off."""
    controller = emulated()
    controller.settings |= {
        "host-timeout": 1,
        "undervoltage": 0,
        "overvoltage": 0,
        "kp": 0,
        "most-rpm": 13_000,
    }
    before = dict(controller.settings)
    assert failures(VirtualWire(controller)) == []
    assert controller.settings == before


@pytest.mark.parametrize("rpm", [240.0, -240.0, 60.0])
def test_a_perfectly_steady_controller_passes(rpm: float) -> None:
    """Its index pulses are whole milliseconds apart, as if its clock had such steps."""
    steady = Controller(Motor(0.0, inertia_s=1e-6, ripple=0.0, noise=0.0))
    assert [
        check.name for check in check_controller(VirtualWire(steady), rpm) if not check.passed
    ] == []


def test_an_older_controller_is_named_and_passes() -> None:
    class Older(Controller):
        """Skips unknown commands, as the emulator of amiwarp 0.1 did."""

        def _execute(self, sequence: int, message: protocol.Message | None) -> None:
            known = protocol.Ping | protocol.SetSpeed | protocol.Stop | protocol.SetCounts
            if isinstance(message, known):
                super()._execute(sequence, message)

    checks = check_controller(VirtualWire(Older(Motor(0.0))), 240.0)
    assert [check.name for check in checks if check.passed is False] == []
    unsure = {check.name: check.measured for check in checks if check.passed is None}
    assert list(unsure) == [
        "says what it is", "keeps settings within their ranges", "answers unknown commands",
        "stops for a lost host, if told so",
    ]  # fmt: skip
    assert "an older controller" in unsure["answers unknown commands"]
    assert unsure["says what it is"] == "answer none: older than firmware 1.1"


def test_firmware_1_0_is_named_and_passes() -> None:
    class Older(Controller):
        """Answers 1 to what it does not know, as firmware 1.0."""

        def _execute(self, sequence: int, message: protocol.Message | None) -> None:
            known = protocol.Ping | protocol.SetSpeed | protocol.Stop | protocol.SetCounts
            super()._execute(sequence, message if isinstance(message, known) else None)

    checks = check_controller(VirtualWire(Older(Motor(0.0))), 240.0)
    unsure = {check.name: check.measured for check in checks if not check.passed}
    assert set(unsure.values()) == {"answer 1: older than firmware 1.1", "older than firmware 1.1"}


@pytest.mark.parametrize(
    ("controller", "failed"),
    [
        (
            emulated("missed-index@0+99", sample_hz=500.0),
            {"encoder samples at 1 kHz", "one index pulse per turn"},
        ),
        (emulated("crc@2.5+1"), {"no frame is damaged or lost"}),
        (
            emulated("reset@7", sync_hz=100.0),
            {"times increase", "sync pulses", "no frame is damaged or lost"},
        ),
        (
            emulated("stall@3+60", drift_ppm=20_000.0),
            {"its clock counts microseconds", "keeps its speed"},
        ),
    ],
    ids=("slow", "noise", "reset", "stall"),
)
def test_a_fault_fails_its_checks(controller: Controller, failed: set[str]) -> None:
    found = set(failures(VirtualWire(controller)))
    assert failed <= found
    assert len(found) < 10


def edited(**changed: Callable[[Any], protocol.Message | None]) -> Edit:
    """Replace messages by the name of their class; a function that returns None drops the message."""

    def edit(number: int, message: protocol.Message) -> Iterable[tuple[int, protocol.Message]]:
        new = changed.get(type(message).__name__, lambda m: m)(message)
        return [] if new is None else [(number, new)]

    return edit


def status(m: protocol.ControllerStatus, **fields: Any) -> protocol.ControllerStatus:
    from dataclasses import replace

    return replace(m, **fields)


@pytest.mark.parametrize(
    ("edit", "failed"),
    [
        (
            edited(ControllerStatus=lambda m: status(m, counts_per_turn=0), Index=lambda m: None, Sync=lambda m: None),
            {"status once per second", "one index pulse per turn"},
        ),
        (
            edited(
                ControllerStatus=lambda m: status(m, faults=m.faults & 15, state=2),
                Pong=lambda m: None,
                Answer=lambda m: protocol.Answer(m.sequence, 0),
                Sync=lambda m: protocol.Sync(m.t_us, 2 * m.number),
                Index=lambda m: protocol.Index(m.t_us // 4 * 4, m.count),
            ),
            {
                "answers pings", "refuses what is out of range", "ignores bad frames", "notices a silent host", "stops",
                "rests after a stop", "keeps its speed", "sync pulses", "latches time and count together",
            },
        ),
        (
            edited(
                ControllerStatus=lambda m: status(m, target_rpm=7.0),
                Index=lambda m: protocol.Index(m.t_us - 9000, m.count + 9),
                Samples=lambda m: protocol.Samples(m.t_us, tuple(-c for c in m.count)),
            ),
            {"accepts a speed", "ignores bad frames", "times increase", "follows the ramp", "keeps its speed"},
        ),
    ],
    ids=("status", "answers", "motion"),
)  # fmt: skip
def test_wrong_messages_fail_their_checks(edit: Edit, failed: set[str]) -> None:
    assert failed <= set(failures(VirtualWire(emulated(), edit)))


def test_a_controller_that_stops_at_unknown_commands_fails() -> None:
    class Obeying(Controller):
        """Takes commands that it does not know, or whose payload has another size, for a stop."""

        def _execute(self, sequence: int, message: protocol.Message | None) -> None:
            super()._execute(sequence, protocol.Stop() if message is None else message)

    failed = failures(VirtualWire(Obeying(Motor(0.0))))
    assert {"ignores bad frames", "answers unknown commands"} <= set(failed)


def test_a_silent_port_ends_the_suite_early() -> None:
    class Silent:
        def advance(self, now_us: int) -> bytes:
            return b"\1\2\3" if now_us % 100_000 == 0 else b""

        def feed(self, data: bytes, now_us: int) -> None:
            pass

    checks = check_controller(VirtualWire(Silent()), 240.0)
    assert [(check.name, check.passed) for check in checks] == [("frames arrive", False)]


def test_a_board_that_resets_when_the_port_is_opened_fails() -> None:
    class Resetting(VirtualWire):
        def reopen(self) -> bool:
            self.controller._boot(0)
            return True

    found = failures(Resetting(emulated()))
    assert "runs on when the port is opened" in found


# The command.


def motor(*args: object) -> Any:
    app = typer.Typer()
    register(app, rig.run_motor, name="motor", example="")
    return CliRunner().invoke(app, [str(a) for a in args])


def test_the_command_prints_a_table_and_ends_with_status_1_for_a_failure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    controllers = [emulated(), emulated(sync_hz=100.0)]
    monkeypatch.setattr(
        conformance_talk, "SerialWire", lambda port: VirtualWire(controllers.pop(0))
    )
    data = json.loads(motor("check", "--port", "p", "--yes", "--rpm", -120, "--json").stdout)
    assert (data["passed"], data["rpm"], len(data["checks"])) == (True, -120.0, 28)
    done = motor("check", "--port", "p", "--yes")
    assert done.exit_code == 1
    assert "1 of 28 checks failed" in done.stdout
    assert "sync pulses: send a pulse every 70 to 130 ms, drawn at random for each" in done.stdout


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ((), "add --yes to start it"), (("--yes", "--rpm", 5), "too slow"), (("--yes", "--rpm", math.nan), "beyond"),
        (("--yes", "--rpm", 200, "--limit-rpm", 100), "beyond the limit"),
    ],
)  # fmt: skip
def test_the_command_does_not_turn_the_motor_unasked(args: tuple[object, ...], says: str) -> None:
    done = motor("check", "--port", "/dev/nothing", *args)
    assert done.exit_code == 1
    assert says in str(done.exception)


def test_a_port_is_read_written_and_opened_again(tmp_path: Path) -> None:
    path = tmp_path / "prism"
    with PseudoTerminal(Controller(Motor(0.0)), path):
        wire = SerialWire(str(path))
        try:
            for _ in range(2):
                decoder, end = protocol.FrameDecoder(), wire.now_us() + LONG_S * 1e6
                wire.write(protocol.encode(protocol.Ping(77), 0))
                while not any(isinstance(m, protocol.Pong) for _, m in decoder.feed(wire.read())):
                    assert wire.now_us() < end
                assert wire.reopen()
        finally:
            wire.close()
    with refused(ErrorCode.UNREACHABLE):
        SerialWire(str(path))
