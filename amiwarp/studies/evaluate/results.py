"""What evaluations return: results of cells, tables with their charts, pictures, and verdicts on the paper's claims."""

from __future__ import annotations

import base64
import enum
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.studies.evaluate.conditions import FOCAL_PX, Condition, RecordedCondition, Stream
from amiwarp.validation import real, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

Share = Annotated[float, partial(real, low=0.0, high=1.0)]
"""Type of a share in a cell, 0 to 1."""
Amount = Annotated[float, partial(real, low=0.0, high=1e6)]
"""Type of a measured value in a cell that is not negative: pixels, degrees, milliseconds, relative rates and so on."""
Count = Annotated[int, partial(whole, low=0, high=10**12)]
"""Type of a number of things in a cell."""
Value = str | int | float | bool | None
"""Type of a value in a table."""


@dataclass(frozen=True)
class Settings:
    """Size of a run."""

    quick: bool = True
    """Whether the run is short: a small image and few values."""
    seeds: int = 2
    """Number of seeds of each condition."""
    first_seed: int = 1
    """First seed. The settings of the algorithms were chosen with seed 0, which is therefore not scored."""
    width: int = 240
    """Width of the images [px]."""
    height: int = 180
    """Height of the images [px]."""
    duration_s: float = 0.25
    """Duration of a recording [s]."""
    device: str = "cpu"
    """Device that computes."""

    def conditions(self, **values: Any) -> list[Condition]:
        """Return a condition of this size for each seed, with the given ``values`` of its other fields."""
        size = {"width": self.width, "height": self.height, "duration_s": self.duration_s}
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return [Condition(**{**size, **values}, seed=seed) for seed in seeds]

    def scenes(self) -> list[Condition]:
        """Return the room at rest and moving; in full also in fast motion, and the desk and the street."""
        scenes = [("room", "still"), ("room", "handheld")]
        scenes += [] if self.quick else [("room", "fast"), ("desk", "handheld"), ("street", "handheld")]
        return [c for world, motion in scenes for c in self.conditions(world=world, trajectory=motion)]


QUICK = Settings()
FULL = Settings(quick=False, seeds=10, width=320, height=240)


def wide_focal(settings: Settings) -> float:
    """Return the focal length with which an image of any size sees what the whole sensor does [px]."""
    return FOCAL_PX * settings.width / 640.0


@dataclass(frozen=True)
class CellResult:
    """Result of one evaluation under one condition."""

    evaluation: str
    """Name of the evaluation."""
    condition: Condition | RecordedCondition
    """Condition under which it ran."""
    values: dict[str, Any] = field(default_factory=dict)
    """Values that the evaluation's function ``measure`` returned; empty if it failed."""
    error: str = ""
    """Message of an error that ended it, or empty."""
    processor_s: float = 0.0
    """Processor time of the measure [s], without the simulation."""


class ChartKind(enum.StrEnum):
    """Kinds of charts."""

    LINES = "lines"
    BARS = "bars"


@dataclass(frozen=True)
class Chart:
    """Chart of a table. All texts but the labels are names of columns."""

    x: str
    """Column of the horizontal axis."""
    y: str
    """Column of the vertical axis."""
    series: str
    """Column whose values are drawn as separate lines or bars."""
    spread: str | None = None
    """Column of the standard deviation over seeds, drawn as a band or as error bars."""
    panels: tuple[str, ...] = ()
    """Columns whose combinations are drawn in separate panels."""
    kind: ChartKind = ChartKind.LINES
    """Kind of the chart."""
    log_x: bool = False
    """Whether the horizontal axis is logarithmic."""
    log_y: bool = False
    """Whether the vertical axis is logarithmic."""
    marks: dict[str, float] = field(default_factory=dict)
    """Values of the vertical axis that are marked by a horizontal line, by their labels, such as the paper's."""


