"""``amiwarp motor``: status and speed of the prism's motor."""

from __future__ import annotations

import enum
import math
import re
import time
from dataclasses import asdict
from typing import Annotated, Any

import typer

from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.live.commands.controller import controller_summary, firmware_text, supply_text
from amiwarp.live.link.link import Link
from amiwarp.live.link.protocol import FAULTS, SETTINGS, STATES

LIMIT_RPM = 3000.0
"""Default of ``--limit-rpm``, the largest accepted speed [turns/min]."""
RAMP_RPM_S = 500.0
"""Default of ``--ramp-rpm-s``, the largest change of the speed [turns/min/s]."""
WAIT_S = 2.5
"""Longest wait for the controller's status, which is sent once a second, and for its clock [s]."""
SELF_REPORT_S = 1.0
"""Longest wait for what the controller says about itself [s]: firmware of amiwarp 0.1 does not answer the question."""
POLL_S = 0.02
"""Interval between two readings of the data that the controller has sent [s]."""
CHECK_RPM = 240.0
LEAST_CHECK_RPM = 60.0
"""Default and smallest speed of ``amiwarp motor check`` [turns/min]."""
_VERDICTS = {True: "passed", False: "FAILED", None: "skipped"}


class Action(enum.StrEnum):
    """Action of ``amiwarp motor``: print the status, set the speed, stop, show or change settings, or check."""

    STATUS = "status"
    SET = "set"
    STOP = "stop"
    SETTINGS = "settings"
    CHECK = "check"


def run_motor(
    action: Annotated[
        Action,
        typer.Argument(
            help="status: print the status; set: turn at --rpm; stop: stop the motor; settings: print the settings of "
            "the controller, or change them; check: test the controller against the serial protocol, with a turning "
            "motor."
        ),
    ],
    *,
    port: Annotated[
        str | None,
        typer.Option(
            help="Serial port of the controller: name, USB id VID:PID or URL (socket://host:port). "
            "Default: the port that sends encoder samples."
        ),
    ] = None,
    rpm: Annotated[
        float | None,
        typer.Option(
            help="Speed to set (turns/min); negative: backwards. For check: 240 by default."
        ),
    ] = None,
    ramp_rpm_s: Annotated[
        float,
        typer.Option(
            min=0.001, help="For set: largest change of the speed (turns/min per second)."
        ),
    ] = RAMP_RPM_S,
    limit_rpm: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="Largest accepted speed (turns/min): what prism, mount and bearing withstand.",
        ),
    ] = LIMIT_RPM,
    yes: Annotated[bool, typer.Option("--yes", help="For check: let the motor turn.")] = False,
    change: Annotated[
        list[str] | None,
        typer.Option(
            help="For settings: value to change, such as host-timeout=5. Can be repeated.",
            metavar="NAME=VALUE",
        ),
    ] = None,
    as_built: Annotated[
        bool,
        typer.Option(
            "--as-built",
            help="For settings: go back to the settings of the firmware's build first.",
        ),
    ] = False,
    save: Annotated[
        bool,
        typer.Option(
            "--save", help="For settings: keep them in the controller, also without power."
        ),
    ] = False,
    common: cli.Common,
) -> None:
    """Set the speed of the prism's motor, stop it, print the controller's status or settings, or check it.

    The motor keeps its last commanded speed after this command exits, unless the setting host-timeout of the controller
    says otherwise. Settings change while the prism rests, and hold until the controller's next reset unless saved. A
    check takes about half a minute, ends with a stop, and fails (status 1) if the serial protocol is violated.
    """
    if action is Action.CHECK and rpm is None:
        rpm = CHECK_RPM
    _check_speed(action, rpm, ramp_rpm_s, limit_rpm)
    if (change or as_built or save) and action is not Action.SETTINGS:
        raise AmiwarpError(
            "--change, --as-built and --save apply to 'amiwarp motor settings'; leave them out",
            ErrorCode.OPTIONS,
        )
    changes = [_parsed_change(text) for text in change or ()]
    if action is Action.CHECK:
        assert rpm is not None
        _check_motor(port, rpm, yes, common)
        return
    with Link(port) as link:
        messages: list[str] = []
        _wait(link, messages)
        if rpm is not None:
            link.set_speed(rpm, ramp_rpm_s)
            _wait(link, messages, rpm)
            _check_target(link, messages, rpm)
        elif action is Action.STOP:
            link.stop()
            _wait(link, messages, 0.0)
            _check_target(link, messages, 0.0)
        data = _described(link, messages)
        if action is Action.SETTINGS:
            _change_settings(link, changes, as_built=as_built, save=save)
            _report_settings(link, common, saved=save)
            return
    cli.report(common, data, [cli.table(_motor_rows(data)), *data["messages"], *_hint(data)])


