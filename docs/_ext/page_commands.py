"""Run what the pages say to run, and compare what it prints with what the pages show.

Each page is run in an empty folder of its own: the ``sh`` and ``python`` blocks in their order. A block must end
without an error. An ``output`` block must occur in what the block before it has printed, word for word; ``...`` stands
for any words. Numbers must be equal, except those whose spread the info string states by the word that follows them:

    ```output px±10% deg±0.001 s±any

A block whose first line is ``# not tested: REASON`` is not run, and neither are installations with pip. The comment
``<!-- twin: COMMANDS -->`` directly after such a block is run instead: the same work with smaller settings, or without
hardware. Each such block has one, with every command and option of the block (:func:`lacking`), unless the comment
states which it does without: ``<!-- twin without --full --device: COMMANDS -->``.
The comment ``<!-- given: COMMAND -->`` makes files that a page takes for granted, before its first block; pages whose
first such comment is the same share its files. What a guide writes must not be in the way of another guide in the same
folder. In these comments, ``$REPOSITORY`` is the folder of the repository, ``$PAGE`` the file of the page, and
``HELPERS`` has functions for programs that run until Ctrl-C.

Every block runs as in a plain installation. If it needs an extra, amiwarp must say so in one line, and the page must
name the extra; then it runs again with it (``plain_installation.py``).

The build of the site runs the pages that have changed. ``python docs/_ext/page_commands.py PAGE ...`` runs single ones.
"""

from __future__ import annotations

import contextlib
import io
import json
import linecache
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import plain_installation

ROOT = REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = (
    "README.md",
    "docs/getting-started/*.md",
    "docs/how-to/*.md",
    "docs/explanation/*.md",
    "docs/reference/*.md",
)
GUIDES = ("docs/getting-started/", "docs/how-to/")
"""Folders of pages that one reader follows in one folder."""
BLOCK = re.compile(
    r"^( *)```(sh|python|output)([^\n]*)\n(.*?)^\1```$|^ *<!-- (given|twin)( [^:\n]*)?:(.*?)-->",
    re.M | re.S,
)
NUMBER = re.compile(r"(?<![\w.])[-+−]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?", re.I)
NOT_RUN = "# not tested: "
INSTALLATION = re.compile(r"\bpip install\b|\.venv/bin/activate")
"""Commands that continuous integration runs as it sets up its environment."""
LIMIT_S = 300.0


@dataclass(frozen=True)
class Block:
    """One block of a page: its kind, info string (of a twin: what it does without), text and line.

    Kinds are ``sh``, ``python`` and ``output``, and ``given`` and ``twin`` of comments.
    """

    kind: str
    info: str
    text: str
    line: int


def blocks(page: str) -> list[Block]:
    """Return the blocks of a page's text that are run or compared."""
    out = []
    for match in BLOCK.finditer(page):
        line = page.count("\n", 0, match.start()) + 1
        if match[5]:
            out.append(
                Block(match[5], (match[6] or "").strip(), textwrap.dedent(match[7]).strip(), line)
            )
        else:
            out.append(Block(match[2], match[3].strip(), textwrap.dedent(match[4]), line))
    return out


def given_commands(page: Path) -> list[str]:
    """Return the commands that make what a page takes for granted."""
    return [block.text for block in blocks(page.read_text()) if block.kind == "given"]


NAMED = re.compile(r"(?:\bamiwarp|python -m) [a-z][\w.-]*|(?<![\w-])--[a-z][\w-]*|\bamiwarp\.\w+")
"""What a block tests: commands, options, and names of the Python package."""


def lacking(block: Block, twin: Block) -> list[str]:
    """Return the commands, options and names of a block that its twin neither has nor says to do without."""
    text = re.sub(r"(?<!\S)# .*", "", block.text)
    have = {*NAMED.findall(twin.text), *twin.info.removeprefix("without").replace(",", " ").split()}
    return [
        name
        for name in dict.fromkeys(NAMED.findall(text))
        if name not in have and name.split()[-1] not in have
    ]


def with_twins(found: list[Block]) -> Iterator[tuple[Block, Block | None]]:
    """Yield the blocks of a page that are not twins, each with its twin: the comment that follows it directly."""
    for block, following in zip(found, [*found, None][1:], strict=True):
        if block.kind != "twin":
            yield block, following if following is not None and following.kind == "twin" else None


def spreads(info: str) -> dict[str, str]:
    """Return the spread of the numbers before each word, as an info string states them."""
    return dict(item.split("±", 1) for item in info.split())


