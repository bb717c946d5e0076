"""Copies of the repository in which the code is changed to test its tests."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
PATIENCE, START_S = 8.0, 240.0
"""Tests of changed code hang after this multiple of their duration and this time [s], in which kernels are compiled."""
CLOCK = itertools.count(10**9)
"""Times of change of the changed files [s]."""


def make_copies(folder: Path, count: int) -> list[Path]:
    """Copy the repository ``count`` times, without what tests do not need.

    Programs that run in the background ignore interrupts, and so would the tests, which interrupt themselves.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return [Path(shutil.copytree(ROOT, folder / str(k), ignore=_unneeded)) for k in range(count)]


def _unneeded(folder: str, names: list[str]) -> set[str]:
    """Return those among the names in a folder of the repository that tests do not need."""
    unneeded = shutil.ignore_patterns(".*", "_build")(folder, names)
    if Path(folder) == ROOT / "benchmarks":
        unneeded |= {"results"}
    return unneeded


def files_of_tests(root: Path, names: Sequence[str]) -> list[str]:
    """Return the paths in a copy of the repository of test files, each named without its folder and ``test_``."""
    paths = {
        path.stem.removeprefix("test_"): path.relative_to(root).as_posix()
        for path in (root / "tests").rglob("test_*.py")
    }
    missing = [name for name in names if name not in paths]
    if missing:
        raise SystemExit(f"no file test_{missing[0]}.py in {root / 'tests'}")
    return [paths[name] for name in names]


def write_code(path: Path, code: str) -> None:
    """Write a module. Python recognises compiled code by the second of the change, so each has its own."""
    path.write_text(code)
    os.utime(path, (next(CLOCK),) * 2)


def run_python(
    copy: Path, command: Sequence[str], limit_s: float | None, environment: dict[str, str]
) -> tuple[int, str]:
    """Run Python in a copy of the repository. Return its exit status and its output."""
    environment = os.environ | {"PYTHONPATH": str(copy)} | environment
    with subprocess.Popen(
        [sys.executable, *command], cwd=copy, env=environment, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, start_new_session=True,
    ) as child:  # fmt: skip
        try:
            output, _ = child.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            return -9, "timeout"
    return child.returncode, output
