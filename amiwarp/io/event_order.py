"""Order of the events of a file in time: what blocks of them hold, repair of late times, and sorting."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.io.event_packets import Packet, Surveyed
from amiwarp.io.inputs import errors_name
from amiwarp.validation import rounded_times

Pass: TypeAlias = Callable[[dict[str, int]], Iterator[Packet]]
"""Function that starts a pass over the events of a file, and notes what it counts."""

CHECKED_EVENTS = 1 << 15
"""Number of events that one thread checks."""

SORT_EVENTS = 1 << 25
"""Largest recording that is sorted by time [events], for which 1.2 GB of memory are needed."""


def surveys_of(events: Events) -> NDArray[Any]:
    """Return what blocks of some events hold, see :class:`amiwarp.kernels.event_survey.Survey`."""
    import warp as wp

    from amiwarp.kernels.event_survey import Survey, survey_events
    from amiwarp.kernels.launch import launch
    from amiwarp.kernels.quiet_start import start_once

    start_once()
    blocks = math.ceil(len(events) / CHECKED_EVENTS)
    surveys = wp.empty(blocks, dtype=Survey, device="cpu")
    inputs = [
        wp.array(events.x, device="cpu", copy=False),
        wp.array(events.y, device="cpu", copy=False),
        wp.array(events.t, device="cpu", copy=False),
        CHECKED_EVENTS,
    ]
    launch(survey_events, blocks, inputs, [surveys], device="cpu", smallest=1)
    return np.asarray(surveys.numpy())


def raise_late_times(events: Events, before: int) -> tuple[int, int]:
    """Raise each time to the largest so far, in place. ``before``: largest time before the events [us].

    Returns the number of raised times, and the largest step [us].
    """
    import warp as wp

    from amiwarp.kernels.event_survey import raise_times
    from amiwarp.kernels.launch import launch

    # The largest time before each block.
    latest = surveys_of(events)["latest"]
    latest_before = np.concatenate([[before], latest[:-1]])
    floors = np.maximum.accumulate(latest_before)

    blocks = latest.size
    t = wp.array(events.t, device="cpu", copy=False)
    raised = wp.empty(blocks, dtype=int, device="cpu")
    furthest = wp.empty(blocks, dtype=wp.int64, device="cpu")
    launch(
        raise_times,
        blocks,
        [CHECKED_EVENTS, wp.array(floors, dtype=wp.int64, device="cpu")],
        [t, raised, furthest],
        device="cpu",
        smallest=1,
    )
    return int(raised.numpy().sum()), int(furthest.numpy().max())


def sorted_packets(path: Path, packets: Pass) -> Pass:
    """Return a function that starts a pass over the events in the order of time. They are all kept in memory.

    Events of equal times keep their order. Raises :class:`AmiwarpError` for more than :data:`SORT_EVENTS` events.
    """
    counts: dict[str, int] = {}
    parts: list[tuple[NDArray[Any], ...]] = []
    count = 0
    with errors_name(path, lambda: f"after {count} events"):
        for packet in packets(counts):
            part = _columns_of(packet)
            parts.append(part)
            count += len(part[2])
            if count > SORT_EVENTS:
                raise AmiwarpError(
                    f"holds over {SORT_EVENTS:,} events, too many to sort; sort the file by time"
                )
        if not parts:
            return lambda notes: iter(())
        x, y, t, p = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        parts.clear()
        times = rounded_times(t)
        order = np.argsort(times, kind="stable")
        is_moved = order != np.arange(order.size)
        counts["sorted_events"] = int(np.count_nonzero(is_moved))
        in_order = x[order], y[order], times[order], p[order]

    def start(notes: dict[str, int]) -> Iterator[Packet]:
        notes.update(counts)
        yield in_order

    return start


def _columns_of(packet: Packet) -> tuple[NDArray[Any], ...]:
    """Return x, y, t and p of a packet."""
    if isinstance(packet, Surveyed):
        packet = packet.events
    if isinstance(packet, Events):
        return packet.x, packet.y, packet.t, packet.p
    return packet
