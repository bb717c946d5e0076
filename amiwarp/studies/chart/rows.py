"""Rows of the charts: one measured setting each, and the rows that no other row beats in both speed and error."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

EQUAL_TIME_SHARE = 0.05
"""Relative difference of times below which they are considered equal, because times vary this much between runs."""
CLEARLY_FASTER = 0.7
"""Ratio of times that decides whether to repeat a measurement.

A row cannot reach the Pareto front by repeats if another row takes less than this share of its time and has no larger
error.
"""
EQUAL_ERROR_PX = 0.003
"""Difference of errors below which they are considered equal [px], because another seed of the noise could reverse
their order."""


@dataclass(frozen=True)
class Row:
    """One measured setting, with speed and error of the same run."""

    chart: str
    """Name of the chart: compensation or calibration."""
    job: str
    """Name of the job. Rows of one job do the same work and share one front."""
    label: str
    """Name of the setting in the chart."""
    family: str
    """Family of the setting, shown by the colour of its point."""
    mark: str
    """Kind of the setting, shown by the marker of its point."""
    settings: Mapping[str, Any]
    """Settings of the run, as JSON data."""
    events: int
    """Number of events of the recording, whichever share of them the setting uses."""
    seconds: float
    """Median time of the repeated runs, each divided by how slow the machine was in its round [s]."""
    spread: float
    """Difference of longest and shortest repeat, relative to ``seconds``."""
    repeats: int
    """Number of repeated runs."""
    error_px: float
    """Error of the result [px rms]."""
    image_error: float | None = None
    """Rms difference of the run's image from the float64 image, relative to the standard deviation of the float64
    image; None if the run makes no image."""
    default: bool = False
    """Whether the commands use this setting by default."""
    comparable: bool = True
    """False for settings that add noise or need a guess. These are not part of a Pareto front."""

    @property
    def mev_per_s(self) -> float:
        """Speed [million events of the recording per second]."""
        return self.events / self.seconds / 1e6

    @property
    def cost(self) -> float:
        """Run time per event [s]."""
        return self.seconds / self.events


def front(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the Pareto front, fastest first: no other row is faster and at least as accurate."""
    best = float("inf")
    chosen = []
    comparable = [row for row in rows if row.comparable]
    for row in sorted(comparable, key=lambda row: (row.cost, row.error_px)):
        if row.error_px < best:
            best = row.error_px
            chosen.append(row)
    return chosen


def fronts(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Yield the name of each job with the rows on its Pareto front."""
    for job in dict.fromkeys(row.job for row in rows):
        yield job, front([row for row in rows if row.job == job])


def told_apart(chosen: Sequence[Row]) -> list[Row]:
    """Return the rows of a Pareto front that are clearly faster than the next more accurate row, and the default.

    The fastest row comes first.
    """
    kept: list[Row] = []
    for row in reversed(chosen):
        if not kept or row.default or row.cost < kept[-1].cost * (1.0 - EQUAL_TIME_SHARE):
            kept.append(row)
    return kept[::-1]


def beaten_by(row: Row, rows: Sequence[Row]) -> list[Row]:
    """Return rows of the same job that are clearly better than ``row`` in time or error and no worse in the other."""
    better = []
    for other in rows:
        if other.job != row.job or not other.comparable:
            continue
        faster = other.cost < row.cost * (1.0 - EQUAL_TIME_SHARE)
        slower = other.cost > row.cost
        nearer = other.error_px < row.error_px - EQUAL_ERROR_PX
        further = other.error_px > row.error_px
        if (faster and not further) or (nearer and not slower):
            better.append(other)
    return better


def near_front(rows: Sequence[Row | None]) -> list[bool]:
    """Return for each row whether repeated timing may put it on the Pareto front; always True for the default."""
    rivals = [row for row in rows if row is not None and row.comparable]

    def hopeful(row: Row) -> bool:
        for other in rivals:
            within_reach = other.cost > row.cost * CLEARLY_FASTER
            less_accurate = other.error_px > row.error_px
            if not (within_reach or less_accurate):
                return False
        return True

    return [row is not None and (row.default or hopeful(row)) for row in rows]


def fastest_within(rows: Sequence[Row], error_px: float) -> Row | None:
    """Return the fastest row with an error of at most ``error_px`` [px]; of rows of equal time, the most accurate."""
    within = [row for row in rows if row.comparable and row.error_px <= error_px]
    if not within:
        return None
    limit = min(row.cost for row in within) * (1.0 + EQUAL_TIME_SHARE)
    fast = [row for row in within if row.cost <= limit]
    return min(fast, key=lambda row: row.error_px)


def most_accurate_within(rows: Sequence[Row], seconds: float) -> Row | None:
    """Return the most accurate row with a time of at most ``seconds`` [s]; of rows of equal error, the fastest."""
    within = [row for row in rows if row.comparable and row.seconds <= seconds]
    if not within:
        return None
    limit = min(row.error_px for row in within) + EQUAL_ERROR_PX
    accurate = [row for row in within if row.error_px <= limit]
    return min(accurate, key=lambda row: row.cost)
