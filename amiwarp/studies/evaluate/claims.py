"""The paper's claims, and the one rule by which a verdict follows from results: an interval of paired differences."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import special

LEVEL = 0.95
"""Confidence of the intervals."""
NO_RESULT = "no result"
"""Text for a claim without values."""

Differences = Mapping[str, Mapping[int, float]]
"""Differences, or single values, by case (such as a scene) and seed."""


class Verdict(enum.StrEnum):
    """Verdict on a claim."""

    REPRODUCED = "reproduced"
    """The whole interval lies where the claim says."""
    NOT_REPRODUCED = "not reproduced"
    """The whole interval lies elsewhere."""
    UNDECIDED = "undecided"
    """The interval spans the limit, or there are fewer than two seeds."""
    NOT_TESTABLE = "not testable"
    """There are no results to judge it by, or the paper leaves open what decides it."""


@dataclass(frozen=True)
class PaperClaim:
    """Claim of the paper, in our words and no further than it goes."""

    text: str
    """What the paper says."""
    value: str = "no number"
    """Its number."""
    elsewhere: str = ""
    """Answer to a claim that no evaluation tests."""


PAPER = {
    1: PaperClaim(
        "The event stream is more uniform, and depends less on the camera's motion (static scene).",
        "variance 0.196, S-EV 0.425",
    ),
    2: PaperClaim(
        "Event images are more complete and more stable: their ODS-F is higher and steadier, their entropy "
        "is higher."
    ),
    3: PaperClaim("Motion along most edges hurts the S-EV, and not the AMI-EV."),
    4: PaperClaim(
        "Reconstructed video is better at rest, where the S-EV fades, and better in motion.",
        "NIQE, curves",
    ),
    5: PaperClaim(
        "In rare moments the motions of prism and camera cancel: a small degradation.", "film"
    ),
    6: PaperClaim(
        "More corners are detected and tracked than by the S-EV and, in hard light, by a standard camera. "
        "They live substantially longer. Their error does not depend on the camera's motion.",
        "error about 1.5 px",
    ),
    7: PaperClaim(
        "The update rate of S-EV and AMI-EV is far above the update rate of standard cameras."
    ),
    8: PaperClaim(
        "The prism's motion does not influence the segmentation of moving bodies; S-EV and AMI-EV are better "
        "than a standard camera.",
        "pictures",
    ),
    9: PaperClaim(
        "Human pose is better than with the S-EV at every rate of pictures, and the rate can be much higher.",
        "PDJ and IoU, curves",
    ),
    10: PaperClaim("Optical flow of static objects gets slightly worse.", "+0.19 px"),
    11: PaperClaim("Events are compensated with a small error, in real time.", "1.5 to 2.0 px"),
    12: PaperClaim("The circle's error is within 2 px in a field of view of 90°.", "2 px"),
    13: PaperClaim(
        "The error surges dramatically above 720 rpm at 0.5° and 1.0°, because of small synchronisation "
        "errors, and more with a larger apex."
    ),
    14: PaperClaim(
        "A prism of 2° gives the most data, but its compensation error is too high to be practical."
    ),
    15: PaperClaim(
        "A larger apex and a higher speed give more events and more error; a quarter turn must fit the "
        "window.",
        "455 rpm at least",
    ),
    16: PaperClaim(
        "Recordings of 2 s calibrate well; the optimum is unique, and the cost is convex in a domain.",
        "costs 29,569 and 2,382",
    ),
    17: PaperClaim(
        "Future: adaptive speed, no moving parts, an ellipse, polarity, the motion used without moving "
        "events, a learned compensation.",
        "–",
        "no claim to test: see 'The paper's results' in the documentation for what exists",
    ),
}
"""The paper's claims by their number here."""


