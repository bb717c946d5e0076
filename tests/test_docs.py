"""The documentation's links have a target, headings included; its index names every page; files and names exist."""

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


CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
PLACE = re.compile(r"(?:amiwarp|benchmarks|docs|examples|tests)/[\w./-]*|[\w./-]+\.pyi?")
PLACEHOLDERS = ("NAME.py",)


def missing_files(text: str, *bases: str) -> list[str]:
    """Return the paths in code spans that do not exist below the repository or below one of its folders ``bases``."""
    places = [place for span in CODE.findall(text) for place in span.split() if PLACE.fullmatch(place)]
    return [
        place for place in places
        if not place.endswith(PLACEHOLDERS) and not any((ROOT / base / place).exists() for base in ("", *bases))
        and not any((ROOT / place).is_relative_to(made) for made in MADE)
    ]  # fmt: skip


def unknown_names(text: str, source: str) -> list[str]:
    """Return the identifiers in code spans that do not occur in ``source``; of dotted ones, the last part counts."""
    spans = [span.removesuffix("()") for span in CODE.findall(text)]
    names = [span for span in spans if re.fullmatch(r"[A-Za-z_][\w.]*", span) and not PLACE.fullmatch(span)]
    known = set(re.findall(r"\w+", source))
    return [name for name in names if name.rpartition(".")[2] not in known]


def source_text() -> str:
    """Return the text of the package, its tests and its settings."""
    files = [ROOT / "pyproject.toml", *(ROOT / "amiwarp").rglob("*.py*"), *(ROOT / "tests").rglob("*.py")]
    own = [file for file in files if file.suffix in (".py", ".pyi", ".toml") and file != Path(__file__)]
    return "\n".join(file.read_text() for file in own)


@pytest.mark.parametrize("page", PAGES[1:], ids=lambda page: page.relative_to(ROOT).as_posix())
def test_files_that_a_page_names_exist(page: Path) -> None:
    """The first page is the changelog, which may name what is gone."""
    assert missing_files(page.read_text(), "amiwarp") == []


def test_names_in_contributing_occur_in_the_source() -> None:
    assert unknown_names((ROOT / "CONTRIBUTING.md").read_text(), source_text()) == []


def test_files_and_names_that_do_not_exist_are_seen() -> None:
    text = "`calib/solve.py` only; `amiwarp/io/NAME.py`, `tests/none/`, `amiwarp/io/`; `pytest tests/test_docs.py`"
    assert missing_files(text, "amiwarp") == ["calib/solve.py", "tests/none/"]
    assert unknown_names("`MODEL_STRUCTS`, `Sharp.score`, `known()`, `a b`", "score known") == ["MODEL_STRUCTS"]
