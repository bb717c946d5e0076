"""Pytest plugin of ``benchmarks.mutants``: the order of its tests, their durations and the lines that each one runs."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Generator
from pathlib import Path

import coverage
import pytest

DURATIONS: dict[str, float] = {}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Note the duration of a test, its fixtures included [s]. Coverage, if it runs, learns the test's name."""
    recording = coverage.Coverage.current()
    if recording is not None:
        recording.switch_context(item.nodeid)
    began = time.perf_counter()
    try:
        return (yield)
    finally:
        DURATIONS[item.nodeid] = time.perf_counter() - began
        if recording is not None:
            recording.switch_context("")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run the tests in the order of the command line, not in that of ``conftest.py``."""
    rank = {name: k for k, name in enumerate(config.args)}
    items.sort(key=lambda item: rank.get(item.nodeid, 0))


def pytest_sessionfinish() -> None:
    """Write the durations to the file that the environment variable names."""
    if "MUTANTS_DURATIONS" in os.environ:
        Path(os.environ["MUTANTS_DURATIONS"]).write_text(json.dumps(DURATIONS))
