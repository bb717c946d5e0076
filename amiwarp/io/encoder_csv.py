"""Reader of encoder logs in CSV: columns ``t_us``, ``angle_deg`` or ``count``, and optionally ``index`` (0 or 1)."""

import os
from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.unwrapping import UnwrapError, check_direction
from amiwarp.io.inputs import errors_name, text_lines

MOST_ROWS = 10_000_000
"""Largest number of samples of a log: 2.8 hours at 1 kHz."""


def read_encoder_csv(
    path: str | os.PathLike[str],
    *,
    counts_per_turn: int | None = None,
    counter_bits: int | None = None,
    direction: int = 1,
) -> Encoder:
    """Return the encoder of a CSV log, whose header names the columns in any order.

    - ``t_us``: time [us], strictly increasing.
    - ``angle_deg``: angle [deg], wrapped or not; or ``count``: encoder count. Counts need ``counts_per_turn``, and
      ``counter_bits`` if the width of the counter is ambiguous (see :meth:`Encoder.from_counts`).
    - ``index``: 1 in the samples at the index pulse, where the angle is 0.

    ``direction`` -1 negates the angle. Raises :class:`AmiwarpError` with the file and line for anything else.
    """
    path = Path(path)
    with errors_name(path, lambda: "reading the encoder"):
        names, table, lines = _read_table(path)
        columns = {name: table[:, column] for column, name in enumerate(names)}
        t = np.rint(columns["t_us"]).astype(np.int64)
        late = np.flatnonzero(t[1:] <= t[:-1])
        if late.size:
            line = lines[int(late[0]) + 1]
            raise AmiwarpError(
                f"{path}: line {line}: t_us is not later than in the line before; sort the lines by t_us and remove "
                "duplicates",
                ErrorCode.FILE_DAMAGED,
            )
        try:
            encoder = _encoder(
                path,
                columns,
                t,
                counts_per_turn=counts_per_turn,
                counter_bits=counter_bits,
                direction=direction,
            )
        except UnwrapError as error:
            raise AmiwarpError(f"{path}: line {lines[error.sample]}: {error.problem}") from error
        if "index" not in columns:
            return encoder
        bad = np.flatnonzero((columns["index"] != 0) & (columns["index"] != 1))
        if bad.size:
            raise AmiwarpError(
                f"{path}: line {lines[int(bad[0])]}: index is neither 0 nor 1; correct this line",
                ErrorCode.FILE_DAMAGED,
            )
        pulses = columns["index"] == 1
        # A pulse that stays high over several samples is one pulse at its first sample.
        rising = pulses & ~np.concatenate([[False], pulses[:-1]])
        return encoder.with_index(t[rising]) if rising.any() else encoder


def _encoder(
    path: Path,
    columns: dict[str, NDArray[np.float64]],
    t: NDArray[np.int64],
    *,
    counts_per_turn: int | None,
    counter_bits: int | None,
    direction: int,
) -> Encoder:
    """Return the encoder of the log's columns."""
    if "count" in columns:
        if counts_per_turn is None:
            raise AmiwarpError(
                f"{path}: holds counts; give the counts per turn as counts_per_turn",
                ErrorCode.AMBIGUOUS,
            )
        return Encoder.from_counts(
            t,
            columns["count"],
            counts_per_turn=counts_per_turn,
            counter_bits=counter_bits,
            direction=direction,
        )
    if counter_bits is not None:
        raise AmiwarpError(
            f"{path}: holds angles, which have no counter_bits; leave counter_bits out",
            ErrorCode.OPTIONS,
        )
    check_direction(direction)
    return Encoder.from_angles(t, direction * np.radians(columns["angle_deg"]))


def _read_table(path: Path) -> tuple[list[str], NDArray[np.float64], Sequence[int]]:
    """Return column names, values of shape ``(rows, columns)`` and the line number of each row."""
    names: list[str] = []
    values = array("d")
    numbers = array("q")
    for number, line in text_lines(path):
        if not line.strip() or line[0] == "#":
            continue
        if not names:
            names = _column_names(path, line)
            continue
        numbers.append(number)
        if len(numbers) > MOST_ROWS:
            raise AmiwarpError(f"{path}: has over {MOST_ROWS} samples; give fewer, at a lower rate")
        try:
            values.extend(map(float, line.split(",")))
        except ValueError as error:
            raise AmiwarpError(
                f"{path}: line {number} is '{line[:80]}'; expected {len(names)} numbers",
                ErrorCode.FILE_DAMAGED,
            ) from error
        if len(values) != len(numbers) * len(names):
            raise AmiwarpError(
                f"{path}: line {number} is '{line[:80]}'; expected {len(names)} numbers",
                ErrorCode.FILE_DAMAGED,
            )
    if not names:
        raise AmiwarpError(
            f"{path}: is empty; expected a header t_us,angle_deg or t_us,count",
            ErrorCode.CONTENT_MISSING,
        )
    if len(numbers) < 2:
        raise AmiwarpError(
            f"{path}: has {len(numbers)} samples; expected at least 2", ErrorCode.CONTENT_MISSING
        )
    table = np.frombuffer(values).reshape(-1, len(names))
    # From 2**53 on, float64 cannot represent every whole microsecond. NaN fails every comparison.
    right = (np.abs(table) < 2.0**53).all(axis=1)
    if not right.all():
        row = int(np.argmin(right))
        given = ",".join(f"{value:g}" for value in table[row])
        raise AmiwarpError(
            f"{path}: line {numbers[row]} is '{given}'; expected {len(names)} finite numbers",
            ErrorCode.FILE_DAMAGED,
        )
    return names, table, numbers


def _column_names(path: Path, header: str) -> list[str]:
    """Return the names in a header."""
    names = [name.strip().lower() for name in header.split(",")]
    known = {"t_us", "angle_deg", "count", "index"}
    if len(set(names)) != len(names) or not set(names) <= known or "t_us" not in names:
        raise AmiwarpError(
            f"{path}: header '{header[:80]}'; expected t_us,angle_deg or t_us,count, then index",
            ErrorCode.FORMAT_UNKNOWN,
        )
    if ("count" in names) == ("angle_deg" in names):
        raise AmiwarpError(
            f"{path}: header '{header[:80]}'; expected one of angle_deg and count",
            ErrorCode.FORMAT_UNKNOWN,
        )
    return names
