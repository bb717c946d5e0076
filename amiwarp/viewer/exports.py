"""Names of exported files: plain file names in one folder that never replace an existing file."""

from __future__ import annotations

import os
import re
from pathlib import Path

from amiwarp.errors import AmiwarpError

MOST_CHARACTERS = 120
"""Largest length of an exported file's name [characters]."""
WINDOWS_DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that Windows reserves for devices, with any extension."""


def export_path(folder: Path, given: str, stem: str, endings: tuple[str, ...]) -> Path:
    """Return the path of an export: a file in ``folder`` that does not exist yet.

    ``given`` is the name from the page; the first of ``endings`` is added to a name without extension. If ``given`` is
    empty, the name is ``stem`` with the first ending, plus a number if that file exists. Raises :class:`AmiwarpError`
    for a name that could lead out of the folder or create a hidden file, for another extension, and for a file that
    exists.
    """
    if not given.strip():
        return _unused_path(folder, _sanitised(stem), endings[0])
    name = checked_name(given.strip())
    if not name.lower().endswith(endings):
        if os.path.splitext(name)[1]:
            wanted = " or ".join(endings)
            raise AmiwarpError(f"{name!r}: the name must end in {wanted}; give another name, or leave the field empty")
        name += endings[0]
    path = folder / name
    if os.path.lexists(path):
        raise AmiwarpError(f"{path}: exists, and the page never replaces a file; give another name")
    return path


def checked_name(name: str) -> str:
    """Return ``name`` if it is a plain, visible file name. Raises :class:`AmiwarpError` otherwise."""
    if len(name) > MOST_CHARACTERS:
        raise AmiwarpError(f"the file name has {len(name):,} characters; give at most {MOST_CHARACTERS} characters")
    wrong = next((c for c in name if c in '/\\:*?"<>|' or not c.isprintable()), None)
    if wrong is not None:
        raise AmiwarpError(f"{name!r}: holds {wrong!r}; give a file name without a folder")
    if name.startswith((".", "~", "-")) or name.endswith((".", " ")) or WINDOWS_DEVICES.fullmatch(name):
        raise AmiwarpError(f"{name!r}: is not the name of an ordinary file; give a name such as 'picture.png'")
    return name


def _sanitised(stem: str) -> str:
    """Return the name of a recording or a stream as a valid file name."""
    return re.sub(r"[^\w.+=@-]+", "_", stem)[:60].strip("._-~ ") or "recording"


def _unused_path(folder: Path, stem: str, ending: str) -> Path:
    """Return the first of ``stem``, ``stem.2``, ``stem.3`` … that does not exist."""

    number, path = 1, folder / f"{stem}{ending}"
    while os.path.lexists(path):
        number += 1
        path = folder / f"{stem}.{number}{ending}"
    return path
