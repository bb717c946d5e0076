"""The prism's encoder from the external trigger edges that a camera recorded with its events."""

from __future__ import annotations

import contextlib
import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TWO_PI, Encoder
from amiwarp.io.formats import Format, detect_format
from amiwarp.io.input_files import errors_name
from amiwarp.validation import whole

READERS = {
    Format.EVT: "prophesee",
    Format.AEDAT4: "aedat",
    Format.AEDAT3: "aedat3",
    Format.AEDAT2: "aedat2",
    Format.ROSBAG: "rosbag",
    Format.HDF5: "hdf5_rows",
}
"""Modules of amiwarp.io whose ``trigger_packets`` reads the edges of a format."""

MOST_EDGES = 1 << 26
"""Largest number of edges that is read: 5 hours at 3.6 kHz."""


def read_encoder_triggers(
    path: str | os.PathLike[str],
    channel: int = 0,
    *,
    counts_per_turn: int = 1,
    direction: int = 1,
    topic: str | None = None,
) -> Encoder:
    """Return the encoder whose pulses a camera recorded at its trigger input, on the clock of the events.

    Each rising edge of ``channel`` moves the angle by one count, or back if ``direction`` is -1. With one count per
    turn the edges are index pulses, at which the angle is a multiple of 2 pi. ``topic`` chooses a topic of a ROS bag.
    Raises :class:`AmiwarpError` if the file stores no triggers, or fewer than two rising edges of the channel.
    """
    path = Path(path)
    whole(channel, "channel", 0, 255)
    whole(counts_per_turn, "counts_per_turn", 1, 1 << 40)
    if direction not in (1, -1):
        raise AmiwarpError(f"direction = {direction}; expected 1 or -1")
    found = detect_format(path)
    if found not in READERS:
        formats = ", ".join(one.value for one in READERS)
        raise AmiwarpError(f"{path}: files of the format {found.value} store no triggers; expected one of {formats}")
    with errors_name(path, lambda: "reading the triggers"):
        channels, t, rising = _edges(path, found, topic)
    at = np.unique(t[(channels == channel) & rising])
    if at.size < 2:
        counts = {int(one): int(np.count_nonzero(channels[rising] == one)) for one in np.unique(channels)}
        listed = ", ".join(f"{count} of channel {one}" for one, count in counts.items()) or "none"
        given = f"{path}: has {at.size} rising trigger edges of channel {channel}"
        raise AmiwarpError(f"{given}; expected at least 2; the rising edges are: {listed}")
    angle = np.arange(at.size, dtype=np.float64) * (direction * TWO_PI / counts_per_turn)
    return Encoder(at, angle, index_t=at.copy() if counts_per_turn == 1 else None)


def _edges(path: Path, found: Format, topic: str | None) -> tuple[Any, Any, Any]:
    """Return channel, time [us] and whether it rises, of each edge."""
    module: Any = importlib.import_module(f"amiwarp.io.{READERS[found]}")
    chosen = (topic,) if found is Format.ROSBAG else ()
    source: Any = module.trigger_packets(path, *chosen)
    parts: list[tuple[Any, ...]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.bool_))]
    count = 0
    with contextlib.closing(source):
        for channel, _, t, rising in source:
            parts.append((channel.astype(np.int64), t.astype(np.int64), rising > 0))
            count += len(t)
            if count > MOST_EDGES:
                raise AmiwarpError(f"has over {MOST_EDGES} trigger edges; expected those of an encoder")
    channels, times, edges = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return channels, times, edges
