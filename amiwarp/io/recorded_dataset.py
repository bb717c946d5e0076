"""Data sets of recordings in a folder with a manifest, as ``amiwarp dataset`` writes them."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events, Recording
from amiwarp.events.rig_recording import RigRecording
from amiwarp.io.formats import open_recording
from amiwarp.io.inputs import errors_name
from amiwarp.io.json_files import read_json
from amiwarp.io.rig_files import open_rig
from amiwarp.io.tensor_files import read_tensors
from amiwarp.schema.calls import guarded
from amiwarp.schema.records import value_of
from amiwarp.validation import instance, shown, whole

FORMAT = "amiwarp-dataset"
"""Value of the manifest's field ``format``."""

VERSION = 1
"""Newest version of the manifest that is read, and the version that is written."""

MANIFEST = "manifest.json"
"""Name of the manifest in the folder of a data set."""

SPLIT_NAME = "[A-Za-z0-9_-]+"
"""Regular expression of the names of splits, which become names of folders and files."""

MOST_BYTES = 1 << 30
"""Largest manifest that is read [bytes]: about a million recordings."""


@dataclass(frozen=True, slots=True)
class ManifestItem:
    """Entry of one recording in the manifest."""

    entry: Mapping[str, Any]
    """All fields of the entry."""
    file: str
    split: str
    labels: Mapping[str, Any]
    events: int
    representation: str | None
    """Representation of the tensors that the file holds; None for a recording."""
    cameras: tuple[str, ...] = ()
    """Cameras of the rig that the file, a folder, holds; none for one recording."""


@guarded
class RecordedDataset:
    """Recordings of a data set, or their tensors, with their labels, for PyTorch's ``DataLoader`` or any other loop.

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
        is the tuple of all events and the labels. If the data set holds recorded rigs, ``transform`` is called with the
        :class:`RigRecording` and the labels; without it, an item is the tuple of these. If the data set holds tensors
        instead of recordings, ``transform`` is called with a dict of arrays and the labels; without it, an item is the
        array ``tensor`` and the labels.
        Worker processes that are spawned need a function of a module.
    structured : bool, default False
        Whether items are as in tonic's data sets: a structured array of the events with the fields x, y, t [us]
        and p (1 is ON, 0 is OFF), and a target, the dict of labels. ``transform`` is then called with the array alone.
    target_transform : callable, optional
        Called with the dict of labels of structured items. Its return value is the target.

    Raises
    ------
    AmiwarpError
        If the folder has no manifest, the manifest is damaged or of a newer version, no recording is in the split,
        ``target_transform`` is given without ``structured``, or ``structured`` for a data set of tensors or rigs.

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
    >>> tonic_like = amiwarp.RecordedDataset(".", structured=True, target_transform=lambda labels: labels["shape"])
    >>> tonic_like[0]
    (array([(1, 0,  0, 1), (2, 0, 10, 0)],
          dtype=[('x', '<i2'), ('y', '<i2'), ('t', '<i8'), ('p', 'i1')]), 'disc')
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        split: str | None = None,
        *,
        transform: Callable[..., Any] | None = None,
        structured: bool = False,
        target_transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        if target_transform is not None and not structured:
            raise AmiwarpError(
                "target_transform applies to structured items; give structured = True, or leave it out",
                ErrorCode.OPTIONS,
            )
        self.folder = Path(folder)
        _, items = read_manifest(self.folder / MANIFEST)
        self._items = [item for item in items if split is None or item.split == split]
        if not self._items:
            counts = Counter(item.split for item in items)
            listed = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))
            raise AmiwarpError(
                f"{self.folder}: no recording is in the split {shown(split)}; it has {listed or 'no recordings'}",
                ErrorCode.CONTENT_MISSING,
            )
        tensors = [item for item in self._items if item.representation is not None]
        if structured and tensors:
            raise AmiwarpError(
                f"{self.folder}: holds tensors ({tensors[0].representation}), but structured items are events; leave "
                "out structured, or make the data set without [output]",
                ErrorCode.OPTIONS,
            )
        rigs = [item for item in self._items if item.cameras]
        if structured and rigs:
            raise AmiwarpError(
                f"{self.folder}: holds rigs of the cameras {', '.join(rigs[0].cameras)}, but structured items are of "
                "one camera; leave out structured, and take the events of a camera in transform",
                ErrorCode.OPTIONS,
            )
        self.transform = transform
        self.structured = structured
        self.target_transform = target_transform

    @property
    def labels(self) -> list[dict[str, Any]]:
        """Labels of all items in order. The recordings are not opened for it."""
        return [dict(item.labels) for item in self._items]

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: int) -> Any:
        """Return an item: the value that ``transform`` returns, or its events or tensor, and its labels.

        Raises IndexError after the last item, and :class:`AmiwarpError` if the index is no whole number, or if the file
        is missing or is not the one that the manifest describes.
        """
        if not hasattr(index, "__index__"):
            raise AmiwarpError(
                f"the index of an item is {shown(index)}; give a whole number, one for each item"
            )
        item = self._items[index]
        labels = dict(item.labels)
        if item.representation is not None:
            arrays = read_tensors(self.folder / item.file)
            if self.transform is None:
                return arrays["tensor"], labels
            return self.transform(arrays, labels)
        if item.cameras:
            rig = open_rig_item(self.folder, item)
            if self.transform is None:
                return rig, labels
            return self.transform(rig, labels)
        recording = open_item(self.folder, item)
        if self.structured:
            return self._structured_item(recording.events.slice(0, item.events), labels)
        if self.transform is None:
            return recording.events.slice(0, item.events), labels
        return self.transform(recording, labels)

    def _structured_item(self, found: Events, target: dict[str, Any]) -> tuple[Any, Any]:
        """Return an item as tonic's data sets give it."""
        side = "i2" if found.whole_pixels else "f4"
        # tonic's own polarities are bool, of which its ToVoxelGrid makes ON events only: bool has no -1.
        events: Any = found.to_structured([("x", side), ("y", side), ("t", "i8"), ("p", "i1")])
        if self.transform is not None:
            events = self.transform(events)
        if self.target_transform is None:
            return events, target
        return events, self.target_transform(target)


