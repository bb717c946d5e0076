"""Commands ``dataset`` and ``export``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.studies.long_runs import AVERAGE_S, LocalWorkers, Scheduler, failed_lines

SHOWN_CLASSES = 6
"""Largest number of classes whose splits are printed."""

if TYPE_CHECKING:
    from amiwarp.learning.dataset.making import DatasetSummary
    from amiwarp.learning.dataset.plan import DatasetPlan


def run_dataset(
    specification: Annotated[Path, typer.Argument(help="Specification of the data set (.toml).")],
    out: Annotated[
        Path,
        typer.Argument(help="Folder of the data set. An existing one is continued."),
        cli.OUTPUT_FOLDER,
    ],
    *,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Only estimate the number of recordings, their size and the time; make none.",
        ),
    ] = False,
    scheduler: Scheduler = None,
    workers: LocalWorkers = None,
    common: cli.Common,
) -> None:
    """Make thousands of simulated recordings from a specification, with labels, splits and a manifest.

    Every combination of source, prism, speed, sensor, seed and trajectory is one recording. Finished recordings are
    kept: the same command continues a stopped run. A recording that fails is reported and does not stop the others.
    --device cuda uses all GPUs, and is the default if there is one.
    """
    from amiwarp.learning.dataset import making
    from amiwarp.learning.dataset.plan import plan_dataset

    device = common.device or _default_device()
    if dry_run:
        if scheduler is not None:
            raise AmiwarpError(
                "--dry-run samples on this machine; leave --scheduler out, and give --workers instead",
                ErrorCode.OPTIONS,
            )
        with cli.progress("sampling") as advance:
            plan = plan_dataset(
                specification, out, workers=workers, device=device, progress=advance
            )
        lines = [
            *(f"sample failed: {file}: {error}" for file, error in plan.failed.items()),
            *_plan_lines(plan),
        ]
        cli.report(common, asdict(plan) | {"seconds": plan.seconds}, lines)
        return
    try:
        with cli.progress("starting workers", average_s=AVERAGE_S) as advance:
            done = making.make_dataset(
                specification,
                out,
                scheduler=scheduler,
                workers=workers,
                device=device,
                progress=advance,
            )
    except KeyboardInterrupt:
        say(
            f"amiwarp: finished recordings are kept in {out}; run the same command again to continue"
        )
        raise
    cli.report(
        common, asdict(done) | {"folder": str(out), "device": device}, _dataset_lines(done, out)
    )
    if done.failed:
        raise typer.Exit(1)


def _default_device() -> str:
    """Return all GPUs, or the CPU."""
    from amiwarp.kernels.quiet_start import start_quietly
    from amiwarp.studies.cluster import ANY_GPU, gpu_count

    return ANY_GPU if gpu_count(start_quietly()) else "cpu"


def _plan_lines(plan: DatasetPlan) -> list[str]:
    from amiwarp.learning.dataset.making import duration_text

    by = ", ".join(f"{count:,} of {kind}" for kind, count in plan.sources.items())
    lines = [
        f"{plan.recordings:,} recordings ({by}), {plan.missing:,} of them missing",
        "splits: " + ", ".join(f"{name} {count:,}" for name, count in plan.splits.items()),
        *_source_lines(plan.sources_of_splits),
        *_drawn_lines(plan.drawn),
    ]
    if plan.missing:
        spread = "spread unknown: a kind of source has only one sample"
        if plan.uncertainty is not None:
            spread = f"± {100 * plan.uncertainty:.0f} %"
        lines += [
            f"about {plan.events:.3g} events and {plan.size_bytes / 1e9:.3g} GB to write",
            f"about {duration_text(plan.seconds)} ({spread}) with {plan.workers} workers on "
            f"{plan.device} once the workers have started, estimated from {plan.samples} samples",
        ]
    return lines


def _source_lines(sources_of_splits: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return how many different sources each split has, and by which rule they were divided."""
    total = Counter[str]()
    for splits in sources_of_splits.values():
        total.update(splits)
    how = "the split of each is drawn (stratify = false)"
    if "" not in sources_of_splits:
        strata = list(sources_of_splits)[:SHOWN_CLASSES]
        parts = []
        for stratum in strata:
            counts = sources_of_splits[stratum]
            parts.append(f"{stratum}: " + ", ".join(f"{name} {counts[name]:,}" for name in counts))
        more = len(sources_of_splits) - len(strata)
        if more:
            parts.append(f"{more:,} more classes")
        how = f"divided by {'; '.join(parts)} (the field stratify gives another rule)"
    sources = ", ".join(f"{name} {count:,}" for name, count in total.items())
    return [f"sources: {sources}; {how}"]


