"""Errors of the optical models."""

from __future__ import annotations

import math

from matplotlib.figure import Figure

from paper.drawing import COLOURS, new_figure
from paper.sources import Table, Values, one, page, table_after

PAGE = "optics.md"
MODELS = {
    "circle, on-axis δ": "circle, nominal δ",
    "circle, fitted δ": "circle, fitted δ",
    "radial circle": "radial circle",
    "ellipse": "ellipse",
}
"""Column of the results, and name in the report."""
ROUNDING_PX = 1.0 / math.sqrt(12.0)
"""Standard deviation of the rounding of a place to its pixel [px]."""
FIELDS = ("40°", "60°", "75°", "90°")


def ladder() -> list[dict[str, str]]:
    """Return the errors of all models with the flat side towards the scene."""
    rows = table_after(PAGE, "## Error of each model")
    return [row for row in rows if row["flat side"] == "scene"]


def rms_px(fov: str, deflection: str, model: str) -> float:
    """Return the rms error of a model [px]."""
    return float(one(ladder(), FOV=fov, **{"δ₀": deflection})[model].split("/")[0])


def worst_of(fov: str, deflection: str, model: str) -> str:
    """Return the largest error of a model [px]."""
    return one(ladder(), FOV=fov, **{"δ₀": deflection})[model].split("/")[1]


def values() -> Values:
    """Return the values of the subject."""
    fitted = "circle, fitted δ"
    from_trace = one(rounding(), width="from the trace [1e-3 px]")
    return {
        "optics.circle_60": f"{rms_px('60°', '1°', fitted):.2f}",
        "optics.circle_60_worst": worst_of("60°", "1°", fitted),
        "optics.circle_60_2deg": f"{rms_px('60°', '2°', fitted):.2f}",
        "optics.circle_90": f"{rms_px('90°', '1°', fitted):.2f}",
        "optics.circle_90_worst": worst_of("90°", "1°", fitted),
        "optics.radial_60": f"{rms_px('60°', '1°', 'radial circle'):.3f}",
        "optics.ellipse_60": f"{rms_px('60°', '1°', 'ellipse'):.3f}",
        "optics.apex_of_1deg": apex_of_one_degree(),
        "optics.width": "640",
        "optics.float32_640": f"{float(from_trace['640']) * 1e-3:.5f}",
    }


def rounding() -> list[dict[str, str]]:
    """Return the worst rounding errors of random cameras and prisms; a column is a width of the image."""
    return table_after(PAGE, "The worst of 1,500 random cameras and prisms")


def apex_of_one_degree() -> str:
    """Return the apex angle [deg] whose deflection is one degree."""
    sentence = page(PAGE).split("need an apex of ", 1)[1]
    return sentence.split(", ")[1].split("°")[0]


def tables() -> dict[str, Table]:
    """Return the tables of the subject."""
    rows = []
    for fov in FIELDS:
        row = one(ladder(), FOV=fov, **{"δ₀": "1°"})
        rows.append([fov, *(row[column].replace("/", " / ") for column in MODELS)])
    return {"rungs": Table(["field of view", *MODELS.values()], rows)}


def draw_rungs() -> Figure:
    """Draw the rms error of each model over the field of view, a panel for each deflection."""
    figure, axes = new_figure(3, 2.1)
    for panel, deflection in zip(axes, ("0.5°", "1°", "2°"), strict=True):
        for (column, name), colour in zip(MODELS.items(), COLOURS, strict=True):
            errors = [rms_px(fov, deflection, column) for fov in FIELDS]
            panel.semilogy(range(len(FIELDS)), errors, marker="o", color=colour, label=name)
        panel.axhline(ROUNDING_PX, color="#808080", linewidth=0.8, linestyle=":")
        panel.set_xticks(range(len(FIELDS)), FIELDS)
        panel.set_ylim(5e-4, 2e1)
        panel.set_title(f"deflection {deflection}")
        panel.set_xlabel("field of view")
    axes[0].set_ylabel("rms error [px]")
    axes[2].legend(loc="lower right", fontsize=6.0)
    return figure


def figures() -> dict[str, Figure]:
    """Return the figures of the subject."""
    return {"rungs": draw_rungs()}
