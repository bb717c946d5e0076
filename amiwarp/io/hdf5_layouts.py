"""Layouts of other data sets' HDF5 files: M3ED, MVSEC and Prophesee's. Runs in the reading process.

M3ED stores columns like amiwarp, in other groups. MVSEC and Prophesee store rows, which are read from the beginning.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import hdf5plugin  # noqa: F401, TID253 - its import registers the filters
import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.io.evt_words import Columns
from amiwarp.io.file_scan import microseconds, whole_pixels
from amiwarp.io.reading_server import Reply

Member = Callable[[Any, str], Any]
"""Function that returns a member of a file by its name, or None, and refuses links."""

SIDES = ("left", "right")
ECF = 0x8ECF
"""Number of Prophesee's filter in HDF5."""

PIECE = 1 << 17
"""Number of rows that are read at once."""

LARGEST_CHUNK = 1 << 28
"""Largest chunk that is read [bytes]."""

MVSEC_SIZE = (346, 260)
"""Size of MVSEC's cameras [px]."""


def find_layout(file: Any, topic: str | None, member: Member) -> tuple[str, str]:
    """Return the layout of a file, and the group of its events. ``topic`` chooses among several cameras."""
    found = {f"prophesee/{side}": "m3ed" for side in SIDES if member(file, f"prophesee/{side}/t") is not None}
    found |= {f"davis/{side}": "mvsec" for side in SIDES if member(file, f"davis/{side}/events") is not None}
    found |= {"CD": "ecf"} if member(file, "CD/events") is not None else {}
    listed = ", ".join(found)
    if isinstance(member(file, "events"), h5py.Group) and not found:
        found, listed = {"": "native"}, "none, as it holds one stream of events"
    if not found:
        names = ", ".join(list(file)[:20]) or "none"
        raise AmiwarpError(f"HDF5 without a group 'events'; expected events/x, y, t, p; its groups are {names}")
    if topic is not None and topic not in found:
        raise AmiwarpError(f"has no events in '{topic}'; the choices for --topic are {listed}")
    if topic is None and len(found) > 1:
        raise AmiwarpError(f"holds the events of several cameras: {listed}; choose one with --topic")
    chosen = next(iter(found)) if topic is None else topic
    return found[chosen], chosen


M3ED_COLUMNS = {**{f"events/{name}": name for name in "xytp"}, "ms_to_idx": "ms_map_idx"}
"""Names of M3ED's datasets by those of the native layout."""


def m3ed_attributes(file: Any, group: str, member: Member) -> dict[str, dict[str, Any]]:
    """Return the camera of an M3ED file as attributes of the native layout."""
    values = {}
    for name, count in (("resolution", 2), ("intrinsics", 4), ("distortion_coeffs", 4)):
        dataset = member(file, f"{group}/calib/{name}")
        if dataset is None or dataset.shape != (count,) or dataset.dtype.kind not in "iuf":
            return {}
        values[name] = dataset[()].tolist()
    size = dict(zip(("width", "height"), map(int, values["resolution"]), strict=True))
    pinhole = dict(zip(("fx", "fy", "cx", "cy"), map(float, values["intrinsics"]), strict=True))
    lens = {"distortion_model": "radial_tangential", "distortion": [*map(float, values["distortion_coeffs"]), 0.0]}
    return {"/": size, "camera": {**size, **pinhole, **lens}}


def read_head(path: str, group: str) -> Reply:
    """Return the sensor size, or None, and the counts of other records, of a file of rows."""
    from amiwarp.io.hdf5_server import member

    with h5py.File(path, "r") as file:
        if group != "CD":
            others = {"frames": member(file, f"{group}/image_raw"), "imu_samples": member(file, f"{group}/imu")}
            counts = {name: int(found.shape[0]) for name, found in others.items() if _is_dataset(found)}
            return {"size": MVSEC_SIZE, "counts": counts}, []
        texts = [str(file.attrs[name])[:100] for name in ("geometry", "format") if name in file.attrs]
        match = re.search(r"(\d+)x(\d+)", " ".join(texts)) or re.search(r"width=(\d+);.*height=(\d+)", " ".join(texts))
        triggers = member(file, "EXT_TRIGGER/events")
        counts = {"triggers": int(triggers.shape[0])} if _is_dataset(triggers) and triggers.shape[0] else {}
        return {"size": [int(match[1]), int(match[2])] if match else None, "counts": counts}, []


def read_rows(notes: dict[str, int], path: str, name: str) -> Iterator[Columns]:
    """Yield the rows of a dataset as columns: events of MVSEC or Prophesee, or triggers of Prophesee."""
    from amiwarp.io.hdf5_server import member

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


def _is_dataset(found: Any) -> bool:
    return isinstance(found, h5py.Dataset) and found.ndim > 0


def _check_rows(dataset: Any, name: str, path: str) -> None:
    """Check that a dataset holds rows of events, and that all of it is in the file."""
    from amiwarp.io.hdf5_server import plain_length

    if not _is_dataset(dataset):
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
    if dataset.chunks is None:
        plain_length(dataset, name, path)
        return
    chunks = math.prod(-(-size // chunk) for size, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    if chunks != dataset.id.get_num_chunks():
        raise AmiwarpError(f"dataset '{name}' declares {dataset.shape[0]} rows, which it does not hold; it is damaged")
    if math.prod(dataset.chunks) * dataset.dtype.itemsize > LARGEST_CHUNK:
        raise AmiwarpError(f"dataset '{name}' has chunks of over {LARGEST_CHUNK >> 20} MiB; store it in smaller ones")
