"""Files that match a pattern as in the module glob, of which a limited number is looked at."""

from __future__ import annotations

import contextlib
import fnmatch
import glob
import itertools
import os
from collections.abc import Iterator
from pathlib import Path

from amiwarp.errors import AmiwarpError
from amiwarp.validation import shown

MOST_VISITED = 2_000_000
"""Largest number of files and folders that one pattern leads through."""


def matches(folder: Path, pattern: str) -> list[str]:
    """Return the paths that match a pattern as in the module glob, sorted and relative to ``folder``.

    Raises :class:`AmiwarpError` after :data:`MOST_VISITED` entries of folders.
    """
    segments = [segment for segment in pattern.split("/") if segment]
    if pattern.endswith("**"):
        segments.append("*")
    search = _Search(folder)
    paths = ["/" if pattern.startswith("/") else ""]
    try:
        for segment in segments:
            inner = [path for outer in paths for path in search.step(outer, segment)]
            paths = list(dict.fromkeys(inner))
    except _TooMany:
        raise AmiwarpError(
            f"pattern {shown(pattern)} leads through more than {MOST_VISITED:,} files and folders; name the folders"
        ) from None
    return sorted(path for path in paths if path)


class _TooMany(Exception):
    """The limit of :func:`matches`."""


class _Search:
    """Search in a folder, which counts the entries that it looks at. All paths are relative to the folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._visited = itertools.count(1)

    def step(self, path: str, segment: str) -> Iterator[str]:
        """Yield the paths below a path that match one segment of a pattern."""
        if segment == "**":
            yield from self._folders_below(path)
        elif glob.has_magic(segment):
            names = [entry.name for entry in self._entries(path)]
            if not segment.startswith("."):
                names = [name for name in names if not name.startswith(".")]
            for name in fnmatch.filter(names, segment):
                yield os.path.join(path, name)
        elif os.path.lexists(self._folder / path / segment):
            yield os.path.join(path, segment)

    def _folders_below(self, path: str) -> Iterator[str]:
        """Yield a folder and all folders in it, at any depth, but for hidden ones."""
        # Each folder with the identities of the folders above it
        waiting: list[tuple[str, frozenset[tuple[int, int]]]] = [(path, frozenset())]
        while waiting:
            folder, above = waiting.pop()
            with contextlib.suppress(OSError, ValueError):
                state = os.stat(self._folder / folder)
                identity = (state.st_dev, state.st_ino)
                # A link to a folder above it has no end.
                if identity in above:
                    continue
                yield folder
                for entry in self._entries(folder):
                    if not entry.name.startswith(".") and _is_folder(entry):
                        waiting.append((os.path.join(folder, entry.name), above | {identity}))

    def _entries(self, path: str) -> Iterator[os.DirEntry[str]]:
        """Yield the entries of a folder; nothing if it is no folder, or cannot be read."""
        with contextlib.suppress(OSError, ValueError), os.scandir(self._folder / path) as listed:
            for entry in listed:
                if next(self._visited) > MOST_VISITED:
                    raise _TooMany
                yield entry


def _is_folder(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry is a folder or a link to one."""
    with contextlib.suppress(OSError):  # a link to itself
        return entry.is_dir()
    return False
