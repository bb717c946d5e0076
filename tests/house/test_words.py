"""No text of the package, the documentation and the pages uses words that `.ci/words.txt` lists."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests import ROOT


def run(*files: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, ROOT / ".ci" / "words.py", *files]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_no_listed_word_is_used() -> None:
    found = run()
    assert (found.returncode, found.stdout) == (0, "")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("Good.\nThe speed is that of the prism.\n", 2),
        ("Those\nof the prism.\n", 1),
        ("# A comment whose speeds are those\n    # of the prism.\n", 1),
        ('text = (\n    "the speeds are those "\n    "of the prism"\n)\n', 2),
        ("Size from\n\n    which on it is read.\n", 1),
    ],
)
def test_a_word_is_found_in_its_line(text: str, line: int, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(text)
    found = run(page)
    assert found.returncode == 1
    assert found.stdout.startswith(f"{page}:{line}: ")
    assert found.stdout.count("\n") == 1


def test_parts_of_words_and_other_sentences_are_not_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "Those often fail. That officer left. It does that. Of all prisms, one is thin.\n"
    )
    found = run(page)
    assert (found.returncode, found.stdout) == (0, "")
