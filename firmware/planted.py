"""Build the core with each fault of ``planted.toml`` and check that the conformance suite catches it.

``python planted.py [TEXT]`` runs all faults, or those whose description contains the text; it ends with status 1 if one
was not caught.
"""

from __future__ import annotations

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
COMPILE = ("gcc", "-std=gnu11", "-O1", "-shared", "-fPIC", "-Icore", "-o", "libboard.so", "native/board.c")


def planted(text: str, fault: dict[str, Any]) -> str:
    """Return the text of a file with a fault; raise ValueError unless each replaced text is there exactly once."""
    for before, after in ((fault["before"], fault["after"]), *fault.get("also", ())):
        if text.count(before) != 1:
            raise ValueError(f"{fault['file']}: {before!r} is there {text.count(before)} times; correct planted.toml")
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


def main() -> int:
    """Run the faults and print what failed for each."""
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    missed = 0
    chosen = [fault for fault in FAULTS if wanted in fault["wrong"]]
    for fault in chosen:
        with tempfile.TemporaryDirectory() as folder:
            found = failures(fault, Path(folder))
        caught = fault["caught"] in found
        missed += not caught
        print(
            f"{'caught' if caught else 'MISSED'}: {fault['wrong']}: {', '.join(found) or 'all checks pass'}", flush=True
        )
    print(f"{len(chosen) - missed} of {len(chosen)} planted faults were caught")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