def close(shown: str, printed: str, spread: str) -> bool:
    """Return whether two numbers differ by no more than a spread: ``any``, a percentage, or a difference."""
    if spread == "any":
        return True
    one, other = (float(text.replace(",", "").replace("−", "-")) for text in (shown, printed))
    allowed = float(spread.rstrip("%")) * (
        max(abs(one), abs(other)) / 100 if spread.endswith("%") else 1
    )
    return math.isclose(one, other, rel_tol=0, abs_tol=allowed * (1 + 1e-9))


def same_word(shown: str, printed: str, following: str, allowed: dict[str, str]) -> bool:
    """Return whether two words are equal but for numbers within the spread of the unit in or after the word."""
    if shown == printed:
        return True
    if NUMBER.sub("#", shown) != NUMBER.sub("#", printed):
        return False
    unit = NUMBER.sub("", shown).strip("().,:;") or following.strip("().,:;")
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return unit in allowed and all(close(one, other, allowed[unit]) for one, other in pairs)


def difference(shown: str, printed: str, info: str = "") -> str | None:
    """Return how the text of a page differs from what was printed, or None if it occurs there."""
    allowed, words, start = spreads(info), printed.split(), 0
    for part in re.split(r"^ *\.\.\. *$", shown, flags=re.M):
        wanted = part.split()
        best, at = -1, start
        for first in range(start, len(words) - len(wanted) + 1):
            rest = [*wanted[1:], ""]
            pairs = zip(wanted, words[first:], rest, strict=False)
            equal = next(
                (k for k, pair in enumerate(pairs) if not same_word(*pair, allowed)), len(wanted)
            )
            if equal > best:
                best, at = equal, first
        if best < len(wanted):
            here = max(best, 0)
            return (f"the page shows {' '.join(wanted[max(0, here - 3) : here + 3])!r}, "
                    f"printed was {' '.join(words[max(0, at + here - 3) : at + here + 3])!r}")  # fmt: skip
        start = at + len(wanted)
    return None


HELPERS = """
trap 'kill $(jobs -p) 2>/dev/null || true; wait || true' EXIT
ready() {
    for file; do for _ in $(seq 1200); do [ -e "$file" ] && continue 2; sleep 0.1; done; return 1; done
}
ctrl_c_after() { timeout --preserve-status --signal INT "$@" || [ $? = 130 ]; }
"""
"""Start of each shell command. Programs in the background end with it. ``ready FILE ...`` waits until they have made
files or sockets, ``ctrl_c_after SECONDS COMMAND`` interrupts a command that runs on."""


def shell(command: str, folder: Path, variables: dict[str, str] | None = None) -> str:
    """Run a shell command in ``folder`` and return what it prints on stdout and stderr."""
    running = subprocess.Popen(
        ["bash", "-euo", "pipefail", "-c", HELPERS + command], cwd=folder, env=variables, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
    )  # fmt: skip
    try:
        printed, _ = running.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(running.pid, signal.SIGTERM)
        running.communicate()
        raise
    if running.returncode:
        raise RuntimeError(f"exit code {running.returncode}: {' '.join(printed.split()[-60:])}")
    return printed


def python(code: str, names: dict[str, Any]) -> str:
    """Run Python code that shares the names of the code before it, and return what it prints."""
    printed = io.StringIO()
    name = f"<page {len(linecache.cache)}>"
    linecache.cache[name] = (
        len(code),
        None,
        code.splitlines(keepends=True),
        name,
    )  # PyTorch reads it
    program = compile(code, name, "exec")
    try:
        with contextlib.redirect_stdout(printed):
            try:
                exec(program, names)
            except Exception:
                need = plain_installation.need_of(traceback.format_exc(), command=False)
                if need is None:
                    raise
                plain_installation.note(need)
                printed.seek(0)
                printed.truncate()
                with plain_installation.everything_shown():
                    exec(program, names)
    except Exception as error:
        raise RuntimeError("".join(traceback.format_exception_only(error)).strip()) from error
    return printed.getvalue()


def problems(text: str, folder: Path) -> Iterator[tuple[int, str]]:
    """Run the blocks of a page's text in ``folder``, the current one, and yield line and text of each problem."""
    names: dict[str, Any] = {"__name__": "__main__"}
    printed = None
    for block, twin in with_twins(blocks(text)):
        if block.kind == "given":
            continue
        if block.kind == "output":
            found = (
                "no block before it was run"
                if printed is None
                else difference(block.text, printed, block.info)
            )
            if found:
                yield block.line, found
            continue
        printed = None
        run = block if twin is None else twin
        if run.text.startswith(NOT_RUN) or (
            run is block and block.kind == "sh" and INSTALLATION.search(block.text)
        ):
            continue
        try:
            printed = python(run.text, names) if block.kind == "python" else shell(run.text, folder)
        except RuntimeError as error:
            yield run.line, str(error)
        except subprocess.TimeoutExpired:
            yield run.line, f"takes longer than {LIMIT_S:g} s"
        for need in plain_installation.noted():
            if not plain_installation.named(text, need):
                yield (
                    run.line,
                    f"needs {need}, which a plain installation lacks and the page does not name",
                )


