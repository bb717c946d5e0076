"""Points of the stability study: rates and errors of one method at one value of an axis, and their text."""

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.stats import binomtest

from amiwarp.studies.stability.axes import Axis
from amiwarp.studies.stability.judging import Outcome, Result

JUDGED = (Outcome.SUCCESS, Outcome.NAMED, Outcome.REFUSAL, Outcome.SILENT)
"""Outcomes that say something of a method, of which the rates are."""
QUANTILES = (5, 25, 50, 75, 95)
"""Quantiles of the model error that are reported [%]."""


@dataclass(frozen=True)
class Rate:
    """Number of calibrations with some outcome, out of a total."""

    count: int
    """Number of calibrations with the outcome."""
    total: int
    """Total number of calibrations."""

    @property
    def share(self) -> float:
        """Share of the calibrations with the outcome; NaN for a total of 0."""
        return self.count / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % confidence interval of the share."""
        return _wilson(self.count, self.total)

    def __str__(self) -> str:
        if not self.total:
            return "0 of 0"
        low, high = self.interval
        return f"{percent(self.share)} ({percent(low)} to {percent(high)}; {self.count:,} of {self.total:,})"

    def to_json(self) -> dict[str, Any]:
        """Return count, total, share and confidence interval as JSON data."""
        low, high = self.interval
        share = round(self.share, 5) if self.total else None
        return {
            "count": self.count,
            "total": self.total,
            "share": share,
            "low": round(low, 5),
            "high": round(high, 5),
        }


@cache
def _wilson(count: int, total: int) -> tuple[float, float]:
    """Return Wilson's 95 % confidence interval of ``count / total``."""
    if not total:
        return 0.0, 1.0
    interval = binomtest(count, total).proportion_ci(confidence_level=0.95, method="wilson")
    return float(interval.low), float(interval.high)


@dataclass(frozen=True)
class AxisPoint:
    """Results of one method at one value of an axis of the study, over all seeds."""

    axis: Axis
    """Axis of the study to which the point belongs."""
    value: Any
    """Value of the condition field that the axis varies."""
    method: str
    """Name of the calibration method."""
    results: tuple[Result, ...]
    """Results of the method for all seeds, except those where the study failed."""
    failed: int = 0
    """Number of recordings for which the study failed. They are part of no rate."""

    @property
    def errors(self) -> list[float]:
        """Model errors of all calibrations that were not refused [px rms]."""
        return [r.error_px for r in self.results if r.error_px is not None]

    @property
    def limit_px(self) -> float:
        """Median over the seeds of the largest model error that counts as a success [px rms]; NaN without results."""
        return _median([r.limit_px for r in self.results])

    @property
    def seconds(self) -> float:
        """Median time of a calibration [s]; NaN without results."""
        return _median([r.seconds for r in self.results])

    @property
    def quantiles(self) -> dict[int, float]:
        """Quantiles of the model error [px rms], by per cent; empty if every recording was refused."""
        errors = self.errors
        if not errors:
            return {}
        found = np.percentile(errors, QUANTILES)
        return dict(zip(QUANTILES, map(float, found), strict=True))

    def common_message(self, *outcomes: Outcome) -> str:
        """Return the most frequent message of the results with an outcome; empty if there is none."""
        return most_common_message(r.message for r in self.results if r.outcome in outcomes)

    def rate(self, outcome: Outcome) -> Rate:
        """Return how many of the results have an outcome."""
        return Rate(sum(r.outcome is outcome for r in self.results), len(self.results))

    def to_json(self) -> dict[str, Any]:
        """Return the point as JSON data."""
        rates = {}
        messages = {}
        for outcome in JUDGED:
            name = outcome.name.lower()
            rates[name] = self.rate(outcome).to_json()
            message = self.common_message(outcome)
            if message:
                messages[name] = message
        errors = {f"{share} %": float(f"{px:.4g}") for share, px in self.quantiles.items()}
        return {
            "axis": self.axis.name,
            "field": self.axis.field,
            "value": self.value,
            "unit": self.axis.unit,
            "method": self.method,
            **rates,
            "failed": self.failed,
            "error_px": errors,
            "limit_px": _rounded(self.limit_px),
            "seconds": _rounded(self.seconds),
            "messages": messages,
        }


def _median(values: Sequence[float]) -> float:
    """Return the median of values; NaN if there are none."""
    return float(np.median(values)) if values else math.nan


def _rounded(value: float) -> float | None:
    """Return a value with four digits for JSON; None for NaN."""
    return None if math.isnan(value) else float(f"{value:.4g}")


def most_common_message(messages: Iterable[str]) -> str:
    """Return the most frequent message, without the recording's name.

    Messages that differ only in numbers count as one.
    """
    texts = [message.replace("simulation: ", "") for message in messages if message]
    if not texts:
        return ""
    kinds = [re.sub(r"-?\d[\d.,]*", "#", text) for text in texts]
    ((most_common, _),) = Counter(kinds).most_common(1)
    return texts[kinds.index(most_common)]


def value_label(axis: Axis, value: Any) -> str:
    """Return a value of an axis as text; shares in per cent."""
    if isinstance(value, bool):
        return "wrong" if value else "right"
    if isinstance(value, str):
        return value
    if axis.field == "window_events" and value == 0:
        return "all"
    if axis.unit.startswith(("of all", "of the", "relative")):
        return f"{100 * value:.10g} %"
    return f"{value:,.10g}"


def axis_label(axis: Axis) -> str:
    """Return name and unit of an axis."""
    return f"{axis.name} [{axis.unit}]" if axis.unit else axis.name


def percent(share: float) -> str:
    """Return a share as text in per cent."""
    return f"{100 * share:.3g} %"
