"""Printed text: control characters from files and names are escaped, and every message is one line."""

import contextlib
import json
import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amiwarp import AmiwarpError, Events, RecordingWriter, open_recording
from amiwarp.cli.common import Common, report, table
from amiwarp.errors import printable
from reference.io_samples_extra import arrays, write_ros2

NASTY = "a\x1b]0;owned\x07\x1b[31m\nb\u202egnp\u2028c.h5"
"""File name that sets the terminal's title and colour, breaks the line and reverses the direction of text."""
SHOWN = r"a\x1b]0;owned\x07\x1b[31m\nb\u202egnp\u2028c.h5"


def run(*words: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-m", "amiwarp", *words], capture_output=True, timeout=300, check=False
    )


def control_characters(output: bytes) -> list[str]:
    """Return the characters that a terminal would interpret, except newlines."""
    return [c for c in output.decode() if not c.isprintable() and c != "\n"]


def test_a_name_in_an_error_is_escaped(tmp_path: Path) -> None:
    ended = run("info", str(tmp_path / NASTY))
    assert ended.returncode == 1
    assert control_characters(ended.stderr) == []
    assert ended.stderr.count(b"\n") == 1
    assert f"{SHOWN}: no such file" in ended.stderr.decode()


def test_a_name_that_is_no_utf8_is_shown(tmp_path: Path) -> None:
    ended = run("info", os.fsdecode(os.fsencode(tmp_path) + b"/\xff.h5"))
    assert ended.returncode == 1
    assert rb"\udcff.h5: " in ended.stderr


def test_wrong_usage_is_one_line() -> None:
    ended = run("motor")
    assert ended.returncode == 2
    assert ended.stderr.decode().splitlines() == [
        "amiwarp: Missing argument 'action'. Choose from: status, set, stop, settings, check; see amiwarp motor --help"
    ]
    strange = run("simulate", "--fl\x1b]0;x\x07at")
    assert strange.returncode == 2
    assert control_characters(strange.stderr) == []


def test_texts_within_a_recording_are_escaped(tmp_path: Path) -> None:
    path = tmp_path / NASTY
    column = np.zeros(1, np.uint16)
    with RecordingWriter(
        path, width=4, height=4, metadata={"made\x1b[2Jby": "one\ntwo\x1b[5m"}
    ) as writer:
        writer.append(Events(column, column, np.zeros(1, np.int64), np.zeros(1, np.uint8)))
    ended = run("info", str(path))
    assert ended.returncode == 0, ended.stderr
    assert control_characters(ended.stdout) == []
    assert SHOWN in ended.stdout.decode()
    assert r"one\ntwo\x1b[5m" in ended.stdout.decode()
    data = json.loads(run("info", str(path), "--json").stdout)
    assert data["file"] == str(path)
    assert data["metadata"]["made\x1b[2Jby"] == "one\ntwo\x1b[5m"


def test_lines_and_cells_keep_their_markup_and_their_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    report(
        Common(),
        {},
        ["[bold]x[/bold]\x1b[1m\nnot a line of its own", table([("cell\r\n", "[red]\x9b")])],
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == r"[bold]x[/bold]\x1b[1m\nnot a line of its own"
    assert lines[1].split() == [r"cell\r\n", r"[red]\x9b"]


@given(st.text())
def test_any_text_becomes_a_printable_line(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    assert printable(shown) == shown
    if text.isprintable():
        assert shown == text


def test_long_names_in_an_error_are_shortened() -> None:
    said = str(AmiwarpError(f"a.bag: no events in {'n' * 1000}/end; give another"))
    assert said.startswith("a.bag: no events in nnn")
    assert said.endswith("nnn/end; give another")
    assert len(said) < 250
    long = str(AmiwarpError("start " + "word " * 10_000 + "; do this"))
    assert long.startswith("start word")
    assert long.endswith("; do this")
    assert len(long) <= 800
    path = "/folder/" + "d" * 100 + "/file.h5: no such file"
    assert str(AmiwarpError(path)) == path


def test_a_type_of_a_bag_does_not_fill_the_error(tmp_path: Path) -> None:
    bag = write_ros2(
        tmp_path / "bag", {"/events": arrays(Events.from_arrays([1], [1], [5], [1]), ros1=False)}
    )
    with contextlib.closing(sqlite3.connect(bag)) as database, database:
        database.execute("UPDATE topics SET type = ?", (f"pkg/msg/{'T' * 1000}",))
    with pytest.raises(AmiwarpError, match="bag") as caught:
        open_recording(bag)
    assert len(str(caught.value)) < 600
