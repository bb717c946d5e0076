"""Data received from the controller, in updates that are split where its clock or counts restarted."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_WAITING_SAMPLES = 100_000
"""Largest number of samples that wait to be fetched: more than 90 s at 1 kHz. Then the oldest are dropped."""
MOST_PULSES = 10_000
MOST_UPDATES = 64
"""Largest number of index or sync pulses in an update that waits to be fetched, and largest number of such updates."""
MOST_MESSAGES = 1000
"""Largest number of messages in an update that waits to be fetched."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LinkUpdate:
    """Data received from the controller since the last fetch, or until its clock or counts restarted."""

    t_us: NDArray[np.int64]
    """Times of the encoder samples [us] on the controller's unwrapped clock, strictly increasing, shape ``(n,)``."""
    angle: NDArray[np.float64]
    """Unwrapped prism angle of each sample [rad], shape ``(n,)``. After the first index pulse, the angle is a whole
    number of turns at each index pulse."""
    index_t_us: NDArray[np.int64]
    """Times of the index pulses from the previous update's last sample to this update's last sample [us]."""
    sync: tuple[tuple[int, int, int], ...]
    """Sync pulses, each with its number, the controller's time [us], and the host's time of arrival [us]."""
    restarted: bool
    """Whether the controller's clock or counts restarted before these samples. Maps fitted to the earlier clock are
    then void."""
    messages: tuple[str, ...]
    """Messages for the user about encoder faults, losses, resets and the port."""


class _PendingUpdate:
    """Update that is being filled; :class:`UpdateQueue` limits the number of its samples."""

    def __init__(self, *, restarted: bool) -> None:
        self.restarted = restarted
        self.samples: deque[tuple[int, float]] = deque()
        self.index: deque[int] = deque(maxlen=MOST_PULSES)
        self.sync: deque[tuple[int, int, int]] = deque(maxlen=MOST_PULSES)
        self.messages: deque[str] = deque(maxlen=MOST_MESSAGES)

    def finished(self) -> LinkUpdate:
        return LinkUpdate(
            t_us=np.array([t for t, _ in self.samples], np.int64),
            angle=np.array([angle for _, angle in self.samples], np.float64),
            index_t_us=np.array(self.index, np.int64),
            sync=tuple(self.sync),
            restarted=self.restarted,
            messages=tuple(self.messages),
        )


class UpdateQueue:
    """Bounded queue of updates between the reader of the port and the user of the link."""

    def __init__(self) -> None:
        self.samples = 0
        """Number of samples that wait to be fetched."""
        self._updates = deque([_PendingUpdate(restarted=False)])
        self._dropped = 0

    def __len__(self) -> int:
        """Number of updates that wait to be fetched."""
        return len(self._updates)

    def say(self, sentence: str) -> None:
        """Add a message for the user, in order with the samples."""
        self._updates[-1].messages.append(sentence)

    def add_sync(self, number: int, t_us: int, host_us: int) -> None:
        """Add a sync pulse: its number, the controller's time and the host's time of arrival [us]."""
        self._updates[-1].sync.append((number, t_us, host_us))

    def add_sample(self, t_us: int, angle: float, index_t_us: Iterable[int]) -> None:
        """Add a sample and the index pulses before it; drop the oldest sample if there are too many."""
        latest = self._updates[-1]
        latest.index.extend(index_t_us)
        latest.samples.append((t_us, angle))
        self.samples += 1
        if self.samples > MOST_WAITING_SAMPLES:
            dropped_us, _ = self._updates[0].samples.popleft()
            while (pulses := self._updates[0].index) and pulses[0] <= dropped_us:
                pulses.popleft()
            self.samples -= 1
            self._dropped += 1
            if not self._updates[0].samples:
                self._merge_first()

    def restart(self) -> None:
        """Begin a new update, because the controller's clock or counts restarted."""
        if self._updates[-1].samples:
            self._updates.append(_PendingUpdate(restarted=True))
        if len(self._updates) > MOST_UPDATES:
            dropped = len(self._updates[0].samples)
            self.samples -= dropped
            self._dropped += dropped
            self._merge_first()
        latest = self._updates[-1]
        latest.restarted = True
        latest.sync.clear()  # the times of these pulses are on the clock before the restart

    def take(self) -> LinkUpdate:
        """Remove and return the oldest update."""
        update = self._updates.popleft()
        if not self._updates:
            self._updates.append(_PendingUpdate(restarted=False))
        self.samples -= len(update.samples)
        if self._dropped:
            update.messages.append(
                f"{self._dropped:,} samples were dropped, the oldest: they were not fetched in time"
            )
            self._dropped = 0
        return update.finished()

    def _merge_first(self) -> None:
        """Merge the first update, whose samples are dropped, into the second, which began with a restart."""
        dropped = self._updates.popleft()
        update = self._updates[0]
        update.messages.extendleft(reversed(dropped.messages))
