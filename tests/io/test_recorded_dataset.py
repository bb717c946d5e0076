"""Data sets of recordings: what the manifest says is what is read, also by the processes of a DataLoader."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amiwarp
from amiwarp import AmiwarpError, Events, MemoryEvents, RecordedDataset, Recording, save_recording

COUNTS = (3, 1, 4, 0, 5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five recordings, of which recording k has COUNTS[k] events at column k."""
    root = tmp_path_factory.mktemp("data")
    items = []
    for k, n in enumerate(COUNTS):
        split = "test" if k == 4 else "train"
        (root / split).mkdir(exist_ok=True)
        events = Events.from_arrays(
            np.full(n, k), np.zeros(n, int), np.arange(n) * 10, np.ones(n, int)
        )
        save_recording(root / split / f"{k:06}.h5", Recording(MemoryEvents(events, 8, 6)))
        items.append(
            {
                "file": f"{split}/{k:06}.h5",
                "sha256": "0",
                "split": split,
                "labels": {"k": k},
                "events": n,
            }
        )
    write_manifest(root, items=items)
    return root


def write_manifest(root: Path, **changed: Any) -> None:
    content = {"format": "amiwarp-dataset", "version": 1, "complete": True, "items": [], **changed}
    (root / "manifest.json").write_text(json.dumps(content))


def count_events(recording: Recording, labels: dict[str, Any]) -> tuple[int, int]:
    return len(recording.events), labels["k"]


def test_items_are_the_events_and_labels_of_a_split(folder: Path) -> None:
    dataset = RecordedDataset(folder, "train")
    assert len(dataset) == 4
    assert dataset.labels == [{"k": 0}, {"k": 1}, {"k": 2}, {"k": 3}]
    for (events, labels), n in zip(dataset, COUNTS[:4], strict=True):
        assert events.x.tolist() == [labels["k"]] * n
        assert events.t.tolist() == [10 * i for i in range(n)]
    assert len(RecordedDataset(folder)) == 5
    assert dataset[-1][1] == {"k": 3}
    with pytest.raises(IndexError):
        dataset[4]
    part: Any = slice(0, 1)
    with pytest.raises(
        AmiwarpError, match=r"index of an item is slice\(0, 1, None\); give a whole number"
    ):
        dataset[part]


def test_a_transform_makes_the_item(folder: Path) -> None:
    dataset = RecordedDataset(str(folder), "test", transform=count_events)
    assert list(dataset) == [(5, 4)]
    assert list(pickle.loads(pickle.dumps(dataset))) == [(5, 4)]


def test_labels_belong_to_the_caller(folder: Path) -> None:
    dataset = RecordedDataset(folder)
    dataset[0][1]["k"] = dataset.labels[0]["k"] = "changed"
    assert dataset[0][1] == {"k": 0}


def test_a_loader_reads_the_copy_of_a_worker(folder: Path) -> None:
    """A spawned process gets a pickled copy. ``examples/train_from_files.py``, which a test runs, starts one."""
    data = pytest.importorskip("torch.utils.data")
    dataset = pickle.loads(pickle.dumps(RecordedDataset(folder, "train", transform=count_events)))
    loader = data.DataLoader(dataset, batch_size=2)
    assert [[column.tolist() for column in batch] for batch in loader] == [
        [[3, 1], [0, 1]],
        [[4, 0], [2, 3]],
    ]


def test_a_folder_without_a_manifest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        AmiwarpError, match=r"has no manifest.json; give the folder that 'amiwarp dataset' wrote"
    ):
        RecordedDataset(tmp_path)
    with pytest.raises(AmiwarpError, match=r"has no manifest.json"):
        RecordedDataset(tmp_path / "none")


def test_an_unknown_split_is_refused_with_the_known_ones(folder: Path) -> None:
    with pytest.raises(AmiwarpError, match=r"split 'val'; it has test \(1\), train \(4\)"):
        RecordedDataset(folder, "val")


