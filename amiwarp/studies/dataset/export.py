"""Export of a data set to the layouts of other libraries: WebDataset's tar files, and Parquet for Hugging Face."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import io
import json
import os
import re
import tarfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from amiwarp._version import __version__
from amiwarp.choices import Option
from amiwarp.errors import AmiwarpError
from amiwarp.io import formats
from amiwarp.io.export import export
from amiwarp.io.files import check_output, errors_name, open_input, put_in_place, scratch_folder, write_text
from amiwarp.io.json_files import parse_json
from amiwarp.studies.dataset.making import flat_rows, require_pyarrow
from amiwarp.tasks import Progress, silent
from amiwarp.validation import choice, guarded, real

INDEX = "export.json"
"""Name of the file that lists the files of an export. Its field ``complete`` is false while they are put in place."""
FORMAT = "amiwarp-export"
"""Value of the index's field ``format``."""
GROUP_EVENTS = 2_000_000
"""Number of events from which on waiting recordings are written as a row group of Parquet."""
GROUP_ROWS = 1000
"""Largest number of recordings in a row group."""
MOST_EVENTS = 2**31 - 1
"""Largest number of events of a recording in Parquet, whose lists have 32-bit offsets."""


class ExportFormat(Option):
    """Layouts to which data sets are exported.

    Examples
    --------
    >>> amiwarp.ExportFormat("parquet")
    <ExportFormat.PARQUET: 'parquet'>
    """

    WEBDATASET = "webdataset"
    """Tar files with an npz of events and a JSON file of labels for each recording, as WebDataset reads them."""
    PARQUET = "parquet"
    """Folder of Parquet files with a README, as ``datasets.load_dataset`` of Hugging Face reads it."""


@guarded
@dataclass(frozen=True)
class ExportSummary:
    """What :func:`export_dataset` wrote.

    Examples
    --------
    >>> amiwarp.ExportSummary(
    ...     splits={"train": 2}, files=("train-000000.tar",), events=10, size_bytes=10240, seconds=0.1).files
    ('train-000000.tar',)
    """

    splits: Mapping[str, int]
    """Number of recordings of each split."""
    files: tuple[str, ...]
    """Files with events, relative to the folder."""
    events: int
    """Number of events."""
    size_bytes: int
    """Size of these files [bytes]."""
    seconds: float
    """Elapsed time [s]."""


