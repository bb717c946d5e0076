"""Job that a benchmark case gives to the program that times it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Job:
    """One method with its data prepared for one scene and device."""

    run: Callable[[], Any]
    """Function that runs one pass, which is timed. On CUDA it may return before the device has finished."""
    errors: Callable[[], dict[str, float]]
    """Function that returns the errors of the latest pass by name; the case has limits for them."""
    work: float = 1.0
    """Amount of work in one pass, in the unit of the case."""
    also: Callable[[], dict[str, float]] = dict
    """Function that returns further results of the latest pass by name."""
    seconds: Iterator[float] | None = None
    """Durations of passes that were timed in another process [s]; ``run`` then does nothing."""
    note: str = ""
    """Text that says how the case differs on this machine; empty if it does not."""
