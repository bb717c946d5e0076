"""Reader of text: the format of the Event Camera Dataset, and tables of any layout, such as CSV.

The Event Camera Dataset has one event ``t x y p`` per line, t in seconds, p 1 or 0. A first line ``width height``,
which some exporters write, gives the sensor size. A ``calib.txt`` in the same folder gives the camera as
``fx fy cx cy k1 k2 p1 p2 k3``. If most of the first events have fractional x or y, all are compensated, and ``nan``
marks events without coordinates.

The size may also be in a file beside it, as amiwarp writes it, see :mod:`amiwarp.io.text.size`.

Other tables have columns between commas, semicolons, tabs or spaces, and may begin with a line of names. Empty lines
and lines that start with ``#`` or ``%`` are comments. A comment may give the names, or the size as ``geometry``.
:mod:`amiwarp.io.text.rows` makes numbers of the lines, :mod:`amiwarp.io.columns.search` decides what the columns are.
A last line that is cut off is dropped, and its length counted as ``truncated_bytes``.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events, Recording
from amiwarp.io.camera_files import read_calib
from amiwarp.io.columns.layout import Layout
from amiwarp.io.columns.names import ROLES
from amiwarp.io.columns.options import TIME_UNITS, GivenLayout
from amiwarp.io.columns.table import check_table
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.inputs import LONGEST_LINE, errors_name
from amiwarp.io.text.encoding import text_head, text_pieces, text_tail
from amiwarp.io.text.form import TextForm, find_form, find_text_layout
from amiwarp.io.text.rows import holds_values, number_of, wrong_word
from amiwarp.io.text.size import read_size
from amiwarp.optics.camera import LARGEST_SIZE

Vector = NDArray[np.float64]

READ_BYTES = 1 << 22
"""Amount of text that is parsed at once [bytes]: about 200,000 events."""

HEAD_BYTES = 1 << 16
"""Amount of text from which the layout is found [bytes]: about 3,000 events."""

KERNEL_LINES = 20_000
"""Least number of lines that a kernel reads. To load it takes as long as to read many lines without it."""

THREAD_LINES = 1 << 12
"""Number of lines that a thread of the kernel reads."""


def open_text(path: Path, given: GivenLayout) -> Recording:
    """Open a text recording, with the camera of ``calib.txt`` in the same folder if that file exists."""
    with errors_name(path, lambda: "line 1"):
        head, is_cut = text_head(path, max(HEAD_BYTES, 2 * LONGEST_LINE))
        form = find_form(path, head)
    written_size = read_size(path)
    if written_size is not None:
        names = form.names or ROLES
        form = replace(form, names=names, size=written_size.size, written_size=written_size)
    with errors_name(path, lambda: "finding the columns"):
        layout = find_text_layout(head, is_cut, form, given)
    events = FileEvents(
        path,
        partial(_text_packets, path, form, layout),
        size=form.size,
        last_time=partial(_last_time, path, form, layout),
    )
    check_table(path, events, layout)
    calib = path.with_name("calib.txt")
    camera = None
    if calib.exists() and calib != path:
        camera = read_calib(calib, *events.size)
    metadata = {"format": "text", **layout.metadata, **events.metadata}
    if layout.columns["t"] in form.stamped:
        metadata["time_zone"] = "UTC, unless a time states another zone"
    return Recording(events=events, camera=camera, metadata=metadata, name=path.stem)


def _last_time(path: Path, form: TextForm, layout: Layout, estimate: int) -> int | None:
    """Return the time of the last event [us], or None if the end of the file holds none."""
    tail = text_tail(path, 2 * LONGEST_LINE)
    with contextlib.suppress(ValueError, IndexError, OverflowError):
        # The first line of the tail may be cut off, as may be a last one without a newline.
        _, *lines, rest = tail.split(b"\n")
        last = _last_with_values(b"\n".join(lines))
        if holds_values(rest) and not (last and _is_cut_off(rest, last, form, layout)):
            last = rest
        words = form.row.words(last)
        t = float(words[layout.columns["t"]])
        return round(t * TIME_UNITS[layout.unit])
    return None


def _text_packets(
    path: Path,
    form: TextForm,
    layout: Layout,
    notes: dict[str, int],
) -> Iterator[Packet]:
    """Yield the events of a text, in pieces of whole lines."""
    parse = partial(_parse, path, form, layout)
    line_number = form.lines
    rest = b""
    before = b""
    for data in text_pieces(path, form.start, READ_BYTES, notes):
        whole, newline, rest = (rest + data).rpartition(b"\n")
        if len(rest) > LONGEST_LINE:
            raise AmiwarpError(
                f"{path}: after line {line_number}: a line is longer than {LONGEST_LINE} characters",
                ErrorCode.FILE_DAMAGED,
            )
        if newline:
            yield parse(whole, line_number)
            line_number += whole.count(b"\n") + 1
            before = _last_with_values(whole) or before
    if not holds_values(rest):
        return
    if before and _is_cut_off(rest, before, form, layout):
        notes["truncated_bytes"] = len(rest)
        return
    yield parse(rest, line_number)
    if before:
        # The last number may have lost digits.
        notes["unended_last_lines"] = 1


def _last_with_values(lines: bytes) -> bytes:
    """Return the last of some lines that is neither empty nor a comment; an empty one if there is none."""
    while lines:
        lines, _, line = lines.rpartition(b"\n")
        if holds_values(line):
            return line
    return b""


def _is_cut_off(line: bytes, before: bytes, form: TextForm, layout: Layout) -> bool:
    """Return whether a last line without a newline is the beginning of one. ``before`` is the line before it.

    Of a time in the last column that lost digits, what is left is earlier than the time before.
    """
    try:
        row = _numbers_of(form.row.words(line))
        last = _numbers_of(form.row.words(before))
    except ValueError:
        return True
    if not _are_events(row, (1, form.width), layout):
        return True
    if layout.columns["t"] != form.width - 1 or last.shape != row.shape:
        return False
    return bool(row[0, -1] < last[0, -1])


def _numbers_of(words: Sequence[Any]) -> Vector:
    """Return the numbers in the words of a line as a table of one row."""
    return np.array([[number_of(word) for word in words]])


def _are_events(table: Vector, shape: tuple[int, int], layout: Layout) -> bool:
    """Return whether a table has a shape, and its rows hold events."""
    if table.shape != shape:
        return False
    plausible = _plausible(_chosen(table, layout), layout)
    return bool(plausible.all())


def _parse(path: Path, form: TextForm, layout: Layout, text: bytes, line_number: int) -> Packet:
    """Return the events in lines of text. ``line_number`` is the number of the line before them."""
    table = _plain_table(text, form)
    if table is not None and _are_events(table, (len(table), form.width), layout):
        return _events(table, layout)
    lines = form.row.plain(text).split(b"\n")
    kept = [line for line in lines if holds_values(line)]
    if not kept:
        nothing = np.zeros(0, np.int64)
        return nothing, nothing, nothing, nothing
    try:
        table = np.loadtxt(kept, ndmin=2, comments=None, encoding="ascii")
    except ValueError:
        table = np.zeros((0, 0))
    if not _are_events(table, (len(kept), form.width), layout):
        bad = _first_bad_line(text.split(b"\n"), line_number, form, layout)
        raise AmiwarpError(
            f"{path}: {bad}; expected {_expected(form, layout)}", ErrorCode.FILE_DAMAGED
        )
    if layout.unit == "ns":
        return _events(table, layout, _whole_times(kept, layout))
    return _events(table, layout)


def _whole_times(kept: list[bytes], layout: Layout) -> NDArray[np.int64] | None:
    """Return the times in some lines, which have more digits than float64; None if they are not whole numbers."""
    time_column = layout.columns["t"]
    try:
        return np.loadtxt(
            kept,
            np.int64,
            ndmin=1,
            comments=None,
            encoding="ascii",
            usecols=time_column,
        )
    except ValueError:
        return None


def _events(
    table: Vector,
    layout: Layout,
    whole_t: NDArray[np.int64] | None = None,
) -> Packet:
    """Return the events in rows of numbers. ``whole_t`` replaces their times."""
    t: NDArray[Any]
    x: NDArray[Any]
    y: NDArray[Any]
    p: NDArray[Any]
    t, x, y, p = _chosen(table, layout)
    if whole_t is not None:
        t = whole_t
    if layout.compensated:
        return layout.columns_of_events(t, x, y, p)
    x = x.astype(np.int64)
    y = y.astype(np.int64)
    x, y, t, p = layout.columns_of_events(t, x, y, p)
    smallest = min(int(x.min()), int(y.min()))
    largest = max(int(x.max()), int(y.max()))
    if smallest >= 0 and largest < LARGEST_SIZE and len(t) >= KERNEL_LINES:
        # A kernel checks these, too.
        return Events(x.astype(np.uint16), y.astype(np.uint16), t, p)
    return x, y, t, p


def _plain_table(text: bytes, form: TextForm) -> Vector | None:
    """Return the numbers in lines of decimal numbers by a kernel; None for few lines, and for any others."""
    row = form.row
    if len(text) < KERNEL_LINES * 2 * form.width:
        return None
    separator = row.separator
    if not row.is_plain(text):
        text = row.plain(text)
        separator = b" "
    characters = np.frombuffer(text, np.uint8)
    newlines = np.flatnonzero(characters == ord("\n"))
    ends = np.append(newlines, len(text)).astype(np.int32)
    if len(ends) < KERNEL_LINES:
        return None
    import warp as wp

    from amiwarp.kernels.launch import launch
    from amiwarp.kernels.quiet_start import start_once
    from amiwarp.kernels.text_numbers import MOST_DIGITS, read_numbers

    start_once()

    blocks = math.ceil(len(ends) / THREAD_LINES)
    values = wp.empty((form.width, len(ends)), dtype=wp.float64, device="cpu")
    faults = wp.empty(blocks, dtype=int, device="cpu")
    powers = 10.0 ** np.arange(MOST_DIGITS + 1)
    inputs = [
        wp.array(characters, device="cpu", copy=False),
        wp.array(ends, device="cpu", copy=False),
        ord(separator),
        wp.array(powers, dtype=wp.float64, device="cpu"),
        THREAD_LINES,
    ]
    launch(read_numbers, blocks, inputs, [values, faults], device="cpu", smallest=1)
    if faults.numpy().any():
        return None
    table: Vector = values.numpy().T
    return table


def _expected(form: TextForm, layout: Layout) -> str:
    """Return what a line holds, for messages."""
    values = sorted(value for value in layout.coding if abs(value) < 2**31)
    polarity = " or ".join(map(str, values))
    if values == [-1, 0, 1]:
        polarity = "0 or 1"
    unit = "seconds" if layout.unit == "s" else layout.unit
    order = sorted(layout.columns, key=lambda role: layout.columns[role])
    expected = f"'{' '.join(order)}' with t in {unit}, p {polarity}"
    if form.width == len(ROLES):
        return expected
    return f"{expected}, in {form.width} columns"


def _chosen(table: Vector, layout: Layout) -> list[Vector]:
    """Return the columns t, x, y, p."""
    return [table[:, column] for column in layout.chosen]


def _plausible(columns: Sequence[Vector], layout: Layout) -> NDArray[np.bool_]:
    """Return for each row t, x, y, p whether its numbers are usable."""
    t, x, y, p = columns
    # Pixels must fit 32 bits. Pixels outside the frame are dropped later. NaN fails every comparison.
    places: Any = (np.abs(x) < 2**31) & (np.abs(y) < 2**31)
    if layout.compensated:
        places |= np.isnan(x) | np.isnan(y)
    else:
        places &= np.floor(x) == x
        places &= np.floor(y) == y
    known: Any = np.zeros(len(p), np.bool_)
    for value in layout.coding:
        known |= p == value
    latest = 2**62 / TIME_UNITS[layout.unit]
    return np.asarray((np.abs(t) < latest) & places & known)


def _first_bad_line(lines: list[bytes], line_number: int, form: TextForm, layout: Layout) -> str:
    """Return a description of the first line that does not hold an event, and why, for error messages."""
    for number, line in enumerate(lines, line_number + 1):
        if not holds_values(line):
            continue
        words = form.row.words(line)
        begin = line[:80].decode("utf-8", "replace").strip()
        shown = f"line {number} is '{begin}'"
        wrong = wrong_word(words)
        if wrong is not None:
            return f"{shown} and holds {wrong}"
        row = _numbers_of(words)
        if row.shape != (1, form.width):
            return shown
        columns = _chosen(row, layout)
        if not _plausible(columns, layout).all():
            _, x, y, _ = columns
            return shown + _why_no_pixel(x.item(), y.item(), layout)
    return f"line {line_number + 1} or after it is malformed"


def _why_no_pixel(x: float, y: float, layout: Layout) -> str:
    """Return why x or y is no pixel, for messages; nothing if both can be, and for compensated events."""
    if layout.compensated:
        return ""
    for name, value in (("x", x), ("y", y)):
        if np.isnan(value):
            return f", in which {name} has no value"
        if value != np.floor(value):
            return f", in which {name} has a fraction"
    return ""
