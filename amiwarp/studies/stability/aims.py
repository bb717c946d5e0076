"""Aims for the default method of calibration, and how often the truth lies within the deviations that it states."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from scipy.stats import binomtest

from amiwarp.studies.stability.axes import Axis
from amiwarp.studies.stability.cells import Stored
from amiwarp.studies.stability.condition import sensible
from amiwarp.studies.stability.judging import Outcome
from amiwarp.studies.stability.mild_troubles import mild
from amiwarp.studies.stability.points import JUDGED, Rate, percent, value_label

DEFAULT = "default"
"""Name of the default method."""
PAPER = "paper"
"""Name of the paper's method."""
AIM_SUCCESS = 0.99
"""Aim for the default method: smallest share of successes where a calibration is expected to work."""
AIM_SILENT = 0.01
"""Aim for the default method: largest share of silent failures elsewhere."""
WORKS = 0.9
"""Share of successes from which a method is said to work at a value of an axis."""
SIGNIFICANT = 0.05
"""Significance level of the comparison of the default with the paper's method."""


@dataclass(frozen=True)
class WorseThanPaper:
    """Value of an axis at which the default method succeeds less often than the paper's method."""

    axis: Axis
    """Axis of the study that the value belongs to."""
    value: Any
    """Value of the condition field that the axis varies."""
    default: Rate
    """Number of successes of the default method."""
    paper: Rate
    """Number of successes of the paper's method."""
    p_value: float
    """One-sided p-value of the exact McNemar test; both methods ran on the same recordings."""

    @property
    def significant(self) -> bool:
        """Whether the difference is significant."""
        return self.p_value < SIGNIFICANT

    def to_json(self) -> dict[str, Any]:
        """Return the comparison as JSON data."""
        return {
            "axis": self.axis.name,
            "value": self.value,
            "default": self.default.to_json(),
            "paper": self.paper.to_json(),
            "p_value": self.p_value,
            "significant": self.significant,
        }


@dataclass(frozen=True)
class Aims:
    """Aims for the default method, and the measured rates. A cell that several axes share counts once."""

    inside: Rate
    """Rate of successes where a calibration is expected to work."""
    outside: Rate
    """Rate of silent failures where a calibration is not expected to work."""
    worse: tuple[WorseThanPaper, ...]
    """Values at which the default method succeeds less often than the paper's method, by increasing p-value."""

    @property
    def holds(self) -> dict[str, bool]:
        """Whether each aim is reached, by name."""
        return {
            "success inside": self.inside.total > 0 and self.inside.share >= AIM_SUCCESS,
            "silent failures outside": not self.outside.total or self.outside.share <= AIM_SILENT,
            "nowhere worse than the paper": not any(w.significant for w in self.worse),
        }

    def to_json(self) -> dict[str, Any]:
        """Return the aims as JSON data."""
        return {
            "success inside": self.inside.to_json(),
            "silent failures outside": self.outside.to_json(),
            "worse than the paper": [w.to_json() for w in self.worse],
            "holds": self.holds,
        }

    def lines(self) -> list[str]:
        """Return the aims and the measured rates as lines of text."""
        words = ["holds" if holds else "MISSED" for holds in self.holds.values()]
        inside, outside, paper = words
        worse_at = []
        for worse in self.worse:
            if worse.significant:
                worse_at.append(f"{worse.axis.name} {value_label(worse.axis, worse.value)}")
        where = ", ".join(worse_at) or "no value"
        return [
            f"default: successes inside the sensible region, at least {percent(AIM_SUCCESS)}: {self.inside}: {inside}",
            f"default: silent failures outside of it, at most {percent(AIM_SILENT)}: {self.outside}: {outside}",
            f"default: nowhere worse than the paper: significantly worse at {where}, "
            f"fewer successes at {len(self.worse)} values: {paper}",
        ]


STATED_HEADINGS = ("recordings", "quantity", "within 1", "within 2", "within 3 stated deviations")
"""Headings of :meth:`StatedDeviations.row`."""