def open_item(folder: Path, item: ManifestItem) -> Recording:
    """Open a recording of a data set.

    Raises :class:`AmiwarpError` if the file is missing or is not the one that the manifest describes.
    """
    path = folder / item.file
    recording = open_recording(path)
    count = len(recording.events)
    if count != item.events:
        given = f"{path}: holds {count} events, the manifest says {item.events}"
        raise AmiwarpError(f"{given}; make this recording again, or correct the manifest")
    return recording


def open_rig_item(folder: Path, item: ManifestItem) -> RigRecording:
    """Open a recorded rig of a data set.

    Raises :class:`AmiwarpError` if a file is missing or the rig is not the one that the manifest describes.
    """
    path = folder / item.file
    rig = open_rig(path)
    found = (tuple(rig.sensors), rig_events(rig))
    if found != (item.cameras, item.events):
        raise AmiwarpError(
            f"{path}: holds {found[1]} events of {', '.join(found[0])}, the manifest says {item.events} of "
            f"{', '.join(item.cameras)}; make this recording again, or correct the manifest"
        )
    return rig


def rig_events(rig: RigRecording) -> int:
    """Return the number of events of all cameras of a rig."""
    return sum(len(sensor.recording.events) for sensor in rig.sensors.values())


def read_manifest(path: Path) -> tuple[dict[str, Any], list[ManifestItem]]:
    """Return the fields of a manifest without its items, and the items."""
    if not path.is_file():
        raise AmiwarpError(
            f"{path.parent}: has no {MANIFEST}; give the folder that 'amiwarp dataset' wrote",
            ErrorCode.CONTENT_MISSING,
        )
    data = read_json(path, "a manifest of a data set", most_bytes=MOST_BYTES)
    with errors_name(path, lambda: "reading the manifest"):
        if data.get("format") != FORMAT:
            raise AmiwarpError(
                f"field format is {shown(data.get('format'))}; expected {shown(FORMAT)}",
                ErrorCode.FIELD,
            )
        version = whole(data.get("version"), "field version", 1, 1 << 30)
        if version > VERSION:
            raise AmiwarpError(
                f"field version is {version}, newer than {VERSION}; update amiwarp", ErrorCode.FIELD
            )
        items = instance(data.get("items"), list, "field items")
        head = {name: value for name, value in data.items() if name != "items"}
        found = [_item(entry, f"items[{index}]") for index, entry in enumerate(items)]
        index_by_file: dict[PurePosixPath, int] = {}
        for index, item in enumerate(found):
            first = index_by_file.setdefault(PurePosixPath(item.file), index)
            if first != index:
                raise AmiwarpError(
                    f"field items[{index}].file is {shown(item.file)}, as items[{first}].file; remove one",
                    ErrorCode.FIELD,
                )
        return head, found


def _item(entry: Any, where: str) -> ManifestItem:
    """Return one item of a manifest, checked."""
    fields = instance(entry, dict, f"field {where}")
    file = instance(fields.get("file"), str, f"field {where}.file")
    path = PurePosixPath(file)
    if path.is_absolute() or ".." in path.parts or "\\" in file or not path.parts:
        raise AmiwarpError(
            f"field {where}.file is {shown(file)}; expected a path below the folder of the manifest",
            ErrorCode.FIELD,
        )
    split = instance(fields.get("split"), str, f"field {where}.split")
    if not re.fullmatch(SPLIT_NAME, split):
        raise AmiwarpError(
            f"field {where}.split is {shown(split)}; use letters, digits, '-' and '_'",
            ErrorCode.FIELD,
        )
    labels = instance(fields.get("labels"), dict, f"field {where}.labels")
    events = whole(fields.get("events"), f"field {where}.events", 0, 1 << 62)
    representation = fields.get("representation")
    if representation is not None:
        instance(representation, str, f"field {where}.representation")
    cameras = fields.get("rig")
    if cameras is not None:
        cameras = value_of(tuple[str, ...], cameras, f"{where}.rig")
    return ManifestItem(
        entry=fields,
        file=file,
        split=split,
        labels=labels,
        events=events,
        representation=representation,
        cameras=cameras or (),
    )
