"""Packets of events, as the decoders of all formats yield them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events

Columns: TypeAlias = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]
"""Arrays x, y [px], t [us], p of events; or channel, 0, t [us] and 1 for a rising edge, of triggers."""


@dataclass(frozen=True, slots=True)
class Surveyed:
    """Events whose decoder has also noted what blocks of them hold."""

    events: Events
    surveys: NDArray[Any] | None
    """What each block holds, see :class:`amiwarp.kernels.event_survey.Survey`; None if the events have been changed."""

    @property
    def is_in_order(self) -> bool:
        """Whether no event is earlier than the one before it."""
        if self.surveys is None:
            return not bool((self.events.t[1:] < self.events.t[:-1]).any())
        if self.surveys["decreases"].any():
            return False
        first = self.surveys["first"]
        latest = self.surveys["latest"]
        return bool((first[1:] >= latest[:-1]).all())


Packet: TypeAlias = Columns | Events | Surveyed
"""Packet of events: arrays x, y [px], t [us] and p (ON if positive) as stored in the file: integers or booleans of one
shape ``(n,)``. x and y of compensated events are floating. Events of a sensor, whose arrays nobody else holds, are
checked by a kernel, in less than a tenth of the time."""


def whole_pixels(values: NDArray[Any]) -> NDArray[np.int64]:
    """Return floating coordinates as integers. NaN and values beyond 32 bits become -1, which lies outside.

    Raises :class:`AmiwarpError` for a fraction, which would be lost.
    """
    known = np.where(np.abs(values) < 2**31, values, -1)
    whole = known.astype(np.int64)
    if not np.array_equal(whole, known):
        given = known[whole != known][0]
        raise AmiwarpError(
            f"a coordinate is {given:g}; expected whole pixels (compensated events: amiwarp's .h5 or .npz)"
        )
    return whole


def microseconds(seconds: NDArray[Any]) -> NDArray[np.int64]:
    """Return times in seconds as whole microseconds. Raises :class:`AmiwarpError` if one is not finite."""
    with np.errstate(over="ignore"):
        times = seconds.astype(np.float64) * 1e6
    if not (np.abs(times) < 2**62).all():
        raise AmiwarpError(
            "a time is not finite or beyond int64; the file is damaged", ErrorCode.FILE_DAMAGED
        )
    return np.rint(times).astype(np.int64)
