"""Events of Prophesee's EVT words in ROS bags, which are decoded in the program, as in RAW files."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.io.event_packets import Packet
from amiwarp.io.prophesee.evt_decoder import EvtDecoder, Triggers
from amiwarp.io.reading_process import packets
from amiwarp.io.ros.order import RESTART, note_largest_gap
from amiwarp.io.ros.reading import read_words
from amiwarp.io.ros.words import Layout

Integers = NDArray[np.int64]


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
    offset_us = 0
    latest_us = 0
    found = packets(read_words, path, topic, layout.encoding, layout.swapped, notes)
    for words, lengths, shifts, missing, recorded, stamps in found:
        ends = np.cumsum(lengths)
        starts = ends - lengths
        cuts = _cuts(shifts, missing, notes.get("largest_packet_gap", 0))
        for first, stop in itertools.pairwise(cuts):
            messages = slice(first, stop)
            part = words[starts[first] : ends[stop - 1]]
            shift_us = int(shifts[first])
            note_largest_gap(notes, int(missing[first]), latest_us)
            on_device, edges = decoder.decode(part)
            events = on_device.to_host()

            offset_us += shift_us
            is_new_clock = shift_us != 0 or missing[first] == RESTART
            if is_new_clock and events.t.size:
                # Time never goes back.
                begin_us = int(events.t[0]) + offset_us
                offset_us += max(latest_us - begin_us, 0)
            if offset_us:
                np.add(events.t, offset_us, out=events.t)
                np.add(edges.t, offset_us, out=edges.t)
            if events.t.size:
                # The events of a late message are earlier.
                latest_us = max(latest_us, int(events.t[-1]))

            notes["triggers"] = notes.get("triggers", 0) + len(edges.t)
            notes["unknown_words"] = decoder.unknown
            yield Decoded(
                events=events,
                edges=edges,
                words=part,
                lengths=lengths[messages],
                recorded=recorded[messages],
                stamps=stamps[messages],
            )


def _cuts(shifts: Integers, missing: Integers, largest_gap: int) -> list[int]:
    """Return the indices at which messages are cut into parts that are decoded at the same time.

    A part begins where the clock is shifted or restarts, and behind a gap if it is the largest so far, because the time
    of this gap is noted: the messages before it are decoded first.
    """
    gaps = np.concatenate([[largest_gap], missing])
    largest_before = np.maximum.accumulate(gaps)[:-1]
    is_new_clock = (shifts != 0) | (missing == RESTART)
    is_largest = missing > largest_before
    begins = np.flatnonzero(is_new_clock | is_largest)
    edges = np.concatenate([[0], begins, [len(shifts)]])
    return np.unique(edges).tolist()


def event_packets(
    path: Path,
    topic: str,
    layout: Layout,
    notes: dict[str, int],
) -> Iterator[Packet]:
    """Yield the events of a topic."""
    for part in decoded(path, topic, layout, notes):
        yield part.events


def edge_packets(path: Path, topic: str, layout: Layout) -> Iterator[Packet]:
    """Yield the edges of the triggers of a topic."""
    for part in decoded(path, topic, layout, {}):
        edges = part.edges
        yield edges.channel, np.zeros_like(edges.channel), edges.t, edges.rising


def stamp_packets(
    path: Path,
    topic: str,
    layout: Layout,
) -> Iterator[tuple[Integers, ...]]:
    """Yield for messages with events: the times of the first event [us], of the recording and of the header [ns]."""
    for part in decoded(path, topic, layout, {}):
        events_until = np.cumsum(layout.counts(part.words), dtype=np.int64)
        events_before = np.concatenate([[0], events_until])
        ends = np.cumsum(part.lengths)
        starts = ends - part.lengths
        first = events_before[starts]
        holds = events_before[ends] > first
        t = part.events.t[first[holds]]
        yield t, part.recorded[holds], part.stamps[holds]
