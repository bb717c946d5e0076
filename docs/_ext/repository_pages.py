"""Show files of the repository that lie outside ``docs`` as pages, and make links between all of them work.

Each entry of ``repository_pages`` is a page and the file that it shows; ``*`` stands for any name. The pages are
copied before Sphinx reads its sources and are not under version control. A file that is not Markdown is shown as code.
Links in Markdown are made for the repository, and lead somewhere in a plain checkout: on the site a link to a file
that is shown leads to its page, and a link to a folder becomes plain text.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from generated_files import write_page
from sphinx.application import Sphinx

LINK = re.compile(
    r"(?<!!)\[((?:[^\[\]]|!\[[^\]]*\]\([^)]*\))*)\]\(([^)\s]+)\)|(!\[[^\]]*\])\(([^)\s]+)\)"
)
"""A link with its text, or a picture."""


def shown_files(docs: Path, entries: dict[str, str]) -> dict[str, Path]:
    """Return the file that each page shows."""
    out = {}
    for page, pattern in entries.items():
        for path in sorted(docs.parent.glob(pattern)):
            out[page.replace("*", path.stem)] = path.resolve()
    return out


def page_text(docs: Path, page: str, path: Path) -> str:
    """Return the text of ``page``, which shows the file ``path``."""
    if path.suffix == ".md":
        return path.read_text()
    language, shown = (
        path.suffix.removeprefix(".").replace("py", "python"),
        os.path.relpath(path, (docs / page).parent),
    )
    name = path.relative_to(docs.parent).as_posix()
    return f"---\norphan: true\n---\n\n# {name}\n\n```{{literalinclude}} {shown}\n:language: {language}\n```\n"


def rewrite(
    text: str, page: str, docs: Path, shown: dict[str, Path], aliases: dict[str, str]
) -> str:
    """Return the Markdown of ``page`` with links that lead to the right pages of the site."""
    pages = {path: name for name, path in shown.items()}
    pages.update({(docs.parent / path).resolve(): name for path, name in aliases.items()})
    here = (docs / page).parent
    base = shown[page].parent if page in shown else here

    def target(link: str) -> str:
        path, hash_, anchor = link.partition("#")
        file = (base / path).resolve()
        if not path or "://" in link or not file.exists():
            return link
        if file in pages:
            suffix = ".rst" if pages[file].startswith("gallery/") else ".md"
            return os.path.relpath(docs / f"{pages[file]}{suffix}", here) + hash_ + anchor
        return os.path.relpath(file, here) + hash_ + anchor

    def link(match: re.Match[str]) -> str:
        if match[3]:
            return f"{match[3]}({target(match[4])})"
        folder = (
            "://" not in match[2]
            and (base / match[2].partition("#")[0]).is_dir()
            and not match[2].startswith("#")
        )
        return match[1] if folder else f"[{match[1]}]({target(match[2])})"

    return LINK.sub(link, text)


def write(app: Sphinx, config: object) -> None:
    """Copy the files that are shown, and remove copies of files that are gone."""
    docs = Path(app.srcdir)
    shown = shown_files(docs, app.config.repository_pages)
    for page in app.config.repository_pages:
        for old in docs.glob(f"{page}.md"):
            if old.relative_to(docs).with_suffix("").as_posix() not in shown:
                old.unlink()
    for page, path in shown.items():
        write_page(docs / f"{page}.md", page_text(docs, page, path))


def read(app: Sphinx, docname: str, source: list[str]) -> None:
    """Correct the links of a page as it is read."""
    if app.env.doc2path(docname).suffix == ".md":
        docs = Path(app.srcdir)
        shown = shown_files(docs, app.config.repository_pages)
        source[0] = rewrite(source[0], docname, docs, shown, app.config.repository_aliases)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register both steps."""
    app.add_config_value("repository_pages", {}, "env")
    app.add_config_value("repository_aliases", {}, "env")
    app.connect("config-inited", write)
    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
