"""HDF5 files of events, as the reading process opens them: every group, attribute and data set is checked here first.

Nothing outside the file is read: HDF5 lets links, external storage and virtual data sets name any other file. Nothing
is believed that the file cannot hold. What is known of a file goes to :mod:`amiwarp.io.hdf5` as JSON.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Iterator
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import hdf5plugin  # noqa: F401, TID253 - its import registers the filters
import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.io.chunks import BLOSC, CHUNK, FLETCHER32
from amiwarp.io.reading_server import Reply, keep, kept

ATTRIBUTES = {
    "/": ("format", "format_version", "width", "height"),
    "encoder": ("clock_offset_us",),
    "camera": ("width", "height", "fx", "fy", "cx", "cy", "distortion_model", "distortion"),
    "prism": ("apex", "index", "flat_side"),
    "truth": (),
    "metadata": (),
}
"""Attributes that are read, by group; of the last two, all. Anything else in a file is passed over."""

COLUMNS = {
    **{f"events/{name}": "iub" for name in ("t", "p", "inside", "extrapolated")},
    **{f"events/{name}": "iuf" for name in ("x", "y")},
    "ms_to_idx": "iu",
    "t_offset": "iuf",
    "encoder/t": "iu",
    "encoder/angle": "f",
    "encoder/index_t": "iu",
    "truth/x": "f",
    "truth/y": "f",
}
"""Data sets that are read, and the kinds of their types."""

WHOLE = ("t_offset", "encoder/t", "encoder/angle", "encoder/index_t")
"""Data sets that are read at once, so their sizes are bounded more tightly."""

WHOLE_BYTES, WHOLE_RATIO = 1 << 24, 1000
"""Such a data set may have so many bytes, or so many times the bytes that it takes in the file."""

CHUNK_BYTES = 1 << 28
"""Largest chunk that is read: HDF5 holds a chunk in memory, decoded."""

CACHE_BYTES = 1 << 22
"""Decoded chunks that HDF5 keeps per data set: chunks of other writers may exceed its usual 1 MB."""

ATTRIBUTE_BYTES = 1 << 16
"""Largest attribute."""

ATTEMPTS = 24
"""To read what is being written: from 1 ns between two on, each twice as long, 17 ms in all."""

FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32", 4: "szip", 5: "nbit", 6: "scaleoffset", 307: "bzip2",
           32000: "lzf", 32001: "blosc", 32004: "lz4", 32008: "bitshuffle", 32013: "zfp", 32015: "zstd",
           32026: "blosc2"}  # fmt: skip
"""Names of filters for messages."""


def open_file(path: str) -> Reply:
    """Open a file and describe it: its identity, whether it is unfinished, its attributes and its data sets."""
    file, unfinished = _open(path)
    keep("file", file)
    columns: dict[str, Any] = {}
    keep("columns", columns)
    if not isinstance(_member(file, "events"), h5py.Group):
        raise AmiwarpError("HDF5 without a group 'events'; expected events/x, y, t, p")
    groups = {name: group for name in ATTRIBUTES if (group := _group(file, name)) is not None}
    described = {}
    for name, kinds in COLUMNS.items():
        dataset = _member(file, name)
        if dataset is not None:
            described[name] = _describe(dataset, name, kinds, path, unfinished)
            columns[name] = dataset
    return {
        "identity": _identity(file),
        "unfinished": unfinished,
        "attributes": {name: dict(_attributes(group, name)) for name, group in groups.items()},
        "columns": described,
    }, []


def read(name: str, start: int, stop: int) -> Reply:
    """Read a part of a data set."""
    dataset = kept("columns")[name]
    return None, [np.atleast_1d(dataset[()] if dataset.ndim == 0 else dataset[start:stop])]


def _open(path: str) -> tuple[Any, bool]:
    """The file, and whether its writer is still at work or was cut off: HDF5 opens only a live recording then."""
    try:
        return h5py.File(path, "r", rdcc_nbytes=CACHE_BYTES), False
    except OSError:
        access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
        access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
        # HDF5 reads what does not match its checksum again, after twice the time: 100 times, for ever. h5py has no name
        # for this setting.
        with contextlib.suppress(AttributeError):
            attempts = ctypes.CDLL(h5py.h5p.__file__).H5Pset_metadata_read_attempts
            attempts(ctypes.c_int64(access.id), ctypes.c_uint(ATTEMPTS))
        with contextlib.suppress(OSError):
            how = h5py.h5f.ACC_RDONLY | h5py.h5f.ACC_SWMR_READ
            return h5py.File(h5py.h5f.open(os.fsencode(path), how, fapl=access)), True
        raise


def _identity(file: Any) -> list[int]:
    """Device and number of the file that is open; the name may lead to another one by now."""
    found = os.fstat(file.id.get_vfd_handle()) if hasattr(os, "pread") else os.stat(file.filename)
    return [found.st_dev, found.st_ino]


def _member(file: Any, name: str) -> Any:
    """The only way to an object of the file: its group or data set, None if there is none.

    Raises :class:`AmiwarpError` for a link to elsewhere and for a data set whose values lie elsewhere.
    """
    found = file
    for part in name.strip("/").split("/"):
        if not isinstance(found, h5py.Group):
            return None
        if not part:
            continue
        if not found.id.links.exists(part.encode()):
            return None
        if found.id.links.get_info(part.encode()).type != h5py.h5l.TYPE_HARD:
            raise AmiwarpError(f"'{name}' is a soft or external link; copy what it links to into the file")
        found = found[part]
    if isinstance(found, h5py.Dataset):
        creation = found.id.get_create_plist()
        if creation.get_layout() == h5py.h5d.VIRTUAL or creation.get_external_count():
            raise AmiwarpError(f"data set '{name}' takes its values from other files; copy them into this one")
    return found


def _group(file: Any, name: str) -> Any:
    found = _member(file, name)
    if found is not None and not isinstance(found, h5py.Group):
        raise AmiwarpError(f"'{name}' is not a group; see docs/recording-format.md")
    return found


def _attributes(group: Any, name: str) -> Iterator[tuple[str, Any]]:
    wanted = ATTRIBUTES[name] or [_text(found) for found in group.attrs]
    for attribute in wanted:
        if attribute in group.attrs:
            yield attribute, _value(group, name, attribute)


def _value(group: Any, name: str, attribute: str) -> Any:
    """An attribute: a number, a string, or a list of them."""
    stored = group.attrs.get_id(attribute)
    classes = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM)
    if stored.get_type().get_class() not in classes or stored.get_space().get_simple_extent_type() == h5py.h5s.NULL:
        raise AmiwarpError(f"{name} attribute '{attribute}' is neither a number nor a string")
    if stored.get_storage_size() > ATTRIBUTE_BYTES:
        raise AmiwarpError(f"{name} attribute '{attribute}' has over {ATTRIBUTE_BYTES} bytes; the file is damaged")
    return _plain(group.attrs[attribute])


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.ravel()]
    if isinstance(value, (bytes, str)):
        return _text(value)
    if isinstance(value, np.floating):
        return float(value)
    return value.item() if isinstance(value, np.generic) else value


def _text(value: Any) -> str:
    """Text that can be printed: bytes that are not UTF-8 are replaced."""
    stored = value if isinstance(value, bytes) else value.encode("utf-8", "surrogateescape")
    return stored.decode("utf-8", "replace")


def _describe(dataset: Any, name: str, kinds: str, path: str, unfinished: bool) -> dict[str, Any]:
    """Type, length, filters and, for columns that are read past HDF5, the chunks' places."""
    if not isinstance(dataset, h5py.Dataset) or dataset.ndim != (0 if name == "t_offset" else 1):
        raise AmiwarpError(f"no one-dimensional dataset '{name}'; the file is incomplete")
    dtype = dataset.dtype
    if dtype.kind not in kinds or dtype.fields is not None:
        raise AmiwarpError(f"dataset '{name}' is {dtype}; see docs/recording-format.md")
    creation = dataset.id.get_create_plist()
    filters = [creation.get_filter(at) for at in range(creation.get_nfilters())]
    places: list[tuple[int, int]] | None = None
    if dataset.chunks is None:
        count = _plain_length(dataset, name, path)
    else:
        chunks = _chunks(dataset, name, filters, path, unfinished)
        count = _chunked_length(dataset, name, chunks, unfinished)
        places = stored_places(dataset, filters, chunks[: -(-count // CHUNK)])
    if name in WHOLE and count * dtype.itemsize > max(WHOLE_BYTES, WHOLE_RATIO * dataset.id.get_storage_size()):
        raise AmiwarpError(f"dataset '{name}' declares {count} elements, too many for its size; the file is damaged")
    names = [FILTERS.get(code, f"filter {code}") for code, *_ in filters]
    return {"dtype": dtype.str, "count": count, "filters": names, "places": places}


def _plain_length(dataset: Any, name: str, path: str) -> int:
    """Elements of a data set without chunks, all of which must lie in the file."""
    count, offset = int(dataset.size), dataset.id.get_offset()
    declared, stored = count * dataset.dtype.itemsize, dataset.id.get_storage_size()
    compact = dataset.id.get_create_plist().get_layout() == h5py.h5d.COMPACT
    inside = compact or (offset is not None and offset + declared <= os.path.getsize(path))
    if count and (stored < declared or not inside):
        raise AmiwarpError(f"dataset '{name}' declares {count} elements, which the file does not hold; it is damaged")
    return count


def _chunked_length(dataset: Any, name: str, chunks: list[Any], unfinished: bool) -> int:
    """Elements of a data set whose chunks are all there; of an unfinished file those before the first gap."""
    count, size = int(dataset.shape[0]), dataset.chunks[0]
    held = next((at for at, chunk in enumerate(chunks) if chunk.chunk_offset[0] != at * size), len(chunks))
    if unfinished:
        return min(count, held * size)
    if held != -(-count // size) or len(chunks) != held:
        raise AmiwarpError(
            f"dataset '{name}' declares {count} elements, the file holds {len(chunks)} chunks of {size}; it is damaged"
        )
    return count


def _chunks(dataset: Any, name: str, filters: list[Any], path: str, unfinished: bool) -> list[Any]:
    """All chunks, sorted, each checked: neither HDF5 nor its Blosc filter looks, and would read beyond one."""
    if dataset.chunks[0] * dataset.dtype.itemsize > CHUNK_BYTES:
        raise AmiwarpError(f"dataset '{name}' has chunks of over {CHUNK_BYTES >> 20} MiB; store it in smaller ones")
    chunks: list[Any] = []
    dataset.id.chunk_iter(chunks.append)
    chunks.sort(key=lambda chunk: chunk.chunk_offset[0])
    file_bytes = os.path.getsize(path)
    # A plain chunk of a recording that was cut off may end beyond the file: HDF5 reads zeros there.
    file_bytes += dataset.chunks[0] * dataset.dtype.itemsize if unfinished and not filters else 0
    damaged = sum(chunk.size for chunk in chunks) > file_bytes or _blosc_disagrees(dataset, filters)
    with open(path, "rb") as raw:
        for chunk in chunks:
            damaged = damaged or chunk.byte_offset is None or chunk.byte_offset + chunk.size > file_bytes
            damaged = damaged or _chunk_is_damaged(dataset, filters, chunk, raw)
    if damaged:
        raise AmiwarpError(f"dataset '{name}' has a damaged chunk; copy the file anew")
    return chunks


def _blosc_disagrees(dataset: Any, filters: list[Any]) -> bool:
    itemsize = dataset.dtype.itemsize
    # The filter's parameters: two versions, bytes per element, bytes per chunk.
    told = [tuple(values[2:4]) for code, _, values, _ in filters if code == BLOSC]
    return any(values != (itemsize, dataset.chunks[0] * itemsize) for values in told)


def _chunk_is_damaged(dataset: Any, filters: list[Any], chunk: Any, raw: Any) -> bool:
    codes = [code for code, *_ in filters]
    chunk_bytes = dataset.chunks[0] * dataset.dtype.itemsize
    if not codes:
        return bool(chunk.size != chunk_bytes)
    if codes[0] != BLOSC:
        return False
    if chunk.filter_mask == 1:  # Blosc, the first filter, left out what it could not shorten
        return bool(chunk.size != chunk_bytes + 4 * (FLETCHER32 in codes))
    raw.seek(chunk.byte_offset)
    header = raw.read(16)
    # Blosc's header: four bytes, then the bytes before and after decompression, little-endian.
    return len(header) < 16 or int.from_bytes(header[4:8], "little") != chunk_bytes or chunk.filter_mask != 0


def stored_places(dataset: Any, filters: list[Any], chunks: list[Any]) -> list[tuple[int, int]] | None:
    """Offset and size of every chunk of our own layout; None for any other, which HDF5 reads."""
    file = dataset.file
    plain = hasattr(os, "pread") and file.driver == "sec2" and file.userblock_size == 0 and dataset.dtype.isnative
    if not plain or dataset.chunks != (CHUNK,) or [code for code, *_ in filters] != [BLOSC, FLETCHER32]:
        return None
    if any(chunk.filter_mask for chunk in chunks):
        return None
    return [(chunk.byte_offset, chunk.size) for chunk in chunks]
