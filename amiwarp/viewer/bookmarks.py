"""Bookmarks: named views of a recording, in a JSON file beside it."""

import json
from pathlib import Path

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.json_files import read_json
from amiwarp.io.outputs import write_text

FORMAT = "amiwarp views"
VERSION = 1
"""What the file says that it is."""
LONGEST_NAME = 60
MOST_VIEWS = 200
"""Largest length of a name [characters], and largest number of bookmarks of a recording."""
MOST_BYTES = 1 << 20
"""Largest size of a file [bytes]."""


class Bookmarks:
    """Bookmarks of a recording: texts by name, as in the page's address.

    Each call reads the file again, because other tabs and programs may have changed it.
    """

    def __init__(self, recording: Path) -> None:
        self.path = recording.with_name(f"{recording.name}.view.json")
        """File of the bookmarks."""

    def names(self) -> list[str]:
        """Return the names in their order. Raises :class:`AmiwarpError` if the file is damaged or a foreign one."""
        return sorted(self._read())

    def save(self, name: str, text: str) -> None:
        """Save the text of a state under a new name.

        Raises :class:`AmiwarpError` for a bad name, a name that exists, if there are too many bookmarks, and if the
        file cannot be written or is a foreign one, which is kept.
        """
        views = self._read()
        name = name.strip()
        if not (name and name.isprintable() and len(name) <= LONGEST_NAME):
            raise AmiwarpError(
                f"the name {name!r:.80} cannot be taken; give 1 to {LONGEST_NAME} letters or digits"
            )
        if name in views:
            raise AmiwarpError(
                f"{self.path.name}: {name!r} exists; give another name, or delete it first",
                ErrorCode.OUTPUT_EXISTS,
            )
        if len(views) >= MOST_VIEWS:
            raise AmiwarpError(
                f"{self.path.name}: holds {len(views)} views, which is the maximum; delete some first"
            )
        self._write({**views, name: text})

    def delete(self, name: str) -> None:
        """Delete a bookmark. Raises :class:`AmiwarpError` if there is none of this name, or as :meth:`save` does."""
        views = self._read()
        self._known(views, name)
        del views[name]
        self._write(views)

    def load(self, name: str) -> str:
        """Return the text of a bookmark.

        Raises :class:`AmiwarpError` if there is no bookmark of this name, or the file is damaged or a foreign one.
        """
        views = self._read()
        self._known(views, name)
        return views[name]

    def _known(self, views: dict[str, str], name: str) -> None:
        if name not in views:
            known = f"choose among {', '.join(sorted(views))}" if views else "it holds none yet"
            raise AmiwarpError(f"{self.path}: has no view {name!r:.80}; {known}")

    def _read(self) -> dict[str, str]:
        if not self.path.exists():
            return {}
        data = read_json(self.path, "bookmarks", most_bytes=MOST_BYTES, noted=False)
        views = data.get("views")
        known = data.get("format") == FORMAT and data.get("version") == VERSION
        if not (
            known
            and isinstance(views, dict)
            and all(isinstance(text, str) for text in views.values())
        ):
            raise AmiwarpError(
                f"{self.path}: holds no bookmarks of amiwarp (format {FORMAT!r}, version {VERSION}); rename it to save "
                "views of this recording"
            )
        return dict(views)

    def _write(self, views: dict[str, str]) -> None:
        data = {"format": FORMAT, "version": VERSION, "views": dict(sorted(views.items()))}
        write_text(self.path, json.dumps(data, indent=1, ensure_ascii=False) + "\n", overwrite=True)
