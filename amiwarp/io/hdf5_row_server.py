"""Part of the reader of HDF5 files with one row per event that runs in the reading process."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import hdf5plugin  # noqa: F401, TID253 - its import registers the filters
import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.io.evt_words import Columns
from amiwarp.io.file_scan import microseconds, whole_pixels
from amiwarp.io.hdf5_server import member, plain_length
from amiwarp.io.reading_server import Reply

ECF = 0x8ECF
"""Number of Prophesee's filter in HDF5."""

PIECE = 1 << 17
"""Number of rows that are read at once."""

LARGEST_CHUNK = 1 << 28
"""Largest chunk that is read [bytes]."""

MVSEC_SIZE = (346, 260)
"""Size of MVSEC's cameras [px]."""


def read_head(path: str, group: str) -> Reply:
    """Return the sensor size, or None, and the counts of other records, of a file of rows."""
    with h5py.File(path, "r") as file:
        if group != "CD":
            others = {"frames": member(file, f"{group}/image_raw"), "imu_samples": member(file, f"{group}/imu")}
            counts = {name: int(found.shape[0]) for name, found in others.items() if is_dataset(found)}
            return {"size": MVSEC_SIZE, "counts": counts}, []
        texts = [str(file.attrs[name])[:100] for name in ("geometry", "format") if name in file.attrs]
        match = re.search(r"(\d+)x(\d+)", " ".join(texts)) or re.search(r"width=(\d+);.*height=(\d+)", " ".join(texts))
        triggers = member(file, "EXT_TRIGGER/events")
        counts = {"triggers": int(triggers.shape[0])} if is_dataset(triggers) and triggers.shape[0] else {}
        return {"size": [int(match[1]), int(match[2])] if match else None, "counts": counts}, []


def read_rows(notes: dict[str, int], path: str, name: str) -> Iterator[Columns]:
    """Yield the rows of a dataset as columns: events of MVSEC or Prophesee, or triggers of Prophesee."""
    with h5py.File(path, "r") as file:
        dataset = member(file, name)
        _check_rows(dataset, name, path)
        notes["total"] = max(int(dataset.shape[0]), 1)
        for start in range(0, dataset.shape[0], PIECE):
            rows = dataset[start : start + PIECE]
            notes["read"] = min(start + PIECE, dataset.shape[0])
            if rows.dtype.fields is None:
                x, y, t, p = rows.T
                yield whole_pixels(x), whole_pixels(y), microseconds(t), (p > 0).astype(np.uint8)
            elif name.startswith("EXT_TRIGGER"):
                yield rows["id"], rows["id"] * 0, rows["t"], rows["p"]
            else:
                yield rows["x"], rows["y"], rows["t"], rows["p"]


def is_dataset(found: Any) -> bool:
    """Return whether a member of a file is a dataset with rows."""
    return isinstance(found, h5py.Dataset) and found.ndim > 0


def _check_rows(dataset: Any, name: str, path: str) -> None:
    """Check that a dataset holds rows of events, and that all of it is in the file."""
    if not is_dataset(dataset):
        raise AmiwarpError(f"no dataset '{name}'; the file is incomplete")
    wanted = ("p", "t", "id") if name.startswith("EXT_TRIGGER") else ("x", "y", "p", "t")
    fields = dataset.dtype.fields
    if dataset.ndim == 1 and fields is not None:
        good = all(field in fields and fields[field][0].kind in "iub" for field in wanted)
    else:
        good = dataset.ndim == 2 and dataset.shape[1] == 4 and dataset.dtype.kind in "fiu"
    if not good:
        raise AmiwarpError(f"dataset '{name}' is {dataset.dtype} of shape {dataset.shape}; expected rows of x, y, t, p")
    creation = dataset.id.get_create_plist()
    codes = [creation.get_filter(at)[0] for at in range(creation.get_nfilters())]
    if ECF in codes and not h5py.h5z.filter_avail(ECF):
        raise AmiwarpError(
            "is compressed with Prophesee's ECF codec, which is not installed; install the plugin hdf5_ecf, set "
            "HDF5_PLUGIN_PATH to its folder, or convert the file to RAW with Metavision"
        )
    check_stored(dataset, name, path)


def check_stored(dataset: Any, name: str, path: str) -> None:
    """Check that the file holds all of a dataset, in chunks that fit into memory."""
    if dataset.chunks is None:
        plain_length(dataset, name, path)
        return
    chunks = math.prod(-(-size // chunk) for size, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    if chunks != dataset.id.get_num_chunks():
        raise AmiwarpError(f"dataset '{name}' declares {dataset.shape[0]} rows, which it does not hold; it is damaged")
    if math.prod(dataset.chunks) * dataset.dtype.itemsize > LARGEST_CHUNK:
        raise AmiwarpError(f"dataset '{name}' has chunks of over {LARGEST_CHUNK >> 20} MiB; store it in smaller ones")
