"""What came from the controller, in parts between which its clock or counts began anew."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_PULSES, MOST_PARTS = 10_000, 64
"""Index or sync pulses kept in a part of the news, and parts: a new one begins where the controller began anew."""


@dataclass(frozen=True, slots=True, eq=False)
class News:
    """What came from the controller since one asked last, or until it began anew."""

    t_us: NDArray[np.int64]
    """Times of the encoder's samples [us], controller's clock made whole, strictly increasing, shape ``(n,)``."""
    angle: NDArray[np.float64]
    """Unwrapped prism angle [rad] at them, whole turns at the index once it was seen, shape ``(n,)``."""
    index_t_us: NDArray[np.int64]
    """Times of the index pulses among them, or between those before and these [us]."""
    sync: tuple[tuple[int, int, int], ...]
    """Sync pulses: number, controller's time, host's time when it was told [us]."""
    restarted: bool
    """The controller's clock or counts began anew before these samples: what was known of its clock is void."""
    messages: tuple[str, ...]
    """Sentences for the user: slip, missed index, reversal, stall, faults, losses, resets, the port gone and back."""


class Part:
    """News in the making, bounded: see :data:`MOST_PULSES`; the follower bounds the samples."""

    def __init__(self, restarted: bool) -> None:
        self.restarted = restarted
        self.samples: deque[tuple[int, float]] = deque()
        self.index: deque[int] = deque(maxlen=MOST_PULSES)
        self.sync: deque[tuple[int, int, int]] = deque(maxlen=MOST_PULSES)
        self.messages: deque[str] = deque(maxlen=1000)

    def news(self) -> News:
        t = np.array([t for t, _ in self.samples], np.int64)
        angle = np.array([a for _, a in self.samples], np.float64)
        return News(t, angle, np.array(self.index, np.int64), tuple(self.sync), self.restarted, tuple(self.messages))
