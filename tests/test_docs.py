"""The documentation's links have a target, headings included, and its index names every page."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
MADE = [ROOT / line[1:] for line in (ROOT / ".gitignore").read_text().split() if line.startswith("/docs/")]
"""Paths that the build of the site writes next to the sources."""
SOURCES = [
    page for page in sorted(DOCS.rglob("*.md")) if not any(page == made or made in page.parents for made in MADE)
]
PAGES = [*sorted(ROOT.glob("*.md")), *SOURCES, *sorted((ROOT / "benchmarks" / "results").glob("*.md"))]


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub makes of headings: lower case, no punctuation, hyphens for spaces."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    headings = re.findall(r"^#+ (.*)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken(page: Path) -> list[str]:
    out = []
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        path, _, anchor = target.partition("#")
        file = page if not path else (page.parent / path).resolve()
        if "://" not in target and (not file.exists() or (anchor and anchor not in anchors(file))):
            out.append(target)
    return out


def unnamed(index: str, names: list[str]) -> list[str]:
    """Return the pages that no table of contents of ``index`` names; * stands for any name in a folder."""
    trees = re.findall(r"```\{toctree\}\n(.*?)```", index, re.S)
    lines = [line.strip() for tree in trees for line in tree.splitlines() if line.strip() and not line.startswith(":")]
    entries = [re.sub(r".*<(.*)>$", r"\1", line) for line in lines]
    patterns = [re.compile(re.escape(entry).replace(r"\*", "[^/]*")) for entry in entries]
    return [name for name in names if not any(pattern.fullmatch(name) for pattern in patterns)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    assert broken(page) == []


def test_a_broken_link_is_seen(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# One heading\n[a](#one-heading) [b](#two) [c](none.md) [d](https://example.org/)\n")
    assert broken(page) == ["#two", "none.md"]


def test_the_index_names_every_page() -> None:
    names = [page.relative_to(DOCS).with_suffix("").as_posix() for page in SOURCES if page != DOCS / "index.md"]
    assert unnamed((DOCS / "index.md").read_text(), [*names, "changelog"]) == []
    assert len(names) >= 10


def test_a_page_that_is_not_named_is_seen() -> None:
    index = "a\n```{toctree}\n:glob:\n\none\nTwo <two>\nhow-to/*\n```\nthree\n"
    assert unnamed(index, ["one", "two", "three", "how-to/four", "how-to/deep/five"]) == ["three", "how-to/deep/five"]


def test_what_the_site_makes_is_not_checked_as_a_source() -> None:
    assert DOCS / "_build" in MADE
    assert DOCS / "changelog.md" in MADE
    assert all("_build" not in page.parts and page.name != "changelog.md" for page in SOURCES)
