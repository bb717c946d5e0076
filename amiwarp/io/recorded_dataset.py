"""Data sets of recordings in a folder with a manifest, as ``amiwarp dataset`` writes them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.formats import open_recording
from amiwarp.io.input_files import errors_name
from amiwarp.io.json_files import read_json
from amiwarp.validation import guarded, instance, shown, whole

FORMAT, VERSION = "amiwarp-dataset", 1
"""Values of the manifest's fields ``format`` and ``version``."""
MANIFEST = "manifest.json"
MOST_BYTES = 1 << 30
"""Largest manifest that is read [bytes]: about a million recordings."""


@dataclass(frozen=True, slots=True)
class _Item:
    """Entry of one recording in the manifest."""

    file: str
    split: str
    labels: Mapping[str, Any]
    events: int


@guarded
class RecordedDataset:
    """Recordings of a data set with their labels, for PyTorch's ``DataLoader`` or any other loop.

    It has a length and an index, as the data sets of PyTorch, but does not need PyTorch. Only the manifest is held in
    memory, so that the processes of a ``DataLoader`` share the object however they are started.

    Parameters
    ----------
    folder : str or os.PathLike
        Folder of the data set, with ``manifest.json``.
    split : str, optional
        Name of the part to use, such as "train"; by default all parts.
    transform : callable, optional
        Called with the :class:`Recording` and the dict of its labels. Its return value is the item. Without it, an item
        is the tuple of all events and the labels. Worker processes that are spawned need a function of a module.

    Raises
    ------
    AmiwarpError
        If the folder has no manifest, the manifest is damaged or of a newer version, or no recording is in the split.

    Examples
    --------
    >>> import json, pathlib
    >>> events = amiwarp.Events.from_arrays([1, 2], [0, 0], [0, 10], [1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, 4, 4))
    >>> amiwarp.save_recording("000000.h5", recording)
    >>> item = {"file": "000000.h5", "split": "train", "labels": {"shape": "disc"}, "events": 2}
    >>> manifest = {"format": "amiwarp-dataset", "version": 1, "items": [item]}
    >>> _ = pathlib.Path("manifest.json").write_text(json.dumps(manifest))
    >>> dataset = amiwarp.RecordedDataset(".", split="train")
    >>> events, labels = dataset[0]
    >>> len(dataset), len(events), labels
    (1, 2, {'shape': 'disc'})
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        split: str | None = None,
        *,
        transform: Callable[[Recording, dict[str, Any]], Any] | None = None,
    ) -> None:
        self.folder = Path(folder)
        items = _read_manifest(self.folder / MANIFEST)
        self._items = [item for item in items if split is None or item.split == split]
        if not self._items:
            counts = ", ".join(f"{name} ({n})" for name, n in sorted(Counter(item.split for item in items).items()))
            raise AmiwarpError(
                f"{self.folder}: no recording is in the split {shown(split)}; it has {counts or 'no recordings'}"
            )
        self.transform = transform

    @property
    def labels(self) -> list[dict[str, Any]]:
        """Labels of all items in order. The recordings are not opened for it."""
        return [dict(item.labels) for item in self._items]

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: int) -> Any:
        """Return an item: the value that ``transform`` returns, or its events and labels.

        Raises IndexError after the last item, and :class:`AmiwarpError` if the file is missing or is not the one that
        the manifest describes.
        """
        item = self._items[index]
        path = self.folder / item.file
        recording = open_recording(path)
        n = len(recording.events)
        if n != item.events:
            given = f"{path}: holds {n} events, the manifest says {item.events}"
            raise AmiwarpError(f"{given}; make this recording again, or correct the manifest")
        if self.transform is not None:
            return self.transform(recording, dict(item.labels))
        return recording.events.slice(0, n), dict(item.labels)


def _read_manifest(path: Path) -> list[_Item]:
    """Return the items of a manifest."""
    if not path.is_file():
        raise AmiwarpError(f"{path.parent}: has no {MANIFEST}; give the folder that 'amiwarp dataset' wrote")
    data = read_json(path, "a manifest of a data set", most_bytes=MOST_BYTES)
    with errors_name(path, lambda: "reading the manifest"):
        if data.get("format") != FORMAT:
            raise AmiwarpError(f"field format is {shown(data.get('format'))}; expected {shown(FORMAT)}")
        version = whole(data.get("version"), "field version", 1, 1 << 30)
        if version > VERSION:
            raise AmiwarpError(f"field version is {version}, newer than {VERSION}; update amiwarp")
        items = instance(data.get("items"), list, "field items")
        return [_item(entry, f"items[{k}]") for k, entry in enumerate(items)]


def _item(entry: Any, where: str) -> _Item:
    """Return one item of a manifest, checked."""
    fields = instance(entry, dict, f"field {where}")
    file = instance(fields.get("file"), str, f"field {where}.file")
    path = PurePosixPath(file)
    if path.is_absolute() or ".." in path.parts or "\\" in file or not path.parts:
        raise AmiwarpError(f"field {where}.file is {shown(file)}; expected a path below the folder of the manifest")
    return _Item(
        file,
        instance(fields.get("split"), str, f"field {where}.split"),
        instance(fields.get("labels"), dict, f"field {where}.labels"),
        whole(fields.get("events"), f"field {where}.events", 0, 1 << 62),
    )
