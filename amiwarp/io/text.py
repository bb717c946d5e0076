"""Text in the format of the Event Camera Dataset: one event ``t x y p`` per line, t in seconds."""

import contextlib
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events, regroup
from amiwarp.events.recording import Recording
from amiwarp.io.chunks import in_order
from amiwarp.io.file_scan import FileEvents, Packet
from amiwarp.io.formats import Outline
from amiwarp.io.input_files import LONGEST_LINE, errors_name, open_input
from amiwarp.optics.camera import Camera, RadialTangential

# Reader of text in the format of the Event Camera Dataset: one event ``t x y p`` per line, t in seconds, p 1 or 0.
#
# A first line ``width height``, which some exporters write, gives the sensor size. Otherwise it is that of the smallest
# known sensor that holds all events (240x180 for that dataset). A ``calib.txt`` in the same folder gives the camera as
# ``fx fy cx cy k1 k2 p1 p2 k3``. Empty lines and lines that start with ``#`` are ignored. If most of the first events
# have fractional x or y, all are compensated, and ``nan`` marks events without coordinates.

READ_BYTES = 1 << 22
"""Amount of text that is parsed at once [bytes]: about 200,000 events."""


def open_text(path: Path) -> Recording:
    """Open a text recording, with the camera of ``calib.txt`` in the same folder if that file exists."""
    with errors_name(path, lambda: "line 1"), open_input(path) as file:
        size, _ = _read_size(path, file)
    events = FileEvents(path, partial(_packets, path), size=size, last_time=partial(_last_time, path))
    calib = path.with_name("calib.txt")
    camera = read_calib(calib, *events.size) if calib.exists() and calib != path else None
    return Recording(events=events, camera=camera, metadata={"format": "text", **events.metadata}, name=path.stem)


def read_calib(path: Path, width: int, height: int) -> Camera:
    """Return the camera of a ``calib.txt``. Raises :class:`AmiwarpError` unless it holds nine finite numbers."""
    with errors_name(path, lambda: "reading the calibration"):
        with open_input(path) as file:
            words = file.read(10_000).decode("utf-8").split()
        numbers = [float(word) for word in words]
        if len(numbers) != 9 or not np.isfinite(numbers).all():
            raise AmiwarpError(f"{path}: has {len(numbers)} numbers; expected finite fx fy cx cy k1 k2 p1 p2 k3")
        fx, fy, cx, cy = numbers[:4]
        return Camera(width, height, fx, fy, cx, cy, RadialTangential(*numbers[4:]))


def _read_size(path: Path, file: BinaryIO) -> tuple[tuple[int, int] | None, int]:
    """Return the sensor size from a first line of two numbers, and the number of lines read.

    If the first line is an event, return None and 0.
    """
    words = file.readline(LONGEST_LINE).split()
    if len(words) != 2:
        file.seek(0)
        return None, 0
    if not (words[0].isdigit() and words[1].isdigit()):
        given = b" ".join(words)[:80].decode("ascii", "replace")
        raise AmiwarpError(f"{path}: line 1 '{given}' is not a size in pixels; expected 'width height' or 't x y p'")
    return (int(words[0]), int(words[1])), 1


def _last_time(path: Path, estimate: int) -> int | None:
    """Return the time of the last line [us], or None if it holds none."""
    with open_input(path) as file:
        file.seek(max(path.stat().st_size - 2 * LONGEST_LINE, 0))
        lines = [line for line in file.read().split(b"\n")[1:] if line.strip() and not line.lstrip().startswith(b"#")]
    with contextlib.suppress(ValueError, IndexError, OverflowError):
        return round(float(lines[-1].split()[0]) * 1e6)
    return None


def _packets(path: Path, notes: dict[str, int]) -> Iterator[Packet]:
    fractional: bool | None = None
    with open_input(path) as file:
        _, line_number = _read_size(path, file)
        rest = b""
        notes["total"] = path.stat().st_size
        while data := file.read(READ_BYTES):
            notes["read"] = file.tell()
            whole, newline, rest = (rest + data).rpartition(b"\n")
            if len(rest) > LONGEST_LINE:
                raise AmiwarpError(f"{path}: after line {line_number}: a line is longer than {LONGEST_LINE} characters")
            if newline:
                lines = whole.split(b"\n")
                fractional, events = _parse(path, lines, line_number, fractional)
                yield events
                line_number += len(lines)
        if rest.strip():
            yield _parse(path, [rest], line_number, fractional)[1]


def _parse(path: Path, lines: list[bytes], line_number: int, fractional: bool | None) -> tuple[bool | None, Packet]:
    """Return whether the events of a file are compensated, and those in lines of text.

    ``line_number`` is the number of the line before them, ``fractional`` what the lines before have shown.
    """
    kept = [line for line in lines if line.strip() and not line.lstrip().startswith(b"#")]
    if not kept:
        nothing = np.zeros(0, np.int64)
        return fractional, (nothing, nothing, nothing, nothing)
    try:
        table = np.loadtxt(kept, ndmin=2, comments=None, encoding="ascii")
    except ValueError:
        table = np.zeros((0, 0))
    if fractional is None and table.shape[1] == 4:
        fractional = bool((table[:, 1:3] != np.floor(table[:, 1:3])).any(axis=1).mean() > 0.5)
    if table.shape != (len(kept), 4) or not _plausible(table, fractional).all():
        bad = _first_bad_line(lines, line_number, fractional)
        raise AmiwarpError(f"{path}: {bad}; expected 't x y p' with t in seconds, p 0 or 1")
    t, x, y, p = table.T
    t, p = np.rint(t * 1e6).astype(np.int64), p.astype(np.int64)
    return fractional, (x, y, t, p) if fractional else (x.astype(np.int64), y.astype(np.int64), t, p)


def _plausible(table: NDArray[np.float64], fractional: bool | None) -> NDArray[np.bool_]:
    """Return for each row ``t x y p`` whether its numbers are usable."""
    t, x, y, p = table.T
    # Pixels must fit 32 bits. Pixels outside the frame are dropped later. NaN fails every comparison.
    places: Any = (np.abs(x) < 2**31) & (np.abs(y) < 2**31)
    if fractional:
        places |= np.isnan(x) | np.isnan(y)
    else:
        places &= (np.floor(x) == x) & (np.floor(y) == y)
    return np.asarray((np.abs(t) < 2**62 / 1e6) & places & ((p == 0) | (p == 1) | (p == -1)))


def _first_bad_line(lines: list[bytes], line_number: int, fractional: bool | None) -> str:
    """Return a description of the first line that does not hold an event, for error messages."""
    for number, line in enumerate(lines, line_number + 1):
        if not line.strip() or line.lstrip().startswith(b"#"):
            continue
        try:
            row = np.array([[float(word) for word in line.split()]])
        except ValueError:
            row = np.zeros((1, 0))
        if row.shape != (1, 4) or not _plausible(row, fractional).all():
            return f"line {number} is '{line[:80].decode('ascii', 'replace').strip()}'"
    return f"line {line_number + 1} or after it is malformed"


# Writer of text in the format of the Event Camera Dataset: one event ``t x y p`` per line, t in seconds, p 1 or 0.
#
# x and y of compensated events have six decimals; ``nan`` marks those without coordinates.

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
