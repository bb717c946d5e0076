"""Parquet: one row for each recording, with lists of the events' columns."""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp._version import __version__
from amiwarp.errors import AmiwarpError
from amiwarp.io import recorded_dataset
from amiwarp.learning.dataset.files import flat_rows, require_pyarrow

GROUP_EVENTS = 2_000_000
"""Number of events at which waiting recordings are written as a row group of Parquet."""
GROUP_ROWS = 1000
"""Largest number of recordings in a row group."""
MOST_EVENTS = 2**31 - 1
"""Largest number of events of a recording, and of a row group, in Parquet, whose lists have 32-bit offsets."""


def _hub_name(split: str) -> str:
    """Return the name of a split for ``datasets``, which allows no hyphen."""
    return split.replace("-", "_")


def write_parquet(
    scratch: Path,
    splits: Sequence[str],
    open_split: Callable[[str], Iterator[tuple[recorded_dataset.ManifestItem, Any]]],
    items: Sequence[recorded_dataset.ManifestItem],
    file_bytes: int,
) -> list[str]:
    """Write Parquet files, which end once they hold ``file_bytes`` before compression. Return their names."""
    pa = require_pyarrow()
    counts = Counter(_hub_name(split) for split in splits)
    for name, count in counts.items():
        if count > 1:
            alike = " and ".join(f"'{split}'" for split in splits if _hub_name(split) == name)
            raise AmiwarpError(
                f"splits {alike} are both '{name}' in Parquet, which has '_' for '-'; give one another name"
            )
    rows = _rows(pa, flat_rows([item.entry for item in items]))
    row_of_file = {item.file: row for row, item in enumerate(items)}
    (scratch / "data").mkdir()
    names = []
    for split in splits:
        parts = _write_parts(pa, scratch, open_split(split), rows, row_of_file, file_bytes)
        for k, part in enumerate(parts):
            names.append(f"data/{_hub_name(split)}-{k:05}-of-{len(parts):05}.parquet")
            part.rename(scratch / names[-1])
    return names


def _rows(pa: Any, rows: Sequence[Mapping[str, Any]]) -> Any:
    """Return a table of the items. Raises :class:`AmiwarpError` for a field whose values are of several types."""
    columns = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        try:
            columns[name] = pa.array([row.get(name) for row in rows])
        except (pa.ArrowException, OverflowError) as error:
            what = " ".join(str(error).split())
            raise AmiwarpError(
                f"{recorded_dataset.MANIFEST}: {name} of the items is no column of a table ({what}); give values of "
                "one type, or export to webdataset"
            ) from error
    return pa.table(columns)


class _PartWriter:
    """Writer of the files of a split, each of which ends once it holds ``file_bytes`` before compression."""

    def __init__(self, pa: Any, scratch: Path, file_bytes: int) -> None:
        self.paths: list[Path] = []
        """Files so far."""
        self._pa = pa
        self._scratch = scratch
        self._file_bytes = file_bytes
        self._writer: Any = None
        self._written = 0  # bytes of the current file
        self._waiting: list[Any] = []  # rows of the next row group
        self._events = 0  # their events

    def add(self, row: Any, events: int) -> None:
        """Write the row of a recording with this number of events."""
        if self._writer is None or self._written >= self._file_bytes:
            self.close()
            self._open(row.schema)
        if self._events + events > MOST_EVENTS:
            self._flush()
        self._waiting.append(row)
        self._events += events
        self._written += row.nbytes
        if self._events >= GROUP_EVENTS or len(self._waiting) >= GROUP_ROWS:
            self._flush()

    def close(self) -> None:
        """Finish the current file, if there is one."""
        if self._writer is not None:
            self._flush()
            self._writer.close()
            self._writer = None

    def discard(self) -> None:
        """Close the current file, which stays incomplete."""
        if self._writer is not None:
            self._writer.close()

    def _open(self, schema: Any) -> None:
        parquet = importlib.import_module("pyarrow.parquet")
        path = self._scratch / f"part-{len(self.paths)}.parquet"
        # Of all columns, only the split repeats from row to row.
        self._writer = parquet.ParquetWriter(
            path, schema, compression="zstd", use_dictionary=["split"]
        )
        self.paths.append(path)
        self._written = 0

    def _flush(self) -> None:
        """Write the waiting rows as a row group."""
        if self._waiting:
            self._writer.write_table(self._pa.concat_tables(self._waiting).combine_chunks())
        self._waiting = []
        self._events = 0


def _write_parts(
    pa: Any,
    scratch: Path,
    recordings: Iterator[tuple[recorded_dataset.ManifestItem, Any]],
    rows: Any,
    row_of_file: Mapping[str, int],
    file_bytes: int,
) -> list[Path]:
    """Write the recordings of a split. Return the paths of the files."""
    writer = _PartWriter(pa, scratch, file_bytes)
    try:
        for item, recording in recordings:
            row = rows.slice(row_of_file[item.file], 1)
            for name, column in _columns(pa, item, recording).items():
                if name in row.column_names:
                    # The width and height of the manifest give way to the file's own.
                    index = row.schema.get_field_index(name)
                    row = row.set_column(index, name, column)
                else:
                    row = row.append_column(name, column)
            writer.add(row, item.events)
        writer.close()
    finally:
        writer.discard()
    return writer.paths


def _columns(pa: Any, item: recorded_dataset.ManifestItem, recording: Any) -> dict[str, Any]:
    """Return the columns of one recording: lists of events, and the size of the sensor."""
    if item.events > MOST_EVENTS:
        raise AmiwarpError(
            f"{item.file}: has {item.events:,} events, a row holds {MOST_EVENTS:,}; export to webdataset"
        )
    events = recording.events.slice(0, item.events)
    if not events.whole_pixels:
        raise AmiwarpError(
            f"{item.file}: has sub-pixel coordinates, the columns are whole; export to webdataset"
        )
    ends = pa.array(np.array([0, item.events], np.int32))
    columns = {}
    for name in ("x", "y", "t", "p"):
        values = pa.array(getattr(events, name))
        columns[name] = pa.ListArray.from_arrays(ends, values)
    width, height = recording.events.size
    columns["width"] = pa.array([width])
    columns["height"] = pa.array([height])
    return columns


def dataset_card(title: str, items: Sequence[recorded_dataset.ManifestItem]) -> str:
    """Return the README of a folder for Hugging Face, whose header names the files of each split."""
    splits = Counter(_hub_name(item.split) for item in items)
    given = Counter(str(item.entry.get("licence") or "not stated") for item in items)
    files = "".join(f"  - split: {split}\n    path: data/{split}-*.parquet\n" for split in splits)
    counts = ", ".join(f"{split} {n:,}" for split, n in splits.items())
    licences = "".join(f"- {name}: {n:,} recordings\n" for name, n in sorted(given.items()))
    return (
        f"---\nconfigs:\n- config_name: default\n  data_files:\n{files}---\n\n# {title}\n\n"
        f"Recordings of an event camera, made by amiwarp {__version__}: {counts}. Each row is one recording. The "
        "columns x and y [px], t [us] and p (1 is ON, 0 is OFF) are lists of its events, the columns label_… its "
        "labels.\n\n"
        f"## Licences of the sources\n\n{licences}"
    )
