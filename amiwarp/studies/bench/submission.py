"""Submissions to AMI-Bench: a folder with a file for each task and recording, and what it says of itself."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name
from amiwarp.io.json_files import read_json
from amiwarp.schema.records import build, check_format, check_given
from amiwarp.studies.bench.answer_files import ArrayField, read_arrays
from amiwarp.studies.bench.scores import ANGLES, COLUMNS, ROWS
from amiwarp.studies.bench.specification import SETS, VERSION, Entry, entries
from amiwarp.validation import one_of, shown

FORMAT = "ami-bench-submission"
FILE = "submission.json"
"""Value of the field ``format``, and name of the file that describes a submission."""
FASTEST_PX_S = 1e5
"""Largest flow that is taken for one [px/s]."""
FASTEST_DEG_S = 1e4
"""Largest angular velocity that is taken for one [deg/s]."""
LARGEST_LOG = 1e6
"""Largest value of a picture, whose unit is free."""

UNITS = {
    "calibration": "px",
    "picture": "log",
    "flow": "px/s",
    "detection": "mask",
    "rotation": "deg/s",
}
"""Units of the tasks' answers, which a submission states. The tasks are in the order of the table."""
TASKS = tuple(UNITS)
"""Names of the tasks."""
ARRAYS = {
    "calibration": "displacement",
    "picture": "log",
    "flow": "flow",
    "detection": "mask",
    "rotation": "rates",
}
"""Name of the array in a file of each task."""


def array_field(task: str, entry: Entry) -> ArrayField:
    """Return what the array of a task's answer about a recording must be."""
    width = entry.camera.width
    height = entry.camera.height
    if task == "calibration":
        return ArrayField("f", (ANGLES, ROWS, COLUMNS, 2), float(width), "px")
    if task == "picture":
        return ArrayField("f", (height, width), LARGEST_LOG)
    if task == "flow":
        return ArrayField("f", (height, width, 2), FASTEST_PX_S, "px/s")
    if task == "detection":
        return ArrayField("b", (height, width))
    return ArrayField("f", (len(entry.rotation_ends_us) - 1, 3), FASTEST_DEG_S, "deg/s")


def nothing(task: str, entry: Entry) -> NDArray[Any]:
    """Return the answer that counts for a refused recording: nothing moves, and nothing is seen."""
    wanted = array_field(task, entry)
    return np.zeros(wanted.shape, np.bool_ if wanted.kind == "b" else np.float64)


def _name(value: str, where: str) -> str:
    """Return the name of a submission; raise :class:`AmiwarpError` for one that a table cannot show."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,39}", value):
        raise AmiwarpError(
            f"{where} is {shown(value)}; expected up to 40 letters, digits, spaces, '.', '_' and '-'",
            ErrorCode.FIELD,
        )
    return value


def _set_name(value: str, where: str) -> str:
    """Return the name of a set; raise :class:`AmiwarpError` for another one."""
    return one_of(value, SETS, where)


@dataclass(frozen=True)
class Submission:
    """Fields of the file that describes a submission."""

    format: str
    version: str
    set: Annotated[str, _set_name]
    """Name of the set of recordings."""
    name: Annotated[str, _name]
    """Name of the method, for the table."""
    units: Mapping[str, str]
    """Unit of the answers, by the name of each task that is answered."""
    refused: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Recordings that the method refuses, by task and name, with the reason. They count as answers of nothing."""
    about: str = ""
    """What the method is, and where it is described."""


def load_submission(folder: Path) -> Submission:
    """Read what a submission says of itself. Raises :class:`AmiwarpError`, which names file, field and value."""
    path = folder / FILE
    data = read_json(path, "a submission to AMI-Bench")
    with errors_name(path, lambda: "is no submission to AMI-Bench"):
        check_given(data, "", "format", "version")
        check_format(data, FORMAT, VERSION)
        found = build(Submission, data, "")
        _check_tasks(found)
    for task in TASKS:
        if task not in found.units and (folder / task).exists():
            raise AmiwarpError(
                f"{folder / task}: answers a task that {FILE} does not name; give units.{task}, or remove the folder",
                ErrorCode.FIELD,
            )
    return found


def _check_tasks(found: Submission) -> None:
    """Raise :class:`AmiwarpError` for unknown tasks, other units, and refusals of what is not asked."""
    if not found.units:
        raise AmiwarpError(
            "field units is empty; give the unit of each answered task", ErrorCode.FIELD
        )
    for task, unit in found.units.items():
        _check_task(task, f"units.{task}")
        if unit != UNITS[task]:
            raise AmiwarpError(
                f"field units.{task} is {shown(unit)}; expected {UNITS[task]!r}: convert the answers",
                ErrorCode.FIELD,
            )
    for task, reasons in found.refused.items():
        _check_task(task, f"refused.{task}")
        if task not in found.units:
            raise AmiwarpError(
                f"field refused.{task} is of a task without a unit; give units.{task}, or remove it",
                ErrorCode.FIELD,
            )
        names = [entry.name for entry in entries_of(found.set, task)]
        for name in reasons:
            if name not in names:
                raise AmiwarpError(
                    f"field refused.{task} names {shown(name)}; choose among {', '.join(names)}",
                    ErrorCode.FIELD,
                )


def _check_task(task: str, where: str) -> None:
    if task not in TASKS:
        raise AmiwarpError(
            f"field {where} is of an unknown task; choose among {', '.join(TASKS)}", ErrorCode.FIELD
        )


def entries_of(set_name: str, task: str, chosen: Sequence[Entry] | None = None) -> list[Entry]:
    """Return the recordings of a set, or the chosen ones of it, that a task scores."""
    known = entries(set_name) if chosen is None else chosen
    return [entry for entry in known if task in entry.tasks]


def load_answers(
    folder: Path, submission: Submission, task: str, chosen: Sequence[Entry]
) -> dict[str, NDArray[Any]]:
    """Return a submission's answers to a task, by the names of the recordings.

    Raises :class:`AmiwarpError` for a missing or additional file, and for arrays of another kind, shape or range.
    """
    refused = submission.refused.get(task, {})
    wanted = {entry.name: entry for entry in entries_of(submission.set, task, chosen)}
    _check_files(folder / task, submission, task)
    answers = {}
    for name, entry in wanted.items():
        path = folder / task / f"{name}.npz"
        if name not in refused:
            expected = {ARRAYS[task]: array_field(task, entry)}
            remedy = f"answer the recording, or state in {FILE} why it is refused (refused.{task})"
            answers[name] = read_arrays(path, expected, remedy)[ARRAYS[task]]
            continue
        if path.exists():
            raise AmiwarpError(
                f"{path}: answers a recording that {FILE} refuses (refused.{task}); remove one of both",
                ErrorCode.FIELD,
            )
        answers[name] = nothing(task, entry)
    return answers


def _check_files(folder: Path, submission: Submission, task: str) -> None:
    """Raise :class:`AmiwarpError` for a file that is no recording of the set."""
    known = {f"{entry.name}.npz" for entry in entries_of(submission.set, task)}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.name not in known:
            raise AmiwarpError(
                f"{path}: the task {task} has no recording of this name in the set {submission.set}; remove the file",
                ErrorCode.FIELD,
            )


def described(submission: Submission) -> dict[str, Any]:
    """Return the fields of the file that describes a submission."""
    return asdict(submission)
