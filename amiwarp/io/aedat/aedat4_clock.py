"""Times in AEDAT 4 files: where the clock of the camera starts again, they are made to go on."""

import bisect
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.aedat.aedat4_packets import Content
from amiwarp.io.aedat.aedat4_tables import Tables
from amiwarp.validation import TIME_LIMIT

Integers = NDArray[np.int64]

RESTART_US = 100_000
"""Least step back of the time that can be a restart of the camera's clock [us]."""

RESTART_EVENTS = 64
"""Number of events before and behind a restart whose times are compared."""
LEAST_BEHIND = 3
"""Fewest events behind a step back that decide whether the clock has started again."""
MOST_RESTARTS = 100
"""Largest number of restarts. With more steps back, the times are damaged, and are left as they are."""


@dataclass(slots=True)
class Clock:
    """Times of the events as stored, which are made to go on where the clock of the camera starts again."""

    restarts: list[tuple[int, int]] = field(default_factory=list)
    """Positions of the packets in which the clock starts again, and what is added to the times from there on [us]."""
    _last: Integers = field(default_factory=lambda: np.zeros(0, np.int64))
    """Latest times, as stored [us]."""
    _is_open: bool = False
    """Whether too few events follow the last step back to decide what it is."""

    @property
    def shift(self) -> int:
        """What is added to the times now [us]."""
        if not self.restarts:
            return 0
        _, shift = self.restarts[-1]
        return shift

    def shift_all(
        self,
        t: Integers,
        starts: Sequence[int] | Integers,
        places: list[int],
        *,
        in_order: bool,
    ) -> None:
        """Shift the times of the next events, at least one, in place [us].

        ``places`` are the positions of their packets, ``starts`` the index of the first event of each. ``in_order``:
        whether none of these times is before the one in front of it.
        """
        count = self._last.size
        steps_back_between = count and self._last[-1] > t[0]
        if self._is_open or not in_order or steps_back_between:
            stored = np.concatenate([self._last, t])
            steps_back = np.flatnonzero(stored[1:] < stored[:-1] - RESTART_US) + 1
        else:
            stored = t
            steps_back = np.zeros(0, np.int64)
        last = stored[-RESTART_EVENTS:].copy()
        if self.shift:
            t += self.shift

        # A step just before the end of the last call was not decided then.
        undecided = max(count - LEAST_BEHIND + 1, 0)
        candidates = steps_back[steps_back >= undecided].tolist()
        if steps_back.size > MOST_RESTARTS:
            candidates = []
        self._is_open = False
        for index in candidates:
            if stored.size - index < LEAST_BEHIND:
                self._is_open = True
                break
            shift = self.shift + int(stored[index - 1]) - int(stored[index])
            is_possible = shift < TIME_LIMIT and len(self.restarts) < MOST_RESTARTS
            if is_possible and _is_restart(stored, index):
                first = max(index - count, 0)
                packet = bisect.bisect_right(starts, first) - 1
                self.restarts.append((places[packet], shift))
                t[first:] = stored[count + first :] + shift
        self._last = last


def _is_restart(stored: Integers, index: int) -> bool:
    """Return whether the clock starts again before the time with the index ``at``.

    Times in the middle of those before and behind it are compared: a single wrong one changes them little.
    """
    before = np.sort(stored[max(index - RESTART_EVENTS, 0) : index])
    behind = np.sort(stored[index : index + RESTART_EVENTS])
    middle_before = int(before[(before.size - 1) // 2])
    middle_behind = int(behind[behind.size // 2])
    return middle_behind - middle_before < -RESTART_US


class OtherClock:
    """Times of another stream than the events, which are shifted as these are."""

    def __init__(self, restarts: list[tuple[int, int]]) -> None:
        """Take the restarts of the clock, see :attr:`Clock.restarts`."""
        self._places = [place for place, _ in restarts]
        self._shifts = [0, *(shift for _, shift in restarts)]
        self._part = 0
        self._last: int | None = None

    def shift(self, t: int, place: int) -> int:
        """Return what to add to the times of the packet at ``place``, whose first time is ``t`` [us].

        The streams are not stored in step: a packet may stand on the wrong side of a restart of the clock.
        """
        part = bisect.bisect_right(self._places, place)
        if self._last is not None:
            step = t - self._last
            if part > self._part and 0 <= step < RESTART_US:
                part = self._part
            elif part == self._part and step < -RESTART_US and part + 1 < len(self._shifts):
                part += 1
        self._part = part
        self._last = t
        return self._shifts[part]

    def shift_all(self, contents: list[Content], tables: Tables) -> Integers:
        """Return the times in field 0 of the tables of some packets, shifted [us]."""
        t: Integers = tables.values[0].astype(np.int64)
        if len(self._shifts) == 1:
            return t
        firsts = np.flatnonzero(np.diff(tables.packet, prepend=-1))
        edges = [*firsts.tolist(), t.size]
        for start, stop in itertools.pairwise(edges):
            packet = contents[tables.packet[start]]
            t[start:stop] += self.shift(int(t[start]), packet.at)
        return t
