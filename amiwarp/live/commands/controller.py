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
    who = link.identity
    condition = link.condition
    told: dict[str, Any] = {
        "firmware": None if who is None else who.version,
        "board": None if who is None else who.board_name,
        "older_than_1_1": link.older,
        "supply_v": None,
        "host_timeout_s": None,
        "host_stops": None,
        "settings": None,
    }
    if condition is not None:
        told["supply_v"] = condition.supply_v
        told["host_timeout_s"], told["host_stops"] = condition.host_timeout_s, condition.host_stops
        known = condition.stored < len(STORED)
        told["settings"] = STORED[condition.stored] if known else f"unknown ({condition.stored})"
    return told


def firmware_text(d: dict[str, Any]) -> str:
    if d["firmware"] is not None:
        return f"{d['firmware']} on {d['board'] or 'a board without a name'}"
    return "older than 1.1" if d["older_than_1_1"] else "unknown: it does not say"


def supply_text(d: dict[str, Any]) -> str:
    if d["supply_v"] is not None:
        return f"{d['supply_v']:.1f} V"
    return "unknown" if d["firmware"] is None else "unknown: its pin is not connected"
