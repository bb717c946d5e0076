"""Errors of both stages of the calibration on recordings of the package's own simulator."""

from __future__ import annotations

from matplotlib.figure import Figure

from paper.drawing import COLOURS, new_figure
from paper.sources import (
    Row,
    Table,
    Values,
    fixed,
    median,
    percents,
    results,
    significant,
    table_after,
)

APEXES = (0.5, 1.0, 2.0)


def rows() -> list[Row]:
    """Return the recordings."""
    return list(results("calibration_photometric_cuda.json")["rows"])


def at_apex(apex_deg: float) -> list[Row]:
    """Return the recordings with an apex angle."""
    return [row for row in rows() if row["apex_true_deg"] == apex_deg]


def measure_px(cost: str, smoothing: str) -> str:
    """Return the median error [px] of a measure of sharpness alone, on nine other recordings."""
    table = table_after("calibration_defaults.md", "## Costs and smoothing, without dither")
    row = next(row for row in table if f"`{cost}`" in row["cost"])
    return row[smoothing].strip("*").split(" / ")[0]


def apex_coverage() -> list[float]:
    """Return the shares of recordings whose true apex is within one, two and three stated deviations."""
    ratios = [abs(row["apex_error_deg"]) / row["apex_std_deg"] for row in rows()]
    return [sum(ratio <= limit for ratio in ratios) / len(ratios) for limit in (1, 2, 3)]


def values() -> Values:
    """Return the values of the subject."""
    found = rows()
    sharpness = [median(at_apex(apex), "sharpness_model_error_px") for apex in APEXES]
    return {
        "calibration.recordings": str(len(found)),
        "calibration.pictures": str(len({row["picture"] for row in found})),
        "calibration.accepted": str(sum(row["ok"] for row in found)),
        "calibration.sharpness_least": significant(min(sharpness), 1),
        "calibration.sharpness_most": significant(max(sharpness), 1),
        "calibration.variance": measure_px("variance", "1 px"),
        "calibration.gradient": measure_px("gradient", "not smoothed"),
        "calibration.both_median": fixed(median(found, "model_error_px"), 4),
        "calibration.both_largest": fixed(max(row["model_error_px"] for row in found), 4),
        "calibration.largest_phase": fixed(max(abs(row["phase_error_deg"]) for row in found), 2),
        "calibration.apex_coverage": percents(apex_coverage()),
    }


def tables() -> dict[str, Table]:
    """Return the tables of the subject."""
    columns = [
        "apex",
        "recordings",
        "sharpness, median",
        "largest",
        "both stages, median",
        "largest",
    ]
    lines = []
    for apex in APEXES:
        found = at_apex(apex)
        lines.append(
            [
                f"{apex:g}°",
                str(len(found)),
                fixed(median(found, "sharpness_model_error_px"), 3),
                fixed(max(row["sharpness_model_error_px"] for row in found), 3),
                fixed(median(found, "model_error_px"), 4),
                fixed(max(row["model_error_px"] for row in found), 4),
            ]
        )
    return {"stages": Table(columns, lines)}


def draw_stages() -> Figure:
    """Draw the error of each recording after the first stage and after both."""
    figure, (panel,) = new_figure(1, 2.2)
    for apex, colour in zip(APEXES, COLOURS, strict=False):
        found = at_apex(apex)
        before = [row["sharpness_model_error_px"] for row in found]
        after = [row["model_error_px"] for row in found]
        panel.loglog(before, after, "o", color=colour, alpha=0.7, label=f"apex {apex:g}°")
    panel.loglog([1e-4, 1.0], [1e-4, 1.0], color="#808080", linewidth=0.8, linestyle=":")
    panel.set_xlim(1e-2, 1.0)
    panel.set_ylim(5e-5, 1.0)
    panel.set_xlabel("error after contrast maximisation [px]")
    panel.set_ylabel("error after both stages [px]")
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def figures() -> dict[str, Figure]:
    """Return the figures of the subject."""
    return {"stages": draw_stages()}
