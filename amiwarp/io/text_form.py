"""Form of a text file of events, from its first lines: names, separators, size and units, and what its columns are."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.column_names import ROLES, names_roles, roles_of, units_in
from amiwarp.io.column_options import GivenLayout
from amiwarp.io.column_search import find_layout
from amiwarp.io.column_units import LONGEST_S, rounded_times_note
from amiwarp.io.columns import Column, Hints, Layout
from amiwarp.io.text_encoding import BOM
from amiwarp.io.text_rows import (
    TextRow,
    doubtful_comma,
    holds_values,
    number_of,
    why_no_rows,
)
from amiwarp.io.text_size import TextSize

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


ROWS_OF_FORM = 100
"""Number of rows from which the form of a file is found: a first number may be whole where others have a comma."""


def find_form(path: Path, head: bytes) -> TextForm:
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


def find_text_layout(head: bytes, is_cut: bool, form: TextForm, given: GivenLayout) -> Layout:
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
