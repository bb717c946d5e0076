"""Planted defects: do the tests of a module notice what a person could get wrong in it?

    python -m benchmarks.planted [--only AREA …] [--jobs 2] [--again FILE.json] [--out FILE.json]

``benchmarks/planted.toml`` lists defects by hand: a sign, a swapped pair, a lost case, a cache that is not renewed.
Each is planted alone in a copy of the repository, and the module's own test files run until a test fails, which kills
it. Without a defect they must pass. A defect is stale if its text is not in the code exactly once, spaces and line
breaks aside, or if no test can run with it. The exit status is 1 unless all are killed. ``--again`` judges only what an
earlier ``--out`` did not kill.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import warp as wp

from benchmarks.copies import (
    PATIENCE,
    ROOT,
    START_S,
    files_of_tests,
    make_copies,
    run_python,
    write_code,
)

DEFECTS = ROOT / "benchmarks" / "planted.toml"


@dataclass(frozen=True)
class Defect:
    """One defect, as ``planted.toml`` describes it."""

    round: int
    area: str
    file: str
    before: str
    after: str
    wrong: str
    tests: tuple[str, ...]

    @property
    def name(self) -> tuple[str, str, str]:
        """What tells the defect from all others."""
        return self.file, self.before, self.after


def name_of(row: dict[str, Any]) -> tuple[str, str, str]:
    """Return the name of the defect of a row of a file of outcomes, as :attr:`Defect.name`."""
    return row["file"], row["before"], row["after"]


def load() -> list[Defect]:
    """Return all defects."""
    rows = tomllib.loads(DEFECTS.read_text())["defect"]
    return [Defect(**{**row, "tests": tuple(row["tests"])}) for row in rows]


TOKEN = re.compile(
    r"""(?P<comment>\#[^\n]*)|(?P<text>[rbuf]*(?:\"{3}[\s\S]*?\"{3}|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'))"""
    r"""|(?P<word>\w+)|(?P<sign>[^\s\w])"""
)
"""Pieces of code that formatting does not change."""
CLOSING = frozenset(")]}")


def tokens_of(code: str) -> list[tuple[str, int, int]]:
    """Return the pieces of code with their first place and the place after them.

    Comments are left out, and commas before a closing bracket: the formatter adds and removes them.
    """
    found = [
        (match.group(), match.start(), match.end())
        for match in TOKEN.finditer(code)
        if match.lastgroup != "comment"
    ]
    after = [token for token, _, _ in found[1:]] + [""]
    return [
        piece
        for piece, following in zip(found, after, strict=True)
        if piece[0] != "," or following not in CLOSING
    ]


def place_of(code: str, text: str) -> tuple[int, int] | None:
    """Return where a text is in the code, whatever the spaces and line breaks; None if not exactly once."""
    have = tokens_of(code)
    words = [token for token, _, _ in have]
    wanted = [token for token, _, _ in tokens_of(text)]
    first = [k for k, word in enumerate(words) if word == wanted[0]]
    found = [k for k in first if words[k : k + len(wanted)] == wanted]
    if len(found) != 1:
        return None
    return have[found[0]][1], have[found[0] + len(wanted) - 1][2]


def planted_in(code: str, defect: Defect) -> str | None:
    """Return the code with the defect; None if the text that it replaces is not there exactly once."""
    place = place_of(code, defect.before)
    if place is None:
        return None
    start, end = place
    return code[:start] + defect.after.strip() + code[end:]


def is_stale(defect: Defect) -> bool:
    """Return whether the code that the defect replaces is not in its file exactly once."""
    path = ROOT / defect.file
    return not path.is_file() or planted_in(path.read_text(), defect) is None


def run_tests(
    copy: Path, tests: Sequence[str], limit_s: float | None, kernels: Path
) -> tuple[int, str]:
    """Run test files until a test fails. Return the exit status and the reason."""
    command = [
        "-m",
        "pytest",
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        *files_of_tests(copy, tests),
    ]
    status, output = run_python(copy, command, limit_s, {"WARP_CACHE_PATH": str(kernels)})
    lines = [
        line for line in output.splitlines() if line.startswith(("FAILED", "ERROR", "timeout"))
    ]
    reason = (lines or [output.strip()[-200:]])[-1]
    # Without folders of this machine
    return status, re.sub(r"(?<![\w.])(/[\w.-]+){2,}/", "", reason)[:300]


