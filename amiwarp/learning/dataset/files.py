"""Files that describe a data set: the journal of finished recordings, and the manifest as JSON and as Parquet."""

from __future__ import annotations

import importlib
import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from amiwarp._version import __version__
from amiwarp.errors import AmiwarpError, ErrorCode, optional_module
from amiwarp.io.finished_work import append_line, create_journal, read_journal
from amiwarp.io.outputs import NewFile, write_text
from amiwarp.io.recorded_dataset import FORMAT, MANIFEST, VERSION
from amiwarp.learning.dataset import specification as spec
from amiwarp.learning.dataset.items import Item
from amiwarp.learning.dataset.stored import (
    put_stored,
    remove_stored,
    stored_bytes,
    stored_digest,
)
from amiwarp.learning.dataset.worker import Failed, Made
from amiwarp.schema.records import build

JOURNAL = "journal.jsonl"
TABLE = "manifest.parquet"
"""Names of the files in the folder of a data set."""


def require_pyarrow() -> Any:
    """Return pyarrow. Raises :class:`AmiwarpError` if it is not installed."""
    return optional_module("pyarrow", "dataset", "'amiwarp dataset' needs pyarrow")


def check_folder(out: Path) -> None:
    """Raise :class:`AmiwarpError` if a folder holds other files than a data set."""
    if out.is_dir() and not (out / JOURNAL).exists():
        other = sorted(p.name for p in out.iterdir() if not p.name.startswith("."))
        if other:
            raise AmiwarpError(
                f"{out}: holds other files, such as {other[0]}; give a new folder",
                ErrorCode.OUTPUT_EXISTS,
            )


