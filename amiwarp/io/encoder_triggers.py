"""The prism's encoder from the external trigger edges that a camera recorded with its events."""

import contextlib
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.unwrapping import check_direction
from amiwarp.io.formats import TRIGGERS, Format, check_topic, detect_format, io_function
from amiwarp.io.inputs import errors_name
from amiwarp.validation import whole

MOST_EDGES = 1 << 26
"""Largest number of edges that is read: 5 hours at 3.6 kHz."""


def read_encoder_triggers(
    path: str | os.PathLike[str],
    channel: int = 0,
    *,
    counts_per_turn: int = 1,
    direction: int = 1,
    topic: str | None = None,
    chip: str | None = None,
) -> Encoder:
    """Return the encoder whose pulses a camera recorded at its trigger input, on the clock of the events.

    Each rising edge of ``channel`` moves the angle by one count, or back if ``direction`` is -1. With one count per
    turn the edges are index pulses, at which the angle is a multiple of 2 pi. ``topic`` chooses a topic of a ROS bag,
    and ``chip`` is the camera's in an AEDAT 2.0 file that does not state it.
    Raises :class:`AmiwarpError` if the file stores no triggers, or fewer than two rising edges of the channel.
    """
    path = Path(path)
    whole(channel, "channel", 0, 255)
    whole(counts_per_turn, "counts_per_turn", 1, 1 << 40)
    check_direction(direction)
    format = detect_format(path)
    if format not in TRIGGERS:
        formats = ", ".join(known.value for known in TRIGGERS)
        raise AmiwarpError(
            f"{path}: files of the format {format.value} store no triggers; expected one of {formats}",
            ErrorCode.CONTENT_MISSING,
        )
    check_topic(path, topic, format)
    with errors_name(path, lambda: "reading the triggers"):
        channels, t, rising = _edges(path, format, topic, chip)
    pulse_t = np.unique(t[(channels == channel) & rising])
    if pulse_t.size < 2:
        counts = []
        for number in np.unique(channels).tolist():
            count = int(np.count_nonzero(channels[rising] == number))
            counts.append(f"{count} of channel {number}")
        given = f"{path}: has {pulse_t.size} rising trigger edges of channel {channel}"
        listed = ", ".join(counts) or "none"
        raise AmiwarpError(
            f"{given}; expected at least 2; the rising edges are: {listed}",
            ErrorCode.CONTENT_MISSING,
        )
    step_rad = direction * math.tau / counts_per_turn
    angle = np.arange(pulse_t.size, dtype=np.float64) * step_rad
    index_t = pulse_t.copy() if counts_per_turn == 1 else None
    return Encoder(pulse_t, angle, index_t=index_t)


def _edges(path: Path, format: Format, topic: str | None, chip: str | None) -> tuple[Any, Any, Any]:
    """Return channel, time [us] and whether it rises, of each edge."""
    # What only files of one format leave open
    choices: dict[Format, str | None] = {Format.ROSBAG: topic, Format.AEDAT2: chip}
    chosen = [choices[format]] if format in choices else []
    source: Any = io_function(TRIGGERS[format])(path, *chosen)
    nothing = np.zeros(0, np.int64)
    parts: list[tuple[Any, ...]] = [(nothing, nothing, np.zeros(0, np.bool_))]
    count = 0
    with contextlib.closing(source):
        for channel, _, t, rising in source:
            parts.append((channel.astype(np.int64), t.astype(np.int64), rising > 0))
            count += len(t)
            if count > MOST_EDGES:
                raise AmiwarpError(
                    f"has over {MOST_EDGES} trigger edges; expected the edges of an encoder"
                )
    channels, times, edges = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return channels, times, edges
