"""Helpers for pages that are written before Sphinx reads its sources."""

from __future__ import annotations

import re
from pathlib import Path


def heading(text: str, line: str = "=") -> str:
    """Return a heading in reStructuredText."""
    return f"{text}\n{line * len(text)}\n\n"


def escape(text: str) -> str:
    """Return ``text`` such that reStructuredText shows it unchanged."""
    marked = re.sub(r"([\\*`|_])", r"\\\1", text)
    return re.sub(r":(?=\S)", r"\\:", marked)  # else what looks like an address becomes a link


def write_page(path: Path, text: str) -> None:
    """Write a page; one that is right already keeps its time stamp."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def write_pages(folder: Path, pages: dict[str, str]) -> None:
    """Make ``folder`` hold exactly ``pages``."""
    if folder.exists():
        for old in folder.iterdir():
            if old.name not in pages:
                old.unlink()
    for name, text in pages.items():
        write_page(folder / name, text)
