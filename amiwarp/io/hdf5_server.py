"""Part of the HDF5 reader that runs in the reading process. It checks every group, attribute and dataset before use.

HDF5 allows links, external storage and virtual datasets that refer to other files. They are refused. Sizes that exceed
the file are refused too. :mod:`amiwarp.io.hdf5_files` receives the description of a file as JSON.
"""

import contextlib
import ctypes
import math
import os
import re
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import h5py  # noqa: TID253 - only the reading process imports this module
import hdf5plugin  # noqa: F401, TID253 - its import registers the filters
import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import EVENT_COLUMNS, MAPS
from amiwarp.io import ecf
from amiwarp.io.column_names import ROLES, names_roles
from amiwarp.io.file_scan import Columns, microseconds, whole_pixels
from amiwarp.io.hdf5_files import BLOSC, CHUNK, FLETCHER32
from amiwarp.io.native_format import FORMAT
from amiwarp.io.reading_process import Reply, forget, keep, kept

# Layouts of other data sets' HDF5 files: M3ED, MVSEC and Prophesee's. Runs in the reading process.
#
# M3ED stores columns like amiwarp, in other groups. :mod:`amiwarp.io.hdf5_server` reads the others.

SIDES = ("left", "right")


def find_layout(file: Any, topic: str | None, find: "Finder") -> tuple[str, str]:
    """Return the layout of a file, and the group of its events. ``topic`` chooses among several cameras."""
    found = {f"prophesee/{side}": "m3ed" for side in SIDES if find(f"prophesee/{side}/t") is not None}
    found |= {f"davis/{side}": "mvsec" for side in SIDES if find(f"davis/{side}/events") is not None}
    found |= {"CD": "ecf"} if find("CD/events") is not None else {}
    listed = ", ".join(found)
    if not found:
        found, listed = {"": _own_or_columns(file, find)}, "none, as it holds one stream of events"
    if topic is not None and topic not in found:
        raise AmiwarpError(f"has no events in '{topic}'; the choices for --topic are {listed}")
    if topic is None and len(found) > 1:
        remedy = "choose one with amiwarp convert --topic, in Python with topic="
        raise AmiwarpError(f"holds the events of several cameras: {listed}; {remedy}")
    chosen = next(iter(found)) if topic is None else topic
    return found[chosen], chosen


def _own_or_columns(file: Any, find: "Finder") -> str:
    """Return "native" for the layout of amiwarp and DSEC, or "columns" for any other."""
    events = find("events")
    if not isinstance(events, h5py.h5g.GroupID):
        return "columns"
    names = list(h5py.Group(events))
    own = set(ROLES) & set(names)
    if h5py.h5a.exists(find(""), b"format") or not own:
        return "native" if own else "columns"
    times = find("events/t")
    seconds = isinstance(times, h5py.h5d.DatasetID) and times.dtype.kind == "f"
    return "columns" if seconds or (len(own) < len(ROLES) and names_roles(names)) else "native"


M3ED_COLUMNS = {**{f"events/{name}": name for name in "xytp"}, "ms_to_idx": "ms_map_idx"}
"""Names of M3ED's datasets by those of the native layout."""


def m3ed_attributes(group: str, find: "Finder") -> dict[str, dict[str, Any]]:
    """Return the camera of an M3ED file as attributes of the native layout."""
    values = {}
    for name, count in (("resolution", 2), ("intrinsics", 4), ("distortion_coeffs", 4)):
        dataset = find(f"{group}/calib/{name}")
        if not isinstance(dataset, h5py.h5d.DatasetID) or dataset.shape != (count,) or dataset.dtype.kind not in "iuf":
            return {}
        values[name] = _whole(dataset).tolist()
    size = dict(zip(("width", "height"), map(int, values["resolution"]), strict=True))
    pinhole = dict(zip(("fx", "fy", "cx", "cy"), map(float, values["intrinsics"]), strict=True))
    lens = {"distortion_model": "radial_tangential", "distortion": [*map(float, values["distortion_coeffs"]), 0.0]}
    return {"/": size, "camera": {**size, **pinhole, **lens}}


