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

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.columns.layout import Column, Hints, Layout
from amiwarp.io.columns.names import ROLES, names_roles, roles_of, units_in
from amiwarp.io.columns.options import GivenLayout
from amiwarp.io.columns.search import find_layout
from amiwarp.io.columns.units import LONGEST_S, rounded_times_note
from amiwarp.io.text.detection import why_no_rows
from amiwarp.io.text.encoding import BOM
from amiwarp.io.text.rows import TextRow, doubtful_comma, holds_values, number_of
from amiwarp.io.text.size import TextSize

Names = tuple[str, ...]

SECONDS = re.compile(rb"-?\d+\.\d{6,}")
"""Pattern of times in seconds, as the Event Camera Dataset and amiwarp write them."""

SIZE = re.compile(
    r"geometry\W{1,3}(\d+)\s*[,x ]\s*(\d+)|width\W{1,3}(\d+).*?height\W{1,3}(\d+)", re.I | re.S
)
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
    written_size: TextSize | None = None
    """What amiwarp wrote beside the text, or None."""


ROWS_OF_FORM = 100
"""Number of rows from which the form of a file is found: a first number may be whole where others have a comma."""


def find_form(path: Path, head: bytes) -> TextForm:
    """Return the form of a file that begins with ``head``."""
    comments: list[str] = []
    names: tuple[str, ...] | None = None
    units: tuple[str | None, ...] = ()
    size: tuple[int, int] | None = None
    position = len(BOM) * head.startswith(BOM)
    number = 0
    # Only a newline ends a line here, as in the reader of all lines.
    for line in io.BytesIO(head[position:]):
        if b"\r" in line.rstrip(b"\r\n"):
            raise AmiwarpError(
                f"{path}: line {number + 1} holds a carriage return; lines must end with a newline; replace the "
                "carriage returns by newlines",
                ErrorCode.FORMAT_UNKNOWN,
            )
        words = TextRow.of(line).words(line) if holds_values(line) else []
        may_be_size = len(words) == 2 and size is None and names is None
        if not words:
            comment = line.decode("utf-8", "replace").strip()
            comments.append(comment.lstrip("#%\ufeff").strip())
        elif may_be_size and words[0].isdigit() and words[1].isdigit():
            size = int(words[0]), int(words[1])
        elif TextRow.of(line).is_row(line):
            if len(words) == 2:
                shown = b" ".join(words)[:80].decode("ascii", "replace")
                raise AmiwarpError(
                    f"{path}: line {number + 1} '{shown}' is not a size in pixels; "
                    "expected 'width height' or 't x y p'",
                    ErrorCode.FORMAT_UNKNOWN,
                )
            rows = head[position:].split(b"\n", ROWS_OF_FORM)[:ROWS_OF_FORM]
            row = _form_of_rows(path, number + 1, rows)
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
        position += len(line)
        number += 1
    why = why_no_rows(head)
    if not why:
        why = f"line {number + 1} holds no numbers; expected 't x y p', or names of columns before them"
    raise AmiwarpError(f"{path}: {why}", ErrorCode.FORMAT_UNKNOWN)


def _form_of_rows(path: Path, number: int, lines: Sequence[bytes]) -> TextRow:
    """Return the form of the first rows of a file. ``number`` is the line number of the first one."""
    comma = doubtful_comma(filter(holds_values, lines))
    if comma is not None:
        raise AmiwarpError(
            f"{path}: line {number} or one after it holds '{comma.decode('ascii', 'replace')}', whose comma can be a "
            "decimal one or separate thousands; write numbers with decimal points and without thousands separators",
            ErrorCode.AMBIGUOUS,
        )
    # A first number may be whole, where others have a decimal comma.
    first = TextRow.of(lines[0])
    for line in lines:
        if holds_values(line):
            form = TextRow.of(line)
            if form.separator == first.separator and form.decimal_comma:
                return form
    return first


def _without_empty_end(names: Names | None, width: int) -> Names | None:
    """Return the names of columns without empty ones beyond the ``width`` of the rows, which a last separator makes."""
    if names is None or any(names[width:]):
        return names
    return names[:width]


def _commented(comments: Sequence[str], row: TextRow, width: int) -> Names | None:
    """Return the names of columns in the last comment before the values that holds them, or None."""
    for comment in reversed(comments):
        _, _, behind_colon = comment.rpartition(":")
        for text in (comment, behind_colon):
            # A unit in brackets belongs to the name before it.
            joined = re.sub(r"\s+(?=[\[({])", "", text.strip())
            between_any = re.split(r"[\s,;]+", joined)
            for names in (row.names(text.encode()), tuple(between_any)):
                if len(names) == width and names_roles(names):
                    return names
    return None


def _commented_size(comments: Sequence[str]) -> tuple[int, int] | None:
    """Return the sensor size in comments, or None."""
    match = SIZE.search("\n".join(comments))
    if match is None:
        return None
    width = match[1] or match[3]
    height = match[2] or match[4]
    return int(width), int(height)


