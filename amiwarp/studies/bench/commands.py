"""Command ``bench``: AMI-Bench, a benchmark whose recordings anyone makes again."""

from __future__ import annotations

import enum
import json
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode, optional_module
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import write_text
from amiwarp.tasks import part

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.studies.bench.baselines import Baseline, View
    from amiwarp.studies.bench.recordings import Made
    from amiwarp.studies.bench.scoring import Scored
    from amiwarp.studies.bench.specification import Entry

NETWORK = "network"
"""Name of the baseline of the network in the package."""
MAKING = 0.2
ANSWERING = 0.95
"""Finished shares of the whole after the recordings and after the answers."""
SHOWN_FILES = 5
"""Largest number of files with other checksums that are named."""


class Action(enum.StrEnum):
    """Action of ``amiwarp bench``."""

    MAKE = "make"
    TRUTH = "truth"
    RUN = "run"
    SCORE = "score"


def run_bench(
    action: Annotated[
        Action | None,
        typer.Argument(
            help="make: make the recordings; truth: make their ground truth; run: answer them by a baseline; score: "
            "score submissions. Default: all of these, with all baselines.",
            show_default=False,
        ),
    ] = None,
    target: Annotated[
        list[Path] | None,
        typer.Argument(
            help="For make and truth: folder to write. For run: name of the baseline: paper, ours, phase, plain, "
            "frames or network. For score: folders of submissions.",
            show_default=False,
        ),
        cli.NO_FILE,
    ] = None,
    *,
    small: Annotated[
        bool,
        typer.Option(
            "--small/--full", help="The set of 10 small recordings, or the full set of 100."
        ),
    ] = True,
    only: Annotated[
        str | None,
        typer.Option(help="Recordings of the set to use. Default: all.", metavar="NAME,..."),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(help="Without an action: baselines to run. Default: all.", metavar="NAME,..."),
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="For run: folder of the recordings, from 'bench make'.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="For score: folder of the ground truth, from 'bench truth'.")
    ] = None,
    out: Annotated[
        Path,
        typer.Option(help="Folder of the submission (run), or of all files (without an action)."),
        cli.OUTPUT_FOLDER,
    ] = Path("amiwarp-bench"),
    common: cli.Common,
) -> None:
    """Make the recordings of AMI-Bench, answer them by baselines, and score submissions.

    Without an action, all of this is done, and the table is compared with the table in the package: the exit code is 1
    if a score differs by more than its tolerance. Recordings that are there are kept, and their checksums compared.
    """
    from amiwarp.studies.bench.specification import chosen_entries

    entries = chosen_entries("small" if small else "full", _names(only))
    targets = target or []
    _check_options(action, targets, methods, data, truth)
    device = cli.choose_device(common.device)
    if action is None:
        _run_all(entries, _names(methods), out, device, common)
    elif action is Action.MAKE:
        _make(targets[0], entries, device, common)
    elif action is Action.TRUTH:
        _make_truth(targets[0], entries, device, common)
    elif action is Action.RUN:
        assert data is not None
        _answer(str(targets[0]), data, out, entries, device, common)
    else:
        assert truth is not None
        _score(targets, truth, entries, common)


