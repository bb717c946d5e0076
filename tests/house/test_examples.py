"""Each example runs, and one of them is the README's program. The tutorials run when the documentation is built."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from tests import ROOT

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
SLOW_EXAMPLES = (
    "train_from_files",
    "save_for_paraview",
    "event_sensors",
    "event_camera_in_newton",
    "event_camera_in_mujoco",
)
"""Examples that take many seconds."""


def marks_of(example: Path) -> list[pytest.MarkDecorator]:
    return [pytest.mark.slow] if example.stem in SLOW_EXAMPLES else []


def test_there_are_examples() -> None:
    assert len(EXAMPLES) >= 3
    assert len(TUTORIALS) >= 5


@pytest.mark.parametrize(
    "example",
    [pytest.param(path, id=path.stem, marks=marks_of(path)) for path in EXAMPLES],
)
def test_example_runs(
    example: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for module in ("torch", "newton", "mujoco_warp"):
        if f"import {module}\n" in example.read_text():
            pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    if "__main__" in example.read_text():  # it starts processes, which import it
        command = [sys.executable, str(example)]
        done = subprocess.run(
            command,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.strip()
        return
    runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out.strip()


def test_the_readme_shows_the_quickstart() -> None:
    programs = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert len(programs) == 1
    source = (ROOT / "examples" / "quickstart.py").read_text()
    assert programs[0].strip() == source.split('"""', 2)[2].strip()
    assert len([line for line in programs[0].splitlines() if line.strip()]) <= 15


def test_the_readme_links_to_files_that_exist() -> None:
    text = (ROOT / "README.md").read_text()
    targets = [target for target in re.findall(r"\]\(([^)#]+)", text) if "://" not in target]
    assert [target for target in targets if not (ROOT / target).exists()] == []
    assert len(targets) >= 3