class Journal:
    """Recordings that were made, on disk. A later entry replaces an earlier one of the same key."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._path = out / JOURNAL
        self.damaged: list[str] = []
        """What is wrong with damaged lines of the journal, and with damaged recordings."""
        found = read_journal(self._path, lambda data: build(Made, data, ""), self.damaged)
        self.made = {made.key: made for made in found}
        """Recordings by the key of their item."""

    def create(self) -> None:
        """Create the journal unless it exists. It marks the folder as a data set."""
        create_journal(self._path)

    def add(self, made: Made) -> None:
        """Add a recording."""
        self.made[made.key] = made
        append_line(self._path, asdict(made))

    def move(self, item: Item) -> None:
        """Move the recording of an item to the folder of its split, if it is in the folder of an earlier split."""
        made = self.made[item.key]
        if made.file != item.file:
            put_stored(self._out / made.file, self._out / item.file, item.cameras)
            self.add(replace(made, file=item.file))

    def drop(self, item: Item) -> None:
        """Forget the recording of an item, which is made again, and remove it from the folder of an earlier split."""
        made = self.made.pop(item.key, None)
        if made is not None and made.file != item.file:
            remove_stored(self._out / made.file, item.cameras)

    def is_there(self, item: Item) -> bool:
        """Return whether the recording of an item is in the journal, and its files have the size stated there.

        It may lie in the folder of an earlier split.
        """
        made = self.made.get(item.key)
        if made is None:
            return False
        return stored_bytes(self._out / made.file, item.cameras) == made.bytes

    def is_intact(self, item: Item) -> bool:
        """Return whether the files of a recording that is there have the checksum of the journal."""
        made = self.made[item.key]
        try:
            if stored_digest(self._out / made.file, item.cameras) == made.sha256:
                return True
        except AmiwarpError as error:  # a file that cannot be read is made again, as a damaged one
            self.damaged.append(str(error))
            return False
        self.damaged.append(f"{self._out / made.file}: does not have the checksum of {JOURNAL}")
        return False

    def others(self, items: Sequence[Item]) -> list[str]:
        """Return the existing recordings that belong to none of the items, for example of an earlier specification."""
        files = {item.file for item in items}
        return sorted(
            made.file
            for made in self.made.values()
            if made.file not in files and (self._out / made.file).exists()
        )


def write_manifest(
    out: Path,
    specification: spec.Specification,
    items: Sequence[Item],
    journal: Journal,
    failed: Sequence[Failed],
) -> None:
    """Write the manifest of the recordings that are finished, as JSON and as Parquet."""
    rows = [_row(item, journal.made[item.key]) for item in items if item.key in journal.made]
    by_key = {item.key: item for item in items}
    licences = Counter((item.source, item.licence) for item in items if item.key in journal.made)
    head = {
        "format": FORMAT,
        "version": VERSION,
        "name": specification.name,
        "amiwarp": __version__,
        "date": time.strftime("%Y-%m-%d"),
        "specification": specification.data,
        "complete": len(rows) == len(items),
        "recordings": len(items),
        "events": sum(row["events"] for row in rows),
        "bytes": sum(row["bytes"] for row in rows),
        "splits": dict(Counter(row["split"] for row in rows)),
        "licences": _licences(licences),
        "failed": [
            {"file": by_key[file.key].file, "source": by_key[file.key].source, "error": file.error}
            for file in failed
        ],
        "not_in_specification": journal.others(items),
    }
    text = json.dumps(head, indent=1, default=str).removesuffix("\n}")
    lines = ",\n".join("  " + json.dumps(row) for row in rows)  # one line for each recording
    write_text(out / MANIFEST, f'{text},\n "items": [\n{lines}\n ]\n}}\n', overwrite=True)
    _write_table(out / TABLE, rows)


def _licences(counts: Mapping[tuple[str, str], int]) -> list[dict[str, Any]]:
    """Return the licences with the number of their sources and recordings."""
    sources = Counter[str]()
    recordings = Counter[str]()
    for (_, licence), count in counts.items():
        sources[licence] += 1
        recordings[licence] += count
    return [
        {"licence": name or "not stated", "sources": sources[name], "recordings": recordings[name]}
        for name in sorted(sources)
    ]


def _row(item: Item, made: Made) -> dict[str, Any]:
    """Return the entry of a recording in the manifest. Settings that it does not have are None."""
    recipe = item.recipe
    prism = recipe.get("prism") or {}
    return {
        "file": made.file,
        "sha256": made.sha256,
        "bytes": made.bytes,
        "split": item.split,
        "labels": dict(item.labels),
        "events": made.events,
        "duration_s": made.duration_s,
        "width": made.width,
        "height": made.height,
        "seed": None if item.kind == "recordings" else item.seed,
        "source": item.source,
        "source_kind": item.kind,
        "source_sha256": recipe["source"]["sha256"],
        "licence": item.licence,
        "apex_deg": item.drawn.get("apex_deg", prism.get("apex_deg")),
        "index": prism.get("index"),
        "flat_side": prism.get("flat_side"),
        "rpm": item.drawn.get("rpm", recipe.get("rpm")),
        "sensor": (recipe.get("sensor") or {}).get("name"),
        "variant": recipe.get("seed"),
        "trajectory": recipe.get("trajectory"),
        "rig": list(item.cameras) or None,
        "representation": (recipe.get("output") or {}).get("representation"),
        "device": made.device,
        "amiwarp": made.amiwarp,
    }


def _write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the entries as Parquet."""
    pyarrow = require_pyarrow()
    parquet = importlib.import_module("pyarrow.parquet")
    with NewFile(path, overwrite=True) as new:
        parquet.write_table(pyarrow.Table.from_pylist(flat_rows(rows)), new.part)


def flat_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the entries as rows of a table: each label is a value ``label_NAME``; the others keep their name."""
    labels = sorted({name for row in rows for name in row["labels"]})
    flat = []
    for row in rows:
        values = {name: value for name, value in row.items() if name != "labels"}
        for name in labels:
            values[f"label_{name}"] = row["labels"].get(name)
        flat.append(values)
    return flat
