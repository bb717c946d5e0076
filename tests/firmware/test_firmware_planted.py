"""Faults planted in the firmware's core: the conformance suite catches each, and passes the core without them."""

import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.firmware.test_firmware import FIRMWARE, load

if not FIRMWARE.is_dir():
    pytest.skip("the firmware is not in this copy of the project", allow_module_level=True)

sys.modules.setdefault("boards", load("boards"))
PLANTED = load("planted")
FAST = 8
"""One in so many faults for the suite is run by the fast tests; those for a test build an image, and are slow."""

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(
            f, marks=[] if k % FAST == 0 and "caught" in f else pytest.mark.slow, id=f["wrong"]
        )
        for k, f in enumerate(PLANTED.FAULTS)
    ],
)
def test_a_planted_fault_is_caught(fault: dict[str, Any], tmp_path: Path) -> None:
    found, what = PLANTED.caught(fault, tmp_path)
    if found is None:
        pytest.skip(f"{what} is skipped: tools of a port are missing")
    assert found


def test_the_suite_passes_the_core_without_a_fault(tmp_path: Path) -> None:
    text = PLANTED.FAULTS[0]["before"]
    harmless = {"file": PLANTED.FAULTS[0]["file"], "before": text, "after": text}
    assert PLANTED.failures(harmless, tmp_path) == []


def test_a_text_that_is_gone_is_named() -> None:
    fault = {"file": "core/frame.c", "before": "b", "after": "c"}
    assert PLANTED.planted("abd", fault) == "acd"
    with pytest.raises(ValueError, match=r"core/frame.c: 'b' is there 2 times"):
        PLANTED.planted("bb", fault)
