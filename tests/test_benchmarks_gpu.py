"""The benchmark of several GPUs, tested without one: jobs shared by Dask workers."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from amiwarp.studies.stability.cells import Outcome, Result, Stored
from benchmarks import two_gpus


def test_cells_are_compared_by_their_results() -> None:
    result = Result(Outcome.SUCCESS, 0.01, 0.1, 2.0)
    cell = Stored(two_gpus.Cell(two_gpus.axis().conditions()[0], 0), 5, {"default": result})
    later = Stored(cell.cell, 5, {"default": replace(result, seconds=9.0, machine="other")})
    assert two_gpus.known(cell) == two_gpus.known(later)
    a, b = {"cell": two_gpus.known(cell)}, {"cell": two_gpus.known(cell) | {"error_px": 0.012}}
    assert two_gpus.difference("atlas", a, b) == pytest.approx(0.002, abs=1e-12)
    assert two_gpus.difference("atlas", a, {"cell": a["cell"] | {"outcome": "refusal"}}) == math.inf
    assert two_gpus.difference("files", {"0.h5": "x"}, {"0.h5": "x", "1.h5": "y"}) == 0.0
    assert two_gpus.difference("files", {"0.h5": "x"}, {"0.h5": "y"}) == math.inf


def test_two_workers_make_the_same_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "two.json"
    words = ["--device", "cpu", "--jobs", "files", "--seconds", "0.01", "--events", "20000", "--folder", str(tmp_path)]
    words += ["--limit-s", "600"]  # both rows are made on a busy machine, too
    monkeypatch.setattr("sys.argv", ["two_gpus", *words, "--out", str(out)])
    assert two_gpus.main() == 0
    rows = json.loads(out.read_text())["rows"]
    assert [row["workers"] for row in rows][:2] == [1, 2]
    assert all(row["identical"] and row["error_px"] <= two_gpus.MOST_PX["files"] for row in rows)
    assert not [row for row in rows if two_gpus.wrong(row, ())]
    assert two_gpus.wrong(rows[1] | {"places": ["one", "one"]}, ("0", "1"))
