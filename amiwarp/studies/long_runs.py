"""What the commands of long runs on several processes share: options, and lines about failures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

Scheduler = Annotated[
    str | None,
    typer.Option(help="Address of a Dask scheduler. Default: processes of this machine."),
]


LocalWorkers = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Number of local processes. Default: up to four for each GPU, or one for each core without GPU.",
    ),
]


AVERAGE_S = 600.0
"""Time over which the speed is averaged [s]; recordings differ in length."""
SHOWN = 5
"""Number of failures that are printed; a file of the study lists all."""


def failed_lines(failed: Mapping[str, str], listed_in: Path) -> list[str]:
    """Return a line of text for each of the first failures of a study, and the file that lists all."""
    lines = [f"failed: {name}: {error}" for name, error in list(failed.items())[:SHOWN]]
    if len(failed) > SHOWN:
        lines.append(f"... and {len(failed) - SHOWN:,} more failures, in {listed_in}")
    return lines
