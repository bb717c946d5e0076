"""Encoder of events in Prophesee's EVT 3.0, and writer of RAW files with them.

EVT 3.0 consists of 16-bit words that set the state of the decoder: upper and lower 12 bits of the time, row, and column
with polarity. The last one is an event. A word is written if its value changes. The format is described at
https://docs.prophesee.ai/stable/data/encoding_formats/evt3.html. faery's encoder is not used, because it loses gaps of
more than 16.8 s, the range of the 24 bits of the time.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.events import Events
from amiwarp.io.output_formats import LONGEST_US, Outline

ADDR_Y, ADDR_X, TIME_LOW, TIME_HIGH = 0x0000, 0x2000, 0x6000, 0x8000
"""Types of the words, in their upper four bits."""

LOW_BITS = 12
"""Bits of the time in each of the two words."""

STOPS = (0x000, 0x7FF, 0xFFF)
"""Values that the upper bits of the time never skip. Decoders take other large steps for a step back or for a wrap."""


def origin_of(about: Outline) -> int:
    """Return the time at which the clock of EVT 3.0 starts [us]: 0, or the first event if that is very late."""
    return 0 if about.t_last <= LONGEST_US else about.t_first


class Evt3Encoder:
    """Encoder of events that follow one another in time, from ``origin`` [us] on."""

    def __init__(self, origin: int) -> None:
        self._origin = origin
        self._last: tuple[int, int, int] | None = None  # upper bits of the time, time, row

    def encode(self, events: Events, *, self_contained: bool = False) -> NDArray[np.uint16]:
        """Return the words of some events, at least one. Self-contained words begin with time and row."""
        t = events.t - self._origin
        high, y = t >> LOW_BITS, events.y
        begins = self_contained or self._last is None
        last_high, last_t, last_y = self._last or (0, 0, 0)
        words = np.empty((len(events), 4), np.uint16)
        used = np.ones((len(events), 4), np.bool_)
        for at, values, last in ((0, high, last_high), (1, t, last_t), (2, y, last_y)):
            np.not_equal(values[1:], values[:-1], out=used[1:, at])
            used[0, at] = begins or values[0] != last
        words[:, 0] = TIME_HIGH | (high & 0xFFF)
        words[:, 1] = TIME_LOW | (t & 0xFFF)
        words[:, 2] = ADDR_Y | y
        words[:, 3] = ADDR_X | (events.p.astype(np.uint16) << 11) | events.x
        self._last = int(high[-1]), int(t[-1]), int(y[-1])
        return _with_stops(words[used], used, np.concatenate([[last_high], high]))


def _with_stops(words: NDArray[np.uint16], used: NDArray[np.bool_], high: NDArray[np.int64]) -> NDArray[np.uint16]:
    """Insert words for the stops that the upper bits of the time skip before an event."""
    steps = np.flatnonzero(np.diff(high) > 1)
    stops = [_stops_between(int(high[at]), int(high[at + 1])) for at in steps]
    skipped = [(at, values) for at, values in zip(steps.tolist(), stops, strict=True) if values.size]
    if not skipped:
        return words
    first_word = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
    places = np.concatenate([np.full(values.size, first_word[at]) for at, values in skipped])
    return np.insert(words, places, np.concatenate([TIME_HIGH | values for _, values in skipped]))


def _stops_between(low: int, high: int) -> NDArray[np.uint16]:
    """Return the stops above ``low`` and below ``high``, in order, modulo 4096."""
    turns = np.arange(low >> LOW_BITS, (high >> LOW_BITS) + 1) << LOW_BITS
    stops = (turns[:, None] + np.array(STOPS)).ravel()
    return (stops[(stops > low) & (stops < high)] & 0xFFF).astype(np.uint16)


def write_evt3(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a RAW file. Its header has the lines that Prophesee's own programs need."""
    size = f"height={about.height};width={about.width}"
    origin = origin_of(about)
    header = [
        "camera_integrator_name Prophesee",
        "evt 3.0",
        f"format EVT3;{size}",
        f"geometry {about.width}x{about.height}",
        "plugin_integrator_name Prophesee",
        "plugin_name hal_plugin_prophesee",
        *([f"t0 {origin}"] if origin else []),
        "end",
    ]
    encoder = Evt3Encoder(origin)
    with part.open("xb") as file:
        file.write("".join(f"% {line}\n" for line in header).encode())
        for events in blocks:
            file.write(encoder.encode(events).astype("<u2").data)
