"""Data sets in bulk: what a specification makes, what is kept, and what a wrong specification or a failure says."""

import gc
import hashlib
import json
import math
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable
from concurrent.futures import Future
from glob import glob
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

import amiwarp
from amiwarp import AmiwarpError, DatasetSummary, make_dataset
from amiwarp.io.finished_work import append_line, create_journal, read_journal
from amiwarp.io.recorded_dataset import MANIFEST
from amiwarp.kernels import quiet_start
from amiwarp.learning.dataset import making, sources, specification, worker
from amiwarp.learning.dataset.files import JOURNAL, TABLE
from amiwarp.studies import cluster
from amiwarp.studies.cluster import ANY_GPU, Workers, run_jobs, single_worker, threads_of_worker
from tests import ROOT
from tests.command_line import app
from tests.learning.specifications import divided, items_of

HEAD = 'format = "amiwarp-dataset-specification"\nversion = 1\n'
PICTURES = """
[[sources]]
pictures = "pictures/*/*.png"
label_from_folder = "class"
labels = {indoor = true}
licence = "CC0-1.0"
"""
BASE = (
    HEAD
    + """
duration_s = 0.01
prisms = [{apex_deg = 1.0}, {apex_deg = 2.0, flat_side = "camera"}]
speeds_rpm = [1800.0]
sensors = ["ideal"]
camera = {size = [24, 18], fov_deg = 40.0}
"""
)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Folder with six pictures in two folders, and a specification of 12 recordings."""
    rng = np.random.default_rng(5)
    for k in range(6):
        folder = tmp_path / "pictures" / ("disc", "square")[k % 2]
        folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(
            np.kron(rng.integers(0, 256, (6, 8)), np.ones((8, 8))).astype(np.uint8)
        ).save(folder / f"{k}.png")
    (tmp_path / "spec.toml").write_text(BASE + PICTURES)
    return tmp_path


def make(place: Path, **options: Any) -> DatasetSummary:
    return make_dataset(place / "spec.toml", place / "out", workers=1, **options)


def manifest(place: Path) -> dict[str, Any]:
    found = json.loads((place / "out" / MANIFEST).read_text())
    assert isinstance(found, dict)
    return found


def checksums(place: Path) -> dict[str, str]:
    """Return the checksums of the recordings in the folder, computed here, by their path."""
    out = place / "out"
    return {
        p.relative_to(out).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in out.rglob("*.h5")
    }


def test_recordings_are_translated_for_every_prism(place: Path) -> None:
    """A recording of a rotating plain camera becomes one recording for each prism of the specification."""
    camera = amiwarp.Camera.from_fov(32, 24, 1.0)
    turning = amiwarp.CameraMotion([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 1.0, 0.0]])
    scene = amiwarp.Scene.from_picture(place / "pictures" / "disc" / "0.png")
    plain = amiwarp.Simulation(
        scene, camera, amiwarp.Prism(0.0), 0.2, camera_motion=turning, encoder_model=None, seed=1
    )
    plain.write(place / "plain.h5")
    source = '[[sources]]\ntranslated = "plain.h5"\nduration_s = 0.05\n'
    (place / "spec.toml").write_text(BASE + source)
    done = make(place)
    assert done.failed == {}
    items = manifest(place)["items"]
    assert {item["source_kind"] for item in items} == {"translated"}
    assert {item["apex_deg"] for item in items} == {1.0, 2.0}
    for item in items:
        recording = amiwarp.open_recording(place / "out" / item["file"])
        assert len(recording.events) == item["events"] > 0
        assert recording.truth is not None
        assert recording.truth.known is not None


def run(*args: str | Path) -> Result:
    return CliRunner().invoke(app, ["dataset", *(str(arg) for arg in args)])


def test_manifest_describes_every_file(place: Path) -> None:
    calls: list[tuple[str, float]] = []
    done = make(place, progress=lambda *a: calls.append(a))
    assert (done.recordings, done.made, done.kept, done.failed, done.workers) == (12, 12, 0, {}, 1)
    assert calls[0] == ("0 of 12 recordings", 0.0)
    assert calls[-1][1] == 1.0
    assert calls[-1][0].startswith("12 of 12 recordings, ")
    found = manifest(place)
    assert (found["format"], found["version"], found["complete"]) == ("amiwarp-dataset", 1, True)
    assert found["licences"] == [{"licence": "CC0-1.0", "sources": 6, "recordings": 12}]
    assert found["splits"] == dict(done.splits)
    assert {item["file"]: item["sha256"] for item in found["items"]} == checksums(place)
    for item in found["items"]:
        recording = amiwarp.open_recording(place / "out" / item["file"])
        assert len(recording.events) == item["events"]
        assert recording.metadata["seed"] == item["seed"]
        assert recording.prism is not None
        assert math.degrees(recording.prism.apex) == pytest.approx(item["apex_deg"], abs=1e-12)
        assert recording.events.size == (item["width"], item["height"]) == (24, 18)
        assert item["labels"] == {"indoor": True, "class": Path(item["source"]).parent.name}
        assert (item["duration_s"], item["rpm"], item["sensor"]) == (0.01, 1800.0, "ideal")
        assert item["file"].startswith(f"{item['split']}/")
    assert sum(item["events"] for item in found["items"]) == found["events"] == done.events > 1000


def test_parquet_equals_json(place: Path) -> None:
    import pyarrow.parquet

    make(place)
    rows = pyarrow.parquet.read_table(place / "out" / TABLE).to_pylist()
    items = manifest(place)["items"]
    assert [
        {**r, "labels": {"indoor": r["label_indoor"], "class": r["label_class"]}} for r in rows
    ] == [
        {**item, "label_indoor": item["labels"]["indoor"], "label_class": item["labels"]["class"]}
        for item in items
    ]


def test_seeds_depend_on_the_recording_alone(place: Path) -> None:
    before = {item.key: item for item in items_of(place / "spec.toml")}
    assert len({item.seed for item in before.values()}) == 12
    (place / "pictures" / "disc" / "00.png").write_bytes(
        (place / "pictures" / "disc" / "0.png").read_bytes()
    )
    more = BASE.replace("[1800.0]", "[60.0, 1800.0]").replace('["ideal"]', '["davis346", "ideal"]')
    (place / "spec.toml").write_text("seeds = [4, 0]\n" + more + PICTURES)
    after = {item.key: item for item in items_of(place / "spec.toml")}
    assert len(after) == 7 * 2 * 2 * 2 * 2
    assert {key: item.seed for key, item in after.items() if key in before} == {
        k: i.seed for k, i in before.items()
    }
    assert {key: item.file for key, item in after.items() if key in before} == {
        k: i.file for k, i in before.items()
    }


def test_a_source_lies_in_one_split(place: Path) -> None:
    worlds = '[[sources]]\nworlds = ["room", "desk"]\ntrajectories = ["still", "fast"]\n'
    copy = place / "pictures" / "square" / "copy.png"
    copy.write_bytes((place / "pictures" / "disc" / "0.png").read_bytes())
    (place / "spec.toml").write_text("seeds = 200\n" + BASE + PICTURES + worlds)
    items = items_of(place / "spec.toml")
    splits: dict[str, set[str]] = {}
    for item in items:
        of = (
            f"{item.source} {item.recipe['seed']}"
            if item.kind == "worlds"
            else item.recipe["source"]["sha256"]
        )
        splits.setdefault(of, set()).add(item.split)
    assert {len(found) for found in splits.values()} == {1}
    assert len(splits) == 6 + 2 * 200
    assert {
        item.split for item in items if item.source.endswith(("disc/0.png", "copy.png"))
    } == splits[hashlib.sha256(copy.read_bytes()).hexdigest()]
    train = sum(found == {"train"} for found in splits.values())
    assert train == 325
    text = (place / "spec.toml").read_text()
    (place / "spec.toml").write_text("stratify = false\n" + text)
    drawn = items_of(place / "spec.toml")
    train = len({item.same for item in drawn if item.split == "train"})
    assert train == pytest.approx(0.8 * 406, abs=30)
    assert train != 325
    other = BASE.replace("duration_s", "split_seed = 1\nduration_s", 1)
    (place / "spec.toml").write_text("seeds = 200\n" + other + PICTURES + worlds)
    assert [i.split for i in items_of(place / "spec.toml")] != [i.split for i in items]


def test_what_is_there_is_kept_and_damage_is_repaired(place: Path) -> None:
    make(place)
    before, written = (
        checksums(place),
        {p: p.stat().st_mtime_ns for p in (place / "out").rglob("*.h5")},
    )
    files = sorted(written)
    again = make(place)
    assert (again.made, again.kept, again.workers) == (0, 12, 0)
    files[0].unlink()
    files[1].write_bytes(files[1].read_bytes()[:-10])
    damaged = bytearray(files[2].read_bytes())
    damaged[len(damaged) // 2] ^= 1
    files[2].write_bytes(damaged)
    os.utime(files[3])  # copied, and undamaged
    repaired = make(place)
    assert (repaired.made, repaired.kept) == (3, 9)
    assert checksums(place) == before
    assert all(file.stat().st_mtime_ns == written[file] for file in files[4:])
    assert (make(place).made, manifest(place)["complete"]) == (0, True)


def test_what_a_changed_specification_leaves_is_reported(place: Path) -> None:
    make(place)
    first = checksums(place)
    (place / "spec.toml").write_text(BASE.replace("apex_deg = 1.0", "apex_deg = 1.5") + PICTURES)
    changed = make(place)
    assert (changed.made, changed.kept, len(changed.not_in_specification)) == (6, 6, 6)
    found = manifest(place)
    assert found["not_in_specification"] == list(changed.not_in_specification)
    assert not {item["file"] for item in found["items"]} & set(changed.not_in_specification)
    assert len(found["items"]) == 12
    assert first.items() < checksums(place).items()
    picture = place / "pictures" / "disc" / "0.png"
    Image.fromarray(np.full((48, 64), 99, np.uint8)).save(picture)
    assert make(place).made == 2


def test_a_recording_moves_to_the_folder_of_its_split(place: Path) -> None:
    """No recording stays in the folder of its old split, where it would mix test and training data."""
    halves = "splits = {train = 0.5, test = 0.5}\nduration_s"
    (place / "spec.toml").write_text(BASE.replace("duration_s", halves, 1) + PICTURES)
    make(place)
    before = checksums(place)
    (place / "spec.toml").write_text(
        BASE.replace("duration_s", f"split_seed = 5\n{halves}", 1) + PICTURES
    )
    items = items_of(place / "spec.toml")
    moved = sorted({item.file for item in items} - set(before))
    damaged = place / "out" / next(file for file in before if file.endswith(moved[0].split("/")[1]))
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    assert amiwarp.plan_dataset(place / "spec.toml", place / "out", workers=1).missing == 0
    again = make(place)
    assert (again.made, again.kept, again.not_in_specification) == (1, 11, ())
    after = checksums(place)
    assert (
        set(after)
        == {item.file for item in items}
        == {item["file"] for item in manifest(place)["items"]}
    )
    assert sorted(after.values()) == sorted(before.values())
    assert len(moved) > 2
    assert make(place).kept == 12


def test_a_failure_is_reported_and_does_not_stop_the_rest(place: Path) -> None:
    (place / "pictures" / "disc" / "bad.png").write_bytes(b"no picture")
    result = run(place / "spec.toml", place / "out", "--workers", "1", "--device", "cpu", "--json")
    assert result.exit_code == 1, result.output
    data = json.loads(result.stdout)
    assert (data["made"], data["recordings"], len(data["failed"])) == (12, 14, 2)
    found = manifest(place)
    assert found["complete"] is False
    assert {f["file"]: f["error"] for f in found["failed"]} == data["failed"]
    assert all("bad.png cannot be read as a picture" in f["error"] for f in found["failed"])
    Image.fromarray(np.eye(48, 64, dtype=np.uint8) * 255).save(
        place / "pictures" / "disc" / "bad.png"
    )
    done = run(place / "spec.toml", place / "out", "--workers", "1", "--device", "cpu")
    assert done.exit_code == 0, done.output
    assert "14 of 14 recordings" in done.stdout
    assert "12 of them kept" in done.stdout
    assert manifest(place)["complete"]


def test_an_unexpected_error_and_a_dead_worker_fail_their_recording_alone(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = worker.write_recording

    def planted(item: Any, *args: Any) -> Any:
        if item.source.endswith("0.png"):
            raise np.linalg.LinAlgError("Singular\nmatrix")
        return write(item, *args)

    monkeypatch.setattr(worker, "write_recording", planted)
    plan = amiwarp.plan_dataset(place / "spec.toml", place / "out", workers=1)
    assert (plan.samples, len(plan.failed)) == (10, 2)
    shown = run(
        place / "spec.toml", place / "out", "--dry-run", "--workers", "1", "--device", "cpu"
    )
    assert shown.exit_code == 0
    assert shown.stdout.count("sample failed: train/0-") == 2
    done = make(place)
    assert (done.made, len(done.failed)) == (10, 2)
    for failed, module in ((done.failed, "worker"), (plan.failed, "plan")):
        for error in failed.values():
            assert error.startswith("LinAlgError: Singular matrix (in ")
            assert f"learning/dataset/{module}.py:" in error
    monkeypatch.setattr(worker, "write_recording", write)
    again = make(place)
    assert (again.made, again.kept, dict(again.failed)) == (2, 10, {})

    monkeypatch.setattr(worker, "write_recording", lambda *_: {}["all"])
    with pytest.raises(
        AmiwarpError, match=r"no sample of pictures can be made; \w+/\S+: KeyError: 'all' \(in "
    ):
        amiwarp.plan_dataset(place / "spec.toml", place / "elsewhere", workers=1)

    (item, *_) = items_of(place / "spec.toml")
    job = worker.Job(item, place, place, "cpu", 1)
    dead: Future[Any] = Future()
    dead.set_exception(type("KilledWorker", (Exception,), {})("make-1"))
    message = "its worker died, out of memory or killed: KilledWorker: make-1"
    assert making._result(job, dead) == worker.Failed(item.key, message)
    for ending in (KeyboardInterrupt(), AmiwarpError("the worker on here does not see the folder")):
        future: Future[Any] = Future()
        future.set_exception(ending)
        with pytest.raises(type(ending)):
            making._result(job, future)


def test_a_finished_recording_that_cannot_be_read_is_made_again(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(place)
    before = checksums(place)
    lost = place / "out" / min(before)

    def planted(path: Path, **_: Any) -> str:
        if path == lost:
            lost.unlink()
            raise AmiwarpError(f"{path}: cannot be read: Input/output error")
        return hashlib.sha256(path.read_bytes()).hexdigest()

    monkeypatch.setattr("amiwarp.learning.dataset.stored.content_digest", planted)
    again = make(place)
    assert (again.made, again.kept) == (1, 11)
    assert again.damaged == (f"{lost}: cannot be read: Input/output error",)
    assert checksums(place) == before


def test_the_manifest_of_an_interrupted_run_says_that_recordings_are_missing(place: Path) -> None:
    def stop_at_third(step: str, _share: float) -> None:
        if step.startswith("3 of 12"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(place, progress=stop_at_third)
    found = manifest(place)
    assert (found["complete"], found["recordings"], len(found["items"]), found["failed"]) == (
        False,
        12,
        3,
        [],
    )
    assert (make(place).kept, manifest(place)["complete"]) == (3, True)


def test_a_killed_run_is_continued(place: Path) -> None:
    (place / "spec.toml").write_text("seeds = 4\n" + BASE + PICTURES)
    journal = place / "out" / JOURNAL
    command = [
        "dataset",
        str(place / "spec.toml"),
        str(place / "out"),
        "--workers",
        "1",
        "--device",
        "cpu",
    ]
    with subprocess.Popen(
        [sys.executable, "-m", "amiwarp", *command], stderr=subprocess.DEVNULL
    ) as process:
        end = time.monotonic() + 60.0
        while process.poll() is None and (
            not journal.exists() or len(journal.read_bytes().splitlines()) < 3
        ):
            assert time.monotonic() < end
            time.sleep(0.005)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    kept = len(list(read_journal(journal, dict, [])))
    assert 3 <= kept < 48
    append_line(journal, {"key": "cut off"})
    journal.write_bytes(journal.read_bytes()[:-4])
    assert any(p.name.startswith(".scratch") for p in (place / "out").iterdir())
    done = make(place)
    assert (done.kept, done.made) == (kept, 48 - kept)
    assert {item["file"]: item["sha256"] for item in manifest(place)["items"]} == checksums(place)
    assert not any(p.name.startswith(".") for p in (place / "out").iterdir())
    assert make(place).kept == 48


def test_a_dry_run_makes_nothing(place: Path) -> None:
    result = run(
        place / "spec.toml",
        place / "out",
        "--dry-run",
        "--workers",
        "2",
        "--device",
        "cpu",
        "--json",
    )
    assert result.exit_code == 0, result.output
    plan = json.loads(result.stdout)
    assert (plan["recordings"], plan["missing"], plan["sources"]) == (12, 12, {"pictures": 12})
    assert (plan["samples"], plan["workers"]) == (12, 2)
    assert plan["seconds"] == pytest.approx(plan["worker_seconds"] / 2, rel=1e-12)
    assert {p.name for p in place.iterdir()} == {"pictures", "spec.toml"}
    done = make(place)
    assert (plan["events"], plan["size_bytes"]) == (done.events, done.size_bytes)
    text = run(place / "spec.toml", place / "out", "--dry-run", "--device", "cpu").stdout
    assert "12 recordings (12 of pictures), 0 of them missing" in text
    (place / "spec.toml").write_text(
        BASE.replace("0.01", "0.4").replace("24, 18", "16, 12") + PICTURES
    )
    long = amiwarp.plan_dataset(place / "spec.toml", place / "out", workers=1)
    made = make(place)
    assert long.events == pytest.approx(made.events, rel=0.1)
    assert long.size_bytes == pytest.approx(made.size_bytes, rel=0.1)


@pytest.mark.filterwarnings("ignore::DeprecationWarning:distributed.*")
def test_a_cluster_makes_the_same_files(place: Path) -> None:
    import dask
    import distributed

    make(place)
    alone = checksums(place)
    with (
        dask.config.set(cluster.LOCAL_CONFIGURATION),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, dashboard_address="127.0.0.1:0"
        ) as local,
    ):
        words = (
            place / "spec.toml",
            place / "other",
            "--scheduler",
            local.scheduler_address,
            "--device",
            "cpu",
        )
        result = run(*words, "--json")
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert (data["made"], data["workers"]) == (12, 1)
    found = json.loads((place / "other" / MANIFEST).read_text())
    assert {item["file"]: item["sha256"] for item in found["items"]} == alone


def test_few_jobs_wait_and_the_rest_is_not_read() -> None:
    taken: list[int] = []

    def jobs() -> Any:
        for k in range(1000):
            taken.append(k)
            yield k

    with single_worker() as alone:
        results = run_jobs(Workers(alone.executor, lambda: 3), str, jobs())
        job, future = next(results)
        assert future.result() == str(job)
        assert len(taken) == 6
        results.close()
        assert len(taken) == 6
        assert sorted(f.result() for _, f in run_jobs(alone, str, range(5))) == list("01234")


def spread(items: list[Any]) -> dict[Any, dict[str, int]]:
    """Return how many different sources of each class lie in each split."""
    found: dict[Any, dict[str, set[str]]] = {}
    for item in items:
        of = (
            f"{item.source} {item.recipe['seed']}"
            if item.kind == "worlds"
            else item.recipe["source"]["sha256"]
        )
        found.setdefault(item.labels["class"], {}).setdefault(item.split, set()).add(of)
    for splits in found.values():
        # None lies in two
        assert len(set().union(*splits.values())) == sum(map(len, splits.values()))
    return {
        value: {name: len(of) for name, of in splits.items()} for value, splits in found.items()
    }


def test_splits_are_stratified_by_class(place: Path) -> None:
    rng = np.random.default_rng(3)
    for folder, count in (("disc", 40), ("square", 25)):
        for k in range(3, count):
            Image.fromarray(rng.integers(0, 256, (4, 4), np.uint8)).save(
                place / "pictures" / folder / f"new{k}.png"
            )
    copy = place / "pictures" / "disc" / "copy.png"
    copy.write_bytes((place / "pictures" / "disc" / "0.png").read_bytes())
    worlds = '[[sources]]\nworlds = ["room"]\nlabels = {class = "room"}\n'
    text = 'stratify = "class"\nseeds = 10\n' + BASE + PICTURES + worlds
    (place / "spec.toml").write_text(text)
    items = items_of(place / "spec.toml")
    # 25 * 0.1 = 2.5 is rounded to 3 and 2: the first of two equal remainders gets the source
    expected = {"disc": (32, 4, 4), "square": (20, 3, 2), "room": (8, 1, 1)}
    assert spread(items) == {
        name: dict(zip(("train", "val", "test"), of, strict=True)) for name, of in expected.items()
    }
    assert [i.split for i in items_of(place / "spec.toml")] == [i.split for i in items]
    (place / "spec.toml").write_text("split_seed = 1\n" + text)
    other = items_of(place / "spec.toml")
    assert spread(other) == spread(items)
    assert [i.split for i in other] != [i.split for i in items]
    (place / "pictures" / "disc" / "one_more.png").write_bytes(b"a")
    (place / "spec.toml").write_text(text)
    more = {item.key: item.split for item in items_of(place / "spec.toml")}
    moved = {item.source for item in items if more[item.key] != item.split}
    assert len(moved) <= 3


@pytest.mark.parametrize("total", [3, 4, 7, 10, 51])
@pytest.mark.parametrize("shares", [(0.8, 0.1, 0.1), (0.98, 0.01, 0.01), (0.5, 0.25, 0.25)])
def test_each_split_gets_its_share_and_at_least_one(
    tmp_path: Path, total: int, shares: tuple[float, ...]
) -> None:
    for k in range(total):
        (tmp_path / f"{k}.png").write_bytes(bytes([k]))
    splits = f"splits = {{a = {shares[0]}, b = {shares[1]}, c = {shares[2]}}}\n"
    (tmp_path / "spec.toml").write_text(splits + BASE + '[[sources]]\npictures = "*.png"\n')
    counts = list(divided(tmp_path / "spec.toml")["all sources"].values())
    assert sum(counts) == total
    assert len(counts) == 3
    for count, share in zip(counts, shares, strict=True):
        assert count == 1 or abs(count - share * total) < 1.0 + (
            counts.count(1) if total * min(shares) < 1.0 else 0
        )


def test_each_class_is_divided_unless_another_rule_is_given(place: Path) -> None:
    """Ten sources of a label give six, two and two of each; one class too small, and all are divided together."""
    rng = np.random.default_rng(3)
    for folder, count in (("disc", 7), ("square", 7)):
        for k in range(count):
            Image.fromarray(rng.integers(0, 256, (4, 4), np.uint8)).save(
                place / "pictures" / folder / f"new{k}.png"
            )
    shares = "splits = {train = 0.6, val = 0.2, test = 0.2}\n"
    (place / "spec.toml").write_text(shares + BASE + PICTURES)
    six = {"train": 6, "val": 2, "test": 2}
    assert divided(place / "spec.toml") == {"class = 'disc'": six, "class = 'square'": six}
    result = run(
        place / "spec.toml", place / "out", "--dry-run", "--workers", "1", "--device", "cpu"
    )
    assert (
        "sources: train 12, val 4, test 4; divided by class = 'disc': train 6, val 2, test 2; class = 'square': "
        "train 6, val 2, test 2 (the field stratify gives another rule)" in result.stdout
    )
    (place / "spec.toml").write_text("stratify = false\n" + shares + BASE + PICTURES)
    drawn = divided(place / "spec.toml")
    assert list(drawn) == [""]
    assert sum(drawn[""].values()) == 20
    assert drawn[""]["train"] != 12
    for k in range(7):
        (place / "pictures" / "square" / f"new{k}.png").unlink()
    (place / "pictures" / "square" / "1.png").unlink()
    (place / "spec.toml").write_text(shares + BASE + PICTURES)
    assert divided(place / "spec.toml") == {"all sources": {"train": 7, "val": 3, "test": 2}}
    (place / "spec.toml").write_text("stratify = true\n" + shares + BASE + PICTURES)
    with pytest.raises(
        AmiwarpError, match=r"stratify is True; expected the name of a label, or false"
    ):
        items_of(place / "spec.toml")


def test_one_source_of_many_splits_is_for_training(place: Path) -> None:
    (place / "spec.toml").write_text(BASE + PICTURES.replace("*/*", "disc/0"))
    assert divided(place / "spec.toml") == {"all sources": {"train": 1}}


def test_a_spread_that_one_sample_cannot_tell_is_not_zero(place: Path) -> None:
    one = BASE.replace(', {apex_deg = 2.0, flat_side = "camera"}', "")
    (place / "spec.toml").write_text(one + PICTURES.replace("*/*", "disc/0"))
    words = (place / "spec.toml", place / "out", "--dry-run", "--workers", "1", "--device", "cpu")
    text = run(*words).stdout
    assert "(spread unknown: a kind of source has only one sample)" in text
    assert json.loads(run(*words, "--json").stdout)["uncertainty"] is None
    (place / "spec.toml").write_text(BASE + PICTURES.replace("*/*", "disc/0"))
    all_sampled = amiwarp.plan_dataset(place / "spec.toml", place / "out", workers=1)
    assert all_sampled.samples == all_sampled.recordings == 2
    assert all_sampled.uncertainty is not None
    assert all_sampled.uncertainty > 0.0


def test_what_cannot_be_stratified_is_named(place: Path) -> None:
    def fails(message: str) -> None:
        with pytest.raises(AmiwarpError, match=message):
            items_of(place / "spec.toml")

    text = 'stratify = "class"\n' + BASE + PICTURES
    (place / "spec.toml").write_text(text.replace('"class"', '"colour"', 1))
    fails(
        r"spec\.toml: field stratify is 'colour': pictures/disc/0\.png has no such label; add it, or remove"
    )
    (place / "spec.toml").write_text(text + '[[sources]]\nworlds = ["room"]\n')
    fails("room has no such label")
    (place / "spec.toml").write_text(text)
    (place / "pictures" / "square" / "5.png").unlink()
    fails(
        r"class = 'square' has 2 different sources for the 3 splits train, val, test; add sources of it, or give fewer"
    )
    (place / "spec.toml").write_text("splits = {train = 0.5, test = 0.5, val = 0.0}\n" + text)
    assert len(items_of(place / "spec.toml")) == 10
    (place / "pictures" / "square" / "5.png").write_bytes(
        (place / "pictures" / "disc" / "0.png").read_bytes()
    )
    fails(
        r"disc/0\.png and pictures/square/5\.png have the same content but the labels 'disc' and 'square'; remove"
    )


PLAIN = """
duration_s = 0.05
no_prism = true
sensors = ["ideal"]
camera = {size = [24, 18], fov_deg = 40.0}
[[sources]]
pictures = "pictures/*/*.png"
rotate_deg_s = [0.0, 200.0, 0.0]
label_from_folder = "class"
"""


def test_plain_cameras_have_neither_prism_nor_encoder(place: Path) -> None:
    (place / "spec.toml").write_text(HEAD + PLAIN)
    assert make(place).failed == {}
    items = manifest(place)["items"]
    assert len(items) == 6
    for item in items:
        assert [item[name] for name in ("apex_deg", "index", "flat_side", "rpm")] == [None] * 4
        assert item["labels"] == {"class": Path(item["source"]).parent.name}
        recording = amiwarp.open_recording(place / "out" / item["file"])
        assert (recording.prism, recording.encoder) == (None, None)
        assert recording.truth is not None
        assert len(recording.events) == item["events"] > 100
    (item, *_) = items_of(place / "spec.toml")
    expected = amiwarp.Simulation(
        amiwarp.Scene.from_picture(place / item.source), amiwarp.Camera.from_fov(24, 18, math.radians(40.0)),
        amiwarp.Prism(0.0), 0.05, camera_motion=amiwarp.CameraMotion((0.0, math.radians(200.0), 0.0)),
        sensor=amiwarp.SensorModel.ideal(), encoder_model=None, seed=item.seed,
    ).run()  # fmt: skip
    made = amiwarp.open_recording(place / "out" / item.file)
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(
            getattr(made.events.slice(0, 10**9), name),
            getattr(expected.events.slice(0, 10**9), name),
        )


GRIDS = 'output = {representation = "voxel_grid", bins = 3, normalize = true}\n'


def test_tensors_are_those_of_the_recordings(place: Path, device: str) -> None:
    (place / "spec.toml").write_text(HEAD + PLAIN)
    kind = "cpu" if device == "cpu" else ANY_GPU
    assert make(place, device=kind).failed == {}
    (place / "grids.toml").write_text(HEAD + GRIDS + PLAIN)
    done = make_dataset(place / "grids.toml", place / "grids", workers=1, device=kind)
    assert (done.made, done.failed) == (6, {})
    recorded = {item["seed"]: item for item in manifest(place)["items"]}
    to_grid = amiwarp.ToTensor(amiwarp.voxel_grid, bins=3, normalize=True)
    made = json.loads((place / "grids" / MANIFEST).read_text())["items"]
    for item, (tensor, labels) in zip(made, amiwarp.RecordedDataset(place / "grids"), strict=True):
        other = recorded[item["seed"]]
        assert (item["representation"], other["representation"]) == ("voxel_grid", None)
        assert [item[k] for k in ("events", "split", "source")] == [
            other[k] for k in ("events", "split", "source")
        ]
        assert labels == other["labels"]
        expected = to_grid(amiwarp.open_recording(place / "out" / other["file"]))
        assert (tensor.dtype, tensor.shape) == (np.float32, (3, 18, 24))
        np.testing.assert_array_equal(tensor, expected)
        assert np.abs(tensor).max() > 0.0
        digest = hashlib.sha256((place / "grids" / item["file"]).read_bytes()).hexdigest()
        assert item["sha256"] == digest
    assert make_dataset(place / "grids.toml", place / "grids", workers=1, device=kind).kept == 6


def test_windows_between_given_times_make_a_batch(place: Path) -> None:
    output = (
        'output = {representation = "event_count", window_us = 9000, t_start = 0, t_end = 50000}\n'
    )
    (place / "counts.toml").write_text(HEAD + output + PLAIN)
    assert (
        make_dataset(place / "counts.toml", place / "counts", workers=1, device="cpu").failed == {}
    )
    assert {tensor.shape for tensor, _ in amiwarp.RecordedDataset(place / "counts")} == {
        (5, 18, 24)
    }


MOVING = """
format = "amiwarp-world"
version = 1
ambient = 1.0
[[bodies]]
name = "wall"
mesh = "tile.obj"
scale = 4.0
position = [0.0, 0.0, 6.0]
material = {reflectance = 0.2}
[[bodies]]
name = "sliding"
mesh = "tile.obj"
material = {reflectance = 0.9}
trajectory = [{t = 0.0, position = [-0.9, -0.1, 3.0]}, {t = 0.1, position = [-0.7, 0.0, 2.8]}]
[[bodies]]
name = "turning"
mesh = "tile.obj"
material = {reflectance = 0.6}
trajectory = [
    {t = 0.0, position = [0.7, 0.1, 3.0], rotation = [0.0, 0.0, 0.0, 1.0]},
    {t = 0.1, position = [0.7, 0.0, 3.0], rotation = [0.08, 0.05, 0.30, 0.9488]},
]
[camera]
trajectory = [{t = 0.0, position = [0.0, 0.0, 0.0]}, {t = 0.1, position = [0.05, 0.02, 0.1]}]
"""
TRUTH_HZ = 50.0


@pytest.fixture
def moving(place: Path) -> Path:
    """Folder with a world in which a tile slides, another one turns, and the camera moves."""
    corners = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
    faces = "f 1 2 3\nf 1 3 4\nf 3 2 1\nf 4 3 1\n"
    (place / "tile.obj").write_text("".join(f"v {x} {y} 0\n" for x, y in corners) + faces)
    (place / "moving.toml").write_text(MOVING)
    (place / "spec.toml").write_text(
        HEAD + f"duration_s = 0.05\nno_prism = true\ntruth_hz = {TRUTH_HZ}\nsensors = ['ideal']\n"
        "camera = {size = [64, 48], fov_deg = 60.0}\n[[sources]]\nworld_files = 'moving.toml'\n"
    )
    return place


def pose_at(name: str, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation matrix and position of a body or of the camera of :data:`MOVING` at a time [s]."""
    world = tomllib.loads(MOVING)
    entry = next((body for body in world["bodies"] if body["name"] == name), world["camera"])
    if "trajectory" not in entry:
        return np.eye(3), np.array(entry["position"])
    first, last = entry["trajectory"]
    share = t / 0.1
    axis, w = (
        np.array(last.get("rotation", (0.0, 0.0, 0.0, 1.0)))[:3],
        last.get("rotation", (0.0, 0.0, 0.0, 1.0))[3],
    )
    sine = np.linalg.norm(axis)
    angle = 2.0 * np.arctan2(sine, w) * share
    x, y, z = axis / max(sine, 1e-30)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return rotation, (1.0 - share) * np.array(first["position"]) + share * np.array(
        last["position"]
    )


