"""``amiwarp motor``: status and speed of the prism's motor."""

import enum
import math
import time
from typing import Annotated, Any

import typer

from amiwarp.cli.console import report, table
from amiwarp.cli.options import Common
from amiwarp.errors import AmiwarpError
from amiwarp.live.link.link import Link
from amiwarp.live.link.protocol import FAULTS, STATES

EXAMPLE = "amiwarp motor set --port /dev/ttyACM0 --rpm 720"
LIMIT_RPM = 3000.0
"""Default of ``--limit-rpm``, the largest accepted speed [turns/min]."""
WAIT_S = 2.5
"""Longest wait for the controller's status, which is sent once a second, and for its clock [s]."""
STEP_S = 0.02
"""Interval between two readings of the data that the controller has sent [s]."""


class Action(enum.StrEnum):
    """Action of ``amiwarp motor``: print the status, set the speed, or stop."""

    STATUS = "status"
    SET = "set"
    STOP = "stop"


def run(
    action: Annotated[
        Action, typer.Argument(help="status: print the status; set: turn at --rpm; stop: stop the motor.")
    ],
    *,
    port: Annotated[
        str | None,
        typer.Option(
            help="Serial port of the controller: name, USB id VID:PID or URL (socket://host:port). "
            "Default: the port that sends encoder samples."
        ),
    ] = None,
    rpm: Annotated[float | None, typer.Option(help="Speed to set (turns/min); negative: backwards.")] = None,
    ramp_rpm_s: Annotated[
        float, typer.Option(min=0.001, help="Largest change of the speed (turns/min per second).")
    ] = 500.0,
    limit_rpm: Annotated[
        float,
        typer.Option(min=0.0, help="Largest accepted speed (turns/min): what prism, mount and bearing withstand."),
    ] = LIMIT_RPM,
    common: Common,
) -> None:
    """Set the speed of the prism's motor, stop it, or print the controller's status.

    The motor keeps its last commanded speed after this command exits.
    """
    if (rpm is None) == (action is Action.SET):
        raise AmiwarpError("'amiwarp motor set' needs --rpm, the speed to set; status and stop do not accept it")
    if rpm is not None and not abs(rpm) <= limit_rpm:
        raise AmiwarpError(
            f"--rpm {rpm:g} is beyond the limit of {limit_rpm:g} rpm; raise --limit-rpm only if prism and mount "
            "withstand it"
        )
    with Link(port) as link:
        messages: list[str] = []
        _wait(link, messages)
        if rpm is not None:
            link.set_speed(rpm, ramp_rpm_s)
            _wait(link, messages, rpm)
        elif action is Action.STOP:
            link.stop()
            _wait(link, messages, 0.0)
        data = _described(link, messages)
    report(common, data, [table(_rows(data)), *data["messages"], *_hint(data)])


def _wait(link: Link, messages: list[str], target: float | None = None) -> None:
    """Wait until the status reports the target speed and the controller's clock is known, or :data:`WAIT_S` passed."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        messages += link.poll().messages
        status = link.status
        reported = status is not None and (target is None or math.isclose(status.target_rpm, target, rel_tol=1e-6))
        if reported and link.clock() is not None:
            return
        time.sleep(STEP_S)


def _described(link: Link, messages: list[str]) -> dict[str, Any]:
    status = link.status
    if status is None:
        details = "; ".join([*messages, "docs/reference/link-protocol.md describes the messages it must send"])
        raise AmiwarpError(f"{link.name}: no status in {WAIT_S:g} s; {details}")
    return {
        "port": link.name,
        "state": STATES[status.state] if status.state < len(STATES) else f"unknown ({status.state})",
        "rpm": status.rpm,
        "target_rpm": status.target_rpm,
        "counts_per_turn": status.counts_per_turn,
        "faults": [name for bit, name in enumerate(FAULTS) if status.faults >> bit & 1],
        "answers": link.clock() is not None,
        "messages": messages,
    }


def _rows(d: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        ("port", d["port"] + ("" if d["answers"] else " (sends data, but does not answer commands)")),
        ("state", d["state"]),
        ("speed", f"{d['rpm']:.1f} rpm, set to {d['target_rpm']:g} rpm"),
        ("encoder", f"{d['counts_per_turn']:,} counts per turn"),
        ("faults", ", ".join(d["faults"]) or "none"),
    ]


def _hint(d: dict[str, Any]) -> list[str]:
    """Return a line that tells how to stop the motor, if it keeps turning."""
    return [f"the motor keeps turning; to stop it: amiwarp motor stop --port {d['port']}"] if d["target_rpm"] else []