@guarded
def export_dataset(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    to: ExportFormat | str,
    *,
    shard_mb: float = 256.0,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ExportSummary:
    """Export the events and labels of a data set to the layout of another library.

    Only the events and the manifest's values are exported, no encoder, camera, prism or ground truth. A data set of
    tensors is exported to WebDataset only, each file with all its arrays. The recordings of a split are in an order
    that is random, but the same every time. One recording is in memory at a time.

    Parameters
    ----------
    folder : str or path-like
        Folder of the data set, with ``manifest.json``.
    out : str or path-like
        Folder to write: a new one, or with ``overwrite`` that of an earlier export.
    to : ExportFormat or str
        ``"webdataset"`` or ``"parquet"``.
    shard_mb : float, optional
        Size from which on the next file begins [MB], before compression.
    overwrite : bool, default False
        Whether the files of an earlier export are replaced.
    progress : callable, optional
        Called with the state and the finished share.

    Returns
    -------
    ExportSummary
        The files, and what they hold.

    Raises
    ------
    AmiwarpError
        If the folder is no data set, a recording is not as the manifest says, or ``out`` holds other files or is in the
        data set. Then nothing is written.

    Examples
    --------
    >>> import json, pathlib
    >>> events = amiwarp.Events.from_arrays([1, 2], [0, 0], [0, 10], [1, 0])
    >>> folder = pathlib.Path("set")
    >>> folder.mkdir()
    >>> amiwarp.save_recording(folder / "000000.h5", amiwarp.Recording(amiwarp.MemoryEvents(events, 4, 4)))
    >>> item = {"file": "000000.h5", "split": "train", "labels": {"shape": "disc"}, "events": 2}
    >>> manifest = {"format": "amiwarp-dataset", "version": 1, "items": [item]}
    >>> _ = (folder / "manifest.json").write_text(json.dumps(manifest))
    >>> amiwarp.export_dataset(folder, "tars", "webdataset").files
    ('train-000000.tar',)
    """
    began = time.perf_counter()
    folder, out, report = Path(folder), Path(out), progress or silent
    chosen = choice(ExportFormat, to, "to")
    if out.resolve().is_relative_to(folder.resolve()):
        raise AmiwarpError(f"{out}: is in the data set {folder}; export to a folder outside it")
    limit = round(1e6 * real(shard_mb, "shard_mb", 1e-3, 1e6, " MB"))
    with _folder(out):
        return _export(folder, out, chosen, limit, overwrite, report, began)


def _export(
    folder: Path, out: Path, chosen: ExportFormat, limit: int, overwrite: bool, report: Progress, began: float
) -> ExportSummary:
    """Write the export to an existing folder, first to a scratch folder in it."""
    head, items = formats.read_manifest(folder / formats.MANIFEST)
    if not items:
        raise AmiwarpError(f"{folder}: has no recordings to export; make some with 'amiwarp dataset'")
    tensors = [item for item in items if item.representation is not None]
    if tensors and chosen is ExportFormat.PARQUET:
        raise AmiwarpError(
            f"{folder}: holds tensors ({tensors[0].representation}), the columns are for events; export to webdataset"
        )
    old = _files_of_earlier(out, overwrite)
    items.sort(key=lambda item: hashlib.sha256(item.file.encode()).digest())
    splits = Counter(item.split for item in items)
    count = 0

    def opened(split: str) -> Iterator[tuple[formats.ManifestItem, Any]]:
        nonlocal count
        for item in items:
            if item.split == split:
                yield item, formats.open_item(folder, item) if item.representation is None else None
                count += 1
                report(f"{count:,} of {len(items):,} recordings", count / len(items))

    with scratch_folder(out) as scratch:
        if chosen is ExportFormat.WEBDATASET:
            keys = _names(items)
            names = [
                name for split in splits for name in _write_tars(folder, scratch, split, opened(split), keys, limit)
            ]
        else:
            names = _write_parquet(scratch, list(splits), opened, items, limit)
            (scratch / "README.md").write_text(_card(head.get("name") or "Events", items), encoding="utf-8")
        size = sum((scratch / name).stat().st_size for name in names)
        files = [*names, *(["README.md"] if chosen is ExportFormat.PARQUET else [])]
        index = {
            "format": FORMAT, "version": 1, "to": chosen.value, "amiwarp": __version__, "name": head.get("name", ""),
            "splits": dict(splits), "complete": True, "files": files,
        }  # fmt: skip
        # If this process is killed meanwhile, the index says so, and the next export removes all these files.
        _write_index(out, index | {"complete": False, "files": sorted(old | set(files))}, overwrite=overwrite)
        for inner in {Path(name).parent for name in files}:
            formats.make_folder(out / inner)
        for name in files:
            put_in_place(scratch / name, out / name, overwrite=overwrite)
    for name in old - set(files):
        (out / name).unlink(missing_ok=True)
    _write_index(out, index, overwrite=True)
    return ExportSummary(
        dict(splits), tuple(names), sum(item.events for item in items), size, time.perf_counter() - began
    )


def _write_index(out: Path, index: Mapping[str, Any], *, overwrite: bool) -> None:
    write_text(out / INDEX, json.dumps(index, indent=1) + "\n", overwrite=overwrite)


@contextlib.contextmanager
def _folder(out: Path) -> Iterator[None]:
    """Create a folder. After an error a new one is removed if it is empty."""
    new = not out.exists()
    formats.make_folder(out)
    try:
        yield
    except BaseException:
        if new:
            with contextlib.suppress(OSError):
                out.rmdir()
        raise


def _files_of_earlier(out: Path, overwrite: bool) -> set[str]:
    """Return the files of an earlier export in ``out``, which may be replaced.

    Raises :class:`AmiwarpError` if it may not, or if the folder holds other files.
    """
    if not out.is_dir():
        return set()
    index = out / INDEX
    if not index.is_file():
        other = sorted(path.name for path in out.iterdir() if not path.name.startswith("."))
        if other:
            raise AmiwarpError(f"{out}: holds other files, such as {other[0]}; give a new folder")
        return set()
    check_output(index, overwrite=overwrite)
    with errors_name(index, lambda: "reading the index of an export"), open_input(index, noted=False) as file:
        files = dict(parse_json(file.read(formats.MOST_BYTES))).get("files")
    known = r"(data/)?[A-Za-z0-9_-]+[.](tar|parquet)|README[.]md"
    return {name for name in files or () if isinstance(name, str) and re.fullmatch(known, name)}


def _names(items: Sequence[formats.ManifestItem]) -> dict[str, str]:
    """Return the names of the samples by file: its path without ending, as far as WebDataset allows it.

    A hash of the file follows where several have the same name, because WebDataset joins members of one name.
    """
    plain = {
        item.file: re.sub(r"[^A-Za-z0-9_-]+", "_", PurePosixPath(item.file).with_suffix("").as_posix())
        for item in items
    }
    count = Counter(plain.values())
    return {
        file: name if count[name] == 1 else f"{name}-{hashlib.sha256(file.encode()).hexdigest()[:16]}"
        for file, name in plain.items()
    }


# WebDataset: tar files in which the members of one sample have the same name up to the first dot.


def _write_tars(
    folder: Path,
    scratch: Path,
    split: str,
    opened: Iterator[tuple[formats.ManifestItem, Any]],
    keys: Mapping[str, str],
    limit: int,
) -> Iterator[str]:
    """Write the recordings of a split as tar files of at least ``limit`` bytes. Yield the name of each.

    The data set lies in ``folder``, unfinished files in ``scratch``. Tensors are stored instead of recordings that are
    None. ``keys``: names of the samples by file.
    """
    count, archive = 0, None
    with contextlib.ExitStack() as stack:
        for item, recording in opened:
            if archive is None or archive.offset >= limit:
                stack.close()
                name = f"{split}-{count:06}.tar"
                archive = stack.enter_context(tarfile.open(scratch / name, "w", format=tarfile.PAX_FORMAT))
                count += 1
                yield name
            if recording is None:  # the tensors of one, which are such an archive already
                arrays = folder / item.file
            else:
                arrays = scratch / "events.npz"
                export(
                    recording.events, arrays, formats.OutputFormat.NPZ, recording.events.size,
                    codec=formats.Codec.BLOSC, progress=None, overwrite=True,
                )  # fmt: skip
            with open_input(arrays, noted=False) as file:
                _add(archive, f"{keys[item.file]}.npz", file, arrays.stat().st_size)
            text = json.dumps(item.entry).encode()
            _add(archive, f"{keys[item.file]}.json", io.BytesIO(text), len(text))


def _add(archive: tarfile.TarFile, name: str, file: Any, size: int) -> None:
    """Add a member. Its owner and date are always the same, so that equal data sets give equal archives."""
    member = tarfile.TarInfo(name)
    member.size = size
    archive.addfile(member, file)


# Parquet: one row for each recording, with lists of the events' columns.


def _hub_name(split: str) -> str:
    """Return the name of a split for ``datasets``, which allows no hyphen."""
    return split.replace("-", "_")


def _write_parquet(
    scratch: Path,
    splits: Sequence[str],
    opened: Callable[[str], Iterator[tuple[formats.ManifestItem, Any]]],
    items: Sequence[formats.ManifestItem],
    limit: int,
) -> list[str]:
    """Write Parquet files of at least ``limit`` bytes before compression. Return their names."""
    pa = require_pyarrow()
    if len({_hub_name(split) for split in splits}) < len(splits):
        raise AmiwarpError(f"splits are {', '.join(splits)}; the same with '_' for '-', so give one another name")
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
                f"{formats.MANIFEST}: {name} of the items is no column of a table ({what}); give values of one type, "
                "or export to webdataset"
            ) from error
    return pa.table(columns)


