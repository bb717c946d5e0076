"""Relation of the camera's clock to the controller's: by pulses that both recorded, else by arrival times at the host.

A controller sends pulses at pseudo-random intervals to the camera's trigger input, and reports when. Under the right
shift between the clocks nearly all of them meet a trigger, under any other shift hardly any. So the shift is found
whatever the reports' delays are, or it is not found: it never belongs to a neighbouring pulse.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.live.link.clocks import FEWEST_PAIRS, ClockMap, fit_to_pulses

MOST_PAIRS = 100
"""Number of latest pulse pairs in memory, each one pulse with its times on both clocks."""
MOST_UNPAIRED = 256
"""Largest number of pulses in memory that have a time on one clock only, for each clock: 25 s at ten pulses per second,
so that reports that are ten seconds late still meet."""
MATCH_US = 300.0
"""Largest difference between the clock shifts of two pulse pairs that belong together [us]. A pulse's delay varies, and
clocks drift by 1e-4 per second."""
UNSTEADY = 2e-6
"""Change of the drift between two clocks that is expected while no pulse is seen, as of quartzes that warm up."""
LARGEST_DRIFT_US = 200.0
"""Change of the map since the last pulse that met a trigger [us], beyond which it no longer counts as sure."""
LARGEST_MATCH_US = 20_000.0
"""Largest difference between a pulse and the time at which the map expects it [us], after a long time without one."""
FEWEST_FOUND = 6
"""Smallest number of pulses that must meet for a shift to be found."""
BY_CHANCE = 1e-6
"""Expected number of wrong shifts under which as many pulses would meet, below which a shift is accepted."""
DOUBTFUL = 1e-3
"""The same for another shift, below which two shifts are possible and none is taken."""
JUDGED = 16
"""Number of latest pulses in the time of known triggers by which the map is judged."""
FEWEST_MET = 5
"""Smallest number of the judged pulses that must meet a trigger. Below it, the map is discarded: one of the clocks has
jumped."""
MOST_OTHERS = 3
"""Number of other shifts that are compared with the best one."""
NO_PULSES_US = 3_000_000
NO_TRIGGERS_US = 6_500_000
"""Time without a pulse of the controller, and time with pulses but without a trigger of the camera, whose reports may
be late, after which arrival times are used [us]."""
NO_SHIFT_US = 10_000_000
"""Time with pulses of both sides, but without a shift between them, after which arrival times are used [us]."""
FEWEST_REGULAR = 7
REGULAR_US = 200.0
"""Smallest number of pulses that can be called regular, and largest deviation of an interval between two of them [us].
Irregular intervals are whole milliseconds of a wide range, so that so many hardly ever agree."""
NO_PAIRS = np.zeros((0, 2), np.int64)
"""No indices of triggers and sync pulses."""
MOST_DELAYS = 2000
"""Number of latest packets whose delays are in memory. The shortest delay relates the camera's clock to the host's."""


class ClockSource(enum.StrEnum):
    """How the camera's clock is related to the controller's. The value of a member is what users read."""

    UNKNOWN = "unknown"
    """Not yet."""
    PULSES = "pulses"
    """By pulses at irregular intervals, under the only shift that is possible."""
    OLD = "old pulses"
    """By pulses, the last of which was so long ago that the clocks may have drifted apart since."""
    REGULAR = "regular pulses"
    """By pulses at regular intervals, as of older controllers. Arrival times choose among the possible shifts, so the
    map may be wrong by whole intervals."""
    ARRIVAL = "arrival times"
    """Without pulses: the shortest delay of the camera's packets is taken for none."""

    @property
    def sure(self) -> bool:
        """Whether the map cannot be wrong by more than its uncertainty."""
        return self is ClockSource.PULSES


