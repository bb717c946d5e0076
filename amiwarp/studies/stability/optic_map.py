"""Map of where which optic can be calibrated: outcomes along each axis of each optic, from the stability study."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.io.inputs import read_text
from amiwarp.io.outputs import write_text
from amiwarp.plotting.figures import blank
from amiwarp.studies.stability.axes import OPTIC_AXES, Axis
from amiwarp.studies.stability.cells import Stored
from amiwarp.studies.stability.condition import Condition, sensible
from amiwarp.studies.stability.figures import COLOURS as OUTCOME_COLOURS
from amiwarp.studies.stability.judging import OPTIC_LIMIT_PX, Outcome, Result
from amiwarp.studies.stability.mild_troubles import mild_optic
from amiwarp.studies.stability.optics import OPTICS
from amiwarp.studies.stability.points import value_label

FORMAT = "amiwarp-optic-map"
VERSION = 1
"""Name and version of the format of a map's file."""
PACKAGED = Path(__file__).with_name("optic_map.json")
"""File of the map that comes with the package."""
KINDS = {
    Outcome.SUCCESS: "answered",
    Outcome.NAMED: "named",
    Outcome.REFUSAL: "refused",
    Outcome.SILENT: "silent",
}
"""Name of each outcome in the map."""


@dataclass(frozen=True)
class MapPoint:
    """Outcomes at one value of an axis, over the seeds."""

    value: float | bool
    """Value of the trouble."""
    answered: int
    """Number of answers within the limit."""
    named: int
    """Number of answers beyond the limit with a warning that names the cause."""
    refused: int
    """Number of refusals."""
    silent: int
    """Number of answers beyond the limit without such a warning."""
    median_px: float | None
    """Median error of the answers [px rms]; None if there is none."""

    @property
    def total(self) -> int:
        """Number of recordings."""
        return self.answered + self.named + self.refused + self.silent

    def __str__(self) -> str:
        counts = {name: getattr(self, name) for name in KINDS.values()}
        parts = [f"{count} {name}" for name, count in counts.items() if count]
        error = "" if self.median_px is None else f"; {self.median_px:.2g} px"
        return f"{', '.join(parts)} of {self.total}{error}"


@dataclass(frozen=True)
class MapAxis:
    """One trouble of one optic, from harmless to hopeless."""

    optic: str
    """Name of the optic."""
    name: str
    """Name of the trouble."""
    field: str
    """Name by which a value of the trouble is given."""
    unit: str
    """Unit of the values."""
    points: tuple[MapPoint, ...]
    """Measured values."""

    def about(self, value: float) -> tuple[MapPoint, ...]:
        """Return the measured points about a value: it, or those below and above; one point beyond an end."""
        values = np.array([float(point.value) for point in self.points])
        order = np.argsort(values)
        for k in order:
            if np.isclose(values[k], value, rtol=1e-6, atol=1e-12):
                return (self.points[k],)
        place = int(np.searchsorted(values[order], value))
        near = order[max(place - 1, 0) : place + 1]
        return tuple(self.points[k] for k in near)

    def measured_at(self, value: float) -> bool:
        """Return whether a value lies within the measured range."""
        values = [float(point.value) for point in self.points]
        if min(values) <= value <= max(values):
            return True
        return bool(np.isclose(values, value, rtol=1e-6, atol=1e-12).any())


@dataclass(frozen=True)
class OpticMap:
    """Where which optic can be calibrated."""

    limit_px: float
    """Largest error of an answer that counts as answered [px rms]."""
    axes: tuple[MapAxis, ...]
    """Troubles of all optics."""
    about: Mapping[str, Any]
    """Machine, versions and date of the measurement."""

    def of(self, optic: str) -> tuple[MapAxis, ...]:
        """Return the axes of an optic. Raises :class:`AmiwarpError` for an unknown one."""
        if optic not in OPTICS:
            raise AmiwarpError(f"optic {optic!r} is not known; choose among {', '.join(OPTICS)}")
        return tuple(axis for axis in self.axes if axis.optic == optic)

    def axis(self, optic: str, field: str) -> MapAxis:
        """Return the axis of a trouble. Raises :class:`AmiwarpError` if the optic has none of that name."""
        axes = {axis.field: axis for axis in self.of(optic)}
        if field not in axes:
            known = ", ".join(f"{name} ({axis_text(axis)})" for name, axis in axes.items())
            raise AmiwarpError(
                f"trouble {field!r} of a {optic} was not measured; choose among {known or 'none'}"
            )
        return axes[field]

    def save(self, path: Path) -> None:
        """Write the map as JSON, one line per axis."""
        head = {
            "format": FORMAT,
            "version": VERSION,
            "limit_px": self.limit_px,
            "about": dict(self.about),
        }
        head_text = json.dumps(head, indent=1, ensure_ascii=False).removesuffix("\n}")
        lines = []
        for axis in self.axes:
            lines.append(json.dumps(asdict(axis), allow_nan=False, ensure_ascii=False))
        axes_text = ",\n  ".join(lines)
        write_text(path, f'{head_text},\n "axes": [\n  {axes_text}\n ]\n}}\n')


