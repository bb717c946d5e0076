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
    opened: Callable[[str], Iterator[tuple[recorded_dataset.ManifestItem, Any]]],
    items: Sequence[recorded_dataset.ManifestItem],
    limit: int,
) -> list[str]:
    """Write Parquet files of at least ``limit`` bytes before compression. Return their names."""
    pa = require_pyarrow()
    if len({_hub_name(split) for split in splits}) < len(splits):
        raise AmiwarpError(
            f"splits are {', '.join(splits)}; the same with '_' for '-', so give one another name"
        )
    rows = _rows(pa, flat_rows([item.entry for item in items]))
    place = {item.file: k for k, item in enumerate(items)}
    (scratch / "data").mkdir()
    names = []
    for split in splits:
        parts = list(_parquet_parts(pa, scratch, opened(split), rows, place, limit))
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


def _parquet_parts(
    pa: Any,
    scratch: Path,
    opened: Iterator[tuple[recorded_dataset.ManifestItem, Any]],
    rows: Any,
    place: Mapping[str, int],
    limit: int,
) -> Iterator[Path]:
    """Write the recordings of a split. Yield the path of each file."""
    parquet = importlib.import_module("pyarrow.parquet")
    waiting: list[Any] = []
    events = 0
    written = 0
    count = 0
    writer: Any = None

    def flush() -> None:
        nonlocal waiting, events
        if waiting:
            writer.write_table(pa.concat_tables(waiting).combine_chunks())
        waiting = []
        events = 0

    try:
        for item, recording in opened:
            k = place[item.file]
            table = rows.slice(k, 1)
            for name, column in _columns(pa, item, recording).items():
                if name in table.column_names:
                    index = table.schema.get_field_index(name)
                    table = table.set_column(index, name, column)
                else:
                    table = table.append_column(name, column)
            if writer is None or written >= limit:
                if writer is not None:
                    flush()
                    writer.close()
                path = scratch / f"part-{count}.parquet"
                count = count + 1
                written = 0
                writer = parquet.ParquetWriter(
                    path, table.schema, compression="zstd", use_dictionary=["split"]
                )
                yield path
            if events + item.events > MOST_EVENTS:
                flush()
            waiting.append(table)
            events += item.events
            written += table.nbytes
            if events >= GROUP_EVENTS or len(waiting) >= GROUP_ROWS:
                flush()
        flush()
    finally:
        if writer is not None:
            writer.close()


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