def _check_speed(action: Action, rpm: float | None, ramp_rpm_s: float, limit_rpm: float) -> None:
    """Raise :class:`AmiwarpError` for a speed or a ramp that the action does not take, or a speed beyond the limit."""
    takes_speed = action in (Action.SET, Action.CHECK)
    if (rpm is not None) != takes_speed:
        raise AmiwarpError(
            "'amiwarp motor set' needs --rpm, the speed to set; status and stop do not accept it",
            ErrorCode.OPTIONS,
        )
    if ramp_rpm_s != RAMP_RPM_S and action is not Action.SET:
        raise AmiwarpError(
            "--ramp-rpm-s applies to 'amiwarp motor set'; to stop slowly, set --rpm 0",
            ErrorCode.OPTIONS,
        )
    if rpm is not None and not abs(rpm) <= limit_rpm:
        raise AmiwarpError(
            f"--rpm {rpm:g} is beyond the limit of {limit_rpm:g} rpm; raise --limit-rpm only if prism and mount "
            "withstand it"
        )


def _parsed_change(text: str) -> tuple[str, int]:
    """Return name and value of a setting given as ``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    if not equals or re.fullmatch(r"-?\d{1,10}", value) is None:
        raise AmiwarpError(
            f"--change {text}: give NAME=VALUE with a whole number, such as host-timeout=5"
        )
    return name, int(value)


def _change_settings(
    link: Link, changes: list[tuple[str, int]], *, as_built: bool, save: bool
) -> None:
    """Change settings in the controller, and save them."""
    if as_built:
        link.restore_settings()
    for name, value in changes:
        link.set_setting(name, value)
    if save:
        link.save_settings()


def _report_settings(link: Link, common: cli.Common, *, saved: bool) -> None:
    """Print the controller's settings."""
    values = link.settings()
    rows = []
    for setting in SETTINGS:
        allowed = f"{setting.least:,} to {setting.most:,}"
        if setting.off:
            allowed += ", or 0: off"
        rows.append((setting.name, f"{values[setting.name]:,}", setting.unit, allowed))
    data = {"port": link.name, "settings": values, "saved": saved}
    note = "changes hold until the controller's next reset; --save keeps them"
    if saved:
        note = "saved in the controller"
    cli.report(common, data, [cli.table(rows, "setting", "value", "unit", "range"), note])


def _check_motor(port: str | None, rpm: float, yes: bool, common: cli.Common) -> None:
    """Run the conformance suite and print its table; exit with status 1 if a check failed."""
    from amiwarp.live.link.conformance import check_controller
    from amiwarp.live.link.conformance_talk import Check, SerialWire

    if abs(rpm) < LEAST_CHECK_RPM:
        raise AmiwarpError(
            f"--rpm {rpm:g} is too slow for a check; give {LEAST_CHECK_RPM:g} rpm or more"
        )
    if not yes:
        raise AmiwarpError(
            f"the check turns the motor at {rpm:g} rpm; cover the prism, keep hands away, and add --yes to start it"
        )

    def say_result(check: Check) -> None:
        say(f"{check.name}: {_VERDICTS[check.passed]}")

    wire = SerialWire(port)
    try:
        checks = check_controller(wire, rpm, say_result)
    except OSError as error:
        raise AmiwarpError(
            f"{wire.name}: the port is gone, {error}; is the motor at rest?", ErrorCode.UNREACHABLE
        ) from error
    finally:
        wire.close()
    failed = [check for check in checks if check.passed is False]
    rows = [(check.name, _VERDICTS[check.passed], check.measured) for check in checks]
    verdict = f"{len(failed)} of {len(checks)} checks failed" if failed else "the controller passes"
    remedies = [f"{check.name}: {check.remedy}" for check in failed]
    data = {
        "port": wire.name,
        "rpm": rpm,
        "passed": not failed,
        "checks": [asdict(check) for check in checks],
    }
    cli.report(
        common, data, [cli.table(rows, "check", "result", "measured"), "", *remedies, verdict]
    )
    if failed:
        raise typer.Exit(1)


