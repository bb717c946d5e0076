"""Verdicts on the paper's claims: paired differences, their interval, and limits, with made-up numbers."""

import importlib
import json
import math
import re

import numpy as np
import pytest

from amiwarp.studies.evaluate import Verdict, judge
from amiwarp.studies.evaluate.claims import (
    NO_RESULT,
    PAPER,
    Interval,
    differences,
    judge_number,
    ranges,
    untestable,
    untestable_as_stated,
)
from tests import ROOT

RESULTS = ROOT / "benchmarks" / "results" / "evaluate"
"""Folder of the stored reports."""

T_975 = {1: 12.7062, 2: 4.30265, 4: 2.77645, 9: 2.26216}
"""Quantiles of Student's t for a two-sided interval of 95 %, by degrees of freedom, as printed tables have them."""


@pytest.mark.parametrize("seeds", [2, 3, 5, 10])
def test_an_interval_is_that_of_student(seeds: int) -> None:
    values = np.random.default_rng(seeds).normal(0.3, 1.2, seeds)
    deviations = values - values.sum() / seeds
    error = math.sqrt((deviations**2).sum() / (seeds - 1) / seeds)
    found = Interval.of(values.tolist())
    expected = [values.mean() - T_975[seeds - 1] * error, values.mean() + T_975[seeds - 1] * error]
    np.testing.assert_allclose([found.low, found.high], expected, rtol=1e-5)
    assert found.seeds == seeds


def test_an_interval_holds_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    held = [
        found.low < 0.5 < found.high
        for found in (Interval.of(rng.normal(0.5, 2.0, 6)) for _ in range(2000))
    ]
    assert 0.935 < np.mean(held) < 0.965


@pytest.mark.parametrize(
    ("low", "high", "above", "below", "verdict"),
    [
        (0.1, 0.3, 0.0, math.inf, Verdict.REPRODUCED),
        (-0.3, -0.1, 0.0, math.inf, Verdict.NOT_REPRODUCED),
        (-0.1, 0.3, 0.0, math.inf, Verdict.UNDECIDED),
        (-0.04, 0.01, -0.05, math.inf, Verdict.REPRODUCED),  # no worse by 0.05
        (-0.06, 0.01, -0.05, math.inf, Verdict.UNDECIDED),
        (-0.2, -0.06, -0.05, math.inf, Verdict.NOT_REPRODUCED),
        (0.1, 0.18, -math.inf, 0.19, Verdict.REPRODUCED),
        (1.2, 1.9, 1.0, 2.0, Verdict.REPRODUCED),  # about 1.5
        (0.9, 1.9, 1.0, 2.0, Verdict.UNDECIDED),
        (2.1, 2.9, 1.0, 2.0, Verdict.NOT_REPRODUCED),
        (-math.inf, math.inf, 0.0, math.inf, Verdict.UNDECIDED),
    ],
)
def test_verdicts(low: float, high: float, above: float, below: float, verdict: Verdict) -> None:
    assert Interval((low + high) / 2.0, low, high, 5).verdict(above, below) is verdict


def rows(scene: str, **scores: list[float | None]) -> list[dict[str, object]]:
    """Return one row per stream and seed with its score."""
    return [{"scene": scene, "camera": "fast", "seed": seed, "stream": stream, "score": value}
            for stream, values in scores.items() for seed, value in enumerate(values)]  # fmt: skip


def test_pairs_are_those_of_one_seed_and_case() -> None:
    """The spread over the seeds is larger than the difference, which pairs alone show."""
    room = rows("room", ami=[1.1, 5.1, 9.2, None], sev=[1.0, 5.0, 9.0, 2.0])
    desk = rows("desk", ami=[2.3, 4.3, None, 6.3], sev=[2.0, 4.0, 3.0, 6.0])
    found = differences(room + desk, "score", {"stream": "ami"}, {"stream": "sev"})
    assert {case: list(values) for case, values in found.items()} == {
        "room, fast": [0, 1, 2],
        "desk, fast": [0, 1, 3],
    }
    claim = judge(1, "More.", found, "the score", above=0.0)
    means = [0.2, 0.2, 0.2, 0.3]  # the mean over the cases that a seed has
    half = 3.18245 * np.std(means, ddof=1) / 2.0
    ends = f"[{np.mean(means) - half:.3g}, {np.mean(means) + half:.3g}]"
    assert claim.ours == f"{np.mean(means):.3g} {ends}, 4 seeds; seeds that lack a case: 2"
    assert claim.verdict is Verdict.REPRODUCED
    assert claim.rule == "the 95 % interval over the seeds of the score lies above 0"
    assert claim.paper == PAPER[1].value
    assert list(claim.cases) == ["room, fast", "desk, fast"]
    assert claim.cases["desk, fast"].startswith("0.3 [0.3, 0.3], 3 seeds")


