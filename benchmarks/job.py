"""What a case hands to the runner."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Job:
    """One method on one scene and device, its data in place."""

    run: Callable[[], Any]
    """One pass, which is timed. On CUDA it may return before the device is done."""
    errors: Callable[[], dict[str, float]]
    """Errors by name of what the latest pass left; the case has bars for them."""
    work: float = 1.0
    """What a pass gets done, in the case's unit."""
    also: Callable[[], dict[str, float]] = dict
    """What else there is to tell, by name."""
    seconds: Iterator[float] | None = None
    """Of passes that clocked themselves, in a process of their own; ``run`` has nothing to do then."""
    note: str = ""
    """How this machine made it differ from what the case says."""
