"""WebDataset: tar files in which the members of one sample have the same name up to the first dot."""

from __future__ import annotations

import contextlib
import io
import json
import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from amiwarp.io import output_formats, recorded_dataset
from amiwarp.io.export import export
from amiwarp.io.inputs import open_input


def write_tars(
    folder: Path,
    scratch: Path,
    split: str,
    opened: Iterator[tuple[recorded_dataset.ManifestItem, Any]],
    keys: Mapping[str, str],
    limit: int,
) -> Iterator[str]:
    """Write the recordings of a split as tar files of at least ``limit`` bytes. Yield the name of each.

    The data set lies in ``folder``, unfinished files in ``scratch``. Tensors are stored instead of recordings that are
    None. ``keys``: names of the samples by file.
    """
    count = 0
    archive = None
    with contextlib.ExitStack() as stack:
        for item, recording in opened:
            if archive is None or archive.offset >= limit:
                stack.close()
                name = f"{split}-{count:06}.tar"
                archive = stack.enter_context(
                    tarfile.open(scratch / name, "w", format=tarfile.PAX_FORMAT)
                )
                count += 1
                yield name
            if recording is None:  # the tensors of one, which are such an archive already
                arrays = folder / item.file
            else:
                arrays = scratch / "events.npz"
                export(
                    recording.events,
                    arrays,
                    output_formats.OutputFormat.NPZ,
                    recording.events.size,
                    codec=output_formats.Codec.BLOSC,
                    progress=None,
                    overwrite=True,
                )
            with open_input(arrays, noted=False) as file:
                _add(archive, f"{keys[item.file]}.npz", file, arrays.stat().st_size)
            text = json.dumps(item.entry).encode()
            _add(archive, f"{keys[item.file]}.json", io.BytesIO(text), len(text))


def _add(archive: tarfile.TarFile, name: str, file: Any, size: int) -> None:
    """Add a member. Its owner and date are always the same, so that equal data sets give equal archives."""
    member = tarfile.TarInfo(name)
    member.size = size
    archive.addfile(member, file)
