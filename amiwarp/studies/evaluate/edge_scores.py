"""Scores of event images as edges, at the best threshold of each set of recordings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from amiwarp.studies.evaluate.edge_agreement import Counts, best_f
from amiwarp.studies.evaluate.results import CellResult, rows_of

ONE_THRESHOLD_COLUMNS = ("scene", "camera", "stream", "truth", "tolerance")
"""Columns whose values make a set of images with one best threshold."""


def as_counts(row: dict[str, Any], images: dict[str, Any], which: str = "matched") -> Counts:
    """Return the counts of a row of matches and of the summary of its images; ``which`` may be "chance"."""
    matched = np.array(row[which])
    found = np.array(images["found"])
    return Counts(matched, found, np.full(len(found), row["true"]))


@dataclass(frozen=True)
class _Member:
    """Recording of a set."""

    seed: int
    """Seed."""
    counts: Counts
    """Counts of matches."""
    chance: Counts
    """The same for images turned by 180 deg."""
    entropy: list[float]
    """Entropy over the thresholds."""


def _sets(results: Sequence[CellResult]) -> dict[tuple[Any, ...], list[_Member]]:
    """Return the recordings of each scene, motion, stream, kind of truth and tolerance."""
    images = {(_recording(row), row["stream"]): row for row in rows_of(results, "images")}
    sets: dict[tuple[Any, ...], list[_Member]] = {}
    for row in rows_of(results, "rows"):
        summary = images[_recording(row), row["stream"]]
        member = _Member(
            row["seed"],
            as_counts(row, summary),
            as_counts(row, summary, "chance"),
            summary["entropy"],
        )
        sets.setdefault(tuple(row[column] for column in ONE_THRESHOLD_COLUMNS), []).append(member)
    return sets


def _at_best_threshold(members: Sequence[Counts]) -> tuple[Counts, int]:
    """Return the counts of a set, and the index of its best threshold."""
    matched = np.sum([member.matched for member in members], axis=0)
    found = np.sum([member.found for member in members], axis=0)
    true = np.sum([member.true for member in members], axis=0)
    total = Counts(matched, found, true)
    best, _ = best_f(total)
    return total, best


def scores(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """Return the ODS-F of each world, motion, stream, kind of truth and tolerance, with its precision and recall."""
    rows = []
    for key, members in _sets(results).items():
        total, best = _at_best_threshold([member.counts for member in members])
        chance, best_of_chance = _at_best_threshold([member.chance for member in members])
        score = float(total.f_score[best])
        score_of_chance = float(chance.f_score[best_of_chance])
        row = {
            **dict(zip(ONE_THRESHOLD_COLUMNS, key, strict=True)),
            "f": score,
            "chance": score_of_chance,
            "margin": score - score_of_chance,
            "std": float(np.std([member.counts.f_score[best] for member in members])),
            "precision": float(total.precision[best]),
            "seeds": len(members),
            "recall": float(total.recall[best]),
            "entropy": float(np.mean([member.entropy[best] for member in members])),
        }
        rows.append(row)
    return rows


def scores_by_seed(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """Return score, margin over chance and entropy of each recording, at the best thresholds of its set."""
    rows = []
    for key, members in _sets(results).items():
        _, best = _at_best_threshold([member.counts for member in members])
        _, best_of_chance = _at_best_threshold([member.chance for member in members])
        known = dict(zip(ONE_THRESHOLD_COLUMNS, key, strict=True))
        for member in members:
            score = member.counts.f_score[best]
            by_chance = member.chance.f_score[best_of_chance]
            row = {
                **known,
                "seed": member.seed,
                "f": float(score),
                "margin": float(score - by_chance),
                "entropy": member.entropy[best],
            }
            rows.append(row)
    return rows


def _recording(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["scene"], row["camera"], row["seed"]