def judge(defect: Defect, copy: Path, seconds: float, kernels: Path) -> tuple[str, str]:
    """Plant a defect in a copy. Return ``killed``, ``survived`` or ``stale``, and the reason."""
    path = copy / defect.file
    code = path.read_text()
    changed = planted_in(code, defect)
    if changed is None:
        return "stale", f"{defect.file} does not have the text exactly once"
    write_code(path, changed)
    try:
        status, reason = run_tests(copy, defect.tests, PATIENCE * seconds + START_S, kernels)
    finally:
        write_code(path, code)
    outcome = {0: "survived", 2: "stale"}.get(status, "killed")  # 2: the tests cannot be collected
    return outcome, "" if status == 0 else reason


def score(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Return the number of each outcome, by round."""
    rounds = sorted({row["round"] for row in rows})
    return {
        f"round {k}": dict(Counter(row["outcome"] for row in rows if row["round"] == k))
        for k in rounds
    }


def first_scores(earlier: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """Return the first score of each round: a round of an earlier run keeps its score, a new one has today's."""
    return found | earlier


def main() -> None:
    """Read the command line, judge the defects and print the outcomes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", metavar="AREA", help="names of areas")
    parser.add_argument("--jobs", type=int, default=1, help="defects at the same time")
    parser.add_argument(
        "--again",
        type=Path,
        metavar="FILE.json",
        help="judge only what an earlier --out did not kill",
    )
    parser.add_argument("--out", type=Path, help="file of all defects and their outcomes")
    given = parser.parse_args()
    chosen = [defect for defect in load() if given.only is None or defect.area in given.only]
    rows: list[dict[str, Any]] = []
    first: dict[str, Any] = {}
    judged: set[tuple[str, str, str]] = set()
    if given.again:
        earlier = json.loads(given.again.read_text())
        first = earlier["first_run"]
        judged = {(row["file"], row["before"], row["after"]) for row in earlier["defects"]}
        killed = {
            (row["file"], row["before"], row["after"])
            for row in earlier["defects"]
            if row["outcome"] == "killed"
        }
        chosen = [defect for defect in chosen if defect.name not in killed]
        today = {defect.name for defect in chosen}
        # Defects of other areas keep their outcome, whatever it was.
        rows = [row for row in earlier["defects"] if name_of(row) not in today]
    wp.init()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(given.jobs) as pool:
        # A copy without what others compile now; kernels of defects are not kept
        kernels = Path(scratch) / "kernels"
        known, unfinished = (
            Path(wp.config.kernel_cache_dir),
            shutil.ignore_patterns("*_p[0-9]*_t[0-9]*"),
        )
        shutil.copytree(known, kernels / known.name, ignore=unfinished)
        copies: SimpleQueue[Path] = SimpleQueue()
        for copy in make_copies(Path(scratch), given.jobs):
            copies.put(copy)

        def measure(tests: tuple[str, ...]) -> float:
            copy, began = copies.get(), time.perf_counter()
            status, reason = run_tests(copy, tests, None, kernels)
            copies.put(copy)
            if status:
                raise SystemExit(f"the tests do not pass without a defect: {reason}")
            return time.perf_counter() - began

        def one(defect: Defect) -> None:
            copy = copies.get()
            outcome, reason = judge(defect, copy, seconds[defect.tests], kernels)
            copies.put(copy)
            rows.append(
                asdict(defect)
                | {"outcome": outcome, "reason": reason, "again": defect.name in judged}
            )
            print(f"{outcome:8} {defect.area}: {defect.wrong}  [{reason}]", flush=True)

        files = sorted({defect.tests for defect in chosen})
        seconds = dict(zip(files, pool.map(measure, files), strict=True))
        list(pool.map(one, chosen))
    order = {defect.name: k for k, defect in enumerate(load())}
    rows.sort(key=lambda row: order.get(name_of(row), len(order)))
    print(found := score(rows))
    if given.out:
        result = {"first_run": first_scores(first, found), "now": found, "defects": rows}
        given.out.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    sys.exit(any(row["outcome"] != "killed" for row in rows))


if __name__ == "__main__":
    main()