GOOD = {"file": "a.h5", "split": "train", "labels": {}, "events": 1}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"format": "other"}, "field format is 'other'; expected 'amiwarp-dataset'"),
        ({"version": 2}, "field version is 2, newer than 1; update amiwarp"),
        ({"version": "1"}, "field version = '1'"),
        ({"items": {}}, "field items is {}; expected a list"),
        ({"items": []}, "it has no recordings"),
        ({"items": [3]}, r"field items\[0\] is 3; expected a dict"),
        (
            {"items": [GOOD, {**GOOD, "file": "/etc/a.h5"}]},
            r"items\[1\].file is '/etc/a.h5'; expected a path below",
        ),
        (
            {"items": [{**GOOD, "file": "x/../../a.h5"}]},
            r"items\[0\].file is 'x/../../a.h5'; expected a path below",
        ),
        ({"items": [{**GOOD, "file": ""}]}, r"items\[0\].file is ''"),
        ({"items": [{**GOOD, "file": 1}]}, r"items\[0\].file is 1; expected a str"),
        ({"items": [{**GOOD, "split": None}]}, r"items\[0\].split is None; expected a str"),
        (
            {"items": [{**GOOD, "split": "../x"}]},
            r"items\[0\].split is '../x'; use letters, digits, '-' and '_'",
        ),
        ({"items": [{**GOOD, "split": "a b"}]}, r"items\[0\].split is 'a b'; use letters"),
        (
            {"items": [GOOD, {**GOOD, "file": "./a.h5"}]},
            r"items\[1\].file is './a.h5', as items\[0\].file; remove one",
        ),
        ({"items": [{**GOOD, "labels": []}]}, r"items\[0\].labels is \[\]; expected a dict"),
        ({"items": [{**GOOD, "events": -1}]}, r"items\[0\].events = -1"),
        ({"items": [{"file": "a.h5"}]}, r"items\[0\].split is None"),
    ],
)
def test_a_bad_manifest_is_refused(tmp_path: Path, changed: dict[str, Any], message: str) -> None:
    write_manifest(tmp_path, **changed)
    with pytest.raises(AmiwarpError, match=message):
        RecordedDataset(tmp_path)


def test_damaged_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(AmiwarpError, match=r"manifest.json: .*is not JSON"):
        RecordedDataset(tmp_path)


def test_a_missing_or_changed_recording_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes((folder / "train" / "000000.h5").read_bytes())
    write_manifest(tmp_path, items=[{**GOOD, "events": 7}, {**GOOD, "file": "b.h5"}])
    dataset = RecordedDataset(tmp_path)
    with pytest.raises(AmiwarpError, match=r"a.h5: holds 3 events, the manifest says 7"):
        dataset[0]
    with pytest.raises(AmiwarpError, match=r"b.h5: no such file"):
        dataset[1]


def test_structured_items_are_those_of_tonic(folder: Path) -> None:
    """The fields and types are those of ``tonic.io.events_struct``, except p, which can become -1."""
    events, target = RecordedDataset(folder, "test", structured=True)[0]
    assert events.dtype == np.dtype(
        [("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", np.int8)]
    )
    assert events.tolist() == [(4, 0, 10 * i, 1) for i in range(5)]
    assert target == {"k": 4}
    made = RecordedDataset(
        folder, "test", structured=True, transform=len, target_transform=lambda labels: labels["k"]
    )
    assert list(made) == [(5, 4)]
    with pytest.raises(
        AmiwarpError, match="target_transform applies to structured items; give structured = True"
    ):
        RecordedDataset(folder, target_transform=len)


def test_structured_items_keep_places_between_pixels(tmp_path: Path) -> None:
    moved = Events.from_arrays(np.float32([1.5, -0.25]), np.float32([2.0, 3.75]), [10, 20], [1, 0])
    save_recording(tmp_path / "a.h5", Recording(MemoryEvents(moved, 8, 6)))
    write_manifest(tmp_path, items=[{**GOOD, "events": 2}])
    events, _ = RecordedDataset(tmp_path, structured=True)[0]
    assert events.dtype == np.dtype(
        [("x", np.float32), ("y", np.float32), ("t", np.int64), ("p", np.int8)]
    )
    assert events.tolist() == [(1.5, 2.0, 10, 1), (-0.25, 3.75, 20, 0)]