def axis_text(axis: MapAxis) -> str:
    """Return name and unit of a trouble."""
    return f"{axis.name} [{axis.unit}]" if axis.unit else axis.name


def load_map(path: Path = PACKAGED) -> OpticMap:
    """Read a map. Raises :class:`AmiwarpError` if the file is missing or damaged."""
    try:
        data = json.loads(read_text(path))
        axes = []
        for axis in data["axes"]:
            points = tuple(MapPoint(**point) for point in axis["points"])
            axes.append(MapAxis(**{**axis, "points": points}))
        if (data["format"], data["version"]) != (FORMAT, VERSION):
            raise AmiwarpError(
                f"{path}: format {data['format']} {data['version']}; expected {FORMAT} {VERSION}"
            )
        return OpticMap(float(data["limit_px"]), tuple(axes), data["about"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise AmiwarpError(
            f"{path}: no map of optics ({error}); install the package again"
        ) from None


def make_map(cells: Iterable[Stored], about: Mapping[str, Any]) -> OpticMap:
    """Return the map of stored cells with optics; axes without results are left out."""
    of_condition: dict[Condition, list[Stored]] = {}
    for stored in cells:
        of_condition.setdefault(stored.cell.condition, []).append(stored)
    axes = []
    for axis in OPTIC_AXES:
        points = []
        for value, condition in zip(axis.values, axis.conditions(), strict=True):
            found = [default_result(stored) for stored in of_condition.get(condition, [])]
            results = [result for result in found if result is not None]
            if results:
                points.append(_point(value, results))
        if points:
            optic, _, name = axis.name.partition(": ")
            axes.append(MapAxis(optic, name, axis.field, axis.unit, tuple(points)))
    return OpticMap(OPTIC_LIMIT_PX, tuple(axes), about)


def _point(value: Any, results: Sequence[Result]) -> MapPoint:
    """Return the point of a value."""
    outcomes = [result.outcome for result in results]
    counts = {name: outcomes.count(kind) for kind, name in KINDS.items()}
    errors = [result.error_px for result in results if result.error_px is not None]
    median_px = float(f"{np.median(errors):.3g}") if errors else None
    return MapPoint(value, **counts, median_px=median_px)


def default_result(stored: Stored) -> Result | None:
    """Return the result of the default method; None if there is none, or the study failed."""
    for name, result in stored.results.items():
        if name.split()[0] == "default" and result.outcome in KINDS:
            return result
    return None


def summary_of(cells: Sequence[Stored]) -> dict[str, Any]:
    """Return the numbers of outcomes of each optic, for axes and random combinations, and in the sensible range."""
    summary: dict[str, Any] = {}
    for stored in cells:
        result = default_result(stored)
        condition = stored.cell.condition
        if result is None or not condition.optic:
            continue
        drawn = condition == mild_optic(stored.cell.seed)
        places = ["combinations" if drawn else "axes", "all"]
        if sensible(condition, stored.events):
            places.append("sensible")
        for optic in (condition.optic, "all"):
            of_optic = summary.setdefault(optic, {})
            for place in places:
                counts = of_optic.setdefault(place, dict.fromkeys(KINDS.values(), 0))
                counts[KINDS[result.outcome]] += 1
    return summary


# Text and figure.

COLOURS = {name: OUTCOME_COLOURS[kind] for kind, name in KINDS.items()}
"""Colour of each outcome."""


@dataclass(frozen=True)
class RigOnMap:
    """A rig, and what the map has about it."""

    known: OpticMap
    """The map."""
    optic: str
    """Optic of the rig."""
    given: Mapping[str, float]
    """Troubles of the rig, by the names of the map's axes."""

    def __post_init__(self) -> None:
        if not self.known.of(self.optic):
            raise AmiwarpError(f"nothing was measured of a {self.optic}")
        for name in self.given:
            self.known.axis(self.optic, name)  # its error for an unknown name

    def rows(self) -> list[tuple[str, str, str]]:
        """Return rows of text; see :func:`rows_for`."""
        return rows_for(self.known, self.optic, self.given)

    def chart(self) -> Any:
        """Return the figure; see :func:`chart`."""
        return chart(self.known, self.optic, self.given)

    def summary(self) -> dict[str, Any]:
        """Return the axes of the optic, and the measured points about each given value, as JSON data."""
        near = {}
        for name, value in self.given.items():
            axis = self.known.axis(self.optic, name)
            points = [asdict(point) for point in axis.about(value)]
            near[name] = {
                "value": value,
                "measured_there": axis.measured_at(value),
                "points": points,
            }
        axes = [asdict(axis) for axis in self.known.of(self.optic)]
        return {
            "optic": self.optic,
            "limit_px": self.known.limit_px,
            "about": dict(self.known.about),
            "rig": near,
            "axes": axes,
        }


def rows_for(
    optic_map: OpticMap, optic: str, given: Mapping[str, float]
) -> list[tuple[str, str, str]]:
    """Return rows of text: trouble, value that is given or measured, and what was measured there.

    For a trouble that is given, these are the measured values about it. For others, it is how far from harmless all
    recordings were answered.
    """
    rows = []
    for axis in optic_map.of(optic):
        if axis.field not in given:
            rows.append((axis_text(axis), "not given", _answered_up_to(axis)))
            continue
        value = given[axis.field]
        near = [f"{label_of(axis, point.value)}: {point}" for point in axis.about(value)]
        text = "; ".join(near)
        if not axis.measured_at(value):
            text = f"not measured there; nearest: {text}"
        rows.append((axis_text(axis), f"{value:g}", text))
    return rows


def _answered_up_to(axis: MapAxis) -> str:
    """Return at which values all recordings were answered, and at which some failed silently, as text."""
    good = []
    bad = []
    for point in axis.points:
        label = label_of(axis, point.value)
        if point.answered == point.total:
            good.append(label)
        if point.silent:
            bad.append(label)
    text = f"all answered at {', '.join(good)}" if good else "nowhere all answered"
    if bad:
        text += f"; silent failures at {', '.join(bad)}"
    return text


def label_of(axis: MapAxis, value: Any) -> str:
    """Return a measured value as text."""
    return value_label(Axis(axis.name, axis.field, (), axis.unit), value)


WIDTH = 11.0
LEFT = 3.3
ROW = 0.36
GAP = 0.42
TOP = 0.75
BOTTOM = 0.45
"""Width of the figure, left margin, height of a row, gap below it, and margins above and below [inch]."""
FONT = 9.5
"""Font size of the figure [point]."""


def chart(optic_map: OpticMap, optic: str, given: Mapping[str, float]) -> Any:
    """Draw the outcomes along each axis of an optic as a Matplotlib figure; given values are marked."""
    from matplotlib.patches import Patch

    axes = optic_map.of(optic)
    height = TOP + len(axes) * (ROW + GAP) + BOTTOM
    figure = blank((WIDTH, height), dpi=130)
    # Places in the figure are shares of its width and height.
    left = LEFT / WIDTH
    width = (WIDTH - LEFT - 0.3) / WIDTH
    for k, axis in enumerate(axes):
        bottom = height - TOP - (k + 1) * (ROW + GAP) + GAP
        ax = figure.add_axes((left, bottom / height, width, ROW / height))
        _strip(ax, axis, given.get(axis.field))
    title = f"Where a {optic} can be calibrated: answers within {optic_map.limit_px:g} px"
    top = 1.0 - 0.3 / height
    figure.text(0.3 / WIDTH, top, title, fontsize=12.0, fontweight="bold", va="center")
    handles = [Patch(color=colour, label=name) for name, colour in COLOURS.items()]
    figure.legend(
        handles=handles,
        loc="lower left",
        ncols=4,
        frameon=False,
        fontsize=FONT,
        bbox_to_anchor=(left, 0.02 / height),
    )
    return figure


def _strip(ax: Any, axis: MapAxis, given: float | None) -> None:
    """Draw one axis: a box for each value, divided by the shares of the outcomes."""
    for column, point in enumerate(axis.points):
        counts = [getattr(point, name) for name in COLOURS]
        edges = column + np.cumsum([0, *counts]) / max(point.total, 1) - 0.5
        for colour, (low, high) in zip(COLOURS.values(), pairwise(edges), strict=True):
            ax.barh(0.0, high - low, 1.0, low, color=colour, linewidth=0)
        text = f"{point.answered}/{point.total}"
        ax.text(column, 0.0, text, ha="center", va="center", fontsize=FONT)
    between = np.arange(len(axis.points) + 1) - 0.5
    ax.vlines(between, -0.5, 0.5, color="white", linewidth=3.0)

    labels = [label_of(axis, point.value) for point in axis.points]
    ax.set(xlim=(-0.5, len(labels) - 0.5), ylim=(-0.5, 0.5), yticks=[])
    ax.set_xticks(range(len(labels)), labels, fontsize=FONT)
    ax.tick_params(axis="x", length=0, pad=1.0)
    ax.set_ylabel(axis_text(axis), rotation=0, ha="right", va="center", fontsize=FONT)
    if given is not None:
        values = np.array([float(point.value) for point in axis.points])
        columns = np.arange(len(values), dtype=float)
        order = np.argsort(values)
        place = float(np.interp(given, values[order], columns[order]))
        ax.plot([place, place], [-0.5, 0.5], color="black", linewidth=2.0, clip_on=False)
    for side in ax.spines.values():
        side.set_visible(False)
