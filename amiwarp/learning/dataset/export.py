"""Export of a data set to the layouts of other libraries: WebDataset's tar files, and Parquet for Hugging Face."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from amiwarp._version import __version__
from amiwarp.errors import AmiwarpError, ErrorCode, Option
from amiwarp.io import output_formats, recorded_dataset
from amiwarp.io.inputs import errors_name, open_input
from amiwarp.io.json_files import parse_json
from amiwarp.io.outputs import check_output, put_in_place, write_text
from amiwarp.io.unfinished import scratch_folder
from amiwarp.learning.dataset.parquet import dataset_card, write_parquet
from amiwarp.learning.dataset.webdataset import write_tars
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress, silent
from amiwarp.validation import choice, real

INDEX = "export.json"
"""Name of the file that lists the files of an export. Its field ``complete`` is false while they are put in place."""
README = "README.md"
"""Name of the card of a data set in Parquet."""
FORMAT = "amiwarp-export"
"""Value of the index's field ``format``."""


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
        Folder to write: a new one, or with ``overwrite`` the folder of an earlier export.
    to : ExportFormat or str
        ``"webdataset"`` or ``"parquet"``.
    shard_mb : float, optional
        Size at which the next file begins [MB], before compression.
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
    folder = Path(folder)
    out = Path(out)
    report = progress or silent
    chosen = choice(ExportFormat, to, "to")
    if out.resolve().is_relative_to(folder.resolve()):
        raise AmiwarpError(f"{out}: is in the data set {folder}; export to a folder outside it")
    limit = round(1e6 * real(shard_mb, "shard_mb", 1e-3, 1e6, " MB"))
    with _folder(out):
        return _export(folder, out, chosen, limit, overwrite, report, began)


def _export(
    folder: Path,
    out: Path,
    chosen: ExportFormat,
    limit: int,
    overwrite: bool,
    report: Progress,
    began: float,
) -> ExportSummary:
    """Write the export to an existing folder, first to a scratch folder in it."""
    name, items = _exportable(folder, chosen)
    earlier = _files_of_earlier(out, overwrite)
    splits = Counter(item.split for item in items)
    with scratch_folder(out) as scratch:
        written = _write_files(folder, scratch, chosen, name, items, limit, report)
        size = sum((scratch / file).stat().st_size for file in written)
        files = list(written)
        if chosen is ExportFormat.PARQUET:
            files.append(README)
        index = {
            "format": FORMAT,
            "version": 1,
            "to": chosen.value,
            "amiwarp": __version__,
            "name": name,
            "splits": dict(splits),
            "complete": True,
            "files": files,
        }
        # If this process is killed meanwhile, the index says so, and the next export removes all these files.
        unfinished = index | {"complete": False, "files": sorted(earlier | set(files))}
        _write_index(out, unfinished, overwrite=overwrite)
        for inner in {Path(file).parent for file in files}:
            output_formats.make_folder(out / inner)
        for file in files:
            put_in_place(scratch / file, out / file, overwrite=overwrite)
    for file in earlier - set(files):
        (out / file).unlink(missing_ok=True)
    _write_index(out, index, overwrite=True)
    return ExportSummary(
        splits=dict(splits),
        files=tuple(written),
        events=sum(item.events for item in items),
        size_bytes=size,
        seconds=time.perf_counter() - began,
    )


def _exportable(
    folder: Path, chosen: ExportFormat
) -> tuple[str, list[recorded_dataset.ManifestItem]]:
    """Return the name of a data set, and its recordings in the order of the export.

    Raises :class:`AmiwarpError` if there are none, or if they do not fit the layout.
    """
    head, items = recorded_dataset.read_manifest(folder / recorded_dataset.MANIFEST)
    if not items:
        raise AmiwarpError(
            f"{folder}: has no recordings to export; make some with 'amiwarp dataset'",
            ErrorCode.CONTENT_MISSING,
        )
    rigs = [item for item in items if item.cameras]
    if rigs:
        raise AmiwarpError(
            f"{folder}: holds recorded rigs, and the layouts are for one camera; convert a rig with 'amiwarp convert'"
        )
    tensors = [item for item in items if item.representation is not None]
    if tensors and chosen is ExportFormat.PARQUET:
        raise AmiwarpError(
            f"{folder}: holds tensors ({tensors[0].representation}), the columns are for events; export to webdataset"
        )
    # Random, but the same every time
    items.sort(key=lambda item: hashlib.sha256(item.file.encode()).digest())
    return head.get("name", ""), items


def _write_files(
    folder: Path,
    scratch: Path,
    chosen: ExportFormat,
    name: str,
    items: Sequence[recorded_dataset.ManifestItem],
    limit: int,
    report: Progress,
) -> list[str]:
    """Write the files of an export to a scratch folder, and return the names of those with events.

    ``limit``: size at which the next file begins [bytes].
    """
    finished = 0

    def opened(split: str) -> Iterator[tuple[recorded_dataset.ManifestItem, Any]]:
        """Yield the items of a split with their open recordings, or with None for tensors."""
        nonlocal finished
        for item in items:
            if item.split == split:
                recording = None
                if item.representation is None:
                    recording = recorded_dataset.open_item(folder, item)
                yield item, recording
                finished += 1
                report(f"{finished:,} of {len(items):,} recordings", finished / len(items))

    splits = list(dict.fromkeys(item.split for item in items))
    if chosen is ExportFormat.PARQUET:
        files = write_parquet(scratch, splits, opened, items, limit)
        card = dataset_card(name or "Events", items)
        (scratch / README).write_text(card, encoding="utf-8")
        return files
    names = _names(items)
    files = []
    for split in splits:
        files += write_tars(folder, scratch, split, opened(split), names, limit)
    return files


def _write_index(out: Path, index: Mapping[str, Any], *, overwrite: bool) -> None:
    write_text(out / INDEX, json.dumps(index, indent=1) + "\n", overwrite=overwrite)


@contextlib.contextmanager
def _folder(out: Path) -> Iterator[None]:
    """Create a folder. After an error a new one is removed if it is empty."""
    new = not out.exists()
    output_formats.make_folder(out)
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
        present = sorted(path.name for path in out.iterdir() if not path.name.startswith("."))
        if present:
            raise AmiwarpError(
                f"{out}: holds other files, such as {present[0]}; give a new folder",
                ErrorCode.OUTPUT_EXISTS,
            )
        return set()
    check_output(index, overwrite=overwrite)
    with (
        errors_name(index, lambda: "reading the index of an export"),
        open_input(index, noted=False) as file,
    ):
        files = dict(parse_json(file.read(recorded_dataset.MOST_BYTES))).get("files")
    # Only names that an export can have are removed, whatever the index says.
    exported_name = r"(data/)?[A-Za-z0-9_-]+[.](tar|parquet)|README[.]md"
    return {
        name for name in files or () if isinstance(name, str) and re.fullmatch(exported_name, name)
    }


def _names(items: Sequence[recorded_dataset.ManifestItem]) -> dict[str, str]:
    """Return the names of the samples by file: its path without ending, as far as WebDataset allows it.

    A hash of the file follows where several have the same name, because WebDataset joins members of one name.
    """
    plain = {}
    for item in items:
        without_ending = PurePosixPath(item.file).with_suffix("").as_posix()
        plain[item.file] = re.sub(r"[^A-Za-z0-9_-]+", "_", without_ending)
    count = Counter(plain.values())
    names = {}
    for file, name in plain.items():
        if count[name] > 1:
            digest = hashlib.sha256(file.encode()).hexdigest()
            name = f"{name}-{digest[:16]}"
        names[file] = name
    return names
