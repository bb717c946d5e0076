"""Command ``evaluate``: the AMI-EV against a plain event camera, as its paper evaluates it, on simulated worlds."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.studies.long_runs import AVERAGE_S, LocalWorkers, Scheduler, failed_lines

if TYPE_CHECKING:
    from amiwarp.studies.evaluate.evaluation import EvaluationSummary


def run_evaluate(
    *,
    out: Annotated[
        Path,
        typer.Option(help="Folder for the report. An existing one is continued."),
        cli.OUTPUT_FOLDER,
    ] = Path("amiwarp-evaluation"),
    only: Annotated[
        str | None,
        typer.Option(
            help="Evaluations to run, such as texture,flow. Default: all.",
            metavar="NAME,...",
        ),
    ] = None,
    full: Annotated[
        bool,
        typer.Option(
            "--full/--quick",
            help="Full study: 320x240, ten seeds, all values; or quick: 240x180, two seeds, a sample of each.",
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
    scheduler: Scheduler = None,
    workers: LocalWorkers = None,
    common: cli.Common,
) -> None:
    """Check the AMI-EV paper's results: compare with a plain event camera on simulated worlds, and write a report.

    The report is OUT/report.html, with its tables and figures next to it. Finished cells are saved in OUT/cells: the
    same command continues a stopped run. A cell that fails is reported, does not stop the others, and is run again by
    the same command. --device cuda uses all GPUs.
    """
    from amiwarp.studies.cluster import ANY_GPU
    from amiwarp.studies.evaluate.evaluation import evaluate

    names = [name.strip() for name in (only or "").split(",") if name.strip()]
    if only is not None and not names:
        raise AmiwarpError(
            f"--only is {only!r}, which names no evaluation; give names such as texture,flow, or leave --only out",
            ErrorCode.OPTIONS,
        )

    device = ANY_GPU
    if common.device != ANY_GPU:
        device = cli.choose_device(common.device)
    elif scheduler is None:
        cli.choose_device("cuda:0")  # refuses a machine without a GPU

    try:
        with cli.progress("starting workers", average_s=AVERAGE_S) as advance:
            done = evaluate(
                out,
                only=tuple(names),
                full=full,
                seeds=seeds,
                recordings=recording or (),
                scheduler=scheduler,
                workers=workers,
                device=device,
                seed=common.seed,
                progress=advance,
            )
    except KeyboardInterrupt:
        say(f"amiwarp: finished cells are kept in {out}; run the same command again to continue")
        raise
    files = {name: str(path) for name, path in done.files.items()}
    cli.report(common, asdict(done) | {"files": files, "device": device}, _evaluate_lines(done))
    if done.failed == done.cells:
        raise typer.Exit(1)


def _evaluate_lines(done: EvaluationSummary) -> list[str]:
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in done.verdicts.items())
    lines = [f"claims: {verdicts or 'none'}"]
    lines += failed_lines(done.failures, done.files["report"])
    lines += cli.made_again(done.damaged)
    lines += [f"{name}: {path}" for name, path in done.files.items()]
    last = (
        f"{done.new_cells:,} of {done.cells:,} cells in {done.seconds:,.0f} s, {done.processor_seconds:,.0f} s of "
        "processor time"
    )
    if done.failed:
        last += f"; {done.failed:,} failed: run the same command again to try them again"
    return [*lines, last]
