"""Simulated faults, alone and in pairs: the speed and the time of voltage without counts stay within their limits."""

import shutil
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from tests.firmware.test_firmware import FIRMWARE, built, load

if not FIRMWARE.is_dir():
    pytest.skip("the firmware is not in this copy of the project", allow_module_level=True)

sys.modules.setdefault("boards", load("boards"))
FAULTS, PLANTED = load("faults"), load("planted")
ONCE_UNSAFE = (876, 3119, 3370, 5348, 8847)
"""Seeds of cases that exceeded a limit with an earlier core."""

pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None or shutil.which("make") is None, reason="needs gcc and make"
)


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("firmware"), "libboard.so") / "libboard.so"


@pytest.mark.parametrize("first", [0, pytest.param(100, marks=pytest.mark.slow)])
def test_no_fault_lets_the_motor_run_away(library: Path, first: int) -> None:
    for seed in (*range(first, first + (60 if first == 0 else 600)), *ONCE_UNSAFE):
        outcome = FAULTS.run(FAULTS.drawn(seed), seed, library)
        assert outcome.safe, (seed, outcome)


def test_without_a_fault_the_motor_turns_and_stops(library: Path) -> None:
    case = FAULTS.Case({}, 720.0, 2000.0, (), reversed_motor=False)
    outcome = FAULTS.run(case, 1, library)
    assert 720.0 < outcome.fastest_rpm < 800.0
    assert not outcome.driven
    assert case.name == ""


def test_the_cases_hold_every_kind_alone_and_in_pairs() -> None:
    cases = [FAULTS.drawn(seed) for seed in range(1000)]
    kinds = Counter(name for case in cases for name, *_ in case.faults)
    assert set(kinds) == set(FAULTS.KINDS)
    assert min(kinds.values()) > 30
    assert Counter(len(case.faults) for case in cases) == {1: 500, 2: 500}
    assert any(case.reversed_motor for case in cases)


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault",
    [
        {
            "file": "core/guard.c",
            "before": "if (standing || dropped) return GUARD_STANDS;",
            "after": "",
        },
        {
            "file": "core/guard.c",
            "before": "#define START_MS 80u",
            "after": "#define START_MS 900u",
        },
        {
            "file": "core/controller.c",
            "before": "c->no_magnet >= NO_MAGNET_MS",
            "after": "c->no_magnet >= 200u",
        },
    ],
    ids=("no guard", "late guard", "late magnet"),
)
def test_the_cases_find_a_core_that_does_not_stop(fault: dict[str, Any], tmp_path: Path) -> None:
    library = PLANTED.built(fault, tmp_path)
    assert not all(FAULTS.run(FAULTS.drawn(seed), seed, library).safe for seed in range(300))
