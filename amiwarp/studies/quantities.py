"""Angles and event rates as text, and the time of a quarter turn."""

import math


def degrees(angle: float) -> str:
    """Return an angle [rad] as text in degrees."""
    return f"{float(f'{math.degrees(angle):.3g}'):g}°"


def quarter_turn_ms(rpm: float) -> float:
    """Return the time of a quarter turn [ms] at a speed [turns/min]."""
    return 15e3 / rpm


def rate(events_per_s: float) -> str:
    """Return an event rate [events/s] as text."""
    return f"{events_per_s / 1e6:.3g} Mev/s"
