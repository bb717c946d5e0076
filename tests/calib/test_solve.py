"""All NLopt algorithms by name, their budgets and their failures."""

import gc
import weakref

import numpy as np
import pytest

from amiwarp import AmiwarpError
from amiwarp.calib import GLOBAL_ALGORITHMS, LOCAL_ALGORITHMS
from amiwarp.calib.nlopt_solver import maximise

LOW, HIGH = np.array([-10.0, -10.0]), np.array([10.0, 10.0])
PEAK = np.array([3.1, -2.3])


def hill(x: np.ndarray) -> float:
    """Return the height of a broad hill with ripples: several local maxima, the global one at PEAK."""
    d2 = float(np.sum((x - PEAK) ** 2))
    return float(np.exp(-d2 / 60.0) + 0.15 * np.exp(-d2 / 2.0) + 0.02 * np.cos(2.0 * d2**0.5))


@pytest.mark.parametrize("algorithm", GLOBAL_ALGORITHMS)
def test_global_algorithms_find_the_hill(algorithm: str) -> None:
    stage = maximise(
        hill,
        algorithm,
        low=LOW,
        high=HIGH,
        start=np.array([-5.0, 5.0]),
        evaluations=2000,
        tolerance=0.01,
        seed=1,
    )
    assert np.linalg.norm(stage.x - PEAK) < 1.0  # px: close enough for the local stage
    assert stage.evaluations <= 2000
    assert len(stage.scores) == len(stage.points) == stage.evaluations
    assert stage.score == stage.scores.max() == hill(stage.x)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"algorithm": "BOBYQA"}, "^algorithm is 'BOBYQA'"),
        ({"algorithm": "GN_MLSL", "inner": "BOBYQA"}, "^inner algorithm is 'BOBYQA'"),
        ({"algorithm": "GN_DIRECT", "inner": "BOBYQA"}, "^inner algorithm is 'BOBYQA'"),
    ],
)
def test_an_unknown_algorithm_is_answered_with_all_that_can_be_given(
    options: dict[str, str], what: str
) -> None:
    with pytest.raises(AmiwarpError, match=f"{what}; choose among .*LN_BOBYQA"):
        maximise(hill, low=LOW, high=HIGH, start=PEAK, evaluations=9, tolerance=0.1, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("algorithm", LOCAL_ALGORITHMS)
def test_local_algorithms_climb_it(algorithm: str) -> None:
    stage = maximise(
        hill,
        algorithm,
        low=LOW,
        high=HIGH,
        start=PEAK + 0.6,
        evaluations=400,
        tolerance=1e-4,
        step=0.3,
    )
    assert np.linalg.norm(stage.x - PEAK) < 0.01


@pytest.mark.parametrize("algorithm", LOCAL_ALGORITHMS)
def test_a_search_ends_near_a_known_optimum(algorithm: str) -> None:
    """It ends at its first point within 1 px of the optimum, and an optimum elsewhere does not end it."""
    ways = {
        "low": LOW,
        "high": HIGH,
        "start": PEAK + 4.0,
        "evaluations": 400,
        "tolerance": 1e-4,
        "step": 0.3,
    }
    whole = maximise(hill, algorithm, **ways)
    near = np.linalg.norm(whole.points - PEAK, axis=1) < 1.0
    ended = maximise(hill, algorithm, **ways, known=[np.array([-9.0, 9.0]), PEAK])
    assert near.any()
    assert ended.ended == "known optimum"
    assert ended.evaluations == np.argmax(near) + 1 < whole.evaluations
    np.testing.assert_array_equal(ended.points, whole.points[: ended.evaluations])


@pytest.mark.parametrize("algorithm", [*GLOBAL_ALGORITHMS, *LOCAL_ALGORITHMS])
def test_the_budget_holds_and_runs_repeat(algorithm: str) -> None:
    runs = [
        maximise(
            hill,
            algorithm,
            low=LOW,
            high=HIGH,
            start=np.zeros(2),
            evaluations=60,
            tolerance=1e-9,
            seed=5,
        )
        for _ in range(2)
    ]
    assert runs[0].evaluations <= 60
    np.testing.assert_array_equal(runs[0].points, runs[1].points)


@pytest.mark.parametrize(
    "algorithm", ["GN_DIRECT_L", "GN_ORIG_DIRECT", "GN_MLSL", "LN_BOBYQA", "LN_SBPLX"]
)
def test_an_interrupt_comes_through(algorithm: str) -> None:
    calls = 0

    def score(x: np.ndarray) -> float:
        nonlocal calls
        calls += 1
        if calls == 10:
            raise KeyboardInterrupt
        return hill(x)

    with pytest.raises(KeyboardInterrupt):
        maximise(
            score, algorithm, low=LOW, high=HIGH, start=np.zeros(2), evaluations=500, tolerance=1e-9
        )
    assert calls == 10


def test_a_score_that_is_not_finite_is_an_error() -> None:
    with pytest.raises(AmiwarpError, match="sharpness or cost is nan"):
        maximise(
            lambda x: float("nan"),
            "LN_BOBYQA",
            low=LOW,
            high=HIGH,
            start=PEAK,
            evaluations=9,
            tolerance=0.1,
        )


@pytest.mark.parametrize("algorithm", ["GN_NONSENSE", "LD_LBFGS", "LN_AUGLAG"])
def test_unknown_algorithms_are_named(algorithm: str) -> None:
    with pytest.raises(AmiwarpError, match=algorithm):
        maximise(hill, algorithm, low=LOW, high=HIGH, start=PEAK, evaluations=9, tolerance=0.1)


def test_one_dimension_is_refused_where_nlopt_has_no_way() -> None:
    with pytest.raises(AmiwarpError, match="LN_COBYLA"):
        maximise(
            lambda x: -float(x[0] ** 2), "LN_BOBYQA",
            low=LOW[:1], high=HIGH[:1], start=np.ones(1), evaluations=50, tolerance=0.1,
        )  # fmt: skip


def test_what_the_score_holds_is_let_go() -> None:
    """NLopt keeps references to the functions it called. They must not keep a search's buffers alive."""

    class Held:
        def __call__(self, x: np.ndarray) -> float:
            return -float(x @ x)

    held = Held()
    gone = weakref.ref(held)
    for algorithm in ("GN_DIRECT_L", "LN_SBPLX", "GN_MLSL"):
        maximise(
            held, algorithm, low=LOW, high=HIGH, start=np.ones(2), evaluations=50, tolerance=0.01
        )
    del held
    gc.collect()
    assert gone() is None
