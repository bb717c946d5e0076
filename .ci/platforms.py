"""Check that amiwarp can be installed from wheels alone: on four platforms, with each supported version of Python.

``uv`` resolves the dependencies against PyPI as of now, and evaluates environment markers for the given platform, which
``pip --platform`` does not. Nothing is installed. Further arguments, such as ``--extra dv``, are given to ``uv``.

Exit codes: 0 all resolve, 1 a combination has no solution, 2 a combination could not be checked.
"""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

PLATFORMS = {
    "Linux x86-64": "x86_64-manylinux_2_28",
    "Linux ARM": "aarch64-manylinux_2_34",  # as old as Warp's wheel allows
    "Windows": "x86_64-pc-windows-msvc",
    "macOS ARM": "aarch64-apple-darwin",  # macOS 13
}
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
ATTEMPTS = 3
"""Number of attempts when PyPI does not answer. Each is also repeated by ``uv``."""


def resolve(platform: str, python: str) -> tuple[int, str]:
    """Return an exit code as this program's, and what ``uv`` reports."""
    command = [sys.executable, "-m", "uv", "pip", "compile", "pyproject.toml", "--only-binary", ":all:",
               "--python-platform", platform, "--python-version", python, "--no-python-downloads", "--no-header",
               "--no-annotate", *sys.argv[1:]]  # fmt: skip
    for attempt in range(ATTEMPTS):
        time.sleep(20.0 * attempt)
        done = subprocess.run(
            command, cwd=Path(__file__).parents[1], capture_output=True, text=True
        )
        if done.returncode == 0:
            return 0, f"{len(done.stdout.splitlines())} packages"
        if "No solution found" in done.stderr:
            return 1, done.stderr
    return 2, done.stderr


def main() -> int:
    """Print a table of platforms and Python versions, and the reports of those that fail. Return the exit code."""
    cells = [(name, python) for name in PLATFORMS for python in PYTHONS]
    with ThreadPoolExecutor(4) as pool:
        results = dict(
            zip(
                cells,
                pool.map(lambda cell: resolve(PLATFORMS[cell[0]], cell[1]), cells),
                strict=True,
            )
        )
    words = {1: "no wheels", 2: "not checked"}
    print(f"{'':14}" + "".join(f"{python:>14}" for python in PYTHONS))
    for name in PLATFORMS:
        row = (results[name, python] for python in PYTHONS)
        print(f"{name:14}" + "".join(f"{words.get(code, report):>14}" for code, report in row))
    for (name, python), (code, report) in results.items():
        if code:
            print(f"\n{name}, Python {python}: {words[code]}\n{report.strip()}", file=sys.stderr)
    codes = {code for code, _ in results.values()}
    return 1 if 1 in codes else max(codes)


if __name__ == "__main__":
    sys.exit(main())
