"""Build the firmware with each fault of ``planted.toml`` and check that the conformance suite, or a test, catches it.

``python planted.py [TEXT]`` runs all faults, or those whose description contains the text; it ends with status 1 if one
was not caught.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import boards

HERE = Path(__file__).parent
FAULTS: list[dict[str, Any]] = tomllib.loads((HERE / "planted.toml").read_text())["fault"]
VERDICTS = {True: "caught", False: "MISSED", None: "left out"}
COMPILE = (
    "gcc",
    "-std=gnu11",
    "-O1",
    "-shared",
    "-fPIC",
    "-Icore",
    "-o",
    "libboard.so",
    "native/board.c",
)


def planted(text: str, fault: dict[str, Any]) -> str:
    """Return the text of a file with a fault; raise ValueError unless each replaced text is there exactly once."""
    for before, after in ((fault["before"], fault["after"]), *fault.get("also", ())):
        if text.count(before) != 1:
            raise ValueError(
                f"{fault['file']}: {before!r} is there {text.count(before)} times; correct planted.toml"
            )
        text = text.replace(before, after)
    return text


def built(fault: dict[str, Any], folder: Path) -> Path:
    """Build the core with a fault in a folder, and return the library."""
    for part in ("core", "native"):
        shutil.copytree(HERE / part, folder / part)
    file = folder / fault["file"]
    file.write_text(planted(file.read_text(), fault))
    sources = sorted(str(path.relative_to(folder)) for path in (folder / "core").glob("*.c"))
    subprocess.run([*COMPILE, *sources, "-lm"], cwd=folder, check=True, capture_output=True)
    return folder / "libboard.so"


def failures(fault: dict[str, Any], folder: Path, rpm: float = 240.0) -> list[str]:
    """Build the core with a fault in a folder, and return the names of the checks that fail."""
    from amiwarp.live.link.conformance import check_controller

    board = boards.NativeBoard(library=built(fault, folder))
    return [c.name for c in check_controller(boards.SimulatedWire(board), rpm) if c.passed is False]


def fails(fault: dict[str, Any], folder: Path) -> bool | None:
    """Copy the firmware with a fault to a folder, and return whether the fault's test fails; None if it was skipped.

    Raises RuntimeError if there is no such test.
    """
    copy = folder / "firmware"
    shutil.copytree(
        HERE, copy, ignore=shutil.ignore_patterns("build", "node_modules", "__pycache__")
    )
    modules = HERE / "simulator" / "node_modules"
    if modules.is_dir():
        (copy / "simulator" / "node_modules").symlink_to(modules)
    file = copy / fault["file"]
    file.write_text(planted(file.read_text(), fault))
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-n0",
        "-p",
        "no:cacheprovider",
        f"tests/firmware/{fault['test']}",
    ]
    environment = os.environ | {"AMIWARP_FIRMWARE": str(copy)}
    done = subprocess.run(
        command, cwd=HERE.parent, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{fault['test']}: {done.stdout[-500:]}{done.stderr[-500:]}")
    return None if done.returncode == 0 and "skipped" in done.stdout else done.returncode == 1


def caught(fault: dict[str, Any], folder: Path) -> tuple[bool | None, str]:
    """Return whether a fault is caught, and by what: checks of the suite, or a test; None: its tools are missing."""
    if "test" in fault:
        return fails(fault, folder), str(fault["test"])
    found = failures(fault, folder)
    return fault["caught"] in found, ", ".join(found) or "all checks pass"


def main() -> int:
    """Run the faults and print what failed for each."""
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    results = []
    for fault in FAULTS:
        if wanted not in fault["wrong"]:
            continue
        with tempfile.TemporaryDirectory() as folder:
            found, what = caught(fault, Path(folder))
        results.append(found)
        print(f"{VERDICTS[found]}: {fault['wrong']}: {what}", flush=True)
    tried = len(results) - results.count(None)
    left_out = (
        f"; {results.count(None)} left out, as their tools are missing" if None in results else ""
    )
    print(f"{results.count(True)} of {tried} planted faults were caught{left_out}")
    return int(False in results)


if __name__ == "__main__":
    sys.exit(main())
