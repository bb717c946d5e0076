"""Recordings that a page can open: the files in one folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from amiwarp.viewer.inspector import Inspector

SUFFIXES = {
    ".aedat", ".aedat2", ".aedat4", ".bag", ".bin", ".csv", ".dat", ".db3", ".es", ".h5", ".hdf5", ".mcap", ".npz",
    ".raw", ".txt",
}  # fmt: skip
"""Suffixes of files that may be recordings."""
MOST_FILES = 200
"""Largest number of files that are listed."""


class Library:
    """Files in a folder that a page may open. The page names a file, never a folder."""

    def __init__(self, folder: Path, open_file: Callable[[Path], Inspector]) -> None:
        self.folder, self._open_file = folder.resolve(), open_file

    def files(self) -> list[list[str]]:
        """Return names and sizes of the files, in the order of their names."""
        found = sorted(path for path in self.folder.iterdir() if self._is_recording(path))
        return [[path.name, f"{path.stat().st_size / 1e6:,.1f} MB"] for path in found[:MOST_FILES]]

    def open(self, name: str) -> Inspector:
        """Open a file of the folder. Raises :class:`AmiwarpError` for any other name, or if it is no recording."""
        if name not in [file for file, _ in self.files()]:
            raise AmiwarpError(f"{name!r}: is no recording in {self.folder}; choose one from the list")
        return self._open_file(self.folder / name)

    def _is_recording(self, path: Path) -> bool:
        """Return whether a file looks like a recording, and lies in the folder even if it is a link."""
        visible = path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
        return visible and path.is_file() and path.resolve().parent == self.folder