ATTRIBUTES = {
    "/": ("format", "format_version", "width", "height"),
    "encoder": ("clock_offset_us",),
    "camera": ("width", "height", "fx", "fy", "cx", "cy", "distortion_model", "distortion"),
    "prism": (
        "apex",
        "index",
        "flat_side",
        "second_apex",
        "second_index",
        "second_flat_side",
        "thickness",
        "tilt",
    ),
    "truth": (),
    "truth/world": ("name",),
    "metadata": (),
}
"""Attributes that are read, by group; of ``truth`` and ``metadata`` all are read. Other attributes are ignored."""

COLUMNS = {
    **{f"events/{name}": "iub" for name in ("t", "p", "inside", "extrapolated")},
    **{f"events/{name}": "iuf" for name in ("x", "y")},
    "ms_to_idx": "iu",
    "t_offset": "iuf",
    "encoder/t": "iu",
    "encoder/angle": "f",
    "encoder/index_t": "iu",
    "encoder/second_t": "iu",
    "encoder/second_angle": "f",
    "truth/x": "f",
    "truth/y": "f",
    **{
        f"truth/{group}/{name}": "f" if np.dtype(dtype).kind == "f" else "iu"
        for group, table in (("events", EVENT_COLUMNS), ("frames", MAPS))
        for name, (dtype, _) in table.items()
    },
    "truth/frames/t": "iu",
    **{f"truth/frames/{name}": "f" for name in ("pose", "joints")},
    **{f"truth/known/{name}": "iu" for name in ("t", "mask")},
    "truth/poses/t": "iu",
    "truth/poses/camera": "f",
    "truth/poses/bodies": "f",
    "truth/joints/position": "f",
    **{f"{group}/t": "iu" for group in ("imu", "frames")},
    **{f"imu/{name}": "f" for name in ("angular_velocity", "acceleration")},
    "frames/image": "u",
    **{f"truth/{name}": "S" for name in ("world/instances", "world/categories", "poses/body_names", "joints/names")},
}
"""Datasets that are read, with the kinds of data types allowed for each, as in NumPy's ``dtype.kind``."""

DIMENSIONS = {
    "t_offset": 0,
    **{f"truth/events/{name}": 1 + len(row) for name, (_, row) in EVENT_COLUMNS.items()},
    **{f"truth/frames/{name}": 3 + len(tail) for name, (_, tail) in MAPS.items()},
    **{f"truth/{name}": 2 for name in ("frames/pose", "poses/camera")},
    **{f"truth/{name}": 3 for name in ("frames/joints", "poses/bodies", "joints/position")},
    "truth/known/mask": 3,
    **{f"imu/{name}": 2 for name in ("angular_velocity", "acceleration")},
    "frames/image": 3,
}
"""Numbers of dimensions of the datasets; of those that are not listed, one."""

READ_AT_ONCE = (
    "t_offset", "encoder/t", "encoder/angle", "encoder/index_t", "encoder/second_t", "encoder/second_angle",
    "truth/frames/t", "truth/known/t",
    "truth/world/instances", "truth/world/categories", "truth/poses/body_names", "truth/joints/names",
    "imu/t", "imu/angular_velocity", "imu/acceleration", "frames/t",
)  # fmt: skip
"""Datasets that are read into memory at once, and therefore have stricter size limits."""

READ_ON_DEMAND = ("events/", "truth/x", "truth/y", "truth/events/", "ms_to_idx")
"""Prefixes of the datasets that are read repeatedly after a file was opened."""

AT_ONCE_BYTES, AT_ONCE_RATIO = 1 << 24, 1000
"""Limits of the datasets in :data:`READ_AT_ONCE`: size in memory [bytes], or ratio to the size in the file. The larger
limit applies."""

CHUNK_BYTES = 1 << 28
"""Largest chunk that is read [bytes]. HDF5 holds a decoded chunk in memory."""

CACHE_BYTES = 1 << 22
"""HDF5's cache of decoded chunks per dataset [bytes]. Chunks of other writers may exceed the default of 1 MB."""

ATTRIBUTE_BYTES = 1 << 16
"""Size of the largest attribute that is read [bytes]."""

ATTEMPTS = 24
"""Number of attempts to read a block that is being written. The pauses double from 1 ns; their sum is 17 ms."""

FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32", 4: "szip", 5: "nbit", 6: "scaleoffset", 307: "bzip2",
           32000: "lzf", 32001: "blosc", 32004: "lz4", 32008: "bitshuffle", 32013: "zfp", 32015: "zstd",
           32026: "blosc2"}  # fmt: skip
"""Names of HDF5 filters by number, for messages."""


def open_file(path: str, topic: str | None, again: bool) -> Reply:
    """Open a file, and return all that is needed to read it, with the values of datasets that HDF5 reads at once.

    The file stays open for :func:`read` if HDF5 is needed to read events. If the file is opened ``again``, it stays
    open in any case, and no values are read.
    """
    file, unfinished = _open(path)
    keep("file", file)
    find = Finder(file)
    layout, group = find_layout(file, topic, find)
    groups = {name: found for name in ATTRIBUTES if (found := _group(find, name)) is not None}
    attributes = {name: dict(_attributes(found, name)) for name, found in groups.items()}
    ours = attributes.get("/", {}).get("format") == FORMAT
    names = {name: name for name in COLUMNS if ours or not name.startswith(("imu/", "frames/"))}
    if layout == "m3ed":
        names = {name: f"{group}/{theirs}" for name, theirs in M3ED_COLUMNS.items()}
        attributes = m3ed_attributes(group, find)
    columns: dict[str, Any] = {}
    keep("columns", columns)
    described, values = {}, []
    about = _FileFacts(path, unfinished, _is_plain(file), os.path.getsize(path))
    for name, stored in names.items() if layout in ("native", "m3ed") else ():
        dataset = find(stored)
        if dataset is not None:
            described[name] = _describe(dataset, name, COLUMNS[name], about)
            columns[name] = dataset
    stays_open = again
    for name, column in described.items():
        if column["places"] is None:
            if name in READ_AT_ONCE and not again:
                with contextlib.suppress(Exception):  # reading this dataset alone reports the error
                    values += read(name, 0, column["count"])[1]
                    column["at_once"] = len(values) - 1
            stays_open |= "at_once" not in column and (name in READ_AT_ONCE or name.startswith(READ_ON_DEMAND))
    identity = _identity(file, path)
    if not stays_open:
        forget()
    return {
        "identity": identity,
        "layout": layout,
        "group": group,
        "unfinished": unfinished,
        "attributes": attributes,
        "columns": described,
        "open": stays_open,
    }, values


def read(name: str, start: int, stop: int) -> Reply:
    """Return the rows ``start`` to ``stop`` (excluded) of a dataset."""
    dataset = kept("columns")[name]
    whole = (start, stop) == (0, (dataset.shape or (1,))[0])
    return None, [np.atleast_1d(_whole(dataset) if whole else h5py.Dataset(dataset)[start:stop])]


def _whole(stored: Any) -> NDArray[Any]:
    """Return all values of a dataset or an attribute."""
    values = np.zeros(stored.shape, stored.dtype)
    if isinstance(stored, h5py.h5d.DatasetID):
        stored.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    else:
        stored.read(values)
    return values


def _open(path: str) -> tuple[Any, bool]:
    """Open a file and return whether it is unfinished. HDF5 opens unfinished files only if they are live recordings."""
    name, how, access = os.fsencode(path), h5py.h5f.ACC_RDONLY, _access()
    try:
        return h5py.h5f.open(name, how, fapl=access), False
    except OSError:
        with contextlib.suppress(OSError):
            return h5py.h5f.open(name, how | h5py.h5f.ACC_SWMR_READ, fapl=access), True
        raise


@cache
def _access() -> Any:
    """Return the settings with which files are opened."""
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
    elements, slots, _, preemption = access.get_cache()
    access.set_cache(elements, slots, CACHE_BYTES, preemption)
    # HDF5 reads a block of an unfinished file with a wrong checksum again, 100 times by default, and doubles the pause
    # each time, which takes forever. h5py does not expose this setting.
    with contextlib.suppress(AttributeError, OSError):
        attempts = ctypes.CDLL(h5py.h5p.__file__).H5Pset_metadata_read_attempts
        attempts(ctypes.c_int64(access.id), ctypes.c_uint(ATTEMPTS))
    return access


