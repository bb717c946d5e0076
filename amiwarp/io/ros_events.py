"""Events of Prophesee's EVT words in ROS bags, which are decoded in the program, as those of RAW files."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.io.evt_decoder import EvtDecoder, Triggers
from amiwarp.io.file_scan import Packet
from amiwarp.io.reading_process import packets
from amiwarp.io.ros_order import RESTART, note_largest_gap
from amiwarp.io.ros_words import Layout, read_words


class Decoded(NamedTuple):
    """Events of consecutive messages."""

    events: Events
    """The events."""
    edges: Triggers
    """Edges of triggers."""
    words: NDArray[Any]
    """The words."""
    lengths: NDArray[np.int64]
    """Number of words of each message."""
    recorded: NDArray[np.int64]
    """Time of the recording of each message [ns]."""
    stamps: NDArray[np.int64]
    """Time in the header of each message [ns]."""


def decoded(path: Path, topic: str, layout: Layout, notes: dict[str, int]) -> Iterator[Decoded]:
    """Yield the events of the messages of a topic, many messages at a time, and note what was counted."""
    decoder = EvtDecoder(layout.version, swapped=layout.swapped)
    offset = latest = 0
    found = packets(read_words, path, topic, layout.encoding, layout.swapped, notes)
    for words, lengths, shifts, missing, recorded, stamps in found:
        ends = np.cumsum(lengths)
        # The messages before a gap are decoded first only if it is the largest so far, so that its time is known.
        largest = np.maximum.accumulate(np.concatenate([[notes.get("largest_packet_gap", 0)], missing]))[:-1]
        apart = np.flatnonzero((shifts != 0) | (missing == RESTART) | (missing > largest))
        cuts = np.unique(np.concatenate([[0], apart, [len(lengths)]])).tolist()
        for start, stop in itertools.pairwise(cuts):
            part = words[ends[start] - lengths[start] : ends[stop - 1]]
            note_largest_gap(notes, int(missing[start]), latest)
            offset += int(shifts[start])
            on_device, edges = decoder.decode(part)
            events = on_device.to_host()
            if (shifts[start] or missing[start] == RESTART) and events.t.size:  # time never goes back
                offset += max(latest - int(events.t[0]) - offset, 0)
            if offset:
                np.add(events.t, offset, out=events.t)
                np.add(edges.t, offset, out=edges.t)
            if events.t.size:
                latest = max(latest, int(events.t[-1]))  # the events of a late message are earlier
            notes["triggers"] = notes.get("triggers", 0) + len(edges.t)
            notes["unknown_words"] = decoder.unknown
            yield Decoded(events, edges, part, lengths[start:stop], recorded[start:stop], stamps[start:stop])


def event_packets(path: Path, topic: str, layout: Layout, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of a topic."""
    for part in decoded(path, topic, layout, notes):
        yield part.events


def edge_packets(path: Path, topic: str, layout: Layout) -> Iterator[Packet]:
    """Yield the edges of the triggers of a topic."""
    for part in decoded(path, topic, layout, {}):
        edges = part.edges
        yield edges.channel, np.zeros_like(edges.channel), edges.t, edges.rising


def stamp_packets(path: Path, topic: str, layout: Layout) -> Iterator[tuple[NDArray[np.int64], ...]]:
    """Yield for messages with events: the times of the first event [us], of the recording and of the header [ns]."""
    for part in decoded(path, topic, layout, {}):
        events_before = np.concatenate([[0], np.cumsum(layout.counts(part.words), dtype=np.int64)])
        ends = np.cumsum(part.lengths)
        first = events_before[ends - part.lengths]
        holds = events_before[ends] > first
        yield part.events.t[first[holds]], part.recorded[holds], part.stamps[holds]
