"""What the link learns about its controller, and how it keeps a controller's motor turning."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from amiwarp import AmiwarpError
from amiwarp.cli.common import command as register
from amiwarp.live.commands import motor as command
from amiwarp.live.link import (
    Condition,
    Controller,
    ControllerStatus,
    Follower,
    FrameDecoder,
    Identity,
    Link,
    Motor,
    Ping,
    PseudoTerminal,
    encode,
    protocol,
)
from amiwarp.live.link import link as link_module
from tests.live.test_link import wait
from tests.rig_world import LONG_S

OLD = protocol.Ping | protocol.SetSpeed | protocol.Stop | protocol.SetCounts
"""Commands of firmware 1.0."""


class Refusing(Controller):
    """Answers 1 to what firmware 1.0 does not know."""

    def _execute(self, sequence: int, message: protocol.Message | None) -> None:
        super()._execute(sequence, message if isinstance(message, OLD) else None)


class Silent(Controller):
    """Skips what it does not know, as firmware of amiwarp 0.1."""

    def _execute(self, sequence: int, message: protocol.Message | None) -> None:
        if isinstance(message, OLD):
            super()._execute(sequence, message)


@pytest.fixture(params=[Controller])
def port(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Any]:
    """A controller of the class in ``request.param`` behind a port; its supply has 12.3 V."""
    monkeypatch.setattr(link_module, "ANSWER_S", LONG_S)
    controller = request.param(Motor(0.0), sample_hz=50.0, supply_mv=12_340)
    with PseudoTerminal(controller, tmp_path / "prism") as terminal:
        yield terminal


def motor(*args: object) -> Any:
    app = typer.Typer()
    register(app, command.run_motor, name="motor", example="")
    return CliRunner().invoke(app, [str(a) for a in args])


def test_a_link_knows_firmware_board_and_supply(port: PseudoTerminal) -> None:
    with Link(port.name) as link:
        wait(lambda: link.condition is not None)
        assert link.identity is not None
        assert (link.identity.version, link.identity.board_name, link.older) == (
            "1.1.0",
            "emulated",
            False,
        )
        assert link.condition is not None
        assert (link.condition.supply_v, link.condition.host_stops) == (12.34, 0)
        port._controller.supply_mv = None
        wait(lambda: link.condition is not None and link.condition.supply_v is None)


@pytest.mark.parametrize(("port", "older"), [(Refusing, True), (Silent, False)], indirect=["port"])
def test_an_older_controller_is_named_and_nothing_is_guessed(
    port: PseudoTerminal, older: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Link(port.name) as link:
        wait(lambda: link.clock() is not None)
        if older:
            wait(lambda: link.older)
        assert (link.identity, link.condition, link.older) == (None, None, older)
        monkeypatch.setattr(link_module, "ANSWER_S", LONG_S if older else 0.05)
        with pytest.raises(
            AmiwarpError,
            match="refused by the controller, unknown command" if older else "no answer",
        ):
            link.settings()
    done = motor("status", "--port", port.name)
    assert done.exit_code == 0
    assert (
        f"firmware        {'older than 1.1' if older else 'unknown: it does not say'}"
        in done.stdout
    )
    assert "supply          unknown\n" in done.stdout
    data = json.loads(motor("status", "--port", port.name, "--json").stdout)
    assert (data["firmware"], data["board"], data["supply_v"], data["host_timeout_s"]) == (
        None,
    ) * 4
    assert data["older_than_1_1"] is older


def test_the_status_shows_what_the_controller_says(port: PseudoTerminal) -> None:
    done = motor("status", "--port", port.name)
    assert "firmware        1.1.0 on emulated" in done.stdout
    assert "supply          12.3 V" in done.stdout
    assert "without a host  the motor goes on" in done.stdout
    assert "settings        as built" in done.stdout
    data = json.loads(motor("status", "--port", port.name, "--json").stdout)
    assert (data["firmware"], data["board"], data["supply_v"]) == ("1.1.0", "emulated", 12.34)
    assert (data["host_timeout_s"], data["host_stops"], data["settings"]) == (0, 0, "as built")
    port._controller.supply_mv = None
    assert (
        "supply          unknown: its pin is not connected"
        in motor("status", "--port", port.name).stdout
    )


def test_settings_are_read_changed_saved_and_restored(port: PseudoTerminal) -> None:
    with Link(port.name) as link:
        wait(lambda: link.clock() is not None)  # settings change 0.1 s after the controller's start
        before = link.settings()
        assert list(before) == [setting.name for setting in protocol.SETTINGS]
        link.set_setting("kp", 4000)
        link.set_setting("undervoltage", 0)
        assert link.settings() == before | {"kp": 4000, "undervoltage": 0}
        link.save_settings()
        wait(lambda: link.condition is not None and link.condition.stored == 1)
        link.restore_settings()
        assert link.settings() == before
        for name, value, says in (
            ("Kp", 1, "there is none of this name; give one of counts-per-turn, most-rpm"),
            ("kp", -1, "setting kp = -1: give 0 to 1000000 duty/rpm/256"),
            ("host-timeout", 3601, r"give 0 \(off\), or 1 to 3600 s"),
        ):
            with pytest.raises(AmiwarpError, match=says):
                link.set_setting(name, value)
        link.set_speed(300.0, 10_000.0)
        with pytest.raises(
            AmiwarpError, match=r"set kp = 1: refused by the controller, not possible now; .*rest"
        ):
            link.set_setting("kp", 1)


def test_a_setting_that_is_damaged_on_its_way_is_not_guessed(port: PseudoTerminal) -> None:
    """Neither when settings are read for the first time, nor later, when an earlier value is known."""
    damaged = [True]
    kp = [setting.name for setting in protocol.SETTINGS].index("kp")
    send = port._controller._send

    def send_damaged(message: protocol.Message) -> None:
        if not (damaged[0] and isinstance(message, protocol.Setting) and message.key == kp):
            send(message)

    port._controller._send = send_damaged  # type: ignore[method-assign]
    with Link(port.name) as link:
        wait(lambda: link.clock() is not None)
        for _ in range(2):
            damaged[0] = True
            with pytest.raises(AmiwarpError, match=r"setting kp: .* damaged on the line; read"):
                link.settings()
            damaged[0] = False
            link.settings()


def test_the_command_shows_changes_and_saves_settings(port: PseudoTerminal) -> None:
    done = motor(
        "settings", "--port", port.name, "--change", "host-timeout=5", "--change", "kp=100"
    )
    assert done.exit_code == 0
    lines = [line.split() for line in done.stdout.splitlines()]
    assert ["kp", "100", "duty/rpm/256", "0", "to", "1,000,000"] in lines
    assert ["host-timeout", "5", "s", "1", "to", "3,600,", "or", "0:", "off"] in lines
    assert "--save keeps them" in done.stdout
    data = json.loads(
        motor(
            "settings", "--port", port.name, "--as-built", "--change", "ki=7", "--save", "--json"
        ).stdout
    )
    assert (data["settings"]["kp"], data["settings"]["ki"], data["saved"]) == (5120, 7, True)
    assert "settings        saved" in motor("status", "--port", port.name).stdout
    for arguments, says in (
        (("status", "--save"), "apply to 'amiwarp motor settings'"),
        (("set", "--rpm", 5, "--change", "kp=1"), "apply to 'amiwarp motor settings'"),
        (("settings", "--change", "kp"), "--change kp: give NAME=VALUE with a whole number"),
        (("settings", "--change", "kp=1.5"), "give NAME=VALUE with a whole number"),
        (("settings", "--change", "no=1"), "there is none of this name"),
    ):
        failed = motor(*arguments, "--port", port.name)
        assert failed.exit_code != 0
        assert says in str(failed.exception) + failed.output


def test_the_link_pings_often_enough_for_the_time_out(port: PseudoTerminal) -> None:
    """Four times within it, so that one or two may be lost; once per second else."""
    with Link(port.name) as link:
        wait(lambda: link.clock() is not None)
        link.set_setting("host-timeout", 1)
        wait(lambda: link.condition is not None and link.condition.host_timeout_s == 1)
        link.set_speed(300.0, 10_000.0)
        pings: list[int] = []
        decoder, feed = FrameDecoder(), port._controller.feed

        def seen(data: bytes, now_us: int) -> None:
            pings.extend([now_us] * sum(isinstance(m, Ping) for _, m in decoder.feed(data)))
            feed(data, now_us)

        port._controller.feed = seen  # type: ignore[method-assign]
        wait(lambda: len(pings) > 12)
        steps = [b - a for a, b in itertools.pairwise(pings[4:])]
        assert 100_000 < sorted(steps)[len(steps) // 2] < 500_000
        assert link.condition is not None
        assert link.condition.host_stops == 0
        assert link.status is not None
        assert link.status.target_rpm == 300.0
    done = motor("set", "--rpm", 200, "--port", port.name)
    assert "the motor stops 1 s after this command ends" in done.stdout


def test_a_speed_that_the_controller_accepts_and_loses_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a controller does that is reset just after its answer."""

    class Forgetful(Controller):
        def _execute(self, sequence: int, message: protocol.Message | None) -> None:
            if isinstance(message, protocol.SetSpeed):
                message = protocol.SetSpeed(0.0, message.ramp)
                monkeypatch.setattr(command, "WAIT_S", 0.0)  # its status comes no more
            super()._execute(sequence, message)

    monkeypatch.setattr(link_module, "ANSWER_S", LONG_S)
    errors = []
    for rpm in (300.0, 0.0):
        monkeypatch.setattr(command, "WAIT_S", LONG_S)
        with PseudoTerminal(Forgetful(Motor(0.0), sample_hz=50.0), tmp_path / "prism") as port:
            done = motor("set", "--rpm", rpm, "--port", port.name)
        errors.append(str(done.exception or ""))
    assert "accepted 300 rpm, but its target is now 0 rpm" in errors[0]
    assert errors[1] == ""


