"""How long the tests take, as recorded in durations.json, and which of them are therefore slow.

``pytest -n 2 --dist loadfile --record-durations`` records. A test counts its own time, and its share of the fixtures
that are made once for several tests of its file.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

RECORD = Path(__file__).with_name("durations.json")
"""Seconds of each test that takes at least :data:`LEAST_S`, by :func:`name_of` it, on two idle cores."""
LEAST_S = 0.5
SLOW_S = 0.6
"""A test that takes as long is slow."""
SAME = 1.5
"""A new duration within this factor of the recorded one changes nothing: machines differ."""


def name_of(nodeid: str) -> str:
    """Return the name that a test has in the record: without its folder, so that a file may move."""
    path, separator, function = nodeid.partition("::")
    return path.rpartition("/")[2] + separator + function


def recorded() -> dict[str, float]:
    """Return the recorded seconds by the test's name."""
    durations: dict[str, float] = json.loads(RECORD.read_text())
    return durations


def merged(before: dict[str, float], measured: dict[str, float]) -> dict[str, float]:
    """Return a record with the tests that were measured now, sorted and rounded to one digit. Others stay."""
    after = {name: seconds for name, seconds in before.items() if name not in measured}
    for name, seconds in measured.items():
        known = before.get(name)
        if known is not None and known / SAME <= seconds <= known * SAME:
            after[name] = known
        elif seconds >= LEAST_S:
            after[name] = float(f"{seconds:.0e}")
    return dict(sorted(after.items()))


class Recorder:
    """Plugin that measures all tests, also those of xdist's processes, and updates a record."""

    def __init__(
        self, record: Path = RECORD, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._record, self._clock = record, clock
        self._measured: dict[str, float] = {}
        self._own: dict[str, float] = {}
        self._shared: defaultdict[tuple[Path, str], float] = defaultdict(float)
        """Seconds in which a fixture with several users was made, by file and name."""
        self._users: defaultdict[tuple[Path, str], list[str]] = defaultdict(list)
        self._skipped: set[str] = set()
        self._item: pytest.Item | None = None
        self._sharing_s = 0.0
        self._making = False

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[Any]:
        """Measure a test without the fixtures that it shares."""
        self._item, self._sharing_s = item, 0.0
        for name in getattr(item, "fixturenames", ()):
            self._users[item.path, name].append(name_of(item.nodeid))
        begun = self._clock()
        result = yield
        self._own[name_of(item.nodeid)] = self._clock() - begun - self._sharing_s
        return result

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Iterator[Any]:
        """Measure a shared fixture, with those that it asks for itself."""
        if fixturedef.scope == "function" or self._making or self._item is None:
            return (yield)
        self._making, begun = True, self._clock()
        try:
            return (yield)
        finally:
            self._making, seconds = False, self._clock() - begun
            self._sharing_s += seconds
            self._shared[self._item.path, fixturedef.argname] += seconds

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a skipped test: what it takes is not known."""
        if report.skipped:
            self._skipped.add(name_of(report.nodeid))

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        """Take what one of xdist's processes measured."""
        self._measured |= getattr(node, "workeroutput", {}).get("durations", {})

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Share the fixtures, and update the record, or give the result to xdist's main process."""
        seconds = dict(self._own)
        for key, spent in self._shared.items():
            for name in self._users[key]:
                seconds[name] += spent / len(self._users[key])
        for name in self._skipped:
            seconds.pop(name, None)
        self._measured |= seconds
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["durations"] = self._measured
        elif self._measured:
            before = json.loads(self._record.read_text()) if self._record.exists() else {}
            self._record.write_text(json.dumps(merged(before, self._measured), indent=0) + "\n")