def _drawn_lines(drawn: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return the range of each randomised setting in the recordings."""
    parts = []
    for name, found in drawn.items():
        parts.append(
            f"{name} {found['least']:.4g} .. {found['largest']:.4g}, median {found['median']:.4g}"
        )
    return [f"drawn: {'; '.join(parts)}"] if parts else []


def _dataset_lines(done: DatasetSummary, out: Path) -> list[str]:
    lines = failed_lines(done.failed, out / "manifest.json")
    lines += cli.made_again(done.damaged)
    if done.not_in_specification:
        lines.append(
            f"{len(done.not_in_specification):,} recordings in {out} are not in the specification, such as "
            f"{done.not_in_specification[0]}; they are kept, and left out of the manifest"
        )
    splits = ", ".join(f"{name} {count:,}" for name, count in done.splits.items())
    lines.append(
        f"{out}: {done.made + done.kept:,} of {done.recordings:,} recordings ({splits}), {done.kept:,} of them kept"
    )
    lines += _source_lines(done.sources_of_splits)
    lines += _drawn_lines(done.drawn)
    if done.made:
        lines.append(_dataset_speed(done))
    return lines


def _dataset_speed(done: DatasetSummary) -> str:
    per_s = done.made / done.seconds
    return (
        f"{done.made:,} made in {done.seconds:,.1f} s: {per_s:.3g} per second, {done.events / done.seconds / 1e6:.3g} "
        f"Mev/s, {done.size_bytes / 1e9:.3g} GB, {done.workers} workers"
    )


# ``amiwarp export``: a data set in the layouts of other libraries.


def run_export(
    dataset: Annotated[
        Path, typer.Argument(help="Folder of the data set, which 'amiwarp dataset' made.")
    ],
    out: Annotated[Path, typer.Argument(help="Folder to write."), cli.OUTPUT_FOLDER],
    *,
    to: Annotated[
        str,
        typer.Option(
            help="Layout: webdataset (tar files) or parquet (a folder for Hugging Face's datasets)."
        ),
    ],
    shard_mb: Annotated[
        float,
        typer.Option(
            min=0.001, help="Size at which the next file begins, before compression (MB)."
        ),
    ] = 256.0,
    common: cli.Common,
) -> None:
    """Export a data set to tar files for WebDataset, or to Parquet files for Hugging Face's datasets.

    Events and labels are exported. Encoder, camera, prism and ground truth are left out. With --force, the files of an
    earlier export in the folder are replaced.
    """
    from amiwarp.learning.dataset.export import export_dataset

    with cli.progress("reading the manifest") as advance:
        done = export_dataset(dataset, out, to, shard_mb=shard_mb, progress=advance)
    splits = ", ".join(f"{name} {count:,}" for name, count in done.splits.items())
    line = (
        f"{out}: {sum(done.splits.values()):,} recordings ({splits}) with {done.events:,} events in "
        f"{len(done.files):,} files, {done.size_bytes / 1e9:.3g} GB, {done.seconds:.1f} s"
    )
    cli.report(common, asdict(done) | {"folder": str(out)}, [line])