class CameraClock:
    """Relates the clocks of controller and camera."""

    def __init__(self) -> None:
        # of each sync pulse the controller's and the host's time, of each trigger the camera's and the host's time
        self._sync: deque[tuple[int, int]] = deque(maxlen=MOST_UNPAIRED)
        self._trigger: deque[tuple[int, int]] = deque(maxlen=MOST_UNPAIRED)
        self._pairs: deque[tuple[int, int]] = deque(maxlen=MOST_PAIRS)
        self._delays: deque[int] = deque(maxlen=MOST_DELAYS)
        self._met: deque[bool] = deque(maxlen=JUDGED)
        self._map: ClockMap | None = None
        self._since_us: int | None = None
        self._now_us = 0
        self._settled = False
        self._regular = False
        self._newest_sync_us = 0
        self.relation = 0
        """Number of the relation between the clocks: another one begins when a map is found anew or discarded."""
        self.source = ClockSource.UNKNOWN
        """How :meth:`clock` knew the relation when it was called last."""

    def restart(self) -> None:
        """Discard all times of the controller's clock, because that clock restarted.

        Triggers before the restart belong to pulses that nobody will report any more.
        """
        self._sync.clear()
        self._trigger.clear()
        self._pairs.clear()
        self._forget_map()
        self._since_us = None
        self.source = ClockSource.UNKNOWN

    def returned(self) -> None:
        """Discard all times of the camera's clock too, because the camera was lost and returned."""
        self.restart()
        self._delays.clear()

    def settle(self) -> None:
        """Wait for no more pulses, because the stream has ended: :meth:`clock` then uses arrival times at once."""
        self._settled = True

    def sync(self, t_us: int, host_us: int) -> None:
        """Add a sync pulse that the controller sent at its time ``t_us`` and reported at host time ``host_us`` [us]."""
        self._saw(host_us)
        self._newest_sync_us = t_us
        self._sync.append((t_us, host_us))
        self._match()

    def triggers(self, t_us: ArrayLike, host_us: int) -> None:
        """Add triggers that the camera recorded at its times ``t_us`` and reported at host time ``host_us`` [us].

        Only the last :data:`MOST_UNPAIRED` of them are used.
        """
        times = np.atleast_1d(np.asarray(t_us, np.int64))[-MOST_UNPAIRED:].tolist()
        if times:
            self._saw(host_us)
            self._trigger.extend((t, host_us) for t in times)
            self._match()

    def packet(self, t_last: int, host_us: int) -> None:
        """Store the delay of a packet: its last event has camera time ``t_last``; it arrived at ``host_us`` [us]."""
        self._saw(host_us)
        self._delays.append(host_us - t_last)

    def clock(self, host: ClockMap | None) -> ClockMap | None:
        """Return the map from the controller's clock to the camera's; None while it is unknown.

        :attr:`source` says how it is known. ``host``: map from the host's clock to the controller's, used without
        pulses. The result then has an unknown error: the shortest delay of the camera's packets.
        """
        clock, self.source = self._map_and_source(host)
        return clock

    def _map_and_source(self, host: ClockMap | None) -> tuple[ClockMap | None, ClockSource]:
        """Return the map from the controller's clock to the camera's, if there is one, and how it is known."""
        if self._map is not None:
            drift_us = UNSTEADY * abs(self._newest_sync_us - self._pairs[-1][0])
            now = replace(self._map, offset_std_us=math.hypot(self._map.offset_std_us, drift_us))
            if self._regular:
                return now, ClockSource.REGULAR
            return now, ClockSource.OLD if drift_us > LARGEST_DRIFT_US else ClockSource.PULSES
        if not self._may_guess():
            return None, ClockSource.UNKNOWN
        if host is None or len(self._delays) < FEWEST_PAIRS:
            return None, ClockSource.UNKNOWN
        return self._map_by_arrival(host), ClockSource.ARRIVAL

    def _map_by_arrival(self, host: ClockMap) -> ClockMap:
        """Return the map from the controller's clock to the camera's, as if the shortest delay of packets were none.

        It goes by the host's clock: ``host`` backwards, then less the delay. The spread of the delays is its error.
        """
        delays_us = np.array(self._delays)
        shortest_us = int(delays_us.min())
        spread_us = float(np.median(delays_us) - shortest_us)
        return replace(
            host,
            at_us=host.at_us + round(host.offset_us),
            offset_us=-host.offset_us - shortest_us,
            drift=-host.drift,
            offset_std_us=math.hypot(host.offset_std_us, spread_us),
        )

    def _saw(self, host_us: int) -> None:
        """Note the host time of the latest data, and of the first ones since the clocks are unknown [us]."""
        self._now_us = max(self._now_us, host_us)
        if self._since_us is None:
            self._since_us = host_us

    def _may_guess(self) -> bool:
        """Return whether pulses have been waited for long enough."""
        if self._settled or self.source is ClockSource.ARRIVAL:
            return True
        if self._since_us is None:
            return False
        patience = NO_PULSES_US
        if self._sync:
            patience = NO_SHIFT_US if self._trigger else NO_TRIGGERS_US
        return self._now_us - self._since_us >= patience

    def _forget_map(self) -> None:
        """Discard the map and all pairs that it was fitted to."""
        if self._map is not None:
            self.relation += 1
        self._pairs.clear()
        self._met.clear()
        self._map = None
        self._regular = False

    def _match(self) -> None:
        """Store the pulses that match as pairs: by the map, or by the search for the shift between the clocks."""
        if not (self._sync and self._trigger):
            return
        trigger = np.array(self._trigger, np.int64)
        sync = np.array(self._sync, np.int64)
        find = self._first_pairs if self._map is None else self._next_pairs
        pairs = find(trigger, sync)
        if not len(pairs):
            return
        self._pairs.extend((int(sync[j, 0]), int(trigger[i, 0])) for i, j in pairs)

        # Pulses before the last pair will not meet any more.
        last_trigger, last_sync = pairs.max(axis=0).tolist()
        _drop_until(self._trigger, trigger[last_trigger, 0])
        _drop_until(self._sync, sync[last_sync, 0])
        sync_us, trigger_us = np.array(self._pairs).T
        if len(sync_us) < FEWEST_PAIRS:
            return
        fitted = fit_to_pulses(sync_us, trigger_us)
        if self._regular:  # the shift may be wrong by whole intervals
            interval_us = float(np.diff(sync_us).min())
            fitted = replace(fitted, offset_std_us=max(fitted.offset_std_us, interval_us))
        if self._map is None:
            self.relation += 1
        self._map = fitted

    def _first_pairs(
        self, trigger: NDArray[np.int64], sync: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return the pulses that match under the shift that is found, as indices (trigger, sync); none if none is."""
        self._regular = are_multiples(sync[:, 0])
        if self._regular:
            return _pairs_by_arrival(trigger, sync) if len(sync) >= FEWEST_REGULAR else NO_PAIRS
        shift = find_shift(trigger[:, 0], sync[:, 0])
        return NO_PAIRS if shift is None else shift.pairs

    def _next_pairs(
        self, triggers: NDArray[np.int64], syncs: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return the pulses that match by the map. Without most of the latest ones, the map is discarded."""
        assert self._map is not None
        trigger = triggers[:, 0]
        sync = syncs[:, 0]
        expected = self._map(sync)
        reach = self._reach_us(sync)
        pairs = _nearest_pairs(np.abs(trigger[:, None] - expected[None, :]), reach)
        met = np.zeros(len(sync), np.bool_)
        met[pairs[:, 1]] = True
        # A pulse between two triggers that wait was either seen, or will never be.
        is_between = (expected - reach >= trigger.min()) & (expected + reach <= trigger.max())
        judged = met | is_between
        self._met.extend(met[judged].tolist())
        missed = set(sync[judged & ~met].tolist())
        self._sync = deque((pulse for pulse in self._sync if pulse[0] not in missed), MOST_UNPAIRED)
        if len(self._met) == JUDGED and sum(self._met) < FEWEST_MET:
            self._forget_map()
            self._since_us = self._now_us
            return NO_PAIRS
        return pairs

    def _reach_us(self, sync: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the distance from the map within which a trigger belongs to a sync pulse [us], shape (syncs,)."""
        assert self._map is not None
        ahead = np.abs(sync - self._pairs[-1][0])
        grown = MATCH_US + (5.0 * self._map.drift_std + UNSTEADY) * ahead
        return np.minimum(grown, LARGEST_MATCH_US)


@dataclass(frozen=True, slots=True, eq=False)
class FoundShift:
    """Shift between two clocks under which pulses meet."""

    shift_us: float
    """Time of the camera's clock minus time of the controller's [us]."""
    pairs: NDArray[np.int64]
    """Indices of the triggers and of the sync pulses that meet, shape ``(n, 2)``."""
    by_chance: float
    """Expected number of wrong shifts under which as many would meet."""


def find_shift(trigger_us: NDArray[np.int64], sync_us: NDArray[np.int64]) -> FoundShift | None:
    """Return the shift between the clocks under which pulses meet; None if there is none, or more than one.

    ``trigger_us``, ``sync_us``: times of pulses on the camera's and on the controller's clock [us], shape ``(n,)``.
    Each of them may hold pulses that the other lacks.
    """
    if min(len(trigger_us), len(sync_us)) < FEWEST_FOUND:
        return None
    candidates = _crowded_shifts(trigger_us, sync_us)
    if not candidates:
        return None
    best = min(candidates, key=lambda shift: shift.by_chance)
    others = [shift for shift in candidates if shift is not best]
    if best.by_chance > BY_CHANCE or len(best.pairs) < FEWEST_FOUND:
        return None
    if any(other.by_chance < DOUBTFUL for other in others):
        return None
    return best


def _crowded_shifts(trigger_us: NDArray[np.int64], sync_us: NDArray[np.int64]) -> list[FoundShift]:
    """Return the shifts under which most pulses meet, the most crowded first, each with its own neighbourhood."""
    order = np.sort((trigger_us[:, None] - sync_us[None, :]).ravel())
    first = np.searchsorted(order, order - MATCH_US, side="left")
    last = np.searchsorted(order, order + MATCH_US, side="right")
    meeting = last - first
    shifts: list[FoundShift] = []
    for k in np.argsort(-meeting, kind="stable"):
        if meeting[k] < FEWEST_PAIRS or len(shifts) > MOST_OTHERS:
            break
        middle_us = float(np.median(order[first[k] : last[k]]))
        if all(abs(middle_us - known.shift_us) > 4.0 * MATCH_US for known in shifts):
            shifts.append(_meeting_at(middle_us, trigger_us, sync_us))
    return shifts


def _meeting_at(
    shift_us: float, trigger_us: NDArray[np.int64], sync_us: NDArray[np.int64]
) -> FoundShift:
    """Return which pulses meet under a shift, and how many shifts would do as well by chance."""
    distance = np.abs(trigger_us[:, None] - sync_us[None, :] - shift_us)
    pairs = _nearest_pairs(distance, np.full(len(sync_us), MATCH_US))
    if not len(pairs):
        return FoundShift(shift_us, pairs, math.inf)
    first_trigger, first_sync = pairs.min(axis=0).tolist()
    last_trigger, last_sync = pairs.max(axis=0).tolist()
    span_us = max(int(trigger_us[last_trigger] - trigger_us[first_trigger]), 1)
    # A pulse at a random time meets one of the triggers with this chance. Controllers count whole milliseconds, so
    # that pulses meet at random more often than their spread tells.
    chance = min(2.0 * max(MATCH_US, 500.0) * (last_trigger - first_trigger) / span_us, 1.0)
    # The first pair is given by the choice of the shift, so the others must meet by chance.
    tried = last_sync - first_sync
    met = len(pairs) - 1
    expected = len(trigger_us) * len(sync_us) * _binomial_tail(tried, met, chance)
    return FoundShift(shift_us, pairs, expected)


def _drop_until(pulses: deque[tuple[int, int]], last_us: int) -> None:
    """Remove the pulses up to a time on their own clock [us]."""
    while pulses and pulses[0][0] <= last_us:
        pulses.popleft()


def _binomial_tail(tried: int, met: int, chance: float) -> float:
    """Return the probability of at least ``met`` successes of ``tried``, each with a ``chance``."""
    return math.fsum(
        math.comb(tried, k) * chance**k * (1.0 - chance) ** (tried - k)
        for k in range(max(met, 0), tried + 1)
    )


def _nearest_pairs(distance: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices (trigger, sync) of pairs that are each other's nearest and within reach, shape ``(n, 2)``.

    ``distance``: shape (triggers, syncs); ``reach``: largest distance of each sync pulse, shape (syncs,).
    """
    nearest = distance.argmin(axis=0)
    sync = np.arange(distance.shape[1])
    mutual = distance.argmin(axis=1)[nearest] == sync
    kept = mutual & (distance[nearest, sync] <= reach)
    return np.stack([nearest[kept], sync[kept]], axis=1)


def are_multiples(sync_us: NDArray[np.int64]) -> bool:
    """Return whether the intervals between pulses are multiples of one interval, as with older controllers."""
    intervals = np.diff(sync_us).astype(np.float64)
    if not len(intervals):
        return True
    shortest = max(float(intervals.min()), 1.0)
    number = np.rint(intervals / shortest)
    return bool((np.abs(intervals - number * shortest) <= REGULAR_US * number).all())


def _pairs_by_arrival(trigger: NDArray[np.int64], sync: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the pairs of regular pulses whose reports arrive at the same time, as indices (trigger, sync).

    ``trigger``, ``sync``: times of pulses and of their reports at the host [us], shape ``(n, 2)`` each. Regular pulses
    match under many shifts. Reports may be late, in bursts if the host was busy, but never early: so the reports with
    the shortest delay decide, if there are three of them on both sides.
    """
    if min(len(trigger), len(sync)) < FEWEST_PAIRS:
        return NO_PAIRS
    reach = min(np.diff(trigger[:, 0]).min(), np.diff(sync[:, 0]).min()) / 2.0
    trigger_delays = trigger[:, 1] - trigger[:, 0]
    sync_delays = sync[:, 1] - sync[:, 0]
    for delays in (trigger_delays, sync_delays):
        if np.count_nonzero(delays <= delays.min() + reach) < FEWEST_PAIRS:
            return NO_PAIRS
    shift = trigger[:, None, 0] - sync[None, :, 0]
    disagreement = np.abs(shift - (sync_delays.min() - trigger_delays.min()))
    i, j = np.unravel_index(disagreement.argmin(), shift.shape)
    pairs = _nearest_pairs(np.abs(shift - shift[i, j]), np.full(len(sync), MATCH_US))
    if disagreement[i, j] > reach or len(pairs) < FEWEST_PAIRS:
        return NO_PAIRS
    return pairs
