"""What a prism controller says about itself, for the results of commands."""

from __future__ import annotations

from typing import Any

from amiwarp.live.link.link import Link
from amiwarp.live.link.protocol import STORED


def controller_lines(controller: dict[str, Any] | None) -> list[str]:
    """Return the line of the result about the controller."""
    if controller is None:
        return []
    return [f"controller: firmware {firmware_text(controller)}, supply {supply_text(controller)}"]


def controller_summary(link: Link) -> dict[str, Any]:
    """Return what the controller says about itself; None for all that is unknown."""
    identity = link.identity
    condition = link.condition
    summary: dict[str, Any] = {
        "firmware": None if identity is None else identity.version,
        "board": None if identity is None else identity.board_name,
        "older_than_1_1": link.older,
        "supply_v": None,
        "host_timeout_s": None,
        "host_stops": None,
        "settings": None,
    }
    if condition is not None:
        summary["supply_v"] = condition.supply_v
        summary["host_timeout_s"] = condition.host_timeout_s
        summary["host_stops"] = condition.host_stops
        known = condition.stored < len(STORED)
        summary["settings"] = STORED[condition.stored] if known else f"unknown ({condition.stored})"
    return summary


def firmware_text(summary: dict[str, Any]) -> str:
    """Return firmware and board of a :func:`controller_summary` as text."""
    if summary["firmware"] is not None:
        return f"{summary['firmware']} on {summary['board'] or 'a board without a name'}"
    return "older than 1.1" if summary["older_than_1_1"] else "unknown: it does not say"


def supply_text(summary: dict[str, Any]) -> str:
    """Return the motor's supply voltage of a :func:`controller_summary` as text."""
    if summary["supply_v"] is not None:
        return f"{summary['supply_v']:.1f} V"
    return "unknown" if summary["firmware"] is None else "unknown: its pin is not connected"
