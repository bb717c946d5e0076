"""Sources of a data set: files found by their patterns, named worlds, and the labels that they carry."""

import csv
import hashlib
import io
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, open_input
from amiwarp.io.json_files import read_json, read_toml
from amiwarp.learning.dataset.digests import content_digest
from amiwarp.learning.dataset.patterns import matches
from amiwarp.learning.dataset.specification import SourceEntry, Specification
from amiwarp.simulation.worlds.mesh_reader import mesh_files
from amiwarp.simulation.worlds.named.catalogue import WORLDS
from amiwarp.validation import one_of, shown

MOST_TABLE_BYTES = 256 << 20
"""Largest table of labels that is read [bytes]."""


@dataclass(frozen=True)
class Source:
    """One picture, video, recording, world file or named world."""

    entry: SourceEntry
    """Entry of the specification that it belongs to."""
    name: str
    """Path relative to the folder of the specification, or name of a world."""
    path: Path | None
    """File; None for a named world."""
    digest: str
    """SHA-256 of the content, in hexadecimal; empty for a named world."""
    labels: Mapping[str, Any]
    """Labels by name."""


def find_sources(specification: Specification) -> list[Source]:
    """Return all sources. Raises :class:`AmiwarpError` for a pattern without files and for a file found twice."""
    by_name: dict[str, tuple[int, Source]] = {}
    kinds: dict[str, tuple[type, int]] = {}
    for k, entry in enumerate(specification.sources):
        with errors_name(specification.path, lambda k=k: f"field sources[{k}]"):  # type: ignore[misc]
            for source in _of_entry(specification.folder, entry, f"sources[{k}]"):
                if source.name in by_name:
                    raise AmiwarpError(
                        f"field sources[{k}] names {source.name}, as does sources[{by_name[source.name][0]}]; "
                        "change one of them, so that each recording is made once",
                        ErrorCode.FIELD,
                    )
                by_name[source.name] = (k, source)
                _check_label_types(source.labels, kinds, k)
    return [source for _, source in by_name.values()]


def _check_label_types(
    labels: Mapping[str, Any], kinds: dict[str, tuple[type, int]], k: int
) -> None:
    """Raise :class:`AmiwarpError` if a label has values of two types. ``kinds`` holds the type of each label so far."""
    for name, value in labels.items():
        kind, first = kinds.setdefault(name, (type(value), k))
        if kind is not type(value):
            raise AmiwarpError(
                f"field sources[{k}] has the label {name} = {value!r}, but in sources[{first}] it is of type "
                f"{kind.__name__}; use one type",
                ErrorCode.FIELD,
            )


def _of_entry(folder: Path, entry: SourceEntry, where: str) -> Iterator[Source]:
    """Yield the sources of one entry."""
    if entry.worlds is not None:
        for name in entry.worlds:
            one_of(name, WORLDS, f"field {where}.worlds")
            yield Source(entry, name, None, "", dict(entry.labels))
        return
    pattern = getattr(entry, entry.kind)
    names = matches(folder, pattern)
    if not names:
        raise AmiwarpError(
            f"field {where}.{entry.kind} is {shown(pattern)}, which matches no file in {folder}; change it",
            ErrorCode.FIELD,
        )
    table = None if entry.label_table is None else _read_labels(folder / entry.label_table)
    digest: Callable[[Path], str] = (
        partial(_world_digest, {}) if entry.kind == "world_files" else content_digest
    )
    for name in names:
        path = folder / name
        yield Source(entry, Path(name).as_posix(), path, digest(path), _labels(entry, path, table))


def _labels(
    entry: SourceEntry, path: Path, table: tuple[Path, dict[Path, dict[str, Any]]] | None
) -> dict[str, Any]:
    """Return the labels of a file: constant ones, its folder's name, and the table's."""
    labels = dict(entry.labels)
    if entry.label_from_folder is not None:
        labels[entry.label_from_folder] = path.absolute().parent.name
    if table is not None:
        table_path, rows = table
        row = rows.get(path.resolve())
        if row is None:
            raise AmiwarpError(
                f"{table_path}: has no row for {path}; add it, or change the pattern of the source",
                ErrorCode.CONTENT_MISSING,
            )
        labels |= row
    return labels


def _read_labels(path: Path) -> tuple[Path, dict[Path, dict[str, Any]]]:
    """Return the labels of each file of a CSV table, whose column ``file`` is relative to the folder of the table.

    A column of numbers becomes numbers; any other column is text.
    """
    with errors_name(path, lambda: "is no table of labels"):
        with open_input(path) as file:
            text = file.read(MOST_TABLE_BYTES + 1)
        if len(text) > MOST_TABLE_BYTES:
            raise AmiwarpError(
                f"is larger than {MOST_TABLE_BYTES >> 20} MiB; divide it among several sources"
            )
        reader = csv.DictReader(io.StringIO(text.decode("utf-8-sig"), newline=""))
        names = [name for name in reader.fieldnames or () if name != "file"]
        if "file" not in (reader.fieldnames or ()) or not names:
            raise AmiwarpError(
                "has no column 'file' or no other column; write a header such as file,class",
                ErrorCode.CONTENT_MISSING,
            )
        _check_once(reader.fieldnames or (), "column", "give each label one column")
        rows = list(reader)
        for number, row in enumerate(rows, 1):
            if None in row or None in row.values():
                raise AmiwarpError(
                    f"row {number} has more or fewer cells than the header; correct it",
                    ErrorCode.FILE_DAMAGED,
                )
        columns = {name: _column([row[name] for row in rows]) for name in names}
        files = [(path.parent / row["file"]).resolve() for row in rows]
        _check_once(files, "file", "keep one row of it")
        labels = {}
        for index, labelled in enumerate(files):
            labels[labelled] = {name: columns[name][index] for name in names}
        return path, labels


def _check_once(values: Sequence[object], what: str, remedy: str) -> None:
    """Raise :class:`AmiwarpError` for a column or a file of a table that is there twice."""
    twice = [value for value, count in Counter(values).items() if count > 1]
    if twice:
        raise AmiwarpError(f"has the {what} {shown(str(twice[0]))} twice; {remedy}")


def _column(values: list[str]) -> list[Any]:
    """Return the values of a column as whole numbers, as numbers, or as text. Numbers like 007 are text."""
    if all(re.fullmatch(r"-?(0|[1-9]\d{0,17})", value) for value in values):
        return [int(value) for value in values]
    if all(re.fullmatch(r"-?(0|[1-9]\d*)(\.\d+)?([eE][+-]?\d{1,2})?", value) for value in values):
        return [float(value) for value in values]
    return list(values)


def _world_digest(known: dict[Path, str], path: Path) -> str:
    """Return the SHA-256 of a world file, of the files that it names, and of those that its meshes name.

    ``known`` holds the digests of named files so far, because worlds share large meshes.
    """
    read = read_json if path.suffix.lower() == ".json" else read_toml
    data = read(path, "a world")
    candidates = {path.parent / text for text in _texts(data)}
    named = {file for file in candidates if os.path.isfile(file)}
    for file in named - known.keys():
        its_files = [file, *sorted(set(mesh_files(file)))]
        known[file] = "\n".join(map(content_digest, its_files))
    digests = [content_digest(path), *(known[file] for file in sorted(named))]
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()


def _texts(data: Any) -> Iterator[str]:
    """Yield all texts among the values of JSON data."""
    if isinstance(data, str):
        yield data
    elif isinstance(data, dict):
        for value in data.values():
            yield from _texts(value)
    elif isinstance(data, list):
        for value in data:
            yield from _texts(value)
