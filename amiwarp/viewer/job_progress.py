"""Progress of long work in threads."""

import asyncio
import math
import weakref
from collections.abc import Callable

PROGRESS_S = 0.1
"""Shortest interval between two progress messages of a job [s]. The page would draw each of eighty per second."""


class JobCancelled(Exception):
    """Raised to stop work whose result is no longer needed."""


class JobProgress:
    """Progress callback of a job in a thread. It stops the job once ``cancelled`` is set.

    It holds the page by a weak reference, because NLopt never releases its callbacks.
    """

    def __init__(self, show: Callable[[str, float], None]) -> None:
        """``show``: method of the page that shows the name of a step and the finished share, 0 to 1."""
        self.cancelled = False
        self.ended = False
        """Whether a film ends with the pictures made so far."""
        self._show = weakref.WeakMethod(show)
        self._loop = asyncio.get_running_loop()
        self._last_s = -math.inf

    def __call__(self, what: str, share: float) -> None:
        if self.cancelled or self._show() is None:
            raise JobCancelled
        now = self._loop.time()
        if now >= self._last_s + PROGRESS_S:
            self._last_s = now
            self._loop.call_soon_threadsafe(self._pass_on, what, share)

    def _pass_on(self, what: str, share: float) -> None:
        show = self._show()
        if show is not None and not self.cancelled:
            show(what, share)