@dataclass(frozen=True)
class Table:
    """Table of results."""

    name: str
    """Name of its files."""
    title: str
    """Title: what is measured."""
    columns: tuple[str, ...]
    """Names of the columns, with their units."""
    rows: list[tuple[Value, ...]]
    """Rows."""
    caption: str = ""
    """What can be seen, and how to read it."""
    chart: Chart | None = None
    """Chart of the table, or None."""
    long: bool = False
    """Whether the table is too long for the page and for ``report.json``, and is only written as CSV."""


@dataclass(frozen=True)
class Picture:
    """Picture or film in the report."""

    name: str
    """Name of its file."""
    caption: str
    """What can be seen."""
    frames: list[NDArray[np.uint8]]
    """Picture, or frames of the film, shape ``(height, width)`` or ``(height, width, 3)``."""
    frame_s: float = 0.1
    """Time that a frame of a film is shown [s]."""


class Verdict(enum.StrEnum):
    """Verdict on a claim of the paper."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    NOT_TESTABLE = "not testable"


@dataclass(frozen=True)
class Claim:
    """Claim of the paper with the verdict on it, which follows from the results by a stated rule."""

    text: str
    """What the paper says."""
    paper: str
    """Value in the paper, or the place of a curve without published numbers."""
    ours: str
    """Our value."""
    verdict: Verdict
    """Verdict."""
    rule: str
    """Rule by which the verdict follows from our results."""

    @classmethod
    def judge(cls, text: str, paper: str, ours: str, holds: bool | None, rule: str) -> Claim:
        """Return a claim that is reproduced if it ``holds``; None if there are no results to judge it by."""
        verdict = {True: Verdict.REPRODUCED, False: Verdict.NOT_REPRODUCED, None: Verdict.NOT_TESTABLE}[holds]
        return cls(text, paper, ours, verdict, rule)


MOST_PIXELS = 1 << 22
"""Largest number of pixels of a picture in a cell."""
NO_RESULT = "no result"
"""Text for a comparison without values."""


@dataclass(frozen=True)
class Score:
    """Score of a stream in a case, over the seeds."""

    mean: float
    """Mean."""
    std: float
    """Standard deviation."""
    seeds: int
    """Number of seeds that have a score."""


def compared(
    cases: Mapping[Any, Mapping[str, Score]], other: Stream, word: str, *, larger: bool
) -> tuple[bool | None, str]:
    """Compare the calibrated AMI-EV with another stream, and return whether it is better in each case, and a text.

    Better means ``larger`` or smaller by more than either standard deviation. A case in which fewer than half of the
    recordings could be calibrated counts as not better; the text also says in how many cases the true model is better.
    ``word``: comparative for the text. The first value is None if no case has the other stream, or if no recording
    could be calibrated.
    """
    given = [case for case in cases.values() if other in case]
    if not given:
        return None, NO_RESULT
    if not any(Stream.CALIBRATED in case for case in given):
        return None, "the calibration refused all recordings"
    sign = 1.0 if larger else -1.0

    def better(stream: Stream) -> int:
        pairs = [(case[stream], case[other]) for case in given if _most_have(stream, case, other)]
        return sum(sign * (ours.mean - theirs.mean) > max(ours.std, theirs.std) for ours, theirs in pairs)

    wins, refused = better(Stream.CALIBRATED), sum(not _most_have(Stream.CALIBRATED, case, other) for case in given)
    text = f"{word} in {wins} of {len(given)} cases, with the true model in {better(Stream.TRUE)}"
    if len(given) == 1 and not refused:
        ours, theirs = given[0][Stream.CALIBRATED], given[0][other]
        text = f"AMI-EV {ours.mean:.3f} ± {ours.std:.3f}, {other} {theirs.mean:.3f} ± {theirs.std:.3f}"
    return wins == len(given), text + (f"; calibration mostly refused in {refused}" if refused else "")


def _most_have(stream: Stream, case: Mapping[str, Score], other: Stream) -> bool:
    """Return whether a stream exists in at least half of the recordings of a case that have the other one."""
    return stream in case and 2 * case[stream].seeds >= case[other].seeds


def where_calibrated(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of the recordings that have a calibrated stream, so that all streams are of the same ones."""
    names = ("scene", "camera", "seed")
    there = {tuple(row[n] for n in names) for row in rows if row["stream"] == Stream.CALIBRATED}
    return [row for row in rows if tuple(row[n] for n in names) in there]