def _identity(file: Any, path: str) -> list[int]:
    """Return device and inode of the open file. They identify it even if its name refers to another file by now."""
    found = os.fstat(file.get_vfd_handle()) if hasattr(os, "pread") else os.stat(path)
    return [found.st_dev, found.st_ino]


def _is_plain(file: Any) -> bool:
    """Return whether HDF5's places of chunks are places in the file, which another process can read."""
    plain = hasattr(os, "pread") and file.get_access_plist().get_driver() == h5py.h5fd.SEC2
    return bool(plain and file.get_create_plist().get_userblock() == 0)


class Finder:
    """Function that finds a group or dataset of an open file, once each. All access to its objects goes through it.

    It raises :class:`AmiwarpError` for links, and for datasets whose values are in other files. It uses h5py's
    low-level objects, which take less time.
    """

    def __init__(self, file: Any) -> None:
        self._found: dict[str, Any] = {"": h5py.h5g.open(file, b"/")}

    def __call__(self, name: str) -> Any:
        """Return the object of that name, or None."""
        if name not in self._found:
            self._found[name] = self._open(name)
        return self._found[name]

    def _open(self, name: str) -> Any:
        folder, _, last = name.rpartition("/")
        parent, key = self(folder), last.encode()
        if not isinstance(parent, h5py.h5g.GroupID) or not parent.links.exists(key):
            return None
        if parent.links.get_info(key).type != h5py.h5l.TYPE_HARD:
            raise AmiwarpError(f"'{name}' is a soft or external link; replace the link by a copy of the data")
        found = h5py.h5o.open(parent, key)
        if isinstance(found, h5py.h5d.DatasetID):
            creation = found.get_create_plist()
            if creation.get_layout() == h5py.h5d.VIRTUAL or creation.get_external_count():
                raise AmiwarpError(
                    f"dataset '{name}' takes its values from other files; copy the values into this file"
                )
        return found


def member(file: h5py.File, name: str) -> Any:
    """Return a group or dataset of the file, or None, as :class:`Finder`."""
    found = Finder(file.id)(name)
    kinds = {h5py.h5d.DatasetID: h5py.Dataset, h5py.h5g.GroupID: h5py.Group}
    return kinds[type(found)](found) if type(found) in kinds else None


def _group(find: Finder, name: str) -> Any:
    found = find(name.strip("/"))
    if found is not None and not isinstance(found, h5py.h5g.GroupID):
        raise AmiwarpError(f"'{name}' is not a group; see docs/reference/recording-format.md")
    return found


def _attributes(group: Any, name: str) -> Iterator[tuple[str, Any]]:
    wanted = ATTRIBUTES[name] or [_text(found) for found in h5py.Group(group).attrs]
    for attribute in wanted:
        if h5py.h5a.exists(group, attribute.encode()):
            yield attribute, _value(group, name, attribute)


def _value(group: Any, name: str, attribute: str) -> Any:
    """Return the value of an attribute: a number, a string, or a list of these."""
    stored = h5py.h5a.open(group, attribute.encode())
    classes = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM)
    if stored.get_type().get_class() not in classes or stored.shape is None:
        raise AmiwarpError(f"{name} attribute '{attribute}' is neither a number nor a string; remove it")
    if stored.get_storage_size() > ATTRIBUTE_BYTES:
        raise AmiwarpError(f"{name} attribute '{attribute}' has over {ATTRIBUTE_BYTES} bytes; the file is damaged")
    return plain_value(_whole(stored)[()])


def plain_value(value: Any) -> Any:
    """Return a value of NumPy or HDF5 as a plain Python value."""
    if isinstance(value, np.ndarray):
        return [plain_value(item) for item in value.ravel()]
    if isinstance(value, (bytes, str)):
        return _text(value)
    if isinstance(value, np.floating):
        return float(value)
    return value.item() if isinstance(value, np.generic) else value


def _text(value: Any) -> str:
    """Decode text as UTF-8; bytes that are not UTF-8 are replaced."""
    stored = value if isinstance(value, bytes) else value.encode("utf-8", "surrogateescape")
    return stored.decode("utf-8", "replace")


