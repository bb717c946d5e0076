"""Journal of finished work: one JSON object a line. A line that was cut off by a crash is ignored."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from amiwarp.io.atomic_output import check_output
from amiwarp.io.input_files import errors_name, open_input


def create_journal(path: Path) -> None:
    """Create an empty journal unless it exists. Raises :class:`AmiwarpError` if that fails."""
    check_output(path, overwrite=True)
    with errors_name(path, lambda: "cannot be written"):
        path.touch()


def append_line(path: Path, data: dict[str, Any]) -> None:
    """Append an object to a journal. Raises :class:`AmiwarpError` if that fails."""
    check_output(path, overwrite=True)
    with errors_name(path, lambda: "cannot be written"), path.open("ab+") as file:
        size = file.seek(0, 2)
        if size:
            file.seek(size - 1)
        cut_off = size and file.read(1) != b"\n"
        file.write(b"\n" * bool(cut_off) + json.dumps(data).encode() + b"\n")


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects of a journal; nothing if it does not exist. Damaged lines are left out."""
    if not path.exists():
        return
    with errors_name(path, lambda: "cannot be read as a journal"), open_input(path, noted=False) as file:
        for line in file:
            try:
                data = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(data, dict):
                yield data
