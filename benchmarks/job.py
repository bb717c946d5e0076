"""The job that a case gives to the runner."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Job:
    """One method on one scene and device, with its data prepared."""

    run: Callable[[], Any]
    """One pass, which is timed. On CUDA it may return before the device is done."""
    errors: Callable[[], dict[str, float]]
    """Function that returns the errors of the latest pass by name; the case has limits for them."""
    work: float = 1.0
    """Work of one pass, in the case's unit."""
    also: Callable[[], dict[str, float]] = dict
    """Function that returns further results by name."""
    seconds: Iterator[float] | None = None
    """Durations of passes that were timed in another process [s]; ``run`` then does nothing."""
    note: str = ""
    """How the case differs on this machine, if it does."""