@dataclass(frozen=True)
class Interval:
    """Mean over the seeds with its :data:`LEVEL` confidence interval, by Student's t."""

    mean: float
    """Mean."""
    low: float
    """Lower end; -inf with one seed."""
    high: float
    """Upper end; inf with one seed."""
    seeds: int
    """Number of seeds."""

    @classmethod
    def of(cls, values: Sequence[float]) -> Interval:
        """Return the interval of the mean of independent values, one for each seed."""
        seeds = len(values)
        mean = float(np.mean(values))
        if seeds < 2:
            return cls(mean, -math.inf, math.inf, seeds)
        quantile = special.stdtrit(seeds - 1, 0.5 + LEVEL / 2.0)
        half = float(quantile * np.std(values, ddof=1) / math.sqrt(seeds))
        return cls(mean, mean - half, mean + half, seeds)

    def verdict(self, above: float, below: float) -> Verdict:
        """Return the verdict on the claim that the mean is larger than ``above`` and smaller than ``below``."""
        if self.low > above and self.high < below:
            return Verdict.REPRODUCED
        if self.high < above or self.low > below:
            return Verdict.NOT_REPRODUCED
        return Verdict.UNDECIDED

    def text(self, unit: str = "") -> str:
        """Return the mean, the interval and the number of seeds in words."""
        ends = f" [{self.low:.3g}, {self.high:.3g}]" if self.seeds > 1 else ""
        seeds = "1 seed" if self.seeds == 1 else f"{self.seeds} seeds"
        return f"{self.mean:.3g}{ends}{unit and ' '}{unit}, {seeds}"


@dataclass(frozen=True)
class Claim:
    """Part of a claim of the paper, or a check of its robustness, with the verdict that follows from the results."""

    number: int | None
    """Number in :data:`PAPER`; None for a check of ours, which the paper does not make."""
    text: str
    """What is tested."""
    ours: str
    """Our value."""
    verdict: Verdict
    """Verdict."""
    rule: str
    """Rule by which the verdict follows from our results."""
    cases: dict[str, str] = field(default_factory=dict)
    """Our value in each case, if there are several."""

    @property
    def paper(self) -> str:
        """Value in the paper."""
        return "not in the paper" if self.number is None else PAPER[self.number].value


def judge(
    number: int | None,
    text: str,
    values: Differences,
    quantity: str,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    unit: str = "",
) -> Claim:
    """Return the claim that a mean over the seeds lies above a limit, below one, or between two.

    A seed's value is the mean over its cases, so that seeds are independent. Every seed runs all cases; one that lacks
    the value of a case, as of a refused calibration, is counted in the text. "No worse by more than m" is
    ``above=-m`` where larger is better. ``quantity``: the value in words.
    """
    limits = [
        f"{relation} {limit:g}"
        for relation, limit in (("above", above), ("below", below))
        if math.isfinite(limit)
    ]
    rule = f"the 95 % interval over the seeds of {quantity} lies {' and '.join(limits)}{unit and ' '}{unit}"
    by_seed: dict[int, list[float]] = {}
    for of_case in values.values():
        for seed, value in of_case.items():
            by_seed.setdefault(seed, []).append(value)
    if not by_seed:
        return Claim(number, text, NO_RESULT, Verdict.NOT_TESTABLE, rule)
    interval = Interval.of([float(np.mean(of_seed)) for of_seed in by_seed.values()])
    verdict = interval.verdict(above, below)
    ours = interval.text(unit)

    # Cases in which the verdict alone would be another one
    intervals = {
        case: Interval.of(list(of_case.values())) for case, of_case in values.items() if of_case
    }
    for other in (Verdict.REPRODUCED, Verdict.NOT_REPRODUCED):
        cases = [case for case, mean in intervals.items() if mean.verdict(above, below) is other]
        if cases and verdict is not other:
            ours += f"; {other} in {' and '.join(cases)}"

    incomplete = sum(len(of_seed) < len(intervals) for of_seed in by_seed.values())
    if incomplete:
        ours += f"; seeds that lack a case: {incomplete}"
    texts = {case: mean.text(unit) for case, mean in intervals.items()}
    return Claim(number, text, ours, verdict, rule, texts if len(texts) > 1 else {})