def test_a_restart_that_keeps_the_speed_is_no_loss_of_it() -> None:
    follower = Follower("port")
    follower.opened(0)
    said = []
    for sequence, target in ((500, 300.0), (300, 300.0), (100, 0.0)):
        follower.feed(encode(ControllerStatus(0, 0, 0, 0.0, target, 4096), sequence), 100)
        said.append([m for m in follower.take().messages if "no longer" in m])
    assert said == [[], [], ["the motor no longer has its speed of 300 rpm; set it again"]]


def test_what_is_known_is_forgotten_when_the_port_is_opened_again() -> None:
    follower = Follower("port")
    follower.opened(0)
    who = Identity(2, 3, 4, b"other".ljust(16, b"\0"))
    status = ControllerStatus(0, 0, 0, 0.0, 0.0, 4096)
    setting = protocol.Setting(0, 4096)
    for number, message in enumerate((status, who, Condition(5, 11_900, 4, 2, 3), setting)):
        follower.feed(encode(message, number), 100)
    assert follower.settings == {0: 4096}
    assert follower.identity == who
    assert follower.condition is not None
    assert follower.condition.supply_v == 11.9
    follower.older = True
    follower.opened(200)
    assert (follower.identity, follower.condition, follower.older) == (None, None, False)
    assert follower.settings == {}


def test_an_unknown_supply_is_not_zero_volts() -> None:
    assert Condition(0, protocol.UNKNOWN_MV, 0, 0, 0).supply_v is None
    assert Condition(0, 0, 0, 0, 0).supply_v == 0.0
