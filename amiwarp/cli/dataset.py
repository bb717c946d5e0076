"""``amiwarp dataset``: thousands of simulated recordings from a specification, with a manifest."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli import say
from amiwarp.cli.console import made_again, progress, report
from amiwarp.cli.options import OUTPUT_FOLDER, Common
from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from amiwarp.studies.dataset.making import DatasetPlan, DatasetSummary

EXAMPLE = "amiwarp dataset shapes.toml shapes --dry-run"
AVERAGE_S = 600.0
"""Time over which the speed is averaged [s]; recordings differ in length."""
SHOWN = 5
"""Number of failures that are printed; the manifest lists all."""


def run(
    specification: Annotated[Path, typer.Argument(help="Specification of the data set (.toml).")],
    out: Annotated[Path, typer.Argument(help="Folder of the data set. An existing one is continued."), OUTPUT_FOLDER],
    *,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Only estimate the number of recordings, their size and the time; make none."),
    ] = False,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler. Default: processes of this machine.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Number of local processes. Default: one for each GPU, or for each core without GPU."),
    ] = None,
    common: Common,
) -> None:
    """Make thousands of simulated recordings from a specification, with labels, splits and a manifest.

    Every combination of source, prism, speed, sensor, seed and trajectory is one recording. Finished recordings are
    kept: the same command continues a stopped run. A recording that fails is reported and does not stop the others.
    --device cuda uses all GPUs, and is the default if there is one.
    """
    device = common.device or _default_device()
    if dry_run:
        if scheduler is not None:
            raise AmiwarpError("--dry-run samples on this machine; leave --scheduler out, and give --workers instead")
        from amiwarp.studies.dataset.making import plan_dataset

        with progress("sampling") as advance:
            plan = plan_dataset(specification, out, workers=workers, device=device, progress=advance)
        report(common, asdict(plan) | {"seconds": plan.seconds}, _plan_lines(plan))
        return
    from amiwarp.studies.dataset.making import make_dataset

    try:
        with progress("starting workers", average_s=AVERAGE_S) as advance:
            done = make_dataset(
                specification, out, scheduler=scheduler, workers=workers, device=device, progress=advance
            )
    except KeyboardInterrupt:
        say(f"amiwarp: finished recordings are kept in {out}; run the same command again to continue")
        raise
    report(common, asdict(done) | {"folder": str(out), "device": device}, _lines(done, out))
    if done.failed:
        raise typer.Exit(1)


def _default_device() -> str:
    """Return all GPUs, or the CPU."""
    from amiwarp.kernels.launch import start_quietly
    from amiwarp.studies.cluster import ANY_GPU, gpu_count

    return ANY_GPU if gpu_count(start_quietly()) else "cpu"


def _plan_lines(plan: DatasetPlan) -> list[str]:
    from amiwarp.studies.dataset.making import duration_text

    by = ", ".join(f"{count:,} of {kind}" for kind, count in plan.sources.items())
    lines = [
        f"{plan.recordings:,} recordings ({by}), {plan.missing:,} of them missing",
        "splits: " + ", ".join(f"{name} {count:,}" for name, count in plan.splits.items()),
    ]
    if plan.missing:
        lines += [
            f"about {plan.events:.3g} events and {plan.size_bytes / 1e9:.3g} GB to write",
            f"about {duration_text(plan.seconds)} (± {100 * plan.uncertainty:.0f} %) with {plan.workers} workers on "
            f"{plan.device} once the workers have started, estimated from {plan.samples} samples",
        ]
    return lines


def _lines(done: DatasetSummary, out: Path) -> list[str]:
    lines = [f"failed: {file}: {error}" for file, error in list(done.failed.items())[:SHOWN]]
    if len(done.failed) > SHOWN:
        lines.append(f"... and {len(done.failed) - SHOWN:,} more failures, in {out / 'manifest.json'}")
    lines += made_again(done.damaged)
    if done.not_in_specification:
        lines.append(
            f"{len(done.not_in_specification):,} recordings in {out} are not in the specification, such as "
            f"{done.not_in_specification[0]}; they are kept, and left out of the manifest"
        )
    splits = ", ".join(f"{name} {count:,}" for name, count in done.splits.items())
    lines.append(
        f"{out}: {done.made + done.kept:,} of {done.recordings:,} recordings ({splits}), {done.kept:,} of them kept"
    )
    if done.made:
        lines.append(_speed(done))
    return lines


def _speed(done: DatasetSummary) -> str:
    per_s = done.made / done.seconds
    return (
        f"{done.made:,} made in {done.seconds:,.1f} s: {per_s:.3g} per second, {done.events / done.seconds / 1e6:.3g} "
        f"Mev/s, {done.size_bytes / 1e9:.3g} GB, {done.workers} workers"
    )
