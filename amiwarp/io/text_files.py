"""Reader of text: the format of the Event Camera Dataset, and tables of any layout, such as CSV.

The Event Camera Dataset has one event ``t x y p`` per line, t in seconds, p 1 or 0. A first line ``width height``,
which some exporters write, gives the sensor size. A ``calib.txt`` in the same folder gives the camera as
``fx fy cx cy k1 k2 p1 p2 k3``. If most of the first events have fractional x or y, all are compensated, and ``nan``
marks events without coordinates.

The size may also be in a file beside it, as amiwarp writes it, see :mod:`amiwarp.io.text_size`.

Other tables have columns between commas, semicolons, tabs or spaces, and may begin with a line of names. Empty lines
and lines that start with ``#`` or ``%`` are comments. A comment may give the names, or the size as ``geometry``.
:mod:`amiwarp.io.text_rows` makes numbers of the lines, :mod:`amiwarp.io.column_search` decides what the columns are.
A last line that is cut off is dropped, and its length counted as ``truncated_bytes``.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.io.column_files import check_table
from amiwarp.io.column_names import ROLES, names_roles, roles_of, units_in
from amiwarp.io.column_options import TIME_UNITS, GivenLayout
from amiwarp.io.column_search import find_layout
from amiwarp.io.column_units import LONGEST_S, rounded_times_note
from amiwarp.io.columns import Column, Hints, Layout
from amiwarp.io.file_scan import FileEvents, Packet
from amiwarp.io.files import LONGEST_LINE, errors_name
from amiwarp.io.plain_files import read_calib
from amiwarp.io.text_rows import (
    BOM,
    TextRow,
    doubtful_comma,
    holds_values,
    number_of,
    text_head,
    text_pieces,
    text_tail,
    why_no_rows,
    wrong_word,
)
from amiwarp.io.text_size import TextSize, read_size
from amiwarp.optics.camera import LARGEST_SIZE

READ_BYTES = 1 << 22
"""Amount of text that is parsed at once [bytes]: about 200,000 events."""

HEAD_BYTES = 1 << 16
"""Amount of text from which the layout is found [bytes]: about 3,000 events."""

SECONDS = re.compile(rb"-?\d+\.\d{6,}")
"""Pattern of times in seconds, as the Event Camera Dataset and amiwarp write them."""

SIZE = re.compile(r"geometry\W{1,3}(\d+)\s*[,x ]\s*(\d+)|width\W{1,3}(\d+).*?height\W{1,3}(\d+)", re.I | re.S)
"""Pattern of the sensor size in comments."""


@dataclass(frozen=True, slots=True)
class TextForm:
    """Form of a text file."""

    start: int
    """Position of the first line of values [bytes]."""
    lines: int
    """Number of lines before it."""
    row: TextRow
    """Form of its lines."""
    width: int
    """Number of columns."""
    names: tuple[str, ...] | None
    """Names of the columns, or None."""
    size: tuple[int, int] | None
    """Sensor size that the file states [px], or None."""
    stamped: tuple[int, ...]
    """Indices of the columns that are dates with times of day."""
    units: tuple[str | None, ...] = ()
    """Unit of time of each column in a line below the names; empty without such a line."""
    own: TextSize | None = None
    """What amiwarp wrote beside the text, or None."""


def open_text(path: Path, given: GivenLayout) -> Recording:
    """Open a text recording, with the camera of ``calib.txt`` in the same folder if that file exists."""
    with errors_name(path, lambda: "line 1"):
        head, is_cut = text_head(path, max(HEAD_BYTES, 2 * LONGEST_LINE))
        form = _find_form(path, head)
    own = read_size(path)
    if own is not None:
        form = replace(form, names=form.names or ROLES, size=own.size, own=own)
    with errors_name(path, lambda: "finding the columns"):
        layout = _find_text_layout(head, is_cut, form, given)
    events = FileEvents(
        path,
        partial(_text_packets, path, form, layout),
        size=form.size,
        last_time=partial(_last_time, path, form, layout),
    )
    check_table(path, events, layout)
    calib = path.with_name("calib.txt")
    camera = read_calib(calib, *events.size) if calib.exists() and calib != path else None
    metadata = {"format": "text", **layout.metadata, **events.metadata}
    if layout.columns["t"] in form.stamped:
        metadata["time_zone"] = "UTC, unless a time states another zone"
    return Recording(events=events, camera=camera, metadata=metadata, name=path.stem)


# The form of a file, from its first lines.

ROWS_OF_FORM = 100
"""Number of rows from which the form of a file is found: a first number may be whole where others have a comma."""


def _find_form(path: Path, head: bytes) -> TextForm:
    """Return the form of a file that begins with ``head``."""
    comments: list[str] = []
    names: tuple[str, ...] | None = None
    units: tuple[str | None, ...] = ()
    size: tuple[int, int] | None = None
    position, number = len(BOM) * head.startswith(BOM), 0
    for line in io.BytesIO(head[position:]):  # which only a newline ends, as in the reader of all lines
        if b"\r" in line.rstrip(b"\r\n"):
            raise AmiwarpError(
                f"{path}: line {number + 1} holds a carriage return; lines must end with a newline; replace the "
                "carriage returns by newlines"
            )
        words = TextRow.of(line).words(line) if holds_values(line) else []
        if not words:
            comments.append(line.decode("utf-8", "replace").strip().lstrip("#%\ufeff").strip())
        elif len(words) == 2 and size is None and names is None and words[0].isdigit() and words[1].isdigit():
            size = int(words[0]), int(words[1])
        elif TextRow.of(line).is_row(line):
            if len(words) == 2:
                shown = b" ".join(words)[:80].decode("ascii", "replace")
                raise AmiwarpError(
                    f"{path}: line {number + 1} '{shown}' is not a size in pixels; expected 'width height' or 't x y p'"
                )
            row = _form_of_rows(path, number + 1, head[position:].split(b"\n", ROWS_OF_FORM)[:ROWS_OF_FORM])
            width = len(row.words(line))
            return TextForm(
                start=position,
                lines=number,
                row=row,
                width=width,
                names=_without_empty_end(names, width) or _commented(comments, row, width),
                size=size or _commented_size(comments),
                stamped=row.stamped(line),
                units=units,
            )
        elif names is None:
            names = TextRow.of(line).names(line)
        else:
            units = units_in(names, TextRow.of(line).names(line), f"{path}: line {number + 1}")
            if not units:
                break
        position, number = position + len(line), number + 1
    why = (
        why_no_rows(head) or f"line {number + 1} holds no numbers; expected 't x y p', or names of columns before them"
    )
    raise AmiwarpError(f"{path}: {why}")


def _form_of_rows(path: Path, number: int, lines: Sequence[bytes]) -> TextRow:
    """Return the form of the first rows of a file. ``number`` is the line number of the first one."""
    comma = doubtful_comma(filter(holds_values, lines))
    if comma is not None:
        raise AmiwarpError(
            f"{path}: line {number} or one after it holds '{comma.decode('ascii', 'replace')}', whose comma can be a "
            "decimal one or separate thousands; write numbers with decimal points and without thousands separators"
        )
    first = TextRow.of(lines[0])
    forms = (TextRow.of(line) for line in lines if holds_values(line))
    return next((form for form in forms if form.separator == first.separator and form.decimal_comma), first)


def _without_empty_end(names: tuple[str, ...] | None, width: int) -> tuple[str, ...] | None:
    """Return the names of columns without empty ones beyond the ``width`` of the rows, which a last separator makes."""
    if names is None or any(names[width:]):
        return names
    return names[:width]


def _commented(comments: Sequence[str], row: TextRow, width: int) -> tuple[str, ...] | None:
    """Return the names of columns in the last comment before the values that holds them, or None."""
    for comment in reversed(comments):
        for text in (comment, comment.rpartition(":")[2]):
            between_any = re.split(r"[\s,;]+", re.sub(r"\s+(?=[\[({])", "", text.strip()))
            for names in (row.names(text.encode()), tuple(between_any)):
                if len(names) == width and names_roles(names):
                    return names
    return None


def _commented_size(comments: Sequence[str]) -> tuple[int, int] | None:
    """Return the sensor size in comments, or None."""
    match = SIZE.search("\n".join(comments))
    if match is None:
        return None
    return int(match[1] or match[3]), int(match[2] or match[4])


def _find_text_layout(head: bytes, is_cut: bool, form: TextForm, given: GivenLayout) -> Layout:
    """Return the layout of the columns of a file that begins with ``head``, whose last line may go on."""
    rows: list[list[bytes]] = []
    values: list[list[float]] = []
    lines = head[form.start :].split(b"\n")
    for line in lines[:-1] if is_cut else lines:
        words = form.row.words(line) if holds_values(line) else []
        if len(words) == form.width:
            with contextlib.suppress(ValueError):  # the reader names such a line
                values.append([number_of(word) for word in words])
                rows.append(words)
    numbers = np.array(values).reshape(-1, form.width)
    if form.names is not None and len(form.names) != form.width and given.columns is None:
        raise AmiwarpError(
            f"names {len(form.names)} columns ({', '.join(form.names)[:200]}), and its rows have {form.width}; give "
            f"the order with --columns, such as {_order_for(form.names, numbers)}"
        )
    names = form.names if form.names is not None and len(form.names) == form.width else None
    units = [*form.units, *[None] * form.width]  # those of the last columns may be left out
    columns = [
        Column(names[at] if names else None, _whole_if_possible(values), "us" if at in form.stamped else units[at])
        for at, values in enumerate(numbers.T)
    ]
    if names is not None and not any(names):
        columns = [replace(column, name=None) for column in columns]
    hints = Hints(is_text=True)
    if form.own is not None:
        hints = replace(hints, unit=form.own.unit, is_own=True)
    if names is None:
        hints = replace(hints, order=ROLES, fractions="s")
    layout = find_layout(columns, given, hints)
    if layout.columns["t"] in form.stamped and given.time_unit is not None:
        raise AmiwarpError(f"times are dates, but --time-unit is {given.time_unit}; leave it out")
    t_words = [words[layout.columns["t"]] for words in rows]
    layout = replace(layout, rounded_times=rounded_times_note(t_words, layout.unit))
    in_decimals = all(SECONDS.fullmatch(word) for word in t_words) and _can_be_seconds(numbers[:, layout.columns["t"]])
    if given.time_unit is None and names is None and in_decimals:
        layout = replace(
            layout,
            unit="s",
            unit_is_assumed=False,
            assumptions=tuple(each for each in layout.assumptions if each.what != "time unit"),
        )
        layout = replace(layout, is_promised=given == GivenLayout() and not layout.assumptions)
    if form.own is not None and form.own.compensated is not None:
        return replace(layout, compensated=form.own.compensated)
    places = numbers[:, [layout.columns["x"], layout.columns["y"]]]
    fractional = bool((places != np.floor(places)).any(axis=1).mean() > 0.5)
    return replace(layout, compensated=fractional)


def _order_for(names: Sequence[str], numbers: NDArray[np.float64]) -> str:
    """Return an example of the option ``--columns`` for rows with more or fewer columns than names."""
    found = roles_of(names)
    roles = {places[0]: role for role, places in found.items() if places}
    order = [roles.get(at, "-") for at in range(len(names))]
    if len(numbers) > 1 and (np.diff(numbers[:, 0]) == 1).all():  # the number of the row, whose column has no name
        order = ["-", *order]
    kept = order[: max(at for at, role in enumerate(order) if role != "-") + 1] if roles else []
    return ",".join(kept) if len(roles) == len(ROLES) else "t,x,y,p (- for a column without use)"


def _can_be_seconds(t: NDArray[np.float64]) -> bool:
    """Return whether times with six decimals can be in seconds: not if they are whole and far apart.

    So are microseconds that a program has written with decimals.
    """
    span = float(np.ptp(t)) if t.size else 0.0
    return bool((t != np.floor(t)).any()) or span < LONGEST_S or t.size > span


def _whole_if_possible(values: NDArray[np.float64]) -> NDArray[Any]:
    """Return values as integers if all are whole."""
    inside = np.abs(values) < 2**63
    return values.astype(np.int64) if inside.all() and (values == np.floor(values)).all() else values


# The events.


def _last_time(path: Path, form: TextForm, layout: Layout, estimate: int) -> int | None:
    """Return the time of the last line [us], or None if it holds none."""
    lines = list(filter(holds_values, text_tail(path, 2 * LONGEST_LINE).split(b"\n")[1:]))
    with contextlib.suppress(ValueError, IndexError, OverflowError):
        word = form.row.words(lines[-1])[layout.columns["t"]]
        return round(float(word) * TIME_UNITS[layout.unit])
    return None


def _text_packets(path: Path, form: TextForm, layout: Layout, notes: dict[str, int]) -> Iterator[Packet]:
    parse = partial(_parse, path, form, layout)
    line_number = form.lines
    rest = before = b""
    for data in text_pieces(path, form.start, READ_BYTES, notes):
        whole, newline, rest = (rest + data).rpartition(b"\n")
        if len(rest) > LONGEST_LINE:
            raise AmiwarpError(f"{path}: after line {line_number}: a line is longer than {LONGEST_LINE} characters")
        if newline:
            yield parse(whole, line_number)
            line_number += whole.count(b"\n") + 1
            before = whole.rpartition(b"\n")[2]
    if not rest.strip():
        return
    if before and _is_cut_off(rest, before, form, layout):
        notes["truncated_bytes"] = len(rest)
        return
    yield parse(rest, line_number)
    if before:  # a last number may have lost digits
        notes["unended_last_lines"] = 1


def _is_cut_off(line: bytes, before: bytes, form: TextForm, layout: Layout) -> bool:
    """Return whether a last line without a newline is the beginning of one. ``before`` is the line before it.

    Of a time in the last column that lost digits, what is left is earlier than the time before.
    """
    try:
        row = np.array([[number_of(word) for word in form.row.words(line)]])
        last = np.array([[number_of(word) for word in form.row.words(before)]])
    except ValueError:
        return True
    if row.shape != (1, form.width) or not _plausible(_chosen(row, layout), layout).all():
        return True
    return layout.columns["t"] == form.width - 1 and last.shape == row.shape and bool(row[0, -1] < last[0, -1])


def _parse(path: Path, form: TextForm, layout: Layout, text: bytes, line_number: int) -> Packet:
    """Return the events in lines of text. ``line_number`` is the number of the line before them."""
    table = _plain_table(text, form)
    if table is not None and _plausible(_chosen(table, layout), layout).all():
        return _events(table, layout)
    kept = list(filter(holds_values, form.row.plain(text).split(b"\n")))
    if not kept:
        nothing = np.zeros(0, np.int64)
        return nothing, nothing, nothing, nothing
    try:
        table = np.loadtxt(kept, ndmin=2, comments=None, encoding="ascii")
    except ValueError:
        table = np.zeros((0, 0))
    if table.shape != (len(kept), form.width) or not _plausible(_chosen(table, layout), layout).all():
        bad = _first_bad_line(text.split(b"\n"), line_number, form, layout)
        raise AmiwarpError(f"{path}: {bad}; expected {_expected(form, layout)}")
    t = None
    if layout.unit == "ns":  # whole nanoseconds since 1970 have more digits than float64
        with contextlib.suppress(ValueError):
            at = layout.columns["t"]
            t = np.loadtxt(kept, np.int64, ndmin=1, comments=None, encoding="ascii", usecols=at)
    return _events(table, layout, t)


def _events(table: NDArray[np.float64], layout: Layout, whole_t: NDArray[np.int64] | None = None) -> Packet:
    """Return the events in rows of numbers. ``whole_t`` replaces their times."""
    columns: list[NDArray[Any]] = [*_chosen(table, layout)]
    if whole_t is not None:
        columns[0] = whole_t
    if not layout.compensated:
        columns[1:3] = (values.astype(np.int64) for values in columns[1:3])
    x, y, t, p = layout.columns_of_events(*columns)
    if layout.compensated:
        return x, y, t, p
    inside = min(int(x.min()), int(y.min())) >= 0 and max(int(x.max()), int(y.max())) < LARGEST_SIZE
    if inside and len(t) >= KERNEL_LINES:
        return Events(x.astype(np.uint16), y.astype(np.uint16), t, p)  # which a kernel checks, too
    return x, y, t, p


KERNEL_LINES = 20_000
"""Number of lines from which on a kernel reads them. To load it takes as long as to read many lines without it."""
THREAD_LINES = 1 << 12
"""Number of lines that a thread of the kernel reads."""


def _plain_table(text: bytes, form: TextForm) -> NDArray[np.float64] | None:
    """Return the numbers in lines of decimal numbers by a kernel; None for few lines, and for any others."""
    row = form.row
    if len(text) < KERNEL_LINES * 2 * form.width:
        return None
    separator = row.separator
    if not row.is_plain(text):
        text, separator = row.plain(text), b" "
    characters = np.frombuffer(text, np.uint8)
    ends = np.append(np.flatnonzero(characters == ord("\n")), len(text)).astype(np.int32)
    if len(ends) < KERNEL_LINES:
        return None
    import warp as wp

    from amiwarp.kernels.launch import launch, start_once
    from amiwarp.kernels.text_numbers import MOST_DIGITS, read_numbers

    start_once()

    blocks = -(-len(ends) // THREAD_LINES)
    values = wp.empty((form.width, len(ends)), dtype=wp.float64, device="cpu")
    faults = wp.empty(blocks, dtype=int, device="cpu")
    powers = wp.array(10.0 ** np.arange(MOST_DIGITS + 1), dtype=wp.float64, device="cpu")
    given = [wp.array(each, device="cpu", copy=False) for each in (characters, ends)]
    inputs = [*given, ord(separator), powers, THREAD_LINES]
    launch(read_numbers, blocks, inputs, [values, faults], device="cpu", smallest=1)
    table: NDArray[np.float64] = values.numpy().T
    return None if faults.numpy().any() else table


def _expected(form: TextForm, layout: Layout) -> str:
    """Return what a line holds, for messages."""
    values = sorted(value for value in layout.coding if abs(value) < 2**31)
    polarity = "0 or 1" if values == [-1, 0, 1] else " or ".join(map(str, values))
    unit = {"s": "seconds"}.get(layout.unit, layout.unit)
    order = sorted(layout.columns, key=lambda role: layout.columns[role])
    return f"'{' '.join(order)}' with t in {unit}, p {polarity}" + (
        "" if form.width == len(ROLES) else f", in {form.width} columns"
    )


def _chosen(table: NDArray[np.float64], layout: Layout) -> list[NDArray[np.float64]]:
    """Return the columns t, x, y, p."""
    return [table[:, at] for at in layout.chosen]


def _plausible(columns: Sequence[NDArray[np.float64]], layout: Layout) -> NDArray[np.bool_]:
    """Return for each row t, x, y, p whether its numbers are usable."""
    t, x, y, p = columns
    # Pixels must fit 32 bits. Pixels outside the frame are dropped later. NaN fails every comparison.
    places: Any = (np.abs(x) < 2**31) & (np.abs(y) < 2**31)
    if layout.compensated:
        places |= np.isnan(x) | np.isnan(y)
    else:
        places &= (np.floor(x) == x) & (np.floor(y) == y)
    known: Any = np.zeros(len(p), np.bool_)
    for value in layout.coding:
        known |= p == value
    return np.asarray((np.abs(t) < 2**62 / TIME_UNITS[layout.unit]) & places & known)


def _first_bad_line(lines: list[bytes], line_number: int, form: TextForm, layout: Layout) -> str:
    """Return a description of the first line that does not hold an event, and why, for error messages."""
    for number, line in enumerate(lines, line_number + 1):
        if not holds_values(line):
            continue
        words = form.row.words(line)
        shown = f"line {number} is '{line[:80].decode('utf-8', 'replace').strip()}'"
        wrong = wrong_word(words)
        if wrong is not None:
            return f"{shown} and holds {wrong}"
        row = np.array([[number_of(word) for word in words]])
        if row.shape != (1, form.width):
            return shown
        if not _plausible(_chosen(row, layout), layout).all():
            _, x, y, _ = _chosen(row, layout)
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