def recording_of(recording: amiwarp.Recording, labels: dict[str, Any]) -> amiwarp.Recording:
    return recording


def test_flow_of_moving_bodies_is_what_finite_differences_say(moving: Path, device: str) -> None:
    """Points of tiles, seen without a prism, are projected a moment before and after each instant, in float64."""
    assert make(moving, device="cpu" if device == "cpu" else ANY_GPU).failed == {}
    (recording,) = amiwarp.RecordedDataset(moving / "out", transform=recording_of)
    assert recording.truth is not None
    truth, camera = recording.truth, recording.camera
    assert truth.frames is not None
    assert truth.labels is not None
    assert truth.stored_instances is not None
    assert camera is not None
    instances = truth.stored_instances[0 : len(recording.events)]
    assert truth.frames.t.tolist() == [0, 20_000, 40_000]
    x, y = np.meshgrid(np.arange(64.0), np.arange(48.0))
    rays = np.stack(
        [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1
    )
    rotations = {}
    for k, t_us in enumerate(truth.frames.t[1:].tolist(), 1):
        frame, t, h = truth.frames[k], t_us * 1e-6, 1e-5
        for number, name in enumerate(truth.labels.instances, 1):
            on = frame.instance == number
            assert on.sum() > 50
            camera_rotation, camera_position = pose_at("camera", t)
            points = (
                camera_position
                + (rays[on] * frame.depth[on][:, None].astype(float)) @ camera_rotation.T
            )
            rotation, position = pose_at(name, t)
            local = (points - position) @ rotation
            np.testing.assert_allclose(local[:, 2], 0.0, rtol=0, atol=1e-5)  # m: on the tile
            ends = []
            for later in (t - h, t + h):
                rotation, position = pose_at(name, later)
                camera_rotation, camera_position = pose_at("camera", later)
                seen = (local @ rotation.T + position - camera_position) @ camera_rotation
                ends.append(
                    seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
                )
            expected = (ends[1] - ends[0]) / (2.0 * h)
            np.testing.assert_allclose(frame.flow[on], expected, rtol=0, atol=0.05)  # px/s
            np.testing.assert_allclose(frame.flow_with_prism[on], expected, rtol=0, atol=0.05)
            rotations[name] = np.ptp(expected, axis=0).max()
            assert np.abs(expected).max() > 5.0
        # the events of about that time lie on the bodies where the frame shows them
        events = recording.events.slice(0, len(recording.events))
        near = np.abs(events.t - t_us) < 2000
        assert near.sum() > 20
        patches = np.pad(frame.instance, 1, mode="edge")
        shown = [instances[i] in patches[events.y[i] : events.y[i] + 3, events.x[i] : events.x[i] + 3]
                 for i in np.flatnonzero(near)]  # fmt: skip
        assert np.mean(shown) == 1.0
    assert rotations["turning"] > 3.0 * rotations["wall"]


def test_tensors_of_windows_with_the_truth_of_a_world(
    moving: Path, recording: amiwarp.Recording
) -> None:
    output = 'output = {representation = "event_count", window_us = 9000}\n'
    text = (moving / "spec.toml").read_text().replace("[[sources]]", output + "[[sources]]", 1)
    (moving / "spec.toml").write_text(text + "[[sources]]\nrecordings = 'a.h5'\n")
    amiwarp.save_recording(moving / "a.h5", recording)
    assert make(moving).failed == {}
    rows = manifest(moving)["items"]
    dataset = amiwarp.RecordedDataset(moving / "out", transform=arrays_of)
    items = {item.file: item for item in items_of(moving / "spec.toml")}
    for row, arrays in zip(rows, dataset, strict=True):
        events = recording.events.slice(0, 10**9)
        if row["source_kind"] != "recordings":
            simulated = worker.simulation_of(items[row["file"]], "cpu").run(truth_hz=TRUTH_HZ)
            events = simulated.events.slice(0, 10**9)
            assert simulated.truth is not None
            assert simulated.truth.frames is not None
            assert arrays["truth_t"].tolist() == [0, 20_000, 40_000]
            for k in range(3):
                for name in ("depth", "flow", "instance", "intensity"):
                    np.testing.assert_array_equal(
                        arrays[name][k], getattr(simulated.truth.frames[k], name)
                    )
        edges = np.arange(events.t[0], events.t[-1] + 1, 9000)
        assert arrays["t_start"].tolist() == edges[:-1].tolist()
        assert arrays["t_end"].tolist() == edges[1:].tolist()
        expected = np.zeros((len(edges) - 1, row["height"], row["width"]), int)
        whole = events.t < edges[-1]
        np.add.at(
            expected, ((events.t[whole] - edges[0]) // 9000, events.y[whole], events.x[whole]), 1
        )
        np.testing.assert_array_equal(arrays["tensor"], expected)
        assert expected.sum() > 100


def arrays_of(arrays: dict[str, np.ndarray], labels: dict[str, Any]) -> dict[str, np.ndarray]:
    return arrays


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ('"voxel_grid"', "field output is 'voxel_grid'; expected an object"),
        ("{bins = 3}", "field output.representation is missing; add this field"),
        ('{representation = "voxels"}', "field output.representation is 'voxels'; choose among event_count"),
        ('{representation = "voxel_grid"}', "field output.bins is missing; voxel_grid needs it"),
        ('{representation = "tore_volume"}', "field output.depth is missing; tore_volume needs it"),
        ('{representation = "mixed_density_stack", stacks = 33}', "field output.stacks = 33 is not"),
        ('{representation = "voxel_grid", bins = 0}', "field output.bins = 0 is not a whole number"),
        ('{representation = "voxel_grid", bins = 2000000}', "field output.bins = 2000000 is not a whole number in 1"),
        ('{representation = "event_count", t_start = 5, t_end = 1}', "field output.t_end is 1 us, before output.t_st"),
        ('{representation = "event_count", bins = 3}', "field output.bins does not apply to event_count; remove it"),
        ('{representation = "stacked_histogram", bins = 3, limit = 300}', "field output.limit = 300 is not"),
        ('{representation = "time_surface", tau_us = 0.0}', r"field output.tau_us = 0\.0 is not"),
        ('{representation = "event_count", window_us = 9, window_events = 9}', "has window_us and window_events; give"),
        ('{representation = "event_count", window_events = 9, t_end = 9}', "has window_events and t_end; give one"),
    ],
)  # fmt: skip
def test_a_wrong_output_is_named(place: Path, output: str, message: str) -> None:
    (place / "spec.toml").write_text(BASE + f"output = {output}\n" + PICTURES)
    with pytest.raises(AmiwarpError, match=message):
        items_of(place / "spec.toml")


