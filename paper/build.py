"""Build the technical report as a PDF file from the committed results.

    python -m paper.build [--out FOLDER] [--pages]

Gathers the values, tables and figures of all subjects in ``FOLDER`` (default ``paper/_build``), copies the text there,
and compiles it with Typst to ``report.pdf``. ``--pages`` also writes each page as a picture.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from paper.drawing import look, save
from paper.sources import ROOT
from paper.subjects import (
    calibration,
    claims,
    conditions,
    optics,
    origins,
    phase,
    speed,
    trust,
    whole_turn,
)

HERE = Path(__file__).parent
SUBJECTS = (conditions, optics, calibration, whole_turn, phase, claims, speed, trust, origins)
SKETCH = ROOT / "docs" / "images" / "prism_sketch.svg"


def gathered() -> dict[str, Any]:
    """Return the values and tables of all subjects."""
    values = {}
    tables = {}
    for subject in SUBJECTS:
        values |= subject.values()
        tables |= {name: asdict(table) for name, table in subject.tables().items()}
    return {"values": values, "tables": tables}


def prepare(folder: Path) -> Path:
    """Write all that Typst reads into a folder, and return the main file."""
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    with look():
        for subject in SUBJECTS:
            for name, figure in subject.figures().items():
                save(figure, folder / "figures" / f"{name}.svg")
    shutil.copy(SKETCH, folder / "figures" / "sketch.svg")
    shutil.copytree(HERE / "sections", folder / "sections", dirs_exist_ok=True)
    for name in ("report.typ", "style.typ", "references.bib"):
        shutil.copy(HERE / name, folder / name)
    data = json.dumps(gathered(), ensure_ascii=False, indent=1)
    (folder / "data.json").write_text(data, encoding="utf-8")
    return folder / "report.typ"


def build(folder: Path, *, pages: bool = False) -> Path:
    """Build the report in a folder, and return the path of the PDF file."""
    import typst

    source = prepare(folder)
    compiler = typst.Compiler(source, root=folder, ignore_system_fonts=True)
    compiler.compile(output=folder / "report.pdf", format="pdf")
    if pages:
        compiler.compile(output=folder / "page-{0p}.png", format="png", ppi=110.0)
    return folder / "report.pdf"


def main() -> int:
    """Build the report as the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=HERE / "_build")
    parser.add_argument("--pages", action="store_true", help="also write a picture of each page")
    options = parser.parse_args()
    try:
        path = build(options.out, pages=options.pages)
    except ModuleNotFoundError as error:
        if error.name != "typst":
            raise
        print("The report needs Typst: pip install '.[paper]'", file=sys.stderr)
        return 1
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
