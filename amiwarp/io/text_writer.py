"""Writer of text in the format of the Event Camera Dataset: one event ``t x y p`` per line, t in seconds, p 1 or 0.

x and y of compensated events have six decimals; ``nan`` marks those without coordinates.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.events import Events, regroup
from amiwarp.io.chunks import in_order
from amiwarp.io.output_formats import Outline

LINES = 1 << 17
"""Number of events that are formatted at a time."""

FARTHEST = 2.0**31
"""Coordinates that are read again are less than this [px]. A larger one, of a ray along the image plane, is ``nan``."""

Digits = tuple[NDArray[np.uint8], NDArray[np.bool_]]
"""Characters by digit and event, and which of them are written."""


def write_text(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events, formatted in parallel threads."""
    jobs = (partial(format_events, events) for events in regroup(blocks, count=LINES))
    with part.open("xb") as file, contextlib.closing(in_order(jobs)) as lines:
        for text in lines:
            file.write(text)


def format_events(events: Events) -> bytes:
    """Return the lines of some events, at least one."""
    columns = _decimals(events.t)
    for values in (events.x, events.y, events.p):
        digits = [_digits(values)] if values.dtype.kind == "u" else _fractional(values)
        columns += [_mark(" ", len(events)), *digits]
    columns.append(_mark("\n", len(events)))
    characters = np.concatenate([column for column, _ in columns])
    return characters.T[np.concatenate([kept for _, kept in columns]).T].tobytes()


def _decimals(millionths: NDArray[np.int64]) -> list[Digits]:
    """Return integers divided by a million, with six decimals."""
    whole, rest = np.divmod(np.abs(millionths), 1_000_000)
    minus = np.full((1, len(whole)), ord("-"), np.uint8), (millionths < 0)[None]
    return [minus, _digits(whole), _mark(".", len(whole)), _digits(rest.astype(np.uint32), places=6)]


def _fractional(values: NDArray[Any]) -> list[Digits]:
    """Return coordinates with six decimals, or ``nan``."""
    unknown = ~(np.abs(values) < FARTHEST)
    columns = _decimals(np.rint(np.where(unknown, 0.0, values.astype(np.float64)) * 1e6).astype(np.int64))
    if unknown.any():
        for _, kept in columns:
            kept[:, unknown] = False
        columns += [(np.full((1, len(values)), ord(letter), np.uint8), unknown[None]) for letter in "nan"]
    return columns


def _mark(character: str, count: int) -> Digits:
    return np.full((1, count), ord(character), np.uint8), np.ones((1, count), np.bool_)


def _digits(values: NDArray[np.integer], places: int = 0) -> Digits:
    """Return the decimal digits of values, with leading zeros up to a number of places, and without if that is 0."""
    width = places or len(str(int(values.max())))
    characters = np.empty((width, len(values)), np.uint8)
    kept = np.ones((width, len(values)), np.bool_)
    for at in range(width - 1, -1, -1):
        if not places and at < width - 1:
            np.greater(values, 0, out=kept[at])
        rest = values // 10
        characters[at] = values - rest * 10
        values = rest
    characters += ord("0")
    return characters, kept
