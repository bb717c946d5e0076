"""Files of one recording of a data set: a file, or the files of a recorded rig in their folder."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Sequence
from pathlib import Path

from amiwarp.io.formats import RIG_FILE
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import put_in_place
from amiwarp.learning.dataset.digests import content_digest


def stored_files(path: Path, cameras: Sequence[str]) -> list[Path]:
    """Return the files of a recording. ``cameras``: names of the cameras of a rig; none for one file.

    The file of a rig comes last, because it marks a rig as complete. Other files in its folder are somebody else's.
    """
    if not cameras:
        return [path]
    return [*(path / f"{name}.h5" for name in cameras), path / RIG_FILE]


def stored_bytes(path: Path, cameras: Sequence[str]) -> int | None:
    """Return the size of a recording [bytes]; None if a file of it is missing."""
    files = stored_files(path, cameras)
    if not all(file.is_file() for file in files):
        return None
    return sum(file.stat().st_size for file in files)


def stored_digest(path: Path, cameras: Sequence[str]) -> str:
    """Return the SHA-256 of a file, or of the names and the SHA-256 of the files of a rig, sorted by name."""
    if not cameras:
        return content_digest(path, noted=False)
    total = hashlib.sha256()
    for file in sorted(stored_files(path, cameras)):
        total.update(f"{file.name}\0{content_digest(file, noted=False)}\n".encode())
    return total.hexdigest()


def put_stored(part: Path, path: Path, cameras: Sequence[str]) -> None:
    """Rename the files of a finished recording, and replace an earlier one."""
    make_folder(path if cameras else path.parent)
    finished = stored_files(part, cameras)
    targets = stored_files(path, cameras)
    if cameras:
        targets[-1].unlink(missing_ok=True)  # a rig of old and new files is not complete
    for file, target in zip(finished, targets, strict=True):
        put_in_place(file, target, overwrite=True)
    _remove_empty(part, cameras)


def remove_stored(path: Path, cameras: Sequence[str]) -> None:
    """Remove the files of a recording, and the folder of a rig if nothing else is in it."""
    for file in reversed(stored_files(path, cameras)):
        file.unlink(missing_ok=True)
    _remove_empty(path, cameras)


def _remove_empty(path: Path, cameras: Sequence[str]) -> None:
    """Remove the folder of a rig if it is empty."""
    if cameras:
        with contextlib.suppress(OSError):
            path.rmdir()
