"""File beside a text of events: its sensor size, its unit of time, and whether its events are compensated.

Other readers take a further line or column of the text for events. So amiwarp writes these into ``OUT.csv.json`` beside
``OUT.csv``, with the number of bytes of the text that they belong to. A file of this name that amiwarp did not write is
ignored and never replaced.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import open_input
from amiwarp.io.json_files import parse_json
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import instance, one_of, whole

FIELDS = {"width", "height", "time_unit", "bytes"}
"""Fields by which a file is known as amiwarp's."""

MOST_BYTES = 4096
"""Largest such file [bytes]."""


@dataclass(frozen=True, slots=True)
class TextSize:
    """What the file beside a text states."""

    size: tuple[int, int]
    """Sensor size (width, height) [px]."""
    unit: str
    """Unit of time in the text."""
    compensated: bool | None
    """Whether the events are compensated; None in files of earlier versions, which do not state it."""


def size_file(path: Path) -> Path:
    """Return the file with the sensor size of a text file."""
    return path.with_name(f"{path.name}.json")


def write_size(part: Path, text: Path, about: TextSize) -> None:
    """Write what belongs to the finished file ``text``."""
    width, height = about.size
    fields = {
        "width": width,
        "height": height,
        "time_unit": about.unit,
        "compensated": about.compensated,
        "bytes": text.stat().st_size,
    }
    part.write_text(json.dumps(fields) + "\n", encoding="ascii", newline="\n")


def read_size(path: Path) -> TextSize | None:
    """Return what :func:`write_size` wrote for a text file.

    None if there is no such file, if another program wrote it, or if it is about another text than this one. Raises
    :class:`AmiwarpError` if it cannot be read, or a value in it is impossible.
    """
    beside = size_file(path)
    fields = _own_fields(beside, noted=True)
    if fields is None or fields["bytes"] != path.stat().st_size:
        return None
    width = whole(fields["width"], f"{beside}: width", 1, LARGEST_SIZE)
    height = whole(fields["height"], f"{beside}: height", 1, LARGEST_SIZE)
    compensated = fields.get("compensated")
    if compensated is not None:
        instance(compensated, bool, f"{beside}: compensated")
    unit = one_of(fields["time_unit"], ("s", "us"), f"{beside}: time_unit")
    return TextSize((width, height), unit, compensated)


def may_replace_size(path: Path) -> bool:
    """Return whether the file beside ``path`` is amiwarp's and left over from a text that is gone.

    Raises :class:`AmiwarpError` if there is a file that amiwarp did not write, which nothing may replace.
    """
    beside = size_file(path)
    if beside.is_file() and _own_fields(beside, noted=False) is None:
        raise AmiwarpError(
            f"{beside}: was not written by amiwarp, which would put the sensor size of {path.name} there and never "
            "replaces such a file; move it, or give the output another name",
            ErrorCode.OUTPUT_EXISTS,
        )
    return beside.is_file() and not path.exists()


def _own_fields(beside: Path, *, noted: bool) -> dict[str, Any] | None:
    """Return the fields of a file that amiwarp wrote; None if there is no such file, or if it is another program's."""
    if not beside.is_file():
        return None
    with open_input(beside, noted=noted) as file:
        text = file.read(MOST_BYTES + 1)
    if len(text) > MOST_BYTES:
        return None
    try:
        fields = parse_json(text)
    except AmiwarpError:
        # It is no JSON.
        return None
    if not isinstance(fields, dict) or not fields.keys() >= FIELDS:
        return None
    return fields
