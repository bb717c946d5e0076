"""Names of the files that a page writes: plain names, in one folder, never over what exists."""

from __future__ import annotations

import os
import re
from pathlib import Path

from amiwarp.errors import AmiwarpError

LONGEST = 120
"""Characters of a file name at most."""
DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that are devices on Windows, whatever their ending."""


def export_path(folder: Path, given: str, stem: str, endings: tuple[str, ...]) -> Path:
    """Return where an export goes: a file in ``folder`` that does not exist yet.

    ``given`` is the name that the page asks for; the first of ``endings`` is added where it has none of them. An empty
    one becomes ``stem`` with that ending, and with a number if that file exists. Raises :class:`AmiwarpError` for a
    name that could lead out of the folder or hide a file, and for one that exists.
    """
    if not given.strip():
        return _free(folder, _plain(stem), endings[0])
    name = checked_name(given.strip())
    if not name.lower().endswith(endings):
        if os.path.splitext(name)[1]:
            raise AmiwarpError(f"{name!r}: such a file ends in {' or '.join(endings)}; give another name, or none")
        name += endings[0]
    path = folder / name
    if os.path.lexists(path):
        raise AmiwarpError(f"{path}: exists, and a page replaces nothing; give another name")
    return path


def checked_name(name: str) -> str:
    """Return ``name`` if it is that of a file and nothing else. Raises :class:`AmiwarpError` otherwise."""
    if len(name) > LONGEST:
        raise AmiwarpError(f"a file name of {len(name):,} characters; give at most {LONGEST}")
    wrong = next((c for c in name if c in '/\\:*?"<>|' or not c.isprintable()), None)
    if wrong is not None:
        raise AmiwarpError(f"{name!r}: holds {wrong!r}; give the name of a file, without a folder")
    if name.startswith((".", "~", "-")) or name.endswith((".", " ")) or DEVICES.fullmatch(name):
        raise AmiwarpError(f"{name!r}: is not the name of an ordinary file; give one such as 'mine.png'")
    return name


def _plain(stem: str) -> str:
    """Turn the name of a recording or a stream into that of a file."""
    return re.sub(r"[^\w.+=@-]+", "_", stem)[:60].strip("._-~ ") or "recording"


def _free(folder: Path, stem: str, ending: str) -> Path:
    number, path = 1, folder / f"{stem}{ending}"
    while os.path.lexists(path):
        number += 1
        path = folder / f"{stem}.{number}{ending}"
    return path