def test_tonic_s_transforms_and_caches_take_structured_items(tmp_path: Path) -> None:
    """tonic needs librosa and Numba, so it is not among the packages of the tests."""
    tonic = pytest.importorskip("tonic")
    from torch.utils.data import DataLoader

    rng = np.random.default_rng(3)
    items = []
    for k in range(3):
        t = np.sort(rng.integers(0, 30_000 + 5000 * k, 400))
        events = Events.from_arrays(
            rng.integers(0, 8, 400), rng.integers(0, 6, 400), t, rng.integers(0, 2, 400)
        )
        save_recording(tmp_path / f"{k}.h5", Recording(MemoryEvents(events, 8, 6)))
        items.append({"file": f"{k}.h5", "split": "train", "labels": {"k": k}, "events": 400})
    write_manifest(tmp_path, items=items)
    size = (8, 6, 2)
    make = {
        "frames": tonic.transforms.ToFrame(size, time_window=5000),
        "grid": tonic.transforms.Compose([tonic.transforms.ToVoxelGrid(size, n_time_bins=4)]),
    }
    ours = RecordedDataset(tmp_path)
    for name, transform in make.items():
        options = {"transform": transform, "target_transform": target_of, "structured": True}
        dataset = tonic.DiskCachedDataset(
            RecordedDataset(tmp_path, **options), cache_path=str(tmp_path / name)
        )
        for k, (events, labels) in enumerate(ours):
            for _ in range(2):  # made, then from the cache
                found, target = dataset[k]
                assert target == labels["k"]
                if name == "frames":
                    cut = amiwarp.windows(events, duration_us=5000)
                    expected = amiwarp.polarity_histogram(events, 8, 6, windows=cut)
                    np.testing.assert_array_equal(found, expected)
                else:
                    expected = amiwarp.voxel_grid(events, 8, 6, 4, end_bin=False)
                    np.testing.assert_allclose(found[:, 0], expected, rtol=0, atol=1e-5)
                    assert found.min() < 0.0 < found.max()
        batches = DataLoader(
            dataset, batch_size=3, collate_fn=tonic.collation.PadTensors(batch_first=True)
        )
        ((padded, targets),) = batches
        assert (len(padded), targets.tolist()) == (3, [0, 1, 2])


def target_of(labels: dict[str, Any]) -> int:
    return int(labels["k"])


def test_tensors_are_no_events_and_a_damaged_archive_is_refused(tmp_path: Path) -> None:
    item = {
        "file": "a.npz",
        "split": "train",
        "labels": {},
        "events": 3,
        "representation": "event_count",
    }
    write_manifest(tmp_path, items=[item])
    with pytest.raises(
        AmiwarpError,
        match=r"holds tensors \(event_count\), but structured items are events; leave out",
    ):
        RecordedDataset(tmp_path, structured=True)
    write_manifest(tmp_path, items=[{**item, "representation": 3}])
    with pytest.raises(AmiwarpError, match="representation is 3; expected a str"):
        RecordedDataset(tmp_path)
    write_manifest(tmp_path, items=[item])
    dataset = RecordedDataset(tmp_path)
    np.savez(tmp_path / "a.npz", other=np.zeros(3))
    with pytest.raises(
        AmiwarpError, match=r"a\.npz: .*has no array tensor, but other; make this recording again"
    ):
        dataset[0]
    np.savez(tmp_path / "a.npz", tensor=np.array([{}], object))
    with pytest.raises(AmiwarpError, match=r"a\.npz: .*array tensor is object"):
        dataset[0]
    (tmp_path / "a.npz").write_bytes(b"no archive")
    with pytest.raises(AmiwarpError, match=r"a\.npz: "):
        dataset[0]
