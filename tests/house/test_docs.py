"""The documentation's links have a target, headings included; its index names every page; files and names exist."""

import importlib
import pkgutil
import re
from pathlib import Path
from typing import Any

import pytest
import typer

from benchmarks import report
from tests import ROOT
from tests.command_line import app

DOCS = ROOT / "docs"
MADE = [
    ROOT / line[1:]
    for line in (ROOT / ".gitignore").read_text().split()
    if line.startswith("/docs/")
]
"""Paths that the build of the site writes next to the sources."""
SOURCES = [
    page
    for page in sorted(DOCS.rglob("*.md"))
    if not any(page == made or made in page.parents for made in MADE)
]
PAGES = [
    *sorted(ROOT.glob("*.md")),
    *SOURCES,
    *sorted((ROOT / "benchmarks" / "results").glob("*.md")),
]


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
    lines = [
        line.strip()
        for tree in trees
        for line in tree.splitlines()
        if line.strip() and not line.startswith(":")
    ]
    entries = [re.sub(r".*<(.*)>$", r"\1", line) for line in lines]
    patterns = [re.compile(re.escape(entry).replace(r"\*", "[^/]*")) for entry in entries]
    return [name for name in names if not any(pattern.fullmatch(name) for pattern in patterns)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    assert broken(page) == []


def test_a_broken_link_is_seen(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# One heading\n[a](#one-heading) [b](#two) [c](none.md) [d](https://example.org/)\n"
    )
    assert broken(page) == ["#two", "none.md"]


def test_the_index_names_every_page() -> None:
    names = [
        page.relative_to(DOCS).with_suffix("").as_posix()
        for page in SOURCES
        if page != DOCS / "index.md"
    ]
    assert unnamed((DOCS / "index.md").read_text(), [*names, "changelog"]) == []
    assert len(names) >= 10


def test_a_page_that_is_not_named_is_seen() -> None:
    index = "a\n```{toctree}\n:glob:\n\none\nTwo <two>\nhow-to/*\n```\nthree\n"
    assert unnamed(index, ["one", "two", "three", "how-to/four", "how-to/deep/five"]) == [
        "three",
        "how-to/deep/five",
    ]


def test_what_the_site_makes_is_not_checked_as_a_source() -> None:
    assert DOCS / "_build" in MADE
    assert DOCS / "changelog.md" in MADE
    assert all("_build" not in page.parts and page.name != "changelog.md" for page in SOURCES)


CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
PLACE = re.compile(r"(?:amiwarp|benchmarks|docs|examples|reference|tests)/[\w./-]*|[\w./-]+\.pyi?")
PLACEHOLDERS = ("NAME.py",)


def missing_files(text: str, *bases: str) -> list[str]:
    """Return the paths in code spans that do not exist below the repository or below one of its folders ``bases``."""
    places = [
        place for span in CODE.findall(text) for place in span.split() if PLACE.fullmatch(place)
    ]
    return [
        place for place in places
        if not place.endswith(PLACEHOLDERS) and not any((ROOT / base / place).exists() for base in ("", *bases))
        and not any((ROOT / place).is_relative_to(made) for made in MADE)
    ]  # fmt: skip


def unknown_names(text: str, source: str) -> list[str]:
    """Return the identifiers in code spans of which a part does not occur in ``source``."""
    spans = [span.removesuffix("()") for span in CODE.findall(text)]
    names = [
        span
        for span in spans
        if re.fullmatch(r"[A-Za-z_][\w.]*", span) and not PLACE.fullmatch(span)
    ]
    known = set(re.findall(r"\w+", source))
    return [name for name in names if not known.issuperset(name.split("."))]


OF_FILE = re.compile(r"((?:`\w+`(?:,| and| or)? ?)+)(?:of|in|\()\s*`((?:amiwarp/)?[\w/]+\.py)`")


def names_of_other_files(text: str) -> list[str]:
    """Return the names that a page says are of a file, "`name` of `file.py`", and that the file does not define."""
    out = []
    for spans, place in OF_FILE.findall(" ".join(text.split())):
        file = next(
            (ROOT / base / place for base in ("", "amiwarp") if (ROOT / base / place).is_file()),
            None,
        )
        if file is None:
            continue  # another test tells missing files
        for name in re.findall(r"\w+", spans.replace(" and", "").replace(" or", "")):
            if not re.search(
                rf"^ *(?:class|def) {name}\b|^ *{name}\b *[:=]", file.read_text(), re.M
            ):
                out.append(f"{name} of {place}")
    return out


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/how-to/add-an-optic.md"])
def test_names_are_defined_in_the_file_that_a_page_says(page: str) -> None:
    assert names_of_other_files((ROOT / page).read_text()) == []


def test_a_name_of_another_file_is_seen() -> None:
    text = "`shake` (`amiwarp/simulation/view.py`); `shake` and `MODELS` of `optics/models/registry.py`,"
    text += " `gone` in\n`amiwarp/choices.py`"
    found = ["shake of optics/models/registry.py", "gone of amiwarp/choices.py"]
    assert names_of_other_files(text) == found


def source_text() -> str:
    """Return the text of the package, its tests, what they compare with, and its settings."""
    files = [
        ROOT / "pyproject.toml",
        *(ROOT / "amiwarp").rglob("*.py*"),
        *(ROOT / "tests").rglob("*.py"),
        *(ROOT / "reference").rglob("*.py"),
    ]
    own = [
        file for file in files if file.suffix in (".py", ".pyi", ".toml") and file != Path(__file__)
    ]
    return "\n".join(file.read_text() for file in own)


@pytest.mark.parametrize("page", PAGES[1:], ids=lambda page: page.relative_to(ROOT).as_posix())
def test_files_that_a_page_names_exist(page: Path) -> None:
    """The first page is the changelog, which may name what is gone."""
    assert missing_files(page.read_text(), "amiwarp") == []


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_names_occur_in_the_source(page: str) -> None:
    """The end of the changelog lists names that are gone."""
    assert unknown_names((ROOT / page).read_text().partition("### Renamed")[0], source_text()) == []


def test_files_and_names_that_do_not_exist_are_seen() -> None:
    text = "`calib/solve.py` only; `amiwarp/io/NAME.py`, `tests/none/`, `amiwarp/io/`; `pytest tests/io`"
    assert missing_files(text, "amiwarp") == ["calib/solve.py", "tests/none/"]
    names = "`MODEL_STRUCTS`, `Sharp.score`, `Sharp.gone`, `Gone.score`, `known()`, `a b`"
    assert unknown_names(names, "Sharp score known") == [
        "MODEL_STRUCTS",
        "Sharp.gone",
        "Gone.score",
    ]


SHELL = re.compile(r"```sh\n(.*?)```|<!-- given: (.*?) -->", re.S)
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")
DOTTED = re.compile(r"(?<![\w./-])amiwarp(?:\.[A-Za-z_]\w*)+")
COMMAND = re.compile(r"(?<![\w.-])amiwarp ([a-z]+(?:-[a-z]+)*)([^;|&#`]*)")
BENCHMARK = re.compile(r"python -m (benchmarks[\w.]*)([^;|&#`]*)")


def code_lines(text: str) -> list[str]:
    """Return the code spans of a page, and the lines of its shell commands."""
    commands = "\n".join(first or second for first, second in SHELL.findall(text))
    return [*CODE.findall(SHELL.sub("", text)), *commands.splitlines()]


def options_of(command: Any) -> set[str]:
    """Return the options of a command and of the commands below it."""
    below = getattr(command, "commands", {}).values()
    own = {option for one in command.params for option in (*one.opts, *one.secondary_opts)}
    return own.union({"--help"}, *map(options_of, below))


def resolves(dotted: str) -> bool:
    try:
        pkgutil.resolve_name(dotted)
    except (ImportError, AttributeError):
        return False
    return True


def unknown_commands(text: str) -> list[str]:
    """Return what code on a page names and does not exist: dotted names, commands, programs and their options."""
    commands = {name: options_of(one) for name, one in typer.main.get_command(app).commands.items()}
    programs = {path.stem: path.read_text() for path in (ROOT / "benchmarks").glob("*.py")}
    others = (ROOT / "rig" / "__main__.py", ROOT / "paper" / "build.py")
    sources = [*programs.values(), *(path.read_text() for path in others)]
    anywhere = set().union(*commands.values()) | {
        option for source in sources for option in OPTION.findall(source)
    }
    out = []
    for line in code_lines(text):
        out += [name for name in DOTTED.findall(line) if not resolves(name)]
        for name, rest in COMMAND.findall(line):
            out += [name] if name not in commands else set(OPTION.findall(rest)) - commands[name]
        for name, rest in BENCHMARK.findall(line):
            source = programs.get(name.rpartition(".")[2] if "." in name else "__main__")
            out += (
                [name]
                if source is None
                else [o for o in OPTION.findall(rest) if f'"{o}"' not in source]
            )
        out += [
            option
            for option in OPTION.findall(line)
            if line.startswith("--") and option not in anywhere
        ]
    return out


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_names_commands_and_options_on_a_page_exist(page: Path) -> None:
    assert unknown_commands(page.read_text()) == []


def test_commands_that_do_not_exist_are_seen() -> None:
    text = "`amiwarp.calibrate(r)` `amiwarp.events.solve` `amiwarp info F --count --loud` `--deaf` `--help`\n```sh\n"
    text += ".venv/bin/pip install x --pre\namiwarp dance\n"
    text += "python -m benchmarks.report --check --bad\npython -m benchmarks.no\n```"
    assert unknown_commands(text) == [
        "amiwarp.events.solve", "--loud", "--deaf", "dance", "--bad", "benchmarks.no",
    ]  # fmt: skip


@pytest.fixture
def page_commands(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    return importlib.import_module("page_commands")


def untested(page_commands: Any, text: str) -> list[str]:
    """Return what is wrong with the twins of a page's blocks that are marked as not tested."""
    out = []
    for block, twin in page_commands.with_twins(page_commands.blocks(text)):
        marked = block.text.startswith(page_commands.NOT_RUN)
        if marked and twin is None:
            out.append(f"line {block.line}: no twin")
        elif marked:
            out += [f"line {block.line}: {name}" for name in page_commands.lacking(block, twin)]
        elif twin is not None:
            out.append(f"line {twin.line}: the twin of a block that runs")
    return out


def test_each_block_that_is_not_tested_has_a_twin_with_its_commands_and_options(
    page_commands: Any,
) -> None:
    found = {page: untested(page_commands, page.read_text()) for page in run_pages(page_commands)}
    assert {page: problems for page, problems in found.items() if problems} == {}


def run_pages(page_commands: Any) -> list[Path]:
    """Return the pages whose commands the site's build runs, those that it copies from other folders among them."""
    return [*page_commands.pages_of(), ROOT / "rig/numbers.md", ROOT / "ros/amiwarp_ros/README.md"]


ELSEWHERE = re.compile(r"^(?:sudo|ros2|colcon|docker)\b", re.M)
"""Commands of programs that the machine which builds the site need not have."""


def runs_elsewhere(page_commands: Any, text: str) -> list[int]:
    """Return the lines of a page's blocks that would run such a program."""
    return [
        block.line
        for block in page_commands.blocks(text)
        if block.kind == "sh"
        and ELSEWHERE.search(block.text)
        and not block.text.startswith(page_commands.NOT_RUN)
        and not page_commands.INSTALLATION.search(block.text)
    ]


def test_blocks_of_programs_that_the_site_lacks_are_marked(page_commands: Any) -> None:
    found = {p: runs_elsewhere(page_commands, p.read_text()) for p in run_pages(page_commands)}
    assert {page: lines for page, lines in found.items() if lines} == {}
    assert runs_elsewhere(page_commands, "```sh\namiwarp info a\nros2 topic list\n```\n") == [1]


def test_a_missing_twin_and_a_missing_option_are_seen(page_commands: Any) -> None:
    block = (
        "```sh\n# not tested: long\namiwarp view a.h5 --web  # or --live\n"
        "python -m benchmarks.fuzz --files 9\n```\n"
    )
    code = "```python\n# not tested: long\namiwarp.view(recording)\n```\n"
    assert untested(page_commands, block) == ["line 1: no twin"]
    assert untested(page_commands, block + "```sh\ntrue\n```\n") == ["line 1: no twin"]
    assert untested(page_commands, "```sh\ntrue\n```\n<!-- twin: true -->\n") == [
        "line 4: the twin of a block that runs"
    ]
    whole = (
        "<!-- twin:\namiwarp view b.h5 --web\npython -m benchmarks.fuzz --files 1 --frames 2\n-->\n"
    )
    assert untested(page_commands, block + whole) == []
    assert untested(page_commands, block + whole.replace("--web", "--webs")) == ["line 1: --web"]
    part = "<!-- twin without --web, benchmarks.fuzz --files: amiwarp info b.h5 -->\n"
    assert untested(page_commands, block + part) == ["line 1: amiwarp view"]
    assert untested(page_commands, code + "<!-- twin: amiwarp.views(1) -->\n") == [
        "line 1: amiwarp.view"
    ]


def test_tables_of_speed_are_those_of_the_measured_files() -> None:
    assert report.PAGE.read_text() == report.refreshed()
