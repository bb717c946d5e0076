"""``amiwarp motor``: what the prism's motor does, a speed for it, and rest."""

from __future__ import annotations

import enum
import math
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli.console import report, table
from amiwarp.cli.options import Common
from amiwarp.errors import AmiwarpError
from amiwarp.live.link.link import Link
from amiwarp.live.link.protocol import FAULTS, STATES

if TYPE_CHECKING:
    from amiwarp.live.link.link import Link

EXAMPLE = "amiwarp motor set --port /dev/ttyACM0 --rpm 720"
LIMIT_RPM = 3000.0
WAIT_S = 2.5
"""For the status, which comes once a second, and for the clocks."""
STEP_S = 0.02


class Action(enum.StrEnum):
    """What to do."""

    STATUS = "status"
    SET = "set"
    STOP = "stop"


def run(
    action: Annotated[Action, typer.Argument(help="status: look only; set: turn at --rpm; stop: come to rest.")],
    *,
    port: Annotated[
        str | None,
        typer.Option(help="Name, or USB id VID:PID, or URL (socket://host:port). Default: the one that sends samples."),
    ] = None,
    rpm: Annotated[float | None, typer.Option(help="Speed to set (turns/min), negative: backwards.")] = None,
    ramp_rpm_s: Annotated[
        float, typer.Option(min=0.001, help="How quickly the speed changes (turns/min each second).")
    ] = 500.0,
    limit_rpm: Annotated[
        float, typer.Option(min=0.0, help="Speeds beyond it are refused: what prism, mount and bearing bear.")
    ] = LIMIT_RPM,
    common: Common,
) -> None:
    """Drive the prism's motor, and see what its controller says. The motor goes on as told when this ends."""
    if (rpm is None) == (action is Action.SET):
        raise AmiwarpError("--rpm is the speed to set; 'amiwarp motor set' needs it and nothing else takes it")
    if rpm is not None and not abs(rpm) <= limit_rpm:
        raise AmiwarpError(
            f"--rpm {rpm:g} is beyond the limit of {limit_rpm:g} rpm; --limit-rpm raises it where the prism bears it"
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
    """Until the status is known and names the target speed, and pings were answered; or for :data:`WAIT_S`."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        messages += link.poll().messages
        status = link.status
        named = status is not None and (target is None or math.isclose(status.target_rpm, target, rel_tol=1e-6))
        if named and link.clock() is not None:
            return
        time.sleep(STEP_S)


def _described(link: Link, messages: list[str]) -> dict[str, Any]:
    status = link.status
    if status is None:
        said = "; ".join([*messages, "docs/link-protocol.md says what it is to send"])
        raise AmiwarpError(f"{link.name}: no status in {WAIT_S:g} s; {said}")
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
        ("port", d["port"] + ("" if d["answers"] else " (it sends, but does not answer)")),
        ("state", d["state"]),
        ("speed", f"{d['rpm']:.1f} rpm, set to {d['target_rpm']:g} rpm"),
        ("encoder", f"{d['counts_per_turn']:,} counts a turn"),
        ("faults", ", ".join(d["faults"]) or "none"),
    ]


def _hint(d: dict[str, Any]) -> list[str]:
    """Nothing turns on in silence."""
    return [f"it goes on turning; to end that: amiwarp motor stop --port {d['port']}"] if d["target_rpm"] else []
