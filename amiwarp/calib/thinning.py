"""Even thinning of a recording's events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.events.events import Events, MemoryEvents
from amiwarp.kernels.launch import pool

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.recording import Recording

RUN = 8
"""Number of consecutive events that thinning keeps together: their times fill one cache line."""


def thin(recording: Recording, most: int) -> Events:
    """Return about ``most`` events of a recording, evenly thinned. Files are read in blocks.

    All events of a recording in memory are not copied.
    """
    source = recording.events
    if isinstance(source, MemoryEvents):
        return thin_events(source.slice(0, len(source)), most)
    step = _step(len(source), most)
    if step == 1:
        return Events.concatenate(list(source.blocks()))
    # a block holds a whole number of steps, so that only the last run of the recording can be cut
    blocks = source.blocks(count=step * RUN * max(1, (1 << 20) // (step * RUN)))
    return Events.concatenate([_every_run(block, step) for block in blocks])


def thin_events(events: Events, most: int) -> Events:
    """Return about ``most`` of the events, evenly thinned: every k-th run of :data:`RUN` events; all are not copied."""
    step = _step(len(events), most)
    return events if step == 1 else _every_run(events, step)


def _step(count: int, most: int) -> int:
    """Return k such that every k-th run of ``count`` events holds about ``most`` of them."""
    return max(1, -(-count // most))


def _every_run(block: Events, step: int) -> Events:
    """Return a copy of every ``step``-th run of :data:`RUN` events, so that the block's memory can be freed."""
    whole = len(block) // (step * RUN) * step * RUN

    def pick(values: NDArray[Any]) -> NDArray[Any]:
        runs, rest = values[:whole].reshape(-1, step * RUN)[:, :RUN], values[whole : whole + RUN]
        out = np.empty(runs.size + rest.size, values.dtype)
        out[: runs.size].reshape(runs.shape)[:] = runs
        out[runs.size :] = rest
        return out

    return Events(*pool().map(pick, (block.x, block.y, block.t, block.p)))
