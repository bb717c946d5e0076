"""The benchmark of several GPUs, tested without one: jobs shared by Dask workers."""

import contextlib
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from amiwarp.studies.stability import Outcome, Result, Stored
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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:distributed.*")
def test_two_workers_make_the_same_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes make the files of one worker, which is a thread of this process."""
    import dask
    from distributed import Client, LocalCluster

    processes, out = two_gpus.cluster, tmp_path / "two.json"

    @contextlib.contextmanager
    def cluster(count: int, share: int, gpus: tuple[str, ...]) -> Iterator[Any]:
        if count > 1:
            with processes(count, share, gpus) as client:
                yield client
            return
        with (
            dask.config.set(two_gpus.LOCAL_CONFIGURATION),
            LocalCluster(
                n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
            ) as local,
            Client(local) as client,
        ):
            yield client

    monkeypatch.setattr(two_gpus, "cluster", cluster)
    words = [
        "--device",
        "cpu",
        "--jobs",
        "files",
        "--seconds",
        "0.01",
        "--events",
        "20000",
        "--folder",
        str(tmp_path),
    ]
    words += ["--limit-s", "600"]  # both rows are made on a busy machine, too
    monkeypatch.setattr("sys.argv", ["two_gpus", *words, "--out", str(out)])
    assert two_gpus.main() == 0
    rows = json.loads(out.read_text())["rows"]
    assert [row["workers"] for row in rows][:2] == [1, 2]
    assert all(row["identical"] and row["error_px"] <= two_gpus.MOST_PX["files"] for row in rows)
    assert not [row for row in rows if two_gpus.wrong(row, ())]
    assert two_gpus.wrong(rows[1] | {"places": ["one", "one"]}, ("0", "1"))
