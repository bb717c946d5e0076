"""Calibrations on recordings of the second simulator, and the atlas of every optic."""

from __future__ import annotations

import math

from matplotlib.figure import Figure

from paper.drawing import COLOURS, new_figure
from paper.sources import Row, Table, Values, fixed, percent, percents, results, significant

DRAWN = "true_optics_drawn8000_cuda.json"
FURTHER = "true_optics_fresh9000_cuda.json"
CHOSEN_WITH = "true_optics_drawn_cuda.json"
"""Recordings with which the code was made; of an earlier state of the code."""
FURTHER_BEFORE = "true_optics_fresh_cuda.json"
"""The further troubles with their first seeds, of the same earlier state."""
LIMIT_PX = 0.02
OPTICS = ("wedge", "pair", "mirror", "vibration", "plate")
OUTCOMES = ("answered", "named", "refused", "silent")


def answered(name: str) -> list[Row]:
    """Return the recordings that were not refused."""
    return [row for row in results(name)["rows"] if not row["refused"]]


def outcome(row: Row) -> str:
    """Return what became of a recording: one of ``OUTCOMES``."""
    if row["refused"]:
        return "refused"
    if row["error_px"] <= LIMIT_PX:
        return "answered"
    return "named" if row["named"] else "silent"


def largest_silent(name: str) -> Row:
    """Return the silent recording with the largest error."""
    silent = [row for row in results(name)["rows"] if outcome(row) == "silent"]
    return max(silent, key=lambda row: row["error_px"])


def largest_error(name: str) -> str:
    """Return the largest error of a set [px]."""
    return significant(max(row["error_px"] for row in answered(name)))


def plate_errors() -> list[float]:
    """Return the errors of the plates that are over the limit [px]."""
    rows = [row for row in answered(DRAWN) if row["optic"] == "plate"]
    return [row["error_px"] for row in rows if row["error_px"] > LIMIT_PX]


def normal_shares() -> str:
    """Return the shares of a normal distribution within one, two and three standard deviations."""
    shares = [math.erf(count / math.sqrt(2.0)) for count in (1, 2, 3)]
    return f"{', '.join(fixed(100.0 * share, 1) for share in shares)} %"


def values() -> Values:
    """Return the values of the subject."""
    worst = largest_silent(DRAWN)
    atlas = results("atlas_optics.json")
    everything = atlas["summary"]["outcomes"]["all"]["all"]
    texts = {
        "turn.limit": f"{LIMIT_PX:g}",
        "turn.normal": normal_shares(),
        "turn.silent_error": significant(worst["error_px"]),
        "turn.silent_total": significant(worst["total_px"]),
        "turn.plates_over": str(len(plate_errors())),
        "turn.plates_most": significant(max(plate_errors())),
        "turn.atlas_recordings": str(len(atlas["rows"])),
        "turn.atlas_answered": str(everything["answered"]),
        "turn.atlas_named": str(everything["named"]),
        "turn.atlas_refused": str(everything["refused"]),
        "turn.atlas_silent": str(everything["silent"]),
    }
    drawn = results(DRAWN)["summary"]
    return texts | {
        "turn.drawn": str(drawn["recordings"]),
        "turn.drawn_answered": str(drawn["answered"]),
        "turn.drawn_silent": str(drawn["silent"]),
        "turn.drawn_within": str(drawn["within_0.02_px"]),
        "turn.drawn_median": fixed(drawn["median_error_px"], 4),
        "turn.drawn_coverage": percents(drawn["within_1_2_3_deviations"]),
        "turn.drawn_total": percent(drawn["within_total"]),
        "turn.drawn_rank": fixed(drawn["rank_correlation"], 2),
        "turn.further_rank": fixed(results(FURTHER)["summary"]["rank_correlation"], 2),
        "turn.chosen_with": str(results(CHOSEN_WITH)["summary"]["recordings"]),
        "turn.chosen_with_silent": str(results(CHOSEN_WITH)["summary"]["silent"]),
        "turn.further_before": str(results(FURTHER_BEFORE)["summary"]["recordings"]),
        "turn.further_before_silent": str(results(FURTHER_BEFORE)["summary"]["silent"]),
    }


def set_lines() -> list[list[str]]:
    """Return the lines of the table of both sets."""
    summaries = [results(name)["summary"] for name in (DRAWN, FURTHER)]
    return [
        ["recordings", *(str(each["recordings"]) for each in summaries)],
        ["answered", *(str(each["answered"]) for each in summaries)],
        [f"within {LIMIT_PX:g} px", *(str(each["within_0.02_px"]) for each in summaries)],
        ["silent", *(str(each["silent"]) for each in summaries)],
        ["median error [px]", *(fixed(each["median_error_px"], 4) for each in summaries)],
        ["largest error [px]", *(largest_error(name) for name in (DRAWN, FURTHER))],
        ["median stated deviation [px]", *(fixed(each["median_stated_px"], 4) for each in summaries)],
        ["truth within 1, 2, 3 deviations", *(percents(each["within_1_2_3_deviations"]) for each in summaries)],
        ["truth within the total", *(percent(each["within_total"]) for each in summaries)],
        ["rank correlation of error and deviation", *(fixed(each["rank_correlation"], 2) for each in summaries)],
    ]  # fmt: skip


def optic_lines() -> list[list[str]]:
    """Return the outcomes of the atlas, a line for each outcome."""
    outcomes = results("atlas_optics.json")["summary"]["outcomes"]
    return [[name, *(str(outcomes[optic]["all"][name]) for optic in OPTICS)] for name in OUTCOMES]


def tables() -> dict[str, Table]:
    """Return the tables of the subject."""
    return {
        "sets": Table(["", "drawn troubles", "further troubles"], set_lines()),
        "atlas": Table(["", *OPTICS], optic_lines()),
    }


def draw_errors() -> Figure:
    """Draw the error of each recording of both sets over what was stated of it."""
    figure, axes = new_figure(2, 2.5)
    titles = ("stated deviation [px]", "stated total [px]")
    for panel, field, title in zip(axes, ("stated_px", "total_px"), titles, strict=True):
        rows = [*answered(DRAWN), *answered(FURTHER)]
        for name, colour in zip(("answered", "named", "silent"), COLOURS, strict=False):
            some = [row for row in rows if outcome(row) == name]
            stated = [row[field] for row in some]
            errors = [row["error_px"] for row in some]
            panel.loglog(stated, errors, "o", color=colour, alpha=0.8, label=name)
        panel.loglog([1e-4, 1.0], [1e-4, 1.0], color="#808080", linewidth=0.8, linestyle=":")
        panel.axhline(LIMIT_PX, color="#808080", linewidth=0.8)
        panel.set_xlim(1e-3, 5e-1)
        panel.set_ylim(2e-4, 5e-1)
        panel.set_xlabel(title)
    axes[0].set_ylabel("error [px rms]")
    axes[1].legend(loc="upper left")
    return figure


def figures() -> dict[str, Figure]:
    """Return the figures of the subject."""
    return {"truth": draw_errors()}