def find_text_layout(head: bytes, is_cut: bool, form: TextForm, given: GivenLayout) -> Layout:
    """Return the layout of the columns of a file that begins with ``head``, whose last line may go on."""
    rows, numbers = _rows_of_numbers(head, is_cut, form)
    names = _fitting_names(form, numbers, given)
    hints = Hints(is_text=True)
    if form.written_size is not None:
        hints = replace(hints, unit=form.written_size.unit, is_own=True)
    if names is None:
        hints = replace(hints, order=ROLES, fractions="s")
    layout = find_layout(_columns_of(form, names, numbers), given, hints)
    t_column = layout.columns["t"]
    if t_column in form.stamped and given.time_unit is not None:
        raise AmiwarpError(f"times are dates, but --time-unit is {given.time_unit}; leave it out")
    t_words = [words[t_column] for words in rows]
    layout = replace(layout, rounded_times=rounded_times_note(t_words, layout.unit))

    # Times with six decimals, in columns without names, are seconds as in the Event Camera Dataset.
    have_six_decimals = all(SECONDS.fullmatch(word) for word in t_words)
    are_seconds = have_six_decimals and _can_be_seconds(numbers[:, t_column])
    if given.time_unit is None and names is None and are_seconds:
        layout = _in_seconds(layout, given)

    if form.written_size is not None and form.written_size.compensated is not None:
        return replace(layout, compensated=form.written_size.compensated)
    x_and_y = [layout.columns["x"], layout.columns["y"]]
    places = numbers[:, x_and_y]
    has_fraction = (places != np.floor(places)).any(axis=1)
    return replace(layout, compensated=bool(has_fraction.mean() > 0.5))


def _rows_of_numbers(
    head: bytes, is_cut: bool, form: TextForm
) -> tuple[list[list[bytes]], NDArray[np.float64]]:
    """Return the words of the rows in ``head``, and their numbers, shape (rows, columns).

    Lines that hold no numbers are left out: the reader of all lines names them.
    """
    rows: list[list[bytes]] = []
    values: list[list[float]] = []
    lines = head[form.start :].split(b"\n")
    for line in lines[:-1] if is_cut else lines:
        words = form.row.words(line) if holds_values(line) else []
        if len(words) == form.width:
            with contextlib.suppress(ValueError):
                values.append([number_of(word) for word in words])
                rows.append(words)
    return rows, np.array(values).reshape(-1, form.width)


def _fitting_names(
    form: TextForm, numbers: NDArray[np.float64], given: GivenLayout
) -> Names | None:
    """Return the names of the columns if there is one for each, or None.

    Raises :class:`AmiwarpError` for more or fewer names, unless the option ``--columns`` gives the columns.
    """
    if form.names is None or len(form.names) == form.width:
        return form.names
    if given.columns is None:
        raise AmiwarpError(
            f"names {len(form.names)} columns ({', '.join(form.names)[:200]}), and its rows have {form.width}; give "
            f"the order with --columns, such as {_order_for(form.names, numbers)}",
            ErrorCode.AMBIGUOUS,
        )
    return None


def _in_seconds(layout: Layout, given: GivenLayout) -> Layout:
    """Return a layout whose times are in seconds, which is certain."""
    assumptions = tuple(
        assumption for assumption in layout.assumptions if assumption.what != "time unit"
    )
    return replace(
        layout,
        unit="s",
        unit_is_assumed=False,
        assumptions=assumptions,
        is_promised=given == GivenLayout() and not assumptions,
    )


def _columns_of(
    form: TextForm,
    names: Names | None,
    numbers: NDArray[np.float64],
) -> list[Column]:
    """Return the columns of rows of numbers, with their names and units."""
    has_names = names is not None and any(names)
    columns = []
    for index, values in enumerate(numbers.T):
        # The units of the last columns may be left out.
        unit = form.units[index] if index < len(form.units) else None
        if index in form.stamped:
            unit = "us"
        name = names[index] if names is not None and has_names else None
        columns.append(Column(name, _whole_if_possible(values), unit))
    return columns


def _order_for(names: Sequence[str], numbers: NDArray[np.float64]) -> str:
    """Return an example of the option ``--columns`` for rows with more or fewer columns than names."""
    places_of_roles = roles_of(names)
    roles = {places[0]: role for role, places in places_of_roles.items() if places}
    if len(roles) != len(ROLES):
        return "t,x,y,p (- for a column without use)"
    order = [roles.get(index, "-") for index in range(len(names))]
    steps = np.diff(numbers[:, 0])
    if len(steps) and (steps == 1).all():
        # It is the number of the row, whose column has no name.
        order = ["-", *order]
    last = max(index for index, role in enumerate(order) if role != "-")
    return ",".join(order[: last + 1])


def _can_be_seconds(t: NDArray[np.float64]) -> bool:
    """Return whether times with six decimals can be in seconds: not if they are whole and far apart.

    So are microseconds that a program has written with decimals.
    """
    span = float(np.ptp(t)) if t.size else 0.0
    has_fractions = bool((t != np.floor(t)).any())
    return has_fractions or span < LONGEST_S or t.size > span


def _whole_if_possible(values: NDArray[np.float64]) -> NDArray[Any]:
    """Return values as integers if all are whole."""
    fit = np.abs(values) < 2**63
    if fit.all() and (values == np.floor(values)).all():
        return values.astype(np.int64)
    return values
