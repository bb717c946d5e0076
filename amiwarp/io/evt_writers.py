"""Encoders of events in Prophesee's EVT 3.0 and 2.1, and writers of RAW files with them."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp import evt_types
from amiwarp.events.recording import Events
from amiwarp.io.formats import LONGEST_EVT21_US, Outline, origin_of

# Encoder of events in Prophesee's EVT 3.0, and writer of RAW files with them.
#
# EVT 3.0 consists of 16-bit words that set the state of the decoder: upper and lower 12 bits of the time, row, and
# column with polarity. The last one is an event. A word is written if its value changes. The format is described at
# https://docs.prophesee.ai/stable/data/encoding_formats/evt3.html. faery's encoder is not used, because it loses gaps
# of more than 16.8 s, the range of the 24 bits of the time.

ROW_WORD = evt_types.ROW << 12
SINGLE_WORD = evt_types.SINGLE << 12
TIME_LOW_WORD = evt_types.TIME_LOW << 12
TIME_HIGH_WORD = evt_types.TIME_HIGH << 12

LOW_BITS = 12
"""Bits of the time in each of the two words."""

STOPS = (0x000, 0x7FF, 0xFFF)
"""Values that the upper bits of the time never skip. Decoders take other large steps for a step back or for a wrap."""


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
        words[:, 0] = TIME_HIGH_WORD | (high & 0xFFF)
        words[:, 1] = TIME_LOW_WORD | (t & 0xFFF)
        words[:, 2] = ROW_WORD | y
        words[:, 3] = SINGLE_WORD | (events.p.astype(np.uint16) << 11) | events.x
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
    return np.insert(words, places, np.concatenate([TIME_HIGH_WORD | values for _, values in skipped]))


def _stops_between(low: int, high: int) -> NDArray[np.uint16]:
    """Return the stops above ``low`` and below ``high``, in order, modulo 4096."""
    turns = np.arange(low >> LOW_BITS, (high >> LOW_BITS) + 1) << LOW_BITS
    stops = (turns[:, None] + np.array(STOPS)).ravel()
    return (stops[(stops > low) & (stops < high)] & 0xFFF).astype(np.uint16)


def _raw_header(about: Outline, version: str, name: str, origin: int, more: str = "") -> bytes:
    """Return the header of a RAW file, with the lines that Prophesee's own programs need."""
    lines = [
        "camera_integrator_name Prophesee",
        f"evt {version}",
        f"format {name};height={about.height};width={about.width}{more}",
        f"geometry {about.width}x{about.height}",
        "plugin_integrator_name Prophesee",
        "plugin_name hal_plugin_prophesee",
        *([f"t0 {origin}"] if origin else []),
        "end",
    ]
    return "".join(f"% {line}\n" for line in lines).encode()


def write_evt3(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a RAW file in EVT 3.0."""
    origin = origin_of(about)
    encoder = Evt3Encoder(origin)
    with part.open("xb") as file:
        file.write(_raw_header(about, "3.0", "EVT3", origin))
        for events in blocks:
            file.write(encoder.encode(events).astype("<u2").data)


# Writer of RAW files in EVT 2.1.
#
# EVT 2.1 consists of 64-bit words: the upper 28 bits of the time, or the lower 6 bits with row, column, polarity and
# the 32 pixels from that column on, one bit for each with an event. Successive events share a word as long as their
# columns rise, because a decoder returns them in the order of the columns: so the order of the events is kept. The
# format is described at https://docs.prophesee.ai/stable/data/encoding_formats/evt21.html.

VECTOR = 32
"""Pixels of a word."""


class Evt21Encoder:
    """Encoder of events that follow one another in time, from ``origin`` [us] on."""

    def __init__(self, origin: int) -> None:
        self._origin = origin
        self._high: int | None = None

    def encode(self, events: Events) -> NDArray[np.uint64]:
        """Return the words of some events, at least one."""
        t = (events.t - self._origin).astype(np.uint64)
        x = events.x.astype(np.uint64)
        y = events.y.astype(np.uint64)
        head = events.p.astype(np.uint64) << np.uint64(60)
        head |= (t & np.uint64(0x3F)) << np.uint64(54)
        head |= (x & ~np.uint64(VECTOR - 1)) << np.uint64(43)
        head |= y << np.uint64(32)
        high = t >> np.uint64(6)
        changes = np.empty(len(events), np.bool_)
        changes[0] = self._high != int(high[0])
        np.not_equal(high[1:], high[:-1], out=changes[1:])
        self._high = int(high[-1])
        begins = np.ones(len(events), np.bool_)
        begins[1:] = changes[1:] | (head[1:] != head[:-1]) | (x[1:] <= x[:-1])
        starts = np.flatnonzero(begins)
        bits = np.bitwise_or.reduceat(np.uint64(1) << (x & np.uint64(VECTOR - 1)), starts)
        words = head[starts] | bits
        timed = np.flatnonzero(changes[starts])
        times = np.uint64(evt_types.TIME_HIGH << 60) | (high[starts[timed]] << np.uint64(32))
        return np.insert(words, timed, times)


def write_evt21(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a RAW file in EVT 2.1."""
    origin = origin_of(about, LONGEST_EVT21_US)
    encoder = Evt21Encoder(origin)
    with part.open("xb") as file:
        file.write(_raw_header(about, "2.1", "EVT21", origin, ";endianness=little"))
        for events in blocks:
            file.write(encoder.encode(events).astype("<u8").data)