def judge_number(
    number: int | None, text: str, value: float, quantity: str, *, below: float, unit: str
) -> Claim:
    """Return the claim that a number lies below a limit, which is computed without recordings and has no spread."""
    verdict = Verdict.REPRODUCED if value < below else Verdict.NOT_REPRODUCED
    rule = f"{quantity} is below {below:g} {unit}"
    return Claim(number, text, f"{value:.3g} {unit}, computed", verdict, rule)


def untestable(number: int, text: str, reason: str) -> Claim:
    """Return a claim that cannot be tested, with the reason."""
    return Claim(number, text, "–", Verdict.NOT_TESTABLE, reason)


def untestable_as_stated(
    number: int, text: str, missing: str, readings: Sequence[Claim]
) -> list[Claim]:
    """Return a claim that cannot be tested as it is stated, and its readings, which are checks with their verdicts.

    ``missing``: what the paper does not state.
    """
    judged = [reading for reading in readings if reading.verdict is not Verdict.NOT_TESTABLE]
    hold = sum(reading.verdict is Verdict.REPRODUCED for reading in judged)
    ours = f"{hold} of {len(judged)} readings hold" if judged else NO_RESULT
    reason = f"the paper does not state {missing}, which decides; its readings are checks"
    return [Claim(number, text, ours, Verdict.NOT_TESTABLE, reason), *readings]


def differences(
    rows: Sequence[Mapping[str, Any]],
    value: str,
    first: Mapping[str, Any],
    second: Mapping[str, Any] | None = None,
    *,
    by: Sequence[str] = ("scene", "camera"),
    relative: bool = False,
) -> dict[str, dict[int, float]]:
    """Return the difference of a column between two kinds of rows, by case and seed.

    ``first`` and ``second``: values of columns that the rows of either kind have, such as their stream. Rows of one
    kind, case and seed are averaged. Without ``second``, the values of the first kind are returned. ``by``: columns
    whose values make a case. With ``relative``, the difference is divided by the second value; pairs in which that is 0
    are left out, as are values that are None or not finite.
    """
    means = [_means(rows, value, kind, by) for kind in (first, second) if kind is not None]
    by_case: dict[str, dict[int, float]] = {}
    for (case, seed), ours in means[0].items():
        theirs = 0.0 if second is None else means[-1].get((case, seed))
        if theirs is None or (relative and theirs == 0.0):
            continue
        difference = ours - theirs
        by_case.setdefault(case, {})[seed] = difference / theirs if relative else difference
    return by_case


def _means(
    rows: Sequence[Mapping[str, Any]], value: str, kind: Mapping[str, Any], by: Sequence[str]
) -> dict[tuple[str, int], float]:
    """Return the mean of a column over the rows of a kind, by case and seed."""
    groups: dict[tuple[str, int], list[float]] = {}
    for row in rows:
        measured = row.get(value)
        if measured is None or not math.isfinite(measured):
            continue
        if all(row[name] == wanted for name, wanted in kind.items()):
            case = ", ".join(str(row[name]) for name in by)
            groups.setdefault((case, row["seed"]), []).append(float(measured))
    return {key: float(np.mean(values)) for key, values in groups.items()}


def ranges(
    rows: Sequence[Mapping[str, Any]], value: str, over: str = "camera"
) -> list[dict[str, Any]]:
    """Return the range of a column over the values of another one, for each scene, seed and stream, as rows.

    Those with fewer than two values are left out.
    """
    groups: dict[tuple[Any, ...], dict[Any, list[float]]] = {}
    for row in rows:
        if row.get(value) is None:
            continue
        of_case = groups.setdefault((row["scene"], row["seed"], row["stream"]), {})
        of_case.setdefault(row[over], []).append(float(row[value]))

    ranges_of_cases = []
    for (scene, seed, stream), values in groups.items():
        if len(values) > 1:
            means = [np.mean(several) for several in values.values()]
            case = {"scene": scene, "seed": seed, "stream": stream}
            ranges_of_cases.append(case | {value: float(np.ptp(means))})
    return ranges_of_cases