def rows_of(results: Sequence[CellResult], name: str) -> list[dict[str, Any]]:
    """Return the rows that the cells' values hold under ``name``, with the fields of their conditions.

    Each row also has ``scene`` (the world, or the name of a recording) and ``camera`` (the camera's motion).
    """
    rows = []
    for result in results:
        condition = result.condition
        if isinstance(condition, Condition):
            known = {**asdict(condition), "scene": condition.world, "camera": condition.trajectory}
        else:
            known = {"scene": condition.path.name, "camera": "recording", "seed": condition.seed}
        rows += [{**known, **row} for row in result.values.get(name, ())]
    return rows


def grouped(rows: Sequence[dict[str, Any]], by: Sequence[str], values: Sequence[str]) -> list[tuple[Value, ...]]:
    """Return one row for each combination of the columns ``by``, in order of appearance.

    A row holds the combination, the number of rows, and for each of ``values`` the mean and the standard deviation.
    Values that are None or NaN are left out.
    """
    groups: dict[tuple[Value, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    out: list[tuple[Value, ...]] = []
    for key, members in groups.items():
        cells: list[Value] = [*key, len(members)]
        for name in values:
            given = np.array([m[name] for m in members if m.get(name) is not None], np.float64)
            given = given[np.isfinite(given)]
            cells += [float(given.mean()), float(given.std())] if given.size else [None, None]
        out.append(tuple(cells))
    return out


def by_case(rows: Sequence[dict[str, Any]], by: Sequence[str], value: str) -> dict[tuple[Value, ...], dict[str, Score]]:
    """Return the score of a column by case, the columns ``by``, and stream, for :func:`compared`."""
    rows = [r for r in rows if r.get(value) is not None]
    seeds: dict[tuple[Value, ...], set[int]] = {}
    for row in rows:
        seeds.setdefault(tuple(row[name] for name in (*by, "stream")), set()).add(row["seed"])
    cases: dict[tuple[Value, ...], dict[str, Score]] = {}
    for *case, stream, _, mean, std in grouped(rows, (*by, "stream"), [value]):
        if isinstance(mean, float) and isinstance(std, float):
            cases.setdefault(tuple(case), {})[str(stream)] = Score(mean, std, len(seeds[*case, stream]))
    return cases


def finite(value: float) -> float | None:
    """Return a number for a cell; None if it is not finite."""
    return value if np.isfinite(value) else None


def encode_picture(picture: NDArray[np.uint8]) -> str:
    """Return a picture as text, for the values of a cell."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode()


def decode_picture(text: str, what: str = "the picture") -> NDArray[np.uint8]:
    """Return a picture of :func:`encode_picture`. Raises :class:`AmiwarpError` for other texts."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(base64.b64decode(text, validate=True)), formats=["PNG"]) as picture:
            if picture.width * picture.height <= MOST_PIXELS:
                return np.asarray(picture)
    except Exception as error:  # PIL raises many kinds
        raise AmiwarpError(f"{what} cannot be decoded: {error}") from error
    raise AmiwarpError(f"{what} has {picture.width}x{picture.height} px; expected at most {MOST_PIXELS:,} pixels")


def check_pictures(texts: Sequence[str], axes: int, what: str) -> None:
    """Check that texts are pictures of 8-bit values, all of one shape of ``axes`` axes."""
    found = {(picture.shape, picture.dtype.str) for picture in map(partial(decode_picture, what=what), texts)}
    if len(found) > 1 or any(len(shape) != axes or kind != "|u1" for shape, kind in found):
        raise AmiwarpError(f"{what} has pictures of shapes and types {found}; expected one shape of {axes} axes, 8 bit")
