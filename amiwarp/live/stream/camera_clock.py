"""Relation of the camera's clock to the controller's: by common pulses, else by arrival times at the host."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.live.link.clocks import FEWEST_PAIRS, ClockMap, fit_to_pulses
from amiwarp.live.link.link import Link

if TYPE_CHECKING:
    from amiwarp.live.stream.packets import Source


MOST_PAIRS = 100
"""Number of latest pulse pairs in memory, each one pulse with its times on both clocks."""
MOST_UNPAIRED = 16
"""Largest number of pulses in memory that have a time on one clock only, for each clock."""
MATCH_US = 300.0
"""Largest difference between the clock shifts of two pulse pairs that belong together [us]. A pulse's delay varies, and
clocks drift by 1e-4 per second."""
REPORTS_US = 5_000_000
"""Longest time at the host between the controller's and the camera's report of the same pulse [us]. Half the interval
of the pulses is a limit too."""
MOST_DELAYS = 2000
"""Number of latest packets whose delays are in memory. The shortest delay relates the camera's clock to the host's."""


def clock_offset(source: Source, link: Link | None) -> float:
    """Return the clock offset of a file's own encoder [us], which a new recording of it shall keep; 0 with a link."""
    return 0.0 if link is not None else float(getattr(source, "clock_offset_us", 0.0))


class CameraClock:
    """Relates the clocks of controller and camera by pulses that both recorded."""

    def __init__(self) -> None:
        # of each sync pulse the controller's and the host's time, of each trigger the camera's and the host's time
        self._sync: deque[tuple[int, int]] = deque(maxlen=MOST_UNPAIRED)
        self._trigger: deque[tuple[int, int]] = deque(maxlen=MOST_UNPAIRED)
        self._pairs: deque[tuple[int, int]] = deque(maxlen=MOST_PAIRS)
        self._delays: deque[int] = deque(maxlen=MOST_DELAYS)
        self._map: ClockMap | None = None

    @property
    def pulses(self) -> int:
        """Number of pulse pairs with a time on both clocks that are in memory."""
        return len(self._pairs)

    def restart(self) -> None:
        """Discard all times of the controller's clock, because that clock restarted."""
        self._sync.clear()
        self._pairs.clear()
        self._map = None

    def returned(self) -> None:
        """Discard all times of the camera's clock too, because the camera was lost and returned."""
        self.restart()
        self._trigger.clear()
        self._delays.clear()

    def sync(self, t_us: int, host_us: int) -> None:
        """Add a sync pulse that the controller sent at its time ``t_us`` and reported at host time ``host_us`` [us]."""
        self._sync.append((t_us, host_us))
        self._match()

    def triggers(self, t_us: ArrayLike, host_us: int) -> None:
        """Add triggers that the camera recorded at its times ``t_us`` and reported at host time ``host_us`` [us].

        Only the last :data:`MOST_UNPAIRED` of them are used.
        """
        for t in np.atleast_1d(np.asarray(t_us, np.int64))[-MOST_UNPAIRED:].tolist():
            self._trigger.append((t, host_us))
            self._match()

    def packet(self, t_last: int, host_us: int) -> None:
        """Store the delay of a packet: its last event has camera time ``t_last``; it arrived at ``host_us`` [us]."""
        self._delays.append(host_us - t_last)

    def clock(self, host: ClockMap | None) -> ClockMap | None:
        """Return the map from the controller's clock to the camera's, by pulses if possible; None while it is unknown.

        ``host``: map from the host's clock to the controller's, used without pulses. The result then has an unknown
        error: the shortest delay of the camera's packets.
        """
        if self._map is not None or host is None or len(self._delays) < FEWEST_PAIRS:
            return self._map
        delays = np.array(self._delays)
        shortest = int(delays.min())
        spread = float(np.median(delays) - shortest)
        at = host.at_us + round(host.offset_us)
        return replace(
            host, at_us=at, offset_us=-host.offset_us - shortest, drift=-host.drift,
            offset_std_us=math.hypot(host.offset_std_us, spread),
        )  # fmt: skip

    def _match(self) -> None:
        """Find the shift between the clocks under which most pulses match, and store the matching pulses as pairs."""
        if not (self._sync and self._trigger):
            return
        t, s = (np.array(pulses, np.int64) for pulses in (self._trigger, self._sync))
        if self._map is not None:
            matches = np.abs(t[:, None, 0] - self._map(s[:, 0])[None, :]) <= MATCH_US
        else:
            matches = _first_matches(t, s)
        indices = np.argwhere(matches)
        if not len(indices):
            if self._map is not None and min(len(t), len(s)) == MOST_UNPAIRED:
                self._map = None  # one of the clocks jumped
                self._pairs.clear()
            return
        pairs = {int(j): int(i) for i, j in indices}
        self._pairs.extend((int(s[j, 0]), int(t[i, 0])) for j, i in sorted(pairs.items()))
        last_t, last_s = max(pairs.values()), max(pairs)
        self._trigger = deque(list(self._trigger)[last_t + 1 :], MOST_UNPAIRED)
        self._sync = deque(list(self._sync)[last_s + 1 :], MOST_UNPAIRED)
        if len(self._pairs) >= FEWEST_PAIRS:
            own, other = np.array(self._pairs).T
            self._map = fit_to_pulses(own, other)


def _first_matches(trigger: NDArray[np.int64], sync: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which pulses match under the most plausible shift between the clocks, shape (triggers, syncs).

    At least three pairs must match. Pulses at regular intervals match under many shifts: the shift is chosen under
    which the two reports of a pulse arrive at the same time. Reports may be late, in bursts if the host was busy, but
    never early: so the reports with the shortest delay decide, if there are three of them on both sides.
    """
    shift = trigger[:, None, 0] - sync[None, :, 0]
    intervals = np.concatenate([np.diff(trigger[:, 0]), np.diff(sync[:, 0]), [2 * REPORTS_US]])
    reach, best = int(intervals.min()) // 2, np.zeros(shift.shape, np.bool_)
    delays = trigger[:, 1] - trigger[:, 0], sync[:, 1] - sync[:, 0]
    if any(np.count_nonzero(some <= some.min() + reach) < FEWEST_PAIRS for some in delays):
        return best
    disagreement = np.abs(shift - (delays[1].min() - delays[0].min()))
    nearest = reach
    for i, j in np.argwhere(disagreement <= reach):
        matches = np.abs(shift - shift[i, j]) <= MATCH_US
        if matches.any(axis=0).sum() >= FEWEST_PAIRS and disagreement[i, j] <= nearest:
            best, nearest = matches, int(disagreement[i, j])
    return best


# Encoder samples of a session: from the controller by way of the camera's clock, or from the source itself.
