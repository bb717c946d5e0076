"""Recordings that a page can open: the files in one folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from amiwarp.errors import AmiwarpError
from amiwarp.io.array_maps import holds_map
from amiwarp.io.output_formats import EXTENSIONS
from amiwarp.results.depth_map import DepthMap
from amiwarp.results.pixel_map import PixelMap
from amiwarp.viewer.inspector import Inspector

SUFFIXES = {*EXTENSIONS, ".aedat", ".aedat2", ".bag", ".bin", ".csv", ".dat", ".es"}
"""Suffixes of files that may be recordings."""
MOST_FILES = 200
"""Largest number of files that are listed."""


class Library:
    """Files in a folder that a page may open. The page names a file, never a folder."""

    def __init__(self, folder: Path, open_file: Callable[[Path], Inspector]) -> None:
        self.folder = folder.resolve()
        self._open_file = open_file

    def files(self) -> list[list[str]]:
        """Return names and sizes of the files, in the order of their names."""
        found = sorted(path for path in self.folder.iterdir() if self._is_recording(path))
        return [[path.name, f"{path.stat().st_size / 1e6:,.1f} MB"] for path in found[:MOST_FILES]]

    def _is_recording(self, path: Path) -> bool:
        """Return whether an entry of the folder looks like a recording that a page may open."""
        return (
            path.suffix.lower() in SUFFIXES
            and not path.name.startswith(".")
            and path.is_file()
            and path.resolve().parent == self.folder  # also if it is a link
            and not holds_map(path, (DepthMap, PixelMap))
        )

    def open(self, name: str) -> Inspector:
        """Open a file of the folder. Raises :class:`AmiwarpError` for any other name, or if it is no recording."""
        if name not in [file for file, _ in self.files()]:
            raise AmiwarpError(
                f"{name!r}: is no recording in {self.folder}; choose one from the list"
            )
        made = self._open_file(self.folder / name)
        made.path = self.folder / name
        return made
