"""Packages of simulators: a missing one names its extra, another version is said once; the how-to's own renderer."""

import importlib.metadata
import re
import sys
import tomllib
import warnings
from pathlib import Path
from typing import Any

import pytest

import amiwarp
from amiwarp.sensors import DISTRIBUTIONS, EXTRAS, TESTED, simulator
from tests import ROOT


@pytest.mark.parametrize("name", TESTED)
def test_a_missing_package_names_its_extra(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(amiwarp.AmiwarpError, match=rf"amiwarp\[{EXTRAS[name]}\]") as caught:
        simulator(name)
    assert caught.value.code is amiwarp.ErrorCode.PACKAGE_MISSING


def test_another_version_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gymnasium")
    monkeypatch.setattr("amiwarp.sensors.versions._said", set())
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "2.0.1")
    with pytest.warns(UserWarning, match=r"gymnasium 2\.0\.1 is installed.* tested with 1\.4\.0"):
        simulator("gymnasium")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulator("gymnasium")
        monkeypatch.setattr(importlib.metadata, "version", lambda name: "1.4.9")
        monkeypatch.setattr("amiwarp.sensors.versions._said", set())
        simulator("gymnasium")


def test_extras_require_the_tested_series() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for module, version in TESTED.items():
        series = ".".join(version.split(".")[:2])
        package = DISTRIBUTIONS.get(module, module)
        assert project["optional-dependencies"][EXTRAS[module]] == [f"{package}>={series}"]


def test_the_renderer_of_the_how_to_takes_30_lines_and_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs" / "how-to" / "simulators.md").read_text()
    part = page.partition("## A renderer of your own")[2]
    match = re.search(r"```python\n(.*?)```", part, re.S)
    assert match is not None
    program = match[1]
    drawn = program.partition("class Disc")[2].partition("\n\n\n")[0]
    assert len(drawn.splitlines()) <= 30
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(program, names)
    found = int(capsys.readouterr().out.split()[0])
    recording = amiwarp.open_recording(tmp_path / "disc.h5")
    assert len(recording.events) == found > 1000
    # Compensated by the true model, the edge of the disc is sharp again
    events = recording.events[:]
    assert recording.encoder is not None
    plain = amiwarp.iwe(events, 64, 48)
    sharp = amiwarp.iwe(events, 64, 48, model=names["optic"], encoder=recording.encoder)
    assert sharp.var() > 1.2 * plain.var()