class _FileFacts(NamedTuple):
    """What is known of an open file when its datasets are described."""

    path: str
    unfinished: bool
    """Whether it may still grow."""
    plain: bool
    """See :func:`_is_plain`."""
    size: int
    """Size when it was opened [bytes]."""

    def size_now(self) -> int:
        """Return the size of the file [bytes]."""
        return os.path.getsize(self.path) if self.unfinished else self.size


class _Dataset(NamedTuple):
    """Dataset with properties that are used several times; h5py would ask HDF5 each time. Its names are h5py's."""

    id: Any
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunks: tuple[int, ...] | None
    filters: list[Any]


def _describe(found: Any, name: str, kinds: str, about: _FileFacts) -> dict[str, Any]:
    """Return type, length and filters of a dataset.

    If the chunks are read without HDF5, their positions in the file are returned too.
    """
    dimensions = DIMENSIONS.get(name, 1)
    shape = found.shape if isinstance(found, h5py.h5d.DatasetID) else None
    if shape is None or len(shape) != dimensions:
        wanted = "one-dimensional" if dimensions == 1 else f"{dimensions}-dimensional"
        raise AmiwarpError(f"no {wanted} dataset '{name}'; the file is incomplete")
    creation = found.get_create_plist()
    filters = [creation.get_filter(at) for at in range(creation.get_nfilters())]
    chunked = creation.get_layout() == h5py.h5d.CHUNKED
    dataset = _Dataset(found, shape, found.dtype, creation.get_chunk() if chunked else None, filters)
    if dataset.dtype.kind not in kinds or dataset.dtype.fields is not None:
        raise AmiwarpError(f"dataset '{name}' is {dataset.dtype}; see docs/reference/recording-format.md")
    if row_bytes(dataset) > CHUNK_BYTES or (dataset.chunks or dataset.shape)[1:] != dataset.shape[1:]:
        raise AmiwarpError(
            f"dataset '{name}' has rows of over {CHUNK_BYTES >> 20} MiB, or chunks of partial rows; "
            "rewrite the file with chunks of whole rows"
        )
    places: list[tuple[int, int]] | None = None
    if dataset.chunks is None:
        count = plain_length(dataset, name, about.size_now())
    else:
        chunks = _chunks(dataset, name, about)
        count = _chunked_length(dataset, name, chunks, about.unfinished)
        places = _stored_places(dataset, chunks[: -(-count // CHUNK)]) if about.plain else None
        if places is None:
            _check_heads(dataset, name, chunks, about.path)
    if name in READ_AT_ONCE and count * row_bytes(dataset) > max(
        AT_ONCE_BYTES, AT_ONCE_RATIO * dataset.id.get_storage_size()
    ):
        raise AmiwarpError(f"dataset '{name}' declares {count} elements, too many for its size; the file is damaged")
    shown = [FILTERS.get(code, f"filter {code}") for code, *_ in filters]
    row = dataset.shape[1:]
    return {"dtype": dataset.dtype.str, "count": count, "filters": shown, "places": places, "row": row}


def row_bytes(dataset: Any) -> int:
    """Return the size of a dataset's row in memory [bytes]."""
    return int(dataset.dtype.itemsize) * math.prod(dataset.shape[1:])


def plain_length(dataset: Any, name: str, file_bytes: int) -> int:
    """Return the length of a dataset without chunks, after checking that the file holds all of it."""
    count, offset = int(dataset.shape[0]) if dataset.shape else 1, dataset.id.get_offset()
    declared, stored = count * row_bytes(dataset), dataset.id.get_storage_size()
    compact = dataset.id.get_create_plist().get_layout() == h5py.h5d.COMPACT
    inside = compact or (offset is not None and offset + declared <= file_bytes)
    if count and (stored < declared or not inside):
        raise AmiwarpError(
            f"dataset '{name}' declares {count} elements, which the file does not hold; copy the file again"
        )
    return count


def _chunked_length(dataset: Any, name: str, chunks: list[Any], unfinished: bool) -> int:
    """Return the length of a dataset with chunks, after checking that no chunk is missing.

    In an unfinished file, the length is that up to the first missing chunk.
    """
    count, size = int(dataset.shape[0]), dataset.chunks[0]
    held = next((at for at, chunk in enumerate(chunks) if chunk.chunk_offset[0] != at * size), len(chunks))
    if unfinished:
        return min(count, held * size)
    if held != -(-count // size) or len(chunks) != held:
        raise AmiwarpError(
            f"dataset '{name}' declares {count} elements, the file holds {len(chunks)} chunks of {size}; copy the "
            "file again"
        )
    return count


def _chunks(dataset: _Dataset, name: str, about: _FileFacts) -> list[Any]:
    """Return all chunks of a dataset in order, after checking that each lies in the file."""
    chunk_bytes = bytes_of_chunk(dataset, name)
    chunks: list[Any] = []
    dataset.id.chunk_iter(chunks.append)
    chunks.sort(key=lambda chunk: chunk.chunk_offset[0])
    # An unfiltered chunk of an interrupted recording may end beyond the file. HDF5 reads zeros there.
    file_bytes = about.size_now() + (chunk_bytes if about.unfinished and not dataset.filters else 0)
    # The Blosc filter's parameters are two versions, bytes per element and bytes per chunk.
    declared = [tuple(values[2:4]) for code, _, values, _ in dataset.filters if code == BLOSC]
    if (
        sum(chunk.size for chunk in chunks) > file_bytes
        or any(chunk.byte_offset is None or chunk.byte_offset + chunk.size > file_bytes for chunk in chunks)
        or any(values != (dataset.dtype.itemsize, chunk_bytes) for values in declared)
    ):
        raise _damaged_chunk(name)
    return chunks


def bytes_of_chunk(dataset: Any, name: str) -> int:
    """Return the size of a dataset's chunk in memory [bytes], after checking that it is not too large."""
    size = math.prod(dataset.chunks) * int(dataset.dtype.itemsize)
    if size > CHUNK_BYTES:
        raise AmiwarpError(f"dataset '{name}' has chunks of over {CHUNK_BYTES >> 20} MiB; store it in smaller chunks")
    return size


def _damaged_chunk(name: str) -> AmiwarpError:
    return AmiwarpError(f"dataset '{name}' has a damaged chunk; copy the file again")


def _check_heads(dataset: _Dataset, name: str, chunks: list[Any], path: str) -> None:
    """Check that the size of each chunk agrees with the dataset. HDF5 and its Blosc filter would read beyond a chunk.

    Chunks in the native layout are not checked here, because they are read without HDF5.
    """
    with open(path, "rb") as raw:
        if any(_chunk_is_damaged(dataset, chunk, raw) for chunk in chunks):
            raise _damaged_chunk(name)


def _chunk_is_damaged(dataset: _Dataset, chunk: Any, raw: Any) -> bool:
    """Return whether a chunk's stored size contradicts the dataset."""
    codes = [code for code, *_ in dataset.filters]
    chunk_bytes = (dataset.chunks or (0,))[0] * row_bytes(dataset)
    if not codes:
        return bool(chunk.size != chunk_bytes)
    if codes[0] != BLOSC:
        return False
    if chunk.filter_mask == 1:  # Blosc, the first filter, skipped this incompressible chunk
        return bool(chunk.size != chunk_bytes + 4 * (FLETCHER32 in codes))
    raw.seek(chunk.byte_offset)
    header = raw.read(16)
    # After four bytes, Blosc's header holds the uncompressed and the compressed size, little-endian.
    return len(header) < 16 or int.from_bytes(header[4:8], "little") != chunk_bytes or chunk.filter_mask != 0


def _stored_places(dataset: _Dataset, chunks: list[Any]) -> list[tuple[int, int]] | None:
    """Return offset and size of every chunk in the native layout [bytes]; None for other layouts, which HDF5 reads."""
    native = dataset.dtype.isnative and [code for code, *_ in dataset.filters] == [BLOSC, FLETCHER32]
    if not native or (dataset.chunks or (0,))[0] != CHUNK or any(chunk.filter_mask for chunk in chunks):
        return None
    return [(chunk.byte_offset, chunk.size) for chunk in chunks]


# Part of the reader of HDF5 files with one row per event that runs in the reading process.

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
        coded = is_dataset(events) and _filters(events) == [ECF]
        if group != "CD":
            others = {"frames": member(file, f"{group}/image_raw"), "imu_samples": member(file, f"{group}/imu")}
            counts = {name: int(found.shape[0]) for name, found in others.items() if is_dataset(found)}
            return {"size": MVSEC_SIZE, "counts": counts, "coded": coded}, []
        texts = [str(file.attrs[name])[:100] for name in ("geometry", "format") if name in file.attrs]
        match = re.search(r"(\d+)x(\d+)", " ".join(texts)) or re.search(r"width=(\d+);.*height=(\d+)", " ".join(texts))
        triggers = member(file, "EXT_TRIGGER/events")
        counts = {"triggers": int(triggers.shape[0])} if is_dataset(triggers) and triggers.shape[0] else {}
        size = [int(match[1]), int(match[2])] if match else None
        return {"size": size, "counts": counts, "coded": coded}, []


def read_rows(notes: dict[str, int], path: str, name: str) -> Iterator[Columns]:
    """Yield the rows of a dataset as columns: events of MVSEC or Prophesee, or triggers of Prophesee."""
    with h5py.File(path, "r") as file:
        dataset = member(file, name)
        _check_rows(dataset, name, path)
        if _filters(dataset) == [ECF]:  # triggers: the codec holds events
            raise _not_events(dataset)
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


def _filters(dataset: Any) -> list[int]:
    """Return the numbers of the filters of a dataset."""
    creation = dataset.id.get_create_plist()
    return [creation.get_filter(at)[0] for at in range(creation.get_nfilters())]


CODED_BYTES = 1 << 20
"""Size of chunks in Prophesee's codec from which on they are sent [bytes]: many are decoded at the same time."""


def read_coded(notes: dict[str, int], path: str, name: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield chunks of a dataset in Prophesee's codec: their bytes, sizes, rows, and whether they are without it."""
    with h5py.File(path, "r") as file:
        dataset = member(file, name)
        _check_rows(dataset, name, path)
        if not {"x", "y", "t", "p"} <= set(dataset.dtype.names or ()):
            raise _not_events(dataset)
        count = int(dataset.shape[0])
        length = dataset.chunks[0]
        notes["total"] = max(count, 1)
        chunks: list[bytes] = []
        rows: list[int] = []
        plain: list[bool] = []
        for start in range(0, count, length):
            size = dataset.id.get_chunk_info_by_coord((start,)).size
            if size > ecf.MOST_BYTES:
                raise AmiwarpError(
                    f"dataset '{dataset.name}': a chunk has {size} bytes; expected at most {ecf.MOST_BYTES}"
                )
            mask, data = dataset.id.read_direct_chunk((start,))
            is_plain = bool(mask & 1)  # the codec was left out for this chunk
            if is_plain:
                data = np.frombuffer(data, dataset.dtype)[list(ecf.PLAIN.names or ())].astype(ecf.PLAIN).tobytes()
            chunks.append(data)
            rows.append(min(length, count - start))
            plain.append(is_plain)
            if sum(map(len, chunks)) >= CODED_BYTES or start + length >= count:
                notes["read"] = start + rows[-1]
                sizes = np.array([len(chunk) for chunk in chunks])
                yield np.frombuffer(b"".join(chunks), np.uint8), sizes, np.array(rows), np.array(plain)
                chunks = []
                rows = []
                plain = []


def _not_events(dataset: Any) -> AmiwarpError:
    """Return the error to raise for a dataset in Prophesee's codec that holds no events."""
    return AmiwarpError(f"dataset '{dataset.name}' is {dataset.dtype}; the ECF codec holds rows of x, y, t, p")


def is_dataset(found: Any) -> bool:
    """Return whether a member of a file is a dataset with rows."""
    return isinstance(found, h5py.Dataset) and found.ndim > 0


def _check_rows(dataset: Any, name: str, path: str) -> None:
    """Check that a dataset holds rows of events, and that all of it is in the file."""
    if not is_dataset(dataset):
        trigger = name.startswith("EXT_TRIGGER")
        why = "only Prophesee's files hold triggers; give the original file" if trigger else "the file is incomplete"
        raise AmiwarpError(f"no dataset '{name}'; {why}")
    wanted = ("p", "t", "id") if name.startswith("EXT_TRIGGER") else ("x", "y", "p", "t")
    fields = dataset.dtype.fields
    if dataset.ndim == 1 and fields is not None:
        good = all(field in fields and fields[field][0].kind in "iub" for field in wanted)
    else:
        good = dataset.ndim == 2 and dataset.shape[1] == 4 and dataset.dtype.kind in "fiu"
    if not good:
        raise AmiwarpError(f"dataset '{name}' is {dataset.dtype} of shape {dataset.shape}; expected rows of x, y, t, p")
    codes = _filters(dataset)
    if ECF in codes and codes != [ECF] and not h5py.h5z.filter_avail(ECF):
        raise AmiwarpError(
            "is compressed with Prophesee's ECF codec and another filter, which is not read; install the plugin "
            "hdf5_ecf, set HDF5_PLUGIN_PATH to its folder, or convert the file to RAW with Metavision"
        )
    check_stored(dataset, name, path)


def check_stored(dataset: Any, name: str, path: str) -> None:
    """Check that the file holds all of a dataset, in chunks that fit into memory."""
    if dataset.chunks is None:
        plain_length(dataset, name, os.path.getsize(path))
        return
    chunks = math.prod(-(-size // chunk) for size, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    if chunks != dataset.id.get_num_chunks():
        raise AmiwarpError(f"dataset '{name}' declares {dataset.shape[0]} rows, which it does not hold; it is damaged")
    bytes_of_chunk(dataset, name)


# Reader of the IMU samples and frames in MVSEC's HDF5 files. Runs in the reading process.
#
# A row of ``imu`` has the acceleration x, y, z [m/s^2] and the angular velocity x, y, z [rad/s], as the data set's
# converter writes it. Times are in seconds.


def read_imu(notes: dict[str, int], path: str, group: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of all samples."""
    with h5py.File(path, "r") as file:
        times, rows = _pair(file, path, f"{group}/imu")
        if rows.shape[1:] != (6,) or rows.dtype.kind not in "fiu":
            raise AmiwarpError(f"dataset '{group}/imu' is {rows.dtype} of shape {rows.shape}; expected six columns")
        for start in range(0, len(times), PIECE):
            values = rows[start : start + PIECE].astype(np.float64)
            yield microseconds(times[start : start + PIECE]), *values[:, 3:].T, *values[:, :3].T


def read_heads(notes: dict[str, int], path: str, group: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], width, height and bytes per pixel of each frame."""
    with h5py.File(path, "r") as file:
        times, images = _pair(file, path, f"{group}/image_raw")
        if images.ndim != 3 or not all(images.shape) or images.dtype not in (np.uint8, np.uint16):
            raise AmiwarpError(
                f"dataset '{group}/image_raw' is {images.dtype} of shape {images.shape}; expected uint8 or uint16 of "
                "shape (frames, height, width)"
            )
        count, height, width = images.shape
        yield microseconds(times[()]), *(np.full(count, value) for value in (width, height, images.dtype.itemsize))


def read_images(notes: dict[str, int], path: str, group: str) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the bytes of each frame."""
    with h5py.File(path, "r") as file:
        for index in range(len(member(file, f"{group}/image_raw_ts"))):
            image = np.ascontiguousarray(member(file, f"{group}/image_raw")[index])
            yield (image.astype(image.dtype.newbyteorder("="), copy=False).reshape(-1).view(np.uint8),)


def _pair(file: Any, path: str, name: str) -> tuple[Any, Any]:
    """Return the dataset of the times and that of the values, after checking that the file holds all of both."""
    times, values = member(file, f"{name}_ts"), member(file, name)
    for dataset, shown in ((times, f"{name}_ts"), (values, name)):
        if not is_dataset(dataset):
            raise AmiwarpError(f"no dataset '{shown}'")
        check_stored(dataset, shown, path)
    if times.shape != values.shape[:1] or times.dtype.kind not in "fiu":
        raise AmiwarpError(f"dataset '{name}_ts' is {times.dtype} of shape {times.shape} for {values.shape[0]} rows")
    return times, values
