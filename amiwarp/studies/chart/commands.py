"""Command ``chart``: charts of speed against error on this machine, and settings for a budget."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io import open_recording
from amiwarp.io.outputs import check_output
from amiwarp.studies.long_runs import failed_lines
from amiwarp.tasks import part

if TYPE_CHECKING:
    from amiwarp.studies.chart.charts import Charts
    from amiwarp.studies.chart.rows import Row


def run_chart(
    recording: Annotated[
        Path | None,
        typer.Argument(help="Recording with ground truth. Default: simulated, 10 million events."),
    ] = None,
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for charts, tables and presets."), cli.OUTPUT_FOLDER
    ] = Path("amiwarp-chart"),
    picture: Annotated[
        Path | None,
        typer.Option(help="Picture of the simulated scene. Default: a map of the earth."),
    ] = None,
    budget_px: Annotated[
        float | None,
        typer.Option(min=0.0, help="Error limit (px): choose the fastest settings within it."),
    ] = None,
    budget_ms: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Time limit (ms): choose the most accurate calibration within it."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Measure a few settings once each, as a short trial.")
    ] = False,
    common: cli.Common,
) -> None:
    """Measure speed and error of the settings on a recording with ground truth, and draw both Pareto fronts.

    A setting that fails is reported and does not stop the others. With a budget, the chosen settings are written to
    preset_calibration.json and preset_compensation.json. Pass these files to calibrate and compensate with --preset.
    """
    if budget_px is not None and budget_ms is not None:
        raise AmiwarpError(
            "--budget-px and --budget-ms are two budgets; give one of them", ErrorCode.OPTIONS
        )
    if recording is not None and picture is not None:
        raise AmiwarpError(
            "a recording and --picture both provide the events to measure on; give one of them",
            ErrorCode.OPTIONS,
        )
    device = cli.choose_device(common.device)
    from amiwarp.studies.chart.charts import make, simulated

    if budget_px is not None or budget_ms is not None:
        for kind in ("calibration", "compensation"):
            if out.is_dir():
                check_output(out / f"preset_{kind}.json")

    with cli.progress("starting") as advance:
        if recording is not None:
            opened = open_recording(recording)
        else:
            opened = simulated(
                picture,
                seed=common.seed,
                device=device,
                quick=quick,
                progress=part(advance, 0.0, 0.0),
            )
        charts = make(opened, out, device=device, seed=common.seed, quick=quick, progress=advance)
    answers = charts.answer(out, budget_px=budget_px, budget_ms=budget_ms)
    cli.report(
        common,
        chart_summary(charts, answers, out) | {"device": device},
        chart_lines(charts, answers, out),
    )
    if not (charts.compensation or charts.calibration):
        raise typer.Exit(1)


def chart_summary(charts: Charts, answers: dict[str, Row | None], out: Path) -> dict[str, Any]:
    """Return the Pareto fronts, the default settings and the chosen settings for JSON.

    The full tables are in the files.
    """
    from amiwarp.studies.chart.rows import fronts

    def fields(row: Row) -> dict[str, Any]:
        return {
            "label": row.label,
            "job": row.job,
            "mev_per_s": row.mev_per_s,
            "ms": row.seconds * 1e3,
            "error_px": row.error_px,
            "settings": dict(row.settings),
        }

    fronts_of = {}
    defaults_of = {}
    for name, rows in (("compensation", charts.compensation), ("calibration", charts.calibration)):
        fronts_of[name] = {job: [fields(row) for row in chosen] for job, chosen in fronts(rows)}
        defaults_of[name] = [fields(row) for row in rows if row.default]
    answered: dict[str, Any] = {}
    for kind, row in answers.items():
        answered[kind] = None
        if row is not None:
            answered[kind] = {**fields(row), "file": str(out / f"preset_{kind}.json")}
    return {
        "fronts": fronts_of,
        "defaults": defaults_of,
        "answers": answered,
        "files": {name: str(path) for name, path in charts.files.items()},
        "notes": list(charts.notes),
        "failed": dict(charts.failed),
    }


def chart_lines(charts: Charts, answers: dict[str, Row | None], out: Path) -> list[Any]:
    """Return the results as tables and lines of text."""
    from amiwarp.studies.chart.rows import beaten_by, fronts, told_apart

    lines: list[Any] = []
    for rows in (charts.compensation, charts.calibration):
        for job, chosen in fronts(rows):
            defaults = [row for row in rows if row.default and row.job == job]
            listed = told_apart(chosen) + [row for row in defaults if row not in chosen]
            cells = [(_setting(row), *_setting_speed(row)) for row in listed]
            lines += [cli.table(cells, f"front, {job}", "speed", "error"), ""]
            for default in defaults:
                better = beaten_by(default, rows)
                if better:
                    labels = ", ".join(row.label for row in better)
                    lines.append(f"faster or more accurate than the default: {labels}")
    lines += [f"note: {note}" for note in charts.notes]
    for kind, row in answers.items():
        if row is None:
            lines.append(f"{kind}: no measured setting is within the budget; see the front above")
        else:
            speed, error = _setting_speed(row)
            file = out / f"preset_{kind}.json"
            lines.append(
                f"{kind} within the budget: {row.label}, {speed}, {error} measured; use it with --preset {file}"
            )
    lines += failed_lines(charts.failed, charts.files["data"])
    lines += [f"{name}: {path}" for name, path in charts.files.items()]
    measured = len(charts.compensation) + len(charts.calibration)
    if charts.failed:
        lines.append(f"{measured:,} settings measured; {len(charts.failed):,} failed")
    return lines


def _setting(row: Row) -> str:
    if row.default and row.label != "default":
        return f"{row.label} (default)"
    return row.label


def _setting_speed(row: Row) -> tuple[str, str]:
    """Return time or speed of a row, and its error."""
    speed = f"{row.mev_per_s:.3g} Mev/s"
    if row.chart == "calibration":
        speed = f"{row.seconds * 1e3:,.0f} ms"
    return speed, f"{row.error_px:.3g} px"
