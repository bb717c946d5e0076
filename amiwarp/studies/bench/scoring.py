"""Scores of submissions to AMI-Bench, their table, and its comparison with the table in the package."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.json_files import read_json
from amiwarp.studies.bench.scores import (
    calibration_error,
    detection_score,
    flow_score,
    picture_score,
    rotation_error,
)
from amiwarp.studies.bench.specification import VERSION, Entry, entries
from amiwarp.studies.bench.submission import (
    TASKS,
    Submission,
    load_answers,
    load_submission,
)
from amiwarp.studies.bench.truth import BenchTruth, load_truth

TABLE = Path(__file__).with_name("table-1.0.json")
"""Table of the small set, as it was made."""


@dataclass(frozen=True)
class Column:
    """A score in the table."""

    task: str
    """Task that it belongs to."""
    heading: str
    """Heading, with the unit."""
    tolerance: float
    """Largest difference from the table in the package that counts as rounding, in the unit."""


COLUMNS = {
    "calibration_px": Column("calibration", "calibration [px]", 0.02),
    "picture": Column("picture", "picture", 0.02),
    "picture_detail": Column("picture", "detail", 0.02),
    "flow_px": Column("flow", "flow [px]", 0.05),
    "flow_deg": Column("flow", "flow [deg]", 2.0),
    "detection_iou": Column("detection", "detection", 0.05),
    "rotation_deg_s": Column("rotation", "rotation [deg/s]", 0.5),
}
"""Scores of the table by name. Picture, detail and detection: higher is better; the others: lower."""


@dataclass(frozen=True)
class Scored:
    """Scores of a submission."""

    name: str
    """Name of the method."""
    set_name: str
    """Name of the set of recordings."""
    recordings: int
    """Number of recordings."""
    scores: dict[str, float | None]
    """Mean of each score over the recordings of its task; None for a task that is not answered."""
    refused: dict[str, int]
    """Number of refused recordings of each answered task."""
    by_recording: dict[str, dict[str, float]]
    """Scores by recording."""


def score_submission(folder: Path, truth: Path, chosen: Sequence[Entry] | None = None) -> Scored:
    """Return the scores of a submission, or of the ``chosen`` recordings of it.

    Raises :class:`AmiwarpError`, which names file, field, value and remedy, if it cannot be scored.
    """
    submission = load_submission(folder)
    recordings = entries(submission.set) if chosen is None else tuple(chosen)
    if any(entry.set_name != submission.set for entry in recordings):
        raise AmiwarpError(
            f"{folder}: field set is {submission.set!r}; expected {recordings[0].set_name!r}; score it with "
            "its own set",
            ErrorCode.FIELD,
        )
    truths = {entry.name: load_truth(truth, entry) for entry in recordings}
    by_recording: dict[str, dict[str, float]] = {entry.name: {} for entry in recordings}
    for task in TASKS:
        if task in submission.units:
            answers = load_answers(folder, submission, task, recordings)
            for entry in recordings:
                if entry.name in answers:
                    found = scores_of(task, answers[entry.name], truths[entry.name], entry)
                    by_recording[entry.name] |= found
    return Scored(
        submission.name,
        submission.set,
        len(recordings),
        _means(by_recording),
        _refusals(submission, recordings),
        by_recording,
    )


def scores_of(task: str, answer: NDArray[Any], truth: BenchTruth, entry: Entry) -> dict[str, float]:
    """Return the scores of an answer to a task, by the names of the columns."""
    if task == "calibration":
        return {"calibration_px": calibration_error(answer, truth.model(entry))}
    if task == "picture":
        picture = picture_score(answer, truth.log)
        return {"picture": picture.whole, "picture_detail": picture.detail}
    if task == "flow":
        flow = flow_score(answer, truth.flow, truth.edges, entry.turn_us)
        return {"flow_px": flow.endpoint_px, "flow_deg": flow.angle_deg}
    if task == "detection":
        return {"detection_iou": detection_score(answer, truth.ball)}
    return {"rotation_deg_s": rotation_error(answer, truth.rates)}


def _means(by_recording: Mapping[str, Mapping[str, float]]) -> dict[str, float | None]:
    """Return the mean of each column over the recordings that have it. Rotations: the rms."""
    means: dict[str, float | None] = {}
    for name in COLUMNS:
        values = [scores[name] for scores in by_recording.values() if name in scores]
        if not values:
            means[name] = None
        elif name == "rotation_deg_s":
            means[name] = math.sqrt(float(np.mean(np.square(values))))
        else:
            means[name] = float(np.mean(values))
    return means


def _refusals(submission: Submission, recordings: Sequence[Entry]) -> dict[str, int]:
    """Return the number of refused recordings of each answered task, among the scored ones."""
    names = {entry.name for entry in recordings}
    refusals = {}
    for task in TASKS:
        if task in submission.units:
            refusals[task] = len(names & set(submission.refused.get(task, {})))
    return refusals


def score_submissions(
    folders: Sequence[Path], truth: Path, chosen: Sequence[Entry] | None = None
) -> list[Scored]:
    """Return the scores of several submissions to one set.

    Raises :class:`AmiwarpError` as :func:`score_submission`, and for two submissions of one name or of two sets.
    """
    found: list[Scored] = []
    for folder in folders:
        scored = score_submission(folder, truth, chosen)
        for other in found:
            if other.name == scored.name:
                raise AmiwarpError(
                    f"{folder}: field name is {scored.name!r}, the name of another submission; give another name",
                    ErrorCode.FIELD,
                )
            if other.set_name != scored.set_name:
                raise AmiwarpError(
                    f"{folder}: field set is {scored.set_name!r}, of another submission {other.set_name!r}; score "
                    "the sets apart",
                    ErrorCode.FIELD,
                )
        found.append(scored)
    return found


def table_rows(found: Sequence[Scored]) -> list[tuple[str, ...]]:
    """Return the cells of the table, row by row. A dash stands for a task that a method does not answer."""
    rows = []
    for scored in found:
        cells = [scored.name]
        for name in COLUMNS:
            value = scored.scores[name]
            cells.append("–" if value is None else f"{value:.3f}")
        refused = [f"{count} {task}" for task, count in scored.refused.items() if count]
        cells.append(", ".join(refused) or "none")
        rows.append(tuple(cells))
    return rows


HEADINGS = ("method", *(column.heading for column in COLUMNS.values()), "refused")
"""Headings of the table."""


def table_data(found: Sequence[Scored]) -> dict[str, Any]:
    """Return the table as data."""
    methods = {}
    for scored in found:
        methods[scored.name] = {
            "scores": scored.scores,
            "refused": scored.refused,
            "recordings": scored.by_recording,
        }
    return {
        "format": "ami-bench-table",
        "version": VERSION,
        "set": found[0].set_name,
        "methods": methods,
    }


def differences(found: Sequence[Scored], table: Mapping[str, Any]) -> list[str]:
    """Return a line for each score that differs from a table by more than the tolerance of its column.

    Scores are compared over the recordings that both have, see :func:`not_compared`.
    """
    lines = []
    for scored in found:
        stated = table["methods"].get(scored.name)
        if stated is None:
            lines.append(f"{scored.name}: is not in the table")
            continue
        common = [name for name in scored.by_recording if name in stated["recordings"]]
        values = _means({name: scored.by_recording[name] for name in common})
        expected = _means({name: stated["recordings"][name] for name in common})
        for name, column in COLUMNS.items():
            where = f"{scored.name}, {column.heading}"
            lines += _difference(where, values[name], expected[name], column)
    return lines


def not_compared(found: Sequence[Scored], table: Mapping[str, Any]) -> list[str]:
    """Return the names of the scored recordings that a table lacks for a method that it has."""
    missing = set[str]()
    for scored in found:
        stated = table["methods"].get(scored.name)
        if stated is not None:
            missing |= set(scored.by_recording) - set(stated["recordings"])
    return sorted(missing)


def _difference(
    where: str, value: float | None, expected: float | None, column: Column
) -> list[str]:
    """Return a line if a score is another one than expected."""
    beyond = ""
    if value is None or expected is None:
        if value is expected:
            return []
    else:
        if abs(value - expected) <= column.tolerance:
            return []
        beyond = f", beyond {column.tolerance:g}"
    return [f"{where}: {_text(value)}, in the table {_text(expected)}{beyond}"]


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def stated_table() -> dict[str, Any]:
    """Return the table in the package."""
    return read_json(TABLE, "a table of AMI-Bench", noted=False)
