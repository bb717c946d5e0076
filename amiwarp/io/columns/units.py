"""Unit of the times in a column: the one that the user, the file or its format states, or one that the values show."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.columns.layout import Column, Hints, Layout
from amiwarp.io.columns.names import unit_in
from amiwarp.io.columns.options import TIME_UNITS, GivenLayout
from amiwarp.validation import TIME_LIMIT

LONGEST_S = 3600
"""Longest recording whose unit is inferred from whole numbers [s]."""
MOST_PER_US = 1000
"""Largest rate of events that is plausible [1/us]."""
MOST_ASSUMED_PER_US = 50
"""Largest rate for which whole numbers of an unknown unit are taken for microseconds [1/us]. Milliseconds would seem to
have such a rate at 50,000 events per second; the bursts of large sensors are half as fast."""

EPOCH_NS = (10**17, 4 * 10**18)
"""Range of times since 1970, from 1973 to 2096 [ns]."""

EPOCH_US = (10**14, 4 * 10**15)
"""Range of times since 1970, from 1973 to 2096 [us]."""

EPOCH_MS = (10**12, 4 * 10**12)
"""Range of times since 1970, from 2001 to 2096 [ms]. As microseconds they are weeks after the start of a camera."""

EPOCH_S = (10**9, 4 * 10**9)
"""Range of times since 1970, from 2001 to 2096 [s]. As microseconds they are half an hour after the start."""
MOST_PER_STEP = 20
"""Number of events per step of time at which times in :data:`EPOCH_S` may be whole seconds, and seconds in
:data:`EXCEL_DAYS` may be days."""

EXCEL_DAYS = (36_526, 73_051)
"""Range of times since 1900 as Excel counts them, from 2000 to 2099 [d]. As seconds they are half a day."""


def find_unit(column: Column, given: GivenLayout, hints: Hints) -> tuple[str, str | None]:
    """Return the unit of time, and why it was assumed; None if the file states it."""
    if given.time_unit is not None:
        return given.time_unit, None
    named = unit_in(column.name) if column.name else None
    stated = column.unit or named
    if stated is not None:
        return stated, None
    if hints.unit is not None:
        return _promised_unit(column.values, hints)
    t = column.values
    known = t[np.isfinite(t) & (np.abs(t) < TIME_LIMIT)] if t.dtype.kind == "f" else t
    if not known.size:
        return hints.fractions or "us", None
    if known.dtype.kind == "f" and (known != np.floor(known)).any():
        return _unit_of_fractions(known, hints)
    return _unit_of_whole(known)


def _promised_unit(t: NDArray[Any], hints: Hints) -> tuple[str, str | None]:
    """Return the unit of times that a format promises, and why it is another one; None if it is the promised one.

    Raises :class:`AmiwarpError` if whole numbers can be no microseconds.
    """
    assert hints.unit is not None
    if hints.unit != "us" or t.dtype.kind not in "iu" or not t.size:
        return hints.unit, None
    if _is_within(t, EPOCH_NS):
        why = "times are whole numbers, as those in nanoseconds since 1970, but this layout has us"
        return "ns", why
    if not hints.is_own:
        _check_whole(t)
    return hints.unit, None


def are_microseconds(t: NDArray[Any]) -> bool:
    """Return whether times that a documented layout promises in microseconds can be such."""
    try:
        return _promised_unit(t, Hints(unit="us")) == ("us", None)
    except AmiwarpError:
        return False


def _is_within(t: NDArray[Any], limits: tuple[int, int]) -> bool:
    """Return whether all times lie within limits."""
    return limits[0] <= int(t.min()) and int(t.max()) <= limits[1]


def _check_whole(t: NDArray[Any]) -> None:
    """Raise :class:`AmiwarpError` if times that are whole numbers are likely no microseconds."""
    low = int(t.min())
    high = int(t.max())
    if _is_within(t, EPOCH_MS):
        raise AmiwarpError(
            f"the unit of time is in doubt: times from {low} may be milliseconds since 1970, or microseconds; give it "
            "with --time-unit ms or us",
            ErrorCode.AMBIGUOUS,
        )
    if _is_within(t, EPOCH_S) and t.size > MOST_PER_STEP * max(high - low, 1):
        raise AmiwarpError(
            f"the unit of time is in doubt: times from {low} may be seconds since 1970, or microseconds; give it with "
            "--time-unit s or us",
            ErrorCode.AMBIGUOUS,
        )
    if t.size > MOST_PER_US * max(high - low, 1) + 1000:
        raise AmiwarpError(_whole_doubt(t), ErrorCode.AMBIGUOUS)


def _whole_doubt(t: NDArray[Any]) -> str:
    """Return the message for times that are whole numbers in an unknown unit."""
    return (
        f"the unit of time is in doubt: times are whole numbers, and the first {t.size:,} events span "
        f"{int(t.max()) - int(t.min()):,}; give it with --time-unit s, ms, us or ns"
    )


def _unit_of_fractions(t: NDArray[Any], hints: Hints) -> tuple[str, str | None]:
    """Return the unit of times with fractions, and why it was assumed; None if the format promises it."""
    span = float(t.max() - t.min())
    in_days = EXCEL_DAYS[0] <= t.min() and t.max() < EXCEL_DAYS[1]
    if in_days and t.size > MOST_PER_STEP * max(span * 1e6, 1.0):
        raise AmiwarpError(
            f"the unit of time is in doubt: times from {float(t.min()):.15g} may be days since 1900, as Excel counts "
            "them, or seconds; change them to seconds, or give --time-unit s",
            ErrorCode.AMBIGUOUS,
        )
    if t.size > MOST_PER_US * max(span * 1e6, 1.0) + 1000:
        raise AmiwarpError(
            f"the unit of time is in doubt: times have fractions, and the first {t.size:,} events span {span:.6g}, in "
            "which no camera sends as many if these are seconds; give it with --time-unit s, ms, us or ns",
            ErrorCode.AMBIGUOUS,
        )
    if hints.fractions is not None:
        return hints.fractions, None
    if span > 10.0 and t.size / span < 1000.0:
        raise AmiwarpError(
            f"the unit of time is in doubt: times have fractions, and the first {t.size:,} events span {span:.6g}; "
            "give it with --time-unit s, ms, us or ns",
            ErrorCode.AMBIGUOUS,
        )
    return "s", f"times have fractions, and the first {t.size:,} events span {span:.3g}"


def _unit_of_whole(t: NDArray[Any]) -> tuple[str, str]:
    """Return the unit of times that are whole numbers, and why."""
    for unit, limits in (("ns", EPOCH_NS), ("us", EPOCH_US)):
        if _is_within(t, limits):
            return unit, "times are whole numbers, as those since 1970"
    _check_whole(t)
    span = int(t.max()) - int(t.min())
    if t.size > MOST_ASSUMED_PER_US * max(span, 1) + 1000:
        raise AmiwarpError(_whole_doubt(t), ErrorCode.AMBIGUOUS)
    if span > LONGEST_S * 10**6:
        raise AmiwarpError(_whole_doubt(t), ErrorCode.AMBIGUOUS)
    why = f"times are whole numbers, and the first {t.size:,} events span {span * 1e-6:.3g} s then"
    return "us", why


EXPONENT = re.compile(rb"[+-]?(\d)(?:\.(\d*))?[eE]([+-]?\d+)")
"""Pattern of a number with an exponent, of which the first digit, the decimals and the exponent are found."""


def rounded_times_note(words: Sequence[bytes], unit: str) -> str | None:
    """Return a note on times that a program has rounded to few digits, as 1.23457E+11; None for others.

    Only numbers with exponents show it. Steps of a microsecond are no loss.
    """
    matches = [match for match in map(EXPONENT.fullmatch, words) if match is not None]
    if 2 * len(matches) <= len(words):
        return None
    digits = 1 + max(len(match[2] or b"") for match in matches)
    largest_exponent = max(int(match[3]) for match in matches)
    step = 10.0 ** (largest_exponent + 1 - digits)
    # The step is a power of ten: 1 us or less, or else 10 us.
    if step * TIME_UNITS[unit] < 2.0:
        return None
    shown = f"{step:,.0f}" if step > 0.5 else f"{step:g}"
    return f"to {digits} significant digits: steps of {shown} {unit}; export them with all digits"


def check_duration(layout: Layout, duration_us: int) -> None:
    """Raise :class:`AmiwarpError` if a recording whose unit was inferred is longer than :data:`LONGEST_S`."""
    if layout.unit_is_assumed and duration_us > LONGEST_S * 10**6:
        raise AmiwarpError(
            f"the unit of time is in doubt: times are whole numbers; in us, the recording would last "
            f"{duration_us * 1e-6:,.0f} s; give it with --time-unit s, ms, us or ns",
            ErrorCode.AMBIGUOUS,
        )
