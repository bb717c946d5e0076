"""Opening of an HDF5 file in the reading process. It checks every group, attribute and dataset before use.

HDF5 allows links, external storage and virtual datasets that refer to other files. They are refused. Sizes that exceed
the file are refused too. :mod:`amiwarp.io.hdf5.file` receives the description of a file as JSON.
"""

import contextlib
import ctypes
import os
from functools import cache
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import numpy as np
from numpy.typing import NDArray

from amiwarp.io.hdf5.server_datasets import COLUMNS, READ_AT_ONCE, FileFacts, describe
from amiwarp.io.hdf5.server_layouts import M3ED_COLUMNS, find_layout, m3ed_attributes
from amiwarp.io.hdf5.server_objects import Finder, all_values, attributes_of, group_of
from amiwarp.io.native.layout import FORMAT
from amiwarp.io.reading_server import Reply, forget, keep, kept

ATTRIBUTES: dict[str, tuple[str, ...] | None] = {
    "/": ("format", "format_version", "width", "height"),
    "encoder": ("clock_offset_us",),
    "imu": ("to_camera",),
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
    "truth": None,
    "truth/world": ("name",),
    "metadata": None,
}
"""Attributes that are read, by group; None for all. Other attributes are ignored."""

READ_ON_DEMAND = ("events/", "truth/x", "truth/y", "truth/events/", "ms_to_idx")
"""Prefixes of the datasets that are read repeatedly after a file was opened."""

CACHE_BYTES = 1 << 22
"""HDF5's cache of decoded chunks per dataset [bytes]. Chunks of other writers may exceed the default of 1 MB."""

ATTEMPTS = 24
"""Number of attempts to read a block that is being written. The pauses double from 1 ns; their sum is 17 ms."""


def open_file(path: str, topic: str | None, again: bool) -> Reply:
    """Open a file, and return all that is needed to read it, with the values of datasets that HDF5 reads at once.

    The file stays open for :func:`read` if HDF5 is needed to read events. If the file is opened ``again``, it stays
    open in any case, and no values are read.
    """
    file, unfinished = _open(path)
    keep("file", file)
    objects = Finder(file)
    layout, group = find_layout(topic, objects)
    attributes = _all_attributes(objects)
    names = _names_of_columns(layout, group, attributes)
    if layout == "m3ed":
        attributes = m3ed_attributes(group, objects)

    columns: dict[str, Any] = {}
    keep("columns", columns)
    described = {}
    about = FileFacts(path, unfinished, _is_plain(file), os.path.getsize(path))
    for name, stored in names.items():
        dataset = objects.find(stored)
        if dataset is not None:
            described[name] = describe(dataset, name, COLUMNS[name], about)
            columns[name] = dataset

    values: list[NDArray[Any]] = []
    stays_open = again
    for name, column in described.items():
        # The program itself reads chunks whose places it gets.
        if column["places"] is not None:
            continue
        if name in READ_AT_ONCE and not again:
            # An error is reported when this dataset is read alone.
            with contextlib.suppress(Exception):
                values += read(name, 0, column["count"])[1]
                column["at_once"] = len(values) - 1
        is_read_later = name in READ_AT_ONCE or name.startswith(READ_ON_DEMAND)
        if is_read_later and "at_once" not in column:
            stays_open = True

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


def _all_attributes(objects: Finder) -> dict[str, dict[str, Any]]:
    """Return the attributes of the native layout, by the name of the group, for the groups that exist."""
    # All groups come first: one that is no group is reported before an attribute.
    groups = {name: group_of(objects, name) for name in ATTRIBUTES}
    return {
        name: attributes_of(group, name, ATTRIBUTES[name])
        for name, group in groups.items()
        if group is not None
    }


def _names_of_columns(
    layout: str, group: str, attributes: dict[str, dict[str, Any]]
) -> dict[str, str]:
    """Return the names of the datasets in a file, by their names in the native layout."""
    if layout == "m3ed":
        return {name: f"{group}/{theirs}" for name, theirs in M3ED_COLUMNS.items()}
    if layout != "native":
        return {}
    # In other programs' files, datasets of these names may hold anything.
    is_own = attributes.get("/", {}).get("format") == FORMAT
    return {name: name for name in COLUMNS if is_own or not name.startswith(("imu/", "frames/"))}


def read(name: str, start: int, stop: int) -> Reply:
    """Return the rows ``start`` to ``stop`` (excluded) of a dataset."""
    dataset = kept("columns")[name]
    count = dataset.shape[0] if dataset.shape else 1
    if (start, stop) == (0, count):
        return None, [np.atleast_1d(all_values(dataset))]
    return None, [np.atleast_1d(h5py.Dataset(dataset)[start:stop])]


def _open(path: str) -> tuple[Any, bool]:
    """Open a file and return whether it is unfinished. HDF5 opens unfinished files only if they are live recordings."""
    name = os.fsencode(path)
    how = h5py.h5f.ACC_RDONLY
    access = _access()
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
