"""Groups, datasets and attributes of an open HDF5 file. Runs in the reading process."""

from collections.abc import Sequence
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module
import hdf5plugin  # noqa: F401, TID253 - its import registers the filters
import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode

ATTRIBUTE_BYTES = 1 << 16
"""Size of the largest attribute that is read [bytes]."""


def all_values(stored: Any) -> NDArray[Any]:
    """Return all values of a dataset or an attribute."""
    values = np.zeros(stored.shape, stored.dtype)
    if isinstance(stored, h5py.h5d.DatasetID):
        stored.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    else:
        stored.read(values)
    return values


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
        parent = self(folder)
        key = last.encode()
        if not isinstance(parent, h5py.h5g.GroupID) or not parent.links.exists(key):
            return None
        if parent.links.get_info(key).type != h5py.h5l.TYPE_HARD:
            raise AmiwarpError(
                f"'{name}' is a soft or external link; replace the link by a copy of the data"
            )
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
    opened = Finder(file.id)(name)
    if isinstance(opened, h5py.h5d.DatasetID):
        return h5py.Dataset(opened)
    if isinstance(opened, h5py.h5g.GroupID):
        return h5py.Group(opened)
    return None


def group_of(find: Finder, name: str) -> Any:
    """Return the group of that name, or None. Raises :class:`AmiwarpError` for a dataset."""
    item = find(name.strip("/"))
    if item is not None and not isinstance(item, h5py.h5g.GroupID):
        raise AmiwarpError(f"'{name}' is not a group; see docs/reference/recording-format.md")
    return item


def attributes_of(group: Any, name: str, wanted: Sequence[str]) -> dict[str, Any]:
    """Return the ``wanted`` attributes of a group that exist; if none are wanted, all.

    ``name``: name of the group, for messages.
    """
    if not wanted:
        wanted = [_text(stored_name) for stored_name in h5py.Group(group).attrs]
    return {
        attribute: _value(group, name, attribute)
        for attribute in wanted
        if h5py.h5a.exists(group, attribute.encode())
    }


def _value(group: Any, name: str, attribute: str) -> Any:
    """Return the value of an attribute: a number, a string, or a list of these."""
    stored = h5py.h5a.open(group, attribute.encode())
    classes = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM)
    if stored.get_type().get_class() not in classes or stored.shape is None:
        raise AmiwarpError(
            f"{name} attribute '{attribute}' is neither a number nor a string; remove it"
        )
    if stored.get_storage_size() > ATTRIBUTE_BYTES:
        raise AmiwarpError(
            f"{name} attribute '{attribute}' has over {ATTRIBUTE_BYTES} bytes; the file is damaged",
            ErrorCode.FILE_DAMAGED,
        )
    return plain_value(all_values(stored)[()])


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


def is_dataset(item: Any) -> bool:
    """Return whether a member of a file is a dataset with rows."""
    return isinstance(item, h5py.Dataset) and item.ndim > 0
