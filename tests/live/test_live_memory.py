"""Resident memory of ``amiwarp live`` with a sensor of 1280 x 720 px."""

import sys
from pathlib import Path

import pytest

from amiwarp import EventFilter
from benchmarks.live_start import MEV_S, SECONDS, started, write_inputs
from benchmarks.stages import SIZE, stream

MOST_MIB = {"plain": 300.0, "compensated": 500.0}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
@pytest.mark.parametrize("kind", MOST_MIB)
def test_a_live_stream_needs_little_memory(tmp_path: Path, kind: str) -> None:
    wanted = write_inputs(tmp_path)
    if kind == "plain":
        calm = EventFilter(refractory_us=300, background_us=10_000)
        wanted = len(calm.apply(stream(SECONDS, MEV_S), SIZE))
    found = started(tmp_path, kind)
    assert (found["events"], found["exit_status"]) == (wanted, 0)
    assert 50.0 < found["memory_mib"] < MOST_MIB[kind]
