"""Finished work that a later run continues from, as JSON with a checksum: folders of cells, and journals.

The checksum shows damage. Anybody can compute it, so that the values are checked as well before they are used.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, open_input
from amiwarp.io.json_files import parse_json, read_json
from amiwarp.io.outputs import check_output, write_text
from amiwarp.schema.records import Made
from amiwarp.validation import instance, shown

SEAL = "checksum"
"""Field with the SHA-256 of the canonical JSON of all other fields, in hexadecimal."""

MOST_CELL_BYTES = 8 << 20
"""Largest file of a cell that is read [bytes]."""

MOST_JOURNAL_BYTES = 1 << 30
"""Largest journal that is read [bytes]."""

MOST_LINE_BYTES = 1 << 16
"""Longest line of a journal that is read [bytes]."""


def sealed(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a JSON object with its checksum."""
    return {SEAL: _digest(data), **data}


def unsealed(data: Any) -> dict[str, Any]:
    """Return a JSON object without its checksum, in place. Raises :class:`AmiwarpError` if the two do not match."""
    given = instance(data, dict, "the content").pop(SEAL, None)
    if given != _digest(data):
        found = "missing" if given is None else f"{shown(given)}, not of this content"
        raise AmiwarpError(f"field {SEAL} is {found}", ErrorCode.FIELD)
    return dict(data)


def _digest(data: Mapping[str, Any]) -> str:
    canonical = json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


class CellStore:
    """Folder of cells, that is of results of single runs. Each is a file with a checksum.

    A file that is damaged counts as missing: it is noted in ``damaged``, and replaced when the cell is written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.damaged: list[str] = []
        """What is wrong with each damaged file that was read."""

    def read(self, name: str, make: Callable[[dict[str, Any]], Made]) -> Made | None:
        """Return what ``make`` makes of the fields of a cell; None if its file is missing or damaged.

        ``make`` raises :class:`AmiwarpError` for fields that a run does not write. So does this method for a folder.
        """
        path = self.folder / name
        if not os.path.lexists(path):
            return None
        if path.is_dir():
            raise AmiwarpError(f"{path}: is a folder, where the file of a cell belongs; remove it")
        try:
            with errors_name(path, lambda: "is damaged"):
                data = read_json(path, "a cell", most_bytes=MOST_CELL_BYTES, noted=False)
                return make(unsealed(data))
        except AmiwarpError as error:
            self.damaged.append(str(error))
            return None

    def write(self, name: str, data: Mapping[str, Any]) -> None:
        """Write the fields of a cell. A pipe or a device of its name is replaced too."""
        path = self.folder / name
        if os.path.lexists(path) and not path.is_file():
            path.unlink()
        text = json.dumps(sealed(data), separators=(",", ":"), allow_nan=False)
        write_text(path, text + "\n", overwrite=True)


def create_journal(path: Path) -> None:
    """Create an empty journal unless it exists. Raises :class:`AmiwarpError` if that fails."""
    check_output(path, overwrite=True)
    with errors_name(path, lambda: "cannot be written"):
        path.touch()


def append_line(path: Path, data: Mapping[str, Any]) -> None:
    """Append an object with its checksum to a journal. Raises :class:`AmiwarpError` if that fails."""
    check_output(path, overwrite=True)
    with errors_name(path, lambda: "cannot be written"), path.open("ab+") as file:
        line = json.dumps(sealed(data), allow_nan=False).encode() + b"\n"
        size = file.seek(0, 2)
        if size:
            file.seek(size - 1)
            if file.read(1) != b"\n":
                # The last line was cut off. It must not swallow the new one.
                line = b"\n" + line
        file.write(line)


def read_journal(
    path: Path, make: Callable[[dict[str, Any]], Made], damaged: list[str]
) -> Iterator[Made]:
    """Yield what ``make`` makes of the fields of each line of a journal; nothing if it does not exist.

    Lines that are damaged, or of which ``make`` raises :class:`AmiwarpError`, are left out, and noted together in
    ``damaged``. Raises :class:`AmiwarpError` for a journal that is not a regular file or is too large.
    """
    if not os.path.lexists(path):
        return
    bad = 0
    first = ""
    with (
        errors_name(path, lambda: "cannot be read as a journal"),
        open_input(path, noted=False) as file,
    ):
        if os.fstat(file.fileno()).st_size > MOST_JOURNAL_BYTES:
            raise AmiwarpError(
                f"is larger than {MOST_JOURNAL_BYTES >> 20} MiB, so it is no journal; remove it",
                ErrorCode.FORMAT_UNKNOWN,
            )
        for number, line in enumerate(iter(lambda: file.readline(MOST_LINE_BYTES), b""), 1):
            # Of a line that is too long for a journal, the last character is kept, which is no JSON.
            while not line.endswith(b"\n") and (rest := file.readline(MOST_LINE_BYTES)):
                line = rest[-1:]
            try:
                with errors_name(path, lambda number=number: f"line {number}"):  # type: ignore[misc]
                    made = make(unsealed(parse_json(line)))
            except AmiwarpError as error:
                bad += 1
                first = first or str(error)
                continue
            yield made
    if bad == 1:
        damaged.append(first)
    elif bad > 1:
        damaged.append(f"{first}; {bad:,} lines are damaged")
