"""Fewer events of a recording, evenly."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.events.events import Events, MemoryEvents
from amiwarp.kernels.launch import pool

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.recording import Recording

RUN = 8
"""Events that stay together where a recording is thinned: a cache line of times."""


def thin(recording: Recording, most: int) -> Events:
    """At most ``most`` events, evenly: every k-th run of the recording's; of a file read in blocks."""
    source = recording.events
    step = max(1, -(-len(source) // most))
    if step == 1:
        return Events.concatenate(list(source.blocks()))
    if isinstance(source, MemoryEvents):
        return _runs(source.slice(0, len(source)), step)
    # blocks of whole periods, so that every run but the last is whole
    blocks = source.blocks(count=step * RUN * max(1, (1 << 20) // (step * RUN)))
    return Events.concatenate([_runs(block, step) for block in blocks])


def _runs(block: Events, step: int) -> Events:
    """The first of every ``step`` runs, copied, so that the block itself can go."""
    whole = len(block) // (step * RUN) * step * RUN

    def pick(values: NDArray[Any]) -> NDArray[Any]:
        runs, rest = values[:whole].reshape(-1, step * RUN)[:, :RUN], values[whole : whole + RUN]
        out = np.empty(runs.size + rest.size, values.dtype)
        out[: runs.size].reshape(runs.shape)[:] = runs
        out[runs.size :] = rest
        return out

    return Events(*pool().map(pick, (block.x, block.y, block.t, block.p)))