def _parquet_parts(
    pa: Any,
    scratch: Path,
    opened: Iterator[tuple[formats.ManifestItem, Any]],
    rows: Any,
    place: Mapping[str, int],
    limit: int,
) -> Iterator[Path]:
    """Write the recordings of a split. Yield the path of each file."""
    parquet = importlib.import_module("pyarrow.parquet")
    waiting: list[Any] = []
    events = written = count = 0
    writer: Any = None

    def flush() -> None:
        nonlocal waiting, events
        if waiting:
            writer.write_table(pa.concat_tables(waiting).combine_chunks())
        waiting, events = [], 0

    try:
        for item, recording in opened:
            k = place[item.file]
            table = rows.slice(k, 1)
            for name, column in _columns(pa, item, recording).items():
                table = table.set_column(table.schema.get_field_index(name), name, column) if (
                    name in table.column_names) else table.append_column(name, column)  # fmt: skip
            if writer is None or written >= limit:
                if writer is not None:
                    flush()
                    writer.close()
                path = scratch / f"part-{count}.parquet"
                count, written = count + 1, 0
                writer = parquet.ParquetWriter(path, table.schema, compression="zstd", use_dictionary=["split"])
                yield path
            waiting.append(table)
            events += item.events
            written += table.nbytes
            if events >= GROUP_EVENTS or len(waiting) >= GROUP_ROWS:
                flush()
        flush()
    finally:
        if writer is not None:
            writer.close()


def _columns(pa: Any, item: formats.ManifestItem, recording: Any) -> dict[str, Any]:
    """Return the columns of one recording: lists of events, and the size of the sensor."""
    if item.events > MOST_EVENTS:
        raise AmiwarpError(
            f"{item.file}: has {item.events:,} events, a row holds {MOST_EVENTS:,}; export to webdataset"
        )
    events = recording.events.slice(0, item.events)
    if not events.whole_pixels:
        raise AmiwarpError(f"{item.file}: has sub-pixel coordinates, the columns are whole; export to webdataset")
    ends = pa.array(np.array([0, item.events], np.int32))
    lists = {name: pa.ListArray.from_arrays(ends, pa.array(getattr(events, name))) for name in ("x", "y", "t", "p")}
    return lists | {
        name: pa.array([side]) for name, side in zip(("width", "height"), recording.events.size, strict=True)
    }


def _card(title: str, items: Sequence[formats.ManifestItem]) -> str:
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
