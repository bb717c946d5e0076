"""HDF5 files with one row per event, of MVSEC and Prophesee. Runs in the reading process."""

import re
from collections.abc import Iterator
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.event_packets import Columns, microseconds, whole_pixels
from amiwarp.io.hdf5.server_datasets import check_stored
from amiwarp.io.hdf5.server_objects import is_dataset, member
from amiwarp.io.prophesee import ecf
from amiwarp.io.reading_server import Reply

ECF = 0x8ECF
"""Number of Prophesee's filter in HDF5."""

PIECE = 1 << 17
"""Number of rows that are read at once."""

MVSEC_SIZE = (346, 260)
"""Size of MVSEC's cameras [px]."""


def read_head(path: str, group: str) -> Reply:
    """Return the sensor size, or None, counts of other records, and whether the events are coded, of a file of rows."""
    with h5py.File(path, "r") as file:
        events = member(file, f"{group}/events")
        is_coded = is_dataset(events) and _filters(events) == [ECF]
        counts = {}
        if group == "CD":
            size = _prophesee_size(file)
            triggers = member(file, "EXT_TRIGGER/events")
            if is_dataset(triggers) and triggers.shape[0]:
                counts["triggers"] = int(triggers.shape[0])
        else:
            size = MVSEC_SIZE
            for name, stored in (("frames", "image_raw"), ("imu_samples", "imu")):
                records = member(file, f"{group}/{stored}")
                if is_dataset(records):
                    counts[name] = int(records.shape[0])
        return {"size": size, "counts": counts, "coded": is_coded}, []


def _prophesee_size(file: h5py.File) -> tuple[int, int] | None:
    """Return the sensor size that the attributes of a file of Prophesee state, or None."""
    stated = []
    for name in ("geometry", "format"):
        if name in file.attrs:
            stated.append(str(file.attrs[name])[:100])
    text = " ".join(stated)
    match = re.search(r"(\d+)x(\d+)", text) or re.search(r"width=(\d+);.*height=(\d+)", text)
    if match is None:
        return None
    return int(match[1]), int(match[2])


def read_rows(notes: dict[str, int], path: str, name: str) -> Iterator[Columns]:
    """Yield the rows of a dataset as columns: events of MVSEC or Prophesee, or triggers of Prophesee."""
    with h5py.File(path, "r") as file:
        dataset = member(file, name)
        _check_rows(dataset, name, path)
        if _filters(dataset) == [ECF]:
            # These are triggers, but the codec holds events.
            raise _not_events(dataset)
        count = int(dataset.shape[0])
        notes["total"] = max(count, 1)
        for start in range(0, count, PIECE):
            stop = min(start + PIECE, count)
            rows = dataset[start:stop]
            notes["read"] = stop
            if rows.dtype.fields is None:
                x, y, t, p = rows.T
                on = (p > 0).astype(np.uint8)
                yield whole_pixels(x), whole_pixels(y), microseconds(t), on
            elif name.startswith("EXT_TRIGGER"):
                yield rows["id"], rows["id"] * 0, rows["t"], rows["p"]
            else:
                yield rows["x"], rows["y"], rows["t"], rows["p"]


def _filters(dataset: Any) -> list[int]:
    """Return the numbers of the filters of a dataset."""
    creation = dataset.id.get_create_plist()
    return [creation.get_filter(number)[0] for number in range(creation.get_nfilters())]


CODED_BYTES = 1 << 20
"""Size at which chunks in Prophesee's codec are sent [bytes]: many are decoded at the same time."""


def read_coded(notes: dict[str, int], path: str, name: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield chunks of a dataset in Prophesee's codec: their bytes, sizes, rows, and whether they are without it."""
    with h5py.File(path, "r") as file:
        dataset = member(file, name)
        _check_rows(dataset, name, path)
        if not {"x", "y", "t", "p"}.issubset(dataset.dtype.names or ()):
            raise _not_events(dataset)
        count = int(dataset.shape[0])
        length = dataset.chunks[0]
        notes["total"] = max(count, 1)
        chunks: list[bytes] = []
        rows: list[int] = []
        plain: list[bool] = []
        for start in range(0, count, length):
            data, is_plain = _coded_chunk(dataset, start)
            chunks.append(data)
            rows.append(min(length, count - start))
            plain.append(is_plain)
            if sum(map(len, chunks)) >= CODED_BYTES or start + length >= count:
                notes["read"] = start + rows[-1]
                sizes = np.array([len(chunk) for chunk in chunks])
                yield (
                    np.frombuffer(b"".join(chunks), np.uint8),
                    sizes,
                    np.array(rows),
                    np.array(plain),
                )
                chunks = []
                rows = []
                plain = []


def _coded_chunk(dataset: Any, start: int) -> tuple[bytes, bool]:
    """Return the bytes of the chunk from row ``start`` on, and whether the codec was left out for it."""
    size = dataset.id.get_chunk_info_by_coord((start,)).size
    if size > ecf.MOST_BYTES:
        raise AmiwarpError(
            f"dataset '{dataset.name}': a chunk has {size} bytes; expected at most {ecf.MOST_BYTES}",
            ErrorCode.FILE_DAMAGED,
        )
    skipped_filters, data = dataset.id.read_direct_chunk((start,))
    is_plain = bool(skipped_filters & 1)
    if is_plain:
        names = list(ecf.PLAIN.names or ())
        events = np.frombuffer(data, dataset.dtype)[names]
        data = events.astype(ecf.PLAIN).tobytes()
    return data, is_plain


def _not_events(dataset: Any) -> AmiwarpError:
    """Return the error to raise for a dataset in Prophesee's codec that holds no events."""
    return AmiwarpError(
        f"dataset '{dataset.name}' is {dataset.dtype}; the ECF codec holds rows of x, y, t, p",
        ErrorCode.FORMAT_UNKNOWN,
    )


def _check_rows(dataset: Any, name: str, path: str) -> None:
    """Check that a dataset holds rows of events, and that all of it is in the file."""
    are_triggers = name.startswith("EXT_TRIGGER")
    if not is_dataset(dataset):
        why = "the file is incomplete"
        if are_triggers:
            why = "only Prophesee's files hold triggers; give the original file"
        raise AmiwarpError(f"no dataset '{name}'; {why}", ErrorCode.CONTENT_MISSING)
    fields = dataset.dtype.fields
    if dataset.ndim == 1 and fields is not None:
        wanted = ("p", "t", "id") if are_triggers else ("x", "y", "p", "t")
        kinds = {name: dtype.kind for name, (dtype, *_) in fields.items()}
        is_good = all(kinds.get(name, "-") in "iub" for name in wanted)
    else:
        has_columns = dataset.ndim == 2 and dataset.shape[1] == 4
        is_good = has_columns and dataset.dtype.kind in "fiu"
    if not is_good:
        raise AmiwarpError(
            f"dataset '{name}' is {dataset.dtype} of shape {dataset.shape}; expected rows of x, y, t, p",
            ErrorCode.FORMAT_UNKNOWN,
        )
    codes = _filters(dataset)
    if ECF in codes and codes != [ECF] and not h5py.h5z.filter_avail(ECF):
        raise AmiwarpError(
            "is compressed with Prophesee's ECF codec and another filter, which is not read; install the plugin "
            "hdf5_ecf, set HDF5_PLUGIN_PATH to its folder, or convert the file to RAW with Metavision",
            ErrorCode.FORMAT_UNKNOWN,
        )
    check_stored(dataset, name, path)
