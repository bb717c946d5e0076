"""Benchmarks of GPUs, tested without one: counters of ncu, disassembled code, and jobs shared by Dask workers."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from amiwarp.studies.stability.cells import Outcome, Result, Stored
from benchmarks import bounds, two_gpus
from benchmarks.vote_instructions import functions, row_of

PLAN: dict[str, Any] = {
    "machine": "GPU", "rows": [
        {"scene": "random pixels", "name": name, "what": "votes", "work": 64.0, "errors": {}, "wrong": []}
        for name in ("a", "b")
    ],
}  # fmt: skip
QUICK, MARK = "vote_quickly_2_cuda_kernel_forward", "mark_case_1_cuda_kernel_forward"
LAUNCHES: tuple[tuple[str, int, dict[str, float]], ...] = (
    (MARK, 1, {}), (QUICK, 9, {"ns": 1000, "issue": 50}), (QUICK, 9, {"ns": 3000, "issue": 90}), (MARK, 2, {}),
)  # fmt: skip


def values_of(given: dict[str, float]) -> dict[str, str]:
    """Return counters as ncu prints them; a counter that it could not read has no number."""
    if not given:
        return dict.fromkeys(bounds.metrics(), "n/a")
    issue = bounds.PERCENT["issue_percent"]
    many = dict.fromkeys(bounds.metrics(), "2")
    return many | {bounds.DURATION: f"{given['ns']:,}", issue: str(given["issue"]), bounds.THREADS: "640"}


def wide() -> str:
    """Return the output of ``--page raw``: one column per counter, and a line of units."""
    names = bounds.metrics()
    lines = ["==PROF== Connected", ",".join(f'"{n}"' for n in ("ID", "Kernel Name", "Grid Size", *names))]
    lines.append(",".join('""' for _ in range(3 + len(names))))
    for k, (kernel, grid, given) in enumerate(LAUNCHES):
        found = values_of(given)
        lines.append(",".join(f'"{v}"' for v in (k, kernel, f"({grid}, 1, 1)", *(found[n] for n in names))))
    return "\n".join(lines)


def long() -> str:
    """Return the same with one line per counter."""
    lines = ['"ID","Kernel Name","Grid Size","Metric Name","Metric Unit","Metric Value"']
    for k, (kernel, grid, given) in enumerate(LAUNCHES):
        lines += [f'"{k}","{kernel}","({grid}, 1, 1)","{n}","","{v}"' for n, v in values_of(given).items()]
    return "\n".join(lines)


@pytest.mark.parametrize("text", [wide(), long()], ids=["wide", "long"])
def test_counters_become_one_row_per_case(text: str) -> None:
    first, second = bounds.results(PLAN, text)["rows"]
    assert (first["kernels"], first["launches"]) == (["vote_quickly_2"], 2)
    assert first["seconds"] == pytest.approx(4e-6, rel=1e-12)
    assert first["votes_per_s"] == pytest.approx(16e6, rel=1e-12)
    assert first["instructions_per_vote"] == 2 * 640 / 64
    assert first["warp_instructions_per_vote"] == 2 * 2 * 32 / 64
    assert first["issue_percent"] == pytest.approx(80.0, rel=1e-12)  # three times as long at 90 % as at 50 %
    assert first["per_vote"]["l2_reductions"] == 4 / 64
    assert first["stalls"]["long_scoreboard"] == pytest.approx(2.0, rel=1e-12)
    assert second["skipped"] == "ncu gave no counters"
    assert "16.0" not in bounds.line(second)
    assert "issue_percent 80" in bounds.line(first)


def test_results_of_an_earlier_run_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, counters, out = (tmp_path / name for name in ("plan.json", "counters.csv", "bounds.json"))
    plan.write_text(json.dumps(PLAN | {"rows": PLAN["rows"][:1]}))
    counters.write_text(wide())
    monkeypatch.setattr("sys.argv", ["bounds", "--from", str(counters), "--plan", str(plan), "--out", str(out)])
    assert bounds.main() == 0
    assert json.loads(out.read_text())["rows"][0]["launches"] == 2


def test_every_case_is_a_case_of_the_benchmark() -> None:
    assert len(list(bounds.chosen())) == len(bounds.NAMES) * 3


CODE = """
	.section	.text.votes_cuda_kernel_forward,"ax",@progbits
.text.votes_cuda_kernel_forward:
        /*0000*/                   LDC R1, c[0x0][0x28] ;
.L_x_0:
        /*0010*/                   FADD R1, R1, 1 ;
        /*0020*/              @!P0 BRA `(.L_x_1) ;
        /*0030*/                   ATOMS.ADD RZ, [R1], R2 ;
        /*0040*/                   BRA `(.L_x_2) ;
.L_x_1:
        /*0050*/                   LDL R3, [R1] ;
        /*0060*/                   ATOMS.ADD RZ, [R1], R2 ;
        /*0070*/                   ATOMS.ADD RZ, [R1+0x4], R2 ;
.L_x_2:
        /*0080*/               @P1 BRA `(.L_x_0) ;
        /*0090*/                   EXIT ;
.L_x_3:
        /*00a0*/                   BRA `(.L_x_3);
"""


def test_instructions_are_counted_on_the_path_with_the_votes() -> None:
    (code,) = functions(CODE).values()
    assert code.loops == [(1, 8)]
    one, two = (code.path(1, 8, atomics) for atomics in (1, 2))
    assert one == [1, 2, 3, 4, 8]
    assert two == [1, 2, 5, 6, 7, 8]
    assert code.path(1, 8, 3) is None
    row = row_of(code, two, 2, vote="bilinear")
    assert (row["instructions_per_vote"], row["spills"], row["vote"]) == (3.0, 1, "bilinear")


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
    words = ["--device", "cpu", "--jobs", "files", "--seconds", "0.1", "--events", "100000", "--folder", str(tmp_path)]
    monkeypatch.setattr("sys.argv", ["two_gpus", *words, "--out", str(out)])
    assert two_gpus.main() == 0
    rows = json.loads(out.read_text())["rows"]
    assert [row["workers"] for row in rows][:2] == [1, 2]
    assert all(row["identical"] and row["error_px"] <= two_gpus.MOST_PX["files"] for row in rows)
    assert not [row for row in rows if two_gpus.wrong(row, ())]
    assert two_gpus.wrong(rows[1] | {"places": ["one", "one"]}, ("0", "1"))