def test_plain_cameras_and_prisms_see_the_same_world(place: Path) -> None:
    worlds = (
        '[[sources]]\nworlds = ["room"]\ntrajectories = ["handheld"]\nlabels = {class = "room"}\n'
    )
    (place / "spec.toml").write_text(BASE + "seeds = 2\ntruth_hz = 100.0\n" + worlds)
    alone = {item.key for item in items_of(place / "spec.toml")}
    (place / "spec.toml").write_text(
        BASE + "no_prism = true\nseeds = 2\ntruth_hz = 100.0\n" + worlds
    )
    items = items_of(place / "spec.toml")
    assert alone < {item.key for item in items}
    assert len(items) == 6  # two prisms and a plain camera, two seeds
    pairs = [[i for i in items if i.recipe["seed"] == seed] for seed in (0, 1)]
    assert all(len({i.split for i in pair}) == 1 for pair in pairs)
    plain, ami = (
        next(i for i in pairs[1] if (i.recipe["prism"] is None) == kind) for kind in (True, False)
    )
    frames = []
    for item in (plain, ami):
        worker.write_recording(item, place / f"{item.key}.h5", "cpu")
        recording = amiwarp.open_recording(place / f"{item.key}.h5")
        assert (recording.encoder is None) == (item is plain)
        assert recording.truth is not None
        assert recording.truth.frames is not None
        frames.append(recording.truth.frames[1])
    for name in ("depth", "instance", "flow", "rotation", "position"):
        np.testing.assert_array_equal(getattr(frames[0], name), getattr(frames[1], name))
    np.testing.assert_allclose(frames[0].flow_with_prism, frames[0].flow, rtol=0, atol=1e-3)  # px/s
    assert np.nanmax(np.abs(frames[1].flow_with_prism - frames[1].flow)) > 1.0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("no_prism = true", "no_prism = 1", "field no_prism is 1; expected true or false"),
        ("no_prism = true", "no_prism = false", "field prisms is missing; add"),
        ("no_prism = true", "no_prism = true\nspeeds_rpm = [90.0]", "prisms is empty; .* remove both prisms and"),
        ("no_prism", "prisms = [{apex_deg = 1.0}]\nno_prism", "speeds_rpm is empty; give at least one entry or, for"),
        ("rotate_deg_s = [0.0, 200.0, 0.0]", "", r"sources\[0\]\.pictures stand still, .* with rotate_deg_s"),
        ("[0.0, 200.0, 0.0]", "[0.0, 200.0]", r"field sources\[0\]\.rotate_deg_s has 2 entries; expected 3"),
        ("pictures =", "videos =", r"field sources\[0\]\.rotate_deg_s does not apply to videos; remove it"),
        ("[[sources]]", '[[sources]]\ntranslated = "a.h5"\n[[sources]]', "is of a plain camera already, but no_"),
    ],
)  # fmt: skip
def test_what_contradicts_a_plain_camera_is_named(
    place: Path, old: str, new: str, message: str
) -> None:
    assert old in PLAIN
    (place / "spec.toml").write_text(HEAD + PLAIN.replace(old, new, 1))
    with pytest.raises(AmiwarpError, match=message):
        items_of(place / "spec.toml")


