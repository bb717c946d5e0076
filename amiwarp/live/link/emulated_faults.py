"""Faults of the emulated controller, and when they begin and end."""

from __future__ import annotations

import re
from dataclasses import dataclass

from amiwarp.errors import AmiwarpError

LASTING_FAULTS = {
    "garbage": 0.5,
    "truncate": 0.5,
    "crc": 0.5,
    "drop": 0.5,
    "missed-index": 0.5,
    "stall": 2.0,
    "reverse": 1.0,
    "unplug": 1.0,
}
"""Faults of the emulated controller that last, with their default duration [s].

``garbage``, ``truncate``, ``crc`` and ``drop`` insert bytes, cut frames, flip a bit and remove a byte, each in half of
the frames at random. ``missed-index`` suppresses index pulses, ``stall`` freezes the count, ``reverse`` reverses the
motor and ``unplug`` pulls out the cable.
"""
INSTANT_FAULTS = ("slip", "reset", "clock-jump")
"""Faults of the emulated controller without a duration: lost counts, a reboot, and a jump of the clock."""


@dataclass(frozen=True, slots=True)
class EmulatedFault:
    """Fault of the emulated controller (a name in :data:`LASTING_FAULTS` or :data:`INSTANT_FAULTS`) at a given time."""

    name: str
    """Name of the fault, from :data:`LASTING_FAULTS` or :data:`INSTANT_FAULTS`."""
    start_s: float
    """Emulation time at which it begins [s]."""
    duration_s: float = 0.0
    """Duration of the fault [s]; 0 for instant faults."""

    @classmethod
    def parse(cls, text: str) -> EmulatedFault:
        """Parse a fault given as ``NAME@SECONDS`` or ``NAME@SECONDS+DURATION``.

        Raises :class:`AmiwarpError` for any other text.
        """
        match = re.fullmatch(r"([a-z-]+)@(\d+(?:\.\d*)?)(?:\+(\d+(?:\.\d*)?))?", text)
        if match is None or match[1] not in (*LASTING_FAULTS, *INSTANT_FAULTS):
            names = ", ".join((*LASTING_FAULTS, *INSTANT_FAULTS))
            raise AmiwarpError(
                f"fault {text!r}: give NAME@SECONDS or NAME@SECONDS+DURATION, NAME one of {names}"
            )
        if match[1] in INSTANT_FAULTS and match[3]:
            raise AmiwarpError(
                f"fault {text!r}: {match[1]} happens at once and has no duration; omit it"
            )
        duration_s = float(match[3] or LASTING_FAULTS.get(match[1], 0.0))
        return cls(match[1], float(match[2]), duration_s)


def fault_edges(fault: EmulatedFault, start_us: int) -> list[tuple[int, bool]]:
    """Return the times [us] at which a fault begins (True) and, if it lasts, ends (False)."""
    first = start_us + round(fault.start_s * 1e6)
    if fault.name in INSTANT_FAULTS:
        return [(first, True)]
    return [(first, True), (first + round(fault.duration_s * 1e6), False)]
