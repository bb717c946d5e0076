"""Writers of text, one event per line: the format of the Event Camera Dataset, and tables.

The Event Camera Dataset has lines ``t x y p`` with t in seconds. Tables have lines ``t,x,y,p`` with t in whole
microseconds, below a line of names. p is 1 or 0. x and y of compensated events have six decimals; ``nan`` marks events
without coordinates.

Other readers take a further line or column for events. So the sensor size and the unit of time are in a file beside
the text, see :mod:`amiwarp.io.text.size`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events, regroup
from amiwarp.io.output_formats import Outline
from amiwarp.io.outputs import NewFile
from amiwarp.tasks import in_order

LINES = 1 << 17
"""Number of events that are formatted at a time."""

FARTHEST = 2.0**31
"""Coordinates that are read again are less than this [px]. A larger one, of a ray along the image plane, is ``nan``."""

Digits = tuple[NDArray[np.uint8], NDArray[np.bool_]]
"""Characters by digit and event, and which of them are written."""


def write_text(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events as the Event Camera Dataset does. Their sensor size is in a file of its own."""
    with part.open("xb") as file:
        _write_lines(file, blocks, format_events)


def write_csv(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events as a table between commas. Their sensor size is in a file of its own."""
    with part.open("xb") as file:
        file.write(b"t,x,y,p\n")
        _write_lines(file, blocks, format_rows)


def _write_lines(
    file: IO[bytes],
    blocks: Iterable[Events],
    form: Callable[[Events], bytes],
) -> None:
    """Write all events as lines of text, formatted in parallel threads."""
    jobs = (partial(form, events) for events in regroup(blocks, count=LINES))
    with contextlib.closing(in_order(jobs)) as lines:
        for text in lines:
            file.write(text)


def format_events(events: Events) -> bytes:
    """Return lines ``t x y p`` of some events, at least one, with t in seconds."""
    return _lines(_decimals(events.t), events, " ")


def format_rows(events: Events) -> bytes:
    """Return lines ``t,x,y,p`` of some events, at least one, with t in microseconds."""
    times = [_minus(events.t), _digits(np.abs(events.t))]
    return _lines(times, events, ",")


def _lines(times: list[Digits], events: Events, separator: str) -> bytes:
    """Return the lines of some events, at least one, with their times as given."""
    columns = list(times)
    for values in (events.x, events.y, events.p):
        columns.append(_mark(separator, len(events)))
        if values.dtype.kind == "u":
            columns.append(_digits(values))
        else:
            columns += _fractional(values)
    columns.append(_mark("\n", len(events)))

    # The characters of each event follow one another, without those that are not written.
    characters = np.concatenate([column for column, _ in columns])
    written = np.concatenate([kept for _, kept in columns])
    text = characters.T[written.T]
    return text.tobytes()


def _minus(values: NDArray[np.int64]) -> Digits:
    """Return a minus for the values below 0."""
    signs = np.full((1, len(values)), ord("-"), np.uint8)
    is_negative = values < 0
    return signs, is_negative[None]


def _decimals(millionths: NDArray[np.int64]) -> list[Digits]:
    """Return integers divided by a million, with six decimals."""
    whole, rest = np.divmod(np.abs(millionths), 1_000_000)
    return [
        _minus(millionths),
        _digits(whole),
        _mark(".", len(whole)),
        _digits(rest.astype(np.uint32), places=6),
    ]


def _fractional(values: NDArray[Any]) -> list[Digits]:
    """Return coordinates with six decimals, or ``nan``."""
    known = np.abs(values) < FARTHEST
    known_values = np.where(known, values.astype(np.float64), 0.0)
    millionths = np.rint(known_values * 1e6).astype(np.int64)
    columns = _decimals(millionths)
    if not known.all():
        for _, kept in columns:
            kept[:, ~known] = False
        for letter in "nan":
            characters, _ = _mark(letter, len(values))
            columns.append((characters, ~known[None]))
    return columns


def _mark(character: str, count: int) -> Digits:
    """Return a character for each of ``count`` events."""
    characters = np.full((1, count), ord(character), np.uint8)
    written = np.ones((1, count), np.bool_)
    return characters, written


def _digits(values: NDArray[np.integer], places: int = 0) -> Digits:
    """Return the decimal digits of values, with leading zeros up to a number of places, and without if that is 0."""
    largest = int(values.max())
    width = places or len(str(largest))
    characters = np.empty((width, len(values)), np.uint8)
    kept = np.ones((width, len(values)), np.bool_)
    last = width - 1
    for position in range(last, -1, -1):
        # Without leading zeros, a digit is written if more than zero is left. The last digit is always written.
        if not places and position < last:
            np.greater(values, 0, out=kept[position])
        rest = values // 10
        characters[position] = values - rest * 10
        values = rest
    characters += ord("0")
    return characters, kept


def save_rows(
    path: Path,
    names: Sequence[str],
    blocks: Iterable[tuple[NDArray[Any], ...]],
    form: str,
) -> None:
    """Write blocks of columns to a new text file, under a line with their names; ``form``: format of a row."""
    head = ",".join(names) + "\n"
    with NewFile(path) as new, open(new.part, "wb") as file:
        file.write(head.encode())
        for block in blocks:
            rows = np.column_stack(block)
            np.savetxt(file, rows, fmt=form)
