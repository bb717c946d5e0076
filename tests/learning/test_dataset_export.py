"""Export of data sets: WebDataset's and Hugging Face's own readers, or others, get every event and label back."""

from __future__ import annotations

import gc
import io
import json
import re
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from amiwarp import AmiwarpError, Events, MemoryEvents, Recording, export_dataset, save_recording
from amiwarp.learning.dataset import export, parquet
from tests.command_line import app

COUNTS = {"train": (30, 0, 70, 20, 1), "val-1": (5,), "test": (9, 8)}


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """Data set of eight recordings in three splits, with random events."""
    rng = np.random.default_rng(7)
    root, items = tmp_path / "made", list[dict[str, Any]]()
    for split, counts in COUNTS.items():
        (root / split).mkdir(parents=True)
        for n in counts:
            file = f"{split}/a.b_{len(items)}-{len(items):016x}.h5"
            events = Events.from_arrays(
                rng.integers(0, 9, n),
                rng.integers(0, 7, n),
                2**40 + np.sort(rng.integers(0, 2**21, n)),
                rng.integers(0, 2, n),
            )
            save_recording(root / file, Recording(MemoryEvents(events, 9, 7)))
            labels = {"class": ("disc", "square")[len(items) % 2], "k": len(items)}
            items.append(
                {"file": file, "split": split, "labels": labels, "events": n, "licence": "CC0-1.0"}
            )
    manifest = {"format": "amiwarp-dataset", "version": 1, "name": "shapes", "items": items}
    (root / "manifest.json").write_text(json.dumps(manifest))
    return root


