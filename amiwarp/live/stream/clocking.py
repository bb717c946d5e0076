"""The camera's clock beside the controller's: from pulses that both saw or, without any, from when things arrived."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.live.link.clocks import FEWEST_PAIRS, ClockMap, fit_to_pulses

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from amiwarp.live.link.link import Link
    from amiwarp.live.stream.packets import Source

PULSES = 100
"""That are remembered, the last ones."""
UNPAIRED = 16
"""Pulses of either side that wait for their other."""
ALIKE_US = 300.0
"""Two distances between pulses are the same within this: a pulse's delay varies, and clocks drift by 1e-4 a second."""
APART_US = 5_000_000
"""The two reports of one pulse reach the host within this, and within half the time between two pulses [us]."""
ARRIVALS = 2000
"""Packets whose delays are remembered: the shortest tells how the camera's clock and the host's lie."""


def clock_offset(source: Source, link: Link | None) -> float:
    """Of the encoder that came along with a file [us]: what is recorded has it too, so that calibrations fit both."""
    return 0.0 if link is not None else float(getattr(source, "clock_offset_us", 0.0))


class CameraClock:
    """Follows both clocks; :meth:`clock` takes the controller's times to the camera's."""

    def __init__(self) -> None:
        self._sync: deque[tuple[int, int]] = deque(maxlen=UNPAIRED)  # controller's time, host's
        self._trigger: deque[tuple[int, int]] = deque(maxlen=UNPAIRED)  # camera's time, host's
        self._pairs: deque[tuple[int, int]] = deque(maxlen=PULSES)
        self._ahead: deque[int] = deque(maxlen=ARRIVALS)
        self._found: ClockMap | None = None

    @property
    def pulses(self) -> int:
        """Pulses that both clocks saw, of those remembered."""
        return len(self._pairs)

    def restart(self) -> None:
        """The controller's clock began anew: what was known of it is void."""
        self._sync.clear()
        self._pairs.clear()
        self._found = None

    def returned(self) -> None:
        """Forget what is known of the camera's clock: it was away and may have begun anew."""
        self.restart()
        self._trigger.clear()
        self._ahead.clear()

    def sync(self, t_us: int, host_us: int) -> None:
        """The controller sent a pulse at ``t_us`` of its clock; the host heard of it at ``host_us``."""
        self._sync.append((t_us, host_us))
        self._pair()

    def triggers(self, t_us: ArrayLike, host_us: int) -> None:
        """The camera saw pulses at ``t_us`` of its clock; the host heard of them at ``host_us``.

        Of more than :data:`UNPAIRED` at once, the last ones count: no earlier one would still wait.
        """
        for t in np.atleast_1d(np.asarray(t_us, np.int64))[-UNPAIRED:].tolist():
            self._trigger.append((t, host_us))
            self._pair()

    def packet(self, t_last: int, host_us: int) -> None:
        """The camera's events up to ``t_last`` arrived at ``host_us``."""
        self._ahead.append(host_us - t_last)

    def clock(self, host: ClockMap | None) -> ClockMap | None:
        """The camera's clock beside the controller's, by pulses; without, by ``host``: the controller's beside it.

        By the host it is off by the shortest way of the camera's packets, which nothing tells. None while unknown.
        """
        if self._found is not None or host is None or len(self._ahead) < FEWEST_PAIRS:
            return self._found
        ahead = np.array(self._ahead)
        shortest = int(ahead.min())
        spread = float(np.median(ahead) - shortest)
        at = host.at_us + round(host.offset_us)
        return replace(
            host, at_us=at, offset_us=-host.offset_us - shortest, drift=-host.drift,
            offset_std_us=math.hypot(host.offset_std_us, spread),
        )  # fmt: skip

    def _pair(self) -> None:
        """Finds the one shift of the camera's clock under which pulses meet, and takes the pairs out."""
        if not (self._sync and self._trigger):
            return
        t, s = (np.array(pulses, np.int64) for pulses in (self._trigger, self._sync))
        if self._found is not None:
            meet = np.abs(t[:, None, 0] - self._found(s[:, 0])[None, :]) <= ALIKE_US
        else:
            meet = _first_meeting(t, s)
        where = np.argwhere(meet)
        if not len(where):
            if self._found is not None and min(len(t), len(s)) == UNPAIRED:
                self._found = None  # one of the clocks jumped
                self._pairs.clear()
            return
        pairs = {int(j): int(i) for i, j in where}
        self._pairs.extend((int(s[j, 0]), int(t[i, 0])) for j, i in sorted(pairs.items()))
        last_t, last_s = max(pairs.values()), max(pairs)
        self._trigger = deque(list(self._trigger)[last_t + 1 :], UNPAIRED)
        self._sync = deque(list(self._sync)[last_s + 1 :], UNPAIRED)
        if len(self._pairs) >= FEWEST_PAIRS:
            own, other = np.array(self._pairs).T
            self._found = fit_to_pulses(own, other)


def _first_meeting(trigger: NDArray[np.int64], sync: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which pairs of pulses share the shift between their clocks, three or more; shape (triggers, syncs).

    Pulses at even distances meet under many shifts: theirs is where they were heard of at the same time. Reports come
    late, many at once where the host was busy, but never early: the promptest of either side tell, where three agree.
    """
    apart = trigger[:, None, 0] - sync[None, :, 0]
    intervals = np.concatenate([np.diff(trigger[:, 0]), np.diff(sync[:, 0]), [2 * APART_US]])
    reach, best = int(intervals.min()) // 2, np.zeros(apart.shape, np.bool_)
    delays = trigger[:, 1] - trigger[:, 0], sync[:, 1] - sync[:, 0]
    if any(np.count_nonzero(some <= some.min() + reach) < FEWEST_PAIRS for some in delays):
        return best
    away = np.abs(apart - (delays[1].min() - delays[0].min()))
    nearest = reach
    for i, j in np.argwhere(away <= reach):
        meet = np.abs(apart - apart[i, j]) <= ALIKE_US
        if meet.any(axis=0).sum() >= FEWEST_PAIRS and away[i, j] <= nearest:
            best, nearest = meet, int(away[i, j])
    return best