def test_cases_that_say_otherwise_are_named() -> None:
    claim = judge(1, "More.", {"room": {1: 5.0, 2: 5.1}, "desk": {1: -1.0, 2: -1.1}, "garden": {1: 1.0, 2: 0.9}},
                  "the score", above=0.0)  # fmt: skip
    assert claim.verdict is Verdict.REPRODUCED
    assert claim.ours.endswith("2 seeds; not reproduced in desk")


def test_relative_differences_and_levels() -> None:
    given = rows("room", ami=[3.0, 2.0, 5.0], sev=[2.0, 0.0, 4.0])
    relative = differences(given, "score", {"stream": "ami"}, {"stream": "sev"}, relative=True)
    assert relative == {"room, fast": {0: 0.5, 2: 0.25}}
    assert differences(given, "score", {"stream": "ami"}, by=("scene",)) == {
        "room": {0: 3.0, 1: 2.0, 2: 5.0}
    }
    twice = differences(given + given, "score", {"stream": "ami"}, {"stream": "sev"})
    # Rows of one seed are no further seeds
    assert twice == {"room, fast": {0: 1.0, 1: 2.0, 2: 1.0}}


def test_ranges_over_the_motions() -> None:
    given = [{"scene": "room", "seed": 1, "stream": "ami", "camera": camera, "v": v}
             for camera, v in (("still", 1.0), ("fast", 4.0), ("fast", 2.0), ("fast", None))]  # fmt: skip
    assert ranges(given, "v") == [{"scene": "room", "seed": 1, "stream": "ami", "v": 2.0}]
    assert ranges(given[:1], "v") == []


def test_claims_without_results() -> None:
    assert judge(None, "", {"room": {}}, "the score", above=0.0).verdict is Verdict.NOT_TESTABLE
    assert judge(None, "", {"room": {1: 9.0}}, "the score", above=0.0).verdict is Verdict.UNDECIDED
    assert judge(None, "", {}, "the score", above=0.0).paper == "not in the paper"
    assert (
        judge_number(12, "", 1.9, "the error", below=2.0, unit="px").verdict is Verdict.REPRODUCED
    )
    assert judge_number(12, "", 2.1, "the error", below=2.0, unit="px").ours == "2.1 px, computed"
    assert untestable(9, "Pose.", "no network").verdict is Verdict.NOT_TESTABLE


def test_a_claim_that_leaves_open_what_decides_counts_its_readings() -> None:
    readings = [
        judge_number(None, f"Within 2 px at {at}.", at, "the error", below=2.0, unit="px")
        for at in (1.0, 1.5, 3.0)
    ]
    readings.append(judge(None, "Without results.", {}, "the error", below=2.0))
    claim, *given = untestable_as_stated(12, "Within 2 px.", "the place", readings)
    assert (claim.number, claim.verdict, claim.ours) == (
        12,
        Verdict.NOT_TESTABLE,
        "2 of 3 readings hold",
    )
    assert (
        claim.rule == "the paper does not state the place, which decides; its readings are checks"
    )
    assert given == readings
    assert untestable_as_stated(12, "", "", readings[3:])[0].ours == NO_RESULT


@pytest.mark.parametrize("name", ["cpu", "gpu"])
def test_stored_reports_state_claims_as_the_program_does(name: str) -> None:
    report = json.loads((RESULTS / f"{name}.json").read_text())
    for section in report["evaluations"]:
        evaluation = importlib.import_module(f"amiwarp.studies.evaluate.{section['name']}")
        stored = {(c["number"], c["text"], c["rule"]) for c in section["claims"]}
        assert {(c.number, c.text, c.rule) for c in evaluation.claims([])} <= stored
        for at, claim in enumerate(section["claims"]):
            found = re.fullmatch(r"(\d+) of (\d+) readings hold", claim["ours"])
            if found:
                verdicts = [
                    c["verdict"] for c in section["claims"][at + 1 : at + 1 + int(found[2])]
                ]
                assert verdicts.count("reproduced") == int(found[1])


def test_the_paper_has_seventeen_claims() -> None:
    assert list(PAPER) == list(range(1, 18))