def written(folder: Path) -> set[str]:
    """Return the files in ``folder``, relative to it."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def environment(page: Path | None = None) -> dict[str, str]:
    """Return the variables for the commands of a page."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    return {
        **os.environ,
        "PATH": path,
        "MPLBACKEND": "agg",
        "REPOSITORY": str(REPOSITORY),
        "PAGE": str(page),
    }


def run_page(page: Path, given: Path, plain: Path) -> dict[str, Any]:
    """Run one page in a new folder, in a process of its own.

    ``given`` is what its first given command has made, ``plain`` the folder of programs in which packages are hidden.
    """
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        shutil.copytree(given, name, dirs_exist_ok=True)
        for command in given_commands(page)[1:]:
            try:
                shell(command, Path(name), environment(page))
            except RuntimeError as error:
                return {"problems": [(1, f"given: {error}")], "files": []}
        before = written(Path(name))
        with tempfile.TemporaryDirectory() as notes:
            needs = Path(notes, "needs")
            needs.touch()
            variables = plain_installation.environment(environment(page), plain, needs)
            done = subprocess.run(
                [sys.executable, __file__, "--page", str(page)], cwd=name, env=variables,
                capture_output=True, text=True, check=False,
            )  # fmt: skip
        found = [] if done.returncode == 0 else [(1, done.stderr[-500:])]
        found += json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 else []
        print(f"{page.relative_to(ROOT)}: {time.perf_counter() - began:.0f} s", file=sys.stderr)
        return {"problems": found, "files": sorted(written(Path(name)) - before)}


def run_pages(pages: list[Path]) -> dict[Path, list[tuple[int, str]]]:
    """Run pages, two at a time, and return the problems of each: line and text."""
    givens = {page: next(iter(given_commands(page)), "") for page in pages}
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(2) as pool:
        folders = {
            command: Path(name) / str(k) for k, command in enumerate(dict.fromkeys(givens.values()))
        }
        for folder in folders.values():
            folder.mkdir()
        plain = Path(name) / "plain"
        plain_installation.prepare(plain)
        first_pages = {command: page for page, command in reversed(givens.items())}
        made = pool.map(
            lambda command: shell(command, folders[command], environment(first_pages[command])),
            folders,
        )
        list(made)
        results = list(pool.map(lambda page: run_page(page, folders[givens[page]], plain), pages))
    out = {
        page: [tuple(found) for found in result["problems"]]
        for page, result in zip(pages, results, strict=True)
    }
    owner: dict[str, Path] = {}
    for page, result in zip(pages, results, strict=True):
        if not page.relative_to(ROOT).as_posix().startswith(GUIDES):
            continue
        for file in result["files"]:
            first = owner.setdefault(file, page)
            if first != page:
                out[page].append((1, f"writes {file}, which {first.relative_to(ROOT)} writes, too"))
    return out


def pages_of(patterns: tuple[str, ...] = PAGES) -> list[Path]:
    """Return the pages whose commands are run. Pages that the build writes have no folder of their own among them."""
    return [path for pattern in patterns for path in sorted(ROOT.glob(pattern))]


def check(app: Any, env: Any, docnames: list[str]) -> None:
    """Warn of each problem of the pages that are read; the README is run with the index."""
    from sphinx.util import logging

    names = {ROOT / "docs" / f"{name}.md": name for name in docnames} | (
        {ROOT / "README.md": "index"} if "index" in docnames else {}
    )
    for page, found in run_pages([page for page in pages_of() if page in names]).items():
        for line, text in found:
            logging.getLogger(__name__).warning("%s", text, location=(names[page], line))


def setup(app: Any) -> dict[str, bool]:
    """Register the check."""
    app.connect("env-before-read-docs", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def main(arguments: list[str]) -> int:
    """Run the pages that are named, or all; with ``--page``, one page in the current folder."""
    if arguments[:1] == ["--page"]:
        found = list(problems(Path(arguments[1]).read_text(), Path.cwd()))
        print(json.dumps(found))
        return 0
    results = run_pages([Path(name).resolve() for name in arguments] or pages_of())
    for page, found in results.items():
        for line, text in found:
            print(f"{page.relative_to(ROOT)}:{line}: {text}")
    return any(results.values())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