def test_other_sources(place: Path, recording: amiwarp.Recording) -> None:
    video = place / "films" / "one"
    video.mkdir(parents=True)
    for k in range(3):
        Image.fromarray(np.kron(np.eye(3, 4, k - 1) * 255, np.ones((8, 8))).astype(np.uint8)).save(
            video / f"{k}.png"
        )
    amiwarp.save_recording(place / "real.h5", recording)
    (place / "poses.csv").write_text("t,x,y,z,qx,qy,qz,qw\n0,0,0,1.2,0,0,0,1\n1,0,0,1.3,0,0,0,1\n")
    (place / "tile.obj").write_text("v -1 -1 3\nv 1 -1 3\nv 0 1 3\nf 1 3 2\n")
    (place / "tile.toml").write_text(
        'format = "amiwarp-world"\nversion = 1\nbodies = [{name = "tile", mesh = "tile.obj"}]\n'
    )
    table = "file,speed,code,name\nreal.h5,1.5,007,a\nother.h5,2,1,b\n"
    (place / "labels.csv").write_text(table, encoding="utf-8-sig")  # as Excel's "CSV UTF-8"
    (place / "spec.toml").write_text(
        HEAD
        + "duration_s = 0.01\nprisms = [{apex_deg = 1.0}]\nspeeds_rpm = [900.0]\ntruth_hz = 200.0\n"
        'sensors = [{name = "mine", preset = "gen4", refractory_us = 5.0}]\n'
        '[[sources]]\nvideos = "films/*"\nfps = 200.0\n[[sources]]\nrecordings = "*.h5"\nlabel_table = "labels.csv"\n'
        'licence = "CC-BY-4.0"\n[[sources]]\nworld_files = "tile.toml"\ntrajectories = ["poses.csv"]\n'
        "[camera]\nsize = [24, 18]\n"
    )
    assert make(place).failed == {}
    film, real, world = manifest(place)["items"]
    assert (world["trajectory"], world["source_kind"]) == ("poses.csv", "world_files")
    seen = amiwarp.open_recording(place / "out" / world["file"]).truth
    assert seen is not None
    assert seen.frames is not None
    assert seen.frames.t.tolist() == [0, 5000, 10_000]
    assert (film["source"], film["duration_s"], film["sensor"], film["labels"]) == (
        "films/one",
        0.015,
        "mine",
        {},
    )
    opened = amiwarp.open_recording(place / "out" / real["file"])
    events = recording.events
    assert real["labels"] == {"speed": 1.5, "code": "007", "name": "a"}
    assert (real["events"], real["seed"], real["apex_deg"]) == (len(events), None, None)
    assert real["duration_s"] == pytest.approx((events.t_last - events.t_first) * 1e-6, abs=1e-9)
    np.testing.assert_array_equal(opened.events.slice(0, 10**9).t, events.slice(0, 10**9).t)
    assert [one["licence"] for one in manifest(place)["licences"]] == ["not stated", "CC-BY-4.0"]


