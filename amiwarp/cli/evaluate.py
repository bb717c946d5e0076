"""``amiwarp evaluate``: the AMI-EV against a plain event camera, as its paper evaluates it, on simulated worlds."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli import say
from amiwarp.cli.console import choose_device, made_again, progress, report
from amiwarp.cli.options import OUTPUT_FOLDER, Common
from amiwarp.studies.cluster import ANY_GPU

if TYPE_CHECKING:
    from amiwarp.studies.evaluate.evaluation import EvaluationSummary

EXAMPLE = "amiwarp evaluate --out evaluation --only texture"
AVERAGE_S = 600.0
"""Time over which the speed is averaged [s]; recordings differ in length."""


def run(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for the report. An existing one is continued."), OUTPUT_FOLDER
    ] = Path("amiwarp-evaluation"),
    only: Annotated[
        str | None,
        typer.Option(
            help="Evaluations to run, such as texture,flow. Default: with --full all, with --quick the short ones.",
            metavar="NAME,...",
        ),
    ] = None,
    full: Annotated[
        bool,
        typer.Option(
            "--full/--quick",
            help="Full study: 320x240, ten seeds, all values; or quick: 240x180, two seeds, within ten minutes on two "
            "cores.",
        ),
    ] = False,
    seeds: Annotated[int | None, typer.Option(min=1, help="Number of seeds instead.")] = None,
    recording: Annotated[
        list[Path] | None,
        typer.Option(
            help="Recording of your own, for the evaluations that need no ground truth: texture and event rate. Can be "
            "repeated. Simulated worlds are then left out, unless --only is given."
        ),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler. Default: processes of this machine.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Number of local processes. Default: one for each GPU, or for each core without GPU."),
    ] = None,
    common: Common,
) -> None:
    """Check the AMI-EV paper's results: compare with a plain event camera on simulated worlds, and write a report.

    The report is OUT/report.html, with its tables and figures next to it. Finished cells are saved in OUT/cells: the
    same command continues a stopped run. --device cuda uses all GPUs.
    """
    device = common.device if common.device == ANY_GPU else choose_device(common.device)
    from amiwarp.studies.evaluate.evaluation import evaluate

    names = tuple(name.strip() for name in only.split(",") if name.strip()) if only else ()
    try:
        with progress("starting workers", average_s=AVERAGE_S) as advance:
            done = evaluate(
                out, only=names, full=full, seeds=seeds, recordings=recording or (), scheduler=scheduler,
                workers=workers, device=device, seed=common.seed, progress=advance,
            )  # fmt: skip
    except KeyboardInterrupt:
        say(f"amiwarp: finished cells are kept in {out}; run the same command again to continue")
        raise
    files = {name: str(path) for name, path in done.files.items()}
    report(common, asdict(done) | {"files": files, "device": device}, _lines(done))


def _lines(done: EvaluationSummary) -> list[str]:
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in done.verdicts.items())
    lines = [f"claims: {verdicts or 'none'}"]
    if done.failed:
        lines.append(f"{done.failed:,} cells failed; the report says why")
    lines += made_again(done.damaged)
    lines += [f"{name}: {path}" for name, path in done.files.items()]
    return [
        *lines,
        f"{done.new_cells:,} of {done.cells:,} cells in {done.seconds:,.0f} s, {done.processor_seconds:,.0f} s of "
        "processor time",
    ]