@dataclass(frozen=True)
class StatedDeviations:
    """How often the truth lies within the standard deviations that the default method states."""

    where: str
    """Recordings that count: random combinations of mild troubles, or the sensible range of the axes."""
    quantity: str
    """Quantity, one of :data:`amiwarp.studies.stability.judging.STATED`."""
    within: tuple[Rate, ...]
    """Number of answers with the truth within one, two and three standard deviations."""

    def row(self) -> tuple[str, ...]:
        """Return the values as a row of a table."""
        return (self.where, self.quantity, *map(str, self.within))

    def to_json(self) -> dict[str, Any]:
        """Return the values as JSON data."""
        return {
            "where": self.where,
            "quantity": self.quantity,
            "within": [rate.to_json() for rate in self.within],
        }


def stated_deviations(cells: Iterable[Stored], default: str | None) -> tuple[StatedDeviations, ...]:
    """Return how honest the stated deviations are: for random combinations of troubles, and for the sensible range."""
    found: dict[str, dict[str, list[float]]] = {}
    for stored in cells:
        result = stored.results.get(default or "")
        cell = stored.cell
        drawn = cell.condition == mild(cell.seed)
        if result is None or not (drawn or sensible(cell.condition, stored.events)):
            continue
        of_where = found.setdefault("random combinations" if drawn else "sensible range", {})
        for name, value in result.deviations.items():
            of_where.setdefault(name, []).append(value)
    stated = []
    for where, of_where in sorted(found.items()):
        for name, values in of_where.items():
            within = []
            for limit in (1.0, 2.0, 3.0):
                within.append(Rate(sum(value <= limit for value in values), len(values)))
            stated.append(StatedDeviations(where, name, tuple(within)))
    return tuple(stated)


def aims_of(cells: Iterable[Stored], default: str | None, worse: Sequence[WorseThanPaper]) -> Aims:
    """Return the aims for the default method with the measured rates."""
    inside: list[Outcome] = []
    outside: list[Outcome] = []
    for stored in cells:
        result = stored.results.get(default or "")
        if result is not None and result.outcome in JUDGED:
            here = inside if sensible(stored.cell.condition, stored.events) else outside
            here.append(result.outcome)
    successes = Rate(inside.count(Outcome.SUCCESS), len(inside))
    silent_failures = Rate(outside.count(Outcome.SILENT), len(outside))
    clearest_first = sorted(worse, key=lambda comparison: comparison.p_value)
    return Aims(successes, silent_failures, tuple(clearest_first))


def worse_than_paper(
    axis: Axis, value: Any, stored_cells: Sequence[Stored], names: dict[str, str]
) -> list[WorseThanPaper]:
    """Compare the default with the paper's method at one value of an axis, by McNemar's test.

    Source: McNemar, "Note on the sampling error of the difference between correlated proportions", Psychometrika 1947.
    """
    if not {DEFAULT, PAPER} <= names.keys():
        return []
    # Whether the default and the paper's method succeed, for each recording on which both ran
    both = []
    for stored in stored_cells:
        default_result = stored.results.get(names[DEFAULT])
        paper_result = stored.results.get(names[PAPER])
        if default_result is None or paper_result is None:
            continue
        pair = (default_result.outcome, paper_result.outcome)
        if Outcome.FAILED not in pair:
            both.append((pair[0] is Outcome.SUCCESS, pair[1] is Outcome.SUCCESS))

    lost = sum(paper and not default for default, paper in both)
    won = sum(default and not paper for default, paper in both)
    if lost <= won:
        return []
    by_default = Rate(sum(default for default, _ in both), len(both))
    by_paper = Rate(sum(paper for _, paper in both), len(both))
    p_value = float(binomtest(lost, lost + won, 0.5, alternative="greater").pvalue)
    return [WorseThanPaper(axis, value, by_default, by_paper, p_value)]
