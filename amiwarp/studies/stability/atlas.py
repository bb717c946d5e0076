"""Atlas: the results of the stability study along its axes, made from the stored cells."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.studies.stability.aims import (
    DEFAULT,
    WORKS,
    Aims,
    StatedDeviations,
    aims_of,
    stated_deviations,
    worse_than_paper,
)
from amiwarp.studies.stability.axes import Axis
from amiwarp.studies.stability.cells import Store, Stored, identity
from amiwarp.studies.stability.condition import Cell, Condition
from amiwarp.studies.stability.judging import Method, Outcome
from amiwarp.studies.stability.mild_troubles import mild
from amiwarp.studies.stability.points import JUDGED, AxisPoint, value_label


@dataclass(frozen=True)
class Failure:
    """Recording of the study for which a method has no result, because the study failed."""

    name: str
    """Name of the cell."""
    where: str
    """Values of the axes that the recording belongs to, in words."""
    methods: tuple[str, ...]
    """Names of the methods without result."""
    message: str
    """Error, and where it was raised."""

    def row(self) -> tuple[str, ...]:
        """Return the values as a row of a table."""
        return (self.name, self.where, ", ".join(self.methods), self.message)


@dataclass(frozen=True)
class Atlas:
    """Results of the study as points, one per axis, method and value, in the order of axes and values.

    Points without results are left out.
    """

    spots: tuple[AxisPoint, ...]
    """Points of all axes: results of one method at one value each."""
    aims: Aims
    """Aims for the default method, and the measured rates."""
    cells: int
    """Number of cells (single recordings) that were evaluated."""
    about: dict[str, Any]
    """Description of the machine, the versions and the date."""
    stated: tuple[StatedDeviations, ...] = ()
    """How often the truth lies within the stated standard deviations."""
    failures: tuple[Failure, ...] = ()
    """What failed in the study, recording by recording."""

    @property
    def measured(self) -> bool:
        """Whether there is any result."""
        return any(s.results for s in self.spots)

    @property
    def failed_cells(self) -> int:
        """Number of cells (single recordings) that lack the result of a method because the study failed."""
        return len({failure.name for failure in self.failures})

    @property
    def axes(self) -> list[Axis]:
        """Axes of the study for which there are results."""
        return list(dict.fromkeys(s.axis for s in self.spots))

    @property
    def methods(self) -> list[str]:
        """Names of the methods for which there are results."""
        return list(dict.fromkeys(s.method for s in self.spots))

    def of(self, axis: Axis) -> dict[tuple[str, Any], AxisPoint]:
        """Return the points of an axis, by method and value."""
        return {(s.method, s.value): s for s in self.spots if s.axis == axis}

    def works(self, axis: Axis, method: str) -> str:
        """Return the values at which a method works, as text; runs of neighbours are written as from ... to.

        "measured" is added to "everywhere" and "nowhere" if not all values of the axis are measured.
        """
        spots = self.of(axis)
        measured_by_any = [value for _, value in spots]
        values = []
        for value in axis.values:
            spot = spots.get((method, value))
            lost = spot is not None and not spot.results
            if value in measured_by_any and not lost:
                values.append(value)
        if not values:
            return "not measured"

        good = []
        for value in values:
            spot = spots.get((method, value))
            good.append(spot is not None and spot.rate(Outcome.SUCCESS).share >= WORKS)
        if all(good) or not any(good):
            where = "everywhere" if all(good) else "nowhere"
            return where if len(values) == len(axis.values) else f"{where} measured"

        # Runs of neighbouring values at which the method works
        runs: list[list[str]] = []
        goes_on = False
        for value, works in zip(values, good, strict=True):
            if works and not goes_on:
                runs.append([])
            if works:
                runs[-1].append(value_label(axis, value))
            goes_on = works
        parts = []
        for run in runs:
            parts.append(f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(run))
        return ", ".join(parts)

    def failing(self, outcome: Outcome) -> list[AxisPoint]:
        """Return the points at which the default method has this outcome, the highest rate first."""
        spots = [s for s in self.spots if s.method == DEFAULT and s.rate(outcome).count]
        return sorted(spots, key=lambda s: -s.rate(outcome).share)


def aggregate(
    cells: Sequence[Stored], axes: Sequence[Axis], methods: Sequence[Method], about: dict[str, Any]
) -> Atlas:
    """Evaluate stored cells along the axes of the study.

    Raises :class:`AmiwarpError` if there are no results of these axes and methods.
    """
    identities = {method.name: identity(method) for method in methods}
    by_condition: dict[Condition, list[Stored]] = {}
    for stored in sorted(cells, key=lambda stored: stored.cell.seed):
        by_condition.setdefault(stored.cell.condition, []).append(stored)
    evaluated: dict[Cell, Stored] = {}
    spots = []
    worse = []
    for axis in axes:
        for value, condition in zip(axis.values, axis.conditions(), strict=True):
            here = by_condition.get(condition, [])
            for stored in here:
                if not stored.results.keys().isdisjoint(identities.values()):
                    evaluated[stored.cell] = stored
            for name, key in identities.items():
                results = [stored.results[key] for stored in here if key in stored.results]
                if results:
                    judged = tuple(result for result in results if result.outcome in JUDGED)
                    failed = len(results) - len(judged)
                    spots.append(AxisPoint(axis, value, name, judged, failed))
            worse += worse_than_paper(axis, value, here, identities)
    if not spots:
        raise AmiwarpError(
            "found no results of single runs (cells) for these axes and methods; run without --redraw first",
            ErrorCode.CONTENT_MISSING,
        )
    default = identities.get(DEFAULT)
    combinations = {
        stored.cell: stored for stored in cells if stored.cell.condition == mild(stored.cell.seed)
    }
    all_cells = evaluated | combinations
    return Atlas(
        spots=tuple(spots),
        aims=aims_of(evaluated.values(), default, worse),
        cells=len(evaluated),
        about=about,
        stated=stated_deviations(cells, default),
        failures=_failures(all_cells.values(), axes, identities),
    )


def _failures(
    cells: Iterable[Stored], axes: Sequence[Axis], identities: dict[str, str]
) -> tuple[Failure, ...]:
    """Return what failed, recording by recording; methods that failed for the same reason are listed together."""
    places: dict[Condition, list[str]] = {}
    for axis in axes:
        for value, condition in zip(axis.values, axis.conditions(), strict=True):
            place = f"{axis.name} {value_label(axis, value)}"
            places.setdefault(condition, []).append(place)
    failures = []
    for stored in cells:
        where = ", ".join(places.get(stored.cell.condition, ["random combination"]))
        methods_by_message: dict[str, list[str]] = {}
        for name, key in identities.items():
            result = stored.results.get(key)
            if result is not None and result.outcome is Outcome.FAILED:
                methods_by_message.setdefault(result.message, []).append(name)
        for message, methods in methods_by_message.items():
            failures.append(Failure(stored.cell.name, where, tuple(methods), message))
    return tuple(failures)


def load(store: Store) -> list[Stored]:
    """Return all cells (results of single runs) of a folder; damaged cells and cells of other versions are left out.

    Raises :class:`AmiwarpError` for a folder without cells.
    """
    cells = store.load_all()
    if not cells:
        what = "holds no results of single runs (cells) of this version"
        raise AmiwarpError(f"{store.folder}: {what}; run without --redraw first")
    return cells