def columns_of(root: Path, k: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the events of recording k as stored in its HDF5 file, and its entry in the manifest."""
    import amiwarp

    entry = json.loads((root / "manifest.json").read_text())["items"][k]
    events = amiwarp.open_recording(root / entry["file"]).events.slice(0, 1000)
    return {name: getattr(events, name) for name in ("x", "y", "t", "p")}, entry


def check(root: Path, k: int, columns: Any) -> None:
    """Compare the columns of recording k with its file."""
    expected, _ = columns_of(root, k)
    for name, values in expected.items():
        np.testing.assert_array_equal(np.asarray(columns[name], values.dtype), values)


def run(*args: object) -> Result:
    return CliRunner().invoke(app, ["export", *(str(arg) for arg in args)])


def test_tar_files_hold_every_event_and_label(made: Path, tmp_path: Path) -> None:
    calls: list[tuple[str, float]] = []
    done = export_dataset(made, tmp_path / "out", "webdataset", progress=lambda *a: calls.append(a))
    assert (done.splits, done.events) == ({"train": 5, "val-1": 1, "test": 2}, 143)
    assert set(done.files) == {"train-000000.tar", "val-1-000000.tar", "test-000000.tar"}
    assert calls[-1] == ("8 of 8 recordings", 1.0)
    assert done.size_bytes == sum((tmp_path / "out" / name).stat().st_size for name in done.files)
    seen = {}
    for name in done.files:
        with tarfile.open(tmp_path / "out" / name) as archive:
            members = archive.getmembers()
            assert {member.mtime for member in members} == {0}
            for first, second in zip(members[::2], members[1::2], strict=True):
                key, ending = first.name.split(".", 1)
                assert (ending, second.name) == ("npz", f"{key}.json")
                entry = json.load(archive.extractfile(second) or io.BytesIO())
                with np.load(
                    io.BytesIO((archive.extractfile(first) or io.BytesIO()).read())
                ) as arrays:
                    check(made, entry["labels"]["k"], arrays)
                    assert (arrays["width"], arrays["height"]) == (9, 7)
                assert entry == columns_of(made, entry["labels"]["k"])[1]
                assert name.startswith(f"{entry['split']}-0")
                seen[key] = entry["labels"]["k"]
    assert sorted(seen.values()) == list(range(8))


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # it leaves its files open
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_webdataset_reads_the_tar_files(made: Path, tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset")
    done = export_dataset(made, tmp_path / "out", "webdataset", shard_mb=0.005)
    shards = sorted(str(tmp_path / "out" / name) for name in done.files if name.startswith("train"))
    assert len(shards) > 1
    samples = list(
        webdataset.WebDataset(shards, shardshuffle=False).decode().to_tuple("npz", "json")
    )
    assert sorted(labels["labels"]["k"] for _, labels in samples) == [0, 1, 2, 3, 4]
    for arrays, labels in samples:
        check(made, labels["labels"]["k"], arrays)
    gc.collect()  # closes its files in this test, where the warning is ignored


def test_parquet_holds_every_event_and_label(made: Path, tmp_path: Path) -> None:
    import pyarrow.parquet

    done = export_dataset(made, tmp_path / "out", "parquet", shard_mb=0.001)
    assert {name for name in done.files if "train" not in name} == {
        "data/val_1-00000-of-00001.parquet", "data/test-00000-of-00001.parquet"
    }  # fmt: skip
    train = [name for name in done.files if "train" in name]
    assert train == [f"data/train-{k:05}-of-{len(train):05}.parquet" for k in range(len(train))]
    assert len(train) > 1
    assert all(
        pyarrow.parquet.read_metadata(tmp_path / "out" / name).num_rows > 0 for name in done.files
    )
    rows = [
        row
        for name in done.files
        for row in pyarrow.parquet.read_table(tmp_path / "out" / name).to_pylist()
    ]
    assert sorted(row["label_k"] for row in rows) == list(range(8))
    for row in rows:
        check(made, row["label_k"], row)
        entry = columns_of(made, row["label_k"])[1]
        assert (row["label_class"], row["split"], row["width"]) == (
            entry["labels"]["class"],
            entry["split"],
            9,
        )
    named = re.findall(
        r"^  - split: (\S+)\n    path: (\S+)$",
        (tmp_path / "out" / "README.md").read_text(),
        re.MULTILINE,
    )
    assert {split for split, _ in named} == {"train", "val_1", "test"}
    globbed = [path for _, pattern in named for path in (tmp_path / "out").glob(pattern)]
    assert sorted(globbed) == sorted(tmp_path / "out" / name for name in done.files)
    types = pyarrow.parquet.read_schema(tmp_path / "out" / train[0])
    assert [str(types.field(name).type.value_type) for name in "xytp"] == [
        "uint16",
        "uint16",
        "int64",
        "uint8",
    ]


def test_hugging_face_reads_the_folder(made: Path, tmp_path: Path) -> None:
    datasets = pytest.importorskip("datasets")
    export_dataset(made, tmp_path / "out", "parquet", shard_mb=0.001)
    found = datasets.load_dataset(str(tmp_path / "out"), cache_dir=str(tmp_path / "cache"))
    assert {split: len(rows) for split, rows in found.items()} == {
        "train": 5,
        "val_1": 1,
        "test": 2,
    }
    for rows in found.values():
        for row in rows:
            check(made, row["label_k"], row)


@pytest.mark.parametrize("to", ["webdataset", "parquet"])
def test_exports_are_equal_and_replaced_only_if_asked(made: Path, tmp_path: Path, to: str) -> None:
    def content(folder: Path) -> dict[str, bytes]:
        return {
            str(p.relative_to(folder)): p.read_bytes()
            for p in sorted(folder.rglob("*"))
            if p.is_file()
        }

    result = run(made, tmp_path / "a", "--to", to, "--shard-mb", "0.001", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["events"] == 143
    export_dataset(made, tmp_path / "b", to, shard_mb=0.001)
    before = content(tmp_path / "a")
    assert before == content(tmp_path / "b")
    again = run(made, tmp_path / "a", "--to", to)
    assert again.exit_code == 1
    assert "export.json: exists; give another name, or --force" in again.stderr
    assert content(tmp_path / "a") == before
    (tmp_path / "a" / "notes.txt").write_text("mine")
    assert run(made, tmp_path / "a", "--to", to, "--force").exit_code == 0
    export_dataset(made, tmp_path / "c", to)
    after = content(tmp_path / "a")
    assert after.pop("notes.txt") == b"mine"
    assert after == content(tmp_path / "c")
    assert len(after) < len(before)


def test_an_interrupted_export_says_so_and_is_repeated(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    export_dataset(made, out, "webdataset")
    (out / "notes.txt").write_text("mine")
    moved = list[Path]()

    def stop_at_third(part: Path, path: Path, *, overwrite: bool) -> None:
        if len(moved) == 2:
            raise KeyboardInterrupt
        moved.append(path)
        part.rename(path)

    with monkeypatch.context() as patch:
        patch.setattr(export, "put_in_place", stop_at_third)
        with pytest.raises(KeyboardInterrupt):
            export_dataset(made, out, "webdataset", shard_mb=0.001, overwrite=True)
    index = json.loads((out / "export.json").read_text())
    present = {path.name for path in out.iterdir()}
    assert index["complete"] is False
    assert {path.name for path in moved} | present - {"notes.txt", "export.json"} <= set(
        index["files"]
    )
    assert (
        "export.json: exists; give another name, or --force"
        in run(made, out, "--to", "webdataset").stderr
    )
    done = export_dataset(made, out, "webdataset", overwrite=True)
    assert {path.name for path in out.iterdir()} == {*done.files, "export.json", "notes.txt"}
    assert json.loads((out / "export.json").read_text())["complete"] is True


def test_tensors_go_into_tar_files_with_all_their_arrays(tmp_path: Path) -> None:
    root = tmp_path / "made"
    (root / "train").mkdir(parents=True)
    arrays = {"tensor": np.arange(12.0).reshape(2, 3, 2), "truth_t": np.array([5])}
    np.savez(root / "train" / "a.npz", **arrays)
    item = {
        "file": "train/a.npz",
        "split": "train",
        "labels": {},
        "events": 9,
        "representation": "voxel_grid",
    }
    (root / "manifest.json").write_text(
        json.dumps({"format": "amiwarp-dataset", "version": 1, "items": [item]})
    )
    done = export_dataset(root, tmp_path / "out", "webdataset")
    with tarfile.open(tmp_path / "out" / done.files[0]) as archive:
        assert archive.getnames() == ["train_a.npz", "train_a.json"]
        with np.load(
            io.BytesIO((archive.extractfile("train_a.npz") or io.BytesIO()).read())
        ) as found:
            assert set(found) == set(arrays)
            for name, values in arrays.items():
                np.testing.assert_array_equal(found[name], values)
    with pytest.raises(
        AmiwarpError, match=r"holds tensors \(voxel_grid\), .* export to webdataset"
    ):
        export_dataset(root, tmp_path / "rows", "parquet")
    (root / "train" / "a.npz").unlink()
    with pytest.raises(AmiwarpError, match=r"a\.npz: no such file"):
        export_dataset(root, tmp_path / "again", "webdataset")
    assert not (tmp_path / "again").exists()


def test_what_cannot_be_exported_is_named(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(AmiwarpError, match=r"to is 'zip'; choose among webdataset, parquet"):
        export_dataset(made, out, "zip")
    for inside in (made, made / "x", made / ".." / made.name / "train" / "x"):
        with pytest.raises(
            AmiwarpError, match=r"is in the data set .*made; export to a folder outside it"
        ):
            export_dataset(made, inside, "parquet")
    assert not (made / "x").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").touch()
    with pytest.raises(
        AmiwarpError, match=r"other: holds other files, such as notes\.txt; give a new folder"
    ):
        export_dataset(made, tmp_path / "other", "parquet")
    (made / "test" / "a.b_7-0000000000000007.h5").unlink()
    for to in ("webdataset", "parquet"):
        with pytest.raises(AmiwarpError, match=r"a\.b_7-0000000000000007\.h5: no such file"):
            export_dataset(made, out, to)
        assert not out.exists()
    moved = Events.from_arrays(
        np.full(8, 1.5, np.float32), np.full(8, 2.0, np.float32), np.arange(8), np.ones(8)
    )
    save_recording(
        made / "test" / "a.b_7-0000000000000007.h5", Recording(MemoryEvents(moved, 9, 7))
    )
    with pytest.raises(
        AmiwarpError, match=r"a\.b_7.*: has sub-pixel coordinates, .*; export to webdataset"
    ):
        export_dataset(made, out, "parquet")
    assert export_dataset(made, out, "webdataset").events == 143


def renamed(made: Path, files: tuple[str, ...]) -> Path:
    """Return the data set with other names for its first recordings."""
    manifest = json.loads((made / "manifest.json").read_text())
    for item, file in zip(manifest["items"], files, strict=False):
        (made / item["file"]).rename(made / file)
        item["file"] = file
    (made / "manifest.json").write_text(json.dumps(manifest))
    return made


def test_samples_of_one_name_are_told_apart(made: Path, tmp_path: Path) -> None:
    """WebDataset's names have no blank, no letter beyond ASCII and no ending."""
    files = ("train/a b.h5", "train/a_b.h5", "猫.h5", "狗.h5", "train/c.h5")
    done = export_dataset(renamed(made, files), tmp_path / "out", "webdataset")
    found = {}
    for file in done.files:
        with tarfile.open(tmp_path / "out" / file) as archive:
            names = archive.getnames()
            assert len(set(names)) == len(names) == 2 * done.splits[file.rsplit("-", 1)[0]]
            found |= {
                json.load(archive.extractfile(n) or io.BytesIO())["file"]: n
                for n in names
                if n.endswith("json")
            }
    assert found["train/c.h5"] == "train_c.json"
    assert found["train/a b.h5"].startswith("train_a_b-")


def test_labels_of_several_types_are_no_column(made: Path, tmp_path: Path) -> None:
    manifest = json.loads((made / "manifest.json").read_text())
    manifest["items"][0]["labels"]["k"] = "none"
    (made / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(
        AmiwarpError,
        match=r"manifest\.json: label_k of the items is no column of a table .*; give ",
    ):
        export_dataset(made, tmp_path / "out", "parquet")
    assert export_dataset(made, tmp_path / "out", "webdataset").events == 143


def test_rows_are_written_in_groups(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow.parquet

    monkeypatch.setattr(parquet, "GROUP_EVENTS", 25)
    export_dataset(made, tmp_path / "out", "parquet")
    file = pyarrow.parquet.ParquetFile(tmp_path / "out" / "data" / "train-00000-of-00001.parquet")
    groups = [
        sum(map(len, file.read_row_group(k)["t"].to_pylist())) for k in range(file.num_row_groups)
    ]
    assert sum(groups) == 121
    assert len(groups) >= 2
    assert all(count >= 25 for count in groups[:-1])


def test_the_lists_of_a_row_group_never_hold_more_than_their_offsets_can_count(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow.parquet

    items = json.loads((made / "manifest.json").read_text())["items"]
    longest = max(item["events"] for item in items)
    monkeypatch.setattr(parquet, "MOST_EVENTS", longest)
    export_dataset(made, tmp_path / "out", "parquet")
    total = 0
    for path in sorted((tmp_path / "out" / "data").glob("*.parquet")):
        file = pyarrow.parquet.ParquetFile(path)
        for k in range(file.num_row_groups):
            count = sum(map(len, file.read_row_group(k)["t"].to_pylist()))
            assert count <= longest
            total += count
    assert total == sum(item["events"] for item in items)
