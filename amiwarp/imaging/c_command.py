"""Command ``export-c``: sums in phase as C for a microcontroller."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from amiwarp.cli import common as cli


def run_export_c(
    out: Annotated[Path, typer.Argument(help="Folder to write."), cli.OUTPUT_FOLDER],
    *,
    size: Annotated[
        str,
        typer.Option(help="Size of the region whose events are summed (px).", metavar="WxH"),
    ] = "32x32",
    harmonics: Annotated[
        int,
        typer.Option(
            help="Number of harmonics of the angle: 1.5 for each px of the orbit's radius."
        ),
    ] = 9,
    bins: Annotated[int, typer.Option(help="Number of bins of a turn.")] = 64,
    off_ratio: Annotated[
        float,
        typer.Option(
            help="OFF threshold divided by the ON threshold, as 'amiwarp phase --json' gives it."
        ),
    ] = 1.0,
    common: cli.Common,
) -> None:
    """Write the sums in phase as C for a microcontroller, with a test of its integers.

    The C sums the events of a region of the sensor. PhaseSums.from_integers reads what it summed. --seed chooses the
    random events of the test.
    """
    from amiwarp.imaging.c_sums import NAMES, CSums, write_c_sums

    cli.choose_device(common.device)
    width, height = cli.parse_size(size, example="32x32")
    settings = CSums(width, height, harmonics, bins, off_ratio)
    write_c_sums(out, settings, seed=common.seed)
    data = {
        "folder": str(out),
        "files": list(NAMES),
        "width": width,
        "height": height,
        "harmonics": harmonics,
        "bins": bins,
        "off_ratio": off_ratio,
        "ram_bytes": settings.ram_bytes,
        "table_bytes": settings.rows.nbytes,
    }
    line = (
        f"{out}: {width}x{height} px, {harmonics} harmonics, {bins} bins: {settings.ram_bytes:,} bytes of RAM, tables "
        f"of {settings.rows.nbytes:,} bytes of flash"
    )
    cli.report(common, data, [line])
