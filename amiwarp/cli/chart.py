"""``amiwarp chart``: charts of speed against error on this machine, and settings for a budget."""

from pathlib import Path
from typing import Annotated, Any

import typer

from amiwarp.cli.console import choose_device, progress, report, table
from amiwarp.cli.options import OUTPUT_FOLDER, Common
from amiwarp.errors import AmiwarpError
from amiwarp.io import open_recording
from amiwarp.io.files import check_output
from amiwarp.progress import part
from amiwarp.studies.chart import Charts
from amiwarp.studies.chart.rows import Row, beaten_by, fronts, told_apart

EXAMPLE = "amiwarp chart --out amiwarp-chart --budget-px 0.3"


def run(
    recording: Annotated[
        Path | None, typer.Argument(help="Recording with ground truth. Default: simulated, 10 million events.")
    ] = None,
    *,
    out: Annotated[Path, typer.Option(help="Folder for charts, tables and presets."), OUTPUT_FOLDER] = Path(
        "amiwarp-chart"
    ),
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the simulated scene. Default: a map of the earth.")
    ] = None,
    budget_px: Annotated[
        float | None, typer.Option(min=0.0, help="Error limit (px): choose the fastest settings within it.")
    ] = None,
    budget_ms: Annotated[
        float | None, typer.Option(min=0.0, help="Time limit (ms): choose the most accurate calibration within it.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Measure a few settings once each, as a short trial.")] = False,
    common: Common,
) -> None:
    """Measure speed and error of the settings on a recording with ground truth, and draw both Pareto fronts.

    With a budget, the chosen settings are written to preset_calibration.json and preset_compensation.json. Pass these
    files to calibrate and compensate with --preset.
    """
    if budget_px is not None and budget_ms is not None:
        raise AmiwarpError("--budget-px and --budget-ms are two budgets; give one of them")
    if recording is not None and picture is not None:
        raise AmiwarpError("a recording and --picture both provide the events to measure on; give one of them")
    device = choose_device(common.device)
    from amiwarp.studies.chart import make, simulated

    if budget_px is not None or budget_ms is not None:
        for kind in ("calibration", "compensation"):
            if out.is_dir():
                check_output(out / f"preset_{kind}.json")

    with progress("starting") as advance:
        if recording is not None:
            opened = open_recording(recording)
        else:
            opened = simulated(picture, seed=common.seed, device=device, quick=quick,
                               progress=part(advance, 0.0, 0.0))  # fmt: skip
        charts = make(opened, out, device=device, seed=common.seed, quick=quick,
                      progress=advance)  # fmt: skip
    answers = charts.answer(out, budget_px=budget_px, budget_ms=budget_ms)
    report(common, summary(charts, answers, out) | {"device": device}, lines(charts, answers, out))


def summary(charts: Charts, answers: dict[str, Row | None], out: Path) -> dict[str, Any]:
    """Return the Pareto fronts, the default settings and the chosen settings for JSON.

    The full tables are in the files.
    """

    def fields(row: Row) -> dict[str, Any]:
        return {"label": row.label, "job": row.job, "mev_per_s": row.mev_per_s, "ms": row.seconds * 1e3,
                "error_px": row.error_px, "settings": dict(row.settings)}  # fmt: skip

    rows = {"compensation": charts.compensation, "calibration": charts.calibration}
    return {
        "fronts": {name: {job: [fields(r) for r in chosen] for job, chosen in fronts(all_)}
                   for name, all_ in rows.items()},
        "defaults": {name: [fields(r) for r in all_ if r.default] for name, all_ in rows.items()},
        "answers": {kind: None if row is None else {**fields(row), "file": str(out / f"preset_{kind}.json")}
                    for kind, row in answers.items()},
        "files": {name: str(path) for name, path in charts.files.items()},
        "notes": list(charts.notes),
    }  # fmt: skip


def lines(charts: Charts, answers: dict[str, Row | None], out: Path) -> list[Any]:
    """Return the results as tables and lines of text."""
    shown: list[Any] = []
    for rows in (charts.compensation, charts.calibration):
        for job, chosen in fronts(rows):
            default = [r for r in rows if r.default and r.job == job and r not in chosen]
            listed = [(_name(r), *_speed(r)) for r in [*told_apart(chosen), *default]]
            shown += [table(listed, f"front, {job}", "speed", "error"), ""]
            shown += [f"faster or more accurate than the default: {', '.join(b.label for b in better)}"
                      for r in rows if r.default and r.job == job and (better := beaten_by(r, rows))]  # fmt: skip
    shown += [f"note: {note}" for note in charts.notes]
    for kind, row in answers.items():
        if row is None:
            shown.append(f"{kind}: no measured setting is within the budget; see the front above")
        else:
            speed, error = _speed(row)
            file = out / f"preset_{kind}.json"
            shown.append(
                f"{kind} within the budget: {row.label}, {speed}, {error} measured; use it with --preset {file}"
            )
    return [*shown, *(f"{name}: {path}" for name, path in charts.files.items())]


def _name(row: Row) -> str:
    return f"{row.label} (default)" if row.default and row.label != "default" else row.label


def _speed(row: Row) -> tuple[str, str]:
    speed = f"{row.seconds * 1e3:,.0f} ms" if row.chart == "calibration" else f"{row.mev_per_s:.3g} Mev/s"
    return speed, f"{row.error_px:.3g} px"