def changed(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


WRONG: dict[str, tuple[Callable[[str], str], str]] = {
    "no TOML": (lambda text: text + "[", "cannot be read as a specification of a data set"),
    "version": (changed("version = 1", "version = 2"), "are 'amiwarp-dataset-specification' and 2; expected"),
    "unknown": (changed("speeds_rpm", "speed_rpm"), "field speeds_rpm is missing; add"),
    "near": (changed("sensors", "sensor"), r"field sensor is unknown; .*; did you mean sensors\?"),
    "prism": (changed("flat_side = ", "flatside = "), r"prisms\[1\]\.flatside is unknown.* did you mean flat_side\?"),
    "apex": (changed("apex_deg = 1.0", "apex_deg = 40.0"), r"field prisms\[0\]: prism apex = 0\.698.* 0 \.\. 30 deg"),
    "twice": (changed("[1800.0]", "[90.0, 90.0]"), r"field speeds_rpm\[1\] repeats speeds_rpm\[0\]; remove it"),
    "none": (changed("[1800.0]", "[]"), "field speeds_rpm is empty; give at least one entry"),
    "duration": (changed("= 0.01", '= "long"'), "field duration_s = 'long' is not a finite number"),
    "sensor": (changed('"ideal"', '"davis"'), r"field sensors\[0\]: sensor preset is 'davis'; choose among"),
    "sensor value": (
        changed('"ideal"', '{name = "a", leak_hz = -1.0}'), r"field sensors\[0\]: sensor leak_hz = -1\.0 is not"
    ),
    "sensor field": (changed('"ideal"', '{name = "a", leak = 1.0}'), r"sensors\[0\]\.leak is unknown.* mean leak_hz\?"),
    "seeds": (changed("sensors", "seeds = 0\nsensors"), "field seeds = 0 is not .*; give their number, or a list"),
    "seed twice": (changed("sensors", "seeds = [4, 4]\nsensors"), r"field seeds\[1\] repeats seeds\[0\]; remove it"),
    "sensor number": (changed('"ideal"', '{name = "a", leak_hz = "x"}'), r"field sensors\[0\]\.leak_hz = 'x' is not a"),
    "splits": (changed("sensors", "splits = {train = 0.5}\nsensors"), "sum to 0.5; change them"),
    "split name": (changed("sensors", 'splits = {"../a" = 1.0}\nsensors'), r"has the name '\.\./a'; use letters"),
    "camera": (changed("fov_deg = 40.0", "fov_deg = 190.0"), "field camera: "),
    "no files": (changed("*.png", "*.jpg"), r"field sources\[0\]\.pictures is 'pictures/\*/\*\.jpg', which matches no"),
    "two kinds": (changed("[[sources]]", "[[sources]]\nworlds = ['room']"), r"\[0\] has pictures and worlds; give"),
    "no kind": (changed('pictures = "pictures/*/*.png"', ""), r"\[0\] has no source; give one of pictures"),
    "fps": (changed("labels", "fps = 5.0\nlabels"), r"field sources\[0\]\.fps does not apply to pictures; remove it"),
    "label": (changed("indoor = true", "indoor = [1]"), r"labels\.indoor is \[1\]; expected text, a number"),
    "label number": (changed("indoor = true", "indoor = nan"), r"labels\.indoor = nan is not a finite number"),
    "many seeds": (changed("sensors", "seeds = 2000000000\nsensors"), "field seeds = 2000000000 is not a whole number"),
    "table": (changed("labels =", 'label_table = "none.csv"\nlabels ='), "none.csv: no such file"),
    "twice found": (lambda text: text + PICTURES, r"sources\[1\] names pictures/disc/0\.png, as does"),
    "world": (lambda text: text + '[[sources]]\nworlds = ["roon"]', r"\[1\]\.worlds is 'roon'; choose among room"),
    "label type": (
        lambda text: text + '[[sources]]\nworlds = ["room"]\nlabels = {indoor = "yes"}',
        r"sources\[1\] has the label indoor = 'yes', but in sources\[0\] it is of type bool; use one type",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_specification_is_named(place: Path, case: str) -> None:
    change, message = WRONG[case]
    (place / "spec.toml").write_text(change(BASE + PICTURES))
    with pytest.raises(AmiwarpError, match=message) as caught:
        make(place)
    assert "spec.toml" in str(caught.value) or case == "table"
    assert "\n" not in str(caught.value)
    assert not (place / "out").exists()


def test_a_wrong_call_is_named(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = (place / "spec.toml", place / "out", "--device", "cpu")
    assert "none.toml: no such file" in run(place / "none.toml", *words[1:]).stderr
    both = run(*words, "--workers", "2", "--scheduler", "tcp://127.0.0.1:1").stderr
    assert "workers = 2 applies to local processes" in both
    assert (
        "--dry-run samples on this machine"
        in run(*words, "--dry-run", "--scheduler", "tcp://127.0.0.1:1").stderr
    )
    assert "device 'cuda:7' is not available" in run(*words[:2], "--device", "cuda:7").stderr
    (place / "full").mkdir()
    (place / "full" / "thesis.doc").write_text("")
    assert (
        "full: holds other files, such as thesis.doc"
        in run(words[0], place / "full", *words[2:]).stderr
    )
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install 'amiwarp[dataset]'" in run(*words, "--workers", "2").stderr
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert "pip install 'amiwarp[dataset]'" in run(*words).stderr


def test_journal_leaves_out_what_was_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    damaged: list[str] = []
    assert list(read_journal(path, dict, damaged)) == []
    create_journal(path)
    for k in range(3):
        append_line(path, {"k": k})
    path.write_bytes(path.read_bytes()[:-3])
    append_line(path, {"k": 3})
    assert list(read_journal(path, dict, damaged)) == [{"k": 0}, {"k": 1}, {"k": 3}]
    assert len(damaged) == 1
    assert damaged[0].startswith(f"{path}: line 3: is not JSON: ")


def test_an_invented_journal_is_not_trusted(place: Path) -> None:
    """A line counts if its checksum, its values and the hash of its file are right. Others are made again, and said."""
    make(place)
    before, journal = checksums(place), place / "out" / JOURNAL
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    for line in lines:
        line.pop("checksum", None)
    journal.write_text(
        "".join(json.dumps({**line, "sha256": "0" * 64}) + "\n" for line in lines[:3])
    )
    for line in lines[3:5]:
        # Anybody can compute the checksum of a line
        append_line(journal, {**line, "sha256": "1" * 64})
    append_line(journal, {**lines[5], "file": "../secret.h5", "key": "0" * 16})
    append_line(journal, {**lines[5], "file": lines[6]["file"]})
    append_line(journal, {**lines[5], "events": 10**300})
    append_line(journal, {**lines[5], "colour": "red"})
    for line in (lines[6], lines[6], lines[7]):
        append_line(journal, line)
    journal.write_bytes(journal.read_bytes() + b"\xff" * 200_000 + b"[" * 100_000 + b"\n")
    done = make(place)
    assert (done.made, done.kept, done.failed) == (10, 2, {})
    assert len(done.damaged) == 3
    assert "line 1: field checksum is missing; 8 lines are damaged" in done.damaged[0]
    assert "does not have the checksum of journal.jsonl" in done.damaged[1]
    assert (
        {item["file"]: item["sha256"] for item in manifest(place)["items"]}
        == checksums(place)
        == before
    )
    journal.unlink()
    os.mkfifo(journal)
    with pytest.raises(
        AmiwarpError, match=r"journal\.jsonl: is a named pipe \(FIFO\); give a regular file"
    ):
        make(place)


def test_large_specifications_are_refused_or_read_in_linear_time(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = place / "spec.toml"
    path.write_text("seeds = 5000000\n" + BASE + PICTURES)
    with pytest.raises(
        AmiwarpError, match=r"field seeds = 5000000 is not a whole number in 1 \.\. 1000000"
    ):
        items_of(path)
    path.write_text("seeds = 1000000\n" + BASE + PICTURES)
    made: list[object] = []
    monkeypatch.setattr("amiwarp.learning.dataset.items.Item", lambda *values: made.append(values))
    with pytest.raises(
        AmiwarpError, match=r"spec\.toml: describes 12,000,000 recordings; divide it among"
    ):
        items_of(path)
    assert not made
    compared = 0

    class Seed(int):
        def __eq__(self, other: object) -> bool:
            nonlocal compared
            compared += 1
            return int(self) == other

        __hash__ = int.__hash__

    specification._check_distinct(tuple(map(Seed, range(60_000))), "seeds")
    assert compared < 60_000
    for dotted in (
        "a." * 200_000 + "a = 1",
        "[" + ' "a" .' * 40 + "a]",
        "x = {" + "a." * 33 + "a = 1}",
        r'"\"".' * 99,
    ):
        path.write_text(BASE + PICTURES + dotted + "\n")
        with pytest.raises(
            AmiwarpError, match=r"spec\.toml: .*line \d+ has a key of more than 32 parts; use"
        ):
            items_of(path)
    path.write_bytes(b"#" * (1 << 20) + b"\n")
    with pytest.raises(AmiwarpError, match=r"spec\.toml: .*is larger than 1 MiB"):
        items_of(path)


def test_a_pattern_visits_a_limited_number_of_entries(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "pictures" / "again").symlink_to(place)  # a loop
    (place / "pictures" / "self").symlink_to("self")
    for pattern in (
        "pictures/*/*.png",
        "**/[0-3].png",
        f"{place}/*/d*/0.png",
        "./pictures/disc/0.png",
        "pict*/../s*",
    ):
        expected = {
            f for f in glob(pattern, root_dir=place, recursive=True) if "again" not in Path(f).parts
        }
        assert sources.matches(place, pattern) == sorted(expected) != []
    monkeypatch.setitem(sources.matches.__globals__, "MOST_VISITED", 100)
    for k in range(100):
        (place / "pictures" / f"{k}.txt").touch()
    (place / "spec.toml").write_text(BASE + '[[sources]]\npictures = "/**/*.png"\n')
    with pytest.raises(
        AmiwarpError,
        match=r"sources\[0\]: pattern '/\*\*/\*\.png' leads through more than 100 files",
    ):
        make(place)


@pytest.mark.parametrize(
    ("seconds", "text"), [(5.4, "5 s"), (119.0, "119 s"), (150.0, "2.5 min"), (3e5, "3.5 days")]
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert making.duration_text(seconds) == text


def test_the_tutorial_s_classifier_beats_chance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tempfile, "mkdtemp", lambda: str(tmp_path))
    monkeypatch.setattr(plt, "show", lambda: None)
    found = runpy.run_path(str(ROOT / "docs" / "tutorials" / "08_data_set.py"))
    plt.close("all")
    tested = int((~found["train"]).sum())
    assert tested >= 15
    assert found["chance"] < 0.6
    assert found["accuracy"] > found["chance"] + 3.0 * math.sqrt(
        found["chance"] * (1.0 - found["chance"]) / tested
    )
    assert f"accuracy {found['accuracy']:.0%}" in capsys.readouterr().out


def test_a_mesh_or_a_file_of_poses_that_changed_is_seen(place: Path) -> None:
    (place / "spec.toml").write_text(
        BASE + '[[sources]]\nworld_files = "w.toml"\ntrajectories = ["poses.csv"]\n'
    )
    (place / "w.toml").write_text('bodies = [{mesh = "tile.obj"}]\n')
    keys = set()
    for mesh, poses in (("a", "a"), ("b", "a"), ("b", "b"), ("b", "b")):
        (place / "tile.obj").write_text(mesh)
        (place / "poses.csv").write_text(poses)
        keys |= {item.key for item in items_of(place / "spec.toml")}
    assert len(keys) == 3 * 2


def test_what_a_mesh_names_is_part_of_its_world(place: Path) -> None:
    """A changed texture of an OBJ file changes the keys of its recordings. A missing one does not stop the planning."""
    (place / "spec.toml").write_text(BASE + '[[sources]]\nworld_files = "w.toml"\n')
    (place / "w.toml").write_text('bodies = [{mesh = "tile.obj"}]\n')
    (place / "tile.obj").write_text(
        "mtllib tile.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n"
    )
    keys = []
    for name, grey in (("t.png", 0), ("t.png", 9), ("t.png\nKs 0 0 0", 9), ("no.png", 9)):
        (place / "tile.mtl").write_text(f"newmtl a\nmap_Kd {name}\n")
        Image.new("L", (4, 4), grey).save(place / "t.png")
        keys.append(items_of(place / "spec.toml")[0].key)
    assert len(set(keys)) == 4


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            "file,a,a\npictures/disc/0.png,1,2\n",
            "has the column 'a' twice; give each label one column",
        ),
        ("file,a\nx.png,1\n./x.png,2\n", r"has the file '.*x\.png' twice; keep one row of it"),
    ],
)
def test_a_table_with_two_labels_for_one_file_is_refused(
    place: Path, table: str, message: str
) -> None:
    (place / "labels.csv").write_text(table)
    (place / "spec.toml").write_text(
        BASE + '[[sources]]\npictures = "pictures/*/*.png"\nlabel_table = "labels.csv"\n'
    )
    with pytest.raises(AmiwarpError, match=f"labels.csv: .*{message}"):
        items_of(place / "spec.toml")


def test_the_specification_of_the_guide(place: Path) -> None:
    page = (ROOT / "docs" / "how-to" / "dataset.md").read_text()
    (place / "shapes.toml").write_text(page.partition("```toml\n")[2].partition("```")[0])
    items = items_of(place / "shapes.toml")
    assert len(items) == (6 + 2) * 2 * 2 * 2 * 2
    assert {item.labels["background"] for item in items} == {"grey", "room"}
    fast = [item.recipe["sensor"] for item in items if item.recipe["sensor"]["name"] == "fast"]
    assert {sensor["refractory_us"] for sensor in fast} == {20.0}
    (made,) = [line for line in page.splitlines() if line.startswith("Each item has ")]
    make(place)
    named = page[page.index(made) :].partition("Above")[0]
    assert [name for name in manifest(place)["items"][0] if f"`{name}`" not in named] == []


def test_recordings_are_those_of_the_simulator_on_each_device(place: Path, device: str) -> None:
    done = make(place, device="cpu" if device == "cpu" else ANY_GPU)
    assert (done.made, done.failed) == (12, {})
    items = {item.file: item for item in items_of(place / "spec.toml")}
    for row in manifest(place)["items"][:3]:
        recording = amiwarp.open_recording(place / "out" / row["file"])
        expected = worker.simulation_of(items[row["file"]], device).run().events
        assert (row["device"], row["events"]) == (device, len(expected))
        np.testing.assert_array_equal(
            recording.events.slice(0, 10**9).t, expected.slice(0, 10**9).t
        )
        np.testing.assert_array_equal(
            recording.events.slice(0, 10**9).x, expected.slice(0, 10**9).x
        )


@pytest.mark.parametrize("enabled", [True, False])
def test_python_3_11_collects_no_garbage_while_it_lists_frames(
    monkeypatch: pytest.MonkeyPatch, enabled: bool
) -> None:
    """Dask lists the frames of a worker every 10 ms, and a collection meanwhile may block all of its threads."""
    monkeypatch.setattr(quiet_start, "start_quietly", list)

    def frames() -> bool:
        return gc.isenabled()

    monkeypatch.setattr(sys, "_current_frames", frames)
    monkeypatch.setattr(sys, "version_info", (3, 11, 7))
    for _ in range(2):  # each command prepares the workers of a cluster
        cluster._prepare((), False, None)
    assert sys._current_frames.__wrapped__ is frames
    before = gc.isenabled()
    try:
        (gc.enable if enabled else gc.disable)()
        assert (sys._current_frames(), gc.isenabled()) == (False, enabled)
    finally:
        (gc.enable if before else gc.disable)()


def test_each_local_worker_sees_one_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quiet_start, "start_quietly", lambda: ["cpu", "cuda:0", "cuda:1"])
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert cluster._visible_gpus() == ("0", "1")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    # The preparation may change it
    monkeypatch.setattr(sys, "_current_frames", sys._current_frames)
    gpus = cluster._visible_gpus()
    assert gpus == ("3", "5")
    seen = []
    for name in range(5):
        cluster._prepare(gpus, False, SimpleNamespace(name=name))
        seen.append(os.environ["CUDA_VISIBLE_DEVICES"])
    assert seen == ["3", "5", "3", "5", "3"]
    assert [threads_of_worker(*of) for of in (("cpu", 8), (ANY_GPU, None), (ANY_GPU, 10**6))] == [
        1,
        None,
        1,
    ]