def _names(text: str | None) -> tuple[str, ...]:
    """Return the names in an option."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


def _check_options(
    action: Action | None,
    targets: Sequence[Path],
    methods: str | None,
    data: Path | None,
    truth: Path | None,
) -> None:
    """Raise :class:`AmiwarpError` if an option is missing, or does not belong to the action."""
    command = "amiwarp bench" if action is None else f"amiwarp bench {action}"
    options = {
        "--methods": (methods, None),
        "--data": (data, Action.RUN),
        "--truth": (truth, Action.SCORE),
    }
    for option, (value, owner) in options.items():
        if value is None and action is owner and owner is not None:
            raise AmiwarpError(f"'{command}' needs {option}; give it", ErrorCode.OPTIONS)
        if value is not None and action is not owner:
            raise AmiwarpError(
                f"{option} does not apply to '{command}'; leave it out", ErrorCode.OPTIONS
            )
    if action is None:
        return
    wanted = {Action.RUN: "the name of a baseline", Action.SCORE: "folders of submissions"}
    if not targets or (len(targets) > 1 and action is not Action.SCORE):
        raise AmiwarpError(
            f"'{command}' has {len(targets)} names after it; give {wanted.get(action, 'a folder')}",
            ErrorCode.OPTIONS,
        )


def _make(folder: Path, entries: Sequence[Entry], device: str, common: cli.Common) -> None:
    from amiwarp.studies.bench.recordings import make_recordings

    with cli.progress("starting") as advance:
        made = make_recordings(folder, entries, device, advance)
    data = asdict(made) | {"folder": str(folder), "device": device}
    cli.report(common, data, [f"{folder}: {len(entries)} recordings", *_made_lines(made)])


def _made_lines(made: Made) -> list[str]:
    """Return what was made, and how its checksums compare with those in the package."""
    lines = [f"{len(made.made)} made, {len(made.kept)} kept"]
    if made.unknown:
        lines.append(f"{len(made.unknown)} files without a checksum in the package: not compared")
    if not made.different:
        equal = f"{len(made.equal)} files are equal to the package's, by their checksums"
        return [*lines, equal] if made.equal else lines
    shown = ", ".join(made.different[:SHOWN_FILES])
    more = len(made.different) - SHOWN_FILES
    rest = f" and {more} more" if more > 0 else ""
    return [
        *lines,
        f"{len(made.different)} files have other events than in the package: {shown}{rest}",
    ]


def _make_truth(folder: Path, entries: Sequence[Entry], device: str, common: cli.Common) -> None:
    from amiwarp.studies.bench.truth import make_truth

    with cli.progress("starting") as advance:
        make_truth(folder, entries, device, advance)
    data = {"folder": str(folder), "recordings": len(entries), "device": device}
    cli.report(common, data, [f"{folder}: ground truth of {len(entries)} recordings"])


def _answer(
    name: str,
    recordings: Path,
    out: Path,
    entries: Sequence[Entry],
    device: str,
    common: cli.Common,
) -> None:
    from amiwarp.studies.bench.baselines import run_baselines

    chosen = _baselines((name,))
    _check_libraries(chosen)
    with cli.progress("starting") as advance:
        run_baselines(chosen, recordings, {name: out}, entries, device, advance)
    data = {"folder": str(out), "baseline": name, "recordings": len(entries), "device": device}
    cli.report(common, data, [f"{out}: answers of {name} about {len(entries)} recordings"])


def _baselines(names: Sequence[str]) -> dict[str, Baseline]:
    """Return baselines by name; all without names. Raises :class:`AmiwarpError` for an unknown name."""
    from amiwarp.studies.bench.baselines import BASELINES, Baseline

    about = "The network in the package, trained on simulated quarter turns, with the calibration of 'ours'."
    known = {**BASELINES, NETWORK: Baseline(about, {"picture": _network_picture})}
    for name in names:
        if name not in known:
            raise AmiwarpError(
                f"baseline {name!r} is unknown; choose among {', '.join(known)}", ErrorCode.OPTIONS
            )
    return {name: baseline for name, baseline in known.items() if not names or name in names}


def _check_libraries(chosen: Collection[str]) -> None:
    """Raise :class:`AmiwarpError` before the work if a library is missing that baselines need."""
    who = "the baselines of 'amiwarp bench' need"
    for library in ("cv2", "sklearn", "skimage"):
        optional_module(library, "evaluate", f"{who} {library}")
    if NETWORK in chosen:
        optional_module(
            "torch", "torch", "the baseline network needs PyTorch; choose others with --methods"
        )


def _network_picture(view: View) -> NDArray[Any]:
    """Return the network's picture of the quarter turn about the moment."""
    import numpy as np

    from amiwarp.learning.networks import Network
    from amiwarp.studies.bench.baselines import default_calibration

    calibration = default_calibration(view)
    start_us, end_us = view.around(0.25)
    picture = Network.quarter_turn(view.device)(
        view.prism.events.between(start_us, end_us),
        view.entry.camera.width,
        view.entry.camera.height,
        t_start=start_us,
        t_end=end_us,
        model=calibration.model,
        encoder=view.encoder(calibration),
    )
    return np.asarray(picture)[0]


def _score(
    folders: Sequence[Path], truth: Path, entries: Sequence[Entry], common: cli.Common
) -> None:
    from amiwarp.studies.bench.scoring import score_submissions, table_data

    found = score_submissions(folders, truth, entries)
    cli.report(common, table_data(found), [_table(found)])


def _table(found: Sequence[Scored]) -> Any:
    from amiwarp.studies.bench.scoring import HEADINGS, table_rows

    return cli.table(table_rows(found), *HEADINGS)


def _run_all(
    entries: Sequence[Entry], names: Sequence[str], out: Path, device: str, common: cli.Common
) -> None:
    """Make the recordings and their truth, run the baselines, score them, and compare the table."""
    from amiwarp.studies.bench.baselines import run_baselines
    from amiwarp.studies.bench.recordings import make_recordings
    from amiwarp.studies.bench.scoring import (
        differences,
        not_compared,
        score_submissions,
        stated_table,
        table_data,
    )
    from amiwarp.studies.bench.truth import make_truth
    from amiwarp.studies.machine import machine, versions

    chosen = _baselines(names)
    _check_libraries(chosen)
    for folder in (out, out / "submissions"):
        make_folder(folder)
    folders = {name: out / "submissions" / name for name in chosen}
    with cli.progress("starting") as advance:
        made = make_recordings(out / "recordings", entries, device, part(advance, 0.0, MAKING))
        make_truth(out / "truth", entries, device)
        answering = part(advance, MAKING, ANSWERING)
        run_baselines(chosen, out / "recordings", folders, entries, device, answering)
        advance("scoring", ANSWERING)
        found = score_submissions(list(folders.values()), out / "truth", entries)
    table = table_data(found) | {
        "machine": machine(device),
        "versions": versions(("warp-lang", "numpy", "scipy", "opencv-python-headless", "torch")),
    }
    write_text(out / "table.json", json.dumps(table, indent=1) + "\n")
    lines: list[Any] = [*_made_lines(made), _table(found)]
    other = None
    if entries[0].set_name == "small":
        stated = stated_table()
        other = differences(found, stated)
        left_out = not_compared(found, stated)
        if left_out:
            lines.append(f"the table in the package lacks, so not compared: {', '.join(left_out)}")
        if other:
            lines += ["differs from the table in the package:", *other]
        else:
            lines.append("equal to the table in the package within its tolerances")
    else:
        lines.append("the package has no table of the full set to compare with")
    lines.append(f"table: {out / 'table.json'}")
    cli.report(common, table | asdict(made) | {"differences": other, "device": device}, lines)
    if other:
        raise typer.Exit(1)
