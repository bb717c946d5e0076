"""Decoders of Prophesee's EVT words with NumPy, for streams that arrive in pieces: what the kernels are compared with.

The words are those of Prophesee's documentation of the formats.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.event_packets import Columns
from amiwarp.io.file_pieces import unwrapped

TIME_HIGH, TRIGGER = 0x8, 0xA
"""Types of words that all versions share."""


UNKNOWN_TYPES = {
    2: (1, 9, 0xB, 0xC, 0xD),
    **dict.fromkeys((4, 8), (2, 3, 4, 5, 6, 7, 9, 0xB, 0xC, 0xD)),
}
"""Types of words that are not in Prophesee's documentation, by the size of a word [bytes]."""


def unknown_words(words: NDArray[Any]) -> int:
    """Return the number of words of unknown types. The first half of words of EVT 2.1 is the upper one."""
    size = words.dtype.itemsize
    return int(np.isin(words >> words.dtype.type(8 * size - 4), UNKNOWN_TYPES[size]).sum())


def swap_halves(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Swap the 32-bit halves of EVT 2.1 words, as the IMX636 sends them (``endianness=legacy``)."""
    return (words >> np.uint64(32)) | (words << np.uint64(32))


def _latest(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return for each element the index of the last true element up to it, or -1."""
    return np.maximum.accumulate(np.where(mask, np.arange(mask.size), -1))


@dataclass(slots=True)
class Evt2Decoder:
    """Decoder of EVT 2.0 and 2.1. Events before the first time word have no time and are dropped."""

    vectors: bool
    """Whether the words are those of EVT 2.1, with 32 pixels each."""
    high: int | None = None
    """Last time word, unwrapped [64 us], or None."""

    def decode(self, words: NDArray[Any]) -> tuple[Columns, Columns]:
        """Return the events and the triggers of the words that follow those of the last call."""
        head = (words >> np.uint64(32)).astype(np.int64) if self.vectors else words.astype(np.int64)
        kind = head >> 28
        is_high = kind == TIME_HIGH
        highs = unwrapped(head[is_high] & 0xFFFFFFF, 28, self.high)
        times = np.concatenate([[self.high or 0], highs])[np.cumsum(is_high)]
        known = np.cumsum(is_high) > 0 if self.high is None else np.ones(head.size, np.bool_)
        t = (times << 6) | (head >> 22) & 0x3F
        if highs.size:
            self.high = int(highs[-1])
        events = known & (kind <= 1)
        trigger = known & (kind == TRIGGER)
        edges = head[trigger]
        triggers = edges >> 8 & 0x1F, np.zeros(edges.size, np.int64), t[trigger], edges & 1
        x, y, p = head[events] >> 11 & 0x7FF, head[events] & 0x7FF, kind[events]
        if not self.vectors:
            return (x, y, t[events], p), triggers
        valid = (words[events] & np.uint64(0xFFFFFFFF)).astype("<u4").view(np.uint8)
        which, bit = np.nonzero(np.unpackbits(valid, bitorder="little").reshape(-1, 32))
        return (x[which] + bit, y[which], t[events][which], p[which]), triggers


@dataclass(slots=True)
class Evt3Decoder:
    """Decoder of EVT 3.0, whose words change a state. Events before the first time word are dropped."""

    high: int | None = None
    """Last TIME_HIGH, unwrapped [4096 us], or None."""
    state: dict[str, int] = field(default_factory=lambda: {"low": 0, "y": 0, "base": 0, "p": 0})
    """Last time within TIME_HIGH [us], row, column of the next vector [px], and polarity of vectors."""

    def decode(self, words: NDArray[np.uint16]) -> tuple[Columns, Columns]:
        """Return the events and the triggers of the words that follow those of the last call."""
        kind, load = (words >> 12).astype(np.int8), (words & 0xFFF).astype(np.int64)
        t, known = self._times(kind, load)
        y = self._filled("y", kind == 0x0, load & 0x7FF)
        triggers = known & (kind == TRIGGER)
        at = np.flatnonzero(triggers)
        edges = load[at] >> 8, np.zeros(at.size, np.int64), t[at], load[at] & 1
        vector = (kind == 0x4) | (kind == 0x5)
        base, polarity = self._bases(kind, load, vector)
        vectors = np.flatnonzero(vector & known)
        mask = np.where(kind[vectors] == 0x4, load[vectors], load[vectors] & 0xFF).astype("<u2")
        row, bit = np.nonzero(np.unpackbits(mask.view(np.uint8), bitorder="little").reshape(-1, 16))
        count = (known & (kind == 0x2)).astype(np.int64)
        count[vectors] = np.bincount(row, minlength=vectors.size)
        which = np.repeat(np.arange(kind.size), count)
        x, p = load[which] & 0x7FF, load[which] >> 11
        of_vector = vector[which]
        x[of_vector], p[of_vector] = base[vectors][row] + bit, polarity[vectors][row]
        return (x, y[which], t[which], p), edges

    def _times(
        self, kind: NDArray[Any], load: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the time of each word [us], and whether it is known."""
        is_high = kind == TIME_HIGH
        highs = unwrapped(load[is_high], 12, self.high)
        before = highs[0] if self.high is None and highs.size else self.high or 0
        all_highs = np.concatenate([[before], highs])
        known = np.cumsum(is_high) > 0 if self.high is None else np.ones(kind.size, np.bool_)
        # A new TIME_HIGH starts at its beginning, until the next TIME_LOW.
        is_low = kind == 0x6
        is_low[np.flatnonzero(is_high)[np.diff(all_highs) != 0]] = True
        low = self._filled("low", is_low, np.where(is_high, 0, load))
        if highs.size:
            self.high = int(highs[-1])
        return (all_highs[np.cumsum(is_high)] << 12) | low, known

    def _filled(
        self, name: str, mask: NDArray[np.bool_], values: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return the last masked value up to each word, starting from the state, and update the state."""
        filled = np.concatenate([values, [self.state[name]]])[_latest(mask)]
        if filled.size:
            self.state[name] = int(filled[-1])
        return filled

    def _bases(
        self, kind: NDArray[Any], load: NDArray[np.int64], vector: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the column of the first pixel and the polarity of each vector. A vector moves the base behind it."""
        is_base = kind == 0x3
        polarity = self._filled("p", is_base, load >> 11)
        width = np.where(kind == 0x4, 12, 8) * vector
        moved = np.cumsum(width) - width
        start, latest = self.state["base"], _latest(is_base)
        base = np.where(latest < 0, start + moved, (load & 0x7FF)[latest] + moved - moved[latest])
        if base.size:
            self.state["base"] = int(base[-1] + width[-1])
        return base, polarity
