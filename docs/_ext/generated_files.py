"""Functions that write generated pages before Sphinx reads its sources."""

from __future__ import annotations

import re
from pathlib import Path


def heading(text: str, line: str = "=") -> str:
    """Return a heading in reStructuredText, underlined by the character ``line``."""
    return f"{text}\n{line * len(text)}\n\n"


def escape(text: str) -> str:
    """Return ``text`` with the markup characters of reStructuredText escaped."""
    marked = re.sub(r"([\\*`|_])", r"\\\1", text)
    return re.sub(
        r":(?=\S)", r"\\:", marked
    )  # otherwise text that looks like an address becomes a link


def write_page(path: Path, text: str) -> None:
    """Write a page unless the file has this text already, so that an unchanged page keeps its time stamp."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def write_pages(folder: Path, pages: dict[str, str]) -> None:
    """Write pages by name into ``folder``, and delete all other files in it."""
    if folder.exists():
        for old in folder.iterdir():
            if old.name not in pages:
                old.unlink()
    for name, text in pages.items():
        write_page(folder / name, text)
