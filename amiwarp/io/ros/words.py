"""Prophesee's EVT words in the messages of ROS bags: their layouts, and the order of halves."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.evt_types import SINGLE, VECTOR_8, VECTOR_12
from amiwarp.io.prophesee.evt_words import halves_of, words_of

EVT = {"evt3": "3.0", "evt2": "2.0", "evt21": "2.1"}
"""Encodings with Prophesee's words, and their versions."""

ORDER_WORDS = 1 << 18
"""Number of words of EVT 2.1 from which the order of their halves is found."""


def _set_bits() -> NDArray[np.uint8]:
    """Return the number of set bits of each number of 16 bits."""
    pairs = np.arange(1 << 16, dtype="<u2").view(np.uint8).reshape(-1, 2)
    return np.unpackbits(pairs, axis=1).sum(axis=1, dtype=np.uint8)


BITS = _set_bits()
"""Number of set bits of each number of 16 bits."""


@dataclass(frozen=True, slots=True)
class Layout:
    """How the words of an encoding are laid out."""

    encoding: str
    """Name of the encoding in the messages."""
    swapped: bool = False
    """Whether the 32-bit halves of EVT 2.1 words are swapped."""

    @property
    def version(self) -> str:
        """Version of EVT."""
        return EVT[self.encoding]

    @property
    def bits(self) -> int:
        """Number of bits of a word below its type, and of a TIME_HIGH."""
        return 12 if self.version == "3.0" else 28

    @property
    def unit_us(self) -> int:
        """Unit of TIME_HIGH [us]."""
        return 1 << 12 if self.version == "3.0" else 1 << 6

    def heads(self, words: NDArray[Any]) -> NDArray[Any]:
        """Return what holds the type of each word: the word, or a half of EVT 2.1."""
        if self.version != "2.1":
            return words
        halves = words.view("<u4")
        return halves[0::2] if self.swapped else halves[1::2]

    def counts(self, words: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the number of events of each word."""
        kind = self.heads(words) >> self.bits
        if self.version == "3.0":
            pixels = (kind == SINGLE).astype(np.uint16)
            pixels = np.where(kind == VECTOR_8, words & 0xFF, pixels)
            pixels = np.where(kind == VECTOR_12, words & 0xFFF, pixels)
            return BITS[pixels]
        is_event = (kind <= 1).astype(np.uint8)
        if self.version == "2.0":
            return is_event
        halves = words.view("<u4")
        pixels = halves[1::2] if self.swapped else halves[0::2]
        return (BITS[pixels & 0xFFFF] + BITS[pixels >> 16]) * is_event


def layout_of(encoding: str, messages: Iterable[Any]) -> tuple[Layout, str | None]:
    """Return the layout of the words in some messages, and a note if it is not certain.

    Raises :class:`AmiwarpError` if the words fit no layout.
    """
    if encoding != "evt21":
        return Layout(encoding), None
    parts = []
    count = 0
    for message in messages:
        parts.append(checked_words(message, encoding))
        count += len(parts[-1])
        if count >= ORDER_WORDS:
            break
    if not count:
        return Layout(encoding), None
    found = halves_of(np.concatenate(parts))
    if found is None:
        raise AmiwarpError(
            "has EVT 2.1 words without times that rise, in either order of their 32-bit halves; "
            "the bag is damaged, or its encoding is not evt21",
            ErrorCode.FILE_DAMAGED,
        )
    layout = Layout(encoding, found.swapped)
    if found.certain:
        return layout, None
    order = "swapped" if found.swapped else "not swapped"
    return layout, f"assumed to be {order}: the words have times that rise in both orders"


def checked_words(message: Any, encoding: str) -> NDArray[Any]:
    """Return the words of a message. Raises :class:`AmiwarpError` for another encoding."""
    if message.encoding != encoding:
        raise AmiwarpError(
            f"has packets of the encodings '{encoding}' and '{message.encoding[:40]}' in one topic; "
            "filter the bag to one of them",
            ErrorCode.FORMAT_UNKNOWN,
        )
    check_byte_order(message)
    return words_of(message.events, EVT[encoding])


def check_byte_order(message: Any) -> None:
    """Raise :class:`AmiwarpError` if a big-endian machine wrote the words of a message."""
    if message.is_bigendian:
        raise AmiwarpError(
            "has packets of big-endian words, which are not read; record on a little-endian machine",
            ErrorCode.FORMAT_UNKNOWN,
        )
