"""The recorded durations of the tests."""

import json
import re
from pathlib import Path

import pytest

from tests import ROOT
from tests.durations import LEAST_S, Recorder, merged, name_of, recorded

pytest_plugins = ("pytester",)
FILE = """
import pytest

@pytest.fixture(scope="module")
def inner(clock):
    clock.now += 4.0

@pytest.fixture(scope="module")
def shared(clock, request):
    clock.now += 2.0
    request.getfixturevalue("inner")

@pytest.fixture
def own(clock):
    clock.now += 1.0

def test_quick(clock):
    clock.now += 0.1

def test_of_both(clock, shared, own):
    clock.now += 10.0

@pytest.mark.parametrize("seconds", [1.0, 3.0])
def test_of_the_shared(clock, shared, seconds):
    clock.now += seconds

def test_skipped(clock, shared):
    pytest.skip("no device")

def test_left_out(clock):
    clock.now += 1.0
"""


class Clock:
    """Plugin with a clock that stands still unless a test advances it."""

    def __init__(self) -> None:
        self.now = 0.0

    @pytest.fixture(scope="session")
    def clock(self) -> "Clock":
        return self


def test_tests_share_the_fixtures_of_their_file(pytester: pytest.Pytester, tmp_path: Path) -> None:
    """Four tests use the fixtures, which take 6 s; one of the four is skipped after that."""
    pytester.makepyfile(test_file=FILE)
    record = tmp_path / "durations.json"
    names = [f"test_file.py::test_{name}" for name in ("left_out", "of_both", "quick", "skipped")]
    record.write_text(json.dumps(dict.fromkeys(names, 60.0)))
    clock = Clock()
    recorder = Recorder(record, lambda: clock.now)
    pytester.inline_run("-p", "no:xdist", "--deselect", names[0], plugins=[clock, recorder])
    assert json.loads(record.read_text()) == {
        names[0]: 60.0,
        names[1]: 10.0,  # 1 + 10 + 6/4, to one digit
        "test_file.py::test_of_the_shared[1.0]": 2.0,  # 2.5, to one digit
        "test_file.py::test_of_the_shared[3.0]": 4.0,  # 4.5, likewise
        names[3]: 60.0,
    }


def test_a_record_changes_only_by_much() -> None:
    before = {"b": 3.0, "c": 3.0, "d": 3.0, "gone": 1.0, "kept": 20.0}
    measured = {"b": 4.4, "c": 4.6, "d": 2.1, "a": 0.84, "gone": LEAST_S - 0.01, "quick": 0.1}
    after = merged(before, measured)
    assert list(after.items()) == [("a", 0.8), ("b", 3.0), ("c", 5.0), ("d", 3.0), ("kept", 20.0)]
    assert before["c"] == 3.0


def test_the_record_names_no_folder() -> None:
    assert (
        name_of("tests/io/test_one.py::Group::test_path[a/b::c]")
        == "test_one.py::Group::test_path[a/b::c]"
    )
    assert name_of("test_one.py::test_path") == "test_one.py::test_path"


def test_recorded_tests_exist() -> None:
    """Take the entries of a test that was renamed or removed out of the file."""
    texts: dict[str, str] = {}
    for name in recorded():
        assert name == name_of(name)
        path, _, function = name.partition("::")
        if path not in texts:
            (file,) = (ROOT / "tests").rglob(path)
            texts[path] = file.read_text()
        function = re.sub(r"\[.*", "", function).rpartition("::")[2]
        assert f"def {function}(" in texts[path], name