def _wait(link: Link, messages: list[str], target: float | None = None) -> None:
    """Wait until the status reports the target speed and the controller's clock is known, or :data:`WAIT_S` passed."""
    start_s = time.monotonic()
    while time.monotonic() < start_s + WAIT_S:
        messages += link.poll().messages
        status = link.status
        has_target = status is not None and (
            target is None or math.isclose(status.target_rpm, target, rel_tol=1e-6)
        )
        has_reported_itself = link.older or link.condition is not None
        gives_up_report = time.monotonic() > start_s + SELF_REPORT_S
        if has_target and (has_reported_itself or gives_up_report) and link.clock() is not None:
            return
        time.sleep(POLL_S)


def _check_target(link: Link, messages: list[str], target: float) -> None:
    """Raise :class:`AmiwarpError` if the controller no longer has the speed that it accepted, as after a reset."""
    status = link.status
    if status is None or math.isclose(status.target_rpm, target, rel_tol=0.01, abs_tol=1.0):
        return
    faults = _fault_names(status.faults)
    details = "; ".join([*messages, *(f"fault: {name}" for name in faults)]) or "was it reset?"
    now_rpm = status.target_rpm
    raise AmiwarpError(
        f"{link.name}: the controller accepted {target:g} rpm, but its target is now {now_rpm:g} rpm; {details}"
    )


def _fault_names(faults: int) -> list[str]:
    """Return the names of the faults in a status's bit field."""
    return [name for bit, name in enumerate(FAULTS) if faults >> bit & 1]


def _described(link: Link, messages: list[str]) -> dict[str, Any]:
    """Return the motor's state and what the controller says about itself, for ``--json``.

    Raises :class:`AmiwarpError` if no status has come.
    """
    status = link.status
    if status is None:
        details = "; ".join(
            [*messages, "docs/reference/link-protocol.md describes the messages it must send"]
        )
        raise AmiwarpError(
            f"{link.name}: no status in {WAIT_S:g} s; {details}", ErrorCode.UNREACHABLE
        )
    state = f"unknown ({status.state})"
    if status.state < len(STATES):
        state = STATES[status.state]
    return {
        "port": link.name,
        "state": state,
        "rpm": status.rpm,
        "target_rpm": status.target_rpm,
        "counts_per_turn": status.counts_per_turn,
        "faults": _fault_names(status.faults),
        "answers": link.clock() is not None,
        **controller_summary(link),
        "messages": messages,
    }


def _without_host_text(motor: dict[str, Any]) -> str:
    """Return what the motor does if no host speaks to the controller."""
    if motor["host_timeout_s"] is None:
        return "the motor goes on" if motor["older_than_1_1"] else "unknown"
    if not motor["host_timeout_s"]:
        return "the motor goes on"
    stops = (
        f"; stops since the controller's start: {motor['host_stops']:,}"
        if motor["host_stops"]
        else ""
    )
    return f"the motor stops after {motor['host_timeout_s']} s{stops}"


def _motor_rows(motor: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the printed table."""
    port = motor["port"]
    if not motor["answers"]:
        port += " (sends data, but does not answer commands)"
    return [
        ("port", port),
        ("state", motor["state"]),
        ("speed", f"{motor['rpm']:.1f} rpm, set to {motor['target_rpm']:g} rpm"),
        ("encoder", f"{motor['counts_per_turn']:,} counts per turn"),
        ("faults", ", ".join(motor["faults"]) or "none"),
        ("firmware", firmware_text(motor)),
        ("supply", supply_text(motor)),
        ("without a host", _without_host_text(motor)),
        ("settings", motor["settings"] or "unknown"),
    ]


def _hint(motor: dict[str, Any]) -> list[str]:
    """Return a line about a motor that turns: how to stop it, or when it stops by itself."""
    if not motor["target_rpm"]:
        return []
    if motor["host_timeout_s"]:
        return [
            f"the motor stops {motor['host_timeout_s']} s after this command ends, if no other host speaks to it"
        ]
    return [f"the motor keeps turning; to stop it: amiwarp motor stop --port {motor['port']}"]
