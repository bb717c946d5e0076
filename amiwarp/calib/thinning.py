"""Choice of the events of a recording: a window about its middle, and even thinning."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.settings import Settings
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.kernels.workers import pool
from amiwarp.results.parameters import MOTION

ROTATION_WINDOW_TURNS = 2.1
ROTATION_WINDOW_US = 100_000.0
"""Length of the part of a recording that is used if the camera's rotation is free: in turns, or without a prism in
microseconds."""
RUN = 8
"""Number of consecutive events that thinning keeps together: their times fill one cache line."""
MOST_IN_BLOCK = 1 << 20
"""Approximate number of events that are read from a file at once."""


def middle_time(recording: Recording) -> int:
    """Return the middle time of the recording [us], about which a change of speed changes the phase least."""
    return (recording.events.t_first + recording.events.t_last) // 2


def rotation_window(recording: Recording, settings: Settings) -> Recording:
    """Return two turns from the recording's middle if the camera's rotation is free, else the recording itself.

    The rotation model holds for a short time only.
    """
    free = settings.free or ()
    if "motion" not in free and set(MOTION).isdisjoint(free):
        return recording
    encoder = recording.encoder
    events = recording.events
    rpm = settings.start.get("rpm", 0.0) if encoder is None else encoder.rpm
    length_us = ROTATION_WINDOW_US
    if abs(rpm) > 1e-3:
        length_us = ROTATION_WINDOW_TURNS * 60e6 / abs(rpm)
    middle_us = middle_time(recording)
    first_us = round(middle_us - length_us / 2)
    last_us = round(middle_us + length_us / 2)
    cut = events.between(first_us, last_us)
    return replace(recording, events=MemoryEvents(cut, *events.size))


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
    stride = step * RUN
    strides = max(1, MOST_IN_BLOCK // stride)
    blocks = source.blocks(count=stride * strides)
    return Events.concatenate([_every_run(block, step) for block in blocks])


def thin_events(events: Events, most: int) -> Events:
    """Return about ``most`` of the events, evenly thinned: every k-th run of :data:`RUN` events; all are not copied."""
    step = _step(len(events), most)
    if step == 1:
        return events
    return _every_run(events, step)


def _step(count: int, most: int) -> int:
    """Return k such that every k-th run of ``count`` events holds about ``most`` of them."""
    return max(1, -(-count // most))


def _every_run(block: Events, step: int) -> Events:
    """Return a copy of every ``step``-th run of :data:`RUN` events, so that the block's memory can be freed."""
    stride = step * RUN
    whole = len(block) // stride * stride

    def pick(values: NDArray[Any]) -> NDArray[Any]:
        steps = values[:whole].reshape(-1, stride)
        runs = steps[:, :RUN]
        rest = values[whole : whole + RUN]  # of the last, incomplete step
        picked = np.empty(runs.size + rest.size, values.dtype)
        picked[: runs.size].reshape(runs.shape)[:] = runs
        picked[runs.size :] = rest
        return picked

    columns = (block.x, block.y, block.t, block.p)
    return Events(*pool().map(pick, columns))
